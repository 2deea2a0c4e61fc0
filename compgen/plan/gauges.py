"""What artefacts under the machine's probe and circles (ballbar) will determine, and what they would show."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np

from compgen.data.charts import Picture, Plot, page_assets, picture_grid, rounded, svg, ticks
from compgen.data.circles import PLANES, Circles
from compgen.data.comparison import without_rigid_motion
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.display import Displayed, Overview
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.files import json_text
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.identify.adjust.determined import Determined
from compgen.identify.adjust.unknowns import error_parameters
from compgen.identify.axis_tests import identify_circles
from compgen.identify.covariance import values_with_factor
from compgen.identify.options import IdentifyOptions
from compgen.identify.together import Source, solve_together
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import modelled_errors
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import volumetric_error
from compgen.simulate.gauges import CIRCLE_NOISE_UM, Ballbar, PlatePose, TouchProbe
from compgen.simulate.trajectory import Stops

Gauge = TouchProbe | Ballbar

# Readings of a perfect machine, and the adjustment that a measurement would get.


@dataclass(frozen=True)
class Addition:
    """A pose or circle to add: in words, as an option, errors that it adds, and the mean ratio of uncertainties."""

    text: str
    option: str
    adds: tuple[str, ...]
    u_ratio: float

    @property
    def effect(self) -> str:
        """What it brings, in words."""
        adds = f"determines {', '.join(self.adds)}" if self.adds else ""
        ratio = f"the others {self.u_ratio:.2f} times as uncertain" if self.u_ratio < 0.995 else ""
        return "; ".join(part for part in (adds, ratio) if part)

    def summary(self) -> dict[str, Any]:
        """Return the entry of ``additions`` in ``plan.json``."""
        return {"what": self.text, "option": self.option, "adds": list(self.adds), "u_ratio": self.u_ratio}


@dataclass(frozen=True, repr=False)
class GaugePlan(Displayed):
    """What a planned measurement with gauges determines.

    Parameters
    ----------
    machine, gauges : the machine, its gauges, and planned tracer lengths, if any.
    lengths : planned tracer lengths, or None.
    readings, freedom : number of readings, without calibration data, and degrees of freedom.
    solution : the adjustment; None if it determines no error.
    errors : errors that are determined, with values of zero and the predicted standard uncertainties.
    additions : what to measure in addition, the most useful first.
    """

    machine: Machine
    gauges: tuple[Gauge, ...]
    lengths: Lengths | None
    readings: int
    freedom: int
    solution: Determined | None
    errors: ErrorTable
    additions: tuple[Addition, ...] = ()

    @property
    def whole(self) -> tuple[str, ...]:
        """Errors that the measurement determines."""
        return tuple(name for name in self.errors.names if name not in self.partly)

    @property
    def partly(self) -> tuple[str, ...]:
        """Errors of which a part cannot be separated from poses, the artefact or other errors."""
        return self.solution.partly if self.solution else ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Errors of the machine's model that the readings do not show, or not separately from others."""
        return tuple(name for name in modelled_errors(self.machine) if name not in self.errors.names)

    @property
    def within_circles(self) -> str:
        """A note on squareness by circles, empty without circles."""
        circles = any(isinstance(gauge, Ballbar) for gauge in self.gauges)
        return "squareness by circles is that within the circle, unless straightness is determined" if circles else ""

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``plan.json``."""
        largest, empty = {}, self.solution.unreached if self.solution else {}
        for name in self.errors.names:
            error = error_named(name)
            if name in self.errors.squareness:
                at_mm, u = np.full(1, np.nan), np.array([self.errors.squareness[name][1]])
            else:
                at_mm, u = self.errors.curves[name].position_mm, self.errors.curves[name].u
            read = ~np.isin(at_mm, empty.get(name, []))
            worst = int(np.argmax(u))
            largest[name] = {
                "unit": error.unit,
                "u_max": float(u[worst]) / error.si_per_unit,
                "at_mm": None if np.isnan(at_mm[worst]) else float(at_mm[worst]),
                "u_max_where_read": float(u[read].max()) / error.si_per_unit if read.any() else None,
            }
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
            "u": largest,
            "nodes_without_data": {name: at.tolist() for name, at in found.unreached.items()} if found else {},
            "additions": [item.summary() for item in self.additions],
        }

    def overview(self) -> Overview:
        """Largest uncertainty of each error."""
        rows = tuple(
            (name, f"{item['u_max']:.3g}", str(item["unit"]), "partly" if name in self.partly else "")
            for name, item in self.summary()["u"].items()
        )
        return Overview(
            f"plan: {len(self.whole)} errors from {self.readings} readings", ("error", "u", "unit", ""), rows
        )


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
    lengths : readings of a perfect machine, see :func:`compgen.plan.prediction.planned`.
    options : the uncertainty of lengths.
    additions : whether to look for poses and circles to add.

    Raises
    ------
    InputError
        for a feature or a circle outside the travel.
    """
    with one_thread():
        found = _predicted(machine, tuple(gauges), lengths, options or IdentifyOptions())
        return replace(found, additions=_additions(found, options or IdentifyOptions())) if additions else found


