"""Waiting jobs are admitted to the engine in turn: their priority, when they were, and the slots of workers.

Revision: 0006, after 0005.
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("worker", sa.Column("slots", sa.Integer(), nullable=True))
    op.add_column("job", sa.Column("priority", sa.SmallInteger(), nullable=False, server_default="2"))
    op.add_column("job", sa.Column("admitted_at", sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("job") as job:
        job.drop_column("admitted_at")
        job.drop_column("priority")
    with op.batch_alter_table("worker") as worker:
        worker.drop_column("slots")
