"""What is said to the user of a COMP_FILE: sign, INI lines, and reversal steps that the control may not apply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from compgen.controllers.linuxcnc.comp_table import AT_ONCE, RAMPED, CompTable, standstill_outcome
from compgen.core.names import AXES, MM_PER_UM

_SECONDS_PER_US = 1e-6
#: A step below this is none.
_NO_STEP_MM = 1e-9


def sign_statement(file_type: int, unit: str, tables: Mapping[int, CompTable]) -> str:
    """Return the sign in words with a number from the file."""
    axis, table = max(tables.items(), key=lambda item: float(np.max(np.abs(item[1].forward))))
    row = int(np.argmax(np.abs(table.forward)))
    position, trim = float(table.nominal[row]), float(table.forward[row])
    places = 6 if unit == "mm" else 8
    written = f"the trim {trim:+.{places}f}" if file_type == 1 else f"the actual position {position - trim:.{places}f}"
    return (
        f"COMP_FILE_TYPE {file_type}: the trim is ADDED to the motor command. The file of {AXES[axis]} has {written} at "
        f"{position:.9g} {unit} (forward), so the motor is sent to {position + trim:.{places}f} {unit} there."
    )


def parameters(
    file_type: int, unit: str, servo_period_us: float, tables: Mapping[int, CompTable], files: Sequence[str]
) -> list[dict[str, str]]:
    """Return the INI lines of each joint, and the accelerations at which a reversal step may be lost, in machine units."""
    rows = [
        {
            "name": "[TRAJ] LINEAR_UNITS",
            "value": unit,
            "meaning": "unit of all numbers in the files; LinuxCNC takes them in its own unit, whatever they were meant in",
        }
    ]
    for axis, table in sorted(tables.items()):
        section = f"[JOINT_{axis}]"
        rows.append({"name": f"{section} COMP_FILE", "value": files[axis], "meaning": f"the file of {AXES[axis]}"})
        rows.append({"name": f"{section} COMP_FILE_TYPE", "value": str(file_type), "meaning": _type_meaning(file_type)})
        rows.append(
            {
                "name": f"{section} BACKLASH",
                "value": "0",
                "meaning": "not used beside a COMP_FILE; a value from before belongs into the file",
            }
        )
        steps = table.step_mm[table.step_mm > _NO_STEP_MM]
        if len(steps):
            low, high = (
                value / table.mm_per_unit
                for value in _lost_between(float(steps.min()), float(steps.max()), servo_period_us)
            )
            rows.append(
                {
                    "name": f"{section} MAX_ACCELERATION",
                    "value": f"not {low:.0f} ... {high:.0f} {unit}/s2",
                    "meaning": f"with SERVO_PERIOD {servo_period_us:g} us; within, the reversal step of {AXES[axis]} may "
                    "not be applied from standstill",
                }
            )
    return rows


def _type_meaning(file_type: int) -> str:
    if file_type == 1:
        return "nominal, forward trim, reverse trim"
    return "nominal, actual forward, actual reverse"


def _lost_between(least_mm: float, largest_mm: float, servo_period_us: float) -> tuple[float, float]:
    """Accelerations between which some of the steps lie in the dead zone, mm/s^2."""
    square = (servo_period_us * _SECONDS_PER_US) ** 2
    return least_mm / (RAMPED * square), largest_mm / (AT_ONCE * square)


def dead_zone_warnings(
    servo_period_us: float, accelerations_mm_s2: Sequence[float] | None, tables: Mapping[int, CompTable]
) -> list[str]:
    """Return a warning for each joint whose reversal steps the control may not apply at the stated acceleration."""
    if accelerations_mm_s2 is None:
        return []
    found = []
    period_s = servo_period_us * _SECONDS_PER_US
    for axis, table in sorted(tables.items()):
        acceleration = accelerations_mm_s2[axis]
        lost = [step for step in table.step_mm.tolist() if standstill_outcome(step, acceleration, period_s) == "never"]
        if lost:
            unit_um = acceleration * period_s**2 / MM_PER_UM
            found.append(
                f"the reversal step of {AXES[axis]} ({max(lost) / MM_PER_UM:.3f} um) lies between {AT_ONCE * unit_um:.3f} "
                f"and {RAMPED * unit_um:.3f} um: LinuxCNC does not apply such a step from standstill at MAX_ACCELERATION "
                f"{acceleration:g} mm/s2 and SERVO_PERIOD {servo_period_us:g} us. Up to {RAMPED * unit_um:.3f} um may stay; "
                "change the acceleration or the period"
            )
    return found
