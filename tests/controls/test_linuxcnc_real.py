"""LinuxCNC itself, headless, runs our tables: what it sends to the motors is what the emulators say.

A simulated machine with injected errors moves where the control sends it; the tool's error is that of the exact model (for
COMP_FILE: of the injected positioning errors and reversal) at the recorded motor positions. Without LinuxCNC (``make test``
installs it on Debian where it may) these tests are skipped by name.
"""

import fcntl
import io
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.controls.heat_outputs import output_of
from compgen.controls.linuxcnc_comp import standstill_outcome
from compgen.data.error_table import Curve, ReversalCurves
from compgen.data.lengths import Points
from compgen.heat import HeatModel, Temperatures
from compgen.heat.model import Range, Term
from compgen.kinematics.exact_chain import exact_error
from compgen.programs import DIALECTS, CorrectOptions, Reader, Setup, correct_program, model_of
from compgen.programs.path import lengths_of, points_of
from compgen.resources import data_folder

HELPERS = Path(__file__).resolve().parents[1] / "linuxcnc"
SOURCES = data_folder("templates") / "linuxcnc-volumetric"
PROGRAMS = ("linuxcnc", "halrun", "halcompile", "gcc", "make")
LIMIT_S = 60
#: The agreement that the issue asks for, and the shrinking of the tool's error.
AGREEMENT_MM, SHRINKS_BY = 1e-12, 1000.0


@cache
def administrator():
    """Words in front of a command that make it run as root; None if that is not possible."""
    if os.geteuid() == 0:
        return ()
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    if (
        shutil.which("sudo")
        and subprocess.run(["sudo", "-n", "true"], **quiet, timeout=20, check=False).returncode == 0
    ):
        return ("sudo", "-n")
    return None


def why_not():
    """Why the control cannot run here, or an empty text."""
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        return f"LinuxCNC is not installed ({', '.join(missing)} missing): make test installs it on Debian as root"
    if administrator() is None:
        return "LinuxCNC's folder of modules can be used by root only, and sudo asks for a password"
    return ""


pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "runs")

# --- one session ------------------------------------------------------------------------------------------------------

INI = """\
[EMC]
MACHINE = compgen-test
DEBUG = 0
VERSION = 1.1
[DISPLAY]
DISPLAY = ./drive.py
[RS274NGC]
PARAMETER_FILE = sim.var
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 8.0
SERVO_PERIOD = 1000000
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.01
TOOL_TABLE = tool.tbl
[HAL]
HALFILE = mill.hal
[KINS]
KINEMATICS = {kinematics}
JOINTS = {joints}
[TRAJ]
COORDINATES = {coordinates}
LINEAR_UNITS = {units}
ANGULAR_UNITS = degree
DEFAULT_LINEAR_VELOCITY = 1000
MAX_LINEAR_VELOCITY = 5000
DEFAULT_LINEAR_ACCELERATION = {acceleration}
MAX_LINEAR_ACCELERATION = {acceleration}
"""
AXIS = """\
[AXIS_{letter}]
MIN_LIMIT = -2000
MAX_LIMIT = 2000
MAX_VELOCITY = 5000
MAX_ACCELERATION = {axis_acceleration}
"""
JOINT = """\
[JOINT_{joint}]
TYPE = {kind}
HOME = {home}
HOME_OFFSET = {home}
HOME_SEARCH_VEL = 0
HOME_LATCH_VEL = 0
HOME_SEQUENCE = 0
MIN_LIMIT = -2000
MAX_LIMIT = 2000
MAX_VELOCITY = 5000
MAX_ACCELERATION = {acceleration}
FERROR = 1000
MIN_FERROR = 1000
{more}
"""
HAL = """\
loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS
loadrt sampler depth=60000 cfg={cfg}
addf motion-command-handler servo-thread
addf motion-controller servo-thread
{more}
net tp iocontrol.0.tool-prepare => iocontrol.0.tool-prepared
net tc iocontrol.0.tool-change => iocontrol.0.tool-changed
"""
LOOP = "net j{k} joint.{k}.motor-pos-cmd => joint.{k}.motor-pos-fb\n"
ENABLE = "net en iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in\n"
#: Joint accelerations so high that the filter of the COMP_FILE passes everything on; moves keep their own.
PASSING = 1e9


def run(command, folder, limit_s=LIMIT_S):
    """Run to the end or kill all of it; returns its output."""
    process = subprocess.Popen(
        command,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
    )
    try:
        return process.communicate(timeout=limit_s)[0], process.returncode
    except subprocess.TimeoutExpired:
        if os.geteuid() == 0:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            subprocess.run([*administrator(), "kill", "-9", f"-{process.pid}"], timeout=10, check=False)
        return process.communicate(timeout=10)[0] + "\n(killed: it took too long)", -9


@cache
def private():
    """Words that put a session into namespaces of its own; empty where that is not allowed."""
    words = ["unshare", "--ipc", "--mount", "--net", "--pid", "--fork", "--mount-proc", "--kill-child"]
    probe = [*administrator(), *words, "sh", "-c", "mount --bind /var/tmp /tmp"]
    return tuple(words) if run(probe, "/", 20)[1] == 0 else ()


@contextmanager
def alone():
    """Hold LinuxCNC for one session: outside a namespace its shared memory, ports and lock files exist once."""
    if private():
        yield
        return
    with open(f"/var/tmp/compgen-linuxcnc-{os.geteuid()}.lock", "w") as lock:
        give_up = time.monotonic() + 5 * LIMIT_S
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                assert time.monotonic() < give_up, "another session holds LinuxCNC"
                time.sleep(0.1)
        yield


@pytest.fixture(scope="module")
def workshop():
    """A folder that an ordinary user can reach, with the modules built once."""
    folder = Path(tempfile.mkdtemp(prefix="compgen-linuxcnc-", dir="/var/tmp"))
    try:
        folder.chmod(0o755)
        modules = folder / "modules"
        modules.mkdir()
        for name in ("volkins.comp", "volcomp.comp", "volcomp.h"):
            shutil.copy(SOURCES / name, modules)
        for name in ("volheat.comp", "volheat.h"):
            shutil.copy(data_folder("templates") / "linuxcnc-heat" / name, modules)
        for name in ("volkins.comp", "volcomp.comp", "volheat.comp"):
            output, code = run(["halcompile", "--compile", name], modules)
            assert code == 0, output
        yield SimpleNamespace(folder=folder, modules=modules)
    finally:
        if run([*administrator(), "rm", "-rf", str(folder)], "/")[1]:
            shutil.rmtree(folder, ignore_errors=True)


