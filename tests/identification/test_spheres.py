"""Position errors of rotary axes from sphere centres: hidden truth, what cannot be told apart, the files."""

import json
from pathlib import Path

import numpy as np
import pytest

from compgen.data.error_table import ErrorTable
from compgen.data.machine import Axis, Chain, Machine, RotaryAxis
from compgen.data.prior import PriorSettings
from compgen.data.rotary import RotaryErrors, format_spheres, position_names, read_machine_errors, read_spheres, unit_of
from compgen.errors import InputError
from compgen.identification.spheres import WITHOUT_EFFECT, identify_spheres, senses
from compgen.simulation.spheres import SphereProbe

KINDS = {"table-table": "WCAYFXZT", "head-table": "WCYFXZBT", "head-head": "WXYFZCBT"}


def machine_of(chain):
    axes = tuple(Axis((-600.0, 600.0), np.linspace(-600.0, 600.0, 5)) for _ in range(3))
    rotary = {}
    for letter in Chain(chain).rotary:
        table = chain.index(letter) < chain.index("F")
        place = (0.0, 0.0, -50.0 if letter != "C" else 0.0) if table else (0.0, 0.0, 200.0)
        ends = {"modulo_deg": 360.0} if letter == "C" else {"range_deg": (-110.0, 110.0)}
        rotary[letter] = RotaryAxis(tuple(np.eye(3)["ABC".index(letter)]), place, np.linspace(-110, 110, 5), **ends)
    return Machine("five", Chain(chain), axes, rotary=rotary)


def measured(machine, rng, lengths, *, poses=40, noise_um=2.0, truth=None, spheres=((60.0, 40.0, 20.0),)):
    probe = SphereProbe(spheres, lengths, poses, noise_um, offset_um=100.0, tilt_urad=300.0)
    truth = truth or probe.truth(machine, rng)
    return probe.measure(machine, ErrorTable(), truth, rng), truth


@pytest.mark.parametrize(
    ("kind", "lengths", "combinations", "apart"),
    [
        ("table-table", (120.0,), 8, []),
        ("table-table", (120.0, 220.0), 8, []),
        ("head-table", (120.0,), 8, [{"EB0B", "TX"}]),
        ("head-table", (120.0, 220.0), 9, []),
        ("head-head", (120.0,), 8, [{"EB0B", "TX"}]),
        ("head-head", (120.0, 220.0), 9, []),
    ],
)
def test_poses_of_one_sphere_determine_what_a_table_of_the_model_says(kind, lengths, combinations, apart):
    """8 of 10 with one probe, with a second length 9 where a head turns; a zero of B and a tool beside B look alike."""
    machine = machine_of(KINDS[kind])
    spheres, _ = measured(machine, np.random.default_rng(1), lengths)
    found = identify_spheres(machine, spheres)
    assert found.rank == combinations
    acting = [(set(words.split(" with ")), cure) for words, cure in found.inseparable if cure != WITHOUT_EFFECT]
    assert [names for names, _ in acting] == apart
    assert all(cure == "the same poses with a probe 100 mm longer" for _, cure in acting)


@pytest.mark.parametrize("kind", KINDS)
def test_the_stated_uncertainties_cover_the_truth(kind):
    machine, rng, off = machine_of(KINDS[kind]), np.random.default_rng(2), []
    for _ in range(5):
        spheres, truth = measured(machine, rng, (120.0, 220.0))
        found = identify_spheres(machine, spheres, separate=False)
        true = np.array([truth.constants.get(name, (0.0, 0.0))[0] for name in found.names])
        off.append((found.values - true) / found.u)
        # combinations, too: the joint covariance is one
        assert (found.values - true) @ np.linalg.solve(found.covariance, found.values - true) < 40.0
        assert found.residual_um["after_rms"] < 4.5 < found.residual_um["before_rms"]
    inside = np.mean(np.abs(off) < 2.0)
    assert inside > 0.9
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.2


def test_what_is_not_determined_is_not_claimed():
    machine = machine_of(KINDS["table-table"])
    truth = RotaryErrors(
        {}, {name: (0.0, 0.0) for letter in "CA" for name in position_names(letter)} | {"EA0C": (4e-4, 0.0)}
    )
    spheres, _ = measured(machine, np.random.default_rng(3), (120.0,), truth=truth, noise_um=1.0)
    found = identify_spheres(machine, spheres)
    known = dict(zip(found.names, found.determined, strict=True))
    assert not known["EA0C"] and not known["EA0A"] and not known["EC0C"] and known["EX0C"]
    k, j = found.names.index("EA0C"), found.names.index("EA0A")
    pair = found.values[k] + found.values[j]
    u = np.sqrt(found.covariance[[k, j]][:, [k, j]].sum())
    assert abs(pair - 4e-4) < 3.0 * u < 3e-5  # their sum is determined
    assert min(found.u[[k, j]]) > 1e-4


