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
from compgen.controls.shared.grids import equidistant_grid, take_loss_mm, uneven_nodes_mm
from compgen.controls.shared.terms import continued, one_dimensional_terms, product_terms
from compgen.controls.twincat_tables import (
    MM_PER_UNIT,
    AxisList,
    CrossTable,
    LeadscrewTable,
    ListFindings,
    PlaneTable,
    PointLimits,
    TwincatTables,
    list_usage,
    parse_axis_list,
    spans_mm,
    stored_sums,
    units_outwards,
)
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenWarning, InputError

# Settings ``[controllers.twincat-lists]`` of a machine file.


#: Points that builds without the parameters P-COMP-00059 ... 61 take.
USUAL = PointLimits(ssfk=1500, crosscomp=1001, crosscomp2=10201)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,31}")
_PLANES = {"XY": (0, 1), "YX": (1, 0), "XZ": (0, 2), "ZX": (2, 0), "YZ": (1, 2), "ZY": (2, 1), "none": None}


@dataclass(frozen=True)
class TwincatSettings:
    """What the export needs to know.

    Parameters
    ----------
    cross_sign : ``"correction"`` (``crosscomp`` and ``crosscomp2`` are added to the slave's command) or ``"error"``.
    ssfk_sign : ``"error"`` (actual minus nominal, which the control takes off) or ``"correction"``.
    real64 : numbers as REAL64 (newer builds), else whole numbers of 0.1 um.
    crosscomp2 : whether plane tables are written.
    planes : masters (first, second) of the plane of each slave, None: no plane, ``"auto"``: chosen.
    own_setpoints : whether every ``ssfk`` point has its own position (interval 0).
    logical_axes, axis_names : of X, Y, Z on the control.
    n_cycles : cycles over which a switched cross or plane correction is smoothed.
    most : points that the control takes.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    increment_mm : encoder increments of X, Y, Z, in which lists with ``unit 0`` hold their values; None: not stated.
    """

    cross_sign: str
    ssfk_sign: str
    real64: bool
    crosscomp2: bool
    planes: tuple[tuple[int, int] | str | None, ...]
    own_setpoints: bool
    logical_axes: tuple[int, int, int]
    axis_names: tuple[str, str, str]
    n_cycles: int
    most: PointLimits
    loss_mm: float
    increment_mm: tuple[float | None, float | None, float | None]

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


def read_twincat_settings(machine: Machine, name: str) -> TwincatSettings:
    """Check the settings; unknown keys and values are an InputError."""
    section = machine.controller_settings(name)
    numbers = _per_axis(section, "logical_axes", toml_files.whole(1, 65535), (1, 2, 3))
    names = _per_axis(section, "axis_names", _axis_name, AXES)
    planes = _per_axis(section, "planes", _check_plane, ("auto",) * 3)
    points = section.section("max_points", required=False)
    most = PointLimits(
        points.take("ssfk", toml_files.whole(2, 100_000), USUAL.ssfk),
        points.take("crosscomp", toml_files.whole(2, 100_000), USUAL.crosscomp),
        points.take("crosscomp2", toml_files.whole(4, 100_000), USUAL.crosscomp2),
    )
    points.finish()
    settings = TwincatSettings(
        cross_sign=section.take("cross_sign", toml_files.choice("correction", "error"), "correction"),
        ssfk_sign=section.take("ssfk_sign", toml_files.choice("error", "correction"), "error"),
        real64=section.take("number_type", toml_files.choice("SGN32", "REAL64"), "SGN32") == "REAL64",
        crosscomp2=section.take("crosscomp2", toml_files.flag, True),
        planes=planes,
        own_setpoints=section.take("own_setpoints", toml_files.flag, False),
        logical_axes=(numbers[0], numbers[1], numbers[2]),
        axis_names=(names[0], names[1], names[2]),
        n_cycles=section.take("n_cycles", toml_files.whole(0, 1000), 10),
        most=most,
        loss_mm=take_loss_mm(section),
        increment_mm=_increments(section),
    )
    section.finish()
    return settings


