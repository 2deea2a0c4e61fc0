"""What a later report needs beside the results of an identification: the machine file, and the residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray, format_csv
from compgen.core.error_table import ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.identify.measurement import Measurement
from compgen.identify.result import Identification


def evidence_files(
    machine: Machine, measurement: Measurement | ErrorTable, result: Identification
) -> dict[str, str | bytes]:
    """Return ``machine.toml``, the machine file byte by byte, and ``residuals.csv``."""
    files: dict[str, str | bytes] = {"residuals.csv": format_residuals(machine, measurement, result)}
    if machine.source is not None and machine.source.is_file():
        files["machine.toml"] = machine.source.read_bytes()
    return files


def format_residuals(machine: Machine, measurement: Measurement | ErrorTable, result: Identification) -> str:
    """Return the text of ``residuals.csv``: measurement minus model of every reading, um, in the order of the files.

    ``used`` is 0 for readings that were rejected; lengths have their station and commanded position beside them.
    """
    columns: dict[str, Sequence[str] | FloatArray] = {}
    if isinstance(measurement, Lengths) and len(measurement) == len(result.residual_mm):
        columns["station"] = [measurement.stations[k] for k in measurement.station.tolist()]
        columns |= {f"{axis}_mm": measurement.position_mm[:, k] for k, axis in enumerate("xyz")}
    columns["residual_um"] = -result.residual_mm / MM_PER_UM
    columns["used"] = result.accepted.astype(np.float64)
    digits = {"x_mm": 3, "y_mm": 3, "z_mm": 3, "residual_um": 4, "used": 0}
    return format_csv(columns, {"machine": machine.name, "method": result.method}, digits)
