"""The search for the set of groups that explains the residual best: forward beam, drops and swaps, then a prune.

Criterion: -chi2 plus a penalty for each member. Named effects pay as in the extended BIC (Chen and Chen 2008); generic
groups pay the evidence of a random effect with optimised prior variance, k + k log(chi2/k), and a handicap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.scene import Scene

#: Handicap of a generic group, and of one that depends on time or temperature.
HANDICAP, SLOW_HANDICAP = 21.0, 27.0
MOST_MEMBERS = 6
#: Columns of the base model up to this number pay as in the BIC; more are curves, and pay as a random effect.
FEW = 3
BEAM, ADDITIONS = 2, 3
#: Largest p-value of a member, corrected for the number of groups and scan positions.
LARGEST_P = 1e-3
#: Directions of which less than this (squared) is left beside the other members say nothing.
LEAST_SQUARE = 1e-6


@dataclass(frozen=True)
class Rules:
    """What the search may do.

    Parameters
    ----------
    named : number of named effects.
    most_named, most_members : how many named effects and groups in all may be chosen.
    predicting : whether groups that say nothing about other readings (an offset of each line) are left out.
    generic : whether groups without a name may be chosen.
    """

    named: int
    most_named: int = 4
    most_members: int = MOST_MEMBERS
    predicting: bool = False
    generic: bool = True


@dataclass(frozen=True)
class Chosen:
    """A set of groups: members in the order named, then generic; criterion; chi-square of all; and of each in turn."""

    members: tuple[int, ...]
    criterion: float
    chi2: float
    gains: tuple[float, ...]


def rules_of(scene: Scene, most_named: int) -> Rules:
    """Return the rules for the groups of a scene."""
    names = {group.name for group in scene.groups if group.tier == "named"}
    return Rules(max(len(names), 1), most_named)


def penalty(scene: Scene, rules: Rules, group: int, chi2: float) -> float:
    """Penalty of a member that gains ``chi2``."""
    item, k = scene.groups[group], scene.size(group)
    if item.tier == "base" and not _is_random(scene, group):
        return k * float(np.log(scene.count))
    if item.tier == "named":
        return k * float(np.log(scene.count)) + 2 * float(np.log(rules.named)) + 2 * float(np.log(item.scans))
    handicap = SLOW_HANDICAP if item.slow else HANDICAP
    return k + k * float(np.log(max(chi2 / max(k, 1), 1.0))) + handicap


def _is_random(scene: Scene, group: int) -> bool:
    """Whether a group is charged as a random effect: those without a name, and curves of many columns."""
    tier = scene.groups[group].tier
    return tier == "generic" or (tier == "base" and scene.size(group) > FEW)


def _ordered(scene: Scene, members: Sequence[int]) -> list[int]:
    rank = {"base": 0, "named": 1, "generic": 2}
    return sorted(members, key=lambda g: (_is_random(scene, g), rank[scene.groups[g].tier]))


@dataclass(frozen=True)
class Beside:
    """What is left of all groups beside a set: ``cross`` (r, K) and ``score`` (K,)."""

    cross: FloatArray
    score: FloatArray
    chi2: float


def beside(scene: Scene, members: Sequence[int]) -> Beside:
    """Take a set of groups out of all others."""
    index = scene.coordinates(members)
    if not len(index):
        return Beside(np.zeros((0, len(scene.score))), scene.score, 0.0)
    rows = scene.rows(members)
    square, vectors = np.linalg.eigh(rows[:, index])
    kept = square > LEAST_SQUARE
    turn = vectors[:, kept] / np.sqrt(square[kept])
    cross = turn.T @ rows
    own = turn.T @ scene.score[index]
    return Beside(cross, scene.score - own @ cross, float(own @ own))


def gains(scene: Scene, left: Beside, wanted: Sequence[int]) -> FloatArray:
    """chi-square that each of the groups ``wanted`` would gain beside the set."""
    result = np.zeros(len(wanted))
    sizes = np.diff(scene.start)[list(wanted)]
    single = np.flatnonzero(sizes == 1)
    at = scene.start[:-1][np.asarray(wanted, dtype=np.int64)[single]]
    square = 1.0 - np.einsum("rk,rk->k", left.cross[:, at], left.cross[:, at])
    result[single] = np.where(square > LEAST_SQUARE, left.score[at] ** 2 / np.maximum(square, LEAST_SQUARE), 0.0)
    for k in np.flatnonzero(sizes > 1).tolist():
        place = scene.place(wanted[k])
        cross = left.cross[:, place]
        values, vectors = np.linalg.eigh(np.eye(cross.shape[1]) - cross.T @ cross)
        kept = values > LEAST_SQUARE
        result[k] = float(np.sum((vectors[:, kept].T @ left.score[place]) ** 2 / values[kept]))
    return result


def evaluate(scene: Scene, rules: Rules, members: Sequence[int]) -> Chosen:
    """Criterion of a set; named members enter first."""
    order = _ordered(scene, members)
    found, total = [], 0.0
    criterion = 0.0
    fixed = [g for g in order if not _is_random(scene, g)]
    known = beside(scene, fixed).chi2
    criterion += sum(penalty(scene, rules, g, 0.0) for g in fixed) - known
    found += [gain_of(scene, [f for f in fixed if f != g], g) for g in fixed]
    total = known
    for k, group in enumerate(order[len(fixed) :]):
        chi2 = beside(scene, order[: len(fixed) + k + 1]).chi2
        found.append(chi2 - total)
        criterion += penalty(scene, rules, group, chi2 - total) - (chi2 - total)
        total = chi2
    return Chosen(tuple(order), criterion, total, tuple(found))


def gain_of(scene: Scene, others: Sequence[int], group: int) -> float:
    """chi-square that a group gains beside others."""
    return float(gains(scene, beside(scene, others), [group])[0])


def allowed_beside(scene: Scene, rules: Rules, members: Sequence[int]) -> list[int]:
    """Groups that may be added: of another name, visible, allowed by the rules, and within the numbers allowed."""
    names = {scene.groups[g].name for g in members}
    reported = [g for g in members if scene.groups[g].tier != "base"]
    named = sum(scene.groups[g].tier == "named" for g in members)
    found = []
    for g, group in enumerate(scene.groups):
        if group.name in names or not scene.size(g) or (rules.predicting and not group.predicts):
            continue
        if group.tier == "named" and named >= rules.most_named:
            continue
        if group.tier == "generic" and not rules.generic:
            continue
        if group.tier != "base" and len(reported) >= rules.most_members:
            continue
        found.append(g)
    return found


def _best_additions(scene: Scene, rules: Rules, members: Sequence[int], most: int) -> list[Chosen]:
    """The sets with one more group that lower the criterion most."""
    allowed = allowed_beside(scene, rules, members)
    if not allowed:
        return []
    gained = gains(scene, beside(scene, members), allowed)
    merit = np.array([g - penalty(scene, rules, a, g) for g, a in zip(gained, allowed, strict=True)])
    best: dict[str, Chosen] = {}
    for k in np.argsort(-merit)[: 4 * most]:
        name = scene.groups[allowed[k]].name
        if merit[k] <= -10.0 or len(best) >= most:
            break
        if name not in best:
            best[name] = evaluate(scene, rules, [*members, allowed[k]])
    return list(best.values())


def search(scene: Scene, rules: Rules, start: Sequence[int] = ()) -> Chosen:
    """Find the set with the smallest criterion; then drop members that are not significant.

    A free offset of each line holds everything that is constant in a line, so that what it took up first finds no way
    in any more: where one won, a search without such groups is made as well.
    """
    found = _forward(scene, rules, start)
    rest = [g for g in found.members if scene.groups[g].predicts]
    if len(rest) < len(found.members):
        other = _forward(scene, replace(rules, predicting=True), rest)
        found = other if other.criterion < found.criterion else found
    return with_names(scene, rules, found)


def _forward(scene: Scene, rules: Rules, start: Sequence[int]) -> Chosen:
    """Forward beam from ``start``, drops and swaps, then the prune."""
    best = evaluate(scene, rules, start)
    beam = [best]
    while True:
        found: dict[frozenset[int], Chosen] = {}
        for item in beam:
            for chosen in _best_additions(scene, rules, item.members, ADDITIONS):
                found[frozenset(chosen.members)] = chosen
        if not found:
            break
        beam = sorted(found.values(), key=lambda item: item.criterion)[:BEAM]
        beam = [_improved(scene, rules, item) for item in beam]
        if beam[0].criterion >= best.criterion - 1e-6:
            break
        best = min(beam, key=lambda item: item.criterion)
    return prune(scene, rules, _improved(scene, rules, best))


def _improved(scene: Scene, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop and swap members as long as that lowers the criterion."""
    for _ in range(6):
        better = chosen
        for member in chosen.members:
            rest = [g for g in chosen.members if g != member]
            for trial in [evaluate(scene, rules, rest), *_best_additions(scene, rules, rest, 2)]:
                if trial.criterion < better.criterion - 1e-6:
                    better = trial
        if better is chosen:
            return chosen
        chosen = better
    return chosen


