"""Droop of a ram that leans out further along Z, different along Y."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings

Y, Z = 1, 2


class RamDroop(DisplacementEffect):
    """d_Y = P2(s_Z) (c1 P1(s_Y) + c2 P2(s_Y))."""

    def __init__(self) -> None:
        self.card = Card(
            name="ram_droop",
            title="Droop of the ram",
            equation="d_Y = P2(s_Z) (c1 P1(s_Y) + c2 P2(s_Y))",
            source="deflection of a cantilever of variable length; Schwenke et al., CIRP Annals 57/2 (2008) 660",
            covariates=(),
            parameters=(
                Parameter("c1_um", MM_PER_UM, "droop that grows along Y", 100.0),
                Parameter("c2_um", MM_PER_UM, "droop that bends along Y", 100.0),
            ),
            aliases=("EYZ (the part that Y leaves alone)", "EAY (the part linear in z)"),
            breaker="measure more heights of Z at several places of Y",
            kinds=("lengths", "deviations"),
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Second Legendre polynomial along Z times first and second along Y."""
        height = legendre(readings.normalised(Z), range(2, 3))
        return along(Y, height * legendre(readings.normalised(Y), range(1, 3)))
