"""Probe programs: run by LinuxCNC's interpreter, or read word by word; their logs lead back to the errors of the machine."""

import os
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from compgen.data.comparison import without_rigid_motion
from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import open_measurement
from compgen.foreign.detect import import_file
from compgen.identification.options import IdentifyOptions
from compgen.identification.positions import identify_artefact
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.many_points import volumetric_error
from compgen.simulation.gauges import PlatePose, TouchProbe
from compgen.tables.probe_program import Probing, probe_program, read_probing

#: One control of each dialect.
DIALECTS = ("linuxcnc-comp", "siemens-cec", "isg-csv")
BORES = Probing("bore", 20.0, 6.0, overtravel_mm=3.0)
SPHERES = Probing("sphere", 20.0, 6.0, overtravel_mm=3.0)
PLATE = TouchProbe(
    poses=tuple(PlatePose((-50.0, 100.0, -100.0), (0.0, 0.0, angle)) for angle in (0.0, 90.0)),
    columns=5, rows=4, pitch_mm=(55.0, 60.0, 0.0), components=(0, 1), calibrated=True, noise_um=0.3,
)  # fmt: skip
BALLS = replace(
    PLATE,
    components=(0, 1, 2),
    poses=(PlatePose((-50.0, 100.0, -150.0)),),
    columns=8,
    rows=6,
    pitch_mm=(48.0, 48.0, 0.0),
)
POSITION = r"([-+]?\d+\.\d+)"


@pytest.fixture(scope="module")
def errors(small_machine):
    x, y = (small_machine.axes[k].nodes_mm for k in (0, 1))
    curves = {
        "EXX": Curve(x, 60e-6 * (x + 50.0), np.zeros(6)),
        "EYX": Curve(x, 8e-3 * np.array([0, 1, 1.5, 1.2, 0.4, 0]), np.zeros(6)),
        "EYY": Curve(y, -40e-6 * (y - 100.0), np.zeros(5)),
    }
    return ErrorTable(curves, {"EC0Y": (80e-6, 0.0)})


def contact(machine, errors, centre_mm, reach_mm, start_mm, target_mm, dimensions):
    """Position of the axes at which the tip comes to the distance of contact from the true centre, by the secant method."""
    tool = np.array(machine.tool_offset_mm)

    def away(share):
        at = (start_mm + share * (target_mm - start_mm))[None]
        tip = tip_position(machine, errors.at(at), at, tool)[0] - tool
        return np.linalg.norm((tip - centre_mm)[:dimensions]) - reach_mm

    first, second = 0.7, 1.0
    before, now = away(first), away(second)
    assert away(0.0) * now < 0, "no contact"
    while abs(now) > 1e-9:
        first, second = second, second - now * (second - first) / (now - before)
        before, now = now, away(second)
    return start_mm + second * (target_mm - start_mm)


def log_of(program, controller, machine, errors, probe, probing, seed=3):
    """The log that the program leaves on a machine with errors; the artefact lies 0.2 mm and 1 mrad off.

    Every motion of the program is followed; the number that the control writes is the position at the true contact.
    """
    rng, lines, at, value, pose = np.random.default_rng(seed), [], np.zeros(3), None, -1
    placed = replace(probe, misplaced_mm=0.2, misturned_mrad=1.0)
    true_mm = [placed.lying(pose, probe.features_mm(), rng) for pose in probe.poses]
    sphere = probing.feature == "sphere"
    reach_mm = 0.5 * (probing.diameter_mm + (probing.ball_mm if sphere else -probing.ball_mm))
    for line in program.splitlines():
        pose += bool(re.match(r"[(;] ?Pose ", line))
        logged = re.search(
            r'^\(LOG,([^#)]*)|^(?:#MSG SAVE EXCLUSIVE \[|WRITE\(_VC_ERROR,"VOLCOMP_PROBE",)"([^"%]*)', line
        )
        if logged:
            text = (logged.group(1) or logged.group(2)).rstrip()
            number = f"{round(value * 1e5)}" if controller == "siemens-cec" and value else f"{value or 0.0:.6f}"
            lines.append(f"{text} {number}" if re.match(r"P\d", text) else text)
            continue
        words = re.findall(rf"([XYZ])\[?{POSITION}", line)
        if not words or not re.match(r"G1 |G38\.2 |MEAS=1 |G100 ", line):
            continue
        target = at.copy()
        for letter, number in words:
            target["XYZ".index(letter)] = float(number)
        if not line.startswith("G1 "):
            assert len(words) == 1
            near = min(true_mm[pose], key=lambda place: np.linalg.norm((place - 0.5 * (at + target))[:2]))
            target = contact(machine, errors, near, reach_mm, at, target, 3 if sphere else 2)
            axis = "XYZ".index(words[0][0])
            value = target[axis] + rng.normal(0.0, 1e-3 * probe.noise_um)
        at = target
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("controller", DIALECTS)
@pytest.mark.parametrize(("probe", "probing"), [(PLATE, BORES), (BALLS, SPHERES)], ids=["bores", "spheres"])
def test_the_log_of_a_program_gives_the_errors_of_the_machine_back(
    tmp_path, small_machine, errors, controller, probe, probing
):
    program = probe_program(small_machine, probe, probing, controller)
    log = tmp_path / "volcomp-probe.log"
    log.write_text(log_of(program, controller, small_machine, errors, probe, probing))
    artefact = open_measurement_quietly(log)
    # contacts of 0.3 um scatter: a centre is better by the root of the contacts that show a coordinate
    found = identify_artefact(small_machine, artefact, IdentifyOptions(u_deviation_um=0.3 / np.sqrt(2.0)))
    assert 0.5 < found.reduced_chi_square < 1.6
    place = np.array([[x, y, probe.poses[0].origin_mm[2]] for x in (-150.0, -50.0, 50.0) for y in (20.0, 100.0, 180.0)])
    left = volumetric_error(small_machine, found.errors, place) - volumetric_error(small_machine, errors, place)
    left[:, 2] = 0.0
    before = volumetric_error(small_machine, errors, place)
    before[:, 2] = 0.0
    assert np.abs(without_rigid_motion(place, before)).max() > 5e-3
    assert np.abs(without_rigid_motion(place, left)[:, :2]).max() < 1.2e-3


