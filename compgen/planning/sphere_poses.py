"""Poses of a machine with rotary axes at which its probe finds spheres, chosen for what they say of the rotary axes.

From all poses that the machine can reach, one after another is taken: the one that lowers the uncertainties of the position
errors most, each relative to what is assumed of it before. Nothing is measured; the figures are those that ``identify`` will
state for readings with the planned uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine, Vector3
from compgen.data.names import MM_PER_UM
from compgen.data.rotary import (
    JOINTS,
    Poses,
    RotaryErrors,
    SphereCentres,
    format_machine_errors,
    format_poses,
    si_per_unit,
    unit_of,
)
from compgen.errors import InputError
from compgen.identification.rotary_adjustment import (
    DETERMINED,
    Problem,
    constants_of,
    directions,
    in_words,
    information,
    separated_by,
    split,
)
from compgen.identification.rotary_linear import LinearState
from compgen.identification.rotary_readings import readings_at
from compgen.identification.spheres import WITHOUT_EFFECT
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose

#: Angles of an axis among which poses are chosen, and most combinations of all axes.
_ANGLES = 13
#: Poses of each sphere before any pose is chosen freely: fewer say nothing of it.
_FEWEST = 4
#: Numerical precision of what is free, relative to the readings.
_RIDGE = 1e-9
#: Largest angle between the tool and the stem of a sphere, which points away from the table along Z, degrees.
STEEPEST_DEG = 90.0


@dataclass(frozen=True)
class Motions:
    """Motions at n poses with five contacts each, positions of X, Y, Z in mm.

    Parameters
    ----------
    above : where a pose begins and ends, along the tool from the sphere, (n, 3).
    over : over the start of each contact, as high as the start of the last, (n, 5, 3); of the last it is its start.
    start, target : of the motion that ends at the contact, (n, 5, 3): four across the tool, and one along it.
    """

    above: FloatArray
    over: FloatArray
    start: FloatArray
    target: FloatArray

    @property
    def all(self) -> FloatArray:
        """All positions of each pose, (n, 16, 3)."""
        return np.concatenate([self.above[:, None], self.over, self.start, self.target], axis=1)


@dataclass(frozen=True)
class Reach:
    """How a sphere is touched: the distance of both centres at a contact, of the start from it, and beyond it, mm."""

    contact_mm: float = 13.0
    clearance_mm: float = 5.0
    overtravel_mm: float = 2.0


@dataclass(frozen=True)
class SpherePlan:
    """Poses in the order in which they are probed, and what they will determine.

    Parameters
    ----------
    spheres : the poses as a measurement without noise of a machine without errors.
    names, u, sizes : position errors, their standard uncertainty after the measurement, and what is assumed before; mm and rad.
    inseparable : combinations that the poses cannot tell apart: words, and what would separate them.
    rank : number of combinations that they determine.
    u_um : planned standard uncertainty of a coordinate of a centre.
    candidates : number of poses among which these were chosen.
    """

    machine: Machine
    spheres: SphereCentres
    names: tuple[str, ...]
    u: FloatArray
    sizes: FloatArray
    inseparable: tuple[tuple[str, str], ...]
    rank: int
    u_um: float
    candidates: int
    reach: Reach

    @property
    def determined(self) -> tuple[bool, ...]:
        """Whether the poses determine each error by itself."""
        return tuple((self.u <= DETERMINED * self.sizes).tolist())

    @property
    def motions(self) -> Motions:
        """How the sphere is touched at each pose."""
        return _motions(self.machine, self.spheres, self.reach)

    def summary(self) -> dict[str, object]:
        """Plain values for ``plan.json``; um and urad."""
        units = [si_per_unit(name) for name in self.names]
        return {
            "kind": "sphere",
            "machine": self.machine.name,
            "poses": len(self.spheres),
            "candidates": self.candidates,
            "u_um": self.u_um,
            "errors": {
                name: {"u": u / unit, "assumed": size / unit, "unit": unit_of(name), "determined": known}
                for name, u, size, unit, known in zip(
                    self.names, self.u.tolist(), self.sizes.tolist(), units, self.determined, strict=True
                )
            },
            "position_errors": len(self.names),
            "determined_combinations": self.rank,
            "inseparable": [{"errors": words, "separated_by": cure} for words, cure in self.inseparable],
        }

    def files(self) -> dict[str, str]:
        """``plan.points.csv`` (the poses) and ``plan.errors.csv`` (values zero, ``u_value`` predicted)."""
        poses = Poses(self.spheres.found_mm, self.spheres.angle_deg, self.spheres.tool_mm)
        metadata = {"machine": self.machine.name, "coordinates": JOINTS}
        constants = constants_of(self.names, np.zeros(len(self.u)), self.u)
        errors = format_machine_errors(ErrorTable(), RotaryErrors({}, constants), {"machine": self.machine.name})
        return {"plan.points.csv": format_poses(poses, {}, metadata), "plan.errors.csv": errors}


def plan_spheres(
    machine: Machine,
    spheres_mm: Sequence[Vector3],
    probe_lengths_mm: Sequence[float],
    *,
    count: int = 40,
    u_um: float = 2.0,
    reach: Reach | None = None,
    height_mm: float | None = None,
) -> SpherePlan:
    """Choose ``count`` poses for spheres at ``spheres_mm`` (workpiece frame) with probes of some lengths.

    Parameters
    ----------
    u_um : standard uncertainty of a coordinate of a centre.
    reach : how the spheres are touched; every motion stays within the travel.
    height_mm : Z of the motion between poses, which must be above every contact; None: the upper end of Z.

    Raises
    ------
    InputError
        for a machine without rotary axes, fewer poses than the spheres need, a sphere that no pose reaches.
    """
    if not machine.rotary:
        raise InputError(
            f"the machine {machine.name} has no rotary axis, and --sphere plans poses of rotary axes", field="--sphere"
        )
    if count < _FEWEST * len(spheres_mm):
        raise InputError(f"{count} poses are too few: each sphere needs {_FEWEST}", field="--count")
    reach = Reach() if reach is None else reach
    offered = _reachable(machine, spheres_mm, probe_lengths_mm, u_um, reach, height_mm)
    chosen = _chosen(_problem(machine, offered), offered.places[0], count, u_um * MM_PER_UM)
    spheres = offered.part(_in_order(offered, chosen))
    problem = _problem(machine, spheres)
    x, u = problem.start(), np.full(3 * len(spheres), u_um * MM_PER_UM)
    vectors, shares = directions(problem, x, u)
    open_ = shares > DETERMINED
    pairs = split(problem, vectors[:, open_]) if open_.any() else []
    return SpherePlan(
        machine=machine,
        spheres=spheres,
        names=problem.names,
        u=_uncertainties(problem, x, u),
        sizes=problem.size,
        inseparable=tuple(
            (in_words(problem, one), separated_by(problem, one, x, u) if acts else WITHOUT_EFFECT)
            for one, acts in pairs
        ),
        rank=int((~open_).sum()),
        u_um=u_um,
        candidates=len(offered),
        reach=reach,
    )


def _problem(machine: Machine, spheres: SphereCentres) -> Problem:
    return Problem.of(machine, [readings_at(machine, spheres)], LinearState.usual(machine), RotaryErrors())


def _angles(machine: Machine) -> dict[str, FloatArray]:
    """All combinations of angles of the rotary axes, each axis evenly over its travel."""
    single = []
    for axis in machine.rotary.values():
        low, high = axis.ends_deg
        single.append(np.linspace(low, high, _ANGLES)[: None if axis.modulo_deg is None else -1])
    grid = np.array(list(product(*single)))
    return {letter: np.round(grid[:, k], 3) for k, letter in enumerate(machine.rotary)}


def _reachable(
    machine: Machine,
    spheres_mm: Sequence[Vector3],
    lengths_mm: Sequence[float],
    u_um: float,
    reach: Reach,
    height_mm: float | None,
) -> SphereCentres:
    """All poses at which every motion is within the travel, and the tool does not come from below the sphere."""
    angle, parts = _angles(machine), []
    n = len(next(iter(angle.values())))
    for k, place in enumerate(spheres_mm, 1):
        some = False
        for length in lengths_mm:
            tool = np.tile(np.array(machine.tool_offset_mm) + [0.0, 0.0, -length], (n, 1))
            joints = joints_of_tip(machine, np.tile(place, (n, 1)), angle, tool)
            nan = np.full(n, np.nan)
            item = SphereCentres(
                joints, np.full((n, 3), np.nan), JOINTS, angle, tool, [f"S{k}"] * n, np.ones(n, dtype=np.int64),
                np.full(n, u_um * MM_PER_UM), nan, nan, {"instrument": "touch-probe"},
            )  # fmt: skip
            rows = np.flatnonzero(_within(machine, item, reach, height_mm))
            some = some or len(rows) > 0
            parts += [item.part(rows)] if len(rows) else []
        if not some:
            raise InputError(
                f"sphere {k} at {', '.join(f'{value:g}' for value in place)} mm cannot be probed at any angle within the travel "
                "of X, Y and Z; is it a place in the workpiece frame (all axes at zero), and is the length of the probe right?",
                field="--sphere",
            )
    return _joined(parts)


def _joined(parts: Sequence[SphereCentres]) -> SphereCentres:
    names = ("found_mm", "deviation_mm", "tool_mm", "setup", "u_mm", "diameter_mm", "time_s")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    angle = {letter: np.concatenate([part.angle_deg[letter] for part in parts]) for letter in parts[0].angle_deg}
    sphere = [name for part in parts for name in part.sphere]
    return SphereCentres(**arrays, coordinates=JOINTS, angle_deg=angle, sphere=sphere, metadata=parts[0].metadata)


def _frames(machine: Machine, spheres: SphereCentres) -> tuple[FloatArray, FloatArray]:
    """Directions from tip to spindle in the workpiece frame (n, 3), and matrices (n, 3, 3) from there to X, Y, Z."""
    zero = np.zeros((len(spheres), 3))
    _, turned = tip_pose(machine, ErrorTable(), RotaryErrors(), zero, spheres.angle_deg, spheres.tool_mm)
    origin = joints_of_tip(machine, zero, spheres.angle_deg, spheres.tool_mm)
    columns = [joints_of_tip(machine, zero + unit, spheres.angle_deg, spheres.tool_mm) - origin for unit in np.eye(3)]
    return turned[:, :, 2], np.stack(columns, axis=2)


def _motions(machine: Machine, spheres: SphereCentres, reach: Reach) -> Motions:
    """Motions on the sphere of each pose."""
    along, to_joints = _frames(machine, spheres)
    upright = np.abs(along[:, 2]) > 0.999
    up = np.where(upright[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    first = up - np.sum(up * along, axis=1)[:, None] * along
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(along, first)
    # at 45 degrees to the plane of tool and stem: no contact is made where the stem is
    across = [(a * first + b * second) / np.sqrt(2.0) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    ways = np.stack([*across, along], axis=1) @ to_joints.transpose(0, 2, 1)
    centre, far = spheres.found_mm[:, None], reach.contact_mm + reach.clearance_mm
    start = centre + far * ways
    over = start + far * ways[:, 4:] * np.array([1.0, 1.0, 1.0, 1.0, 0.0])[:, None]
    places = (
        spheres.found_mm + (far + reach.clearance_mm) * ways[:, 4],
        over,
        start,
        centre + (reach.contact_mm - reach.overtravel_mm) * ways,
    )
    return Motions(*(np.round(place, 3) for place in places))


def _within(machine: Machine, spheres: SphereCentres, reach: Reach, height_mm: float | None) -> NDArray[np.bool_]:
    """Whether every motion of a pose is within the travel and below the height, and the tool not below the sphere."""
    along, _ = _frames(machine, spheres)
    points = _motions(machine, spheres, reach).all
    ceiling = machine.upper_mm if height_mm is None else np.append(machine.upper_mm[:2], height_mm)
    inside = ((points >= machine.lower_mm) & (points <= ceiling)).all(axis=(1, 2))
    return np.asarray(inside & (along[:, 2] >= np.cos(np.radians(STEEPEST_DEG)) - 1e-9))


def _chosen(problem: Problem, place: NDArray[np.int64], count: int, u_mm: float) -> list[int]:
    """Rows of the poses, greedily: each lowers the sum of (u / assumed)^2 of the position errors most."""
    k, free = problem.errors, ~np.isfinite(problem.sizes)
    scaled = problem.columns(problem.start()) * np.where(free, 1.0, problem.sizes) / u_mm
    blocks = scaled.reshape(len(place), 3, -1)
    covariance = np.diag(np.where(free, 1.0 / _RIDGE, 1.0))
    taken: list[int] = []
    spheres = int(place.max()) + 1
    for turn in range(count):
        across = blocks @ covariance
        inner = np.eye(3) + across @ blocks.transpose(0, 2, 1)
        lowered = across[:, :, :k] @ across[:, :, :k].transpose(0, 2, 1)
        gain = np.einsum("nij,nji->n", np.linalg.inv(inner), lowered)
        gain[taken] *= 0.5  # a pose may be probed again, if no other says as much
        if turn < _FEWEST * spheres:
            gain[(place != turn % spheres) | np.isin(np.arange(len(place)), taken)] = -np.inf
        best = int(np.argmax(gain))
        taken.append(best)
        covariance = covariance - across[best].T @ np.linalg.solve(inner[best], across[best])
    return taken


def _in_order(spheres: SphereCentres, rows: Sequence[int]) -> NDArray[np.intp]:
    """Rows by length of the probe, then by the angles, so that tools and slow axes change seldom."""
    letters = list(spheres.angle_deg)
    keys = [spheres.angle_deg[letter][list(rows)] for letter in reversed(letters)]
    number = np.array([int(spheres.sphere[row][1:]) for row in rows])
    order = np.lexsort((*keys, number, -spheres.tool_mm[list(rows), 2]))
    return np.asarray(rows, dtype=np.intp)[order]


def _uncertainties(problem: Problem, x: FloatArray, u_mm: FloatArray) -> FloatArray:
    """Standard uncertainties of the position errors after the readings, mm and rad."""
    known = information(problem, x, u_mm)
    return np.asarray(problem.size * np.sqrt(np.diag(np.linalg.inv(np.eye(len(known)) + known))))
