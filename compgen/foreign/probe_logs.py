"""Logs of our probe programs: contacts on the features of an artefact, or on spheres at poses, to centres.

Features (:mod:`compgen.tables.probe_program`):

    VOLCOMP PROBE LOG 1
    MACHINE zha-gantry
    FEATURE bore 20.0 BALL 6.0 COMPONENTS xy UNIT-MM 1
    CALIBRATED false U-PROBE-UM 0.5 U-CALIBRATION-UM 0
    P1 F001 N -25.0 0.0 0.0 C -416.000 -500.000 -200.000 X+ -418.0123
    END

N is the nominal place in the artefact, C the target of the motion in machine coordinates, mm. The last number is the
position of the axis named before it at the contact, in units of UNIT-MM; the other two axes were at C.

Spheres (:mod:`compgen.tables.sphere_program`):

    VOLCOMP SPHERE LOG 1
    MACHINE trunnion
    SPHERE 20.0 BALL 6.0 CONTACTS 5 POSES 40 U-UM 2.0 UNIT-MM 1
    P1 S1 T 0.0000 0.0000 -100.0000 A -30.000 C 40.000 N 1 12.345678 -20.123456 130.001234
    END

T is the offset of the tip, mm, then the angles as in the machine file, degrees, the number of the contact, and the positions of
X, Y, Z there in units of UNIT-MM: machine coordinates without a transformation.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.machine import ROTARY
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.rotary import JOINTS, SphereCentres
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.findings import Imported
from compgen.foreign.source import read_source, shown

PROBE_LOG_TITLE, SPHERE_LOG_TITLE = "VOLCOMP PROBE LOG 1", "VOLCOMP SPHERE LOG 1"
_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_ON_FEATURE = re.compile(
    rf"P(\d+) (\S+) N {' '.join([_NUMBER] * 3)} C {' '.join([_NUMBER] * 3)} ([XYZ])([+-]) {_NUMBER}"
)
_FEATURE = re.compile(rf"FEATURE (bore|sphere) {_NUMBER} BALL {_NUMBER} COMPONENTS (xyz?) UNIT-MM {_NUMBER}")
_STATED = re.compile(rf"CALIBRATED (true|false) U-PROBE-UM {_NUMBER} U-CALIBRATION-UM {_NUMBER}")
_HEAD = re.compile(rf"SPHERE {_NUMBER} BALL {_NUMBER} CONTACTS (\d+) POSES (\d+) U-UM {_NUMBER} UNIT-MM {_NUMBER}")
_AT_POSE = re.compile(
    rf"P(\d+) (\S+) T {' '.join([_NUMBER] * 3)}((?: [ABC] [-+]?\d+(?:\.\d*)?)+) N (\d+) {' '.join([_NUMBER] * 3)}"
)
#: Contacts of one feature that fit a circle or sphere worse than this were not all made on it, mm.
MISFIT_MM = 0.05
#: A found diameter that differs more from that of sphere and ball is another sphere, or another unit, mm.
_OTHER_MM = 0.5
#: Steps of the fit of a circle or sphere.
FIT_STEPS = 20


def is_probe_log(text: str) -> bool:
    """Whether a text begins like the log of a probe program; controls may write lines before it."""
    return PROBE_LOG_TITLE in text


def is_sphere_log(text: str) -> bool:
    """Whether a text begins like the log of a sphere program; controls may write lines before it."""
    return SPHERE_LOG_TITLE in text


def _one_run(path: Path, title: str) -> list[tuple[int, str]]:
    """The lines of the only run of a program behind its title, with their numbers.

    Raises
    ------
    InputError
        for a log of no run or of several, and for one that does not end.
    """
    lines = [(number, line.strip()) for number, line in enumerate(read_source(path).text.splitlines(), 1)]
    begin = [k for k, (_, line) in enumerate(lines) if line.endswith(title)]
    if not begin:
        raise InputError(f"has no line that ends with {title}: was it edited? measure again", file=path)
    if len(begin) > 1:
        raise InputError(
            f"contains {len(begin)} runs of the program; keep one of them, and delete the file on the control before each run",
            file=path,
            line=lines[begin[1]][0],
        )
    if not any(line == "END" for _, line in lines):
        raise InputError("has no END: the program did not run to its end; measure again", file=path, line=len(lines))
    return lines[begin[0] + 1 :]


def import_probe_log(path: Path, options: ImportOptions) -> Imported:
    """Import the log of a probe program as an artefact.

    Raises
    ------
    InputError
        for a log without its end, of several runs, with a missing contact, or with contacts that are not on the feature.
    """
    lines = _one_run(path, PROBE_LOG_TITLE)
    machine, feature, stated = (
        _stated(path, lines, key, pattern)
        for key, pattern in (("MACHINE", re.compile("MACHINE (.+)")), ("FEATURE", _FEATURE), ("CALIBRATED", _STATED))
    )
    kind, unit_mm = feature[0], float(feature[4])
    contacts: dict[tuple[int, str], list[tuple[FloatArray, FloatArray, str]]] = {}
    for number, line in lines:
        if not re.match(r"P\d", line):
            continue
        found = _ON_FEATURE.fullmatch(line)
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
        centre_mm, radius_mm, misfit_mm = _fitted(points_mm, 3 if kind == "sphere" else 2)
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


def import_sphere_log(path: Path, options: ImportOptions) -> Imported:
    """Import the log of a sphere program.

    Raises
    ------
    InputError
        for a log without its end, of several runs, with a missing contact, or with contacts that are not on a sphere.
    """
    lines = _one_run(path, SPHERE_LOG_TITLE)
    machine = next((line.partition(" ")[2] for _, line in lines if line.startswith("MACHINE ")), "")
    head = next((found for _, line in lines if (found := _HEAD.fullmatch(line))), None)
    if head is None:
        raise InputError("lacks the line SPHERE with diameter, BALL, CONTACTS, POSES, U-UM and UNIT-MM", file=path)
    diameter, ball, unit_mm = float(head[1]), float(head[2]), float(head[6])
    poses = _poses(path, lines, unit_mm)
    if len(poses) != int(head[4]):
        raise InputError(f"contains {len(poses)} poses, and the program has {head[4]}; measure again", file=path)
    rows = [_found(path, number, own, int(head[3]), diameter + ball) for number, own in poses.items()]
    letters = [letter for letter in ROTARY if letter in rows[0]["angle"]]
    count, nan = len(rows), np.full(len(rows), np.nan)
    data = SphereCentres(
        found_mm=np.array([row["centre"] for row in rows]),
        deviation_mm=np.full((count, 3), np.nan),
        coordinates=JOINTS,
        angle_deg={letter: np.array([row["angle"][letter] for row in rows]) for letter in letters},
        tool_mm=np.array([row["tool"] for row in rows]),
        sphere=[row["sphere"] for row in rows],
        setup=np.ones(count, dtype=np.int64),
        u_mm=np.full(count, float(head[5]) * MM_PER_UM) if float(head[5]) > 0.0 else nan,
        diameter_mm=np.array([row["diameter"] - ball for row in rows]),
        time_s=nan,
        metadata={"machine": machine, "source": path.name, "instrument": "touch-probe"},
        origin=[(str(path), row["line"]) for row in rows],
    )
    sizes = data.diameter_mm
    understood = {
        "machine": machine,
        "poses": count,
        "spheres": len(set(data.sphere)),
        "rotary_axes": " ".join(letters),
        "diameter_mm": float(np.mean(sizes)),
        "largest_misfit_um": max(row["misfit"] for row in rows) / MM_PER_UM,
    }
    notes = (
        f"probed diameters differ by +-{0.5 * (sizes.max() - sizes.min()) / MM_PER_UM:.1f} um: pretravel and form of the sphere",
    )
    return Imported(path, "sphere-log", "sphere", data, understood, (), notes)


def _poses(path: Path, lines: list[tuple[int, str]], unit_mm: float) -> dict[int, dict[str, Any]]:
    """Contacts by the number of their pose."""
    found: dict[int, dict[str, Any]] = {}
    for number, line in lines:
        if not re.match(r"P\d", line):
            continue
        match = _AT_POSE.fullmatch(line)
        if match is None:
            raise InputError(f"{shown(line)} is not a contact of the program", file=path, line=number)
        words = match[6].split()
        state = {
            "sphere": match[2],
            "tool": [float(word) for word in match.group(3, 4, 5)],
            "angle": {letter: float(value) for letter, value in zip(words[::2], words[1::2], strict=True)},
        }
        own = found.setdefault(int(match[1]), {**state, "contacts": {}, "line": number})
        if any(own[key] != value for key, value in state.items()):
            raise InputError(
                f"pose {match[1]} has another sphere, tool or angle than in its first line", file=path, line=number
            )
        if int(match[7]) in own["contacts"]:
            raise InputError(f"contact {match[7]} of pose {match[1]} is there twice", file=path, line=number)
        own["contacts"][int(match[7])] = [unit_mm * float(word) for word in match.group(8, 9, 10)]
    if not found:
        raise InputError("contains no contact", file=path)
    letters = {tuple(own["angle"]) for own in found.values()}
    if len(letters) > 1:
        raise InputError("names other rotary axes at some poses than at others", file=path)
    return found


def _found(path: Path, number: int, own: dict[str, Any], contacts: int, expected_mm: float) -> dict[str, Any]:
    """The pose with centre, diameter (of the sphere and the ball) and misfit, mm."""
    missing = sorted(set(range(1, contacts + 1)) - set(own["contacts"]))
    if missing:
        raise InputError(
            f"pose {number} lacks the contacts {', '.join(map(str, missing))}", file=path, line=own["line"]
        )
    centre, radius, misfit = _fitted(np.array(list(own["contacts"].values())), 3)
    if misfit > MISFIT_MM:
        raise InputError(
            f"the contacts of pose {number} are {misfit:.3f} mm from a sphere; was the probe elsewhere?",
            file=path,
            line=own["line"],
        )
    if abs(2.0 * radius - expected_mm) > _OTHER_MM:
        raise InputError(
            f"the contacts of pose {number} are on a sphere of {2.0 * radius:.3f} mm; sphere and ball have {expected_mm:g} mm "
            "together; is it another sphere, or another unit?",
            file=path,
            line=own["line"],
        )
    return {**own, "centre": centre, "diameter": 2.0 * radius, "misfit": misfit}


def _fitted(points_mm: FloatArray, dimensions: int) -> tuple[FloatArray, float, float]:
    """Centre (3,), radius and largest distance of contacts (k, 3) from the circle or sphere of least squares."""
    middle = points_mm.mean(axis=0)
    own = (points_mm - middle)[:, :dimensions]
    # |p|^2 = 2 p c + (r^2 - |c|^2), linear in the centre c
    start = np.linalg.lstsq(np.column_stack([2.0 * own, np.ones(len(own))]), np.sum(own**2, axis=1), rcond=None)[0]
    unknowns = np.append(start[:-1], np.sqrt(max(start[-1] + start[:-1] @ start[:-1], 1e-12)))
    for _ in range(FIT_STEPS):
        away = own - unknowns[:-1]
        distance = np.linalg.norm(away, axis=1)
        design = np.column_stack([-away / distance[:, None], -np.ones(len(own))])
        unknowns = unknowns - np.linalg.lstsq(design, distance - unknowns[-1], rcond=None)[0]
    residual = np.linalg.norm(own - unknowns[:-1], axis=1) - unknowns[-1]
    centre = middle + np.append(unknowns[:-1], np.zeros(3 - dimensions))
    return centre, float(unknowns[-1]), float(np.abs(residual).max())
