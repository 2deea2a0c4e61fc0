"""Errors of a machine with what is known of their uncertainty, as a source of fields at any points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from compgen.accuracy.field import Field, Spread, axis_lines, unknown_spread
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, SQUARENESS_NAMES, error_named
from compgen.core.points import Points
from compgen.identify.covariance import Covariance
from compgen.model.basis import hat_matrix
from compgen.model.exact import exact_error
from compgen.model.volumetric import c_matrix, tool_of, volumetric_error

#: What tables of a control add to the command at points, (n, 3), mm.
Correction = Callable[[Points], FloatArray]


@dataclass(frozen=True)
class ErrorSource:
    """Errors of a machine; ``factor`` (k, r) has F F^T as the covariance of the k values in the order of the table.

    ``factor`` is None where the uncertainty is not known. ``correction`` is what active tables add: the field is then that
    of the machine with them. ``exact`` moves the exact model, for fields that are compared with measured ones; a correction
    always does.
    """

    machine: Machine
    errors: ErrorTable
    factor: FloatArray | None = None
    correction: Correction | None = None
    exact: bool = False

    @property
    def known(self) -> bool:
        """Whether the uncertainty is known."""
        return self.factor is not None

    def field(self, position_mm: FloatArray) -> Field:
        """Return the errors of the tip at positions (n, 3) with the machine's tool; uncertainties to first order."""
        points = Points(position_mm)
        tool = tool_of(self.machine, None)
        if self.correction is None:
            model = exact_error if self.exact else volumetric_error
            error = model(self.machine, self.errors, position_mm)
        else:  # looked up at the commanded position, as controls do
            added = self.correction(points)
            error = exact_error(self.machine, self.errors, position_mm + added) + added
        return Field(position_mm, position_mm + tool, error, self._spread(position_mm))

    def _spread(self, position_mm: FloatArray) -> Spread:
        if self.factor is None:
            return unknown_spread

        def spread(weight: FloatArray) -> float:
            used = np.any(weight != 0.0, axis=1)
            return self.u_of(self._gradient(position_mm[used], weight[used]))

        return spread

    def _gradient(self, position_mm: FloatArray, weight: FloatArray) -> FloatArray:
        """Derivative (k,) of sum(weight * E) over points by the values of the table; E = C P is linear in them."""
        through = np.einsum("nij,ni->nj", c_matrix(self.machine, position_mm), weight)
        parts = []
        for name in self.errors.names:
            column = through[:, ERROR_INDEX[name]]
            if name in SQUARENESS_NAMES:
                parts.append(np.array([column.sum()]))
            else:
                nodes = self.errors.curves[name].position_mm
                parts.append(column @ hat_matrix(nodes, position_mm[:, error_named(name).axis]))
        return np.concatenate(parts)

    def value_gradient(self, name: str, weight: FloatArray) -> FloatArray:
        """Derivative (k,) of sum(weight * values of one error)."""
        parts = []
        for other in self.errors.names:
            count = 1 if other in self.errors.squareness else len(self.errors.curves[other].value)
            parts.append(np.asarray(weight) if other == name else np.zeros(count))
        return np.concatenate(parts)

    def u_of(self, gradient: FloatArray) -> float:
        """Standard uncertainty of a functional of the values with derivative (k,); nan if it is not known."""
        if self.factor is None:
            return math.nan
        return float(np.linalg.norm(gradient @ self.factor))


def error_source(
    machine: Machine, errors: ErrorTable, covariance: Covariance | None = None, correction: Correction | None = None
) -> ErrorSource:
    """Return a source; without a covariance the values of the table count as independent with their own uncertainties.

    The uncertainty is known only if every value has one.
    """
    if covariance is not None:
        return ErrorSource(machine, errors, covariance.errors_factor, correction)
    u = np.concatenate([_u_values(errors, name) for name in errors.names])
    return ErrorSource(machine, errors, None if np.isnan(u).any() else np.diag(u), correction)


def _u_values(errors: ErrorTable, name: str) -> FloatArray:
    return np.array([errors.squareness[name][1]]) if name in errors.squareness else errors.curves[name].u


def grid_points(machine: Machine, levels_mm: tuple[FloatArray, ...]) -> FloatArray:
    """Points (n, 3) of a full grid, with the points that the alignment to the axes needs added where they are missing."""
    grid = np.stack(np.meshgrid(*levels_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    extra = [p for p in axis_lines(machine) if np.max(np.abs(grid - p), axis=1).min() > 1e-6]
    return np.concatenate([grid, np.array(extra)]) if extra else grid
