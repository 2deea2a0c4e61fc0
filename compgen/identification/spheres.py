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
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, MM_PER_UM, SQUARENESS_NAMES
from compgen.data.prior import CLASSES, USUAL_CLASS
from compgen.data.rotary import (
    JOINTS,
    SPINDLE,
    TIP,
    RotaryCurve,
    RotaryErrors,
    SphereCentres,
    position_names,
    si_per_unit,
    unit_of,
)
from compgen.drawing.display import Displayed, Overview
from compgen.errors import ConvergenceError, InputError
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose

#: Sizes of position errors of a machine that was set up by usual means (one standard deviation), um and urad.
OFFSET_UM, TILT_URAD = 100.0, 300.0
#: A combination is determined if its uncertainty is at most this share of what was assumed of it.
DETERMINED = 1.0 / 3.0
#: Names that appear in a combination with less than this share of the largest are left out of its words.
_NAMED = 0.25
_NO_PRIOR = 1e3
#: Errors of this many times their size say that the machine is worse than its class; the sizes grow until they are not.
_WORSE = 2.0
_STEPS, _SETTLED = 30, 1e-4
#: Steps of the difference quotients: mm, rad, relative.
_STEP_MM, _STEP_RAD = 1e-3, 1e-6
#: Times the uncertainty of the readings, and the sizes of the errors, follow the residuals.
_ROUNDS = 8
WITHOUT_EFFECT = "nothing needs to: it moves or turns the workpiece as a whole, and setting up the part removes it"
#: A diameter changes with an angle if chance explains it with a smaller probability only (F test over sectors of 30 degrees).
_UNLIKELY = 1e-4
#: Groups of poses that are left out in turn.
_FOLDS = 5


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
class _Model:
    """The unknowns in their order: position errors, then squareness and scales of the linear axes, places of the spheres.

    On a machine with a rotary head the offset of the gauge point of the spindle (``TX``, ``TY``, ``TZ``: the pivot length) is
    among the position errors: it turns with the head.
    """

    machine: Machine
    spheres: SphereCentres
    joint_mm: FloatArray
    names: tuple[str, ...]
    size: FloatArray
    known: RotaryErrors = field(default_factory=RotaryErrors)

    @property
    def errors(self) -> int:
        return len(self.names)

    def tables(self, x: FloatArray) -> tuple[ErrorTable, RotaryErrors]:
        """The errors that the unknowns ``x`` say."""
        k = self.errors
        squareness = {name: (float(value), 0.0) for name, value in zip(SQUARENESS_NAMES, x[k : k + 3], strict=True)}
        curves = {}
        for axis, scale in zip(range(3), x[k + 3 : k + 6], strict=True):
            at = np.array(self.machine.axes[axis].range_mm)
            value = scale * (at - self.machine.reference_point_mm[axis])
            curves[f"E{AXES[axis]}{AXES[axis]}"] = Curve(at, value, np.zeros(2))
        return ErrorTable(curves, squareness), RotaryErrors(
            self.known.curves, _constants(self.names, x[:k], np.zeros(k))
        )

    def tip(self, x: FloatArray) -> FloatArray:
        """Tip minus what an R-test read, (n, 3): where the sphere must be."""
        tip = tip_pose(self.machine, *self.tables(x), self.joint_mm, self.spheres.angle_deg, self.spheres.tool_mm)[0]
        return tip - np.nan_to_num(self.spheres.deviation_mm)

    def columns(self, x: FloatArray) -> FloatArray:
        """Derivatives (3 n, k + 6) of the tip by errors of the machine, central differences."""
        found = []
        for j in range(len(self.size)):
            step = np.zeros(len(x))
            step[j] = _STEP_MM if j < self.errors and _unit(self.names[j])[0] == "um" else _STEP_RAD
            found.append((self.tip(x + step) - self.tip(x - step)).ravel() / (2 * step[j]))
        return np.stack(found, axis=1)

    def places(self) -> FloatArray:
        """Derivatives (3 n, 3 m) of the residuals by the places of the spheres."""
        place, names = self.spheres.places
        pick = np.eye(len(names))[place]
        return np.asarray(-np.einsum("nm,ij->nimj", pick, np.eye(3)).reshape(3 * len(place), 3 * len(names)))


