"""All figures of a machine from its errors: curves, straightness, squareness, diagonals and reversal."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.accuracy.field import (
    Alignment,
    ErrorField,
    ErrorSource,
    Figure,
    aligned,
    grid_points,
    range_weight,
    volume_figures,
)
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ReversalCurves, fitted_line, hat_matrix, read_reversal
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import AXES, BODY_DIAGONALS, ERROR_INDEX, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.drawing.display import Bars, Drawable, Overview, Panel, shortened
from compgen.errors import InputError, Message
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.many_points import volume_grid

if TYPE_CHECKING:
    from compgen.identification import Identification

# Straightness against a stated reference line, and squareness of two reference lines (ISO 230-1).
#
# Straightness error: largest positive plus size of the largest negative distance from the reference line. The line
# passes through the end points, or is that of least squares or of the minimum zone. What the line removes from
# straightness belongs to squareness: squareness is the deviation of the angle between two reference lines from 90
# degrees, and both together leave the volumetric error unchanged.


#: Reference lines by the names of the command line.
LINES = {"end-point": "end points", "ls": "least squares", "minzone": "minimum zone"}


def straightness(position_mm: FloatArray, value_mm: FloatArray, line: str) -> tuple[float, FloatArray]:
    """Return the straightness error (mm), and its derivative (n,) by the values.

    Parameters
    ----------
    position_mm, value_mm : deviations across the axis (n,) at positions (n,), n > 1.
    line : ``"end-point"``, ``"ls"`` or ``"minzone"``.
    """
    _check(position_mm, line)
    constant, slope = fitted_line(position_mm, value_mm, line)
    rest = value_mm - constant - slope * position_mm
    high, low = int(np.argmax(rest)), int(np.argmin(rest))
    if line == "minzone":  # the width is the distance of the single contact from the line through the two others
        first, last, against, side = _contacts(position_mm, rest)
        share = (position_mm[against] - position_mm[first]) / (position_mm[last] - position_mm[first])
        derivative = np.zeros(len(rest))
        derivative[against] += side
        derivative[first] -= side * (1.0 - share)
        derivative[last] -= side * share
        return float(np.ptp(rest)), derivative
    return float(np.ptp(rest)), range_weight(rest) - (position_mm[high] - position_mm[low]) * slope_weights(
        position_mm, line
    )


def slope_weights(position_mm: FloatArray, line: str, value: FloatArray | None = None) -> FloatArray:
    """Derivative (n,) of the slope of a reference line by the values; the minimum zone depends on the values (n,)."""
    _check(position_mm, line)
    weights = np.zeros(len(position_mm))
    if line == "ls":
        centred = position_mm - position_mm.mean()
        return np.asarray(centred / (centred @ centred))
    first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
    if line == "minzone":
        if value is None:
            raise ValueError("the line of the minimum zone depends on the values")
        constant, slope = fitted_line(position_mm, value, line)
        first, last, _, _ = _contacts(position_mm, value - constant - slope * position_mm)
    length = position_mm[last] - position_mm[first]
    weights[first], weights[last] = -1.0 / length, 1.0 / length
    return weights


def _check(position_mm: FloatArray, line: str) -> None:
    if line not in LINES:
        raise InputError(
            Message(
                "reference-line-unknown",
                "{line!r} is not a reference line; use one of {known}",
                line=line,
                known=", ".join(LINES),
            )
        )
    if len(position_mm) < 2:
        raise InputError(Message("straightness-few-positions", "straightness needs values at two or more positions"))


def _contacts(position_mm: FloatArray, rest: FloatArray) -> tuple[int, int, int, float]:
    """Return two points on one side of the zone, the one between them on the other, and the sign of the other side."""
    half = 0.5 * float(np.ptp(rest))
    tolerance = 1e-9 * max(half, 1e-12) + 1e-15
    for side in (1.0, -1.0):
        touching = np.flatnonzero(side * rest >= float(np.max(side * rest)) - tolerance)
        against = int(np.argmin(side * rest))
        first, last = int(touching[0]), int(touching[-1])
        if first != last and position_mm[first] <= position_mm[against] <= position_mm[last]:
            return first, last, against, -side
    first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
    return first, last, int(np.argmin(rest)), -1.0


# Figures of identified errors: single curves, squareness, axes, diagonals, orientation.


#: Points along a diagonal.
ALONG_DIAGONAL = 41
#: The squareness errors by (axis whose line turns, component, reference axis, its component).
SQUARENESS_LINES = {"EC0Y": (1, 0, 0, 1), "EB0Z": (2, 0, 0, 2), "EA0Z": (2, 1, 1, 2)}


def error_figures(source: ErrorSource, line: str = "ls") -> dict[str, Figure]:
    """Return one figure for each error of the table, by its name.

    Straightness refers to the reference line ``line``; positioning and angular errors are given as their range over the
    travel; squareness of the table is taken between the lines ``line`` of its straightness curves. None of these
    depends on constants in a table, nor straightness and squareness together on lines in it.
    """
    found = {}
    for name in source.shown.curves:
        found[name] = _curve_figure(source, name, line)
    for name in source.shown.squareness:
        found[name] = squareness_figure(source, name, line)
    return found


def straightness_figures(source: ErrorSource) -> dict[str, dict[str, Figure]]:
    """Return every straightness of the table against each of the three reference lines: by error, then by line."""
    names = [name for name in source.shown.curves if error_named(name).is_straightness]
    several = [name for name in names if len(source.shown.curves[name].value) > 1]
    return {name: {line: _curve_figure(source, name, line) for line in LINES} for name in several}


def _curve_figure(source: ErrorSource, name: str, line: str) -> Figure:
    error, curve = error_named(name), source.shown.curves[name]
    if error.is_straightness and len(curve.value) > 1:
        value, weight = straightness(curve.position_mm, curve.value, line)
        meaning = f"straightness {name}, reference line: {LINES[line]}; ISO 230-1"
    else:
        value, weight = float(np.ptp(curve.value)), range_weight(curve.value)
        meaning = f"angular error {name}, range over the travel"
        if error.kind == "linear":
            meaning = f"mean bidirectional positioning error M (ISO 230-2) {name}, range over the travel"
    u = source.u_of(source.value_gradient(name, weight))
    return Figure(value / error.si_per_unit, u / error.si_per_unit, error.unit, meaning)


def squareness_figure(source: ErrorSource, name: str, line: str = "ls") -> Figure:
    """Return a squareness error (urad) between the reference lines of its two axes.

    The slopes of the reference lines of the straightness curves are added to the value of the table: moving a line from
    a curve to the squareness changes neither this figure nor the volumetric error.
    """
    value = source.errors.squareness[name][0]
    gradient = source.value_gradient(name, np.ones(1))
    # A slope a of EXY moves x by a Y, as EC0Y does by -EC0Y Y (docs/conventions.md); a slope of EYX turns the reference line
    # of X the same way. So the slopes of two curves act like the squareness error, with the sign that C gives it.
    axis, component, other, across = SQUARENESS_LINES[name]
    unit = np.zeros((1, 3))
    unit[0, axis] = 1.0
    column = c_matrix(source.machine, unit, np.zeros(3))[0, :, ERROR_INDEX[name]]
    factor = 1.0 / column[component] if column[component] else -1.0  # squareness_reference = "Y": dY = -X EC0Y
    for curve_name in (f"E{AXES[component]}{AXES[axis]}", f"E{AXES[across]}{AXES[other]}"):
        curve = source.shown.curves.get(curve_name)
        if curve is None or len(curve.value) < 2:
            continue
        weights = factor * slope_weights(curve.position_mm, line, curve.value)
        value += float(weights @ curve.value)
        gradient = gradient + source.value_gradient(curve_name, weights)
    meaning = f"squareness {name} between reference lines of {LINES[line]}; ISO 230-1"
    return Figure(value / RAD_PER_URAD, source.u_of(gradient) / RAD_PER_URAD, "urad", meaning)


def axis_figures(source: ErrorSource) -> dict[str, Figure]:
    """Return for each axis the range of its positioning error along the line through the reference point (``M_X`` ...)."""
    found, lines = {}, []
    for k in range(3):
        levels = levels_of(source, k)
        points = np.tile(np.array(source.machine.reference_point_mm), (len(levels), 1))
        points[:, k] = levels
        lines.append(points)
    for k, (axis, part) in enumerate(zip(AXES, source.fields(lines), strict=True)):
        along = part.error_mm[:, k]
        weight = np.zeros_like(part.error_mm)
        weight[:, k] = range_weight(along)
        meaning = f"mean bidirectional positioning error M of {axis} on the line through the reference point; ISO 230-2"
        found[f"M_{axis}"] = Figure.of_mm(np.ptp(along), part.spread(weight), meaning)
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
    diagonals = [diagonal_points(machine, signs) for signs in BODY_DIAGONALS.values()]
    for name, points, part in zip(BODY_DIAGONALS, diagonals, source.fields(diagonals), strict=True):
        along = points[-1] - points[0]
        unit = along / np.linalg.norm(along)
        deviation = diagonal_deviation(machine, part.error_mm, points)
        u_mm = part.spread(range_weight(deviation)[:, None] * unit)
        found[name] = Figure.of_mm(np.ptp(deviation), u_mm, f"systematic error E of the diagonal {name}; ISO 230-6")
    worst = max(found, key=lambda name: found[name].value)
    return {
        **found,
        "Ed": replace(found[worst], meaning=f"largest systematic error of the body diagonals, {worst}; ISO 230-6"),
    }


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

    The tool rotates relative to the workpiece by the sum of the angular errors of all axes, so each range is the sum of
    the ranges of three curves; constants and squareness do not change the orientation over the volume.
    """
    found = {}
    for letter in "ABC":
        names = [f"E{letter}{axis}" for axis in AXES]
        present = [name for name in names if name in source.errors.curves]
        value, gradient = 0.0, None
        for name in present:
            curve = source.shown.curves.get(name, source.errors.curves[name])
            value += float(np.ptp(curve.value))
            part = source.value_gradient(name, range_weight(curve.value))
            gradient = part if gradient is None else gradient + part
        u = math.nan if gradient is None else source.u_of(gradient)
        missing = [name for name in names if name not in present]
        without = f"; without {', '.join(missing)}, which the table lacks" if missing else ""
        meaning = f"volumetric accuracy V_{letter}: range of the tool's orientation about {letter}{without}; ISO 230-1"
        found[f"V_{letter}"] = Figure(value / RAD_PER_URAD, u / RAD_PER_URAD, "urad", meaning)
    return found


