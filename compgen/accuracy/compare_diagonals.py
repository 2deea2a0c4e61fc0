"""Measured diagonals before against after (ISO 230-6)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from compgen.accuracy.compare import CompareOptions, Comparison, paired_figures, said_of_uncertainty
from compgen.accuracy.diagonals import SAME_CORNER_MM, DiagonalRun, accuracy_of_diagonals
from compgen.accuracy.pairing import paired_runs
from compgen.core.machine import Machine
from compgen.errors import InputError

#: The first of these that a diagonal has decides where there is no Ed.
_DECISIVE = ("E", "E_up", "E_down")


def compare_diagonals(
    machine: Machine,
    before: Mapping[str, DiagonalRun],
    after: Mapping[str, DiagonalRun],
    options: CompareOptions | None = None,
) -> Comparison:
    """Compare measured diagonals; Ed and Bd decide, or E of every diagonal where the four are not complete.

    Raises
    ------
    InputError
        for different diagonals or positions, unless the options say how to align them (``common``, ``interpolate``).
    """
    chosen = options or CompareOptions()
    if chosen.align == "model" or chosen.alignment is not None:
        raise InputError(
            "diagonals have no rigid motion and no model to align by; --align common or interpolate is possible"
        )
    names = [name for name in before if name in after]
    if set(before) != set(after) and (chosen.align != "common" or not names):
        raise InputError(
            f"BEFORE holds {', '.join(before)}, AFTER {', '.join(after)}; --align common compares the diagonals that both hold",
            field="--align",
        )
    pairs = {name: _paired(before[name], after[name], chosen.align) for name in names}
    first = {name: pair[0] for name, pair in pairs.items()}
    second = {name: pair[1] for name, pair in pairs.items()}
    sides = [accuracy_of_diagonals(machine, runs, chosen.edition, chosen.budgets) for runs in (first, second)]
    groups = paired_figures(sides[0].groups, sides[1].groups)
    together = groups.get("diagonals", {})
    decisive = tuple(("diagonals", key) for key in together)
    if not decisive:
        decisive = tuple((name, next(key for key in _DECISIVE if key in groups[name])) for name in names)
    known = not any(math.isnan(item.before.u + item.after.u) for g in groups.values() for item in g.values())
    statements = (*(pair[2] for pair in pairs.values()), *sides[0].statements, *said_of_uncertainty(known))
    return Comparison("diagonals", groups, decisive, statements)


def _paired(before: DiagonalRun, after: DiagonalRun, align: str | None) -> tuple[DiagonalRun, DiagonalRun, str]:
    """Both at the same positions; distances of AFTER count from the start of BEFORE."""
    offset = after.start_mm - before.start_mm
    along = float(offset @ before.unit)
    beside = [offset - along * before.unit, after.end_mm - before.end_mm]
    beside[1] = beside[1] - (beside[1] @ before.unit) * before.unit
    if max(float(np.linalg.norm(part)) for part in beside) > SAME_CORNER_MM:
        raise InputError(
            f"{before.name} is another line in AFTER: measure it between the same ends", field=f"diagonal {before.name}"
        )
    moved = replace(after.statistics, position_mm=after.statistics.position_mm + along)
    first, second, text = paired_runs(before.name, before.statistics, moved, align)
    ends = [before.start_mm + first.position_mm[k] * before.unit for k in (0, -1)]
    sides = [replace(run, start_mm=ends[0], end_mm=ends[1]) for run in (before, after)]
    return replace(sides[0], statistics=first), replace(sides[1], statistics=second), text
