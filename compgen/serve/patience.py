"""How long the server waits for a request: whoever sends it byte by byte must not keep others out (slow loris)."""

from __future__ import annotations

import time
from typing import Any

from waitress.channel import HTTPChannel  # type: ignore[import-untyped]  # shipped without type information

#: A request must be complete this long after its first byte, s.
REQUEST_S = 20.0
#: While the connections are at their limit, those without a request end after this time, s.
CROWDED_S = 2.0


class Channel(HTTPChannel):  # type: ignore[misc]
    """A connection that ends when its request takes too long; asked by the server's loop about once a second."""

    began: float | None = None

    def readable(self) -> bool:
        """Say whether more may be read; note when a request began, and end what takes too long."""
        now = time.time()
        if self.request is None or self.requests:
            self.began = None
        elif self.began is None:
            self.began = now
        if self._too_long(now):
            self.will_close = True
            return False
        return bool(super().readable())

    def _too_long(self, now: float) -> bool:
        if self.requests or self.total_outbufs_len:
            return False
        crowded = self.server.in_connection_overflow
        since = self.last_activity if self.began is None else self.began
        return now - since > (CROWDED_S if crowded else REQUEST_S if self.began is not None else float("inf"))


def bounded(server: Any) -> Any:
    """Return the server with connections that end in time."""
    for each in [*getattr(server, "map", {}).values(), server]:
        if hasattr(each, "channel_class"):
            each.channel_class = Channel
    return server
