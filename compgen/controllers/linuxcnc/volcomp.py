"""The table of the LinuxCNC kinematics ``volkins``: E = C P or a grid, evaluated in the arithmetic of the C sources.

E(q, t) is the error of the tool tip (actual minus commanded) with the axes at q and the tool offset t; the tip stands at
P = q + E(q, t) (less the tool offset), so the control sends the axes to q = P - E(q, t), by iteration.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from compgen.controllers.trilinear import trilinear
from compgen.core.csvio import FloatArray
from compgen.errors import InputError

#: Factors of a term, in the words of the file.
LEVERS = ("1", "x", "y", "z", "tx", "ty", "tz")
#: Limits of ``volcomp.h``.
MOST_CURVES, MOST_TERMS, MOST_NODES, MOST_VERTICES, LONGEST_NAME = 64, 512, 10_000, 100_000, 31
#: The iteration of the inverse ends when no axis moves by more than this and this part of its coordinate (far from
#: machine zero neighbouring numbers differ by more than the first), or fails after so many rounds.
LAST_STEP_MM, LAST_PART, MOST_ROUNDS = 1e-13, 1e-15, 50


@dataclass(frozen=True)
class VolCurve:
    """One curve over ``axis``: values (n,) in mm or rad at ``first_mm + k step_mm``; the end values hold outside."""

    name: str
    axis: int
    first_mm: float
    step_mm: float
    values: FloatArray

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions of the values, shape (n,)."""
        return np.asarray(self.first_mm + self.step_mm * np.arange(len(self.values)), dtype=np.float64)

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at positions (m,)."""
        last = len(self.values) - 1
        ratio = np.clip((position_mm - self.first_mm) / self.step_mm, 0.0, float(last))
        left = np.minimum(ratio.astype(np.int64), max(last - 1, 0))
        right = np.minimum(left + 1, last)
        below = self.values[left]
        between = below + (ratio - left) * (self.values[right] - below)
        return np.asarray(np.where(ratio >= last, self.values[last], between))


@dataclass(frozen=True)
class VolTerm:
    """Adds coefficient x lever x curve to the error of axis ``output``; ``lever`` is one of :data:`LEVERS`."""

    output: int
    curve: str
    coefficient: float
    lever: str


@dataclass(frozen=True)
class VolGrid:
    """Errors ``vertices_mm`` (nx, ny, nz, 3) at ``first_mm + (i, j, k) step_mm``, for one tool offset."""

    first_mm: tuple[float, float, float]
    step_mm: tuple[float, float, float]
    vertices_mm: FloatArray


@dataclass(frozen=True)
class VolTable:
    """A table as the kinematics module reads it: curves with terms, or a grid.

    Numbers are in mm here; ``unit`` is that of the lengths in the file: the unit of the machine, ``"mm"`` or ``"inch"``.
    """

    curves: tuple[VolCurve, ...]
    terms: tuple[VolTerm, ...]
    grid: VolGrid | None = None
    unit: str = "mm"

    def scaled(self, factor: float) -> VolTable:
        """Return the table with all lengths times ``factor``: from the unit of the file to mm, and back.

        A curve is a length where a term takes it as it is (lever 1). Beside a lever it is an angle and has no unit; a curve
        that is used in both ways is taken as a length, and the coefficient of the terms with a lever makes up for it.
        """
        if factor == 1.0:
            return self
        lengths = {term.curve for term in self.terms if term.lever == LEVERS[0]}
        curves = tuple(
            replace(
                curve,
                first_mm=curve.first_mm * factor,
                step_mm=curve.step_mm * factor,
                values=curve.values * factor if curve.name in lengths else curve.values,
            )
            for curve in self.curves
        )
        both = {term for term in self.terms if term.curve in lengths and term.lever != LEVERS[0]}
        terms = tuple(
            replace(term, coefficient=term.coefficient / factor) if term in both else term for term in self.terms
        )
        grid = self.grid
        if grid is not None:
            x, y, z = (value * factor for value in grid.first_mm)
            hx, hy, hz = (value * factor for value in grid.step_mm)
            grid = VolGrid((x, y, z), (hx, hy, hz), grid.vertices_mm * factor)
        return VolTable(curves, terms, grid, self.unit)

    def error(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """E at axis positions (n, 3) with tool offsets (3,) or (n, 3): shape (n, 3), mm, actual minus commanded."""
        if self.grid is not None:
            return trilinear(
                self.grid.vertices_mm, np.array(self.grid.first_mm), np.array(self.grid.step_mm), position_mm
            )
        tool = np.broadcast_to(tool_mm, position_mm.shape)
        levers = dict(zip(LEVERS, [np.ones(len(position_mm)), *position_mm.T, *tool.T], strict=True))
        values = {curve.name: curve.at(position_mm[:, curve.axis]) for curve in self.curves}
        error = np.zeros((len(position_mm), 3))
        for term in self.terms:
            error[:, term.output] += term.coefficient * levers[term.lever] * values[term.curve]
        return error

    def forward(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Where the tip stands, less the tool offset, with the axes at positions (n, 3): shape (n, 3), mm."""
        return position_mm + self.error(position_mm, tool_mm)

    def inverse(self, wanted_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Axis positions at which the tip stands at ``wanted_mm`` (n, 3), less the tool offset: shape (n, 3), mm.

        InputError where the iteration does not end: no machine has such errors, and the control refuses to move.
        """
        axes = np.array(wanted_mm, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(MOST_ROUNDS):
                following = wanted_mm - self.error(axes, tool_mm)
                ended = np.abs(following - axes) <= LAST_STEP_MM + LAST_PART * np.abs(following)
                axes = following
                if np.all(ended):
                    return axes
        raise InputError(
            "the errors of the table change too fast with position: no position puts the tool where it belongs"
        )

    def slope(self, lower_mm: FloatArray, upper_mm: FloatArray, tool_mm: FloatArray) -> float:
        """Upper bound of the change of E per mm of travel within a box; well below 1 the inverse exists and is unique."""
        if self.grid is not None:
            parts = [
                np.max(np.abs(np.diff(self.grid.vertices_mm, axis=axis)), initial=0.0) / step
                for axis, step in enumerate(self.grid.step_mm)
            ]
            return float(sum(parts))
        reach = np.concatenate([[1.0], np.maximum(np.abs(lower_mm), np.abs(upper_mm)), np.abs(tool_mm)])
        largest = dict(zip(LEVERS, reach.tolist(), strict=True))
        curves = {curve.name: curve for curve in self.curves}
        sums = np.zeros(3)
        for term in self.terms:
            curve = curves[term.curve]
            steepest = np.max(np.abs(np.diff(curve.values)), initial=0.0) / curve.step_mm
            own = np.max(np.abs(curve.values)) if term.lever in LEVERS[1:4] else 0.0
            sums[term.output] += abs(term.coefficient) * (largest[term.lever] * steepest + own)
        return float(np.max(sums))


def checksum(words: Iterable[str]) -> str:
    """CRC-32 of the words from ``volcomp`` to ``end`` with one blank between two, as 8 hexadecimal digits.

    >>> checksum("volcomp 1 end".split())
    'CF835787'
    """
    total, joint = 0, b""
    for word in words:
        total = zlib.crc32(joint + word.encode("ascii", "replace"), total)
        joint = b" "
    return f"{total:08X}"
