"""What the tables of a control hold, in its own basis, from the files as they stand in the folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from compgen.controllers import CONTROLLERS
from compgen.controllers.base import Term
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.core.points import Points
from compgen.errors import CompgenError
from compgen.export.synthesis import projector
from compgen.report.html.folder import ControlFolder
from compgen.verify import ReadTables, read_tables

#: What is raised where machine file, errors and tables of a folder do not fit each other any more. The figures stand in
#: result.json; only what needs the tables themselves is left out then.
UNFIT = (CompgenError, ValueError, ArithmeticError, LookupError, OSError)


@dataclass(frozen=True)
class TableCurve:
    """Values of one table of a control over its axis, ``unit`` um or urad.

    ``error`` is True where the table holds one of the 21 errors by its name, else it holds a correction. A constant has
    no axis and one value.
    """

    name: str
    axis: str | None
    position_mm: FloatArray
    value: FloatArray
    unit: str
    error: bool


def table_curves(machine: Machine | None, errors: ErrorTable | None, control: ControlFolder) -> tuple[TableCurve, ...]:
    """Return the tables of a control as they act: its emulation, written in the basis of its tables.

    The values are those that reproduce the emulated correction over the volume best, which is all there is to tell
    where a control lets one table stand for another. Empty where machine, errors or files are missing, or where the
    control cannot read them.
    """
    if machine is None or errors is None or not control.files or control.name not in CONTROLLERS:
        return ()
    try:
        parsed = _parsed(machine, control)
        return _curves(_as_exported(machine, control), errors, parsed)
    except UNFIT:
        return ()


def read_back(machine: Machine, control: ControlFolder) -> Callable[[Points], FloatArray] | None:
    """Return what the files of a control add at points, (n, 3), mm; None where they cannot be read with this machine."""
    try:
        parsed = _parsed(machine, control)
    except UNFIT:
        return None
    if control.name not in CONTROLLERS or not control.files:
        return None
    moved = _as_exported(machine, control)
    return lambda points: parsed.mean_correction(moved, points.position_mm)


def _as_exported(machine: Machine, control: ControlFolder) -> Machine:
    """The machine with the settings that the manifest states; options of the run may differ from the machine file."""
    settings = control.manifest.get("settings")
    for key, value in (settings if isinstance(settings, dict) else {}).items():
        machine = machine.with_setting(control.name, key, value)
    return machine


def _parsed(machine: Machine, control: ControlFolder) -> ReadTables:
    return read_tables(_as_exported(machine, control), [item.path for item in control.files], control.name)


def _curves(machine: Machine, errors: ErrorTable, parsed: ReadTables) -> tuple[TableCurve, ...]:
    basis = parsed.controller.basis_of(machine, parsed.settings, errors, parsed.tables)
    solver = projector(machine, basis, anchored=parsed.controller.anchored)
    start = np.concatenate([term.start for term in basis])
    held = parsed.mean_correction(machine, solver.position_mm)
    values = solver.by_name(solver.project(held, start))
    return tuple(_curve(term, values[term.name]) for term in basis)


def _curve(term: Term, values: FloatArray) -> TableCurve:
    axis = None if term.axis is None else AXES[term.axis]
    named = term.name in CURVE_NAMES or term.name in SQUARENESS_NAMES
    if named:
        unit, scale = error_named(term.name).unit, 1.0 / error_named(term.name).si_per_unit
    else:
        angular = any(part.lever is not None for part in term.carrier)
        unit, scale = ("urad", 1e6) if angular else ("um", 1e3)
    return TableCurve(term.name, axis, np.asarray(term.nodes_mm), np.asarray(values) * scale, unit, named)
