"""Figures of identified errors: each curve by itself, squareness, axes, diagonals, orientation."""

from __future__ import annotations

import math

import numpy as np

from compgen.accuracy.figure import Figure
from compgen.accuracy.source import ErrorSource
from compgen.accuracy.straightness import LINES, slope_weights, straightness
from compgen.core.csvio import FloatArray
from compgen.core.diagonals import BODY_DIAGONALS
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.model.volumetric import c_matrix

#: Points along a diagonal.
ALONG_DIAGONAL = 41
#: The squareness errors by (axis whose line turns, component, reference axis, its component).
SQUARENESS_LINES = {"EC0Y": (1, 0, 0, 1), "EB0Z": (2, 0, 0, 2), "EA0Z": (2, 1, 1, 2)}


def error_figures(source: ErrorSource, line: str = "ls") -> dict[str, Figure]:
    """Return one figure for each error of the table, by its name.

    Straightness stands against the reference line ``line``; positioning and angular errors as their range over the travel;
    squareness as it stands in the table, against the lines ``line`` of its straightness curves. None of these depends on
    the constants, nor straightness and squareness together on the lines, that a table may have.
    """
    found = {}
    for name in source.errors.curves:
        found[name] = _curve_figure(source, name, line)
    for name in source.errors.squareness:
        found[name] = squareness_figure(source, name, line)
    return found


def straightness_figures(source: ErrorSource) -> dict[str, dict[str, Figure]]:
    """Return every straightness of the table against each of the three reference lines: by error, then by line."""
    names = [name for name in source.errors.curves if error_named(name).is_straightness]
    several = [name for name in names if len(source.errors.curves[name].value) > 1]
    return {name: {line: _curve_figure(source, name, line) for line in LINES} for name in several}


def _curve_figure(source: ErrorSource, name: str, line: str) -> Figure:
    error, curve = error_named(name), source.errors.curves[name]
    if error.is_straightness and len(curve.value) > 1:
        value, weight = straightness(curve.position_mm, curve.value, line)
        meaning = f"straightness {name}, reference line: {LINES[line]}; ISO 230-1"
    else:
        value, weight = float(np.ptp(curve.value)), _range_weight(curve.value)
        what = "mean bidirectional positioning error M (ISO 230-2)" if error.kind == "linear" else "angular error"
        meaning = f"{what} {name}, range over the travel"
    u = source.u_of(source.value_gradient(name, weight))
    return Figure(value / error.si_per_unit, u / error.si_per_unit, error.unit, meaning)


def _range_weight(value: FloatArray) -> FloatArray:
    weight = np.zeros(len(value))
    weight[int(np.argmax(value))] += 1.0
    weight[int(np.argmin(value))] -= 1.0
    return weight


def squareness_figure(source: ErrorSource, name: str, line: str = "ls") -> Figure:
    """Return a squareness error (urad) between the reference lines of its two axes.

    To the value of the table come the slopes that the reference lines have in the straightness curves: moving a line from
    a curve into the squareness changes neither this figure nor the volumetric error.
    """
    value = source.errors.squareness[name][0]
    gradient = source.value_gradient(name, np.ones(1))
    for curve_name, factor in _line_curves(source.machine, name):
        curve = source.errors.curves.get(curve_name)
        if curve is None or len(curve.value) < 2:
            continue
        weights = factor * slope_weights(curve.position_mm, line, curve.value)
        value += float(weights @ curve.value)
        gradient = gradient + source.value_gradient(curve_name, weights)
    meaning = f"squareness {name} between reference lines of {LINES[line]}; ISO 230-1"
    return Figure(value / RAD_PER_URAD, source.u_of(gradient) / RAD_PER_URAD, "urad", meaning)


def _line_curves(machine: Machine, name: str) -> list[tuple[str, float]]:
    """Straightness curves whose slope acts like a squareness error, and its sign in it (docs/conventions.md).

    A slope a of EXY moves x by a Y, as EC0Y does by -EC0Y Y; a slope of EYX turns the reference line of X the same way.
    """
    axis, component, other, across = SQUARENESS_LINES[name]
    unit = np.zeros((1, 3))
    unit[0, axis] = 1.0
    column = c_matrix(machine, unit, np.zeros(3))[0, :, 18 + list(SQUARENESS_LINES).index(name)]
    sign = 1.0 / column[component] if column[component] else -1.0  # squareness_reference = "Y": dY = -X EC0Y
    return [(f"E{AXES[component]}{AXES[axis]}", sign), (f"E{AXES[across]}{AXES[other]}", sign)]


