"""Lengths from files of any size: CSV in parts and Parquet, with the result and the refusals of a file read at once."""

import importlib.util
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.data import csv_files, length_archive, records
from compgen.data.csv_files import csv_parts, read_csv
from compgen.data.length_archive import open_large, same_hash
from compgen.data.lengths import format_lengths
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import open_measurement, source
from compgen.identification import identify, identify_measurement, read_measurement, streamed_lengths

EXAMPLE = "examples/zha-gantry.lengths.csv"
pytestmark = pytest.mark.filterwarnings("ignore:.*too large to separate reversals")
REQUIRED = ("station", "point", "x_mm", "y_mm", "z_mm", "length_mm")
needs_pyarrow = pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed")


@pytest.fixture
def in_parts(monkeypatch):
    """Files of more than some bytes or readings are not read whole, and parts end in the middle of a stop."""
    for module in (records, source):
        monkeypatch.setattr(module, "LARGE_TEXT", 1000)
    monkeypatch.setattr(source, "MOST_OWN_BYTES", 1000)
    monkeypatch.setattr(csv_files, "PART_BYTES", 20_000)
    monkeypatch.setattr(length_archive, "MOST_WHOLE", 1000)
    monkeypatch.setattr(length_archive, "COMPARED", 3000)
    for module in (length_archive, streamed_lengths):
        monkeypatch.setattr(module, "CHUNK", 997)


def parts_of(path, text):
    path.write_bytes(text.encode())
    whole = read_csv(path, REQUIRED, ("run", "note"))
    parts = list(csv_parts(path, REQUIRED, ("run", "note")))
    assert [line for part in parts for line in part.lines] == list(whole.lines)
    for name, cells in whole.columns.items():
        assert [cell for part in parts for cell in part.columns[name]] == list(cells)
    assert dict(parts[-1].metadata) == dict(whole.metadata)
    return parts


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("size", [40, 64, 150, 10_000])
def test_parts_are_what_the_whole_file_is(tmp_path, monkeypatch, end, size):
    monkeypatch.setattr(csv_files, "PART_BYTES", max(size, 64))
    rows = [f"LT{k % 4},{k},{k}.5,-{k}.25,0.125,{1000 + k}.0625,{k % 3},text" for k in range(40)]
    head = ["# instrument = tracer", "", "# note = 1", f"{','.join(REQUIRED)},run,note"]
    lines = [*head, *rows[:20], "# operator = somebody", "", *rows[20:]]
    parts = parts_of(tmp_path / "a.lengths.csv", end.join([*lines, ""]))
    assert len(parts) > 1 or size == 10_000
    quoted = [*head, *rows[:10], '"LT1","p, q",1,2,3,4,1,"a ""word"""', *rows[10:]]
    parts_of(tmp_path / "b.lengths.csv", end.join(quoted))


def refused(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    messages = []
    for read in (
        lambda: read_csv(path, REQUIRED).numbers("x_mm"),
        lambda: [t.numbers("x_mm") for t in csv_parts(path, REQUIRED)],
    ):
        with pytest.raises(InputError) as error:
            read()
        messages.append(str(error.value))
    return messages


ROWS = [f"LT{k % 4},{k},{k}.5,-{k}.25,0.125,{1000 + k}.0625" for k in range(60)]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda rows: [*rows[:50], "LT1,7,1,2", *rows[50:]], ":52: has 4 fields"),
        (lambda rows: [*rows[:50], "LT1,7,seven,2,3,4", *rows[50:]], ":52: column x_mm: 'seven' is not a number"),
        (lambda rows: [*rows[:40], '"LT1,7,1,2,3,4', *rows[40:]], ":4"),
        (lambda rows: ["# rows = 61", *rows], "declares 61 rows but contains 60"),
        (lambda rows: [], "has a header but no rows"),
    ],
)
def test_what_is_wrong_in_a_late_part_is_named_by_its_line(tmp_path, monkeypatch, change, match):
    monkeypatch.setattr(csv_files, "PART_BYTES", 200)
    whole, part = refused(tmp_path / "a.csv", "\n".join([",".join(REQUIRED), *change(ROWS), ""]))
    assert match in part
    assert match == ":4" or whole.removesuffix(":2") == part


def test_other_damage_is_found_in_parts_too(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_files, "PART_BYTES", 200)
    head, path = ",".join(REQUIRED), tmp_path / "a.csv"
    whole, part = refused(path, "\n".join([head, *ROWS])[:-3])
    assert whole == part and "the file is truncated" in part
    whole, part = refused(path, "\n".join([head, *ROWS]).encode() + b"\xff\n")
    assert whole == part and part.startswith(f"{path}:61: is not UTF-8")
    whole, part = refused(path, "\n".join(["station,point", *ROWS, ""]))
    assert "column 'x_mm' is missing" in whole and whole == part
    whole, part = refused(path, "")
    assert whole == part and "is empty" in part
    path.write_bytes(head.encode() + b"\n" + b"0" * 1000)
    with pytest.raises(InputError, match=":2: is too long for a line"):
        list(csv_parts(path, REQUIRED))


