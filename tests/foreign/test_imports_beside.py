"""Imports: what stands beside the readings (temperatures, times, tool, feed, load), dates, and what laser files say."""

import zipfile
from datetime import datetime
from io import BytesIO

import numpy as np
import openpyxl
import pytest

from compgen.data.axis_runs import AxisRuns, read_axis_runs
from compgen.data.deviations import Deviations, read_deviations
from compgen.data.lengths import Lengths, read_lengths
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, import_file, open_measurement
from compgen.foreign.source import header_date, order_of, read_date

ROUNDING = 1e-9


def written(tmp_path, text, name="t.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


@pytest.mark.parametrize(
    ("text", "iso"),
    [
        ("2016-12-12T10:46:05", "2016-12-12T10:46:05"),
        ("2016-12-12 10:46:05+01:00", "2016-12-12T10:46:05+01:00"),
        ("2016/12/12", "2016-12-12"),
        ("12.3.2016 9:05", "2016-03-12T09:05:00"),
        ("31/12/2016", "2016-12-31"),
        ("12/31/2016 1:02:03 PM", "2016-12-31T13:02:03"),
        ("12/31/2016 12:02 am", "2016-12-31T00:02:00"),
        ("10:46 Dec 12 2016", "2016-12-12T10:46:00"),
        ("12. Dezember 2016", "2016-12-12"),
        ("3-Mar-2020", "2020-03-03"),
        ("05/05/2025", "2025-05-05"),
        ("10:46 13-04-2025", "2025-04-13T10:46:00"),
        ("2025-04-13 10:46 -0500", "2025-04-13T10:46:00-05:00"),
    ],
)
def test_dates_that_can_be_read_in_one_way_are_read_so(text, iso):
    assert header_date(text) == (iso, None)


@pytest.mark.parametrize("text", ["12/10/2016", "01-02-03", "2/3/2020 10:00"])
def test_a_date_with_two_readings_is_left_out_and_asked_for(text):
    iso, against = header_date(text)
    assert iso is None
    assert "--dates dmy, mdy or ymd" in against


@pytest.mark.parametrize("text", ["2025-13-40", "99:99", "12.5", "abc", "30/30/2020", "20160501", "1/2", "x" * 500])
def test_what_is_no_date_is_none(text):
    assert header_date(text)[0] is None


def test_the_user_settles_the_order_and_a_wrong_order_is_refused():
    assert header_date("12/10/2016", "dmy")[0] == "2016-10-12"
    assert header_date("12/10/2016", "mdy")[0] == "2016-12-10"
    dates = [read_date(text) for text in ("03/04/2025", "13/04/2025")]
    assert order_of(dates) == "dmy"
    with pytest.raises(InputError, match="is not a date in the order mdy"):
        order_of(dates, "mdy")
    with pytest.raises(InputError, match="do not all fit one order"):
        order_of([read_date(text) for text in ("03/04/2025", "13/04/2025", "04/13/2025")])


LENGTHS = """\
Date: 2025-04-13
Station;Point;X [mm];Y [mm];Z [mm];Length [mm];Time;T_X [\u00b0C];Lufttemperatur [\u00b0F];Spindle temp [K];Vorschub [m/min];\
Last [t];Tool X;Tool Y;Tool Z;Dead path [mm];Direction;Setup
A;1;0;0;0;100,5;10:00:00;20,1;68;293,15;2;0,5;0;1;100;12;+;1
A;2;100;0;0;190,5;10:00:05;20,2;69,8;294,15;2;0,5;0;1;100;12;+;1
A;3;100;90;0;260,5;10:00:10;20,3;68;293,15;2;0,5;0;1;100;12;-;1
"""


def test_columns_beside_tracer_lengths_are_taken_in_the_units_of_the_contract(tmp_path):
    item = import_file(written(tmp_path, LENGTHS))
    assert item.doubts == ()
    assert isinstance(item.data, Lengths)
    out = written(tmp_path, item.files()["t.lengths.csv"], "o.lengths.csv")
    lengths = read_lengths(out)
    expected = {
        "time_s": [0, 5, 10],
        "temp_x_c": [20.1, 20.2, 20.3],
        "temp_ambient_c": [20, 21, 20],
        "temp_spindle_c": [20, 21, 20],
        "feed_mm_min": [2000] * 3,
        "load_kg": [500] * 3,
        "approach": [1, 1, -1],
    }
    assert set(lengths.covariates) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(lengths.covariates[name], values, rtol=0, atol=ROUNDING, err_msg=name)
    np.testing.assert_array_equal(lengths.tool_mm, [[0, 1, 100]] * 3)
    assert lengths.labels["setup"].tolist() == [1, 1, 1]
    assert lengths.metadata["measured_at"] == "2025-04-13"
    assert item.understood["not_used"] == {"Dead path [mm]": "the native format has no column for it"}
    assert any("not used: Dead path" in text for text in item.notes)


@pytest.mark.parametrize(
    ("header", "cells", "options", "channel", "expected"),
    [
        ("Temp X", "20.1 20.4", {}, "temp_x_c", [20.1, 20.4]),
        ("Temperatur X-Achse", "293.15 294.15", {}, "temp_x_c", [20, 21]),
        ("Air temperature (F)", "68 50", {}, "temp_ambient_c", [20, 10]),
        ("Temperature", "20 21", {}, "temp_measured_c", [20, 21]),
        ("Werkst\u00fccktemperatur 2 [\u00b0C]", "20 21", {}, "temp_material_2_c", [20, 21]),
        (
            "Sensor 7",
            "68 50",
            {"columns": {"temp_bed": "Sensor 7"}, "units": {"temp_bed": "degF"}},
            "temp_bed_c",
            [20, 10],
        ),
        ("T7", "20 21", {"columns": {"temperature": "T7"}}, "temp_measured_c", [20, 21]),
    ],
)
def test_temperatures_by_name_by_unit_and_by_the_user(tmp_path, header, cells, options, channel, expected):
    first, second = cells.split()
    text = f"position [mm],deviation [um],{header}\n0,1,{first}\n100,2,{second}\n"
    item = import_file(written(tmp_path, text), ImportOptions(axis="X", **options))
    assert isinstance(item.data, AxisRuns)
    np.testing.assert_allclose(item.data.covariates[channel], expected, rtol=0, atol=ROUNDING)
    back = read_axis_runs(written(tmp_path, item.files()["t.axis.csv"], "o.axis.csv"))
    np.testing.assert_allclose(back.covariates[channel], expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("header", "cells", "reason"),
    [
        ("Temp X", ("1", "2"), "the file states no unit"),
        ("Temp X [K]", ("20", "21"), "another unit"),
        ("Temp X [degC]", ("20", ""), "is empty"),
        ("Temp X [degC]", ("20", "warm"), "'warm' is not a number"),
        ("Time", ("1", "2"), "give --unit time=s"),
        ("Time", ("10:00", "09:00"), "are not ascending"),
        ("Time", ("10:00", "soon"), "'soon' is not a date or time"),
        ("Feed", ("1", "2"), "has no column"),
    ],
)
def test_columns_that_cannot_be_read_are_named_with_the_reason_and_do_not_stop_the_import(
    tmp_path, header, cells, reason
):
    text = f"position [mm],deviation [um],{header}\n0,1,{cells[0]}\n100,2,{cells[1]}\n"
    item = import_file(written(tmp_path, text), ImportOptions(axis="X"))
    assert item.doubts == ()
    assert item.data.covariates == {}
    assert reason in item.understood["not_used"][header]
    if "no place" not in reason and "Temp" in header:
        with pytest.raises(InputError, match=reason):
            import_file(written(tmp_path, text), ImportOptions(axis="X", columns={"temp_x": header}))


def test_time_stamps_of_one_day_need_no_order_and_those_of_several_days_are_asked_for(tmp_path):
    text = "position [mm],deviation [um],Time\n0,1,03/04/2025 10:00:00\n100,2,{}/04/2025 10:00:30\n"
    same = import_file(written(tmp_path, text.format("03")), ImportOptions(axis="X"))
    assert same.doubts == ()
    assert same.data.covariates["time_s"].tolist() == [0, 30]
    assert "measured_at" not in same.data.metadata
    path = written(tmp_path, text.format("05"))
    assert any("--dates" in doubt for doubt in import_file(path, ImportOptions(axis="X")).doubts)
    by_day = import_file(path, ImportOptions(axis="X", dates="dmy")).data
    assert by_day.covariates["time_s"].tolist() == [0, 2 * 86400 + 30]
    assert by_day.metadata["measured_at"] == "2025-04-03T10:00:00"
    by_month = import_file(path, ImportOptions(axis="X", dates="mdy")).data
    apart = datetime(2025, 5, 4, 10, 0, 30) - datetime(2025, 3, 4, 10)
    assert by_month.covariates["time_s"].tolist() == [0, apart.total_seconds()]
    settled = import_file(written(tmp_path, text.format("13")), ImportOptions(axis="X")).data
    assert settled.covariates["time_s"].tolist() == [0, 10 * 86400 + 30]


def test_dates_of_a_workbook_count_as_cells_and_as_numbers_of_days(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "X"
    for row in (
        ["Target [mm]", "Deviation [um]", "Time"],
        [0, 1, datetime(2025, 3, 4, 12)],
        [9, 2, datetime(2025, 3, 4, 13)],
    ):
        book.active.append(row)
    book.save(tmp_path / "a.xlsx")
    for row, value in ((2, 45720.5), (3, 45720.5 + 1 / 24)):
        book.active.cell(row, 3).value = value
        book.active.cell(row, 3).number_format = "General"
    book.save(tmp_path / "b.xlsx")
    for name in ("a.xlsx", "b.xlsx"):
        data = import_file(tmp_path / name).data
        np.testing.assert_allclose(data.covariates["time_s"], [0, 3600], rtol=0, atol=1e-3)
        assert data.metadata["measured_at"] == "2025-03-04T12:00:00"


def test_several_files_with_dates_share_one_clock(tmp_path):
    head = "Station,Point,X [mm],Y [mm],Z [mm],Length [mm],Time\n"
    rows = "{s},1,0,0,0,5,2025-04-13 {t}:00:00\n{s},2,50,0,0,55,2025-04-13 {t}:00:10\n"
    paths = [written(tmp_path, head + rows.format(s=s, t=t), f"{s}.csv") for s, t in (("A", 10), ("B", 9))]
    with pytest.warns(CompgenWarning, match="was read as: table, lengths"):
        both = open_measurement(paths)
    assert both.covariates["time_s"].tolist() == [3600, 3610, 0, 10]


def test_repeated_rows_are_numbered_and_copies_refused(tmp_path):
    rows = [(x, y, x * 1e-2 + y) for y in (0, 50) for x in (0, 100, 200)]
    head = "x [mm],y [mm],z [mm],dx [um]\n"
    again = head + "".join(f"{x},{y},0,{d + e}\n" for e in (0, 0.1) for x, y, d in rows)
    item = import_file(written(tmp_path, again))
    assert isinstance(item.data, Deviations)
    assert item.data.labels["repeat"].tolist() == [1] * 6 + [2] * 6
    assert any("numbered in order of occurrence" in text for text in item.notes)
    assert len(read_deviations(written(tmp_path, item.files()["t.deviations.csv"], "o.deviations.csv"))) == 12
    copied = head + "".join(f"{x},{y},0,{d}\n" for _ in (0, 1) for x, y, d in rows)
    with pytest.raises(InputError, match="6 rows repeat earlier ones to the last digit"):
        import_file(written(tmp_path, copied))


def test_missing_runs_missing_readings_and_copied_runs_are_said(tmp_path):
    def table(runs, value=lambda t, r: t * 0.01 + 0.1 * r):
        return "position [mm],deviation [um],run,axis\n" + "".join(
            f"{t},{value(t, r):.3f},{r},X\n" for r in runs for t in (0, 100, 200, 300)
        )

    def notes(text):
        return " ".join(import_file(written(tmp_path, text)).notes)

    assert "missing" not in notes(table((1, 2)))
    assert "there is no run 3" in notes(table((1, 2, 4)))
    assert "1 of 8 reading is missing, the first in one-way run 2 at 300 mm" in notes(
        table((1, 2)).rpartition("300")[0]
    )
    assert "runs 1 and 2 are equal to the last digit" in notes(table((1, 2), lambda t, r: t * 0.01))


def test_runs_are_numbered_by_their_numbers_and_not_as_words(tmp_path):
    text = "position [mm],deviation [um],run,axis\n"
    text += "".join(f"{t},{r + t / 100},{r},X\n" for r in range(1, 13) for t in (0, 100))
    data = import_file(written(tmp_path, text), ImportOptions(directions="alternate")).data
    odd = np.floor(data.deviation_mm * 1e3 - data.position_mm / 100 + 0.5).astype(int) % 2 == 1
    np.testing.assert_array_equal(data.direction, np.where(odd, 1, -1))


@pytest.mark.parametrize(
    ("cells", "decimal", "values"),
    [
        (("1.000,5", "2.000,5"), None, (1000.5, 2000.5)),
        (("1,000.5", "2,000.5"), None, (1000.5, 2000.5)),
        (("1 000.5", "2 000.5"), None, (1000.5, 2000.5)),
        (("1\u202f000", "2'000"), None, (1000, 2000)),
        (("1,000", "2,000"), "point", (1000, 2000)),
        (("1,000", "2,000"), "comma", (1, 2)),
        (("0,500", "2,000"), None, (0.5, 2)),
    ],
)
def test_thousands_and_decimal_marks(tmp_path, cells, decimal, values):
    text = "position [mm];deviation [um];axis\n" + "".join(f"{cell};{k};X\n" for k, cell in enumerate(cells))
    data = import_file(written(tmp_path, text), ImportOptions(decimal=decimal)).data
    assert data.position_mm.tolist() == list(values)


def test_numbers_that_may_have_a_comma_or_thousands_are_asked_for(tmp_path):
    path = written(tmp_path, "position [mm];deviation [um];axis\n0;1;X\n1,000;2;X\n")
    with pytest.raises(InputError, match=r"t.csv:3: numbers such as 1,000 may be 1000 or 1.000; give --decimal"):
        import_file(path)
    mixed = written(tmp_path, "position [mm];deviation [um];axis\n0;0.1;X\n1,000;0.2;X\n")
    with pytest.raises(InputError, match="a decimal point in line 2"):
        import_file(mixed)
    with pytest.raises(InputError, match="has no decimal comma"):
        import_file(mixed, ImportOptions(decimal="comma"))


def test_positions_without_a_unit_beside_values_in_inches_are_asked_for(tmp_path):
    path = written(tmp_path, "position,deviation [in],axis\n0,0.0001,X\n40,0.0002,X\n")
    assert any("--unit position=in or mm" in text for text in import_file(path).doubts)
    item = import_file(path, ImportOptions(units={"position": "in"}))
    assert item.doubts == ()
    assert item.data.position_mm.tolist() == [0, 1016]


def test_options_that_a_format_cannot_take_and_unknown_fields_are_refused(tmp_path):
    exchange = written(tmp_path, "[EXX]\nGridpoints = {\n0 0.001\n100 -0.002\n}\n", "e.txt")
    with pytest.raises(
        InputError, match="--map: does not apply to a file of the format etalon-exchange; --sign, --unit do"
    ):
        import_file(exchange, ImportOptions(columns={"position": "A"}))
    with pytest.raises(InputError, match="give linear= or angle="):
        import_file(exchange, ImportOptions(units={"value": "um"}))
    table = written(tmp_path, "position [mm],deviation [um],axis\n0,1,X\n1,2,X\n")
    with pytest.raises(InputError, match="--sheet: does not apply"):
        import_file(table, ImportOptions(sheet="A"))
    with pytest.raises(InputError, match="'postion' is not a field; did you mean 'position'"):
        import_file(table, ImportOptions(units={"postion": "mm"}))


def test_hidden_sheets_are_left_out_and_remarks_below_a_table_end_it(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "X"
    rows = [
        ["Positioning"],
        [],
        ["Target [mm]", "Deviation [um]"],
        [0, 1],
        [100, 2],
        [],
        ["Mean", 1.5],
        ["Signed: N. N."],
    ]
    for row in rows:
        book.active.append(row)
    hidden = book.create_sheet("Y")
    for row in rows[2:5]:
        hidden.append(row)
    hidden.sheet_state = "hidden"
    book.save(tmp_path / "b.xlsx")
    item = import_file(tmp_path / "b.xlsx")
    assert item.data.axes == (0,)
    assert item.data.deviation_mm.tolist() == [0.001, 0.002]
    assert any("sheet 'Y' is hidden" in text for text in item.notes)
    assert any("line 7 and everything below" in text for text in item.notes)
    assert import_file(tmp_path / "b.xlsx", ImportOptions(sheet="Y")).data.axes == (1,)
    second = "position [mm],deviation [um]\n0,1\n100,2\n\nposition,backward\n0,3\n"
    with pytest.raises(InputError, match=":6: rows of numbers follow again, below line 5"):
        import_file(written(tmp_path, second))


def test_cells_without_a_stored_value_say_what_may_be_the_reason(tmp_path):
    book = openpyxl.Workbook()
    for row in (["Target [mm]", "Deviation [um]"], [0, "=A2*2"], [100, 3]):
        book.active.append(row)
    book.save(tmp_path / "f.xlsx")
    with pytest.raises(InputError, match="a formula that was never calculated is empty"):
        import_file(tmp_path / "f.xlsx")


def laser(runs, flags="0 0 2 0", date="12/10/2016", beside="", name="x.rtl", axis="X"):
    targets = [0, 100, 200, 300, 400]
    lines = [
        "HEADER::",
        "File type  : rtl",
        "Owner : made up",
        "",
        "TARGET DATA::",
        "Filetype : ISO",
        "Target-count: 5",
    ]
    lines += [
        "Targets :",
        "0.000000  100.000000  200.000000  300.000000  400.000000 ",
        f"Flags: {flags}",
        "",
        "USER-TEXT::",
    ]
    lines += [
        "Machine: M",
        f"Date:{date}",
        f"Axis:{axis}",
        "Targets: 3 and 4",
        "",
        "RUNS::",
        f"Run-count: {len(runs)}",
        "",
    ]
    lines += ["DEVIATIONS::", "Run Target Data: "]
    for number, values in enumerate(runs, start=1):
        order = range(len(targets)) if number % 2 else range(len(targets) - 1, -1, -1)
        lines += [f"{number:5d}{k + 1:5d}    {values[k]:.3f}" for k in order]
    return "\r\n".join([*lines, "", beside, "EOF::", ""])


ENVIRONMENT = """ENVIRONMENT::\r
Air temp   : 20.30 20.50 0\r
Air press  : 99.04 99.05 1\r
Mat temp 1 : 21.00 21.20 0\r
Mat temp 2 : -10.000000 -10.000000 0\r
Mat temp 3 : 68.1 68.2 1\r
Exp coeff  : 8.000000 8.000000 0\r
Date Time  : "10:46 Dec 12 2016" "11:01 Dec 12 2016"\r
\r
EQUIPMENT::\r
Serial No : of the laser\r
"""
UP, DOWN = [1, 3, 5, 7, 9], [0, 2, 4, 6, 8]


def test_surroundings_of_a_laser_file_are_shown_and_used_where_they_are_clear(tmp_path):
    item = import_file(written(tmp_path, laser([UP, DOWN], beside=ENVIRONMENT), "x.rtl"))
    assert item.doubts == ()
    covariates = item.data.covariates
    np.testing.assert_allclose(covariates["temp_ambient_c"], 20.4, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(covariates["temp_material_1_c"], 21.1, rtol=0, atol=ROUNDING)
    assert set(covariates) == {"temp_ambient_c", "temp_material_1_c"}
    assert item.data.metadata["measured_at"] == "2016-12-12T10:46:00"
    assert item.understood["environment"]["air press"] == "99.04 99.05 1"
    assert item.understood["equipment"] == {"serial no": "of the laser"}
    assert "serial no" not in item.understood
    notes = " ".join(item.notes)
    assert "mat temp 2" in notes
    assert "mat temp 3" in notes
    assert "expansion coefficient" in notes
    assert len(item.data) == 10


def test_the_date_of_a_laser_file_is_never_guessed(tmp_path):
    path = written(tmp_path, laser([UP, DOWN]), "x.rtl")
    item = import_file(path)
    assert "measured_at" not in item.data.metadata
    assert "date" not in item.data.metadata
    assert any("--dates" in text for text in item.notes)
    assert import_file(path, ImportOptions(dates="dmy")).data.metadata["measured_at"] == "2016-10-12"


def test_runs_of_zeros_that_fill_up_a_one_way_test_are_no_readings(tmp_path):
    zero = [0, 0, 0, 0, 0]
    one_way = import_file(written(tmp_path, laser([UP, zero, UP, zero], flags="0 1 2 0"), "x.rtl"))
    assert one_way.doubts == ()
    assert one_way.data.direction.tolist() == [1] * 10
    assert one_way.data.run.tolist() == [1] * 5 + [2] * 5
    path = written(tmp_path, laser([UP, zero, UP, zero]), "y.rtl")
    assert any("--zero-runs" in text for text in import_file(path).doubts)
    assert len(import_file(path, ImportOptions(zero_runs="drop")).data) == 10
    kept = import_file(path, ImportOptions(zero_runs="keep"))
    assert kept.doubts == ()
    assert len(kept.data) == 20


def test_the_name_of_a_laser_file_may_say_the_axis(tmp_path):
    item = import_file(written(tmp_path, laser([UP, DOWN], axis=""), "mill_y-axis.rtl"))
    assert item.data.axes == (1,)
    assert "axis Y by the name of the file" in item.notes


def test_a_sheet_of_a_million_rows_is_refused_unread(tmp_path, monkeypatch):
    row = b"<row><c><v>1.5</v></c><c><v>0.25</v></c></row>"
    with zipfile.ZipFile(tmp_path / "m.xlsx", "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("[Content_Types].xml", "<a/>")
        archive.writestr("xl/workbook.xml", "<a/>")
        archive.writestr("xl/worksheets/sheet1.xml", b"<a>" + row * 1_100_000 + b"</a>")
    opened = []
    monkeypatch.setattr(
        zipfile.ZipFile, "open", lambda archive, member, *rest: opened.append(member.filename) or BytesIO()
    )
    with pytest.raises(InputError, match="a sheet of 51 MB unpacked; at most 48 MB are read: save that sheet as CSV"):
        import_file(tmp_path / "m.xlsx")
    assert opened == ["[Content_Types].xml", "xl/workbook.xml"]


def test_no_damage_to_a_table_or_a_laser_file_ends_in_anything_but_an_answer(tmp_path):
    generator = np.random.default_rng(11)
    whole = {"t.csv": LENGTHS.encode(), "x.rtl": laser([UP, DOWN], beside=ENVIRONMENT).encode()}
    pieces = (b"\xff", b",", b";", b"\0", b"1e999", b"::", b"\n", b"/", b"31/02/2025", b"1,000", b'"', b"nan", b"[K]")
    for name, content in whole.items():
        for _ in range(150):
            data = bytearray(content)
            for _ in range(int(generator.integers(1, 6))):
                place = int(generator.integers(len(data)))
                if generator.integers(3) == 0:
                    del data[place : place + int(generator.integers(1, 40))]
                else:
                    data[place:place] = pieces[int(generator.integers(len(pieces)))]
            try:
                item = import_file(written(tmp_path, bytes(data), name))
            except InputError:
                continue
            assert item.files()


def test_slips_are_remarked_on_and_deviations_of_more_than_100_mm_are_refused(tmp_path):
    def table(value):
        rows = [(t, t * 0.01) for t in range(0, 1000, 100)]
        rows[4] = (400, value)
        return "position [mm],deviation [um],axis\n" + "".join(f"{t},{v},X\n" for t, v in rows)

    assert not any("far from" in text for text in import_file(written(tmp_path, table(4.1))).notes)
    slip = import_file(written(tmp_path, table(4100)))
    assert any("4100 um at 400 mm, line 6, is far from all others" in text for text in slip.notes)
    large = import_file(written(tmp_path, table(4.1e6)))
    assert any("numbers look like" in text for text in large.doubts)
    readings = "target [mm],measured [mm],axis\n" + "".join(
        f"{t},{t * 1.00001:.5f},X\n" for t in range(0, 100_000, 100)
    )
    slipped = readings.replace("\n400,400.00400,", "\n400,4000.04,")
    with pytest.raises(InputError, match="t.csv:6: a deviation of 3600 mm is not plausible"):
        import_file(written(tmp_path, slipped))


def test_exchange_files_in_other_units_are_doubted_until_the_user_says_them(tmp_path):
    text = "[EXX]\nGridpoints = {\n0 1\n100 -2\n}\n[EAX]\nGridpoints = {\n0 1\n100 3\n}\n[C0Y]\nVALUE = 20\n"
    path = written(tmp_path, text, "e.txt")
    doubts = " ".join(import_file(path).doubts)
    for name in ("EXX reaches 2000 um", "EAX reaches 3e+06 urad", "C0Y reaches 2e+07 urad"):
        assert name in doubts
    item = import_file(path, ImportOptions(units={"linear": "um", "angle": "urad"}))
    assert item.doubts == ()
    np.testing.assert_allclose(item.data.curves["EXX"].value, [1e-3, -2e-3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(item.data.curves["EAX"].value, [1e-6, 3e-6], rtol=0, atol=1e-18)
    assert item.data.squareness["EC0Y"][0] == pytest.approx(2e-5, abs=1e-18)
    confirmed = import_file(path, ImportOptions(units={"linear": "mm", "angle": "rad"}))
    assert confirmed.doubts == ()
    assert confirmed.data.curves["EXX"].value.tolist() == [1, -2]


def test_the_projects_own_columns_are_known_in_another_dialect(tmp_path):
    names = "station point x_mm y_mm z_mm length_mm tool_x_mm tool_y_mm tool_z_mm time_s temp_x_c temp_ambient_c"
    names += " feed_mm_min load_kg u_length_um approach_x run line"
    cells = [
        "A",
        "{k}",
        "{k}00",
        "0",
        "0",
        "1{k}0,5",
        "0",
        "0",
        "9",
        "{k}",
        "20,1",
        "20,2",
        "500",
        "3",
        "0,2",
        "1",
        "1",
        "{k}",
    ]
    rows = [";".join(cells).format(k=k) for k in (1, 2, 3)]
    item = import_file(written(tmp_path, "\n".join([names.replace(" ", ";"), *rows, ""])))
    assert item.doubts == ()
    assert "not_used" not in item.understood
    assert set(item.data.covariates) == {*names.split()[9:15]}
    assert set(item.data.labels) == {"run", "line"}
    assert item.data.covariates["u_length_um"].tolist() == [0.2] * 3
    assert item.data.approach[:, 0].tolist() == [1, 1, 1]
