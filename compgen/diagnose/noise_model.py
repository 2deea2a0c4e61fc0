"""The noise of a measurement: kernels, their variances by restricted maximum likelihood, and whitening."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, eye_array

from compgen.data.csv_files import FloatArray
from compgen.diagnose.base_fit import BaseFit, orthonormal
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import Block, IntArray, MeasurementLayout
from compgen.kinematics.kernel_switch import lapack

# Noise of a measurement: white, slow parts per channel and common to all, and parts that change from run to run.
#
# The covariance is a sum of kernels whose variances are estimated by restricted maximum likelihood from the differences
# of repeats (Patterson and Thompson 1971), in which every effect of position, direction, feed, load or set-up cancels,
# known or not. The channels of a stop are rotated to their mean and contrasts, which decouples a common part.


#: Time constants of the kernels, in intervals between stops.
TAU = (3.0, 10.0, 40.0, 200.0, 2000.0)
#: Lower bound of a variance, as a share of the raw variance.
LEAST_SHARE = 1e-5
#: Maximum numbers of differences of repeats, and of stops without repeats: more cost time and add little information.
MOST_DIFFERENCES, MOST_STOPS = 640, 450
#: The prior is proportional to this power of every variance; least improvement of the log-likelihood that is worth another step.
PRIOR, NEGLIGIBLE = 0.02, 2e-3
#: How often a step that improves nothing is shortened.
HALVINGS = 8


@dataclass(frozen=True)
class Variances:
    """Variances of the kernels, mm^2: white, per channel (K,), common to all (K,); ``runs`` of the last two."""

    white: float
    own: FloatArray
    common: FloatArray

    @property
    def slow(self) -> float:
        """Variance of one channel without the white part."""
        return float(self.own.sum() + self.common.sum())

    @property
    def total(self) -> float:
        """Variance of one reading."""
        return self.white + self.slow


@dataclass(frozen=True)
class Noise:
    """The fitted noise model.

    Parameters
    ----------
    variances : of the kernels.
    scale : factor s of the standard deviation of each reading, (n,); 1 if it does not depend on range or channel.
    quadratic : d' P d of the differences, the pure-error sum of squares.
    freedom : its degrees of freedom.
    criterion : twice the REML criterion, up to a constant.
    source : ``"repeats"``, ``"given"`` or ``"assumed"``.
    spacing_s : median time between stops.
    """

    variances: Variances
    scale: FloatArray
    quadratic: float
    freedom: int
    criterion: float
    source: str
    spacing: float


def kernels(
    time: FloatArray, spacing: float, run: IntArray, in_run: FloatArray, *, runs: bool = True
) -> Iterator[FloatArray]:
    """Correlation matrices (T, T) of a block, in turn: one per time constant, then two for single runs."""
    apart = np.abs(time[:, None] - time[None, :]) / -spacing
    for tau in TAU:
        yield np.exp(apart / tau)
    same = (run[:, None] == run[None, :]).astype(np.float64) if runs else np.zeros_like(apart)
    yield same
    yield same * np.outer(in_run, in_run)


def rotation(channels: int) -> FloatArray:
    """Orthonormal matrix (c, c) whose first row forms the mean of the channels and the others contrasts."""
    matrix = np.zeros((channels, channels))
    matrix[0] = 1.0 / np.sqrt(channels)
    for k in range(1, channels):
        matrix[k, :k] = 1.0
        matrix[k, k] = -k
        matrix[k] /= np.sqrt(k * (k + 1.0))
    return matrix


def rotated(block: Block, columns: FloatArray) -> FloatArray:
    """Columns (n, k) of all readings in the rotated channels of a block, (c, T, k)."""
    picked = columns[block.rows]  # (T, c, k)
    if block.channels == 1:
        return np.ascontiguousarray(picked.transpose(1, 0, 2), dtype=np.float64)
    return np.asarray(np.einsum("dc,tck->dtk", rotation(block.channels), picked, optimize=True))


def spacing_of(layout: MeasurementLayout) -> float:
    """Median time between stops, 1 if there is none."""
    steps = np.diff(layout.time)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 1.0


def difference_matrix(layout: MeasurementLayout, block: Block) -> csr_array:
    """Orthonormal differences (d, T) of the repeats in a block; the stops of a cell are in time order."""
    cells = layout.cell[block.stop]
    order = np.argsort(cells, kind="stable")
    rows, columns, values, at = [], [], [], 0
    bounds = np.flatnonzero(np.diff(cells[order], prepend=-1, append=-1))
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        members = order[first:last]
        for k in range(1, len(members)):
            share = 1.0 / np.sqrt(k * (k + 1.0))
            rows += [at] * (k + 1)
            columns += members[: k + 1].tolist()
            values += [-share] * k + [k * share]
            at += 1
    return csr_array((values, (rows, columns)), shape=(at, len(cells)))


@dataclass(frozen=True)
class _Part:
    """Differences of one block: kernels (K, d (d + 1) / 2) and ``square`` (K, d, d), fixed effects and data (c, d, q + 1).

    Symmetric matrices that are summed or inverted are in LAPACK's rectangular packed form: half the memory, and half the
    operations of each sum.
    """

    kernels: FloatArray
    square: FloatArray
    columns: FloatArray

    @property
    def data(self) -> FloatArray:
        """The differences, (c, d)."""
        return self.columns[:, :, -1]

    def summed(self, variances: FloatArray, white: float) -> FloatArray:
        """Packed covariances (m, ...) for the variances (m, K) of the kernels and of the white part."""
        covariances = variances @ self.kernels
        covariances[:, self.diagonal] += white
        return np.asarray(covariances)

    @cached_property
    def diagonal(self) -> IntArray:
        """Places of the diagonal in the packed form, (d,)."""
        size = self.columns.shape[1]
        packed = _packed(np.diag(np.arange(1.0, size + 1.0)))
        places = np.flatnonzero(packed)
        return np.asarray(places[np.argsort(packed[places])], dtype=np.int64)

    def traces(self, packed: FloatArray) -> FloatArray:
        """Traces (K,) of the products of a packed matrix, which is overwritten, with each kernel."""
        packed *= 2.0
        packed[self.diagonal] *= 0.5
        return np.asarray(self.kernels @ packed)


def _packed(matrix: FloatArray) -> FloatArray:
    """Lower triangle of a symmetric matrix (d, d) in LAPACK's rectangular packed form."""
    return np.asarray(lapack().dtrttf(matrix, uplo="L")[0])


