"""Several measurements of one machine together: against its given errors, and against each measurement alone."""

import json

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.error_table import format_errors
from compgen.data.names import error_named
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import open_measurement
from compgen.identify import joint_covariance
from compgen.identify.options import StatedNumbers
from compgen.kinematics.exact_chain import tip_position
from compgen.pipeline import identify_bare, with_reversal

NOISE_MM = 3e-4


@pytest.fixture(scope="module")
def truth(small_machine, small_errors):
    """Errors of the machine, every curve zero at the point set by the gauge."""
    return small_errors


def runs_of(machine, truth, axis, *, offset_mm=0.02, targets=None, seed=1):
    """Five runs in both directions along an axis, with an arbitrary zero; values only from the truth."""
    rng = np.random.default_rng(seed)
    name = ("EXX", "EYY", "EZZ")[axis]
    at = machine.axes[axis].nodes_mm if targets is None else np.asarray(targets)
    rows = [(p, way, run) for run in range(5) for way in (1, -1) for p in at]
    position = np.array([row[0] for row in rows])
    value = truth.curves[name].at(position) + offset_mm + rng.normal(0.0, NOISE_MM, len(rows))
    count = len(rows)
    way, run = (np.array([row[k] for row in rows]) for k in (1, 2))
    return AxisRuns(np.full(count, axis), position, way, run, value)


def plane_of(machine, truth, *, seed=2, z_mm=None):
    """Positions in a plane, measured in a frame that is turned and shifted, by the exact model."""
    rng = np.random.default_rng(seed)
    x, y, z = (axis.nodes_mm for axis in machine.axes)
    position = np.stack(np.meshgrid(x, y, [z[1] if z_mm is None else z_mm], indexing="ij"), axis=-1).reshape(-1, 3)
    tool = np.array(machine.tool_offset_mm)
    tip = tip_position(machine, truth.at(position), position, tool) - tool
    turn = np.array([[np.cos(1e-3), -np.sin(1e-3), 0], [np.sin(1e-3), np.cos(1e-3), 0], [0, 0, 1.0]])
    deviation = tip @ turn.T + [0.3, -0.2, 0.1] - position + rng.normal(0.0, NOISE_MM, position.shape)
    deviation[:, 2] = np.nan
    return Deviations(position, deviation, np.where(np.isnan(deviation), np.nan, NOISE_MM))


def written(folder, **texts):
    paths = []
    for name, text in texts.items():
        path = folder / name.replace("_", ".", 1).replace("_csv", ".csv")
        path.write_text(text)
        paths.append(path)
    return paths


def test_pitch_of_a_laser_and_a_granite_square_are_joined_as_they_are(tmp_path, small_machine, truth):
    runs = runs_of(small_machine, truth, 0, targets=np.linspace(*small_machine.axes[0].range_mm, 13))
    paths = written(tmp_path, x_axis_csv=format_axis_runs(runs))
    numbers = StatedNumbers(squareness={"EC0Y": "25±3"}, backlash={"Z": "6±1"}, scale={"Y": "-12±2"})
    measurement = open_measurement(paths, stated=numbers.errors(small_machine))
    found = with_reversal(identify_bare(small_machine, measurement), numbers.reversal())
    assert found.errors.names == ("EXX", "EYY", "EC0Y")
    assert found.errors.squareness["EC0Y"] == pytest.approx((25e-6, 3e-6))
    assert len(found.errors.curves["EXX"].value) == 13  # at the targets, not at the nodes of the machine
    slope = np.polyfit(found.errors.curves["EYY"].position_mm, found.errors.curves["EYY"].value, 1)[0]
    assert slope == pytest.approx(-12e-6)
    assert found.reversal_curves.curves[2, 2].value.tolist() == [-6e-3]  # an axis that stops short
    assert joint_covariance(found).errors_covariance[-1, -1] == pytest.approx(9e-12)


