"""Structured logs on stderr: one JSON object per line, or words on a terminal."""

from __future__ import annotations

import sys
from typing import Any, Literal

import structlog

from compgen.errors import visible

Format = Literal["auto", "json", "text"]
_FORM: list[Format] = []


class _Stderr:
    """Writes to the current stderr."""

    def msg(self, text: str) -> None:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()

    info = warning = error = msg


def configure(kind: Format = "auto") -> None:
    """Choose the form of the logs; "auto" gives words on a terminal and JSON elsewhere."""
    _FORM[:] = [kind]
    words = kind == "text" or (kind == "auto" and sys.stderr.isatty())
    last: Any = (
        structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()) if words else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *([_visible] if words else []),
            last,
        ],
        logger_factory=lambda *_: _Stderr(),
        cache_logger_on_first_use=False,
    )


def _visible(_logger: object, _name: str, fields: Any) -> Any:
    """Show control characters as escapes; JSON already does."""
    return {key: visible(value, flat=True) if isinstance(value, str) else value for key, value in fields.items()}


def form() -> Format:
    """Return the chosen form, for a process that writes to the same place."""
    return _FORM[0] if _FORM else "auto"


def _logger() -> Any:
    if not structlog.is_configured():
        configure()
    return structlog.get_logger()


def info(event: str, **fields: Any) -> None:
    """Log what was done."""
    _logger().info(event, **fields)


def warning(event: str, **fields: Any) -> None:
    """Log what needs attention."""
    _logger().warning(event, **fields)


def error(event: str, **fields: Any) -> None:
    """Log what went wrong."""
    _logger().error(event, **fields)