def test_an_unknown_column_is_named_once(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_files, "PART_BYTES", 200)
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join([*REQUIRED, "colour"]), *(f"{row},red" for row in ROWS), ""]))
    with pytest.warns(CompgenWarning, match="'colour' is unknown and ignored") as caught:
        list(csv_parts(path, REQUIRED))
    assert len(caught) == 1


def values_of(result):
    return np.concatenate([*(curve.value for curve in result.errors.curves.values())])


def assert_same_result(found, whole):
    """As an archive: no reading is left out, and the optimum is the same."""
    assert found.readings == found.readings_used == whole.readings
    u = np.concatenate([curve.u for curve in whole.errors.curves.values()])
    assert np.abs((values_of(found) - values_of(whole))[u > 0] / u[u > 0]).max() < 2e-2
    for mine, theirs in zip(found.stations, whole.stations, strict=True):
        assert (mine.station, mine.readings) == (theirs.station, theirs.readings)
    assert found.reduced_chi_square == pytest.approx(whole.reduced_chi_square, rel=1e-2)


@pytest.fixture(scope="module")
def machine():
    return compgen.load_machine("zha-gantry")


@pytest.fixture(scope="module")
def whole(machine):
    return identify(machine, compgen.read_lengths(EXAMPLE))


@pytest.mark.usefixtures("in_parts")
def test_a_large_csv_file_gives_what_it_gives_in_memory(machine, whole):
    measurement = open_measurement([EXAMPLE])
    assert isinstance(measurement, length_archive.LengthArchive) and len(measurement) == whole.readings
    folder = measurement.columns["x_mm"].path.parent
    assert folder.is_dir()
    assert_same_result(identify_measurement(machine, measurement), whole)
    lengths, few = compgen.read_lengths(EXAMPLE), np.array([0, 17, 9000, 10_647])
    copied = measurement.taken(few)
    assert copied.origin == [lengths.origin[k] for k in few]
    np.testing.assert_array_equal(copied.position_mm, lengths.position_mm[few])
    np.testing.assert_array_equal(copied.length_mm, lengths.length_mm[few])
    assert dict(copied.metadata) == dict(lengths.metadata)
    del measurement
    assert not folder.exists()


def changed(path, change):
    lines = Path(EXAMPLE).read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("#")) + 1
    rows = lines[first:]
    path.write_text("\n".join([*(x for x in lines[:first] if "rows" not in x), *change(rows), ""]))
    return path


@pytest.mark.usefixtures("in_parts")
def test_a_reading_that_is_there_twice_is_found_across_parts(tmp_path):
    path = changed(tmp_path / "a.lengths.csv", lambda rows: [*rows, rows[5]])
    messages = []
    for read in (open_large, compgen.read_lengths):
        with pytest.raises(InputError, match="already appear in line") as error:
            read(path)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


@pytest.mark.usefixtures("in_parts")
def test_different_readings_with_the_same_hash_are_not_refused(monkeypatch):
    monkeypatch.setattr(
        length_archive,
        "hash",
        lambda identity: len(identity[1]) if identity[1] > "P2600" else hash(identity),
        raising=False,
    )
    assert len(open_large(EXAMPLE)) == 10_648


def test_pairs_of_equal_hashes_are_those_of_a_simple_search(monkeypatch):
    monkeypatch.setattr(length_archive, "COMPARED", 50)
    monkeypatch.setattr(length_archive, "CHUNK", 37)
    values = np.random.default_rng(2).integers(-300, 300, 400)
    last, expected = {}, []
    for row, value in enumerate(values.tolist()):
        if value in last:
            expected.append((last[value], row))
        last[value] = row
    assert same_hash(values) == expected[: length_archive.MOST_PAIRS] and len(expected) > 100


@pytest.mark.usefixtures("in_parts")
@pytest.mark.parametrize("column", ["tool_x_mm", "approach_x", "approach"])
def test_columns_that_need_all_readings_are_refused_or_named_in_a_large_file(tmp_path, column):
    path = tmp_path / "a.lengths.csv"
    path.write_text("\n".join([",".join([*REQUIRED, column]), *(f"{row},1" for row in ROWS), ""]))
    if column == "tool_x_mm":
        with pytest.raises(InputError, match=f"column {column}: needs all readings in memory"):
            open_large(path)
        return
    with pytest.warns(CompgenWarning, match=f"reversals: {column} are not used"):
        assert column not in open_large(path).columns


