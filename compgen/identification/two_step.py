"""Tracer lengths in two steps (Zha & Zhang 2024, sections 4 and 5): self-calibration, transformation, separation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.comparison import best_rotation, rigid_fields, small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.lengths import Lengths
from compgen.data.names import MM_PER_UM
from compgen.errors import ConvergenceError, InputError, Message, UndeterminedError
from compgen.identification.adjust.problem import (
    LEVER_MM,
    LinesOfSight,
    PointEquations,
    SeparationProblem,
    frame_rotation,
)
from compgen.identification.adjust.robust import MOST_ROUNDS, Rejected, accepted_readings, check_rejected
from compgen.identification.adjust.solver import LeastSquaresSolution, determined_factor, factorise, solve
from compgen.identification.adjust.unknowns import DistinctPoses, ErrorParameters, IntArray, State, distinct_poses
from compgen.kinematics.first_order import tool_of

# Tracers and points as a network of distances: its normal equations with the points eliminated one by one.


@dataclass(frozen=True)
class Sightings:
    """n readings of S stations (with G dead lengths) to m points; every point has a reading.

    ``point``, ``station``, ``group`` (dead length) are indices (n,), ``length_mm`` and ``sigma_mm`` (n,) the reading
    and its standard uncertainty.
    """

    point: IntArray
    station: IntArray
    group: IntArray
    length_mm: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class Frame:
    """Stations (S, 3), dead lengths (G,) and points (m, 3) in one frame, mm."""

    stations_mm: FloatArray
    dead_length_mm: FloatArray
    points_mm: FloatArray

    def moved(self, rotation: FloatArray, translation_mm: FloatArray) -> Frame:
        """Return the frame after x -> R x + t."""
        return Frame(
            self.stations_mm @ rotation.T + translation_mm,
            self.dead_length_mm,
            self.points_mm @ rotation.T + translation_mm,
        )


@dataclass(frozen=True)
class Network:
    """Sightings, and the free unknowns of the stations (q,)."""

    sightings: Sightings
    free: IntArray


@dataclass(frozen=True)
class Linear:
    """Readings linearised at a frame.

    Parameters
    ----------
    residual_mm, cost : model minus reading (n,), and half the weighted sum of squares.
    equations : of the points and the free unknowns of the stations (q,).
    reduced : of the stations with the points eliminated, (q, q).
    """

    residual_mm: FloatArray
    cost: float
    equations: PointEquations
    reduced: FloatArray


def residuals(data: Network, frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Model minus reading (n,) and unit lines of sight (n, 3)."""
    seen = data.sightings
    sight = frame.points_mm[seen.point] - frame.stations_mm[seen.station]
    distance = np.sqrt(np.einsum("ij,ij->i", sight, sight))
    return distance - frame.dead_length_mm[seen.group] - seen.length_mm, sight / distance[:, None]


def cost(data: Network, frame: Frame) -> float:
    """Half the weighted sum of squares."""
    residual, _ = residuals(data, frame)
    return 0.5 * float(np.sum((residual / data.sightings.sigma_mm) ** 2))


def linearise(data: Network, frame: Frame) -> Linear:
    """Normal equations at a frame; ``reduced`` is the Schur complement of the points."""
    seen = data.sightings
    residual, unit = residuals(data, frame)
    weight = 1.0 / seen.sigma_mm**2
    counts = len(frame.points_mm), len(frame.stations_mm), len(frame.dead_length_mm)
    equations = (
        LinesOfSight(seen.point, seen.station, seen.group, counts).equations(unit, weight, residual).of(data.free)
    )
    flat = equations.coupling.reshape(-1, len(data.free))
    reduced = equations.own - flat.T @ solved(equations.information, equations.coupling).reshape(flat.shape)
    return Linear(residual, 0.5 * float(np.dot(weight, residual**2)), equations, 0.5 * (reduced + reduced.T))


def solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for every point: information (m, 3, 3), right side (m, 3, k); UndeterminedError for a singular point."""
    try:
        return np.asarray(np.linalg.solve(information, right))
    except np.linalg.LinAlgError:
        raise UndeterminedError(
            Message(
                "point-in-line",
                "a point is in line with its stations, or all its stations are on one line; it cannot be located",
            ),
            [],
        ) from None


# Self-calibration of tracers in their own frame (Zha & Zhang 2024, eq. 12-19): no machine model, no commanded position.
#
# The unknowns are the stations, the dead lengths and every target point:
#
#     | x_j - s_i | - d_i = l_ij
#
# The frame is that of eq. 17: the first station in the origin, the second on the x axis, the third in the xy plane.
# Least squares by Levenberg-Marquardt. A point appears only in its own readings, so its three unknowns are eliminated
# point by point; the remaining normal matrix is that of the stations and dead lengths.


#: A point is located by at least this many stations; with one more it helps to locate them.
LOCATING_STATIONS = 3
TOLERANCE_MM = 1e-8
MAX_ITERATIONS = 100
#: Eigenvalues of the scaled normal matrix of the stations below this count as zero: the stations are undetermined.
ZERO_EIGENVALUE = 1e-12
#: Sine of the angle at the first station from which the third one may define the xy plane.
OFF_THE_LINE = 0.02


@dataclass(frozen=True)
class SelfCalibration:
    """Optimum of a self-calibration; q = 3 S + G - 6 unknowns of the stations remain in the frame of eq. 17.

    Parameters
    ----------
    frame : stations, dead lengths and points.
    free : which of the 3 S + G coordinates and dead lengths are unknown, indices (q,).
    information : of each point with the stations fixed, (m, 3, 3), 1/mm^2.
    lever : derivative of each point by the unknowns of the stations, (m, 3, q).
    station_information : of the stations and dead lengths, the points eliminated, (q, q), 1/mm^2.
    residual_mm : model minus reading, (n,).
    chi_square, degrees_of_freedom, iterations : of the adjustment, which is independent of the machine.
    """

    frame: Frame
    free: IntArray
    information: FloatArray
    lever: FloatArray
    station_information: FloatArray
    residual_mm: FloatArray
    chi_square: float
    degrees_of_freedom: int
    iterations: int

    def mirrored(self) -> SelfCalibration:
        """Return the mirror image in the xy plane, which explains the readings equally well."""
        flip = np.array([1.0, 1.0, -1.0])
        stations = len(self.frame.stations_mm)
        signs = np.concatenate([np.tile(flip, stations), np.ones(len(self.frame.dead_length_mm))])[self.free]
        frame = Frame(self.frame.stations_mm * flip, self.frame.dead_length_mm, self.frame.points_mm * flip)
        return replace(
            self,
            frame=frame,
            information=self.information * np.outer(flip, flip),
            lever=self.lever * flip[:, None] * signs,
            station_information=self.station_information * np.outer(signs, signs),
        )

    def own_covariance(self) -> FloatArray:
        """Covariance of each point with the stations fixed, (m, 3, 3), mm^2."""
        return np.asarray(np.linalg.inv(self.information))

    def station_covariance(self) -> FloatArray:
        """Covariance of the unknowns of the stations, (q, q), mm^2."""
        return np.asarray(np.linalg.inv(self.station_information))

    def covariance(self) -> FloatArray:
        """Covariance of each point in the frame of the stations, (m, 3, 3), mm^2; the stations' part is common to all points."""
        return self.own_covariance() + self.lever @ self.station_covariance() @ self.lever.transpose(0, 2, 1)


