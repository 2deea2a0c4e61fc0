"""Curves whose nodes are correlated: the covariance of the identification in place of independent uncertainties.

    (y - c)^T W (y - c) + mu |D2 c|^2,   W = u0^2 V^-1

over the free nodes, V being their covariance after zeroing. With V/u0^2 = L L^T and the singular values s of D2 L, all
that the fit needs is diagonal: the eigenvalues of the penalty against W are s^2, and the smoother is L Q (1 + mu s^2)^-1
Q^T L^-1. Dense, O(n^3) once per curve.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular, svd

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.names import CURVE_NAMES
from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.fit.held import SAME_POSITION_MM, HeldCurve
from compgen.fit.smooth import Smoother
from compgen.identify.covariance import Covariance

#: Asymmetry and negative eigenvalues up to this fraction of the largest entry are rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class CorrelatedSmoother(Smoother):
    """A smoother whose weights are a matrix.

    ``nodes`` (m,) are the free ones, ``turn`` (n, m) makes a curve of their values, ``root`` (m, m) is L, ``basis``
    (m, m) Q, ``strength`` (m,) the s^2 in ascending order.
    """

    nodes: NDArray[np.intp]
    turn: FloatArray
    root: FloatArray
    basis: FloatArray
    strength: FloatArray

    @classmethod
    def of(cls, simple: Smoother, covariance: FloatArray) -> CorrelatedSmoother:
        """Build it on the zeros and D2 of a simple smoother; ``covariance`` (n, n) is V/u0^2, positive definite."""
        nodes = np.setdiff1d(np.arange(len(simple.weight)), [node for node, _, _ in simple.steps])
        turn = simple.expand(np.eye(len(simple.weight)))[:, nodes]
        root = np.linalg.cholesky(covariance[np.ix_(nodes, nodes)])
        _, values, across = svd(simple.bend(turn) @ root, full_matrices=True)
        strength = np.zeros(len(nodes))
        strength[: len(values)] = values**2
        strength[simple.rank :] = 0.0
        order = np.argsort(strength, kind="stable")
        return cls(
            simple.weight,
            simple.rows,
            simple.steps,
            simple.free_weight,
            simple.penalty,
            nodes,
            turn,
            root,
            across.T[:, order],
            strength[order],
        )

    @property
    def eigenvalues(self) -> FloatArray:
        """Eigenvalues (m,) of the penalty against W, ascending."""
        return self.strength

    def _weighted(self, x: FloatArray) -> FloatArray:
        return np.asarray(cho_solve((self.root, True), x))

    def _scattered(self, x: FloatArray) -> FloatArray:
        out = np.zeros((len(self.weight), x.shape[1]))
        out[self.nodes] = x
        return out

    def _curves(self, turned: FloatArray, mu: float) -> FloatArray:
        """Curves (n, k) from components (m, k) along Q, each damped by its strength."""
        return np.asarray(self.turn @ (self.root @ (self.basis @ (turned / (1 + mu * self.strength)[:, None]))))

    def apply(self, mu: float, c: FloatArray) -> FloatArray:
        """A c for curves (n, k)."""
        bent = self.gather(mu * self._bend_transposed(self.bend(c)))
        return self._scattered(self._weighted(c[self.nodes])) + bent

    def inverse(self, mu: float, gathered: FloatArray) -> FloatArray:
        """Z A^-1 g for gathered right-hand sides (n, k)."""
        turned = self.basis.T @ (self.root.T @ gathered[self.nodes])
        return self._curves(turned, mu)

    def solve(self, mu: float, y: FloatArray) -> FloatArray:
        """Fitted curves (n, k) for data (n, k)."""
        white = solve_triangular(self.root, y[self.nodes], lower=True)
        return self._curves(self.basis.T @ white, mu)

    def load(self, y: FloatArray) -> FloatArray:
        """Z^T W y for data (n, k)."""
        return self._scattered(self._weighted(y[self.nodes]))

    def misfit(self, residual: FloatArray) -> float:
        """r^T W r for residuals (n,)."""
        white = solve_triangular(self.root, residual[self.nodes], lower=True)
        return float(white @ white)

    def costs(self, y: FloatArray) -> Callable[[float], tuple[float, float]]:
        """Return misfit and |D2 c|^2 as a function of mu; along Q both are sums over the components t of the data.

        With t = Q^T L^-1 y the fitted curve has the components t/(1 + mu s^2), for zeroed data.
        """
        power = (self.basis.T @ solve_triangular(self.root, y[self.nodes], lower=True)) ** 2

        def at(mu: float) -> tuple[float, float]:
            damping = 1 / (1 + mu * self.strength)
            bent = self.strength * damping
            return mu**2 * float(power @ bent**2), float(power @ (bent * damping))

        return at

    def inverse_root(self, mu: float) -> FloatArray:
        """F (n, m) with F F^T = Z A^-1 Z^T: L Q (1 + mu s^2)^-1/2."""
        return np.asarray(self.turn @ (self.root @ (self.basis / np.sqrt(1 + mu * self.strength))))

    def matrix(self, mu: float) -> sp.csc_array:
        """A (n, n) with 1 on the diagonal of eliminated unknowns."""
        full = np.eye(len(self.weight))
        bent = self.bend(self.turn)
        inner = cho_solve(cho_factor(self.root @ self.root.T), np.eye(len(self.nodes))) + mu * bent.T @ bent
        full[np.ix_(self.nodes, self.nodes)] = 0.5 * (inner + inner.T)
        return sp.csc_array(full)


def propagated(smoother: Smoother, mu: float, held: HeldCurve, covariance: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of the fitted curve for a covariance (n, n) of the input, in its unit."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    carried = smoother.solve(mu, held.zeroing @ factor)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", carried, carried)))


def curve_covariances(errors: ErrorTable, covariance: Covariance | Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Covariance (n, n) of each curve's nodes, mm and rad, checked against the table.

    ``covariance`` is that of an identification, or holds the matrices by error name; curves that it leaves out have
    independent nodes.

    Raises
    ------
    InputError
        for a name that is no curve, other nodes than the table's, or a matrix that is no covariance.
    """
    if isinstance(covariance, Covariance):
        return _blocks(errors, covariance)
    for name in covariance:
        if name not in CURVE_NAMES:
            raise InputError(f"{name!r} is not one of the 18 curves; {nearest(name, CURVE_NAMES)}", field="covariance")
    found = {name: np.asarray(covariance[name], dtype=float) for name in errors.curves if name in covariance}
    for name, matrix in found.items():
        _check(name, errors.curves[name], matrix)
    return found


