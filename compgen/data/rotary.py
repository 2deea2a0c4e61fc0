"""Errors of rotary axes (ISO 230-1, ISO 230-7), and sphere centres found at poses of a machine with rotary axes.

A rotary axis has six error motions over its angle (``EXC`` ... ``ECC``), and constants of its position: for C the offsets
``EX0C``, ``EY0C``, the tilts ``EA0C``, ``EB0C`` and the zero ``EC0C``. Files are in um, urad and degrees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers
from compgen.data.csv_files import CsvTable, FloatArray, csv_table, format_csv, names_in_header, read_csv
from compgen.data.error_table import ErrorTable, parse_errors
from compgen.data.files import read_text
from compgen.data.machine import ROTARY, Machine
from compgen.data.names import AXES, ERROR_NAMES, MM_PER_UM, RAD_PER_URAD
from compgen.data.records import (
    DEVIATION_COLUMNS,
    POSITION_COLUMNS,
    TEMPERATURES,
    TOOL_COLUMNS,
    ReadColumn,
    deviations_um,
    directions,
    uncertainties,
    within,
)
from compgen.drawing.display import Displayed, Overview
from compgen.errors import InputError, nearest

# Names and units.


def motion_names(letter: str) -> tuple[str, ...]:
    """Error motions of a rotary axis: three translations, three rotations, e.g. EXC ... ECC."""
    return tuple(f"E{part}{letter}" for part in "XYZABC")


def position_names(letter: str) -> tuple[str, ...]:
    """Constants of the position of its axis line: two offsets, two tilts across it, then its zero, e.g. EX0C ... EC0C."""
    along = ROTARY.index(letter)
    across = [k for k in range(3) if k != along]
    return (
        *(f"E{AXES[k]}0{letter}" for k in across),
        *(f"E{ROTARY[k]}0{letter}" for k in across),
        f"E{letter}0{letter}",
    )


ROTARY_NAMES: tuple[str, ...] = tuple(
    name for letter in ROTARY for name in (*motion_names(letter), *position_names(letter))
)
#: Offset of the gauge point of the spindle in the last body, from the nominal one: it turns with a rotary head.
SPINDLE = ("TX", "TY", "TZ")
#: By name: letter of the axis (none: of the spindle), component of its small motion (0 to 5: X, Y, Z, A, B, C), constant
#: or not.
_PLACES: dict[str, tuple[str, int, bool]] = {
    name: (name[-1], "XYZABC".index(name[1]), name[2] == "0") for name in ROTARY_NAMES
} | {name: ("", k, True) for k, name in enumerate(SPINDLE)}


def si_per_unit(name: str) -> float:
    """Factor from the unit of files (um or urad) to mm or rad."""
    return MM_PER_UM if name[1] in AXES else RAD_PER_URAD


def unit_of(name: str) -> str:
    """Unit in files."""
    return "um" if name[1] in AXES else "urad"


def axis_line_name(name: str) -> str:
    """Name by ISO 230-7 of an offset or tilt of an axis line; empty for zeros, motions and the spindle.

    >>> axis_line_name("EX0C"), axis_line_name("EC0C"), axis_line_name("EXC")
    ('XOC', '', '')
    """
    letter, part, constant = _PLACES[name]
    own = not letter or not constant or part == 3 + ROTARY.index(letter)
    return "" if own else f"{name[1]}O{letter}"


def describe_rotary_error(name: str) -> str:
    """Return an error of a rotary axis in words.

    >>> describe_rotary_error("EA0C"), describe_rotary_error("EZC")
    ('Tilt of the axis line of C about X', 'Axial error motion of C')
    """
    letter, part, constant = _PLACES[name]
    toward, along = AXES[part % 3], letter != "" and part % 3 == ROTARY.index(letter)
    if not letter:
        return f"Gauge point of the spindle in {toward}"
    if constant:
        if along:
            return f"Zero of {letter}"
        return (
            f"Offset of the axis line of {letter} in {toward}"
            if part < 3
            else f"Tilt of the axis line of {letter} about {toward}"
        )
    if along:
        return f"Axial error motion of {letter}" if part < 3 else f"Positioning of {letter}"
    return (
        f"Radial error motion of {letter} in {toward}" if part < 3 else f"Tilt error motion of {letter} about {toward}"
    )


# Errors.

RAD_PER_ARCSEC = np.pi / 648000.0
#: Comment of an errors file with the reversal of an axis.
_REVERSAL = "reversal_{}_arcsec"


@dataclass(frozen=True)
class RotaryCurve:
    """One error motion over the angle: ``angle_deg`` ascending, ``value`` and ``u`` in mm or rad, shape (n,)."""

    angle_deg: FloatArray
    value: FloatArray
    u: FloatArray

    def __post_init__(self) -> None:
        for name in ("angle_deg", "value"):
            object.__setattr__(self, name, numbers(name, getattr(self, name), None))
        object.__setattr__(self, "u", numbers("u", self.u, None, unknown=True, least=0.0))
        if not len(self.angle_deg) == len(self.value) == len(self.u) > 0 or (np.diff(self.angle_deg) <= 0).any():
            raise InputError("expected one value and one u for each angle, angles ascending", field="angle_deg")

    def at(self, angle_deg: FloatArray, modulo_deg: float | None) -> FloatArray:
        """Value at angles, same shape: linear between nodes, periodic with ``modulo_deg``, else constant outside."""
        return np.interp(angle_deg, self.angle_deg, self.value, period=modulo_deg)


@dataclass(frozen=True, repr=False)
class RotaryErrors(Displayed):
    """Errors of rotary axes, mm and rad; one that is absent is zero. ``constants`` by name as (value, uncertainty).

    ``reversal`` by letter: mean angle reached in positive travel minus that in negative travel, rad; absent: not known.
    """

    curves: Mapping[str, RotaryCurve] = field(default_factory=dict)
    constants: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reversal: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for names, constant in ((self.curves, False), (self.constants, True)):
            for name in names:
                if name not in _PLACES or _PLACES[name][2] != constant:
                    what = "a constant of a rotary axis" if constant else "an error motion of a rotary axis"
                    raise InputError(f"{name!r} is not {what}; {nearest(name, _PLACES)}", field="errors")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors that are present."""
        return tuple(name for name in _PLACES if name in self.curves or name in self.constants)

    @property
    def spindle_mm(self) -> FloatArray:
        """Offset of the gauge point of the spindle (3,), mm."""
        return np.array([self.constants.get(name, (0.0, 0.0))[0] for name in SPINDLE])

    def motions(self, machine: Machine, angle_deg: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Small motions D (n, 6) of each rotary axis at angles (n,): mm and rad, zero at its reference."""
        found = {letter: np.zeros((len(angle), 6)) for letter, angle in angle_deg.items()}
        for name, curve in self.curves.items():
            letter, part, _ = _PLACES[name]
            if letter not in machine.rotary:
                continue
            axis = machine.rotary[letter]
            zero = curve.at(np.array([axis.reference_deg]), axis.modulo_deg)
            found[letter][:, part] = curve.at(angle_deg[letter], axis.modulo_deg) - zero
        return found

    def position(self, letter: str) -> FloatArray:
        """Position errors L (6,) of one rotary axis, mm and rad."""
        found = np.zeros(6)
        for name, (value, _) in self.constants.items():
            if _PLACES[name][0] == letter:
                found[_PLACES[name][1]] = value
        return found

    def overview(self) -> Overview:
        """Constants with their uncertainty, and the largest value of each motion."""
        rows = []
        for name in self.names:
            value, u = (
                self.constants[name]
                if name in self.constants
                else (self.curves[name].value[np.argmax(np.abs(self.curves[name].value))], np.max(self.curves[name].u))
            )
            unit = si_per_unit(name)
            rows.append((name, f"{value / unit:+.2f}", "" if np.isnan(u) else f"{u / unit:.2f}", unit_of(name)))
        return Overview(f"{len(rows)} errors of rotary axes", ("error", "value", "u (k = 1)", "unit"), tuple(rows))


def read_machine_errors(path: str | Path) -> tuple[ErrorTable, RotaryErrors]:
    """Read an ``*.errors.csv`` file with errors of linear (``position_mm``) and rotary axes (``position_deg``).

    Raises
    ------
    InputError
        for a name that is neither, an angle missing or given twice, with file, line and column.
    """
    text, source = read_text(path), Path(path)
    lines = text.splitlines()
    rotary = [line.split(",")[0].strip().lstrip("'") in _PLACES for line in lines]
    linear = "\n".join("" if own else line for line, own in zip(lines, rotary, strict=True)) + "\n"
    rest = [line for line in linear.splitlines() if line.strip() and not line.startswith("#")]
    if not any(rotary):
        return parse_errors(text, source), RotaryErrors()
    linear = "\n".join(line for line in linear.split("\n") if not line.startswith("# rows"))
    table = parse_errors(linear, source) if len(rest) > 1 else ErrorTable(metadata={})
    columns = csv_table(source, text, required=("error", "value"), optional=("position_mm", "position_deg", "u_value"))
    return table, _rotary_of(columns)


def _rotary_of(table: CsvTable) -> RotaryErrors:
    names, values = table.text("error"), table.numbers("value")
    u = table.numbers("u_value", empty=np.nan) if "u_value" in table.columns else np.full(len(table), np.nan)
    unknown = np.full(len(table), np.nan)
    angle = table.numbers("position_deg", empty=np.nan) if "position_deg" in table.columns else unknown
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        if name in _PLACES:
            rows.setdefault(name, []).append(row)
        elif name not in ERROR_NAMES:
            raise table.fail(row, "error", f"{name!r} is not an error; {nearest(name, (*ERROR_NAMES, *_PLACES))}")
    curves, constants = {}, {}
    for name, own in rows.items():
        unit = si_per_unit(name)
        if _PLACES[name][2]:
            if len(own) > 1:
                raise table.fail(own[1], "error", f"{name} appears a second time (first in line {table.lines[own[0]]})")
            constants[name] = (float(values[own[0]]) * unit, float(u[own[0]]) * unit)
            continue
        for row in own:
            if np.isnan(angle[row]):
                raise table.fail(row, "position_deg", f"is missing; {name} is a function of the angle in degrees")
        own = sorted(own, key=lambda row: float(angle[row]))
        for first, second in zip(own, own[1:], strict=False):
            if angle[first] == angle[second]:
                raise table.fail(second, "position_deg", f"{name} has two values at {angle[second]:g} degrees")
        curves[name] = RotaryCurve(angle[own], values[own] * unit, u[own] * unit)
    return RotaryErrors(curves, constants, _reversals(table))


def _reversals(table: CsvTable) -> dict[str, float]:
    """Reversal of rotary axes by letter, rad, from comments such as ``# reversal_c_arcsec = 2.0``."""
    found = {}
    for letter in ROTARY:
        key = _REVERSAL.format(letter.lower())
        if key not in table.metadata:
            continue
        try:
            value = float(table.metadata[key])
        except ValueError:
            value = np.nan
        if not abs(value) <= 3600.0:
            raise InputError(
                f"{table.metadata[key][:40]!r} is no reversal; expected arcsec, at most 3600 in size",
                file=table.path,
                field=key,
            )
        found[letter] = value * RAD_PER_ARCSEC
    return found


def format_machine_errors(table: ErrorTable, rotary: RotaryErrors, metadata: Mapping[str, object]) -> str:
    """Return the text of an ``*.errors.csv`` file with both kinds of axes; what has no position has an empty cell."""
    rows: list[tuple[str, str, str, float, float]] = []
    for name in table.names:
        if name in table.squareness:
            value, u = table.squareness[name]
            rows.append((name, "", "", value / RAD_PER_URAD, u / RAD_PER_URAD))
        else:
            curve, unit = table.curves[name], MM_PER_UM if name[1] in AXES else RAD_PER_URAD
            rows += [
                (name, f"{at:.6f}", "", value / unit, u / unit)
                for at, value, u in zip(curve.position_mm, curve.value, curve.u, strict=True)
            ]
    for name in rotary.names:
        unit = si_per_unit(name)
        if name in rotary.constants:
            value, u = rotary.constants[name]
            rows.append((name, "", "", value / unit, u / unit))
        else:
            own = rotary.curves[name]
            rows += [
                (name, "", f"{at:.6f}", value / unit, u / unit)
                for at, value, u in zip(own.angle_deg, own.value, own.u, strict=True)
            ]
    columns: dict[str, Any] = {
        "error": [row[0] for row in rows],
        "position_mm": [row[1] for row in rows],
        "position_deg": [row[2] for row in rows],
        "value": [f"{row[3]:.6f}" for row in rows],
        "u_value": ["" if np.isnan(row[4]) else f"{row[4]:.6f}" for row in rows],
    }
    turned = {_REVERSAL.format(a.lower()): f"{value / RAD_PER_ARCSEC:.4f}" for a, value in rotary.reversal.items()}
    return format_csv(columns, {**metadata, **turned})


# Centres of spheres found at poses: ``*.sphere.csv``.


ANGLE_COLUMNS = tuple(f"{letter.lower()}_deg" for letter in ROTARY)
CENTRE_COLUMNS = ("cx_mm", "cy_mm", "cz_mm")
#: What the coordinates of a centre are: positions of the axes, or of the tip under active kinematics.
JOINTS, TIP = "joints", "tip"
_length = within(2000.0, "mm", "more than 2 m; is the unit mm?")


@dataclass(frozen=True, repr=False)
class SphereCentres(Displayed):
    """Centres of spheres found with a touch probe, or by an R-test, at n poses.

    Parameters
    ----------
    found_mm : the centre found, or for an R-test the commanded position, (n, 3).
    deviation_mm : for an R-test: tip minus the centre, in the frame of the table, (n, 3); nan for a touch probe.
    coordinates : what ``found_mm`` is: positions of the axes (``joints``), or of the tip in the workpiece frame of the
        nominal machine (``tip``).
    angle_deg : commanded angles by rotary axis, each (n,).
    tool_mm : offset of the tip, (n, 3).
    sphere, setup : which sphere, and which set-up of it, (n,); each pair has a place of its own on the table.
    u_mm : standard uncertainty of a coordinate, (n,); nan where unknown.
    diameter_mm, time_s : nan where not stated, (n,).
    """

    found_mm: FloatArray
    deviation_mm: FloatArray
    coordinates: str
    angle_deg: Mapping[str, FloatArray]
    tool_mm: FloatArray
    sphere: Sequence[str]
    setup: NDArray[np.int64]
    u_mm: FloatArray
    diameter_mm: FloatArray
    time_s: FloatArray
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.found_mm)

    @property
    def places(self) -> tuple[NDArray[np.int64], list[str]]:
        """Number of the place of each reading (n,), and the names of the places."""
        keys = [f"{ball}, set-up {setup}" for ball, setup in zip(self.sphere, self.setup.tolist(), strict=True)]
        names = list(dict.fromkeys(keys))
        return np.array([names.index(key) for key in keys], dtype=np.int64), names

    def part(self, rows: NDArray[np.intp]) -> SphereCentres:
        """Return some of the readings."""
        arrays = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return replace(
            self,
            **arrays,
            angle_deg={letter: angle[rows] for letter, angle in self.angle_deg.items()},
            sphere=[self.sphere[k] for k in rows],
            origin=[self.origin[k] for k in rows] if self.origin else (),
        )

    def overview(self) -> Overview:
        """Number of poses, spheres and lengths of the probe."""
        spheres, tools = len(self.places[1]), len(np.unique(self.tool_mm, axis=0))
        return Overview(f"{len(self)} poses, {spheres} places of spheres, {tools} lengths of the probe")


