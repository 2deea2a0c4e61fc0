"""Text exports of ballbar programs: columns over the angle, in several forms; the readings come from a formula of this file."""

import json

import numpy as np
import pytest

import compgen
from compgen.data.circles import read_circles
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, import_file, open_measurement
from compgen.identification.axis_tests import identify_circles

STEPS = np.arange(0, 360, 3)


def reading_um(angle_deg, direction):
    """Off centre by 20 and -8 um, out of round by 5 um, different in both directions."""
    t = np.radians(angle_deg)
    return 20.0 * np.cos(t) - 8.0 * np.sin(t) + 5.0 * np.sin(2 * t) * direction + 3.0


def rows(separator=";", decimal=".", turn=1):
    for direction, word in ((1, "CCW"), (-1, "CW")):
        for angle in STEPS[::direction]:
            value = f"{reading_um(angle, direction):.4f}".replace(".", decimal)
            yield separator.join([str(angle if direction > 0 else turn * angle), value, word])


def written(folder, text, name="test.txt"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def check(circles, plane="XY", radius_mm=150.0):
    assert circles.planes == (plane,)
    assert (circles.radius_mm == radius_mm).all()
    assert len(circles) == 2 * len(STEPS)
    assert sorted(set(circles.direction.tolist())) == [-1, 1]
    angle = np.degrees(circles.angle_rad)
    np.testing.assert_allclose(1e3 * circles.deviation_mm, reading_um(angle, circles.direction), atol=1e-3)


def test_a_row_for_each_reading(tmp_path):
    head = "Plane: YZ\nRadius: 150 mm\nOperator: A. Miller\n\nAngle [deg];Deviation [um];Direction\n"
    item = import_file(written(tmp_path, head + "\n".join(rows())))
    assert item.kind == "circle" and item.doubts == ()
    assert item.data.metadata["operator"] == "A. Miller"
    check(item.data, "YZ")
    path = tmp_path / item.file_name
    path.write_text(item.files()[item.file_name])
    check(read_circles(path), "YZ")


def test_a_column_for_each_direction_in_german(tmp_path):
    lines = [
        f"{angle};{reading_um(angle, 1):.4f};{reading_um(angle, -1):.4f}".replace(".", ",") for angle in STEPS.tolist()
    ]
    head = "Ebene: G17\nWinkel [°];Gegenuhrzeigersinn [µm];Uhrzeigersinn [µm]\n"
    item = import_file(written(tmp_path, head + "\n".join(lines)), ImportOptions(radius_mm=150.0))
    assert item.doubts == ()
    check(item.data)


def test_measured_radii_in_radians(tmp_path):
    lines = [
        f"{np.radians(angle):.8f},{150.0 + 1e-3 * reading_um(angle, way):.7f},{word}"
        for way, word in ((1, "counter-clockwise"), (-1, "clockwise"))
        for angle in STEPS.tolist()
    ]
    head = "Angle [rad],Radius [mm],Direction\n"
    item = import_file(written(tmp_path, head + "\n".join(lines)), ImportOptions(radius_mm=150.0, plane="ZX"))
    assert item.doubts == ()
    check(item.data, "ZX")


def test_what_is_missing_is_asked_and_nothing_is_written(tmp_path, call, listing):
    path = written(tmp_path, "Angle [deg];Deviation [um]\n" + "\n".join(f"{a};{reading_um(a, 1):.4f}" for a in STEPS))
    before = listing(tmp_path)
    code, out, err = call("import", path, "--out", tmp_path / "o")
    assert code == 2
    for option in ("--plane", "--radius-mm", "--map direction"):
        assert option in out + err
    assert listing(tmp_path) == before
    head = "Plane: XZ\nRadius: 150 mm\nAngle [deg];Deviation [um];Direction\n"
    assert (
        "does not state the plane as XY, YZ or ZX" in import_file(written(tmp_path, head + "\n".join(rows()))).doubts[0]
    )


def test_the_command_writes_the_native_file(tmp_path, call):
    path = written(tmp_path, "Angle [deg];Deviation [um];Direction\n" + "\n".join(rows()))
    code, out, _ = call("import", path, "--plane", "XY", "--radius-mm", "150", "--out", tmp_path / "o", "--json")
    assert code == 0 and json.loads(out)["kind"] == "circle"
    check(read_circles(tmp_path / "o" / "test.circle.csv"))


def test_clockwise_angles_that_count_backwards_are_asked_about(tmp_path):
    """The centre is at (20, -8) um in one direction and, with the angles mirrored, at (20, 8) in the other."""
    head = "Plane: XY\nRadius: 150 mm\nAngle [deg];Deviation [um];Direction\n"
    path = written(tmp_path, head + "\n".join(rows(turn=-1)))
    assert any("mirrored" in text and "--directions labels" in text for text in import_file(path).doubts)
    assert import_file(path, ImportOptions(directions="labels")).doubts == ()


@pytest.mark.parametrize(
    ("head", "replaced", "message"),
    [
        (
            "Angle [deg];Deviation [um];Direction",
            ("CCW", "left"),
            "'left' is not a direction; write CCW or CW, 1 or -1",
        ),
        ("Angle [deg];Feedback [um];Direction", ("", ""), "no column is recognised as actual"),
    ],
)
def test_what_is_not_understood_is_refused(tmp_path, head, replaced, message):
    text = "Plane: XY\nRadius: 150 mm\n" + head + "\n" + "\n".join(rows())
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, text.replace(*replaced) if replaced[0] else text))


