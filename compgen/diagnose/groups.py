"""Groups of columns that a diagnosis chooses among: effects of the catalogue and smooth terms without a name."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.effects import Effect, Readings, catalogue
from compgen.errors import CompgenWarning

Tier = Literal["named", "generic", "base"]


@dataclass(frozen=True)
class Group:
    """Columns (n, k) that enter together.

    Parameters
    ----------
    name : of the effect, or a description of the smooth term.
    tier : ``"named"``, ``"generic"``, or ``"base"`` for what belongs to the base model and is never reported.
    columns : change of every reading per unit, (n, k).
    effect : the effect of the catalogue, with its scan position fixed.
    scans : number of scan positions among which this is one.
    position : its scan position.
    covariates, direction : what a generic term depends on, and how it acts (``dX``, ``length``).
    slow : whether it depends on time or temperature.
    predicts : whether it says anything about readings that were left out.
    """

    name: str
    tier: Tier
    columns: FloatArray
    effect: Effect | None = None
    scans: int = 1
    position: float | None = None
    covariates: tuple[str, ...] = ()
    direction: str = ""
    slow: bool = False
    predicts: bool = True


def named_groups(readings: Readings, only: Sequence[str] = (), most_scans: int = 400) -> tuple[list[Group], list[str]]:
    """Return the groups of the catalogue, one for each scan position, and the names that lack a covariate."""
    groups: list[Group] = []
    missing: list[str] = []
    for name, effect in catalogue(readings.stations).items():
        if (only and name not in only) or readings.kind not in effect.card.kinds:
            continue
        found = _of_effect(name, effect, readings, most_scans)
        groups += found
        if not found:
            missing.append(name)
    return groups, missing


def _of_effect(name: str, effect: Effect, readings: Readings, most_scans: int) -> list[Group]:
    positions = list(effect.positions(readings))
    if len(positions) > most_scans:
        positions = [positions[k] for k in np.linspace(0, len(positions) - 1, most_scans).astype(int)]
    found = []
    choices: list[float | None] = [*positions] if positions else [None]
    for position in choices:
        fixed = effect if position is None else effect.at(position)
        columns = fixed.columns(readings)
        if columns is None or not np.isfinite(columns).all() or not np.any(columns):
            continue
        scans = max(len(positions), 1)
        found.append(Group(name, "named", columns, fixed, scans, position, fixed.card.covariates, slow=scans > 1))
    return found


def check_names(names: Sequence[str], stations: Sequence[str]) -> None:
    """Warn of names that are no effect of the catalogue."""
    unknown = [name for name in names if name not in catalogue(stations)]
    if unknown:
        warnings.warn(f"{', '.join(unknown)}: no such effect", CompgenWarning, stacklevel=3)
