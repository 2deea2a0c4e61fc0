"""Simulated effects of the structure: angular errors with an offset, squareness, signs, sag, droop, bending, jumps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, error_named
from compgen.model.exact import tip_position
from compgen.simulate.effects.scene import Displacement, channel, from_reference, over_travel
from compgen.simulate.trajectory import Stops

Values = Mapping[str, float]
X, Y, Z = 0, 1, 2
#: Angle by which a carriage is turned to see what an angular error moves, rad.
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
    """An angular error along its axis, turning all that hangs on it."""
    return lambda machine, stops: _moved_by(machine, stops, name, _curve(machine, stops, error_named(name).axis, p))


def squareness(short: str, p: Values, settings: Values) -> Displacement:
    """An axis that leans."""
    return lambda machine, stops: _moved_by(machine, stops, f"E{short}", np.full(len(stops), p["c_urad"]))


def _arm(machine: Machine, name: str) -> list[tuple[int, int, float]]:
    """What an angular error moves: (component, axis whose travel is the lever, sign), by turning a carriage."""
    found = []
    for axis in range(3):
        if axis == error_named(name).axis:
            continue
        both = []
        for angle in (SMALL_RAD, -SMALL_RAD):
            errors = np.zeros((1, len(ERROR_INDEX)))
            errors[0, ERROR_INDEX[name]] = angle
            both.append(tip_position(machine, errors, np.eye(3)[[axis]], np.zeros(3))[0])
        slope = (both[0] - both[1]) / (2 * SMALL_RAD)
        found += [(k, axis, float(np.sign(slope[k]))) for k in range(3) if abs(slope[k]) > 0.5]
    return found


def sign(name: str, p: Values, settings: Values) -> Displacement:
    """One of two products of an angular error, taken with the other sign."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        component, axis, direction = max(_arm(machine, name))
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
    """A ram that droops the more it leans out."""

    def moved(machine: Machine, stops: Stops) -> FloatArray:
        y, z = over_travel(machine, stops, Y), over_travel(machine, stops, Z)
        droop = (1.5 * z**2 - 0.5) * (p["c1_um"] * y + p["c2_um"] * (1.5 * y**2 - 0.5))
        return np.column_stack([0 * y, droop, 0 * y])

    return moved


def load_deflection(p: Values, settings: Values) -> Displacement:
    """A bed that gives under the workpiece."""

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
    """A displacement from a time on."""
    return lambda machine, stops: np.outer(stops.time_s >= settings["time_s"], _vector(p))


def tool_offset_error(p: Values, settings: Values) -> Displacement:
    """A displacement in one set-up: that of the label, else of the tool offsets in order of size."""

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