@dataclass(frozen=True)
class RemlPoint:
    """Criterion, gradient (k,) and average information (k, k) at some variances, and d' P d."""

    criterion: float
    gradient: FloatArray
    information: FloatArray
    quadratic: float


@dataclass
class Reml:
    """REML criterion of the differences of repeats, by the variances of white, per-channel and common kernels."""

    parts: list[_Part]
    fixed: int
    common: bool
    starts: FloatArray

    def at(self, theta: FloatArray) -> RemlPoint:
        """Criterion and derivatives at variances ``theta`` (k,).

        The average information 1/2 d' P K P K P d is the mean of the observed and the expected one, and needs no traces
        of products of two kernels (Gilmour, Thompson and Cullis 1995).
        """
        count, q, routines = len(TAU) + 2, self.fixed, lapack()
        own, shared = theta[1 : 1 + count], theta[1 + count :] if self.common else np.zeros(count)
        products, logdet = np.zeros((q + 1, q + 1)), 0.0
        # the mean of the channels and their contrasts, each with its channels, factor, and columns whitened once and twice
        solved: list[tuple[_Part, int, int, FloatArray, FloatArray, FloatArray]] = []
        for part in self.parts:
            channels, size = part.data.shape
            split = channels > 1 and bool(shared.any())
            kinds = ((slice(0, 1), channels), (slice(1, None), 0)) if split else ((slice(None), 0),)
            taken = np.stack([own + times * shared for _, times in kinds])[:, : len(part.kernels)]
            covariances = part.summed(taken, theta[0])
            for (mine, times), covariance in zip(kinds, covariances, strict=True):
                factor, failed = routines.dpftrf(size, covariance, uplo="L", overwrite_a=1)
                if failed:
                    raise np.linalg.LinAlgError("the covariance is not positive definite")
                columns = part.columns[mine]
                logdet += 2.0 * len(columns) * float(np.log(factor[part.diagonal]).sum())
                side_by_side = np.array(columns.transpose(1, 0, 2).reshape(size, -1), order="F")
                half = routines.dtfsm(1.0, factor, side_by_side, uplo="L", overwrite_b=1)
                for white in np.split(half, len(columns), axis=1):
                    products += white.T @ white
                weighted = routines.dtfsm(1.0, factor, half, uplo="L", trans="T")
                solved.append((part, len(columns), channels if times or not split else 0, factor, half, weighted))
        # eliminate the fixed effects: ``turn`` maps weighted columns to those of P d, and to the root of what P lacks
        turn, quadratic = np.eye(q + 1), float(products[q, q])
        if q:
            root = np.linalg.cholesky(products[:q, :q])
            turn[:q, :q] = np.linalg.inv(root).T
            seen = products[:q, q] @ turn[:q, :q]
            turn[:q, q] = -turn[:q, :q] @ seen
            quadratic -= float(seen @ seen)
            logdet += 2.0 * float(np.log(np.diag(root)).sum())
        gradient, information = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        absorbed = np.zeros((len(theta), q))
        for part, channels, times, factor, half, weighted in solved:
            size, terms = len(weighted), len(part.kernels)
            turned = np.asfortranarray((weighted.reshape(size, channels, -1) @ turn).reshape(weighted.shape))
            # K P d of the white part and of every kernel, whitened: (d, channels, 1 + K)
            left = np.ascontiguousarray(turned[:, q :: q + 1])
            of_kernels = (part.square.reshape(-1, size) @ left).reshape(terms, size, channels)
            moved = np.concatenate([left[None], of_kernels]).transpose(1, 2, 0).reshape(size, -1)
            white = routines.dtfsm(1.0, factor, np.asfortranarray(moved), uplo="L", overwrite_b=1)
            white = white.reshape(size * channels, 1 + terms)
            fixed = half.reshape(size, channels, -1)[:, :, :q].reshape(size * channels, q)
            each = np.eye(len(theta), 1 + terms)  # derivative of the variance of each kernel by ``theta``
            if self.common and len(part.columns) > 1:
                each[1 + count : 1 + count + terms, 1:] = times * np.eye(terms)
            information += 0.5 * each @ (white.T @ white) @ each.T
            absorbed += each @ (white.T @ fixed) @ turn[:q, :q]
            # 1/2 (tr(P K) - d' P K P d) for every kernel K
            inverse = routines.dpftri(size, factor, uplo="L", overwrite_a=1)[0]
            lacking = routines.dsfrk(*turned.shape, -1.0, turned, channels, inverse, uplo="L", overwrite_c=1)
            gradient += 0.5 * each @ np.append(float(lacking[part.diagonal].sum()), part.traces(lacking))
        information -= 0.5 * absorbed @ absorbed.T
        return RemlPoint(0.5 * (logdet + quadratic), gradient, information, quadratic)


