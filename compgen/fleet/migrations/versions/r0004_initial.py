"""The store as the first released version makes it: all tables, and triggers that refuse to change or remove a row.

As long as no version has been released there is this one revision; its number is that of the stores which exist.
"""

import sqlalchemy as sa
from alembic import op

from compgen.fleet.database import ALL, metadata

revision = "0004"
down_revision = None
branch_labels = None
depends_on = None

REFUSE = """
CREATE OR REPLACE FUNCTION compgen_append_only() RETURNS trigger AS $$
BEGIN RAISE EXCEPTION 'append-only: % takes new rows only', TG_TABLE_NAME; END
$$ LANGUAGE plpgsql
"""


def upgrade() -> None:
    """Make the tables and their triggers."""
    connection = op.get_bind()
    metadata.create_all(connection)
    if connection.dialect.name == "postgresql":
        op.execute(REFUSE)
        for table in ALL:
            for action, each in (("UPDATE", "ROW"), ("DELETE", "ROW"), ("TRUNCATE", "STATEMENT")):
                _trigger(table, action, action, f"FOR EACH {each} EXECUTE FUNCTION compgen_append_only()")
        return
    for table in ALL:
        then = f"BEGIN SELECT RAISE(ABORT, 'append-only: {table.name} takes new rows only'); END"
        for action in ("UPDATE", "DELETE"):
            _trigger(table, action, action, then)
        # INSERT OR REPLACE removes a row without asking the trigger above
        there = " OR ".join(f"EXISTS (SELECT 1 FROM {table.name} WHERE {key})" for key in _keys(table))
        _trigger(table, "REPLACE", "INSERT", f"WHEN {there} {then}")


def _trigger(table: sa.Table, name: str, action: str, then: str) -> None:
    op.execute(f"CREATE TRIGGER append_only_{table.name}_{name.lower()} BEFORE {action} ON {table.name} {then}")


def _keys(table: sa.Table) -> list[str]:
    """Conditions under which a new row has the key of one that is there."""
    unique = [item for item in table.constraints if isinstance(item, sa.UniqueConstraint)]
    return [" AND ".join(f"{c.name} = NEW.{c.name}" for c in item.columns) for item in (*unique, table.primary_key)]
