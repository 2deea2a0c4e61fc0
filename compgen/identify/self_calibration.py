"""Self-calibration of tracers in their own frame (Zha & Zhang 2024, eq. 12-19): no machine model, no commanded position.

Unknown are the stations, the dead lengths and every target point:

    | x_j - s_i | - d_i = l_ij

The frame is that of eq. 17: the first station in the origin, the second on the x axis, the third in the xy plane. Least
squares by Levenberg-Marquardt. A point appears in its own readings only, so its three unknowns are eliminated point by
point; what remains is a normal matrix of the stations and dead lengths alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError, UndeterminedError
from compgen.identify.network import Frame, Linear, Network, Sightings, cost, linearise, solved
from compgen.identify.state import IntArray

#: A point is located by at least this many stations; only from one more on does it help to locate them.
LOCATING_STATIONS = 3
TOLERANCE_MM = 1e-8
MAX_ITERATIONS = 100
#: Eigenvalues of the scaled normal matrix of the stations below this are zero: the stations are not determined.
ZERO_EIGENVALUE = 1e-12
#: Sine of the angle at the first station from which the third one may define the xy plane.
OFF_THE_LINE = 0.02


@dataclass(frozen=True)
class SelfCalibration:
    """Optimum of a self-calibration; q = 3 S + G - 6 unknowns of the stations are left in the frame of eq. 17.

    Parameters
    ----------
    frame : stations, dead lengths and points.
    free : which of the 3 S + G coordinates and dead lengths are unknown, indices (q,).
    information : of each point with the stations held, (m, 3, 3), 1/mm^2.
    lever : movement of each point when an unknown of the stations moves, (m, 3, q).
    station_information : of the stations and dead lengths, the points eliminated, (q, q), 1/mm^2.
    residual_mm : model minus reading, (n,).
    chi_square, degrees_of_freedom, iterations : of the adjustment; the machine has no part in it.
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
        """Return the mirror image in the xy plane, which explains the readings as well."""
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
        """Covariance of each point with the stations held, (m, 3, 3), mm^2."""
        return np.asarray(np.linalg.inv(self.information))

    def station_covariance(self) -> FloatArray:
        """Covariance of the unknowns of the stations, (q, q), mm^2."""
        return np.asarray(np.linalg.inv(self.station_information))

    def covariance(self) -> FloatArray:
        """Covariance of each point in the frame of the stations, (m, 3, 3), mm^2; points share the stations' part."""
        return self.own_covariance() + self.lever @ self.station_covariance() @ self.lever.transpose(0, 2, 1)


def self_calibrate(sightings: Sightings, start: Frame) -> SelfCalibration:
    """Locate stations and points from readings alone.

    Parameters
    ----------
    sightings : every point is seen by three stations or more; points with four or more locate the stations.
    start : rough values in any frame; only the start uses them, and they choose between the two mirror images.

    Raises
    ------
    UndeterminedError
        if the readings leave more open than the frame: too few points, stations or points in a plane or on a line.
    ConvergenceError
        if no optimum is reached.
    """
    order = np.argsort(sightings.point, kind="stable")
    data = Network(
        Sightings(*(part[order] for part in vars(sightings).values())),
        np.searchsorted(sightings.point[order], np.arange(len(start.points_mm))),
        _free_unknowns(start),
    )
    frame, step, iterations = _minimise(data, _to_own_frame(start))
    residual = np.empty(len(order))
    residual[order] = step.residual_mm
    return SelfCalibration(
        frame=frame,
        free=data.free,
        information=step.information,
        lever=-solved(step.information, step.coupling),
        station_information=step.reduced,
        residual_mm=residual,
        chi_square=2.0 * step.cost,
        degrees_of_freedom=len(order) - 3 * len(start.points_mm) - len(data.free),
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


def _to_own_frame(start: Frame) -> Frame:
    """Turn and shift into the frame of eq. 17."""
    origin, second, third = (start.stations_mm[k] for k in frame_stations(start.stations_mm))
    x = (second - origin) / np.linalg.norm(second - origin)
    y = (third - origin) - x * float(x @ (third - origin))
    length = float(np.linalg.norm(y))
    if length < 1e-6:
        raise UndeterminedError("all stations stand on one line; the tracers cannot locate themselves", [])
    y /= length
    rotation = np.stack([x, y, np.cross(x, y)])
    frame = start.moved(rotation, -rotation @ origin)
    coordinates = frame.stations_mm.ravel()
    coordinates[_held_coordinates(start.stations_mm)] = 0.0
    return replace(frame, stations_mm=coordinates.reshape(-1, 3))


def _held_coordinates(stations_mm: FloatArray) -> list[int]:
    """Places of the six zeros of eq. 17 among the coordinates of all stations."""
    first, second, third = frame_stations(stations_mm)
    return [3 * first, 3 * first + 1, 3 * first + 2, 3 * second + 1, 3 * second + 2, 3 * third + 2]


def _free_unknowns(start: Frame) -> IntArray:
    held = _held_coordinates(start.stations_mm)
    return np.setdiff1d(np.arange(start.stations_mm.size + len(start.dead_length_mm)), held).astype(np.int64)


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
        "the self-calibration of the tracers found no optimum; check station labels and units, or use the joint method"
    )


def _step(linear: Linear, damping: float) -> tuple[FloatArray, FloatArray]:
    """Steps of the points (m, 3) and of the free unknowns of the stations (q,)."""
    information, reduced = linear.information, linear.reduced
    flat = linear.coupling.reshape(-1, linear.coupling.shape[2])
    if damping:
        information = information * (1.0 + damping * np.eye(3))
        damped = linear.station_matrix + damping * np.diag(np.diag(linear.station_matrix))
        reduced = damped - flat.T @ solved(information, linear.coupling).reshape(flat.shape)
    own = solved(information, linear.point_gradient[:, :, None])[:, :, 0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    right = (linear.station_gradient - flat.T @ own.ravel()) * scale
    stations = -scale * np.linalg.solve(reduced * np.outer(scale, scale), right)
    moved = solved(information, (linear.coupling @ stations)[:, :, None])[:, :, 0]
    return -own - moved, stations


def _moved(frame: Frame, points: FloatArray, stations: FloatArray, free: IntArray) -> Frame:
    everything = np.concatenate([frame.stations_mm.ravel(), frame.dead_length_mm])
    everything[free] += stations
    split = frame.stations_mm.size
    return Frame(everything[:split].reshape(-1, 3), everything[split:], frame.points_mm + points)


def _check_rank(linear: Linear, data: Network) -> None:
    """UndeterminedError if the points leave more of the stations open than the frame of eq. 17."""
    freedom = len(linear.residual_mm) - linear.point_gradient.size - len(data.free)
    if freedom < 0:
        raise UndeterminedError(
            f"the self-calibration has {len(linear.residual_mm)} readings for {linear.point_gradient.size} coordinates "
            f"of points and {len(data.free)} unknowns of the stations; more points seen by four stations are needed, or "
            "the joint method, which needs no point of its own",
            [],
        )
    scale = 1.0 / np.sqrt(np.diag(linear.station_matrix))
    eigenvalues = np.linalg.eigvalsh(linear.reduced * np.outer(scale, scale))
    open_directions = int(np.count_nonzero(eigenvalues < ZERO_EIGENVALUE))
    if open_directions:
        raise UndeterminedError(
            f"the tracers cannot locate themselves: {open_directions} direction(s) of the stations stay open (all "
            "stations, or all points, in a plane?); use the joint method, which knows how the machine moves",
            [],
        )
