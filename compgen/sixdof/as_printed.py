"""Equations 5 to 7 of Jia et al. 2022 as they are printed, for comparison with the paper only.

Exact ray tracing refutes them in several places (``docs/sixdof.md``, "What the print has otherwise"): the cross-talk of
the angles in mode 1, the drift in yaw and pitch, the roll of Y and Z. Nothing else of the program uses this module. Where
the print cannot be read (pitch of Y, the sign of the drift) the traced form stands.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import CompgenWarning, InputError
from compgen.sixdof.frames import AxisRun, zeroed
from compgen.sixdof.instrument import AxisSetUp, Instrument
from compgen.sixdof.optics import DIRECTIONS, ROTATIONS, Optics
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import RelativeRun, drift_of, signals_of

WARNING = (
    "as_printed = true: the paper's own equations 5 to 7 are used, with the signs that ray tracing refutes (cross-talk in "
    "mode 1, drift, roll of Y and Z); the result is for comparison with the paper only, never for a machine"
)


class _Terms:
    """What the equations speak of, for one run of n rows."""

    def __init__(self, readings: SixDof, optics: Optics, entry: AxisSetUp, run: RelativeRun) -> None:
        signals = signals_of(readings, run.rows)
        f = optics.focal_length_mm
        self.y1, self.z1, self.z2 = signals[:, 1], signals[:, 2], signals[:, 4]
        self.yp, self.zp = signals[:, 5] / (2 * f), signals[:, 6] / (2 * f)
        self.ay, self.az = drift_of(readings, run.rows, f).T
        self.L, self.h, self.t = run.distance_mm, optics.beam_separation_mm, optics.reduced_depth_mm
        self.n, self.b, self.second = optics.glass_index, optics.prism_leg_mm, float(entry.set_up.mode == 2)
        self.s = entry.set_up.sense
        self.values: Mapping[str, float] = entry.systematics

    def p(self, name: str) -> float:
        """Value of a systematic parameter, mm or rad, 0 if it is not calibrated."""
        return self.values.get(name, 0.0)


def _x(m: _Terms) -> list[FloatArray]:
    """Equation 5: horizontal, vertical, yaw, pitch, roll of X."""
    p = m.p
    yaw = -m.s * (m.yp + p("eps_zic") - p("eps_PEz") / 2 - m.ay)
    pitch = m.s * (m.zp - p("eps_yic") + p("eps_PEy") / 2 - m.az)
    across = m.y1 / 2 - p("delta_ymc1") / 2 + p("eps_zmc1") * m.L / 2 - p("delta_yic")
    up = m.z1 / 2 - p("delta_zmc1") / 2 - p("eps_ymc1") * m.L / 2 - p("delta_zic")
    horizontal = m.s * (across + m.t * (p("eps_zic") + yaw) + m.second * m.L * yaw + m.L * m.ay)
    vertical = m.s * (up - m.t * (p("eps_yic") + pitch) - m.second * m.L * pitch + m.L * m.az)
    cubes = p("delta_zmc2") - p("delta_zmc1") + m.L * (p("eps_ymc2") - p("eps_ymc1"))
    roll = m.s * (m.z1 - m.z2 + 2 * p("eps_PEy") * (m.L + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def _y(m: _Terms) -> list[FloatArray]:
    """Equation 6: horizontal, vertical, yaw, pitch, roll of Y."""
    p, n, b = m.p, m.n, m.b
    faces = p("eps_zmrs1") + p("eps_zmrs2")
    yaw = m.s * (m.yp - p("eps_zic") - p("eps_PEz") / 2 + 2 * p("eps_zir") - (n - 1) * faces - m.ay)
    tilt = p("eps_xic") + p("eps_PEy") / 2 - p("eps_xir") - p("eps_yir") + (n - 1) * (p("eps_ymrs1") + p("eps_xmrs2"))
    pitch = -m.s * (m.zp + tilt - m.az)
    outer, inner, arm = (n - 1) * (m.L + m.t), (n - 1) * (m.L + m.t) + b * (1 - 1 / n), m.L + b / 2
    across = m.y1 / 2 - p("eps_zmc3") * (m.L + b / n) / 2 - p("delta_xmc3") / 2 - p("delta_xic")
    across = across + p("delta_xir") - p("delta_yir") - p("eps_zir") * (2 * m.L + 2 * m.t + b / n + b / 2)
    across = across + inner * p("eps_zmrs1") + outer * p("eps_zmrs2")
    up = m.z1 / 2 + p("eps_xmc3") * (m.L + b / n) / 2 - p("delta_zmc3") / 2 - p("delta_zic")
    up = up + p("eps_xir") * (arm + m.t) + p("eps_yir") * (arm + m.t + b / n)
    up = up - inner * p("eps_ymrs1") - outer * p("eps_xmrs2")
    horizontal = m.s * (across - m.t * (p("eps_zic") + yaw) - m.second * arm * yaw + m.L * m.ay)
    vertical = m.s * (up + m.t * (p("eps_xic") + pitch) + m.second * arm * pitch + m.L * m.az)
    cubes = p("delta_zmc4") - p("delta_zmc3") + (p("eps_xmc3") - p("eps_xmc4")) * (m.L + b / n)
    roll = m.s * (m.z1 - m.z2 + 2 * p("eps_PEy") * (m.L + b / n + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def _z(m: _Terms) -> list[FloatArray]:
    """Equation 7: horizontal, vertical, yaw, pitch, roll of Z."""
    p, b, arm = m.p, m.b, m.L + m.b / 2
    yaw = m.s * (m.yp - p("eps_xic") - p("eps_PEz") / 2 + p("eps_xir") + p("eps_zir") - m.ay)
    pitch = -m.s * (m.zp + p("eps_yic") + p("eps_PEy") / 2 - 2 * p("eps_yir") - m.az)
    across = m.y1 / 2 - p("delta_ymc5") / 2 - p("delta_yic") - (b + m.L) * p("eps_xmc5") / 2
    across = across - (p("eps_xir") + p("eps_zir")) * (arm + m.t)
    up = m.z1 / 2 - p("delta_xmc5") / 2 - p("delta_xic") + p("delta_xir") - p("delta_zir")
    up = up + (b + m.L) * p("eps_ymc5") / 2 + 2 * p("eps_yir") * (m.L + 0.75 * b - m.t)
    horizontal = m.s * (across - m.t * (p("eps_xic") + yaw) - m.second * arm * yaw + m.L * m.ay)
    vertical = m.s * (up + m.t * (p("eps_yic") + pitch) + m.second * arm * pitch + m.L * m.az)
    cubes = p("delta_xmc6") - p("delta_xmc5") - (b + m.L) * (p("eps_ymc6") - p("eps_ymc5"))
    roll = m.s * (m.z1 - m.z2 - 2 * p("eps_PEy") * (b + m.L + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def printed_run(machine: Machine, readings: SixDof, instrument: Instrument, run: RelativeRun) -> AxisRun:
    """Errors of the moving body over a run by the printed equations, in its own axes, zero at the reference point."""
    entry, axis = instrument.axes[run.axis], run.axis
    if entry.set_up.beam_direction < 0:
        message = "is -1, for which the paper prints no equations; as_printed needs beam_direction = 1"
        raise InputError(message, file=instrument.source, field=f"[axes.{AXES[axis]}] beam_direction")
    terms = _Terms(readings, instrument.optics, entry, run)
    delta, eps = np.zeros((len(run.rows), 3)), np.zeros((len(run.rows), 3))
    channels = (_x, _y, _z)[axis](terms)
    delta[:, list(DIRECTIONS[axis][1:])] = np.column_stack(channels[:2])
    eps[:, list(ROTATIONS[axis])] = np.column_stack(channels[2:])
    delta[:, axis] = terms.s * run.shift_mm[:, axis]
    delta, eps = (zeroed(machine, axis, run.position_mm, values) for values in (delta, eps))
    return AxisRun(axis, run.run, run.position_mm, delta, eps, run.direction, False, "as printed")


def warn_as_printed() -> None:
    """Say loudly that the result is not for a machine."""
    warnings.warn(WARNING, CompgenWarning, stacklevel=3)
