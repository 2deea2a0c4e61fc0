"""From a scenario to measurement files on a virtual machine.

:func:`read_scenario` reads what is measured and how; :func:`simulate`, :func:`simulate_axis_runs` and
:func:`simulate_sixdof` draw the true errors, move the tool tip by the exact chain and the effects, and let the instrument
read it; :func:`write_simulation` writes the readings and the truth.
"""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from compgen.data import toml_files
from compgen.data.arguments import of_kind, path_of
from compgen.data.axis_runs import AxisRuns, Diagonals, format_axis_runs, format_diagonals
from compgen.data.circles import Circles, format_circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, format_artefact
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.files import OutputFolder
from compgen.data.length_archive import write_archive
from compgen.data.lengths import Lengths, format_lengths
from compgen.data.machine import Machine
from compgen.data.names import SECONDS_PER_MIN
from compgen.data.pose_readings import Bars, format_bars
from compgen.data.records import ARCHIVE
from compgen.data.rotary import RotaryErrors, SphereCentres, format_machine_errors, format_spheres
from compgen.data.toml_files import part_setting, setting
from compgen.drawing.display import Displayed, Overview
from compgen.errors import InputError, Message
from compgen.instruments.sixdof_instrument import SixDof, format_sixdof
from compgen.kinematics.exact_chain import tip_position
from compgen.registry import Registry, call_problem
from compgen.simulation.bars import RotaryBallbar, read_rotary_ballbar
from compgen.simulation.effects import (
    Displacement,
    LengthEffect,
    RunEffect,
    Sights,
    SimulatedEffect,
    effects_schema,
    read_effects,
)
from compgen.simulation.gauges import Ballbar, TouchProbe, read_ballbar, read_touch_probe
from compgen.simulation.lasers import (
    AxisLaser,
    DiagonalLaser,
    LaserTracer,
    Station,
    read_axis_laser,
    read_diagonal_laser,
    read_laser_tracer,
)
from compgen.simulation.sixdof import SimulatedSixDof, read_sixdof_measurement
from compgen.simulation.spheres import SphereProbe, read_sphere_probe
from compgen.simulation.trajectory import (
    Session,
    Stops,
    Temperature,
    Trajectory,
    check_stops,
    passes_of,
    plan_session,
    plan_stops,
    read_session,
    read_temperatures,
    read_trajectory,
    with_temperatures,
)
from compgen.simulation.truth import (
    RandomErrors,
    TruthPlan,
    child_seeds,
    draw_truth,
    random_stream,
    read_truth_plan,
    truth_schema,
)

# Requirements on an effect or an instrument of a plug-in; checked when it is registered.


#: How the methods of an instrument are called.
OBSERVE = ("stops", "tip_mm", "rng")


