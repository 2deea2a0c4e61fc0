"""Readings brought to reference conditions: machine scales at 20 degC, the wavelength of the air that was there.

* **Scales.** At the temperature T of an axis its scale has grown about the reference point: at the command q the
  carriage stands at q + alpha (T - 20 degC)(q - q_ref), along the (leaning) axis. What this does to a length, with the
  exact model, is taken out of the reading. The identified errors then are those of the machine with all scales at
  20 degC. Unless the machine file names effects, nothing else is corrected: neither bending, nor a growth of bed,
  spindle or workpiece.
* **Effects** of the machine file (``[effects.NAME]``): what they add to a length is taken out.
* **Wavelength**, only if the file says ``# wavelength_compensated = false``: the refractive index of the air by the
  modified Edlen equation (Birch & Downs, Metrologia 30 (1993) 155 and 31 (1994) 315). A reading N is the true change of
  n times the distance D since the tracer was set to zero, over the index that the instrument assumed:

      n(t) D(t) - n(0) D(0) = n_assumed N

  so D = n_assumed N / n + dead length * (mean n) / n.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.core.air import (
    HELIUM_NEON_NM,
    REFERENCE_C,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_HPA,
    refractive_index,
)
from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.effects import ActiveEffect, readings_of_lengths
from compgen.errors import CompgenWarning, InputError
from compgen.identify.effects import effects_of_lengths, moved_by, notes_of
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import tip_position
from compgen.model.volumetric import tool_of

#: Temperatures that vary by more than this call for an expansion coefficient.
NOTABLE_K = 0.5


@dataclass(frozen=True)
class Conditions:
    """What the readings have to be corrected for; n readings.

    Parameters
    ----------
    machine : the machine.
    growth_mm : what the scales add to the command of each axis, (n, 3).
    dead_share : share of the dead length by which a reading is too short, (n,).
    notes : what was corrected, for ``identify.json``.
    effects : effects of the machine file that the readings show.
    """

    machine: Machine
    growth_mm: FloatArray
    dead_share: FloatArray
    notes: Mapping[str, Any]
    effects: tuple[ActiveEffect, ...] = ()

    @property
    def needs_geometry(self) -> bool:
        """Whether the correction depends on stations and dead lengths."""
        return bool(np.any(self.growth_mm) or np.any(self.dead_share) or self.effects)

    def correction_mm(
        self, lengths: Lengths, layout: ErrorParameters, state: State, group: IntArray, further_mm: FloatArray
    ) -> FloatArray:
        """Return what must be added to the readings (n,), mm, for stations, dead lengths and errors ``state``.

        ``further_mm`` (n, 3) is a displacement of the tip that is to be taken out as well.
        """
        machine = layout.machine
        tool = tool_of(machine, lengths.tool_mm)
        poses, pose = np.unique(lengths.position_mm, axis=0, return_inverse=True)
        bases = [layout.basis(axis, poses[:, axis]) for axis in range(3)]
        values = layout.values(state.errors, bases)[pose.ravel()]
        station = state.stations_mm[lengths.station]
        tip = tip_position(machine, values, lengths.position_mm, tool)
        moved, lengthened = self._effects_mm(lengths, station, tip)
        grown = tip_position(machine, values, lengths.position_mm + self.growth_mm, tool) + further_mm + moved - station
        change = np.linalg.norm(tip - station, axis=1) - np.linalg.norm(grown, axis=1)
        return np.asarray(change - lengthened + self.dead_share * state.dead_length_mm[group])

    def _effects_mm(self, lengths: Lengths, station: FloatArray, tip: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement of the tips (n, 3) and change of the lengths (n,) by the effects."""
        if not self.effects:
            return np.zeros_like(tip), np.zeros(len(tip))
        return moved_by(self.effects, readings_of_lengths(self.machine, lengths, station, tip))


def reading_conditions(machine: Machine, lengths: Lengths, *, temperature: bool = True) -> tuple[Lengths, Conditions]:
    """Return the readings with the right wavelength, and what else they have to be corrected for.

    Raises
    ------
    InputError
        for temperatures that some readings lack, or air that is not described.
    """
    growth, notes = (_growth(machine, lengths)) if temperature else (np.zeros(lengths.position_mm.shape), {})
    share = np.zeros(len(lengths))
    if _says_uncompensated(lengths):
        index, assumed = _refractive_indices(lengths)
        lengths = replace(lengths, length_mm=lengths.length_mm * assumed / index)
        share = float(index.mean()) / index - 1.0
        notes["wavelength"] = {"index_assumed": assumed, "index_mean": float(index.mean())}
    effects = effects_of_lengths(machine, lengths)
    if effects:
        notes["effects"] = notes_of(effects)
    return lengths, Conditions(machine, growth, share, notes, effects)


