"""What calibration leaves uncertain, as changes of readings and instrument by standard uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from compgen.core.names import AXES
from compgen.sixdof.instrument import Instrument, known_systematics
from compgen.sixdof.readings import SixDof

#: Parameters of the beams, one for all axes; the others belong to the prism or the target of one axis.
SHARED = ("eps_PEy", "eps_PEz")
#: Constants of :class:`Optics` that a budget can hold.
OPTICS = (
    "focal_length_mm",
    "beam_separation_mm",
    "glass_index",
    "cube_side_mm",
    "plate_thickness_mm",
    "prism_leg_mm",
    "exit_to_prism_mm",
)

Change = Callable[[float], tuple[SixDof, Instrument]]


def calibration_changes(readings: SixDof, instrument: Instrument) -> Iterator[tuple[str, Change]]:
    """Everything that calibration leaves uncertain, as changes by a number of standard uncertainties."""
    for name in OPTICS:
        u = instrument.u_constants.get(name, 0.0)
        if u > 0:
            yield name, _optics_change(readings, instrument, name, u)
    for axis in instrument.axes:
        u = instrument.u_constants.get("distance_first_mm", 0.0)
        if u > 0:
            yield f"distance of {AXES[axis]}", _distance_change(readings, instrument, axis, u)
        for name, u_parallel in (("y", "parallel_drift_um"), ("z", "parallel_drift_um")):
            drift = instrument.u_constants.get(u_parallel, 0.0) * 1e-3
            if drift > 0:
                yield "parallel drift", _ramp_change(readings, instrument, axis, name, drift)
    gain = instrument.u_constants.get("drift_gain_percent", 0.0) / 100.0
    if gain > 0:
        yield "drift gain", _scaled_change(readings, instrument, ("y_psd2_mm", "z_psd2_mm"), gain)
    scale = instrument.u_constants.get("displacement_ppm", 0.0) * 1e-6
    if scale > 0:
        yield "wavelength", _scaled_change(readings, instrument, ("displacement_mm",), scale)
    yield from _systematic_changes(readings, instrument)


def _systematic_changes(readings: SixDof, instrument: Instrument) -> Iterator[tuple[str, Change]]:
    for name, u in instrument.u_systematics.items():
        having = [axis for axis in instrument.axes if name in known_systematics(axis)]
        for axes in [having] if name in SHARED else [[axis] for axis in having]:
            where = "" if name in SHARED or len(having) == 1 else f" of {AXES[axes[0]]}"
            if u > 0 and axes:
                yield name + where, _systematic_change(readings, instrument, axes, name, u)


def _optics_change(readings: SixDof, instrument: Instrument, name: str, u: float) -> Change:
    def change(times: float) -> tuple[SixDof, Instrument]:
        values = {name: getattr(instrument.optics, name) + times * u}
        return readings, replace(instrument, optics=replace(instrument.optics, **values))

    return change


def _distance_change(readings: SixDof, instrument: Instrument, axis: int, u: float) -> Change:
    def change(times: float) -> tuple[SixDof, Instrument]:
        distance = readings.distance_mm + np.where(readings.axis == axis, times * u, 0.0)
        entry = instrument.axes[axis]
        first = None if entry.distance_first_mm is None else entry.distance_first_mm + times * u
        axes = {**instrument.axes, axis: replace(entry, distance_first_mm=first)}
        return replace(readings, distance_mm=distance), replace(instrument, axes=axes)

    return change


def _systematic_change(readings: SixDof, instrument: Instrument, on: Sequence[int], name: str, u: float) -> Change:
    def change(times: float) -> tuple[SixDof, Instrument]:
        axes = dict(instrument.axes)
        for axis in on:
            values = dict(axes[axis].systematics)
            values[name] = values.get(name, 0.0) + times * u
            axes[axis] = replace(axes[axis], systematics=values)
        return readings, replace(instrument, axes=axes)

    return change


def _scaled_change(readings: SixDof, instrument: Instrument, names: Sequence[str], u: float) -> Change:
    def change(times: float) -> tuple[SixDof, Instrument]:
        signals = {**readings.signals_mm, **{name: readings.signals_mm[name] * (1 + times * u) for name in names}}
        return replace(readings, signals_mm=signals), instrument

    return change


def _ramp_change(readings: SixDof, instrument: Instrument, axis: int, letter: str, drift_mm: float) -> Change:
    """Both beams move parallel to themselves by so much from the first to the last row of each run of the axis."""
    ramp = np.zeros(len(readings))
    for which, _, rows in readings.runs():
        if which == axis:
            ramp[rows] = np.linspace(0.0, drift_mm, len(rows))

    def change(times: float) -> tuple[SixDof, Instrument]:
        names = [name for name in (f"{letter}_qd1_mm", f"{letter}_qd2_mm") if name in readings.signals_mm]
        signals = {**readings.signals_mm, **{name: readings.signals_mm[name] - times * ramp for name in names}}
        return replace(readings, signals_mm=signals), instrument

    return change
