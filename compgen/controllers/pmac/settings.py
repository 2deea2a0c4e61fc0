"""Settings ``[controllers.pmac]`` of a machine file, and positions in counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.controllers.grids import take_loss_mm
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES

_COUNTS_MISSING = (
    "is missing: tables are in counts of the motors, and nothing but the machine says how many make a mm; write e.g. "
    "counts_per_mm = { X = 1000.0, Y = 1000.0, Z = 2000.0 } (negative where the motor counts against the axis)"
)


@dataclass(frozen=True)
class PmacSettings:
    """What the export needs to know.

    Parameters
    ----------
    counts_per_mm : counts of the motors of X, Y, Z per mm, negative where a motor counts against its axis.
    home_mm : machine coordinates of the motors' zero.
    motors : motors of X, Y, Z.
    motors_available : motors that can own a table (Turbo PMAC 32, PMAC 8).
    two_dimensional : whether angular errors go into two-dimensional tables.
    desired : whether tables go over the commanded position of their source.
    max_entries : largest number of entries of one table.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    """

    counts_per_mm: tuple[float, float, float]
    home_mm: tuple[float, float, float]
    motors: tuple[int, int, int]
    motors_available: int
    two_dimensional: bool
    desired: bool
    max_entries: int
    loss_mm: float

    def counts(self, position_mm: FloatArray) -> Mapping[int, FloatArray]:
        """Return the positions (n,) of the three motors in counts at axis positions (n, 3)."""
        return {
            motor: self.counts_per_mm[axis] * (position_mm[:, axis] - self.home_mm[axis])
            for axis, motor in enumerate(self.motors)
        }

    @property
    def free_motors(self) -> list[int]:
        """Motors without an axis that may own a table."""
        return [number for number in range(1, self.motors_available + 1) if number not in self.motors]


def read_pmac_settings(machine: Machine, name: str) -> PmacSettings:
    """Check the settings; ``counts_per_mm`` is mandatory."""
    section = machine.controller_settings(name)
    if "counts_per_mm" not in section:
        raise section.fail("counts_per_mm", _COUNTS_MISSING)
    available = section.take("motors_available", tomlio.whole(3, 32), 32)
    motors = _per_axis(section, "motors", tomlio.whole(1, available), (1, 2, 3))
    if len(set(motors)) != 3:
        raise section.fail("motors", f"gives {motors} for X, Y, Z; three different motors are needed")
    home = _per_axis(section, "home_mm", tomlio.number, (0.0, 0.0, 0.0))
    counts = section.take("counts_per_mm", _scales)
    settings = PmacSettings(
        counts_per_mm=counts,
        home_mm=(home[0], home[1], home[2]),
        motors=(motors[0], motors[1], motors[2]),
        motors_available=available,
        two_dimensional=section.take("two_dimensional", tomlio.flag, False),
        desired=section.take("source_position", tomlio.choice("desired", "actual"), "desired") == "desired",
        max_entries=section.take("max_entries", tomlio.whole(8, 100_000), 20_000),
        loss_mm=take_loss_mm(section),
    )
    section.finish()
    return settings


def _per_axis(section: tomlio.Section, key: str, check: Any, defaults: Any) -> tuple[Any, ...]:
    part = section.section(key, required=False)
    found = tuple(part.take(letter, check, default) for letter, default in zip(AXES, defaults, strict=True))
    part.finish()
    return found


def _scales(value: Any) -> tuple[float, float, float]:
    """Counts per mm: one number for all axes, or a table with X, Y and Z; none is zero."""
    if isinstance(value, dict):
        if set(value) != set(AXES):
            raise ValueError("one number, or a table { X = ..., Y = ..., Z = ... }, is expected")
        x, y, z = (tomlio.number(value[axis]) for axis in AXES)
    else:
        x = y = z = tomlio.number(value)
    if not np.all(np.array([x, y, z])):
        raise ValueError("counts per mm other than zero are expected")
    return x, y, z
