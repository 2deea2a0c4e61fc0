"""Logs of programs that probe spheres (:mod:`compgen.tables.sphere_program`): contacts at poses, to centres of spheres.

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
from compgen.data.machine import ROTARY
from compgen.data.names import MM_PER_UM
from compgen.data.rotary import JOINTS, SphereCentres
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.findings import Imported
from compgen.foreign.source import read_source, shown

SPHERE_LOG_TITLE = "VOLCOMP SPHERE LOG 1"
_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_HEAD = re.compile(rf"SPHERE {_NUMBER} BALL {_NUMBER} CONTACTS (\d+) POSES (\d+) U-UM {_NUMBER} UNIT-MM {_NUMBER}")
_CONTACT = re.compile(
    rf"P(\d+) (\S+) T {' '.join([_NUMBER] * 3)}((?: [ABC] [-+]?\d+(?:\.\d*)?)+) N (\d+) {' '.join([_NUMBER] * 3)}"
)
#: Contacts of one pose that fit a sphere worse than this were not all made on it, mm.
_MISFIT_MM = 0.05
#: A found diameter that differs more from that of sphere and ball is another sphere, or another unit, mm.
_OTHER_MM = 0.5
_STEPS = 20


def is_sphere_log(text: str) -> bool:
    """Whether a text begins like the log of a sphere program; controls may write lines before it."""
    return SPHERE_LOG_TITLE in text


def import_sphere_log(path: Path, options: ImportOptions) -> Imported:
    """Import the log of a sphere program.

    Raises
    ------
    InputError
        for a log without its end, of several runs, with a missing contact, or with contacts that are not on a sphere.
    """
    lines = [(number, line.strip()) for number, line in enumerate(read_source(path).text.splitlines(), 1)]
    begin = [k for k, (_, line) in enumerate(lines) if line.endswith(SPHERE_LOG_TITLE)]
    if len(begin) != 1:
        raise InputError(
            f"contains {len(begin)} runs of the program; keep one of them, and delete the file on the control before each run",
            file=path,
            line=lines[begin[1]][0],
        )
    if not any(line == "END" for _, line in lines):
        raise InputError("has no END: the program did not run to its end; measure again", file=path, line=len(lines))
    lines = lines[begin[0] + 1 :]
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
        match = _CONTACT.fullmatch(line)
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
    centre, radius, misfit = _sphere_through(np.array(list(own["contacts"].values())))
    if misfit > _MISFIT_MM:
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


def _sphere_through(points_mm: FloatArray) -> tuple[FloatArray, float, float]:
    """Centre (3,), radius and largest distance of contacts (k, 3) from the sphere of least squares."""
    middle = points_mm.mean(axis=0)
    own = points_mm - middle
    # |p|^2 = 2 p c + (r^2 - |c|^2), linear in the centre c
    solved = np.linalg.lstsq(np.column_stack([2.0 * own, np.ones(len(own))]), np.sum(own**2, axis=1), rcond=None)[0]
    unknowns = np.append(solved[:3], np.sqrt(max(solved[3] + solved[:3] @ solved[:3], 1e-12)))
    for _ in range(_STEPS):
        away = own - unknowns[:3]
        distance = np.linalg.norm(away, axis=1)
        design = np.column_stack([-away / distance[:, None], -np.ones(len(own))])
        unknowns = unknowns - np.linalg.lstsq(design, distance - unknowns[3], rcond=None)[0]
    residual = np.linalg.norm(own - unknowns[:3], axis=1) - unknowns[3]
    return middle + unknowns[:3], float(unknowns[3]), float(np.abs(residual).max())
