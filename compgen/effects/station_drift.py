"""A tracer that moves steadily while it measures."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter, Setting
from compgen.effects.readings import Readings

SECONDS_PER_HOUR = 3600.0


class StationDrift(Effect):
    """dl = -u . v (t - t0) for the readings of one station."""

    def __init__(self, station: str) -> None:
        self.station = station
        self.card = Card(
            name=f"station_drift_{station}",
            title=f"Drift of station {station}",
            equation="dl = -u . v (t - reference)",
            source="first order of a motion in time; Gomez-Acedo et al. 2015 (multilateration under drift)",
            covariates=("time_s", "station"),
            parameters=tuple(
                Parameter(f"v{axis.lower()}_um_per_h", MM_PER_UM / SECONDS_PER_HOUR, f"velocity along {axis}", 50.0)
                for axis in AXES
            ),
            aliases=("dead_path", "spindle_growth_X", "spindle_growth_Y", "spindle_growth_Z"),
            breaker="return to one reference point from time to time",
            kinds=("lengths",),
            settings=(Setting("reference_s", "time that counts as zero; default: the mean of the readings"),),
            slow=True,
        )

    def used(self, readings: Readings) -> dict[str, float]:
        """The reference time."""
        time_s = readings.covariate("time_s")
        return {**({} if time_s is None else {"reference_s": float(time_s.mean())}), **self.settings}

    def columns(self, readings: Readings) -> FloatArray | None:
        """Direction from the target to the station times the time."""
        own, time_s = readings.is_from(self.station), readings.covariate("time_s")
        if time_s is None or not own.any() or ("reference_s" not in self.settings and np.ptp(time_s[own]) == 0.0):
            return None
        since_s = np.where(own, time_s - self.used(readings)["reference_s"], 0.0)
        return np.asarray(-readings.direction * since_s[:, None])
