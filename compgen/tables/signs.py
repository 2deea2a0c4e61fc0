"""Signs, axes and units: the crash test of every wrong convention, and five positions at the machine that reveal one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls import SourceFile, controller_named
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, MM_PER_UM, error_named
from compgen.errors import CompgenError
from compgen.identification.covariance import Covariance
from compgen.identification.posterior import Posterior
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import full_grid
from compgen.resources import LANGUAGES
from compgen.tables import Export, export
from compgen.tables.entries import entry_check, numbers_of, with_number
from compgen.tables.judge import COMPONENT_FLOOR_MM, Judge, judge_of
from compgen.tables.render import load_format, render, template_folders
from compgen.tables.verification import ReadTables, assumed_lines, known_errors, reasons_against

# The sign crash test: every way to get signs, axes and units wrong, and whether the verification detects it. Variants
# at the level of the **emulated correction** c(p), after the text of the tables was parsed:
#
# - ``output``: S c(p) for the 47 wrong signed permutations S of the three axes (the values get a wrong axis or sign);
# - ``frame``: S c(S^T p), correction and positions both in a wrong frame, as of a machine with other axis directions;
# - the reversed sign (-c, one of the 47) and wrong units (a thousand times too large or too small).
#
# Variants at the level of the **errors** that tables are made from, exported and parsed again: degrees for radians and
# vice versa, and the errors instead of the correction.
#
# Variants at the level of the **numbers** of the parsed tables: one number that depends on the errors is changed until
# the tip moves by a little more than the goal of one entry (``Judge.goal_mm``), with the machine's tool or any other.


Correction = Callable[[FloatArray], FloatArray]
#: Outcomes of one trial.
REJECTED, SAME, ACCEPTED = "rejected", "same", "ACCEPTED"
#: Default count of numbers of the tables that are changed one at a time.
ENTRIES = 24
#: Share of the goal by which a changed number exceeds it.
BEYOND_GOAL = 0.05
#: Trial changes that show what a number does, in its unit (mm, rad, um, counts), and the smallest response that counts.
TRIALS, LEAST_MOVED_MM = (1e-6, 1e-3, 1.0), 1e-7


@dataclass(frozen=True)
class Trial:
    """One wrong correction and what the verification said.

    ``outcome`` is ``"rejected"``; ``"same"`` if the correction differs from the right one by no more than the
    verification resolves (``difference_um``, the largest over the volume), so it does not count; or ``"ACCEPTED"``, a
    failure. ``reason`` is the first reason of the verification.
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
        """Return how many trials had this outcome."""
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
    """Return in words which value each axis gets, e.g. ``X<-Y Y<--X Z<-Z`` as ``(Y, -X, Z)``."""
    parts = []
    for row in matrix:
        source = int(np.argmax(np.abs(row)))
        parts.append(("-" if row[source] < 0 else "") + AXES[source])
    return f"({', '.join(parts)})"


def exported_tables(machine: Machine, errors: ErrorTable, controller: str) -> ReadTables:
    """Export errors and parse the text, without any file."""
    made = export(machine, errors, controller, allow_unverified=True)
    control = controller_named(controller)(machine)
    sources = [SourceFile(Path(name), text) for name, text in made.files.items()]
    return ReadTables(control, control.parse(sources), ())


