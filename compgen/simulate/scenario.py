"""Scenario files: true errors, instrument and trajectory of a simulated measurement."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.simulate.axis_runs import AxisLaser, read_axis_laser
from compgen.simulate.diagonals import DiagonalLaser, read_diagonal_laser
from compgen.simulate.effects import SimulatedEffect, read_effects
from compgen.simulate.laser_tracer import read_laser_tracer
from compgen.simulate.registration import instrument_problems
from compgen.simulate.session import Session, Temperature, read_session, read_temperatures
from compgen.simulate.sixdof_measurement import SimulatedSixDof, read_sixdof_measurement
from compgen.simulate.trajectory import Stops, Trajectory, read_trajectory
from compgen.simulate.truth import RandomErrors, TruthPlan, read_truth_plan


class Instrument(Protocol):
    """What every simulated instrument has; one with ``stations`` says where they truly are."""

    @property
    def passes(self) -> int:
        """How often the machine runs its trajectory."""

    def observe(self, stops: Stops, tip_mm: FloatArray, rng: np.random.Generator) -> Lengths:
        """Return the readings at stops whose true tips are ``tip_mm`` (n, 3) in the workpiece frame."""


LineLaser = AxisLaser | DiagonalLaser
AnyInstrument = Instrument | SimulatedSixDof | LineLaser
#: Reader of the ``[instrument]`` section by its ``type``; plug-ins add to it.
INSTRUMENTS: dict[str, Callable[[tomlio.Section], AnyInstrument]] = {
    "laser-tracer": read_laser_tracer,
    "sixdof": read_sixdof_measurement,
    "axis-laser": read_axis_laser,
    "diagonal-laser": read_diagonal_laser,
}


@dataclass(frozen=True)
class Scenario:
    """A simulated measurement; ``name`` begins the names of its files, ``seed`` starts every random number."""

    instrument: AnyInstrument
    seed: int
    name: str = "simulated"
    errors: TruthPlan = field(default_factory=lambda: TruthPlan(random=RandomErrors()))
    trajectory: Trajectory = field(default_factory=Trajectory)
    source: Path | None = None
    effects: tuple[SimulatedEffect, ...] = ()
    session: Session | None = None
    temperatures: Mapping[str, Temperature] = field(default_factory=dict)


def read_scenario(path: str | Path) -> Scenario:
    """Read a scenario TOML strictly, and the error file that it may name.

    Raises
    ------
    InputError
        with file, line and key for anything that is missing, unknown or impossible.
    """
    root = tomlio.read_toml(path)
    source = Path(path)
    name = root.take("name", _file_name, "simulated")
    seed = root.take("seed", tomlio.whole(0))
    errors = read_truth_plan(root.section("errors", required=False), source.parent)
    instrument = root.section("instrument")
    kind = instrument.take("type", tomlio.choice(*INSTRUMENTS))
    scenario = Scenario(
        instrument=_instrument(kind, instrument),
        seed=seed,
        name=name,
        errors=errors,
        trajectory=read_trajectory(root.section("trajectory", required=False)),
        source=source,
        effects=read_effects(root.sections("effects")),
        session=read_session(root.section("session")) if "session" in root else None,
        temperatures=read_temperatures(root.section("temperatures", required=False)),
    )
    root.finish()
    if isinstance(scenario.instrument, SimulatedSixDof):
        for key in ("trajectory", "effects", "session", "temperatures"):
            if key in root.data:
                raise root.fail(key, "belongs to other instruments; a six-DOF instrument runs along the axes")
    if isinstance(scenario.instrument, LineLaser):
        for key in ("trajectory", "session"):
            if key in root.data:
                raise root.fail(
                    key, "belongs to other instruments; a laser along axes or diagonals runs to and fro along each"
                )
    return scenario


def _instrument(kind: str, section: tomlio.Section) -> AnyInstrument:
    made = INSTRUMENTS[kind](section)
    if isinstance(made, SimulatedSixDof | LineLaser):
        return made
    problems = instrument_problems(made)
    if problems:
        raise section.fail("type", "; ".join(problems))
    return made


def _file_name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}", value):
        raise ValueError("a file name of letters, digits, '.', '_' and '-' without an ending is expected")
    return value
