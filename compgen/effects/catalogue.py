"""The catalogue of effects: every family, the effects of a machine file, advice, and which effects readings can tell apart.

:func:`catalogue` lists the effects, :func:`active_effects` reads the ``[effects.NAME]`` sections of a machine file,
:func:`effects_reversal` and :func:`advice_of_effects` say what of them tables can hold and what not, and
:func:`visible_parts` what a set of readings shows of each effect beside the geometric errors.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.messages import nearest
from compgen.effects.axes import Backlash, CosineError, LostMotion, Periodic, ServoLag, SpindleGrowth, ThermalScale
from compgen.effects.axis_session import BadRun, DisturbedReadings, LinearDrift, Settling, StepBetweenRuns, WarmupDrift
from compgen.effects.base import (
    ANY_STATION,
    AllStations,
    Card,
    DisplacementEffect,
    Effect,
    Family,
    PerAxis,
    PerName,
    PerStation,
    Single,
)
from compgen.effects.noise import ListedEffects, noise_cards
from compgen.effects.optics import (
    DeadPath,
    LaserScale,
    LengthStep,
    RefractiveIndex,
    StationDrift,
    TargetAngle,
    TracerRunout,
    sixdof_cards,
)
from compgen.effects.readings import Readings, legendre
from compgen.effects.structure import (
    ANGULAR_NAMES,
    BeamSag,
    ColumnBending,
    Lever,
    LoadDeflection,
    MachineJump,
    RamDroop,
    SignError,
    Squareness,
    ToolOffsetError,
)
from compgen.errors import InputError

# The registry of the catalogue: every family of effects in the order in which it is listed.


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
    ListedEffects("noise", noise_cards()),
    ListedEffects("sixdof", sixdof_cards()),
)

#: Every family by its name; plug-ins add to it.
FAMILIES: dict[str, Family] = {family.name: family for family in _BUILT_IN}


def catalogue(stations: Sequence[str] = ()) -> dict[str, Effect]:
    """Return every effect by its name; those of single stations for ``stations``."""
    members = [effect for family in FAMILIES.values() for effect in family.members(stations)]
    return {effect.card.name: effect for effect in members}


def listed() -> dict[str, Effect]:
    """Return the catalogue for a list: effects of stations appear once, as ``..._<station>``."""
    return catalogue((ANY_STATION,))


# What a family of effects of a plug-in must be; said when it is registered.


def check_family(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A family, or its class: its members are effects with complete cards, whose names are free."""
    family = thing() if isinstance(thing, type) and issubclass(thing, Family) else thing
    if not isinstance(family, Family):
        return thing, [f"{type(thing).__name__} is not a compgen.effects.Family"]
    try:
        members = list(family.members((ANY_STATION,)))
    except Exception as error:  # code of others
        return family, [f"its members cannot be listed: {type(error).__name__}: {error}"]
    taken = set(catalogue((ANY_STATION,)))
    problems = [] if members else ["it has no members"]
    for effect in members:
        problems += _effect_problems(effect, taken)
    return family, problems


def _effect_problems(effect: Any, taken: set[str]) -> list[str]:
    if not isinstance(effect, Effect):
        return [f"{type(effect).__name__} is not a compgen.effects.Effect"]
    card = getattr(effect, "card", None)
    if not isinstance(card, Card):
        return [f"{type(effect).__name__} has no card"]
    problems = [f"the name {card.name!r} is taken"] if card.name in taken else []
    lacking = [key for key in ("name", "title", "equation", "source", "parameters") if not getattr(card, key)]
    problems += [f"the card of {card.name!r} lacks {', '.join(lacking)}"] if lacking else []
    if card.scan and card.scan not in {setting.name for setting in card.settings}:
        problems.append(f"the card of {card.name!r} scans {card.scan!r}, which is none of its settings")
    return problems


