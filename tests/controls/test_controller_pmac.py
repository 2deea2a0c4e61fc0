"""PMAC compensation tables: 1/16 counts, roll-over, implied zero, order of definition, two dimensions, backlash."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.controls.pmac import CompTable1D, CompTable2D, Ring, rolled, table_context
from compgen.data import toml_files
from compgen.data.error_table import ReversalCurves
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import InputError

NAME = "pmac"
CONTROL = CONTROLLERS[NAME]
GOLDEN = (Path(__file__).parents[1] / "golden" / NAME / "constructed.pmc").read_text()
TRAVELS = ((-300.0, 500.0), (-150.0, 650.0), (-420.0, 80.0))
COUNTS = {"X": 1000.0, "Y": 2000.0, "Z": -500.0}


def machine_with(chain="WXYFZT", travels=TRAVELS, tool=(3.0, -40.0, -155.0), reference=(10.0, 20.0, -30.0), **own):
    section = toml_files.Section(
        {"counts_per_mm": COUNTS, "loss_um": 1.0, **own}, path=None, name=f"controllers.{NAME}"
    )
    x, y, z = (Axis(travel, np.linspace(*travel, 5)) for travel in travels)
    return Machine("lopsided", Chain(chain), (x, y, z), "X", tool, reference, controllers={NAME: section})


PLAIN = machine_with()


def parsed(text, machine=PLAIN):
    texts = text if isinstance(text, dict) else {"comp.pmc": text}
    files = [SourceFile(Path(name), part) for name, part in texts.items()]
    return CONTROL(machine).parse(files)


def added(tables, position, machine=PLAIN, approach=None):
    position = np.atleast_2d(np.asarray(position, dtype=float))
    direction = None if approach is None else np.broadcast_to(np.asarray(approach, dtype=float), position.shape)
    return CONTROL(machine).emulate(tables, compgen.Points(position, approach=direction))


def made(machine, errors, reversal=None):
    exported = compgen.export(machine, errors, NAME, reversal=reversal)
    return exported, parsed(dict(exported.files), machine)


def errors_of(**curves):
    nodes = {axis: np.linspace(*TRAVELS[k], 9) for k, axis in enumerate("XYZ")}
    return compgen.ErrorTable(
        {
            name: compgen.Curve(nodes[name[-1]], slope * nodes[name[-1]], np.full(9, np.nan))
            for name, slope in curves.items()
        }
    )


# --- golden numbers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("counts", "expected"), [(250, 5.0), (500, 10.0), (750, 7.5), (4000, 0.0), (-250, 2.5)])
def test_the_constructed_table_gives_its_counts(counts, expected):
    result = added(parsed(GOLDEN), [counts / 1000.0, 0, 0])
    assert result[0] * 1000.0 == pytest.approx([expected, 0, 0], abs=1e-9)


def test_the_first_entry_stands_one_spacing_above_zero_which_is_zero_itself():
    assert added(parsed(GOLDEN), [[0, 0, 0], [0.5, 0, 0]])[:, 0] == pytest.approx([0.0, 0.010])


def test_negative_travel_stands_at_the_far_end():
    """The manual's example: +-50 000 counts every 500 are 200 entries over 100 000."""
    entries = [0] * 200
    entries[199 - 1] = 16  # entry 199: 500 counts below zero
    text = "#1 DEFINE COMP 200,100000\n" + " ".join(map(str, entries)) + "\nI51=1\n"
    assert added(parsed(text), [[-0.5, 0, 0], [-0.25, 0, 0], [0.5, 0, 0]])[:, 0] == pytest.approx([0.001, 0.0005, 0.0])


