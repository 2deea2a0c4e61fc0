"""Errors from tests of one or two axes: runs along single axes (ISO 230-2), and circles (ballbar, ISO 230-4)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import POSITIONING, SAME_TARGET_MM, AxisRuns, two_way_mean, worth_a_table
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import SIGNIFICANT, WORTH_MM, Curve, ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError, Message, UndeterminedError
from compgen.identification.adjust.determined import FINEST, USUAL_U, Observations
from compgen.identification.adjust.unknowns import ErrorParameters, check_axis_travel, check_travel
from compgen.identification.posterior import processes_of, root_of
from compgen.identification.result import (
    Identification,
    metadata_of,
    without_adjustment,
)
from compgen.kinematics.first_order import c_matrix, coefficients


def positioning_errors(
    runs: AxisRuns, metadata: Mapping[str, str]
) -> tuple[ErrorTable, ReversalCurves | None, FloatArray]:
    """Return EXX, EYY, EZZ of the axes that were measured, their reversals, and the residuals (n,), mm."""
    curves, reversals = {}, {}
    residual = np.zeros(len(runs))
    for axis in runs.axes:
        rows = runs.axis == axis
        readings = runs.position_mm[rows], runs.direction[rows], runs.deviation_mm[rows]
        curves[POSITIONING[axis]], reversal, residual[rows] = two_way_mean(*readings)
        if reversal is not None and worth_a_table(reversal):
            reversals[axis, axis] = reversal
    table = ErrorTable(curves, {}, dict(metadata))
    return table, ReversalCurves(reversals, dict(metadata)) if reversals else None, residual


def identify_axis_runs(machine: Machine, runs: AxisRuns) -> Identification:
    """Take the positioning errors of the measured axes from their runs; the runs show no other errors.

    The curves are zero at the reference point, as in every identification; the details state the subtracted offset.

    Raises
    ------
    InputError
        for targets outside the travel.
    """
    check_axis_travel(machine, runs.axis, runs.position_mm, runs.origin)
    raw, reversal, residual = positioning_errors(runs, metadata_of(machine, runs.metadata))
    # the zero of the laser is arbitrary: each curve is zero at the machine's reference point
    offsets = {
        name: float(np.interp(machine.reference_point_mm[axis], raw.curves[name].position_mm, raw.curves[name].value))
        for axis, name in ((axis, POSITIONING[axis]) for axis in runs.axes)
    }
    curves = raw.curves
    errors = raw.replace(
        curves={
            name: Curve(curves[name].position_mm, curves[name].value - offset, curves[name].u)
            for name, offset in offsets.items()
        }
    )
    letters = ", ".join(AXES[axis] for axis in runs.axes)
    warnings.warn(
        Message(
            "runs-show-positioning",
            "positioning runs of {letters} show {names} along the line that was measured; "
            "angular errors, straightness and squareness were not measured",
            letters=letters,
            names=", ".join(errors.names),
        ),
        CompgenWarning,
        stacklevel=2,
    )
    cells = {
        (a, round(p / SAME_TARGET_MM), d)
        for a, p, d in zip(runs.axis.tolist(), runs.position_mm.tolist(), runs.direction.tolist(), strict=True)
    }
    summaries = {}
    for axis in runs.axes:
        rows = runs.axis == axis
        summaries[AXES[axis]] = {
            "targets": len(np.unique(np.round(runs.position_mm[rows] / SAME_TARGET_MM))),
            "runs": len(np.unique(runs.run[rows])),
            "directions": sorted(set(runs.direction[rows].tolist())),
            "from_mm": float(runs.position_mm[rows].min()),
            "to_mm": float(runs.position_mm[rows].max()),
            "taken_off_um": offsets[POSITIONING[axis]] / MM_PER_UM,
        }
        if reversal is not None and (axis, axis) in reversal.curves:  # actual position from plus minus from minus
            summaries[AXES[axis]]["reversal_um"] = float(reversal.curves[axis, axis].value.mean()) / MM_PER_UM
    known = all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    missing = "runs along single axes do not show it"
    return replace(
        without_adjustment(machine, errors, -residual, "scatter" if known else "unknown", missing),
        degrees_of_freedom=len(runs) - len(cells),
        reversal_curves=reversal,
        method="axis-runs",
        details={"axes": summaries},
    )


#: Standard uncertainties of the scale of a laser, per mm, and of temperatures that were read with it, or were not, K.
U_LASER, U_READ_K, U_NOT_READ_K = 1.5e-6, 0.05, 0.3
#: Expansion of a machine whose file states none, per K.
USUAL_EXPANSION = 11.5e-6


def temperatures_read(runs: AxisRuns) -> bool:
    """Whether the temperature of every axis, or of the material, was read: that of a spindle or the air is another one."""
    of_axes = all(f"temp_{AXES[axis].lower()}_c" in runs.covariates for axis in runs.axes)
    return of_axes or any(name.startswith(("temp_material", "temp_measured")) for name in runs.covariates)


def u_scale_of(machine: Machine, runs: AxisRuns) -> float:
    """Standard uncertainty of the scale of axis runs, per mm: of the laser, and of the temperature."""
    expansion = np.mean([axis.expansion_um_per_m_k or 1e6 * USUAL_EXPANSION for axis in machine.axes]) * 1e-6
    read = temperatures_read(runs)
    return float(np.hypot(U_LASER, expansion * (U_READ_K if read else U_NOT_READ_K)))


def _unstated_lever(machine: Machine, name: str, axis: int, unknown: Sequence[int]) -> float:
    """Mean square, mm^2, of the levers of an angle on a run of an axis along a line of which positions are unknown."""
    terms = coefficients(machine.chain, machine.squareness_reference)
    levers = {term.lever for term in terms if term.error == name and term.output == axis}
    travels = [axis_of.range_mm for lever, axis_of in enumerate(machine.axes) if lever in levers and lever in unknown]
    return sum(float(np.mean(np.square(np.linspace(*travel, 101)))) for travel in travels)


def unstated_lines(machine: Machine, runs: AxisRuns) -> dict[int, tuple[float, tuple[str, ...]]]:
    """Return by axis what it costs that nobody said where its line was: u of the run, um, rms about its mean, and the axes.

    Empty for lines that are stated, or whose position does not matter on this chain.
    """
    found: dict[int, tuple[float, tuple[str, ...]]] = {}
    line_mm = runs.line_mm()
    for axis in runs.axes:
        rows = runs.axis == axis
        unknown = [k for k in range(3) if k != axis and np.isnan(line_mm[rows, k]).any()]
        at_mm = np.unique(runs.position_mm[rows])
        total, matter = 0.0, set[str]()
        angles = [f"E{about}{AXES[axis]}" for about in "ABC"]
        for name, process in processes_of(machine, machine.prior, angles).items():
            for lever in unknown:
                square = _unstated_lever(machine, name, axis, [lever])
                spread = process.covariance(at_mm, at_mm)
                total += square * float(np.trace(spread) / len(at_mm) - spread.mean())
                matter |= {AXES[lever]} if square else set()
        if total > 0.0:
            found[axis] = float(np.sqrt(total)) / MM_PER_UM, tuple(sorted(matter))
    return found


def axis_observations(machine: Machine, layout: ErrorParameters, runs: AxisRuns, prior: PriorSettings) -> Observations:
    """Return the means of axis runs as readings of the errors of a layout, at the lines where they were measured.

    Along a line away from the zeros of the other axes the angles move the tool as well: E = C P there. Where the file
    does not say where the line was, it may have been anywhere in the travel, so the prior of the angles, at the root mean
    square lever, adds to the noise, the same way for neighbouring targets. The zero of each line is unknown; the scale
    of the laser and the temperature are those of one instrument, so they are common to all lines.
    """
    line_mm = runs.line_mm()
    keys = np.column_stack([runs.axis, np.nan_to_num(np.where(np.eye(3)[runs.axis] > 0, 0.0, line_mm), nan=np.inf)])
    lines, of_line = np.unique(keys, axis=0, return_inverse=True)
    designs, values, sigmas, others, places, shows = [], [], [], [], [], []
    usual = USUAL_U * MM_PER_UM
    for k in range(len(lines)):
        rows = of_line.ravel() == k
        axis, letter = int(lines[k, 0]), AXES[int(lines[k, 0])]
        curve, _, _ = two_way_mean(runs.position_mm[rows], runs.direction[rows], runs.deviation_mm[rows])
        count = len(curve.value)
        at_mm = np.tile(np.where(np.isinf(lines[k, 1:]), 0.0, lines[k, 1:]), (count, 1))
        at_mm[:, axis] = curve.position_mm
        unknown = [lever for lever in range(3) if lever != axis and np.isinf(lines[k, 1 + lever])]
        base = np.where(np.isinf(lines[k, 1:]), machine.reference_point_mm, lines[k, 1:])
        everywhere = np.tile(base, (count, 1))
        everywhere[:, axis] = curve.position_mm
        columns = c_matrix(machine, at_mm)
        own = np.zeros(len(ERROR_INDEX), dtype=bool)
        own[[index for name, index in ERROR_INDEX.items() if error_named(name).axis == axis]] = True
        own[[ERROR_INDEX[name] for name in SQUARENESS_NAMES]] = False  # constant, or along the line: not in its mean
        design = layout.design(columns * own, layout.bases(everywhere))[:, axis]
        offset = [np.ones(count)]
        angles = [f"E{about}{letter}" for about in "ABC"]
        for name, process in processes_of(machine, prior, angles).items():
            square = _unstated_lever(machine, name, axis, unknown)
            if square:
                offset += list(np.sqrt(square) * root_of(process.covariance(curve.position_mm, curve.position_mm)).T)
        designs.append(design)
        values.append(curve.value)
        known = np.isfinite(curve.u)
        sigmas.append(np.where(known, np.maximum(curve.u, FINEST * MM_PER_UM), usual))
        others.append(np.column_stack(offset))
        places.append(np.where(np.arange(3) == axis, everywhere, np.nan))
        shows.append(np.tile([item.error.axis == axis for item in layout.curves], (count, 1)))
    # proper unknowns: the scale common to all, and the angles of lines nobody stated, each of unit variance
    u_scale = u_scale_of(machine, runs)
    count, width = sum(map(len, values)), 1 + sum(item.shape[1] for item in others)
    block, row, column = np.zeros((count, width)), 0, 1
    proper = np.ones(width, dtype=bool)
    for item, place in zip(others, places, strict=True):
        block[row : row + len(item), 0] = u_scale * np.nansum(place, axis=1)
        block[row : row + len(item), column : column + item.shape[1]] = item
        proper[column] = False
        row, column = row + len(item), column + item.shape[1]
    pulls = np.eye(width)[proper]
    nothing = len(pulls)
    return Observations(
        design=np.vstack([*designs, np.zeros((nothing, layout.size))]),
        others=np.vstack([block, pulls]),
        value=np.concatenate([*values, np.zeros(nothing)]),
        sigma=np.concatenate([*sigmas, np.ones(nothing)]),
        at_mm=np.vstack([*places, np.full((nothing, 3), np.nan)]),
        shows=np.vstack([*shows, np.zeros((nothing, len(layout.curves)), dtype=bool)]),
    )


# Squareness, reversal and the scales of two axes from circular tests (ballbar; ISO 230-4).
#
# The gauge reads the distance of the tool from a pivot; the pivot's position and the zero of the gauge are unknown. At
# angle t on a circle of radius R in the plane of axes 1 and 2 the deviation of the radius is
#
#     d(t) = n . (E(p) - c) + r,    n = (cos t, sin t)
#
# with the offset c of the centre, the constant r of the gauge, and the part of the errors E that such a circle shows:
#
#     squareness            n . C S         one row of C for each squareness error S of the plane
#     scales                R/2 cos 2t (s1 - s2)
#     reversal of an axis   n_i sign(v_i) B_i / 2     its actual position from the positive side minus from the negative
#     servo mismatch        direction R/2 sin 2t m    separable from squareness only with both directions
#     straightness          cos 3t, sin 3t            bows of the two axes
#
# Higher harmonics (cyclic errors, spikes at reversal) stay in the residuals. They are not white, so uncertainties are
# enlarged by their correlation along the path.


#: Below this share of their size a combination of columns counts as not determined.
RCOND = 1e-7


@dataclass(frozen=True)
class _Column:
    """One unknown: what it is, its set-up or axis, and the derivative of the readings by it, (n,)."""

    kind: str
    key: Any
    values: FloatArray


def identify_circles(machine: Machine, circles: Circles) -> Identification:
    """Identify the squareness errors and reversals that circular tests show.

    Parameters
    ----------
    machine : chain, travel, reference of squareness. If a file does not state where its circles were, they are
        assumed in the middle of the travel.
    circles : readings in one or more planes, with one or both directions, whole circles or arcs.

    Raises
    ------
    InputError
        for circles that leave the travel.
    UndeterminedError
        if arcs are too short to separate squareness from the centre and the scales.
    """
    columns = _columns(machine, circles, circle_positions(machine, circles))
    solution = _Solution.of(circles, columns)
    shown = [(column, k) for k, column in enumerate(columns) if solution.shown[k]]
    for k, name in enumerate(PLANES):
        if len(np.unique(circles.direction[circles.plane == k])) == 1:
            text = f"{name} was measured in one direction only: a servo mismatch counts as squareness; measure both directions"
            warnings.warn(text, CompgenWarning, stacklevel=2)
    rows = {column.key: k for column, k in shown if column.kind == "squareness"}
    order = [rows[name] for name in SQUARENESS_NAMES if name in rows]
    squareness = {columns[k].key: (float(solution.value[k]), float(solution.u[k])) for k in order}
    errors = ErrorTable({}, squareness, metadata_of(machine, circles.metadata))
    for name in set(_of_planes(circles)) - set(rows):
        warnings.warn(
            Message(
                "arcs-ambiguous",
                "the arcs do not tell {name} from the centre, the scales or the servo mismatch",
                name=name,
            ),
            CompgenWarning,
            stacklevel=2,
        )
    curves = {
        (column.key, column.key): Curve(np.zeros(1), solution.value[k : k + 1], solution.u[k : k + 1])
        for column, k in shown
        if column.kind == "reversal"
    }
    reversal = {key: curve for key, curve in curves.items() if worth_a_table(curve)}
    return replace(
        without_adjustment(machine, errors, solution.residual, "scatter", "circles do not show it"),
        degrees_of_freedom=solution.freedom,
        u_length_um=solution.spread_mm / MM_PER_UM,
        rank=len(circles) - solution.freedom,
        unknowns=len(columns),
        condition=solution.condition,
        values_factor=solution.factor[order],
        reversal_curves=ReversalCurves(reversal, {"machine": machine.name}) if reversal else None,
        method="circles",
        details={"unknowns": [_described(column, solution.value[k], solution.u[k]) for column, k in shown]},
    )


#: Comment of a file of circles: the axes do run ahead, the directions are right.
AHEAD = "runs_ahead"


def check_ways(machine: Machine, circles: Circles) -> None:
    """Ask whether clockwise and counter-clockwise are exchanged, where every axis of a circle would run ahead at reversal.

    Each file and plane is judged by itself. The comment ``# runs_ahead = true`` says that the axes do so.

    Raises
    ------
    InputError
        with the reversals that the file shows.
    """
    if circles.metadata.get(AHEAD, "").lower() == "true":
        return
    files = [str(file) for file, _ in circles.origin] or [""] * len(circles)
    for file, plane in dict.fromkeys(zip(files, circles.plane.tolist(), strict=True)):
        rows = np.flatnonzero((np.array(files) == file) & (circles.plane == plane))
        ahead = _ahead(machine, circles.part(rows))
        if len(ahead) < 2:
            continue
        shown = " and ".join(f"{AXES[axis]} {value / MM_PER_UM:+.3g} um" for axis, value in ahead.items())
        first, second = list(PLANES)[plane]
        raise InputError(
            Message(
                "reversals-run-ahead",
                "the reversals of {shown} in {first}{second} say that both axes run ahead; an axis "
                "with play stays behind. Are clockwise and counter-clockwise exchanged? 1 is "
                "counter-clockwise, from +{first2} to +{second2}: exchange 1 and -1 in the column "
                "direction, or, if the axes do run ahead (too much backlash compensation), add the "
                "comment '# {value} = true'",
                shown=shown,
                first=first,
                second=second,
                first2=first,
                second2=second,
                value=AHEAD,
            ),
            file=file or None,
            field="column direction",
        )


def _ahead(machine: Machine, circles: Circles) -> dict[int, float]:
    """Reversals by axis, mm, if all that are beyond their uncertainty are positive; empty otherwise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # said when the circles are identified
        columns = _columns(machine, circles, circle_positions(machine, circles))
    try:
        solution = _Solution.of(circles, columns)
    except UndeterminedError:
        return {}
    found = {
        int(column.key): float(solution.value[k])
        for k, column in enumerate(columns)
        if column.kind == "reversal" and solution.shown[k]
        and abs(solution.value[k]) > max(SIGNIFICANT * solution.u[k], WORTH_MM)
    }  # fmt: skip
    return found if all(value > 0.0 for value in found.values()) else {}


