"""Fields of position errors: how they are aligned, and the figures of a volume with their uncertainty.

Every figure is taken as a linear functional of the field near where it stands: sum(weight * error) over few points. So
its uncertainty is that of the functional, from the joint covariance of what the field is made of, alignment included.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from compgen.accuracy.figure import Figure
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError
from compgen.verify.residuals import without_rigid_motion

#: Standard uncertainty (mm) of sum(weight * error) for weights (n, 3); nan if it is not known.
Spread = Callable[[FloatArray], float]
Alignment = Literal["as-given", "axes", "best-fit"]

ALIGNMENTS = ("as-given", "axes", "best-fit")
_SAME_MM = 1e-6


@dataclass(frozen=True)
class Field:
    """Position errors (n, 3) of the tool tip at commanded positions (n, 3), mm, and how well they are known.

    ``tip_mm`` is where the tip should be (position and tool offset), (n, 3); a rigid motion turns about it.
    ``alignment`` says in words what was taken out.
    """

    position_mm: FloatArray
    tip_mm: FloatArray
    error_mm: FloatArray
    spread: Spread
    alignment: str = "as given"

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)


def unknown_spread(_: FloatArray) -> float:
    """Spread of a field whose uncertainty is not known."""
    return math.nan


def independent_spread(u_mm: FloatArray) -> Spread:
    """Spread of errors whose components have independent standard uncertainties (n, 3), mm."""

    def spread(weight: FloatArray) -> float:
        used = weight != 0.0
        return math.sqrt(float(np.sum((weight[used] * u_mm[used]) ** 2)))

    return spread


def _rigid(tip_mm: FloatArray) -> FloatArray:
    """Fields of three translations and three rotations (about machine zero), shape (n, 3, 6)."""
    fields = np.zeros((len(tip_mm), 3, 6))
    fields[:, range(3), range(3)] = 1.0
    for k in range(3):
        fields[:, :, 3 + k] = np.cross(np.eye(3)[k], tip_mm)
    return fields


def _without(field: Field, parameters: FloatArray, error_mm: FloatArray, text: str) -> Field:
    """Field with ``error_mm``, of which a rigid motion was taken out that ``parameters`` (6, n, 3) read off the field."""
    motion = _rigid(field.tip_mm)

    def spread(weight: FloatArray) -> float:
        through = np.einsum("nij,ni->j", motion, weight)
        return field.spread(weight - np.einsum("j,jni->ni", through, parameters))

    return replace(field, error_mm=error_mm, spread=spread, alignment=text)


def aligned(machine: Machine, field: Field, alignment: Alignment) -> Field:
    """Return the field in the stated alignment.

    Parameters
    ----------
    machine : its reference point and squareness reference say which axis lines the alignment ``"axes"`` uses.
    field : any field; for ``"axes"`` it must hold the reference point and the ends of the lines through it.
    alignment : ``"as-given"``; ``"axes"``: zero at the reference point, primary axis X (Y if squareness counts from Y) and
        secondary axis Y (X) straight between their ends; ``"best-fit"``: the best rigid motion (least squares over all
        points, finite rotation) is taken out.
    """
    if alignment == "as-given":
        return field
    if alignment == "axes":
        return _to_axes(machine, field)
    motion = _rigid(field.tip_mm).reshape(-1, 6)
    scale = np.linalg.norm(motion, axis=0)
    inverse = np.linalg.pinv(motion / scale) / scale[:, None]
    error = without_rigid_motion(field.tip_mm, field.error_mm)
    return _without(field, inverse.reshape(6, -1, 3), error, "best-fit rigid motion taken out (least squares)")


def axis_lines(machine: Machine) -> FloatArray:
    """Reference point, then lower and upper end of the X and of the Y line through it, shape (5, 3), mm."""
    points = np.tile(np.array(machine.reference_point_mm), (5, 1))
    for axis in range(2):
        points[1 + 2 * axis, axis], points[2 + 2 * axis, axis] = machine.axes[axis].range_mm
    return points


def _to_axes(machine: Machine, field: Field) -> Field:
    rows = [_row_of(field, point) for point in axis_lines(machine)]
    parameters = np.zeros((6, len(field), 3))
    first, second = (0, 1) if machine.squareness_reference == "X" else (1, 0)
    for axis, other in ((first, True), (second, False)):
        low, high = rows[1 + 2 * axis], rows[2 + 2 * axis]
        length = machine.axes[axis].length_mm
        across = 1 - axis
        sign = 1.0 if axis == 0 else -1.0
        for row, side in ((low, -1.0), (high, 1.0)):
            if other:  # the primary axis fixes the rotation about z
                parameters[5, row, across] += side * sign / length
            parameters[3 + across, row, 2] -= side * sign / length  # dz along x: -B; dz along y: +A
    motion = _rigid(field.tip_mm)
    rotation = parameters[3:].copy()
    parameters[:3, rows[0]] = np.eye(3)
    parameters[:3] -= np.einsum("ij,jnk->ink", motion[rows[0]][:, 3:], rotation)
    amounts = np.einsum("jni,ni->j", parameters, field.error_mm)
    error = field.error_mm - np.einsum("nij,j->ni", motion, amounts)
    names = ("X", "Y")
    text = (
        f"primary axis {names[first]}, secondary axis {names[second]}, end-point lines through the reference point "
        "(zero there)"
    )
    return _without(field, parameters, error, text)


def _row_of(field: Field, point_mm: FloatArray) -> int:
    distance = np.max(np.abs(field.position_mm - point_mm), axis=1)
    row = int(np.argmin(distance))
    if distance[row] > _SAME_MM:
        where = ", ".join(f"{value:g}" for value in point_mm)
        raise InputError(
            f"the alignment to the axes needs the point ({where}) mm, which is not there; take --alignment as-given or best-fit"
        )
    return row


def volume_figures(field: Field, pairs: Field | None = None) -> dict[str, Figure]:
    """Return the figures of a volume: ISO 230-1 ranges V_X, V_Y, V_Z, and ours, labelled as such.

    Parameters
    ----------
    field : the errors over the volume, aligned.
    pairs : a smaller set of points among which the largest length error is looked for; default the field itself.
    """
    where = f"over {len(field)} points, {field.alignment}"
    found = {}
    for k, axis in enumerate("XYZ"):
        meaning = f"volumetric accuracy V_{axis}: range of the {axis} deviation {where}; ISO 230-1"
        found[f"V_{axis}"] = _range(field, k, meaning)
    size = np.linalg.norm(field.error_mm, axis=1)
    rms = float(np.sqrt(np.mean(size**2)))
    worst = int(np.argmax(size))
    found["max"] = _figure(
        field, size[worst], _at(field, worst), f"largest length of the error vector {where}; own figure"
    )
    weight = field.error_mm / (len(field) * rms) if rms else np.zeros_like(field.error_mm)
    found["rms"] = _figure(field, rms, weight, f"root mean square of the error vector {where}; own figure")
    p95 = float(np.percentile(size, 95))
    near = int(np.argmin(np.abs(size - p95)))
    found["p95"] = _figure(field, p95, _at(field, near), f"95th percentile of its length {where}; own figure")
    return found | _between(pairs or field)


def _figure(field: Field, value_mm: float, weight: FloatArray, meaning: str) -> Figure:
    return Figure(float(value_mm) / MM_PER_UM, field.spread(weight) / MM_PER_UM, "um", meaning)


def _range(field: Field, component: int, meaning: str) -> Figure:
    along = field.error_mm[:, component]
    weight = np.zeros_like(field.error_mm)
    weight[int(np.argmax(along)), component] += 1.0
    weight[int(np.argmin(along)), component] -= 1.0
    return _figure(field, float(np.ptp(along)), weight, meaning)


def _at(field: Field, row: int, toward: FloatArray | None = None) -> FloatArray:
    """Weights that read off the length of the error at one point, or its part along ``toward`` (3,)."""
    weight = np.zeros_like(field.error_mm)
    vector = field.error_mm[row] if toward is None else toward
    size = float(np.linalg.norm(vector))
    weight[row] = vector / size if size else np.full(3, 1.0 / math.sqrt(3.0))
    return weight


def _between(field: Field) -> dict[str, Figure]:
    """Largest difference of two error vectors, and the largest error of a length between two points."""
    difference, length = _largest_pairs(field)
    where = f"any two of {len(field)} points"
    i, j = difference
    apart = field.error_mm[i] - field.error_mm[j]
    weight = _at(field, i, apart) - _at(field, j, apart)
    found = {
        "difference": _figure(
            field,
            float(np.linalg.norm(apart)),
            weight,
            f"largest difference of the error vectors of {where}; own figure",
        )
    }
    i, j = length
    line = field.tip_mm[i] - field.tip_mm[j]
    value = float(np.linalg.norm(line + apart_of(field, i, j)) - np.linalg.norm(line))
    weight = (_at(field, i, line) - _at(field, j, line)) * (1.0 if value >= 0 else -1.0)
    ends = f"({_place(field, i)}) and ({_place(field, j)}) mm"
    found["length"] = _figure(
        field, abs(value), weight, f"largest error of the distance between {where}, here {ends}; own figure"
    )
    return found


def apart_of(field: Field, first: int, second: int) -> FloatArray:
    """Difference (3,) of the errors of two points, mm."""
    return np.asarray(field.error_mm[first] - field.error_mm[second])


def _place(field: Field, row: int) -> str:
    return ", ".join(f"{value:.6g}" for value in field.position_mm[row])


def _largest_pairs(field: Field, block: int = 256) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows of the pair with the largest difference of vectors, and of that with the largest length error."""
    best = [(-1.0, (0, 0)), (-1.0, (0, 0))]
    tip, error = field.tip_mm, field.error_mm
    for first in range(0, len(tip), block):
        rows = slice(first, first + block)
        apart = error[rows, None] - error[None, first:]
        line = tip[rows, None] - tip[None, first:]
        squares = np.einsum("ijk,ijk->ij", apart, apart)
        # |line + apart| - |line| without the loss of digits that the difference of two roots has
        before = np.sqrt(np.einsum("ijk,ijk->ij", line, line))
        after = np.sqrt(np.einsum("ijk,ijk->ij", line + apart, line + apart))
        gain = 2.0 * np.einsum("ijk,ijk->ij", line, apart) + squares
        sizes = np.abs(np.divide(gain, before + after, out=np.zeros_like(gain), where=(before + after) > 0.0))
        for k, values in enumerate((squares, sizes)):
            at = int(np.argmax(values))
            if values.flat[at] > best[k][0]:
                i, j = divmod(at, len(tip) - first)
                best[k] = (float(values.flat[at]), (first + i, first + j))
    return best[0][1], best[1][1]
