"""Features of parts made on a machine: the errors that they determine, in frames of unknown pose."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.data.deviations import read_parts
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.identification import IdentifyOptions, identify_measurement
from compgen.identification.any_measurement import read_measurement

MACHINE = """\
name = "mill"
chain = "{chain}"
reference_point_mm = [0.0, 0.0, 0.0]
[axes.X]
range_mm = [-330.0, 330.0]
nodes = 7
[axes.Y]
range_mm = [-330.0, 330.0]
nodes = 7
[axes.Z]
range_mm = [-200.0, 50.0]
nodes = 6
"""
#: Truth in the plane, mm and rad, by formulas of this test; straightness is zero at both ends of the travel.
EC0Y, SLOPE_X, SLOPE_Y = 64e-6, 9e-6, -6e-6


def without_prior(machine):
    """For what the readings themselves say: least squares."""
    return replace(machine, prior=PriorSettings(class_name="none"))


def exx(x):
    return SLOPE_X * x + 0.004 * np.sin(x / 110.0)


def eyy(y):
    return SLOPE_Y * y + 0.003 * np.sin(y / 90.0)


def eyx(x):
    return 0.005 * np.cos(np.pi * x / 660.0)


def exy(y):
    return 0.004 * np.sin(np.pi * (y + 330.0) / 330.0)


def displaced(x, y):
    """Tool position for the command (x, y) with X as the squareness reference."""
    return np.column_stack([x + exx(x) + exy(y) - EC0Y * y, y + eyy(y) + eyx(x)])


def drilled(seed, count=500, reach=330.0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach, reach, (count, 2))
    corners = reach * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, -1], [-1, 0]])
    return np.vstack([points, corners]), rng


def turned(points, degrees, offset=(0.0, 0.0), scale=1.0):
    a = np.radians(degrees)
    return scale * points @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + offset


def part(path, nominal, measured, comments=("origin_mm = 0, 0, 0",), **columns):
    names = ["x_mm", "y_mm", "mx_mm", "my_mm", *columns]
    rows = np.column_stack([nominal, measured, *columns.values()])
    text = "".join(f"# {line}\n" for line in comments) + ",".join(names) + "\n"
    path.write_text(text + "".join(",".join(f"{value:.6f}" for value in row) + "\n" for row in rows))
    return path


@pytest.fixture
def mill(tmp_path):
    path = tmp_path / "mill.toml"
    path.write_text(MACHINE.format(chain="WFYXZT"))
    return compgen.load_machine(path)


def plane_field(machine, errors, points):
    position = np.column_stack([points, np.zeros(len(points))])
    return compgen.volumetric_error(machine, errors, position)[:, :2]


def without_plane_motion(points, field, *, scale=False):
    """The field (n, 2) without its best-fit shift and rotation in the plane, and without its best-fit scale."""
    x, y = points.T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    columns = [np.r_[one, zero], np.r_[zero, one], np.r_[-y, x], *([np.r_[x, y]] if scale else [])]
    design = np.column_stack(columns)
    flat = np.r_[field[:, 0], field[:, 1]]
    return flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]


@pytest.mark.parametrize("degrees", [0.0, 0.029, 37.0, 90.0, 180.0])
def test_a_turned_plate_without_noise_gives_the_errors_of_its_plane(mill, tmp_path, degrees):
    """The curves are piecewise linear between 7 nodes; so is the truth here, read at the nodes."""
    points, _ = drilled(1)
    nodes = np.linspace(-330.0, 330.0, 7)
    broken = [np.interp(points[:, k], nodes, curve(nodes)) for k, curve in ((0, exx), (1, exy), (1, eyy), (0, eyx))]
    made = np.column_stack(
        [points[:, 0] + broken[0] + broken[1] - EC0Y * points[:, 1], points[:, 1] + broken[2] + broken[3]]
    )
    path = part(tmp_path / "p.part.csv", points, turned(made, degrees, (12.0, -3.0)))
    found = identify_measurement(mill, read_measurement([path]))
    assert {"EXX", "EYX", "EXY", "EYY", "EC0Y"} <= set(found.errors.names)
    assert found.errors.squareness["EC0Y"][0] == pytest.approx(EC0Y, abs=2e-8)
    for name, truth in (("EXX", exx), ("EYX", eyx), ("EXY", exy), ("EYY", eyy)):
        curve = found.errors.curves[name]
        assert np.allclose(
            curve.value, truth(curve.position_mm) - (truth(0.0) if name in ("EXX", "EYY") else 0), atol=2e-5
        ), name
    pose = found.summary()["deviations"]["poses"][0]
    assert pose["offset_mm"][2] is None
    assert pose["rotation_deg"][2] == pytest.approx(degrees, abs=2e-6) or degrees == 180.0


def test_nothing_is_invented_at_one_height(mill, tmp_path):
    points, rng = drilled(2)
    path = part(tmp_path / "p.part.csv", points, displaced(*points.T) + rng.normal(0, 1e-3, points.shape))
    found = identify_measurement(mill, read_measurement([path]))
    assert not {"EZX", "EZY", "EXZ", "EYZ", "EZZ", "EAZ", "EBZ", "EA0Z", "EB0Z", "EAX", "EBX"} & set(found.errors.names)
    assert {text.split(":")[0] for text in found.unobservable} >= {"EZX", "EZZ", "EB0Z", "EAX"}
    field = plane_field(mill, found.errors, points) - (displaced(*points.T) - points)
    assert np.sqrt(np.mean(without_plane_motion(points, field) ** 2)) < 0.6e-3
    assert 0.8 < found.reduced_chi_square < 1.3


def test_stated_uncertainties_of_squareness_and_scale_difference_hold(mill, tmp_path):
    """Over 40 plates: the error over its standard uncertainty has a spread of about one."""
    away = []
    for seed in range(40):
        points, rng = drilled(100 + seed, 150)
        nodes = np.linspace(-330.0, 330.0, 7)
        made = points + np.column_stack(
            [np.interp(points[:, 0], nodes, 1e-5 * nodes) - EC0Y * points[:, 1], np.zeros(len(points))]
        )
        path = part(tmp_path / "p.part.csv", points, turned(made, 5.0) + rng.normal(0, 2e-3, points.shape))
        found = identify_measurement(mill, read_measurement([path]), IdentifyOptions(u_deviation_um=2.0))
        value, u = found.errors.squareness["EC0Y"]
        curve = found.errors.curves["EXX"]
        away.append([(value - EC0Y) / u, (curve.value[-1] - 3.3e-3) / curve.u[-1]])
    spread = np.sqrt(np.mean(np.square(away), axis=0))
    assert ((spread > 0.7) & (spread < 1.35)).all(), spread


def test_a_free_scale_takes_the_temperature_and_only_a_common_scale_of_the_axes(mill, tmp_path):
    points, rng = drilled(3)
    warm = turned(displaced(*points.T), 1.0, scale=1.0 + 140e-6) + rng.normal(0, 1e-3, points.shape)
    path = part(tmp_path / "p.part.csv", points, warm)
    measurement = read_measurement([path])
    free = identify_measurement(mill, measurement, IdentifyOptions(part_scale="free"))
    pose = free.summary()["deviations"]["poses"][0]
    assert pose["scale"] - 1.0 == pytest.approx(
        140e-6 + (SLOPE_X + SLOPE_Y) / 2, abs=12e-6
    )  # scale errors: the smallest that agree
    field = plane_field(mill, free.errors, points) - (displaced(*points.T) - points)
    assert np.sqrt(np.mean(without_plane_motion(points, field, scale=True) ** 2)) < 0.6e-3
    assert any("EXX: part of it" in text for text in free.unobservable)
    known = identify_measurement(mill, measurement)
    assert known.errors.curves["EXX"].value[-1] == pytest.approx(330.0 * (140e-6 + SLOPE_X), abs=8e-3)


def test_temperatures_in_the_file_do_what_the_thermometer_says(mill, tmp_path):
    """Machined at 25 degC and measured at 20.5 degC: aluminium has shrunk by 4.5 K x 23 um/m in between."""
    points, _ = drilled(4)
    shrunk = displaced(*points.T) * (1.0 + 23e-6 * (20.5 - 25.0))
    hot, cool = np.full(len(points), 25.0), np.full(len(points), 20.5)
    columns = {"temp_machined_c": hot, "temp_part_c": cool}
    path = part(
        tmp_path / "a.part.csv", points, shrunk, ["expansion_um_per_m_k = 23", "origin_mm = 0, 0, 0"], **columns
    )
    plain = part(tmp_path / "b.part.csv", points, displaced(*points.T))
    with_them, without = (identify_measurement(mill, read_measurement([name])) for name in (path, plain))
    assert np.allclose(with_them.errors.curves["EXX"].value, without.errors.curves["EXX"].value, atol=2e-5)
    path.write_text(path.read_text().replace("# expansion_um_per_m_k = 23\n", ""))
    with pytest.raises(InputError, match="coefficient of expansion"):
        identify_measurement(mill, read_measurement([path]))


def test_names_of_features_are_for_people(tmp_path):
    """A report of a coordinate measuring machine names its features: neither refused nor warned of."""
    rows = ["1,1,1.1,1", "9,1,9.1,1", "1,9,1.1,9"]
    (tmp_path / "plain.part.csv").write_text("# origin_mm = 0, 0, 0\nx_mm,y_mm,mx_mm,my_mm\n" + "\n".join(rows) + "\n")
    named = "\n".join(f"{name},{row}" for name, row in zip(("H1", "", "H=3"), rows, strict=True))
    (tmp_path / "named.part.csv").write_text(f"# origin_mm = 0, 0, 0\nfeature,x_mm,y_mm,mx_mm,my_mm\n{named}\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain, found = read_parts(tmp_path / "plain.part.csv"), read_parts(tmp_path / "named.part.csv")
    np.testing.assert_array_equal(found.deviation_mm, plain.deviation_mm)


def test_two_set_ups_have_a_pose_each(mill, tmp_path):
    points, _ = drilled(5, 300)
    made = displaced(*points.T)
    half = np.arange(len(points)) % 2
    measured = np.where(half[:, None] == 1, turned(made, 90.0, (5.0, 6.0)), turned(made, -3.0, (-1.0, 0.5)))
    path = part(tmp_path / "p.part.csv", points, measured, setup=half)
    path.write_text(path.read_text().replace(".000000\n", "\n"))
    found = identify_measurement(mill, read_measurement([path]))
    assert found.errors.squareness["EC0Y"][0] == pytest.approx(EC0Y, abs=4e-7)
    poses = found.summary()["deviations"]["poses"]
    assert [round(pose["rotation_deg"][2], 2) for pose in poses] == [-3.0, 90.0]


def test_nodes_without_a_hole_are_said_and_their_uncertainty_grows(mill, tmp_path):
    points, rng = drilled(6, reach=160.0)
    path = part(tmp_path / "p.part.csv", points, displaced(*points.T) + rng.normal(0, 1e-3, points.shape))
    with pytest.warns(
        CompgenWarning, match=r"no reading reaches EXX at -330, 330 mm.*the uncertainty of an extrapolation"
    ):
        found = identify_measurement(mill, read_measurement([path]))
    curve = found.errors.curves["EXX"]
    assert curve.u[-1] > 2.0 * curve.u[-2]
    assert np.all(np.abs(curve.value - exx(curve.position_mm)) < 3.0 * curve.u + 1e-6)
    value, u = found.errors.squareness["EC0Y"]
    assert abs(value - EC0Y) < 2.0 * u
    # the squareness of straightness errors that are zero at 160 mm: a different number, which the readings determine
    short = identify_measurement(without_prior(mill), read_measurement([path]), IdentifyOptions(travel="from-data"))
    curve = short.errors.curves["EXX"]
    assert (curve.position_mm[0], curve.position_mm[-1]) == (-160.0, 160.0)
    slope = (exy(160.0) - exy(-160.0)) / 320.0
    assert short.errors.squareness["EC0Y"][0] == pytest.approx(EC0Y - slope, abs=2e-6)


def test_deviations_without_z_at_one_height_are_taken_the_same_way(mill, tmp_path):
    points, _ = drilled(7)
    moved = displaced(*points.T) - points
    rows = "".join(
        f"{x:.6f},{y:.6f},-40,{1e3 * dx:.6f},{1e3 * dy:.6f}\n" for (x, y), (dx, dy) in zip(points, moved, strict=True)
    )
    path = tmp_path / "p.deviations.csv"
    path.write_text("x_mm,y_mm,z_mm,dx_um,dy_um\n" + rows)
    plate = part(tmp_path / "p.part.csv", points, turned(points + moved, 20.0))
    first, second = (identify_measurement(without_prior(mill), read_measurement([name])) for name in (path, plate))
    assert first.errors.names == second.errors.names
    assert np.allclose(first.errors.curves["EYX"].value, second.errors.curves["EYX"].value, atol=1e-5)


def test_several_heights_and_all_components_show_the_angles_too(tmp_path):
    """A machine whose errors are all in the model: a part measured in space agrees with the known field."""
    path = tmp_path / "mill.toml"
    path.write_text(MACHINE.format(chain="WYFXZT"))
    machine = compgen.load_machine(path)
    rng = np.random.default_rng(8)
    names = compgen.observable_errors(machine)
    curves, squareness = {}, {}
    for name in names:
        if name in ("EC0Y", "EB0Z", "EA0Z"):
            squareness[name] = (float(rng.normal(0, 3e-5)), float("nan"))
            continue
        axis = machine.axes["XYZ".index(name[2])]
        value = rng.normal(0, 5e-3 if name[1] in "XYZ" else 2e-5, len(axis.nodes_mm))
        curves[name] = compgen.Curve(axis.nodes_mm, value, np.full(len(value), np.nan))
    truth = compgen.ErrorTable(curves, squareness)
    grid = [np.linspace(*axis.range_mm, 13) for axis in machine.axes]
    points = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    field = compgen.exact_error(machine, truth, points)
    text = "# origin_mm = 0, 0, 0\nx_mm,y_mm,z_mm,mx_mm,my_mm,mz_mm\n"
    rows = np.column_stack([points, points + field])
    plate = tmp_path / "p.part.csv"
    plate.write_text(text + "".join(",".join(f"{value:.7f}" for value in row) + "\n" for row in rows))
    found = identify_measurement(machine, read_measurement([plate]))
    assert set(found.errors.names) == set(names)
    left = compgen.exact_error(machine, found.errors, points) - field
    assert np.abs(compgen.without_rigid_motion(points, left)).max() < 2e-5


BAD = [
    (lambda text: text.replace("mx_mm", "mxx_mm").replace("my_mm", "myy_mm"), "has none of mx_mm|required|is missing"),
    (lambda text: text.replace("mx_mm,my_mm", "my_mm,mx_mm"), "axes exchanged"),
    (lambda text: text.replace("x_mm,y_mm,mx", "y_mm,x_mm,mx", 1), "axes exchanged"),
    (lambda text: text[: len(text) // 2], "fields|truncated"),
    (lambda text: text.replace("0, 0, 0", "1, 2"), "origin_mm = '1, 2' is not three numbers"),
    (lambda text: text.replace("0, 0, 0", "0, 0, nan"), "origin_mm = '0, 0, nan' is not three numbers"),
    (lambda text: text.replace("0, 0, 0", "900, 0, 0"), "outside the travel"),
    (
        lambda text: text.replace("# origin_mm = 0, 0, 0\n", ""),
        "does not say where the part was.*'# origin_mm = 0, 0, 0' if",
    ),
]


@pytest.mark.parametrize("change, message", BAD)
def test_what_cannot_be_right_is_refused(mill, tmp_path, change, message):
    points, _ = drilled(9)
    path = part(tmp_path / "p.part.csv", points, displaced(*points.T))
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message):
        identify_measurement(mill, read_measurement([path]))


def test_one_of_several_parts_that_does_not_say_where_it_was_is_named(mill, tmp_path, capsys):
    from compgen.cli import cli
    from compgen.cli.common import run_command

    points, _ = drilled(9)
    stated = part(tmp_path / "a.part.csv", points, displaced(*points.T))
    silent = part(tmp_path / "b.part.csv", points + [1.0, 0.0], displaced(*points.T) + [1.0, 0.0], ())
    for words in (["identify"], ["run", "--controller", "isg-csv"]):
        files = [str(tmp_path / "mill.toml"), str(stated), str(silent)]
        assert run_command(cli, [words[0], *files, *words[1:], "--out", str(tmp_path / "o")]) == 2
        said = capsys.readouterr().err
        assert "b.part.csv" in said
        assert "a.part.csv" not in said
        assert not (tmp_path / "o").exists()
    assert run_command(cli, ["import", str(silent)]) == 2
    assert "# origin_mm = X, Y, Z" in capsys.readouterr().err


def test_measured_coordinates_in_inches_are_refused(mill, tmp_path):
    points, _ = drilled(9)
    path = part(tmp_path / "p.part.csv", points, displaced(*points.T) / 25.4)
    with pytest.raises(InputError, match="check the units"):
        read_parts(path)


def test_too_few_features_are_undetermined(mill, tmp_path):
    points = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    path = part(tmp_path / "p.part.csv", points, displaced(*points.T))
    with pytest.raises(UndeterminedError):
        identify_measurement(mill, read_measurement([path]))


def test_the_command_line_goes_from_a_plate_to_tables(tmp_path, capsys):
    from compgen.cli import cli
    from compgen.cli.common import run_command

    machine = tmp_path / "mill.toml"
    machine.write_text(MACHINE.format(chain="WFYXZT"))
    points, rng = drilled(10)
    path = part(tmp_path / "p.part.csv", points, turned(displaced(*points.T), 12.0) + rng.normal(0, 1e-3, points.shape))
    words = ["run", machine, path, "--controller", "isg-csv", "--out", tmp_path / "out", "--no-report", "--json"]
    assert run_command(cli, list(map(str, words))) == 0
    assert json.loads(capsys.readouterr().out)
    assert json.loads(Path(tmp_path / "out" / "identify.json").read_text())["deviations"]["poses"][0]["setup"] == 0


def test_a_slip_in_the_fixture_halfway_is_found_in_the_residuals(mill, tmp_path):
    """The second half of the features was measured after the part had moved by 30 um, but the labels say one set-up."""
    points, rng = drilled(11)
    made = displaced(*points.T) + rng.normal(0, 1e-3, points.shape)
    made[len(made) // 2 :, 0] += 0.03
    path = part(tmp_path / "p.part.csv", points, made)
    found = identify_measurement(mill, read_measurement([path]), IdentifyOptions(u_deviation_um=1.0, reject=False))
    assert found.misfit.summary()["causes"]


def test_the_condition_is_that_of_the_readings(mill, tmp_path):
    """A plate that covers the travel is better conditioned than one that covers half of it; neither is a constant."""
    found = []
    for reach in (330.0, 160.0):
        points, _ = drilled(12, reach=reach)
        path = part(tmp_path / f"{reach:g}.part.csv", points, displaced(*points.T))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            found.append(identify_measurement(mill, read_measurement([path])).condition)
    assert 1.0 < found[0] < found[1] < 1e6
