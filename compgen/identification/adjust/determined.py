"""Readings that are linear in the errors of a machine: least squares only in what they determine.

Readings along single axes, circles, plates of unknown pose, or a mixture of them rarely determine the whole model: one
height shows nothing over Z, data without dz no straightness in Z. So directions of the unknowns that no reading shows
are found (singular values) and stay zero; errors that are not seen at all are omitted and named. If only nodes at the
ends of a curve have no readings, they are tied to the others by smoothness, with the growing uncertainty of an
extrapolation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.names import MM_PER_UM, RAD_PER_URAD, error_named
from compgen.errors import Message, UndeterminedError
from compgen.identification.adjust.unknowns import CurveParameters, ErrorParameters, error_parameters

#: Directions whose singular value is below this share of the largest are not determined; columns have unit length.
SHOWS, RCOND = 1e-6, 1e-9
#: Lengths of few stations and a plate that lies a little tilted show many errors by terms of second order only: directions
#: below this share, which they determine about a hundred times worse than their readings, count as not determined.
FAINT = 1e-3
#: The same where noise in the faintest of them would be errors that no machine has.
FAINTER = (FAINT, 3.0 * FAINT, 1e-2, 3e-2)
#: Angles are expressed in mm at this lever, comparable to translations.
LEVER_MM = 1000.0
#: Nodes with less than this share of the readings of the median node are tied to their neighbours.
WEAK = 0.25
#: An error counts as identified if readings determine this share of its unknowns, or at least one direction.
SEEN = 1e-6
#: An error is partly undetermined if the readings show less than this share of one of its unknowns.
WHOLLY = 1.0 - 1e-4
#: Standard uncertainty of values that state none, and the smallest allowed, um and urad.
USUAL_U, FINEST = 1.0, 1e-3
#: A column below this share of the largest is rounding: its error is not read. Scaled up, it would be the whole answer.
ROUNDING = 1e-9
#: Largest number of positions of each error that represent all at which it was read.
MOST_SHOWN = 50
#: A value is determined if less than this share of it is outside the determined directions.
MOST_OUTSIDE = 1e-4
#: Assumed curvature of a curve between neighbouring nodes if too few nodes are seen to measure it, um and urad.
USUAL_BEND = 2.0


@dataclass(frozen=True)
class Observations:
    """k readings: value = ``design`` times the unknown errors + ``others`` times further unknowns + noise.

    Parameters
    ----------
    design : (k, size of the layout), per mm and rad of the unknown errors.
    others : (k, q), per unit of the further unknowns: the pose of a plate, the zero of a laser.
    value, sigma : (k,), in any unit that both share.
    at_mm : position of each axis, (k, 3), or nan if the reading does not depend on the errors of that axis.
    shows : which curves of the layout a reading depends on, (k, curves).
    covered : errors known over the whole travel, wherever the readings were.
    """

    design: FloatArray
    others: FloatArray
    value: FloatArray
    sigma: FloatArray
    at_mm: FloatArray
    shows: NDArray[np.bool_]
    covered: frozenset[str] = frozenset()

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.value)

    def kept(self, rows: NDArray[np.bool_]) -> Observations:
        """Return the readings of some rows, (k,)."""
        arrays = ("design", "others", "value", "sigma", "at_mm", "shows")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    @classmethod
    def of_values(
        cls,
        layout: ErrorParameters,
        names: Sequence[str],
        position_mm: FloatArray,
        value: FloatArray,
        covariance: FloatArray,
        taken_off: FloatArray | None = None,
    ) -> Observations:
        """Return error values with a covariance as independent readings of unit variance; no zero-variance directions.

        Values without uncertainty (a curve where it is zero by definition) are ignored. Every curve counts as read
        everywhere. ``taken_off`` (k, k) is the part of the values that their gauge took off.
        """
        design = layout.value_rows(names, position_mm)
        if taken_off is not None:
            design = design - taken_off @ design
        size, direction = np.linalg.eigh(covariance)
        seen = size > 1e-12 * size[-1]
        whiten = (direction[:, seen] / np.sqrt(size[seen])).T
        count = int(np.count_nonzero(seen))
        return cls(
            design=whiten @ design,
            others=np.zeros((count, 0)),
            value=whiten @ value,
            sigma=np.ones(count),
            at_mm=np.full((count, 3), np.nan),
            shows=np.zeros((count, len(layout.curves)), dtype=bool),
            covered=frozenset(names),
        )

    @classmethod
    def of_curves(cls, layout: ErrorParameters, errors: ErrorTable) -> Observations:
        """Return error values as independent readings, each curve with a free constant, straightness with a free line.

        An unknown uncertainty is set to the usual value. Errors that the layout does not contain are omitted.
        """
        errors = errors.only(*(name for name, _ in layout.columns()))
        names = [name for name, rows in errors.rows().items() for _ in range(rows.stop - rows.start)]
        position_mm = np.concatenate(
            [errors.curves[name].position_mm if name in errors.curves else [np.nan] for name in errors.names]
        )
        label, axis = np.array(names), np.array([error_named(name).axis for name in names])
        unit = np.array([error_named(name).si_per_unit for name in names])
        u = errors.uncertainties()
        at_mm = np.full((len(names), 3), np.nan)
        at_mm[np.arange(len(names)), axis] = position_mm
        free = []
        for name, curve in errors.curves.items():
            own = (label == name).astype(np.float64)
            free.append(own)
            if error_named(name).is_straightness:
                free.append(own * np.nan_to_num(position_mm - curve.position_mm.mean()))
        return cls(
            design=layout.value_rows(names, position_mm),
            others=np.column_stack(free) if free else np.zeros((len(names), 0)),
            value=errors.values(),
            sigma=np.where(np.isfinite(u), np.maximum(u, FINEST * unit), USUAL_U * unit),
            at_mm=at_mm,
            shows=label[:, None] == np.array([curve.error.name for curve in layout.curves], dtype=object)[None, :],
        )

    def positions(self, layout: ErrorParameters) -> dict[str, FloatArray]:
        """Positions of the readings of each error: at most ``MOST_SHOWN`` of them, else the nodes."""
        positions = {name: np.array([np.nan]) for name in layout.squareness}
        for number, curve in enumerate(layout.curves):
            along = np.unique(self.at_mm[self.shows[:, number], curve.error.axis])
            along = along[np.isfinite(along)]
            some = np.unique(np.linspace(0, max(len(along) - 1, 0), MOST_SHOWN).astype(int))
            positions[curve.error.name] = along[some] if len(along) else curve.nodes_mm
        return positions


def stacked(parts: Sequence[Observations]) -> Observations:
    """Return several sets of readings as one; each keeps its further unknowns."""
    widths = np.cumsum([0, *(part.others.shape[1] for part in parts)])
    others = [np.pad(part.others, ((0, 0), (widths[k], widths[-1] - widths[k + 1]))) for k, part in enumerate(parts)]
    return Observations(
        np.vstack([part.design for part in parts]),
        np.vstack(others),
        np.concatenate([part.value for part in parts]),
        np.concatenate([part.sigma for part in parts]),
        np.vstack([part.at_mm for part in parts]),
        np.vstack([part.shows for part in parts]),
        frozenset().union(*(part.covered for part in parts)),
    )


@dataclass(frozen=True)
class Determined:
    """Optimum: unknown errors with a factor F of their covariance (F F^T), the other unknowns, residuals (all readings).

    ``unreached`` are nodes that no reading reaches, by error; ``left_out`` the errors that are not seen; ``partly`` the
    errors that are partly undetermined. ``freedom`` is the number of readings minus the number of determined unknowns,
    including poses and the like.
    """

    layout: ErrorParameters
    unknowns: FloatArray
    factor: FloatArray
    others: FloatArray
    u_others: FloatArray
    residual: FloatArray
    rank: int
    freedom: int
    condition: float
    partly: tuple[str, ...]
    unreached: Mapping[str, FloatArray] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def on(self, layout: ErrorParameters) -> FloatArray:
        """The unknowns of a layout that contains more errors, (size,); zero for undetermined ones."""
        whole = np.zeros(layout.size)
        own = dict(self.layout.columns())
        for name, columns in layout.columns():
            if name in own:
                whole[columns] = self.unknowns[own[name]]
        return whole

    def curve(self, name: str, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values of an error at positions (m,) and their standard uncertainties, (m,) each, mm or rad."""
        rows = self.layout.value_rows([name] * len(position_mm), position_mm)
        return rows @ self.unknowns, np.linalg.norm(rows @ self.factor, axis=1)


