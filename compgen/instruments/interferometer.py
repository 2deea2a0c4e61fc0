"""Refractive index of air, compensated distances, and growth of the scales."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError, Message

if TYPE_CHECKING:
    from compgen.instruments.sixdof_instrument import SixDof, SixDofInstrument

# Refractive index of air, for interferometers that did not compensate the wavelength.


#: Air if nothing else is given, and as assumed by an uncompensated instrument.
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
    saturation pressure of water is from Buck (1981).
    """
    t, pascal = np.asarray(temperature_c, dtype=np.float64), 100.0 * np.asarray(pressure_hpa, dtype=np.float64)
    wavenumber = (1000.0 / wavelength_nm) ** 2  # squared, 1/um^2
    standard = (8342.54 + 2406147.0 / (130.0 - wavenumber) + 15998.0 / (38.9 - wavenumber)) * 1e-8
    compressed = (1.0 + 1e-8 * (0.601 - 0.00972 * t) * pascal) / (1.0 + 0.0036610 * t)
    saturation = 611.21 * np.exp((18.678 - t / 234.5) * t / (257.14 + t))
    vapour = np.asarray(humidity_percent) / 100.0 * saturation
    water = vapour * (3.7345 - 0.0401 * wavenumber) * 1e-10
    return np.asarray(1.0 + standard * pascal / 96095.43 * compressed - water)


# Interferometer equation with the index of air, and the growth of the machine's scales.
#
# The phase counts half wavelengths in the actual air (Jia et al. 2022, eq. 1): with the vacuum wavelength lambda,
# the index n of the air and the distance D to the target, travelled there and back,
#
#     n(t) D(t) - n(0) D(0) = lambda phi / (4 pi)
#
# A displacement computed by an instrument with an assumed index n_a is N = lambda phi / (4 pi n_a). So the change of
# the distance is (n_a N - (n - n(0)) D(0)) / n; the last term is the dead path, the distance at the first row of a run.


MM_PER_NM = 1e-6


def needs_air(readings: SixDof) -> bool:
    """Whether the interferometer's reading is a phase, or a displacement without the wavelength of the air."""
    if "phase_rad" in readings.covariates:
        return True
    text = readings.metadata.get("wavelength_compensated", "true").lower()
    if text not in ("true", "yes", "1", "false", "no", "0"):
        raise InputError(
            Message(
                "comment-not-boolean",
                "the comment wavelength_compensated = {text!r} is neither true nor false",
                text=text,
            ),
            file=_file(readings),
        )
    return text in ("false", "no", "0")


def compensated(readings: SixDof, instrument: SixDofInstrument) -> tuple[SixDof, dict[str, Any]]:
    """Return readings whose ``displacement_mm`` is the true change of the distance, and notes on what was done.

    Raises
    ------
    InputError
        if the air is not described (column ``temp_ambient_c``), or numbers are impossible.
    """
    if not needs_air(readings):
        return readings, {}
    temperature = readings.covariates.get("temp_ambient_c")
    if temperature is None:
        message = "is missing; a phase, or wavelength_compensated = false, requires the air temperature of each row"
        raise InputError(message, file=_file(readings), field="column temp_ambient_c")
    _check_complete(readings, "temp_ambient_c", temperature, np.ones(len(readings), dtype=bool))
    pressure = _air(readings, "pressure_hpa", STANDARD_PRESSURE_HPA, (500.0, 1200.0))
    humidity = _air(readings, "humidity_percent", STANDARD_HUMIDITY_PERCENT, (0.0, 100.0))
    wavelength_nm = _metadata_number(readings, "wavelength_nm", HELIUM_NEON_NM, (350.0, 1700.0))
    index = refractive_index(temperature, pressure, humidity, wavelength_nm)
    phase = readings.covariates.get("phase_rad")
    if phase is None:
        standard = refractive_index(
            np.array(REFERENCE_C), STANDARD_PRESSURE_HPA, STANDARD_HUMIDITY_PERCENT, wavelength_nm
        )
        assumed = _metadata_number(readings, "refractive_index_used", float(standard), (1.0, 1.001))
        optical = assumed * readings.signals_mm["displacement_mm"]
    else:
        assumed, optical = 1.0, wavelength_nm * MM_PER_NM * phase / (4.0 * np.pi)
    change = np.empty(len(readings))
    for axis, _, rows in readings.runs():
        # dead path: in air from the unit to the target at the first row, which is l_0, the outer prism of Z, and L
        first, entry, optics = rows[0], instrument.axes.get(axis), instrument.optics
        distance = float(readings.distance_mm[first])
        if not np.isfinite(distance):
            distance = float(entry.distance_first_mm or 0.0) if entry else 0.0
        dead = distance + optics.exit_to_prism_mm + (optics.prism_leg_mm if axis == 2 else 0.0)
        change[rows] = (optical[rows] - optical[first] - (index[rows] - index[first]) * dead) / index[rows]
    signals = {**readings.signals_mm, "displacement_mm": change}
    covariates = {name: values for name, values in readings.covariates.items() if name != "phase_rad"}
    metadata = {**readings.metadata, "wavelength_compensated": "true"}
    notes = {"index_assumed": assumed, "index_mean": float(index.mean()), "from_phase": phase is not None}
    return replace(readings, signals_mm=signals, covariates=covariates, metadata=metadata), {"wavelength": notes}


