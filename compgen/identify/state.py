"""The values of all unknowns of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.identify.parameters import ErrorParameters

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class State:
    """Current values of the unknowns: errors (size,), stations (S, 3), dead lengths (groups,); mm and rad."""

    errors: FloatArray
    stations_mm: FloatArray
    dead_length_mm: FloatArray

    def moved(self, step: FloatArray) -> State:
        """Return the state after a step (unknowns in the order errors, stations, dead lengths)."""
        first, second = len(self.errors), len(self.errors) + self.stations_mm.size
        return State(
            self.errors + step[:first],
            self.stations_mm + step[first:second].reshape(-1, 3),
            self.dead_length_mm + step[second:],
        )


class Problem(Protocol):
    """What the solver needs of a least-squares problem; the unknowns stand as in :meth:`State.moved`."""

    @property
    def parameters(self) -> ErrorParameters:
        """The unknown errors."""

    @property
    def size(self) -> int:
        """Number of unknowns."""

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its gradient (size,)."""

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size), exact or close to it."""

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, mm."""

    def weighted(self, weight: FloatArray) -> Problem:
        """Return the same problem with other weights of the readings, 1/mm^2."""
