"""The search for the set of groups that explains the whitened residual best, and the alternatives to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.diagnose.base_fit import BaseFit
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import IntArray
from compgen.diagnose.noise_model import Whitener

# The whitened problem with the base model projected out: products of columns on which all sets of groups are compared.
#
# Frisch-Waugh-Lovell: what the base model can do as well is invisible, so both residual and columns lose their part in
# the span of the base Jacobian first.


#: Directions of a group of which less than this share is left without the base model are dropped.
LEAST_VISIBLE = 1e-3
#: Columns smaller than this share of the largest of their group are rounding.
ROUNDING = 1e-9
#: Columns whitened at a time.
CHUNK = 400


@dataclass(frozen=True)
class Design:
    """Groups in orthonormal coordinates of what is visible of them; K coordinates in all.

    Parameters
    ----------
    groups : the groups.
    start : first coordinate of each group, (groups + 1,).
    maps : matrix (k, k_visible) of each group from its coordinates to the parameters of its columns.
    score : products with the residual, (K,).
    visible : share of each group that is left without the base model (RMS over its columns), (groups,).
    residual : whitened residual without its part in the base model, (N,).
    base : orthonormal columns of the whitened base model, (N, p).
    directions : the coordinates as whitened columns, (N, K).
    whiten : the whitening.
    fit : the base fit.
    """

    groups: tuple[Group, ...]
    start: IntArray
    maps: tuple[FloatArray, ...]
    score: FloatArray
    visible: FloatArray
    residual: FloatArray
    base: FloatArray
    directions: FloatArray
    whiten: Whitener
    fit: BaseFit
    _rows: dict[int, FloatArray] = field(default_factory=dict)

    def rows(self, members: Sequence[int]) -> FloatArray:
        """Products of the coordinates of ``members`` with all coordinates, (r, K), computed when first asked for."""
        for g in members:
            if g not in self._rows:
                self._rows[g] = self.directions[:, self.place(g)].T @ self.directions
        return np.vstack([self._rows[g] for g in members]) if members else np.zeros((0, len(self.score)))

    @property
    def total(self) -> float:
        """Residual sum of squares of the base model, whitened."""
        return float(self.residual @ self.residual)

    @property
    def count(self) -> int:
        """Number of readings."""
        return len(self.residual)

    @property
    def freedom(self) -> int:
        """Readings less unknowns of the base model."""
        return self.count - int(self.base.shape[1])

    def size(self, group: int) -> int:
        """Visible dimensions of a group."""
        return int(self.start[group + 1] - self.start[group])

    def place(self, group: int) -> slice:
        """Coordinates of a group."""
        return slice(int(self.start[group]), int(self.start[group + 1]))

    def coordinates(self, members: Sequence[int]) -> IntArray:
        """Coordinates of several groups."""
        parts = [np.arange(self.start[g], self.start[g + 1]) for g in members]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def projected(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (n, k) and take out the base model."""
        white = self.whiten(columns)
        return np.asarray(white - self.base @ (self.base.T @ white))


def orthonormal(columns: FloatArray, least: float = 1e-9) -> FloatArray:
    """Orthonormal basis of the span of columns (n, p)."""
    norm = np.linalg.norm(columns, axis=0)
    kept = norm > 0
    q, r = np.linalg.qr(columns[:, kept] / norm[kept])
    u, singular, _ = np.linalg.svd(r, full_matrices=False)
    return np.asarray(q @ u[:, singular > least * singular[0]])


