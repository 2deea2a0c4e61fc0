"""The parts of a judgement by hand: components, lines and points, growth, reversal, steps and ends of tables."""

from types import SimpleNamespace

import numpy as np
import pytest

from compgen.controls import controller_named
from compgen.data.comparison import residuals, rms
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.errors import InputError
from compgen.kinematics.many_points import volume_grid
from compgen.tables.judge import (
    Judge,
    SafetyLimits,
    components,
    in_both_directions,
    judge_of,
    left_by_reversal,
    mean_correction,
    point_reasons,
    reversal_reasons,
    safety_of,
    scan_lines,
)
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
    points = np.vstack([lines.position_mm for lines in scan_lines(machine_of(ranges, 5), nodes)])
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


# --- components and growth -------------------------------------------------------------------------------------------

MACHINE = machine_of(((-300.0, 500.0), (-150.0, 250.0), (-420.0, 80.0)), 5)
GRID = volume_grid(MACHINE, tuple(axis.nodes_mm for axis in MACHINE.axes))


def judge_with(best_mm, errors=None, slack_um=0.0, resolution_um=0.0):
    """A judge of corrections on the grid alone."""
    nothing = np.zeros((0, 3))
    return Judge(
        machine=MACHINE,
        errors=errors or ErrorTable({}),
        solver=None,
        values=np.zeros(0),
        grid=GRID,
        best_mm=best_mm,
        line_mm=nothing,
        line_best_mm=nothing,
        bent_mm=0.0,
        goal_mm=0.0,
        slack_mm=np.array([0.0, 0.0, slack_um]) * UM,
        resolution_mm=resolution_um * UM,
    )


@pytest.mark.parametrize(
    ("best_um", "slack_um", "own_um", "named", "hint"),
    [
        # 0.3 of 10 um and the slack, on either side
        (10.0, 0.0, 7.1, False, ""),
        (10.0, 0.0, 6.9, True, ""),
        (10.0, 0.5, 13.4, False, ""),
        (10.0, 0.5, 13.6, True, ""),
        # never below 0.2 um
        (0.0, 0.0, 0.19, False, ""),
        (0.0, 0.0, -0.21, True, ""),
        # turned round, or nearly so
        (10.0, 0.0, -10.0, True, "; its sign is reversed"),
        (-10.0, 0.0, 9.1, True, "; its sign is reversed"),
        (-10.0, 0.0, 11.2, True, ""),
        (10.0, 0.0, 0.0, True, ""),
    ],
)
def test_the_limit_of_a_component_by_hand(best_um, slack_um, own_um, named, hint):
    best, own = np.zeros((len(GRID.position_mm), 3)), np.zeros((len(GRID.position_mm), 3))
    best[:, 2], own[:, 2] = best_um * UM, own_um * UM
    found = judge_with(best, slack_um=slack_um).component_reasons(own)
    due = (
        f"correction Z constant: {abs(own_um):.2f} um rms in the table, {abs(best_um):.2f} um rms needed, "
        f"they differ by {abs(own_um - best_um):.2f} um{hint}"
    )
    assert found == ([due] if named else [])


@pytest.mark.parametrize(("share", "named"), [(0.999, False), (1.001, True)])
def test_a_correction_may_overshoot_until_the_exact_residual_is_as_large_as_before(share, named):
    """A scale 1 + s and a correction -k x leave s (x - k x) - k x: as much as before at k = 2 s / (1 + s)."""
    s = 0.01
    wide = np.array([-2000.0, 2000.0])
    errors = ErrorTable({"EXX": Curve(wide, s * wide, np.zeros(2))})
    correction = np.zeros_like(GRID.position_mm)
    correction[:, 0] = -share * 2.0 * s / (1.0 + s) * GRID.position_mm[:, 0]
    found = judge_with(correction, errors).shrink_reasons(correction)
    x = GRID.position_mm[:, 0]
    before_um, after_um = (1e3 * abs(scale) * np.std(x) for scale in (s, s - 2.0 * s * share))
    assert [text.split("(")[0].strip() for text in found] == (
        [f"the residual does not shrink: {before_um:.2f} um rms before, {after_um:.2f} um rms after"] if named else []
    )


def test_zeros_do_not_let_the_residual_grow_and_rounding_may():
    x = GRID.position_mm[:, [0]] * [1.0, 0.0, 0.0]
    errors = ErrorTable({"EXX": Curve(np.array([-300.0, 500.0]), np.array([-3e-3, 5e-3]), np.zeros(2))})
    assert judge_with(0.0 * x, errors).shrink_reasons(0.0 * x) == []
    growth = 1e-5 * x  # nine levels 100 mm apart: 2.58 um rms on a machine without errors
    assert judge_with(growth, resolution_um=2.6).shrink_reasons(growth) == []
    assert len(judge_with(growth, resolution_um=2.5).shrink_reasons(growth)) == 1


