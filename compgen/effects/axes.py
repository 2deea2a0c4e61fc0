"""Effects of single axes: heat, backlash, lost motion, periodic errors, lag, cosine error; changes during axis runs.

The card of a class is a template: ``{A}`` and ``{a}`` are replaced by the axis letter.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Self

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.effects.base import (
    Card,
    DisplacementEffect,
    Effect,
    Parameter,
    Setting,
    SingleAxisEffect,
    along,
    reference_of,
)
from compgen.effects.readings import Readings, legendre, velocity_mm_s

# Thermal expansion of an axis scale, about the point where the scale is fixed.


class ThermalScale(SingleAxisEffect):
    """d_a = c (p_a - p_fixed) (T_a - T_ref)."""

    template = Card(
        name="thermal_scale_{A}",
        title="Thermal growth of the scale of {A}",
        equation="d_{A} = c ({a} - fixed) (T_{A} - reference)",
        source="ISO 230-3; Mayr et al., CIRP Annals 61/2 (2012) 771",
        covariates=("temp_{a}_c",),
        parameters=(Parameter("c_um_per_m_k", 1e-6, "remaining expansion of the scale", 30.0),),
        aliases=("refractive_index", "spindle_growth_{A}", "E{A}{A} (its constant part)"),
        breaker="measure again at another temperature of the axis, with the temperatures logged",
        settings=(
            Setting("fixed_mm", "position at which the scale is fixed"),
            reference_of("temp_{a}_c"),
        ),
        scan="fixed_mm",
        slow=True,
    )

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Usual fixed points of scales: reference point, middle, either end, axis zero."""
        low, high = readings.machine.axes[self.axis].range_mm
        reference = readings.machine.reference_point_mm[self.axis]
        return list(dict.fromkeys((reference, 0.5 * (low + high), low, high, 0.0)))

    def defaults(self, readings: Readings) -> dict[str, float]:
        """The fixed point and the reference temperature."""
        return {"fixed_mm": readings.machine.reference_point_mm[self.axis], **super().defaults(readings)}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Distance from the fixed point times the temperature."""
        warm = readings.temperature_k(AXES[self.axis].lower(), self.settings.get("reference_c"))
        if warm is None:
            return None
        return along(self.axis, (readings.position_mm[:, self.axis] - self.used(readings)["fixed_mm"]) * warm)


# Displacement of the tool by a warm spindle or column, proportional to the spindle temperature.


class SpindleGrowth(SingleAxisEffect):
    """d_a = c (T_spindle - T_ref)."""

    template = Card(
        name="spindle_growth_{A}",
        title="Growth of spindle or column along {A}",
        equation="d_{A} = c (T_spindle - reference)",
        source="ISO 230-3 (thermal distortion by the rotating spindle)",
        covariates=("temp_spindle_c",),
        parameters=(Parameter("c_um_per_k", MM_PER_UM, "growth per kelvin of the spindle", 30.0),),
        aliases=("dead_path", "station_drift", "thermal_scale_{A}"),
        breaker="switch the spindle on and off in cycles while measuring, instead of one warm-up",
        settings=(reference_of("temp_spindle_c"),),
        slow=True,
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Temperature of the spindle."""
        warm = readings.temperature_k("spindle", self.settings.get("reference_c"))
        return None if warm is None else along(self.axis, warm)


# Backlash: an axis lags by half its play, on the other side after each reversal.


