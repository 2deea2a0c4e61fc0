"""LinuxCNC: COMP_FILE per joint, and the table of the kinematics module volkins, against hand-worked numbers and C."""

import shutil
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.controls.linuxcnc_comp import comp_table, parse_comp, standstill_outcome
from compgen.controls.linuxcnc_volumetric import VolCurve, VolTable, VolTerm, parse_volcomp
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import CURVE_NAMES, error_named
from compgen.errors import InputError
from compgen.kinematics.many_points import volumetric_error
from compgen.resources import data_folder
from compgen.tables.render import load_format, render_files

GOLDEN = Path(__file__).parents[1] / "golden"
COMP, VOLUMETRIC = "linuxcnc-comp", "linuxcnc-volumetric"
AGREEMENT_MM = 1e-12
#: Of decimals and float32 in a COMP_FILE, and of the decimals of 21 curves with levers below 1 m.
COMP_QUANTUM_MM, VOLUMETRIC_QUANTUM_MM = 1e-7, 1e-8
TRAVELS = ((-300.0, 500.0), (-150.0, 700.0), (-420.0, 80.0))


def machine_with(chain="WXYFZT", reference="X", tool=(3.0, -40.0, -155.0), **controls):
    """An asymmetric machine; ``controls`` are settings of both controls that know them."""
    sections = {
        name: toml_files.Section({"loss_um": 1e-9, **controls.get(key, {})}, path=None, name=f"controllers.{name}")
        for name, key in ((COMP, "comp"), (VOLUMETRIC, "volumetric"))
    }
    x, y, z = (Axis(travel, np.linspace(*travel, 6)) for travel in TRAVELS)
    return Machine("lopsided", Chain(chain), (x, y, z), reference, tool, (10.0, 20.0, -30.0), controllers=sections)


def random_errors(machine, seed=7, names=CURVE_NAMES):
    """All errors at the nodes of the machine, some um and some ten urad, none alike."""
    generator = np.random.default_rng(seed)
    curves = {}
    for name in names:
        error = error_named(name)
        nodes = machine.axes[error.axis].nodes_mm
        value = generator.normal(size=len(nodes)) * (1e-2 if error.kind == "linear" else 3e-5)
        curves[name] = Curve(nodes, value, np.full(len(nodes), np.nan))
    return ErrorTable(curves, {"EC0Y": (1.1e-5, 0.0), "EB0Z": (-2e-5, 0.0), "EA0Z": (3e-5, 0.0)})


COMMON = {
    "version": "0", "machine_name": "lopsided", "chain": "", "input_sha256": "0" * 64, "inputs": [],
}  # fmt: skip


def built(name, machine, errors):
    """Tables and texts from the natural start values."""
    control = controller_named(name)
    own = control.read_settings(machine)
    basis = control(machine, own).basis(errors)
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    return tables, render_files(load_format(name), {**COMMON, **control(machine, own).context(tables)})


def parsed(name, machine, texts):
    control = controller_named(name)
    sources = [SourceFile(Path(file), text) for file, text in texts.items()]
    return control(machine).parse(sources)


def added(name, machine, texts, points):
    control = controller_named(name)
    return control(machine).emulate(parsed(name, machine, texts), points)


def golden(name, *files):
    """Texts as they are, line ends too."""
    return {file: (GOLDEN / name / file).read_bytes().decode() for file in files}


def random_points(machine, count=40, seed=3, beyond=60.0):
    low, high = machine.lower_mm - beyond, machine.upper_mm + beyond
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


# --- COMP_FILE --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("position", "direction", "trim"),
    [
        (-100, 1, 0.010),
        (-80, 1, 0.006),
        (120, 1, 0.0025),
        (20, -1, -0.00825),
        (-900, 1, 0.010),
        (900, 1, 0.006),
        (900, -1, 0.004),
    ],
)
def test_a_file_of_type_0_gives_nominal_minus_actual_in_the_direction_of_travel(position, direction, trim):
    table = parse_comp(SourceFile(Path("a"), golden(COMP, "joint0-x.comp")["joint0-x.comp"]), 0)
    assert table.at(np.array([float(position)]), direction)[0] == pytest.approx(trim, abs=1e-9)


def test_what_the_control_reads_is_read_crlf_exponents_further_columns_and_a_single_row():
    machine = machine_with()
    texts = golden(COMP, "joint1-y.comp", "joint2-z.comp")
    up, down = (
        added(COMP, machine, texts, Points(np.array([[1.0, 7.0, -3.0]]), approach=np.full((1, 3), direction)))[0]
        for direction in (1.0, -1.0)
    )
    assert up == pytest.approx([0.0, 0.25, np.float32(0.015)], abs=0)
    assert down == pytest.approx([0.0, 0.5, np.float32(-0.015)], abs=0)