def reml_problem(
    layout: MeasurementLayout,
    residual: FloatArray,
    fixed: FloatArray,
    *,
    repeats: bool = True,
    runs: bool = True,
    numbered: bool = False,
) -> Reml:
    """Set up the criterion: residuals (n,) and fixed effects (n, q) in the differences of repeats.

    Without ``repeats`` the residuals themselves are used; they must then contain only noise. ``runs``: whether there may
    be parts that change from run to run. ``numbered``: noise
    evolves from stop to stop, regardless of the time between them.
    """
    columns = np.column_stack([fixed, residual])
    key = "differences", repeats, numbered
    if key not in layout.kept:
        layout.kept[key] = [_differences(layout, block, repeats, numbered) for block in layout.blocks]
    count = len(TAU) + 2 if runs else len(TAU)
    parts = []
    for block, (matrix, packed, square) in zip(layout.blocks, layout.kept[key], strict=True):
        if matrix.shape[0]:
            turned = rotated(block, columns)
            parts.append(
                _Part(packed[:count], square[:count], np.stack([matrix @ turned[c] for c in range(block.channels)]))
            )
    return _with_fixed(parts)


def _differences(
    layout: MeasurementLayout, block: Block, repeats: bool, numbered: bool
) -> tuple[csr_array, FloatArray, FloatArray]:
    """Differences (d, T) of a block (or its stops), and the kernels of their covariance, packed and as (K, d, d)."""
    time = np.arange(layout.stops, dtype=np.float64) if numbered else layout.time
    size = len(block.stop)
    few = eye_array(min(size, MOST_STOPS), size, format="csr")
    matrix = difference_matrix(layout, block)[:MOST_DIFFERENCES] if repeats else few
    taken = np.unique(matrix.indices)
    stop, few = block.stop[taken], matrix[:, taken]
    run = layout.run[stop]  # with only one run, the part common to a run is a constant, which the fit absorbs
    several = len(np.unique(run)) > 1
    pattern = kernels(time[stop], 1.0 if numbered else spacing_of(layout), run, layout.in_run[stop], runs=several)
    square = np.array([few @ (few @ kernel).T for kernel in pattern] if len(stop) else [])
    return matrix, np.array([_packed(kernel) for kernel in square]), square


