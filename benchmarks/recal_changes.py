"""How often recalibration proposes new tables without a change, and how soon it finds one; prints a table.

    python benchmarks/recal_changes.py [--machines 300] [--seed 1]

Calibrations of a machine are drawn from a truth, the covariance of a measurement, and how well the machine repeats: scales
of three axes follow temperatures that nobody reads, squarenesses change from one calibration to the next. The decision is
that of :func:`compgen.fleet.change.change_since`, which `volcomp recal` calls. What is proposed is approved, so that a false
proposal has its consequences.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.names import error_named
from compgen.data.repeatability import Repeatability
from compgen.fleet.change import Calibration, change_since
from compgen.identification.covariance import Covariance, covariance_of_values
from compgen.kinematics import modelled_errors

#: Expansion of the scales, 1/K; standard uncertainty of curves (mm), angles and squareness (rad) of a measurement.
PER_K = 11.5e-6
U_MM, U_RAD = 0.03e-3, 0.1e-6
CONFIDENCE = 0.98
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


def machine_of(stated: Repeatability | None = None, expansion: float | None = None) -> Machine:
    """A gantry of half a metre; ``expansion`` in um/(m K) is what its file states."""
    travel = ((-300.0, 200.0), (-100.0, 300.0), (-240.0, 0.0))
    axes = [Axis(ends, np.linspace(*ends, 6), expansion) for ends in travel]
    known = Repeatability() if stated is None else stated
    return Machine("gantry", Chain("WFYXZT"), (axes[0], axes[1], axes[2]), repeatability=known)


@dataclass(frozen=True)
class Repeats:
    """How the machine really repeats: temperature of each axis, K, squareness, urad; ``read``: with thermometers.

    Thermometers read to ``read_k``; the coefficient in the machine file is wrong by the share ``wrong``, while the hall
    is ``season_k`` warmer or colder (standard deviation).
    """

    kelvin: float = 0.0
    urad: float = 0.0
    read_k: float | None = None
    wrong: float = 0.0
    season_k: float = 0.0


class Simulated:
    """A machine and its calibrations; ``step`` is added to its errors by name: mm/mm, rad, or a bump of EXX, mm."""

    def __init__(self, machine: Machine, repeats: Repeats, rng: np.random.Generator) -> None:
        self.machine, self.repeats, self.rng = machine, repeats, rng
        self.truth = _truth(machine, rng)
        self.covariance = covariance_of_values(self.truth, np.diag(self.truth.uncertainties()), machine.name)
        self.step: dict[str, float] = {}
        self.days = 0.0

    def calibration(self) -> Calibration:
        """One more measurement."""
        known, rng = self.repeats, self.rng
        self.days += 7.0
        hall = known.season_k * rng.normal()
        warm = hall + known.kelvin * rng.normal(size=3)  # what the scales have
        read = hall if known.read_k is None else warm + known.read_k * rng.normal(size=3)
        left = PER_K * warm if known.read_k is None else PER_K * (warm - (1.0 + known.wrong) * read)
        curves, squareness = dict(self.truth.curves), dict(self.truth.squareness)
        for k, name in enumerate(("EXX", "EYY", "EZZ")):
            curve = curves[name]
            at = curve.position_mm - self.machine.reference_point_mm[k]
            value = curve.value + (left[k] + self.step.get(name, 0.0)) * at
            if name == "EXX":
                value = value + self.step.get("bump", 0.0) * (np.arange(len(at)) == len(at) // 2)
            curves[name] = replace(curve, value=value)
        for name, (value, u) in squareness.items():
            squareness[name] = (value + self.step.get(name, 0.0) + 1e-6 * known.urad * rng.normal(), u)
        table = ErrorTable(curves, squareness)
        noise = self.covariance.errors_factor @ rng.normal(size=self.covariance.errors_factor.shape[1])
        temperatures = (
            {} if known.read_k is None else {f"temp_{a}_c": 20.0 + t for a, t in zip("xyz", read, strict=True)}
        )
        return Calibration(
            BEGIN + timedelta(days=self.days), _plus(table, self.covariance, noise), self.covariance, temperatures
        )


def _truth(machine: Machine, rng: np.random.Generator) -> ErrorTable:
    curves, squareness = {}, {}
    for name in modelled_errors(machine):
        error = error_named(name)
        if error.kind == "squareness":
            squareness[name] = (30e-6 * rng.normal(), U_RAD)
            continue
        nodes = machine.axes[error.axis].nodes_mm
        size, u = (8e-3, U_MM) if error.kind == "linear" else (15e-6, U_RAD)
        curves[name] = Curve(nodes, size * np.cumsum(rng.normal(size=len(nodes))) / 3.0, np.full(len(nodes), u))
    return ErrorTable(curves, squareness)


def _plus(table: ErrorTable, covariance: Covariance, noise: np.ndarray) -> ErrorTable:
    names = np.array(covariance.error)
    curves = {name: replace(curve, value=curve.value + noise[names == name]) for name, curve in table.curves.items()}
    squareness = {name: (value + noise[names == name][0], u) for name, (value, u) in table.squareness.items()}
    return ErrorTable(curves, squareness)


def proposed(machine: Machine, known: Sequence[Calibration], levels: Sequence[int], corrected: bool) -> bool:
    """Whether the last calibration leads to a proposal."""
    return change_since(machine, known, levels, CONFIDENCE, corrected=corrected).significant


def false_share(
    machine: Machine, repeats: Repeats, machines: int, measurements: int, rng: np.random.Generator
) -> float:
    """Share of measurements of unchanged machines that lead to a proposal, in percent."""
    found = 0
    for _ in range(machines):
        made, known, levels = Simulated(machine, repeats, rng), [], []
        for number in range(measurements + 1):
            known.append(made.calibration())
            levels.append(levels[-1] if levels else 0)
            if number and proposed(machine, known, levels, repeats.read_k is not None):
                found += 1
                levels[-1] += 1
    return 100.0 * found / (machines * measurements)


def found_share(
    machine: Machine, repeats: Repeats, step: dict[str, float], history: int, after: int, machines: int,
    rng: np.random.Generator
) -> list[float]:  # fmt: skip
    """Share of machines whose ``step`` is found by the first, second, ... measurement after it, in percent."""
    found = np.zeros(after)
    for _ in range(machines):
        made = Simulated(machine, repeats, rng)
        known = [made.calibration() for _ in range(history)]
        made.step = step
        for number in range(after):
            known.append(made.calibration())
            if proposed(machine, known, [0] * len(known), repeats.read_k is not None):
                found[number:] += 1
                break
    return [100.0 * float(value) / machines for value in found]


#: The rows of the table: true repeatability.
ROWS = {
    "none": Repeats(),
    "0.3 K": Repeats(0.3),
    "0.3 K + 1 urad": Repeats(0.3, 1.0),
    "twice that": Repeats(0.6, 2.0),
    "0.3 K + 1 urad, read to 0.05 K": Repeats(0.3, 1.0, 0.05),
    "the same, coefficient 20 % wrong, hall +- 3 K": Repeats(0.3, 1.0, 0.05, 0.2, 3.0),
    "0.3 K + 1 urad, hall +- 2 K that nobody reads": Repeats(0.3, 1.0, season_k=2.0),
    "0.3 K + 1 urad, hall +- 2 K, read to 0.05 K": Repeats(0.3, 1.0, 0.05, 0.0, 2.0),
}
SQUARENESS, SCALE = {"EC0Y": 5e-6}, {"EXX": 5e-6}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--machines", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(
        "true repeatability | false, % | 5 urad found by 1st/2nd, % (history 5; 20) | 5 um/m by 1st/2nd (5; 20), 12th (20)"
    )
    for name, repeats in ROWS.items():
        rng = np.random.default_rng([given.seed, len(name)])
        machine = machine_of(expansion=None if repeats.read_k is None else 1e6 * PER_K)
        cells = [f"{false_share(machine, repeats, given.machines, 15, rng):.2f}"]
        for step in (SQUARENESS, SCALE):
            five = found_share(machine, repeats, step, 5, 2, given.machines, rng)
            twenty = found_share(machine, repeats, step, 20, 12 if step is SCALE else 2, given.machines, rng)
            last = f", {twenty[-1]:.0f}" if step is SCALE else ""
            cells.append(f"{five[0]:.0f}/{five[1]:.0f}; {twenty[0]:.0f}/{twenty[1]:.0f}{last}")
        print(" | ".join([name, *cells]), flush=True)
    rng = np.random.default_rng(given.seed)
    bump = found_share(machine_of(), ROWS["0.3 K + 1 urad"], {"bump": 1e-3}, 5, 1, given.machines, rng)
    print(f"a bump of 1 um in EXX found at once: {bump[0]:.0f} %")
    for factor in (1.0 / 3.0, 2.0):
        stated = Repeatability(scale_um_per_m=3.5 * factor, squareness_urad=factor)
        machine = machine_of(stated)
        share = false_share(machine, ROWS["0.3 K + 1 urad"], given.machines, 15, rng)
        seen = found_share(machine, ROWS["0.3 K + 1 urad"], SQUARENESS, 5, 2, given.machines, rng)
        print(
            f"stated repeatability times {factor:.2g}: false {share:.1f} %, 5 urad found {seen[0]:.0f}/{seen[1]:.0f} %"
        )


if __name__ == "__main__":
    main()