def circle_observations(
    machine: Machine, layout: ErrorParameters, circles: Circles, found: Identification
) -> Observations:
    """Return the squareness errors ``found`` by circles as readings of the errors of a layout, with their joint covariance.

    A circle shows the squareness within its diameter: guides that are bent there contribute to it. So a value reads the
    curves, too, each with the same weights of the radial readings as the squareness itself.
    """
    names = [name for name in found.errors.names if name in layout.squareness]
    rows = [found.errors.names.index(name) for name in names]
    assert found.values_factor is not None
    factor = found.values_factor[rows]
    weights = factor / (found.u_length_um * MM_PER_UM)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # said when the circles were identified
        position_mm = circle_positions(machine, circles)
    errors = layout.design(c_matrix(machine, position_mm), layout.bases(position_mm))
    # unit variances: independent combinations of the planes
    size, direction = np.linalg.eigh(factor @ factor.T)
    whiten = (direction / np.sqrt(size)).T
    return Observations(
        design=whiten @ weights @ np.einsum("nd,ndp->np", circles.radial(), errors),
        others=np.zeros((len(names), 0)),
        value=whiten @ found.errors.values()[rows],
        sigma=np.ones(len(names)),
        at_mm=np.full((len(names), 3), np.nan),
        shows=np.zeros((len(names), len(layout.curves)), dtype=bool),
    )


