"""What a machine leaves on a part: features against exact geometry, uncertainty against many drawn machines."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from programs.make import mill
from virtual_shop import drawn_truth, of_the_prior

import compgen
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.files import json_text
from compgen.data.names import AXES
from compgen.data.prior import PriorSettings
from compgen.errors import InputError
from compgen.identification.covariance import covariance_of_values, covariance_or_independent
from compgen.kinematics import exact_error
from compgen.programs import CorrectOptions, PartMachine, Setup, correct_program, model_of, predict_part, rank_machines
from compgen.programs.path import PLANE_AXES, ExactModel
from compgen.report.part_page import part_page
from compgen.tables import export, read_tables
from machines import machine_of

SETUP = Setup({"G54": (100.0, 100.0, -80.0)}, {"1": (0.0, 0.0, 20.0)}, gauge_mm=(0.0, 0.0, -50.0))
PART = """%
O1
G21 G90 G17 G40 G80 G54 T1 M6
G0 G43 H1 Z50.
G98 G81 X10. Y10. Z-5. R2. F90
X90.
Y90.
G80
G0 X20. Y20.
Z2.
G1 Z-3. F100
X80.
Y80.
X20.
Y20.
G0 Z5.
X65. Y50.
G1 Z-3.
G3 I-15. J0. F200
G0 Z50.
M30
%
"""


def unassuming():
    """The mill without a prior: only errors that are given have an uncertainty."""
    return replace(mill(), prior=PriorSettings(class_name="none"))


def predicted(tmp_path, errors, machine=mill, **more):
    program = tmp_path / "part<1>.nc"
    program.write_text(PART)
    found = predict_part(model_of(machine(), errors, None), program, "fanuc", SETUP, **more)
    return found, {(item.name, item.quantity): item for item in found.features}


def test_a_scale_and_a_squareness_by_hand(tmp_path):
    """X is 100 um/m too long, EC0Y = 30 urad opens the angle of +X and +Y: the corner at their origin by 30 urad."""
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EXX": Curve(ends, 100e-6 * ends, np.zeros(2))}, {"EC0Y": (30e-6, 0.0)})
    found, features = predicted(tmp_path, errors)
    assert features["hole 1 to 2", "distance"].error == pytest.approx(8.0, abs=1e-3)
    assert features["hole 2 to 3", "distance"].error == pytest.approx(0.0, abs=1e-3)
    assert features["circle 1", "diameter"].error == pytest.approx(30.0 * 0.1 / 2, abs=1e-3)  # the mean diameter
    corners = [item for (name, _), item in features.items() if name.startswith("corner")]
    assert [item.line for item in corners] == [13, 14, 15, 12]
    assert [item.error for item in corners] == pytest.approx([-30.0, 30.0, -30.0, 30.0], abs=0.02)
    widths = [item for (name, what), item in features.items() if name.startswith("sides") and what == "distance"]
    assert {(item.nominal, round(item.error, 2)) for item in widths} == {(60.0, 6.0), (60.0, 0.0)}
    # the radius of a circle of 15 mm changes by 0.75 + 0.75 cos 2t um, and by 0.225 sin 2t
    assert features["circle 1", "roundness"].error == pytest.approx(2 * np.hypot(0.75, 0.225), rel=5e-3)
    assert features["hole 3", "position X from hole 1"].error == pytest.approx(8.0 - 80 * 0.03, abs=1e-3)
    assert features["hole 3", "position Y from hole 1"].nominal == 80.0
    assert np.isnan(features["hole 1 to 2", "distance"].u)
    assert found.figures.length_mm == pytest.approx(3 * 7 + 5 + 4 * 60 + 8 + 30 * np.pi, abs=1e-6)


def test_features_are_those_of_points_on_the_exact_machine(tmp_path, make_errors):
    """Circle and sides fitted to points that the exact machine makes, by least squares."""
    errors = make_errors(mill(), 4)
    _, features = predicted(tmp_path, errors)
    tool = np.array([0.0, 0.0, -70.0])
    angle = np.linspace(0, 2 * np.pi, 721)[:-1]
    z = np.full_like(angle, -63.0)
    nominal = np.stack([150.0 + 15.0 * np.cos(angle), 150.0 + 15.0 * np.sin(angle), z], axis=1)
    real = nominal + exact_error(mill(), errors, nominal, tool)
    columns = np.stack([2 * real[:, 0], 2 * real[:, 1], np.ones(720)], axis=1)
    cx, cy, c = np.linalg.lstsq(columns, (real[:, :2] ** 2).sum(axis=1), rcond=None)[0]
    diameter = 2 * np.sqrt(c + cx**2 + cy**2)
    assert features["circle 1", "diameter"].error == pytest.approx(1e3 * (diameter - 30.0), abs=0.01)
    assert features["circle 1", "position X"].error == pytest.approx(1e3 * (cx - 150.0), abs=0.01)
    assert features["circle 1", "position Y"].error == pytest.approx(1e3 * (cy - 150.0), abs=0.01)
    share = np.linspace(0, 1, 400)[:, None]

    def slope(first, second):
        at = np.array(first) + share * (np.array(second) - np.array(first))
        x, y = (at + exact_error(mill(), errors, at, tool))[:, :2].T
        along = 0 if abs(second[0] - first[0]) > 1 else 1
        return np.polyfit(*((x, y) if along == 0 else (y, x)), 1)[0]

    bottom, right = slope((120, 120, -63.0), (180, 120, -63.0)), slope((180, 120, -63.0), (180, 180, -63.0))
    # +X turns by its slope, +Y by minus that of x over y; the angle between -X and +Y
    assert features["corner 1", "angle"].error == pytest.approx(1e6 * (bottom + right), abs=0.6)


def milled(plane=2):
    """A part with all that is recognised, milled in any plane: A, B are the axes of the plane, C is normal to it.

    Two levels of a pocket with round corners, entered within its long side; circles of two halves, of short lines, of a
    helix, in two passes; a face of rows with steps, and one of single rows.
    """
    lines = ["G21 G90 G40 G54 G0 X0 Y0 Z0", f"G{19 - plane} G94 F500"]
    for level in (-4, -12):
        lines += ["G0 C5", "G0 A0 B0", f"G1 C{level}", "G1 B-20", "G1 A25"]
        for (a, b), (x, y), (i, j) in zip(
            ((30, -15), (25, 20), (-30, 15), (-25, -20)),
            ((30, 15), (-25, 20), (-30, -15), (0, -20)),
            ((0, 5), (-5, 0), (0, -5), (5, 0)),
            strict=True,
        ):
            lines += [f"G3 A{a} B{b} I{i} J{j}", f"G1 A{x} B{y}"]
    lines += ["G0 C5", "G0 A60 B0", "G1 C-3", "G3 A80 I10 J0", "G3 A60 I-10 J0", "G0 C5", "G0 A60 B40", "G1 C-2"]
    angle = 2 * np.pi * np.arange(1, 73) / 72
    lines += [f"G1 A{72 - 12 * np.cos(t):.5f} B{40 - 12 * np.sin(t):.5f}" for t in angle]
    lines += ["G0 C5", "G0 A-60 B0", "G1 C0", "G2 A-60 B0 C-3 I-8 J0", "G2 A-60 B0 C-6 I-8 J0", "G0 C5"]
    lines += ["G0 A-70 B50", "G1 C-3", "G1 A-68", "G3 A-68 B50 I-2 J0", "G1 A-65", "G3 A-65 B50 I-5 J0", "G0 C5"]
    lines += ["G0 A0 B60", "G1 C1"]
    lines += [text for k in range(6) for text in (f"G1 A{50 * ((k + 1) % 2)}", f"G1 B{63 + 3 * k}")]
    for k in range(5):
        lines += ["G0 C5", f"G0 A-50 B{-60 - 4 * k}", "G1 C2", "G1 A0"]
    words = dict(
        zip(
            "ABCIJ",
            [*(AXES[k] for k in (*PLANE_AXES[plane], plane)), *("IJK"[k] for k in PLANE_AXES[plane])],
            strict=True,
        )
    )
    return "\n".join(["".join(words.get(c, c) for c in line) for line in lines] + ["G0 " + words["C"] + "5", "M2", ""])


def of_milled(tmp_path, errors, plane=2, machine=mill, **more):
    program = tmp_path / "milled.ngc"
    program.write_text(milled(plane))
    found = predict_part(
        model_of(machine(), errors, None), program, "linuxcnc", Setup({"G54": (150.0, 90.0, -60.0)}), **more
    )
    return {(item.name, item.quantity): item for item in found.features}


@pytest.mark.parametrize("plane", [0, 1, 2])
def test_features_in_every_plane_are_those_of_points_on_the_exact_machine(tmp_path, make_errors, plane):
    """Lines, circles and planes fitted to points that the exact machine makes, by polynomials and least squares."""
    errors, (a, b), where = make_errors(mill(), 6), PLANE_AXES[plane], (" in YZ", " in ZX", "")[plane]
    features = of_milled(tmp_path, errors, plane)
    zero, tool = np.array([150.0, 90.0, -60.0]), np.array(mill().tool_offset_mm)

    def real(points, level):
        at = np.zeros((len(points), 3))
        at[:, a], at[:, b], at[:, plane] = *np.transpose(points), level
        return at + zero + exact_error(mill(), errors, at + zero, tool)

    def slope(first, second, level=-12.0):
        """Of the deviation across the way, counter-clockwise, rad; its mean, mm."""
        at = np.array(first) + np.linspace(0, 1, 401)[:, None] * (np.array(second, dtype=float) - np.array(first))
        way = np.subtract(second, first) / np.linalg.norm(np.subtract(second, first))
        off = real(at, level)[:, [a, b]] - at - zero[[a, b]]
        across = off @ np.array([-way[1], way[0]])
        return np.polyfit(at @ way, across, 1)[0], across.mean()

    sides = [((30, -15), (30, 15)), ((25, 20), (-25, 20)), ((-30, 15), (-30, -15)), ((-25, -20), (25, -20))]
    (right, back, left, front), means = np.transpose([slope(*side) for side in sides])
    errors_of = {
        what: sorted(item.error for (name, kind), item in features.items() if kind == what)
        for what in ("angle", "distance", "parallelism", f"tilt over {AXES[plane]}")
    }
    corners = [right - back, back - left, left - front, front - right]
    assert errors_of["angle"] == pytest.approx(sorted(1e6 * np.array(corners)), abs=1.0)
    parallel = [30 * (left - right), 50 * (front - back)]
    assert errors_of["parallelism"] == pytest.approx(sorted(1e3 * np.array(parallel)), abs=0.05)
    for nominal, pair in ((60, means[[0, 2]]), (40, means[[1, 3]])):
        own = [item for (_, what), item in features.items() if what == "distance" and item.nominal == nominal]
        assert [item.error for item in own if item.name.startswith("sides")] == pytest.approx(
            [-1e3 * pair.sum()], abs=0.1
        )
    tilts = [
        (slope(*side, -4.0)[1] - slope(*side, -12.0)[1]) / 8.0 * sign
        for side, sign in zip(sides, (-1, -1, 1, 1), strict=True)
    ]
    assert errors_of[f"tilt over {AXES[plane]}"] == pytest.approx(sorted(1e6 * np.array(tilts)), abs=1.0)
    angle = np.linspace(0, 2 * np.pi, 721)[:-1]
    for k, (u, v, radius, level) in enumerate(
        ((70, 0, 10, -3), (72, 40, 12, -2), (-68, 0, 8, None), (-70, 50, 5, -3)), 1
    ):
        # which way a helix turns, and where, differs from plane to plane: only that it is found
        if level is None:
            assert features[f"circle {k}{where}", "diameter"].nominal == 16.0
            continue
        points = real(np.stack([u + radius * np.cos(angle), v + radius * np.sin(angle)], axis=1), level)[:, [a, b]]
        columns = np.column_stack([2 * points, np.ones(720)])
        x, y, c = np.linalg.lstsq(columns, (points**2).sum(axis=1), rcond=None)[0]
        radii = np.hypot(points[:, 0] - x, points[:, 1] - y)
        size, name = np.sqrt(c + x**2 + y**2), f"circle {k}{where}"
        assert features[name, "diameter"].error == pytest.approx(2e3 * (size - radius), abs=0.02)
        assert features[name, "roundness"].error == pytest.approx(1e3 * np.ptp(radii), abs=0.02)
        assert features[name, f"position {AXES[a]}"].error == pytest.approx(1e3 * (x - u - zero[a]), abs=0.02)
        assert features[name, f"position {AXES[b]}"].error == pytest.approx(1e3 * (y - v - zero[b]), abs=0.02)
    rows = np.array([[x, 60 + 3 * k] for k in range(6) for x in np.linspace(0, 50, 51)])
    points = real(rows, 1.0)
    columns = np.column_stack([points[:, [a, b]], np.ones(len(points))])
    left = points[:, plane] - columns @ np.linalg.lstsq(columns, points[:, plane], rcond=None)[0]
    assert features[f"milled face 1{where}", "flatness"].error == pytest.approx(1e3 * np.ptp(left), rel=0.1, abs=0.05)
    assert (f"milled face 2{where}", "flatness") in features


def test_tilt_of_a_wall_by_hand(tmp_path):
    """EB0Z = 40 urad: X grows with Z, so that a wall normal to X leans to plus by as much; one normal to Y stays upright."""
    sign = exact_error(
        mill(), ErrorTable({}, {"EB0Z": (40e-6, 0.0)}), np.array([[0, 0, 0], [0, 0, 100.0]]), np.zeros(3)
    )
    slope = 1e6 * (sign[1, 0] - sign[0, 0]) / 100.0
    assert abs(slope) == pytest.approx(40.0, abs=0.01)
    features = of_milled(tmp_path, ErrorTable({}, {"EB0Z": (40e-6, 0.0)}))
    tilts = [item.error for (_, what), item in features.items() if what == "tilt over Z"]
    assert sorted(np.abs(tilts)) == pytest.approx([0.0, 0.0, 40.0, 40.0], abs=0.01)
    assert max(tilts, key=abs) == pytest.approx(slope, abs=0.01)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        # six sides, and an ellipse of many short lines: no circles
        ([f"G1 X{20 * np.cos(t):.4f} Y{20 * np.sin(t):.4f}" for t in np.arange(7) * np.pi / 3], {"sides"}),
        ([f"G1 X{20 * np.cos(t):.4f} Y{19.9 * np.sin(t):.4f}" for t in np.arange(73) * np.pi / 36], set()),
        # three quarters of a circle, with the way to it and from it
        (["G1 X20 Y0", "G3 X0 Y-20 I-20 J0", "G1 X0 Y-40"], set()),
        # rows of a surface that rises: no face
        ([f"G1 X{30 * (k % 2)} Z{-k / 10}" for k in range(10)], set()),
        # a surface in short lines, flat in places, at several heights of the other axis: no sides, no walls
        (
            [
                f"G1 X{x:.3f} Y{8 * row} Z{15 * np.sin(x / 40):.3f}"
                for row in range(6)
                for x in (np.linspace(-90, 90, 181) if row % 2 else np.linspace(90, -90, 181))
            ],
            set(),
        ),
        # a side in three pieces is one side; a step of 90 degrees is a corner
        (["G1 X0 Y0", "G1 X4 Y0", "G1 X8 Y0", "G1 X30 Y0", "G1 Y30"], {"corner"}),
    ],
)
def test_what_is_no_feature(tmp_path, text, names):
    program = tmp_path / "p.ngc"
    start = text[0].replace("G1", "G0")
    program.write_text("\n".join(["G21 G90 G17 G54 G0 X0 Y0 Z0", start, "F100", *text[1:], "M2", ""]))
    found = predict_part(model_of(mill(), ErrorTable(), None), program, setup=Setup({"G54": (0.0, 0.0, 0.0)}))
    assert {item.name.split()[0] for item in found.features} == names


def test_holes_of_a_long_list_are_found_and_thinned(tmp_path):
    """250 holes under one cycle: 100 of them are evaluated, first and last too."""
    program = tmp_path / "p.ngc"
    holes = [f"X{k % 25}.5 Y{k // 25}.25" for k in range(250)]
    program.write_text(
        "\n".join(["G21 G90 G17 G54 G0 X0 Y0 Z5", "F100", "G81 X0.5 Y0.25 Z-3 R1", *holes, "G80", "M2", ""])
    )
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EXX": Curve(ends, 100e-6 * ends, np.zeros(2))})
    found = predict_part(model_of(mill(), errors, None), program, setup=Setup({"G54": (0.0, 0.0, 0.0)}))
    at = {item.name: item for item in found.features if item.quantity == "position X"}
    assert len(at) == 100
    assert found.left_out == 150
    assert at["hole 250"].error == pytest.approx(0.1 * 24.5, abs=1e-6)
    assert at["hole 1"].line == 4


def test_holes_along_y_have_their_places_in_z_and_x(tmp_path):
    """G18: X is 100 um/m too long, so that two holes 40 mm apart in X and 30 in Z are 3.2 um farther from each other."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "G21 G90 G17 G54 G0 X0 Y50 Z0\nG18 F100\nG81 X10 Z0 Y-3 R1\nX50 Z30\nG80\nG17 G0 Y60\nG0 Z60\nG81 X1 Y1 Z-3 R1\nM2\n"
    )
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EXX": Curve(ends, 100e-6 * ends, np.zeros(2)), "EYX": Curve(ends, 1e-3 * ends, np.zeros(2))})
    found = predict_part(model_of(mill(), errors, None), program, setup=Setup({"G54": (0.0, 0.0, 0.0)}))
    at = {(item.name, item.quantity): item.error for item in found.features}
    assert at["hole 1 in ZX", "position X"] == pytest.approx(1.0, abs=1e-6)
    assert at["hole 2 in ZX", "position Z from hole 1 in ZX"] == pytest.approx(0.0, abs=1e-9)
    assert at["hole 1 in ZX to 2", "distance"] == pytest.approx(0.8 * 4.0, abs=1e-6)
    assert at["hole 3", "position Y"] == pytest.approx(1.0, abs=1e-6)
    assert not any("position Y" in quantity for name, quantity in at if "ZX" in name)


