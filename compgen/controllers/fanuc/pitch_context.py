"""What the templates of stored pitch error compensation show: records, plan, parameters to set, worked numbers."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.fanuc.pitch_limits import MOST_MISSED, shortfall_text
from compgen.controllers.fanuc.pitch_settings import PitchSettings
from compgen.controllers.fanuc.pitch_tables import (
    AT_REFERENCE,
    INTERVAL,
    NEGATIVE_FIRST,
    PARAMETERS,
    PitchBlock,
    PitchTables,
)
from compgen.controllers.fanuc.sample import Sample
from compgen.controllers.fanuc.style import Punched
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
    "farthest point number on the negative side for travel in negative direction",
    "value at the reference point when it is reached against the direction of the reference return",
)


def pitch_context(machine: Machine, settings: PitchSettings, tables: PitchTables) -> dict[str, Any]:
    """Return the context beyond the common one; ``plan`` holds point number -> value for a binary transfer."""
    present = [(axis, block) for axis, block in enumerate(tables.blocks) if block is not None]
    records = _records(settings, present)
    punched = _punched(settings, present)
    points = {number: value for _, block in present for number, value in block.points()}
    return {
        "sign_statement": _sign_statement(settings),
        "parameters": _preflight_parameters(settings, present),
        "warnings": [
            *_warnings(settings, present),
            *(shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts <= MOST_MISSED),
        ],
        "tables": [_summary(machine, settings, axis, block) for axis, block in present],
        "style": settings,
        "records": records,
        "file": punched,
        "parameter_file": _parameter_file(settings, present),
        "container": "separate" if settings.sample.points_style is not None else "one file",
        "separate": settings.sample.points_style is not None,
        "overwrites": _overwrites(settings, present),
        "has_sample": settings.sample.shows_points,
        "style_notes": list(settings.style_notes),
        "bidirectional": settings.bidirectional,
        "points": [{"number": settings.number_base + number, "value": value} for number, value in points.items()],
        "plan": {
            "parameters": {record["number"]: {a["axis"]: a["value"] for a in record["axes"]} for record in records},
            "points": points,
            "value_type": settings.value_type,
            "bidirectional": settings.bidirectional,
            "stores": settings.stores,
            "detection_unit_um": settings.detection_unit_um,
        },
        "check": _check(machine, settings, *present[0]) if present else None,
    }


def _interval_text(settings: PitchSettings, interval_mm: Decimal) -> str:
    """Interval as it is written, e.g. ``50.0``, or a whole number of the machine file's unit."""
    real = settings.style.real_point
    return settings.style.length(interval_mm if real else interval_mm / settings.interval_quantum_mm)


def _parameter_values(settings: PitchSettings, block: PitchBlock) -> tuple[str, ...]:
    whole = settings.style.whole
    numbers = (block.reference, block.first, block.last, block.magnification)
    found = (*map(whole, numbers), _interval_text(settings, block.interval_mm))
    return (*found, whole(block.negative_first), whole(block.at_reference)) if settings.bidirectional else found


def _numbers(settings: PitchSettings) -> tuple[int, ...]:
    return (*PARAMETERS, NEGATIVE_FIRST, AT_REFERENCE) if settings.bidirectional else PARAMETERS


