"""Readers of every kind of file, with the records that they return, and the options of the chain: one import for scripts.

>>> from compgen import readers
>>> lengths = readers.read_lengths("examples/zha-gantry.lengths.csv")
>>> sorted(lengths.to_columns())[:4]
['approach_x', 'approach_y', 'approach_z', 'length_mm']

Every name is also that of ``compgen`` itself (``compgen.read_axis_runs``). A reader takes native files; :func:`open_measurement`
takes those of other programs, too, and any mixture. The module of a name is imported when it is used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.data.axis_runs import AxisRuns, Diagonals, read_axis_runs, read_diagonals
    from compgen.data.circles import Circles, read_circles
    from compgen.data.deviations import (
        Artefact,
        Deviations,
        read_artefacts,
        read_deviations,
        read_parts,
    )
    from compgen.data.error_table import ErrorTable, ReversalCurves, read_errors, read_reversal
    from compgen.data.lengths import Lengths, Points, read_lengths, read_points
    from compgen.data.rotary import SphereCentres, read_spheres
    from compgen.foreign.answers import ImportOptions
    from compgen.foreign.opening import open_errors, open_measurement
    from compgen.heat.sessions import DriftSession, Temperatures, read_drift, read_temperatures
    from compgen.identification.options import StatedNumbers, read_stations
    from compgen.instruments.sixdof_instrument import SixDof, SixDofInstrument, read_instrument, read_sixdof
    from compgen.tables.active import ActiveTables, read_active
    from compgen.tables.judge import SafetyLimits

__all__ = [
    "ActiveTables",
    "Artefact",
    "AxisRuns",
    "Circles",
    "Deviations",
    "Diagonals",
    "DriftSession",
    "ErrorTable",
    "ImportOptions",
    "Lengths",
    "Points",
    "ReversalCurves",
    "SafetyLimits",
    "SixDof",
    "SixDofInstrument",
    "SphereCentres",
    "StatedNumbers",
    "Temperatures",
    "open_errors",
    "open_measurement",
    "read_active",
    "read_artefacts",
    "read_axis_runs",
    "read_circles",
    "read_deviations",
    "read_diagonals",
    "read_drift",
    "read_errors",
    "read_instrument",
    "read_lengths",
    "read_parts",
    "read_points",
    "read_reversal",
    "read_sixdof",
    "read_spheres",
    "read_stations",
    "read_temperatures",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)


def read_artefact(path: str | Path) -> "Artefact":
    """Read one ``*.artefact.csv`` file, see ``read_artefacts``."""
    from compgen.data.deviations import read_artefacts

    return read_artefacts(path)


def read_part(path: str | Path) -> "Deviations":
    """Read one ``*.part.csv`` file as aligned deviations, see ``read_parts``."""
    from compgen.data.deviations import read_parts

    return read_parts(path)


__all__ += ["read_artefact", "read_part"]