def test_runs_beside_lengths_narrow_what_they_are_about_and_leave_the_rest(
    tmp_path, small_machine, truth, small_lengths_file
):
    alone = identify_bare(small_machine, open_measurement([small_lengths_file]))
    (path,) = written(tmp_path, x_axis_csv=format_axis_runs(runs_of(small_machine, alone.errors, 0)))
    found = identify_bare(small_machine, open_measurement([small_lengths_file, path]))
    assert found.objections == ()
    assert found.errors.names == alone.errors.names
    assert found.stations == alone.stations
    assert found.readings == alone.readings + 10 * len(small_machine.axes[0].nodes_mm)
    assert max(found.details["en"][small_lengths_file.name].values()) < 1.0
    for name, curve in found.errors.curves.items():
        before = alone.errors.curves[name]
        assert np.all(curve.u <= before.u * (1 + 1e-6) + 1e-9)
        assert np.max(np.abs(curve.value - before.value) / np.maximum(before.u, 1e-7)) < 4.0
    assert found.errors.curves["EXX"].u.max() < 0.98 * alone.errors.curves["EXX"].u.max()
    assert found.errors.curves["EZZ"].u == pytest.approx(alone.errors.curves["EZZ"].u, rel=0.02)


def test_a_plane_and_runs_determine_what_neither_does_alone(tmp_path, small_machine, truth):
    paths = written(
        tmp_path,
        p_deviations_csv=format_deviations(plane_of(small_machine, truth)),
        x_axis_csv=format_axis_runs(runs_of(small_machine, truth, 0)),
        y_axis_csv=format_axis_runs(runs_of(small_machine, truth, 1)),
    )
    found = identify_bare(small_machine, open_measurement(paths))
    assert found.method == "together"
    assert found.objections == ()
    assert 0.6 < found.reduced_chi_square < 1.5
    for name in ("EXX", "EYY"):  # at one height a positioning error cannot be separated from an angle
        curve, u = found.errors.curves[name], found.errors.curves[name].u
        difference = curve.value - truth.curves[name].at(curve.position_mm)
        assert np.max(np.abs(difference) / np.maximum(u, 1e-6)) < 4.0
    position = plane_of(small_machine, truth).position_mm
    left = compgen.volumetric_error(small_machine, found.errors, position) - compgen.volumetric_error(
        small_machine, truth, position
    )
    left[:, 2] = 0.0  # never measured
    assert np.sqrt(np.mean(compgen.without_rigid_motion(position, left)[:, :2] ** 2)) < 2 * NOISE_MM


def test_what_is_rejected_alone_does_not_come_back_in_the_mixture(tmp_path, small_machine, truth):
    plane = plane_of(small_machine, truth)
    clean, wrong = plane.deviation_mm.copy(), plane.deviation_mm.copy()
    wrong[7, 0] += 0.05  # a hole that was read wrong by 50 um
    runs = written(tmp_path, x_axis_csv=format_axis_runs(runs_of(small_machine, truth, 0)))
    found = []
    for values in (clean, wrong):
        plane.deviation_mm[:] = values
        (path,) = written(tmp_path, p_deviations_csv=format_deviations(plane))
        found.append(identify_bare(small_machine, open_measurement([path, *runs])))
    assert len(found[1].rejected) == 1
    assert found[1].reduced_chi_square < 1.5
    for name in ("EXX", "EYX"):
        first, second = (item.errors.curves[name] for item in found)
        assert np.max(np.abs(first.value - second.value) / np.maximum(second.u, 1e-6)) < 3.0


def test_instruments_that_contradict_each_other_are_named_and_nothing_is_accepted(tmp_path, small_machine, truth):
    wrong = runs_of(small_machine, truth, 0)
    wrong.deviation_mm[:] *= -1.0  # the sign of the laser
    paths = written(
        tmp_path,
        a_axis_csv=format_axis_runs(runs_of(small_machine, truth, 0, seed=4)),
        b_errors_csv=format_errors(truth.only("EXX", "EC0Y").replace(metadata={})),
    )
    agreeing = identify_bare(small_machine, open_measurement(paths))
    assert agreeing.objections == ()
    assert max(agreeing.details["en"]["a.axis.csv"].values()) < 1.0
    (paths[0]).write_text(format_axis_runs(wrong))
    with pytest.warns(CompgenWarning, match=r"a\.axis\.csv disagrees .* EXX"):
        found = identify_bare(small_machine, open_measurement(paths))
    assert "EXX" in found.objections[0]
    assert found.details["en"]["a.axis.csv"]["EXX"] > 3.0
    out = tmp_path / "out"
    arguments = ["run", str(small_machine.source), *map(str, paths), "--controller", "isg-csv", "--out", str(out)]
    assert run_command(cli, [*arguments, "--no-report"]) == 1
    assert not json.loads((out / "result.json").read_text())["accepted"]


