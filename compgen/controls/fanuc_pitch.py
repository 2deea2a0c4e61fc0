"""FANUC stored pitch error compensation (``fanuc-pitch``): positioning as whole increments per section of travel."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import ROUND_CEILING, Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.fanuc_pitch_tables import (
    AT_REFERENCE,
    DIRECTIONS,
    INTERVAL,
    MOST_MISSED,
    NEGATIVE_FIRST,
    PARAMETERS,
    PitchBlock,
    PitchSettings,
    PitchShortfall,
    PitchTables,
    RequestedPitch,
    parse_pitch,
    pitch_usage,
    pitch_violations,
    read_pitch_settings,
    shortfall_text,
)
from compgen.controls.fanuc_records import PointGrid, Punched, Sample, as_sample
from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, by_travel, nodes_by_axis, travel_of
from compgen.controls.shared.grids import (
    EquidistantGrid,
    common_step,
    curve_nodes_mm,
    equidistant_grid,
    grid_of_step,
    nearly_best,
    worth_mm,
)
from compgen.controls.shared.integers import IntegerCurve, best_integers, lowest_free, travel_weights
from compgen.controls.shared.tables import along_itself
from compgen.controls.shared.terms import one_dimensional_name, one_dimensional_terms
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenWarning

# Section length of pitch compensation: the widest without loss that keeps every increment small enough.


#: Factor by which the final curve may be steeper than the estimate: angular errors are spread over the volume.
STEEPER = 1.1
#: Interpolation loss, in counts, hidden by rounding to whole counts.
NEGLIGIBLE_COUNTS = 0.05


def pitch_grid(machine: Machine, settings: PitchSettings, errors: ErrorTable, axis: int) -> EquidistantGrid:
    """Return the section ends of an axis, including the reference point.

    Points in the sample from the control keep their section ends. The user's interval
    is used as it is. Otherwise the fewest sections for which linear interpolation of the requested correction
    has no significant loss and every increment, with a margin, stays within the limit (one count with a staircase),
    as far as the axis' point numbers and the least interval permit.
    """
    kept = settings.kept[axis]
    if kept is not None:
        lowest = kept.first if settings.total else kept.first - 1
        start = Decimal(repr(machine.reference_point_mm[axis])) + (lowest - kept.reference) * kept.interval_mm
        return EquidistantGrid(start, kept.interval_mm, kept.last - lowest + 1)
    most = max(3, (settings.last_number - settings.first_number + 1) // 3)
    asked_mm = settings.interval_mm[axis]
    if asked_mm is not None:
        return equidistant_grid(machine, errors, axis, most=most, step_mm=asked_mm, anchor=True)
    nodes_mm = curve_nodes_mm(machine, errors, axis, most)
    # its positioning error, and the effect of angular errors at mid-volume
    (term,) = one_dimensional_terms(machine, errors, [nodes_mm] * 3, [(axis, axis)])
    wanted_mm = term.start
    loss_mm = max(worth_mm(errors, axis, settings.loss_mm), NEGLIGIBLE_COUNTS * settings.count_mm(axis))
    flat: list[tuple[float, EquidistantGrid]] = []
    places_mm = (*machine.axes[axis].range_mm, machine.reference_point_mm[axis])
    common = common_step(machine, errors, axis, anchor=True)
    grids = _grids(places_mm, common, settings.least_interval_mm, settings.interval_quantum_mm, most)
    for grid in grids:
        at_ends_mm = _extended(grid.nodes_mm, nodes_mm, wanted_mm)
        largest = float(np.max(np.abs(np.diff(at_ends_mm)))) / settings.count_mm(axis)
        staircase = settings.interpolation == "staircase"
        if largest <= 1.0 if staircase else STEEPER * largest + 1.0 <= settings.increment_limit:
            lost_mm = float(np.max(np.abs(np.interp(nodes_mm, grid.nodes_mm, at_ends_mm) - wanted_mm)))
            flat.append((lost_mm, grid))
            if lost_mm <= loss_mm:
                return grid
    return nearly_best(flat) or grids[-1]


@lru_cache(maxsize=16)  # hundreds of intervals, for the tables, their verification and the report
def _grids(
    places_mm: tuple[float, float, float], common: Decimal, least_mm: float, quantum_mm: Decimal, most: int
) -> list[EquidistantGrid]:
    """Possible section ends, by number of sections; only the widest sections if none stays within ``most``.

    ``places_mm`` are the travel ends and the reference point, ``common`` the step of the curves' nodes, ``least_mm`` and
    ``quantum_mm`` the least interval and the unit of intervals.
    """
    low_mm, high_mm, _ = places_mm
    steps = set()
    for intervals in range(1, most):
        # travel over the intervals, rounded up to a writable value, not below the least interval
        length = Decimal(repr(round(max((high_mm - low_mm) / intervals, least_mm), 9))) / quantum_mm
        steps.add(float(max(Decimal(1), length.to_integral_value(rounding=ROUND_CEILING)) * quantum_mm))
    parts = [common / part for part in range(1, 11)]
    steps |= {float(step) for step in parts if step >= least_mm and step % quantum_mm == 0}
    low, high, origin = (Decimal(repr(place)) for place in places_mm)
    count_most = (high_mm - low_mm) / most
    grids = [grid_of_step(low, high, origin, Decimal(repr(step))) for step in steps if step > count_most]
    grids = sorted(grids, key=lambda grid: (grid.count, grid.step))
    return [grid for grid in grids if grid.count <= most] or grids[:1]


def _extended(position_mm: FloatArray, nodes_mm: FloatArray, value: FloatArray) -> FloatArray:
    """Interpolate linearly at positions (m,), extrapolating the first and last segments beyond the nodes (n,)."""
    inner = np.interp(position_mm, nodes_mm, value)
    below = np.minimum(position_mm - nodes_mm[0], 0.0) * (value[1] - value[0]) / (nodes_mm[1] - nodes_mm[0])
    above = np.maximum(position_mm - nodes_mm[-1], 0.0) * (value[-1] - value[-2]) / (nodes_mm[-1] - nodes_mm[-2])
    return np.asarray(inner + below + above, dtype=np.float64)


# From requested curves to stored pitch error compensation: best whole numbers, and point numbers for each block.
#
# Bi-directional: with the reversal B (position reached in positive minus in negative direction) the tool is at +B/2
# after positive travel, so the correction is the mean minus B/2 there, and plus B/2 after negative travel. The curve of
# the direction of the reference return is zero at the reference point; the other has the value of parameter 3627 there.


Span = tuple[int, int]


def reference_node(machine: Machine, axis: int, nodes_mm: FloatArray) -> int:
    """Return the index of the section end at the reference point."""
    return int(np.argmin(np.abs(nodes_mm - machine.reference_point_mm[axis])))


def _block(
    machine: Machine, settings: PitchSettings, axis: int, requested: RequestedPitch, reversal: ReversalCurves | None
) -> tuple[PitchBlock, list[PitchShortfall]]:
    """Table of one axis with numbers from 0, and what the step limit costs it."""
    nodes_mm = requested.nodes_mm
    below = reference_node(machine, axis, nodes_mm)
    half = np.zeros(len(nodes_mm))
    curve = None if reversal is None else reversal.curves.get((axis, axis))
    if settings.bidirectional and curve is not None and np.max(np.abs(curve.value)) >= WORTH_MM:
        half = 0.5 * settings.sign * curve.at(nodes_mm) / settings.count_mm(axis)
    towards = settings.reference_return[axis]
    both = {1: requested.counts - half, -1: requested.counts + half}
    home = both[towards][below]
    both = {way: part - home for way, part in both.items()}
    at_reference = int(np.floor(both[-towards][below] + 0.5))
    both[-towards] = both[-towards] - at_reference
    ways = (1, -1) if settings.bidirectional else (1,)
    sections = travel_weights(machine, axis, nodes_mm)
    best = {way: best_integers(both[way], sections, below, settings.increment_limit) for way in ways}
    limited = [PitchShortfall(axis, item.largest, item.full_sections) for item in best.values() if item.limited]
    keep = settings.kept[axis] is not None
    interval = Decimal(repr(round(float(nodes_mm[-1] - nodes_mm[0]), 9))) / (len(nodes_mm) - 1)
    block = PitchBlock(
        reference=below if settings.total else below - 1 if keep else max(below - 1, 0),
        first=0,
        values=_stored(settings, best[1], below, keep),
        total=settings.total,
        magnification=settings.magnifications[axis],
        interval_mm=Decimal(f"{interval.quantize(settings.interval_quantum_mm).normalize():f}"),
        negative=_stored(settings, best[-1], below, keep) if settings.bidirectional else (),
        at_reference=at_reference if settings.bidirectional else 0,
    )
    return block, limited[:1]


def _stored(settings: PitchSettings, best: IntegerCurve, below: int, keep: bool) -> tuple[int, ...]:
    """Numbers as stored; without travel below it, the reference number is added unless the sample's points are kept."""
    if settings.total:
        return tuple(int(value) for value in best.counts)
    steps = np.diff(best.counts, prepend=[0]) if below == 0 and not keep else np.diff(best.counts)
    return tuple(int(value) for value in steps)


