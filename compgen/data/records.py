"""The columns of measurement files, declared once: a schema reads, joins and writes records, and distinguishes formats.

A record is a frozen dataclass of arrays with one entry (or row) for each line of a file, ``metadata`` for the comments and
``origin`` for the file and line of every entry. Its schema lists the fields in the order in which they are written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from compgen.data.arguments import numbers, of_kind, paths_of, whole_numbers
from compgen.data.csv_files import CsvTable, FloatArray, format_csv, names_in_header, read_csv
from compgen.data.files import read_bytes, read_text
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError, repeated

R = TypeVar("R")
#: Reads one column of a table, shape (rows,).
ReadColumn = Callable[[CsvTable, str], Any]

POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
TOOL_COLUMNS = ("tool_x_mm", "tool_y_mm", "tool_z_mm")
APPROACH_COLUMNS = ("approach_x", "approach_y", "approach_z")
LABEL_COLUMNS = ("run", "line", "repeat", "block", "setup", "pose")
COVARIATE_COLUMNS = ("time_s", "feed_mm_min", "load_kg", "u_length_um")
DEVIATION_COLUMNS = ("dx_um", "dy_um", "dz_um")
#: Measured coordinates of features of parts.
MEASURED_COLUMNS = ("mx_mm", "my_mm", "mz_mm")
#: Temperatures, of which a file may have any number.
TEMPERATURES = "temp_*_c"
#: Ending of lengths in binary form, the only format recognised by its name.
ARCHIVE = ".lengths.npz"
#: Ending of lengths in Parquet files, also recognised by the name.
PARQUET = ".parquet"
#: Larger texts of lengths are never read whole, bytes.
LARGE_TEXT = 256_000_000
#: The header of a large file is looked for in so many bytes, before the whole file is read.
HEAD_BYTES = 65_536
#: A larger deviation is rejected as a wrong unit, um.
LARGEST_DEVIATION_UM = 1e5


@dataclass(frozen=True)
class Field:
    """One field of a record and its columns.

    Parameters
    ----------
    name : the field.
    columns : one column for an array (n,), three for one of shape (n, 3).
    read : how a column is read and checked.
    unit : factor from the column to the field.
    digits : decimals in the file.
    presence : ``required``; ``filled``: columns that a file lacks are ``fill``; ``optional``: likewise, but None if the
        file has none of them; ``complete``: all or none, alike in all files; ``each``: a dict of the columns in the
        file; ``covariates``: likewise, in the order of the file and with its temperatures.
    fill : value of a column that a file lacks.
    encode : converts the values to text, e.g. to the letters of axes; None: numbers, or text unchanged.
    """

    name: str
    columns: tuple[str, ...]
    read: ReadColumn = CsvTable.numbers
    unit: float = 1.0
    digits: int = 6
    presence: Literal["required", "filled", "optional", "complete", "each", "covariates"] = "required"
    fill: float = np.nan
    encode: Callable[[Any], Sequence[str]] | None = None

    def of_table(self, table: CsvTable) -> Any:
        """Return the values of the field from one file; InputError for missing or invalid columns."""
        present = [name for name in self.columns if name in table.columns]
        if self.presence == "each":
            return {name: self.read(table, name) for name in present}
        if self.presence == "covariates":
            known = [name for name in table.columns if name in self.columns or name.startswith("temp_")]
            # a direction of travel among the covariates is checked as such
            return {name: table.signs(name) if name == "approach" else table.numbers(name) for name in known}
        if not present and self.presence in ("optional", "complete"):
            return None
        if len(present) < len(self.columns) and self.presence == "complete":
            raise InputError(f"has {present[0]} but not all of {', '.join(self.columns)}", file=table.path)
        found = [
            self.read(table, name) if name in present or self.presence == "required" else np.full(len(table), self.fill)
            for name in self.columns
        ]
        if len(found) > 1:
            return np.column_stack(found) * self.unit
        return found[0] if self.unit == 1.0 else found[0] * self.unit

    def cells(self, values: Any) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of a file for ``values``; components that were never measured have none."""
        if isinstance(values, Mapping):
            return {name: np.asarray(column, dtype=np.float64) for name, column in values.items()}
        if values is None:
            return {}
        if self.encode is not None or not isinstance(values, np.ndarray):
            return {self.columns[0]: self.encode(values) if self.encode else values}
        columns = values.T if values.ndim == 2 else [values]
        found = {name: np.asarray(one / self.unit) for name, one in zip(self.columns, columns, strict=True)}
        return {name: one for name, one in found.items() if self.presence == "required" or not np.isnan(one).all()}


