"""The best tables that a control can express: least squares of its basis against the required correction field.

The required correction c*(p) brings the exact machine to the commanded position: tip(p + c*(p)) = p + tool offset. It
contains what a first-order model leaves out, e.g. the 4 um over a metre that come with a squareness of 2.9 mrad.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache, wraps
from typing import Any, TypeVar

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from compgen.controls.shared.base import Term
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, eliminated, hat_entries, hat_matrix
from compgen.data.lengths import Points
from compgen.data.machine import Machine, Vector3
from compgen.errors import ConvergenceError
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.kernel_switch import kernel_choice, lapack
from compgen.kinematics.many_points import VolumeGrid, volume_sample

#: Where the volume leaves a choice, values stay at their start at the positions ``Term.keep_mm``; where even that
#: leaves one, everywhere. Both weights are far below that of any data (the normal matrix has unit diagonal).
KEEP = 1e-7
RIDGE = 1e-11
#: An end interval of a table with less than this share within the travel says too little about the node outside.
LEAST_SHARE = 0.5
#: Iterations for a control whose correction is not the sum of its tables: 1e-3 rad in the first are 1e-9 after three.
APPLIED_STEPS = 3
#: Fields that move the tip by less than this are rounding.
NOTHING_MM = 1e-12
#: Results at more points are not kept.
MOST_KEPT = 50_000
#: Up to so many fields are summed one by one, more by a matrix product unless the matrix has more entries than that.
_FEW, _LARGEST_HAT = 3, 4_000_000

Result = TypeVar("Result")
#: What a control adds to the commands: values by term, points -> (n, 3), mm.
Applied = Callable[[Mapping[str, FloatArray], Points], FloatArray]


@dataclass(frozen=True)
class _Call:
    """Arguments of a calculation; two are equal if all numbers in them are, of which ``key`` is a digest."""

    key: bytes
    machine: Machine = field(compare=False)
    errors: ErrorTable = field(compare=False)
    position_mm: FloatArray = field(compare=False)
    more: tuple[Any, ...] = field(compare=False)

    @classmethod
    def of(cls, machine: Machine, errors: ErrorTable, position_mm: FloatArray, *more: Any) -> _Call:
        """Take the digest of everything that the errors of the machine at points (n, 3) depend on, and of ``more``.

        A :class:`Projector` among ``more`` has a digest of its own.
        """
        geometry = machine.reference_point_mm, [axis.range_mm for axis in machine.axes], machine.prior
        model = (machine.chain.name, machine.squareness_reference, machine.tool_offset_mm, geometry, kernel_choice())
        sizes = [(name, len(curve.position_mm)) for name, curve in errors.curves.items()]
        digest = hashlib.sha256(repr((model, sizes, dict(errors.squareness), position_mm.shape)).encode())
        for curve in errors.curves.values():
            for part in (curve.position_mm, curve.value, curve.u):
                digest.update(np.ascontiguousarray(part, dtype=np.float64).data)
        digest.update(np.ascontiguousarray(position_mm, dtype=np.float64).data)
        digest.update(pickle.dumps([item.digest if isinstance(item, Projector) else item for item in more]))
        return cls(digest.digest(), machine, errors, position_mm, more)


def kept(calculation: Callable[..., Result]) -> Callable[..., Result]:
    """Keep the last results of a calculation (machine, errors, points (n, 3), more): the next control needs them, too.

    Controls with the same nodes are exported and judged at the same points. Equal numbers are recognised, whatever
    objects hold them. The caller gets a copy.
    """

    @lru_cache(maxsize=8)
    def result_of(call: _Call) -> Result:
        return calculation(call.machine, call.errors, call.position_mm, *call.more)

    @wraps(calculation)
    def wrapper(machine: Machine, errors: ErrorTable, position_mm: FloatArray, *more: Any) -> Result:
        if len(position_mm) > MOST_KEPT:
            return calculation(machine, errors, position_mm, *more)
        while more and more[-1] is None:  # as if it were not given
            more = more[:-1]
        return copy(result_of(_Call.of(machine, errors, position_mm, *more)))

    return wrapper


#: :func:`exact_error` at commanded points.
error_at = kept(exact_error)


@kept
def wanted_correction(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Return what must be added to commands (n, 3) so that the exact machine reaches the commanded position, mm."""
    correction = np.zeros_like(position_mm)
    for _ in range(50):
        previous = correction
        moved = position_mm + previous
        correction = -exact_error(machine, errors, moved, tool_mm)
        if np.max(np.abs(correction - previous)) < 1e-10:
            return correction
    raise ConvergenceError("the errors are too large for a compensation: tip(p + c) = p has no solution by iteration")


