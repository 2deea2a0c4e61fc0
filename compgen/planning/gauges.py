"""What artefacts under the machine's probe and circles (ballbar) will determine, and what they would show."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

import numpy as np

from compgen.data.circles import PLANES, Circles
from compgen.data.comparison import without_rigid_motion
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.files import json_text
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.drawing.charts import Picture, Plot, page_assets, picture_grid, rounded, svg, ticks
from compgen.drawing.display import Displayed, Overview
from compgen.errors import CompgenWarning, InputError, UndeterminedError, number_text, um_text
from compgen.identification.adjust.determined import Determined
from compgen.identification.adjust.unknowns import error_parameters
from compgen.identification.axis_tests import identify_circles
from compgen.identification.covariance import values_with_factor
from compgen.identification.options import IdentifyOptions
from compgen.identification.posterior import Information, Posterior, assumed_text, not_measured, with_information
from compgen.identification.result import Identification, without_adjustment
from compgen.identification.together import Source, solve_together, with_prior
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import modelled_errors
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import volumetric_error
from compgen.planning.next_measurement import REDUCED, unmeasured
from compgen.planning.prediction import FEW_POINTS, VolumeUncertainty, volume_of
from compgen.simulation.gauges import CIRCLE_NOISE_UM, Ballbar, PlatePose, TouchProbe
from compgen.simulation.trajectory import Stops

Gauge = TouchProbe | Ballbar

# Readings of a perfect machine, and the posterior that a measurement would get.


@dataclass(frozen=True)
class Addition:
    """A pose or circle to add: in words, as an option, what it adds and reduces, and u of the field over the volume with it.

    ``adds`` are errors that are determined with it and not without, ``reduces`` those whose uncertainty it reduces, by what
    that takes from u of the field. ``u_ratio`` is the mean ratio of the uncertainties of the errors that were determined before.
    """

    text: str
    option: str
    adds: tuple[str, ...]
    reduces: tuple[str, ...]
    u_ratio: float
    u_after_um: float | None = None

    @property
    def effect(self) -> str:
        """What it brings, in words."""
        adds = f"determines {', '.join(self.adds)}" if self.adds else ""
        others = [name for name in self.reduces if name not in self.adds][:MOST_NAMES]
        less = f"reduces {', '.join(others)}" if others else ""
        after = "" if self.u_after_um is None else f"u over the volume then {um_text(self.u_after_um)} um"
        return "; ".join(part for part in (adds, less, after) if part)

    def summary(self) -> dict[str, Any]:
        """Return the entry of ``additions`` in ``plan.json``."""
        return {
            "what": self.text,
            "option": self.option,
            "adds": list(self.adds),
            "reduces": list(self.reduces),
            "u_ratio": self.u_ratio,
            "u_after_um": self.u_after_um,
        }


@dataclass(frozen=True, repr=False)
class GaugePlan(Displayed):
    """What a planned measurement with gauges determines.

    Parameters
    ----------
    machine, gauges : the machine, its gauges, and planned tracer lengths, if any.
    lengths : planned tracer lengths, or None.
    readings, freedom : number of readings, without calibration data, and degrees of freedom.
    solution : the adjustment of the readings alone; None if they determine no error.
    errors : errors that an identification would list, with values of zero and the predicted standard uncertainties.
    posterior : what will be known of every error; None without a prior.
    volume : u of E over the volume; None without a prior.
    additions : what to measure in addition, the most useful first.
    """

    machine: Machine
    gauges: tuple[Gauge, ...]
    lengths: Lengths | None
    readings: int
    freedom: int
    solution: Determined | None
    errors: ErrorTable
    posterior: Posterior | None = None
    volume: VolumeUncertainty | None = None
    additions: tuple[Addition, ...] = ()

    @property
    def whole(self) -> tuple[str, ...]:
        """Errors that the measurement determines: at most a third of what is assumed of them remains unknown."""
        return tuple(name for name in self.errors.names if name not in self.partly)

    @property
    def partly(self) -> tuple[str, ...]:
        """Errors of which the measurement shows something, but not enough."""
        if self.posterior is None:
            return self.solution.partly if self.solution else ()
        return tuple(name for name in self.errors.names if name not in self.posterior.determined)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Errors that the measurement shows little of or nothing: what is assumed of them remains unknown."""
        names = modelled_errors(self.machine) if self.posterior is None else self.posterior.names
        return tuple(name for name in names if name not in self.errors.names)

    def uncertainties(self) -> dict[str, dict[str, Any]]:
        """Largest standard uncertainty of each error over the travel and where it was read; with a prior of every error."""
        empty, largest = self.solution.unreached if self.solution else {}, {}
        for name in self.errors.names if self.posterior is None else self.posterior.names:
            error, listed = error_named(name), name in self.errors.names
            at_mm, u = self._u_of(name)
            worst, read = int(np.argmax(np.nan_to_num(u, nan=np.inf))), ~np.isin(at_mm, empty.get(name, []))
            known = bool(np.isfinite(u[worst]))
            largest[name] = {
                "unit": error.unit,
                "u_max": float(u[worst]) / error.si_per_unit if known else None,
                "at_mm": None if np.isnan(at_mm[worst]) else float(at_mm[worst]),
                "u_max_where_read": float(u[read].max()) / error.si_per_unit
                if listed and known and read.any()
                else None,
                "state": "assumed" if not listed else "partly" if name in self.partly else "determined",
            }
        return largest

    def _u_of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Positions (m,) and standard uncertainties (m,) of an error, mm and rad; nan for the position of a squareness."""
        if name in self.errors.squareness:
            return np.full(1, np.nan), np.array([self.errors.squareness[name][1]])
        if name in self.errors.curves:
            return self.errors.curves[name].position_mm, self.errors.curves[name].u
        assert self.posterior is not None
        error = error_named(name)
        at_mm = np.full(1, np.nan) if error.kind == "squareness" else self.machine.axes[error.axis].nodes_mm
        return at_mm, self.posterior.curve(name, at_mm).u

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``plan.json``."""
        found = self.solution
        return {
            "determined": list(self.whole),
            "partly": list(self.partly),
            "left_out": list(self.left_out),
            "machine": self.machine.name,
            "gauges": [_described(gauge) for gauge in self.gauges],
            "readings": self.readings,
            "rank": found.rank if found else 0,
            "degrees_of_freedom": self.freedom,
            "condition": found.condition if found else None,
            "u": self.uncertainties(),
            **self._assumed(),
            "nodes_without_data": {name: at.tolist() for name, at in found.unreached.items()} if found else {},
            "additions": [item.summary() for item in self.additions],
        }

    def _assumed(self) -> dict[str, Any]:
        """What is assumed of errors that the measurement does not show, what it costs, and u of the field."""
        if self.posterior is None or self.volume is None:
            return {"prior": self.machine.prior.as_dict(), "not_measured": {}}
        return {
            "volume": self.volume.summary(),
            "prior": self.posterior.prior.as_dict(),
            "assumed": assumed_text(self.posterior),
            "not_measured": not_measured(self.posterior, self.errors.names),
        }

    def overview(self) -> Overview:
        """Largest uncertainty of each error."""
        rows = tuple(
            (name, number_text(item["u_max"], missing="not determined"), str(item["unit"]), str(item["state"]))
            for name, item in self.uncertainties().items()
        )
        return Overview(
            f"plan: {len(self.whole)} errors from {self.readings} readings", ("error", "u", "unit", ""), rows
        )