def _per_axis(section: toml_files.Section, key: str, check: Any, defaults: Any) -> tuple[Any, ...]:
    part = section.section(key, required=False)
    found = tuple(part.take(letter, check, default) for letter, default in zip(AXES, defaults, strict=True))
    part.finish()
    if key != "planes" and len(set(found)) != 3:
        raise section.fail(key, f"gives {', '.join(map(str, found))} for X, Y, Z; three different ones are needed")
    return found


def _increments(section: toml_files.Section) -> tuple[float | None, float | None, float | None]:
    """``increment_um = { X = ..., ... }`` in mm."""
    part = section.section("increment_um", required=False)
    found = [part.take(letter, toml_files.positive, None) for letter in AXES]
    part.finish()
    x, y, z = (None if value is None else value * MM_PER_UM for value in found)
    return x, y, z


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise ValueError("an axis name of letters, digits, '_' and '-' is expected")
    return value


def _check_plane(value: Any) -> tuple[int, int] | None:
    if not isinstance(value, str) or value not in _PLANES:
        raise ValueError(f"two different letters, first and second master, are expected: {', '.join(_PLANES)}")
    return _PLANES[value]


# What TwinCAT axis lists can hold: which table of a slave axis takes which function, and the numbers of the tables.
#
# A slave has one leadscrew table, one cross table (one master) and one plane (two masters; one of them may be the slave).
# The plane takes the products function-of-one-axis times lever-of-another that matter most.


#: A function or product that moves the slave by less than this (rms) needs no table.
NOTHING_MM = 0.02 * MM_PER_UM


@dataclass(frozen=True)
class SlaveLayout:
    """Tables of one slave: its leadscrew, the master of its cross table, the masters of its plane."""

    slave: int
    cross: int
    plane: tuple[int, int] | None

    @property
    def plane_curves(self) -> tuple[int, ...]:
        """Axes whose one-dimensional function stands in the plane."""
        return tuple(axis for axis in self.plane or () if axis not in (self.slave, self.cross))


