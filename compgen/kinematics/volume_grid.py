"""Points that fill the working volume: where tables have their nodes, and between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Emphasis, Machine

#: A full grid larger than this is thinned to about as many points.
MOST_POINTS = 20_000


NO_EMPHASIS = Emphasis()
#: Gauss-Legendre points across an axis of which the own levels are taken.
LEAST_ACROSS, MOST_ACROSS = 4, 12
#: Fewer points than this in a plane of a thinned grid are not spread evenly enough.
LEAST_IN_PLANE = 144
#: Least number of intervals over an axis in a sample.
LEAST_INTERVALS = 10


@dataclass(frozen=True)
class VolumeSample:
    """Points (n, 3) in mm with weights (n,) of mean 1, for integrals over the volume."""

    position_mm: FloatArray
    weight: FloatArray


def levels_between(nodes_mm: FloatArray, low_mm: float, high_mm: float) -> FloatArray:
    """Return the nodes within the travel, its ends, and the middle of every interval, ascending."""
    inside = nodes_mm[(nodes_mm > low_mm + 1e-9) & (nodes_mm < high_mm - 1e-9)]
    ends = np.concatenate([[low_mm], np.unique(inside), [high_mm]])
    return np.sort(np.concatenate([ends, 0.5 * (ends[1:] + ends[:-1])]))


@dataclass(frozen=True)
class VolumeGrid:
    """A full grid over the working volume; ``levels_mm`` per axis, points in C order (z runs fastest)."""

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of levels of X, Y and Z."""
        x, y, z = (len(levels) for levels in self.levels_mm)
        return x, y, z

    @property
    def position_mm(self) -> FloatArray:
        """All points, shape (n, 3)."""
        return np.stack(np.meshgrid(*self.levels_mm, indexing="ij"), axis=-1).reshape(-1, 3)


def volume_grid(machine: Machine, nodes_mm: tuple[FloatArray, ...], most: int = MOST_POINTS) -> VolumeGrid:
    """Return the grid of the nodes and the middles between them; thinned evenly where it would exceed ``most``."""
    levels = [
        levels_between(np.asarray(nodes), *axis.range_mm) for nodes, axis in zip(nodes_mm, machine.axes, strict=True)
    ]
    while np.prod([len(level) for level in levels]) > most:
        longest = int(np.argmax([len(level) for level in levels]))
        count = max(2, int(0.8 * len(levels[longest])))
        picked = np.unique(np.round(np.linspace(0, len(levels[longest]) - 1, count)).astype(int))
        levels[longest] = levels[longest][picked]
    return VolumeGrid((levels[0], levels[1], levels[2]))


