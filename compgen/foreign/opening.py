"""How commands open files: native ones are read as they are, foreign ones are converted in memory.

:func:`open_measurement` and :func:`open_errors` take any file; a foreign one that leaves something open is refused with
what ``volcomp import`` needs. What converts a foreign file is imported when there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compgen.data.csv_files import names_in_header
from compgen.data.error_table import ErrorTable, read_errors
from compgen.data.records import ARCHIVE, format_of_columns
from compgen.errors import InputError
from compgen.foreign.source import MOST_CAPTURE_BYTES, MOST_OWN_BYTES, check_size, decode_head, read_head
from compgen.identify.any_measurement import Measurement, read_measurement

_NATIVE_SUFFIXES = (".lengths.csv", ".deviations.csv", ".axis.csv", ".sixdof.csv", ".part.csv")


def native_format(path: Path) -> str | None:
    """Return the kind of a native file, None for a foreign one; InputError for what is not data."""
    if path.name.lower().endswith(ARCHIVE):
        return "lengths"
    check_size(path, MOST_CAPTURE_BYTES)
    head = read_head(path)
    if head.startswith((b"PK\x03\x04", b"HEADER::", b"\xff\xfe", b"\xfe\xff")):
        return None
    kind = format_of_columns(names_in_header(decode_head(head).lstrip("\ufeff")), complete=True)
    if kind not in (None, "sixdof", "part"):
        check_size(path, MOST_OWN_BYTES)
    return kind


def open_measurement(
    paths: Sequence[str | Path], instrument: str | Path | None = None, axis: str | None = None
) -> Measurement | ErrorTable:
    """Read measurement files, native and foreign ones; a foreign file of errors gives those.

    Parameters
    ----------
    paths : files of one kind (lengths, deviations, axis runs); six-DOF readings as ``read_measurement`` takes them.
    instrument : the instrument TOML of six-DOF readings.
    axis : the axis of foreign files that measure along one and do not say which; native files do.

    Raises
    ------
    InputError
        for a foreign file that leaves something open (unit, sign, axis, direction), with what ``volcomp import`` needs.
    """
    kinds = [native_format(Path(path)) for path in paths]
    if axis is not None and any(kinds):
        known = paths[[kind is not None for kind in kinds].index(True)]
        raise InputError(
            "is in the native format, which names its axis; use --axis for instrument files only",
            file=known,
            field="--axis",
        )
    if not paths or all(kinds) or "sixdof" in kinds or instrument is not None:
        return read_measurement(paths, instrument)
    if len(paths) == 1 and Path(paths[0]).name.lower().endswith(_NATIVE_SUFFIXES):
        return read_measurement(paths, instrument)  # the native reader says best what is missing
    from compgen.foreign.converted import converted_measurement

    return converted_measurement(paths, kinds, axis)


def open_errors(path: str | Path) -> ErrorTable:
    """Read errors: ``*.errors.csv``, or a foreign file with errors, or with axis runs (their two-way means).

    Raises
    ------
    InputError
        for a foreign file that leaves something open, or holds neither.
    """
    source = Path(path)
    kind = native_format(source)
    if kind == "errors" or (kind is None and source.name.lower().endswith(".errors.csv")):
        return read_errors(source)
    if kind not in (None, "axis"):
        raise InputError(f"holds {kind}, not errors; identify them first", file=source)
    from compgen.foreign.converted import converted_errors

    return converted_errors(source, kind)
