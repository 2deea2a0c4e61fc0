"""What is kept between requests: figures that take time to calculate, and pages until something changes.

Figures (drift, shortest re-check) are calculated one at a time in a background thread: nobody can keep all processors
busy with requests. A request waits briefly and is then told to try again.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from compgen.data.names import COVERAGE, SQUARENESS_NAMES, error_named
from compgen.drawing.charts import LABEL
from compgen.errors import InputError
from compgen.fleet import database, logs
from compgen.fleet.dashboard.charts import Chart, ChartSeries, chart, time_ticks
from compgen.fleet.decisions import EXCLUSION
from compgen.fleet.drift import DAYS_A_MONTH, Drift, DriftSettings, drift_of_store, following_temperature
from compgen.fleet.job import Job, read_job
from compgen.fleet.recheck import Recheck, shortest_recheck
from compgen.fleet.records import IdentificationRecord, MachineRecord, RequestedChange
from compgen.fleet.store import Store, counting
from compgen.planning import PlannedStations

#: Results that stay in memory, and requests that may wait for their turn.
MOST, WAITING = 300, 20
#: Tasks that may wait for an idle moment.
MOST_LATER = 2000
#: Such a task starts after this time without a request, and after this time in any case, s.
REST_S, AT_LATEST_S = 2.0, 30.0
#: How long a request waits for a result, s.
PATIENCE_S = 0.7
#: Pages kept; how long a complete page is shown (it says how long ago things were), and one that waits for figures, s.
PAGES, SHOWN_S, WAITING_SHOWN_S = 200, 60.0, 1.0


class NotReadyError(Exception):
    """The figures are being calculated; ask again in a moment."""


class Background:
    """Results by a key that contains everything they depend on."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="figures")
        self._lock = threading.Lock()
        self._known: OrderedDict[Hashable, Future[Any]] = OrderedDict()
        self._idle: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()
        self._idling = False
        self._requests, self._last = 0, time.monotonic()

    def get(self, key: Hashable, work: Callable[[], Any], patience_s: float | None = None) -> Any:
        """Return the result of ``work``, or raise its error.

        Raises
        ------
        NotReadyError
            if that takes longer than ``patience_s`` (None: :data:`PATIENCE_S`), or too many requests are waiting.
        """
        with self._lock:
            future = self._known.get(key)
            if future is None:
                if sum(not item.done() for item in self._known.values()) >= WAITING:
                    raise NotReadyError
                future = self._known[key] = self._pool.submit(work)
            self._known.move_to_end(key)
            self._forget()
        try:
            return future.result(PATIENCE_S if patience_s is None else patience_s)
        except NotYetError as error:
            raise NotReadyError from error
        except InputError:
            raise
        except Exception:
            with self._lock:  # the problem may be temporary: the next request tries again
                self._known.pop(key, None)
            raise

    def later(self, key: Hashable, work: Callable[[], None]) -> None:
        """Do ``work``, which stores its result itself, when the server is idle; it is queued once.

        It starts :data:`REST_S` after the last request, or after :data:`AT_LATEST_S` on a server that is never idle.
        """
        with self._lock:
            if len(self._idle) < MOST_LATER:
                self._idle.setdefault(key, work)
            if not self._idling:
                self._idling = True
                threading.Thread(target=self._work_at_rest, name="figures in idle time", daemon=True).start()

    def began(self) -> None:
        """Note that a request arrived."""
        with self._lock:
            self._requests += 1

    def ended(self) -> None:
        """Note that a request was answered."""
        with self._lock:
            self._requests, self._last = max(0, self._requests - 1), time.monotonic()

    def _work_at_rest(self) -> None:
        """Do the tasks that wait for an idle moment, one after the other, until none is left."""
        since = time.monotonic()
        while True:
            with self._lock:
                if not self._idle:
                    self._idling = False
                    return
                now = time.monotonic()
                rests = self._requests == 0 and now - self._last >= REST_S
                rests = rests and all(future.done() for future in self._known.values())
                work = self._idle.popitem(last=False)[1] if rests or now - since >= AT_LATEST_S else None
            if work is None:
                time.sleep(REST_S)
                continue
            try:
                future = self._pool.submit(work)
            except RuntimeError:  # the server stops
                return
            error = future.exception()
            if error is not None:  # it will be requested again; the page of that machine shows the problem
                logs.warning("figures not calculated", problem=f"{type(error).__name__}: {error}")
            since = time.monotonic()

    def _forget(self) -> None:
        """Drop the least recently requested results; keep what is being calculated."""
        for key in [key for key, item in self._known.items() if item.done()][: max(0, len(self._known) - MOST)]:
            del self._known[key]


