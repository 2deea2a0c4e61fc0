"""The CSV dialect: what is refused, what is read, and that written files come back as they were; output folders."""

import csv
import os
import warnings
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.data import files
from compgen.data.csv_files import csv_table, fixed, format_csv, read_csv
from compgen.data.files import OutputFolder, read_bytes, read_text, write_file
from compgen.data.lengths import Points, format_points, read_points
from compgen.errors import CompgenWarning, InputError
from compgen.identification.any_measurement import format_residuals


@pytest.fixture
def saved(tmp_path):
    def save(content, name="table.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        return path

    return save


def refusal(path, required=("name", "value"), **how):
    """Message of the error that reading ``path`` and the numbers in its column ``value`` gives."""
    with pytest.raises(InputError) as caught:
        read_csv(path, required, **how).numbers("value")
    assert str(path) in str(caught.value)
    return str(caught.value)


# --- structure ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", ["", "\n\n", "# only = a comment\n", "\ufeff"])
def test_an_empty_file_is_refused(saved, content):
    assert "is empty; expected a header line with name, value" in refusal(saved(content))


def test_a_header_without_rows_is_refused(saved):
    assert "has a header but no rows" in refusal(saved("name,value\n"))


def test_a_missing_column_is_named_with_what_is_needed_and_what_is_there(saved):
    message = refusal(saved("# a comment\nname,valu\na,1\n"))
    assert ":2: column 'value' is missing; required are name, value; the header has name, valu" in message


def test_semicolons_between_columns_get_a_hint(saved):
    assert "separate columns by commas" in refusal(saved("name;value\na;1\n"))


def test_an_unknown_column_is_left_out_with_a_warning_that_names_the_nearest(saved):
    path = saved("name,value,valeu2\na,1,2\n")
    with pytest.warns(CompgenWarning, match=r"table.csv:1: column 'valeu2' is unknown.*did you mean 'value'"):
        table = read_csv(path, ["name", "value"])
    assert set(table.columns) == {"name", "value"}


def test_columns_of_an_allowed_prefix_or_pattern_are_kept(saved):
    path = saved("name,value,temp_x_c,more_1\na,1,20,5\n")
    table = read_csv(path, ["name", "value"], prefixes=("temp_*_c", "more_"))
    assert set(table.columns) == {"name", "value", "temp_x_c", "more_1"}


def test_a_column_that_misses_an_allowed_pattern_is_left_out(saved):
    path = saved("name,value,temp_x_f\na,1,68\n")
    with pytest.warns(CompgenWarning, match="temp_x_f"):
        assert "temp_x_f" not in read_csv(path, ["name", "value"], prefixes=("temp_*_c",)).columns


def test_a_doubled_column_is_refused(saved):
    assert "contains 'value' twice" in refusal(saved("name,value,value\na,1,2\n"))


@pytest.mark.parametrize(("row", "fields"), [("b", 1), ("b,2,3", 3)])
def test_a_row_with_another_number_of_fields_is_refused_with_its_line(saved, row, fields):
    assert f":4: has {fields} fields, the header has 2" in refusal(saved(f"name,value\na,1\n\n{row}\nc,3\n"))


def test_a_last_row_with_too_few_fields_asks_whether_the_file_is_truncated(saved):
    assert "truncated" in refusal(saved("name,value\na,1\nb"))


def test_columns_may_come_in_any_order_and_blank_lines_and_comments_are_skipped(saved):
    table = read_csv(saved("# unit = um\n value , name\n\n1.5, a\n# note\n2,b\n"), ["name", "value"])
    assert table.text("name") == ["a", "b"]
    assert table.numbers("value").tolist() == [1.5, 2.0]
    assert list(table.lines) == [4, 6]
    assert table.metadata == {"unit": "um"}


@pytest.mark.parametrize("newline", ["\r\n", "\r", "\n"])
def test_every_line_end_and_a_byte_order_mark_are_understood(saved, newline):
    table = read_csv(saved("\ufeff" + newline.join(["# a = b", "name,value", "p,1", "q,2", ""])), ["name", "value"])
    assert table.text("name") == ["p", "q"]
    assert list(table.lines) == [3, 4]


def test_quoted_text_may_hold_commas_quotes_and_a_hash(saved):
    table = read_csv(saved('name,value\n"a, ""b""",1\n "#c",2\n'), ["name", "value"])
    assert table.text("name") == ['a, "b"', "#c"]


def test_a_label_with_an_exotic_line_separator_stays_one_row(saved):
    assert len(read_csv(saved("name,value\na\u2028b,1\nc,2\n"), ["name", "value"])) == 2


def test_a_quote_that_is_never_closed_is_refused(saved):
    assert "not readable as CSV" in refusal(saved('name,value\na,1\n"b,2\nc,3\n'))


def test_a_quoted_field_over_a_line_end_is_refused(saved):
    assert "contains a line end" in refusal(saved('name,value\n"a\nb",1\n'))


def test_text_after_a_closing_quote_is_refused_with_its_line(saved):
    assert ":3: is not readable as CSV" in refusal(saved('name,value\na,1\n"b"x,2\n'))


def test_nul_bytes_are_refused(saved):
    assert "NUL" in refusal(saved(b"name,value\na,1\0\n"))


def test_text_that_is_not_utf_8_is_refused_with_its_line(saved):
    assert ":2: is not UTF-8" in refusal(saved("name,value\nK\xf6ln,1\n".encode("latin-1")))
    assert "is not UTF-8" in refusal(saved("name,value\na,1\n".encode("utf-16")))


def test_a_folder_or_a_file_that_is_not_there_is_refused(tmp_path):
    assert "is a folder; expected a file" in refusal(tmp_path)
    assert "no such file" in refusal(tmp_path / "missing.csv")
    (tmp_path / "file").write_text("x")
    assert "cannot be read" in refusal(tmp_path / "file" / "below.csv")
    assert "cannot be read" in refusal(tmp_path / ("n" * 400))


# --- numbers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "says"),
    [
        ("1O.5", "'1O.5' is not a number; expected a number with '.' as decimal point"),
        ("12 um", "'12 um' is not a number"),
        ('"1,5"', "'1,5' is not a number"),
        ("1_000", "'1_000' is not a number"),
        ("\u0661\u0662", "'\u0661\u0662' is not a number"),
        ("0x10", "'0x10' is not a number"),
        ("", "is empty; expected a number"),
        ("nan", "'nan' is not a finite number"),
        ("NaN", "'NaN' is not a finite number"),
        ("inf", "'inf' is not a finite number"),
        ("-Infinity", "'-Infinity' is not a finite number"),
        ("1e999", "'1e999' is not a finite number"),
    ],
)
def test_what_is_no_finite_number_is_refused_with_line_and_column(saved, cell, says):
    message = refusal(saved(f"name,value\na,1\nb,{cell}\nc,3\n"))
    assert f":3: column value: {says}" in message


