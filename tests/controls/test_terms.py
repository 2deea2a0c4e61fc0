"""The bases that controls share: at their nodes all tables together are minus the error E = C P."""

from itertools import product

import numpy as np
import pytest

from compgen.controls import Term
from compgen.controls.shared.terms import ACROSS, continued, error_terms, one_dimensional_terms, product_terms
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.names import SQUARENESS_NAMES
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.many_points import volumetric_error
from tests.machines import machine_of

RANGES = ((-300.0, 500.0), (-150.0, 700.0), (-420.0, 80.0))
CHAINS = ("WXYFZT", "WFYXZT", "WYZFXT", "WXYZFT")
PAIRS = list(product(range(3), repeat=2))


def machine_with(chain, reference):
    return machine_of(
        RANGES,
        5,
        chain,
        squareness_reference=reference,
        tool_offset_mm=(30.0, -45.0, -120.0),
        reference_point_mm=(10.0, 20.0, -30.0),
    )


def field_of(machine, terms, at):
    """What tables with the start values of the terms add at points (n, 3), mm."""
    tool = tool_of(machine, None)
    return sum(term.carrier_field(at, tool) * term.curve(term.start, at)[:, None] for term in terms)


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_functions_of_one_axis_and_products_together_are_minus_the_error(chain, reference, make_errors):
    """Whatever the levers are counted from; that is E = C P of the model, term by term."""
    machine = machine_with(chain, reference)
    errors = make_errors(machine)
    nodes = [axis.nodes_mm for axis in machine.axes]
    vertices = np.array(list(product(*nodes)))
    for origin in ((0.0, 0.0, 0.0), (120.0, -80.0, 33.0)):
        terms = one_dimensional_terms(machine, errors, nodes, PAIRS, lever_origin_mm=origin)
        terms += product_terms(machine, errors, nodes, origin)
        added = field_of(machine, terms, vertices)
        assert added == pytest.approx(-volumetric_error(machine, errors, vertices), abs=1e-12)


@pytest.mark.parametrize("chain", CHAINS)
def test_without_an_origin_levers_count_from_the_middle_and_anchored_tables_are_zero_at_the_reference(
    chain, make_errors
):
    machine = machine_with(chain, "X")
    errors, nodes = make_errors(machine), [axis.nodes_mm for axis in machine.axes]
    middle = [0.5 * (low + high) for low, high in RANGES]
    plain = one_dimensional_terms(machine, errors, nodes, PAIRS)
    for term, other in zip(
        plain, one_dimensional_terms(machine, errors, nodes, PAIRS, lever_origin_mm=middle), strict=True
    ):
        assert np.array_equal(term.start, other.start) and term.zero_at_mm is None
    for (output, axis), term, other in zip(
        PAIRS, plain, one_dimensional_terms(machine, errors, nodes, PAIRS, anchored=True), strict=True
    ):
        at = np.full((1, 3), machine.reference_point_mm[axis])
        assert other.curve(other.start, at)[0] == pytest.approx(0.0, abs=1e-15)
        assert other.start - term.start == pytest.approx(np.full(5, -term.curve(term.start, at)[0]), abs=1e-15)
        assert other.zero_at_mm == machine.reference_point_mm[axis]
        # straightness is held at both ends of the travel, positioning at the reference point
        held = RANGES[axis] if output != axis else (machine.reference_point_mm[axis],)
        assert term.keep_mm == other.keep_mm == held


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_one_term_per_error_gives_minus_the_error_and_the_line_of_a_straightness_goes_where_it_belongs(
    chain, reference, make_errors
):
    """A control that knows X as the only reference gets EC0Y as the slope of EYX."""
    machine = machine_with(chain, reference)
    errors, nodes = make_errors(machine), [axis.nodes_mm for axis in machine.axes]
    errors = ErrorTable(errors.curves, {name: (1e-5 * (k + 1), 0.0) for k, name in enumerate(errors.squareness)})
    vertices = np.array(list(product(*nodes)))
    terms = error_terms(machine, errors, nodes)
    assert field_of(machine, terms, vertices) == pytest.approx(-volumetric_error(machine, errors, vertices), abs=1e-12)
    for term in terms:
        ends = np.max(np.abs(errors.curves[term.name].value[[0, -1]])) if term.name in errors.curves else 1.0
        straight = len(term.name) == 3 and term.name[1] in "XYZ" and term.name[1] != term.name[2]
        folded = term.name == "EYX" and reference == "Y"
        zero = straight and ends < 1e-9 and not folded and set(SQUARENESS_NAMES) <= set(errors.names)
        assert term.zeros_mm == (RANGES[term.axis] if zero else ())


def term_over(nodes, start):
    return Term("X(x)", 0, np.array(nodes), (), np.array(start))


def test_a_start_goes_straight_on_at_a_node_far_beyond_the_travel_only():
    """Far: less than half of the interval lies within the travel; its value lies on the line of the next two nodes."""
    nodes, start = [0.0, 100.0, 200.0, 300.0, 400.0], [5.0, 1.0, 3.0, 9.0, 2.0]
    # travel from 80 to 310: 20 of the first 100 mm and 10 of the last 100 mm lie within
    assert continued(term_over(nodes, start), (80.0, 310.0)).start == pytest.approx([-1.0, 1.0, 3.0, 9.0, 15.0])
    # 50 mm are half of it: both ends stay
    assert continued(term_over(nodes, start), (50.0, 350.0)).start == pytest.approx(start)
    assert continued(term_over(nodes, start), (50.0, 349.0)).start == pytest.approx([5.0, 1.0, 3.0, 9.0, 15.0])
    # uneven nodes: the slope is that of the inner interval
    uneven = continued(term_over([0.0, 100.0, 150.0, 200.0], [0.0, 1.0, 2.0, 2.0]), (90.0, 200.0))
    assert uneven.start == pytest.approx([-1.0, 1.0, 2.0, 2.0])
    assert continued(term_over(nodes[:2], start[:2]), (80.0, 90.0)).start == pytest.approx(start[:2])


def test_a_curve_that_is_not_known_adds_nothing():
    machine = machine_with("WFYXZT", "X")
    nodes = [axis.nodes_mm for axis in machine.axes]
    curve = Curve(nodes[0], 1e-3 * np.arange(5.0), np.full(5, np.nan))
    terms = one_dimensional_terms(machine, ErrorTable({"EXX": curve}), nodes, PAIRS)
    assert [term.name for term in terms if np.any(term.start)] == ["X(x)"]
    assert terms[0].start == pytest.approx(-curve.value)
    assert [term.name for term in error_terms(machine, ErrorTable({"EXX": curve}), nodes)] == ["EXX"]


def test_the_names_of_tables_say_what_moves_and_over_which_axis():
    known = {"Y(x)": (1, 0), "Z(x)": (2, 0), "X(y)": (0, 1), "Z(y)": (2, 1), "X(z)": (0, 2), "Y(z)": (1, 2)}
    assert known == ACROSS