def rule_of_the_control(nominal, trims, position):
    """The control's rule row by row: float32 trims and slopes, double positions, end values outside."""
    trims = [np.float32(trim) for trim in trims]
    if position < nominal[0]:
        return float(trims[0])
    if position >= nominal[-1]:
        return float(trims[-1])
    row = max(k for k in range(len(nominal)) if nominal[k] <= position)
    slope = np.float32(float(np.float32(trims[row + 1] - trims[row])) / (nominal[row + 1] - nominal[row]))
    return float(trims[row]) + float(slope) * (position - nominal[row])


def test_the_emulator_rounds_as_the_control_does():
    generator = np.random.default_rng(1)
    nominal = np.cumsum(generator.uniform(0.5, 30.0, 256)) - 700.0
    forward = generator.normal(size=256) * 0.05
    table = comp_table(0, nominal, forward, -forward)
    positions = np.concatenate([generator.uniform(-900, 4500, 500), nominal])
    for direction, trims in ((1, forward), (-1, -forward)):
        expected = [rule_of_the_control(nominal, trims, position) for position in positions]
        assert np.array_equal(table.at(positions, direction), expected)


@pytest.mark.parametrize("file_type", [0, 1])
def test_the_exported_files_add_minus_the_error(file_type):
    """EXX = +0.010 at 500: the motor of X is sent 0.010 mm less far."""
    machine = machine_with(comp={"comp_file_type": file_type})
    curve = Curve(np.array([-300.0, 500.0]), np.array([0.0, 0.010]), np.full(2, np.nan))
    tables, texts = built(COMP, machine, ErrorTable({"EXX": curve}))
    assert added(COMP, machine, texts, Points(np.array([[500.0, 0, 0], [100.0, 0, 0]])))[:, 0] == pytest.approx(
        [-0.010, -0.005], abs=COMP_QUANTUM_MM
    )
    last = texts["joint0-x.comp"].splitlines()[-1].split()
    assert last == ["500.000000000", *(["-0.010000000"] * 2 if file_type else ["500.010000000"] * 2)]
    assert np.array_equal(parsed(COMP, machine, texts).tables[0].positive, tables.tables[0].positive)


@pytest.mark.parametrize("file_type", [0, 1])
def test_files_for_an_inch_machine_hold_inches(file_type):
    """EXX = +0.0127 mm (0.0005 inch) at 500 mm (19.685039370 inch): that trim, with the opposite sign, at that place."""
    machine = machine_with(comp={"comp_file_type": file_type, "machine_units": "inch"})
    curve = Curve(np.array([-300.0, 500.0]), np.array([0.0, 0.0127]), np.full(2, np.nan))
    tables, texts = built(COMP, machine, ErrorTable({"EXX": curve}))
    last = texts["joint0-x.comp"].splitlines()[-1].split()
    assert last == ["19.685039370", *(["-0.000500000"] * 2 if file_type else ["19.685539370"] * 2)]
    points = Points(np.array([[500.0, 0, 0], [100.0, 0, 0]]))
    assert added(COMP, machine, texts, points)[:, 0] == pytest.approx([-0.0127, -0.00635], abs=COMP_QUANTUM_MM)
    read = parsed(COMP, machine, texts)
    assert np.array_equal(read.tables[0].positive, tables.tables[0].positive)
    control = controller_named(COMP)
    assert control(machine).violations(read) == []
    metric = machine_with(comp={"comp_file_type": file_type})
    found = control(metric).violations(parsed(COMP, metric, texts))
    assert len(found) == 3
    assert all("in inch it would cover the travel: is machine_units right?" in text for text in found)


def test_an_inch_machine_is_corrected_as_one_in_mm_reversal_too_and_the_preflight_says_the_unit():
    unknown = np.full(3, np.nan)
    nodes = np.array([-300.0, 20.0, 500.0])
    backlash = ReversalCurves({(0, 0): Curve(nodes, np.array([-0.006, 0.002, 0.004]), unknown)})
    points = random_points(machine_with(), beyond=0.0)
    found = {}
    for unit in ("mm", "inch"):
        machine = machine_with(comp={"machine_units": unit})
        made = compgen.export(machine, random_errors(machine), COMP, reversal=backlash)
        assert f"**The files are in {unit}**" in made.preflight
        assert f"| `[TRAJ] LINEAR_UNITS` | {unit} |" in made.preflight
        assert f"{unit}/s2" in made.preflight
        found[unit] = [
            added(COMP, machine, made.files, Points(points, approach=np.full((40, 3), way))) for way in (1.0, -1.0)
        ]
    assert np.max(np.abs(np.subtract(found["mm"], found["inch"]))) < 2 * COMP_QUANTUM_MM
    assert np.max(np.abs(found["mm"])) > 0.01


