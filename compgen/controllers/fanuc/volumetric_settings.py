"""Settings of ``[controllers.fanuc-3d]``: counts, the grid and its limits, the style of the user's own control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from itertools import permutations
from typing import Any, Literal

from compgen.controllers.fanuc.volumetric_style import VolumeStyle, read_volume_style
from compgen.controllers.grids import take_loss_mm
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Smallest step of positions and intervals in the files.
QUANTUM_MM = Decimal("0.0001")


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of three-dimensional error compensation.

    Parameters
    ----------
    detection_unit_um, magnification : one count of the table of X, Y, Z is their product.
    stores : whether the values are the correction (added to the command) or the error.
    interval_mm : distance of the vertices of X, Y, Z, None: chosen.
    loss_mm : loss by interpolation between vertices that is worth no further ones.
    most_points, most_in_all : largest number of vertices of an axis, and altogether.
    value_low, value_high : range of a value, counts.
    order : axes in the order of the point numbers, the one that runs fastest first.
    axis_numbers : controlled axis numbers of X, Y, Z.
    sample : style of a file punched from the user's control, None: none was given.
    """

    detection_unit_um: float
    magnification: tuple[int, int, int]
    stores: Literal["correction", "error"]
    interval_mm: tuple[float | None, float | None, float | None]
    loss_mm: float
    most_points: int
    most_in_all: int
    value_low: int
    value_high: int
    order: tuple[int, int, int]
    axis_numbers: tuple[int, int, int]
    sample: VolumeStyle | None

    @property
    def sign(self) -> int:
        """+1 if the values are the correction, -1 if they are the error."""
        return 1 if self.stores == "correction" else -1

    def count_mm(self, axis: int) -> float:
        """One count of the values of an axis, mm."""
        return self.magnification[axis] * self.detection_unit_um * MM_PER_UM


def read_volume_settings(machine: Machine) -> VolumeSettings:
    """Read and check ``[controllers.fanuc-3d]``; every key has a default."""
    section = machine.controller_settings("fanuc-3d")
    sample = section.file("style_from")
    stores = section.take("stores", tomlio.choice("correction", "error"), "correction")
    settings = VolumeSettings(
        detection_unit_um=section.take("detection_unit_um", tomlio.positive, 1.0),
        magnification=_per_axis(section.section("magnification", required=False), tomlio.whole(1, 100), (1, 1, 1)),
        stores="correction" if stores == "correction" else "error",
        interval_mm=_per_axis(section.section("interval_mm", required=False), _interval, (None, None, None)),
        loss_mm=take_loss_mm(section),
        most_points=section.take("most_points", tomlio.whole(2, 1000), 25),
        most_in_all=section.take("most_in_all", tomlio.whole(8, 50_000), 15625),
        value_low=section.take("value_low", tomlio.whole(-32768, -1), -128),
        value_high=section.take("value_high", tomlio.whole(1, 32767), 127),
        order=section.take("order", _order, (0, 1, 2)),
        axis_numbers=_per_axis(section.section("axis_numbers", required=False), tomlio.whole(1, 99), (1, 2, 3)),
        sample=None if sample is None else read_volume_style(sample),
    )
    if len(set(settings.axis_numbers)) < 3:
        raise section.fail("axis_numbers", f"{settings.axis_numbers} gives two axes the same number")
    section.finish()
    return settings


def _per_axis(section: tomlio.Section, check: Callable[[Any], Any], default: tuple[Any, Any, Any]) -> Any:
    values = tuple(section.take(axis, check, value) for axis, value in zip(AXES, default, strict=True))
    section.finish()
    return values


def _interval(value: Any) -> float:
    """A positive length that can be written."""
    length = tomlio.positive(value)
    if Decimal(repr(length)) % QUANTUM_MM:
        raise ValueError(f"a multiple of {QUANTUM_MM} mm is expected")
    return length


def _order(value: Any) -> tuple[int, int, int]:
    """One of the six orders of X, Y, Z."""
    word = tomlio.choice(*("".join(order) for order in permutations(AXES)))(value)
    x, y, z = (AXES.index(letter) for letter in word)
    return x, y, z
