"""Calibrations of devices; which one a survey was taken with, and the stretches of a survey that are left out.

Revision: 0005, after 0004.
"""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "calibration",
        sa.Column("id", sa.String(36), nullable=False),
        sa.Column("organisation_id", sa.String(36), nullable=False),
        sa.Column("device", sa.String(200), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("method", sa.String(40), nullable=False),
        sa.Column("model", sa.JSON(), nullable=False),
        sa.Column("fit", sa.JSON(), nullable=False),
        sa.Column("reference", sa.JSON(), nullable=False),
        sa.Column("samples_sha256", sa.String(64), nullable=False),
        sa.Column("measured_at", TIME, nullable=False),
        sa.Column("created_at", TIME, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_calibration"),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"],
                                name="fk_calibration_organisation_id_organisation"),
        sa.UniqueConstraint("organisation_id", "device", "version",
                            name="uq_calibration_organisation_id_device_version"),
    )  # fmt: skip
    op.create_index("ix_calibration_organisation_id_id", "calibration", ["organisation_id", "id"])
    with op.batch_alter_table("survey") as survey:
        survey.add_column(sa.Column("calibration_id", sa.String(36), nullable=True))
        survey.add_column(sa.Column("excluded_s", sa.JSON(), nullable=True))
        survey.create_foreign_key("fk_survey_calibration_id_calibration", "calibration", ["calibration_id"], ["id"])


def downgrade() -> None:
    with op.batch_alter_table("survey") as survey:
        survey.drop_constraint("fk_survey_calibration_id_calibration", type_="foreignkey")
        survey.drop_column("excluded_s")
        survey.drop_column("calibration_id")
    op.drop_table("calibration")
