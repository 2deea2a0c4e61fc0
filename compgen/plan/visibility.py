"""What a planned measurement can never see of the catalogue of effects, and what to measure in addition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.points import Points
from compgen.effects import Card, Effect, Readings, catalogue
from compgen.effects.sign_error import SignError
from compgen.effects.squareness import Squareness
from compgen.effects.visibility import INVISIBLE, Pair, VisiblePart, alike_pairs, separating, visible_parts
from compgen.identify.parameters import ErrorParameters, error_parameters
from compgen.model.observability import modelled_errors
from compgen.model.volumetric import c_matrix
from compgen.plan.planned import Planned
from compgen.simulate.trajectory import approach_of

#: Time between two stops of a plan that says nothing about it, and its feed; only their being constant matters.
STOP_S = 10.0
FEED_MM_MIN = 1000.0
CHUNK = 2048
#: Warming of every channel over a plan without temperatures, K; only that they warm together matters.
WARMING_K = 1.0


@dataclass(frozen=True)
class PlanVisibility:
    """Visible fractions, what is hidden and why, effects that look alike.

    Parameters
    ----------
    parts : visible part of every effect whose columns the plan can tell.
    hidden : why an effect does not show at all, by its name.
    pairs : effects that cannot be told apart.
    cards : cards of the effects.
    assumed : what the plan does not say and was assumed, in words.
    """

    parts: dict[str, VisiblePart]
    hidden: dict[str, str]
    pairs: list[Pair]
    cards: dict[str, Card]
    assumed: list[str]

    @property
    def never(self) -> dict[str, str]:
        """Effects that the plan never sees, with the reason."""
        faint = {
            name: f"visible fraction {part.fraction:.3f}: the errors of the machine, stations and dead lengths imitate it"
            for name, part in self.parts.items()
            if part.fraction < INVISIBLE
        }
        return {**self.hidden, **faint}

    def summary(self) -> dict[str, Any]:
        """Return the object ``visibility`` of ``plan.json``."""
        return {
            "assumed": self.assumed,
            "fractions": {name: round(part.fraction, 4) for name, part in self.parts.items()},
            "never": [
                {"name": name, "reason": reason, "measure": self.cards[name].breaker}
                for name, reason in self.never.items()
            ],
            "alike": [
                {
                    "names": list(pair.names),
                    "correlation": round(pair.correlation, 4),
                    "shared_directions": pair.shared,
                    "directions": pair.directions,
                    "measure": separating(*(self.cards[name] for name in pair.names)),
                }
                for pair in self.pairs
            ],
        }


def plan_visibility(found: Planned, points: Points) -> PlanVisibility:
    """Project every effect of the catalogue off what errors, stations and dead lengths can do in this plan.

    The order of the points is that in which they are visited. What the points do not say is assumed: one feed, equal
    times, temperatures that rise together; it stands in the result.
    """
    readings, assumed = _readings(found, points)
    chosen, hidden, cards = {}, {}, {}
    for name, effect in catalogue(found.stations.names).items():
        if "lengths" not in effect.card.kinds or _belongs_to_the_model(effect, readings):
            continue
        cards[name] = effect.card
        columns = _columns(effect, readings)
        if columns is None:
            hidden[name] = _lacking(effect.card, readings)
        else:
            chosen[name] = columns
    gram, base, where = _gram(found, readings, chosen)
    parts = visible_parts(gram, base, where)
    seen = {name: part for name, part in parts.items() if part.fraction >= INVISIBLE}
    return PlanVisibility(parts, hidden, alike_pairs(gram, base, seen), cards, assumed)


def _belongs_to_the_model(effect: Effect, readings: Readings) -> bool:
    """Whether an effect cannot be missing: its error is modelled, or its sign means nothing on this chain."""
    if isinstance(effect, SignError | Squareness):
        return effect.displacement(readings) is None
    return effect.card.name.removeprefix("lever_") in modelled_errors(readings.machine)


def _columns(effect: Effect, readings: Readings) -> FloatArray | None:
    """Columns of an effect at the middle of its scan positions."""
    positions = list(effect.positions(readings))
    fixed = effect.at(positions[len(positions) // 2]) if positions else effect
    columns = fixed.columns(readings)
    return None if columns is None or not np.any(columns) else columns


def _lacking(card: Card, readings: Readings) -> str:
    if card.name.startswith("lever_"):
        return "one tool offset"
    if card.name == "tool_offset_error":
        return "one set-up"
    known = {*readings.covariates, *readings.labels, "station", "approach_x", "approach_y", "approach_z"}
    lacking = [name for name in card.covariates if name not in known]
    return f"the plan has no {', '.join(lacking)}" if lacking else "nothing of it varies in this plan"


def _readings(found: Planned, points: Points) -> tuple[Readings, list[str]]:
    """The planned readings with covariates, and what was assumed."""
    lengths, count = found.lengths, len(points)
    passes = found.stations.passes[:, 0]
    stop = np.tile(np.arange(count), len(passes))
    own_pass = np.repeat([np.count_nonzero(passes[:k] == station) for k, station in enumerate(passes)], count)
    covariates, assumed = _covariates(points)
    covariates = {name: values[stop] for name, values in covariates.items()}
    covariates["time_s"] = np.asarray(covariates["time_s"] + own_pass * count * STOP_S, dtype=np.float64)
    approach = points.approach
    if approach is None:
        approach = approach_of(np.diff(points.position_mm, axis=0, prepend=points.position_mm[:1]))
        assumed.append("points are visited in the order of the file")
    setup = lengths.labels["setup"] if "setup" not in points.covariates else points.covariates["setup"][stop]
    tool_mm = np.broadcast_to(found.tool_mm, lengths.position_mm.shape)
    line_mm = lengths.position_mm + tool_mm - found.stations.position_mm[lengths.station]
    range_mm = np.asarray(np.linalg.norm(line_mm, axis=1), dtype=np.float64)
    readings = Readings(
        machine=found.machine,
        kind="lengths",
        position_mm=lengths.position_mm,
        direction=line_mm / range_mm[:, None],
        tool_mm=tool_mm,
        stations=found.stations.names,
        station=lengths.station,
        range_mm=range_mm,
        approach=approach[stop],
        covariates=covariates,
        labels={"setup": setup.astype(np.int64)},
    )
    return readings, assumed


def _covariates(points: Points) -> tuple[dict[str, FloatArray], list[str]]:
    logged = {name: values for name, values in points.covariates.items() if name != "setup"}
    assumed: list[str] = []
    if "time_s" not in logged:
        logged["time_s"] = STOP_S * np.arange(len(points), dtype=np.float64)
        assumed.append("stops follow each other at equal times, and all stations read at once")
    if "feed_mm_min" not in logged:
        logged["feed_mm_min"] = np.full(len(points), FEED_MM_MIN)
        assumed.append("one feed")
    if not any(name.startswith("temp_") for name in logged):
        warming = np.asarray(WARMING_K * np.linspace(0.0, 1.0, len(points)))
        names = ("x", "y", "z", "spindle", "ambient", "column_front")
        logged |= {f"temp_{name}_c": 20.0 + warming for name in names}
        logged["temp_column_rear_c"] = np.full(len(points), 20.0)
        assumed.append("temperatures are logged and rise together during the measurement")
    if "load_kg" not in logged:
        assumed.append("one load")
    return logged, assumed


def _gram(
    found: Planned, readings: Readings, chosen: dict[str, FloatArray]
) -> tuple[FloatArray, int, dict[str, slice]]:
    """Gram matrix of the base Jacobian and the columns of the effects, readings in units of their uncertainty."""
    where, start = {}, 0
    for name, columns in chosen.items():
        where[name] = slice(start, start + columns.shape[1])
        start += columns.shape[1]
    names = modelled_errors(found.machine)  # those of one tool: what further tools show is an effect here
    layout = error_parameters(found.machine, names)
    keys = np.column_stack([readings.station, readings.labels["setup"], found.lengths.labels["setup"]])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    weight = 1.0 / found.noise.sigma_mm(readings.range_mm)
    size = layout.size + 3 * len(readings.stations) + int(group.max()) + 1
    gram = np.zeros((size + start, size + start))
    for first in range(0, len(readings), CHUNK):
        rows = slice(first, first + CHUNK)
        errors = _error_rows(layout, found, readings, rows)
        placing = _placing(readings, group.ravel().astype(np.int64), rows, size - layout.size)
        block = np.hstack([errors, placing, *(columns[rows] for columns in chosen.values())]) * weight[rows, None]
        gram += block.T @ block
    return gram, size, where


def _error_rows(layout: ErrorParameters, found: Planned, readings: Readings, rows: slice) -> FloatArray:
    position_mm = readings.position_mm[rows]
    bases = [layout.basis(axis, position_mm[:, axis]) for axis in range(3)]
    moved = layout.design(c_matrix(found.machine, position_mm, readings.tool_mm[rows]), bases)
    return np.asarray(np.einsum("nd,ndp->np", readings.direction[rows], moved))


def _placing(readings: Readings, group: NDArray[np.int64], rows: slice, size: int) -> FloatArray:
    """Derivative of the readings by stations and dead lengths."""
    station, each = readings.station[rows], np.arange(len(readings.station[rows]))
    columns = np.zeros((len(station), size))
    for axis in range(3):
        columns[each, 3 * station + axis] = -readings.direction[rows, axis]
    columns[each, 3 * len(readings.stations) + group[rows]] = -1.0
    return columns
