"""Identification at reference conditions: readings corrected for temperature, air and the effects of the machine file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen import effects as catalogue
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.errors import CompgenWarning, InputError, Message
from compgen.identification.adjust.propagation import Adjustment
from compgen.identification.adjust.residual_tests import (
    ResidualSeries,
    Whiteness,
    check_whiteness,
    residual_series,
    warn_of_misfit,
    warn_of_weakness,
)
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, State
from compgen.identification.options import number_in_comment
from compgen.identification.result import Identification, judged
from compgen.identification.reversal_errors import ReversalStops, approach_signs, estimate_reversal, stop_cells
from compgen.instruments.interferometer import (
    HELIUM_NEON_NM,
    REFERENCE_C,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_HPA,
    refractive_index,
)
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import tool_of

if TYPE_CHECKING:
    from compgen.data.deviations import Deviations

# Effects in the machine file, removed from the readings before errors are identified.


#: Assumed place of a station while only the columns of the file are checked, mm.
FAR_MM = (0.0, 0.0, 1e5)


def effects_of_lengths(machine: Machine, lengths: Lengths) -> tuple[catalogue.ActiveEffect, ...]:
    """Return the effects of the machine file that act on these lengths; warn of missing columns."""
    if not machine.effects:
        return ()
    effects = catalogue.active_effects(machine)
    tip_mm = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    return _usable(effects, catalogue.readings_of_lengths(machine, lengths, tip_mm - np.array(FAR_MM), tip_mm))


def _usable(
    effects: Sequence[catalogue.ActiveEffect], readings: catalogue.Readings
) -> tuple[catalogue.ActiveEffect, ...]:
    usable = []
    for active in effects:
        card = active.effect.card
        if readings.kind not in card.kinds:
            continue
        if active.change_mm(readings) is not None:
            usable.append(_settled(active, readings))
        else:
            message = (
                f"{active.name} of the machine file is not applied: the readings lack {', '.join(card.covariates)}"
            )
            warnings.warn(message, CompgenWarning, stacklevel=6)
    return tuple(usable)


def _settled(active: catalogue.ActiveEffect, readings: catalogue.Readings) -> catalogue.ActiveEffect:
    """Return the effect with its settings resolved for these readings, so that they mean the same for a part of them."""
    return replace(active, effect=active.effect.with_settings(active.effect.used(readings)))


def moved_by(effects: Sequence[catalogue.ActiveEffect], readings: catalogue.Readings) -> tuple[FloatArray, FloatArray]:
    """Return the displacement of the tip by effects (n, 3), and the change of the readings by the others (n,), mm."""
    moved, _ = catalogue.displacement_of(effects, readings)
    lengthened = np.zeros(len(readings))
    for active in effects:
        if not isinstance(active.effect, catalogue.DisplacementEffect):
            change = active.change_mm(readings)
            lengthened += 0.0 if change is None else change
    return moved, lengthened


def notes_of(effects: Sequence[catalogue.ActiveEffect]) -> dict[str, Any]:
    """Return the object ``effects`` of ``identify.json``: parameters and settings by the name of the effect."""
    return {active.name: active.summary() for active in effects}


def without_effects(machine: Machine, deviations: Deviations) -> tuple[Deviations, dict[str, Any]]:
    """Return deviations without the effects of the machine file, and what was removed."""
    if not machine.effects:
        return deviations, {}
    readings = catalogue.readings_of_deviations(machine, deviations)
    effects = _usable(catalogue.active_effects(machine), readings)
    moved, lengthened = moved_by(effects, readings)
    moved_mm = np.zeros((3, len(deviations)))  # readings are all dX, then all dY, then all dZ
    moved_mm[~np.isnan(deviations.deviation_mm.T)] = np.sum(readings.direction * moved, axis=1) + lengthened
    return replace(deviations, deviation_mm=deviations.deviation_mm - moved_mm.T), notes_of(effects)


# Readings at reference conditions: machine scales at 20 degC, the actual wavelength in air.
#
# * **Scales.** At the temperature T of an axis its scale has expanded about the reference point: at the command q
#   the carriage is at q + alpha (T - 20 degC)(q - q_ref), along the actual direction of the axis. The effect of this on
#   a length, by the exact model, is removed from the reading. The identified errors are then those of the machine with
#   all scales at 20 degC. Unless the machine file lists effects, nothing else is corrected: neither bending, nor
#   expansion of bed, spindle or workpiece.
# * **Effects** of the machine file (``[effects.NAME]``): their change of a length is removed.
# * **Wavelength**, only if the file says ``# wavelength_compensated = false``: the refractive index of the air by the
#   modified Edlen equation (Birch & Downs, Metrologia 30 (1993) 155 and 31 (1994) 315). A reading N is the true change of
#   n times the distance D since the tracer was zeroed, over the index that the instrument assumed:
#
#       n(t) D(t) - n(0) D(0) = n_assumed N
#
#   so D = n_assumed N / n + dead length * (mean n) / n.


#: Temperatures that vary by more than this require an expansion coefficient.
NOTABLE_K = 0.5


@dataclass(frozen=True)
class Conditions:
    """Corrections of n readings.

    Parameters
    ----------
    machine : the machine.
    growth_mm : expansion of the scales at the command of each axis, (n, 3).
    dead_share : share of the dead length by which a reading is too short, (n,).
    notes : what was corrected, for ``identify.json``.
    effects : effects of the machine file that the readings show.
    """

    machine: Machine
    growth_mm: FloatArray
    dead_share: FloatArray
    notes: Mapping[str, Any]
    effects: tuple[catalogue.ActiveEffect, ...] = ()

    @property
    def needs_geometry(self) -> bool:
        """Whether the correction depends on stations and dead lengths."""
        return bool(np.any(self.growth_mm) or np.any(self.dead_share) or self.effects)

    def correction_mm(
        self, lengths: Lengths, layout: ErrorParameters, state: State, group: IntArray, other_mm: FloatArray
    ) -> FloatArray:
        """Return what must be added to the readings (n,), mm, for stations, dead lengths and errors ``state``.

        ``other_mm`` (n, 3) is another displacement of the tip to remove.
        """
        machine = layout.machine
        tool = tool_of(machine, lengths.tool_mm)
        poses, pose = np.unique(lengths.position_mm, axis=0, return_inverse=True)
        bases = [layout.basis(axis, poses[:, axis]) for axis in range(3)]
        values = layout.values(state.errors, bases)[pose.ravel()]
        station = state.stations_mm[lengths.station]
        tip = tip_position(machine, values, lengths.position_mm, tool)
        moved, lengthened = self._effects_mm(lengths, station, tip)
        grown = tip_position(machine, values, lengths.position_mm + self.growth_mm, tool) + other_mm + moved - station
        change = np.linalg.norm(tip - station, axis=1) - np.linalg.norm(grown, axis=1)
        return np.asarray(change - lengthened + self.dead_share * state.dead_length_mm[group])

    def _effects_mm(self, lengths: Lengths, station: FloatArray, tip: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement of the tips (n, 3) and change of the lengths (n,) by the effects."""
        if not self.effects:
            return np.zeros_like(tip), np.zeros(len(tip))
        return moved_by(self.effects, catalogue.readings_of_lengths(self.machine, lengths, station, tip))


