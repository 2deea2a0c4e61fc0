"""Whether a machine has changed between calibrations, given the uncertainty of both."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.comparison import Difference, SmallMotion, Uncertain, compare, sizes_of, small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.repeatability import EXPANSION_SHARE, USUAL_UM_PER_M_K
from compgen.errors import InputError
from compgen.fleet.decisions import excluded
from compgen.fleet.records import AFTER, WITHOUT_PRIOR, IdentificationRecord, MachineRecord, TableRecord, comparable
from compgen.fleet.store import Store, at_one_moment, counting
from compgen.identification.covariance import (
    Covariance,
    covariance_of_values,
    covariance_or_independent,
    error_design,
    values_at_nodes,
)
from compgen.kinematics.gauge import curve_weights, gauge_changes, gauge_directions, gauge_part
from compgen.kinematics.many_points import full_grid, volumetric_error

# Whether a machine has changed between two measurements, given the uncertainty of both.
#
# The change is E = C P of the new errors minus E of the old errors at points of the volume, with the best-fit rigid
# motion removed: the gauge directions, which no measurement shows, do not count. If nothing changed, its covariance is
# the sum of both covariances, which gives the probability of its sum of squares (:mod:`compgen.data.comparison`).


#: Identified errors and their covariance, if known.
Known = tuple[ErrorTable, Covariance | None]
#: Points along each axis of the grid on which the change is evaluated.
POINTS = 6
#: A change equals a field if it differs from it by at most the first share of the field (rms) beyond the noise, or by
#: at most the second share if it contains the field once, within the third: then a drift of another shape was added.
ALIKE, DRIFTED, ONCE = 0.25, 0.5, 0.1
#: Lower probabilities are reported as this one: the number of independent directions is known only roughly.
LEAST_P = 1e-9


@dataclass(frozen=True)
class Change:
    """Change of the machine over its volume, rigid motion removed, um.

    ``expected_rms_um`` is the rms due to the uncertainties alone, and to how well the machine repeats where that counts;
    ``p_value`` the probability of at least this change if the machine had not changed. ``largest`` says what changed most
    significantly, over how many of the last calibrations; ``known_from`` with how many earlier ones it was compared.
    """

    rms_um: float
    max_um: float
    expected_rms_um: float
    p_value: float
    confidence: float
    largest: str = ""
    known_from: int = 1

    @property
    def significant(self) -> bool:
        """Whether the change exceeds its uncertainty with the requested confidence."""
        return self.p_value < 1.0 - self.confidence

    def summary(self) -> dict[str, object]:
        """Return the figures by name."""
        return {**asdict(self), "significant": self.significant}


@dataclass(frozen=True)
class Likeness:
    """A change that equals plus or minus a known field, both over the volume without rigid motion.

    ``field`` is the key of the field, ``sign`` +1 or -1, ``correlation`` the correlation of the two, ``size`` the
    factor with which the field fits the change best. ``p_value``: the probability that a change drawn uniformly from
    all changes of at most twice the size of the field comes as close to any of the fields that were tried, each with
    its sign.
    """

    field: str
    sign: int
    correlation: float
    size: float
    p_value: float

    def words(self) -> str:
        """State the figures.

        E.g. ``correlation +0.990, size 1.02; a random change is as similar with probability 1e-07``.
        """
        by_chance = f"{self.p_value:.1g}" if self.p_value >= LEAST_P else f"below {LEAST_P:g}"
        return (
            f"correlation {self.correlation:+.3f}, size {abs(self.size):.2f}; a random change is as similar with "
            f"probability {by_chance}"
        )

    def summary(self) -> dict[str, object]:
        """Return the figures by name."""
        return asdict(self)


def likeness(
    machine: Machine,
    new: Known,
    old: Known,
    added: Mapping[str, FloatArray],
    missing: Mapping[str, FloatArray],
) -> Likeness | None:
    """Return the field that the change equals, with its sign; None if there is none.

    If the tables were on but are not removed from the readings, the readings change by what the tables add; if tables
    are removed from readings of the bare machine, by the opposite. Both look like a drift, and tables made from it undo
    the compensation.

    Parameters
    ----------
    new, old : identified errors and their covariance, if known.
    added : fields that may have acted without being counted, at the points of :func:`volume_points`, (n, 3), mm.
    missing : fields that may have been counted without acting.
    """
    position_mm = volume_points(machine)
    motion = small_motion(position_mm)
    change = compared_fields(machine, new, old, position_mm)
    moved, noise = change.value, change.noise
    free = _directions(machine, new[0], position_mm, motion)
    best: Likeness | None = None
    nearest = DRIFTED
    signed = [
        *((name, 1, field) for name, field in added.items()),
        *((name, -1, field) for name, field in missing.items()),
    ]
    for name, sign, error_field in signed:
        known = motion.taken_out(error_field).ravel()
        square, product = float(known @ known), float(known @ moved)
        if square <= 4.0 * noise or sign * product <= 0.0:
            continue  # too small to be detected, or of the opposite sign
        apart = float(np.sum((moved - sign * known) ** 2))
        share = float(np.sqrt(max(apart - noise, 0.0) / square))
        once = abs(sign * product / square - 1.0) <= ONCE
        if share <= (nearest if once else min(nearest, ALIKE)):
            nearest = share
            correlation = product / float(np.sqrt(square * (moved @ moved)))
            p_value = min(1.0, len(signed) * (0.5 * min(float(np.sqrt(apart / square)), 2.0)) ** free)
            best = Likeness(name, sign, correlation, product / square, p_value)
    return best


def _directions(machine: Machine, errors: ErrorTable, position_mm: FloatArray, motion: SmallMotion) -> float:
    """Number of independent directions that low-order changes of the errors span over the volume.

    Each error may change by its value (squareness), or by a line and a bow; nearly equal fields count once: n^2 over
    the sum of the squared eigenvalues of their correlation matrix (participation ratio), at least 1.
    """
    layout = covariance_of_values(errors, np.diag(errors.uncertainties()))
    design = error_design(machine, layout, position_mm).reshape(3 * len(position_mm), -1)
    names = np.array(layout.error)
    columns = []
    for name in errors.names:
        own = np.flatnonzero(names == name)
        at = layout.position_mm[own]
        if len(own) < 2:
            shapes = np.ones((1, len(own)))
        else:
            share = np.interp(at, (at.min(), at.max()), (-1.0, 1.0))
            shapes = np.array([share, share**2 - 1.0 / 3.0])
        columns += [motion.taken_out(design[:, own] @ shape) for shape in shapes]
    fields = np.column_stack(columns)
    length = np.linalg.norm(fields, axis=0)
    fields = fields[:, length > 1e-6 * length.max()] / length[length > 1e-6 * length.max()]
    if fields.shape[1] == 0:
        return 1.0
    gram = fields.T @ fields
    return float(max(1.0, fields.shape[1] ** 2 / np.sum(gram**2)))


def change_between(
    machine: Machine,
    new: tuple[ErrorTable, Covariance],
    old: tuple[ErrorTable, Covariance],
    confidence: float,
) -> Change:
    """Compare two identifications (errors with covariance) of the same machine over its volume."""
    found = compared_fields(machine, new, old, volume_points(machine))
    sizes = sizes_of(found.size / MM_PER_UM)
    count = len(found.size)
    return Change(
        rms_um=sizes.rms,
        max_um=sizes.largest,
        expected_rms_um=float(np.sqrt(found.noise / count)) / MM_PER_UM,
        p_value=found.p_of_sum(),
        confidence=confidence,
    )


def compared_fields(machine: Machine, new: Known, old: Known, position_mm: FloatArray) -> Difference:
    """Difference of the fields at points (n, 3) without rigid motion; errors without covariance count as exact."""
    fields: list[Uncertain] = []
    for errors, covariance in (new, old):
        factor = np.zeros((position_mm.size, 0))
        if covariance is not None:
            design = error_design(machine, covariance, position_mm)
            factor = design.reshape(position_mm.size, -1) @ covariance.errors_factor
        fields.append((volumetric_error(machine, errors, position_mm).ravel(), factor))
    return compare(fields[0], fields[1], small_motion(position_mm))


def volume_points(machine: Machine) -> FloatArray:
    """Return the points at which changes are evaluated, (n, 3), mm."""
    levels = [np.linspace(*axis.range_mm, POINTS) for axis in machine.axes]
    return full_grid(levels).reshape(-1, 3)


# The calibrations of one machine in common figures: gauge-aligned, each with its joint covariance.
#
# Two different error tables may describe the same machine (:mod:`compgen.kinematics.gauge`). Every calibration is
# therefore brought into one gauge first: along the gauge directions the curves are made as small as possible. Constants
# vanish, and slopes that a squareness error can also express become part of it. The map is linear, so it
# also transforms the covariances.
#
# A curve is monitored by two figures of its best-fit parabola: ``line``, the change of its straight part from the first
# to the last node, and ``bow``, the height of the middle above the ends. A squareness error has one figure, ``value``.


#: The channels of X, Y and Z, for which scales are corrected.
SCALE_CHANNELS = ("temp_x_c", "temp_y_c", "temp_z_c")
#: The state of a machine that the active tables are for.
STATE_NOW = -1
#: Key in the figures of tables: whether nothing makes it doubtful what the measurement behind them shows.
SOUND = "sound"
#: A figure is not observable if its weights keep less than this share of their size in the common gauge.
NOTHING_LEFT = 1e-6
#: A calibration that shows less than this share of the errors of the richest one is left out.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Calibration:
    """One identification: time of measurement, errors (mm, rad) with covariance, mean temperature by channel, degC."""

    at: datetime
    errors: ErrorTable
    covariance: Covariance
    temperatures_c: Mapping[str, float] = field(default_factory=dict)


def axis_temperatures(channels: Mapping[str, Mapping[str, float]]) -> FloatArray:
    """Return the mean temperature of each scale, (3,), degC, nan where its own channel was not read.

    Readings are corrected for these channels alone: a spindle or the air does not tell how warm a scale is.
    """
    return np.array([float(channels.get(name, {}).get("mean", np.nan)) for name in SCALE_CHANNELS])


@dataclass(frozen=True)
class MonitoredFigure:
    """One monitored figure of one error: ``part`` is "value", "line" or "bow"; in mm or rad internally."""

    error: str
    part: str

    @property
    def unit(self) -> str:
        """Unit in reports: um or urad."""
        return error_named(self.error).unit

    @property
    def scale(self) -> float:
        """Factor from mm or rad to the unit of reports."""
        return 1.0 / error_named(self.error).si_per_unit

    @property
    def name(self) -> str:
        """Name in reports, e.g. ``EXX line``, ``EC0Y``."""
        return self.error if self.part == "value" else f"{self.error} {self.part}"


@dataclass(frozen=True)
class Aligned:
    """All calibrations in one gauge on the same k error values.

    Parameters
    ----------
    machine : its chain, travel and tool offset define the gauge.
    error, position_mm : name and position (k,) of each value; nan for squareness.
    days : times in days since the first calibration, (n,).
    value : (n, k), mm and rad. ``factor``: n factors (k, r_i) of the covariance of each.
    figures, weights : f monitored figures and their weights of the values, (f, k).
    """

    machine: Machine
    error: tuple[str, ...]
    position_mm: FloatArray
    days: FloatArray
    value: FloatArray
    factor: tuple[FloatArray, ...]
    figures: tuple[MonitoredFigure, ...]
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


@at_one_moment
def calibrations_of(store: Store, machine: MachineRecord) -> tuple[list[Calibration], list[int], Machine]:
    """Return the calibrations of a machine with known uncertainty, their identification ids, and the newest machine file.

    Left out are calibrations that a person excluded, and those whose uncertainty is another one than that of the newest
    (:func:`compgen.fleet.records.comparable`). InputError if there are none.
    """
    left_out, records = {*excluded(store, machine), *with_other_prior(store, machine)}, counting(store, machine)
    measured = {item.id: item for item in store.measurements(machine)}
    found, ids = [], []
    for record in records:
        errors = store.errors_of(record)
        covariance = covariance_or_independent(errors, store.covariance_of(record))
        if covariance is not None and record.measurement_id not in left_out:
            logged = mean_temperatures(measured[record.measurement_id].temperatures_c)
            found.append(Calibration(record.measured_at, errors, covariance, logged))
            ids.append(record.id)
    if not found:
        raise InputError(f"the store has no identified errors of {machine.name!r} with uncertainties; measure it first")
    newest = next(item for item in records if item.id == ids[-1])
    return found, ids, store.machine_of(newest)


def with_other_prior(store: Store, machine: MachineRecord) -> dict[int, str]:
    """Return the measurements whose uncertainties cannot be compared with those of the newest, and why, by id."""
    left_out = excluded(store, machine)
    records = [item for item in counting(store, machine) if item.measurement_id not in left_out]
    again = f"`volcomp recal reprocess {machine.name} --measurement {{}} --reason TEXT` identifies it again"
    words = {True: f"{WITHOUT_PRIOR}, the newest with one", False: "with a prior, the newest without"}
    return {
        item.measurement_id: f"the measurement of {item.measured_at:%Y-%m-%d} is left out: it was identified "
        f"{words[item.without_prior]}; {again.format(item.measurement_id)}"
        for item in records
        if not comparable(item.summary, records[-1].summary)
    }


def mean_temperatures(channels: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each channel, degC."""
    return {name: float(figures["mean"]) for name, figures in channels.items()}


