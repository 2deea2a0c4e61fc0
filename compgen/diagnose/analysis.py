"""The diagnosis of one measurement up to the chosen set: base fit, noise, groups, search, evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.base import BaseFit
from compgen.diagnose.base_choice import Wider, widened, wider_of
from compgen.diagnose.evidence import Evidence, evidence_of
from compgen.diagnose.generic import base_groups, generic_groups
from compgen.diagnose.groups import Group, named_groups
from compgen.diagnose.noise import Noise
from compgen.diagnose.noise_fit import noise_of, run_ratio
from compgen.diagnose.scene import Scene, scene_of
from compgen.diagnose.search import Chosen, Rules, rules_of, search
from compgen.diagnose.whiten import whitener

Show = Callable[[str], None]


@dataclass(frozen=True)
class Analysis:
    """Everything that the verdict is drawn from; ``missing`` are effects whose covariates the data lack."""

    fit: BaseFit
    noise: Noise
    scene: Scene
    rules: Rules
    chosen: Chosen
    evidence: Evidence
    missing: tuple[str, ...]


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
    most_named : largest number of named effects.
    only : names of effects to look for; default all.
    sigma_mm : standard uncertainty of each reading, (n,), if one is given.
    show : receives the stage in words.
    """
    wider = wider_of(fit)
    found = _analysed(fit, wider, most_named, only, sigma_mm, show)
    chosen = {found.scene.groups[g].name for g in found.chosen.members}
    taken = [item for item in wider if item.group.name in chosen]
    return _analysed(widened(fit, taken), (), most_named, only, sigma_mm, show) if taken else found


def _analysed(
    fit: BaseFit,
    wider: Sequence[Wider],
    most_named: int,
    only: Sequence[str],
    sigma_mm: FloatArray | None,
    show: Show,
) -> Analysis:
    """Analyse the residuals of a base fit, with wider curves among the groups."""
    show("building the catalogue")
    named, missing = named_groups(fit.readings, only)
    groups = [*base_groups(fit.readings), *(item.group for item in wider), *named]
    groups += generic_groups(fit.readings, fit.observed.layout)
    fixed = [group for group in named if group.scans == 1 or fit.readings.kind == "axis"]
    show("fitting the noise")
    noise = noise_of(fit, fixed if _repeats(fit) else [], sigma_mm=sigma_mm)
    show(f"comparing {len(groups)} groups")
    scene, rules, chosen = _searched(fit, groups, noise, most_named)
    more = [scene.groups[g] for g in chosen.members if scene.groups[g].slow or noise.source != "repeats"]
    if more:
        show("fitting the noise beside what was found")
        noise = noise_of(fit, [*fixed, *more] if _repeats(fit) else more, sigma_mm=sigma_mm, before=noise)
        scene, rules, chosen = _searched(fit, groups, noise, most_named)
    show("weighing the evidence")
    ratio = run_ratio(fit, [*fixed, *more], noise)
    evidence = evidence_of(scene, chosen, noise, ratio, fit.observed.layout)
    return Analysis(fit, noise, scene, rules, chosen, evidence, tuple(missing))


def _repeats(fit: BaseFit) -> bool:
    from compgen.diagnose.noise_fit import has_repeats

    return has_repeats(fit.observed.layout)


def _searched(fit: BaseFit, groups: Sequence[Group], noise: Noise, most_named: int) -> tuple[Scene, Rules, Chosen]:
    scene = scene_of(fit, groups, whitener(fit.observed.layout, noise))
    rules = rules_of(scene, most_named)
    return scene, rules, search(scene, rules)


def white_rms(analysis: Analysis) -> float:
    """RMS of the whitened residual of the base model; 1 if it explains everything."""
    return float(np.sqrt(analysis.scene.total / analysis.scene.freedom))