def volume_text(plan: GaugePlan) -> str:
    """Say how well the field over the volume will be known, and what is assumed for it; empty without a prior."""
    if plan.volume is None or plan.posterior is None:
        return ""
    largest, mean = um_text(plan.volume.worst_um), um_text(plan.volume.rms_um)
    return f"u of E over the volume, max / rms: {largest} / {mean} um; {assumed_text(plan.posterior)}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _described(gauge: Gauge) -> str:
    """A gauge in words."""
    if isinstance(gauge, Ballbar):
        planes = ", ".join(list(PLANES)[k] for k in gauge.planes)
        return f"circles in {planes}, radius {gauge.radius_mm:g} mm, {gauge.noise_um:g} um"
    kind = "calibrated" if gauge.calibrated else "uncalibrated"
    count = gauge.columns * gauge.rows * gauge.layers
    poses = f"{len(gauge.poses)} pose{'s' if len(gauge.poses) > 1 else ''}"
    return f"{kind} artefact of {count} features in {poses}, {gauge.noise_um:g} um"


def perfect_readings(machine: Machine, gauge: Gauge, errors: ErrorTable | None = None) -> Artefact | Circles:
    """Return what a gauge reads without noise on a machine with the given errors, by the exact model; none by default."""

    def tips(stops: Stops) -> FloatArray:
        tool = np.array(machine.tool_offset_mm)
        if errors is None:
            return np.asarray(stops.position_mm + tool)
        return tip_position(machine, errors.at(stops.position_mm), stops.position_mm, tool)

    exact: Gauge
    if isinstance(gauge, Ballbar):
        exact = replace(gauge, noise_um=0.0)
    else:
        exact = replace(gauge, noise_um=0.0, form_um=0.0, u_calibration_um=0.0, misplaced_mm=0.0, misturned_mrad=0.0)
    found = exact.measure(machine, tips, [], {}, np.random.default_rng(0))
    if isinstance(found, Circles) or isinstance(gauge, Ballbar):
        return found
    u_mm = gauge.u_calibration_um * MM_PER_UM
    return replace(
        found,
        u_nominal_mm=np.full(found.nominal_mm.shape, u_mm if gauge.calibrated and u_mm else np.nan),
        metadata={**found.metadata, "u_probe_um": f"{gauge.noise_um or CIRCLE_NOISE_UM:g}"},
    )