_ARRAYS = ("found_mm", "deviation_mm", "tool_mm", "setup", "u_mm", "diameter_mm", "time_s")


def read_spheres(machine: Machine, paths: Sequence[str | Path]) -> SphereCentres:
    """Read ``*.sphere.csv`` files (mm and degrees) of a machine with rotary axes.

    Raises
    ------
    InputError
        without the comment ``# coordinates = joints`` or ``tip``, for an angle outside the travel of its axis, an axis
        that the machine lacks, a missing column; with file, line and column.
    """
    needs_rotary(machine, paths[0])
    parts = [_spheres_of(machine, Path(path)) for path in paths]
    if len({part.coordinates for part in parts}) > 1:
        raise InputError("some files have coordinates = joints, others tip; identify them separately", file=paths[-1])
    first = parts[0]
    if len(parts) == 1:
        return first
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return replace(
        first,
        **arrays,
        angle_deg={letter: np.concatenate([part.angle_deg[letter] for part in parts]) for letter in machine.rotary},
        sphere=[name for part in parts for name in part.sphere],
        origin=[entry for part in parts for entry in part.origin],
    )


def _spheres_of(machine: Machine, path: Path) -> SphereCentres:
    found = CENTRE_COLUMNS[0] in names_in_header(read_text(path))
    places = CENTRE_COLUMNS if found else (*POSITION_COLUMNS, *DEVIATION_COLUMNS)
    angles = tuple(f"{letter.lower()}_deg" for letter in machine.rotary)
    table = read_csv(
        path,
        (*places, *angles),
        (*POSITION_COLUMNS, *ANGLE_COLUMNS, "probe_length_mm", "tool", *TOOL_COLUMNS, "sphere", "setup", "u_um",
         "diameter_mm", "time_s", "run"),
        (TEMPERATURES,),
    )  # fmt: skip
    coordinates = coordinates_of(table)
    count, nan = len(table), np.full(len(table), np.nan)
    angle_deg = {letter: angles_of(machine, table, letter) for letter in machine.rotary}
    check_other_angles(machine, table)

    def optional(name: str, read: ReadColumn = CsvTable.numbers) -> FloatArray:
        return np.asarray(read(table, name)) if name in table.columns else nan

    return SphereCentres(
        found_mm=np.column_stack([table.numbers(name) for name in (CENTRE_COLUMNS if found else POSITION_COLUMNS)]),
        deviation_mm=np.column_stack(
            [nan if found else deviations_um(table, name) * MM_PER_UM for name in DEVIATION_COLUMNS]
        ),
        coordinates=coordinates,
        angle_deg=angle_deg,
        tool_mm=tools_of(machine, table),
        sphere=table.text("sphere") if "sphere" in table.columns else ["sphere"] * count,
        setup=table.labels("setup") if "setup" in table.columns else np.ones(count, dtype=np.int64),
        u_mm=optional("u_um", uncertainties) * MM_PER_UM,
        diameter_mm=optional("diameter_mm", _length),
        time_s=optional("time_s"),
        metadata={key: value for key, value in table.metadata.items() if key != "rows"},
        origin=[(str(path), line) for line in table.lines],
    )


