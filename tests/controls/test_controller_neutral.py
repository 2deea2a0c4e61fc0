"""Neutral CSV and JSON: correction field and error curves, exact round trip, signs, malformed text."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import InputError
from compgen.kinematics import volumetric_error

NAME = "neutral"
CONTROL = CONTROLLERS[NAME]
TRAVELS = ((-300.0, 500.0), (-150.0, 700.5), (-420.0, 80.0))
NANOMETRE = 1e-6


def machine_with(chain="WXYFZT", tool=(3.0, -40.0, -155.0), reference="X"):
    x, y, z = (Axis(travel, np.linspace(*travel, count)) for travel, count in zip(TRAVELS, (5, 4, 3), strict=True))
    return Machine("lopsided", Chain(chain), (x, y, z), reference, tool, (10.0, 20.0, -30.0))


PLAIN = machine_with()


def parsed(texts, machine=PLAIN):
    files = [SourceFile(Path(name), part) for name, part in texts.items()]
    return CONTROL(machine).parse(files)


def added(tables, position, machine=PLAIN, tool=None):
    position = np.atleast_2d(np.asarray(position, dtype=float))
    tool = None if tool is None else np.broadcast_to(np.asarray(tool, dtype=float), position.shape)
    return CONTROL(machine).emulate(tables, compgen.Points(position, tool))


FIELD = """# rows = 8
x_mm,y_mm,z_mm,cx_um,cy_um,cz_um
""" + "".join(
    f"{x},{y},{z},{value},{-value},0\n"
    for (x, y, z), value in zip(
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
        range(0, 64, 8),
        strict=True,
    )
)
CURVES = "error,position_mm,value\nEXX,0,0\nEXX,100,5\nEC0Y,,10\n"


def test_the_field_is_trilinear_added_and_holds_its_surface():
    """Corners C1 ... C8 = 0, 8 ... 56 round the lower and the upper face give 36 at (0.25, 0.5, 0.75)."""
    tables = parsed({"f.csv": FIELD})
    result = added(tables, [[0.25, 0.5, 0.75], [0.25, 0, 0], [-9, 9, 0]])
    assert result[:, 0] == pytest.approx([0.036, 0.002, 0.024])
    assert result[:, 1] == pytest.approx([-0.036, -0.002, -0.024])


def test_curves_are_errors_that_are_taken_off():
    tables = parsed({"c.csv": CURVES}, machine_with(tool=(0.0, 0.0, 0.0)))
    assert added(tables, [100, 200, 0])[0] == pytest.approx([-0.005 + 0.002, 0, 0])  # dX = EXX - EC0Y Y


def test_json_says_the_same_as_csv():
    data = {
        "schema": "compgen-error-curves",
        "version": 1,
        "errors": {"EXX": {"position_mm": [0, 100], "value_um": [0, 5]}, "EC0Y": {"value_urad": 10}},
    }
    both = parsed({"c.csv": CURVES, "c.json": json.dumps(data)})
    assert both.conflicts == ()
    data["errors"]["EC0Y"]["value_urad"] = 11
    assert parsed({"c.csv": CURVES, "c.json": json.dumps(data)}).conflicts == ("c.json differs from c.csv",)


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("reference", ["X", "Y"])
def test_the_four_files_hold_the_same_numbers_and_take_the_errors_away(chain, reference, make_errors):
    machine = machine_with(chain, reference=reference)
    errors = make_errors(machine)
    files = dict(compgen.export(machine, errors, NAME).files)
    assert CONTROL(machine).violations(parsed(files, machine)) == []
    position = np.random.default_rng(5).uniform(machine.lower_mm, machine.upper_mm, (300, 3))
    by_field = [added(parsed({name: files[name]}, machine), position, machine) for name in list(files)[:2]]
    by_curves = [added(parsed({name: files[name]}, machine), position, machine) for name in list(files)[2:]]
    np.testing.assert_array_equal(by_field[0], by_field[1])
    np.testing.assert_array_equal(by_curves[0], by_curves[1])
    left = by_curves[0] + volumetric_error(machine, errors, position)
    assert np.abs(left).max() < 5 * NANOMETRE + 0.2e-3  # second order of the wanted correction
    assert np.abs(by_field[0] - by_curves[0]).max() < 3 * 0.05e-3  # parabolas between nodes, at most loss_um each


def test_a_read_file_is_written_again_byte_for_byte(make_errors):
    from compgen.tables.exporting import Provenance, export_context, rerender

    errors = make_errors(PLAIN)
    files = compgen.export(PLAIN, errors, NAME).files
    assert rerender(PLAIN, NAME, files, export_context(PLAIN, errors, NAME, Provenance())) == dict(files)


def test_another_tool_is_served_by_the_curves(make_errors):
    files = dict(compgen.export(PLAIN, make_errors(PLAIN), NAME).files)
    tables = parsed(files)
    tool = np.array([50.0, 60.0, -300.0])
    position = np.random.default_rng(5).uniform(PLAIN.lower_mm, PLAIN.upper_mm, (50, 3))
    due = -volumetric_error(PLAIN, tables.curves, position, tool)
    np.testing.assert_allclose(added(tables, position, tool=tool), due, atol=1e-15)


def test_the_same_tool_turned_round_is_another_tool(make_errors):
    """The field holds for the tool offset of the machine file only, not for minus that offset."""
    tables = parsed(dict(compgen.export(PLAIN, make_errors(PLAIN), NAME).files))
    position = np.array([[100.0, 200.0, -300.0], [-250.0, 600.0, 50.0]])
    turned = -np.array(PLAIN.tool_offset_mm)
    due = -volumetric_error(PLAIN, tables.curves, position, turned)
    assert added(tables, position, tool=turned) == pytest.approx(due, abs=1e-12)


def test_the_curves_file_is_an_errors_file(make_errors, tmp_path):
    errors = make_errors(PLAIN)
    (tmp_path / "n.errors.csv").write_text(compgen.export(PLAIN, errors, NAME).files["neutral.errors.csv"])
    assert set(errors.names) <= set(compgen.read_errors(tmp_path / "n.errors.csv").names)


def test_files_of_different_exports_are_a_violation(make_errors):
    one, two = (dict(compgen.export(PLAIN, make_errors(PLAIN, seed=seed), NAME).files) for seed in (1, 2))
    mixed = {"neutral.field.csv": one["neutral.field.csv"], "neutral.errors.csv": two["neutral.errors.csv"]}
    found = CONTROL(PLAIN).violations(parsed(mixed))
    assert any("field and curves differ by" in text for text in found)


JSON = json.dumps(
    {
        "schema": "compgen-correction-field",
        "version": 1,
        "nodes_mm": {"x": [0, 1], "y": [0], "z": [0]},
        "correction_um": [[1, 2, 3], [4, 5, 6]],
    },
    indent=0,
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        (FIELD.replace("x_mm", "x_in"), "x_mm"),
        (FIELD.rsplit("\n", 2)[0] + "\n", "declares 8 rows but contains 7"),
        (FIELD.replace("# rows = 8\n", "").rsplit("\n", 2)[0] + "\n", "do not fill the grid"),
        (FIELD.replace("1,1,1,48", "1,0,1,48"), "is given twice"),
        (FIELD.replace("48", "4.8.0"), "not a number"),
        (FIELD.replace("48", "nan"), "finite"),
        (CURVES.replace("EC0Y", "EC0X"), "EC0X"),
        (JSON[:-5], "not valid JSON"),
        (JSON.replace("[\n4,", "[\nNaN,"), "NaN"),
        (JSON.replace("[\n4,", "[\n1e999,"), "finite"),
        (JSON.replace("[\n4,", '[\n"4",'), r"expected \d+ finite numbers"),
        (JSON.replace("compgen-correction-field", "other"), "schema"),
        (JSON.replace('"y": [\n0\n]', '"y": [\n0,\n1\n]'), "expected 2 x 2 x 1 vertices"),
        (JSON.replace('"x": [\n0,\n1\n]', '"x": [\n1,\n0\n]'), "ascend"),
        ("[" * 100_000, "JSON"),
        ("{" + '"a":1,' * 2 + '"b":2}', "is given twice"),
    ],
)
def test_malformed_text_is_refused(text, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed({"a.txt": text})
    assert str(caught.value.file) == "a.txt"


@pytest.mark.parametrize(("part", "times"), [("\xff", 30_000_000), ("1,2\n", 10_000_000), ("[", 25_000_000)])
def test_huge_garbage_is_refused_at_a_cost_that_grows_with_it(part, times):
    def read(text):
        with pytest.raises(InputError):
            parsed({"a.txt": text})

    assert grows_with_its_file(read, part)
    read(part * times)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 400), st.text(alphabet='{}[]",:eE+-.0123456789xyzu_mc\n\x00', max_size=10))
def test_damaged_text_is_read_or_refused(place, piece):
    for text in (JSON, FIELD, CURVES):
        at = place % len(text)
        with contextlib.suppress(InputError):
            parsed({"a.txt": text[:at] + piece + text[at + len(piece) :]})