def _parameter_records(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[str]:
    style, parameters = settings.style, []
    columns = [(settings.axis_numbers[axis], _parameter_values(settings, block)) for axis, block in present]
    for k, number in enumerate(_numbers(settings)):
        letter = style.real_letter if number == INTERVAL else "P"
        parameters += style.parameter(number, [(axis, values[k]) for axis, values in columns], letter)
    return parameters if present else []


def _punched(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> Punched:
    """Text of the file in its style: parameters by number unless they have a file of their own, points by number."""
    style, separate = settings.style, settings.sample.points_style
    points = [
        (separate or style).point(*pair) for pair in sorted(pair for _, block in present for pair in block.points())
    ]
    if separate is not None:
        return Punched(separate.file([], points))
    return Punched(style.file(_parameter_records(settings, present), points))


def _parameter_file(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> Punched | None:
    """Text of the file of the parameters, where the sample has parameters and points in files of their own."""
    if settings.sample.points_style is None:
        return None
    return Punched(settings.style.file(_parameter_records(settings, present), []))


def _overwrites(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[str]:
    """Say what the files overwrite, other axes first."""
    sample, written = settings.sample, [settings.axis_numbers[axis] for axis, _ in present]
    others = [
        f"A{number}: points {low} to {high}"
        for number, axis in sample.axes.items()
        if number not in written
        for low, high in axis.spans
    ]
    if sample.shows_points:
        told = (
            f"The sample has {'; '.join(others)}; they stay." if others else "No other axis of the sample has points."
        )
        found = [f"Of other axes: nothing. {told}"]
    else:
        given = (
            "the sample has no parameters 3620 to 3622" if settings.style_notes else "no file of this control was given"
        )
        found = [
            f"Of other axes: NOT KNOWN, {given} (`--style-from`). An axis whose 3621 to 3622 meet the points below loses its "
            "table."
        ]
    for axis, block in present:
        number, name = settings.axis_numbers[axis], f"{AXES[axis]} (A{settings.axis_numbers[axis]})"
        values = zip(_numbers(settings), _parameter_values(settings, block), strict=True)
        found.append(f"Parameters of {name}: " + ", ".join(_change(sample, p, number, text) for p, text in values))
        spans = [(block.first, block.last)]
        if block.negative:
            spans.append((block.negative_first, block.negative_first + len(block.negative) - 1))
        texts = [
            f"{low} to {high} (N{settings.number_base + low} to N{settings.number_base + high})" for low, high in spans
        ]
        old = {key: sample.values[key] for key, _ in block.points() if key in sample.values}
        changed = sum(1 for key, value in block.points() if key in old and old[key] != value)
        told = f"; {changed} of them differ from the sample" if old else ""
        found.append(f"Points of {name}: {' and '.join(texts)}{told}")
    return found


def _change(sample: Sample, parameter: int, axis: int, text: str) -> str:
    """A parameter with its value, and that of the sample if it is another one."""
    old = sample.parameters.get((parameter, axis))
    same = old is None or Decimal(old[0]) == Decimal(text)
    return f"{parameter} = {text}" if same else f"{parameter} = {text} (sample: {old[0] if old else ''})"


def _records(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[dict[str, Any]]:
    """Parameters 3620 ... in order, each with its axes in ascending axis number, values as text."""
    columns = sorted((settings.axis_numbers[axis], _parameter_values(settings, block)) for axis, block in present)
    return [
        {"number": parameter, "axes": [{"axis": number, "value": values[k]} for number, values in columns]}
        for k, parameter in enumerate(_numbers(settings))
    ]


def _preflight_parameters(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[dict[str, str]]:
    rows = [
        {"name": f"{number} ({AXES[axis]}, A{settings.axis_numbers[axis]})", "value": value, "meaning": meaning}
        for axis, block in present
        for number, value, meaning in zip(
            _numbers(settings), _parameter_values(settings, block), MEANINGS, strict=False
        )
    ]
    linear = settings.interpolation == "linear"
    rows += [
        {
            "name": "3605#0",
            "value": str(int(settings.bidirectional)),
            "meaning": f"bi-directional pitch compensation {'on' if settings.bidirectional else 'off'}, for X, Y and Z",
        },
        {
            "name": "3602#0 (APE)",
            "value": "total" if settings.total else "incremental",
            "meaning": "type of the values; which bit value means which is to be read in the parameter manual",
        },
        {
            "name": "3605, interpolated type",
            "value": "on" if linear else "off",
            "meaning": f"interpolated pitch compensation; the files were checked as {settings.interpolation}. Bit 1 is set on "
            "a 30i that was seen, bit 2 (IPP) is remembered: read the parameter manual, and leave the bits as the backup has them"
            + _bits_of_sample(settings, present),
        },
    ]
    return rows + (_directional_rows(settings, present) if settings.bidirectional else [])


def _bits_of_sample(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> str:
    """3605 of the axes in the sample, in words."""
    numbers = [(AXES[axis], settings.axis_numbers[axis]) for axis, _ in present]
    found = [f"{name} {bits}" for name, number in numbers if (bits := settings.sample.bits(3605, number)) is not None]
    return f"; the sample has {', '.join(found)} (bit 7 first)" if found else ""


def _directional_rows(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[dict[str, str]]:
    """Reference return as the tables take it, and backlash, which the tables of both directions hold already."""
    rows = []
    for axis, _ in present:
        name, towards = f"({AXES[axis]}, A{settings.axis_numbers[axis]})", settings.reference_return[axis] > 0
        rows += [
            {
                "name": f"1006#5 (ZMI) {name}",
                "value": "0" if towards else "1",
                "meaning": f"reference return in {'positive' if towards else 'negative'} direction, as the tables take it; "
                "if the control has another value, set reference_return in the machine file: the reversal would double",
            },
            *(
                {"name": f"{number} {name}", "value": "0", "meaning": "the tables of both directions hold the backlash"}
                for number in (1851, 1852)
            ),
        ]
    return rows


def _sign_statement(settings: PitchSettings) -> str:
    stored = "the correction, which the control adds" if settings.stores == "correction" else "the error"
    kind = (
        "A value is the sum up to its point"
        if settings.total
        else "A value is the change over its section, seen in the positive direction"
    )
    count_um, other = settings.count_mm(0) / MM_PER_UM, ""
    if len(set(settings.magnifications)) > 1:
        other = " of X; " + ", ".join(f"{settings.count_mm(k) / MM_PER_UM:g} um of {AXES[k]}" for k in (1, 2))
    return (
        f"The numbers are {stored}; one count is {count_um:g} um{other} (magnification "
        f"{', '.join(map(str, dict.fromkeys(settings.magnifications)))} times detection unit "
        f"{settings.detection_unit_um:g} um). {kind}. An X axis that travels {2 * count_um:g} um too "
        f"short over a section in the positive direction gets {2 * settings.sign:+d} there."
        + (_directional_statement(settings) if settings.bidirectional else "")
    )


def _directional_statement(settings: PitchSettings) -> str:
    return (
        " Points from 3621 to 3622 act in travel in positive direction, as many from 3626 on in negative direction, their "
        "values seen in the positive direction as well. With a reference return in positive direction an axis that stops "
        f"{settings.count_mm(0) / MM_PER_UM:g} um farther after positive than after negative travel gets "
        f"{settings.sign:+d} in 3627."
    )


def _warnings(settings: PitchSettings, present: list[tuple[int, PitchBlock]]) -> list[str]:
    found = ["The sign of the values is not settled by public documents: check it at one section first (part 3)."]
    for axis, block in present:
        if settings.kept[axis] is not None:
            found.append(
                f"The points {block.first} to {block.last} of {AXES[axis]}, their interval {block.interval_mm:f} mm and the "
                f"magnification {block.magnification} are those of the sample; interval_mm or first_numbers in the machine file "
                f"lay them out anew."
            )
    if settings.style_notes:
        found.append("The style was taken from the sample: " + "; ".join(settings.style_notes) + ".")
    if settings.bidirectional:
        found.append(
            "Bi-directional: 3627 (value at the reference point reached against the reference return) and the numbers of "
            "the points for negative travel are not settled by public documents; check both directions at the machine."
        )
    if settings.interpolation == "staircase":
        worst_mm = max((int(np.max(np.abs(np.diff(b.curve)))) * settings.count_mm(k) for k, b in present), default=0.0)
        found.append(
            f"Where inside a section the plain type puts its pulses out is not documented: between section ends the "
            f"correction may be off by up to {fixed(worst_mm / MM_PER_UM, 1)} um."
        )
    if settings.max_feed_mm_min is None and present:
        shortest = min(float(block.interval_mm) for _, block in present)
        found.append(
            f"max_feed_mm_min is not in the machine file. By the rule interval >= feed / 7500 the shortest interval of "
            f"{shortest:g} mm allows {7500 * shortest:.0f} mm/min."
        )
    return found


def _summary(machine: Machine, settings: PitchSettings, axis: int, block: PitchBlock) -> dict[str, Any]:
    """One axis in numbers, for preflight: where its table lies and how large its values are."""
    curves = block.curves(settings.reference_return[axis])
    ends_mm = machine.reference_point_mm[axis] + block.curve_mm
    return {
        "axis": AXES[axis],
        "reference": block.reference,
        "first": block.first,
        "last": block.last,
        "interval_mm": float(block.interval_mm),
        "first_mm": float(ends_mm[0]),
        "last_mm": float(ends_mm[-1]),
        "largest_step": max(int(np.max(np.abs(np.diff(curve)), initial=0)) for curve in curves),
        "largest_sum": max(int(np.max(np.abs(curve))) for curve in curves),
        "negative_first": block.negative_first,
        "negative_last": block.negative_first + len(block.negative) - 1,
        "at_reference": block.at_reference,
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
        "short_mm": float(block.interval_mm) - 2 * settings.count_mm(axis),
        "short_counts": 2 * settings.sign,
    }


def backlash_rows(settings: PitchSettings, reversal: ReversalCurves) -> list[dict[str, str]]:
    """Return parameters 1851 and 1852 for the mean reversal of each axis along itself, in detection units.

    Source: parameter manuals B-63090EN p. 97, B-64120EN p. 116: added in the direction of movement, -9999 to +9999;
    an axis that stops short (reversal value below zero) gets a positive value.
    """
    meanings = {
        1851: "backlash compensation in detection units: minus the mean reversal value; these tables act in both "
        "directions alike. If a value was active while the machine was measured, add this one to it",
        1852: "the same in rapid traverse, if the control keeps it apart (1800#4, RBK = 1)",
    }
    return [
        {
            "name": f"{number} ({AXES[axis]}, A{settings.axis_numbers[axis]})",
            "value": str(round(-reversal.mean_mm(axis) / (settings.detection_unit_um * MM_PER_UM))),
            "meaning": meaning,
        }
        for axis in range(3)
        for number, meaning in meanings.items()
        if abs(reversal.mean_mm(axis)) >= WORTH_MM
    ]