def test_the_uncertainty_is_the_scatter_of_machines_drawn_from_it(tmp_path, make_errors):
    """Every quantity there is: errors drawn from a covariance with correlations, each evaluated on the exact machine."""
    errors = make_errors(mill(), 2)
    generator = np.random.default_rng(1)
    u = errors.uncertainties()
    factor = u[:, None] * generator.normal(size=(len(u), 12)) / np.sqrt(12)
    covariance = covariance_of_values(errors, np.hstack([factor, np.diag(0.3 * u)]))
    stated = {
        **predicted(tmp_path, errors, unassuming, covariance=covariance)[1],
        **of_milled(tmp_path, errors, machine=unassuming, covariance=covariance),
    }
    drawn = []
    for _ in range(300):
        values = errors.values() + covariance.errors_factor @ generator.normal(size=covariance.errors_factor.shape[1])
        machine = errors.with_values(values)
        found = {**predicted(tmp_path, machine)[1], **of_milled(tmp_path, machine)}
        drawn.append([found[key].error for key in stated])
    scatter, said = np.std(drawn, axis=0), np.array([item.u for item in stated.values()])
    kinds = {what.split()[0] for _, what in stated}
    assert kinds == {"position", "distance", "diameter", "roundness", "angle", "parallelism", "tilt", "flatness"}
    # what this chain cannot show to first order is below a thousandth of a micrometre
    shown = said > 1e-3
    assert scatter[~shown] == pytest.approx(said[~shown], abs=1e-3)
    assert shown.sum() > 40
    assert scatter[shown] / said[shown] == pytest.approx(np.ones(shown.sum()), abs=0.2)