@dataclass(frozen=True)
class FreeValues:
    """All table values (parameters,) as linear functions of the free ones x: x at ``free``, ``rows`` x at ``bound``."""

    free: NDArray[np.intp]
    bound: NDArray[np.intp]
    rows: FloatArray

    @classmethod
    def of(cls, machine: Machine, basis: Sequence[Term]) -> FreeValues:
        """Return the values that are free in the tables of a basis: not those that must be zero, or continue a line."""
        parts = []
        for term, place in placed_terms(basis):
            rows = []
            if term.axis is not None:
                if term.zero_at_mm is not None:
                    rows.append(hat_matrix(term.nodes_mm, np.array([term.zero_at_mm]))[0])
                rows += [row for row in hat_matrix(term.nodes_mm, np.array(term.zeros_mm)) if len(term.zeros_mm)]
                # nodes outside the travel that few points determine continue the line of the two inside
                nodes_mm, (low_mm, high_mm) = term.nodes_mm, machine.axes[term.axis].range_mm
                ends = ((0, 1, 2, low_mm), (-1, -2, -3, high_mm)) if len(nodes_mm) >= 3 else ()
                for node, next_node, third, end_mm in ends:
                    step = nodes_mm[next_node] - nodes_mm[node]
                    if (nodes_mm[next_node] - end_mm) / step < LEAST_SHARE:
                        ratio = (nodes_mm[node] - nodes_mm[next_node]) / (nodes_mm[next_node] - nodes_mm[third])
                        row = np.zeros(len(nodes_mm))
                        row[node], row[next_node], row[third] = 1.0, -(1.0 + ratio), ratio
                        rows.append(row)
            parts.append((place.start, *eliminated(np.array(rows), len(term.nodes_mm))))
        free = np.concatenate([first + own for first, own, _, _ in parts])
        bound = np.concatenate([np.array(own, dtype=np.intp) + first for first, _, own, _ in parts])
        combined, down, across = np.zeros((len(bound), len(free))), 0, 0
        for *_, own_rows in parts:
            height, width = own_rows.shape
            combined[down : down + height, across : across + width] = own_rows
            down, across = down + height, across + width
        return cls(free, bound, combined)

    def expand(self, x: FloatArray) -> FloatArray:
        """T x for free values (free, k): all values (parameters, k)."""
        values = np.empty((len(self.free) + len(self.bound), x.shape[1]))
        values[self.free], values[self.bound] = x, self.rows @ x
        return values

    def gather(self, g: FloatArray) -> FloatArray:
        """T^T g for quantities (parameters, k) of all values: (free, k)."""
        gathered = g[self.free]
        some = np.flatnonzero(self.rows.any(axis=0))  # few free values are neighbours of bound ones
        gathered[some] += self.rows[:, some].T @ g[self.bound]
        return gathered


@dataclass(frozen=True)
class SampledTerm:
    """A term at n sample points: two values count at each, those at ``node`` (2, n) with the shares ``share`` (2, n).

    ``place`` is that of the term in the vector of all values, ``carrier`` (3, n) its carrier, zero but for ``outputs``;
    ``hat`` says which terms have the same nodes.
    """

    place: slice
    hat: tuple[int | None, bytes]
    node: NDArray[np.int64]
    share: FloatArray
    outputs: tuple[int, ...]
    carrier: FloatArray

    @classmethod
    def of(cls, term: Term, place: slice, position_mm: FloatArray, tool_mm: FloatArray) -> SampledTerm:
        """Evaluate a term at points (n, 3) with tool offsets (3,) or (n, 3)."""
        if term.axis is None or len(term.nodes_mm) == 1:
            left, share = np.zeros(len(position_mm), dtype=np.int64), np.zeros(len(position_mm))
        else:
            left, share = hat_entries(term.nodes_mm, position_mm[:, term.axis])
        node = np.stack([left, np.minimum(left + 1, len(term.nodes_mm) - 1)])
        hat = term.axis, np.asarray(term.nodes_mm, dtype=np.float64).tobytes()
        outputs = tuple(sorted({part.output for part in term.carrier}))
        carrier = np.ascontiguousarray(term.carrier_field(position_mm, tool_mm).T)
        return cls(place, hat, node, np.stack([1.0 - share, share]), outputs, carrier)

    def gather(self, fields_mm: FloatArray, moved: Any, hats: _Hats) -> FloatArray:
        """Products of the values' fields with k fields (3, k, n), (values, k); ``moved`` (3, k): where these are not zero."""
        size = self.place.stop - self.place.start
        products = np.zeros((size, fields_mm.shape[1]))
        some = _places(np.any(moved[list(self.outputs)], axis=0))
        first, *others = self.outputs
        along = self.carrier[first] * fields_mm[first, some]
        for output in others:
            along += self.carrier[output] * fields_mm[output, some]
        hat = hats.of(self, len(along))
        if hat is not None:
            products[:, some] = hat @ along.T
        else:
            for k, one in zip(np.arange(len(moved.T))[some], along, strict=True):
                products[:, k] = np.bincount(self.node.ravel(), (self.share * one).ravel(), size)
        return products

    def take(self, values: FloatArray, fields_mm: FloatArray, hats: _Hats, least_mm: float = 0.0) -> None:
        """Subtract the fields of k sets of values (values, k) from k fields (3, k, n), if they exceed ``least_mm``."""
        some = _places(np.abs(values).max(axis=0) * np.abs(self.carrier).max() > least_mm)
        own = values.T[some]
        hat = hats.of(self, len(own))
        left, right = self.share
        along = left * own[:, self.node[0]] + right * own[:, self.node[1]] if hat is None else own @ hat
        for output in self.outputs:
            fields_mm[output, some] -= self.carrier[output] * along


