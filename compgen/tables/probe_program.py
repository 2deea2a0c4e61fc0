"""Programs that measure an artefact with the machine's own probe, for controls whose probing motion is documented.

The program logs raw contacts: position of the one axis that moved, with feature and side. Nothing is calculated on the control;
:mod:`compgen.foreign.probe_logs` finds the centres. Every motion is in machine coordinates, along one axis while probing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls import CONTROLLERS, controller_named
from compgen.data import toml_files
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.toml_files import setting
from compgen.errors import InputError, program_text
from compgen.identification.adjust.unknowns import check_travel
from compgen.kinematics.exact_chain import rotate
from compgen.simulation.gauges import TouchProbe
from compgen.tables.render import load_format, render, template_folders

TEMPLATE, PROGRAM_NAME = "probe-program.nc.j2", "probe-program.nc"
#: Distance of the clearance plane from the upper end of Z if it is not stated, mm.
FROM_END_MM = 1.0


@dataclass(frozen=True)
class Probing:
    """How features are probed: section ``[probing]`` of the file of an artefact.

    Parameters
    ----------
    feature : "bore": four contacts from inside, X and Y; "sphere": four contacts at the equator and one from above.
    diameter_mm : of the bore or the sphere.
    ball_mm : diameter of the stylus ball, for the distances of the approach only.
    overtravel_mm : the probe travels this far beyond the expected contact before the control reports an error.
    clearance_mm : distance from a sphere at which probing begins.
    clearance_z_mm : Z of the motion between features, machine coordinates; the upper end of Z less 1 mm by default.
    feed_mm_min, position_feed_mm_min : feed while probing and between contacts.
    """

    feature: str = setting(toml_files.choice("bore", "sphere"))
    diameter_mm: float = setting(toml_files.positive)
    ball_mm: float = setting(toml_files.positive)
    overtravel_mm: float = setting(toml_files.positive, 2.0)
    clearance_mm: float = setting(toml_files.positive, 5.0)
    clearance_z_mm: float | None = setting(toml_files.number, None)
    feed_mm_min: float = setting(toml_files.positive, 100.0)
    position_feed_mm_min: float = setting(toml_files.positive, 1000.0)


def read_probing(path: str | Path) -> Probing:
    """Read the section ``[probing]`` of the TOML file of an artefact.

    Raises
    ------
    InputError
        for a missing section, an unknown key, a ball that does not fit into the bore.
    """
    root = toml_files.read_toml(path)
    if "probing" not in root:
        text = "has no [probing] section, which the program needs; give feature, diameter_mm and ball_mm"
        raise InputError(text, file=Path(path))
    section = root.section("probing")
    found = toml_files.read_settings(Probing, section)
    if found.feature == "bore" and found.ball_mm >= found.diameter_mm:
        raise section.fail("ball_mm", f"{found.ball_mm:g} mm does not fit into a bore of {found.diameter_mm:g} mm")
    return found


def has_probe_program(controller: str, templates: Path | None = None) -> bool:
    """Whether a probing motion is documented for a control."""
    return any((folder / controller / TEMPLATE).is_file() for folder in template_folders(controller, templates))


def probe_program(
    machine: Machine, probe: TouchProbe, probing: Probing, controller: str, templates: Path | None = None
) -> str:
    """Return the program that probes every feature in every pose, with a stop before each pose.

    Raises
    ------
    InputError
        for a control without documented probing, components that the contacts do not show, motions outside the travel.
    """
    controller_named(controller)
    card = load_format(controller, templates)
    if not has_probe_program(controller, templates):
        known = ", ".join(name for name in CONTROLLERS if has_probe_program(name))
        message = (
            f"no public document of {controller} describes probing in machine coordinates; programs exist for {known}"
        )
        raise InputError(message, field="--program")
    bore = probing.feature == "bore"
    if bore == (len(probe.components) == 3):
        expected = '"xy" for bores' if bore else '"xyz" for spheres'
        raise InputError(
            f"the contacts show other coordinates than components states: expected {expected}", field="components"
        )
    top_mm = float(machine.upper_mm[2])
    safe_mm = round(top_mm - FROM_END_MM if probing.clearance_z_mm is None else probing.clearance_z_mm, 3)
    nominal_mm, poses, corners = probe.features_mm(), [], []
    for number, pose in enumerate(probe.poses, 1):
        turn = np.broadcast_to(np.radians(pose.rotation_deg), nominal_mm.shape)
        places_mm = np.round(rotate(turn, nominal_mm) + np.array(pose.origin_mm), 3)
        features = []
        for k, (own_mm, place_mm) in enumerate(zip(nominal_mm, places_mm, strict=True), 1):
            touches = _touches(place_mm, probing)
            features.append({"name": f"F{k:03d}", "nominal": own_mm.tolist(), "touches": touches})
            corners += [touch[key] for touch in touches for key in ("start", "target")]
            highest = max(touch["start"][2] for touch in touches)
            if safe_mm < highest:
                text = f"{safe_mm:g} mm is below the start of a contact at Z {highest:g} mm; raise it"
                raise InputError(text, field="[probing] clearance_z_mm")
        poses.append({"number": number, "origin": list(pose.origin_mm), "rotation": list(pose.rotation_deg),
                      "features": features})  # fmt: skip
    try:
        check_travel(machine, np.array([*corners, [*corners[0][:2], safe_mm]]))
    except InputError as error:
        text = f"{error.message.partition(';')[0]}: the probe would go there; move the artefact or lower the clearance"
        raise InputError(text, field="--pose") from None
    context = {
        "machine_name": program_text(machine.name),
        "poses": poses,
        "safe_z_mm": safe_mm,
        "probing": {**vars(probing)},
        "calibrated": probe.calibrated,
        "components": "xy" if bore else "xyz",
        "u_probe_um": probe.noise_um,
        "u_calibration_um": probe.u_calibration_um,
    }
    return render(replace(card), TEMPLATE, context, templates)


def _touches(place_mm: np.ndarray, probing: Probing) -> list[dict[str, Any]]:
    """The contacts of a feature at a nominal place (3,): side, axis, start and target in machine coordinates.

    A side is named after the direction in which the probe moves. Bores are left through their centre.
    """
    reach_mm = 0.5 * probing.diameter_mm + probing.overtravel_mm
    found = []
    for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)):
        start, target = place_mm.copy(), place_mm.copy()
        if probing.feature == "bore":
            target[axis] += sign * (reach_mm - 0.5 * probing.ball_mm)
        else:
            contact = 0.5 * (probing.diameter_mm + probing.ball_mm)
            start[axis] -= sign * (contact + probing.clearance_mm)
            target[axis] -= sign * (contact - probing.overtravel_mm)
        found.append((axis, sign, start, target))
    if probing.feature == "sphere":
        # Z is the position of the ball's centre: the program's tool point
        start, target, contact = place_mm.copy(), place_mm.copy(), 0.5 * (probing.diameter_mm + probing.ball_mm)
        start[2] += contact + probing.clearance_mm
        target[2] += contact - probing.overtravel_mm
        found.append((2, -1.0, start, target))
    return [
        {
            "side": f"{AXES[axis]}{'+' if sign > 0 else '-'}",
            "letter": AXES[axis],
            "axis": axis,
            "start": np.round(start, 3).tolist(),
            "target": np.round(target, 3).tolist(),
        }
        for axis, sign, start, target in found
    ]