@at_one_moment
def calibrations_before(
    store: Store,
    machine: MachineRecord,
    tables: Sequence[TableRecord],
    active: IdentificationRecord,
    new: Calibration,
    figures: Mapping[str, Any],
) -> tuple[list[Calibration], list[int]]:
    """Return what a new calibration is compared with: those before it, oldest first, and which state each is of.

    The last state is that of the active tables, which begins with the calibration behind them; every version that became
    active began a new one. Left out are calibrations that a person excluded, that were held back because it was doubtful
    what they show, that show fewer errors, or whose uncertainty is another one than that of the new, by its ``figures``.
    """
    left_out, measured = excluded(store, machine), store.measured(machine)
    doubted = {t.identification_id for t in tables if not t.summary.get(SOUND, "likeness" not in t.summary)}
    records = []
    for record in counting(store, machine):
        if record.measurement_id == active.measurement_id:
            records.append(active)
        elif record.measurement_id not in left_out and record.id not in doubted and record.measured_at <= new.at:
            records.append(record)
    place = next(k for k, record in enumerate(records) if record.id == active.id)
    records = records[min(place, max(len(records) - MOST_COMPARED, 0)) :]
    swaps = [item for item in store.decisions(machine) if AFTER[item.kind] == "active"]
    by_table = {table.id: measured[table.identification_id] for table in tables}
    began = {by_table[item.table_id] for item in swaps if item.table_id is not None}
    states = _states_of_machine(records, began, active, swaps[-1].at)
    logged = {item.id: item.temperatures_c for item in store.measurements(machine)}
    found, kept = [], []
    for record, state in zip(records, states, strict=True):
        errors = store.errors_of(record)
        covariance = covariance_or_independent(errors, store.covariance_of(record))
        shows_all = {*new.errors.names} <= {*errors.names}
        if covariance is not None and shows_all and comparable(record.summary, figures):
            means = mean_temperatures(logged[record.measurement_id])
            found.append(Calibration(record.measured_at, errors, covariance, means))
            kept.append(state)
    return found, kept


