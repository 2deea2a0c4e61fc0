"""Figures of a drift session as ISO 230-3 reports them: ranges in the first hour and in all, and minutes to wait."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.heat.sessions import DIRECTIONS, DriftSession

HOUR_S = 3600.0


def etve_figures(session: DriftSession, tolerance_um: float) -> dict[str, Any]:
    """Return ranges by direction, what each sensor warmed by, and the wait until displacements stay within a tolerance.

    ``wait_min`` is the time after which dx, dy, dz stay within +-tolerance of their last reading; None if that is not
    before the last quarter of the session: then it is not known whether the machine had settled.
    """
    time_s = session.temperatures.time_s - session.temperatures.time_s[0]
    found: dict[str, Any] = {"file": session.name, "minutes": float(time_s[-1] / 60)}
    for name, moved in session.moved.items():
        unit = DIRECTIONS[name]
        found[f"{name}_range_first_60_min_{unit}"] = _range(moved[time_s <= HOUR_S])
        found[f"{name}_range_last_60_min_{unit}"] = _range(moved[time_s >= time_s[-1] - HOUR_S])
        found[f"{name}_range_{unit}"] = _range(moved)
    for name, celsius in session.temperatures.celsius.items():
        found[f"temp_{name}_range_k"] = _range(celsius)
    waits = [_wait_s(time_s, session.moved[name], tolerance_um) for name in session.moved if DIRECTIONS[name] == "um"]
    longest = max(waits, default=0.0)
    found["wait_min"] = longest / 60 if longest <= 0.75 * time_s[-1] else None
    return found


def warm_up(waits_min: Sequence[float | None]) -> dict[str, Any] | None:
    """Return how long to wait on another day, min: mean and standard deviation, and what is enough on 19 of 20 days.

    ``enough_min`` is the one-sided 95 % bound of one further session, mean + t s sqrt(1 + 1/n). None where a session had
    not settled at its end, or for less than two sessions: how days differ is then not known.
    """
    known = np.array([wait for wait in waits_min if wait is not None])
    if len(known) < len(waits_min) or len(known) < 2:
        return None
    from scipy.stats import t

    mean, s, n = float(known.mean()), float(known.std(ddof=1)), len(known)
    enough = mean + float(t.ppf(0.95, n - 1)) * s * float(np.sqrt(1 + 1 / n))
    return {"mean_min": mean, "s_min": s, "enough_min": enough, "sessions": n}


def _range(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if known.size else None


def _wait_s(time_s: FloatArray, moved: FloatArray, tolerance_um: float) -> float:
    known = np.isfinite(moved)
    rest = np.abs(moved[known] - moved[known][-1])
    late = np.flatnonzero(rest > tolerance_um)
    return float(time_s[known][late[-1] + 1]) if late.size else 0.0
