"""The database itself refuses to change or remove a row."""

from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

TABLES = (
    "blobs",
    "machines",
    "machine_versions",
    "measurements",
    "measurement_files",
    "claims",
    "attempts",
    "identifications",
    "tables",
    "table_files",
    "decisions",
    "events",
)
FUNCTION = """
CREATE OR REPLACE FUNCTION compgen_append_only() RETURNS trigger AS $$
BEGIN RAISE EXCEPTION 'append-only: % takes new rows only', TG_TABLE_NAME; END
$$ LANGUAGE plpgsql
"""


def upgrade() -> None:
    """Add triggers to every table."""
    postgresql = op.get_bind().dialect.name == "postgresql"
    if postgresql:
        op.execute(FUNCTION)
    for table in TABLES:
        for action in ("UPDATE", "DELETE"):
            name = f"append_only_{table}_{action.lower()}"
            then = "FOR EACH ROW EXECUTE FUNCTION compgen_append_only()"
            if not postgresql:
                then = f"BEGIN SELECT RAISE(ABORT, 'append-only: {table} takes new rows only'); END"
            op.execute(f"CREATE TRIGGER {name} BEFORE {action} ON {table} {then}")
