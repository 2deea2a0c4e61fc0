"""Search for the set of groups that best explains the whitened residual, and its alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import fdtrc

from compgen.data.csv_files import FloatArray
from compgen.diagnose.base_fit import BaseFit, orthonormal
from compgen.diagnose.groups import Group, Placed, Scanned
from compgen.diagnose.layout import IntArray
from compgen.diagnose.noise_model import Whitener

# The whitened problem with the base model projected out: products of columns, from which all sets are compared.
#
# Frisch-Waugh-Lovell: what the base model can also explain is invisible, so the part in the span of the base Jacobian
# is first removed from the residual and from the columns.


#: Directions of a group with less than this share left after projecting out the base model are dropped.
LEAST_VISIBLE = 1e-3
#: Columns smaller than this share of the largest column of their group are rounding errors.
ROUNDING = 1e-9
#: Groups of the base model with up to this many columns are charged as in the BIC; larger ones are curves, charged as a
#: random effect.
FEW = 3
#: Columns whitened at a time.
CHUNK = 128
#: Squared share of the raw columns of a group below which products of columns are too inaccurate for the remainder.
COARSE = 1e-4


@dataclass(frozen=True)
class GroupFacts:
    """Properties of all groups, (groups,): number of the name, tier, visible dimensions ...

    ``random``: charged as a random effect; this applies to unnamed groups and to curves of many columns.
    """

    name: IntArray
    tier: NDArray[np.object_]
    size: IntArray
    scans: IntArray
    slow: NDArray[np.bool_]
    predicts: NDArray[np.bool_]
    random: NDArray[np.bool_]


@dataclass(frozen=True)
class Design:
    """Groups in orthonormal coordinates of their visible part; K coordinates in total.

    The whitened columns of all groups are never stored. For products of a member with every coordinate, its direction
    is mapped back through the whitening once and multiplied by the raw columns, which are short or sparse.

    Parameters
    ----------
    groups : the groups.
    start : first coordinate of each group, (groups + 1,).
    maps : matrix (k, k_visible) of each group from its coordinates to the parameters of its columns.
    score : products with the residual, (K,).
    visible : share of each group left after projecting out the base model (RMS over its columns), (groups,).
    residual : whitened residual with the base model projected out, (N,).
    base : orthonormal columns of the whitened base model, (N, p).
    whiten : the whitener.
    fit : the base fit.
    kept : cache of earlier results: products of members, sets.
    """

    groups: tuple[Group, ...]
    start: IntArray
    maps: tuple[FloatArray, ...]
    score: FloatArray
    visible: FloatArray
    residual: FloatArray
    base: FloatArray
    whiten: Whitener
    fit: BaseFit
    kept: dict[Any, Any] = field(default_factory=dict)

    def rows(self, members: Sequence[int]) -> FloatArray:
        """Products of the coordinates of ``members`` with all coordinates, (r, K), computed on first request."""
        new = [g for g in members if g not in self.kept]
        if new:
            vectors = self.whiten.transposed(self.directions(new))
            summed: dict[int, FloatArray] = {}
            raw = np.vstack([source.products(vectors, summed) for source in self._sources])
            found = np.ascontiguousarray((self._mapping.T @ raw).T)
            ends = np.cumsum([0, *(self.size(g) for g in new)])
            self.kept.update({g: found[ends[k] : ends[k + 1]] for k, g in enumerate(new)})
        return np.vstack([self.kept[g] for g in members]) if members else np.zeros((0, len(self.score)))

    @cached_property
    def _sources(self) -> list[Placed | Scanned]:
        return list({id(group.source): group.source for group in self.groups}.values())

    @cached_property
    def _mapping(self) -> csr_array:
        """All maps as one sparse matrix (columns of all sources, K)."""
        first = dict(zip(map(id, self._sources), np.cumsum([0, *(s.width for s in self._sources)]), strict=False))
        values, rows, columns = [], [], []
        for group, mapping, at in zip(self.groups, self.maps, self.start, strict=False):
            row = first[id(group.source)] + (group.place.start if group.place else 0)
            values.append(mapping.ravel())
            rows.append(np.repeat(np.arange(row, row + mapping.shape[0]), mapping.shape[1]))
            columns.append(np.tile(np.arange(at, at + mapping.shape[1]), mapping.shape[0]))
        shape = (sum(source.width for source in self._sources), len(self.score))
        return csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)

    def directions(self, members: Sequence[int]) -> FloatArray:
        """Coordinates of the given groups as whitened columns, (N, r)."""
        if not members:
            return np.zeros((self.count, 0))
        columns = np.hstack([self.groups[g].columns for g in members])
        left = self.projected(columns, less=self.whiten.averages.T @ columns)
        ends = np.cumsum([0, *(len(self.maps[g]) for g in members)])
        return np.hstack([left[:, ends[k] : ends[k + 1]] @ self.maps[g] for k, g in enumerate(members)])

    def first(self, count: int) -> Design:
        """Return the design with only the first ``count`` groups."""
        size = int(self.start[count])
        return replace(
            self,
            groups=self.groups[:count],
            start=self.start[: count + 1],
            maps=self.maps[:count],
            score=self.score[:size],
            visible=self.visible[:count],
            kept={},
        )

    @property
    def total(self) -> float:
        """Whitened residual sum of squares of the base model."""
        return float(self.residual @ self.residual)

    @property
    def count(self) -> int:
        """Number of readings."""
        return len(self.residual)

    @property
    def freedom(self) -> int:
        """Number of readings minus unknowns of the base model."""
        return self.count - int(self.base.shape[1])

    @cached_property
    def facts(self) -> GroupFacts:
        """Properties of all groups that the search uses."""
        size, tier = np.diff(self.start), np.array([group.tier for group in self.groups], dtype=object)
        return GroupFacts(
            np.unique([group.name for group in self.groups], return_inverse=True)[1],
            tier,
            size,
            np.array([group.scans for group in self.groups]),
            np.array([group.slow for group in self.groups], dtype=bool),
            np.array([group.predicts for group in self.groups], dtype=bool),
            (tier == "generic") | ((tier == "base") & (size > FEW)),
        )

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

    def projected(self, columns: FloatArray, *, less: FloatArray | None = None) -> FloatArray:
        """Whiten columns (n, k) and project out the base model.

        ``less`` (channels, k): what is first subtracted on each channel, e.g. the mean, which a dead length would absorb.
        """
        white = self.whiten(columns, less=less)
        return np.asarray(white - self.base @ (self.base.T @ white))


def design_of(fit: BaseFit, groups: Sequence[Group], whiten: Whitener) -> Design:
    """Whiten, project and reduce all groups, a few sources of columns at a time.

    Products with the base model and the residual are formed with these mapped back through the whitening, because raw
    columns are short or sparse; whitened columns are needed for the products within a group only.
    """
    base = orthonormal(whiten(fit.jacobian))
    white = whiten(fit.residual_mm)
    residual = white - base @ (base.T @ white)
    size = base.shape[1]
    owners: dict[int, list[int]] = {}
    for g, group in enumerate(groups):
        owners.setdefault(id(group.source), []).append(g)
    sources = [groups[own[0]].source for own in owners.values()]
    vectors = np.hstack([whiten.transposed(np.column_stack([base, residual])), whiten.averages])
    summed: dict[int, FloatArray] = {}
    each = [source.products(vectors, summed) for source in sources]
    products = np.vstack([np.zeros((0, vectors.shape[1])), *each])
    constants = vectors[:, : size + 1].T @ (whiten.averages > 0.0)
    del vectors, summed  # free the memory before columns are whitened
    chunks: list[list[list[int]]] = []
    widths: list[int] = []
    for own, source in zip(owners.values(), sources, strict=True):
        if not chunks or widths[-1] + source.width > CHUNK:
            chunks.append([])
            widths.append(0)
        chunks[-1].append(own)
        widths[-1] += source.width
    reduced: dict[int, tuple[FloatArray, FloatArray, float]] = {}
    of_white = float(residual @ residual) / max(float(fit.residual_mm @ fit.residual_mm), 1e-300)
    space = np.empty((2, len(residual) * max(widths, default=0)))
    for chunk, width in zip(chunks, widths, strict=True):
        # less the mean on each channel, which a dead length would absorb
        first, products = products[:width], products[width:]
        mean = first[:, size + 1 :].T
        seen = first[:, : size + 1].T - constants @ mean
        seen, score, at = seen[:-1], seen[-1], 0
        columns, tall = space[:, : len(residual) * width].reshape(2, -1, width)
        for of in chunk:
            source = groups[of[0]].source
            source.columns(columns[:, at : at + source.width])
            at += source.width
        size_raw = np.einsum("nk,nk->k", columns, columns)
        whiten(columns, less=mean, out=tall)
        # a column that is constant on each channel (an axis that stood still) leaves its rounding behind
        nothing = np.einsum("nk,nk->k", tall, tall) < ROUNDING**2 * size_raw * of_white
        tall[:, nothing], seen[:, nothing] = 0.0, 0.0
        whole = np.einsum("nk,nk->k", tall, tall)
        left = np.maximum(whole - np.einsum("pk,pk->k", seen, seen), 0.0)
        shares, at = np.sqrt(left / np.where(whole > 0.0, whole, np.inf)), 0
        for of in chunk:
            for g in of:
                where = range(at, at + groups[g].source.width)[groups[g].place or slice(None)]
                mine = slice(where.start, where.stop)
                if len(where) == 1:
                    share = float(shares[where[0]])
                    mapping = np.full((1, int(share > LEAST_VISIBLE)), 1.0) / np.sqrt(left[mine])
                else:
                    mapping, share = _reduced(tall[:, mine], seen[:, mine], base)
                reduced[g] = mapping, mapping.T @ score[mine], share
            at += groups[of[0]].source.width
    maps, scores, visible = zip(*(reduced[g] for g in range(len(groups))), strict=True) if groups else ((), (), ())
    start = np.cumsum([0, *(mapping.shape[1] for mapping in maps)]).astype(np.int64)
    stacked = np.concatenate(scores) if scores else np.zeros(0)
    return Design(tuple(groups), start, tuple(maps), stacked, np.array(visible), residual, base, whiten, fit)


def _reduced(raw: FloatArray, seen: FloatArray, base: FloatArray) -> tuple[FloatArray, float]:
    """Map (k, m) from orthonormal visible directions to the parameters, and the visible share.

    ``raw`` (N, k > 1) are whitened columns, ``seen`` (p, k) their products with the base model. The raw columns are
    orthonormalised first; the eigenvalues of the remainder are then squared shares.
    """
    whole = raw.T @ raw
    left = whole - seen.T @ seen
    norm = np.sqrt(np.diag(whole))
    if not norm.any():
        return np.zeros((len(whole), 0)), 0.0
    norm = np.where(norm > ROUNDING * norm.max(), norm, np.inf)
    square, vectors = np.linalg.eigh(whole / np.outer(norm, norm))
    kept = square > 1e-8 * square[-1]
    turn = vectors[:, kept] / np.sqrt(square[kept]) / norm[:, None]
    if square[kept].min() < COARSE:
        exact = (raw - base @ seen) @ turn
        share2, axes = np.linalg.eigh(exact.T @ exact)
    else:
        share2, axes = np.linalg.eigh(turn.T @ left @ turn)
    visible = share2 > LEAST_VISIBLE**2
    share = np.sum(np.diag(left) / norm**2) / np.sum(np.diag(whole) / norm**2)
    return turn @ (axes[:, visible] / np.sqrt(share2[visible])), float(np.sqrt(max(share, 0.0)))


# Search for the set of groups that best explains the residual: forward beam, drops and swaps, then pruning.
#
# Criterion: -chi2 plus a penalty for each member. Named effects are charged as in the extended BIC (Chen and Chen
# 2008); generic groups as a random effect with optimised prior variance, k + k log(chi2/k), plus a handicap.


#: Handicap of a generic group, and of one that depends on time or temperature.
HANDICAP, SLOW_HANDICAP = 21.0, 27.0
MOST_MEMBERS = 6
BEAM, ADDITIONS = 2, 3
#: Criteria that agree to this many decimals are equal: of exact aliases the first in the catalogue is taken, whatever the
#: rounding errors.
DECIMALS = 4
#: Largest p-value of a member, corrected for the number of groups and scan positions.
LARGEST_P = 1e-3
#: Directions with less than this (squared) left after projecting out the other members are ignored.
LEAST_SQUARE = 1e-6
#: With a determinant above this there is no such direction: the eigenvalues are at most 1, so none is below it.
SAFE = 1e-5


@dataclass(frozen=True)
class Rules:
    """Limits of the search.

    Parameters
    ----------
    named : number of named effects.
    most_named, most_members : maximum number of named effects, and of groups in total.
    predicting : whether groups that cannot predict other readings (an offset of each line) are excluded.
    generic : whether unnamed groups may be chosen.
    trials : number of distinct groups that are compared.
    """

    named: int
    most_named: int = 4
    most_members: int = MOST_MEMBERS
    predicting: bool = False
    generic: bool = True
    trials: int = 1


@dataclass(frozen=True)
class Chosen:
    """A set of groups: members (named first), criterion, chi-square of the set, and gain of each member in turn."""

    members: tuple[int, ...]
    criterion: float
    chi2: float
    gains: tuple[float, ...]


def rules_of(design: Design, most_named: int) -> Rules:
    """Return the rules for a design."""
    names = {group.name for group in design.groups if group.tier == "named"}
    return Rules(max(len(names), 1), most_named, trials=len({group.name for group in design.groups}))


def penalties(design: Design, rules: Rules, groups: Sequence[int], chi2: FloatArray) -> FloatArray:
    """Penalty of each of the groups that gain ``chi2``, (m,)."""
    facts = design.facts
    tier, k = facts.tier[groups], facts.size[groups]
    plain = k * np.log(design.count)
    named = plain + 2 * np.log(rules.named) + 2 * np.log(facts.scans[groups])
    handicap = np.where(facts.slow[groups], SLOW_HANDICAP, HANDICAP)
    random = k + k * np.log(np.maximum(chi2 / np.maximum(k, 1), 1.0)) + handicap
    return np.where(facts.random[groups], random, np.where(tier == "named", named, plain))


@dataclass(frozen=True)
class Remainder:
    """What remains of all groups after projecting out a set: ``cross`` (r, K) and ``score`` (K,)."""

    cross: FloatArray
    score: FloatArray
    chi2: float


def remainder_of(design: Design, members: Sequence[int]) -> Remainder:
    """Project a set of groups out of all others."""
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


def explained(design: Design, members: Sequence[int]) -> float:
    """chi-square of a set."""
    key = "explained", frozenset(members)
    if key not in design.kept:
        index = design.coordinates(members)
        square, vectors = np.linalg.eigh(design.rows(members)[:, index])
        kept = square > LEAST_SQUARE
        design.kept[key] = float(np.sum((vectors[:, kept].T @ design.score[index]) ** 2 / square[kept]))
    return float(design.kept[key])


def gains(design: Design, left: Remainder, candidates: Sequence[int]) -> FloatArray:
    """Gain in chi-square of each of the groups ``candidates`` when added to the set.

    s' (I - c'c)^-1 s with the products c (r, k) of a group and the set, and the scores s of the group, for all groups
    of one size together; by (I - cc')^-1 if the set is smaller than the group.
    """
    result = np.zeros(len(candidates))
    sizes = design.facts.size[list(candidates)]
    first = design.start[:-1][np.asarray(candidates, dtype=np.int64)]
    for k in np.unique(sizes[sizes > 0]).tolist():
        alike = np.flatnonzero(sizes == k)
        at = first[alike][:, None] + np.arange(k)
        score, cross = left.score[at], left.cross[:, at].transpose(1, 0, 2)
        found = np.einsum("gk,gk->g", score, score)
        if k == 1:
            square = 1.0 - np.einsum("grk,grk->g", cross, cross)
            result[alike] = np.where(square > LEAST_SQUARE, found / np.maximum(square, LEAST_SQUARE), 0.0)
            continue
        short = cross.shape[1] < k
        inner = cross @ cross.transpose(0, 2, 1) if short else cross.transpose(0, 2, 1) @ cross
        seen = np.einsum("grk,gk->gr", cross, score) if short else score
        apart = np.eye(inner.shape[1]) - inner
        # directions also contained in the set carry no information: if there may be any, remove them group by group
        with np.errstate(all="ignore"):
            safe = np.abs(np.linalg.det(apart)) > SAFE
        if safe.any():
            solved = np.linalg.solve(apart[safe], seen[safe][:, :, None])[:, :, 0]
            gain = np.einsum("gr,gr->g", seen[safe], solved)
            result[alike[safe]] = found[safe] + gain if short else gain
        for g in np.flatnonzero(~safe).tolist():
            values, vectors = np.linalg.eigh(np.eye(k) - cross[g].T @ cross[g])
            kept = values > LEAST_SQUARE
            result[alike[g]] = float(np.sum((vectors[:, kept].T @ score[g]) ** 2 / values[kept]))
    return result


def evaluate(design: Design, rules: Rules, members: Sequence[int]) -> Chosen:
    """Evaluate the criterion of a set; named members enter first."""
    facts = design.facts
    rank = {"base": 0, "named": 1, "generic": 2}
    order = sorted(members, key=lambda g: (facts.random[g], rank[design.groups[g].tier]))
    key = rules.named, tuple(order)
    if key not in design.kept:
        fixed = [g for g in order if not facts.random[g]]
        totals = [explained(design, order[:k]) for k in range(len(fixed), len(order) + 1)]
        found = [gain_of(design, [f for f in fixed if f != g], g) for g in fixed] + np.diff(totals).tolist()
        costs = penalties(design, rules, order, np.array(found))
        design.kept[key] = Chosen(tuple(order), float(costs.sum()) - totals[-1], totals[-1], tuple(found))
    chosen: Chosen = design.kept[key]
    return chosen


def gain_of(design: Design, others: Sequence[int], group: int) -> float:
    """Gain in chi-square of a group when added to others."""
    return explained(design, [*others, group]) - explained(design, others)


def allowed_with(design: Design, rules: Rules, members: Sequence[int]) -> list[int]:
    """Groups that may be added: different name, visible, allowed by the rules, and within the maximum numbers."""
    facts = design.facts
    allowed = (facts.size > 0) & ~np.isin(facts.name, facts.name[list(members)])
    if rules.predicting:
        allowed &= facts.predicts
    if np.sum(facts.tier[list(members)] == "named") >= rules.most_named:
        allowed &= facts.tier != "named"
    if not rules.generic:
        allowed &= facts.tier != "generic"
    if np.sum(facts.tier[list(members)] != "base") >= rules.most_members:
        allowed &= facts.tier == "base"
    return np.flatnonzero(allowed).tolist()


def _best_additions(design: Design, rules: Rules, members: Sequence[int], most: int) -> list[Chosen]:
    """The sets with one more group that decrease the criterion most."""
    key = "additions", rules, frozenset(members)
    if key not in design.kept:
        allowed = allowed_with(design, rules, members)
        gained = gains(design, remainder_of(design, members), allowed)
        merit = gained - penalties(design, rules, allowed, gained)
        first = np.argsort(-np.round(merit, DECIMALS), kind="stable")[: 4 * max(ADDITIONS, most)]
        design.kept[key] = [(allowed[k], float(merit[k])) for k in first]
    best: dict[str, int] = {}
    for g, merit in design.kept[key][: 4 * most]:
        if merit <= -10.0 or len(best) >= most:
            break
        best.setdefault(design.groups[g].name, g)
    design.rows(list(best.values()))
    return [evaluate(design, rules, [*members, g]) for g in best.values()]


def search(design: Design, rules: Rules, start: Sequence[int] = ()) -> Chosen:
    """Find the set with the smallest criterion; then drop members that are not significant.

    A free offset per line absorbs everything that is constant in a line, so effects that it absorbed first cannot enter
    later. If such a group wins, the search is repeated without such groups.
    """
    found = _forward(design, rules, start)
    rest = [g for g in found.members if design.groups[g].predicts]
    if len(rest) < len(found.members):
        other = _forward(design, replace(rules, predicting=True), rest)
        found = other if other.criterion < found.criterion else found
    return with_names(design, rules, found)


def _forward(design: Design, rules: Rules, start: Sequence[int]) -> Chosen:
    """Forward beam from ``start``, drops and swaps, then pruning."""
    best = evaluate(design, rules, start)
    beam = [best]
    while True:
        found: dict[frozenset[int], Chosen] = {}
        for item in beam:
            for chosen in _best_additions(design, rules, item.members, ADDITIONS):
                found[frozenset(chosen.members)] = chosen
        if not found:
            break
        beam = sorted(found.values(), key=lambda item: round(item.criterion, DECIMALS))[:BEAM]
        beam = [_improved(design, rules, item) for item in beam]
        if beam[0].criterion >= best.criterion - 1e-6:
            break
        best = min(beam, key=lambda item: round(item.criterion, DECIMALS))
    return prune(design, rules, _improved(design, rules, best))


def _improved(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop and swap members as long as that decreases the criterion."""
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


#: A named effect that explains this share of what a generic group in its covariates explains replaces it.
SAME_LAW = 0.93


def with_names(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Replace generic groups by names with the same law and less freedom, whose shape is not quite exact."""
    for generic in [g for g in chosen.members if design.groups[g].tier == "generic"]:
        rest = [g for g in chosen.members if g != generic]
        group, related = design.groups[generic], []
        own = plain_covariates(group.covariates) - {"x", "y", "z"}
        for g in allowed_with(design, rules, rest):
            # named effects in the covariates of the generic group; offsets of lines contain all covariates
            item = design.groups[g]
            same = not group.predicts or (own and own <= plain_covariates(item.covariates))
            if item.tier == "named" and same:
                related.append(g)
        if not related:
            continue
        gained = gains(design, remainder_of(design, rest), related)
        best = int(np.argmax(gained))
        if gained[best] > SAME_LAW * gain_of(design, rest, generic):
            chosen = evaluate(design, rules, [*rest, related[best]])
    return chosen


def plain_covariates(names: tuple[str, ...]) -> set[str]:
    """Covariates of a card or generic term in uniform spelling: ``x``, ``approach_x``, ``temperature``, ``time``."""
    found = set()
    for name in names:
        word = (
            name.removesuffix("_mm_min").removesuffix("_mm").removesuffix("_s").removesuffix("_c").removesuffix("_kg")
        )
        found.add("temperature" if word.startswith("temp") else word)
    return found


def prune(design: Design, rules: Rules, chosen: Chosen) -> Chosen:
    """Drop the least significant member as long as its corrected p-value is too large."""
    members = list(chosen.members)
    while members:
        left = design.total - explained(design, members)
        freedom = design.freedom - len(design.coordinates(members))
        worst, largest = -1, 0.0
        for member in members:
            if design.groups[member].tier == "base":
                continue
            k = max(design.size(member), 1)
            gain = gain_of(design, [g for g in members if g != member], member)
            ratio = gain / k / max(left / max(freedom, 1), 1e-300)
            p = float(fdtrc(k, design.count / 2, ratio)) * rules.trials * design.groups[member].scans
            if p > largest:
                worst, largest = member, p
        if largest <= LARGEST_P:
            break
        members.remove(worst)
    return chosen if len(members) == len(chosen.members) else evaluate(design, rules, members)


# Names that explain the readings almost as well as the winner, with weights.


@dataclass(frozen=True)
class Alternative:
    """A name that explains the readings almost as well as a member, with its weight and correlation."""

    name: str
    weight: float
    group: int


#: Difference of the criterion within which a name belongs to the 99 % set.
WITHIN = 9.2


def alternatives(design: Design, rules: Rules, chosen: Chosen, member: int) -> list[Alternative]:
    """Names that could replace a named member, with weights that sum to 1; the member first among equals.

    Base groups that are fitted only if the data require them (the tilt of the tools) may be added to these names.
    """
    rest = [g for g in chosen.members if g != member]
    allowed = [g for g in allowed_with(design, rules, rest) if design.groups[g].tier == "named"]
    bases = [[g] for g, item in enumerate(design.groups) if item.tier == "base" and g not in rest and design.size(g)]
    rough: dict[int, tuple[float, list[int]]] = {}
    for base in ([], *bases):
        known = evaluate(design, rules, [*rest, *base]).criterion
        gained = gains(design, remainder_of(design, [*rest, *base]), allowed)
        values = known + penalties(design, rules, allowed, np.zeros(len(allowed))) - gained
        for g, value in zip(allowed, values.tolist(), strict=True):
            if g not in rough or value < rough[g][0]:
                rough[g] = value, [*rest, *base]
    reference = rough[member][0] if member in rough else 0.0
    best: dict[str, int] = {}
    for g in sorted(rough, key=lambda g: rough[g][0]):
        if design.groups[g].name not in best and rough[g][0] - reference < 3 * WITHIN:
            best[design.groups[g].name] = g
    best[design.groups[member].name] = member
    criteria = {name: evaluate(design, rules, [*rough.get(g, (0.0, rest))[1], g]).criterion for name, g in best.items()}
    least = min(criteria.values())
    kept = {name: value for name, value in criteria.items() if value - least <= WITHIN}
    weights = {name: float(np.exp(-0.5 * (value - least))) for name, value in kept.items()}
    total = sum(weights.values())
    found = [Alternative(name, weight / total, best[name]) for name, weight in weights.items()]
    return sorted(found, key=lambda item: (-round(item.weight, 6), item.group != member))
