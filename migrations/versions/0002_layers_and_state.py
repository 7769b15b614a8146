"""A map's layers beside its grid, and the state of its fit.

Revision: 0002, after 0001.
"""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("map", sa.Column("layers_sha256", sa.String(length=64), nullable=True))
    op.add_column("map", sa.Column("state_sha256", sa.String(length=64), nullable=True))


def downgrade() -> None:
    op.drop_column("map", "state_sha256")
    op.drop_column("map", "layers_sha256")