# Reversal in addition to the errors: figures of both directions along the axes (ISO 230-2) and diagonals (ISO 230-6).
#
# The errors are the means of both directions; with the reversal B(q) the tip is at e + B/2 after positive travel and at
# e - B/2 after negative travel. So B is the largest |B(q)| and E the range over both. Along a diagonal in the direction s every
# axis that moves adds its own reversal: B(p) = u . sum_k s_k B_k(p).


#: Key of a curve, position on its axis (mm), factor.
Term = tuple[tuple[int, int], float, float]


@dataclass(frozen=True)
class KnownReversal:
    """Reversal of a machine, None if unknown; ``text`` gives its source or why there is none."""

    curves: ReversalCurves | None
    text: str


def identified_reversal(found: Identification) -> KnownReversal:
    """Return the reversal in the readings, with its uncertainty, whether or not it is worth a table."""
    if found.reversal_curves is not None:
        return KnownReversal(found.reversal_curves, "reversal: identified, over the position of each axis")
    if found.reversal is None:
        if found.method in ("joint", "two-step", "deviations"):
            return KnownReversal(None, "reversal: unknown: no position in the file was approached from both directions")
        return KnownReversal(
            None, "reversal: unknown: none exceeds its uncertainty, or only one direction was measured"
        )
    curves = {}
    for name, axis in found.reversal.axes.items():
        for component, (value, u) in enumerate(zip(axis.vector_mm, axis.u_mm, strict=True)):
            curves[AXES.index(name), component] = Curve(np.zeros(1), np.array([value]), np.array([u]))
    return KnownReversal(ReversalCurves(curves), "reversal: identified, one mean for each axis")