def check_effect(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A reader: takes the section ``[[effects]]`` of a scenario and returns a function of machine and stops."""
    return thing, call_problem(thing, ["section"], f"its reader {_name_of(thing)}")


def check_instrument(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A reader: takes the section ``[instrument]`` of a scenario and returns an object with passes and observe.

    A class in the return annotation of the reader is checked here, the object itself when a scenario is read.
    """
    problems = call_problem(thing, ["section"], f"its reader {_name_of(thing)}")
    if not problems:
        try:
            made = typing.get_type_hints(thing).get("return")
        except (TypeError, NameError, AttributeError):
            made = None
        if inspect.isclass(made) and made is not object:
            problems += instrument_problems(made)
    return thing, problems


def instrument_problems(thing: Any) -> list[str]:
    """Return what an instrument, or its class, lacks."""
    is_class = inspect.isclass(thing)
    name = thing.__name__ if is_class else type(thing).__name__
    known = {*dir(thing), *(getattr(thing, "__annotations__", {}) if is_class else ())}
    problems = [] if "passes" in known else [f"{name} has no passes (how often the machine runs its trajectory)"]
    observe = getattr(thing, "observe", None)
    if is_class and inspect.isfunction(observe):
        observe = observe.__get__(object())
    return problems + call_problem(observe, OBSERVE, f"{name}.observe")


def _name_of(thing: Any) -> str:
    return getattr(thing, "__name__", type(thing).__name__)


# Scenario files: true errors, instrument and trajectory of a simulated measurement.


class Instrument(Protocol):
    """What every simulated instrument has; ``stations``, if any, have their true positions."""

    @property
    def passes(self) -> int:
        """How often the machine runs its trajectory."""

    def observe(self, stops: Stops, tip_mm: FloatArray, rng: np.random.Generator) -> Lengths:
        """Return the readings at stops whose true tips are ``tip_mm`` (n, 3) in the workpiece frame."""


#: Instruments that bring the path of the machine with them, and need no trajectory.
OwnPath = AxisLaser | DiagonalLaser | Ballbar | TouchProbe | SphereProbe | RotaryBallbar
AnyInstrument = Instrument | SimulatedSixDof | OwnPath
#: Reader of the ``[instrument]`` section by its ``type``; plug-ins add to it.
INSTRUMENTS: Registry[Callable[[toml_files.Section], AnyInstrument]] = Registry(
    {
        "laser-tracer": read_laser_tracer,
        "sixdof": read_sixdof_measurement,
        "axis-laser": read_axis_laser,
        "diagonal-laser": read_diagonal_laser,
        "ballbar": read_ballbar,
        "touch-probe": read_touch_probe,
        "sphere-probe": read_sphere_probe,
        "rotary-ballbar": read_rotary_ballbar,
    }
)


@toml_files.accepts({"type": "string", "pattern": r"^[A-Za-z0-9][A-Za-z0-9._-]{0,80}$"})
def _file_name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}", value):
        raise ValueError("expected a file name of letters, digits, '.', '_' and '-' without an ending")
    return value


def instruments_schema() -> dict[str, Any]:
    """Return the JSON schema of ``[instrument]``, by its ``type``; the class that a reader says it returns declares the keys."""
    found = []
    for name, reader in INSTRUMENTS.items():
        made, kind = typing.get_type_hints(reader).get("return"), {"const": name, "required": True}
        if (
            isinstance(made, type)
            and is_dataclass(made)
            and any({"check", "part"} & set(item.metadata) for item in fields(made))
        ):
            found.append(toml_files.section_schema(made, type=kind))
        else:  # a plug-in that reads key by key
            found.append({"type": "object", "required": ["type"], "properties": {"type": {"const": name}}})
    return {"oneOf": found}


@dataclass(frozen=True, repr=False)
class Scenario(Displayed):
    """A simulated measurement; ``name`` begins the names of its files, ``seed`` starts every random number."""

    instrument: AnyInstrument = part_setting(
        lambda: instruments_schema(), required=True, meaning="the measuring instrument"
    )
    seed: int = setting(toml_files.whole(0), meaning="seed of all random numbers")
    name: str = setting(_file_name, "simulated", meaning="prefix of the file names")
    errors: TruthPlan = part_setting(
        truth_schema, factory=lambda: TruthPlan(random=RandomErrors()), meaning="the true errors of the machine"
    )
    trajectory: Trajectory = part_setting(
        lambda: toml_files.section_schema(Trajectory), factory=Trajectory, meaning="the commanded points"
    )
    source: Path | None = None
    effects: tuple[SimulatedEffect, ...] = part_setting(
        effects_schema, (), meaning="effects in addition to the geometric errors"
    )
    session: Session | None = part_setting(
        lambda: toml_files.section_schema(Session), None, meaning="number and conditions of the runs"
    )
    temperatures: Mapping[str, Temperature] = part_setting(
        lambda: {"type": "object", "additionalProperties": toml_files.section_schema(Temperature)},
        factory=dict,
        meaning="temperatures by channel; the column is temp_NAME_c",
    )

    def overview(self) -> Overview:
        """Name, seed, instrument, and the number of effects."""
        effects = f", {len(self.effects)} effects" if self.effects else ""
        return Overview(f"{self.name}, seed {self.seed}, {type(self.instrument).__name__}{effects}")


