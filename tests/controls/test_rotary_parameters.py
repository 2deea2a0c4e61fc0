"""Parameters of rotary axes: against the modules of LinuxCNC themselves, against worked vectors, and by command."""

import ctypes
import json
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from compgen.controls import ROTARY_TARGETS
from compgen.controls.rotary_parameters import ABOUT, TARGETS, believed, lines_of, target_of
from compgen.data.comparison import without_rigid_motion
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Axis, Chain, Machine, RotaryAxis
from compgen.data.rotary import RotaryErrors, format_machine_errors, position_names
from compgen.errors import InputError
from compgen.kinematics.rotary_chain import tip_pose
from compgen.tables.rotary_parameters import export_rotary, judged

MODULES = Path("/usr/lib/linuxcnc/modules")
STUB = Path(__file__).resolve().parents[1] / "linuxcnc" / "kinematics_pins.c"
real = pytest.mark.skipif(
    not MODULES.is_dir() or shutil.which("gcc") is None, reason="needs the modules of LinuxCNC, and gcc"
)
DIRECTIONS = {"A": (1.0, 0.0, 0.0), "B": (0.0, 1.0, 0.0), "C": (0.0, 0.0, 1.0)}


def machine_of(chain, points=None, conventional=None, directions=None, **more):
    axes = tuple(Axis((-300.0, 300.0), np.linspace(-300.0, 300.0, 5)) for _ in range(3))
    rotary = {
        letter: RotaryAxis(
            (directions or {}).get(letter, DIRECTIONS[letter]),
            (points or {}).get(letter, (0.0, 0.0, 0.0)),
            np.linspace(-90, 90, 7),
            range_deg=(-90.0, 90.0),
        )
        for letter in Chain(chain).rotary
    }
    machine = Machine("five", Chain(chain), axes, rotary=rotary, **more)
    if conventional is not None:
        machine = machine.with_setting("linuxcnc-trt", "conventional_directions", conventional)
    return machine


@cache
def stub():
    import tempfile

    library = Path(tempfile.mkdtemp()) / "pins.so"
    subprocess.run(["gcc", "-w", "-shared", "-fPIC", "-o", library, STUB], check=True, timeout=60)
    found = ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    found.set_pin.argtypes = [ctypes.c_char_p, ctypes.c_double]
    ctypes.CDLL("libm.so.6", mode=ctypes.RTLD_GLOBAL)
    return found


@cache
def module_of(name):
    """A kinematics module of LinuxCNC, ready to be called."""
    stub()
    module = ctypes.CDLL(str(MODULES / f"{name}.so"), mode=1)
    assert module.rtapi_app_main() == 0
    module.kinematicsType()
    if name == "xyzab_tdr_kins":
        assert module.kinematicsSwitch(1) == 0
    return module


def setp(text, tool_pin, length_mm):
    """Set the pins of a HAL file, and the length of the tool, as motion would."""
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["setp"] and not words[1].startswith("compgen-pivot"):
            assert stub().set_pin(words[1].encode(), float(words[2])) == 0, line
        if words[:1] == ["setp"] and words[1] == "compgen-pivot.in1":  # sum2 adds the length of the tool
            assert stub().set_pin(b"5axiskins.pivot-length", float(words[2]) + length_mm) == 0
    if tool_pin:
        assert stub().set_pin(tool_pin.encode(), length_mm) == 0


ORDER = "XYZABCUVW"


def forward(module, joints):
    pose, flag = (ctypes.c_double * 9)(), ctypes.c_ulong(0)
    module.kinematicsForward((ctypes.c_double * 16)(*joints), pose, ctypes.byref(flag), ctypes.byref(flag))
    return np.array(pose[:3])


def inverse(module, pose):
    joints, flag = (ctypes.c_double * 16)(), ctypes.c_ulong(0)
    module.kinematicsInverse((ctypes.c_double * 9)(*pose), joints, ctypes.byref(flag), ctypes.byref(flag))
    return np.array(joints[:6])


