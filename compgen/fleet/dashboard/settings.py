"""Settings of the dashboard.

``volcomp serve --help`` loads this module, so libraries are imported where they are used.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from compgen.data.files import read_text
from compgen.data.toml_files import option
from compgen.errors import InputError
from compgen.web.site import LOCAL_NAMES, is_any, is_local

HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\]")


@dataclass(frozen=True)
class DashboardSettings:
    """How the dashboard runs.

    ``store_url`` is the store, see :func:`compgen.fleet.store.open_store`; ``users`` None: nobody can log in.
    """

    store_url: str
    job: Path | None = option(
        None,
        "Job file whose folders and notifications follow decisions, and whose tolerances forecasts use.",
        metavar="FILE",
    )
    host: str = option("127.0.0.1", "Address on which it listens.")
    port: int = option(8765, "Port; 0: any free one.", within=(0, 65535))
    names: tuple[str, ...] = option((), "Additional host name that browsers use.", name="--name", metavar="HOST")
    decide: bool = option(False, "Let users who are logged in approve, reject and roll back.")
    private: bool = option(False, "Reading needs a login too.")
    tls: bool = option(False, "A proxy in front speaks HTTPS; cookies go over HTTPS only.", name="--behind-tls")
    users: Path | None = option(None, "File of the users; default: next to the SQLite store.", metavar="FILE")
    metrics_token: str | None = option(
        None,
        "File with the token that /metrics requires; with --private there is no /metrics without one.",
        name="--metrics-token-file",
        metavar="FILE",
    )

    @property
    def scheme(self) -> str:
        """URL scheme that browsers use."""
        return "https" if self.tls else "http"

    @property
    def login(self) -> bool:
        """Whether anything needs a login."""
        return self.decide or self.private

    @property
    def host_names(self) -> frozenset[str]:
        """Host names that a request may use, in lower case."""
        listens = () if is_any(self.host) else (f"[{self.host}]" if ":" in self.host else self.host,)
        return frozenset(name.lower() for name in (*LOCAL_NAMES, *listens, *self.names))


def check_settings(settings: DashboardSettings) -> DashboardSettings:
    """Return the settings; InputError if they are incomplete or would send unencrypted passwords over a network."""
    if settings.login and not is_local(settings.host) and not settings.tls:
        raise InputError(
            f"passwords would be sent to {settings.host} unencrypted; keep --host 127.0.0.1 and put a proxy with HTTPS in "
            "front, then add --behind-tls",
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


def read_token(path: str | Path) -> str:
    """Return the metrics token from its file; InputError if it could be guessed."""
    token = read_text(path).strip()
    if len(token) < 16 or not token.isascii():
        raise InputError("expected a token of at least 16 ASCII characters", file=path)
    return token


def default_users(store_url: str) -> Path | None:
    """Return the users file of a store: next to an SQLite file; None for a store on a server."""
    from compgen.fleet.database import sqlite_path

    path = sqlite_path(store_url)
    return None if path is None else Path(f"{path}.users.json")
