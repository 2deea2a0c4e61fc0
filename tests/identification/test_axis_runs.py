"""Axis runs: the contract file `*.axis.csv`."""

import warnings

import numpy as np
import pytest

from compgen.data.axis_runs import format_axis_runs, read_axis_runs
from compgen.data.records import detect_format
from compgen.errors import InputError
from compgen.pipeline import identify_bare

HEADER = "axis,position_mm,direction,run,deviation_um\n"
GOOD = HEADER + "X,0,1,1,2.5\nX,100,1,1,-4\nY,100,-1,2,1e1\n"


def written(tmp_path, text, name="a.axis.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_axis_runs_are_read_in_mm_and_survive_the_round_trip(tmp_path):
    path = written(
        tmp_path,
        "# machine = m\n"
        + GOOD.replace("um\n", "um,temp_x_c\n")
        .replace("\nX", "\nX")
        .replace("2.5\n", "2.5,20.5\n")
        .replace("-4\n", "-4,21\n")
        .replace("1e1\n", "1e1,22\n"),
    )
    runs = read_axis_runs(path)
    assert detect_format(path) == "axis"
    assert runs.axis.tolist() == [0, 0, 1]
    assert runs.direction.tolist() == [1, 1, -1]
    np.testing.assert_allclose(runs.deviation_mm, [2.5e-3, -4e-3, 10e-3], rtol=0, atol=1e-15)
    assert runs.covariates["temp_x_c"].tolist() == [20.5, 21.0, 22.0]
    again = read_axis_runs(written(tmp_path, format_axis_runs(runs), "b.axis.csv"))
    for name in ("axis", "position_mm", "direction", "run", "deviation_mm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(runs, name))
    assert again.metadata == runs.metadata == {"machine": "m"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "W,0,1,1,2\n", "2: column axis: 'W' is not an axis"),
        (HEADER + "X,0,0,1,2\n", "column direction: 0 is not a direction"),
        (HEADER + "X,0,2,1,2\n", "is not a direction"),
        (HEADER + "X,0,1,1.5,2\n", "not a whole number"),
        (HEADER + "X,0,1,1,2e5\n", "is the unit um"),
        (HEADER + "X,0,1,1,2\nX,0,1,1,3\n", "a.axis.csv:3: X at 0 mm, direction 1, run 1 already appears in"),
        ("axis,position_mm,direction,run\nX,0,1,1\n", "deviation_um' is missing"),
    ],
)
def test_what_is_no_axis_run_is_refused_with_its_place(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_axis_runs(written(tmp_path, text))


def test_two_files_are_one_measurement_unless_they_are_the_same(tmp_path):
    a, b = written(tmp_path, GOOD), written(tmp_path, HEADER + "Z,0,1,1,2.5\n", "b.axis.csv")
    assert read_axis_runs([a, b]).axes == (0, 1, 2)
    with pytest.raises(InputError, match="same rows"):
        read_axis_runs([a, written(tmp_path, GOOD, "c.axis.csv")])


def test_a_run_along_a_line_that_nobody_stated_costs_what_the_angles_do_at_an_unknown_lever():
    """The prior of the angles at the root mean square lever of the travel; a line that is stated costs nothing of it."""
    from virtual_shop import case

    from compgen.identification.any_measurement import unseen
    from compgen.identification.axis_tests import unstated_lines

    shop = case(2, seed=3)
    unknown, stated = shop.runs(stated=False), shop.runs()
    costs = unstated_lines(shop.machine, unknown)
    assert costs and not unstated_lines(shop.machine, stated)
    loose, tight = (known_alone_quietly(shop.machine, runs) for runs in (unknown, stated))
    for axis, (cost_um, _) in costs.items():
        name, at = "E" + 2 * "XYZ"[axis], np.unique(unknown.position_mm[unknown.axis == axis])
        wide, narrow = (1e3 * found.posterior.curve(name, at).u for found in (loose, tight))
        added_um = np.sqrt(np.mean(wide**2) - np.mean(narrow**2))
        assert 0.3 * cost_um < added_um < 3.0 * cost_um
    text = " ".join(unseen(shop.machine, [unknown]))
    assert "Where was the laser?" in text and "Where was the laser?" not in " ".join(unseen(shop.machine, [stated]))


def known_alone_quietly(machine, runs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return identify_bare(machine, runs)
