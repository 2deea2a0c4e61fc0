"""The same points before and after: matched, or refused with what differs, or brought together as the user says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy.field import Field, Spread, independent_spread, unknown_spread
from compgen.accuracy.runs import SAME_TARGET_MM, RunStatistics
from compgen.accuracy.source import ErrorSource
from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError
from compgen.model.basis import hat_matrix
from compgen.model.volumetric import tool_of

#: Ways to bring different points together.
ALIGN = ("common", "interpolate", "model")
#: Positions closer than this are the same one, mm.
SAME_MM = 1e-3


def refuse(what: str, before: Sequence[object], after: Sequence[object], ways: str) -> InputError:
    """Return the error that says what the two do not share."""
    only_before, only_after = [x for x in before if x not in set(after)], [x for x in after if x not in set(before)]
    parts = []
    for name, only in (("BEFORE", only_before), ("AFTER", only_after)):
        if only:
            shown = ", ".join(str(x) for x in only[:3]) + (", ..." if len(only) > 3 else "")
            parts.append(f"only {name} has {shown}")
    return InputError(
        f"BEFORE and AFTER do not have the same {what}: {'; '.join(parts)}. A comparison needs the same points; {ways}",
        field="--align",
    )


# --- errors --------------------------------------------------------------------------------------------------------


def paired_errors(before: ErrorSource, after: ErrorSource, align: str | None) -> tuple[ErrorSource, ErrorSource, str]:
    """Return both sources with the same errors at the same positions, and what was done in words.

    Raises
    ------
    InputError
        if they differ and ``align`` does not say what to do: ``"common"`` keeps the errors and positions that both have,
        ``"interpolate"`` takes both linearly at all positions of both within the range that both know.
    """
    first, second = before.errors, after.errors
    if first.names != second.names and align != "common":
        ways = "--align common compares the errors that both hold"
        raise refuse("errors", first.names, second.names, ways)
    same = all(
        _same(first.curves[n].position_mm, second.curves[n].position_mm) for n in first.curves if n in second.curves
    )
    if same and first.names == second.names:
        return before, after, "same errors at the same positions"
    names = [name for name in first.names if name in second.names]
    if not names:
        raise refuse("errors", first.names, second.names, "they have none in common")
    if not same and align not in ("common", "interpolate"):
        name = next(
            n
            for n in names
            if n in first.curves and not _same(first.curves[n].position_mm, second.curves[n].position_mm)
        )
        texts = [[f"{x:g} mm" for x in table.curves[name].position_mm] for table in (first, second)]
        ways = "--align interpolate takes both linearly at all positions of both, --align common those that both have"
        raise refuse(f"positions of {name}", texts[0], texts[1], ways)
    nodes = {
        name: _joined(first.curves[name], second.curves[name], str(align)) for name in names if name in first.curves
    }
    text = (
        "linear between positions, all of both within the range that both know"
        if align == "interpolate"
        else (f"only what both hold: {', '.join(names)}, at common positions")
    )
    return resampled(before, names, nodes), resampled(after, names, nodes), text


def _same(first: FloatArray, second: FloatArray) -> bool:
    return len(first) == len(second) and bool(np.all(np.abs(first - second) <= SAME_MM))


def _joined(first: Curve, second: Curve, align: str) -> FloatArray:
    low = max(first.position_mm[0], second.position_mm[0])
    high = min(first.position_mm[-1], second.position_mm[-1])
    near = np.abs(first.position_mm[:, None] - second.position_mm[None]).min(axis=1) <= SAME_MM
    kept = first.position_mm[near]
    if align == "interpolate":
        both = np.unique(np.concatenate([first.position_mm, second.position_mm]))
        both = both[np.concatenate([[True], np.diff(both) > SAME_MM])]
        kept = both[(both >= low) & (both <= high)]
    if len(kept) == 0:
        raise InputError("BEFORE and AFTER have no position in common", field="--align")
    return np.asarray(kept)


def resampled(source: ErrorSource, names: Sequence[str], nodes_mm: dict[str, FloatArray]) -> ErrorSource:
    """Return some errors of a source, linear between its positions, at new ones; the covariance follows."""
    curves, squareness, rows = {}, {}, []
    first = 0
    for name in source.errors.names:
        single = name in source.errors.squareness
        count = 1 if single else len(source.errors.curves[name].value)
        if name in names:
            matrix = np.eye(1) if single else hat_matrix(source.errors.curves[name].position_mm, nodes_mm[name])
            factor = None if source.factor is None else matrix @ source.factor[first : first + count]
            if single:
                squareness[name] = source.errors.squareness[name]
            else:
                old = source.errors.curves[name]
                u = np.full(len(matrix), np.nan) if factor is None else np.linalg.norm(factor, axis=1)
                curves[name] = Curve(nodes_mm[name], matrix @ old.value, u)
            rows.append(factor)
        first += count
    known = [part for part in rows if part is not None]
    factor = np.vstack(known) if len(known) == len(rows) else None
    return replace(source, errors=ErrorTable(curves, squareness, source.errors.metadata), factor=factor)


# --- measured positions --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredField:
    """Deviations as a field, repeats averaged; ``keys`` tells the points apart, ``measured`` the components (3,)."""

    field: Field
    keys: tuple[tuple[float, ...], ...]
    measured: tuple[bool, bool, bool]

    def at(self, keys: Sequence[tuple[float, ...]]) -> MeasuredField:
        """Return the field at some of its points, in the given order."""
        index = {key: k for k, key in enumerate(self.keys)}
        rows = np.array([index[key] for key in keys])
        inner = self.field

        def spread(weight: FloatArray) -> float:
            full = np.zeros_like(inner.error_mm)
            full[rows] = weight
            return inner.spread(full)

        part = replace(
            inner,
            position_mm=inner.position_mm[rows],
            tip_mm=inner.tip_mm[rows],
            error_mm=inner.error_mm[rows],
            spread=spread,
        )
        return MeasuredField(part, tuple(keys), self.measured)


def measured_field(machine: Machine, deviations: Deviations, u_um: float | None = None) -> MeasuredField:
    """Return measured deviations as a field over distinct points: position, tool, direction of approach.

    Parameters
    ----------
    machine : its tool offset counts where the file has none.
    deviations : the measurement; repeats at a point are averaged.
    u_um : standard uncertainty of each component in um; default that of the file, else from the scatter of repeats
        (pooled), else unknown.
    """
    tool = tool_of(machine, deviations.tool_mm)
    tools = np.broadcast_to(tool, deviations.position_mm.shape)
    approach = np.zeros_like(tools) if deviations.approach is None else deviations.approach
    place = np.round(np.hstack([deviations.position_mm, tools]) / SAME_MM) * SAME_MM + 0.0
    keys, index = np.unique(np.hstack([place, approach]), axis=0, return_inverse=True)
    index = np.asarray(index, dtype=np.int64).ravel()
    count = np.bincount(index).astype(np.float64)[:, None]
    error, position, tip = (
        _means(index, values, count)
        for values in (np.nan_to_num(deviations.deviation_mm), deviations.position_mm, deviations.position_mm + tools)
    )
    spread = _measured_spread(deviations, index, error, count, u_um)
    x, y, z = (not np.isnan(deviations.deviation_mm[:, k]).all() for k in range(3))
    return MeasuredField(Field(position, tip, error, spread), tuple(map(tuple, keys.tolist())), (x, y, z))


def _means(index: NDArray[np.int64], values: FloatArray, count: FloatArray) -> FloatArray:
    sums = np.column_stack([np.bincount(index, values[:, k], len(count)) for k in range(3)])
    return np.asarray(sums / count)


def _measured_spread(
    deviations: Deviations, index: NDArray[np.int64], mean_mm: FloatArray, count: FloatArray, u_um: float | None
) -> Spread:
    if u_um is not None:
        return independent_spread(np.broadcast_to(u_um * MM_PER_UM / np.sqrt(count), mean_mm.shape))
    if deviations.u_mm is not None:
        squares = _means(index, np.nan_to_num(deviations.u_mm) ** 2, count)
        return independent_spread(np.sqrt(squares / count))
    freedom = len(index) - len(count)
    if freedom < 1:
        return unknown_spread
    rest = np.nan_to_num(deviations.deviation_mm) - mean_mm[index]
    pooled = np.sqrt(np.sum(rest**2, axis=0) / freedom)
    return independent_spread(pooled / np.sqrt(count))


def paired_fields(
    before: MeasuredField, after: MeasuredField, align: str | None
) -> tuple[MeasuredField, MeasuredField, str]:
    """Return both at the same points; InputError if these differ and ``align`` is not ``"common"``."""
    if before.measured != after.measured:
        raise InputError(
            "BEFORE and AFTER do not measure the same components dx, dy, dz; measure the same, or identify both"
        )
    known = set(after.keys)
    common = [key for key in before.keys if key in known]
    same = len(common) == len(before.keys) == len(after.keys)
    if not same and align != "common" or not common:
        texts = [[_shown(key) for key in side.keys] for side in (before, after)]
        ways = "--align common takes those that both have, --align model compares the errors identified from each"
        raise refuse("points", texts[0], texts[1], ways)
    text = f"same {len(common)} points" if same else f"only the {len(common)} points that both have"
    return before.at(common), after.at(common), text


def _shown(key: tuple[float, ...]) -> str:
    x, y, z = key[:3]
    ways = [f"{value:+.0f}" for value in key[6:]]
    return f"({x:g}, {y:g}, {z:g}) mm" + (f" from {','.join(ways)}" if any(key[6:]) else "")


def check_same_positions(before: Lengths, after: Lengths, align: str | None) -> str:
    """Tracer lengths of the same targets: the stations may differ, the positions not, unless ``align`` is ``"model"``."""
    sets = []
    for lengths in (before, after):
        tools = np.zeros_like(lengths.position_mm) if lengths.tool_mm is None else lengths.tool_mm
        place = np.unique(np.round(np.hstack([lengths.position_mm, tools]) / SAME_MM) * SAME_MM + 0.0, axis=0)
        sets.append([f"({x:g}, {y:g}, {z:g}) mm" for x, y, z, *_ in place.tolist()])
    if sets[0] == sets[1]:
        return f"lengths to the same {len(sets[0])} positions"
    if align != "model":
        ways = "--align model compares the errors identified from each over the volume of the machine"
        raise refuse("positions", sets[0], sets[1], ways)
    return "lengths to different positions: the errors identified from each are compared"


# --- positioning runs ----------------------------------------------------------------------------------------------


def paired_runs(
    axis: str, before: RunStatistics, after: RunStatistics, align: str | None
) -> tuple[RunStatistics, RunStatistics, str]:
    """Return both at the same targets.

    ``"common"`` keeps the targets that both have; ``"interpolate"`` takes means and estimators of AFTER linearly at the
    targets of BEFORE that lie within its range.
    """
    first, second = before.position_mm, after.position_mm
    if len(first) == len(second) and bool(np.all(np.abs(first - second) <= SAME_TARGET_MM)):
        return before, after, f"{axis}: same {len(first)} targets"
    if align == "common":
        near = np.abs(first[:, None] - second[None]) <= SAME_TARGET_MM
        rows, columns = np.nonzero(near)
        if len(rows) < 2:
            raise InputError(
                f"{axis}: BEFORE and AFTER have {len(rows)} targets in common; two are needed", field="--align"
            )
        return _picked(before, rows), _picked(after, columns), f"{axis}: the {len(rows)} targets that both have"
    if align == "interpolate":
        rows = np.flatnonzero((first >= second[0]) & (first <= second[-1]))
        if len(rows) < 2:
            raise InputError(f"{axis}: fewer than two targets of BEFORE lie within AFTER", field="--align")
        at = first[rows]
        values = np.vstack([np.interp(at, second, row) for row in after.values])
        count = np.vstack([np.interp(at, second, row) for row in after.count])
        text = f"{axis}: AFTER taken linearly at {len(rows)} targets of BEFORE"
        return _picked(before, rows), RunStatistics(at, values, count), text
    texts = [[f"{x:g} mm" for x in side] for side in (first, second)]
    ways = (
        "--align common takes the targets that both have, --align interpolate takes AFTER linearly at those of BEFORE"
    )
    raise refuse(f"targets of {axis}", texts[0], texts[1], ways)


def _picked(statistics: RunStatistics, rows: np.ndarray) -> RunStatistics:
    return RunStatistics(statistics.position_mm[rows], statistics.values[:, rows], statistics.count[:, rows])
