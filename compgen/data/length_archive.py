"""Tracer lengths that are never all in memory: from archives (``*.lengths.npz``), Parquet files, and large CSV files."""

from __future__ import annotations

import struct
import warnings
import weakref
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray, csv_parts, kept_columns
from compgen.data.files import working_folder
from compgen.data.lengths import LENGTHS, MOST_WHOLE, Lengths
from compgen.data.records import (
    APPROACH_COLUMNS,
    ARCHIVE,
    COVARIATE_COLUMNS,
    LABEL_COLUMNS,
    PARQUET,
    POSITION_COLUMNS,
    TOOL_COLUMNS,
    detect_format,
    may_be_large,
)
from compgen.errors import CompgenWarning, InputError, Message

#: Readings of which an identification from an archive keeps the residuals, and in which it searches for disturbances.
SAMPLE = 20_000
#: Readings in memory at a time.
CHUNK = 250_000
_REQUIRED = ("station", *POSITION_COLUMNS, "length_mm")


@dataclass(frozen=True)
class Column:
    """An array of an archive, on the disk: ``column[rows]`` reads a slice of it, or single rows (k,)."""

    path: Path
    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> NDArray[Any]:
        """Return a part of the column."""
        if isinstance(rows, slice):
            first, last, _ = rows.indices(self.shape[0])
            return np.fromfile(self.path, self.dtype, last - first, offset=self.offset + first * self.dtype.itemsize)
        return np.array(np.memmap(self.path, self.dtype, "r", self.offset, self.shape)[rows])