def determined_values(
    layout: ErrorParameters, observations: Observations, rows: FloatArray, least: float = SHOWS
) -> NDArray[np.bool_]:
    """Which error values, ``rows`` (m, size) times the unknowns, the readings separate from all other unknowns, (m,).

    At one height a positioning error cannot be separated from an angle about a horizontal axis: neither value is
    determined, although their common direction is.
    """
    unit = _kinds(layout)[1]
    explained = _range(observations.others / observations.sigma[:, None])
    design = observations.design * unit / observations.sigma[:, None]
    rest = design - explained @ (explained.T @ design)
    size = np.linalg.norm(rest, axis=0)
    scale = np.where(size > SHOWS * size.max(initial=1e-300), size, size.max(initial=1e-300))
    _, values, right = np.linalg.svd(np.linalg.qr(rest / scale, mode="r"))  # fewer rows, the same directions
    directions = right[: len(values)][values > least * values.max(initial=1e-300)].T
    scaled = rows * unit / scale
    outside = np.linalg.norm(scaled - scaled @ directions @ directions.T, axis=1)
    size = np.linalg.norm(scaled, axis=1)
    return np.asarray((size > 0) & (outside <= MOST_OUTSIDE * size))


def least_squares(
    layout: ErrorParameters, observations: Observations, accepted: NDArray[np.bool_], least: float = SHOWS
) -> Determined:
    """Adjust the errors of a layout and the other unknowns to the accepted readings, (k,).

    Directions of the errors that the readings show by a share of less than ``least`` count as not determined.

    Raises
    ------
    UndeterminedError
        if no error is determined.
    """
    names = [name for name, _ in layout.columns()]
    angular, unit = _kinds(layout)
    used = (accepted / observations.sigma)[:, None]
    shown, _ = _seen_directions(observations.design * unit * used, observations.others * used, angular, least)
    seen = np.einsum("ij,ij->i", shown, shown)  # how much of each unknown is determined, 0 to 1
    kept = [name for name, columns in layout.columns() if seen[columns].max(initial=0.0) > SEEN]
    if not kept:
        raise UndeterminedError(
            Message("errors-undetermined", "the readings determine none of the machine's errors"), []
        )
    smaller = error_parameters(layout.machine, kept)
    columns = np.concatenate([np.arange(span.start, span.stop) for name, span in layout.columns() if name in kept])
    curves = [curve.error.name in kept for curve in layout.curves]
    observations = replace(observations, design=observations.design[:, columns], shows=observations.shows[:, curves])
    unreached, tied = _far_nodes(smaller, observations, accepted)
    found = _optimum(smaller, observations, accepted, _ties(smaller, tied, {}), least)
    if tied:  # repeat with the curvature of the curves where they are seen
        bends = _ties(smaller, tied, _bends(smaller, found.unknowns, tied))
        found = _optimum(smaller, observations, accepted, bends, least)
    return replace(found, unreached=unreached, left_out=tuple(name for name in names if name not in kept))