def read_scenario(path: str | Path) -> Scenario:
    """Read a scenario TOML strictly, and its error file if it has one.

    Raises
    ------
    InputError
        with file, line and key for anything that is missing, unknown or impossible.

    Examples
    --------
    >>> import compgen
    >>> scenario = compgen.read_scenario("examples/zha-gantry.scenario.toml")
    >>> scenario.name, scenario.seed
    ('zha-gantry', 190)
    """
    return scenario_of(toml_files.read_toml(path), Path(path))


def scenario_of(root: toml_files.Section, source: Path) -> Scenario:
    """Read the root of a scenario TOML as :func:`read_scenario` does."""
    stated = toml_files.stated_settings(Scenario, root)
    errors = read_truth_plan(root.section("errors", required=False), source.parent)
    instrument = root.section("instrument")
    kind = instrument.take("type", toml_files.choice(*INSTRUMENTS))
    scenario = Scenario(
        instrument=INSTRUMENTS[kind](instrument),
        **stated,
        errors=errors,
        trajectory=read_trajectory(root.section("trajectory", required=False)),
        source=source,
        effects=read_effects(root.sections("effects")),
        session=read_session(root.section("session")) if "session" in root else None,
        temperatures=read_temperatures(root.section("temperatures", required=False)),
    )
    if not isinstance(scenario.instrument, SimulatedSixDof | OwnPath):
        problems = instrument_problems(scenario.instrument)
        if problems:
            raise instrument.fail("type", "; ".join(problems))
    root.finish()
    others: tuple[str, ...] = ()
    if isinstance(scenario.instrument, SimulatedSixDof):
        others, text = ("trajectory", "effects", "session", "temperatures"), "a six-DOF instrument runs along the axes"
    elif isinstance(scenario.instrument, AxisLaser | DiagonalLaser):
        others, text = ("trajectory", "session"), "a laser along axes or diagonals runs in both directions along each"
    elif isinstance(scenario.instrument, OwnPath):
        others, text = ("trajectory", "session"), "a ballbar or touch probe states in [instrument] where it measures"
    for key in others:
        if key in root.data:
            raise root.fail(key, f"applies to other instruments; {text}")
    return scenario


# Run a scenario on a virtual machine: true errors -> tips -> readings -> files.


#: Children of the seed: for the errors, the noise, the order of a session, and the errors of rotary axes.
ERROR_STREAM, NOISE_STREAM, ORDER_STREAM, ROTARY_STREAM = 0, 1, 2, 3


@dataclass(frozen=True, repr=False)
class Simulation(Displayed):
    """The measurement of a virtual machine, and its truth.

    Parameters
    ----------
    name : beginning of the file names.
    lengths : the readings, as in a measurement file.
    truth : the true errors in mm and rad; its metadata give machine and seed.
    stations : the true stations (none for an instrument without).
    """

    name: str
    lengths: Lengths
    truth: ErrorTable
    stations: tuple[Station, ...]

    def overview(self) -> Overview:
        """The readings and the true errors."""
        truth = self.truth.overview()
        return Overview(f"{self.name}, {self.lengths.overview().title}", truth.header, truth.rows)


@dataclass(frozen=True)
class SimulatedReadings:
    """Readings of a virtual machine that are not lengths (axis runs, circles, ...), and its true errors in mm and rad.

    ``name`` begins the file names.
    """

    name: str
    readings: AxisRuns | Diagonals | Circles | Artefact | SixDof | SphereCentres | Bars
    truth: ErrorTable
    rotary: RotaryErrors | None = None


def actual_tips(machine: Machine, truth: ErrorTable, stops: Stops, effects: Sequence[Displacement] = ()) -> FloatArray:
    """Return the true tool tip in the workpiece frame: exact chain plus ``effects``, shape (n, 3), mm."""
    tip_mm = tip_position(machine, truth.at(stops.position_mm), stops.position_mm, stops.tool_mm)
    for effect in effects:
        moved_mm = np.asarray(effect(machine, stops))
        if (  # code of a plug-in may return anything
            moved_mm.shape != stops.position_mm.shape
            or moved_mm.dtype.kind not in "fi"
            or not np.all(np.isfinite(moved_mm))
        ):
            name = getattr(effect, "__qualname__", type(effect).__qualname__)
            expected = f"an array {stops.position_mm.shape} of finite numbers in mm"
            raise InputError(
                Message(
                    "effect-returns-other",
                    "the effect {name} returns {dtype} {shape}; expected {expected}",
                    name=name,
                    dtype=moved_mm.dtype,
                    shape=moved_mm.shape,
                    expected=expected,
                )
            )
        tip_mm = tip_mm + moved_mm.astype(np.float64)
    return tip_mm


