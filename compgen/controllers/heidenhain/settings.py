"""Settings of ``[controllers.heidenhain-com]``: generation, sign, node positions, limits, tables saved on the control."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Literal

from compgen.controllers.grids import take_loss_mm
from compgen.controllers.heidenhain.text import Layout, own_layout, template_layout
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES

POSITION, BACKLASH, ACTIVE = "AXISPOS", "BACKLASH", "ACTIVE"
#: Spacings of the older controls are 2^n times this (TNC 407 technical manual, p. 153).
SPACING_UNIT_MM = Decimal("0.0001")
SMALLEST_EXPONENT, LARGEST_EXPONENT = 6, 23
#: Entries of one .COM file (TNC 407 technical manual, p. 622, error 3 of module 9095).
MOST_ENTRIES = 256


@dataclass(frozen=True)
class HeidenhainSettings:
    """Settings of compensation-value tables.

    Parameters
    ----------
    older : True for the older controls (datum and power-of-two spacing), False for free positions.
    subtracts : True if the entries are errors, which the control subtracts; False if it adds them.
    axis_names : names of X, Y, Z in CfgAxes/axisList, which are the column names.
    decimals : digits after the point.
    loss_mm : loss by interpolation, as a displacement of the tool, that is worth no further node.
    max_points : entries that a .COM file may have.
    max_tables, max_total_points : limits of the control, None: not known.
    backlash : what the column BACKLASH holds: nothing (zeros), absolute values for negative travel, or the difference.
    datum_mm, exponent : first node and n of the spacing 2^n x 0.0001 mm per axis; None: chosen.
    com, cma : layouts of tables that were saved on the control, None: our own.
    keep_name : whether the name in the first line of such a table stays, or becomes that of the written file.
    """

    older: bool
    subtracts: bool
    axis_names: tuple[str, str, str]
    decimals: int
    loss_mm: float
    max_points: int
    max_tables: int | None
    max_total_points: int | None
    backlash: Literal["empty", "absolute", "difference"]
    datum_mm: tuple[Decimal | None, Decimal | None, Decimal | None]
    exponent: tuple[int | None, int | None, int | None]
    com: Layout | None
    cma: Layout | None
    keep_name: bool

    @property
    def sign(self) -> int:
        """Sign of an entry in what the control adds to the command."""
        return -1 if self.subtracts else 1

    @property
    def has_positions(self) -> bool:
        """Whether the tables have a column with the positions."""
        return self.com is None or POSITION in self.com.names

    def com_layout(self, axis: int) -> Layout:
        """Layout of the .COM file of an input axis."""
        name = f"AXIS_{AXES[axis]}"
        if self.com is not None:
            return self._named(self.com, name)
        columns = [("NR", 5), (POSITION, 13), (BACKLASH, 11), *((item, 11) for item in self.axis_names)]
        return own_layout(name, "COM", _wide(columns))

    def cma_layout(self) -> Layout:
        """Layout of the .CMA file."""
        if self.cma is not None:
            return self._named(self.cma, "CONFIG")
        return own_layout("CONFIG", "CMA", _wide([("NR", 5), (ACTIVE, 9), *((item, 13) for item in self.axis_names)]))

    def _named(self, layout: Layout, name: str) -> Layout:
        if self.keep_name:
            return layout
        first = re.sub(r"^(\s*BEGIN\s+)[^\s.]+", rf"\g<1>{name}", layout.before[0])
        return Layout((first, *layout.before[1:]), layout.columns, layout.after, layout.crlf, layout.source)


def _wide(columns: list[tuple[str, int]]) -> list[tuple[str, int]]:
    return [(name, max(width, len(name) + 2)) for name, width in columns]


def read_heidenhain_settings(machine: Machine) -> HeidenhainSettings:
    """Read and check ``[controllers.heidenhain-com]``; every key has a default."""
    section = machine.controller_settings("heidenhain-com")
    com_path, cma_path = section.file("template_from"), section.file("cma_template_from")
    settings = HeidenhainSettings(
        older=section.take("generation", tomlio.choice("free", "power-of-two"), "free") == "power-of-two",
        subtracts=section.take("sign", tomlio.choice("error", "correction"), "error") == "error",
        axis_names=take_names(section),
        decimals=section.take("decimals", tomlio.whole(3, 6), 4),
        loss_mm=take_loss_mm(section),
        max_points=section.take("max_points", tomlio.whole(4, 100_000), MOST_ENTRIES),
        max_tables=section.take("max_tables", tomlio.whole(1, 1000), None),
        max_total_points=section.take("max_total_points", tomlio.whole(12, 1_000_000), None),
        backlash=_backlash(section),
        datum_mm=_per_axis(section, "datum_mm", _position),
        exponent=_per_axis(section, "spacing_exponent", tomlio.whole(SMALLEST_EXPONENT, LARGEST_EXPONENT)),
        com=template_layout(com_path, "COM") if com_path else None,
        cma=template_layout(cma_path, "CMA") if cma_path else None,
        keep_name=section.take("begin_name", tomlio.choice("keep", "file"), "keep") == "keep",
    )
    _check_older(section, settings)
    _check_templates(section, settings)
    section.finish()
    return settings


def take_names(section: tomlio.Section) -> tuple[str, str, str]:
    """Take ``axis_names``, by default X, Y, Z: words that differ from each other and from the other columns."""
    part = section.section("axis_names", required=False)
    x, y, z = (part.take(letter, _word, letter) for letter in AXES)
    part.finish()
    if len({x, y, z, "NR", POSITION, BACKLASH, ACTIVE}) < 7:
        raise section.fail("axis_names", f"{x}, {y}, {z}: three different names are due, none of the other columns")
    return x, y, z


def _word(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9_]{1,12}", value, re.ASCII):
        raise ValueError("a name of letters and digits is expected")
    return value


def _backlash(section: tomlio.Section) -> Any:
    return section.take("backlash_column", tomlio.choice("empty", "absolute", "difference"), "empty")


def _position(value: Any) -> Decimal:
    exact = Decimal(repr(tomlio.number(value)))
    if exact % SPACING_UNIT_MM or abs(exact) >= 10**7:
        raise ValueError(f"a position in whole multiples of {SPACING_UNIT_MM} mm is expected")
    return exact


def _per_axis(section: tomlio.Section, key: str, check: Callable[[Any], Any]) -> Any:
    part = section.section(key, required=False)
    values = tuple(part.take(letter, check, None) for letter in AXES)
    part.finish()
    return values


def _check_older(section: tomlio.Section, settings: HeidenhainSettings) -> None:
    if settings.older and settings.backlash != "empty":
        raise section.fail("backlash_column", "the column BACKLASH is known of the newer controls only (generation)")
    for key, values in (("datum_mm", settings.datum_mm), ("spacing_exponent", settings.exponent)):
        if not settings.older and any(value is not None for value in values):
            raise section.fail(key, 'belongs to generation = "power-of-two"; tables with free positions have neither')


def _check_templates(section: tomlio.Section, settings: HeidenhainSettings) -> None:
    """Hold the saved tables against what has to be written into them; the errors point at their header line."""
    for layout, due in ((settings.com, settings.axis_names), (settings.cma, (ACTIVE, *settings.axis_names))):
        missing = [] if layout is None else [name for name in due if name not in layout.names]
        if layout is not None and missing:
            raise layout.fail(
                f"the table has no column {', '.join(missing)} (it has {', '.join(layout.names)}); columns are named "
                "like the axes of the control, see axis_names"
            )
    if settings.com is None:
        return
    if settings.backlash != "empty" and BACKLASH not in settings.com.names:
        raise settings.com.fail('the table has no column BACKLASH, which backlash_column needs ("empty": not)')
    if POSITION not in settings.com.names:
        if not settings.older:
            raise settings.com.fail(
                'the table has no column AXISPOS; with generation = "power-of-two" a table of an older control is filled'
            )
        if None in settings.datum_mm or None in settings.exponent:
            raise section.fail(
                "datum_mm",
                "and spacing_exponent are needed for X, Y and Z: the saved table has no column AXISPOS, so that its "
                "positions follow from the datum and the spacing 2^n x 0.0001 mm in its head alone",
            )
