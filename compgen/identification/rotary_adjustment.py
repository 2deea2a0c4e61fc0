"""Errors of rotary axes from readings at many poses, of any kinds, in one adjustment with what is known of the linear axes.

    residual(T(joints, angles; errors), own unknowns of the readings) = noise

Unknown are the position errors of the rotary axes (two offsets, two tilts and the zero of each), the errors of the linear axes
as far as they are known (:class:`~compgen.identification.rotary_linear.LinearState`), and what belongs to the readings: the
place of a sphere, the length of a bar. Every error has a normal prior; Gauss-Newton on the exact chain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.prior import CLASSES
from compgen.data.rotary import SPINDLE, RotaryErrors, position_names, si_per_unit, unit_of
from compgen.errors import ConvergenceError, Message
from compgen.identification.rotary_linear import LinearAt, LinearState
from compgen.identification.rotary_readings import PoseReadings, SpheresAt
from compgen.kinematics.rotary_chain import linear_columns, pose_of_values

#: Sizes of position errors of a machine that was set up by usual means (one standard deviation), um and urad.
OFFSET_UM, TILT_URAD = 100.0, 300.0
#: A combination is determined if its uncertainty is at most this share of what was assumed of it.
DETERMINED = 1.0 / 3.0
#: Names that appear in a combination with less than this share of the largest are left out of its words.
_NAMED = 0.25
_NO_PRIOR = 1e3
_STEPS, _SETTLED = 30, 1e-4
#: Steps of the difference quotients: mm, rad.
_STEP_MM, _STEP_RAD = 1e-3, 1e-6
#: Tilts from which the derivatives by the linear axes are calculated again, rad.
_FAR_RAD = 2e-3
#: Groups of poses that are left out in turn.
_FOLDS = 5
#: Precision of what is free, mm^-2: it keeps the equations solvable and is far below what any reading says.
_RIDGE = 1e-6


@dataclass(frozen=True)
class Problem:
    """Readings, and the unknowns in their order: position errors (k), linear axes (r), what belongs to the readings.

    On a machine with a rotary head the offset of the gauge point of the spindle (``TX``, ``TY``, ``TZ``: the pivot length) is
    among the position errors: it turns with the head. ``size`` (k,) are their sizes before the measurement.
    """

    machine: Machine
    parts: tuple[PoseReadings, ...]
    linear: LinearState
    names: tuple[str, ...]
    size: FloatArray
    known: RotaryErrors = field(default_factory=RotaryErrors)

    @classmethod
    def of(
        cls,
        machine: Machine,
        parts: Sequence[PoseReadings],
        linear: LinearState,
        known: RotaryErrors,
        raised: float = 1.0,
    ) -> Problem:
        """The problem with the sizes of the class of the machine, ``raised`` by a factor."""
        names = tuple(name for letter in machine.chain.rotary for name in position_names(letter))
        if any(tool_side and letter not in AXES for letter, tool_side in machine.chain.passed):
            names += SPINDLE
        prior = machine.prior
        # without a prior the sizes only keep the equations solvable
        factor = _NO_PRIOR if prior.is_none else CLASSES[prior.stated_class]
        usual = [(OFFSET_UM if unit_of(name) == "um" else TILT_URAD) * si_per_unit(name) for name in names]
        return cls(machine, tuple(parts), linear, names, raised * factor * np.array(usual), known)

    @property
    def errors(self) -> int:
        """Number of position errors."""
        return len(self.names)

    @property
    def machine_unknowns(self) -> int:
        """Number of unknowns of the machine."""
        return self.errors + self.linear.size

    @cached_property
    def own(self) -> tuple[slice, ...]:
        """Columns of the further unknowns of each kind of readings."""
        ends = self.machine_unknowns + np.cumsum([0, *(len(part.sizes) for part in self.parts)])
        return tuple(slice(int(a), int(b)) for a, b in zip(ends, ends[1:], strict=False))

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """Rows of the readings of each kind."""
        ends = np.cumsum([0, *(len(part.of_pose) for part in self.parts)])
        return tuple(slice(int(a), int(b)) for a, b in zip(ends, ends[1:], strict=False))

    @cached_property
    def pose(self) -> NDArray[np.int64]:
        """Number of the pose of each reading over all kinds."""
        starts = np.cumsum([0, *(len(part.joint_mm) for part in self.parts)])
        return np.concatenate([part.of_pose + start for part, start in zip(self.parts, starts, strict=False)])

    @cached_property
    def sizes(self) -> FloatArray:
        """Standard deviations of all unknowns before the readings; inf for what is free."""
        return np.concatenate([self.size, np.ones(self.linear.size), *(part.sizes for part in self.parts)])

    @cached_property
    def _linear_at(self) -> tuple[LinearAt, ...]:
        return tuple(self.linear.at(part.joint_mm) for part in self.parts)

    @cached_property
    def _linear_design(self) -> tuple[FloatArray, ...]:
        """Derivatives (n, 3, r) of the tips by what is unknown of the linear axes."""
        return self._design_with(RotaryErrors())

    def _design_with(self, rotary: RotaryErrors) -> tuple[FloatArray, ...]:
        return tuple(
            at.design(linear_columns(self.machine, part.joint_mm, part.angle_deg, part.tool_mm, rotary)[:, :3])
            for part, at in zip(self.parts, self._linear_at, strict=True)
        )

    @property
    def angle_deg(self) -> dict[str, FloatArray]:
        """Angles of each axis at all poses."""
        return {
            letter: np.concatenate([part.angle_deg[letter] for part in self.parts]) for letter in self.machine.rotary
        }

    def start(self) -> FloatArray:
        """Unknowns of a machine without errors of rotary axes."""
        tips = self.tips(np.zeros(self.machine_unknowns))
        own = [part.start(tip) for part, tip in zip(self.parts, tips, strict=True)]
        return np.concatenate([np.zeros(self.machine_unknowns), *own])

    def tips(self, x: FloatArray) -> list[FloatArray]:
        """Tips at the poses of each kind."""
        k = self.errors
        rotary = RotaryErrors(self.known.curves, constants_of(self.names, x[:k], np.zeros(k)))
        return [
            pose_of_values(
                self.machine,
                at.values(x[k : self.machine_unknowns]),
                rotary,
                part.joint_mm,
                part.angle_deg,
                part.tool_mm,
            )[0]
            for part, at in zip(self.parts, self._linear_at, strict=True)
        ]

    def residual(self, x: FloatArray) -> FloatArray:
        """Model minus reading of all readings, mm."""
        return np.concatenate(
            [part.residual(tip, x[own]) for part, tip, own in zip(self.parts, self.tips(x), self.own, strict=True)]
        )

    def columns(self, x: FloatArray) -> FloatArray:
        """Derivatives of the residuals by all unknowns."""
        tips, k, m = self.tips(x), self.errors, self.machine_unknowns
        by_error = [np.zeros((len(tip), 3, k)) for tip in tips]
        for j, name in enumerate(self.names):
            step = np.zeros(len(x))
            step[j] = _STEP_MM if unit_of(name) == "um" else _STEP_RAD
            for found, high, low in zip(by_error, self.tips(x + step), self.tips(x - step), strict=True):
                found[:, :, j] = (high - low) / (2.0 * step[j])
        tilts = [value for name, value in zip(self.names, x, strict=False) if unit_of(name) != "um"]
        linear = (
            self._linear_design
        )  # of a machine without errors: near enough unless its axes are far off, or nothing is assumed
        if np.abs(tilts).max(initial=0.0) > _FAR_RAD:
            linear = self._design_with(RotaryErrors({}, constants_of(self.names, x[:k], np.zeros(k))))
        columns = np.zeros((self.rows[-1].stop, len(self.sizes)))
        for part, tip, own, rows, turned, straight in zip(
            self.parts, tips, self.own, self.rows, by_error, linear, strict=True
        ):
            by_tip, columns[rows, own] = part.slopes(tip, x[own])
            columns[rows, :k] = np.einsum("mi,mij->mj", by_tip, turned[part.of_pose])
            columns[rows, k:m] = np.einsum("mi,mij->mj", by_tip, straight[part.of_pose])
        return columns

    def with_curves(self, curves: Mapping[str, object]) -> Problem:
        """The problem with further known error motions."""
        return replace(self, known=RotaryErrors({**self.known.curves, **curves}))  # type: ignore[dict-item]


def constants_of(names: Sequence[str], values: FloatArray, u: FloatArray) -> dict[str, tuple[float, float]]:
    """Constants of the rotary axes by name."""
    return {name: (float(value), float(own)) for name, value, own in zip(names, values, u, strict=True)}


@dataclass(frozen=True)
class Solved:
    """Unknowns, residuals (m,), joint covariance, and by kind of readings the degrees of freedom."""

    x: FloatArray
    residual: FloatArray
    covariance: FloatArray
    freedom: tuple[float, ...]


def solve(problem: Problem, u_mm: FloatArray, start: FloatArray | None = None) -> Solved:
    """Gauss-Newton with the priors; ``u_mm`` (m,) of all readings. ConvergenceError if it does not settle."""
    free = ~np.isfinite(problem.sizes)
    size = np.where(free, 1.0, problem.sizes)
    precision = np.where(free, 0.0, 1.0)
    x = problem.start() if start is None else start
    for _ in range(_STEPS):
        jacobian = problem.columns(x) * size / u_mm[:, None]
        residual = problem.residual(x) / u_mm
        normal = jacobian.T @ jacobian + np.diag(precision)
        normal[free, free] += _RIDGE
        step = np.linalg.solve(normal, -(jacobian.T @ residual) - precision * x / size)
        x = x + step * size
        if np.abs(jacobian @ step).max() < _SETTLED:
            break
    else:
        raise ConvergenceError(
            Message(
                "rotary-errors-not-found",
                "the position errors of the rotary axes were not found; are the angles and the chain right?",
            )
        )
    inverse = np.linalg.inv(normal)
    leverage = np.einsum("ij,jk,ik->i", jacobian, inverse, jacobian)
    freedom = tuple(float(rows.stop - rows.start - leverage[rows].sum()) for rows in problem.rows)
    return Solved(x, problem.residual(x), inverse * np.outer(size, size), freedom)


def information(problem: Problem, x: FloatArray, u_mm: FloatArray) -> FloatArray:
    """Information of the readings about the position errors in units of their size, (k, k); everything else is eliminated."""
    k, free = problem.errors, ~np.isfinite(problem.sizes)
    jacobian = problem.columns(x) * np.where(free, 1.0, problem.sizes) / u_mm[:, None]
    normal = jacobian.T @ jacobian
    rest = np.arange(k, len(free))
    normal[rest, rest] += np.where(free[k:], _RIDGE, 1.0)
    eliminated = np.linalg.solve(normal[k:, k:], normal[k:, :k])
    return np.asarray(normal[:k, :k] - normal[:k, k:] @ eliminated)


def directions(problem: Problem, x: FloatArray, u_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Combinations (k, k) of the position errors, columns, and their uncertainty after the readings over that before, (k,)."""
    value, vector = np.linalg.eigh(information(problem, x, u_mm))
    return vector, 1.0 / np.sqrt(1.0 + np.maximum(value, 0.0))


