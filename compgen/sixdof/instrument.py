"""The instrument file: constants of the optics, the set-up of each axis, calibrated systematic parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from compgen.core import tomlio
from compgen.core.machine import Vector3
from compgen.core.names import AXES
from compgen.core.text import nearest
from compgen.sixdof.model import SetUp, systematic_columns
from compgen.sixdof.optics import Optics

RAD_PER_ARCSEC = math.pi / 648000.0
#: Units of systematic parameters by the ending of their key, to mm or rad.
UNITS = {
    "eps": {"arcsec": RAD_PER_ARCSEC, "urad": 1e-6, "rad": 1.0},
    "delta": {"um": 1e-3, "mm": 1.0},
}
Line = Literal["ls", "minzone"]
#: Signs of S_xy, S_xz, S_yz (90 degrees minus the angle between the positive axes) in EC0Y, EB0Z, EA0Z.
SQUARENESS_SIGNS = (-1.0, 1.0, -1.0)


@dataclass(frozen=True)
class AxisSetUp:
    """How one axis was measured.

    Parameters
    ----------
    set_up : axis, mode and beam direction.
    distance_first_mm : L at the first target position of a run; None if the readings hold the distance.
    position_mm : where the other axes stood (its own component does not count); None: machine zero.
    target_offset_mm : from the reference point of the tool (spindle nose) to the front centre of the first cube corner.
    systematics : calibrated parameters of this axis, mm and rad.
    """

    set_up: SetUp
    distance_first_mm: float | None = None
    position_mm: Vector3 | None = None
    target_offset_mm: Vector3 = (0.0, 0.0, 0.0)
    systematics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Instrument:
    """A six-DOF laser instrument as its TOML file describes it.

    Parameters
    ----------
    optics : constants.
    axes : set-up of each measured axis by number (0, 1, 2).
    line : the line that is taken out of straightness: least squares, or minimum zone.
    as_printed : use equations 5-7 as the paper prints them, for comparison with it only.
    squareness_signs : signs of S_xy, S_xz, S_yz in EC0Y, EB0Z, EA0Z.
    u_systematics : standard uncertainties of calibrated parameters, mm and rad.
    u_constants : standard uncertainties of constants by their key in the file.
    noise : standard deviations of the signals by name, mm.
    """

    optics: Optics
    axes: Mapping[int, AxisSetUp]
    line: Line = "ls"
    as_printed: bool = False
    squareness_signs: tuple[float, float, float] = SQUARENESS_SIGNS
    u_systematics: Mapping[str, float] = field(default_factory=dict)
    u_constants: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    source: Path | None = None


def known_systematics(axis: int | None = None) -> tuple[str, ...]:
    """Names of the systematic parameters of one axis, or of all."""
    at = np.zeros(1)
    axes = range(3) if axis is None else (axis,)
    return tuple(dict.fromkeys(name for k in axes for name in systematic_columns(Optics(), SetUp(k), at)))


def read_instrument(path: str | Path) -> Instrument:
    """Read an instrument TOML strictly; InputError with file, line and key."""
    root = tomlio.read_toml(path)
    root.take("kind", tomlio.choice("sixdof-laser"))
    default = Optics()
    optics = Optics(
        focal_length_mm=root.take("focal_length_mm", tomlio.positive),
        beam_separation_mm=root.take("beam_separation_mm", _separation),
        glass_index=root.take("glass_index", _glass),
        cube_side_mm=root.take("cube_side_mm", tomlio.positive),
        plate_thickness_mm=root.take("plate_thickness_mm", tomlio.not_negative),
        prism_leg_mm=root.take("prism_leg_mm", tomlio.positive, default.prism_leg_mm),
        exit_to_prism_mm=root.take("exit_to_prism_mm", tomlio.not_negative, 0.0),
    )
    common = read_systematics(root.section("systematics", required=False))
    u_common = read_systematics(root.section("u_systematics", required=False), check=tomlio.not_negative)
    instrument = Instrument(
        optics=optics,
        axes=_read_axes(root.section("axes"), common),
        line=cast(Line, root.take("line", tomlio.choice("ls", "minzone"), "ls")),
        as_printed=root.take("as_printed", tomlio.flag, False),
        squareness_signs=root.take("squareness_sign", _signs, SQUARENESS_SIGNS),
        u_systematics=u_common,
        u_constants=_read_numbers(root.section("u_constants", required=False), _CONSTANTS),
        noise=_read_noise(root.section("noise", required=False)),
        source=Path(path),
    )
    root.finish()
    return instrument


_CONSTANTS = (
    "focal_length_mm",
    "beam_separation_mm",
    "glass_index",
    "cube_side_mm",
    "plate_thickness_mm",
    "prism_leg_mm",
    "exit_to_prism_mm",
    "distance_first_mm",
    "drift_gain_percent",
    "parallel_drift_um",
    "displacement_ppm",
)
_NOISE = ("displacement_um", "qd_um", "psd_um")


def _separation(value: Any) -> float:
    result = tomlio.number(value)
    if result == 0.0:
        raise ValueError("the separation of the beams, not zero, is expected")
    return result


def _glass(value: Any) -> float:
    result = tomlio.number(value)
    if not 1.0 < result < 4.0:
        raise ValueError("a refractive index between 1 and 4 is expected")
    return result


def _signs(value: Any) -> tuple[float, float, float]:
    """One sign for all three, or a list of three: +1 keeps the program's own convention, -1 turns it."""
    turns = tomlio.numbers(value) if isinstance(value, list) else (tomlio.number(value),) * 3
    if len(turns) != 3 or any(turn not in (-1.0, 1.0) for turn in turns):
        raise ValueError("1, -1, or a list of three of them (for XY, XZ, YZ) is expected")
    x, y, z = (sign * turn for sign, turn in zip(SQUARENESS_SIGNS, turns, strict=True))
    return x, y, z