def needs_rotary(machine: Machine, path: str | Path) -> None:
    """InputError for poses of rotary axes of a machine that has none."""
    if not machine.rotary:
        raise InputError(
            f"contains poses of rotary axes, and the machine {machine.name} has none; name them in its chain, e.g. "
            "WCAYFXZT, and describe them in [axes.A] and [axes.C]",
            file=path,
        )


def coordinates_of(table: CsvTable) -> str:
    """What the positions of a file are, from its comment ``# coordinates``; InputError if that is not stated."""
    coordinates = table.metadata.get("coordinates", "").strip().lower()
    if coordinates not in (JOINTS, TIP):
        stated = f"is {coordinates!r}" if coordinates else "is not stated"
        raise InputError(
            f"{stated}; write '# coordinates = joints' if the numbers are positions of the axes, '# coordinates = tip' "
            "if they are positions of the tip under active kinematics (TCPC, RTCP)",
            file=table.path,
            field="coordinates",
        )
    return coordinates


def check_other_angles(machine: Machine, table: CsvTable) -> None:
    """InputError for angles of an axis that the machine lacks, other than zero."""
    for column in ANGLE_COLUMNS:
        letter = column[0].upper()
        if column in table.columns and letter not in machine.rotary and np.any(table.numbers(column, empty=0.0)):
            row = int(np.flatnonzero(table.numbers(column, empty=0.0))[0])
            raise table.fail(
                row, column, f"the machine {machine.name} (chain {machine.chain.name}) has no axis {letter}"
            )