def _optimum(
    layout: ErrorParameters, observations: Observations, accepted: NDArray[np.bool_], bends: FloatArray, least: float
) -> Determined:
    """Least squares in the directions that the readings show; angles only explain what translations cannot.

    At one height an angle about a horizontal axis is the same as a straightness. Translations and squareness therefore
    come first, then the remainder of the columns of the angles. ``bends`` are rows that tie nodes to others.
    """
    angular, unit = _kinds(layout)
    used = (accepted / observations.sigma)[:, None]
    errors, others = observations.design * unit, observations.others
    design = np.vstack([errors * used, bends * unit])
    frames = np.vstack([others * used, np.zeros((len(bends), others.shape[1]))])
    shown, rank = _seen_directions(design, frames, angular, least)
    whole = np.hstack([design @ shown, frames])
    target = np.concatenate([observations.value * used[:, 0], np.zeros(len(bends))])
    scale = np.linalg.norm(whole, axis=0)
    scale = np.where(scale > 1e-9 * scale.max(), scale, scale.max())  # a column of rounding errors is not scaled up
    values = np.linalg.svd(whole / scale, compute_uv=False)
    inverse = np.linalg.pinv(whole / scale, rcond=RCOND) / scale[:, None]
    found = inverse @ target
    seen, other_values = found[: shown.shape[1]], found[shown.shape[1] :]
    spread = unit[:, None] * shown @ inverse[: shown.shape[1]]
    size, direction = np.linalg.eigh(spread @ spread.T)
    share = np.einsum("ij,ij->i", shown, shown)
    return Determined(
        layout,
        unknowns=unit * (shown @ seen),
        factor=direction * np.sqrt(np.maximum(size, 0.0)),  # as many columns as unknowns, not as readings
        others=other_values,
        u_others=np.linalg.norm(inverse[shown.shape[1] :], axis=1),
        residual=observations.value - errors @ (shown @ seen) - others @ other_values,
        rank=rank,
        freedom=int(np.count_nonzero(accepted)) - rank - _range(others).shape[1],
        condition=float(values[0] / values[values > RCOND * values[0]][-1]),
        partly=tuple(name for name, columns in layout.columns() if share[columns].min(initial=1.0) < WHOLLY),
    )


