"""Positioning of rotary axes from runs in both directions (ISO 230-2): the error motion about the axis, and its reversal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import RAD_PER_URAD
from compgen.data.rotary import RAD_PER_ARCSEC, RotaryCurve, RotaryErrors, RotaryRuns
from compgen.errors import InputError, Message

#: An angle encoder is no better than this, and its zero moves between runs: added to the scatter, rad.
_ENCODER = 0.25 * RAD_PER_ARCSEC


@dataclass(frozen=True)
class RotaryPositioning:
    """Curves by letter, and figures of ISO 230-2 in arcsec: A, E, M, R (k = 2), B, mean reversal."""

    errors: RotaryErrors
    figures: Mapping[str, Mapping[str, float]]
    notes: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for ``identify.json``."""
        curves = {
            name: {
                "position_deg": curve.angle_deg.tolist(),
                "value_urad": (curve.value / RAD_PER_URAD).tolist(),
                "u_urad": (curve.u / RAD_PER_URAD).tolist(),
            }
            for name, curve in self.errors.curves.items()
        }
        figures = {letter: dict(own) for letter, own in self.figures.items()}
        return {"kind": "rotary-axis", "curves": curves, "figures_arcsec": figures, "notes": list(self.notes)}


def identify_rotary_runs(machine: Machine, runs: RotaryRuns) -> RotaryPositioning:
    """The mean of both directions as error motion about each axis, zero at its reference, with its uncertainty.

    Raises
    ------
    InputError
        for an axis with fewer than three targets.
    """
    curves, figures, notes, reversal = {}, {}, [], {}
    letters = np.array(runs.letter)
    for letter in dict.fromkeys(runs.letter):
        own = letters == letter
        target = np.unique(runs.angle_deg[own])
        if len(target) < 3:
            raise InputError(
                Message(
                    "few-angles",
                    "{letter} was measured at {target} angles; at least 3 are needed",
                    letter=letter,
                    target=len(target),
                )
            )
        mean, scatter, count = _statistics(runs, own, target)
        both = np.nanmean(mean, axis=0)
        if not np.isnan(mean).any():
            reversal[letter] = float(np.mean(mean[0] - mean[1]))
        axis, name = machine.rotary[letter], f"E{letter}{letter}"
        figures[letter] = _figures(mean, scatter)
        one_way = bool(np.isnan(mean).all(axis=1).any())
        if one_way:
            notes.append(
                f"{letter} was measured in one direction only: its reversal is not known, and half of it is in {name}."
            )
        single = count.max() < 2
        if single:
            notes.append(
                f"{letter} was measured once at each angle: its scatter is not known; uncertainties are of the encoder only."
            )
        pooled = 0.0 if single else float(np.sqrt(np.nansum(scatter**2) / max(int(np.sum(count > 1)), 1)))
        u = np.sqrt(pooled**2 / np.maximum(count.sum(axis=0), 1) + _ENCODER**2)
        at, value = target, both
        if axis.modulo_deg is not None and at[-1] - at[0] < axis.modulo_deg - 1e-9:
            at, value, u = (np.append(at, at[0] + axis.modulo_deg), np.append(value, value[0]), np.append(u, u[0]))
        elif axis.modulo_deg is not None:
            closing = (value[-1] - value[0]) / RAD_PER_ARCSEC
            if abs(closing) > 3.0 * float(u[0]) / RAD_PER_ARCSEC + 0.5:
                notes.append(
                    f"{letter}: after a whole turn the deviation differs by {closing:+.2f} arcsec; drift, or a slipping encoder."
                )
            value = np.append(value[:-1], value[0])
        if axis.range_deg is not None and (at[0] > axis.range_deg[0] + 1e-6 or at[-1] < axis.range_deg[1] - 1e-6):
            notes.append(
                f"{letter} was measured from {at[0]:g} to {at[-1]:g} degrees; beyond, to {axis.range_deg[0]:g} ... "
                f"{axis.range_deg[1]:g}, its last value is kept and not known."
            )
        zero = np.interp(axis.reference_deg, at, value, period=axis.modulo_deg)
        curves[name] = RotaryCurve(at, value - zero, u)
    return RotaryPositioning(RotaryErrors(curves, {}, reversal), figures, tuple(notes))


def _statistics(runs: RotaryRuns, own: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, estimator of the scatter, and number of readings, each (2, targets): up, then down; nan where there is none."""
    mean, scatter = np.full((2, len(target)), np.nan), np.full((2, len(target)), np.nan)
    count = np.zeros((2, len(target)))
    for way, direction in enumerate((1, -1)):
        for k, angle in enumerate(target):
            rows = runs.deviation_rad[own & (runs.angle_deg == angle) & (runs.direction == direction)]
            count[way, k] = len(rows)
            if len(rows):
                mean[way, k] = rows.mean()
            if len(rows) > 1:
                scatter[way, k] = rows.std(ddof=1)
    return mean, scatter, count


def _figures(mean: FloatArray, scatter: FloatArray) -> dict[str, float]:
    """Figures of ISO 230-2 (k = 2), arcsec; those that need both directions or several runs are left out without them."""
    k_s = 2.0 * scatter
    both = np.nanmean(mean, axis=0)
    found = {"E": np.nanmax(mean) - np.nanmin(mean), "M": np.ptp(both)}
    if not np.isnan(mean).any():
        reversal = mean[0] - mean[1]
        found |= {"B": np.max(np.abs(reversal)), "mean_reversal": reversal.mean()}
        if not np.isnan(scatter).any():
            at = np.maximum(k_s[0] + k_s[1] + np.abs(reversal), 2.0 * np.max(k_s, axis=0))
            found |= {"A": np.max(mean + k_s) - np.min(mean - k_s), "R": np.max(at)}
    return {name: float(value / RAD_PER_ARCSEC) for name, value in found.items()}
