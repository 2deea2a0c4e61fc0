"""Figures of accuracy and fields of position errors: where they come from, alignment, uncertainty, comparison of two."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from compgen.data.comparison import (
    SmallMotion,
    normalized_error,
    rigid_fields,
    sizes_of,
    small_motion,
    without_rigid_motion,
)
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, hat_matrix
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import COVERAGE, ERROR_INDEX, ERRORS, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.errors import InputError, Message
from compgen.identification.covariance import Covariance, covariance_or_independent, posterior_with
from compgen.identification.posterior import Posterior, assumed_text, worse_text
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import coefficients, factor, tool_of
from compgen.kinematics.many_points import blocks, full_grid, volumetric_error

# One figure of accuracy with its uncertainty, and how two of them compare.

Verdict = Literal["better", "worse", "not separated", "smaller", "larger", "same"]


@dataclass(frozen=True)
class Figure:
    """A figure in the unit of reports, um or urad.

    Parameters
    ----------
    value : the figure.
    u : its standard uncertainty, nan if unknown.
    unit : "um" or "urad".
    meaning : what it is, and the standard that defines it.
    contributions : standard uncertainties by source; their root sum of squares is ``u``.
    """

    value: float
    u: float
    unit: str
    meaning: str
    contributions: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of_mm(cls, value_mm: float, u_mm: float, meaning: str) -> Figure:
        """Return a figure in um."""
        return cls(float(value_mm) / MM_PER_UM, u_mm / MM_PER_UM, "um", meaning)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty U (k = 2)."""
        return COVERAGE * self.u

    def against(self, tolerance: float) -> str:
        """Return whether the figure keeps a tolerance in its unit, by the rule of ISO 14253-1 with U (k = 2).

        ``"within"`` and ``"exceeded"`` are proven: the whole interval is on that side. ``"not proven"``: the interval
        contains the tolerance. Without a known uncertainty the value alone decides, and the answer says so.

        >>> [Figure(value, 0.5, "um", "E").against(8.0) for value in (6.0, 7.5, 9.5)]
        ['within', 'not proven', 'exceeded']
        """
        if math.isnan(self.u):
            return ("within" if self.value <= tolerance else "exceeded") + ", uncertainty not known"
        if abs(self.value - tolerance) < self.expanded:
            return "not proven"
        return "within" if self.value <= tolerance else "exceeded"

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        found: dict[str, Any] = {
            "value": self.value,
            "u": self.u,
            "U_k2": self.expanded,
            "unit": self.unit,
            "meaning": self.meaning,
        }
        if self.contributions:
            found["contributions"] = dict(self.contributions)
        return found


@dataclass(frozen=True)
class ComparedFigure:
    """The same figure before and after; magnitudes are compared: -12 urad to +3 urad is an improvement by a factor of 4."""

    before: Figure
    after: Figure

    @property
    def factor(self) -> float:
        """How many times smaller the figure became: |before| / |after|; infinite if nothing is left."""
        before, after = abs(self.before.value), abs(self.after.value)
        if after == 0.0:
            return 1.0 if before == 0.0 else math.inf
        return before / after

    @property
    def u_factor(self) -> float:
        """Standard uncertainty of the factor, to first order; nan if unknown."""
        before, after = abs(self.before.value), abs(self.after.value)
        if before == 0.0 or after == 0.0:
            return math.nan
        return self.factor * math.hypot(self.before.u / before, self.after.u / after)

    @property
    def gain(self) -> float:
        """|before| - |after|, um or urad."""
        return abs(self.before.value) - abs(self.after.value)

    @property
    def en(self) -> float:
        """E_n number (ISO/IEC 17043): |gain| over the root sum of squares of both expanded uncertainties."""
        joint = np.hypot(self.before.expanded, self.after.expanded)
        return float(normalized_error(np.asarray(self.gain), joint))

    @property
    def separated(self) -> bool:
        """Whether the intervals value +/- U of both do not overlap; E_n is then above 1."""
        return abs(self.gain) > self.before.expanded + self.after.expanded

    @property
    def verdict(self) -> Verdict:
        """Return "better" or "worse" only if the intervals do not overlap; without uncertainties "smaller", "larger", "same"."""
        if math.isnan(self.en):
            return "same" if self.gain == 0.0 else "smaller" if self.gain > 0.0 else "larger"
        if not self.separated:
            return "not separated"
        return "better" if self.gain > 0.0 else "worse"

    def summary(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "before": self.before.summary(),
            "after": self.after.summary(),
            "factor": self.factor,
            "u_factor": self.u_factor,
            "en": self.en,
            "verdict": self.verdict,
        }


