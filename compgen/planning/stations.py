"""Planned stations, and the regions in which they may be placed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers, of_kind
from compgen.data.csv_files import FloatArray, format_csv, read_csv
from compgen.data.lengths import POSITION_COLUMNS
from compgen.data.machine import Machine
from compgen.errors import InputError, Message, nearest, one_line

#: Columns of the ``stations.csv`` of ``volcomp identify`` that a plan does not need.
_OF_IDENTIFY = (
    *(f"u_{axis}_um" for axis in "xyz"),
    "dead_length_mm",
    "u_dead_length_um",
    "readings",
    "residual_rms_um",
    "segment",
)
_BOX_COLUMNS = tuple(f"{axis}_{end}_mm" for axis in "xyz" for end in ("min", "max"))

#: The shell in which stations may be placed without a box: at this distance from the footprint of the working volume,
#: and at this height above its lowest tool tip, the level of the table.
SHELL_NEAR_MM, SHELL_FAR_MM, SHELL_HEIGHT_MM = 100.0, 600.0, 300.0


@dataclass(frozen=True)
class PlannedStations:
    """Stations of a planned measurement.

    Parameters
    ----------
    names : one for each station, S of them.
    position_mm : in the workpiece frame, shape (S, 3).
    passes : station index and set-up of each pass, shape (p, 2); in a pass a station reads every point once, and each
    pass has its own dead length.
    """

    names: tuple[str, ...]
    position_mm: FloatArray
    passes: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.names)

    def moved(self, position_mm: FloatArray) -> PlannedStations:
        """Return the same stations at other places (S, 3)."""
        return PlannedStations(self.names, position_mm, self.passes)


def planned_stations(positions: Mapping[str, Sequence[float]]) -> PlannedStations:
    """Return stations by name, with one pass each.

    Examples
    --------
    >>> import compgen
    >>> stations = compgen.planned_stations({"LT1": (158.8, -1456.7, -349.7), "LT2": (-113.1, -1671.7, -349.4)})
    >>> stations.names
    ('LT1', 'LT2')
    """
    of_kind("positions", positions, Mapping)
    index = np.arange(len(positions))
    where = np.array([numbers(f"positions[{name}]", place, 3) for name, place in positions.items()]).reshape(-1, 3)
    return PlannedStations(tuple(positions), where, np.column_stack([index, 0 * index]))


def read_stations(path: str | Path) -> PlannedStations:
    """Read a stations file: ``station, x_mm, y_mm, z_mm``, optional ``setup``; the file of ``volcomp identify`` is valid, too.

    A station with several set-ups has a row for each, at one place.
    """
    table = read_csv(path, required=("station", *POSITION_COLUMNS), optional=("setup", *_OF_IDENTIFY))
    names = table.names("station")
    where = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    setup = table.labels("setup") if "setup" in table.columns else np.zeros(len(table), dtype=np.int64)
    known = tuple(dict.fromkeys(names))
    position_mm = np.zeros((len(known), 3))
    first: dict[tuple[str, int | None], int] = {}
    main = table.labels("segment") == 0 if "segment" in table.columns else np.ones(len(table), dtype=bool)
    kept = np.flatnonzero(main).tolist()  # dead lengths added by a beam break are not planned set-ups
    for row in kept:
        name = names[row]
        earlier = first.setdefault((name, None), row)
        if first.setdefault((name, int(setup[row])), row) != row:
            raise table.fail(
                row, "station", f"{one_line(name)!r} is listed twice; distinguish set-ups by a column setup"
            )
        if np.max(np.abs(where[row] - where[earlier])) > 1e-6:
            message = (
                f"{one_line(name)!r} is at a different position than in line {table.lines[earlier]}; a tracer that was "
                "moved is another station"
            )
            raise table.fail(row, "x_mm", message)
        position_mm[known.index(name)] = where[row]
    station = np.array([known.index(names[row]) for row in kept])
    return PlannedStations(known, position_mm, np.column_stack([station, setup[kept]]))


def format_stations(stations: PlannedStations, machine: Machine) -> str:
    """Return the text of a stations file."""
    station = stations.passes[:, 0]
    where = stations.position_mm[station]
    columns: dict[str, Sequence[str] | FloatArray] = {
        "station": [stations.names[k] for k in station],
        "setup": [str(setup) for setup in stations.passes[:, 1]],
        **{name: where[:, k] for k, name in enumerate(POSITION_COLUMNS)},
    }
    return format_csv(columns, {"machine": machine.name, "source": "compgen plan"}, dict.fromkeys(POSITION_COLUMNS, 3))


# --- where stations may be placed ----------------------------------------------------------------------------------


class Region(Protocol):
    """A set of places, parametrised by three numbers between 0 and 1."""

    def place(self, unit: FloatArray) -> FloatArray:
        """Return the place (3,) in mm of numbers (3,)."""

    def unit(self, place_mm: FloatArray) -> FloatArray:
        """Return the numbers (3,) of a place (3,) in mm, or of the nearest one in the region."""


@dataclass(frozen=True)
class Box:
    """A box ``lower_mm`` ... ``upper_mm``, each (3,); a box may be flat."""

    lower_mm: FloatArray
    upper_mm: FloatArray

    def place(self, unit: FloatArray) -> FloatArray:
        """Return the place for numbers between 0 and 1."""
        return np.asarray(self.lower_mm + unit * (self.upper_mm - self.lower_mm))

    def unit(self, place_mm: FloatArray) -> FloatArray:
        """Return the numbers of a place; one outside is moved to the nearest inside."""
        size = self.upper_mm - self.lower_mm
        return np.clip((place_mm - self.lower_mm) / np.where(size > 0, size, 1.0), 0.0, 1.0)


@dataclass(frozen=True)
class Shell:
    """The places around a footprint: along its outline, outwards from it, upwards from the table.

    Parameters
    ----------
    centre_mm, half_mm : of the footprint in X and Y, each (2,).
    table_mm : height of the table.
    """

    centre_mm: FloatArray
    half_mm: FloatArray
    table_mm: float

    def place(self, unit: FloatArray) -> FloatArray:
        """Return the place for the share of the outline, of the distance, and of the height."""
        outwards = SHELL_NEAR_MM + unit[1] * (SHELL_FAR_MM - SHELL_NEAR_MM)
        # the outline starts at the lower left corner to the right; (x, y) by the length along it
        a, b = (float(half) for half in self.half_mm + outwards)
        along = (float(unit[0]) % 1.0) * 4 * (a + b)
        if along < 2 * a:
            x, y = along - a, -b
        elif along < 2 * a + 2 * b:
            x, y = a, along - 2 * a - b
        elif along < 4 * a + 2 * b:
            x, y = 3 * a + 2 * b - along, b
        else:
            x, y = -a, 4 * a + 3 * b - along
        return np.array([*(self.centre_mm + [x, y]), self.table_mm + unit[2] * SHELL_HEIGHT_MM])

    def unit(self, place_mm: FloatArray) -> FloatArray:
        """Return the shares of a place; one that is too near, far, low or high is moved to the nearest."""
        offset = place_mm[:2] - self.centre_mm
        outwards = float(np.max(np.abs(offset) - self.half_mm))
        half = self.half_mm + max(outwards, 0.0)
        if outwards < 0:  # inside: perpendicular to the nearest side
            side = int(np.argmax(np.abs(offset) - self.half_mm))
            offset = offset.copy()
            offset[side] = np.copysign(half[side], offset[side])
        far = (outwards - SHELL_NEAR_MM) / (SHELL_FAR_MM - SHELL_NEAR_MM)
        high = (place_mm[2] - self.table_mm) / SHELL_HEIGHT_MM
        (a, b), (x, y) = (float(size) for size in half), (float(part) for part in offset)
        side = int(np.argmin(np.abs([y + b, x - a, y - b, x + a])))
        along = (x + a, 2 * a + y + b, 3 * a + 2 * b - x, 4 * a + 3 * b - y)[side]
        share = float(np.clip(along / (4 * (a + b)), 0.0, 1.0 - 1e-12))
        return np.array([share, *np.clip([far, high], 0.0, 1.0)])


def shell_around(machine: Machine) -> Shell:
    """Return the shell around the working volume of the tool tip, with the table at its lowest level."""
    tool = np.array(machine.tool_offset_mm)
    lower, upper = machine.lower_mm + tool, machine.upper_mm + tool
    return Shell(0.5 * (lower + upper)[:2], 0.5 * (upper - lower)[:2], float(lower[2]))


def regions_of(machine: Machine, stations: PlannedStations, boxes: Mapping[str, Box]) -> list[Region]:
    """Return the region of each station: its box, otherwise the shell around the table.

    Raises
    ------
    InputError
        for a box of a station that does not exist.
    """
    for name in boxes:
        if name not in stations.names:
            raise InputError(
                Message(
                    "box-without-station",
                    "the box {name!r} belongs to no station; {suggestion}",
                    name=one_line(name),
                    suggestion=nearest(name, stations.names),
                )
            )
    shell = shell_around(machine)
    return [boxes.get(name, shell) for name in stations.names]


def box_from_text(text: str) -> tuple[str, Box]:
    """Read ``LABEL:xmin,xmax,ymin,ymax,zmin,zmax`` in mm."""
    label, colon, rest = text.rpartition(":")
    try:
        values = np.array([float(part) for part in rest.split(",")])
    except ValueError:
        values = np.zeros(0)
    if not colon or not label or len(values) != 6 or not np.isfinite(values).all():
        raise InputError(
            Message(
                "box-not-readable", "{text!r} is not LABEL:xmin,xmax,ymin,ymax,zmin,zmax (mm)", text=one_line(text)
            ),
            field="--box",
        )
    if np.any(values[0::2] > values[1::2]):
        raise InputError(
            Message("box-limits-crossed", "{text!r} has a lower limit above the upper one", text=one_line(text)),
            field="--box",
        )
    return label, Box(values[0::2], values[1::2])


def read_boxes(path: str | Path) -> dict[str, Box]:
    """Read a boxes file: ``station, x_min_mm, x_max_mm, y_min_mm, y_max_mm, z_min_mm, z_max_mm``."""
    table = read_csv(path, required=("station", *_BOX_COLUMNS))
    values = np.column_stack([table.numbers(name) for name in _BOX_COLUMNS])
    boxes: dict[str, Box] = {}
    for row, name in enumerate(table.names("station")):
        if name in boxes:
            raise table.fail(row, "station", f"{one_line(name)!r} is listed twice")
        lower, upper = values[row, 0::2], values[row, 1::2]
        if np.any(lower > upper):
            axis = int(np.argmax(lower > upper))
            raise table.fail(row, _BOX_COLUMNS[2 * axis], f"{lower[axis]:g} is above the upper limit {upper[axis]:g}")
        boxes[name] = Box(lower, upper)
    return boxes
