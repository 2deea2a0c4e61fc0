"""Whole numbers of tables: held against every table that there is, and against the bound of half a count."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgen.controls import CONTROLLERS
from compgen.controls.shared.integers import best_integers, section_weights
from compgen.data.error_table import Curve, ErrorTable, hat_entries, hat_matrix
from compgen.data.lengths import Points
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.toml_files import Section
from compgen.tables import export, synthesize

UM = 1e-3
ROUNDING = 1e-9
EQUAL = 1e-9
CONTROL = CONTROLLERS["fanuc-pitch"]


def missed_square(nodes, counts, wanted, low, high):
    """Integral of the squared distance of two polylines over low ... high, by Simpson's rule, which is exact here."""
    ends = np.unique(np.clip(np.concatenate([nodes, [low, high]]), low, high))
    total = 0.0
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        d = np.interp([a, 0.5 * (a + b), b], nodes, counts - wanted)
        total += (b - a) / 6.0 * (d[0] ** 2 + 4.0 * d[1] ** 2 + d[2] ** 2)
    return total


def every_table(sections, reference, limit):
    """All tables that are zero at the reference node and change by at most ``limit`` per section."""
    for steps in product(range(-limit, limit + 1), repeat=sections):
        curve = np.concatenate([[0], np.cumsum(steps)])
        yield curve - curve[reference]


def exhaustive(nodes, wanted, reference, limit):
    """Smallest integral on each side of the reference; tables within half a count at every node go first."""
    total = 0.0
    for part in (slice(None, reference + 1), slice(reference, None)):
        own_nodes, own_wanted = nodes[part], wanted[part]
        if len(own_nodes) < 2:
            continue
        own_reference = reference if part.start is None else 0
        tables = list(every_table(len(own_nodes) - 1, own_reference, limit))
        near = [table for table in tables if np.max(np.abs(table - own_wanted)) <= 0.5 + ROUNDING]
        total += min(
            missed_square(own_nodes, table, own_wanted, own_nodes[0], own_nodes[-1]) for table in near or tables
        )
    return total


@pytest.mark.parametrize("seed", range(40))
def test_the_result_is_that_of_trying_every_table(seed):
    generator = np.random.default_rng(seed)
    limit, count = [(1, 8), (2, 6), (3, 5)][seed % 3]
    nodes = np.cumsum(generator.uniform(10.0, 90.0, count))
    wanted = np.cumsum(generator.normal(0.0, [0.6, 2.0][seed % 2] * limit, count))
    reference = int(generator.integers(0, count))
    wanted -= wanted[reference]
    found = best_integers(wanted, section_weights(nodes, (nodes[0], nodes[-1])), reference, limit)
    assert found.counts[reference] == 0
    assert np.max(np.abs(np.diff(found.counts))) <= limit
    own = missed_square(nodes, found.counts, wanted, nodes[0], nodes[-1])
    best = exhaustive(nodes, wanted, reference, limit)
    assert own == pytest.approx(best, rel=EQUAL)
    assert found.rms == pytest.approx(np.sqrt(own / (nodes[-1] - nodes[0])), rel=EQUAL)
    assert found.limited is bool(found.largest > 0.5 + ROUNDING)


def test_the_cases_above_are_of_both_kinds():
    """The test above would say little if the limit bound always or never."""
    kinds = set()
    for seed in range(12):
        wanted = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.6, 8))
        sections = section_weights(np.arange(8.0), (0.0, 7.0))
        kinds.add(best_integers(wanted - wanted[3], sections, 3, 1).limited)
    assert kinds == {True, False}


def dense_programme(wanted, sections, limit):
    """Smallest J over every reachable whole number, without any window; from the reference node outwards."""
    costs = {0: 0.0}
    for k in range(1, len(wanted)):
        g0, g1, g2 = sections[k - 1]
        following = {}
        for state in range(-limit * k, limit * k + 1):
            d = state - wanted[k]
            options = [
                cost + g0 * (a - wanted[k - 1]) ** 2 + 2 * g1 * (a - wanted[k - 1]) * d + g2 * d * d
                for a, cost in costs.items()
                if abs(a - state) <= limit
            ]
            if options:
                following[state] = min(options)
        costs = following
    return min(costs.values())


