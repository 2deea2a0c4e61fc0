"""Logs of probe programs (:mod:`compgen.tables.probe_program`): contacts on the features of an artefact, to their centres.

    VOLCOMP PROBE LOG 1
    MACHINE zha-gantry
    FEATURE bore 20.0 BALL 6.0 COMPONENTS xy UNIT-MM 1
    CALIBRATED false U-PROBE-UM 0.5 U-CALIBRATION-UM 0
    P1 F001 N -25.0 0.0 0.0 C -416.000 -500.000 -200.000 X+ -418.0123
    END

N is the nominal place in the artefact, C the target of the motion in machine coordinates, mm. The last number is the position
of the axis named before it at the contact, in units of UNIT-MM; the other two axes were at C.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError
from compgen.foreign.findings import Imported, ImportOptions
from compgen.foreign.source import read_source, shown

TITLE = "VOLCOMP PROBE LOG 1"
_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_CONTACT = re.compile(rf"P(\d+) (\S+) N {' '.join([_NUMBER] * 3)} C {' '.join([_NUMBER] * 3)} ([XYZ])([+-]) {_NUMBER}")
_FEATURE = re.compile(rf"FEATURE (bore|sphere) {_NUMBER} BALL {_NUMBER} COMPONENTS (xyz?) UNIT-MM {_NUMBER}")
_STATED = re.compile(rf"CALIBRATED (true|false) U-PROBE-UM {_NUMBER} U-CALIBRATION-UM {_NUMBER}")
#: Contacts of one feature that fit a circle or sphere worse than this were not all made on it, mm.
MISFIT_MM = 0.05
#: Steps of the fit of a circle or sphere.
STEPS = 20


def is_probe_log(text: str) -> bool:
    """Whether a text begins like the log of a probe program; controls may write lines before it."""
    return TITLE in text


def import_probe_log(path: Path, options: ImportOptions) -> Imported:
    """Import the log of a probe program as an artefact.

    Raises
    ------
    InputError
        for a log without its end, of several runs, with a missing contact, or with contacts that are not on the feature.
    """
    lines = [(number, line.strip()) for number, line in enumerate(read_source(path).text.splitlines(), 1)]
    begin = [k for k, (_, line) in enumerate(lines) if line.endswith(TITLE)]
    if len(begin) != 1:
        text = f"contains {len(begin)} runs of the program; keep one of them, and delete the file on the control before each run"
        raise InputError(text, file=path, line=lines[begin[1]][0])
    if not any(line == "END" for _, line in lines):
        raise InputError("has no END: the program did not run to its end; measure again", file=path, line=len(lines))
    lines = lines[begin[0] + 1 :]
    machine, feature, stated = (
        _stated(path, lines, key, pattern)
        for key, pattern in (("MACHINE", re.compile("MACHINE (.+)")), ("FEATURE", _FEATURE), ("CALIBRATED", _STATED))
    )
    kind, unit_mm = feature[0], float(feature[4])
    contacts: dict[tuple[int, str], list[tuple[FloatArray, FloatArray, str]]] = {}
    for number, line in lines:
        if not re.match(r"P\d", line):
            continue
        found = _CONTACT.fullmatch(line)
        if found is None:
            raise InputError(f"{shown(line)} is not a contact of the program", file=path, line=number)
        at_mm = np.array([float(word) for word in found.group(6, 7, 8)])
        axis = AXES.index(found.group(9))
        at_mm[axis] = unit_mm * float(found.group(11))
        side = f"{found.group(9)}{found.group(10)}"
        nominal_mm = np.array([float(word) for word in found.group(3, 4, 5)])
        own = contacts.setdefault((int(found.group(1)), found.group(2)), [])
        if side in [other for _, _, other in own]:
            raise InputError(f"contact {side} of feature {found.group(2)} is there twice", file=path, line=number)
        own.append((at_mm, nominal_mm, side))
    sides = {"X+", "X-", "Y+", "Y-", *(["Z-"] if kind == "sphere" else [])}
    centres, sizes, misfits = [], [], []
    for (pose, name), own in contacts.items():
        missing = sides - {side for _, _, side in own}
        if missing:
            text = f"feature {name} of pose {pose} lacks the contacts {', '.join(sorted(missing))}"
            raise InputError(text, file=path)
        points_mm = np.array([at_mm for at_mm, _, _ in own])
        centre_mm, radius_mm, misfit_mm = _centre(points_mm, 3 if kind == "sphere" else 2)
        if misfit_mm > MISFIT_MM:
            text = f"the contacts of feature {name} of pose {pose} are {misfit_mm:.3f} mm from a {kind}; was the probe elsewhere?"
            raise InputError(text, file=path)
        centres.append(centre_mm)
        sizes.append(2.0 * radius_mm)
        misfits.append(misfit_mm)
    if not contacts:
        raise InputError("contains no contact", file=path)
    measured_mm, nominal_mm = np.array(centres), np.array([own[0][1] for own in contacts.values()])
    flat = feature[3] == "xy"
    if flat:  # the height of the plate: what is not measured counts as where the machine was
        nominal_mm = np.column_stack([nominal_mm[:, :2], measured_mm[:, 2]])
        measured_mm[:, 2] = np.nan
    poses = [pose for pose, _ in contacts]
    u_mm, calibrated = float(stated[2]) * MM_PER_UM, stated[0] == "true"
    data = Artefact(
        feature=[name for _, name in contacts],
        nominal_mm=nominal_mm,
        u_nominal_mm=np.full(nominal_mm.shape, u_mm if calibrated and u_mm else np.nan),
        measured_mm=measured_mm,
        setup=np.array(poses, dtype=np.int64),
        calibrated=np.full(len(poses), calibrated),
        metadata={
            "machine": machine[0],
            "source": path.name,
            "instrument": "touch-probe",
            **({"u_probe_um": stated[1]} if float(stated[1]) > 0 else {}),
        },
    )
    difference = 0.5 * (max(sizes) - min(sizes))
    sign = -1.0 if kind == "bore" else 1.0
    understood = {
        "machine": machine[0],
        "features": len(set(data.feature)),
        "poses": len(set(poses)),
        "kind": kind,
        "components": feature[3],
        "calibrated": calibrated,
        "effective_diameter_mm": float(np.mean(sizes)),
        "expected_diameter_mm": float(feature[1]) + sign * float(feature[2]),
        "largest_misfit_um": max(misfits) / MM_PER_UM,
    }
    notes = [
        f"effective diameters differ by +-{difference / MM_PER_UM:.1f} um: pretravel, form and size of the features"
    ]
    return Imported(path, "probe-log", "artefact", data, understood, (), tuple(notes))


def _stated(path: Path, lines: list[tuple[int, str]], key: str, pattern: re.Pattern[str]) -> tuple[str, ...]:
    """What the head line that begins with ``key`` states."""
    for number, line in lines:
        if line.startswith(f"{key} "):
            found = pattern.fullmatch(line)
            if found is None:
                raise InputError(f"{shown(line)} is not a head line of the program", file=path, line=number)
            return found.groups()
    raise InputError(f"lacks the line {key}", file=path)


def _centre(points_mm: FloatArray, dimensions: int) -> tuple[FloatArray, float, float]:
    """Centre (3,), radius and largest distance of contacts (k, 3) from the circle or sphere of least squares."""
    own = points_mm[:, :dimensions]
    middle = own.mean(axis=0)
    if dimensions == 3:  # four contacts at the equator, one from above
        middle[2] = own[:, 2].min()
    unknowns = np.append(middle, np.linalg.norm(own - middle, axis=1).mean())
    for _ in range(STEPS):
        away = own - unknowns[:-1]
        distance = np.linalg.norm(away, axis=1)
        design = np.column_stack([-away / distance[:, None], -np.ones(len(own))])
        unknowns = unknowns - np.linalg.lstsq(design, distance - unknowns[-1], rcond=None)[0]
    residual = np.linalg.norm(own - unknowns[:-1], axis=1) - unknowns[-1]
    centre = points_mm.mean(axis=0)
    centre[:dimensions] = unknowns[:-1]
    return centre, float(unknowns[-1]), float(np.abs(residual).max())