def simulate(
    machine: Machine, scenario: Scenario, seed: int | None = None, effects: Sequence[Displacement] = ()
) -> Simulation:
    """Measure a virtual machine.

    Parameters
    ----------
    machine : provides chain, travel, nodes and modelled errors.
    scenario : true errors, instrument and trajectory.
    seed : replaces that of the scenario. Errors and noise have separate random streams, so that changing one leaves the
    other unchanged.
    effects : what acts in addition to the geometric errors and the effects of the scenario.

    Raises
    ------
    InputError
        if the trajectory leaves the machine's travel.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> scenario = compgen.read_scenario("examples/zha-gantry.scenario.toml")
    >>> measured = compgen.simulate(machine, scenario)
    >>> measured
    <Simulation: zha-gantry, 10648 readings of LT1, LT2, LT3, LT4>
    >>> again, other = compgen.simulate(machine, scenario), compgen.simulate(machine, scenario, seed=191)
    >>> [bool((item.lengths.length_mm == measured.lengths.length_mm).all()) for item in (again, other)]
    [True, False]
    """
    of_kind("machine", machine, Machine)
    of_kind("scenario", scenario, Scenario)
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    instrument = scenario.instrument
    if isinstance(instrument, SimulatedSixDof):
        raise InputError(
            Message("instrument-six-dof", "is a six-DOF instrument, which has no lengths; call simulate_sixdof"),
            file=scenario.source,
        )
    if isinstance(instrument, OwnPath):
        raise InputError(
            Message("instrument-own-path", "brings its own path and has no lengths; call simulate_axis_runs"),
            file=scenario.source,
        )
    if isinstance(instrument, LaserTracer) and instrument.rate_hz is not None:
        raise InputError(
            Message("instrument-moving", "reads while the machine moves; call simulate_moving"), file=scenario.source
        )
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
    """Add the effects of tracers and air to the lengths."""
    if not isinstance(instrument, LaserTracer):
        raise InputError(
            Message(
                "effect-not-measured",
                "{name} acts on the lengths of a laser-tracer, which this instrument does not measure",
                name=effects[0].name,
            )
        )
    stop, station = instrument.rows(len(stops))
    places = np.array([item.position_mm for item in instrument.stations])
    names = tuple(item.name for item in instrument.stations)
    sights = Sights(stops, stop, names, station, places[station], tip_mm[stop])
    change = np.sum([effect.change(sights) for effect in effects], axis=0)
    return replace(lengths, length_mm=lengths.length_mm + change)


@dataclass(frozen=True)
class MovingSimulation:
    """Readings of tracers while a virtual machine moves, generated in parts as they are written, and its true errors.

    ``name`` begins the file names, ``readings`` is their number, ``parts`` makes their columns.
    """

    name: str
    readings: int
    stations: tuple[Station, ...]
    truth: ErrorTable
    metadata: Mapping[str, str]
    parts: Callable[[], Iterator[dict[str, Any]]]


#: Positions per part.
_PART = 50_000


