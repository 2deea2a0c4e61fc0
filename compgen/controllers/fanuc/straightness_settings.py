"""Settings of ``[controllers.fanuc-straightness]``: what is compensated, the point numbers, the style of the file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, Decimal
from typing import Any, Literal

from compgen.controllers.fanuc.pitch_build import pitch_points
from compgen.controllers.fanuc.pitch_settings import PitchSettings, read_pitch_settings
from compgen.controllers.fanuc.sample import PointGrid, Sample, take_sample
from compgen.controllers.fanuc.style import FanucStyle
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Sections of a travel where the user does not say which compensation points the control has.
SECTIONS = 100


@dataclass(frozen=True)
class StraightnessSettings:
    """Settings of straightness compensation.

    Parameters
    ----------
    detection_unit_um : one count of the compensation amounts.
    stores : whether the amounts are the correction (added to the command) or the error.
    pairs : (compensated axis, moving axis), 0..2; None: the best ones are chosen.
    grids : compensation points of X, Y, Z; None where the sample shows that the axis has none. ``stated`` tells which of
        them the user or the sample gave, ``of_pitch`` which are those of ``[controllers.fanuc-pitch]``; the others are
        assumed.
    amount_limit : largest magnitude of an amount.
    axis_numbers : controlled axis numbers of X, Y, Z.
    path : path of the control, for parameters with a word L.
    sample : what files of the user's control show.
    """

    detection_unit_um: float
    stores: Literal["correction", "error"]
    pairs: tuple[tuple[int, int], ...] | None
    grids: tuple[PointGrid | None, PointGrid | None, PointGrid | None]
    stated: tuple[bool, bool, bool]
    of_pitch: tuple[bool, bool, bool]
    amount_limit: int
    axis_numbers: tuple[int, int, int]
    path: int
    sample: Sample = field(default_factory=Sample, compare=False)

    @property
    def style(self) -> FanucStyle:
        """How the file is written."""
        return self.sample.style

    @property
    def assumed(self) -> tuple[bool, ...]:
        """Whether the points of X, Y, Z are assumed."""
        return tuple(not one and not other for one, other in zip(self.stated, self.of_pitch, strict=True))

    @property
    def interval_unit_mm(self) -> float:
        """Unit of 3624 without a decimal point."""
        return self.sample.interval_unit_mm

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
    path = section.take("path", tomlio.whole(1, 99), 1)
    sample = take_sample(section, path=path)
    points = section.section("points", required=False)
    pitch = read_pitch_settings(machine) if "fanuc-pitch" in machine.controllers else None
    axis_numbers = _axis_numbers(section.section("axis_numbers", required=False), pitch)
    if len(set(axis_numbers)) < 3:
        raise section.fail("axis_numbers", f"{axis_numbers} gives two axes the same number")
    grids, stated, of_pitch = _grids(machine, sample, points, axis_numbers)
    unit_um = 1.0 if pitch is None else pitch.detection_unit_um
    settings = StraightnessSettings(
        detection_unit_um=section.take("detection_unit_um", tomlio.positive, unit_um),
        stores=_stores(section.take("stores", tomlio.choice("correction", "error"), "correction")),
        pairs=section.take("pairs", _pairs, None),
        grids=grids,
        stated=stated,
        of_pitch=of_pitch,
        amount_limit=section.take("amount_limit", tomlio.whole(1, 32767), 32767),
        axis_numbers=axis_numbers,
        path=path,
        sample=sample,
    )
    for _, moving in settings.pairs or ():
        if settings.grids[moving] is None:
            raise section.fail(
                "pairs",
                f"{AXES[moving]} (A{axis_numbers[moving]}) has no compensation points in the sample (3620 to 3622 and 3624), "
                f"and other axes must keep theirs; leave its table out, or state points.{AXES[moving]}",
            )
    section.finish()
    return settings


def _grids(machine: Machine, sample: Sample, points: tomlio.Section, axis_numbers: tuple[int, int, int]) -> Any:
    """Compensation points of X, Y, Z: stated ones, those of the sample, of ``[controllers.fanuc-pitch]``, else assumed ones.

    Beside them, which are of the first two kinds and which of the third. The numbers belong to pitch error compensation
    as well: with a sample no others than its own are written, and assumed ones are never written beside the tables.
    """
    quantum = Decimal("0.001") if sample.style.real_point else Decimal(repr(sample.interval_unit_mm))
    grids: list[PointGrid | None] = []
    pitch = pitch_points(machine)
    of_pitch = [False, False, False]
    for axis, letter in enumerate(AXES):
        shown = sample.axes.get(axis_numbers[axis])
        known = None if shown is None or not shown.grid.interval_mm else shown.grid
        if letter in points:
            grid = _grid(points.section(letter))
            if known is not None and grid != known:
                raise points.fail(
                    letter,
                    f"differs from the sample: A{axis_numbers[axis]} has 3620 = {known.reference}, 3621 = {known.first}, 3622 = "
                    f"{known.last}, 3624 = {known.interval_mm:f} there; other values would shift its pitch table",
                )
            sample.check_free(axis_numbers[axis], letter, grid.first, grid.last)
            grids.append(grid)
        elif known is not None:
            sample.check_free(axis_numbers[axis], letter, known.first, known.last)
            grids.append(known if known.last >= known.first + 3 else None)
        elif any((number, axis_numbers[axis]) in sample.parameters for number in (3620, 3621, 3622, 3624)):
            grids.append(None)
        elif (own := pitch[axis]) is not None:
            sample.check_free(axis_numbers[axis], letter, own.first, own.last)
            grids.append(own if own.last >= own.first + 3 else None)
            of_pitch[axis] = True
        else:
            used = [grid.last for grid in (*grids, *pitch) if grid is not None]
            used += [span[1] for _, span in sample.others(0)]
            grids.append(default_grid(machine, axis, max(used, default=0) + 1, quantum=quantum))
    stated = tuple(letter in points or axis_numbers[k] in sample.axes for k, letter in enumerate(AXES))
    points.finish()
    return tuple(grids), stated, tuple(of_pitch)


def _stores(word: str) -> Literal["correction", "error"]:
    return "correction" if word == "correction" else "error"


def _axis_numbers(section: tomlio.Section, pitch: PitchSettings | None) -> tuple[int, int, int]:
    usual = (1, 2, 3) if pitch is None else pitch.axis_numbers
    x, y, z = (section.take(axis, tomlio.whole(1, 99), usual[k]) for k, axis in enumerate(AXES))
    if pitch is not None and (x, y, z) != usual:
        stated = ", ".join(map(str, usual))
        raise section.fail("X", f"{x}, {y}, {z} are the axis numbers here, and {stated} in [controllers.fanuc-pitch]")
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