def launch(workshop, command, files):
    """Run a command for LinuxCNC in a new folder with these files; returns the folder and the output."""
    here = Path(tempfile.mkdtemp(prefix="run-", dir=workshop.folder))
    for name, text in files.items():
        (here / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    for name in ("drive.py", "lookup.py", "session.sh"):
        shutil.copy(HELPERS / name, here)
    here.chmod(0o777)
    mode = "private" if private() else "shared"
    with alone():
        output, _ = run([*administrator(), *private(), "./session.sh", mode, str(workshop.modules), *command], here)
    return here, output


def sampler(sampled, wiring):
    """HAL lines that record pins in every servo cycle; a pin that has a signal in ``wiring`` is read from that."""
    lines = []
    for number, pin in enumerate(sampled):
        found = re.search(rf"^net (\S+) .*(?<!\S){re.escape(pin)}(?!\S)", wiring, re.MULTILINE)
        source = found[1] if found else f"sampled{number} {pin}"
        lines.append(f"net {source} => sampler.0.pin.{number}\n")
    return "".join([*lines, "addf sampler.0 servo-thread\n"])


def session(workshop, steps, sampled, *, kinematics="trivkins coordinates=XYZ", more=("", "", ""), hal=None, files=None,
            acceleration=PASSING, axis_acceleration=1e5, pins=(), coordinates="XYZ", units="mm",
            home=(0.0, 0.0, 0.0)):  # fmt: skip
    """Run commands on the control; returns samples by pin name, pins at the end, messages, and whether it started.

    ``files`` beside the INI file; a ``volkins.hal`` among them is read as second HAL file and brings the e-stop chain.
    ``coordinates`` is the axis of each joint; ``home`` the position of X, Y and Z that homing gives to a joint where it rests.
    """
    files = files or {}
    at_home = dict(zip("XYZ", home, strict=True))
    ini = INI.format(kinematics=kinematics, acceleration=acceleration, joints=len(coordinates), units=units,
                     coordinates=" ".join(coordinates))  # fmt: skip
    ini += "".join(
        AXIS.format(letter=letter, axis_acceleration=axis_acceleration) for letter in sorted(set(coordinates))
    )
    ini += "".join(
        JOINT.format(
            joint=joint,
            kind="ANGULAR" if letter in "ABC" else "LINEAR",
            home=at_home.get(letter, 0.0),
            acceleration=acceleration,
            more=more[joint] if joint < len(more) else "",
        )  # fmt: skip
        for joint, letter in enumerate(coordinates)
    )
    second = files.get("volkins.hal", "")
    wiring = (hal or "".join(LOOP.format(k=k) for k in range(len(coordinates)))) + (
        "" if "iocontrol.0.emc-enable-in" in second + (hal or "") else ENABLE
    )
    if second:
        ini = ini.replace("HALFILE = mill.hal", "HALFILE = mill.hal\nHALFILE = volkins.hal")
    wiring += sampler(sampled, wiring + second)
    kinds = {"settling": "b", "at-zero": "b", "fault-code": "s"}
    channels = "".join(next((kinds[end] for end in kinds if name.endswith(end)), "f") for name in sampled)
    texts = {
        "mill.ini": ini,
        "mill.hal": HAL.format(cfg=channels, more=wiring),
        "plan.json": json.dumps({"steps": steps, "channels": channels, "pins": list(pins)}),
        "tool.tbl": "T1 P1 Z80\n",
    }
    here, output = launch(workshop, ["linuxcnc", "-r", "mill.ini"], {**texts, **files})
    assert (here / "result.json").is_file(), output
    result = json.loads((here / "result.json").read_text())
    rows = np.fromfile(here / "samples.f64").reshape(-1, len(sampled))
    return SimpleNamespace(**result, output=output, rows=dict(zip(sampled, rows.T, strict=True)))


# --- COMP_FILE --------------------------------------------------------------------------------------------------------

#: Moves of all joints in both directions, rapid, fast and slow, ends inside and outside the tables.
MOVES = (
    "G21 G90 G61 G94",
    "G1 X180 Y-90 Z-230 F150000",
    "G1 X-310 Y310 Z-5 F300000",
    "G1 X-295 Y295 Z-12 F6000",
    "G0 X150 Y-50 Z-235",
    "G1 X-120 Y200 Z-60 F60000",
)
JOINT_NAMES = ("pos-cmd", "vel-cmd", "backlash-corr", "backlash-filt", "motor-pos-cmd")
JOINT_PINS = [f"joint.{k}.{name}" for k in range(3) for name in JOINT_NAMES]


def joint_rows(rows, joint):
    return tuple(rows[f"joint.{joint}.{name}"] for name in JOINT_NAMES)


def comp_lines(file_type):
    names = ("joint0-x.comp", "joint1-y.comp", "joint2-z.comp")
    return [f"COMP_FILE = {name}\nCOMP_FILE_TYPE = {file_type}" for name in names]


@pytest.fixture(scope="module")
def positioning(small_errors):
    return small_errors.only("EXX", "EYY", "EZZ")


@pytest.fixture(scope="module")
def reversal():
    """Backlash of X constant, of Y over its travel, none of Z; in mm."""
    unknown = np.full(3, np.nan)
    along_y = Curve(np.array([-100.0, 60.0, 300.0]), np.array([-4e-3, -9e-3, 2e-3]), unknown)
    return ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-6e-3]), unknown[:1]), (1, 1): along_y})


def tool_error(errors, reversal, joint, motor, command, velocity):
    """Error of the simulated machine along one joint: where it stands less where it was told to, mm."""
    approach, position = np.zeros((len(motor), 3)), np.zeros((len(motor), 3))
    approach[:, joint], position[:, joint] = np.sign(velocity), motor
    axis = "XYZ"[joint]
    moved = reversal.displacement(position, approach)[:, joint]
    return motor + errors.curves[f"E{axis}{axis}"].at(motor) + moved - command


