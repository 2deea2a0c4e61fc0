"""Tables of tracer lengths, and of measured positions, in space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.deviations import LARGEST_UM, Deviations
from compgen.core.lengths import Lengths
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError
from compgen.imports.columns import MM_PER_LENGTH
from compgen.imports.findings import Findings
from compgen.imports.further import Further, further_of, metadata_of
from compgen.imports.hypotheses import LengthEvidence, judge_lengths, slope_of, usual_deviation_mm

#: The unit of lengths by their geometry must agree with a known one so well (the machine's errors are far smaller).
UNIT_TOLERANCE = 0.03


def lengths_of(findings: Findings) -> Lengths:
    """Return tracer lengths; unit and sign are held against the commanded points."""
    table, fields = findings.table, findings.fields
    position = _positions(findings, "xyz")
    rows = len(table.rows)
    names = table.column(fields["station"].name) if "station" in fields else ["S1"] * rows
    if "station" not in fields:
        findings.notes.append("there is no column of stations: all lengths belong to one, S1")
    points = table.column(fields["point"].name) if "point" in fields else [str(k + 1) for k in range(rows)]
    for cells, key in ((names, "station"), (points, "point")):
        empty = next((k for k, cell in enumerate(cells) if not cell), None)
        if empty is not None:
            raise table.grid.fail(
                f"is empty{table.grid.empty}; every row needs a label here", table.lines[empty], fields[key].name
            )
    stations = tuple(dict.fromkeys(names))
    station = np.array([stations.index(name) for name in names], dtype=np.int64)
    reading = findings.numbers("length")
    scale = _length_scale(findings, position, reading, station)
    findings.understood |= {"stations": len(stations), "readings": rows}
    further = further_of(findings, "lengths")
    labels = _numbered(findings, [names, points], position, reading, further)
    return Lengths(
        stations=stations,
        station=station,
        point=points,
        position_mm=position,
        length_mm=reading * scale,
        tool_mm=further.tool_mm,
        approach=further.approach,
        labels=labels,
        covariates=further.covariates,
        metadata=metadata_of(findings, further),
        origin=[(str(table.grid.path), line) for line in table.lines],
    )


def _positions(findings: Findings, keys: str) -> FloatArray:
    missing = [key for key in keys if key not in findings.fields]
    if missing:
        raise findings.table.grid.fail(
            f"has no column of commanded {missing[0].upper()}; give --map {missing[0]}=COLUMN",
            findings.table.header_line,
        )
    raw = [findings.numbers(key) for key in keys]
    longest = int(np.argmax([np.ptp(values) for values in raw]))
    first = findings.positions_mm(keys[longest], raw[longest])
    factor = MM_PER_LENGTH[str(findings.understood["position_unit"])]
    columns = [first if k == longest else _like(findings, keys[k], raw[k], factor) for k in range(3)]
    return np.column_stack(columns)


def _like(findings: Findings, key: str, values: FloatArray, factor: float) -> FloatArray:
    """Return the other two coordinates in their own unit if they have one, else in that of the longest axis."""
    own = findings.given_unit(key) or findings.given_unit("position") or findings.fields[key].unit
    return values * (MM_PER_LENGTH.get(own, factor) if own else factor)


def _length_scale(findings: Findings, position: FloatArray, reading: FloatArray, station: NDArray[np.int64]) -> float:
    """Signed mm per unit of the lengths: declared, and held against the geometry of each station."""
    found = [judge_lengths(position[station == k], reading[station == k]) for k in np.unique(station)]
    evidence = [item for item in found if item is not None]
    declared = findings.given_unit("length", value=True) or findings.fields["length"].unit
    unit = _unit_by_geometry(evidence)
    sign = _sign_by_geometry(evidence)
    if declared is not None and declared not in MM_PER_LENGTH:
        raise findings.table.grid.fail(f"{declared} is no length", None, findings.fields["length"].name)
    if declared is None and unit is None:
        findings.doubts.append(
            "no unit of the lengths stands in the file, and the points do not tell; give --unit length=mm"
        )
    elif declared is None:
        findings.notes.append(f"the lengths fit the points in {unit}")
    elif unit is not None and unit != declared:
        findings.doubts.append(f"the lengths say {declared}, but they fit the points in {unit}; give --unit length=...")
    if sign < 0:
        findings.notes.append("the lengths shrink where the distance grows: their sign was turned round")
    if sign == 0:
        findings.notes.append(
            "the points do not tell the sign of the lengths; they are taken to grow with the distance"
        )
    chosen = declared or unit or "mm"
    ratio = float(np.median([item.mm_per_unit for item in evidence])) if evidence else None
    findings.understood |= {"unit": chosen, "sign": "grows with the distance" if sign >= 0 else "turned round"}
    findings.understood["mm_per_unit_by_geometry"] = ratio
    return MM_PER_LENGTH[chosen] * (-1.0 if sign < 0 else 1.0)


def _unit_by_geometry(evidence: list[LengthEvidence]) -> str | None:
    if not evidence:
        return None
    ratio = float(np.median([item.mm_per_unit for item in evidence]))
    return next((unit for unit, mm in MM_PER_LENGTH.items() if abs(ratio / mm - 1.0) < UNIT_TOLERANCE), None)


def _sign_by_geometry(evidence: list[LengthEvidence]) -> int:
    signs = {item.sign for item in evidence}
    return signs.pop() if len(signs) == 1 else 0


def _numbered(
    findings: Findings, names: Sequence[Sequence[str]], position: FloatArray, value: FloatArray, further: Further
) -> dict[str, NDArray[np.int64]]:
    """Return the labels; rows that nothing tells apart are numbered as repeats, or refused if they are a copy.

    Raises
    ------
    InputError
        if three or more rows repeat earlier ones, and each of them to the last digit: they were pasted twice.
    """
    first, count = _earlier(_keys(names, position, further))
    again = np.flatnonzero(count > 1)
    if not again.size:
        return further.labels
    if again.size >= 3 and np.array_equal(value[again], value[first[again]]):
        line, earlier = (findings.table.lines[k] for k in (int(again[0]), int(first[again[0]])))
        message = f"{again.size} rows repeat earlier ones to the last digit (this one line {earlier}): take out what is a copy"
        raise findings.table.grid.fail(message, line)
    findings.notes.append(
        f"{again.size} rows repeat a position without a run or repeat: they were numbered as they come"
    )
    if "repeat" in further.labels:
        count = count + further.labels["repeat"] * (1 + int(count.max()))
    return {**further.labels, "repeat": count}


def _keys(names: Sequence[Sequence[str]], position: FloatArray, further: Further) -> FloatArray:
    """Return what tells rows apart, a number for each column (rows, k)."""
    numbered = [np.unique(np.array(cells), return_inverse=True)[1] for cells in names]
    times = [further.covariates[key] for key in ("time_s", "approach") if key in further.covariates]
    vectors = [part for part in (position, further.tool_mm, further.approach) if part is not None]
    return np.column_stack([*numbered, *times, *further.labels.values(), *vectors]) + 0.0


def _earlier(keys: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each row the first one with the same key, and how often it stood so far (1: the first time), (rows,)."""
    rows = (
        np.ascontiguousarray(keys)
        .view([("", keys.dtype)] * keys.shape[1])
        .ravel()
        .view(f"V{keys.itemsize * keys.shape[1]}")
    )
    _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    group = inverse.ravel()[order]
    starts = np.flatnonzero(np.concatenate([[True], group[1:] != group[:-1]]))
    position_in_group = np.arange(len(group)) - np.repeat(starts, np.diff([*starts, len(group)]))
    count = np.empty(len(group), dtype=np.int64)
    count[order] = position_in_group + 1
    return first[inverse.ravel()].astype(np.int64), count