def _placed(settings: PitchSettings, blocks: Sequence[PitchBlock | None]) -> list[PitchBlock | None]:
    """Give every block its numbers: from the sample, as fixed by the user, or else the lowest free ones.

    Numbers used by another axis in the sample are never taken; InputError if the user fixed such numbers.
    """
    sample, kept = settings.sample, settings.kept
    taken: list[Span] = [*settings.reserved, *(span for _, span in sample.others(0))]
    firsts: dict[int, int] = {}
    present = {axis: block for axis, block in enumerate(blocks) if block is not None}
    for axis in sorted(present, key=lambda k: kept[k] is None and settings.first_numbers[k] is None):
        count, grid, fixed = len(present[axis].values), kept[axis], settings.first_numbers[axis]
        start = fixed if grid is None else grid.first
        firsts[axis] = lowest_free(taken, settings.first_number, count) if start is None else start
        sample.check_free(settings.axis_numbers[axis], AXES[axis], firsts[axis], firsts[axis] + count - 1)
        taken.append((firsts[axis], firsts[axis] + count - 1))
    placed: list[PitchBlock | None] = [None, None, None]
    for axis, block in present.items():
        first, negative = firsts[axis], 0
        if block.negative:
            known_axis = sample.axes.get(settings.axis_numbers[axis])
            shown = known_axis.negative_first if known_axis is not None and kept[axis] is not None else None
            count = len(block.negative)
            negative = lowest_free(taken, settings.negative_first_number, count) if shown is None else shown
            sample.check_free(settings.axis_numbers[axis], AXES[axis], negative, negative + count - 1)
            taken.append((negative, negative + count - 1))
        placed[axis] = replace(block, reference=block.reference + first, first=first, negative_first=negative)
    return placed


