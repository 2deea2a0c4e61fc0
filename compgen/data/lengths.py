"""Laser-tracer lengths (``*.lengths.csv``) and lists of commanded points (``*.points.csv``): records, readers, writers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import labels_of, paths_of, whole_numbers
from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.records import (
    APPROACH,
    ARCHIVE,
    COVARIATES,
    LABELS,
    PARQUET,
    POSITION,
    POSITION_COLUMNS,
    TOOL,
    Field,
    Schema,
    check_rows,
    within,
)
from compgen.drawing.display import Displayed, Overview, Tabular, ranges_of, shortened
from compgen.errors import InputError

#: Archives of at most this many readings are read whole, like text files.
MOST_WHOLE = 200_000

__all__ = [
    "POSITION_COLUMNS",
    "Lengths",
    "Points",
    "format_lengths",
    "format_points",
    "read_lengths",
    "read_points",
]


@dataclass(frozen=True, repr=False)
class Lengths(Displayed, Tabular):
    """Displacement readings of one or more tracer stations; n readings, S stations.

    Parameters
    ----------
    stations : names of the stations.
    station : index into ``stations`` of each reading, shape (n,).
    point : label of the target point of each reading.
    position_mm : commanded positions, shape (n, 3).
    length_mm : readings, the true distance minus an unknown constant per station and set-up, shape (n,).
    tool_mm : tool offset of each reading, shape (n, 3), or None for that of the machine file.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    labels : whole-number labels by column name (run, line, repeat, block, setup, pose), each of shape (n,).
    covariates : other numbers by column name (``time_s``, ``temp_...``, ...), each of shape (n,).
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each reading, for messages.

    Examples
    --------
    >>> import compgen
    >>> lengths = compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> lengths
    <Lengths: 10648 readings of LT1, LT2, LT3, LT4>
    >>> lengths.position_mm.shape, lengths.length_mm.shape
    ((10648, 3), (10648,))
    >>> r, k = lengths, slice(9)
    >>> few = compgen.Lengths(r.stations, r.station[k], r.point[k], r.position_mm[k], r.length_mm[k])
    >>> len(few)
    9
    """

    stations: tuple[str, ...]
    station: NDArray[np.int64]
    point: Sequence[str]
    position_mm: FloatArray
    length_mm: FloatArray
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __post_init__(self) -> None:
        check_rows(self, names=("length_mm",))
        count, stations = len(self.length_mm), len(labels_of("stations", self.stations))
        object.__setattr__(self, "station", whole_numbers("station", self.station, count))
        if count and (self.station.min() < 0 or self.station.max() >= stations):
            text = f"goes from {self.station.min()} to {self.station.max()}; expected indices of {stations} stations"
            raise InputError(text, field="station")
        if len(labels_of("point", self.point)) != count:
            raise InputError(f"has {len(self.point)} labels for {count} readings", field="point")

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.lengths.csv``, each (n,)."""
        return _with_names(self).cells(self)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.length_mm)

    def part(self, rows: NDArray[Any]) -> Lengths:
        """Return some of the readings, ``rows`` as an index or a mask (n,); all stations keep their number."""
        chosen = np.arange(len(self))[rows].tolist()
        return replace(
            self,
            station=self.station[rows],
            point=[self.point[k] for k in chosen],
            position_mm=self.position_mm[rows],
            length_mm=self.length_mm[rows],
            tool_mm=None if self.tool_mm is None else self.tool_mm[rows],
            approach=None if self.approach is None else self.approach[rows],
            labels={name: values[rows] for name, values in self.labels.items()},
            covariates={name: values[rows] for name, values in self.covariates.items()},
            origin=[self.origin[k] for k in chosen] if len(self.origin) else (),
        )

    def overview(self) -> Overview:
        """Number of readings of each station."""
        counts = np.bincount(self.station, minlength=len(self.stations))
        rows = tuple((name, str(count)) for name, count in zip(self.stations, counts, strict=True))
        return Overview(f"{len(self)} readings of {shortened(self.stations)}", ("station", "readings"), rows)


#: The columns of lengths.
LENGTHS = Schema(
    (
        Field("station", ("station",), CsvTable.names),
        Field("point", ("point",), CsvTable.text),
        POSITION,
        Field("length_mm", ("length_mm",), within(1e6, "mm", "more than a kilometre; is the unit mm?"), digits=7),
        LABELS,
        APPROACH,
        TOOL,
        replace(COVARIATES, digits=3),
    ),
    keys=("station", "point"),
)