def _predicted(
    machine: Machine, gauges: tuple[Gauge, ...], lengths: Lengths | None, options: IdentifyOptions
) -> GaugePlan:
    parts, count = [], 0
    for k, gauge in enumerate(gauges):
        readings = perfect_readings(machine, gauge)
        if isinstance(readings, Artefact):
            parts.append(Source(f"artefact {k}", readings, None))
            count += int(np.isfinite(readings.measured_mm).sum())
        else:
            # readings with any scatter give the weights; the covariance is that of the stated noise
            u_mm = gauge.noise_um * MM_PER_UM or CIRCLE_NOISE_UM * MM_PER_UM
            scatter = u_mm * np.random.default_rng(k).standard_normal(len(readings))
            alone = identify_circles(machine, replace(readings, deviation_mm=scatter))
            assert alone.values_factor is not None
            factor = alone.values_factor * (u_mm / (alone.u_length_um * MM_PER_UM))
            alone = replace(alone, values_factor=factor, u_length_um=u_mm / MM_PER_UM)
            parts.append(Source(f"circles {k}", readings, alone))
            count += len(readings)
    if lengths is not None:
        parts.append(Source("lengths", lengths, None))
        count += len(lengths)
    layout = error_parameters(machine, modelled_errors(machine))
    metadata = {"machine": machine.name, "source": "compgen plan", "values": "zero, only u_value is predicted"}
    try:
        _, solution, _ = solve_together(machine, layout, parts, replace(options, reject=False))
    except UndeterminedError:
        return GaugePlan(machine, gauges, lengths, count, 0, None, ErrorTable({}, {}, metadata))
    errors, _ = values_with_factor(solution.layout, np.zeros(solution.layout.size), solution.factor)
    freedom = solution.freedom + sum(part.alone.degrees_of_freedom for part in parts if part.alone is not None)
    return GaugePlan(machine, gauges, lengths, count, freedom, solution, errors.replace(metadata=metadata))


# What to add: each candidate is planned as well.


#: Number of additions that are listed.
MOST_ADDITIONS = 3
#: Radii of circles to add, mm, the largest that fits first.
RADII_MM = (300.0, 200.0, 150.0, 100.0, 50.0)
#: An addition is useful if it lowers the uncertainties to this share on average.
USEFUL = 0.95


