"""Identification in the steps of Zha & Zhang 2024, sections 4 and 5: self-calibration, transformation, separation.

The tracers locate themselves and every target point without any knowledge of the machine; the points are placed in the
machine frame; the errors follow from the placed points. As the correlation of the points is carried along in full, the
result is that of the joint adjustment up to terms of second order; the joint one can use more readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.names import MM_PER_UM
from compgen.errors import ConvergenceError, UndeterminedError
from compgen.identify.located import Located, TracerReadings, distinct_poses, locatable_readings, locate_points
from compgen.identify.outliers import Rejected, accepted_readings
from compgen.identify.rank import describe_rank
from compgen.identify.separation import LEVER_MM, SeparationProblem, frame_rotation
from compgen.identify.solver import Solution, factorise, solve
from compgen.identify.state import IntArray, State
from compgen.model.exact import tip_position
from compgen.model.rotation import cross_matrices

MOST_ROUNDS = 20
#: With fewer readings kept than this share, model and readings do not belong together.
LEAST_KEPT = 0.7


@dataclass(frozen=True)
class TwoSteps:
    """Result: the optimum with the unknowns of the joint method, which readings count, the points, what to report."""

    solution: Solution
    accepted: NDArray[np.bool_]
    rejected: tuple[Rejected, ...]
    located: Located
    summary: dict[str, Any]


def solve_in_two_steps(readings: TracerReadings, *, reject: bool) -> TwoSteps:
    """Self-calibrate, place, separate; reject what lies beyond the robust limit, and repeat until the same are kept.

    Raises
    ------
    InputError
        if fewer than four stations see common points.
    UndeterminedError
        if tracers, or errors, are not determined.
    ConvergenceError
        if no optimum is reached, or too many readings do not fit.
    """
    count = len(readings.lengths)
    poses, pose = distinct_poses(readings)
    keep = np.ones(count, dtype=bool)
    for _ in range(MOST_ROUNDS):
        used = keep & locatable_readings(readings, pose, keep)
        located = locate_points(readings, poses, pose, np.flatnonzero(used))
        problem = _separation(readings, located)
        solution = _solve(problem, located, readings)
        state = _joint_state(problem, solution.state, located)
        residual = _length_residuals(readings, poses, pose, state)
        lonely = np.flatnonzero(keep & ~used)
        again = accepted_readings(residual / readings.sigma_mm) if reject else keep
        _check_enough(again)
        if np.array_equal(again, keep):
            break
        keep = again
    return TwoSteps(
        solution=_joint_solution(problem, solution, located, state, float(readings.sigma_mm.min())),
        accepted=used,
        rejected=_not_located(readings.lengths, lonely, residual),
        located=located,
        summary=_summary(readings, located, solution),
    )


def _check_enough(keep: NDArray[np.bool_]) -> None:
    rejected = int(np.count_nonzero(~keep))
    if rejected > (1.0 - LEAST_KEPT) * len(keep):
        raise ConvergenceError(
            f"{rejected} of {len(keep)} readings do not fit the model; check the machine file's chain, the station "
            "labels and the units before anything is rejected"
        )


def _separation(readings: TracerReadings, located: Located) -> SeparationProblem:
    turn, calibration = located.placement.rotation, located.calibration
    bases = tuple(readings.layout.basis(axis, located.position_mm[:, axis]) for axis in range(3))
    return SeparationProblem(
        parameters=readings.layout,
        bases=bases,  # type: ignore[arg-type]
        position_mm=located.position_mm,
        tool_mm=located.tool_mm,
        measured_mm=located.measured_mm,
        information=turn @ calibration.information @ turn.T,
        lever=turn @ calibration.lever,
        station_information=calibration.station_information,
    )


def _solve(problem: SeparationProblem, located: Located, readings: TracerReadings) -> Solution:
    """Step 3: eq. 21-28."""
    matrix = problem.normal_matrix(problem.start)
    try:
        factor = factorise(matrix)
    except LinAlgError:
        stations = [f"{name} {letter}" for name in readings.lengths.stations for letter in "xyz"]
        everything = [*stations, *(f"dead length {k + 1}" for k in range(len(readings.start.dead_length_mm)))]
        names = problem.unknown_names(tuple(everything[k] for k in located.calibration.free))
        rank = describe_rank(matrix, names)
        raise UndeterminedError(
            f"the {len(located.position_mm)} located points determine {rank.rank} of {rank.size} unknowns; "
            + "; ".join(rank.combinations[:8]),
            list(rank.combinations),
        ) from None
    return solve(problem, problem.start, factor)


def _joint_state(problem: SeparationProblem, state: State, located: Located) -> State:
    """Errors, stations and dead lengths in the machine frame."""
    calibration = located.calibration
    frame = calibration.frame
    everything = np.concatenate([frame.stations_mm.ravel(), frame.dead_length_mm])
    everything[calibration.free] += state.dead_length_mm
    split = frame.stations_mm.size
    stations = located.placement.apply(everything[:split].reshape(-1, 3)) - problem.centre_mm
    turned = stations @ frame_rotation(-state.stations_mm[1])[0]
    return State(state.errors, turned + problem.centre_mm + state.stations_mm[0], everything[split:])


def _joint_solution(
    problem: SeparationProblem, solution: Solution, located: Located, state: State, sigma_mm: float
) -> Solution:
    """The same optimum with the joint method's unknowns; readings of ``sigma_mm`` get weight 1."""
    size, errors = problem.size, problem.parameters.size
    change = np.eye(size)
    change[errors:, errors:] = _station_derivative(problem, solution.state, located, state)
    back = np.linalg.inv(change)
    matrix = back.T @ problem.normal_matrix(solution.state) @ back * sigma_mm**2
    factor = factorise(0.5 * (matrix + matrix.T))
    return Solution(state, solution.cost * sigma_mm**2, factor, solution.iterations, solution.factorisations)