def _read_numbers(section: tomlio.Section, names: tuple[str, ...]) -> dict[str, float]:
    found = {name: section.take(name, tomlio.not_negative) for name in names if name in section}
    section.finish()
    return found


def _read_noise(section: tomlio.Section) -> dict[str, float]:
    found = _read_numbers(section, _NOISE)
    return {name.removesuffix("_um"): value * 1e-3 for name, value in found.items()}


def _beam_direction(value: Any) -> int:
    if value not in (1, -1) or isinstance(value, bool):
        raise ValueError("1 (beam along the positive axis at the target) or -1 is expected")
    return int(value)


def _offset(value: Any) -> Vector3:
    """Three numbers, or 0."""
    if not isinstance(value, bool) and value == 0:
        return (0.0, 0.0, 0.0)
    return tomlio.vector3(value)


def _read_axes(section: tomlio.Section, common: Mapping[str, float]) -> dict[int, AxisSetUp]:
    found = {}
    for number, letter in enumerate(AXES):
        if letter in section:
            found[number] = _read_axis(section.section(letter), number, common)
    section.finish()
    if not found:
        raise section.fail("X", "no axis is described; give [axes.X], [axes.Y] or [axes.Z]")
    return found


def _read_axis(entry: tomlio.Section, axis: int, common: Mapping[str, float]) -> AxisSetUp:
    mode = entry.take("mode", tomlio.whole(1, 2))
    direction = entry.take("beam_direction", _beam_direction, 1)
    own = read_systematics(entry.section("systematics", required=False), axis)
    known = known_systematics(axis)
    result = AxisSetUp(
        set_up=SetUp(axis, mode, direction),
        distance_first_mm=entry.take("distance_first_mm", tomlio.number, None),
        position_mm=entry.take("position_mm", tomlio.vector3, None),
        target_offset_mm=entry.take("target_offset_mm", _offset, (0.0, 0.0, 0.0)),
        systematics={**{name: value for name, value in common.items() if name in known}, **own},
    )
    entry.finish()
    return result


def read_systematics(
    section: tomlio.Section, axis: int | None = None, check: Callable[[Any], float] = tomlio.number
) -> dict[str, float]:
    """Read parameters with their unit at the end of the key (``eps_zir_arcsec``, ``delta_xic_um``) to mm and rad."""
    names, found = known_systematics(axis), {}
    for key in section.data:
        name, _, unit = key.rpartition("_")
        units = UNITS.get(name.partition("_")[0], {})
        if name not in names or unit not in units:
            allowed = [f"{n}_{'arcsec' if n.startswith('eps') else 'um'}" for n in names]
            raise section.fail(key, f"is not a systematic parameter; {nearest(key, allowed)}")
        if name in found:
            raise section.fail(key, "stands there twice, in two units")
        found[name] = section.take(key, check) * units[unit]
    section.finish()
    return found
