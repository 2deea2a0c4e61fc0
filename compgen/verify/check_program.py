"""Five positions at the machine that show which sign, axis or unit is wrong, with what must be read there.

The readings come from the parsed tables (the emulated control) and the exact machine with the given errors; every
reading counts from the one at the first position, so that any displacement instrument will do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers import SourceFile, controller_named
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.points import Points
from compgen.core.reversal import ReversalCurves
from compgen.export import Export
from compgen.export.render import Format, load_format, render, template_folders
from compgen.model.exact import exact_error
from compgen.verify.crash_test import signed_permutations
from compgen.verify.verify import ReadTables

#: Candidates per axis for the positions.
LEVELS = 5
#: Way of the last approach, at most, and as a share of the travel, mm.
APPROACH_MM, APPROACH_SHARE = 10.0, 0.02
#: Positions stay this many times that way inside the travel, so that no move ends at a software limit.
MARGIN = 1.5
#: Feed between the positions and over the last approach, mm/min.
FEED_MM_MIN, APPROACH_FEED_MM_MIN = 1000, 200
#: In a folder of their own, so that nobody takes the program for a table.
PROGRAM_NAME, PAGE_NAME = "check/check-program.nc", "check/check-program.md"


@dataclass(frozen=True)
class CheckProgram:
    """Positions and readings.

    Parameters
    ----------
    position_mm : the five positions in machine coordinates, shape (5, 3); the first is the zero of all readings.
    before_mm : from where each is approached: X and Y from below, Z from above, shape (5, 3).
    safe_z_mm : Z on the way between two positions.
    added_mm : what the control adds to the command there, shape (5, 3).
    off_mm, on_mm : readings (actual tip minus commanded) without and with compensation, less the first, shape (5, 3).
    separation_mm : every wrong signed permutation of the axes changes some reading by at least this.
    slips : common mistakes, as (what, position number, axis, right reading, wrong reading) in mm, with compensation on.
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
    machine : the machine; all positions and approaches lie within its travel.
    tables : the tables as they were parsed.
    errors : how the machine errs, usually the identified errors (mm, rad).
    reversal : what it does differently in its two directions; every position is approached from one side.
    """
    way_mm = np.minimum(APPROACH_MM, APPROACH_SHARE * (machine.upper_mm - machine.lower_mm))
    candidates = _candidates(machine, way_mm)
    added = tables.correction(machine, _approached(candidates))
    others = _other_readings(machine, tables, candidates)
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


def _other_readings(machine: Machine, tables: ReadTables, position_mm: FloatArray) -> dict[str, FloatArray]:
    """What the same tables add at positions (n, 3) if the control reads them otherwise, by words, each (n, 3), mm."""
    control = tables.controller
    return {
        words: np.asarray(control.emulate(machine, settings, tables.tables, _approached(position_mm)))
        for words, settings in control.other_readings(tables.settings, tables.tables).items()
    }


def _apart(moved: Sequence[FloatArray]) -> FloatArray:
    """Smallest difference between any two readings of the tables, each (n, 3): shape (n, 3), mm."""
    return np.asarray(np.min([np.abs(a - b) for a, b in combinations(moved, 2)], axis=0))


def _readings(
    moved_mm: FloatArray, others_mm: Mapping[str, FloatArray], on_mm: FloatArray
) -> list[tuple[str, int, str, float, float]]:
    """Slips of the other readings, all at the position and axis that tell every two of them apart best."""
    if not others_mm:
        return []
    place, axis = divmod(int(np.argmax(_apart([moved_mm, *others_mm.values()]))), 3)
    right = float(on_mm[place, axis])
    return [
        (name, place + 1, AXES[axis], right, right + float(other[place, axis] - moved_mm[place, axis]))
        for name, other in others_mm.items()
    ]


def _approached(position_mm: FloatArray) -> Points:
    """Points with the direction of the last travel of every axis: X and Y upwards, Z downwards."""
    return Points(position_mm, approach=_directions(position_mm))


def _directions(position_mm: FloatArray) -> FloatArray:
    return np.tile([1.0, 1.0, -1.0], (len(position_mm), 1))


def _candidates(machine: Machine, way_mm: FloatArray) -> FloatArray:
    """The reference point (moved into reach) and a grid within the travel less the approach, shape (n, 3), mm."""
    low, high = machine.lower_mm + MARGIN * way_mm, machine.upper_mm - MARGIN * way_mm
    lines = [np.linspace(low[k], high[k], LEVELS) for k in range(3)]
    first = np.clip(machine.reference_point_mm, low, high)
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.round(np.vstack([first, grid]), 3)


def _choose(added_mm: FloatArray, others_mm: Sequence[FloatArray]) -> list[int]:
    """Indices of five candidates: the first, the largest change of X, Y and Z, and the one that tells most apart.

    The last one tells wrong permutations of the axes apart, and the other readings of the tables (n, 3) from each other,
    as far as the first four do not.
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
    """Mistakes as (what, what the control then adds at each position, less the first), shape (5, 3), mm."""
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
    """Where a mistake shows most: position number, axis, right and wrong reading with compensation on."""
    place, axis = divmod(int(np.argmax(np.abs(change_mm))), 3)
    right = float(on_mm[place, axis])
    return name, place + 1, AXES[axis], right, right + float(change_mm[place, axis])


def check_files(
    machine: Machine,
    exported: Export,
    errors: ErrorTable,
    templates: Path | None = None,
    reversal: ReversalCurves | None = None,
) -> dict[str, str]:
    """Return ``check/check-program.md`` and, for controls whose motion in machine coordinates is documented, the program.

    Parameters
    ----------
    machine, errors : what moves, and how it errs.
    exported : the files; the readings are those of their text.
    templates : a user's templates folder, searched first.
    reversal : as in :func:`check_program`.
    """
    control = controller_named(exported.controller)
    settings = control.read_settings(machine)
    sources = [SourceFile(Path(name), text) for name, text in exported.files.items()]
    tables = ReadTables(control, settings, control.parse(machine, settings, sources), ())
    card = load_format(exported.controller, templates)
    program = check_program(machine, tables, errors, reversal)
    has_program = _has_template(card, templates)
    context = {**_context(machine, exported, program), "has_program": has_program}
    files = {PAGE_NAME: render(replace(card, name="_common"), "check-program.md.j2", context, templates)}
    if has_program:
        files[PROGRAM_NAME] = render(card, "check-program.nc.j2", context, templates)
    return files


def _has_template(card: Format, templates: Path | None) -> bool:
    """Whether the control's folder has a program; without one only the page is written."""
    folders = template_folders(card.name, templates)
    return any((folder / card.name / "check-program.nc.j2").is_file() for folder in folders)


def _context(machine: Machine, exported: Export, program: CheckProgram) -> Mapping[str, Any]:
    rows = [
        {
            "number": k + 1,
            "position": program.position_mm[k].tolist(),
            "before": program.before_mm[k].tolist(),
            "off": (program.off_mm[k] / MM_PER_UM).tolist(),
            "on": (program.on_mm[k] / MM_PER_UM).tolist(),
            "added": (program.added_mm[k] / MM_PER_UM).tolist(),
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