def read_lengths(files: str | Path | Sequence[str | Path]) -> Lengths:
    """Read one or more ``*.lengths.csv`` (or ``*.lengths.npz``, ``*.parquet``) files into one :class:`Lengths`.

    Labels that only some of the files have are 0 in the others; the same station in two files is one station.

    Examples
    --------
    >>> import compgen
    >>> compgen.read_lengths("examples/zha-gantry.lengths.csv").metadata["instrument"]
    'laser-tracer'
    """
    sources = paths_of("files", files)
    binary = [source for source in sources if str(source).lower().endswith((ARCHIVE, PARQUET))]
    parts = []
    text = [source for source in sources if source not in binary]
    tables = LENGTHS.read_tables(text) if text or not binary else []
    if binary:
        from compgen.data.length_archive import parquet_table, read_archive  # imported here: they depend on this module

        parts = [read_archive(source) for source in binary if str(source).lower().endswith(ARCHIVE)]
        tables += [parquet_table(source) for source in binary if str(source).lower().endswith(PARQUET)]
    for values in map(LENGTHS.values, tables):
        stations = tuple(dict.fromkeys(values["station"]))
        parts.append(Lengths(**values | {"stations": stations, "station": _numbered(values["station"], stations)}))
    return join_lengths(parts)


def _numbered(names: Iterable[str], stations: Sequence[str]) -> NDArray[np.int64]:
    index = {name: k for k, name in enumerate(stations)}
    return np.array([index[name] for name in names], dtype=np.int64)


def join_lengths(parts: Sequence[Lengths]) -> Lengths:
    """Return several records as one; stations of the same name are one station."""
    stations = tuple(dict.fromkeys(name for part in parts for name in part.stations))
    numbers = [_numbered(part.stations, stations)[part.station] for part in parts]
    known = [replace(part, stations=stations, station=number) for part, number in zip(parts, numbers, strict=True)]
    return LENGTHS.joined(known)


def format_lengths(lengths: Lengths) -> str:
    """Return the text of a ``*.lengths.csv`` file: positions with 6 decimals (1 nm), lengths with 7."""
    return _with_names(lengths).format(lengths, lengths.metadata)


def _with_names(lengths: Lengths) -> Schema:
    named = replace(LENGTHS.fields[0], encode=lambda station: [lengths.stations[k] for k in station])
    return replace(LENGTHS, fields=(named, *LENGTHS.fields[1:]))


# Lists of commanded points (``*.points.csv``), with or without results.


@dataclass(frozen=True, repr=False)
class Points(Displayed):
    """Commanded points, n of them.

    Parameters
    ----------
    position_mm : shape (n, 3).
    tool_mm : tool offset at each point, shape (n, 3), or None for that of the machine file.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    covariates : other numbers by column name (time_s, feed_mm_min, load_kg, setup, temp_<name>_c), each (n,).

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> points = compgen.Points(np.array([[0.0, 0.0, 0.0], [100.0, 50.0, 20.0]]))
    >>> len(points)
    2
    """

    position_mm: FloatArray
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_rows(self)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)

    def tools(self, rows: slice) -> FloatArray | None:
        """Tool offsets of some of the points, None for that of the machine file."""
        return None if self.tool_mm is None else self.tool_mm[rows]

    def overview(self) -> Overview:
        """Number of points, and their bounding box."""
        return Overview(f"{len(self)} points", ("axis", "from (mm)", "to (mm)"), ranges_of(self.position_mm))


_POINTS = Schema(
    (
        POSITION,
        TOOL,
        replace(APPROACH, presence="complete", digits=6),
        # columns on which effects of a machine may depend
        Field("covariates", ("time_s", "feed_mm_min", "load_kg", "setup"), presence="covariates"),
    )
)


def read_points(path: str | Path) -> Points:
    r"""Read a ``*.points.csv`` file; tool and approach columns are optional, but each complete.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import compgen
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "two.points.csv"
    ...     with path.open("w") as file:
    ...         print("x_mm,y_mm,z_mm", "0,0,0", "100,50,20", sep="\n", file=file)
    ...     points = compgen.read_points(path)
    >>> points
    <Points: 2 points>
    """
    table = _POINTS.read_table(path)
    return Points(**{field.name: field.of_table(table) for field in _POINTS.fields})


def format_points(
    points: Points, results: Mapping[str, FloatArray], metadata: Mapping[str, object] | None = None
) -> str:
    """Return CSV text of the points with result columns (each of shape (n,)) after them, 6 decimals."""
    return _POINTS.format(points, metadata or {}, results)
