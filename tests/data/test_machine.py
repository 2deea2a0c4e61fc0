"""Machine files: what is read, what is refused and with which words, and how machines are found by name."""

import re
from itertools import permutations

import numpy as np
import pytest

from compgen.controls import CONTROLLERS
from compgen.data import machine as machine_module
from compgen.data.machine import CHAINS, Chain, load_machine, machine_files, machine_of, read_machine
from compgen.data.toml_files import problems_of
from compgen.effects import active_effects
from compgen.errors import CompgenWarning, InputError
from compgen.resources import data_folder

GOOD = """\
name = "mill"
chain = "WYFXZT"
squareness_reference = "Y"
tool_offset_mm = [0.0, 0.0, 150.0]
reference_point_mm = [-800.0, 0.0, 10.0]
errors = ["EXX", "EC0Y", "EAX"]
curves = "cubic"
[axes.X]
range_mm = [-800.0, 0.0]
nodes = 11
expansion_um_per_m_k = 11.5
screw_pitch_mm = 10.0
[axes.Y]
range_mm = [-500, 500]
nodes_mm = [-500, -100, 0, 500]
[axes.Z]
range_mm = [0.0, 350.0]
nodes = 8
[controllers.siemens-cec]
sign = "error"
axis_names = { X = "AX1" }
"""


