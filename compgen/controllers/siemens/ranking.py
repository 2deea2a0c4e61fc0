"""Which CEC tables to keep where a control has too few: those that leave the least error over the volume.

Every table moves one axis only, so that the axes can be looked at one by one: for each set of terms of an axis the number
of tables that it takes and the squares that it takes out of the wanted correction (least squares over the volume). The
best sets of the three axes together within the number of tables are found exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import lstsq

from compgen.controllers.base import Term
from compgen.controllers.siemens.products import MULT_MODES, IntArray
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.model.grid import volume_sample
from compgen.model.volumetric import tool_of, volumetric_error

#: Points over the volume at which sets of tables are compared.
_MOST_POINTS = 6000
#: Directions of the normal matrix (unit diagonal) below this are not determined.
_UNDETERMINED = 1e-9
#: Terms whose natural values move the tool by less than this are no tables.
_NOTHING_MM = 0.5e-6
#: Tables of another set than the best one are as good if no more than this share above its error stays.
_AS_GOOD = 1.1
#: What stays uncorrected by less than this is not worth a word.
_NAMED_FROM_MM = 0.01 * MM_PER_UM


@dataclass(frozen=True)
class Choice:
    """Terms that the tables can hold, and the others.

    Parameters
    ----------
    kept : terms in their order.
    dropped : (name, mm): for each term that has no room what it would take out (rms over the volume) beside the kept.
    tables, allowed : tables that the kept terms take, and that there are (None: not limited).
    wanted : tables that all terms would take.
    left_mm : rms over the volume that all terms would take out and the kept ones do not.
    beside : terms of tables of another kind, which are there in any case.
    """

    kept: list[Term]
    dropped: tuple[tuple[str, float], ...]
    tables: int
    allowed: int | None
    wanted: int
    left_mm: float
    beside: tuple[Term, ...] = ()

    def statements(self) -> list[str]:
        """Say what is left out, largest first; nothing if everything has room."""
        if not self.dropped:
            return []
        return [
            f"{self.wanted} tables would be needed, {self.allowed} may be used: not corrected are "
            f"{_named(self.dropped) or 'tables of less than 0.01 um'}; together they leave "
            f"{self.left_mm / MM_PER_UM:.2f} um rms over the volume (first order)"
        ]


def table_count(terms: Sequence[Term], mode: str) -> int:
    """Return how many tables a set of terms takes: ordinary ones, those that only hold folds, angles, levers."""
    first_stays, multiplier_stays = MULT_MODES[mode]
    ordinary, levers, angles = set(), set(), 0
    for term in terms:
        part = term.carrier[0]
        if part.lever is None:
            ordinary.add((part.output, term.axis))
            continue
        angles += 1
        levers.add((part.output, part.lever))
        ordinary |= {(part.output, term.axis)} if first_stays else set()
        ordinary |= {(part.output, part.lever)} if multiplier_stays else set()
    return len(ordinary) + len(levers) + angles


def chosen_terms(
    machine: Machine,
    errors: ErrorTable,
    terms: Sequence[Term],
    mode: str,
    allowed: int | None,
    beside: Sequence[Term] = (),
) -> Choice:
    """Return the terms that ``allowed`` tables can hold and that leave the least error.

    Parameters
    ----------
    machine, errors : what is to be corrected; its work zone counts more.
    terms : everything that the control could hold.
    mode : reading of products, a key of ``MULT_MODES``.
    allowed : number of tables, None: all of them.
    beside : terms that tables of another kind hold in any case.
    """
    wanted = table_count(terms, mode)
    if allowed is None or wanted <= allowed:
        return Choice(list(terms), (), wanted, allowed, wanted, 0.0)
    gains = [_Gains.of(machine, errors, terms, beside, output) for output in range(3)]
    picked = _best_sets(gains, mode, allowed)
    names = {term.name for part in picked for term in part} or {terms[0].name}
    kept = [term for term in terms if term.name in names]
    left = sum(gain.of_all - gain.taken(part) for gain, part in zip(gains, picked, strict=True))
    dropped = [item for gain, part in zip(gains, picked, strict=True) for item in gain.missed(part)]
    return Choice(
        kept, tuple(dropped), table_count(kept, mode), allowed, wanted, float(np.sqrt(max(left, 0.0))), tuple(beside)
    )


def without_products(
    machine: Machine, errors: ErrorTable, terms: Sequence[Term], beside: Sequence[Term] = ()
) -> list[str]:
    """Say what stays uncorrected because no products are written: their names, and the rms over the volume.

    ``terms`` are the ordinary ones and the products, ``beside`` as in :func:`chosen_terms`. Nothing if it is nothing.
    """
    ordinary = [term for term in terms if term.carrier[0].lever is None]
    gains = [_Gains.of(machine, errors, terms, beside, output) for output in range(3)]
    own = [[term for term in gain.terms if term in ordinary] for gain in gains]
    left = sum(gain.of_all - gain.taken(part) for gain, part in zip(gains, own, strict=True))
    missed = [item for gain, part in zip(gains, own, strict=True) for item in gain.missed(part)]
    named = _named(missed)
    if not named:
        return []
    return [
        f"no products of tables are written: not corrected are {named}; together they leave "
        f"{np.sqrt(max(left, 0.0)) / MM_PER_UM:.2f} um rms over the volume (first order)"
    ]


def _named(missed: Sequence[tuple[str, float]]) -> str:
    """Names with their rms in um, the largest first; what is below 0.01 um is left out."""
    return ", ".join(
        f"{name} ({size / MM_PER_UM:.2f} um rms)"
        for name, size in sorted(missed, key=lambda item: -item[1])
        if size >= _NAMED_FROM_MM
    )


def terms_of_tables(
    machine: Machine, errors: ErrorTable, terms: Sequence[Term], mode: str, choice: Choice, names: set[str]
) -> list[Term]:
    """Return the terms ``names`` that given tables hold if they are as good as the chosen ones, else the chosen ones.

    Two sets may leave nearly the same error, so that slightly different errors prefer another one.
    """
    own = [term for term in terms if term.name in names]
    if not choice.dropped or not own or table_count(own, mode) > (choice.allowed or 0):
        return choice.kept
    gains = [_Gains.of(machine, errors, terms, choice.beside, output) for output in range(3)]
    left = [
        sum(
            gain.wanted - gain.taken([term for term in part if term.carrier[0].output == k])
            for k, gain in enumerate(gains)
        )
        for part in (own, choice.kept)
    ]
    return own if left[0] <= _AS_GOOD**2 * left[1] else choice.kept


@dataclass(frozen=True)
class _Gains:
    """Least squares of the terms of one output axis; ``taken`` is in mm^2, the mean over the volume.

    ``beside`` are terms that are there in any case and take no table; ``wanted`` is the square of what is to be taken out.
    """

    terms: tuple[Term, ...]
    beside: tuple[Term, ...]
    normal: FloatArray
    right: FloatArray
    wanted: float
    columns: Mapping[str, IntArray]

    @classmethod
    def of(
        cls, machine: Machine, errors: ErrorTable, terms: Sequence[Term], beside: Sequence[Term], output: int
    ) -> _Gains:
        nodes = tuple(
            np.unique(
                np.concatenate(
                    [machine.axes[axis].nodes_mm, *(t.nodes_mm for t in [*terms, *beside] if t.axis == axis)]
                )
            )
            for axis in range(3)
        )
        sample = volume_sample(machine, nodes, _MOST_POINTS, machine.emphasis)
        tool_mm, weight = tool_of(machine, None), sample.weight / np.sum(sample.weight)
        wanted = -volumetric_error(machine, errors, sample.position_mm)[:, output]
        own = [term for term in terms if term.carrier[0].output == output]
        own = [term for term in own if _moves(machine, term)]
        given = [term for term in beside if term.carrier[0].output == output]
        parts: list[FloatArray] = []
        columns: dict[str, IntArray] = {}
        first = 0
        for term in [*own, *given]:
            carrier = term.carrier_field(sample.position_mm, tool_mm)[:, output]
            parts.append(term.curve_matrix(sample.position_mm) * carrier[:, None])
            columns[term.name] = np.arange(first, first + len(term.nodes_mm))
            first += len(term.nodes_mm)
        design = np.hstack(parts) if parts else np.zeros((len(wanted), 0))
        scale = 1.0 / np.maximum(np.sqrt(np.sum(weight[:, None] * design**2, axis=0)), 1e-12)
        design = design * scale
        normal, right = design.T @ (weight[:, None] * design), design.T @ (weight * wanted)
        return cls(tuple(own), tuple(given), normal, right, float(weight @ wanted**2), columns)

    @property
    def of_all(self) -> float:
        """What all terms take out, mm^2."""
        return self.taken(self.terms)

    def taken(self, terms: Sequence[Term]) -> float:
        """Squares that a set of terms takes out, mm^2."""
        held = [term for term in (*terms, *self.beside) if term.name in self.columns]
        if not held:
            return 0.0
        where = np.concatenate([self.columns[term.name] for term in held])
        solution = lstsq(self.normal[np.ix_(where, where)], self.right[where], cond=_UNDETERMINED)[0]
        return float(self.right[where] @ solution)

    def missed(self, kept: Sequence[Term]) -> list[tuple[str, float]]:
        """Return (name, rms mm) of the terms beside the kept ones: what each would take out in addition."""
        own = self.taken(kept)
        return [
            (term.name, float(np.sqrt(max(self.taken([*kept, term]) - own, 0.0))))
            for term in self.terms
            if term not in kept
        ]

    def by_count(self, mode: str, allowed: int) -> dict[int, tuple[float, tuple[Term, ...]]]:
        """Return the best set for every number of tables: (mm^2, terms)."""
        best: dict[int, tuple[float, tuple[Term, ...]]] = {0: (self.taken(()), ())}
        for size in range(1, len(self.terms) + 1):
            for part in combinations(self.terms, size):
                count = table_count(part, mode)
                if count > allowed:
                    continue
                gain = self.taken(part)
                if count not in best or gain > best[count][0]:
                    best[count] = gain, part
        return best


def _moves(machine: Machine, term: Term) -> bool:
    """Whether the natural values of a term are more than the last decimal."""
    lever = term.carrier[0].lever
    span = 1.0 if lever is None else machine.axes[lever].length_mm
    return float(np.max(np.abs(term.start), initial=0.0)) * span > _NOTHING_MM


def _best_sets(gains: Sequence[_Gains], mode: str, allowed: int) -> list[tuple[Term, ...]]:
    """Return the best set of each axis such that all together take no more than ``allowed`` tables; one at least."""
    best: dict[int, tuple[float, list[tuple[Term, ...]]]] = {0: (0.0, [])}
    for gain in gains:
        options = gain.by_count(mode, allowed)
        joined: dict[int, tuple[float, list[tuple[Term, ...]]]] = {}
        for used, (so_far, parts) in best.items():
            for count, (value, part) in options.items():
                total = used + count
                if total <= allowed and (total not in joined or so_far + value > joined[total][0]):
                    joined[total] = so_far + value, [*parts, part]
        best = joined
    return max(best.values(), key=lambda item: item[0])[1]
