"""Diagnosis of one measurement up to the chosen set of effects, with lack of fit and homogeneity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtrc, ndtri

from compgen.data.csv_files import FloatArray
from compgen.diagnose.base_fit import BaseFit, least_norm, legendre, orthonormal
from compgen.diagnose.groups import (
    Group,
    Wider,
    base_groups,
    covariates_of,
    generic_groups,
    named_groups,
    widened,
    wider_of,
)
from compgen.diagnose.layout import MeasurementLayout
from compgen.diagnose.noise_model import Noise, has_repeats, noise_of, run_ratio, whitener
from compgen.diagnose.search import (
    Chosen,
    Design,
    Rules,
    design_of,
    gain_of,
    gains,
    remainder_of,
    rules_of,
    search,
)

# Support for and against a set of groups: lack of fit, what remains, changes from run to run, homogeneity.


#: Limits: standard normal deviate of the lack of fit, likelihood ratio of the runs, p-value of the homogeneity test.
LACK_OF_FIT_Z = 3.0
RUN_RATIO = 12.0
HOMOGENEITY_P = 2e-3
#: Least likelihood ratio (2 log) of the best remaining generic group, in units of the criterion above its handicap.
DIRECTED, DIRECTED_SLOW = 20.0, 26.0


@dataclass(frozen=True)
class Remaining:
    """A remaining generic group with its likelihood ratio (2 log, without handicap)."""

    group: int
    log_ratio: float


@dataclass(frozen=True)
class Support:
    """Support of a set of groups by the readings.

    Parameters
    ----------
    lack_of_fit_z : deviate of the global lack of fit against pure error; nan without repeats.
    directed : remaining generic groups, best first.
    run_ratio : likelihood ratio of the changes from run to run.
    homogeneity_p : p-value of each named member, keyed by group.
    uneven : chi-square explained by the unevenness of each named member, keyed by group.
    chi2 : drop-one chi-square of each member, keyed by group.
    excess : residual sum of squares above its expected value.
    """

    lack_of_fit_z: float
    directed: tuple[Remaining, ...]
    run_ratio: float
    homogeneity_p: dict[int, float]
    uneven: dict[int, float]
    chi2: dict[int, float]
    excess: float

    @property
    def misfits(self) -> bool:
        """Whether the residuals after fitting the set exceed what the noise explains."""
        return bool(self.lack_of_fit_z > LACK_OF_FIT_Z) or bool(self.directed)

    @property
    def changes_between_runs(self) -> bool:
        """Whether repeats of a line differ by more than the noise within a repeat."""
        return self.run_ratio > RUN_RATIO


def support_of(design: Design, chosen: Chosen, noise: Noise, ratio: float, layout: MeasurementLayout) -> Support:
    """Collect the support for a chosen set."""
    size = len(design.coordinates(chosen.members))
    left = design.total - chosen.chi2
    named = [g for g in chosen.members if design.groups[g].tier == "named"]
    chi2 = {g: gain_of(design, [m for m in chosen.members if m != g], g) for g in chosen.members}
    even = {g: homogeneity(design, chosen, g, layout) for g in named}
    # deviate of the F-test of the residuals after the set against the pure error of the repeats
    freedom, z = design.freedom - size, float("nan")
    if 0 < noise.freedom < freedom:
        error = noise.quadratic / noise.freedom
        f_ratio = (left - noise.quadratic) / (freedom - noise.freedom) / error
        p = float(fdtrc(freedom - noise.freedom, noise.freedom, f_ratio)) if f_ratio > 0 else 1.0
        z = -10.0 if f_ratio <= 0 else float(-ndtri(p)) if p > 0 else 40.0
    # generic groups whose remaining likelihood ratio exceeds chance
    generic = [
        g for g, group in enumerate(design.groups)
        if group.tier == "generic" and g not in chosen.members and design.size(g)
    ]  # fmt: skip
    directed = []
    for g, gained in zip(generic, gains(design, remainder_of(design, chosen.members), generic), strict=True):
        k = design.size(g)
        log_ratio = float(gained - k - k * np.log(max(gained / k, 1.0)))
        if log_ratio > (DIRECTED_SLOW if design.groups[g].slow else DIRECTED):
            directed.append(Remaining(g, log_ratio))
    return Support(
        z,
        tuple(sorted(directed, key=lambda item: -item.log_ratio)),
        ratio,
        {g: p for g, (p, _) in even.items()},
        {g: gained for g, (_, gained) in even.items()},
        chi2,
        left - freedom,
    )


def contribution(design: Design, chosen: Chosen, member: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters (k,) of a member in the joint fit, their covariance (k, k), and its raw contribution (n,)."""
    index = design.coordinates(chosen.members)
    solution, inverse = _solved(design.rows(chosen.members)[:, index], design.score[index])
    offsets = np.cumsum([0, *(design.size(g) for g in chosen.members)])
    k = chosen.members.index(member)
    at, end = int(offsets[k]), int(offsets[k + 1])
    mapping = design.maps[member]
    parameters = mapping @ solution[at:end]
    covariance = mapping @ inverse[at:end, at:end] @ mapping.T
    return parameters, covariance, np.asarray(design.groups[member].columns @ parameters)