def _additions(found: GaugePlan, options: IdentifyOptions) -> tuple[Addition, ...]:
    """The most useful poses and circles in addition, best first: by the errors that they add, then the uncertainties."""
    from scipy.spatial.transform import Rotation  # imported here: slow to load

    machine, before = found.machine, {name: item["u_max"] for name, item in found.summary()["u"].items()}
    candidates: list[tuple[str, str, tuple[Gauge, ...]]] = []
    for k, gauge in enumerate(found.gauges):
        if isinstance(gauge, Ballbar):
            continue
        base, others = gauge.poses[0], (found.gauges[:k], found.gauges[k + 1 :])
        lies = Rotation.from_rotvec(base.rotation_deg, degrees=True)
        steps = [(f"turned by {angle} degrees", (0.0, 0.0, float(angle)), np.zeros(3)) for angle in (90, 180, 270)]
        for axis in range(3):
            half_mm = 0.5 * (np.array([gauge.columns, gauge.rows, gauge.layers]) - 1) * np.array(gauge.pitch_mm)
            reach_mm = float(np.abs(lies.as_matrix())[axis] @ half_mm)
            low_mm, high_mm = machine.axes[axis].range_mm
            ends = (low_mm + reach_mm + 1.0, high_mm - reach_mm - 1.0)
            shifts = [(f"shifted by one pitch in {AXES[axis]}", gauge.pitch_mm[axis])] if axis < 2 else []
            shifts += [(f"at {AXES[axis]} {end:.0f}", float(np.round(end)) - base.origin_mm[axis]) for end in ends]
            steps += [(text, (0.0, 0.0, 0.0), np.eye(3)[axis] * by_mm) for text, by_mm in shifts]
        if len(gauge.components) == 3:
            steps += [
                ("upright in ZX", (90.0, 0.0, 0.0), np.zeros(3)),
                ("upright in YZ", (0.0, 90.0, 0.0), np.zeros(3)),
            ]
        for text, turn_deg, shift_mm in steps:
            turned = (Rotation.from_rotvec(turn_deg, degrees=True) * lies).as_rotvec(degrees=True)
            x, y, z = (np.array(base.origin_mm) + shift_mm).tolist()
            a, b, c = np.round(turned, 6).tolist()
            pose = PlatePose((x, y, z), (a, b, c))
            if pose in gauge.poses:
                continue
            numbers = [x, y, z, *((c,) if not a and not b else (a, b, c))]
            option = f"--pose {','.join(f'{value:g}' for value in (numbers if a or b or c else numbers[:3]))}"
            candidates.append((text, option, (*others[0], replace(gauge, poses=(*gauge.poses, pose)), *others[1])))
    drawn = {plane for gauge in found.gauges if isinstance(gauge, Ballbar) for plane in gauge.planes}
    for plane in sorted({0, 1, 2} - drawn):
        room_mm = 0.5 * min(np.ptp(machine.axes[k].range_mm) for k in list(PLANES.values())[plane])
        fitting = [radius for radius in RADII_MM if radius < room_mm]
        if fitting:
            name = list(PLANES)[plane]
            ballbar = Ballbar((plane,), fitting[0], noise_um=CIRCLE_NOISE_UM)
            text = f"a circle in {name}, radius {fitting[0]:g} mm"
            candidates.append((text, f"--circle {name}:{fitting[0]:g}", (*found.gauges, ballbar)))
    judged = []
    for text, option, gauges in candidates:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            try:
                more = _predicted(machine, gauges, found.lengths, options)
            except InputError:  # it leaves the travel
                continue
        adds = tuple(name for name in more.whole if name not in found.whole)
        after = {name: item["u_max"] for name, item in more.summary()["u"].items()}
        ratios = [after[name] / before[name] for name in found.whole if name in after and before[name] > 0]
        ratio = float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0
        if adds or ratio < USEFUL:
            judged.append(Addition(text, option, adds, ratio))
    judged.sort(key=lambda item: (-len(item.adds), item.u_ratio))
    # the last one is what lowers the uncertainties most
    chosen = [*judged[: MOST_ADDITIONS - 1], *sorted(judged[MOST_ADDITIONS - 1 :], key=lambda item: item.u_ratio)[:1]]
    return tuple(chosen)


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
    planned, rows = found.summary()["u"], []
    for name in visible:
        error = error_named(name)
        values = (table.squareness[name][0],) if name in table.squareness else table.curves[name].value
        size = float(np.abs(values).max()) / error.si_per_unit
        unit = error.unit.replace("u", "µ", 1)
        u = (
            f"± {planned[name]['u_max']:.2g} {unit}{' (partly separable)' if name in found.partly else ''}"
            if name in planned
            else "–"
        )
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
        f"<p>Not determined by this plan: {', '.join(found.left_out)}.</p>" if found.left_out else "",
        "<p>Squareness by circles is that within the circle, unless straightness is determined.</p>"
        if found.within_circles
        else "",
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