@pytest.mark.parametrize("seed", range(6))
def test_the_windows_hold_the_best_table_of_a_long_steep_curve(seed):
    generator = np.random.default_rng(seed)
    count, limit = 24, 3
    nodes = np.cumsum(generator.uniform(20.0, 60.0, count))
    wanted = np.cumsum(generator.normal(1.0, 4.0, count))
    wanted -= wanted[0]
    sections = section_weights(nodes, (nodes[0] + 5.0, nodes[-1] - 19.0))  # nodes beyond the travel weigh little
    found = best_integers(wanted, sections, 0, limit)
    assert found.limited and found.full_sections
    d = found.counts - wanted
    own = sum(
        g0 * a * a + 2 * g1 * a * b + g2 * b * b for (g0, g1, g2), a, b in zip(sections, d[:-1], d[1:], strict=True)
    )
    assert own == pytest.approx(dense_programme(wanted, sections, limit), rel=EQUAL)


def nearest_polyline(nodes_mm, position_mm, requested, weight, reference):
    """Project a curve given at any positions (m,) onto polylines that are zero at node ``reference``.

    Returns the values (n,) at the nodes and G (n-1, 3) of the sections, both with the weights (m,) of the positions.
    Every section needs enough weighted positions to determine its ends.
    """
    matrix = hat_matrix(nodes_mm, position_mm)
    left, share = hat_entries(nodes_mm, position_mm)
    sections = np.zeros((len(nodes_mm) - 1, 3))
    products = np.column_stack([(1.0 - share) ** 2, (1.0 - share) * share, share**2])
    np.add.at(sections, left, weight[:, None] * products)
    free = np.arange(len(nodes_mm)) != reference
    root = np.sqrt(weight)
    values = np.zeros(len(nodes_mm))
    values[free] = np.linalg.lstsq(matrix[:, free] * root[:, None], requested * root, rcond=None)[0]
    return values, sections


def test_a_finer_curve_is_met_between_the_nodes_too():
    """The wanted curve bends between the nodes; every table is tried against the curve itself."""
    nodes = np.array([0.0, 40.0, 100.0, 130.0, 200.0])
    position = np.linspace(0.0, 200.0, 401)
    wanted = 6.0 * np.sin(position / 35.0) - 6.0 * np.sin(100.0 / 35.0)
    weight = 1.0 + (position > 120.0)
    values, sections = nearest_polyline(nodes, position, wanted, weight, 2)
    found = best_integers(values, sections, 2, 7)

    def missed(table):
        return float(np.sum(weight * (np.interp(position, nodes, table) - wanted) ** 2))

    near = [table for table in every_table(4, 2, 7) if np.max(np.abs(table - values)) <= 0.5 + ROUNDING]
    assert missed(found.counts) == pytest.approx(min(map(missed, near)), rel=EQUAL)
    steep = best_integers(values, sections, 2, 2)
    assert steep.limited
    assert missed(steep.counts) == pytest.approx(min(map(missed, every_table(4, 2, 2))), rel=EQUAL)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.floats(-7.0, 7.0), min_size=1, max_size=60),
    st.integers(0, 60),
    st.integers(7, 9),
)
def test_within_the_limit_nothing_is_off_by_more_than_half_a_count(steps, reference, limit):
    wanted = np.concatenate([[0.0], np.cumsum(steps)])
    reference = min(reference, len(steps))
    wanted -= wanted[reference]
    nodes = np.arange(len(wanted)) * 25.0
    found = best_integers(wanted, section_weights(nodes, (nodes[0], nodes[-1])), reference, limit)
    assert not found.limited
    assert np.max(np.abs(np.diff(found.counts))) <= limit
    assert found.largest <= 0.5 + 1e-8
    assert found.rms <= found.largest + ROUNDING


def test_rounding_each_increment_would_lose_counts_that_the_curve_keeps():
    wanted = 2.4 * np.arange(6.0)
    found = best_integers(wanted, section_weights(np.arange(6.0), (0.0, 5.0)), 0, 7)
    assert found.counts[-1] == 12
    assert int(np.sum(np.rint(np.diff(wanted)))) == 10


def test_at_half_a_count_the_polyline_decides():
    """0.5 at two nodes: 0 and 1 in turn leave a third of the square that 0 and 0 leave."""
    found = best_integers(np.array([0.0, 0.5, 0.5, 0.0]), section_weights(np.arange(4.0), (0.0, 3.0)), 0, 7)
    assert sorted(found.counts[1:3].tolist()) == [0, 1]


