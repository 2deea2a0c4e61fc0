"""How commands open files of any kind: native ones are read directly, foreign ones are converted in memory.

A foreign file with open questions is refused with what ``volcomp import`` needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from compgen.data.error_table import ErrorTable, about_own_lines, is_apart, read_errors
from compgen.errors import InputError
from compgen.foreign.source import native_format
from compgen.identification.any_measurement import read_measurement
from compgen.identification.kinds import Measurement, MixedMeasurement, OneKind

if TYPE_CHECKING:
    from compgen.foreign.answers import ImportOptions

_NATIVE_SUFFIXES = (
    ".lengths.csv",
    ".deviations.csv",
    ".axis.csv",
    ".sixdof.csv",
    ".part.csv",
    ".artefact.csv",
    ".circle.csv",
)


def open_measurement(
    paths: Sequence[str | Path],
    instrument: str | Path | None = None,
    axis: str | None = None,
    stated: ErrorTable | None = None,
    answers: ImportOptions | None = None,
) -> Measurement | ErrorTable:
    """Read measurement files of any kinds, native and foreign ones, and files of errors.

    Parameters
    ----------
    paths : files; those of one kind are one measurement, several kinds a mixture. A single file of errors gives those.
    instrument : the instrument TOML of six-DOF readings.
    axis : the axis of foreign files that measure along one and do not state it; native files do.
    stated : errors that are known without a file.
    answers : what foreign files leave open; each answer is for the files of formats that take it.

    Raises
    ------
    InputError
        for a foreign file that leaves something open (unit, sign, axis, direction), with what ``volcomp import`` needs.
    """
    kinds = [native_format(Path(path), in_parts=len(paths) == 1) for path in paths]
    if axis is not None and any(kinds):
        known = paths[[kind is not None for kind in kinds].index(True)]
        raise InputError(
            "is in the native format, which states its axis; use --axis for instrument files only",
            file=known,
            field="--axis",
        )
    parts: list[tuple[str, OneKind | ErrorTable]] = []
    measured = [k for k, kind in enumerate(kinds) if kind != "errors"]
    # of a file that has the name of a native one, the native reader says best what is missing
    foreign = any(kinds[k] is None and not Path(paths[k]).name.lower().endswith(_NATIVE_SUFFIXES) for k in measured)
    if answers is not None and answers.given() and not foreign:
        text = (
            "answers a question about a file of another program, and all files are in the native format: leave it out"
        )
        raise InputError(text, field=answers.flag(answers.given()[0]))
    apart = [k for k in measured if kinds[k] == "sixdof"] if foreign else []
    plain = [paths[k] for k in measured if k not in apart]
    if foreign:
        from compgen.foreign.converted import converted_parts  # the converters, where a foreign file is read

        parts += converted_parts(plain, [kinds[k] for k in measured if k not in apart], axis, answers)
        plain = [paths[k] for k in apart]
    if plain or instrument is not None or not (paths or stated):
        found = read_measurement(plain, instrument)
        parts += (
            found.parts
            if isinstance(found, MixedMeasurement)
            else [(", ".join(Path(path).name for path in plain), found)]
        )
    tables = [Path(paths[k]) for k, kind in enumerate(kinds) if kind == "errors"]
    for k, path in enumerate(tables):
        if path.resolve() in [other.resolve() for other in tables[:k]]:
            raise InputError("is given twice; give it once", file=path)
        same = [other.name for other in tables].count(path.name) > 1
        parts.append((str(path) if same else path.name, read_errors(path)))
    if stated is not None:
        parts.append(("command line", stated))
    return parts[0][1] if len(parts) == 1 else MixedMeasurement(tuple(parts))


def open_errors(path: str | Path) -> ErrorTable:
    """Read errors: ``*.errors.csv``, or a foreign file with errors, or with axis runs (their bidirectional means).

    Straightness that says nothing about squareness is returned about its own line: how a straightedge lay is no error.

    Raises
    ------
    InputError
        for a foreign file with open questions, or without errors and axis runs.
    """
    source = Path(path)
    kind = native_format(source)
    if kind == "errors" or (kind is None and source.name.lower().endswith(".errors.csv")):
        table = read_errors(source)
    elif kind not in (None, "axis"):
        raise InputError(f"contains {kind}, not errors; identify them first", file=source)
    else:
        from compgen.foreign.converted import converted_errors

        table = converted_errors(source, kind)
    return about_own_lines(table)[0] if is_apart(table) else table
