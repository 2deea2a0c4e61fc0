"""Learn the model of heat from sessions: few terms, each of which makes sessions better that were left out whole.

Every choice (sensors, lags, starts) is made again without each session, and the session is then predicted: the figures
are those of days that nothing was learned from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from compgen.data.csv_files import FloatArray
from compgen.errors import InputError
from compgen.heat.model import HeatModel, Term, hull_of, states_of
from compgen.heat.sessions import DIRECTIONS, DriftSession, Temperatures

Ints = Sequence[int]
#: Fewest sessions: two to learn from when one is left out.
FEWEST_SESSIONS = 3
MOST_TERMS, LAGS = 5, 8
#: Terms of one sensor, and how many times longer the lag of the second must be: closer ones cannot be told apart.
MOST_OF_SENSOR, LAGS_APART = 2, 3.0
#: A further term must take this share of what is left in left-out sessions.
WORTH = 0.05
#: The gain of a second term of a sensor must be so many of its standard errors: two lags of a sensor stand in for each other.
SURE = 2.0
#: A coefficient is expected within this, um/K (a metre of steel: 11.5); readings of a session count as so many that are
#: independent, since a drift that is wrong stays wrong for an hour.
USUAL_UM_PER_K, INDEPENDENT = 10.0, 5.0
#: A model must halve the rms of left-out sessions (the share is of mean squares), and make at most this share of them worse: less
#: is also reached by whatever rises while a machine warms.
MOST_LEFT, MOST_WORSE = 0.25, 0.25


@dataclass(frozen=True)
class Learned:
    """The model, reasons why it is refused (none: it may be used), and what to know about it."""

    model: HeatModel | None
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    sessions: tuple[Mapping[str, Any], ...]
    gains: Mapping[str, float]


@dataclass(frozen=True)
class _Sums:
    """Sums over each session, divided by its readings: terms with terms (s, d, c, c), terms with movement, movement.

    ``middle`` and ``middle_moved`` are the means of terms and movement, ``noise`` the variance of one reading (s, d), um^2.
    """

    products: FloatArray
    with_moved: FloatArray
    moved: FloatArray
    middle: FloatArray
    middle_moved: FloatArray
    noise: FloatArray
    share: FloatArray

    def only(self, sessions: Ints) -> _Sums:
        return _Sums(*(getattr(self, item.name)[sessions] for item in fields(self)))

    def apart(self, left: FloatArray) -> _Sums:
        """Take away what the noise of the first reading, from which all others count, adds to a session.

        That noise is a constant of the session with the variance of one reading. Against what the model leaves, ``left``
        (s, d), of which so many readings are independent, its best estimate is a share of the mean of the session. Without
        it, terms that grow early in the day are learned from the noise of single readings.
        """
        share = INDEPENDENT * self.noise / (INDEPENDENT * self.noise + left + 1e-12)
        return replace(self, share=share)

    @property
    def rest(self) -> FloatArray:
        """Mean square of movement (s, d), without that share of its mean."""
        found: FloatArray = self.moved - self.share * self.middle_moved**2
        return found

    def of(self, sets: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Sums of sets (m, k) of terms: with each other (s, d, m, k, k), and with movement (s, d, m, k)."""
        middle = self.middle[:, :, sets]
        share = self.share[:, :, None, None]
        a = self.products[:, :, sets[:, :, None], sets[:, None, :]]
        a = a - share[..., None] * middle[..., :, None] * middle[..., None, :]
        b = self.with_moved[:, :, sets] - share * middle * self.middle_moved[:, :, None, None]
        return a, b


def _sums(candidates: Sequence[Term], sessions: Sequence[DriftSession], directions: Sequence[str]) -> _Sums:
    """Return the sums of all candidates, from their change since the first reading of each session."""
    rows: list[list[list[Any]]] = [[] for _ in fields(_Sums)]
    for item in sessions:
        states = states_of(candidates, item.temperatures)
        states = states - states[0]
        own: list[list[Any]] = [[] for _ in rows]
        for name in directions:
            y = item.moved[name]
            used = np.isfinite(y)
            a, b = states[used], _since_first(y)[used]
            n = max(len(b), 1)
            found = (a.T @ a / n, a.T @ b / n, float(b @ b) / n, a.mean(axis=0), float(b.mean()), _noise(b), 0.0)
            for kind, value in zip(own, found, strict=True):
                kind.append(value)
        for kind, values in zip(rows, own, strict=True):
            kind.append(values)
    return _Sums(*(np.array(kind) for kind in rows))


