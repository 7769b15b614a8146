"""A floor's plan: the picture's hash, and where it lies.

Revision: 0003, after 0002.
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("floor", sa.Column("plan", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.drop_column("floor", "plan")