# Effects that a machine file switches on: ``[effects.NAME]`` with parameters and settings by name.
#
# [effects.backlash_X]
# c_um = 4.1
# [effects.spindle_growth_Z]
# c_um_per_k = 2.7
# reference_c = 21.5


#: The names of stations in the names of effects and of their parameters.
STATION_NAME = re.compile(r"(?:station_drift|length_step|tracer_runout)_(.+)")
_DEAD_PATH_KEY = re.compile(r"c_(.+)_um_per_k")


@dataclass(frozen=True)
class ActiveEffect:
    """An effect with its settings, and its parameters in SI units (mm, rad, s, K, kg), (k,)."""

    effect: Effect
    values: FloatArray

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.card.name

    def change_mm(self, readings: Readings) -> FloatArray | None:
        """What the effect adds to each reading, (n,), mm; None where the readings lack a covariate."""
        columns = self.effect.columns(readings)
        return None if columns is None else columns @ self.values

    def displacement_mm(self, readings: Readings) -> FloatArray | None:
        """How the effect moves the tip, (n, 3), mm; None if it does not, or where a covariate is missing."""
        if not isinstance(self.effect, DisplacementEffect):
            return None
        moved = self.effect.displacement(readings)
        return None if moved is None else moved @ self.values

    def summary(self) -> dict[str, Any]:
        """Parameters in the units of their names, and settings."""
        parameters = self.effect.card.parameters
        return {
            **{p.name: float(v / p.si_per_unit) for p, v in zip(parameters, self.values, strict=True)},
            **dict(self.effect.settings),
        }


def active_effects(machine: Machine) -> tuple[ActiveEffect, ...]:
    """Read the ``[effects.NAME]`` sections of a machine file.

    Raises
    ------
    InputError
        with file, line and key for an effect, a parameter or a setting that is not known, or that is missing.
    """
    dead_path = machine.effects.get("dead_path")
    of_dead_path = [] if dead_path is None else dead_path_stations(dead_path.data)
    of_names = [match.group(1) for name in machine.effects if (match := STATION_NAME.fullmatch(name))]
    known = catalogue(tuple(dict.fromkeys([*of_names, *of_dead_path])))
    if dead_path is not None:
        known["dead_path"] = DeadPath(tuple(of_dead_path) or (ANY_STATION,))
    return tuple(_read(machine, known, name, section) for name, section in machine.effects.items())


def dead_path_stations(keys: Iterable[str]) -> list[str]:
    """Return the names of the stations in the parameters of a dead path."""
    return [match.group(1) for key in keys if (match := _DEAD_PATH_KEY.fullmatch(key))]


def _read(machine: Machine, known: dict[str, Effect], name: str, raw: toml_files.Section) -> ActiveEffect:
    section = toml_files.Section(raw.data, path=raw.path, text=raw.text, name=raw.name)
    effect = known.get(name)
    if effect is None or not effect.card.parameters:
        names = [other for other, one in {**catalogue((ANY_STATION,)), **known}.items() if one.card.parameters]
        message = (
            f"unknown effect {name!r}; {nearest(name, names)}; volcomp effects lists all"
            if effect is None
            else f"{name} has no parameters, so it cannot be switched on; it is found in residuals"
        )
        raise InputError(message, file=raw.path, line=raw.fail("", "").line, field=f"[{raw.name}]")
    effect, values = read_values(effect, section)
    if isinstance(effect, Periodic) and effect.pitch_mm(machine) is None:
        raise section.fail("pitch_mm", "is missing, and the machine file has no screw_pitch_mm for this axis")
    section.finish()
    return ActiveEffect(effect, values)


