"""Cosine error: a scale or a beam that leans against the axis measures too long a way."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.readings import Readings


class CosineError(DisplacementEffect):
    """d_a = -p_a theta^2 / 2; the parameter is c = theta^2 / 2."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"cosine_error_{letter}",
            title=f"Cosine error of {letter}",
            equation=f"d_{letter} = -c {letter.lower()},  c = theta^2 / 2",
            source="second order of the cosine of a small angle; ISO 230-6",
            covariates=(),
            parameters=(Parameter("c_ppm", 1e-6, "half the square of the angle: 50 ppm for 10 mrad", 100.0),),
            aliases=(f"E{letter}{letter} (its slope)", "laser_scale"),
            breaker="check the alignment of the scale",
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Minus the position."""
        return along(self.axis, -readings.position_mm[:, self.axis])
