"""Reversal: difference of the tool position between both directions of approach (ISO 230-1, 3.5.6; ISO 230-2).

Readings of one station at one stop in both directions differ by the line of sight times the vector of each axis whose
direction of approach changed. Relative to their mean at that stop, they do not depend on the error curves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import SIGNIFICANT
from compgen.data.lengths import Lengths
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.records import approach_of
from compgen.identification.adjust.grid_problem import levels_of
from compgen.identification.adjust.robust import time_order
from compgen.identification.adjust.unknowns import IntArray

#: Cells are renumbered if there could be this many times more of them than readings.
SPARSE = 8
#: Fewer readings than this, of all stations or of one, are not evaluated.
LEAST_READINGS = 12
#: Eigenvalue of the normal matrix with unit diagonal below which a direction counts as undetermined.
ZERO = 1e-8


@dataclass(frozen=True)
class ReversalStops:
    """Readings to be compared within their stops.

    Parameters
    ----------
    cell : index of station, dead length and stop of each reading, (n,).
    difference_mm : reading minus model without reversal, (n,).
    sight : unit vectors from station to target, (n, 3).
    weight : weight of each reading (n,), zero for a rejected one.
    """

    cell: IntArray
    difference_mm: FloatArray
    sight: FloatArray
    weight: FloatArray

    def cost(self, displacement_mm: FloatArray) -> float:
        """Return the weighted square sum of the differences within the stops if the tip is displaced by (n, 3)."""
        left = self.difference_mm - np.einsum("ij,ij->i", self.sight, displacement_mm)
        return float(self.weight @ _centred(left[:, None], self.cell, self.weight)[:, 0] ** 2)


@dataclass(frozen=True)
class AxisReversal:
    """Displacement of the tool tip between positive and negative approach (positive minus negative) of one axis.

    ``vector_mm`` and its standard uncertainty ``u_mm`` have the components X, Y, Z. ``stations`` has for each station
    the mean difference of its readings and the standard uncertainty of that, mm.
    """

    vector_mm: tuple[float, float, float]
    u_mm: tuple[float, float, float]
    stations: Mapping[str, tuple[float, float]]

    @property
    def significant(self) -> bool:
        """Whether any component is far beyond its uncertainty."""
        return any(abs(value) > SIGNIFICANT * u for value, u in zip(self.vector_mm, self.u_mm, strict=True))


@dataclass(frozen=True)
class Reversal:
    """Mean reversal of each axis that was approached from both sides at the same stops.

    ``pairs`` counts the readings with another from the other side at the same station and stop. ``removed`` says
    whether the readings were corrected to the mean of both directions, so that the curves are the bidirectional means.
    """

    axes: Mapping[str, AxisReversal]
    pairs: int
    removed: bool = False

    @property
    def significant(self) -> bool:
        """Whether any axis has a significant reversal."""
        return any(axis.significant for axis in self.axes.values())

    def resolved(self, approach: FloatArray, station: IntArray, stops: ReversalStops) -> FloatArray:
        """Give unknown directions (0) the sign that fits: an axis that has not moved yet has one direction.

        ``approach`` (n, 3) and ``station`` (n,) belong to the readings of ``stops``; an axis without known directions
        remains unknown.
        """
        known = approach.copy()
        for axis in np.flatnonzero(np.any(approach != 0, axis=0)).tolist():
            unknown = approach[:, axis] == 0
            for k in np.unique(station[unknown]):
                rows = unknown & (station == k)
                known[rows, axis] = 1.0
                forward = stops.cost(self.displacement(known))
                known[rows, axis] = -1.0
                if forward <= stops.cost(self.displacement(known)):
                    known[rows, axis] = 1.0
        return known

    def displacement(self, approach: FloatArray) -> FloatArray:
        """Return the displacement of the tip from the mean of both directions for approaches (n, 3): shape (n, 3), mm."""
        vectors = np.zeros((3, 3))
        for name, axis in self.axes.items():
            vectors[AXES.index(name)] = axis.vector_mm if axis.significant else 0.0
        return np.asarray(0.5 * approach @ vectors)

    def summary(self) -> dict[str, Any]:
        """Return the object ``reversal`` of ``identify.json``."""
        axes = {
            name: {
                "vector_um": [value / MM_PER_UM for value in axis.vector_mm],
                "u_um": [value / MM_PER_UM for value in axis.u_mm],
                "significant": axis.significant,
                "stations_um": {
                    station: {"value": value / MM_PER_UM, "u": u / MM_PER_UM}
                    for station, (value, u) in axis.stations.items()
                },
            }
            for name, axis in self.axes.items()
        }
        undetermined = [name for name in AXES if name not in self.axes]
        return {"axes": axes, "undetermined": undetermined, "pairs": self.pairs, "removed": self.removed}


def approach_signs(lengths: Lengths) -> FloatArray | None:
    """Return the last direction of travel of each axis at each reading, (n, 3), +1, -1 or 0; None if unknown.

    Columns ``approach_x`` ... take precedence; with the column ``approach`` or several runs the directions follow from
    the order of the stops.
    """
    if lengths.approach is not None:
        return lengths.approach if np.any(lengths.approach) else None
    last = lengths.covariates.get("approach")
    run = lengths.labels.get("run")
    if last is None and (run is None or not np.any(run != run[0])):
        return None
    signs = np.zeros((len(lengths), 3))
    order = time_order(lengths)
    for k in range(len(lengths.stations)):
        rows = order[lengths.station[order] == k]
        moves = np.diff(lengths.position_mm[rows], axis=0, prepend=lengths.position_mm[rows[:1]])
        signs[rows] = approach_of(moves)
        if last is not None:
            stated = np.nan_to_num(last[rows])[:, None]
            signs[rows] = np.where((moves != 0) & (stated != 0), stated, signs[rows])
    return signs


def estimate_reversal(lengths: Lengths, approach: FloatArray, stops: ReversalStops) -> Reversal | None:
    """Estimate the reversal of each axis; None if no stop was approached from both sides.

    Parameters
    ----------
    lengths : the readings.
    approach : direction of each axis, (n, 3); readings with an unknown direction of a moving axis are not used.
    stops : the stops to compare.
    """
    unknown = np.any((approach == 0) & np.any(approach != 0, axis=0), axis=1)
    cell, weight = stops.cell, np.where(unknown, 0.0, stops.weight)
    design = 0.5 * approach[:, :, None] * stops.sight[:, None, :]
    columns = _centred(design.reshape(len(cell), 9), cell, weight)
    target = _centred(stops.difference_mm[:, None], cell, weight)[:, 0]
    moved = np.any(np.abs(columns) > 1e-9, axis=1) & (weight > 0)
    if np.count_nonzero(moved) < LEAST_READINGS:
        return None
    value, u, known = _solved(cell[moved], columns[moved], target[moved], weight[moved])
    # The uncertainty of a mean grows if successive residuals are correlated: for a first-order autoregressive process
    # with correlation rho by the root of (1 + rho)/(1 - rho).
    order = time_order(lengths)
    order = order[np.argsort(lengths.station[order], kind="stable")]
    series = (target - columns @ value)[order][moved[order]]
    square = float(series @ series)
    rho = min(max(float(series[1:] @ series[:-1]) / square if square > 0 else 0.0, 0.0), 0.98)
    u *= float(np.sqrt((1.0 + rho) / (1.0 - rho)))
    # mean difference of the readings of each station between the directions of each axis
    stations, along = {}, _centred(0.5 * approach, cell, weight)
    for k, station in enumerate(lengths.stations):
        rows = (lengths.station == k) & (weight > 0) & np.any(np.abs(along) > 1e-9, axis=1)
        if np.count_nonzero(rows) >= LEAST_READINGS:
            mean, u_mean, shown = _solved(cell[rows], along[rows], target[rows], weight[rows])
            stations[station] = {AXES[a]: (float(mean[a]), float(u_mean[a])) for a in range(3) if shown[a]}
    axes = {}
    for axis, name in enumerate(AXES):
        x, y, z = range(3 * axis, 3 * axis + 3)
        if known[[x, y, z]].all():
            vector, u_vector = (value[x], value[y], value[z]), (u[x], u[y], u[z])
            means = {station: found[name] for station, found in stations.items() if name in found}
            axes[name] = AxisReversal(_floats(vector), _floats(u_vector), means)
    return Reversal(axes, int(np.count_nonzero(moved))) if axes else None


def _floats(vector: tuple[Any, Any, Any]) -> tuple[float, float, float]:
    x, y, z = vector
    return float(x), float(y), float(z)


def stop_cells(lengths: Lengths, group: IntArray) -> IntArray:
    """Index of station, dead length and stop (position and tool) of each reading."""
    columns = [*lengths.position_mm.T, *(() if lengths.tool_mm is None else lengths.tool_mm.T)]
    cell, count = group, int(group.max()) + 1
    for column in columns:
        levels, level = levels_of(column)
        cell, count = cell * len(levels) + level, count * len(levels)
        if count > SPARSE * len(cell):
            present, cell = np.unique(cell, return_inverse=True)
            count = len(present)
    return cell.ravel().astype(np.int64)


def _centred(columns: FloatArray, cell: IntArray, weight: FloatArray) -> FloatArray:
    """Subtract the weighted mean of each cell from columns (n, k)."""
    total = np.bincount(cell, weight)
    total[total == 0] = 1.0
    centred = np.empty_like(columns)
    for k in range(columns.shape[1]):
        centred[:, k] = columns[:, k] - (np.bincount(cell, weight * columns[:, k]) / total)[cell]
    return centred


def _solved(
    cell: IntArray, columns: FloatArray, target: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Weighted least squares: values, standard uncertainties from the residuals, and which are determined."""
    matrix = columns.T @ (columns * weight[:, None])
    diagonal = np.diag(matrix)
    present = diagonal > ZERO * max(float(diagonal.max()), 1e-300)
    scale = np.where(present, 1.0 / np.sqrt(np.where(present, diagonal, 1.0)), 0.0)
    eigenvalues, vectors = np.linalg.eigh(matrix * scale * scale[:, None] + np.diag((~present).astype(float)))
    kept = eigenvalues > ZERO
    known = present & (np.abs(vectors[:, ~kept]).max(axis=1, initial=0.0) < 1e-3)
    inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T * scale * scale[:, None]
    value = inverse @ (columns.T @ (weight * target))
    left = target - columns @ value
    freedom = len(target) - int(np.count_nonzero(np.bincount(cell))) - int(np.count_nonzero(kept & (eigenvalues > 0)))
    variance = float(weight @ left**2) / max(freedom, 1)
    return value, np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance), known
