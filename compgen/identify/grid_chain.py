"""The chain of the machine on a grid of levels: points after each body, and the gradient back along the same way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.grid import Grid
from compgen.identify.state import State
from compgen.model.exact import passing_order
from compgen.model.rotation import level_rotations


@dataclass(frozen=True)
class Body:
    """One carriage at its levels: rotation R (n, 3, 3), J_l (n, 3, 3), travel plus delta (n, 3), rows of its levels."""

    axis: int
    tool_side: bool
    rotation: FloatArray
    jacobian: FloatArray
    shift: FloatArray
    position_mm: FloatArray
    direction_derivative: FloatArray
    rows: slice


def bodies_at(grid: Grid, state: State) -> list[Body]:
    """Bodies in the order in which the tool point passes them (innermost first)."""
    directions, derivatives = grid.travel(state)
    motion = (grid.motion.dense @ state.errors).reshape(-1, 6)
    rotation, jacobian = level_rotations(motion[:, 3:])
    own = level_slices(grid.levels_mm)
    return [
        Body(
            axis,
            tool_side,
            rotation[own[axis]],
            jacobian[own[axis]],
            grid.levels_mm[axis][:, None] * directions[axis] + motion[own[axis], :3],
            grid.levels_mm[axis],
            derivatives[axis],
            own[axis],
        )
        for axis, tool_side in passing_order(grid.parameters.machine)
    ]


def level_slices(levels_mm: Sequence[FloatArray]) -> list[slice]:
    """Rows of the levels of X, Y and Z where they stand one after another."""
    bounds = np.cumsum([0, *(len(levels) for levels in levels_mm)]).tolist()
    return [slice(bounds[axis], bounds[axis + 1]) for axis in range(3)]


def points_along(bodies: Sequence[Body], tool_mm: FloatArray) -> list[FloatArray]:
    """Points before the first body (1, 3, 1) and after each body (n_axis, 3, product of the earlier levels)."""
    points = [tool_mm.reshape(1, 3, 1)]
    for body in bodies:
        before = _flat(points[-1])
        shift = body.shift if body.tool_side else np.einsum("lij,lj->li", body.rotation, body.shift)
        points.append(shift[:, :, None] + body.rotation @ before)
    return points


def lengths_of(vectors: FloatArray) -> FloatArray:
    """Lengths of vectors (..., 3, m): shape (..., m)."""
    squares = vectors * vectors
    total = squares[..., 0, :] + squares[..., 1, :]
    total += squares[..., 2, :]
    return np.asarray(np.sqrt(total, out=total))


def _flat(points: FloatArray) -> FloatArray:
    """(n, 3, m) -> (3, n * m)."""
    return np.ascontiguousarray(points.transpose(1, 0, 2)).reshape(3, -1)


def pull_back(
    grid: Grid,
    bodies: Sequence[Body],
    tips: Sequence[FloatArray],
    force: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the gradient by the errors for forces on the tips (n_out, 3, m): back along the chain, body by body."""
    parameters = grid.parameters
    first = parameters.size - len(parameters.squareness)
    by_motion = np.empty((grid.first_rows[3], 6))
    for body, before in zip(reversed(bodies), reversed(tips[:-1]), strict=True):
        turned = body.rotation.transpose(0, 2, 1) @ force
        arm = turned @ _flat(before).T  # [level, force component, arm component]
        moment = arm[:, (2, 0, 1), (1, 2, 0)] - arm[:, (1, 2, 0), (2, 0, 1)]
        total = turned.sum(axis=2)
        if body.tool_side:
            by_delta = force.sum(axis=2)
        else:
            by_delta = total
            moment += np.cross(body.shift, total)
        by_motion[body.rows, :3] = by_delta
        by_eps = body.jacobian.transpose(0, 2, 1) @ (body.rotation @ moment[:, :, None])
        by_motion[body.rows, 3:] = by_eps[:, :, 0]
        if parameters.squareness:
            by_squareness = (body.position_mm @ by_delta) @ body.direction_derivative
            for k, name in enumerate(parameters.squareness):
                gradient[first + k] += by_squareness[SQUARENESS_NAMES.index(name)]
        force = turned.sum(axis=0).reshape(3, before.shape[0], before.shape[2]).transpose(1, 0, 2)
    gradient[: parameters.size] += by_motion.ravel() @ grid.motion.dense