def test_errors_of_several_files_are_one_set(tmp_path, small_machine, truth):
    names = truth.names
    paths = written(
        tmp_path,
        a_errors_csv=format_errors(truth.only(*names[:5], "EC0Y", "EB0Z", "EA0Z")),
        b_errors_csv=format_errors(
            truth.only(*(name for name in names[5:] if name.startswith("E") and "0" not in name))
        ),
    )
    found = identify_bare(small_machine, open_measurement(paths))
    assert found.errors.names == names
    for name in found.errors.curves:
        at = found.errors.curves[name].position_mm
        assert found.errors.curves[name].value == pytest.approx(truth.curves[name].at(at), abs=1e-9)


def test_files_of_one_name_and_errors_that_the_model_lacks_do_not_disturb(tmp_path, small_machine, truth):
    """Two folders with files of the same name; one contains ECX, which this machine does not show."""
    at = small_machine.axes[0].nodes_mm
    yaw = compgen.Curve(at, 50e-6 * np.sin(at), np.full(len(at), 1e-6))
    paths = []
    both = truth.only("EXX").replace(curves={"EXX": truth.curves["EXX"], "ECX": yaw})
    for folder, table in (("a", truth.only("EXX")), ("b", both)):
        (tmp_path / folder).mkdir()
        paths += written(tmp_path / folder, x_errors_csv=format_errors(table))
    with pytest.warns(CompgenWarning, match="a rotation is removed"):
        found = identify_bare(small_machine, open_measurement(paths))
    assert found.errors.names == ("EXX",)
    assert found.objections == ()
    assert found.reduced_chi_square < 1.5
    assert [part["name"] for part in found.details["parts"]] == [str(path) for path in paths]
    with pytest.raises(InputError, match="is given twice"):
        open_measurement([paths[0], paths[0]])


def test_how_a_straightedge_lay_makes_no_squareness(tmp_path, small_machine, truth):
    """A line in the straightness of a file without squareness comes from the set-up of the straightedge."""
    curve = truth.curves["EYX"]
    sloped = compgen.Curve(curve.position_mm, curve.value + 5e-5 * curve.position_mm + 0.01, curve.u)
    (path,) = written(tmp_path, s_errors_csv=format_errors(compgen.ErrorTable({"EYX": sloped})))
    stated = StatedNumbers(squareness={"EC0Y": "0.02/300"}).errors(small_machine)
    found = identify_bare(small_machine, open_measurement([path], stated=stated))
    assert found.errors.squareness["EC0Y"][0] == pytest.approx(0.02 / 300)
    assert found.errors.curves["EYX"].value == pytest.approx(curve.value, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "value", "u"),
    [
        ("25", 25e-6, np.nan),
        ("-25.5±3", -25.5e-6, 3e-6),
        ("25+-3um/m", 25e-6, 3e-6),
        ("5.2arcsec", 5.2 * np.pi / 648000, np.nan),
        ('1" ', np.pi / 648000, np.nan),
        ("0.02/300", 0.02 / 300, np.nan),
        ("0.02/300±0.005", 0.02 / 300, 0.005 / 300),
        ("0.1mrad", 1e-4, np.nan),
    ],
)
def test_numbers_of_squareness_in_the_units_of_the_workshop(small_machine, text, value, u):
    found = StatedNumbers(squareness={"EA0Z": text}).errors(small_machine).squareness["EA0Z"]
    assert found == pytest.approx((value, u), nan_ok=True)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"squareness": {"EC0X": "25"}}, "'EC0X' is not a squareness error; this may be EC0Y"),
        (
            {"squareness": {"Rechtwinkligkeit YZ": "25"}},
            "this may be EA0Z, squareness of Z to Y, positive where the angle",
        ),
        ({"squareness": {"XZ": "25"}}, "this may be EB0Z"),
        ({"squareness": {"foo": "25"}}, "these are EC0Y"),
        ({"squareness": {"EC0Y": "25mm"}}, "is not understood; give a number"),
        ({"squareness": {"EC0Y": "nan"}}, "is not understood"),
        ({"squareness": {"EC0Y": "300000"}}, "too large"),
        ({"scale": {"A": "3"}}, "'A' is not an axis"),
        ({"scale": {"X": "3um"}}, "is not understood"),
    ],
)
def test_numbers_that_are_not_understood_are_refused(small_machine, numbers, message):
    with pytest.raises(InputError) as found:
        StatedNumbers(**numbers).errors(small_machine)
    assert message in str(found.value)


