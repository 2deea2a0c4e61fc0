"""Sag of a gantry's beam under its carriage, different along the bed."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings

X, Y, Z = 0, 1, 2


class BeamSag(DisplacementEffect):
    """d_Z = sum of c_ij P_i(s_X) P_j(s_Y), i, j = 1, 2."""

    def __init__(self) -> None:
        self.card = Card(
            name="beam_sag",
            title="Sag of the beam",
            equation="d_Z = sum of c_ij P_i(s_X) P_j(s_Y),  i, j = 1, 2",
            source="deflection of a beam under a travelling load, second order; Schwenke et al., CIRP Annals 57/2 (2008) 660",
            covariates=(),
            parameters=tuple(
                Parameter(f"c{i}{j}_um", MM_PER_UM, f"sag that goes as P{i} along X and P{j} along Y", 100.0)
                for i in (1, 2)
                for j in (1, 2)
            ),
            aliases=("sign_EBY",),
            breaker="measure more sections along Y",
            kinds=("lengths", "deviations"),
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Products of first and second Legendre polynomials."""
        across, along_bed = (legendre(readings.normalised(axis), range(1, 3)) for axis in (X, Y))
        products = across[:, :, None] * along_bed[:, None, :]
        return along(Z, np.asarray(products.reshape(len(readings), 4)))