def _constants(names: Sequence[str], values: FloatArray, u: FloatArray) -> dict[str, tuple[float, float]]:
    """Constants of the rotary axes by name."""
    return {name: (float(value), float(own)) for name, value, own in zip(names, values, u, strict=True)}


def _model(machine: Machine, spheres: SphereCentres, known: RotaryErrors, raised: float = 1.0) -> _Model:
    joints = spheres.found_mm
    if spheres.coordinates == TIP:
        joints = joints_of_tip(machine, joints, spheres.angle_deg, spheres.tool_mm)
    names = tuple(name for letter in machine.chain.rotary for name in position_names(letter))
    if any(tool_side and letter not in AXES for letter, tool_side in machine.chain.passed):
        names += SPINDLE
    prior = machine.prior
    # without a prior the sizes only keep the equations solvable
    factor = _NO_PRIOR if prior.is_none else CLASSES[prior.stated_class]
    usual = replace(prior, class_name=USUAL_CLASS) if prior.is_none else prior
    sizes = [factor * (OFFSET_UM if _unit(name)[0] == "um" else TILT_URAD) * _unit(name)[1] for name in names]
    linear = [*(usual.size(name) for name in SQUARENESS_NAMES), *(usual.scale(f"E{axis}{axis}") for axis in AXES)]
    return _Model(machine, spheres, joints, names, np.array([*(raised * np.array(sizes)), *linear]), known)


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
        raise InputError("contains one pose; two poses of one sphere are needed", file=_file_of(spheres))
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
    """Identify the position errors of all rotary axes from sphere centres.

    Parameters
    ----------
    machine : a machine with rotary axes.
    spheres : centres at poses, from :func:`compgen.data.rotary.read_spheres`.
    u_um : standard uncertainty of a coordinate where the file states none; None: from the residuals.
    separate : look for what would separate combinations that the readings cannot tell apart.
    known : error motions that were measured otherwise, such as the positioning of an axis; taken as they are.

    Raises
    ------
    InputError
        for fewer than four poses of a sphere, and for an axis that turns the other way round than the machine file says.
    """
    wrong = [sense.text for sense in senses(machine, spheres) if sense.verdict == "reversed"]
    if wrong:
        text = "; ".join(wrong)
        raise InputError(
            f"{text}. Reverse the sign of its angles in the file, or find out which way it turns",
            file=_file_of(spheres),
        )
    known = RotaryErrors() if known is None else known
    model, raised = _model(machine, spheres, known), 1.0
    place, names = spheres.places
    for k, name in enumerate(names):
        if (place == k).sum() < 4:
            raise InputError(f"{name} was found at {(place == k).sum()} poses; at least 4 are needed to say anything")
    stated = np.where(np.isnan(spheres.u_mm), np.nan if u_um is None else u_um * MM_PER_UM, spheres.u_mm)
    estimated = bool(np.isnan(stated).any())
    u = np.full(len(spheres), 1e-3) if estimated else stated
    scale = 1.0
    for _ in range(_ROUNDS):
        x, residual, covariance, freedom = _solve(model, u)
        wide = float(np.sqrt(np.sum((residual / u[:, None]) ** 2) / max(freedom, 1.0)))
        worse = float(np.sqrt(np.mean((x[: model.errors] / model.size[: model.errors]) ** 2)))
        if worse > _WORSE:
            raised *= worse
            model = _model(machine, spheres, known, raised)
        if estimated or wide > 1.02:
            u, scale = u * wide, scale * wide
        if worse <= _WORSE and abs(wide - 1.0) < 0.02 or (not estimated and wide <= 1.02 and worse <= _WORSE):
            break
    k = model.errors
    own = covariance[:k, :k]
    directions, shares = _directions(model, x, u)
    open_ = shares > DETERMINED
    pairs = _split(model, directions[:, open_]) if separate and open_.any() else []
    before = _centred(model.tip(np.zeros(k + 6)), place)
    notes = [
        "Squareness and scales of the linear axes have the sizes that the class of the machine says; their curves count as "
        "noise. Measure the linear axes first: their errors are part of every pose.",
        *_look(machine, spheres),
    ]
    if raised > 1.0:
        notes.append(
            f"The rotary axes are {raised:.1f} times as far off as the class of the machine says; its sizes were raised."
        )
    if not estimated and scale > 1.3:
        notes.append(
            f"The readings scatter {scale:.1f} times as much as they state; their uncertainty is widened. Something that no "
            "position error explains is in them."
        )
    found = SphereIdentification(
        errors=RotaryErrors({}, _constants(model.names, x[:k], np.sqrt(np.diag(own)))),
        names=model.names,
        values=x[:k],
        covariance=own,
        sizes=model.size[:k],
        determined=tuple((np.sqrt(np.diag(own)) <= DETERMINED * model.size[:k]).tolist()),
        inseparable=tuple(
            (_in_words(model, one), _separated_by(model, one, u) if acts else WITHOUT_EFFECT) for one, acts in pairs
        ),
        rank=int((~open_).sum()),
        residual_um=_figures(before, residual),
        left_out_um=_left_out(model, x, u),
        u_um=float(np.sqrt(np.mean(u**2)) / MM_PER_UM),
        u_from_residuals=estimated or scale > 1.0,
        poses=len(spheres),
        sphere_mm={name: tuple(x[k + 6 + 3 * j : k + 9 + 3 * j].tolist()) for j, name in enumerate(names)},
        notes=tuple(notes),
        metadata=spheres.metadata,
    )
    if not (estimated or scale > _MISFIT) or len(spheres) < _MANY:
        return found
    return _with_motions(model, found, x, u, stated if not estimated else u)


