"""The truth of a simulation: error curves given, read from a file, or drawn at random and smooth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, read_errors
from compgen.data.machine import Machine
from compgen.data.names import (
    CURVE_NAMES,
    ERROR_INDEX,
    MM_PER_UM,
    RAD_PER_URAD,
    SQUARENESS_NAMES,
    ErrorName,
    error_named,
)
from compgen.errors import Message, nearest
from compgen.kinematics import modelled_errors

#: Number of harmonics in a drawn curve; harmonic k has k half-waves over the travel.
HARMONICS = 3

PeakRange = tuple[float, float]


@toml_files.accepts({**toml_files.array_schema(toml_files.accepted(toml_files.not_negative), 2), "maxItems": 2})
def _peak_range(value: Any) -> PeakRange:
    items = toml_files.numbers(value)
    if len(items) != 2 or not 0 <= items[0] <= items[1]:
        raise ValueError("expected two numbers [smallest, largest], not negative and in this order")
    return items[0], items[1]


_COUNT = toml_files.whole(2, 10001)


@toml_files.accepts(
    {
        "anyOf": [
            toml_files.accepted(_COUNT),
            {**toml_files.array_schema(toml_files.accepted(_COUNT), 3), "maxItems": 3},
        ]
    }
)
def counts(value: Any) -> tuple[int, int, int]:
    """One whole number for all three axes, or three for X, Y and Z, each at least 2 (a check for TOML values)."""
    items = value if isinstance(value, list) else [value] * 3
    if len(items) != 3:
        raise ValueError("expected a whole number, or three for X, Y and Z")
    x, y, z = (_COUNT(item) for item in items)
    return x, y, z


def _peak(key: str, unit: float, meaning: str) -> Any:
    return toml_files.setting(_peak_range, key=key, unit=unit, stated=[10.0, 30.0], meaning=meaning)


@dataclass(frozen=True)
class RandomErrors:
    """How errors are drawn: the peak of each one is uniform within its range, in mm or rad.

    ``nodes`` gives the number of nodes of the curves on X, Y, Z; None means the machine's nodes.
    """

    linear_peak_mm: PeakRange = _peak(
        "linear_peak_um", MM_PER_UM, "smallest and largest peak of drawn linear errors, um"
    )
    angular_peak_rad: PeakRange = _peak(
        "angular_peak_urad", RAD_PER_URAD, "smallest and largest peak of drawn angular errors, urad"
    )
    squareness_peak_rad: PeakRange = _peak(
        "squareness_peak_urad", RAD_PER_URAD, "smallest and largest peak of drawn squareness errors, urad"
    )
    nodes: tuple[int, int, int] | None = toml_files.setting(counts, None)


@dataclass(frozen=True)
class TruthPlan:
    """Source of the true errors; ``given`` ones take precedence over drawn ones and over the file.

    Parameters
    ----------
    given : curves and squareness errors of the scenario, or of the file it names.
    random : how the other errors of the machine's model are drawn; None leaves them zero.
    """

    given: ErrorTable = field(default_factory=ErrorTable)
    random: RandomErrors | None = None


def truth_schema() -> dict[str, Any]:
    """Return the JSON schema of the ``[errors]`` section of a scenario."""
    values = toml_files.accepted(toml_files.numbers)
    curve = {
        "name": toml_files.accepted(_curve_name),
        "position_mm": toml_files.accepted(toml_files.ascending),
        "value_um": values,
        "value_urad": values,
    }
    either = {"oneOf": [{"required": ["value_um"]}, {"required": ["value_urad"]}]}
    angles = dict.fromkeys(SQUARENESS_NAMES, toml_files.accepted(toml_files.number))
    return toml_files.section_schema(
        RandomErrors,
        file={**toml_files.accepted(toml_files.text), "description": "*.errors.csv with the true errors"},
        random={
            **toml_files.accepted(toml_files.flag),
            "description": "draw the errors that are not given; default: true if no file is given",
        },
        curve={
            **toml_files.array_schema({**toml_files.table_schema(curve, ["name", "position_mm"]), **either}),
            "description": "error curves that are given",
        },
        squareness_urad={**toml_files.table_schema(angles), "description": "squareness errors that are given, urad"},
    )


def read_truth_plan(section: toml_files.Section, folder: Path) -> TruthPlan:
    """Read the ``[errors]`` section of a scenario; a relative ``file`` is relative to ``folder``.

    Raises
    ------
    InputError
        for unknown keys or errors, a unit that does not match the error, a file together with random errors.
    """
    file = section.take("file", toml_files.text, None)
    drawn = section.take("random", toml_files.flag, file is None)
    if file is not None and drawn:
        raise section.fail("random", "the errors already come from a file; give either file or random = true")
    table = read_errors(folder / file) if file is not None else ErrorTable()
    random = toml_files.take_settings(RandomErrors, section) if drawn else None
    curves: dict[str, Curve] = {}
    for entry in section.sections("curve"):
        name = entry.take("name", _curve_name)
        if name in curves:
            raise entry.fail("name", f"the curve of {name} is given twice; give it once")
        curves[name] = _read_curve(entry, error_named(name))
        entry.finish()
    angles = section.section("squareness_urad", required=False)
    stated = {name: angles.take(name, toml_files.number, None) for name in SQUARENESS_NAMES}
    angles.finish()
    squareness = {name: (value * RAD_PER_URAD, np.nan) for name, value in stated.items() if value is not None}
    section.finish()
    return TruthPlan(ErrorTable({**table.curves, **curves}, {**table.squareness, **squareness}), random)


def _read_curve(entry: toml_files.Section, error: ErrorName) -> Curve:
    position_mm = np.array(entry.take("position_mm", toml_files.ascending))
    key, other = ("value_um", "value_urad") if error.unit == "um" else ("value_urad", "value_um")
    if other in entry:
        raise entry.fail(other, f"{error.name} is given in {error.unit}; write {key}")
    value = np.array(entry.take(key, toml_files.numbers))
    if len(value) != len(position_mm):
        raise entry.fail(key, f"has {len(value)} values for {len(position_mm)} positions; give one for each")
    return Curve(position_mm, value * error.si_per_unit, np.full(len(value), np.nan))


@toml_files.accepts({"enum": list(CURVE_NAMES)})
def _curve_name(value: Any) -> str:
    if value in SQUARENESS_NAMES:
        raise ValueError("a squareness error is a constant; give it in [errors.squareness_urad]")
    if value not in CURVE_NAMES:
        raise ValueError(
            Message(
                "curve-name-expected",
                "expected the name of one of the 18 error curves; {value}",
                value=nearest(str(value), CURVE_NAMES),
            )
        )
    return str(value)


def child_seeds(seeds: np.random.SeedSequence, index: int) -> np.random.SeedSequence:
    """Return child ``index`` of ``seeds``, always the same one (``spawn`` would continue counting)."""
    return np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, index))


def random_stream(seeds: np.random.SeedSequence, index: int) -> np.random.Generator:
    """Return the generator of child ``index`` of ``seeds``."""
    return np.random.Generator(np.random.PCG64(child_seeds(seeds, index)))


def draw_truth(
    plan: TruthPlan, machine: Machine, seeds: np.random.SeedSequence, tools_mm: FloatArray | None = None
) -> ErrorTable:
    """Return the true errors of ``machine`` in mm and rad.

    Every error has its own random stream, so giving one of them leaves the others unchanged.

    Parameters
    ----------
    plan : the given errors and how the rest is drawn.
    machine : provides nodes, reference point and modelled errors.
    seeds : parent of the 21 random streams, one for each error by its place among the 21.
    tools_mm : the tool offsets in use, shape (k, 3); they determine which errors the model contains.
    """
    curves, squareness = dict(plan.given.curves), dict(plan.given.squareness)
    if plan.random is None:
        return ErrorTable(curves, squareness)
    for name in modelled_errors(machine, tools_mm):
        rng = random_stream(seeds, ERROR_INDEX[name])
        if name in SQUARENESS_NAMES:
            size = float(rng.uniform(*plan.random.squareness_peak_rad) * rng.choice([-1.0, 1.0]))
            squareness.setdefault(name, (size, np.nan))
        elif name not in curves:
            curves[name] = draw_curve(error_named(name), machine, plan.random, rng)
    return ErrorTable(curves, squareness)


def draw_curve(error: ErrorName, machine: Machine, random: RandomErrors, rng: np.random.Generator) -> Curve:
    """Draw one smooth curve whose largest absolute node value is uniform in the peak range of its kind.

    It keeps the gauge of the model: a straightness is zero at both ends of its nodes (a sum of sines), positioning and
    angles are zero at the machine's reference point (a slope and cosines, minus their value there).
    """
    axis = machine.axes[error.axis]
    nodes_mm = axis.nodes_mm if random.nodes is None else np.linspace(*axis.range_mm, random.nodes[error.axis])
    peak = rng.uniform(*(random.linear_peak_mm if error.kind == "linear" else random.angular_peak_rad))
    along = (nodes_mm - nodes_mm[0]) / (nodes_mm[-1] - nodes_mm[0])
    order = np.arange(1, HARMONICS + 1)
    phase = np.pi * np.outer(along, order)
    weights = rng.standard_normal(HARMONICS) / order**2
    if error.is_straightness:
        shape = np.sin(phase) @ weights
        shape[[0, -1]] = 0.0
    else:
        shape = rng.standard_normal() * along + np.cos(phase) @ weights
        shape = shape - np.interp(machine.reference_point_mm[error.axis], nodes_mm, shape)
    largest = np.abs(shape).max()
    value = shape * (peak / largest) if largest > 0 else shape
    return Curve(nodes_mm, value, np.full(len(nodes_mm), np.nan))
