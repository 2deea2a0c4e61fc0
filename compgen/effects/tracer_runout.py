"""Runout of a tracer's sphere or centre: lengths that depend on the azimuth of the beam."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter
from compgen.effects.readings import Readings


class TracerRunout(Effect):
    """dl = s2 sin 2a + c2 cos 2a + s3 sin 3a + c3 cos 3a, a the azimuth of the beam of one station."""

    def __init__(self, station: str) -> None:
        self.station = station
        names = tuple(f"{letter}{harmonic}" for harmonic in (2, 3) for letter in ("s", "c"))
        self.card = Card(
            name=f"tracer_runout_{station}",
            title=f"Runout of the tracer at station {station}",
            equation="dl = s2 sin 2a + c2 cos 2a + s3 sin 3a + c3 cos 3a,  a azimuth of the beam",
            source="Schwenke et al., CIRP Annals 54/1 (2005) 475; the first harmonic is a shift of the station",
            covariates=("station",),
            parameters=tuple(Parameter(f"{name}_um", MM_PER_UM, f"amplitude {name}", 5.0) for name in names),
            aliases=("smooth errors of the machine",),
            breaker="turn the head of the tracer by 180 degrees and measure again",
            kinds=("lengths",),
        )

    def columns(self, readings: Readings) -> FloatArray | None:
        """Second and third harmonic of the azimuth."""
        own = readings.is_from(self.station)
        if not own.any():
            return None
        azimuth = np.arctan2(readings.direction[:, 1], readings.direction[:, 0])
        waves = [wave(k * azimuth) for k in (2, 3) for wave in (np.sin, np.cos)]
        return np.asarray(own[:, None] * np.column_stack(waves))
