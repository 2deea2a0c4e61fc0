"""Connections to the store: SQLite by default, PostgreSQL by URL; old stores are upgraded as they are opened."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy import event

from compgen.errors import CompgenError, InputError
from compgen.recal.schema import HEAD

Result = TypeVar("Result")

#: Waits between attempts to reach the store, s.
WAITS_S = (0.2, 0.5, 1.0, 2.0)
#: How long a writer waits for another one, s; who waited that long for a lock does not try again.
BUSY_S = 60.0
#: A server that does not answer is noticed: waits for a connection, and for an answer on one that broke, s.
REACHABLE = {
    "connect_timeout": 10,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 60_000,  # ms
}
#: Key of the lock under which PostgreSQL stores are upgraded.
UPGRADE_LOCK = 7305211


class StoreError(CompgenError):
    """The store cannot be reached, or is not one; nothing was changed."""


def engine_of(url: str) -> sa.Engine:
    """Return an engine for a URL or the path of an SQLite file; InputError for a kind that is not served.

    A process has one for each store, which keeps its compiled statements when its connections are given back.
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
    if not folder.is_dir():  # not made here: on a drive that is not mounted a new, empty store would begin
        raise StoreError(f"the store {shown(url)} cannot be used: there is no folder {folder}; mount or make it first")
    path = folder / Path(parsed.database).name
    _refuse_empty(path, url)
    return _sqlite(parsed.set(database=str(path)), os.getpid())


def _refuse_empty(path: Path, url: str) -> None:
    """Raise StoreError for a file without contents: a store lost them; one that is being made has some in a moment."""
    for pause in (*WAITS_S, None):
        try:
            if path.stat().st_size > 0:
                return
        except OSError:
            return  # not there yet, or the database says what is wrong
        if pause is not None:
            time.sleep(pause)
    raise StoreError(
        f"the store {shown(url)} is damaged: the file is empty (0 bytes); restore a backup, or remove the file if there "
        "never was anything in it"
    )


@lru_cache(maxsize=8)
def _sqlite(url: sa.URL, _process: int) -> sa.Engine:
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_S}, poolclass=sa.pool.QueuePool, pool_size=2)
    event.listen(engine, "connect", _configure_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


@lru_cache(maxsize=8)
def _postgresql(url: sa.URL, _process: int) -> sa.Engine:
    """One connection for the work and one for the renewal of leases; what the URL says itself counts."""
    arguments = {name: value for name, value in REACHABLE.items() if name not in url.query}
    url = url.set(drivername="postgresql+psycopg")
    engine = sa.create_engine(url, connect_args=arguments, pool_pre_ping=True, pool_size=2)
    event.listen(engine, "connect", _configure_postgresql)
    return engine


def shown(url: str) -> str:
    """Return the URL without its password."""
    try:
        return sa.make_url(url).render_as_string(hide_password=True) if "://" in url else url
    except sa.exc.ArgumentError:
        return "the given URL"


def _configure_sqlite(connection: Any, _record: object) -> None:
    """Write-ahead log, full synchronisation, foreign keys; transactions are begun by :func:`_begin_sqlite`."""
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode = WAL")
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _configure_postgresql(connection: Any, _record: object) -> None:
    """Wait for a lock of somebody else as long as on SQLite, not for ever."""
    connection.execute(f"SET lock_timeout = {int(BUSY_S * 1000)}")
    connection.commit()


def _begin_sqlite(connection: sa.Connection) -> None:
    """Writers take the lock at once, so that none has to give up half way."""
    reading = connection.get_execution_options().get("reading", False)
    connection.exec_driver_sql("BEGIN" if reading else "BEGIN IMMEDIATE")


def retried(action: Callable[[], Result], url: str, wait: Callable[[float], None] = time.sleep) -> Result:
    """Do ``action`` again while the store cannot be reached, then raise StoreError."""
    for pause in (*WAITS_S, None):
        started = time.monotonic()
        try:
            return action()
        except sa.exc.IntegrityError:
            raise
        except UnicodeDecodeError as error:  # SQLite shows a piece of the damage in its message
            raise StoreError(f"the store {shown(url)} is damaged: {error}; restore a backup") from error
        except (sa.exc.DBAPIError, sa.exc.TimeoutError) as error:
            waited = time.monotonic() - started >= BUSY_S
            if pause is None or waited or not _may_pass(error):
                raise StoreError(f"the store {shown(url)} cannot be used: {first_line(error)}") from error
            wait(pause)
    raise AssertionError("unreachable")


def first_line(error: Exception) -> str:
    """Return what the database says, without the statement."""
    lines = str(getattr(error, "orig", error)).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _may_pass(error: sa.exc.SQLAlchemyError) -> bool:
    """Whether waiting may help: not for a wrong name, password, a full disk or a damaged file."""
    if not isinstance(error, sa.exc.OperationalError | sa.exc.InterfaceError):
        return False
    text = str(error).lower()
    lasting = ("authentication", "does not exist", "no such table", "no such column", "disk is full", "readonly")
    return not any(word in text for word in lasting)


def upgrade(engine: sa.Engine) -> int:
    """Bring the schema to :data:`HEAD`; InputError for a store that a newer program made.

    Returns
    -------
    The number that the file of an SQLite store has alone, so that another file in its place is noticed; else 0.
    """
    with engine.connect().execution_options(reading=True) as connection:
        number = _number(connection)
        if _revision(connection) == HEAD and number is not None:
            return number
    with engine.begin() as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(UPGRADE_LOCK)))
        if _revision(connection) != HEAD:
            _migrate(connection)
        number = _number(connection)
        if number is None:
            number = 1 + secrets.randbelow(2**31 - 1)
            connection.exec_driver_sql(f"PRAGMA user_version = {number}")
    return number


def _number(connection: sa.Connection) -> int | None:
    """Return the number of the file, None where it has none yet, 0 where the store is not a file."""
    if connection.dialect.name != "sqlite":
        return 0
    return int(connection.exec_driver_sql("PRAGMA user_version").scalar() or 0) or None


def _revision(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    found = connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar()
    if found is not None and str(found) > HEAD:
        raise InputError(f"the store was written by a newer compgen (schema {found}, this one knows {HEAD}); update")
    return None if found is None else str(found)


def _migrate(connection: sa.Connection) -> None:
    from alembic import command  # late: only a store that is new or old needs it
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).with_name("migrations")))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