def _masters(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


def _masters_of_plane(
    slave: int, products: Sequence[tuple[Term, float]], others: Sequence[int], sizes: Sequence[float]
) -> tuple[int, int] | None:
    captured: dict[tuple[int, int], float] = {}
    for term, size in products:
        if term.carrier[0].output == slave:
            captured[_masters(term)] = captured.get(_masters(term), 0.0) + size**2
    best = max(captured, key=lambda pair: captured[pair], default=None)
    if best is not None and captured[best] > NOTHING_MM**2:
        return best
    return (others[0], others[1]) if min(sizes) > NOTHING_MM else None


def _cross(others: Sequence[int], sizes: Sequence[float], plane: tuple[int, int] | None) -> int:
    """Master of the cross table: the axis that the plane leaves out, else the one with the larger function."""
    free = [axis for axis in others if plane is not None and axis not in plane]
    return free[0] if free else others[int(np.argmax(sizes))]


def _at(axis: int, nodes_mm: FloatArray) -> list[FloatArray]:
    """Nodes of one axis in a list for three."""
    return [nodes_mm if axis == k else np.zeros(1) for k in range(3)]


def _units(nodes_mm: FloatArray) -> FloatArray:
    return np.rint(nodes_mm / MM_PER_UNIT)


def _direction_rows(axis: int, item: AxisList) -> list[tuple[str, object, str]]:
    if item.screw is None or item.screw.neg is None:
        return []
    meaning = "bilateral table: it holds the backlash, so backlash compensation of this axis must be off"
    return [
        (f"backlash compensation ({AXES[axis]})", "off", meaning),
        (f"lr_param.n_backlash_cyc ({AXES[axis]})", "as suits", "cycles over which a change of direction is spread"),
    ]


def _moves(item: AxisList) -> bool:
    if item.cross or item.plane:
        return True
    return item.screw is not None and bool(
        np.any(item.screw.pos) or (item.screw.neg is not None and np.any(item.screw.neg))
    )


# ``twincat-lists``: compensation value lists of the TwinCAT CNC axes (TF5200): leadscrew, cross and plane tables.
#
# Source: Beckhoff TF5200 "Axis compensation" and "Axis compensation parameters" (P-COMP-00001 ... 00061). The sign of
# cross and plane tables is stated nowhere in public; it is the setting ``cross_sign``.


_LARGEST_SGN32 = 2.0**31 - 1


class TwincatLists(Controller[TwincatSettings, TwincatTables]):
    """TwinCAT CNC axis lists: one file per axis."""

    name = "twincat-lists"
    bidirectional = True

    @classmethod
    def read_settings(cls, machine: Machine) -> TwincatSettings:
        """Check the settings of the machine file; all have defaults."""
        return read_twincat_settings(machine, cls.name)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return pitch, one cross function and one plane of products per slave axis."""
        terms: list[Term] = []
        for layout in self._layouts(errors):
            terms += self._terms(errors, layout)
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
                lists[axis] = replace(lists[axis], screw=self._two_sided(screw, curve))
        return TwincatTables(lists)

    def context(self, tables: TwincatTables) -> dict[str, Any]:
        """Return the lists with their numbers, the signs with a worked number, and what must be set."""
        return {
            **self._twincat_notes(tables),
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
        foreign = ListFindings()
        tables = self._parsed(files, foreign)
        if not any(item != AxisList() for item in tables.lists.values()):
            raise files[0].fail("; ".join(["holds no table of an axis of the machine file", *foreign.remarks()]))
        return tables, foreign.remarks()

    def _parsed(self, files: Sequence[SourceFile], foreign: ListFindings | None) -> TwincatTables:
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
            found += self._number_violations(axis, item)
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

    def _layouts(self, errors: ErrorTable) -> list[SlaveLayout]:
        """Return the tables of the three slaves: every plane takes the pair of masters that needs it most."""
        machine = self.machine
        probe = [np.linspace(*axis.range_mm, 41) for axis in machine.axes]
        origin = machine.reference_point_mm
        products = product_terms(machine, errors, probe, (0.5 * (machine.lower_mm + machine.upper_mm)).tolist())
        found = []
        for slave in range(3):
            others = [axis for axis in range(3) if axis != slave]
            pairs = [(slave, axis) for axis in others]
            curves = one_dimensional_terms(machine, errors, probe, pairs, lever_origin_mm=origin)
            sizes = [float(np.std(term.start)) for term in curves]
            plane = self.settings.planes[slave] if self.settings.crosscomp2 else None
            if plane == "auto":
                plane = _masters_of_plane(slave, [(term, self._size(term)) for term in products], others, sizes)
            masters = None if plane is None or isinstance(plane, str) else plane
            found.append(SlaveLayout(slave, _cross(others, sizes, masters), masters))
        return found

    def _size(self, term: Term) -> float:
        """Rms of a product over the volume without what functions of one axis hold of it, mm."""
        lever = term.carrier[0].lever
        length = self.machine.axes[lever].length_mm if lever is not None and lever < 3 else 0.0
        return float(np.std(term.start)) * length / math.sqrt(12.0)

    def _terms(self, errors: ErrorTable, layout: SlaveLayout) -> list[Term]:
        machine = self.machine
        slave, origin = layout.slave, machine.reference_point_mm
        alone = [
            (slave, self._screw_nodes_mm(errors, slave)),
            (layout.cross, self._cross_nodes_mm(errors, layout.cross)),
        ]
        found = [
            one_dimensional_terms(machine, errors, _at(axis, nodes), [(slave, axis)], lever_origin_mm=origin)[0]
            for axis, nodes in alone
        ]
        if layout.plane is None:
            return found
        nodes = self._plane_nodes_mm(errors, layout)
        pairs = [(slave, axis) for axis in layout.plane_curves]
        found += one_dimensional_terms(machine, errors, nodes, pairs, lever_origin_mm=origin)
        products = product_terms(machine, errors, nodes, origin)
        return found + [t for t in products if t.carrier[0].output == slave and set(_masters(t)) == set(layout.plane)]

    def _screw_nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        if self.settings.own_setpoints:
            return self._cross_nodes_mm(errors, axis)
        grid = equidistant_grid(
            self.machine, errors, axis, most=self.settings.most.ssfk - 1, loss_mm=self.settings.loss_mm, output=axis
        )
        start, step, count = self._even_units(axis, float(grid.step) / MM_PER_UNIT)
        return np.asarray((start + step * np.arange(count)) * MM_PER_UNIT, dtype=np.float64)

    def _cross_nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        most = min(self.settings.most.crosscomp, self.settings.most.ssfk)
        nodes_mm = uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm, most=most)
        return units_outwards(self.machine, axis, nodes_mm) * MM_PER_UNIT

    def _even_units(self, axis: int, step: float) -> tuple[int, int, int]:
        """Return start, step and number of equidistant nodes in units of 0.1 um that cover the travel."""
        low, high = (end / MM_PER_UNIT for end in self.machine.axes[axis].range_mm)
        start, whole = math.floor(low + 1e-3), max(1, round(step))
        return start, whole, max(1, math.ceil((high - 1e-3 - start) / whole)) + 1

    def _plane_nodes_mm(self, errors: ErrorTable, layout: SlaveLayout) -> list[FloatArray]:
        """Return the nodes of both masters (and any of the third axis): one distance for both, within the control's limit."""
        masters = layout.plane or (0, 1)
        most = max(3, self.settings.most.crosscomp2 // 2 - 1)
        steps = [
            float(
                equidistant_grid(
                    self.machine, errors, axis, most=most, loss_mm=self.settings.loss_mm, output=layout.slave
                ).step
            )
            for axis in masters
        ]
        step = min(steps) / MM_PER_UNIT
        while True:
            grids = [self._even_units(axis, step) for axis in masters]
            if grids[0][2] * grids[1][2] <= self.settings.most.crosscomp2:
                break
            step *= 1.02
        nodes = [np.zeros(1)] * 3
        for axis, (start, whole, count) in zip(masters, grids, strict=True):
            nodes[axis] = np.asarray((start + whole * np.arange(count)) * MM_PER_UNIT, dtype=np.float64)
        return nodes

    def _list_of(self, slave: int, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> AxisList:
        own = [term for term in basis if term.carrier[0].output == slave]
        screw_term, cross_term, *plane_terms = own
        cross = CrossTable(
            int(cross_term.axis or 0),
            _units(cross_term.nodes_mm),
            self._rounded(self.settings.cross_factor * values[cross_term.name]),
        )
        plane = None
        if plane_terms:
            masters = self._masters_of(slave, plane_terms, cross.master)
            plane = self._plane_table(masters, plane_terms, values)
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

    def _masters_of(self, slave: int, terms: Sequence[Term], cross: int) -> tuple[int, int]:
        """First and second master of a plane: as the machine file has them, else in the order X, Y, Z."""
        stated = self.settings.planes[slave]
        if isinstance(stated, tuple):
            return stated
        axes = {axis for term in terms for axis in (term.axis, term.carrier[0].lever) if axis is not None}
        first, second = sorted(axes if len(axes) == 2 else {*axes, cross})
        return first, second

    def _plane_table(
        self, masters: tuple[int, int], terms: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> PlaneTable:
        """Return the sum of the terms at the nodes of a plane; between nodes it is bilinear, as each of the terms is."""
        step = float(np.diff(_units(terms[0].nodes_mm))[0])
        grids = [self._even_units(axis, step) for axis in masters]
        lines = [(start + whole * np.arange(count)) * MM_PER_UNIT for start, whole, count in grids]
        second, first = np.meshgrid(lines[1], lines[0], indexing="ij")
        position_mm = np.zeros((first.size, 3))
        position_mm[:, masters[0]], position_mm[:, masters[1]] = first.ravel(), second.ravel()
        total = np.zeros(first.size)
        for term in terms:
            carrier = term.carrier_field(position_mm, np.zeros(3))[:, term.carrier[0].output]
            total += carrier * term.curve(np.asarray(values[term.name]), position_mm)
        starts = (float(grids[0][0]), float(grids[1][0]))
        numbers = self._rounded(self.settings.cross_factor * total.reshape(first.shape))
        return PlaneTable(masters, starts, step, numbers)

    def _rounded(self, values_mm: FloatArray) -> FloatArray:
        """Return values in 0.1 um as they are written."""
        return np.round(np.asarray(values_mm) / MM_PER_UNIT, self.settings.digits) + 0.0

    # Words for the people at a TwinCAT CNC: signs, parameters of the axis lists, warnings.

    def _twincat_notes(self, tables: TwincatTables) -> dict[str, Any]:
        """Return the texts of the context: sign_statement, cross_statement, screw_statement, parameters, warnings."""
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
        }

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
            rows += _direction_rows(axis, item)
            rows += self._point_rows(axis, item)
        return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]

    def _point_rows(self, axis: int, item: AxisList) -> list[tuple[str, object, str]]:
        counts = (
            ("ssfk", item.screw and len(item.screw.setpoints), USUAL.ssfk),
            ("crosscomp", item.cross and len(item.cross.setpoints), USUAL.crosscomp),
            ("crosscomp2", item.plane and item.plane.values.size, USUAL.crosscomp2),
        )
        return [
            (f"kw.{name}.max_points ({AXES[axis]})", f">= {used + 1}", f"the usual {usual} do not hold this table")
            for name, used, usual in counts
            if used and used > usual
        ]

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
        if any(item.cross is None and item.plane is None for item in tables.lists.values()):
            idle = [AXES[axis] for axis, item in tables.lists.items() if not _moves(item)]
            found += [f"the tables of {', '.join(idle)} are zero everywhere"] * bool(idle)
        return found

    def _two_sided(self, screw: LeadscrewTable, curve: Curve) -> LeadscrewTable:
        """Return a leadscrew table with the reversal B: after positive travel -B/2 is added to the command, else +B/2."""
        nodes = screw.setpoints
        if len(curve.position_mm) > 1:
            held = np.interp(curve.position_mm, nodes * MM_PER_UNIT, curve.at(nodes * MM_PER_UNIT))
            if np.max(np.abs(held - curve.value)) > WORTH_MM:
                inside = np.clip(np.rint(curve.position_mm / MM_PER_UNIT), nodes[0], nodes[-1])
                nodes = np.unique(np.concatenate([nodes, inside]))
        base = np.interp(nodes, screw.setpoints, screw.pos)
        half = self._rounded(0.5 * self.settings.screw_factor * curve.at(nodes * MM_PER_UNIT))
        interval = screw.interval if len(nodes) == len(screw.setpoints) else 0.0
        base = np.round(base, self.settings.digits)
        return LeadscrewTable(nodes, base - half, base + half, interval)

    def _number_violations(self, axis: int, item: AxisList) -> list[str]:
        parts: list[FloatArray | None] = [np.zeros(1)]
        if item.screw is not None:
            parts += [item.screw.setpoints, item.screw.pos, item.screw.neg]
        if item.cross is not None:
            parts += [item.cross.setpoints, item.cross.values]
        if item.plane is not None:
            parts += [np.array([*item.plane.starts, item.plane.interval]), item.plane.values]
        numbers = np.concatenate([np.ravel(part) for part in parts if part is not None])
        found = []
        if not self.settings.real64 and np.any(numbers != np.round(numbers)):
            found.append(f"the list of {AXES[axis]} has numbers with decimals; number_type SGN32 takes whole ones")
        if np.any(np.abs(numbers) > _LARGEST_SGN32):
            found.append(f"the list of {AXES[axis]} has numbers beyond {_LARGEST_SGN32:g}")
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