def reading_conditions(machine: Machine, lengths: Lengths, *, temperature: bool = True) -> tuple[Lengths, Conditions]:
    """Return the readings with the right wavelength, and their other corrections.

    Raises
    ------
    InputError
        for missing temperatures of some readings, or missing air data.
    """
    growth, notes = (_growth(machine, lengths)) if temperature else (np.zeros(lengths.position_mm.shape), {})
    share = np.zeros(len(lengths))
    text = lengths.metadata.get("wavelength_compensated", "true").lower()
    if text not in ("true", "yes", "1", "false", "no", "0"):
        file = lengths.origin[0][0] if lengths.origin else None
        raise InputError(
            Message(
                "comment-not-boolean",
                "the comment wavelength_compensated = {text!r} is neither true nor false",
                text=text,
            ),
            file=file,
        )
    if text in ("false", "no", "0"):
        # index of the air at each reading (n,), and the one assumed by the instrument
        temperature_c = lengths.covariates.get("temp_ambient_c")
        if temperature_c is None:
            file = lengths.origin[0][0] if lengths.origin else None
            message = "is missing; wavelength_compensated = false requires the air temperature of each reading"
            raise InputError(message, file=file, field="column temp_ambient_c")
        _check_complete(lengths, "temp_ambient_c", temperature_c)
        pressure = _metadata_number(lengths, "pressure_hpa", STANDARD_PRESSURE_HPA, (500.0, 1200.0))
        humidity = _metadata_number(lengths, "humidity_percent", STANDARD_HUMIDITY_PERCENT, (0.0, 100.0))
        wavelength = _metadata_number(lengths, "wavelength_nm", HELIUM_NEON_NM, (350.0, 1700.0))
        standard = float(
            refractive_index(np.array(REFERENCE_C), STANDARD_PRESSURE_HPA, STANDARD_HUMIDITY_PERCENT, wavelength)
        )
        assumed = _metadata_number(lengths, "refractive_index_used", standard, (1.0, 1.001))
        index = refractive_index(temperature_c, pressure, humidity, wavelength)
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
                    Message(
                        "temperature-not-corrected",
                        "the temperature of {name} varies by {spread:.1f} K, and the machine file has no "
                        "[axes.{name2}] expansion_um_per_m_k: the readings are not corrected",
                        name=name,
                        spread=spread,
                        name2=name,
                    ),
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
            Message("known-for-some", "is known for only some of the readings; give it in every file or in none"),
            file=file,
            line=line,
            field=f"column {column}",
        )


def _metadata_number(lengths: Lengths, key: str, default: float, allowed: tuple[float, float]) -> float:
    value = number_in_comment(lengths, key)
    if value is None:
        return default
    if not allowed[0] <= value <= allowed[1]:
        file = lengths.origin[0][0] if lengths.origin else None
        raise InputError(
            Message(
                "comment-out-of-range",
                "the comment {key} = {value:g} must be within {allowed:g} ... {allowed2:g}",
                key=key,
                value=value,
                allowed=allowed[0],
                allowed2=allowed[1],
            ),
            file=file,
        )
    return value


