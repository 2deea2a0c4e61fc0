"""Sphere programs: planned, followed word by word on a machine with errors, and their logs lead back to these errors."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from compgen.data.error_table import ErrorTable
from compgen.data.machine import read_machine
from compgen.data.rotary import RotaryErrors, position_names, read_spheres, si_per_unit
from compgen.errors import InputError
from compgen.foreign.detect import import_file
from compgen.identification.spheres import identify_spheres
from compgen.kinematics.rotary_chain import tip_pose
from compgen.planning.sphere_poses import Reach, plan_spheres
from compgen.tables.probe_program import Probing
from compgen.tables.sphere_program import height_of, reach_of, sphere_program

PROBING = Probing("sphere", 20.0, 6.0, overtravel_mm=2.0)
AXES = "".join(
    f"[axes.{letter}]\nrange_mm = [-400.0, 400.0]\nnodes = 5\n" for letter in "XYZ"
)  # fmt: skip
ENDLESS = "modulo_deg = 360.0"
MACHINES = {
    "trunnion": (
        "WCAYFXZT",
        {"A": ("[0.0, 0.0, -50.0]", "range_deg = [-100.0, 60.0]"), "C": ("[0.0, 0.0, 0.0]", ENDLESS)},
    ),
    "fork": ("WXYFZCBT", {"C": ("[0.0, 0.0, 0.0]", ENDLESS), "B": ("[0.0, 0.0, 80.0]", "range_deg = [-95.0, 95.0]")}),
}
POSITION = r"(-?\d+\.\d+)"


def machine_of(folder: Path, kind: str, more: str = ""):
    chain, rotary = MACHINES[kind]
    own = "".join(f"[axes.{a}]\npoint_mm = {point}\n{ends}\nnodes = 9\n" for a, (point, ends) in rotary.items())
    path = folder / f"{kind}.toml"
    path.write_text(f'name = "{kind}"\nchain = "{chain}"\n{AXES}{own}{more}')
    return read_machine(path)


def errors_of(machine, seed):
    rng = np.random.default_rng(seed)
    names = [name for letter in machine.rotary for name in position_names(letter)]
    size = {"um": 60.0, "urad": 150.0}
    values = {name: size["um" if name[1] in "XYZ" else "urad"] * rng.standard_normal() for name in names}
    return RotaryErrors({}, {name: (value * si_per_unit(name), 0.0) for name, value in values.items()})


def followed(program, machine, rotary, place_mm, sense, rng, noise_mm=0.5e-3):
    """The log that the program leaves: each motion is followed, a probing motion ends where the true tip touches the sphere."""
    log, at, angle, tool, value = [], np.array([0.0, 0.0, 399.0]), {}, None, None
    state = {}
    lines = program.splitlines()
    tools = iter(
        np.array([float(word) for word in words])
        for words in re.findall(r"P\d+ S\d+ T (\S+) (\S+) (\S+) [ABC] .* N 1\b", program)
    )

    def away(joint):
        return np.linalg.norm(state["zero"] + state["slope"] @ joint - place_mm) - 13.0

    def frame():
        """Tips are affine in X, Y, Z at given angles, exactly: the linear axes have no errors here."""
        own = {letter: np.full(4, degrees) for letter, degrees in angle.items()}
        joints = np.vstack([np.zeros(3), np.eye(3)])
        tips = tip_pose(machine, ErrorTable(), rotary, joints, own, np.tile(tool, (4, 1)))[0]
        state.update(zero=tips[0], slope=(tips[1:] - tips[0]).T)

    for line in lines:
        turned = re.findall(r"([ABC])=?(?:DC\()?(-?\d+\.\d+)", line) if line.startswith("G0 ") else []
        if turned:
            assert at[2] == pytest.approx(399.0)  # the axes turn at the upper end of Z only
            angle = {letter: sense[letter] * float(degrees) for letter, degrees in turned}
            tool = next(tools)
            frame()
        text = re.search(r'^\(LOG,([^#)]*)|^WRITE\(_VC_ERROR,"VOLCOMP_SPHERE","([^"]*)"', line)
        if text:
            own = (text[1] or text[2]).rstrip()
            if re.match(r"P\d", own):
                unit = 1e5 if text[2] else 1.0
                numbers = [f"{round(x * unit)}" if text[2] else f"{x:.6f}" for x in value]
                own = f"{own} {' '.join(numbers)}"
            log.append(own)
        words = re.findall(rf"([XYZ])\[?{POSITION}", line)
        if not words or not re.match(r"G1 |G38\.2 |MEAS=1 ", line):
            continue
        target = at.copy()
        for letter, number in words:
            target["XYZ".index(letter)] = float(number)
        assert (target >= machine.lower_mm).all()
        assert (target <= machine.upper_mm).all()
        if not line.startswith("G1 "):
            low, high = 0.0, 1.0
            assert away(at) > 0.0 > away(target)
            for _ in range(50):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if away(at + middle * (target - at)) > 0.0 else (low, middle)
            target = at + high * (target - at)
            value = target + rng.normal(0.0, noise_mm, 3)
        elif angle:  # between contacts the ball stays clear of the sphere
            steps = np.linspace(0.0, 1.0, 9)[:, None]
            start_free = away(at) > 1.0
            assert not start_free or min(away(at + share * (target - at)) for share in steps) > 1.0
        at = target
    return "\n".join(log) + "\n"


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A plan for each kind of machine."""
    folder = tmp_path_factory.mktemp("machines")
    found = {}
    for kind in MACHINES:
        more = "[controllers.linuxcnc-trt]\nconventional_directions = false\n" if kind == "trunnion" else ""
        machine = machine_of(folder, kind, more)
        plan = plan_spheres(
            machine, [(70.0, 40.0, 60.0)], [80.0, 130.0], count=26, u_um=0.5, reach=reach_of(PROBING),
            height_mm=height_of(machine, PROBING),
        )  # fmt: skip
        found[kind] = plan
    return found