def _blocks(errors: ErrorTable, covariance: Covariance) -> dict[str, FloatArray]:
    names = np.array(covariance.error)
    blocks = {}
    for name, curve in errors.curves.items():
        at = np.flatnonzero(names == name)
        if not len(at):
            continue
        same = len(at) == len(curve.position_mm)
        if not same or np.abs(covariance.position_mm[at] - curve.position_mm).max() > SAME_POSITION_MM:
            raise InputError(
                f"the covariance of {name} belongs to other nodes than those of the table; give the one that was "
                "written with it",
                field="covariance",
            )
        rows = covariance.errors_factor[at]
        blocks[name] = rows @ rows.T
    return blocks


def _check(name: str, curve: Curve, matrix: FloatArray) -> None:
    n = len(curve.position_mm)
    if matrix.shape != (n, n):
        raise InputError(f"{name} has {n} nodes and a covariance of shape {matrix.shape}; it needs ({n}, {n})")
    top = float(np.abs(matrix).max()) if np.isfinite(matrix).all() else -1.0
    if top < 0 or np.abs(matrix - matrix.T).max() > _ROUNDING * top:
        raise InputError(f"the covariance of {name} is not finite and symmetric; give that of its nodes")
    lowest = float(np.linalg.eigvalsh(matrix)[0])
    if lowest < -_ROUNDING * top * n:
        raise InputError(f"the covariance of {name} has a negative variance ({lowest:.3g}); give that of its nodes")