def self_calibrate(sightings: Sightings, start: Frame) -> SelfCalibration:
    """Locate stations and points from readings alone.

    Parameters
    ----------
    sightings : every point is seen by three stations or more; points with four or more locate the stations.
    start : rough values in any frame, for the start and the choice between the two mirror images.

    Raises
    ------
    UndeterminedError
        if the readings leave more undetermined than the frame: too few points, stations or points in a plane or on a
        line.
    ConvergenceError
        if no optimum is reached.
    """
    unknowns = np.arange(start.stations_mm.size + len(start.dead_length_mm))
    # the six zeros of eq. 17 among the coordinates of all stations
    first, second, third = frame_stations(start.stations_mm)
    zeros = [3 * first, 3 * first + 1, 3 * first + 2, 3 * second + 1, 3 * second + 2, 3 * third + 2]
    data = Network(sightings, np.setdiff1d(unknowns, zeros).astype(np.int64))
    # transformed into that frame
    origin, along, across = start.stations_mm[[first, second, third]]
    x = (along - origin) / np.linalg.norm(along - origin)
    y = (across - origin) - x * float(x @ (across - origin))
    if (length := float(np.linalg.norm(y))) < 1e-6:
        raise UndeterminedError(
            Message("stations-on-line", "all stations are on one line; the tracers cannot locate themselves"), []
        )
    y /= length
    rotation = np.stack([x, y, np.cross(x, y)])
    frame = start.moved(rotation, -rotation @ origin)
    frame.stations_mm.flat[zeros] = 0.0
    frame, step, iterations = _minimise(data, frame)
    equations = step.equations
    return SelfCalibration(
        frame=frame,
        free=data.free,
        information=equations.information,
        lever=-solved(equations.information, equations.coupling),
        station_information=step.reduced,
        residual_mm=step.residual_mm,
        chi_square=2.0 * step.cost,
        degrees_of_freedom=len(sightings.point) - 3 * len(start.points_mm) - len(data.free),
        iterations=iterations,
    )


def frame_stations(stations_mm: FloatArray) -> tuple[int, int, int]:
    """Return the stations that define origin, x axis and xy plane: the first three, or a later one off their line."""
    along = stations_mm[1] - stations_mm[0]
    others = stations_mm[2:] - stations_mm[0]
    sine = np.linalg.norm(np.cross(along, others), axis=1) / (
        np.linalg.norm(along) * np.maximum(np.linalg.norm(others, axis=1), 1e-9)
    )
    third = int(np.argmax(sine > OFF_THE_LINE)) if np.any(sine > OFF_THE_LINE) else int(np.argmax(sine))
    return 0, 1, 2 + third


def _minimise(data: Network, start: Frame) -> tuple[Frame, Linear, int]:
    """Levenberg-Marquardt (eq. 19) with the points eliminated; the damping starts at zero."""
    frame, linear, damping = start, linearise(data, start), 0.0
    _check_rank(linear, data)
    for iteration in range(1, MAX_ITERATIONS + 1):
        points, stations = _step(linear, damping)
        size = max(float(np.abs(points).max()), float(np.abs(stations).max()))
        candidate = _moved(frame, points, stations, data.free)
        if not cost(data, candidate) <= linear.cost * (1 + 1e-9) + 1e-12:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        frame, linear = candidate, linearise(data, candidate)
        if size < TOLERANCE_MM and not damping:
            _check_rank(linear, data)
            return frame, linear, iteration
        damping = damping / 10.0 if damping > 1e-8 else 0.0
    raise ConvergenceError(
        Message(
            "self-calibration-no-optimum",
            "the self-calibration of the tracers found no optimum; check station labels and "
            "units, or use the joint method",
        )
    )