def test_exported_files_hold_rows_of_three_plain_numbers_and_nothing_else():
    machine = machine_with()
    x = np.linspace(*TRAVELS[0], 900)
    curve = Curve(x, 0.01 * np.sin(x / 7.0), np.full(900, np.nan))
    _, texts = built(COMP, machine, ErrorTable({"EXX": curve}))
    for text in texts.values():
        lines = text.split("\n")
        assert lines.pop() == ""
        assert 2 <= len(lines) <= 256
        assert all(len(word.partition(".")[2]) == 9 for line in lines for word in line.split(" "))
        nominal = [float(line.split()[0]) for line in lines]
        assert all(a < b for a, b in zip(nominal, nominal[1:], strict=False))
    assert len(texts["joint0-x.comp"].splitlines()) > 200


def test_a_reversal_goes_into_the_columns_with_half_of_it_in_each():
    """B = -0.006: the tool stops short by 3 um after positive travel, so +3 um forward and -3 um reverse are added."""
    machine = machine_with()
    unknown = np.full(2, np.nan)
    curves = {
        (0, 0): Curve(np.zeros(1), np.array([-0.006]), unknown[:1]),
        (2, 2): Curve(np.array([-200.0, 0.0]), np.array([0.002, 0.010]), unknown),
        (0, 1): Curve(np.zeros(1), np.array([0.004]), unknown[:1]),
    }
    made = compgen.export(machine, random_errors(machine), COMP, reversal=ReversalCurves(curves))
    points = random_points(machine, beyond=0.0)
    up, down = (added(COMP, machine, made.files, Points(points, approach=np.full((40, 3), d))) for d in (1.0, -1.0))
    expected = np.zeros((40, 3))
    expected[:, 0] = 0.006
    expected[:, 2] = -np.interp(points[:, 2], [-200.0, 0.0], [0.002, 0.010])
    assert np.max(np.abs(up - down - expected)) < 2 * COMP_QUANTUM_MM
    unknown_way = added(COMP, machine, made.files, Points(points))
    assert np.max(np.abs(unknown_way - 0.5 * (up + down))) < AGREEMENT_MM
    assert any("reversal X in Y" in warning for warning in made.warnings)


@pytest.mark.parametrize(
    ("acceleration", "lost_um"), [(5000.0, (1.25, 2.5)), (1e5, (25.0, 50.0)), (1000.0, (0.25, 0.5))]
)
def test_the_dead_zone_of_small_steps(acceleration, lost_um):
    """Known zones at a servo period of 1 ms; at 5000 mm/s2 a step of 2 um was never applied, one of 1 um was."""
    low, high = (value * 1e-3 for value in lost_um)
    assert standstill_outcome(0.999 * low, acceleration, 1e-3) == "at once"
    assert standstill_outcome(1.001 * low, acceleration, 1e-3) == "never"
    assert standstill_outcome(0.999 * high, acceleration, 1e-3) == "never"
    assert standstill_outcome(1.001 * high, acceleration, 1e-3) == "ramped"


@pytest.mark.parametrize(("acceleration", "warned"), [(5000.0, True), (1000.0, False), (20000.0, False)])
def test_a_reversal_in_the_dead_zone_is_warned_of(acceleration, warned):
    machine = machine_with(comp={"max_acceleration_mm_s2": [acceleration, 1000.0, 1000.0]})
    backlash = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-0.002]), np.full(1, np.nan))})
    made = compgen.export(machine, random_errors(machine), COMP, reversal=backlash)
    assert any("does not apply such a step" in text for text in made.warnings) is warned
    assert "not 4000 ... 8000 mm/s2" in made.preflight
    for line in ("COMP_FILE = joint2-z.comp", "COMP_FILE_TYPE = 1", "[JOINT_1]"):
        assert line in made.preflight


ROW = "0 0.1 0.1\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", 1, "no row"),
        ("\n\n", 1, "no row"),
        ("# nominal forward reverse\n" + ROW, 1, "comment"),
        (ROW + "; more\n5 0.1 0.1\n", 2, "comment"),
        (ROW + "\n5 0.1 0.1\n", 2, "blank"),
        (ROW + "5 0.1\n", 2, "2 columns"),
        (ROW + "5 0.1 0.1", 2, "no line end"),
        (ROW + "5 0.1 0.", 2, "no line end"),
        ("0,0 0,0 0,0\n", 1, "the decimal mark of LinuxCNC is '.'"),
        (ROW + "5 abc 0\n", 2, "not a number"),
        (ROW + "5 nan 0\n", 2, "not a number"),
        (ROW + "5 1e999 0\n", 2, "not a number"),
        (ROW + "5 0x1p3 0\n", 2, "not a number"),
        (ROW + ROW, 2, "is not above"),
        (ROW + "-1 0 0\n", 2, "is not above"),
        ("".join(f"{k} 0 0\n" for k in range(257)), 257, "row 257"),
        (ROW + "5 0 0" + " " * 300 + "\n", 2, "characters"),
        ("x" * 300 + "\n", 1, "characters"),
    ],
)
def test_malformed_comp_files_are_refused_with_their_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed(COMP, machine_with(), {"joint0-x.comp": text})
    assert (caught.value.line, Path(caught.value.file).name) == (line, "joint0-x.comp")


