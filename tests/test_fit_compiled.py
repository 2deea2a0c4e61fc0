"""The compiled solution of banded systems against LAPACK's."""

import numpy as np
import pytest
from scipy.linalg import solveh_banded

from compgen.fit.stacked import lower_band


@pytest.mark.parametrize("n", [2, 3, 4, 50, 1001])
def test_the_loop_solves_what_lapack_solves(n):
    pytest.importorskip("numba")
    from compgen.fit.compiled import band_solver

    rng = np.random.default_rng(n)
    band = lower_band(n)
    band[0], band[1], band[2] = 6.0 + rng.uniform(0, 2, n), rng.uniform(-1, 1, n), rng.uniform(-1, 1, n)
    band[1, n - 1 :] = band[2, max(n - 2, 0) :] = 0.0
    pull, found = rng.normal(size=n), np.empty(n)
    expected = solveh_banded(np.array(band)[: min(n, 3)], pull, lower=True)
    assert band_solver()(band, pull, found)
    assert np.abs(found - expected).max() <= 1e-13


def test_a_matrix_that_is_not_positive_definite_is_said():
    pytest.importorskip("numba")
    from compgen.fit.compiled import band_solver

    band = lower_band(3)
    band[:] = 0.0
    band[0] = 1.0, -1.0, 1.0
    assert not band_solver()(band, np.ones(3), np.empty(3))