@pytest.mark.parametrize(
    ("kind", "controller", "reversed_axes"),
    [("trunnion", "linuxcnc-trt", "AC"), ("trunnion", "siemens-toolcarrier", ""), ("fork", "siemens-toolcarrier", "")],
)
def test_the_log_of_a_program_gives_the_errors_of_the_machine_back(tmp_path, planned, kind, controller, reversed_axes):
    plan = planned[kind]
    machine, rotary = plan.machine, errors_of(plan.machine, 7)
    place = np.array([70.3, 39.8, 60.1])
    sense = {letter: -1.0 if letter in reversed_axes else 1.0 for letter in machine.rotary}
    program = sphere_program(plan, PROBING, controller)
    log = tmp_path / "volcomp-sphere.log"
    log.write_text(followed(program, machine, rotary, place, sense, np.random.default_rng(3)))
    item = import_file(log)
    assert item.kind == "sphere"
    path = tmp_path / item.file_name
    path.write_text(item.files()[item.file_name])
    found = identify_spheres(machine, read_spheres(machine, [path]))
    assert found.rank == plan.rank
    assert item.data.diameter_mm == pytest.approx(np.full(len(item.data), 20.0), abs=0.01)
    known = [
        (name, value, u)
        for name, value, u, told in zip(found.names, found.values, found.u, found.determined, strict=True)
        if told and name not in ("TX", "TY", "TZ")
    ]
    assert len(known) >= 5
    for name, value, u in known:
        assert abs(value - rotary.constants[name][0]) < 3.0 * u, name
    for name, u, told, before in zip(plan.names, plan.u, plan.determined, found.u, strict=True):
        assert not told or before < 2.0 * u, name


def test_what_poses_determine_is_the_known_number_of_combinations(planned):
    """Calculated elsewhere for one sphere and two lengths: 8 of a table-table machine, 9 of one with a head."""
    assert {kind: plan.rank for kind, plan in planned.items()} == {"trunnion": 8, "fork": 9}
    one = plan_spheres(planned["fork"].machine, [(70.0, 40.0, 60.0)], [80.0], count=20, u_um=0.5)
    assert one.rank == 8
    assert ("EB0B with TX", "the same poses with a probe 100 mm longer") in one.inseparable


def test_chosen_poses_say_more_than_poses_drawn_at_random(planned):
    """The greedy choice against ten draws from the same candidates."""
    from compgen.planning import sphere_poses

    plan = planned["fork"]
    machine = plan.machine
    all_of = sphere_poses._reachable(machine, [(70.0, 40.0, 60.0)], [80.0, 130.0], 0.5, Reach(), None)
    rng, worse = np.random.default_rng(0), 0
    for _ in range(5):
        some = all_of.part(rng.choice(len(all_of), len(plan.spheres), replace=False))
        problem = sphere_poses._problem(machine, some)
        u = sphere_poses._uncertainties(problem, problem.start(), np.full(3 * len(some), 0.5e-3))
        worse += np.sum((u / plan.sizes) ** 2) > np.sum((plan.u / plan.sizes) ** 2)
    assert worse == 5


@pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed")
def test_linuxcnc_itself_runs_the_program(tmp_path, planned):
    """Its interpreter finds every contact at the target; a work offset must not matter; A and C turn in the control's sense."""
    plan = planned["trunnion"]
    program = sphere_program(plan, PROBING, "linuxcnc-trt")
    (tmp_path / "p.ngc").write_text(program.replace("G90 G21", "G10 L2 P1 X-21.5 Y33.25 Z12\nG90 G21", 1))
    done = subprocess.run(
        ["rs274", "-g", "p.ngc"], cwd=tmp_path, env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    targets, logged = plan.motions.target.reshape(-1, 3), []
    for name, text in re.findall(r"(LOG)\((.*)\)", done.stdout):
        if name == "LOG" and text.startswith('"P'):
            logged.append([float(word) for word in text.strip('"').split()[-3:]])
    assert np.array(logged) == pytest.approx(targets, abs=1e-3)
    turns = re.findall(r"STRAIGHT_TRAVERSE\((.*)\)", done.stdout)
    last = [float(word) for word in turns[-1].split(",")]
    assert last[3] == pytest.approx(-plan.spheres.angle_deg["A"][-1], abs=1e-3)
    assert np.mod(last[5] + plan.spheres.angle_deg["C"][-1], 360.0) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: re.sub(r"(VOLCOMP \w+ LOG 1)", r"\1 copy", text), "was it edited"),
        (lambda text: text.replace("END", ""), "has no END"),
        (lambda text: text + text, "contains 2 runs"),
        (lambda text: re.sub(r"P1 .* N 3 .*\n", "", text), "pose 1 lacks the contacts 3"),
        (lambda text: re.sub(r"(P1 .* N 3 )\S+", r"\1 12mm", text), "is not a contact of the program"),
        (lambda text: re.sub(r"(P1 .* N 3 )\S+", r"\g<1>300.0", text), "was the probe elsewhere"),
        (lambda text: re.sub(r"(P1 .* N 3 .*\n)", r"\1\1", text), "is there twice"),
        (lambda text: re.sub(r"P26 .*\n", "", text), "contains 25 poses"),
        (lambda text: text.replace("SPHERE 20.0", "SPHERE 25.0"), "are on a sphere of 26"),
    ],
)
def test_damaged_logs_are_refused(tmp_path, planned, change, message):
    plan = planned["trunnion"]
    program = sphere_program(plan, PROBING, "linuxcnc-trt")
    sense = dict.fromkeys("AC", -1.0)
    rng = np.random.default_rng(1)
    text = followed(program, plan.machine, RotaryErrors(), np.array([70.0, 40.0, 60.0]), sense, rng)
    log = tmp_path / "p.log"
    log.write_text(change(text))
    with pytest.raises(InputError, match=message):
        import_file(log)


def test_the_command_plans_and_refuses(tmp_path, planned, call):
    machine = planned["trunnion"].machine.source
    probing = tmp_path / "probing.toml"
    probing.write_text('[probing]\nfeature = "sphere"\ndiameter_mm = 20.0\nball_mm = 6.0\n')
    command = ["plan", machine, "--sphere", "70,40,60", "--count", "12", "--out", tmp_path / "o"]
    code, out, _ = call(*command, "--probing", probing, "--program", "linuxcnc-trt")
    assert code == 0
    assert "8 combinations" in out
    assert {path.name for path in (tmp_path / "o").iterdir()} == {
        "plan.errors.csv", "plan.json", "plan.points.csv", "sphere-program.nc",
    }  # fmt: skip
    for options, message in (
        (["--program", "linuxcnc-trt"], "give --probing FILE"),
        (["--probing", probing, "--program", "fanuc-5axis"], "no public document of fanuc-5axis"),
        (["--probe-length", "3000"], "3000 is not possible"),
        (["--sphere", "1,2"], "is not a place"),
        (["--sphere", "900,40,60"], "cannot be probed at any angle"),
    ):
        code, _, err = call(*command[:-1], tmp_path / "no", *options)
        assert (code, message in err) == (2, True), err
    assert not (tmp_path / "no").exists()
