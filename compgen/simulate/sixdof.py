"""Raw signals of the six-DOF instrument on a virtual machine: exact chain, exact ray tracer."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.model.exact import tip_position
from compgen.simulate.ray_tracer import Tracer
from compgen.sixdof.frames import expected_away
from compgen.sixdof.instrument import Instrument


def tool_pose(machine: Machine, truth: ErrorTable, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose of the tool's body in the workpiece frame at positions (n, 3): origin (n, 3) in mm, rotation (n, 3, 3)."""
    values = truth.at(position_mm)
    origin = tip_position(machine, values, position_mm, np.zeros(3))
    columns = [tip_position(machine, values, position_mm, unit) - origin for unit in np.eye(3)]
    return origin, np.stack(columns, axis=2)


def run_positions(machine: Machine, instrument: Instrument, axis: int, along_mm: FloatArray) -> FloatArray:
    """Positions of all axes while ``axis`` goes to ``along_mm`` (n,), shape (n, 3)."""
    position = np.tile(np.array(instrument.axes[axis].position_mm or (0.0, 0.0, 0.0)), (len(along_mm), 1))
    position[:, axis] = along_mm
    return position


def run_signals(
    machine: Machine,
    truth: ErrorTable,
    instrument: Instrument,
    axis: int,
    along_mm: FloatArray,
    drift_rad: FloatArray | None = None,
    first_mm: float | None = None,
    scatter: FloatArray | None = None,
) -> FloatArray:
    """Signals (n, 7) of one run, in mm and in the order of SIGNALS; the interferometer's with its travel.

    Chain and mode say where unit and target are. The one on the workpiece stands still in the workpiece frame; the one
    at the tool has the offset ``target_offset_mm`` (the target's front centre, or the unit's reference point).

    Parameters
    ----------
    along_mm : commanded positions of the axis, (n,).
    drift_rad : tilt of the beams toward unit +y, +z, (n, 2); None for no drift.
    first_mm : where ``distance_first_mm`` holds, default the first position.
    scatter : what moves the body at the tool further, translations in mm and rotations in rad, (n, 6).
    """
    entry, optics = instrument.axes[axis], instrument.optics
    position = run_positions(machine, instrument, axis, along_mm)
    offset = np.array(entry.target_offset_mm)
    origin, turn = tool_pose(machine, truth, position)
    further = np.zeros((len(along_mm), 6)) if scatter is None else scatter
    moved = origin + np.einsum("nij,j->ni", turn, offset) - position - offset + further[:, :3]
    at_tool = expected_away(machine, instrument)[axis] > 0
    tracer = Tracer(optics, axis, 1 if at_tool else 2, entry.set_up.beam_direction, entry.systematics)
    start = along_mm[0] if first_mm is None else first_mm
    travel = entry.set_up.beam_direction * (along_mm - start)
    tilt = np.zeros((len(along_mm), 2)) if drift_rad is None else drift_rad
    angles = Rotation.from_matrix(turn).as_rotvec() + further[:, 3:]
    return np.array(
        [
            tracer.signals(
                float(entry.distance_first_mm or 0.0),
                moved[k],
                angles[k],
                drift_rad=tuple(tilt[k]),
                travel_mm=travel[k],
            )
            for k in range(len(along_mm))
        ]
    )
