"""The machine of the hidden sets, written anew: a chain of carriages with finite small rotations.

Nothing here comes from compgen. Conventions are those of ISO 230-1: ``E`` + direction + axis; X is the reference axis
and XY the reference plane. mm and rad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

AXES = "XYZ"
Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class HiddenMachine:
    """A machine: chain, travel (3, 2) mm, screw pitches (3,) mm, nodes of each curve."""

    name: str
    chain: str
    range_mm: np.ndarray
    pitch_mm: np.ndarray
    nodes: int = 11

    def unit(self, axis: int, position_mm: np.ndarray) -> np.ndarray:
        """Position over the travel, -1 ... 1."""
        low, high = self.range_mm[axis]
        return (2.0 * position_mm - low - high) / (high - low)

    @property
    def tool_side(self) -> list[int]:
        """Axes that carry the tool, from the foundation outwards."""
        return [AXES.index(c) for c in self.chain.split("F")[1].rstrip("T")]

    @property
    def work_side(self) -> list[int]:
        """Axes that carry the workpiece, from the foundation outwards."""
        return [AXES.index(c) for c in reversed(self.chain.split("F")[0].lstrip("W"))]


@dataclass(frozen=True)
class Truth:
    """True errors: Legendre coefficients of each curve over the travel, (degree + 1,), and the three squareness errors."""

    curves: Mapping[str, np.ndarray]
    squareness: Mapping[str, float] = field(default_factory=dict)


def without_lever(machine: HiddenMachine) -> list[str]:
    """Angular errors that do nothing of their own while the tool offset is zero: no lever, or only their own travel."""
    found = []
    for axis in range(3):
        arms = {j for j in range(3) if lever(machine, axis, np.eye(3)[[j]], np.zeros((1, 3)))[0, j]}
        found += [f"E{'ABC'[k]}{AXES[axis]}" for k in range(3) if arms - {k} <= {axis}]
    return found


def random_truth(
    machine: HiddenMachine, rng: np.random.Generator, degree: int, length_um: float = 8.0, angle_urad: float = 12.0
) -> Truth:
    """Smooth random errors whose coefficients fall with their order; none that has no lever."""
    curves = {}
    for direction in "XYZ":
        for axis in "XYZ":
            for kind, size in (("", length_um * 1e-3), ("A", angle_urad * 1e-6)):
                name = f"E{'ABC'['XYZ'.index(direction)] if kind else direction}{axis}"
                drawn = rng.normal(size=degree + 1) * size / (1.0 + 0.5 * np.arange(degree + 1))
                curves[name] = np.where(np.arange(degree + 1) == 0, 0.0, drawn)
    for name in without_lever(machine):
        del curves[name]
    return Truth(curves, {name: float(rng.normal() * 3e-5) for name in ("EC0Y", "EB0Z", "EA0Z")})


def small_motion(
    machine: HiddenMachine, truth: Truth, axis: int, position_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Translation (n, 3) and rotation (n, 3) of the carriage of an axis."""
    s = machine.unit(axis, position_mm)
    letter = AXES[axis]
    found = []
    for directions in ("XYZ", "ABC"):
        names = [f"E{d}{letter}" for d in directions]
        found.append(np.column_stack([legendre.legval(s, truth.curves.get(n, np.zeros(1))) for n in names]))
    return found[0], found[1]


def axis_direction(truth: Truth, axis: int) -> np.ndarray:
    """Direction of an axis, turned by its squareness errors."""
    turn = np.zeros(3)
    if axis == 1:
        turn[2] = truth.squareness.get("EC0Y", 0.0)
    if axis == 2:
        turn[:2] = truth.squareness.get("EA0Z", 0.0), truth.squareness.get("EB0Z", 0.0)
    return Rotation.from_rotvec(turn).apply(np.eye(3)[axis])


def tip(machine: HiddenMachine, truth: Truth, q_mm: np.ndarray, tool_mm: np.ndarray) -> np.ndarray:
    """Tool tip in the workpiece frame for commanded positions (n, 3) and tools (n, 3)."""
    x = tool_mm.copy()
    for axis in reversed(machine.tool_side):
        delta, eps = small_motion(machine, truth, axis, q_mm[:, axis])
        x = q_mm[:, [axis]] * axis_direction(truth, axis) + delta + Rotation.from_rotvec(eps).apply(x)
    for axis in machine.work_side:
        delta, eps = small_motion(machine, truth, axis, q_mm[:, axis])
        x = Rotation.from_rotvec(eps).apply(x + q_mm[:, [axis]] * axis_direction(truth, axis) + delta)
    return x


def lever(machine: HiddenMachine, axis: int, q_mm: np.ndarray, tool_mm: np.ndarray) -> np.ndarray:
    """Lever (n, 3) of the rotation of an axis."""
    arm = tool_mm.copy()
    if axis in machine.tool_side:
        carried = machine.tool_side[machine.tool_side.index(axis) + 1 :]
    else:
        carried = machine.tool_side + machine.work_side[: machine.work_side.index(axis) + 1]
    for other in carried:
        arm[:, other] += q_mm[:, other]
    return arm


def error_directions(machine: HiddenMachine, q_mm: np.ndarray, tool_mm: np.ndarray) -> dict[str, np.ndarray]:
    """Displacement (n, 3) per unit of each of the 18 motion errors, to first order."""
    found = {}
    for axis in range(3):
        arm = lever(machine, axis, q_mm, tool_mm)
        for k in range(3):
            found[f"E{'XYZ'[k]}{AXES[axis]}"] = np.broadcast_to(np.eye(3)[k], q_mm.shape)
            found[f"E{'ABC'[k]}{AXES[axis]}"] = np.cross(np.eye(3)[k], arm)
    return found