@pytest.mark.parametrize(("file_type", "unit"), [(1, "mm"), (0, "mm"), (1, "inch"), (0, "inch")])
def test_comp_files_act_bit_for_bit_as_emulated_and_the_error_shrinks_a_thousandfold(
    file_type, unit, workshop, small_machine, positioning, reversal
):
    machine = small_machine.with_setting("linuxcnc-comp", "comp_file_type", file_type)
    machine = machine.with_setting("linuxcnc-comp", "machine_units", unit)
    made = compgen.export(machine, positioning, "linuxcnc-comp", reversal=reversal)
    control = controller_named("linuxcnc-comp")
    settings = control.read_settings(machine)
    tables = control(machine, settings).parse([SourceFile(Path(name), text) for name, text in made.files.items()])
    steps = [{"mdi": line} for line in MOVES]
    done = session(workshop, steps, JOINT_PINS, more=comp_lines(file_type), files=made.files, units=unit)
    assert done.messages == []
    scale = {"mm": 1.0, "inch": 25.4}[unit]
    for joint in range(3):
        position, velocity, corrected, filtered, motor = (rows * scale for rows in joint_rows(done.rows, joint))
        moving = velocity != 0
        assert np.count_nonzero(moving) > 300
        assert np.ptp(position) > 200  # mm, in either unit
        points = np.zeros((len(position), 3))
        points[:, joint] = position
        approach = np.zeros_like(points)
        approach[:, joint] = np.sign(velocity)
        added = control(machine, settings).emulate(tables, compgen.Points(points, approach=approach))[:, joint]
        if unit == "mm":
            assert np.array_equal(corrected[moving], added[moving])
        assert np.max(np.abs((corrected - added)[moving])) < AGREEMENT_MM  # mm to inch and back is not bit for bit
        assert np.array_equal(filtered, corrected)
        assert np.max(np.abs(motor - (position + filtered))) < AGREEMENT_MM
        low, high = machine.axes[joint].range_mm
        inside = moving & (position > low) & (position < high)
        before = tool_error(positioning, reversal, joint, position, position, velocity)[inside]
        after = tool_error(positioning, reversal, joint, motor, position, velocity)[inside]
        assert np.max(np.abs(before)) > 0.01
        assert np.max(np.abs(before)) > SHRINKS_BY * np.max(np.abs(after))


def test_a_control_without_comp_files_adds_nothing(workshop):
    done = session(workshop, [{"mdi": line} for line in MOVES[:3]], JOINT_PINS)
    for joint in range(3):
        position, velocity, corrected, _, motor = joint_rows(done.rows, joint)
        assert np.any(velocity != 0)
        assert not np.any(corrected)
        assert np.array_equal(motor, position)


def test_a_small_reversal_step_is_lost_from_standstill_exactly_where_the_warning_says(workshop):
    """Steps of 1, 2 and 3 um at 5000 mm/s2 and 1 ms: at once, never, ramped."""
    steps_mm = (0.001, 0.002, 0.003)
    files = {f"joint{k}-{'xyz'[k]}.comp": f"-100 {step} 0\n100 {step} 0\n" for k, step in enumerate(steps_mm)}
    plan = [{"mdi": line} for line in ("G21 G90 G61", "G1 X9 Y9 Z9 F6000", "G1 X2 Y2 Z2", "G1 X9 Y9 Z9")]
    done = session(
        workshop, plan, JOINT_PINS, more=comp_lines(1), files=files, acceleration=5000, axis_acceleration=5000
    )
    for joint, step_mm in enumerate(steps_mm):
        _, _, corrected, filtered, _ = joint_rows(done.rows, joint)
        outcome = standstill_outcome(step_mm, 5000.0, 1e-3)
        assert np.max(corrected) == np.float32(step_mm)
        assert np.max(filtered) == pytest.approx(0.0 if outcome == "never" else step_mm, abs=1e-9)
        values = np.unique(np.round(filtered, 9))
        assert (len(values) > 2) == (outcome == "ramped")


@pytest.mark.parametrize(
    ("text", "used_mm"),
    [
        ("# first\n-100 0.5 0.5\n100 0.5 0.5\n", 0.0),
        ("-100 0.5 0.5\n\n100 0.9 0.9\n", 0.5),
        ("-100,0 0,5 0,5\n100,0 0,5 0,5\n", 0.0),
    ],
)
def test_what_our_parser_refuses_is_what_the_control_drops_without_a_word(workshop, small_machine, text, used_mm):
    control = controller_named("linuxcnc-comp")
    with pytest.raises(compgen.InputError):
        control(small_machine).parse([SourceFile(Path("x.comp"), text)])
    files = {"joint0-x.comp": text}
    more = (comp_lines(1)[0], "", "")
    done = session(workshop, [{"mdi": "G0 X50"}], JOINT_PINS, more=more, files=files)
    assert done.rows["joint.0.backlash-corr"][-1] == used_mm


# --- volumetric -------------------------------------------------------------------------------------------------------

PROGRAM = """G21 G90 G61 G94
G0 X-250 Y-60 Z-40
G1 X150 Y250 Z-200 F100000
G2 X100 Y100 I-85 J-55 F60000
G43.1 Z80
G1 X-280 Y280 Z-150 F100000
G1 X190 Y-90 Z-130 F200000
G49
G1 X0 Y0 Z-20 F100000
M2
"""
AXIS_PINS = [f"axis.{axis}.pos-cmd" for axis in "xyz"]
VOLKINS_PINS = [
    *AXIS_PINS,
    *(f"joint.{k}.coarse-pos-cmd" for k in range(3)),
    *(f"motion.tooloffset.{a}" for a in "xyz"),
]


def columns(rows, names):
    return np.column_stack([rows[name] for name in names])


def table_of(machine, files):
    control = controller_named("linuxcnc-volumetric")
    sources = [SourceFile(Path(name), text) for name, text in files.items()]
    return control(machine).parse(sources)


#: Tool offset that the kinematics uses in a cycle (error model).
USED_PINS = [f"volkins.used-{a}" for a in "xyz"]


def moved_samples(done):
    """Commanded positions, joint positions and tool offsets (error model) of the samples in world mode, machine units."""
    command, joints = columns(done.rows, AXIS_PINS), columns(done.rows, VOLKINS_PINS[3:6])
    volkins = USED_PINS[0] in done.rows
    tool = columns(done.rows, USED_PINS) if volkins else -columns(done.rows, VOLKINS_PINS[6:9])
    first = int(np.argmax(np.any(np.diff(command, axis=0, prepend=command[:1]) != 0, axis=1)))
    return command[first:], joints[first:], tool[first:]