def deviations_of(findings: Findings) -> Deviations:
    """Return measured minus commanded positions, from deviations or from measured positions."""
    position = _positions(findings, "xyz")
    deviation = np.full_like(position, np.nan)
    usual = usual_deviation_mm(float(np.ptp(position, axis=0).max()))
    for k, axis in enumerate("xyz"):
        if f"d{axis}" in findings.fields:
            name = findings.fields[f"d{axis}"].name
            values = findings.numbers(f"d{axis}")
            deviation[:, k] = findings.values_si(f"d{axis}", name, values, usual, angular=False)
        elif f"{axis}a" in findings.fields:
            deviation[:, k] = _measured(findings, f"{axis}a", position[:, k])
    if findings.options.sign == "correction":
        deviation = -deviation
        findings.understood["sign"] = "corrections, turned round"
    else:
        findings.understood["sign"] = "measured minus commanded"
    findings.understood["readings"] = len(position)
    further = further_of(findings, "deviations")
    return Deviations(
        position_mm=position,
        deviation_mm=deviation,
        tool_mm=further.tool_mm,
        approach=further.approach,
        labels=_numbered(findings, [], position, np.nan_to_num(deviation).sum(axis=1), further),
        covariates=further.covariates,
        metadata=metadata_of(findings, further),
        origin=[(str(findings.table.grid.path), line) for line in findings.table.lines],
    )


def check_largest(deviation_mm: FloatArray, origin: Sequence[tuple[str, int]]) -> None:
    """Refuse deviations that no file of the contract may hold; ``deviation_mm`` is (n,) or (n, 3), nan where unknown."""
    size = np.nan_to_num(np.abs(deviation_mm)).reshape(len(deviation_mm), -1).max(axis=1)
    worst = int(np.argmax(size))
    if size[worst] > LARGEST_UM * MM_PER_UM:
        file, line = origin[worst]
        raise InputError(
            f"a deviation of {size[worst]:.4g} mm is none; is it a slip, or another unit?", file=file, line=line
        )


def _measured(findings: Findings, key: str, position: FloatArray) -> FloatArray:
    """Measured minus commanded coordinate; unit and sign by the slope of the one over the other."""
    values = findings.numbers(key)
    name, declared = findings.fields[key].name, findings.given_unit(key) or findings.fields[key].unit
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0
    if np.ptp(position) > 0:
        slope = slope_of(position, values * scale)
        if slope.unit_ratio != 1.0 or slope.sign < 0:
            findings.doubts.append(f"{name!r} follows the command with the slope {slope.slope:.5g}, not 1")
    return values * scale - position
