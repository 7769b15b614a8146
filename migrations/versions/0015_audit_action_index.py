"""The audit log of one action is found by an index.

Revision: 0015, after 0014.
"""

from alembic import op

from migrations.steps import create_index

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_index("ix_audit_organisation_id_action_id", "audit", ["organisation_id", "action", "id"])


def downgrade() -> None:
    op.drop_index("ix_audit_organisation_id_action_id", table_name="audit")