def test_a_machine_much_worse_than_its_class_is_said_and_found():
    machine = machine_of(KINDS["table-table"])
    truth = RotaryErrors({}, {"EX0C": (2.5, 0.0), "EY0A": (-1.0, 0.0), "EB0C": (4e-3, 0.0)})
    spheres, _ = measured(machine, np.random.default_rng(4), (120.0,), truth=truth)
    found = identify_spheres(machine, spheres, separate=False)
    assert any("times as far off as the class" in note for note in found.notes)
    for name in truth.constants:
        k = found.names.index(name)
        assert abs(found.values[k] - truth.constants[name][0]) < 3.5 * found.u[k]
        assert found.determined[k]


def test_noise_that_is_not_stated_comes_from_the_residuals():
    machine = machine_of(KINDS["head-head"])
    spheres, _ = measured(machine, np.random.default_rng(5), (120.0, 220.0), noise_um=5.0)
    from dataclasses import replace

    unknown = replace(spheres, u_mm=np.full(len(spheres), np.nan))
    found = identify_spheres(machine, unknown, separate=False)
    assert found.u_from_residuals and found.u_um == pytest.approx(5.0, rel=0.15)
    optimistic = replace(spheres, u_mm=np.full(len(spheres), 1e-3))
    assert identify_spheres(machine, optimistic, separate=False).u_um == pytest.approx(5.0, rel=0.15)


def test_without_a_prior_the_determined_errors_are_the_same():
    from dataclasses import replace

    machine = machine_of(KINDS["table-table"])
    spheres, _ = measured(machine, np.random.default_rng(6), (120.0,))
    usual = identify_spheres(machine, spheres, separate=False)
    free = identify_spheres(replace(machine, prior=PriorSettings("none")), spheres, separate=False)
    for k, known in enumerate(usual.determined):
        if known:
            assert abs(usual.values[k] - free.values[k]) < 0.3 * usual.u[k]
        else:
            assert free.u[k] > 50.0 * usual.u[k]


def test_a_diameter_that_changes_with_an_angle_is_named():
    from dataclasses import replace

    machine, rng = machine_of(KINDS["head-head"]), np.random.default_rng(7)
    spheres, _ = measured(machine, rng, (120.0,), poses=150)
    turned = spheres.angle_deg["C"]
    lobed = 30.13 + 0.15 * (np.abs(turned - 270.0) < 45.0) + 0.005 * rng.normal(size=150)
    notes = identify_spheres(machine, replace(spheres, diameter_mm=lobed), separate=False).notes
    assert any("changes with C" in note and "No position error does that" in note for note in notes)
    even = 30.13 + 0.002 * rng.normal(size=150)
    notes = identify_spheres(machine, replace(spheres, diameter_mm=even), separate=False).notes
    assert not any("diameter" in note for note in notes)


MACHINE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 7 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
"""
SCENARIO = """name = "trunnion"
seed = 5
[errors]
file = "zero.errors.csv"
[instrument]
type = "sphere-probe"
spheres_mm = [[60.0, 20.0, 10.0]]
probe_lengths_mm = [100.0]
poses = 40
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("five.toml").write_text(MACHINE)
    Path("s.toml").write_text(SCENARIO)
    Path("zero.errors.csv").write_text("error,position_mm,value\nEC0Y,,0.0\n")
    return tmp_path


def test_simulate_identify_predict(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    code, out, err = call("identify", "five.toml", "sim/trunnion.sphere.csv", "--out", "found", "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert summary["determined_combinations"] == 8 and len(summary["inseparable"]) == 2
    _, truth = read_machine_errors("sim/truth.errors.csv")
    _, found = read_machine_errors("found/identified.errors.csv")
    for name, entry in summary["errors"].items():
        unit = 1e-3 if unit_of(name) == "um" else 1e-6
        assert found.constants[name][0] == pytest.approx(entry["value"] * unit, abs=1e-9)
        if entry["determined"]:
            assert abs(truth.constants[name][0] / unit - entry["value"]) < 4.0 * entry["u"]
    Path("p.points.csv").write_text("x_mm,y_mm,z_mm,a_deg,c_deg\n10,20,130,-45,90\n0,0,200,0,0\n")
    code, out, err = call(
        "predict", "five.toml", "found/identified.errors.csv", "--points", "p.points.csv", "--out", "p.csv"
    )
    assert code == 0, err
    assert "ea_urad,eb_urad,ec_urad" in Path("p.csv").read_text()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("# coordinates = joints\n", "", "is not stated; write '# coordinates = joints'"),
        ("# coordinates = joints\n", "# coordinates = machine\n", "is 'machine'; write"),
        ("a_deg", "b_deg", "a_deg"),
    ],
)
def test_a_file_that_does_not_say_what_it_is_is_refused(folder, call, old, new, said):
    call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")
    text = Path("sim/trunnion.sphere.csv").read_text()
    Path("x.sphere.csv").write_text(text.replace(old, new, 1))
    code, out, err = call("identify", "five.toml", "x.sphere.csv", "--out", "found")
    assert code == 2 and said in " ".join(err.split())
    assert not Path("found").exists()