def test_what_nobody_measured_is_in_the_uncertainty_as_machines_of_the_class_scatter(tmp_path):
    """Only EC0Y is known. Machines of class "general" are drawn by formulas of ``tests/virtual_shop.py``."""
    general = replace(mill(), prior=PriorSettings(class_name="general", learn="no"))
    known = ErrorTable({}, {"EC0Y": (20e-6, 0.5e-6)})
    covariance = covariance_or_independent(known, None, general.name)
    stated = predicted(tmp_path, known, lambda: general, covariance=covariance)[1]
    drawn, rng = [], np.random.default_rng(8)
    for _ in range(150):
        truth = drawn_truth(general, rng, of_the_prior, spread=0.0)
        every = {}
        for name, (at, value) in truth.curves.items():
            nodes = np.linspace(at[0], at[-1], 41)
            every[name] = Curve(nodes, np.interp(nodes, at, value), np.zeros(41))
        squareness = {name: (value, 0.0) for name, value in truth.squareness.items()} | known.squareness
        found = predicted(tmp_path, ErrorTable(every, squareness), unassuming)[1]
        drawn.append([found[key].error for key in stated])
    scatter, said = np.std(drawn, axis=0), np.array([item.u for item in stated.values()])
    shown = said > 0.1
    assert shown.sum() > 20
    # what is a range, never below zero, scatters less than its linear parts
    ranges = np.array([what.split()[0] in ("roundness", "parallelism", "flatness") for _, what in stated])
    ratio = scatter / np.where(shown, said, np.inf)
    assert ratio[shown & ~ranges] == pytest.approx(np.ones((shown & ~ranges).sum()), abs=0.25)
    assert np.all((ratio[shown & ranges] > 0.5) & (ratio[shown & ranges] < 1.25))


