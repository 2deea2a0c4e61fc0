"""How much of an effect the base model of a measurement cannot explain away. Dense and plain: a reference."""

from __future__ import annotations

import numpy as np
from hidden.kinematics import AXES, error_directions, without_lever
from hidden.session import Session
from numpy.polynomial import legendre

DEGREE = 7


def base_columns(session: Session, degree: int = DEGREE) -> np.ndarray:
    """Columns (n, k): motion errors of every axis as polynomials, squareness, stations, dead lengths."""
    u, _ = session.beams()
    stop, station = session.reading_stop, session.reading_station
    blocks = []
    for name, moved in error_directions(session.machine, session.q, session.tool).items():
        if name in without_lever(session.machine):
            continue
        seen = np.sum(u * moved[stop], axis=1)
        powers = legendre.legvander(session.s[:, AXES.index(name[2])], degree)
        blocks.append(seen[:, None] * powers[stop])
    for k in range(session.plan.stations):
        own = station == k
        blocks.append(np.where(own[:, None], u, 0.0))
        blocks += [((own) & (session.setup[stop] == setup))[:, None] * 1.0 for setup in np.unique(session.setup)]
    return np.hstack(blocks)


def base_space(session: Session, degree: int = DEGREE) -> np.ndarray:
    """Orthonormal basis (n, r) of what the base model can express."""
    columns = base_columns(session, degree)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, size > 1e-9 * size[0]]


def centred(session: Session, values: np.ndarray) -> np.ndarray:
    """Readings less the mean of their station and set-up, (n,)."""
    group = session.reading_station * 100 + session.setup[session.reading_stop]
    _, member = np.unique(group, return_inverse=True)
    return values - (np.bincount(member, values) / np.bincount(member))[member]


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def visible_part(space: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What is left of readings (n,) after the base model has taken its part."""
    return values - space @ (space.T @ values)
