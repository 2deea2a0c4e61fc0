"""The files that hold the outcome of a verification: its figures, and the points behind them."""

from __future__ import annotations

import json

from compgen.core.csvio import FloatArray, format_csv
from compgen.core.names import MM_PER_UM
from compgen.verify.verify import Verification


def verification_files(result: Verification) -> dict[str, str]:
    """Return the texts of ``result.json`` and ``volume.csv``."""
    return {"result.json": json.dumps(result.summary(), indent=2) + "\n", "volume.csv": format_volume(result)}


def format_volume(result: Verification) -> str:
    """Return the text of ``volume.csv``: error of the tool tip before and after at every point of the figures, um.

    Where a reversal is known every point stands twice, reached in positive and in negative direction.
    """
    columns: dict[str, FloatArray] = {f"{axis}_mm": result.position_mm[:, k] for k, axis in enumerate("xyz")}
    digits = dict.fromkeys(columns, 6)
    for prefix, values in (("before", result.error_before_mm), ("after", result.error_after_mm)):
        columns |= {f"{prefix}_{axis}_um": values[:, k] / MM_PER_UM for k, axis in enumerate("xyz")}
    return format_csv(columns, {"controller": result.controller}, {**dict.fromkeys(columns, 4), **digits})
