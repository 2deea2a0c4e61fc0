"""What must be set on a SINUMERIK before CEC tables act: sign in words, machine data with values, warnings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from compgen.controllers.siemens.limits import largest_slopes, speed_percent
from compgen.controllers.siemens.products import CecMap, sum_into_axes
from compgen.controllers.siemens.profiles import (
    DEFAULT_MAX_SUM_MM,
    DEFAULT_MAX_VELO_PERCENT,
    FEWEST_AXES,
    PROFILES,
    USUAL,
)
from compgen.core.machine import Machine
from compgen.core.names import AXES

Sums = Sequence[tuple[float, tuple[float, float, float]]]


class CecLimits(Protocol):
    """The settings that decide which warnings are due."""

    @property
    def sign_stated(self) -> bool:
        """Whether the machine file states the sign."""

    @property
    def mode_stated(self) -> bool:
        """Whether the machine file states the reading of MULT_BY_TABLE."""

    @property
    def products(self) -> bool:
        """Whether products are written."""

    @property
    def mult_mode(self) -> str:
        """Reading of MULT_BY_TABLE."""

    @property
    def tables_available(self) -> int | None:
        """Number of tables that the control has."""

    @property
    def max_sum_mm(self) -> tuple[float, float, float] | None:
        """MD32720."""

    @property
    def max_velo_percent(self) -> tuple[float, float, float] | None:
        """MD32730."""

    @property
    def max_speed_mm_min(self) -> tuple[float, float, float]:
        """MD32000."""


#: A jump of an axis at switch-on below this is not worth a warning.
NOTICEABLE_JUMP_MM = 5e-4


def cec_sign_statement(names: Sequence[str], subtracts: bool, sums: Sums, *, stated: bool) -> str:
    """Return the sign convention in words with the largest sum of the file as a worked number.

    ``stated`` is False where the machine file leaves the sign to what is inferred.
    """
    output = max(range(3), key=lambda axis: abs(sums[axis][0]))
    value, place = sums[output]
    rule = (
        'sign = "error": the sum of the tables is the error of the axis, the control SUBTRACTS it from the command.'
        if subtracts
        else 'sign = "correction": the sum of the tables is the correction, the control ADDS it to the command.'
    )
    rule += "" if stated else " This sign is inferred, not stated in the machine file: check it at the machine first."
    moved = -value if subtracts else value
    return (
        f"{rule} Values in mm. Here: at X {place[0]:.3f} Y {place[1]:.3f} Z {place[2]:.3f} mm the sum into "
        f"{names[output]} is {value:+.6f} mm, the axis is moved by {moved:+.6f} mm."
    )


def cec_parameters(
    machine: Machine, names: Sequence[str], tables: CecMap, mode: str, sums: Sums
) -> list[dict[str, str]]:
    """Return the machine and setting data with the values that these tables need."""
    rows = [
        _row(f"MD18342 $MN_MM_CEC_MAX_POINTS[{index}]", str(len(entry.table.values)), "nodes of the table, exactly")
        for index, entry in sorted(tables.items())
    ]
    rows += [
        _row(f"SD41300 $SN_CEC_TABLE_ENABLE[{_indices(tables)}]", "1", "every table is evaluated"),
        _row(f"SD41310 $SN_CEC_TABLE_WEIGHT[{_indices(tables)}]", "1.0", "weights stay 1"),
        _row("MD10240, MD10260, MD32711", "metric", "the tables are in mm"),
    ]
    slopes = largest_slopes(machine, tables, mode)
    for output in sorted({entry.output_axis for entry in tables.values()}):
        rows += _axis_rows(names, output, abs(sums[output][0]), slopes[output].tolist())
    return rows


def _indices(tables: CecMap) -> str:
    """Indices in words: ``0 ... 4, 6``; those between that belong to other axes are not named."""
    found = sorted(tables)
    ends = [index for index in found if index - 1 not in tables or index + 1 not in tables]
    parts: list[str] = []
    for index in ends:
        alone, begins = index - 1 not in tables and index + 1 not in tables, index - 1 not in tables
        if alone or begins:
            parts.append(str(index))
        else:
            parts[-1] += f" ... {index}"
    return ", ".join(parts)


def cec_overwrites(tables: CecMap, kept: Sequence[int]) -> list[str]:
    """Say which tables the file overwrites, other axes first."""
    if kept:
        first = f"Of other axes: nothing. Tables kept (kept_tables): {', '.join(map(str, sorted(kept)))}."
    else:
        first = (
            "Of other axes: NOT KNOWN. A table of a rotary or further axis that has one of the indices below is lost: give "
            "the archive of the control with --active, or state kept_tables in the machine file."
        )
    return [first, f"Tables {_indices(tables)}, whatever they hold now."]


def _axis_rows(names: Sequence[str], output: int, needed_mm: float, slopes: Sequence[float]) -> list[dict[str, str]]:
    name = names[output]
    by_base = ", ".join(f"{names[base]} {slope:.3g}" for base, slope in enumerate(slopes))
    return [
        _row(f"MD32710 $MA_CEC_ENABLE[{name}]", "0, then 1", "0 while the file is loaded; 1 enables the sum"),
        _row(
            f"MD32720 $MA_CEC_MAX_SUM[{name}]",
            f">= {np.ceil(needed_mm * 1e4) / 1e4:.4f} mm",
            f"the sum reaches {needed_mm:.6f} mm; what is above this limit is cut off (alarm 20124)",
        ),
        _row(
            f"MD32730 $MA_CEC_MAX_VELO[{name}]",
            f">= {100.0 * sum(slopes):.4f} %",
            f"largest change of the sum, mm per mm of travel of the base axes: {by_base}; the percentage holds if all "
            "bases run as fast as this axis' own maximum MD32000, else scale it by v_base / MD32000",
        ),
    ]


def _row(name: str, value: str, meaning: str) -> dict[str, str]:
    return {"name": name, "value": value, "meaning": meaning}


def cec_warnings(machine: Machine, names: Sequence[str], tables: CecMap, limits: CecLimits, sums: Sums) -> list[str]:
    """Return what the user must know: limits that are not stated but would be exceeded, a jump at the reference."""
    found = []
    for axis, (value, _) in enumerate(sums):
        if limits.max_sum_mm is None and abs(value) > DEFAULT_MAX_SUM_MM:
            found.append(
                f"{names[axis]}: the sum reaches {value:+.4f} mm; the usual MD32720 is {DEFAULT_MAX_SUM_MM:g} mm and "
                "would clip it"
            )
    slopes = largest_slopes(machine, tables, limits.mult_mode)
    for axis in range(3):
        percent = speed_percent(slopes, axis, limits.max_speed_mm_min)
        if limits.max_velo_percent is None and percent > DEFAULT_MAX_VELO_PERCENT:
            found.append(
                f"{names[axis]}: the sum changes by up to {percent / 100.0:.3g} mm per mm of travel; the usual "
                f"MD32730 is {DEFAULT_MAX_VELO_PERCENT:g} % and would make it lag behind"
            )
    return found + _jumps(machine, names, tables, limits.mult_mode)


def cec_reservations(tables: CecMap, limits: CecLimits) -> list[str]:
    """Return what the verdict must say: an inferred sign, products that are missing, a number of tables not known."""
    found = []
    if not limits.sign_stated:
        found.append(
            'sign = "error" (the control subtracts the tables) is inferred from two traces, not stated in the machine file '
            "nor by the vendor: do the dial-gauge check of preflight.md first, then state sign"
        )
    if not limits.products and not limits.mode_stated:
        found.append(
            "mult_mode is not stated: what the control makes of two multiplied tables is not known, so none are multiplied "
            "and angular errors stay. Find it with the test of preflight.md and state it, or write products = false"
        )
    small, usual = PROFILES["828D"], PROFILES[USUAL]
    needed, nodes = max(tables) + 1, max(len(entry.table.values) for entry in tables.values())
    sure = usual.tables_per_axis * FEWEST_AXES
    if limits.tables_available is None and (needed > sure or nodes > (small.cec_nodes or 0)):
        found.append(
            f"these are {needed} tables with up to {nodes} nodes, and how many the control has is not stated: an 840D sl "
            f"has two for each of its axes ({sure} with {FEWEST_AXES}), an 828D {small.cec_tables} of {small.cec_nodes} "
            "nodes; what has no room does not act. State nc_axes or tables_available"
        )
    return found


def _jumps(machine: Machine, names: Sequence[str], tables: CecMap, mode: str) -> list[str]:
    at_reference = {
        index: entry.at(np.array(machine.reference_point_mm[entry.input_axis])) for index, entry in tables.items()
    }
    totals = [float(total) for total in sum_into_axes(tables, mode, at_reference)]
    return [
        f"{names[axis]}: the sum at the reference point is {total:+.6f} mm ({AXES[axis]}); the axis jumps by it when "
        "the compensation is enabled"
        for axis, total in enumerate(totals)
        if abs(total) > NOTICEABLE_JUMP_MM
    ]