def pitch_points(machine: Machine) -> tuple[PointGrid | None, ...]:
    """Return the points given to X, Y and Z in every fanuc-pitch export of this machine file; None if errors decide.

    Points do not depend on the errors if a sample shows them, or if interval and first number are stated; the first
    number follows if the intervals of all axes are stated.
    """
    if "fanuc-pitch" not in machine.controllers:
        return (None, None, None)
    settings = read_pitch_settings(machine)
    known = [settings.kept[axis] is not None or settings.interval_mm[axis] is not None for axis in range(3)]
    blocks: list[PitchBlock | None] = []
    for axis in range(3):
        nodes_mm = pitch_grid(machine, settings, ErrorTable({}), axis).nodes_mm if known[axis] else np.zeros(0)
        requested = RequestedPitch(nodes_mm, np.zeros(len(nodes_mm)))
        blocks.append(_block(machine, settings, axis, requested, None)[0] if known[axis] else None)
    fixed = [settings.kept[axis] is not None or settings.first_numbers[axis] is not None for axis in range(3)]
    return tuple(
        PointGrid(block.reference, block.first, block.last, block.interval_mm)
        if block is not None and (all(known) or fixed[axis])
        else None
        for axis, block in enumerate(_placed(settings, blocks))
    )


# Template content for stored pitch error compensation: records, plan, parameters to set, worked example.