def volume_sample(
    machine: Machine,
    nodes_mm: tuple[FloatArray, ...],
    most: int = MOST_POINTS,
    emphasis: Emphasis = NO_EMPHASIS,
) -> VolumeSample:
    """Return points that determine tables with the given nodes over the volume; weighted sums are integrals over it.

    Along each axis there are two Gauss-Legendre points between neighbouring nodes: what tables that are linear there can
    hold is integrated exactly. Of the full grid of them, where it has more than ``most`` points, those (i, j, k) are taken
    whose i + j + k is a multiple of a whole number. Each plane of the grid then has points that are spread evenly over
    the other two axes, so that a function of one axis is orthogonal to functions of the others as it is over the
    volume; a random sample would turn what the tables cannot hold into ragged values.

    The weight of the work zone of ``emphasis`` is part of the weights, interval by interval: its ends are nodes. Points
    at the nodes, on lines along the axes through corners and middles of the travel, follow with weight 0: what is largest
    anywhere is usually largest there.
    """
    nodes_mm = tuple(np.append(nodes, emphasis.ends_mm(axis)) for axis, nodes in enumerate(nodes_mm))
    sides = [_between_nodes(machine, axis, nodes, emphasis) for axis, nodes in enumerate(nodes_mm)]
    counts = [len(points) for points, _ in sides]
    every = -(-math.prod(counts) // most)
    if every > 1 and most < LEAST_IN_PLANE * max(counts):
        inner = _three_grids(machine, sides, most, emphasis)
    else:
        thinned = _lattice(counts, every)
        position_mm = np.stack([side[0][part] for side, part in zip(sides, thinned, strict=True)], axis=1)
        weight = np.prod([side[1][part] for side, part in zip(sides, thinned, strict=True)], axis=0)
        inner = VolumeSample(position_mm, weight)
    lines_mm = _lines(machine, nodes_mm)
    weight = np.concatenate([inner.weight, np.zeros(len(lines_mm))])
    return VolumeSample(np.concatenate([inner.position_mm, lines_mm]), weight * (len(weight) / weight.sum()))


def _lines(machine: Machine, nodes_mm: Sequence[FloatArray]) -> FloatArray:
    """Points (m, 3) at the nodes within the travel and its ends, on nine lines along each axis."""
    ends = [np.array([low, 0.5 * (low + high), high]) for low, high in (axis.range_mm for axis in machine.axes)]
    found = []
    for axis, nodes in enumerate(nodes_mm):
        levels = list(ends)
        levels[axis] = np.unique(np.clip(np.concatenate([nodes, ends[axis]]), *machine.axes[axis].range_mm))
        found.append(VolumeGrid((levels[0], levels[1], levels[2])).position_mm)
    return np.unique(np.concatenate(found), axis=0)


def _lattice(counts: Sequence[int], every: int) -> list[NDArray[np.int64]]:
    """Indices (m,) of the points of a grid, for its three axes, whose sum is a multiple of ``every``."""
    kept = np.indices(tuple(counts)).sum(axis=0) % every == 0
    return [np.asarray(part, dtype=np.int64) for part in np.nonzero(kept)]


def _three_grids(
    machine: Machine, sides: Sequence[tuple[FloatArray, FloatArray]], most: int, emphasis: Emphasis
) -> VolumeSample:
    """Three grids, one for each axis: its own points by a few Gauss-Legendre points of the other two.

    For tables with so many nodes that a thinned grid would leave too few points in a plane.
    """
    positions, weights = [], []
    for axis in range(3):
        count = int(np.clip(np.sqrt(most / len(sides[axis][0])), LEAST_ACROSS, MOST_ACROSS))
        parts = list(sides)
        for k in {0, 1, 2} - {axis}:  # about ``count`` points over the axis, within and outside of the work zone
            ends = np.unique([*machine.axes[k].range_mm, *emphasis.ends_mm(k)])
            points, weight = np.polynomial.legendre.leggauss(max(LEAST_ACROSS, count // (len(ends) - 1)))
            middle, half = 0.5 * (ends[1:] + ends[:-1])[:, None], 0.5 * np.diff(ends)[:, None]
            weighted = emphasis.factor(k, middle) * half * weight
            parts[k] = (middle + half * points).ravel(), weighted.ravel() / np.sum(weighted)
        grid = VolumeGrid((parts[0][0], parts[1][0], parts[2][0]))
        positions.append(grid.position_mm)
        weights.append(np.einsum("i,j,k->ijk", parts[0][1], parts[1][1], parts[2][1]).ravel())
    joined = np.concatenate(weights)
    return VolumeSample(np.concatenate(positions), joined * (len(joined) / joined.sum()))


def _between_nodes(
    machine: Machine, axis: int, nodes_mm: FloatArray, emphasis: Emphasis
) -> tuple[FloatArray, FloatArray]:
    """Two Gauss-Legendre points in each interval between nodes within the travel; their weights sum to 1.

    Few intervals are parted, because the errors are not as smooth as the tables.
    """
    low, high = machine.axes[axis].range_mm
    inside = nodes_mm[(nodes_mm > low + 1e-9) & (nodes_mm < high - 1e-9)]
    ends = np.concatenate([[low], np.unique(inside), [high]])
    parts = -(-LEAST_INTERVALS // (len(ends) - 1))
    ends = np.interp(np.arange(parts * (len(ends) - 1) + 1) / parts, np.arange(len(ends)), ends)
    middle, half = 0.5 * (ends[1:] + ends[:-1])[:, None], 0.5 * np.diff(ends)[:, None]
    weighted = emphasis.factor(axis, middle) * half * np.ones(2)
    return (middle + half * np.array([-1.0, 1.0]) / np.sqrt(3.0)).ravel(), weighted.ravel() / np.sum(weighted)
