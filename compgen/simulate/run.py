"""Run a scenario on a virtual machine: true errors -> tips -> readings -> files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.core.axis_runs import AxisRuns, format_axis_runs
from compgen.core.csvio import FloatArray
from compgen.core.diagonals import Diagonals, format_diagonals
from compgen.core.error_table import ErrorTable, format_errors
from compgen.core.files import OutputFolder
from compgen.core.lengths import Lengths, format_lengths
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.model.exact import tip_position
from compgen.simulate.effects import Effect, LengthEffect, RunEffect, Sights
from compgen.simulate.laser_tracer import LaserTracer, Station
from compgen.simulate.scenario import LineLaser, Scenario
from compgen.simulate.session import plan_session, with_temperatures
from compgen.simulate.sixdof_measurement import SimulatedSixDof
from compgen.simulate.trajectory import Stops, plan_stops
from compgen.simulate.truth import child_seeds, draw_truth, random_stream
from compgen.sixdof.readings import SixDof, format_sixdof

#: Children of the seed: one for the errors, one for the noise, one for the order of a session.
ERROR_STREAM, NOISE_STREAM, ORDER_STREAM = 0, 1, 2


@dataclass(frozen=True)
class Simulation:
    """The measurement of a virtual machine, and what is really true of it.

    Parameters
    ----------
    name : beginning of the file names.
    lengths : the readings, as a measurement file holds them.
    truth : the true errors in mm and rad; its metadata name machine and seed.
    stations : the true stations (none for an instrument without).
    """

    name: str
    lengths: Lengths
    truth: ErrorTable
    stations: tuple[Station, ...]


@dataclass(frozen=True)
class AxisSimulation:
    """Runs of a virtual machine along axes or diagonals, and its true errors in mm and rad; ``name`` begins the file names."""

    name: str
    readings: AxisRuns | Diagonals
    truth: ErrorTable


@dataclass(frozen=True)
class SixDofSimulation:
    """The six-DOF readings of a virtual machine, and its true errors in mm and rad; ``name`` begins the file names."""

    name: str
    readings: SixDof
    truth: ErrorTable


def actual_tips(machine: Machine, truth: ErrorTable, stops: Stops, effects: Sequence[Effect] = ()) -> FloatArray:
    """Where the tool tip really is in the workpiece frame: exact chain plus ``effects``, shape (n, 3), mm."""
    tip_mm = tip_position(machine, truth.at(stops.position_mm), stops.position_mm, stops.tool_mm)
    for effect in effects:
        tip_mm = tip_mm + _displacement(effect, machine, stops)
    return tip_mm


def _displacement(effect: Effect, machine: Machine, stops: Stops) -> FloatArray:
    """What an effect adds; InputError if it is not one finite vector per stop, as code of others may have it."""
    moved_mm = np.asarray(effect(machine, stops))
    if (
        moved_mm.shape != stops.position_mm.shape
        or moved_mm.dtype.kind not in "fi"
        or not np.all(np.isfinite(moved_mm))
    ):
        name = getattr(effect, "__qualname__", type(effect).__qualname__)
        due = f"an array {stops.position_mm.shape} of finite numbers in mm"
        raise InputError(f"the effect {name} returns {moved_mm.dtype} {moved_mm.shape}; {due} is expected")
    return moved_mm.astype(np.float64)


def simulate(
    machine: Machine, scenario: Scenario, seed: int | None = None, effects: Sequence[Effect] = ()
) -> Simulation:
    """Measure a virtual machine.

    Parameters
    ----------
    machine : chain, travel, nodes and modelled errors count.
    scenario : true errors, instrument and trajectory.
    seed : takes the place of the scenario's. Errors and noise have random streams of their own, so that changing
        the one leaves the other.
    effects : what acts besides the geometric errors and the effects of the scenario.

    Raises
    ------
    InputError
        if the trajectory leaves the machine's travel.
    """
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    instrument = scenario.instrument
    if isinstance(instrument, SimulatedSixDof):
        raise InputError("is a six-DOF instrument, which has no lengths; call simulate_sixdof", file=scenario.source)
    if isinstance(instrument, LineLaser):
        raise InputError("runs along lines and has no lengths; call simulate_axis_runs", file=scenario.source)
    for effect in scenario.effects:
        if isinstance(effect, RunEffect):
            message = f"{effect.name} acts on axis runs only; their instrument has type = 'axis-laser'"
            raise InputError(message, file=scenario.source, field="[[effects]]")
    try:
        stops = with_temperatures(_stops(machine, scenario, seeds, instrument.passes), scenario.temperatures)
    except InputError as error:
        raise InputError(error.message, file=scenario.source, field=error.field) from None
    tools_mm = np.array(scenario.trajectory.tools_mm) if scenario.trajectory.tools_mm else None
    truth = draw_truth(scenario.errors, machine, child_seeds(seeds, ERROR_STREAM), tools_mm)
    truth.warn_outside(stops.position_mm)
    of_tips = [effect for effect in scenario.effects if not isinstance(effect, LengthEffect | RunEffect)]
    tip_mm = actual_tips(machine, truth, stops, (*of_tips, *effects))
    lengths = instrument.observe(stops, tip_mm, random_stream(seeds, NOISE_STREAM))
    of_lengths = [effect for effect in scenario.effects if isinstance(effect, LengthEffect)]
    if of_lengths:
        lengths = _changed(lengths, instrument, stops, tip_mm, of_lengths)
    common = _common(machine, used_seed)
    return Simulation(
        name=scenario.name,
        lengths=replace(lengths, metadata={**common, **lengths.metadata}),
        truth=_described(machine, truth, used_seed),
        stations=getattr(instrument, "stations", ()),
    )


def _stops(machine: Machine, scenario: Scenario, seeds: np.random.SeedSequence, passes: int) -> Stops:
    if scenario.session is None:
        return plan_stops(scenario.trajectory, machine, passes)
    order = random_stream(seeds, ORDER_STREAM)
    return plan_session(scenario.session, scenario.trajectory, machine, passes, order)


def _changed(
    lengths: Lengths, instrument: object, stops: Stops, tip_mm: FloatArray, effects: Sequence[LengthEffect]
) -> Lengths:
    """Add what effects of tracers and air do to the lengths."""
    if not isinstance(instrument, LaserTracer):
        raise InputError(
            f"{effects[0].name} acts on the lengths of a laser-tracer; this instrument has none of its kind"
        )
    stop, station = instrument.rows(len(stops))
    places = np.array([item.position_mm for item in instrument.stations])
    names = tuple(item.name for item in instrument.stations)
    sights = Sights(stops, stop, names, station, places[station], tip_mm[stop])
    change = np.sum([effect.change(sights) for effect in effects], axis=0)
    return replace(lengths, length_mm=lengths.length_mm + change)


def simulate_sixdof(machine: Machine, scenario: Scenario, seed: int | None = None) -> SixDofSimulation:
    """Measure a virtual machine with the six-DOF instrument of the scenario; InputError for another instrument."""
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    if not isinstance(scenario.instrument, SimulatedSixDof):
        raise InputError("is no six-DOF instrument; call simulate", file=scenario.source, field="[instrument] type")
    truth = draw_truth(scenario.errors, machine, child_seeds(seeds, ERROR_STREAM), None)
    readings = scenario.instrument.measure(machine, truth, random_stream(seeds, NOISE_STREAM))
    metadata = {**_common(machine, used_seed), **readings.metadata}
    return SixDofSimulation(scenario.name, replace(readings, metadata=metadata), _described(machine, truth, used_seed))


def simulate_axis_runs(machine: Machine, scenario: Scenario, seed: int | None = None) -> AxisSimulation:
    """Measure a virtual machine with the scenario's laser along axes or diagonals; InputError for another instrument."""
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    if not isinstance(scenario.instrument, LineLaser):
        raise InputError(
            "is no laser along axes or diagonals; call simulate", file=scenario.source, field="[instrument] type"
        )
    truth = draw_truth(scenario.errors, machine, child_seeds(seeds, ERROR_STREAM), None)
    moving = [effect for effect in scenario.effects if not isinstance(effect, LengthEffect | RunEffect)]
    readings = scenario.instrument.measure(
        machine,
        lambda stops: actual_tips(machine, truth, stops, moving),
        scenario.effects,
        scenario.temperatures,
        random_stream(seeds, NOISE_STREAM),
    )
    metadata = {**_common(machine, used_seed), **readings.metadata}
    return AxisSimulation(scenario.name, replace(readings, metadata=metadata), _described(machine, truth, used_seed))