def holes_of(text):
    return np.array([[float(v) for v in re.search(r"X([-.\d]+)\D+Y([-.\d]+)", line).groups()] for line in text])


def test_a_corrected_program_and_tables_correct_nothing_twice(tmp_path, make_errors):
    """The holes of the program that `correct` writes, on the exact machine: as `part` says; and with tables active."""
    errors = make_errors(mill(), 3)
    program = tmp_path / "p.ngc"
    holes = [(10.0, 10.0), (90.0, 10.0), (90.0, 70.0)]
    cycle = [f"X{x} Y{y} Z-5 R2" for x, y in holes]
    program.write_text(
        "\n".join(["G21 G90 G17 G54 G0 X0 Y0 Z50", "F90", "G98 G81 " + cycle[0], *cycle[1:], "G80", "M2", ""])
    )
    setup = Setup({"G54": (100.0, 100.0, -60.0)})
    model = model_of(mill(), errors, None)
    made = export(mill(), errors, "siemens-eec", allow_unverified=True).write(tmp_path / "t")
    tables = read_tables(mill(), made, "siemens-eec")
    found = predict_part(model, program, "linuxcnc", setup, tables=tables, correct=CorrectOptions())
    active = PartMachine("m", model, tables=tables).with_tables
    assert np.abs([item.after - item.error for item in found.features]).max() > 2.0
    tool = np.array(mill().tool_offset_mm)
    for which, machine in (("corrected", model), ("both", active)):
        out = tmp_path / which
        assert correct_program(machine, program, out, CorrectOptions(), setup).accepted
        lines = [line for line in (out / "p.ngc").read_text().splitlines() if "R" in line and "X" in line]
        at = np.column_stack([holes_of(lines), [float(re.search(r"Z([-.\d]+)", line)[1]) for line in lines]])
        command = at + (100.0, 100.0, -60.0)
        real = command + machine.error(command, tool, np.tile([1.0, 1.0, -1.0], (3, 1)))
        for k, (x, y) in enumerate(holes):
            for axis, nominal in enumerate((x, y)):
                item = next(
                    f for f in found.features if (f.name, f.quantity) == (f"hole {k + 1}", f"position {'XY'[axis]}")
                )
                assert getattr(item, which) == pytest.approx(1e3 * (real[k, axis] - 100.0 - nominal), abs=1e-4)
        assert max(abs(getattr(item, which)) for item in found.features) < 0.02
    assert found.corrected.normal_mm < 1e-3 > found.both.normal_mm
    assert found.best is found.both
    assert {"path_corrected", "path_both"} <= set(found.as_dict())
    assert found.as_dict()["features"][0]["both_um"] == found.features[0].both


