"""Errors from measured positions (``*.deviations.csv``, ``*.part.csv``), in an aligned frame or in frames of unknown pose."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.comparison import rigid_fields
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import FAR_MM, PART, Artefact, Deviations, aligned, setups_of
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Axis, Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.records import MEASURED_COLUMNS
from compgen.errors import CompgenWarning, InputError, Message, UndeterminedError
from compgen.identification.adjust.determined import FAINTER, SHOWS, Determined, Observations, least_squares
from compgen.identification.adjust.problem import SeparationProblem
from compgen.identification.adjust.propagation import Adjustment
from compgen.identification.adjust.residual_tests import residual_series
from compgen.identification.adjust.robust import fit_accepted, rejected_components
from compgen.identification.adjust.solver import LeastSquaresSolution, determined_factor, factorise, solve
from compgen.identification.adjust.unknowns import (
    ErrorParameters,
    State,
    check_travel,
    common_tool,
    error_parameters,
    parameters_for_tools,
)
from compgen.identification.covariance import values_with_factor
from compgen.identification.options import ASSUMED_U_DEVIATION_UM, IdentifyOptions, deviation_sigma, stated_deviation_um
from compgen.identification.reference_conditions import without_effects
from compgen.identification.result import (
    AdjustedReadings,
    Identification,
    error_table,
    judged,
    not_among,
)
from compgen.kinematics.first_order import c_matrix, modelled_errors, tool_of
from compgen.kinematics.kernel_switch import one_thread

# Errors from positions measured in frames of unknown pose, in any of their components: only what they determine.
#
# The positions are features of parts (``*.part.csv``) or measured deviations without one component, at one height, or
# from several set-ups. Component i of position j, measured in set-up s, is to first order
#
#     d_ij = e_i . (shift_s + turn_s x p_j + scale_s p_j + C(p_j) P)
#
# P are the errors of the machine's model, C as in E = C P. The pose (shift, turn) of every set-up is unknown, its scale
# unknown or given by temperatures. Such data rarely determine the whole model (:mod:`compgen.identification.adjust.determined`).


IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class FramePose:
    """Pose of the frame of one set-up: measured = offset + rotation(scale x (nominal + error)).

    ``offset_mm`` (3,) is the offset of the nominal origin, ``turn_rad`` (3,) the rotation vector; nan in components
    that the readings do not determine. ``scale`` is 1 if it was not free.
    """

    setup: int
    offset_mm: FloatArray
    turn_rad: FloatArray
    scale: float
    u_scale: float
    readings: int

    def summary(self) -> dict[str, Any]:
        """Return the pose for ``identify.json``."""
        return {
            "setup": self.setup,
            "offset_mm": [None if np.isnan(value) else float(value) for value in self.offset_mm],
            "rotation_deg": [None if np.isnan(value) else float(np.degrees(value)) for value in self.turn_rad],
            "scale": self.scale,
            "u_scale": self.u_scale,
            "readings": self.readings,
        }


@dataclass(frozen=True)
class _Readings:
    """The k measured components: position (k, 3), component 0..2, deviation in mm, its sigma, set-up number (k,).

    ``arm_mm`` (k, 3) is the position from the centre of the set-up.
    """

    row: IntArray
    component: IntArray
    position_mm: FloatArray
    arm_mm: FloatArray
    tool_mm: FloatArray
    deviation_mm: FloatArray
    sigma_mm: FloatArray
    setup: IntArray


def needs_free_pose(deviations: Deviations) -> bool:
    """Whether readings are features of parts, lack a component or an axis, or come from several set-ups."""
    measured = np.isfinite(deviations.deviation_mm).any(axis=0)
    flat = bool((np.ptp(deviations.position_mm, axis=0) < 1e-6).any()) if len(deviations) else False
    several = "setup" in deviations.labels and len(np.unique(deviations.labels["setup"])) > 1
    return deviations.metadata.get("measured") == PART or not measured.all() or flat or several


def identify_with_free_pose(machine: Machine, deviations: Deviations, options: IdentifyOptions) -> Identification:
    """Identify the errors that positions in frames of unknown pose determine.

    Parameters
    ----------
    machine : chain, nodes, reference point and the errors that its model contains.
    deviations : measured minus nominal coordinates, any components; the label ``setup`` distinguishes the frames.
    options : ``u_deviation_um``, ``reject``, ``part_scale`` ("free", or "known": 1, or from the temperatures) and
        ``travel`` ("machine", or "from-data": curves over the range that the readings cover).

    Raises
    ------
    InputError
        for temperatures without the coefficient of expansion of the part.
    UndeterminedError
        if no error is determined.
    """
    deviations = _at_20_degrees(deviations if deviations.poses else aligned(deviations))
    if options.travel == "from-data":
        machine = _within(machine, deviations.position_mm)
    sigma, source = deviation_sigma(deviations, options)
    readings = _readings(machine, deviations, sigma)
    layout = error_parameters(machine, modelled_errors(machine))
    observations = observed_positions(layout, readings, free_scale=options.part_scale == "free")
    solution, accepted = fit_accepted(
        lambda accepted, _: least_squares(layout, observations, accepted),
        lambda solution: solution.residual / readings.sigma_mm,
        len(readings.row),
        "coordinates do not fit the model; check the axis order, signs and units, and assignment of the features,",
        reject=options.reject,
    )
    result = _free_pose_result(deviations, readings, solution, accepted, source)
    texts = [f"{name} at {', '.join(f'{value:g}' for value in nodes)} mm" for name, nodes in solution.unreached.items()]
    if texts:
        warnings.warn(
            Message(
                "nodes-not-reached",
                "no reading reaches {texts}{texts2}: these nodes follow their neighbours by "
                "smoothness, with the uncertainty of an extrapolation",
                texts="; ".join(texts[:6]),
                texts2=" ..." if len(texts) > 6 else "",
            ),
            CompgenWarning,
            stacklevel=3,
        )
    return result


def _at_20_degrees(deviations: Deviations) -> Deviations:
    """Scale measured coordinates to the size of the part at 20 degC and to its size during machining.

    ``temp_part_c`` is the temperature of the part during the measurement, ``temp_machined_c`` during machining.
    """
    names = ("temp_part_c", "temp_machined_c")
    if not any(name in deviations.covariates for name in names):
        return deviations
    text = deviations.metadata.get("expansion_um_per_m_k", "")
    try:
        expansion = float(text) * 1e-6
    except ValueError:
        raise InputError(
            Message(
                "part-expansion-comment",
                "has {names}, but the comment expansion_um_per_m_k is {text!r}; give the part's "
                "coefficient of expansion, e.g. # expansion_um_per_m_k = 11.5",
                names=" and ".join(n for n in names if n in deviations.covariates),
                text=text,
            ),
            file=deviations.origin[0][0] if deviations.origin else None,
        ) from None
    measured, machined = (np.nan_to_num(deviations.covariates.get(n, 20.0) - np.array(20.0)) for n in names)
    # the part expanded by the temperature difference between machining and measurement
    growth = (expansion * (measured - machined))[..., None]
    actual = deviations.position_mm + deviations.deviation_mm
    return replace(deviations, deviation_mm=deviations.deviation_mm - growth * actual)


def _within(machine: Machine, position_mm: FloatArray) -> Machine:
    """Return the machine with the travel covered by the positions; same node spacing, reference point inside."""
    axes = []
    for k, axis in enumerate(machine.axes):
        low, high = float(position_mm[:, k].min()), float(position_mm[:, k].max())
        if high - low < 1e-6:
            axes.append(axis)
            continue
        share = (high - low) / (axis.range_mm[1] - axis.range_mm[0])
        count = max(2, int(np.ceil(share * (len(axis.nodes_mm) - 1) - 1e-9)) + 1)
        axes.append(Axis((low, high), np.linspace(low, high, count), axis.expansion_um_per_m_k, axis.screw_pitch_mm))
    low_mm, high_mm = np.array([axis.range_mm for axis in axes]).T
    x, y, z = np.clip(machine.reference_point_mm, low_mm, high_mm).tolist()
    return replace(machine, axes=(axes[0], axes[1], axes[2]), reference_point_mm=(x, y, z))


def _readings(machine: Machine, deviations: Deviations, sigma_mm: FloatArray) -> _Readings:
    row, component = np.nonzero(np.isfinite(deviations.deviation_mm))
    tools = np.broadcast_to(tool_of(machine, deviations.tool_mm), deviations.position_mm.shape)
    setups = setups_of(deviations)
    centre = np.array([deviations.poses[setup].nominal_mm for setup in setups.tolist()])
    # an unmeasured coordinate has no centre
    centre = np.where(np.isfinite(deviations.deviation_mm).any(axis=0), centre, deviations.position_mm.mean(axis=0))
    return _Readings(
        row.astype(np.int64),
        component.astype(np.int64),
        deviations.position_mm[row],
        (deviations.position_mm - centre)[row],
        tools[row],
        deviations.deviation_mm[row, component],
        sigma_mm[row, component],
        setups[row],
    )


def observed_positions(layout: ErrorParameters, readings: _Readings, *, free_scale: bool = False) -> Observations:
    """Position components as readings of the errors, and of shift, turn and scale of each set-up about its centre."""
    read = np.arange(len(readings.component)), readings.component
    block = rigid_fields(readings.arm_mm).reshape(-1, 3, 6)[read]
    if free_scale:
        block = np.column_stack([block, readings.arm_mm[read]])
    setups = np.unique(readings.setup)
    columns = c_matrix(layout.machine, readings.position_mm, readings.tool_mm)
    design = layout.design(columns, layout.bases(readings.position_mm))
    return Observations(
        design=np.asarray(design[read]),
        others=np.hstack([block * (readings.setup == setup)[:, None] for setup in setups]),
        value=readings.deviation_mm,
        sigma=readings.sigma_mm,
        at_mm=readings.position_mm,
        shows=np.ones((len(design), len(layout.curves)), dtype=bool),
    )


def position_observations(
    machine: Machine,
    layout: ErrorParameters,
    deviations: Deviations,
    options: IdentifyOptions,
    around: FloatArray | None = None,
) -> Observations:
    """Return measured positions as readings of the errors of a layout, each set-up with a separate pose.

    ``around`` are approximate errors of the layout (size,): poses and errors then count from there, exactly, and
    second-order terms (2 um over a metre for a squareness of 2 mrad) stay out of the remainder.

    Raises
    ------
    InputError
        for positions outside the travel, temperatures without the coefficient of expansion of the part.
    """
    check_travel(machine, deviations.position_mm, deviations.origin)
    deviations, _ = without_effects(machine, deviations)
    deviations = _at_20_degrees(deviations if deviations.poses else aligned(deviations))
    if around is not None:
        tool_mm = np.broadcast_to(tool_of(machine, deviations.tool_mm), deviations.position_mm.shape)
        expected_mm = layout.tips(around, deviations.position_mm, tool_mm) - tool_mm - deviations.position_mm
        deviations = aligned(replace(deviations, deviation_mm=deviations.deviation_mm - expected_mm, poses={}))
    readings = _readings(machine, deviations, deviation_sigma(deviations, options)[0])
    found = observed_positions(layout, readings, free_scale=options.part_scale == "free")
    return found if around is None else replace(found, value=found.value + found.design @ around)


def _free_pose_result(
    deviations: Deviations, readings: _Readings, solution: Determined, accepted: NDArray[np.bool_], source: str
) -> Identification:
    too_few = "{} coordinates for {} unknowns and the poses"
    adjusted = AdjustedReadings(
        -solution.residual, readings.sigma_mm, accepted, source, solution.rank, solution.freedom, too_few=too_few
    )
    errors, values_factor = values_with_factor(solution.layout, solution.unknowns, solution.factor * adjusted.u_scale)
    ambiguous = "part of it cannot be separated from the pose, the scale or other errors"
    return replace(
        _result(adjusted, errors, solution.layout, deviations, readings.row, readings.component),
        unobservable=(
            *not_among(errors, "no reading shows it"),
            *(f"{name}: {ambiguous}" for name in solution.partly),
        ),
        condition=solution.condition,
        values_factor=values_factor,
        details={
            "poses": [pose.summary() for pose in _poses(deviations, readings, solution, adjusted.u_scale)],
            "range_mm": {
                letter: [float(column.min()), float(column.max())]
                for letter, column in zip(AXES, deviations.position_mm.T, strict=True)
            },
            "tied_nodes_mm": {name: nodes.tolist() for name, nodes in solution.unreached.items()},
        },
    )


def _result(
    adjusted: AdjustedReadings,
    errors: ErrorTable,
    layout: ErrorParameters,
    deviations: Deviations,
    row: IntArray,
    component: IntArray,
) -> Identification:
    """The result of adjusted components (k,) with the rejected ones, and the assessment of the residuals."""
    residual, sigma, accepted = adjusted.residual_mm, adjusted.sigma_mm, adjusted.accepted
    found = replace(
        adjusted.identification(errors, layout, deviations.metadata, float(np.median(sigma)) / MM_PER_UM),
        rejected=rejected_components(deviations, row, component, residual, sigma, accepted),
        method="deviations",
    )
    return judged(
        found,
        lambda: residual_series(deviations, row[accepted], residual[accepted], sigma[accepted], component[accepted]),
    )


def _poses(
    deviations: Deviations,
    readings: _Readings,
    solution: Determined,
    u_scale: float,
) -> list[FramePose]:
    """Return the pose of each set-up: the rotation removed first, and the small adjusted one."""
    from scipy.spatial.transform import Rotation  # imported here: slow to load, and rarely needed

    setups, found = setups_of(deviations), []
    poses = solution.others.reshape(len(np.unique(setups)), -1)
    u_poses = solution.u_others.reshape(poses.shape)
    for k, setup in enumerate(np.unique(setups).tolist()):
        own = setups == setup
        components = np.isfinite(deviations.deviation_mm[own]).any(axis=0)
        shift, small, stretch = poses[k][:3], poses[k][3:6], poses[k][6:].sum()  # the scale where it was free
        scale = 1.0 + stretch
        rough = deviations.poses[setup]
        turn = Rotation.from_matrix(rough.rotation) * Rotation.from_rotvec(small)
        offset = rough.measured_mm + rough.rotation @ shift - scale * turn.apply(rough.nominal_mm)
        turning = np.array([components[[1, 2]].any(), components[[0, 2]].any(), components[[0, 1]].any()])
        found.append(
            FramePose(
                setup,
                np.where(components, offset, np.nan),
                np.where(turning, turn.as_rotvec(), np.nan),
                float(scale),
                float(u_poses[k][6:].sum() * u_scale),
                int(np.count_nonzero(readings.setup == setup)),
            )
        )
    return found


# Errors from artefacts measured with the machine's probe.
#
# The probe finds a feature at the coordinates m, where the tool is at m + E(m): this is the position of the feature,
#
#     m + E(m) = shift_s + R_s (q + dq)
#
# with its position q in the artefact, and the unknown pose of the set-up. So probe readings contain the machine errors
# with the opposite sign of those in a part. dq is zero for a calibrated artefact, known to the uncertainty of its
# calibration, or unknown: then the same plate in several set-ups, turned and shifted, separates its errors from the
# errors of the machine (self-calibration; it does not determine a common scale).


def identify_artefact(machine: Machine, artefact: Artefact, options: IdentifyOptions) -> Identification:
    """Identify the errors that an artefact measured with the machine's probe determines.

    Parameters
    ----------
    machine : chain, nodes, reference point and the errors that its model contains.
    artefact : calibrated or not, in one or more set-ups.
    options : ``u_deviation_um``, the standard uncertainty of a probed coordinate, and ``reject``.

    Raises
    ------
    InputError
        for features outside the travel, or far from their expected position.
    UndeterminedError
        if no error is determined.
    """
    layout = error_parameters(machine, modelled_errors(machine))
    # what a calibrated plate shows only because it lies a little tilted is not determined
    faint = FAINTER if artefact.calibrated.all() else (SHOWS,)

    def adjusted_with(least: float) -> tuple[Observations, int, str, Determined, NDArray[np.bool_]]:
        around = np.zeros(layout.size)
        for _ in range(2):  # repeat about the first result, to keep second-order terms out
            observations, count, source = artefact_observations(machine, layout, artefact, options, around)
            begin = _not_gross(artefact)
            solution, accepted = _robust(layout, observations, count, least, begin, reject=options.reject)
            around = solution.on(layout)
        plausible_errors(machine, layout, artefact, around)
        return observations, count, source, solution, accepted

    observations, count, source, solution, accepted = without_faint(adjusted_with, faint)
    standardised = solution.residual / observations.sigma
    adjusted = AdjustedReadings(
        -solution.residual[:count], observations.sigma[:count], accepted, source, solution.rank, solution.freedom,
        known_square_sum=float(np.sum(standardised[count:] ** 2)), too_few="{} coordinates for {} unknowns and the poses",
    )  # fmt: skip
    errors, values_factor = values_with_factor(solution.layout, solution.unknowns, solution.factor * adjusted.u_scale)
    if not artefact.calibrated.all() and {"EXX", "EYY", "EZZ"} & set(solution.partly):
        warnings.warn(
            Message(
                "artefact-scale-unknown",
                "an artefact that is not calibrated does not show a common scale of the axes: "
                "{machine}; give a length as well, for example an axis run (*.axis.csv)",
                machine=_open_scale(machine),
            ),
            CompgenWarning,
            stacklevel=3,
        )
    u_um = float(np.median(adjusted.sigma_mm)) / MM_PER_UM
    return replace(
        adjusted.identification(errors, solution.layout, artefact.metadata, u_um),
        unobservable=(
            *not_among(errors, "no reading shows it"),
            *(
                f"{name}: part of it cannot be separated from the pose, the artefact or other errors"
                for name in solution.partly
            ),
        ),
        condition=solution.condition,
        method="artefact",
        values_factor=values_factor,
        details={
            "features": len(set(artefact.feature)),
            "setups": len(np.unique(artefact.setup)),
            "calibrated": bool(artefact.calibrated.all()),
            "tied_nodes_mm": {name: nodes.tolist() for name, nodes in solution.unreached.items()},
        },
    )


T = TypeVar("T")
#: A coordinate is a gross error beyond so many times the median residual of its set-up, which must have a few touches.
_GROSS, _FEW_TOUCHES, _REWEIGHTED = 20.0, 8, 15


def _open_scale(machine: Machine) -> str:
    """What becomes of a scale that no reading shows."""
    if machine.prior.is_none:
        return "it is unknown, and so is the uncertainty of the positioning errors"
    um_per_m = 1e6 * machine.prior.scale("EXX")
    return f"their uncertainty contains one of {um_per_m:.3g} um/m, as the class of the machine lets expect"


def _robust(
    layout: ErrorParameters,
    observations: Observations,
    count: int,
    least: float,
    begin: NDArray[np.bool_],
    *,
    reject: bool,
) -> tuple[Determined, NDArray[np.bool_]]:
    """The adjustment without outliers among the probed coordinates, the first ``count`` readings; and which fit."""

    def fit(accepted: NDArray[np.bool_], _: Determined | None) -> Determined:
        used = np.concatenate([accepted, np.ones(len(observations) - count, dtype=bool)])
        return least_squares(layout, observations, used, least)

    return fit_accepted(
        fit,
        lambda found: (found.residual / observations.sigma)[:count],
        count,
        "probed coordinates do not fit the model; check which feature is which, the set-ups, axes, signs and units,",
        reject=reject,
        begin=begin,
    )


class HardlySeparated(UndeterminedError):
    """Readings whose noise the adjustment enlarges to errors that no machine has."""


def without_faint(adjust: Callable[[float], T], leasts: Sequence[float]) -> T:
    """Adjust with the smallest share from which a direction counts as shown that gives errors of a machine."""
    for least in leasts[:-1]:
        with suppress(HardlySeparated):
            return adjust(least)
    return adjust(leasts[-1])


def _not_gross(artefact: Artefact) -> NDArray[np.bool_]:
    """Which probed coordinates are no gross errors, in the order of the readings.

    One touch that missed would bend weakly determined errors by millimetres before its residual tells. A machine bends a
    plate little beside an affine map of it: the least sum of absolute residuals (iterated weights) of each set-up shows it.
    """
    seen = np.isfinite(artefact.measured_mm)
    kept = np.ones(seen.shape, dtype=bool)
    for setup in np.unique(artefact.setup):
        own = artefact.setup == setup
        for component in np.flatnonzero(seen[own].any(axis=0)):
            rows = np.flatnonzero(own & seen[:, component])
            place = artefact.nominal_mm[rows] - artefact.nominal_mm[rows].mean(axis=0)
            design = np.column_stack([np.ones(len(rows)), place / max(float(np.abs(place).max()), 1.0)])
            if len(rows) < _FEW_TOUCHES:
                continue
            value, weight = artefact.measured_mm[rows, component], np.ones(len(rows))
            for _ in range(_REWEIGHTED):
                fit = np.linalg.lstsq(design * weight[:, None], value * weight, rcond=1e-9)[0]
                rest = np.abs(value - design @ fit)
                weight = 1.0 / np.sqrt(np.maximum(rest, MM_PER_UM))
            usual = max(float(np.median(rest)), MM_PER_UM)
            kept[rows, component] = rest <= _GROSS * usual
    return kept[seen]


def plausible_errors(
    machine: Machine, layout: ErrorParameters, artefact: Artefact, around: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where the features were probed, with which tool, and what errors of a layout (size,) do there, (n, 3) each.

    Raises
    ------
    HardlySeparated
        for errors that no machine has.
    """
    tool_mm = np.broadcast_to(tool_of(machine, artefact.tool_mm), artefact.measured_mm.shape)
    position_mm = np.where(np.isnan(artefact.measured_mm), artefact.nominal_mm, artefact.measured_mm)
    check_travel(machine, position_mm, artefact.origin, MEASURED_COLUMNS)
    expected_mm = layout.tips(around, position_mm, tool_mm) - tool_mm - position_mm
    largest_mm = float(np.abs(expected_mm).max())
    if largest_mm > FAR_MM:  # no machine: noise, enlarged by directions that the set-ups hardly determine
        raise HardlySeparated(
            f"the set-ups hardly separate the errors of the machine from the artefact (errors of {largest_mm:.3g} mm would fit): "
            "measure the artefact turned by 180 degrees and shifted, too, or give the machine fewer nodes or errors",
            [],
        )
    return position_mm, tool_mm, expected_mm


