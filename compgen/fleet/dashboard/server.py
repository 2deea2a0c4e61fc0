"""The HTTP server of the dashboard."""

from __future__ import annotations

import logging
import signal
from types import FrameType
from typing import Any

from compgen.errors import InputError
from compgen.fleet import logs
from compgen.fleet.dashboard.settings import DashboardSettings
from compgen.web.connections import LARGEST_BODY, bounded

#: Bytes of the headers of a request.
LARGEST_HEADERS = 65_536
THREADS = 8
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
