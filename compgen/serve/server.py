"""Runs the dashboard until it is told to stop."""

from __future__ import annotations

import logging
import signal
from types import FrameType
from typing import Any

from compgen.errors import InputError
from compgen.recal import logs
from compgen.serve.app import make_app
from compgen.serve.settings import Settings

THREADS, LARGEST_BODY, LARGEST_HEADERS = 8, 65_536, 65_536
#: Connections at the same time; so many that patient ones do not keep others out, see :mod:`compgen.serve.patience`.
CONNECTIONS = 1000
#: Bytes of an answer that may wait for a slow reader, so that none keeps a thread.
WAITING_BYTES = 2**30


def make_server(settings: Settings) -> Any:
    """Return a server that listens; InputError if the address cannot be used."""
    import waitress  # type: ignore[import-untyped]  # shipped without type information

    from compgen.serve.patience import bounded

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


def run(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT; requests that are being answered are finished."""
    server = make_server(settings)
    _log_server()
    signal.signal(signal.SIGTERM, _stop)
    logs.info("serving", address=_address(server), decide=settings.decide)
    try:
        server.run()
    finally:
        server.close()
        logs.info("stopped serving")


def _address(server: Any) -> str:
    """Return the first address on which it listens."""
    host, port = getattr(server, "effective_listen", [(None, None)])[0]
    host, port = (server.effective_host, server.effective_port) if host is None else (host, port)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


class _Logged(logging.Handler):
    """Puts what the server library says into our logs, so that all lines have one form."""

    def emit(self, record: logging.LogRecord) -> None:
        """Log one message."""
        logs.warning("server", problem=record.getMessage())


def _log_server() -> None:
    logger = logging.getLogger("waitress")
    logger.setLevel(logging.WARNING)
    logger.propagate = False
    logger.handlers = [_Logged()]


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)
