"""Programs that probe spheres at poses of rotary axes, and what their logs contain.

The program logs raw contacts: positions of X, Y, Z with the pose and the angles of the machine file. Nothing is calculated on
the control; :mod:`compgen.foreign.probe_logs` finds the centres. Every motion is in positions of the axes, without a
transformation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls import CONTROLLERS, ROTARY_PITCH, ROTARY_TARGETS
from compgen.controls.rotary_parameters import target_of
from compgen.controls.rotary_pitch import format_of
from compgen.data.machine import Machine
from compgen.errors import InputError, program_text
from compgen.planning.sphere_poses import Reach, SpherePlan
from compgen.tables.probe_program import FROM_END_MM, Probing
from compgen.tables.render import load_format, render, template_folders

TEMPLATE, PROGRAM_NAME = "sphere-program.nc.j2", "sphere-program.nc"
#: Controls of rotary axes, and the one whose templates say how it probes.
_TEMPLATES_OF = {"linuxcnc": "linuxcnc-comp", "siemens": "siemens-cec"}


def reach_of(probing: Probing) -> Reach:
    """How a sphere is touched; InputError for the section ``[probing]`` of a bore."""
    if probing.feature != "sphere":
        raise InputError(
            f'"{probing.feature}" is not what --sphere probes; expected "sphere"', field="[probing] feature"
        )
    return Reach(0.5 * (probing.diameter_mm + probing.ball_mm), probing.clearance_mm, probing.overtravel_mm)


def height_of(machine: Machine, probing: Probing) -> float:
    """Z of the motion between poses, mm."""
    top = float(machine.upper_mm[2]) - FROM_END_MM
    return round(top if probing.clearance_z_mm is None else probing.clearance_z_mm, 3)


def sphere_program(plan: SpherePlan, probing: Probing, controller: str, templates: Path | None = None) -> str:
    """Return the program that probes the spheres at all poses of a plan, with a stop before each length of the probe.

    Raises
    ------
    InputError
        for a control without documented probing, or one that does not exist.
    """
    own = _card_name(controller, templates)
    sense = _senses(plan.machine, controller)
    spheres, motions = plan.spheres, plan.motions
    poses: list[dict[str, Any]] = []
    for row in range(len(spheres)):
        tool = spheres.tool_mm[row] - np.array(plan.machine.tool_offset_mm)
        angle = {letter: float(values[row]) for letter, values in spheres.angle_deg.items()}
        fitted = row == 0 or not np.array_equal(spheres.tool_mm[row], spheres.tool_mm[row - 1])
        poses.append(
            {
                "number": row + 1,
                "sphere": spheres.sphere[row],
                "length_mm": float(-tool[2]) if fitted else None,
                "tool_text": " ".join(f"{value:.4f}" for value in spheres.tool_mm[row]),
                "angle_text": " ".join(f"{letter} {value:.3f}" for letter, value in angle.items()),
                "axes": [_turned(plan.machine, letter, sense[letter] * value) for letter, value in angle.items()],
                "above": motions.above[row].tolist(),
                "touches": [
                    {"over": over, "start": start, "target": target}
                    for over, start, target in zip(
                        motions.over[row].tolist(),
                        motions.start[row].tolist(),
                        motions.target[row].tolist(),
                        strict=True,
                    )
                ],
            }
        )
    context = {
        "machine_name": program_text(plan.machine.name),
        "poses": poses,
        "contacts": motions.start.shape[1],
        "safe_z_mm": height_of(plan.machine, probing),
        "probing": {**vars(probing)},
        "u_um": plan.u_um,
        "senses": [
            f"+{letter} of the control turns {'against' if way < 0 else 'as'} +{letter} of the machine file, ISO 841"
            for letter, way in sense.items()
        ],
    }
    return render(load_format(own, templates), TEMPLATE, context, templates)


def _card_name(controller: str, templates: Path | None) -> str:
    """The control whose templates write the program; InputError if none does."""
    family = controller.partition("-")[0]
    rotary = controller in (*ROTARY_TARGETS, *ROTARY_PITCH)
    own = _TEMPLATES_OF.get(family, controller) if rotary else controller
    if rotary or controller in CONTROLLERS:
        if any((folder / own / TEMPLATE).is_file() for folder in template_folders(own, templates)):
            return own
        known = [name for name in (*ROTARY_TARGETS, *ROTARY_PITCH) if name.partition("-")[0] in _TEMPLATES_OF]
        raise InputError(
            f"no public document of {controller} that describes probing along any direction, and its log, was found; "
            f"programs exist for {', '.join(known)}",
            field="--program",
        )
    raise InputError(f"there is no control {controller!r} of rotary axes", field="--program")


def _senses(machine: Machine, controller: str) -> dict[str, float]:
    """Sign from the machine file to the control of each rotary axis, as the section of the control states it."""
    if controller in ROTARY_TARGETS:
        target = target_of(machine, controller)
        return {letter: target.sense.get(letter, 1.0) for letter in machine.rotary}
    if controller in ROTARY_PITCH:
        form = format_of(machine, controller)
        return {letter: form.sense(letter) for letter in machine.rotary}
    return dict.fromkeys(machine.rotary, 1.0)


def _turned(machine: Machine, letter: str, at_deg: float) -> dict[str, Any]:
    """The word of a rotary axis; an axis without end is commanded within its first turn."""
    modulo = machine.rotary[letter].modulo_deg
    at = at_deg if modulo is None else float(np.mod(at_deg, modulo))
    return {"letter": letter, "at_deg": round(at, 3) + 0.0, "endless": modulo is not None}