def test_a_table_of_two_dimensions_has_its_columns_along_the_row_motor():
    # 2 rows, 3 columns; X (motor 1) is the row motor, Y (motor 2) the column motor, Z the target
    text = "#4\nDEFINE COMP 2.3,#1D,#2D,#3,3000,4000\n16 32 0\n160 176 192 160\n0 16 32 0\nI51=1\n"
    tables = parsed(text)
    assert isinstance(tables.tables[0], CompTable2D)
    assert tables.tables[0].values.tolist() == [[0, 16, 32, 0], [160, 176, 192, 160], [0, 16, 32, 0]]
    # X 1 mm = 1000 counts = one column; Y 1 mm = 2000 counts = one row; Z -500 counts per mm
    points = [[1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [1.5, 0.5, 0], [-1, 0, 0]]
    counts = [1.0, 2.0, 10.0, 11.0, 0.5 * (1.5 + 11.5), 2.0]
    assert added(tables, points)[:, 2] == pytest.approx(np.array(counts) / -500.0)


def test_a_d_behind_a_source_is_its_desired_position():
    """Software Reference, DEFINE COMP: with D the table goes over the commanded position, without over the actual one."""
    text = "#4 DEFINE COMP 2,#1D,#3,4000\n0 0\n#3 DEFINE COMP 2,#1,#2,4000\n0 0\n#2 DEFINE COMP 1.1,#1D,#2,#3,4000,4000\n0 0 0\n"
    tables = parsed(text + "#1 DEFINE COMP 1.1,#1,#2D,#3,4000,4000\n0 0 0\n").tables
    assert [table.desired for table in tables[:2]] == [True, False]
    assert [(table.row_desired, table.column_desired) for table in tables[2:]] == [(True, False), (False, True)]


def test_backlash_is_taken_off_after_negative_travel_of_the_motor_only():
    text = GOLDEN.replace("I51=1", "#1 DEFINE BLCOMP 4,4000\n16 32 0 0\nI186=160\nI51=1")
    tables = parsed(text)
    up, down = (added(tables, [1.0, 0, 0], approach=[sign, 1, 1])[0, 0] for sign in (1, -1))
    assert (up - down) * 1000 == pytest.approx(10.0 + 1.0)  # Ixx86 and the entry at 1000 counts
    z = parsed("#3\nDEFINE COMP 2,4000\n0 0\nI386=160\nI51=1\n")
    assert added(z, [0, 0, 1.0], approach=[1, 1, 1])[0, 2] == pytest.approx(-10.0 / -500.0)  # Z counts against its axis
    assert added(z, [0, 0, 1.0], approach=[1, 1, -1])[0, 2] == 0.0


# --- signs by hand ---------------------------------------------------------------------------------------------------


def test_too_long_a_pitch_gets_negative_entries_in_sixteenths_of_a_count():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    _, tables = made(machine, errors_of(EXX=1e-5))
    pitch = next(table for table in tables.tables if table.motor == 1)
    spacing = pitch.length / len(pitch.entries)
    first = pitch.entries[0]
    assert first == pytest.approx(-16 * 1e-5 * spacing, abs=0.5)  # 10 um/m too long: minus in positive travel
    assert pitch.entries[-2] == pytest.approx(+16 * 1e-5 * spacing, abs=0.5)  # and plus one spacing below zero
    assert pitch.entries[-1] == 0
    assert added(tables, [500, 0, 0], machine)[0, 0] == pytest.approx(-0.005, abs=1 / 16000)


def test_a_straightness_is_owned_by_a_free_motor_and_follows_its_source():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    exported, tables = made(machine, errors_of(EZX=1e-5))
    table = next(table for table in tables.tables if isinstance(table, CompTable1D) and table.target != table.source)
    assert (table.motor, table.source, table.target) == (4, 1, 3)
    assert table.entries[0] > 0  # Z too high: minus in mm, plus in counts of a motor that counts against its axis
    assert added(tables, [400, 0, 0], machine)[0, 2] == pytest.approx(-0.004, abs=1 / 8000)
    commands = re.findall(r"^(#\d+|DEFINE.*)\r$", exported.files["comp.pmc"], re.MULTILINE)
    motors = [int(word[1:]) for word in commands if word.startswith("#")]
    assert motors == sorted(motors, reverse=True)
    assert exported.files["comp.pmc"].endswith("I51=1\r\n")


# --- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "own", [{}, {"two_dimensional": True}, {"home_mm": {"X": 100.0, "Y": -900.0}, "source_position": "actual"}]
)
def test_text_read_back_acts_as_the_terms_with_their_values(own, make_errors):
    machine = machine_with("WFYXZT", **own)
    errors = make_errors(machine)
    read = CONTROL.read_settings(machine)
    basis = CONTROL(machine, read).basis(errors)
    assert any(part.lever is not None for term in basis for part in term.carrier) is own.get("two_dimensional", False)
    values = {term.name: term.start for term in basis}
    tables = CONTROL(machine, read).build(basis, values)
    position = np.random.default_rng(4).uniform(machine.lower_mm, machine.upper_mm, (200, 3))
    due = sum(
        term.carrier_field(position, np.array(machine.tool_offset_mm))
        * term.curve(values[term.name], position)[:, None]
        for term in basis
    )
    assert np.abs(added(tables, position, machine) - due).max() <= CONTROL(machine, read).resolution_mm()
    exported, again = made(machine, errors)
    assert CONTROL(machine, read).violations(again) == []
    assert compgen.export(machine, errors, NAME).files == exported.files


