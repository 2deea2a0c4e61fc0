"""Backlash: an axis stays behind by half its play, to the other side after each reversal."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.readings import Readings


class Backlash(DisplacementEffect):
    """d_a = c dir_a; the reversal error of ISO 230-2 is 2 c."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"backlash_{letter}",
            title=f"Backlash of {letter}",
            equation=f"d_{letter} = c dir_{letter}",
            source="ISO 230-2 (reversal value B = 2 c)",
            covariates=(f"approach_{letter.lower()}",),
            parameters=(Parameter("c_um", MM_PER_UM, "half the reversal value", 100.0),),
            aliases=(f"servo_lag_{letter}", f"lost_motion_{letter}"),
            breaker="measure every line in both directions at two feeds",
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit displacement along the axis, signed by the last direction of travel."""
        if readings.approach is None or not np.any(readings.approach[:, self.axis]):
            return None
        return along(self.axis, readings.approach[:, self.axis])
