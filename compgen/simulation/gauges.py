"""Simulated gauges of the workshop: ballbar (circular tests, ISO 230-4) and touch probe on an artefact.

Both read the exact machine: the ballbar the distance of the tip from its pivot, the probe the axis positions at which the
tip is at a feature of the artefact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.machine import Machine, Vector3
from compgen.data.names import MM_PER_UM, SECONDS_PER_MIN
from compgen.data.toml_files import part_setting, setting
from compgen.errors import InputError, Message
from compgen.kinematics.exact_chain import rotate
from compgen.simulation.effects import LengthEffect, RunEffect, SimulatedEffect
from compgen.simulation.lasers import stop_times_s
from compgen.simulation.trajectory import Stops, Temperature, check_stops, different_numbers, with_temperatures

Tips = Callable[[Stops], FloatArray]
#: Milliseconds in a second.
MS_PER_S = 1e3
#: The tip is brought this close to a feature, mm, in at most so many steps; each gains three digits or more.
CLOSE_MM, MOST_STEPS = 1e-9, 20


#: Standard deviation of a ballbar's reading where only plane and radius are stated, um.
CIRCLE_NOISE_UM = 0.5


def _moving_only(effects: Sequence[SimulatedEffect], what: str) -> None:
    """Raise InputError for an effect that acts on the readings of another instrument."""
    for effect in effects:
        if isinstance(effect, LengthEffect | RunEffect):
            of = "the lengths of a laser-tracer" if isinstance(effect, LengthEffect) else "axis runs"
            raise InputError(
                Message(
                    "effect-acts-elsewhere", "{name} acts on {of}, not on {what}", name=effect.name, of=of, what=what
                ),
                field="[[effects]]",
            )


@dataclass(frozen=True)
class Ballbar:
    """Circles in planes of two axes, read by a ballbar or another radial gauge.

    Each axis follows its command with a lag of first order, in the steady state of a circle at constant feed: at the
    angular speed w its amplitude is cos f and its phase late by f = atan(w lag). Where an axis reverses it sticks, and
    comes free with a time constant.

    Parameters
    ----------
    planes : numbers of the planes in the order of ``PLANES``.
    radius_mm : commanded radius, the nominal length of the bar.
    centre_mm : commanded centre; None: the middle of the travel.
    arc_deg : first and last angle; a whole turn by default.
    directions : 1 counter-clockwise, -1 clockwise, in this order.
    feeds_mm_min : path speeds, one after another.
    runs : circles of each direction and feed.
    readings : readings of each circle, in the middle of as many equal steps.
    noise_um : standard deviation of a reading.
    pivot_um : pivot minus position of the tip when the machine is at the centre.
    zero_um : constant that the gauge adds.
    lag_ms : time constant of each axis; different ones are a servo mismatch.
    spike_um, spike_ms : largest overshoot at reversal of each axis (positive: outwards), and its time constant.
    """

    planes: tuple[int, ...] = setting(
        toml_files.several_of({name: k for k, name in enumerate(PLANES)}, f"planes, of {', '.join(PLANES)}"), (0, 1, 2)
    )
    radius_mm: float = setting(toml_files.positive, 100.0)
    centre_mm: Vector3 | None = setting(toml_files.vector3, None)
    arc_deg: tuple[float, float] = setting(toml_files.interval, (0.0, 360.0))
    directions: tuple[int, ...] = setting(
        toml_files.word_for({"both": (1, -1), "counter-clockwise": (1,), "clockwise": (-1,)}), (1, -1)
    )
    feeds_mm_min: tuple[float, ...] = setting(different_numbers(toml_files.positive), (1000.0,))
    runs: int = setting(toml_files.whole(1, 1000), 1)
    readings: int = setting(toml_files.whole(8, 100_000), 360)
    noise_um: float = setting(toml_files.not_negative, 0.1)
    pivot_um: Vector3 = setting(toml_files.vector3, (0.0, 0.0, 0.0))
    zero_um: float = setting(toml_files.number, 0.0)
    lag_ms: Vector3 = setting(toml_files.vector3, (0.0, 0.0, 0.0))
    spike_um: Vector3 = setting(toml_files.vector3, (0.0, 0.0, 0.0))
    spike_ms: float = setting(toml_files.positive, 20.0)

    def stops(self, machine: Machine) -> tuple[Stops, dict[str, FloatArray]]:
        """Where the axes really are, in order of time, and plane, angle, direction, run and feed of each reading."""
        share = (np.arange(self.readings) + 0.5) / self.readings
        angle = np.radians(self.arc_deg[0] + share * (self.arc_deg[1] - self.arc_deg[0]))
        rows = []
        for plane in self.planes:
            for feed in self.feeds_mm_min:
                for run in range(1, self.runs + 1):
                    for way in self.directions:
                        one = np.column_stack([np.full(len(angle), plane), angle[::way]])
                        rows.append(np.column_stack([one, np.tile([way, run, feed], (len(angle), 1))]))
        table = np.concatenate(rows)
        marks = dict(zip(("plane", "angle", "direction", "run", "feed"), table.T, strict=True))
        # the angle of which each axis is the cosine: t for the first axis of the plane, t - 90 deg for the second
        axes = np.array(list(PLANES.values()))[marks["plane"].astype(np.int64)]
        second = axes[:, [1]] == np.arange(3)
        moving = second | (axes[:, [0]] == np.arange(3))
        way, speed = marks["direction"][:, None], marks["feed"][:, None] / SECONDS_PER_MIN / self.radius_mm
        late = np.arctan(speed * np.array(self.lag_ms) / MS_PER_S)
        at = marks["angle"][:, None] - 0.5 * np.pi * second - way * late
        # a moment earlier: an axis that is just reversing still counts as coming from its old side
        approach = np.where(moving, -way * np.sign(np.sin(at - 1e-9 * way)), 0.0)
        since_s = (way * at % np.pi) / speed
        stuck_mm = MM_PER_UM * np.array(self.spike_um) * np.exp(-since_s * MS_PER_S / self.spike_ms)
        offset_mm = np.where(moving, self.radius_mm * np.cos(late) * np.cos(at) - approach * stuck_mm, 0.0)
        centre_mm = self.centre(machine)
        step_mm = np.full(len(table), self.radius_mm * np.radians(self.arc_deg[1] - self.arc_deg[0]) / self.readings)
        stops = Stops(
            position_mm=centre_mm + offset_mm,
            point=("",) * len(table),
            run=marks["run"].astype(np.int64),
            time_s=np.cumsum(step_mm / marks["feed"] * SECONDS_PER_MIN),
            approach=approach,
            covariates={"feed_mm_min": marks["feed"]},
            way_mm=np.where(moving, -way * np.sin(at), 0.0),
        )
        try:
            check_stops(stops.position_mm, machine)
        except InputError as error:
            text = f"{error.message.partition(';')[0]}; the circle leaves it: change centre_mm or radius_mm"
            raise InputError(text, field="[instrument]") from None
        return stops, marks

    def centre(self, machine: Machine) -> FloatArray:
        """The commanded centre, (3,), mm."""
        return np.array(self.centre_mm or [np.mean(axis.range_mm) for axis in machine.axes], dtype=np.float64)

    def measure(
        self,
        machine: Machine,
        tips: Tips,
        effects: Sequence[SimulatedEffect],
        temperatures: Mapping[str, Temperature],
        rng: np.random.Generator,
    ) -> Circles:
        """Return the readings: distance of the true tip from the pivot, minus the nominal radius."""
        _moving_only(effects, "circles")
        stops, marks = self.stops(machine)
        stops = with_temperatures(stops, temperatures)
        count = len(stops)
        # the pivot is set up where the tip is with the machine at the centre
        centre_mm = np.tile(self.centre(machine), (count, 1))
        at_rest = np.zeros_like(centre_mm)
        still = replace(stops, position_mm=centre_mm, approach=at_rest, way_mm=at_rest)
        pivot_mm = tips(still)[0] + np.array(self.pivot_um) * MM_PER_UM
        length_mm = np.linalg.norm(tips(stops) - pivot_mm, axis=1) + self.zero_um * MM_PER_UM
        plane = marks["plane"].astype(np.int64)
        logged = {name: values for name, values in stops.covariates.items() if name.startswith("temp_")}
        return Circles(
            plane=plane,
            angle_rad=marks["angle"],
            radius_mm=np.full(count, self.radius_mm),
            deviation_mm=length_mm - self.radius_mm + self.noise_um * MM_PER_UM * rng.standard_normal(count),
            direction=marks["direction"].astype(np.int64),
            run=stops.run,
            setup=np.array([self.planes.index(k) for k in plane.tolist()], dtype=np.int64),
            centre_mm=centre_mm,
            u_mm=np.full(count, self.noise_um * MM_PER_UM if self.noise_um else np.nan),
            covariates={"feed_mm_min": marks["feed"], "time_s": stops.time_s, **logged},
            metadata={"instrument": "ballbar"},
        )


def read_ballbar(section: toml_files.Section) -> Ballbar:
    """A ballbar on circles in the planes of two axes: *.circle.csv (ISO 230-4)."""
    return toml_files.read_settings(Ballbar, section)


@dataclass(frozen=True)
class PlatePose:
    """How the artefact lies: its middle in machine coordinates, and its rotation (a rotation vector)."""

    origin_mm: Vector3 = setting(toml_files.vector3)
    rotation_deg: Vector3 = setting(toml_files.vector3, (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class TouchProbe:
    """A grid of features, measured by the machine's own probe in one or more poses.

    A feature is touched from all sides, so that the reversal of the axes cancels.

    Parameters
    ----------
    poses : how the artefact lies in each set-up.
    columns, rows, layers : number of features along X, Y, Z of the artefact; the origin is in the middle.
    pitch_mm : their distances.
    calibrated : whether the file contains the true places (with ``u_calibration_um``), or the nominal ones.
    u_calibration_um : standard deviation of a calibrated coordinate from the true one.
    form_um : standard deviation of a true coordinate from the nominal one.
    components : measured coordinates, numbers 0, 1, 2.
    noise_um : standard deviation of a probed coordinate.
    misplaced_mm, misturned_mrad : standard deviation of the true pose from the stated one, in the plane of two
        measured coordinates or in space.
    feed_mm_min, dwell_s : speed between features, and time for each.
    """

    poses: tuple[PlatePose, ...] = part_setting(
        lambda: toml_files.array_schema(toml_files.section_schema(PlatePose), 1), required=True
    )
    columns: int = setting(toml_files.whole(1, 1000), 5)
    rows: int = setting(toml_files.whole(1, 1000), 5)
    layers: int = setting(toml_files.whole(1, 1000), 1)
    pitch_mm: Vector3 = setting(toml_files.vector3, (50.0, 50.0, 50.0))
    calibrated: bool = setting(toml_files.flag, True)
    u_calibration_um: float = setting(toml_files.not_negative, 0.0)
    form_um: float = setting(toml_files.not_negative, 0.0)
    components: tuple[int, ...] = setting(toml_files.word_for({"xyz": (0, 1, 2), "xy": (0, 1)}), (0, 1, 2))
    noise_um: float = setting(toml_files.not_negative, 0.5)
    misplaced_mm: float = setting(toml_files.not_negative, 0.05)
    misturned_mrad: float = setting(toml_files.not_negative, 0.2)
    feed_mm_min: float = setting(toml_files.positive, 2000.0)
    dwell_s: float = setting(toml_files.positive, 5.0)

    def features_mm(self) -> FloatArray:
        """Nominal places of the features in the artefact, (n, 3); its middle is the origin."""
        counts = (self.columns, self.rows, self.layers)
        steps = [
            (np.arange(size) - 0.5 * (size - 1)) * pitch for size, pitch in zip(counts, self.pitch_mm, strict=True)
        ]
        return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)

    def measure(
        self,
        machine: Machine,
        tips: Tips,
        effects: Sequence[SimulatedEffect],
        temperatures: Mapping[str, Temperature],
        rng: np.random.Generator,
    ) -> Artefact:
        """Return the axis positions at which the true tip is at the features."""
        _moving_only(effects, "an artefact")
        nominal_mm = self.features_mm()
        measured = np.isin(np.arange(3), self.components)
        true_mm = nominal_mm + measured * self.form_um * MM_PER_UM * rng.standard_normal(nominal_mm.shape)
        u_mm = self.u_calibration_um * MM_PER_UM
        stated_mm = true_mm + measured * u_mm * rng.standard_normal(nominal_mm.shape) if self.calibrated else nominal_mm
        place_mm = np.concatenate([self.lying(pose, true_mm, rng) for pose in self.poses])
        setup = np.repeat(np.arange(len(self.poses)), len(nominal_mm))
        found_mm = self.probed(machine, tips, place_mm, setup, temperatures)
        height_mm = np.repeat([pose.origin_mm for pose in self.poses], len(nominal_mm), axis=0)
        again = (len(self.poses), 1)
        return Artefact(
            feature=[f"F{k:03d}" for k in range(1, len(nominal_mm) + 1)] * len(self.poses),
            # a component that is not measured is where the machine goes to
            nominal_mm=np.tile(stated_mm, again) + ~measured * height_mm,
            u_nominal_mm=np.full(place_mm.shape, u_mm if self.calibrated and u_mm else np.nan),
            measured_mm=np.where(
                measured, found_mm + self.noise_um * MM_PER_UM * rng.standard_normal(place_mm.shape), np.nan
            ),
            setup=setup,
            calibrated=np.full(len(setup), self.calibrated),
            metadata={
                "instrument": "touch-probe",
                **({"u_probe_um": f"{self.noise_um:g}"} if self.noise_um else {}),
            },
        )

    def lying(self, pose: PlatePose, true_mm: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Places of the features in the workpiece frame, (n, 3): in the stated pose, a little off."""
        off_mm = self.misplaced_mm * rng.standard_normal(3)
        off_rad = 1e-3 * self.misturned_mrad * rng.standard_normal(3)
        if len(self.components) < 3:  # in the plane: what is not measured stays as stated
            off_mm[2], off_rad[:2] = 0.0, 0.0
        stated = np.broadcast_to(np.radians(pose.rotation_deg), true_mm.shape)
        turned = rotate(np.broadcast_to(off_rad, true_mm.shape), rotate(stated, true_mm))
        return np.asarray(turned + np.array(pose.origin_mm) + off_mm)

    def probed(
        self,
        machine: Machine,
        tips: Tips,
        place_mm: FloatArray,
        setup: NDArray[np.int64],
        temperatures: Mapping[str, Temperature],
    ) -> FloatArray:
        """Axis positions (n, 3) at which the tip is at the places in the measured components, by fixed-point iteration."""
        measured = np.isin(np.arange(3), self.components)
        time_s = stop_times_s(place_mm, self.feed_mm_min, self.dwell_s)
        none = np.zeros(place_mm.shape)
        stops = with_temperatures(
            Stops(place_mm, ("",) * len(place_mm), setup + 1, time_s, none, labels={"setup": setup + 1}, way_mm=none),
            temperatures,
        )
        for _ in range(MOST_STEPS):
            away_mm = (tips(stops) - machine.tool_offset_mm - place_mm) * measured
            stops = replace(stops, position_mm=stops.position_mm - away_mm)
            if np.abs(away_mm).max() < CLOSE_MM:
                break
        try:
            check_stops(stops.position_mm, machine)
        except InputError as error:
            text = f"{error.message.partition(';')[0]}; a feature lies there: change origin_mm, or the size of the artefact"
            raise InputError(text, field="[[instrument.poses]]") from None
        return stops.position_mm


