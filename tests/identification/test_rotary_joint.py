"""Rotary and linear axes in one adjustment; bars, positions and lengths at turned axes: hidden truth, files, refusals."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgen.data.axis_runs import AxisRuns
from compgen.data.deviations import Deviations
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine, RotaryAxis
from compgen.data.names import ERROR_NAMES, error_named
from compgen.data.pose_readings import (
    PosedDeviations,
    PosedLengths,
    format_bars,
    read_bars,
    read_posed_lengths,
    rotary_kind,
)
from compgen.data.rotary import JOINTS, TIP, Poses, RotaryErrors, position_names, read_machine_errors, unit_of
from compgen.errors import CompgenWarning, InputError
from compgen.identification.any_measurement import identify_measurement
from compgen.identification.options import IdentifyOptions
from compgen.identification.rotary_covariance import joint_beside, pose_uncertainty
from compgen.identification.spheres import identify_at_poses
from compgen.identification.with_rotary import RotaryFiles, identify_rotary
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.rotary_chain import linear_columns, pose_error, tip_pose
from compgen.simulation.bars import RotaryBallbar
from compgen.simulation.spheres import SphereProbe

KINDS = {"table-table": "WCAYFXZT", "head-table": "WCYFXZBT", "head-head": "WXYFZCBT"}


def machine_of(chain):
    axes = tuple(Axis((-500.0, 500.0), np.linspace(-500.0, 500.0, 5)) for _ in range(3))
    rotary = {}
    for letter in Chain(chain).rotary:
        table = chain.index(letter) < chain.index("F")
        place = (0.0, 0.0, -50.0 if letter != "C" else 0.0) if table else (0.0, 0.0, 150.0)
        ends = {"modulo_deg": 360.0} if letter == "C" else {"range_deg": (-90.0, 90.0)}
        rotary[letter] = RotaryAxis(tuple(np.eye(3)["ABC".index(letter)]), place, np.linspace(-90, 90, 5), **ends)
    return Machine("five", Chain(chain), axes, rotary=rotary)


def drawn(machine, rng):
    """A machine of its class: curves linear between nodes, straightness zero at both ends, others at zero."""
    curves, at = {}, machine.axes[0].nodes_mm
    for name in ERROR_NAMES[:18]:
        error = error_named(name)
        value = machine.prior.size(name) * rng.normal(size=5)
        value += machine.prior.scale(name) * rng.normal() * at
        value -= np.interp(at, at[[0, -1]], value[[0, -1]]) if error.is_straightness else value[2]
        curves[name] = Curve(at, value, np.zeros(5))
    squareness = {name: (machine.prior.size(name) * rng.normal(), 0.0) for name in ERROR_NAMES[18:]}
    rotary = {
        name: ((0.1 if unit_of(name) == "um" else 3e-4) * rng.normal(), 0.0)
        for letter in machine.rotary
        for name in position_names(letter)
    }
    return ErrorTable(curves, squareness), RotaryErrors({}, rotary)


def positions(machine, errors, rng, noise_mm=1e-3):
    """The whole volume measured, rotary axes at zero, with noise."""
    at = np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), axis=-1).reshape(-1, 3)
    away = pose_error(machine, errors, RotaryErrors(), at, {letter: np.zeros(len(at)) for letter in machine.rotary})[0]
    noise = noise_mm * rng.normal(size=at.shape)
    return Deviations(at, away + noise, np.full(at.shape, noise_mm))


def test_six_rows_of_c_are_those_of_three_axes_where_nothing_turns():
    machine = machine_of(KINDS["table-table"])
    at = np.array([[120.0, -80.0, 60.0], [-300.0, 10.0, 5.0]])
    tool = np.array([[3.0, -2.0, -90.0]] * 2)
    six = linear_columns(machine, at, {"A": np.zeros(2), "C": np.zeros(2)}, tool)
    assert six[:, :3] == pytest.approx(c_matrix(machine, at, tool), abs=1e-6)
    assert six[:, 3:, [3, 10, 17]] == pytest.approx(np.stack([np.eye(3)] * 2), abs=1e-9)  # EAX, EBY, ECZ turn the tool
    quarter = linear_columns(machine, at, {"A": np.zeros(2), "C": np.full(2, 90.0)}, tool)
    # the table turned by -90 degrees about z: what was along x of the machine is along -y of the workpiece... or y
    assert np.abs(quarter[:, 1, 0]) == pytest.approx(1.0) and quarter[:, 0, 0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_with_the_volume_measured_spheres_determine_rotary_axes_within_their_uncertainty(kind):
    """Everything within what is stated: values of rotary errors, and the tip at poses that nobody measured."""
    machine, rng, off, tips = machine_of(KINDS[kind]), np.random.default_rng(3), [], []
    for _ in range(2):
        errors, truth = drawn(machine, rng)
        linear = identify_measurement(machine, positions(machine, errors, rng))
        probe = SphereProbe(((60.0, 40.0, 20.0),), (120.0, 220.0), 30, 2.0)
        spheres = probe.measure(machine, errors, truth, rng)
        found = identify_rotary(machine, RotaryFiles(None, (spheres,), ()), IdentifyOptions(), linear)
        placed, after = found.placed, found.linear
        true = np.array([truth.constants.get(name, (0.0, 0.0))[0] for name in placed.names])
        off += ((placed.values - true) / placed.u).tolist()
        assert placed.u_um == pytest.approx(2.0, rel=0.25)  # nothing is left that the linear axes explain
        for name in after.errors.squareness:  # the poses add to what is known of the linear axes, and never take away
            assert after.errors.squareness[name][1] <= linear.errors.squareness[name][1] * 1.0001
        count = 40
        angle = {letter: rng.uniform(*axis.ends_deg, count) for letter, axis in machine.rotary.items()}
        poses = Poses(rng.uniform(-100, 100, (count, 3)), angle, np.tile([0.0, 0.0, -150.0], (count, 1)))
        tips.append(_tip_ratio(machine, found, errors, truth, poses))
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert 0.3 < np.mean(tips) < 1.6


def _tip_ratio(machine, found, errors, truth, poses, folder=None):
    """Rms of (tip as identified minus true tip) over its stated uncertainty, the table not moved as a whole."""
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        for file, content in found.files().items():
            path = Path(name) / file
            path.write_bytes(content) if isinstance(content, bytes) else path.write_text(content)
        table, rotary = read_machine_errors(Path(name) / "identified.errors.csv")
        joint = joint_beside(Path(name) / "identified.errors.csv", table, rotary)
        assert joint is not None
        u = pose_uncertainty(machine, table, rotary, poses, joint)[0]
    where = machine, table, rotary, poses.position_mm, poses.angle_deg, poses.tool_mm
    away = tip_pose(*where)[0] - tip_pose(machine, errors, truth, poses.position_mm, poses.angle_deg, poses.tool_mm)[0]
    return float(np.sqrt(np.mean((away / u) ** 2)))


def test_what_nobody_measured_of_the_linear_axes_is_in_the_uncertainty_of_the_rotary_ones():
    """Runs of X alone: the curves of Y and Z are as large as the class lets expect, and widen what spheres say."""
    machine, rng = machine_of(KINDS["table-table"]), np.random.default_rng(5)
    errors, truth = drawn(machine, rng)
    at = np.tile(np.linspace(-400.0, 400.0, 9), 4)
    value = errors.curves["EXX"].at(at) + 2e-4 * rng.normal(size=36)
    runs = AxisRuns(np.zeros(36, dtype=int), at, np.repeat([1, -1, 1, -1], 9), np.repeat([1, 1, 2, 2], 9), value)
    spheres = SphereProbe(((60.0, 40.0, 20.0),), (120.0,), 30, 2.0).measure(machine, errors, truth, rng)
    alone = identify_at_poses(machine, [spheres], separate=False)
    with pytest.warns(CompgenWarning, match="along the line"):
        linear = identify_measurement(machine, runs)
    both = identify_rotary(machine, RotaryFiles(None, (spheres,), ()), IdentifyOptions(), linear).placed
    k = both.names.index("EX0C")
    assert both.u[k] > 1.5 * alone.u[k]
    true = np.array([truth.constants[name][0] for name in both.names])
    assert np.abs((both.values - true) / both.u).max() < 3.0


@pytest.mark.parametrize("kind", KINDS)
def test_bars_at_poses_determine_axis_lines_within_their_uncertainty(kind):
    machine, rng = machine_of(KINDS[kind]), np.random.default_rng(7)
    bar = RotaryBallbar(balls_mm=((60.0, 20.0, 10.0), (-40.0, 50.0, 10.0)), poses=20, tilt_urad=300.0)
    truth = bar.truth(machine, rng)
    bars = bar.measure(machine, ErrorTable(), truth, rng)
    found = identify_at_poses(machine, [bars], separate=False)
    true = np.array([truth.constants.get(name, (0.0, 0.0))[0] for name in found.names])
    assert np.abs((found.values - true) / found.u).max() < 3.0
    assert found.rank >= 5 and found.u_um == pytest.approx(0.5, rel=0.3)
    assert (found.values - true) @ np.linalg.solve(found.covariance, found.values - true) < 40.0
    # what a bar cannot tell, a sphere adds: more is determined together than by either
    sphere = SphereProbe(((60.0, 40.0, 20.0),), (120.0,), 20, 2.0).measure(machine, ErrorTable(), truth, rng)
    both = identify_at_poses(machine, [sphere, bars], separate=False)
    assert both.rank >= found.rank and both.kinds == ("spheres", "bars")
    assert np.abs((both.values - true) / both.u).max() < 3.0
    assert (both.u <= found.u * 1.05).all()


def test_a_sphere_is_named_where_a_bar_alone_cannot_tell_apart():
    machine, rng = machine_of(KINDS["table-table"]), np.random.default_rng(8)
    bar = RotaryBallbar(balls_mm=((60.0, 20.0, 10.0),), poses=15)
    bars = bar.measure(machine, ErrorTable(), bar.truth(machine, rng), rng)
    found = identify_at_poses(machine, [bars])
    assert any("sphere under the probe" in cure for _, cure in found.inseparable)
    assert any("length of the bar was not calibrated" in note for note in found.notes)


def test_a_bar_whose_length_is_known_says_more(tmp_path):
    machine, rng = machine_of(KINDS["table-table"]), np.random.default_rng(9)
    bar = RotaryBallbar(balls_mm=((60.0, 20.0, 10.0),), directions=("X", "Y"), poses=12, length_um=0.0)
    bars = bar.measure(machine, ErrorTable(), bar.truth(machine, rng), rng)
    file = tmp_path / "b.bar.csv"
    file.write_text(format_bars(replace(bars, u_nominal_mm=5e-4)))
    assert rotary_kind(file) == "bar"
    known = read_bars(machine, [file])
    assert known.u_nominal_mm == pytest.approx(5e-4) and known.deviation_mm == pytest.approx(
        bars.deviation_mm, abs=1e-8
    )
    free, fixed = (identify_at_poses(machine, [item], separate=False) for item in (bars, known))
    assert (fixed.u <= free.u * 1.02).all() and not any("not calibrated" in note for note in fixed.notes)


@pytest.mark.parametrize("kind", ["table-table", "head-head"])
def test_positions_and_lengths_with_turned_axes(kind):
    """Truth by the exact chain; frames, stations and their constants unknown."""
    machine, rng = machine_of(KINDS[kind]), np.random.default_rng(10)
    errors, truth = drawn(machine, rng)
    count = 90
    at = rng.uniform(-200.0, 200.0, (count, 3))
    angle = {letter: rng.uniform(*axis.ends_deg, count) for letter, axis in machine.rotary.items()}
    tool = np.tile([0.0, 0.0, -100.0], (count, 1)) + np.outer(np.arange(count) % 2, [0.0, 0.0, -80.0])
    tip = tip_pose(machine, errors, truth, at, angle, tool)[0]
    nominal = tip_pose(machine, ErrorTable(), RotaryErrors(), at, angle, tool)[0]
    setup, u = np.ones(count, dtype=int), np.full(count, 1e-3)
    away = tip - nominal + np.array([0.03, -0.02, 0.01]) + 1e-3 * rng.normal(size=tip.shape)
    away[::3, 2] = np.nan
    deviations = PosedDeviations(at, JOINTS, angle, tool, setup, u, away)
    stations = {"S1": (500.0, 100.0, -100.0), "S2": (-300.0, 600.0, 50.0), "S3": (100.0, -500.0, 400.0)}
    rows = np.tile(np.arange(count), 3)
    length = np.concatenate(
        [np.linalg.norm(tip - np.array(place), axis=1) - 321.0 - k for k, place in enumerate(stations.values())]
    )
    lengths = PosedLengths(
        nominal[rows], TIP, {letter: values[rows] for letter, values in angle.items()}, tool[rows],
        setup[np.zeros(3 * count, dtype=int)], np.full(3 * count, 5e-4),
        [name for name in stations for _ in range(count)], length + 5e-4 * rng.normal(size=3 * count),
    )  # fmt: skip
    true_of = truth.constants
    for read in ((deviations,), (lengths,)):
        found = identify_rotary(machine, RotaryFiles(None, read, ()), IdentifyOptions(), None)
        placed = found.placed
        true = np.array([true_of.get(name, (0.0, 0.0))[0] for name in placed.names])
        assert np.abs((placed.values - true) / placed.u).max() < 3.5, read
        assert sum(placed.determined) >= 4 and placed.rank >= 7
        assert found.linear is not None and "identified.covariance.npz" in found.files()
        for name in placed.names:
            if not placed.determined[placed.names.index(name)]:
                assert placed.u[placed.names.index(name)] > 0.3 * placed.sizes[placed.names.index(name)]


MACHINE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 5 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 5 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 5 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
[controllers.linuxcnc-trt]
conventional_directions = false
"""
SCENARIO = """name = "trunnion"
seed = 5
[errors]
file = "zero.errors.csv"
[instrument]
type = "sphere-probe"
spheres_mm = [[60.0, 20.0, 10.0]]
probe_lengths_mm = [100.0]
poses = 20
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("five.toml").write_text(MACHINE)
    Path("s.toml").write_text(SCENARIO)
    Path("zero.errors.csv").write_text("error,position_mm,value\nEC0Y,,0.0\n")
    rows = [
        f"X,{x},{way},{run},{x / 40 + 0.1 * run}" for run in (1, 2) for way in (1, -1) for x in range(-400, 401, 100)
    ]
    Path("x.axis.csv").write_text("\n".join(["axis,position_mm,direction,run,deviation_um", *rows]) + "\n")
    return tmp_path


def test_one_call_takes_files_of_linear_and_rotary_axes(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    words = ["identify", "five.toml", "sim/trunnion.sphere.csv", "x.axis.csv", "--squareness", "EC0Y=25"]
    code, out, err = call(*words, "--out", "found", "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert {"EX0C", "EY0A"} <= set(summary["errors"]) and "EXX" in summary["identified"] and summary["not_measured"]
    assert summary["prior"]["class"] == "general"
    table, rotary = read_machine_errors("found/identified.errors.csv")
    assert "EXX" in table.curves and "EX0C" in rotary.constants
    # commands that know no rotary axes take the linear ones
    assert call("fit", "five.toml", "found/linear.errors.csv", "--out", "fitted")[0] == 0
    Path("p.points.csv").write_text("x_mm,y_mm,z_mm,a_deg,c_deg\n10,20,130,-45,90\n")
    words = ["predict", "five.toml", "found/identified.errors.csv", "--points", "p.points.csv", "--out", "p.csv"]
    code, out, err = call(*words, "--uncertainty")
    assert code == 0 and "with the sizes of the prior" in " ".join(out.split()), err


def test_one_run_writes_tables_of_linear_axes_and_parameters_of_rotary_ones(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    words = ["run", "five.toml", "sim/trunnion.sphere.csv", "x.axis.csv", "--no-report"]
    both = ["--controller", "linuxcnc-comp", "--controller", "linuxcnc-trt"]
    code, out, err = call(*words, *both, "--out", "tables")
    assert Path("tables/linuxcnc-trt/trt.hal").is_file() or Path("tables/linuxcnc-trt/REJECTED-trt.hal").is_file(), err
    assert any(Path("tables").glob("*.comp")), sorted(Path("tables").iterdir())
    code, out, err = call(*words, *both, "--out", "x", "--json")
    assert code == 2 and "one control at a time" in " ".join(err.split())
    code, out, err = call("run", "five.toml", "sim/trunnion.sphere.csv", "--controller", "linuxcnc-comp", "--out", "x")
    assert code == 2 and "says nothing of the linear axes" in " ".join(err.split()) and not Path("x").exists()


BAR = """# coordinates = joints
x_mm,y_mm,z_mm,a_deg,c_deg,ball_x_mm,ball_y_mm,ball_z_mm,nominal_mm,deviation_um,probe_length_mm
100,0,100,0,0,0,0,0,100,1.5,100
0,100,100,0,90,0,0,0,100,2.5,100
-100,0,100,0,180,0,0,0,100,-1.5,100
0,-100,100,0,270,0,0,0,100,-0.5,100
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("# coordinates = joints\n", "", "is not stated; write '# coordinates = joints'"),
        ("0,100,100,0,90", "0,150,100,0,90", "puts the balls 150.000 mm apart, and the bar is 100 mm long"),
        ("100,1.5,100", "-100,1.5,100", "is no length of a bar"),
        ("0,100,100,0,90", "0,100,100,50,90", "50 degrees is outside the travel -110 ... 30 of A"),
        ("# coordinates", "# u_nominal_um = two\n# coordinates", "is no standard uncertainty of the bar's length"),
        ("\n0,-100,100,0,270,0,0,0,100,-0.5,100", "", "has 3 readings; at least 4 are needed"),
    ],
)
def test_a_bar_file_that_cannot_be_right_is_refused(folder, call, old, new, said):
    Path("b.bar.csv").write_text(BAR)
    assert call("identify", "five.toml", "b.bar.csv", "--out", "ok")[0] == 0
    Path("b.bar.csv").write_text(BAR.replace(old, new, 1))
    code, out, err = call("identify", "five.toml", "b.bar.csv", "--out", "found")
    assert code == 2 and said in " ".join(err.split()), err
    assert not Path("found").exists()


def test_angles_make_positions_and_lengths_readings_at_poses(folder):
    text = "# coordinates = joints\nx_mm,y_mm,z_mm,c_deg,dx_um\n0,0,0,{},1\n"
    for name, angle, kind in (
        ("a.deviations.csv", 10, "deviations"),
        ("b.deviations.csv", 0, None),
        ("r.csv", 10, "sphere"),
    ):
        Path(name).write_text(text.format(angle))
        assert rotary_kind(Path(name)) == kind
    Path("l.lengths.csv").write_text(
        "# coordinates = joints\nstation,point,x_mm,y_mm,z_mm,c_deg,length_mm\nS,1,0,0,0,10,5\n"
    )
    assert rotary_kind(Path("l.lengths.csv")) == "lengths"
    from compgen.data.machine import read_machine

    with pytest.raises(InputError, match="has 1 lengths"):
        identify_at_poses(read_machine("five.toml"), [read_posed_lengths(read_machine("five.toml"), ["l.lengths.csv"])])