def test_numbers_may_have_signs_spaces_and_exponents(saved):
    table = read_csv(saved("name,value\na, +1.5 \nb,-2.5e-3\nc,.5\nd,3.\n"), ["name", "value"])
    assert table.numbers("value").tolist() == [1.5, -0.0025, 0.5, 3.0]


def test_empty_cells_take_the_given_value_but_nan_in_words_does_not(saved):
    table = read_csv(saved("name,value\na,\nb,2\n"), ["name", "value"])
    np.testing.assert_array_equal(table.numbers("value", empty=np.nan), [np.nan, 2.0])
    table = read_csv(saved("name,value\na,\nb,nan\n"), ["name", "value"])
    with pytest.raises(InputError, match=":3: column value: 'nan' is not a finite number"):
        table.numbers("value", empty=np.nan)


def test_an_empty_label_is_refused(saved):
    with pytest.raises(InputError, match=":3: column name: is empty"):
        read_csv(saved("name,value\na,1\n,2\n"), ["name", "value"]).text("name")


@pytest.mark.parametrize("cell", ["1.5", "1e300", "-1e19"])
def test_a_label_must_be_a_whole_number_that_a_double_holds(saved, cell):
    with pytest.raises(InputError, match=":2: column value: .* is not a whole number"):
        read_csv(saved(f"name,value\na,{cell}\n"), ["name", "value"]).labels("value")


