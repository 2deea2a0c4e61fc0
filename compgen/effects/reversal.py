"""What a control can carry of the effects of a machine file: reversal in tables, the rest as advice."""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve
from compgen.core.machine import Machine
from compgen.core.reversal import ReversalCurves
from compgen.effects.backlash import Backlash
from compgen.effects.lost_motion import LostMotion
from compgen.effects.of_machine import ActiveEffect, active_effects
from compgen.effects.polynomials import legendre

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