@pytest.fixture(scope="module")
def reached(workshop, small_machine, small_errors):
    """Error of the tool along the program without compensation: what is told is what the joints get."""
    done = session(workshop, [{"program": "part.ngc"}], [*VOLKINS_PINS], files={"part.ngc": PROGRAM})
    command, joints, tool = moved_samples(done)
    assert np.array_equal(command, joints)
    return exact_error(small_machine, small_errors, joints, tool)


@pytest.mark.parametrize(("form", "unit"), [("curves", "mm"), ("grid", "mm"), ("curves", "inch"), ("grid", "inch")])
def test_volkins_agrees_with_the_emulator_in_every_cycle_and_the_error_shrinks(
    form, unit, workshop, small_machine, small_errors, reached
):
    machine = small_machine.with_setting("linuxcnc-volumetric", "form", form)
    machine = machine.with_setting("linuxcnc-volumetric", "machine_units", unit)
    made = compgen.export(machine, small_errors, "linuxcnc-volumetric")
    done = session(
        workshop,
        [{"program": "part.ngc"}],
        [*VOLKINS_PINS, *USED_PINS],
        kinematics="volkins file=volcomp.tab",
        files={**made.files, "part.ngc": PROGRAM},
        pins=("volkins.loaded", "volkins.fault"),
        units=unit,
    )
    assert done.messages == []
    assert done.pins == {"volkins.loaded": True, "volkins.fault": False}
    command, joints, tool = (rows * (1.0 if unit == "mm" else 25.4) for rows in moved_samples(done))
    assert len(command) > 1000
    assert np.ptp(command[:, 0]) > 400  # mm, in either unit
    assert {0.0, -80.0} <= set(np.round(tool[:, 2], 9).tolist())
    table = table_of(machine, made.files)
    assert np.max(np.abs(joints - table.inverse(command, tool))) < AGREEMENT_MM
    with_tool = np.abs(tool[:, 2] + 80.0) < 1e-9 if form == "grid" else np.full(len(tool), True)
    after = (joints + exact_error(machine, small_errors, joints, tool) - command)[with_tool]
    assert np.max(np.abs(reached)) > 0.02
    assert np.max(np.abs(reached)) > SHRINKS_BY * np.max(np.abs(after))