def growth_mm(machine: Machine, readings: SixDof, axis: int) -> FloatArray:
    """What the scale of ``axis`` adds to the command at its temperature, (n,), mm; zero where unknown.

    The scale has grown about the reference point: alpha (T - 20 degC)(q - q_ref), as for tracer lengths.
    """
    temperature = readings.covariates.get(f"temp_{AXES[axis].lower()}_c")
    alpha = machine.axes[axis].expansion_um_per_m_k
    if temperature is None or alpha is None:
        return np.zeros(len(readings))
    _check_complete(readings, f"temp_{AXES[axis].lower()}_c", temperature, readings.axis == axis)
    grown = 1e-6 * alpha * (temperature - REFERENCE_C) * (readings.position_mm - machine.reference_point_mm[axis])
    return np.asarray(np.where(readings.axis == axis, grown, 0.0))


def growth_notes(machine: Machine, readings: SixDof) -> dict[str, Any]:
    """Entry of ``identify.json`` on the temperature of the scales."""
    notes = {}
    for axis, name in enumerate(AXES):
        rows = readings.axis == axis
        grown = growth_mm(machine, readings, axis)
        if np.any(grown):
            values = readings.covariates[f"temp_{name.lower()}_c"][rows]
            largest = float(np.abs(grown).max()) / MM_PER_UM
            notes[name] = {"mean_c": float(values.mean()), "largest_growth_um": largest}
    return {"temperature": notes} if notes else {}


def _air(readings: SixDof, name: str, default: float, allowed: tuple[float, float]) -> FloatArray | float:
    """The column of that name, else the comment, else the default."""
    column = readings.covariates.get(name)
    if column is None:
        return _metadata_number(readings, name, default, allowed)
    _check_complete(readings, name, column, np.ones(len(readings), dtype=bool))
    wrong = np.flatnonzero((column < allowed[0]) | (column > allowed[1]))
    if wrong.size:
        raise _at_row(
            readings, int(wrong[0]), name, f"{column[wrong[0]]:g} is not within {allowed[0]:g}...{allowed[1]:g}"
        )
    return column


def _metadata_number(readings: SixDof, key: str, default: float, allowed: tuple[float, float]) -> float:
    text = readings.metadata.get(key)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        raise InputError(
            Message("comment-not-number", "the comment {key} = {text!r} is not a number", key=key, text=text),
            file=_file(readings),
        ) from None
    if not allowed[0] <= value <= allowed[1]:
        message = f"the comment {key} = {value:g} must lie within {allowed[0]:g} ... {allowed[1]:g}"
        raise InputError(message, file=_file(readings))
    return value


def _check_complete(readings: SixDof, column: str, values: FloatArray, required: FloatArray) -> None:
    missing = np.flatnonzero(~np.isfinite(values) & required)
    if missing.size:
        raise _at_row(readings, int(missing[0]), column, "is given for only some of the rows; give it in every file")


def _at_row(readings: SixDof, row: int, column: str, message: str) -> InputError:
    file, line = readings.origin[row] if readings.origin else (None, None)
    return InputError(message, file=file, line=line, field=f"column {column}")


def _file(readings: SixDof) -> str | None:
    return readings.origin[0][0] if readings.origin else None


def summary_of(machine: Machine, readings: SixDof, notes: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that was corrected, for ``identify.json``."""
    return {**notes, **growth_notes(machine, readings)}
