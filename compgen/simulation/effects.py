"""What acts on a simulated machine and its tracers beyond the geometric errors: forward formulas, sections of a scenario."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, SECONDS_PER_MIN, error_named
from compgen.effects import ANY_STATION, DisplacementEffect, Effect, catalogue, listed, readings_of_points
from compgen.effects.active import STATION_NAME, dead_path_stations, keys_schema, read_values, station_pattern
from compgen.errors import InputError, Message, nearest
from compgen.kinematics.exact_chain import tip_position
from compgen.registry import Registry, call_problem, why_missing
from compgen.simulation.trajectory import Stops

# What simulated effects act on: the stops of the machine, and the lines of sight of the tracers.


#: Moves the tip: displacement in the workpiece frame at the stops, shape (n, 3), mm.
Displacement = Callable[[Machine, Stops], FloatArray]


@dataclass(frozen=True)
class Sights:
    """Readings of tracers, n of them.

    Parameters
    ----------
    stops : all stops of the machine.
    stop : stop of each reading, (n,).
    stations : names of the stations.
    station : station of each reading, (n,).
    station_mm, tip_mm : true station and tip of each reading, (n, 3).
    """

    stops: Stops
    stop: NDArray[np.int64]
    stations: tuple[str, ...]
    station: NDArray[np.int64]
    station_mm: FloatArray
    tip_mm: FloatArray

    @property
    def range_mm(self) -> FloatArray:
        """Distance of station and tip, (n,)."""
        return np.asarray(np.linalg.norm(self.tip_mm - self.station_mm, axis=1))

    @property
    def time_s(self) -> FloatArray:
        """Time of each reading, (n,)."""
        return self.stops.time_s[self.stop]

    def channel(self, name: str) -> FloatArray:
        """Covariate of each reading, (n,)."""
        return channel(self.stops, name)[self.stop]


@dataclass(frozen=True)
class LengthEffect:
    """An effect that changes lengths without moving the tip: ``change`` returns what it adds, (n,), mm."""

    name: str
    change: Callable[[Sights], FloatArray]


@dataclass(frozen=True)
class RunEffect:
    """An effect on the readings of axis runs: ``change`` takes their times (n,) and returns what it adds, (n,), mm."""

    name: str
    change: Callable[[FloatArray], FloatArray]


def channel(stops: Stops, name: str) -> FloatArray:
    """Covariate of each stop (n,); InputError if the scenario has none of that name."""
    if name not in stops.covariates:
        what = "[temperatures]" if name.startswith("temp_") else "[session]"
        what = '[instrument] as a list, one for each run of type = "axis-laser"' if name == "dwell_s" else what
        message = f"an effect needs {name}, which the scenario does not have; add it to {what}"
        raise InputError(message, field="[[effects]]")
    return stops.covariates[name]


def over_travel(machine: Machine, stops: Stops, axis: int) -> FloatArray:
    """Position of an axis over its travel, -1 ... +1, (n,)."""
    low, high = machine.axes[axis].range_mm
    return np.asarray((stops.position_mm[:, axis] - 0.5 * (low + high)) / (0.5 * (high - low)))


def from_reference(values: FloatArray, settings: Mapping[str, float], key: str) -> FloatArray:
    """Return values minus the setting ``key``, by default minus their mean."""
    return values - settings.get(key, float(values.mean()))


# Simulated effects of single axes: backlash, lost motion, periodic errors, lag, growth, cosine error.


Values = Mapping[str, float]


def _along(axis: int, moved_mm: FloatArray) -> FloatArray:
    vectors = np.zeros((len(moved_mm), 3))
    vectors[:, axis] = moved_mm
    return vectors


def backlash(axis: int, p: Values, settings: Values) -> Displacement:
    """Half the backlash, towards the side from which the axis came."""
    return lambda machine, stops: _along(axis, p["c_um"] * stops.approach[:, axis])


def lost_motion(axis: int, p: Values, settings: Values) -> Displacement:
    """Backlash that changes along the travel."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        s = over_travel(machine, stops, axis)
        return _along(axis, stops.approach[:, axis] * (p["c1_um"] * s + p["c2_um"] * (1.5 * s**2 - 0.5)))

    return moved


