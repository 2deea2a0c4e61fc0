"""Do the 95 % intervals of identify hold the truth? Simulated machines, seeded; prints a table.

    python benchmarks/interval_coverage.py [--machines 200] [--seed 1]

Every machine has its own chain, travel, nodes, stations, errors and noise, and readings are missing. An interval is the
identified value +- 1.96 standard uncertainties. Values that the zero conditions fix have none and do not count. Within
one identification the values are correlated, so the spread is given between machines.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.identification import Identification, identify
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import tip_position

NORMAL_95 = 1.959964
KINDS = ("positioning", "straightness", "angular", "squareness", "stations", "dead lengths")


@dataclass(frozen=True)
class Case:
    """A simulated machine with its readings and what is true of it."""

    machine: Machine
    truth: ErrorTable
    stations_mm: np.ndarray
    dead_mm: np.ndarray
    lengths: Lengths


def draw_case(rng: np.random.Generator) -> Case:
    """Draw machine, errors, stations and noise."""
    axes = []
    for _ in range(3):
        low = rng.uniform(-800.0, 100.0)
        high = low + rng.uniform(300.0, 900.0)
        axes.append(Axis((low, high), np.linspace(low, high, int(rng.integers(4, 8)))))
    reference = tuple(float(rng.choice(axis.range_mm)) for axis in axes)
    tool = tuple(rng.uniform(-150.0, 150.0, 3).tolist())
    machine = Machine(
        "drawn", Chain(str(rng.choice(CHAINS))), tuple(axes), tool_offset_mm=tool, reference_point_mm=reference
    )
    truth = draw_errors(machine, rng)
    stations, dead = draw_stations(machine, rng), rng.uniform(100.0, 500.0, 4)
    return Case(machine, truth, stations, dead, readings_of(machine, truth, stations, dead, rng))


def draw_errors(machine: Machine, rng: np.random.Generator) -> ErrorTable:
    """Draw node values within the zero conditions; squareness of some 500 urad."""
    curves, squareness = {}, {}
    for name in modelled_errors(machine):
        if name in SQUARENESS_NAMES:
            squareness[name] = (float(rng.normal(0.0, 500e-6)), 0.0)
            continue
        error = error_named(name)
        nodes = machine.axes[error.axis].nodes_mm
        value = rng.normal(0.0, 0.015 if error.kind == "linear" else 20e-6, len(nodes))
        if error.is_straightness:
            value -= np.interp(nodes, nodes[[0, -1]], value[[0, -1]])
        else:
            value -= np.interp(machine.reference_point_mm[error.axis], nodes, value)
        curves[name] = Curve(nodes, value, np.zeros(len(nodes)))
    return ErrorTable(curves, squareness)


def draw_stations(machine: Machine, rng: np.random.Generator) -> np.ndarray:
    """Four stations about the volume, one at each corner, at different heights."""
    centre, extent = 0.5 * (machine.lower_mm + machine.upper_mm), machine.upper_mm - machine.lower_mm
    corners = np.array([[-1.0, -1.0, -0.7], [1.0, -1.0, -0.2], [1.0, 1.0, 0.3], [-1.0, 1.0, 0.9]])
    return centre + machine.tool_offset_mm + corners * rng.uniform(0.6, 1.0, (4, 3)) * extent


def readings_of(
    machine: Machine, truth: ErrorTable, stations: np.ndarray, dead: np.ndarray, rng: np.random.Generator
) -> Lengths:
    """Readings on the grid of nodes, two runs, a tenth of them missing, with noise a + b L."""
    grid = np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), axis=-1).reshape(-1, 3)
    tip = tip_position(machine, truth.at(grid), grid)
    distance = np.linalg.norm(tip[:, None] - stations, axis=2)
    constant_um, per_m_um = float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.05, 0.3))
    point, station, run = (index.ravel() for index in np.indices((len(grid), 4, 2)))
    sigma_mm = 1e-3 * (constant_um + per_m_um * distance / 1e3)
    noise = sigma_mm[point, station] * rng.standard_normal(len(point))
    kept = rng.random(len(point)) < 0.9
    point, station, run, noise = point[kept], station[kept], run[kept], noise[kept]
    return Lengths(
        stations=("LT1", "LT2", "LT3", "LT4"),
        station=station,
        point=[str(k) for k in point],
        position_mm=grid[point],
        length_mm=distance[point, station] - dead[station] + noise,
        labels={"repeat": run},
        metadata={"u_length_um": f"{constant_um:.9f}", "u_length_um_per_m": f"{per_m_um:.9f}"},
    )


def standardised_deviations(case: Case, found: Identification) -> dict[str, np.ndarray]:
    """Identified minus true value over the standard uncertainty, by kind."""
    result: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for name, curve in found.errors.curves.items():
        error = error_named(name)
        kind = "angular" if error.kind == "angular" else "straightness" if error.is_straightness else "positioning"
        free = curve.u > 1e-12
        deviation = curve.value - case.truth.curves[name].at(curve.position_mm)
        result[kind] += (deviation[free] / curve.u[free]).tolist()
    for name, (value, u) in found.errors.squareness.items():
        result["squareness"].append((value - case.truth.squareness[name][0]) / u)
    for k, station in enumerate(found.stations):
        deviation = np.array(station.position_mm) - case.stations_mm[k]
        result["stations"] += (deviation / station.u_position_mm).tolist()
        result["dead lengths"].append((station.dead_length_mm - case.dead_mm[k]) / station.u_dead_length_mm)
    return {kind: np.array(values) for kind, values in result.items()}


@dataclass(frozen=True)
class Coverage:
    """Share of true values within the 95 % interval: ``shares`` by kind and machine, of all values, and chi-squares."""

    shares: dict[str, np.ndarray]
    overall: float
    spread: float
    counts: dict[str, int]
    chi_square: np.ndarray
    rejected: int

    @property
    def by_kind(self) -> dict[str, float]:
        """Mean share of each kind over the machines."""
        return {kind: float(np.mean(values)) for kind, values in self.shares.items()}


def coverage(machines: int, seed: int) -> Coverage:
    """Simulate and identify ``machines`` machines."""
    shares: dict[str, list[float]] = {kind: [] for kind in KINDS}
    counts = dict.fromkeys(KINDS, 0)
    overall, chi_square, rejected = [], [], 0
    for stream in np.random.SeedSequence(seed).spawn(machines):
        case = draw_case(np.random.default_rng(stream))
        found = identify(case.machine, case.lengths)
        deviations = standardised_deviations(case, found)
        for kind, values in deviations.items():
            shares[kind].append(float(np.mean(np.abs(values) < NORMAL_95)))
            counts[kind] += len(values)
        overall.append(float(np.mean(np.abs(np.concatenate(list(deviations.values()))) < NORMAL_95)))
        chi_square.append(found.reduced_chi_square)
        rejected += len(found.rejected)
    return Coverage(
        shares={kind: np.array(values) for kind, values in shares.items()},
        overall=float(np.mean(overall)),
        spread=float(np.std(overall) / np.sqrt(len(overall))),
        counts=counts,
        chi_square=np.array(chi_square),
        rejected=rejected,
    )


def table(result: Coverage) -> str:
    """Return the result as text."""
    lines = [f"{'kind':<14}{'values':>8}{'within 95 %':>13}{'+-':>7}"]
    for kind, values in result.shares.items():
        spread = np.std(values) / np.sqrt(len(values))
        lines.append(f"{kind:<14}{result.counts[kind]:>8}{100 * np.mean(values):>12.2f}%{100 * spread:>7.2f}")
    total = sum(result.counts.values())
    lines.append(f"{'all':<14}{total:>8}{100 * result.overall:>12.2f}%{100 * result.spread:>7.2f}")
    chi = result.chi_square
    lines.append(f"reduced chi-square {chi.mean():.4f} (from {chi.min():.3f} to {chi.max():.3f})")
    lines.append(f"rejected readings {result.rejected} (none was disturbed)")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(f"{options.machines} simulated machines, seed {options.seed}")
    print(table(coverage(options.machines, options.seed)))


if __name__ == "__main__":
    main()