def test_an_angle_beyond_the_travel_a_machine_of_three_axes_and_other_commands_are_refused(folder, call):
    call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")
    lines = Path("sim/trunnion.sphere.csv").read_text().splitlines()
    cells = lines[-1].split(",")
    cells[3] = "-130.0"
    Path("x.sphere.csv").write_text("\n".join([*lines[:-1], ",".join(cells)]) + "\n")
    code, out, err = call("identify", "five.toml", "x.sphere.csv", "--out", "found")
    assert code == 2 and "-130 degrees is outside the travel -110 ... 30 of A" in err.replace("\n", " ")
    code, out, err = call("identify", "zha-gantry", "sim/trunnion.sphere.csv", "--out", "found")
    assert code == 2 and "the machine zha-gantry has none" in " ".join(err.split())
    code, out, err = call("run", "five.toml", "sim/trunnion.sphere.csv", "--controller", "isg-csv", "--out", "found")
    assert code == 2 and "says nothing of the linear axes" in " ".join(err.split())


def test_positions_of_the_tip_give_the_same_as_positions_of_the_axes(tmp_path):
    from dataclasses import replace

    from compgen.data.rotary import TIP
    from compgen.kinematics.rotary_chain import tip_pose

    machine = machine_of(KINDS["table-table"])
    spheres, _ = measured(machine, np.random.default_rng(8), (120.0,))
    tip = tip_pose(machine, ErrorTable(), RotaryErrors(), spheres.found_mm, spheres.angle_deg, spheres.tool_mm)[0]
    file = tmp_path / "t.sphere.csv"
    file.write_text(format_spheres(replace(spheres, found_mm=tip, coordinates=TIP)))
    one = identify_spheres(machine, spheres, separate=False)
    other = identify_spheres(machine, read_spheres(machine, [file]), separate=False)
    assert other.values == pytest.approx(one.values, rel=0, abs=2e-6)
    with pytest.raises(InputError, match="some files have coordinates = joints, others tip"):
        joints = tmp_path / "j.sphere.csv"
        joints.write_text(format_spheres(spheres))
        read_spheres(machine, [file, joints])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turned", [0, 1])
def test_two_poses_say_which_way_an_axis_turns(kind, turned):
    """The machine turns one axis the other way round: its poses are those of the file with the sign of that angle changed."""
    from dataclasses import replace

    machine = machine_of(KINDS[kind])
    letter = tuple(machine.rotary)[turned]
    other = next(name for name in machine.rotary if name != letter)
    spheres, _ = measured(machine, np.random.default_rng(9), (120.0,), poses=60)
    for axis in (letter, other):  # a pair of poses that differ by 60 degrees of one axis
        angle = spheres.angle_deg
        probe = SphereProbe(((60.0, 40.0, 20.0),), (120.0,), 4, 2.0)
        at = {name: np.array([10.0, 10.0]) for name in machine.rotary} | {axis: np.array([0.0, 60.0])}
        truth = RotaryErrors({}, {name: (0.1, 0.0) for name in position_names(axis)[:2]})
        place = np.tile([60.0, 40.0, 20.0], (2, 1))
        joint = probe._found(machine, ErrorTable(), truth, place, at, np.tile([0.0, 0.0, -120.0], (2, 1)))
        pair = replace(spheres.part(np.array([0, 1])), found_mm=joint, angle_deg=at)
        pair = replace(pair, tool_mm=np.tile([0.0, 0.0, -120.0], (2, 1)))
        found = {sense.letter: sense.verdict for sense in senses(machine, pair)}
        assert found[axis] == "agrees"
        assert angle  # the poses of the campaign are not changed
        swapped = replace(pair, angle_deg={**at, axis: -at[axis]})
        assert {sense.letter: sense.verdict for sense in senses(machine, swapped)}[axis] == "reversed"
    wrong = replace(spheres, angle_deg={**spheres.angle_deg, letter: -spheres.angle_deg[letter]})
    with pytest.raises(InputError, match=f"{letter} turns the other way round than the machine file says"):
        identify_spheres(machine, wrong)
    assert {sense.verdict for sense in senses(machine, spheres)} == {"agrees"}


