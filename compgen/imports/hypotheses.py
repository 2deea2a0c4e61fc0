"""Unit and sign as hypotheses that the data speak for or against.

Three kinds of evidence, the strongest first. Where a file holds target AND reading, the slope of the one over the other is
the ratio of their units and its sign the sign. Tracer lengths and commanded points obey |P - S|^2 = (k L + c)^2, linear in
k^2, S and the rest, so least squares tells the unit k and, by the sign of k L + c, the sign. Bare deviations have their
size only: it is compared with what machine tools have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray

#: Usual size of a deviation: so much, and so much for each metre of travel; one standard deviation is a factor of 5.
USUAL_UM, USUAL_UM_PER_M, SPREAD_DECADES = 2.0, 10.0, 0.7
USUAL_URAD = 10.0
#: Usual travel, and its spread.
USUAL_TRAVEL_MM, TRAVEL_DECADES = 800.0, 0.5
#: A hypothesis with less than this share of all is not taken without being asked.
SURE = 0.95
#: A declared unit that makes the data so much larger or smaller than usual is doubted (decades).
ABSURD_DECADES = 2.2
#: Deviation of a slope from a ratio of units that still is that ratio.
SLOPE_TOLERANCE = 0.02


@dataclass(frozen=True)
class Verdict:
    """The best hypothesis, its share among all (0..1), and the shares of the others."""

    best: str
    share: float
    shares: Mapping[str, float]

    @property
    def sure(self) -> bool:
        """Whether it may be taken without asking."""
        return self.share >= SURE

    def text(self) -> str:
        """Say the best two in words."""
        ranked = sorted(self.shares.items(), key=lambda item: -item[1])[:2]
        return ", ".join(f"{name} {100 * share:.1f} %" for name, share in ranked)


def verdict_of(scores: Mapping[str, float]) -> Verdict:
    """Return the shares of hypotheses with the given log-likelihoods."""
    top = max(scores.values())
    weights = {name: float(np.exp(score - top)) for name, score in scores.items()}
    total = sum(weights.values())
    shares = {name: weight / total for name, weight in weights.items()}
    best = max(shares, key=lambda name: shares[name])
    return Verdict(best, shares[best], shares)


def decades_off(values: FloatArray, si_per_unit: float, usual_si: float) -> float:
    """Return by how many powers of ten the RMS of ``values`` about their mean (a single one: itself) exceeds the usual."""
    centre = values.mean() if len(values) > 1 else 0.0
    rms = float(np.sqrt(np.mean((values - centre) ** 2))) * si_per_unit
    return float(np.log10(max(rms, 1e-15) / usual_si))


def usual_deviation_mm(span_mm: float) -> float:
    """Return the usual size of deviations over a travel, mm."""
    return 1e-3 * (USUAL_UM + USUAL_UM_PER_M * span_mm / 1000.0)


def unit_of_deviations(values: FloatArray, units: Mapping[str, float], usual_si: float) -> Verdict:
    """Judge units of bare deviations by their size; ``units`` holds mm or rad for each unit."""
    scores = {
        name: -0.5 * (decades_off(values, scale, usual_si) / SPREAD_DECADES) ** 2 for name, scale in units.items()
    }
    return verdict_of(scores)


def unit_of_positions(span: float) -> Verdict:
    """Judge mm, m and inch for positions that span so much; mm is ten times as likely before one looks."""
    scores = {
        name: prior - 0.5 * (float(np.log10(max(span * scale, 1e-12) / USUAL_TRAVEL_MM)) / TRAVEL_DECADES) ** 2
        for name, scale, prior in (("mm", 1.0, 0.0), ("m", 1e3, -np.log(10.0)), ("in", 25.4, -np.log(50.0)))
    }
    return verdict_of(scores)


@dataclass(frozen=True)
class Slope:
    """Reading = slope * target + offset, in units of the reading; ``unit_ratio`` and ``sign`` if the slope is a ratio."""

    slope: float
    offset: float
    unit_ratio: float | None
    sign: int


def slope_of(target: FloatArray, reading: FloatArray) -> Slope:
    """Compare readings with targets, both (n,): the size of the slope is a ratio of units, its sign a sign."""
    if np.ptp(target) == 0.0:  # a single target shows no slope
        return Slope(0.0, float(np.mean(reading)), None, 1)
    slope, offset = np.polyfit(target, reading, 1).tolist()
    for ratio in (1.0, 1e3, 1e-3, 25.4, 1.0 / 25.4, 1e4):
        if abs(abs(slope) / ratio - 1.0) < SLOPE_TOLERANCE:
            return Slope(slope, offset, ratio, 1 if slope > 0 else -1)
    return Slope(slope, offset, None, 1 if slope > 0 else -1)


@dataclass(frozen=True)
class LengthEvidence:
    """What lengths and points say together: mm per unit of length, and the sign with which lengths grow."""

    mm_per_unit: float
    sign: int
    rms_mm: float


def judge_lengths(position_mm: FloatArray, length: FloatArray) -> LengthEvidence | None:
    """Judge the unit and the sign of the lengths of ONE station and set-up.

    |P|^2 = k^2 L^2 + 2 k c L + 2 S P + (c^2 - |S|^2) with points P (n, 3) in mm and lengths L (n,) in their unit. Two
    solutions c differ in sign only with k; of both the one counts with k L + c > 0 everywhere.

    Returns
    -------
    the evidence, or None if the points are too few or do not tell (k^2 not above zero, sign mixed).
    """
    if len(length) < 8:
        return None
    centre = position_mm.mean(axis=0)
    points, own = position_mm - centre, length - length.mean()
    size, scale = float(np.abs(points).max()), float(np.abs(own).max())
    if size == 0.0 or scale == 0.0:
        return None
    p, read = points / size, own / scale
    design = np.column_stack([read**2, read, p, np.ones(len(read))])
    found, _, rank, _ = np.linalg.lstsq(design, np.sum(p**2, axis=1), rcond=1e-10)
    square, linear = float(found[0]), float(found[1])
    if square <= 0.0 or rank < 3:
        return None
    k = float(np.sqrt(square))
    distance = k * read + linear / (2.0 * k)
    if not (np.all(distance > 0) or np.all(distance < 0)):
        return None
    rms = float(np.sqrt(np.mean((design @ found - np.sum(p**2, axis=1)) ** 2)))
    return LengthEvidence(k * size / scale, 1 if distance[0] > 0 else -1, rms * size)
