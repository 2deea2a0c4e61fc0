"""The fast ways through CSV text give what the thorough ones give: reading plain files, writing columns of numbers."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from compgen.data.csv_files import fixed, format_csv, parse_any, parse_plain, read_csv
from compgen.errors import InputError

HEADS = ["a,b\n", "# k = v\n\n a , b,c \n", "a\n", '"a",b\n', "# rows = 2\r\na,b\r\n", "\ra,b\n", "a,\n", "a,b"]
CELLS = st.text(alphabet="1.-e\u00fc\x1f\x85", max_size=3)
ENDS = st.sampled_from([",", ",", ",", "\n", "\n", "\r\n", "\r", " ", "#", '"', "\0"])


@settings(max_examples=600, deadline=None)
@given(head=st.sampled_from(HEADS), parts=st.lists(st.tuples(CELLS, ENDS), max_size=12))
@example(head="a,b\n", parts=[("1", ","), ("2", "\n"), ("3", ","), ("", "\n")])
@example(head="a,b\n", parts=[("1", "\n"), ("2", ","), ("3", ","), ("4", "\n")])
@example(head="a,b\n", parts=[("1", ","), ("2", "\n"), ("", "\n"), ("3", ","), ("4", "\n")])
def test_whatever_is_read_as_plain_is_read_the_same_line_by_line(head, parts):
    content = head + "".join(cell + end for cell, end in parts)
    plain = parse_plain(content)
    if plain is None:
        return
    due = parse_any(Path("x.csv"), content)
    assert (plain.header_line, plain.header, plain.metadata) == (due.header_line, due.header, due.metadata)
    assert list(plain.lines) == due.lines
    assert all(len(row) == len(due.header) for row in due.rows)
    for k in range(len(due.header)):
        assert plain.column(k) == due.column(k)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_what_the_program_writes_is_read_as_plain(newline):
    text = format_csv(
        {"x": np.array([1.0, -2.0]), "name": ["p", "q"], "y": np.array([np.nan, 3.5])}, {"machine": "m 1"}
    )
    plain = parse_plain(text.replace("\n", newline))
    assert plain is not None
    assert [plain.column(k) for k in range(3)] == [["1.000000", "-2.000000"], ["p", "q"], ["", "3.500000"]]
    assert (plain.metadata, list(plain.lines)) == ({"machine": "m 1", "rows": "2"}, [4, 5])


def test_a_wrong_cell_of_a_plain_file_is_pointed_at_with_its_line(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("# a comment\nx,y\n1,2\n3,4O\n5,6\n")
    with pytest.raises(InputError, match=r"p\.csv:4: column y: '4O' is not a number"):
        read_csv(path, ["x", "y"]).numbers("y")


@settings(max_examples=300, deadline=None)
@given(
    values=st.lists(st.floats(-1e9, 1e9) | st.floats(-1e-5, 1e-5) | st.just(float("nan")), min_size=1, max_size=20)
    | st.lists(st.floats(-1e4, 1e4) | st.integers(-99_999, 99_999).map(lambda k: k / 16), min_size=1, max_size=20)
    | st.lists(st.integers(-99_999, 99_999).map(lambda k: (k + 0.5) * 1e-4), min_size=1, max_size=20),
    digits=st.integers(0, 9),
)
@example(values=[-0.0, -5e-7, -4.9999999999e-7, -5.0000000001e-7, -1.5e-6, 0.0], digits=6)
@example(values=[-0.5, -0.49999, -0.50001, -1.0, -0.0], digits=0)
def test_columns_are_written_as_each_number_alone(values, digits):
    text = format_csv({"v": np.array(values), "w": np.array(values)}, decimals={"v": digits, "w": 3})
    assert text.splitlines()[2:] == [f"{fixed(value, digits)},{fixed(value, 3)}" for value in values]


def test_columns_over_many_blocks_stay_in_step():
    count = 25_003
    numbers = np.arange(count) / 8
    text = format_csv({"n": numbers, "label": [f"p{k}, 100%s" for k in range(count)]})
    assert text.splitlines()[2:] == [f'{k / 8:.6f},"p{k}, 100%s"' for k in range(count)]


def test_columns_of_different_length_or_with_infinite_numbers_are_refused():
    with pytest.raises(ValueError, match="columns differ in length: a 2, b 1"):
        format_csv({"a": np.zeros(2), "b": ["x"]})
    with pytest.raises(ValueError, match="infinite"):
        format_csv({"a": np.array([1.0, np.inf])})
