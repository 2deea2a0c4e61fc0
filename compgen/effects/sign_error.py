"""A sign that the model has wrong: one of the products of an angular error acts the other way round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, error_named
from compgen.effects.angular import DEGREES, curve_parameters
from compgen.effects.base import Card, DisplacementEffect, Setting, along
from compgen.effects.polynomials import legendre
from compgen.effects.readings import Readings
from compgen.model.volumetric import Coefficient, coefficients

DEFAULT_DEGREE = 3


def flipped_product(machine: Machine, name: str) -> Coefficient | None:
    """Product of an angular error whose sign can be told from the data: the last of two with travels of other axes.

    If the error acts by one product only, its sign is the sign of the curve, and nothing can be wrong about it.
    """
    axis = error_named(name).axis
    terms = [
        term
        for term in coefficients(machine.chain, machine.squareness_reference)
        if term.error == name and term.lever is not None and term.lever < 3 and term.lever != axis
    ]
    return max(terms, key=lambda term: term.output) if len(terms) > 1 else None


class SignError(DisplacementEffect):
    """d_o = q f(p_a): the product that should have been taken the other way, f = -2 times the error's curve."""

    def __init__(self, name: str) -> None:
        self.error = error_named(name)
        axis = AXES[self.error.axis].lower()
        self.card = Card(
            name=f"sign_{name}",
            title=f"Wrong sign of {name} in one direction",
            equation=f"d_o = q f({axis}),  f = sum of p_k P_k(s_{axis.upper()}), q another axis (EBY of WFYXZT: d_Z = x f(y))",
            source="sign conventions of the volumetric model: Zha & Zhang 2024, eq. 9; errata in docs/conventions.md",
            covariates=(),
            parameters=curve_parameters(name, range(1, DEFAULT_DEGREE + 1)),
            aliases=("beam_sag",),
            breaker=f"measure more sections along {axis.upper()}",
            kinds=("lengths", "deviations"),
            settings=(Setting("degree", "degree of the curve, 1 ... 6"),),
            scan="degree",
        )

    def with_settings(self, settings: Mapping[str, float]) -> Self:
        """Return the effect with a curve of the given degree."""
        chosen = super().with_settings(settings)
        degree = int(chosen.settings.get("degree", DEFAULT_DEGREE))
        chosen.card = replace(self.card, parameters=curve_parameters(self.error.name, range(1, degree + 1)))
        return chosen

    def positions(self, readings: Readings) -> Sequence[float]:
        """Degrees of the curve."""
        return (
            () if "degree" in self.settings or flipped_product(readings.machine, self.error.name) is None else DEGREES
        )

    def used(self, readings: Readings) -> dict[str, float]:
        """The degree."""
        return {"degree": DEFAULT_DEGREE, **self.settings}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Travel of the lever axis times the polynomials, with the sign of the product; None without such a product."""
        term = flipped_product(readings.machine, self.error.name)
        if term is None or term.lever is None:
            return None
        degree = int(self.used(readings)["degree"])
        shape = legendre(readings.normalised(self.error.axis), range(1, degree + 1))
        return along(term.output, -term.sign * readings.position_mm[:, [term.lever]] * shape)
