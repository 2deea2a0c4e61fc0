"""Uncertainty by sampling: draws of the errors from their covariance, and re-identification as a self-check.

Linear propagation agrees with nonlinear re-identification to about 1e-5 um, so drawing from the covariance is enough
for everything that depends on the errors; the re-identification confirms it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.errors import InputError, Message
from compgen.identification.covariance import Covariance
from compgen.identification.options import IdentifyOptions
from compgen.identification.result import Identification
from compgen.identification.tracer_lengths import identify
from compgen.kinematics.kernel_switch import one_thread
from compgen.parallel import Map


def sample_errors(covariance: Covariance, count: int, seed: int = 0) -> FloatArray:
    """Draw deviations of the error values from their joint distribution, shape (count, k), mm and rad.

    They are to be added to the values of the errors file, in the order of ``covariance.error``.
    """
    factor = covariance.errors_factor
    draws = np.random.default_rng(seed).standard_normal((count, factor.shape[1]))
    return np.asarray(draws @ factor.T)


@dataclass(frozen=True)
class SelfCheck:
    """Outcome of :func:`self_check`.

    ``ratio_median``, ``ratio_min``, ``ratio_max`` compare the standard deviation over the replicates with the stated
    standard uncertainty, value by value; ``expected_spread`` is the standard deviation of such a ratio by chance.
    """

    replicates: int
    seed: int
    ratio_median: float
    ratio_min: float
    ratio_max: float
    expected_spread: float

    @property
    def agrees(self) -> bool:
        """Whether the stated uncertainties agree with the replicates, within chance."""
        return abs(self.ratio_median - 1.0) < 3.0 * self.expected_spread and (
            1.0 - 5.0 * self.expected_spread < self.ratio_min and self.ratio_max < 1.0 + 5.0 * self.expected_spread
        )

    def summary(self) -> dict[str, Any]:
        """Return the object ``monte_carlo`` of ``identify.json``."""
        return {**asdict(self), "agrees": self.agrees}


def self_check(
    machine: Machine,
    lengths: Lengths,
    result: Identification,
    replicates: int = 50,
    seed: int = 0,
    progress: Callable[[int], None] = lambda _: None,
    mapper: Map = map,
) -> SelfCheck:
    """Identify again from simulated readings: those of the model with new noise of the stated size.

    Parameters
    ----------
    machine, lengths, result : what was identified, by the joint method, and the outcome.
    replicates : at least 10.
    seed : of the noise; each replicate has a separate generator, from this seed and its number.
    progress : called with the number of finished replicates.
    mapper : may distribute the replicates over processes; the outcome is the same.
    """
    adjustment = result.adjustment
    if replicates < 10 or adjustment is None or result.method != "joint":
        raise InputError(
            Message(
                "self-check-few",
                "a self-check needs at least 10 replicates of the joint method, not {replicates}",
                replicates=replicates,
            )
        )
    used = np.flatnonzero(result.accepted)
    sigma_mm = adjustment.sigma_mm / np.sqrt(adjustment.weight[used])
    model_mm = (lengths.length_mm + result.residual_mm)[used]
    plain = replace(lengths.part(used), covariates={}, approach=None)
    options = IdentifyOptions(
        u_length_um=result.u_length_um, u_length_um_per_m=result.u_length_um_per_m, reject=False, temperature=False
    )
    replicate = _Replicate(machine, plain, model_mm, sigma_mm, options)
    values = []
    for k, found in enumerate(mapper(replicate, ((seed, k) for k in range(replicates)))):
        values.append(found)
        progress(k + 1)
    _, u = _figures(result)
    spread = np.std(values, axis=0, ddof=1)
    ratio = spread[u > 0] / u[u > 0]
    return SelfCheck(
        replicates=replicates,
        seed=seed,
        ratio_median=float(np.median(ratio)),
        ratio_min=float(ratio.min()),
        ratio_max=float(ratio.max()),
        expected_spread=float(1.0 / np.sqrt(2.0 * (replicates - 1))),
    )


@dataclass(frozen=True)
class _Replicate:
    """The identified values of one simulated set of readings, as a function of its seed; can be sent to a process."""

    machine: Machine
    lengths: Lengths
    model_mm: FloatArray
    sigma_mm: FloatArray
    options: IdentifyOptions

    def __call__(self, seed: tuple[int, int]) -> FloatArray:
        noise = np.random.default_rng(seed).standard_normal(len(self.model_mm))
        readings = replace(self.lengths, length_mm=self.model_mm + self.sigma_mm * noise)
        with one_thread():
            return _figures(identify(self.machine, readings, self.options))[0]


def _figures(result: Identification) -> tuple[FloatArray, FloatArray]:
    """Values and standard uncertainties of all errors, curves first, mm and rad."""
    curves, squareness = result.errors.curves.values(), result.errors.squareness.values()
    value = np.concatenate([*(curve.value for curve in curves), [value for value, _ in squareness]])
    return value, np.concatenate([*(curve.u for curve in curves), [u for _, u in squareness]])