def crash_test(machine: Machine, errors: ErrorTable, controller: str, entries: int = ENTRIES) -> CrashTest:
    """Verify every wrong variant of a control's tables against the errors.

    Parameters
    ----------
    machine, errors : the errors (mm, rad) from which the tables are made and against which they are judged.
    controller : name of the control.
    entries : how many numbers of the tables are changed, spread evenly over all that depend on the errors.
    """
    control = controller_named(controller)(machine)
    judge = judge_of(machine, control, errors)
    right = exported_tables(machine, errors, controller)

    def correction(position_mm: FloatArray) -> FloatArray:
        return _from_below(machine, right, position_mm)

    visible_mm = judge.resolution_mm + COMPONENT_FLOOR_MM
    court = _Court(machine, judge, correction(judge.grid.position_mm), visible_mm)
    baseline = [
        *control.violations(right.tables),
        *judge.reasons(court.right_mm, correction(judge.line_mm)),
    ]
    trials = []
    for matrix in signed_permutations()[1:]:
        name = permutation_name(matrix)
        flipped = " flipped sign" if np.array_equal(matrix, -np.eye(3)) else ""
        trials.append(court.trial("output", name + flipped, lambda part, m=matrix: correction(part) @ m.T))  # type: ignore[misc]
        trials.append(court.trial("frame", name, lambda part, m=matrix: correction(part @ m) @ m.T))  # type: ignore[misc]
    name = "um written for mm (1000 times too large)"
    trials.append(court.trial("unit", name, lambda part: 1000.0 * correction(part)))
    name = "mm written for um (1000 times too small)"
    trials.append(court.trial("unit", name, lambda part: 0.001 * correction(part)))
    trials += [
        court.exported(name, _scaled(errors, linear, angular), controller)
        for name, linear, angular in (
            ("deg for rad (angles 57 times too large)", 1.0, math.degrees(1.0)),
            ("rad for deg (angles 57 times too small)", 1.0, math.radians(1.0)),
            ("correction mistaken for the error", -1.0, -1.0),
            ("um for mm in the lengths only", 1000.0, 1.0),
            ("urad for mrad in the angles only", 1.0, 1000.0),
        )
    ]
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
        """Judge one wrong correction; the lines are checked only if the grid shows nothing."""
        on_grid = wrong(self.judge.grid.position_mm)
        difference = float(np.max(np.abs(on_grid - self.right_mm)))
        reasons = [*violations, *self.judge.component_reasons(on_grid)]
        if not reasons:
            reasons = self.judge.reasons(on_grid, wrong(self.judge.line_mm))
        outcome = REJECTED if reasons else SAME if difference <= self.visible_mm else ACCEPTED
        return Trial(kind, name, outcome, difference / MM_PER_UM, reasons[0] if reasons else "")

    def exported(self, name: str, errors: ErrorTable, controller: str) -> Trial:
        """Judge tables made from wrong errors; tables that cannot be made count as rejected."""
        try:
            tables = exported_tables(self.machine, errors, controller)
            found = tables.controller.violations(tables.tables)
            return self.trial("errors", name, lambda part: _from_below(self.machine, tables, part), found)
        except (CompgenError, OverflowError) as error:
            return Trial("errors", name, REJECTED, math.inf, f"cannot be exported: {error}")


def _entry_trials(machine: Machine, judge: Judge, right: ReadTables, most: int) -> Iterator[Trial]:
    """Change one number at a time, by a little more than the goal; numbers that cannot move the tip that far are skipped."""
    check = entry_check(machine, judge, right)
    places = [(place, int(k)) for place, part in check.depends.items() for k in np.flatnonzero(part)]
    picked = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int))
    position_mm = np.vstack([judge.grid.position_mm, judge.line_mm])
    corners_mm = np.array(machine.tool_corners_mm)[np.arange(len(judge.line_mm)) % len(machine.tool_corners_mm)]
    points = [Points(judge.line_mm, corners_mm)]
    for side in (1.0, -1.0) if right.controller.by_direction(right.tables) else (1.0,):
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
        reasons = reasons_against(machine, tables, judge, check=check)[1]
        outcome = REJECTED if reasons else SAME if moved <= judge.goal_mm else ACCEPTED
        name = f"{place.lstrip('.')}, number {k + 1}"
        yield Trial("entry", name, outcome, moved / MM_PER_UM, reasons[0] if reasons else "")


def _scaled(errors: ErrorTable, length: float, angle: float) -> ErrorTable:
    """Return errors with all lengths and all angles (squareness too) times a factor."""
    curves = {}
    for name, curve in errors.curves.items():
        factor = length if error_named(name).kind == "linear" else angle
        curves[name] = Curve(curve.position_mm, factor * curve.value, curve.u)
    squareness = {name: (angle * value, u) for name, (value, u) in errors.squareness.items()}
    return ErrorTable(curves, squareness, errors.metadata)


