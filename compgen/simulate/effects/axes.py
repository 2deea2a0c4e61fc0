"""Simulated effects of single axes: backlash, lost motion, periodic errors, lag, growth, cosine error."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.simulate.effects.scene import Displacement, RunEffect, channel, from_reference, over_travel
from compgen.simulate.trajectory import Stops

Values = Mapping[str, float]
SECONDS_PER_MIN = 60.0


def _along(axis: int, moved_mm: FloatArray) -> FloatArray:
    vectors = np.zeros((len(moved_mm), 3))
    vectors[:, axis] = moved_mm
    return vectors


def backlash(axis: int, p: Values, settings: Values) -> Displacement:
    """Half the play, to the side that the axis came from."""
    return lambda machine, stops: _along(axis, p["c_um"] * stops.approach[:, axis])


def lost_motion(axis: int, p: Values, settings: Values) -> Displacement:
    """Play that changes along the stroke."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        s = over_travel(machine, stops, axis)
        return _along(axis, stops.approach[:, axis] * (p["c1_um"] * s + p["c2_um"] * (1.5 * s**2 - 0.5)))

    return moved


def periodic(axis: int, p: Values, settings: Values) -> Displacement:
    """Two harmonics of the pitch."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        pitch = settings.get("pitch_mm", machine.axes[axis].screw_pitch_mm or math.nan)
        turn = 2 * math.pi * stops.position_mm[:, axis] / pitch
        wave = p["s1_um"] * np.sin(turn) + p["c1_um"] * np.cos(turn)
        return _along(axis, wave + p["s2_um"] * np.sin(2 * turn) + p["c2_um"] * np.cos(2 * turn))

    return moved


def servo_lag(axis: int, p: Values, settings: Values) -> Displacement:
    """A time times the velocity of the axis on the way to the stop."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        speed = channel(stops, "feed_mm_min") / SECONDS_PER_MIN
        way = stops.way_mm / np.maximum(np.linalg.norm(stops.way_mm, axis=1, keepdims=True), 1e-12)
        return _along(axis, p["tau_ms"] * speed * way[:, axis])

    return moved


def thermal_scale(axis: int, p: Values, settings: Values) -> Displacement:
    """A scale that grows about the point where it is fixed."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        fixed = settings.get("fixed_mm", machine.reference_point_mm[axis])
        warm = from_reference(channel(stops, f"temp_{AXES[axis].lower()}_c"), settings, "reference_c")
        return _along(axis, p["c_um_per_m_k"] * warm * (stops.position_mm[:, axis] - fixed))

    return moved


def spindle_growth(axis: int, p: Values, settings: Values) -> Displacement:
    """A spindle or column that grows with the temperature of the spindle."""
    return lambda machine, stops: _along(
        axis, p["c_um_per_k"] * from_reference(channel(stops, "temp_spindle_c"), settings, "reference_c")
    )


def cosine_error(axis: int, p: Values, settings: Values) -> Displacement:
    """A scale that leans by theta: it stands at p cos(theta) where p was told."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        theta = math.sqrt(max(2.0 * p["c_ppm"], 0.0))
        return _along(axis, stops.position_mm[:, axis] * (math.cos(theta) - 1.0))

    return moved


def warmup_drift(p: Values, settings: Values) -> RunEffect:
    """A drift that dies out: the readings of an axis that warms up, or of its sensor."""

    def change(time_s: FloatArray) -> FloatArray:
        since = time_s - settings.get("start", float(time_s.min()))
        return p["c_um"] * (1.0 - np.exp(-since / settings["tau"]))

    return RunEffect("warmup_drift", change)


AXIS_EFFECTS = {
    "backlash": backlash,
    "lost_motion": lost_motion,
    "periodic": periodic,
    "servo_lag": servo_lag,
    "thermal_scale": thermal_scale,
    "spindle_growth": spindle_growth,
    "cosine_error": cosine_error,
}
