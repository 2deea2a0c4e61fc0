"""Several measurements of one machine together: against its given errors, and against each measurement alone."""

import json
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.circles import PLANES, Circles, format_circles
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.error_table import format_errors
from compgen.data.lengths import format_lengths
from compgen.data.names import error_named
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.foreign import open_measurement
from compgen.foreign.converted import given_errors
from compgen.identification import IdentifyOptions, joint_covariance
from compgen.identification.any_measurement import MixedMeasurement
from compgen.identification.axis_tests import identify_circles
from compgen.identification.options import StatedNumbers
from compgen.identification.together import Source, identify_together
from compgen.kinematics.exact_chain import tip_position
from compgen.pipeline import identify_bare, with_reversal

NOISE_MM = 3e-4


@pytest.fixture(scope="module")
def least_squares(small_machine):
    """The machine without a prior: what the readings themselves say."""
    return replace(small_machine, prior=PriorSettings(class_name="none"))


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
    scale = found.errors.curves["EYY"]
    low, high = small_machine.axes[1].range_mm
    assert scale.at(np.array([low, high])) == pytest.approx([-12e-6 * (low - 100.0), -12e-6 * (high - 100.0)], rel=0.01)
    known = joint_covariance(found)
    rows = np.flatnonzero(np.array(known.error) == "EYY")
    ends = np.subtract.outer(np.eye(len(rows))[-1], 0.0) - np.eye(len(rows))[0]
    u = np.sqrt(ends @ known.errors_covariance[np.ix_(rows, rows)] @ ends)
    assert u == pytest.approx(2e-6 * (high - low), rel=0.02)  # of the whole travel; a single place may differ more
    assert scale.u.min(where=np.abs(scale.position_mm - 100.0) > 1.0, initial=1.0) > u
    assert found.reversal_curves.curves[2, 2].value.tolist() == [-6e-3]  # an axis that stops short
    assert joint_covariance(found).errors_covariance[-1, -1] == pytest.approx(9e-12)


def test_runs_beside_lengths_narrow_what_they_are_about_and_leave_the_rest(
    tmp_path, least_squares, truth, small_lengths_file
):
    small_machine = least_squares
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


def test_a_plane_and_runs_determine_what_neither_does_alone(tmp_path, least_squares, truth):
    small_machine = least_squares
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


def test_what_is_rejected_alone_does_not_come_back_in_the_mixture(tmp_path, least_squares, truth):
    small_machine = least_squares
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
        assert np.max(np.abs(first.value - second.value)) < 0.1 * NOISE_MM


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


def some_stations(small_lengths_file, *names):
    """The readings of some stations of the small machine."""
    lengths = compgen.read_lengths(small_lengths_file)
    rows = np.flatnonzero(np.isin(lengths.station, [lengths.stations.index(name) for name in names]))
    kept = lengths.part(rows)
    number = {lengths.stations.index(name): k for k, name in enumerate(names)}
    return replace(kept, stations=names, station=np.array([number[k] for k in kept.station.tolist()]))


def test_two_stations_and_a_plane_give_what_neither_gives_alone(small_machine, small_lengths_file):
    """Two stations determine no error alone; with measured positions at one height they add the errors along Z."""
    truth = compgen.read_errors(small_lengths_file.parent / "truth.errors.csv")
    plane = plane_of(small_machine, truth)
    both = MixedMeasurement((("t", some_stations(small_lengths_file, "S1", "S3")), ("p", plane)))
    found = identify_bare(small_machine, both)
    assert found.objections == ()
    assert 0.8 < found.reduced_chi_square < 1.2
    assert len(found.residual_mm) == len(both.parts[0][1]) + 2 * len(plane)
    assert {"EZZ", "EYZ"} <= set(found.errors.names)
    alone = identify_bare(small_machine, plane)
    assert "EZZ" not in alone.errors.names
    for name in set(found.errors.names) - set(alone.errors.names):  # new ones are wholly determined
        value, u, known = of(found, truth, name)
        assert np.max(np.abs(value - known) / np.maximum(u, 1e-9)) < 4.0, name


