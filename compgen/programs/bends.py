"""How far the error can be off the chord of a move: an upper bound from the nodes of the curves that the move crosses.

Curves are straight between their nodes. With p along a move of length l, and the angular error w of an axis at q, its part of
the error at a lever v is w(q) x v. Between nodes w and v are linear along the move, so that

    E(p) - chord  <=  |dw/dq| |dq| l / 4        (w x v is quadratic; |dv| <= l)

At a node the slope jumps, by k (mm per mm of the axis; that of w times the lever), which adds

    k |dq| s (1 - s)  <=  k |dq| / 4            (the node is at share s of the move)

Squareness is linear along a move and does not bend. What finite rotations add is smaller than these by the errors
themselves, which ``_SLACK`` covers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.names import error_named

#: What the products of errors may add to a bound of first order.
_SLACK = 1.1


@dataclass(frozen=True)
class _Axis:
    """Nodes (n,) of the curves of an axis, mm; sums (n + 1,) of the jumps of slope up to each; slope of its rotations, rad/mm."""

    nodes_mm: FloatArray
    jumps: FloatArray
    slope_rad: float

    @staticmethod
    def of(linear: Iterable[tuple[int, Curve]], angular: Iterable[tuple[int, Curve]], lever_mm: float) -> _Axis:
        """Collect curves, each with its direction; those of rotations count with the lever."""
        curves = [(direction, curve, 1.0) for direction, curve in linear]
        curves += [(3 + direction, curve, lever_mm) for direction, curve in angular]
        every = np.unique(np.concatenate([np.zeros(0), *(curve.position_mm for _, curve, _ in curves)]))
        jump, slope = np.zeros((len(every), 6)), np.zeros((len(every) + 1, 6))
        for column, curve, factor in curves:
            # beyond its ends a curve is constant
            own = np.concatenate([[0.0], np.diff(curve.value) / np.diff(curve.position_mm), [0.0]])
            jump[np.searchsorted(every, curve.position_mm), column] += factor * np.diff(own)
            slope[:, column] += own[np.searchsorted(curve.position_mm, np.append(every, np.inf))]
        size = np.linalg.norm(jump[:, :3], axis=1) + np.linalg.norm(jump[:, 3:], axis=1)
        return _Axis(every, np.append(0.0, np.cumsum(size)), float(np.linalg.norm(slope[:, 3:], axis=1).max()))

    def jumped(self, low_mm: FloatArray, high_mm: FloatArray) -> FloatArray:
        """Sum of the jumps of slope between two places (n,), mm per mm."""
        first = np.searchsorted(self.nodes_mm, low_mm, side="left")
        return np.asarray(self.jumps[np.searchsorted(self.nodes_mm, high_mm, side="right")] - self.jumps[first])


@dataclass(frozen=True)
class Bends:
    """The bound for the errors of one machine; ``change`` is how much the error changes at most along a length, mm per mm."""

    axes: tuple[_Axis, _Axis, _Axis]
    change: float

    @staticmethod
    def of(errors: ErrorTable, reversal: ReversalCurves | None, lever_mm: float) -> Bends:
        """Return the bound for errors that no lever longer than ``lever_mm`` turns into a displacement."""
        linear: list[list[tuple[int, Curve]]] = [[], [], []]
        angular: list[list[tuple[int, Curve]]] = [[], [], []]
        change = sum(abs(value) for value, _ in errors.squareness.values())
        for name, curve in errors.curves.items():
            error = error_named(name)
            (linear if error.kind == "linear" else angular)[error.axis].append((error.direction, curve))
            steepest = float(np.abs(np.diff(curve.value) / np.diff(curve.position_mm)).max(initial=0.0))
            turned = 0.0 if error.kind == "linear" else float(np.abs(curve.value).max())
            change += steepest * (1.0 if error.kind == "linear" else lever_mm) + turned
        for (axis, component), curve in {} if reversal is None else reversal.curves.items():
            half = Curve(curve.position_mm, 0.5 * curve.value, curve.u)
            linear[axis].append((component, half))
            change += float(np.abs(np.diff(half.value) / np.diff(half.position_mm)).max(initial=0.0))
        x, y, z = (_Axis.of(linear[k], angular[k], lever_mm) for k in range(3))
        return Bends((x, y, z), change)

    def parts(
        self, low_mm: FloatArray, high_mm: FloatArray, way_mm: FloatArray, length_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds (n,), mm, of what nodes and what levers bend along moves between places ``low_mm`` and ``high_mm`` (n, 3).

        ``way_mm`` (n, 3) is how far each axis goes at most, ``length_mm`` (n,) the whole. Of one of m equal parts of a move
        the first is smaller by m, the second by m squared.
        """
        nodes, levers = np.zeros((2, len(length_mm)))
        for k, axis in enumerate(self.axes):
            if len(axis.nodes_mm):
                nodes += axis.jumped(low_mm[:, k], high_mm[:, k]) * way_mm[:, k]
            levers += axis.slope_rad * way_mm[:, k] * length_mm
        return 0.25 * _SLACK * nodes, 0.25 * _SLACK * levers
