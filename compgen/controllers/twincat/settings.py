"""Settings ``[controllers.twincat-lists]`` of a machine file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from compgen.controllers.grids import take_loss_mm
from compgen.controllers.twincat.tables import Most
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError

#: Points that builds without the parameters P-COMP-00059 ... 61 take.
USUAL = Most(ssfk=1500, crosscomp=1001, crosscomp2=10201)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,31}")
_PLANES = {"XY": (0, 1), "YX": (1, 0), "XZ": (0, 2), "ZX": (2, 0), "YZ": (1, 2), "ZY": (2, 1), "none": None}


@dataclass(frozen=True)
class TwincatSettings:
    """What the export needs to know.

    Parameters
    ----------
    cross_sign : ``"correction"`` (``crosscomp`` and ``crosscomp2`` are added to the slave's command) or ``"error"``.
    ssfk_sign : ``"error"`` (actual minus nominal, which the control takes off) or ``"correction"``.
    real64 : numbers as REAL64 (newer builds), else whole numbers of 0.1 um.
    crosscomp2 : whether plane tables are written.
    planes : masters (first, second) of the plane of each slave, None: no plane, ``"auto"``: chosen.
    own_setpoints : whether every ``ssfk`` point has its own position (interval 0).
    logical_axes, axis_names : of X, Y, Z on the control.
    n_cycles : cycles over which a switched cross or plane correction is smoothed.
    most : points that the control takes.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    increment_mm : encoder increments of X, Y, Z, in which lists with ``unit 0`` hold their values; None: not stated.
    """

    cross_sign: str
    ssfk_sign: str
    real64: bool
    crosscomp2: bool
    planes: tuple[tuple[int, int] | str | None, ...]
    own_setpoints: bool
    logical_axes: tuple[int, int, int]
    axis_names: tuple[str, str, str]
    n_cycles: int
    most: Most
    loss_mm: float
    increment_mm: tuple[float | None, float | None, float | None]

    @property
    def digits(self) -> int:
        """Decimals of numbers in 0.1 um."""
        return 4 if self.real64 else 0

    @property
    def screw_factor(self) -> float:
        """What the control adds per stored ``ssfk`` value: -1 or +1."""
        return -1.0 if self.ssfk_sign == "error" else 1.0

    @property
    def cross_factor(self) -> float:
        """What the control adds per stored cross or plane value: +1 or -1."""
        return 1.0 if self.cross_sign == "correction" else -1.0


def read_twincat_settings(machine: Machine, name: str) -> TwincatSettings:
    """Check the settings; unknown keys and values are an InputError."""
    section = machine.controller_settings(name)
    numbers = _per_axis(section, "logical_axes", tomlio.whole(1, 65535), (1, 2, 3))
    names = _per_axis(section, "axis_names", _axis_name, AXES)
    planes = _per_axis(section, "planes", _plane, ("auto",) * 3)
    points = section.section("max_points", required=False)
    most = Most(
        points.take("ssfk", tomlio.whole(2, 100_000), USUAL.ssfk),
        points.take("crosscomp", tomlio.whole(2, 100_000), USUAL.crosscomp),
        points.take("crosscomp2", tomlio.whole(4, 100_000), USUAL.crosscomp2),
    )
    points.finish()
    settings = TwincatSettings(
        cross_sign=section.take("cross_sign", tomlio.choice("correction", "error"), "correction"),
        ssfk_sign=section.take("ssfk_sign", tomlio.choice("error", "correction"), "error"),
        real64=section.take("number_type", tomlio.choice("SGN32", "REAL64"), "SGN32") == "REAL64",
        crosscomp2=section.take("crosscomp2", tomlio.flag, True),
        planes=planes,
        own_setpoints=section.take("own_setpoints", tomlio.flag, False),
        logical_axes=(numbers[0], numbers[1], numbers[2]),
        axis_names=(names[0], names[1], names[2]),
        n_cycles=section.take("n_cycles", tomlio.whole(0, 1000), 10),
        most=most,
        loss_mm=take_loss_mm(section),
        increment_mm=_increments(section),
    )
    section.finish()
    return settings


def _per_axis(section: tomlio.Section, key: str, check: Any, defaults: Any) -> tuple[Any, ...]:
    part = section.section(key, required=False)
    found = tuple(part.take(letter, check, default) for letter, default in zip(AXES, defaults, strict=True))
    part.finish()
    if key != "planes" and len(set(found)) != 3:
        raise _doubled(section, key, found)
    return found


def _increments(section: tomlio.Section) -> tuple[float | None, float | None, float | None]:
    """``increment_um = { X = ..., ... }`` in mm."""
    part = section.section("increment_um", required=False)
    found = [part.take(letter, tomlio.positive, None) for letter in AXES]
    part.finish()
    x, y, z = (None if value is None else value * MM_PER_UM for value in found)
    return x, y, z


def _doubled(section: tomlio.Section, key: str, found: tuple[Any, ...]) -> InputError:
    return section.fail(key, f"gives {', '.join(map(str, found))} for X, Y, Z; three different ones are needed")


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise ValueError("an axis name of letters, digits, '_' and '-' is expected")
    return value


def _plane(value: Any) -> tuple[int, int] | None:
    if not isinstance(value, str) or value not in _PLANES:
        raise ValueError(f"two different letters, first and second master, are expected: {', '.join(_PLANES)}")
    return _PLANES[value]