def read_touch_probe(section: toml_files.Section, poses: tuple[PlatePose, ...] = ()) -> TouchProbe:
    """The machine's own probe on an artefact in one or more poses: *.artefact.csv.

    ``poses`` come after those of the section, which needs none then.
    """
    stated = toml_files.read_each(PlatePose, section, "poses") if "poses" in section or not poses else ()
    poses = (*stated, *poses)
    probe = toml_files.read_settings(TouchProbe, section, poses=poses)
    turned = [np.radians(pose.rotation_deg)[:2] for pose in poses]
    if len(probe.components) < 3 and np.any(turned):
        raise section.fail("components", "'xy' is for an artefact that lies flat; rotation_deg has to be [0, 0, angle]")
    return probe


def read_gauge(path: str | Path, kind: str, poses: tuple[PlatePose, ...] = ()) -> TouchProbe | Ballbar:
    """Read a ballbar or a touch probe with its artefact from a TOML file: its keys alone, or [instrument] of a scenario.

    Raises
    ------
    InputError
        for an instrument of another ``kind`` ("touch-probe", "ballbar"), no pose, an unknown key.
    """
    root = toml_files.read_toml(path)
    section = root.section("instrument") if "instrument" in root else root
    if kind == "touch-probe":
        root.section("probing", required=False)  # only the probe program needs it
    stated = section.take("type", toml_files.choice("touch-probe", "ballbar"), kind)
    if stated != kind:
        raise section.fail("type", f"{stated!r} is not expected here; this file must describe a {kind}")
    return read_touch_probe(section, poses) if kind == "touch-probe" else read_ballbar(section)


