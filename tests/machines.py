"""Machines that tests build: ranges and node counts of X, Y and Z, and whatever else the test is about."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compgen.data.machine import Axis, Chain, Machine


def machine_of(
    ranges_mm: Sequence[tuple[float, float]],
    nodes: int | Sequence[int],
    chain: str = "WFYXZT",
    *,
    name: str = "m",
    expansion: float | None | Sequence[float | None] = None,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    **fields: Any,
) -> Machine:
    """A machine with evenly spaced nodes; ``settings`` by control, ``fields`` of :class:`compgen.Machine`."""
    counts = (nodes,) * 3 if isinstance(nodes, int) else nodes
    growth = tuple(expansion) if isinstance(expansion, Sequence) else (expansion,) * 3
    axes = tuple(Axis(r, np.linspace(*r, n), e) for r, n, e in zip(ranges_mm, counts, growth, strict=True))
    machine = Machine(name, Chain(chain), axes, **fields)
    for control, options in (settings or {}).items():
        for key, value in options.items():
            machine = machine.with_setting(control, key, value)
    return machine