def in_words(problem: Problem, direction: FloatArray) -> str:
    """The errors of a combination."""
    largest = np.abs(direction).max()
    named = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) >= _NAMED * largest]
    return " with ".join(problem.names[k] for k in named)


def separated_by(problem: Problem, direction: FloatArray, x: FloatArray, u_mm: FloatArray) -> str:
    """What would determine a combination: a second probe length, another place of the sphere, other poses, a sphere at all."""
    for words, more in _additions(problem):
        total = replace(problem, parts=(*problem.parts, *more))
        u = np.concatenate([u_mm, *(np.full(len(part.of_pose), float(np.median(u_mm))) for part in more)])
        start = np.concatenate([x, *(part.start(tip) for part, tip in zip(more, _tips(total, x, more), strict=True))])
        known = information(total, start, u)
        if np.sqrt(direction @ np.linalg.solve(np.eye(len(known)) + known, direction)) <= DETERMINED:
            return words
    return "nothing of this kind: it needs another measurement (a dial gauge on the axis, a square, an angle reference)"


def _tips(total: Problem, x: FloatArray, more: Sequence[PoseReadings]) -> list[FloatArray]:
    return total.tips(x[: total.machine_unknowns])[-len(more) :]


def _additions(problem: Problem) -> list[tuple[str, tuple[PoseReadings, ...]]]:
    """Measurements that may separate what cannot be told apart, with the words for them."""
    rng = np.random.default_rng(0)
    spheres = [part for part in problem.parts if isinstance(part, SpheresAt)]
    if not spheres:
        first = problem.parts[0]
        at, tool = first.joint_mm.mean(axis=0), first.tool_mm[0]
        one = at_poses(at, any_angles(problem.machine, rng, 60), tool)
        longer = replace(one, tool_mm=one.tool_mm + np.array([0.0, 0.0, -100.0]))
        return [
            ("a sphere under the probe, at 60 poses over the whole range of all rotary axes", (one,)),
            ("a sphere under the probe, at 60 poses, with two probes of lengths 100 mm apart", (one, longer)),
        ]
    own = spheres[0]
    count = max(60, len(own.joint_mm))
    many = at_poses(own.joint_mm.mean(axis=0), any_angles(problem.machine, rng, count), own.tool_mm[0])
    longer = replace(own, tool_mm=own.tool_mm + np.array([0.0, 0.0, -100.0]))
    moved = replace(own, joint_mm=own.joint_mm + np.array([80.0, 50.0, 30.0]))
    return [
        ("more poses over the whole range of all rotary axes", (many,)),
        ("the same poses with a probe 100 mm longer", (longer,)),
        ("the sphere at another place, 80 to 100 mm away", (moved,)),
    ]