# Fields of position errors: how they are aligned, and the figures of a volume with their uncertainty.
#
# Every figure is linearised in the field: sum(weight * error) over a few points. Its uncertainty is that of this linear
# functional, from the joint covariance of the data behind the field, alignment included.


#: Standard uncertainty (mm) of sum(weight * error) for weights (n, 3); nan if unknown.
Spread = Callable[[FloatArray], float]
Alignment = Literal["as-given", "axes", "best-fit"]

_SAME_MM = 1e-6


@dataclass(frozen=True)
class ErrorField:
    """Position errors (n, 3) of the tool tip at commanded positions (n, 3), mm, and their uncertainty.

    ``tip_mm`` is where the tip should be (position and tool offset), (n, 3); rigid rotations are about it.
    ``alignment`` says in words what was removed.
    """

    position_mm: FloatArray
    tip_mm: FloatArray
    error_mm: FloatArray
    spread: Spread
    alignment: str = "as given"

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)

    def at_rows(self, rows: NDArray[np.int64]) -> ErrorField:
        """Return the field at some of its points; their uncertainty is still that of the whole field."""

        def spread(weight: FloatArray) -> float:
            full = np.zeros_like(self.error_mm)
            full[rows] = weight
            return self.spread(full)

        return ErrorField(self.position_mm[rows], self.tip_mm[rows], self.error_mm[rows], spread, self.alignment)

    def thinned(self, most: int) -> ErrorField:
        """Return at most ``most`` points, evenly from first to last."""
        if len(self) <= most:
            return self
        return self.at_rows(np.unique(np.round(np.linspace(0, len(self) - 1, most)).astype(np.int64)))


def unknown_spread(_: FloatArray) -> float:
    """Spread of a field whose uncertainty is unknown."""
    return math.nan


def independent_spread(u_mm: FloatArray) -> Spread:
    """Spread of errors whose components have independent standard uncertainties (n, 3), mm."""

    def spread(weight: FloatArray) -> float:
        used = weight != 0.0
        return math.sqrt(float(np.sum((weight[used] * u_mm[used]) ** 2)))

    return spread


def _without(field: ErrorField, motion: SmallMotion, error_mm: FloatArray, text: str) -> ErrorField:
    """Field with ``error_mm``, of which a rigid motion was taken out: to first order ``motion``."""

    def spread(weight: FloatArray) -> float:
        return field.spread(motion.taken_out_of_weights(weight))

    return replace(field, error_mm=error_mm, spread=spread, alignment=text)


def aligned(machine: Machine, field: ErrorField, alignment: Alignment) -> ErrorField:
    """Return the field in the stated alignment.

    Parameters
    ----------
    machine : its reference point and squareness reference say which axis lines the alignment ``"axes"`` uses.
    field : any field; for ``"axes"`` it must contain the reference point and the ends of the lines through it.
    alignment : ``"as-given"``; ``"axes"``: zero at the reference point, primary axis X (Y if it is the squareness
        reference) and secondary axis Y (X) straight between their ends; ``"best-fit"``: the best rigid motion (least
        squares over all points, finite rotation) is removed.
    """
    if alignment == "as-given":
        return field
    if alignment == "axes":
        return _to_axes(machine, field)
    error = without_rigid_motion(field.tip_mm, field.error_mm)
    return _without(field, small_motion(field.tip_mm), error, "best-fit rigid motion removed (least squares)")


def axis_lines(machine: Machine) -> FloatArray:
    """Reference point, then lower and upper end of the X and of the Y line through it, shape (5, 3), mm."""
    points = np.tile(np.array(machine.reference_point_mm), (5, 1))
    for axis in range(2):
        points[1 + 2 * axis, axis], points[2 + 2 * axis, axis] = machine.axes[axis].range_mm
    return points