def test_whole_number_labels_come_back_as_integers(saved):
    labels = read_csv(saved("name,value\na,-3\nb,4.0\n"), ["name", "value"]).labels("value")
    assert labels.tolist() == [-3, 4] and labels.dtype == np.int64


def test_a_direction_is_plus_one_minus_one_or_zero(saved):
    assert read_csv(saved("name,value\na,1\nb,-1\nc,0\n"), ["name", "value"]).signs("value").tolist() == [1, -1, 0]
    with pytest.raises(InputError, match=":2: column value: '2' is not a direction"):
        read_csv(saved("name,value\na,2\n"), ["name", "value"]).signs("value")


# --- truncation and round trip ------------------------------------------------------------------------------------


def test_a_file_that_declares_more_rows_than_it_holds_is_refused(saved):
    assert "declares 3 rows but contains 2" in refusal(saved("# rows = 3\nname,value\na,1\nb,2\n"))


def test_without_a_declared_number_a_shorter_last_number_without_line_end_is_refused(saved):
    assert ":4: the last line has no line end and fewer decimals" in refusal(
        saved("name,value\na,1.25\nb,2.125\nc,3.5")
    )


def test_a_complete_last_line_may_lack_its_line_end(saved):
    table = read_csv(saved("name,value\na,1.25\nb,2.50\nc,3.75"), ["name", "value"])
    assert table.numbers("value").tolist() == [1.25, 2.5, 3.75]


WRITTEN = {
    "numbers last": {"name": [f"P{k}" for k in range(40)], "value": np.linspace(-5, 5, 40)},
    "whole numbers last": {"name": [f"P{k}" for k in range(40)], "value": np.arange(90.0, 130.0)},
    "text last": {"value": np.linspace(-5, 5, 40), "name": [f"P{k}" for k in range(40)]},
    "empty last": {"name": [f"P{k}" for k in range(40)], "value": np.ones(40), "u": np.full(40, np.nan)},
    "one row": {"name": ["P"], "value": np.array([123.456])},
    "two rows": {"name": ["P", "Q"], "value": np.array([1.0, 123.456])},
}


@pytest.mark.parametrize("columns", WRITTEN.values(), ids=WRITTEN.keys())
def test_a_written_file_cut_at_any_byte_is_refused_or_holds_the_same_values(saved, columns):
    whole = format_csv(columns).encode()
    complete = read_csv(saved(whole), ["name", "value"], ["u"]).columns
    for cut in range(max(0, len(whole) - 200), len(whole)):
        try:
            table = read_csv(saved(whole[:cut]), ["name", "value"], ["u"])
        except InputError:
            continue
        assert table.columns == complete, cut


def test_what_is_written_comes_back_exact_to_the_written_decimals_without_exponents(saved):
    rng = np.random.default_rng(13)
    values = np.concatenate([rng.normal(size=200) * 10.0 ** rng.integers(-9, 9, 200), [0.0, -0.0, 1e-12, -1e-12, 1e15]])
    columns = {"name": [f'a "{k}", #{k}' for k in range(len(values))], "value": values}
    text = format_csv(columns, {"source": "a\nb = c", "machine": "m"}, {"value": 7})
    numbers = [line.rpartition(",")[2] for line in text.splitlines() if not line.startswith(("#", "name"))]
    assert not any("e" in cell.lower() or cell.startswith("-0.0000000") for cell in numbers)
    table = read_csv(saved(text), ["name", "value"])
    assert table.text("name") == columns["name"]
    assert table.metadata == {"source": "a b = c", "machine": "m", "rows": str(len(values))}
    np.testing.assert_array_equal(table.numbers("value"), [float(f"{value:.7f}") for value in values])


def test_a_number_is_written_without_exponent_or_negative_zero():
    assert [fixed(v, 3) for v in (1e-9, -1e-9, -0.0, 1e16, -1.0005)] == ["0.000"] * 3 + [
        "10000000000000000.000",
        "-1.000",
    ]
    assert fixed(-0.4, 0) == "0"


def test_an_infinite_number_is_never_written():
    with pytest.raises(ValueError, match="infinite"):
        format_csv({"value": np.array([1.0, np.inf])})


