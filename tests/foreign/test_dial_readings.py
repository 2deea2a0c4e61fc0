"""Squares, straightedges, arms over a span and levels: readings made with the kinematic model, written down, read back."""

import functools

import numpy as np
import pytest

import compgen
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, import_file, open_measurement
from compgen.foreign.converted import given_errors

CORNER = np.array([-600.0, -700.0, -300.0])
SPAN = {"X": 300.0, "Y": 300.0, "Z": 200.0}
#: Squareness by the two axes of a square, and what the square has more than 90 degrees, rad, and how it lies.
PAIRS = {"EC0Y": "XY", "EB0Z": "XZ", "EA0Z": "YZ"}
SQUARE, LAY = 17e-6, 90e-6
TRUE = {"EC0Y": 40e-6, "EB0Z": -25e-6, "EA0Z": 60e-6}


@functools.cache
def errors_at(axis):
    """Error of the tip along a travel from the corner, at 0, 1/3, 2/3 and 3/3 of the span, (4, 3), mm."""
    machine = compgen.load_machine("zha-gantry")
    place = np.tile(CORNER, (4, 1))
    place[:, "XYZ".index(axis)] += np.linspace(0, SPAN[axis], 4)
    table = compgen.ErrorTable({}, {name: (value, float("nan")) for name, value in TRUE.items()})
    return compgen.predict(machine, table, compgen.Points(place), exact=True)


def arm(axis, towards, turn_rad, plunger=1):
    """Reading (um) along an edge that is turned by an angle from its axis towards the other axis of the pair."""
    away = errors_at(axis)[:, "XYZ".index(towards)]
    edge = turn_rad * np.linspace(0, SPAN[axis], 4)
    return 1e3 * plunger * (away - away[0] - edge)


def arms(name, turned=False, plungers=(1, 1)):
    """Readings along both arms. Turned over about its first arm, the second one points the other way."""
    first, second = PAIRS[name]
    square = -SQUARE if turned else SQUARE
    # the first edge leans towards the second axis by the lay, the second one away from the first by lay and square
    return arm(first, second, LAY, plungers[0]), arm(second, first, -(LAY + square), plungers[1])


