"""A target whose reflection depends on the angle at which the beam comes in."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter
from compgen.effects.readings import Readings


class TargetAngle(Effect):
    """dl = c1 u_z^2 + c2 u_z^3, u_z the component of the beam along the axis of the target."""

    def __init__(self) -> None:
        self.card = Card(
            name="target_angle",
            title="Target that depends on the angle of the beam",
            equation="dl = c1 u_z^2 + c2 u_z^3,  u from the station to the target",
            source="cat's eye and corner cube off their axis: series of the angle, second and third order",
            covariates=(),
            parameters=(
                Parameter("c1_um", MM_PER_UM, "second order", 20.0),
                Parameter("c2_um", MM_PER_UM, "third order", 20.0),
            ),
            aliases=("smooth errors of the machine", "places of the stations"),
            breaker="turn the target and measure again",
            kinds=("lengths",),
        )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Square and cube of the vertical component of the beam."""
        vertical = readings.direction[:, 2]
        return np.column_stack([vertical**2, vertical**3])
