"""Where pages are served: address, names by which browsers reach them, scheme."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Protocol

#: Host names by which a browser on this computer reaches a server.
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")


class Site(Protocol):
    """What the checks of a request need to know about the server."""

    @property
    def port(self) -> int:
        """Port on which it listens; a cookie of another port has another name."""

    @property
    def tls(self) -> bool:
        """Whether browsers use HTTPS."""

    @property
    def scheme(self) -> str:
        """URL scheme that browsers use."""

    @property
    def host_names(self) -> frozenset[str]:
        """Host names that a request may use, in lower case."""


@dataclass(frozen=True)
class LocalSite:
    """Pages for this computer alone."""

    port: int
    tls: bool = False
    scheme: str = "http"
    host_names: frozenset[str] = frozenset(LOCAL_NAMES)


def is_any(host: str) -> bool:
    """Whether ``host`` means every address of this computer."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return host == ""


def is_local(host: str) -> bool:
    """Whether only this computer can reach ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
