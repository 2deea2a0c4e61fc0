"""The drift of a machine as :mod:`compgen.recal.drift` judges it; worked out once per state of store and job file."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from compgen.core.names import error_named
from compgen.errors import InputError
from compgen.recal import schema
from compgen.recal.drift import Drift, DriftSettings, FigureDrift, drift_of_store
from compgen.recal.drift_trend import Step
from compgen.recal.drift_words import following_temperature
from compgen.recal.exclude import KIND as EXCLUSION
from compgen.recal.job import Job, read_job
from compgen.recal.records import MachineRecord
from compgen.recal.store import Store
from compgen.serve.background import Background
from compgen.serve.chart import UNITS, Chart, Series, chart
from compgen.serve.history import COVERAGE, time_ticks

DAYS_A_MONTH = 30.4375
#: Figures that are drawn at most, the most significant first.
DRAWN = 12
MACHINES = schema.machines


@dataclass(frozen=True)
class ChangeRow:
    """Change of one error where it changed most: since the last and since the first calibration, with intervals."""

    error: str
    unit: str
    last: tuple[float, float, float] | None
    first: tuple[float, float, float] | None


@dataclass(frozen=True)
class TrendRow:
    """Trend of one figure: change a month with expanded uncertainty, adjusted error probability, steps, forecast.

    ``significant``: whether its slope or a step of it is beyond the uncertainty, all figures counted.
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
    """The job file as it is now; read again when it changed."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._lock = path, threading.Lock()
        self._state: tuple[int, int] | None = None
        self._job: Job | None = None

    def state(self) -> tuple[int, int] | None:
        """Return what changes when the file is written, None where there is none."""
        if self._path is None or not self._path.is_file():
            return None
        stat = self._path.stat()
        return stat.st_mtime_ns, stat.st_size

    def tolerances(self, machine: str) -> Mapping[str, float]:
        """Return the tolerances of a machine, mm and rad, by error; none without a job file or such a machine."""
        state = self.state()
        if self._path is None or state is None:
            return {}
        with self._lock:
            if self._job is None or state != self._state:
                self._job, self._state = read_job(self._path), state
            found = self._job.machines.get(machine)
        return {} if found is None else found.tolerances


class DriftCache:
    """Drifts of machines, worked out beside the requests."""

    def __init__(self, store: Store, background: Background, job: JobFile) -> None:
        self._store, self._background, self._job = store, background, job
        self._outlooks: dict[int, tuple[Hashable, tuple[str, str]]] = {}

    def __call__(self, machine: MachineRecord, patience_s: float | None = None) -> Drift:
        """Return the drift; InputError where there are no errors with uncertainties, NotReadyError while it is made."""
        states = self._store.read(lambda c: c.execute(state_query().where(MACHINES.c.id == machine.id)).all())
        return self._drift(machine, tuple(states[0])[1:] if states else (), patience_s)

    def outlooks(self, machines: Sequence[MachineRecord]) -> dict[int, tuple[str, str]]:
        """Return what moves and when a tolerance is left, by the id of the machine; those that are known by now.

        The others are worked out one after the other while the server has nothing else to do.
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
            return  # two pages asked for it
        try:
            said = drift_of_store(self._store, machine, DriftSettings(tolerances)).outlook()
        except InputError:  # no calibrations with uncertainties
            said = ("", "")
        self._outlooks[machine.id] = (key, said)

    def _drift(self, machine: MachineRecord, state: tuple[Any, ...], patience_s: float | None) -> Drift:
        tolerances = self._job.tolerances(machine.name)

        def work() -> Drift:
            return drift_of_store(self._store, machine, DriftSettings(tolerances))

        key = ("drift", machine.id, state, tuple(sorted(tolerances.items())))
        found: Drift = self._background.get(key, work, patience_s)
        return found


def state_query() -> sa.Select[Any]:
    """Everything of the store that the drift of a machine depends on: id, last decision, identification, exclusion."""
    decisions, made, events = schema.decisions, schema.identifications, schema.events
    newest = [
        sa.select(sa.func.max(decisions.c.sequence)).where(decisions.c.machine_id == MACHINES.c.id),
        sa.select(sa.func.max(made.c.id)).where(made.c.machine_id == MACHINES.c.id),
        sa.select(sa.func.max(events.c.id)).where(events.c.machine_id == MACHINES.c.id, events.c.kind == EXCLUSION),
    ]
    return sa.select(MACHINES.c.id, *(query.scalar_subquery() for query in newest))


