"""What a positioning test's set-up adds to the uncertainty of its figures, in the manner of ISO/TR 230-9.

The sources are those that ISO 230-2 (Annex A) and ISO/TR 230-9 name: device, misalignment, temperature, expansion
coefficient, drift of the environment (EVE). How they act on a figure follows from the figure itself (its derivative by
every mean); the printed shortcut formulas of these documents are not used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM


@dataclass(frozen=True)
class Budget:
    """Standard uncertainties (k = 1) of what all readings of one axis share, and of single means.

    Parameters
    ----------
    device_um : of the device for each mean of a target and direction by itself (resolution, stability), um.
    device_ppm : of its length scale (wavelength, air), 1e-6.
    misalignment_mrad : of the angle between beam and axis, in each of two directions, mrad; a cosine error.
    temperature_k : of the axis' temperature, K; acts with ``expansion_um_per_m_k``.
    expansion_um_per_m_k : coefficient of expansion of the axis.
    u_expansion_um_per_m_k : its standard uncertainty; acts with ``from_20_k``.
    from_20_k : how far the axis was from 20 degC, K.
    drift_um : of each mean by the drift of the environment (EVE) during the test, um.
    """

    device_um: float = 0.0
    device_ppm: float = 0.0
    misalignment_mrad: float = 0.0
    temperature_k: float = 0.0
    expansion_um_per_m_k: float = 11.5
    u_expansion_um_per_m_k: float = 0.0
    from_20_k: float = 0.0
    drift_um: float = 0.0

    def contributions(self, position_mm: FloatArray, weight: FloatArray) -> Iterator[tuple[str, float]]:
        """Yield source and standard uncertainty (mm) of sum(weight * mean), which is how a figure follows the means.

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


NO_BUDGET = Budget()
