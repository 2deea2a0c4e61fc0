"""Measured diagonals (ISO 230-6): each evaluated as in ISO 230-2, and the largest of the four body diagonals.

From the deviations of the measured from the commanded distance along a diagonal: E, B, M, R of each diagonal as along
an axis; E_d and B_d are the largest E and B of the four body diagonals. Face diagonals are evaluated one by one.
Differences of the diagonals' lengths indicate squareness: NPP - PPP = 2 EC0Y X Y / L over a box X, Y, Z with the
diagonal L.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from compgen.accuracy.evaluate import Accuracy
from compgen.accuracy.field import Figure
from compgen.accuracy.positioning import (
    LATEST,
    MEAN_UP,
    NO_BUDGET,
    RunStatistics,
    SetupBudget,
    combine,
    figure,
    positioning_test,
    run_statistics,
)
from compgen.data.axis_runs import Diagonals, along_mm
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, BODY_DIAGONALS, MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES
from compgen.errors import InputError
from compgen.kinematics.first_order import c_matrix

#: Figures of ISO 230-2 that are not evaluated along diagonals.
_NOT_ALONG = ("A", "A_up", "A_down")
#: Corners of the boxes of two diagonals closer than this are the same, mm.
SAME_CORNER_MM = 0.01
NO_PROOF = "errors of opposite sign cancel on a diagonal: four equal diagonals do not prove a good machine"


@dataclass(frozen=True)
class DiagonalRun:
    """One measured diagonal: ends (3,) in mm in the direction of its name, and its statistics over the distance."""

    name: str
    start_mm: FloatArray
    end_mm: FloatArray
    statistics: RunStatistics

    @property
    def length_mm(self) -> float:
        """Distance of the ends."""
        return float(np.linalg.norm(self.end_mm - self.start_mm))

    @property
    def unit(self) -> FloatArray:
        """Direction (3,) from start to end."""
        return np.asarray((self.end_mm - self.start_mm) / self.length_mm)


def diagonal_runs(machine: Machine, diagonals: Diagonals) -> dict[str, DiagonalRun]:
    """Return the statistics of every measured diagonal by its name.

    Raises
    ------
    InputError
        for positions outside the travel, and for a direction measured at only some positions.
    """
    for axis, values in enumerate(diagonals.position_mm.T):
        low, high = machine.axes[axis].range_mm
        for row in np.flatnonzero((values < low - 1e-3) | (values > high + 1e-3))[:1].tolist():
            file, line = diagonals.origin[row] if diagonals.origin else (None, None)
            text = f"{AXES[axis]} = {values[row]:g} mm is outside the travel {low:g} to {high:g} mm"
            raise InputError(text, file=file, line=line, field=f"column {AXES[axis].lower()}_mm")
    found = {}
    for name in diagonals.names:
        rows = diagonals.rows(name)
        points = diagonals.position_mm[rows]
        distance = along_mm(points, name)
        try:
            own = run_statistics(distance, diagonals.direction[rows].astype(np.float64), diagonals.deviation_mm[rows])
        except InputError as error:
            file = diagonals.origin[int(rows[0])][0] if diagonals.origin else None
            raise InputError(f"{name}, distance along it: {error.message}", file=file) from None
        found[name] = DiagonalRun(name, points[int(np.argmin(distance))], points[int(np.argmax(distance))], own)
    return found


def accuracy_of_diagonals(
    machine: Machine,
    runs: Mapping[str, DiagonalRun],
    edition: int = LATEST,
    budgets: Mapping[str, SetupBudget] | None = None,
) -> Accuracy:
    """Return the figures of each diagonal, of all four (``Ed``, ``Bd``), and the squareness that they indicate.

    Parameters
    ----------
    machine : defines how squareness errors act.
    runs : by name.
    edition : of ISO 230-2.
    budgets : contribution of the set-up to the uncertainties, by axis; along a diagonal expansions are weighted by the
    squares of its direction cosines.
    """
    groups: dict[str, dict[str, Figure]] = {}
    targets = {}
    for name, run in runs.items():
        budget = budget_along(run, budgets or {})
        test = positioning_test(run.statistics, edition, budget)
        targets[name] = test.targets
        groups[name] = {
            key: replace(item, meaning=f"diagonal {name}, ISO 230-6: {item.meaning}")
            for key, item in test.figures.items()
            if key not in _NOT_ALONG
        }
        ways, last = run.statistics.directions, len(run.statistics.position_mm) - 1
        ends = [(sign / len(ways), way, at) for way in ways for sign, at in ((1.0, last), (-1.0, 0))]
        said = "mean of both directions" if len(ways) == 2 else "of the measured direction"
        text = f"diagonal {name}: deviation of its length from end to end, {said}; not a standard figure"
        groups[name]["D"] = figure(run.statistics, combine(run.statistics, ends), text, budget)
    statements = [f"ISO 230-6, each diagonal as ISO 230-2:{edition}", *(_described(run) for run in runs.values())]
    missing = [name for name in BODY_DIAGONALS if name not in runs]
    corners = {name: np.sort([run.start_mm, run.end_mm], axis=0) for name, run in runs.items()}
    other = [n for n in BODY_DIAGONALS if not missing and np.max(np.abs(corners[n] - corners["PPP"])) > SAME_CORNER_MM]
    together: dict[str, dict[str, Figure]] = {}
    if missing:
        statements.append(f"Ed, Bd: not given; all four body diagonals are needed, {', '.join(missing)} missing")
    elif other:
        statements.append(f"Ed, Bd: not given; {', '.join(other)} belong to a different box than PPP")
    else:
        together["diagonals"], remarks = _largest(runs, groups)
        together["squareness indication"] = _squareness(machine, runs, groups)
        statements += [*remarks, _SQUARENESS_TEXT]
    statements += [NO_PROOF, "checked against published formulas and worked examples, not certified"]
    return Accuracy({**together, **groups}, tuple(statements), targets)


def budget_along(run: DiagonalRun, budgets: Mapping[str, SetupBudget]) -> SetupBudget:
    """Return the budget of a diagonal: that of an axis with the expansion coefficients weighted by squared cosines."""
    known = [budgets.get(axis, NO_BUDGET) for axis in AXES]
    squares = run.unit**2
    mixed = float(squares @ [item.expansion_um_per_m_k for item in known])
    moving = int(np.argmax(squares))
    return replace(known[moving], expansion_um_per_m_k=mixed)


def _described(run: DiagonalRun) -> str:
    ends = " to ".join(f"({', '.join(f'{value:g}' for value in point)})" for point in (run.start_mm, run.end_mm))
    ways = "both directions" if run.statistics.bidirectional else (
        "only in its direction" if MEAN_UP in run.statistics.directions else "only against its direction"
    )  # fmt: skip
    return f"{run.name}: {ends} mm, {run.length_mm:g} mm, {len(run.statistics.position_mm)} positions, {ways}"


def _largest(
    runs: Mapping[str, DiagonalRun], groups: Mapping[str, Mapping[str, Figure]]
) -> tuple[dict[str, Figure], list[str]]:
    """Return Ed and Bd, or why they cannot be given."""
    one_way = [name for name in BODY_DIAGONALS if not runs[name].statistics.bidirectional]
    if one_way:
        return {}, [f"Ed, Bd: not given; {', '.join(one_way)} measured in only one direction"]
    found = {}
    for symbol, key, text in (("Ed", "E", "systematic error"), ("Bd", "B", "reversal error")):
        worst = max(BODY_DIAGONALS, key=lambda name: groups[name][key].value)
        own = groups[worst][key]
        meaning = f"largest {text} {key} of the four body diagonals, {worst}; ISO 230-6"
        found[symbol] = replace(own, meaning=meaning)
    return found, []


_SQUARENESS_TEXT = (
    "squareness: an indication from differences of the diagonals' lengths (NPP - PPP = 2 EC0Y X Y / L, and so on); slopes of "
    "straightness and angular errors have the same effect"
)


def _squareness(
    machine: Machine, runs: Mapping[str, DiagonalRun], groups: Mapping[str, Mapping[str, Figure]]
) -> dict[str, Figure]:
    """Solve the four length deviations for their common part and the three squareness errors.

    D = c + u . (C(end) - C(start)) P with P the squareness errors alone: four equations, four unknowns.
    """
    first = c_matrix(machine, np.array([runs[name].start_mm for name in BODY_DIAGONALS]), np.zeros(3))
    last = c_matrix(machine, np.array([runs[name].end_mm for name in BODY_DIAGONALS]), np.zeros(3))
    units = np.array([runs[name].unit for name in BODY_DIAGONALS])
    effect = np.einsum("di,dij->dj", units, (last - first)[:, :, -len(SQUARENESS_NAMES) :])
    weights = np.linalg.inv(np.column_stack([np.ones(len(units)), effect]))[1:]
    ends = [groups[name]["D"] for name in BODY_DIAGONALS]
    found = {}
    for name, row in zip(SQUARENESS_NAMES, weights * MM_PER_UM / RAD_PER_URAD, strict=True):
        meaning = f"indication of squareness {name} from differences of the body diagonals; not a standard figure"
        value = float(sum(w * item.value for w, item in zip(row, ends, strict=True)))
        u = math.sqrt(sum((w * item.u) ** 2 for w, item in zip(row, ends, strict=True)))  # independent of each other
        parts = {
            key: math.sqrt(sum((w * i.contributions.get(key, 0.0)) ** 2 for w, i in zip(row, ends, strict=True)))
            for key in dict.fromkeys(key for item in ends for key in item.contributions)
        }
        found[name] = Figure(value, u, "urad", meaning, parts)
    return found
