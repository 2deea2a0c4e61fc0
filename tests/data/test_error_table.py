"""Names and units of the 21 errors, tables of them, and their files."""

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable, format_errors, read_errors
from compgen.data.names import CURVE_NAMES, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, InputError

UNKNOWN = np.nan


@pytest.fixture
def saved(tmp_path):
    def save(text):
        path = tmp_path / "some.errors.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return save


def refusal(path):
    with pytest.raises(InputError) as caught:
        read_errors(path)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


def example():
    nodes_mm = np.array([-800.0, -1.0 / 3.0, 0.0])
    return ErrorTable(
        {
            "EXX": Curve(nodes_mm, np.array([0.001, -0.0025, 0.0]), np.array([1e-4, 2e-4, UNKNOWN])),
            "EBZ": Curve(nodes_mm[:2], np.array([1e-6, -2.7e-6]), np.array([1e-7, 1e-7])),
        },
        {"EC0Y": (2.903e-3, 1e-6), "EA0Z": (-5e-6, UNKNOWN)},
        {"machine": "mill", "source": "test"},
    )


# --- names --------------------------------------------------------------------------------------------------------


def test_the_21_names_are_those_of_iso_230_in_the_order_of_the_columns_of_c():
    assert (
        " ".join(ERROR_NAMES)
        == "EXX EYX EZX EAX EBX ECX EXY EYY EZY EAY EBY ECY EXZ EYZ EZZ EAZ EBZ ECZ EC0Y EB0Z EA0Z"
    )
    assert CURVE_NAMES + SQUARENESS_NAMES == ERROR_NAMES and len(CURVE_NAMES) == 18


@pytest.mark.parametrize(
    ("name", "kind", "direction", "axis", "unit", "straightness"),
    [
        ("EXX", "linear", 0, 0, "um", False),
        ("EZY", "linear", 2, 1, "um", True),
        ("EAX", "angular", 0, 0, "urad", False),
        ("ECY", "angular", 2, 1, "urad", False),
        ("EC0Y", "squareness", 2, 1, "urad", False),
        ("EB0Z", "squareness", 1, 2, "urad", False),
        ("EA0Z", "squareness", 0, 2, "urad", False),
    ],
)
def test_a_name_says_kind_direction_axis_and_unit(name, kind, direction, axis, unit, straightness):
    error = error_named(name)
    assert (error.kind, error.direction, error.axis, error.unit) == (kind, direction, axis, unit)
    assert error.is_straightness is straightness


def test_there_are_six_straightness_errors():
    assert [n for n in ERROR_NAMES if error_named(n).is_straightness] == ["EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ"]


# --- tables -------------------------------------------------------------------------------------------------------


def test_each_curve_is_taken_at_the_position_of_its_own_axis_linear_between_and_constant_outside():
    nodes_mm = np.array([0.0, 10.0])
    table = ErrorTable(
        {
            "EXX": Curve(nodes_mm, np.array([0.0, 1.0]), np.full(2, UNKNOWN)),
            "EXZ": Curve(nodes_mm, np.array([5.0, 6.0]), np.full(2, UNKNOWN)),
        },
        {"EB0Z": (7.0, UNKNOWN)},
    )
    values = table.at(np.array([[2.5, 99.0, 5.0], [-3.0, 99.0, 30.0]]))
    expected = np.zeros((2, 21))
    expected[:, 0] = [0.25, 0.0]  # EXX
    expected[:, 12] = [5.5, 6.0]  # EXZ
    expected[:, 19] = 7.0  # EB0Z
    np.testing.assert_array_equal(values, expected)
    assert table.names == ("EXX", "EXZ", "EB0Z")


def test_leaving_the_range_of_a_curve_warns_and_staying_inside_does_not():
    table = example()
    table.warn_outside(np.array([[-800.0, 5000.0, -400.0]]))
    with pytest.warns(CompgenWarning, match="EXX is known from -800 to 0 mm, but positions range from -801 to -5 mm"):
        table.warn_outside(np.array([[-801.0, 0.0, -400.0], [-5.0, 0.0, -400.0]]))


def test_a_curve_of_one_node_is_a_constant_and_has_no_range_to_leave():
    table = ErrorTable({"EAX": Curve(np.zeros(1), np.array([3e-6]), np.full(1, UNKNOWN))})
    table.warn_outside(np.array([[500.0, 0.0, 0.0]]))
    assert table.at(np.array([[500.0, 0.0, 0.0]]))[0, 3] == 3e-6


@pytest.mark.parametrize("positions", [[0.0, 0.0], [1.0, 0.0], [0.0, UNKNOWN], [0.0, np.inf]])
def test_positions_of_a_curve_must_ascend_and_be_finite(positions):
    with pytest.raises(ValueError, match="ascend"):
        Curve(np.array(positions), np.zeros(2), np.zeros(2))


@pytest.mark.parametrize("sizes", [(2, 1, 2), (2, 2, 1), (0, 0, 0)])
def test_a_curve_needs_as_many_values_as_positions(sizes):
    with pytest.raises(ValueError, match="lengths differ"):
        Curve(*(np.arange(float(n)) for n in sizes))