def periodic(axis: int, p: Values, settings: Values) -> Displacement:
    """Two harmonics of the pitch."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        pitch = settings.get("pitch_mm", machine.axes[axis].screw_pitch_mm or math.nan)
        turn = 2 * math.pi * stops.position_mm[:, axis] / pitch
        wave = p["s1_um"] * np.sin(turn) + p["c1_um"] * np.cos(turn)
        return _along(axis, wave + p["s2_um"] * np.sin(2 * turn) + p["c2_um"] * np.cos(2 * turn))

    return moved


def servo_lag(axis: int, p: Values, settings: Values) -> Displacement:
    """A time constant times the velocity of the axis before the stop."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        speed = channel(stops, "feed_mm_min") / SECONDS_PER_MIN
        way = stops.way_mm / np.maximum(np.linalg.norm(stops.way_mm, axis=1, keepdims=True), 1e-12)
        return _along(axis, p["tau_ms"] * speed * way[:, axis])

    return moved


def thermal_scale(axis: int, p: Values, settings: Values) -> Displacement:
    """A scale that expands about its fixed point."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        fixed = settings.get("fixed_mm", machine.reference_point_mm[axis])
        warm = from_reference(channel(stops, f"temp_{AXES[axis].lower()}_c"), settings, "reference_c")
        return _along(axis, p["c_um_per_m_k"] * warm * (stops.position_mm[:, axis] - fixed))

    return moved


def spindle_growth(axis: int, p: Values, settings: Values) -> Displacement:
    """A spindle or column that grows with the temperature of the spindle."""
    return lambda machine, stops: _along(
        axis, p["c_um_per_k"] * from_reference(channel(stops, "temp_spindle_c"), settings, "reference_c")
    )


def cosine_error(axis: int, p: Values, settings: Values) -> Displacement:
    """A scale inclined by theta: the axis is at p cos(theta) when commanded to p."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        theta = math.sqrt(max(2.0 * p["c_ppm"], 0.0))
        return _along(axis, stops.position_mm[:, axis] * (math.cos(theta) - 1.0))

    return moved


def warmup_drift(p: Values, settings: Values) -> RunEffect:
    """A decaying drift: the readings of an axis that warms up, or of its sensor."""

    def change(time_s: FloatArray) -> FloatArray:
        since = time_s - settings.get("start", float(time_s.min()))
        return p["c_um"] * (1.0 - np.exp(-since / settings["tau"]))

    return RunEffect("warmup_drift", change)


def linear_drift(p: Values, settings: Values) -> RunEffect:
    """A drift at a constant rate that reaches ``c_um`` within ``span``, by default from the first to the last reading."""

    def change(time_s: FloatArray) -> FloatArray:
        since = time_s - settings.get("start", float(time_s.min()))
        return np.asarray(p["c_um"] * since / settings.get("span", float(np.ptp(time_s))))

    return RunEffect("linear_drift", change)


def step_between_runs(p: Values, settings: Values) -> RunEffect:
    """The zero that jumps before the reading ``at``; readings are numbered from 0 in the order of time."""

    def change(time_s: FloatArray) -> FloatArray:
        return np.where(np.arange(len(time_s)) < settings["at"], 0.0, p["c_um"])

    return RunEffect("step_between_runs", change)


def off_between(name: str) -> Callable[[Values, Values], RunEffect]:
    """Readings from the number ``first`` to the number ``last`` that are off: a bad run, or a disturbance."""

    def made(p: Values, settings: Values) -> RunEffect:
        first, last = settings["first"], settings["last"]
        if last < first:
            raise InputError(
                Message(
                    "effect-range-reversed",
                    "{name}: last is {last:g}, before first, {first:g}",
                    name=name,
                    last=last,
                    first=first,
                ),
                field="[[effects]]",
            )

        def change(time_s: FloatArray) -> FloatArray:
            number = np.arange(len(time_s))
            if first > number[-1] or last < 0:
                raise InputError(
                    Message(
                        "effect-without-readings",
                        "{name}: there are readings 0 to {number}, none from {first:g} to {last:g}",
                        name=name,
                        number=number[-1],
                        first=first,
                        last=last,
                    )
                )
            return np.where((number < first) | (number > last), 0.0, p["c_um"])

        return RunEffect(name, change)

    return made


