"""What the data do not determine: numerical rank, unobservable combinations in words, nodes without data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.errors import UndeterminedError
from compgen.identify.adjust.solver import Factor, factorise
from compgen.identify.adjust.unknowns import ErrorParameters, IntArray

#: Eigenvalues of the normal matrix with unit diagonal below this count as zero. A determined problem stays above
#: about 1e-7, an undetermined direction falls to 1e-14: there is a wide gap.
ZERO_EIGENVALUE = 1e-11
#: Reciprocal condition of the scaled normal matrix below which the rank is looked at in detail.
SUSPICIOUS_RCOND = 1e-10
#: Unknowns without data that a message names.
MOST_NAMED = 12


@dataclass(frozen=True)
class Rank:
    """Numerical rank of a problem.

    ``undetermined`` marks the unknowns (size,) that take part in a direction without data, ``combinations`` names
    these directions, ``condition`` is the ratio of the kept eigenvalues of the scaled normal matrix.
    """

    rank: int
    size: int
    condition: float
    undetermined: NDArray[np.bool_]
    combinations: tuple[str, ...]


def determined_factor(
    matrix: FloatArray, names: Callable[[], list[str]], what: str, suspicious: float = SUSPICIOUS_RCOND
) -> tuple[Factor, Rank | None]:
    """Return the factor of a normal matrix (size, size), and its rank where the condition gave reason to look at it.

    ``names`` makes the names of the unknowns, ``what`` begins the message.

    Raises
    ------
    UndeterminedError
        if the matrix is singular; it names the combinations that no data determine.
    """
    factor = None
    try:
        factor = factorise(matrix)
        if factor.rcond > suspicious:
            return factor, None
    except LinAlgError:
        pass
    rank = describe_rank(matrix, names())
    if factor is None or rank.rank < rank.size:
        message = f"{what} determine {rank.rank} of {rank.size} unknowns; " + "; ".join(rank.combinations[:8])
        raise UndeterminedError(message, list(rank.combinations))
    return factor, rank


def describe_rank(matrix: FloatArray, names: list[str], zero: float = ZERO_EIGENVALUE) -> Rank:
    """Analyse a normal matrix (size, size) whose unknowns have ``names``; eigenvalues below ``zero`` count as none."""
    diagonal = np.diag(matrix)
    empty = diagonal <= 1e-14 * np.median(diagonal[diagonal > 0])
    scale = 1.0 / np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = np.where(np.outer(empty, empty), 0.0, matrix * np.outer(scale, scale))
    eigenvalues, vectors = np.linalg.eigh(scaled)
    null = eigenvalues < zero
    kept = eigenvalues[~null]
    undetermined = np.sqrt(np.sum(vectors[:, null] ** 2, axis=1)) > 1e-4
    texts = []
    without = [names[k] for k in np.flatnonzero(empty)]
    if without:
        more = f" and {len(without) - MOST_NAMED} more" if len(without) > MOST_NAMED else ""
        texts.append(f"no data at all for: {', '.join(without[:MOST_NAMED])}{more}")
    # each direction without data is named by the errors that take part in it, the leading one first
    others = vectors[:, null][:, np.sum(vectors[:, null][empty] ** 2, axis=0) < 0.5]
    for vector in _sparse_directions(others).T:
        share: dict[str, float] = {}
        for name, value in zip(names, vector, strict=True):
            share[name.split(" ")[0]] = share.get(name.split(" ")[0], 0.0) + float(value**2)
        leading = sorted((name for name in share if share[name] > 0.02), key=lambda name: -share[name])
        texts.append("cannot be told apart: " + " and ".join(leading[:6]) + (" and others" if len(leading) > 6 else ""))
    return Rank(
        rank=int(np.count_nonzero(~null)),
        size=len(matrix),
        condition=float(kept[-1] / kept[0]) if len(kept) else np.inf,
        undetermined=undetermined,
        combinations=tuple(dict.fromkeys(texts)),
    )


def _sparse_directions(vectors: FloatArray) -> FloatArray:
    """Rotate a null space (size, k) to vectors with few entries each (pivoted elimination), columns normalised."""
    rest = vectors.copy()
    found = []
    while rest.shape[1]:
        pivot = int(np.argmax(np.sum(rest**2, axis=1)))
        direction = rest @ rest[pivot]
        direction /= np.linalg.norm(direction)
        found.append(direction)
        rest = rest - np.outer(direction, direction @ rest)
        left, singular, _ = np.linalg.svd(rest, full_matrices=False)
        rest = left[:, singular > 1e-6]
    return np.column_stack(found) if found else vectors


def unknown_names(
    parameters: ErrorParameters, stations: tuple[str, ...], station: IntArray, group: IntArray
) -> list[str]:
    """Names of all unknowns, e.g. ``EXX at -80 mm``, ``EC0Y``, ``LT1 x``, ``LT1 dead length``."""
    names: list[str] = []
    for curve in parameters.curves:
        for column in curve.free.T:
            strongest = int(np.argmax(np.abs(column)))
            names.append(f"{curve.error.name} at {curve.nodes_mm[strongest]:g} mm")
    names += parameters.squareness
    names += [f"{name} {letter}" for name in stations for letter in "xyz"]
    owner = dict(zip(group.tolist(), station.tolist(), strict=True))
    names += [f"{stations[owner[k]]} dead length" for k in sorted(owner)]
    return names