def axis_figures(source: ErrorSource) -> dict[str, Figure]:
    """Return for each axis the range of its positioning error along the line through the reference point (``M_X`` ...)."""
    machine = source.machine
    found = {}
    for k, axis in enumerate(AXES):
        levels = levels_of(source, k)
        points = np.tile(np.array(machine.reference_point_mm), (len(levels), 1))
        points[:, k] = levels
        field = source.field(points)
        along = field.error_mm[:, k]
        weight = np.zeros_like(field.error_mm)
        weight[:, k] = _range_weight(along)
        meaning = f"mean bidirectional positioning error M of {axis} on the line through the reference point; ISO 230-2"
        found[f"M_{axis}"] = Figure(float(np.ptp(along)) / MM_PER_UM, field.spread(weight) / MM_PER_UM, "um", meaning)
    return found


def levels_of(source: ErrorSource, axis: int) -> FloatArray:
    """Return the nodes of the curves of one axis within its travel, and the ends of the travel."""
    low, high = source.machine.axes[axis].range_mm
    nodes = [curve.position_mm for name, curve in source.errors.curves.items() if error_named(name).axis == axis]
    levels = np.unique(np.concatenate([np.array([low, high]), *nodes]))
    return levels[(levels >= low) & (levels <= high)]


def diagonal_figures(source: ErrorSource) -> dict[str, Figure]:
    """Return E of the four body diagonals of the travel and their largest, ``Ed`` (ISO 230-6), from the errors.

    The deviation at p is u . (e(p) - e(s)) along the unit vector u from the start s; the errors are means of both
    directions, so there is no reversal B_d here. Errors of opposite sign in two axes cancel on a diagonal: four equal
    diagonals do not prove a good machine.
    """
    machine = source.machine
    found = {}
    for name, signs in BODY_DIAGONALS.items():
        points = diagonal_points(machine, signs)
        along = points[-1] - points[0]
        unit = along / np.linalg.norm(along)
        field = source.field(points)
        deviation = (field.error_mm - field.error_mm[0]) @ unit
        weight = _range_weight(deviation)[:, None] * unit
        value, u = float(np.ptp(deviation)) / MM_PER_UM, field.spread(weight) / MM_PER_UM
        found[name] = Figure(value, u, "um", f"systematic error E of the diagonal {name}; ISO 230-6")
    worst = max(found, key=lambda name: found[name].value)
    text = f"largest systematic error of the body diagonals, {worst}; ISO 230-6"
    return {**found, "Ed": Figure(found[worst].value, found[worst].u, "um", text)}


def diagonal_points(machine: Machine, signs: tuple[int, int, int], count: int = ALONG_DIAGONAL) -> FloatArray:
    """Points (count, 3) along a body diagonal of the travel, in the direction of ``signs``."""
    ends = [axis.range_mm if sign > 0 else axis.range_mm[::-1] for axis, sign in zip(machine.axes, signs, strict=True)]
    return np.column_stack([np.linspace(*pair, count) for pair in ends])


def diagonal_deviation(machine: Machine, error_mm: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Length deviation (n,) along a line of points (n, 3) with errors (n, 3), mm: u . (e(p) - e(s)), ISO 230-6."""
    along = points_mm[-1] - points_mm[0]
    return np.asarray((error_mm - error_mm[0]) @ (along / np.linalg.norm(along)))


def orientation_figures(source: ErrorSource) -> dict[str, Figure]:
    """Return the ranges of the tool's orientation V_A, V_B, V_C over the volume (ISO 230-1), urad.

    The tool turns against the workpiece by the sum of the angular errors of all axes, so each range is the sum of the
    ranges of three curves; constants and squareness do not turn the tool from place to place.
    """
    found = {}
    for letter in "ABC":
        names = [f"E{letter}{axis}" for axis in AXES]
        present = [name for name in names if name in source.errors.curves]
        value, gradient = 0.0, None
        for name in present:
            curve = source.errors.curves[name]
            value += float(np.ptp(curve.value))
            part = source.value_gradient(name, _range_weight(curve.value))
            gradient = part if gradient is None else gradient + part
        u = math.nan if gradient is None else source.u_of(gradient)
        missing = [name for name in names if name not in present]
        without = f"; without {', '.join(missing)}, which the table does not hold" if missing else ""
        meaning = f"volumetric accuracy V_{letter}: range of the tool's orientation about {letter}{without}; ISO 230-1"
        found[f"V_{letter}"] = Figure(value / RAD_PER_URAD, u / RAD_PER_URAD, "urad", meaning)
    return found