def _common(machine: Machine, seed: int) -> dict[str, str]:
    return {"machine": machine.name, "seed": str(seed)}


def _described(machine: Machine, truth: ErrorTable, seed: int) -> ErrorTable:
    reference = " ".join(f"{value:g}" for value in machine.reference_point_mm)
    common = _common(machine, seed)
    return truth.replace(metadata={**common, "source": "simulated truth", "reference_point_mm": reference})


def write_simulation(simulation: Simulation | SixDofSimulation | AxisSimulation, folder: str | Path) -> dict[str, Path]:
    """Write the readings, e.g. ``<name>.lengths.csv``, and ``truth.errors.csv``; return paths by file name."""
    output = OutputFolder(folder)
    if isinstance(simulation, AxisSimulation) and isinstance(simulation.readings, Diagonals):
        output.add(f"{simulation.name}.diagonals.csv", format_diagonals(simulation.readings))
    elif isinstance(simulation, AxisSimulation) and isinstance(simulation.readings, AxisRuns):
        output.add(f"{simulation.name}.axis.csv", format_axis_runs(simulation.readings))
    elif isinstance(simulation, SixDofSimulation):
        output.add(f"{simulation.name}.sixdof.csv", format_sixdof(simulation.readings))
    elif isinstance(simulation, Simulation):
        output.add(f"{simulation.name}.lengths.csv", format_lengths(simulation.lengths))
    output.add("truth.errors.csv", format_errors(simulation.truth))
    return output.commit()