@pytest.mark.parametrize(("chain", "own"), [("WXYFZT", {}), ("WFYXZT", {"two_dimensional": True})])
def test_the_exported_tables_are_accepted(chain, own, make_errors, tmp_path):
    machine = machine_with(chain, **own)
    errors = make_errors(machine)
    reversal = ReversalCurves(
        {(0, 0): compgen.Curve(np.array([-300.0, 500.0]), np.array([0.004, -0.006]), np.full(2, np.nan))}
    )
    for both in (None, reversal):
        paths = compgen.export(machine, errors, NAME, reversal=both).write(tmp_path)
        result = compgen.verify(machine, compgen.read_tables(machine, paths, NAME), errors, reversal=both)
        assert result.accepted, result.reasons
        if own:
            assert result.unrepresentable_um < 2.0


def test_few_motors_keep_the_largest_functions(make_errors):
    machine = machine_with("WFYXZT", motors_available=8)
    tables = made(machine, make_errors(machine))[1]
    assert len(tables.tables) == 8
    assert sorted(table.motor for table in tables.tables) == list(range(1, 9))


def test_a_varying_reversal_becomes_ixx86_and_a_backlash_table():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    curve = compgen.Curve(np.array([-300.0, 500.0]), np.array([-0.002, -0.010]), np.full(2, np.nan))
    exported, tables = made(machine, errors_of(EXX=1e-5), ReversalCurves({(0, 0): curve}))
    assert "DEFINE BLCOMP" in exported.files["comp.pmc"]
    assert tables.constants == {1: round(16 * 1000 * 0.005)}  # B = -5 um at zero
    for x in (-200.0, 0.0, 450.0):
        up, down = (added(tables, [x, 0, 0], machine, [sign, 1, 1])[0, 0] for sign in (1, -1))
        assert up - down == pytest.approx(-curve.at(np.array([x]))[0], abs=2 / 16000)


@pytest.mark.parametrize("parts", [1, 5, 64])
def test_the_spacing_of_the_pitch_is_divided_as_finely_as_the_reversal_bends(parts):
    """Pitch bends every 100 mm, 128 000 counts, and the reversal ``parts`` times as often; 64 is the finest division."""
    machine = machine_with(tool=(0.0, 0.0, 0.0), counts_per_mm={**COUNTS, "X": 1280.0})
    bent = np.array([0, 1, 0, 0, 1, 0, -1, 1, 0.0])
    pitch = compgen.Curve(np.linspace(*TRAVELS[0], 9), 0.05 * bent, np.full(9, np.nan))
    count = 8 * parts + 1
    zigzag = -0.006 + 0.002 * (np.arange(count) % 2)
    reversal = ReversalCurves({(0, 0): compgen.Curve(np.linspace(*TRAVELS[0], count), zigzag, np.full(count, np.nan))})
    _, tables = made(machine, compgen.ErrorTable({"EXX": pitch}), reversal)
    (table,) = tables.backlash
    assert table.length / len(table.entries) == 128_000 / parts


