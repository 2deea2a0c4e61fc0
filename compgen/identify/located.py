"""Points that tracers have located: self-calibration and transformation (Zha & Zhang 2024, eq. 12-20)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.lengths import Lengths
from compgen.errors import InputError
from compgen.identify.network import Frame, Sightings
from compgen.identify.parameters import ErrorParameters
from compgen.identify.self_calibration import LOCATING_STATIONS, SelfCalibration, self_calibrate
from compgen.identify.state import IntArray, State
from compgen.identify.transformation import Placement, place, placed_covariance
from compgen.model.volumetric import tool_of

MIN_STATIONS = 4


@dataclass(frozen=True)
class TracerReadings:
    """Tracer readings as the joint method has prepared them; n readings.

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
    """Points that the tracers have located.

    Parameters
    ----------
    rows, point : the readings that were used, and the point of each, (k,).
    position_mm, tool_mm : poses of the points, (m, 3).
    calibration : of the tracers in their own frame, right-handed as the machine.
    placement : from that frame into the machine's; ``anchored`` if it was held at the reference point.
    deviations : measured tip minus nominal one in the machine frame; the uncertainty is that against the best-fit
        placement of all points.
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


def distinct_poses(readings: TracerReadings) -> tuple[FloatArray, IntArray]:
    """Distinct positions with their tools (m, 6), and the pose of each reading (n,)."""
    lengths = readings.lengths
    tool = np.broadcast_to(tool_of(readings.layout.machine, lengths.tool_mm), lengths.position_mm.shape)
    poses, pose = np.unique(np.column_stack([lengths.position_mm, tool]), axis=0, return_inverse=True)
    return poses, pose.ravel().astype(np.int64)


def locatable_readings(readings: TracerReadings, pose: IntArray, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """TracerReadings whose pose is seen by three stations or more; InputError if they cannot locate the tracers."""
    lengths = readings.lengths
    names = lengths.stations
    seen = np.zeros((int(pose.max()) + 1, len(names)), dtype=bool)
    seen[pose[keep], lengths.station[keep]] = True
    by_pose = seen.sum(axis=1)
    advice = (
        "; self-calibration leaves three unknown coordinates for each point, so at least four stations must see common "
        "points. Use the joint method (--method joint), which needs three stations and no common point"
    )
    file = lengths.origin[0][0] if lengths.origin else None
    if by_pose.max() < MIN_STATIONS:
        raise InputError(f"no point is seen by more than {by_pose.max()} of {len(names)} stations{advice}", file=file)
    located = by_pose >= LOCATING_STATIONS
    lonely = [name for name, sees in zip(names, seen[located].any(axis=0), strict=True) if not sees]
    if lonely:
        raise InputError(f"station {lonely[0]!r} shares no point with three others{advice}", file=file)
    rows = located[pose]
    groups = np.setdiff1d(readings.group, readings.group[keep & rows])
    if len(groups):
        row = int(np.flatnonzero(readings.group == groups[0])[0])
        name = names[lengths.station[row]]
        raise InputError(f"a set-up of station {name!r} shares no point with three others{advice}", file=file)
    return np.asarray(rows)


def locate_points(readings: TracerReadings, poses: FloatArray, pose: IntArray, rows: IntArray) -> Located:
    """Self-calibrate and place (eq. 12-20) with the readings ``rows`` (k,); ``poses`` (m, 6), ``pose`` of each reading (n,)."""
    lengths = readings.lengths
    present, point = np.unique(pose[rows], return_inverse=True)
    point = point.ravel().astype(np.int64)
    position_mm, tool_mm = poses[present, :3], poses[present, 3:]
    nominal = position_mm + tool_mm
    sightings = Sightings(
        point, lengths.station[rows], readings.group[rows], lengths.length_mm[rows], readings.sigma_mm[rows]
    )
    start = Frame(readings.start.stations_mm, readings.start.dead_length_mm, nominal)
    calibration = self_calibrate(sightings, start)
    own = calibration.own_covariance()
    weight = 1.0 / np.trace(own, axis1=1, axis2=2)
    anchor = _anchor(readings, position_mm)
    placement = place(calibration.frame.points_mm, nominal, weight, anchor)
    if placement.mirrored:
        calibration = calibration.mirrored()
        own = calibration.own_covariance()
        placement = place(calibration.frame.points_mm, nominal, weight, anchor)
    turn = placement.rotation
    measured = placement.apply(calibration.frame.points_mm)
    shared = calibration.station_covariance()
    covariance = placed_covariance(turn @ own @ turn.T, turn @ calibration.lever, shared, measured, weight)
    deviations = _deviations(readings, position_mm, tool_mm, measured, covariance)
    return Located(
        rows, point, position_mm, tool_mm, calibration, placement, anchor is not None, deviations, covariance
    )


def _deviations(
    readings: TracerReadings,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    measured_mm: FloatArray,
    covariance: FloatArray,
) -> Deviations:
    lengths = readings.lengths
    kept = {key: lengths.metadata[key] for key in ("date",) if key in lengths.metadata}
    return Deviations(
        position_mm=position_mm,
        deviation_mm=measured_mm - position_mm - tool_mm,
        u_mm=np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)),
        tool_mm=None if lengths.tool_mm is None else tool_mm,
        metadata={"machine": readings.layout.machine.name, **kept, "source": "compgen identify"},
    )


def _anchor(readings: TracerReadings, position_mm: FloatArray) -> int | None:
    """The pose at the machine's reference point, if it was measured once."""
    away = np.abs(position_mm - np.array(readings.layout.machine.reference_point_mm)).max(axis=1)
    at = np.flatnonzero(away < 1e-6)
    return int(at[0]) if len(at) == 1 else None
