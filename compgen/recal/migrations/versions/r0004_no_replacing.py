"""Two ways round the triggers that refuse changes are closed: TRUNCATE on PostgreSQL, INSERT OR REPLACE on SQLite."""

from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

#: Tables and what is unique in each, beside its id.
UNIQUE = {
    "blobs": ("sha256",),
    "machines": ("name",),
    "machine_versions": ("machine_id", "sha256"),
    "measurements": ("machine_id", "sha256"),
    "measurement_files": (),
    "claims": ("measurement_id", "sequence"),
    "attempts": (),
    "identifications": ("measurement_id", "revision"),
    "tables": ("machine_id", "version"),
    "table_files": (),
    "decisions": ("machine_id", "sequence"),
    "events": (),
}


def upgrade() -> None:
    """Add a trigger to every table."""
    postgresql = op.get_bind().dialect.name == "postgresql"
    for table, columns in UNIQUE.items():
        if postgresql:
            then = "FOR EACH STATEMENT EXECUTE FUNCTION compgen_append_only()"
            op.execute(f"CREATE TRIGGER append_only_{table}_truncate BEFORE TRUNCATE ON {table} {then}")
            continue
        keys = [" AND ".join(f"{column} = NEW.{column}" for column in columns)] if columns else []
        keys += [] if table == "blobs" else ["id = NEW.id"]
        there = " OR ".join(f"EXISTS (SELECT 1 FROM {table} WHERE {key})" for key in keys)
        then = f"BEGIN SELECT RAISE(ABORT, 'append-only: {table} takes new rows only'); END"
        op.execute(f"CREATE TRIGGER append_only_{table}_replace BEFORE INSERT ON {table} WHEN {there} {then}")
