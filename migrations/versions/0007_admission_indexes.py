"""Indexes for what admission asks: which jobs have not ended, and when an organisation had its last turn.

Revision: 0007, after 0006.
"""

from alembic import op

from migrations.steps import create_index

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_index("ix_job_organisation_id_admitted_at", "job", ["organisation_id", "admitted_at"])
    create_index("ix_job_status_floor_id", "job", ["status", "floor_id"])


def downgrade() -> None:
    op.drop_index("ix_job_status_floor_id", table_name="job")
    op.drop_index("ix_job_organisation_id_admitted_at", table_name="job")