def _states_of_machine(
    records: Sequence[IdentificationRecord], began: Container[int], active: IdentificationRecord, since: datetime
) -> list[int]:
    """Number the states of a machine: every measurement whose tables became active began one.

    That of the active tables, :data:`STATE_NOW`, ends where the next began, and goes on when they were made active again.
    """
    states = np.cumsum([record.measurement_id in began for record in records]).tolist()
    own = next(state for state, record in zip(states, records, strict=True) if record.id == active.id)
    return [
        STATE_NOW if state == own or record.measured_at > since else state
        for state, record in zip(states, records, strict=True)
    ]


def with_all_errors(
    history: Sequence[Calibration], ids: Sequence[int]
) -> tuple[list[Calibration], list[int], list[str]]:
    """Keep the calibrations that show at least half of the errors of the richest one; return a note about the others.

    A laser measurement along one axis has another gauge, and would leave only that axis to compare.
    """
    names = [{*item.covariance.error} for item in history]
    richest = max(names, key=len)
    kept = [k for k, found in enumerate(names) if len(found & richest) >= LEAST_SHARE * len(richest)]
    left = len(history) - len(kept)
    notes = [f"{left} of {len(history)} calibrations are left out: they contain only a few errors"] if left else []
    return [history[k] for k in kept], [ids[k] for k in kept], notes