def test_256_rows_are_accepted_and_the_name_says_the_joint():
    text = "".join(f"{k} 0 {k}e-6\n" for k in range(256))
    for name, axis in (
        ("joint1-y.comp", 1),
        ("NOT-ACCEPTED-joint2-z.comp", 2),
        ("x.comp", 0),
        ("Y.txt", 1),
        ("joint_2", 2),
    ):
        tables = parsed(COMP, machine_with(), {name: text}).tables
        assert list(tables) == [axis]
        assert len(tables[axis].nodes) == 256
    for names in (("table.comp",), ("x.comp", "joint0-x.comp")):
        with pytest.raises(InputError, match="joint"):
            parsed(COMP, machine_with(), dict.fromkeys(names, text))
    with pytest.raises(InputError, match="no COMP_FILE"):
        parsed(COMP, machine_with(), {})


def test_travel_without_a_table_is_a_violation():
    machine, control = machine_with(), controller_named(COMP)
    own = control.read_settings(machine)
    found = control(machine, own).violations(parsed(COMP, machine, {"x.comp": "-300 0 0\n499 0 0\n"}))
    assert len(found) == 3
    assert "there is no COMP_FILE for Y" in found[0]
    assert "499" in found[2]


# --- the table of volkins ---------------------------------------------------------------------------------------------


def test_the_hand_written_table_gives_the_hand_worked_error():
    table = parse_volcomp(SourceFile(Path("t"), golden(VOLUMETRIC, "hand.tab")["hand.tab"]))
    found = table.error(np.array([[-4.5, 50.0, 0.0]]), np.array([10.0, 0.0, -80.0]))
    assert found[0] == pytest.approx([0.00025, 0.00015, 0.0], abs=1e-17)


@pytest.mark.parametrize(
    ("position", "error"),
    [
        ((-5, 20, 7), (0.003, 0.03, 0.3)),
        ((0, 10, -700), (0.0025, 0.025, 0.25)),
        ((99, 99, 99), (0.006, 0.06, 0.6)),
        ((-99, 0, 0), (0.001, 0.01, 0.1)),
    ],
)
def test_the_hand_written_grid_counts_x_fastest_and_holds_outside(position, error):
    table = parse_volcomp(SourceFile(Path("t"), golden(VOLUMETRIC, "grid.tab")["grid.tab"]))
    assert table.error(np.array([position], dtype=float), np.zeros(3))[0] == pytest.approx(error, abs=1e-15)


def test_the_table_in_the_documentation_is_a_table():
    page = (Path(__file__).parents[2] / "docs" / "linuxcnc.md").read_text(encoding="utf-8")
    text = page[page.index("volcomp 1\n") :].partition("```")[0]
    table = parse_volcomp(SourceFile(Path("t"), text))
    assert table.error(np.array([[-4.5, 0.0, 0.0]]), np.zeros(3))[0] == pytest.approx([0.002, 0, 0], abs=1e-15)


@pytest.mark.parametrize("chain", CHAINS)
def test_every_chain_is_the_error_model_inverted(chain):
    """The axes go to q with q + E(q) = P, E from the model itself, for any tool."""
    machine = machine_with(chain)
    errors = random_errors(machine)
    _, texts = built(VOLUMETRIC, machine, errors)
    points, tool = random_points(machine, beyond=0.0), np.random.default_rng(2).uniform(-200, 200, (40, 3))
    axes = points + added(VOLUMETRIC, machine, texts, Points(points, tool))
    reached = axes + volumetric_error(machine, errors, axes, tool)
    assert np.max(np.abs(axes - points)) > 0.02
    assert np.max(np.abs(reached - points)) < VOLUMETRIC_QUANTUM_MM


def test_a_machine_with_y_as_reference_direction_is_the_same_with_the_squareness_in_eyx():
    machine = machine_with(reference="Y")
    errors = random_errors(machine)
    _, texts = built(VOLUMETRIC, machine, errors)
    points = random_points(machine, beyond=0.0)
    axes = points + added(VOLUMETRIC, machine, texts, Points(points))
    assert np.max(np.abs(axes + volumetric_error(machine, errors, axes) - points)) < VOLUMETRIC_QUANTUM_MM


def test_the_sign_by_hand():
    """EXX = +0.010 everywhere: the joint of X is sent 0.010 mm less far."""
    machine = machine_with()
    curve = Curve(np.array([-300.0, 500.0]), np.full(2, 0.010), np.full(2, np.nan))
    _, texts = built(VOLUMETRIC, machine, ErrorTable({"EXX": curve}))
    assert added(VOLUMETRIC, machine, texts, Points(np.array([[100.0, 5.0, 6.0]])))[0] == pytest.approx([-0.010, 0, 0])


