"""The shortest re-check of a machine: few points at which its tracers would see a wanted change of one error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.names import SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.plan import PlannedStations
from compgen.recal.counting import counting
from compgen.recal.recheck import Recheck, Wanted, shortest_recheck
from compgen.recal.records import IdentificationRecord, MachineRecord
from compgen.recal.store import Store
from compgen.serve.background import Background
from compgen.serve.chart import UNITS

#: Without a tolerance the page asks for a change of this size first, um or urad.
FIRST_CHANGE = 10.0
#: Largest change that may be asked for, um or urad.
LARGEST = 10_000.0
POWER = 0.9


@dataclass(frozen=True)
class Basis:
    """What a re-check starts from: the newest calibration that says where its tracers stood, and what it identified."""

    identification: IdentificationRecord
    stations: PlannedStations
    errors: Sequence[str]


def basis(store: Store, machine: MachineRecord) -> Basis:
    """Return it; InputError if no calibration of the machine was measured with tracers."""
    for item in reversed(counting(store, machine)):
        stations = stations_of(item.summary)
        errors = [str(name) for name in item.summary.get("identified", ())]
        if stations is not None and errors and item.covariance_sha256 is not None:
            order = sorted(errors, key=lambda name: (name not in SQUARENESS_NAMES, name))
            return Basis(item, stations, order)
    raise InputError("no calibration of this machine says where its tracers stood, so a re-check cannot be planned")


def stations_of(summary: Mapping[str, Any]) -> PlannedStations | None:
    """Return the stations of an identification; None if there are none. Beam breaks add no passes."""
    listed = [item for item in summary.get("stations") or () if not item.get("segment")]
    places = {str(item["station"]): item["position_mm"] for item in listed}
    if not places:
        return None
    names = tuple(places)
    passes = [(names.index(str(item["station"])), int(item.get("setup", 0))) for item in listed]
    return PlannedStations(names, np.array([places[name] for name in names], dtype=np.float64), np.array(passes))


def wanted_of(given: Mapping[str, str], start: Basis, tolerances: Mapping[str, float]) -> tuple[Wanted, str]:
    """Return error and change that the address asks for, with defaults; and the change in the unit of files as text."""
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
        raise InputError(f"the change is a number above 0, at most {LARGEST:g} {UNITS[error_named(name).unit]}")
    return Wanted(name, size * scale, POWER), text


class RecheckCache:
    """Re-checks, worked out beside the requests."""

    def __init__(self, store: Store, background: Background) -> None:
        self._store, self._background = store, background

    def __call__(self, start: Basis, wanted: Wanted) -> Recheck:
        """Return the re-check; InputError for one that cannot be, NotReadyError while it is worked out."""
        key = ("recheck", start.identification.id, wanted)

        def work() -> Recheck:
            machine = self._store.machine_of(start.identification)
            covariance = self._store.covariance_of(start.identification)
            return shortest_recheck(machine, start.stations, wanted, covariance)

        found: Recheck = self._background.get(key, work)
        return found
