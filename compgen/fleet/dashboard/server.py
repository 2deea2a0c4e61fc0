"""The HTTP server of the dashboard; clients that send a request byte by byte do not block others (slow loris)."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable
from copy import copy
from types import FrameType
from typing import Any

from waitress.channel import HTTPChannel  # type: ignore[import-untyped]  # shipped without type information
from waitress.parser import HTTPRequestParser  # type: ignore[import-untyped]

from compgen.errors import InputError
from compgen.fleet import logs
from compgen.fleet.dashboard.settings import DashboardSettings

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


THREADS, LARGEST_BODY, LARGEST_HEADERS = 8, 65_536, 65_536
#: Largest number of connections; so many that slow ones do not block others.
CONNECTIONS = 1000
#: Bytes of a response that may wait for a slow reader: none occupies a thread.
WAITING_BYTES = 2**30


def make_server(settings: DashboardSettings) -> Any:
    """Return a listening server; InputError if the address cannot be used."""
    import waitress  # type: ignore[import-untyped]  # shipped without type information

    from compgen.fleet.dashboard.app import make_app

    app = make_app(settings)
    try:
        server = waitress.create_server(
            app,
            host=settings.host,
            port=settings.port,
            threads=THREADS,
            ident=None,
            max_request_body_size=LARGEST_BODY,
            max_request_header_size=LARGEST_HEADERS,
            connection_limit=CONNECTIONS,
            asyncore_use_poll=True,
            outbuf_high_watermark=WAITING_BYTES,
            channel_timeout=60,
            url_scheme=settings.scheme,
        )
    except OSError as error:
        place = f"{settings.host}:{settings.port}"
        raise InputError(f"{place} cannot be used: {error.strerror or error}", field="--port") from error
    return bounded(server)


def run(settings: DashboardSettings) -> None:
    """Serve until SIGTERM or SIGINT; requests in progress are completed."""
    server = make_server(settings)
    logger = logging.getLogger("waitress")
    logger.setLevel(logging.WARNING)
    logger.propagate = False
    logger.handlers = [_Logged()]
    signal.signal(signal.SIGTERM, _stop)
    host, port = getattr(server, "effective_listen", [(None, None)])[0]  # the first of several
    host, port = (server.effective_host, server.effective_port) if host is None else (host, port)
    address = f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
    logs.info("serving", address=address, decide=settings.decide)
    try:
        server.run()
    finally:
        server.close()
        logs.info("stopped serving")


class _Logged(logging.Handler):
    """Write the server library's messages to our logs: all lines have the same form."""

    def emit(self, record: logging.LogRecord) -> None:
        """Log one message."""
        logs.warning("server", problem=record.getMessage())


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)
