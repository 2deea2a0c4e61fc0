"""TwinCAT CNC axis lists (``twincat-lists``): leadscrew, cross and plane tables of the axes."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import equidistant_grid, loss_setting, uneven_nodes_mm
from compgen.controls.shared.scanner import Findings
from compgen.controls.shared.terms import continued, one_dimensional_terms, product_terms
from compgen.controls.twincat_tables import (
    MM_PER_UNIT,
    AxisList,
    CrossTable,
    LeadscrewTable,
    PlaneTable,
    PointLimits,
    TwincatTables,
    list_usage,
    parse_axis_list,
    point_counts,
    spans_mm,
    stored_sums,
    units_outwards,
)
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import axis_setting, choice, flag, positive, setting, table_setting, whole, word_for
from compgen.errors import CompgenWarning, InputError

# Settings ``[controllers.twincat-lists]`` of a machine file.


_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,31}")
_PLANES = {"XY": (0, 1), "YX": (1, 0), "XZ": (0, 2), "ZX": (2, 0), "YZ": (1, 2), "ZY": (2, 1), "none": None}
_DIFFER = "gives {} for X, Y, Z; three different ones are needed"


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise ValueError("an axis name of letters, digits, '_' and '-' is expected")
    return value


def plane_masters(value: Any) -> tuple[int, int] | None:
    """The first and second master of a plane by their letters, e.g. "XZ"; None for "none"."""
    if not isinstance(value, str) or value not in _PLANES:
        raise ValueError(f"two different letters, first and second master, are expected: {', '.join(_PLANES)}")
    return _PLANES[value]


@dataclass(frozen=True)
class TwincatSettings:
    """``[controllers.twincat-lists]`` of a machine file.

    ``planes`` are the masters (first, second) of the plane of each slave, None: no plane, ``"auto"``: chosen.
    """

    logical_axes: tuple[int, int, int] = axis_setting(
        whole(1, 65535), (1, 2, 3), differ=_DIFFER, meaning="numbers of the axes on the control"
    )
    axis_names: tuple[str, str, str] = axis_setting(
        _axis_name, ("X", "Y", "Z"), differ=_DIFFER, meaning="names of the axes on the control"
    )
    planes: tuple[tuple[int, int] | str | None, ...] = axis_setting(
        plane_masters, ("auto",) * 3, meaning="masters of the plane table of each slave; chosen unless stated"
    )
    most: PointLimits = table_setting(PointLimits, key="max_points", meaning="points per table that the control takes")
    cross_sign: str = setting(
        choice("correction", "error"),
        "correction",
        meaning='"correction": crosscomp and crosscomp2 are added to the command of the slave; or "error"',
    )
    ssfk_sign: str = setting(
        choice("error", "correction"),
        "error",
        meaning='"error": actual minus nominal, which the control takes off; or "correction"',
    )
    real64: bool = setting(
        word_for({"SGN32": False, "REAL64": True}),
        key="number_type",
        stated="SGN32",
        meaning="numbers as the build of the control reads them",
    )
    crosscomp2: bool = setting(flag, True, meaning="write plane tables")
    own_setpoints: bool = setting(flag, False, meaning="every ssfk point has its own position (interval 0)")
    n_cycles: int = setting(whole(0, 1000), 10, meaning="cycles over which a switched correction is smoothed")
    loss_mm: float = loss_setting()
    increment_mm: tuple[float | None, float | None, float | None] = axis_setting(
        positive,
        key="increment_um",
        unit=MM_PER_UM,
        meaning="encoder increments of the axes, e.g. { X = 0.1 }: for reading lists of the control with unit 0",
    )

    @property
    def digits(self) -> int:
        """Decimals of numbers in 0.1 um."""
        return 4 if self.real64 else 0

    @property
    def screw_factor(self) -> float:
        """What the control adds per stored ``ssfk`` value: -1 or +1."""
        return -1.0 if self.ssfk_sign == "error" else 1.0

    @property
    def cross_factor(self) -> float:
        """What the control adds per stored cross or plane value: +1 or -1."""
        return 1.0 if self.cross_sign == "correction" else -1.0


# What TwinCAT axis lists can hold: which table of a slave axis takes which function, and the numbers of the tables.
#
# A slave has one leadscrew table, one cross table (one master) and one plane (two masters; one of them may be the slave).
# The plane takes the products function-of-one-axis times lever-of-another that matter most.


#: A function or product that moves the slave by less than this (rms) needs no table.
NOTHING_MM = 0.02 * MM_PER_UM


def _masters(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


def _units(nodes_mm: FloatArray) -> FloatArray:
    return np.rint(nodes_mm / MM_PER_UNIT)


# ``twincat-lists``: compensation value lists of the TwinCAT CNC axes (TF5200): leadscrew, cross and plane tables.
#
# Source: Beckhoff TF5200 "Axis compensation" and "Axis compensation parameters" (P-COMP-00001 ... 00061). The sign of
# cross and plane tables is stated nowhere in public; it is the setting ``cross_sign``.


_LARGEST_SGN32 = 2.0**31 - 1


class TwincatLists(Controller[TwincatSettings, TwincatTables]):
    """TwinCAT CNC axis lists: one file per axis."""

    name = "twincat-lists"
    settings_class = TwincatSettings
    bidirectional = True

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return pitch, one cross function and one plane of products per slave axis."""
        terms = [term for slave in range(3) for term in self._terms_of(slave, errors)]
        return [continued(term, self.machine.axes[term.axis or 0].range_mm) for term in terms]

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> TwincatTables:
        """Return the tables in 0.1 um, signs as the control stores them."""
        # cross and plane tables of zeros are left out
        return TwincatTables({slave: self._list_of(slave, basis, values) for slave in range(3)})

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Only the reversal of an axis along itself goes into tables."""
        return ReversalCurves({key: curve for key, curve in reversal.curves.items() if key[0] == key[1]})

    def with_reversal(self, tables: TwincatTables, reversal: ReversalCurves) -> TwincatTables:
        """Return the tables with a bilateral leadscrew table for the reversal of each axis along itself."""
        lists = dict(tables.lists)
        for (axis, _), curve in sorted(reversal.curves.items()):
            screw = lists[axis].screw
            if screw is not None and np.max(np.abs(curve.value)) >= WORTH_MM:
                nodes = screw.setpoints
                if len(curve.position_mm) > 1:
                    held = np.interp(curve.position_mm, nodes * MM_PER_UNIT, curve.at(nodes * MM_PER_UNIT))
                    if np.max(np.abs(held - curve.value)) > WORTH_MM:
                        inside = np.clip(np.rint(curve.position_mm / MM_PER_UNIT), nodes[0], nodes[-1])
                        nodes = np.unique(np.concatenate([nodes, inside]))
                # reversal B: after positive travel -B/2 is added to the command, after negative travel +B/2
                base = np.round(np.interp(nodes, screw.setpoints, screw.pos), self.settings.digits)
                half = self._rounded(0.5 * self.settings.screw_factor * curve.at(nodes * MM_PER_UNIT))
                interval = screw.interval if len(nodes) == len(screw.setpoints) else 0.0
                lists[axis] = replace(lists[axis], screw=LeadscrewTable(nodes, base - half, base + half, interval))
        return TwincatTables(lists)

    def context(self, tables: TwincatTables) -> dict[str, Any]:
        """Return the lists with their numbers, the signs with a worked number, and what must be set."""
        return {
            "sign_statement": f"{self._screw_statement()} {self._cross_statement()}",
            "screw_statement": self._screw_statement(),
            "cross_statement": self._cross_statement(),
            "cross_sign": self.settings.cross_sign,
            "ssfk_sign": self.settings.ssfk_sign,
            "parameters": self._parameters(tables),
            "warnings": self._warnings(tables),
            "overwrites": [
                "Of other axes: nothing.",
                "The compensation lists of X, Y and Z as a whole: what the old list of one of them holds beside these tables, "
                "e.g. a table over a rotary axis, is lost.",
            ],
            "digits": self.settings.digits,
            "n_cycles": self.settings.n_cycles,
            "lists": [self._list_context(axis, tables.lists.get(axis, AxisList())) for axis in range(3)],
        }

    def parse(self, files: Sequence[SourceFile]) -> TwincatTables:
        """Read the lists of one or more axes, in any order."""
        if not files:
            raise InputError("no axis list was given; achskw1.lis is one")
        return self._parsed(files, None)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[TwincatTables, list[str]]:
        """Read lists of a real control: reserved entries and other structures are passed over, other axes kept apart."""
        foreign = Findings()
        tables = self._parsed(files, foreign)
        if not any(item != AxisList() for item in tables.lists.values()):
            raise files[0].fail("; ".join(["holds no table of an axis of the machine file", *foreign.statements()]))
        return tables, foreign.statements()

    def _parsed(self, files: Sequence[SourceFile], foreign: Findings | None) -> TwincatTables:
        lists: dict[int, AxisList] = {}
        seen: dict[int, SourceFile] = {}
        for source in files:
            axis, item = parse_axis_list(
                source, self.settings.axis_names, self.settings.logical_axes, self.settings.increment_mm, foreign
            )
            if axis is None:
                continue
            if axis in seen:
                raise source.fail(f"is a second list of axis {AXES[axis]}; the first is {seen[axis].path.name}")
            lists[axis], seen[axis] = item, source
        return TwincatTables(lists)

    def emulate(self, tables: TwincatTables, points: Points) -> FloatArray:
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
            result[:, axis] = self.settings.screw_factor * screw + self.settings.cross_factor * cross
        return result + 0.0

    def violations(self, tables: TwincatTables) -> list[str]:
        """Return tables with too many points, numbers that do not fit, travel that is not covered, missing lists."""
        settings = self.settings
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
                for message in coverage_violations(self.machine, over, nodes[0], nodes[-1], f"{what} of {AXES[axis]}")
            ]
            numbers = item.numbers
            if not settings.real64 and np.any(numbers != np.round(numbers)):
                found.append(f"the list of {AXES[axis]} has numbers with decimals; number_type SGN32 takes whole ones")
            if np.any(np.abs(numbers) > _LARGEST_SGN32):
                found.append(f"the list of {AXES[axis]} has numbers beyond {_LARGEST_SGN32:g}")
        return found

    def usage(self, tables: TwincatTables) -> list[Usage]:
        """Return the points of every table against what the control takes."""
        return [
            use
            for axis, item in sorted(tables.lists.items())
            for use in list_usage(AXES[axis], item, self.settings.most)
        ]

    def table_nodes_mm(self, tables: TwincatTables) -> tuple[FloatArray, ...]:
        """Return the nodes of all tables by the axis that they depend on."""
        return nodes_by_axis(
            (over, nodes) for axis, item in tables.lists.items() for _, over, nodes in spans_mm(item, axis)
        )

    def resolution_mm(self) -> float:
        """Half of the last digit of the three tables that act on one axis."""
        return 3 * 0.5 * 10.0**-self.settings.digits * MM_PER_UNIT

    def _masters_for(self, slave: int, errors: ErrorTable) -> tuple[int, tuple[int, int] | None]:
        """Return the master of the cross table and those of the plane: the pair whose products need it most."""
        machine = self.machine
        probe = [np.linspace(*axis.range_mm, 41) for axis in machine.axes]
        others = [axis for axis in range(3) if axis != slave]
        pairs = [(slave, axis) for axis in others]
        curves = one_dimensional_terms(machine, errors, probe, pairs, lever_origin_mm=machine.reference_point_mm)
        sizes = [float(np.std(term.start)) for term in curves]
        plane = self.settings.planes[slave] if self.settings.crosscomp2 else None
        if isinstance(plane, str):  # "auto"
            captured: dict[tuple[int, int], float] = {}
            for term in product_terms(machine, errors, probe, (0.5 * (machine.lower_mm + machine.upper_mm)).tolist()):
                if term.carrier[0].output == slave:
                    # rms over the volume without what functions of one axis hold of the product
                    length = machine.axes[term.carrier[0].lever or 0].length_mm
                    size = float(np.std(term.start)) * length / math.sqrt(12.0)
                    captured[_masters(term)] = captured.get(_masters(term), 0.0) + size**2
            plane = max(captured, key=lambda pair: captured[pair], default=None)
            if plane is None or captured[plane] <= NOTHING_MM**2:
                plane = (others[0], others[1]) if min(sizes) > NOTHING_MM else None
        # the cross table takes the axis that the plane leaves out, else the one with the larger function
        free = [axis for axis in others if plane is not None and axis not in plane]
        return free[0] if free else others[int(np.argmax(sizes))], plane

    def _terms_of(self, slave: int, errors: ErrorTable) -> list[Term]:
        """Return the terms of one slave: leadscrew, cross table, then function and products of its plane."""
        machine, settings, origin = self.machine, self.settings, self.machine.reference_point_mm
        cross, plane = self._masters_for(slave, errors)
        if settings.own_setpoints:
            screw_mm = self._cross_nodes_mm(errors, slave)
        else:
            most = settings.most.ssfk - 1
            grid = equidistant_grid(machine, errors, slave, most=most, loss_mm=settings.loss_mm, output=slave)
            screw_mm = self._even_units(slave, float(grid.step) / MM_PER_UNIT) * MM_PER_UNIT
        found = []
        for axis, nodes_mm in ((slave, screw_mm), (cross, self._cross_nodes_mm(errors, cross))):
            found += one_dimensional_terms(machine, errors, [nodes_mm] * 3, [(slave, axis)], lever_origin_mm=origin)
        if plane is None:
            return found
        nodes = self._plane_nodes_mm(errors, slave, plane)
        pairs = [(slave, axis) for axis in plane if axis not in (slave, cross)]
        found += one_dimensional_terms(machine, errors, nodes, pairs, lever_origin_mm=origin)
        products = product_terms(machine, errors, nodes, origin)
        return found + [t for t in products if t.carrier[0].output == slave and set(_masters(t)) == set(plane)]

    def _cross_nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        most = min(self.settings.most.crosscomp, self.settings.most.ssfk)
        nodes_mm = uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm, most=most)
        return units_outwards(self.machine, axis, nodes_mm) * MM_PER_UNIT

    def _even_units(self, axis: int, step: float) -> FloatArray:
        """Return equidistant nodes in whole units of 0.1 um that cover the travel of an axis."""
        low, high = (end / MM_PER_UNIT for end in self.machine.axes[axis].range_mm)
        start, distance = math.floor(low + 1e-3), max(1, round(step))
        count = max(1, math.ceil((high - 1e-3 - start) / distance)) + 1
        return np.asarray(start + distance * np.arange(count), dtype=np.float64)

    def _plane_nodes_mm(self, errors: ErrorTable, slave: int, masters: tuple[int, int]) -> list[FloatArray]:
        """Return the nodes of both masters (and any of the third axis): one distance for both, within the control's limit."""
        points, loss_mm = self.settings.most.crosscomp2, self.settings.loss_mm
        most = max(3, points // 2 - 1)
        grids = [
            equidistant_grid(self.machine, errors, axis, most=most, loss_mm=loss_mm, output=slave) for axis in masters
        ]
        step = min(float(grid.step) for grid in grids) / MM_PER_UNIT
        while True:
            first, second = (self._even_units(axis, step) for axis in masters)
            if len(first) * len(second) <= points:
                break
            step *= 1.02
        nodes = [np.zeros(1)] * 3
        nodes[masters[0]], nodes[masters[1]] = first * MM_PER_UNIT, second * MM_PER_UNIT
        return nodes

    def _list_of(self, slave: int, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> AxisList:
        screw_term, cross_term, *plane_terms = (term for term in basis if term.carrier[0].output == slave)
        cross = CrossTable(
            int(cross_term.axis or 0),
            _units(cross_term.nodes_mm),
            self._rounded(self.settings.cross_factor * values[cross_term.name]),
        )
        plane = self._plane_table(slave, cross.master, plane_terms, values) if plane_terms else None
        nodes = _units(screw_term.nodes_mm)
        return AxisList(
            LeadscrewTable(
                nodes,
                self._rounded(self.settings.screw_factor * values[screw_term.name]),
                interval=0.0 if self.settings.own_setpoints else float(nodes[1] - nodes[0]),
            ),
            cross if np.any(cross.values) else None,
            plane if plane is not None and np.any(plane.values) else None,
        )

    def _plane_table(
        self, slave: int, cross: int, terms: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> PlaneTable:
        """Return the sum of the terms at the nodes of a plane; between nodes it is bilinear, as each of the terms is.

        First and second master are as the machine file has them, else in the order X, Y, Z.
        """
        stated = self.settings.planes[slave]
        axes = {axis for term in terms for axis in (term.axis, term.carrier[0].lever) if axis is not None}
        one, other = stated if isinstance(stated, tuple) else sorted(axes if len(axes) == 2 else {*axes, cross})
        step = float(np.diff(_units(terms[0].nodes_mm))[0])
        lines = [self._even_units(axis, step) for axis in (one, other)]
        second, first = np.meshgrid(lines[1] * MM_PER_UNIT, lines[0] * MM_PER_UNIT, indexing="ij")
        position_mm = np.zeros((first.size, 3))
        position_mm[:, one], position_mm[:, other] = first.ravel(), second.ravel()
        total = np.zeros(first.size)
        for term in terms:
            carrier = term.carrier_field(position_mm, np.zeros(3))[:, term.carrier[0].output]
            total += carrier * term.curve(np.asarray(values[term.name]), position_mm)
        numbers = self._rounded(self.settings.cross_factor * total.reshape(first.shape))
        return PlaneTable((one, other), (float(lines[0][0]), float(lines[1][0])), step, numbers)

    def _rounded(self, values_mm: FloatArray) -> FloatArray:
        """Return values in 0.1 um as they are written."""
        return np.round(np.asarray(values_mm) / MM_PER_UNIT, self.settings.digits) + 0.0

    def _screw_statement(self) -> str:
        if self.settings.ssfk_sign == "error":
            return (
                "kw.ssfk holds actual minus nominal in 0.1 um, and the control takes it off: 21 at 100 mm says that the axis "
                "stands 0.0021 mm too far in the positive direction; the control then commands 99.9979 mm."
            )
        return "kw.ssfk holds what the control adds, in 0.1 um: 21 at 100 mm makes it command 100.0021 mm."

    def _cross_statement(self) -> str:
        settings = self.settings
        added, sign = ("added to", "+") if settings.cross_sign == "correction" else ("taken off", "-")
        return (
            f"Values of kw.crosscomp and kw.crosscomp2 are {added} the command of the slave (cross_sign = "
            f'"{settings.cross_sign}"): 50 moves it by {sign}0.0050 mm.'
        )

    def _parameters(self, tables: TwincatTables) -> list[dict[str, object]]:
        settings = self.settings
        rows: list[tuple[str, object, str]] = []
        for axis, item in sorted(tables.lists.items()):
            where = f"axis parameter list of {AXES[axis]} (axis {settings.logical_axes[axis]})"
            for name, table in (("ssfk", item.screw), ("crosscomp", item.cross), ("crosscomp2", item.plane)):
                active = 1 if table is not None else 0
                rows.append((f"lr_param.{name} ({AXES[axis]})", active, where))
            if item.screw is not None and item.screw.neg is not None:
                meaning = "bilateral table: it holds the backlash, so backlash compensation of this axis must be off"
                rows.append((f"backlash compensation ({AXES[axis]})", "off", meaning))
                meaning = "cycles over which a change of direction is spread"
                rows.append((f"lr_param.n_backlash_cyc ({AXES[axis]})", "as suits", meaning))
            for kind, used in point_counts(item).items():
                if used > (usual := getattr(PointLimits(), kind)):
                    meaning = f"the usual {usual} do not hold this table"
                    rows.append((f"kw.{kind}.max_points ({AXES[axis]})", f">= {used + 1}", meaning))
        return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]

    def _warnings(self, tables: TwincatTables) -> list[str]:
        settings = self.settings
        found: list[str] = []
        if any(item.cross or item.plane for item in tables.lists.values()):
            found.append(
                f'cross_sign = "{settings.cross_sign}": no public document says whether kw.crosscomp and kw.crosscomp2 are '
                "added or taken off. Do section 3 of the preflight list before you use them, and write what it shows "
                "into the machine file."
            )
        own = [
            AXES[axis]
            for axis, item in sorted(tables.lists.items())
            if item.plane is not None and axis in item.plane.masters
        ]
        if own:
            found.append(
                f"the plane of {', '.join(own)} has its own slave as a master: documented for the older CNC builds"
            )
        idle = [
            AXES[axis]
            for axis, item in tables.lists.items()
            if not (item.cross or item.plane or (item.screw and (np.any(item.screw.pos) or np.any(item.screw.neg))))
        ]
        if idle:
            found.append(f"the tables of {', '.join(idle)} are zero everywhere")
        return found

    def _list_context(self, axis: int, item: AxisList) -> dict[str, Any]:
        numbers = self.settings.logical_axes
        context: dict[str, Any] = {
            "letter": AXES[axis],
            "number": numbers[axis],
            "name": self.settings.axis_names[axis],
            "screw": None,
            "cross": None,
            "plane": None,
        }
        # entries that the template writes, by which a cut file is noticed
        entries = 2
        if (screw := item.screw) is not None:
            context["screw"] = {
                "interval": screw.interval,
                "start": screw.setpoints[0],
                "setpoints": [] if screw.interval else screw.setpoints.tolist(),
                "pos": screw.pos.tolist(),
                "neg": [] if screw.neg is None else screw.neg.tolist(),
            }
            entries += 6 + sum(len(context["screw"][column]) for column in ("setpoints", "pos", "neg"))
        if (cross := item.cross) is not None:
            rows = list(zip(cross.setpoints.tolist(), cross.values.tolist(), strict=True))
            context["cross"] = {"master": numbers[cross.master], "letter": AXES[cross.master], "rows": rows}
            entries += 4 + 2 * len(rows)
        if (plane := item.plane) is not None:
            context["plane"] = {
                "masters": [numbers[master] for master in plane.masters],
                "letters": [AXES[master] for master in plane.masters],
                "starts": list(plane.starts),
                "interval": plane.interval,
                "values": plane.values.tolist(),
            }
            entries += 9 + plane.values.size
        return {**context, "entries": entries}
