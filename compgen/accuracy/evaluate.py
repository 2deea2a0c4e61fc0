"""All figures of a machine from its errors, or of its axes from positioning runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from compgen.accuracy.budget import NO_BUDGET, Budget
from compgen.accuracy.errors import (
    axis_figures,
    diagonal_figures,
    error_figures,
    orientation_figures,
    straightness_figures,
)
from compgen.accuracy.field import Alignment, Field, aligned, volume_figures
from compgen.accuracy.figure import Figure
from compgen.accuracy.iso230_2 import LATEST, positioning_test
from compgen.accuracy.reversal import KnownReversal, reversal_figures
from compgen.accuracy.runs import RunStatistics
from compgen.accuracy.source import ErrorSource, grid_points
from compgen.accuracy.vdi3441 import vdi_3441
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import error_named
from compgen.model.grid import volume_grid

#: Points of the volume, and of the smaller grid on which pairs of points are looked at.
MOST_POINTS, MOST_IN_PAIRS = 20_000, 1_750

Groups = Mapping[str, Mapping[str, Figure]]


@dataclass(frozen=True)
class Accuracy:
    """Figures by group (``volume``, ``orientation``, ``axes``, ``diagonals``, ``errors``, ``X`` ...) and key.

    ``statements`` says in words what they stand for: alignment, reference line, tool offset, edition. ``targets`` has the
    values at each target of groups that stem from runs (:class:`compgen.accuracy.iso230_2.PositioningTest`).
    """

    groups: Groups
    statements: tuple[str, ...]
    targets: Mapping[str, Mapping[str, FloatArray]] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        groups = {name: {key: item.summary() for key, item in group.items()} for name, group in self.groups.items()}
        found: dict[str, Any] = {"figures": groups, "statements": list(self.statements)}
        if self.targets:
            found["targets"] = {
                name: {key: values.tolist() for key, values in columns.items()}
                for name, columns in self.targets.items()
            }
        return found


def nodes_of(machine: Machine, *sources: ErrorSource) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the nodes of the curves of all sources by axis; the ends of the travel where there is no curve."""
    found = []
    for k in range(3):
        nodes = [np.array(machine.axes[k].range_mm)]
        for source in sources:
            nodes += [c.position_mm for name, c in source.errors.curves.items() if error_named(name).axis == k]
        found.append(np.unique(np.concatenate(nodes)))
    return found[0], found[1], found[2]


def volume_fields(
    machine: Machine, sources: tuple[ErrorSource, ...], alignment: Alignment
) -> list[tuple[Field, Field]]:
    """Return for each source its aligned field over the volume, and over the smaller grid of the pairs.

    All have the same points: the nodes of all curves within the travel and the middles between them.
    """
    nodes = nodes_of(machine, *sources)
    grids = [grid_points(machine, volume_grid(machine, nodes, most).levels_mm) for most in (MOST_POINTS, MOST_IN_PAIRS)]
    found = []
    for source in sources:
        full, pairs = (aligned(machine, source.field(points), alignment) for points in grids)
        found.append((full, pairs))
    return found


def accuracy_of_errors(
    source: ErrorSource, alignment: Alignment = "axes", line: str = "ls", reversal: KnownReversal | None = None
) -> Accuracy:
    """Return the figures of a machine: its volume (ISO 230-1), axes, diagonals (ISO 230-6), and each error.

    Parameters
    ----------
    source : errors and their uncertainty.
    alignment : how the volume is aligned, see :func:`compgen.accuracy.field.aligned`.
    line : reference line of straightness and squareness: ``"ls"``, ``"end-point"``, ``"minzone"``.
    reversal : what the axes do differently in their two directions, where it is known.
    """
    ((full, pairs),) = volume_fields(source.machine, (source,), alignment)
    groups = {"volume": volume_figures(full, pairs), **groups_of_errors(source, line)}
    straight = straightness_figures(source)
    groups["straightness"] = {
        f"{name} {kind}": item for name, kinds in straight.items() for kind, item in kinds.items()
    }
    if reversal is not None and reversal.curves is not None:
        groups["reversal"] = reversal_figures(source, reversal.curves)
    said = () if reversal is None else (reversal.text,)
    return Accuracy(groups, (*statements_of(source.machine, full, line), *said))


def groups_of_errors(source: ErrorSource, line: str) -> dict[str, dict[str, Figure]]:
    """Return the groups of figures beside the volume's."""
    return {
        "orientation": orientation_figures(source),
        "axes": axis_figures(source),
        "diagonals": diagonal_figures(source),
        "errors": error_figures(source, line),
    }


def statements_of(machine: Machine, field: Field, line: str) -> tuple[str, ...]:
    """Say what the figures of a volume stand for."""
    tool = ", ".join(f"{value:g}" for value in machine.tool_offset_mm)
    ranges = ", ".join(f"{low:g} ... {high:g}" for low, high in (axis.range_mm for axis in machine.axes))
    return (
        f"volume {ranges} mm (X, Y, Z), {len(field)} points",
        f"alignment: {field.alignment}",
        f"tool offset ({tool}) mm",
        f"reference line of straightness and squareness: {line}",
        "checked against published formulas and worked examples, not certified",
    )


def accuracy_of_runs(
    statistics: Mapping[str, RunStatistics], edition: int = LATEST, budgets: Mapping[str, Budget] | None = None
) -> Accuracy:
    """Return ISO 230-2 and, where the runs allow it, VDI/DGQ 3441 of every axis; groups are the axes' letters.

    Parameters
    ----------
    statistics : by axis.
    edition : of ISO 230-2.
    budgets : what the set-up adds to the uncertainties, by axis.
    """
    groups: dict[str, dict[str, Figure]] = {}
    targets = {}
    for axis, item in statistics.items():
        budget = (budgets or {}).get(axis, NO_BUDGET)
        test = positioning_test(item, edition, budget)
        groups[axis], targets[axis] = dict(test.figures), test.targets
        if item.bidirectional and item.repeated:
            groups[axis] |= {f"VDI {key}": figure for key, figure in vdi_3441(item, budget).items()}
    statements = (f"ISO 230-2:{edition}", "checked against published formulas and worked examples, not certified")
    return Accuracy(groups, statements, targets)


def narrowed(machine: Machine, lower_mm: FloatArray, upper_mm: FloatArray) -> Machine:
    """Return the machine with its travel cut to what is known of it; the reference point moves inside."""
    axes = []
    for k, axis in enumerate(machine.axes):
        low, high = max(axis.range_mm[0], float(lower_mm[k])), min(axis.range_mm[1], float(upper_mm[k]))
        inside = axis.nodes_mm[(axis.nodes_mm > low) & (axis.nodes_mm < high)]
        axes.append(replace(axis, range_mm=(low, high), nodes_mm=np.array([low, *inside, high])))
    point = [
        min(max(value, a.range_mm[0]), a.range_mm[1]) for value, a in zip(machine.reference_point_mm, axes, strict=True)
    ]
    return replace(machine, axes=(axes[0], axes[1], axes[2]), reference_point_mm=(point[0], point[1], point[2]))