def written(tmp_path, text, name="square.txt"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def table(heads, columns, top=""):
    span = np.linspace(0, 300, 4)
    rows = [";".join([f"{span[k]:g}", *(f"{column[k]:.4f}".replace(".", ",") for column in columns)]) for k in range(4)]
    return f"{top}{';'.join(heads)}\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize("plungers", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_two_arms_give_the_squareness_whichever_way_the_plunger_points(tmp_path, plungers):
    readings = arms("EC0Y", plungers=plungers)
    signs = ["+" if way > 0 else "-" for way in plungers]
    heads = ["Position [mm]", f"X arm (plunger {signs[0]}Y) [um]", f"Y arm (plunger {signs[1]}X) [um]"]
    text = table(heads, readings, f"Square error: {SQUARE * 1e6} ± 1 urad\nu: 0.5 um\n".replace(".", ","))
    item = import_file(written(tmp_path, text))
    assert item.doubts == ()
    value, u = item.data.squareness["EC0Y"]
    assert value == pytest.approx(40e-6, abs=0.05e-6)
    assert u == pytest.approx(np.sqrt(4 * (0.5e-3 / 300) ** 2 + 1e-12), rel=1e-6)


@pytest.mark.parametrize("name", PAIRS)
def test_a_square_turned_over_needs_no_certificate_on_any_pair_of_axes(tmp_path, name):
    first, second = PAIRS[name]
    lines = ["Travel;Plunger;Span [mm];Reading [um];State"]
    for turned, word in ((False, "normal"), (True, "reversed")):
        for axis, towards, reading in zip((first, second), (second, first), arms(name, turned), strict=True):
            lines.append(f"{axis};+{towards};{SPAN[axis]:g};{reading[-1]:.4f};{word}")
    item = import_file(written(tmp_path, "\n".join(lines) + "\n"))
    assert item.doubts == ()
    assert item.data.squareness[name][0] == pytest.approx(TRUE[name], abs=0.05e-6)
    assert any("reversal" in note for note in item.notes)


def test_a_german_record_with_a_column_for_each_arm(tmp_path):
    heads = ["Position [mm]", "X-Schenkel (Messtaster +Y) [µm]", "Y-Schenkel (Messtaster +X) [µm]",
             "X-Schenkel umgeschlagen (Messtaster +Y) [µm]", "Y-Schenkel umgeschlagen (Messtaster +X) [µm]"]  # fmt: skip
    path = written(tmp_path, table(heads, [*arms("EC0Y"), *arms("EC0Y", turned=True)], "Granitwinkel 300\n"))
    assert import_file(path).data.squareness["EC0Y"][0] == pytest.approx(40e-6, abs=0.05e-6)
    with pytest.warns(CompgenWarning):
        measured = open_measurement([path])
    found = given_errors(compgen.load_machine("zha-gantry"), measured).errors.squareness["EC0Y"]
    assert found[0] == pytest.approx(40e-6, abs=0.05e-6)


def test_the_certificate_of_the_square_counts_above_90_degrees_in_every_unit(tmp_path):
    heads = ["Position [mm]", "X arm (plunger +Y) [um]", "Y arm (plunger +X) [um]"]
    values = []
    for stated in ("17 urad", "5,1 um/300 mm", "3,5065 arcsec", "0,0051 mm/300"):
        path = written(tmp_path, table(heads, arms("EC0Y"), f"Error of the square: {stated}\n"))
        values.append(import_file(path).data.squareness["EC0Y"][0])
    assert values == pytest.approx([40e-6] * 4, abs=0.1e-6)
    bare = import_file(written(tmp_path, table(heads, arms("EC0Y"))))
    assert bare.data.squareness["EC0Y"][0] == pytest.approx(23e-6, abs=0.1e-6)
    assert bare.data.squareness["EC0Y"][1] > 5e-6  # never exact by silence


def test_a_straightedge_turned_over_gives_straightness_without_its_own_and_no_squareness(tmp_path):
    x = np.linspace(-800, 0, 9)
    machine, bow = 4.0 * np.sin(np.pi * x / 800), 2.5 * np.cos(np.pi * x / 400)
    rows = [f"{p:g};{m + b + 0.01 * p:.4f};{-m + b + 0.02 * p:.4f}" for p, m, b in zip(x, machine, bow, strict=True)]
    head = "Position [mm];along X (plunger +Y) [um];along X reversed (plunger -Y) [um]\n"
    item = import_file(written(tmp_path, head + "\n".join(rows) + "\n"))
    curve = item.data.curves["EYX"]
    line = np.polyfit(curve.position_mm, 1e3 * curve.value - machine, 1)
    assert np.abs(1e3 * curve.value - machine - np.polyval(line, x)).max() < 1e-3
    assert not item.data.squareness and "apart" in item.data.metadata["squareness"]


def test_a_level_on_the_spindle_side_and_on_the_table_have_opposite_signs(tmp_path):
    text = "{}X position [mm];Level along X [mm/m];Level along Y [mm/m]\n-800;0,000;0,000\n-400;0,010;0,005\n0;0,020;-0,004\n"
    asked = import_file(written(tmp_path, text.format("")))
    assert "--mounted" in asked.doubts[0]
    spindle = import_file(written(tmp_path, text.format("Level on: spindle\n"))).data.curves
    table_side = import_file(written(tmp_path, text.format("")), ImportOptions(mounted="table")).data.curves
    # docs: on the spindle side the end at +X rises by u over a length: EBX = -u / length; roll: the end at +Y rises: EAX > 0
    assert 1e6 * spindle["EBX"].value == pytest.approx([0, -10, -20])
    assert 1e6 * spindle["EAX"].value == pytest.approx([0, 5, -4])
    assert table_side["EBX"].value == pytest.approx(-spindle["EBX"].value)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("Position [mm];X arm (plunger Y) [um];Y arm (plunger +X) [um]", r"plunger \+Y"),
        ("Position [mm];X arm (plunger +X) [um];Y arm (plunger +X) [um]", "straightness of X"),
        ("Position [mm];arm (plunger +Y) [um];Y arm (plunger +X) [um]", "which axis moves"),
        ("Position [mm];X arm (plunger +Y);Y arm (plunger +X) [um]", "unit"),
        ("Position [mm];X arm (plunger +Y) [um];Something", "Something"),
        ("Nonsense;X arm (plunger +Y) [um];Y arm (plunger +X) [um]", "Position"),
    ],
)
def test_what_a_record_does_not_state_is_asked(tmp_path, head, message):
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, table(head.split(";"), arms("EC0Y"))))


