"""One table in place of two: an old table that was active, and the errors that were measured with it.

The machine with its old table c_old still errs; the correction of what is left is c_new. Commanded to p it must go to

    c_total(p) = c_new(p) + c_old(p + c_new(p))

which is the correction of the bare machine, whose errors :func:`compgen.verify.active.bare_errors` gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.points import Points
from compgen.export import wanted_correction
from compgen.model.grid import volume_grid
from compgen.verify.active import ActiveTables, bare_errors
from compgen.verify.safety import node_positions
from compgen.verify.verify import ReadTables


@dataclass(frozen=True)
class MergeReport:
    """How close the merged table comes to old and new together, over the volume, um.

    ``total_max_um`` is the largest total correction, ``difference_max_um`` and ``difference_rms_um`` what the merged
    table misses of it, all that the control cannot hold included; ``lost_um`` is the largest part of the old table that
    no error of the model expresses.
    """

    total_max_um: float
    difference_max_um: float
    difference_rms_um: float
    lost_um: float

    def summary(self) -> dict[str, float]:
        """Return the contents of ``merge.json``."""
        return dict(vars(self))


def total_correction(machine: Machine, errors: ErrorTable, active: ActiveTables, position_mm: FloatArray) -> FloatArray:
    """Return c_total at commanded positions (n, 3): the old correction and that of the errors measured with it, mm."""
    new = wanted_correction(machine, errors, position_mm)
    moved = position_mm + new
    return np.asarray(new + active.correction(machine, Points(moved, approach=np.ones_like(moved))))


def merged_errors(machine: Machine, errors: ErrorTable, active: ActiveTables) -> tuple[ErrorTable, float]:
    """Return the errors of the bare machine at the nodes of old tables and new errors, and what is lost, um."""
    return bare_errors(machine, errors, active, keep_nodes=True)


def merge_report(
    machine: Machine, errors: ErrorTable, active: ActiveTables, merged: ReadTables, lost_um: float
) -> MergeReport:
    """Hold merged tables against the total correction at the nodes of old and merged tables and between them.

    Parameters
    ----------
    machine, errors : the errors that were measured with the old tables active.
    active : the old tables.
    merged : the new ones, as they were parsed.
    lost_um : as :func:`merged_errors` gives it.
    """
    nodes = []
    for axis in range(3):
        parts = [
            node_positions(machine, read.controller.table_nodes_mm(machine, read.settings, read.tables)[axis], axis)
            for read in (active.tables, merged)
        ]
        nodes.append(np.unique(np.concatenate(parts)))
    position_mm = volume_grid(machine, (nodes[0], nodes[1], nodes[2])).position_mm
    wanted = total_correction(machine, errors, active, position_mm)
    miss = merged.correction(machine, Points(position_mm, approach=np.ones_like(position_mm))) - wanted
    if merged.controller.anchored:
        miss = miss - miss.mean(axis=0)
    size = np.linalg.norm(miss, axis=1) / MM_PER_UM
    largest = float(np.max(np.linalg.norm(wanted, axis=1))) / MM_PER_UM
    return MergeReport(largest, float(size.max()), float(np.sqrt(np.mean(size**2))), lost_um)


__all__ = ["MergeReport", "merge_report", "merged_errors", "total_correction"]
