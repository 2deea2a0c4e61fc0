"""Measurements that can be diagnosed, told apart by the columns of their files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compgen.core.deviations import Deviations, holds_deviations, read_deviations
from compgen.core.lengths import Lengths, read_lengths
from compgen.errors import InputError

Measurement = Lengths | Deviations


def read_diagnosed(paths: Sequence[str | Path]) -> Measurement:
    """Read measurement files of one kind: tracer lengths or measured deviations."""
    kinds = {path: holds_deviations(path) for path in paths}
    if len(set(kinds.values())) > 1:
        odd = next(path for path, kind in kinds.items() if kind)
        raise InputError("holds deviations, and another file lengths; diagnose them one after the other", file=odd)
    return read_deviations(list(paths)) if all(kinds.values()) else read_lengths(list(paths))