def reversal_beside(path: Path) -> KnownReversal:
    """Return the reversal that belongs to an errors file.

    It is in ``NAME.reversal.csv``, for fitted errors in that of the identified ones; a reversal not worth a table is in
    ``identify.json`` in the same folder.
    """
    stem = path.name.removesuffix(".errors.csv")
    names = [f"{stem}.reversal.csv", *(["identified.reversal.csv"] if stem == "fitted" else [])]
    named = next((path.parent / name for name in names if (path.parent / name).is_file()), None)
    curves = {}
    whole = path.parent / "identify.json"
    if stem in ("identified", "fitted") and whole.is_file():
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError):  # an unrelated file of that name
            read = {}
            for name, item in (json.loads(read_text(whole)).get("reversal") or {}).get("axes", {}).items():
                for component, (value, u) in enumerate(zip(item["vector_um"], item["u_um"], strict=True)):
                    parts = np.array([float(value)]) * MM_PER_UM, np.array([float(u)]) * MM_PER_UM
                    read[AXES.index(name), component] = Curve(np.zeros(1), *parts)
            curves = read
    if named is None and not curves:
        return KnownReversal(
            None, f"reversal: unknown: errors are means of both directions, and {names[-1]} does not exist"
        )
    where = " and ".join([*([named.name] if named else []), *(["identify.json"] if curves else [])])
    curves |= {} if named is None else read_reversal(named).curves
    return KnownReversal(
        ReversalCurves(curves),
        f"reversal: {where}; a direction without one is left out",
    )