def test_backlash_tables_are_defined_from_the_highest_motor_down():
    """Software Reference, DEFINE BLCOMP: in another order the control gives ERR003."""
    ends = [np.array(travel) for travel in TRAVELS]
    varying = {(k, k): compgen.Curve(at, np.array([-0.006, -0.014]), np.full(2, np.nan)) for k, at in enumerate(ends)}
    exported, tables = made(machine_with(), errors_of(EXX=1e-5), ReversalCurves(varying))
    assert [table.motor for table in tables.backlash] == sorted((t.motor for t in tables.backlash), reverse=True)
    assert len(tables.backlash) == 3
    assert [text for text in CONTROL(machine_with()).violations(tables) if "order" in text] == []


@pytest.mark.parametrize("counts", [1000.0, -1000.0])
@pytest.mark.parametrize("home", [0.0, 120.0])
def test_a_varying_reversal_leaves_minus_half_of_it_after_either_direction(counts, home):
    """ISO 230-2: B is the position reached in positive minus in negative direction; the curves are the mean of both."""
    machine = machine_with(tool=(0.0, 0.0, 0.0), counts_per_mm=counts, home_mm={"X": home})
    curve = compgen.Curve(np.array([-300.0, 500.0]), np.array([-0.002, -0.010]), np.full(2, np.nan))
    _, tables = made(machine, errors_of(EXX=1e-5), ReversalCurves({(0, 0): curve}))

    def at(x, sign):
        return added(tables, [x, 0, 0], machine, [sign, 1, 1])[0, 0]

    for x in (-300.0, -200.0, 0.0, 450.0, 500.0):
        reversal = -0.006 - 0.008 * (x - 100.0) / 800.0
        for sign in (1, -1):
            # what is added there against the zero of the motor, where the tables hold nothing but Ixx86
            moved = at(x, sign) - 0.5 * (at(home, 1) + at(home, -1))
            assert moved == pytest.approx(-1e-5 * (x - home) - 0.5 * sign * reversal, abs=3 / 16000), (x, sign)


# --- rings of nodes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("low", "high", "first", "last", "numbers"),
    [
        # nodes over the travel, one more on either side with the value of the end, the negative ones behind
        (-3, 4, -4, 5, [0, 1, 2, 3, 4, 4, -3, -3, -2, -1]),
        # zero is in the table where the travel does not hold it
        (2, 4, -1, 5, [2, 2, 2, 3, 4, 4, 2]),
        (-4, -2, -5, 1, [-2, -2, -4, -4, -3, -2, -2]),
    ],
)
@pytest.mark.parametrize("counts", [1000.0, -1000.0])
def test_a_ring_holds_the_travel_and_one_node_beyond_it_negative_ones_at_the_far_end(
    counts, low, high, first, last, numbers
):
    settings_ = CONTROL.read_settings(machine_with(counts_per_mm=counts, home_mm={"X": 120.0}))
    ring = Ring(0, 500, low, high)
    assert (ring.first, ring.last, ring.size) == (first, last, len(numbers))
    sign = np.sign(counts)
    assert ring.positions_mm(settings_) == pytest.approx([120.0 + sign * 0.5 * number for number in numbers])
    assert ring.nodes_mm(settings_) == pytest.approx(
        sorted(120.0 + sign * 0.5 * number for number in range(low, high + 1))
    )


@pytest.mark.parametrize(("counts", "step"), [(1000.0, 100_000), (-1250.0, 125_000), (999.994, 100_000)])
def test_a_step_is_a_whole_number_of_counts_the_next_one_if_it_is_broken(counts, step):
    """Errors that bend every 100 mm, from the motor's zero on, need nodes there and nowhere else."""
    machine = machine_with(tool=(0.0, 0.0, 0.0), counts_per_mm={**COUNTS, "X": counts}, home_mm={"X": 0.0})
    nodes = np.linspace(*TRAVELS[0], 9)
    bent = compgen.Curve(nodes, 0.05 * np.array([0, 1, 0, 0, 1, 0, -1, 1, 0.0]), np.full(9, np.nan))
    _, tables = made(machine, compgen.ErrorTable({"EXX": bent}))
    pitch = next(table for table in tables.tables if table.motor == 1)
    assert pitch.length / len(pitch.entries) == step


