"""Warm-up drift in an axis run: one exponential in measuring order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter, Setting
from compgen.effects.readings import Readings

#: Number of time constants that are tried.
STEPS = 16


class WarmupDrift(Effect):
    """d = c (1 - exp(-(t - t0) / tau)); t is the time, or the number of the reading where no time was logged."""

    def __init__(self) -> None:
        self.card = Card(
            name="warmup_drift",
            title="Warm-up drift in measuring order",
            equation="d = c (1 - exp(-(t - start) / tau))",
            source="ISO 230-2 (warm-up before the test), ISO 230-3",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "drift in the end", 500.0),),
            aliases=("warm-up of the sensor",),
            breaker="a stationary test: the same target again and again with the axis at rest, and then with the sensor warm",
            kinds=("axis",),
            settings=(
                Setting("tau", "time constant in s; in readings where no time was logged", needed=True),
                Setting("start", "time (or number of the reading) at which the drift begins; default: the first"),
            ),
            scan="tau",
            slow=True,
        )

    def _order(self, readings: Readings) -> FloatArray:
        """Time in s, else the logged order, else the number of the row."""
        for name in ("time_s", "order"):
            logged = readings.covariate(name)
            if logged is not None and np.ptp(logged) > 0.0:
                return logged
        return np.arange(len(readings), dtype=np.float64)

    def positions(self, readings: Readings) -> Sequence[float]:
        """Time constants from a fiftieth of the measurement to twice its duration."""
        span = float(np.ptp(self._order(readings)))
        return () if "tau" in self.settings or span == 0.0 else list(np.geomspace(span / 50.0, 2.0 * span, STEPS))

    def used(self, readings: Readings) -> dict[str, float]:
        """Time constant and start."""
        return {"start": float(self._order(readings).min()), **self.settings}

    def columns(self, readings: Readings) -> FloatArray | None:
        """Share of the drift that has come; None without a time constant."""
        if "tau" not in self.settings or not len(readings):
            return None
        since = self._order(readings) - self.used(readings)["start"]
        return np.asarray(-np.expm1(-since / self.settings["tau"])[:, None])