def _station_derivative(problem: SeparationProblem, state: State, located: Located, joint: State) -> FloatArray:
    """Derivative of stations and dead lengths in the machine frame by placement and b, (6 + q, 6 + q)."""
    forward, jacobian = frame_rotation(state.stations_mm[1])
    stations = len(joint.stations_mm)
    derivative = np.zeros((3 * stations + len(joint.dead_length_mm), 6 + len(state.dead_length_mm)))
    arms = cross_matrices(joint.stations_mm - problem.centre_mm - state.stations_mm[0])
    derivative[: 3 * stations, :3] = np.tile(np.eye(3), (stations, 1))
    derivative[: 3 * stations, 3:6] = (-arms @ jacobian).reshape(-1, 3) / LEVER_MM
    turn = np.eye(len(derivative))
    turn[: 3 * stations, : 3 * stations] = np.kron(np.eye(stations), forward @ located.placement.rotation)
    derivative[:, 6:] = turn[:, located.calibration.free]
    return derivative


def _length_residuals(readings: TracerReadings, poses: FloatArray, pose: IntArray, state: State) -> FloatArray:
    """Model minus reading of every reading, also of those that were not used, (n,), mm."""
    layout = readings.layout
    values = layout.values(state.errors, [layout.basis(axis, poses[:, axis]) for axis in range(3)])
    tip = tip_position(layout.machine, values, poses[:, :3], poses[:, 3:])
    distance = np.linalg.norm(tip[pose] - state.stations_mm[readings.lengths.station], axis=1)
    return np.asarray(distance - state.dead_length_mm[readings.group] - readings.lengths.length_mm)


def _not_located(lengths: Lengths, rows: IntArray, residual_mm: FloatArray) -> tuple[Rejected, ...]:
    """TracerReadings of points that fewer than three stations see."""
    reason = "fewer than three stations see its point, so that it cannot be located; the joint method uses the reading"
    found = []
    for row in rows.tolist():
        file, line = lengths.origin[row] if lengths.origin else ("", 0)
        station = lengths.stations[lengths.station[row]]
        residual_um = float(-residual_mm[row]) / MM_PER_UM
        found.append(Rejected(row, station, str(lengths.point[row]), residual_um, reason, file, line))
    return tuple(found)


def _summary(readings: TracerReadings, located: Located, solution: Solution) -> dict[str, Any]:
    """Return what each step leaves, for ``identify.json``."""
    calibration = located.calibration
    points = len(located.position_mm)
    freedom = 3 * points - readings.layout.size - 6
    u = located.deviations.u_mm
    assert u is not None
    return {
        "self_calibration": {
            "points": points,
            "readings": len(located.rows),
            "degrees_of_freedom": calibration.degrees_of_freedom,
            "reduced_chi_square": calibration.chi_square / max(calibration.degrees_of_freedom, 1),
            "residual_rms_um": float(np.sqrt(np.mean(calibration.residual_mm**2))) / MM_PER_UM,
            "stations_mm": calibration.frame.stations_mm.round(7).tolist(),
            "iterations": calibration.iterations,
        },
        "transformation": {
            "rotation": located.placement.rotation.tolist(),
            "translation_mm": located.placement.translation_mm.tolist(),
            "held_at_reference_point": located.anchored,
            "mirrored": located.placement.mirrored,
            "deviation_rms_um": located.placement.rms_mm / MM_PER_UM,
            "u_deviation_max_um": float(u.max()) / MM_PER_UM,
        },
        "separation": {
            "degrees_of_freedom": freedom,
            "reduced_chi_square": 2.0 * solution.cost / max(freedom, 1),
        },
    }