def design_of(fit: BaseFit, groups: Sequence[Group], whiten: Whitener) -> Design:
    """Whiten, project and reduce all groups."""
    base = orthonormal(whiten(fit.jacobian))
    white = whiten(fit.residual_mm)
    residual = white - base @ (base.T @ white)
    directions, maps, visible = [], [], []
    for part in _chunks(groups):
        raw = [_centred(fit, group.columns) for group in part]
        sizes = np.cumsum([0, *(columns.shape[1] for columns in raw)])
        tall = whiten(np.hstack(raw))
        left = tall - base @ (base.T @ tall)
        for k in range(len(part)):
            place = slice(sizes[k], sizes[k + 1])
            basis, mapping, share = _reduced(tall[:, place], left[:, place])
            directions.append(basis)
            maps.append(mapping)
            visible.append(share)
    stacked = np.hstack(directions) if directions else np.zeros((len(residual), 0))
    start = np.cumsum([0, *(basis.shape[1] for basis in directions)]).astype(np.int64)
    return Design(
        tuple(groups),
        start,
        tuple(maps),
        stacked.T @ residual,
        np.array(visible),
        residual,
        base,
        stacked,
        whiten,
        fit,
    )


def _centred(fit: BaseFit, columns: FloatArray) -> FloatArray:
    """Columns without their mean at every channel, which a dead length takes up."""
    channel = fit.observed.layout.channel
    count = np.bincount(channel).astype(np.float64)
    result = columns.copy()
    for k in range(columns.shape[1]):
        result[:, k] -= (np.bincount(channel, columns[:, k]) / count)[channel]
    return result


def _chunks(groups: Sequence[Group]) -> list[list[Group]]:
    parts: list[list[Group]] = []
    width = CHUNK
    for group in groups:
        if width + group.columns.shape[1] > CHUNK:
            parts.append([])
            width = 0
        parts[-1].append(group)
        width += group.columns.shape[1]
    return parts