def _step(linear: Linear, damping: float) -> tuple[FloatArray, FloatArray]:
    """Steps of the points (m, 3) and of the free unknowns of the stations (q,)."""
    equations, reduced = linear.equations, linear.reduced
    information, coupling = equations.information, equations.coupling
    flat = coupling.reshape(-1, coupling.shape[2])
    if damping:
        information = information * (1.0 + damping * np.eye(3))
        damped = equations.own + damping * np.diag(np.diag(equations.own))
        reduced = damped - flat.T @ solved(information, coupling).reshape(flat.shape)
    own = solved(information, equations.force[:, :, None])[:, :, 0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    right = (equations.own_force - flat.T @ own.ravel()) * scale
    stations = -scale * np.linalg.solve(reduced * np.outer(scale, scale), right)
    moved = solved(information, (coupling @ stations)[:, :, None])[:, :, 0]
    return -own - moved, stations


def _moved(frame: Frame, points: FloatArray, stations: FloatArray, free: IntArray) -> Frame:
    everything = np.concatenate([frame.stations_mm.ravel(), frame.dead_length_mm])
    everything[free] += stations
    split = frame.stations_mm.size
    return Frame(everything[:split].reshape(-1, 3), everything[split:], frame.points_mm + points)


def _check_rank(linear: Linear, data: Network) -> None:
    """Raise UndeterminedError if the points leave more of the stations undetermined than the frame of eq. 17."""
    coordinates = linear.equations.force.size
    if len(linear.residual_mm) < coordinates + len(data.free):
        raise UndeterminedError(
            Message(
                "self-calibration-few-readings",
                "the self-calibration has {residual_mm} readings for {coordinates} coordinates of "
                "points and {free} unknowns of the stations; measure more points with four stations, "
                "or use the joint method, which has no unknown points",
                residual_mm=len(linear.residual_mm),
                coordinates=coordinates,
                free=len(data.free),
            ),
            [],
        )
    scale = 1.0 / np.sqrt(np.diag(linear.equations.own))
    eigenvalues = np.linalg.eigvalsh(linear.reduced * np.outer(scale, scale))
    open_directions = int(np.count_nonzero(eigenvalues < ZERO_EIGENVALUE))
    if open_directions:
        raise UndeterminedError(
            Message(
                "self-calibration-undetermined",
                "the tracers cannot locate themselves: {open_directions} direction(s) of the "
                "stations remain undetermined (all stations, or all points, in a plane?); use the "
                "joint method, which uses the model of the machine",
                open_directions=open_directions,
            ),
            [],
        )


# From the tracers' frame into the machine's (Zha & Zhang 2024, eq. 20), in closed form.


#: A mirror image is accepted if it fits this much better than the proper placement.
MIRROR_RATIO = 0.5


@dataclass(frozen=True)
class Placement:
    """Rigid motion x -> R x + t from one frame into another, with its residual.

    Parameters
    ----------
    rotation, translation_mm : R (3, 3), a rotation, never a reflection, and t (3,).
    rms_mm : weighted root mean square distance that remains.
    mirrored : the points fit only as their mirror image: their frame is left-handed.
    """

    rotation: FloatArray
    translation_mm: FloatArray
    rms_mm: float
    mirrored: bool

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """Return points (n, 3) in the other frame."""
        return points_mm @ self.rotation.T + self.translation_mm


def place(
    points_mm: FloatArray, target_mm: FloatArray, weight: FloatArray | None = None, anchor: int | None = None
) -> Placement:
    """Return the rigid motion that brings points (n, 3) closest to targets (n, 3): eq. 20 in closed form.

    Parameters
    ----------
    points_mm, target_mm : corresponding points in the two frames.
    weight : of each point, (n,); default 1.
    anchor : index of a point that is placed exactly on its target (the paper's machine origin); default None: the
        weighted centroids coincide, which is the minimum.

    Raises
    ------
    UndeterminedError
        if the points are on one line.
    """
    w = np.ones(len(points_mm)) if weight is None else weight / weight.mean()
    share = w / w.sum() if anchor is None else (np.arange(len(w)) == anchor).astype(np.float64)
    here, there = share @ points_mm, share @ target_mm
    moment = (target_mm - there).T @ (w[:, None] * (points_mm - here))
    size = np.linalg.svd(moment, compute_uv=False)
    if size[1] <= 1e-12 * size[0]:
        raise UndeterminedError(
            Message("points-on-line", "the points are on one line; the rotation of the frame about it is undetermined"),
            [],
        )
    # the best rotation, and the best mirror image: a rotation of the points mirrored in their centre
    rotation, image = best_rotation(moment), -best_rotation(-moment)
    rms_mm, rms_of_image = (
        float(np.sqrt(np.average(np.sum(((points_mm - here) @ turn.T - target_mm + there) ** 2, axis=1), weights=w)))
        for turn in (rotation, image)
    )
    handed = size[2] > 1e-12 * size[0]  # points in a plane are their own mirror image
    return Placement(rotation, there - rotation @ here, rms_mm, handed and rms_of_image < MIRROR_RATIO * rms_mm)


def placed_covariance(
    own: FloatArray, lever: FloatArray, shared: FloatArray, points_mm: FloatArray, weight: FloatArray
) -> FloatArray:
    """Return the covariance of each point relative to the best-fit placement of all points, (n, 3, 3), mm^2.

    Parameters
    ----------
    own : independent covariance of each point, (n, 3, 3).
    lever, shared : (n, 3, q) and (q, q); the part lever shared lever^T is common to all points.
    points_mm, weight : as for :func:`place`, the points in the final frame.
    """
    motion = small_motion(points_mm, weight)
    rigid = motion.fields.reshape(-1, 3, 6)  # movement of each point by the six amounts
    taken = motion.reading.reshape(6, -1, 3).transpose(1, 0, 2)  # the six amounts by each point, (n, 6, 3)
    own_part = taken @ own  # (n, 6, 3)
    total = np.einsum("nij,nkj->ik", own_part, taken)
    cross = rigid @ own_part
    rest = lever - rigid @ np.einsum("nij,njq->iq", taken, lever)
    placed = own - cross - cross.transpose(0, 2, 1) + rigid @ total @ rigid.transpose(0, 2, 1)
    return np.asarray(placed + rest @ shared @ rest.transpose(0, 2, 1))


# Points located by tracers: self-calibration and transformation (Zha & Zhang 2024, eq. 12-20).


MIN_STATIONS = 4


@dataclass(frozen=True)
class TracerReadings:
    """n tracer readings as prepared by the joint method.

    Parameters
    ----------
    lengths, layout : the readings, and the unknown errors of the machine.
    group : index of the dead length of each reading, (n,).
    sigma_mm : standard uncertainty of each reading, (n,).
    start : rough stations and dead lengths.
    """

    lengths: Lengths
    layout: ErrorParameters
    group: IntArray
    sigma_mm: FloatArray
    start: State


@dataclass(frozen=True)
class Located:
    """Points located by the tracers.

    Parameters
    ----------
    rows, point : the used readings, and the point of each, (k,).
    position_mm, tool_mm : poses of the points, (m, 3).
    calibration : of the tracers in their own frame, right-handed like that of the machine.
    placement : from that frame into the machine's; ``anchored`` if it was fixed at the reference point.
    deviations : measured minus nominal tip in the machine frame; the uncertainty is relative to the best-fit placement
        of all points.
    covariance_mm2 : the same as a covariance of each point, (m, 3, 3).
    """

    rows: IntArray
    point: IntArray
    position_mm: FloatArray
    tool_mm: FloatArray
    calibration: SelfCalibration
    placement: Placement
    anchored: bool
    deviations: Deviations
    covariance_mm2: FloatArray

    @property
    def measured_mm(self) -> FloatArray:
        """Measured tips in the machine frame, (m, 3)."""
        return self.placement.apply(self.calibration.frame.points_mm)


def locatable_readings(readings: TracerReadings, pose: IntArray, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """TracerReadings whose pose is seen by three stations or more; InputError if they cannot locate the tracers."""
    lengths = readings.lengths
    names = lengths.stations
    seen = np.zeros((int(pose.max()) + 1, len(names)), dtype=bool)
    seen[pose[keep], lengths.station[keep]] = True
    by_pose = seen.sum(axis=1)
    advice = (
        "; self-calibration leaves three unknown coordinates for each point, so at least four stations must see common "
        "points. Use the joint method (--method joint), which needs three stations and no common points"
    )
    file = lengths.origin[0][0] if lengths.origin else None
    if by_pose.max() < MIN_STATIONS:
        raise InputError(
            Message(
                "points-seen-by-few",
                "no point is seen by more than {by_pose} of {names} stations{advice}",
                by_pose=by_pose.max(),
                names=len(names),
                advice=advice,
            ),
            file=file,
        )
    located = by_pose >= LOCATING_STATIONS
    lonely = [name for name, sees in zip(names, seen[located].any(axis=0), strict=True) if not sees]
    if lonely:
        raise InputError(
            Message(
                "station-shares-no-point",
                "station {lonely!r} shares no point with three others{advice}",
                lonely=lonely[0],
                advice=advice,
            ),
            file=file,
        )
    rows = located[pose]
    groups = np.setdiff1d(readings.group, readings.group[keep & rows])
    if len(groups):
        row = int(np.flatnonzero(readings.group == groups[0])[0])
        name = names[lengths.station[row]]
        raise InputError(
            Message(
                "setup-shares-no-point",
                "a set-up of station {name!r} shares no point with three others{advice}",
                name=name,
                advice=advice,
            ),
            file=file,
        )
    return np.asarray(rows)


def locate_points(readings: TracerReadings, poses: DistinctPoses, rows: IntArray) -> Located:
    """Self-calibrate and place (eq. 12-20) with the readings ``rows`` (k,); ``poses`` are those of all readings."""
    lengths = readings.lengths
    present, point = np.unique(poses.of[rows], return_inverse=True)
    point = point.ravel().astype(np.int64)
    position_mm, tool_mm = poses.position_mm[present], poses.tool_mm[present]
    nominal = position_mm + tool_mm
    sightings = Sightings(
        point, lengths.station[rows], readings.group[rows], lengths.length_mm[rows], readings.sigma_mm[rows]
    )
    start = Frame(readings.start.stations_mm, readings.start.dead_length_mm, nominal)
    calibration = self_calibrate(sightings, start)
    own = calibration.own_covariance()
    weight = 1.0 / np.trace(own, axis1=1, axis2=2)
    # the pose at the machine's reference point, if measured once, is placed exactly on it
    away = np.abs(position_mm - np.array(readings.layout.machine.reference_point_mm)).max(axis=1)
    at = np.flatnonzero(away < 1e-6)
    anchor = int(at[0]) if len(at) == 1 else None
    placement = place(calibration.frame.points_mm, nominal, weight, anchor)
    if placement.mirrored:
        calibration = calibration.mirrored()
        own = calibration.own_covariance()
        placement = place(calibration.frame.points_mm, nominal, weight, anchor)
    turn = placement.rotation
    measured = placement.apply(calibration.frame.points_mm)
    shared = calibration.station_covariance()
    covariance = placed_covariance(turn @ own @ turn.T, turn @ calibration.lever, shared, measured, weight)
    kept = {key: lengths.metadata[key] for key in ("date",) if key in lengths.metadata}
    deviations = Deviations(
        position_mm=position_mm,
        deviation_mm=measured - position_mm - tool_mm,
        u_mm=np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)),
        tool_mm=None if lengths.tool_mm is None else tool_mm,
        metadata={"machine": readings.layout.machine.name, **kept, "source": "compgen identify"},
    )
    return Located(
        rows, point, position_mm, tool_mm, calibration, placement, anchor is not None, deviations, covariance
    )


