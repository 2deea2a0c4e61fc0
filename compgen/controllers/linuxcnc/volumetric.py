"""LinuxCNC volumetric compensation: the table of the kinematics module ``volkins``, which comes with compgen.

The module (``templates/linuxcnc-volumetric/``, GPL-2.0-or-later) evaluates E = C P, or a grid, in every servo cycle, and
takes the tool offset from the control. Its arithmetic is that of :mod:`compgen.controllers.linuxcnc.volcomp`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.grids import equidistant_grid, take_loss_mm
from compgen.controllers.linuxcnc.text import take_machine_units
from compgen.controllers.linuxcnc.volcomp import (
    LEVERS,
    MOST_CURVES,
    MOST_NODES,
    MOST_TERMS,
    MOST_VERTICES,
    VolCurve,
    VolGrid,
    VolTable,
    VolTerm,
)
from compgen.controllers.linuxcnc.volcomp_parse import parse_volcomp
from compgen.controllers.linuxcnc.volumetric_notes import notes, shown_table
from compgen.controllers.linuxcnc.volumetric_text import (
    ANGLE_DIGITS,
    LENGTH_DIGITS,
    as_written,
    check_companion,
    is_companion,
)
from compgen.controllers.terms import error_terms
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERROR_INDEX
from compgen.core.points import Points
from compgen.errors import InputError
from compgen.model.volumetric import tool_of

#: Values of a grid are written with the digits of lengths; eight of them and the rounding of all curves of one axis.
_ROUNDED_CURVES = 12
#: Vertices of a grid along one axis: 46 x 46 x 46 is within what the module takes.
MOST_ALONG_AXIS = 46
#: Axes and joints that LinuxCNC knows.
_AXIS_LETTERS, _MOST_JOINTS = "XYZABCUVW", 16
#: A table whose errors change by more than this per mm of travel is refused; real machines stay below 0.01.
STEEPEST = 0.5


@dataclass(frozen=True)
class VolumetricSettings:
    """Settings ``[controllers.linuxcnc-volumetric]``.

    Parameters
    ----------
    form : ``"curves"`` (E = C P, with the tool in use) or ``"grid"`` (for the tool offset of the machine file only).
    loss_mm : loss by interpolation between nodes that is worth no further node.
    most_nodes : most nodes per axis.
    gauge_mm : tool offset of the error model where the control's tool offset is zero, for the pins ``volkins.gauge-*``.
    machine_units : [TRAJ] LINEAR_UNITS, ``"mm"`` or ``"inch"``; all files are written in it, and the table says which.
    coordinates : letter of the axis of each joint from joint 0 on, as in ``trivkins coordinates=XYYZA``.
    """

    form: str
    loss_mm: float
    most_nodes: int
    gauge_mm: tuple[float, float, float]
    machine_units: str
    coordinates: str


class LinuxcncVolumetric(Controller[VolumetricSettings, VolTable]):
    """``linuxcnc-volumetric``: all 21 errors on all 24 chains, with the tool in use."""

    name = "linuxcnc-volumetric"
    at_axes = True

    def read_settings(self, machine: Machine) -> VolumetricSettings:
        """Check the settings; all have defaults."""
        section = machine.controller_settings(self.name)
        settings = VolumetricSettings(
            form=section.take("form", tomlio.choice("curves", "grid"), "curves"),
            loss_mm=take_loss_mm(section),
            most_nodes=section.take("most_nodes", tomlio.whole(2, 1000), 400),
            gauge_mm=section.take("gauge_mm", tomlio.vector3, (0.0, 0.0, 0.0)),
            machine_units=take_machine_units(section),
            coordinates=section.take("coordinates", _coordinates, "XYZ"),
        )
        section.finish()
        return settings

    def basis(self, machine: Machine, settings: VolumetricSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per error, on equidistant nodes; the module evaluates E = C P itself, a grid holds products."""
        nodes = [
            equidistant_grid(
                machine,
                errors,
                axis,
                most=settings.most_nodes if settings.form == "curves" else min(settings.most_nodes, MOST_ALONG_AXIS),
                loss_mm=settings.loss_mm,
                products=settings.form == "grid",
            ).nodes_mm
            for axis in range(3)
        ]
        return error_terms(machine, errors, nodes)

    def build(
        self, machine: Machine, settings: VolumetricSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> VolTable:
        """Return curves and terms, or the grid made of them, rounded as they are written."""
        ordered = sorted(basis, key=lambda term: ERROR_INDEX[term.name])
        curves = tuple(_curve(machine, term, values[term.name]) for term in ordered)
        terms = tuple(
            VolTerm(part.output, term.name, float(-part.sign), LEVERS[0 if part.lever is None else part.lever + 1])
            for term in ordered
            for part in term.carrier
        )
        table = as_written(VolTable(curves, terms, unit=settings.machine_units))
        return table if settings.form == "curves" else as_written(_as_grid(machine, table))

    def context(self, machine: Machine, settings: VolumetricSettings, tables: VolTable) -> dict[str, Any]:
        """Return curves, terms or grid as they are written, the checksum, and what INI and HAL need."""
        return {**shown_table(tables), **notes(machine, settings.gauge_mm, settings.coordinates, tables)}

    def parse(self, machine: Machine, settings: VolumetricSettings, files: Sequence[SourceFile]) -> VolTable:
        """Read the table; INI, HAL and C sources that are exported beside it are only checked for their last line."""
        tables = [source for source in files if not is_companion(source)]
        for source in files:
            if is_companion(source):
                check_companion(source)
        if not tables:
            raise InputError("no table was given; volcomp.tab is due")
        if len(tables) > 1:
            raise tables[1].fail(f"is a second table beside {tables[0].path.name}; volkins reads one")
        return parse_volcomp(tables[0])

    def emulate(self, machine: Machine, settings: VolumetricSettings, tables: VolTable, points: Points) -> FloatArray:
        """Return q - P, with q the axis positions that put the tip where the command P says, tool offset of the points."""
        tool = tool_of(machine, points.tool_mm)
        return tables.inverse(points.position_mm, tool) - points.position_mm

    def violations(self, machine: Machine, settings: VolumetricSettings, tables: VolTable) -> list[str]:
        """Return travel that curves leave out, errors too steep for the inverse, and a unit that is not the machine's."""
        found = []
        if tables.unit != settings.machine_units:
            found.append(
                f"the table is in {tables.unit}, and machine_units is {settings.machine_units!r}: the control does not use "
                "such a table, and the machine cannot be switched on"
            )
        for axis, first, last, what in _spans(tables):
            found += coverage_violations(machine, axis, first, last, what)
        slope = tables.slope(machine.lower_mm, machine.upper_mm, tool_of(machine, None))
        if slope > STEEPEST:
            found.append(f"the errors change by up to {slope:.2f} mm per mm of travel; {STEEPEST} is the limit")
        return found

    def resolution_mm(self, settings: VolumetricSettings) -> float:
        """Half of the last decimal of every curve; angles with levers of up to 10 m."""
        return _ROUNDED_CURVES * 0.5 * (10.0**-LENGTH_DIGITS + 1e4 * 10.0**-ANGLE_DIGITS)

    def table_nodes_mm(
        self, machine: Machine, settings: VolumetricSettings, tables: VolTable
    ) -> tuple[FloatArray, ...]:
        """Return the nodes of curves or grid; a constant has none."""
        if tables.grid is not None:
            return nodes_by_axis(enumerate(_grid_lines(tables.grid)))
        return nodes_by_axis((curve.axis, curve.nodes_mm) for curve in tables.curves if np.ptp(curve.values) > 0)

    def usage(self, machine: Machine, settings: VolumetricSettings, tables: VolTable) -> list[Usage]:
        """Return curves, terms and nodes, or vertices, against the limits of the module."""
        if tables.grid is not None:
            return [Usage("vertices", tables.grid.vertices_mm[..., 0].size, MOST_VERTICES, "vertices")]
        nodes = max(len(curve.values) for curve in tables.curves)
        return [
            Usage("curves", len(tables.curves), MOST_CURVES, "curves"),
            Usage("terms", len(tables.terms), MOST_TERMS, "terms"),
            Usage("nodes of a curve", nodes, MOST_NODES, "nodes"),
        ]


def _coordinates(value: Any) -> str:
    """One letter of an axis for each joint, X, Y and Z among them."""
    letters = str(value).upper() if isinstance(value, str) else ""
    if set(letters) - set(_AXIS_LETTERS) or not set(AXES) <= set(letters) or len(letters) > _MOST_JOINTS:
        raise ValueError(f"the axis of each joint, e.g. 'XYZA', X, Y and Z among at most {_MOST_JOINTS}, is expected")
    return letters


def _curve(machine: Machine, term: Term, values: FloatArray) -> VolCurve:
    """Return a curve; a squareness is a constant, written as two equal nodes at the ends of the travel of its axis."""
    if term.axis is None:
        axis = AXES.index(term.name[-1])
        low, high = machine.axes[axis].range_mm
        return VolCurve(term.name, axis, low, high - low, np.repeat(values[0], 2))
    nodes = term.nodes_mm
    return VolCurve(term.name, term.axis, float(nodes[0]), float(nodes[1] - nodes[0]), np.asarray(values))


def _as_grid(machine: Machine, table: VolTable) -> VolTable:
    """Return the errors of curves at the vertices of the grid of their nodes, with the machine's own tool offset."""
    lines = []
    for axis in range(3):
        moving = [curve for curve in table.curves if curve.axis == axis and not re.match("E[ABC]0", curve.name)]
        low, high = machine.axes[axis].range_mm
        lines.append(moving[0].nodes_mm if moving else np.array([low, high]))
    vertices = np.array(list(product(*lines)))
    values = table.error(vertices, tool_of(machine, None)).reshape(*(len(line) for line in lines), 3)
    x, y, z = ((float(line[0]), float(line[1] - line[0])) for line in lines)
    return VolTable((), (), VolGrid((x[0], y[0], z[0]), (x[1], y[1], z[1]), values), table.unit)


def _grid_lines(grid: VolGrid) -> list[FloatArray]:
    counts = grid.vertices_mm.shape[:3]
    return [
        np.asarray(first + step * np.arange(count), dtype=np.float64)
        for first, step, count in zip(grid.first_mm, grid.step_mm, counts, strict=True)
    ]


def _spans(tables: VolTable) -> list[tuple[int, float, float, str]]:
    """Return (axis, first, last, what) of everything that depends on an axis."""
    if tables.grid is not None:
        lines = enumerate(_grid_lines(tables.grid))
        return [(axis, float(line[0]), float(line[-1]), "the grid") for axis, line in lines]
    return [
        (curve.axis, float(curve.nodes_mm[0]), float(curve.nodes_mm[-1]), f"the curve {curve.name}")
        for curve in tables.curves
        if np.ptp(curve.values) > 0
    ]