def reversal_figures(source: ErrorSource, reversal: ReversalCurves) -> dict[str, Figure]:
    """Return ``B_X``, ``B_mean_X``, ``E_X`` ... of the axes whose reversal is known, and of the body diagonals.

    Values of the reversal are taken as independent of each other and of the errors.
    """
    found: dict[str, Figure] = {}
    for axis, letter in enumerate(AXES):
        curve = reversal.curves.get((axis, axis))
        if curve is None:
            continue
        low, high = source.machine.axes[axis].range_mm
        inside = curve.position_mm[(curve.position_mm > low) & (curve.position_mm < high)]
        levels = np.unique(np.concatenate([levels_of(source, axis), inside]))
        points = np.tile(np.array(source.machine.reference_point_mm), (len(levels), 1))
        points[:, axis] = levels
        terms: list[list[Term]] = [[((axis, axis), float(q), 1.0)] for q in levels]
        mean = [((axis, axis), float(q), 1.0 / len(curve.value)) for q in curve.position_mm]
        where = f"of {letter} on the line through the reference point; ISO 230-2"
        found[f"B_{letter}"] = _largest(reversal, terms, f"largest reversal error {where}")
        found[f"B_mean_{letter}"] = _figure(reversal, mean, 0.0, 0.0, f"mean reversal error of {letter}; ISO 230-2")
        text = f"bidirectional systematic error {where}"
        found[f"E_{letter}"] = _both_ways(source.field(points), np.eye(3)[axis], reversal, terms, text)
    if not reversal.curves:
        return found
    sizes, errors = {}, {}
    for name, signs in BODY_DIAGONALS.items():
        points = diagonal_points(source.machine, signs)
        unit = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
        terms = [[((a, c), float(point[a]), float(signs[a] * unit[c])) for a, c in reversal.curves] for point in points]
        sizes[name] = _largest(reversal, terms, f"reversal error B of the diagonal {name}; ISO 230-6")
        text = f"bidirectional systematic error E of the diagonal {name}; ISO 230-6"
        errors[name] = _both_ways(source.field(points), unit, reversal, terms, text)
    found |= {f"B {name}": item for name, item in sizes.items()} | {f"E {name}": item for name, item in errors.items()}
    for key, group, text in (("Bd", sizes, "reversal error B"), ("Ed", errors, "bidirectional systematic error E")):
        worst = max(group, key=lambda name: group[name].value)
        found[key] = replace(group[worst], meaning=f"largest {text} of the body diagonals, {worst}; ISO 230-6")
    return found


def _value(reversal: ReversalCurves, terms: Sequence[Term]) -> float:
    return sum(factor * float(reversal.curves[key].at(np.array([q]))[0]) for key, q, factor in terms)


def _figure(reversal: ReversalCurves, terms: Sequence[Term], value_mm: float, u_mm: float, meaning: str) -> Figure:
    """Return a figure: a value with its uncertainty plus a sum of reversal values; nan if one is unknown."""
    square = 0.0
    for key in dict.fromkeys(key for key, _, _ in terms):
        curve = reversal.curves[key]
        gradient = sum(factor * hat_matrix(curve.position_mm, np.array([q]))[0] for k, q, factor in terms if k == key)
        weights = np.asarray(gradient)
        used = weights != 0.0
        square += float(np.sum((weights[used] * curve.u[used]) ** 2))
    return Figure.of_mm(value_mm + _value(reversal, terms), math.hypot(u_mm, math.sqrt(square)), meaning)


def _largest(reversal: ReversalCurves, terms: Sequence[Sequence[Term]], meaning: str) -> Figure:
    worst = max(terms, key=lambda item: abs(_value(reversal, item)))
    sign = -1.0 if _value(reversal, worst) < 0.0 else 1.0
    return _figure(reversal, [(key, q, sign * factor) for key, q, factor in worst], 0.0, 0.0, meaning)


