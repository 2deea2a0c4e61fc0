"""Axis runs in the engine: cells of repeats as the base, noise with memory, and what may change within a session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.diagnose.axis_session import AxisSession
from compgen.diagnose.engine import LEAST_GAIN, Candidate, Fit, NoiseGrid, Search
from compgen.diagnose.layout import IntArray
from compgen.effects import Effect, catalogue

#: Names of slow drifts.
DRIFTS = ("warmup_drift", "linear_drift")
#: Bad runs or steps from which a search is started if the first searches found anything that depends on the run.
RUN_STARTS = 8
#: Names of effects on whole runs.
OF_RUNS = ("bad_run", "step_between_runs")
#: Readings of one run that may be off by themselves, at most, before the whole run counts as bad.
MOST_OFF = 3


def noise_of(
    session: AxisSession, scatter: FloatArray | None = None, points: Sequence[tuple[float, float]] | None = None
) -> NoiseGrid:
    """The noise of a session; ``scatter`` (n,) divides all readings if the noise is not uniform."""
    step = session.time / (np.median(np.diff(session.time)) if session.timed else 1.0)
    cells = np.zeros((len(session), int(session.cell.max()) + 1))
    cells[np.arange(len(session)), session.cell] = 1.0 if scatter is None else 1.0 / scatter
    return NoiseGrid(np.diff(step), cells, points)


class AxisSearch(Search):
    """Search in a session of axis runs."""

    def __init__(self, session: AxisSession, grid: NoiseGrid, candidates: Sequence[Candidate]) -> None:
        super().__init__(session.deviation_mm - session.deviation_mm.mean(), grid, candidates, session.least_mm)
        self.session = session

    def run(self, most: int) -> list[int]:
        """The best set; single readings in place of a run of which only these are off."""
        return self._single(super().run(most))

    def further_starts(self, members: Sequence[int]) -> list[int]:
        """Bad runs and steps, if anything depends on the run: two bad runs may hide each other in the first step."""
        if not any("run" in " ".join(self.candidates[k].covariates) for k in members):
            return []
        gains = self.criteria([])[0]
        found = [k for k, c in enumerate(self.candidates) if c.name in OF_RUNS and c.columns.shape[1] == 1]
        return sorted(found, key=lambda k: -gains[k])[:RUN_STARTS]

    def _single(self, members: list[int]) -> list[int]:
        """Members with a run whose readings have separate values exchanged for the few readings that are off, if they tell more.

        Two outliers in one run together look like a bad run to a search that adds one candidate at a time.
        """
        for member in members:
            run = self.candidates[member]
            if not run.free or run.last - run.first < MOST_OFF:
                continue
            rest, chosen = [k for k in members if k != member], list[int]()
            inside = [
                k for k, c in enumerate(self.candidates)
                if not c.free and c.first == c.last >= 0 and run.first <= c.first <= run.last and k not in rest
            ]  # fmt: skip
            while inside and len(chosen) < MOST_OFF:
                criteria = self.criteria([*rest, *chosen])[1]
                best = max(inside, key=lambda k: float(criteria[k]))  # noqa: B023 - used at once
                if criteria[best] < LEAST_GAIN:
                    break
                chosen.append(best)
                inside.remove(best)
            if chosen and self.total([*rest, *chosen]) > self.total([*rest, member]):
                members = [*rest, *chosen]
        return members


class AxisFit(Fit):
    """The chosen changes with time, fitted together with the means of the cells."""

    def __init__(self, search: AxisSearch, members: Sequence[int]) -> None:
        super().__init__(search, members)
        self.search: AxisSearch = search
        self.session = search.session

    def slopes(self) -> FloatArray:
        """Change of the effects with their time constants of settling, which are known from the readings only, (n, k)."""
        found = [np.zeros((len(self.session), 0))]
        for k in self.members:
            effect = self.search.candidates[k].effect
            if effect is not None and "tau_s" in effect.settings:
                other = effect.with_settings({**effect.settings, "tau_s": 1.15 * effect.settings["tau_s"]})
                columns = other.columns(self.session.readings)
                found.append(self.search.candidates[k].columns * 0.0 if columns is None else columns)
        return np.hstack(found)

    @property
    def rounded_alike(self) -> float:
        """Share of the error of rounding that repeats have in common: 1 without scatter, 0 where it exceeds the step."""
        if not self.session.step_mm or not self.freedom:
            return 0.0
        scatter = self.search.scatter_mm(self.members) / self.session.step_mm
        return float(np.exp(-((2.0 * np.pi * scatter) ** 2) / 2.0))


# Candidates: what may change within a session of axis runs; effects of the catalogue, and smooth terms without a name.


#: Scan positions charged for the time constant of a warm-up (the columns are nearly alike), and for a drift at a
#: constant rate: in sessions this slow, most drifts are the beginning or the end of a warm-up.
WARMUP_SCANS, LINEAR_SCANS = 2.0, 4.0
#: Numbers of waves per session that are tried, and the scan positions charged for them (neighbours are nearly alike).
WAVES, WAVE_SCANS = np.concatenate([np.arange(0.5, 4.1, 0.25), np.arange(4.5, 10.1, 0.5)]), 10.0
#: Waves per run from which a swing can be confused with a reversal, and the share of a swing that must remain visible.
RUN_LIKE, LEAST_WAVE = 0.6, 0.3
#: Time constants of a fading jump, as shares of the session, and the maximum number of readings at which it may begin.
FADING, MOST_ONSETS = (0.07, 0.2), 150
#: Most columns of "every target of every run has a separate value", and the degree of the curve of a run.
MOST_OF_RUNS, CURVE = 60, 4
#: Windows of disturbed readings that are tried; if there are k times as many, only every k-th.
MOST_WINDOWS = 800
#: Scan positions charged at most for the setting of an effect of a logged column: neighbours are nearly alike.
MOST_LOGGED_SCANS = 6
#: Readings before and after a step within a run, at least.
LEAST_OF_STEP = 5
#: A step within a run is charged as this many scan positions each: outliers next to the end of a run are more common.
RARE = 8.0
#: Lengths of a pause, and time constants of a warm-up that it interrupts, as shares of the session.
PAUSES, PAUSED_TAU = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2), (0.1, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.5, 5.0)
#: Burst lengths (readings) that are tried; in bursts up to LONGEST_FREE each reading may have a separate value.
BURSTS, LONGEST_FREE = (1, 2, 3, 5, 8), 3


def candidates_of(session: AxisSession, only: Sequence[str] = ()) -> list[Candidate]:
    """Return all candidates to compare; ``only`` limits the names."""
    known = catalogue()
    warm = known["warmup_drift"]
    slow = [_candidate(session, warm.at(tau), WARMUP_SCANS) for tau in warm.positions(session.readings)]
    slow.append(_candidate(session, known["linear_drift"], LINEAR_SCANS))
    drifts = [item for item in slow if item is not None]
    found = [*drifts, *_disturbed(session, known), *_steps(session, known), *_logged(session, known)]
    found = [c for c in found if not only or c.name in only]
    return [*found, *_generic(session)]


def invisible_of(session: AxisSession) -> tuple[str, ...]:
    """Names that these runs cannot show: whatever is the same in every run is part of the curve of the axis."""
    letter = session.letter
    hidden = [f"periodic_{letter}"]
    seen = {candidate.name for candidate in _logged(session, catalogue())}
    hidden += [name for name in _logged_names(letter) if name not in seen]
    if not len(session.both):
        hidden += [f"backlash_{letter}", f"lost_motion_{letter}"]
    return tuple(hidden)


def _logged_names(letter: str) -> tuple[str, ...]:
    return (f"thermal_scale_{letter}", f"spindle_growth_{letter}", f"settling_{letter}", f"servo_lag_{letter}")


def _candidate(session: AxisSession, effect: Effect, scans: float, text: str = "") -> Candidate | None:
    columns = effect.columns(session.readings)
    if columns is None or not np.isfinite(columns).all():
        return None
    first, last = (int(effect.settings.get(key, -1)) for key in ("first", "last"))
    card = effect.card
    return Candidate(
        card.name, "named", columns, scans, text or card.title, card.covariates, effect, first, last,
        only_one="drift" if card.name in DRIFTS else "",
    )  # fmt: skip


def _steps(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    if not session.in_runs:
        return []
    step = known["step_between_runs"]
    found = []
    for k in range(1, len(session)):
        end, between = int(np.flatnonzero(session.leg == session.leg[k])[-1]), session.leg[k] != session.leg[k - 1]
        if not between and min(k, len(session) - k) < LEAST_OF_STEP:
            continue  # a few readings at an end that are off are disturbed, not a step
        where = session.window(k, end) if between else session.place(k)
        scans = _runs(session) if between else RARE * float(len(session))
        found.append(_candidate(session, step.at(float(k)), scans, f"step before {where}"))
    return [item for item in found if item is not None]


def paused_warmups(session: AxisSession, first: int) -> list[Candidate]:
    """Warm-ups that went on during a pause before the reading ``first``, with time constants and pauses of many lengths."""
    share = (session.time - session.time[0]) / (session.time[-1] - session.time[0])
    after = np.arange(len(session)) >= first
    return [
        Candidate("warmup_drift", "named", -np.expm1(-(share + pause * after) / tau)[:, None], WARMUP_SCANS)
        for pause in PAUSES for tau in PAUSED_TAU
    ]  # fmt: skip


def _runs(session: AxisSession) -> float:
    """Scan positions charged for a step or a bad run: equal, so a bad first run and a step after it weigh the same."""
    return float(session.leg.max()) + 1.0


def _disturbed(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    """One run that is off, in one or both directions, and shorter bursts."""
    bad, burst = known["bad_run"], known["disturbed_readings"]
    runs = set() if not session.in_runs else {_ends(session.leg == k) for k in range(int(session.leg.max()) + 1)}
    runs |= {_ends(session.cycle == k) for k in range(int(session.cycle.max()) + 1)} if runs else set()
    runs = runs if len(runs) > 1 else set()
    found = []
    for first, last in sorted(runs):
        chosen = bad.with_settings({"first": float(first), "last": float(last)})
        item = _candidate(session, chosen, _runs(session), session.window(first, last))
        assert item is not None
        found.append(item)
        found.append(_free(item, len(session)))
    n, longest = len(session), max(int(np.bincount(session.leg).max()), len(session) // 10) - 1
    windows = [(k, k + size - 1) for size in BURSTS if size <= longest for k in range(n - size + 1)]
    windows = windows[:: max(1, len(windows) // MOST_WINDOWS)] if len(windows) > MOST_WINDOWS else windows
    windows = [window for window in windows if window not in runs]
    for first, last in windows:
        item = _candidate(
            session, burst.with_settings({"first": float(first), "last": float(last)}), len(windows),
            session.window(first, last),
        )  # fmt: skip
        assert item is not None
        found.append(item)
        if 1 < last - first + 1 <= LONGEST_FREE:
            found.append(_free(item, n))
    return found


def _free(item: Candidate, count: int) -> Candidate:
    """The same readings, each with a separate value; the session has ``count`` readings."""
    return replace(item, columns=np.eye(count, item.last - item.first + 1, -item.first), free=True)


def _ends(chosen: NDArray[np.bool_]) -> tuple[int, int]:
    rows = np.flatnonzero(chosen)
    return int(rows[0]), int(rows[-1])


def _logged(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    """Effects that need a logged temperature or dwell that changed between repeats."""
    found = []
    for name in _logged_names(session.letter):
        effect = known[name]
        positions = effect.positions(session.readings)
        every = [effect.at(p) for p in positions] if positions else [effect]
        for item in (_candidate(session, one, float(np.clip(len(every), 1, MOST_LOGGED_SCANS))) for one in every):
            if item is not None and _varies(session, item.columns):
                found.append(item)
    return found


def _varies(session: AxisSession, columns: FloatArray, least: float = 1e-3) -> bool:
    """Whether anything is left of the columns after subtracting the means of the cells."""
    count = np.bincount(session.cell)[:, None]
    means = np.stack([np.bincount(session.cell, column) for column in columns.T], axis=1) / count
    return bool(np.linalg.norm(columns - means[session.cell]) > least * np.linalg.norm(columns))


def _generic(session: AxisSession) -> list[Candidate]:
    t = session.time - session.time[0]
    t = 2.0 * t / t[-1] - 1.0
    s, way = session.s, session.direction.astype(np.float64)
    found = []

    def add(
        text: str,
        covariates: tuple[str, ...],
        columns: FloatArray,
        scans: float = 1.0,
        least: float = 1e-3,
    ) -> None:
        columns = columns.reshape(len(session), -1)
        columns = columns / np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-12)
        if columns.shape[1] and columns.shape[1] <= len(session) // 2 and _varies(session, columns, least):
            found.append(Candidate(text, "generic", columns, scans, text, covariates))

    add("the readings drift smoothly with time", ("time",), np.column_stack([t, t**2, t**3]))
    add("the readings drift smoothly with time", ("time",), np.column_stack([t, t**2]))
    for waves in WAVES.tolist():
        angle = np.pi * (t + 1) * waves
        text = f"the readings oscillate with time, about {waves:.3g} periods in the session"
        # a wave about as long as a run looks like a reversal; one of exactly that length is part of the axis curve
        as_run = waves > RUN_LIKE * (int(session.cycle.max()) + 1)
        columns = np.column_stack([np.sin(angle), np.cos(angle)])
        add(text, ("time", "approach") if as_run else ("time",), columns, WAVE_SCANS, LEAST_WAVE)
    saturating = [-np.expm1(-(t + 1) / 2 / tau) for tau in (0.2, 0.6)]
    for shape in (t, *saturating):
        add("the scale of the axis changes with time", ("time", "x"), shape * s, 3)
        add("the reversal changes with time", ("time", "approach"), shape * way, 3)
        own = _indicators(session.target)
        own = own - own.mean(axis=1, keepdims=True)
        add("each target drifts in its own way", ("time", "x"), shape[:, None] * own, 3)
    cycles, legs = _indicators(session.cycle), _indicators(session.leg)
    if cycles.shape[1] > 2 and session.in_runs:
        add("every run has a separate level", ("run",), cycles[:, 1:])
        add("every run has a separate slope", ("run", "x"), cycles * s[:, None])
        curve = np.polynomial.legendre.legvander(s, min(CURVE, len(session.targets_mm) - 1))[:, 1:]
        add("every run has a separate curve", ("run", "x"), _products(cycles, np.asarray(curve, dtype=np.float64)))
        if cycles.shape[1] * len(session.targets_mm) <= MOST_OF_RUNS:
            text = "both directions of a run agree, and differ from the other runs"
            add(text, ("run", "x"), _products(cycles, _indicators(session.target)))
    if legs.shape[1] > cycles.shape[1] and session.in_runs:
        add("every direction of every run has a separate level", ("run", "approach"), legs[:, 1:])
    number = np.arange(len(session), dtype=np.float64)
    onsets = range(1, len(session) - 1, max(1, len(session) // MOST_ONSETS))
    for k in onsets:
        for fades in FADING:
            shape = np.where(number >= k, np.exp(-np.maximum(number - k, 0.0) / (fades * len(session))), 0.0)
            text = f"a jump before {session.place(k)} that fades"
            add(text, ("time",), shape, len(FADING) * len(onsets))
    for k in (np.flatnonzero(np.diff(session.leg)) + 1).tolist():
        legs_count = int(session.leg.max())
        add(f"the scale changes at {session.place(k)}", ("time", "x"), _from(session, k) * s, legs_count)
        add(f"the reversal changes at {session.place(k)}", ("time", "approach"), _from(session, k) * way, legs_count)
    return found


def _products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Every column of ``first`` times every column of ``second``."""
    return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(first), -1))


def _from(session: AxisSession, k: int) -> FloatArray:
    return (np.arange(len(session)) >= k).astype(np.float64)


def _indicators(number: IntArray) -> FloatArray:
    return np.asarray(np.eye(int(number.max()) + 1)[number])
