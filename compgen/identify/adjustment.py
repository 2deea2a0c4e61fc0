"""What an identification leaves behind for later: the optimum, its factor, and the joint covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from compgen.core.csvio import FloatArray
from compgen.identify.solver import Factor
from compgen.identify.state import IntArray, State


@dataclass(frozen=True)
class Adjustment:
    """The optimum of a weighted least-squares problem of n readings.

    Parameters
    ----------
    state : the unknowns at the optimum.
    factor : of the normal matrix J^T W J there.
    weight : dimensionless weight of each reading (n,), zero for a rejected one.
    group : index of the dead length of each reading, (n,).
    sigma_mm : standard uncertainty of a reading of weight 1, so that the covariance is sigma^2 (J^T W J)^-1.
    held_weight : weight of unknowns that were known beforehand, (size,), part of the normal matrix; None without any.
    """

    state: State
    factor: Factor
    weight: FloatArray
    group: IntArray
    sigma_mm: float
    held_weight: FloatArray | None = None

    @cached_property
    def _root(self) -> FloatArray:
        root = self.factor.inverse_root()
        root *= self.sigma_mm
        return root

    def covariance_factor(self) -> FloatArray:
        """Upper triangular F (size, size) with F F^T the covariance of all unknowns, mm and rad."""
        return self._root