def _both_ways(
    field: ErrorField, unit: FloatArray, reversal: ReversalCurves, terms: Sequence[Sequence[Term]], meaning: str
) -> Figure:
    """Return the range of mean +/- half the reversal over points, along a direction."""
    along = field.error_mm @ unit
    half = 0.5 * np.array([_value(reversal, item) for item in terms])
    both = np.concatenate([along + half, along - half])
    weight, parts, value = np.zeros_like(field.error_mm), [], 0.0
    for at, sign in ((int(np.argmax(both)), 1.0), (int(np.argmin(both)), -1.0)):
        row, way = at % len(along), 1.0 if at < len(along) else -1.0
        weight[row] += sign * unit
        value += sign * float(along[row])
        parts += [(key, q, 0.5 * sign * way * factor) for key, q, factor in terms[row]]
    return _figure(reversal, parts, value, field.spread(weight), meaning)


# All figures of a machine from its errors, or of its axes from positioning runs.


#: Points of the volume, and of the smaller grid for pairs of points.
MOST_POINTS, MOST_IN_PAIRS = 20_000, 1_750
#: The same for each of many draws.
DRAWN_POINTS = (1_750, 216)

Groups = Mapping[str, Mapping[str, Figure]]


@dataclass(frozen=True, repr=False)
class Accuracy(Drawable):
    """Figures by group (``volume``, ``orientation``, ``axes``, ``diagonals``, ``errors``, ``X`` ...) and key.

    ``statements`` says in words what they refer to: alignment, reference line, tool offset, edition. ``targets`` has
    the values at each target of groups from axis runs (:class:`compgen.accuracy.positioning.PositioningTest`).
    """

    groups: Groups
    statements: tuple[str, ...]
    targets: Mapping[str, Mapping[str, FloatArray]] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        groups = {name: {key: item.summary() for key, item in group.items()} for name, group in self.groups.items()}
        found: dict[str, Any] = {"figures": groups, "statements": list(self.statements)}
        if self.targets:
            found["targets"] = {
                name: {key: values.tolist() for key, values in columns.items()}
                for name, columns in self.targets.items()
            }
        return found

    def overview(self) -> Overview:
        """All figures with their expanded uncertainty."""
        rows = tuple(
            (f"{group} {key}", f"{item.value:.3f}", "" if np.isnan(item.u) else f"{item.expanded:.3f}", item.unit)
            for group, figures in self.groups.items()
            for key, item in figures.items()
        )
        title = f"{len(rows)} figures of {shortened(tuple(self.groups))}"
        return Overview(title, ("figure", "value", "U (k = 2)", "unit"), rows, self.statements)

    def panels(self) -> Sequence[Panel]:
        """The figures of each group, um and urad apart."""
        panels = []
        for group, figures in self.groups.items():
            for unit in ("um", "urad"):
                shown = {key: item.value for key, item in figures.items() if item.unit == unit}
                if shown:
                    panels.append(Panel(group, unit, bars=(Bars("", tuple(shown), tuple(shown.values())),)))
        return panels


def volume_fields(
    machine: Machine,
    sources: tuple[ErrorSource, ...],
    alignment: Alignment,
    most: tuple[int, int] = (MOST_POINTS, MOST_IN_PAIRS),
) -> list[tuple[ErrorField, ErrorField]]:
    """Return for each source its aligned field over the volume, and over the smaller grid of the pairs.

    All have the same points: the nodes of all curves within the travel and the middles between them, at ``most`` so many.
    """
    curves = [(error_named(name).axis, curve) for source in sources for name, curve in source.shown.curves.items()]
    nodes = any(source.undetermined for source in sources)  # curves that were not measured are in between, too
    x, y, z = (
        np.unique(
            np.concatenate(
                [
                    machine.axes[k].range_mm,
                    *([machine.axes[k].nodes_mm] if nodes else []),
                    *(c.position_mm for axis, c in curves if axis == k),
                ]
            )
        )
        for k in range(3)
    )
    grids = [grid_points(machine, volume_grid(machine, (x, y, z), n).levels_mm) for n in most]
    fields = [[aligned(machine, source.field(points), alignment) for points in grids] for source in sources]
    return [(full, pairs) for full, pairs in fields]