def simulate_moving(machine: Machine, scenario: Scenario, seed: int | None = None) -> MovingSimulation:
    """Measure a virtual machine while it moves along the trajectory: ``rate_hz`` readings a second at constant feed.

    Raises
    ------
    InputError
        if the trajectory leaves the travel, or for features of stops: effects, temperatures, sessions, other tools.
    """
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    tracer, path = scenario.instrument, scenario.trajectory
    if not isinstance(tracer, LaserTracer) or tracer.rate_hz is None or tracer.in_turn:
        message = "needs a laser-tracer with rate_hz whose stations read simultaneously"
        raise InputError(message, file=scenario.source, field="[instrument]")
    if scenario.effects or scenario.temperatures or scenario.session or path.tools_mm:
        message = "readings on the fly (rate_hz) cannot be combined with effects, temperatures, sessions or other tools"
        raise InputError(message, file=scenario.source)
    truth = draw_truth(scenario.errors, machine, child_seeds(seeds, ERROR_STREAM), None)
    corners = np.concatenate(passes_of(path, machine))
    check_stops(corners, machine)
    way_mm = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    rate_hz = tracer.rate_hz
    step_mm = path.feed_mm_min / SECONDS_PER_MIN / rate_hz
    count, stations = int(way_mm[-1] / step_mm) + 1, len(tracer.stations)
    centre_mm = np.array([item.position_mm for item in tracer.stations])
    dead_mm = np.array([item.dead_length_mm for item in tracer.stations])

    def parts() -> Iterator[dict[str, Any]]:
        rng = random_stream(seeds, NOISE_STREAM)
        for first in range(0, count, _PART):
            at_mm = np.arange(first, min(first + _PART, count)) * step_mm
            position_mm = np.stack([np.interp(at_mm, way_mm, along) for along in corners.T], axis=1)
            tip_mm = tip_position(machine, truth.at(position_mm), position_mm)
            distance_mm = np.linalg.norm(tip_mm[:, None] - centre_mm, axis=2)
            noise_mm = tracer.sigma_mm(distance_mm) * rng.standard_normal(distance_mm.shape)
            columns = {f"{axis}_mm": position_mm[:, k].repeat(stations) for k, axis in enumerate("xyz")}
            yield {
                "station": np.tile(np.arange(stations, dtype=np.int16), len(at_mm)),
                **columns,
                "length_mm": (distance_mm - dead_mm + noise_mm).ravel(),
                "time_s": (at_mm / step_mm / rate_hz).repeat(stations),
            }

    noise = {"u_length_um": f"{tracer.noise_um:g}", "u_length_um_per_m": f"{tracer.noise_um_per_m:g}"}
    metadata = {**_common(machine, used_seed), "instrument": "laser-tracer", **noise}
    described = _described(machine, truth, used_seed)
    return MovingSimulation(scenario.name, count * stations, tracer.stations, described, metadata, parts)


def simulate_sixdof(machine: Machine, scenario: Scenario, seed: int | None = None) -> SimulatedReadings:
    """Measure a virtual machine with the six-DOF instrument of the scenario; InputError for another instrument."""
    instrument = scenario.instrument
    if not isinstance(instrument, SimulatedSixDof):
        raise InputError(
            Message("instrument-not-six-dof", "is not a six-DOF instrument; call simulate"),
            file=scenario.source,
            field="[instrument] type",
        )
    return _measured(machine, scenario, seed, lambda truth, rng: instrument.measure(machine, truth, rng))


def simulate_axis_runs(machine: Machine, scenario: Scenario, seed: int | None = None) -> SimulatedReadings:
    """Measure with the scenario's laser along axes or diagonals, ballbar or touch probe; InputError for another one."""
    instrument = scenario.instrument
    if not isinstance(instrument, OwnPath):
        raise InputError(
            Message(
                "instrument-not-along-axes",
                "is not a laser along axes or diagonals, ballbar or touch probe; call simulate",
            ),
            file=scenario.source,
            field="[instrument] type",
        )
    if isinstance(instrument, SphereProbe | RotaryBallbar):
        return _at_poses(machine, scenario, instrument, seed)
    moving = [effect for effect in scenario.effects if not isinstance(effect, LengthEffect | RunEffect)]

    def measure(truth: ErrorTable, rng: np.random.Generator) -> AxisRuns | Diagonals | Circles | Artefact:
        def tips(stops: Stops) -> FloatArray:
            return actual_tips(machine, truth, stops, moving)

        return instrument.measure(machine, tips, scenario.effects, scenario.temperatures, rng)

    return _measured(machine, scenario, seed, measure)


