"""Scenario files: true errors, instrument and trajectory of a simulated measurement."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from compgen.core import tomlio
from compgen.simulate.laser_tracer import LaserTracer, read_laser_tracer
from compgen.simulate.trajectory import Trajectory, read_trajectory
from compgen.simulate.truth import RandomErrors, TruthPlan, read_truth_plan

#: Reader of the ``[instrument]`` section by its ``type``.
INSTRUMENTS: dict[str, Callable[[tomlio.Section], LaserTracer]] = {"laser-tracer": read_laser_tracer}


@dataclass(frozen=True)
class Scenario:
    """A simulated measurement; ``name`` begins the names of its files, ``seed`` starts every random number."""

    instrument: LaserTracer
    seed: int
    name: str = "simulated"
    errors: TruthPlan = field(default_factory=lambda: TruthPlan(random=RandomErrors()))
    trajectory: Trajectory = field(default_factory=Trajectory)
    source: Path | None = None


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
        instrument=INSTRUMENTS[kind](instrument),
        seed=seed,
        name=name,
        errors=errors,
        trajectory=read_trajectory(root.section("trajectory", required=False)),
        source=source,
    )
    root.finish()
    return scenario


def _file_name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}", value):
        raise ValueError("a file name of letters, digits, '.', '_' and '-' without an ending is expected")
    return value
