"""Lost motion that varies along the stroke: worn screws, wind-up that grows with the free length."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings


class LostMotion(DisplacementEffect):
    """d_a = dir_a (c1 P1(s_a) + c2 P2(s_a)), s_a the position of the axis over its travel, -1 ... +1."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"lost_motion_{letter}",
            title=f"Lost motion of {letter} that varies along the stroke",
            equation=f"d_{letter} = dir_{letter} (c1 P1(s_{letter}) + c2 P2(s_{letter}))",
            source="ISO 230-2: reversal value at each target position, as a polynomial of the position",
            covariates=(f"approach_{letter.lower()}",),
            parameters=(
                Parameter("c1_um", MM_PER_UM, "half the reversal value that grows along the stroke, at its end", 100.0),
                Parameter(
                    "c2_um", MM_PER_UM, "half the reversal value that bends along the stroke, at its ends", 100.0
                ),
            ),
            aliases=(f"backlash_{letter}",),
            breaker="measure the whole stroke in both directions",
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """First and second Legendre polynomial, signed by the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        shape = legendre(readings.normalised(self.axis), range(1, 3))
        return along(self.axis, readings.approach[:, [self.axis]] * shape)