def test_the_seam_of_a_table_belongs_to_zero():
    """A position that rounding moves just below zero is the end of the last cell, and nothing lies behind it."""
    entries = np.array([160, 80, 0, 16])
    assert rolled(np.array([-1e-20, 0.0, 4000.0 - 1e-12]), 4000, entries) == pytest.approx([16.0, 0.0, 16.0])


@pytest.mark.parametrize("home", [0.0, 0.2, -900.0])
def test_nodes_of_read_tables_cover_the_travel(home):
    """Eight entries over 4000 counts are one for each 0.5 mm of X; so are three columns over 1500; two rows one for 2 mm of Y."""
    machine = machine_with(home_mm={"X": home, "Y": home})
    text = (
        "#4\nDEFINE COMP 2.3,#1D,#2D,#3,1500,8000\n16 32 0\n160 176 192 160\n0 16 32 0\n#1\nDEFINE BLCOMP 2,1000\n0 0\n"
    )
    for tables, steps in ((parsed(GOLDEN, machine), (0.5,)), (parsed(text, machine), (0.5, 2.0))):
        for axis, step in enumerate(steps):
            nodes = CONTROL(machine).table_nodes_mm(tables)[axis]
            low, high = TRAVELS[axis]
            assert low - step < nodes[0] <= low and high <= nodes[-1] < high + step
            assert np.diff(nodes) == pytest.approx(np.full(len(nodes) - 1, step))
            assert (nodes - home) / step == pytest.approx(np.rint((nodes - home) / step), abs=1e-6)


@pytest.mark.parametrize(("own", "tables"), [({}, 3), ({"two_dimensional": True}, 6)])
def test_the_quantum_is_half_of_a_sixteenth_of_the_coarsest_count_in_every_table(own, tables):
    assert CONTROL(machine_with(**own)).resolution_mm() == pytest.approx(tables * 0.5 / 16.0 / 500.0)


@pytest.mark.parametrize(("home", "needed"), [(0.0, 800_000), (-400.0, 900_000), (600.0, 900_000)])
def test_a_table_spans_the_travel_and_the_zero_of_the_motor(home, needed):
    machine = machine_with(home_mm={"X": home})
    for length, named in ((needed, False), (needed - 2, True)):
        found = CONTROL(machine).violations(parsed(f"#1 DEFINE COMP 2,{length}\n0 0\nI51=1\n", machine))
        assert [f"the travel needs {needed}" in text for text in found] == [True] * named


@pytest.mark.parametrize("home", [-300.0, 0.0, 100.0, 437.5, 500.0])
def test_a_function_is_zero_at_the_zero_of_its_motor(home):
    machine = machine_with(tool=(0.0, 0.0, 0.0), home_mm={"X": home})
    terms = [term for term in CONTROL(machine).basis(errors_of(EXX=1e-5, EZX=-2e-5)) if term.axis == 0]
    assert len(terms) == 2
    for term in terms:
        assert term.zero_at_mm == pytest.approx(home)
        assert np.interp(home, term.nodes_mm, term.start) == pytest.approx(0.0, abs=1e-15)


def test_the_one_motor_that_is_free_takes_the_largest_function():
    machine = machine_with(tool=(0.0, 0.0, 0.0), motors_available=4)
    errors = errors_of(EZX=1e-5, EYX=4e-5, EXZ=1e-5, EXY=2e-5)  # over 800, 800, 500 and 800 mm
    (table,) = (table for table in made(machine, errors)[1].tables if table.motor == 4)
    assert (table.source, table.target) == (1, 2)
    # EBY acts as z EBY(y) on X and as -x EBY(y) on Z: X has the longest travel, and 800 mm times 320 urad are most
    flat = machine_with("WFYXZT", tool=(0.0, 0.0, 0.0), motors_available=4, two_dimensional=True)
    (table,) = (t for t in made(flat, errors_of(EZX=1e-5, EBY=4e-7))[1].tables if t.motor == 4)
    assert isinstance(table, CompTable2D)
    assert table.target == 3 and {table.row, table.column} == {1, 2}


