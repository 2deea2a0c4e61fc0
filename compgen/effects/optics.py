"""Effects of tracers and lasers on the measured lengths, and the list of effects of the six-DOF instrument.

Effects on lengths change each reading; they do not move the tool tip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import MM_PER_UM, SECONDS_PER_HOUR
from compgen.effects.base import Card, Effect, Parameter, Setting, reference_of, vector_parameters
from compgen.effects.readings import Readings, step_times_s

# Lengths that follow the air temperature: a wavelength that was not, or wrongly, compensated.


class RefractiveIndex(Effect):
    """dl = c l (T_air - T_ref)."""

    card = Card(
        name="refractive_index",
        title="Refractive index of the air, not compensated",
        equation="dl = c l (T_ambient - reference)",
        source="Birch & Downs, Metrologia 30 (1993) 155: about -0.93 ppm of the index per kelvin",
        covariates=("temp_ambient_c",),
        parameters=(Parameter("c_ppm_per_k", 1e-6, "change of a length per kelvin of the air", 5.0),),
        aliases=("dead_path", "thermal_scale_X", "thermal_scale_Y", "thermal_scale_Z"),
        breaker="vary the range at constant air temperature, and the temperature at constant range",
        kinds=("lengths",),
        settings=(reference_of("temp_ambient_c"),),
        slow=True,
    )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Range times the air temperature."""
        warm = readings.temperature_k("ambient", self.settings.get("reference_c"))
        return None if warm is None else (readings.range_mm * warm)[:, None]


# Dead path of the interferometers: a part of the beam path in air that is not compensated.


class DeadPath(Effect):
    """dl = c_i (T_air - T_ref), c_i for each station i."""

    def __init__(self, stations: tuple[str, ...]) -> None:
        self.stations = stations
        self.card = Card(
            name="dead_path",
            title="Dead path of the interferometers",
            equation="dl = c_i (T_ambient - reference),  i the station",
            source="Steinmetz, Precision Engineering 12 (1990) 12; Birch & Downs, Metrologia 30 (1993) 155",
            covariates=("temp_ambient_c", "station"),
            parameters=tuple(
                Parameter(f"c_{name}_um_per_k", MM_PER_UM, f"change of the lengths of {name} per kelvin", 5.0)
                for name in stations
            ),
            aliases=("refractive_index", "station_drift", "spindle_growth_X", "spindle_growth_Y", "spindle_growth_Z"),
            breaker="vary the range at constant air temperature, and the temperature at constant range",
            kinds=("lengths",),
            settings=(reference_of("temp_ambient_c"),),
            slow=True,
        )

    def columns(self, readings: Readings) -> FloatArray | None:
        """The air temperature, one column per station."""
        warm = readings.temperature_k("ambient", self.settings.get("reference_c"))
        if warm is None:
            return None
        return np.column_stack([np.where(readings.is_from(name), warm, 0.0) for name in self.stations])


# A scale error of the lengths, common to all stations: laser wavelength, a wrong air pressure.


class LaserScale(Effect):
    """dl = c l."""

    card = Card(
        name="laser_scale",
        title="Scale error of the lengths",
        equation="dl = c l",
        source="wavelength of the laser; Birch & Downs, Metrologia 30 (1993) 155",
        covariates=(),
        parameters=(Parameter("c_ppm", 1e-6, "scale error", 20.0),),
        aliases=("a common slope of EXX, EYY and EZZ",),
        breaker="measure a calibrated length (a ball bar, a step gauge)",
        kinds=("lengths",),
    )

    def columns(self, readings: Readings) -> FloatArray | None:
        """The range."""
        return readings.range_mm[:, None]


# A tracer that moves at constant velocity while it measures.


class StationEffect(Effect):
    """An effect on the lengths of one station; its ``template`` is its card with ``{station}`` for the station name."""

    template: ClassVar[Card]

    def __init__(self, station: str) -> None:
        self.station = station
        self.card = self.template.named(station=station)


