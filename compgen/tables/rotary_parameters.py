"""Parameters of rotary axes for a control: best values on the exact chain, read back, emulated and judged.

The control turns a wanted tip into positions of X, Y, Z with the axis lines that it believes in; the true machine takes these
positions and the angles. What is left is a field of positions and orientations over the volume, all angles and tools.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.rotary_parameters import Target, as_written, believed, lines_of, with_lines
from compgen.data.comparison import rigid_fields
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, RAD_PER_URAD
from compgen.data.rotary import RotaryErrors
from compgen.kinematics.rotary_chain import joints_of_tip, rotation_between, tip_pose

#: Lengths of the tools along -Z from the gauge point at which tables are judged, mm.
TOOLS_MM = (0.0, 100.0, 200.0)
#: A tilt of the tool axis counts as much as what it does to the tip at this length.
LEVER_MM = 100.0
#: Angles, places along each axis and lengths of tools at which numbers are judged, and found.
_JUDGED: tuple[int, int, tuple[float, ...]] = (7, 3, TOOLS_MM)
_FITTED: tuple[int, int, tuple[float, ...]] = (5, 2, TOOLS_MM[::2])
_ROUNDS = 4
_STEP_MM, _STEP = 1e-3, 1e-6


@dataclass(frozen=True)
class Wanted:
    """Tips (n, 3) in the frame of the workpiece, with angles by axis and tools (n, 3)."""

    tip_mm: FloatArray
    angle_deg: Mapping[str, FloatArray]
    tool_mm: FloatArray


def wanted(machine: Machine, numbers: tuple[int, int, tuple[float, ...]] = _JUDGED) -> Wanted:
    """Tips over the travel of X, Y and Z, the range of all rotary axes, and tools of several lengths."""
    angles, places, tools = numbers
    ends = [
        np.linspace(max(low, -1e3), min(high, 1e3), places) for low, high in (axis.range_mm for axis in machine.axes)
    ]
    turns = []
    for axis in machine.rotary.values():
        low, high = axis.ends_deg
        turns.append(np.linspace(low, min(high, low + 360.0), angles, endpoint=axis.modulo_deg is None))
    rows = np.array(list(product(*ends, *turns, tools)))
    angle = {letter: rows[:, 3 + k] for k, letter in enumerate(machine.rotary)}
    tool = np.array(machine.tool_offset_mm) + rows[:, -1:] * np.array([0.0, 0.0, -1.0])
    tip, _ = tip_pose(machine, ErrorTable(), RotaryErrors(), rows[:, :3], angle, tool)
    return Wanted(tip, angle, tool)


@dataclass(frozen=True)
class Left:
    """Error of the tip (n, 3), mm, tilt of the tool axis (n, 3), rad, and that axis (n, 3), in the frame of the workpiece."""

    tip_mm: FloatArray
    tilt_rad: FloatArray
    axis: FloatArray

    def set_up(self, at: Wanted) -> Left:
        """Without the small rigid motion of the whole workpiece that setting up the part removes: least squares of both."""
        turn = np.tile(np.eye(3), (len(self.axis), 1, 1))
        turn = turn - np.einsum("ni,nj->nij", self.axis, self.axis)  # a turn about the tool axis does nothing
        tilts = np.concatenate([np.zeros_like(turn), turn], axis=2).reshape(-1, 6)
        fields = np.vstack([rigid_fields(at.tip_mm), LEVER_MM * tilts])
        values = np.concatenate([self.tip_mm.ravel(), LEVER_MM * self.tilt_rad.ravel()])
        size = np.linalg.norm(fields, axis=0)
        motion = np.linalg.solve((fields / size).T @ (fields / size), (fields / size).T @ values) / size
        tip = self.tip_mm - (rigid_fields(at.tip_mm) @ motion).reshape(-1, 3)
        return replace(self, tip_mm=tip, tilt_rad=self.tilt_rad - (tilts @ motion).reshape(-1, 3))


def left(machine: Machine, control: Machine, rotary: RotaryErrors, at: Wanted) -> Left:
    """What is left if ``control`` is what the control believes."""
    joints = joints_of_tip(control, at.tip_mm, at.angle_deg, at.tool_mm)
    tip, turned = tip_pose(machine, ErrorTable(), rotary, joints, at.angle_deg, at.tool_mm)
    # X, Y and Z turn no tool: what a control can do is know how the tool points, and turn the axes that a tool vector asks for
    _, straight = tip_pose(control, ErrorTable(), RotaryErrors(), joints, at.angle_deg, at.tool_mm)
    axis, rotation = straight[:, :, 2], rotation_between(turned, straight)
    return Left(tip - at.tip_mm, rotation - np.sum(rotation * axis, axis=1)[:, None] * axis, axis)


@dataclass(frozen=True)
class Figures:
    """Tip and tool axis over all poses, after the part is set up; the tip also as it stands."""

    max_um: float
    rms_um: float
    p95_um: float
    as_it_stands_max_um: float
    max_urad: float
    rms_urad: float

    def as_dict(self) -> dict[str, float]:
        """Plain values by name."""
        return {name: float(value) for name, value in vars(self).items()}


def figures(at: Wanted, field: Left) -> Figures:
    """Figures of what is left."""
    after = field.set_up(at)
    size = np.linalg.norm(after.tip_mm, axis=1) / MM_PER_UM
    tilt = np.linalg.norm(after.tilt_rad, axis=1) / RAD_PER_URAD
    return Figures(
        float(size.max()),
        float(np.sqrt(np.mean(size**2))),
        float(np.percentile(size, 95.0)),
        float(np.linalg.norm(field.tip_mm, axis=1).max() / MM_PER_UM),
        float(tilt.max()),
        float(np.sqrt(np.mean(tilt**2))),
    )


def _moved(machine: Machine, target: Target, values: FloatArray) -> Machine:
    """The believed machine with components of its axis lines changed by ``values`` (k,)."""
    lines = {letter: (point.copy(), direction.copy()) for letter, (point, direction) in lines_of(machine).items()}
    for (letter, kind, component), value in zip(target.free, values, strict=True):
        lines[letter][kind == "direction"][component] += value
    return with_lines(machine, lines)


@dataclass(frozen=True)
class Best:
    """The control's numbers that leave least, as written, and how they depend on errors.

    Parameters
    ----------
    numbers : by name, mm.
    u : standard uncertainty of each that the errors give it; empty without a covariance.
    left_u_um : standard uncertainty (rms over all poses) that the errors give to the tip afterwards; None without.
    """

    numbers: Mapping[str, float]
    u: Mapping[str, float]
    left_u_um: float | None


def best_numbers(
    machine: Machine,
    target: Target,
    rotary: RotaryErrors,
    covariance: tuple[Sequence[str], FloatArray] | None = None,
) -> Best:
    """The numbers that leave least over all poses.

    Least squares on the exact chain, with a free rigid motion of the workpiece; what the poses do not tell stays as it is.
    ``covariance`` of the named constants, mm and rad.
    """
    start, at = believed(target, machine, target.numbers(lines_of(machine))), wanted(machine, _FITTED)
    size = np.array([1.0 if kind == "point" else 1e-3 for _, kind, _ in target.free])
    steps = np.where(size == 1.0, _STEP_MM, _STEP)
    values = np.zeros(len(size))

    def residual(x: FloatArray, errors: RotaryErrors = rotary) -> FloatArray:
        field = left(machine, _moved(start, target, x), errors, at).set_up(at)
        return np.concatenate([field.tip_mm.ravel(), LEVER_MM * field.tilt_rad.ravel()])

    for _ in range(_ROUNDS):
        base = residual(values)
        columns = [
            (residual(values + step) - residual(values - step)) / (2.0 * k)
            for step, k in zip(np.diag(steps), steps, strict=True)
        ]
        jacobian = np.stack(columns, axis=1) * size
        change = np.linalg.lstsq(jacobian, -base, rcond=1e-6)[0] * size
        values = values + change
        if np.abs(change / size).max() < 1e-7:
            break
    numbers = as_written(target, machine, target.numbers(lines_of(_moved(start, target, values))))
    if covariance is None:
        return Best(numbers, {}, None)
    by_error = np.stack([_by_error(residual, values, rotary, name) for name in covariance[0]], axis=1)
    root = np.linalg.cholesky(covariance[1] + 1e-18 * np.trace(covariance[1]) * np.eye(len(covariance[1])))
    change = -np.linalg.lstsq(jacobian, by_error @ root, rcond=1e-6)[0] * size[:, None]
    base_numbers = target.numbers(lines_of(_moved(start, target, values)))
    moved = [np.array(list(target.numbers(lines_of(_moved(start, target, values + one))).values())) for one in change.T]
    spread = np.sqrt(np.sum((np.array(moved) - np.array(list(base_numbers.values()))) ** 2, axis=0))
    rest = (by_error @ root + (jacobian / size) @ change)[: at.tip_mm.size]
    left_u = float(np.sqrt(np.sum(rest**2) / len(at.tip_mm)) / MM_PER_UM)
    return Best(numbers, dict(zip(numbers, spread.tolist(), strict=True)), left_u)


def _by_error(
    residual: Callable[[FloatArray, RotaryErrors], FloatArray], values: FloatArray, rotary: RotaryErrors, name: str
) -> FloatArray:
    """Derivative of the residuals by one constant, mm or rad."""
    value, u = rotary.constants.get(name, (0.0, np.nan))
    step = _STEP_MM if name[1] in AXES else _STEP

    def changed(by: float) -> RotaryErrors:
        return replace(rotary, constants={**rotary.constants, name: (value + by, u)})

    return np.asarray((residual(values, changed(step)) - residual(values, changed(-step))) / (2.0 * step))


@dataclass(frozen=True)
class RotaryExport:
    """Numbers for a control, what they leave, and what it cannot express.

    Parameters
    ----------
    numbers, nominal : the control's numbers by name, and those of the machine file without errors, mm.
    before, after : what is left with the nominal numbers, and with these, read back from the text.
    zeros : error of the zero of each rotary axis, rad.
    u, after_u_um : standard uncertainties of the numbers and of the tip afterwards, if known.
    """

    target: Target
    text: str
    numbers: Mapping[str, float]
    nominal: Mapping[str, float]
    before: Figures
    after: Figures
    not_expressed: Sequence[str]
    zeros: Mapping[str, float]
    u: Mapping[str, float]
    after_u_um: float | None

    @property
    def reasons(self) -> list[str]:
        """Why the numbers are not acceptable; none if they are."""
        found = []
        if self.after.rms_um > self.before.rms_um + 1e-3:
            found.append(
                f"the error of the tip grows from {self.before.rms_um:.2f} to {self.after.rms_um:.2f} um (rms over all poses)"
            )
        elif self.after.rms_um > 0.98 * self.before.rms_um and self.before.rms_um > 0.1:
            found.append(
                f"the numbers take nothing away: {self.before.rms_um:.2f} um before, {self.after.rms_um:.2f} um after (rms)"
            )
        if self.after.rms_urad > 1.1 * self.before.rms_urad + 1.0:
            found.append(
                f"the error of the orientation grows from {self.before.rms_urad:.1f} to {self.after.rms_urad:.1f} urad (rms)"
            )
        return found

    def summary(self) -> dict[str, Any]:
        """Plain values for ``result.json``."""
        return {
            "controller": self.target.name,
            "accepted": not self.reasons,
            "reasons": self.reasons,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "numbers": dict(self.numbers),
            "nominal": dict(self.nominal),
            "u": dict(self.u),
            "after_u_um": self.after_u_um,
            "not_expressed": list(self.not_expressed),
            "stated": [{"evidence": how, "text": text} for how, text in self.target.stated],
            "sense": dict(self.target.sense),
            "files": {self.target.file: hashlib.sha256(self.text.encode()).hexdigest()},
        }


def judged(
    machine: Machine, target: Target, rotary: RotaryErrors, numbers: Mapping[str, float], text: str
) -> RotaryExport:
    """Emulate a control with these numbers on the true machine, beside one with those of the machine file."""
    at = wanted(machine)
    nominal = as_written(target, machine, target.numbers(lines_of(machine)))
    before, after = (
        figures(at, left(machine, believed(target, machine, own), rotary, at)) for own in (nominal, numbers)
    )
    turns = {letter for letter, kind, _ in target.free if kind == "direction"}
    lost = [name for name in rotary.names if name in rotary.curves]
    for name in rotary.constants:
        letter, angle = name[-1], name[1] in "ABC"
        if rotary.constants[name][0] and angle and (letter not in turns or name[1] == letter):
            lost.append(name)
    zeros = {letter: rotary.constants.get(f"E{letter}0{letter}", (0.0, 0.0))[0] for letter in machine.rotary}
    return RotaryExport(target, text, numbers, nominal, before, after, tuple(lost), zeros, {}, None)


def export_rotary(
    machine: Machine,
    target: Target,
    rotary: RotaryErrors,
    covariance: tuple[Sequence[str], FloatArray] | None = None,
) -> RotaryExport:
    """Best numbers, their text, read back from it, and judged."""
    best = best_numbers(machine, target, rotary, covariance)
    text = target.text(machine, best.numbers)
    found = judged(machine, target, rotary, target.parse(machine, text, Path(target.file)), text)
    return replace(found, u=best.u, after_u_um=best.left_u_um)
