"""A simulated laser tracer: what its interferometer reads at each stop of the machine (Zha & Zhang 2024, eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Vector3
from compgen.core.names import MM_PER_UM
from compgen.simulate.trajectory import Stops

MM_PER_M = 1e3


@dataclass(frozen=True)
class Station:
    """A tracer on the workpiece side: its centre in the workpiece frame, and the distance at which it reads zero."""

    name: str
    position_mm: Vector3
    dead_length_mm: float


@dataclass(frozen=True)
class LaserTracer:
    """One or more tracer stations.

    Parameters
    ----------
    stations : the stations; their names differ.
    noise_um, noise_um_per_m : a and b of the standard deviation a + b L of a reading, L the distance in m.
    in_turn : False: all stations read at every stop; True: one tracer goes from station to station, and the machine
        repeats its whole trajectory for each.
    """

    stations: tuple[Station, ...]
    noise_um: float = 0.1
    noise_um_per_m: float = 0.15
    in_turn: bool = False

    @property
    def passes(self) -> int:
        """How often the machine runs its trajectory."""
        return len(self.stations) if self.in_turn else 1

    def sigma_mm(self, distance_mm: FloatArray) -> FloatArray:
        """Standard deviation of readings at the given distances, same shape, mm."""
        return (self.noise_um + self.noise_um_per_m * distance_mm / MM_PER_M) * MM_PER_UM

    def observe(self, stops: Stops, tip_mm: FloatArray, rng: np.random.Generator) -> Lengths:
        """Return the readings at stops whose true tips are ``tip_mm`` (n, 3): distance - dead length + noise."""
        stop, station = self.rows(len(stops))
        centre_mm = np.array([item.position_mm for item in self.stations])
        dead_mm = np.array([item.dead_length_mm for item in self.stations])
        distance_mm = np.linalg.norm(tip_mm[stop] - centre_mm[station], axis=1)
        noise_mm = self.sigma_mm(distance_mm) * rng.standard_normal(len(stop))
        return Lengths(
            stations=tuple(item.name for item in self.stations),
            station=station,
            point=[stops.point[k] for k in stop],
            position_mm=stops.position_mm[stop],
            length_mm=distance_mm - dead_mm[station] + noise_mm,
            tool_mm=None if stops.tool_mm is None else stops.tool_mm[stop],
            approach=stops.approach[stop],
            labels={"run": stops.run[stop], **{name: label[stop] for name, label in stops.labels.items()}},
            covariates={
                "time_s": stops.time_s[stop],
                **{name: values[stop] for name, values in stops.covariates.items()},
            },
            metadata={
                "instrument": "laser-tracer",
                "u_length_um": f"{self.noise_um:g}",
                "u_length_um_per_m": f"{self.noise_um_per_m:g}",
            },
        )

    def rows(self, stops: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Stop and station of each reading, in order of time."""
        count = len(self.stations)
        if self.in_turn:
            return np.arange(stops), np.repeat(np.arange(count), stops // count)
        return np.repeat(np.arange(stops), count), np.tile(np.arange(count), stops)


def read_laser_tracer(section: tomlio.Section) -> LaserTracer:
    """Read the ``[instrument]`` section of a scenario, its ``type`` taken already, strictly."""
    stations = tuple(_read_station(entry) for entry in section.sections("stations"))
    if not stations:
        raise section.fail("stations", "is missing; give at least one [[instrument.stations]]")
    names = [station.name for station in stations]
    if len(set(names)) != len(names):
        raise section.fail("stations", f"the names {', '.join(names)} must differ")
    tracer = LaserTracer(
        stations=stations,
        noise_um=section.take("noise_um", tomlio.not_negative, 0.1),
        noise_um_per_m=section.take("noise_um_per_m", tomlio.not_negative, 0.15),
        in_turn=section.take("reading", tomlio.choice("at-once", "in-turn"), "at-once") == "in-turn",
    )
    section.finish()
    return tracer


def _read_station(entry: tomlio.Section) -> Station:
    station = Station(
        name=entry.take("name", tomlio.name),
        position_mm=entry.take("position_mm", tomlio.vector3),
        dead_length_mm=entry.take("dead_length_mm", tomlio.number),
    )
    entry.finish()
    return station