def _at_poses(
    machine: Machine, scenario: Scenario, instrument: SphereProbe | RotaryBallbar, seed: int | None
) -> SimulatedReadings:
    """Read at poses; the errors of the rotary axes come from the stream of errors, after those of the linear axes."""
    if scenario.effects or scenario.temperatures:
        raise InputError(
            Message(
                "poses-without-effects",
                "measurements at poses of rotary axes take no effects and no temperatures; omit them",
            ),
            file=scenario.source,
        )
    drawn: list[RotaryErrors] = []
    used_seed = scenario.seed if seed is None else seed
    own = random_stream(np.random.SeedSequence(used_seed), ROTARY_STREAM)

    def measure(truth: ErrorTable, rng: np.random.Generator) -> SphereCentres | Bars:
        drawn.append(instrument.truth(machine, own))
        return instrument.measure(machine, truth, drawn[0], rng)

    return replace(_measured(machine, scenario, seed, measure), rotary=drawn[0])


def _measured(
    machine: Machine,
    scenario: Scenario,
    seed: int | None,
    measure: Callable[
        [ErrorTable, np.random.Generator], AxisRuns | Diagonals | Circles | Artefact | SixDof | SphereCentres | Bars
    ],
) -> SimulatedReadings:
    used_seed = scenario.seed if seed is None else seed
    seeds = np.random.SeedSequence(used_seed)
    truth = draw_truth(scenario.errors, machine, child_seeds(seeds, ERROR_STREAM), None)
    readings = measure(truth, random_stream(seeds, NOISE_STREAM))
    metadata = {**_common(machine, used_seed), **readings.metadata}
    return SimulatedReadings(scenario.name, replace(readings, metadata=metadata), _described(machine, truth, used_seed))


def _common(machine: Machine, seed: int) -> dict[str, str]:
    return {"machine": machine.name, "seed": str(seed)}


def _described(machine: Machine, truth: ErrorTable, seed: int) -> ErrorTable:
    reference = " ".join(f"{value:g}" for value in machine.reference_point_mm)
    common = _common(machine, seed)
    return truth.replace(metadata={**common, "source": "simulated truth", "reference_point_mm": reference})


#: Ending and writer of the file of each kind of readings.
_FORMATS: dict[type, tuple[str, Callable[[Any], str]]] = {
    Diagonals: (".diagonals.csv", format_diagonals),
    AxisRuns: (".axis.csv", format_axis_runs),
    Circles: (".circle.csv", format_circles),
    Artefact: (".artefact.csv", format_artefact),
    SixDof: (".sixdof.csv", format_sixdof),
    SphereCentres: (".sphere.csv", format_spheres),
    Bars: (".bar.csv", format_bars),
    Lengths: (".lengths.csv", format_lengths),
}


def write_simulation(
    simulation: Simulation | SimulatedReadings | MovingSimulation, folder: str | Path
) -> dict[str, Path]:
    """Write the readings, e.g. ``<name>.lengths.csv``, and ``truth.errors.csv``; return paths by file name.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> scenario = compgen.read_scenario("examples/zha-gantry.scenario.toml")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = compgen.write_simulation(compgen.simulate(machine, scenario), folder)
    >>> sorted(paths)
    ['truth.errors.csv', 'zha-gantry.lengths.csv']
    """
    of_kind("simulation", simulation, Simulation, SimulatedReadings, MovingSimulation)
    path_of("folder", folder)
    output = OutputFolder(folder)
    if isinstance(simulation, MovingSimulation):
        output.add("truth.errors.csv", format_errors(simulation.truth))
        paths = output.commit()
        target = output.folder / f"{simulation.name}{ARCHIVE}"
        names = [item.name for item in simulation.stations]
        write_archive(target, names, simulation.parts(), simulation.metadata)
        return {**paths, target.name: target}
    readings = simulation.lengths if isinstance(simulation, Simulation) else simulation.readings
    suffix, text_of = _FORMATS[type(readings)]
    output.add(f"{simulation.name}{suffix}", text_of(readings))
    rotary = simulation.rotary if isinstance(simulation, SimulatedReadings) else None
    truth = simulation.truth
    text = format_errors(truth) if rotary is None else format_machine_errors(truth, rotary, truth.metadata)
    output.add("truth.errors.csv", text)
    return output.commit()