def angles_of(machine: Machine, table: CsvTable, letter: str) -> FloatArray:
    """Commanded angles of one axis, within its travel."""
    column = f"{letter.lower()}_deg"
    angle = table.numbers(column)
    axis = machine.rotary[letter]
    if axis.range_deg is not None:
        low, high = axis.range_deg
        for row in np.flatnonzero((angle < low - 1e-6) | (angle > high + 1e-6))[:1].tolist():
            raise table.fail(
                row, column, f"{angle[row]:g} degrees is outside the travel {low:g} ... {high:g} of {letter}"
            )
    return angle


def tools_of(machine: Machine, table: CsvTable) -> FloatArray:
    """Offsets of the tip (n, 3): stated as a vector, or the machine's own offset and the probe along -Z."""
    own = np.tile(np.array(machine.tool_offset_mm), (len(table), 1))
    if "probe_length_mm" in table.columns:
        length = _length(table, "probe_length_mm")
        for row in np.flatnonzero(length < 0)[:1].tolist():
            raise table.fail(row, "probe_length_mm", f"{length[row]:g} mm is no length; expected a positive number")
        return np.asarray(own + length[:, None] * np.array([0.0, 0.0, -1.0]))
    if TOOL_COLUMNS[0] in table.columns:
        return np.column_stack([table.numbers(name) for name in TOOL_COLUMNS])
    if "tool" in table.columns and len(set(table.text("tool"))) > 1:
        raise InputError(
            "names several tools; give their lengths in a column probe_length_mm", file=table.path, field="column tool"
        )
    return own


