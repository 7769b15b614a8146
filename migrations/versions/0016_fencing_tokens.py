"""A running job says whose try at it counts, and what was claimed.

Revision: 0016, after 0015.
"""

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("job", sa.Column("fencing_token", sa.String(36), nullable=True))
    op.add_column("job", sa.Column("plan", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.drop_column("job", "plan")
    op.drop_column("job", "fencing_token")
