"""Sampling: draws have the covariance they come from, and re-identification shows the stated uncertainties."""

from dataclasses import replace

import numpy as np
import pytest

from compgen.data.lengths import read_lengths
from compgen.data.machine import read_machine
from compgen.errors import InputError
from compgen.identification import identify, joint_covariance
from compgen.identification.monte_carlo import sample_errors, self_check


@pytest.fixture(scope="module")
def case(small_machine_file, small_lengths_file):
    machine, lengths = read_machine(small_machine_file), read_lengths(small_lengths_file)
    return machine, lengths, identify(machine, lengths)


def test_draws_have_the_covariance_and_are_reproduced_by_the_seed(case):
    covariance = joint_covariance(case[2])
    draws = sample_errors(covariance, 20_000, seed=3)
    assert np.array_equal(draws, sample_errors(covariance, 20_000, seed=3))
    expected = covariance.errors_covariance
    root = np.sqrt(np.maximum(np.diag(expected), 1e-30))
    moving = np.diag(expected) > 0
    correlation = (expected / root / root[:, None])[np.ix_(moving, moving)]
    found = np.corrcoef(draws[:, moving].T)
    assert np.max(np.abs(found - correlation)) < 5 / np.sqrt(20_000)
    assert np.allclose(draws.std(axis=0)[moving] / root[moving], 1.0, atol=5 / np.sqrt(40_000))


def test_reidentification_shows_the_stated_uncertainties(case):
    found = self_check(*case, replicates=60, seed=1)
    assert found.agrees
    assert found.ratio_median == pytest.approx(1.0, abs=0.1)
    assert found.summary()["replicates"] == 60


def test_a_wrong_uncertainty_does_not_agree(case):
    machine, lengths, result = case
    doubled = {
        name: type(curve)(curve.position_mm, curve.value, 2 * curve.u) for name, curve in result.errors.curves.items()
    }
    boast = replace(result, errors=result.errors.replace(curves=doubled))
    assert not self_check(machine, lengths, boast, replicates=30, seed=1).agrees


def test_too_few_replicates_are_refused(case):
    with pytest.raises(InputError, match="at least 10"):
        self_check(*case, replicates=3)
