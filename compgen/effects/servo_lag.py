"""Servo lag: the axis follows its command a time behind it, by more the faster it moves."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.motion import velocity_mm_s
from compgen.effects.readings import Readings


class ServoLag(DisplacementEffect):
    """d_a = tau v_a, v_a the velocity on the way to the reading."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"servo_lag_{letter}",
            title=f"Servo lag of {letter}",
            equation=f"d_{letter} = tau v_{letter},  v = feed times the direction of motion",
            source="velocity error of a position loop; ISO 230-4 (contouring)",
            covariates=("feed_mm_min", f"approach_{letter.lower()}"),
            parameters=(Parameter("tau_ms", 1e-3, "time by which the axis leads (negative: lags) its command", 5.0),),
            aliases=(f"backlash_{letter}",),
            breaker="measure every line once more at another feed, or dwell before each reading",
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Velocity along the axis in mm/s."""
        velocity = velocity_mm_s(readings)
        if velocity is None or not np.any(velocity[:, self.axis]):
            return None
        return along(self.axis, velocity[:, self.axis])
