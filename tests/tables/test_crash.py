"""The sign crash test: wrong signs, axes and units are rejected for every control, and a lax judgement is shown up."""

import itertools
import json
from functools import cache, partial

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import CONTROLLERS
from compgen.data.error_table import Curve, ErrorTable
from compgen.tables.judge import Judge
from compgen.tables.signs import crash_test, exported_tables, permutation_name, signed_permutations

ALL = sorted(CONTROLLERS)
#: Signs that change nothing: most of these do not move Z; uCNC (compiled for XY) moves X as a function of Y alone.
UNSEEN = {"aerotech-2d": 1, "klipper": 1, "marlin": 1, "reprapfirmware": 1, "ucnc": 9}


@pytest.fixture(scope="module")
def crashed(small_machine, small_errors):
    """The crash test of a control, by its name; each is made once."""
    return cache(partial(crash_test, small_machine, small_errors))


def test_the_48_signed_permutations_are_those_of_a_brute_force_search():
    """All 3 x 3 matrices with entries -1, 0, 1 that are orthogonal."""
    entries = (np.array(values).reshape(3, 3) for values in itertools.product((-1, 0, 1), repeat=9))
    expected = {tuple(m.ravel()) for m in entries if np.array_equal(m @ m.T, np.eye(3))}
    found = signed_permutations()
    assert len(expected) == len(found) == 48
    assert {tuple(m.ravel()) for m in found} == expected
    assert np.array_equal(found[0], np.eye(3))


def test_the_name_says_where_each_axis_takes_its_value_from():
    assert permutation_name(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])) == "(-Y, X, Z)"


@pytest.mark.parametrize("name", ALL)
def test_every_wrong_table_of_every_control_is_rejected(name, crashed):
    result = crashed(name)
    assert result.baseline == ()
    assert [trial for trial in result.trials if trial.outcome == "ACCEPTED"] == []
    assert result.passed
    kinds = [trial.kind for trial in result.trials]
    assert (kinds.count("output"), kinds.count("frame"), kinds.count("unit")) == (47, 47, 2)
    assert all(trial.reason for trial in result.trials if trial.outcome == "rejected")
    # at most one slip of angles that hardly acts, and the signs of axes that the control does not move or look at
    assert result.count("rejected") >= len(result.trials) - 1 - UNSEEN.get(name, 0)


@pytest.mark.parametrize("name", ["isg-csv", "siemens-cec"])
def test_a_slip_of_degrees_is_visible_where_angles_are_held(name, crashed):
    slips = {trial.name: trial for trial in crashed(name).trials}
    for slip in ("deg for rad (angles 57 times too large)", "rad for deg (angles 57 times too small)"):
        assert slips[slip].outcome == "rejected"
        assert slips[slip].difference_um > 5.0


def test_a_flip_that_changes_nothing_does_not_count(small_machine):
    """Only X is in error: the three other sign patterns of Y and Z give the same correction, and only these."""
    nodes = small_machine.axes[0].nodes_mm
    value = 0.01 * np.sin((nodes + 50.0) / 120.0)
    errors = ErrorTable({"EXX": Curve(nodes, value, np.full(len(nodes), np.nan))})
    result = crash_test(small_machine, errors, "siemens-eec")
    same = {trial.name for trial in result.trials if trial.kind == "output" and trial.outcome == "same"}
    expected = {f"(X, {a}, {b})" for a, b in itertools.product(("Y", "-Y", "Z", "-Z"), repeat=2) if a[-1] != b[-1]}
    assert same == expected - {"(X, Y, Z)"}
    assert result.passed
    assert all(trial.difference_um <= result.visible_um for trial in result.trials if trial.outcome == "same")


def test_a_judgement_that_accepts_everything_fails_the_test(small_machine, small_errors, monkeypatch):
    monkeypatch.setattr(Judge, "component_reasons", lambda self, correction: [])
    monkeypatch.setattr(Judge, "reasons", lambda self, grid, lines, left=None: [])
    result = crash_test(small_machine, small_errors, "siemens-cec")
    assert not result.passed
    assert result.count("ACCEPTED") >= 90


def test_tables_that_are_wrong_from_the_start_are_named(small_machine, small_errors, monkeypatch):
    monkeypatch.setattr(Judge, "reasons", lambda self, grid, lines, left=None: ["never good"])
    result = crash_test(small_machine, small_errors, "isg-csv")
    assert result.baseline == ("never good",)
    assert not result.passed


def test_exported_tables_are_those_of_the_written_files(small_machine, small_errors, tmp_path):
    points = compgen.Points(np.random.default_rng(3).uniform(small_machine.lower_mm, small_machine.upper_mm, (30, 3)))
    paths = compgen.export(small_machine, small_errors, "siemens-cec").write(tmp_path)
    written = compgen.read_tables(small_machine, paths, "siemens-cec").correction(small_machine, points)
    tables = exported_tables(small_machine, small_errors, "siemens-cec")
    assert np.array_equal(tables.correction(small_machine, points), written)


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def errors_file(small_errors, tmp_path):
    path = tmp_path / "e.errors.csv"
    path.write_text(compgen.format_errors(small_errors))
    return path


def test_the_command_prints_the_verdict_and_exits_with_0(small_machine_file, errors_file, capsys):
    words = ["crash-test", str(small_machine_file), str(errors_file), "--controller", "siemens-eec", "--json"]
    assert run_command(cli, words) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["passed"] is True
    assert data["controllers"]["siemens-eec"]["accepted"] == 0
    assert run_command(cli, words[:-1]) == 0
    printed = capsys.readouterr().out
    assert "siemens-eec" in printed
    assert "passed" in printed


def test_the_command_exits_with_1_where_a_wrong_one_is_accepted(small_machine_file, errors_file, monkeypatch, capsys):
    monkeypatch.setattr(Judge, "component_reasons", lambda self, correction: [])
    monkeypatch.setattr(Judge, "reasons", lambda self, grid, lines, left=None: [])
    words = ["crash-test", str(small_machine_file), str(errors_file), "--controller", "isg-csv"]
    assert run_command(cli, words) == 1
    assert "ACCEPTED although wrong" in capsys.readouterr().out


def test_controls_without_settings_are_left_out_by_name_and_refused_when_asked_for(
    small_machine_file, errors_file, tmp_path, monkeypatch, capsys
):
    machine = tmp_path / "m.toml"
    machine.write_text(small_machine_file.read_text().partition("[controllers.pmac]")[0])
    two = {name: CONTROLLERS[name] for name in ("pmac", "siemens-eec")}
    monkeypatch.setattr("compgen.cli.table_commands.CONTROLLERS", two)
    assert run_command(cli, ["crash-test", str(machine), str(errors_file), "--json"]) == 0
    printed = capsys.readouterr()
    assert "pmac is skipped" in printed.err
    assert list(json.loads(printed.out)["controllers"]) == ["siemens-eec"]
    two.pop("siemens-eec")
    assert run_command(cli, ["crash-test", str(machine), str(errors_file)]) == 2
    assert "for none of the controls" in capsys.readouterr().err
    monkeypatch.undo()
    assert run_command(cli, ["crash-test", str(machine), str(errors_file), "--controller", "pmac"]) == 2
    assert "counts_per_mm" in capsys.readouterr().err