def at_poses(joint_mm: FloatArray, angle_deg: Mapping[str, FloatArray], tool_mm: FloatArray) -> SpheresAt:
    """A sphere at poses, all near one position of the axes, nothing read."""
    count = len(next(iter(angle_deg.values())))
    return SpheresAt(
        np.tile(joint_mm, (count, 1)) if joint_mm.ndim == 1 else joint_mm,
        angle_deg,
        np.array(np.broadcast_to(tool_mm, (count, 3))),
        np.repeat(np.arange(count), 3),
        np.full(3 * count, np.nan),
        np.zeros((count, 3)),
        np.zeros(count, dtype=np.int64),
    )


def any_angles(machine: Machine, rng: np.random.Generator, count: int) -> dict[str, FloatArray]:
    """Angles over the travel of every rotary axis."""
    return {letter: rng.uniform(*axis.ends_deg, count) for letter, axis in machine.rotary.items()}


#: Effect on a part, relative to that of the errors of a combination one by one, below which the combination has none.
_NO_EFFECT = 0.02


def split(problem: Problem, open_: FloatArray) -> list[tuple[FloatArray, bool]]:
    """Combinations (k,) that span the undetermined ones (k, r), and whether each has an effect on parts.

    Combinations without effect move and turn the workpiece as a whole: over the travel, all angles and tools. Each is
    written with as few errors as possible.
    """
    effect = _effects(problem)
    _, strength, across = np.linalg.svd(effect @ open_, full_matrices=True)
    turned = open_ @ across.T
    none = (
        np.append(strength, np.zeros(turned.shape[1] - len(strength)))
        <= _NO_EFFECT * np.linalg.norm(effect, axis=0).max()
    )
    return [(column, bool(acts)) for acts in (True, False) for column in _sparse(turned[:, none != acts]).T]