def _with_fixed(parts: list[_Part]) -> Reml:
    """Orthonormalise the fixed effects over all parts, without directions that do not vary."""
    common = any(len(part.columns) > 1 for part in parts)
    stacked = np.concatenate([part.columns.reshape(-1, part.columns.shape[2]) for part in parts])
    stacked, raw = stacked[:, :-1], stacked[:, -1]
    norm = np.linalg.norm(stacked, axis=0)
    varying = norm > 1e-9
    stacked = stacked[:, varying] / norm[varying]
    basis = np.zeros((len(stacked), 0))
    if stacked.shape[1]:
        u, singular, _ = np.linalg.svd(stacked, full_matrices=False)
        basis = u[:, singular > 1e-3 * singular[0]]
    start = float(np.mean((raw - basis @ (basis.T @ raw)) ** 2))
    done, at = [], 0
    for part in parts:
        rows, shape = part.data.size, part.data.shape
        both = np.column_stack([basis[at : at + rows], raw[at : at + rows]])
        done.append(_Part(part.kernels, part.square, both.reshape(*shape, both.shape[1])))
        at += rows
    count = len(TAU) + 2
    variances = np.full(1 + count * (2 if common else 1), 0.02 * start)
    variances[0] = 0.8 * start
    return Reml(done, basis.shape[1], common, variances)


def fit_reml(problem: Reml, *, start: FloatArray | None = None, steps: int = 60) -> tuple[Variances, float, float, int]:
    """Return variances, d' P d, the criterion, and the degrees of freedom of the differences.

    Newton's method with the average information in place of the second derivative, and a weak prior that grows with every
    variance (Chung et al. 2013): the likelihood alone would set parts to zero that it hardly determines.
    """
    raw = float(problem.starts[0]) / 0.8
    low, high = LEAST_SHARE * raw, 100.0 * raw
    theta = np.clip(problem.starts if start is None else start, low, high)
    now = problem.at(theta)
    for _ in range(steps):
        better = np.clip(away_from_zero(now, theta), low, high)
        step = better - theta
        gained = PRIOR * float(np.log(better / theta).sum())
        if gained - (now.gradient + 0.5 * now.information @ step) @ step < NEGLIGIBLE:
            break
        for _ in range(HALVINGS):
            better = theta + step
            trial = problem.at(better)
            if trial.criterion - PRIOR * float(np.log(better / theta).sum()) < now.criterion:
                break
            step = 0.25 * step
        else:
            break
        theta, now = better, trial
    theta = np.where(theta <= LEAST_SHARE * raw * 1.01, 0.0, theta)
    count = len(TAU) + 2
    common = theta[1 + count :] if problem.common else np.zeros(count)
    freedom = sum(part.data.size for part in problem.parts) - problem.fixed
    white = float(max(theta[0], LEAST_SHARE * raw))
    return Variances(white, theta[1 : 1 + count], common), now.quadratic, 2 * now.criterion, freedom


def away_from_zero(point: RemlPoint, theta: FloatArray) -> FloatArray:
    """Variances t (k,) > 0 that minimise the quadratic model of the criterion at ``theta`` less the prior of log t.

    Those that the criterion does not depend on stay as they are.
    """
    used = np.diag(point.information) > 0.0
    # in units of ``theta``; each step keeps a tenth of every variance, and is shortened until it improves the model
    slope = (point.gradient * theta)[used]
    curvature = (point.information * np.outer(theta, theta))[np.ix_(used, used)]

    def model(t: FloatArray) -> float:
        return float((slope + 0.5 * curvature @ (t - 1.0)) @ (t - 1.0) - PRIOR * np.log(t).sum())

    t = np.ones(len(slope))
    now = model(t)
    for _ in range(100):
        pull = slope + curvature @ (t - 1.0) - PRIOR / t
        step = np.linalg.solve(curvature + np.diag(PRIOR / t**2), -pull)
        if -float(pull @ step) < 1e-3 * NEGLIGIBLE:
            break
        share = min(1.0, 0.9 / max(float((-step / t).max()), 1e-300))
        while (trial := model(t + share * step)) > now and share > 1e-9:
            share *= 0.5
        t, now = t + share * step, trial
    found = theta.copy()
    found[used] *= t
    return found


