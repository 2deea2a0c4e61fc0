"""What the templates of straightness compensation show: records, plan, parameters to set, worked numbers."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.fanuc.straightness_settings import StraightnessSettings
from compgen.controllers.fanuc.straightness_tables import (
    COMPENSATED,
    ENTRIES,
    GRID_PARAMETERS,
    MOVING,
    StraightTable,
    StraightTables,
    entry_numbers,
    free_entries,
)
from compgen.controllers.fanuc.style import Punched
from compgen.core.csvio import fixed
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM


def straightness_context(machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> dict[str, Any]:
    """Return the context beyond the common one."""
    common = _common(settings, tables)
    grids = _grids(settings, tables, settings.stated)
    assumed = _grids(settings, tables, settings.assumed)
    not_written = _grids(settings, tables, tuple(not stated for stated in settings.stated))
    return {
        "sign_statement": _sign_statement(machine, settings, tables),
        "parameters": _rows(settings, tables, common, grids, not_written),
        "warnings": _warnings(settings, tables),
        "tables": [_summary(machine, settings, entry) for entry in tables.entries],
        "settings": settings,
        "style_notes": list(settings.sample.notes),
        "overwrites": _overwrites(settings, common, grids, not_written),
        "file": _punched(settings, common, grids),
        "points_file": _punched(settings, {}, assumed),
        "container": "assumed points" if assumed else "points known",
        "not_written": bool(not_written),
        "switches": [MOVING + k for k in free_entries(settings)[0]],
        "plan": {
            "common": common,
            "axes": {number: {axis: text for axis, text in values} for number, values in grids.items()},
            "stores": settings.stores,
            "detection_unit_um": settings.detection_unit_um,
        },
        "check": _check(machine, settings, tables) if tables.entries else None,
    }


def _common(settings: StraightnessSettings, tables: StraightTables) -> dict[int, int]:
    """Parameter number -> value of the entries; one of X, Y, Z in the sample that is no longer used gets 0."""
    found: dict[int, int] = {}
    free, _ = free_entries(settings)
    for k, entry in zip(free, tables.entries, strict=False):
        axes = (settings.axis_numbers[entry.moving], settings.axis_numbers[entry.compensated])
        found.update(zip(entry_numbers(k), (*axes, *entry.numbers, *entry.amounts), strict=True))
    for k in free[len(tables.entries) :]:
        if Decimal(settings.sample.common.get(MOVING + k, ("0",))[0]):
            found[MOVING + k] = 0
    return dict(sorted(found.items()))


def _overwrites(
    settings: StraightnessSettings,
    common: dict[int, int],
    grids: dict[int, list[tuple[int, str]]],
    not_written: dict[int, list[tuple[int, str]]],
) -> list[str]:
    """Say what the file overwrites, other axes first."""
    sample, names = settings.sample, dict(zip(settings.axis_numbers, AXES, strict=True))
    kept = [
        f"entry {k + 1} (A{sample.common[MOVING + k][0]} moves, {COMPENSATED + k} = {sample.common[COMPENSATED + k][0]})"
        for k in ENTRIES
        if k not in free_entries(settings)[0] and COMPENSATED + k in sample.common
    ]
    if any(MOVING + k in sample.common for k in ENTRIES):
        found = [f"Of other axes: nothing{'; ' + ', '.join(kept) + ' stays' if kept else ''}."]
    else:
        given = "the sample has no parameters 5711 to 5713" if sample.notes else "no file of this control was given"
        found = [f"Of other axes: NOT KNOWN, {given} (`--style-from`): look at 5711 to 5723."]
    for number, values in grids.items():
        texts = [f"{names[axis]} (A{axis}) = {text}" for axis, text in values]
        found.append(f"{number}, which pitch error compensation uses as well: {', '.join(texts)}")
    if not_written:
        letters = ", ".join(names[axis] for axis, _ in not_written[GRID_PARAMETERS[0]])
        found.append(f"NOT written: 3620, 3621, 3622 and 3624 of {letters}, which belong to pitch error compensation")
    old = {number: sample.common[number][0] for number in common if number in sample.common}
    changed = [
        f"{number} = {common[number]} (sample: {old[number]})"
        for number in common
        if number in old and Decimal(old[number]) != common[number]
    ]
    found.append(
        f"Straightness: {', '.join(map(str, common))}" + (f"; changed: {', '.join(changed)}" if changed else "")
    )
    return found


def _grids(
    settings: StraightnessSettings, tables: StraightTables, chosen: Sequence[bool]
) -> dict[int, list[tuple[int, str]]]:
    """Parameters 3620 ... of the ``chosen`` ones of the moving axes: number -> (axis number, value as text)."""
    style = settings.style
    entries = [entry for entry in tables.entries if chosen[entry.moving]]
    found: dict[int, list[tuple[int, str]]] = {number: [] for number in GRID_PARAMETERS} if entries else {}
    for entry in entries:
        grid, axis = entry.grid, settings.axis_numbers[entry.moving]
        unit = Decimal(1) if style.real_point else Decimal(repr(settings.interval_unit_mm))
        length = style.length(grid.interval_mm / unit)
        texts = (*map(style.whole, (grid.reference, grid.first, grid.last)), length)
        for number, text in zip(GRID_PARAMETERS, texts, strict=True):
            found[number].append((axis, text))
    return {number: sorted(values) for number, values in found.items()}


def _punched(
    settings: StraightnessSettings, common: dict[int, int], grids: dict[int, list[tuple[int, str]]]
) -> Punched:
    style, records = settings.style, []
    for number, values in grids.items():
        records += style.parameter(number, values, style.real_letter if number == GRID_PARAMETERS[3] else "P")
    records += [style.common(number, value) for number, value in common.items()]
    return Punched(style.file(records, []))


def _sign_statement(machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> str:
    stored = "the correction, which the control adds" if settings.stores == "correction" else "the error"
    text = (
        f"The amounts are {stored} to the command of the compensated axis; one count is {settings.detection_unit_um:g} um. "
        f"Linear between the four points, zero outside."
    )
    for entry in tables.entries[:1]:
        k = int(np.argmax(np.abs(entry.amounts)))
        moved = settings.sign * entry.amounts[k] * settings.detection_unit_um
        at = machine.reference_point_mm[entry.moving] + entry.along_mm[k]
        text += (
            f" At point {entry.numbers[k]}, {AXES[entry.moving]} = {at:g} mm, the amount {entry.amounts[k]:+d} moves "
            f"{AXES[entry.compensated]} by {moved:+g} um."
        )
    return text


def _rows(
    settings: StraightnessSettings,
    tables: StraightTables,
    common: dict[int, int],
    grids: dict[int, list[tuple[int, str]]],
    not_written: dict[int, list[tuple[int, str]]],
) -> list[dict[str, str]]:
    names = dict(zip(settings.axis_numbers, AXES, strict=True))
    meanings = dict(
        zip(GRID_PARAMETERS, ("point at the reference point", "first point", "last point", "interval"), strict=True)
    )
    rows = [
        {
            "name": f"{number} ({names[axis]}, A{axis})",
            "value": text,
            "meaning": f"{meanings[number]}; must be the value that stored pitch error compensation uses{behind}",
        }
        for part, behind in ((grids, ""), (not_written, ". COMPARE: not in `STRAIGHT.TXT`"))
        for number, values in part.items()
        for axis, text in values
    ]
    free, _ = free_entries(settings)
    for k, entry in zip(free, tables.entries, strict=False):
        words = [
            "moving axis",
            "compensated axis",
            *(f"point {n}" for n in "abcd"),
            *(f"amount at {n}" for n in "abcd"),
        ]
        rows += [
            {"name": str(number), "value": str(common[number]), "meaning": f"{entry.name}: {word}"}
            for number, word in zip(entry_numbers(k), words, strict=True)
        ]
    rows += [
        {"name": str(MOVING + k), "value": "0", "meaning": "no moving axis: this entry is not used"}
        for k in free[len(tables.entries) :]
    ]
    return rows


def _warnings(settings: StraightnessSettings, tables: StraightTables) -> list[str]:
    found = ["Sign, range and parameter numbers are not settled by public documents: check one entry first (part 3)."]
    if settings.sample.notes:
        found.append("The style was taken from the sample: " + "; ".join(settings.sample.notes) + ".")
        if not settings.sample.common:
            found.append("The sample has no parameters 5711 to 5799: whether they need a word L is NOT confirmed.")
    for entry in tables.entries:
        grid = entry.grid
        if not settings.stated[entry.moving]:
            source = "those of [controllers.fanuc-pitch]" if settings.of_pitch[entry.moving] else "assumed"
            found.append(
                f"The compensation points of {AXES[entry.moving]} are {source}: {grid.first} to {grid.last}, reference point "
                f"{grid.reference}, every {grid.interval_mm:f} mm. The table is right on a control that has exactly these; if "
                f"it has others, give its file with --style-from, or state points.{AXES[entry.moving]}, and export again."
            )
        ends = [settings.sign * entry.amounts[k] * settings.count_mm / MM_PER_UM for k in (0, 3)]
        if any(ends):
            found.append(
                f"{entry.name}: beyond its outer points the control is taken to drop to zero, a step of {fixed(ends[0], 1)} "
                f"and {fixed(ends[1], 1)} um."
            )
    return found


def _summary(machine: Machine, settings: StraightnessSettings, entry: StraightTable) -> dict[str, Any]:
    knots = machine.reference_point_mm[entry.moving] + entry.along_mm
    return {
        "name": entry.name,
        "knots": [
            {"number": number, "mm": float(mm), "amount": amount}
            for number, mm, amount in zip(entry.numbers, knots, entry.amounts, strict=True)
        ],
    }


def _check(machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> dict[str, Any]:
    """A trial of one entry: all amounts 0 but one, and what the compensated axis must do there."""
    counts, place, entry = 10, free_entries(settings)[0][0], tables.entries[0]
    amounts = entry_numbers(place)[6:]
    return {
        "moving": AXES[entry.moving],
        "compensated": AXES[entry.compensated],
        "parameter": amounts[1],
        "amounts": f"{amounts[0]} to {amounts[-1]}",
        "counts": counts,
        "at_mm": float(machine.reference_point_mm[entry.moving] + entry.along_mm[1]),
        "zero_mm": float(machine.reference_point_mm[entry.moving] + entry.along_mm[2]),
        "change_um": settings.sign * counts * settings.detection_unit_um,
    }
