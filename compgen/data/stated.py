"""Numbers that somebody read from a granite square, a dial gauge or a certificate: squareness, backlash, scale of an axis."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES
from compgen.data.toml_files import option
from compgen.errors import InputError

#: Radians in each unit of an angle or a ratio; the first is meant where none is given.
ANGLES = {"urad": RAD_PER_URAD, "um/m": RAD_PER_URAD, "µrad": RAD_PER_URAD, "µm/m": RAD_PER_URAD, "mrad": 1e-3, "mm/m": 1e-3,
          "arcsec": np.pi / 648000.0, '"': np.pi / 648000.0, "ppm": 1e-6}  # fmt: skip
#: mm in each unit of a length; the first is meant where none is given.
LENGTHS = {"um": MM_PER_UM, "µm": MM_PER_UM, "mm": 1.0}
#: No machine tool has more; a larger number has another unit.
LARGEST_MM, LARGEST_RAD = 2.0, 0.1
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_STATED = re.compile(
    rf"({_NUMBER})(?:\s*/\s*({_NUMBER}))?(?:\s*(?:±|\+-|\+/-)\s*({_NUMBER}))?\s*([a-zA-Zµ\"]+(?:/[a-z]+)?)?"
)
#: What each squareness error is, and what a positive one looks like.
SQUARENESS = {
    "EC0Y": ("Y to X", "the angle between +X and +Y is larger than 90 degrees"),
    "EB0Z": ("Z to X", "the angle between +X and +Z is smaller than 90 degrees"),
    "EA0Z": ("Z to Y", "the angle between +Y and +Z is larger than 90 degrees"),
}
_ABOUT = {
    key: name for name, keys in (("EC0Y", "C XY YX"), ("EB0Z", "B XZ ZX"), ("EA0Z", "A YZ ZY")) for key in keys.split()
}


@dataclass(frozen=True)
class StatedNumbers:
    """Squareness, backlash and scale as given: ``VALUE[±U][UNIT]`` by name; U is the standard uncertainty.

    Signs are those of the errors: of the tool relative to the workpiece, actual minus commanded.

    Examples
    --------
    >>> import compgen
    >>> stated = StatedNumbers(squareness={"EC0Y": "25±3"}, scale={"Y": "-12um/m"})
    >>> errors = stated.errors(compgen.load_machine("zha-gantry"))
    >>> errors
    <ErrorTable: 2 errors: EYY, EC0Y>
    """

    squareness: Mapping[str, str] = option(
        None,
        "Squareness error, urad unless another unit follows (um/m, mm/m, arcsec, or a ratio such as 0.02/300), with its "
        "standard uncertainty: EC0Y=25±3. Positive: EC0Y and EA0Z, angle above 90 degrees between +X and +Y, +Y and +Z; "
        "EB0Z, angle below 90 degrees between +X and +Z. May be given several times.",
        metavar="NAME=VALUE[±U][UNIT]",
        factory=dict,
    )
    backlash: Mapping[str, str] = option(
        None,
        "Lost motion of an axis at reversal, um: X=6, X=6±1, X=0.006mm. Positive where the axis stays behind.",
        metavar="AXIS=VALUE[±U][UNIT]",
        factory=dict,
    )
    scale: Mapping[str, str] = option(
        None,
        "Scale error of an axis, um/m: Y=-12±2. Positive where the axis travels too far.",
        metavar="AXIS=VALUE[±U][UNIT]",
        factory=dict,
    )

    def errors(self, machine: Machine) -> ErrorTable | None:
        """Return squareness and scale as errors of a machine, mm and rad; an uncertainty that is not given is nan.

        None without either.

        Raises
        ------
        InputError
            for names, numbers and units that are not understood.
        """
        if not (self.squareness or self.scale):
            return None
        squareness = {}
        for name, text in self.squareness.items():
            if name not in SQUARENESS_NAMES:
                axes = re.search(r"([XYZ])\W?([XYZ])$", name.upper())
                key = "".join(axes.groups()) if axes else name.upper().removeprefix("E")[:1]
                meant = [_ABOUT[key]] if key in _ABOUT else list(SQUARENESS)
                shown = [
                    f"{item}, squareness of {SQUARENESS[item][0]}, positive where {SQUARENESS[item][1]}"
                    for item in meant
                ]
                what = f"{name!r} is not a squareness error; {'this may be' if key in _ABOUT else 'these are'} {'; '.join(shown)}"
                raise InputError(what, field="--squareness")
            squareness[name] = _value(text, ANGLES, "--squareness", name)
        curves = {}
        for letter, text in self.scale.items():
            axis = _axis(letter, "--scale")
            value, u = _value(text, ANGLES, "--scale", letter)
            reference = machine.reference_point_mm[axis]
            at = np.unique([*machine.axes[axis].range_mm, reference])
            curves[f"E{letter}{letter}"] = Curve(at, value * (at - reference), np.abs(u * (at - reference)))
        return ErrorTable(curves, squareness, {"machine": machine.name, "source": "numbers of the command line"})

    def reversal(self) -> ReversalCurves | None:
        """Return the backlash as reversals (positive minus negative approach), mm; None without any.

        Raises
        ------
        InputError
            for axes, numbers and units that are not understood.
        """
        curves = {}
        for letter, text in self.backlash.items():
            axis = _axis(letter, "--backlash")
            value, u = _value(text, LENGTHS, "--backlash", letter)
            curves[axis, axis] = Curve(np.zeros(1), np.array([-value]), np.array([u]))
        return ReversalCurves(curves) if curves else None


def _axis(letter: str, option_name: str) -> int:
    if letter not in AXES:
        raise InputError(f"{letter!r} is not an axis; expected X, Y or Z", field=option_name)
    return AXES.index(letter)


def _value(text: str, units: Mapping[str, float], option_name: str, name: str) -> tuple[float, float]:
    """Value and standard uncertainty (nan where none is given) of a text, in mm or rad."""
    found = _STATED.fullmatch(text.strip())
    unit = found[4] if found else None
    if found is None or (unit is not None and unit not in units) or (found[2] and (units is LENGTHS or unit)):
        ratio = ", or a ratio such as 0.02/300" if units is ANGLES else ""
        raise InputError(
            f"{text!r} for {name} is not understood; give a number, ±U if it is known, and a unit "
            f"({', '.join(key for key in units if key.isascii())}; {next(iter(units))} without{ratio}), for example 25±3",
            field=option_name,
        )
    by = 1.0 / float(found[2]) if found[2] else units[unit or next(iter(units))]
    value, u = float(found[1]) * by, abs(float(found[3]) * by) if found[3] else np.nan
    if abs(value) > (LARGEST_MM if units is LENGTHS else LARGEST_RAD):
        raise InputError(
            f"{text!r} for {name} is too large to be an error of a machine; check the unit", field=option_name
        )
    return value, float(u)