def read_values(effect: Effect, section: toml_files.Section) -> tuple[Effect, FloatArray]:
    """Take settings and parameters of an effect from a section; return it with its settings, and the values in SI.

    Parameters that are not given are zero, but one has to be.
    """
    settings: dict[str, float] = {}
    for setting in effect.card.settings:
        value = section.take(setting.name, _degree if setting.name == "degree" else toml_files.number, None)
        if value is not None:
            settings[setting.name] = float(value)
        elif setting.needed:
            raise section.fail(setting.name, f"is missing: {setting.meaning}")
    effect = effect.with_settings(settings)
    names = [parameter.name for parameter in effect.card.parameters]
    if not any(name in section.data for name in names):
        given = [key for key in section.data if key not in {setting.name for setting in effect.card.settings}]
        if given:
            raise section.fail(given[0], f"is not a known key; {nearest(given[0], names)}")
        raise section.fail(names[0], f"is missing; expected at least one of {', '.join(names)}")
    values = [section.take(p.name, toml_files.number, 0.0) * p.si_per_unit for p in effect.card.parameters]
    return effect, np.array(values)


def _degree(value: Any) -> int:
    return toml_files.whole(1, 12)(int(value) if isinstance(value, float) and value.is_integer() else value)


def displacement_of(effects: Sequence[ActiveEffect], readings: Readings) -> tuple[FloatArray, list[str]]:
    """Return how effects move the tip, (n, 3), mm, and the names of those for which the readings lack a covariate."""
    total, missing = np.zeros((len(readings), 3)), []
    for active in effects:
        moved = active.displacement_mm(readings)
        if moved is not None:
            total += moved
        elif isinstance(active.effect, DisplacementEffect):
            missing.append(active.name)
    return total, missing


def section_text(effect: Effect, readings: Readings, values: FloatArray) -> str:
    """Return the ``[effects.NAME]`` section of a machine file for parameters in SI units (k,).

    Settings that follow from the readings (the mean temperature) are written with them, so that the section means the
    same for other readings.
    """
    name = effect.card.name
    quoted = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'
    lines = [f"[effects.{quoted}]"]
    for parameter, value in zip(effect.card.parameters, values, strict=True):
        key = parameter.name if re.fullmatch(r"[A-Za-z0-9_-]+", parameter.name) else f'"{parameter.name}"'
        lines.append(f"{key} = {float(value / parameter.si_per_unit):.9g}")
    lines += [f"{key} = {float(value)!r}" for key, value in effect.used(readings).items()]
    return "\n".join(lines) + "\n"


# What a control can carry of the effects of a machine file: reversal in tables, the rest as advice.


#: Positions of a reversal that varies along the stroke.
POSITIONS = 21

ADVICE = {
    "thermal_scale": "the scale of the axis grows with its temperature: set the control's temperature compensation of "
    "this axis to this coefficient, fixed point and reference temperature; the tables do not follow the temperature",
    "periodic": "the error repeats with the pitch: use the control's periodic (encoder, torque-ripple) compensation, or "
    "table positions at a fraction of the pitch; tables with wide positions leave it as it is",
    "spindle_growth": "the tool grows with the temperature of the spindle: warm the spindle up, or use the control's "
    "spindle growth compensation",
    "servo_lag": "the axis lags by a time: adapt loop gain or feed-forward; tables cannot hold it",
}


def effects_reversal(machine: Machine, only: Container[str] | None = None) -> ReversalCurves | None:
    """Return the reversal of the backlash and lost motion of a machine file; None if it has neither.

    ``only`` takes effects of some names. The effects move the tip by c dir; the reversal value of ISO 230-2 is the
    difference of both directions, 2 c.
    """
    curves: dict[tuple[int, int], Curve] = {}
    for active in active_effects(machine):
        if isinstance(active.effect, Backlash | LostMotion) and (only is None or active.name in only):
            axis = active.effect.axis
            key = (axis, axis)
            curves[key] = added(curves.get(key), _curve(machine, active))
    return (
        ReversalCurves(curves, {"machine": machine.name, "source": "effects of the machine file"}) if curves else None
    )


