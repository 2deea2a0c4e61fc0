"""Position errors of rotary axes from centres of spheres that were found at many poses.

A sphere lies on the table. At every pose the tip, wherever the errors of the machine put it, is at its centre s:

    T(joints, angles; errors) = s + noise

Unknown are the position errors of the rotary axes (two offsets, two tilts and the zero of each) and a place s for each sphere
and set-up. Squareness and scales of the linear axes enter with what the prior of the machine says of them: as unknowns of
known size, not as zero. Every error has a normal prior; what the readings do not determine keeps its uncertainty, and the
directions that they cannot tell apart are named (:attr:`SphereIdentification.inseparable`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import COVERAGE, MM_PER_UM
from compgen.data.pose_readings import Bars, PosedDeviations, PosedLengths
from compgen.data.rotary import TIP, RotaryErrors, SphereCentres, si_per_unit, unit_of
from compgen.drawing.display import Displayed, Overview
from compgen.errors import InputError, Message
from compgen.identification.posterior import Posterior, root_of
from compgen.identification.rotary_adjustment import (
    DETERMINED,
    Problem,
    Solved,
    by_pose,
    constants_of,
    directions,
    in_words,
    left_out,
    separated_by,
    solve,
    split,
    without_errors,
)
from compgen.identification.rotary_linear import LinearState
from compgen.identification.rotary_readings import PoseReadings, readings_at
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose

#: Errors of this many times their size say that the machine is worse than its class; the sizes grow until they are not.
_WORSE = 2.0
#: Times the uncertainty of the readings, and the sizes of the errors, follow the residuals.
_ROUNDS = 8
#: Degrees of freedom from which residuals say how small the noise is, and the smallest noise of a machine, mm.
_FEW_FREE, _FINEST_MM = 3.0, 1e-5
WITHOUT_EFFECT = "nothing needs to: it moves or turns the workpiece as a whole, and setting up the part removes it"
#: A diameter changes with an angle if chance explains it with a smaller probability only (F test over sectors of 30 degrees).
_UNLIKELY = 1e-4


@dataclass(frozen=True, repr=False)
class SphereIdentification(Displayed):
    """Position errors of the rotary axes, and what the poses leave open.

    Parameters
    ----------
    errors : constants with standard uncertainties, mm and rad.
    names, values, covariance : of the errors in this order, mm and rad; with a rotary head also TX, TY, TZ, the offset of
        the gauge point of the spindle (TZ: the pivot length is longer by -TZ).
    sizes : what was assumed of each before the measurement (one standard deviation).
    determined : whether the readings determine each error by itself.
    inseparable : combinations that the readings cannot tell apart: words, and what would separate them.
    rank : number of combinations of the position errors that the readings determine.
    residual_um : rms and largest distance between readings and their spheres, before (places only) and after the fit.
    left_out_um : rms of poses that were left out of the fit in turn, before and after; nan if there are too few.
    u_um : standard uncertainty of a coordinate that was used, and whether it comes from the residuals.
    sphere_mm : places of the spheres in the workpiece frame.
    linear : what the poses say of the linear axes, with the joint covariance.
    kinds : what was read at the poses.
    """

    errors: RotaryErrors
    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    sizes: FloatArray
    determined: tuple[bool, ...]
    inseparable: tuple[tuple[str, str], ...]
    rank: int
    residual_um: Mapping[str, float]
    left_out_um: tuple[float, float]
    u_um: float
    u_from_residuals: bool
    poses: int
    sphere_mm: Mapping[str, tuple[float, float, float]]
    notes: tuple[str, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    motions_not_told: tuple[str, ...] = ()
    linear: Joint | None = None
    kinds: tuple[str, ...] = ("spheres",)

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties of the errors, mm and rad."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> dict[str, object]:
        """Plain values for ``identify.json``; um and urad."""
        units = np.array([_unit(name)[1] for name in self.names])
        return {
            "kind": "sphere",
            "poses": self.poses,
            "errors": {
                name: {
                    "value": value / unit,
                    "u": u / unit,
                    "unit": _unit(name)[0],
                    "assumed": size / unit,
                    "determined": known,
                }
                for name, unit, value, u, size, known in zip(
                    self.names,
                    units.tolist(),
                    self.values.tolist(),
                    self.u.tolist(),
                    self.sizes.tolist(),
                    self.determined,
                    strict=True,
                )
            },
            "covariance": (self.covariance / np.outer(units, units)).tolist(),
            "position_errors": len(self.names),
            "determined_combinations": self.rank,
            "inseparable": [{"errors": words, "separated_by": cure} for words, cure in self.inseparable],
            "residual_um": dict(self.residual_um),
            "left_out_rms_um": [None if np.isnan(value) else value for value in self.left_out_um],
            "u_um": self.u_um,
            "u_from_residuals": self.u_from_residuals,
            "spheres_mm": {name: list(place) for name, place in self.sphere_mm.items()},
            "notes": list(self.notes),
            "motions": {
                name: {
                    "position_deg": curve.angle_deg.tolist(),
                    "value": (curve.value / _unit(name)[1]).tolist(),
                    "u": (curve.u / _unit(name)[1]).tolist(),
                    "unit": _unit(name)[0],
                }
                for name, curve in self.errors.curves.items()
            },
            "motions_not_told_apart": list(self.motions_not_told),
        }

    def overview(self) -> Overview:
        """Each error with its uncertainty, and whether it is determined."""
        rows = []
        for name, value, u, known in zip(self.names, self.values, self.u, self.determined, strict=True):
            unit, size = _unit(name)
            mark = "" if known else "not determined"
            rows.append((name, f"{value / size:+.2f}", f"{COVERAGE * u / size:.2f}", unit, mark))
        title = f"{sum(self.determined)} of {len(self.names)} position errors from {self.poses} poses"
        return Overview(title, ("error", "value", "U (k = 2)", "unit", ""), tuple(rows))


def _unit(name: str) -> tuple[str, float]:
    """Unit in files, and its factor to mm or rad, of a position error or an offset of the spindle."""
    return unit_of(name), si_per_unit(name)


@dataclass(frozen=True)
class Sense:
    """Whether a rotary axis turns as the machine file says: distances from the sphere if it does, and if it does not, mm.

    ``verdict`` is ``"agrees"``, ``"reversed"``, or ``"not told"`` where both fit alike, or neither.
    """

    letter: str
    as_stated_mm: float
    reversed_mm: float
    verdict: str

    @property
    def text(self) -> str:
        """The verdict in words."""
        figures = f"the sphere moves by {self.as_stated_mm:.3f} mm as the file says, by {self.reversed_mm:.3f} mm reversed (rms)"
        if self.verdict == "agrees":
            return f"{self.letter} turns as the machine file says: {figures}"
        if self.verdict == "reversed":
            return f"{self.letter} turns the other way round than the machine file says: {figures}"
        return (
            f"{self.letter}: the poses do not tell which way it turns: {figures}. Probe the sphere, farther from the axis, at "
            f"two angles of {self.letter} that are some 30 to 120 degrees apart, the other rotary axes at rest"
        )


#: Distances below which no sense is told, and by which one must exceed the other.
_TOLD_MM, _TOLD_TIMES = 0.5, 4.0


def senses(machine: Machine, spheres: SphereCentres) -> tuple[Sense, ...]:
    """Which way each rotary axis turns: two poses of one sphere are enough, at any angles that are not opposite.

    A sphere stays where it is on the table. With the sense of an axis reversed, its poses lie on another curve, mm apart;
    errors of the axis lines move them by tenths.
    """
    joints = spheres.found_mm
    if spheres.coordinates == TIP:
        joints = joints_of_tip(machine, joints, spheres.angle_deg, spheres.tool_mm)
    place, letters = spheres.places[0], tuple(machine.rotary)
    if len(spheres) < 2:
        raise InputError(
            Message("one-pose", "contains one pose; two poses of one sphere are needed"), file=_file_of(spheres)
        )
    moved: dict[tuple[float, ...], float] = {}
    for signs in product((1.0, -1.0), repeat=len(letters)):
        angle = {letter: sign * spheres.angle_deg[letter] for letter, sign in zip(letters, signs, strict=True)}
        tip, _ = tip_pose(machine, ErrorTable(), RotaryErrors(), joints, angle, spheres.tool_mm)
        apart = _centred(tip - np.nan_to_num(spheres.deviation_mm), place)
        moved[signs] = float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
    found = []
    for k, letter in enumerate(letters):
        stated, other = (min(size for signs, size in moved.items() if signs[k] == sign) for sign in (1.0, -1.0))
        told = max(stated, other) > max(_TOLD_MM, _TOLD_TIMES * min(stated, other))
        found.append(Sense(letter, stated, other, ("agrees" if stated < other else "reversed") if told else "not told"))
    return tuple(found)


def _file_of(spheres: SphereCentres) -> str | None:
    return spheres.origin[0][0] if spheres.origin else None


def identify_spheres(
    machine: Machine,
    spheres: SphereCentres,
    *,
    u_um: float | None = None,
    separate: bool = True,
    known: RotaryErrors | None = None,
) -> SphereIdentification:
    """Identify the position errors of all rotary axes from sphere centres: :func:`identify_at_poses` of spheres alone."""
    return identify_at_poses(machine, [spheres], u_um=u_um, separate=separate, known=known)


def identify_at_poses(
    machine: Machine,
    read: Sequence[SphereCentres | Bars | PosedDeviations | PosedLengths],
    *,
    u_um: float | None = None,
    separate: bool = True,
    known: RotaryErrors | None = None,
    linear: Posterior | None = None,
) -> SphereIdentification:
    """Identify the position errors of all rotary axes from readings at poses, of one or several kinds.

    Parameters
    ----------
    machine : a machine with rotary axes.
    read : readings at poses: spheres, bars, positions, lengths.
    u_um : standard uncertainty of a reading where its file states none; None: from the residuals.
    separate : look for what would separate combinations that the readings cannot tell apart.
    known : error motions that were measured otherwise, such as the positioning of an axis; taken as they are.
    linear : what is known of the linear axes from measurements of their own; None: nothing.

    Raises
    ------
    InputError
        for fewer than four poses of a sphere, and for an axis that turns the other way round than the machine file says.
    """
    for item in read:
        if isinstance(item, SphereCentres):
            _check_spheres(machine, item)
    parts = [readings_at(machine, item) for item in read]
    joints = np.concatenate([part.joint_mm for part in parts])
    state = LinearState.usual(machine) if linear is None else LinearState.of_posterior(machine, linear, joints)
    known = RotaryErrors() if known is None else known
    problem, solved, u, stated, scale, raised = _adjusted(machine, parts, state, known, u_um)
    k, m, x = problem.errors, problem.machine_unknowns, solved.x
    own = solved.covariance[:k, :k]
    vectors, shares = directions(problem, x, u)
    open_ = shares > DETERMINED
    pairs = split(problem, vectors[:, open_]) if separate and open_.any() else []
    estimated = bool(np.isnan(stated).any())
    zero = without_errors(problem)
    left = left_out(problem, x, u, zero)
    found = SphereIdentification(
        errors=RotaryErrors({}, constants_of(problem.names, x[:k], np.sqrt(np.diag(own)))),
        names=problem.names,
        values=x[:k],
        covariance=own,
        sizes=problem.size,
        determined=tuple((np.sqrt(np.diag(own)) <= DETERMINED * problem.size).tolist()),
        inseparable=tuple(
            (in_words(problem, one), separated_by(problem, one, x, u) if acts else WITHOUT_EFFECT)
            for one, acts in pairs
        ),
        rank=int((~open_).sum()),
        residual_um=_figures(by_pose(problem, zero), by_pose(problem, solved.residual)),
        left_out_um=(left[0] / MM_PER_UM, left[1] / MM_PER_UM),
        u_um=float(np.sqrt(np.mean(u**2)) / MM_PER_UM),
        u_from_residuals=estimated or max(scale) > 1.0,
        poses=len(joints),
        sphere_mm=_places(problem, read, x),
        notes=tuple(_notes(machine, read, linear, raised, [] if estimated else scale)),
        metadata=read[0].metadata,
        linear=Joint(state, x[k:m], solved.covariance[:m, :m]),
        kinds=tuple(dict.fromkeys(part.what for part in parts)),
    )
    if not (estimated or max(scale) > _MISFIT) or len(joints) < _MANY:
        return found
    return _with_motions(problem, found, x, u, np.where(np.isnan(stated), u, stated))


@dataclass(frozen=True)
class Joint:
    """What the poses say of the linear axes: their unknowns (r,), and the joint covariance of the rotary errors and these."""

    state: LinearState
    unknown: FloatArray
    covariance: FloatArray

    @property
    def root(self) -> FloatArray:
        """A factor (k + r, q) of the joint covariance; mm, rad and plain numbers are scaled, so that none counts as rounding."""
        size = np.sqrt(np.diag(self.covariance))
        return np.asarray(size[:, None] * root_of(self.covariance / np.outer(size, size)))


def _check_spheres(machine: Machine, spheres: SphereCentres) -> None:
    """InputError for an axis that turns the other way round, or a sphere at fewer than four poses."""
    wrong = [sense.text for sense in senses(machine, spheres) if sense.verdict == "reversed"]
    if wrong:
        raise InputError(
            Message(
                "rotary-sign-reversed",
                "{wrong}. Reverse the sign of its angles in the file, or find out which way it turns",
                wrong="; ".join(wrong),
            ),
            file=_file_of(spheres),
        )
    place, names = spheres.places
    for k, name in enumerate(names):
        if (place == k).sum() < 4:
            raise InputError(
                Message(
                    "few-poses",
                    "{name} was found at {place} poses; at least 4 are needed to say anything",
                    name=name,
                    place=(place == k).sum(),
                )
            )


def _adjusted(
    machine: Machine, parts: Sequence[PoseReadings], state: LinearState, known: RotaryErrors, u_um: float | None
) -> tuple[Problem, Solved, FloatArray, FloatArray, list[float], float]:
    """The problem with sizes and uncertainties that fit the readings, solved.

    Returns the problem and its solution, the uncertainty of each reading (m,), the stated one (nan: none), by how much each
    kind was widened, and by how much the sizes of the errors were raised.
    """
    problem, raised = Problem.of(machine, parts, state, known), 1.0
    stated = np.concatenate([part.u_mm for part in parts])
    stated = np.where(np.isnan(stated), np.nan if u_um is None else u_um * MM_PER_UM, stated)
    u = np.where(np.isnan(stated), 1e-3, stated)
    open_ = [bool(np.isnan(stated[rows]).any()) for rows in problem.rows]
    scale = [1.0] * len(parts)
    solved = solve(problem, u)
    for _ in range(_ROUNDS):
        k, settled = problem.errors, True
        worse = float(np.sqrt(np.mean((solved.x[:k] / problem.size) ** 2)))
        for j, (rows, freedom) in enumerate(zip(problem.rows, solved.freedom, strict=True)):
            wide = float(np.sqrt(np.sum((solved.residual[rows] / u[rows]) ** 2) / max(freedom, 1.0)))
            if wide < 1.0:  # a few readings that happen to fit do not say that there is no noise
                wide = max(wide, _FINEST_MM / float(u[rows].min())) if freedom >= _FEW_FREE else 1.0
            if open_[j] or wide > 1.02:
                u[rows] *= wide
                scale[j] *= wide
            settled = settled and (abs(wide - 1.0) < 0.02 or (not open_[j] and wide <= 1.02))
        if worse > _WORSE:
            raised *= worse
            problem = replace(problem, size=problem.size * worse)
        elif settled:
            break
        solved = solve(problem, u, solved.x)
    return problem, solved, u, stated, scale, raised


def _places(
    problem: Problem, read: Sequence[SphereCentres | Bars | PosedDeviations | PosedLengths], x: FloatArray
) -> dict[str, tuple[float, float, float]]:
    """Places of the spheres in the workpiece frame."""
    found: dict[str, tuple[float, float, float]] = {}
    for item, own in zip(read, problem.own, strict=True):
        if isinstance(item, SphereCentres):
            for name, (a, b, c) in zip(item.places[1], x[own].reshape(-1, 3).tolist(), strict=True):
                found[name] = (a, b, c)
    return found


def _notes(
    machine: Machine,
    read: Sequence[SphereCentres | Bars | PosedDeviations | PosedLengths],
    linear: Posterior | None,
    raised: float,
    scale: Sequence[float],
) -> list[str]:
    """What was assumed, what the spheres betray, and what does not fit."""
    notes = []
    if linear is None:
        notes.append(
            "Squareness and scales of the linear axes have the sizes that the class of the machine says; their curves count as "
            "noise. Measure the linear axes first: their errors are part of every pose."
        )
    else:
        notes.append(
            "Linear and rotary axes were adjusted together: curves of the linear axes that nobody measured have the sizes of the "
            "prior, and their uncertainty is in that of the rotary axes."
        )
    for item in read:
        if isinstance(item, SphereCentres):
            notes += _look(machine, item)
        elif isinstance(item, Bars) and item.u_nominal_mm is None:
            notes.append(
                "The length of the bar was not calibrated: its mean of each set-up says nothing. If it was, write "
                "'# u_nominal_um = ...' with its standard uncertainty."
            )
    if raised > 1.0:
        notes.append(
            f"The rotary axes are {raised:.1f} times as far off as the class of the machine says; its sizes were raised."
        )
    if max(scale, default=1.0) > _MISFIT:
        notes.append(
            f"The readings scatter {max(scale):.1f} times as much as they state; their uncertainty is widened. Something that no "
            "position error explains is in them."
        )
    return notes


#: Residuals of this many times what is stated, of this many poses, are looked at for error motions.
_MISFIT, _MANY = 1.3, 20


def _with_motions(
    problem: Problem, found: SphereIdentification, x: FloatArray, u_mm: FloatArray, stated_mm: FloatArray
) -> SphereIdentification:
    """The result with error motions over the angle, if the readings are far more probable with them."""
    from compgen.identification.rotary_motions import find_motions

    m, k, columns = problem.machine_unknowns, problem.errors, problem.columns(x)
    motions = find_motions(
        problem.machine,
        problem.angle_deg,
        lambda curves: -problem.with_curves(curves).residual(x),
        problem.pose,
        -columns,
        problem.residual(x) - columns @ x,
        problem.sizes**2,
        u_mm,
        free_noise=True,
    )
    if motions is None:
        return found
    value, own = motions.values, motions.covariance[:k, :k]
    after = by_pose(problem, motions.residual_mm) / MM_PER_UM
    plain = found.left_out_um[1]
    note = (
        f"Position errors alone do not explain the poses; with error motions over the angle (about "
        f"{1e3 * motions.size_mm:.0f} um for one period a turn) poses left out of the fit are "
        f"{motions.left_out_mm / MM_PER_UM:.1f} um off instead of {plain:.1f} um. "
        f"Determined: {', '.join(motions.curves) or 'none by itself'}; not told apart: {', '.join(motions.not_told) or 'none'}."
    )
    kept = [text for text in found.notes if "Something that no position error explains" not in text]
    if motions.noise_mm > 3.0 * float(np.median(stated_mm)) and not found.u_from_residuals:
        kept.append("The readings still scatter more than they state.")
    places = problem.own[0]
    return replace(
        found,
        errors=RotaryErrors(motions.curves, constants_of(problem.names, value[:k], np.sqrt(np.diag(own)))),
        values=value[:k],
        covariance=own,
        determined=tuple((np.sqrt(np.diag(own)) <= DETERMINED * problem.size).tolist()),
        residual_um={
            **found.residual_um,
            "after_rms": float(np.sqrt(np.mean(after**2))),
            "after_max": float(after.max()),
        },
        left_out_um=(found.left_out_um[0], motions.left_out_mm / MM_PER_UM),
        u_um=motions.noise_mm / MM_PER_UM,
        u_from_residuals=True,
        sphere_mm={
            name: (float(a), float(b), float(c))
            for name, (a, b, c) in zip(found.sphere_mm, value[places].reshape(-1, 3), strict=False)
        },
        notes=(*kept, note),
        motions_not_told=motions.not_told,
        linear=None
        if found.linear is None
        else replace(found.linear, unknown=value[k:m], covariance=motions.covariance[:m, :m]),
    )


def _centred(points: FloatArray, place: NDArray[np.int64]) -> FloatArray:
    out = points.copy()
    for k in np.unique(place):
        out[place == k] -= out[place == k].mean(axis=0)
    return out


def _figures(before: FloatArray, after: FloatArray) -> dict[str, float]:
    first, second = before / MM_PER_UM, after / MM_PER_UM
    return {
        "before_rms": float(np.sqrt(np.mean(first**2))),
        "before_max": float(first.max()),
        "after_rms": float(np.sqrt(np.mean(second**2))),
        "after_max": float(second.max()),
    }


def _look(machine: Machine, spheres: SphereCentres) -> list[str]:
    """What the sphere itself betrays: a probed diameter that changes with an angle; repeats of a pose that do not close."""
    from scipy.special import fdtrc  # imported here: slow to load

    notes = []
    diameter = spheres.diameter_mm
    known = ~np.isnan(diameter)
    if known.sum() >= 8:
        spread = float(np.std(diameter[known], ddof=1))
        for letter, angle in spheres.angle_deg.items():
            turns = np.round(np.mod(angle[known], 360.0) / 30.0).astype(int) % 12
            groups = [diameter[known][turns == k] for k in np.unique(turns) if (turns == k).sum() >= 2]
            if len(groups) < 2:
                continue
            within = np.concatenate([group - group.mean() for group in groups])
            freedom = len(within) - len(groups)
            inner = float(np.sqrt(np.sum(within**2) / max(freedom, 1)))
            means = np.array([group.mean() for group in groups])
            across = sum(len(group) * (group.mean() - np.mean(np.concatenate(groups))) ** 2 for group in groups)
            ratio = across / (len(groups) - 1) / max(inner, 1e-4) ** 2
            if freedom >= 3 and fdtrc(len(groups) - 1, freedom, ratio) < _UNLIKELY:
                notes.append(
                    f"The probed diameter of the sphere changes with {letter}: {means.min():.3f} to {means.max():.3f} mm "
                    f"({1e3 * inner:.0f} um within a sector). No position error does that: look at the probe (pre-travel and "
                    f"lobing against its direction), its calibration at this angle, or a spindle that turns with {letter}."
                )
        if not notes and spread > 5e-3:
            notes.append(
                f"The probed diameter scatters by {1e3 * spread:.0f} um (one standard deviation), without relation to an angle: "
                "look at the probe and its repeatability before the errors of the axes."
            )
    return notes