def _kinds(layout: ErrorParameters) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which unknowns belong to angular curves, and the unit of each: mm, and for all angles mm at ``LEVER_MM``."""
    angular, unit = np.zeros(layout.size, dtype=bool), np.ones(layout.size)
    for name, columns in layout.columns():
        angular[columns] = error_named(name).kind == "angular"
        unit[columns] = 1.0 if error_named(name).kind == "linear" else 1.0 / LEVER_MM
    return angular, unit


def _seen_directions(
    errors: FloatArray, frames: FloatArray, angular: NDArray[np.bool_], least: float
) -> tuple[FloatArray, int]:
    """Orthonormal directions (size, r) of the unknown errors that the readings separate from the poses, and r.

    The angles get what neither poses nor translations explain. Directions without effect are omitted: their unknowns
    are zero, the smallest value that agrees with the readings.
    """
    explained = _range(frames)
    parts = []
    for group in (~angular, angular):
        own = errors[:, group]
        size = float(np.linalg.norm(own, axis=0).max(initial=0.0))
        if not size:
            continue
        own = np.where(np.linalg.norm(own, axis=0) > ROUNDING * size, own, 0.0)
        lever = np.maximum(np.linalg.norm(own, axis=0), ROUNDING * size)
        rest = own / lever
        rest = rest - explained @ (explained.T @ rest)
        left, values, right = np.linalg.svd(rest, full_matrices=False)
        shows = values > least * max(1.0, float(values[0]))
        good = right[shows]
        raw = np.zeros((len(angular), len(good)))
        raw[np.flatnonzero(group)] = good.T / lever[:, None]
        parts.append(np.linalg.qr(raw)[0] if len(good) else raw)
        explained = np.hstack([explained, left[:, shows]])
    shown = np.hstack(parts) if parts else np.zeros((len(angular), 0))
    return shown, shown.shape[1]


def _range(matrix: FloatArray) -> FloatArray:
    """Orthonormal basis of the columns, (rows, rank); columns of very different size count equally."""
    size = np.linalg.norm(matrix, axis=0)
    matrix = matrix[:, size > 0] / size[size > 0]
    left, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return np.asarray(left[:, values > 1e-9 * max(1.0, float(values.max(initial=0.0)))])


@dataclass(frozen=True)
class _Tied:
    """Nodes of a curve that are tied to others, and the first nodes of the triples whose second difference does it."""

    nodes_mm: FloatArray
    triples: tuple[int, ...]


def _far_nodes(
    layout: ErrorParameters, observations: Observations, accepted: NDArray[np.bool_]
) -> tuple[dict[str, FloatArray], dict[str, _Tied]]:
    """Nodes without a reading in the intervals next to them, and nodes with few readings or none; both by error.

    A round plate hardly reaches the ends of the travel: without a tie the noise of a few holes there would tilt the
    whole curve, since straightness is zero at both ends.
    """
    unreached, tied = {}, {}
    for number, curve in enumerate(layout.curves):
        if curve.error.name in observations.covered:
            continue
        along = observations.at_mm[accepted & observations.shows[:, number], curve.error.axis]
        along = along[np.isfinite(along)]
        hats = hat_matrix(curve.nodes_mm, along)
        near = np.asarray((hats > 1e-6).any(axis=0))
        if not near.all():
            unreached[curve.error.name] = curve.nodes_mm[~near]
        weight = (layout.basis(curve.error.axis, along) ** 2).sum(axis=0)
        shown: NDArray[np.bool_] = weight > WEAK * np.median(weight)
        if not shown.all():
            counts = (hats**2).sum(axis=0)
            nodes = curve.nodes_mm[counts <= WEAK * np.median(counts)]
            triples = tuple(k for k in range(len(shown) - 2) if not shown[k : k + 3].all())
            tied[curve.error.name] = _Tied(nodes, triples)
    return unreached, tied


def _bends(layout: ErrorParameters, unknowns: FloatArray, tied: Mapping[str, _Tied]) -> dict[str, float]:
    """Second difference of the tied curves between nodes that readings show, rms, mm and rad; at least the usual."""
    found = {}
    for curve in layout.curves:
        if curve.error.name in tied:
            alone = set(tied[curve.error.name].nodes_mm.tolist())
            bends = np.diff(curve.free @ unknowns[curve.columns], 2).tolist()
            size = [bend for k, bend in enumerate(bends) if not alone & set(curve.nodes_mm[k : k + 3].tolist())]
            measured = float(np.sqrt(np.mean(np.square(size)))) if size else 0.0
            found[curve.error.name] = max(_usual_bend(curve), measured)
    return found


def _usual_bend(curve: CurveParameters) -> float:
    return USUAL_BEND * (MM_PER_UM if curve.error.kind == "linear" else RAD_PER_URAD)


def _ties(layout: ErrorParameters, tied: Mapping[str, _Tied], bend: Mapping[str, float]) -> FloatArray:
    """Rows (ties, size) that tie nodes to their neighbours by small second differences, in units of the bend."""
    rows = []
    for curve in layout.curves:
        for k in tied[curve.error.name].triples if curve.error.name in tied else ():
            second = np.zeros(curve.free.shape[0])
            second[k : k + 3] = [1.0, -2.0, 1.0]
            row = np.zeros(layout.size)
            row[curve.columns] = second @ curve.free / bend.get(curve.error.name, _usual_bend(curve))
            rows.append(row)
    return np.array(rows) if rows else np.zeros((0, layout.size))
