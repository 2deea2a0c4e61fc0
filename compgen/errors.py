"""The few exceptions of compgen; each carries the data that a caller needs to react."""

from __future__ import annotations

from pathlib import Path

from compgen.data.messages import visible


class CompgenError(Exception):
    """Base of every error that compgen raises on purpose; the command line turns it into ``exit_code``.

    Examples
    --------
    >>> import compgen
    >>> try:
    ...     compgen.load_machine("no-such-machine")
    ... except compgen.CompgenError as error:
    ...     print(type(error).__name__, error.exit_code)
    InputError 2
    """

    exit_code = 2


class InputError(CompgenError, ValueError):
    """Something that the user gave cannot be used.

    Parameters
    ----------
    message : what was given, what is allowed, what to do.
    file, line, field : where it is, as far as known; they are put in front of the message.

    Examples
    --------
    >>> import compgen
    >>> error = compgen.InputError("expected a number, found 'ten'", file="mill.toml", line=7, field="nodes")
    >>> print(error)
    mill.toml:7: nodes: expected a number, found 'ten'
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
    """The data do not determine the requested unknowns; ``combinations`` says in words what is missing.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine, r = compgen.load_machine("zha-gantry"), compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> k = np.flatnonzero((r.position_mm[:, 1:] == 0.0).all(axis=1))  # readings along one line only
    >>> few = compgen.Lengths(r.stations, r.station[k], tuple(r.point[i] for i in k), r.position_mm[k], r.length_mm[k])
    >>> try:
    ...     compgen.identify(machine, few)
    ... except compgen.UndeterminedError as error:
    ...     print(len(error.combinations) > 0)
    True
    """

    exit_code = 1

    def __init__(self, message: str, combinations: list[str]) -> None:
        self.combinations = combinations
        super().__init__(message)


class ConvergenceError(CompgenError):
    """An iteration did not converge; its result must not be used.

    Examples
    --------
    >>> import compgen
    >>> issubclass(compgen.ConvergenceError, compgen.CompgenError)
    True
    """

    exit_code = 1


class CompgenWarning(UserWarning):
    """Something the user should know that does not stop the work.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", compgen.CompgenWarning)
    ...     try:
    ...         compgen.predict(machine, errors, compgen.Points(np.array([[50.0, 0.0, 0.0]])))
    ...     except compgen.CompgenWarning as warning:
    ...         print("outside the travel:", str(warning)[:3])
    outside the travel: EXX
    """