def settling(axis: int, p: Values, settings: Values) -> Displacement:
    """Settling error at the reading, towards the side from which the axis came; the dwell reduces it."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        missing = p["c_um"] * np.exp(-channel(stops, "dwell_s") / settings["tau_s"])
        return _along(axis, missing * stops.approach[:, axis])

    return moved


#: Effects on the readings of axis runs.
RUN_EFFECTS: dict[str, Callable[[Values, Values], RunEffect]] = {
    "warmup_drift": warmup_drift,
    "linear_drift": linear_drift,
    "step_between_runs": step_between_runs,
    "bad_run": off_between("bad_run"),
    "disturbed_readings": off_between("disturbed_readings"),
}
AXIS_EFFECTS = {
    "settling": settling,
    "backlash": backlash,
    "lost_motion": lost_motion,
    "periodic": periodic,
    "servo_lag": servo_lag,
    "thermal_scale": thermal_scale,
    "spindle_growth": spindle_growth,
    "cosine_error": cosine_error,
}


# Simulated effects of the structure: angular errors with an offset, squareness, signs, sag, droop, bending, jumps.


X, Y, Z = 0, 1, 2
#: Angle by which a carriage is rotated to find what an angular error moves, rad.
SMALL_RAD = 1e-3


def _curve(machine: Machine, stops: Stops, axis: int, p: Values) -> FloatArray:
    """Angular curve sum of p_k P_k over the travel of an axis, (n,), rad."""
    top = max(int(name[1:].partition("_")[0]) for name in p)
    weights = [p.get(f"p{k}_urad", 0.0) for k in range(top + 1)]
    return np.asarray(np.polynomial.Legendre(weights)(over_travel(machine, stops, axis)))


def _moved_by(machine: Machine, stops: Stops, name: str, value: FloatArray) -> FloatArray:
    """Displacement of the tip by one of the 21 errors with finite rotations, (n, 3), mm."""
    errors = np.zeros((len(stops), len(ERROR_INDEX)))
    plain = tip_position(machine, errors, stops.position_mm, stops.tool_mm)
    errors[:, ERROR_INDEX[name]] = value
    return tip_position(machine, errors, stops.position_mm, stops.tool_mm) - plain


def lever(name: str, p: Values, settings: Values) -> Displacement:
    """An angular error along its axis, which rotates everything mounted on it."""
    return lambda machine, stops: _moved_by(machine, stops, name, _curve(machine, stops, error_named(name).axis, p))


def squareness(short: str, p: Values, settings: Values) -> Displacement:
    """An axis out of square."""
    return lambda machine, stops: _moved_by(machine, stops, f"E{short}", np.full(len(stops), p["c_urad"]))


def sign(name: str, p: Values, settings: Values) -> Displacement:
    """One of two products of an angular error, with the wrong sign."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        # what the angle moves: (component, axis whose travel is the lever, sign), found by rotating a carriage
        arms = []
        for axis in (axis for axis in range(3) if axis != error_named(name).axis):
            errors = np.zeros((2, len(ERROR_INDEX)))
            errors[:, ERROR_INDEX[name]] = SMALL_RAD, -SMALL_RAD
            both = tip_position(machine, errors, np.eye(3)[[axis, axis]], np.zeros(3))
            slope = (both[0] - both[1]) / (2 * SMALL_RAD)
            arms += [(k, axis, float(np.sign(slope[k]))) for k in range(3) if abs(slope[k]) > 0.5]
        component, axis, direction = max(arms)
        vectors = np.zeros((len(stops), 3))
        curve = _curve(machine, stops, error_named(name).axis, p)
        vectors[:, component] = -direction * stops.position_mm[:, axis] * curve
        return vectors

    return moved


def beam_sag(p: Values, settings: Values) -> Displacement:
    """A beam that sags by products of polynomials along X and Y."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        weights = np.zeros((3, 3))
        for i in (1, 2):
            for j in (1, 2):
                weights[i, j] = p[f"c{i}{j}_um"]
        x, y = over_travel(machine, stops, X), over_travel(machine, stops, Y)
        return np.column_stack([0 * x, 0 * x, np.polynomial.legendre.legval2d(x, y, weights)])

    return moved


def ram_droop(p: Values, settings: Values) -> Displacement:
    """A ram that droops with its extension."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        y, z = over_travel(machine, stops, Y), over_travel(machine, stops, Z)
        droop = (1.5 * z**2 - 0.5) * (p["c1_um"] * y + p["c2_um"] * (1.5 * y**2 - 0.5))
        return np.column_stack([0 * y, droop, 0 * y])

    return moved


