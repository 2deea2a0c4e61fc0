"""Error motions of rotary axes over their angle (EXC ... ECC) from sphere poses that position errors alone do not explain.

Each motion is a sum of waves of one to four periods a turn, zero at the reference of its axis, with a normal prior that is
smaller for shorter waves. Its size, and the noise where no uncertainty is stated, are those under which the readings are most
probable; motions enter only if that is far more probable than without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.rotary import RotaryCurve, motion_names

#: Periods a turn; sizes of motions that are tried, mm; of a tilt relative to a translation, rad per mm (30 urad with 10 um).
_WAVES = (1, 2, 3, 4)
_SIZES_MM = tuple(1e-3 * 2.0**k for k in range(-1, 10))
_TILT = 3e-3
#: Logarithm of how much more probable the readings must be with motions.
WORTH = 10.0
#: Noise that is tried where none is stated, relative to that without motions.
_NOISE = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
#: Variance of what is free: places of the spheres, mm^2.
_FREE = 1e4
_FOLDS = 5


@dataclass(frozen=True)
class Motions:
    """Error motions with what else was found with them.

    Parameters
    ----------
    curves : motions that the readings determine, by name; ``not_told`` the names of the others.
    values, covariance : of the unknowns without motions, mm and rad.
    residual_mm : what is left, (q,).
    left_out_mm : rms distance of poses that were left out in turn.
    noise_mm, size_mm : standard deviations of a coordinate, and of a motion of one period a turn.
    gain : logarithm of how much more probable the readings are than without motions.
    """

    curves: Mapping[str, RotaryCurve]
    not_told: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    residual_mm: FloatArray
    left_out_mm: float
    noise_mm: float
    size_mm: float
    gain: float


def _waves(angle_deg: FloatArray, reference_deg: float) -> FloatArray:
    """Waves at angles, zero at the reference, (n, 8)."""
    at, zero = np.radians(angle_deg), np.radians(reference_deg)
    return np.stack(
        [one for k in _WAVES for one in (np.cos(k * at) - np.cos(k * zero), np.sin(k * at) - np.sin(k * zero))], axis=1
    )


_SMALLER = np.repeat([1.0 / k**2 for k in _WAVES], 2)


def find_motions(
    machine: Machine,
    angle_deg: Mapping[str, FloatArray],
    read_with: Callable[[Mapping[str, RotaryCurve]], FloatArray],
    pose: NDArray[np.int64],
    columns: FloatArray,
    wanted: FloatArray,
    variance: FloatArray,
    noise_mm: FloatArray,
    *,
    free_noise: bool,
) -> Motions | None:
    """Error motions, if the readings are far more probable with them; else None.

    Parameters
    ----------
    read_with : what the model reads with these motions, (q,); ``pose`` (q,) is the number of the pose of each reading.
    columns, wanted : the linear model of the other unknowns (q, m), and what it has to explain (q,), mm.
    variance : of the other unknowns before the measurement, (m,); inf for what is free.
    noise_mm : standard uncertainty of each reading, (q,).
    free_noise : whether the noise is to be found, too.
    """
    names = [name for letter in machine.rotary for name in motion_names(letter)]
    moved = _columns(machine, angle_deg, read_with, names)
    size = np.concatenate([_SMALLER * (1.0 if name[1] in AXES else _TILT) for name in names])
    every = np.hstack([columns, moved])
    before = np.minimum(variance, _FREE)

    def prior(size_mm: float) -> FloatArray:
        return np.concatenate([before, (size_mm * size) ** 2])

    noise = noise_mm
    factors = _NOISE if free_noise else (1.0,)
    compressed = _compressed(every / noise[:, None], wanted / noise)
    plain = max(_evidence(compressed, prior(0.0), factor) for factor in factors)
    tried = {
        (size_mm, factor): _evidence(compressed, prior(size_mm), factor) for size_mm in _SIZES_MM for factor in factors
    }
    size_mm, factor = max(tried, key=lambda key: tried[key])
    gain = tried[size_mm, factor] - plain
    if gain < WORTH:
        return None
    variances, noise = prior(size_mm), noise * factor
    mean, covariance = _posterior(every, variances, noise, wanted)
    m = columns.shape[1]
    curves, not_told = _curves(machine, angle_deg, names, mean[m:], covariance[m:, m:], variances[m:])
    left = wanted - every @ mean
    left_out = _left_out(every, variances, noise, wanted, pose)
    return Motions(
        curves,
        tuple(not_told),
        mean[:m],
        covariance[:m, :m],
        left,
        left_out,
        float(np.sqrt(np.mean(noise**2))),
        size_mm,
        gain,
    )


def _columns(
    machine: Machine,
    angle_deg: Mapping[str, FloatArray],
    read_with: Callable[[Mapping[str, RotaryCurve]], FloatArray],
    names: list[str],
) -> FloatArray:
    """Derivatives (q, 8 motions) of the readings by the waves of each motion."""
    none, found = read_with({}), []
    for name in names:
        axis = machine.rotary[name[-1]]
        nodes = np.unique(np.append(angle_deg[name[-1]], axis.reference_deg))
        step = 1e-3 if name[1] in AXES else 1e-6
        for wave in _waves(nodes, axis.reference_deg).T:
            curve = RotaryCurve(nodes, step * wave, np.full(len(nodes), np.nan))
            found.append((read_with({name: curve}) - none) / step)
    return np.stack(found, axis=1)


def _compressed(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray, float, int]:
    """Columns and readings in the space that the columns span; square and number of what is outside. All in units of noise."""
    across, columns = np.linalg.qr(columns)
    inside = across.T @ wanted
    return columns, inside, float(wanted @ wanted - inside @ inside), len(wanted) - len(inside)


def _evidence(compressed: tuple[FloatArray, FloatArray, float, int], variance: FloatArray, noise: float) -> float:
    """Logarithm of the probability density of the readings, but for a constant; ``noise`` is a factor."""
    columns, inside, outside, count = compressed
    total = (columns * variance) @ columns.T + noise**2 * np.eye(len(inside))
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(factor, inside)
    return float(-0.5 * (half @ half + outside / noise**2) - np.log(np.diag(factor)).sum() - count * np.log(noise))


def _posterior(
    columns: FloatArray, variance: FloatArray, noise: FloatArray, wanted: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of all unknowns."""
    known = variance > 0.0
    root = np.sqrt(variance[known])
    weighted = columns[:, known] * root / noise[:, None]
    inverse = np.linalg.inv(weighted.T @ weighted + np.eye(len(root)))
    mean, covariance = np.zeros(len(variance)), np.zeros((len(variance), len(variance)))
    mean[known] = root * (inverse @ (weighted.T @ (wanted / noise)))
    covariance[np.ix_(known, known)] = inverse * np.outer(root, root)
    return mean, covariance


