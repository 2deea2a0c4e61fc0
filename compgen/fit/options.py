"""What a user may ask of the fit: smoothness and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from compgen.core.names import CURVE_NAMES, error_named
from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.fit.bounds import Bounds

KINDS = ("linear", "angular")
DIRECTIONS = {"increasing": 1, "decreasing": -1}
_PER_M = 1e-3  # one per metre in one per mm


@dataclass(frozen=True)
class FitOptions:
    """Smoothness and bounds of the fit; everything may be left out.

    Parameters
    ----------
    smoothness : dimensionless weight mu of the squared second differences in
        ``sum((u0/u)^2 (c - y)^2) + mu |D2 c|^2``, with ``u0`` the harmonic root mean square of the uncertainties u
        (all weights 1 where u is not known) and D2 the second difference over nodes at their mean spacing h. On even
        nodes a wave of length L keeps the fraction ``1/(1 + mu (2 sin(pi h/L))^4)``: 0 keeps the data, 1 halves waves
        of 6 nodes, 100 of 20 nodes, and mu much above (number of nodes/pi)^4 leaves a straight line (larger ones than
        that needs are taken as if they were that). None: chosen from the data.
    max_abs : largest magnitude of a fitted curve in mm or rad, by error name or by ``"linear"``, ``"angular"``; the
        name goes before the kind.
    max_slope : largest magnitude of its slope in mm/mm or rad/mm, likewise.
    max_curvature : largest magnitude of its second derivative at the inner nodes (difference of the slopes beside a node
        over half the distance between its neighbours) in mm/mm^2 or rad/mm^2, likewise.
    monotone : ``"increasing"`` or ``"decreasing"`` by error name. A straightness is zero at both ends and cannot be.
    robust : Huber's loss instead of squares, for data with outliers: a node pulls at most as if it were off by 1.345 of
        its uncertainty. Where uncertainties are not known, their scale comes from the residuals.

    Raises
    ------
    InputError
        for a negative smoothness, a bound that is not positive, an unknown name.
    """

    smoothness: float | None = None
    max_abs: Mapping[str, float] = field(default_factory=dict)
    max_slope: Mapping[str, float] = field(default_factory=dict)
    max_curvature: Mapping[str, float] = field(default_factory=dict)
    monotone: Mapping[str, str] = field(default_factory=dict)
    robust: bool = False

    def __post_init__(self) -> None:
        if self.smoothness is not None and not (math.isfinite(self.smoothness) and self.smoothness >= 0):
            message = (
                f"{self.smoothness!r} is not allowed; give a number >= 0, or leave it out to take it from the data"
            )
            raise InputError(message, field="smoothness")
        for bound in ("max_abs", "max_slope", "max_curvature"):
            for key, limit in getattr(self, bound).items():
                _check_limit(bound, key, limit)
        for key, direction in self.monotone.items():
            _check_direction(key, direction)

    @classmethod
    def from_file_units(
        cls,
        smoothness: float | None = None,
        max_abs_um_urad: Mapping[str, float] | None = None,
        max_slope_um_m_urad_m: Mapping[str, float] | None = None,
        max_curvature_um_m2_urad_m2: Mapping[str, float] | None = None,
        monotone: Mapping[str, str] | None = None,
        *,
        robust: bool = False,
    ) -> FitOptions:
        """Build the options from um and urad, um/m and urad/m, um/m^2 and urad/m^2.

        >>> FitOptions.from_file_units(max_abs_um_urad={"EXX": 20.0}).max_abs
        {'EXX': 0.02}
        """
        slopes, bends = max_slope_um_m_urad_m or {}, max_curvature_um_m2_urad_m2 or {}
        return cls(
            smoothness,
            {key: limit * _unit("max_abs", key) for key, limit in (max_abs_um_urad or {}).items()},
            {key: limit * _unit("max_slope", key) * _PER_M for key, limit in slopes.items()},
            {key: limit * _unit("max_curvature", key) * _PER_M**2 for key, limit in bends.items()},
            dict(monotone or {}),
            robust,
        )

    def limits(self, name: str) -> tuple[float, float]:
        """Return the bounds (magnitude, slope) of one curve in mm or rad and per mm, inf where there is none."""
        bounds = self.bounds(name)
        return bounds.max_abs, bounds.max_slope

    def bounds(self, name: str) -> Bounds:
        """Return all bounds of one curve, in mm or rad."""
        kind = error_named(name).kind
        magnitude, slope, bend = (
            limits.get(name, limits.get(kind, math.inf))
            for limits in (self.max_abs, self.max_slope, self.max_curvature)
        )
        return Bounds(magnitude, slope, bend, DIRECTIONS.get(self.monotone.get(name, ""), 0))


def _unit(bound: str, key: str) -> float:
    _check_key(bound, key)
    name = key if key in CURVE_NAMES else {"linear": "EXX", "angular": "EAX"}[key]
    return error_named(name).si_per_unit


def _check_key(bound: str, key: str) -> None:
    if key not in CURVE_NAMES and key not in KINDS:
        known = (*KINDS, *CURVE_NAMES)
        raise InputError(f"{key!r} is neither a curve nor a kind of error; {nearest(key, known)}", field=bound)


def _check_limit(bound: str, key: str, limit: float) -> None:
    _check_key(bound, key)
    if not limit > 0:
        message = f"{limit!r} for {key} leaves no curve; a bound is a positive number, leave it out for none"
        raise InputError(message, field=bound)


def _check_direction(key: str, direction: str) -> None:
    if key not in CURVE_NAMES:
        raise InputError(f"{key!r} is not one of the curves; {nearest(key, CURVE_NAMES)}", field="monotone")
    if direction not in DIRECTIONS:
        raise InputError(
            f"{direction!r} for {key} is not allowed; give one of {', '.join(DIRECTIONS)}", field="monotone"
        )
