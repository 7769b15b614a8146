"""Tiles of a large floor that workers fit together: which chunks of which order, and who took them.

Revision: 0013, after 0012.
"""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "tile_chunk",
        sa.Column("offer_id", sa.String(36), primary_key=True),
        sa.Column("number", sa.Integer(), primary_key=True, autoincrement=False),
        sa.Column("job_id", sa.String(36), nullable=False),
        sa.Column("order_sha256", sa.String(64), nullable=False),
        sa.Column("version", sa.String(40), nullable=False),
        sa.Column("taken_by", sa.String(120), nullable=True),
        sa.Column("fits_sha256", sa.String(64), nullable=True),
    )


def downgrade() -> None:
    op.drop_table("tile_chunk")
