"""Imports of foreign files: formats, units, signs, directions, and the door that commands use."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import compgen
from compgen.data.axis_runs import AxisRuns, read_axis_runs
from compgen.data.deviations import Deviations
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, form_of, import_file, native_format, open_errors, open_measurement

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden" / "imports"
#: The constructed example: mean and half-width of the five runs (mean + k * (-1, -1, 0, 1, 1)) at each target, um.
TARGETS_MM = [0.0, 100.0, 200.0, 300.0, 400.0]
UP, S_UP = [2, 6, 0, -2, 5], [1, 2, 1, 2, 3]
DOWN, S_DOWN = [-1, 2, -3, -6, 2], [1, 1, 2, 1, 2]
NANOMETRE_MM = 1e-6
ROUNDING_MM = 1e-12


def expected_um(target, direction, run):
    mean, half = (UP, S_UP) if direction > 0 else (DOWN, S_DOWN)
    k = TARGETS_MM.index(target)
    return mean[k] + half[k] * (-1, -1, 0, 1, 1)[run - 1]


def assert_is_the_example(runs, axis=0):
    assert isinstance(runs, AxisRuns)
    assert len(runs) == 50
    assert set(runs.axis.tolist()) == {axis}
    keys = {}
    for position, direction, run, value in zip(
        runs.position_mm.tolist(), runs.direction.tolist(), runs.run.tolist(), runs.deviation_mm.tolist(), strict=True
    ):
        keys[position, direction, run] = value
    assert len(keys) == 50
    for (position, direction, run), value in keys.items():
        assert value == pytest.approx(
            1e-3 * expected_um(position, direction, run), abs=ROUNDING_MM + NANOMETRE_MM * 1e-3
        )


@pytest.mark.parametrize(
    ("name", "options", "form"),
    [
        ("linear.rtl", {}, "renishaw"),
        ("ecmc_ISO230.dat", {"axis": "X"}, "ecmc-iso230"),
        ("german.csv", {}, "table"),
        ("wide.xlsx", {}, "xlsx"),
    ],
)
def test_the_constructed_example_comes_out_of_every_format_as_it_went_in(name, options, form, tmp_path):
    path = GOLDEN / name
    assert form_of(path) == form
    assert native_format(path) is None
    item = import_file(path, ImportOptions(**options))
    assert item.doubts == ()
    assert_is_the_example(item.data)
    written = tmp_path / item.file_name
    written.write_text(item.files()[item.file_name])
    assert_is_the_example(read_axis_runs(written))


def test_the_evaluation_of_the_imported_example_has_the_golden_means_and_reversals():
    runs = import_file(GOLDEN / "linear.rtl").data
    up, down = (
        [1e3 * runs.deviation_mm[(runs.position_mm == t) & (runs.direction == way)].mean() for t in TARGETS_MM]
        for way in (1, -1)
    )
    np.testing.assert_allclose(up, UP, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.subtract(up, down), [3, 4, 3, 4, 3], rtol=0, atol=1e-9)
    with pytest.warns(CompgenWarning, match="read as: renishaw"):
        errors = open_errors(GOLDEN / "linear.rtl")
    np.testing.assert_allclose(1e3 * errors.curves["EXX"].value, [0.5, 4, -1.5, -4, 3.5], rtol=0, atol=1e-9)


def rtl(rows, targets="0 100 200\r\n300 400", count=5, runs=2, tail="EOF::\r\n", axis="Y", kind="RTL"):
    lines = [
        "HEADER::", f"File type: {kind}", "", "TARGET DATA::", f"Target-count :{count}", f"Targets : {targets}", "Flags: 0 0 2 0",
        "", "USER-TEXT::", f"Axis:{axis}", "Location:", "", "RUNS::", f"Run-count:{runs}", "", "DEVIATIONS::", "Run Target Data:",
    ]  # fmt: skip
    return "\r\n".join([*lines, *rows, "", tail])


ROWS = [
    f"{run}\t{k} {v}"
    for run, ks in ((1, range(1, 6)), (2, range(5, 0, -1)))
    for k, v in ((k, k * run * 1.5) for k in ks)
]


def written(tmp_path, content, name="a.rtl"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_direction_follows_the_order_of_the_targets_not_the_number_of_the_run(tmp_path):
    down_first = [row.replace("1\t", "3\t", 1).replace("2\t", "1\t", 1).replace("3\t", "2\t", 1) for row in ROWS]
    runs = import_file(written(tmp_path, rtl(down_first))).data
    first = runs.deviation_mm == runs.deviation_mm.max()
    assert runs.position_mm[first] == 400.0
    assert runs.direction[first] == -1
    assert runs.axes == (1,)


def test_the_axis_that_the_user_says_counts_whatever_the_text_of_a_laser_file_calls_it(tmp_path):
    for text in ("Y", "X axis", "spindle"):
        item = import_file(written(tmp_path, rtl(ROWS, axis=text)), ImportOptions(axis="Z"))
        assert item.data.axes == (2,)
    assert import_file(written(tmp_path, rtl(ROWS, axis="X axis"))).data.axes == (0,)


def test_runs_of_one_direction_all_ascend(tmp_path):
    rows = [f"{run} {k} {run + k}" for run in (1, 2, 3) for k in range(1, 6)]
    item = import_file(written(tmp_path, rtl(rows, runs=3).replace("0 0 2 0", "0 1 2 0")))
    assert item.data.direction.tolist() == [1] * 15
    assert item.data.run.tolist() == [1] * 5 + [2] * 5 + [3] * 5
    assert item.doubts == ()


def test_sorted_rows_of_a_two_way_test_are_not_taken_for_one_direction(tmp_path):
    rows = [f"{run} {k} {run + k}" for run in (1, 2) for k in range(1, 6)]
    path = written(tmp_path, rtl(rows))
    assert any("--directions" in text for text in import_file(path).doubts)
    said = import_file(path, ImportOptions(directions="alternate"))
    assert said.doubts == ()
    assert said.data.direction.tolist() == [1] * 5 + [-1] * 5
    with pytest.raises(InputError, match="leaves open.*--directions"):
        open_measurement([path])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (rtl(ROWS[:-1]), "2 runs of 5 targets are 10 readings, the file contains 9"),
        (rtl(ROWS[:-1], tail=""), "it is truncated"),
        (rtl(ROWS, tail="")[:-6], "three numbers|it is truncated"),
        (rtl(ROWS)[: rtl(ROWS).index("DEVIATIONS")], "contains no readings"),
        (rtl(ROWS)[: rtl(ROWS).index("Targets")], "contains no target positions"),
        (rtl(ROWS, count=6), "declares 6 targets but contains 5"),
        (rtl([*ROWS[:-1], "2 2 1.0"]), "appears twice"),
        (rtl([*ROWS[:-1], "2 9 1.0"]), "beyond 2 runs and 5 targets"),
        (rtl([*ROWS[:-1], "2 1 abc"]), "expected three numbers 'run target deviation'"),
        (rtl([*ROWS[:-1], "2 1"]), "is the file truncated"),
        (rtl([*ROWS[:-1], "2 1 nan"]), "expected three numbers 'run target deviation'"),
        (rtl(ROWS, runs="many"), "whole number from 1"),
        (rtl(ROWS, targets="0 100 x 300 400"), "expected a target position"),
        (rtl(ROWS, kind="RTA"), "rename it"),
    ],
)
def test_damaged_laser_files_are_refused_with_the_place(tmp_path, content, message):
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, content))


@pytest.mark.parametrize("keep", range(5, 100, 7))
def test_no_cut_of_a_laser_file_is_taken_for_a_whole_one(tmp_path, keep):
    content = rtl(ROWS).encode()
    body = content[: content.rindex(b"EOF") - 4]
    with pytest.raises(InputError):
        import_file(written(tmp_path, body[: len(body) * keep // 100]))


def test_laser_values_that_look_like_another_unit_are_doubted(tmp_path):
    small = [
        f"{run} {k} {0.000001 * k * run}" for run in (1, 2) for k in (range(1, 6) if run == 1 else range(5, 0, -1))
    ]
    path = written(tmp_path, rtl(small))
    assert any("look like mm" in text for text in import_file(path).doubts)
    said = import_file(path, ImportOptions(units={"value": "mm"}))
    assert said.doubts == ()
    assert said.data.deviation_mm.max() == pytest.approx(1e-5, abs=ROUNDING_MM)


def test_angular_runs_become_the_error_that_the_user_names_in_rad():
    path = GOLDEN / "angular.rta"
    assert any("--error" in text for text in import_file(path).doubts)
    item = import_file(path, ImportOptions(error="EBX"))
    curve = item.data.curves["EBX"]
    np.testing.assert_allclose(curve.value, [1e-6, 5e-6, 11e-6, 13e-6, 21e-6], rtol=0, atol=1e-15)
    for wrong, message in (("EXX", "contains an angle"), ("EBY", "belongs to axis Y"), ("EQX", "did you mean|Known")):
        with pytest.raises(InputError, match=message):
            import_file(path, ImportOptions(error=wrong))


def capture(samples=1000, declared=None, trailer=b"\r\nEOF::\r\n"):
    values = 0.001 * np.arange(samples) - 0.1
    head = (
        f"HEADER::\r\nOwner : x\r\nFile Type : linear\r\nSample rate : 50000\r\nSample no : {declared or samples}\r\n"
    )
    return head.encode() + b"Axis : X\r\nData:\r\n" + struct.pack(f"<{samples}d", *values) + trailer


@pytest.mark.parametrize("trailer", [b"\r\nEOF::\r\n", b"EOF::\r\n"])
def test_captures_are_read_to_the_last_sample(tmp_path, trailer):
    item = import_file(written(tmp_path, capture(trailer=trailer), "a.rtx"))
    assert len(item.data) == 1000
    assert item.data.value[-1] == 0.001 * 999 - 0.1
    assert item.data.step_s == 2e-5
    assert item.understood["axis"] == "X"
    assert item.files()["a.capture.csv"].splitlines()[-1] == "0.019980000,0.899000000"


@pytest.mark.parametrize(
    "content", [capture()[:-600], capture(declared=999), capture(trailer=b""), capture(declared=10**12)]
)
def test_cut_captures_are_refused_and_not_padded(tmp_path, content):
    with pytest.raises(InputError, match="truncated"):
        import_file(written(tmp_path, content, "a.rtx"))


def test_forward_runs_of_descending_targets_move_in_negative_direction(tmp_path):
    text = "UNIT=mm\nCYCLES=1\nPOSITIONS=2\nTGT_DATA[1]=10\nTGT_DATA[2]=-.5\n"
    text += "REF_DATA_FWD[1,1]=10.001\nREF_DATA_FWD[2,1]=-.4967\nREF_DATA_BWD[1,1]=10.002\nREF_DATA_BWD[2,1]=-.499\n"
    runs = import_file(written(tmp_path, text, "a.dat"), ImportOptions(axis="Z")).data
    assert runs.direction.tolist() == [-1, -1, 1, 1]
    np.testing.assert_allclose(runs.deviation_mm, [0.001, 0.0033, 0.001, 0.002], rtol=0, atol=1e-12)
    assert runs.covariates["order"].tolist() == [1, 2, 3, 4]  # down first: rows by themselves never tell the time
    with pytest.raises(InputError, match="declares 3 targets"):
        import_file(written(tmp_path, text.replace("POSITIONS=2", "POSITIONS=3"), "b.dat"))
    with pytest.raises(InputError, match="is missing; is it truncated"):
        import_file(written(tmp_path, text.rpartition("REF")[0], "c.dat"))
    turned = text.replace("=10.00", "=-10.00").replace("=-.49", "=.49")
    assert any("slope" in doubt for doubt in import_file(written(tmp_path, turned, "d.dat")).doubts)
    with pytest.raises(InputError, match="is not a unit of length"):
        import_file(written(tmp_path, text.replace("UNIT=mm", "UNIT=deg"), "e.dat"))


def long_table(separator=",", decimal=".", unit="um", factor=1.0, swapped=False, header=None):
    names = header or ["position [mm]", f"deviation [{unit}]", "direction", "run", "axis"]
    lines = [separator.join(names)]
    for run in range(1, 6):
        for way in (1, -1):
            for target in TARGETS_MM[::way]:
                number = f"{expected_um(target, way, run) * factor:.6f}".replace(".", decimal)
                label = -way if swapped else way
                lines.append(
                    separator.join([f"{target:.1f}".replace(".", decimal), number, f"{label:+d}", str(run), "X"])
                )
    return "\r\n".join(lines) + "\r\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
@pytest.mark.parametrize(
    ("separator", "decimal"), [(",", "."), (";", ","), ("\t", ","), ("\t", "."), ("  ", "."), ("|", ".")]
)
def test_tables_come_in_any_encoding_with_any_separator(tmp_path, encoding, separator, decimal):
    header = ["position[mm]", "deviation[µm]", "direction", "run", "axis"]
    text = long_table(separator, decimal, header=header)
    item = import_file(written(tmp_path, text.encode(encoding), "t.csv"))
    assert item.doubts == ()
    assert_is_the_example(item.data)


def test_text_of_mixed_encodings_still_has_its_unit(tmp_path):
    text = long_table(header=["position [mm]", "deviation [µm]", "direction", "run", "axis"]).encode()
    item = import_file(written(tmp_path, b"Bediener: M\xfcller\r\n" + text, "t.csv"))
    assert_is_the_example(item.data)


@pytest.mark.parametrize(("unit", "factor"), [("um", 1.0), ("mm", 1e-3), ("nm", 1e3), ("inch", 1 / 25400.0)])
def test_units_in_the_header_count(tmp_path, unit, factor):
    text = long_table(unit=unit, factor=factor)
    runs = import_file(written(tmp_path, text, "t.csv")).data
    tolerance_mm = 0.5e-6 / factor * 1e-3 + ROUNDING_MM  # six decimals of the file's own unit
    for position, direction, run, value in zip(
        runs.position_mm, runs.direction, runs.run, runs.deviation_mm, strict=True
    ):
        assert value == pytest.approx(1e-3 * expected_um(position, direction, run), abs=tolerance_mm)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "um"), (1e-3, "mm")])
def test_without_a_unit_the_size_of_the_numbers_decides_and_says_so(tmp_path, factor, unit):
    text = long_table(factor=factor, header=["position", "deviation", "direction", "run", "axis"])
    item = import_file(written(tmp_path, text, "t.csv"))
    assert item.understood["unit"] == unit
    assert any("by the magnitude" in text for text in item.notes)
    assert_is_the_example(item.data)


def test_a_header_that_says_the_wrong_unit_is_doubted(tmp_path):
    item = import_file(written(tmp_path, long_table(unit="mm"), "t.csv"))
    assert any("look like um" in text for text in item.doubts)


def test_swapped_directions_are_seen_where_the_rows_show_the_motion(tmp_path):
    path = written(tmp_path, long_table(swapped=True), "t.csv")
    item = import_file(path)
    assert any("swapped" in text for text in item.doubts)
    assert_is_the_example(import_file(path, ImportOptions(directions="motion")).data)
    kept = import_file(path, ImportOptions(directions="labels"))
    assert kept.doubts == ()
    one, other = (np.lexsort((d.deviation_mm, d.position_mm)) for d in (kept.data, item.data))
    np.testing.assert_array_equal(kept.data.direction[one], -item.data.direction[other])


def test_corrections_are_turned_round(tmp_path):
    negative = long_table(factor=-1.0)
    by_name = import_file(written(tmp_path, negative.replace("deviation", "correction"), "t.csv"))
    assert_is_the_example(by_name.data)
    assert_is_the_example(import_file(written(tmp_path, negative, "u.csv"), ImportOptions(sign="correction")).data)


def test_readings_in_place_of_deviations_tell_their_unit_and_sign(tmp_path):
    rows = [(t, t + 1e-3 * expected_um(t, 1, 1)) for t in TARGETS_MM]
    for scale, doubt in ((1.0, None), (1 / 25.4, None), (-1.0, "sign")):
        text = "target [mm];measured;axis\n" + "".join(f"{t};{v * scale:.9f};Y\n" for t, v in rows)
        item = import_file(written(tmp_path, text, "t.csv"))
        assert any(doubt in text for text in item.doubts) if doubt else item.doubts == ()
        if not doubt:
            np.testing.assert_allclose(
                1e3 * item.data.deviation_mm, [expected_um(t, 1, 1) for t in TARGETS_MM], atol=1e-4
            )
            assert item.data.direction.tolist() == [1] * 5


def test_columns_may_be_named_by_the_user(tmp_path):
    text = long_table(header=["A", "B", "C", "D", "E"])
    path = written(tmp_path, text, "t.csv")
    with pytest.raises(InputError, match="--map position=COLUMN"):
        import_file(path)
    columns = {"position": "A", "deviation": "B", "direction": "C", "run": "D", "axis": "E"}
    item = import_file(path, ImportOptions(columns=columns, units={"value": "um", "position": "mm"}, sign="error"))
    assert item.doubts == ()
    assert_is_the_example(item.data)
    with pytest.raises(InputError, match="there is no column 'Q'"):
        import_file(path, ImportOptions(columns={"position": "Q"}))
    with pytest.raises(InputError, match="'positon' is not a field; did you mean 'position'"):
        import_file(path, ImportOptions(columns={"positon": "A"}))


LENGTHS = ROOT / "examples" / "zha-gantry.lengths.csv"


def foreign_lengths(tmp_path, factor, unit="", every=7):
    lengths = compgen.read_lengths(LENGTHS)
    lines = [f"Tracer;Point ID;X;Y;Z;Length{unit}"]
    for k in range(0, len(lengths), every):
        x, y, z = lengths.position_mm[k]
        row = (lengths.stations[lengths.station[k]], lengths.point[k], x, y, z, lengths.length_mm[k] * factor)
        lines.append(";".join(str(cell) for cell in row))
    return written(tmp_path, "\n".join(lines) + "\n", "tracer.csv"), lengths, range(0, len(lengths), every)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "mm"), (1e-3, "m"), (1 / 25.4, "in"), (-1.0, "mm"), (-1e3, "um")])
def test_tracer_lengths_show_their_unit_and_sign_against_the_points(tmp_path, factor, unit):
    path, lengths, rows = foreign_lengths(tmp_path, factor)
    item = import_file(path)
    assert isinstance(item.data, Lengths)
    assert item.understood["unit"] == unit
    assert item.doubts == ()
    np.testing.assert_allclose(item.data.length_mm, lengths.length_mm[list(rows)], rtol=0, atol=1e-9)
    names = [[data.stations[k] for k in data.station] for data in (item.data, lengths)]
    assert names[0] == [names[1][k] for k in rows]


def test_tracer_lengths_with_a_wrong_unit_in_the_header_are_doubted(tmp_path):
    path, _, _ = foreign_lengths(tmp_path, 1.0, " [inch]")
    item = import_file(path)
    assert any("they fit the points in mm" in text for text in item.doubts)
    with pytest.raises(InputError, match="leaves open"):
        open_measurement([path])


def test_measured_positions_become_deviations(tmp_path):
    text = "x cmd;y cmd;z cmd;x meas;dy [µm];z meas\n"
    text += "0;0;0;0,001;2;-0,003\n100;50;0;100,002;3;-0,001\n200;50;-40;200,001;1;-40,002\n300;70;-90;299,999;2;-90\n"
    item = import_file(written(tmp_path, text, "p.csv"), ImportOptions(units={"position": "mm"}))
    assert isinstance(item.data, Deviations)
    expected = [[1, 2, -3], [2, 3, -1], [1, 1, -2], [-1, 2, 0]]
    np.testing.assert_allclose(1e3 * item.data.deviation_mm, expected, rtol=0, atol=1e-9)
    assert item.doubts == ()


def test_error_tables_have_a_column_or_a_row_for_each_value(tmp_path):
    wide = "position [mm],EXX [um],EBX [arcsec]\n0,0,0\n100,2.5,1\n200,-4,2\n"
    item = import_file(written(tmp_path, wide, "e.csv"))
    assert isinstance(item.data, ErrorTable)
    np.testing.assert_allclose(item.data.curves["EXX"].value, [0, 2.5e-3, -4e-3], atol=1e-15)
    np.testing.assert_allclose(item.data.curves["EBX"].value, np.deg2rad([0, 1 / 3600, 2 / 3600]), atol=1e-12)
    long = "parameter;pos [mm];value [mm]\nEXX;0;0\nEXX;100;0,004\n"
    np.testing.assert_allclose(import_file(written(tmp_path, long, "f.csv")).data.curves["EXX"].value, [0, 4e-3])
    with pytest.warns(CompgenWarning, match="read as: table, errors"):
        assert set(open_errors(written(tmp_path, wide, "g.csv")).names) == {"EXX", "EBX"}


def book(tmp_path, sheets, name="b.xlsx"):
    workbook = openpyxl.Workbook()
    workbook.remove(workbook.active)
    for title, rows in sheets.items():
        sheet = workbook.create_sheet(title)
        for row in rows:
            sheet.append(row)
    workbook.save(tmp_path / name)
    return tmp_path / name


def test_sheets_of_several_axes_are_one_measurement(tmp_path):
    rows = [["Target [mm]", "Deviation [um]"], *([t, expected_um(t, 1, 1)] for t in TARGETS_MM)]
    path = book(tmp_path, {"X": rows, "Y": rows, "notes": [["made by", "hand"]]})
    item = import_file(path)
    assert item.data.axes == (0, 1)
    assert len(item.data) == 10
    assert any("sheet skipped" in text for text in item.notes)
    assert import_file(path, ImportOptions(sheet="Y")).data.axes == (1,)
    with pytest.raises(InputError, match="no sheet 'Z'"):
        import_file(path, ImportOptions(sheet="Z"))


def test_zip_bombs_entities_and_damaged_workbooks_are_refused_without_unpacking_them(tmp_path, monkeypatch):
    good = book(tmp_path, {"X": [["Target", "Deviation"], [0, 1], [10, 2]]})
    parts = {name: zipfile.ZipFile(good).read(name) for name in zipfile.ZipFile(good).namelist()}

    def packed(name, **changed):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for part, content in {**parts, **changed}.items():
                archive.writestr(part, content)
        return written(tmp_path, buffer.getvalue(), name)

    sheet = parts["xl/worksheets/sheet1.xml"]
    entity = (
        b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
        + sheet[sheet.index(b"<worksheet") :]
    )
    wide = entity.decode().replace('1.0"?>', '1.0" encoding="utf-16"?>').encode("utf-16")
    unpacked = []

    def counted(read):
        def reading(stream, *size):
            unpacked.append(len(content := read(stream, *size)))
            return content

        return reading

    bad = (
        (packed("bomb.xlsx", **{"xl/worksheets/sheet1.xml": b"<a>" + b" " * 100_000_000}), "bomb"),
        (packed("huge.xlsx", **{f"xl/media/{k}.bin": b"\0" * 60_000_000 for k in range(5)}), "at most 256 MB"),
        (packed("entity.xlsx", **{"xl/worksheets/sheet1.xml": entity}), "XML entities"),
        (packed("entity16.xlsx", **{"xl/worksheets/sheet1.xml": wide}), "XML entities"),
        (packed("odd.xlsx", **{"xl/workbook.xml": b"<nonsense/>"}), "damaged|without any"),
        (written(tmp_path, good.read_bytes()[:-40], "cut.xlsx"), "damaged or truncated"),
        (written(tmp_path, b"PK\x03\x04" + b"\0" * 100, "zip.xlsx"), "damaged or truncated"),
        (written(tmp_path, b"\xd0\xcf\x11\xe0" + b"\0" * 100, "old.xlsx"), "old Excel workbook"),
    )
    for name in ("read", "read1"):
        monkeypatch.setattr(zipfile.ZipExtFile, name, counted(getattr(zipfile.ZipExtFile, name)))
    for path, message in bad:
        with pytest.raises(InputError, match=message):
            import_file(path)
    assert 0 < sum(unpacked) < 200_000, "bombs of 400 MB must not be unpacked"


def test_files_of_500_megabytes_are_refused_without_reading_them(tmp_path):
    path = tmp_path / "huge.csv"
    with path.open("wb") as stream:
        stream.write(b"position [mm],deviation [um]\n0,1\n")
        stream.truncate(500_000_000)
    tracemalloc.start()
    try:
        for call in (import_file, open_errors, lambda p: open_measurement([p])):
            with pytest.raises(InputError, match="500 MB; at most 128 MB"):
                call(path)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\0\x01\x02" * 100, "NUL bytes|no table"),
        (b"%PDF-1.4 ...", "PDF"),
        (b"<?xml version='1.0'?><a/>", "XML or HTML"),
        (b"only words here\nand here\n", "contains no table"),
        ("position [mm],deviation [um]\n0,1\n100".encode("utf-16")[:-1], "truncated or damaged UTF-16"),
        (b"position [mm],deviation [um]\n0,1\n100,x\n", "3: column deviation .um.: 'x' is not a number"),
        (b"position [mm],deviation [um]\n0,1\n100,1e999\n", "'1e999' is not a number"),
        (b"position [mm],deviation [um]\n0,5,1,2\n1,5,1,2\n", "decimal commas and commas between columns"),
        (b"position [mm];deviation [um]\n0,5;1.2\n1,5;1,2\n", "write all numbers alike"),
        (b"position [mm],deviation [um]\n0,1\n1,2\n3", "it is truncated"),
        (b"position [mm],deviation [um],direction\n0,1,up\n1,2,sideways\n", "'sideways' is not a direction"),
        (b"pos [mm],deviation [um],deviation [um]\n0,1,2\n", "twice"),
        (b"position [kg],deviation [um]\n0,1\n0,2\n", "kg is not a unit of length"),
        (b"weight [kg],force [N]\n0,1\n0,2\n", "its columns are not recognised"),
    ],
)
def test_what_is_no_measurement_is_refused_with_the_place(tmp_path, content, message):
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, content, "t.csv")).check_settled()


def test_the_door_takes_own_files_as_they_are_and_foreign_ones_converted(tmp_path):
    own = open_measurement([LENGTHS])
    np.testing.assert_array_equal(own.length_mm, compgen.read_lengths(LENGTHS).length_mm)
    other = written(tmp_path, rtl(ROWS), "y.rtl")
    with pytest.warns(CompgenWarning, match="measured minus target.*") as seen:
        both = open_measurement([GOLDEN / "linear.rtl", other])
    assert both.axes == (0, 1)
    assert len(both) == 60
    assert len(seen) == 2
    with pytest.warns(CompgenWarning, match="measured minus target"):
        (lengths_name, lengths), (runs_name, runs) = open_measurement([LENGTHS, other]).parts
    assert (lengths_name, runs_name) == (LENGTHS.name, "y.rtl")
    np.testing.assert_array_equal(lengths.length_mm, own.length_mm)
    assert runs.axes == (1,)


def test_exchange_files_come_in_any_encoding(tmp_path):
    text = "// Größe in mm\n[EXX]\nGridpoints = {\n0 0.001\n100 -0.002\n}\n[C0Y]\nVALUE = 0.00002\n"
    for name, encoding in (("a.txt", "utf-16"), ("b.txt", "cp1252"), ("c.txt", "utf-8-sig")):
        path = written(tmp_path, text.encode(encoding), name)
        with pytest.warns(CompgenWarning, match="etalon-exchange"):
            table = open_errors(path)
        np.testing.assert_allclose(table.curves["EXX"].value, [1e-3, -2e-3], rtol=0, atol=1e-15)
        assert table.squareness["EC0Y"][0] == 0.00002
    wrong = import_file(written(tmp_path, text.replace("0.001", "25.0"), "d.txt"))
    assert any("are the numbers mm and rad" in text for text in wrong.doubts)


@pytest.mark.parametrize("name", ["linear.rtl", "angular.rta", "ecmc_ISO230.dat", "german.csv", "wide.xlsx"])
def test_no_damage_to_a_file_ends_in_anything_but_an_answer(tmp_path, name):
    content = (GOLDEN / name).read_bytes()
    generator = np.random.default_rng(3)
    for _ in range(40):
        data = bytearray(content)
        for _ in range(int(generator.integers(1, 6))):
            place, what = int(generator.integers(len(data))), int(generator.integers(4))
            if what == 0:
                data[place] = int(generator.integers(256))
            elif what == 1:
                del data[place : place + int(generator.integers(1, 40))]
            elif what == 2:
                data[place:place] = data[place : place + 30]
            else:
                data[place:place] = (b"\xff", b",", b";", b"\0", b"1e999", b"::", b"\n")[int(generator.integers(7))]
        path = written(tmp_path, bytes(data), name)
        try:
            item = import_file(path)
        except InputError:
            continue
        assert item.files()


BACKUPS = {
    "siemens-cec": [
        b"%_N_NC_CEC_INI\n$AN_CEC[0,0]=0.001\n$AN_CEC[0,1]=0.002\n",
        b"\0\0\x03_N_NC_CEC_INI\0\0\r\nCHANDATA(1)\r\n$MA_CEC_ENABLE[AX1]=1\r\n",
        b"; axis data\nN38000 $MA_MM_ENC_COMP_MAX_POINTS[0,AX1]=100\n",
    ],
    "fanuc-pitch": [b"%\nN03620Q1A1P40A2P140\n", b"%\nN05711Q1L1P0L2P0\n"],
    "mitsubishi": [b"%\n; M80\nPARA101()\nN4001PX\nN4007P12.000\n"],
    "heidenhain-com": [b"BEGIN AXIS_X.COM MM\n0 0.000 0.001\nEND AXIS_X.COM MM\n"],
    "pmac": [b"#4 DEFINE COMP 24 #20,#20,60000000\n0,1,2,3\n"],
}


@pytest.mark.parametrize(("control", "content"), [(name, text) for name, texts in BACKUPS.items() for text in texts])
def test_the_backup_of_a_control_is_named_and_where_it_belongs(tmp_path, control, content):
    path = tmp_path / "backup.txt"
    path.write_bytes(content)
    for reading in (import_file, lambda file: open_measurement([file]), open_errors):
        with pytest.raises(InputError, match=rf"backup.*volcomp read .*--controller {control} .*--active"):
            reading(path)


def test_a_zip_archive_that_is_no_workbook_may_be_a_backup(tmp_path):
    with zipfile.ZipFile(tmp_path / "backup.zip", "w") as archive:
        archive.writestr("a.ini", "$AN_CEC[0,0]=0.001\n")
    with pytest.raises(InputError, match="--active"):
        import_file(tmp_path / "backup.zip")


LINE_TABLE = "Position [mm];Deviation [um]\n0;0.0\n100;1.2\n200;2.1\n300;3.3\n"


def test_where_the_other_axes_stood_is_asked_and_kept(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text(LINE_TABLE, encoding="utf-8")
    silent = import_file(path, ImportOptions(axis="X", sign="error"))
    assert any("where Y and Z stood" in note and "--line Y=MM,Z=MM" in note for note in silent.offers)
    assert silent.doubts == ()
    (asked,) = silent.questions
    assert (asked.option, asked.key, asked.required, asked.picture) == ("line", "Y,Z", False, "line")
    half = import_file(path, ImportOptions(axis="X", sign="error", line="y = -250"))
    assert any("where Z stood" in note for note in half.offers)
    stated = import_file(path, ImportOptions(axis="X", sign="error", line="Y=-250, Z=-100.5"))
    assert not any("stood" in note for note in (*stated.notes, *stated.offers))
    (text,) = stated.files().values()
    (tmp_path / "x.axis.csv").write_text(text, encoding="utf-8")
    assert read_axis_runs(tmp_path / "x.axis.csv").line_mm()[1].tolist() == [100.0, -250.0, -100.5]


@pytest.mark.parametrize("line", ["X=3", "Y=a", "Y=1,Y=2", "A=3", "Y", "Y=nan", "Y=1e9"])
def test_a_place_of_a_run_that_is_none_is_refused(tmp_path, line):
    path = tmp_path / "x.csv"
    path.write_text(LINE_TABLE, encoding="utf-8")
    with pytest.raises(InputError, match="--line"):
        import_file(path, ImportOptions(axis="X", sign="error", line=line))
