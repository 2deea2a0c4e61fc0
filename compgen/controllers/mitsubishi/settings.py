"""Settings of ``[controllers.mitsubishi]``: what the control counts in, section lengths, numbers that are free."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

from compgen.controllers.grids import take_loss_mm
from compgen.controllers.mitsubishi.records import (
    FIRST_NUMBER,
    MOST_NUMBER,
    SETS,
    ControlFile,
    ControlSet,
    read_control_file,
)
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Smallest step of the division interval.
INTERVAL_QUANTUM_MM = Decimal("0.001")
#: Values per division point (E68 manual p. II-292, C64 manual 9.2).
LOWEST_VALUE, HIGHEST_VALUE = -128, 127


@dataclass(frozen=True)
class MitsubishiSettings:
    """Settings of machine error compensation.

    Parameters
    ----------
    setting_unit_um : setting unit of the control; one count of the table is half of it, times ``scale``.
    scale : compensation scale factor (parameter sc) of every set; None: that of the control's file, else 1.
    absolute : whether values are sums up to their point (#4000 = 0) and not steps (1); None: not known.
    adds : True if the control adds the numbers (corrections), False if it subtracts them.
    across : tables of one axis as a function of another (straightness, squareness), as (output, base axis).
    interval_mm : division interval per base axis, None: chosen.
    loss_mm : loss by interpolation between division points that is worth no shorter interval.
    first_number, last_number : numbers of values that may be used.
    first_set : first set of parameters that may be used, 1 to 10.
    axis_names : names of X, Y, Z on the control.
    sample : the control's own parameter file.
    """

    setting_unit_um: float
    scale: int | None
    absolute: bool | None
    adds: bool
    across: tuple[tuple[int, int], ...]
    interval_mm: tuple[float | None, float | None, float | None]
    loss_mm: float
    first_number: int
    last_number: int
    first_set: int
    axis_names: tuple[str, str, str]
    sample: ControlFile = field(default_factory=ControlFile, compare=False)

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.adds else -1

    @property
    def half_unit_mm(self) -> float:
        """One unit of output: half of the setting unit, mm."""
        return 0.5 * self.setting_unit_um * MM_PER_UM

    def scale_of(self, pair: tuple[int, int]) -> int:
        """Scale of a table (output, base axis): that of the machine file, else of the control's own set, else 1."""
        own = self.own_set(pair)
        return self.scale or (own.scale if own is not None and own.scale else 1)

    def count_mm(self, pair: tuple[int, int]) -> float:
        """One count of a written table (output, base axis), mm."""
        return self.half_unit_mm * self.scale_of(pair)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(output, base axis) of the tables: positioning of the three axes first."""
        return [*((axis, axis) for axis in range(3)), *self.across]

    def own_set(self, pair: tuple[int, int]) -> ControlSet | None:
        """Return the set of the control's file that holds a table (output, base axis)."""
        output, base = (self.axis_names[axis] for axis in pair)
        return next((item for item in self.sample.sets if (item.output, item.base) == (output, base)), None)

    def kept(self, pair: tuple[int, int]) -> ControlSet | None:
        """Return the set of the control whose numbers and interval a table keeps: unless another interval is stated."""
        own, stated = self.own_set(pair), self.interval_mm[pair[1]]
        same = own is not None and (stated is None or Decimal(repr(stated)) == own.interval_mm)
        return own if same else None

    def kept_at_reference(self, pair: tuple[int, int]) -> int:
        """Return the value at the reference number that a kept set of the control has: a constant, which stays; else 0."""
        kept = self.kept(pair)
        entry = None if kept is None else self.sample.entries.get(kept.reference)
        return 0 if entry is None or not entry.value else entry.whole(LOWEST_VALUE, HIGHEST_VALUE)

    def free_sets(self) -> list[int]:
        """Return the sets (0 to 9) that no table of the control's file needs, from ``first_set`` on."""
        used = {item.index for item in self.sample.sets}
        return [index for index in range(self.first_set - 1, SETS) if index not in used]


def read_mitsubishi_settings(machine: Machine) -> MitsubishiSettings:
    """Read and check ``[controllers.mitsubishi]``.

    Every key has a default but ``mode``, which an export needs unless the control's own file is given.
    """
    section = machine.controller_settings("mitsubishi")
    sample = read_control_file(section.files("style_from"))
    mode = section.take("mode", tomlio.choice("incremental", "absolute"), None)
    absolute = sample.absolute if mode is None else mode == "absolute"
    if sample.file is not None and absolute != sample.absolute:
        raise section.fail("mode", f"{mode!r} is stated, but {sample.file.path} has #4000 = {int(not sample.absolute)}")
    settings = MitsubishiSettings(
        setting_unit_um=section.take("setting_unit_um", tomlio.positive, sample.unit_um or 1.0),
        scale=section.take("scale", tomlio.whole(1, 99), None),
        absolute=absolute,
        adds=section.take("stores", tomlio.choice("correction", "error"), "correction") == "correction",
        across=section.take("relative_errors", _across, ACROSS),
        interval_mm=_intervals(section),
        loss_mm=take_loss_mm(section),
        first_number=section.take("first_number", tomlio.whole(FIRST_NUMBER, MOST_NUMBER), FIRST_NUMBER),
        last_number=section.take("last_number", tomlio.whole(FIRST_NUMBER, MOST_NUMBER), sample.last_number),
        first_set=section.take("first_set", tomlio.whole(1, SETS), 1),
        axis_names=_names(section),
        sample=sample,
    )
    if settings.last_number - settings.first_number + 1 < 3 * len(settings.pairs):
        raise section.fail("last_number", f"leaves too few numbers from {settings.first_number} on")
    new = [pair for pair in settings.pairs if settings.own_set(pair) is None]
    free = settings.free_sets()
    if len(new) > len(free):
        others = "".join(f", set {item.index + 1} of {item.base}" for item in sample.others(settings.axis_names))
        raise section.fail(
            "first_set",
            f"{len(new)} new sets are needed and {len(free)} of the {SETS} sets of the control are free{others}; state which "
            'tables are wanted, e.g. relative_errors = ["Y(x)", "X(y)"], or false for positioning alone',
        )
    section.finish()
    return settings


#: All tables of one axis as a function of another.
ACROSS = tuple((output, base) for base in range(3) for output in range(3) if output != base)


def _across(value: Any) -> tuple[tuple[int, int], ...]:
    """True for all tables of one axis as a function of another, false for none, or a list of names."""
    known = {f"{AXES[output]}({AXES[base].lower()})": (output, base) for output, base in ACROSS}
    if isinstance(value, bool):
        return ACROSS if value else ()
    if not isinstance(value, list) or any(item not in known for item in value) or len(set(value)) < len(value):
        raise ValueError(f"true, false or a list of {', '.join(map(repr, known))} is expected")
    return tuple(known[item] for item in value)


def _intervals(section: tomlio.Section) -> tuple[float | None, float | None, float | None]:
    part = section.section("interval_mm", required=False)
    x, y, z = (part.take(letter, _interval, None) for letter in AXES)
    part.finish()
    return x, y, z


def _interval(value: Any) -> float:
    if Decimal(repr(tomlio.positive(value))) % INTERVAL_QUANTUM_MM:
        raise ValueError(f"a multiple of {INTERVAL_QUANTUM_MM} mm is expected")
    return float(value)


def _names(section: tomlio.Section) -> tuple[str, str, str]:
    part = section.section("axis_names", required=False)
    x, y, z = (part.take(letter, _name, letter) for letter in AXES)
    part.finish()
    if len({x, y, z}) < 3:
        raise section.fail("axis_names", f"{x}, {y}, {z}: three different names are due")
    return x, y, z


def _name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9]{0,3}", value, re.ASCII):
        raise ValueError("a name of at most four letters and digits is expected")
    return value