@pytest.mark.parametrize(("slope", "count"), [(0.6e-7, 3), (1.2e-7, 4)])
def test_a_function_of_less_than_a_fiftieth_of_a_micrometre_has_no_table(slope, count):
    """A slope over 800 mm in nine even nodes has a standard deviation of 258 mm times the slope: 0.015 and 0.031 um."""
    machine = machine_with(tool=(0.0, 0.0, 0.0), loss_um=1e-3)
    assert len(made(machine, errors_of(EZX=slope))[1].tables) == count


def test_entries_stand_ten_to_a_line_and_rows_without_the_zero_at_their_corner():
    line = table_context(CompTable1D(4, 1, 3, 2500, np.arange(25)), {1: "X", 3: "Z"})
    assert line["command"] == "DEFINE COMP 25,#1D,#3,2500"
    assert line["rows"] == [list(range(10)), list(range(10, 20)), list(range(20, 25))]
    assert line["title"] == "Z over X"
    sheet = table_context(CompTable2D(4, 1, 2, 3, 3000, 4000, np.arange(12).reshape(3, 4), False, True), {1: "X"})
    assert sheet["command"] == "DEFINE COMP 2.3,#1,#2D,#3,3000,4000"
    assert sheet["rows"] == [[1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]


# --- limits and settings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOLDEN, "spans 4000 counts of motor 1, but the travel needs 800000"),
        (GOLDEN.replace("I51=1\n", ""), "I51 is not 1"),
        (GOLDEN.replace("80 0\n", "80 5\n"), "ends with 5"),
        ("#1 DEFINE COMP 2,8000000\n0 0\n#2 DEFINE COMP 2,8000000\n0 0\nI51=1\n", "ERR003"),
        ("#1 DEFINE COMP 1.2,#1,#2,#3,8000000,8000000\n1 2 3 4 5\nI51=1\n", "far edges"),
    ],
)
def test_broken_rules_are_violations(text, words):
    found = CONTROL(PLAIN).violations(parsed(text))
    assert any(words in message for message in found), found


def test_the_entries_of_a_table_are_the_numbers_in_the_file():
    """Software Reference, DEFINE COMP: (rows + 1) (columns + 1) - 1 numbers, without the one at the zero of both motors."""
    tables = parsed("#4\nDEFINE COMP 2.3,#1D,#2D,#3,3000,4000\n16 32 0\n160 176 192 160\n0 16 32 0\nI51=1\n")
    for most, named in ((11, False), (10, True)):
        control = CONTROL(machine_with(max_entries=most))
        assert [usage.used for usage in control.usage(tables) if usage.unit == "entries"] == [11]
        said = f"the table of motor 4 has 11 entries; max_entries is {most}"
        assert (said in control.violations(tables)) == named


def test_the_preflight_gives_the_scale_of_an_inch_machine(make_errors):
    machine = machine_with(counts_per_mm={"X": 1000.0, "Y": 2000.0, "Z": -500.0})
    text = compgen.export(machine, make_errors(machine), NAME).preflight
    for motor, counts in ((1, "1000.000000 counts per mm (25400.0000"), (3, "-500.000000 counts per mm (-12700.0000")):
        assert f"motor {motor} is {'XYZ'[motor - 1]}: {counts} counts per inch)" in text
    assert "Inch machines:" in text


def test_numbers_have_24_bits_and_motors_those_that_there_are():
    largest = 2**23 - 1
    text = f"#1 DEFINE COMP 2,8000000\n{largest} -{largest}\nI186={largest}\nI51=1\n"
    assert parsed(text).constants == {1: largest}
    beyond = (
        text.replace(f"\n{largest} ", f"\n{largest + 1} "),
        text.replace(f"I186={largest}", f"I186={largest + 1}"),
        text.replace("I186=", "I86="),
        text.replace("I186=", "I3386="),
        text.replace("I51=1", "I51=2"),
    )
    for wrong in beyond:
        with pytest.raises(InputError):
            parsed(wrong)
    assert CONTROL.read_settings(machine_with(motors_available=3)).free_motors == []
    with pytest.raises(InputError, match="motor 4 does not exist; use 1 to 3"):
        CONTROL.read_settings(machine_with(motors_available=3, motors={"X": 4}))