def test_the_rounds_of_the_inverse_shrink_as_they_did_on_the_control():
    """Errors of 100 um with slopes near 1e-3: some 1e-5, 1e-8, 1e-11 mm are left after 1, 2, 3 rounds."""
    curve = VolCurve("EXX", 0, -300.0, 200.0, np.array([0.1, -0.1, 0.1, -0.1]))
    table = VolTable((curve,), (VolTerm(0, "EXX", 1.0, "1"),))
    wanted = np.array([[-220.0, 0.0, 0.0], [33.0, 0.0, 0.0]])
    exact, axes, left = table.inverse(wanted, np.zeros(3)), wanted, []
    for _ in range(4):
        axes = wanted - table.error(axes, np.zeros(3))
        left.append(float(np.max(np.abs(axes - exact))))
    assert left == pytest.approx([6e-5, 6e-8, 6e-11, 6e-14], rel=0.5)
    assert np.max(np.abs(table.forward(exact, np.zeros(3)) - wanted)) < 1e-13


def test_forward_and_inverse_are_consistent_on_a_machine_with_large_squareness():
    machine = machine_with()
    errors = random_errors(machine).replace(squareness={"EC0Y": (2.9e-3, 0.0), "EB0Z": (-2e-3, 0.0)})
    tables, texts = built(VOLUMETRIC, machine, errors)
    wanted, tool = random_points(machine), np.array([3.0, -40.0, -155.0])
    table = parsed(VOLUMETRIC, machine, texts)
    assert np.max(np.abs(table.forward(table.inverse(wanted, tool), tool) - wanted)) < AGREEMENT_MM
    assert controller_named(VOLUMETRIC)(machine).violations(tables) == []


def test_what_is_written_is_read_back_to_the_last_digit():
    machine = machine_with("WFYXZT", tool=(0.0, 0.0, -80.0))
    for form in ("curves", "grid"):
        machine = machine.with_setting(VOLUMETRIC, "form", form)
        tables, texts = built(VOLUMETRIC, machine, random_errors(machine))
        read = parsed(VOLUMETRIC, machine, texts)
        for mine, theirs in zip(tables.curves, read.curves, strict=True):
            assert (mine.name, mine.axis, mine.first_mm, mine.step_mm) == (
                theirs.name, theirs.axis, theirs.first_mm, theirs.step_mm,
            )  # fmt: skip
            assert np.array_equal(mine.values, theirs.values)
        assert tables.terms == read.terms
        if form == "grid":
            assert np.array_equal(tables.grid.vertices_mm, read.grid.vertices_mm)
            assert tables.grid.vertices_mm.shape == (6, 6, 6, 3)
        again = {name: text.replace("\n", "\r\n  ") for name, text in texts.items() if name.endswith(".tab")}
        points = Points(random_points(machine))
        assert np.array_equal(added(VOLUMETRIC, machine, again, points), added(VOLUMETRIC, machine, texts, points))


@pytest.mark.parametrize("form", ["curves", "grid"])
def test_a_table_in_inch_is_the_table_in_mm(form):
    """1 inch is 25.4 mm: what is added at a point is the same; the text says its unit, and its numbers are in inch."""
    machine = machine_with().with_setting(VOLUMETRIC, "form", form)
    inch = machine.with_setting(VOLUMETRIC, "machine_units", "inch")
    errors = random_errors(machine)
    _, metric = built(VOLUMETRIC, machine, errors)
    tables, texts = built(VOLUMETRIC, inch, errors)
    assert metric["volcomp.tab"].startswith("volcomp 1\nunit mm\n")
    assert texts["volcomp.tab"].startswith("volcomp 1\nunit inch\n")
    tool = None if form == "grid" else np.random.default_rng(2).uniform(-200, 200, (40, 3))
    points = Points(random_points(machine), tool)
    assert np.max(np.abs(added(VOLUMETRIC, inch, texts, points) - added(VOLUMETRIC, machine, metric, points))) < 1e-8
    read = parsed(VOLUMETRIC, inch, texts)
    assert np.array_equal(read.error(points.position_mm, np.zeros(3)), tables.error(points.position_mm, np.zeros(3)))
    control = controller_named(VOLUMETRIC)
    assert control(inch).violations(read) == []
    assert any("is in inch" in text for text in control(machine).violations(read))
    start, step = texts["volcomp.tab"].split("\n")[2].split()[-2:] if form == "curves" else (None, None)
    if form == "curves":
        assert float(start) == pytest.approx(-300 / 25.4, abs=1e-11)
        assert float(step) == pytest.approx(160 / 25.4, abs=1e-11)
    assert "LINEAR_UNITS = inch" in texts["volkins.ini"]
    assert "MIN_LIMIT = -11.811024\nMAX_LIMIT = 19.685040" in texts["volkins.ini"]  # -300 ... 500 mm, outward


HAND_INCH = """volcomp 1
unit inch
curve EXX 0 2 -10 20 0.001 0.003
curve ECX 0 2 -10 20 1e-5 3e-5
term 0 EXX 1 1
term 0 ECX -1 y term 1 ECX 1 tx
{more}end
"""


