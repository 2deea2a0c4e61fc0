"""What matters of a result, for the first screen: largest error, squareness, backlash, and what was not measured.

One object for the terminal, ``report.html`` and the workbench: lines of text, and a row for each error with what it moves the
tool tip by, so that errors of all units compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.drawing.charts import Picture, Plot, limits_of, svg
from compgen.errors import um_text
from compgen.kinematics.many_points import volumetric_error_on_grid

State = Literal["found", "partly", "not measured"]
#: Levels of each axis at which the effect of one error over the volume is calculated.
LEVELS = 7
#: Errors that the picture has room for.
MOST_BARS = 12
_ROLES: Mapping[State, str] = {"found": "line", "partly": "before", "not measured": "muted"}
_WIDE, _BOX = (420.0, 170.0), (46.0, 22.0, 412.0, 138.0)


@dataclass(frozen=True)
class Weight:
    """One error and what it alone moves the tool tip by, rms over the volume: as found, or as assumed if not measured."""

    name: str
    state: State
    rms_um: float


@dataclass(frozen=True)
class Summary:
    """The first screen of a result: lines, and the errors from the one that matters most."""

    lines: tuple[str, ...]
    weights: tuple[Weight, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the contents for ``report.json``."""
        rows = [{"error": item.name, "state": item.state, "rms_um": item.rms_um} for item in self.weights]
        return {"lines": list(self.lines), "errors": rows}


def summary_of(machine: Machine | None, errors: ErrorTable | None, identify: Mapping[str, Any]) -> Summary | None:
    """Return the summary of an identification; None without its machine and errors, or of rotary axes."""
    if machine is None or errors is None or not errors.names or machine.rotary:
        return None
    if any(name not in (*errors.curves, *SQUARENESS_NAMES) for name in errors.names):
        return None
    levels = [np.linspace(*axis.range_mm, LEVELS) for axis in machine.axes]
    moved = {name: volumetric_error_on_grid(machine, errors.only(name), levels) for name in errors.names}
    rms_um = {name: float(np.sqrt((part**2).sum(axis=-1).mean())) / MM_PER_UM for name, part in moved.items()}
    determined = identify.get("determined")
    weights = [
        Weight(name, "found" if determined is None or name in determined else "partly", rms_um[name])
        for name in errors.names
    ]
    open_um = _assumed_um(identify)
    weights += [Weight(name, "not measured", value) for name, value in open_um.items() if name not in errors.names]
    weights.sort(key=lambda item: -item.rms_um)
    lines = [
        _largest(machine, errors, rms_um),
        *_squareness(machine, errors),
        *_backlash(identify),
        *_counts(weights, open_um),
    ]
    return Summary(tuple(lines), tuple(weights))


def _assumed_um(identify: Mapping[str, Any]) -> dict[str, float]:
    """What errors that were not measured are assumed to move the tool tip by, um rms over the volume."""
    listed = identify.get("not_measured")
    found = {}
    for name, item in listed.items() if isinstance(listed, Mapping) else ():
        value = item.get("rms_over_volume_um") if isinstance(item, Mapping) else None
        if isinstance(value, int | float) and math.isfinite(value):
            found[str(name)] = float(value)
    return found


def _travel_mm(machine: Machine, name: str) -> float:
    """The travel over which a squareness error acts."""
    return machine.axes[error_named(name).axis].length_mm


def _over_travel_um(machine: Machine, errors: ErrorTable, name: str) -> float:
    return errors.squareness[name][0] * _travel_mm(machine, name) / MM_PER_UM


def _largest(machine: Machine, errors: ErrorTable, rms_um: Mapping[str, float]) -> str:
    """The error that moves the tool tip most, with where it is largest."""
    name = max(rms_um, key=lambda key: rms_um[key])
    error, axis = error_named(name), AXES[error_named(name).axis]
    moves = um_text(rms_um[name])
    if name in errors.squareness:
        urad, um = errors.squareness[name][0] / error.si_per_unit, _over_travel_um(machine, errors, name)
        travel = _travel_mm(machine, name)
        return (
            f"largest error: {name} {urad:+.0f} urad, {um:+.1f} um over the {travel:g} mm of {axis}; "
            f"moves the tool tip by {moves} um rms"
        )
    curve = errors.curves[name]
    k = int(np.argmax(np.abs(curve.value)))
    value, unit, at = curve.value[k] / error.si_per_unit, error.unit, curve.position_mm[k]
    return f"largest error: {name} {value:+.1f} {unit} at {axis} {at:g} mm; moves the tool tip by {moves} um rms"


