"""Settings that both kinds of SINUMERIK tables have: names of the axes, and node distances."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Any

from compgen.controllers.siemens_syntax import POSITION_QUANTUM_MM
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES

_NAME = re.compile(r"[A-Z_][A-Z0-9_]{0,31}")


def take_axis_names(section: tomlio.Section) -> tuple[str, str, str]:
    """Take ``axis_names = { X = "AX1", ... }`` (default AX1, AX2, AX3) from a control's settings."""
    names_section = section.section("axis_names", required=False)
    names = [names_section.take(axis, _axis_name, f"AX{number}") for number, axis in enumerate(AXES, start=1)]
    names_section.finish()
    if len(set(names)) != 3:
        raise section.fail("axis_names", f"two axes have one name ({', '.join(names)}); each needs its own")
    return names[0], names[1], names[2]


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value.upper()) or not value.isascii():
        raise ValueError("an axis name of letters, digits and '_', e.g. 'AX1' or 'X1', is expected")
    return value.upper()


def take_steps(section: tomlio.Section, machine: Machine, most: int) -> tuple[float | None, ...]:
    """Take ``step_mm = { X = 50.0, ... }``: the table steps that the user asks for, None where he does not."""
    steps_section = section.section("step_mm", required=False)
    steps: list[float | None] = []
    for letter, axis in zip(AXES, machine.axes, strict=True):
        step = steps_section.take(letter, _step, None)
        if step is not None and axis.length_mm / step > most - 1:
            message = f"{step:g} mm gives more than the {most} nodes that max_points allows over {axis.length_mm:g} mm"
            raise steps_section.fail(letter, message)
        steps.append(step)
    steps_section.finish()
    return tuple(steps)


def _step(value: Any) -> float:
    step = tomlio.positive(value)
    if Decimal(repr(step)) % POSITION_QUANTUM_MM or step > 1e6:
        raise ValueError("a step in mm with at most 6 decimals is expected")
    return step