def open_measurement_quietly(path):
    with pytest.warns(CompgenWarning, match="was read as: probe-log, artefact"):
        return open_measurement([path])


@pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed")
@pytest.mark.parametrize("offset_mm", [(0.0, 0.0, 0.0), (-210.5, 33.25, 12.0)])
def test_linuxcnc_itself_runs_the_program_and_logs_machine_coordinates(tmp_path, small_machine, offset_mm):
    """Its interpreter without a machine finds every contact at the target; a work offset must not matter."""
    program = probe_program(small_machine, PLATE, BORES, "linuxcnc-volumetric")
    x, y, z = offset_mm
    (tmp_path / "p.ngc").write_text(program.replace("G90 G21", f"G10 L2 P1 X{x} Y{y} Z{z}\nG90 G21", 1))
    done = subprocess.run(
        ["rs274", "-g", "p.ngc"], cwd=tmp_path, env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert "error" not in done.stderr.lower().replace("errors", "")
    canon = re.findall(r"(STRAIGHT_PROBE|STRAIGHT_FEED|LOG)\((.*)\)", done.stdout)
    low, high = small_machine.lower_mm - 1e-6, small_machine.upper_mm + 1e-6
    position, contacts = None, 0
    for name, text in canon:
        if name != "LOG":
            position = np.array([float(word) for word in text.split(",")[:3]]) + offset_mm
            if contacts or name == "STRAIGHT_PROBE":
                assert np.all(position >= low)
                assert np.all(position <= high)
        elif text.startswith('"P'):
            words = text.strip('"').split()
            contacts += 1
            assert [float(word) for word in words[7:10]] == pytest.approx(position, abs=1e-3)
            assert float(words[-1]) == pytest.approx(position["XYZ".index(words[10][0])], abs=1e-3)
    assert contacts == 4 * 20 * 2
    assert done.stdout.count("PROGRAM_STOP") == 1 + len(PLATE.poses)


@pytest.mark.parametrize("controller", DIALECTS)
def test_between_features_the_probe_is_above_everything(small_machine, controller):
    """Motion in X and Y at the height of a contact is only from a contact back to its start, and along one axis."""
    program = probe_program(small_machine, BALLS, SPHERES, controller)
    at, probed = np.array([0.0, 0.0, -1.0]), False
    for line in program.splitlines():
        words = re.findall(rf"([XYZ])\[?{POSITION}", line)
        if not words or not re.match(r"G1 |G38\.2 |MEAS=1 |G100 ", line):
            continue
        target = at.copy()
        for letter, number in words:
            target["XYZ".index(letter)] = float(number)
        moved = np.abs(target - at) > 1e-9
        if line.startswith("G1 ") and moved[:2].any() and not probed:
            assert at[2] == pytest.approx(-1.0)
        assert moved.sum() <= (2 if at[2] == -1.0 else 1)
        probed = not line.startswith("G1 ")
        at = target


def test_comments_of_a_program_cannot_be_ended_by_the_name_of_a_machine(small_machine):
    named = replace(small_machine, name='a) G0 X999\n(b "c')
    for controller in DIALECTS:
        program = probe_program(named, PLATE, BORES, controller)
        assert not re.search(r"^[^(;#W]*G0 X999", program, re.MULTILINE)


@pytest.fixture(scope="module")
def whole_log(small_machine, errors):
    program = probe_program(small_machine, PLATE, BORES, "linuxcnc-comp")
    return log_of(program, "linuxcnc-comp", small_machine, errors, PLATE, BORES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("END", ""), "has no END"),
        (lambda text: text + text, "contains 2 runs"),
        (lambda text: re.sub(r"(VOLCOMP \w+ LOG 1)", r"\1 copy", text), "was it edited"),
        (lambda text: re.sub(r"P1 F001 .* X- .*\n", "", text), "feature F001 of pose 1 lacks the contacts X-"),
        (lambda text: re.sub(r"(P1 F002 .*X\+ ).*", r"\1 12 mm", text), "is not a contact of the program"),
        (lambda text: re.sub(r"(P1 F002 .*X\+ ).*", r"\g<1>-180.0", text), "was the probe elsewhere"),
        (lambda text: text.replace("FEATURE bore", "FEATURE ring"), "is not a head line"),
        (lambda text: re.sub(r"(P1 F003 .*Y\+ .*\n)", r"\1\1", text), "is there twice"),
    ],
)
def test_damaged_logs_are_refused(tmp_path, whole_log, change, message):
    log = tmp_path / "p.log"
    log.write_text(change(whole_log))
    assert log.read_text() != whole_log
    with pytest.raises(InputError, match=message):
        import_file(log)


