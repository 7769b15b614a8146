"""The size of a survey's file, for the limit of what an organisation may keep; null for those from before.

Revision: 0011, after 0010.
"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("survey", sa.Column("raw_bytes", sa.BigInteger(), nullable=True))


def downgrade() -> None:
    op.drop_column("survey", "raw_bytes")
