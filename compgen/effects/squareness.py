"""A squareness error that the machine's model leaves out."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.core.names import ERROR_INDEX, RAD_PER_URAD
from compgen.effects.base import Card, DisplacementEffect, Parameter
from compgen.effects.readings import Readings
from compgen.model.observability import modelled_errors
from compgen.model.volumetric import c_matrix


class Squareness(DisplacementEffect):
    """d = c times the column of C of the squareness error."""

    def __init__(self, short: str) -> None:
        self.error = f"E{short}"
        self.card = Card(
            name=f"squareness_{short}",
            title=f"Squareness {self.error}, which the model leaves out",
            equation={"C0Y": "d_X = -c y", "B0Z": "d_X = c z", "A0Z": "d_Y = -c z"}[short],
            source="ISO 230-1; docs/conventions.md",
            covariates=(),
            parameters=(Parameter("c_urad", RAD_PER_URAD, "squareness error", 1000.0),),
            aliases=("straightness slopes", "rotation of the workpiece frame"),
            breaker="let the machine file's errors contain it",
            kinds=("lengths", "deviations"),
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Column of C; None where the base model contains the error."""
        if self.error in modelled_errors(readings.machine):
            return None
        column = c_matrix(readings.machine, readings.position_mm, readings.tool_mm)[:, :, ERROR_INDEX[self.error]]
        return column[:, :, None]