def test_section_weights_are_the_integrals_of_the_hat_functions():
    plain = section_weights(np.array([0.0, 30.0, 90.0]), (0.0, 90.0))
    assert plain == pytest.approx(np.array([[10.0, 5.0, 10.0], [20.0, 10.0, 20.0]]))
    zone = section_weights(np.array([0.0, 30.0, 90.0]), (0.0, 90.0), (30.0, 90.0), 10.0)
    assert zone == pytest.approx(np.array([[10.0, 5.0, 10.0], [200.0, 100.0, 200.0]]))
    cut = section_weights(np.array([0.0, 30.0]), (0.0, 15.0))
    assert cut == pytest.approx(np.array([[8.75, 2.5, 1.25]]), rel=1e-5)


# --- in the pitch tables -------------------------------------------------------------------------------------------


def machine_of(**options):
    axes = tuple(Axis(r, np.linspace(*r, n)) for r, n in (((-300.0, 500.0), 11), ((-1.0, 1.0), 2), ((-1.0, 1.0), 2)))
    section = Section(options, path=None, name="controllers.fanuc-pitch")
    return Machine(
        "m", Chain("WFYXZT"), axes, reference_point_mm=(-100.0, 0.0, 0.0), controllers={CONTROL.name: section}
    )


def wavy(machine, peak_mm, waves=1.5):
    nodes = machine.axes[0].nodes_mm
    value = peak_mm * np.sin(waves * 2 * np.pi * (nodes + 100.0) / 800.0)
    return ErrorTable({"EXX": Curve(nodes, value, np.full(len(nodes), np.nan))})


def emulated_x(machine, tables, x_mm):
    points = Points(np.column_stack([x_mm, np.zeros_like(x_mm), np.zeros_like(x_mm)]))
    return CONTROL(machine).emulate(tables, points)[:, 0]


@pytest.mark.parametrize("stores", ["correction", "error"])
def test_the_table_adds_no_more_than_half_a_count_to_the_best_one_without_whole_numbers(stores):
    machine = machine_of(detection_unit_um=1.0, stores=stores)
    errors, chosen = wavy(machine, 20 * UM), CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(errors)
    values = synthesize(machine, errors, basis, anchored=True)
    tables = CONTROL(machine, chosen).build(basis, values)
    x_mm = np.linspace(-300.0, 500.0, 3001)
    best = np.interp(x_mm, basis[0].nodes_mm, values["X(x)"])
    added = emulated_x(machine, tables, x_mm) - best
    assert 0.2 * UM < np.max(np.abs(added)) <= 0.5 * UM + 1e-12
    assert tables.shortfalls == () and CONTROL(machine, chosen).violations(tables) == []


def test_a_curve_steeper_than_the_limit_is_met_as_far_as_it_goes_and_said_so():
    machine = machine_of(increment_limit=3, interval_mm={"X": 80.0})
    errors, chosen = wavy(machine, 6 * UM), CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(errors)
    tables = CONTROL(machine, chosen).build(basis, {term.name: term.start for term in basis})
    assert max(map(abs, tables.blocks[0].values)) == 3
    (message,) = CONTROL(machine, chosen).violations(tables)
    assert message.startswith("X: the requested curve is too steep; the limit is 3 counts per section")
    exported = export(machine, errors, CONTROL.name)
    assert any("too steep" in text for text in exported.violations)


def test_a_limit_that_costs_less_than_a_count_is_a_warning():
    machine = machine_of(increment_limit=3, interval_mm={"X": 80.0})
    nodes = np.array([-300.0, -20.0, 60.0, 500.0])  # the section from -20 to 60 mm is steeper than 3 counts by 0.75
    errors = ErrorTable({"EXX": Curve(nodes, np.array([0.0, 0.0, 3.75, 3.75]) * UM, np.full(4, np.nan))})
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(errors)
    tables = CONTROL(machine, chosen).build(basis, {term.name: term.start for term in basis})
    assert CONTROL(machine, chosen).violations(tables) == []
    (shortfall,) = tables.shortfalls
    assert 0.5 < shortfall.missed_counts <= 1.0
    assert any("too steep" in text for text in CONTROL(machine, chosen).context(tables)["warnings"])
