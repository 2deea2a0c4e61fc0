"""A simulated laser along single axes: bidirectional runs as ISO 230-2 has them, ``*.axis.csv``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine, Vector3
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError
from compgen.simulate.effects import LengthEffect, RunEffect, SimulatedEffect
from compgen.simulate.session import Temperature, with_temperatures
from compgen.simulate.trajectory import SECONDS_PER_MIN, Stops, check_stops, label_points

#: Targets stand this share of the travel inside its ends, so that both directions can approach them.
OVERRUN = 0.02


@dataclass(frozen=True)
class AxisLaser:
    """Runs to and fro along axes, one after another.

    Parameters
    ----------
    axes : axes that are measured, 0, 1, 2.
    targets : targets of each axis, equally spaced over 96 % of its travel.
    cycles : runs there and back of each axis.
    noise_um : standard deviation of a reading.
    feed_mm_min, dwell_s : speed between targets and time at each.
    at_mm : where the other axes stand; None: the machine's reference point.
    """

    axes: tuple[int, ...] = (0, 1, 2)
    targets: int = 11
    cycles: int = 5
    noise_um: float = 0.2
    feed_mm_min: float = 2000.0
    dwell_s: float = 4.0
    at_mm: Vector3 | None = None

    def stops(self, machine: Machine) -> tuple[Stops, NDArray[np.int64]]:
        """All stops in order of time, and axis, direction and run of each, (n, 3)."""
        positions, marks = [], []
        for axis in self.axes:
            low, high = machine.axes[axis].range_mm
            inside = OVERRUN * (high - low)
            for run in range(1, self.cycles + 1):
                for way in (1, -1):
                    line = np.tile(np.array(self.at_mm or machine.reference_point_mm), (self.targets, 1))
                    line[:, axis] = np.linspace(low + inside, high - inside, self.targets)[::way]
                    positions.append(line)
                    marks.append(np.tile(np.array([axis, way, run], dtype=np.int64), (self.targets, 1)))
        position_mm, mark = np.concatenate(positions), np.concatenate(marks)
        check_stops(position_mm, machine)
        way_mm = np.eye(3)[mark[:, 0]] * mark[:, [1]]
        stops = Stops(
            position_mm=position_mm,
            point=label_points(position_mm),
            run=mark[:, 2],
            time_s=stop_times_s(position_mm, self.feed_mm_min, self.dwell_s),
            approach=way_mm,
            covariates={"feed_mm_min": np.full(len(mark), self.feed_mm_min)},
            way_mm=way_mm,
        )
        return stops, mark

    def measure(
        self,
        machine: Machine,
        tips: Callable[[Stops], FloatArray],
        effects: Sequence[SimulatedEffect],
        temperatures: Mapping[str, Temperature],
        rng: np.random.Generator,
    ) -> AxisRuns:
        """Return the readings; ``tips`` tells where the tip really is at stops, ``effects`` act on readings alone."""
        stops, mark = self.stops(machine)
        stops, axis = with_temperatures(stops, temperatures), mark[:, 0]
        moved_mm = tips(stops) - stops.position_mm - np.array(machine.tool_offset_mm)
        deviation = along_beam(moved_mm, np.eye(3)[axis], stops, effects, "axis runs")
        return AxisRuns(
            axis=axis,
            position_mm=np.round(stops.position_mm[np.arange(len(axis)), axis], 6),
            direction=mark[:, 1],
            run=mark[:, 2],
            deviation_mm=deviation + self.noise_um * MM_PER_UM * rng.standard_normal(len(axis)),
            covariates=logged_beside(stops),
            metadata={"instrument": "axis-laser", "u_deviation_um": f"{self.noise_um:g}"},
        )


def stop_times_s(position_mm: FloatArray, feed_mm_min: float, dwell_s: float) -> FloatArray:
    """Return the times (n,) at the stops (n, 3): travel at the feed from one to the next, and the dwell at each."""
    travel_mm = np.linalg.norm(np.diff(position_mm, axis=0, prepend=position_mm[:1]), axis=1)
    return np.asarray(np.cumsum(travel_mm / feed_mm_min * SECONDS_PER_MIN + dwell_s))


def along_beam(
    moved_mm: FloatArray, unit: FloatArray, stops: Stops, effects: Sequence[SimulatedEffect], what: str
) -> FloatArray:
    """Return displacements (n, 3) along beams (n, 3) with the effects that act on the readings alone, (n,), mm."""
    deviation = np.einsum("ij,ij->i", moved_mm, unit)
    for effect in effects:
        if isinstance(effect, LengthEffect):
            raise InputError(f"{effect.name} acts on the lengths of a laser-tracer, not on {what}")
        if isinstance(effect, RunEffect):
            deviation = deviation + effect.change(stops.time_s)
    return np.asarray(deviation)


def logged_beside(stops: Stops) -> dict[str, FloatArray]:
    """Return the columns that are written beside the readings: the time and the temperatures."""
    temperatures = {name: values for name, values in stops.covariates.items() if name.startswith("temp_")}
    return {"time_s": stops.time_s, **temperatures}


def read_axis_laser(section: tomlio.Section) -> AxisLaser:
    """Read the ``[instrument]`` section of a scenario, its ``type`` taken already, strictly."""
    laser = AxisLaser(
        axes=section.take("axes", _axes, (0, 1, 2)),
        targets=section.take("targets", tomlio.whole(2, 1000), 11),
        cycles=section.take("cycles", tomlio.whole(1, 1000), 5),
        noise_um=section.take("noise_um", tomlio.not_negative, 0.2),
        feed_mm_min=section.take("feed_mm_min", tomlio.positive, 2000.0),
        dwell_s=section.take("dwell_s", tomlio.positive, 4.0),
        at_mm=section.take("at_mm", tomlio.vector3, None),
    )
    section.finish()
    return laser


def _axes(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not value or not set(value) <= set(AXES) or len(set(value)) < len(value):
        raise ValueError("a list of different axes, e.g. ['X', 'Y'], is expected")
    return tuple(AXES.index(letter) for letter in value)