def test_an_unknown_column_of_numbers_is_a_question(tmp_path):
    lines = [f"{line};{k}.5" for k, line in enumerate(rows())]
    head = "Plane: XY\nRadius: 150 mm\nAngle [deg];Deviation [um];Direction;Gizmo\n"
    path = written(tmp_path, head + "\n".join(lines))
    item = import_file(path)
    assert any("Gizmo" in text for text in item.doubts)
    assert import_file(path, ImportOptions(ignore=("Gizmo",))).doubts == ()


def test_tables_of_axes_with_an_angle_are_as_before(tmp_path):
    text = "Axis: X\nPosition [mm];Deviation [um];Direction;Angle [deg]\n0;1.0;+;5\n100;2.0;+;5\n200;3.5;+;5\n"
    assert import_file(written(tmp_path, text)).kind == "axis"


SHOP = (
    "Ballbar test report\nMachine:\tVMC 850\nTest plane:\t{plane}\nTest radius:\t150.0000 mm\n"
    "Feedrate:\t1000 mm/min\n\nAngle (deg)\tRun 1 CCW (um)\tRun 2 CW (um)\n"
)


def printed(angle_deg, squareness_urad):
    """Radial deviation of a circle of 150 mm whose axes are not square, um: R - R/2 s sin 2t."""
    return -0.5 * 150e-3 * squareness_urad * np.sin(2 * np.radians(angle_deg))


def shop_file(tmp_path, plane, squareness_urad, name):
    angle = np.arange(0, 360, 5)
    rows = "".join(f"{t}\t{d:.3f}\t{d:.3f}\n" for t, d in zip(angle, printed(angle, squareness_urad), strict=True))
    path = tmp_path / name
    path.write_text(SHOP.format(plane=plane) + rows)
    return path


@pytest.mark.parametrize(
    ("plane", "number"),
    [("XY", 0), ("X-Y", 0), ("Y/Z", 1), ("YZ plane", 1), ("G18 (ZX)", 2), ("ZX", 2)],
)
def test_test_plane_and_test_radius_are_read_as_programs_and_people_write_them(tmp_path, plane, number):
    item = import_file(shop_file(tmp_path, plane, 30.0, "b.txt"))
    assert item.doubts == ()
    assert set(item.data.plane) == {number}
    assert set(item.data.radius_mm) == {150.0}


@pytest.mark.parametrize("plane", ["XZ", "G17 YZ", "vertical", "Z-Y"])
def test_a_plane_that_counts_the_other_way_or_is_unclear_is_asked(tmp_path, plane):
    (doubt,) = import_file(shop_file(tmp_path, plane, 30.0, "b.txt")).doubts
    assert "--plane" in doubt


def test_ballbar_texts_go_straight_into_an_identification_with_their_signs(tmp_path):
    files = [shop_file(tmp_path, "XY", 40.0, "a.txt"), shop_file(tmp_path, "?", -25.0, "b.txt")]
    with pytest.warns(CompgenWarning):
        circles = open_measurement(files, answers=ImportOptions(plane="YZ"))
    assert circles.planes == ("XY", "YZ")
    assert sorted(set(circles.setup)) == [0, 1]
    with pytest.warns(CompgenWarning, match="centres"):
        found = identify_circles(compgen.load_machine("zha-gantry"), circles).errors.squareness
    assert [found["EC0Y"][0], found["EA0Z"][0]] == pytest.approx([40e-6, -25e-6], abs=0.2e-6)


def test_an_answer_is_for_the_file_that_asks_and_never_replaces_what_another_one_states(tmp_path):
    files = [shop_file(tmp_path, "XY", 40.0, "a.txt"), shop_file(tmp_path, "YZ", -25.0, "b.txt")]
    with pytest.raises(InputError, match="no file asks this"):
        open_measurement(files, answers=ImportOptions(plane="ZX"))
    with pytest.raises(InputError, match="states the plane 'XY'"):
        open_measurement(files[:1], answers=ImportOptions(plane="ZX"))
    native = tmp_path / "a.circle.csv"
    native.write_text(import_file(files[0]).files()["a.circle.csv"])
    with pytest.raises(InputError, match="native format"):
        open_measurement([native], answers=ImportOptions(plane="XY"))


def test_one_direction_may_stand_above_the_table(tmp_path):
    path = written(
        tmp_path, "Plane: ZX\nRadius: 100mm\nDirection: CW\nAngle [deg];Deviation [um]\n0;1\n90;2\n180;1\n270;2\n"
    )
    assert set(import_file(path).data.direction) == {-1}
