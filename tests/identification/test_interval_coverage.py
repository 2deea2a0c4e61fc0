"""The 95 % intervals of identify contain the truth: a small run of ``benchmarks/interval_coverage.py``."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "interval_coverage.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("interval_coverage", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_95_percent_intervals_hold_the_truth_in_93_to_97_percent(benchmark):
    machines = 20
    result = benchmark.coverage(machines, seed=4)
    assert 0.93 < result.overall < 0.97
    assert result.rejected == 0
    assert np.mean(result.chi_square) == pytest.approx(1.0, abs=0.03)
    # values of one identification are correlated: each machine counts as two independent values of each kind
    limit = 3.0 * np.sqrt(0.95 * 0.05 / (2 * machines))
    for kind, share in result.by_kind.items():
        assert abs(share - 0.95) < limit, kind


def test_the_table_names_every_kind(benchmark):
    text = benchmark.table(benchmark.coverage(machines=2, seed=3))
    assert all(kind in text for kind in benchmark.KINDS)
