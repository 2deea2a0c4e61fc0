"""From wanted curves to the numbers of stored pitch error compensation: best whole numbers, and a place for each block.

Bi-directional: with the reversal B (position reached in positive minus in negative direction) the tool stands at +B/2
after positive travel, so the correction is the mean one minus B/2 there, and plus B/2 after negative travel. The curve of
the direction of the reference return is zero at the reference point, the other one has parameter 3627 there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from compgen.controllers.base import Term
from compgen.controllers.fanuc.pitch_grid import pitch_grid
from compgen.controllers.fanuc.pitch_settings import PitchSettings, read_pitch_settings
from compgen.controllers.fanuc.pitch_tables import PitchBlock, PitchTables, Shortfall, Wanted
from compgen.controllers.fanuc.sample import PointGrid
from compgen.controllers.integers import IntegerCurve, best_integers, lowest_free, section_weights
from compgen.controllers.terms import one_dimensional_name
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.reversal import WORTH_MM, ReversalCurves

Span = tuple[int, int]


def wanted_curves(
    machine: Machine, settings: PitchSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
) -> tuple[Wanted | None, Wanted | None, Wanted | None]:
    """Return for X, Y, Z the wanted cumulative curve at the section ends in counts, zero at the reference point."""
    terms = {term.name: term for term in basis}
    found: list[Wanted | None] = [None, None, None]
    for axis in range(3):
        name = one_dimensional_name(axis, axis)
        if name in terms:
            nodes_mm = terms[name].nodes_mm
            curve = np.asarray(values[name], dtype=np.float64)
            below = reference_node(machine, axis, nodes_mm)
            found[axis] = Wanted(nodes_mm, settings.sign * (curve - curve[below]) / settings.count_mm(axis))
    return found[0], found[1], found[2]


def reference_node(machine: Machine, axis: int, nodes_mm: FloatArray) -> int:
    """Return the index of the section end at the reference point."""
    return int(np.argmin(np.abs(nodes_mm - machine.reference_point_mm[axis])))


def tables_of(
    machine: Machine,
    settings: PitchSettings,
    wanted: tuple[Wanted | None, Wanted | None, Wanted | None],
    reversal: ReversalCurves | None = None,
) -> PitchTables:
    """Return the best whole tables for wanted curves, with the reversal of each axis along itself, and their numbers."""
    blocks: list[PitchBlock | None] = [None, None, None]
    shortfalls: list[Shortfall] = []
    for axis, curve in enumerate(wanted):
        if curve is not None:
            blocks[axis], limited = _block(machine, settings, axis, curve, reversal)
            shortfalls += limited
    placed = _placed(settings, blocks)
    numbered = [_renumbered(item, placed[item.axis]) for item in shortfalls]
    return PitchTables((placed[0], placed[1], placed[2]), shortfalls=tuple(numbered), wanted=wanted)


def _renumbered(shortfall: Shortfall, block: PitchBlock | None) -> Shortfall:
    """Point numbers in place of the sections' counts, which begin with 0."""
    assert block is not None
    return replace(shortfall, sections=tuple(int(block.curve_numbers[k + 1]) for k in shortfall.sections))


def _block(
    machine: Machine, settings: PitchSettings, axis: int, wanted: Wanted, reversal: ReversalCurves | None
) -> tuple[PitchBlock, list[Shortfall]]:
    """Table of one axis with numbers from 0, and what the limit of the steps costs it."""
    nodes_mm = wanted.nodes_mm
    below = reference_node(machine, axis, nodes_mm)
    half = np.zeros(len(nodes_mm))
    curve = None if reversal is None else reversal.curves.get((axis, axis))
    if settings.bidirectional and curve is not None and np.max(np.abs(curve.value)) >= WORTH_MM:
        half = 0.5 * settings.sign * curve.at(nodes_mm) / settings.count_mm(axis)
    towards = settings.reference_return[axis]
    both = {1: wanted.counts - half, -1: wanted.counts + half}
    home = both[towards][below]
    both = {way: part - home for way, part in both.items()}
    at_reference = int(np.floor(both[-towards][below] + 0.5))
    both[-towards] = both[-towards] - at_reference
    ways = (1, -1) if settings.bidirectional else (1,)
    best = {way: _best(machine, settings, axis, nodes_mm, both[way]) for way in ways}
    limited = [Shortfall(axis, item.largest, item.full_sections) for item in best.values() if item.limited]
    keep = settings.kept[axis] is not None
    block = PitchBlock(
        reference=below if settings.total else below - 1 if keep else max(below - 1, 0),
        first=0,
        values=_stored(settings, best[1], below, keep),
        total=settings.total,
        magnification=settings.magnifications[axis],
        interval_mm=_interval_mm(settings, nodes_mm),
        negative=_stored(settings, best[-1], below, keep) if settings.bidirectional else (),
        at_reference=at_reference if settings.bidirectional else 0,
    )
    return block, limited[:1]


