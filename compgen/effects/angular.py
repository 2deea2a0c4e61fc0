"""What effects that are angular error curves have in common: parameters and degrees."""

from __future__ import annotations

from collections.abc import Sequence

from compgen.core.names import AXES, CURVE_NAMES, RAD_PER_URAD, error_named
from compgen.effects.base import Parameter

#: The nine angular errors.
ANGULAR_NAMES = tuple(name for name in CURVE_NAMES if error_named(name).kind == "angular")
#: Degrees of the curve that are tried.
DEGREES = tuple(float(degree) for degree in range(1, 7))


def curve_parameters(name: str, degrees: Sequence[int]) -> tuple[Parameter, ...]:
    """Parameters of a curve of an angular error as Legendre polynomials."""
    axis = AXES[error_named(name).axis]
    return tuple(
        Parameter(f"p{k}_urad", RAD_PER_URAD, f"part of {name} that goes as P{k} along {axis}", 200.0) for k in degrees
    )