@pytest.mark.parametrize(("more", "ez_inch"), [("", 0.0), ("term 2 EXX 2 z\n", 2 * 0.002 * 4.0)])
def test_a_hand_written_table_in_inch_gives_the_hand_worked_error(more, ez_inch):
    """At X 0 Y 5 Z 4 inch, tool 3 inch: EX = 0.002 - 5 * 2e-5 inch, EY = 3 * 2e-5 inch; also a curve used in both ways."""
    table = parse_volcomp(SourceFile(Path("t"), signed(HAND_INCH.format(more=more))))
    found = table.error(np.array([[0.0, 5 * 25.4, 4 * 25.4]]), np.array([3 * 25.4, 0.0, 0.0]))[0]
    assert found == pytest.approx([25.4 * 0.0019, 25.4 * 6e-5, 25.4 * ez_inch], abs=1e-15)


def test_the_setting_of_joints_names_axes():
    machine = machine_with().with_setting(VOLUMETRIC, "coordinates", "xyyza")
    _, texts = built(VOLUMETRIC, machine, random_errors(machine))
    assert "coordinates=XYYZA\nJOINTS = 5" in texts["volkins.ini"]
    for joint, low in ((1, "-151.000000"), (2, "-151.000000"), (3, "-421.000000")):
        assert f"[JOINT_{joint}]\nMIN_LIMIT = {low}" in texts["volkins.ini"]
    assert "[JOINT_4]" not in texts["volkins.ini"]
    assert "loadrt volcomp" not in texts["volcomp.hal"]  # a gantry needs volkins
    for wrong in ("XYA", "XYZQ", 3, "XYZ" * 6):
        with pytest.raises(InputError, match="expected one axis letter for each of at most 16 joints"):
            built(VOLUMETRIC, machine.with_setting(VOLUMETRIC, "coordinates", wrong), random_errors(machine))


def test_a_grid_is_the_curves_at_its_vertices_for_the_tool_of_the_machine():
    machine = machine_with()
    errors = random_errors(machine)
    grid, _ = built(VOLUMETRIC, machine.with_setting(VOLUMETRIC, "form", "grid"), errors)
    nodes = [axis.nodes_mm for axis in machine.axes]
    corners = np.stack(np.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, 3)
    found = grid.error(corners, np.zeros(3))
    assert np.max(np.abs(found - volumetric_error(machine, errors, corners))) < VOLUMETRIC_QUANTUM_MM


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
def test_an_export_with_large_squareness_leaves_nothing_of_second_order(chain):
    """Tables are looked up where the axes stand; taken at the command, 2.9 mrad over a metre would leave 8 um."""
    machine = machine_with(chain)
    errors = random_errors(machine).replace(squareness={"EC0Y": (2.9e-3, 0.0)})
    made = compgen.export(machine, errors, VOLUMETRIC)
    result = verified(machine, made, errors)
    assert result.accepted
    assert result.before.max_um > 1500
    assert result.after.max_um < 0.5


def verified(machine, made, errors):
    control = controller_named(made.controller)(machine)
    return compgen.verify(
        machine, compgen.ReadTables(control, parsed(made.controller, machine, made.files), ()), errors
    )


@pytest.mark.parametrize("name", [COMP, VOLUMETRIC])
@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
def test_the_exported_text_makes_the_exact_machine_better(name, chain):
    machine = machine_with(chain)
    result = verified(machine, compgen.export(machine, random_errors(machine), name), random_errors(machine))
    assert result.accepted, result.reasons
    assert result.after.max_um < (0.05 if name == VOLUMETRIC else 1.0) * result.before.max_um


BODY = "volcomp 1\ncurve A 0 2 0 1 0.1 0.2\nterm 0 A 1 x\nend\n"


def signed(body):
    """A table with the checksum that belongs to its words."""
    words = body.split()
    return f"{body}crc32 {zlib.crc32(' '.join(words).encode()):08X}\n"


