"""Limits of stored pitch error compensation: what tables break, how much of each limit they use."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from compgen.controllers.base import Usage, coverage_violations
from compgen.controllers.fanuc.pitch_settings import PitchSettings
from compgen.controllers.fanuc.pitch_tables import MOST_TOTAL, PitchBlock, PitchTables, Shortfall
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: A table that misses by more counts than this because its steps are limited is not acceptable.
MOST_MISSED = 1.0


def pitch_violations(machine: Machine, settings: PitchSettings, tables: PitchTables) -> list[str]:
    """Return every limit that the tables break, and travel that they leave out, in words."""
    messages = []
    for axis, block in enumerate(tables.blocks):
        if block is None:
            messages.append(f"{AXES[axis]} has no pitch table: none of its travel is covered")
        else:
            messages += _block_violations(settings, AXES[axis], block)
            first_mm, last_mm = machine.reference_point_mm[axis] + block.curve_mm[[0, -1]]
            messages += coverage_violations(machine, axis, first_mm, last_mm, f"the pitch table of {AXES[axis]}")
    messages += [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > MOST_MISSED]
    for axis_number, total in tables.turns:
        if total:
            messages.append(
                f"the values of the rotary axis A{axis_number} sum to {total} counts over a revolution; they must sum to 0, "
                f"else every revolution adds to the error"
            )
    return messages + _overlaps(tables)


def shortfall_text(settings: PitchSettings, shortfall: Shortfall) -> str:
    """Say that the limit of the change per section keeps a table from what was wanted, and what helps."""
    numbers = ", ".join(map(str, shortfall.sections[:5])) + (", ..." if len(shortfall.sections) > 5 else "")
    return (
        f"{AXES[shortfall.axis]}: the wanted curve is too steep, the limit is {settings.increment_limit} counts per "
        f"section: {len(shortfall.sections)} sections are full (points {numbers}), and even the best table misses by up "
        f"to {shortfall.missed_counts * settings.count_mm(shortfall.axis) / MM_PER_UM:.1f} um; a shorter interval or a larger "
        f"magnification is needed"
    )


def _block_violations(settings: PitchSettings, name: str, block: PitchBlock) -> list[str]:
    messages = _value_violations(settings, name, block)
    if block.last > settings.last_number:
        messages.append(
            f"{name}: the points {block.first} to {block.last} go beyond the last number {settings.last_number}"
        )
    if block.negative and block.negative_first + len(block.negative) - 1 > settings.negative_last_number:
        messages.append(
            f"{name}: the points for travel in negative direction, from {block.negative_first} on, go beyond the last "
            f"number {settings.negative_last_number}"
        )
    if block.negative and block.magnification != 1:
        messages.append(f"{name}: whether 3627 counts with the magnification {block.magnification} is not documented")
    if block.magnification == 0:
        messages.append(f"{name}: the magnification is 0, which switches the table off")
    if float(block.interval_mm) < settings.least_interval_mm - 1e-9:
        messages.append(
            f"{name}: the interval {block.interval_mm:f} mm is shorter than the {settings.least_interval_mm:g} mm that "
            f"{settings.max_feed_mm_min:g} mm/min need"
        )
    return messages


def _value_violations(settings: PitchSettings, name: str, block: PitchBlock) -> list[str]:
    messages = []
    for curve, way in zip(block.curves(1), ("", " in negative travel"), strict=True):
        steps = np.abs(np.diff(curve))
        if steps.size and steps.max() > settings.increment_limit and (block.negative or not way):
            worst = int(np.argmax(steps))
            messages.append(
                f"{name}: the change over section {block.curve_numbers[worst + 1]}{way} is {steps[worst]} counts, the limit "
                f"is {settings.increment_limit}; a shorter interval or a larger magnification is needed"
            )
    if block.total and max(map(abs, block.values)) > MOST_TOTAL:
        most = max(map(abs, block.values))
        messages.append(f"{name}: a total value of {most} counts does not fit 16 bits ({MOST_TOTAL})")
    if block.total and block.values[block.reference - block.first] != 0:
        messages.append(f"{name}: the total value at the reference point {block.reference} must be 0")
    return messages


def _overlaps(tables: PitchTables) -> list[str]:
    spans = [(AXES[k], block.first, block.last) for k, block in enumerate(tables.blocks) if block is not None]
    spans += [
        (f"{AXES[k]} in negative travel", block.negative_first, block.negative_first + len(block.negative) - 1)
        for k, block in enumerate(tables.blocks)
        if block is not None and block.negative
    ]
    spans += [(f"axis A{number}", first, last) for number, first, last in tables.others]
    return [
        f"the compensation points of {a} ({a_first} to {a_last}) and {b} ({b_first} to {b_last}) overlap"
        for (a, a_first, a_last), (b, b_first, b_last) in combinations(spans, 2)
        if a_first <= b_last and b_first <= a_last
    ]


def pitch_usage(settings: PitchSettings, tables: PitchTables) -> list[Usage]:
    """Return the largest change over a section, the point numbers and the interval against their limits."""
    found, used = [], 0
    for axis, block in enumerate(tables.blocks):
        if block is None:
            continue
        used += len(block.values)
        step = max(int(np.max(np.abs(np.diff(curve)), initial=0)) for curve in block.curves(1))
        found.append(Usage(f"change over a section of {AXES[axis]}", step, settings.increment_limit, "counts"))
        if settings.max_feed_mm_min is not None:
            least, own = settings.least_interval_mm, float(block.interval_mm)
            found.append(Usage(f"shortest section at the feed, {AXES[axis]}", least, own, "mm"))
    numbers = settings.last_number - settings.first_number + 1
    return [*found, Usage("compensation points", used, numbers, "points")]
