"""Strict TOML: every refusal names the file, the line and the key, and says what is expected."""

from pathlib import Path

import pytest

from compgen.data import toml_files
from compgen.errors import InputError

TEXT = """\
name = "m"           # 1
count = 3

[axes.X]
range_mm = [-1, 2]
grid = [
  [1, 2],
  [3, 4]
]
late = "x"

[ "axes"."Y" ]       # 12
range_um = [0, 1]

[[slide]]
name = "first"

[[slide]]
name = "second"
nmae = 1
"""


@pytest.fixture
def saved(tmp_path):
    def save(content):
        path = tmp_path / "file.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        return path

    return save


def message_of(action, *arguments):
    with pytest.raises(InputError) as caught:
        action(*arguments)
    return str(caught.value)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "is empty"),
        ("  \n", "is empty"),
        ("a = 1\nb = \n", ":2: is not valid TOML"),
        ("a = 1\nb = 'x", ":2: is not valid TOML"),
        ("a = 1\nb = 2\na = 3\n", ":3: is not valid TOML"),
        ("[axes.X]\nn = 1\n[axes.X]\nn = 2\n", ":3: is not valid TOML"),
        ("a = 01\n", ":1: is not valid TOML"),
        ("a = " + "9" * 5000, "is not valid TOML"),
        ("a = " + "[" * 5000, "is not valid TOML"),
        (b"a = '\xff'\n", ":1: is not UTF-8"),
        (b"a = 1\n\0", "is not valid TOML"),
    ],
)
def test_what_is_not_toml_is_refused_with_file_and_line(saved, content, says):
    path = saved(content)
    message = message_of(toml_files.read_toml, path)
    assert message.startswith(str(path)) and says in message


def test_a_folder_is_refused(tmp_path):
    assert "is a folder" in message_of(toml_files.read_toml, tmp_path)


def test_a_byte_order_mark_and_windows_line_ends_are_understood(saved):
    root = toml_files.read_toml(saved("\ufeffa = 1\r\nb = true\r\n"))
    assert root.take("a", toml_files.number) == 1.0 and root.take("b", toml_files.flag) is True
    root.finish()


def test_a_wrong_value_is_shown_with_its_line_and_what_is_expected(saved):
    path = saved(TEXT)
    message = message_of(toml_files.read_toml(path).take, "count", toml_files.text)
    assert message == f"{path}:2: count: expected one line of text; got 3"


def test_a_missing_key_names_the_nearest_one_that_is_there_and_the_line_of_its_table(saved):
    path = saved(TEXT)
    section = toml_files.read_toml(path).section("axes").section("Y")
    message = message_of(section.take, "range_mm", toml_files.interval)
    assert message.startswith(
        f"{path}:12: [axes.Y] range_mm: is missing; 'range_um' is not a key here, did you mean 'range_mm'?"
    )


def test_an_unknown_key_names_the_nearest_known_one(saved):
    path = saved(TEXT)
    section = toml_files.read_toml(path).section("axes").section("Y")
    section.take("range_mm", toml_files.interval, None)
    section.take("nodes", toml_files.number, None)
    message = message_of(section.finish)
    assert message.startswith(f"{path}:13: [axes.Y] range_um: is not a known key; did you mean 'range_mm'?")


def test_lists_over_several_lines_do_not_confuse_the_line_numbers(saved):
    section = toml_files.read_toml(saved(TEXT)).section("axes").section("X")
    assert ":10: [axes.X] late" in message_of(section.take, "late", toml_files.number)


def test_a_wrong_key_in_the_second_table_of_an_array_points_there(saved):
    first, second = toml_files.read_toml(saved(TEXT)).sections("slide")
    assert [s.take("name", toml_files.text) for s in (first, second)] == ["first", "second"]
    first.finish()
    assert ":20: [slide] nmae: is not a known key; did you mean 'name'?" in message_of(second.finish)
    assert ":18: [slide] size: is missing" in message_of(second.take, "size", toml_files.number)


def test_a_section_that_is_a_value_and_a_value_that_is_a_section_are_refused(saved):
    root = toml_files.read_toml(saved(TEXT))
    assert ":2: count: expected a table ([section]); got 3" in message_of(root.section, "count")
    assert ":2: count: expected an array of tables ([[section]])" in message_of(root.sections, "count")
    assert "name: is missing" in message_of(toml_files.read_toml(saved("nmae = 1\n")).take, "name", toml_files.text)