def one_of(allowed: Iterable[str], what: str) -> Callable[[CsvTable, str], np.ndarray[Any, np.dtype[np.int64]]]:
    """Read a column of words as their numbers among the allowed ones; another word is refused as not being ``what``."""
    known = tuple(allowed)

    def read(table: CsvTable, column: str) -> np.ndarray[Any, np.dtype[np.int64]]:
        words = table.text(column)
        for row, word in enumerate(words):
            if word not in known:
                listed = f"{', '.join(known[:-1])} or {known[-1]}"
                raise table.fail(row, column, f"{word!r} is not {what}; expected {listed}")
        return np.array([known.index(word) for word in words], dtype=np.int64)

    return read


def check_rows(record: Any, *, names: Sequence[str] = (), unknown: Sequence[str] = ()) -> None:
    """Check the arrays of a record with a row for each position (n, 3), and make float64 arrays of lists and whole numbers.

    ``names`` are its further arrays (n,), ``unknown`` the fields in which nan means: not measured, not known. InputError with
    the name of the field.
    """

    def put(name: str, value: Any) -> None:
        object.__setattr__(record, name, value)

    put("position_mm", numbers("position_mm", record.position_mm, None, 3))
    count = len(record.position_mm)
    for name in ("deviation_mm", "u_mm", "tool_mm", "approach"):
        value = getattr(record, name, None)
        if value is not None:
            put(
                name,
                numbers(name, value, count, 3, unknown=name in unknown, least=-1.0 if name == "approach" else -np.inf),
            )
    for name in names:
        put(name, numbers(name, getattr(record, name), count, unknown=name in unknown))
    for name, read in (("labels", whole_numbers), ("covariates", _covariate)):
        given = getattr(record, name, {})
        of_kind(name, given, Mapping)
        put(name, {key: read(f"{name}[{key}]", values, count) for key, values in given.items()})
    of_kind("metadata", getattr(record, "metadata", {}), Mapping)


def _covariate(name: str, value: Any, count: int) -> FloatArray:
    return numbers(name, value, count, unknown=True)


#: Reads a column of axis letters as 0, 1, 2 for X, Y, Z.
axes_of = one_of(AXES, "an axis")


def within(most: float, unit: str, doubt: str) -> ReadColumn:
    """Read numbers of at most ``most`` in magnitude; a larger one is refused, with the reason ``doubt``."""

    def read(table: CsvTable, column: str) -> FloatArray:
        values = table.numbers(column)
        for row in np.flatnonzero(np.abs(values) > most)[:1].tolist():
            raise table.fail(row, column, f"{values[row]:g} {unit} is {doubt}")
        return values

    return read


def uncertainties(table: CsvTable, column: str) -> FloatArray:
    """Read standard uncertainties, which must be above zero."""
    values = table.numbers(column)
    for row in np.flatnonzero(values <= 0)[:1].tolist():
        raise table.fail(row, column, f"{values[row]:g} um is not a standard uncertainty; it must be above zero")
    return values