def _to_axes(machine: Machine, field: ErrorField) -> ErrorField:
    rows = []
    for point in axis_lines(machine):
        distance = np.max(np.abs(field.position_mm - point), axis=1)
        rows.append(int(np.argmin(distance)))
        if distance[rows[-1]] > _SAME_MM:
            where = ", ".join(f"{value:g}" for value in point)
            raise InputError(
                Message(
                    "alignment-point-missing",
                    "the alignment to the axes needs the point ({where}) mm, which is missing; use "
                    "--alignment as-given or best-fit",
                    where=where,
                )
            )
    parameters = np.zeros((6, len(field), 3))
    first, second = (0, 1) if machine.squareness_reference == "X" else (1, 0)
    for axis, other in ((first, True), (second, False)):
        low, high = rows[1 + 2 * axis], rows[2 + 2 * axis]
        length = machine.axes[axis].length_mm
        across = 1 - axis
        sign = 1.0 if axis == 0 else -1.0
        for row, side in ((low, -1.0), (high, 1.0)):
            if other:  # the primary axis fixes the rotation about z
                parameters[5, row, across] += side * sign / length
            parameters[3 + across, row, 2] -= side * sign / length  # dz along x: -B; dz along y: +A
    fields = rigid_fields(field.tip_mm)
    rotation = parameters[3:].copy()
    parameters[:3, rows[0]] = np.eye(3)
    parameters[:3] -= np.einsum("ij,jnk->ink", fields.reshape(-1, 3, 6)[rows[0]][:, 3:], rotation)
    motion = SmallMotion(fields, parameters.reshape(6, -1))
    names = ("X", "Y")
    text = (
        f"primary axis {names[first]}, secondary axis {names[second]}, end-point lines through the reference point "
        "(zero there)"
    )
    return _without(field, motion, motion.taken_out(field.error_mm), text)


def volume_figures(field: ErrorField, pairs: ErrorField | None = None) -> dict[str, Figure]:
    """Return the figures of a volume: ISO 230-1 ranges V_X, V_Y, V_Z, and non-standard ones, labelled as such.

    Parameters
    ----------
    field : the errors over the volume, aligned.
    pairs : a smaller set of points among which the largest length error is searched; default: the field itself.
    """
    where = f"over {len(field)} points, {field.alignment}"
    found = {}
    for k, axis in enumerate("XYZ"):
        meaning = f"volumetric accuracy V_{axis}: range of the {axis} deviation {where}; ISO 230-1"
        along, weight = field.error_mm[:, k], np.zeros_like(field.error_mm)
        weight[:, k] = range_weight(along)
        found[f"V_{axis}"] = Figure.of_mm(np.ptp(along), field.spread(weight), meaning)
    size = np.linalg.norm(field.error_mm, axis=1)
    largest, rms, p95 = sizes_of(size)
    worst = int(np.argmax(size))
    found["max"] = _figure(
        field, largest, _at(field, worst), f"largest length of the error vector {where}; not a standard figure"
    )
    weight = field.error_mm / (len(field) * rms) if rms else np.zeros_like(field.error_mm)
    found["rms"] = _figure(field, rms, weight, f"root mean square of the error vector {where}; not a standard figure")
    near = int(np.argmin(np.abs(size - p95)))
    found["p95"] = _figure(
        field, p95, _at(field, near), f"95th percentile of its length {where}; not a standard figure"
    )
    return found | _between(pairs or field)


def range_weight(value: FloatArray) -> FloatArray:
    """Derivative (n,) of the range of values (n,): +1 at the largest, -1 at the smallest."""
    weight = np.zeros(len(value))
    weight[int(np.argmax(value))] += 1.0
    weight[int(np.argmin(value))] -= 1.0
    return weight


def _figure(field: ErrorField, value_mm: float, weight: FloatArray, meaning: str) -> Figure:
    return Figure.of_mm(value_mm, field.spread(weight), meaning)


def _at(field: ErrorField, row: int, toward: FloatArray | None = None) -> FloatArray:
    """Return the weights that give the length of the error at one point, or its part along ``toward`` (3,)."""
    weight = np.zeros_like(field.error_mm)
    vector = field.error_mm[row] if toward is None else toward
    size = float(np.linalg.norm(vector))
    weight[row] = vector / size if size else np.full(3, 1.0 / math.sqrt(3.0))
    return weight


