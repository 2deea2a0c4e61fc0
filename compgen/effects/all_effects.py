"""The catalogue of effects: all families, advice, and which effects readings can separate.

:func:`catalogue` lists the effects, :func:`what_to_do` gives the remedy for each, and :func:`visible_parts` what a set
of readings shows of each effect in addition to the geometric errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.effects.axes import (
    Backlash,
    BadRun,
    CosineError,
    DisturbedReadings,
    LinearDrift,
    LostMotion,
    Periodic,
    ServoLag,
    Settling,
    SpindleGrowth,
    StepBetweenRuns,
    ThermalScale,
    WarmupDrift,
)
from compgen.effects.base import (
    ANY_STATION,
    AllStations,
    Card,
    Effect,
    Family,
    PerAxis,
    PerName,
    PerStation,
    Single,
)
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
from compgen.effects.readings import Readings
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
from compgen.registry import Registry

# Effects that show in the noise of the readings, not in their mean: found by tests of the residuals, no columns.


class NoiseClass(Effect):
    """A class of noise; it has a card but no columns."""

    def __init__(self, card: Card) -> None:
        self.card = card

    def columns(self, readings: Readings) -> FloatArray | None:
        """None: there is no mean to fit."""
        return None


def _card(name: str, title: str, equation: str, covariates: tuple[str, ...], breaker: str) -> Card:
    source = "tests of whitened residuals: docs/effects.md"
    return Card(name, title, equation, source, covariates, (), ("every weak effect",), breaker, ("noise",))


def noise_cards() -> list[Card]:
    """Cards of the noise classes."""
    cards = [
        _card(
            "outliers", "Gross errors of single readings", "readings far outside the rest", (), "measure these again"
        ),
        _card(
            "variance_trend",
            "Noise that changes with time, range or position",
            "sigma depends on a covariate",
            ("time_s",),
            "repeat lines at the beginning and at the end",
        ),
        _card(
            "autocorrelated_noise",
            "Noise that is correlated between neighbouring readings",
            "autocorrelated noise (random walk, drift of the air)",
            ("time_s", "repeat"),
            "measure every line at least twice, in random order",
        ),
        _card(
            "quantisation",
            "Coarse resolution of the readings",
            "readings are multiples of a step",
            (),
            "log more decimals",
        ),
        _card(
            "axis_mapping",
            "Swapped axes, signs or stations",
            "columns of the file exchanged or of the other sign",
            (),
            "check the file: residuals are millimetres, not micrometres",
        ),
    ]
    stick_slip = [
        _card(
            f"stick_slip_{letter}",
            f"Stick-slip of {letter}",
            f"d_{letter} jumps by steps of one size at random after reversals",
            (f"approach_{letter.lower()}",),
            "approach every target slowly and fast, several times each",
        )
        for letter in AXES
    ]
    return cards + stick_slip


class ListedEffects(Family):
    """Listed effects without columns: noise classes, and what shows only in the signals of an instrument."""

    def __init__(self, name: str, cards: Sequence[Card]) -> None:
        self.name, self._cards = name, tuple(cards)

    def members(self, stations: object) -> list[Effect]:
        """One effect per card."""
        return [NoiseClass(card) for card in self._cards]


# The registry of the catalogue: every family of effects, in listing order.


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

#: Every family by name; plug-ins add to it.
FAMILIES: Registry[Family] = Registry({family.name: family for family in _BUILT_IN})


def catalogue(stations: Sequence[str] = ()) -> dict[str, Effect]:
    """Return every effect by name; effects of single stations for ``stations``."""
    members = [effect for family in FAMILIES.values() for effect in family.members(stations)]
    return {effect.card.name: effect for effect in members}


def listed() -> dict[str, Effect]:
    """Return the catalogue for a list: effects of stations appear once, as ``..._<station>``."""
    return catalogue((ANY_STATION,))


# Requirements on a plug-in's family of effects, checked when it is registered.


def check_family(name: str, thing: Any) -> tuple[Any, list[str]]:
    """Check a family, or its class: its members must be effects with complete cards and unused names."""
    family = thing() if isinstance(thing, type) and issubclass(thing, Family) else thing
    if not isinstance(family, Family):
        return thing, [f"{type(thing).__name__} is not a compgen.effects.Family"]
    try:
        members = list(family.members((ANY_STATION,)))
    except Exception as error:  # third-party code
        return family, [f"its members cannot be listed: {type(error).__name__}: {error}"]
    taken = set(listed())
    problems = [] if members else ["it has no members"]
    for effect in members:
        card = getattr(effect, "card", None)
        if not isinstance(effect, Effect):
            problems.append(f"{type(effect).__name__} is not a compgen.effects.Effect")
        elif not isinstance(card, Card):
            problems.append(f"{type(effect).__name__} has no card")
        else:
            lacking = [key for key in ("name", "title", "equation", "source", "parameters") if not getattr(card, key)]
            problems += [f"the name {card.name!r} is already used"] if card.name in taken else []
            problems += [f"the card of {card.name!r} lacks {', '.join(lacking)}"] if lacking else []
            if card.scan and card.scan not in {setting.name for setting in card.settings}:
                problems.append(f"the card of {card.name!r} scans {card.scan!r}, which is not one of its settings")
    return family, problems


# What to do about each effect of the catalogue: one sentence for the machine operator.


#: By family: the name of the effect without the axis, station or error at its end.
WHAT_TO_DO = {
    "thermal_scale": "set the control's temperature compensation of this axis to this coefficient, fixed point and "
    "reference temperature, or let the axis reach its working temperature before the test; the tables do not follow it",
    "spindle_growth": "warm up the spindle at working speed before measuring, or use the control's compensation of spindle "
    "growth with this coefficient",
    "column_bending": "shield the column from draught and sun, or run it warm before measuring; compensate by the "
    "difference of two temperatures of the column if the control can",
    "backlash": "enter the reversal value (twice c) as the control's backlash compensation of this axis, or export tables "
    "with reversal; check nut, preload, coupling and thrust bearing if it has grown",
    "lost_motion": "a single backlash value cannot correct it: export tables for each direction; look for a worn stretch of the "
    "screw, wind-up of a long screw and sticking guides, and measure again after lubrication",
    "periodic": "use table positions at a fraction of the pitch, or the control's periodic compensation; check screw run-out, "
    "coupling and scale mounting, and measure one pitch in steps of a tenth",
    "servo_lag": "adjust loop gain (KV) or velocity feed-forward, or dwell before each reading; tables cannot correct it",
    "lever": "add this angular error to the model in the machine file, measure with a second tool offset, and export it",
    "squareness": "add this squareness error to the model in the machine file, and export it; check the alignment of the guides "
    "if it is new",
    "beam_sag": "measure more sections along the beam, and let the tables follow two axes; check the balance of the carriage",
    "ram_droop": "export tables over both axes, and measure with the heaviest tool; check the counterbalance",
    "load_deflection": "measure with the load of the workpieces, and keep one set of tables for each class of load",
    "refractive_index": "log air temperature, pressure and humidity next to the beam and switch the wavelength compensation on",
    "dead_path": "zero the interferometer close to the reflector's nearest point, or enter the dead path into its software",
    "laser_scale": "check wavelength and material compensation of the interferometer against a calibrated length",
    "station_drift": "let the tracer warm up, clamp it on the table and not on a tripod, and return to one reference point "
    "every few minutes",
    "length_step": "find the broken beam in the log, and measure these lines again with a reference point before and after",
    "machine_jump": "look for a bump, a clamp or a table that slipped at this time, and repeat the measurements after it",
    "tracer_runout": "have the centring of the tracer's sphere checked, or turn its head by 180 degrees and take the mean",
    "target_angle": "point the reflector at the station, or use one with a wider angle, and measure the far lines again",
    "tool_offset_error": "measure the length and the offset of the target again and enter them; a third offset shows which is "
    "wrong",
    "sign": "check sign and lever arm of this error in the machine file and in the source of the tables before any export",
    "cosine_error": "align the beam with the axis again",
    "warmup_drift": "repeat the test after a warm-up of three time constants with the axis moving and the sensor switched on; "
    "a stationary test (axis at rest, then sensor warm) shows which of the two warms up",
    "linear_drift": "log the temperatures of scale, workpiece and air, and repeat the test in a longer session: a warm-up "
    "levels off, a drift of sensor or room continues",
    "step_between_runs": "look for what happened between these runs (zero set again, bumped sensor or optics, a slipped "
    "clamp, an axis that was homed), fix the sensor, and repeat the runs on one side of the step",
    "bad_run": "leave this run out and measure it again; check what was different (first run after a stop, door open, "
    "another feed, a beam that was cut)",
    "disturbed_readings": "leave these readings out or measure them again; look for draught, vibration or people at that time",
    "settling": "raise the dwell at each target to five time constants before reading; if the effect remains, check "
    "integral gain and friction of the axis",
    "outliers": "measure these readings again; they are left out of everything else",
    "variance_trend": "find the source of the growing noise (draught, vibration, a laser that warms up), and repeat a few lines "
    "at the beginning and at the end",
    "autocorrelated_noise": "take repeats far apart in time and in random order; shield the beam from draught",
    "quantisation": "log more decimals",
    "axis_mapping": "correct columns or signs in the file, and confirm by a small move of one axis before any export",
    "stick_slip": "lubricate the guide, check its preload and the friction compensation of the control, and approach each "
    "target slowly and fast",
    "crosstalk_yaw": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "crosstalk_pitch": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "beam_drift": "let the laser warm up, shield its beam, and measure forth and back three times",
    "detector_gain": "have the gain of this detector calibrated and entered into the instrument's file",
    "nonparallel_beams": "have the instrument's beams adjusted, or enter their angle into its file",
    "distance_offset": "enter the distance of the target's points into the instrument's file",
}


#: Effects of the instrument as it was set up, and events of one session; all others belong to the machine.
OF_SETUP = (
    "refractive_index", "dead_path", "laser_scale", "tracer_runout", "target_angle", "tool_offset_error", "sign",
    "crosstalk", "detector_gain", "nonparallel_beams", "distance_offset",
)  # fmt: skip
OF_SESSION = (
    "station_drift", "length_step", "machine_jump", "warmup_drift", "linear_drift", "step_between_runs", "bad_run",
    "disturbed_readings", "radius_drift", "radius_level", "outliers", "variance_trend", "autocorrelated_noise", "quantisation",
    "axis_mapping", "beam_drift",
)  # fmt: skip


def belongs_to(name: str) -> str:
    """What an effect belongs to: "machine" (kept), "setup" (of the instrument), or "session" (these readings only).

    >>> belongs_to("backlash_X"), belongs_to("tool_offset_error"), belongs_to("length_step_T1")
    ('machine', 'setup', 'session')
    """
    return "setup" if name.startswith(OF_SETUP) else "session" if name.startswith(OF_SESSION) else "machine"


def what_to_do(card: Card) -> str:
    """Return what to do about an effect; for a plug-in's effect without such a sentence, what to measure next."""
    name = card.name
    while name:
        if name in WHAT_TO_DO:
            return WHAT_TO_DO[name]
        name = name.rpartition("_")[0]
    return f"measure next: {card.breaker}" if card.breaker else "measure again, every line at least twice"


