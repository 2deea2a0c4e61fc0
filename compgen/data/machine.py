"""A machine as described by its TOML file: chain, linear and rotary axes, error model, work zone and tools.

:func:`read_machine` reads one file strictly, :func:`load_machine` finds it by name. A machine keeps the raw
sections of its controls and effects, which read their settings when they are used.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from compgen.data import toml_files
from compgen.data.arguments import numbers, of_kind, path_of, text_of
from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES, ERROR_NAMES
from compgen.data.prior import PriorSettings, prior_schema, read_prior
from compgen.data.repeatability import EXPANSION_SHARE, Repeatability
from compgen.drawing.display import Displayed, Overview
from compgen.errors import CompgenWarning, InputError, nearest
from compgen.resources import data_folder

# Where tables must be most accurate if they cannot be accurate everywhere: a work zone, and tools of several lengths.


Interval = tuple[float, float]
Vector3 = tuple[float, float, float]
PartialVector = tuple[float | None, float | None, float | None]

#: Default weight of a coordinate within the work zone, relative to one outside.
ZONE_WEIGHT = 10.0
#: Almost only the zone counts; the rest of the travel still determines what the zone leaves open.
MOST_ZONE_WEIGHT = 1e3


_weight = toml_files.bounded(
    f"a number from 1 (no zone) to {MOST_ZONE_WEIGHT:g} (almost only the zone)", minimum=1.0, maximum=MOST_ZONE_WEIGHT
)

#: What numbers without a decimal point may be in NC programs.
INTEGERS = ("mm", "increments")


@dataclass(frozen=True)
class Emphasis:
    """Weights of the least squares for the tables.

    Parameters
    ----------
    zone_mm : ranges of X, Y and Z within the travel (None: the whole travel); if all are None there is no zone.
    zone_weight : weight of a coordinate within the zone, relative to one outside; the factors of the axes multiply.
    tools_mm : tool offsets over which the residual is averaged; none: that of the machine file.
    """

    zone_mm: tuple[Interval | None, Interval | None, Interval | None] = toml_files.axis_setting(
        toml_files.interval,
        key="work_zone_mm",
        meaning="the part of the travel where the tables must be most accurate, mm",
    )
    zone_weight: float = toml_files.setting(_weight, ZONE_WEIGHT)
    tools_mm: tuple[Vector3, ...] = toml_files.setting(toml_files.vectors3, ())

    @property
    def has_zone(self) -> bool:
        """Whether a part of the travel has more weight than the rest."""
        return any(part is not None for part in self.zone_mm) and self.zone_weight != 1.0

    def ends_mm(self, axis: int) -> list[float]:
        """Return the ends of the zone along an axis, none if it covers the whole travel."""
        part = self.zone_mm[axis]
        return [] if part is None or not self.has_zone else list(part)

    def factor(self, axis: int, along_mm: FloatArray) -> FloatArray:
        """Return the factor of one axis in the weight of positions along it, same shape.

        The weight is a product over the axes, so that what depends on one of them remains orthogonal to what depends on
        another: a table over X must not absorb the average effect of Y as a step at the end of the zone.
        """
        ends = self.ends_mm(axis)
        if not ends:
            return np.ones_like(along_mm)
        return np.where((along_mm > ends[0]) & (along_mm < ends[1]), self.zone_weight, 1.0)

    def summary(self) -> dict[str, Any]:
        """Return the entries of ``manifest.json``."""
        zone = {letter: list(part) for letter, part in zip(AXES, self.zone_mm, strict=True) if part is not None}
        return {
            "work_zone_mm": zone if self.has_zone else None,
            "zone_weight": self.zone_weight if self.has_zone else None,
            "tools_mm": [list(tool) for tool in self.tools_mm],
        }

    @property
    def notes(self) -> list[str]:
        """Return what the user of the tables should know."""
        notes = []
        if self.has_zone:
            parts = [
                f"{letter} {part[0]:g} ... {part[1]:g} mm"
                for letter, part in zip(AXES, self.zone_mm, strict=True)
                if part
            ]
            zone = ", ".join(parts)
            notes.append(
                f"The tables are made for the work zone {zone}; a coordinate in it has {self.zone_weight:g} times the weight."
            )
        if self.tools_mm:
            tools = "; ".join(", ".join(f"{value:g}" for value in tool) for tool in self.tools_mm)
            notes.append(f"The tables are made for the tool offsets (x, y, z in mm) {tools}, with equal weight.")
        return notes


def take_emphasis(root: toml_files.Section, travel_mm: Sequence[Interval]) -> Emphasis:
    """Read ``work_zone_mm``, ``zone_weight`` and ``tools_mm`` from a machine file."""
    emphasis = toml_files.take_settings(Emphasis, root)
    for letter, part, (low, high) in zip(AXES, emphasis.zone_mm, travel_mm, strict=True):
        if part is not None and (part[0] < low or part[1] > high):
            raise root.section("work_zone_mm").fail(letter, _outside(letter, part, (low, high)))
    return emphasis


def zone_of(text: str, travel_mm: Sequence[Interval]) -> tuple[Interval | None, Interval | None, Interval | None]:
    """Read a zone such as ``"X=-400:0,Y=100:300"`` (mm); InputError with what is expected."""
    found: dict[str, Interval] = {}
    for part in text.split(","):
        letter, _, ends = part.strip().partition("=")
        letter = letter.strip().upper()
        try:
            low, high = (float(end) for end in ends.split(":"))
        except ValueError:
            low, high = np.nan, np.nan
        if letter not in AXES or letter in found or not -np.inf < low < high < np.inf:
            raise InputError(
                f"--zone: {part.strip()[:40]!r} is not a range; expected each axis once, lower end first, in mm, "
                f"e.g. X=-400:0,Y=100:300"
            )
        found[letter] = (low, high)
        travel = travel_mm[AXES.index(letter)]
        if low < travel[0] or high > travel[1]:
            raise InputError(f"--zone: {_outside(letter, (low, high), travel)}")
    return found.get("X"), found.get("Y"), found.get("Z")


def _outside(letter: str, part: Interval, travel: Interval) -> str:
    return (
        f"the work zone {letter} = {part[0]:g} ... {part[1]:g} mm exceeds the travel {travel[0]:g} ... {travel[1]:g} mm; "
        f"give the part of it within the travel"
    )


# A machine as described by its TOML file: chain, axes, contents of the error model, settings of the controls.


Reference = Literal["X", "Y"]
CurveBasis = Literal["linear", "cubic"]
ErrorSelection = Literal["observable", 17, 21] | tuple[str, ...]

ToolRange = tuple[Interval, Interval, Interval]

#: Default range of tool offsets about that of the machine file in X, Y and Z, mm.
ASSUMED_TOOL_MM: Vector3 = (100.0, 100.0, 200.0)
#: The 24 valid chains: W, every order of X, Y, Z and F, then T.
CHAINS: tuple[str, ...] = tuple(f"W{''.join(order)}T" for order in permutations("FXYZ"))


#: Length of a unit in which a control may keep its numbers.
MM_PER_UNIT = {"mm": 1.0, "inch": 25.4}
#: Longest travel and offset of a machine, mm.
MOST_MM = 1e6
#: A travel below this is asked about, mm.
FEW_MM = 60.0
_NODES = toml_files.whole(2, 10001)
_ONE_NODES = {"oneOf": [{"required": ["nodes"]}, {"required": ["nodes_mm"]}]}
#: A length of a machine, mm.
_WITHIN = {"type": "number", "minimum": -MOST_MM, "maximum": MOST_MM}


#: How far a margin can be meant to go, mm.
_MOST_MARGIN_MM = 100.0
_margin = toml_files.bounded(f"a length from 0 to {_MOST_MARGIN_MM:g} mm", minimum=0.0, maximum=_MOST_MARGIN_MM)


@toml_files.accepts({**toml_files.accepted(toml_files.interval), "items": _WITHIN})
def _travel(value: object) -> tuple[float, float]:
    """Return the lower and upper end of the travel, mm."""
    lower, upper = toml_files.interval(value)
    if max(abs(lower), abs(upper)) > MOST_MM:
        raise ValueError("expected a range within a kilometre of zero; is the unit mm?")
    return lower, upper


@toml_files.accepts({**toml_files.accepted(toml_files.vector3), "items": _WITHIN})
def _offset(value: object) -> Vector3:
    """Return a vector from one point of a machine to another, mm."""
    x, y, z = toml_files.vector3(value)
    if max(abs(x), abs(y), abs(z)) > MOST_MM:
        raise ValueError("expected components of less than a kilometre; is the unit mm?")
    return x, y, z


@toml_files.accepts(
    {
        "anyOf": [
            {**toml_files.accepted(toml_files.vector3), "items": _WITHIN},
            toml_files.table_schema(dict.fromkeys(AXES, _WITHIN)),
        ]
    }
)
def _reference(value: object) -> PartialVector:
    """Return the position of each axis at its reference point, mm; None along an axis that a table does not name."""
    if not isinstance(value, dict):
        return _offset(value)
    if not value or not set(value) <= set(AXES):
        raise ValueError("expected three numbers, or a table such as { Z = 500.0 }")
    x, y, z = (None if value.get(axis) is None else toml_files.number(value[axis]) for axis in AXES)
    _offset([place or 0.0 for place in (x, y, z)])
    return x, y, z


@toml_files.accepts(
    {
        "anyOf": [
            {"enum": ["observable", 17, 21]},
            {**toml_files.array_schema({"enum": list(ERROR_NAMES)}, 1), "uniqueItems": True},
        ]
    }
)
def _error_selection(value: Any) -> ErrorSelection:
    if value == "observable" or (value in (17, 21) and not isinstance(value, bool)):
        return cast(Literal["observable", 17, 21], value)
    if not isinstance(value, list) or not value:
        raise ValueError("expected 'observable', 17, 21 or a list of error names")
    for name in value:
        if name not in ERROR_NAMES:
            raise ValueError(f"{name!r} is not one of the 21 errors; {nearest(str(name), ERROR_NAMES)}")
    if len(set(value)) != len(value):
        raise ValueError("each error may be listed only once")
    return tuple(name for name in ERROR_NAMES if name in value)


@toml_files.accepts({"type": "string", "maxLength": 200, "pattern": r"^\s*[^\s=+@-][^=]*$"})
def _name(value: Any) -> str:
    """Return the name of a machine, which may be an argument of a command and a cell of a table."""
    name = toml_files.text(value)
    if "=" in name or name.lstrip()[0] in "+-@":
        raise ValueError("expected a name without '=' that does not begin with '+', '-' or '@'")
    return name


#: Rotary axes about X, Y, Z (ISO 841).
ROTARY = ("A", "B", "C")
#: Angle between an axis and the direction of its letter beyond which it is asked whether that is meant.
MOST_NUTATING_DEG = 60.0
#: Cosine beyond which a direction counts as opposite to that of its letter: no smallest rotation leads there.
OPPOSITE = 1.0 - 1e-6
_CHAIN_PATTERN = r"^W(?!.*([A-CFXYZ]).*\1)(?=.*F)(?=.*X)(?=.*Y)(?=.*Z)[A-CFXYZ]+T$"


@dataclass(frozen=True)
class ProgramNumbers:
    """What NC programs of a machine mean by a number without a decimal point; ``integers`` None: that is asked."""

    integers: str | None = toml_files.setting(
        toml_files.choice(*INTEGERS),
        None,
        meaning="what a number without a decimal point is in NC programs: X500 is 500 mm (mm), or 500 increments",
    )
    increment_mm: float | None = toml_files.setting(
        toml_files.bounded("an increment from 0.000001 to 1 mm", minimum=1e-6, maximum=1.0),
        None,
        meaning="least input increment of the control, mm: 0.001 (0.0001 inch, 0.001 deg); needed for increments",
    )


def _chain_fault(name: object) -> str:
    """What is wrong with the letters of a chain, after a semicolon; empty if only their order is."""
    letters = name[:40] if isinstance(name, str) else ""
    twice = sorted({letter for letter in letters if letters.count(letter) > 1})
    unknown = sorted(set(letters) - {"W", "F", "T", *AXES, *ROTARY})
    if unknown:
        return f"; {', '.join(unknown)} is no axis"
    return f"; {', '.join(twice)} appears twice" if twice else ""


@toml_files.accepts({"type": "string", "pattern": _CHAIN_PATTERN, "examples": ["WFYXZT", "WCAYFXZT"]})
@dataclass(frozen=True)
class Chain:
    """Kinematic chain from workpiece to tool, e.g. ``WFYXZT``, with rotary axes ``WCAYFXZT``; 0, 1, 2 are X, Y, Z.

    ``workpiece_side`` lists the linear axes left of F in order from the foundation outwards (the first is next to F),
    ``tool_side`` those right of F, also from the foundation outwards (the last carries the tool). With its rotary axes at
    zero a machine is that of its linear axes.

    Examples
    --------
    >>> import compgen
    >>> chain = compgen.Chain("WXYFZT")
    >>> chain.workpiece_side, chain.tool_side
    ((1, 0), (2,))
    """

    name: str
    workpiece_side: tuple[int, ...] = field(init=False)
    tool_side: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(_CHAIN_PATTERN, self.name):
            raise InputError(
                f"chain {self.name!r} is not valid; expected W, then X, Y, Z and F once each, then T, e.g. the name "
                f"'WFYXZT'; rotary axes A, B, C at most once each between them, e.g. 'WCAYFXZT'{_chain_fault(self.name)}"
            )
        left, _, right = self.linear[1:-1].partition("F")
        object.__setattr__(self, "workpiece_side", tuple(AXES.index(axis) for axis in reversed(left)))
        object.__setattr__(self, "tool_side", tuple(AXES.index(axis) for axis in right))

    @property
    def linear(self) -> str:
        """The chain without its rotary axes."""
        return "".join(letter for letter in self.name if letter not in ROTARY)

    @property
    def rotary(self) -> tuple[str, ...]:
        """Rotary axes from workpiece to tool."""
        return tuple(letter for letter in self.name if letter in ROTARY)

    @property
    def passed(self) -> tuple[tuple[str, bool], ...]:
        """Axes in the order in which a point passes them from tool to workpiece, with True for the tool side."""
        left, _, right = self.name[1:-1].partition("F")
        return (*((letter, True) for letter in reversed(right)), *((letter, False) for letter in reversed(left)))

    def lever_axes(self, axis: int) -> tuple[int, ...]:
        """Axes whose travel is part of the lever arm of an angular error of ``axis`` (``docs/conventions.md``)."""
        if axis in self.tool_side:
            return self.tool_side[self.tool_side.index(axis) + 1 :]
        return self.tool_side + self.workpiece_side[: self.workpiece_side.index(axis) + 1]


@dataclass(frozen=True, repr=False)
class Axis(Displayed):
    """One linear axis: travel range and curve nodes in mm; ``nodes_mm`` has shape (n,) and spans the range.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> axis = compgen.Axis((0.0, 600.0), np.linspace(0.0, 600.0, 7))
    >>> axis
    <Axis: 0 to 600 mm, 7 nodes>
    >>> axis.length_mm
    600.0
    """

    range_mm: tuple[float, float] = toml_files.setting(_travel, meaning="lower and upper end of the travel, mm")
    nodes_mm: FloatArray = toml_files.part_setting(
        {
            "nodes": {"anyOf": [toml_files.accepted(check) for check in (_NODES, toml_files.ascending)]},
            "nodes_mm": toml_files.accepted(toml_files.ascending),
        },
        meaning="nodes of the error curves: how many there are, equally spaced over the travel, or where, mm",
    )
    expansion_um_per_m_k: float | None = toml_files.setting(
        toml_files.number, None, meaning="thermal expansion of screw or scale, um/m/K"
    )
    screw_pitch_mm: float | None = toml_files.setting(
        toml_files.positive, None, meaning="pitch of the screw, mm: used to search for periodic errors"
    )
    u_expansion_um_per_m_k: float | None = toml_files.setting(
        toml_files.not_negative,
        None,
        meaning="standard uncertainty of expansion_um_per_m_k, um/m/K (a fifth of it if not stated): used by recalibration",
    )

    def __post_init__(self) -> None:
        low, high = numbers("range_mm", self.range_mm, 2).tolist()
        nodes = numbers("nodes_mm", self.nodes_mm, None)
        if not low < high:
            raise InputError(f"goes from {low:g} to {high:g} mm; expected the lower end first", field="range_mm")
        if len(nodes) < 2 or (np.diff(nodes) <= 0.0).any():
            raise InputError("expected at least two positions in ascending order, mm", field="nodes_mm")
        object.__setattr__(self, "nodes_mm", nodes)

    @property
    def u_expansion(self) -> float:
        """Standard uncertainty of the expansion coefficient, 1/K; 0 if scales are not corrected for temperature."""
        if self.expansion_um_per_m_k is None:
            return 0.0
        stated, usual = self.u_expansion_um_per_m_k, EXPANSION_SHARE * abs(self.expansion_um_per_m_k)
        return 1e-6 * (usual if stated is None else stated)

    @property
    def length_mm(self) -> float:
        """Travel in mm."""
        return self.range_mm[1] - self.range_mm[0]

    def overview(self) -> Overview:
        """Travel and number of nodes."""
        return Overview(f"{self.range_mm[0]:g} to {self.range_mm[1]:g} mm, {len(self.nodes_mm)} nodes")


_MOST_DEG = 36000.0
_angle = toml_files.bounded("an angle from -36000 to 36000 degrees", minimum=-_MOST_DEG, maximum=_MOST_DEG)
#: How far the length of a stated direction may be from 1, by rounding.
_UNIT = 2e-3
#: Ends of a travel within two turns in radians, which no axis has in degrees unless they are whole or half ones.
_TURN_RAD = 2.0 * np.pi


def _few_digits(angle_deg: float) -> bool:
    """Whether an angle is a whole or half number of degrees."""
    return abs(2.0 * angle_deg - round(2.0 * angle_deg)) < 1e-9


@toml_files.accepts(
    {
        **toml_files.accepted(toml_files.interval),
        "items": {"type": "number", "minimum": -_MOST_DEG, "maximum": _MOST_DEG},
    }
)
def _turns(value: object) -> tuple[float, float]:
    """Return the lower and upper end of the travel of a rotary axis, degrees; radians are refused."""
    low, high = toml_files.interval(value)
    if max(abs(low), abs(high)) > _MOST_DEG:
        raise ValueError("expected angles within a hundred turns; is the unit degrees?")
    if max(abs(low), abs(high)) < 1.001 * _TURN_RAD and not (_few_digits(low) and _few_digits(high)):
        degrees = f"[{np.degrees(low):.4g}, {np.degrees(high):.4g}]"
        raise ValueError(
            f"expected degrees; are these radians ({degrees} degrees)? A short travel ends at half degrees"
        )
    return low, high


@toml_files.accepts({"type": "number", "exclusiveMinimum": 0})
def _modulo(value: object) -> float:
    """Return after how many degrees an axis without end repeats: whole turns, or an even part of one."""
    found = toml_files.positive(value)
    turns = max(found / 360.0, 360.0 / found)
    if abs(turns - round(turns)) > 1e-9 or found > _MOST_DEG:
        radians = abs(found - _TURN_RAD) < 0.01
        raise ValueError(
            "expected degrees: 360, not 2 pi" if radians else "expected 360 degrees, or an even part of them"
        )
    return found


@toml_files.accepts(
    {**toml_files.accepted(toml_files.vector3), "items": {"type": "number", "minimum": -1.1, "maximum": 1.1}}
)
def _direction(value: object) -> Vector3:
    """Return the direction of a rotary axis, a unit vector."""
    x, y, z = toml_files.vector3(value)
    length = float(np.linalg.norm((x, y, z)))
    if length < 1e-9:
        raise ValueError("expected a direction such as [0.0, 0.0, 1.0]; (0, 0, 0) has none")
    if abs(length - 1.0) > _UNIT:
        unit = ", ".join(f"{part / length:.6g}" for part in (x, y, z))
        raise ValueError(f"expected a vector of length 1, this has {length:.4g}; of its direction is [{unit}]")
    return x, y, z


@dataclass(frozen=True, repr=False)
class RotaryAxis(Displayed):
    """One rotary axis: nominal direction, a point of its axis line (mm), range and nodes in degrees.

    The tool turns by +angle about ``direction`` relative to the workpiece (ISO 841), whichever side carries the axis.
    An axis that turns without end has ``modulo_deg``, the others ``range_deg``; errors are zero at ``reference_deg``.

    Examples
    --------
    >>> import numpy as np
    >>> from compgen.data.machine import RotaryAxis
    >>> RotaryAxis((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), np.linspace(0.0, 360.0, 13), modulo_deg=360.0)
    <RotaryAxis: 0 to 360 deg without end, 13 nodes>
    """

    direction: Vector3
    point_mm: Vector3 = toml_files.setting(
        _offset, meaning="a point of the axis line with all axes at zero, machine coordinates, mm"
    )
    nodes_deg: FloatArray = toml_files.part_setting(
        {
            "nodes": {
                "anyOf": [toml_files.accepted(check) for check in (_NODES, toml_files.ascending)],
                "description": "nodes of the error motions: how many there are, or at which angles, degrees",
            },
            "direction": {
                **toml_files.accepted(_direction),
                "description": "nominal direction, a unit vector: the tool turns by + about it relative to the workpiece",
            },
        },
        required=True,
    )
    range_deg: tuple[float, float] | None = toml_files.setting(
        _turns, None, meaning="lower and upper end of the travel, degrees"
    )
    modulo_deg: float | None = toml_files.setting(
        _modulo, None, meaning="an axis that turns without end: after how many degrees it repeats, 360"
    )
    reference_deg: float = toml_files.setting(_angle, 0.0, meaning="where the errors of the axis are zero, degrees")

    def __post_init__(self) -> None:
        direction = numbers("direction", self.direction, 3)
        length = float(np.linalg.norm(direction))
        if not length > 1e-9:
            raise InputError("is (0, 0, 0); expected a direction such as [0.0, 0.0, 1.0]", field="direction")
        object.__setattr__(self, "direction", tuple((direction / length).tolist()))
        if (self.range_deg is None) == (self.modulo_deg is None):
            raise InputError(
                "expected either range_deg, or modulo_deg for an axis that turns without end", field="range_deg"
            )
        low, high = self.ends_deg
        if not low < high:
            raise InputError(f"goes from {low:g} to {high:g} degrees; expected the lower end first", field="range_deg")
        if not low <= self.reference_deg <= high:
            raise InputError(
                f"{self.reference_deg:g} degrees is outside {low:g} ... {high:g}; the errors are zero there",
                field="reference_deg",
            )
        nodes = numbers("nodes_deg", self.nodes_deg, None)
        if len(nodes) < 2 or (np.diff(nodes) <= 0.0).any():
            raise InputError("expected at least two angles in ascending order, degrees", field="nodes_deg")
        turn = self.range_deg is None and nodes[-1] - nodes[0] <= high + 1e-9
        if not turn and np.abs(nodes[[0, -1]] - (low, high)).max() > 1e-9:
            raise InputError(
                f"range from {nodes[0]:g} to {nodes[-1]:g} degrees; expected {low:g} ... {high:g}, the travel",
                field="nodes_deg",
            )
        object.__setattr__(self, "nodes_deg", nodes)

    @property
    def ends_deg(self) -> tuple[float, float]:
        """Ends of the travel, or of one turn from zero, degrees."""
        return self.range_deg or (0.0, float(self.modulo_deg or 360.0))

    def overview(self) -> Overview:
        """Travel and number of nodes."""
        low, high = self.ends_deg
        endless = " without end" if self.modulo_deg is not None else ""
        return Overview(f"{low:g} to {high:g} deg{endless}, {len(self.nodes_deg)} nodes")


@dataclass(frozen=True, repr=False)
class Machine(Displayed):
    """A machine of three linear axes, X, Y, Z in that order; ``errors`` the contents of its model, ``rotary`` further axes.

    ``errors`` is ``"observable"``, 17, 21 or a tuple of names (resolved by :func:`compgen.kinematics.modelled_errors`).
    ``controllers`` keeps the raw settings of each control; the control itself checks them. ``emphasis`` says where
    tables must be most accurate. ``tool_range_mm`` are the ranges of tool offsets, None if its file does not state
    them. ``effects`` keeps the raw ``[effects.NAME]`` sections, which
    :func:`compgen.effects.active_effects` reads. ``prior`` is what is assumed of errors that were not measured.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> axis = compgen.Axis((-500.0, 500.0), np.linspace(-500.0, 500.0, 11))
    >>> machine = compgen.Machine("gantry", compgen.Chain("WFYXZT"), (axis, axis, axis))
    >>> machine
    <Machine: gantry, chain WFYXZT>
    >>> machine.lower_mm.tolist()
    [-500.0, -500.0, -500.0]
    """

    name: str = toml_files.setting(_name, meaning="name of the machine, in reports and as MACHINE of commands")
    chain: Chain = toml_files.setting(
        Chain,
        meaning="order of the bodies from workpiece W over foundation F to tool T: axes left of F carry the workpiece",
    )
    axes: tuple[Axis, Axis, Axis] = toml_files.part_setting(
        lambda: toml_files.table_schema(
            dict.fromkeys(AXES, {**toml_files.section_schema(Axis), **_ONE_NODES})
            | dict.fromkeys(ROTARY, toml_files.section_schema(RotaryAxis)),
            AXES,
        ),
        required=True,
    )
    squareness_reference: Reference = toml_files.setting(
        toml_files.choice("X", "Y"), "X", meaning="the axis that squareness is measured from; X as in ISO 230-1"
    )
    tool_offset_mm: Vector3 = toml_files.setting(
        _offset, (0.0, 0.0, 0.0), meaning="from the reference of the spindle to the tip of the tool, mm"
    )
    reference_point_mm: Vector3 = toml_files.setting(
        toml_files.vector3, (0.0, 0.0, 0.0), meaning="where the errors are zero, within the travel, mm"
    )
    errors: ErrorSelection = toml_files.setting(
        _error_selection,
        "observable",
        meaning="the errors that the model contains: those that lengths show, 17, 21, or a list of names",
    )
    curves: CurveBasis = toml_files.setting(
        toml_files.choice("linear", "cubic"), "linear", meaning="shape of the error curves between nodes"
    )
    controllers: Mapping[str, toml_files.Section] = toml_files.part_setting(
        factory=dict, meaning="settings for the export to each control"
    )
    source: Path | None = None
    emphasis: Emphasis = Emphasis()
    effects: Mapping[str, toml_files.Section] = toml_files.part_setting(
        factory=dict, meaning="known effects in addition to the geometric errors"
    )
    tool_range_mm: ToolRange | None = toml_files.part_setting(
        lambda: toml_files.table_schema(dict.fromkeys(AXES, toml_files.accepted(toml_files.interval))),
        None,
        meaning="tool offsets that the machine may carry, lower and upper end by axis, mm",
    )
    prior: PriorSettings = toml_files.part_setting(
        prior_schema, PriorSettings(), meaning="what is assumed of errors that were not measured"
    )
    copy: Path | None = field(default=None, compare=False, repr=False)
    reference_position_mm: PartialVector | None = toml_files.setting(
        _reference,
        None,
        meaning="where G28 leads: machine position of the axes at their reference points, mm (machine zero if not stated)",
    )
    machine_units: str | None = toml_files.setting(
        toml_files.choice(*MM_PER_UNIT),
        None,
        meaning="unit in which the control keeps its offsets and tables, mm (if not stated) or inch: LINEAR_UNITS of LinuxCNC",
    )
    repeatability: Repeatability = toml_files.table_setting(
        Repeatability, meaning="how well the machine repeats from one calibration to the next"
    )
    programs: ProgramNumbers = toml_files.table_setting(ProgramNumbers, meaning="how numbers of NC programs are read")
    travel_margin_mm: float = toml_files.setting(
        _margin,
        0.0,
        meaning="how far beyond the travel NC programs may go, mm: the software limits are as far from range_mm, or farther",
    )
    rotary: Mapping[str, RotaryAxis] = toml_files.part_setting(
        factory=dict, meaning="rotary axes of the chain by letter"
    )

    def __post_init__(self) -> None:
        text_of("name", self.name)
        of_kind("chain", self.chain, Chain)
        of_kind("axes", self.axes, tuple, list)
        if len(self.axes) != len(AXES):
            raise InputError(f"has {len(self.axes)} axes; expected those of X, Y and Z", field="axes")
        for letter, axis in zip(AXES, self.axes, strict=True):
            of_kind(f"axes[{letter}]", axis, Axis)
        of_kind("rotary", self.rotary, Mapping)
        if set(self.rotary) != set(self.chain.rotary):
            raise InputError(
                f"has the rotary axes {', '.join(self.rotary) or '-'}, the chain {self.chain.name} "
                f"{', '.join(self.chain.rotary) or '-'}; give each of them",
                field="rotary",
            )
        for name in ("tool_offset_mm", "reference_point_mm"):
            numbers(name, getattr(self, name), 3)
        for name, allowed in (("squareness_reference", ("X", "Y")), ("curves", ("linear", "cubic"))):
            if text_of(name, getattr(self, name)) not in allowed:
                raise InputError(f"is {getattr(self, name)!r}; expected {' or '.join(allowed)}", field=name)

    @property
    def file(self) -> Path | None:
        """Where the machine file can be read: ``source``, or a local copy if that is on another computer."""
        return self.copy or self.source

    @property
    def reference_place_mm(self) -> Vector3:
        """Where G28 leads along each axis, mm: as stated, or machine zero; nan where that is not within the travel."""
        stated = self.reference_position_mm or (None, None, None)
        zero = [0.0 if axis.range_mm[0] <= 0.0 <= axis.range_mm[1] else np.nan for axis in self.axes]
        x, y, z = (usual if place is None else place for place, usual in zip(stated, zero, strict=True))
        return x, y, z

    @property
    def units(self) -> str:
        """Unit in which the control keeps its work offsets: as the machine states, or its control for its tables; else mm.

        Raises
        ------
        InputError
            if sections of controls state both.
        """
        tables = {name: section.data.get("machine_units") for name, section in self.controllers.items()}
        stated = {unit: name for name, unit in tables.items() if unit in MM_PER_UNIT}
        if self.machine_units is None and len(stated) > 1:
            raise InputError(
                f"[controllers.{stated['mm']}] is in mm, [controllers.{stated['inch']}] in inch; state it for the machine",
                file=self.source,
                field="machine_units",
            )
        return self.machine_units or next(iter(stated), "mm")

    @property
    def tool_range(self) -> ToolRange:
        """Ranges of the tool offset in X, Y and Z, mm, from the machine file, or assumed about its tool offset."""
        if self.tool_range_mm is not None:
            return self.tool_range_mm
        x, y, z = ((own - reach, own + reach) for own, reach in zip(self.tool_offset_mm, ASSUMED_TOOL_MM, strict=True))
        return x, y, z

    @property
    def tool_range_text(self) -> str:
        """:attr:`tool_range` in words, and whether it was assumed."""
        parts = [f"{axis} {low:g} ... {high:g}" for axis, (low, high) in zip(AXES, self.tool_range, strict=True)]
        assumed = " (assumed; state tool_range_mm in the machine file)" if self.tool_range_mm is None else ""
        return f"tool offsets {', '.join(parts)} mm{assumed}"

    @property
    def tool_corners_mm(self) -> list[Vector3]:
        """Tool offsets at the corners of :attr:`tool_range`, each once."""
        return list(dict.fromkeys(product(*self.tool_range)))

    @property
    def lower_mm(self) -> FloatArray:
        """Lower travel ends, shape (3,)."""
        return np.array([axis.range_mm[0] for axis in self.axes])

    @property
    def upper_mm(self) -> FloatArray:
        """Upper travel ends, shape (3,)."""
        return np.array([axis.range_mm[1] for axis in self.axes])

    @property
    def doubts(self) -> list[str]:
        """Questions about numbers that are possible, but hardly meant."""
        short = [
            (letter, axis.length_mm) for letter, axis in zip(AXES, self.axes, strict=True) if axis.length_mm < FEW_MM
        ]
        far = {letter: self._from_letter_deg(letter) for letter in self.rotary}
        return [
            f"[axes.{letter}] range_mm: is the travel really {length:g} mm? The unit is mm, not m or inch ({length:g} in are "
            f"{25.4 * length:.5g} mm)"
            for letter, length in short
        ] + [
            f"[axes.{letter}] direction: is it really {angle:.0f} degrees from {AXES[ROTARY.index(letter)]}? ISO 841 names an "
            "axis by the direction that it turns about"
            for letter, angle in far.items()
            if angle > MOST_NUTATING_DEG
        ]

    def _from_letter_deg(self, letter: str) -> float:
        """Angle between a rotary axis and the direction of its letter."""
        cosine = self.rotary[letter].direction[ROTARY.index(letter)]
        return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def controller_settings(self, name: str) -> toml_files.Section:
        """Return a new section with the settings of one control (empty if the file has none)."""
        section = self.controllers.get(name)
        if section is None:
            return toml_files.Section({}, path=self.source, name=f"controllers.{name}", place=("controllers", name))
        return section.again()

    def with_setting(self, controller: str, key: str, value: Any) -> Machine:
        """Return the machine with one setting of one control replaced."""
        section = self.controller_settings(controller)
        section.data[key] = value
        return replace(self, controllers={**self.controllers, controller: section})

    def overview(self) -> Overview:
        """Chain, travel and nodes."""
        axes: dict[str, Axis | RotaryAxis] = {**dict(zip(AXES, self.axes, strict=True)), **self.rotary}
        rows = tuple((letter, axis.overview().title) for letter, axis in axes.items())
        return Overview(f"{self.name}, chain {self.chain.name}", ("axis", "travel"), rows)


def read_machine(path: str | Path) -> Machine:
    """Read a machine TOML strictly: unknown keys, wrong units and reversed ranges are errors that say what to do."""
    return machine_of(toml_files.read_toml(path), Path(path))


def parse_machine(text: str, source: Path) -> Machine:
    """Read the text of a machine TOML like :func:`read_machine`; ``source`` is the name in messages."""
    return replace(machine_of(toml_files.parse_toml(text, source), source), source=None)


def machine_of(root: toml_files.Section, source: Path) -> Machine:
    """Read the root of a machine TOML as :func:`read_machine` does."""
    stated = toml_files.stated_settings(Machine, root)
    axes_section = root.section("axes")
    axes = [_read_axis(axes_section.section(axis), stated.get("curves", Machine.curves)) for axis in AXES]
    rotary = _read_rotary(axes_section, stated["chain"])
    axes_section.finish()
    controllers_section = root.section("controllers", required=False)
    controllers = {key: controllers_section.section(key) for key in controllers_section.data}
    units = stated.get("machine_units")
    for section in controllers.values():
        if units is not None and section.data.get("machine_units", units) != units:
            raise section.fail("machine_units", f"the machine states {units!r}; leave it out here, or state the same")
    effects_section = root.section("effects", required=False)
    effects = {key: effects_section.section(key) for key in effects_section.data}
    for axis_name, axis, reference_mm in zip(
        AXES, axes, stated.get("reference_point_mm", Machine.reference_point_mm), strict=True
    ):
        low, high = axis.range_mm
        if not low <= reference_mm <= high:
            raise root.fail(
                "reference_point_mm",
                f"{axis_name} = {reference_mm:g} mm is outside the travel {low:g} ... {high:g} mm; the "
                f"position-dependent errors are zero there, so it must be within the travel; set reference_point_mm",
                instead=[axis.range_mm[0] for axis in axes],
            )
    tool_range_mm: ToolRange | None = None
    if "tool_range_mm" in root:  # an axis without an entry has the offset of the machine file
        section = root.section("tool_range_mm")
        x, y, z = (
            section.take(axis, toml_files.interval, (at, at))
            for axis, at in zip(AXES, stated.get("tool_offset_mm", Machine.tool_offset_mm), strict=True)
        )
        section.finish()
        tool_range_mm = x, y, z
    programs = stated.get("programs", ProgramNumbers())
    if programs.integers == "increments" and programs.increment_mm is None:
        message = "is missing; integers = 'increments' needs the least input increment of the control, e.g. 0.001"
        raise root.section("programs").fail("increment_mm", message, kind="missing", instead=[0.001])
    emphasis = take_emphasis(root, [axis.range_mm for axis in axes])
    prior = read_prior(root.section("prior", required=False))
    root.finish()
    return Machine(
        **stated,
        axes=(axes[0], axes[1], axes[2]),
        controllers=controllers,
        source=source,
        emphasis=emphasis,
        effects=effects,
        tool_range_mm=tool_range_mm,
        prior=prior,
        rotary=rotary,
    )


def _read_rotary(section: toml_files.Section, chain: Chain) -> dict[str, RotaryAxis]:
    """Read the rotary axes of the chain; one that the chain does not name is refused."""
    for letter in ROTARY:
        if letter in section and letter not in chain.rotary:
            raise section.fail(
                letter, f"the chain {chain.name} has no axis {letter}; put the letter into it, or omit [axes.{letter}]"
            )
    for letter in section.data:
        if letter not in (*AXES, *ROTARY):
            raise section.fail(letter, f"is no axis; known: {', '.join((*AXES, *ROTARY))}", kind="unknown")
    found = {}
    for letter in sorted(chain.rotary):
        if letter not in section:
            raise section.fail(
                letter,
                f"is missing; the chain {chain.name} has it: describe it with point_mm, range_deg or modulo_deg, and nodes",
                kind="missing",
                instead={"point_mm": [0.0, 0.0, 0.0], "range_deg": [-90.0, 90.0], "nodes": 7},
            )
        own = section.section(letter)
        x, y, z = (float(k == ROTARY.index(letter)) for k in range(3))
        direction = own.take("direction", _direction, (x, y, z))
        if ROTARY.index(letter) == int(np.argmin(direction)) and min(direction) < -OPPOSITE:
            message = f"points against {letter} of ISO 841; reverse it, and the sign of the angles"
            raise own.fail("direction", message, kind="value", instead=(x, y, z))
        if not {key for key in own.data if "point" in key or "pivot" in key or "mm" in key}:
            message = "is missing: a point of the axis line with all axes at zero, machine coordinates, e.g. [0.0, 0.0, -50.0]"
            raise own.fail("point_mm", message, kind="missing", instead=[0.0, 0.0, 0.0])
        stated = toml_files.stated_settings(RotaryAxis, own)
        low, high = stated.get("range_deg") or (0.0, stated.get("modulo_deg", 360.0))
        if isinstance(own.data.get("nodes"), list):
            nodes = np.array(own.take("nodes", toml_files.ascending))
        else:
            nodes = np.linspace(low, high, own.take("nodes", _NODES))
        own.finish()
        try:
            found[letter] = RotaryAxis(direction, nodes_deg=nodes, **stated)
        except InputError as error:
            raise own.fail("nodes" if error.field == "nodes_deg" else error.field or "nodes", error.message) from None
    return found


def _read_axis(section: toml_files.Section, curves: str) -> Axis:
    range_mm = section.take("range_mm", _travel)
    if "nodes_mm" in section or isinstance(section.data.get("nodes"), list):
        key = "nodes_mm" if "nodes_mm" in section else "nodes"
        nodes_mm = np.array(section.take(key, toml_files.ascending))
        if key == "nodes_mm" and "nodes" in section:
            raise section.fail("nodes", "nodes and nodes_mm are both given; keep one")
        if abs(nodes_mm[0] - range_mm[0]) > 1e-9 or abs(nodes_mm[-1] - range_mm[1]) > 1e-9:
            message = (
                f"ranges from {nodes_mm[0]:g} to {nodes_mm[-1]:g} mm; first and last node must be the ends of range_mm"
            )
            raise section.fail(key, message)
    else:
        nodes_mm = np.linspace(*range_mm, section.take("nodes", _NODES))
    if curves == "cubic" and len(nodes_mm) < 4:
        raise section.fail("nodes", f"{len(nodes_mm)} is too few for curves = 'cubic'; at least 4 are required")
    return toml_files.read_settings(Axis, section, range_mm=range_mm, nodes_mm=nodes_mm)


def machine_files(folders: tuple[Path, ...] = ()) -> dict[str, Path]:
    """Return the machine files by the name they declare: the shipped ones, and those in ``folders``.

    Machine files are ``*.toml`` and ``*/machine.toml`` that describe a chain or axes; other files (scenarios, jobs) may
    be in the same folder. A file that is not valid TOML, and names that several files declare, are skipped with a
    warning: one bad file must not block the other machines.
    """
    found = _declared(folders)
    for name, paths in found.items():
        if len(paths) > 1:
            warnings.warn(f"skipped: {_several(name, paths)}", CompgenWarning, stacklevel=2)
    return {name: paths[0] for name, paths in found.items() if len(paths) == 1}


def _several(name: str, paths: Sequence[Path]) -> str:
    return f"two machines have the name {name!r}: {' and '.join(map(str, paths))}; rename one"


def _declared(folders: tuple[Path, ...]) -> dict[str, list[Path]]:
    """Return the files that declare each name; an identical copy of a machine in another folder counts once."""
    found: dict[str, list[Path]] = {}
    here: dict[str, Path] = {}
    for folder in dict.fromkeys(path.resolve() for path in (data_folder("machines"), *folders)):
        for path in sorted([*folder.glob("*.toml"), *folder.glob("*/machine.toml")]):
            try:
                root = toml_files.read_toml(path)
                name = root.take("name", _name) if {"chain", "axes"} & set(root.data) else None
            except InputError as error:
                warnings.warn(f"machine file skipped: {error}", CompgenWarning, stacklevel=3)
                continue
            if name is None:
                continue
            others = found.setdefault(name, [])
            if here.get(name) == folder or all(other.read_bytes() != path.read_bytes() for other in others):
                others.append(path)
            here[name] = folder
    return found


def load_machine(machine: str | Path, folders: tuple[Path, ...] = ()) -> Machine:
    """Load a machine by the path of its TOML file, or by its name.

    Parameters
    ----------
    machine : a path (ends in ``.toml`` or has a folder in it), or a name in the shipped ``machines/``, in a folder
        ``machines/`` below the working directory, or in ``folders``.
    folders : additional folders to search.

    Raises
    ------
    InputError
        with file, line and key for anything that is missing, unknown or impossible.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> machine.axes
    (<Axis: -800 to 0 mm, 11 nodes>, <Axis: -1000 to 0 mm, 11 nodes>, <Axis: -350 to 0 mm, 11 nodes>)
    """
    path = path_of("machine", machine)
    if path.suffix == ".toml" or len(path.parts) > 1:
        return read_machine(path)
    local = Path("machines")
    known = _declared((*((local,) if local.is_dir() else ()), *folders))
    paths = known.get(str(machine), [])
    if not paths:
        raise InputError(
            f"there is no machine {str(machine)!r}; {nearest(str(machine), known)}, or give the path of a TOML file"
        )
    if len(paths) > 1:
        raise InputError(f"{_several(str(machine), paths)}, or give the path of one", file=paths[-1], field="name")
    return read_machine(paths[0])
