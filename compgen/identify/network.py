"""Tracers and points as a network of distances: its normal equations with the points eliminated one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import UndeterminedError
from compgen.identify.state import IntArray


@dataclass(frozen=True)
class Sightings:
    """n readings of S stations (with G dead lengths) to m points; every point has a reading.

    ``point``, ``station``, ``group`` (dead length) are indices (n,), ``length_mm`` and ``sigma_mm`` (n,) the reading
    and its standard uncertainty.
    """

    point: IntArray
    station: IntArray
    group: IntArray
    length_mm: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class Frame:
    """Stations (S, 3), dead lengths (G,) and points (m, 3) in one frame, mm."""

    stations_mm: FloatArray
    dead_length_mm: FloatArray
    points_mm: FloatArray

    def moved(self, rotation: FloatArray, translation_mm: FloatArray) -> Frame:
        """Return the same after x -> R x + t."""
        return Frame(
            self.stations_mm @ rotation.T + translation_mm,
            self.dead_length_mm,
            self.points_mm @ rotation.T + translation_mm,
        )


@dataclass(frozen=True)
class Network:
    """Sightings in the order of their points, the first reading of each point (m,), and the free unknowns (q,)."""

    sightings: Sightings
    first: IntArray
    free: IntArray


@dataclass(frozen=True)
class Linear:
    """Readings linearised at a frame: residuals, cost, and the normal equations with the points split off.

    Parameters
    ----------
    residual_mm, cost : model minus reading (n,), and half the weighted sum of squares.
    information, coupling, station_matrix : blocks of points (m, 3, 3), points by stations (m, 3, q), stations (q, q).
    reduced : stations with the points eliminated, (q, q).
    point_gradient, station_gradient : (m, 3) and (q,).
    """

    residual_mm: FloatArray
    cost: float
    information: FloatArray
    coupling: FloatArray
    station_matrix: FloatArray
    reduced: FloatArray
    point_gradient: FloatArray
    station_gradient: FloatArray


def residuals(data: Network, frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Model minus reading (n,) and unit lines of sight (n, 3)."""
    seen = data.sightings
    sight = frame.points_mm[seen.point] - frame.stations_mm[seen.station]
    distance = np.sqrt(np.einsum("ij,ij->i", sight, sight))
    return distance - frame.dead_length_mm[seen.group] - seen.length_mm, sight / distance[:, None]


def cost(data: Network, frame: Frame) -> float:
    """Half the weighted sum of squares."""
    residual, _ = residuals(data, frame)
    return 0.5 * float(np.sum((residual / data.sightings.sigma_mm) ** 2))


def linearise(data: Network, frame: Frame) -> Linear:
    """Normal equations at a frame; ``reduced`` is the Schur complement of the points."""
    seen = data.sightings
    residual, unit = residuals(data, frame)
    weight = 1.0 / seen.sigma_mm**2
    points, columns = len(frame.points_mm), frame.stations_mm.size + len(frame.dead_length_mm)
    outer = weight[:, None, None] * unit[:, :, None] * unit[:, None, :]
    information = np.add.reduceat(outer, data.first, axis=0)
    pulled = (weight * residual)[:, None] * unit
    own = 3 * seen.station[:, None] + np.arange(3)
    dead = frame.stations_mm.size + seen.group
    coupling = _scatter(seen.point, own, outer, points, columns)
    coupling += _scatter(seen.point, dead[:, None], weight[:, None, None] * unit[:, :, None], points, columns)
    station_matrix = _station_matrix(own, dead, outer, weight[:, None] * unit, columns)
    gradient = np.zeros(columns)
    gradient -= np.bincount(own.ravel(), pulled.ravel(), columns)
    gradient -= np.bincount(dead, weight * residual, columns)
    free = data.free
    coupling, station_matrix = -coupling[:, :, free], station_matrix[np.ix_(free, free)]
    flat = coupling.reshape(-1, len(free))
    reduced = station_matrix - flat.T @ solved(information, coupling).reshape(-1, len(free))
    return Linear(
        residual_mm=residual,
        cost=0.5 * float(np.dot(weight, residual**2)),
        information=information,
        coupling=coupling,
        station_matrix=station_matrix,
        reduced=0.5 * (reduced + reduced.T),
        point_gradient=np.add.reduceat(pulled, data.first, axis=0),
        station_gradient=gradient[free],
    )


def _station_matrix(
    own: IntArray, dead: IntArray, outer: FloatArray, weighted_unit: FloatArray, columns: int
) -> FloatArray:
    """Block of stations and dead lengths: columns ``own`` (n, 3) and ``dead`` (n,) of each reading."""
    matrix = np.zeros((columns, columns))
    np.add.at(matrix, (own[:, :, None], own[:, None, :]), outer)
    cross = np.zeros((columns, columns))
    np.add.at(cross, (own, dead[:, None]), weighted_unit)
    matrix += cross + cross.T
    weight = np.einsum("nii->n", outer)  # u is a unit vector
    matrix[np.diag_indices(columns)] += np.bincount(dead, weight, columns)
    return matrix


def _scatter(point: IntArray, column: IntArray, values: FloatArray, points: int, columns: int) -> FloatArray:
    """Sum values (n, 3, k) into (points, 3, columns) at point (n,) and column (n, k)."""
    index = (point[:, None, None] * 3 + np.arange(3)[:, None]) * columns + column[:, None, :]
    summed = np.bincount(index.ravel(), values.ravel(), points * 3 * columns)
    return np.asarray(summed, dtype=np.float64).reshape(points, 3, columns)


def solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for every point: information (m, 3, 3), right side (m, 3, k); UndeterminedError for a singular point."""
    try:
        return np.asarray(np.linalg.solve(information, right))
    except np.linalg.LinAlgError:
        raise UndeterminedError(
            "a point lies in line with its stations, or they stand on one line; it cannot be located", []
        ) from None