def _sparse(basis: FloatArray) -> FloatArray:
    """Columns that span the same as ``basis`` (k, r), each with a leading error that the others lack, of unit length."""
    if not basis.shape[1]:
        return basis
    work, rows = basis.copy(), []
    for _ in range(basis.shape[1]):
        size = np.linalg.norm(work, axis=1)
        row = int(np.argmax(size))
        rows.append(row)
        along = work[row] / size[row]
        work = work - np.outer(work @ along, along)
    found = basis @ np.linalg.inv(basis[rows])
    return np.asarray(found / np.linalg.norm(found, axis=0))


def _effects(problem: Problem) -> FloatArray:
    """What each position error of its size does to points of a part (3 n, k), the motion of the whole workpiece removed."""
    machine, count, k = problem.machine, 200, problem.errors
    rng = np.random.default_rng(1)
    lower, upper = np.maximum(machine.lower_mm, -1e3), np.minimum(machine.upper_mm, 1e3)
    tools = problem.parts[0].tool_mm[0] + rng.uniform(0.0, 100.0, (count, 1)) * np.array([0.0, 0.0, -1.0])
    anywhere = at_poses(rng.uniform(lower, upper, (count, 3)), any_angles(machine, rng, count), tools)
    own = replace(problem, parts=(anywhere,), linear=LinearState.usual(machine))
    x = own.start()
    tip = own.tips(x)[0]
    zero, (a, b, c) = np.zeros(count), tip.T
    turn = np.stack([zero, c, -b, -c, zero, a, b, -a, zero], axis=1).reshape(count, 3, 3)
    rigid = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), turn], axis=2).reshape(3 * count, 6)
    moved = own.columns(x)[:, :k] * problem.size
    return np.asarray(moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0])


