"""Tables of the store; rows are only ever added (triggers refuse a change), the state follows from the last ones.

Times are UTC. Contents of files stand compressed in ``blobs`` by their SHA-256, each once.
"""

from __future__ import annotations

from datetime import UTC, datetime

import sqlalchemy as sa

#: Newest revision of ``migrations/versions``.
HEAD = "0004"


class UtcTime(sa.types.TypeDecorator[datetime]):
    """A time with zone UTC in the program, without a zone in the database."""

    impl = sa.DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: sa.engine.Dialect) -> datetime | None:
        """Turn into UTC; a time without a zone is an error of the program."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("a time without a zone")
        return value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: sa.engine.Dialect) -> datetime | None:
        """Give the zone back."""
        return None if value is None else value.replace(tzinfo=UTC)


class PlainText(sa.types.TypeDecorator[str]):
    """Text that every database takes: PostgreSQL refuses a NUL, and none takes the rest of a name that is not UTF-8."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: sa.engine.Dialect) -> str | None:
        """Escape what cannot be kept."""
        return None if value is None else plain(value)


def plain(text: str) -> str:
    """Return the text with NUL and lone surrogates as escapes."""
    return text.replace("\0", "\\x00").encode("utf-8", "backslashreplace").decode("utf-8")


metadata = sa.MetaData()


def _id() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True, autoincrement=True)


def _of(table: str, *, optional: bool = False) -> sa.Column[int]:
    name = {"machines": "machine_id", "machine_versions": "machine_version_id"}.get(table, f"{table[:-1]}_id")
    return sa.Column(name, sa.Integer, sa.ForeignKey(f"{table}.id"), nullable=optional, index=True)


def _at(name: str = "at") -> sa.Column[datetime]:
    return sa.Column(name, UtcTime, nullable=False)


def _text(name: str, *, optional: bool = False) -> sa.Column[str]:
    return sa.Column(name, PlainText, nullable=optional)


def _json(name: str) -> sa.Column[object]:
    return sa.Column(name, sa.JSON, nullable=False)


blobs = sa.Table(
    "blobs",
    metadata,
    sa.Column("sha256", sa.String(64), primary_key=True),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("deflated", sa.LargeBinary, nullable=False),
)
machines = sa.Table("machines", metadata, _id(), sa.Column("name", sa.String(200), nullable=False, unique=True), _at())
machine_versions = sa.Table(
    "machine_versions",
    metadata,
    _id(),
    _of("machines"),
    sa.Column("sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False),
    _at(),
    sa.UniqueConstraint("machine_id", "sha256"),
)
measurements = sa.Table(
    "measurements",
    metadata,
    _id(),
    _of("machines"),
    sa.Column("sha256", sa.String(64), nullable=False),
    _text("name"),
    _at("measured_at"),
    _text("measured_at_source"),
    _at("received_at"),
    _text("active_table", optional=True),
    _json("temperatures_c"),
    sa.UniqueConstraint("machine_id", "sha256"),
)
measurement_files = sa.Table(
    "measurement_files",
    metadata,
    _id(),
    _of("measurements"),
    _text("name"),
    sa.Column("sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False),
)
claims = sa.Table(
    "claims",
    metadata,
    _id(),
    _of("measurements"),
    sa.Column("sequence", sa.Integer, nullable=False),
    _text("kind"),  # take, renew, release
    _text("owner"),
    _at(),
    _at("until"),
    sa.UniqueConstraint("measurement_id", "sequence"),
)
attempts = sa.Table(
    "attempts",
    metadata,
    _id(),
    _of("machines"),
    _of("measurements"),
    _text("outcome"),  # done, failed
    _text("message"),
    sa.Column("settings_sha256", sa.String(64), nullable=False),
    _text("owner"),
    sa.Column("seconds", sa.Float, nullable=False),
    _at(),
)
identifications = sa.Table(
    "identifications",
    metadata,
    _id(),
    _of("machines"),
    _of("measurements"),
    _of("machine_versions"),
    sa.Column("active_table_id", sa.Integer, nullable=True),  # of tables, which refer to this table in turn
    sa.Column("errors_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False),
    sa.Column("covariance_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=True),
    sa.Column("fitted_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=True),
    _json("summary"),
    _text("program"),
    _at(),
    sa.Column("revision", sa.Integer, nullable=False, server_default="1"),  # counts how often it was identified
    sa.UniqueConstraint("measurement_id", "revision"),
)
tables = sa.Table(
    "tables",
    metadata,
    _id(),
    _of("machines"),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("identification_id", sa.Integer, sa.ForeignKey("identifications.id"), nullable=False, index=True),
    sa.Column("accepted", sa.Boolean, nullable=False),
    _json("controllers"),
    _json("reasons"),
    _json("summary"),
    _at(),
    sa.UniqueConstraint("machine_id", "version"),
)
table_files = sa.Table(
    "table_files",
    metadata,
    _id(),
    _of("tables"),
    _text("controller"),
    _text("name"),
    sa.Column("sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False),
)
decisions = sa.Table(
    "decisions",
    metadata,
    _id(),
    _of("machines"),
    sa.Column("sequence", sa.Integer, nullable=False),
    _of("tables", optional=True),
    _text("kind"),
    _text("actor"),
    _text("reason"),
    _at(),
    sa.UniqueConstraint("machine_id", "sequence"),
)
events = sa.Table(
    "events",
    metadata,
    _id(),
    _of("machines", optional=True),
    _text("kind"),
    _text("subject"),
    _text("message"),
    _at(),
)

#: Every table in an order in which none refers to a later one.
ALL = (
    blobs,
    machines,
    machine_versions,
    measurements,
    measurement_files,
    claims,
    attempts,
    identifications,
    tables,
    table_files,
    decisions,
    events,
)