#: A name that explains this share of what a generic group in its covariates explains takes its place.
SAME_LAW = 0.93


def with_names(scene: Scene, rules: Rules, chosen: Chosen) -> Chosen:
    """Put names in place of generic groups that hold the same law with more freedom: a shape that is not quite exact."""
    for generic in [g for g in chosen.members if scene.groups[g].tier == "generic"]:
        rest = [g for g in chosen.members if g != generic]
        related = [g for g in allowed_beside(scene, rules, rest) if _related(scene, generic, g)]
        if not related:
            continue
        gained = gains(scene, beside(scene, rest), related)
        best = int(np.argmax(gained))
        if gained[best] > SAME_LAW * gain_of(scene, rest, generic):
            chosen = evaluate(scene, rules, [*rest, related[best]])
    return chosen


def _related(scene: Scene, generic: int, group: int) -> bool:
    """Whether a group is a name for what depends on the covariates of a generic one; offsets of lines hold them all."""
    if scene.groups[group].tier != "named":
        return False
    if not scene.groups[generic].predicts:
        return True
    own = plain_covariates(scene.groups[generic].covariates) - {"x", "y", "z"}
    return bool(own) and own <= plain_covariates(scene.groups[group].covariates)


def plain_covariates(names: tuple[str, ...]) -> set[str]:
    """Covariates of a card or of a generic term in one spelling: ``x``, ``approach_x``, ``temperature``, ``time``."""
    found = set()
    for name in names:
        word = (
            name.removesuffix("_mm_min").removesuffix("_mm").removesuffix("_s").removesuffix("_c").removesuffix("_kg")
        )
        found.add("temperature" if word.startswith("temp") else word)
    return found


def prune(scene: Scene, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop the least significant member as long as its corrected p-value is too large."""
    from scipy.stats import f as f_distribution  # imported here: slow to load

    trials = len({group.name for group in scene.groups})
    members = list(chosen.members)
    while members:
        left = scene.total - beside(scene, members).chi2
        freedom = scene.freedom - len(scene.coordinates(members))
        worst, largest = -1, 0.0
        for member in members:
            if scene.groups[member].tier == "base":
                continue
            k = max(scene.size(member), 1)
            gain = gain_of(scene, [g for g in members if g != member], member)
            ratio = gain / k / max(left / max(freedom, 1), 1e-300)
            p = float(f_distribution.sf(ratio, k, scene.count / 2)) * trials * scene.groups[member].scans
            if p > largest:
                worst, largest = member, p
        if largest <= LARGEST_P:
            break
        members.remove(worst)
    return chosen if len(members) == len(chosen.members) else evaluate(scene, rules, members)