def _squareness(machine: Machine, errors: ErrorTable) -> list[str]:
    """What the squareness errors are over the travel."""
    listed = [_of_squareness(machine, errors, name) for name in SQUARENESS_NAMES if name in errors.squareness]
    joined = ", ".join(listed)
    return [f"squareness over the travel: {joined}"] if listed else ["squareness: not measured"]


def _of_squareness(machine: Machine, errors: ErrorTable, name: str) -> str:
    """One squareness error over the travel."""
    um, travel = _over_travel_um(machine, errors, name), _travel_mm(machine, name)
    return f"{name} {um:+.1f}{_expanded(machine, errors, name)} um over {travel:g} mm"


def _expanded(machine: Machine, errors: ErrorTable, name: str) -> str:
    """The expanded uncertainty of a squareness error over the travel, if it is known."""
    u_um = COVERAGE * errors.squareness[name][1] * _travel_mm(machine, name) / MM_PER_UM
    return f" ± {u_um:.1f}" if math.isfinite(u_um) and u_um > 0.0 else ""


def _backlash(identify: Mapping[str, Any]) -> list[str]:
    """Backlash of the axes where the readings show it."""
    found: dict[str, float] = {}
    circles = identify.get("circles")
    for item in circles.get("unknowns") or () if isinstance(circles, Mapping) else ():
        if isinstance(item, Mapping) and item.get("what") == "reversal" and str(item.get("of")) in AXES:
            found[str(item["of"])] = float(item["value"])
    runs = identify.get("axis-runs")
    of_runs = runs.get("axes") if isinstance(runs, Mapping) else None
    for axis, item in of_runs.items() if isinstance(of_runs, Mapping) else ():
        if axis in AXES and isinstance(item, Mapping) and isinstance(item.get("reversal_um"), int | float):
            found[axis] = float(item["reversal_um"])
    reversal = identify.get("reversal")
    by_axis = reversal.get("axes") if isinstance(reversal, Mapping) else None
    for axis, item in by_axis.items() if isinstance(by_axis, Mapping) else ():
        vector = item.get("vector_um") if isinstance(item, Mapping) else None
        if axis in AXES and isinstance(vector, Sequence) and len(vector) == len(AXES):
            found[axis] = float(vector[AXES.index(axis)])
    listed = [f"{axis} {value:+.2f} um" for axis, value in sorted(found.items()) if math.isfinite(value)]
    joined = ", ".join(listed)
    return [f"backlash: {joined}"] if listed else []


def _counts(weights: Sequence[Weight], open_um: Mapping[str, float]) -> list[str]:
    """How many errors are known, and what the others may cost."""
    found, partly, missing = (
        sum(item.state == state for item in weights) for state in ("found", "partly", "not measured")
    )
    lines = [
        f"1 error found, {partly} partly, {missing} not measured"
        if found == 1
        else f"{found} errors found, {partly} partly, {missing} not measured"
    ]
    costs = [item for item in weights if item.state == "not measured" and item.name in open_um]
    if costs:
        listed = ", ".join(f"{item.name} {um_text(item.rms_um)} um" for item in costs[:4])
        further = len(costs) - 4
        if further <= 0:
            lines.append(f"what was not measured may cost, rms over the volume: {listed}")
        elif further == 1:
            lines.append(f"what was not measured may cost, rms over the volume: {listed} and 1 other")
        else:
            lines.append(f"what was not measured may cost, rms over the volume: {listed} and {further} others")
    return lines


def draw_summary(found: Summary) -> list[Picture]:
    """Return one picture: what each error moves the tool tip by, the largest first."""
    shown = found.weights[:MOST_BARS]
    value = np.array([item.rms_um for item in shown])
    at = np.arange(len(shown), dtype=np.float64)
    marks = [(float(k), item.name) for k, item in enumerate(shown)]
    plot = Plot((-0.6, len(shown) - 0.4), limits_of(value, zero=True), _BOX, y_label="µm rms", x_ticks=marks)
    plot.y = (0.0, 1.14 * plot.y[1])
    for state, role in _ROLES.items():
        own = np.array([item.state == state for item in shown])
        if own.any():
            plot.bars(at[own] - 0.36, at[own] + 0.36, np.zeros(int(own.sum())), value[own], role)
    for k, item in enumerate(shown):
        text = um_text(item.rms_um, whole_from=100.0)
        plot.text(float(k), item.rms_um, text, anchor="middle", shift=(0.0, -3.0), unit="um")
    title = "What each error alone moves the tool tip by, rms over the volume"
    return [Picture("summary", title, svg("summary", title, [plot], _WIDE))]