def test_a_corrected_program_does_without_tables_what_volkins_does_with_them(
    tmp_path, workshop, small_machine, small_errors
):
    """The same control runs the program of the CAM with volkins, and the corrected program without: the tool is on the path."""
    text = """G21 G90 G61 G94 G17 G54
G43.1 Z80
G4 P1
G0 X-250 Y-60 Z-120
G1 X150 Y250 Z-280 F100000
G2 X100 Y100 I-85 J-55 F60000
G1 X-280 Y280 Z-230 F100000
G1 X190 Y-90 Z-210 F200000
G1 X0 Y0 Z-100 F100000
M2
"""
    source = tmp_path / "part.ngc"
    source.write_text(text)
    setup = Setup({"G54": (0.0, 0.0, 0.0)})
    model = model_of(small_machine, small_errors, None)
    # decimals enough that the tolerance is what remains
    options = CorrectOptions("linuxcnc", tolerance_um=0.5, decimals=6)
    result = correct_program(model, source, tmp_path / "out", options, setup)
    reader = Reader(small_machine, DIALECTS["linuxcnc"], setup, source)
    (batch,) = reader.batches(io.BytesIO(text.encode()))
    cut = batch.moves.part(np.flatnonzero(batch.moves.cutting))
    count = np.ceil(lengths_of(cut) / 0.05).astype(int)
    own = np.repeat(np.arange(len(cut)), count)
    share = (np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)) / (count[own] - 1)
    path = points_of(cut.part(own), share)
    near = cKDTree(path)

    def largest(program, kinematics, files):
        done = session(workshop, [{"program": "part.ngc"}], [*VOLKINS_PINS], kinematics=kinematics,
                       files={**files, "part.ngc": program})  # fmt: skip
        assert done.messages == []
        _, joints, tool = moved_samples(done)
        tool = np.broadcast_to([0.0, 0.0, -80.0], tool.shape)
        tip = joints + exact_error(small_machine, small_errors, joints, tool)
        begin = int(np.argmin(np.linalg.norm(tip[: len(tip) // 2] - cut.start_mm[0], axis=1)))
        tip = tip[begin + 1 :]
        first = near.query(tip, k=4)[1]  # where two moves meet, the point of both
        best = np.full(len(tip), np.inf)
        for k in np.concatenate([first - 1, first], axis=1).T.clip(0, len(path) - 2):
            way = path[k + 1] - path[k]
            along = np.einsum("ij,ij->i", tip - path[k], way) / np.maximum(np.einsum("ij,ij->i", way, way), 1e-30)
            best = np.minimum(best, np.linalg.norm(tip - path[k] - along.clip(0, 1)[:, None] * way, axis=1))
        assert len(best) > 1000
        return best.max()

    made = compgen.export(small_machine, small_errors, "linuxcnc-volumetric")
    corrected = (tmp_path / "out" / result.file).read_text()
    before = largest(text, "trivkins coordinates=XYZ", {})
    with_tables = largest(text, "volkins file=volcomp.tab", made.files)
    by_program = largest(corrected, "trivkins coordinates=XYZ", {})
    assert before > 15e-3
    assert with_tables < 0.1e-3
    assert by_program < 0.6e-3


def damaged(text, how):
    """The table of a user whose disk, editor or memory stick failed him; None: no file at all."""
    return {
        "missing": None,
        "cut": text[: len(text) // 2],
        "cut after end": text[: text.index("# Volumetric")],
        "one digit": text.replace("curve EXX 0 6 -300", "curve EXX 0 6 -200", 1),
    }[how]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("missing", "cannot open"),
        ("cut", "expected a number"),
        ("cut after end", "no checksum"),
        ("one digit", "checksum is wrong"),
    ],
)
def test_a_table_that_is_damaged_keeps_the_machine_in_e_stop(how, said, workshop, small_machine, small_errors):
    files = dict(compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files)
    text = damaged(files.pop("volcomp.tab"), how)
    if text is not None:
        files["volcomp.tab"] = text
    done = session(
        workshop, [], AXIS_PINS, kinematics="volkins file=volcomp.tab", files=files, pins=("volkins.loaded",)
    )
    assert done.started is False
    assert done.pins == {"volkins.loaded": False}
    assert re.search(f"NO COMPENSATION.*volcomp.tab.*{said}", done.output)


def test_without_a_table_coordinated_motion_is_refused_even_past_the_e_stop_chain(workshop):
    """A user who leaves volkins.hal out is not moved without compensation either."""
    steps = [{"mdi": "G1 X10 F6000"}]
    names = [*AXIS_PINS, *(f"joint.{k}.motor-pos-cmd" for k in range(3))]
    done = session(workshop, steps, names, kinematics="volkins file=none.tab", pins=("volkins.loaded", "volkins.fault"))
    assert done.pins == {"volkins.loaded": False, "volkins.fault": True}
    assert done.messages
    assert not np.any(columns(done.rows, names[3:]))


LOOKUP = """\
loadrt threads name1=servo period1=1000000
loadrt volcomp file=volcomp.tab units=mm
setp volcomp.enable TRUE
setp volcomp.rate 1e9
addf volcomp.feedback servo
addf volcomp.command servo
setp volcomp.gauge-z -5
setp volcomp.motor-x 7
start
loadusr -w ./lookup.py
"""


def test_the_hal_component_looks_up_as_the_emulator_does(workshop, small_machine, small_errors):
    files = compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files
    generator = np.random.default_rng(4)
    points = generator.uniform(small_machine.lower_mm - 40.0, small_machine.upper_mm + 40.0, (200, 3))
    offset = generator.uniform(-50.0, 120.0, (200, 3))
    texts = {**files, "lookup.hal": LOOKUP, "points.f64": np.hstack([points, offset]).tobytes()}
    here, output = launch(workshop, ["halrun", "-f", "lookup.hal"], texts)
    assert (here / "corrections.f64").is_file(), output
    found = np.fromfile(here / "corrections.f64").reshape(-1, 3)
    tool = np.array([0.0, 0.0, -5.0]) - offset
    expected = table_of(small_machine, files).inverse(points, tool) - points
    assert np.max(np.abs(expected)) > 0.02
    assert np.max(np.abs(found - expected)) < AGREEMENT_MM


@pytest.mark.parametrize(
    ("table_unit", "machine_unit", "stated", "said"),
    [
        ("mm", "inch", "", r'the table is in mm, but the machine is in inch: export it with machine_units = "inch"'),
        ("mm", "imperial", "", "the table is in mm, but the machine is in inch"),
        ("inch", "mm", "", "the table is in inch, but the machine is in mm"),
        ("inch", "metric", "", "the table is in inch, but the machine is in mm"),
        ("mm", "inch", " units=mm", r"units=mm, but \[TRAJ\] LINEAR_UNITS = inch"),
        ("mm", "mm", " units=cm", "units=cm is not known"),
    ],
)
def test_a_table_in_another_unit_than_the_machine_keeps_it_in_e_stop(
    table_unit, machine_unit, stated, said, workshop, small_machine, small_errors
):
    machine = small_machine.with_setting("linuxcnc-volumetric", "machine_units", table_unit)
    files = compgen.export(machine, small_errors, "linuxcnc-volumetric").files
    done = session(
        workshop, [], AXIS_PINS, kinematics=f"volkins file=volcomp.tab{stated}", files=files, pins=("volkins.loaded",),
        units=machine_unit,
    )  # fmt: skip
    assert done.started is False
    assert done.pins == {"volkins.loaded": False}
    assert re.search(f"NO COMPENSATION.*volcomp.tab.*{said}", done.output)


@pytest.mark.parametrize("stated", ["", " coordinates=XYYZAC"])
def test_further_axes_and_both_joints_of_a_gantry_get_their_commands(stated, workshop, small_machine, small_errors):
    """Rotary axes as they are told; the second joint of Y goes with the first; what volkins adds is that of XYZ."""
    machine = small_machine.with_setting("linuxcnc-volumetric", "coordinates", "XYYZAC")
    files = compgen.export(machine, small_errors, "linuxcnc-volumetric").files
    assert "KINEMATICS = volkins file=volcomp.tab coordinates=XYYZAC\nJOINTS = 6" in files["volkins.ini"]
    names = [*(f"axis.{a}.pos-cmd" for a in "xyzac"), *(f"joint.{k}.coarse-pos-cmd" for k in range(6))]
    names += ["axis.x.teleop-pos-cmd"]
    lines = ("G21 G90 G61", "G0 A90", "G1 X-200 Y200 Z-150 A-45 C30 F60000", "G0 C-10")
    done = session(
        workshop,
        [{"mdi": line} for line in lines],
        names,
        kinematics=f"volkins file=volcomp.tab{stated}",
        files=files,
        coordinates="XYYZAC",
        pins=[*names, "volkins.loaded"],
    )
    assert done.messages == []
    assert done.pins["volkins.loaded"] is True
    command, joints = columns(done.rows, names[:5]), columns(done.rows, names[5:11])
    started = int(np.argmax(command[:, 3] != 0))
    assert np.max(joints[:, 4]) == 90.0
    assert np.array_equal(joints[started:, 4:], command[started:, 3:])
    assert np.array_equal(joints[:, 1], joints[:, 2])
    expected = table_of(machine, files).inverse(command[started:, :3], np.zeros(3))
    assert np.max(np.abs(joints[started:, [0, 1, 3]] - expected)) < AGREEMENT_MM
    assert command[-1] == pytest.approx([-200, 200, -150, -45, -10], abs=1e-9)
    assert np.max(np.abs(joints[-1, [0, 1, 3]] - command[-1, :3])) > 0.005


@pytest.mark.parametrize(
    ("coordinates", "stated", "said"),
    [
        ("XYZA", " coordinates=XYZ", r"no joint for A of \[TRAJ\] COORDINATES = X Y Z A"),
        ("XYZ", " coordinates=XYZA", r"\[KINS\] JOINTS = 3, and the coordinates are for 4 joints"),
        ("XYZ", " coordinates=XYQ", "'Q' at joint 2 is not one of"),
        ("XYZ", " coordinates=XYY", "no joint for Z"),
    ],
)
def test_joints_that_do_not_fit_the_ini_file_keep_the_machine_in_e_stop(
    coordinates, stated, said, workshop, small_machine, small_errors
):
    files = compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files
    done = session(
        workshop, [], AXIS_PINS, kinematics=f"volkins file=volcomp.tab{stated}", files=files, pins=("volkins.loaded",),
        coordinates=coordinates,
    )  # fmt: skip
    assert done.started is False
    assert done.pins == {"volkins.loaded": False}
    assert re.search(f"NO COMPENSATION.*{said}", done.output)


@pytest.mark.parametrize("unit", ["mm", "inch"])
def test_volkins_never_steps_the_joints_at_homing_or_tool_changes(unit, workshop, small_machine, small_errors):
    """Homed at X 905 mm, beyond the table: joints rest through homing, and follow a new tool as slowly as it is taken up."""
    scale = 1.0 if unit == "mm" else 25.4
    machine = small_machine.with_setting("linuxcnc-volumetric", "machine_units", unit)
    files = compgen.export(machine, small_errors, "linuxcnc-volumetric").files
    steps = [
        {"home": -1},
        {"mdi": "G21 G43.1 Z150"},
        {"rest": "volkins.settling"},
        {"mdi": "G49"},
        {"rest": "volkins.settling"},
    ]
    names = [*VOLKINS_PINS, *USED_PINS]
    done = session(
        workshop, steps, names, kinematics="volkins file=volcomp.tab", files=files, units=unit,
        home=(905.0 / scale, 250.0 / scale, -230.0 / scale),
    )  # fmt: skip
    assert done.messages == []
    joints, used = columns(done.rows, VOLKINS_PINS[3:6]) * scale, columns(done.rows, USED_PINS) * scale
    assert joints[-1] == pytest.approx([905.0, 250.0, -230.0], abs=0.1)
    table = table_of(machine, files)
    with_tool = used[:, 2] != 0
    assert np.min(used[:, 2]) == pytest.approx(-150.0)
    assert np.count_nonzero(with_tool & (used[:, 2] > -149.999)) > 500  # 150 mm at 200 mm/s, twice
    turned = np.ptp(joints[with_tool], axis=0)
    assert np.max(turned) > 0.002
    tip = table.forward(joints[with_tool], used[with_tool])
    assert np.max(np.ptp(tip, axis=0)) < AGREEMENT_MM  # the tip stays while the joints follow


def test_a_tool_pin_that_is_not_a_number_stops_volkins_with_an_error(workshop, small_machine, small_errors):
    files = dict(compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files)
    files["volkins.hal"] = files["volkins.hal"].replace("net volkins-tool-z", "# net volkins-tool-z")
    steps = [{"mdi": "G21 G90 G61 G1 X-100 Y50 Z-40 F60000"}, {"set": ["volkins.tool-z", "nan"]}, {"mdi": "G1 X100"}]
    names = [*VOLKINS_PINS, *(f"joint.{k}.motor-pos-cmd" for k in range(3))]
    done = session(workshop, steps, names, kinematics="volkins file=volcomp.tab", files=files, pins=("volkins.fault",))
    assert done.pins == {"volkins.fault": True}
    assert any("kinematics" in message.lower() for message in done.messages), done.messages
    drives = columns(done.rows, names[-3:])
    assert np.all(np.isfinite(drives))
    assert drives[-1] == pytest.approx([-100, 50, -40], abs=0.1)


#: A simulated drive stands where it is sent; the functions in an order for simulation: command before feedback.
DRIVES = "".join(f"net drive-{a} volcomp.drive-{a} => volcomp.drive-fb-{a}\n" for a in "xyz")
VOLCOMP_FUNCTIONS = "addf volcomp.command servo-thread\naddf volcomp.feedback servo-thread\n"
VOLCOMP_NAMES = [
    f"{pin}-{a}"
    for pin in ("volcomp.pos", "volcomp.drive", "volcomp.motor-fb", "volcomp.tool", "volcomp.correction")
    for a in "xyz"
]
#: The rate at which volcomp takes up what changes without motion, mm/s, and the servo period.
RATE_MM_S, PERIOD_S = 0.1, 1e-3


def volcomp_session(workshop, machine, errors, steps, *, unit="mm", wired=(), **options):
    """Run the exported table and HAL file; returns (command, drive, feedback, tool, correction) in mm, table and session."""
    machine = machine.with_setting("linuxcnc-volumetric", "machine_units", unit)
    files = compgen.export(machine, errors, "linuxcnc-volumetric").files
    hal = files["volcomp.hal"] + DRIVES + VOLCOMP_FUNCTIONS
    for old, new in wired:
        assert old in hal
        hal = hal.replace(old, new)
    done = session(
        workshop, steps, [*VOLCOMP_NAMES, "volcomp.settling"], hal=hal, units=unit,
        files={"volcomp.tab": files["volcomp.tab"], "part.ngc": PROGRAM},
        pins=("volcomp.loaded", "volcomp.settling", "volcomp.fault"), **options,
    )  # fmt: skip
    scale = 1.0 if unit == "mm" else 25.4
    parts = [columns(done.rows, VOLCOMP_NAMES[k : k + 3]) * scale for k in range(0, 15, 3)]
    return parts, table_of(machine, files), done


@pytest.mark.parametrize("unit", ["mm", "inch"])
def test_the_hal_component_between_motion_and_drives_corrects_under_the_kinematics_of_the_machine(
    unit, workshop, small_machine, small_errors
):
    """Trivial kinematics: the drive gets the corrected command, the control sees its own one."""
    steps = [{"rest": "volcomp.settling"}, {"program": "part.ngc"}, {"rest": "volcomp.settling"}]
    parts, table, done = volcomp_session(workshop, small_machine, small_errors, steps, unit=unit)
    command, drive, feedback, tool, correction = parts
    assert done.messages == []
    assert done.pins == {"volcomp.loaded": True, "volcomp.settling": False, "volcomp.fault": False}
    expected = table.inverse(command, -tool) - command
    settled = done.rows["volcomp.settling"] == 0
    settled[: int(np.argmax(np.any(command != 0, axis=1)))] = False
    assert np.count_nonzero(settled & np.any(np.diff(command, axis=0, prepend=command[:1]) != 0, axis=1)) > 1000
    assert np.max(np.abs(expected[settled])) > 0.02
    assert np.max(np.abs((correction - expected)[settled])) < AGREEMENT_MM
    assert set(np.round(tool[settled, 2], 9).tolist()) == {0.0, 80.0}
    assert np.max(np.abs(drive - command - correction)) < AGREEMENT_MM
    assert np.max(np.abs(feedback - command)) < AGREEMENT_MM


@pytest.mark.parametrize("unit", ["mm", "inch"])
@pytest.mark.parametrize("home", [(905.0, 0.0, 0.0), (905.0, 250.0, -230.0)])
def test_homing_and_tool_changes_never_step_the_drives(home, unit, workshop, small_machine, small_errors):
    """At every cycle without motion the correction changes by the rate at most, through homing twice, G43 and G49."""
    there = [value / (1.0 if unit == "mm" else 25.4) for value in home]
    steps = [
        {"rest": "volcomp.settling"},
        {"home": -1},
        {"rest": "volcomp.settling"},
        {"mdi": "G21 G43.1 Z150"},
        {"rest": "volcomp.settling"},
        {"mdi": "G49"},
        {"rest": "volcomp.settling"},
    ]
    parts, table, done = volcomp_session(workshop, small_machine, small_errors, steps, unit=unit, home=there)
    command, _, _, tool, correction = parts
    assert done.messages == []
    assert command[-1] == pytest.approx(home)
    least = RATE_MM_S * PERIOD_S
    assert np.max(np.abs(np.diff(correction, axis=0))) < least * (1 + 1e-6)
    assert np.max(tool[:, 2]) == pytest.approx(150.0)
    at_home = [(table.inverse(command[-1:], np.array([0, 0, -z])) - command[-1])[0] for z in (0.0, 150.0)]
    assert correction[-1] == pytest.approx(at_home[0], abs=AGREEMENT_MM)
    assert np.max(np.abs(at_home[0])) > 100 * least
    with_tool = np.argmax(tool[:, 2] > 0) + np.argmax(done.rows["volcomp.settling"][np.argmax(tool[:, 2] > 0) :] == 0)
    assert correction[with_tool] == pytest.approx(at_home[1], abs=AGREEMENT_MM)


def test_the_path_waits_until_the_correction_of_a_new_tool_is_there(workshop, small_machine, small_errors):
    """No motion with a part of the correction: behind G43 the feed is held while the correction settles."""
    text = "G21 G90 G61\nG1 X-100 Y50 Z-40 F60000\nG43.1 Z150\nG1 X150 Y250 Z-100 F60000\nM2\n"
    steps = [{"rest": "volcomp.settling"}, {"mdi": "G0 Z-1"}, {"program": "wait.ngc"}, {"rest": "volcomp.settling"}]
    files = compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files
    hal = files["volcomp.hal"] + DRIVES + VOLCOMP_FUNCTIONS + "setp volcomp.rate 0.01\n"
    done = session(
        workshop, steps, [*VOLCOMP_NAMES, "volcomp.settling"], hal=hal,
        files={"volcomp.tab": files["volcomp.tab"], "wait.ngc": text},
    )  # fmt: skip
    assert done.messages == []
    command, tool = columns(done.rows, VOLCOMP_NAMES[:3]), columns(done.rows, VOLCOMP_NAMES[9:12])
    settling = done.rows["volcomp.settling"] != 0
    waiting = np.flatnonzero(settling & (tool[:, 2] > 0))
    assert len(waiting) > 100
    moved = np.abs(np.diff(command[waiting], axis=0)).sum(axis=0)
    assert np.all(moved < 1.0)  # it brakes from what one or two cycles gave it
    assert command[-1] == pytest.approx([150, 250, -100 + 150])  # the machine coordinate holds the tool


def test_a_tool_pin_that_is_not_a_number_holds_the_last_correction(workshop, small_machine, small_errors):
    unwired = [("net volcomp-tool-z motion.tooloffset.z =>", "net volcomp-tool-z")]
    steps = [
        {"rest": "volcomp.settling"},
        {"mdi": "G21 G90 G61 G1 X-100 Y50 Z-40 F60000"},
        {"set": ["volcomp-tool-z", "nan"]},
    ]
    parts, table, done = volcomp_session(workshop, small_machine, small_errors, steps, wired=unwired)
    command, drive, _, _, correction = parts
    assert done.pins == {"volcomp.loaded": True, "volcomp.settling": True, "volcomp.fault": True}
    assert np.all(np.isfinite(drive))
    expected = table.inverse(command[-1:], np.zeros(3))[0] - command[-1]
    assert correction[-1] == pytest.approx(expected, abs=AGREEMENT_MM)
    again = [*steps, {"set": ["volcomp-tool-z", "0"]}, {"rest": "volcomp.settling"}]
    parts, table, done = volcomp_session(workshop, small_machine, small_errors, again, wired=unwired)
    assert done.pins == {"volcomp.loaded": True, "volcomp.settling": False, "volcomp.fault": False}
    assert parts[4][-1] == pytest.approx(expected, abs=AGREEMENT_MM)


def test_the_hal_component_adds_nothing_before_it_is_enabled(workshop, small_machine, small_errors):
    unwired = [("net volcomp-enable", "# net volcomp-enable")]
    parts, _, done = volcomp_session(workshop, small_machine, small_errors, [{"mdi": "G0 X50"}], wired=unwired)
    assert not np.any(parts[4])
    assert np.ptp(parts[0][:, 0]) == 50.0
    assert done.pins["volcomp.loaded"] is True


def test_the_hal_component_refuses_a_table_in_another_unit(workshop, small_machine, small_errors):
    files = compgen.export(small_machine, small_errors, "linuxcnc-volumetric").files
    done = session(
        workshop, [], VOLCOMP_NAMES, hal=files["volcomp.hal"] + DRIVES + VOLCOMP_FUNCTIONS, units="inch",
        files={"volcomp.tab": files["volcomp.tab"]}, pins=("volcomp.loaded",),
    )  # fmt: skip
    assert done.started is False
    assert done.pins == {"volcomp.loaded": False}
    assert re.search("NO COMPENSATION.*volcomp.tab.*the table is in mm, but the machine is in inch", done.output)


# --- heat -------------------------------------------------------------------------------------------------------------

#: dz = 2 um/K of the spindle behind 1200 s, dx = -3 um/K of the bed; 12 hours pass in 6 s, so the lag is 1/6 s here.
DAY_S, HASTE = 6.0, 7200.0
HEAT_TERMS = (
    Term("spindle", 1200.0 / HASTE, "bed", {"dx": 0.0, "dz": 2.0}),
    Term("bed", 0.0, "bed", {"dx": -3.0, "dz": 0.0}),
)
HEAT_HULL = (Range("spindle", "", 18.0, 36.0), Range("bed", "", 18.0, 26.0))
HEAT_MODEL = HeatModel(
    "mill", HEAT_TERMS, dict.fromkeys(("dx", "dz"), np.eye(2)), HEAT_HULL, dict.fromkeys(("dx", "dz"), (9.0, 1.0))
)
HEAT_NAMES = (
    *(f"volheat.{pin}-{a}" for pin in ("drive", "motor", "motor-fb", "offset") for a in "xz"),
    *("volheat.temp-00", "volheat.temp-01", "volheat.share", "volheat.at-zero", "volheat.fault-code"),
)
HEAT_RATE_UM_S = 100.0


def heat_session(workshop, machine, steps):
    """Run the exported component between motion and drives; returns rows by pin, the output, and the session."""
    output = output_of(machine.with_setting("linuxcnc-heat", "rate_um_s", HEAT_RATE_UM_S), "linuxcnc-heat")
    files = output.files(HEAT_MODEL)
    drives = "".join(f"net drive-{a} volheat.drive-{a} => volheat.drive-fb-{a}\n" for a in "xyz")
    hal = files["volheat.hal"] + drives + "addf volheat.command servo-thread\naddf volheat.feedback servo-thread\n"
    # as on a machine whose sensors have been read before LinuxCNC starts its threads
    hal += "sets heat-spindle 20\nsets heat-bed 20\n"
    done = session(workshop, steps, HEAT_NAMES, hal=hal + ENABLE, files={"volheat.tab": files["volheat.tab"]},
                   pins=("volheat.loaded", "volheat.fault", "volheat.fault-sensor"))  # fmt: skip
    return done.rows, output.parse([SourceFile(Path("volheat.tab"), files["volheat.tab"])]), done


def heat_of_a_day(count):
    """Spindle and bed: a morning that warms, hot beyond the hull in the middle, and back."""
    t = np.linspace(0.0, 1.0, count)
    spindle = 20 + 14 * np.sin(np.pi * t) ** 2 + 8 * np.exp(-(((t - 0.55) / 0.06) ** 2))
    return np.column_stack([spindle, 20 + 4 * t]).tolist()


def test_a_day_of_heat_in_a_running_control_is_taken_away_at_a_limited_rate(workshop, small_machine):
    """Through the hull and beyond it, moves and an e-stop, then a broken sensor: what is added is what the emulator says."""
    day = {"signals": ["heat-spindle", "heat-bed"], "seconds": DAY_S, "rows": heat_of_a_day(1200)}
    hot = {**day, "seconds": 1.0, "rows": [[20 + 10 * k / 200, 24.0] for k in range(201)]}
    steps = [
        {"temperatures": day},
        {"temperatures": hot},
        {"mdi": "G21 G90 G1 X100 Z-50 F60000"},
        {"estop": 0},
        {"mdi": "G1 X20 Z-10 F60000"},
        {"temperatures": {**day, "seconds": 1.0, "rows": [[float("nan"), 24.0]]}},
    ]
    rows, table, done = heat_session(workshop, small_machine, steps)
    assert done.messages == []
    assert done.pins == {"volheat.loaded": True, "volheat.fault": True, "volheat.fault-sensor": 0}
    spindle, bed = rows["volheat.temp-00"], rows["volheat.temp-01"]
    offset = columns(rows, ["volheat.offset-x", "volheat.offset-z"])
    sound = np.isfinite(spindle)
    count = int(np.argmin(sound))
    assert sound[:count].all()
    # never faster than the rate, whatever happens
    assert np.abs(np.diff(offset, axis=0)).max() <= HEAT_RATE_UM_S * 1e-6 * (1 + 1e-6)
    # what the emulator says, from the first reading of the component to the fault
    read = Temperatures(1e-3 * np.arange(count), {"spindle": spindle[:count], "bed": bed[:count]})
    expected = table.added(read)[:, [0, 2]]
    begun = int(np.argmax(np.any(offset != 0, axis=1))) + 200
    assert np.abs(offset[:count] - expected)[begun:].max() < 2e-4  # mm: steps of the temperature against straight lines
    assert np.abs(offset[:count, 1]).max() > 0.02
    beyond = rows["volheat.share"][:count] == 0
    assert beyond.sum() > 100
    assert np.abs(offset[:count][beyond]).min() == 0.0
    # drives: the offset is added, the control does not see it, and nothing steps at the e-stop
    for k, axis in enumerate("xz"):
        drive, motor = rows[f"volheat.drive-{axis}"], rows[f"volheat.motor-{axis}"]
        assert np.abs(drive - motor - offset[:, k]).max() < AGREEMENT_MM
        assert np.abs(rows[f"volheat.motor-fb-{axis}"] - motor).max() < AGREEMENT_MM
    # the fault is said, and the offset is back at zero
    assert set(rows["volheat.fault-code"][count + 1 :].tolist()) == {1.0}
    assert rows["volheat.at-zero"][-1]
    assert not offset[-1].any()


# --- matrixkins: a module of LinuxCNC itself, from the release on that has it ----------------------------------------

MATRIXKINS = Path("/usr/lib/linuxcnc/modules/matrixkins.so")


@pytest.mark.skipif(not MATRIXKINS.is_file(), reason="the installed LinuxCNC has no module matrixkins")
def test_matrixkins_moves_the_joints_where_the_emulation_says(workshop, small_machine, small_errors):
    made = compgen.export(small_machine, small_errors, "linuxcnc-matrixkins")
    control = controller_named("linuxcnc-matrixkins")(small_machine)
    tables = control.parse([SourceFile(Path(name), text) for name, text in made.files.items()])
    wiring = "".join(LOOP.format(k=k) for k in range(3)) + made.files["matrixkins.hal"]
    done = session(workshop, [{"mdi": line} for line in MOVES], [*VOLKINS_PINS], kinematics="matrixkins", hal=wiring)
    command, joints, _ = moved_samples(done)
    assert np.ptp(command, axis=0).min() > 100.0
    added = control.emulate(tables, Points(command))
    assert np.max(np.abs(added)) > 0.01
    assert np.max(np.abs(joints - command - added)) < AGREEMENT_MM