#: Target, chain, module, pin of the tool length, axes in the order of the module's joints, and places of the axis lines.
CASES = {
    "xyzac": ("linuxcnc-trt", "WCAYFXZT", "xyzac-trt-kins", "xyzac-trt-kins.tool-offset", "AC"),
    "xyzbc": ("linuxcnc-trt", "WCBXYFZT", "xyzbc-trt-kins", "xyzbc-trt-kins.tool-offset", "BC"),
    "xyzab": ("linuxcnc-tdr", "WABYFXZT", "xyzab_tdr_kins", "xyzab_tdr_kins.tool-offset-z", "AB"),
    "5axis": ("linuxcnc-5axis", "WXYFZCBT", "5axiskins", None, "BC"),
}


def case_of(key, rng):
    name, chain, module, pin, letters = CASES[key]
    if key == "5axis":
        points = {"B": (0.0, 0.0, 180.0), "C": (0.0, 0.0, 50.0)}
    else:
        points = {letter: tuple(rng.uniform(-60.0, 60.0, 3)) for letter in letters}
    machine = machine_of(chain, points, conventional=False if name == "linuxcnc-trt" else None)
    return target_of(machine, name), machine, module_of(module), pin, letters


@real
@pytest.mark.parametrize("key", CASES)
def test_the_file_makes_the_module_of_linuxcnc_the_machine(key):
    """Signs, units and places: the module's own forward function is that of the nominal machine, for any tool."""
    rng = np.random.default_rng(2)
    target, machine, module, pin, letters = case_of(key, rng)
    text = target.text(machine, target.numbers(lines_of(machine)))
    for length_mm in (0.0, 87.5):
        setp(text, pin, length_mm)
        for _ in range(5):
            position, angle = rng.uniform(-200, 200, 3), dict(zip(letters, rng.uniform(-80, 80, 2), strict=True))
            turned = [target.sense[letter] * angle[letter] for letter in letters]
            found = forward(module, [*position, *turned])
            tool = np.array([[0.0, 0.0, -length_mm]])
            where = {letter: np.array([value]) for letter, value in angle.items()}
            tip, _ = tip_pose(machine, ErrorTable(), RotaryErrors(), position[None], where, tool)
            # the control counts positions of the tip plus the length of the tool; what is written has six decimals
            assert found - [0.0, 0.0, length_mm] == pytest.approx(tip[0], rel=0, abs=3e-6)


@real
@pytest.mark.parametrize("key", CASES)
def test_injected_errors_are_gone_at_the_tip_that_linuxcnc_commands(key):
    """Programmed tips on a sphere with turning axes; the module says where the joints go, the true machine where the tip is."""
    rng = np.random.default_rng(3)
    target, machine, module, pin, letters = case_of(key, rng)
    if key == "5axis":
        constants = {"TZ": (0.12, 0.0)}
    else:
        names = [name for letter in machine.rotary for name in position_names(letter) if name[1] in "XYZ"]
        constants = {name: (0.1 * rng.choice([-1.0, 1.0]), 0.0) for name in names}
    rotary = RotaryErrors({}, constants)
    exported = export_rotary(machine, target, rotary)
    nominal = target.text(machine, target.numbers(lines_of(machine)))
    length_mm, count = 90.0, 60
    tips = rng.normal(size=(count, 3))
    tips = 60.0 * tips / np.linalg.norm(tips, axis=1)[:, None]
    angle = {letter: rng.uniform(-85, 85, count) for letter in letters}
    tool = np.tile([0.0, 0.0, -length_mm], (count, 1))
    left = {}
    for what, text in (("without", nominal), ("with", exported.text)):
        setp(text, pin, length_mm)
        joints = []
        for k in range(count):
            pose = np.zeros(9)
            pose[:3] = tips[k] + [0.0, 0.0, length_mm]
            for letter in letters:
                pose[ORDER.index(letter)] = target.sense[letter] * angle[letter][k]
            joints.append(inverse(module, pose)[:3])
        actual, _ = tip_pose(machine, ErrorTable(), rotary, np.array(joints), angle, tool)
        left[what] = 1e3 * np.linalg.norm(without_rigid_motion(tips, actual - tips), axis=1).max()
    assert left["without"] > 50.0
    assert left["with"] < 1.0
    assert not exported.reasons