class StationDrift(StationEffect):
    """dl = -u . v (t - t0) for the readings of one station."""

    template = Card(
        name="station_drift_{station}",
        title="Drift of station {station}",
        equation="dl = -u . v (t - reference)",
        source="first order of a motion in time; Gomez-Acedo et al. 2015 (multilateration under drift)",
        covariates=("time_s", "station"),
        parameters=vector_parameters("velocity along {}", 50.0, "um_per_h", MM_PER_UM / SECONDS_PER_HOUR),
        aliases=("dead_path", "spindle_growth_X", "spindle_growth_Y", "spindle_growth_Z"),
        breaker="return to one reference point from time to time",
        kinds=("lengths",),
        settings=(
            Setting("reference_s", "time at which the effect is zero; default: mean of the readings", mean_of="time_s"),
        ),
        slow=True,
    )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Direction from the target to the station times the time."""
        own, time_s = readings.is_from(self.station), readings.covariate("time_s")
        if time_s is None or not own.any() or ("reference_s" not in self.settings and np.ptp(time_s[own]) == 0.0):
            return None
        since_s = np.where(own, time_s - self.used(readings)["reference_s"], 0.0)
        return np.asarray(-readings.direction * since_s[:, None])


# A step in the lengths of one station: an interrupted beam that was re-acquired with a different count.


class LengthStep(StationEffect):
    """dl = c H(t - tau) for the readings of one station, H = 1 from tau on."""

    template = Card(
        name="length_step_{station}",
        title="Step in the lengths of station {station}",
        equation="dl = c H(t - tau)",
        source="loss of counts after a beam break, as a change point",
        covariates=("time_s", "station"),
        parameters=(Parameter("c_um", MM_PER_UM, "height of the step", 1000.0),),
        aliases=("slowly varying noise", "machine_jump"),
        breaker="repeat the first point of every line at its end",
        kinds=("lengths",),
        settings=(Setting("time_s", "time of the step", needed=True),),
        scan="time_s",
        slow=True,
    )

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Times between the runs of the station."""
        return step_times_s(readings, readings.is_from(self.station))

    def columns(self, readings: Readings) -> FloatArray | None:
        """1 for the station's readings after the step; None without a step time."""
        own, time_s = readings.is_from(self.station), readings.covariate("time_s")
        if "time_s" not in self.settings or time_s is None or not own.any():
            return None
        return np.asarray((own & (time_s >= self.settings["time_s"])).astype(np.float64)[:, None])


# Runout of a tracer's sphere or centre: lengths that depend on the azimuth of the beam.


class TracerRunout(StationEffect):
    """dl = s2 sin 2a + c2 cos 2a + s3 sin 3a + c3 cos 3a, a the azimuth of the beam of one station."""

    template = Card(
        name="tracer_runout_{station}",
        title="Runout of the tracer at station {station}",
        equation="dl = s2 sin 2a + c2 cos 2a + s3 sin 3a + c3 cos 3a,  a azimuth of the beam",
        source="Schwenke et al., CIRP Annals 54/1 (2005) 475; the first harmonic is a shift of the station",
        covariates=("station",),
        parameters=tuple(
            Parameter(f"{name}_um", MM_PER_UM, f"amplitude {name}", 5.0) for name in ("s2", "c2", "s3", "c3")
        ),
        aliases=("smooth errors of the machine",),
        breaker="turn the head of the tracer by 180 degrees and measure again",
        kinds=("lengths",),
    )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Second and third harmonic of the azimuth."""
        own = readings.is_from(self.station)
        if not own.any():
            return None
        azimuth = np.arctan2(readings.direction[:, 1], readings.direction[:, 0])
        waves = [wave(k * azimuth) for k in (2, 3) for wave in (np.sin, np.cos)]
        return np.asarray(own[:, None] * np.column_stack(waves))


# A target whose reflection depends on the angle of incidence of the beam.


class TargetAngle(Effect):
    """dl = c1 u_z^2 + c2 u_z^3, u_z the component of the beam along the axis of the target."""

    card = Card(
        name="target_angle",
        title="Target error that depends on the angle of the beam",
        equation="dl = c1 u_z^2 + c2 u_z^3,  u from the station to the target",
        source="cat's eye and corner cube off their axis: series of the angle, second and third order",
        covariates=(),
        parameters=(
            Parameter("c1_um", MM_PER_UM, "second order", 20.0),
            Parameter("c2_um", MM_PER_UM, "third order", 20.0),
        ),
        aliases=("smooth errors of the machine", "positions of the stations"),
        breaker="turn the target and measure again",
        kinds=("lengths",),
    )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Square and cube of the vertical component of the beam."""
        vertical = readings.direction[:, 2]
        return np.column_stack([vertical**2, vertical**3])


# Effects of the six-DOF laser instrument; what the data of one axis show of them is found from its signals.


SOURCE = "Jia et al. 2022, section 4; docs/conventions.md"
REVERSAL = "turn the target by 180 degrees, measure with a second target offset, or calibrate the instrument"


def _card(name: str, title: str, equation: str, breaker: str = REVERSAL) -> Card:
    return Card(
        name, title, equation, SOURCE, (), (), ("the geometric error of the same signal",), breaker, ("sixdof",)
    )


def sixdof_cards() -> list[Card]:
    """Cards of the effects of the instrument."""
    detectors = [
        _card(f"detector_gain_{name}", f"Gain of the detector of {name}", f"the signal of {name} is scaled")
        for name in ("x", "y", "pitch", "yaw", "roll")
    ]
    return [
        _card("beam_drift", "Angle drift of the beam", "straightness signals = L times an angle that drifts with time",
              "measure forth and back three times"),
        _card("crosstalk_yaw", "Crosstalk of yaw into straightness", "signal of straightness + k times yaw"),
        _card("crosstalk_pitch", "Crosstalk of pitch into straightness", "signal of straightness + k times pitch"),
        *detectors,
        _card("nonparallel_beams", "Beams that are not parallel", "roll signal = L times the angle between the beams"),
        _card("distance_offset", "Wrong distance between instrument and target", "L is off by a constant"),
    ]  # fmt: skip
