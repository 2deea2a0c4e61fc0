"""Deflection of the table or bed under the mass of the workpiece."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, along
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings

X, Y, Z = 0, 1, 2


class LoadDeflection(DisplacementEffect):
    """d_Z = m (c0 + c1 P2(s_X) + c2 P2(s_Y))."""

    def __init__(self) -> None:
        shapes = (("c0", "everywhere alike"), ("c1", "that bends along X"), ("c2", "that bends along Y"))
        self.card = Card(
            name="load_deflection",
            title="Deflection under load",
            equation="d_Z = load (c0 + c1 P2(s_X) + c2 P2(s_Y))",
            source="elastic compliance of table and bed, second order in the position",
            covariates=("load_kg",),
            parameters=tuple(Parameter(f"{n}_um_per_kg", MM_PER_UM, f"deflection {what}", 2.0) for n, what in shapes),
            aliases=("tool_offset_error", "station_drift"),
            breaker="two loads, changed to and fro between the lines, not once at the end",
            kinds=("lengths", "deviations"),
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Load times 1 and second Legendre polynomials along X and Y; None where the load is not known or never there."""
        load = readings.covariate("load_kg")
        if load is None or not np.any(load):
            return None
        bend = [legendre(readings.normalised(axis), range(2, 3))[:, 0] for axis in (X, Y)]
        return along(Z, load[:, None] * np.column_stack([np.ones(len(readings)), *bend]))
