"""One key for each subject of an identity provider.

Revision: 0010, after 0009.
"""

from alembic import op

from migrations.steps import create_index

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_index("ix_key_organisation_id_issuer_subject", "key", ["organisation_id", "issuer", "subject"], unique=True)


def downgrade() -> None:
    op.drop_index("ix_key_organisation_id_issuer_subject", table_name="key")