def directions(table: CsvTable, column: str) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Read directions of approach: 1 or -1."""
    values = table.signs(column)
    for row in np.flatnonzero(values == 0)[:1].tolist():
        raise table.fail(row, column, "0 is not a direction of approach; expected 1 or -1")
    return values.astype(np.int64)


def approach_of(moves: FloatArray) -> FloatArray:
    """Return the last direction of travel of each axis after moves (n, 3): +1, -1, or 0 before its first move; (n, 3)."""
    moving = moves != 0
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moves))[:, None], 0), axis=0)
    return np.sign(np.take_along_axis(moves, last, axis=0))


#: Deviations in um; beyond 100 mm the unit must be wrong.
deviations_um = within(LARGEST_DEVIATION_UM, "um", "more than 100 mm; is the unit um?")

# Fields that several kinds of record have.
POSITION = Field("position_mm", POSITION_COLUMNS)
TOOL = Field("tool_mm", TOOL_COLUMNS, presence="complete")
APPROACH = Field("approach", APPROACH_COLUMNS, CsvTable.signs, digits=0, presence="optional", fill=0.0)
LABELS = Field("labels", LABEL_COLUMNS, CsvTable.labels, digits=0, presence="each", fill=0)
COVARIATES = Field("covariates", (*COVARIATE_COLUMNS, "approach"), presence="covariates")
AXIS = Field("axis", ("axis",), axes_of, encode=lambda axes: [AXES[k] for k in axes])
DIRECTION = Field("direction", ("direction",), directions, digits=0)
RUN = Field("run", ("run",), CsvTable.labels, digits=0)
#: Actual minus commanded position along a line, of runs along axes and diagonals.
RUN_DEVIATION = Field("deviation_mm", ("deviation_um",), deviations_um, MM_PER_UM, digits=4)


#: Files with fewer rows are compared as they are written.
FEW_ROWS = 5


@dataclass(frozen=True)
class Schema:
    """The fields of one kind of record.

    ``keys`` are the columns that identify a row of a file, ``needed`` the optional columns that a file must have.
    """

    fields: tuple[Field, ...]
    keys: tuple[str, ...] = ()
    needed: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[Sequence[str], Sequence[str], Sequence[str]]:
        """Required and optional columns, and patterns of further ones."""
        required = [name for field in self.fields if field.presence == "required" for name in field.columns]
        others = [name for field in self.fields if field.presence != "required" for name in field.columns]
        return (*required, *self.needed), others, (TEMPERATURES,)

    def read_table(self, file: str | Path) -> CsvTable:
        """Read the columns of one file."""
        return self.with_different_rows(read_csv(file, *self.columns))

    def with_different_rows(self, table: CsvTable) -> CsvTable:
        """Return the table; InputError if two of its rows are about the same reading."""
        found = repeated(self.identities(table))
        if found is not None:
            raise self.fail_repeated(table, found[1], table.lines[found[0]])
        return table

    def identities(self, table: CsvTable) -> Iterable[tuple[Any, ...]]:
        """Return what distinguishes each row: its keys, and labels, directions, the tool and the time."""
        names = (
            (*self.keys, "approach", *APPROACH_COLUMNS, *TOOL_COLUMNS, *LABEL_COLUMNS, "time_s") if self.keys else ()
        )
        return zip(*(table.columns[name] for name in names if name in table.columns), strict=True)

    def fail_repeated(self, table: CsvTable, row: int, first_line: int) -> InputError:
        """Return the error about a row whose reading already appears in another line."""
        keys = [name for name in self.keys if name in table.columns]
        what = " and ".join(f"{name} {table.columns[name][row]!r}" for name in keys)
        return table.fail(
            row, keys[-1], f"{what} already appear in line {first_line}; give repeats a run or repeat column"
        )

    def read_tables(self, files: str | Path | Sequence[str | Path]) -> list[CsvTable]:
        """Read the columns of one or more files; the same rows must not occur twice."""
        sources = paths_of("files", files)
        if not sources:
            raise InputError("no measurement file was given")
        tables = [self.read_table(source) for source in sources]
        for k, table in enumerate(tables):
            for earlier in tables[:k]:
                if table.columns == earlier.columns:
                    what = f"contains the same rows as {earlier.path}; give each measurement only once"
                    raise InputError(what, file=table.path)
                if len(table) == len(earlier) >= FEW_ROWS and _readings(table) == _readings(earlier):
                    what = (
                        f"contains the same readings as {earlier.path}, under other run numbers, labels or times, in another "
                        "order or written with other digits; give each measurement only once"
                    )
                    raise InputError(what, file=table.path)
        return tables

    def values(self, table: CsvTable) -> dict[str, Any]:
        """Return the fields of a record, with ``metadata`` and ``origin``, from one file."""
        found = {field.name: field.of_table(table) for field in self.fields}
        metadata = {key: value for key, value in table.metadata.items() if key != "rows"}
        return {**found, "metadata": metadata, "origin": [(str(table.path), line) for line in table.lines]}

    def joined(self, parts: Sequence[R]) -> R:
        """Return several records as one: missing labels are 0, covariates nan, directions unknown.

        Raises
        ------
        InputError
            if only some of them have a tool or uncertainties.
        """
        if len(parts) == 1:
            return parts[0]
        metadata = {key: value for part in reversed(parts) for key, value in vars(part)["metadata"].items()}
        values = {field.name: _joined(field, parts) for field in self.fields}
        return replace(parts[0], **values, metadata=metadata, origin=_chained(parts, "origin"))  # type: ignore[type-var]

    def format(
        self,
        record: Any,
        metadata: Mapping[str, object],
        others: Mapping[str, FloatArray] | None = None,
        decimals: Mapping[str, int] | None = None,
    ) -> str:
        """Return the text of a file with the record's fields, then ``others``; ``decimals`` override those of columns."""
        digits: dict[str, int] = {}
        for field in self.fields:
            digits |= dict.fromkeys(field.cells(getattr(record, field.name)), field.digits)
        return format_csv({**self.cells(record), **(others or {})}, metadata, digits | dict(decimals or {}))

    def cells(self, record: Any) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of a file for a record, not rounded."""
        columns: dict[str, Sequence[str] | FloatArray] = {}
        for field in self.fields:
            columns |= field.cells(getattr(record, field.name))
        return columns


def _readings(table: CsvTable) -> list[tuple[str, ...]]:
    """The rows of a file without numbers of runs, labels and times, in an order of their own."""
    counted = {*LABEL_COLUMNS, "run", "time_s", "order"}
    columns = [[_plain(cell) for cell in table.columns[name]] for name in sorted(set(table.columns) - counted)]
    return sorted(zip(*columns, strict=True))


def _plain(cell: str) -> str:
    """A cell with its number, if it is one, in one way of writing."""
    try:
        return f"{float(cell):.9g}"
    except ValueError:
        return cell.strip()


def _chained(parts: Sequence[object], name: str) -> list[Any]:
    return list(chain.from_iterable(getattr(part, name) for part in parts))


def _joined(field: Field, parts: Sequence[Any]) -> Any:
    """Join one field of several records."""
    values = [getattr(part, field.name) for part in parts]
    if isinstance(values[0], Mapping):
        kinds = {name: column.dtype for found in values for name, column in found.items()}

        def column(found: Mapping[str, Any], size: int, name: str) -> Any:
            return found[name] if name in found else np.full(size, field.fill).astype(kinds[name])

        known = list(zip(values, map(len, parts), strict=True))
        return {name: np.concatenate([column(found, size, name) for found, size in known]) for name in kinds}
    if all(value is None for value in values):
        return None
    lacking = [k for k, value in enumerate(values) if value is None]
    if lacking and np.isnan(field.fill):
        origin = parts[lacking[0]].origin
        message = f"lacks {', '.join(field.columns)}, which another file has; give them in every file"
        raise InputError(message, file=origin[0][0] if origin else None)
    if not isinstance(values[0], np.ndarray | None):
        return type(values[0])(_chained(parts, field.name))
    return np.concatenate(
        [np.full((len(part), len(field.columns)), field.fill) if value is None else value
         for value, part in zip(values, parts, strict=True)]
    )  # fmt: skip


def fail_at(origin: Sequence[tuple[str, int]], row: int, message: str, field: str | None = None) -> InputError:
    """Return the error about one entry of a record."""
    file, line = origin[row] if origin else (None, None)
    return InputError(message, file=file, line=line, field=field)


# The kind of a file, from the names in its header.


@dataclass(frozen=True)
class _Signature:
    """Columns of a native format: any of ``marks`` identifies it, ``needed`` are its other required columns."""

    kind: str
    marks: tuple[frozenset[str], ...]
    needed: frozenset[str] = frozenset()


def _any_of(names: Iterable[str]) -> tuple[frozenset[str], ...]:
    return tuple(frozenset({name}) for name in names)


_PLACE = frozenset(POSITION_COLUMNS)
_SIGNATURES = (
    _Signature("sixdof", _any_of(("y_qd1_mm", "y_psd1_mm"))),
    _Signature("bar", (frozenset({"ball_x_mm", "nominal_mm"}),), _PLACE),
    _Signature("sphere", (frozenset({"cx_mm", "cy_mm", "cz_mm"}),)),
    _Signature("sphere", tuple(frozenset({angle, "dx_um"}) for angle in ("a_deg", "b_deg", "c_deg")), _PLACE),
    _Signature("part", _any_of(MEASURED_COLUMNS), frozenset(POSITION_COLUMNS[:2])),
    _Signature("lengths", _any_of(("length_mm",)), _PLACE | {"station", "point"}),
    _Signature("axis", (frozenset({"axis", "position_mm", "deviation_um"}),), frozenset({"direction", "run"})),
    _Signature("circle", (frozenset({"angle_deg", "deviation_um"}),), frozenset({"plane", "radius_mm", "direction"})),
    _Signature("diagonals", (frozenset({"diagonal", "deviation_um"}),), _PLACE),
    _Signature("errors", (frozenset({"error", "position_mm", "value"}),)),
    _Signature("sixdof", (frozenset({"axis", "position_mm", "displacement_mm"}),)),
    _Signature("deviations", _any_of(DEVIATION_COLUMNS), _PLACE),
)


def format_of_columns(names: set[str], *, complete: bool = False) -> str | None:
    """Return the native format of a header, None for a foreign one.

    Parameters
    ----------
    names : columns of the file.
    complete : require all columns that distinguish the format from tables of other programs.
    """
    for signature in _SIGNATURES:
        if any(marks <= names for marks in signature.marks) and (not complete or signature.needed <= names):
            return signature.kind
    return None


def detect_format(source: str | Path) -> str | None:
    """Return the kind of a measurement file from its columns.

    ``lengths``, ``deviations``, ``part``, ``artefact``, ``axis``, ``circle``, ``diagonals``, ``sixdof``, ``sphere``,
    ``bar``, ``errors``, or None.
    """
    if str(source).lower().endswith((ARCHIVE, PARQUET)):
        return "lengths"
    head = read_bytes(source, HEAD_BYTES)
    text = head.rpartition(b"\n")[0].decode("utf-8-sig", "replace") if len(head) == HEAD_BYTES else ""
    if not any(names_in_header(text)):  # a small file, or a long head
        text = read_text(source)
    kind = format_of_columns(names_in_header(text))
    return "artefact" if kind == "part" and is_artefact(source, text) else kind


def may_be_large(source: str | Path) -> bool:
    """Whether a file may hold more readings than are read whole: by its name, or as a text of many bytes."""
    binary = str(source).lower().endswith((ARCHIVE, PARQUET))
    return binary or (Path(source).is_file() and Path(source).stat().st_size > LARGE_TEXT)


def is_artefact(source: str | Path, text: str) -> bool:
    """Whether a file of features was measured by the machine itself, by its name or the comment ``calibrated``.

    Both have the same columns, but opposite signs: a part has the errors of the machine, its probe sees their opposite.
    """
    comment = any(line.lstrip("# ").startswith("calibrated") for line in text.splitlines()[:50] if line.startswith("#"))
    return str(source).lower().endswith(".artefact.csv") or comment
