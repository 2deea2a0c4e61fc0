"""The few exceptions of compgen; each carries the data that a caller needs to react."""

from __future__ import annotations

from pathlib import Path

from compgen.core.text import visible


class CompgenError(Exception):
    """Base of every error that compgen raises on purpose; the command line turns it into ``exit_code``."""

    exit_code = 2


class InputError(CompgenError, ValueError):
    """Something that the user gave cannot be used.

    Parameters
    ----------
    message : what was given, what is allowed, what to do.
    file, line, field : where it stands, as far as it is known; they are put in front of the message.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
    ) -> None:
        self.message, self.file, self.line, self.field = message, file, line, field
        place = visible(str(file), flat=True) if file is not None else ""
        if line is not None:
            place += f":{line}" if place else f"line {line}"
        if field:
            place += f": {field}" if place else field
        super().__init__(f"{place}: {message}" if place else message)


class UndeterminedError(CompgenError):
    """The data do not determine what was asked for; ``combinations`` says in words what is missing."""

    exit_code = 1

    def __init__(self, message: str, combinations: list[str]) -> None:
        self.combinations = combinations
        super().__init__(message)


class ConvergenceError(CompgenError):
    """An iteration did not reach its optimum; nothing that it produced may be used."""

    exit_code = 1


class CompgenWarning(UserWarning):
    """Something the user should know that does not stop the work."""
