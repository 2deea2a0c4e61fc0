"""ISO 230-4 on circles whose figures follow from their formula."""

import json

import numpy as np
import pytest

from compgen.accuracy.circularity import accuracy_of_circles
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.circles import Circles, format_circles


def circles(up_um, down_um, *, runs=1, noise_um=0.0, calibrated=False, count=720):
    """Paths by their deviation over the angle (um), about a centre that is 12 um, -7 um off."""
    rng = np.random.default_rng(5)
    rows = []
    for run in range(runs):
        for direction, path in ((1, up_um), (-1, down_um)):
            angle = np.arange(count) * 2 * np.pi / count
            value = path(angle) + 12.0 * np.cos(angle) - 7.0 * np.sin(angle) + rng.normal(0.0, noise_um, count)
            rows.append((angle, value * 1e-3, np.full(count, direction), np.full(count, run)))
    angle, value, direction, run = (np.concatenate(item) for item in zip(*rows, strict=True))
    size = len(angle)
    whole = np.zeros(size, dtype=np.int64)
    metadata = {"radius": "calibrated"} if calibrated else {}
    return Circles(whole, angle, np.full(size, 150.0), value, direction, run, whole, np.full((size, 3), np.nan),
                   np.full(size, np.nan), metadata=metadata)  # fmt: skip


def test_the_figures_of_two_ovals():
    """Up 5 cos 2t + 1, down 5 cos 2t - 2: G is 10 each, G(b) 13, H 3 everywhere."""
    found = accuracy_of_circles(
        circles(lambda t: 5 * np.cos(2 * t) + 1, lambda t: 5 * np.cos(2 * t) - 2, calibrated=True)
    ).groups["XY"]
    assert found["G_ccw"].value == pytest.approx(10.0, abs=1e-6)
    assert found["G_cw"].value == pytest.approx(10.0, abs=1e-6)
    assert found["G_b"].value == pytest.approx(13.0, abs=1e-6)
    assert found["H"].value == pytest.approx(3.0, abs=1e-6)
    assert found["F_max_ccw"].value == pytest.approx(6.0, abs=1e-6)
    assert found["F_min_cw"].value == pytest.approx(-7.0, abs=1e-6)


def test_without_a_calibrated_radius_there_is_no_radial_deviation():
    found = accuracy_of_circles(circles(np.cos, np.sin))
    assert not any(key.startswith("F") for key in found.groups["XY"])
    assert any("calibrated" in text for text in found.statements)


def test_the_uncertainty_is_that_of_the_scatter_between_runs():
    quiet = accuracy_of_circles(circles(lambda t: 5 * np.cos(2 * t), lambda t: 5 * np.cos(2 * t))).groups["XY"]
    assert np.isnan(quiet["G_ccw"].u)
    noisy = circles(lambda t: 5 * np.cos(2 * t), lambda t: 5 * np.cos(2 * t), runs=5, noise_um=1.0)
    found = accuracy_of_circles(noisy).groups["XY"]
    assert found["G_ccw"].u == pytest.approx(np.sqrt(2.0 / 5.0), rel=0.2)


def test_the_command_writes_the_figures(tmp_path, small_machine):
    path, out = tmp_path / "a.circle.csv", tmp_path / "out"
    path.write_text(format_circles(circles(lambda t: 5 * np.cos(2 * t), lambda t: 5 * np.cos(2 * t) + 1)))
    assert run_command(cli, ["accuracy", str(small_machine.source), str(path), "--out", str(out)]) == 0
    figures = json.loads((out / "accuracy.json").read_text())["figures"]["XY"]
    assert figures["G_b"]["value"] == pytest.approx(11.0, abs=1e-3)
    assert "H: largest radial difference" in (out / "accuracy.txt").read_text()
