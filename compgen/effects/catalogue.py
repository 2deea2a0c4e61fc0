"""The registry of the catalogue: every family of effects in the order in which it is listed."""

from __future__ import annotations

from collections.abc import Sequence

from compgen.effects.angular import ANGULAR_NAMES
from compgen.effects.axis_session import (
    BadRun,
    DisturbedReadings,
    LinearDrift,
    Settling,
    StepBetweenRuns,
    WarmupDrift,
)
from compgen.effects.backlash import Backlash
from compgen.effects.base import (
    ANY_STATION,
    AllStations,
    Effect,
    Family,
    PerAxis,
    PerName,
    PerStation,
    Single,
)
from compgen.effects.beam_sag import BeamSag
from compgen.effects.column_bending import ColumnBending
from compgen.effects.cosine_error import CosineError
from compgen.effects.dead_path import DeadPath
from compgen.effects.laser_scale import LaserScale
from compgen.effects.length_step import LengthStep
from compgen.effects.lever import Lever
from compgen.effects.load_deflection import LoadDeflection
from compgen.effects.lost_motion import LostMotion
from compgen.effects.machine_jump import MachineJump
from compgen.effects.noise_classes import NoiseClasses
from compgen.effects.periodic import Periodic
from compgen.effects.ram_droop import RamDroop
from compgen.effects.refractive_index import RefractiveIndex
from compgen.effects.servo_lag import ServoLag
from compgen.effects.sign_error import SignError
from compgen.effects.sixdof_effects import SixDofEffects
from compgen.effects.spindle_growth import SpindleGrowth
from compgen.effects.squareness import Squareness
from compgen.effects.station_drift import StationDrift
from compgen.effects.target_angle import TargetAngle
from compgen.effects.thermal_scale import ThermalScale
from compgen.effects.tool_offset_error import ToolOffsetError
from compgen.effects.tracer_runout import TracerRunout

_BUILT_IN: tuple[Family, ...] = (
    PerAxis("thermal_scale", ThermalScale),
    PerAxis("spindle_growth", SpindleGrowth),
    Single("column_bending", ColumnBending),
    PerAxis("backlash", Backlash),
    PerAxis("lost_motion", LostMotion),
    PerAxis("periodic", Periodic),
    PerAxis("servo_lag", ServoLag),
    PerName("lever", ANGULAR_NAMES, Lever),
    PerName("squareness", ("C0Y", "B0Z", "A0Z"), Squareness),
    Single("beam_sag", BeamSag),
    Single("ram_droop", RamDroop),
    Single("load_deflection", LoadDeflection),
    Single("refractive_index", RefractiveIndex),
    AllStations("dead_path", DeadPath),
    Single("laser_scale", LaserScale),
    PerStation("station_drift", StationDrift),
    PerStation("length_step", LengthStep),
    Single("machine_jump", MachineJump),
    PerStation("tracer_runout", TracerRunout),
    Single("target_angle", TargetAngle),
    Single("tool_offset_error", ToolOffsetError),
    PerName("sign", ANGULAR_NAMES, SignError),
    PerAxis("cosine_error", CosineError),
    Single("warmup_drift", WarmupDrift),
    Single("linear_drift", LinearDrift),
    Single("step_between_runs", StepBetweenRuns),
    Single("bad_run", BadRun),
    Single("disturbed_readings", DisturbedReadings),
    PerAxis("settling", Settling),
    NoiseClasses(),
    SixDofEffects(),
)

#: Every family by its name; plug-ins add to it.
FAMILIES: dict[str, Family] = {family.name: family for family in _BUILT_IN}


def catalogue(stations: Sequence[str] = ()) -> dict[str, Effect]:
    """Return every effect by its name; those of single stations for ``stations``."""
    members = [effect for family in FAMILIES.values() for effect in family.members(stations)]
    return {effect.card.name: effect for effect in members}


def listed() -> dict[str, Effect]:
    """Return the catalogue for a list: effects of stations stand there once, as ``..._<station>``."""
    return catalogue((ANY_STATION,))
