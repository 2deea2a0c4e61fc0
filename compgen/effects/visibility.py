"""What a set of readings can see of each effect: the part that errors, stations and dead lengths cannot imitate.

For the base Jacobian J and the columns G of an effect, the visible part is (I - Q Q') G with Q an orthonormal basis of J
(Frisch-Waugh-Lovell). Everything here follows from the Gram matrix of [J, G1, G2, ...], which can be summed up in pieces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.effects.base import Card

#: Eigenvalue of a Gram matrix with unit diagonal below which a direction counts as absent.
ZERO = 1e-10
#: Visible share of a direction, squared, below which it is left out of comparisons.
SEEN = 1e-4
#: An effect whose visible fraction is below this can not be confirmed.
INVISIBLE = 0.05
#: Canonical correlation above which two effects cannot be told apart in practice.
ALIKE = 0.9


@dataclass(frozen=True)
class VisiblePart:
    """Visible part of one effect.

    Parameters
    ----------
    fraction : root mean square over its directions of the share that is left after projection, 0 ... 1.
    least, most : share of the least and of the most visible direction.
    basis : orthonormal visible directions in terms of all columns of effects, (columns, r).
    """

    fraction: float
    least: float
    most: float
    basis: FloatArray


@dataclass(frozen=True)
class Pair:
    """Two effects that look alike: largest canonical correlation, and how many directions exceed 0.9 of how many."""

    names: tuple[str, str]
    correlation: float
    shared: int
    directions: int


def projected_gram(gram: FloatArray, base: int) -> FloatArray:
    """Gram matrix of the effects' columns less what the first ``base`` columns can imitate."""
    scale = np.sqrt(np.maximum(np.diagonal(gram), np.finfo(float).tiny))
    unit = gram / scale[:, None] / scale
    values, vectors = np.linalg.eigh(unit[:base, :base])
    kept = values > ZERO * max(float(values[-1]), 1.0) if base else np.zeros(0, dtype=bool)
    reach = (vectors[:, kept] / np.sqrt(values[kept])).T @ unit[:base, base:]
    return np.asarray((unit[base:, base:] - reach.T @ reach) * scale[base:, None] * scale[base:])


def visible_parts(gram: FloatArray, base: int, columns: Mapping[str, slice]) -> dict[str, VisiblePart]:
    """Return the visible part of each effect.

    Parameters
    ----------
    gram : Gram matrix of [J, G1, G2, ...], each reading divided by its standard uncertainty, (base + k, base + k).
    base : number of columns of J.
    columns : columns of each effect, counted from the first one after J.
    """
    seen = projected_gram(gram, base)
    return {name: _part(gram[base:, base:], seen, where) for name, where in columns.items()}


def _part(own: FloatArray, seen: FloatArray, where: slice) -> VisiblePart:
    block = own[where, where]
    scale = np.sqrt(np.maximum(np.diagonal(block), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(block / scale[:, None] / scale)
    kept = values > ZERO * values[-1]
    whole = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]  # orthonormal directions of the effect itself
    shares, turned = np.linalg.eigh(whole.T @ seen[where, where] @ whole)
    shares = np.clip(shares, 0.0, 1.0)
    good = shares > SEEN
    basis = np.zeros((len(own), int(good.sum())))
    basis[where] = (whole @ turned[:, good]) / np.sqrt(shares[good])
    return VisiblePart(float(np.sqrt(shares.mean())), float(np.sqrt(shares[0])), float(np.sqrt(shares[-1])), basis)


def alike_pairs(gram: FloatArray, base: int, parts: Mapping[str, VisiblePart]) -> list[Pair]:
    """Return the pairs of visible effects with a canonical correlation above 0.9, the most alike first."""
    seen = projected_gram(gram, base)
    names = [name for name, part in parts.items() if part.basis.shape[1]]
    found = []
    for k, first in enumerate(names):
        reach = seen @ parts[first].basis
        for second in names[k + 1 :]:
            correlations = np.linalg.svd(reach.T @ parts[second].basis, compute_uv=False)
            if correlations[0] > ALIKE:
                shared = int(np.count_nonzero(correlations > ALIKE))
                found.append(Pair((first, second), min(float(correlations[0]), 1.0), shared, len(correlations)))
    return sorted(found, key=lambda pair: -pair.correlation)


def separating(first: Card, second: Card) -> str:
    """The smallest further measurement that separates two effects, from the card that names the other one."""
    for card, other in ((first, second), (second, first)):
        if any(other.name.startswith(alias) for alias in card.aliases) and card.breaker:
            return card.breaker
    return first.breaker or second.breaker