@dataclass(frozen=True)
class LengthArchive:
    """The columns of an archive, n readings.

    ``columns`` have the names of a ``*.lengths.csv`` file, each (n,); ``station`` is an index into ``stations``, ``line``
    the line of each reading if the file has lines.
    """

    path: Path
    stations: tuple[str, ...]
    columns: Mapping[str, Column]
    metadata: Mapping[str, str] = field(default_factory=dict)
    line: Column | None = None

    def lines(self, rows: slice | NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lines of some readings in the file: their numbers, counted from 1, in a file without lines."""
        if self.line is not None:
            return np.asarray(self.line[rows], dtype=np.int64)
        return (np.arange(len(self))[rows] if isinstance(rows, slice) else rows) + 1

    def __len__(self) -> int:
        """Return the number of readings."""
        return self.columns["length_mm"].shape[0]

    def chunks(self) -> Iterator[slice]:
        """Rows in memory at a time."""
        return (slice(first, min(first + CHUNK, len(self))) for first in range(0, len(self), CHUNK))

    def check(self, look: Callable[[int, list[FloatArray]], None] = lambda *_: None) -> None:
        """Raise InputError for numbers that are not finite, and for stations that are not in the list.

        ``look`` gets the first row and the coordinates x, y, z (k,) of each chunk.
        """
        for rows in self.chunks():
            found = {name: self.columns[name][rows] for name in (*POSITION_COLUMNS, "length_mm")}
            for name, values in found.items():
                if not np.isfinite(values.sum(dtype=np.float64)):  # not finite if any number is not
                    for row in np.flatnonzero(~np.isfinite(values))[:1].tolist():
                        message = f"reading {rows.start + row + 1} is not a finite number"
                        raise InputError(message, file=self.path, field=name)
            look(rows.start, [found[name].astype(np.float64, copy=False) for name in POSITION_COLUMNS])
            station = self.columns["station"][rows]
            if station.min() < 0 or station.max() >= len(self.stations):
                message = f"contains a number that is not one of the {len(self.stations)} stations, 0 to "
                raise InputError(f"{message}{len(self.stations) - 1}", file=self.path, field="station")

    def taken(self, rows: slice | NDArray[np.int64]) -> Lengths:
        """Return some of the readings; their points are numbered by row."""
        found = {name: column[rows] for name, column in self.columns.items()}
        numbers, lines = np.arange(len(self))[rows], self.lines(rows)
        labels = {name: found[name].astype(np.int64) for name in LABEL_COLUMNS if name in found}
        others = {name: found[name].astype(np.float64) for name in found if name.startswith("temp_")}
        others |= {name: found[name].astype(np.float64) for name in COVARIATE_COLUMNS if name in found}
        return Lengths(
            stations=self.stations,
            station=found["station"].astype(np.int64),
            point=[str(number + 1) for number in numbers.tolist()],
            position_mm=np.column_stack([found[name] for name in POSITION_COLUMNS]),
            length_mm=found["length_mm"],
            labels=labels,
            covariates=others,
            metadata=self.metadata,
            origin=[(str(self.path), line) for line in lines.tolist()],
        )

    @cached_property
    def sample_rows(self) -> NDArray[np.int64]:
        """Return the rows of a sample: stops spread at random distances, so that no period of the data is aliased.

        A few consecutive rows are taken together, because stations often read at the same stop.
        """
        together = min(4 * len(self.stations), 64)
        starts = np.arange(0, len(self) - together, max(together, len(self) * together // SAMPLE))
        room = max(1, len(self) * together // SAMPLE - together)
        starts = starts + np.random.default_rng(0).integers(0, room, len(starts))
        rows = (starts[:, None] + np.arange(together)).ravel()
        return np.asarray(rows[rows < len(self)], dtype=np.int64)


def open_archive(path: str | Path) -> LengthArchive:
    """Map an archive from the disk.

    It is an ``.npz`` file of numpy (``numpy.savez``, not compressed) with one array for each column of a ``*.lengths.csv``
    file, all of the same length; ``station`` is an index into the array ``stations`` of names. Arrays without a dimension
    are comments, e.g. ``u_length_um``.

    Raises
    ------
    InputError
        for a file that is not such an archive, lacks a column, or is compressed.
    """
    source = Path(path)
    try:
        with zipfile.ZipFile(source) as archive, source.open("rb") as stream:
            members = {item.filename.removesuffix(".npy"): _member(source, stream, item) for item in archive.infolist()}
    except FileNotFoundError as error:
        raise InputError(Message("file-missing", "no such file"), file=source) from error
    except InputError:
        raise
    except Exception as error:  # what reads archives raises errors of many kinds: struct, tokenize, zlib
        raise InputError(
            f"is not an archive of numpy (.npz), or is truncated or damaged ({error})", file=source
        ) from error
    columns = {name: member for name, member in members.items() if isinstance(member, Column)}
    small = {name: member for name, member in members.items() if not isinstance(member, Column)}
    metadata = {name: str(values[()]) for name, values in small.items() if values.ndim == 0}
    missing = [name for name in _REQUIRED if name not in columns]
    if "stations" not in small or small["stations"].ndim != 1:
        missing.append("stations (the names, text)")
    if missing:
        raise InputError(f"lacks {', '.join(missing)}; expected the columns of a *.lengths.csv file", file=source)
    known = {*_REQUIRED, *LABEL_COLUMNS, *COVARIATE_COLUMNS}
    count = columns["length_mm"].shape[0]
    for name, values in columns.items():
        if name not in known and not (name.startswith("temp_") and name.endswith("_c")):
            raise InputError("is not a column that an archive of lengths may have", file=source, field=name)
        if values.shape != (count,):
            raise InputError(f"has the shape {values.shape}; expected ({count},)", file=source, field=name)
        kinds, what = ("iu", "whole numbers") if name in ("station", *LABEL_COLUMNS) else ("fiu", "numbers")
        if values.dtype.kind not in kinds:
            raise InputError(f"has the type {values.dtype}; expected {what}", file=source, field=name)
    if not count:
        raise InputError("contains no readings", file=source)
    return LengthArchive(source, tuple(str(name) for name in small["stations"]), columns, metadata)


def _member(source: Path, stream: BinaryIO, item: zipfile.ZipInfo) -> NDArray[Any] | Column:
    """Find one array of an archive, after its local header and its numpy header; small ones are read."""
    if item.compress_type != zipfile.ZIP_STORED:
        raise InputError("is compressed; write it with numpy.savez, not numpy.savez_compressed", file=source)
    stream.seek(item.header_offset)
    mark, *_, name_bytes, extra_bytes = struct.unpack("<4s5H3I2H", stream.read(30))
    if mark != b"PK\x03\x04":
        raise ValueError("a local header is missing")
    stream.seek(name_bytes + extra_bytes, 1)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(stream)
    if dtype.hasobject or (fortran and len(shape) > 1):
        raise ValueError(f"{item.filename} contains objects, or is stored column by column")
    if not shape or 0 in shape or dtype.kind in "US":  # names and comments are small
        stream.seek(item.header_offset + 30 + name_bytes + extra_bytes)
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
    return Column(source, stream.tell(), dtype, shape)


def read_archive(path: str | Path) -> Lengths:
    """Read a whole archive; InputError for more than ``MOST_WHOLE`` readings."""
    archive = open_archive(path)
    if len(archive) > MOST_WHOLE:
        raise too_many(archive.path, len(archive))
    archive.check()
    return archive.taken(slice(None))


def write_archive(
    path: str | Path, stations: Iterable[str], parts: Iterable[Mapping[str, NDArray[Any]]], metadata: Mapping[str, Any]
) -> int:
    """Write an archive in parts, with only one part in memory; return the number of readings.

    Each of ``parts`` has the same columns, which are collected in files next to ``path`` and then combined.
    """
    target = Path(path)
    open_files: dict[str, tuple[BinaryIO, np.dtype[Any]]] = {}
    count = 0
    try:
        for part in parts:
            for name, values in part.items():
                if name not in open_files:
                    open_files[name] = (target.with_name(f".{target.name}.{name}").open("w+b"), values.dtype)
                open_files[name][0].write(np.ascontiguousarray(values).tobytes())
            count += len(part["length_mm"])
        with zipfile.ZipFile(target.with_name(f".{target.name}.part"), "w", zipfile.ZIP_STORED) as archive:
            small = {
                "stations": np.array(list(stations)),
                **{key: np.array(str(value)) for key, value in metadata.items()},
            }
            for name, values in small.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), "w") as member:
                    np.lib.format.write_array(member, values, allow_pickle=False)
            for name, (stream, dtype) in open_files.items():
                stream.seek(0)
                entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                with archive.open(entry, "w", force_zip64=True) as member:
                    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
                    np.lib.format.write_array_header_1_0(member, header)
                    while block := stream.read(1 << 22):
                        member.write(block)
        target.with_name(f".{target.name}.part").replace(target)
    finally:
        for stream, _ in open_files.values():
            stream.close()
            Path(stream.name).unlink()
    return count


# --- text and Parquet ----------------------------------------------------------------------------------------------

#: Columns that an identification in parts does not use.
UNUSED = (*APPROACH_COLUMNS, "approach")
#: Rows whose hashes are compared at a time, and pairs with the same hash that are looked at.
COMPARED, MOST_PAIRS = 1_000_000, 100


def copied_archive(parts: Callable[[], Iterable[CsvTable]]) -> LengthArchive:
    """Copy lengths that come in parts to columns in a temporary folder, which is removed with the result.

    ``parts`` begins from the start with each call.

    Raises
    ------
    InputError
        for whatever :meth:`Schema.values` refuses, columns that need all readings at once, and readings given twice.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(working_folder("lengths-"))
        stations, unused = dict[str, int](), dict[str, None]()
        streams: dict[str, tuple[BinaryIO, np.dtype[Any]]] = {}
        count = 0
        for table in parts():
            for name, values in archive_columns(table, stations).items():
                if name not in streams:
                    streams[name] = stack.enter_context((folder / name).open("wb")), values.dtype
                streams[name][0].write(np.ascontiguousarray(values).data)
            count += len(table)
            unused |= dict.fromkeys(name for name in UNUSED if name in table.columns)
        if unused:
            message = f"the file is too large to separate reversals: {', '.join(unused)} are not used"
            warnings.warn(f"{table.path}: {message}", CompgenWarning, stacklevel=5)
        for stream, _ in streams.values():
            stream.close()
        columns = {name: Column(folder / name, 0, dtype, (count,)) for name, (_, dtype) in streams.items()}
        for pair in same_hash(columns.pop("identity")):
            found: list[tuple[CsvTable, int, object]] = []
            first = 0
            for part in parts():  # read once more: different rows may have the same hash
                own = [row - first for row in pair if first <= row < first + len(part)]
                identities = list(LENGTHS.identities(part)) if own else []
                found += [(part, row, identities[row]) for row in own]
                first += len(part)
            (earlier, row, identity), (later, again, other) = found
            if identity == other:
                raise LENGTHS.fail_repeated(later, again, earlier.lines[row])
        metadata = {key: value for key, value in table.metadata.items() if key != "rows"}
        archive = LengthArchive(table.path, tuple(stations), columns, metadata, columns.pop("line"))
        weakref.finalize(archive, stack.pop_all().close)
    return archive


def archive_columns(table: CsvTable, stations: dict[str, int]) -> dict[str, NDArray[Any]]:
    """Return the columns of a part as an archive has them, with its lines and a hash of the identity of each row.

    Stations that are not among ``stations`` are added to them.
    """
    for name in TOOL_COLUMNS:
        if name in table.columns:
            message = (
                "needs all readings in memory, for which the file is too large; remove the column or split the file"
            )
            raise InputError(message, file=table.path, field=f"column {name}")
    fields = {item.name: item.of_table(table) for item in LENGTHS.fields}
    return {
        "station": np.array([stations.setdefault(name, len(stations)) for name in fields["station"]], dtype=np.int32),
        **dict(zip(POSITION_COLUMNS, fields["position_mm"].T, strict=True)),
        "length_mm": fields["length_mm"],
        **fields["labels"],
        **{name: values for name, values in fields["covariates"].items() if name not in UNUSED},
        "line": np.asarray(table.lines, dtype=np.int64),
        "identity": np.fromiter(map(hash, LENGTHS.identities(table)), np.int64, len(table)),
    }


def same_hash(hashes: Column | NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first pairs of rows with the same hash; only a part of the hashes is in memory."""
    count, found = hashes.shape[0], list[tuple[int, int]]()
    groups = 1 + count // COMPARED
    for group in range(groups):
        rows, values = [], []
        for first in range(0, count, CHUNK):
            chunk = hashes[slice(first, min(first + CHUNK, count))]
            own = np.flatnonzero(chunk % groups == group)
            rows.append(first + own)
            values.append(chunk[own])
        row, value = np.concatenate(rows), np.concatenate(values)
        order = np.argsort(value, kind="stable")  # equal ones in the order of their rows
        twice = np.flatnonzero(np.diff(value[order]) == 0)
        pairs = zip(row[order[twice]].tolist(), row[order[twice + 1]].tolist(), strict=True)
        found = sorted([*found, *pairs], key=lambda pair: pair[1])[:MOST_PAIRS]
    return found


class ParquetTable(CsvTable):
    """Rows of a Parquet file, as of a CSV file; ``lines`` are the numbers of the rows, from 1."""

    def words(self, column: str) -> list[str]:
        """Return the cells of a column of text or whole numbers as text."""
        cells: Sequence[Any] = self.columns[column]
        for row, cell in enumerate(cells):
            if not isinstance(cell, str | int | None):
                raise self.fail(row, column, f"{cell!r} is not a label; expected text or a whole number")
        return ["" if cell is None else str(cell) for cell in cells]

    def parsed(self, column: str, empty: float | None) -> FloatArray:
        """Return a column of numbers, shape (rows,); there must be one in every row."""
        cells: Sequence[Any] = self.columns[column]
        for row, cell in enumerate(cells):
            if isinstance(cell, str | bool) or cell is None:
                raise self.fail(row, column, f"{'is empty' if cell is None else repr(cell)}; expected a number")
        return np.array(cells, dtype=np.float64)


@contextmanager
def opened_parquet(path: Path) -> Iterator[Any]:
    """Open a Parquet file; InputError without pyarrow, and for a file that is damaged or something else."""
    try:
        import pyarrow
        from pyarrow import parquet  # imported here: an optional extra
    except ImportError:
        message = "is a Parquet file, which pyarrow reads; install compgen[parquet], or save the readings as CSV"
        raise InputError(message, file=path) from None
    try:
        with parquet.ParquetFile(path) as file:
            yield file
    except FileNotFoundError as error:
        raise InputError(Message("file-missing", "no such file"), file=path) from error
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(f"is not a Parquet file, or is damaged: {error}", file=path) from error


def parquet_parts(path: str | Path) -> Iterator[ParquetTable]:
    """Read lengths from a Parquet file in parts: columns as in a CSV file, key-value metadata for its comments.

    Raises
    ------
    InputError
        for a missing column or a file without rows, and as :func:`opened_parquet`.
    """
    source, first = Path(path), 1
    with opened_parquet(source) as file:
        known = file.schema_arrow.metadata or {}
        metadata = {key.decode(): value.decode("utf-8", "replace") for key, value in known.items() if b":" not in key}
        kept = list(kept_columns(source, 1, file.schema_arrow.names, *LENGTHS.columns).values())
        for batch in file.iter_batches(CHUNK, columns=kept):
            columns = {name: batch.column(name).to_pylist() for name in kept}
            yield ParquetTable(source, columns, range(first, first + batch.num_rows), metadata)
            first += batch.num_rows
    if first == 1:
        raise InputError("contains no readings", file=source)


def parquet_table(path: str | Path) -> ParquetTable:
    """Read lengths from a whole Parquet file; InputError for more than ``MOST_WHOLE`` readings, or one given twice."""
    with opened_parquet(Path(path)) as file:
        if file.metadata.num_rows > MOST_WHOLE:
            raise too_many(Path(path), file.metadata.num_rows)
    parts = list(parquet_parts(path))
    columns = {name: list(chain.from_iterable(part.columns[name] for part in parts)) for name in parts[0].columns}
    whole = ParquetTable(Path(path), columns, range(1, 1 + sum(map(len, parts))), parts[0].metadata)
    LENGTHS.with_different_rows(whole)
    return whole


def too_many(path: Path, count: int) -> InputError:
    """Return the error about a file whose readings cannot be in memory together."""
    text = f"contains {count} readings; more than {MOST_WHOLE} can only be identified (volcomp identify, run)"
    return InputError(text, file=path)


def open_large(path: str | Path) -> LengthArchive | None:
    """Return the readings of a file that is too large to be read whole; None for other files.

    These are archives and Parquet files of more than ``MOST_WHOLE`` readings, and CSV files of lengths of more than
    ``LARGE_TEXT`` bytes. Of a Parquet or CSV file a copy in binary form is made.
    """
    source, name = Path(path), str(path).lower()
    if name.endswith(ARCHIVE):
        archive = open_archive(source)
        return archive if len(archive) > MOST_WHOLE else None
    if name.endswith(PARQUET):
        with opened_parquet(source) as file:
            large = file.metadata.num_rows > MOST_WHOLE
        return copied_archive(lambda: parquet_parts(source)) if large else None
    if not may_be_large(source) or detect_format(source) != "lengths":
        return None
    return copied_archive(lambda: csv_parts(source, *LENGTHS.columns))
