"""The difference of two sets of tables: of their corrections at the tool, over the volume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.data.comparison import figures_of, rms
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.kinematics.many_points import volume_grid
from compgen.tables.judge import components, node_positions
from compgen.tables.verification import ReadTables

#: Smaller components, um rms, are not listed.
NAMED_FROM_UM = 0.001
#: Longer tuples are numbers of a table, whose difference is in the correction.
MOST_LISTED = 3


@dataclass(frozen=True)
class TableDifference:
    """Correction of A minus that of B at n points.

    Parameters
    ----------
    position_mm, first_mm, second_mm : points and the corrections of A and B there, shapes (n, 3).
    component_um : rms of every component of the difference over the volume, largest first, um.
    geometry : other differences, as (what, in A, in B) in words: nodes of the tables, settings.
    """

    controllers: tuple[str, str]
    position_mm: FloatArray
    first_mm: FloatArray
    second_mm: FloatArray
    component_um: Mapping[str, float]
    geometry: tuple[tuple[str, str, str], ...]

    @property
    def difference_mm(self) -> FloatArray:
        """Correction of A minus that of B, shape (n, 3)."""
        return self.first_mm - self.second_mm

    @property
    def size_mm(self) -> FloatArray:
        """Length of the difference, shape (n,)."""
        return np.asarray(np.linalg.norm(self.difference_mm, axis=1))

    @property
    def max_um(self) -> float:
        """Largest length of the difference."""
        return float(self.size_mm.max()) / MM_PER_UM

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``diff.json``."""
        worst = int(np.argmax(self.size_mm))
        axes = {f"d{axis.lower()}": figures_of(self.difference_mm[:, k]) for k, axis in enumerate(AXES)}
        return {
            "controllers": list(self.controllers),
            "points": len(self.position_mm),
            "same": self.max_um == 0.0 and not self.geometry,
            **figures_of(self.size_mm),
            "axes": axes,
            "largest_at_mm": self.position_mm[worst].tolist(),
            "largest_a_um": (self.first_mm[worst] / MM_PER_UM).tolist(),
            "largest_b_um": (self.second_mm[worst] / MM_PER_UM).tolist(),
            "components_rms_um": dict(self.component_um),
            "geometry": [{"what": what, "a": a, "b": b} for what, a, b in self.geometry],
        }


def difference(
    machine: Machine, first: ReadTables, second: ReadTables, points: Points | None = None
) -> TableDifference:
    """Compare two sets of tables by what their controls add to the commands.

    Parameters
    ----------
    machine : the machine; its settings say how each control reads its tables.
    first, second : the sets A and B, perhaps of different controls.
    points : where the figures are taken; default the nodes of both sets within the travel and the middles between
        them, all approached from the side (below or above) from which the sets differ more. The components are always
        taken there.
    """
    nodes = [_nodes(machine, tables) for tables in (first, second)]
    merged = [np.unique(np.concatenate([a, b]).round(6)) for a, b in zip(*nodes, strict=True)]
    grid = volume_grid(machine, (merged[0], merged[1], merged[2]))
    upward, downward = (
        Points(grid.position_mm, approach=side * np.ones_like(grid.position_mm)) for side in (1.0, -1.0)
    )
    miss = _miss(machine, first, second, upward)
    back = _miss(machine, first, second, downward)
    on_grid = upward if np.max(np.abs(miss)) >= np.max(np.abs(back)) else downward
    miss = miss if on_grid is upward else back
    named = {name: rms(part) / MM_PER_UM for name, part in components(grid, miss).items()}
    where = points or on_grid
    return TableDifference(
        controllers=(first.controller.name, second.controller.name),
        position_mm=where.position_mm,
        first_mm=first.correction(machine, where),
        second_mm=second.correction(machine, where),
        component_um=dict(sorted(((k, v) for k, v in named.items() if v >= NAMED_FROM_UM), key=lambda item: -item[1])),
        geometry=(*_geometry(machine, first, second), *_settings(first, second)),
    )


def _miss(machine: Machine, first: ReadTables, second: ReadTables, points: Points) -> FloatArray:
    return first.correction(machine, points) - second.correction(machine, points)


def _own_nodes(machine: Machine, tables: ReadTables) -> tuple[FloatArray, ...]:
    return tables.controller.table_nodes_mm(tables.tables)


def _nodes(machine: Machine, tables: ReadTables) -> list[FloatArray]:
    return [node_positions(machine, nodes, axis) for axis, nodes in enumerate(_own_nodes(machine, tables))]


def _geometry(machine: Machine, first: ReadTables, second: ReadTables) -> list[tuple[str, str, str]]:
    """Return the nodes that differ, axis by axis."""
    found = []
    for axis, pair in enumerate(zip(_own_nodes(machine, first), _own_nodes(machine, second), strict=True)):
        if len(pair[0]) != len(pair[1]) or np.max(np.abs(pair[0] - pair[1]), initial=0.0) > 1e-6:
            found.append((f"nodes over {AXES[axis]}", _spread(pair[0]), _spread(pair[1])))
    return found


def _spread(nodes_mm: FloatArray) -> str:
    if not len(nodes_mm):
        return "none"
    return f"{len(nodes_mm)} from {nodes_mm[0]:g} to {nodes_mm[-1]:g} mm"


def _settings(first: ReadTables, second: ReadTables) -> list[tuple[str, str, str]]:
    """Return the settings of the machine file, and other data of the files than their numbers, that differ."""
    if first.controller.name != second.controller.name:
        return [("control", first.controller.name, second.controller.name)]
    found = []
    for what, a, b in (
        ("setting", first.controller.settings, second.controller.settings),
        ("tables", first.tables, second.tables),
    ):
        one, two = _facts(a), _facts(b)
        for key in sorted({*one, *two}):
            if one.get(key) != two.get(key):
                found.append((f"{what} {key}", one.get(key, "absent"), two.get(key, "absent")))
    return found


def _facts(value: Any, name: str = "") -> dict[str, str]:
    """Flatten settings or tables to texts by name; arrays and the values of tables are excluded."""
    if is_dataclass(value) and not isinstance(value, type):
        compared = (item.name for item in fields(value) if item.compare)
        items: list[tuple[str, Any]] = [(key, getattr(value, key)) for key in compared]
    elif isinstance(value, Mapping):
        items = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, tuple | list) and any(is_dataclass(item) for item in value):
        items = [(str(k), item) for k, item in enumerate(value)]
    elif isinstance(value, bool | str | int | float | Decimal) or value is None:
        return {name: str(value)}
    elif isinstance(value, tuple) and len(value) <= MOST_LISTED:
        return {name: ", ".join(map(str, value))}
    else:
        return {}
    found: dict[str, str] = {}
    for key, item in items:
        found |= _facts(item, f"{name}.{key}" if name else key)
    return found
