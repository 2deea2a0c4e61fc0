"""Laser-tracer lengths: reading one or several files, what is refused, and the round trip."""

import numpy as np
import pytest

from compgen.data.lengths import Lengths, format_lengths, read_lengths
from compgen.errors import CompgenWarning, InputError

HEADER = "station,point,x_mm,y_mm,z_mm,length_mm"


@pytest.fixture
def saved(tmp_path):
    def save(text, name="a.lengths.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return save


def refusal(*paths):
    with pytest.raises(InputError) as caught:
        read_lengths(list(paths))
    return str(caught.value)


def example(rows=12):
    rng = np.random.default_rng(15)
    return Lengths(
        stations=("LT1", "LT2"),
        station=np.arange(rows) % 2,
        point=[f"P{k // 2}" for k in range(rows)],
        position_mm=rng.uniform(-1000, 1000, (rows, 3)),
        length_mm=rng.uniform(-500, 500, rows),
        tool_mm=rng.uniform(-100, 100, (rows, 3)),
        approach=rng.choice([-1.0, 1.0], (rows, 3)),
        labels={"run": np.arange(rows) // 4, "pose": np.arange(rows) // 2 + 7},
        covariates={"time_s": np.arange(rows) * 1.5, "temp_x_c": rng.uniform(19, 21, rows).round(3)},
        metadata={"machine": "mill"},
    )


def test_the_required_columns_are_enough_in_any_order(saved):
    path = saved("length_mm,z_mm,point,x_mm,station,y_mm\n7.5,3,P1,1,B,2\n8.5,6,P1,4,A,5\n")
    lengths = read_lengths(path)
    assert lengths.stations == ("B", "A") and lengths.station.tolist() == [0, 1]
    assert lengths.position_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert lengths.length_mm.tolist() == [7.5, 8.5] and list(lengths.point) == ["P1", "P1"]
    assert lengths.tool_mm is None and lengths.approach is None and lengths.labels == {} and lengths.covariates == {}
    assert lengths.origin == [(str(path), 2), (str(path), 3)] and len(lengths) == 2


def test_what_is_written_comes_back(saved):
    lengths = example()
    back = read_lengths(saved(format_lengths(lengths)))
    assert back.stations == lengths.stations and list(back.point) == lengths.point and back.metadata == lengths.metadata
    np.testing.assert_array_equal(back.station, lengths.station)
    nanometre, tenth_of_it = 1e-6, 1e-7
    np.testing.assert_allclose(back.position_mm, lengths.position_mm, rtol=0, atol=0.51 * nanometre)
    np.testing.assert_allclose(back.tool_mm, lengths.tool_mm, rtol=0, atol=0.51 * nanometre)
    np.testing.assert_allclose(back.length_mm, lengths.length_mm, rtol=0, atol=0.51 * tenth_of_it)
    np.testing.assert_array_equal(back.approach, lengths.approach)
    assert list(back.labels) == ["run", "pose"] and sorted(back.covariates) == ["temp_x_c", "time_s"]
    for name in back.labels:
        np.testing.assert_array_equal(back.labels[name], lengths.labels[name])
    for name in back.covariates:
        np.testing.assert_array_equal(back.covariates[name], lengths.covariates[name])
    assert format_lengths(back) == format_lengths(lengths)


@pytest.mark.parametrize("rows", [1, 2, 12])
def test_a_written_file_cut_at_any_byte_is_refused_or_the_same(saved, rows):
    text = format_lengths(example(rows))
    path = saved(text)
    for cut in range(max(0, len(text) - 200), len(text)):
        path.write_text(text[:cut])
        try:
            back = read_lengths(path)
        except InputError:
            continue
        assert format_lengths(back) == text, cut


def test_several_files_become_one_measurement(saved):
    first = saved(f"# machine = a\n# note = 1\n{HEADER},run,temp_x_c\nA,P1,0,0,0,1,3,20\n")
    second = saved(f"# machine = b\n{HEADER}\nB,P1,0,0,0,2\nA,P2,1,0,0,3\n", "b.lengths.csv")
    lengths = read_lengths([first, second])
    assert lengths.stations == ("A", "B") and lengths.station.tolist() == [0, 1, 0]
    assert lengths.labels["run"].tolist() == [3, 0, 0]
    np.testing.assert_array_equal(lengths.covariates["temp_x_c"], [20, np.nan, np.nan])
    assert lengths.metadata == {"machine": "a", "note": "1"}
    assert lengths.origin[1:] == [(str(second), 3), (str(second), 4)]


def test_the_same_rows_in_two_files_are_refused(saved):
    text = f"{HEADER}\nA,P1,0,0,0,1\n"
    first, copy = saved(text), saved("# copied\n" + text, "copy.lengths.csv")
    for again in (first, copy):
        message = refusal(first, again)
        assert message == f"{again}: contains the same rows as {first}; give each measurement only once"


def test_no_file_at_all_is_refused():
    assert "no measurement file was given" in refusal()


def test_a_station_that_sees_a_point_twice_needs_a_label(saved):
    rows = "A,P1,0,0,0,1\nB,P1,0,0,0,2\nA,P1,0,0,0,3\n"
    path = saved(f"{HEADER}\n{rows}")
    assert f"{path}:4: column point: station 'A' and point 'P1' already appear in line 2" in refusal(path)


@pytest.mark.parametrize("label", ["run", "repeat", "line", "block", "setup", "pose", "time_s"])
def test_labels_and_times_tell_repeats_apart(saved, label):
    path = saved(f"{HEADER},{label}\nA,P1,0,0,0,1,1\nA,P1,0,0,0,3,2\n")
    assert len(read_lengths(path)) == 2
    path = saved(f"{HEADER},{label}\nA,P1,0,0,0,1,1\nA,P1,0,0,0,3,1\n")
    assert "already appear in line 2" in refusal(path)


@pytest.mark.parametrize(
    ("columns", "row", "says"),
    [
        ("", "A,P1,0,0,0,2000000", "column length_mm: 2e+06 mm is more than a kilometre; is the unit mm?"),
        ("", "A,P1,0,x,0,1", "column y_mm: 'x' is not a number"),
        ("", "A,P1,0,0,nan,1", "column z_mm: 'nan' is not a finite number"),
        ("", "A,,0,0,0,1", "column point: is empty"),
        ("", ",P1,0,0,0,1", "column station: is empty"),
        (",run", "A,P1,0,0,0,1,1.5", "column run: '1.5' is not a whole number"),
        (",approach", "A,P1,0,0,0,1,2", "column approach: '2' is not a direction"),
        (",approach_x", "A,P1,0,0,0,1,0.5", "column approach_x: '0.5' is not a direction"),
        (",temp_x_c", "A,P1,0,0,0,1,warm", "column temp_x_c: 'warm' is not a number"),
    ],
)
def test_a_faulty_cell_is_refused_with_line_and_column(saved, columns, row, says):
    path = saved(f"{HEADER}{columns}\n{row}\n")
    assert refusal(path).startswith(f"{path}:2: {says}")


def test_a_tool_offset_needs_all_three_columns_in_every_file(saved):
    whole = saved(f"{HEADER},tool_x_mm,tool_y_mm,tool_z_mm\nA,P1,0,0,0,1,0,0,5\n")
    part = saved(f"{HEADER},tool_x_mm\nA,P2,0,0,0,1,0\n", "part.lengths.csv")
    none = saved(f"{HEADER}\nA,P3,0,0,0,1\n", "none.lengths.csv")
    assert read_lengths(whole).tool_mm.tolist() == [[0, 0, 5]]
    assert f"{part}: has tool_x_mm but not all of" in refusal(whole, part)
    assert f"{none}: lacks tool_x_mm, tool_y_mm, tool_z_mm, which another file has" in refusal(whole, none)


def test_an_approach_that_is_not_given_is_unknown(saved):
    path = saved(f"{HEADER},approach_y\nA,P1,0,0,0,1,-1\n")
    assert read_lengths(path).approach.tolist() == [[0, -1, 0]]


def test_the_direction_of_the_last_moving_axis_and_other_covariates_are_kept(saved):
    path = saved(f"{HEADER},approach,feed_mm_min,load_kg,temp_spindle_c\nA,P1,0,0,0,1,-1,2000,50,31.5\n")
    covariates = read_lengths(path).covariates
    assert {name: values.tolist() for name, values in covariates.items()} == {
        "approach": [-1],
        "feed_mm_min": [2000],
        "load_kg": [50],
        "temp_spindle_c": [31.5],
    }


def test_a_temperature_that_is_not_in_degrees_celsius_is_left_out(saved):
    with pytest.warns(CompgenWarning, match="column 'temp_x_k' is unknown and ignored"):
        lengths = read_lengths(saved(f"{HEADER},temp_x_k\nA,P1,0,0,0,1,293\n"))
    assert lengths.covariates == {}


def test_a_part_keeps_each_reading_with_everything_that_belongs_to_it(saved):
    whole = read_lengths(saved(format_lengths(example())))
    for rows, expected in ((np.array([5, 0]), [5, 0]), (np.arange(12) % 7 == 3, [3, 10])):
        part = whole.part(rows)
        assert part.stations == whole.stations and len(part) == 2
        for k, row in enumerate(expected):
            assert part.station[k] == whole.station[row] and part.length_mm[k] == whole.length_mm[row]
            assert part.point[k] == whole.point[row] and part.origin[k] == whole.origin[row]
            for name in ("position_mm", "tool_mm", "approach"):
                assert getattr(part, name)[k].tolist() == getattr(whole, name)[row].tolist()
            for name in ("labels", "covariates"):
                values = getattr(part, name)
                assert {key: value[k] for key, value in values.items()} == {
                    key: value[row] for key, value in getattr(whole, name).items()
                }
