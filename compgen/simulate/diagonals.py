"""A simulated laser along diagonals of the travel (ISO 230-6): ``*.diagonals.csv``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.diagonals import BODY_DIAGONALS, DIAGONALS, Diagonals
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.simulate.axis_runs import OVERRUN, along_beam, logged_beside, stop_times_s
from compgen.simulate.effects import SimulatedEffect
from compgen.simulate.session import Temperature, with_temperatures
from compgen.simulate.trajectory import Stops, check_stops, label_points


@dataclass(frozen=True)
class DiagonalLaser:
    """Runs to and fro along diagonals, one after another; the beam lies along the diagonal.

    Parameters
    ----------
    diagonals : names of those that are measured; axes that stand do so at the machine's reference point.
    targets : targets of each diagonal, equally spaced.
    cycles : runs there and back of each diagonal.
    noise_um : standard deviation of a reading.
    feed_mm_min, dwell_s : speed between targets and time at each.
    inside : how far the first and last target stand inside the travel of each axis, as a share of it, so that both
        directions can approach them.
    """

    diagonals: tuple[str, ...] = tuple(BODY_DIAGONALS)
    targets: int = 11
    cycles: int = 5
    noise_um: float = 0.2
    feed_mm_min: float = 2000.0
    dwell_s: float = 4.0
    inside: float = OVERRUN

    def line_mm(self, machine: Machine, name: str) -> FloatArray:
        """Targets (targets, 3) of one diagonal from its start to its end."""
        columns: list[FloatArray] = []
        for axis, sign in zip(machine.axes, DIAGONALS[name], strict=True):
            low, high = axis.range_mm
            margin = self.inside * (high - low)
            ends = (low + margin, high - margin) if sign > 0 else (high - margin, low + margin)
            stands = machine.reference_point_mm[len(columns)]
            columns.append(np.linspace(*ends, self.targets) if sign else np.full(self.targets, stands))
        return np.asarray(np.round(np.column_stack(columns), 6), dtype=np.float64)

    def unit(self, machine: Machine, name: str) -> FloatArray:
        """Direction (3,) of a diagonal from its start to its end."""
        line = self.line_mm(machine, name)
        return np.asarray((line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0]))

    def stops(self, machine: Machine) -> tuple[Stops, tuple[str, ...], NDArray[np.int64]]:
        """All stops in order of time, the diagonal of each, and direction and run of each, (n, 2)."""
        positions, names, marks, ways, units = [], [], [], [], []
        for name in self.diagonals:
            line = self.line_mm(machine, name)
            for run in range(1, self.cycles + 1):
                for way in (1, -1):
                    positions.append(line[::way])
                    names += [name] * self.targets
                    marks.append(np.tile(np.array([way, run], dtype=np.int64), (self.targets, 1)))
                    ways.append(np.tile(way * np.array(DIAGONALS[name], dtype=np.float64), (self.targets, 1)))
                    units.append(np.tile(way * self.unit(machine, name), (self.targets, 1)))
        position_mm, mark, approach = np.concatenate(positions), np.concatenate(marks), np.concatenate(ways)
        check_stops(position_mm, machine)
        stops = Stops(
            position_mm=position_mm,
            point=label_points(position_mm),
            run=mark[:, 1],
            time_s=stop_times_s(position_mm, self.feed_mm_min, self.dwell_s),
            approach=approach,
            covariates={"feed_mm_min": np.full(len(mark), self.feed_mm_min)},
            way_mm=np.concatenate(units),
        )
        return stops, tuple(names), mark

    def measure(
        self,
        machine: Machine,
        tips: Callable[[Stops], FloatArray],
        effects: Sequence[SimulatedEffect],
        temperatures: Mapping[str, Temperature],
        rng: np.random.Generator,
    ) -> Diagonals:
        """Return the readings; ``tips`` tells where the tip really is at stops, ``effects`` act on readings alone."""
        stops, names, mark = self.stops(machine)
        stops = with_temperatures(stops, temperatures)
        moved_mm = tips(stops) - stops.position_mm - np.array(machine.tool_offset_mm)
        units = {name: self.unit(machine, name) for name in self.diagonals}
        deviation = along_beam(moved_mm, np.array([units[name] for name in names]), stops, effects, "diagonals")
        return Diagonals(
            name=names,
            position_mm=stops.position_mm,
            direction=mark[:, 0],
            run=mark[:, 1],
            deviation_mm=deviation + self.noise_um * MM_PER_UM * rng.standard_normal(len(names)),
            covariates=logged_beside(stops),
            metadata={"instrument": "diagonal-laser", "u_deviation_um": f"{self.noise_um:g}"},
        )


def read_diagonal_laser(section: tomlio.Section) -> DiagonalLaser:
    """Read the ``[instrument]`` section of a scenario, its ``type`` taken already, strictly."""
    laser = DiagonalLaser(
        diagonals=section.take("diagonals", _names, tuple(BODY_DIAGONALS)),
        targets=section.take("targets", tomlio.whole(2, 1000), 11),
        cycles=section.take("cycles", tomlio.whole(1, 1000), 5),
        noise_um=section.take("noise_um", tomlio.not_negative, 0.2),
        feed_mm_min=section.take("feed_mm_min", tomlio.positive, 2000.0),
        dwell_s=section.take("dwell_s", tomlio.positive, 4.0),
        inside=section.take("inside", _share, OVERRUN),
    )
    section.finish()
    return laser


def _share(value: Any) -> float:
    number = tomlio.not_negative(value)
    if number > 0.25:
        raise ValueError("a share of the travel from 0 to 0.25 is expected")
    return number


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not set(value) <= set(DIAGONALS) or len(set(value)) < len(value):
        raise ValueError(f"a list of different diagonals is expected, of {', '.join(DIAGONALS)}")
    return tuple(value)
