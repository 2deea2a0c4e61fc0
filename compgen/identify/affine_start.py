"""A better start: the machine as an affine map (scales and squareness), stations and dead lengths, from a few readings.

A squareness of milliradians moves the stations of the closed form by millimetres. Taken out beforehand, the lines of
sight of the first normal matrix are right, and its factor serves until the end.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError

from compgen.core.csvio import FloatArray
from compgen.core.machine import Reference
from compgen.core.names import AXES
from compgen.identify.grid import nominal_targets
from compgen.identify.grid_problem import GridProblem
from compgen.identify.solver import factorise
from compgen.identify.state import State

#: Cells of the grid that are looked at, spread over the volume.
SAMPLE = 150
#: One step leaves less than what the curves, which the map does not hold, do to it anyway.
STEPS = 1
#: Reciprocal condition below which the readings do not determine the affine map, and the start is left as it is.
LEAST_RCOND = 1e-12


def affine_start(problem: GridProblem, start: State) -> State:
    """Return ``start`` with squareness, scales, stations and dead lengths improved; unchanged where that fails."""
    if len(problem.tools) != 1:
        return start
    data = problem.tools[0]
    target = nominal_targets(problem)[0]
    picked = _spread(target.shape[1])
    p = target[:, picked].T
    weight = data.weight.reshape(problem.groups, -1)[:, picked]
    reading = data.length_mm.reshape(problem.groups, -1)[:, picked]
    fields = _fields(p, problem.parameters.machine.squareness_reference)
    affine, stations, dead = np.zeros(6), start.stations_mm.copy(), start.dead_length_mm.copy()
    for _ in range(STEPS):
        tip = p + fields @ affine
        sight = tip[None] - stations[problem.station_of][:, None]
        distance = np.linalg.norm(sight, axis=2)
        unit = sight / distance[:, :, None]
        residual = distance - dead[:, None] - reading
        step = _step(problem, fields, unit, residual, weight)
        if step is None or not np.isfinite(step).all():
            return start
        affine += step[:6]
        stations += step[6 : 6 + stations.size].reshape(-1, 3)
        dead += step[6 + stations.size :]
    return State(_errors(problem, affine), stations, dead)


def _spread(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.round(np.linspace(0, count - 1, min(count, SAMPLE))).astype(np.int64)


def _fields(p: FloatArray, reference: Reference) -> FloatArray:
    """Displacement fields (n, 3, 6) at points (n, 3): scales of X, Y, Z, then EC0Y, EB0Z, EA0Z."""
    fields = np.zeros((len(p), 3, 6))
    for axis in range(3):
        fields[:, axis, axis] = p[:, axis]
    if reference == "Y":
        fields[:, 1, 3] = -p[:, 0]
    else:
        fields[:, 0, 3] = -p[:, 1]
    fields[:, 0, 4] = p[:, 2]
    fields[:, 1, 5] = -p[:, 2]
    return fields


def _step(
    problem: GridProblem, fields: FloatArray, unit: FloatArray, residual: FloatArray, weight: FloatArray
) -> FloatArray | None:
    groups, count = residual.shape
    size = 6 + 3 * problem.stations + groups
    jacobian = np.zeros((groups, count, size))
    jacobian[:, :, :6] = np.einsum("gna,nak->gnk", unit, fields)
    for group, station in enumerate(problem.station_of.tolist()):
        jacobian[group, :, 6 + 3 * station : 9 + 3 * station] = -unit[group]
        jacobian[group, :, 6 + 3 * problem.stations + group] = -1.0
    root = np.sqrt(weight)[:, :, None]
    rows = (jacobian * root).reshape(-1, size)
    matrix = rows.T @ rows
    gradient = rows.T @ (residual[:, :, None] * root).ravel()
    try:
        factor = factorise(matrix)
    except LinAlgError:
        return None
    return None if factor.rcond < LEAST_RCOND else -factor.solve(gradient)


def _errors(problem: GridProblem, affine: FloatArray) -> FloatArray:
    """Put scales into the slopes of EXX, EYY, EZZ and squareness where they belong; what is not modelled is left out."""
    parameters = problem.parameters
    errors = np.zeros(parameters.size)
    for curve in parameters.curves:
        axis = curve.error.axis
        if curve.error.name == f"E{AXES[axis]}{AXES[axis]}":
            reference = parameters.machine.reference_point_mm[axis]
            if parameters.machine.curves == "linear" and np.count_nonzero(curve.free) == curve.free.shape[1]:
                errors[curve.columns] = affine[axis] * (curve.nodes_mm - reference) @ curve.free  # picks free nodes
                continue
            line = affine[axis] * (problem.levels_mm[axis] - reference)
            reduced = problem.bases[axis] @ curve.free
            errors[curve.columns] = np.linalg.lstsq(reduced, line, rcond=1e-9)[0]
    first = parameters.size - len(parameters.squareness)
    for k, name in enumerate(parameters.squareness):
        errors[first + k] = affine[3 + ("EC0Y", "EB0Z", "EA0Z").index(name)]
    return errors
