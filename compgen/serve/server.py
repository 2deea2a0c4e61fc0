"""Runs the dashboard until it is told to stop."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

from compgen.errors import InputError
from compgen.recal import logs
from compgen.serve.app import make_app
from compgen.serve.settings import Settings

THREADS, LARGEST_BODY = 8, 65_536


def make_server(settings: Settings) -> Any:
    """Return a server that listens; InputError if the address cannot be used."""
    import waitress  # type: ignore[import-untyped]  # shipped without type information

    app = make_app(settings)
    try:
        return waitress.create_server(
            app,
            host=settings.host,
            port=settings.port,
            threads=THREADS,
            ident=None,
            max_request_body_size=LARGEST_BODY,
            channel_timeout=60,
            url_scheme=settings.scheme,
        )
    except OSError as error:
        place = f"{settings.host}:{settings.port}"
        raise InputError(f"{place} cannot be used: {error.strerror or error}", field="--port") from error


def run(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT; requests that are being answered are finished."""
    server = make_server(settings)
    signal.signal(signal.SIGTERM, _stop)
    logs.info("serving", address=f"http://{server.effective_host}:{server.effective_port}/", decide=settings.decide)
    try:
        server.run()
    finally:
        server.close()
        logs.info("stopped serving")


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)
