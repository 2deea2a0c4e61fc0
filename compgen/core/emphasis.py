"""Where tables have to be best that cannot be good everywhere: a work zone, and tools of several lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.errors import InputError

Interval = tuple[float, float]
Vector3 = tuple[float, float, float]

#: How much more a coordinate within the work zone counts than one outside, if nothing is said.
ZONE_WEIGHT = 10.0
#: The zone all but alone; the rest of the travel still settles what the zone leaves open.
MOST_ZONE_WEIGHT = 1e3


@dataclass(frozen=True)
class Emphasis:
    """What the least squares of the tables weighs.

    Parameters
    ----------
    zone_mm : ranges of X, Y and Z within the travel (None: the whole travel); where all are None there is no zone.
    zone_weight : how much more a coordinate within the zone counts; the factors of the axes multiply.
    tools_mm : tool offsets over which the residual is averaged; none: the machine's own.
    """

    zone_mm: tuple[Interval | None, Interval | None, Interval | None] = (None, None, None)
    zone_weight: float = ZONE_WEIGHT
    tools_mm: tuple[Vector3, ...] = ()

    @property
    def has_zone(self) -> bool:
        """Whether a part of the travel counts more than the rest."""
        return any(part is not None for part in self.zone_mm) and self.zone_weight != 1.0

    def ends_mm(self, axis: int) -> list[float]:
        """Return the ends of the zone along an axis, none where it takes the whole travel."""
        part = self.zone_mm[axis]
        return [] if part is None or not self.has_zone else list(part)

    def factor(self, axis: int, along_mm: FloatArray) -> FloatArray:
        """Return the factor of one axis in the weight of positions along it, same shape.

        The weight is a product over the axes, so that what depends on one of them stays orthogonal to what depends on
        another: a table over X must not take up, as a step at the end of the zone, what Y does on the average there.
        """
        ends = self.ends_mm(axis)
        if not ends:
            return np.ones_like(along_mm)
        return np.where((along_mm > ends[0]) & (along_mm < ends[1]), self.zone_weight, 1.0)

    def summary(self) -> dict[str, Any]:
        """Return what stands in ``manifest.json``."""
        zone = {letter: list(part) for letter, part in zip(AXES, self.zone_mm, strict=True) if part is not None}
        return {
            "work_zone_mm": zone if self.has_zone else None,
            "zone_weight": self.zone_weight if self.has_zone else None,
            "tools_mm": [list(tool) for tool in self.tools_mm],
        }

    @property
    def notes(self) -> list[str]:
        """What the user of the tables should know."""
        notes = []
        if self.has_zone:
            parts = [
                f"{letter} {part[0]:g} ... {part[1]:g} mm"
                for letter, part in zip(AXES, self.zone_mm, strict=True)
                if part
            ]
            zone = ", ".join(parts)
            notes.append(
                f"The tables are made for the work zone {zone}; a coordinate in it counts {self.zone_weight:g} times."
            )
        if self.tools_mm:
            tools = "; ".join(", ".join(f"{value:g}" for value in tool) for tool in self.tools_mm)
            notes.append(f"The tables are made for the tool offsets (x, y, z in mm) {tools}, which count alike.")
        return notes


def take_emphasis(root: tomlio.Section, travel_mm: Sequence[Interval]) -> Emphasis:
    """Take ``work_zone_mm``, ``zone_weight`` and ``tools_mm`` from a machine file."""
    zone = root.section("work_zone_mm", required=False)
    parts = [zone.take(letter, tomlio.interval, None) for letter in AXES]
    zone.finish()
    for letter, part, (low, high) in zip(AXES, parts, travel_mm, strict=True):
        if part is not None and (part[0] < low or part[1] > high):
            raise zone.fail(letter, _outside(letter, part, (low, high)))
    return Emphasis(
        zone_mm=(parts[0], parts[1], parts[2]),
        zone_weight=root.take("zone_weight", zone_weight, ZONE_WEIGHT),
        tools_mm=root.take("tools_mm", _tools, ()),
    )


def zone_weight(value: Any) -> float:
    """A weight from 1 to 1000."""
    result = tomlio.number(value)
    if not 1.0 <= result <= MOST_ZONE_WEIGHT:
        raise ValueError(f"a number from 1 (no zone) to {MOST_ZONE_WEIGHT:g} (the zone all but alone) is expected")
    return result


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
                f"--zone: {part.strip()[:40]!r} is not a range; each axis once, lower end first, in mm is expected, "
                f"e.g. X=-400:0,Y=100:300"
            )
        found[letter] = (low, high)
        travel = travel_mm[AXES.index(letter)]
        if low < travel[0] or high > travel[1]:
            raise InputError(f"--zone: {_outside(letter, (low, high), travel)}")
    return found.get("X"), found.get("Y"), found.get("Z")


def _outside(letter: str, part: Interval, travel: Interval) -> str:
    return (
        f"the work zone {letter} = {part[0]:g} ... {part[1]:g} mm leaves the travel {travel[0]:g} ... {travel[1]:g} mm; "
        f"give the part of it within the travel"
    )


def _tools(value: Any) -> tuple[Vector3, ...]:
    if not isinstance(value, list) or not value:
        raise ValueError("a list of tool offsets [[x, y, z], ...] is expected")
    return tuple(tomlio.vector3(item) for item in value)