def _curve(machine: Machine, active: ActiveEffect) -> Curve:
    if isinstance(active.effect, Backlash):
        return Curve(np.zeros(1), 2.0 * active.values, np.full(1, np.nan))
    assert isinstance(active.effect, LostMotion)
    low, high = machine.axes[active.effect.axis].range_mm
    s = np.linspace(-1.0, 1.0, POSITIONS)
    value = 2.0 * legendre(s, range(1, 3)) @ active.values
    return Curve(0.5 * (low + high) + 0.5 * (high - low) * s, value, np.full(POSITIONS, np.nan))


def added(first: Curve | None, second: Curve) -> Curve:
    """Sum of two curves at the positions of both; a curve of one position is constant."""
    if first is None:
        return second
    many = [curve.position_mm for curve in (first, second) if len(curve.position_mm) > 1]
    position_mm = np.unique(np.concatenate(many)) if many else first.position_mm
    value = first.at(position_mm) + second.at(position_mm)
    u = np.hypot(np.nan_to_num(_u_at(first, position_mm)), np.nan_to_num(_u_at(second, position_mm)))
    return Curve(position_mm, value, np.where(u > 0, u, np.nan))


def _u_at(curve: Curve, position_mm: FloatArray) -> FloatArray:
    return np.interp(position_mm, curve.position_mm, curve.u)


def with_effects_reversal(
    machine: Machine, found: ReversalCurves | None, taken_out: Container[str]
) -> ReversalCurves | None:
    """Return a reversal found in readings together with those effects of the machine file that were ``taken_out``."""
    own = effects_reversal(machine, taken_out)
    if own is None or found is None:
        return found or own
    curves = dict(own.curves)
    for key, curve in found.curves.items():
        curves[key] = added(curves.get(key), curve)
    return ReversalCurves(curves, {**own.metadata, **found.metadata})


def advice_of_effects(machine: Machine) -> list[str]:
    """Return what the user has to set for effects of the machine file that no table holds, one sentence each."""
    found = []
    for active in active_effects(machine):
        if isinstance(active.effect, Backlash | LostMotion):
            continue
        figures = ", ".join(f"{key} = {value:g}" for key, value in active.summary().items())
        advice = ADVICE.get(active.name.rpartition("_")[0], "no table of this control holds it")
        found.append(f"{active.effect.card.title} ({active.name}: {figures}): {advice}")
    return found


# What to do about each effect of the catalogue, a sentence for the one who stands at the machine.


