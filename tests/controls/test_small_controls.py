"""Controls of small shops: the makers' numbers, the sign on a machine with errors, what is not held, malformed files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import InputError
from compgen.kinematics.exact_chain import exact_error

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
SKEWS = ("klipper", "marlin", "reprapfirmware", "linuxcnc-matrixkins")
SQUARENESS = {"EC0Y": (310e-6, 0.0), "EB0Z": (-140e-6, 0.0), "EA0Z": (85e-6, 0.0)}
FLOAT32_MM = 6e-5  # of a position of 400 mm
NANOMETRE = 1e-6


def machine_with(chain="WFYXZT", *, reference="X", **settings):
    """A router whose travel, reference point and tool differ between the axes."""
    travels = ((-50.0, 700.0), (0.0, 1200.0), (-180.0, 10.0))
    x, y, z = (Axis(travel, np.linspace(*travel, count)) for travel, count in zip(travels, (6, 5, 4), strict=True))
    machine = Machine("router", Chain(chain), (x, y, z), reference, (3.0, -4.0, -60.0), (0.0, 100.0, 0.0))
    stated = {name.replace("_", "-").rstrip("-"): keys for name, keys in settings.items()}
    sections = {name: machine.controller_settings(name).again(keys) for name, keys in stated.items()}
    return replace(machine, controllers=sections)


def read(name, machine, *paths):
    """The tables of golden files, strictly."""
    control = CONTROLLERS[name](machine)
    return control, control.parse([SourceFile(path, path.read_text()) for path in paths])


def text_of(name, machine, text, file="a.txt"):
    return CONTROLLERS[name](machine).parse([SourceFile(Path(file), text)])


def moved_to(control, tables, positions, direction=1.0):
    position = np.array(positions, dtype=float)
    return position + control.emulate(tables, Points(position, approach=np.full_like(position, direction)))


def left_mm(machine, errors, name):
    """Largest error of the exact machine in its volume, without and with the exported tables, rigid motion removed."""
    control = CONTROLLERS[name](machine)
    made = compgen.export(machine, errors, name, allow_unverified=True)
    tables = control.parse([SourceFile(Path(key), text) for key, text in made.files.items()])
    position = np.random.default_rng(3).uniform(machine.lower_mm, machine.upper_mm, (200, 3))
    added = control.emulate(tables, Points(position, approach=np.ones_like(position)))
    before = exact_error(machine, errors, position)
    after = exact_error(machine, errors, position + added) + added
    return [np.max(np.linalg.norm(without_rigid_motion(position, part), axis=1)) for part in (before, after)]


def without_rigid_motion(position, field):
    """To first order: least squares of three translations and three rotations."""
    columns = [np.tile(axis, (len(position), 1)).ravel() for axis in np.eye(3)]
    columns += [np.cross(axis, position).ravel() / 1e3 for axis in np.eye(3)]
    design = np.array(columns).T
    return field - (design @ np.linalg.lstsq(design, field.ravel(), rcond=None)[0]).reshape(-1, 3)


# --- three skews -----------------------------------------------------------------------------------------------------

COMMANDS = [[100.0, 200.0, 50.0], [-350.0, 420.0, -180.0], [0.0, 0.0, 300.0]]
KLIPPER = [[99.3949565, 200.015, 50.0], [-351.1278434, 419.946, -180.0], [-0.150261, 0.09, 300.0]]
FACTORS = "[skew_correction volcomp]\nxy_skew = 0.0029\nxz_skew = 0.0005\nyz_skew = -0.0003\n"


def test_klipper_moves_to_what_its_own_module_says():
    machine = machine_with()
    control = CONTROLLERS["klipper"](machine)
    assert np.allclose(moved_to(control, text_of("klipper", machine, FACTORS), COMMANDS), KLIPPER, rtol=0, atol=1e-12)


def test_marlin_is_klipper_with_factors_of_single_precision():
    machine = machine_with()
    tables = text_of("marlin", machine, "G21\nM852 I0.0029 J0.0005 K-0.0003\n")
    assert np.allclose(moved_to(CONTROLLERS["marlin"](machine), tables, COMMANDS), KLIPPER, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("last", "expected"),
    [
        (0, [[99.3949966, 200.014999, 50], [-351.127991, 419.946014, -180], [-0.150000006, 0.0900000036, 300]]),
        (1, [[99.9749985, 199.725067, 50], [-349.910004, 420.960724, -180], [-0.150000006, 0.0904350057, 300]]),
    ],
)
def test_reprapfirmware_moves_to_what_its_source_says(last, expected):
    machine = machine_with(reprapfirmware={"moves": "XY"[last]})
    tables = text_of("reprapfirmware", machine, f"M556 S100 X-0.29 Y0.03 Z-0.05 P{last}\n")
    assert np.allclose(
        moved_to(CONTROLLERS["reprapfirmware"](machine), tables, COMMANDS), expected, rtol=0, atol=FLOAT32_MM
    )


@pytest.mark.parametrize(
    ("build", "text", "expected"),
    [
        (
            "three",
            "$37=0.0029\n$38=0.0005\n$39=-0.0003\n",
            [[99.2749939, 200.014999, 50], [-350.695953, 419.946014, -180], [-0.870044947, 0.0900000036, 300]],
        ),
        ("xy-only", "$37=0.0029\n", [[99.4199982, 200, 50], [-351.217987, 420, -180], [0, 0, 300]]),
    ],
)
def test_ucnc_moves_to_what_its_source_says(build, text, expected):
    machine = machine_with(ucnc={"build": build})
    control = CONTROLLERS["ucnc"](machine)
    moved = moved_to(control, text_of("ucnc", machine, text), COMMANDS)
    assert np.allclose(moved, expected, rtol=0, atol=FLOAT32_MM)
    beside_um = 1e3 * abs(moved[0, 0] - KLIPPER[0][0])
    assert beside_um == pytest.approx(120 if build == "three" else 25, abs=0.5)  # as the card says


@pytest.mark.parametrize("chain", ["WFYXZT", "WYFXZT", "WXYFZT", "WXYZFT"])
@pytest.mark.parametrize("name", SKEWS)
def test_three_skews_hold_the_three_squarenesses_on_every_chain(name, chain):
    """To the second order: the carriage that stands at an angle travels 1/cos as far."""
    before, after = left_mm(machine_with(chain), ErrorTable(squareness=SQUARENESS), name)
    assert before > 0.09
    assert after < 1.5 * 1200.0 * 310e-6**2 + 2e-6


def test_the_factors_are_minus_the_squarenesses_with_the_order_of_the_shears():
    """EC0Y > 0: dX = -EC0Y y, so X must be sent further out; EB0Z > 0: dX = +EB0Z z; EA0Z > 0: dY = -EA0Z z."""
    made = compgen.export(machine_with(), ErrorTable(squareness=SQUARENESS), "klipper").files["skew.cfg"]
    values = dict(line.split(" = ") for line in made.splitlines() if "_skew = " in line)
    xy, xz, yz = (float(values[key]) for key in ("xy_skew", "xz_skew", "yz_skew"))
    assert xy == pytest.approx(-310e-6, abs=2e-7)
    assert yz == pytest.approx(-85e-6, abs=2e-7)
    assert xz - xy * yz == pytest.approx(-140e-6, abs=2e-7)


def test_a_rotation_of_the_volume_is_not_taken_for_a_squareness():
    """Constant ECX, ECY turn everything about Z by the same angle: nothing is out of square."""
    nodes = {axis: np.array(machine_with().axes[axis].range_mm) for axis in range(3)}
    turned = {f"EC{'XY'[k]}": Curve(nodes[k], np.full(2, 2e-4), np.full(2, np.nan)) for k in (1,)}
    errors = ErrorTable(turned, {"EA0Z": (85e-6, 0.0)})
    machine = machine_with("WFYXZT")
    basis = CONTROLLERS["klipper"](machine).basis(errors)
    values = compgen.tables.synthesis.synthesize(machine, errors, basis, anchored=True)
    turn_of_x = 2e-4  # X and Z ride on Y: dY = +x ECY and the tool in X, which is Y out of square to X by -ECY
    assert values["X*y"][0] == pytest.approx(-turn_of_x, rel=1e-2)
    assert values["Y*z"][0] == pytest.approx(85e-6, rel=1e-2)


@pytest.mark.parametrize("name", ["klipper", "reprapfirmware"])
def test_y_as_the_reference_of_squareness(name):
    """RepRapFirmware moves Y itself (P1); Klipper moves X, which leaves a rotation of the frame and nothing else."""
    machine = machine_with(reference="Y")
    errors = ErrorTable(squareness={"EC0Y": (310e-6, 0.0)})
    before, after = left_mm(machine, errors, name)
    assert before > 0.09
    assert after < 2e-4
    made = compgen.export(machine, errors, name)
    assert ("P1" in made.files.get("skew.g", "")) == (name == "reprapfirmware")
    assert any("align the workpiece again" in text for text in made.warnings) == (name == "klipper")


def test_ucnc_with_three_factors_writes_the_only_xz_for_which_it_shows_what_it_was_told():
    machine = machine_with(ucnc={"build": "three"})
    made = compgen.export(machine, ErrorTable(squareness={"EC0Y": (310e-6, 0.0)}), "ucnc")
    control = CONTROLLERS["ucnc"](machine)
    factors = control.parse([SourceFile(Path("skew.txt"), made.files["skew.txt"])])
    assert factors.xz == factors.xy != 0.0
    place = moved_to(control, factors, COMMANDS)
    back_x = place[:, 0] + place[:, 1] * factors.xy + place[:, 2] * factors.xz  # kinematics_steps_to_coordinates
    assert np.allclose(back_x, [row[0] for row in COMMANDS], rtol=0, atol=1e-7)
    assert any("EB0Z" in text for text in compgen.export(machine, ErrorTable(squareness=SQUARENESS), "ucnc").warnings)


def test_what_skews_leave_is_named(small_machine, small_errors):
    warnings = compgen.export(small_machine, small_errors, "klipper").warnings
    assert any("hold squareness alone" in text and "EXX" in text for text in warnings)


@pytest.mark.parametrize(
    ("limits", "broken"),
    [([-52.0, 701.0], False), ([-50.0, 701.0], True), ([-52.0, 700.0], True)],
)
def test_marlin_needs_room_at_both_ends_of_x(limits, broken):
    machine = machine_with(marlin={"x_limits_mm": limits})
    errors = ErrorTable(squareness={"EC0Y": (310e-6, 0.0)})  # X goes 0.37 mm further out at Y 1200
    made = compgen.export(machine, errors, "marlin")
    assert bool(made.violations) == broken
    assert all("X_MIN_POS" in text for text in made.violations)


def test_marlin_without_z_writes_one_factor():
    machine = machine_with(marlin={"for_z": False})
    made = compgen.export(machine, ErrorTable(squareness=SQUARENESS), "marlin")
    assert "J" not in made.files["skew.gcode"].splitlines()[-1]
    assert sum("cannot correct" in text for text in made.warnings) == 2


def test_a_printer_cfg_is_read_with_all_that_is_in_it():
    machine = machine_with(klipper={"profile": "router"})
    path = GOLDEN / "klipper" / "printer.cfg"
    control = CONTROLLERS["klipper"](machine)
    tables, _ = control.parse_foreign([SourceFile(path, path.read_text(encoding="utf-8"))])
    assert np.allclose(moved_to(control, tables, COMMANDS), KLIPPER, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="stepper_x"):
        control.parse([SourceFile(path, path.read_text(encoding="utf-8"))])


def test_the_last_command_of_a_start_program_acts():
    machine = machine_with()
    text = "G28\nM852 I0.1\nM104 S200 ; hot\nM852 I0.0029 J0.0005 K-0.0003 ; better\n"
    tables, remarks = CONTROLLERS["marlin"](machine).parse_foreign([SourceFile(Path("start.gcode"), text)])
    assert (tables.xy, tables.xz, tables.yz) == (0.0029, 0.0005, -0.0003)
    assert "line 4: xy is given again" in remarks[0]


MATRIX_JOINTS = [[100.575, 199.995, 50.0], [-348.762, 419.904, -180.0]]


def test_a_matrix_moves_the_joints_to_what_its_manual_says():
    control = CONTROLLERS["linuxcnc-matrixkins"](machine_with())
    path = GOLDEN / "linuxcnc-matrixkins" / "machine.hal"
    tables, remarks = control.parse_foreign([SourceFile(path, path.read_text())])
    assert np.allclose(moved_to(control, tables, COMMANDS[:2]), MATRIX_JOINTS, rtol=0, atol=1e-12)
    assert remarks == ["C_zz: not set, so 1 in the diagonal and 0 beside it, as at the start of the module"]


def test_the_matrix_has_the_squarenesses_with_their_sign_and_the_mean_scales():
    """X is 40 um per m too long: its joint must go 40 um less; Y leans by EC0Y towards -X: the joint of X goes further.

    The columns of ``moves`` are where the tool goes per mm of each joint, so the matrix is its inverse.
    """
    machine = machine_with()
    nodes = machine.axes[0].nodes_mm
    scale = Curve(nodes, 40e-6 * nodes, np.full(len(nodes), np.nan))
    made = compgen.export(machine, ErrorTable({"EXX": scale}, SQUARENESS), "linuxcnc-matrixkins")
    files = [SourceFile(Path(name), text) for name, text in made.files.items()]
    matrix = CONTROLLERS["linuxcnc-matrixkins"](machine).parse(files).matrix
    along_y = [-np.sin(310e-6), np.cos(310e-6), 0.0]
    along_z = [np.sin(-140e-6), -np.sin(85e-6), np.cos(np.hypot(140e-6, 85e-6))]
    moves = np.array([[1.0 + 40e-6, 0.0, 0.0], along_y, along_z]).T
    assert np.allclose(matrix, np.linalg.inv(moves), rtol=0, atol=2e-10)
    assert np.allclose(matrix, np.eye(3) + [[-40e-6, 310e-6, 140e-6], [0, 0, 85e-6], [0, 0, 0]], rtol=0, atol=1e-7)
    alone = machine_with(linuxcnc_matrixkins={"scales": False})
    made = compgen.export(alone, ErrorTable({"EXX": scale}, SQUARENESS), "linuxcnc-matrixkins")
    assert "setp matrixkins.C_xx 1.000000000000\n" in made.files["matrixkins.hal"]


# --- screw maps ------------------------------------------------------------------------------------------------------


def test_smoothieware_goes_to_what_its_source_says():
    machine = machine_with()
    control, tables = read("smoothieware", machine, GOLDEN / "smoothieware" / "pitch_compensation.dat")
    commands = [-150, -100, -60, -20.5, 0, 30, 60, 200, 300, 350]
    expected = [-149.994461, -100.004463, -60.0084419, -20.504467, 0, 30.0078526, 60.0172691, 200.04689]
    expected += [300.046051, 350.041046]
    moved = moved_to(control, tables, [[x, 0.0, 0.0] for x in commands])
    assert np.allclose(moved[:, 0], expected, rtol=0, atol=3e-5)  # the control returns single precision


def test_ecmc_looks_up_what_its_own_reader_does():
    machine = machine_with(ecmc={"version": "11.0.8"})
    _, tables = read("ecmc", machine, GOLDEN / "ecmc" / "x.lut")
    position = [-200, -100.5, -30.15, 0, 10, 40, 200, 300]
    expected = [0.012, 0.012, 0.00045, -0.0045, -0.002625, 0.003, 0.01707847800237812, 0.0215]
    table = tables.tables[0]
    assert np.allclose(np.interp(position, table.nodes, table.positive), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("version", "sign"), [("9.6.8", 1.0), ("10.0.0", -1.0), ("11.0.8", -1.0)])
def test_ecmc_stands_where_the_corrected_encoder_shows_the_command(version, sign):
    """Up to 9.6.8 shown = encoder + table(encoder), then encoder - table(encoder)."""
    machine = machine_with(ecmc={"version": version})
    control, tables = read("ecmc", machine, GOLDEN / "ecmc" / "x.lut")
    commands = np.array([[x, 0.0, 0.0] for x in (-120.0, -60.0, 1.0, 35.0, 249.0)])
    encoder = moved_to(control, tables, commands)[:, 0]
    table = tables.tables[0]
    shown = encoder + sign * np.interp(encoder, table.nodes, table.positive)
    assert np.allclose(shown, commands[:, 0], rtol=0, atol=1e-9)


def test_the_sign_of_ecmc_follows_its_release():
    errors = ErrorTable({"EXX": Curve(np.array([-50.0, 700.0]), np.array([0.0, 0.05]), np.full(2, np.nan))})
    files = [
        compgen.export(machine_with(ecmc={"version": version}), errors, "ecmc").files["ecmc-x.lut"]
        for version in ("9.6.8", "10.0.0")
    ]
    last = [float(text.splitlines()[-1].split()[1]) for text in files]
    assert last[0] == -last[1]
    assert last[1] == pytest.approx(-0.05 * 700.0 / 750.0, rel=1e-3)  # encoder minus true; zero at the reference point


def test_a_sign_or_release_that_is_not_stated_is_asked_for_with_the_reason():
    asked = {"ecmc": "version: is missing: release 10.0.0 reversed", "ucnc": "build: is missing: a factor acts"}
    asked |= {"centroid": "sign: is missing"}
    asked |= dict.fromkeys(("weihong", "mach4", "fagor-8055"), 'sign: is missing: .* set sign = "error"')
    for name, words in asked.items():
        with pytest.raises(InputError, match=words):
            CONTROLLERS[name](machine_with())


def test_the_example_of_weihong_with_a_backlash():
    machine = machine_with(weihong={"sign": "error"})
    control, tables = read("weihong", machine, GOLDEN / "weihong" / "axeserr.dat")
    position = np.array([[-510.0225, 500.0, 0.0]])
    assert moved_to(control, tables, position, 1.0) - position == pytest.approx(
        np.array([[-0.026, 0.0, 0.0]]), abs=1e-9
    )
    assert moved_to(control, tables, position, -1.0) - position == pytest.approx(
        np.array([[-0.08, -0.03, 0.0]]), abs=1e-9
    )


STATED = {
    "weihong": {"sign": "error"},
    "mach4": {"sign": "correction", "both_directions": True},
    "fagor-8055": {"sign": "error"},
}


@pytest.mark.parametrize("name", STATED)
@pytest.mark.parametrize("sign", ["error", "correction"])
def test_the_stated_sign_turns_the_values_and_a_reversal_leaves_nothing(name, sign, make_errors):
    """X comes 12 um further in its positive direction; tables of the other sign have the opposite values."""
    machine = machine_with(**{name.replace("-", "_"): {**STATED[name], "sign": sign}})
    errors = make_errors(machine)
    turned = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([0.012]), np.full(1, np.nan))})
    made = compgen.export(machine, errors, name, reversal=turned)
    control = CONTROLLERS[name](machine)
    tables = control.parse([SourceFile(Path(key), text) for key, text in made.files.items()])
    position = np.random.default_rng(3).uniform(machine.lower_mm, machine.upper_mm, (50, 3))
    forth, back = (moved_to(control, tables, position, direction)[:, 0] for direction in (1.0, -1.0))
    assert np.allclose(forth - back, -0.012, rtol=0, atol=1.1e-4)
    mean = 0.5 * (tables.tables[0].positive + tables.tables[0].negative)
    wanted = errors.curves["EXX"].at(tables.tables[0].nodes) * (1.0 if sign == "error" else -1.0)
    assert np.corrcoef(mean, wanted)[0, 1] > 0.7


def test_the_constructed_file_of_centroid_in_counts_and_in_mm():
    counts = {"sign": "correction", "values": "counts", "counts_per_mm": {"X": 2000.0, "Y": 2000.0, "Z": 2000.0}}
    control, tables = read("centroid", machine_with(centroid=counts), GOLDEN / "centroid" / "cnc-x.tab")
    for position, direction, expected in (
        (-12.5, 1.0, 0.0025), (-12.5, -1.0, 0.0), (-40.0, 1.0, -0.004), (-90.0, -1.0, -0.015)
    ):  # fmt: skip
        moved = moved_to(control, tables, [[position, 0.0, 0.0]], direction)
        assert np.allclose(moved - [[position, 0.0, 0.0]], [[expected, 0.0, 0.0]], rtol=0, atol=1e-12)
    error = machine_with(centroid={"sign": "error", "values": "mm"})
    text = "CNC10 TAB FILE VERSION 3\nAXIS Y\nUNITS MM\nINTERVAL 100\nENTRIES 2\n0 0.010 0.014\n100 0.030 0.034\n"
    tables = text_of("centroid", error, text, "cnc-y.tab")
    moved = moved_to(CONTROLLERS["centroid"](error), tables, [[0.0, 50.0, 0.0]])
    assert np.allclose(moved, [[0.0, 49.980, 0.0]], rtol=0, atol=1e-12)


def test_the_rows_of_centroid_go_outward_from_where_the_axis_is_homed():
    """The travel of Z is -180 ... 10 mm: its end at 10 is nearer to machine zero, where the rows begin."""
    machine = machine_with(centroid={"sign": "correction", "values": "mm"})
    nodes = machine.axes[2].nodes_mm
    errors = ErrorTable({"EZZ": Curve(nodes, 1e-4 * nodes, np.full(len(nodes), np.nan))})
    made = compgen.export(machine, errors, "centroid", allow_unverified=True)
    rows = {name: [line.split("\t") for line in text.splitlines()[5:]] for name, text in made.files.items()}
    assert (rows["cnc-z.tab"][0][0], rows["cnc-z.tab"][-1][0]) == ("10.000000", "-180.000000")
    assert (rows["cnc-y.tab"][0][0], rows["cnc-y.tab"][-1][0]) == ("0.000000", "1200.000000")
    assert float(rows["cnc-z.tab"][-1][1]) == pytest.approx(0.018 / 1.0001, abs=5e-7)  # minus EZZ there
    control = CONTROLLERS["centroid"](machine)
    tables = control.parse([SourceFile(Path(name), text) for name, text in made.files.items()])
    assert any("Z does not begin at machine zero" in text for text in control.reservations(tables))


def test_a_negative_column_of_zeros_means_both_directions_on_a_fagor():
    machine = machine_with(fagor_8055={"sign": "error"})
    head = "axis,position_mm,positive_mm,negative_mm\n"
    control = CONTROLLERS["fagor-8055"](machine)
    position = np.array([[100.0, 0.0, 0.0]])
    for negative, back in (("0.0000", -0.02), ("0.0001", -0.0001)):
        tables = text_of("fagor-8055", machine, head + f"X,0,0.0200,{negative}\nX,500,0.0200,{negative}\n")
        assert (moved_to(control, tables, position, -1.0) - position)[0, 0] == pytest.approx(back, abs=1e-12)
    flat = ErrorTable({"EXX": Curve(np.array([-50.0, 700.0]), np.zeros(2), np.full(2, np.nan))})
    half = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([0.02]), np.full(1, np.nan))})
    basis = control.basis(flat)
    tables = control.with_reversal(control.build(basis, {term.name: term.start - 0.01 for term in basis}), half)
    assert np.all(tables.tables[0].positive == 0.02)  # 0.02 forth and none back must not read as 0.02 in both
    assert tables.tables[0].negative.tolist() == [0.0001, 0.0]


# --- Aerotech and KMotion --------------------------------------------------------------------------------------------


def test_the_constructed_files_of_aerotech():
    machine = machine_with()
    control, tables = read("aerotech", machine, GOLDEN / "aerotech" / "axes.cal")
    commands = np.array([[x, 0.0, 0.0] for x in (-150.0, -100.0, -50.0, -25.0, 0.0, 80.0)])
    added = moved_to(control, tables, commands) - commands
    assert added[:, 0] == pytest.approx([0.003, 0.003, 0.001, -0.0015, -0.004, -0.004], abs=1e-12)
    machine = machine_with(aerotech_2d={"reversed_axes": {"X": True}})
    control, tables = read("aerotech-2d", machine, GOLDEN / "aerotech" / "plane.cal")
    commands = np.array(
        [[10.0, -20.0, 0.0], [25.0, 0.0, 5.0], [40.0, -20.0, 0.0], [10.0, 20.0, 0.0], [-99.0, -99.0, 0.0]]
    )
    added = moved_to(control, tables, commands) - commands
    expected = [[0.004, 0.002], [0.0025, -0.001], [0.002, -0.006], [0.003, 0.001], [0.004, 0.002]]
    assert np.allclose(added[:, :2], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["aerotech", "aerotech-2d"])
def test_a_reversed_axis_changes_the_file_and_not_what_it_does(name, make_errors):
    plain, turned = machine_with(), machine_with(**{name.replace("-", "_"): {"reversed_axes": {"X": True}}})
    files, moved = [], []
    for machine in (plain, turned):
        made = compgen.export(machine, make_errors(machine), name, allow_unverified=True)
        control = CONTROLLERS[name](machine)
        tables = control.parse([SourceFile(Path(key), text) for key, text in made.files.items()])
        files.append(next(iter(made.files.values())))
        moved.append(moved_to(control, tables, [[10.0, 300.0, -50.0], [650.0, 900.0, 0.0]]))
    assert files[0] != files[1]
    assert np.allclose(moved[0], moved[1], rtol=0, atol=NANOMETRE)


@pytest.mark.parametrize("name", ["aerotech", "aerotech-2d"])
def test_a_line_of_values_that_is_there_twice_is_noticed(name, make_errors):
    machine = machine_with()
    made = compgen.export(machine, make_errors(machine), name, allow_unverified=True)
    (file, text), control = next(iter(made.files.items())), CONTROLLERS[name](machine)
    lines = text.splitlines(keepends=True)
    values = next(k for k, line in enumerate(lines) if line[0] in "-0123456789")
    with pytest.raises(InputError, match="declares"):
        control.parse([SourceFile(Path(file), "".join([*lines[: values + 1], *lines[values:]]))])


def test_kmotion_moves_to_what_its_source_says():
    machine = machine_with(kmotion={"units": "mm"})
    control, tables = read("kmotion", machine, GOLDEN / "kmotion" / "geo.txt")
    commands = [[-100, 20, 0], [-50, 45, 10], [30, 60, -5], [150, 90, 0], [-130, 0, 2]]
    expected = [[-100.01, 20.004, 0.001], [-50.008, 45.00525, 10.002], [29.99906, 60.00258, -4.99776]]
    expected += [[149.9975, 89.9946, -0.00055], [-130.00912, 0.00228, 2.00074]]
    assert np.allclose(moved_to(control, tables, commands), expected, rtol=0, atol=1e-12)


def test_kmotion_in_inches_does_the_same_in_another_file(make_errors):
    moved = []
    for units in ("mm", "inch"):
        machine = machine_with(kmotion={"units": units})
        made = compgen.export(machine, make_errors(machine), "kmotion")
        assert made.violations == []
        control = CONTROLLERS["kmotion"](machine)
        tables = control.parse([SourceFile(Path("geo.txt"), made.files["geo.txt"])])
        moved.append(moved_to(control, tables, [[10.0, 300.0, -50.0], [650.0, 900.0, 0.0]]))
    assert np.allclose(moved[0], moved[1], rtol=0, atol=2e-5)


# --- the sign on the exact machine -----------------------------------------------------------------------------------

EVERY = {
    "smoothieware": {}, "ecmc": {"version": "9.6.8"}, "aerotech": {}, "aerotech-2d": {}, "kmotion": {},
    "weihong": {"sign": "correction"}, "mach4": {"sign": "error"}, "fagor-8055": {"sign": "correction"},
    "centroid": {"sign": "error", "values": "mm"},
}  # fmt: skip


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
def test_the_machine_with_the_table_comes_closer(name, chain):
    """Positioning of X and Y by 40 um, told by a laser; planar grids and screw maps hold it to a micrometre."""
    machine = machine_with(chain, **{name.replace("-", "_"): EVERY[name]})
    curves = {}
    for k, letter in enumerate("XY"):
        nodes = machine.axes[k].nodes_mm
        reach = (nodes - machine.reference_point_mm[k]) / 1000.0
        curves[f"E{letter}{letter}"] = Curve(
            nodes, 0.04 * reach + 0.01 * np.sin(3.0 * reach), np.full(len(nodes), np.nan)
        )
    before, after = left_mm(machine, ErrorTable(curves), name)
    assert before > 0.015
    assert after < 3e-4


# --- malformed files -------------------------------------------------------------------------------------------------


MATRIX = "".join(f"setp matrixkins.C_{a}{b} {int(a == b)}\n" for a in "xyz" for b in "xyz")
CENTROID = {"sign": "correction", "values": "mm"}
TAB = "CNC10 TAB FILE VERSION 3\nAXIS X\nUNITS MM\nINTERVAL 25\nENTRIES 2\n0 0 0\n-25 1 2\n"


@pytest.mark.parametrize(
    ("name", "settings", "text", "words"),
    [
        ("klipper", {}, FACTORS.replace("volcomp", "other"), "no profile 'volcomp'"),
        ("klipper", {}, FACTORS + "xy_skew = 0.1\n", "second time"),
        ("klipper", {}, FACTORS.replace("0.0005", "nan"), "not a finite number"),
        ("klipper", {}, FACTORS.rsplit("yz", 1)[0], "no factor yz"),
        ("marlin", {}, "G20\nM852 I0.1 J0 K0\n", "G20"),
        ("marlin", {}, "M852 I0.1 J0 X0\n", "not a word of M852"),
        ("reprapfirmware", {}, "M556 S0 X0 Y0 Z0\n", "above zero"),
        ("reprapfirmware", {}, "M556 X0 Y0 Z0\n", "no factor height"),
        ("ucnc", {"build": "xy-only"}, "$37=0.1\n$38=0\n", r"expected \$37 with"),
        ("ecmc", {"version": "11"}, "0 1\n1 2\n", "at least 3"),
        ("ecmc", {"version": "11"}, "0 1\n1 2\n1 3\n", "not above"),
        ("weihong", {"sign": "error"}, "[X]\n0, 1, 2\n", "unit = mm"),
        ("weihong", {"sign": "error"}, "unit = mm\n[X]\n0, 1\n", "2 columns"),
        ("mach4", {"sign": "error"}, "# records: 2\naxis,position_mm,positive_mm,negative_mm\nX,0,0,0\n", "declares 2"),
        (
            "mach4",
            {"sign": "error"},
            "axis,position_mm,positive_mm,negative_mm\nX,0,0,0\nX,1,0.002,0.003\n",
            "one value holds for both",
        ),
        ("aerotech", {}, ":START 1 SAMPLEDIST=1 NEGCOR\n", "NEGCOR"),
        ("aerotech", {}, ":START 1 SAMPLEDIST=-1\n:START OFFSET=0\n1 2\n:END\n", "reversed_axes"),
        ("aerotech-2d", {}, ":START2D 1 2 1 2 1 1 2\n:START2D OFFSETROW=0 OFFSETCOL=0\n:END\n", "axis_numbers"),
        ("kmotion", {}, "2,2\n1,1\n0,0\n0,0,0,0,0\n", "need 20"),
        ("kmotion", {}, "2,2\n1,1\n0,0\n" + 4 * "0,0,0,0,0\n", "second time"),
        ("smoothieware", {}, "A 1 1\n", "not an axis"),
        ("linuxcnc-matrixkins", {}, "setp matrixkins.C_xx 1\n", "no factor xy"),
        ("linuxcnc-matrixkins", {}, "setp matrixkins.C_xw 1\n", "expected setp"),
        ("linuxcnc-matrixkins", {}, "loadrt matrixkins\n", "expected setp"),
        ("linuxcnc-matrixkins", {}, MATRIX.replace("C_yy 1", "C_yy 25.4"), "skew factor of 24.4"),
        ("linuxcnc-matrixkins", {}, MATRIX + "setp matrixkins.C_zz 1\n", "second time"),
        ("centroid", CENTROID, TAB.replace("VERSION 3", "VERSION 2"), "other versions"),
        ("centroid", CENTROID, TAB.replace("MM", "INCH"), "only files in MM"),
        ("centroid", CENTROID, TAB.replace("ENTRIES 2", "ENTRIES 3"), "declares 3 entries but has 2"),
        ("centroid", CENTROID, TAB.replace("INTERVAL 25", "INTERVAL 20"), "INTERVAL 20 is not"),
        ("centroid", CENTROID, TAB.replace("AXIS X\n", ""), "expected AXIS"),
        ("centroid", CENTROID, TAB.replace("-25 1 2", "-25 1"), "2 columns"),
        (
            "centroid",
            {**CENTROID, "values": "counts", "counts_per_mm": {"X": 1.0, "Y": 1.0, "Z": 1.0}},
            TAB.replace("-25 1 2", "-25 1 0.5"),
            "whole numbers",
        ),
        ("centroid", {"sign": "error", "values": "counts"}, TAB, "counts_per_mm"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(name, settings, text, words):
    machine = machine_with(**{name.replace("-", "_"): settings})
    with pytest.raises(InputError, match=words) as caught:
        text_of(name, machine, text, "x.txt")
    assert caught.value.file is None or str(caught.value.file) == "x.txt"
