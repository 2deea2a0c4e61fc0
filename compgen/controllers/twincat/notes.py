"""Words for the people at a TwinCAT CNC: signs, parameters of the axis lists, warnings."""

from __future__ import annotations

from typing import Any

import numpy as np

from compgen.controllers.twincat.settings import USUAL, TwincatSettings
from compgen.controllers.twincat.tables import AxisList, TwincatTables
from compgen.core.machine import Machine
from compgen.core.names import AXES


def twincat_notes(machine: Machine, settings: TwincatSettings, tables: TwincatTables) -> dict[str, Any]:
    """Return the texts of the context: sign_statement, cross_statement, screw_statement, parameters, warnings."""
    return {
        "sign_statement": f"{_screw_statement(settings)} {_cross_statement(settings)}",
        "screw_statement": _screw_statement(settings),
        "cross_statement": _cross_statement(settings),
        "cross_sign": settings.cross_sign,
        "ssfk_sign": settings.ssfk_sign,
        "parameters": _parameters(settings, tables),
        "warnings": _warnings(settings, tables),
        "overwrites": [
            "Of other axes: nothing.",
            "The compensation lists of X, Y and Z as a whole: what the old list of one of them holds beside these tables, e.g. a "
            "table over a rotary axis, is lost.",
        ],
    }


def _screw_statement(settings: TwincatSettings) -> str:
    if settings.ssfk_sign == "error":
        return (
            "kw.ssfk holds actual minus nominal in 0.1 um, and the control takes it off: 21 at 100 mm says that the axis "
            "stands 0.0021 mm too far in the positive direction; the control then commands 99.9979 mm."
        )
    return "kw.ssfk holds what the control adds, in 0.1 um: 21 at 100 mm makes it command 100.0021 mm."


def _cross_statement(settings: TwincatSettings) -> str:
    added, sign = ("added to", "+") if settings.cross_sign == "correction" else ("taken off", "-")
    return (
        f"Values of kw.crosscomp and kw.crosscomp2 are {added} the command of the slave (cross_sign = "
        f'"{settings.cross_sign}"): 50 moves it by {sign}0.0050 mm.'
    )


def _parameters(settings: TwincatSettings, tables: TwincatTables) -> list[dict[str, object]]:
    rows: list[tuple[str, object, str]] = []
    for axis, item in sorted(tables.lists.items()):
        where = f"axis parameter list of {AXES[axis]} (axis {settings.logical_axes[axis]})"
        for name, table in (("ssfk", item.screw), ("crosscomp", item.cross), ("crosscomp2", item.plane)):
            active = 1 if table is not None else 0
            rows.append((f"lr_param.{name} ({AXES[axis]})", active, where))
        rows += _direction_rows(axis, item)
        rows += _point_rows(settings, axis, item)
    return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]


def _direction_rows(axis: int, item: AxisList) -> list[tuple[str, object, str]]:
    if item.screw is None or item.screw.neg is None:
        return []
    meaning = "bilateral table: it holds the backlash, so backlash compensation of this axis must be off"
    return [
        (f"backlash compensation ({AXES[axis]})", "off", meaning),
        (f"lr_param.n_backlash_cyc ({AXES[axis]})", "as suits", "cycles over which a change of direction is spread"),
    ]


def _point_rows(settings: TwincatSettings, axis: int, item: AxisList) -> list[tuple[str, object, str]]:
    counts = (
        ("ssfk", item.screw and len(item.screw.setpoints), USUAL.ssfk),
        ("crosscomp", item.cross and len(item.cross.setpoints), USUAL.crosscomp),
        ("crosscomp2", item.plane and item.plane.values.size, USUAL.crosscomp2),
    )
    return [
        (f"kw.{name}.max_points ({AXES[axis]})", f">= {used + 1}", f"the usual {usual} do not hold this table")
        for name, used, usual in counts
        if used and used > usual
    ]


def _warnings(settings: TwincatSettings, tables: TwincatTables) -> list[str]:
    found: list[str] = []
    if any(item.cross or item.plane for item in tables.lists.values()):
        found.append(
            f'cross_sign = "{settings.cross_sign}": no public document says whether kw.crosscomp and kw.crosscomp2 are '
            "added or taken off. Do section 3 of the preflight list before you use them, and write what it shows "
            "into the machine file."
        )
    own = [
        AXES[axis]
        for axis, item in sorted(tables.lists.items())
        if item.plane is not None and axis in item.plane.masters
    ]
    if own:
        found.append(
            f"the plane of {', '.join(own)} has its own slave as a master: documented for the older CNC builds"
        )
    if any(item.cross is None and item.plane is None for item in tables.lists.values()):
        idle = [AXES[axis] for axis, item in tables.lists.items() if not _moves(item)]
        found += [f"the tables of {', '.join(idle)} are zero everywhere"] * bool(idle)
    return found


def _moves(item: AxisList) -> bool:
    if item.cross or item.plane:
        return True
    return item.screw is not None and bool(
        np.any(item.screw.pos) or (item.screw.neg is not None and np.any(item.screw.neg))
    )