def test_points_come_back_with_tool_approach_and_results(saved):
    rng = np.random.default_rng(14)
    points = Points(
        rng.uniform(-900, 900, (5, 3)).round(6), rng.uniform(0, 9, (5, 3)).round(6), rng.choice([-1.0, 1.0], (5, 3))
    )
    path = saved(format_points(points, {"ex_um": rng.normal(size=5)}, {"machine": "m"}))
    with pytest.warns(CompgenWarning, match="ex_um"):
        back = read_points(path)
    for name in ("position_mm", "tool_mm", "approach"):
        np.testing.assert_array_equal(getattr(back, name), getattr(points, name))


def test_points_with_a_part_of_the_tool_columns_are_refused(saved):
    with pytest.raises(InputError, match="has tool_x_mm but not all of tool_x_mm, tool_y_mm, tool_z_mm"):
        read_points(saved("x_mm,y_mm,z_mm,tool_x_mm\n0,0,0,1\n"))


def test_points_without_tool_and_approach_have_none(saved):
    points = read_points(saved("z_mm,x_mm,y_mm\n3,1,2\n"))
    assert points.position_mm.tolist() == [[1.0, 2.0, 3.0]]
    assert points.tool_mm is None and points.approach is None and len(points) == 1


def test_an_approach_that_is_no_direction_is_refused(saved):
    with pytest.raises(InputError, match="approach_y: '7' is not a direction"):
        read_points(saved("x_mm,y_mm,z_mm,approach_x,approach_y,approach_z\n0,0,0,1,7,1\n"))


# --- output folders -----------------------------------------------------------------------------------------------


