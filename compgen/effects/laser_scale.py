"""A scale error of the lengths that all stations share: the wavelength of the laser, a wrong pressure."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.effects.base import Card, Effect, Parameter
from compgen.effects.readings import Readings


class LaserScale(Effect):
    """dl = c l."""

    def __init__(self) -> None:
        self.card = Card(
            name="laser_scale",
            title="Scale error of the lengths",
            equation="dl = c l",
            source="wavelength of the laser; Birch & Downs, Metrologia 30 (1993) 155",
            covariates=(),
            parameters=(Parameter("c_ppm", 1e-6, "scale error", 20.0),),
            aliases=("a common slope of EXX, EYY and EZZ",),
            breaker="measure a calibrated length (a ball bar, a step gauge)",
            kinds=("lengths",),
        )

    def columns(self, readings: Readings) -> FloatArray | None:
        """The range."""
        return readings.range_mm[:, None]