MALFORMED = [
    ("", 1, "expected"),
    ("hello 1\n", 1, "volcomp"),
    ("volcomp 2\nend\n", 1, "volcomp"),
    ("volcomp 1\nunit cm\ncurve A 0 1 0 1 0.1\nterm 0 A 1 x\nend\n", 2, "not a unit"),
    ("volcomp 1\nunit\nend\n", 3, "not a unit"),
    ("volcomp 1\nunit mm\nunit mm\ncurve A 0 1 0 1 0.1\nterm 0 A 1 x\nend\n", 3, "expected"),
    ("volcomp 1\ncurve A 0 1 0 1 0.1\nunit inch\nterm 0 A 1 x\nend\n", 3, "expected"),
    ("volcomp 1\nend\n", 2, "terms or a grid"),
    ("volcomp 1\ncurve A 0 2 0 1\n0.1\n0,2\nend\n", 4, "the decimal mark of LinuxCNC is '.'"),
    ("volcomp 1\ncurve A 3 2 0 1 0.1 0.2\nend\n", 2, "axis"),
    ("volcomp 1\ncurve A 0 3 0 1 0.1 0.2\nterm 0 A 1 x\nend\n", 3, "not a number"),
    ("volcomp 1\ncurve A 0 2 0 1 0.1 0.2 0.3\nend\n", 2, "expected"),
    ("volcomp 1\ncurve A 0 2 0 0 0.1 0.2\nend\n", 2, "step"),
    ("volcomp 1\ncurve A 0 2 0 1 0.1 nan\nend\n", 2, "not a number"),
    ("volcomp 1\ncurve A 0 2 0 1 0.1 1e999\nend\n", 2, "not a number"),
    ("volcomp 1\ncurve A 0 2 0 1 0.1 0x1\nend\n", 2, "not a number"),
    ("volcomp 1\ncurve A 0 99999999 0 1\nend\n", 2, "number of nodes"),
    ("volcomp 1\ncurve A 0 1 0 1 0.1\ncurve A 0 1 0 1 0.1\nend\n", 3, "new name"),
    ("volcomp 1\nterm 0 A 1 x\nend\n", 2, "no curve"),
    ("volcomp 1\ncurve A 0 1 0 1 0.1\nterm 0 A 1 w\nend\n", 3, "lever"),
    ("volcomp 1\n# a comment\nend\n", 2, "expected"),
    ("volcomp 1\ngrid 1 1 1 0 0 0 1 1 1\n1 2\nend\n", 4, "not a number"),
    ("volcomp 1\ngrid 9999 9999 9999 0 0 0 1 1 1\nend\n", 2, "more than"),
    ("volcomp 1\ngrid 1 1 1 0 0 0 1 1 1 1 2 3 grid 1 1 1 0 0 0 1 1 1 1 2 3\nend\n", 2, "expected"),
]


@pytest.mark.parametrize(("body", "line", "words"), MALFORMED)
def test_malformed_tables_are_refused_with_their_line(body, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed(VOLUMETRIC, machine_with(), {"volcomp.tab": signed(body)})
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BODY, "truncated"),
        (signed(BODY).replace("0.2", "0.3"), "checksum"),
        (signed(BODY).replace("crc32 ", "crc32 0"), "checksum"),
        (signed(BODY) + "term 0 A 1 x\n", "may follow"),
        (signed(BODY) + "crc32 00000000\n", "may follow"),
        (signed(BODY)[:-3], "checksum"),
    ],
)
def test_a_table_that_was_changed_or_cut_is_refused(text, words):
    assert parse_volcomp(SourceFile(Path("t"), signed(BODY))).terms
    with pytest.raises(InputError, match=words):
        parsed(VOLUMETRIC, machine_with(), {"volcomp.tab": text})