def _reduced(raw: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Orthonormal visible directions (N, m), their map to the parameters (k, m), and the visible share.

    The raw columns are first made orthonormal, so that the singular values of what is left are shares.
    """
    if raw.shape[1] == 1:
        return _single(raw, left)
    norm = np.linalg.norm(raw, axis=0)
    present = norm > ROUNDING * norm.max()
    norm = np.where(present, norm, np.inf)
    square, vectors = np.linalg.eigh((raw / norm).T @ (raw / norm))
    kept = square > 1e-8 * max(square[-1], 1e-300)
    turn = vectors[:, kept] / np.sqrt(square[kept]) / norm[:, None]
    if not kept.any() or not np.any(raw):
        return np.zeros((len(raw), 0)), np.zeros((raw.shape[1], 0)), 0.0
    seen = left @ turn
    share2, axes = np.linalg.eigh(seen.T @ seen)
    visible = share2 > LEAST_VISIBLE**2
    mapping = turn @ (axes[:, visible] / np.sqrt(share2[visible]))
    share = np.sum((left / norm) ** 2) / max(float(np.sum((raw / norm) ** 2)), 1e-300)
    return left @ mapping, mapping, float(np.sqrt(share))


def _single(raw: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """The same for one column."""
    whole, seen = float(np.linalg.norm(raw)), float(np.linalg.norm(left))
    share = seen / whole if whole > 0.0 else 0.0
    if share <= LEAST_VISIBLE:
        return np.zeros((len(raw), 0)), np.zeros((1, 0)), share
    return left / seen, np.array([[1.0 / seen]]), share


# The search for the set of groups that explains the residual best: forward beam, drops and swaps, then a prune.
#
# Criterion: -chi2 plus a penalty for each member. Named effects pay as in the extended BIC (Chen and Chen 2008); generic
# groups pay the evidence of a random effect with optimised prior variance, k + k log(chi2/k), and a handicap.


#: Handicap of a generic group, and of one that depends on time or temperature.
HANDICAP, SLOW_HANDICAP = 21.0, 27.0
MOST_MEMBERS = 6
#: Columns of the base model up to this number pay as in the BIC; more are curves, and pay as a random effect.
FEW = 3
BEAM, ADDITIONS = 2, 3
#: Largest p-value of a member, corrected for the number of groups and scan positions.
LARGEST_P = 1e-3
#: Directions of which less than this (squared) is left without the other members say nothing.
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


def rules_of(design: Design, most_named: int) -> Rules:
    """Return the rules for the groups of a design."""
    names = {group.name for group in design.groups if group.tier == "named"}
    return Rules(max(len(names), 1), most_named)


def penalty(design: Design, rules: Rules, group: int, chi2: float) -> float:
    """Penalty of a member that gains ``chi2``."""
    item, k = design.groups[group], design.size(group)
    if item.tier == "base" and not _is_random(design, group):
        return k * float(np.log(design.count))
    if item.tier == "named":
        return k * float(np.log(design.count)) + 2 * float(np.log(rules.named)) + 2 * float(np.log(item.scans))
    handicap = SLOW_HANDICAP if item.slow else HANDICAP
    return k + k * float(np.log(max(chi2 / max(k, 1), 1.0))) + handicap


def _is_random(design: Design, group: int) -> bool:
    """Whether a group is charged as a random effect: those without a name, and curves of many columns."""
    tier = design.groups[group].tier
    return tier == "generic" or (tier == "base" and design.size(group) > FEW)


def _ordered(design: Design, members: Sequence[int]) -> list[int]:
    rank = {"base": 0, "named": 1, "generic": 2}
    return sorted(members, key=lambda g: (_is_random(design, g), rank[design.groups[g].tier]))


@dataclass(frozen=True)
class Remainder:
    """What is left of all groups once a set is taken out: ``cross`` (r, K) and ``score`` (K,)."""

    cross: FloatArray
    score: FloatArray
    chi2: float


def remainder_of(design: Design, members: Sequence[int]) -> Remainder:
    """Take a set of groups out of all others."""
    index = design.coordinates(members)
    if not len(index):
        return Remainder(np.zeros((0, len(design.score))), design.score, 0.0)
    rows = design.rows(members)
    square, vectors = np.linalg.eigh(rows[:, index])
    kept = square > LEAST_SQUARE
    turn = vectors[:, kept] / np.sqrt(square[kept])
    cross = turn.T @ rows
    own = turn.T @ design.score[index]
    return Remainder(cross, design.score - own @ cross, float(own @ own))


def gains(design: Design, left: Remainder, wanted: Sequence[int]) -> FloatArray:
    """chi-square that each of the groups ``wanted`` would gain in addition to the set."""
    result = np.zeros(len(wanted))
    sizes = np.diff(design.start)[list(wanted)]
    single = np.flatnonzero(sizes == 1)
    at = design.start[:-1][np.asarray(wanted, dtype=np.int64)[single]]
    square = 1.0 - np.einsum("rk,rk->k", left.cross[:, at], left.cross[:, at])
    result[single] = np.where(square > LEAST_SQUARE, left.score[at] ** 2 / np.maximum(square, LEAST_SQUARE), 0.0)
    for k in np.flatnonzero(sizes > 1).tolist():
        place = design.place(wanted[k])
        cross = left.cross[:, place]
        values, vectors = np.linalg.eigh(np.eye(cross.shape[1]) - cross.T @ cross)
        kept = values > LEAST_SQUARE
        result[k] = float(np.sum((vectors[:, kept].T @ left.score[place]) ** 2 / values[kept]))
    return result


def evaluate(design: Design, rules: Rules, members: Sequence[int]) -> Chosen:
    """Criterion of a set; named members enter first."""
    order = _ordered(design, members)
    found, total = [], 0.0
    criterion = 0.0
    fixed = [g for g in order if not _is_random(design, g)]
    known = remainder_of(design, fixed).chi2
    criterion += sum(penalty(design, rules, g, 0.0) for g in fixed) - known
    found += [gain_of(design, [f for f in fixed if f != g], g) for g in fixed]
    total = known
    for k, group in enumerate(order[len(fixed) :]):
        chi2 = remainder_of(design, order[: len(fixed) + k + 1]).chi2
        found.append(chi2 - total)
        criterion += penalty(design, rules, group, chi2 - total) - (chi2 - total)
        total = chi2
    return Chosen(tuple(order), criterion, total, tuple(found))


def gain_of(design: Design, others: Sequence[int], group: int) -> float:
    """chi-square that a group gains in addition to others."""
    return float(gains(design, remainder_of(design, others), [group])[0])


def allowed_with(design: Design, rules: Rules, members: Sequence[int]) -> list[int]:
    """Groups that may be added: of another name, visible, allowed by the rules, and within the numbers allowed."""
    names = {design.groups[g].name for g in members}
    reported = [g for g in members if design.groups[g].tier != "base"]
    named = sum(design.groups[g].tier == "named" for g in members)
    found = []
    for g, group in enumerate(design.groups):
        if group.name in names or not design.size(g) or (rules.predicting and not group.predicts):
            continue
        if group.tier == "named" and named >= rules.most_named:
            continue
        if group.tier == "generic" and not rules.generic:
            continue
        if group.tier != "base" and len(reported) >= rules.most_members:
            continue
        found.append(g)
    return found


def _best_additions(design: Design, rules: Rules, members: Sequence[int], most: int) -> list[Chosen]:
    """The sets with one more group that lower the criterion most."""
    allowed = allowed_with(design, rules, members)
    if not allowed:
        return []
    gained = gains(design, remainder_of(design, members), allowed)
    merit = np.array([g - penalty(design, rules, a, g) for g, a in zip(gained, allowed, strict=True)])
    best: dict[str, Chosen] = {}
    for k in np.argsort(-merit)[: 4 * most]:
        name = design.groups[allowed[k]].name
        if merit[k] <= -10.0 or len(best) >= most:
            break
        if name not in best:
            best[name] = evaluate(design, rules, [*members, allowed[k]])
    return list(best.values())


def search(design: Design, rules: Rules, start: Sequence[int] = ()) -> Chosen:
    """Find the set with the smallest criterion; then drop members that are not significant.

    A free offset of each line holds everything that is constant in a line, so that what it took up first finds no way
    in any more: where one won, a search without such groups is made as well.
    """
    found = _forward(design, rules, start)
    rest = [g for g in found.members if design.groups[g].predicts]
    if len(rest) < len(found.members):
        other = _forward(design, replace(rules, predicting=True), rest)
        found = other if other.criterion < found.criterion else found
    return with_names(design, rules, found)


def _forward(design: Design, rules: Rules, start: Sequence[int]) -> Chosen:
    """Forward beam from ``start``, drops and swaps, then the prune."""
    best = evaluate(design, rules, start)
    beam = [best]
    while True:
        found: dict[frozenset[int], Chosen] = {}
        for item in beam:
            for chosen in _best_additions(design, rules, item.members, ADDITIONS):
                found[frozenset(chosen.members)] = chosen
        if not found:
            break
        beam = sorted(found.values(), key=lambda item: item.criterion)[:BEAM]
        beam = [_improved(design, rules, item) for item in beam]
        if beam[0].criterion >= best.criterion - 1e-6:
            break
        best = min(beam, key=lambda item: item.criterion)
    return prune(design, rules, _improved(design, rules, best))


def _improved(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop and swap members as long as that lowers the criterion."""
    for _ in range(6):
        better = chosen
        for member in chosen.members:
            rest = [g for g in chosen.members if g != member]
            for trial in [evaluate(design, rules, rest), *_best_additions(design, rules, rest, 2)]:
                if trial.criterion < better.criterion - 1e-6:
                    better = trial
        if better is chosen:
            return chosen
        chosen = better
    return chosen


#: A name that explains this share of what a generic group in its covariates explains takes its place.
SAME_LAW = 0.93


def with_names(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Put names in place of generic groups that hold the same law with more freedom: a shape that is not quite exact."""
    for generic in [g for g in chosen.members if design.groups[g].tier == "generic"]:
        rest = [g for g in chosen.members if g != generic]
        related = [g for g in allowed_with(design, rules, rest) if _related(design, generic, g)]
        if not related:
            continue
        gained = gains(design, remainder_of(design, rest), related)
        best = int(np.argmax(gained))
        if gained[best] > SAME_LAW * gain_of(design, rest, generic):
            chosen = evaluate(design, rules, [*rest, related[best]])
    return chosen


def _related(design: Design, generic: int, group: int) -> bool:
    """Whether a group is a name for what depends on the covariates of a generic one; offsets of lines hold them all."""
    if design.groups[group].tier != "named":
        return False
    if not design.groups[generic].predicts:
        return True
    own = plain_covariates(design.groups[generic].covariates) - {"x", "y", "z"}
    return bool(own) and own <= plain_covariates(design.groups[group].covariates)


def plain_covariates(names: tuple[str, ...]) -> set[str]:
    """Covariates of a card or of a generic term in one spelling: ``x``, ``approach_x``, ``temperature``, ``time``."""
    found = set()
    for name in names:
        word = (
            name.removesuffix("_mm_min").removesuffix("_mm").removesuffix("_s").removesuffix("_c").removesuffix("_kg")
        )
        found.add("temperature" if word.startswith("temp") else word)
    return found


def prune(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop the least significant member as long as its corrected p-value is too large."""
    from scipy.stats import f as f_distribution  # imported here: slow to load

    trials = len({group.name for group in design.groups})
    members = list(chosen.members)
    while members:
        left = design.total - remainder_of(design, members).chi2
        freedom = design.freedom - len(design.coordinates(members))
        worst, largest = -1, 0.0
        for member in members:
            if design.groups[member].tier == "base":
                continue
            k = max(design.size(member), 1)
            gain = gain_of(design, [g for g in members if g != member], member)
            ratio = gain / k / max(left / max(freedom, 1), 1e-300)
            p = float(f_distribution.sf(ratio, k, design.count / 2)) * trials * design.groups[member].scans
            if p > largest:
                worst, largest = member, p
        if largest <= LARGEST_P:
            break
        members.remove(worst)
    return chosen if len(members) == len(chosen.members) else evaluate(design, rules, members)


# Names that explain the readings almost as well as the one that won, with weights.


@dataclass(frozen=True)
class Alternative:
    """A name that explains the readings almost as well in place of a member, with its weight and correlation."""

    name: str
    weight: float
    group: int


#: Difference of the criterion within which a name belongs to the set of 99 %.
WITHIN = 9.2


def alternatives(design: Design, rules: Rules, chosen: Chosen, member: int) -> list[Alternative]:
    """Names that could take the place of a named member, with weights that add up to 1; itself first among equals.

    What belongs to the base model and is fitted where the data ask for it (the tilt of the tools) may be added to them.
    """
    rest = [g for g in chosen.members if g != member]
    allowed = [g for g in allowed_with(design, rules, rest) if design.groups[g].tier == "named"]
    bases = [[g] for g, item in enumerate(design.groups) if item.tier == "base" and g not in rest and design.size(g)]
    rough: dict[int, tuple[float, list[int]]] = {}
    for base in ([], *bases):
        known = evaluate(design, rules, [*rest, *base]).criterion
        for g, gain in zip(allowed, gains(design, remainder_of(design, [*rest, *base]), allowed), strict=True):
            value = known + penalty(design, rules, g, 0.0) - float(gain)
            if g not in rough or value < rough[g][0]:
                rough[g] = value, [*rest, *base]
    reference = rough[member][0] if member in rough else 0.0
    best: dict[str, int] = {}
    for g in sorted(rough, key=lambda g: rough[g][0]):
        if design.groups[g].name not in best and rough[g][0] - reference < 3 * WITHIN:
            best[design.groups[g].name] = g
    best[design.groups[member].name] = member
    values = {name: evaluate(design, rules, [*rough.get(g, (0.0, rest))[1], g]).criterion for name, g in best.items()}
    least = min(values.values())
    kept = {name: value for name, value in values.items() if value - least <= WITHIN}
    weights = {name: float(np.exp(-0.5 * (value - least))) for name, value in kept.items()}
    total = sum(weights.values())
    found = [Alternative(name, weight / total, best[name]) for name, weight in weights.items()]
    return sorted(found, key=lambda item: (-round(item.weight, 6), item.group != member))
