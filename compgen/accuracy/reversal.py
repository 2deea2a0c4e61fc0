"""Reversal beside the errors of a machine: figures of both directions along its axes (ISO 230-2) and diagonals (ISO 230-6).

The errors are the means of both directions; with the reversal B(q) the tip stands at e + B/2 after positive travel and at
e - B/2 after negative travel. So B is the largest |B(q)| and E the range over both. Along a diagonal in the direction s every
axis that moves adds its own reversal: B(p) = u . sum_k s_k B_k(p).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.accuracy.errors import diagonal_points, levels_of
from compgen.accuracy.field import Field
from compgen.accuracy.figure import Figure
from compgen.accuracy.source import ErrorSource
from compgen.core.csvio import FloatArray
from compgen.core.diagonals import BODY_DIAGONALS
from compgen.core.error_table import Curve
from compgen.core.files import read_text
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.reversal import ReversalCurves, read_reversal
from compgen.identify import Identification
from compgen.model.basis import hat_matrix

#: Key of a curve, position on its axis (mm), factor.
Term = tuple[tuple[int, int], float, float]


@dataclass(frozen=True)
class KnownReversal:
    """Reversal of a machine, None where it is not known; ``text`` says where it comes from or why there is none."""

    curves: ReversalCurves | None
    text: str


def identified_reversal(found: Identification) -> KnownReversal:
    """Return the reversal that readings show, with its uncertainty, whether or not it is worth a table."""
    if found.reversal_curves is not None:
        return KnownReversal(found.reversal_curves, "reversal: identified, over the position of each axis")
    if found.reversal is None:
        if found.method in ("joint", "two-step", "deviations"):
            return KnownReversal(
                None, "reversal: not known: no position was approached from both directions, as far as told"
            )
        return KnownReversal(
            None, "reversal: not known: none stands out of its uncertainty, or one direction was measured"
        )
    curves = {}
    for name, axis in found.reversal.axes.items():
        for component, (value, u) in enumerate(zip(axis.vector_mm, axis.u_mm, strict=True)):
            curves[AXES.index(name), component] = Curve(np.zeros(1), np.array([value]), np.array([u]))
    return KnownReversal(ReversalCurves(curves), "reversal: identified, one mean for each axis")


def reversal_beside(path: Path) -> KnownReversal:
    """Return the reversal that belongs to an errors file.

    It stands in ``NAME.reversal.csv``, of fitted errors in the identified one; what is not worth a table there, in
    ``identify.json`` beside it.
    """
    stem = path.name.removesuffix(".errors.csv")
    names = [f"{stem}.reversal.csv", *(["identified.reversal.csv"] if stem == "fitted" else [])]
    named = next((path.parent / name for name in names if (path.parent / name).is_file()), None)
    summed = _summed_up(path.parent / "identify.json") if stem in ("identified", "fitted") else {}
    if named is None and not summed:
        return KnownReversal(
            None, f"reversal: not known: errors are means of both directions, {names[-1]} is not there"
        )
    curves = {**summed, **({} if named is None else read_reversal(named).curves)}
    where = " and ".join([*([named.name] if named else []), *(["identify.json"] if summed else [])])
    return KnownReversal(ReversalCurves(curves), f"reversal: {where}; a direction that is not there counts as zero")


def _summed_up(path: Path) -> dict[tuple[int, int], Curve]:
    """Mean reversals of ``identify.json`` with their uncertainties; none if it holds none or is another file."""
    if not path.is_file():
        return {}
    curves = {}
    try:
        axes = (json.loads(read_text(path)).get("reversal") or {}).get("axes", {})
        for name, item in axes.items():
            for component, (value, u) in enumerate(zip(item["vector_um"], item["u_um"], strict=True)):
                parts = np.array([float(value)]) * MM_PER_UM, np.array([float(u)]) * MM_PER_UM
                curves[AXES.index(name), component] = Curve(np.zeros(1), *parts)
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
    return curves


def reversal_figures(source: ErrorSource, reversal: ReversalCurves) -> dict[str, Figure]:
    """Return ``B_X``, ``B_mean_X``, ``E_X`` ... of the axes whose reversal is known, and of the body diagonals.

    Values of the reversal count as independent of each other and of the errors.
    """
    found: dict[str, Figure] = {}
    for axis, letter in enumerate(AXES):
        if (axis, axis) in reversal.curves:
            found |= _of_axis(source, reversal, axis, letter)
    return {**found, **_of_diagonals(source, reversal)} if reversal.curves else found


def _of_axis(source: ErrorSource, reversal: ReversalCurves, axis: int, letter: str) -> dict[str, Figure]:
    curve = reversal.curves[axis, axis]
    low, high = source.machine.axes[axis].range_mm
    inside = curve.position_mm[(curve.position_mm > low) & (curve.position_mm < high)]
    levels = np.unique(np.concatenate([levels_of(source, axis), inside]))
    points = np.tile(np.array(source.machine.reference_point_mm), (len(levels), 1))
    points[:, axis] = levels
    terms = [[((axis, axis), float(q), 1.0)] for q in levels]
    unit = np.eye(3)[axis]
    field = source.field(points)
    share = 1.0 / len(curve.value)
    mean = [((axis, axis), float(q), share) for q in curve.position_mm]
    where = f"of {letter} on the line through the reference point; ISO 230-2"
    return {
        f"B_{letter}": _largest(reversal, terms, f"largest reversal error {where}"),
        f"B_mean_{letter}": _figure(reversal, mean, 0.0, 0.0, f"mean reversal error of {letter}; ISO 230-2"),
        f"E_{letter}": _both_ways(field, unit, reversal, terms, f"bidirectional systematic error {where}"),
    }


def _of_diagonals(source: ErrorSource, reversal: ReversalCurves) -> dict[str, Figure]:
    sizes, errors = {}, {}
    for name, signs in BODY_DIAGONALS.items():
        points = diagonal_points(source.machine, signs)
        unit = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
        terms = [[((a, c), float(point[a]), float(signs[a] * unit[c])) for a, c in reversal.curves] for point in points]
        field = source.field(points)
        sizes[name] = _largest(reversal, terms, f"reversal error B of the diagonal {name}; ISO 230-6")
        text = f"bidirectional systematic error E of the diagonal {name}; ISO 230-6"
        errors[name] = _both_ways(field, unit, reversal, terms, text)
    found = {f"B {name}": item for name, item in sizes.items()} | {f"E {name}": item for name, item in errors.items()}
    for key, group, text in (("Bd", sizes, "reversal error B"), ("Ed", errors, "bidirectional systematic error E")):
        worst = max(group, key=lambda name: group[name].value)
        found[key] = replace(group[worst], meaning=f"largest {text} of the body diagonals, {worst}; ISO 230-6")
    return found


def _value(reversal: ReversalCurves, terms: Sequence[Term]) -> float:
    return sum(factor * float(reversal.curves[key].at(np.array([q]))[0]) for key, q, factor in terms)


def _u(reversal: ReversalCurves, terms: Sequence[Term]) -> float:
    """Standard uncertainty of a sum of values of the curves; nan where one is not known."""
    square = 0.0
    for key in dict.fromkeys(key for key, _, _ in terms):
        curve = reversal.curves[key]
        gradient = sum(factor * hat_matrix(curve.position_mm, np.array([q]))[0] for k, q, factor in terms if k == key)
        weights = np.asarray(gradient)
        used = weights != 0.0
        square += float(np.sum((weights[used] * curve.u[used]) ** 2))
    return math.sqrt(square)


def _figure(reversal: ReversalCurves, terms: Sequence[Term], value_mm: float, u_mm: float, meaning: str) -> Figure:
    """A figure of a value with its own uncertainty plus a sum of reversal values."""
    value, u = value_mm + _value(reversal, terms), math.hypot(u_mm, _u(reversal, terms))
    return Figure(value / MM_PER_UM, u / MM_PER_UM, "um", meaning)


def _largest(reversal: ReversalCurves, terms: Sequence[Sequence[Term]], meaning: str) -> Figure:
    worst = max(terms, key=lambda item: abs(_value(reversal, item)))
    sign = -1.0 if _value(reversal, worst) < 0.0 else 1.0
    return _figure(reversal, [(key, q, sign * factor) for key, q, factor in worst], 0.0, 0.0, meaning)


def _both_ways(
    field: Field, unit: FloatArray, reversal: ReversalCurves, terms: Sequence[Sequence[Term]], meaning: str
) -> Figure:
    """Range of mean +/- half the reversal over points, along a direction."""
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
