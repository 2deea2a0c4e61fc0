"""The diagnosis of one measurement up to the chosen set: base fit, noise, groups, search, evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.base import BaseFit
from compgen.diagnose.base_choice import Wider, widened, wider_of
from compgen.diagnose.evidence import RUN_RATIO, Evidence, evidence_of
from compgen.diagnose.generic import base_groups, generic_groups
from compgen.diagnose.groups import Group, named_groups
from compgen.diagnose.noise import Noise
from compgen.diagnose.noise_fit import noise_of, run_ratio
from compgen.diagnose.scene import Scene, scene_of
from compgen.diagnose.search import Chosen, Rules, beside, gains, rules_of, search
from compgen.diagnose.whiten import whitener

Show = Callable[[str], None]

#: Share of what wider curves explain above which one smooth term in one direction stands for them.
ONE_TERM = 0.85
#: Named effects that wider curves are compared with.
MOST_NAMED = 4


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
    show("building the catalogue")
    wider = wider_of(fit)
    if wider:
        show("choosing the curves of the base model")
        taken = needed(fit, wider, only, sigma_mm)
        fit = widened(fit, taken) if taken else fit
    named, missing = named_groups(fit.readings, only)
    groups = [*base_groups(fit.readings), *named, *generic_groups(fit.readings, fit.observed.layout)]
    fixed = [group for group in named if group.scans == 1]
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
    ratio = run_ratio(fit, [*fixed, *more], noise, RUN_RATIO)
    evidence = evidence_of(scene, chosen, noise, ratio, fit.observed.layout)
    return Analysis(fit, noise, scene, rules, chosen, evidence, tuple(missing))


def needed(fit: BaseFit, wider: Sequence[Wider], only: Sequence[str], sigma_mm: FloatArray | None) -> list[Wider]:
    """Return the wider bases that are worth their columns beside the names, and that no single smooth term replaces.

    A machine whose curves are steeper has them in several errors of an axis; what acts in one direction alone is
    something else.
    """
    named, _ = named_groups(fit.readings, only)
    fixed = [group for group in named if group.scans == 1]
    noise = noise_of(fit, fixed if _repeats(fit) else [], sigma_mm=sigma_mm)
    along = [group for group in generic_groups(fit.readings, fit.observed.layout) if len(group.covariates) == 1]
    along = [group for group in along if group.covariates[0] in ("x", "y", "z")]
    groups = [*base_groups(fit.readings), *(item.group for item in wider), *named, *along]
    scene = scene_of(fit, groups, whitener(fit.observed.layout, noise))
    chosen = search(scene, replace(rules_of(scene, MOST_NAMED), generic=False)).members
    found = []
    for item in wider:
        place = next((g for g in chosen if groups[g].name == item.group.name), None)
        if place is None:
            continue
        left = beside(scene, [g for g in chosen if g != place])
        single = [g for g, group in enumerate(groups) if group.covariates == ("xyz"[item.axis],) and scene.size(g)]
        if max(gains(scene, left, single), default=0.0) < ONE_TERM * float(gains(scene, left, [place])[0]):
            found.append(item)
    return found


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
