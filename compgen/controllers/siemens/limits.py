"""Limits of SINUMERIK CEC tables: what the sum reaches over the volume, how fast it changes, and the rules of a set.

Rules: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245-249, 264.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Protocol

import numpy as np

from compgen.controllers.base import Usage
from compgen.controllers.siemens.products import CecMap, CecTable, sum_into_axes
from compgen.controllers.siemens.profiles import DEFAULT_MAX_SUM_MM, DEFAULT_MAX_VELO_PERCENT
from compgen.controllers.siemens.syntax import table_violations
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES

_MOST_POSITIONS = 81
_MOST_ACROSS = 21


def _positions(machine: Machine, tables: CecMap, axis: int, most: int | None) -> FloatArray:
    """Nodes of all tables over an axis within its travel and the ends; thinned to ``most``, extremes of tables kept."""
    low, high = machine.axes[axis].range_mm
    own = [entry.table for entry in tables.values() if entry.input_axis == axis]
    nodes = np.concatenate([[low, high], *(table.nodes_mm for table in own)])
    nodes = np.unique(np.round(np.clip(nodes, low, high), 6))
    if most is None or len(nodes) <= most:
        return nodes
    extremes = [table.nodes_mm[[np.argmin(table.numbers), np.argmax(table.numbers)]] for table in own]
    picked = nodes[np.unique(np.linspace(0, len(nodes) - 1, most).round().astype(int))]
    return np.unique(np.clip(np.concatenate([picked, *extremes]), low, high))


def _sums(tables: CecMap, mode: str, positions: Sequence[FloatArray], travel: Sequence[int]) -> list[FloatArray]:
    """Totals of the three axes over the grid of positions, each (nx, ny, nz), for one direction of travel per axis."""
    outputs = {}
    for index, entry in tables.items():
        axis = entry.input_axis
        acts = entry.direction in (0, travel[axis])
        value = entry.at(positions[axis]) * float(acts)
        outputs[index] = np.expand_dims(value, tuple(other for other in range(3) if other != axis))
    shape = tuple(len(along) for along in positions)
    return [np.broadcast_to(total, shape) for total in sum_into_axes(tables, mode, outputs)]


def _travels(tables: CecMap) -> list[tuple[int, ...]]:
    """Directions of travel that make a difference to some table."""
    directed = {entry.input_axis for entry in tables.values() if entry.direction}
    return list(product(*[(1, -1) if axis in directed else (1,) for axis in range(3)]))


def largest_sums(machine: Machine, tables: CecMap, mode: str) -> list[tuple[float, tuple[float, float, float]]]:
    """Return for each output axis the sum of largest size over the travel, with its sign (mm), and where it stands.

    Sums are multilinear between nodes, so the largest stands on nodes; all are searched, up to 81 positions per axis.
    """
    positions = [_positions(machine, tables, axis, _MOST_POSITIONS) for axis in range(3)]
    found = [(0.0, (0.0, 0.0, 0.0))] * 3
    for travel in _travels(tables):
        for output, total in enumerate(_sums(tables, mode, positions, travel)):
            x, y, z = np.unravel_index(int(np.argmax(np.abs(total))), total.shape)
            value = float(total[x, y, z])
            if abs(value) >= abs(found[output][0]):
                found[output] = value, (float(positions[0][x]), float(positions[1][y]), float(positions[2][z]))
    return found


def largest_slopes(machine: Machine, tables: CecMap, mode: str) -> FloatArray:
    """Return the largest change of each output's sum per travel of each base axis, shape (3 outputs, 3 bases), mm/mm."""
    slopes = np.zeros((3, 3))
    for base in range(3):
        most = [_MOST_ACROSS if axis != base else None for axis in range(3)]
        positions = [_positions(machine, tables, axis, most[axis]) for axis in range(3)]
        steps = np.expand_dims(np.diff(positions[base]), tuple(axis for axis in range(3) if axis != base))
        for travel in _travels(tables):
            for output, total in enumerate(_sums(tables, mode, positions, travel)):
                slope = float(np.max(np.abs(np.diff(total, axis=base) / steps), initial=0.0))
                slopes[output, base] = max(slopes[output, base], slope)
    return slopes


def set_violations(machine: Machine, tables: CecMap, max_points: int, tables_available: int | None) -> list[str]:
    """Return broken rules of single tables and of the set: grid, travel, numbers of tables and nodes, references."""
    found: list[str] = []
    for index, entry in sorted(tables.items()):
        what = f"table {index} ({AXES[entry.output_axis]} over {AXES[entry.input_axis]})"
        found += table_violations(machine, entry.input_axis, entry.table, max_points, what)
        found += _reference_violations(tables, index, entry, what)
    needed = max(tables) + 1
    if tables_available is not None and needed > tables_available:
        found.append(f"{needed} tables are needed, the control has {tables_available}")
    return found