def _between(field: ErrorField) -> dict[str, Figure]:
    """Return the largest difference of two error vectors, and the largest error of a length between two points."""
    difference, length = _largest_pairs(field)
    where = f"any two of {len(field)} points"
    i, j = difference
    apart = field.error_mm[i] - field.error_mm[j]
    weight = _at(field, i, apart) - _at(field, j, apart)
    found = {
        "difference": _figure(
            field,
            float(np.linalg.norm(apart)),
            weight,
            f"largest difference of the error vectors of {where}; not a standard figure",
        )
    }
    i, j = length
    line, apart = field.tip_mm[i] - field.tip_mm[j], field.error_mm[i] - field.error_mm[j]
    value = float(np.linalg.norm(line + apart) - np.linalg.norm(line))
    weight = (_at(field, i, line) - _at(field, j, line)) * (1.0 if value >= 0 else -1.0)
    ends = f"({_place(field, i)}) and ({_place(field, j)}) mm"
    found["length"] = _figure(
        field, abs(value), weight, f"largest error of the distance between {where}, here {ends}; not a standard figure"
    )
    return found


def _place(field: ErrorField, row: int) -> str:
    return ", ".join(f"{value:.6g}" for value in field.position_mm[row])


#: Share of the largest value that rounding of products may take away; distances of this share of the volume are none.
_ROUNDING, _NO_DISTANCE = 1e-6, 1e-6


