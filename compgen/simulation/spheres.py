"""Spheres on the table of a virtual machine with rotary axes, found by its probe at poses of all axes: ``*.sphere.csv``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine, Vector3
from compgen.data.names import MM_PER_UM
from compgen.data.rotary import (
    JOINTS,
    ROTARY_NAMES,
    RotaryCurve,
    RotaryErrors,
    SphereCentres,
    motion_names,
    position_names,
    si_per_unit,
    unit_of,
)
from compgen.data.toml_files import setting
from compgen.errors import InputError, Message, nearest
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose
from compgen.simulation.trajectory import check_stops

#: Steps, and the distance from the sphere in mm, at which the probe has found it.
_STEPS, _CLOSE_MM = 30, 1e-9


@toml_files.accepts({"type": "object", "additionalProperties": {"type": "number"}})
def _constants(value: Any) -> dict[str, float]:
    """Position errors by name, um and urad."""
    found = toml_files.table(value)
    for name in found:
        if name not in ROTARY_NAMES or name[2] != "0":
            raise ValueError(
                Message(
                    "rotary-error-unknown",
                    "{name!r} is no position error of a rotary axis; {suggestion}",
                    name=name,
                    suggestion=nearest(name, ROTARY_NAMES),
                )
            )
    return {name: toml_files.number(number) for name, number in found.items()}


@toml_files.accepts({"type": "array", "items": {"type": "number", "exclusiveMinimum": 0}, "minItems": 1})
def _lengths(value: Any) -> tuple[float, ...]:
    return (
        tuple(toml_files.positive(one) for one in value)
        if isinstance(value, list) and value
        else toml_files.numbers(value)
    )


@dataclass(frozen=True, kw_only=True)
class RotaryTruth:
    """The true errors of the rotary axes of a virtual machine; the same seed draws the same for every instrument.

    Parameters
    ----------
    rotary_errors : true position errors by name, um and urad; those of the machine that are not named are drawn with
        standard deviations ``offset_um`` and ``tilt_urad`` unless some are named.
    motion_um, motion_urad : amplitude of the error motions, a wave of one and one of two periods a turn each.
    """

    rotary_errors: dict[str, float] | None = setting(_constants, None)
    offset_um: float = setting(toml_files.not_negative, 50.0)
    tilt_urad: float = setting(toml_files.not_negative, 100.0)
    motion_um: float = setting(toml_files.not_negative, 0.0)
    motion_urad: float = setting(toml_files.not_negative, 0.0)

    def truth(self, machine: Machine, rng: np.random.Generator) -> RotaryErrors:
        """The true errors of the rotary axes."""
        curves, constants = {}, {}
        for letter, axis in machine.rotary.items():
            for name in position_names(letter):
                size = self.offset_um if unit_of(name) == "um" else self.tilt_urad
                drawn = size * float(rng.standard_normal())
                value = drawn if self.rotary_errors is None else self.rotary_errors.get(name, 0.0)
                constants[name] = (value * si_per_unit(name), np.nan)
            angle = np.linspace(*axis.ends_deg, 73)
            for name in motion_names(letter):
                size = self.motion_um if unit_of(name) == "um" else self.motion_urad
                if size:
                    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
                    wave = np.cos(np.radians(angle) + phase[0]) + np.cos(2.0 * np.radians(angle) + phase[1])
                    curves[name] = RotaryCurve(angle, 0.5 * size * wave * si_per_unit(name), np.full(73, np.nan))
        for name in self.rotary_errors or {}:
            if name not in constants:
                raise InputError(
                    Message(
                        "error-of-lacking-axis",
                        "{name} is an error of an axis that the machine {machine} lacks",
                        name=name,
                        machine=machine.name,
                    ),
                    field="rotary_errors",
                )
        return RotaryErrors(curves, constants)


@dataclass(frozen=True)
class SphereProbe(RotaryTruth):
    """A touch probe that finds spheres at poses of all rotary axes, drawn evenly over their travel.

    Parameters
    ----------
    spheres_mm : places of the spheres in the workpiece frame.
    probe_lengths_mm : lengths of the probe along -Z; every one finds every sphere at all poses.
    poses : number of poses for each sphere and length.
    noise_um : standard deviation of a coordinate.
    """

    spheres_mm: tuple[Vector3, ...] = setting(toml_files.vectors3)
    probe_lengths_mm: tuple[float, ...] = setting(_lengths, (100.0,))
    poses: int = setting(toml_files.whole(4, 100_000), 60)
    noise_um: float = setting(toml_files.not_negative, 2.0)

    def measure(
        self, machine: Machine, errors: ErrorTable, rotary: RotaryErrors, rng: np.random.Generator
    ) -> SphereCentres:
        """Positions of the axes at which the true tip is at the spheres, with noise."""
        if not machine.rotary:
            raise InputError(
                Message(
                    "machine-without-rotary-axis",
                    "the machine {name} has no rotary axis; see [axes.C] in docs/five-axis.md",
                    name=machine.name,
                )
            )
        count = self.poses * len(self.spheres_mm) * len(self.probe_lengths_mm)
        place = np.repeat(self.spheres_mm, self.poses * len(self.probe_lengths_mm), axis=0)
        length = np.tile(np.repeat(self.probe_lengths_mm, self.poses), len(self.spheres_mm))
        tool = np.array(machine.tool_offset_mm) + length[:, None] * np.array([0.0, 0.0, -1.0])
        angle = {
            letter: np.round(rng.uniform(*axis.ends_deg, count), 3) for letter, axis in sorted(machine.rotary.items())
        }
        joint = self._found(machine, errors, rotary, place, angle, tool)
        try:
            check_stops(joint, machine)
        except InputError as error:
            text = (
                f"{error.message.partition(';')[0]}; a sphere leads there: change spheres_mm, or the ranges of the axes"
            )
            raise InputError(text, field="[instrument] spheres_mm") from None
        nan = np.full(count, np.nan)
        return SphereCentres(
            found_mm=joint + self.noise_um * MM_PER_UM * rng.standard_normal(joint.shape),
            deviation_mm=np.full((count, 3), np.nan),
            coordinates=JOINTS,
            angle_deg=angle,
            tool_mm=tool,
            sphere=[f"S{k}" for k in np.repeat(np.arange(1, len(self.spheres_mm) + 1), count // len(self.spheres_mm))],
            setup=np.ones(count, dtype=np.int64),
            u_mm=np.full(count, self.noise_um * MM_PER_UM) if self.noise_um else nan,
            diameter_mm=nan,
            time_s=nan,
            metadata={"instrument": "sphere-probe"},
        )

    def _found(
        self,
        machine: Machine,
        errors: ErrorTable,
        rotary: RotaryErrors,
        place: FloatArray,
        angle: dict[str, FloatArray],
        tool: FloatArray,
    ) -> FloatArray:
        """Positions of the axes (n, 3) at which the true tip is at its place, by fixed-point iteration."""
        target = joints_of_tip(machine, place, angle, tool)
        joint = target
        for _ in range(_STEPS):
            tip = tip_pose(machine, errors, rotary, joint, angle, tool)[0]
            if np.abs(tip - place).max() < _CLOSE_MM:
                break
            joint = joint + target - joints_of_tip(machine, tip, angle, tool)
        return joint


def read_sphere_probe(section: toml_files.Section) -> SphereProbe:
    """A touch probe on spheres at poses of all rotary axes: *.sphere.csv."""
    return toml_files.read_settings(SphereProbe, section)