def _reference_violations(tables: CecMap, index: int, entry: CecTable, what: str) -> list[str]:
    found = []
    if entry.direction not in (-1, 0, 1):
        found.append(f"{what}: DIRECTION is {entry.direction}; 0, 1 and -1 are allowed")
    if entry.multiplier:
        other = tables.get(entry.multiplier - 1)
        if other is None:
            found.append(f"{what}: MULT_BY_TABLE names table number {entry.multiplier}, which does not exist")
        elif other.table.modulo != entry.table.modulo:
            found.append(f"{what}: it and its multiplier {entry.multiplier - 1} are not both cyclic or both not")
    factors = {other.multiplier - 1 for other in tables.values() if other.multiplier}
    if (entry.multiplier or index in factors) and (entry.weight != 1 or not entry.enabled):
        found.append(
            f"{what} is a factor of a product, with SD41300 = {int(entry.enabled)} and SD41310 = {entry.weight}; what "
            "the product is then is not documented: both must be 1"
        )
    return found


def speed_percent(slopes: FloatArray, output: int, max_speed_mm_min: Sequence[float]) -> float:
    """Return how fast the sum into an axis changes, in % of the axis' own largest speed, all bases at theirs.

    Rule: largest change per travel, times the speed of the base, against MD32730 / 100 times MD32000 of the output.
    """
    speeds = np.asarray(max_speed_mm_min, dtype=np.float64)
    return float(100.0 * np.sum(slopes[output] * speeds) / speeds[output])


def stated_limit_violations(machine: Machine, tables: CecMap, limits: StatedLimits) -> list[str]:
    """Return where the sums exceed MD32720, or change faster than MD32730, as far as these are stated."""
    found = []
    if limits.max_sum_mm is not None:
        for axis, (value, place) in enumerate(largest_sums(machine, tables, limits.mult_mode)):
            if abs(value) > limits.max_sum_mm[axis]:
                found.append(
                    f"the sum into {limits.axis_names[axis]} reaches {value:+.6f} mm at X {place[0]:g} Y {place[1]:g} "
                    f"Z {place[2]:g}; MD32720 clips it at {limits.max_sum_mm[axis]:g} mm"
                )
    if limits.max_velo_percent is not None:
        slopes = largest_slopes(machine, tables, limits.mult_mode)
        for axis, allowed in enumerate(limits.max_velo_percent):
            percent = speed_percent(slopes, axis, limits.max_speed_mm_min)
            if percent > allowed:
                found.append(
                    f"the sum into {limits.axis_names[axis]} changes by up to {percent:.4f} % of the axis' largest "
                    f"speed; MD32730 allows {allowed:g} %"
                )
    return found


class StatedLimits(Protocol):
    """The settings that hold limits of the control."""

    @property
    def mult_mode(self) -> str:
        """Reading of MULT_BY_TABLE."""

    @property
    def max_points(self) -> int:
        """Nodes per table."""

    @property
    def tables_available(self) -> int | None:
        """Number of tables that the control has."""

    @property
    def max_sum_mm(self) -> tuple[float, float, float] | None:
        """MD32720."""

    @property
    def max_velo_percent(self) -> tuple[float, float, float] | None:
        """MD32730."""

    @property
    def max_speed_mm_min(self) -> tuple[float, float, float]:
        """MD32000."""

    @property
    def axis_names(self) -> tuple[str, str, str]:
        """Names of X, Y, Z on the control."""


def cec_usage(machine: Machine, tables: CecMap, limits: StatedLimits) -> list[Usage]:
    """Return nodes of the longest table, number of tables, largest sums and their largest change against the limits."""
    nodes = max(len(entry.table.values) for entry in tables.values())
    found = [Usage("nodes of the longest table", nodes, limits.max_points, "nodes")]
    if limits.tables_available is not None:
        found.append(Usage("tables", max(tables) + 1, limits.tables_available, "tables"))
    sums, slopes = largest_sums(machine, tables, limits.mult_mode), largest_slopes(machine, tables, limits.mult_mode)
    for axis in sorted({entry.output_axis for entry in tables.values()}):
        name, stated = limits.axis_names[axis], limits.max_sum_mm is not None
        most_mm = DEFAULT_MAX_SUM_MM if limits.max_sum_mm is None else limits.max_sum_mm[axis]
        percent, velo = speed_percent(slopes, axis, limits.max_speed_mm_min), limits.max_velo_percent
        most_percent = DEFAULT_MAX_VELO_PERCENT if velo is None else velo[axis]
        found.append(Usage(f"sum into {name} (MD32720)", abs(sums[axis][0]), most_mm, "mm", stated))
        found.append(Usage(f"change of the sum of {name} (MD32730)", percent, most_percent, "%", velo is not None))
    return found