def _largest_pairs(field: ErrorField, block: int = 64) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the rows of the pair with the largest difference of vectors, and of the pair with the largest length error.

    With a = ``apart`` and l = ``line`` of a pair, products of matrices give a.a, l.l and l.a of all pairs at once:
    (u_i - u_j).(v_i - v_j) = u_i.v_i + u_j.v_j - u_i.v_j - v_i.u_j. These differences lose digits, so the pairs that may
    be the largest are then evaluated from their coordinates.
    """
    tip, error = field.tip_mm - field.tip_mm.mean(axis=0), field.error_mm - field.error_mm.mean(axis=0)
    sides = []
    for u, v in ((error, error), (tip, tip), (tip, error)):
        own, ones = np.einsum("ij,ij->i", u, v), np.ones(len(u))
        sides.append((np.column_stack([own, ones, -u, -v]), np.vstack([ones, own, v.T, u.T])))
    none = (_NO_DISTANCE * float(np.abs(tip).max())) ** 2
    largest, rows = [0.0, 0.0], ([np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)])
    for part in blocks(len(tip), block):
        squares, before, gain = (left[part] @ right[:, part.start :] for left, right in sides)
        gain = 2.0 * gain + squares  # |l + a|^2 - |l|^2, hence |l + a| - |l| = gain / (|l + a| + |l|)
        beside, before = before <= none, np.maximum(before, none)
        sizes = np.abs(gain) / (np.sqrt(np.maximum(before + gain, 0.0)) + np.sqrt(before))
        sizes[beside] = 0.0  # not known so well: to be evaluated
        for k, (values, unknown) in enumerate(((squares, False), (sizes, beside))):
            largest[k] = max(largest[k], float(values.max()))
            chosen = np.flatnonzero((values > (1.0 - _ROUNDING) * largest[k]) | unknown)
            i, j = np.divmod(chosen, values.shape[1])
            rows[k].append(part.start + np.stack([i, j], axis=1)[j > i])
    found = [(0, 0), (0, 0)]
    for k, pairs in enumerate(np.concatenate(some) for some in rows):
        apart, line = (values[pairs[:, 0]].T - values[pairs[:, 1]].T for values in (field.error_mm, field.tip_mm))
        squares, before, after, gain = (
            u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
            for u, v in ((apart, apart), (line, line), (line + apart, line + apart), (line, apart))
        )
        gain, lengths = 2.0 * gain + squares, np.sqrt(before) + np.sqrt(after)
        sizes = np.abs(np.divide(gain, lengths, out=np.zeros_like(gain), where=lengths > 0.0))
        if len(pairs):
            i, j = pairs[int(np.argmax((squares, sizes)[k]))]
            found[k] = int(i), int(j)
    return found[0], found[1]


# Errors of a machine with their uncertainty, if known, as a source of fields at any points.


#: What tables of a control add to the command at points, (n, 3), mm.
Correction = Callable[[Points], FloatArray]


#: Draws of the errors where what is not known of them is as large as they are, and the seed of these.
DRAWS, DRAW_SEED = 128, 20_261_124


@dataclass(frozen=True)
class ErrorSource:
    """Errors of a machine; ``factor`` (k, r) has F F^T as the covariance of the k values in the order of the table.

    ``factor`` is None if the uncertainty is unknown. ``correction`` is what active tables add: the field is then that
    of the machine with them. ``exact`` uses the exact model, for fields that are compared with measured ones; so does a
    correction. ``given`` is what was measured, None for all of the table: of other errors, and between and beyond the
    positions measured, the table has what a prior says. ``given_factor`` is the factor of its own values. ``assumed`` are
    sentences on the prior; ``undetermined`` says that figures need draws, since what is not known is not small beside them.
    """

    machine: Machine
    errors: ErrorTable
    factor: FloatArray | None = None
    correction: Correction | None = None
    exact: bool = False
    given: ErrorTable | None = None
    given_factor: FloatArray | None = None
    assumed: tuple[str, ...] = ()
    undetermined: bool = False

    @property
    def measured(self) -> ErrorSource:
        """The same source with what was measured alone, and the uncertainty of that."""
        if self.given is None:
            return self
        return ErrorSource(self.machine, self.given, self.given_factor, self.correction, self.exact)

    @property
    def shown(self) -> ErrorTable:
        """The errors that were measured, at the positions where they were; values and uncertainties of the source."""
        if self.given is None:
            return self.errors
        curves = {}
        for name, curve in self.given.curves.items():
            whole, at_mm = self.errors.curves[name], curve.position_mm
            curves[name] = Curve(at_mm, whole.at(at_mm), np.interp(at_mm, whole.position_mm, whole.u))
        squareness = {name: self.errors.squareness[name] for name in self.given.squareness}
        return ErrorTable(curves, squareness, self.errors.metadata)

    def drawn(self, count: int = DRAWS) -> Iterator[ErrorSource]:
        """Yield machines that the measurement and the prior allow: the same source with errors drawn from their covariance."""
        if self.factor is None:
            return
        random, values = np.random.default_rng(DRAW_SEED), self.errors.values()
        for _ in range(count):
            moved = values + self.factor @ random.standard_normal(self.factor.shape[1])
            yield replace(self, errors=self.errors.with_values(moved), factor=None)

    @property
    def known(self) -> bool:
        """Whether the uncertainty is known."""
        return self.factor is not None

    def field(self, position_mm: FloatArray) -> ErrorField:
        """Return the errors of the tip at positions (n, 3) with the machine's tool; uncertainties to first order."""
        return self.fields([position_mm])[0]

    def fields(self, lines_mm: Sequence[FloatArray]) -> list[ErrorField]:
        """Return the fields at several sets of positions, each (n, 3), evaluated together."""
        position_mm, tool = np.concatenate(lines_mm), tool_of(self.machine, None)
        if self.correction is None:
            model = exact_error if self.exact else volumetric_error
            error = model(self.machine, self.errors, position_mm)
        else:  # looked up at the commanded position, as controls do
            added = self.correction(Points(position_mm))
            error = exact_error(self.machine, self.errors, position_mm + added) + added
        parts = np.split(error, np.cumsum([len(line) for line in lines_mm])[:-1])
        lines = zip(lines_mm, parts, strict=True)
        return [ErrorField(line, line + tool, part, self._spread(line)) for line, part in lines]

    def _spread(self, position_mm: FloatArray) -> Spread:
        if self.factor is None:
            return unknown_spread

        def spread(weight: FloatArray) -> float:
            # derivative (k,) of sum(weight * E) over points by the values of the table; E = C P is linear in them
            used = np.any(weight != 0.0, axis=1)
            position, given = position_mm[used], np.ascontiguousarray(weight[used].T)
            through, tool = np.zeros((len(ERRORS), len(position))), tool_of(self.machine, None)
            for part in coefficients(self.machine.chain, self.machine.squareness_reference):
                through[ERROR_INDEX[part.error]] += part.sign * factor(part.lever, position, tool) * given[part.output]
            gradient = np.empty(len(self.errors.values()))
            for name, rows in self.errors.rows().items():
                column = through[ERROR_INDEX[name]]
                if name in SQUARENESS_NAMES:
                    gradient[rows] = column.sum()
                else:
                    nodes = self.errors.curves[name].position_mm
                    gradient[rows] = column @ hat_matrix(nodes, position[:, error_named(name).axis])
            return self.u_of(gradient)

        return spread

    def value_gradient(self, name: str, weight: FloatArray) -> FloatArray:
        """Derivative (k,) of sum(weight * values of one error), at the positions where it was measured."""
        gradient = np.zeros(len(self.errors.values()))
        if self.given is not None and name in self.given.curves:
            weight = weight @ hat_matrix(self.errors.curves[name].position_mm, self.given.curves[name].position_mm)
        gradient[self.errors.rows()[name]] = weight
        return gradient

    def u_of(self, gradient: FloatArray) -> float:
        """Standard uncertainty of a functional of the values with derivative (k,); nan if it is not known."""
        if self.factor is None:
            return math.nan
        return float(np.linalg.norm(gradient @ self.factor))


