"""Runs of all axes to the 21 errors: mean over runs, lines out of the straightness, squareness from their slopes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.lines import fitted_line
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.sixdof.frames import AxisRun, along, turned_by, zeroed
from compgen.sixdof.instrument import Instrument

#: (S_xy, S_xz, S_yz): for each the two straightnesses, as (component, moving axis), whose slopes add up to it.
SLOPES = (((1, 0), (0, 1)), ((2, 0), (0, 2)), ((2, 1), (1, 2)))
SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")
#: Positions of two runs that differ by less are the same target, mm.
SAME_MM = 1e-4


@dataclass(frozen=True)
class AxisErrors:
    """Errors of one axis at its target positions, n of them.

    Parameters
    ----------
    position_mm : ascending, (n,).
    delta_mm, eps_rad : means over all runs, (n, 3), zero at the reference point.
    spread : half of the range over the runs, (n, 6): three translations in mm, three rotations in rad (half-range
        repeatability); nan where there is one run only.
    reversal : mean of the runs in positive direction less those in negative direction, (n, 6), or None.
    count : runs at each position, (n,).
    turned_by : how often the rotation of each other axis, where it stood, is still in the translations.
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
    """The identified errors and what they were made of.

    Parameters
    ----------
    errors : in mm and rad, zero at the machine's reference point, uncertainties nan.
    axes : means of each measured axis.
    slopes : slope of each straightness by ISO name, rad, carriers' rotation taken out.
    squareness_rad : S_xy, S_xz, S_yz by the ISO name (EC0Y, EB0Z, EA0Z), as far as both axes were measured: 90 degrees
        minus the angle between the positive axes.
    """

    errors: ErrorTable
    axes: Mapping[int, AxisErrors]
    slopes: Mapping[str, float] = field(default_factory=dict)
    squareness_rad: Mapping[str, float] = field(default_factory=dict)


def axis_errors(machine: Machine, runs: Sequence[AxisRun]) -> AxisErrors:
    """Average the runs of one axis at every target position."""
    axis = runs[0].axis
    positions = _targets(np.concatenate([run.position_mm for run in runs]))
    signed: list[tuple[float, FloatArray]] = []
    for run in runs:
        values = np.hstack([run.delta_mm, run.eps_rad])
        for direction in np.unique(run.direction):
            rows = run.direction == direction
            signed.append((float(direction), _on(positions, run.position_mm[rows], values[rows])))
    stacked = np.array([values for _, values in signed])
    count = np.sum(~np.isnan(stacked[:, :, 0]), axis=0)
    mean = np.nanmean(stacked, axis=0)
    several = count[:, None] > 1
    spread = np.where(several, 0.5 * (np.nanmax(stacked, axis=0) - np.nanmin(stacked, axis=0)), np.nan)
    turns = (
        {} if any(run.contradiction for run in runs) else turned_by(machine, axis, unit_at_tool=runs[0].unit_at_tool)
    )
    return AxisErrors(axis, positions, mean[:, :3], mean[:, 3:], spread, _reversal(signed), count, turns)


def _targets(position_mm: FloatArray) -> FloatArray:
    """Target positions: readings closer than SAME_MM are one."""
    ordered = np.sort(position_mm)
    keep = np.concatenate([[True], np.diff(ordered) > SAME_MM])
    return np.asarray(ordered[keep])


def _on(positions: FloatArray, at_mm: FloatArray, values: FloatArray) -> FloatArray:
    """Means of values (m, 6) at their positions among the targets, (n, 6), nan where there is none."""
    index = np.clip(np.searchsorted(positions, at_mm + SAME_MM) - 1, 0, len(positions) - 1)
    total, count = np.zeros((len(positions), values.shape[1])), np.zeros(len(positions))
    np.add.at(total, index, values)
    np.add.at(count, index, 1.0)
    count[count == 0.0] = np.nan
    return np.asarray(total / count[:, None])


def _reversal(signed: Sequence[tuple[float, FloatArray]]) -> FloatArray | None:
    ways = [[values for direction, values in signed if direction == sign] for sign in (1.0, -1.0)]
    if not all(ways):
        return None
    forward, backward = (np.mean(np.array(way), axis=0) for way in ways)
    return np.asarray(forward - backward)


def evaluate(machine: Machine, instrument: Instrument, runs: Sequence[AxisRun]) -> Evaluation:
    """Return the errors of every measured axis, and of squareness where both axes were measured."""
    measured_axes = sorted({run.axis for run in runs})
    axes = {axis: axis_errors(machine, [run for run in runs if run.axis == axis]) for axis in measured_axes}
    return evaluate_axes(machine, instrument, axes)


def evaluate_axes(machine: Machine, instrument: Instrument, axes: Mapping[int, AxisErrors]) -> Evaluation:
    """Return errors and squareness from the means of each axis."""
    turns = {axis: zeroed(machine, axis, entry.position_mm, entry.eps_rad) for axis, entry in axes.items()}
    curves: dict[str, Curve] = {}
    slopes: dict[str, float] = {}
    for axis, entry in axes.items():
        delta = entry.delta_mm - _carried(instrument, entry, axes, turns)
        for component in range(3):
            name, value = f"E{AXES[component]}{AXES[axis]}", delta[:, component]
            if component != axis:
                constant, slope = fitted_line(entry.position_mm, value, instrument.line)
                slopes[name], value = slope, value - constant - slope * entry.position_mm
            curves[name] = _as_curve(entry.position_mm, zeroed(machine, axis, entry.position_mm, value[:, None])[:, 0])
            angle = f"E{'ABC'[component]}{AXES[axis]}"
            curves[angle] = _as_curve(entry.position_mm, turns[axis][:, component])
    measured = _squareness(slopes, axes)
    signs = dict(zip(SQUARENESS, instrument.squareness_signs, strict=True))
    squareness = {name: (signs[name] * value, np.nan) for name, value in measured.items()}
    ordered = {name: curves[name] for name in sorted(curves, key=_order)}
    return Evaluation(ErrorTable(ordered, squareness), axes, slopes, measured)


def _order(name: str) -> tuple[int, int]:
    return "XYZ".index(name[2]), "XYZABC".index(name[1])


def _as_curve(position_mm: FloatArray, value: FloatArray) -> Curve:
    return Curve(position_mm, np.asarray(value), np.full(len(position_mm), np.nan))


def _carried(
    instrument: Instrument, entry: AxisErrors, axes: Mapping[int, AxisErrors], turns: Mapping[int, FloatArray]
) -> FloatArray:
    """What the rotation of the other axes, where they stood, adds to the measured translations, (n, 3)."""
    stood = instrument.axes[entry.axis].position_mm or (0.0, 0.0, 0.0)
    turn = np.zeros(3)
    for other, times in entry.turned_by.items():
        if other in axes:
            at = axes[other].position_mm
            turn += [times * np.interp(stood[other], at, turns[other][:, k]) for k in range(3)]
    return np.cross(turn, along(entry.axis, entry.position_mm))


def _squareness(slopes: Mapping[str, float], axes: Mapping[int, AxisErrors]) -> dict[str, float]:
    found = {}
    for name, pair in zip(SQUARENESS, SLOPES, strict=True):
        if all(axis in axes for _, axis in pair):
            found[name] = sum(slopes[f"E{AXES[component]}{AXES[axis]}"] for component, axis in pair)
    return found