def format_spheres(spheres: SphereCentres) -> str:
    """Return the text of a ``*.sphere.csv`` file."""
    columns: dict[str, Any] = {}
    touched = np.isnan(spheres.deviation_mm).all()
    for k, name in enumerate(CENTRE_COLUMNS if touched else POSITION_COLUMNS):
        columns[name] = spheres.found_mm[:, k]
    for letter, angle in spheres.angle_deg.items():
        columns[f"{letter.lower()}_deg"] = angle
    if not touched:
        columns |= {name: spheres.deviation_mm[:, k] / MM_PER_UM for k, name in enumerate(DEVIATION_COLUMNS)}
    columns |= {name: spheres.tool_mm[:, k] for k, name in enumerate(TOOL_COLUMNS)}
    columns |= {"sphere": list(spheres.sphere), "setup": [str(k) for k in spheres.setup]}
    for name, values, unit in (
        ("u_um", spheres.u_mm, MM_PER_UM),
        ("diameter_mm", spheres.diameter_mm, 1.0),
        ("time_s", spheres.time_s, 1.0),
    ):
        if not np.isnan(values).any():
            columns[name] = values / unit
    return format_csv(columns, {**spheres.metadata, "coordinates": spheres.coordinates})


# Points at poses, where errors are predicted.