def _curves(
    machine: Machine,
    angle_deg: Mapping[str, FloatArray],
    names: list[str],
    mean: FloatArray,
    covariance: FloatArray,
    variance: FloatArray,
) -> tuple[dict[str, RotaryCurve], list[str]]:
    """Curves that are determined (a third of what was assumed, as position errors), and names of the others."""
    curves, not_told, width = {}, [], len(_SMALLER)
    for k, name in enumerate(names):
        axis, own = machine.rotary[name[-1]], slice(k * width, (k + 1) * width)
        waves = _waves(angle_deg[name[-1]], axis.reference_deg)
        after = np.sqrt(np.mean(np.einsum("ij,jk,ik->i", waves, covariance[own, own], waves)))
        assumed = np.sqrt(np.mean(waves**2 @ variance[own]))
        if after > assumed / 3.0:
            not_told.append(name)
            continue
        low, high = float(angle_deg[name[-1]].min()), float(angle_deg[name[-1]].max())
        nodes = np.unique(np.append(np.linspace(low, high, 37), axis.reference_deg))
        waves = _waves(nodes, axis.reference_deg)
        u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", waves, covariance[own, own], waves), 0.0))
        curves[name] = RotaryCurve(nodes, waves @ mean[own], u)
    return curves, not_told


def _left_out(
    columns: FloatArray, variance: FloatArray, noise: FloatArray, wanted: FloatArray, pose: NDArray[np.int64]
) -> float:
    """Rms distance of poses that were left out of the fit in turn, mm."""
    count = int(pose.max()) + 1
    fold: NDArray[np.int64] = (np.random.default_rng(0).permutation(count) % _FOLDS)[pose]
    total = 0.0
    for k in range(_FOLDS):
        inside = fold != k
        mean, _ = _posterior(columns[inside], variance, noise[inside], wanted[inside])
        total += float(np.sum((wanted[~inside] - columns[~inside] @ mean) ** 2))
    return float(np.sqrt(total / count))