def everything(machine, rng, offsets_only=False):
    names = [name for letter in machine.rotary for name in position_names(letter)]
    return RotaryErrors(
        {},
        {
            name: ((0.1 if name[1] in "XYZ" else 3e-4) * rng.normal(), 0.0)
            for name in names
            if name[1] in "XYZ" or not offsets_only
        },
    )


OTHERS = [
    ("siemens-toolcarrier", "WCAYFXZT"),
    ("siemens-toolcarrier", "WCYFXZBT"),
    ("siemens-toolcarrier", "WXYFZCBT"),
    ("siemens-toolcarrier", "WCFXYZT"),
    ("fanuc-5axis", "WCBXYFZT"),
    ("fanuc-5axis", "WCYFXZAT"),
    ("fanuc-5axis", "WFXYZCAT"),
]


@pytest.mark.parametrize(("name", "chain"), OTHERS)
def test_offsets_of_the_axis_lines_are_taken_away(name, chain):
    rng = np.random.default_rng(len(chain) + ord(chain[1]))
    machine = machine_of(chain, {letter: tuple(rng.uniform(-80, 80, 3)) for letter in Chain(chain).rotary})
    target, rotary = target_of(machine, name), everything(machine, rng, offsets_only=True)
    found = export_rotary(machine, target, rotary)
    resolution_um = 2.0 if name == "fanuc-5axis" else 0.02
    assert found.after.max_um < resolution_um < 30.0 < found.before.max_um and not found.reasons
    # the same numbers with their changes reversed make it worse, and are refused
    wrong = {key: 2.0 * found.nominal[key] - value for key, value in found.numbers.items()}
    judgement = judged(machine, target, rotary, wrong, "")
    assert judgement.after.rms_um > 1.9 * judgement.before.rms_um and "grows" in judgement.reasons[0]


def test_directions_of_a_toolcarrier_take_tilts_away_too():
    rng = np.random.default_rng(5)
    machine = machine_of("WCAYFXZT")
    target = target_of(machine, "siemens-toolcarrier")
    found = export_rotary(machine, target, everything(machine, rng))
    assert found.before.rms_um > 50.0 and found.after.max_um < 0.5
    assert found.before.rms_urad > 100.0 and found.after.max_urad < 1.0
    plain = export_rotary(
        machine.with_setting("linuxcnc-trt", "conventional_directions", True),
        target_of(machine.with_setting("linuxcnc-trt", "conventional_directions", True), "linuxcnc-trt"),
        everything(machine, np.random.default_rng(5)),
    )
    assert plain.after.rms_urad > 100.0 and {"EA0C", "EB0C"} <= set(plain.not_expressed)  # X, Y, Z turn no tool


def test_a_nutating_head_keeps_its_direction_in_the_toolcarrier():
    share = 0.5**0.5
    machine = machine_of("WCYFXZBT", {"B": (0.0, 80.0, 120.0)}, directions={"B": (0.0, share, share)})
    target = target_of(machine, "siemens-toolcarrier")
    numbers = target.numbers(lines_of(machine))
    vector = lambda start: [numbers[f"$TC_CARR{start + k}[1]"] for k in range(3)]  # noqa: E731
    # mixed kinematics: the head is the first axis; the vectors close; V of a table points the other way
    assert vector(4) == [0.0, 80.0, 120.0] and vector(1) == [0.0, -80.0, -120.0]
    assert vector(7) == pytest.approx([0.0, share, share]) and vector(10) == pytest.approx([0.0, 0.0, -1.0])
    assert '$TC_CARR23[1]="M"' in target.text(machine, numbers)
    rng = np.random.default_rng(8)
    found = export_rotary(machine, target, everything(machine, rng, offsets_only=True))
    assert found.before.max_um > 50.0 and found.after.max_um < 0.02
    with pytest.raises(InputError, match="no parameter for the direction of B"):
        target_of(machine, "fanuc-5axis")


