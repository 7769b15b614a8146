"""The first tables.

Revision: 0001, after nothing.
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "organisation",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_organisation"),
        sa.UniqueConstraint("name", name="uq_organisation_name"),
    )
    op.create_table(
        "worker",
        sa.Column("id", sa.String(length=120), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("beat", sa.DateTime(timezone=True), nullable=False),
        sa.Column("reaper", sa.String(length=120), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_worker"),
    )
    op.create_table(
        "building",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("anchor", sa.JSON(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["organisation_id"], ["organisation.id"], name="fk_building_organisation_id_organisation"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_building"),
    )
    op.create_index("ix_building_organisation_id", "building", ["organisation_id"])

    op.create_table(
        "idempotency",
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("status_code", sa.Integer(), nullable=False),
        sa.Column("body", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["organisation_id"], ["organisation.id"], name="fk_idempotency_organisation_id_organisation"
        ),
        sa.PrimaryKeyConstraint("organisation_id", "key", name="pk_idempotency"),
    )
    op.create_table(
        "job",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("floor_id", sa.String(length=36), nullable=False),
        sa.Column("map_id", sa.String(length=36), nullable=True),
        sa.Column("kind", sa.String(length=40), nullable=False),
        sa.Column("workflow_id", sa.String(length=120), nullable=False),
        sa.Column("status", sa.String(length=20), nullable=False),
        sa.Column("progress", sa.Integer(), nullable=False),
        sa.Column("message", sa.String(), nullable=False),
        sa.Column("cancel_requested", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"], name="fk_job_organisation_id_organisation"),
        sa.PrimaryKeyConstraint("id", name="pk_job"),
        sa.UniqueConstraint("workflow_id", name="uq_job_workflow_id"),
    )
    op.create_index("ix_job_organisation_id_id", "job", ["organisation_id", "id"])

    op.create_table(
        "key",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("revoked_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"], name="fk_key_organisation_id_organisation"),
        sa.PrimaryKeyConstraint("id", name="pk_key"),
        sa.UniqueConstraint("sha256", name="uq_key_sha256"),
    )
    op.create_index("ix_key_organisation_id", "key", ["organisation_id"])

    op.create_table(
        "floor",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("building_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("elevation_m", sa.Double(), nullable=False),
        sa.Column("height_m", sa.Double(), nullable=True),
        sa.Column("outline", sa.JSON(), nullable=True),
        sa.Column("auto_build", sa.Boolean(), nullable=False),
        sa.Column("claimed_generation", sa.Integer(), nullable=False),
        sa.Column("build_sequence", sa.Integer(), nullable=False),
        sa.Column("active_map_id", sa.String(length=36), nullable=True),
        sa.Column("active_sequence", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["building_id"], ["building.id"], name="fk_floor_building_id_building"),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"], name="fk_floor_organisation_id_organisation"),
        sa.PrimaryKeyConstraint("id", name="pk_floor"),
    )
    op.create_index("ix_floor_building_id", "floor", ["building_id"])

    op.create_table(
        "map",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("floor_id", sa.String(length=36), nullable=False),
        sa.Column("status", sa.String(length=20), nullable=False),
        sa.Column("sequence", sa.Integer(), nullable=False),
        sa.Column("activate", sa.Boolean(), nullable=False),
        sa.Column("spec", sa.JSON(), nullable=False),
        sa.Column("survey_ids", sa.JSON(), nullable=False),
        sa.Column("components", sa.String(length=20), nullable=True),
        sa.Column("grid_sha256", sa.String(length=64), nullable=True),
        sa.Column("quality_sha256", sa.String(length=64), nullable=True),
        sa.Column("bounds_m", sa.JSON(), nullable=True),
        sa.Column("hyperparameters", sa.JSON(), nullable=True),
        sa.Column("score", sa.JSON(), nullable=True),
        sa.Column("score_reason", sa.String(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["floor_id"], ["floor.id"], name="fk_map_floor_id_floor"),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"], name="fk_map_organisation_id_organisation"),
        sa.PrimaryKeyConstraint("id", name="pk_map"),
    )
    op.create_index("ix_map_floor_id", "map", ["floor_id"])

    op.create_table(
        "survey",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("organisation_id", sa.String(length=36), nullable=False),
        sa.Column("floor_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("format", sa.String(length=40), nullable=False),
        sa.Column("frame", sa.String(length=20), nullable=False),
        sa.Column("raw_sha256", sa.String(length=64), nullable=False),
        sa.Column("samples_sha256", sa.String(length=64), nullable=False),
        sa.Column("sample_count", sa.Integer(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("included", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["floor_id"], ["floor.id"], name="fk_survey_floor_id_floor"),
        sa.ForeignKeyConstraint(
            ["organisation_id"], ["organisation.id"], name="fk_survey_organisation_id_organisation"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_survey"),
        sa.UniqueConstraint(
            "floor_id", "raw_sha256", "format", "frame", name="uq_survey_floor_id_raw_sha256_format_frame"
        ),
    )
    op.create_index("ix_survey_floor_id", "survey", ["floor_id"])


def downgrade() -> None:
    op.drop_index("ix_survey_floor_id", "survey")
    op.drop_table("survey")
    op.drop_index("ix_map_floor_id", "map")
    op.drop_table("map")
    op.drop_index("ix_floor_building_id", "floor")
    op.drop_table("floor")
    op.drop_index("ix_key_organisation_id", "key")
    op.drop_table("key")
    op.drop_index("ix_job_organisation_id_id", "job")
    op.drop_table("job")
    op.drop_table("idempotency")
    op.drop_index("ix_building_organisation_id", "building")
    op.drop_table("building")
    op.drop_table("worker")
    op.drop_table("organisation")
