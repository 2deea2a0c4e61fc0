"""What the dashboard is told at its start."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from compgen.errors import InputError

#: Names under which a browser of this computer reaches the dashboard.
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\]")


@dataclass(frozen=True)
class Settings:
    """How the dashboard runs.

    Parameters
    ----------
    store_url : the store, see :func:`compgen.recal.store.open_store`.
    host, port : where it listens.
    names : further host names under which browsers may call it.
    decide : whether users who are logged in may approve, reject and roll back; otherwise it only reads.
    private : whether reading needs a login too.
    tls : whether a proxy in front of it speaks HTTPS to the browsers.
    users : file of the users; None where nobody can log in.
    job : job file, whose folders and notifications follow the decisions.
    metrics_token : what a reader of ``/metrics`` must show; needed where reading needs a login.
    """

    store_url: str
    host: str = "127.0.0.1"
    port: int = 8765
    names: tuple[str, ...] = ()
    decide: bool = False
    private: bool = False
    tls: bool = False
    users: Path | None = None
    job: Path | None = None
    metrics_token: str | None = None

    @property
    def scheme(self) -> str:
        """How browsers speak to it."""
        return "https" if self.tls else "http"

    @property
    def login(self) -> bool:
        """Whether there is anything to log in for."""
        return self.decide or self.private

    @property
    def host_names(self) -> frozenset[str]:
        """Names that a request may call it by, in lower case."""
        own = () if is_any(self.host) else (f"[{self.host}]" if ":" in self.host else self.host,)
        return frozenset(name.lower() for name in (*LOCAL_NAMES, *own, *self.names))


def is_any(host: str) -> bool:
    """Whether ``host`` stands for every address of this computer."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return host == ""


def is_local(host: str) -> bool:
    """Whether only this computer reaches ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_settings(settings: Settings) -> Settings:
    """Return the settings; InputError where they would send passwords over a network in the clear, or miss something."""
    if settings.login and not is_local(settings.host) and not settings.tls:
        raise InputError(
            f"passwords would go to {settings.host} in the clear; keep --host 127.0.0.1 and put a proxy with HTTPS in "
            "front, then say --behind-tls",
            field="--host",
        )
    if settings.login and settings.users is None:
        raise InputError(
            "needs a file of users; give --users FILE and add one with `volcomp serve add-user`", field="--users"
        )
    for name in settings.names:
        if not HOST_NAME.fullmatch(name):
            raise InputError(f"{name!r} is not a host name; give it without scheme and port", field="--name")
    return settings


def default_users(store_url: str) -> Path | None:
    """Return the file of users that belongs to a store: beside an SQLite file; None for a store on a server."""
    if "://" not in store_url:
        return Path(f"{store_url}.users.json")
    try:
        parsed = sa.make_url(store_url)
    except sa.exc.ArgumentError:
        return None
    if parsed.get_backend_name() != "sqlite" or not parsed.database:
        return None
    return Path(f"{parsed.database}.users.json")