def load_deflection(p: Values, settings: Values) -> Displacement:
    """A bed that deflects under the load of the workpiece."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        x, y = over_travel(machine, stops, X), over_travel(machine, stops, Y)
        compliance = p["c0_um_per_kg"] + p["c1_um_per_kg"] * (1.5 * x**2 - 0.5) + p["c2_um_per_kg"] * (1.5 * y**2 - 0.5)
        return np.column_stack([0 * x, 0 * x, channel(stops, "load_kg") * compliance])

    return moved


def column_bending(p: Values, settings: Values) -> Displacement:
    """A column that bends away from its warm side."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        gradient = channel(stops, "temp_column_front_c") - channel(stops, "temp_column_rear_c")
        height = stops.position_mm[:, Z] - settings.get("z0_mm", machine.axes[Z].range_mm[0])
        bent = p["c_um_per_k_m2"] * from_reference(gradient, settings, "reference_k") * height**2
        return np.column_stack([0 * bent, bent, 0 * bent])

    return moved


def _vector(p: Values) -> FloatArray:
    return np.array([p["cx_um"], p["cy_um"], p["cz_um"]])


def machine_jump(p: Values, settings: Values) -> Displacement:
    """A displacement that begins at a time."""
    return lambda machine, stops: np.outer(stops.time_s >= settings["time_s"], _vector(p))


