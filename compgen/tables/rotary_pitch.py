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
from compgen.data.machine import Machine, RotaryAxis
from compgen.data.rotary import RAD_PER_ARCSEC, RotaryErrors
from compgen.errors import InputError
from compgen.kinematics.rotary_chain import joints_of_tip, rotation_between, tip_pose
from compgen.tables.rotary_parameters import Figures, Left, Wanted, figures, wanted

#: Angles at which the positioning is judged, for each axis.
_ANGLES = 721


def pitch_tables(machine: Machine, rotary: RotaryErrors, *, both_ways: bool = False) -> dict[str, AngleTable]:
    """What has to be added to the command of each axis whose positioning is known, at the nodes of its curve.

    With ``both_ways`` the tables act by direction of travel and contain the reversal, where it is known.
    """
    found = {}
    for letter, axis in machine.rotary.items():
        curve = rotary.curves.get(f"E{letter}{letter}")
        if curve is not None:
            zero = curve.at(np.array([axis.reference_deg]), axis.modulo_deg)
            mean, half = -np.degrees(curve.value - zero), 0.5 * np.degrees(rotary.reversal.get(letter, 0.0))
            # what was reached in positive travel is half of the reversal more than the mean, in negative travel half less
            split = both_ways and half != 0.0
            found[letter] = AngleTable(curve.angle_deg, mean - split * half, mean + half if split else None)
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
    faults: tuple[str, ...] = ()
    backlash: tuple[str, ...] = ()

    @property
    def instructions(self) -> list[str]:
        """What has to be done with the files, and the backlash parameters that belong to them."""
        return [*self.form.instructions(self.angle_arcsec), *self.backlash]

    @property
    def reasons(self) -> list[str]:
        """Why the files are not acceptable; none if they are."""
        return [*self.faults, *self._larger()]

    def _larger(self) -> list[str]:
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
            "instructions": self.instructions,
            "files": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in self.files.items()},
        }


def export_pitch(form: PitchFormat, rotary: RotaryErrors) -> PitchExport:
    """Write the tables, read them back, and judge what they leave."""
    files = form.files(pitch_tables(form.machine, rotary, both_ways=form.both_ways))
    return judged_pitch(form, rotary, {Path(name): text for name, text in files.items()})


def judged_pitch(form: PitchFormat, rotary: RotaryErrors, contents: Mapping[Path, str]) -> PitchExport:
    """Emulate a control with these files on the true machine."""
    machine, tables = form.machine, form.parse(contents)
    if not tables:
        raise InputError("contains no table of a rotary axis", file=next(iter(contents), None))
    angles = {letter: _judged_angle(form, rotary, letter, table) for letter, table in tables.items()}
    poses = wanted(machine)
    first, last = (figures(poses, _left(machine, rotary, own, poses)) for own in ({}, tables))
    faults = tuple(text for table in tables.values() for text in table.faults)
    backlash = tuple(
        f"Reversal of {letter}: {form.backlash(letter, float(np.degrees(rotary.reversal[letter])))}"
        for letter, table in tables.items()
        if table.negative_deg is None and rotary.reversal.get(letter) and form.backlash(letter, 0.0)
    )
    unknown = tuple(
        f"Reversal of {letter}: {np.degrees(rotary.reversal[letter]) * 3600.0:+.2f} arcsec; where this control takes it is not "
        "documented, and it stays"
        for letter, table in tables.items()
        if table.negative_deg is None and rotary.reversal.get(letter) and not form.backlash(letter, 0.0)
    )
    names = {path.name: text for path, text in contents.items()}
    return PitchExport(form, names, angles, first, last, faults, (*backlash, *unknown))


def _judged_angle(form: PitchFormat, rotary: RotaryErrors, letter: str, table: AngleTable) -> dict[str, float]:
    """What is left in the angle of one axis (arcsec), by the mean of both directions, and its reversal.

    True error and table are straight between their nodes: the largest deviation lies at a node of one of them, or just
    beside it. Even angles are added for the rms.
    """
    machine, axis = form.machine, form.machine.rotary[letter]
    even, at = _angles_of(rotary, letter, table, axis)
    added = 0.5 * (table.emulated(at, 1) + table.emulated(at, -1))
    before, after = (np.degrees(_turned(machine, rotary, letter, at + one)) + one for one in (0.0 * added, added))
    name, reversal = f"E{letter}{letter}", rotary.reversal.get(letter)
    u = rotary.curves[name].u if name in rotary.curves else np.array([np.nan])
    found = {
        "before_max": _arcsec(np.abs(before).max()),
        "before_rms": _arcsec(np.sqrt(np.mean(before[:even] ** 2))),
        "after_max": _arcsec(np.abs(after).max()),
        "after_rms": _arcsec(np.sqrt(np.mean(after[:even] ** 2))),
        "u_after": float(np.sqrt(np.mean(u**2)) / RAD_PER_ARCSEC),
    }
    if reversal is not None:
        step = table.emulated(at, 1) - table.emulated(at, -1)
        left = np.degrees(reversal) + step
        found["reversal_before"] = float(reversal / RAD_PER_ARCSEC)
        found["reversal_after"] = _arcsec(left[np.argmax(np.abs(left))])
    return found


def _angles_of(rotary: RotaryErrors, letter: str, table: AngleTable, axis: RotaryAxis) -> tuple[int, FloatArray]:
    """Evenly spaced angles (and how many), then nodes of error and table and places beside them.

    An axis without end goes on counting: the turn before and the one after count as far as the table claims them.
    """
    low, high = axis.ends_deg
    even = np.linspace(low, high, _ANGLES)
    turns, nodes = [0.0], table.angle_deg
    if axis.modulo_deg is not None:
        turns = [-axis.modulo_deg, 0.0, axis.modulo_deg]
        if table.turn_deg is None:
            low, high = min(low, nodes[0]), max(high, nodes[-1])
        else:
            low, high = low - axis.modulo_deg, high + axis.modulo_deg
    name = f"E{letter}{letter}"
    own = [nodes, rotary.curves[name].angle_deg if name in rotary.curves else nodes]
    at = np.concatenate(
        [part + turn + beside for part in [even, *own] for turn in turns for beside in (-1e-6, 0.0, 1e-6)]
    )
    return len(even), np.concatenate([even, at[(at >= low) & (at <= high)]])


def _turned(machine: Machine, rotary: RotaryErrors, letter: str, angle_deg: FloatArray) -> FloatArray:
    motions = rotary.motions(machine, {name: angle_deg for name in machine.rotary})[letter]
    return motions[:, 3 + "ABC".index(letter)]


def _arcsec(angle_deg: float) -> float:
    return float(np.radians(angle_deg) / RAD_PER_ARCSEC)


def _left(machine: Machine, rotary: RotaryErrors, tables: Mapping[str, AngleTable], at: Wanted) -> Left:
    """What is left over all poses if the control adds its tables to the commanded angles."""
    joints = joints_of_tip(machine, at.tip_mm, at.angle_deg, at.tool_mm)
    moved = {
        letter: angle + (0.5 * sum(tables[letter].emulated(angle, way) for way in (1, -1)) if letter in tables else 0.0)
        for letter, angle in at.angle_deg.items()
    }
    tip, turned = tip_pose(machine, ErrorTable(), rotary, joints, moved, at.tool_mm)
    _, straight = tip_pose(machine, ErrorTable(), RotaryErrors(), joints, at.angle_deg, at.tool_mm)
    axis, rotation = straight[:, :, 2], rotation_between(turned, straight)
    return Left(tip - at.tip_mm, rotation - np.sum(rotation * axis, axis=1)[:, None] * axis, axis)
