"""Gross errors of convention, looked for first: swapped axes, wrong signs, the tool the wrong way, mixed-up stations.

They leave residuals of mm where errors of a machine leave um. All 48 signed permutations of the axes are tried again,
each with the tool as it stands, turned round, and mapped like the axes; then the labels of stations in single runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.diagnose.base import fit_base
from compgen.diagnose.basis import CurveBasis, base_errors
from compgen.diagnose.layout import IntArray
from compgen.diagnose.noise import difference_matrix
from compgen.diagnose.observed import ObservedLengths, some_lengths
from compgen.diagnose.station_start import located
from compgen.errors import CompgenError
from compgen.identify.robust_start import robust_state
from compgen.identify.state import State
from compgen.identify.task import dead_lengths_of
from compgen.model.volumetric import tool_of

#: Residuals beyond so many times what repeats scatter by call for a second look; without repeats this many mm.
SUSPICIOUS, SUSPICIOUS_MM = 20.0, 0.02
#: A mapping is taken if it makes the residual so many times smaller.
BETTER = 5.0
#: Readings that a mapping is tried on.
READINGS = 900
#: Residual of a reading, mm, that only a wrong label explains.
LABEL_MM = 0.5
#: Mappings that are compared with the errors of the machine inside.
MOST_CLOSE = 24


@dataclass(frozen=True)
class Correction:
    """Corrected lengths, and what was wrong in words."""

    lengths: Lengths
    text: str


def looks_gross(observed: ObservedLengths, rms_mm: float) -> bool:
    """Whether the residual of the base model is far beyond the scatter of repeats."""
    squares, count = 0.0, 0
    for block in observed.layout.blocks:
        values = difference_matrix(observed.layout, block) @ observed.value_mm[block.rows]
        squares += float(np.sum(values**2))
        count += values.size
    if count < 20:
        return rms_mm > SUSPICIOUS_MM
    return rms_mm > SUSPICIOUS * float(np.sqrt(squares / count)) or rms_mm > 1.0


def correction_of(machine: Machine, lengths: Lengths, rms_mm: float) -> Correction | None:
    """Return the mapping that makes the residuals small; None if there is none."""
    return _mapped(machine, lengths, rms_mm) or _relabelled(machine, lengths, rms_mm)


def _mappings(machine: Machine, lengths: Lengths) -> Iterator[tuple[str, Lengths]]:
    several = lengths.tool_mm is not None and bool(np.any(lengths.tool_mm))
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            moved = _fitted_to_travel(machine, lengths.position_mm @ turn.T)
            if moved is None:
                continue
            plain = bool(np.array_equal(turn, np.eye(3)))
            parts = [f"{AXES[k]} is {'-' if signs[k] < 0 else ''}{AXES[order[k]]} of the file" for k in range(3)]
            what = "" if plain else ", ".join(p for k, p in enumerate(parts) if order[k] != k or signs[k] < 0)
            if not plain:
                yield what, replace(lengths, position_mm=moved)
            if several and lengths.tool_mm is not None:
                yield (
                    _joined(what, "the tool offset has the other sign"),
                    replace(lengths, position_mm=moved, tool_mm=-lengths.tool_mm),
                )
                if not plain:
                    yield (
                        _joined(what, "the tool offset likewise"),
                        replace(lengths, position_mm=moved, tool_mm=lengths.tool_mm @ turn.T),
                    )


def _joined(first: str, second: str) -> str:
    return f"{first}; {second}" if first else second


def _fitted_to_travel(machine: Machine, position_mm: FloatArray) -> FloatArray | None:
    """Positions if they lie in the travel of the machine (to 5 %); those of a flipped axis are tried as they are."""
    low, high = machine.lower_mm, machine.upper_mm
    room = 0.05 * (high - low)
    inside = (position_mm >= low - room) & (position_mm <= high + room)
    return position_mm if inside.all() else None


def _some(lengths: Lengths) -> Lengths:
    rng = np.random.default_rng(0)
    return some_lengths(lengths, np.sort(rng.choice(len(lengths), min(READINGS, len(lengths)), replace=False)))


def _small_fit(machine: Machine, lengths: Lengths) -> float:
    """Residual RMS in mm of a base model of low degree on some of the readings."""
    basis = CurveBasis(machine, base_errors(machine), (4, 4, 4))
    try:
        return fit_base(ObservedLengths(machine, _some(lengths)), basis, steps=3).rms_mm
    except (CompgenError, np.linalg.LinAlgError):
        return float("inf")


def _stations_only(machine: Machine, lengths: Lengths) -> float:
    """Residual RMS in mm if the machine is taken as perfect: enough to tell mm from um."""
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    group = dead_lengths_of(lengths)
    squares = 0.0
    for k in range(len(lengths.stations)):
        rows = np.flatnonzero(lengths.station == k)
        own, member = np.unique(group[rows], return_inverse=True)
        residual = located(target[rows], lengths.length_mm[rows], member.ravel().astype(np.int64), len(own))[1]
        squares += float(np.sum(residual**2))
    return float(np.sqrt(squares / len(lengths)))


def _mapped(machine: Machine, lengths: Lengths, rms_mm: float) -> Correction | None:
    """Return the best mapping; those that the stations alone cannot tell apart are compared with the errors inside."""
    some = _some(lengths)
    scored = [(_stations_only(machine, mapped), text, mapped) for text, mapped in _mappings(machine, some)]
    if not scored:
        return None
    scored.sort(key=lambda item: item[0])
    close = [item for item in scored if item[0] < 3.0 * scored[0][0]][:MOST_CLOSE]
    if len(close) > 1 or scored[0][0] > 0.5 * _stations_only(machine, some):
        close = sorted(((_small_fit(machine, item[2]), item[1], item[2]) for item in close), key=lambda item: item[0])
    least, what, _ = close[0]
    if not (least < rms_mm / BETTER or _small_fit(machine, close[0][2]) < rms_mm / BETTER):
        return None
    return Correction(dict(_mappings(machine, lengths))[what], what)


def _relabelled(machine: Machine, lengths: Lengths, rms_mm: float) -> Correction | None:
    """Exchange the labels of two stations in the runs whose readings then fit."""
    observed = ObservedLengths(machine, lengths)
    if len(lengths.stations) < 2:
        return None
    count = len(lengths.stations)
    placement = observed.start()
    state = State(np.zeros(0), placement[: 3 * count].reshape(-1, 3), placement[3 * count :])
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    try:
        state, _ = robust_state(state, lengths, target, lengths.station, observed.group)
    except CompgenError:
        return None
    distance = np.linalg.norm(target[:, None, :] - state.stations_mm[None], axis=2)
    station, swapped = _swapped(observed, lengths, distance, state)
    if not swapped:
        return None
    better = replace(lengths, station=station)
    if not _small_fit(machine, better) < rms_mm / BETTER:
        return None
    pairs = sorted({f"{lengths.stations[i]} and {lengths.stations[j]}" for _, i, j in swapped})
    return Correction(better, f"the labels of stations {', '.join(pairs)} are exchanged in {len(swapped)} run(s)")


def _swapped(
    observed: ObservedLengths, lengths: Lengths, distance: FloatArray, state: State
) -> tuple[IntArray, list[tuple[int, int, int]]]:
    """Labels after the exchanges, and each exchange as (run, station, station)."""
    count = len(lengths.stations)
    run = observed.layout.run[observed.layout.stop]
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    group_of = {(int(s), int(k)): int(g) for s, k, g in zip(lengths.station, setup, observed.group, strict=True)}
    station = lengths.station.copy()
    own = distance[np.arange(len(station)), station] - state.dead_length_mm[observed.group] - lengths.length_mm
    found = []
    for number in np.unique(run[np.abs(own) > LABEL_MM]):
        here = np.flatnonzero(run == number)
        for i in range(count):
            for j in range(i + 1, count):
                rows = here[(lengths.station[here] == i) | (lengths.station[here] == j)]
                other = np.where(lengths.station[rows] == i, j, i)
                group = [group_of.get((int(o), int(setup[r])), 0) for o, r in zip(other, rows, strict=True)]
                fit = distance[rows, other] - state.dead_length_mm[group] - lengths.length_mm[rows]
                if len(rows) and np.median(np.abs(fit)) < LABEL_MM < np.median(np.abs(own[rows])):
                    station[rows] = other
                    found.append((int(number), i, j))
    return station, found