#: By family: the name of the effect without the axis, station or error at its end.
WHAT_TO_DO = {
    "thermal_scale": "set the control's temperature compensation of this axis to this coefficient, fixed point and "
    "reference temperature, or let the axis reach its working temperature before the test; the tables do not follow it",
    "spindle_growth": "warm the spindle up at working speed before measuring, or use the control's compensation of spindle "
    "growth with this coefficient",
    "column_bending": "shield the column from draught and sun, or run it warm before measuring; compensate by the "
    "difference of two temperatures of the column if the control can",
    "backlash": "enter the reversal value (twice c) as the control's backlash compensation of this axis, or export tables "
    "with reversal; look at nut, preload, coupling and thrust bearing if it has grown",
    "lost_motion": "a single backlash value cannot hold it: export tables for each direction; look for a worn stretch of the "
    "screw, wind-up of a long screw and sticking guides, and measure again after lubrication",
    "periodic": "use table positions at a fraction of the pitch, or the control's periodic compensation; look at screw run-out, "
    "coupling and scale mounting, and measure one pitch in steps of a tenth",
    "servo_lag": "adapt loop gain (KV) or velocity feed-forward, or dwell before each reading; tables cannot hold it",
    "lever": "let the model of the machine file contain this angular error, measure with a second tool offset, and export it",
    "squareness": "let the model of the machine file contain this squareness and export it; check the alignment of the guides "
    "if it is new",
    "beam_sag": "measure more sections along the beam, and let the tables follow two axes; check the balance of the carriage",
    "ram_droop": "export tables over both axes, and measure with the heaviest tool; check the counterbalance",
    "load_deflection": "measure with the load of the workpieces, and keep one set of tables for each class of load",
    "refractive_index": "log air temperature, pressure and humidity beside the beam and switch the wavelength compensation on",
    "dead_path": "zero the interferometer close to the reflector's nearest point, or enter the dead path into its software",
    "laser_scale": "check wavelength and material compensation of the interferometer against a calibrated length",
    "station_drift": "let the tracer warm up, clamp it on the table and not on a tripod, and return to one reference point "
    "every few minutes",
    "length_step": "find the broken beam in the log, and measure these lines again with a reference point before and after",
    "machine_jump": "look for a bump, a clamp or a table that slipped at this time, and measure what came after it again",
    "tracer_runout": "have the centring of the tracer's sphere checked, or turn its head by 180 degrees and take the mean",
    "target_angle": "point the reflector at the station, or use one with a wider angle, and measure the far lines again",
    "tool_offset_error": "measure the length and the offset of the target again and enter them; a third offset shows which is "
    "wrong",
    "sign": "check sign and lever arm of this error in the machine file and in the source of the tables before any export",
    "cosine_error": "align the beam with the axis again",
    "warmup_drift": "repeat the test after a warm-up of three time constants with the axis moving and the sensor switched on; "
    "whether machine or sensor warms up shows a stationary test (axis at rest, then sensor warm)",
    "linear_drift": "log the temperatures of scale, workpiece and air, and repeat the test in a longer session: a warm-up "
    "levels off, a drift of sensor or room goes on",
    "step_between_runs": "look for what happened between these runs (zero set again, bumped sensor or optics, a slipped "
    "clamp, an axis that was homed), fix the sensor, and repeat the runs on one side of the step",
    "bad_run": "leave this run out and measure it again; look at what was different (first run after a stop, door open, "
    "another feed, a beam that was cut)",
    "disturbed_readings": "leave these readings out or measure them again; look for draught, vibration or people at that time",
    "settling": "raise the dwell at each target to five time constants before reading; if it stays, look at integral gain "
    "and friction of the axis",
    "outliers": "measure these readings again; they are left out of everything else",
    "variance_trend": "find what grew louder (draught, vibration, a warming laser), and repeat a few lines at the beginning "
    "and at the end",
    "autocorrelated_noise": "take repeats far apart in time and in random order; shield the beam from draught",
    "quantisation": "log more decimals",
    "axis_mapping": "correct columns or signs in the file, and confirm by a small move of one axis before any export",
    "stick_slip": "lubricate the guide, look at its preload and at the friction compensation of the control, and approach each "
    "target slowly and fast",
    "crosstalk_yaw": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "crosstalk_pitch": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "beam_drift": "let the laser warm up, shield its beam, and run forth and back three times",
    "detector_gain": "have the gain of this detector calibrated and entered into the instrument's file",
    "nonparallel_beams": "have the instrument's beams adjusted, or enter their angle into its file",
    "distance_offset": "enter the distance of the target's points into the instrument's file",
}


def what_to_do(card: Card) -> str:
    """Return what to do about an effect; for one of a plug-in without such a sentence, what to measure next."""
    name = card.name
    while name:
        if name in WHAT_TO_DO:
            return WHAT_TO_DO[name]
        name = name.rpartition("_")[0]
    return f"measure next: {card.breaker}" if card.breaker else "measure again, every line at least twice"


# What a set of readings can see of each effect: the part that errors, stations and dead lengths cannot imitate.
#
# For the base Jacobian J and the columns G of an effect, the visible part is (I - Q Q') G with Q an orthonormal basis of J
# (Frisch-Waugh-Lovell). Everything here follows from the Gram matrix of [J, G1, G2, ...], which can be summed up in pieces.


#: Eigenvalue of a Gram matrix with unit diagonal below which a direction counts as absent.
ZERO = 1e-10
#: Visible share of a direction, squared, below which it is left out of comparisons.
SEEN = 1e-4
#: An effect whose visible fraction is below this can not be confirmed.
INVISIBLE = 0.05
#: Canonical correlation above which two effects cannot be told apart in practice.
ALIKE = 0.9