@pytest.mark.parametrize(
    ("probe", "probing", "controller", "message"),
    [
        (PLATE, BORES, "fanuc-3d", "no public document of fanuc-3d describes probing"),
        (PLATE, BORES, "linuxcnc", "there is no controller 'linuxcnc'; did you mean 'linuxcnc-comp'"),
        (PLATE, SPHERES, "isg-csv", 'expected "xyz" for spheres'),
        (BALLS, BORES, "isg-csv", 'expected "xy" for bores'),
        (PLATE, replace(BORES, clearance_z_mm=-150.0), "isg-csv", "is below the start of a contact"),
        (PLATE, replace(BORES, clearance_z_mm=20.0), "isg-csv", "the probe would go there"),
        (replace(PLATE, pitch_mm=(120.0, 60.0, 0.0)), BORES, "isg-csv", "outside the travel"),
    ],
)
def test_programs_that_would_be_wrong_are_not_written(small_machine, probe, probing, controller, message):
    with pytest.raises(InputError, match=re.escape(message)):
        probe_program(small_machine, probe, probing, controller)


def test_the_command_writes_the_program_and_reads_its_log(tmp_path, small_machine, errors, call):
    plate = tmp_path / "plate.toml"
    keys = 'columns = 5\nrows = 4\npitch_mm = [55.0, 60.0, 0.0]\ncomponents = "xy"\nnoise_um = 0.3\n'
    plate.write_text(f'{keys}[probing]\nfeature = "bore"\ndiameter_mm = 20.0\nball_mm = 6.0\novertravel_mm = 3.0\n')
    poses = ["--pose", "-50,100,-100", "--pose", "-50,100,-100,90"]
    command = ["plan", small_machine.source, "--artefact", plate, *poses]
    code, _, _ = call(*command, "--program", "siemens-cec", "--out", tmp_path / "o")
    assert code == 0
    program = (tmp_path / "o" / "probe-program.nc").read_text()
    assert program == probe_program(small_machine, PLATE, read_probing(plate), "siemens-cec")
    log = tmp_path / "volcomp-probe.log"
    log.write_text(log_of(program, "siemens-cec", small_machine, errors, PLATE, BORES))
    code, out, _ = call("import", log, "--machine", small_machine.source, "--out", tmp_path / "i")
    assert code == 0
    assert "features: 20" in out
    code, out, _ = call(
        "identify", small_machine.source, tmp_path / "i" / "volcomp-probe.artefact.csv", "--out", tmp_path / "f"
    )
    assert code == 0
    assert "EC0Y" in out
    plate.write_text(keys)
    code, _, err = call(*command, "--program", "siemens-cec", "--out", tmp_path / "q")
    assert code == 2
    assert "has no [probing] section" in err
    assert not (tmp_path / "q").exists()


@pytest.mark.parametrize("name", DIALECTS)
def test_the_name_of_a_machine_is_a_comment_whatever_it_contains(small_machine, name):
    """A machine file may come from anybody; in LinuxCNC also (LOG, ...) and #<...> act."""
    evil = replace(small_machine, name='a) G0 Z-99 (LOG, #1 % "<<x; M30 [1/0]')
    program = probe_program(evil, PLATE, BORES, name)
    plain = probe_program(replace(small_machine, name="a  G0 Z-99  LOG,  1     x  M30  1/0 "), PLATE, BORES, name)
    assert program == plain