def _growth(machine: Machine, lengths: Lengths) -> tuple[FloatArray, dict[str, Any]]:
    growth = np.zeros(lengths.position_mm.shape)
    notes: dict[str, Any] = {}
    for k, (name, axis) in enumerate(zip(AXES, machine.axes, strict=True)):
        values = lengths.covariates.get(f"temp_{name.lower()}_c")
        if values is None:
            continue
        _check_complete(lengths, f"temp_{name.lower()}_c", values)
        spread = float(np.ptp(values))
        if axis.expansion_um_per_m_k is None:
            if spread > NOTABLE_K:
                warnings.warn(
                    f"the temperature of {name} varies by {spread:.1f} K, and the machine file has no "
                    f"[axes.{name}] expansion_um_per_m_k: the readings stay as they are",
                    CompgenWarning,
                    stacklevel=5,
                )
            continue
        from_reference = lengths.position_mm[:, k] - machine.reference_point_mm[k]
        growth[:, k] = 1e-6 * axis.expansion_um_per_m_k * (values - REFERENCE_C) * from_reference
        notes[name] = {
            "expansion_um_per_m_k": axis.expansion_um_per_m_k,
            "mean_c": float(values.mean()),
            "lowest_c": float(values.min()),
            "highest_c": float(values.max()),
            "largest_growth_um": 1e3 * float(np.abs(growth[:, k]).max()),
        }
    return growth, {"temperature": notes} if notes else {}


def _check_complete(lengths: Lengths, column: str, values: FloatArray) -> None:
    missing = np.flatnonzero(~np.isfinite(values))
    if missing.size:
        file, line = lengths.origin[int(missing[0])] if lengths.origin else (None, None)
        raise InputError(
            "is known for a part of the readings only; give it in every file, or leave it out of all",
            file=file,
            line=line,
            field=f"column {column}",
        )


def _says_uncompensated(lengths: Lengths) -> bool:
    text = lengths.metadata.get("wavelength_compensated", "true").lower()
    if text in ("true", "yes", "1"):
        return False
    if text in ("false", "no", "0"):
        return True
    file = lengths.origin[0][0] if lengths.origin else None
    raise InputError(f"the comment wavelength_compensated = {text!r} is neither true nor false", file=file)


def _refractive_indices(lengths: Lengths) -> tuple[FloatArray, float]:
    """Index of the air at each reading (n,), and the one that the instrument assumed."""
    temperature = lengths.covariates.get("temp_ambient_c")
    if temperature is None:
        file = lengths.origin[0][0] if lengths.origin else None
        message = "is missing; wavelength_compensated = false asks for the air temperature of each reading"
        raise InputError(message, file=file, field="column temp_ambient_c")
    _check_complete(lengths, "temp_ambient_c", temperature)
    pressure = _metadata_number(lengths, "pressure_hpa", STANDARD_PRESSURE_HPA, (500.0, 1200.0))
    humidity = _metadata_number(lengths, "humidity_percent", STANDARD_HUMIDITY_PERCENT, (0.0, 100.0))
    wavelength = _metadata_number(lengths, "wavelength_nm", HELIUM_NEON_NM, (350.0, 1700.0))
    standard = float(
        refractive_index(np.array(REFERENCE_C), STANDARD_PRESSURE_HPA, STANDARD_HUMIDITY_PERCENT, wavelength)
    )
    assumed = _metadata_number(lengths, "refractive_index_used", standard, (1.0, 1.001))
    return refractive_index(temperature, pressure, humidity, wavelength), assumed


def _metadata_number(lengths: Lengths, key: str, default: float, allowed: tuple[float, float]) -> float:
    text = lengths.metadata.get(key)
    if text is None:
        return default
    file = lengths.origin[0][0] if lengths.origin else None
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"the comment {key} = {text!r} is not a number", file=file) from None
    if not allowed[0] <= value <= allowed[1]:
        raise InputError(f"the comment {key} = {value:g} must lie within {allowed[0]:g} ... {allowed[1]:g}", file=file)
    return value