def test_a_table_refuses_names_that_are_none_or_stand_in_the_wrong_place():
    curve = Curve(np.zeros(1), np.zeros(1), np.zeros(1))
    for curves, squareness in (({"EXA": curve}, {}), ({"EC0Y": curve}, {}), ({}, {"EXX": (0.0, 0.0)})):
        with pytest.raises(ValueError, match="is not one of the"):
            ErrorTable(curves, squareness)


def test_replace_changes_only_what_is_given():
    table = example().replace(squareness={})
    assert table.names == ("EXX", "EBZ")
    assert table.metadata == {"machine": "mill", "source": "test"}


# --- files --------------------------------------------------------------------------------------------------------


def test_um_and_urad_of_the_file_become_mm_and_rad(saved):
    path = saved("error,position_mm,value,u_value\nEXX,0,1.5,0.1\nEAX,0,-2.7,\nEC0Y,,2903,1\n")
    table = read_errors(path)
    assert table.curves["EXX"].value[0] == pytest.approx(0.0015) and table.curves["EXX"].u[0] == pytest.approx(1e-4)
    assert table.curves["EAX"].value[0] == pytest.approx(-2.7e-6) and np.isnan(table.curves["EAX"].u[0])
    assert table.squareness["EC0Y"] == pytest.approx((2.903e-3, 1e-6))


def test_rows_may_come_in_any_order_and_without_uncertainties(saved):
    table = read_errors(saved("value,error,position_mm\n3,EYX,5\n9,EB0Z,\n1,EYX,-5\n2,EYX,0\n"))
    assert table.curves["EYX"].position_mm.tolist() == [-5, 0, 5]
    np.testing.assert_allclose(table.curves["EYX"].value, [0.001, 0.002, 0.003])
    assert np.all(np.isnan(table.curves["EYX"].u)) and np.isnan(table.squareness["EB0Z"][1])


def test_a_written_table_comes_back_with_its_metadata(saved):
    table = example()
    text = format_errors(table, {"date": "2024-01-01"})
    assert "EC0Y,,2903.000000000,1.000000000" in text.splitlines()
    back = read_errors(saved(text))
    assert back.metadata == {"machine": "mill", "source": "test", "date": "2024-01-01"}
    assert back.names == table.names
    for name, curve in table.curves.items():
        unit = error_named(name).si_per_unit
        np.testing.assert_allclose(back.curves[name].position_mm, curve.position_mm, rtol=0, atol=0.5e-6)
        np.testing.assert_allclose(back.curves[name].value, curve.value, rtol=1e-15, atol=0.5e-9 * unit)
        np.testing.assert_allclose(back.curves[name].u, curve.u, rtol=1e-15, atol=0.5e-9 * unit)
    for name, pair in table.squareness.items():
        np.testing.assert_allclose(back.squareness[name], pair, rtol=1e-15, atol=0.5e-15)
    assert format_errors(read_errors(saved(text))) == format_errors(back)


def test_a_written_table_cut_at_any_byte_is_refused_or_the_same(saved, tmp_path):
    text = format_errors(example())
    path = saved(text)
    for cut in range(max(0, len(text) - 200), len(text)):
        path.write_text(text[:cut])
        try:
            back = read_errors(path)
        except InputError:
            continue
        assert format_errors(back) == text, cut


HEADER = "error,position_mm,value,u_value\n"


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("EXX,0,1,\nEXQ,0,1,\n", ":3: column error: 'EXQ' is not an error of ISO 230-1 here; did you mean"),
        ("EXX,0,1,\nEXA,0,1,\n", ":3: column error: 'EXA' is an error of a rotary axis"),
        ("exx,0,1,\n", ":2: column error: 'exx' is not an error of ISO 230-1 here; did you mean 'EXX'"),
        ("EXX,0,1,\nEXX,10,2,\nEXX,0.0,3,\n", ":4: column position_mm: EXX has a value at 0 mm already in line 2"),
        ("EXX,,1,\n", ":2: column position_mm: is empty; EXX is a function"),
        ("EXX,abc,1,\n", ":2: column position_mm: 'abc' is not a number"),
        ("EXX,nan,1,\n", ":2: column position_mm: 'nan' is not a finite number"),
        ("EC0Y,0,1,\n", ":2: column position_mm: EC0Y is a constant; leave its position empty"),
        ("EC0Y,,1,\nEXX,0,1,\nEC0Y,,1,\n", ":4: column error: EC0Y appears a second time (first in line 2)"),
        ("EXX,0,,\n", ":2: column value: is empty"),
        ("EXX,0,1,-0.1\n", ":2: column u_value: -0.1 is negative"),
        ("EXX,0,1,inf\n", ":2: column u_value: 'inf' is not a finite number"),
        (",0,1,\n", ":2: column error: is empty"),
    ],
)
def test_a_faulty_row_is_refused_with_line_and_column(saved, rows, says):
    assert says in refusal(saved(HEADER + rows))