#: Residuals of this many times what is stated, of this many poses, are looked at for error motions.
_MISFIT, _MANY = 1.3, 20


def _with_motions(
    model: _Model, found: SphereIdentification, x: FloatArray, u_mm: FloatArray, stated_mm: FloatArray
) -> SphereIdentification:
    """The result with error motions over the angle, if the readings are far more probable with them."""
    from compgen.identification.rotary_motions import find_motions

    m, k, places = len(model.size), model.errors, model.places()
    columns = np.hstack([model.columns(x[:m]), places])

    def tip_with(curves: Mapping[str, RotaryCurve]) -> FloatArray:
        return replace(model, known=RotaryErrors({**model.known.curves, **curves})).tip(x[:m])

    motions = find_motions(
        model.machine,
        model.spheres.angle_deg,
        lambda curves: -tip_with(curves),
        -columns,
        model.tip(x[:m]).ravel() + places @ x[m:] - columns @ x,
        np.concatenate([model.size**2, np.full(places.shape[1], np.inf)]),
        u_mm,
        free_noise=True,
    )
    if motions is None:
        return found
    value, own = motions.values, motions.covariance[:k, :k]
    after = np.linalg.norm(motions.residual_mm, axis=1) / MM_PER_UM
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
    return replace(
        found,
        errors=RotaryErrors(motions.curves, _constants(model.names, value[:k], np.sqrt(np.diag(own)))),
        values=value[:k],
        covariance=own,
        determined=tuple((np.sqrt(np.diag(own)) <= DETERMINED * model.size[:k]).tolist()),
        residual_um={
            **found.residual_um,
            "after_rms": float(np.sqrt(np.mean(after**2))),
            "after_max": float(after.max()),
        },
        left_out_um=(found.left_out_um[0], motions.left_out_mm / MM_PER_UM),
        u_um=motions.noise_mm / MM_PER_UM,
        u_from_residuals=True,
        sphere_mm={
            name: tuple(value[m + 3 * j : m + 3 + 3 * j].tolist()) for j, name in enumerate(model.spheres.places[1])
        },
        notes=(*kept, note),
        motions_not_told=motions.not_told,
    )


