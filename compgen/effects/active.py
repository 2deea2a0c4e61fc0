"""The effects enabled in a machine file: ``[effects.NAME]`` with parameters and settings by name.

    [effects.backlash_X]
    c_um = 4.1
    [effects.spindle_growth_Z]
    c_um_per_k = 2.7
    reference_c = 21.5

:func:`active_effects` reads the sections; :func:`effects_reversal` returns what tables can contain of the effects,
:func:`advice_of_effects` what they cannot.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ReversalCurves
from compgen.data.machine import Machine
from compgen.effects.all_effects import catalogue, listed
from compgen.effects.axes import Backlash, LostMotion, Periodic
from compgen.effects.base import ANY_STATION, DisplacementEffect, Effect
from compgen.effects.optics import DeadPath
from compgen.effects.readings import Readings, legendre
from compgen.errors import nearest

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
        """What the effect adds to each reading, (n,), mm; None if the readings lack a covariate."""
        columns = self.effect.columns(readings)
        return None if columns is None else columns @ self.values

    def displacement_mm(self, readings: Readings) -> FloatArray | None:
        """Displacement of the tip by the effect, (n, 3), mm; None if it does not move the tip or lacks a covariate."""
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
        with file, line and key, for an effect, a parameter or a setting that is unknown or missing.
    """
    if not machine.effects:
        return ()
    dead_path = machine.effects.get("dead_path")
    of_dead_path = [] if dead_path is None else dead_path_stations(dead_path.data)
    of_names = [match.group(1) for name in machine.effects if (match := STATION_NAME.fullmatch(name))]
    known = catalogue(tuple(dict.fromkeys([*of_names, *of_dead_path])))
    if dead_path is not None:
        known["dead_path"] = DeadPath(tuple(of_dead_path) or (ANY_STATION,))
    return tuple(_read(machine, known, name, section) for name, section in machine.effects.items())


def dead_path_stations(keys: Iterable[str]) -> list[str]:
    """Return the station names in the parameters of a dead path."""
    return [match.group(1) for key in keys if (match := _DEAD_PATH_KEY.fullmatch(key))]


def _read(machine: Machine, known: dict[str, Effect], name: str, raw: toml_files.Section) -> ActiveEffect:
    section = raw.again()
    effect = known.get(name)
    if effect is None or not effect.card.parameters:
        names = [other for other, one in {**listed(), **known}.items() if one.card.parameters]
        message = (
            f"unknown effect {name!r}; {nearest(name, names)}; volcomp effects lists all"
            if effect is None
            else f"{name} has no parameters, so it cannot be switched on; it is found in residuals"
        )
        raise section.fail("", message, kind="unknown")
    effect, values = read_values(effect, section)
    if isinstance(effect, Periodic) and effect.pitch_mm(machine) is None:
        raise section.fail("pitch_mm", "is missing, and the machine file has no screw_pitch_mm for this axis")
    section.finish()
    return ActiveEffect(effect, values)


@toml_files.accepts({"type": "integer", "minimum": 1, "maximum": 12})
def _degree(value: Any) -> int:
    return toml_files.whole(1, 12)(int(value) if isinstance(value, float) and value.is_integer() else value)


#: Checks of settings that accept only some numbers.
_SETTING_CHECKS: Mapping[str, Callable[[Any], float]] = {"degree": _degree}


def keys_schema(effect: Effect, **more: toml_files.Schema) -> dict[str, Any]:
    """Return the JSON schema of a section with the parameters and settings of an effect, and ``more`` properties."""
    number, card = toml_files.accepted(toml_files.number), effect.card
    parameters = {item.name: {**number, "description": item.meaning} for item in card.parameters}
    named = {name: schema for name, schema in parameters.items() if ANY_STATION not in name}
    patterns = {station_pattern(name): schema for name, schema in parameters.items() if name not in named}
    settings = {
        item.name: {
            **toml_files.accepted(_SETTING_CHECKS.get(item.name, toml_files.number)),
            "description": item.meaning,
        }
        for item in card.settings
    }
    schema = toml_files.section_schema(**more, **named, **settings)
    schema["required"] = [*more, *(item.name for item in card.settings if item.needed)]
    if patterns:
        return {**schema, "patternProperties": patterns}
    return {**schema, "anyOf": [{"required": [name]} for name in named]}


def station_pattern(name: str) -> str:
    """Return the regular expression of a name in which :data:`ANY_STATION` is the name of a station."""
    return "^" + re.escape(name).replace(re.escape(ANY_STATION), ".+") + "$"