def artefact_observations(
    machine: Machine, layout: ErrorParameters, artefact: Artefact, options: IdentifyOptions, around: FloatArray
) -> tuple[Observations, int, str]:
    """Return probed coordinates as readings of the errors of a layout, followed by the calibration data.

    Also their number, and whether their uncertainty is "stated" or "assumed". ``around`` are approximate errors of the
    layout (size,); poses and errors count from there.
    """
    position_mm, tool_mm, expected_mm = plausible_errors(machine, layout, artefact, around)
    found_mm = artefact.measured_mm + expected_mm
    lying = aligned(Deviations(artefact.nominal_mm, found_mm - artefact.nominal_mm, labels={"setup": artefact.setup}))
    poses = [lying.poses[setup] for setup in artefact.setup.tolist()]
    rotation = np.array([pose.rotation for pose in poses])
    arm_mm = np.einsum("nij,nj->ni", rotation, artefact.nominal_mm - np.array([pose.nominal_mm for pose in poses]))
    there_mm = arm_mm + np.array([pose.measured_mm for pose in poses])
    row, component = np.nonzero(np.isfinite(artefact.measured_mm))
    # at the features' positions by the rough pose: there a common scale of machine and plate are exactly the same
    at_mm = np.where(np.isnan(artefact.measured_mm), artefact.nominal_mm, there_mm)
    design = layout.design(c_matrix(machine, at_mm, tool_mm), layout.bases(at_mm))[row, component]
    unit = np.eye(3)[component]
    pose = np.hstack([unit, np.cross(arm_mm[row], unit)])
    setups = np.unique(artefact.setup)
    features = {name: k for k, name in enumerate(dict.fromkeys(artefact.feature))}
    number = np.array([features[name] for name in artefact.feature])
    own = np.zeros((len(row), len(features), 3))
    own[np.arange(len(row)), number[row]] = rotation[row, component]
    # features with an uncertainty are both free and observed; exact ones are not free
    first = np.array([artefact.feature.index(name) for name in features])
    u_mm = np.where(artefact.calibrated[first, None], np.nan_to_num(artefact.u_nominal_mm[first]), np.inf)
    free = (u_mm > 0).ravel()
    known = np.flatnonzero(free & np.isfinite(u_mm).ravel())
    others = np.hstack(
        [*(pose * (artefact.setup[row] == setup)[:, None] for setup in setups), own.reshape(len(row), -1)[:, free]]
    )
    sigma_um = stated_deviation_um(artefact, options, "u_probe_um")
    behind = np.zeros((len(known), others.shape[1]))
    behind[np.arange(len(known)), others.shape[1] - int(free.sum()) + np.searchsorted(np.flatnonzero(free), known)] = (
        1.0
    )
    value = (there_mm - found_mm)[row, component] + design @ around
    sigma_mm = np.full(len(row), (ASSUMED_U_DEVIATION_UM if sigma_um is None else sigma_um) * MM_PER_UM)
    nothing = len(known)
    observations = Observations(
        design=np.vstack([design, np.zeros((nothing, layout.size))]),
        others=np.vstack([others, behind]),
        value=np.concatenate([value, np.zeros(nothing)]),
        sigma=np.concatenate([sigma_mm, u_mm.ravel()[known]]),
        at_mm=np.vstack([at_mm[row], np.full((nothing, 3), np.nan)]),
        shows=np.repeat([[True], [False]], [len(row), nothing], axis=0) & np.ones(len(layout.curves), dtype=bool),
    )
    return observations, len(row), "assumed" if sigma_um is None else "stated"