def error_source(
    machine: Machine,
    errors: ErrorTable,
    covariance: Covariance | None = None,
    correction: Correction | None = None,
    *,
    prior: bool = True,
    posterior: Posterior | None = None,
) -> ErrorSource:
    """Return a source: the errors of the table, and of all others what the prior of the machine says of them.

    The uncertainty is known only if every value of the table has one. Without a covariance its values are independent.

    Parameters
    ----------
    machine, errors, covariance : the errors, and their joint covariance if there is one.
    correction : what active tables add.
    prior : False leaves the source with the errors of the table alone, and the uncertainties of their values.
    posterior : of all errors, where it is known already.
    """
    known = covariance_or_independent(errors, covariance)
    plain = ErrorSource(machine, errors, None if known is None else known.errors_factor, correction)
    if not prior or known is None:
        return plain
    found = posterior or posterior_with(machine, errors, covariance)
    return plain if found is None else _completed(plain, found)


def _completed(source: ErrorSource, found: Posterior) -> ErrorSource:
    """Source with all errors of a machine: values as given, the rest from the posterior, all with its uncertainty.

    Curves get the levels of the posterior as nodes, so that their uncertainty is that between and beyond the readings.
    Errors that one tool does not show stay as they are.
    """
    errors = source.errors
    curves, squareness = dict(errors.curves), dict(errors.squareness)
    at_mm: dict[str, FloatArray] = {}
    for name in found.names:
        if name in SQUARENESS_NAMES:
            at_mm[name] = np.full(1, np.nan)
            if name not in squareness:
                mean = found.curve(name, np.zeros(1))
                squareness[name] = float(mean.value[0]), float(mean.u[0])
            continue
        own, levels = curves.get(name), found.machine.axes[error_named(name).axis].nodes_mm
        if own is not None:
            apart = np.abs(levels[:, None] - own.position_mm[None, :]).min(axis=1) > _SAME_MM
            levels = np.sort(np.concatenate([own.position_mm, levels[apart]]))
        at_mm[name], mean = levels, found.curve(name, levels)
        curves[name] = mean if own is None else Curve(levels, own.at(levels), mean.u)
    table = ErrorTable(curves, squareness, errors.metadata)
    names = [name for name in table.names if name in at_mm]
    of_posterior, rows = found.values_factor(names, [at_mm[name] for name in names]), table.rows()
    kept = [name for name in table.names if name not in at_mm]
    beside = sum(rows[name].stop - rows[name].start for name in kept)
    factor = np.zeros((len(table.values()), of_posterior.shape[1] + beside))
    first, column = 0, of_posterior.shape[1]
    u = table.uncertainties()
    for name in table.names:
        count = rows[name].stop - rows[name].start
        if name in at_mm:
            factor[rows[name], : of_posterior.shape[1]] = of_posterior[first : first + count]
            first += count
        else:
            factor[rows[name], column : column + count] = np.diag(u[rows[name]])
            column += count
    shown = set(found.determined)
    said = [assumed_text(found), worse_text(found)]
    return replace(
        source,
        errors=table.with_values(u=np.linalg.norm(factor, axis=1)),
        factor=factor,
        given=errors,
        given_factor=source.factor,
        assumed=tuple(text for text in said if text),
        undetermined=not set(found.names) <= shown,
    )


def grid_points(machine: Machine, levels_mm: tuple[FloatArray, ...]) -> FloatArray:
    """Return points (n, 3) of a full grid, plus the points for the alignment to the axes if they are missing."""
    grid = full_grid(levels_mm).reshape(-1, 3)
    extra = [p for p in axis_lines(machine) if np.max(np.abs(grid - p), axis=1).min() > 1e-6]
    return np.concatenate([grid, np.array(extra)]) if extra else grid
