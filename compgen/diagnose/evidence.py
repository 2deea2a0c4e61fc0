"""What speaks for and against a set of groups: lack of fit, what is left over, changes from run to run, homogeneity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.basis import legendre
from compgen.diagnose.generic import covariates_of
from compgen.diagnose.layout import Layout
from compgen.diagnose.noise import Noise
from compgen.diagnose.scene import Scene, orthonormal
from compgen.diagnose.search import Chosen, beside, gain_of, gains

#: Limits: standard normal deviate of the lack of fit, likelihood ratio of runs, p-value of the homogeneity.
LACK_OF_FIT_Z = 3.0
RUN_RATIO = 12.0
HOMOGENEITY_P = 2e-3
#: Evidence of the best remaining generic group, in units of the criterion beyond its handicap.
DIRECTED, DIRECTED_SLOW = 20.0, 26.0


@dataclass(frozen=True)
class Remaining:
    """A generic group that is left over, with its evidence (2 log, without handicap)."""

    group: int
    evidence: float


@dataclass(frozen=True)
class Evidence:
    """Evidence for a set.

    Parameters
    ----------
    lack_of_fit_z : deviate of the global lack of fit against pure error; nan without repeats.
    directed : generic groups that are left over, best first.
    run_ratio : likelihood ratio of what changes from run to run.
    homogeneity_p : p-value of every named member, by its group.
    uneven : chi-square that the unevenness of every named member explains, by its group.
    chi2 : drop-one chi-square of every member, by its group.
    excess : residual sum of squares beyond its expectation.
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
        """Whether the set leaves something that the noise does not explain."""
        return bool(self.lack_of_fit_z > LACK_OF_FIT_Z) or bool(self.directed)

    @property
    def changes_between_runs(self) -> bool:
        """Whether repeats of a line differ by more than the noise within them."""
        return self.run_ratio > RUN_RATIO


def evidence_of(scene: Scene, chosen: Chosen, noise: Noise, ratio: float, layout: Layout) -> Evidence:
    """Collect the evidence for a chosen set."""
    size = len(scene.coordinates(chosen.members))
    left = scene.total - chosen.chi2
    named = [g for g in chosen.members if scene.groups[g].tier == "named"]
    chi2 = {g: gain_of(scene, [m for m in chosen.members if m != g], g) for g in chosen.members}
    even = {g: homogeneity(scene, chosen, g, layout) for g in named}
    return Evidence(
        _lack_of_fit(left, scene.freedom - size, noise),
        _directed(scene, chosen),
        ratio,
        {g: p for g, (p, _) in even.items()},
        {g: gained for g, (_, gained) in even.items()},
        chi2,
        left - (scene.freedom - size),
    )


def _lack_of_fit(left: float, freedom: int, noise: Noise) -> float:
    """Deviate of the F-test of what the set leaves, against the pure error of the repeats."""
    from scipy.stats import f as f_distribution
    from scipy.stats import norm

    if noise.freedom <= 0 or freedom <= noise.freedom:
        return float("nan")
    ratio = (left - noise.quadratic) / (freedom - noise.freedom) / (noise.quadratic / noise.freedom)
    if ratio <= 0:
        return -10.0
    p = float(f_distribution.sf(ratio, freedom - noise.freedom, noise.freedom))
    return float(norm.isf(p)) if p > 0 else 40.0


def _directed(scene: Scene, chosen: Chosen) -> tuple[Remaining, ...]:
    """Generic groups with more evidence left than chance gives."""
    wanted = [
        g
        for g, group in enumerate(scene.groups)
        if group.tier == "generic" and g not in chosen.members and scene.size(g)
    ]
    gained = gains(scene, beside(scene, chosen.members), wanted)
    found = []
    for g, chi2 in zip(wanted, gained, strict=True):
        k = scene.size(g)
        evidence = float(chi2 - k - k * np.log(max(chi2 / k, 1.0)))
        if evidence > (DIRECTED_SLOW if scene.groups[g].slow else DIRECTED):
            found.append(Remaining(g, evidence))
    return tuple(sorted(found, key=lambda item: -item.evidence))


def contribution(scene: Scene, chosen: Chosen, member: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters (k,) of a member fitted beside the others, their covariance (k, k), and its raw contribution (n,)."""
    index = scene.coordinates(chosen.members)
    solution, inverse = _solved(scene.rows(chosen.members)[:, index], scene.score[index])
    offsets = np.cumsum([0, *(scene.size(g) for g in chosen.members)])
    k = chosen.members.index(member)
    at, end = int(offsets[k]), int(offsets[k + 1])
    mapping = scene.maps[member]
    parameters = mapping @ solution[at:end]
    covariance = mapping @ inverse[at:end, at:end] @ mapping.T
    return parameters, covariance, np.asarray(scene.groups[member].columns @ parameters)


def _solved(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    square, vectors = np.linalg.eigh(matrix)
    kept = square > 1e-9
    inverse = (vectors[:, kept] / square[kept]) @ vectors[:, kept].T
    return inverse @ right, inverse


def leftover(scene: Scene, chosen: Chosen) -> FloatArray:
    """Whitened residual without base model and chosen set, scaled to the degrees of freedom that are left, (N,)."""
    basis = orthonormal(scene.directions[:, scene.coordinates(chosen.members)]) if chosen.members else None
    left = scene.residual if basis is None else scene.residual - basis @ (basis.T @ scene.residual)
    used = scene.count - scene.freedom + (0 if basis is None else basis.shape[1])
    return np.asarray(left * np.sqrt(scene.count / max(scene.count - used, 1)))


def homogeneity(scene: Scene, chosen: Chosen, member: int, layout: Layout) -> tuple[float, float]:
    """p-value of the test that an effect has the same size everywhere, and the chi-square of its unevenness.

    Its contribution is multiplied by stations, quarters of the time, load, directions and position; a true effect
    leaves nothing for these products to explain, a wrong name that takes up part of something else does.
    """
    from scipy.stats import f as f_distribution

    effect = scene.groups[member].effect
    assert effect is not None
    shape = contribution(scene, chosen, member)[2]
    readings = scene.fit.readings
    c = covariates_of(readings, layout)
    parts = [c.s, legendre(c.time, 3)[:, 1:]]
    if len(readings.stations) > 1:
        parts.append((readings.station[:, None] == np.arange(1, len(readings.stations))).astype(np.float64))
    if c.load is not None:
        parts.append(c.load[:, None])
    if c.approach is not None:
        parts.append(c.approach)
    columns = shape[:, None] * np.hstack(parts)
    white = scene.projected(columns)
    members = scene.directions[:, scene.coordinates(chosen.members)]
    basis = orthonormal(members)
    white -= basis @ (basis.T @ white)
    residual = scene.residual - basis @ (basis.T @ scene.residual)
    norm = np.linalg.norm(white, axis=0)
    raw = np.linalg.norm(scene.whiten(columns), axis=0)
    kept = norm > 0.02 * np.maximum(raw, 1e-300)
    if not kept.any():
        return 1.0, 0.0
    extra = orthonormal(white[:, kept], least=1e-4)
    gained = float(np.sum((extra.T @ residual) ** 2))
    k = extra.shape[1]
    freedom = max(scene.freedom - basis.shape[1] - k, 1)
    left = float(residual @ residual) - gained
    return float(f_distribution.sf(gained / k / max(left / freedom, 1e-300), k, freedom)), gained
