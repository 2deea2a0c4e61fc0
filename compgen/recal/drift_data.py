"""The calibrations of one machine on common figures: gauge-aligned, each with its joint covariance.

Two tables of errors may describe the same machine (:mod:`compgen.model.gauge`). Every calibration is therefore brought
into one gauge first: along the gauge directions the curves are made as small as possible, so that constants vanish and
slopes which a squareness error holds as well stand there. That map is linear, so covariances follow it.

A curve is watched by two figures of its best-fit parabola: ``line``, what its straight part adds from the first to the
last node, and ``bow``, by how much the middle stands above the ends. A squareness error is its own ``value``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.identify.covariance import Covariance
from compgen.model.basis import hat_matrix
from compgen.model.gauge import LEVER_MM, gauge_directions
from compgen.recal.change import spread_of
from compgen.recal.counting import counting
from compgen.recal.exclude import excluded
from compgen.recal.records import MachineRecord
from compgen.recal.store import Store

#: A figure whose weights keep less than this share of their size in the common gauge is not observable.
NOTHING_LEFT = 1e-6
#: A calibration that shows less than this share of the errors of the richest one is left out.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Calibration:
    """One identification: when it was measured, errors (mm, rad) with covariance, mean temperature by channel, degC."""

    at: datetime
    errors: ErrorTable
    covariance: Covariance
    temperatures_c: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Figure:
    """One watched quantity of one error: ``part`` is "value", "line" or "bow"; mm or rad inside."""

    error: str
    part: str

    @property
    def unit(self) -> str:
        """Unit in reports: um or urad."""
        return error_named(self.error).unit

    @property
    def name(self) -> str:
        """Name in reports, e.g. ``EXX line``, ``EC0Y``."""
        return self.error if self.part == "value" else f"{self.error} {self.part}"


@dataclass(frozen=True)
class Aligned:
    """All calibrations in one gauge on the same k error values.

    Parameters
    ----------
    machine : chain, travel and tool offset that the gauge is that of.
    error, position_mm : name and position (k,) of each value; nan for squareness.
    days : times in days since the first calibration, (n,).
    value : (n, k), mm and rad. ``factor``: n factors (k, r_i) of the covariance of each.
    figures, weights : f watched figures and what each takes of the values, (f, k).
    """

    machine: Machine
    error: tuple[str, ...]
    position_mm: FloatArray
    days: FloatArray
    value: FloatArray
    factor: tuple[FloatArray, ...]
    figures: tuple[Figure, ...]
    weights: FloatArray

    def figure_values(self) -> FloatArray:
        """Values of the figures, (n, f)."""
        return np.asarray(self.value @ self.weights.T)

    def figure_u(self) -> FloatArray:
        """Standard uncertainties of the figures, (n, f)."""
        return np.array([np.linalg.norm(self.weights @ factor, axis=1) for factor in self.factor])

    def columns(self, name: str) -> NDArray[np.intp]:
        """Positions in the list of values that belong to an error."""
        return np.flatnonzero(np.array(self.error) == name)

    def field_covariance(self, k: int) -> Covariance:
        """Covariance of calibration ``k`` in the common gauge."""
        return Covariance(self.error, self.position_mm, (), np.zeros(0, dtype=np.int64), self.factor[k])


def calibrations_of(store: Store, machine: MachineRecord) -> tuple[list[Calibration], list[int], Machine]:
    """Return the calibrations of a machine with known uncertainty, their identification ids, and the newest machine file.

    Those that a person excluded are left out. InputError if there is none.
    """
    return store.together(lambda: _calibrations(store, machine))


def _calibrations(store: Store, machine: MachineRecord) -> tuple[list[Calibration], list[int], Machine]:
    left_out, records = excluded(store, machine), counting(store, machine)
    measured = {item.id: item for item in store.measurements(machine)}
    found, ids = [], []
    for record in records:
        errors = store.errors_of(record)
        covariance = spread_of(errors, store.covariance_of(record))
        if covariance is not None and record.measurement_id not in left_out:
            logged = measured[record.measurement_id].temperatures_c
            means = {name: float(figures["mean"]) for name, figures in logged.items()}
            found.append(Calibration(record.measured_at, errors, covariance, means))
            ids.append(record.id)
    if not found:
        raise InputError(
            f"the store holds no identified errors of {machine.name!r} with uncertainties; measure it first"
        )
    newest = next(item for item in records if item.id == ids[-1])
    return found, ids, store.machine_of(newest)


def with_all_errors(
    history: Sequence[Calibration], ids: Sequence[int]
) -> tuple[list[Calibration], list[int], list[str]]:
    """Keep the calibrations that show at least half of the errors of the richest one; return a note about the others.

    What a laser along one axis saw has another gauge, and would leave nothing but that axis to compare.
    """
    names = [{*item.covariance.error} for item in history]
    wanted = max(names, key=len)
    kept = [k for k, found in enumerate(names) if len(found & wanted) >= LEAST_SHARE * len(wanted)]
    left = len(history) - len(kept)
    notes = [f"{left} of {len(history)} calibrations are left out: they show a few errors only"] if left else []
    return [history[k] for k in kept], [ids[k] for k in kept], notes


def aligned(machine: Machine, history: Sequence[Calibration]) -> Aligned:
    """Bring calibrations, oldest first, into one gauge on the nodes of the newest."""
    if any(late.at < early.at for early, late in zip(history, history[1:], strict=False)):
        raise InputError("calibrations must stand in the order of their times; sort them")
    common = set.intersection(*({*item.covariance.error} for item in history))
    newest = history[-1].covariance
    kept = [k for k, name in enumerate(newest.error) if name in common]
    if not kept:
        raise InputError("the calibrations have no error in common; keep the errors of the machine file the same")
    error, position = tuple(newest.error[k] for k in kept), newest.position_mm[kept]
    keep = _gauge_projector(machine, error, position)
    maps = [keep @ _resampler(error, position, item.covariance) for item in history]
    values = [each @ _values(item) for each, item in zip(maps, history, strict=True)]
    factors = [each @ item.covariance.errors_factor for each, item in zip(maps, history, strict=True)]
    seconds = [(item.at - history[0].at).total_seconds() for item in history]
    figures, weights = _figures(error, position, keep)
    days = np.array(seconds) / 86400.0
    return Aligned(machine, error, position, days, np.array(values), tuple(factors), figures, weights)


def _values(item: Calibration) -> FloatArray:
    """Values of a calibration in the order of its covariance."""
    errors, found = item.errors, []
    for name, position in zip(item.covariance.error, item.covariance.position_mm.tolist(), strict=True):
        is_constant = name in errors.squareness
        found.append(errors.squareness[name][0] if is_constant else float(errors.curves[name].at(np.array(position))))
    return np.array(found)


def _resampler(error: Sequence[str], position_mm: FloatArray, source: Covariance) -> FloatArray:
    """Matrix (k, k_i) that takes values of one calibration to the common nodes, linear in between."""
    names, given = np.array(error), np.array(source.error)
    matrix = np.zeros((len(names), len(given)))
    for name in dict.fromkeys(error):
        rows, columns = np.flatnonzero(names == name), np.flatnonzero(given == name)
        if name in SQUARENESS_NAMES:
            matrix[np.ix_(rows, columns)] = 1.0
        else:
            matrix[np.ix_(rows, columns)] = hat_matrix(source.position_mm[columns], position_mm[rows])
    return matrix


def _gauge_projector(machine: Machine, error: Sequence[str], position_mm: FloatArray) -> FloatArray:
    """Matrix (k, k) that takes the gauge directions out so that the curves, not squareness, become small."""
    counts = {name: error.count(name) for name in error}
    names = [name for name, count in counts.items() if count > 1 or name in SQUARENESS_NAMES]
    directions = gauge_directions(machine, names)
    index = [ERROR_INDEX[name] for name in error]
    shapes = directions[:, index, 0] + directions[:, index, 1] * np.nan_to_num(position_mm)
    gauge = shapes.T  # (k, directions)
    weight = np.array([_weight(name, counts[name]) for name in error])
    gauge = gauge / np.maximum(np.linalg.norm(weight[:, None] * gauge, axis=0), 1e-300)
    amounts = np.linalg.pinv(weight[:, None] * gauge, rcond=1e-10) * weight
    return np.asarray(np.eye(len(error)) - gauge @ amounts)


def _weight(name: str, count: int) -> float:
    kind = error_named(name).kind
    if kind == "squareness":
        return 0.0
    return (1.0 if kind == "linear" else LEVER_MM) / float(np.sqrt(count))


def _figures(error: Sequence[str], position_mm: FloatArray, keep: FloatArray) -> tuple[tuple[Figure, ...], FloatArray]:
    """Figures that the common gauge leaves, and their weights (f, k)."""
    figures, rows = [], []
    for name in dict.fromkeys(error):
        columns = np.flatnonzero(np.array(error) == name)
        for part, weights in _parts(name, position_mm[columns]).items():
            row = np.zeros(len(error))
            row[columns] = weights
            if np.linalg.norm(row @ keep) > NOTHING_LEFT * np.linalg.norm(row):
                figures.append(Figure(name, part))
                rows.append(row)
    return tuple(figures), np.array(rows).reshape(-1, len(error))


def _parts(name: str, position_mm: FloatArray) -> dict[str, FloatArray]:
    if name in SQUARENESS_NAMES:
        return {"value": np.ones(1)}
    if len(position_mm) < 2:
        return {}
    share = np.interp(position_mm, (position_mm[0], position_mm[-1]), (-1.0, 1.0))
    degree = 2 if len(position_mm) > 2 else 1
    fit = np.linalg.pinv(np.vander(share, degree + 1, increasing=True))
    found = {} if error_named(name).is_straightness else {"line": 2.0 * fit[1]}
    return found | ({"bow": -fit[2]} if degree == 2 else {})