def _noise(moved: FloatArray) -> float:
    """Variance of the noise of one reading, from second differences (6 times it), in which drift does not show."""
    bends = np.diff(moved, 2)
    return float(np.median(bends**2) / 0.4549 / 6.0) if bends.size else 0.0


def _since_first(moved: FloatArray) -> FloatArray:
    """Return the movement since the first reading that there is."""
    found: FloatArray = moved - moved[np.isfinite(moved)][0]
    return found


def _left_out(sums: _Sums, sets: NDArray[np.int64], ridge: FloatArray) -> FloatArray:
    """Return the mean square that is left of each session when it is left out, for sets (m, k) of terms: (m, s, d)."""
    a, b = sums.of(sets)
    count = len(a)
    eye = (count - 1) * ridge[:, None, None, None] * np.eye(sets.shape[1])
    k = np.linalg.solve(a.sum(0) - a + eye, (b.sum(0) - b)[..., None])[..., 0]
    left = sums.rest[:, :, None] - 2 * (k * b).sum(-1) + np.einsum("sdmi,sdmij,sdmj->sdm", k, a, k)
    found: FloatArray = np.maximum(left, 0.0).transpose(2, 0, 1)
    return found


def _ridge(left: FloatArray) -> FloatArray:
    """Return what is added to the sums of each direction, K^2: by what the model leaves (s, d), against usual coefficients."""
    found: FloatArray = left.mean(0) / (INDEPENDENT * USUAL_UM_PER_K**2) + 1e-9
    return found


def _chosen(sums: _Sums, candidates: Sequence[Term], usable: Ints) -> tuple[list[int], float]:
    """Return few terms, one at a time, the one that helps left-out sessions most; and what they leave, um^2."""
    chosen: list[int] = []
    left = sums.moved
    while len(chosen) < MOST_TERMS:
        ridge = _ridge(left)
        trials = np.array([[*chosen, c] for c in usable if _goes_with(candidates, c, chosen)], dtype=np.int64)
        if not trials.size:
            break
        own = sums.apart(left)
        now = _left_out(own, np.array([chosen], dtype=np.int64), ridge)[0] if chosen else own.rest
        results = _left_out(own, trials, ridge)
        best = int(np.argmin(results.mean(1).sum(1)))
        again = candidates[trials[best][-1]].sensor in [candidates[k].sensor for k in chosen]
        if not _worth(now, results[best], SURE if again else 0.0):
            break
        chosen, left = trials[best].tolist(), results[best]
        chosen, left = _exchanged(sums, candidates, usable, chosen, left)
    return chosen, float(left.mean(0).sum())