def aligned(machine: Machine, history: Sequence[Calibration]) -> Aligned:
    """Bring calibrations, oldest first, into one gauge on the nodes of the newest."""
    if any(late.at < early.at for early, late in zip(history, history[1:], strict=False)):
        raise InputError("calibrations must be in chronological order; sort them by time")
    common = set.intersection(*({*item.covariance.error} for item in history))
    newest = history[-1].covariance
    kept = [k for k, name in enumerate(newest.error) if name in common]
    if not kept:
        raise InputError("the calibrations have no error in common; keep the same errors in the machine file")
    error, position = tuple(newest.error[k] for k in kept), newest.position_mm[kept]
    # removes the gauge directions; the curves, not the squareness errors, become small
    told = [name for name in dict.fromkeys(error) if name in SQUARENESS_NAMES or error.count(name) > 1]
    weight = np.where(np.isin(error, SQUARENESS_NAMES), 0.0, curve_weights(error))
    changes = gauge_changes(gauge_directions(machine, told), error, position)
    keep = np.asarray(np.eye(len(error)) - gauge_part(changes, np.diag(weight)))
    names, known = np.array(error), {}
    for (
        item
    ) in history:  # by the layout of the values: a matrix (k, k_i) that interpolates them linearly at the common nodes
        layout = (item.covariance.error, item.covariance.position_mm.tobytes())
        if layout in known:
            continue
        given = np.array(item.covariance.error)
        matrix = np.zeros((len(names), len(given)))
        for name in dict.fromkeys(error):
            rows, columns = np.flatnonzero(names == name), np.flatnonzero(given == name)
            if name in SQUARENESS_NAMES:
                matrix[np.ix_(rows, columns)] = 1.0
            else:
                matrix[np.ix_(rows, columns)] = hat_matrix(item.covariance.position_mm[columns], position[rows])
        known[layout] = keep @ matrix
    maps = [known[item.covariance.error, item.covariance.position_mm.tobytes()] for item in history]
    values = [
        each @ values_at_nodes(item.errors, item.covariance.error, item.covariance.position_mm)
        for each, item in zip(maps, history, strict=True)
    ]
    factors = [each @ item.covariance.errors_factor for each, item in zip(maps, history, strict=True)]
    seconds = [(item.at - history[0].at).total_seconds() for item in history]
    figures, weights = _figures(error, position, keep)
    days = np.array(seconds) / 86400.0
    return Aligned(machine, error, position, days, np.array(values), tuple(factors), figures, weights)