# What a set of readings shows of each effect: the part that errors, stations and dead lengths cannot imitate.
#
# For the base Jacobian J and the columns G of an effect, the visible part is (I - Q Q') G with Q an orthonormal basis of J
# (Frisch-Waugh-Lovell). All follows from the Gram matrix of [J, G1, G2, ...], which can be summed over blocks of data.


#: Eigenvalue of a Gram matrix with unit diagonal below which a direction counts as absent.
ZERO = 1e-10
#: Visible fraction of a direction, squared, below which it is excluded from comparisons.
SEEN = 1e-4
#: An effect whose visible fraction is below this cannot be confirmed.
INVISIBLE = 0.05
#: Canonical correlation above which two effects cannot be told apart in practice.
ALIKE = 0.9


@dataclass(frozen=True)
class VisiblePart:
    """Visible part of one effect.

    Parameters
    ----------
    fraction : root mean square over its directions of the fraction left after projection, 0 ... 1.
    least, most : fraction of the least and of the most visible direction.
    basis : orthonormal visible directions in terms of all effect columns, (columns, r).
    """

    fraction: float
    least: float
    most: float
    basis: FloatArray


@dataclass(frozen=True)
class Pair:
    """Two similar effects: largest canonical correlation, number of directions above 0.9, number of directions."""

    names: tuple[str, str]
    correlation: float
    shared: int
    directions: int


def projected_gram(gram: FloatArray, base: int) -> FloatArray:
    """Gram matrix of the effects' columns minus what the first ``base`` columns can imitate."""
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
    """Return the pairs of visible effects with a canonical correlation above 0.9, the most similar first."""
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
    """The smallest additional measurement that separates two effects, from the card that names the other one."""
    for card, other in ((first, second), (second, first)):
        if any(other.name.startswith(alias) for alias in card.aliases) and card.breaker:
            return card.breaker
    return first.breaker or second.breaker