def test_the_best_fit_knows_no_clamping(tmp_path, make_errors):
    """A machine that is shifted and turned by rigid motion makes the same part; the ranking says so."""
    errors = make_errors(mill(), 3)
    nodes = errors.curves["EXX"].position_mm
    shift = Curve(nodes, errors.curves["EXX"].value + 0.2, np.zeros(len(nodes)))
    shifted = ErrorTable({**errors.curves, "EXX": shift}, errors.squareness)
    one, other = (predicted(tmp_path, table)[0] for table in (errors, shifted))
    assert other.figures.normal_mm > one.figures.normal_mm + 0.15
    # the angles of the chain act at other places by 0.2 mm
    assert other.rank_figures["max_um"] == pytest.approx(one.rank_figures["max_um"], rel=0.01)


def test_a_machine_that_is_too_small_comes_last(tmp_path, make_errors):
    program = tmp_path / "p.nc"
    program.write_text(PART)
    small = machine_of([(-600.0, 150.0), (-500.0, 500.0), (-400.0, 200.0)], 9, tool_offset_mm=(0.0, 0.0, -50.0))
    models = [ExactModel(machine, make_errors(machine, 4)) for machine in (small, mill(), mill())]
    machines = [PartMachine(f"m{k}", model) for k, model in enumerate(models)]
    ranked = rank_machines(machines, program, "fanuc", SETUP)
    assert [item.machine for item in ranked] == ["m1", "m2", "m0"]
    assert "outside its travel" in ranked[2].refused
    page = part_page(ranked[0], ranked)
    assert "Which machine makes this part best" in page
    assert "outside its travel" in page
    assert ranked[2].ranked() == {"machine": "m0", "refused": ranked[2].refused}