@dataclass
class _Page:
    """One page, what it was made from, and until when it is shown; made by one request while the others wait."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    made_from: Hashable = None
    until: float = 0.0
    text: str = ""


class Pages:
    """Pages by address, each made once for every state of what it shows.

    Every request calls ``state``, so a page is never older than the data at that time.
    """

    def __init__(self, state: Callable[[], Hashable]) -> None:
        self._state, self._lock = state, threading.Lock()
        self._pages: OrderedDict[Hashable, _Page] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], tuple[str, bool]]) -> str:
        """Return the page; ``make`` returns its text and whether it is complete: if not, it is soon made again."""
        state = self._state()
        with self._lock:
            page = self._pages.setdefault(key, _Page())
            self._pages.move_to_end(key)
            while len(self._pages) > PAGES:
                self._pages.popitem(last=False)
        with page.lock:
            if page.made_from != state or time.monotonic() >= page.until:
                page.text, complete = make()
                page.made_from, page.until = state, time.monotonic() + (SHOWN_S if complete else WAITING_SHOWN_S)
            return page.text


# --- drift ---------------------------------------------------------------------------------------------------------

#: Largest number of figures drawn, the most significant first.
DRAWN = 12
MACHINES = database.machines


@dataclass(frozen=True)
class ChangeRow:
    """Change of one error where it changed most, since the last and since the first calibration, with intervals."""

    error: str
    unit: str
    last: tuple[float, float, float] | None
    first: tuple[float, float, float] | None


@dataclass(frozen=True)
class TrendRow:
    """Trend of one figure: change per month with expanded uncertainty, adjusted error probability, steps, forecast.

    ``significant``: whether its slope or one of its steps exceeds the uncertainty, corrected for all figures.
    """

    name: str
    unit: str
    rate: float
    expanded: float
    adjusted: float
    per_kelvin: tuple[float, float] | None
    steps: Sequence[str]
    tolerance: float | None
    forecast: str
    significant: bool


class JobFile:
    """The current job file; read again when it has changed."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._lock = path, threading.Lock()
        self._state: tuple[int, int] | None = None
        self._job: Job | None = None

    def state(self) -> tuple[int, int] | None:
        """Return what changes when the file is written, None if there is no file."""
        if self._path is None or not self._path.is_file():
            return None
        stat = self._path.stat()
        return stat.st_mtime_ns, stat.st_size

    def tolerances(self, machine: str) -> Mapping[str, float]:
        """Return the tolerances of a machine, mm and rad, by error; empty without a job file or such a machine."""
        state = self.state()
        if self._path is None or state is None:
            return {}
        with self._lock:
            if self._job is None or state != self._state:
                self._job, self._state = read_job(self._path), state
            found = self._job.machines.get(machine)
        return {} if found is None else found.tolerances


class DriftCache:
    """Drifts of machines, calculated in the background."""

    def __init__(self, store: Store, background: Background, job: JobFile) -> None:
        self._store, self._background, self._job = store, background, job
        self._outlooks: dict[int, tuple[Hashable, tuple[str, str]]] = {}

    def __call__(self, machine: MachineRecord, patience_s: float | None = None) -> Drift:
        """Return the drift; InputError if no errors have uncertainties, NotReadyError while it is being calculated."""
        states = self._store.read(lambda c: c.execute(state_query().where(MACHINES.c.id == machine.id)).all())
        tolerances = self._job.tolerances(machine.name)
        key = ("drift", machine.id, tuple(states[0])[1:] if states else (), tuple(sorted(tolerances.items())))
        work = partial(drift_of_store, self._store, machine, DriftSettings(tolerances))
        found: Drift = self._background.get(key, work, patience_s)
        return found

    def outlooks(self, machines: Sequence[MachineRecord]) -> dict[int, tuple[str, str]]:
        """Return by machine id, as far as known, what changes and when a tolerance is exceeded.

        The others are calculated one after the other while the server is idle.
        """
        rows = self._store.read(lambda connection: connection.execute(state_query()).all())
        states = {row[0]: tuple(row)[1:] for row in rows}
        found: dict[int, tuple[str, str]] = {}
        for machine in machines:
            tolerances = self._job.tolerances(machine.name)
            key = (machine.id, states.get(machine.id, ()), tuple(sorted(tolerances.items())))
            known = self._outlooks.get(machine.id)
            if known is not None and known[0] == key:
                found[machine.id] = known[1]
            else:
                self._background.later(key, partial(self._look, machine, tolerances, key))
        return found

    def _look(self, machine: MachineRecord, tolerances: Mapping[str, float], key: Hashable) -> None:
        if self._outlooks.get(machine.id, (None,))[0] == key:
            return  # two pages requested it
        try:
            said = drift_of_store(self._store, machine, DriftSettings(tolerances)).outlook()
        except InputError:  # no calibrations with uncertainties
            said = ("", "")
        self._outlooks[machine.id] = (key, said)