def change_rows(drift: Drift) -> Sequence[ChangeRow]:
    """Return largest change, expanded uncertainty and adjusted error probability of every error, in units of files."""
    last, first = (
        {
            item.error: (item.largest / scale, COVERAGE * item.u / scale, item.adjusted)
            for item in changes
            for scale in (error_named(item.error).si_per_unit,)
        }
        for changes in (drift.since_last, drift.since_first)
    )
    names = dict.fromkeys([*first, *last])
    return [ChangeRow(name, UNITS[error_named(name).unit], last.get(name), first.get(name)) for name in names]


def trend_rows(drift: Drift) -> Sequence[TrendRow]:
    """Return the trends, the most significant first, in units of files and months."""
    known = [item for item in drift.figures if item.trend is not None]
    level = 1.0 - drift.settings.confidence
    return [_trend_row(item, drift.times, level) for item in sorted(known, key=lambda item: item.p_value)]


def _trend_row(item: FigureDrift, times: Sequence[str], level: float) -> TrendRow:
    assert item.trend is not None
    scale = 1.0 / error_named(item.figure.error).si_per_unit
    unit, (rate, u), kelvin = UNITS[item.figure.unit], item.trend.slope, item.trend.per_kelvin
    month = DAYS_A_MONTH * scale
    return TrendRow(
        item.figure.name,
        unit,
        rate * month,
        COVERAGE * u * month,
        item.adjusted,
        None if kelvin is None else (kelvin[0] * scale, COVERAGE * kelvin[1] * scale),
        [_step_words(step, scale, times) for step in item.trend.steps],
        None if item.tolerance is None else item.tolerance * scale,
        "" if item.forecast is None else item.forecast.words(item.figure.name),
        item.p_value < level,
    )


def _step_words(step: Step, scale: float, times: Sequence[str]) -> str:
    chance = "< 0.001" if step.p_value < 1e-3 else f"{step.p_value:.3f}"
    return f"{step.size * scale:+.2f} before {times[step.after][:10]} (p {chance})"


def drift_charts(drift: Drift) -> Sequence[Chart]:
    """Draw the volume against what the active tables take out, temperatures, and the figures that matter.

    Those are the ones that drift, have a step or follow the temperature beyond the uncertainty, and those with a tolerance.
    """
    times = [datetime.fromisoformat(text) for text in drift.times]
    seconds, marks = [time.timestamp() for time in times], time_ticks(times)
    volume = [
        Series("change against the active tables", seconds, [rms for rms, _ in drift.volume_um]),
        Series("expected from the uncertainty alone", seconds, [expected for _, expected in drift.volume_um]),
    ]
    found = [chart("Change in the volume, rms, \N{MICRO SIGN}m", volume, marks)]
    if drift.temperature_c is not None:
        found.append(chart("Mean temperature, \N{DEGREE SIGN}C", [Series("mean", seconds, drift.temperature_c)], marks))
    level, warm = 1.0 - drift.settings.confidence, following_temperature(drift)
    known = [item for item in drift.figures if item.trend is not None]
    shown = [item for item in known if item.p_value < level or item.figure.name in warm or item.tolerance is not None]
    shown.sort(key=lambda item: (item.p_value, item.figure.name))
    found += [_figure_chart(item, seconds, marks) for item in shown[:DRAWN]]
    return [item for item in found if item is not None]


def _figure_chart(item: FigureDrift, seconds: Sequence[float], marks: Sequence[tuple[float, str]]) -> Chart | None:
    scale = 1.0 / error_named(item.figure.error).si_per_unit
    value, u = item.series.value * scale, COVERAGE * item.series.u * scale
    series = [Series("identified", seconds, value.tolist(), u.tolist())]
    days, level = item.line()
    label = "trend with steps" if item.trend is not None and item.trend.steps else "trend"
    series.append(Series(label, (seconds[0] + 86400.0 * days).tolist(), (level * scale).tolist(), marked=False))
    if item.tolerance is not None:
        ends = np.array([item.reference - item.tolerance, item.reference + item.tolerance]) * scale
        span = (seconds[0], seconds[-1])
        series += [Series("limit of the tolerance", span, (end, end), marked=False) for end in ends.tolist()]
    return chart(f"{item.figure.name}, {UNITS[item.figure.unit]}", series, marks)