def _figures(
    error: Sequence[str], position_mm: FloatArray, keep: FloatArray
) -> tuple[tuple[MonitoredFigure, ...], FloatArray]:
    """Figures that are observable in the common gauge, and their weights (f, k)."""
    figures, rows = [], []
    for name in dict.fromkeys(error):
        columns = np.flatnonzero(np.array(error) == name)
        for part, weights in _parts(name, position_mm[columns]).items():
            row = np.zeros(len(error))
            row[columns] = weights
            if np.linalg.norm(row @ keep) > NOTHING_LEFT * np.linalg.norm(row):
                figures.append(MonitoredFigure(name, part))
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


# Change between two calibrations: of each error with the joint covariance of its values, and of the volume.


@dataclass(frozen=True)
class ErrorChange:
    """Change of one error in the common gauge.

    ``largest`` is the change of the value that changed most (mm or rad, with its sign), ``u`` its standard uncertainty,
    ``p_value`` the probability of at least this change of the whole curve if there was none, ``adjusted`` the same
    corrected for all errors that are tested (Holm 1979, Scandinavian Journal of Statistics 6).
    """

    error: str
    largest: float
    u: float
    p_value: float
    adjusted: float

    def summary(self) -> dict[str, Any]:
        """Return the figures in um or urad."""
        name = error_named(self.error)
        sizes = {"unit": name.unit, "largest": self.largest / name.si_per_unit, "u": self.u / name.si_per_unit}
        return {"error": self.error, **sizes, "p_value": self.p_value, "adjusted_p_value": self.adjusted}