def _worth(before: FloatArray, after: FloatArray, sure: float) -> bool:
    """Whether left-out sessions (s, d) get better by enough, and by so many standard errors of that over the sessions."""
    gain = (before - after).sum(1)
    chance = float(np.std(gain, ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else 0.0
    return bool(gain.mean() >= WORTH * before.mean(0).sum() and gain.mean() > sure * chance)


def _goes_with(candidates: Sequence[Term], new: int, chosen: Ints) -> bool:
    """Whether a term can be told apart from those of the same sensor."""
    sensor, lag_s = candidates[new].sensor, candidates[new].lag_s
    lags = [candidates[k].lag_s for k in chosen if candidates[k].sensor == sensor]
    apart = all((lag_s == 0) != (other == 0) or max(lag_s, other) > LAGS_APART * min(lag_s, other) for other in lags)
    return new not in chosen and len(lags) < MOST_OF_SENSOR and apart


def _exchanged(
    sums: _Sums, candidates: Sequence[Term], usable: Ints, chosen: list[int], left: FloatArray
) -> tuple[list[int], FloatArray]:
    """Give each chosen term another lag or start of the same sensor where left-out sessions get better."""
    for place in range(len(chosen)):
        others = [*chosen[:place], *chosen[place + 1 :]]
        sensor = candidates[chosen[place]].sensor
        same = [c for c in usable if candidates[c].sensor == sensor and c != chosen[place]]
        same = [c for c in same if _goes_with(candidates, c, others)]
        if not same:
            continue
        trials = np.array([[*chosen[:place], c, *chosen[place + 1 :]] for c in same], dtype=np.int64)
        results = _left_out(sums.apart(left), trials, _ridge(left))
        best = int(np.argmin(results.mean(1).sum(1)))
        if results[best].mean(0).sum() < 0.999 * left.mean(0).sum():
            chosen, left = trials[best].tolist(), results[best]
    return chosen, left


def _candidates(sessions: Sequence[DriftSession], sensors: Sequence[str]) -> list[Term]:
    """Return every sensor with every lag from every start."""
    spans = [float(item.temperatures.time_s[-1] - item.temperatures.time_s[0]) for item in sessions]
    steps = [float(np.median(np.diff(item.temperatures.time_s))) for item in sessions]
    lags = np.geomspace(max(2 * np.median(steps), max(spans) / 200), 1.5 * max(spans), LAGS).tolist()
    found = [Term(name, 0.0, name) for name in sensors]
    return found + [Term(name, lag, start) for name, lag, start in product(sensors, lags, sensors)]


def _choices(candidates: Sequence[Term], sensors: Sequence[str]) -> list[list[int]]:
    """Return the terms that go together: lags start at their own sensor, or all at that of one other."""
    own = [k for k, item in enumerate(candidates) if item.start == item.sensor]
    return [own] + [[k for k, item in enumerate(candidates) if item.start in (item.sensor, name)] for name in sensors]


def _best(sums: _Sums, candidates: Sequence[Term], choices: Sequence[Ints]) -> list[int]:
    """Return the terms of the best choice; another start than the own one must be worth it, as a term must."""
    found = [_chosen(sums, candidates, usable) for usable in choices]
    least = min(left for _, left in found)
    plain, left = found[0]
    if left * (1 - WORTH) <= least:
        return plain
    return min(found, key=lambda item: item[1])[0]


def _fitted(sums: _Sums, chosen: Ints, ridge: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (d, k) and their covariance (d, k, k) from the scatter between sessions."""
    a, b = (found[:, :, 0] for found in sums.of(np.array([chosen], dtype=np.int64)))
    count = len(a)
    inverse = np.linalg.inv(a.sum(0) + count * ridge[:, None, None] * np.eye(len(chosen)))
    k = np.einsum("dij,dj->di", inverse, b.sum(0))
    scores = b - np.einsum("sdij,dj->sdi", a, k)
    middle = np.einsum("sdi,sdj->dij", scores, scores) * count / max(count - len(chosen), 1)
    return k, inverse @ middle @ inverse


def learn_heat(machine: str, sessions: Sequence[DriftSession]) -> Learned:
    """Return the model of sessions, or why there is none.

    Raises
    ------
    InputError
        for sessions of different directions, or without a sensor that all of them have.
    """
    directions, sensors, notes = _common(sessions)
    if len(sessions) < FEWEST_SESSIONS:
        given = f"{len(sessions)} session{'s' if len(sessions) > 1 else ''} given"
        reason = f"a model needs {FEWEST_SESSIONS} sessions on different days ({given}): it is judged on days left out"
        return Learned(None, (reason,), tuple(notes), (), {})
    candidates = _candidates(sessions, sensors)
    sums, choices = _sums(candidates, sessions, directions), _choices(candidates, sensors)
    rows, before, after, used = _judged(sessions, directions, candidates, sums, choices)
    reasons, kept = _verdict(directions, before, after, used)
    chosen = _best(sums, candidates, choices)
    if not chosen or not kept:
        return Learned(None, tuple(reasons or ["no term makes left-out sessions better"]), tuple(notes), rows, {})
    terms = _refined([candidates[k] for k in chosen], sessions, directions)
    model, gains = _model(machine, sessions, directions, kept, terms)
    rms = {name: _rms_pair(before, after, directions.index(name)) for name in model.directions}
    notes += [
        f"{name}: no model, which would not make left-out sessions better" for name in directions if name not in kept
    ]
    return Learned(replace(model, rms=rms, sessions=rows), tuple(reasons), tuple(notes), rows, gains)


def _rms_pair(before: FloatArray, after: FloatArray, column: int) -> tuple[float, float]:
    return float(np.sqrt(before[:, column].mean())), float(np.sqrt(after[:, column].mean()))


def _common(sessions: Sequence[DriftSession]) -> tuple[list[str], list[str], list[str]]:
    """Return directions and sensors of all sessions, and what is left out."""
    if not sessions:
        raise InputError("no session was given")
    directions = [name for name in DIRECTIONS if all(name in item.moved for item in sessions)]
    if not directions:
        raise InputError("the sessions have no displacement in common; give sessions with the same columns")
    every = list(dict.fromkeys(name for item in sessions for name in item.temperatures.celsius))
    broken = {name for item in sessions for name in item.temperatures.broken}
    shared = [name for name in every if all(name in item.temperatures.celsius for item in sessions)]
    sensors = [name for name in shared if name not in broken]
    notes = [f"sensor {name} is not in every session: not used" for name in every if name not in shared]
    notes += [f"sensor {name} jumps: not used" for name in sorted(broken)]
    if not sensors:
        raise InputError("no sensor is in every session and sound in all of them; give sessions with the same sensors")
    return directions, sensors, notes


def _judged(
    sessions: Sequence[DriftSession],
    directions: Sequence[str],
    candidates: Sequence[Term],
    sums: _Sums,
    choices: Sequence[Ints],
) -> tuple[tuple[Mapping[str, Any], ...], FloatArray, FloatArray, FloatArray]:
    """Choose and fit without each session, and predict it: rows for people, mean squares (s, d) before, after, in the hull."""
    rows = []
    after, in_hull = np.zeros_like(sums.moved), np.zeros_like(sums.moved)
    for k, item in enumerate(sessions):
        others = [j for j in range(len(sessions)) if j != k]
        training = sums.only(others)
        chosen = _best(training, candidates, choices)
        row: dict[str, Any] = {"file": item.name}
        left = training.moved if not chosen else _left_out(training, np.array([chosen]), _ridge(training.moved))[0]
        values = _fitted(training.apart(left), chosen, _ridge(left))[0] if chosen else np.zeros((len(directions), 0))
        terms = [candidates[c] for c in chosen]
        states = states_of(terms, item.temperatures)
        share = _share(terms, [sessions[j] for j in others], item.temperatures)
        for d, name in enumerate(directions):
            y = _since_first(item.moved[name])
            seen = np.isfinite(y)
            predicted = (states - states[0]) @ values[d]
            after[k, d] = np.mean((y - predicted)[seen] ** 2)
            in_hull[k, d] = np.mean((y - share * predicted)[seen] ** 2)
            unit = DIRECTIONS[name]
            row[f"{name}_before_rms_{unit}"] = float(np.sqrt(sums.moved[k, d]))
            row[f"{name}_after_rms_{unit}"] = float(np.sqrt(after[k, d]))
            row[f"{name}_after_in_hull_rms_{unit}"] = float(np.sqrt(in_hull[k, d]))
        row["weight"] = float(share.mean())
        rows.append(row)
    return tuple(rows), sums.moved, after, in_hull


def _share(terms: Sequence[Term], sessions: Sequence[DriftSession], temperatures: Temperatures) -> FloatArray:
    """Return the weight of the hull of other sessions (n,)."""
    hull = hull_of(_sensors_of(terms), [item.temperatures.celsius for item in sessions])
    empty = HeatModel("", tuple(terms), {}, hull, {})
    return empty.weight(temperatures)[0]


def _sensors_of(terms: Sequence[Term]) -> list[str]:
    return list(dict.fromkeys(name for item in terms for name in (item.sensor, item.start)))


def _verdict(
    directions: Sequence[str], before: FloatArray, after: FloatArray, in_hull: FloatArray
) -> tuple[list[str], list[str]]:
    """Return why the model is refused, and the directions in which it is better than nothing."""
    kept = []
    reasons = []
    for d, name in enumerate(directions):
        share = float(after[:, d].mean() / max(before[:, d].mean(), 1e-12))
        worse = int((in_hull[:, d] > before[:, d]).sum())
        if share <= MOST_LEFT and worse <= MOST_WORSE * len(before) and in_hull[:, d].mean() < before[:, d].mean():
            kept.append(name)
            continue
        unit = DIRECTIONS[name]
        was, now = np.sqrt(before[:, d].mean()), np.sqrt(after[:, d].mean())
        reasons.append(
            f"{name}: left-out sessions have {was:.2f} {unit} rms without a model and {now:.2f} with one, and {worse} of "
            f"{len(before)} get worse: these sensors do not express the heat of this machine"
        )
    return ([] if kept else reasons), kept


def _refined(terms: Sequence[Term], sessions: Sequence[DriftSession], directions: Sequence[str]) -> list[Term]:
    """Return the terms with lags between those that were tried, by what the fit to all sessions leaves."""
    moving = [k for k, item in enumerate(terms) if item.lag_s > 0]
    if not moving:
        return list(terms)

    def with_lags(logs: FloatArray) -> list[Term]:
        lags = dict(zip(moving, np.exp(logs).tolist(), strict=True))
        return [replace(item, lag_s=lags.get(k, item.lag_s)) for k, item in enumerate(terms)]

    def left(logs: FloatArray) -> float:
        sums = _sums(with_lags(logs), sessions, directions).apart(begun)
        trial = np.arange(len(terms), dtype=np.int64)[None]
        return float(_left_out(sums, trial, ridge)[0].mean(0).sum())

    begin = np.log([terms[k].lag_s for k in moving])
    sums = _sums(terms, sessions, directions)
    begun = _left_out(sums, np.arange(len(terms))[None], _ridge(sums.moved))[0]
    ridge = _ridge(begun)
    bounds = [(value - 1.0, value + 1.0) for value in begin.tolist()]
    found = minimize(left, begin, method="Powell", bounds=bounds, options={"xtol": 1e-3, "ftol": 1e-6, "maxfev": 150})
    return with_lags(found.x) if found.fun < left(begin) else list(terms)


def _model(
    machine: str,
    sessions: Sequence[DriftSession],
    directions: Sequence[str],
    kept: Sequence[str],
    terms: Sequence[Term],
) -> tuple[HeatModel, dict[str, float]]:
    """Return the model of all sessions, and what is left without each of its sensors, as a factor of what is left with all."""
    sums = _sums(terms, sessions, directions)
    every = np.arange(len(terms), dtype=np.int64)
    left = _left_out(sums, every[None], _ridge(sums.moved))[0]
    sums = sums.apart(left)
    left = _left_out(sums, every[None], _ridge(left))[0]
    k, covariance = _fitted(sums, every.tolist(), _ridge(left))
    numbers = {name: k[directions.index(name)] for name in kept}
    found = tuple(replace(item, per_k={name: float(numbers[name][j]) for name in kept}) for j, item in enumerate(terms))
    hull = hull_of(_sensors_of(found), [item.temperatures.celsius for item in sessions])
    spread = {name: covariance[directions.index(name)] for name in kept}
    model = HeatModel(machine, found, spread, hull, dict.fromkeys(kept, (0.0, 0.0)))
    return model, _gains(sums, terms, left)


def _gains(sums: _Sums, terms: Sequence[Term], left: FloatArray) -> dict[str, float]:
    """Return by sensor how many times the rms of left-out sessions would be larger without it."""
    found = {}
    for name in dict.fromkeys(item.sensor for item in terms):
        others = [k for k, item in enumerate(terms) if item.sensor != name]
        without = _left_out(sums, np.array([others], dtype=np.int64), _ridge(left))[0] if others else sums.rest
        found[name] = float(np.sqrt(without.mean(0).sum() / max(left.mean(0).sum(), 1e-12)))
    return found
