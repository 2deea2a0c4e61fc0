"""The drift of a machine as :mod:`compgen.recal.drift` judges it; worked out once per state of the store."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

from compgen.core.names import error_named
from compgen.recal.drift import Drift, DriftSettings, drift_of_store
from compgen.recal.records import MachineRecord
from compgen.recal.store import Store
from compgen.serve.chart import UNITS
from compgen.serve.history import COVERAGE

#: Drifts that stay in memory.
MOST = 200


@dataclass(frozen=True)
class ChangeRow:
    """Change of one error where it changed most: since the last and since the first calibration, with intervals."""

    error: str
    unit: str
    last: tuple[float, float, float] | None
    first: tuple[float, float, float] | None


class DriftCache:
    """Works out one drift at a time: nobody can keep all processors busy by asking."""

    def __init__(self, store: Store) -> None:
        self._store, self._lock = store, threading.Lock()
        self._known: OrderedDict[tuple[int, ...], Drift] = OrderedDict()

    def __call__(self, machine: MachineRecord) -> Drift:
        """Return the drift; InputError where the store holds no errors with uncertainties."""
        active = next((t.id for t in self._store.tables(machine, figures=False) if t.state == "active"), 0)
        key = (machine.id, active, *(item.id for item in self._store.identifications(machine)))
        with self._lock:
            if key not in self._known:
                self._known[key] = drift_of_store(self._store, machine, DriftSettings())
            self._known.move_to_end(key)
            while len(self._known) > MOST:
                self._known.popitem(last=False)
            return self._known[key]


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
