"""``twincat-lists``: compensation value lists of the TwinCAT CNC axes (TF5200): leadscrew, cross and plane tables.

Source: Beckhoff TF5200 "Axis compensation" and "Axis compensation parameters" (P-COMP-00001 ... 00061). The sign of
cross and plane tables is stated nowhere in public; it is the setting ``cross_sign``.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.twincat.basis import lists_from, rounded, twincat_basis
from compgen.controllers.twincat.notes import twincat_notes
from compgen.controllers.twincat.settings import TwincatSettings, read_twincat_settings
from compgen.controllers.twincat.tables import (
    MM_PER_UNIT,
    AxisList,
    Screw,
    TwincatTables,
    list_usage,
    spans_mm,
    stored_sums,
)
from compgen.controllers.twincat.text import Foreign, parse_axis_list
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves
from compgen.errors import CompgenWarning, InputError

_LARGEST_SGN32 = 2.0**31 - 1


class TwincatLists(Controller[TwincatSettings, TwincatTables]):
    """TwinCAT CNC axis lists: one file per axis."""

    name = "twincat-lists"
    bidirectional = True

    def read_settings(self, machine: Machine) -> TwincatSettings:
        """Check the settings of the machine file; all have defaults."""
        return read_twincat_settings(machine, self.name)

    def basis(self, machine: Machine, settings: TwincatSettings, errors: ErrorTable) -> list[Term]:
        """Return pitch, one cross function and one plane of products per slave axis."""
        return twincat_basis(machine, settings, errors)

    def build(
        self, machine: Machine, settings: TwincatSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> TwincatTables:
        """Return the tables in 0.1 um, signs as the control stores them."""
        return TwincatTables(lists_from(machine, settings, basis, values))

    def reversal_in_tables(self, settings: TwincatSettings, reversal: ReversalCurves) -> ReversalCurves:
        """Only the reversal of an axis along itself goes into tables."""
        return ReversalCurves({key: curve for key, curve in reversal.curves.items() if key[0] == key[1]})

    def with_reversal(
        self, machine: Machine, settings: TwincatSettings, tables: TwincatTables, reversal: ReversalCurves
    ) -> TwincatTables:
        """Return the tables with a bilateral leadscrew table for the reversal of each axis along itself."""
        lists = dict(tables.lists)
        for (axis, _), curve in sorted(reversal.curves.items()):
            screw = lists[axis].screw
            if screw is not None and np.max(np.abs(curve.value)) >= WORTH_MM:
                lists[axis] = replace(lists[axis], screw=_two_sided(settings, screw, curve))
        return TwincatTables(lists)

    def context(self, machine: Machine, settings: TwincatSettings, tables: TwincatTables) -> dict[str, Any]:
        """Return the lists with their numbers, the signs with a worked number, and what must be set."""
        return {
            **twincat_notes(machine, settings, tables),
            "digits": settings.digits,
            "n_cycles": settings.n_cycles,
            "lists": [_list_context(settings, axis, tables.lists.get(axis, AxisList())) for axis in range(3)],
        }

    def parse(self, machine: Machine, settings: TwincatSettings, files: Sequence[SourceFile]) -> TwincatTables:
        """Read the lists of one or more axes, in any order."""
        if not files:
            raise InputError("no axis list was given; achskw1.lis is one")
        return self._parsed(settings, files, None)

    def parse_foreign(
        self, machine: Machine, settings: TwincatSettings, files: Sequence[SourceFile]
    ) -> tuple[TwincatTables, list[str]]:
        """Read lists of a real control: reserved entries and other structures are passed over, other axes kept apart."""
        foreign = Foreign()
        tables = self._parsed(settings, files, foreign)
        if not any(item != AxisList() for item in tables.lists.values()):
            raise files[0].fail("; ".join(["holds no table of an axis of the machine file", *foreign.remarks()]))
        return tables, foreign.remarks()

    @staticmethod
    def _parsed(settings: TwincatSettings, files: Sequence[SourceFile], foreign: Foreign | None) -> TwincatTables:
        lists: dict[int, AxisList] = {}
        seen: dict[int, SourceFile] = {}
        for source in files:
            axis, item = parse_axis_list(
                source, settings.axis_names, settings.logical_axes, settings.increment_mm, foreign
            )
            if axis is None:
                continue
            if axis in seen:
                raise source.fail(f"is a second list of axis {AXES[axis]} beside {seen[axis].path.name}")
            lists[axis], seen[axis] = item, source
        return TwincatTables(lists)

    def emulate(self, machine: Machine, settings: TwincatSettings, tables: TwincatTables, points: Points) -> FloatArray:
        """Return the sum of all tables of each axis with the signs of the settings.

        A bilateral leadscrew table needs the last direction of travel; where that is unknown the mean of both is
        taken, and a CompgenWarning says so.
        """
        unknown = np.zeros_like(points.position_mm)
        approach = unknown if points.approach is None else points.approach
        result = np.zeros((len(points), 3))
        for axis, item in tables.lists.items():
            if item.screw is not None and item.screw.neg is not None and np.any(approach[:, axis] == 0):
                message = (
                    f"kw.ssfk of {AXES[axis]} knows two directions of travel, and some points do not say from where they "
                    "were approached: the mean of both is taken; give approach_x, approach_y, approach_z"
                )
                warnings.warn(message, CompgenWarning, stacklevel=2)
            screw, cross = stored_sums(item, axis, points.position_mm, approach)
            result[:, axis] = settings.screw_factor * screw + settings.cross_factor * cross
        return result + 0.0

    def violations(self, machine: Machine, settings: TwincatSettings, tables: TwincatTables) -> list[str]:
        """Return tables with too many points, numbers that do not fit, travel that is not covered, missing lists."""
        found = [
            f"no list of axis {AXES[axis]} ({settings.logical_axes[axis]}) was given"
            for axis in range(3)
            if axis not in tables.lists
        ]
        for axis, item in sorted(tables.lists.items()):
            found += [
                f"{use.name}: {use.used:g}, the control takes {use.allowed:g}"
                for use in list_usage(AXES[axis], item, settings.most)
                if use.used > use.allowed
            ]
            found += [
                message
                for what, over, nodes in spans_mm(item, axis)
                for message in coverage_violations(machine, over, nodes[0], nodes[-1], f"{what} of {AXES[axis]}")
            ]
            found += _number_violations(settings, axis, item)
        return found

    def usage(self, machine: Machine, settings: TwincatSettings, tables: TwincatTables) -> list[Usage]:
        """Return the points of every table against what the control takes."""
        return [
            use for axis, item in sorted(tables.lists.items()) for use in list_usage(AXES[axis], item, settings.most)
        ]

    def table_nodes_mm(
        self, machine: Machine, settings: TwincatSettings, tables: TwincatTables
    ) -> tuple[FloatArray, ...]:
        """Return the nodes of all tables by the axis that they depend on."""
        return nodes_by_axis(
            (over, nodes) for axis, item in tables.lists.items() for _, over, nodes in spans_mm(item, axis)
        )

    def resolution_mm(self, settings: TwincatSettings) -> float:
        """Half of the last digit of the three tables that act on one axis."""
        return 3 * 0.5 * 10.0**-settings.digits * MM_PER_UNIT


def _two_sided(settings: TwincatSettings, screw: Screw, curve: Curve) -> Screw:
    """Return a leadscrew table with the reversal B: after positive travel -B/2 is added to the command, else +B/2."""
    nodes = screw.setpoints
    if len(curve.position_mm) > 1:
        held = np.interp(curve.position_mm, nodes * MM_PER_UNIT, curve.at(nodes * MM_PER_UNIT))
        if np.max(np.abs(held - curve.value)) > WORTH_MM:
            inside = np.clip(np.rint(curve.position_mm / MM_PER_UNIT), nodes[0], nodes[-1])
            nodes = np.unique(np.concatenate([nodes, inside]))
    base = np.interp(nodes, screw.setpoints, screw.pos)
    half = rounded(settings, 0.5 * settings.screw_factor * curve.at(nodes * MM_PER_UNIT))
    interval = screw.interval if len(nodes) == len(screw.setpoints) else 0.0
    base = np.round(base, settings.digits)
    return Screw(nodes, base - half, base + half, interval)


def _number_violations(settings: TwincatSettings, axis: int, item: AxisList) -> list[str]:
    parts: list[FloatArray | None] = [np.zeros(1)]
    if item.screw is not None:
        parts += [item.screw.setpoints, item.screw.pos, item.screw.neg]
    if item.cross is not None:
        parts += [item.cross.setpoints, item.cross.values]
    if item.plane is not None:
        parts += [np.array([*item.plane.starts, item.plane.interval]), item.plane.values]
    numbers = np.concatenate([np.ravel(part) for part in parts if part is not None])
    found = []
    if not settings.real64 and np.any(numbers != np.round(numbers)):
        found.append(f"the list of {AXES[axis]} has numbers with decimals; number_type SGN32 takes whole ones")
    if np.any(np.abs(numbers) > _LARGEST_SGN32):
        found.append(f"the list of {AXES[axis]} has numbers beyond {_LARGEST_SGN32:g}")
    return found


def _list_context(settings: TwincatSettings, axis: int, item: AxisList) -> dict[str, Any]:
    numbers = settings.logical_axes
    context: dict[str, Any] = {
        "letter": AXES[axis],
        "number": numbers[axis],
        "name": settings.axis_names[axis],
        "screw": None,
        "cross": None,
        "plane": None,
    }
    if (screw := item.screw) is not None:
        context["screw"] = {
            "interval": screw.interval,
            "start": screw.setpoints[0],
            "setpoints": [] if screw.interval else screw.setpoints.tolist(),
            "pos": screw.pos.tolist(),
            "neg": [] if screw.neg is None else screw.neg.tolist(),
        }
    if (cross := item.cross) is not None:
        rows = list(zip(cross.setpoints.tolist(), cross.values.tolist(), strict=True))
        context["cross"] = {"master": numbers[cross.master], "letter": AXES[cross.master], "rows": rows}
    if (plane := item.plane) is not None:
        context["plane"] = {
            "masters": [numbers[master] for master in plane.masters],
            "letters": [AXES[master] for master in plane.masters],
            "starts": list(plane.starts),
            "interval": plane.interval,
            "values": plane.values.tolist(),
        }
    context["entries"] = 2 + _entries(context)
    return context


def _entries(context: Mapping[str, Any]) -> int:
    """Number of entries that the template writes for the tables."""
    count = 0
    if screw := context["screw"]:
        count += 6 + len(screw["setpoints"]) + len(screw["pos"]) + len(screw["neg"])
    if cross := context["cross"]:
        count += 4 + 2 * len(cross["rows"])
    if plane := context["plane"]:
        count += 9 + sum(len(row) for row in plane["values"])
    return count
