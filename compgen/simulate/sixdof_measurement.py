"""A simulated measurement with the six-DOF instrument: runs along every axis, noise, drift, and what is not calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine, Vector3
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError
from compgen.simulate.sixdof import run_signals
from compgen.sixdof.instrument import RAD_PER_ARCSEC, Instrument, known_systematics, read_instrument, read_systematics
from compgen.sixdof.optics import DIRECTIONS, ROTATIONS, SIGNALS
from compgen.sixdof.readings import SixDof

#: The largest over 17 positions of the half ranges of 3 runs is on average so many standard deviations of a reading.
HALF_RANGE = 1.75
#: Half ranges of X, Y, Z in Table 3 of Jia et al. 2022 in the order of ROLES: um, um, um, arcsec, arcsec, arcsec.
TABLE_3 = (
    (0.090, 0.96, 1.21, 0.30, 0.53, 2.03),
    (0.010, 0.33, 0.71, 0.54, 0.23, 1.19),
    (0.070, 0.34, 0.84, 0.78, 0.83, 1.58),
)
_KEYS = ("positioning_um", "horizontal_um", "vertical_um", "yaw_arcsec", "pitch_arcsec", "roll_arcsec")
_UNITS = np.array([MM_PER_UM] * 3 + [RAD_PER_ARCSEC] * 3)
_NOISE = {"displacement_um": (0,), "qd_um": (1, 2, 3, 4), "psd_um": (5, 6)}


@dataclass(frozen=True)
class SimulatedSixDof:
    """How the axes are measured.

    Parameters
    ----------
    instrument : constants, set-up and calibrated parameters, as the instrument file has them.
    uncalibrated : parameters that are there as well, but do not stand in the instrument file, mm and rad.
    runs, there_and_back : how often each axis is run, and whether each run comes back.
    positions_mm : target positions by axis; None takes the machine's nodes.
    scatter : standard deviation of each reading by axis in the order of ROLES, (3, 6), mm and rad: the machine does not
        come to the same place.
    noise_mm : standard deviation of the signals in the order of SIGNALS, then of the two of the drift monitor, (9,).
    drift_rad : standard deviation of the step that the tilt of the beam takes from reading to reading, rad.
    reversal_mm : reversal value of each axis.
    seconds : time between readings.
    """

    instrument: Instrument
    uncalibrated: Mapping[str, float] = field(default_factory=dict)
    runs: int = 3
    there_and_back: bool = False
    positions_mm: tuple[FloatArray | None, FloatArray | None, FloatArray | None] = (None, None, None)
    scatter: FloatArray = field(default_factory=lambda: np.zeros((3, 6)))
    noise_mm: FloatArray = field(default_factory=lambda: np.zeros(9))
    drift_rad: float = 0.0
    reversal_mm: Vector3 = (0.0, 0.0, 0.0)
    seconds: float = 5.0

    @property
    def true_instrument(self) -> Instrument:
        """The instrument as it really is."""
        axes = {
            k: replace(entry, systematics=_sum(entry.systematics, self.uncalibrated, known_systematics(k)))
            for k, entry in self.instrument.axes.items()
        }
        return replace(self.instrument, axes=axes)

    def measure(self, machine: Machine, truth: ErrorTable, rng: np.random.Generator) -> SixDof:
        """Return what the instrument reads on the exactly moved machine, all axes and runs one after another."""
        blocks: list[tuple[NDArray[Any], ...]] = []
        tilt = np.zeros(2)
        for axis in sorted(self.instrument.axes):
            along, direction = self._path(machine, axis)
            for run in range(1, self.runs + 1):
                drift = tilt + np.cumsum(self.drift_rad * rng.standard_normal((len(along), 2)), axis=0)
                tilt = drift[-1]
                signals = self._signals(machine, truth, axis, along, direction, drift, rng)
                blocks.append((np.full(len(along), axis), along, np.full(len(along), run), direction, signals))
        return self._readings(machine, blocks)

    def _path(self, machine: Machine, axis: int) -> tuple[FloatArray, FloatArray]:
        """Positions of one run and the direction of travel at each."""
        given = self.positions_mm[axis]
        there = machine.axes[axis].nodes_mm if given is None else given
        low, high = machine.axes[axis].range_mm
        if there.min() < low - 1e-9 or there.max() > high + 1e-9:
            raise InputError(
                f"positions from {there.min():g} to {there.max():g} mm leave the travel of {AXES[axis]}, {low:g} to {high:g} mm",
                field=f"[instrument.positions_mm] {AXES[axis]}",
            )
        if not self.there_and_back:
            return there, np.zeros(len(there))
        return np.concatenate([there, there[::-1]]), np.repeat([1.0, -1.0], len(there))

    def _signals(
        self,
        machine: Machine,
        truth: ErrorTable,
        axis: int,
        along: FloatArray,
        direction: FloatArray,
        drift: FloatArray,
        rng: np.random.Generator,
    ) -> FloatArray:
        """Signals (n, 9) of one run: those of SIGNALS and the drift monitor, mm."""
        drawn = rng.standard_normal((len(along), 6)) * self.scatter[axis]
        moved = np.zeros((len(along), 6))
        moved[:, list(DIRECTIONS[axis])] = drawn[:, :3]
        moved[:, [3 + k for k in ROTATIONS[axis]]] = drawn[:, 3:]
        moved[:, axis] += 0.5 * direction * self.reversal_mm[axis]
        signals = run_signals(machine, truth, self.true_instrument, axis, along, drift, None, moved)
        monitor = self.instrument.optics.focal_length_mm * drift
        return np.asarray(np.hstack([signals, monitor]) + rng.standard_normal((len(along), 9)) * self.noise_mm)

    def _readings(self, machine: Machine, blocks: list[tuple[NDArray[Any], ...]]) -> SixDof:
        axis, along, run, direction, signals = (np.concatenate(column) for column in zip(*blocks, strict=True))
        names = (*SIGNALS, "y_psd2_mm", "z_psd2_mm")
        return SixDof(
            axis=axis.astype(np.int64),
            position_mm=np.asarray(along, dtype=np.float64),
            run=run.astype(np.int64),
            signals_mm=dict(zip(names, signals.T, strict=True)),
            distance_mm=np.full(len(along), np.nan),
            direction=np.asarray(direction, dtype=np.float64),
            covariates={"time_s": np.asarray(self.seconds * np.arange(len(along)), dtype=np.float64)},
            metadata={"machine": machine.name, "instrument": "sixdof-laser"},
        )


def _sum(given: Mapping[str, float], further: Mapping[str, float], known: tuple[str, ...]) -> dict[str, float]:
    names = dict.fromkeys([*given, *(name for name in further if name in known)])
    return {name: given.get(name, 0.0) + further.get(name, 0.0) for name in names}


def read_sixdof_measurement(section: tomlio.Section) -> SimulatedSixDof:
    """Read the ``[instrument]`` section of a scenario of type ``sixdof``, its type taken already, strictly."""
    path = section.file("file")
    if path is None:
        raise section.fail("file", "is missing; give the instrument TOML, relative to the scenario")
    instrument = read_instrument(path)
    positions = section.section("positions_mm", required=False)
    measurement = SimulatedSixDof(
        instrument=instrument,
        uncalibrated=read_systematics(section.section("uncalibrated", required=False)),
        runs=section.take("runs", tomlio.whole(1, 100), 3),
        there_and_back=section.take("there_and_back", tomlio.flag, False),
        positions_mm=(_targets(positions, "X"), _targets(positions, "Y"), _targets(positions, "Z")),
        scatter=_scatter(section),
        noise_mm=_noise(section.section("noise", required=False), instrument),
        drift_rad=section.take("drift_arcsec_per_reading", tomlio.not_negative, 0.0) * RAD_PER_ARCSEC,
        reversal_mm=_um(section.take("reversal_um", tomlio.vector3, (0.0, 0.0, 0.0))),
        seconds=section.take("seconds_per_reading", tomlio.positive, 5.0),
    )
    positions.finish()
    section.finish()
    return measurement


def _um(values: Vector3) -> Vector3:
    x, y, z = (MM_PER_UM * value for value in values)
    return x, y, z


def _targets(section: tomlio.Section, letter: str) -> FloatArray | None:
    """Target positions: a list, or a table with from, to and step."""
    value = section.take(letter, _positions, None)
    return None if value is None else np.asarray(value)


def _positions(value: Any) -> tuple[float, ...]:
    if not isinstance(value, dict):
        return tomlio.ascending(value)
    if set(value) != {"from", "to", "step"}:
        raise ValueError("a list of positions, or { from = .., to = .., step = .. }, is expected")
    low, high, step = (tomlio.number(value[key]) for key in ("from", "to", "step"))
    if not (high > low and step > 0 and (high - low) / step < 10000):
        raise ValueError("from below to, and a step above zero, are expected")
    return tuple((low + step * np.arange(int(np.floor((high - low) / step + 1e-9)) + 1)).tolist())


def _scatter(section: tomlio.Section) -> FloatArray:
    """Standard deviations (3, 6) of the readings in the order of ROLES: Table 3 of the paper, given ones, or zero."""
    if section.data.get("scatter") == "table3":
        section.take("scatter", tomlio.choice("table3"))
        return np.asarray(np.array(TABLE_3) * _UNITS / HALF_RANGE)
    given, result = section.section("scatter", required=False), np.zeros((3, 6))
    for axis, letter in enumerate(AXES):
        entry = given.section(letter, required=False)
        result[axis] = [entry.take(key, tomlio.not_negative, 0.0) for key in _KEYS]
        entry.finish()
    given.finish()
    return np.asarray(result * _UNITS)


def _noise(section: tomlio.Section, instrument: Instrument) -> FloatArray:
    """Standard deviations (9,) of the signals: given ones, else those of the instrument file."""
    result = np.zeros(9)
    for key, places in _NOISE.items():
        stated = instrument.noise.get(key.removesuffix("_um"), 0.0) / MM_PER_UM
        value = MM_PER_UM * section.take(key, tomlio.not_negative, stated)
        result[list(places)] = value
        if key == "psd_um":
            result[7:] = value
    section.finish()
    return result
