"""Figures of ISO 230-2 of axis runs before and after what was found is taken off the readings."""

from __future__ import annotations

from typing import Any

import numpy as np

from compgen.accuracy import positioning_test, run_statistics
from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.diagnose.layout import IntArray
from compgen.diagnose.observed_axis import ObservedAxis
from compgen.errors import InputError

#: Figures that are shown: reversal, repeatability, systematic deviation and accuracy, in um.
SHOWN = ("B", "R", "E", "A")
#: What statistics cannot tell.
WARM_UP_NOTE = (
    "a warm-up of the machine and one of the sensor look alike: only a stationary drift test tells them apart"
)


def figures_before_after(observed: ObservedAxis, change_mm: FloatArray) -> dict[str, Any]:
    """Figures by axis and key as {"before", "after"} in um; ``change_mm`` (n,) is taken off for the second."""
    found: dict[str, Any] = {}
    for axis in observed.runs.axes:
        rows = np.flatnonzero(observed.runs.axis == axis)
        before = _figures(observed, rows, observed.runs.deviation_mm)
        after = _figures(observed, rows, observed.runs.deviation_mm - change_mm)
        found[AXES[axis]] = {key: {"before": before[key], "after": after[key]} for key in before if key in after}
    return found


def _figures(observed: ObservedAxis, rows: IntArray, deviation_mm: FloatArray) -> dict[str, float]:
    runs = observed.runs
    try:
        test = positioning_test(
            run_statistics(runs.position_mm[rows], runs.direction[rows].astype(np.float64), deviation_mm[rows])
        )
    except InputError:
        return {}
    return {key: float(test.figures[key].value) for key in SHOWN if key in test.figures}
