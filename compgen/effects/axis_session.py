"""What changes within a session of axis runs: drift, a step, a bad run, disturbed readings, an axis that has not settled.

Time is ``time_s`` where it was logged, else the number of the reading in the order of time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Effect, Parameter, Setting, along
from compgen.effects.readings import Readings

#: Number of time constants that are tried.
STEPS = 64
#: Longest time constant that is tried, as a share of the session, and the shortest, also in readings.
LONGEST, SHORTEST, SHORTEST_READINGS = 4.0, 0.015, 4.0
#: Time constants of settling that are tried, s.
SETTLING_S = (0.3, 0.6, 1.2, 2.5, 5.0, 10.0)
_WINDOW = (
    Setting("first", "time (or number in the order of time) of the first reading that is off", needed=True),
    Setting("last", "time (or number) of the last reading that is off", needed=True),
)


def time_of(readings: Readings) -> FloatArray:
    """Time in s, else the number of the reading in the order of time, else that of the row, (n,)."""
    for name in ("time_s", "order"):
        logged = readings.covariate(name)
        if logged is not None and np.ptp(logged) > 0.0:
            return logged
    return np.arange(len(readings), dtype=np.float64)


def number_of(readings: Readings) -> FloatArray:
    """Number of each reading in the order of time, else its time, (n,)."""
    number = readings.covariate("order")
    return time_of(readings) if number is None else number


class WarmupDrift(Effect):
    """d = c (1 - exp(-(t - t0) / tau)); t is the time, or the number of the reading where no time was logged."""

    def __init__(self) -> None:
        self.card = Card(
            name="warmup_drift",
            title="Warm-up drift that levels off",
            equation="d = c (1 - exp(-(t - start) / tau))",
            source="ISO 230-2 (warm-up before the test), ISO 230-3",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "drift in the end", 500.0),),
            aliases=("warm-up of the sensor", "linear_drift"),
            breaker="a stationary test: the same target again and again with the axis at rest, and then with the sensor warm",
            kinds=("axis",),
            settings=(
                Setting("tau", "time constant in s; in readings where no time was logged", needed=True),
                Setting("start", "time (or number of the reading) at which the drift begins; default: the first"),
            ),
            scan="tau",
            slow=True,
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Time constants from four readings to four times the duration of the measurement."""
        span = float(np.ptp(time_of(readings))) if len(readings) else 0.0
        if "tau" in self.settings or span == 0.0:
            return ()
        shortest = min(max(SHORTEST, SHORTEST_READINGS / len(readings)), 0.5)
        return list(np.geomspace(shortest * span, LONGEST * span, STEPS))

    def used(self, readings: Readings) -> dict[str, float]:
        """Time constant and start."""
        return {"start": float(time_of(readings).min()), **self.settings}

    def columns(self, readings: Readings) -> FloatArray | None:
        """Share of the drift that has come; None without a time constant."""
        if "tau" not in self.settings or not len(readings):
            return None
        since = time_of(readings) - self.used(readings)["start"]
        return np.asarray(-np.expm1(-since / self.settings["tau"])[:, None])


class LinearDrift(Effect):
    """d = c (t - start) / span: the drift from the first to the last reading is c."""

    def __init__(self) -> None:
        self.card = Card(
            name="linear_drift",
            title="Drift at a constant rate",
            equation="d = c (t - start) / span",
            source="ISO 230-2 (drift during the test), ISO 230-3",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "drift over the span", 500.0),),
            aliases=("warmup_drift", "drift of the sensor"),
            breaker="a longer session: a warm-up levels off, a drift of sensor or room goes on",
            kinds=("axis",),
            settings=(
                Setting("start", "time (or number of the reading) at which the drift begins; default: the first"),
                Setting("span", "duration (or number of readings) over which it drifts by c; default: all"),
            ),
            slow=True,
        )

    def used(self, readings: Readings) -> dict[str, float]:
        """Start and span."""
        time = time_of(readings)
        return {"start": float(time.min()), "span": float(np.ptp(time)), **self.settings}

    def columns(self, readings: Readings) -> FloatArray | None:
        """Share of the span that has passed; None for readings of one time."""
        if not len(readings) or np.ptp(time_of(readings)) == 0.0:
            return None
        used = self.used(readings)
        return np.asarray(((time_of(readings) - used["start"]) / used["span"])[:, None])


