"""The sign crash test: every way to get signs, axes and units wrong, and whether the verification would notice.

Wrong ones at the level of the **emulated correction** c(p), that is after the text of the tables was parsed:

- ``output``: S c(p) for the 47 wrong signed permutations S of the three axes (the values go to a wrong axis or sign);
- ``frame``: S c(S^T p), correction and positions both in a wrong frame, as from a machine with other axis directions;
- the flipped sign (-c, one of the 47) and slips of unit (a thousand times too large or too small).

Wrong ones at the level of the **errors** that tables are made of, exported and parsed anew: degrees for radians in both
directions, and the errors in place of the correction.

Wrong ones at the level of the **numbers** of the parsed tables: one number that depends on the errors is changed so that
the tip moves by a little more than the goal of one entry (``Judge.goal_mm``), with the machine's own tool or any other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.controllers import SourceFile, controller_named
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, error_named
from compgen.core.points import Points
from compgen.errors import CompgenError
from compgen.export import export
from compgen.verify.entries import entry_check, numbers_of, with_number
from compgen.verify.judge import COMPONENT_FLOOR_MM, Judge, judge_of
from compgen.verify.verify import ReadTables, reasons_against

Correction = Callable[[FloatArray], FloatArray]
#: Outcomes of one trial.
REJECTED, SAME, ACCEPTED = "rejected", "same", "ACCEPTED"
#: Numbers of the tables that are changed one at a time, if not said otherwise.
ENTRIES = 24
#: Part of the goal that a changed number exceeds it by.
BEYOND_GOAL = 0.05
#: Changes by which it is found out what a number does, in its own unit (mm, rad, um, counts), and the least that says it.
TRIALS, LEAST_MOVED_MM = (1e-6, 1e-3, 1.0), 1e-7


@dataclass(frozen=True)
class Trial:
    """One wrong correction and what the verification said.

    ``outcome`` is ``"rejected"``; ``"same"`` if the correction differs from the right one by no more than the
    verification is meant to see (``difference_um``, the largest over the volume), so that it does not count; or
    ``"ACCEPTED"``, which must not be. ``reason`` is the first reason of the verification.
    """

    kind: str
    name: str
    outcome: str
    difference_um: float
    reason: str


@dataclass(frozen=True)
class CrashTest:
    """Outcome for one control; ``baseline`` are the reasons against the right tables, which must be empty."""

    controller: str
    trials: tuple[Trial, ...]
    baseline: tuple[str, ...]
    visible_um: float

    @property
    def passed(self) -> bool:
        """Whether the right tables are accepted and no wrong one is."""
        return not self.baseline and not self.count(ACCEPTED)

    def count(self, outcome: str) -> int:
        """Return how many trials ended so."""
        return sum(trial.outcome == outcome for trial in self.trials)

    def summary(self) -> dict[str, object]:
        """Return the object that ``volcomp crash-test --json`` prints for this control."""
        return {
            "controller": self.controller,
            "passed": self.passed,
            "baseline_reasons": list(self.baseline),
            "visible_um": self.visible_um,
            "rejected": self.count(REJECTED),
            "same": self.count(SAME),
            "accepted": self.count(ACCEPTED),
            "trials": [vars(trial) for trial in self.trials],
        }


def signed_permutations() -> list[FloatArray]:
    """Return the 48 signed permutation matrices of three axes, shape (3, 3), the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    return found


def permutation_name(matrix: FloatArray) -> str:
    """Say which value each axis gets, e.g. ``X<-Y Y<--X Z<-Z`` as ``(Y, -X, Z)``."""
    parts = []
    for row in matrix:
        source = int(np.argmax(np.abs(row)))
        parts.append(("-" if row[source] < 0 else "") + AXES[source])
    return f"({', '.join(parts)})"


def exported_tables(machine: Machine, errors: ErrorTable, controller: str) -> ReadTables:
    """Export errors and parse the text again, without any file."""
    made = export(machine, errors, controller, allow_unverified=True)
    control = controller_named(controller)
    settings = control.read_settings(machine)
    sources = [SourceFile(Path(name), text) for name, text in made.files.items()]
    return ReadTables(control, settings, control.parse(machine, settings, sources), ())


def crash_test(machine: Machine, errors: ErrorTable, controller: str, entries: int = ENTRIES) -> CrashTest:
    """Hold every wrong variant of a control's tables against the errors.

    Parameters
    ----------
    machine, errors : the errors (mm, rad) that the tables are made of and judged against.
    controller : name of the control.
    entries : how many numbers of the tables are changed, spread evenly over all that depend on the errors.
    """
    control = controller_named(controller)
    judge = judge_of(machine, control, errors)
    right = exported_tables(machine, errors, controller)

    def correction(position_mm: FloatArray) -> FloatArray:
        return _from_below(machine, right, position_mm)

    visible_mm = judge.resolution_mm + COMPONENT_FLOOR_MM
    court = _Court(machine, judge, correction(judge.grid.position_mm), visible_mm)
    baseline = [
        *control.violations(machine, right.settings, right.tables),
        *judge.reasons(court.right_mm, correction(judge.line_mm)),
    ]
    trials = [court.trial(kind, name, wrong) for kind, name, wrong in _wrong_corrections(machine, correction)]
    trials += [court.exported(name, wrong, controller) for name, wrong in _wrong_errors(errors)]
    trials += _entry_trials(machine, judge, right, entries)
    return CrashTest(controller, tuple(trials), tuple(baseline), visible_mm / MM_PER_UM)