def names_below(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_all_files_of_a_set_are_written_with_their_bytes(tmp_path):
    out = OutputFolder(tmp_path / "new" / "out")
    out.add("a.csv", "\u00b5m\r\n")
    out.add("sub/b.bin", b"\0\1")
    paths = out.commit()
    assert paths["a.csv"].read_bytes() == b"\xc2\xb5m\r\n"
    assert paths["sub/b.bin"].read_bytes() == b"\0\1"
    assert names_below(tmp_path / "new" / "out") == ["a.csv", "sub", "sub/b.bin"]


def test_written_files_have_the_usual_rights(tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("x")
    assert write_file(tmp_path / "atomic", "x").stat().st_mode == plain.stat().st_mode


def test_nothing_is_there_before_commit(tmp_path):
    OutputFolder(tmp_path / "out").add("a", "x")
    assert names_below(tmp_path) == []


def test_a_second_file_that_cannot_be_written_leaves_nothing_behind(tmp_path, monkeypatch):
    genuine = files._write_temporary

    def full_disk(target: Path, content: bytes, mode: int | None = None) -> Path:
        if target.name == "b":
            raise OSError(28, "No space left on device")
        return genuine(target, content, mode)

    monkeypatch.setattr(files, "_write_temporary", full_disk)
    out = OutputFolder(tmp_path / "new" / "out")
    out.add("a", "x")
    out.add("b", "y")
    with pytest.raises(InputError, match="No space left on device; nothing was written"):
        out.commit()
    assert names_below(tmp_path) == []


def test_a_second_file_that_cannot_be_renamed_puts_the_first_back(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("old")
    genuine = os.replace

    def failing(source, target):
        if Path(target).name == "c":
            raise OSError(5, "Input/output error")
        genuine(source, target)

    monkeypatch.setattr(os, "replace", failing)
    out = OutputFolder(tmp_path)
    for name in ("a", "b", "c"):
        out.add(name, "new")
    with pytest.raises(InputError, match="nothing was written"):
        out.commit()
    assert names_below(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_a_folder_in_the_place_of_a_file_stops_the_whole_set(tmp_path):
    (tmp_path / "b").mkdir()
    out = OutputFolder(tmp_path)
    out.add("a", "x")
    out.add("b", "y")
    with pytest.raises(InputError, match="b is a folder; nothing was written"):
        out.commit()
    assert names_below(tmp_path) == ["b"]


@pytest.mark.parametrize("below", ["", "new/out"])
def test_a_folder_without_write_bits_is_refused_for_every_user(tmp_path, below):
    locked = tmp_path / "locked"
    locked.mkdir()
    locked.chmod(0o555)
    try:
        with pytest.raises(InputError, match="the output folder is read-only"):
            OutputFolder(locked / below)
    finally:
        locked.chmod(0o755)


@pytest.mark.parametrize("below", ["", "out"])
def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path, below):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file; --out needs a folder"):
        OutputFolder(tmp_path / "file" / below)
    assert (tmp_path / "file").read_text() == "x"


def test_a_name_that_the_file_system_cannot_hold_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be used"):
        OutputFolder(tmp_path / ("n" * 400))


def test_read_text_drops_the_byte_order_mark_and_read_bytes_keeps_it(tmp_path):
    path = write_file(tmp_path / "bom", b"\xef\xbb\xbfx")
    assert read_text(path) == "x"
    assert read_bytes(path) == b"\xef\xbb\xbfx"


def test_reading_a_good_file_warns_of_nothing(saved):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read_csv(saved("name,value\na,1\n"), ["name", "value"])
    assert len(table) == 1


def test_no_label_of_the_residuals_is_a_formula_for_a_spreadsheet(small_machine, small_lengths_file, tmp_path):
    text = small_lengths_file.read_text().replace("\nS1,", "\n+HYPERLINK(1),").replace("\nS2,", "\n@S2,")
    path = tmp_path / "x.lengths.csv"
    path.write_text(text)
    lengths = compgen.read_lengths(path)
    found = format_residuals(small_machine, lengths, compgen.identify(small_machine, lengths))
    assert "\n'+HYPERLINK(1)," in found and "\n'@S2," in found
    table = csv_table(tmp_path / "residuals.csv", found, ("station", "residual_um"), ("used", "x_mm", "y_mm", "z_mm"))
    assert {"+HYPERLINK(1)", "@S2", "S3", "S4"} == set(table.text("station"))


LABELS = ["=1+1", "+A", "-A", "@A", "'=1", "''@x", " \t=2", "'quoted", "-5", "+", "-", "-2.5e3", "A-1", "=a,b", "-1_0"]


def test_a_label_that_is_a_formula_is_guarded_and_comes_back_as_it_was(tmp_path):
    text = format_csv({"label": LABELS, "x_mm": np.arange(len(LABELS)) - 5.0})
    cells = [row[0] for row in csv.reader(line for line in text.splitlines() if not line.startswith("#"))][1:]
    for cell in cells:  # a number, a lone sign, or nothing that a spreadsheet would work out
        assert cell[0] not in "=+-@" or cell in ("-5", "+", "-", "-2.5e3")
    table = csv_table(tmp_path / "labels.csv", text, ("label", "x_mm"))
    assert table.text("label") == [label.strip() for label in LABELS]
    assert table.numbers("x_mm")[0] == -5.0


def test_a_comment_is_no_formula_after_its_commas(tmp_path):
    text = format_csv({"x_mm": np.zeros(1)}, {"machine": "mill,=1+1,@SUM(A1);-2", "range_mm": "0, -5"})
    first = text.splitlines()[0]
    assert not [cell for line in (first, first.replace(";", ",")) for cell in line.split(",") if cell[0] in "=+-@"]
    assert csv_table(tmp_path / "x.csv", text, ["x_mm"]).metadata["range_mm"] == "0, -5"


def test_an_equals_sign_in_the_name_of_a_station_is_refused(small_lengths_file, tmp_path):
    path = tmp_path / "x.lengths.csv"
    path.write_text(small_lengths_file.read_text().replace("\nS2,", "\nS=2,"))
    with pytest.raises(InputError, match=r"column station: 'S=2' is not a valid name; remove the '='"):
        compgen.read_lengths(path)


@pytest.mark.parametrize("name", ["=1+1", "mill=1", "+mill", "-mill", "@mill", " @mill"])
def test_a_machine_with_the_name_of_a_formula_is_refused(name, small_machine_file, tmp_path):
    text = small_machine_file.read_text()
    own = next(line for line in text.splitlines() if line.startswith("name"))
    path = tmp_path / "mill.toml"
    path.write_text(text.replace(own, f'name = "{name}"'))
    with pytest.raises(InputError, match="a name without '=' that does not begin with"):
        compgen.load_machine(path)
    path.write_text(text.replace(own, 'name = "A-1 + 5 @ 20"'))
    assert compgen.load_machine(path).name == "A-1 + 5 @ 20"