def circle_readings(machine: Machine, layout: ErrorParameters, circles: Circles, found: Identification) -> Observations:
    """Return every reading of circles as one of the errors of a layout: squareness, scales, straightness and angles.

    The noise is that which ``found`` has from their residuals, enlarged by the correlation along the path.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # said when the circles were identified
        return circle_design(machine, layout, circles, max(found.u_length_um, FINEST) * MM_PER_UM)


def circle_design(machine: Machine, layout: ErrorParameters, circles: Circles, sigma_mm: float) -> Observations:
    """Return readings of circles with a noise as readings of the errors of a layout.

    Centre, zero of the gauge, servo mismatch and reversals are further unknowns.
    """
    position_mm = circle_positions(machine, circles)
    own = ("squareness", "scales", "straightness")
    others = [column.values for column in _columns(machine, circles, position_mm) if column.kind not in own]
    errors = layout.design(c_matrix(machine, position_mm), layout.bases(position_mm))
    moved = np.array(list(PLANES.values()))[circles.plane]
    in_plane = np.array([[axis in pair for axis in range(3)] for pair in moved.tolist()])
    axes = [curve.error.axis for curve in layout.curves]
    return Observations(
        design=np.einsum("nd,ndp->np", circles.radial(), errors),
        others=np.column_stack(others),
        value=circles.deviation_mm,
        sigma=np.full(len(circles), sigma_mm),
        at_mm=np.where(in_plane, position_mm, np.nan),
        shows=in_plane[:, axes],
    )


@dataclass(frozen=True)
class _Solution:
    """Least squares of circular readings: values (m,) with a factor (m, n) of their covariance, and what is determined.

    ``shown`` (m,) says which unknowns the readings determine; ``residual`` (n,) is model minus reading, mm.
    """

    value: FloatArray
    factor: FloatArray
    shown: NDArray[np.bool_]
    residual: FloatArray
    freedom: int
    spread_mm: float
    condition: float

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (m,)."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    @classmethod
    def of(cls, circles: Circles, columns: Sequence[_Column]) -> _Solution:
        """Solve in the directions that the readings show; UndeterminedError if they show no squareness."""
        design = np.column_stack([column.values for column in columns])
        scale = np.linalg.norm(design, axis=0)
        left, size, right = np.linalg.svd(design / scale, full_matrices=False)
        used = size > RCOND * size[0]
        inverse = (right[used].T / size[used]) @ left[:, used].T / scale[:, None]
        shown = np.einsum("ij,ij->j", right[used], right[used]) > 1 - 1e-6
        if not any(column.kind == "squareness" and shown[k] for k, column in enumerate(columns)):
            raise UndeterminedError(
                Message("arcs-too-short", "the arcs are too short to tell squareness from the centre and the scales"),
                [],
            )
        value = inverse @ circles.deviation_mm
        residual = design @ value - circles.deviation_mm
        rank = int(np.count_nonzero(used))
        freedom = len(circles) - rank
        if freedom < 1:
            raise UndeterminedError(
                Message(
                    "too-few-circle-readings", "{circles} readings for {rank} unknowns", circles=len(circles), rank=rank
                ),
                [],
            )
        spread = float(np.sqrt(residual @ residual / freedom * correlated(circles, residual)))
        return cls(value, spread * inverse, shown, residual, freedom, spread, float(size[0] / size[used][-1]))


def circle_positions(machine: Machine, circles: Circles) -> FloatArray:
    """Commanded positions (n, 3); InputError where one is outside the travel."""
    middle = np.array([np.mean(axis.range_mm) for axis in machine.axes])
    unknown = np.isnan(circles.centre_mm).any(axis=1)
    if unknown.any():
        text = ", ".join(f"{AXES[k]} {middle[k]:g}" for k in range(3))
        warnings.warn(
            Message(
                "circle-centres-assumed",
                "the files do not state the centres of the circles; assumed in the middle of the travel ({text} mm)",
                text=text,
            ),
            CompgenWarning,
            stacklevel=3,
        )
    centre = np.where(np.isnan(circles.centre_mm), middle, circles.centre_mm)
    position = centre + circles.radius_mm[:, None] * circles.radial()
    try:
        check_travel(machine, position, circles.origin)
    except InputError as error:
        text = "the circle leaves the travel; check centre and radius" if not unknown.all() else (
            "a circle of this radius in the middle of the travel leaves it; give centre_x_mm, centre_y_mm, centre_z_mm"
        )  # fmt: skip
        raise InputError(
            f"{error.message}: {text}", file=error.file, line=error.line, field="column radius_mm"
        ) from None
    return position


#: The squareness error that a circle in each plane shows.
SQUARENESS_OF = {"XY": "EC0Y", "YZ": "EA0Z", "ZX": "EB0Z"}


def _of_planes(circles: Circles) -> list[str]:
    """Squareness errors of the measured planes."""
    return [SQUARENESS_OF[name] for name in circles.planes]


def _columns(machine: Machine, circles: Circles, position_mm: FloatArray) -> list[_Column]:
    """All unknowns of the readings."""
    radial, angle = circles.radial(), circles.angle_rad
    both = c_matrix(machine, position_mm)
    columns = [
        _Column("squareness", name, np.einsum("ij,ij->i", radial, both[:, :, ERROR_INDEX[name]]))
        for name in _of_planes(circles)
    ]
    travel = circles.travel()
    for axis in range(3):
        values = 0.5 * radial[:, axis] * travel[:, axis]
        if (values != 0).any():
            columns.append(_Column("reversal", axis, values))
    feed = circles.covariates.get("feed_mm_min", np.zeros(len(circles)))
    keys = np.column_stack([circles.plane, circles.setup, circles.radius_mm, np.nan_to_num(circles.centre_mm)])
    several = len(np.unique(keys[:, 3:], axis=0)) > 1
    for key in np.unique(keys, axis=0):
        own = (keys == key).all(axis=1).astype(np.float64)
        plane, setup, radius, *centre = key.tolist()
        name = f"{list(PLANES)[int(plane)]}, radius {radius:g} mm" + (f", set-up {int(setup)}" if setup else "")
        name += f", centre {', '.join(f'{value:g}' for value in centre)} mm" if several else ""
        columns += [
            _Column("centre", f"{name}, first axis", own * np.cos(angle)),
            _Column("centre", f"{name}, second axis", own * np.sin(angle)),
            _Column("scales", name, own * 0.5 * radius * np.cos(2 * angle)),
            _Column("straightness", f"{name}, cos 3t", own * np.cos(3 * angle)),
            _Column("straightness", f"{name}, sin 3t", own * np.sin(3 * angle)),
        ]
        for speed in np.unique(feed[own > 0]).tolist():
            at = own * (feed == speed)
            told = name + (f", {speed:g} mm/min" if speed else "")
            columns.append(_Column("radius", told, at))
            if len(np.unique(circles.direction[at > 0])) == 2:
                columns.append(
                    _Column("servo mismatch", told, at * 0.5 * radius * circles.direction * np.sin(2 * angle))
                )
    return columns


def correlated(circles: Circles, residual: FloatArray) -> float:
    """How many successive readings count as one: 1 + twice the sum of correlations along the path, while above 0."""
    total, weight = 0.0, 0
    keys = np.column_stack([circles.plane, circles.setup, circles.run, circles.direction])
    for key in np.unique(keys, axis=0):
        own = (keys == key).all(axis=1)
        path = residual[own][np.argsort(circles.angle_rad[own])]
        power = float(path @ path)
        if len(path) < 8 or not power:
            continue
        lags = (float(path[:-lag] @ path[lag:]) / power for lag in range(1, len(path) // 4))
        total += len(path) * (1.0 + 2.0 * sum(takewhile(lambda lag: lag >= 0, lags)))
        weight += len(path)
    return max(1.0, total / weight) if weight else 1.0


def _described(column: _Column, value: float, u: float) -> dict[str, Any]:
    """The entry of an unknown in ``identify.json``: um, urad, um/m."""
    unit = "um" if column.kind in ("centre", "radius", "reversal", "straightness") else "um/m"
    if column.kind == "squareness":
        unit = error_named(column.key).unit
    by = 1e3 if unit == "um" else 1e6
    name = AXES[column.key] if column.kind == "reversal" else str(column.key)
    return {"what": column.kind, "of": name, "value": by * float(value), "u": by * float(u), "unit": unit}