def test_what_is_optional_may_be_absent(saved):
    root = toml_files.read_toml(saved("a = 1\n"))
    assert root.take("b", toml_files.number, 7) == 7
    assert root.section("c", required=False).data == {}
    assert root.sections("d") == []
    assert "a: is not a known key" in message_of(root.finish)


def test_a_section_that_came_from_no_file_still_names_the_key():
    section = toml_files.Section({"sing": "x"}, path=None, name="controllers.c")
    assert message_of(section.take, "sign", toml_files.text).startswith(
        "[controllers.c] sign: is missing; 'sing' is not a key here, did you mean"
    )


HUGE = 10**400


@pytest.mark.parametrize(
    ("check", "value", "says"),
    [
        (toml_files.number, "1", "a finite number"),
        (toml_files.number, True, "a finite number"),
        (toml_files.number, float("nan"), "a finite number"),
        (toml_files.number, float("-inf"), "a finite number"),
        (toml_files.number, HUGE, "a finite number"),
        (toml_files.positive, 0, "above zero"),
        (toml_files.not_negative, -1e-9, "not negative"),
        (toml_files.whole(2, 5), 6, "a whole number from 2 to 5"),
        (toml_files.whole(2, 5), 1, "a whole number from 2 to 5"),
        (toml_files.whole(2), 1, "a whole number of at least 2"),
        (toml_files.whole(2), 3.0, "a whole number"),
        (toml_files.whole(0), True, "a whole number"),
        (toml_files.flag, 1, "true or false"),
        (toml_files.text, " ", "one line of text"),
        (toml_files.text, "a\nb", "one line of text"),
        (toml_files.text, "a" * 201, "one line of text"),
        (toml_files.choice("X", "Y"), "Z", "one of 'X', 'Y'"),
        (toml_files.choice("X", "Y"), ["X"], "one of 'X', 'Y'"),
        (toml_files.numbers, 1, "a list of numbers"),
        (toml_files.numbers, [1, "2"], "a finite number"),
        (toml_files.vector3, [1, 2], "three numbers"),
        (toml_files.vector3, {"x": 1}, "three numbers"),
        (toml_files.interval, [1], "two numbers"),
        (toml_files.interval, [2, 1], "lower number first"),
        (toml_files.interval, [1, 1], "lower number first"),
        (toml_files.interval, [0, float("inf")], "a finite number"),
        (toml_files.ascending, [1], "ascending"),
        (toml_files.ascending, [1, 1], "ascending"),
    ],
)
def test_each_check_refuses_what_it_does_not_mean(check, value, says):
    with pytest.raises(ValueError, match=says):
        check(value)


def test_each_check_returns_the_clean_value():
    assert toml_files.number(3) == 3.0 and isinstance(toml_files.number(3), float)
    assert toml_files.positive(0.5) == 0.5 and toml_files.not_negative(0) == 0.0
    assert toml_files.whole(2, 5)(5) == 5 and toml_files.flag(False) is False
    assert toml_files.text("a b") == "a b" and toml_files.choice("X", "Y")("Y") == "Y"
    assert toml_files.numbers([]) == () and toml_files.vector3([1, 2, 3]) == (1.0, 2.0, 3.0)
    assert toml_files.interval([-1, 0]) == (-1.0, 0.0) and toml_files.ascending([0, 1, 4]) == (0.0, 1.0, 4.0)


@pytest.mark.parametrize(
    "text", ["a = 1\nlow = { X = 1, Y = 2 }\n", "a = 1\nlow.X = 1\n", "a = 1\n[low]\nX = 1\n[b]\n"]
)
def test_a_key_of_a_table_that_is_a_value_has_the_line_of_the_table(text):
    section = toml_files.parse_toml(text, Path("m.toml")).section("low")
    assert section.fail("X", "is wrong").line == (2 if "[low]" not in text else 3)


def test_a_table_that_is_a_value_is_looked_for_in_its_own_table_alone():
    text = "[one]\nends = { X = 1 }\n[two]\nb = 2\nends = { X = 2 }\n"
    root = toml_files.parse_toml(text, Path("m.toml"))
    lines = [root.section(name).section("ends").fail("X", "is wrong").line for name in ("one", "two")]
    assert lines == [2, 5]