# Identification in the steps of Zha & Zhang 2024, sections 4 and 5: self-calibration, transformation, separation.
#
# The tracers locate themselves and every target point independently of the machine; the points are placed in the
# machine frame; the errors follow from the placed points. As the full correlation of the points is propagated, the
# result is that of the joint adjustment up to terms of second order; the joint one can use more readings.


TOO_MANY = "readings do not fit the model; check the machine file's chain, the station labels and the units"


@dataclass(frozen=True)
class TwoSteps:
    """Result: the optimum with the unknowns of the joint method, the used readings, the points, figures for the report."""

    solution: LeastSquaresSolution
    accepted: NDArray[np.bool_]
    rejected: tuple[Rejected, ...]
    located: Located
    summary: dict[str, Any]


def solve_in_two_steps(readings: TracerReadings, *, reject: bool) -> TwoSteps:
    """Self-calibrate, place, separate; reject what is beyond the robust limit, and repeat until the set is stable.

    Raises
    ------
    InputError
        if fewer than four stations see common points.
    UndeterminedError
        if tracers, or errors, are undetermined.
    ConvergenceError
        if no optimum is reached, or too many readings do not fit.
    """
    count = len(readings.lengths)
    poses = distinct_poses(readings.lengths.position_mm, tool_of(readings.layout.machine, readings.lengths.tool_mm))
    keep = np.ones(count, dtype=bool)
    for _ in range(MOST_ROUNDS):
        used = keep & locatable_readings(readings, poses.of, keep)
        located = locate_points(readings, poses, np.flatnonzero(used))
        problem, solution = _solve(located, readings)
        joint = _joint(problem, solution, located, float(readings.sigma_mm.min()))
        state = joint.state
        # also of the unused readings
        sight = readings.layout.tips(state.errors, poses.position_mm, poses.tool_mm)[poses.of]
        sight = sight - state.stations_mm[readings.lengths.station]
        distance = np.linalg.norm(sight, axis=1)
        residual = distance - state.dead_length_mm[readings.group] - readings.lengths.length_mm
        lonely = np.flatnonzero(keep & ~used)
        again = accepted_readings(residual / readings.sigma_mm) if reject else keep
        check_rejected(again, TOO_MANY)
        if np.array_equal(again, keep):
            break
        keep = again
    lengths = readings.lengths
    rejected = [
        Rejected(
            row,
            lengths.stations[lengths.station[row]],
            str(lengths.point[row]),
            float(-residual[row]) / MM_PER_UM,
            "fewer than three stations see its point, so it cannot be located; the joint method uses the reading",
            *(lengths.origin[row] if lengths.origin else ("", 0)),
        )
        for row in lonely.tolist()
    ]
    return TwoSteps(
        solution=joint,
        accepted=used,
        rejected=tuple(rejected),
        located=located,
        summary=_summary(readings, located, solution),
    )