def test_poses_that_do_not_tell_say_so(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    code, out, err = call("check", "five.toml", "--spheres", "sim/trunnion.sphere.csv")
    assert code == 0 and out.count("turns as the machine file says") == 2, err
    lines = Path("sim/trunnion.sphere.csv").read_text().splitlines()
    lines = [line for line in lines if not line.startswith("# rows")]
    start = next(k for k, line in enumerate(lines) if line.startswith("cx_mm"))
    cells = [line.split(",") for line in lines[start + 1 :]]
    Path("same.sphere.csv").write_text("\n".join([*lines[: start + 1], *([lines[start + 1]] * 2)]) + "\n")
    code, out, err = call("check", "five.toml", "--spheres", "same.sphere.csv", "--json")
    assert code == 0 and {item["verdict"] for item in json.loads(out)["senses"].values()} == {"not told"}, err
    column = lines[start].split(",").index("c_deg")
    for row in cells:
        row[column] = str(360.0 - float(row[column]))
    Path("x.sphere.csv").write_text("\n".join([*lines[: start + 1], *(",".join(row) for row in cells)]) + "\n")
    code, out, err = call("check", "five.toml", "--spheres", "x.sphere.csv")
    assert code == 1 and "C turns the other way round" in out
    code, out, err = call("check", "zha-gantry", "--spheres", "x.sphere.csv")
    assert code == 2 and "has none" in " ".join(err.split())
    Path("one.sphere.csv").write_text("\n".join(lines[: start + 2]) + "\n")
    code, out, err = call("check", "five.toml", "--spheres", "one.sphere.csv")
    assert code == 2 and "two poses of one sphere" in " ".join(err.split())


def test_predict_with_uncertainty_holds_the_joint_covariance(folder, call):
    """Monte Carlo over the covariance of identify.json; and the truth within it."""
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    assert call("identify", "five.toml", "sim/trunnion.sphere.csv", "--out", "found")[0] == 0
    Path("p.points.csv").write_text("x_mm,y_mm,z_mm,a_deg,c_deg\n10,20,130,-45,90\n0,0,200,0,200\n-100,50,10,20,300\n")
    words = ["predict", "five.toml", "found/identified.errors.csv", "--points", "p.points.csv", "--out", "p.csv"]
    code, out, err = call(*words, "--uncertainty")
    assert code == 0 and "largest standard uncertainty" in out, err
    rows = [line.split(",") for line in Path("p.csv").read_text().splitlines() if not line.startswith("#")]
    u = np.array([[float(row[rows[0].index(f"u_{axis}_um")]) for axis in "xyz"] for row in rows[1:]])
    from compgen.data.machine import read_machine
    from compgen.data.rotary import read_poses
    from compgen.kinematics.rotary_chain import pose_error

    machine, summary = read_machine("five.toml"), json.loads(Path("found/identify.json").read_text())
    poses = read_poses(machine, "p.points.csv")
    names, rng = list(summary["errors"]), np.random.default_rng(0)
    units = np.array([1e-3 if summary["errors"][name]["unit"] == "um" else 1e-6 for name in names])
    mean = np.array([summary["errors"][name]["value"] for name in names])
    drawn = [
        pose_error(machine, ErrorTable(), RotaryErrors({}, {n: (v, 0.0) for n, v in zip(names, row, strict=True)}),
                   poses.position_mm, poses.angle_deg)[0]
        for row in rng.multivariate_normal(mean, np.array(summary["covariance"]), 400) * units
    ]  # fmt: skip
    assert u == pytest.approx(1e3 * np.std(drawn, axis=0), rel=0.12)
    Path("bare.errors.csv").write_text("error,position_mm,value\nEX0C,,5\n")
    code, out, err = call(*words[:2], "bare.errors.csv", *words[3:], "--uncertainty")
    assert code == 2 and "states no uncertainty of EX0C" in " ".join(err.split())


@pytest.mark.parametrize("kind", ["table-table", "head-head"])
def test_error_motions_over_the_angle_are_found_where_position_errors_do_not_explain_the_poses(kind):
    machine, rng = machine_of(KINDS[kind]), np.random.default_rng(11)
    probe = SphereProbe(((60.0, 40.0, 20.0),), (120.0, 220.0), 60, 2.0, motion_um=25.0, motion_urad=60.0)
    truth = probe.truth(machine, rng)
    found = identify_spheres(machine, probe.measure(machine, ErrorTable(), truth, rng), separate=False)
    note = next(note for note in found.notes if "error motions over the angle" in note)
    assert found.errors.curves and set(found.errors.curves) | set(found.motions_not_told) == set(truth.curves)
    assert all(name in note for name in found.errors.curves)
    assert found.left_out_um[1] < 6.0 < found.left_out_um[0]  # noise of 2 um in three coordinates is 3.5 um
    for name, curve in found.errors.curves.items():
        axis = machine.rotary[name[-1]]
        true = truth.curves[name].at(curve.angle_deg, axis.modulo_deg) - truth.curves[name].at(
            np.array([axis.reference_deg]), axis.modulo_deg
        )
        known = curve.u > 0.0
        assert np.sqrt(np.mean(((curve.value - true)[known] / curve.u[known]) ** 2)) < 2.5, name


def test_noise_that_is_understated_is_not_taken_for_motions():
    from dataclasses import replace

    machine = machine_of(KINDS["head-table"])
    spheres, _ = measured(machine, np.random.default_rng(12), (120.0,), noise_um=6.0, poses=60)
    found = identify_spheres(machine, replace(spheres, u_mm=np.full(60, 1e-3)), separate=False)
    assert not found.errors.curves and not found.motions_not_told
    assert any("Something that no position error explains" in note for note in found.notes)


def test_other_commands_say_what_they_do_with_rotary_axes(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    code, out, err = call("diagnose", "five.toml", "sim/trunnion.sphere.csv", "--out", "d", "--json")
    data = json.loads(out)
    assert code == 0 and data["kind"] == "sphere" and len(data["not_told_apart"]) == 2, err
    assert "cannot be told apart" in Path("d/diagnosis.md").read_text()
    call("identify", "five.toml", "sim/trunnion.sphere.csv", "--out", "found")
    code, out, err = call("fit", "five.toml", "found/identified.errors.csv", "--out", "x")
    assert code == 2 and "is an error of a rotary axis; here" in " ".join(err.split())
    code, out, err = call("accuracy", "five.toml", "sim/trunnion.sphere.csv", "--out", "x")
    assert code == 2 and "volcomp identify gives its figures" in " ".join(err.split())
    words = ["run", "five.toml", "sim/trunnion.sphere.csv", "--controller", "linuxcnc-rotary-comp", "--out", "x"]
    code, out, err = call(*words)
    assert code == 2 and "contains no positioning" in " ".join(err.split()) and not Path("x").exists()


def test_report_states_errors_names_and_what_is_not_determined(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    assert call("identify", "five.toml", "sim/trunnion.sphere.csv", "--out", "found")[0] == 0
    code, out, err = call("report", "found", "--json")
    assert code == 0, err
    rotary, known = json.loads(out)["rotary"], json.loads(Path("found/identify.json").read_text())
    rows = {row["error"]: row for row in rotary["errors"]}
    assert {name: (row["largest"], row["u_k1"], row["unit"], row["determined"]) for name, row in rows.items()} == {
        name: (own["value"], own["u"], own["unit"], own["determined"]) for name, own in known["errors"].items()
    }
    assert rows["EY0A"]["axis_name"] == "YOA" and rows["EC0C"]["axis_name"] == ""
    # both axes carry the workpiece: their lines lie at minus the error (docs/five-axis.md)
    assert all(row["axis_line"] == -row["largest"] for row in rows.values() if row["axis_name"])
    page = Path("found/report.html").read_text()
    assert "Not determined, and what would separate it" in page
    assert all(item["separated_by"] in page for item in known["inseparable"])
    assert "three linear axes only" not in page


def test_report_of_parameters_of_rotary_axes(folder, call):
    assert call("simulate", "five.toml", "--scenario", "s.toml", "--out", "sim")[0] == 0
    words = ["run", "five.toml", "sim/trunnion.sphere.csv", "--controller", "siemens-toolcarrier", "--out", "tables"]
    assert call(*words)[0] == 0
    code, out, err = call("report", "tables", "--json")
    assert code == 0, err
    (control,), result = json.loads(out)["controls"], json.loads(Path("tables/result.json").read_text())
    assert {row["name"]: row["value"] for row in control["rotary"]["numbers"]} == result["numbers"]
    assert [item["name"] for item in control["files"]] == ["TOOLCARRIER.SPF"] and control["files"][0]["intact"]
    Path("tables/TOOLCARRIER.SPF").write_text("changed")
    code, out, err = call("report", "tables", "--out", "again")
    assert code == 0 and "is not the file that was verified" in " ".join(err.split())