@dataclass(frozen=True)
class Poses:
    """Commanded positions (n, 3) with angles by rotary axis, each (n,), and tool offsets (n, 3) or None."""

    position_mm: FloatArray
    angle_deg: Mapping[str, FloatArray]
    tool_mm: FloatArray | None


def read_poses(machine: Machine, path: str | Path) -> Poses:
    """Read a ``*.points.csv`` file with ``a_deg``, ``b_deg``, ``c_deg``; an axis without a column is at its reference."""
    table = read_csv(path, POSITION_COLUMNS, (*ANGLE_COLUMNS, *TOOL_COLUMNS))
    for column in ANGLE_COLUMNS:
        if column in table.columns and column[0].upper() not in machine.rotary:
            raise table.fail(0, column, f"the machine {machine.name} has no axis {column[0].upper()}; omit the column")
    angle = {
        letter: angles_of(machine, table, letter)
        if f"{letter.lower()}_deg" in table.columns
        else np.full(len(table), axis.reference_deg)
        for letter, axis in machine.rotary.items()
    }
    known = [name for name in TOOL_COLUMNS if name in table.columns]
    if known and len(known) < len(TOOL_COLUMNS):
        raise InputError(f"has {known[0]} but not all of {', '.join(TOOL_COLUMNS)}", file=path)
    tool = np.column_stack([table.numbers(name) for name in TOOL_COLUMNS]) if known else None
    return Poses(np.column_stack([table.numbers(name) for name in POSITION_COLUMNS]), angle, tool)