def test_memory_does_not_grow_with_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_files, "PART_BYTES", 50_000)
    monkeypatch.setattr(length_archive, "CHUNK", 1000)
    monkeypatch.setattr(length_archive, "COMPARED", 1000)
    monkeypatch.setattr(records, "LARGE_TEXT", 1000)
    peaks = []
    for count in (10_000, 80_000):
        path = tmp_path / f"{count}.lengths.csv"
        with path.open("w") as stream:
            stream.write(",".join(REQUIRED) + "\n")
            stream.writelines(
                f"LT{k % 4},{k},-{k % 800}.5,-{k % 900}.25,-1.125,{1000 + k % 999}.0625\n" for k in range(count)
            )
        tracemalloc.start()
        assert len(open_large(path)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


# --- Parquet --------------------------------------------------------------------------------------------------------


def parquet(path, columns, metadata=None, **options):
    import pyarrow
    from pyarrow import parquet as file

    table = pyarrow.table(columns)
    file.write_table(table.replace_schema_metadata(metadata or {}), path, **options)
    return path


def columns_of(lengths):
    return {
        "station": [lengths.stations[k] for k in lengths.station.tolist()],
        "point": list(lengths.point),
        **{f"{axis}_mm": lengths.position_mm[:, k] for k, axis in enumerate("xyz")},
        "length_mm": lengths.length_mm,
        **lengths.labels,
        **lengths.covariates,
    }


@needs_pyarrow
def test_a_parquet_file_is_what_the_csv_file_is(tmp_path, machine, whole, in_parts, monkeypatch):
    lengths = replace(compgen.read_lengths(EXAMPLE), approach=None)
    path = parquet(tmp_path / "a.parquet", columns_of(lengths), lengths.metadata, row_group_size=3000)
    large = open_measurement([path])
    assert isinstance(large, length_archive.LengthArchive)
    assert_same_result(identify_measurement(machine, large), whole)
    monkeypatch.setattr(length_archive, "MOST_WHOLE", 200_000)
    for read in (compgen.read_lengths, lambda file: read_measurement([file]), lambda file: open_measurement([file])):
        found = read(path)
        assert format_lengths(found) == format_lengths(lengths)
        assert found.origin[7] == (str(path), 8)


@needs_pyarrow
def test_whole_numbers_and_other_forms_of_text_are_labels_in_parquet(tmp_path):
    import pyarrow

    names = pyarrow.array(["LT1", "LT2", "LT1"]).dictionary_encode()
    columns = {
        "station": names,
        "point": [1, 1, 2],
        "x_mm": [0, 1, 2],
        "y_mm": [0.0] * 3,
        "z_mm": [0.0] * 3,
        "length_mm": [1.0] * 3,
    }
    found = compgen.read_lengths(parquet(tmp_path / "a.parquet", columns))
    assert found.point == ["1", "1", "2"] and found.station.tolist() == [0, 1, 0]


GOOD = {
    "station": ["A", "A"],
    "point": ["1", "2"],
    "x_mm": [0.0, 1.0],
    "y_mm": [0.0] * 2,
    "z_mm": [0.0] * 2,
    "length_mm": [1.0] * 2,
}


@needs_pyarrow
@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"x_mm": ["0", "1"]}, ":1: column x_mm: '0'; expected a number"),
        ({"x_mm": [0.0, None]}, ":2: column x_mm: is empty; expected a number"),
        ({"x_mm": [0.0, np.nan]}, ":2: column x_mm: nan is not a finite number"),
        ({"length_mm": [1.0, 2e6]}, ":2: column length_mm: .* more than a kilometre"),
        ({"station": ["A", None]}, ":2: column station: is empty"),
        ({"station": ["A", "B=C"]}, "remove the '='"),
        ({"point": [1.5, 2.5]}, ":1: column point: 1.5 is not a label"),
        ({"point": ["1", "1"]}, ":2: column point: .* already appear in line 1"),
        ({"setup": [0.5, 1.0]}, ":1: column setup: 0.5 is not a whole number"),
        ({"y_mm": None}, "column 'y_mm' is missing"),
        (dict.fromkeys(GOOD, []), "contains no readings"),
    ],
)
def test_a_malformed_parquet_file_is_refused(tmp_path, change, match):
    columns = {name: cells for name, cells in {**GOOD, **change}.items() if cells is not None}
    with pytest.raises(InputError, match=match):
        compgen.read_lengths(parquet(tmp_path / "a.parquet", columns))


@needs_pyarrow
def test_damaged_parquet_files_and_too_many_readings_are_refused(tmp_path, monkeypatch):
    path = parquet(tmp_path / "a.parquet", GOOD)
    content = path.read_bytes()
    for wrong in (b"", b"station,point", content[:-20]):
        path.write_bytes(wrong)
        for read in (compgen.read_lengths, open_large, lambda file: open_measurement([file])):
            with pytest.raises(InputError, match="is not a Parquet file, or is damaged"):
                read(path)
    with pytest.raises(InputError, match="no such file"):
        open_measurement([tmp_path / "b.parquet"])
    path.write_bytes(content)
    monkeypatch.setattr(length_archive, "MOST_WHOLE", 1)
    with pytest.raises(InputError, match="contains 2 readings"):
        compgen.read_lengths(path)


def test_without_pyarrow_it_is_said_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    path.write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"install compgen\[parquet\]"):
        read_measurement([path])
