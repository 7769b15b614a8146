"""Keys that end, that are limited to buildings, and that stand for subjects of an identity provider; the audit log.

Revision: 0009, after 0008.
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

TIME = sa.DateTime(timezone=True)
NEW_OF_KEY = (
    ("building_ids", sa.JSON()),
    ("issuer", sa.String(300)),
    ("subject", sa.String(255)),
    ("expires_at", TIME),
    ("last_used_at", TIME),
)


def upgrade() -> None:
    for name, kind in NEW_OF_KEY:
        op.add_column("key", sa.Column(name, kind, nullable=True))
    op.create_table(
        "audit",
        sa.Column("id", sa.String(36), nullable=False),
        sa.Column("organisation_id", sa.String(36), nullable=False),
        sa.Column("at", TIME, nullable=False),
        sa.Column("key_id", sa.String(36), nullable=True),
        sa.Column("actor", sa.String(300), nullable=False),
        sa.Column("action", sa.String(60), nullable=False),
        sa.Column("object_id", sa.String(36), nullable=False),
        sa.Column("outcome", sa.String(20), nullable=False),
        sa.Column("address", sa.String(60), nullable=True),
        sa.Column("request_id", sa.String(128), nullable=True),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_audit"),
        sa.ForeignKeyConstraint(["organisation_id"], ["organisation.id"],
                                name="fk_audit_organisation_id_organisation"),
    )  # fmt: skip
    op.create_index("ix_audit_organisation_id_id", "audit", ["organisation_id", "id"])
    op.create_index("ix_audit_object_id", "audit", ["object_id"])
    op.create_index("ix_audit_at", "audit", ["at"])


def downgrade() -> None:
    op.drop_table("audit")
    for name, _ in reversed(NEW_OF_KEY):
        op.drop_column("key", name)
