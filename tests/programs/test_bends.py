"""The bound of the bend of a move against the exact error at many points of it."""

import numpy as np
import pytest
from programs.make import mill

from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.kinematics import exact_error
from compgen.programs import model_of
from compgen.programs.bends import Bends


def errors_of(seed, nodes):
    """All errors of three axes with uneven nodes, up to 100 um and 100 urad."""
    r = np.random.default_rng(seed)
    curves = {}
    for axis in "XYZ":
        for kind in "XYZABC":
            at = np.unique(np.round(r.uniform(-500, 500, nodes), 3))
            value = r.uniform(-1e-4, 1e-4, len(at)) * (1.0 if kind in "ABC" else 1e3)
            curves[f"E{kind}{axis}"] = Curve(at, value, np.zeros(len(at)))
    return ErrorTable(curves, squareness={"EC0Y": (3e-4, 0.0), "EA0Z": (-2e-4, 0.0)})


def lines(seed, count):
    r = np.random.default_rng(seed)
    start = r.uniform(-400, 150, (count, 3))
    return start, np.clip(start + r.normal(size=(count, 3)) * 10 ** r.uniform(-1, 2.3, (count, 1)), -400, 200)


def off_chord(error, start, end):
    """Largest distance of the error from the chord of its ends, at 200 points of each line."""
    share = np.linspace(0.0, 1.0, 201)
    points = start[:, None] + share[None, :, None] * (end - start)[:, None]
    found = error(points.reshape(-1, 3)).reshape(points.shape)
    chord = found[:, :1] + share[None, :, None] * (found[:, -1:] - found[:, :1])
    return np.linalg.norm(found - chord, axis=2).max(axis=1)


@pytest.mark.parametrize("nodes", [2, 5, 60])
def test_the_error_is_within_the_bound_of_its_chord(nodes):
    machine, errors = mill(), errors_of(nodes, nodes)
    start, end = lines(7, 400)
    bends = Bends.of(errors, None, model_of(machine, errors, None).lever_mm)
    way = np.abs(end - start)
    parts = bends.parts(np.minimum(start, end), np.maximum(start, end), way, np.linalg.norm(way, axis=1))
    off = off_chord(lambda at: exact_error(machine, errors, at), start, end)
    assert (off <= parts[0] + parts[1]).all()
    assert off.max() > 0.02  # the errors do bend


def test_a_line_across_one_node_bends_by_a_quarter_of_its_jump_of_slope():
    """By hand: EYX rises by 10 um to X 0 and falls by 10 um behind: slopes +-0.1 um/mm. A line of 40 mm about the node: 2 um."""
    errors = ErrorTable({"EYX": Curve(np.array([-100.0, 0.0, 100.0]), np.array([0.0, 0.01, 0.0]), np.zeros(3))})
    bends = Bends.of(errors, None, 1000.0)
    low, high, way = (
        np.array([[-20.0, 5, 5], [1, 5, 5]]),
        np.array([[20.0, 5, 5], [41, 5, 5]]),
        np.array([[40.0, 0, 0]] * 2),
    )
    nodes, levers = bends.parts(low, high, way, np.array([40.0, 40.0]))
    assert nodes == pytest.approx([1.1 * 2e-3, 0.0])
    assert levers.tolist() == [0.0, 0.0]
    off = off_chord(lambda at: exact_error(mill(), errors, at), low, high)
    assert off == pytest.approx([2e-3, 0.0], abs=1e-9)


def test_curves_of_reversal_bend_as_well():
    reversal = ReversalCurves({(0, 1): Curve(np.array([-100.0, 0.0, 100.0]), np.array([0.0, 0.02, 0.0]), np.zeros(3))})
    low, high = np.array([[-20.0, 5, 5]]), np.array([[20.0, 5, 5]])
    nodes, _ = Bends.of(ErrorTable(), reversal, 1000.0).parts(low, high, high - low, np.array([40.0]))
    assert nodes == pytest.approx([1.1 * 2e-3])
    off = off_chord(lambda at: reversal.displacement(at, np.ones(at.shape)), low, high)
    assert off == pytest.approx([2e-3])
