"""Sections ``[[effects]]`` of a scenario: names, parameters and settings of the catalogue, or those of a plug-in."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.plugins import call_problem, why_missing
from compgen.core.points import Points
from compgen.core.text import nearest
from compgen.effects import DisplacementEffect, Effect, catalogue, listed, readings_of_points
from compgen.effects.of_machine import DEAD_PATH_KEY, STATION_NAME, read_values
from compgen.errors import InputError
from compgen.simulate.effects.axes import AXIS_EFFECTS, warmup_drift
from compgen.simulate.effects.scene import Displacement, LengthEffect, RunEffect
from compgen.simulate.effects.sight import LENGTH_EFFECTS, STATION_EFFECTS
from compgen.simulate.effects.structure import NAMED_EFFECTS, SINGLE_EFFECTS
from compgen.simulate.trajectory import Stops

SimulatedEffect = Displacement | LengthEffect | RunEffect
#: Reader of a section ``[[effects]]`` of a scenario by its ``name``; plug-ins add to it.
EFFECTS: dict[str, Callable[[tomlio.Section], Displacement]] = {}


def read_effects(sections: list[tomlio.Section]) -> tuple[SimulatedEffect, ...]:
    """Read the effects of a scenario in their order; InputError for an unknown name, key or value."""
    return tuple(_read_effect(section) for section in sections)


def _read_effect(section: tomlio.Section) -> SimulatedEffect:
    name = section.take("name", tomlio.text)
    if name in EFFECTS:
        return _read_own(name, section)
    known = catalogue(_stations(name, section))
    if name not in known or not known[name].card.parameters:
        names = [*EFFECTS, *(other for other, effect in listed().items() if effect.card.parameters)]
        reason = why_missing("effect", name)
        raise section.fail("name", f"is no effect; {nearest(name, names)}; --plugin PATH adds some{reason}")
    effect, values = read_values(known[name], section)
    section.finish()
    by_name = {p.name: float(v) for p, v in zip(effect.card.parameters, values, strict=True)}
    return _built_in(name, by_name, effect.settings) or _of_columns(effect, values)


def _read_own(name: str, section: tomlio.Section) -> Displacement:
    """Read an effect by the reader of a plug-in."""
    effect = EFFECTS[name](section)
    section.finish()
    problems = call_problem(effect, ["machine", "stops"], f"the effect {name}")
    if problems:
        raise section.fail("name", "; ".join(problems))
    return effect


def _stations(name: str, section: tomlio.Section) -> tuple[str, ...]:
    """Stations that the name of an effect and its keys speak of."""
    keys = [match.group(1) for key in section.data if (match := DEAD_PATH_KEY.fullmatch(key))]
    of_name = STATION_NAME.fullmatch(name)
    return tuple(dict.fromkeys([*([of_name.group(1)] if of_name else []), *keys]))


def _built_in(name: str, p: Mapping[str, float], settings: Mapping[str, float]) -> SimulatedEffect | None:
    """Return the forward formula of an effect of the catalogue, parameters in SI units; None for one of a plug-in."""
    if name in SINGLE_EFFECTS:
        return SINGLE_EFFECTS[name](p, settings)
    if name == "warmup_drift":
        return warmup_drift(p, settings)
    if name in LENGTH_EFFECTS:
        return LengthEffect(name, LENGTH_EFFECTS[name](p, settings))
    station = STATION_NAME.fullmatch(name)
    if station:
        family = name[: station.start(1) - 1]
        return LengthEffect(name, STATION_EFFECTS[family](station.group(1), p, settings))
    family, _, member = name.rpartition("_")
    if family in AXIS_EFFECTS and member in AXES:
        return AXIS_EFFECTS[family](AXES.index(member), p, settings)
    return NAMED_EFFECTS[family](member, p, settings) if family in NAMED_EFFECTS else None


def _of_columns(effect: Effect, values: FloatArray) -> Displacement:
    """Simulate an effect of a plug-in's family by its own columns."""
    if not isinstance(effect, DisplacementEffect):
        raise InputError(
            f"{effect.card.name} does not move the tip, so a plug-in has to give a reader of its own for it"
        )

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        covariates = {"time_s": stops.time_s, **stops.covariates}
        points = Points(stops.position_mm, stops.tool_mm, stops.approach, covariates)
        found = effect.displacement(readings_of_points(machine, points))
        if found is None:
            raise InputError(f"the scenario lacks what {effect.card.name} needs: {', '.join(effect.card.covariates)}")
        return found @ values

    return moved