def packed(variances: Variances, common: bool) -> FloatArray:
    """Variances as start values of :func:`fit_reml`."""
    parts: Sequence[FloatArray] = [np.array([variances.white]), variances.own, *([variances.common] if common else [])]
    return np.maximum(np.concatenate(parts), 1e-30)


# Noise model of a base fit: dependence on range and channel, then the variances of the kernels.


#: With fewer differences of repeats than this, the residuals themselves are used.
LEAST_DIFFERENCES = 60
#: Ratio of slope to uncertainty above which the noise depends on range.
RANGE_Z = 3.5
#: The same for noise that differs between channels: deviate of the logarithm of a variance.
CHANNEL_Z = 6.0
#: Neighbouring second differences overlap: sum of their squared correlations.
OVERLAP = 1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2
#: Squares above this many times the variance are gross errors and are clipped to it.
FAR_OUT = 16.0
#: Variance of single runs, as a share of the white variance, below which it is not tested.
LEAST_RUN_SHARE = 0.04


def has_repeats(layout: MeasurementLayout) -> bool:
    """Whether the measurement contains enough repeats for an independent noise model.

    What another station read at the same place, as one tracer does from station to station, repeats nothing.
    """
    differences = (len(block.stop) - len(np.unique(layout.cell[block.stop])) for block in layout.blocks)
    return sum(differences) >= LEAST_DIFFERENCES


def noise_of(
    fit: BaseFit, fixed: Sequence[Group], *, sigma_mm: FloatArray | None = None, before: Noise | None = None
) -> Noise:
    """Fit the noise model.

    Parameters
    ----------
    fit : the base fit.
    fixed : groups whose columns may differ between repeats; they neither inflate the noise nor are absorbed by it.
    sigma_mm : standard uncertainty of each reading, if given, (n,); used without repeats.
    before : an earlier model to start from.
    """
    layout = fit.observed.layout
    if not has_repeats(layout):
        # from the residuals after the base model and the groups ``fixed``: an assumption, not a measurement
        residual, count = fit.residual_mm, len(fit.residual_mm)
        design = np.hstack([fit.jacobian, _unit_columns(fixed, count)])
        q = orthonormal(design)
        residual = residual - q @ (q.T @ residual)
        residual = residual * np.sqrt(count / max(count - q.shape[1], 1))
        scale = np.ones(count) if sigma_mm is None else sigma_mm / np.sqrt(np.mean(sigma_mm**2))
        problem = reml_problem(layout, residual / scale, np.zeros((count, 0)), repeats=False, runs=False)
        variances, quadratic, criterion, _ = fit_reml(problem, steps=20)
        if sigma_mm is None:
            return Noise(variances, scale, quadratic, 0, criterion, "assumed", spacing_of(layout))
        variances = Variances(float(np.mean(sigma_mm**2)), variances.own, variances.common)
        return Noise(variances, scale, quadratic, 0, criterion, "given", spacing_of(layout))
    scale = before.scale if before is not None else noise_scale(fit)
    residual = fit.residual_mm / scale
    problem = reml_problem(layout, residual, _unit_columns(fixed, len(residual)) / scale[:, None])
    start = None if before is None else np.maximum(packed(before.variances, problem.common), problem.starts * 1e-3)
    variances, quadratic, criterion, freedom = fit_reml(problem, start=start, steps=60 if before is None else 15)
    return Noise(variances, scale, quadratic, freedom, criterion, "repeats", spacing_of(layout))


def _unit_columns(groups: Sequence[Group], count: int) -> FloatArray:
    if not groups:
        return np.zeros((count, 0))
    columns = np.hstack([group.columns for group in groups])
    return np.asarray(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))


def run_ratio(fit: BaseFit, fixed: Sequence[Group], noise: Noise, enough: float = 0.0) -> float:
    """Likelihood ratio of the parts that change from run to run; 0 where they are too small to matter.

    They are compared with noise that evolves in time, and, unless that gives no more than ``enough``, with noise that
    evolves from stop to stop.
    """
    runs = float(noise.variances.own[-2:].sum() + noise.variances.common[-2:].sum())
    if noise.source != "repeats" or runs <= LEAST_RUN_SHARE * noise.variances.white:
        return 0.0
    scale = noise.scale
    columns = _unit_columns(fixed, len(scale)) / scale[:, None]
    ratio = np.inf
    for numbered in (False, True):
        problem = reml_problem(fit.observed.layout, fit.residual_mm / scale, columns, runs=False, numbered=numbered)
        start = np.maximum(packed(noise.variances, problem.common), problem.starts * 1e-3)
        ratio = min(ratio, fit_reml(problem, start=start, steps=30)[2] - noise.criterion)
        if ratio <= enough:
            break
    return max(0.0, float(ratio))