class Backlash(SingleAxisEffect):
    """d_a = c dir_a; the reversal error of ISO 230-2 is 2 c."""

    template = Card(
        name="backlash_{A}",
        title="Backlash of {A}",
        equation="d_{A} = c dir_{A}",
        source="ISO 230-2 (reversal value B = 2 c)",
        covariates=("approach_{a}",),
        parameters=(Parameter("c_um", MM_PER_UM, "half the reversal value", 100.0),),
        aliases=("servo_lag_{A}", "lost_motion_{A}"),
        breaker="measure every line in both directions at two feeds",
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit displacement along the axis, with the sign of the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        return along(self.axis, readings.approach[:, self.axis])


# Lost motion that varies along the travel: worn screws, wind-up that grows with the free length.


class LostMotion(SingleAxisEffect):
    """d_a = dir_a (c1 P1(s_a) + c2 P2(s_a)), s_a the position of the axis over its travel, -1 ... +1."""

    template = Card(
        name="lost_motion_{A}",
        title="Lost motion of {A} that varies along the travel",
        equation="d_{A} = dir_{A} (c1 P1(s_{A}) + c2 P2(s_{A}))",
        source="ISO 230-2: reversal value at each target position, as a polynomial of the position",
        covariates=("approach_{a}",),
        parameters=(
            Parameter("c1_um", MM_PER_UM, "half the reversal value: linear part, at the end of the travel", 100.0),
            Parameter("c2_um", MM_PER_UM, "half the reversal value: quadratic part, at the ends of the travel", 100.0),
        ),
        aliases=("backlash_{A}",),
        breaker="measure the full travel in both directions",
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """First and second Legendre polynomial, with the sign of the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        shape = legendre(readings.normalised(self.axis), range(1, 3))
        return along(self.axis, readings.approach[:, [self.axis]] * shape)


# Periodic errors of a screw or an encoder: first and second harmonic of the pitch.


#: Nominal leads of ball screws in mm (ISO 3408-2, table 1, and other common ones): tried if no pitch is known.
LEADS_MM = (4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 12.5, 15.0, 16.0, 20.0, 24.0, 25.0, 30.0, 32.0, 40.0, 50.0)


#: RMS below which readings do not show a wave of amplitude 1: positions vary by this much if they are 1 % of the pitch
#: away from its multiples.
LEAST_WAVE = 0.05


class Periodic(SingleAxisEffect):
    """d_a = s1 sin w + c1 cos w + s2 sin 2w + c2 cos 2w with w = 2 pi p_a / pitch."""

    template = Card(
        name="periodic_{A}",
        title="Periodic error of {A}",
        equation="d_{A} = s1 sin w + c1 cos w + s2 sin 2w + c2 cos 2w,  w = 2 pi {a} / pitch",
        source="ISO 230-2 (targets spread against the pitch); Fourier series of the pitch, two terms",
        covariates=(),
        parameters=tuple(
            Parameter(f"{name}_um", MM_PER_UM, f"amplitude of the {what}", 20.0)
            for name, what in (
                ("s1", "sine"),
                ("c1", "cosine"),
                ("s2", "sine of twice the angle"),
                ("c2", "cosine of twice the angle"),
            )
        ),
        breaker="steps that are not a multiple of the pitch, with a few targets spread over one pitch",
        settings=(Setting("pitch_mm", "pitch; default: screw_pitch_mm of the axis"),),
        scan="pitch_mm",
    )
    #: 1 for each wave that counts, 0 for the others, (4,).
    visible: FloatArray = np.ones(4)

    def pitch_mm(self, machine: Machine) -> float | None:
        """Pitch in mm: from the setting, else from the machine file; None if neither is known."""
        return self.settings.get("pitch_mm", machine.axes[self.axis].screw_pitch_mm)

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Common leads, if the machine file does not give the pitch."""
        if self.pitch_mm(readings.machine) is not None:
            return ()
        return [lead for lead in LEADS_MM if lead < readings.machine.axes[self.axis].length_mm / 6.0]

    def defaults(self, readings: Readings) -> dict[str, float]:
        """The pitch of the machine file."""
        pitch_mm = readings.machine.axes[self.axis].screw_pitch_mm
        return {} if pitch_mm is None else {"pitch_mm": pitch_mm}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Sine and cosine of the screw angle and of twice that angle."""
        pitch_mm = self.pitch_mm(readings.machine)
        if pitch_mm is None:
            return None
        angle = 2.0 * np.pi * readings.position_mm[:, self.axis] / pitch_mm
        waves = np.column_stack([np.sin(angle), np.cos(angle), np.sin(2.0 * angle), np.cos(2.0 * angle)])
        return along(self.axis, waves * self.visible)

    def shown(self, readings: Readings) -> Self | None:
        """The effect without waves that at these positions are constant, or equal to sums of those before them.

        At steps of the pitch, or of a simple fraction of it, they are so except for the rounding of the positions; the
        smallest misfit would then be explained by an enormous amplitude.
        """
        moved = self.displacement(readings)
        if moved is None:
            return self
        left = moved[:, self.axis] - moved[:, self.axis].mean(axis=0)
        visible = np.zeros(left.shape[1])
        for k in range(left.shape[1]):
            size = float(np.sqrt(np.mean(left[:, k] ** 2)))
            if size > LEAST_WAVE:
                visible[k] = 1.0
                left -= np.outer(left[:, k], left[:, k] @ left / (len(left) * size**2))
        if not visible.any():
            return None
        chosen = copy.copy(self)
        chosen.visible = visible
        return chosen


# Servo lag: the axis follows its command with a time delay, so its error grows with velocity.


class ServoLag(SingleAxisEffect):
    """d_a = tau v_a, v_a the velocity on the way to the reading."""

    template = Card(
        name="servo_lag_{A}",
        title="Servo lag of {A}",
        equation="d_{A} = tau v_{A},  v = feed times the direction of motion",
        source="velocity error of a position loop; ISO 230-4 (contouring)",
        covariates=("feed_mm_min", "approach_{a}"),
        parameters=(Parameter("tau_ms", 1e-3, "time by which the axis leads (negative: lags) its command", 5.0),),
        aliases=("backlash_{A}",),
        breaker="measure every line once more at another feed, or dwell before each reading",
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Velocity along the axis in mm/s."""
        velocity = velocity_mm_s(readings)
        if velocity is None or not np.any(velocity[:, self.axis]):
            return None
        return along(self.axis, velocity[:, self.axis])


# Cosine error: a scale or a beam misaligned with the axis measures too long a distance.


class CosineError(SingleAxisEffect):
    """d_a = -p_a theta^2 / 2; the parameter is c = theta^2 / 2."""

    template = Card(
        name="cosine_error_{A}",
        title="Cosine error of {A}",
        equation="d_{A} = -c {a},  c = theta^2 / 2",
        source="second order of the cosine of a small angle; ISO 230-6",
        covariates=(),
        parameters=(Parameter("c_ppm", 1e-6, "half the square of the angle: 50 ppm for 10 mrad", 100.0),),
        aliases=("E{A}{A} (its slope)", "laser_scale"),
        breaker="check the alignment of the scale",
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Minus the position."""
        return along(self.axis, -readings.position_mm[:, self.axis])


# Changes during a session of axis runs: drift, a step, a bad run, disturbed readings, an axis that has not settled.
#
# Time is ``time_s`` if it was logged, else the number of the reading in chronological order.

#: Number of time constants that are tried.
STEPS = 64
#: Longest time constant that is tried, as a share of the session, and the shortest, also in readings.
LONGEST, SHORTEST, SHORTEST_READINGS = 4.0, 0.015, 4.0
#: Time constants of settling that are tried, s: so close together that what is left of a settling that lies between two of
#: them is no backlash.
SETTLING_S = tuple(np.geomspace(0.2, 15.0, 32).round(4).tolist())
_WINDOW = (
    Setting("first", "time (or number in chronological order) of the first disturbed reading", needed=True),
    Setting("last", "time (or number) of the last disturbed reading", needed=True),
)


def time_of(readings: Readings) -> FloatArray:
    """Time in s, else the number of the reading in chronological order, else the row number, (n,)."""
    for name in ("time_s", "order"):
        logged = readings.covariate(name)
        if logged is not None and np.ptp(logged) > 0.0:
            return logged
    return np.arange(len(readings), dtype=np.float64)


def number_of(readings: Readings) -> FloatArray:
    """Number of each reading in chronological order, else its time, (n,)."""
    number = readings.covariate("order")
    return time_of(readings) if number is None else number


class WarmupDrift(Effect):
    """d = c (1 - exp(-(t - t0) / tau)); t is the time, or the number of the reading if no time was logged."""

    def __init__(self) -> None:
        self.card = Card(
            name="warmup_drift",
            title="Warm-up drift that levels off",
            equation="d = c (1 - exp(-(t - start) / tau))",
            source="ISO 230-2 (warm-up before the test), ISO 230-3",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "final value of the drift", 500.0),),
            aliases=("warm-up of the sensor", "linear_drift"),
            breaker="a stationary test: measure one target repeatedly with the axis at rest, then again with the sensor warm",
            kinds=("axis",),
            settings=(
                Setting("tau", "time constant, s; number of readings if no time was logged", needed=True),
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
        """Fraction of the drift reached; None without a time constant."""
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
            breaker="a longer session: a warm-up levels off, a drift of sensor or room continues",
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
        """Fraction of the span elapsed; None if all readings have the same time."""
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
            equation="d = c H(k - at), k the number of the reading in chronological order",
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
        """One from the step on; None if the step has no position."""
        if "at" not in self.settings:
            return None
        return np.asarray((number_of(readings) >= self.settings["at"])[:, None] * 1.0)


class _Window(Effect):
    """d = c from the reading ``first`` to the reading ``last``."""

    def columns(self, readings: Readings) -> FloatArray | None:
        """One within the window; None if the window has no position."""
        if not {"first", "last"} <= self.settings.keys():
            return None
        number = number_of(readings)
        inside = (number >= self.settings["first"]) & (number <= self.settings["last"])
        return np.asarray(inside[:, None] * 1.0)


class BadRun(_Window):
    """One run, or one direction of it, that deviates from all others."""

    def __init__(self) -> None:
        self.card = Card(
            name="bad_run",
            title="One run that differs from all others",
            equation="d = c in one run (or one direction of it), 0 in all others",
            source="repeats of ISO 230-2",
            covariates=("run",),
            parameters=(Parameter("c_um", MM_PER_UM, "offset of the run", 1000.0),),
            aliases=("step_between_runs (the first or the last run)",),
            breaker="measure two more runs: if they agree with the others, the run was bad",
            kinds=("axis",),
            settings=_WINDOW,
        )


class DisturbedReadings(_Window):
    """A short burst of deviating readings."""

    def __init__(self) -> None:
        self.card = Card(
            name="disturbed_readings",
            title="Readings disturbed for a short time",
            equation="readings from .. to .. differ from their repeats",
            source="scatter of repeats over time",
            covariates=("time_s or order",),
            parameters=(Parameter("c_um", MM_PER_UM, "mean offset of these readings", 1000.0),),
            aliases=("outliers", "bad_run"),
            breaker="measure these readings again",
            kinds=("axis",),
            settings=_WINDOW,
        )


class Settling(DisplacementEffect):
    """d_a = c dir_a exp(-dwell / tau): the axis creeps after stopping; readings after a short dwell are too early."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"settling_{letter}",
            title=f"{letter} is read before it has settled",
            equation=f"d_{letter} = c dir_{letter} exp(-dwell / tau)",
            source="ISO 230-2 (dwell at each target)",
            covariates=("dwell_s", f"approach_{letter.lower()}"),
            parameters=(Parameter("c_um", MM_PER_UM, "distance left when the command stops", 200.0),),
            aliases=(f"backlash_{letter}", f"servo_lag_{letter}"),
            breaker="one more run with twice the dwell, dwell_s logged",
            kinds=("axis",),
            settings=(Setting("tau_s", "time constant of settling, s", needed=True),),
            scan="tau_s",
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Time constants, if dwell times differ."""
        dwell = readings.covariate("dwell_s")
        return () if "tau_s" in self.settings or dwell is None or np.ptp(dwell) == 0.0 else SETTLING_S

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Remaining creep, with the sign of the direction of travel; None without dwell times or a time constant."""
        dwell = readings.covariate("dwell_s")
        if dwell is None or readings.approach is None or "tau_s" not in self.settings:
            return None
        return along(self.axis, readings.approach[:, self.axis] * np.exp(-dwell / self.settings["tau_s"]))