def test_the_page_holds_the_figures_and_escapes_names(tmp_path, make_errors):
    found, _ = predicted(tmp_path, make_errors(mill(), 1))
    page = part_page(found)
    assert ">part&lt;1&gt;.nc</h1>" in page
    assert "part<1>" not in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert len(data["at"]) == len(data["off"][0]) > 100
    assert f"{found.figures.as_dict()['max_um']:.2f}" in page
    assert json.loads(json_text(found.as_dict()))["features"][0]["name"] == "hole 1"


def test_long_programs_keep_few_points(tmp_path, monkeypatch):
    monkeypatch.setattr("compgen.programs.part.MOST_POINTS", 50)
    ends = np.array([-600.0, 600.0])
    found, _ = predicted(tmp_path, ErrorTable({"EXX": Curve(ends, 1e-4 * ends, np.zeros(2))}))
    assert 20 < len(found.position_mm) <= 51
    assert found.every == 4
    assert np.diff(np.unique(np.round(found.position_mm[:, 0]))).max() < 60


def test_the_command_ranks_machines_and_evaluates_tables(tmp_path, small_machine_file, small_errors, call):
    (tmp_path / "e.errors.csv").write_text(compgen.format_errors(small_errors))
    half = small_errors.with_values(0.5 * small_errors.values())
    (tmp_path / "half.errors.csv").write_text(compgen.format_errors(half))
    (tmp_path / "p.nc").write_text(PART)
    (tmp_path / "t.csv").write_text("tool,length_mm\n1,20\n")
    assert (
        call(
            "export", small_machine_file, tmp_path / "e.errors.csv", "--controller", "isg-csv", "--out", tmp_path / "t"
        )[0]
        == 0
    )
    words = ["part", small_machine_file, tmp_path / "p.nc", "--dialect", "fanuc", "--wcs", "G54=0,50,-120"]
    words += ["--tools", tmp_path / "t.csv", "--errors", tmp_path / "e.errors.csv"]
    more = ["--also", f"{small_machine_file}={tmp_path / 'half.errors.csv'}"]
    table = ["--tables", tmp_path / "t" / "volcomp0.csv", "--controller", "isg-csv"]
    code, out, _ = call(*words, *more, *table, "--uncertainty", "--json", "--out", tmp_path / "o")
    found = json.loads(out)
    assert code == 0
    first, second = found["machines"]
    assert first["normal_max_um"] == pytest.approx(0.5 * second["normal_max_um"], rel=1e-3)
    assert first["best_fit"]["max_um"] == pytest.approx(0.5 * second["best_fit"]["max_um"], rel=1e-3)
    assert found["path_after"]["max_um"] < 0.1 * found["path"]["max_um"]
    assert all(abs(item.get("after_um", 0.0)) < 1.0 for item in found["features"])
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"part.json", "part.html"}
    assert first["worst_um"]["name"]
    page = (tmp_path / "o" / "part.html").read_text()
    assert page.count(f'<td class="n">{first["normal_max_um"]:.2f}</td>') >= 1
    code, out, _ = call(*words, "--correct")
    assert code == 0
    assert "hole 1 to 2" in out
    assert "program corrected" in out
    for wrong, message in ((table[:2], "belong together"), (["--also", "m"], "MACHINE=ERRORS")):
        code, _, error = call(*words, *wrong)
        assert code == 2
        assert message in error