def of(found, truth, name):
    """Value, uncertainty and truth of an error, each (m,)."""
    if name in found.errors.squareness:
        (value, u), (known, _) = found.errors.squareness[name], truth.squareness[name]
        return np.array([value]), np.array([u]), np.array([known])
    curve = found.errors.curves[name]
    return curve.value, curve.u, truth.curves[name].at(curve.position_mm)


def test_one_station_adds_nothing_alone_and_takes_nothing_away(
    tmp_path, small_machine, least_squares, truth, small_lengths_file
):
    """A station beside a laser: the positioning of X stays, all that one station cannot separate is named."""
    lengths = some_stations(small_lengths_file, "S2")
    lengths.length_mm[5] += 0.5  # a reading that belongs to nothing
    truth = compgen.read_errors(small_lengths_file.parent / "truth.errors.csv")
    runs = runs_of(small_machine, truth, 0)
    mixture = MixedMeasurement((("t", lengths), ("x", runs)))
    found = identify_bare(small_machine, mixture)
    assert found.errors.names[0] == "EXX"
    for name in found.errors.names:  # a little of everything, with the uncertainty that this is
        value, u, known = of(found, truth, name)
        assert np.max(np.abs(value - known) / np.maximum(u, 1e-9)) < 3.0, name
    found = identify_bare(least_squares, mixture)
    assert found.errors.names == ("EXX",)
    value, u, known = of(found, truth, "EXX")
    assert np.max(np.abs(value - known) / np.maximum(u, 1e-9)) < 4.0
    assert u.max() < NOISE_MM  # as the runs alone, the zero at the reference point included
    assert "EC0Y: the readings do not separate it from the stations and other errors" in found.unobservable
    assert max(found.rejected, key=lambda item: abs(item.residual_um)).row == 5
    assert len(found.rejected) < 0.01 * len(lengths)
    paths = written(tmp_path, t_lengths_csv=format_lengths(lengths), x_axis_csv=format_axis_runs(runs))
    command = ["identify", str(small_machine.source), *map(str, paths), "--out", str(tmp_path / "o")]
    assert run_command(cli, command) == 0
    assert run_command(cli, [*command[:2], str(paths[0]), "--out", str(tmp_path / "p")]) == 2  # a station alone


def test_lengths_of_targets_in_one_plane_are_refused_with_the_reason(small_machine, small_lengths_file, truth):
    lengths = some_stations(small_lengths_file, "S2")
    flat = lengths.part(np.flatnonzero(lengths.position_mm[:, 2] == lengths.position_mm[0, 2]))
    with pytest.raises(UndeterminedError, match="targets of station 'S2' lie in a plane"):
        identify_bare(small_machine, MixedMeasurement((("t", flat), ("x", runs_of(small_machine, truth, 0)))))


def circles_of(machine, errors, *, radius_mm=90.0, noise_mm=NOISE_MM, seed=6):
    """Circles in three planes about the middle of the travel, both directions, by the exact model."""
    rng, centre = np.random.default_rng(seed), np.array([np.mean(axis.range_mm) for axis in machine.axes])
    tool = np.array(machine.tool_offset_mm)
    angle = np.radians(np.arange(0.5, 360.0, 3.0))
    parts = []
    for plane, (first, second) in enumerate(PLANES.values()):
        position = np.tile(centre, (len(angle), 1))
        position[:, first] += radius_mm * np.cos(angle)
        position[:, second] += radius_mm * np.sin(angle)
        tip = tip_position(machine, errors.at(position), position, tool) - tool - centre
        distance = np.linalg.norm(tip, axis=1) - radius_mm
        for way in (1, -1):
            parts.append((np.full(len(angle), plane), angle, distance + rng.normal(0.0, noise_mm, len(angle)), way))
    plane, at, deviation = (np.concatenate([part[k] for part in parts]) for k in range(3))
    count, way = len(plane), np.repeat([part[3] for part in parts], len(angle))
    return Circles(
        plane, at, np.full(count, radius_mm), deviation, way, np.zeros(count, dtype=int), np.zeros(count, dtype=int),
        np.tile(centre, (count, 1)), np.full(count, np.nan),
    )  # fmt: skip