def test_vectors_by_hand():
    """Trunnion: A line at y 10, z -50; C line at x 3, y 7. Fork: B 20 mm before C, 150 mm above the gauge point."""
    trunnion = machine_of("WCAYFXZT", {"A": (0.0, 10.0, -50.0), "C": (3.0, 7.0, 0.0)}, conventional=True)
    numbers = target_of(trunnion, "linuxcnc-trt").numbers(lines_of(trunnion))
    assert list(numbers.values()) == [3.0, 7.0, 0.0, 0.0, 3.0, -50.0]
    numbers = target_of(trunnion, "fanuc-5axis").numbers(lines_of(trunnion))
    assert numbers == {
        "N19700": 0.0, "N19701": 10.0, "N19702": -50.0, "N19703": 3.0, "N19704": -3.0, "N19705": 50.0,
    }  # fmt: skip
    fork = machine_of("WXYFZCBT", {"C": (0.0, 20.0, 200.0), "B": (0.0, 0.0, 150.0)}, tool_offset_mm=(0.0, 0.0, -30.0))
    numbers = target_of(fork, "fanuc-5axis").numbers(lines_of(fork))
    # from the gauge point, 30 mm below, to B, and from B to C
    assert list(numbers.values()) == [0.0, 0.0, 180.0, 0.0, 20.0, 50.0]


@pytest.mark.parametrize("name", ["linuxcnc-trt", "siemens-toolcarrier", "fanuc-5axis"])
def test_a_file_is_read_back_in_the_unit_of_the_machine(name):
    for units in ("mm", "inch"):
        machine = machine_of("WCAYFXZT", {"A": (1.0, 2.5, -50.8)}, conventional=True, machine_units=units)
        target = target_of(machine, name)
        text = target.text(machine, target.numbers(lines_of(machine)))
        assert ("-2.000" in text or "2.000" in text) == (units == "inch") or name == "fanuc-5axis"
        again = believed(target, machine, target.parse(machine, text, Path("x")))
        assert again.rotary["A"].point_mm[1:] == pytest.approx((2.5, -50.8), abs=2e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda text: text.replace("setp xyzac-trt-kins.y-offset", "setp xyzac-trt-kins.yy-offset"),
            "is not understood",
        ),
        (lambda text: text + "setp xyzac-trt-kins.y-offset 1\n", "given a second time"),
        (lambda text: "\n".join(text.splitlines()[:-1]), "lacks xyzac-trt-kins.z-offset"),
        (lambda text: text.replace("-50.000000", "1e99"), "is no length"),
        (lambda text: text.replace("-50.000000", "nan"), "is no length"),
        (lambda text: text.replace("conventional-directions 1", "conventional-directions 0"), "is not understood"),
        (lambda text: text + "loadrt foo\n", "is not understood"),
    ],
)
def test_files_that_are_not_understood_are_refused(change, said):
    machine = machine_of("WCAYFXZT", {"A": (0.0, 0.0, -50.0)}, conventional=True)
    target = target_of(machine, "linuxcnc-trt")
    text = change(target.text(machine, target.numbers(lines_of(machine))))
    with pytest.raises(InputError, match=said):
        target.parse(machine, text, Path("trt.hal"))


@pytest.mark.parametrize(
    ("chain", "name", "said"),
    [
        ("WCAYFXZT", "linuxcnc-trt", "conventional_directions: is missing"),
        ("WCYFXZBT", "linuxcnc-trt", "is not one of linuxcnc-trt"),
        ("WCYAFXZT", "linuxcnc-trt", "no linear axis may be between"),
        ("WCAYFXZT", "linuxcnc-5axis", "is not one of linuxcnc-5axis"),
        ("WXYFZBCT", "linuxcnc-5axis", "is not one of linuxcnc-5axis"),
        ("WCFXYZT", "fanuc-5axis", "19680 needs two"),
        ("WXYFZT", "siemens-toolcarrier", "has none"),
        ("WCBFXYZAT", "siemens-toolcarrier", "one or two rotary axes"),
    ],
)
def test_a_machine_of_another_kind_is_refused(chain, name, said):
    with pytest.raises(InputError, match=said):
        target_of(machine_of(chain), name)


