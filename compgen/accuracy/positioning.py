"""Positioning tests along an axis (ISO 230-2, VDI/DGQ 3441) or a diagonal (ISO 230-6); budget (ISO/TR 230-9), statistics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.accuracy.evaluate import Accuracy
from compgen.accuracy.field import Figure
from compgen.data.axis_runs import AxisRuns, Diagonals, along_mm
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, BODY_DIAGONALS, MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES
from compgen.data.toml_files import option
from compgen.errors import InputError, Message
from compgen.kinematics.first_order import c_matrix

# Contribution of the set-up of a positioning test to the uncertainty of its figures, in the manner of ISO/TR 230-9.
#
# The sources are those of ISO 230-2 (Annex A) and ISO/TR 230-9: device, misalignment, temperature, expansion
# coefficient, drift of the environment (EVE). How they act on a figure follows from its derivative by every mean; the
# simplified formulas printed in these documents are not used.


@dataclass(frozen=True)
class SetupBudget:
    """Standard uncertainties (k = 1) of the common inputs of all readings of one axis, and of single means.

    Parameters
    ----------
    device_um : of the device for each single mean of a target and direction (resolution, stability), um.
    device_ppm : of its length scale (wavelength, air), 1e-6.
    misalignment_mrad : of the angle between beam and axis, in each of two directions, mrad; a cosine error.
    temperature_k : of the axis' temperature, K; acts with ``expansion_um_per_m_k``.
    expansion_um_per_m_k : coefficient of expansion of the axis.
    u_expansion_um_per_m_k : its standard uncertainty; acts with ``from_20_k``.
    from_20_k : deviation of the axis temperature from 20 degC, K.
    drift_um : of each mean, due to the drift of the environment (EVE) during the test, um.
    """

    device_um: float = option(
        0.0, "Axis runs: standard uncertainty of the device for each mean, um.", name="--u-device-um"
    )
    device_ppm: float = option(
        0.0, "Axis runs: standard uncertainty of the device's length scale, 1e-6.", name="--u-device-ppm"
    )
    misalignment_mrad: float = option(
        0.0,
        "Axis runs: standard uncertainty of the angle between beam and axis, mrad.",
        name="--u-misalignment-mrad",
    )
    temperature_k: float = option(
        0.0,
        "Axis runs: standard uncertainty of the axis' temperature, K (acts with expansion_um_per_m_k of the machine file, "
        "else 11.5).",
        name="--u-temperature-k",
    )
    expansion_um_per_m_k: float = 11.5
    u_expansion_um_per_m_k: float = option(
        0.0,
        "Axis runs: standard uncertainty of the coefficient of expansion, um/(m K) (acts with --from-20-k).",
        name="--u-expansion-um-per-m-k",
    )
    from_20_k: float = option(0.0, "Deviation of the axis temperature from 20 degC, K.", name="--from-20-k")
    drift_um: float = option(
        0.0,
        "Axis runs: standard uncertainty of each mean due to drift of the environment (EVE), um.",
        name="--u-drift-um",
    )

    def contributions(self, position_mm: FloatArray, weight: FloatArray) -> Iterator[tuple[str, float]]:
        """Yield source and standard uncertainty (mm) of sum(weight * mean), the linearised figure.

        Parameters
        ----------
        position_mm : targets, (m,).
        weight : derivative of the figure by each mean, (directions, m).
        """
        length = abs(float(np.sum(weight * position_mm)))
        single = math.sqrt(float(np.sum(weight**2)))
        expansion = length * self.expansion_um_per_m_k * 1e-6 * self.temperature_k
        coefficient = length * self.u_expansion_um_per_m_k * 1e-6 * abs(self.from_20_k)
        found = {
            "device": math.hypot(single * self.device_um * MM_PER_UM, length * self.device_ppm * 1e-6),
            "misalignment": length * math.sqrt(2.0) * (self.misalignment_mrad * 1e-3) ** 2,  # rms of (a^2 + b^2) / 2
            "temperature": expansion,
            "expansion coefficient": coefficient,
            "drift": single * self.drift_um * MM_PER_UM,
        }
        yield from ((name, value) for name, value in found.items() if value > 0.0)


NO_BUDGET = SetupBudget()


# Statistics of positioning runs at each target, and figures as combinations of them.


#: Targets closer than this are the same target, mm.
SAME_TARGET_MM = 1e-4
#: Rows of the statistics: means of positive and negative approach, then the estimators of both.
MEAN_UP, MEAN_DOWN, S_UP, S_DOWN = range(4)


@dataclass(frozen=True)
class RunStatistics:
    """Means and standard deviations (n - 1) of the deviations at m targets, mm.

    Parameters
    ----------
    position_mm : targets, ascending, (m,).
    values : shape (4, m): mean of positive, of negative approach, estimator s of positive, of negative approach; nan for
        a direction without readings, and for s of a single reading.
    count : readings of positive and negative approach, (2, m).
    """

    position_mm: FloatArray
    values: FloatArray
    count: FloatArray

    @property
    def directions(self) -> tuple[int, ...]:
        """Directions that were measured: rows 0 (positive), 1 (negative) of the means."""
        return tuple(row for row in (MEAN_UP, MEAN_DOWN) if not np.isnan(self.values[row]).any())

    @property
    def bidirectional(self) -> bool:
        """Whether both directions were measured."""
        return len(self.directions) == 2

    @property
    def repeated(self) -> bool:
        """Whether every target has at least two readings in each measured direction, so that s is known."""
        return all(bool(np.all(self.count[row] > 1)) for row in self.directions)


def run_statistics(position_mm: FloatArray, direction: FloatArray, deviation_mm: FloatArray) -> RunStatistics:
    """Return the statistics of readings (n,) at targets (n,) reached in directions (n,), +1 or -1.

    Raises
    ------
    InputError
        if a direction was measured at only some targets, or there are fewer than two targets.
    """
    readings = np.asarray(position_mm, dtype=np.float64)
    order = np.argsort(readings, kind="stable")
    new = np.concatenate([[False], np.diff(readings[order]) > SAME_TARGET_MM])
    position = readings[order[np.concatenate([[0], np.flatnonzero(new)])]]
    target = np.empty(len(order))  # number of the target of each reading
    target[order] = np.cumsum(new)
    values, count = np.full((4, len(position)), np.nan), np.zeros((2, len(position)))
    for row, sign in enumerate((1, -1)):
        for k in range(len(position)):
            here = deviation_mm[(target == k) & (np.sign(direction) == sign)]
            count[row, k] = len(here)
            if len(here):
                values[row, k] = here.mean()
            if len(here) > 1:
                values[2 + row, k] = here.std(ddof=1)
        if 0 < np.count_nonzero(count[row]) < len(position):
            missing = position[np.flatnonzero(count[row] == 0)[0]]
            raise InputError(
                Message(
                    "target-without-direction",
                    "no reading at {missing:g} mm in direction {sign:+d}; every target needs both directions",
                    missing=missing,
                    sign=sign,
                )
            )
    if len(position) < 2:
        raise InputError(Message("positioning-few-targets", "a positioning test needs at least two targets"))
    return RunStatistics(position, values, count)


def axis_statistics(runs: AxisRuns) -> dict[str, RunStatistics]:
    """Return the statistics of every measured axis by letter; InputError gives the axis."""
    found = {}
    for axis in runs.axes:
        own = runs.axis == axis
        try:
            found[AXES[axis]] = run_statistics(runs.position_mm[own], runs.direction[own], runs.deviation_mm[own])
        except InputError as error:
            file = runs.origin[int(np.flatnonzero(own)[0])][0] if runs.origin else None
            raise InputError(f"{AXES[axis]}: {error.message}", file=file) from None
    return found


@dataclass(frozen=True)
class Combination:
    """A figure as sum(weight * statistics.values): its value, and its derivative by every mean and s, shape (4, m)."""

    value: float
    weight: FloatArray


def combine(statistics: RunStatistics, parts: Sequence[tuple[float, int, int]]) -> Combination:
    """Return sum of factor * values[row, target] over ``parts`` of (factor, row, target)."""
    weight = np.zeros(statistics.values.shape)
    value = 0.0
    for factor, row, target in parts:
        if factor:
            weight[row, target] += factor
            value += factor * float(statistics.values[row, target])
    return Combination(value, weight)


def largest(candidates: Sequence[Combination]) -> Combination:
    """Return the combination with the largest value."""
    return max(candidates, key=lambda item: item.value)


def minus(first: Combination, second: Combination) -> Combination:
    """Return first - second."""
    return Combination(first.value - second.value, first.weight - second.weight)


def spread(candidates: Sequence[Combination], lower: Sequence[Combination] | None = None) -> Combination:
    """Return the largest of the candidates minus the smallest of ``lower`` (default the same ones)."""
    return minus(largest(candidates), min(lower or candidates, key=lambda item: item.value))


def figure(statistics: RunStatistics, item: Combination, meaning: str, budget: SetupBudget = NO_BUDGET) -> Figure:
    """Return a combination in um with its standard uncertainty.

    The scatter gives s^2 / n for a mean and s^2 (1 - c4^2) for an estimator s (normal readings); the rest comes from
    the budget. A single reading has no scatter: u is then nan.
    """
    from scipy.special import gammaln  # imported here: slow to load

    counts, scatter = statistics.count, statistics.values[2:]
    # variance of s over sigma^2 for n normal readings: 1 - c4(n)^2, c4^2 = 2 / (n - 1) (G(n/2) / G((n-1)/2))^2
    n = np.maximum(counts, 2.0)
    c4_square = 2.0 / (n - 1.0) * np.exp(2.0 * (gammaln(0.5 * n) - gammaln(0.5 * (n - 1.0))))
    of_estimator = np.where(counts > 1, 1.0 - c4_square, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        variances = np.concatenate([scatter**2 / counts, scatter**2 * of_estimator])
    used = item.weight != 0.0
    repeatability = math.sqrt(float(np.sum(item.weight[used] ** 2 * variances[used])))
    parts = {"repeatability": repeatability / MM_PER_UM}
    for name, u_mm in budget.contributions(statistics.position_mm, item.weight[:2]):
        parts[name] = u_mm / MM_PER_UM
    u = math.sqrt(sum(value**2 for value in parts.values()))
    return Figure(item.value / MM_PER_UM, u, "um", meaning, parts)


# Positioning accuracy and repeatability of one axis after ISO 230-2.
#
# With x_ij(u), x_ij(d) the deviations of run j at target i in positive and negative approach, m(u), m(d) their means, s(u),
# s(d) their estimators (n - 1), k the coverage factor of the edition:
#
#     B_i = m_i(u) - m_i(d),  B = max |B_i|,  mean reversal = mean of B_i,  M = max - min of (m_i(u) + m_i(d)) / 2
#     R_i(u) = 2 k s_i(u),    R_i = max{ k s_i(u) + k s_i(d) + |B_i|; R_i(u); R_i(d) },  R = max R_i
#     E(u) = max - min of m_i(u),  E = max - min of the means of both directions together
#     A(u) = max [m_i(u) + k s_i(u)] - min [m_i(u) - k s_i(u)],  A = the same over both directions together
#
# k is 2 since the edition of 1997 and was 3 in that of 1988. The edition of 2014 says "error" where the earlier ones
# say "deviation" or "value"; the formulas are the same. Two mistakes of public programs give other numbers: R as the
# larger of R(u) and R(d), and E as the larger or smaller of E(u) and E(d).


#: Coverage factor by edition.
EDITIONS = {1988: 3.0, 1997: 2.0, 2006: 2.0, 2014: 2.0}
LATEST = 2014
_SIGNS = {MEAN_UP: "up", MEAN_DOWN: "down"}


@dataclass(frozen=True)
class PositioningTest:
    """Figures of one axis (um) by key, and the values at each target.

    Keys: ``B``, ``B_mean``, ``M``, ``R``, ``R_up``, ``R_down``, ``E``, ``E_up``, ``E_down``, ``A``, ``A_up``,
    ``A_down`` as far as the runs show them: both directions for those without an ending, at least two runs for R and A.
    ``targets`` has the columns position_mm, mean_up_um, mean_down_um, s_up_um, s_down_um, B_um, mean_um, R_um, R_up_um,
    R_down_um, and from the scatter the standard uncertainties u_mean_up_um, u_mean_down_um, u_B_um (without common
    sources), each (m,), nan if unknown.
    """

    edition: int
    statistics: RunStatistics
    figures: dict[str, Figure]
    targets: dict[str, FloatArray]


def positioning_test(
    statistics: RunStatistics, edition: int = LATEST, budget: SetupBudget = NO_BUDGET
) -> PositioningTest:
    """Return all figures of ISO 230-2 for one axis.

    Parameters
    ----------
    statistics : means and estimators at the targets.
    edition : 1988, 1997, 2006 or 2014.
    budget : contribution of the set-up to the uncertainties.
    """
    if edition not in EDITIONS:
        raise InputError(
            Message(
                "edition-unknown",
                "edition {edition} of ISO 230-2 is not available; use {editions}",
                edition=edition,
                editions=" or ".join(map(str, EDITIONS)),
            )
        )
    k = EDITIONS[edition]
    found: dict[str, tuple[Combination, str]] = {}
    if statistics.bidirectional:
        found |= _reversal(statistics)
    for way in statistics.directions:
        found |= _one_way(statistics, way, k)
    if statistics.bidirectional:
        found |= _both_ways(statistics, k)
    figures = {
        key: figure(statistics, item, f"{meaning}, ISO 230-2:{edition}", budget)
        for key, (item, meaning) in found.items()
    }
    # relations between the figures for any readings; a violation is a bug, not bad input
    for pair in ("A E", "A A_up", "A A_down", "E E_up", "E E_down", "E M", "R R_up", "R R_down", "R B"):
        large, small = pair.split()
        if large in figures and small in figures:
            assert figures[large].value >= figures[small].value - 1e-9, f"{large} is below {small}"
    if "E" in figures:
        assert figures["E"].value <= figures["M"].value + figures["B"].value + 1e-9
    return PositioningTest(edition, statistics, figures, _figures_at_targets(statistics, k))


def _means(statistics: RunStatistics, ways: Sequence[int], k: float = 0.0) -> list[Combination]:
    """Every mean + k s of the given directions."""
    count = len(statistics.position_mm)
    return [combine(statistics, [(1.0, way, i), (k, 2 + way, i)]) for way in ways for i in range(count)]


def _reversal(statistics: RunStatistics) -> dict[str, tuple[Combination, str]]:
    gaps = statistics.values[MEAN_UP] - statistics.values[MEAN_DOWN]
    each = range(len(gaps))
    signed = [[(float(np.sign(gaps[i])), MEAN_UP, i), (-float(np.sign(gaps[i])), MEAN_DOWN, i)] for i in each]
    sizes = [combine(statistics, parts) for parts in signed]
    share = 1.0 / len(gaps)
    mean = combine(
        statistics, [(sign * share, way, i) for way, sign in ((MEAN_UP, 1.0), (MEAN_DOWN, -1.0)) for i in each]
    )
    middles = [combine(statistics, [(0.5, MEAN_UP, i), (0.5, MEAN_DOWN, i)]) for i in each]
    return {
        "B": (largest(sizes), "reversal error, largest"),
        "B_mean": (mean, "mean reversal error"),
        "M": (spread(middles), "mean bidirectional positioning error"),
    }


def _one_way(statistics: RunStatistics, way: int, k: float) -> dict[str, tuple[Combination, str]]:
    end, text = _SIGNS[way], f"unidirectional, {'positive' if way == MEAN_UP else 'negative'} approach"
    found = {f"E_{end}": (spread(_means(statistics, [way])), f"systematic positioning error, {text}")}
    if statistics.repeated:
        count = len(statistics.position_mm)
        widths = [combine(statistics, [(2.0 * k, 2 + way, i)]) for i in range(count)]
        accuracy = spread(_means(statistics, [way], k), _means(statistics, [way], -k))
        found[f"R_{end}"] = (largest(widths), f"positioning repeatability, {text}")
        found[f"A_{end}"] = (accuracy, f"positioning accuracy, {text}")
    return found


def _both_ways(statistics: RunStatistics, k: float) -> dict[str, tuple[Combination, str]]:
    ways = (MEAN_UP, MEAN_DOWN)
    found = {"E": (spread(_means(statistics, ways)), "systematic positioning error, bidirectional")}
    if statistics.repeated:
        accuracy = spread(_means(statistics, ways, k), _means(statistics, ways, -k))
        signs = np.sign(statistics.values[MEAN_UP] - statistics.values[MEAN_DOWN]).tolist()
        widths = []
        for i, sign in enumerate(signs):  # R_i is the largest of its three candidates
            both = [(k, S_UP, i), (k, S_DOWN, i), (sign, MEAN_UP, i), (-sign, MEAN_DOWN, i)]
            parts = (both, [(2.0 * k, S_UP, i)], [(2.0 * k, S_DOWN, i)])
            widths.append(largest([combine(statistics, part) for part in parts]))
        found["R"] = (largest(widths), "positioning repeatability, bidirectional")
        found["A"] = (accuracy, "positioning accuracy, bidirectional")
    return found


def _figures_at_targets(statistics: RunStatistics, k: float) -> dict[str, FloatArray]:
    up, down, s_up, s_down = statistics.values / MM_PER_UM
    with np.errstate(divide="ignore", invalid="ignore"):
        u_up, u_down = (s_up, s_down) / np.sqrt(statistics.count)
    wide = np.maximum(np.maximum(2.0 * k * s_up, 2.0 * k * s_down), k * (s_up + s_down) + np.abs(up - down))
    return {
        "position_mm": statistics.position_mm,
        "mean_up_um": up,
        "mean_down_um": down,
        "s_up_um": s_up,
        "s_down_um": s_down,
        "B_um": up - down,
        "mean_um": 0.5 * (up + down),
        "R_um": wide,
        "R_up_um": 2.0 * k * s_up,
        "R_down_um": 2.0 * k * s_down,
        "u_mean_up_um": u_up,
        "u_mean_down_um": u_down,
        "u_B_um": np.hypot(u_up, u_down),
    }


# Statistical test of the positioning of one axis after VDI/DGQ 3441.
#
# With U_i = |m_i(u) - m_i(d)|, s_i the mean of both estimators, P_s,i = 6 s_i and m_i the mean of both directions:
#
#     P_a = max m_i - min m_i,   P = max [m_i + (U_i + P_s,i) / 2] - min [m_i - (U_i + P_s,i) / 2]


def vdi_3441(statistics: RunStatistics, budget: SetupBudget = NO_BUDGET) -> dict[str, Figure]:
    """Return ``P``, ``P_a``, ``P_s_max``, ``P_s_mean``, ``U_max``, ``U_mean`` in um.

    Raises
    ------
    InputError
        if a direction is missing or nothing was repeated: the guideline has no such test.
    """
    if not (statistics.bidirectional and statistics.repeated):
        raise InputError(
            Message("vdi-needs-both-directions", "VDI/DGQ 3441 needs both directions, each repeated at every target")
        )
    count = len(statistics.position_mm)
    signs = np.sign(statistics.values[MEAN_UP] - statistics.values[MEAN_DOWN]).tolist()
    middle = [[(0.5, MEAN_UP, i), (0.5, MEAN_DOWN, i)] for i in range(count)]
    reversal = [[(signs[i], MEAN_UP, i), (-signs[i], MEAN_DOWN, i)] for i in range(count)]
    scatter = [[(3.0, 2, i), (3.0, 3, i)] for i in range(count)]

    def edge(side: float) -> list[Combination]:
        half = [[(0.5 * side * f, row, k) for f, row, k in reversal[i] + scatter[i]] for i in range(count)]
        return [combine(statistics, middle[i] + half[i]) for i in range(count)]

    def mean(parts: list[list[tuple[float, int, int]]]) -> Combination:
        return combine(statistics, [(factor / count, row, i) for part in parts for factor, row, i in part])

    found = {
        "P": (spread(edge(1.0), edge(-1.0)), "positional uncertainty"),
        "P_a": (spread([combine(statistics, part) for part in middle]), "positional deviation"),
        "P_s_max": (largest([combine(statistics, part) for part in scatter]), "largest positional scatter"),
        "P_s_mean": (mean(scatter), "mean positional scatter"),
        "U_max": (largest([combine(statistics, part) for part in reversal]), "largest reversal"),
        "U_mean": (mean(reversal), "mean reversal"),
    }
    return {key: figure(statistics, item, f"{text}, VDI/DGQ 3441", budget) for key, (item, text) in found.items()}


def accuracy_of_runs(
    statistics: Mapping[str, RunStatistics], edition: int = LATEST, budgets: Mapping[str, SetupBudget] | None = None
) -> Accuracy:
    """Return ISO 230-2 and, if the runs allow it, VDI/DGQ 3441 of every axis; groups are the letters of the axes.

    Parameters
    ----------
    statistics : by axis.
    edition : of ISO 230-2.
    budgets : contribution of the set-up to the uncertainties, by axis.
    """
    groups: dict[str, dict[str, Figure]] = {}
    targets = {}
    for axis, item in statistics.items():
        budget = (budgets or {}).get(axis, NO_BUDGET)
        test = positioning_test(item, edition, budget)
        groups[axis], targets[axis] = dict(test.figures), test.targets
        if item.bidirectional and item.repeated:
            groups[axis] |= {f"VDI {key}": figure for key, figure in vdi_3441(item, budget).items()}
    statements = (f"ISO 230-2:{edition}", "checked against published formulas and worked examples, not certified")
    return Accuracy(groups, statements, targets)


# Measured diagonals (ISO 230-6): each evaluated as an axis, and the largest of the four body diagonals.
#
# From the deviations of the measured from the commanded distance along a diagonal: E, B, M, R of each diagonal as along
# an axis; E_d and B_d are the largest E and B of the four body diagonals. Face diagonals are evaluated one by one.
# Differences of the diagonals' lengths indicate squareness: NPP - PPP = 2 EC0Y X Y / L over a box X, Y, Z with the
# diagonal L.


#: Figures of ISO 230-2 that are not evaluated along diagonals.
_NOT_ALONG = ("A", "A_up", "A_down")
#: Corners of the boxes of two diagonals closer than this are the same, mm.
SAME_CORNER_MM = 0.01
NO_PROOF = "errors of opposite sign cancel on a diagonal: four equal diagonals do not prove a good machine"


@dataclass(frozen=True)
class DiagonalRun:
    """One measured diagonal: ends (3,) in mm in the direction of its name, and its statistics over the distance."""

    name: str
    start_mm: FloatArray
    end_mm: FloatArray
    statistics: RunStatistics

    @property
    def length_mm(self) -> float:
        """Distance of the ends."""
        return float(np.linalg.norm(self.end_mm - self.start_mm))

    @property
    def unit(self) -> FloatArray:
        """Direction (3,) from start to end."""
        return np.asarray((self.end_mm - self.start_mm) / self.length_mm)


def diagonal_runs(machine: Machine, diagonals: Diagonals) -> dict[str, DiagonalRun]:
    """Return the statistics of every measured diagonal by its name.

    Raises
    ------
    InputError
        for positions outside the travel, and for a direction measured at only some positions.
    """
    for axis, values in enumerate(diagonals.position_mm.T):
        low, high = machine.axes[axis].range_mm
        for row in np.flatnonzero((values < low - 1e-3) | (values > high + 1e-3))[:1].tolist():
            file, line = diagonals.origin[row] if diagonals.origin else (None, None)
            text = f"{AXES[axis]} = {values[row]:g} mm is outside the travel {low:g} to {high:g} mm"
            raise InputError(text, file=file, line=line, field=f"column {AXES[axis].lower()}_mm")
    found = {}
    for name in diagonals.names:
        rows = diagonals.rows(name)
        points = diagonals.position_mm[rows]
        distance = along_mm(points, name)
        try:
            own = run_statistics(distance, diagonals.direction[rows].astype(np.float64), diagonals.deviation_mm[rows])
        except InputError as error:
            file = diagonals.origin[int(rows[0])][0] if diagonals.origin else None
            raise InputError(
                Message(
                    "distance-along-line", "{name}, distance along it: {message}", name=name, message=error.message
                ),
                file=file,
            ) from None
        found[name] = DiagonalRun(name, points[int(np.argmin(distance))], points[int(np.argmax(distance))], own)
    return found


def accuracy_of_diagonals(
    machine: Machine,
    runs: Mapping[str, DiagonalRun],
    edition: int = LATEST,
    budgets: Mapping[str, SetupBudget] | None = None,
) -> Accuracy:
    """Return the figures of each diagonal, of all four (``Ed``, ``Bd``), and the squareness that they indicate.

    Parameters
    ----------
    machine : defines how squareness errors act.
    runs : by name.
    edition : of ISO 230-2.
    budgets : contribution of the set-up to the uncertainties, by axis; along a diagonal expansions are weighted by the
    squares of its direction cosines.
    """
    groups: dict[str, dict[str, Figure]] = {}
    targets = {}
    for name, run in runs.items():
        budget = budget_along(run, budgets or {})
        test = positioning_test(run.statistics, edition, budget)
        targets[name] = test.targets
        groups[name] = {
            key: replace(item, meaning=f"diagonal {name}, ISO 230-6: {item.meaning}")
            for key, item in test.figures.items()
            if key not in _NOT_ALONG
        }
        ways, last = run.statistics.directions, len(run.statistics.position_mm) - 1
        ends = [(sign / len(ways), way, at) for way in ways for sign, at in ((1.0, last), (-1.0, 0))]
        said = "mean of both directions" if len(ways) == 2 else "of the measured direction"
        text = f"diagonal {name}: deviation of its length from end to end, {said}; not a standard figure"
        groups[name]["D"] = figure(run.statistics, combine(run.statistics, ends), text, budget)
    statements = [f"ISO 230-6, each diagonal as ISO 230-2:{edition}", *(_described(run) for run in runs.values())]
    missing = [name for name in BODY_DIAGONALS if name not in runs]
    corners = {name: np.sort([run.start_mm, run.end_mm], axis=0) for name, run in runs.items()}
    other = [n for n in BODY_DIAGONALS if not missing and np.max(np.abs(corners[n] - corners["PPP"])) > SAME_CORNER_MM]
    together: dict[str, dict[str, Figure]] = {}
    if missing:
        statements.append(f"Ed, Bd: not given; all four body diagonals are needed, {', '.join(missing)} missing")
    elif other:
        statements.append(f"Ed, Bd: not given; {', '.join(other)} belong to a different box than PPP")
    else:
        together["diagonals"], remarks = _largest(runs, groups)
        together["squareness indication"] = _squareness(machine, runs, groups)
        statements += [*remarks, _SQUARENESS_TEXT]
    statements += [NO_PROOF, "checked against published formulas and worked examples, not certified"]
    return Accuracy({**together, **groups}, tuple(statements), targets)


def budget_along(run: DiagonalRun, budgets: Mapping[str, SetupBudget]) -> SetupBudget:
    """Return the budget of a diagonal: that of an axis with the expansion coefficients weighted by squared cosines."""
    known = [budgets.get(axis, NO_BUDGET) for axis in AXES]
    squares = run.unit**2
    mixed = float(squares @ [item.expansion_um_per_m_k for item in known])
    moving = int(np.argmax(squares))
    return replace(known[moving], expansion_um_per_m_k=mixed)


def _described(run: DiagonalRun) -> str:
    ends = " to ".join(f"({', '.join(f'{value:g}' for value in point)})" for point in (run.start_mm, run.end_mm))
    ways = "both directions" if run.statistics.bidirectional else (
        "only in its direction" if MEAN_UP in run.statistics.directions else "only against its direction"
    )  # fmt: skip
    return f"{run.name}: {ends} mm, {run.length_mm:g} mm, {len(run.statistics.position_mm)} positions, {ways}"


def _largest(
    runs: Mapping[str, DiagonalRun], groups: Mapping[str, Mapping[str, Figure]]
) -> tuple[dict[str, Figure], list[str]]:
    """Return Ed and Bd, or why they cannot be given."""
    one_way = [name for name in BODY_DIAGONALS if not runs[name].statistics.bidirectional]
    if one_way:
        return {}, [f"Ed, Bd: not given; {', '.join(one_way)} measured in only one direction"]
    found = {}
    for symbol, key, text in (("Ed", "E", "systematic error"), ("Bd", "B", "reversal error")):
        worst = max(BODY_DIAGONALS, key=lambda name: groups[name][key].value)
        own = groups[worst][key]
        meaning = f"largest {text} {key} of the four body diagonals, {worst}; ISO 230-6"
        found[symbol] = replace(own, meaning=meaning)
    return found, []


_SQUARENESS_TEXT = (
    "squareness: an indication from differences of the diagonals' lengths (NPP - PPP = 2 EC0Y X Y / L, and so on); slopes of "
    "straightness and angular errors have the same effect"
)


def _squareness(
    machine: Machine, runs: Mapping[str, DiagonalRun], groups: Mapping[str, Mapping[str, Figure]]
) -> dict[str, Figure]:
    """Solve the four length deviations for their common part and the three squareness errors.

    D = c + u . (C(end) - C(start)) P with P the squareness errors alone: four equations, four unknowns.
    """
    first = c_matrix(machine, np.array([runs[name].start_mm for name in BODY_DIAGONALS]), np.zeros(3))
    last = c_matrix(machine, np.array([runs[name].end_mm for name in BODY_DIAGONALS]), np.zeros(3))
    units = np.array([runs[name].unit for name in BODY_DIAGONALS])
    effect = np.einsum("di,dij->dj", units, (last - first)[:, :, -len(SQUARENESS_NAMES) :])
    weights = np.linalg.inv(np.column_stack([np.ones(len(units)), effect]))[1:]
    ends = [groups[name]["D"] for name in BODY_DIAGONALS]
    found = {}
    for name, row in zip(SQUARENESS_NAMES, weights * MM_PER_UM / RAD_PER_URAD, strict=True):
        meaning = f"indication of squareness {name} from differences of the body diagonals; not a standard figure"
        value = float(sum(w * item.value for w, item in zip(row, ends, strict=True)))
        u = math.sqrt(sum((w * item.u) ** 2 for w, item in zip(row, ends, strict=True)))  # independent of each other
        parts = {
            key: math.sqrt(sum((w * i.contributions.get(key, 0.0)) ** 2 for w, i in zip(row, ends, strict=True)))
            for key in dict.fromkeys(key for item in ends for key in item.contributions)
        }
        found[name] = Figure(value, u, "urad", meaning, parts)
    return found