def noise_scale(fit: BaseFit) -> FloatArray:
    """Factor of the standard deviation of each reading, (n,), with mean square 1.

    It is 1 unless the noise grows with range or differs between channels by more than range explains.
    """
    bends = _bends(fit)
    count = len(fit.residual_mm)
    if bends is None:
        return np.ones(count)
    readings = fit.readings
    square = (readings.range_mm / readings.range_mm.mean()) ** 2 if readings.kind == "lengths" else None
    with_range = _range_scale(bends.power, bends.rows, square, count)
    own = _channel_factor(fit, bends, bends.power / with_range[bends.rows] ** 2)
    if not own.any():
        return with_range
    factor = _channel_factor(fit, bends, bends.power, certain=True)
    factor = np.where(factor > 0, factor, 1.0)[fit.observed.layout.channel]
    scale = factor * _range_scale(bends.power / factor[bends.rows] ** 2, bends.rows, square, count)
    return np.asarray(scale / np.sqrt(np.mean(scale**2)))


@dataclass(frozen=True)
class _Bends:
    """Squared second differences of differences of repeats, mm^2, scaled to the variance of a reading; middle rows."""

    power: FloatArray
    rows: IntArray


def _bends(fit: BaseFit) -> _Bends | None:
    """Second differences of differences of repeats along a run, which contain no slow part. None if there are few."""
    layout = fit.observed.layout
    power, middle = [], []
    for block in layout.blocks:
        first, second = _pairs(layout, block.stop)
        if len(first) < 3:
            continue
        runs = layout.run[block.stop]
        together = (runs[second[2:]] == runs[second[:-2]]) & (runs[first[2:]] == runs[first[:-2]])
        difference = fit.residual_mm[block.rows[second]] - fit.residual_mm[block.rows[first]]
        bend = (difference[2:] - 2 * difference[1:-1] + difference[:-2])[together]
        power.append((bend**2 / 12.0).ravel())
        middle.append(block.rows[second[1:-1]][together].ravel())
    if sum(map(len, power)) < LEAST_DIFFERENCES:
        return None
    return _Bends(np.concatenate(power), np.concatenate(middle))


def _clipped(power: FloatArray) -> FloatArray:
    """Squares with gross errors clipped; 0.455 is the median of a squared normal deviate."""
    return np.minimum(power, FAR_OUT * float(np.median(power)) / 0.455)


def _channel_factor(fit: BaseFit, bends: _Bends, power: FloatArray, *, certain: bool = False) -> FloatArray:
    """Standard deviation of each channel relative to all channels, (channels,); zeros unless they clearly differ."""
    channel = fit.observed.layout.channel[bends.rows]
    factor = np.zeros(int(fit.observed.layout.channel.max()) + 1)
    means, counts = np.zeros(len(factor)), np.bincount(channel, minlength=len(factor))
    for k in np.flatnonzero(counts):
        means[k] = float(_clipped(power[channel == k]).mean())
    seen = counts > 0
    middle = float(np.exp(np.average(np.log(means[seen]), weights=counts[seen])))
    u = np.sqrt(2.0 * OVERLAP / np.maximum(counts, 1))
    apart = np.abs(np.log(np.where(seen, means, middle) / middle)) / u
    if not certain and float(apart.max()) < CHANNEL_Z:
        return factor
    factor[seen] = np.sqrt(means[seen] / middle)
    return factor


