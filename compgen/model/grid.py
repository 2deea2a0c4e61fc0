"""Points that fill the working volume: where tables have their nodes, and between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine

#: A full grid larger than this is replaced by a low-discrepancy sample of as many points.
MOST_POINTS = 20_000


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


def volume_sample(machine: Machine, nodes_mm: tuple[FloatArray, ...], most: int = MOST_POINTS) -> FloatArray:
    """Return points (n, 3) that determine tables with the given nodes: the full grid, or a seeded Sobol sample."""
    levels = [
        levels_between(np.asarray(nodes), *axis.range_mm) for nodes, axis in zip(nodes_mm, machine.axes, strict=True)
    ]
    if np.prod([len(level) for level in levels]) <= most:
        return VolumeGrid((levels[0], levels[1], levels[2])).position_mm
    from scipy.stats import qmc  # imported here: it takes a quarter of a second, and few machines need it

    unit = qmc.Sobol(3, seed=1).random_base2(int(np.floor(np.log2(most))))
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return machine.lower_mm + np.vstack([unit, corners]) * (machine.upper_mm - machine.lower_mm)