# Identification at reference conditions: scales at 20 degC, the right wavelength, the mean of both directions.
#
# The corrections of the readings depend slightly on stations and errors, so these are identified once or twice again
# with better corrected readings.


ROUNDS = 3
#: Corrections that change by less than this have converged, mm.
SETTLED_MM = 1e-8


def identify_at_reference(
    machine: Machine,
    lengths: Lengths,
    adjust: Callable[[Lengths], Identification],
    rough: Callable[[Lengths], tuple[ErrorParameters, State, IntArray]],
    *,
    temperature: bool = True,
) -> Identification:
    """Identify from readings at reference conditions, and test the residuals.

    Parameters
    ----------
    machine, lengths : as in :func:`compgen.identification.tracer_lengths`.
    adjust : identifies from readings without correction.
    rough : start values for stations and dead lengths.
    temperature : whether the scales are corrected to 20 degC.
    """
    lengths, conditions = reading_conditions(machine, lengths, temperature=temperature)
    still = np.zeros_like(lengths.position_mm)
    used = lengths
    if conditions.needs_geometry:
        used = _added(lengths, conditions.correction_mm(lengths, *rough(lengths), still))
    found = adjust(used)
    approach = approach_signs(lengths)
    reversal, removed, taken_mm = None, False, still[:, 0]
    for _ in range(ROUNDS if approach is not None or conditions.needs_geometry else 0):
        assert found.adjustment is not None
        geometry = (found.layout, found.adjustment.state, found.adjustment.group)
        plain = conditions.correction_mm(lengths, *geometry, still) if conditions.needs_geometry else still[:, 0]
        expected = used.length_mm + found.residual_mm
        moved = still
        if approach is not None:
            stops = _stops(machine, lengths, lengths.length_mm + plain - expected, found.adjustment)
            reversal = estimate_reversal(lengths, approach, stops)
            if reversal is not None and reversal.significant:
                moved = reversal.displacement(reversal.resolved(approach, lengths.station, stops))
                removed = True
        if not conditions.needs_geometry and not removed:
            break
        again = _added(lengths, conditions.correction_mm(lengths, *geometry, moved))
        settled = np.abs(again.length_mm - used.length_mm).max() < SETTLED_MM
        used, taken_mm = again, again.length_mm - lengths.length_mm - plain
        if settled:
            break
        found = adjust(used)
    if reversal is not None:
        reversal = replace(reversal, removed=removed)
    found = replace(found, reversal=reversal, corrections=conditions.notes)
    return _tested(machine, used, found, taken_mm if removed else None)


def _added(lengths: Lengths, correction_mm: FloatArray) -> Lengths:
    return replace(lengths, length_mm=lengths.length_mm + correction_mm)


def _sight(machine: Machine, lengths: Lengths, stations_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors from station to nominal target (n, 3), and distances (n,)."""
    vector = lengths.position_mm + tool_of(machine, lengths.tool_mm) - stations_mm[lengths.station]
    distance = np.sqrt(np.einsum("ij,ij->i", vector, vector))
    return vector / distance[:, None], distance


def _stops(machine: Machine, lengths: Lengths, difference_mm: FloatArray, adjustment: Adjustment) -> ReversalStops:
    sight, _ = _sight(machine, lengths, adjustment.state.stations_mm)
    return ReversalStops(stop_cells(lengths, adjustment.group), difference_mm, sight, adjustment.weight)


def _tested(machine: Machine, used: Lengths, found: Identification, reversal_mm: FloatArray | None) -> Identification:
    """Add the verdict about the size of the residuals, and their tests, which are made when somebody looks at them.

    ``reversal_mm`` (n,) is what was added to each reading for a reversal.
    """
    adjustment = found.adjustment
    assert adjustment is not None
    if adjustment.known_weight is None:  # known stations contribute their uncertainty
        typical = adjustment.sigma_mm / float(np.sqrt(max(adjustment.weight.mean(), 1e-12)))
        warn_of_weakness(machine, found.errors, found.worst_u, typical)
    warn_of_misfit(found.reduced_chi_square, found.u_source)

    def sigma_mm() -> FloatArray:
        weight = np.where(found.accepted, adjustment.weight, 1.0)
        return np.asarray(adjustment.sigma_mm / found.u_scale / np.sqrt(weight))

    def tests() -> Whiteness:
        standardised = np.where(found.accepted, found.residual_mm / sigma_mm(), np.nan)
        _, distance = _sight(machine, used, adjustment.state.stations_mm)
        return check_whiteness(used, adjustment.group, standardised, distance, found.unknowns)

    def series() -> ResidualSeries:
        rows = found.accepted
        residual_mm = found.residual_mm[rows]
        bare_mm = None if reversal_mm is None else residual_mm + reversal_mm[rows]
        return residual_series(used, rows, residual_mm, sigma_mm()[rows], adjustment.group[rows], bare_mm)

    return judged(replace(found, residual_tests=tests), series)
