"""The database below the store: schema, connections, upgrades, contents of files by SHA-256.

Rows are only added (triggers refuse a change); the state follows from the last rows. Times are UTC. File contents are
kept compressed in ``blobs`` by their SHA-256, each once. The store is an SQLite file, or PostgreSQL by URL; an old
store is upgraded when it is opened.
"""

from __future__ import annotations

import os
import secrets
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.dialects import postgresql, sqlite

from compgen.data.files import sha256_of
from compgen.errors import CompgenError, InputError

#: Newest revision of ``migrations/versions``.
HEAD = "0004"
#: First revision that a released version writes; the program cannot read older ones.
INITIAL = "0004"


class UtcTime(sa.types.TypeDecorator[datetime]):
    """A time with time zone UTC in the program, without a time zone in the database."""

    impl = sa.DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: sa.engine.Dialect) -> datetime | None:
        """Convert to UTC; a time without a time zone is a programming error."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("a time without a zone")
        return value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: sa.engine.Dialect) -> datetime | None:
        """Restore the time zone."""
        return None if value is None else value.replace(tzinfo=UTC)


class PlainText(sa.types.TypeDecorator[str]):
    """Text for every database: PostgreSQL refuses NUL, and none accepts the lone surrogates of non-UTF-8 names."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: sa.engine.Dialect) -> str | None:
        """Escape what cannot be stored."""
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


def _contents() -> sa.Column[str]:
    """The file that a row names, by the SHA-256 of its bytes."""
    return sa.Column("sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False)


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
    _contents(),
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
    _contents(),
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
    sa.Column("active_table_id", sa.Integer, nullable=True),  # id in tables, which in turn refers to this table
    sa.Column("errors_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=False),
    sa.Column("covariance_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=True),
    sa.Column("fitted_sha256", sa.String(64), sa.ForeignKey("blobs.sha256"), nullable=True),
    _json("summary"),
    _text("program"),
    _at(),
    sa.Column("revision", sa.Integer, nullable=False, server_default=sa.text("1")),  # number of its identification
    sa.UniqueConstraint("measurement_id", "revision"),
)
#: Class of the prior of an identification; those of earlier programs have none.
PRIOR_CLASS = identifications.c.summary[("prior", "class")].as_string().label("prior_class")
NO_PRIOR = (None, "none")
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
    _contents(),
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

#: Every table; none refers to a later one in this order.
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


# --- connections ---------------------------------------------------------------------------------------------------

Result = TypeVar("Result")

#: Waits between attempts to reach the store, s.
WAITS_S = (0.2, 0.5, 1.0, 2.0)
#: How long a writer waits for another one, s; after waiting that long for a lock it does not try again.
BUSY_S = 60.0
#: Time limits that detect a server that does not answer: for connecting, and for an answer on a broken connection, s.
REACHABLE = {
    "connect_timeout": 10,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 60_000,  # ms
}
#: Key of the lock under which PostgreSQL stores are upgraded.
UPGRADE_LOCK = 7305211


#: Errors that waiting does not cure: a wrong name or password, a full disk, a damaged file.
LASTING = ("authentication", "does not exist", "no such table", "no such column", "disk is full", "readonly")


class StoreError(CompgenError):
    """The store cannot be reached or is not a store; nothing was changed."""


def engine_of(url: str) -> sa.Engine:
    """Return an engine for a URL or the path of an SQLite file; InputError for an unsupported kind.

    A process has one engine for each store; its compiled statements are kept after its connections are closed.
    """
    try:
        parsed = sa.make_url(url if "://" in url else f"sqlite:///{url}")
    except sa.exc.ArgumentError as error:
        raise InputError(f"{url!r} is not the URL of a store; give sqlite:///FILE or postgresql://HOST/NAME") from error
    kind = parsed.get_backend_name()
    if kind == "postgresql":
        return _postgresql(parsed, os.getpid())
    if kind != "sqlite" or not parsed.database or parsed.database == ":memory:":
        raise InputError(f"{shown(url)} is not a store; give sqlite:///FILE or postgresql://HOST/NAME")
    folder = Path(parsed.database).absolute().parent
    if not folder.is_dir():  # not created here: if a drive is not mounted, this would start a new, empty store
        raise StoreError(f"the store {shown(url)} cannot be used: no such folder: {folder}; mount or create it first")
    path = folder / Path(parsed.database).name
    for pause in (
        *WAITS_S,
        None,
    ):  # an empty file: a store lost its contents; one that is being made has some in a moment
        try:
            if path.stat().st_size > 0:
                break
        except OSError:  # not there yet, or the database reports what is wrong
            break
        if pause is not None:
            time.sleep(pause)
    else:
        raise StoreError(
            f"the store {shown(url)} is damaged: the file is empty (0 bytes); restore a backup, or remove the file if it "
            "never contained data"
        )
    return _sqlite(parsed.set(database=str(path)), os.getpid())


def sqlite_path(url: str) -> str | None:
    """Return the path of the file of an SQLite store; None for a store on a server, or text that is not a URL."""
    if "://" not in url:
        return url
    try:
        parsed = sa.make_url(url)
    except sa.exc.ArgumentError:
        return None
    return parsed.database or None if parsed.get_backend_name() == "sqlite" else None


@lru_cache(maxsize=8)
def _sqlite(url: sa.URL, _process: int) -> sa.Engine:
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_S}, poolclass=sa.pool.QueuePool, pool_size=2)

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # transactions begin below
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
            connection.execute(f"PRAGMA {pragma}").close()

    @event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        """Writers take the lock at once; none has to give up half way."""
        reading = connection.get_execution_options().get("reading", False)
        connection.exec_driver_sql("BEGIN" if reading else "BEGIN IMMEDIATE")

    return engine