def changes(data: Aligned, new: int, old: int) -> tuple[ErrorChange, ...]:
    """Return the change of every error from calibration ``old`` to ``new``, which are taken as independent."""
    whole = compare((data.value[new], data.factor[new]), (data.value[old], data.factor[old]))
    names = list(dict.fromkeys(data.error))
    found = []
    for name in names:
        part = whole.part(data.columns(name))
        k = int(np.argmax(np.abs(part.value)))
        found.append((float(part.value[k]), float(part.u[k]), part.p_of_pattern()))
    adjusted = holm([item[2] for item in found])
    return tuple(ErrorChange(name, *item, each) for name, item, each in zip(names, found, adjusted, strict=True))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the error probabilities corrected for the number of tests.

    >>> holm([0.01, 0.5, 0.02])
    [0.03, 0.5, 0.04]
    """
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    result, highest = [1.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        result[k] = highest
    return result


# Whether a machine has changed, given how well it repeats.
#
# A machine that has not changed is found again within its repeatability, which the uncertainty of a measurement does not
# contain: scales follow temperatures that nobody reads, a part is clamped again. In six directions, three scales and three
# squarenesses, the mean of the last w calibrations is therefore compared with the mean of all n before them since tables
# were last made active,
#
#     t = (mean of the last w - mean of those before) / (s sqrt(1/w + 1/n)),    s^2 = (F r s0^2 + SS) / (F + N)
#
# with the repeatability s0 (:mod:`compgen.data.repeatability`; as if known from four degrees of freedom), and the sum of squares
# SS of the calibrations before about their mean, with N degrees of freedom; earlier tables have means of their own. What the
# other two scales, or squarenesses, tell of the repeatability is r = (4 + SS' / s0'^2) / (4 + N'), which counts as F = 4 + N',
# at most 10, degrees of freedom: one of the three may repeat worse than the others. A scale
# that is corrected for its temperature T may have a wrong expansion coefficient: y = level + c (T - 20 degC), c normal with the
# uncertainty of the coefficient, which is one more observation. Where no temperature is read, the hall moves all scales together
# by the same temperature: that common change is compared with what a season does (season_k), and each scale with the others, from
# which the hall cancels as far as their coefficients are known. The other shapes of the errors are compared as a field: the
# sum of squares against that of the uncertainties, which the calibrations before scale (F-test).


#: Degrees of freedom with which the repeatability counts as known.
KNOWN_FROM = 4.0
#: At most as many with the other directions of the same kind.
KNOWN_FROM_OTHERS = 10.0
#: Share of the error probability for the six directions; the rest is for all other shapes.
FOR_DIRECTIONS = 0.75
#: The last calibrations are averaged over up to so many; over up to the second number where the history is longer.
WINDOW, LONG_WINDOW = 3, 10
#: At most so many of the last calibrations are compared.
MOST_COMPARED = 60
REFERENCE_C = 20.0
#: Name of the direction in which the temperature of the hall moves all scales together.
ALL_SCALES = "all scales"


@dataclass(frozen=True)
class Direction:
    """One direction of change: name and unit in reports; ``weight`` (k,) reads it from the values, ``shape`` (k,) is one unit.

    ``axis`` is that of a scale (mm/mm), None for a squareness (rad).
    """

    name: str
    unit: str
    weight: FloatArray
    shape: FloatArray
    axis: int | None
    #: Standard deviation of it that the unread temperature of the hall causes, mm/mm.
    by_hall: float = 0.0
    #: How much less sure it is than one scale, since the others are subtracted; below 1 for their mean.
    spread: float = 1.0


def change_since(
    machine: Machine, history: Sequence[Calibration], levels: Sequence[int], confidence: float, *, corrected: bool
) -> Change:
    """Compare the last calibration, with those before it, with the calibrations since the active tables.

    Parameters
    ----------
    history : calibrations, oldest first; the last is the new one.
    levels : which calibrations are of one state of the machine, (n,): those with the number of the last are compared with
        it, the first of them is behind the active tables; the others show how well the machine repeats.
    corrected : scales were corrected for their temperatures where the machine file has an expansion coefficient.
    """
    data, level = aligned(machine, history), np.array(levels)
    position_mm = volume_points(machine)
    motion = small_motion(position_mm)
    design = error_design(machine, data.field_covariance(len(history) - 1), position_mm).reshape(position_mm.size, -1)
    directions = _six_directions(data)
    judged = _with_hall(data, history, directions, corrected=corrected)
    tested = _tested(data, history, level, judged, corrected=corrected)
    own = np.flatnonzero(level == level[-1])
    count = max(len(_windows(len(own))) * len(judged), 1)
    p_value, said = min(((p * count / FOR_DIRECTIONS, text) for p, text, _ in tested), default=(1.0, ""))
    p_rest = _p_of_other_shapes(data, level, directions, motion, design) / (1.0 - FOR_DIRECTIONS)
    if p_rest < min(p_value, 1.0):
        said = "other shapes than scales and squareness"
    first = history[own[0]]
    found = compared_fields(machine, _known(history[-1]), _known(first), position_mm)
    sizes = sizes_of(found.size / MM_PER_UM)
    own_shapes = motion.taken_out(design @ np.array([item.shape for item in judged]).reshape(-1, design.shape[1]).T)
    repeats = sum(2.0 * s2 * float(shape @ shape) for (_, _, s2), shape in zip(tested, own_shapes.T, strict=True))
    return Change(
        rms_um=sizes.rms,
        max_um=sizes.largest,
        expected_rms_um=float(np.sqrt((found.noise + repeats) / len(found.size))) / MM_PER_UM,
        p_value=min(1.0, p_value, p_rest),
        confidence=confidence,
        largest=said if min(p_value, p_rest) < 1.0 else "",
        known_from=len(own) - 1,
    )


def _known(item: Calibration) -> Known:
    return item.errors, item.covariance


def _windows(count: int) -> range:
    """Over how many of the last calibrations of ``count`` the mean is taken."""
    return range(1, min(max(WINDOW, min(LONG_WINDOW, (count - 1) // 2)), count - 1) + 1)


def _six_directions(data: Aligned) -> list[Direction]:
    """Scales and squarenesses that the calibrations show, in the common gauge."""
    found, names = [], np.array(data.error)
    for figure, weight in zip(data.figures, data.weights, strict=True):
        name, own, shape = figure.error, data.columns(figure.error), np.zeros(len(names))
        if figure.part == "value":
            shape[own] = 1.0
            found.append(Direction(name, "urad", weight, shape, None))
        elif figure.part == "line" and error_named(name).kind == "linear" and not error_named(name).is_straightness:
            axis, at = error_named(name).axis, data.position_mm[own]
            shape[own] = at - at.mean()
            travel = float(np.ptp(at))
            found.append(Direction(f"scale of {'XYZ'[axis]}", "um/m", weight / travel, shape, axis))
    return found


def _with_hall(
    data: Aligned, history: Sequence[Calibration], directions: Sequence[Direction], *, corrected: bool
) -> list[Direction]:
    """Return directions, scales of which no temperature is read against the other ones, and what they have in common."""
    hall_k = data.machine.repeatability.hall_k
    unread = [
        k
        for k, item in enumerate(directions)
        if item.axis is not None and _warm(data, history, item.axis, corrected=corrected) is None
    ]
    if not unread or hall_k == 0.0:
        return list(directions)
    axes = [data.machine.axes[axis] for k in unread if (axis := directions[k].axis) is not None]
    per_k = 1e-6 * np.array([axis.expansion_um_per_m_k or USUAL_UM_PER_M_K for axis in axes])
    u_per_k = np.array([axis.u_expansion or EXPANSION_SHARE * own for axis, own in zip(axes, per_k, strict=True)])
    if len(unread) == 1:
        (only,) = unread
        return [replace(item, by_hall=hall_k * per_k[0]) if k == only else item for k, item in enumerate(directions)]
    weights = np.array([directions[k].weight for k in unread])
    found, mean = list(directions), float(per_k.mean())
    for row, k in enumerate(unread):
        rest = np.arange(len(unread)) != row
        kelvin = per_k[rest] @ weights[rest] / float(per_k[rest] @ per_k[rest])  # that the others tell
        spread = float(np.sqrt(1.0 + per_k[row] ** 2 / (per_k[rest] @ per_k[rest])))
        by_hall = hall_k * float(np.hypot(u_per_k[row], u_per_k[rest].mean() / np.sqrt(rest.sum())))
        weight = weights[row] - per_k[row] * kelvin
        found[k] = replace(directions[k], weight=weight, by_hall=by_hall, spread=spread)
    together = mean * per_k @ weights / float(per_k @ per_k)
    shape = np.sum([own / mean * directions[k].shape for own, k in zip(per_k, unread, strict=True)], axis=0)
    axis, least = directions[unread[0]].axis, 1.0 / float(np.sqrt(len(unread)))
    return [*found, Direction(ALL_SCALES, "um/m", together, shape, axis, hall_k * mean, least)]


def _tested(
    data: Aligned,
    history: Sequence[Calibration],
    level: NDArray[np.int_],
    directions: Sequence[Direction],
    *,
    corrected: bool,
) -> list[tuple[float, str, float]]:
    """Smallest error probability over the windows, the change in words, and the variance of one calibration, by direction."""
    series = [_series(data, history, item, corrected=corrected) for item in directions]
    own, best = np.flatnonzero(level == level[-1]), [(1.0, "", item.s0**2) for item in series]
    for window in _windows(len(own)):
        before = np.ones(len(level), dtype=bool)
        before[own[-window:]] = False
        steps = [_step(item, level, before, own[-window:]) for item in series]
        over = "" if window == 1 else f" over the last {window} measurements"
        for k, (direction, step) in enumerate(zip(directions, steps, strict=True)):
            others = [steps[j] for j, item in enumerate(directions) if j != k and _kind(item) == _kind(direction)]
            p_value, variance = _t_test(step, series[k].s0, others)
            if p_value <= best[k][0]:
                said = f"{direction.name} {1e6 * step.size:+.1f} {direction.unit}{over}"
                best[k] = p_value, said, variance
    return best


def _kind(direction: Direction) -> str:
    """Directions of one kind repeat equally well; what all scales have in common is of its own."""
    if direction.name == ALL_SCALES:
        return ALL_SCALES
    return "squareness" if direction.axis is None else "scale"


@dataclass(frozen=True)
class Series:
    """Values of one direction, (n,), with the repeatability ``s0`` of one.

    ``warm`` (n,) is a covariate, none of zeros, whose coefficient counts as an observation of zero with this ``weight``, in
    units of s0.
    """

    value: FloatArray
    s0: float
    warm: FloatArray | None = None
    weight: float = 0.0


@dataclass(frozen=True)
class Step:
    """Change of the last values of a series against those before.

    Its variance is ``spread`` times that of one value; ``squares`` is the sum of squares of those before about what they are
    explained by, in s0^2, with ``freedom`` degrees of freedom.
    """

    size: float
    spread: float
    squares: float
    freedom: int


def _series(data: Aligned, history: Sequence[Calibration], direction: Direction, *, corrected: bool) -> Series:
    value, machine = data.value @ direction.weight, data.machine
    u = np.array([np.linalg.norm(direction.weight @ factor) for factor in data.factor])
    warm, u_expansion = None, 0.0
    if direction.axis is not None:
        u_expansion = machine.axes[direction.axis].u_expansion
        warm = _warm(data, history, direction.axis, corrected=corrected)
    known = machine.repeatability
    repeats = 1e-6 * known.squareness_urad if direction.axis is None else known.scale(temperatures=warm is not None)
    s0 = float(np.sqrt((direction.spread * repeats) ** 2 + direction.by_hall**2 + np.mean(u**2)))
    return Series(value, s0) if warm is None else Series(value, s0, warm - REFERENCE_C, s0 / u_expansion)


def _warm(data: Aligned, history: Sequence[Calibration], axis: int, *, corrected: bool) -> FloatArray | None:
    """Temperatures for which a scale was corrected, (n,); None if it was not."""
    known = corrected and data.machine.axes[axis].u_expansion > 0.0
    return _temperatures_of(history, axis) if known else None


def _temperatures_of(history: Sequence[Calibration], axis: int) -> FloatArray | None:
    """Temperature of a scale in every calibration, (n,), degC; None unless all logged it."""
    found = np.array([item.temperatures_c.get(SCALE_CHANNELS[axis], np.nan) for item in history])
    return found if np.isfinite(found).all() else None


def _step(series: Series, level: NDArray[np.int_], before: NDArray[np.bool_], last: NDArray[np.intp]) -> Step:
    """Compare the mean of the ``last`` values with those ``before``."""
    states = np.unique(level[before])
    matrix = (level[before][:, None] == states).astype(np.float64)
    new = (level[last[-1]] == states).astype(np.float64)
    target, warm = series.value[before], series.warm
    if warm is not None:
        matrix = np.vstack([np.column_stack([matrix, warm[before]]), [*np.zeros(len(states)), series.weight]])
        new, target = np.append(new, warm[last].mean()), np.append(target, 0.0)
    normal = np.linalg.inv(matrix.T @ matrix)
    found = normal @ (matrix.T @ target)
    squares = float(np.sum((target - matrix @ found) ** 2)) / series.s0**2
    size, spread = float(series.value[last].mean() - new @ found), 1.0 / len(last) + float(new @ normal @ new)
    return Step(size, spread, squares, int(np.count_nonzero(before)) - len(states))


def _t_test(step: Step, s0: float, others: Sequence[Step] = ()) -> tuple[float, float]:
    """Return the error probability of a step, and the variance of one value; ``others`` repeat as this direction does."""
    from scipy.special import stdtr  # imported here: few comparisons are tests

    known = KNOWN_FROM + sum(item.freedom for item in others)
    ratio = (KNOWN_FROM + sum(item.squares for item in others)) / known
    known = min(known, KNOWN_FROM_OTHERS)
    freedom = known + step.freedom
    variance = s0**2 * (known * ratio + step.squares) / freedom
    t = step.size / np.sqrt(variance * step.spread)
    return float(2.0 * stdtr(freedom, -abs(t))), variance


def _p_of_other_shapes(
    data: Aligned, level: NDArray[np.int_], directions: Sequence[Direction], motion: SmallMotion, design: FloatArray
) -> float:
    """Error probability of the change in all shapes but the six directions, over the volume."""
    from scipy.special import fdtrc  # imported here: few comparisons are tests

    keep = np.eye(data.value.shape[1])
    for item in directions:
        keep -= np.outer(item.shape, item.weight)
    _, sizes, shapes = np.linalg.svd(motion.taken_out(design @ keep), full_matrices=False)
    read = (sizes[:, None] * shapes)[sizes > 1e-9 * sizes[0]]  # of the fields in directions of their own: as long
    fields, factors = data.value @ read.T, [read @ factor for factor in data.factor]
    own = np.flatnonzero(level == level[-1])[:-1]
    change = fields[-1] - fields[own].mean(axis=0)
    gram = factors[-1] @ factors[-1].T + sum(factors[k] @ factors[k].T for k in own) / len(own) ** 2
    mean, squares = float(np.trace(gram)), float(np.sum(gram**2))
    if mean <= 0.0:
        return 1.0
    seen, expected, free = 0.0, 0.0, 0
    for state in np.unique(level[:-1]):
        rows = np.flatnonzero(level[:-1] == state)
        seen += float(np.sum((fields[rows] - fields[rows].mean(axis=0)) ** 2))
        expected += (1.0 - 1.0 / len(rows)) * sum(float(np.sum(factors[k] ** 2)) for k in rows)
        free += len(rows) - 1
    scale = (KNOWN_FROM + (free * seen / expected if expected > 0.0 else 0.0)) / (KNOWN_FROM + free)
    count = mean * mean / squares
    return float(fdtrc(count, count * (KNOWN_FROM + free), float(change @ change) / mean / scale))
