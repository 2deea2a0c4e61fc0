"""Measurements that can be diagnosed, told apart by the columns of their files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compgen.core.axis_runs import AxisRuns, holds_axis_runs, read_axis_runs
from compgen.core.deviations import Deviations, holds_deviations, read_deviations
from compgen.core.lengths import Lengths, read_lengths
from compgen.core.parts import holds_parts
from compgen.errors import InputError
from compgen.sixdof.readings import holds_sixdof

Measurement = Lengths | Deviations | AxisRuns


def read_diagnosed(paths: Sequence[str | Path]) -> Measurement:
    """Read measurement files of one kind: tracer lengths, measured deviations or axis runs."""
    kinds = {path: _kind(path) for path in paths}
    if len(set(kinds.values())) > 1:
        odd = next(path for path, kind in kinds.items() if kind != kinds[paths[0]])
        message = f"holds {kinds[odd]}, and another file {kinds[paths[0]]}; diagnose them one after the other"
        raise InputError(message, file=odd)
    kind, files = kinds[paths[0]], list(paths)
    if kind == "axis runs":
        return read_axis_runs(files)
    return read_deviations(files) if kind == "deviations" else read_lengths(files)


def _kind(path: str | Path) -> str:
    if holds_sixdof(path):
        message = "holds six-DOF readings, which need the constants of their instrument; give --instrument FILE (TOML)"
        raise InputError(message, file=path)
    if holds_parts(path):
        message = (
            "holds features of a part, which identify and accuracy take; diagnose takes lengths, deviations, axis runs"
        )
        raise InputError(message, file=path)
    if holds_axis_runs(path):
        return "axis runs"
    return "deviations" if holds_deviations(path) else "lengths"