@dataclass(frozen=True)
class VisiblePart:
    """Visible part of one effect.

    Parameters
    ----------
    fraction : root mean square over its directions of the share that is left after projection, 0 ... 1.
    least, most : share of the least and of the most visible direction.
    basis : orthonormal visible directions in terms of all columns of effects, (columns, r).
    """

    fraction: float
    least: float
    most: float
    basis: FloatArray


@dataclass(frozen=True)
class Pair:
    """Two effects that look alike: largest canonical correlation, and how many directions exceed 0.9 of how many."""

    names: tuple[str, str]
    correlation: float
    shared: int
    directions: int


def projected_gram(gram: FloatArray, base: int) -> FloatArray:
    """Gram matrix of the effects' columns less what the first ``base`` columns can imitate."""
    scale = np.sqrt(np.maximum(np.diagonal(gram), np.finfo(float).tiny))
    unit = gram / scale[:, None] / scale
    values, vectors = np.linalg.eigh(unit[:base, :base])
    kept = values > ZERO * max(float(values[-1]), 1.0) if base else np.zeros(0, dtype=bool)
    reach = (vectors[:, kept] / np.sqrt(values[kept])).T @ unit[:base, base:]
    return np.asarray((unit[base:, base:] - reach.T @ reach) * scale[base:, None] * scale[base:])


def visible_parts(gram: FloatArray, base: int, columns: Mapping[str, slice]) -> dict[str, VisiblePart]:
    """Return the visible part of each effect.

    Parameters
    ----------
    gram : Gram matrix of [J, G1, G2, ...], each reading divided by its standard uncertainty, (base + k, base + k).
    base : number of columns of J.
    columns : columns of each effect, counted from the first one after J.
    """
    seen = projected_gram(gram, base)
    return {name: _part(gram[base:, base:], seen, where) for name, where in columns.items()}


def _part(own: FloatArray, seen: FloatArray, where: slice) -> VisiblePart:
    block = own[where, where]
    scale = np.sqrt(np.maximum(np.diagonal(block), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(block / scale[:, None] / scale)
    kept = values > ZERO * values[-1]
    whole = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]  # orthonormal directions of the effect itself
    shares, turned = np.linalg.eigh(whole.T @ seen[where, where] @ whole)
    shares = np.clip(shares, 0.0, 1.0)
    good = shares > SEEN
    basis = np.zeros((len(own), int(good.sum())))
    basis[where] = (whole @ turned[:, good]) / np.sqrt(shares[good])
    return VisiblePart(float(np.sqrt(shares.mean())), float(np.sqrt(shares[0])), float(np.sqrt(shares[-1])), basis)


def alike_pairs(gram: FloatArray, base: int, parts: Mapping[str, VisiblePart]) -> list[Pair]:
    """Return the pairs of visible effects with a canonical correlation above 0.9, the most alike first."""
    seen = projected_gram(gram, base)
    names = [name for name, part in parts.items() if part.basis.shape[1]]
    found = []
    for k, first in enumerate(names):
        reach = seen @ parts[first].basis
        for second in names[k + 1 :]:
            correlations = np.linalg.svd(reach.T @ parts[second].basis, compute_uv=False)
            if correlations[0] > ALIKE:
                shared = int(np.count_nonzero(correlations > ALIKE))
                found.append(Pair((first, second), min(float(correlations[0]), 1.0), shared, len(correlations)))
    return sorted(found, key=lambda pair: -pair.correlation)


def separating(first: Card, second: Card) -> str:
    """The smallest further measurement that separates two effects, from the card that names the other one."""
    for card, other in ((first, second), (second, first)):
        if any(other.name.startswith(alias) for alias in card.aliases) and card.breaker:
            return card.breaker
    return first.breaker or second.breaker
