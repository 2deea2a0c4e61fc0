"""Connections of a server whose clients may send a request byte by byte and do not block others (slow loris)."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from typing import Any

from waitress.channel import HTTPChannel  # type: ignore[import-untyped]  # shipped without type information
from waitress.parser import HTTPRequestParser  # type: ignore[import-untyped]

#: Bytes of a request that needs no upload.
LARGEST_BODY = 65_536
#: A request must be complete within this time after its first byte, s.
REQUEST_S = 20.0
#: At the limit of connections, those without a request end after this time, s.
CROWDED_S = 2.0


class TimedChannel(HTTPChannel):  # type: ignore[misc]
    """A connection that ends when its request takes too long; checked by the server's loop about once a second."""

    began: float | None = None

    def readable(self) -> bool:
        """Return whether more may be read; note when a request began, and end a request that takes too long."""
        now = time.time()
        if self.request is None or self.requests:
            self.began = None
        elif self.began is None:
            self.began = now
        if not self.requests and not self.total_outbufs_len:
            crowded = self.server.in_connection_overflow
            since = self.last_activity if self.began is None else self.began
            if now - since > (CROWDED_S if crowded else REQUEST_S if self.began is not None else float("inf")):
                self.will_close = True
                return False
        return bool(super().readable())


def bounded(server: Any, channel: type[TimedChannel] = TimedChannel) -> Any:
    """Return the server with connections that have a time limit."""
    for each in [*getattr(server, "map", {}).values(), server]:
        if hasattr(each, "channel_class"):
            each.channel_class = channel
    return server


def small_for(stranger: Callable[[str], bool], most_bytes: int) -> type[TimedChannel]:
    """Return connections on which a request with cookies of a ``stranger`` has at most ``most_bytes``.

    A body is kept on the disk before the application sees the request, so a limit of the application comes too late.
    """

    class Parser(HTTPRequestParser):  # type: ignore[misc]
        adj: Any

        def parse_header(self, header_plus: bytes) -> None:
            super().parse_header(header_plus)
            if stranger(str(self.headers.get("COOKIE", ""))):
                self.adj = copy(self.adj)
                self.adj.max_request_body_size = most_bytes

    class Channel(TimedChannel):
        parser_class = Parser

    return Channel