def test_files_beside_the_table_must_be_whole_and_the_table_there_once():
    machine = machine_with()
    _, texts = built(VOLUMETRIC, machine, random_errors(machine))
    sources = {"volkins.comp", "volcomp.comp", "volcomp.h", "COPYING"}
    assert set(texts) == {"volcomp.tab", "volkins.ini", "volkins.hal", "volcomp.hal"} | sources
    for name, text in texts.items():
        for cut in (0, len(text) // 2, len(text) - 2):
            with pytest.raises(InputError):
                parsed(VOLUMETRIC, machine, {**texts, name: text[:cut]})
    with pytest.raises(InputError, match="second table"):
        parsed(VOLUMETRIC, machine, {**texts, "other.tab": texts["volcomp.tab"]})
    with pytest.raises(InputError, match="no table"):
        parsed(VOLUMETRIC, machine, {"volkins.ini": texts["volkins.ini"]})


def test_the_sources_are_exported_as_they_are_with_their_licence():
    folder = data_folder("templates") / VOLUMETRIC
    _, texts = built(VOLUMETRIC, machine_with(), random_errors(machine_with()))
    for name in ("volkins.comp", "volcomp.comp", "volcomp.h"):
        assert texts[name] == (folder / name).read_text()
        assert texts[name].startswith("// SPDX-License-Identifier: GPL-2.0-or-later")
    assert "GNU GENERAL PUBLIC LICENSE" in texts["COPYING"]
    assert texts["COPYING"] == (folder / "COPYING").read_text()


def test_errors_too_steep_for_an_inverse_are_a_violation_and_no_endless_loop():
    machine, control = machine_with(), controller_named(VOLUMETRIC)
    steep = VolTable((VolCurve("A", 0, -300.0, 1.0, np.tile([0.0, 2.0], 401)),), (VolTerm(0, "A", 1.0, "1"),))
    own = control.read_settings(machine)
    assert any("2.00 mm per mm" in text for text in control(machine, own).violations(steep))
    with pytest.raises(InputError, match="too fast"):
        control(machine, own).emulate(steep, Points(random_points(machine)))


@pytest.mark.parametrize("name", [COMP, VOLUMETRIC])
@pytest.mark.parametrize(
    ("part", "times"),
    [
        ("x", 50_000_000),
        ("0 0 0 \n", 8_000_000),
        ("\n", 50_000_000),
        ("\n", 900_000),
        ("0 0 0 \n", 100_000),
        ("volcomp 1 ", 5_000_000),
    ],
)
def test_garbage_of_any_size_is_refused_at_a_cost_that_grows_with_it(name, part, times):
    def read(text):
        with pytest.raises(InputError):
            parsed(name, machine_with(), {"x.comp" if name == COMP else "volcomp.tab": text})

    assert grows_with_its_file(read, part)
    read(part * times)


CHARACTERS = st.text(alphabet="0123456789.,-+eE \t\r\n#xyzt\x00endcurvtmgi", max_size=80)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(text=CHARACTERS, at=st.integers(0, 10_000), length=st.integers(0, 40), name=st.sampled_from([COMP, VOLUMETRIC]))
def test_any_text_is_read_or_refused(text, at, length, name):
    whole = golden(COMP, "joint0-x.comp")["joint0-x.comp"] if name == COMP else signed(BODY)
    at = at % len(whole)
    for given_text in (text, whole[:at] + text + whole[at + length :]):
        try:
            parsed(name, machine_with(), {"x.comp" if name == COMP else "volcomp.tab": given_text})
        except InputError as error:
            assert error.file is not None


# --- the C sources, without LinuxCNC ----------------------------------------------------------------------------------

needs_c = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="gcc is not installed: make test installs it on Debian as root"
)


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """The C sources of the module in a small program."""
    program = tmp_path_factory.mktemp("c") / "volcomp_test"
    source = Path(__file__).parents[1] / "linuxcnc" / "volcomp_test.c"
    include = data_folder("templates") / VOLUMETRIC
    words = ["gcc", "-Os", "-Wall", "-Werror", f"-I{include}", "-o", str(program), str(source), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return program


@needs_c
@pytest.mark.parametrize(("form", "unit"), [("curves", "mm"), ("grid", "mm"), ("curves", "inch"), ("grid", "inch")])
def test_c_and_the_emulator_agree_to_the_last_digits(form, unit, reader, tmp_path):
    machine = machine_with().with_setting(VOLUMETRIC, "form", form).with_setting(VOLUMETRIC, "machine_units", unit)
    scale = {"mm": 1.0, "inch": 25.4}[unit]
    _, texts = built(VOLUMETRIC, machine, random_errors(machine))
    (tmp_path / "t").write_text(texts["volcomp.tab"])
    corners = np.stack(np.meshgrid(*(axis.nodes_mm for axis in machine.axes), indexing="ij"), -1).reshape(-1, 3)
    points = np.vstack([random_points(machine, 3000, beyond=200.0), corners])
    tool = np.random.default_rng(6).uniform(-300, 300, points.shape)
    (np.hstack([points, tool]) / scale).tofile(tmp_path / "points")
    words = [str(reader), "-e", str(tmp_path / "t"), str(tmp_path / "points"), str(tmp_path / "out")]
    assert subprocess.run(words, timeout=30, check=False).returncode == 0
    found = np.fromfile(tmp_path / "out").reshape(-1, 6) * scale
    table = parsed(VOLUMETRIC, machine, texts)
    assert np.max(np.abs(found[:, :3] - table.error(points, tool))) < 1e-15
    assert np.max(np.abs(found[:, 3:] - table.inverse(points, tool))) < AGREEMENT_MM


@needs_c
def test_c_refuses_exactly_the_tables_that_the_parser_refuses(reader, tmp_path):
    """Every malformed one, and a good one with one character changed, left out, or doubled in many places."""
    good = signed(BODY)
    texts = [good, "", BODY, *(signed(body) for body, _, _ in MALFORMED)]
    texts += [good[:k] for k in range(len(good))] + [good[:k] + good[k + 1 :] for k in range(len(good))]
    texts += [good[:k] + "7" + good[k:] for k in range(len(good))]
    texts += [signed(BODY[:k] + change + BODY[k:]) for k in range(len(BODY)) for change in ("-", " ", "e", ".", "#")]
    texts += list(golden(VOLUMETRIC, "hand.tab", "grid.tab").values())
    texts += [signed(HAND_INCH.format(more="")), signed(BODY.replace("1\n", "1\nunit mm\n", 1))]
    for k, text in enumerate(texts):
        (tmp_path / f"{k:04}").write_text(text, newline="")
    paths = [str(tmp_path / f"{k:04}") for k in range(len(texts))]
    done = subprocess.run([str(reader), *paths], capture_output=True, text=True, timeout=60, check=True)
    verdicts = [line[0] == "1" for line in done.stdout.splitlines()]
    assert len(verdicts) == len(texts)
    assert sum(verdicts) > 20
    for text, accepted in zip(texts, verdicts, strict=True):
        assert accepted is is_read(text), text


def is_read(text):
    try:
        parse_volcomp(SourceFile(Path("t"), text))
    except InputError:
        return False
    return True