def format_poses(poses: Poses, results: Mapping[str, FloatArray], metadata: Mapping[str, object]) -> str:
    """Return CSV text of the poses with result columns (n,) after them."""
    columns = {name: poses.position_mm[:, k] for k, name in enumerate(POSITION_COLUMNS)}
    columns |= {f"{letter.lower()}_deg": angle for letter, angle in poses.angle_deg.items()}
    if poses.tool_mm is not None:
        columns |= {name: poses.tool_mm[:, k] for k, name in enumerate(TOOL_COLUMNS)}
    return format_csv({**columns, **results}, metadata)


# Positioning runs of rotary axes (ISO 230-2): ``*.axis.csv`` with angles.


#: Columns that tell runs of a rotary axis from those of a linear one.
RUN_COLUMNS = ("position_deg", "deviation_arcsec")


@dataclass(frozen=True)
class RotaryRuns:
    """Actual minus target angle of rotary axes: letters, targets (degrees), directions, runs, deviations (rad), each (n,)."""

    letter: Sequence[str]
    angle_deg: FloatArray
    direction: NDArray[np.int64]
    run: NDArray[np.int64]
    deviation_rad: FloatArray

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.angle_deg)


def is_rotary_runs(path: str | Path) -> bool:
    """Whether a file contains positioning runs of rotary axes."""
    return str(path).lower().endswith(".csv") and set(RUN_COLUMNS) <= names_in_header(read_text(path))


def read_rotary_runs(machine: Machine, paths: Sequence[str | Path]) -> RotaryRuns:
    """Read ``*.axis.csv`` files with ``axis``, ``position_deg``, ``direction``, ``run``, ``deviation_arcsec``.

    Raises
    ------
    InputError
        for an axis that the machine lacks, an angle outside its travel, a reading given twice, a deviation beyond a degree.
    """
    letters: list[str] = []
    parts: list[tuple[FloatArray, ...]] = []
    seen: dict[tuple[object, ...], str] = {}
    for path in paths:
        table = read_csv(path, ("axis", "direction", *RUN_COLUMNS), ("run", "time_s"), (TEMPERATURES,))
        own = [text.strip().upper() for text in table.text("axis")]
        angle, way = table.numbers("position_deg"), directions(table, "direction")
        run = table.labels("run") if "run" in table.columns else np.ones(len(table), dtype=np.int64)
        deviation = table.numbers("deviation_arcsec")
        for row, letter in enumerate(own):
            if letter not in machine.rotary:
                known = ", ".join(machine.rotary) or "none"
                raise table.fail(row, "axis", f"{letter!r} is no rotary axis of {machine.name} (it has {known})")
            ends = machine.rotary[letter].range_deg
            low, high = (-np.inf, np.inf) if ends is None else ends
            if not low - 1e-6 <= angle[row] <= high + 1e-6:
                raise table.fail(
                    row,
                    "position_deg",
                    f"{angle[row]:g} degrees is outside the travel {low:g} ... {high:g} of {letter}",
                )
            if abs(deviation[row]) > 3600.0:
                raise table.fail(
                    row, "deviation_arcsec", f"{deviation[row]:g} is more than a degree; is the unit arcsec?"
                )
            key, where = (letter, float(angle[row]), int(way[row]), int(run[row])), f"{path}:{table.lines[row]}"
            if key in seen:
                raise table.fail(
                    row, "position_deg", f"{letter} at {angle[row]:g} already appears in {seen[key]}; number the runs"
                )
            seen[key] = where
        letters += own
        parts.append((angle, way.astype(float), run.astype(float), deviation * RAD_PER_ARCSEC))
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return RotaryRuns(letters, joined[0], joined[1].astype(np.int64), joined[2].astype(np.int64), joined[3])