def test_circles_enter_an_adjustment_with_their_joint_covariance(small_machine):
    """A number for EC0Y improves the other planes, too, as far as their values are correlated: Gauss-Markov by hand."""
    table = StatedNumbers(squareness={"EC0Y": "45", "EB0Z": "-30", "EA0Z": "25"}).errors(small_machine)
    circles = circles_of(small_machine, table)
    circles = circles.part(np.flatnonzero(circles.direction == 1))  # the reversals of the axes tie the planes
    with pytest.warns(CompgenWarning, match="in one direction only"):
        alone = identify_circles(small_machine, circles)
    prior, weights = alone.values_factor @ alone.values_factor.T, np.array([1.0, 0.0, 0.0])
    assert abs(prior[0, 1]) > 0.1 * prior[0, 0]
    u_rad = float(np.sqrt(prior[0, 0]))
    known = alone.errors.values()[0] + u_rad
    numbers = StatedNumbers(squareness={"EC0Y": f"{1e6 * known}±{1e6 * u_rad}"}).errors(small_machine)
    given = Source("number", None, given_errors(small_machine, numbers, whole=False))
    found = identify_together(small_machine, [Source("c", circles, alone), given], IdentifyOptions())
    gain = prior @ weights / (weights @ prior @ weights + u_rad**2)
    assert found.errors.values() == pytest.approx(alone.errors.values() + gain * u_rad, abs=1e-10)
    u = found.errors.uncertainties() / found.u_scale
    assert u == pytest.approx(np.sqrt(np.diag(prior - np.outer(gain, weights @ prior))), rel=1e-6)


def closely(machine, table, count=41):
    """A table at closely spaced positions, as a level or a straightedge reads it."""
    curves = {}
    for name, curve in table.curves.items():
        at = np.linspace(*machine.axes[error_named(name).axis].range_mm, count)
        curves[name] = compgen.Curve(at, curve.at(at), np.full(count, curve.u[0]))
    return compgen.ErrorTable(curves)


def test_a_circle_gives_the_squareness_over_the_travel_as_far_as_guides_are_known(tmp_path, small_machine, truth):
    """It shows the squareness within its diameter: straightness and angles there, once measured, are taken off."""
    flat = truth.only(*(name for name in truth.names if error_named(name).kind != "angular"))
    circles = circles_of(small_machine, flat)
    straight = closely(small_machine, flat.only(*(name for name in flat.curves if error_named(name).is_straightness)))
    turns = truth.only(*(name for name in truth.curves if error_named(name).kind == "angular"))
    level = closely(small_machine, turns.with_values(values=np.zeros(len(turns.values()))))
    files = {"c_circle_csv": format_circles(circles), "s_errors_csv": format_errors(straight)}
    some = written(tmp_path, **files)
    every = written(tmp_path, **files, l_errors_csv=format_errors(level))
    known = []
    for paths in (some[:1], some, every):
        found = identify_bare(small_machine, open_measurement(paths)).errors.squareness
        known.append(np.array([found[name] for name in flat.squareness]))
    for values in known[1:]:
        assert np.all(np.abs(values[:, 0] - [value for value, _ in flat.squareness.values()]) < 2.0 * values[:, 1])
    assert (
        known[0][0, 1] > 20e-6 and known[1][0, 1] > 20e-6
    )  # angles that nobody read move the tool along the circle, too
    assert known[2][:, 1].max() < 5e-6