def _places(chosen: Any) -> slice | NDArray[np.intp]:
    """Indices of what is chosen; a slice, of which numpy makes no copy, for all."""
    return slice(None) if chosen.all() else np.flatnonzero(chosen)


class _Hats:
    """Matrices (values, n) of the shares of terms, for one calculation: terms with the same nodes have the same."""

    def __init__(self) -> None:
        self._found: dict[tuple[int | None, bytes], FloatArray] = {}

    def of(self, term: SampledTerm, fields: int) -> FloatArray | None:
        """Return the matrix of a term, None if it would serve too few fields, or be too large."""
        size, points = term.place.stop - term.place.start, np.arange(term.carrier.shape[1])
        if fields <= _FEW or size * len(points) > _LARGEST_HAT:
            return None
        if term.hat not in self._found:
            hat = np.zeros((size, len(points)))
            hat[term.node[0], points] = term.share[0]
            hat[term.node[1], points] += term.share[1]
            self._found[term.hat] = hat
        return self._found[term.hat]


@dataclass(frozen=True)
class Projector:
    """Least squares of a basis over sample points, with the normal matrix factorised once.

    ``position_mm`` (n, 3) with ``weight`` (n,) and ``sample_tool_mm`` (3,) or (n, 3) are the sample; elsewhere the tool
    is ``tool_mm``. ``terms`` are the basis at the sample. ``freedom`` builds in the zeros at the reference point;
    ``offsets`` is 3 if a constant per axis is fitted together with the tables because the control cannot express it, 6 if
    a rotation of the whole volume is, too: for tables of shears alone, which must not take a rotation for a squareness.
    ``factor`` (free + offsets, free + offsets) is the Cholesky factor of the normal matrix with
    unit diagonal, ``scale`` what gave it that. Two with the same ``digest`` are equal but for the values in the basis.
    """

    basis: tuple[Term, ...]
    position_mm: FloatArray
    weight: FloatArray
    tool_mm: FloatArray
    sample_tool_mm: FloatArray
    terms: tuple[SampledTerm, ...]
    freedom: FreeValues
    offsets: int
    factor: FloatArray
    scale: FloatArray
    digest: bytes

    def project(self, required_mm: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """Return all table values (parameters,) whose field is closest to ``required_mm`` (n, 3)."""
        if start is None:
            return np.asarray(self.project_all(required_mm[None])[0])
        return np.asarray(start + self.project_all((required_mm - self.field(start))[None])[0])

    def project_all(self, required_mm: FloatArray) -> FloatArray:
        """Return table values (k, parameters) for k target fields (k, n, 3) at once."""
        return self._solved(np.ascontiguousarray(np.moveaxis(required_mm, 2, 0)), _Hats()).T

    def left_of(self, required_mm: FloatArray) -> FloatArray:
        """Return what the closest tables leave of k required fields (k, n, 3) at the sample points, (k, n, 3)."""
        left, hats = np.ascontiguousarray(np.moveaxis(required_mm, 2, 0)), _Hats()
        values = self._solved(left, hats)  # a constant per axis is left to whoever asks
        for term in self.terms:
            term.take(values[term.place], left, hats, NOTHING_MM)
        return np.moveaxis(left, 0, 2)

    def _solved(self, required_mm: FloatArray, hats: _Hats) -> FloatArray:
        """All table values (parameters, k) for k required fields (3, k, n)."""
        counting, moved = required_mm * self.weight, np.any(required_mm, axis=2)
        right = self.freedom.gather(np.concatenate([term.gather(counting, moved, hats) for term in self.terms]))
        if self.offsets:
            right = np.concatenate([right, counting.sum(axis=2)])
        if self.offsets > 3:
            turned = rigid_fields(self.position_mm)[3:]
            right = np.concatenate([right, np.einsum("jon,okn->jk", turned, counting)])
        solution = self.scale[:, None] * lapack().dpotrs(self.factor, right * self.scale[:, None], lower=1)[0]
        return self.freedom.expand(solution[: len(self.freedom.free)])

    def field(self, values: FloatArray, position_mm: FloatArray | None = None) -> FloatArray:
        """Return the correction field of table values at the sample points or at others, see :func:`basis_field`."""
        if position_mm is None:
            return basis_field(self.basis, values, self.position_mm, self.sample_tool_mm)
        return basis_field(self.basis, values, position_mm, self.tool_mm)

    def field_on_grid(self, values: FloatArray, grid: VolumeGrid) -> FloatArray:
        """Return the correction field of table values at the points of a grid, (n, 3): one look-up at each level."""
        fields = np.zeros((3, *grid.shape))
        levels = [part.reshape([-1 if k == axis else 1 for k in range(3)]) for axis, part in enumerate(grid.levels_mm)]
        for term, place in placed_terms(self.basis):
            curve = (
                values[place][0] if term.axis is None else np.interp(levels[term.axis], term.nodes_mm, values[place])
            )
            for output in {part.output for part in term.carrier}:
                carrier = np.zeros((1, 1, 1))
                for part in term.carrier:
                    if part.output == output:
                        lever = 1.0 if part.lever is None else [*levels, *self.tool_mm][part.lever]
                        carrier = carrier + part.sign * (lever - part.origin_mm)
                fields[output] += carrier * curve
        return np.ascontiguousarray(fields.reshape(3, -1).T)

    def by_name(self, values: FloatArray) -> dict[str, FloatArray]:
        """Split a vector of all table values by term."""
        return {term.name: values[place] for term, place in placed_terms(self.basis)}


def placed_terms(basis: Sequence[Term]) -> Iterator[tuple[Term, slice]]:
    """Yield each term of a basis with the place of its values in the vector of all values."""
    first = 0
    for term in basis:
        yield term, slice(first, first + len(term.nodes_mm))
        first += len(term.nodes_mm)


def basis_field(basis: Sequence[Term], values: FloatArray, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Return the correction field of a basis at points (n, 3), shape (n, 3), mm.

    ``values`` are those of all terms in a row; several rows (k, parameters) give as many fields (k, n, 3).
    """
    rows = np.atleast_2d(values)
    fields = np.zeros((len(rows), 3, len(position_mm)))
    places: dict[tuple[int, bytes], tuple[NDArray[np.int64], FloatArray]] = {}  # terms over an axis have the same nodes
    for term, place in placed_terms(basis):
        nodes_mm, own = np.asarray(term.nodes_mm, dtype=np.float64), rows[:, place]
        if term.axis is None or len(nodes_mm) == 1:
            along = own
        else:
            # as np.interp, to the last bit, but the interval of a point is looked up once
            nodes = term.axis, nodes_mm.tobytes()
            if nodes not in places:
                inside = np.clip(position_mm[:, term.axis], nodes_mm[0], nodes_mm[-1])
                left = np.searchsorted(nodes_mm, inside, side="right") - 1
                places[nodes] = left, inside - nodes_mm[left]
            left, beyond_mm = places[nodes]
            slope = np.diff(own) / np.diff(nodes_mm)
            along = np.hstack([slope, np.zeros((len(own), 1))]).take(left, axis=1)
            along *= beyond_mm
            along += own.take(left, axis=1)
        carriers = term.carriers(position_mm, tool_mm).items()
        for output, carrier in carriers:
            fields[:, output] += carrier * along
    fields = np.ascontiguousarray(np.moveaxis(fields, 1, 2))
    return fields if values.ndim == 2 else np.asarray(fields[0])


def rigid_fields(position_mm: FloatArray) -> FloatArray:
    """Return the displacements of points (n, 3) by 1 mm along X, Y, Z and by 1 rad about them, shape (6, 3, n), mm."""
    moved = np.repeat(np.eye(3)[:, :, None], len(position_mm), axis=2)
    turned = np.cross(np.eye(3)[:, None], position_mm[None]).swapaxes(1, 2)
    return np.concatenate([moved, turned])


def _normal_matrix(terms: Sequence[SampledTerm], weight: FloatArray) -> FloatArray:
    """Sums of the weighted products of the values' fields at points (n,), (parameters, parameters).

    Two nodes count for each term at a point, so four entries for two terms; terms with the same nodes share them.
    """
    size = terms[-1].place.stop
    normal = np.zeros((size, size))
    entries: dict[tuple[object, object], tuple[NDArray[np.int64], FloatArray]] = {}
    done: dict[tuple[object, object, bytes], tuple[slice, slice]] = {}  # e.g. EXX with EXY is as EYX with EYY
    for k, one in enumerate(terms):
        counting = weight * one.carrier
        for other in terms[k:]:
            common = [output for output in one.outputs if output in other.outputs]
            if not common:
                continue
            height, width = (part.place.stop - part.place.start for part in (one, other))
            if (one.hat, other.hat) not in entries:
                where = one.node[:, None] * width + other.node[None]
                entries[one.hat, other.hat] = where.ravel(), one.share[:, None] * other.share[None]
            product = counting[common[0]] * other.carrier[common[0]]
            for output in common[1:]:
                product += counting[output] * other.carrier[output]
            key = one.hat, other.hat, product.tobytes()
            if key not in done:
                where, share = entries[one.hat, other.hat]
                block = np.bincount(where, (share * product).ravel(), height * width).reshape(height, width)
            else:
                block = normal[done[key]]
            done.setdefault(key, (one.place, other.place))
            normal[one.place, other.place] = block
            normal[other.place, one.place] = block.T
    return normal


def projector(
    machine: Machine, basis: Sequence[Term], *, anchored: bool, tools_mm: Sequence[Vector3] = ()
) -> Projector:
    """Factorise the least-squares problem of a basis over the machine's volume.

    Parameters
    ----------
    machine : its travel is sampled at the tables' nodes and between them, its work zone by its weight.
    basis : the control's terms.
    anchored : True if the control cannot apply a constant offset per axis.
    tools_mm : every point is sampled with each of these tool offsets; by default with that of the machine file.
    """
    volume = (machine.axes[0].range_mm, machine.axes[1].range_mm, machine.axes[2].range_mm, machine.emphasis)
    about_terms = [(term.name, term.axis, term.carrier, term.zero_at_mm, term.keep_mm, term.zeros_mm) for term in basis]
    about = pickle.dumps((volume, machine.tool_offset_mm, about_terms, anchored, tools_mm))
    nodes = tuple(np.asarray(term.nodes_mm, dtype=np.float64).tobytes() for term in basis)
    found = _factorised(_Problem((about, *nodes), machine, tuple(basis), anchored, tuple(tools_mm)))
    return replace(found, basis=tuple(basis))


@dataclass(frozen=True)
class _Problem:
    """A least-squares problem; two are equal if the volume and the tables are, whatever the values of the tables."""

    key: tuple[bytes, ...]
    machine: Machine = field(compare=False)
    basis: tuple[Term, ...] = field(compare=False)
    anchored: bool = field(compare=False)
    tools_mm: tuple[Vector3, ...] = field(compare=False)


@lru_cache(maxsize=16)  # a few MB each: a run for all controls and its report reuse them
def _factorised(problem: _Problem) -> Projector:
    """Factorise once what an export, its verification and the next measurement of the machine have in common."""
    machine, basis, tools_mm = problem.machine, problem.basis, problem.tools_mm
    nodes = tuple(
        np.unique(np.concatenate([[low, high], *(term.nodes_mm for term in basis if term.axis == axis)]))
        for axis, (low, high) in enumerate(item.range_mm for item in machine.axes)
    )
    sample = volume_sample(machine, nodes, emphasis=machine.emphasis)
    position_mm, weight = sample.position_mm, sample.weight
    tool_mm = own_tool_mm = tool_of(machine, None)
    if tools_mm:
        tool_mm = np.repeat(np.array(tools_mm, dtype=np.float64), len(position_mm), axis=0)
        position_mm, weight = np.tile(position_mm, (len(tools_mm), 1)), np.tile(weight, len(tools_mm))
    terms = tuple(SampledTerm.of(term, place, position_mm, tool_mm) for term, place in placed_terms(basis))
    freedom = FreeValues.of(machine, basis)
    shears = all(term.axis is None and term.carrier[0].lever is not None for term in basis)
    free, offsets = len(freedom.free), (6 if shears else 3) if problem.anchored else 0
    normal = np.zeros((free + offsets, free + offsets))
    normal[:free, :free] = freedom.gather(freedom.gather(_normal_matrix(terms, weight)).T)
    if offsets:
        rigid = rigid_fields(position_mm)[:offsets]
        fields = weight * rigid.swapaxes(0, 1)
        moved = np.any(fields, axis=2)
        across = freedom.gather(np.concatenate([term.gather(fields, moved, _Hats()) for term in terms]))
        normal[:free, free:], normal[free:, :free] = across, across.T
        normal[free:, free:] = np.einsum("ion,n,jon->ij", rigid, weight, rigid) if offsets > 3 else 0.0
        normal[free : free + 3, free : free + 3] = weight.sum() * np.eye(3)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30 + 1e-14 * normal.diagonal().max()))
    # rows whose product with the values gives them at the positions keep_mm of every term
    blocks = []
    for term, place in placed_terms(basis):
        kept = np.zeros((len(term.keep_mm) if term.axis is not None else 0, terms[-1].place.stop))
        if len(kept):
            kept[:, place] = hat_matrix(term.nodes_mm, np.array(term.keep_mm))
        blocks.append(kept)
    rows = freedom.gather(np.vstack(blocks).T).T
    rows *= scale[:free]
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    kept_values = np.flatnonzero(rows.any(axis=0))
    regular = KEEP * rows[:, kept_values].T @ rows[:, kept_values]
    weak = np.full(free, RIDGE)  # the diagonal; few values have a position that is kept
    weak[kept_values] += np.diag(regular)
    np.fill_diagonal(regular, 0.0)
    normal *= scale[:, None]  # in place: for tables of thousands of nodes these matrices are large
    normal *= scale
    normal[np.ix_(kept_values, kept_values)] += regular
    normal[np.arange(free), np.arange(free)] += weak
    factor, failed = lapack().dpotrf(normal.T, lower=1, overwrite_a=1)  # symmetric, and in the order that needs no copy
    if failed:
        raise LinAlgError("the normal matrix of the tables is not positive definite")
    sampled = (position_mm, weight, own_tool_mm, tool_mm, terms)
    digest = hashlib.sha256(pickle.dumps(problem.key)).digest()
    return Projector(basis, *sampled, freedom, offsets, factor, scale, digest)


def synthesize(
    machine: Machine,
    errors: ErrorTable,
    basis: Sequence[Term],
    *,
    anchored: bool,
    at_axes: bool = False,
    applied: Applied | None = None,
) -> dict[str, FloatArray]:
    """Return the table values by term that come closest to the required correction over the volume.

    The machine's work zone and tools (``machine.emphasis``) set the weights. ``applied`` is the correction of a control
    that does not simply sum its tables, see :func:`best_values`.
    """
    solver = projector(machine, basis, anchored=anchored)
    return solver.by_name(best_values(machine, errors, solver, at_axes=at_axes, applied=applied))


def best_values(
    machine: Machine, errors: ErrorTable, solver: Projector, *, at_axes: bool = False, applied: Applied | None = None
) -> FloatArray:
    """Return all values (parameters,) of the best tables, over the tools of ``machine.emphasis`` if it has any.

    With ``at_axes`` the tables are looked up at the actual axis positions: they contain minus the error there, not c*.
    A control whose correction ``applied(values by term, points)`` (n, 3) is not the sum of the basis, but close to it,
    gets values for which that correction is the required one (Gauss-Newton).
    """
    if machine.emphasis.tools_mm:
        solver = projector(machine, solver.basis, anchored=bool(solver.offsets), tools_mm=machine.emphasis.tools_mm)
    sample = (solver.position_mm, solver.sample_tool_mm)
    required = -error_at(machine, errors, *sample) if at_axes else wanted_correction(machine, errors, *sample)
    start = np.concatenate([term.start for term in solver.basis])
    values = solver.project(required, start)
    if applied is not None:
        tool_mm = np.broadcast_to(solver.sample_tool_mm, solver.position_mm.shape)
        points = Points(solver.position_mm, np.array(tool_mm))
        for _ in range(APPLIED_STEPS):
            beyond = applied(solver.by_name(values), points) - solver.field(values)
            values = solver.project(required - beyond, start)
    return values