# Five positions at the machine that show which sign, axis or unit is wrong, with the readings expected there.
#
# The readings come from the parsed tables (the emulated control) and the exact machine with the given errors; every
# reading is relative to the one at the first position, so any displacement instrument will do.


#: Candidates per axis for the positions.
LEVELS = 5
#: Length of the last approach: at most, mm, and as a share of the travel.
APPROACH_MM, APPROACH_SHARE = 10.0, 0.02
#: Positions keep this many approach lengths away from the ends of the travel, so that no move ends at a software limit.
MARGIN = 1.5
#: Feed between the positions and over the last approach, mm/min.
FEED_MM_MIN, APPROACH_FEED_MM_MIN = 1000, 200
#: In a separate folder, so that the program is not mistaken for a table.
PROGRAM_NAME, PAGE_NAME = "check/check-program.nc", "check/check-program.md"


@dataclass(frozen=True)
class CheckProgram:
    """Positions and readings.

    Parameters
    ----------
    position_mm : the five positions in machine coordinates, shape (5, 3); the first is the zero of all readings.
    before_mm : where each approach starts: X and Y from below, Z from above, shape (5, 3).
    safe_z_mm : Z between two positions.
    added_mm : what the control adds to the command there, shape (5, 3).
    off_mm, on_mm : readings (actual tip minus commanded) without and with compensation, less the first, shape (5, 3).
    separation_mm : every wrong signed permutation of the axes changes some reading by at least this.
    slips : common mistakes, as (description, position number, axis, right reading, wrong reading) in mm, with
        compensation on.
    """

    position_mm: FloatArray
    before_mm: FloatArray
    safe_z_mm: float
    added_mm: FloatArray
    off_mm: FloatArray
    on_mm: FloatArray
    separation_mm: float
    slips: tuple[tuple[str, int, str, float, float], ...]


def check_program(
    machine: Machine, tables: ReadTables, errors: ErrorTable, reversal: ReversalCurves | None = None
) -> CheckProgram:
    """Choose five positions and work out the readings.

    Parameters
    ----------
    machine : the machine; all positions and approaches are within its travel.
    tables : the tables as parsed.
    errors : errors of the machine, usually the identified errors (mm, rad).
    reversal : its reversal; every position is approached from one side.
    """
    way_mm = np.minimum(APPROACH_MM, APPROACH_SHARE * (machine.upper_mm - machine.lower_mm))
    candidates = _candidates(machine, way_mm)
    added = tables.correction(machine, _approached(candidates))
    # What the same tables add at positions (n, 3) if the control interprets them otherwise, by description, each (n,
    # 3), mm.
    others = {
        words: np.asarray(other.emulate(tables.tables, _approached(candidates)))
        for words, other in tables.controller.other_readings(tables.tables).items()
    }
    chosen = _choose(added, list(others.values()))
    position_mm, added_mm = candidates[chosen], added[chosen]
    lag = 0.0 if reversal is None else reversal.displacement(position_mm, _directions(position_mm))
    off = exact_error(machine, errors, position_mm) + lag
    on = exact_error(machine, errors, position_mm + added_mm) + added_mm + lag
    off_mm, on_mm = off - off[0], on - on[0]
    moved = added_mm - added_mm[0]
    return CheckProgram(
        position_mm=position_mm,
        before_mm=np.round(position_mm - way_mm * np.array([1.0, 1.0, -1.0]), 3),
        safe_z_mm=float(np.round(machine.upper_mm[2] - (MARGIN - 1.0) * way_mm[2], 3)),
        added_mm=added_mm,
        off_mm=off_mm,
        on_mm=on_mm,
        separation_mm=min(float(np.max(np.abs(moved @ wrong.T - moved))) for wrong in signed_permutations()[1:]),
        slips=(
            *(_slip(name, wrong - moved, on_mm) for name, wrong in _wrong(moved)),
            *_readings(moved, {name: part[chosen] - part[chosen[0]] for name, part in others.items()}, on_mm),
        ),
    )


