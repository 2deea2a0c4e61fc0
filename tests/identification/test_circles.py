"""Circular tests against machines with known errors; the readings are distances of the exact model from a pivot."""

import json
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.circles import PLANES, Circles, format_circles, read_circles
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.foreign import open_measurement
from compgen.identification import IdentifyOptions
from compgen.identification.axis_tests import circle_positions, identify_axis_runs, identify_circles
from compgen.identification.together import Source, identify_together
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import observable_errors
from compgen.pipeline import identify_bare
from compgen.tables.active import read_active

RADIUS_MM, NOISE_MM = 100.0, 2e-4
SQUARENESS = {"EC0Y": 80e-6, "EB0Z": -60e-6, "EA0Z": 45e-6}
REVERSAL_MM = (-6e-3, 4e-3, -3e-3)


@pytest.fixture(scope="module", params=["WFYXZT", "WXYFZT", "WYFXZT", "WZYXFT"])
def machine(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("m") / "mill.toml"
    axes = "".join(f"[axes.{a}]\nrange_mm = [-250.0, 250.0]\nnodes = 6\n" for a in "XYZ")
    path.write_text(f'name = "mill"\nchain = "{request.param}"\n{axes}')
    return compgen.load_machine(path)


@pytest.fixture(scope="module")
def least_squares(machine):
    """The machine without a prior: what the circles themselves say, within their diameter."""
    return replace(machine, prior=PriorSettings(class_name="none"))


def errors_of(machine):
    at = np.linspace(-250.0, 250.0, 26)
    zero = np.zeros(26)
    curves = {
        "EXX": Curve(at, 20e-6 * at, zero),
        "EYY": Curve(at, -15e-6 * at, zero),
        "EZZ": Curve(at, 5e-6 * at, zero),
        "EYX": Curve(at, 2e-8 * (at**2 - 250.0**2), zero),
        "EXZ": Curve(at, -1e-8 * (at**2 - 250.0**2), zero),
    }
    return ErrorTable(curves, {name: (value, 0.0) for name, value in SQUARENESS.items()})


def readings(machine, errors, plane, *, seed=1, mismatch=0.0, arc=(0.0, 360.0), directions=(1, -1), known_centre=True):
    """Length of a bar from a pivot slightly off centre, by an independent formula."""
    rng = np.random.default_rng(seed)
    centre = np.array([20.0, -10.0, 30.0])
    first, second = PLANES[plane]
    parts = []
    for direction in directions:
        angle = np.radians(np.linspace(*arc, 361)[:-1])
        unit = np.zeros((len(angle), 3))
        unit[:, first], unit[:, second] = np.cos(angle), np.sin(angle)
        command = centre + RADIUS_MM * unit
        tip = tip_position(machine, errors.at(command), command, np.zeros(3))
        velocity = np.zeros((len(angle), 3))
        velocity[:, first], velocity[:, second] = -direction * np.sin(angle), direction * np.cos(angle)
        tip = tip + 0.5 * np.array(REVERSAL_MM) * np.sign(np.round(velocity, 9))
        length = np.linalg.norm(tip - (centre + [0.02, -0.03, 0.01]), axis=1)
        length += 0.5 * RADIUS_MM * mismatch * direction * np.sin(2 * angle) + 0.004
        parts.append(
            (angle, length - RADIUS_MM + rng.normal(0.0, NOISE_MM, len(angle)), np.full(len(angle), direction))
        )
    angle, deviation, direction = (np.concatenate(item) for item in zip(*parts, strict=True))
    count = len(angle)
    ones = np.ones(count, dtype=np.int64)
    place = np.tile(centre if known_centre else np.full(3, np.nan), (count, 1))
    number = list(PLANES).index(plane)
    return Circles(
        number * ones,
        angle,
        RADIUS_MM * np.ones(count),
        deviation,
        direction,
        ones,
        0 * ones,
        place,
        np.full(count, np.nan),
    )


def file_of(folder, circles, name):
    path = folder / f"{name}.circle.csv"
    path.write_text(format_circles(circles))
    return path


def unknowns(found, what):
    return {item["of"]: (item["value"], item["u"]) for item in found.details["unknowns"] if item["what"] == what}


def test_three_planes_give_squareness_and_reversal_with_their_uncertainty(tmp_path, machine):
    errors = errors_of(machine)
    paths = [file_of(tmp_path, readings(machine, errors, plane, mismatch=30e-6), plane) for plane in PLANES]
    circles = read_circles(paths)
    assert circles.planes == ("XY", "YZ", "ZX")
    found = identify_circles(machine, circles)
    assert found.errors.names == ("EC0Y", "EB0Z", "EA0Z")
    for name, (value, u) in found.errors.squareness.items():
        assert 0 < u < 2e-6
        assert abs(value - SQUARENESS[name]) < 4 * u + 1e-6  # bows tilt the axes slightly at the circle
    for axis, value in enumerate(REVERSAL_MM):
        curve = found.reversal_curves.curves[axis, axis]
        assert curve.value[0] == pytest.approx(value, abs=4 * curve.u[0] + 1e-5)
    scales = unknowns(found, "scales")
    assert next(value for name, (value, _) in scales.items() if name.startswith("XY")) == pytest.approx(35.0, abs=1.0)
    assert all(value == pytest.approx(30.0, abs=1.0) for value, _ in unknowns(found, "servo mismatch").values())


def test_the_uncertainty_covers_the_truth_as_often_as_it_says(machine):
    errors = errors_of(machine)
    # the circle shows the axes at its position: there, at x = 20, the bow of X tilts it towards Y
    local = SQUARENESS["EC0Y"] - 2 * 2e-8 * 20.0
    standard = []
    for seed in range(30):
        found = identify_circles(machine, readings(machine, errors, "XY", seed=seed))
        value, u = found.errors.squareness["EC0Y"]
        standard.append((value - local) / u)
    assert 0.4 < np.sqrt(np.mean(np.square(standard))) < 1.6


def test_one_direction_is_said_to_hold_the_servo_mismatch(machine):
    errors = errors_of(machine)
    with pytest.warns(CompgenWarning, match="XY was measured in one direction only"):
        found = identify_circles(machine, readings(machine, errors, "XY", mismatch=30e-6, directions=(1,)))
    sign = -1.0 if machine.squareness_reference == "X" else 1.0
    assert found.errors.squareness["EC0Y"][0] == pytest.approx(SQUARENESS["EC0Y"] + sign * 30e-6, abs=2e-6)


def test_circles_at_two_places_of_one_set_up_have_a_centre_each(machine):
    """Both are in one file without set-up numbers; the pivot is off by something else at each."""
    errors = errors_of(machine)
    first, second = readings(machine, errors, "XY"), readings(machine, errors, "XY", seed=2)
    second.centre_mm[:, 0] += 30.0
    second.deviation_mm[:] += 0.05 * np.cos(second.angle_rad) - 0.02
    names = ("plane", "angle_rad", "radius_mm", "deviation_mm", "direction", "run", "setup", "centre_mm", "u_mm")
    both = Circles(**{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names})
    found = identify_circles(machine, both)
    value, u = found.errors.squareness["EC0Y"]
    assert abs(value - SQUARENESS["EC0Y"]) < 4 * u + 1e-6
    assert found.rms_um < 1.2e3 * NOISE_MM
    assert len(unknowns(found, "centre")) == 4


@pytest.mark.parametrize("arc", [(10.0, 240.0), (0.0, 180.0)])
def test_arcs_tell_squareness_with_a_larger_uncertainty(machine, arc):
    errors = errors_of(machine)
    whole = identify_circles(machine, readings(machine, errors, "XY"))
    part = identify_circles(machine, readings(machine, errors, "XY", arc=arc))
    value, u = part.errors.squareness["EC0Y"]
    assert abs(value - SQUARENESS["EC0Y"]) < 4 * u + 1e-6
    assert u > whole.errors.squareness["EC0Y"][1]


def test_a_laser_and_circles_make_tables_in_one_command(tmp_path, machine, capsys):
    errors = errors_of(machine)
    paths = [file_of(tmp_path, readings(machine, errors, plane), plane) for plane in PLANES]
    runs = tmp_path / "x.axis.csv"
    rows = [
        f"X,{x},{way},{run},{20e-3 * x + 7.0:.4f}" for run in (1, 2, 3) for way in (1, -1) for x in range(-250, 251, 50)
    ]
    runs.write_text("axis,position_mm,direction,run,deviation_um\n" + "\n".join(rows) + "\n")
    out = tmp_path / "out"
    words = [
        "run",
        str(machine.source),
        str(runs),
        *map(str, paths),
        "--controller",
        "isg-csv",
        "--out",
        str(out),
        "--no-report",
    ]
    assert run_command(cli, words) == 0
    result = json.loads((out / "result.json").read_text())
    # a circle of 200 mm shows a squareness over 500 mm as far as guides are straight there
    assert "EXX" in result["measured"]["errors"]
    assert result["verdict"] == "accepted_with_reservations"
    found = compgen.read_errors(out / "identified.errors.csv")
    for name, true in SQUARENESS.items():
        value, u = found.squareness[name]
        assert abs(value - true) < 2.0 * u, name
        assert 5e-6 < u < 40e-6  # of noise alone it is 1 urad; 40 urad are assumed without any reading
    assert set(result["not_measured"]) == set(observable_errors(machine)) - set(found.names)
    text = (out / "identified.reversal.csv").read_text()
    assert "Y,Y,,4.0" in text or "Y,Y,,3.9" in text


def test_files_say_what_is_wrong_with_them(tmp_path, machine):
    good = format_circles(readings(machine, errors_of(machine), "XY"))
    for text, message in (
        (good.replace("XY,", "YX,", 1), "'YX' is not a plane; expected XY, YZ or ZX"),
        (good.replace(",100.000000,", ",0.000000,", 1), "0 is not a radius"),
        (good.replace("centre_z_mm", "temp_z_c"), "give centre_x_mm, centre_y_mm and centre_z_mm"),
    ):
        path = tmp_path / "bad.circle.csv"
        path.write_text(text)
        with pytest.raises(InputError) as found:
            read_circles(path)
        assert message in str(found.value)
    far = readings(machine, errors_of(machine), "XY")
    far.centre_mm[:, 0] = 200.0
    with pytest.raises(InputError, match="the circle leaves the travel; check centre and radius"):
        identify_circles(machine, far)
    with pytest.warns(CompgenWarning, match="middle of the travel"):
        identify_circles(machine, readings(machine, errors_of(machine), "XY", known_centre=False))
    with pytest.raises(UndeterminedError, match="too short"):
        identify_circles(machine, readings(machine, errors_of(machine), "XY", arc=(0.0, 3.0), directions=(1,)))


def one_arc_each_way(machine, errors):
    """Planes XY and YZ, short arcs that differ in both directions: the reversal of Y is shared and hardly determined."""
    names = ("plane", "angle_rad", "radius_mm", "deviation_mm", "direction", "run", "setup", "centre_mm", "u_mm")
    arcs = {("XY", 1): (-100, -60), ("XY", -1): (60, 180), ("YZ", 1): (-60, -20), ("YZ", -1): (-80, 20)}
    parts = [
        readings(machine, errors, plane, arc=arc, directions=(way,), seed=seed)
        for seed, ((plane, way), arc) in enumerate(arcs.items())
    ]
    return Circles(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def test_planes_keep_their_joint_covariance_beside_other_measurements(tmp_path, machine):
    """The squareness errors of two planes share the reversal of Y, and so the readings that show it."""
    errors = errors_of(machine)
    circles = read_circles(file_of(tmp_path, one_arc_each_way(machine, errors), "both"))
    alone = identify_circles(machine, circles)
    covariance = alone.values_factor @ alone.values_factor.T
    runs = tmp_path / "x.axis.csv"
    rows = [
        f"X,{x},{way},{run},{20e-3 * x + 0.1 * run:.4f}"
        for run in (1, 2, 3)
        for way in (1, -1)
        for x in range(-250, 251, 50)
    ]
    runs.write_text("axis,position_mm,direction,run,deviation_um\n" + "\n".join(rows) + "\n")
    measured = open_measurement([runs])
    with pytest.warns(CompgenWarning, match="positioning runs of X show EXX"):
        laser = Source("x", measured, identify_axis_runs(machine, measured))
    together = identify_together(machine, [Source("c", circles, alone), laser], IdentifyOptions())
    names, _ = together.errors.labels()
    own = [names.index(name) for name in ("EC0Y", "EA0Z")]
    factor = together.values_factor
    np.testing.assert_allclose((factor @ factor.T)[np.ix_(own, own)], covariance, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(factor, axis=1), together.errors.uncertainties(), rtol=1e-9)
    assert not (factor @ factor.T)[own][:, names.index("EXX")].any()
    assert abs(covariance[0, 1]) > 0.1 * np.sqrt(covariance[0, 0] * covariance[1, 1])


def test_tables_that_were_active_are_taken_out_of_circles(tmp_path, least_squares):
    """The tables move the axes before the machine errs: commands p + c(p) by their text, the tip by the exact model."""
    machine = least_squares
    errors = errors_of(machine)
    wrong = {name: 0.7 * value + 9e-6 for name, value in SQUARENESS.items()}  # tables of an earlier measurement
    old = ErrorTable({"EXX": errors.curves["EXX"]}, {name: (value, 0.0) for name, value in wrong.items()})
    files = compgen.export(machine, old, "isg-csv").write(tmp_path)
    active = read_active(machine, files, "isg-csv")
    parts = []
    for plane in PLANES:
        bare = readings(machine, errors, plane)
        position, tip = circle_positions(machine, bare), []
        added = active.correction(machine, Points(position, approach=bare.travel()))
        centre = np.array([20.0, -10.0, 30.0]) + [0.02, -0.03, 0.01]
        for command in (position, position + added):
            tip.append(np.linalg.norm(tip_position(machine, errors.at(command), command, np.zeros(3)) - centre, axis=1))
        parts.append(replace(bare, deviation_mm=bare.deviation_mm + tip[1] - tip[0]))
    paths = [file_of(tmp_path, part, f"{k}-on") for k, part in enumerate(parts)]
    circles = read_circles(paths)
    with_tables = identify_bare(machine, circles)
    found = identify_bare(machine, circles, active=active)
    bare = identify_circles(machine, read_circles([file_of(tmp_path, readings(machine, errors, p), p) for p in PLANES]))
    for name, value in SQUARENESS.items():
        assert abs(found.errors.squareness[name][0] - value) < 2e-6
        assert found.errors.squareness[name][0] == pytest.approx(bare.errors.squareness[name][0], abs=5e-8)
        assert abs(with_tables.errors.squareness[name][0] - value) > 15e-6
    assert found.corrections["active_tables"]["controller"] == "isg-csv"
    assert found.corrections["active_tables"]["largest_correction_um"] > 5.0
