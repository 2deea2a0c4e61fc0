"""Effects of single axes: thermal scale, spindle growth, backlash, lost motion, periodic error, lag, cosine error.

The card of a class is a template: ``{A}`` and ``{a}`` are replaced by the letter of the axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.effects.base import Card, Parameter, Setting, SingleAxisEffect, along, reference_of
from compgen.effects.readings import Readings, legendre, velocity_mm_s

# Growth of the scale of an axis with its temperature, about the point where the scale is fixed.


class ThermalScale(SingleAxisEffect):
    """d_a = c (p_a - p_fixed) (T_a - T_ref)."""

    template = Card(
        name="thermal_scale_{A}",
        title="Thermal growth of the scale of {A}",
        equation="d_{A} = c ({a} - fixed) (T_{A} - reference)",
        source="ISO 230-3; Mayr et al., CIRP Annals 61/2 (2012) 771",
        covariates=("temp_{a}_c",),
        parameters=(Parameter("c_um_per_m_k", 1e-6, "expansion that is left of the scale", 30.0),),
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
        """Where scales are fixed: at the reference point, in the middle, at either end, at zero of the axis."""
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


# Displacement of the tool by a warm spindle or column, proportional to the temperature of the spindle.


class SpindleGrowth(SingleAxisEffect):
    """d_a = c (T_spindle - T_ref)."""

    template = Card(
        name="spindle_growth_{A}",
        title="Growth of spindle or column along {A}",
        equation="d_{A} = c (T_spindle - reference)",
        source="ISO 230-3 (thermal distortion by the rotating spindle)",
        covariates=("temp_spindle_c",),
        parameters=(Parameter("c_um_per_k", MM_PER_UM, "growth for each K of the spindle", 30.0),),
        aliases=("dead_path", "station_drift", "thermal_scale_{A}"),
        breaker="switch the spindle on and off in cycles while measuring, in place of one warm-up",
        settings=(reference_of("temp_spindle_c"),),
        slow=True,
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Temperature of the spindle."""
        warm = readings.temperature_k("spindle", self.settings.get("reference_c"))
        return None if warm is None else along(self.axis, warm)


# Backlash: an axis stays behind by half its play, to the other side after each reversal.


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
        """Unit displacement along the axis, signed by the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        return along(self.axis, readings.approach[:, self.axis])


# Lost motion that varies along the stroke: worn screws, wind-up that grows with the free length.


class LostMotion(SingleAxisEffect):
    """d_a = dir_a (c1 P1(s_a) + c2 P2(s_a)), s_a the position of the axis over its travel, -1 ... +1."""

    template = Card(
        name="lost_motion_{A}",
        title="Lost motion of {A} that varies along the stroke",
        equation="d_{A} = dir_{A} (c1 P1(s_{A}) + c2 P2(s_{A}))",
        source="ISO 230-2: reversal value at each target position, as a polynomial of the position",
        covariates=("approach_{a}",),
        parameters=(
            Parameter("c1_um", MM_PER_UM, "half the reversal value that grows along the stroke, at its end", 100.0),
            Parameter("c2_um", MM_PER_UM, "half the reversal value that bends along the stroke, at its ends", 100.0),
        ),
        aliases=("backlash_{A}",),
        breaker="measure the whole stroke in both directions",
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """First and second Legendre polynomial, signed by the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        shape = legendre(readings.normalised(self.axis), range(1, 3))
        return along(self.axis, readings.approach[:, [self.axis]] * shape)


# Periodic errors of a screw or an encoder: first and second harmonic of the pitch.


#: Nominal leads of ball screws in mm (ISO 3408-2, table 1, and usual ones besides): tried where no pitch is known.
LEADS_MM = (4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 12.5, 15.0, 16.0, 20.0, 24.0, 25.0, 30.0, 32.0, 40.0, 50.0)


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
                ("c2", "cosine of it"),
            )
        ),
        breaker="steps that are not a multiple of the pitch, with a few targets spread over one pitch",
        settings=(Setting("pitch_mm", "pitch; default: screw_pitch_mm of the axis"),),
        scan="pitch_mm",
    )

    def pitch_mm(self, machine: Machine) -> float | None:
        """Pitch in mm: the setting, else that of the machine file; None if neither is known."""
        return self.settings.get("pitch_mm", machine.axes[self.axis].screw_pitch_mm)

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Usual leads, where the machine file does not give the pitch."""
        if self.pitch_mm(readings.machine) is not None:
            return ()
        return [lead for lead in LEADS_MM if lead < readings.machine.axes[self.axis].length_mm / 6.0]

    def defaults(self, readings: Readings) -> dict[str, float]:
        """The pitch of the machine file."""
        pitch_mm = readings.machine.axes[self.axis].screw_pitch_mm
        return {} if pitch_mm is None else {"pitch_mm": pitch_mm}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Sine and cosine of the angle of the screw and of twice that angle."""
        pitch_mm = self.pitch_mm(readings.machine)
        if pitch_mm is None:
            return None
        angle = 2.0 * np.pi * readings.position_mm[:, self.axis] / pitch_mm
        waves = [np.sin(angle), np.cos(angle), np.sin(2.0 * angle), np.cos(2.0 * angle)]
        return along(self.axis, np.column_stack(waves))


# Servo lag: the axis follows its command a time behind it, by more the faster it moves.


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


# Cosine error: a scale or a beam that leans against the axis measures too long a way.


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