MACHINE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 7 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
[controllers.linuxcnc-trt]
conventional_directions = true
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("five.toml").write_text(MACHINE)
    rotary = RotaryErrors({}, {"EX0C": (0.08, 2e-3), "EY0A": (-0.05, 2e-3), "EA0C": (1e-4, 1e-5)})
    Path("found.errors.csv").write_text(format_machine_errors(ErrorTable(), rotary, {}))
    return tmp_path


def test_export_read_and_verify_by_command(folder, call):
    code, out, err = call(
        "export", "five.toml", "found.errors.csv", "--controller", "linuxcnc-trt", "--out", "out", "--json"
    )
    assert code == 0, err
    summary = json.loads(out)
    assert summary["after"]["rms_um"] < 0.6 * summary["before"]["rms_um"] and summary["not_expressed"] == ["EA0C"]
    assert summary["u"]["xyzac-trt-kins.x-rot-point"] == pytest.approx(2e-3, rel=0.1)
    assert "conventional-directions 1" in Path("out/trt.hal").read_text()
    code, out, err = call(
        "verify",
        "five.toml",
        "out",
        "--controller",
        "linuxcnc-trt",
        "--errors",
        "found.errors.csv",
        "--out",
        "v",
        "--json",
    )
    assert code == 0 and json.loads(out)["after"] == summary["after"], err
    # at zero the control does what it did; a turned table is met where its axis line is
    Path("p.points.csv").write_text("x_mm,y_mm,z_mm,a_deg,c_deg\n10,20,130,0,0\n10,20,130,0,180\n")
    code, out, err = call(
        "read", "five.toml", "out/trt.hal", "--controller", "linuxcnc-trt", "--points", "p.points.csv", "--out", "c.csv"
    )
    assert code == 0, err
    rows = [line.split(",") for line in Path("c.csv").read_text().splitlines() if not line.startswith("#")]
    added = [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
    assert float(added[0]["cx_um"]) == pytest.approx(0.0, abs=1e-6)
    # EX0C > 0: the axis line is at -EX0C; half a turn about it moves a point by twice that
    assert float(added[1]["cx_um"]) == pytest.approx(-160.0, abs=1.0)


def test_wrong_use_is_refused_and_a_worse_file_is_not_accepted(folder, call):
    call("export", "five.toml", "found.errors.csv", "--controller", "linuxcnc-trt", "--out", "out")
    text = Path("out/trt.hal").read_text()
    Path("trt.hal").write_text(text.replace("x-rot-point -", "x-rot-point "))
    code, out, err = call(
        "verify", "five.toml", "trt.hal", "--controller", "linuxcnc-trt", "--errors", "found.errors.csv", "--out", "v"
    )
    assert code == 1 and "grows" in err
    Path("plain.errors.csv").write_text("error,position_mm,value\nEC0Y,,10\n")
    code, out, err = call("export", "five.toml", "plain.errors.csv", "--controller", "linuxcnc-trt", "--out", "n")
    assert code == 2 and "no errors of rotary axes" in " ".join(err.split()) and not Path("n").exists()
    code, out, err = call("export", "zha-gantry", "plain.errors.csv", "--controller", "linuxcnc-trt", "--out", "n")
    assert code == 2 and "zha-gantry has none" in " ".join(err.split()) and not Path("n").exists()
    code, out, err = call("export", "five.toml", "found.errors.csv", "--controller", "linuxcnc-tdr", "--out", "n")
    assert code == 2 and "is not one of linuxcnc-tdr" in " ".join(err.split())
    code, out, err = call("check", "five.toml")
    assert code == 0, err
    Path("five.toml").write_text(MACHINE.replace("conventional_directions = true", "conventional = true"))
    code, out, err = call("check", "five.toml")
    assert code == 2 and "conventional_directions" in out


def test_every_target_is_listed(call):
    code, out, _ = call("controllers", "--json")
    assert code == 0 and set(TARGETS) <= set(json.loads(out))
    for name in TARGETS:
        code, out, _ = call("controllers", name)
        assert code == 0 and name in out


def test_the_names_are_those_of_the_targets():
    assert set(ROTARY_TARGETS) == set(TARGETS) == set(ABOUT)
