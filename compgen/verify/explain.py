"""Why a control's table is as it is: what it corrects, what stays, what the next option would buy, and what it uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers import AnyController, SourceFile, controller_named
from compgen.controllers.base import Usage
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, error_named
from compgen.core.reversal import ReversalCurves
from compgen.export import Export
from compgen.export.synthesis import projector
from compgen.model.volumetric import tool_of
from compgen.verify.capability import Capability, ControlResult, capability, missing_notes
from compgen.verify.levels import Level, level_key
from compgen.verify.reversal import left_by_reversal
from compgen.verify.safety import Step, safety_of

#: Errors that stay by less than this are taken as corrected, um.
CORRECTED_UM = 0.1


@dataclass(frozen=True)
class Fate:
    """What becomes of one error: displacement in um that it causes by itself, and that it leaves; why it stays."""

    name: str
    before_um: float
    after_um: float
    why: str


@dataclass(frozen=True)
class Explanation:
    """Result of :func:`explain`.

    ``nodes`` holds number, first and last node and smallest and largest step (mm) of the tables over each axis,
    ``rounding_um`` the most that rounding changes a correction, ``steps`` the largest steps between neighbouring nodes.
    """

    controller: str
    machine: str
    level: str
    fates: tuple[Fate, ...]
    nodes: Mapping[str, Mapping[str, float]]
    rounding_um: float
    steps: tuple[Step, ...]
    usage: tuple[Usage, ...]
    violations: tuple[str, ...]
    options: Capability
    own: ControlResult | None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "controller": self.controller,
            "level": self.level,
            "errors": [asdict(item) for item in self.fates],
            "nodes": {axis: dict(item) for axis, item in self.nodes.items()},
            "rounding_um": self.rounding_um,
            "steps": [asdict(item) for item in self.steps],
            "limits": [{**asdict(item), "share": item.share} for item in self.usage],
            "limits_broken": list(self.violations),
            "options": self.options.as_dict(),
        }


def explain(
    machine: Machine,
    errors: ErrorTable,
    exported: Export,
    *,
    reversal: ReversalCurves | None = None,
    templates: Path | None = None,
) -> Explanation:
    """Explain exported files from their text; ``errors``, ``reversal`` and ``templates`` as they were exported with."""
    control = controller_named(exported.controller)
    settings = control.read_settings(machine)
    tables = control.parse(machine, settings, [SourceFile(Path(name), text) for name, text in exported.files.items()])
    solver = projector(machine, control.basis(machine, settings, errors), anchored=control.anchored)
    values = np.concatenate([term.start for term in solver.basis])
    level = level_key(solver.basis)
    safety = safety_of(machine, control, tables, lambda part: solver.field(values, part))
    rest = None  # what tables of one direction do not take out
    if reversal is not None:
        rest = reversal.without(control.reversal_in_tables(settings, reversal))
    known = rest if rest is not None and rest.curves else None
    options = capability(machine, errors, reversal=known, templates=templates, controllers=(control.name,))
    usage = sorted(control.usage(machine, settings, tables), key=lambda item: -item.share)
    return Explanation(
        controller=control.name,
        machine=machine.name,
        level=level,
        fates=tuple(_fates(machine, errors, Level("own", solver), level, anchored=control.anchored))
        + tuple(_reversal_fates(reversal, rest)),
        nodes=_nodes(control, machine, settings, tables),
        rounding_um=control.resolution_mm(settings) / MM_PER_UM,
        steps=safety.steps,
        usage=tuple(usage),
        violations=tuple(exported.violations),
        options=options,
        own=next((item for item in options.controls if item.own), None),
        notes=tuple(missing_notes(errors)),
    )


def _fates(machine: Machine, errors: ErrorTable, own: Level, level: str, *, anchored: bool) -> list[Fate]:
    tool_mm = tool_of(machine, None)
    (before,) = Level("nothing").left_alone_um(machine, errors, [tool_mm], anchored=anchored)
    (after,) = own.left_alone_um(machine, errors, [tool_mm], anchored=anchored)
    return [
        Fate(name, before[name], after[name], _why(name, level) if after[name] > CORRECTED_UM else "")
        for name in sorted(before, key=lambda name: -after[name])
    ]


def _why(name: str, level: str) -> str:
    """Say in words why a control of this level leaves an error."""
    error = error_named(name)
    if level in ("products", "volumetric"):
        return "the nodes of the tables do not follow it closely"
    if error.kind == "angular":
        return (
            "it acts with a lever that changes with another axis: products of tables or a volumetric function hold it"
        )
    if level == "pitch":
        across = "squareness" if error.kind == "squareness" else "straightness"
        return f"{across} moves the tool across the axis: tables of one axis over another hold it"
    return "the nodes of the tables do not follow it closely"


def _reversal_fates(reversal: ReversalCurves | None, rest: ReversalCurves | None) -> list[Fate]:
    before, after = (left_by_reversal(part, corrected=False) for part in (reversal, rest))
    why = "the tables act in both directions alike: the control's backlash parameter takes the part along the axis"
    return [Fate(name, value, after.get(name, 0.0), why if name in after else "") for name, value in before.items()]


def _nodes(control: AnyController, machine: Machine, settings: Any, tables: Any) -> dict[str, dict[str, float]]:
    found = {}
    for letter, nodes in zip(AXES, control.table_nodes_mm(machine, settings, tables), strict=True):
        if len(nodes) > 1:
            steps = np.diff(nodes)
            found[letter] = {
                "nodes": len(nodes),
                "first_mm": float(nodes[0]),
                "last_mm": float(nodes[-1]),
                "smallest_step_mm": float(steps.min()),
                "largest_step_mm": float(steps.max()),
            }
    return found


__all__ = ["Explanation", "Fate", "explain"]