def test_a_judge_of_a_control_counts_bends_uncertainty_and_the_nodes_of_its_tables():
    machine = MACHINE.with_setting("siemens-eec", "step_mm", {"X": 37.1})
    nodes = np.array([-300.0, -120.0, 500.0])
    errors = ErrorTable({"EXX": Curve(nodes, np.array([-0.03, 0.0, 0.05]), np.full(3, 2.0 * UM))})
    control = controller_named("siemens-eec")(machine)
    judge = judge_of(machine, control, errors)
    (own,) = (term.nodes_mm for term in control.basis(errors) if term.axis == 0)
    assert own[1] - own[0] == pytest.approx(37.1)
    assert set(own[(own > -300.0) & (own < 500.0)].round(6)) <= set(judge.line_mm[:, 0])
    assert len(np.unique(judge.line_mm[:, 1])) == 1001  # no table over Y: no node but those of its even positions
    # half of the standard uncertainty of 2 um, which is less than 0.3 of the correction, and the rounding
    assert judge.slack_mm == pytest.approx(np.array([1.0 * UM, 0.0, 0.0]) + control.resolution_mm(), abs=1e-9)
    straight = judge_of(machine, control, ErrorTable({"EXX": Curve(nodes, 1e-4 * nodes, np.zeros(3))}))
    assert straight.bent_mm < 1.0 * UM  # a slope of 80 um bends only where the last interval ends beyond the travel


# --- both directions -------------------------------------------------------------------------------------------------


def constant_reversal(value_um, axis=0, component=0):
    return ReversalCurves({(axis, component): Curve(np.zeros(1), np.array([value_um * UM]), np.zeros(1))})


def test_points_are_taken_in_both_directions_and_their_mean_is_half_of_the_sum():
    points = Points(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), np.tile([7.0, 8.0, 9.0], (2, 1)))
    both = in_both_directions(points)
    assert both.position_mm.tolist() == [*points.position_mm.tolist()] * 2
    assert both.tool_mm.tolist() == [[7.0, 8.0, 9.0]] * 4
    assert both.approach.tolist() == [[1.0] * 3] * 2 + [[-1.0] * 3] * 2
    mean = mean_correction(
        lambda at: at.position_mm + 5.0 * at.approach + at.tool_mm, points.position_mm, points.tool_mm
    )
    assert mean.tolist() == (points.position_mm + [7.0, 8.0, 9.0]).tolist()


@pytest.mark.parametrize(
    ("reversal_um", "given_um", "resolution_um", "named"),
    [
        (8.0, -8.0, 0.0, False),
        (8.0, 8.0, 0.0, True),
        (8.0, 0.0, 0.0, True),
        # 0.3 of 8 um
        (8.0, -5.7, 0.0, False),
        (8.0, -5.5, 0.0, True),
        # never below 0.2 um, and the rounding on top
        (0.0, 0.19, 0.0, False),
        (0.0, 0.21, 0.0, True),
        (0.0, 0.69, 0.5, False),
        (0.0, 0.71, 0.5, True),
    ],
)
@pytest.mark.parametrize(("axis", "component"), [(0, 0), (1, 2)])
def test_the_difference_of_the_directions_is_minus_the_reversal(
    axis, component, reversal_um, given_um, resolution_um, named
):
    seen = []

    def correction(points):
        seen.append(points.position_mm)
        moved = np.zeros((len(points), 3))
        moved[:, component] = 0.5 * given_um * UM * points.approach[:, axis]
        return moved

    found = reversal_reasons(MACHINE, correction, constant_reversal(reversal_um, axis, component), resolution_um * UM)
    assert len(found) == named
    assert all(
        f"differ by {given_um:+.2f} um between positive and negative travel, {0.0 - reversal_um:+.2f} um needed" in text
        for text in found
    )
    # each axis runs over its travel while the others stand in the middle
    for moving, position in zip((0, 0, 1, 1, 2, 2), seen, strict=True):
        for k, (low, high) in enumerate(axis.range_mm for axis in MACHINE.axes):
            expected = np.linspace(low, high, 201) if k == moving else np.full(201, 0.5 * (low + high))
            assert position[:, k] == pytest.approx(expected)


def test_a_reversal_that_no_table_takes_out_leaves_half_of_itself_on_either_side():
    assert left_by_reversal(constant_reversal(-8.0, 1, 2), corrected=False) == {"reversal Y in Z": 4.0}
    assert left_by_reversal(constant_reversal(-8.0, 1, 2), corrected=True) == {}
    assert left_by_reversal(constant_reversal(0.11), corrected=False) == {"reversal X": 0.055}
    assert left_by_reversal(constant_reversal(0.09), corrected=False) == {}


# --- steps, ends and the reference point -----------------------------------------------------------------------------

NODES = np.arange(-400.0, 601.0, 100.0)  # one beyond each end of the travel of X
SLACK_UM = 1.0  # of a control whose rounding is half of it


