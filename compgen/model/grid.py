"""Points that fill the working volume: where tables have their nodes, and between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.emphasis import Emphasis
from compgen.core.machine import Machine

#: A full grid larger than this is replaced by a low-discrepancy sample of as many points.
MOST_POINTS = 20_000


NO_EMPHASIS = Emphasis()
#: Gauss-Legendre points across an axis of which the own levels are taken.
LEAST_ACROSS, MOST_ACROSS = 4, 12


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
    """Return points that determine tables with the given nodes over the volume: the full grid where it is not too large.

    Weighted sums over them are integrals over the volume.

    Otherwise three grids, one for each axis: its own levels by Gauss-Legendre points of the other two. On each of them
    a function of one axis is orthogonal to functions of the others, as it is over the volume; a random sample is not,
    and would turn what the tables cannot hold into ragged values.

    The weight of the work zone of ``emphasis`` is part of them, interval by interval: its ends are levels, and the
    Gauss-Legendre points fill each part between them, so that all grids agree on the mean over an axis.
    """
    nodes_mm = tuple(np.append(nodes, emphasis.ends_mm(axis)) for axis, nodes in enumerate(nodes_mm))
    levels = [
        levels_between(np.asarray(nodes), *axis.range_mm) for nodes, axis in zip(nodes_mm, machine.axes, strict=True)
    ]
    if np.prod([len(level) for level in levels]) <= most:
        x, y, z = (_simpson(level, emphasis.factor(axis, level[1::2])) for axis, level in enumerate(levels))
        position_mm = VolumeGrid((levels[0], levels[1], levels[2])).position_mm
        return VolumeSample(position_mm, len(position_mm) * np.einsum("i,j,k->ijk", x, y, z).ravel())
    positions, weights = [], []
    for axis in range(3):
        count = int(np.clip(np.sqrt(most / len(levels[axis])), LEAST_ACROSS, MOST_ACROSS))
        sides = [_gauss_legendre(machine, k, emphasis, count) for k in range(3)]
        sides[axis] = (levels[axis], _simpson(levels[axis], emphasis.factor(axis, levels[axis][1::2])))
        grid = VolumeGrid((sides[0][0], sides[1][0], sides[2][0]))
        positions.append(grid.position_mm)
        weights.append(np.einsum("i,j,k->ijk", sides[0][1], sides[1][1], sides[2][1]).ravel())
    joined = np.concatenate(weights)
    return VolumeSample(np.concatenate(positions), joined * (len(joined) / joined.sum()))


def _simpson(levels_mm: FloatArray, factor: FloatArray) -> FloatArray:
    """Weights (n,), which sum to 1, of levels where every second one is the middle of its neighbours.

    Exact for cubic polynomials between the nodes, so for squares of what tables hold there. ``factor`` weighs the
    intervals.
    """
    part = factor * np.diff(levels_mm[::2])
    part /= 6.0 * np.sum(part)
    weights = np.zeros(len(levels_mm))
    weights[1::2] = 4.0 * part
    weights[:-1:2] += part
    weights[2::2] += part
    return weights


def _gauss_legendre(machine: Machine, axis: int, emphasis: Emphasis, count: int) -> tuple[FloatArray, FloatArray]:
    """Points over an axis, about ``count`` in all, within and beside the work zone; their weights sum to 1."""
    ends = np.unique([*machine.axes[axis].range_mm, *emphasis.ends_mm(axis)])
    points, weights = np.polynomial.legendre.leggauss(max(LEAST_ACROSS, count // (len(ends) - 1)))
    middle, half = 0.5 * (ends[1:] + ends[:-1])[:, None], 0.5 * np.diff(ends)[:, None]
    weighted = emphasis.factor(axis, middle) * half * weights
    return (middle + half * points).ravel(), weighted.ravel() / np.sum(weighted)
