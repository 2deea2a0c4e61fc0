"""Simulated interferometers: laser tracer, laser along axes (ISO 230-2), laser along diagonals (ISO 230-6).

Each has its settings in a scenario and turns true tool tips into readings with noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.axis_runs import DIAGONALS, AxisRuns, Diagonals
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine, Vector3
from compgen.data.names import AXES, BODY_DIAGONALS, MM_PER_UM, SECONDS_PER_MIN
from compgen.data.toml_files import part_setting, setting
from compgen.errors import InputError, Message
from compgen.simulation.effects import LengthEffect, RunEffect, SimulatedEffect
from compgen.simulation.trajectory import (
    Stops,
    Temperature,
    check_stops,
    label_points,
    with_temperatures,
)

# A simulated laser tracer: what its interferometer measures at each stop of the machine (Zha & Zhang 2024, eq. 12).


MM_PER_M = 1e3


@dataclass(frozen=True)
class Station:
    """A tracer on the workpiece side: its centre in the workpiece frame, and the distance at which it reads zero."""

    name: str = setting(toml_files.name)
    position_mm: Vector3 = setting(toml_files.vector3)
    dead_length_mm: float = setting(toml_files.number)


@dataclass(frozen=True)
class LaserTracer:
    """One or more tracer stations.

    Parameters
    ----------
    stations : the stations; their names differ.
    noise_um, noise_um_per_m : a and b of the standard deviation a + b L of a reading at distance L in m.
    in_turn : False: all stations read at every stop; True: one tracer goes from station to station, and the machine
        repeats its whole trajectory for each.
    rate_hz : readings a second of each station while the machine moves, without stops; None reads at stops.
    """

    stations: tuple[Station, ...] = part_setting(
        lambda: toml_files.array_schema(toml_files.section_schema(Station), 1), required=True
    )
    noise_um: float = setting(toml_files.not_negative, 0.1)
    noise_um_per_m: float = setting(toml_files.not_negative, 0.15)
    in_turn: bool = setting(toml_files.word_for({"at-once": False, "in-turn": True}), False, key="reading")
    rate_hz: float | None = setting(toml_files.positive, None)

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


def read_laser_tracer(section: toml_files.Section) -> LaserTracer:
    """Laser tracers at stations, at stops or while the machine moves: *.lengths.csv, *.lengths.npz.

    Read from the section ``[instrument]`` of a scenario, without its ``type``, strictly.
    """
    stations = toml_files.read_each(Station, section, "stations")
    names = [station.name for station in stations]
    if len(set(names)) != len(names):
        raise section.fail("stations", f"the names {', '.join(names)} must differ")
    return toml_files.read_settings(LaserTracer, section, stations=stations)


# A simulated laser along single axes: bidirectional runs as in ISO 230-2, ``*.axis.csv``.


#: Targets are this share of the travel inside its ends, so that both directions can approach them.
OVERRUN = 0.02


@dataclass(frozen=True)
class AxisLaser:
    """Runs in both directions along axes, one after another.

    Parameters
    ----------
    axes : axes that are measured, 0, 1, 2.
    targets : targets of each axis, equally spaced over 96 % of its travel.
    cycles : forward and return runs of each axis.
    noise_um : standard deviation of a reading.
    feed_mm_min, dwell_s : speed between targets and time at each; several dwells apply to the runs in turn, and are
    logged.
    at_mm : position of the other axes; None: the machine's reference point.
    """

    axes: tuple[int, ...] = setting(
        toml_files.several_of({letter: k for k, letter in enumerate(AXES)}, "axes, e.g. ['X', 'Y']"), (0, 1, 2)
    )
    targets: int = setting(toml_files.whole(2, 1000), 11)
    cycles: int = setting(toml_files.whole(1, 1000), 5)
    noise_um: float = setting(toml_files.not_negative, 0.2)
    feed_mm_min: float = setting(toml_files.positive, 2000.0)
    dwell_s: float | tuple[float, ...] = setting(toml_files.one_or_more(toml_files.positive), 4.0)
    at_mm: Vector3 | None = setting(toml_files.vector3, None)

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
        covariates = {"feed_mm_min": np.full(len(mark), self.feed_mm_min)}
        dwell_s = np.broadcast_to(self.dwell_s, self.cycles)[mark[:, 2] - 1]
        if isinstance(self.dwell_s, tuple):
            covariates["dwell_s"] = dwell_s
        stops = Stops(
            position_mm=position_mm,
            point=label_points(position_mm),
            run=mark[:, 2],
            time_s=stop_times_s(position_mm, self.feed_mm_min, dwell_s),
            approach=way_mm,
            covariates=covariates,
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
        """Return the readings; ``tips`` returns the true tip at stops, ``effects`` act only on readings."""
        stops, mark = self.stops(machine)
        stops, axis = with_temperatures(stops, temperatures), mark[:, 0]
        deviation = along_beam(machine, tips, np.eye(3)[axis], stops, effects, "axis runs")
        return AxisRuns(
            axis=axis,
            position_mm=np.round(stops.position_mm[np.arange(len(axis)), axis], 6),
            direction=mark[:, 1],
            run=mark[:, 2],
            deviation_mm=deviation + self.noise_um * MM_PER_UM * rng.standard_normal(len(axis)),
            covariates=logged_with(stops),
            metadata={"instrument": "axis-laser", "u_deviation_um": f"{self.noise_um:g}"},
        )


def stop_times_s(position_mm: FloatArray, feed_mm_min: float, dwell_s: float | FloatArray) -> FloatArray:
    """Return the times (n,) at the stops (n, 3): travel at the feed rate between them, and the dwell at each."""
    travel_mm = np.linalg.norm(np.diff(position_mm, axis=0, prepend=position_mm[:1]), axis=1)
    return np.asarray(np.cumsum(travel_mm / feed_mm_min * SECONDS_PER_MIN + dwell_s))


def along_beam(
    machine: Machine,
    tips: Callable[[Stops], FloatArray],
    unit: FloatArray,
    stops: Stops,
    effects: Sequence[SimulatedEffect],
    what: str,
) -> FloatArray:
    """Return the deviation of the tip along beams (n, 3), with effects on the readings, (n,), mm."""
    moved_mm = tips(stops) - stops.position_mm - np.array(machine.tool_offset_mm)
    deviation = np.einsum("ij,ij->i", moved_mm, unit)
    for effect in effects:
        if isinstance(effect, LengthEffect):
            raise InputError(
                Message(
                    "effect-needs-lengths",
                    "{name} acts on the lengths of a laser-tracer, not on {what}",
                    name=effect.name,
                    what=what,
                )
            )
        if isinstance(effect, RunEffect):
            deviation = deviation + effect.change(stops.time_s)
    return np.asarray(deviation)


def logged_with(stops: Stops) -> dict[str, FloatArray]:
    """Return the columns written next to the readings: the time, the temperatures, and dwells that differ."""
    logged = {
        name: values for name, values in stops.covariates.items() if name.startswith("temp_") or name == "dwell_s"
    }
    return {"time_s": stops.time_s, **logged}


def read_axis_laser(section: toml_files.Section) -> AxisLaser:
    """An interferometer along one axis, run by run: *.axis.csv (ISO 230-2).

    Read from the section ``[instrument]`` of a scenario, without its ``type``, strictly.
    """
    laser = toml_files.take_settings(AxisLaser, section)
    if isinstance(laser.dwell_s, tuple) and len(laser.dwell_s) != laser.cycles:
        raise section.fail(
            "dwell_s", f"has {len(laser.dwell_s)} entries for {laser.cycles} cycles; give one for each run"
        )
    section.finish()
    return laser


# A simulated laser along diagonals of the travel (ISO 230-6): ``*.diagonals.csv``.


@dataclass(frozen=True)
class DiagonalLaser:
    """Runs in both directions along diagonals, one after another; the beam is along the diagonal.

    Parameters
    ----------
    diagonals : names of the measured diagonals; axes that do not move are at the machine's reference point.
    targets : targets of each diagonal, equally spaced.
    cycles : forward and return runs of each diagonal.
    noise_um : standard deviation of a reading.
    feed_mm_min, dwell_s : speed between targets and time at each.
    inside : distance of the first and last target from the ends of the travel of each axis, as a share of it, so that
        both directions can approach them.
    """

    diagonals: tuple[str, ...] = setting(
        toml_files.several_of({name: name for name in DIAGONALS}, f"diagonals, of {', '.join(DIAGONALS)}"),
        tuple(BODY_DIAGONALS),
    )
    targets: int = setting(toml_files.whole(2, 1000), 11)
    cycles: int = setting(toml_files.whole(1, 1000), 5)
    noise_um: float = setting(toml_files.not_negative, 0.2)
    feed_mm_min: float = setting(toml_files.positive, 2000.0)
    dwell_s: float = setting(toml_files.positive, 4.0)
    inside: float = setting(toml_files.share(0.25, "the travel"), OVERRUN)

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
        """Return the readings; ``tips`` returns the true tip at stops, ``effects`` act only on readings."""
        stops, names, mark = self.stops(machine)
        stops = with_temperatures(stops, temperatures)
        units = {name: self.unit(machine, name) for name in self.diagonals}
        unit = np.array([units[name] for name in names])
        deviation = along_beam(machine, tips, unit, stops, effects, "diagonals")
        return Diagonals(
            name=names,
            position_mm=stops.position_mm,
            direction=mark[:, 0],
            run=mark[:, 1],
            deviation_mm=deviation + self.noise_um * MM_PER_UM * rng.standard_normal(len(names)),
            covariates=logged_with(stops),
            metadata={"instrument": "diagonal-laser", "u_deviation_um": f"{self.noise_um:g}"},
        )


def read_diagonal_laser(section: toml_files.Section) -> DiagonalLaser:
    """An interferometer along diagonals of faces and of the volume: *.diagonals.csv (ISO 230-6).

    Read from the section ``[instrument]`` of a scenario, without its ``type``, strictly.
    """
    return toml_files.read_settings(DiagonalLaser, section)