def safety_with(values_um, best_um=None, limit_um=None, drops=0.0):
    """Look at a table of X over X with one value per node; ``drops`` is how much of it goes beyond its ends, um."""

    def over(values):
        def correction(position_mm):
            moved = np.zeros_like(position_mm)
            moved[:, 0] = np.interp(position_mm[:, 0], NODES, np.asarray(values, dtype=float) * UM)
            return moved

        return correction

    def emulate(_, points):
        outside = (points.position_mm[:, 0] < NODES[0]) | (points.position_mm[:, 0] > NODES[-1])
        return over(values_um)(points.position_mm) - np.outer(outside, [drops * UM, 0.0, 0.0])

    control = SimpleNamespace(
        table_nodes_mm=lambda _: (NODES, np.zeros(0), np.zeros(1)),
        emulate=emulate,
        by_direction=lambda _: True,
        resolution_mm=lambda: 0.5 * SLACK_UM * UM,
    )
    best = over(np.zeros(11) if best_um is None else best_um)
    return safety_of(MACHINE, control, None, best, SafetyLimits(limit_um))


def stepped(size_um, after=5):
    """One step behind the node ``after``."""
    return np.where(np.arange(11) > after, size_um, 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("step_um", "slope_at", "unexplained"),
    [
        # 500 um and the rounding; a best table of 0.5 um/mm explains twice its slope over 100 mm, within the travel only
        (500.9, None, False),
        (501.1, None, True),
        (600.9, 1, False),
        (601.1, 1, True),
        (600.9, 8, False),
        (501.1, 0, True),
        (501.1, 9, True),
    ],
)
def test_a_step_is_absurd_beyond_what_the_slope_of_the_errors_explains(sign, step_um, slope_at, unexplained):
    best = None if slope_at is None else stepped(50.0, slope_at)
    (text,) = safety_with(sign * stepped(step_um), best).reasons
    assert text.startswith(f"correction X steps by {step_um:.1f} um between X 100 and 200 mm")
    assert ("which no slope of the machine's errors explains" in text) is unexplained


@pytest.mark.parametrize(
    ("spike_um", "elsewhere_um", "named"),
    [(10.9, 0.0, False), (11.1, 0.0, True), (19.0, 2.0, False), (21.0, 2.0, True)],
)
@pytest.mark.parametrize("at", [0, 5, 9])
def test_a_spike_is_ten_times_as_steep_as_what_does_not_touch_it(at, spike_um, elsewhere_um, named):
    """Up and down again: the two sides of a node do not excuse each other."""
    values = np.zeros(11)
    values[at + 1] = spike_um
    values[3 if at != 2 else 7] += elsewhere_um
    found = safety_with(values).reasons
    assert [": more than 10 times as steep as anywhere else" in text for text in found] == [True] * named


def test_the_largest_step_has_its_place_and_a_limit_of_the_user():
    safety = safety_with(stepped(8.0, 1), limit_um=8.1)
    (step,) = safety.steps
    assert (step.output, step.along, step.from_mm, step.to_mm) == ("X", "X", -300.0, -200.0)
    assert (step.step_um, step.slope_um_per_mm) == pytest.approx((8.0, 0.08))
    assert safety.reasons == ()
    (reason,) = safety_with(stepped(8.0, 1), limit_um=7.9).reasons
    assert reason == "correction X steps by 8.0 um between X -300 and -200 mm; the limit is 7.9 um"
    with pytest.raises(InputError, match="expected a number of um above zero"):
        SafetyLimits(0.0)


@pytest.mark.parametrize(("offset_um", "warned"), [(20.9, False), (21.1, True), (-21.1, True)])
def test_a_correction_at_the_reference_point_is_warned_of_beyond_20_um_and_the_rounding(offset_um, warned):
    safety = safety_with(np.full(11, offset_um))
    assert safety.reference_um == pytest.approx((offset_um, 0.0, 0.0))
    assert [f"the correction at the reference point is X {offset_um:+.1f} um" in text for text in safety.warnings] == [
        True
    ] * warned


@pytest.mark.parametrize(
    ("end_um", "drops_um", "outside", "warned"),
    [
        (9.0, 0.0, "held", False),
        (9.0, 0.4, "continued", False),
        (9.0, 0.6, "dropped", False),
        (10.9, 10.9, "dropped", False),
        (11.1, 11.1, "dropped", True),
    ],
)
@pytest.mark.parametrize("last", [False, True])
def test_what_lies_beyond_a_table_is_held_or_dropped(last, end_um, drops_um, outside, warned):
    ramp = np.linspace(0.0, end_um, 11)
    safety = safety_with(ramp if last else ramp[::-1], drops=drops_um)
    assert [(end.along, end.end_mm, end.travel_mm) for end in safety.ends] == [
        ("X", -400.0, -300.0),
        ("X", 600.0, 500.0),
    ]
    end = safety.ends[last]
    assert end.jump_um == pytest.approx(end_um)
    assert end.outside == outside
    due = f"the tables over X end at {end.end_mm:g} mm and the control drops them there: a jump of {end_um:.1f} um"
    assert list(safety.warnings) == [due] * warned


def test_a_steep_table_is_not_taken_for_one_that_is_dropped_at_its_end():
    """Dropped is what changes ten times more at the end than over the millimetre before it."""
    ramp = np.linspace(0.0, 1000.0, 11)  # 1 um in the last millimetre
    assert safety_with(ramp, drops=9.0).ends[1].outside == "continued"
    assert safety_with(ramp, drops=11.0).ends[1].outside == "dropped"
