"""Logs of measuring cycles with several lines for each feature, written here in the manner of controls, from a known part."""

import numpy as np
import pytest

from compgen.errors import InputError
from compgen.foreign import ImportOptions, import_file

PLATE = {f"H{i}{j}": (50.0 + 100.0 * i, 40.0 + 90.0 * j) for i in range(4) for j in range(3)}
PART = ImportOptions(kind="part", origin="0,0,0")


def as_measured(x, y):
    """A machine that travels 40 um/m too far in X and 25 um/m too little in Y made the part: the part is that."""
    return x * (1 + 40e-6), y * (1 - 25e-6)


def in_sections(name, x, y):
    """Sections of nominal values, limits and actual values, as the cycles 421 and 422 of HEIDENHAIN write them."""
    a, b = as_measured(x, y)
    parts = [f"Measuring log {name}, probing cycle 421\nDate: 30-06-2025\nTime: 6:55:04\n--------"]
    for heading, (one, other) in (
        ("Nominal values:", (x, y)),
        ("Actual values:", (a, b)),
        ("Deviations:", (a - x, b - y)),
    ):
        parts.append(
            f"{heading}\nCenter in reference axis: {one:.4f}\nCenter in minor axis: {other:.4f}\nDiameter: 12.0\n--------"
        )
        if heading == "Nominal values:":
            parts.append(f"Given limit values:\nMaximum limit for center in reference axis: {x + 0.1:.4f}\n--------")
    return "\n".join([*parts, "Further measuring results:\nMeasuring height: -5.0000\nEnd of measuring log"])


def in_german(name, x, y):
    a, b = as_measured(x, y)
    text = (
        f"Messprotokoll {name}\nSollwerte:\nMitte Hauptachse: {x:.4f}\nMitte Nebenachse: {y:.4f}\nDurchmesser: 12,0\n"
    )
    return (text + f"Istwerte:\nMitte Hauptachse: {a:.4f}\nMitte Nebenachse: {b:.4f}").replace(".", ",")


def in_columns(name, x, y):
    a, b = as_measured(x, y)
    head = f"{name}   CYCLE977\nWork offset: G54\n     Setpoint  Measured  Difference\n"
    rows = "\n".join(f"{k}  {n:.3f} mm  {m:.4f} mm  {m - n:.4f} mm" for k, n, m in (("X", x, a), ("Y", y, b)))
    return f"{head}{rows}\nDiameter  12.000 mm  12.013 mm  0.013 mm\n"


def in_lines(name, x, y):
    a, b = as_measured(x, y)
    return f"{name} CYCLE977\n setpoint X= {x:g} actual X= {a:.4f}\n setpoint Y= {y:g} actual Y= {b:.4f}\n"


def in_pairs(name, x, y):
    a, b = as_measured(x, y)
    return f"BOHRUNG {name}\nSOLL X {x:.3f} Y {y:.3f}\nIST X {a:.4f} Y {b:.4f}\n"


FORMS = (in_sections, in_german, in_columns, in_lines, in_pairs)


def write(path, form, plate=None, head=""):
    path.write_text(head + "\n".join(form(name, *place) for name, place in (plate or PLATE).items()), encoding="utf-8")
    return path


@pytest.mark.parametrize("form", FORMS)
def test_a_log_of_cycles_is_the_part_that_its_numbers_say(form, tmp_path):
    item = import_file(write(tmp_path / "log.txt", form), PART)
    assert (item.kind, item.doubts) == ("part", ())
    assert all(key in name for key, name in zip(PLATE, item.data.feature, strict=True))
    places = np.array(list(PLATE.values()))
    assert np.array_equal(item.data.nominal_mm[:, :2], places)
    assert np.allclose(item.data.measured_mm[:, :2], np.column_stack(as_measured(*places.T)), atol=6e-5)


@pytest.mark.parametrize("form", FORMS)
def test_a_value_without_a_number_is_named_with_its_line(form, tmp_path):
    """Otherwise the number of another coordinate, or of another feature, would be taken for it."""
    path = write(tmp_path / "log.txt", form)
    lines = path.read_text().split("\n")
    measured = "50,0020" if form is in_german else "50.0020"
    at = next(k for k, line in enumerate(lines) if measured in line)
    lines[at] = lines[at].replace(measured, "n.a.")
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        import_file(path, PART)
    assert caught.value.line is not None
    assert abs(caught.value.line - (at + 1)) <= 8


def test_set_ups_and_zeros_between_the_features_are_used(tmp_path):
    path = tmp_path / "log.txt"
    one, other = (write(tmp_path / "one.txt", in_lines).read_text() for _ in range(2))
    path.write_text(f"Setup 1\nG54 X-700 Y-900 Z-250\n{one}Setup 2\nG54 X-600 Y-900 Z-250\n{other}")
    data = import_file(path, ImportOptions(kind="part")).data
    assert data.setup.tolist() == [1] * len(PLATE) + [2] * len(PLATE)
    assert data.nominal_mm[0, 0] + data.origin_mm[0] == -650.0
    assert data.nominal_mm[len(PLATE), 0] + data.origin_mm[0] == -550.0


def test_features_under_one_heading_have_numbers_and_a_repeat_keeps_its_own(tmp_path):
    path = write(tmp_path / "log.txt", lambda _, x, y: in_lines("BORE", x, y))
    path.write_text(path.read_text() + in_lines("BORE", *PLATE["H00"]))
    item = import_file(path, PART)
    assert "several times" in " ".join(item.doubts)
    assert item.data.feature[:2] == ["BORE CYCLE977 1", "BORE CYCLE977 2"]
    assert item.data.feature[-1] == "BORE CYCLE977 1"


def test_an_edge_among_holes_is_named_and_can_be_left_out(tmp_path):
    """CYCLE978 measures one coordinate: it is not half of a hole."""
    path = write(tmp_path / "log.txt", in_lines)
    path.write_text(path.read_text() + "\nEDGE CYCLE978\n setpoint X= 400 actual X= 400.016\n")
    with pytest.raises(InputError, match="EDGE CYCLE978"):
        import_file(path, PART)
    found = import_file(path, ImportOptions(kind="part", origin="0,0,0", ignore=("EDGE CYCLE978",)))
    assert len(found.data) == len(PLATE)


def test_inches_that_follow_the_numbers_are_the_unit(tmp_path):
    plate = {name: (x / 25.4, y / 25.4) for name, (x, y) in PLATE.items()}
    path = write(tmp_path / "log.txt", in_columns, plate)
    path.write_text(path.read_text().replace(" mm", " inch"))
    assert np.allclose(
        import_file(path, PART).data.nominal_mm[:, :2], list(PLATE.values()), atol=0.02
    )  # three decimals of an inch
