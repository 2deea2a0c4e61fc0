"""Angular errors that the model of one tool leaves out: they show with a second tool offset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, ERROR_INDEX, error_named
from compgen.effects.angular import DEGREES, curve_parameters
from compgen.effects.base import Card, DisplacementEffect, Setting
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings
from compgen.model.observability import modelled_errors
from compgen.model.volumetric import c_matrix

DEFAULT_DEGREE = 3


class Lever(DisplacementEffect):
    """d = theta(p_a) e x lever, lever from the first-order model of the chain, theta a polynomial of degree k."""

    def __init__(self, name: str) -> None:
        self.error = error_named(name)
        axis = AXES[self.error.axis]
        self.card = Card(
            name=f"lever_{name}",
            title=f"{name}, which only a tool offset shows",
            equation=f"d = theta({axis.lower()}) e x lever,  theta = sum of p_k P_k(s_{axis}) up to the degree",
            source="ISO 230-1; column of C of Zha & Zhang 2024, eq. 9, with a tool offset",
            covariates=("tool_x_mm", "tool_y_mm", "tool_z_mm"),
            parameters=curve_parameters(name, range(DEFAULT_DEGREE + 1)),
            aliases=tuple(f"lever_{other}" for other in ("ECX", "EAZ", "EBZ", "ECZ") if other != name)
            + ("tool_offset_error",),
            breaker="measure with three or more tool offsets that do not lie in one plane",
            kinds=("lengths", "deviations"),
            settings=(Setting("degree", "degree of the curve, 1 ... 6"),),
            scan="degree",
        )

    def with_settings(self, settings: Mapping[str, float]) -> Self:
        """Return the effect with a curve of the given degree."""
        chosen = super().with_settings(settings)
        degree = int(chosen.settings.get("degree", DEFAULT_DEGREE))
        chosen.card = replace(self.card, parameters=curve_parameters(self.error.name, range(degree + 1)))
        return chosen

    def positions(self, readings: Readings) -> Sequence[float]:
        """Degrees of the curve."""
        return () if "degree" in self.settings or not self._shows(readings) else DEGREES

    def _shows(self, readings: Readings) -> bool:
        """Whether the machine's model leaves the error out, and tools of different offset were used."""
        spread = np.ptp(readings.tool_mm, axis=0).max(initial=0.0)
        return bool(spread > 1e-6) and self.error.name not in modelled_errors(readings.machine)

    def used(self, readings: Readings) -> dict[str, float]:
        """The degree."""
        return {"degree": DEFAULT_DEGREE, **self.settings}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Column of C times the polynomials; with a fixed degree also for one tool, as a machine file may ask."""
        if "degree" not in self.settings and not self._shows(readings):
            return None
        degree = int(self.used(readings)["degree"])
        arm = c_matrix(readings.machine, readings.position_mm, readings.tool_mm)[:, :, ERROR_INDEX[self.error.name]]
        shape = legendre(readings.normalised(self.error.axis), range(degree + 1))
        return np.asarray(arm[:, :, None] * shape[:, None, :])