def plan_gauges(
    machine: Machine,
    gauges: Sequence[Gauge],
    lengths: Lengths | None = None,
    options: IdentifyOptions | None = None,
    *,
    additions: bool = True,
) -> GaugePlan:
    """Predict what artefacts, circles and planned tracer lengths determine in one joint adjustment.

    Parameters
    ----------
    machine : chain, travel, nodes and the errors that its model contains.
    gauges : touch probes with their artefact and its poses, ballbars with their circles.
    lengths : readings of a perfect machine, see :func:`compgen.planning.prediction.planned`.
    options : the uncertainty of lengths.
    additions : whether to look for poses and circles to add.

    Raises
    ------
    InputError
        for a feature or a circle outside the travel.
    """
    with one_thread():
        setting = _Setting(machine, lengths, replace(options or IdentifyOptions(), reject=False))
        found = _predicted(setting, tuple(gauges))
        return replace(found, additions=_additions(setting, found)) if additions else found


@dataclass(frozen=True)
class _Setting:
    """What all plans of a machine share: planned lengths, options, and what each gauge reads, once it was asked for."""

    machine: Machine
    lengths: Lengths | None
    options: IdentifyOptions
    known: dict[Gauge, Source] = field(default_factory=dict)

    def sources(self, gauges: Sequence[Gauge]) -> list[Source]:
        """What gauges and the tracer read, with the uncertainty that identification would find."""
        for gauge in gauges:
            if gauge not in self.known:
                self.known[gauge] = _source(self.machine, gauge)
        parts = [replace(self.known[gauge], name=f"gauge {k}") for k, gauge in enumerate(gauges)]
        return [*parts, Source("lengths", self.lengths, None)] if self.lengths is not None else parts


def _predicted(setting: _Setting, gauges: tuple[Gauge, ...]) -> GaugePlan:
    """The plan of gauges: what least squares determines, and the posterior that identification would have of the readings."""
    machine, lengths, plain = setting.machine, setting.lengths, setting.options
    parts = setting.sources(gauges)
    count = sum(_count(part) for part in parts)
    layout = error_parameters(machine, modelled_errors(machine))
    metadata = {"machine": machine.name, "source": "compgen plan", "values": "zero, only u_value is predicted"}
    freedom, solution, errors = 0, None, ErrorTable({}, {}, metadata)
    try:
        _, solution, _ = solve_together(machine, layout, parts, plain)
    except UndeterminedError:
        pass
    else:
        errors, _ = values_with_factor(solution.layout, np.zeros(solution.layout.size), solution.factor)
        freedom = solution.freedom + sum(part.alone.degrees_of_freedom for part in parts if part.alone is not None)
    alone = without_adjustment(machine, errors.replace(metadata=metadata), np.zeros(1), "stated", "no reading shows it")
    known, posterior = _with_prior(machine, parts, alone, plain)
    volume = None if posterior is None else volume_of(machine, posterior)
    return GaugePlan(machine, gauges, lengths, count, freedom, solution, known, posterior, volume)


def _with_prior(
    machine: Machine, parts: Sequence[Source], alone: Identification, options: IdentifyOptions
) -> tuple[ErrorTable, Posterior | None]:
    """The errors that identification would list, with their uncertainties, and the posterior; values are zero."""
    nothing = alone.errors.only()
    if not alone.errors.names:  # identification refuses such readings
        return nothing, None if machine.prior.is_none else unmeasured(machine)
    try:
        found = with_prior(machine, parts, replace(alone, method="together"), options)
    except UndeterminedError:
        return nothing, unmeasured(machine)
    return found.errors.with_values(np.zeros(len(found.errors.values()))), found.posterior