# Errors from measured and commanded positions (``*.deviations.csv``): the separation step alone.
#
# The rigid placement of the measured frame is unknown (six more unknowns), so the file may be in the frame of any
# instrument whose axes agree with the machine's to a few degrees.


def identify_deviations(
    machine: Machine, deviations: Deviations, options: IdentifyOptions | None = None
) -> Identification:
    """Identify the errors of a machine from measured positions.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    deviations : measured minus commanded position; any of the three components.
    options : ``u_deviation_um`` and ``reject`` are used.

    Raises
    ------
    InputError
        for positions outside the travel, or an uncertainty that is not positive.
    UndeterminedError
        if the positions do not determine the errors; it lists the combinations.
    ConvergenceError
        if no optimum is reached.
    """
    chosen = options or IdentifyOptions()
    check_travel(machine, deviations.position_mm, deviations.origin)
    with one_thread():
        deviations, effects = without_effects(machine, deviations)
        identified = identify_with_free_pose if needs_free_pose(deviations) else _identify
        found = identified(machine, deviations, chosen)
        return replace(found, corrections={**found.corrections, "effects": effects}) if effects else found


def _identify(machine: Machine, deviations: Deviations, options: IdentifyOptions) -> Identification:
    tool_mm = common_tool(machine, deviations.tool_mm)
    layout = parameters_for_tools(machine, tool_mm)
    index = np.flatnonzero(np.isfinite(deviations.deviation_mm.ravel())).astype(np.int64)
    sigma_mm, source = deviation_sigma(deviations, options)
    sigma_mm = sigma_mm.ravel()[index]
    problem = _problem(layout, deviations, tool_mm, index, sigma_mm)
    factor, _ = determined_factor(problem.normal_matrix(problem.start), problem.unknown_names, "the measured positions")

    def fit(accepted: NDArray[np.bool_], before: LeastSquaresSolution | None) -> LeastSquaresSolution:
        if before is None:
            return solve(problem, problem.start, factor)
        weight = np.zeros(3 * len(problem.position_mm))
        weight[index] = accepted
        return solve(problem.weighted(weight), before.state)

    solution, accepted = fit_accepted(
        fit,
        lambda found: problem.residuals(found.state)[index] / sigma_mm,
        len(index),
        "deviations do not fit the model; check the machine file's chain, the axis order, signs and units",
        reject=options.reject,
    )
    return _separation_result(problem, deviations, index, sigma_mm, source, solution, accepted)


