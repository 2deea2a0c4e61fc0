"""What an effect does to a session: it moves the tip, or it changes the readings themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from hidden.session import Session


@dataclass(frozen=True)
class Change:
    """``tip`` (P, 3): displacement at each stop; ``reading`` (n,): change of each reading; any common unit."""

    tip: np.ndarray | None = None
    reading: np.ndarray | None = None

    def readings(self, session: Session) -> np.ndarray:
        """Change of every reading to first order, (n,)."""
        out = np.zeros(len(session.reading_stop))
        if self.tip is not None:
            out += np.sum(session.beams()[0] * self.tip[session.reading_stop], axis=1)
        if self.reading is not None:
            out += self.reading
        return out

    def scaled(self, factor: float) -> Change:
        """The same effect, ``factor`` times as large."""
        return Change(*(None if part is None else factor * part for part in (self.tip, self.reading)))


Hidden = Callable[[Session, np.random.Generator], Change]


def along(session: Session, axis: int, values: np.ndarray) -> Change:
    """Displacement by ``values`` (P,) along an axis."""
    tip = np.zeros((len(session.t), 3))
    tip[:, axis] = values
    return Change(tip=tip)


def stop_noise(session: Session, rng: np.random.Generator) -> np.ndarray:
    """A standard normal number for each run, repeated for its stops, (P,)."""
    return rng.normal(size=int(session.run.max()))[session.run - 1]


def p2(s: np.ndarray) -> np.ndarray:
    """Second Legendre polynomial."""
    return 1.5 * s**2 - 0.5


def share_of_time(session: Session) -> np.ndarray:
    """Time from 0 at the first stop to 1 at the last, (P,)."""
    return (session.t - session.t[0]) / np.ptp(session.t)


def first_stop_at(session: Session, share: float) -> int:
    """First stop of the run that begins after ``share`` of the session."""
    at = int(np.searchsorted(share_of_time(session), share))
    return int(np.argmax(session.run == session.run[min(at, len(session.t) - 1)]))


def of_station(session: Session, station: int, values: np.ndarray) -> Change:
    """Change of the readings of one station by ``values`` (n,)."""
    return Change(reading=np.where(session.reading_station == station, values, 0.0))
