"""Settings of ``[controllers.fanuc-straightness]``: what is compensated, the point numbers, the style of the file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import ROUND_CEILING, Decimal
from typing import Any, Literal

from compgen.controllers.fanuc.sample import take_length_unit_mm, take_style
from compgen.controllers.fanuc.style import FanucStyle
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Sections of a travel where the user does not say which compensation points the control has.
SECTIONS = 100


@dataclass(frozen=True)
class PointGrid:
    """Compensation points of one axis: point n stands at the reference point plus (n - ``reference``) intervals.

    The same numbers as in stored pitch error compensation: parameters 3620 (``reference``), 3621 and 3622 (``first`` and
    ``last``), 3624 (``interval_mm``).
    """

    reference: int
    first: int
    last: int
    interval_mm: Decimal

    def along_mm(self, number: int) -> float:
        """Position of a point from the reference point, mm."""
        return float((number - self.reference) * self.interval_mm)


@dataclass(frozen=True)
class StraightnessSettings:
    """Settings of straightness compensation.

    Parameters
    ----------
    detection_unit_um : one count of the compensation amounts.
    stores : whether the amounts are the correction (added to the command) or the error.
    pairs : (compensated axis, moving axis), 0..2; None: the best ones are chosen.
    grids : compensation points of X, Y, Z; ``stated`` tells which of them the user gave.
    amount_limit : largest magnitude of an amount.
    axis_numbers : controlled axis numbers of X, Y, Z.
    style, style_notes, interval_unit_mm : as in :class:`compgen.controllers.fanuc.pitch_settings.PitchSettings`.
    """

    detection_unit_um: float
    stores: Literal["correction", "error"]
    pairs: tuple[tuple[int, int], ...] | None
    grids: tuple[PointGrid, PointGrid, PointGrid]
    stated: tuple[bool, bool, bool]
    amount_limit: int
    axis_numbers: tuple[int, int, int]
    style: FanucStyle
    style_notes: tuple[str, ...]
    interval_unit_mm: float

    @property
    def sign(self) -> int:
        """+1 if the amounts are the correction, -1 if they are the error."""
        return 1 if self.stores == "correction" else -1

    @property
    def count_mm(self) -> float:
        """One count, mm."""
        return self.detection_unit_um * MM_PER_UM


def read_straightness_settings(machine: Machine) -> StraightnessSettings:
    """Read and check ``[controllers.fanuc-straightness]``; every key has a default."""
    section = machine.controller_settings("fanuc-straightness")
    style, notes = take_style(section)
    unit_mm = take_length_unit_mm(section, style)
    points = section.section("points", required=False)
    stated = (AXES[0] in points, AXES[1] in points, AXES[2] in points)
    quantum = Decimal("0.001") if style.real_point else Decimal(repr(unit_mm))
    grids: list[PointGrid] = []
    for axis, letter in enumerate(AXES):
        free = grids[-1].last + 1 if grids else 1
        grids.append(
            _grid(points.section(letter)) if stated[axis] else default_grid(machine, axis, free, quantum=quantum)
        )
    points.finish()
    numbers = section.section("axis_numbers", required=False)
    settings = StraightnessSettings(
        detection_unit_um=section.take("detection_unit_um", tomlio.positive, 1.0),
        stores=_stores(section.take("stores", tomlio.choice("correction", "error"), "correction")),
        pairs=section.take("pairs", _pairs, None),
        grids=(grids[0], grids[1], grids[2]),
        stated=stated,
        amount_limit=section.take("amount_limit", tomlio.whole(1, 32767), 32767),
        axis_numbers=_axis_numbers(numbers),
        style=style,
        style_notes=notes,
        interval_unit_mm=unit_mm,
    )
    if len(set(settings.axis_numbers)) < 3:
        raise section.fail("axis_numbers", f"{settings.axis_numbers} gives two axes the same number")
    section.finish()
    return settings


def _stores(word: str) -> Literal["correction", "error"]:
    return "correction" if word == "correction" else "error"


def _axis_numbers(section: tomlio.Section) -> tuple[int, int, int]:
    x, y, z = (section.take(axis, tomlio.whole(1, 99), k + 1) for k, axis in enumerate(AXES))
    section.finish()
    return x, y, z


def _grid(section: tomlio.Section) -> PointGrid:
    number = tomlio.whole(0, 9999)
    grid = PointGrid(
        reference=section.take("reference", number),
        first=section.take("first", number),
        last=section.take("last", number),
        interval_mm=Decimal(repr(section.take("interval_mm", tomlio.positive))),
    )
    section.finish()
    if grid.last < grid.first + 3:
        raise section.fail("last", f"points {grid.first} to {grid.last}: at least four are needed")
    return grid


def default_grid(machine: Machine, axis: int, free: int, *, quantum: Decimal) -> PointGrid:
    """Return points over the whole travel, about a hundredth of it apart, with numbers from ``free`` on."""
    low, high = machine.axes[axis].range_mm
    reference = machine.reference_point_mm[axis]
    step = (Decimal(repr(high - low)) / SECTIONS / quantum).to_integral_value(rounding=ROUND_CEILING) * quantum
    below = math.ceil((reference - low) / float(step) - 1e-9)
    above = math.ceil((high - reference) / float(step) - 1e-9)
    return PointGrid(free + below, free, free + below + above, step)


def _pairs(value: Any) -> tuple[tuple[int, int], ...]:
    """A list of at most three tables such as ``"Y(x)"``, each moving axis once."""
    known = {f"{AXES[c]}({AXES[m].lower()})": (c, m) for c in range(3) for m in range(3) if c != m}
    if not isinstance(value, list) or not value or any(item not in known for item in value):
        raise ValueError(f"a list of {', '.join(map(repr, known))} is expected")
    found = tuple(known[item] for item in value)
    if len({moving for _, moving in found}) < len(found):
        raise ValueError("each moving axis may stand once: the control keeps four points for each moving axis")
    return found