def _apart(moved: Sequence[FloatArray]) -> FloatArray:
    """Return the smallest difference between any two interpretations of the tables, each (n, 3): shape (n, 3), mm."""
    return np.asarray(np.min([np.abs(a - b) for a, b in combinations(moved, 2)], axis=0))


def _readings(
    moved_mm: FloatArray, others_mm: Mapping[str, FloatArray], on_mm: FloatArray
) -> list[tuple[str, int, str, float, float]]:
    """Return the slips of the other interpretations, all at the position and axis that best distinguish every two."""
    if not others_mm:
        return []
    place, axis = divmod(int(np.argmax(_apart([moved_mm, *others_mm.values()]))), 3)
    right = float(on_mm[place, axis])
    return [
        (name, place + 1, AXES[axis], right, right + float(other[place, axis] - moved_mm[place, axis]))
        for name, other in others_mm.items()
    ]


def _approached(position_mm: FloatArray) -> Points:
    """Return points with the direction of the last travel of every axis: X and Y upwards, Z downwards."""
    return Points(position_mm, approach=_directions(position_mm))


def _directions(position_mm: FloatArray) -> FloatArray:
    return np.tile([1.0, 1.0, -1.0], (len(position_mm), 1))


def _candidates(machine: Machine, way_mm: FloatArray) -> FloatArray:
    """Return the reference point (moved into reach) and a grid within the travel less the approach, shape (n, 3), mm."""
    low, high = machine.lower_mm + MARGIN * way_mm, machine.upper_mm - MARGIN * way_mm
    lines = [np.linspace(low[k], high[k], LEVELS) for k in range(3)]
    first = np.clip(machine.reference_point_mm, low, high)
    grid = full_grid(lines).reshape(-1, 3)
    return np.round(np.vstack([first, grid]), 3)


def _choose(added_mm: FloatArray, others_mm: Sequence[FloatArray]) -> list[int]:
    """Return the indices of five candidates: the first, the largest change of X, Y and Z, and the most distinctive one.

    The last one distinguishes wrong permutations of the axes, and the other interpretations of the tables (n, 3), as
    far as the first four do not.
    """
    moved = added_mm - added_mm[0]
    chosen = [0]
    for axis in range(3):
        size = np.abs(moved[:, axis]).copy()
        size[chosen] = -1.0
        chosen.append(int(np.argmax(size)))
    wrong = np.stack([moved @ matrix.T for matrix in signed_permutations()[1:]])
    miss = np.max(np.abs(wrong - moved), axis=2)
    so_far = np.max(miss[:, chosen], axis=1)
    least = np.min(np.maximum(so_far[:, None], miss), axis=0)
    if others_mm:
        apart = np.max(_apart([moved, *(part - part[0] for part in others_mm)]), axis=1)
        least = np.minimum(least, np.maximum(np.max(apart[chosen]), apart))
    score = least + 1e-6 * np.linalg.norm(moved, axis=1)
    score[chosen] = -1.0
    return [*chosen, int(np.argmax(score))]


def _wrong(moved_mm: FloatArray) -> list[tuple[str, FloatArray]]:
    """Return mistakes as (description, what the control then adds at each position less the first, shape (5, 3), mm)."""
    found: list[tuple[str, FloatArray]] = [("all signs reversed", -moved_mm)]
    for axis, letter in enumerate(AXES):
        signs = np.ones(3)
        signs[axis] = -1.0
        found.append((f"sign of {letter} reversed", moved_mm * signs))
    for order, letters in (((1, 0, 2), "X and Y"), ((2, 1, 0), "X and Z"), ((0, 2, 1), "Y and Z")):
        found.append((f"{letters} swapped", moved_mm[:, order]))
    found.append(("compensation does not act, or is 1000 times too small", 0.0 * moved_mm))
    found.append(("acts twice (an older compensation is still on)", 2.0 * moved_mm))
    found.append(("half or less of it acts (a scale is wrong)", 0.5 * moved_mm))
    return found