def _solve(located: Located, readings: TracerReadings) -> tuple[SeparationProblem, LeastSquaresSolution]:
    """Step 3: eq. 21-28."""
    turn, calibration = located.placement.rotation, located.calibration
    problem = SeparationProblem(
        parameters=readings.layout,
        position_mm=located.position_mm,
        tool_mm=located.tool_mm,
        bases=readings.layout.bases(located.position_mm),
        measured_mm=located.measured_mm,
        information=turn @ calibration.information @ turn.T,
        lever=turn @ calibration.lever,
        station_information=calibration.station_information,
    )

    def names() -> list[str]:
        stations = [f"{name} {letter}" for name in readings.lengths.stations for letter in "xyz"]
        everything = [*stations, *(f"dead length {k + 1}" for k in range(len(readings.start.dead_length_mm)))]
        return problem.unknown_names(tuple(everything[k] for k in located.calibration.free))

    what = f"the {len(located.position_mm)} located points"
    factor, _ = determined_factor(problem.normal_matrix(problem.start), names, what, suspicious=0.0)
    return problem, solve(problem, problem.start, factor)


def _joint(
    problem: SeparationProblem, solution: LeastSquaresSolution, located: Located, sigma_mm: float
) -> LeastSquaresSolution:
    """The same optimum with the joint method's unknowns; readings of ``sigma_mm`` get weight 1.

    Stations s and dead lengths d in the machine frame follow from those of the tracers' frame, b their errors, by the
    placement (t, w) of that frame about the centre c: s = R(w) (R_0 (s_0 + b) + t_0 - c) + c + t. The normal matrix is
    that of the separation, transformed with the derivative of (s, d) by (t, w, b).
    """
    state, calibration, placement = solution.state, located.calibration, located.placement
    frame = calibration.frame
    everything = np.concatenate([frame.stations_mm.ravel(), frame.dead_length_mm])
    everything[calibration.free] += state.dead_length_mm
    split, count = frame.stations_mm.size, len(frame.stations_mm)
    shift = state.stations_mm[0]
    turn_back, _ = frame_rotation(-state.stations_mm[1])
    turned = (placement.apply(everything[:split].reshape(-1, 3)) - problem.centre_mm) @ turn_back
    joint = State(state.errors, turned + problem.centre_mm + shift, everything[split:])

    forward, jacobian = frame_rotation(state.stations_mm[1])
    turn = np.eye(len(everything))
    turn[:split, :split] = np.kron(np.eye(count), forward @ placement.rotation)
    moved = rigid_fields(joint.stations_mm - problem.centre_mm - shift)
    size, errors = problem.size, problem.parameters.size
    change = np.eye(size)
    change[errors:, errors:] = 0.0
    change[errors : errors + split, errors : errors + 3] = moved[:, :3]
    change[errors : errors + split, errors + 3 : errors + 6] = moved[:, 3:] @ jacobian / LEVER_MM
    change[errors:, errors + 6 :] = turn[:, calibration.free]
    back = np.linalg.inv(change)
    matrix = back.T @ problem.normal_matrix(state) @ back * sigma_mm**2
    factor = factorise(0.5 * (matrix + matrix.T))
    return LeastSquaresSolution(
        joint, solution.cost * sigma_mm**2, factor, solution.iterations, solution.factorisations
    )


def _summary(readings: TracerReadings, located: Located, solution: LeastSquaresSolution) -> dict[str, Any]:
    """Return the figures of each step, for ``identify.json``."""
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