@lru_cache(maxsize=8)
def _postgresql(url: sa.URL, _process: int) -> sa.Engine:
    """One connection for the work and one for renewing leases; options in the URL take precedence."""
    arguments = {name: value for name, value in REACHABLE.items() if name not in url.query}
    url = url.set(drivername="postgresql+psycopg")
    engine = sa.create_engine(url, connect_args=arguments, pool_pre_ping=True, pool_size=2)

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: object) -> None:
        """Wait for somebody else's lock as long as with SQLite, not for ever."""
        connection.execute(f"SET lock_timeout = {int(BUSY_S * 1000)}")
        connection.commit()

    return engine


def shown(url: str) -> str:
    """Return the URL without its password."""
    try:
        return sa.make_url(url).render_as_string(hide_password=True) if "://" in url else url
    except sa.exc.ArgumentError:
        return "the given URL"


def retried(action: Callable[[], Result], url: str, wait: Callable[[float], None] = time.sleep) -> Result:
    """Repeat ``action`` while the store cannot be reached, then raise StoreError."""
    for pause in (*WAITS_S, None):
        started = time.monotonic()
        try:
            return action()
        except sa.exc.IntegrityError:
            raise
        except UnicodeDecodeError as error:  # SQLite's message contains some of the damaged bytes
            raise StoreError(f"the store {shown(url)} is damaged: {error}; restore a backup") from error
        except (sa.exc.DBAPIError, sa.exc.TimeoutError) as error:
            waited = time.monotonic() - started >= BUSY_S
            may_pass = isinstance(error, sa.exc.OperationalError | sa.exc.InterfaceError)
            if pause is None or waited or not may_pass or any(word in str(error).lower() for word in LASTING):
                raise StoreError(f"the store {shown(url)} cannot be used: {first_line(error)}") from error
            wait(pause)
    raise AssertionError("unreachable")


def first_line(error: Exception) -> str:
    """Return the database's message without the statement."""
    lines = str(getattr(error, "orig", error)).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def upgrade(engine: sa.Engine) -> int:
    """Bring the schema to :data:`HEAD`; InputError for a store that a newer program made.

    Returns
    -------
    The unique number of an SQLite store's file, by which a replaced file is noticed; 0 for other stores.
    """
    with engine.connect().execution_options(reading=True) as connection:
        number = _number(connection)
        if _revision(connection) == HEAD and number is not None:
            return number
    with engine.begin() as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(UPGRADE_LOCK)))
        if _revision(connection) != HEAD:
            from alembic import command  # imported late: needed only for a new or old store
            from alembic.config import Config

            config = Config()
            config.set_main_option("script_location", str(Path(__file__).with_name("migrations")))
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
        number = _number(connection)
        if number is None:
            number = 1 + secrets.randbelow(2**31 - 1)
            connection.exec_driver_sql(f"PRAGMA user_version = {number}")
    return number


def _number(connection: sa.Connection) -> int | None:
    """Return the number of the file; None if it has none yet, 0 if the store is not a file."""
    if connection.dialect.name != "sqlite":
        return 0
    return int(connection.exec_driver_sql("PRAGMA user_version").scalar() or 0) or None


def _revision(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    found = connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar()
    if found is not None and str(found) > HEAD:
        raise InputError(f"the store was written by a newer compgen (schema {found}, this one knows {HEAD}); update")
    if found is not None and str(found) < INITIAL:
        raise InputError(
            f"the store has schema {found}, which only unreleased versions of compgen wrote; start a new one"
        )
    return None if found is None else str(found)


def inserted(connection: sa.Connection, table: sa.Table, values: Mapping[str, Any]) -> int:
    """Add a row to a table with numbered rows, and return its number."""
    key = connection.execute(sa.insert(table), dict(values)).inserted_primary_key
    assert key is not None
    return int(key[0])


#: zlib's level for contents: 6 would need twice the time for 6 % less space.
LEVEL = 4
_KNOWN = sa.select(blobs.c.sha256).where(blobs.c.sha256.in_(sa.bindparam("digests", expanding=True)))
#: By dialect; another process may add the same contents meanwhile.
_PUT = {kind.__name__.rpartition(".")[2]: kind.insert(blobs).on_conflict_do_nothing() for kind in (postgresql, sqlite)}


def put_blobs(connection: sa.Connection, contents: Iterable[bytes]) -> list[str]:
    """Store contents that are not there yet, and return the SHA-256 of each."""
    named = [(sha256_of(content), content) for content in contents]
    new = dict(named)
    for known in connection.execute(_KNOWN, {"digests": list(new)}).scalars():
        del new[known]
    if new:
        rows = [
            {"sha256": digest, "size": len(content), "deflated": zlib.compress(content, LEVEL)}
            for digest, content in new.items()
        ]
        connection.execute(_PUT[connection.dialect.name], rows)
    return [digest for digest, _ in named]