def effects_schema() -> dict[str, Any]:
    """Return the JSON schema of the ``[effects.NAME]`` sections of a machine file."""
    known = {name: keys_schema(effect) for name, effect in listed().items() if effect.card.parameters}
    of_stations = {station_pattern(name): schema for name, schema in known.items() if ANY_STATION in name}
    plain = {name: schema for name, schema in known.items() if ANY_STATION not in name}
    return {**toml_files.table_schema(plain), "patternProperties": of_stations}


def read_values(effect: Effect, section: toml_files.Section) -> tuple[Effect, FloatArray]:
    """Read settings and parameters of an effect from a section; return it with its settings, and the values in SI.

    Parameters that are not given are zero; at least one must be given.
    """
    settings: dict[str, float] = {}
    for setting in effect.card.settings:
        value = section.take(setting.name, _SETTING_CHECKS.get(setting.name, toml_files.number), None)
        if value is not None:
            settings[setting.name] = float(value)
        elif setting.needed:
            raise section.fail(setting.name, f"is missing: {setting.meaning}", kind="missing", instead=1.0)
    effect = effect.with_settings(settings)
    names = [parameter.name for parameter in effect.card.parameters]
    if not any(name in section.data for name in names):
        given = [key for key in section.data if key not in {setting.name for setting in effect.card.settings}]
        if given:
            raise section.fail(given[0], f"is not a known key; {nearest(given[0], names)}", kind="unknown")
        raise section.fail(
            names[0], f"is missing; expected at least one of {', '.join(names)}", kind="missing", instead=1.0
        )
    values = [section.take(p.name, toml_files.number, 0.0) * p.si_per_unit for p in effect.card.parameters]
    return effect, np.array(values)


def displacement_of(effects: Sequence[ActiveEffect], readings: Readings) -> tuple[FloatArray, list[str]]:
    """Return the displacement of the tip by effects, (n, 3), mm, and the names of effects that lack a covariate."""
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

    Settings that follow from the readings (the mean temperature) are written too: the section then means the same for
    other readings.
    """
    name = effect.card.name
    quoted = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'
    lines = [f"[effects.{quoted}]"]
    for parameter, value in zip(effect.card.parameters, values, strict=True):
        key = parameter.name if re.fullmatch(r"[A-Za-z0-9_-]+", parameter.name) else f'"{parameter.name}"'
        lines.append(f"{key} = {float(value / parameter.si_per_unit):.9g}")
    lines += [f"{key} = {float(value)!r}" for key, value in effect.used(readings).items()]
    return "\n".join(lines) + "\n"


# What a control can compensate of the effects of a machine file: reversal in tables, the rest as advice.


#: Positions of a reversal that varies along the travel.
POSITIONS = 21

ADVICE = {
    "thermal_scale": "the scale of the axis grows with its temperature: set the control's temperature compensation of "
    "this axis to this coefficient, fixed point and reference temperature; the tables do not follow the temperature",
    "periodic": "the error repeats with the pitch: use the control's periodic (encoder, torque-ripple) compensation, or "
    "table positions at a fraction of the pitch; tables with wide positions do not change it",
    "spindle_growth": "the tool grows with the temperature of the spindle: warm up the spindle, or use the control's "
    "spindle growth compensation",
    "servo_lag": "the axis lags behind its command: adjust loop gain or feed-forward; tables cannot correct it",
}


def effects_reversal(machine: Machine, only: Container[str] | None = None) -> ReversalCurves | None:
    """Return the reversal due to the backlash and lost motion of a machine file; None if it has neither.

    ``only`` selects effects by name. The effects move the tip by c dir; the reversal value of ISO 230-2 is the
    difference between the two directions, 2 c.
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
    """Sum of two curves at the positions of both; a curve with one position is constant."""
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
    """Return a reversal found in readings plus those effects of the machine file that were ``taken_out``."""
    own = effects_reversal(machine, taken_out)
    if own is None or found is None:
        return found or own
    curves = dict(own.curves)
    for key, curve in found.curves.items():
        curves[key] = added(curves.get(key), curve)
    return ReversalCurves(curves, {**own.metadata, **found.metadata})


def advice_of_effects(machine: Machine) -> list[str]:
    """Return what the user has to set for effects of the machine file that no table covers, one sentence each."""
    found = []
    for active in active_effects(machine):
        if isinstance(active.effect, Backlash | LostMotion):
            continue
        figures = ", ".join(f"{key} = {value:g}" for key, value in active.summary().items())
        advice = ADVICE.get(active.name.rpartition("_")[0], "no table of this control corrects it")
        found.append(f"{active.effect.card.title} ({active.name}: {figures}): {advice}")
    return found