def _solve(model: _Model, u_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Unknowns, residuals (n, 3), covariance, and degrees of freedom: Gauss-Newton on the exact chain with the prior."""
    places, m = model.places(), len(model.size)
    x = np.zeros(m)
    root = np.repeat(1.0 / u_mm, 3)[:, None]
    size = np.concatenate([model.size, np.ones(places.shape[1])])
    precision = np.concatenate([np.ones(m), np.zeros(places.shape[1])])  # of the unknowns in units of their size
    for _ in range(_STEPS):
        jacobian = root * np.hstack([model.columns(x[:m]), places]) * size
        at = np.zeros(places.shape[1]) if len(x) == m else x[m:]
        residual = root[:, 0] * (model.tip(x[:m]).ravel() + places @ at)
        full = np.concatenate([x[:m], at])
        normal = jacobian.T @ jacobian + np.diag(precision)
        step = np.linalg.solve(normal, -(jacobian.T @ residual) - precision * full / size)
        x = full + step * size
        if np.abs(jacobian @ (x / size - full / size)).max() < _SETTLED:
            break
    else:
        raise ConvergenceError(
            "the position errors of the rotary axes were not found; are the angles and the chain right?"
        )
    inverse = np.linalg.inv(normal)
    residual = (model.tip(x[:m]).ravel() + places @ x[m:]).reshape(-1, 3)
    freedom = residual.size - float(np.trace(inverse @ (jacobian.T @ jacobian)))
    return x, residual, inverse * np.outer(size, size), freedom


def _information(model: _Model, x: FloatArray, u_mm: FloatArray) -> FloatArray:
    """Information of the readings alone about the position errors in units of their size, (k, k).

    Places of the spheres are free, squareness and scales have their prior.
    """
    k, m = model.errors, len(model.size)
    root = np.repeat(1.0 / u_mm, 3)[:, None]
    jacobian = root * np.hstack([model.columns(x[:m]) * model.size, model.places()])
    normal = jacobian.T @ jacobian
    normal[np.arange(k, m), np.arange(k, m)] += 1.0
    rest = np.linalg.solve(normal[k:, k:], normal[k:, :k])
    return np.asarray(normal[:k, :k] - normal[:k, k:] @ rest)


def _directions(model: _Model, x: FloatArray, u_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Combinations (k, k) of the position errors, columns, and their uncertainty after the readings over that before, (k,)."""
    value, vector = np.linalg.eigh(_information(model, x, u_mm))
    return vector, 1.0 / np.sqrt(1.0 + np.maximum(value, 0.0))


def _in_words(model: _Model, direction: FloatArray) -> str:
    largest = np.abs(direction).max()
    named = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) >= _NAMED * largest]
    return " with ".join(model.names[k] for k in named)


def _separated_by(model: _Model, direction: FloatArray, u_mm: FloatArray) -> str:
    """What would determine a combination: a second probe length, another place of the sphere, or other poses."""
    spheres = model.spheres
    machine = model.machine
    longer = replace(spheres, tool_mm=spheres.tool_mm + np.array([0.0, 0.0, -100.0]))
    count = max(60, len(spheres))
    many = _poses(
        np.tile(model.joint_mm.mean(axis=0), (count, 1)),
        _any_angles(machine, np.random.default_rng(0), count),
        np.tile(spheres.tool_mm[0], (count, 1)),
    )
    moved = replace(spheres, setup=spheres.setup + 1000)
    shift = np.array([80.0, 50.0, 30.0])
    options = (
        ("more poses over the whole range of all rotary axes", many, model.joint_mm.mean(axis=0), 0.0),
        ("the same poses with a probe 100 mm longer", longer, None, 0.0),
        ("the sphere at another place, 80 to 100 mm away", moved, None, shift),
    )
    base = _information(model, np.zeros(len(model.size)), u_mm)
    for words, more, joint, offset in options:
        joints = np.tile(joint, (len(more), 1)) if joint is not None else model.joint_mm + offset
        other = replace(model, spheres=more, joint_mm=np.asarray(joints, dtype=float))
        u = np.full(len(more), float(np.median(u_mm)))
        # the places of the spheres are others: information adds up
        total = base + _information(other, np.zeros(len(model.size)), u)
        inside = float(direction @ np.linalg.solve(np.eye(len(total)) + total, direction))
        if np.sqrt(inside) <= DETERMINED:
            return words
    return "nothing of this kind: it needs another measurement (a dial gauge on the axis, a square, an angle reference)"


#: Effect on a part, relative to that of the errors of a combination one by one, below which the combination has none.
_NO_EFFECT = 0.02


