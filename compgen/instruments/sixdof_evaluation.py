"""Six-DOF runs to the 21 errors, and comparison with reference instruments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, fitted_line
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.errors import InputError, Message
from compgen.instruments.interferometer import growth_mm
from compgen.instruments.sixdof_instrument import ERRORS_OF_AXIS, RAD_PER_ARCSEC, SixDof, SixDofInstrument
from compgen.instruments.sixdof_reduction import (
    AxisRun,
    along,
    errors_of_run,
    expected_away,
    printed_run,
    reduce_runs,
    turned_by,
    zeroed,
)

# Runs of all axes to the 21 errors: mean over runs, lines removed from straightness, squareness from their slopes.


#: (S_xy, S_xz, S_yz): each is the sum of the slopes of two straightnesses, as (component, moving axis).
SLOPES = (((1, 0), (0, 1)), ((2, 0), (0, 2)), ((2, 1), (1, 2)))
SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")
#: Positions of two runs closer than this are the same target, mm.
SAME_MM = 1e-4


@dataclass(frozen=True)
class AxisErrors:
    """Errors of one axis at its n target positions.

    Parameters
    ----------
    position_mm : ascending, (n,).
    delta_mm, eps_rad : means over all runs, (n, 3), zero at the reference point.
    spread : half of the range over the runs, (n, 6): three translations in mm, three rotations in rad (half-range
        repeatability); nan for a single run.
    reversal : mean of the runs in positive direction minus mean of those in negative direction, (n, 6), or None.
    count : runs at each position, (n,).
    turned_by : how many times the rotation of each other axis, where it was, is still contained in the translations.
    """

    axis: int
    position_mm: FloatArray
    delta_mm: FloatArray
    eps_rad: FloatArray
    spread: FloatArray
    reversal: FloatArray | None
    count: FloatArray
    turned_by: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Evaluation:
    """The identified errors and the values they were computed from.

    Parameters
    ----------
    errors : in mm and rad, zero at the machine's reference point, uncertainties nan.
    axes : means of each measured axis.
    slopes : slope of each straightness by ISO name, rad, carriers' rotation removed.
    squareness_rad : S_xy, S_xz, S_yz by the ISO name (EC0Y, EB0Z, EA0Z), if both axes were measured: 90 degrees
        minus the angle between the positive axes.
    """

    errors: ErrorTable
    axes: Mapping[int, AxisErrors]
    slopes: Mapping[str, float] = field(default_factory=dict)
    squareness_rad: Mapping[str, float] = field(default_factory=dict)


def axis_errors(machine: Machine, runs: Sequence[AxisRun]) -> AxisErrors:
    """Average the runs of one axis at every target position."""
    axis = runs[0].axis
    # target positions: readings closer than SAME_MM are one
    ordered = np.sort(np.concatenate([run.position_mm for run in runs]))
    keep = np.concatenate([[True], np.diff(ordered) > SAME_MM])
    positions = np.asarray(ordered[keep])
    signed: list[tuple[float, FloatArray]] = []
    for run in runs:
        values = np.hstack([run.delta_mm, run.eps_rad])
        for direction in np.unique(run.direction):
            # means at the targets, nan without readings
            rows = run.direction == direction
            index = np.searchsorted(positions, run.position_mm[rows] + SAME_MM) - 1
            index = np.clip(index, 0, len(positions) - 1)
            total, readings = np.zeros((len(positions), values.shape[1])), np.zeros(len(positions))
            np.add.at(total, index, values[rows])
            np.add.at(readings, index, 1.0)
            readings[readings == 0.0] = np.nan
            signed.append((float(direction), total / readings[:, None]))
    ways = [[values for direction, values in signed if direction == sign] for sign in (1.0, -1.0)]
    forward, backward = (np.mean(np.array(way), axis=0) if way else None for way in ways)
    reversal = None if forward is None or backward is None else np.asarray(forward - backward)
    stacked = np.array([values for _, values in signed])
    count = np.sum(~np.isnan(stacked[:, :, 0]), axis=0)
    mean = np.nanmean(stacked, axis=0)
    several = count[:, None] > 1
    spread = np.where(several, 0.5 * (np.nanmax(stacked, axis=0) - np.nanmin(stacked, axis=0)), np.nan)
    turns = (
        {} if any(run.contradiction for run in runs) else turned_by(machine, axis, unit_at_tool=runs[0].unit_at_tool)
    )
    return AxisErrors(axis, positions, mean[:, :3], mean[:, 3:], spread, reversal, count, turns)


def evaluate(machine: Machine, instrument: SixDofInstrument, runs: Sequence[AxisRun]) -> Evaluation:
    """Return the errors of every measured axis, and squareness if both axes were measured."""
    measured_axes = sorted({run.axis for run in runs})
    axes = {axis: axis_errors(machine, [run for run in runs if run.axis == axis]) for axis in measured_axes}
    return evaluate_axes(machine, instrument, axes)


#: Curves and slopes of each axis by the identity of its means, which are kept for that, and the turn removed from them.
KnownAxes = dict[tuple[int, bytes], tuple[AxisErrors, dict[str, Curve], dict[str, float]]]


def evaluate_axes(
    machine: Machine,
    instrument: SixDofInstrument,
    axes: Mapping[int, AxisErrors],
    known: KnownAxes | None = None,
) -> Evaluation:
    """Return errors and squareness from the means of each axis.

    ``known`` keeps what was computed for an axis, for the next call with the same means of that axis.
    """
    known = {} if known is None else known
    turns = {axis: zeroed(machine, axis, entry.position_mm, entry.eps_rad) for axis, entry in axes.items()}
    curves: dict[str, Curve] = {}
    slopes: dict[str, float] = {}
    for axis, entry in axes.items():
        # remove what the rotation of the other axes, where they were, adds to the measured translations
        stood, turn = instrument.axes[axis].position_mm or (0.0, 0.0, 0.0), np.zeros(3)
        for other, times in entry.turned_by.items():
            if other in axes and times:
                at = axes[other].position_mm
                turn += [times * np.interp(stood[other], at, turns[other][:, k]) for k in range(3)]
        key = id(entry), turn.tobytes()
        if key not in known:
            delta = entry.delta_mm - np.cross(turn, along(axis, entry.position_mm))
            own: dict[str, Curve] = {}
            lines: dict[str, float] = {}
            for component in range(3):
                name, value = f"E{AXES[component]}{AXES[axis]}", delta[:, component]
                if component != axis:
                    constant, slope = fitted_line(entry.position_mm, value, instrument.line)
                    lines[name], value = slope, value - constant - slope * entry.position_mm
                own[name] = _as_curve(entry.position_mm, zeroed(machine, axis, entry.position_mm, value[:, None])[:, 0])
                angle = f"E{'ABC'[component]}{AXES[axis]}"
                own[angle] = _as_curve(entry.position_mm, turns[axis][:, component])
            known[key] = entry, own, lines
        curves |= known[key][1]
        slopes |= known[key][2]
    measured = {
        name: sum(slopes[f"E{AXES[component]}{AXES[axis]}"] for component, axis in pair)
        for name, pair in zip(SQUARENESS, SLOPES, strict=True)
        if all(axis in axes for _, axis in pair)
    }
    signs = dict(zip(SQUARENESS, instrument.squareness_signs, strict=True))
    squareness = {name: (signs[name] * value, np.nan) for name, value in measured.items()}
    order = sorted(curves, key=lambda name: ("XYZ".index(name[2]), "XYZABC".index(name[1])))
    ordered = {name: curves[name] for name in order}
    return Evaluation(ErrorTable(ordered, squareness), axes, slopes, measured)


def _as_curve(position_mm: FloatArray, value: FloatArray) -> Curve:
    return Curve(position_mm, np.asarray(value), np.full(len(position_mm), np.nan))


# From readings to the 21 errors in one call: reduce every run, turn it into errors of the machine, evaluate.


def axis_runs(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> list[AxisRun]:
    """Errors of the moved axis over every run; a CompgenWarning if chain and readings contradict each other.

    ``as_printed`` of the instrument selects the paper's equations instead of the traced ones.
    """
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    grown = {axis: growth_mm(machine, readings, axis) for axis in {run.axis for run in reduced}}
    runs = []
    for part in reduced:
        if instrument.as_printed:
            run = printed_run(machine, readings, instrument, part)
        else:
            run = errors_of_run(machine, instrument, part)
        growth = grown[run.axis][part.rows]
        if np.any(growth):  # as on a machine whose scales are at 20 degC
            delta = run.delta_mm.copy()
            delta[:, run.axis] -= growth
            run = replace(run, delta_mm=delta)
        runs.append(run)
    return runs


def evaluate_readings(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> Evaluation:
    """Return errors, means of the axes, slopes and squareness of all readings."""
    return evaluate(machine, instrument, axis_runs(machine, readings, instrument))


# Repeatability and comparison with reference instruments in the style of Tables 2 and 3 of Jia et al. 2022.


#: Rows of the tables: title, unit, and factor from mm or rad to it; in the order of ROLES.
ROWS = (
    ("positioning", "nm", 1e6),
    ("horizontal straightness", "um", 1.0 / MM_PER_UM),
    ("vertical straightness", "um", 1.0 / MM_PER_UM),
    ("yaw", "arcsec", 1.0 / RAD_PER_ARCSEC),
    ("pitch", "arcsec", 1.0 / RAD_PER_ARCSEC),
    ("roll", "arcsec", 1.0 / RAD_PER_ARCSEC),
)
SQUARENESS_ROWS = (("EC0Y", "S_xy"), ("EB0Z", "S_xz"), ("EA0Z", "S_yz"))


def each_run(machine: Machine, instrument: SixDofInstrument, runs: Sequence[AxisRun]) -> list[Evaluation]:
    """Evaluate the first run of every axis together, then the second runs, and so on, as long as all axes have one."""
    by_axis = [[run for run in runs if run.axis == axis] for axis in sorted({run.axis for run in runs})]
    return [evaluate(machine, instrument, list(together)) for together in zip(*by_axis, strict=False)]


def half_ranges(evaluations: Sequence[Evaluation]) -> dict[str, float]:
    """Half of the range over repeated measurements by error, the worst position of a curve, mm and rad.

    Straightness is without its line, everything is zero at the reference point. Empty for a single measurement.
    """
    tables = [item.errors for item in evaluations]
    if len(tables) < 2:
        return {}
    result = {}
    for name in tables[0].names:
        if name in tables[0].squareness:
            values = np.array([table.squareness[name][0] for table in tables])[:, None]
        else:
            at = tables[0].curves[name].position_mm
            values = np.array([table.curves[name].at(at) for table in tables])
        result[name] = float(0.5 * np.ptp(values, axis=0).max())
    return result


def largest_differences(errors: ErrorTable, reference: ErrorTable, line: str = "ls") -> dict[str, float]:
    """Largest absolute difference to a reference by error, mm and rad; errors that only one of them has are omitted.

    The reference is compared at its own positions within the travel of the errors. The arbitrary
    zero of the reference instrument is removed: a line for straightness, the first value for the other curves.
    """
    result = {}
    for name in errors.names:
        if name in errors.squareness and name in reference.squareness:
            result[name] = abs(errors.squareness[name][0] - reference.squareness[name][0])
        elif name in errors.curves and name in reference.curves:
            own, other = errors.curves[name], reference.curves[name]
            within = (other.position_mm >= own.position_mm[0] - 1e-6) & (
                other.position_mm <= own.position_mm[-1] + 1e-6
            )
            at = other.position_mm[within]
            if len(at) < 2:
                raise InputError(
                    Message(
                        "reference-few-positions",
                        "the reference has fewer than two positions of {name} within the measured travel",
                        name=name,
                    )
                )
            difference = own.at(at) - other.at(at)
            if error_named(name).is_straightness:
                constant, slope = fitted_line(at, difference, line)
                difference = difference - constant - slope * at
            else:
                difference = difference - difference[0]
            result[name] = float(np.abs(difference).max())
    return result


def in_table_units(values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Values by error (mm, rad) as the rows of the paper's tables: by row with its unit, then by axis or pair of axes."""
    table: dict[str, dict[str, float]] = {}
    for role, (title, unit, factor) in enumerate(ROWS):
        row = {
            AXES[axis]: factor * values[names[role]]
            for axis, names in enumerate(ERRORS_OF_AXIS)
            if names[role] in values
        }
        if row:
            table[f"{title} ({unit})"] = row
    pairs = {short: values[name] / RAD_PER_ARCSEC for name, short in SQUARENESS_ROWS if name in values}
    if pairs:
        table["squareness (arcsec)"] = pairs
    return table


def format_table(columns: Mapping[str, Mapping[str, float]]) -> str:
    """Text of a table whose columns are values by error (mm, rad), e.g. ``repeatability``, ``u (k = 1)``.

    One line for every error and axis, in the units of the paper.
    """
    cells = {title: in_table_units(values) for title, values in columns.items()}
    keys = list(
        dict.fromkeys((row, where) for table in cells.values() for row, part in table.items() for where in part)
    )
    width = max((len(f"{row} {where}") for row, where in keys), default=0)
    lines = [" " * width + "".join(f"  {title:>16}" for title in columns)]
    for row, where in keys:
        numbers = [cells[title].get(row, {}).get(where) for title in columns]
        texts = "".join("  " + ("-" if value is None else f"{value:.3f}").rjust(16) for value in numbers)
        lines.append(f"{row} {where}".ljust(width) + texts)
    return "\n".join(lines) + "\n"
