"""Positioning tables of rotary axes: from error motions to text, read back, emulated, judged in angle, tip and tool axis."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.rotary_pitch import AngleTable, PitchFormat
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.rotary import RAD_PER_ARCSEC, RotaryErrors
from compgen.errors import InputError
from compgen.kinematics.rotary_chain import joints_of_tip, rotation_between, tip_pose
from compgen.tables.rotary_parameters import Figures, Left, Wanted, figures, wanted

#: Angles at which the positioning is judged, for each axis.
_ANGLES = 721


def pitch_tables(machine: Machine, rotary: RotaryErrors) -> dict[str, AngleTable]:
    """What has to be added to the command of each axis whose positioning is known, at the nodes of its curve."""
    found = {}
    for letter, axis in machine.rotary.items():
        curve = rotary.curves.get(f"E{letter}{letter}")
        if curve is not None:
            zero = curve.at(np.array([axis.reference_deg]), axis.modulo_deg)
            found[letter] = AngleTable(curve.angle_deg, -np.degrees(curve.value - zero))
    if not found:
        names = ", ".join(f"E{letter}{letter}" for letter in machine.rotary)
        raise InputError(
            f"contains no positioning of rotary axes ({names}); identify it from *.axis.csv runs", field="errors"
        )
    return found


@dataclass(frozen=True)
class PitchExport:
    """Files, and what is left: in the angle of each axis (largest, rms; arcsec), and in tip and tool axis over all poses."""

    form: PitchFormat
    files: Mapping[str, str]
    angle_arcsec: Mapping[str, Mapping[str, float]]
    before: Figures
    after: Figures

    @property
    def reasons(self) -> list[str]:
        """Why the files are not acceptable; none if they are."""
        return [
            f"{letter}: the error of the angle does not shrink: {own['before_rms']:.2f} -> {own['after_rms']:.2f} arcsec (rms)"
            for letter, own in self.angle_arcsec.items()
            if own["after_rms"] > 0.98 * own["before_rms"]
        ]

    def summary(self) -> dict[str, Any]:
        """Plain values for ``result.json``."""
        return {
            "controller": self.form.name,
            "accepted": not self.reasons,
            "reasons": self.reasons,
            "angle_arcsec": {letter: dict(own) for letter, own in self.angle_arcsec.items()},
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "reversed_axes": list(self.form.settings.reversed_axes),
            "instructions": self.form.instructions(self.angle_arcsec),
            "files": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in self.files.items()},
        }


def export_pitch(form: PitchFormat, rotary: RotaryErrors) -> PitchExport:
    """Write the tables, read them back, and judge what they leave."""
    files = form.files(pitch_tables(form.machine, rotary))
    return judged_pitch(form, rotary, {Path(name): text for name, text in files.items()})


def judged_pitch(form: PitchFormat, rotary: RotaryErrors, contents: Mapping[Path, str]) -> PitchExport:
    """Emulate a control with these files on the true machine."""
    machine, tables = form.machine, form.parse(contents)
    angles = {}
    for letter in tables:
        axis = machine.rotary[letter]
        at = np.linspace(*axis.ends_deg, _ANGLES)
        added = tables[letter].at(at, axis)
        before, after = (np.degrees(_turned(machine, rotary, letter, at + one)) + one for one in (0.0 * added, added))
        angles[letter] = {
            "before_max": _arcsec(np.abs(before).max()),
            "before_rms": _arcsec(np.sqrt(np.mean(before**2))),
            "after_max": _arcsec(np.abs(after).max()),
            "after_rms": _arcsec(np.sqrt(np.mean(after**2))),
            "u_after": float(np.sqrt(np.mean(rotary.curves[f"E{letter}{letter}"].u ** 2)) / RAD_PER_ARCSEC)
            if f"E{letter}{letter}" in rotary.curves
            else np.nan,
        }
    poses = wanted(machine)
    first, last = (figures(poses, _left(machine, rotary, own, poses)) for own in ({}, tables))
    return PitchExport(form, {path.name: text for path, text in contents.items()}, angles, first, last)


def _turned(machine: Machine, rotary: RotaryErrors, letter: str, angle_deg: FloatArray) -> FloatArray:
    motions = rotary.motions(machine, {name: angle_deg for name in machine.rotary})[letter]
    return motions[:, 3 + "ABC".index(letter)]


def _arcsec(angle_deg: float) -> float:
    return float(np.radians(angle_deg) / RAD_PER_ARCSEC)


def _left(machine: Machine, rotary: RotaryErrors, tables: Mapping[str, AngleTable], at: Wanted) -> Left:
    """What is left over all poses if the control adds its tables to the commanded angles."""
    joints = joints_of_tip(machine, at.tip_mm, at.angle_deg, at.tool_mm)
    moved = {
        letter: angle + (tables[letter].at(angle, machine.rotary[letter]) if letter in tables else 0.0)
        for letter, angle in at.angle_deg.items()
    }
    tip, turned = tip_pose(machine, ErrorTable(), rotary, joints, moved, at.tool_mm)
    _, straight = tip_pose(machine, ErrorTable(), RotaryErrors(), joints, at.angle_deg, at.tool_mm)
    axis, rotation = straight[:, :, 2], rotation_between(turned, straight)
    return Left(tip - at.tip_mm, rotation - np.sum(rotation * axis, axis=1)[:, None] * axis, axis)