@pytest.fixture
def saved(tmp_path):
    def save(text, name="machine.toml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return save


def refusal(path):
    with pytest.raises(InputError) as caught:
        read_machine(path)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


def test_everything_in_a_machine_file_is_read(saved):
    machine = read_machine(saved(GOOD))
    assert (machine.name, machine.chain.name, machine.squareness_reference) == ("mill", "WYFXZT", "Y")
    assert machine.tool_offset_mm == (0.0, 0.0, 150.0)
    assert machine.reference_point_mm == (-800.0, 0.0, 10.0)
    assert machine.errors == ("EXX", "EAX", "EC0Y")
    assert machine.curves == "cubic"
    assert machine.lower_mm.tolist() == [-800, -500, 0] and machine.upper_mm.tolist() == [0, 500, 350]
    x, y, z = machine.axes
    assert x.nodes_mm.tolist() == [-800 + 80 * k for k in range(11)]
    assert y.nodes_mm.tolist() == [-500, -100, 0, 500]
    assert (x.expansion_um_per_m_k, x.screw_pitch_mm, x.length_mm) == (11.5, 10.0, 800.0)
    assert (z.expansion_um_per_m_k, z.screw_pitch_mm, len(z.nodes_mm)) == (None, None, 8)


def test_what_may_be_left_out_has_the_documented_defaults(saved):
    axes = "".join(f"[axes.{axis}]\nrange_mm = [-1, 1]\nnodes = 2\n" for axis in "ZYX")
    machine = read_machine(saved(f'name = "m"\nchain = "WFYXZT"\n{axes}'))
    assert machine.squareness_reference == "X" and machine.errors == "observable" and machine.curves == "linear"
    assert machine.tool_offset_mm == machine.reference_point_mm == (0.0, 0.0, 0.0)


def test_controller_settings_are_handed_over_fresh_each_time(saved):
    machine = read_machine(saved(GOOD))
    for _ in range(2):
        settings = machine.controller_settings("siemens-cec")
        assert settings.take("sign", str) == "error"
        with pytest.raises(
            InputError, match=r"machine.toml:21: \[controllers.siemens-cec\] axis_names: is not a known"
        ):
            settings.finish()
    assert machine.controller_settings("pmac").data == {}
    with pytest.raises(InputError, match=r"machine.toml: \[controllers.pmac\] sign: is missing"):
        machine.controller_settings("pmac").take("sign", str)


REPLACEMENTS = [
    (
        "range_mm = [-800.0, 0.0]",
        "range_um = [-800.0, 0.0]",
        r":8: \[axes.X\] range_mm: is missing; 'range_um' is not a key here, did you mean 'range_mm'",
    ),
    (
        "screw_pitch_mm",
        "screw_pitch_um",
        r":12: \[axes.X\] screw_pitch_um: is not a known key; did you mean 'screw_pitch_mm'",
    ),
    ("tool_offset_mm", "tool_offset_um", r":4: tool_offset_um: is not a known key; did you mean 'tool_offset_mm'"),
    ("curves =", "curve =", r":7: curve: is not a known key; did you mean 'curves'"),
    (
        "[-800.0, 0.0]",
        "[0.0, -800.0]",
        r":9: \[axes.X\] range_mm: expected .*lower number first; got \[0.0, -800.0\]",
    ),
    ("[-800.0, 0.0]", "[-800.0, inf]", r":9: \[axes.X\] range_mm: expected a finite number"),
    ("[-800.0, 0.0]", "[nan, 0.0]", r":9: \[axes.X\] range_mm: expected a finite number"),
    ("[-800.0, 0.0]", "800.0", r":9: \[axes.X\] range_mm: expected two numbers"),
    ("nodes = 11", "nodes = 11.0", r":10: \[axes.X\] nodes: expected a whole number from 2 to 10001; got 11.0"),
    ("nodes = 11", "nodes = 1", r":10: \[axes.X\] nodes: expected a whole number from 2"),
    ("nodes = 11", "nodes = 3", r":10: \[axes.X\] nodes: 3 is too few for curves = 'cubic'; at least 4"),
    ("nodes = 11\n", "", r":8: \[axes.X\] nodes: is missing"),
    ("[-500, -100, 0, 500]", "[-500, 0, -100, 500]", r":15: \[axes.Y\] nodes_mm: .*ascending order"),
    ("[-500, -100, 0, 500]", "[-400, -100, 0, 500]", r":15: \[axes.Y\] nodes_mm: ranges from -400 to 500 mm"),
    ("nodes_mm = [", "nodes = 5\nnodes_mm = [", r":15: \[axes.Y\] nodes: nodes and nodes_mm are both given"),
    ("[axes.Y]", "[axes.X]", r":13: is not valid TOML: Cannot declare"),
    ("[axes.Y]", "[axes.y]", r"\[axes\] Y: is missing; 'y' is not a key here, did you mean 'Y'"),
    ("[axes.Y]", "[axes.A]", r"\[axes\] Y: is missing"),
    ("[axes.Z]", "[axes.Z]\nrange_mm = 1\n[axes.A]", r":17: \[axes.Z\] range_mm: expected two numbers"),
    ('"WYFXZT"', '"WYXZT"', r":2: chain: chain 'WYXZT' is not valid; expected W, then X, Y, Z and F once each"),
    ('"WYFXZT"', '"wyfxzt"', r":2: chain: chain 'wyfxzt' is not valid"),
    ('"WYFXZT"', '"TZXFYW"', r":2: chain: chain 'TZXFYW' is not valid"),
    ('"WYFXZT"', '["W"]', r":2: chain: chain \['W'\] is not valid"),
    ('chain = "WYFXZT"\n', "", r": chain: is missing"),
    ('name = "mill"', "name = 5", r":1: name: expected one line of text; got 5"),
    ('reference = "Y"', 'reference = "Z"', r":3: squareness_reference: expected one of 'X', 'Y'; got 'Z'"),
    ("150.0]", '"150"]', r":4: tool_offset_mm: expected a finite number"),
    ("0.0, 150.0]", "150.0]", r":4: tool_offset_mm: expected three numbers"),
    (
        "[-800.0, 0.0, 10.0]",
        "[-801.0, 0.0, 10.0]",
        r":5: reference_point_mm: X = -801 mm is outside the travel -800 ... 0 mm",
    ),
    ("[-800.0, 0.0, 10.0]", "[0, 0, 351]", r":5: reference_point_mm: Z = 351 mm is outside the travel 0 ... 350 mm"),
    ('"EAX"]', '"EXA"]', r":6: errors: 'EXA' is not one of the 21 errors; did you mean"),
    ('"EAX"]', '"EXX"]', r":6: errors: each error may be listed only once"),
    ('["EXX", "EC0Y", "EAX"]', "18", r":6: errors: expected 'observable', 17, 21 or a list"),
    ('["EXX", "EC0Y", "EAX"]', "[]", r":6: errors: expected 'observable', 17, 21 or a list"),
    ('"cubic"', '"quintic"', r":7: curves: expected one of 'linear', 'cubic'; got 'quintic'"),
    ("screw_pitch_mm = 10.0", "screw_pitch_mm = 0", r":12: \[axes.X\] screw_pitch_mm: expected a number above zero"),
    (
        "expansion_um_per_m_k = 11.5",
        "expansion_um_per_m_k = nan",
        r":11: \[axes.X\] expansion_um_per_m_k: expected a finite",
    ),
    ("[controllers.siemens-cec]\n", "[controllers]\n", r":20: \[controllers\] sign: expected a table"),
]


@pytest.mark.parametrize(("old", "new", "says"), REPLACEMENTS)
def test_a_faulty_machine_file_is_refused_with_line_and_key(saved, old, new, says):
    assert old in GOOD
    message = refusal(saved(GOOD.replace(old, new, 1)))
    assert re.search(says, message), message


def test_a_missing_axis_is_named(saved):
    text = GOOD[: GOOD.index("[axes.Z]")]
    assert "[axes] Z: is missing" in refusal(saved(text))


def test_an_unknown_axis_is_refused(saved):
    message = refusal(saved(GOOD + "[axes.A]\nrange_mm = [0, 1]\nnodes = 2\n"))
    assert ":22: [axes] A: the chain WYFXZT has no axis A; put the letter into it" in message


def test_a_range_without_machine_zero_needs_a_reference_point(saved):
    text = GOOD.replace("reference_point_mm = [-800.0, 0.0, 10.0]\n", "").replace("[0.0, 350.0]", "[10.0, 350.0]")
    assert "reference_point_mm: Z = 0 mm is outside" in refusal(saved(text))


@pytest.mark.parametrize("value", ['"observable"', "17", "21"])
def test_the_errors_may_be_chosen_by_word_or_number(saved, value):
    machine = read_machine(saved(GOOD.replace('["EXX", "EC0Y", "EAX"]', value)))
    assert str(machine.errors) == value.strip('"')


# --- chains -------------------------------------------------------------------------------------------------------


def test_there_are_24_chains_one_for_each_order():
    assert len(set(CHAINS)) == 24
    assert set(CHAINS) == {"W" + "".join(order) + "T" for order in permutations("XYZF")}


@pytest.mark.parametrize(
    ("name", "workpiece", "tool"),
    [("WFYXZT", "", "YXZ"), ("WYFXZT", "Y", "XZ"), ("WXYFZT", "YX", "Z"), ("WZYXFT", "XYZ", "")],
)
def test_the_sides_of_a_chain_count_from_the_foundation(name, workpiece, tool):
    chain = Chain(name)
    assert "".join("XYZ"[axis] for axis in chain.workpiece_side) == workpiece
    assert "".join("XYZ"[axis] for axis in chain.tool_side) == tool


@pytest.mark.parametrize(
    ("name", "levers"),
    [
        ("WFYXZT", {"Y": "XZ", "X": "Z", "Z": ""}),
        ("WYFXZT", {"X": "Z", "Z": "", "Y": "XZY"}),
        ("WXYFZT", {"Z": "", "Y": "ZY", "X": "ZYX"}),
        ("WZYXFT", {"X": "X", "Y": "XY", "Z": "XYZ"}),
    ],
)
def test_the_lever_of_an_axis_is_what_lies_between_it_and_the_tool(name, levers):
    chain = Chain(name)
    assert {axis: "".join("XYZ"[k] for k in chain.lever_axes("XYZ".index(axis))) for axis in "XYZ"} == levers


# --- finding machines by name ---------------------------------------------------------------------------------------


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A folder in the place of the shipped one, and an empty working directory."""
    folder, work = tmp_path / "shipped", tmp_path / "work"
    folder.mkdir()
    work.mkdir()
    monkeypatch.setattr(machine_module, "data_folder", lambda kind: folder)
    monkeypatch.chdir(work)
    return folder


def test_a_machine_is_found_by_path_and_by_name_in_every_folder(shipped, saved, tmp_path, monkeypatch):
    saved(GOOD, "shipped/one.toml")
    saved(GOOD.replace("mill", "two"), "shipped/two/machine.toml")
    saved(GOOD.replace("mill", "three"), "work/machines/three.toml")
    saved(GOOD.replace("mill", "four"), "extra/four.toml")
    assert load_machine("mill").name == "mill"
    assert load_machine("two").name == "two"
    assert load_machine("three").name == "three"
    assert load_machine("four", (tmp_path / "extra",)).name == "four"
    assert load_machine(tmp_path / "extra" / "four.toml").name == "four"
    monkeypatch.chdir(tmp_path / "extra")
    assert load_machine("four.toml").name == "four"


def test_an_unknown_name_is_refused_with_the_nearest(shipped, saved):
    saved(GOOD, "shipped/one.toml")
    with pytest.raises(InputError, match="there is no machine 'mil'; did you mean 'mill'"):
        load_machine("mil")


@pytest.mark.parametrize("change", ["", "# another comment\n"])
def test_two_machines_of_one_name_in_one_folder_are_refused(shipped, saved, change):
    first, second = saved(GOOD, "shipped/a.toml"), saved(GOOD + change, "shipped/b.toml")
    with pytest.raises(InputError, match="two machines have the name 'mill'") as caught:
        load_machine("mill")
    assert str(first) in str(caught.value) and str(second) in str(caught.value)


def test_another_machine_of_the_same_name_in_another_folder_is_refused_but_a_copy_is_not(shipped, saved, tmp_path):
    first = saved(GOOD, "shipped/a.toml")
    other = saved(GOOD, "other/b.toml")
    assert machine_files((tmp_path / "other",)) == {"mill": first}
    other.write_text(GOOD + "# changed\n")
    with pytest.raises(InputError, match="two machines have the name 'mill'"):
        load_machine("mill", (tmp_path / "other",))


def test_a_folder_named_twice_counts_once(shipped, saved):
    path = saved(GOOD, "shipped/a.toml")
    assert machine_files((shipped, shipped)) == {"mill": path}


def test_every_shipped_machine_loads_under_its_name():
    files = machine_files()
    assert files
    for name in files:
        machine = load_machine(name)
        assert machine.name == name
        assert np.all(machine.upper_mm > machine.lower_mm)


def test_every_section_of_a_shipped_machine_file_is_right():
    """Commands rely on it: of a shipped machine they read the controls in use only."""
    for name in machine_files():
        machine = load_machine(name)
        for controller in machine.controllers:
            CONTROLLERS[controller].read_settings(machine)
        assert len(active_effects(machine)) == len(machine.effects)


def test_a_copy_beside_its_original_is_a_second_machine_of_that_name(tmp_path):
    shipped = data_folder("machines") / "zha-gantry.toml"
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).write_bytes(shipped.read_bytes())
    with pytest.raises(InputError, match="two machines have the name 'zha-gantry'"):
        load_machine("zha-gantry", (tmp_path,))
    with pytest.warns(CompgenWarning, match="skipped: two machines have the name 'zha-gantry'"):
        assert "moving-table-mill" in machine_files((tmp_path,))


def test_a_doubled_name_and_a_broken_file_do_not_block_the_other_machines(shipped, saved):
    """A copied machine, a copied scenario, a job, a broken file: the machine that is asked for is used."""
    saved(GOOD, "shipped/a.toml"), saved(GOOD, "shipped/b.toml")
    wanted = saved(GOOD.replace('"mill"', '"lathe"'), "shipped/c.toml")
    saved('name = "lathe"\nseed = 3\n[errors]\n', "shipped/lathe.scenario.toml")
    assert load_machine("lathe").source == wanted
    with pytest.warns(CompgenWarning, match="two machines have the name 'mill'"):
        assert machine_files() == {"lathe": wanted}
    saved("name = = 3", "shipped/d.toml")
    with pytest.warns(CompgenWarning, match=r"d\.toml:1"):
        assert load_machine("lathe").source == wanted


def test_what_programs_need_of_a_machine(saved):
    """Where G28 leads is stated, or machine zero; where that is outside the travel it is not known."""
    text = GOOD.replace("[-800.0, 0.0, 10.0]", "[-800.0, 0.0, 110.0]").replace("[0.0, 350.0]", "[100.0, 350.0]")
    usual = read_machine(saved(text))
    assert (usual.reference_position_mm, usual.travel_margin_mm) == (None, 0.0)
    assert usual.reference_place_mm[:2] == (0.0, 0.0) and np.isnan(usual.reference_place_mm[2])
    stated = read_machine(saved("reference_position_mm = [-800.0, 1.0, 360.0]\ntravel_margin_mm = 0.5\n" + text))
    assert (stated.reference_place_mm, stated.travel_margin_mm) == ((-800.0, 1.0, 360.0), 0.5)
    some = read_machine(saved("reference_position_mm = { Z = 350 }\n" + text))
    assert some.reference_place_mm == (0.0, 0.0, 350.0)
    for line, message in (
        ("reference_position_mm = [0.0, 0.0]", "reference_position_mm"),
        ("reference_position_mm = { W = 1.0 }", "table such as { Z = 500.0 }"),
        ("reference_position_mm = { Z = 2e6 }", "less than a kilometre"),
        ("travel_margin_mm = -1", "from 0 to 100 mm"),
        ("travel_margin_mm = 101", "from 0 to 100 mm"),
    ):
        assert message in refusal(saved(f"{line}\n{text}"))


# --- rotary axes -----------------------------------------------------------------------------------------------------

FIVE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 7 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
"""


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("WCAYFXZT", "WCACYFXZT", 2, "C appears twice"),
        ("WCAYFXZT", "WCAYFXZCT", 2, "C appears twice"),
        ("WCAYFXZT", "WCUYFXZT", 2, "U is no axis"),
        ("WCAYFXZT", "WCYFXZT", 6, "the chain WCYFXZT has no axis A"),
        ("axes.A", "axes.D", 6, "is no axis; known: X, Y, Z, A, B, C"),
        ("nodes = 8", "nodes = 8, direction = [0.0, 0.0, 0.0]", 6, "(0, 0, 0) has none"),
        ("nodes = 8", "nodes = 8, direction = [0.0, 1.0, 1.0]", 6, "of its direction is [0, 0.707107, 0.707107]"),
        ("nodes = 8", "nodes = 8, direction = [0.0, 0.0072, 0.0071]", 6, "expected a vector of length 1"),
        ("nodes = 8", "nodes = 8, direction = [-1.0, 0.0, 0.0]", 6, "points against A of ISO 841; reverse it"),
        ("nodes = 8", "nodes = 8, direction = [0.0, 1.0]", 6, "expected three numbers"),
        ("-110.0, 30.0", "30.0, -110.0", 6, "with the lower number first"),
        ("-110.0, 30.0", "-1.9199, 0.5236", 6, "are these radians ([-110, 30] degrees)"),
        ("-110.0, 30.0", "-1.5708, 1.5708", 6, "are these radians ([-90, 90] degrees)"),
        ("-110.0, 30.0", "-11000000.0, 30.0", 6, "is the unit degrees"),
        ("360.0", "6.2832", 7, "360, not 2 pi"),
        ("360.0", "350.0", 7, "expected 360 degrees, or an even part of them"),
        ("point_mm = [0.0, 0.0, -50.0], ", "", 6, "point_mm: is missing: a point of the axis line"),
        ("point_mm = [0.0, 0.0, -50.0]", "pivot_mm = [0.0, 0.0, -50.0]", 6, "point_mm"),
        ("range_deg", "range_rad", 6, "range_rad"),
        ("nodes = 8", "nodes = [-1.9, 0.0, 0.5]", 6, "expected -110 ... 30, the travel"),
        ("nodes = 8", "nodes = [-200.0, 0.0, 200.0]", 6, "expected -110 ... 30, the travel"),
        ("nodes = 8", "nodes = 8, reference_deg = 45.0", 6, "45 degrees is outside"),
    ],
)  # fmt: skip
def test_an_impossible_rotary_axis_is_refused_with_its_line(tmp_path, old, new, line, said):
    (tmp_path / "m.toml").write_text(FIVE.replace(old, new, 1))
    problems = problems_of(tmp_path / "m.toml", lambda root: machine_of(root, tmp_path / "m.toml")).problems
    assert any(said in str(problem) and problem.line == line for problem in problems), [str(one) for one in problems]


@pytest.mark.parametrize(
    ("direction", "asked"),
    [([0.7071, 0.0, 0.7071], False), ([0.0, 0.7071, 0.7071], True), ([-0.6, 0.0, 0.8], True), ([1.0, 0.0, 0.0], False)],
)
def test_a_nutating_direction_is_taken_and_one_far_from_its_letter_asked_about(tmp_path, direction, asked):
    (tmp_path / "m.toml").write_text(FIVE.replace("nodes = 8", f"nodes = 8, direction = {direction}"))
    machine = read_machine(tmp_path / "m.toml")
    unit = np.array(direction) / np.linalg.norm(direction)
    assert machine.rotary["A"].direction == pytest.approx(unit, abs=1e-15)
    assert bool(machine.doubts) == asked
