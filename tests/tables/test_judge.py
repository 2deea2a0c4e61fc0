"""The parts of a judgement by hand: components of a field, lines along the axes, limits at single points."""

from types import SimpleNamespace

import numpy as np
import pytest

from compgen.tables.judge import components, point_reasons, residuals, rms, scan_lines
from tests.machines import machine_of

UM = 1e-3
LEVELS = (np.array([-3.0, 0.0, 1.0, 7.0]), np.array([10.0, 20.0, 60.0]), np.array([-5.0, -4.0, 2.0]))


def test_a_field_is_split_into_what_it_was_made_of():
    """Each part alone comes back under its own name; centred on the grid, parts do not leak into each other."""
    x, y, z = (level - level.mean() for level in np.meshgrid(*LEVELS, indexing="ij"))
    bent = (LEVELS[1] - 30.0) ** 2
    bent = bent - bent.mean()
    bent = bent - (LEVELS[1] - 30.0) * np.sum(bent * (LEVELS[1] - 30.0)) / np.sum((LEVELS[1] - 30.0) ** 2)
    made = {
        "Y constant": np.full(x.shape, 0.25),
        "Y linear in z": -0.5 * z,
        "Y(y)": np.broadcast_to(bent[None, :, None], x.shape),
        "Y(x,z)": 2.0 * x * z,
        "Y(x,y,z)": 0.1 * x * y * z,
    }
    field = np.zeros((x.size, 3))
    field[:, 1] = sum(made.values()).ravel()
    found = components(SimpleNamespace(shape=x.shape, levels_mm=LEVELS), field)
    assert len(found) == 3 * 11
    for name, part in found.items():
        due = made.get(name, np.zeros(x.shape))
        assert np.broadcast_to(part, x.shape) == pytest.approx(due, abs=1e-12), name
    assert rms(np.array([3.0, -4.0])) == pytest.approx(np.sqrt(12.5))


def test_the_figures_of_a_field_by_hand():
    found = residuals(np.array([[3.0, 4.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 2.0]]) * UM)
    assert found.max_um == pytest.approx(5.0)
    assert found.rms_um == pytest.approx(np.sqrt((25.0 + 1.0 + 4.0) / 3.0))
    assert (found.v_x_um, found.v_y_um, found.v_z_um) == pytest.approx((4.0, 4.0, 2.0))


def test_lines_run_at_both_ends_and_in_the_middle_and_hold_the_nodes_within_the_travel():
    ranges = ((-300.0, 500.0), (-150.0, 700.0), (-420.0, 80.0))
    nodes = (np.array([-301.0, -300.0, 0.123, 500.0, 501.0]), np.array([33.3]), np.zeros(0))
    points = scan_lines(machine_of(ranges, 5), nodes)
    assert points.min(axis=0) == pytest.approx([low for low, _ in ranges])
    assert points.max(axis=0) == pytest.approx([high for _, high in ranges])
    assert len(points) == 9 * (1002 + 1002 + 1001)
    for axis, inner in ((0, 0.123), (1, 33.3)):
        at = points[points[:, axis] == inner]
        others = [k for k in range(3) if k != axis]
        assert len(at) == 9
        for k in others:
            assert set(at[:, k]) == {ranges[k][0], 0.5 * sum(ranges[k]), ranges[k][1]}


@pytest.mark.parametrize(
    ("miss_um", "bent_um", "u_um", "resolution_um", "named"),
    [
        # best goes from 0 to 20 um: its share of 0.3 is 6 um, and that of a bent part of 10 um is 3 um
        (3.1, 10.0, 0.0, 0.0, True),
        (2.9, 10.0, 0.0, 0.0, False),
        # the smaller of both shares counts
        (5.9, 100.0, 0.0, 0.0, False),
        (6.1, 100.0, 0.0, 0.0, True),
        # never below 1 um
        (0.9, 0.0, 0.0, 0.0, False),
        (1.1, 0.0, 0.0, 0.0, True),
        # the quantum, and five standard uncertainties up to the share of the whole, come on top
        (1.4, 0.0, 0.0, 0.5, False),
        (1.6, 0.0, 0.0, 0.5, True),
        (1.9, 0.0, 0.2, 0.0, False),
        (2.1, 0.0, 0.2, 0.0, True),
        (6.9, 0.0, 90.0, 0.0, False),
        (7.1, 0.0, 90.0, 0.0, True),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limit_at_a_point_by_hand(sign, miss_um, bent_um, u_um, resolution_um, named):
    position = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0], [20.0, 21.0, 22.0]])
    best = np.zeros((3, 3))
    best[:, 1] = np.array([0.0, 10.0, 20.0]) * UM
    correction = best.copy()
    correction[1, 1] += sign * miss_um * UM
    found = point_reasons(position, correction, best, bent_um * UM, np.full(3, u_um * UM), resolution_um * UM)
    due = f"correction Y at X 10 Y 11 Z 12 mm: {10.0 + sign * miss_um:+.2f} um in the table, +10.00 um needed"
    assert found == ([due] if named else [])


def test_a_correction_that_rounds_to_zero_is_shown_without_a_minus_sign():
    best, correction = np.full((1, 3), -0.001 * UM), np.full((1, 3), 5.0 * UM)
    (x, *_) = point_reasons(np.zeros((1, 3)), correction, best, 0.0, np.zeros(3), 0.0)
    assert x.endswith("+5.00 um in the table, +0.00 um needed")