def _solved(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    square, vectors = np.linalg.eigh(matrix)
    kept = square > 1e-9
    inverse = (vectors[:, kept] / square[kept]) @ vectors[:, kept].T
    return inverse @ right, inverse


def leftover(design: Design, chosen: Chosen) -> FloatArray:
    """Whitened residual after base model and chosen set, scaled to the remaining degrees of freedom, (N,)."""
    basis = orthonormal(design.directions(chosen.members)) if chosen.members else None
    left = design.residual if basis is None else design.residual - basis @ (basis.T @ design.residual)
    used = design.count - design.freedom + (0 if basis is None else basis.shape[1])
    return np.asarray(left * np.sqrt(design.count / max(design.count - used, 1)))


def homogeneity(design: Design, chosen: Chosen, member: int, layout: MeasurementLayout) -> tuple[float, float]:
    """p-value of the test that an effect has the same size everywhere, and the chi-square of its unevenness.

    Its contribution is multiplied by stations, Legendre terms in time, load, directions and position. These products
    explain nothing if the effect is real; they do if a wrong name has absorbed part of another effect.
    """
    effect = design.groups[member].effect
    assert effect is not None
    shape = contribution(design, chosen, member)[2]
    readings = design.fit.readings
    c = covariates_of(readings, layout)
    parts = [c.s, legendre(c.time, 3)[:, 1:]]
    if len(readings.stations) > 1:
        parts.append((readings.station[:, None] == np.arange(1, len(readings.stations))).astype(np.float64))
    if c.load is not None:
        parts.append(c.load[:, None])
    if c.approach is not None:
        parts.append(c.approach)
    columns = shape[:, None] * np.hstack(parts)
    white = design.projected(columns)
    members = design.directions(chosen.members)
    basis = orthonormal(members)
    white -= basis @ (basis.T @ white)
    residual = design.residual - basis @ (basis.T @ design.residual)
    norm = np.linalg.norm(white, axis=0)
    raw = np.linalg.norm(design.whiten(columns), axis=0)
    kept = norm > 0.02 * np.maximum(raw, 1e-300)
    if not kept.any():
        return 1.0, 0.0
    extra = orthonormal(white[:, kept], least=1e-4)
    gained = float(np.sum((extra.T @ residual) ** 2))
    k = extra.shape[1]
    freedom = max(design.freedom - basis.shape[1] - k, 1)
    left = float(residual @ residual) - gained
    return float(fdtrc(k, freedom, gained / k / max(left / freedom, 1e-300))), gained


# Diagnosis of one measurement up to the chosen set: base fit, noise, groups, search, support.


Show = Callable[[str], None]

#: If one smooth term in one direction explains at least this share of what wider curves explain, it replaces them.
ONE_TERM = 0.85
#: Most named effects that the wider curves compete with.
MOST_NAMED = 4


@dataclass(frozen=True)
class Analysis:
    """All results that the verdict is based on; ``missing`` are effects whose covariates are not in the data."""

    fit: BaseFit
    noise: Noise
    design: Design
    rules: Rules
    chosen: Chosen
    support: Support
    missing: tuple[str, ...]

    @cached_property
    def left_mm(self) -> FloatArray:
        """Residuals (n,) of an unweighted fit of the base model and all members to all readings."""
        columns = self.columns()
        return self.fit.residual_mm - columns @ least_norm(columns, self.fit.residual_mm)

    def columns(self) -> FloatArray:
        """Columns (n, k) of the base model and of all members."""
        design = self.design
        return np.hstack([self.fit.jacobian, *(design.groups[g].columns @ design.maps[g] for g in self.chosen.members)])


def analyse(
    fit: BaseFit,
    *,
    most_named: int = 4,
    only: Sequence[str] = (),
    sigma_mm: FloatArray | None = None,
    show: Show = lambda _: None,
) -> Analysis:
    """Analyse the residuals of a base fit.

    Parameters
    ----------
    fit : the base fit.
    most_named : maximum number of named effects.
    only : names of effects to look for; default all.
    sigma_mm : standard uncertainty of each reading, (n,), if given.
    show : called with a description of each step.
    """
    show("building the candidate effects")
    repeats = has_repeats(fit.observed.layout)
    wider = wider_of(fit)
    groups, missing, fixed = _groups_of(fit, only)
    show("fitting the noise")
    noise = noise_of(fit, fixed if repeats else [], sigma_mm=sigma_mm)
    show(f"comparing {len(groups)} groups")
    design = design_of(fit, [*groups, *(item.group for item in wider)], whitener(fit.observed.layout, noise))
    taken = needed(design, wider) if wider else []
    if taken:
        show("fitting the wider curves that the readings require")
        fit = widened(fit, taken)
        groups, missing, fixed = _groups_of(fit, only)
        noise = noise_of(fit, fixed if repeats else [], sigma_mm=sigma_mm)
        design = design_of(fit, groups, whitener(fit.observed.layout, noise))
    design = design.first(len(groups))
    rules = rules_of(design, most_named)
    chosen = search(design, rules)
    more = [design.groups[g] for g in chosen.members if design.groups[g].slow or noise.source != "repeats"]
    if more:
        show("fitting the noise together with what was found")
        noise = noise_of(fit, [*fixed, *more] if repeats else more, sigma_mm=sigma_mm, before=noise)
        del design  # free the memory before the next one is built
        design = design_of(fit, groups, whitener(fit.observed.layout, noise))
        rules = rules_of(design, most_named)
        chosen = search(design, rules)
    show("weighing the candidates")
    ratio = run_ratio(fit, [*fixed, *more], noise, RUN_RATIO)
    support = support_of(design, chosen, noise, ratio, fit.observed.layout)
    return Analysis(fit, noise, design, rules, chosen, support, tuple(missing))


def _groups_of(fit: BaseFit, only: Sequence[str]) -> tuple[list[Group], list[str], list[Group]]:
    """All groups of the search, names without the covariate they need, and named groups with a single scan position."""
    named, missing = named_groups(fit.readings, only)
    groups = [*base_groups(fit.readings), *named, *generic_groups(fit.readings, fit.observed.layout)]
    return groups, missing, [group for group in named if group.scans == 1]


def needed(design: Design, wider: Sequence[Wider]) -> list[Wider]:
    """Return the wider bases that justify their columns next to named effects and that no single smooth term replaces.

    A machine with steeper curves has them in several errors of an axis; an effect in only one direction has another
    cause.
    """
    groups = design.groups
    along = [g for g, group in enumerate(groups) if group.covariates in (("x",), ("y",), ("z",))]
    trials = {group.name for g, group in enumerate(groups) if group.tier != "generic" or g in along}
    chosen = search(design, replace(rules_of(design, MOST_NAMED), generic=False, trials=len(trials))).members
    found = []
    for item in wider:
        place = next((g for g in chosen if groups[g].name == item.group.name), None)
        if place is None:
            continue
        left = remainder_of(design, [g for g in chosen if g != place])
        single = [g for g in along if groups[g].covariates == ("xyz"[item.axis],) and design.size(g)]
        if max(gains(design, left, single), default=0.0) < ONE_TERM * float(gains(design, left, [place])[0]):
            found.append(item)
    return found
