"""Refractive index of air, for interferometers that did not compensate the wavelength."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray

#: What the air is taken to be where nothing says, and what an uncompensated instrument assumes.
REFERENCE_C = 20.0
STANDARD_PRESSURE_HPA = 1013.25
STANDARD_HUMIDITY_PERCENT = 50.0
HELIUM_NEON_NM = 632.9913


def refractive_index(
    temperature_c: FloatArray,
    pressure_hpa: FloatArray | float,
    humidity_percent: FloatArray | float,
    wavelength_nm: float = HELIUM_NEON_NM,
) -> FloatArray:
    """Phase refractive index of air by the modified Edlen equation (Birch & Downs 1993, eq. 1-3, 1994), 450 ppm CO2.

    Temperature, pressure and humidity are numbers or arrays (n,). ``wavelength_nm`` is the vacuum wavelength; the
    saturation pressure of water is that of Buck (1981).
    """
    t, pascal = np.asarray(temperature_c, dtype=np.float64), 100.0 * np.asarray(pressure_hpa, dtype=np.float64)
    wavenumber = (1000.0 / wavelength_nm) ** 2  # squared, 1/um^2
    standard = (8342.54 + 2406147.0 / (130.0 - wavenumber) + 15998.0 / (38.9 - wavenumber)) * 1e-8
    compressed = (1.0 + 1e-8 * (0.601 - 0.00972 * t) * pascal) / (1.0 + 0.0036610 * t)
    saturation = 611.21 * np.exp((18.678 - t / 234.5) * t / (257.14 + t))
    vapour = np.asarray(humidity_percent) / 100.0 * saturation
    water = vapour * (3.7345 - 0.0401 * wavenumber) * 1e-10
    return np.asarray(1.0 + standard * pascal / 96095.43 * compressed - water)
