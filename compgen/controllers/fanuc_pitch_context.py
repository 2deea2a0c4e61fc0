"""What the templates of stored pitch error compensation show: records, plan, parameters to set, worked numbers."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.fanuc_pitch_settings import PitchSettings
from compgen.controllers.fanuc_pitch_tables import (
    MOST_MISSED,
    PARAMETERS,
    PitchBlock,
    PitchTables,
    shortfall_text,
)
from compgen.core.csvio import fixed
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.reversal import WORTH_MM, ReversalCurves

MEANINGS = (
    "point number at the reference point",
    "farthest point number on the negative side",
    "farthest point number on the positive side",
    "magnification",
    "interval",
)


def pitch_context(machine: Machine, settings: PitchSettings, tables: PitchTables) -> dict[str, Any]:
    """Return the context beyond the common one; ``plan`` holds point number -> value for a binary transfer."""
    present = [(axis, block) for axis, block in enumerate(tables.blocks) if block is not None]
    records = _records(settings, present)
    points = {block.first + k: value for _, block in present for k, value in enumerate(block.values)}
    return {
        "sign_statement": _sign_statement(settings),
        "parameters": _preflight_parameters(settings, present),
        "warnings": [
            *_warnings(settings, present),
            *(shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts <= MOST_MISSED),
        ],
        "tables": [_summary(machine, axis, block) for axis, block in present],
        "style": settings,
        "records": records,
        "points": [{"number": settings.number_base + number, "value": value} for number, value in points.items()],
        "plan": {
            "parameters": {record["number"]: {a["axis"]: a["value"] for a in record["axes"]} for record in records},
            "points": points,
            "value_type": settings.value_type,
            "stores": settings.stores,
            "detection_unit_um": settings.detection_unit_um,
        },
        "check": _check(machine, settings, *present[0]) if present else None,
    }


def _interval_text(settings: PitchSettings, interval_mm: Decimal) -> str:
    """Interval as it is written, e.g. ``50.0``, or a whole number of the machine file's unit."""
    if not settings.real_point:
        return str(int(interval_mm / settings.interval_quantum_mm))
    text = f"{interval_mm:f}"
    return text if "." in text else f"{text}.0"


def _parameter_values(settings: PitchSettings, block: PitchBlock) -> tuple[str, ...]:
    whole = (block.reference, block.first, block.last, block.magnification)
    return (*map(str, whole), _interval_text(settings, block.interval_mm))