def _count(part: Source) -> int:
    """Number of readings of a part, without calibration data."""
    measured = part.measurement
    if isinstance(measured, Artefact):
        return int(np.isfinite(measured.measured_mm).sum())
    assert isinstance(measured, Circles | Lengths)
    return len(measured)


def _source(machine: Machine, gauge: Gauge) -> Source:
    """What a gauge reads, with the uncertainty that identification would find."""
    readings = perfect_readings(machine, gauge)
    if isinstance(readings, Artefact):
        return Source("", readings, None)
    u_mm = gauge.noise_um * MM_PER_UM or CIRCLE_NOISE_UM * MM_PER_UM
    # readings with any scatter give the weights; the covariance is that of the expected scatter
    scatter = u_mm * np.random.default_rng(0).standard_normal(len(readings))
    alone = identify_circles(machine, replace(readings, deviation_mm=scatter))
    assert alone.values_factor is not None
    expected_um = _scatter_um(machine, readings, u_mm)
    factor = alone.values_factor * (expected_um / alone.u_length_um)
    return Source("", readings, replace(alone, values_factor=factor, u_length_um=expected_um))


def _scatter_um(machine: Machine, circles: Circles, u_mm: float) -> float:
    """Standard uncertainty of a reading that identification will find in the residuals of circles, um.

    Noise, and what guides as bent as the prior has them leave: from machines drawn from it. Without a prior the noise.
    """
    if machine.prior.is_none:
        return u_mm / MM_PER_UM
    position_mm = circles.centre_mm + circles.radius_mm[:, None] * circles.radial()
    moved = np.einsum("knd,nd->kn", unmeasured(machine).field(position_mm).draws(DRAWN, 1), circles.radial())
    noise = u_mm * np.random.default_rng(1).standard_normal(moved.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        found = [identify_circles(machine, replace(circles, deviation_mm=row)).u_length_um for row in moved + noise]
    return float(np.sqrt(np.mean(np.square(found))))


# What to add: each candidate is planned as well.


#: Number of additions that are listed, and of errors that each is said to reduce.
MOST_ADDITIONS, MOST_NAMES = 3, 5
#: Machines that are drawn from the prior for the scatter of circles.
DRAWN = 8
#: Radii of circles to add, mm, the largest that fits first.
RADII_MM = (300.0, 200.0, 150.0, 100.0, 50.0)
#: An addition is useful if it lowers u of the field (without a prior: of the errors, on average) to this share.
USEFUL = 0.97


@dataclass(frozen=True)
class _More:
    """A pose or circle that could be added: in words, as an option, and all gauges with it."""

    text: str
    option: str
    gauges: tuple[Gauge, ...]


def _additions(setting: _Setting, found: GaugePlan) -> tuple[Addition, ...]:
    """The most useful poses and circles in addition, best first: by u of the field, without a prior by what they determine."""
    candidates = [*_more_poses(found), *_more_circles(found)]
    if found.posterior is not None:
        said: dict[Gauge, Information] = {}
        rated = [(_u_with(setting, found.posterior, item, said), item) for item in candidates]
        least = USEFUL * (found.volume.rms_um if found.volume else np.inf)
        rated.sort(key=lambda pair: pair[0])
        candidates = [item for u_um, item in rated if u_um < least][:MOST_ADDITIONS]
    judged = [addition for item in candidates if (addition := _judged(setting, found, item)) is not None]
    if found.posterior is not None:
        return tuple(sorted(judged, key=lambda item: item.u_after_um or 0.0))
    judged.sort(key=lambda item: (-len(item.adds), item.u_ratio))
    # the last one is what lowers the uncertainties most
    chosen = [*judged[: MOST_ADDITIONS - 1], *sorted(judged[MOST_ADDITIONS - 1 :], key=lambda item: item.u_ratio)[:1]]
    return tuple(chosen)


def _more_poses(found: GaugePlan) -> Iterator[_More]:
    """Every artefact turned, shifted, at the ends of the travel, upright."""
    from scipy.spatial.transform import Rotation  # imported here: slow to load

    for k, gauge in enumerate(found.gauges):
        if isinstance(gauge, Ballbar):
            continue
        base = gauge.poses[0]
        lies = Rotation.from_rotvec(base.rotation_deg, degrees=True)
        for text, turn_deg, shift_mm in _moves(found.machine, gauge, lies.as_matrix()):
            turned = (Rotation.from_rotvec(turn_deg, degrees=True) * lies).as_rotvec(degrees=True)
            x, y, z = (np.array(base.origin_mm) + shift_mm).tolist()
            a, b, c = np.round(turned, 6).tolist()
            pose = PlatePose((x, y, z), (a, b, c))
            if pose in gauge.poses:
                continue
            numbers = [x, y, z, *((c,) if not a and not b else (a, b, c))]
            option = f"--pose {','.join(f'{value:g}' for value in (numbers if a or b or c else numbers[:3]))}"
            more = replace(gauge, poses=(*gauge.poses, pose))
            yield _More(text, option, (*found.gauges[:k], more, *found.gauges[k + 1 :]))


def _moves(
    machine: Machine, gauge: TouchProbe, lies: FloatArray
) -> Iterator[tuple[str, tuple[float, float, float], FloatArray]]:
    """Turns (degrees) and shifts (mm) of an artefact from its first pose, in words."""
    for angle in (90, 180, 270):
        yield f"turned by {angle} degrees", (0.0, 0.0, float(angle)), np.zeros(3)
    base = gauge.poses[0]
    half_mm = 0.5 * (np.array([gauge.columns, gauge.rows, gauge.layers]) - 1) * np.array(gauge.pitch_mm)
    for axis in range(3):
        reach_mm = float(np.abs(lies)[axis] @ half_mm)
        low_mm, high_mm = machine.axes[axis].range_mm
        ends = (low_mm + reach_mm + 1.0, high_mm - reach_mm - 1.0)
        shifts = [(f"shifted by one pitch in {AXES[axis]}", gauge.pitch_mm[axis])] if axis < 2 else []
        shifts += [(f"at {AXES[axis]} {end:.0f}", float(np.round(end)) - base.origin_mm[axis]) for end in ends]
        for text, by_mm in shifts:
            yield text, (0.0, 0.0, 0.0), np.eye(3)[axis] * by_mm
    if len(gauge.components) == 3:
        yield "upright in ZX", (90.0, 0.0, 0.0), np.zeros(3)
        yield "upright in YZ", (0.0, 90.0, 0.0), np.zeros(3)


def _more_circles(found: GaugePlan) -> Iterator[_More]:
    """A circle in every plane that has none."""
    drawn = {plane for gauge in found.gauges if isinstance(gauge, Ballbar) for plane in gauge.planes}
    for plane in sorted({0, 1, 2} - drawn):
        name, axes = list(PLANES)[plane], list(PLANES.values())[plane]
        room_mm = 0.5 * min(np.ptp(found.machine.axes[k].range_mm) for k in axes)
        radius_mm = next((radius for radius in RADII_MM if radius < room_mm), None)
        if radius_mm is not None:
            ballbar = Ballbar((plane,), radius_mm, noise_um=CIRCLE_NOISE_UM)
            text = f"a circle in {name}, radius {radius_mm:g} mm"
            yield _More(text, f"--circle {name}:{radius_mm:g}", (*found.gauges, ballbar))


def _u_with(setting: _Setting, posterior: Posterior, more: _More, said: dict[Gauge, Information]) -> float:
    """Return u of the field, rms, um, with a pose or circle in addition; infinite if it leaves the travel.

    ``said`` keeps what each gauge says about the state of the posterior.
    """
    layout, new = posterior.layout, [gauge for gauge in more.gauges if gauge not in said]
    try:
        parts, start = setting.sources(new), np.zeros(layout.size)
        readings = [part.readings(setting.machine, layout, setting.options, start) for part in parts]
    except (InputError, UndeterminedError):
        return np.inf
    found = [Information.of(item) for item in readings]
    said |= dict(zip(new, found, strict=False))  # behind the gauges: the tracer
    whole = with_information(posterior, [*(said[gauge] for gauge in more.gauges), *found[len(new) :]])
    return volume_of(setting.machine, whole, FEW_POINTS).rms_um


def _judged(setting: _Setting, found: GaugePlan, item: _More) -> Addition | None:
    """What a pose or circle brings; None if it is not useful."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            more = _predicted(setting, item.gauges)
        except InputError:  # it leaves the travel
            return None
    adds = tuple(name for name in more.whole if name not in found.whole)
    before, after = (
        {name: row["u_max"] for name, row in plan.uncertainties().items() if row["u_max"]} for plan in (found, more)
    )
    ratios = {name: after[name] / before[name] for name in before if name in after}
    determined = [ratios[name] for name in found.whole if name in ratios]
    ratio = float(np.exp(np.mean(np.log(determined)))) if determined else 1.0
    if found.posterior is None and not adds and ratio >= USEFUL:
        return None
    less = sorted((name for name, value in ratios.items() if value < 1.0 - REDUCED), key=lambda name: ratios[name])
    return Addition(
        item.text, item.option, adds, tuple(less), ratio, None if more.volume is None else more.volume.rms_um
    )


# What the gauges would show on a machine with known errors: arrows on the artefact, the polar diagram of the circle.
#
# To first order the picture is the sum of what each error shows alone: the page adds them with the factors of its sliders.


#: Errors that the page begins with if none are known: positioning and straightness in um, angles and squareness in urad.
USUAL_UM, USUAL_URAD = 5.0, 20.0
#: What an error shows below this, um, is not listed.
VISIBLE_UM = 0.01
#: Picture and its part for the drawing.
SIZE, BOX = (250.0, 250.0), (13.0, 10.0, 237.0, 234.0)
#: Share of the radius of the picture at which the nominal circle is drawn, and that of the largest deviation.
NOMINAL, FARTHEST = 0.54, 0.27
#: The smallest scale of a picture, um.
LEAST_STEP_UM = 0.1
#: Length of the longest arrow as a share of the distance of neighbouring features.
LONGEST = 0.7


def usual_errors(machine: Machine) -> ErrorTable:
    """Errors of ordinary size: scales and angles that grow along the axis, bows of the guides, squareness."""
    curves = {}
    names = modelled_errors(machine)
    for name in names:
        error = error_named(name)
        if error.kind == "squareness":
            continue
        low, high = machine.axes[error.axis].range_mm
        at = np.linspace(low, high, 9)
        share = (at - 0.5 * (low + high)) / (0.5 * (high - low))
        shape = 1.0 - share**2 if error.is_straightness else share
        size = USUAL_URAD if error.kind == "angular" else USUAL_UM
        curves[name] = Curve(at, size * error.si_per_unit * shape, np.zeros(9))
    squareness = {name: (USUAL_URAD * 1e-6, 0.0) for name in names if error_named(name).kind == "squareness"}
    return ErrorTable(curves, squareness, {"source": "usual sizes"})


@dataclass(frozen=True)
class Shown:
    """One set-up of an artefact or one circle: title, its plane, places and what each error shows there.

    ``place_mm`` (n, 2) are machine coordinates in the two axes ``axes``; for a circle angle_rad (n,) counts instead.
    ``responses_um`` by error: (n, 2) in these axes for an artefact, (n,) along the radius for a circle.
    """

    title: str
    axes: tuple[int, int]
    place_mm: FloatArray
    responses_um: dict[str, FloatArray]
    angle_rad: FloatArray | None = None


def shown_by(machine: Machine, gauge: Gauge, errors: ErrorTable) -> list[Shown]:
    """Return what each error of a table shows alone, in every set-up of a gauge, to first order.

    The probe finds a feature where the axes have moved by minus the error; the position and rotation of the artefact that
    fit best are taken off. Of a circle the centre that fits best is taken off.
    """
    readings = perfect_readings(machine, gauge)
    found = []
    if isinstance(readings, Circles):
        for plane in np.unique(readings.plane).tolist():
            rows = np.flatnonzero((readings.plane == plane) & (readings.direction == readings.direction[0]))
            own = readings.part(rows)
            own = own.part(np.argsort(own.angle_rad))
            position_mm = own.centre_mm + own.radius_mm[:, None] * own.radial()
            centre = np.column_stack([np.cos(own.angle_rad), np.sin(own.angle_rad)])
            responses = {}
            for name in errors.names:
                moved = volumetric_error(machine, errors.only(name), np.vstack([position_mm, own.centre_mm[:1]]))
                radial = np.einsum("nd,nd->n", own.radial(), moved[:-1] - moved[-1])
                responses[name] = (radial - centre @ np.linalg.lstsq(centre, radial, rcond=None)[0]) / MM_PER_UM
            axes = list(PLANES.values())[plane]
            name = list(PLANES)[plane]
            title = f"Circle {name}, radius {own.radius_mm[0]:g} mm"
            found.append(Shown(title, axes, position_mm[:, axes], responses, own.angle_rad))
        return found
    for setup in np.unique(readings.setup).tolist():
        rows = readings.setup == setup
        place_mm = np.where(
            np.isfinite(readings.measured_mm[rows]), readings.measured_mm[rows], readings.nominal_mm[rows]
        )
        first, second = sorted(np.argsort(-np.ptp(place_mm, axis=0), kind="stable")[:2].tolist())
        responses = {}
        for name in errors.names:
            seen_mm = -volumetric_error(machine, errors.only(name), place_mm)
            seen_mm[:, ~np.isfinite(readings.measured_mm[rows]).any(axis=0)] = 0.0
            responses[name] = without_rigid_motion(place_mm, seen_mm)[:, [first, second]] / MM_PER_UM
        title = f"Pose {setup + 1}: {AXES[first]} to the right, {AXES[second]} up"
        found.append(Shown(title, (first, second), place_mm[:, [first, second]], responses))
    return found


def _drawing(shown: Shown, key: str, sum_um: FloatArray) -> tuple[Picture, dict[str, Any]]:
    """The picture of the sum of all responses, and what the script of the page needs to draw it with other factors."""
    left, top, right, bottom = BOX
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
    if shown.angle_rad is not None:
        half = 0.5 * (right - left)
        step = ticks(0.0, max(float(np.abs(sum_um).max()), LEAST_STEP_UM), 1, around=True)[-1]
        per_um = FARTHEST * half / step
        plot = Plot((-1.0, 1.0), (-1.0, 1.0), BOX, bare=True)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        for level, role, width in ((-1, "grid", 0.6), (0, "muted", 1.1), (1, "grid", 0.6)):
            ring = NOMINAL + level * FARTHEST
            plot.line(ring * np.cos(turn), ring * np.sin(turn), role, width=width)
        for axis, (x, y) in zip(shown.axes, ((1, 0), (0, 1)), strict=True):
            plot.text(0.93 * x, 0.93 * y, f"+{AXES[axis]}", anchor="middle", shift=(0.0, 3.0))
        start = len(plot.drawn)
        for level in (-1, 1):
            at = (NOMINAL + level * FARTHEST) * np.sqrt(0.5)
            plot.text(at, at, f"{level * step:+g} µm".replace("-", "−"), shift=(2.0, -2.0))
        plot.layer("scale", start)
        start = len(plot.drawn)
        radius = NOMINAL + sum_um * per_um / half
        closed = np.append(np.arange(len(radius)), 0) if np.ptp(shown.angle_rad) > np.radians(350) else slice(None)
        plot.line(
            (radius * np.cos(shown.angle_rad))[closed], (radius * np.sin(shown.angle_rad))[closed], "c0", width=1.8
        )
        plot.layer("shown", start)
        data = {
            "circle": rounded(np.degrees(shown.angle_rad), 6),
            "middle": middle.tolist(),
            "radius": NOMINAL * half,
            "step": FARTHEST * half,
            "closed": not isinstance(closed, slice),
        }
        note = "deviation of the radius, enlarged"
    else:
        span = np.ptp(shown.place_mm, axis=0)
        centre = 0.5 * (shown.place_mm.min(axis=0) + shown.place_mm.max(axis=0))
        half = 0.68 * float(span.max()) or 1.0
        plot = Plot((-half, half), (-half, half), BOX, bare=True)
        x, y = (shown.place_mm - centre).T
        gaps = np.linalg.norm(shown.place_mm[:, None] - shown.place_mm[None], axis=2)
        pitch_mm = float(np.min(gaps[gaps > 1e-6], initial=2.0 * half))
        step = ticks(0.0, max(float(np.linalg.norm(sum_um, axis=1).max()), LEAST_STEP_UM), 1, around=True)[-1]
        mm_per_um = LONGEST * pitch_mm / step
        plot.dots(x, y, "muted", size=3.0)
        plot.line([-0.95 * half, -0.95 * half + step * mm_per_um], [-0.88 * half] * 2, "ink", width=1.6)
        start = len(plot.drawn)
        plot.text(-0.95 * half, -0.88 * half, f"{step:g} µm", shift=(0.0, 11.0))
        plot.layer("scale", start)
        start = len(plot.drawn)
        for (px, py), (dx, dy) in zip(np.column_stack([x, y]).tolist(), (sum_um * mm_per_um).tolist(), strict=True):
            plot.line(*_arrow(px, py, dx, dy), "c1", width=1.4)
        plot.layer("shown", start)
        scale = (right - left) / (2.0 * half)
        data = {
            "arrows": rounded(np.column_stack([middle[0] + x * scale, middle[1] - y * scale]), 5),
            "step": LONGEST * pitch_mm * scale,
        }
        note = "arrows: measured minus nominal coordinates; scale at the lower left"
    data["responses"] = {name: rounded(values, 4) for name, values in shown.responses_um.items()}
    drawn = svg(key, shown.title, [plot], SIZE)
    return Picture(key, shown.title, drawn, note=note), data


def _arrow(x: float, y: float, dx: float, dy: float) -> tuple[list[float], list[float]]:
    """Shaft and head of an arrow as one line: points x and y."""
    ends = [(x, y), (x + dx, y + dy)]
    for side in (1.0, -1.0):
        ends += [(x + 0.75 * dx - side * 0.12 * dy, y + 0.75 * dy + side * 0.12 * dx), (x + dx, y + dy)]
    return [end[0] for end in ends], [end[1] for end in ends]


def plan_page(found: GaugePlan, errors: ErrorTable | None = None) -> str:
    """Return the text of ``plan.html``: what the gauges show for given errors, with a slider for each, and the plan.

    Without ``errors`` the page begins with those of :func:`usual_errors`. It needs no server and loads nothing.
    """
    table = errors or usual_errors(found.machine)
    table = table.only(*modelled_errors(found.machine))
    views = [view for gauge in found.gauges for view in shown_by(found.machine, gauge, table)]
    visible = [
        name
        for name in table.names
        if any(float(np.abs(view.responses_um[name]).max(initial=0.0)) > VISIBLE_UM for view in views)
    ]
    pictures, data = [], {}
    for k, view in enumerate(views):
        total = (
            np.sum([view.responses_um[name] for name in visible], axis=0) if visible else np.zeros_like(view.place_mm)
        )
        only = replace(view, responses_um={name: view.responses_um[name] for name in visible})
        picture, data[f"view-{k}"] = _drawing(only, f"view-{k}", np.asarray(total, dtype=np.float64))
        pictures.append(picture)
    planned, rows = found.uncertainties(), []
    for name in visible:
        error = error_named(name)
        values = (table.squareness[name][0],) if name in table.squareness else table.curves[name].value
        size = float(np.abs(values).max()) / error.si_per_unit
        unit = error.unit.replace("u", "µ", 1)
        state = {"determined": "", "partly": " (shown in part)", "assumed": " (assumed, not shown)"}
        u_max = planned.get(name, {}).get("u_max")
        u = "–" if u_max is None else f"± {u_max:.2g} {unit}{state[planned[name]['state']]}"
        rows.append(
            f'<tr><th scope="row"><label for="slider-{name}">{name}</label></th><td>{size:.4g} {unit}</td>'
            f'<td class="needs-script"><input type="range" id="slider-{name}" data-error="{name}" min="-200" max="200" '
            'value="100"> '
            f'<output for="slider-{name}">100 %</output></td><td class="needs-script"><button type="button" data-only="{name}">'
            f"only</button></td><td>{u}</td></tr>"
        )
    hidden = [name for name in table.names if name not in visible]
    said = "known errors" if errors is not None else "usual sizes, because no errors were given (--errors FILE)"
    lines = [f"{item.text}: {item.effect} ({item.option})" for item in found.additions]
    parts = [
        f"<h1>What these gauges show on {escape(found.machine.name)}</h1>",
        f"<p>{escape('; '.join(_described(gauge) for gauge in found.gauges))}. Errors: {escape(said)}. "
        "The pose or centre that fits best is taken off; to first order.</p>",
        picture_grid(pictures),
        '<h2>Errors</h2><p class="needs-script"><button type="button" data-all="100">all as given</button> '
        '<button type="button" data-all="0">all zero</button></p>',
        '<div class="scroll"><table><tr><th>error</th><th>largest</th><th class="needs-script">share</th>'
        '<th class="needs-script"></th><th>u of this plan</th></tr>' + "".join(rows) + "</table></div>",
        f"<p>Not visible here: {', '.join(hidden)}.</p>" if hidden else "",
        f"<p>Not shown by this plan: {', '.join(found.left_out)}.</p>" if found.left_out else "",
        f"<p>{escape(_capital(volume_text(found)))}.</p>" if found.volume else "",
        "<h2>What to add</h2><ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else "",
    ]
    style, script, policy = page_assets("gauges.js")
    payload = json_text(data).replace("<", "\\u003c")
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(found.machine.name)}: plan</title><style>{style}</style>"
    body = "\n".join(parts)
    body += f'\n<script type="application/json" id="data">{payload}</script>\n<script>{script}</script>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n{body}</body></html>\n'