def tool_offset_error(p: Values, settings: Values) -> Displacement:
    """A displacement in one set-up: that of the label, otherwise of the tool offsets in order of size."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        if "setup" in stops.labels:
            setup = stops.labels["setup"]
        else:
            tools = [tuple(row) for row in np.atleast_2d(np.zeros((1, 3)) if stops.tool_mm is None else stops.tool_mm)]
            rank = {tool: k + 1 for k, tool in enumerate(sorted(set(tools)))}
            setup = np.broadcast_to([rank[tool] for tool in tools], len(stops))
        return np.outer(setup == settings["setup"], _vector(p))

    return moved


SINGLE_EFFECTS: dict[str, Callable[[Values, Values], Displacement]] = {
    "beam_sag": beam_sag,
    "ram_droop": ram_droop,
    "load_deflection": load_deflection,
    "column_bending": column_bending,
    "machine_jump": machine_jump,
    "tool_offset_error": tool_offset_error,
}
NAMED_EFFECTS = {"lever": lever, "squareness": squareness, "sign": sign}


# Simulated effects of the tracers and of the air: they change lengths without moving the tip.


Change = Callable[[Sights], FloatArray]


def refractive_index(p: Values, settings: Values) -> Change:
    """All lengths follow the air."""
    return lambda sights: (
        p["c_ppm_per_k"] * sights.range_mm * from_reference(sights.channel("temp_ambient_c"), settings, "reference_c")
    )


def dead_path(p: Values, settings: Values) -> Change:
    """An air path error for each station; none for a station without an entry."""

    def change(sights: Sights) -> FloatArray:
        path = np.array([p.get(f"c_{name}_um_per_k", 0.0) for name in sights.stations])
        return path[sights.station] * from_reference(sights.channel("temp_ambient_c"), settings, "reference_c")

    return change


def laser_scale(p: Values, settings: Values) -> Change:
    """All lengths too long by one factor."""
    return lambda sights: p["c_ppm"] * sights.range_mm


def target_angle(p: Values, settings: Values) -> Change:
    """A target whose reading grows with the angle of incidence."""

    def change(sights: Sights) -> FloatArray:
        steepness = (sights.tip_mm[:, 2] - sights.station_mm[:, 2]) / sights.range_mm
        return p["c1_um"] * steepness**2 + p["c2_um"] * steepness**3

    return change


def _of(station: str, sights: Sights) -> FloatArray:
    """1 for the readings of a station, else 0."""
    return np.array([name == station for name in sights.stations], dtype=np.float64)[sights.station]


def station_drift(station: str, p: Values, settings: Values) -> Change:
    """A station that drifts, at its true distance at each time."""

    def change(sights: Sights) -> FloatArray:
        velocity = np.array([p["vx_um_per_h"], p["vy_um_per_h"], p["vz_um_per_h"]])
        since = from_reference(sights.time_s, settings, "reference_s")
        moved = sights.tip_mm - sights.station_mm - np.outer(since, velocity)
        return np.asarray(_of(station, sights) * (np.linalg.norm(moved, axis=1) - sights.range_mm))

    return change


def length_step(station: str, p: Values, settings: Values) -> Change:
    """Counts lost at a time."""
    return lambda sights: p["c_um"] * _of(station, sights) * (sights.time_s >= settings["time_s"])


def tracer_runout(station: str, p: Values, settings: Values) -> Change:
    """A reference sphere with form error: harmonics of the pointing direction of the head."""

    def change(sights: Sights) -> FloatArray:
        line = sights.tip_mm - sights.station_mm
        turn = np.exp(1j * np.arctan2(line[:, 1], line[:, 0]))
        second, third = (p[f"s{k}_um"] * (turn**k).imag + p[f"c{k}_um"] * (turn**k).real for k in (2, 3))
        return np.asarray(_of(station, sights) * (second + third))

    return change


LENGTH_EFFECTS: dict[str, Callable[[Values, Values], Change]] = {
    "refractive_index": refractive_index,
    "dead_path": dead_path,
    "laser_scale": laser_scale,
    "target_angle": target_angle,
}
STATION_EFFECTS = {"station_drift": station_drift, "length_step": length_step, "tracer_runout": tracer_runout}


# Sections ``[[effects]]`` of a scenario: names, parameters and settings of the catalogue, or of a plug-in.


SimulatedEffect = Displacement | LengthEffect | RunEffect
#: Reader of a section ``[[effects]]`` of a scenario by its ``name``; plug-ins add to it.
EFFECTS: Registry[Callable[[toml_files.Section], SimulatedEffect]] = Registry()


def effects_schema() -> dict[str, Any]:
    """Return the JSON schema of the sections ``[[effects]]`` of a scenario."""
    known = {name: effect for name, effect in listed().items() if effect.card.parameters}
    names = [
        {"pattern": station_pattern(name)} if ANY_STATION in name else {"const": name} for name in (*EFFECTS, *known)
    ]
    rules = [
        {
            "if": {"required": ["name"], "properties": {"name": which}},
            "then": keys_schema(known[name], name={"type": "string"}) if name in known else {},
        }
        for name, which in zip((*EFFECTS, *known), names, strict=True)
    ]
    one = {"type": "object", "required": ["name"], "properties": {"name": {"type": "string", "anyOf": names}}}
    return toml_files.array_schema({**one, "allOf": rules})


def read_effects(sections: list[toml_files.Section]) -> tuple[SimulatedEffect, ...]:
    """Read the effects of a scenario in their order; InputError for an unknown name, key or value."""
    found: list[SimulatedEffect] = []
    for section in sections:
        name = section.take("name", toml_files.text)
        if name in EFFECTS:  # has the reader of a plug-in
            moving = EFFECTS[name](section)
            section.finish()
            problems = call_problem(moving, ["machine", "stops"], f"the effect {name}")
            if problems:
                raise section.fail("name", "; ".join(problems))
            found.append(moving)
            continue
        known = catalogue(_stations(name, section))
        if name not in known or not known[name].card.parameters:
            names = [*EFFECTS, *(other for other, effect in listed().items() if effect.card.parameters)]
            reason = why_missing(EFFECTS.broken, name)
            message = f"unknown effect; {nearest(name, names)}; --plugin PATH adds some{reason}"
            raise section.fail("name", message, kind="value")
        effect, values = read_values(known[name], section)
        section.finish()
        by_name = {p.name: float(v) for p, v in zip(effect.card.parameters, values, strict=True)}
        found.append(_built_in(name, by_name, effect.settings) or _of_columns(effect, values))
    return tuple(found)


def _stations(name: str, section: toml_files.Section) -> tuple[str, ...]:
    """Return the stations in the name of an effect and its keys."""
    of_name = STATION_NAME.fullmatch(name)
    return tuple(dict.fromkeys([*([of_name.group(1)] if of_name else []), *dead_path_stations(section.data)]))


def _built_in(name: str, p: Mapping[str, float], settings: Mapping[str, float]) -> SimulatedEffect | None:
    """Return the forward formula of an effect of the catalogue, parameters in SI units; None for an effect of a plug-in."""
    if name in SINGLE_EFFECTS:
        return SINGLE_EFFECTS[name](p, settings)
    if name in RUN_EFFECTS:
        return RUN_EFFECTS[name](p, settings)
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
    """Simulate an effect of a plug-in's family by its columns."""
    if not isinstance(effect, DisplacementEffect):
        raise InputError(
            Message(
                "effect-without-reader",
                "{name} does not move the tip, so a plug-in must provide a reader for it",
                name=effect.card.name,
            )
        )

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        covariates = {"time_s": stops.time_s, **stops.covariates}
        points = Points(stops.position_mm, stops.tool_mm, stops.approach, covariates)
        found = effect.displacement(readings_of_points(machine, points))
        if found is None:
            raise InputError(
                Message(
                    "scenario-lacks-channel",
                    "the scenario lacks what {name} needs: {covariates}",
                    name=effect.card.name,
                    covariates=", ".join(effect.card.covariates),
                )
            )
        return found @ values

    return moved