def state_query() -> sa.Select[Any]:
    """Everything in the store that a machine's drift depends on: id, last decision, identification, exclusion."""
    decisions, made, events = database.decisions, database.identifications, database.events
    newest = [
        sa.select(sa.func.max(decisions.c.sequence)).where(decisions.c.machine_id == MACHINES.c.id),
        sa.select(sa.func.max(made.c.id)).where(made.c.machine_id == MACHINES.c.id),
        sa.select(sa.func.max(events.c.id)).where(events.c.machine_id == MACHINES.c.id, events.c.kind == EXCLUSION),
    ]
    return sa.select(MACHINES.c.id, *(query.scalar_subquery() for query in newest))


def change_rows(drift: Drift) -> Sequence[ChangeRow]:
    """Return each error's largest change, expanded uncertainty, adjusted error probability, in the units of files."""
    last, first = (
        {
            item.error: (item.largest / scale, COVERAGE * item.u / scale, item.adjusted)
            for item in changes
            for scale in (error_named(item.error).si_per_unit,)
        }
        for changes in (drift.since_last, drift.since_first)
    )
    names = dict.fromkeys([*first, *last])
    return [ChangeRow(name, LABEL[error_named(name).unit], last.get(name), first.get(name)) for name in names]


def trend_rows(drift: Drift) -> Sequence[TrendRow]:
    """Return the trends, most significant first, in the units of files and months."""
    level, found = 1.0 - drift.settings.confidence, []
    for item in sorted(drift.figures, key=lambda item: item.p_value):
        if item.trend is None:
            continue
        scale = item.figure.scale
        month, (rate, u), kelvin = DAYS_A_MONTH * scale, item.trend.slope, item.trend.per_kelvin
        row = TrendRow(
            name=item.figure.name,
            unit=LABEL[item.figure.unit],
            rate=rate * month,
            expanded=COVERAGE * u * month,
            adjusted=item.adjusted,
            per_kelvin=None if kelvin is None else (kelvin[0] * scale, COVERAGE * kelvin[1] * scale),
            steps=[
                f"{step.size * scale:+.2f} before {drift.times[step.after][:10]} "
                f"(p {'< 0.001' if step.p_value < 1e-3 else f'{step.p_value:.3f}'})"
                for step in item.trend.steps
            ],
            tolerance=None if item.tolerance is None else item.tolerance * scale,
            forecast="" if item.forecast is None else item.forecast.words(item.figure.name),
            significant=item.p_value < level,
        )
        found.append(row)
    return found