def test_one_arm_over_a_span_is_no_squareness(tmp_path):
    path = written(tmp_path, "Travel;Plunger;Span [mm];Reading [um]\nZ;+X;200;6\n")
    with pytest.raises(InputError, match="other arm"):
        import_file(path)
    aligned = written(tmp_path, "Travel;Plunger;Span [mm];Reading [um]\nZ;+X;200;6\nX;+Z;300;0\n")
    assert import_file(aligned).data.squareness["EB0Z"][0] == pytest.approx(30e-6)


@pytest.mark.parametrize(
    "head", ["X arm (plunger +Y) [um];Y arm (plunger +X) [um]", "Level along X [um/m];Level along Y [um/m]"]
)
def test_a_position_that_occurs_twice_is_refused(tmp_path, head):
    path = written(tmp_path, f"Level on: table\nX position [mm];{head}\n100;1;1\n100;2;2\n")
    with pytest.raises(InputError, match="mean of repeats"):
        import_file(path)


ARMS = "X arm (plunger +Y) [um];Y arm (plunger +X) [um]"


@pytest.mark.parametrize(
    ("top", "place", "message"),
    [
        ("", "Position [deg]", "deg is not a unit of length"),
        ("u: -0.5 um\n", "Position [mm]", "u: '-0.5 um' is not the uncertainty"),
        ("u: nan um\n", "Position [mm]", "uncertainty"),
        ("u: 0 um\n", "Position [mm]", "uncertainty"),
        ("u: 2 urad\n", "Position [mm]", "uncertainty"),
        ("Messunsicherheit: gut\n", "Position [mm]", "uncertainty"),
        ("Square error: 3 +- -2 urad\n", "Position [mm]", "not an angle"),
        ("Square error: 3 um/300 in\n", "Position [mm]", "not an angle"),
    ],
)
def test_what_a_record_states_and_cannot_be_read_is_not_replaced_by_an_assumption(tmp_path, top, place, message):
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, table([place, *ARMS.split(";")], arms("EC0Y"), top)))


def test_a_span_is_a_length(tmp_path):
    text = "Travel;Plunger;Span [arcsec];Reading [um]\nX;+Y;300;5\nY;+X;300;-3\n"
    with pytest.raises(InputError, match="arcsec is not a unit of length"):
        import_file(written(tmp_path, text))


@pytest.mark.parametrize(
    "stated",
    [
        "u: 0.5 um",
        "U: 1 µm (k=2)",
        "u: 1 um (k = 2)",
        "Expanded uncertainty: 1 um",
        "Erweiterte Messunsicherheit: 1 µm",
        "u = 0.0005 mm",
    ],
)
def test_an_uncertainty_is_read_as_labs_write_it(tmp_path, stated):
    found = import_file(written(tmp_path, table(["Position [mm]", *ARMS.split(";")], arms("EC0Y"), f"{stated}\n")))
    assert any("uncertainty of a reading 0.5 um, as stated" in note for note in found.notes)


def test_the_stated_uncertainty_of_a_level_is_its_u(tmp_path):
    text = "Level on: spindle\n{}X position [mm];Level along X [mm/m]\n-800;0,000\n-400;0,010\n0;0,020\n"
    found = import_file(written(tmp_path, text.format("U: 0.01 mm/m (k=2)\n")))
    assert 1e6 * found.data.curves["EBX"].u == pytest.approx([5.0] * 3)
    with pytest.raises(InputError, match="uncertainty of a reading"):
        import_file(written(tmp_path, text.format("u: 3 um\n")))


@pytest.mark.parametrize("word", ["längs", "laengs", "entlang"])
def test_a_level_along_x_on_the_spindle_side_in_german(tmp_path, word):
    """The end at +X sinks by 0.02 mm/m over 400 mm: X turns right-handed about +Y by 20 urad."""
    path = tmp_path / "l.csv"
    path.write_text(
        f"X-Achse\nPosition [mm];Richtwaage {word} X [mm/m]\n0;0,00\n200;-0,01\n400;-0,02\n", encoding="utf-8"
    )
    item = import_file(path, ImportOptions(mounted="spindle"))
    assert {name: curve.value[-1] for name, curve in item.data.curves.items()} == pytest.approx({"EBX": 20e-6})