@pytest.mark.parametrize(("value", "warned"), [(-1, True), (0, False), (1, False)])
def test_a_negative_backlash_is_said_to_be_one(value, warned):
    tables = parsed(f"#1 DEFINE COMP 2,8000000\n0 0\nI186={value}\nI51=1\n")
    assert any("is negative" in text for text in CONTROL(PLAIN).context(tables)["warnings"]) is warned


def test_counts_per_mm_are_mandatory_and_say_why():
    machine = machine_with()
    bare = Machine("m", machine.chain, machine.axes)
    with pytest.raises(InputError, match="only the machine builder"):
        CONTROL.read_settings(bare)
    with pytest.raises(InputError, match="other than zero"):
        CONTROL.read_settings(machine_with(counts_per_mm={"X": 1.0, "Y": 0.0, "Z": 1.0}))
    with pytest.raises(InputError, match="three different"):
        CONTROL.read_settings(machine_with(motors={"X": 2}))


# --- malformed text --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", None, "contains no data"),
        ("; nothing\n", None, "contains no data"),
        ("I51=1\n", None, "no compensation table"),
        (GOLDEN.replace("#1\n", ""), 1, "no motor is addressed"),
        (GOLDEN.replace("#1\n", "#99\n"), 1, "motor #99 does not exist; use 1 to"),
        (GOLDEN.replace(" 0\nI51=1\n", "\n"), 3, "7 of 8 entries"),
        (GOLDEN.replace(" 0\nI51", "\nI51"), 4, "7 of 8 entries"),
        (GOLDEN.replace("80 0\n", "80 0 5\n"), 3, "too many"),
        (GOLDEN.replace("160", "160.5"), 3, "not a whole number"),
        (GOLDEN.replace("160", "1e2"), 3, "not a whole number"),
        (GOLDEN.replace("160", "1,6"), 3, "not a whole number"),
        (GOLDEN.replace("160", "nan"), 3, "not a whole number"),
        (GOLDEN.replace("8,4000", "8"), 2, "not understood"),
        (GOLDEN.replace("8,4000", "8,#2,#3,#1,4000"), 2, "wrong arguments"),
        (GOLDEN.replace("8,4000", "0,4000"), 2, "above zero"),
        (GOLDEN.replace("COMP 8", "COMP 2.3"), 2, "wrong arguments"),
        (GOLDEN + GOLDEN.replace("I51=1\n", ""), 6, "motor 1 has a second COMP table; the first is in line 2"),
        (GOLDEN.replace("I51=1", "I52=1"), 4, "is not part of compensation"),
        (GOLDEN.replace("I51=1", "MOVE"), 4, "not understood"),
        ("; tables: 2\n" + GOLDEN, None, "declares 2 tables but contains 1"),
        (GOLDEN.replace("#1\n", "#9\n"), None, "is not an axis of the machine file"),
        (GOLDEN + "\N{MICRO SIGN}\n", 5, "ASCII"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed(text)
    assert (str(caught.value.file), caught.value.line) == ("comp.pmc", line)


def test_an_exported_file_that_is_cut_is_refused(make_errors):
    text = compgen.export(PLAIN, make_errors(PLAIN), NAME).files["comp.pmc"]
    for end in range(0, len(text), 1 + len(text) // 50):
        with pytest.raises(InputError):
            parsed(text[:end])


@pytest.mark.parametrize(
    ("head", "part", "times"),
    [("", "\xff", 30_000_000), ("", "1\n", 20_000_000), ("#1\nDEFINE COMP 99999,1\n", "7 ", 10_000_000)],
)
def test_huge_garbage_is_refused_at_a_cost_that_grows_with_it(head, part, times):
    def read(text):
        with pytest.raises(InputError):
            parsed(text)

    assert grows_with_its_file(read, part, head)
    read(head + part * times)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 200), st.text(alphabet="#DEFINCOMPBL.,I51=0 -;\n\x00e", max_size=10))
def test_damaged_text_is_read_or_refused(place, piece):
    at = place % len(GOLDEN)
    with contextlib.suppress(InputError):
        parsed(GOLDEN[:at] + piece + GOLDEN[at + len(piece) :])