def without_errors(problem: Problem) -> FloatArray:
    """Residuals (m,) of a machine whose rotary axes have no errors, the further unknowns of the readings fitted."""
    x, m = problem.start(), problem.machine_unknowns
    for _ in range(_STEPS):
        columns, residual = problem.columns(x)[:, m:], problem.residual(x)
        step = np.linalg.lstsq(columns, -residual, rcond=1e-12)[0]
        x[m:] += step
        if np.abs(columns @ step).max() < 1e-6:
            break
    return problem.residual(x)


def by_pose(problem: Problem, residual: FloatArray) -> FloatArray:
    """Size of the residuals of each pose, mm."""
    square = np.bincount(problem.pose, residual**2)
    return np.asarray(np.sqrt(square[np.unique(problem.pose)]))


def left_out(problem: Problem, x: FloatArray, u_mm: FloatArray, zero: FloatArray) -> tuple[float, float]:
    """Rms over poses that were left out of the fit in turn, mm: without errors of rotary axes, and fitted.

    Each fit is one linear step from the fit of all poses; ``zero`` are the residuals without errors (:func:`without_errors`).
    nan if there are too few poses.
    """
    poses = int(problem.pose.max()) + 1
    fewest = min(len(part.joint_mm) / (len(part.sizes) / 3.0) for part in problem.parts)
    if fewest < 3 * _FOLDS:
        return np.nan, np.nan
    m, free = problem.machine_unknowns, ~np.isfinite(problem.sizes)
    columns, residual = problem.columns(x), problem.residual(x)
    prior = np.where(free, 0.0, 1.0 / np.where(free, 1.0, problem.sizes) ** 2)
    fold = (np.random.default_rng(0).permutation(poses) % _FOLDS)[problem.pose]
    before = after = 0.0
    for k in range(_FOLDS):
        inside = fold != k
        weighted = columns[inside] / u_mm[inside, None] ** 2
        normal = weighted.T @ columns[inside] + np.diag(prior)
        normal[free, free] += _RIDGE
        step = np.linalg.solve(normal, -(weighted.T @ residual[inside]) - prior * x)
        after += float(np.sum((residual + columns @ step)[~inside] ** 2))
        own = np.linalg.lstsq(columns[inside, m:], -zero[inside], rcond=1e-12)[0]
        before += float(np.sum((zero + columns[:, m:] @ own)[~inside] ** 2))
    return float(np.sqrt(before / poses)), float(np.sqrt(after / poses))
