"""A measurement may be identified again: each time is a revision of its own."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

COLUMNS = (
    "id, machine_id, measurement_id, machine_version_id, active_table_id, errors_sha256, covariance_sha256, "
    "fitted_sha256, summary, program, at"
)
#: What SQLite cannot change in a table that is there: its constraints. Names and order as on PostgreSQL.
TABLE = """
CREATE TABLE identifications (
    id INTEGER NOT NULL,
    machine_id INTEGER NOT NULL,
    measurement_id INTEGER NOT NULL,
    machine_version_id INTEGER NOT NULL,
    active_table_id INTEGER,
    errors_sha256 VARCHAR(64) NOT NULL,
    covariance_sha256 VARCHAR(64),
    fitted_sha256 VARCHAR(64),
    summary JSON NOT NULL,
    program TEXT NOT NULL,
    at DATETIME NOT NULL,
    revision INTEGER DEFAULT 1 NOT NULL,
    FOREIGN KEY(covariance_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(errors_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(fitted_sha256) REFERENCES blobs (sha256),
    FOREIGN KEY(machine_id) REFERENCES machines (id),
    FOREIGN KEY(machine_version_id) REFERENCES machine_versions (id),
    FOREIGN KEY(measurement_id) REFERENCES measurements (id),
    PRIMARY KEY (id),
    UNIQUE (measurement_id, revision)
)
"""
INDEXED = ("machine_id", "machine_version_id", "measurement_id")


def upgrade() -> None:
    """Number the identifications of a measurement."""
    if op.get_bind().dialect.name == "postgresql":
        op.add_column("identifications", sa.Column("revision", sa.Integer(), nullable=False, server_default="1"))
        op.drop_constraint("identifications_measurement_id_key", "identifications", type_="unique")
        op.create_unique_constraint(None, "identifications", ["measurement_id", "revision"])
        return
    op.execute("PRAGMA defer_foreign_keys = ON")  # tables refer to rows that are away for a moment
    op.execute("CREATE TEMPORARY TABLE kept AS SELECT * FROM identifications")
    op.execute("DROP TABLE identifications")
    op.execute(TABLE)
    for column in INDEXED:
        op.create_index(op.f(f"ix_identifications_{column}"), "identifications", [column], unique=False)
    op.execute(f"INSERT INTO identifications ({COLUMNS}) SELECT {COLUMNS} FROM kept ORDER BY id")
    op.execute("DROP TABLE kept")
    for action in ("UPDATE", "DELETE"):
        then = "BEGIN SELECT RAISE(ABORT, 'append-only: identifications takes new rows only'); END"
        op.execute(
            f"CREATE TRIGGER append_only_identifications_{action.lower()} BEFORE {action} ON identifications {then}"
        )
