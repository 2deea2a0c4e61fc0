"""Circular tests (ballbar, or any radial gauge; ISO 230-4): ``*.circle.csv``, record, reader and writer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.names import MM_PER_UM
from compgen.data.records import DIRECTION, RUN_DEVIATION, Field, Schema, one_of, uncertainties, within
from compgen.drawing.display import Displayed, Overview, Tabular
from compgen.errors import InputError

#: First and second axis of each plane; angles count from the first to the second.
PLANES = {"XY": (0, 1), "YZ": (1, 2), "ZX": (2, 0)}
#: Largest radius of a circular test, mm; a larger one is taken as a wrong unit.
LARGEST_RADIUS_MM = 1e4


@dataclass(frozen=True, repr=False)
class Circles(Displayed, Tabular):
    """Radial deviations along circles in planes of two axes, n readings.

    Parameters
    ----------
    plane : number of the plane in the order of :data:`PLANES`, (n,).
    angle_rad : angle from the first axis of the plane to the second, (n,).
    radius_mm : nominal radius, (n,).
    deviation_mm : actual minus nominal radius, (n,).
    direction : +1 counter-clockwise (from the first axis to the second), -1 clockwise, (n,).
    run : number of the run, (n,).
    setup : number of the set-up; readings of one share the centre and the zero of the gauge, (n,).
    centre_mm : commanded centre, (n, 3); nan where the file does not state it.
    u_mm : standard uncertainty of each reading (n,), nan where unknown.
    covariates : further numbers by column name (feed_mm_min, time_s, temp_..._c), each of shape (n,).
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each row, for messages.
    """

    plane: NDArray[np.int64]
    angle_rad: FloatArray
    radius_mm: FloatArray
    deviation_mm: FloatArray
    direction: NDArray[np.int64]
    run: NDArray[np.int64]
    setup: NDArray[np.int64]
    centre_mm: FloatArray
    u_mm: FloatArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.circle.csv``, each (n,)."""
        return _CIRCLES.cells(self)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.angle_rad)

    @property
    def planes(self) -> tuple[str, ...]:
        """Planes that were measured."""
        return tuple(name for k, name in enumerate(PLANES) if (self.plane == k).any())

    def part(self, rows: NDArray[np.int64]) -> Circles:
        """Return some of the readings."""
        columns = ("plane", "angle_rad", "radius_mm", "deviation_mm", "direction", "run", "setup", "centre_mm", "u_mm")
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in columns},
            covariates={name: values[rows] for name, values in self.covariates.items()},
            origin=[self.origin[k] for k in rows] if self.origin else (),
        )

    def radial(self) -> FloatArray:
        """Unit vectors from the centre outwards, (n, 3)."""
        unit = np.zeros((len(self), 3))
        axes = np.array(list(PLANES.values()))[self.plane]
        rows = np.arange(len(self))
        unit[rows, axes[:, 0]] = np.cos(self.angle_rad)
        unit[rows, axes[:, 1]] = np.sin(self.angle_rad)
        return unit

    def travel(self) -> FloatArray:
        """Direction of travel of each axis, +1, -1 or 0, (n, 3)."""
        way = np.zeros((len(self), 3))
        axes = np.array(list(PLANES.values()))[self.plane]
        rows = np.arange(len(self))
        way[rows, axes[:, 0]] = -self.direction * np.sign(np.round(np.sin(self.angle_rad), 12))
        way[rows, axes[:, 1]] = self.direction * np.sign(np.round(np.cos(self.angle_rad), 12))
        return way

    def overview(self) -> Overview:
        """Number of readings by plane, radius and direction."""
        rows = []
        for k, name in enumerate(PLANES):
            for radius in np.unique(self.radius_mm[self.plane == k]).tolist():
                own = (self.plane == k) & (self.radius_mm == radius)
                ways = "both directions" if len(np.unique(self.direction[own])) == 2 else "one direction"
                rows.append((name, f"{radius:g}", str(int(own.sum())), ways))
        return Overview(
            f"{len(self)} readings along circles in {', '.join(self.planes)}",
            ("plane", "radius (mm)", "readings", "directions"),
            tuple(rows),
        )