def _from_below(machine: Machine, tables: ReadTables, position_mm: FloatArray) -> FloatArray:
    return tables.correction(machine, Points(position_mm, approach=np.ones_like(position_mm)))


@dataclass(frozen=True)
class _Court:
    """Judge with the right correction on its grid; ``visible_mm`` is what counts as a difference."""

    machine: Machine
    judge: Judge
    right_mm: FloatArray
    visible_mm: float

    def trial(self, kind: str, name: str, wrong: Correction, violations: Sequence[str] = ()) -> Trial:
        """Judge one wrong correction; the lines are looked at only if the grid shows nothing."""
        on_grid = wrong(self.judge.grid.position_mm)
        difference = float(np.max(np.abs(on_grid - self.right_mm)))
        reasons = [*violations, *self.judge.component_reasons(on_grid)]
        if not reasons:
            reasons = self.judge.reasons(on_grid, wrong(self.judge.line_mm))
        outcome = REJECTED if reasons else SAME if difference <= self.visible_mm else ACCEPTED
        return Trial(kind, name, outcome, difference / MM_PER_UM, reasons[0] if reasons else "")

    def exported(self, name: str, errors: ErrorTable, controller: str) -> Trial:
        """Judge tables that were made of wrong errors; tables that cannot be made are rejected as well."""
        try:
            tables = exported_tables(self.machine, errors, controller)
            found = tables.controller.violations(self.machine, tables.settings, tables.tables)
            return self.trial("errors", name, lambda part: _from_below(self.machine, tables, part), found)
        except (CompgenError, OverflowError) as error:
            return Trial("errors", name, REJECTED, math.inf, f"cannot be exported: {error}")


def _entry_trials(machine: Machine, judge: Judge, right: ReadTables, most: int) -> Iterator[Trial]:
    """Change one number at a time, by a little more than the goal; what cannot move the tip by so much is left out."""
    depends = entry_check(machine, judge, right).depends
    places = [(place, int(k)) for place, part in depends.items() for k in np.flatnonzero(part)]
    picked = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int))
    position_mm = np.vstack([judge.grid.position_mm, judge.line_mm])
    corners_mm = np.array(machine.tool_corners_mm)[np.arange(len(judge.line_mm)) % len(machine.tool_corners_mm)]
    points = [Points(judge.line_mm, corners_mm)]
    for side in (1.0, -1.0) if right.controller.bidirectional else (1.0,):
        points.append(Points(position_mm, approach=np.full_like(position_mm, side)))
    before = np.vstack([right.correction(machine, part) for part in points])
    numbers = numbers_of(right.tables)

    def changed(place: str, k: int, step: float) -> tuple[ReadTables, float]:
        tables = replace(right, tables=with_number(right.tables, place, k, step))
        after = [tables.correction(machine, part) for part in points]
        return tables, float(np.max(np.linalg.norm(np.vstack(after) - before, axis=1)))

    for number, (place, k) in enumerate(places[i] for i in picked):
        sign = 1.0 if number % 2 else -1.0
        for trial in TRIALS:
            tables, moved = changed(place, k, sign * trial)
            if moved >= LEAST_MOVED_MM:
                break
        else:
            continue
        moved_by = abs(float(numbers_of(tables.tables)[place][k] - numbers[place][k])) / moved
        tables, moved = changed(place, k, math.copysign((1.0 + BEYOND_GOAL) * judge.goal_mm * moved_by, sign))
        reasons = reasons_against(machine, tables, judge)[1]
        outcome = REJECTED if reasons else SAME if moved <= judge.goal_mm else ACCEPTED
        name = f"{place.lstrip('.')}, number {k + 1}"
        yield Trial("entry", name, outcome, moved / MM_PER_UM, reasons[0] if reasons else "")


def _wrong_corrections(machine: Machine, right: Correction) -> Iterator[tuple[str, str, Correction]]:
    """Every wrong correction as (kind, name, function of positions)."""
    for matrix in signed_permutations()[1:]:
        name = permutation_name(matrix)
        flipped = " flipped sign" if np.array_equal(matrix, -np.eye(3)) else ""
        yield "output", name + flipped, lambda part, m=matrix: right(part) @ m.T  # type: ignore[misc]
        yield "frame", name, lambda part, m=matrix: right(part @ m) @ m.T  # type: ignore[misc]
    yield "unit", "um written for mm (1000 times too large)", lambda part: 1000.0 * right(part)
    yield "unit", "mm written for um (1000 times too small)", lambda part: 0.001 * right(part)


def _wrong_errors(errors: ErrorTable) -> Iterator[tuple[str, ErrorTable]]:
    yield "deg for rad (angles 57 times too large)", _scaled(errors, 1.0, math.degrees(1.0))
    yield "rad for deg (angles 57 times too small)", _scaled(errors, 1.0, math.radians(1.0))
    yield "correction taken for the error", _scaled(errors, -1.0, -1.0)
    yield "um for mm in the lengths only", _scaled(errors, 1000.0, 1.0)
    yield "urad for mrad in the angles only", _scaled(errors, 1.0, 1000.0)


def _scaled(errors: ErrorTable, length: float, angle: float) -> ErrorTable:
    """Return errors with all lengths and all angles (squareness too) times a factor."""
    curves = {}
    for name, curve in errors.curves.items():
        factor = length if error_named(name).kind == "linear" else angle
        curves[name] = Curve(curve.position_mm, factor * curve.value, curve.u)
    squareness = {name: (angle * value, u) for name, (value, u) in errors.squareness.items()}
    return ErrorTable(curves, squareness, errors.metadata)


__all__ = ["CrashTest", "Trial", "crash_test", "permutation_name", "signed_permutations"]