def accuracy_of_errors(
    source: ErrorSource, alignment: Alignment = "axes", line: str = "ls", reversal: KnownReversal | None = None
) -> Accuracy:
    """Return the figures of a machine: its volume (ISO 230-1), axes, diagonals (ISO 230-6), and each error.

    Parameters
    ----------
    source : errors and their uncertainty.
    alignment : how the volume is aligned, see :func:`compgen.accuracy.field.aligned`.
    line : reference line of straightness and squareness: ``"ls"``, ``"end-point"``, ``"minzone"``.
    reversal : reversal of the axes, if known.
    """
    ((full, pairs),) = volume_fields(source.machine, (source,), alignment)
    groups = {"volume": volume_figures(full, pairs), **groups_of_errors(source, line)}
    straight = straightness_figures(source)
    groups["straightness"] = {f"{name} {kind}": x for name, kinds in straight.items() for kind, x in kinds.items()}
    if source.undetermined and source.known:
        groups = _over_draws(source, groups, alignment, line)
    if reversal is not None and reversal.curves is not None:
        groups["reversal"] = reversal_figures(source, reversal.curves)
    said = () if reversal is None else (reversal.text,)
    return Accuracy(groups, (*source.assumed, *statements_of(source.machine, full, line), *said))


def _over_draws(
    source: ErrorSource, groups: Mapping[str, Mapping[str, Figure]], alignment: Alignment, line: str
) -> dict[str, dict[str, Figure]]:
    """Return the figures with mean and standard deviation over machines that measurement and prior allow, where these differ.

    A range, or a largest length, is no linear function of the errors: of an error of which nothing is known the mean is
    zero, but not its range. Where the mean over the draws is within the uncertainty of the figure, the figure stays. Draws are
    evaluated at fewer points: what they differ by is taken from the source at the same points.
    """
    values: dict[tuple[str, str], list[float]] = {(group, key): [] for group, part in groups.items() for key in part}

    def keep(one: ErrorSource) -> None:
        ((full, pairs),) = volume_fields(source.machine, (one,), alignment, DRAWN_POINTS)
        groups_found: dict[str, Any] = {"volume": volume_figures(full, pairs), **groups_of_errors(one, line)}
        for group, part in groups_found.items():
            for key, item in part.items():
                values[group, key].append(item.value)

    keep(source)
    for one in source.drawn():
        keep(one)
    result: dict[str, dict[str, Figure]] = {}
    for group, part in groups.items():
        result[group] = {}
        for key, item in part.items():
            found = values[group, key]
            drawn = np.array(found[1:]) - found[0] if found else np.zeros(0)
            if len(drawn) and not abs(drawn.mean()) <= item.u:
                meaning = f"{item.meaning.partition(', here ')[0]}; mean over what the measurement and the prior allow"
                mean = item.value + float(drawn.mean())
                item = replace(item, value=mean, u=float(drawn.std(ddof=1)), meaning=meaning)
            result[group][key] = item
    return result


def groups_of_errors(source: ErrorSource, line: str) -> dict[str, dict[str, Figure]]:
    """Return the groups of figures other than those of the volume."""
    return {
        "orientation": orientation_figures(source),
        "axes": axis_figures(source),
        "diagonals": diagonal_figures(source),
        "errors": error_figures(source, line),
    }


def statements_of(machine: Machine, field: ErrorField, line: str) -> tuple[str, ...]:
    """Return in words what the figures of a volume refer to."""
    tool = ", ".join(f"{value:g}" for value in machine.tool_offset_mm)
    ranges = ", ".join(f"{low:g} ... {high:g}" for low, high in (axis.range_mm for axis in machine.axes))
    return (
        f"volume {ranges} mm (X, Y, Z), {len(field)} points",
        f"alignment: {field.alignment}",
        f"tool offset ({tool}) mm",
        f"reference line of straightness and squareness: {line}",
        "checked against published formulas and worked examples, not certified",
    )


def narrowed(machine: Machine, lower_mm: FloatArray, upper_mm: FloatArray) -> Machine:
    """Return the machine with its travel reduced to the known part; the reference point is moved inside."""
    axes = []
    for k, axis in enumerate(machine.axes):
        low, high = max(axis.range_mm[0], float(lower_mm[k])), min(axis.range_mm[1], float(upper_mm[k]))
        inside = axis.nodes_mm[(axis.nodes_mm > low) & (axis.nodes_mm < high)]
        axes.append(replace(axis, range_mm=(low, high), nodes_mm=np.array([low, *inside, high])))
    point = [
        min(max(value, a.range_mm[0]), a.range_mm[1]) for value, a in zip(machine.reference_point_mm, axes, strict=True)
    ]
    return replace(machine, axes=(axes[0], axes[1], axes[2]), reference_point_mm=(point[0], point[1], point[2]))