def _problem(
    layout: ErrorParameters, deviations: Deviations, tool_mm: FloatArray, index: IntArray, sigma_mm: FloatArray
) -> SeparationProblem:
    count = len(deviations)
    tools = np.broadcast_to(tool_mm, deviations.position_mm.shape)
    weight = np.zeros(3 * count)
    weight[index] = 1.0 / sigma_mm**2
    return SeparationProblem(
        parameters=layout,
        bases=layout.bases(deviations.position_mm),
        position_mm=deviations.position_mm,
        tool_mm=tools,
        measured_mm=deviations.position_mm + tools + np.nan_to_num(deviations.deviation_mm),
        information=weight.reshape(count, 3, 1) * np.eye(3),
        lever=np.zeros((count, 3, 0)),
        station_information=np.zeros((0, 0)),
    )


def _separation_result(
    problem: SeparationProblem,
    deviations: Deviations,
    index: IntArray,
    sigma_mm: FloatArray,
    source: str,
    solution: LeastSquaresSolution,
    accepted: NDArray[np.bool_],
) -> Identification:
    layout = problem.parameters
    adjusted = AdjustedReadings(
        problem.residuals(solution.state)[index],
        sigma_mm,
        accepted,
        source,
        problem.size,
        int(np.count_nonzero(accepted)) - problem.size,
        too_few="{} deviations for {} unknowns",
    )
    # normal matrix of the errors, the placement of the frame eliminated
    whole, size = solution.factor.matrix, layout.size
    reduced = whole[:size, :size] - whole[size:, :size].T @ np.linalg.solve(whole[size:, size:], whole[size:, :size])
    adjustment = Adjustment(
        state=State(solution.state.errors, np.zeros((0, 3)), np.zeros(0)),
        factor=factorise(0.5 * (reduced + reduced.T)),
        weight=accepted / sigma_mm**2,
        group=np.zeros(0, dtype=np.int64),
        sigma_mm=adjusted.u_scale,
    )
    errors = error_table(layout, solution.state.errors, adjustment.covariance_factor())
    return replace(
        _result(adjusted, errors, layout, deviations, *np.divmod(index, 3)),
        condition=1.0 / solution.factor.rcond,
        iterations=solution.iterations,
        adjustment=adjustment,
    )