def arcs_of(angle_rad: FloatArray, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the readings ``rows`` of one path in the order of their angles, an array for each arc.

    A full circle is one arc that ends with its first reading; a gap of more than 3 degrees and 3 steps ends an arc.
    """
    angle = angle_rad[rows] % (2 * np.pi)
    order = np.argsort(angle, kind="stable")
    rows, angle = rows[order], angle[order]
    gaps = np.diff(angle, append=angle[0] + 2 * np.pi)
    ends = np.flatnonzero(gaps > max(3.0 * float(np.median(gaps)), np.radians(3.0))) + 1
    if not len(ends):
        return [np.append(rows, rows[0])]
    first = int(ends[-1]) % len(rows)
    return np.split(np.roll(rows, -first), ends[:-1] + len(rows) - int(ends[-1]))


_CIRCLES = Schema(
    (
        Field("plane", ("plane",), one_of(PLANES, "a plane"), encode=lambda planes: [list(PLANES)[k] for k in planes]),
        Field("angle_rad", ("angle_deg",), unit=float(np.pi / 180.0), digits=6),
        Field("radius_mm", ("radius_mm",), within(LARGEST_RADIUS_MM, "mm", "more than 10 m; is the unit mm?")),
        RUN_DEVIATION,
        DIRECTION,
        Field("run", ("run",), CsvTable.labels, presence="filled", fill=0, digits=0),
        Field("setup", ("setup",), CsvTable.labels, presence="filled", fill=0, digits=0),
        Field("centre_mm", ("centre_x_mm", "centre_y_mm", "centre_z_mm"), presence="filled"),
        Field("u_mm", ("u_deviation_um",), uncertainties, 1e-3, presence="filled", digits=4),
        Field("covariates", ("feed_mm_min", "time_s"), presence="covariates"),
    )
)


def read_circles(files: str | Path | Sequence[str | Path]) -> Circles:
    """Read one or more ``*.circle.csv`` files into one :class:`Circles`, um to mm; each file has separate set-ups.

    Raises
    ------
    InputError
        for a plane other than XY, YZ and ZX (angles would turn the other way), a direction that is not 1 or -1, a
        centre with a missing coordinate.
    """
    parts = []
    for table in _CIRCLES.read_tables(files):
        values = _CIRCLES.values(table)
        found = Circles(**values)
        for row in np.flatnonzero(found.radius_mm <= 0)[:1].tolist():
            text = f"{found.radius_mm[row]:g} is not a radius; it must be above zero"
            raise table.fail(row, "radius_mm", text)
        partly = np.isnan(found.centre_mm).any(axis=1) & ~np.isnan(found.centre_mm).all(axis=1)
        if partly.any():
            given = [name for name in ("centre_x_mm", "centre_y_mm", "centre_z_mm") if name in table.columns]
            text = f"has {' and '.join(given)}; give centre_x_mm, centre_y_mm and centre_z_mm, or none of them"
            raise InputError(text, file=table.path)
        parts.append(replace(found, run=found.run.astype(np.int64)))
    return join_circles(parts)


def join_circles(parts: Sequence[Circles]) -> Circles:
    """Return several records as one, whose set-ups are numbered differently."""
    renumbered, first = [], 0
    for part in parts:
        _, setup = np.unique(part.setup, return_inverse=True)
        renumbered.append(replace(part, setup=setup.ravel().astype(np.int64) + first))
        first = int(renumbered[-1].setup.max()) + 1
    return _CIRCLES.joined(renumbered)


def format_circles(circles: Circles) -> str:
    """Return the text of a ``*.circle.csv`` file: angles in degrees with 6 decimals, deviations in um with 4."""
    return _CIRCLES.format(circles, circles.metadata)


#: Columns of a polar diagram.
DIAGRAM = ("plane", "angle_deg", "radius_mm", "direction", "run", "setup", "deviation_um")


def circle_columns(circles: Circles) -> dict[str, Sequence[str] | FloatArray]:
    """Return what a polar diagram needs of circles, by column, each (n,)."""
    numbers = {
        "angle_deg": np.degrees(circles.angle_rad),
        "radius_mm": circles.radius_mm,
        "direction": circles.direction.astype(np.float64),
        "run": circles.run.astype(np.float64),
        "setup": circles.setup.astype(np.float64),
        "deviation_um": circles.deviation_mm / MM_PER_UM,
    }
    names = list(PLANES)
    return {"plane": [names[k] for k in circles.plane.tolist()], **numbers}


def circles_of_columns(table: CsvTable) -> Circles | None:
    """Return circles from the columns of :func:`circle_columns`; None if the table has none or another plane."""
    if any(name not in table.columns for name in DIAGRAM):
        return None
    planes, names = table.text("plane"), list(PLANES)
    if not planes or any(name not in names for name in planes):
        return None
    whole = {name: table.numbers(name).astype(np.int64) for name in ("direction", "run", "setup")}
    unknown = np.full(len(planes), np.nan)
    return Circles(
        np.array([names.index(name) for name in planes]),
        np.radians(table.numbers("angle_deg")),
        table.numbers("radius_mm"),
        table.numbers("deviation_um") * MM_PER_UM,
        whole["direction"],
        whole["run"],
        whole["setup"],
        np.full((len(planes), 3), np.nan),
        unknown,
    )
