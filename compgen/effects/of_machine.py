"""Effects that a machine file switches on: ``[effects.NAME]`` with parameters and settings by name.

[effects.backlash_X]
c_um = 4.1
[effects.spindle_growth_Z]
c_um_per_k = 2.7
reference_c = 21.5
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.text import nearest
from compgen.effects.base import ANY_STATION, Card, DisplacementEffect, Effect
from compgen.effects.catalogue import catalogue
from compgen.effects.dead_path import DeadPath
from compgen.effects.periodic import Periodic
from compgen.effects.readings import Readings
from compgen.errors import InputError

#: The names of stations in the names of effects and of their parameters.
STATION_NAME = re.compile(r"(?:station_drift|length_step|tracer_runout)_(.+)")
DEAD_PATH_KEY = re.compile(r"c_(.+)_um_per_k")


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
    stations = _stations_of(machine)
    known = catalogue(stations)
    if "dead_path" in machine.effects:
        known["dead_path"] = DeadPath(tuple(_dead_path_stations(machine)) or (ANY_STATION,))
    return tuple(_read(machine, known, name, section) for name, section in machine.effects.items())


def _stations_of(machine: Machine) -> tuple[str, ...]:
    """Names of the stations in the names of effects and parameters."""
    found = [match.group(1) for name in machine.effects if (match := STATION_NAME.fullmatch(name))]
    return tuple(dict.fromkeys([*found, *_dead_path_stations(machine)]))


def _dead_path_stations(machine: Machine) -> list[str]:
    """Names of the stations in the parameters of the dead path."""
    dead_path = machine.effects.get("dead_path")
    keys = [] if dead_path is None else dead_path.data
    return [match.group(1) for key in keys if (match := DEAD_PATH_KEY.fullmatch(key))]


def _read(machine: Machine, known: dict[str, Effect], name: str, raw: tomlio.Section) -> ActiveEffect:
    section = tomlio.Section(raw.data, path=raw.path, text=raw.text, name=raw.name)
    if name not in known:
        names = [other for other, effect in {**catalogue((ANY_STATION,)), **known}.items() if effect.card.parameters]
        hint = nearest(name, names)
        raise InputError(
            f"{name!r} is no effect; {hint}; volcomp effects lists all",
            file=raw.path,
            line=_line(raw),
            field=f"[{raw.name}]",
        )
    effect = known[name]
    if not effect.card.parameters:
        message = f"{name} has no parameters, so it cannot be switched on; it is found in residuals"
        raise InputError(message, file=raw.path, line=_line(raw), field=f"[{raw.name}]")
    effect, values = read_values(effect, section)
    if isinstance(effect, Periodic) and effect.pitch_mm(machine) is None:
        raise section.fail("pitch_mm", "is missing, and the machine file has no screw_pitch_mm for this axis")
    section.finish()
    return ActiveEffect(effect, values)


def read_values(effect: Effect, section: tomlio.Section) -> tuple[Effect, FloatArray]:
    """Take settings and parameters of an effect from a section; return it with its settings, and the values in SI."""
    effect = _with_settings(effect, section)
    return effect, _parameters(effect.card, section)


def _line(section: tomlio.Section) -> int | None:
    """Line of the header of a section."""
    return section.fail("", "").line


def _with_settings(effect: Effect, section: tomlio.Section) -> Effect:
    settings: dict[str, float] = {}
    for setting in effect.card.settings:
        check = _degree if setting.name == "degree" else tomlio.number
        value = section.take(setting.name, check, None)
        if value is not None:
            settings[setting.name] = float(value)
        elif setting.needed:
            raise section.fail(setting.name, f"is missing: {setting.meaning}")
    return effect.with_settings(settings)


def _degree(value: Any) -> int:
    return tomlio.whole(1, 12)(int(value) if isinstance(value, float) and value.is_integer() else value)


def _parameters(card: Card, section: tomlio.Section) -> FloatArray:
    """Parameters in SI units; those that are not given are zero, but one has to be."""
    names = [parameter.name for parameter in card.parameters]
    if not any(name in section.data for name in names):
        given = [key for key in section.data if key not in {setting.name for setting in card.settings}]
        if given:
            raise section.fail(given[0], f"is not a known key; {nearest(given[0], names)}")
        raise section.fail(names[0], f"is missing; at least one of {', '.join(names)} is due")
    values = [section.take(parameter.name, tomlio.number, 0.0) * parameter.si_per_unit for parameter in card.parameters]
    return np.array(values)


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