def pose_from_text(text: str) -> PlatePose:
    """Return a pose from ``X,Y,Z`` (mm), ``X,Y,Z,A`` (turned by A degrees about Z) or six numbers (rotation vector).

    >>> pose_from_text("0,50,-300,90").rotation_deg
    (0.0, 0.0, 90.0)
    """
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (3, 4, 6) or not np.isfinite(values).all():
        message = (
            f"{text!r} is not X,Y,Z in mm, X,Y,Z,ANGLE with degrees about Z, or X,Y,Z and a rotation vector in degrees"
        )
        raise InputError(message, field="--pose")
    a, b, c = values[3:] if len(values) == 6 else (0.0, 0.0, *values[3:], 0.0)[:3]
    return PlatePose((values[0], values[1], values[2]), (a, b, c))


def circle_from_text(text: str) -> Ballbar:
    """Return a ballbar from ``PLANE:RADIUS`` or ``PLANE:RADIUS:X,Y,Z`` (mm), one circle in each direction.

    >>> circle_from_text("YZ:150").radius_mm
    150.0
    """
    try:
        plane, radius, *centre = text.split(":")
        place = [float(word) for word in centre[0].split(",")] if centre else [0.0] * 3
        number, (x, y, z) = list(PLANES).index(plane.upper()), place
        radius_mm = toml_files.positive(float(radius))
    except (ValueError, IndexError):
        message = (
            f"{text!r} is not PLANE:RADIUS or PLANE:RADIUS:X,Y,Z in mm, such as XY:150; planes are {', '.join(PLANES)}"
        )
        raise InputError(message, field="--circle") from None
    return Ballbar((number,), radius_mm, (x, y, z) if centre else None, noise_um=CIRCLE_NOISE_UM)