def test_a_program_that_cannot_be_followed_is_refused(tmp_path):
    program = tmp_path / "p.nc"
    program.write_text(PART.replace("X80.", "G16 X80."))
    with pytest.raises(InputError, match="polar") as caught:
        predict_part(model_of(mill(), ErrorTable(), None), program, "fanuc", SETUP)
    assert caught.value.line == 12


#: Contours with radius compensation (radius 5), and the same as paths of the tool centre.
BESIDE = {
    "pocket": (
        "G1 G41 D1 X0. Y-30. F200\nX30.\nY30.\nX-30.\nY-30.\nX0.\nG40 Y0.\n",
        "G1 X0. Y-25. F200\nX25.\nY25.\nX-25.\nY-25.\nX0.\nY0.\n",
    ),
    "outside": (
        "G1 G42 D1 X0. Y-30. F200\nX30.\nY30.\nX-30.\nY-30.\nX0.\nG40 Y-60.\n",
        "G1 X0. Y-35. F200\nX30.\nG3 X35. Y-30. I0. J5.\nG1 Y30.\nG3 X30. Y35. I-5. J0.\nG1 X-30.\nG3 X-35. Y30. I0. J-5.\n"
        "G1 Y-30.\nG3 X-30. Y-35. I5. J0.\nG1 X0.\nY-60.\n",
    ),
    "bore": (
        "G1 G41 D1 X20. Y0. F200\nG3 X20. Y0. I-20. J0.\nG1 G40 X0.\n",
        "G1 X15. Y0. F200\nG3 X15. Y0. I-15. J0.\nG1 X0.\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BESIDE)
def test_a_part_with_radius_compensation_is_that_of_the_path_of_the_tool_centre(tmp_path, make_errors, name):
    """Contour and path of the tool centre, posted by hand, give the same features with the same errors, also corrected."""
    errors = make_errors(mill(), 6)
    found = []
    for text in BESIDE[name]:
        program = tmp_path / "p.nc"
        program.write_text(
            f"%\nG21 G90 G17 G54\nG0 X0. Y0. Z5.\nG0 Y{-60 if name == 'outside' else 0}.\nG1 Z-5. F90\n{text}G0 Z20.\nM30\n%\n"
        )
        setup = Setup({"G54": (12.0, 7.0, -30.0)}, radii_mm={"1": 5.0})
        found.append(predict_part(model_of(mill(), errors, None), program, "fanuc", setup, correct=CorrectOptions()))
    beside, centre = found
    assert len(beside.features) == len(centre.features) >= 3
    for item, other in zip(beside.features, centre.features, strict=True):
        assert (item.name.split()[0], item.quantity) == (other.name.split()[0], other.quantity)
        assert item.nominal == pytest.approx(other.nominal, abs=1e-6)
        assert item.error == pytest.approx(other.error, abs=2e-3 * max(abs(other.error), 1.0))
        # three decimals of FANUC: 1 um, and 1 um over 50 mm
        assert abs(item.corrected) < (25.0 if item.quantity == "angle" else 1.5)
    assert beside.figures.normal_mm == pytest.approx(centre.figures.normal_mm, abs=1e-5)
    assert any("path of the tool centre" in text for text in beside.assumed)


def test_a_part_with_a_contour_that_has_no_path_is_refused_with_its_line(tmp_path):
    program = tmp_path / "p.nc"
    program.write_text(f"%\nG21 G90 G17 G54\nG0 X0. Y0. Z-5.\n{BESIDE['bore'][0]}M30\n%\n")
    offsets, curve = {"G54": (0.0, 0.0, 0.0)}, Curve(np.array([-600.0, 600.0]), np.array([-0.6, 0.6]), np.zeros(2))
    model = model_of(mill(), ErrorTable({"EXX": curve}), None)
    for setup, words in ((Setup(offsets, radii_mm={"1": 25.0}), "too large"), (Setup(offsets), "--tool-radius 5")):
        with pytest.raises(InputError, match=words) as caught:
            predict_part(model, program, "fanuc", setup)
        assert caught.value.line == 5


# --- errors that were not measured ---------------------------------------------------------------------------------


def positioning_only():
    """Positioning of X, Y, Z known to 0.5 um, nothing else."""
    curves = {}
    for axis, letter in zip(mill().axes, AXES, strict=True):
        at = axis.nodes_mm
        curves[f"E{letter}{letter}"] = Curve(at, 20e-6 * (at - at[0]), np.full(len(at), 0.5e-3))
    errors = ErrorTable(curves, {})
    return errors, covariance_of_values(errors, np.diag(errors.uncertainties()))


def test_what_was_not_measured_is_said_and_is_in_the_uncertainty_of_the_part(tmp_path):
    errors, covariance = positioning_only()
    found, features = predicted(tmp_path, errors, covariance=covariance)
    assert any("assumed for what was not measured" in text for text in found.notes)
    (share,) = (float(re.search(r"make (\d+) %", text)[1]) for text in found.notes if "what is not known" in text)
    assert 50.0 < share <= 100.0
    angles = [item.u for (_, quantity), item in features.items() if quantity == "angle"]
    assert min(angles) > 30.0, "an angle of the part follows squareness: 40 urad are assumed of it"
    bare, there = predicted(tmp_path, errors, unassuming, covariance=covariance)
    assert any(text.startswith("no prior") for text in bare.notes)
    assert all(there[key].u <= item.u + 1e-9 for key, item in features.items())


def test_a_part_of_errors_without_uncertainties_says_so(tmp_path):
    errors, _ = positioning_only()
    found, _ = predicted(tmp_path, errors)
    assert any("have no uncertainties" in text for text in found.notes)


def test_a_tool_longer_than_the_measured_one_is_less_certain(tmp_path):
    """What was measured with the tool of the machine file says less of one that is 200 mm longer."""
    errors, covariance = positioning_only()
    program = tmp_path / "part.nc"
    program.write_text(PART)
    model = model_of(mill(), errors, None)
    sizes = {}
    for longer_mm in (0.0, 200.0):
        setup = Setup({"G54": (100.0, 100.0, -80.0)}, {"1": (0.0, 0.0, 20.0 + longer_mm)}, gauge_mm=(0.0, 0.0, -50.0))
        found = predict_part(model, program, "fanuc", setup, covariance=covariance)
        sizes[longer_mm] = max(item.u for item in found.features if item.quantity == "flatness" or item.unit == "um")
    assert sizes[200.0] >= sizes[0.0]
