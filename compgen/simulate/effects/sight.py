"""Simulated effects of the tracers and of the air: they change lengths without moving the tip."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.simulate.effects.scene import Sights, from_reference

Values = Mapping[str, float]
Change = Callable[[Sights], FloatArray]


def refractive_index(p: Values, settings: Values) -> Change:
    """All lengths follow the air."""
    return lambda sights: (
        p["c_ppm_per_k"] * sights.range_mm * from_reference(sights.channel("temp_ambient_c"), settings, "reference_c")
    )


def dead_path(p: Values, settings: Values) -> Change:
    """A piece of air for each station; without an entry a station has none."""

    def change(sights: Sights) -> FloatArray:
        path = np.array([p.get(f"c_{name}_um_per_k", 0.0) for name in sights.stations])
        return path[sights.station] * from_reference(sights.channel("temp_ambient_c"), settings, "reference_c")

    return change


def laser_scale(p: Values, settings: Values) -> Change:
    """All lengths too long by one factor."""
    return lambda sights: p["c_ppm"] * sights.range_mm


def target_angle(p: Values, settings: Values) -> Change:
    """A target that is longer the steeper the beam comes in."""

    def change(sights: Sights) -> FloatArray:
        steepness = (sights.tip_mm[:, 2] - sights.station_mm[:, 2]) / sights.range_mm
        return p["c1_um"] * steepness**2 + p["c2_um"] * steepness**3

    return change


def _of(station: str, sights: Sights) -> FloatArray:
    """1 for the readings of a station, else 0."""
    return np.array([name == station for name in sights.stations], dtype=np.float64)[sights.station]


def station_drift(station: str, p: Values, settings: Values) -> Change:
    """A station that walks away, at its true distance at each time."""

    def change(sights: Sights) -> FloatArray:
        velocity = np.array([p["vx_um_per_h"], p["vy_um_per_h"], p["vz_um_per_h"]])
        since = from_reference(sights.time_s, settings, "reference_s")
        moved = sights.tip_mm - sights.station_mm - np.outer(since, velocity)
        return np.asarray(_of(station, sights) * (np.linalg.norm(moved, axis=1) - sights.range_mm))

    return change


def length_step(station: str, p: Values, settings: Values) -> Change:
    """Counts that were lost at a time."""
    return lambda sights: p["c_um"] * _of(station, sights) * (sights.time_s >= settings["time_s"])


def tracer_runout(station: str, p: Values, settings: Values) -> Change:
    """A sphere that is not round: harmonics of the direction in which the head looks."""

    def change(sights: Sights) -> FloatArray:
        line = sights.tip_mm - sights.station_mm
        turn = np.exp(1j * np.arctan2(line[:, 1], line[:, 0]))
        second, third = (p[f"s{k}_um"] * (turn**k).imag + p[f"c{k}_um"] * (turn**k).real for k in (2, 3))
        return np.asarray(_of(station, sights) * (second + third))

    return change


LENGTH_EFFECTS: dict[str, Callable[[Values, Values], Change]] = {
    "refractive_index": refractive_index,
    "dead_path": dead_path,
    "laser_scale": laser_scale,
    "target_angle": target_angle,
}
STATION_EFFECTS = {"station_drift": station_drift, "length_step": length_step, "tracer_runout": tracer_runout}