def _range_scale(power: FloatArray, rows: IntArray, square: FloatArray | None, count: int) -> FloatArray:
    """Range-dependent factor of the standard deviation, mean square 1, from regressing squares on squared range."""
    if square is None:
        return np.ones(count)
    against, power = square[rows], _clipped(power)
    design = np.column_stack([np.ones(len(against)), against])
    weight = np.ones(len(power))
    for _ in range(4):  # the variance of a squared normal deviate is twice the square of its mean
        coefficients = np.linalg.lstsq(design * weight[:, None], power * weight, rcond=None)[0]
        expected = np.maximum(design @ coefficients, 0.05 * power.mean())
        weight = 1.0 / expected
    inverse = np.linalg.inv((design * weight[:, None]).T @ (design * weight[:, None]))
    u = np.sqrt(inverse[1, 1] * 2.0 * OVERLAP)
    if coefficients[1] / u <= RANGE_Z:
        return np.ones(len(square))
    variance = np.maximum(coefficients[0] + coefficients[1] * square, 0.02 * power.mean())
    return np.asarray(np.sqrt(variance / variance.mean()))


def _pairs(layout: MeasurementLayout, stop: IntArray) -> tuple[IntArray, IntArray]:
    """Places in a block of the first and second stop of each repeated cell, in time order of the second."""
    cells = layout.cell[stop]
    order = np.lexsort((np.arange(len(cells)), cells))
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    counts = np.diff(np.append(starts, len(cells)))
    twice = starts[counts > 1]
    first, second = order[twice], order[twice + 1]
    by_time = np.argsort(second)
    return first[by_time], second[by_time]


# Whitening: transform columns and readings so that the noise is white with variance 1.
#
# The full inverse Cholesky factor is never formed. Each kernel has a state (an exponential with its time constant, a
# level and a slope of the run); its value at the start of a piece of stops contains all information from earlier stops.
# After the known states are subtracted, a piece is whitened by its small factor: time and memory grow linearly with the
# number of stops.


#: Stops per piece.
PIECE = 40


@dataclass(frozen=True)
class Piece:
    """Stops first ... last - 1, whitened together; b stops, J states at the first stop.

    Parameters
    ----------
    inverse : inverse Cholesky factor of their covariance given all earlier stops, (b, b).
    known : whitened stops per unit of each state, (b, J).
    kept, learnt : states of the next piece per unit of these states, (J,), and per unit of the whitened stops, (J, b).
    """

    first: int
    last: int
    inverse: FloatArray
    known: FloatArray
    kept: FloatArray
    learnt: FloatArray

    @cached_property
    def whole(self) -> FloatArray:
        """Whitened stops per unit of each stop, then of each state, (b, b + J)."""
        return np.hstack([self.inverse, -self.known])