def drift_charts(drift: Drift) -> Sequence[Chart]:
    """Draw the volume relative to what the active tables compensate, temperatures, and the important figures.

    Important figures drift, have a step or follow the temperature beyond the uncertainty, or have a tolerance.
    """
    times = [datetime.fromisoformat(text) for text in drift.times]
    seconds, marks = [time.timestamp() for time in times], time_ticks(times)
    volume = [
        ChartSeries("change against the active tables", seconds, [rms for rms, _ in drift.volume_um]),
        ChartSeries("expected from the uncertainty alone", seconds, [expected for _, expected in drift.volume_um]),
    ]
    found = [chart("Change in the volume, rms, \N{MICRO SIGN}m", volume, marks)]
    if drift.temperature_c is not None:
        found.append(
            chart("Mean temperature, \N{DEGREE SIGN}C", [ChartSeries("mean", seconds, drift.temperature_c)], marks)
        )
    level, warm = 1.0 - drift.settings.confidence, following_temperature(drift)
    known = [item for item in drift.figures if item.trend is not None]
    shown = [item for item in known if item.p_value < level or item.figure.name in warm or item.tolerance is not None]
    shown.sort(key=lambda item: (item.p_value, item.figure.name))
    for item in shown[:DRAWN]:
        scale = item.figure.scale
        value, u = item.series.value * scale, COVERAGE * item.series.u * scale
        series = [ChartSeries("identified", seconds, value.tolist(), u.tolist())]
        days, line = item.line()
        label = "trend with steps" if item.trend is not None and item.trend.steps else "trend"
        series.append(ChartSeries(label, (seconds[0] + 86400.0 * days).tolist(), (line * scale).tolist(), marked=False))
        for limit in item.limits:
            ends = (seconds[0], seconds[-1]), (limit * scale, limit * scale)
            series.append(ChartSeries("limit of the tolerance", *ends, marked=False))
        found.append(chart(f"{item.figure.name}, {LABEL[item.figure.unit]}", series, marks))
    return [item for item in found if item is not None]


# --- shortest re-check ---------------------------------------------------------------------------------------------

#: Size of the change that the page first requests if there is no tolerance, um or urad.
FIRST_CHANGE = 10.0
#: Largest change that may be requested, um or urad.
LARGEST = 10_000.0


@dataclass(frozen=True)
class Basis:
    """Starting point of a re-check: the newest calibration with known tracer positions, and what it identified."""

    identification: IdentificationRecord
    stations: PlannedStations
    errors: Sequence[str]


def basis(store: Store, machine: MachineRecord) -> Basis:
    """Return the starting point; InputError if no calibration of the machine was measured with tracers."""
    for item in reversed(counting(store, machine)):
        stations = stations_of(item.summary)
        errors = [str(name) for name in item.summary.get("identified", ())]
        if stations is not None and errors and item.covariance_sha256 is not None:
            order = sorted(errors, key=lambda name: (name not in SQUARENESS_NAMES, name))
            return Basis(item, stations, order)
    raise InputError("no calibration of this machine states where its tracers were, so a re-check cannot be planned")


def stations_of(summary: Mapping[str, Any]) -> PlannedStations | None:
    """Return the stations of an identification; None if it has none. Beam breaks do not add passes."""
    listed = [item for item in summary.get("stations") or () if not item.get("segment")]
    places = {str(item["station"]): item["position_mm"] for item in listed}
    if not places:
        return None
    names = tuple(places)
    passes = [(names.index(str(item["station"])), int(item.get("setup", 0))) for item in listed]
    return PlannedStations(names, np.array([places[name] for name in names], dtype=np.float64), np.array(passes))


def requested_change(
    given: Mapping[str, str], start: Basis, tolerances: Mapping[str, float]
) -> tuple[RequestedChange, str]:
    """Return the requested error and change, with defaults, and the change as text in the unit of files."""
    name = given.get("error") or next((item for item in start.errors if item in tolerances), start.errors[0])
    if name not in start.errors:
        raise InputError("choose an error that the last calibration identified")
    scale = error_named(name).si_per_unit
    text = given.get("change", "").strip() or f"{tolerances.get(name, FIRST_CHANGE * scale) / scale:g}"
    try:
        size = float(text)
    except ValueError:
        size = 0.0
    if not 0.0 < size <= LARGEST:
        raise InputError(f"give the change as a number above 0, at most {LARGEST:g} {LABEL[error_named(name).unit]}")
    return RequestedChange(name, size * scale), text


class RecheckCache:
    """Re-checks, calculated in the background."""

    def __init__(self, store: Store, background: Background) -> None:
        self._store, self._background = store, background

    def __call__(self, start: Basis, request: RequestedChange) -> Recheck:
        """Return the re-check; InputError if it is not possible, NotReadyError while it is being calculated."""
        key = ("recheck", start.identification.id, request)

        def work() -> Recheck:
            machine = self._store.machine_of(start.identification)
            covariance = self._store.covariance_of(start.identification)
            return shortest_recheck(machine, start.stations, request, covariance)

        found: Recheck = self._background.get(key, work)
        return found
