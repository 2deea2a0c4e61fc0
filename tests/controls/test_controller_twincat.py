"""TwinCAT CNC axis lists (TF5200): leadscrew, cross and plane tables, signs, units, index order, malformed text."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.controls.twincat_lists import plane_table, units_outwards
from compgen.data import toml_files
from compgen.data.error_table import ReversalCurves
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import CompgenWarning, InputError

NAME = "twincat-lists"
CONTROL = CONTROLLERS[NAME]
GOLDEN = Path(__file__).parents[1] / "golden" / NAME
TENTH_UM = 1e-4
TRAVELS = ((-300.0, 500.0), (-150.0, 700.5), (-420.0, 80.0))


def machine_with(chain="WXYFZT", tool=(3.0, -40.0, -155.0), reference=(10.0, 20.0, -30.0), **own):
    section = toml_files.Section(own, path=None, name=f"controllers.{NAME}")
    x, y, z = (Axis(travel, np.linspace(*travel, 5)) for travel in TRAVELS)
    return Machine("lopsided", Chain(chain), (x, y, z), "X", tool, reference, controllers={NAME: section})


PLAIN = machine_with()


def parsed(text, machine=PLAIN):
    texts = text if isinstance(text, dict) else {"achskw.lis": text}
    files = [SourceFile(Path(name), part) for name, part in texts.items()]
    return CONTROL(machine).parse(files)


def added(tables, position, machine=PLAIN, approach=None):
    position = np.atleast_2d(np.asarray(position, dtype=float))
    direction = None if approach is None else np.broadcast_to(np.asarray(approach, dtype=float), position.shape)
    return CONTROL(machine).emulate(tables, compgen.Points(position, approach=direction))


def golden(name):
    return (GOLDEN / name).read_text()


# --- golden numbers --------------------------------------------------------------------------------------------------


def test_the_vendors_third_point_is_taken_off_in_each_direction():
    tables = parsed(golden("ssfk_y.lis"))
    at = [0.0, -19.8667, 0.0]
    # actual minus nominal: 19856.5 - 19866.7 um = -10.2 um after positive travel, 19874.7 - 19866.7 = +8.0 um after negative
    assert added(tables, at, approach=[1, 1, 1])[0, 1] == pytest.approx(+0.0102, abs=1e-12)
    assert added(tables, at, approach=[1, -1, 1])[0, 1] == pytest.approx(-0.0080, abs=1e-12)
    turned = machine_with(ssfk_sign="correction")
    assert added(tables, at, turned, approach=[1, 1, 1])[0, 1] == pytest.approx(-0.0102, abs=1e-12)


def test_an_unknown_direction_takes_the_mean_and_says_so():
    with pytest.warns(CompgenWarning, match="values for both directions of travel"):
        assert added(parsed(golden("ssfk_y.lis")), [0, -19.8667, 0])[0, 1] == pytest.approx(0.0011, abs=1e-12)


def test_the_constructed_list_gives_2_75_um_at_75_mm_and_holds_its_ends():
    tables = parsed(golden("constructed_x.lis"))
    result = added(tables, [[50, 0, 0], [75, 0, 0], [100, 0, 0], [400, 0, 0], [-9, 0, 0]])[:, 0]
    assert result == pytest.approx([-0.0021, -0.00275, -0.0034, -0.0034, 0.0], abs=1e-12)


def test_cross_values_are_interpolated_over_the_master_and_act_on_the_slave():
    tables = parsed(golden("crosscomp_z.lis"))
    at = added(tables, [[1.1129, 50, 60], [1000.0, 0, 0], [2000.0, 0, 0]])
    assert at[:, 2] == pytest.approx([4.0 * TENTH_UM, 0.1, 0.1], abs=1e-12)
    assert np.all(at[:, :2] == 0.0)
    assert added(tables, [1000.0, 0, 0], machine_with(cross_sign="error"))[0, 2] == pytest.approx(-0.1)


def test_plane_values_have_the_second_master_as_first_index_and_hold_their_margin():
    tables = parsed(golden("crosscomp2_x.lis"))
    # master 1 is Y (logical axis 2), master 2 is Z (3)
    points = [[0, -35, -70], [0, -40, -60], [0, -35, -65], [0, -99, -99], [0, 99, 99]]
    due = np.array([-2.0, 40.0, 0.5 * (-2.0 + 45.0), -3.0, 70.0]) * TENTH_UM
    assert added(tables, points)[:, 0] == pytest.approx(due, abs=1e-15)


# --- signs and order by hand -----------------------------------------------------------------------------------------


def errors_of(**curves):
    nodes = {axis: np.linspace(*TRAVELS[k], 9) for k, axis in enumerate("XYZ")}
    found = {
        name: compgen.Curve(nodes[name[-1]], slope * (nodes[name[-1]] - origin), np.full(9, np.nan))
        for name, (slope, origin) in curves.items()
    }
    return compgen.ErrorTable(found)


def made(machine, errors, reversal=None):
    exported = compgen.export(machine, errors, NAME, reversal=reversal)
    return exported, parsed(dict(exported.files), machine)


def test_too_long_a_pitch_is_stored_as_a_positive_error_in_tenths_of_a_micrometre():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    exported, tables = made(machine, errors_of(EXX=(1e-5, 10.0)))
    screw = tables.lists[0].screw
    at_500 = np.interp(5_000_000, screw.nodes, screw.positive)
    assert at_500 == pytest.approx(49, abs=0.5)  # 10 um/m over 490 mm: 4.9 um too far
    assert added(tables, [500, 0, 0], machine)[0, 0] == pytest.approx(-0.0049, abs=TENTH_UM)
    assert "kw.ssfk.unit                          1\n" in exported.files["achskw1.lis"]


def test_a_straightness_goes_to_the_list_of_the_slave_with_the_sign_of_a_correction():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    _, tables = made(machine, errors_of(EZX=(1e-5, 10.0)))
    cross = tables.lists[2].cross
    assert cross.axis == 0
    assert np.interp(5_000_000, cross.nodes, cross.positive) == pytest.approx(-49, abs=0.5)
    turned, tables = made(machine_with(tool=(0.0, 0.0, 0.0), cross_sign="error"), errors_of(EZX=(1e-5, 10.0)))
    cross = tables.lists[2].cross
    assert np.interp(5_000_000, cross.nodes, cross.positive) == pytest.approx(+49, abs=0.5)
    assert 'cross_sign = "error"' in turned.files["achskw3.lis"]


def test_an_angle_goes_to_the_plane_that_holds_it():
    """WFYXZT: EBX moves X by z EBX(x): the plane of X has X (its own slave) and Z as masters."""
    machine = machine_with("WFYXZT", tool=(0.0, 0.0, 0.0))
    _, tables = made(machine, errors_of(EBX=(2e-7, 10.0)))
    plane = tables.lists[0].plane
    assert plane.axes == (0, 2)
    result = added(tables, [500, 0, -400], machine)[0]
    assert result == pytest.approx([-(-400 * 2e-7 * 490), 0, 0], abs=3 * TENTH_UM)
    _, turned = made(machine_with("WFYXZT", tool=(0.0, 0.0, 0.0), planes={"X": "ZX"}), errors_of(EBX=(2e-7, 10.0)))
    assert turned.lists[0].plane.axes == (2, 0)
    assert np.array_equal(turned.lists[0].plane.values, plane.values.transpose(1, 0, 2))


# --- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("own", [{}, {"number_type": "REAL64", "own_setpoints": True, "ssfk_sign": "correction"}])
def test_text_read_back_acts_as_the_terms_with_their_values(chain, own, make_errors):
    machine = machine_with(chain, **own)
    errors = make_errors(machine)
    read = CONTROL.read_settings(machine)
    basis = CONTROL(machine, read).basis(errors)
    values = {term.name: term.start for term in basis}
    tables = CONTROL(machine, read).build(basis, values)
    exported = compgen.export(machine, errors, NAME)
    position = np.random.default_rng(4).uniform(machine.lower_mm, machine.upper_mm, (200, 3))
    due = sum(
        term.carrier_field(position, np.array(machine.tool_offset_mm))
        * term.curve(values[term.name], position)[:, None]
        for term in basis
    )
    assert np.abs(added(tables, position, machine) - due).max() <= CONTROL(machine, read).resolution_mm() + 1e-12
    again = parsed(dict(exported.files), machine)
    assert compgen.export(machine, errors, NAME).files == exported.files
    assert CONTROL(machine, read).violations(again) == []
    assert all(text.isascii() and "e-" not in text.split("kopf")[1] for text in exported.files.values())


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT", "WZFXYT"])
def test_the_exported_lists_are_accepted_and_take_out_what_they_can(chain, make_errors, tmp_path):
    machine = machine_with(chain)
    errors = make_errors(machine)
    paths = compgen.export(machine, errors, NAME).write(tmp_path)
    result = compgen.verify(machine, compgen.read_tables(machine, paths, NAME), errors)
    assert result.accepted, result.reasons
    assert result.after_rigid_removed.rms_um < 0.5 * result.before_rigid_removed.rms_um


def test_a_reversal_along_the_axis_becomes_a_bilateral_table():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    reversal = ReversalCurves({(0, 0): compgen.Curve(np.zeros(1), np.array([-0.006]), np.array([np.nan]))})
    exported, tables = made(machine, errors_of(EXX=(1e-5, 10.0)), reversal)
    assert "kw.ssfk.bilateral                     1\n" in exported.files["achskw1.lis"]
    up, down = (added(tables, [100, 0, 0], machine, [sign, 1, 1])[0, 0] for sign in (1, -1))
    assert up - down == pytest.approx(0.006, abs=2 * TENTH_UM)  # after positive travel the tool stands 6 um short
    assert 0.5 * (up + down) == pytest.approx(-0.0009, abs=TENTH_UM)


def test_a_reversal_that_bends_between_the_nodes_is_held_where_it_was_measured():
    """Up and down differ by the reversal at each of its positions, whatever nodes the leadscrew table has."""
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    at, size = np.array([TRAVELS[0][0], 130.0, TRAVELS[0][1]]), np.array([-0.002, -0.010, -0.004])
    reversal = ReversalCurves({(0, 0): compgen.Curve(at, size, np.full(3, np.nan))})
    _, tables = made(machine, errors_of(EXX=(1e-5, 10.0)), reversal)
    up, down = (added(tables, [[x, 0, 0] for x in at], machine, [sign, 1, 1])[:, 0] for sign in (1, -1))
    assert up - down == pytest.approx(-size, abs=2 * TENTH_UM)


def test_a_table_over_a_travel_in_whole_units_ends_where_the_travel_ends():
    _, tables = made(machine_with(tool=(0.0, 0.0, 0.0)), errors_of(EXX=(1e-5, 10.0)))
    ends = np.array(TRAVELS[0]) * 10_000
    assert tables.lists[0].screw.nodes[[0, -1]] == pytest.approx(ends, abs=0)


# --- limits ----------------------------------------------------------------------------------------------------------


def test_the_preflight_says_that_an_inch_machine_takes_the_lists_as_they_are(make_errors):
    text = compgen.export(PLAIN, make_errors(PLAIN), NAME).preflight
    assert "Metric only" in text and "do not convert any number" in text


def test_limits_of_points_and_missing_lists_are_named(make_errors):
    errors = make_errors(PLAIN)
    tables = parsed(dict(compgen.export(PLAIN, errors, NAME).files))
    few = machine_with(max_points={"ssfk": 2, "crosscomp": 2, "crosscomp2": 4})
    found = CONTROL(few).violations(replace(tables, lists={0: tables.lists[0]}))
    for words in ("points of kw.ssfk of X", "points of kw.crosscomp of X", "points of kw.crosscomp2 of X"):
        assert any(text.startswith(words) for text in found)
    assert "no list for axis Z (3) was given" in found
    for axis in range(3):
        plane = tables.lists[axis].plane
        assert plane is None or plane.values.size <= 10201


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"cross_sign": "plus"}, "'correction', 'error'"),
        ({"planes": {"X": "XX"}}, "expected the letters of first and second master"),
        ({"logical_axes": {"X": 2}}, "three different"),
        ({"axis_names": {"Y": "X"}}, "three different"),
        ({"number_type": "REAL32"}, "SGN32"),
        ({"crosssign": "error"}, "did you mean 'cross_sign'"),
    ],
)
def test_wrong_settings_are_refused(own, words):
    with pytest.raises(InputError, match=words):
        CONTROL.read_settings(machine_with(**own))


# --- malformed text --------------------------------------------------------------------------------------------------

LIST = golden("constructed_x.lis")
CROSS, PLANE = golden("crosscomp_z.lis"), golden("crosscomp2_x.lis")


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", None, "contains no data"),
        ("# nothing\n", None, "contains no data"),
        (LIST.replace("kw.ssfk.table[2].pos   34\n", ""), None, r"kw.ssfk.table\[2\].pos is missing"),
        (LIST.replace("table[2]", "table[1]"), 10, "second time; the first is in line 9"),
        (LIST.replace("table[2]", "table[3]"), 10, "the indices of the table are"),
        (LIST.replace("pos   34", "pos   3,4"), 10, "decimal mark"),
        (LIST.replace("pos   34", "pos   3.4e1"), 10, "exponent"),
        (LIST.replace("pos   34", "pos   nan"), 10, "not a number"),
        (LIST.replace("pos   34", "pos"), 10, "has no value"),
        (LIST.replace("kw.ssfk.unit", "kw.sfk.unit"), 3, "is not a parameter"),
        (LIST.replace("table[2].pos", "table[2].poss"), 10, "is not a parameter"),
        (LIST.replace("table[2].pos", "table[2][0].pos"), 10, "is not a parameter"),
        (LIST.replace("unit           1", "unit           0"), 3, "encoder increments"),
        (LIST.replace("kw_nr_max      3", "kw_nr_max      2.5"), 6, "whole number"),
        (LIST.replace("bilateral      0", "bilateral      1"), None, "neg is missing"),
        (LIST.replace("achs_nr           1", "achs_nr           9"), 1, "no axis has the logical number 9"),
        (LIST.replace("kw.ssfk.interval       500000\n", ""), None, "interval is missing"),
        (LIST.replace("X\n", "X /* open\n", 1), 2, "must end on its own line"),
        (LIST + "garbage\n", 11, "is not an entry"),
        (LIST + "\N{MICRO SIGN}\n", 11, "ASCII"),
        ("# entries: 11\n" + LIST, None, "declares 11 entries but contains 10"),
        (CROSS.replace("11523", "10735"), 13, "not above the position before it"),
        (PLANE.replace("interval                           100000", "interval 0"), 3, "70430"),
        (re.sub(r"master2_ax_nr +3", "master2_ax_nr 2", PLANE), 11, "two different axes"),
    ],
)
def test_a_malformed_list_is_refused_with_its_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed(text)
    assert (str(caught.value.file), caught.value.line) == ("achskw.lis", line)


def test_two_lists_of_one_axis_are_refused():
    with pytest.raises(InputError, match="second list for axis X; the first is a.lis"):
        parsed({"a.lis": LIST, "b.lis": LIST})


def test_an_exported_list_that_is_cut_is_refused(make_errors):
    text = compgen.export(PLAIN, make_errors(PLAIN), NAME).files["achskw2.lis"]
    for end in range(0, len(text), 1 + len(text) // 40):
        with pytest.raises(InputError):
            parsed(text[:end])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("\xff" * 30_000_000, ":1: the line has 30000000 characters; at most 4000 are read"),
        ("1\n" * 20_000_000, "has 20000000 lines; at most 200000 are read"),
        ("kw.ssfk.unit 1\n" * 1_000_000, "has 1000000 lines; at most 200000 are read"),
    ],
    ids=["one line", "numbers", "keys"],  # not these texts themselves
)
def test_huge_garbage_is_refused_for_its_size_before_it_is_parsed(text, reason):
    with pytest.raises(InputError, match=reason):
        parsed(text)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2000), st.text(alphabet="kw.ssfkcrotable[]0123456789- /*#\n\x00,e", max_size=12))
def test_damaged_text_is_read_or_refused(place, piece):
    for text in (LIST, PLANE):
        at = place % len(text)
        try:
            parsed(text[:at] + piece + text[at + len(piece) :])
        except InputError:
            continue


# --- positions in whole units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("travel_mm", "at_mm", "units"),
    [
        ((-30.0, 50.0), (-30.0, 0.0, 50.0), (-300000, 0, 500000)),  # whole units stay
        (
            (-30.00004, 50.00004),
            (-30.00004, 50.00004),
            (-300001, 500001),
        ),  # ends move outwards, so that they are covered
        ((-30.00004, 50.00004), (-30.00004, 0.0, 50.00004), (-300001, 0, 500001)),
        ((-30.00004, 50.00004), (-10.00004, 0.0, 20.00004), (-100000, 0, 200000)),  # nodes within are rounded
    ],
)
def test_nodes_in_whole_units_still_cover_the_travel(travel_mm, at_mm, units):
    axis = Axis(travel_mm, np.linspace(*travel_mm, 3))
    machine = Machine("m", Chain("WFYXZT"), (axis, axis, axis))
    assert units_outwards(machine, 0, np.array(at_mm)).tolist() == list(units)


@pytest.mark.parametrize(
    ("low_mm", "high_mm", "first", "last"),
    [(-30.0, 50.0, -300_000, 500_000), (-30.00004, 50.0, -300_001, 500_000), (-30.0, 50.00004, -300_000, 500_001)],
)
def test_an_equidistant_table_covers_the_travel_with_no_node_to_spare(low_mm, high_mm, first, last):
    """Whole units of 0.1 um by hand; the last node may lie up to a unit for each interval beyond the travel."""
    axes = (Axis((low_mm, high_mm), np.linspace(low_mm, high_mm, 5)), *PLAIN.axes[1:])
    machine = replace(PLAIN, axes=axes, reference_point_mm=(10.0, 20.0, -30.0))
    screw = made(machine, compgen.ErrorTable({}, {"EC0Y": (0.0, np.nan)}))[1].lists[0].screw
    intervals = len(screw.nodes) - 1
    assert np.diff(screw.nodes).tolist() == [screw.interval] * intervals
    assert screw.nodes[0] == first
    assert last <= screw.nodes[-1] <= last + intervals


def test_a_plane_of_one_row_or_one_column_holds_its_value_along_the_other_master():
    row = plane_table(2, (0, 1), (0.0, 0.0), 10.0, np.array([[4.0, 8.0]]))
    column = plane_table(2, (0, 1), (0.0, 0.0), 10.0, np.array([[4.0], [8.0]]))
    along, across = np.array([0.0, 5.0, 10.0]) * TENTH_UM, np.array([-3.0, 0.0, 99.0]) * TENTH_UM
    nothing = np.zeros(3)
    assert row.at(np.column_stack([along, across, nothing]))[:, 0] == pytest.approx([4.0, 6.0, 8.0])
    assert column.at(np.column_stack([across, along, nothing]))[:, 0] == pytest.approx([4.0, 6.0, 8.0])