def _best(
    machine: Machine, settings: PitchSettings, axis: int, nodes_mm: FloatArray, wanted: FloatArray
) -> IntegerCurve:
    emphasis = machine.emphasis
    sections = section_weights(nodes_mm, machine.axes[axis].range_mm, emphasis.zone_mm[axis], emphasis.zone_weight)
    return best_integers(wanted, sections, reference_node(machine, axis, nodes_mm), settings.increment_limit)


def _stored(settings: PitchSettings, best: IntegerCurve, below: int, keep: bool) -> tuple[int, ...]:
    """Numbers as stored; unless the sample has other points, the reference number is among them without travel below it."""
    if settings.total:
        return tuple(int(value) for value in best.counts)
    steps = np.diff(best.counts, prepend=[0]) if below == 0 and not keep else np.diff(best.counts)
    return tuple(int(value) for value in steps)


def _interval_mm(settings: PitchSettings, nodes_mm: FloatArray) -> Decimal:
    interval = Decimal(repr(round(float(nodes_mm[-1] - nodes_mm[0]), 9))) / (len(nodes_mm) - 1)
    return Decimal(f"{interval.quantize(settings.interval_quantum_mm).normalize():f}")


def _placed(settings: PitchSettings, blocks: Sequence[PitchBlock | None]) -> list[PitchBlock | None]:
    """Give every block its numbers: those of the sample, those that the user fixed, else the lowest that are free.

    Numbers that the sample shows in use by another axis are never taken; InputError where fixed ones would be.
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
            own = sample.axes.get(settings.axis_numbers[axis])
            shown = own.negative_first if own is not None and kept[axis] is not None else None
            count = len(block.negative)
            negative = lowest_free(taken, settings.negative_first_number, count) if shown is None else shown
            sample.check_free(settings.axis_numbers[axis], AXES[axis], negative, negative + count - 1)
            taken.append((negative, negative + count - 1))
        placed[axis] = replace(block, reference=block.reference + first, first=first, negative_first=negative)
    return placed


def pitch_points(machine: Machine) -> tuple[PointGrid | None, ...]:
    """Return the points that every fanuc-pitch export of this machine file gives X, Y and Z; None where errors decide.

    Points are known whatever the errors are where a sample shows them, or interval and first number are stated; the first
    number follows if the intervals of all axes are stated.
    """
    if "fanuc-pitch" not in machine.controllers:
        return (None, None, None)
    settings = read_pitch_settings(machine)
    known = [settings.kept[axis] is not None or settings.interval_mm[axis] is not None for axis in range(3)]
    blocks: list[PitchBlock | None] = []
    for axis in range(3):
        nodes_mm = pitch_grid(machine, settings, ErrorTable({}), axis).nodes_mm if known[axis] else np.zeros(0)
        wanted = Wanted(nodes_mm, np.zeros(len(nodes_mm)))
        blocks.append(_block(machine, settings, axis, wanted, None)[0] if known[axis] else None)
    fixed = [settings.kept[axis] is not None or settings.first_numbers[axis] is not None for axis in range(3)]
    return tuple(
        PointGrid(block.reference, block.first, block.last, block.interval_mm)
        if block is not None and (all(known) or fixed[axis])
        else None
        for axis, block in enumerate(_placed(settings, blocks))
    )
