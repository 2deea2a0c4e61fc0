"""Options that say where tables have to be best: the work zone, and the tools."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import click

from compgen.cli.common import Command
from compgen.core.emphasis import MOST_ZONE_WEIGHT, ZONE_WEIGHT, Emphasis, Vector3, zone_of
from compgen.core.machine import Machine
from compgen.errors import InputError


def emphasis_options(command: Command) -> Command:
    """Add --zone, --zone-weight and --tools; they stand before what the machine file says. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        zone: str | None,
        zone_weight: float | None,
        tools: tuple[str, ...],
        **options: Any,
    ) -> Any:
        return command(*args, machine=emphasised(machine, zone, zone_weight, tools), **options)

    zone_option = click.option(
        "--zone",
        metavar="RANGES",
        help="Work zone (mm) that counts more, e.g. X=-400:0,Y=100:300; default: work_zone_mm of the machine file.",
    )
    weight_option = click.option(
        "--zone-weight",
        metavar="W",
        type=click.FloatRange(1.0, MOST_ZONE_WEIGHT),
        help=f"How much more a coordinate in it counts, default {ZONE_WEIGHT:g}; {MOST_ZONE_WEIGHT:g}: the zone all but alone.",
    )
    tools_option = click.option(
        "--tools",
        metavar="X,Y,Z",
        multiple=True,
        help="Tool offset (mm) that the tables have to suit; several times for several tools, which count alike.",
    )
    return zone_option(weight_option(tools_option(wrapper)))  # type: ignore[return-value]


def emphasised(machine: Machine, zone: str | None, zone_weight: float | None, tools: tuple[str, ...]) -> Machine:
    """Return the machine with the work zone and tools of the command line, where they are given."""
    own = machine.emphasis
    zone_mm = own.zone_mm if zone is None else zone_of(zone, [axis.range_mm for axis in machine.axes])
    if zone_weight is not None and not any(zone_mm):
        raise InputError("--zone-weight needs a work zone; add --zone, or work_zone_mm to the machine file")
    weight = own.zone_weight if zone_weight is None else zone_weight
    tools_mm = tuple(_tool(text) for text in tools) or own.tools_mm
    return replace(machine, emphasis=Emphasis(zone_mm, weight, tools_mm))


def _tool(text: str) -> Vector3:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = float("nan")
    if not all(abs(part) < 1e6 for part in (x, y, z)):
        raise InputError(f"--tools: {text[:40]!r} is no tool offset; three numbers in mm are expected, e.g. 0,0,-150")
    return x, y, z
