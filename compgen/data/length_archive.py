"""Tracer lengths in binary form (``*.lengths.npz``): for measurements on the fly, never all in memory."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from compgen.data.lengths import MOST_WHOLE, Lengths
from compgen.data.records import COVARIATE_COLUMNS, LABEL_COLUMNS, POSITION_COLUMNS
from compgen.errors import InputError

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

    ``columns`` have the names of a ``*.lengths.csv`` file, each (n,); ``station`` is an index into ``stations``.
    """

    path: Path
    stations: tuple[str, ...]
    columns: Mapping[str, Column]
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of readings."""
        return self.columns["length_mm"].shape[0]

    def chunks(self) -> Iterator[slice]:
        """Rows in memory at a time."""
        return (slice(first, min(first + CHUNK, len(self))) for first in range(0, len(self), CHUNK))

    def check(self, look: Callable[[int, NDArray[np.float64]], None] = lambda *_: None) -> None:
        """Raise InputError for numbers that are not finite, and for stations that are not in the list.

        ``look`` gets the first row and the positions (3, k) of each chunk.
        """
        for rows in self.chunks():
            found = np.stack([self.columns[name][rows] for name in (*POSITION_COLUMNS, "length_mm")]).astype(np.float64)
            if not np.isfinite(found.sum()):  # not finite if any number is not
                for k, name in enumerate((*POSITION_COLUMNS, "length_mm")):
                    for row in np.flatnonzero(~np.isfinite(found[k]))[:1].tolist():
                        message = f"reading {rows.start + row + 1} is not a finite number"
                        raise InputError(message, file=self.path, field=name)
            look(rows.start, found[:3])
            station = self.columns["station"][rows]
            if station.min() < 0 or station.max() >= len(self.stations):
                message = f"contains a number that is not one of the {len(self.stations)} stations, 0 to "
                raise InputError(f"{message}{len(self.stations) - 1}", file=self.path, field="station")

    def taken(self, rows: slice | NDArray[np.int64]) -> Lengths:
        """Return some of the readings; their points are numbered by row."""
        found = {name: column[rows] for name, column in self.columns.items()}
        numbers = np.arange(len(self))[rows] if isinstance(rows, slice) else rows
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
            origin=[(str(self.path), int(number) + 1) for number in numbers],
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
        raise InputError("no such file", file=source) from error
    except (zipfile.BadZipFile, ValueError, EOFError, struct.error, OSError) as error:
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
        message = (
            f"contains {len(archive)} readings; more than {MOST_WHOLE} can only be identified (volcomp identify, run)"
        )
        raise InputError(message, file=archive.path)
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