class StepBetweenRuns(Effect):
    """d = c H(k - at), k the number of the reading, H = 1 from ``at`` on."""

    def __init__(self) -> None:
        self.card = Card(
            name="step_between_runs",
            title="Step between two runs",
            equation="d = c H(k - at), k the number of the reading in the order of time",
            source="change of the zero during a test of ISO 230-2",
            covariates=("run or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "step", 1000.0),),
            aliases=("bad_run (the first or the last run)", "bumped sensor or optics"),
            breaker="return to one reference target before and after every run",
            kinds=("axis",),
            settings=(Setting("at", "number of the first reading after the step", needed=True),),
            scan="at",
        )

    def columns(self, readings: Readings) -> FloatArray | None:
        """One from the step on; None where it is not placed."""
        if "at" not in self.settings:
            return None
        return np.asarray((number_of(readings) >= self.settings["at"])[:, None] * 1.0)


class _Window(Effect):
    """d = c from the reading ``first`` to the reading ``last``."""

    def columns(self, readings: Readings) -> FloatArray | None:
        """One within the window; None where it is not placed."""
        if not {"first", "last"} <= self.settings.keys():
            return None
        number = number_of(readings)
        inside = (number >= self.settings["first"]) & (number <= self.settings["last"])
        return np.asarray(inside[:, None] * 1.0)


class BadRun(_Window):
    """One run, or one way of it, that is off against all others."""

    def __init__(self) -> None:
        self.card = Card(
            name="bad_run",
            title="One run that differs from all others",
            equation="d = c in one run (or one way of it), 0 in all others",
            source="repeats of ISO 230-2",
            covariates=("run",),
            parameters=(Parameter("c_um", MM_PER_UM, "offset of the run", 1000.0),),
            aliases=("step_between_runs (the first or the last run)",),
            breaker="measure two more runs: if they agree with the others, the run was bad",
            kinds=("axis",),
            settings=_WINDOW,
        )


class DisturbedReadings(_Window):
    """A short burst of readings that are off."""

    def __init__(self) -> None:
        self.card = Card(
            name="disturbed_readings",
            title="Readings disturbed for a short time",
            equation="readings from .. to .. are off against their repeats",
            source="scatter of repeats over time",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "mean offset of these readings", 1000.0),),
            aliases=("outliers", "bad_run"),
            breaker="measure these readings again",
            kinds=("axis",),
            settings=_WINDOW,
        )


class Settling(DisplacementEffect):
    """d_a = c dir_a exp(-dwell / tau): the axis creeps on after it has stopped; readings with a short dwell are early."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"settling_{letter}",
            title=f"{letter} is read before it has settled",
            equation=f"d_{letter} = c dir_{letter} exp(-dwell / tau)",
            source="ISO 230-2 (dwell at each target)",
            covariates=("dwell_s", f"approach_{letter.lower()}"),
            parameters=(Parameter("c_um", MM_PER_UM, "what is missing at the moment of the stop", 200.0),),
            aliases=(f"backlash_{letter}", f"servo_lag_{letter}"),
            breaker="one more run with twice the dwell, dwell_s logged",
            kinds=("axis",),
            settings=(Setting("tau_s", "time constant of settling, s", needed=True),),
            scan="tau_s",
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Time constants, if dwells differ."""
        dwell = readings.covariate("dwell_s")
        return () if "tau_s" in self.settings or dwell is None or np.ptp(dwell) == 0.0 else SETTLING_S

    def displacement(self, readings: Readings) -> FloatArray | None:
        """What is still missing, signed by the direction of travel; None without dwells or a time constant."""
        dwell = readings.covariate("dwell_s")
        if dwell is None or readings.approach is None or "tau_s" not in self.settings:
            return None
        return along(self.axis, readings.approach[:, self.axis] * np.exp(-dwell / self.settings["tau_s"]))
