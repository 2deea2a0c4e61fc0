"""The 21 geometric errors of three linear axes, named as in ISO 230-1 (``docs/conventions.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

AXES = ("X", "Y", "Z")
#: Body diagonals: directions of X, Y, Z from start to end.
BODY_DIAGONALS = {"PPP": (1, 1, 1), "NPP": (-1, 1, 1), "PNP": (1, -1, 1), "NNP": (-1, -1, 1)}
Kind = Literal["linear", "angular", "squareness"]

#: Magnitudes of input numbers other than zero, whatever their unit: their squares and quotients are finite, too.
SMALLEST, LARGEST = 1e-30, 1e15
MM_PER_UM = 1e-3
SECONDS_PER_MIN, SECONDS_PER_HOUR = 60.0, 3600.0
RAD_PER_URAD = 1e-6
#: Coverage factor of expanded uncertainties (about 95 %).
COVERAGE = 2.0


@dataclass(frozen=True)
class ErrorName:
    """One geometric error: its kind, the direction it acts in or about, and the axis whose motion has it.

    ``direction`` and ``axis`` count 0, 1, 2 for X, Y, Z (A, B, C for rotations).
    """

    name: str
    kind: Kind
    direction: int
    axis: int

    @property
    def unit(self) -> str:
        """Unit in files: ``um`` for translations, ``urad`` for rotations and squareness."""
        return "um" if self.kind == "linear" else "urad"

    @property
    def si_per_unit(self) -> float:
        """Factor from the unit of files to that of the program (mm or rad)."""
        return MM_PER_UM if self.kind == "linear" else RAD_PER_URAD

    @property
    def is_straightness(self) -> bool:
        """Whether it is a translation across the direction of the axis."""
        return self.kind == "linear" and self.direction != self.axis


_LETTERS: tuple[tuple[Kind, str], ...] = (("linear", "XYZ"), ("angular", "ABC"))
#: All 21, in the order of the columns of C: six of X, six of Y, six of Z, then EC0Y, EB0Z, EA0Z.
ERRORS: tuple[ErrorName, ...] = (
    *(
        ErrorName(f"E{letter}{AXES[axis]}", kind, direction, axis)
        for axis in range(3)
        for kind, letters in _LETTERS
        for direction, letter in enumerate(letters)
    ),
    ErrorName("EC0Y", "squareness", 2, 1),
    ErrorName("EB0Z", "squareness", 1, 2),
    ErrorName("EA0Z", "squareness", 0, 2),
)
ERROR_NAMES: tuple[str, ...] = tuple(error.name for error in ERRORS)
ERROR_INDEX: dict[str, int] = {name: k for k, name in enumerate(ERROR_NAMES)}
CURVE_NAMES: tuple[str, ...] = ERROR_NAMES[:18]
SQUARENESS_NAMES: tuple[str, ...] = ERROR_NAMES[18:]


def error_named(name: str) -> ErrorName:
    """Return the :class:`ErrorName` of ``name``, e.g. ``"EXX"`` or ``"EC0Y"``; KeyError if there is none."""
    return ERRORS[ERROR_INDEX[name]]


def describe_error(name: str) -> str:
    """Return an error in words, e.g. ``"Straightness of X in Y"``."""
    error = error_named(name)
    axis = AXES[error.axis]
    if error.kind == "linear":
        return (
            f"Straightness of {axis} in {AXES[error.direction]}" if error.is_straightness else f"Positioning of {axis}"
        )
    if error.kind == "squareness":
        return {"EC0Y": "Squareness of Y to X", "EB0Z": "Squareness of Z to X", "EA0Z": "Squareness of Z to Y"}[name]
    return f"Roll of {axis}" if error.direction == error.axis else f"Rotation of {axis} about {AXES[error.direction]}"