MEANINGS = (
    "point number at the reference point",
    "farthest point number on the negative side",
    "farthest point number on the positive side",
    "magnification",
    "interval",
    "farthest point number on the negative side for travel in negative direction",
    "value at the reference point when it is reached against the direction of the reference return",
)


def _change(sample: Sample, parameter: int, axis: int, text: str) -> str:
    """A parameter with its value, and the sample's value if different."""
    old = sample.parameters.get((parameter, axis))
    same = old is None or Decimal(old[0]) == Decimal(text)
    return f"{parameter} = {text}" if same else f"{parameter} = {text} (sample: {old[0] if old else ''})"


# FANUC stored pitch error compensation: positioning of X, Y and Z, whole-number increments per section of travel.
#
# What the control is assumed to do, and how certain that is: see ``templates/fanuc-pitch/format.toml``.


class FanucPitch(Controller[PitchSettings, PitchTables]):
    """Tables X(x), Y(y), Z(z) in counts, zero at the reference point."""

    name = "fanuc-pitch"
    settings_class = PitchSettings
    anchored = True
    bidirectional = True
    has_plan = True
    sample_setting = "style_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> PitchSettings:
        """Check ``[controllers.fanuc-pitch]``."""
        return read_pitch_settings(machine)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one table per axis whose nodes are the section ends, including the reference point."""
        nodes = [pitch_grid(self.machine, self.settings, errors, axis).nodes_mm for axis in range(3)]
        return one_dimensional_terms(self.machine, errors, nodes, [(axis, axis) for axis in range(3)], anchored=True)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> PitchTables:
        """Find the best whole cumulative curves within the limit, and give the axes consecutive point numbers."""
        terms = {term.name: term for term in basis}
        requested: list[RequestedPitch | None] = [None, None, None]
        for axis in range(3):
            name = one_dimensional_name(axis, axis)
            if name in terms:
                nodes_mm, curve = terms[name].nodes_mm, np.asarray(values[name], dtype=np.float64)
                below = reference_node(self.machine, axis, nodes_mm)
                counts = self.settings.sign * (curve - curve[below]) / self.settings.count_mm(axis)
                requested[axis] = RequestedPitch(nodes_mm, counts)
        return self._tables_of(requested)

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Return the reversal of each axis along itself if ``bidirectional`` is set, else none."""
        return along_itself(reversal) if self.settings.bidirectional else ReversalCurves({})

    def with_reversal(self, tables: PitchTables, reversal: ReversalCurves) -> PitchTables:
        """Return the tables of both directions, each with the best whole numbers for its curve."""
        return self._tables_of(tables.requested, reversal)

    def context(self, tables: PitchTables) -> dict[str, Any]:
        """Return the context beyond the common one; ``plan`` maps point number -> value for a binary transfer."""
        settings = self.settings
        present = [(axis, block) for axis, block in enumerate(tables.blocks) if block is not None]
        separate = settings.sample.points_style is not None
        points = {number: value for _, block in present for number, value in block.points()}
        return {
            "sign_statement": self._sign_statement(),
            "parameters": self._preflight_parameters(present),
            "warnings": [
                *self._warnings(present),
                *(shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts <= MOST_MISSED),
            ],
            "tables": [self._summary(axis, block) for axis, block in present],
            "style": settings,
            "file": self._punched(present),
            "parameter_file": Punched(settings.style.file(self._parameter_records(present), [])) if separate else None,
            "container": "separate" if separate else "one file",
            "separate": separate,
            "overwrites": self._overwrites(present),
            "has_sample": settings.sample.shows_points,
            "style_notes": list(settings.sample.notes),
            "bidirectional": settings.bidirectional,
            "plan": {
                "parameters": self._parameters(present),
                "points": points,
                "value_type": settings.value_type,
                "bidirectional": settings.bidirectional,
                "stores": settings.stores,
                "detection_unit_um": settings.detection_unit_um,
            },
            "check": self._check(*present[0]) if present else None,
        }

    def parse(self, files: Sequence[SourceFile]) -> PitchTables:
        """Read parameters 3620 ... 3624 and their points; a ``.json`` plan is skipped."""
        return parse_pitch(self.settings, files)

    def emulate(self, tables: PitchTables, points: Points) -> FloatArray:
        """Return sign * count * A at each point, A constant beyond the first and last section ends."""
        added = np.zeros((len(points), 3))
        unknown = []
        for axis, block in enumerate(tables.blocks):
            if block is None:
                continue
            along = points.position_mm[:, axis] - self.machine.reference_point_mm[axis]
            count_mm = block.magnification * self.settings.detection_unit_um * MM_PER_UM
            curves = block.curves(self.settings.reference_return[axis])
            if self.settings.interpolation == "linear":
                up, down = (np.interp(along, block.curve_mm, curve) for curve in curves)
            else:  # a section's value is output at its start: A[n] for ((n-1-ref) d, (n-ref) d]
                section = np.ceil(along / float(block.interval_mm) - 1e-9) + block.reference
                inside = np.clip(section, block.curve_numbers[0], block.last).astype(np.int64)
                up, down = (curve[inside - block.curve_numbers[0]].astype(np.float64) for curve in curves)
            travel = travel_of(points, axis)
            added[:, axis] = self.settings.sign * count_mm * by_travel(travel, up, down)
            if np.any((travel == 0) & (up != down)):
                unknown.append(AXES[axis])
        if unknown:
            message = (
                f"the tables of {', '.join(unknown)} differ between the directions of travel, but some points have no "
                "approach direction: the mean is taken there; give approach_x, approach_y, approach_z"
            )
            warnings.warn(message, CompgenWarning, stacklevel=2)
        return added

    def violations(self, tables: PitchTables) -> list[str]:
        """Return exceeded limits: change per section, 16 bits, point numbers, overlaps, interval, uncovered travel."""
        return pitch_violations(self.machine, self.settings, tables)

    def table_nodes_mm(self, tables: PitchTables) -> tuple[FloatArray, ...]:
        """Return the section ends of each axis."""
        blocks = ((axis, block) for axis, block in enumerate(tables.blocks) if block is not None)
        return nodes_by_axis((axis, self.machine.reference_point_mm[axis] + block.curve_mm) for axis, block in blocks)

    def backlash_parameters(self, reversal: ReversalCurves) -> list[dict[str, str]]:
        """Return parameters 1851 and 1852 for the mean reversal of each axis along itself, in detection units.

        Source: parameter manuals B-63090EN p. 97, B-64120EN p. 116: added in the direction of movement, -9999 to +9999;
        an axis that stops short (reversal value below zero) gets a positive value.
        """
        settings = self.settings
        meanings = {
            1851: "backlash compensation in detection units: minus the mean reversal value; these tables are the same "
            "for both directions. If a value was active while the machine was measured, add this one to it",
            1852: "the same in rapid traverse, if the control has a separate value (1800#4, RBK = 1)",
        }
        return [
            {
                "name": f"{number} ({AXES[axis]}, A{settings.axis_numbers[axis]})",
                "value": str(round(-reversal.mean_mm(axis) / (settings.detection_unit_um * MM_PER_UM))),
                "meaning": meaning,
            }
            for axis in range(3)
            for number, meaning in meanings.items()
            if abs(reversal.mean_mm(axis)) >= WORTH_MM
        ]

    def usage(self, tables: PitchTables) -> list[Usage]:
        """Return change per section, point numbers and interval against their limits."""
        return pitch_usage(self.settings, tables)

    def keeping_others(self, tables: PitchTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with these files if they contain points of other axes."""
        return as_sample(self.machine, files, ("fanuc-pitch", "fanuc-straightness")) if tables.others else {}

    def resolution_mm(self) -> float:
        """Return half a count: the bound of :mod:`compgen.controls.shared.integers` where the limit is not active."""
        return 0.5 * max(self.settings.count_mm(axis) for axis in range(3))

    def _tables_of(
        self, requested: Sequence[RequestedPitch | None], reversal: ReversalCurves | None = None
    ) -> PitchTables:
        """Return the best whole tables for requested curves, each with its reversal along itself, and their numbers."""
        blocks: list[PitchBlock | None] = [None, None, None]
        shortfalls: list[PitchShortfall] = []
        for axis, curve in enumerate(requested):
            if curve is not None:
                blocks[axis], limited = _block(self.machine, self.settings, axis, curve, reversal)
                shortfalls += limited
        placed = _placed(self.settings, blocks)
        numbered = []
        for item in shortfalls:  # their sections count from 0, the control's from the first point number
            numbers = placed[item.axis].curve_numbers  # type: ignore[union-attr]
            numbered.append(replace(item, sections=tuple(int(numbers[k + 1]) for k in item.sections)))
        return PitchTables(tuple(placed), shortfalls=tuple(numbered), requested=tuple(requested))

    def _values_of(self, block: PitchBlock) -> dict[int, str]:
        """Parameter number -> value as text for one axis."""
        settings, whole = self.settings, self.settings.style.whole
        # without a decimal point the interval is in the unit stated in the machine file
        unit = Decimal(1) if settings.style.real_point else settings.interval_quantum_mm
        found = dict(
            zip(
                PARAMETERS,
                (
                    *map(whole, (block.reference, block.first, block.last, block.magnification)),
                    settings.style.length(block.interval_mm / unit),
                ),
                strict=True,
            )
        )
        if settings.bidirectional:
            found |= {NEGATIVE_FIRST: whole(block.negative_first), AT_REFERENCE: whole(block.at_reference)}
        return found

    def _parameters(self, present: list[tuple[int, PitchBlock]]) -> dict[int, dict[int, str]]:
        """Parameter number -> axis number, ascending -> value as text."""
        columns = sorted((self.settings.axis_numbers[axis], self._values_of(block)) for axis, block in present)
        return (
            {number: {axis: values[number] for axis, values in columns} for number in columns[0][1]} if columns else {}
        )

    def _parameter_records(self, present: list[tuple[int, PitchBlock]]) -> list[str]:
        style, records = self.settings.style, []
        for number, values in self._parameters(present).items():
            records += style.parameter(number, values.items(), style.real_letter if number == INTERVAL else "P")
        return records

    def _punched(self, present: list[tuple[int, PitchBlock]]) -> Punched:
        """Text of the file in its style: parameters by number unless they have a separate file, points by number."""
        style, separate = self.settings.style, self.settings.sample.points_style
        points = [
            (separate or style).point(*pair) for pair in sorted(pair for _, block in present for pair in block.points())
        ]
        if separate is not None:
            return Punched(separate.file([], points))
        return Punched(style.file(self._parameter_records(present), points))

    def _overwrites(self, present: list[tuple[int, PitchBlock]]) -> list[str]:
        """Say what the files overwrite, other axes first."""
        settings = self.settings
        sample, written = settings.sample, [settings.axis_numbers[axis] for axis, _ in present]
        others = [
            f"A{number}: points {low} to {high}"
            for number, axis in sample.axes.items()
            if number not in written
            for low, high in axis.spans
        ]
        if sample.shows_points:
            remark = f"Kept: {'; '.join(others)}." if others else "No other axis of the sample has points."
            found = [f"Of other axes: nothing. {remark}"]
        else:
            given = (
                "the sample has no parameters 3620 to 3622"
                if settings.sample.notes
                else "no file of this control was given"
            )
            found = [
                f"Of other axes: NOT KNOWN, {given} (`--style-from`). An axis whose points (3621 to 3622) overlap "
                "those below loses its table."
            ]
        for axis, block in present:
            number, name = settings.axis_numbers[axis], f"{AXES[axis]} (A{settings.axis_numbers[axis]})"
            values = self._values_of(block).items()
            changes = ", ".join(_change(sample, p, number, text) for p, text in values)
            found.append(f"Parameters of {name}: {changes}")
            spans = [(block.first, block.last)]
            if block.negative:
                spans.append((block.negative_first, block.negative_last))
            texts = [
                f"{low} to {high} (N{settings.number_base + low} to N{settings.number_base + high})"
                for low, high in spans
            ]
            old = {key: sample.values[key] for key, _ in block.points() if key in sample.values}
            changed = sum(1 for key, value in block.points() if key in old and old[key] != value)
            both = f"{texts[0]} and {texts[1]}" if block.negative else texts[0]
            text = f"Points of {name}: {both}"
            found.append(f"{text}; {changed} of them differ from the sample" if old else text)
        return found

    def _preflight_parameters(self, present: list[tuple[int, PitchBlock]]) -> list[dict[str, str]]:
        settings = self.settings
        rows = [
            {"name": f"{number} ({AXES[axis]}, A{settings.axis_numbers[axis]})", "value": value, "meaning": meaning}
            for axis, block in present
            for (number, value), meaning in zip(self._values_of(block).items(), MEANINGS, strict=False)
        ]
        bits = [
            f"{AXES[axis]} {text}"
            for axis, _ in present
            if (text := settings.sample.bits(DIRECTIONS, settings.axis_numbers[axis])) is not None
        ]
        shown = f"; the sample has {', '.join(bits)} (bit 7 first)" if bits else ""
        rows += [
            {
                "name": "3605#0",
                "value": str(int(settings.bidirectional)),
                "meaning": f"bi-directional pitch compensation {'on' if settings.bidirectional else 'off'}, for X, Y and Z",
            },
            {
                "name": "3602#0 (APE)",
                "value": "total" if settings.total else "incremental",
                "meaning": "type of the values; the parameter manual says which bit value means which",
            },
            {
                "name": "3605, interpolated type",
                "value": "on" if settings.interpolation == "linear" else "off",
                "meaning": f"interpolated pitch compensation; the files were checked as {settings.interpolation}. "
                "Which bit switches it on is not certain (bit 1 is set in the backup of a 30i; bit 2, IPP, "
                "is from memory): read the parameter manual, and leave the bits as they are in the "
                f"backup{shown}",
            },
        ]
        return rows + (self._directional_rows(present) if settings.bidirectional else [])

    def _directional_rows(self, present: list[tuple[int, PitchBlock]]) -> list[dict[str, str]]:
        """Reference return as the tables assume it, and backlash, which tables of both directions already include."""
        settings = self.settings
        rows = []
        for axis, _ in present:
            name, towards = f"({AXES[axis]}, A{settings.axis_numbers[axis]})", settings.reference_return[axis] > 0
            rows += [
                {
                    "name": f"1006#5 (ZMI) {name}",
                    "value": "0" if towards else "1",
                    "meaning": f"reference return in {'positive' if towards else 'negative'} direction, as the tables "
                    "assume; if the control has another value, set reference_return in the machine file, "
                    "else the reversal doubles",
                },
                *(
                    {
                        "name": f"{number} {name}",
                        "value": "0",
                        "meaning": "the tables of both directions already correct the backlash",
                    }
                    for number in (1851, 1852)
                ),
            ]
        return rows

    def _sign_statement(self) -> str:
        settings = self.settings
        stored = "correction, which the control adds"
        if settings.stores == "error":
            stored = "error, which the control subtracts"
        kind = (
            "A value is the sum up to its point"
            if settings.total
            else "A value is the change over its section in the positive direction"
        )
        count_um, other = settings.count_mm(0) / MM_PER_UM, ""
        if len(set(settings.magnifications)) > 1:
            other = " of X; " + ", ".join(f"{settings.count_mm(k) / MM_PER_UM:g} um of {AXES[k]}" for k in (1, 2))
        text = (
            f"The numbers are the {stored}; one count is {count_um:g} um{other} (magnification "
            f"{', '.join(map(str, dict.fromkeys(settings.magnifications)))} times detection unit "
            f"{settings.detection_unit_um:g} um). {kind}. Example: an X axis that travels {2 * count_um:g} um too "
            f"short over a section in the positive direction gets {2 * settings.sign:+d} there."
        )
        if not settings.bidirectional:
            return text
        return (
            f"{text} The points from 3621 to 3622 act in positive travel; as many points from 3626 on act in negative "
            "travel, and their values are also changes in the positive direction. With a reference return in positive "
            f"direction, an axis that stops {settings.count_mm(0) / MM_PER_UM:g} um farther after positive than after "
            f"negative travel gets {settings.sign:+d} in 3627."
        )

    def _warnings(self, present: list[tuple[int, PitchBlock]]) -> list[str]:
        settings = self.settings
        found = ["Public documents do not settle the sign of the values: check it on one section first (part 3)."]
        for axis, block in present:
            if settings.kept[axis] is not None:
                found.append(
                    f"The points {block.first} to {block.last} of {AXES[axis]}, their interval {block.interval_mm:f} "
                    f"mm and the magnification {block.magnification} are those of the sample; for a new layout set "
                    "interval_mm or first_numbers in the machine file."
                )
        if settings.sample.notes:
            found.append("The style was taken from the sample: " + "; ".join(settings.sample.notes) + ".")
        if settings.bidirectional:
            found.append(
                "Bi-directional: public documents do not settle 3627 (value at the reference point when it is reached "
                "against the reference return) and the point numbers for negative travel; check both directions at the "
                "machine."
            )
        if settings.interpolation == "staircase":
            worst_mm = max(
                (int(np.max(np.abs(np.diff(b.curve)))) * settings.count_mm(k) for k, b in present), default=0.0
            )
            found.append(
                "It is not documented where inside a section the plain type outputs its pulses: between section ends "
                f"the correction may be off by up to {fixed(worst_mm / MM_PER_UM, 1)} um."
            )
        if settings.max_feed_mm_min is None and present:
            shortest = min(float(block.interval_mm) for _, block in present)
            found.append(
                "max_feed_mm_min is not set in the machine file. By the rule interval >= feed / 7500 the shortest "
                f"interval of {shortest:g} mm allows {7500 * shortest:.0f} mm/min."
            )
        return found

    def _summary(self, axis: int, block: PitchBlock) -> dict[str, Any]:
        """One axis in numbers, for preflight: where its table is and how large its values are."""
        curves = block.curves(self.settings.reference_return[axis])
        ends_mm = self.machine.reference_point_mm[axis] + block.curve_mm
        return {
            "axis": AXES[axis],
            "reference": block.reference,
            "first": block.first,
            "last": block.last,
            "interval_mm": float(block.interval_mm),
            "first_mm": float(ends_mm[0]),
            "last_mm": float(ends_mm[-1]),
            "largest_step": max(int(np.max(np.abs(np.diff(curve)), initial=0)) for curve in curves),
            "largest_sum": max(int(np.max(np.abs(curve))) for curve in curves),
            "negative_first": block.negative_first,
            "negative_last": block.negative_last,
            "at_reference": block.at_reference,
        }

    def _check(self, axis: int, block: PitchBlock) -> dict[str, Any]:
        """Trial of one section next to the reference point: which number to set, and the laser reading to expect."""
        settings = self.settings
        upper = block.last > block.reference
        start_mm = self.machine.reference_point_mm[axis] - (0.0 if upper else float(block.interval_mm))
        counts = min(5, settings.increment_limit)
        # Below the reference point an increment belongs to the section's upper end, a total value to its lower end.
        number = block.reference + (1 if upper else -1 if block.total else 0)
        return {
            "axis": AXES[axis],
            "record": settings.number_base + number,
            "number": number,
            "from_mm": start_mm,
            "to_mm": start_mm + float(block.interval_mm),
            "counts": -counts if block.total and not upper else counts,
            "change_um": settings.sign * counts * block.magnification * settings.detection_unit_um,
            "interval_mm": float(block.interval_mm),
            "short_mm": float(block.interval_mm) - 2 * settings.count_mm(axis),
            "short_counts": 2 * settings.sign,
        }
