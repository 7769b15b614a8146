"""An organisation's surveys and their bytes are counted from the index alone.

Revision: 0012, after 0011.
"""

from alembic import op

from migrations.steps import create_index

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_index("ix_survey_organisation_id_raw_bytes", "survey", ["organisation_id", "raw_bytes"])


def downgrade() -> None:
    op.drop_index("ix_survey_organisation_id_raw_bytes", table_name="survey")