@pytest.mark.parametrize(("text", "value"), [("6", -6e-3), ("0.006mm", -6e-3), ("-2±1", 2e-3)])
def test_backlash_is_positive_where_the_axis_stays_behind(text, value):
    assert StatedNumbers(backlash={"X": text}).reversal().curves[0, 0].value.tolist() == pytest.approx([value])


def test_the_signs_of_squareness_are_those_of_the_angle_between_the_axes(small_machine):
    """As the help says: EC0Y and EA0Z open the angle between their axes, EB0Z closes it."""
    names = ("EC0Y", "EB0Z", "EA0Z")
    pairs = ((0, 1), (0, 2), (1, 2))
    for name, (first, second), sign in zip(names, pairs, (1, -1, 1), strict=True):
        errors = StatedNumbers(squareness={name: "100"}).errors(small_machine)
        start = np.array([axis.range_mm[0] for axis in small_machine.axes])
        ends = [start.copy(), start.copy(), start.copy()]
        ends[1][first] = small_machine.axes[first].range_mm[1]
        ends[2][second] = small_machine.axes[second].range_mm[1]
        moved = np.array(ends) + compgen.volumetric_error(small_machine, errors, np.array(ends))
        origin, one, other = moved
        cosine = (one - origin) @ (other - origin) / np.linalg.norm(one - origin) / np.linalg.norm(other - origin)
        assert np.arccos(cosine) - np.pi / 2 == pytest.approx(sign * 100e-6, abs=1e-7)
        assert error_named(name).kind == "squareness"


def test_a_command_takes_numbers_without_any_file(tmp_path, small_machine, capsys):
    out = tmp_path / "o"
    assert (
        run_command(cli, ["identify", str(small_machine.source), "--squareness", "EC0Y=25±3", "--out", str(out)]) == 0
    )
    assert "EC0Y,,25.000000000,3.000000000" in (out / "identified.errors.csv").read_text()
    assert run_command(cli, ["identify", str(small_machine.source), "--out", str(tmp_path / "p")]) == 2
    assert "no measurement file was given" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(5))
def test_the_formula_of_the_granite_square_on_the_page_of_instruments(small_machine, seed):
    """EC0Y = -b/B - a/A + s, by the geometry of arms at any position and a gauge that travels with the tool."""
    rng = np.random.default_rng(seed)
    truth, lean, own = rng.uniform(-1e-4, 1e-4, 3)
    errors = StatedNumbers(squareness={"EC0Y": f"{truth * 1e6}"}).errors(small_machine)
    length, start = 150.0, np.array([axis.range_mm[0] for axis in small_machine.axes]) + 10.0
    ends = np.array([start, start + [length, 0, 0], start + [0, length, 0]])
    at, along_x, along_y = ends + compgen.volumetric_error(small_machine, errors, ends) - start

    def drift(tool, angle):
        """Distance by which the tool moves to the left of an arm at an angle, over its travel."""
        return (tool - at)[1] * np.cos(angle) - (tool - at)[0] * np.sin(angle)

    a = drift(along_x, lean)  # plunger to +Y: the reading grows to the left of the X arm
    found = []
    for turned in (1, -1):  # the second time flipped about the X arm, read along the same line towards +Y
        b = -drift(along_y, np.pi / 2 + lean + turned * own)  # plunger to +X: it grows to the right of the Y arm
        found.append(-b / length - a / length + turned * own)
    assert found == pytest.approx([truth, truth], abs=1e-8)
