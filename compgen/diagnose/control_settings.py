"""Numbers for a control's own parameters from a diagnosed effect: backlash with its sign, a table of a periodic error.

An axis whose tool moves by c dir (dir the direction of travel) has the reversal value B = 2 c of ISO 230-2. Where the tool stops
short, the usual case, B is below zero. What a parameter does with its sign is told by documents of each control, or is not known:
then only the size is given.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

#: A table of straight lines with this share of the period between its points leaves 1 - cos(pi share) of the amplitude.
SHARE = 0.1
#: Rows that LinuxCNC reads from a COMP_FILE: further ones are refused, as was tried.
LINUXCNC_ROWS = 256


def settings_of(item: Mapping[str, Any]) -> list[str]:
    """Return, for one effect of ``diagnosis.json``, what goes into which parameter of a control; nothing for other effects.

    >>> found = settings_of({"name": "backlash_X", "parameters": {"c_um": {"value": -4.0, "u": 0.1}}})
    >>> found[1]
    'SINUMERIK: MD32450 $MA_BACKLASH = +0.0080 mm'
    """
    match = re.fullmatch(r"(backlash|lost_motion|periodic)_([XYZ])", str(item.get("name")))
    if match is None:
        return []
    values = {key: (float(entry["value"]), entry["u"]) for key, entry in item["parameters"].items()}
    family, axis = match.groups()
    if family == "periodic":
        return _periodic(item, values)
    if family == "lost_motion":
        return _lost_motion(values, axis)
    return _backlash(*values["c_um"], axis) if "c_um" in values else []


def _backlash(c_um: float, u_um: float | None, axis: str) -> list[str]:
    """Return the parameter of each control; ``c_um`` is half of the reversal value."""
    reversal_um = 2.0 * c_um
    size_um, short = abs(reversal_um), reversal_um < 0.0
    u = "" if u_um is None else f" +- {2.0 * u_um:.1f}"
    lines = [
        f"{axis} stops short by {size_um:.1f}{u} um at each reversal; parameters (add it to a value that was active):"
        if short
        else f"{axis} goes too far by {size_um:.1f}{u} um at each reversal; parameters (add it to a value that was active):",
        f"SINUMERIK: MD32450 $MA_BACKLASH = {-reversal_um / 1000:+.4f} mm",
        f"FANUC: 1851 = {round(-reversal_um):+d} with a detection unit of 1 um; the same in 1852 if 1800#4 (RBK) is 1",
        f"LinuxCNC: BACKLASH = {-reversal_um / 1000:+.4f} mm of the joint; a joint with a COMP_FILE does not use it",
        f"HEIDENHAIN: MP_backLash (MP710, MP750) {size_um / 1000:.4f} mm in size; its sign is not documented: try it",
    ]
    if short:
        lines += [
            f"TwinCAT and ISG: P-AXIS-00103 (getriebe[i].lose) = {round(10 * size_um):+d} (0.1 um); P-AXIS-00021 switches it on",
            f"PMAC: Ixx86 = {size_um:.1f} um in counts, times 16",
            f"Smoothieware: backlash of the actuator {size_um / 1000:.4f} mm",
        ]
    else:
        lines.append(
            "TwinCAT, ISG, PMAC, Smoothieware: no document tells that they take this sign; use tables for each direction"
        )
    lines.append("Klipper: has no parameter for it; other controls: not known here")
    return lines


def _lost_motion(values: Mapping[str, tuple[float, float | None]], axis: str) -> list[str]:
    """Say how the reversal varies over the travel, of which one parameter holds the mean alone."""
    s = np.linspace(-1.0, 1.0, 201)
    c1, c2 = (values.get(key, (0.0, None))[0] for key in ("c1_um", "c2_um"))
    reversal_um = 2.0 * (c1 * s + c2 * (1.5 * s**2 - 0.5))
    return [
        f"the reversal of {axis} varies from {reversal_um.min():+.1f} to {reversal_um.max():+.1f} um about its mean: one "
        "parameter holds the mean alone; export tables for each direction where the control has them (SINUMERIK, FANUC, LinuxCNC)"
    ]


def _periodic(item: Mapping[str, Any], values: Mapping[str, tuple[float, float | None]]) -> list[str]:
    """Say how close the points of a table have to be, and over which travel a short table holds them."""
    pitch_mm = item.get("settings", {}).get("pitch_mm")
    first, second = (
        math.hypot(*(values.get(key, (0.0, None))[0] for key in keys))
        for keys in (("s1_um", "c1_um"), ("s2_um", "c2_um"))
    )
    left_um = first * (1.0 - np.cos(np.pi * SHARE)) + second * (1.0 - np.cos(2.0 * np.pi * SHARE))
    if pitch_mm is None:
        return []
    step_mm, all_um = SHARE * float(pitch_mm), first + second
    return [
        f"a table with points every {step_mm:.3g} mm, a tenth of the pitch, leaves at most {left_um:.2f} of {all_um:.2f} um; "
        "points as far apart as half of the pitch or more change nothing, or make it worse",
        f"LinuxCNC: {LINUXCNC_ROWS} rows of a COMP_FILE hold that over {LINUXCNC_ROWS * step_mm:.0f} mm of travel; SINUMERIK and "
        "FANUC: as many points as machine data and parameters reserve (`volcomp controllers NAME`)",
    ]
