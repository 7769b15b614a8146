"""The audit log of one actor is found by an index.

Revision: 0014, after 0013.
"""

from alembic import op

from migrations.steps import create_index

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_index("ix_audit_organisation_id_key_id_id", "audit", ["organisation_id", "key_id", "id"])


def downgrade() -> None:
    op.drop_index("ix_audit_organisation_id_key_id_id", table_name="audit")