def _split(model: _Model, open_: FloatArray) -> list[tuple[FloatArray, bool]]:
    """Combinations (k,) that span the undetermined ones (k, r), and whether each has an effect on parts.

    Combinations without effect move and turn the workpiece as a whole: over the travel, all angles and tools. Each is
    written with as few errors as possible.
    """
    effect = _effects(model)
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


def _effects(model: _Model) -> FloatArray:
    """What each position error of its size does to points of a part (3 n, k), the motion of the whole workpiece removed."""
    machine, count = model.machine, 200
    rng = np.random.default_rng(1)
    lower, upper = np.maximum(machine.lower_mm, -1e3), np.minimum(machine.upper_mm, 1e3)
    tools = model.spheres.tool_mm[0] + rng.uniform(0.0, 100.0, (count, 1)) * np.array([0.0, 0.0, -1.0])
    anywhere = _poses(rng.uniform(lower, upper, (count, 3)), _any_angles(machine, rng, count), tools)
    own = replace(model, spheres=anywhere, joint_mm=anywhere.found_mm)
    x, y, z = own.tip(np.zeros(len(model.size))).T
    zero = np.zeros(count)
    turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(count, 3, 3)
    rigid = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), turn], axis=2).reshape(3 * count, 6)
    moved = own.columns(np.zeros(len(model.size)))[:, : model.errors] * model.size[: model.errors]
    return np.asarray(moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0])


def _any_angles(machine: Machine, rng: np.random.Generator, count: int) -> dict[str, FloatArray]:
    return {letter: rng.uniform(*axis.ends_deg, count) for letter, axis in machine.rotary.items()}


def _poses(joint_mm: FloatArray, angle_deg: Mapping[str, FloatArray], tool_mm: FloatArray) -> SphereCentres:
    """Poses of one sphere, nothing read."""
    count, nan = len(joint_mm), np.full(len(joint_mm), np.nan)
    return SphereCentres(
        joint_mm, np.full((count, 3), np.nan), JOINTS, angle_deg, tool_mm, ["sphere"] * count,
        np.zeros(count, dtype=np.int64), nan, nan, nan,
    )  # fmt: skip


def _centred(points: FloatArray, place: NDArray[np.int64]) -> FloatArray:
    out = points.copy()
    for k in np.unique(place):
        out[place == k] -= out[place == k].mean(axis=0)
    return out


def _figures(before: FloatArray, after: FloatArray) -> dict[str, float]:
    first, second = (np.linalg.norm(rows, axis=1) / MM_PER_UM for rows in (before, after))
    return {
        "before_rms": float(np.sqrt(np.mean(first**2))),
        "before_max": float(first.max()),
        "after_rms": float(np.sqrt(np.mean(second**2))),
        "after_max": float(second.max()),
    }


def _left_out(model: _Model, x: FloatArray, u_mm: FloatArray) -> tuple[float, float]:
    """Rms over poses that were left out of the fit in turn, um: with the sphere from the fitted poses, no errors and fitted.

    Each fit is one linear step from the fit of all poses.
    """
    place, names = model.spheres.places
    if min((place == k).sum() for k in range(len(names))) < 3 * _FOLDS:
        return np.nan, np.nan
    m, places = len(model.size), model.places()
    columns = np.hstack([model.columns(x[:m]), places])
    residual = model.tip(x[:m]).ravel() + places @ x[m:]
    zero = model.tip(np.zeros(m))
    prior = np.concatenate([model.size**-2.0, np.zeros(places.shape[1])])
    fold = np.random.default_rng(0).permutation(len(place)) % _FOLDS
    before, after = [], []
    for k in range(_FOLDS):
        inside = np.repeat(fold != k, 3)
        weighted = columns[inside] * np.repeat(u_mm, 3)[inside, None] ** -2.0
        normal = weighted.T @ columns[inside] + np.diag(prior)
        step = np.linalg.solve(normal, -(weighted.T @ residual[inside]) - prior * x)
        after.append((residual + columns @ step)[~inside])
        means = np.stack([zero[(place == j) & (fold != k)].mean(axis=0) for j in range(len(names))])
        before.append((zero - means[place])[fold == k].ravel())
    first, second = (float(np.sqrt(3.0 * np.mean(np.concatenate(rows) ** 2)) / MM_PER_UM) for rows in (before, after))
    return first, second


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
