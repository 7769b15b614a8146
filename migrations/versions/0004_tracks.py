"""Tracks: what they are followed by, the steps that were followed, and a state to go on from.

Revision: 0004, after 0003.
"""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "track",
        sa.Column("id", sa.String(36), nullable=False),
        sa.Column("organisation_id", sa.String(36), nullable=False),
        sa.Column("key_id", sa.String(36), nullable=False),
        sa.Column("building_id", sa.String(36), nullable=False),
        sa.Column("name", sa.String(200), nullable=True),
        sa.Column("status", sa.String(20), nullable=False),
        sa.Column("ended_reason", sa.String(20), nullable=True),
        sa.Column("frame", sa.String(20), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("spec", sa.JSON(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("batches", sa.Integer(), nullable=False),
        sa.Column("next_step", sa.BigInteger(), nullable=False),
        sa.Column("waiting", sa.JSON(), nullable=False),
        sa.Column("gaps", sa.JSON(), nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.Column("touched_at", TIME, nullable=False),
        sa.Column("ended_at", TIME, nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_track"),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"],
                                name="fk_track_organisation_id_organisation"),
        sa.ForeignKeyConstraint(["key_id"], ["key.id"], name="fk_track_key_id_key"),
        sa.ForeignKeyConstraint(["building_id"], ["building.id"], name="fk_track_building_id_building"),
    )  # fmt: skip
    op.create_index("ix_track_building_id", "track", ["building_id"])
    op.create_index("ix_track_organisation_id_id", "track", ["organisation_id", "id"])
    op.create_index("ix_track_key_id_status", "track", ["key_id", "status"])
    op.create_index("ix_track_status_touched_at", "track", ["status", "touched_at"])
    op.create_table(
        "track_steps",
        sa.Column("track_id", sa.String(36), nullable=False),
        sa.Column("sequence", sa.Integer(), nullable=False, autoincrement=False),
        sa.Column("next_step", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("settled", sa.JSON(), nullable=True),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.PrimaryKeyConstraint("track_id", "sequence", name="pk_track_steps"),
        sa.ForeignKeyConstraint(["track_id"], ["track.id"], name="fk_track_steps_track_id_track"),
    )
    op.create_table(
        "track_state",
        sa.Column("track_id", sa.String(36), nullable=False),
        sa.Column("batches", sa.Integer(), nullable=False),
        sa.Column("written_by", sa.String(40), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("track_id", name="pk_track_state"),
        sa.ForeignKeyConstraint(["track_id"], ["track.id"], name="fk_track_state_track_id_track"),
    )


def downgrade() -> None:
    for table in ("track_state", "track_steps", "track"):
        op.drop_table(table)