def pieces_of(
    time: FloatArray, run: IntArray, in_run: FloatArray, white: float, variances: FloatArray
) -> tuple[Piece, ...]:
    """Factorise a covariance: ``time`` (T,) ascending, in stop intervals, ``variances`` (J,) of the kernels."""

    def seen(rows: slice, at: int) -> FloatArray:
        same = (run[rows] == run[at]).astype(np.float64)
        slow = np.exp(-np.abs(time[rows] - time[at])[:, None] / np.array(TAU))
        return np.column_stack([slow, same, same * in_run[rows]])

    found: list[Piece] = []
    explained = np.zeros((len(variances), len(variances)))
    for first in range(0, len(time), PIECE):
        rows, end = slice(first, first + PIECE), min(first + PIECE, len(time))
        here = seen(rows, first)
        covariance = white * np.eye(end - first) - here @ explained @ here.T
        for variance, kernel in zip(variances, kernels(time[rows], 1.0, run[rows], in_run[rows]), strict=True):
            if variance > 0.0:
                covariance += variance * kernel
        factor, failed = lapack().dpotrf(covariance, lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("the covariance of the noise is not positive definite")
        inverse = lapack().dtrtri(factor, lower=1)[0]
        after = min(end, len(time) - 1)
        kept = np.append(np.exp(-(time[after] - time[first]) / np.array(TAU)), [float(run[after] == run[first])] * 2)
        learnt = (variances[:, None] * seen(rows, after).T - (kept[:, None] * explained) @ here.T) @ inverse.T
        explained = kept[:, None] * explained * kept + learnt @ learnt.T
        found.append(Piece(first, end, inverse, inverse @ here, kept, learnt))
    return tuple(found)


@dataclass(frozen=True)
class Whitener:
    """Maps columns (n, k) of all readings to whitened columns (n, k), block by block and channel by channel.

    ``pieces`` of a block: the factors of the covariance of its channel mean, and of its contrasts.
    """

    layout: MeasurementLayout
    scale: FloatArray
    pieces: tuple[tuple[tuple[Piece, ...], tuple[Piece, ...]], ...]

    @cached_property
    def averages(self) -> FloatArray:
        """Weights (n, channels) of the mean of the readings of each channel."""
        member = self.layout.channel[:, None] == np.arange(int(self.layout.channel.max()) + 1)
        return np.asarray(member / np.maximum(member.sum(axis=0), 1))

    def __call__(
        self, columns: FloatArray, *, less: FloatArray | None = None, out: FloatArray | None = None
    ) -> FloatArray:
        """Whiten columns (n, k) or one column (n,).

        ``less`` (channels, k): what is subtracted from the readings of each channel; ``out`` (n, k): where to put them.
        """
        wide = columns.reshape(len(columns), -1)
        result, at = np.empty(wide.shape) if out is None else out, 0
        width, scaled = wide.shape[1], bool(np.any(self.scale != 1.0))
        for block, both in zip(self.layout.blocks, self.pieces, strict=True):
            count, size = block.channels, len(block.stop)
            turn = rotation(count)
            whitened = result[at : at + size * count].reshape(count, size, width)
            work = np.zeros((count, PIECE + len(both[0][0].kept), width))
            for mean, contrast in zip(*both, strict=True):
                rows, here = block.rows[mean.first : mean.last], mean.last - mean.first
                # (c, b, k): the channels of the piece, rotated to their mean and contrasts
                picked = wide[rows.T]
                if less is not None:
                    picked -= less[self.layout.channel[rows[0]]][:, None]
                if scaled:
                    picked /= self.scale[rows.T][:, :, None]
                if here < PIECE:  # the states follow the stops
                    work[:, here : here + work.shape[1] - PIECE] = work[:, PIECE:].copy()
                held = work[:, : here + work.shape[1] - PIECE]
                np.matmul(turn, picked.reshape(count, -1), out=work.reshape(count, -1)[:, : here * width])
                for piece, own in ((mean, slice(0, 1)), (contrast, slice(1, None))):
                    white = np.matmul(piece.whole, held[own], out=whitened[own, piece.first : piece.last])
                    states = held[own, here:]
                    states *= piece.kept[:, None]
                    states += piece.learnt @ white
            at += size * count
        return result.reshape(columns.shape)

    def transposed(self, whitened: FloatArray) -> FloatArray:
        """Transpose of whitening: its products with raw columns equal those of ``whitened`` (n, k) with white ones."""
        result, at = np.empty(whitened.shape), 0
        for block, both in zip(self.layout.blocks, self.pieces, strict=True):
            turn = rotation(block.channels)
            states = np.zeros((block.channels, len(both[0][0].kept), whitened.shape[1]))
            size = len(block.stop)
            parts = whitened[at : at + size * block.channels].reshape(block.channels, size, -1)
            for mean, contrast in zip(both[0][::-1], both[1][::-1], strict=True):
                turned = np.empty((block.channels, mean.last - mean.first, whitened.shape[1]))
                for piece, own in ((mean, slice(0, 1)), (contrast, slice(1, None))):
                    white = parts[own, piece.first : piece.last] + piece.learnt.T @ states[own]
                    turned[own] = piece.inverse.T @ white
                    states[own] = piece.kept[:, None] * states[own] - piece.known.T @ white
                rows = block.rows[mean.first : mean.last].T
                picked = (turn.T @ turned.reshape(block.channels, -1)).reshape(turned.shape)
                result[rows] = picked / self.scale[rows][:, :, None]
            at += size * block.channels
        return result

    def order_of(self, stop: IntArray) -> IntArray:
        """Stop of each whitened row, (n,); ``stop`` contains the stop of each reading."""
        blocks = self.layout.blocks
        return np.concatenate([np.tile(stop[block.rows[:, 0]], block.channels) for block in blocks])


def whitener(layout: MeasurementLayout, noise: Noise) -> Whitener:
    """Return the whitener for a noise model."""
    variances, spacing = noise.variances, spacing_of(layout)
    found = []
    for block in layout.blocks:
        order = (layout.time[block.stop] / spacing, layout.run[block.stop], layout.in_run[block.stop])
        several = np.append(np.ones(len(TAU)), [float(len(np.unique(order[1])) > 1)] * 2)
        own, common = variances.own * several, block.channels * variances.common * several
        contrast = pieces_of(*order, variances.white, own)
        found.append((pieces_of(*order, variances.white, own + common) if common.any() else contrast, contrast))
    return Whitener(layout, noise.scale, tuple(found))