def _records(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[dict[str, Any]]:
    """Parameters 3620 ... 3624 in order, each with its axes in ascending axis number, values as text."""
    columns = sorted((settings.axis_numbers[axis], _parameter_values(settings, block)) for axis, block in present)
    return [
        {"number": parameter, "axes": [{"axis": number, "value": values[k]} for number, values in columns]}
        for k, parameter in enumerate(PARAMETERS)
    ]


def _preflight_parameters(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[dict[str, str]]:
    rows = [
        {"name": f"{number} ({AXES[axis]}, A{settings.axis_numbers[axis]})", "value": value, "meaning": meaning}
        for axis, block in present
        for number, value, meaning in zip(PARAMETERS, _parameter_values(settings, block), MEANINGS, strict=True)
    ]
    linear = settings.interpolation == "linear"
    rows += [
        {"name": "3605#0", "value": "0", "meaning": "bi-directional pitch compensation off, for X, Y and Z"},
        {
            "name": "3602#0 (APE)",
            "value": "total" if settings.total else "incremental",
            "meaning": "type of the values; which bit value means which is to be read in the parameter manual",
        },
        {
            "name": "3605#2 (IPP)",
            "value": "on" if linear else "off",
            "meaning": f"interpolated pitch compensation; the files were checked as {settings.interpolation}",
        },
    ]
    return rows


def _sign_statement(settings: PitchSettings) -> str:
    count_um = settings.count_mm / MM_PER_UM
    stored = "the correction, which the control adds" if settings.stores == "correction" else "the error"
    kind = (
        "A value is the sum up to its point"
        if settings.total
        else "A value is the change over its section, seen in the positive direction"
    )
    return (
        f"The numbers are {stored}; one count is {count_um:g} um (magnification {settings.magnification} times "
        f"detection unit {settings.detection_unit_um:g} um). {kind}. An axis that travels {2 * count_um:g} um too "
        f"short over a section in the positive direction gets {2 * settings.sign:+d} there."
    )


def _warnings(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[str]:
    found = ["The sign of the values is not settled by public documents: check it at one section first (part 3)."]
    if settings.interpolation == "staircase":
        worst = max((int(np.max(np.abs(np.diff(block.curve)))) for _, block in present), default=0)
        found.append(
            f"Where inside a section the plain type puts its pulses out is not documented: between section ends the "
            f"correction may be off by up to {fixed(worst * settings.count_mm / MM_PER_UM, 1)} um."
        )
    if settings.max_feed_mm_min is None and present:
        shortest = min(float(block.interval_mm) for _, block in present)
        found.append(
            f"max_feed_mm_min is not in the machine file. By the rule interval >= feed / 7500 the shortest interval of "
            f"{shortest:g} mm allows {7500 * shortest:.0f} mm/min."
        )
    return found


def _summary(machine: Machine, axis: int, block: PitchBlock) -> dict[str, Any]:
    """One axis in numbers, for preflight: where its table lies and how large its values are."""
    ends_mm = machine.reference_point_mm[axis] + block.curve_mm
    return {
        "axis": AXES[axis],
        "reference": block.reference,
        "first": block.first,
        "last": block.last,
        "interval_mm": float(block.interval_mm),
        "first_mm": float(ends_mm[0]),
        "last_mm": float(ends_mm[-1]),
        "largest_step": int(np.max(np.abs(np.diff(block.curve)), initial=0)),
        "largest_sum": int(np.max(np.abs(block.curve))),
    }


def _check(machine: Machine, settings: PitchSettings, axis: int, block: PitchBlock) -> dict[str, Any]:
    """A trial of one section next to the reference point: which number to set, and what a laser must then read."""
    upper = block.last > block.reference
    start_mm = machine.reference_point_mm[axis] - (0.0 if upper else float(block.interval_mm))
    counts = min(5, settings.increment_limit)
    # Below the reference point an increment belongs to the section's upper end, a total value to its lower end.
    number = block.reference + (1 if upper else -1 if block.total else 0)
    return {
        "axis": AXES[axis],
        "record": settings.number_base + number,
        "number": number,
        "from_mm": start_mm,
        "to_mm": start_mm + float(block.interval_mm),
        "counts": -counts if block.total and not upper else counts,
        "change_um": settings.sign * counts * block.magnification * settings.detection_unit_um,
        "interval_mm": float(block.interval_mm),
        "short_mm": float(block.interval_mm) - 2 * settings.count_mm,
        "short_counts": 2 * settings.sign,
    }


def backlash_rows(settings: PitchSettings, reversal: ReversalCurves) -> list[dict[str, str]]:
    """Return parameter 1851 for the mean reversal of each axis along itself, in detection units.

    Source: parameter manuals B-63090EN p. 97, B-64120EN p. 116: added in the direction of movement, -9999 to +9999;
    an axis that stops short (reversal value below zero) gets a positive value.
    """
    return [
        {
            "name": f"1851 ({AXES[axis]}, A{settings.axis_numbers[axis]})",
            "value": str(round(-reversal.mean_mm(axis) / (settings.detection_unit_um * MM_PER_UM))),
            "meaning": "backlash compensation in detection units: minus the mean reversal value; these tables act in both "
            "directions alike. If a value was active while the machine was measured, add this one to it",
        }
        for axis in range(3)
        if abs(reversal.mean_mm(axis)) >= WORTH_MM
    ]