def _slip(name: str, change_mm: FloatArray, on_mm: FloatArray) -> tuple[str, int, str, float, float]:
    """Return where a mistake shows most: position number, axis, right and wrong reading with compensation on."""
    place, axis = divmod(int(np.argmax(np.abs(change_mm))), 3)
    right = float(on_mm[place, axis])
    return name, place + 1, AXES[axis], right, right + float(change_mm[place, axis])


def check_files(
    machine: Machine,
    exported: Export,
    errors: ErrorTable,
    templates: Path | None = None,
    reversal: ReversalCurves | None = None,
    language: str = LANGUAGES[0],
    read: ReadTables | None = None,
    covariance: Covariance | None = None,
) -> dict[str, str]:
    """Return ``check/check-program.md`` and, for controls with a documented motion in machine coordinates, the program.

    Parameters
    ----------
    machine, errors : the machine and its errors.
    exported : the files; the readings are those of their text.
    templates : a user's templates folder, searched first.
    reversal : as in :func:`check_program`.
    language : of the page; the program stays in English.
    read : the files as read back, if they have been.
    covariance : of the errors, with what is known of those that were not measured; by default from their u.
    """
    if read is None:
        control = controller_named(exported.controller)(machine)
        sources = [SourceFile(Path(name), text) for name, text in exported.files.items()]
        read = ReadTables(control, control.parse(sources), ())
    card = load_format(exported.controller, templates)
    program = check_program(machine, read, errors, reversal)
    # If the control's folder has no program, only the page is written.
    folders = template_folders(card.name, templates)
    has_program = any((folder / card.name / "check-program.nc.j2").is_file() for folder in folders)
    known = known_errors(machine, errors, covariance)
    context = {**_context(machine, exported, program, known), "has_program": has_program}
    context["assumed"] = assumed_lines(machine, errors, covariance)[0]
    files = {PAGE_NAME: render(replace(card, name="_common"), "check-program.md.j2", context, templates, language)}
    if has_program:
        files[PROGRAM_NAME] = render(card, "check-program.nc.j2", context, templates)
    return files


def _reading_u_um(known: Posterior | None, position_mm: FloatArray) -> list[list[float]] | None:
    """Expanded uncertainty of each reading, um: of the difference of E to the first position; None if nothing is known."""
    if known is None:
        return None
    spread, found = known.field(position_mm), list[list[float]]()
    for k in range(len(position_mm)):
        row = []
        for axis in range(3):
            weight = np.zeros_like(position_mm)
            weight[k, axis] += 1.0
            weight[0, axis] -= 1.0
            row.append(COVERAGE * spread.u_of(weight) / MM_PER_UM)
        found.append(row)
    return found


def _context(machine: Machine, exported: Export, program: CheckProgram, known: Posterior | None) -> Mapping[str, Any]:
    u_um = _reading_u_um(known, program.position_mm)
    rows = [
        {
            "number": k + 1,
            "position": program.position_mm[k].tolist(),
            "before": program.before_mm[k].tolist(),
            "off": (program.off_mm[k] / MM_PER_UM).tolist(),
            "on": (program.on_mm[k] / MM_PER_UM).tolist(),
            "added": (program.added_mm[k] / MM_PER_UM).tolist(),
            "u": None if u_um is None else u_um[k],
        }
        for k in range(len(program.position_mm))
    ]
    slips = [
        {"name": name, "number": number, "axis": axis, "right": right / MM_PER_UM, "wrong": wrong / MM_PER_UM}
        for name, number, axis, right, wrong in program.slips
    ]
    return {
        "machine_name": machine.name,
        "controller": exported.controller,
        "short_sha256": exported.manifest["files"][0]["sha256"][:12],
        "sign_statement": exported.manifest["sign_statement"],
        "files": exported.manifest["files"],
        "tool_offset_mm": [f"{value:g}" for value in machine.tool_offset_mm],
        "rows": rows,
        "slips": slips,
        "separation_um": program.separation_mm / MM_PER_UM,
        "safe_z_mm": program.safe_z_mm,
        "feed": FEED_MM_MIN,
        "approach_feed": APPROACH_FEED_MM_MIN,
    }
