"""Semantic difference of two sets of tables, and merging old tables with new errors."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data import toml_files
from compgen.data.error_table import Curve
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.identification.covariance import covariance_of_values, covariance_or_independent, posterior_with
from compgen.kinematics.exact_chain import exact_error
from compgen.tables import export, read_tables
from compgen.tables.active import (
    ActiveTables,
    bare_covariance,
    bare_errors,
    difference,
    merge_report,
    merged_errors,
    total_correction,
)
from compgen.tables.signs import exported_tables

NANOMETRE = 1e-6
MICROMETRE = 1e-3
#: Tables look up at p, the exact correction at p + c: 44 um times the steepest slope, 3e-4, is 0.013 um.
HELD_UM = 0.02


def files_of(machine, errors, name, folder):
    return export(machine, errors, name).write(folder)


def read(machine, paths, name="siemens-eec"):
    return read_tables(machine, paths, name)


def needed(machine, errors, position):
    """What must be added to the command so that the exact machine stands right, by plain iteration."""
    correction = np.zeros_like(position)
    for _ in range(20):
        correction = -exact_error(machine, errors, position + correction)
    return correction


# --- diff ------------------------------------------------------------------------------------------------------------


def test_text_that_means_the_same_is_no_difference(small_machine, small_errors, tmp_path):
    paths = files_of(small_machine, small_errors, "siemens-cec", tmp_path / "a")
    other = tmp_path / "NC_CEC.INI"
    lines = paths[0].read_text().splitlines()
    other.write_text(
        "\r\n".join([f"  {line} " if line.startswith("$") else line for line in lines if line != ""]) + "\r\n"
    )
    assert other.read_bytes() != paths[0].read_bytes()
    result = difference(
        small_machine, read(small_machine, paths, "siemens-cec"), read(small_machine, other, "siemens-cec")
    )
    assert result.summary()["same"] is True
    assert result.summary()["max_um"] == 0.0
    assert result.geometry == ()
    assert result.component_um == {}


def test_one_changed_node_shows_with_its_amount_axis_and_place(small_machine, small_errors, tmp_path):
    """20 um less in node k of the X table: the tool moves 20 um further there (the control subtracts the error)."""
    paths = files_of(small_machine, small_errors, "siemens-eec", tmp_path / "a")
    text = paths[0].read_text()
    match = re.search(r"\$AA_ENC_COMP\[0,2,AX1\]=(\S+)", text)
    changed = tmp_path / "AX_EEC.INI"
    changed.write_text(text.replace(match[0], f"$AA_ENC_COMP[0,2,AX1]={float(match[1]) - 0.020:.6f}"))
    start, step = (float(re.search(rf"_{key}\[0,AX1\]=(\S+)", text)[1]) for key in ("MIN", "STEP"))
    data = difference(small_machine, read(small_machine, changed), read(small_machine, paths)).summary()
    assert data["max_um"] == pytest.approx(20.0, abs=1e-6)
    assert data["axes"]["dx"]["max_um"] == pytest.approx(20.0, abs=1e-6)
    assert data["axes"]["dy"]["max_um"] == data["axes"]["dz"]["max_um"] == 0.0
    assert data["largest_at_mm"][0] == pytest.approx(start + 2 * step)
    assert data["largest_a_um"][0] - data["largest_b_um"][0] == pytest.approx(20.0, abs=1e-6)
    assert {name[0] for name in data["components_rms_um"]} == {"X"}
    assert {name.partition("(")[0].partition(" ")[0] for name in data["components_rms_um"]} == {"X"}
    assert data["geometry"] == []


def test_the_figures_are_those_of_hand_calculation_at_given_points(small_machine, small_errors, tmp_path):
    """Tables with doubled errors against the single ones, at points of the caller."""
    double = small_errors.replace(
        curves={key: Curve(c.position_mm, 2 * c.value, c.u) for key, c in small_errors.curves.items()}, squareness={}
    )
    single = small_errors.replace(squareness={})
    position = np.random.default_rng(4).uniform(small_machine.lower_mm, small_machine.upper_mm, (50, 3))
    points = compgen.Points(position)
    sets = [exported_tables(small_machine, errors, "isg-csv") for errors in (double, single)]
    data = difference(small_machine, *sets, points).summary()
    by_hand = 1e3 * (needed(small_machine, double, position) - needed(small_machine, single, position))
    size = np.linalg.norm(by_hand, axis=1)
    assert data["points"] == 50
    assert data["max_um"] == pytest.approx(size.max(), abs=HELD_UM)
    assert data["rms_um"] == pytest.approx(np.sqrt(np.mean(size**2)), abs=HELD_UM)
    assert data["p95_um"] == pytest.approx(np.percentile(size, 95), abs=HELD_UM)
    for k, axis in enumerate("xyz"):
        assert data["axes"][f"d{axis}"]["max_um"] == pytest.approx(np.abs(by_hand[:, k]).max(), abs=HELD_UM)


def test_components_come_largest_first_and_name_the_squareness(small_machine, small_errors):
    wrong = small_errors.replace(squareness={**small_errors.squareness, "EC0Y": (245e-6, 0.0)})
    sets = [exported_tables(small_machine, errors, "siemens-cec") for errors in (wrong, small_errors)]
    named = difference(small_machine, *sets).component_um
    assert next(iter(named)) == "X linear in y"
    assert list(named.values()) == sorted(named.values(), reverse=True)
    levels = np.linspace(-100, 300, 9) - 100.0
    assert named["X linear in y"] == pytest.approx(200e-6 * np.sqrt(np.mean(levels**2)) * 1e3, rel=0.01)


def test_other_nodes_and_settings_are_named_though_they_do_the_same(small_machine, small_errors):
    section = toml_files.Section({"step_mm": {"X": 25.0}}, path=None, name="controllers.siemens-eec")
    fine = replace(small_machine, controllers={"siemens-eec": section})
    sets = [exported_tables(machine, small_errors, "siemens-eec") for machine in (fine, small_machine)]
    result = difference(small_machine, *sets)
    named = {what: (a, b) for what, a, b in result.geometry}
    assert named["nodes over X"][0].startswith("21 from -300")
    assert "nodes over Y" not in named
    assert named["setting step_mm"] == ("25.0, None, None", "None, None, None")


def test_two_controls_can_be_compared(small_machine, small_errors):
    sets = [exported_tables(small_machine, small_errors, name) for name in ("isg-csv", "etalon-exchange")]
    result = difference(small_machine, *sets)
    assert result.max_um < 1e-3
    assert result.geometry == (("control", "isg-csv", "etalon-exchange"),)


# --- diff on the command line ----------------------------------------------------------------------------------------


@pytest.fixture
def two_sets(small_machine, small_errors, tmp_path):
    """Files of two sets: 30 um apart in X linear in y."""
    wrong = small_errors.replace(squareness={**small_errors.squareness, "EC0Y": (145e-6, 0.0)})
    return [
        files_of(small_machine, errors, "isg-csv", tmp_path / n) for n, errors in (("a", wrong), ("b", small_errors))
    ]


def test_the_command_writes_and_exits_with_0_unless_a_limit_is_given(small_machine_file, two_sets, tmp_path, capsys):
    first, second = ([str(path) for path in paths] for paths in two_sets)
    out = tmp_path / "out"
    words = [
        "diff",
        str(small_machine_file),
        *first,
        "--against",
        *second,
        "--controller",
        "isg-csv",
        "--out",
        str(out),
    ]
    assert run_command(cli, words) == 0
    assert "X linear in y" in capsys.readouterr().out
    data = json.loads((out / "diff.json").read_text())
    assert data["max_um"] == pytest.approx(1e-4 * 300.0 * 1e3, rel=0.01)  # 100 urad at Y = 300 mm
    rows = (out / "difference.csv").read_text().splitlines()
    header = next(row for row in rows if not row.startswith("#"))
    assert header == "x_mm,y_mm,z_mm,ax_um,ay_um,az_um,bx_um,by_um,bz_um,dx_um,dy_um,dz_um"
    assert run_command(cli, [*words, "--fail-above", "29"]) == 1
    assert run_command(cli, [*words, "--fail-above", "31", "--json"]) == 0
    capsys.readouterr()


def test_against_takes_all_words_up_to_the_next_option(small_machine_file, two_sets, tmp_path, capsys):
    first, second = ([str(path) for path in paths] for paths in two_sets)
    assert len(first) == len(second) == 2
    end = ["--controller", "isg-csv", "--out", str(tmp_path / "out"), "--json"]
    forms = (
        [*first, "--against", *second],
        [*first, "--against", second[0], "--against", second[1]],
    )
    printed = []
    for form in forms:
        assert run_command(cli, ["diff", str(small_machine_file), *form, *end]) == 0
        printed.append(json.loads(capsys.readouterr().out))
    assert printed[0] == printed[1]


def test_bad_input_of_diff_exits_with_2_and_writes_nothing(small_machine_file, two_sets, tmp_path, capsys):
    first = [str(path) for path in two_sets[0]]
    out = tmp_path / "out"
    end = ["--controller", "isg-csv", "--out", str(out)]
    for against in (["--against", str(tmp_path / "none.csv")], []):
        assert run_command(cli, ["diff", str(small_machine_file), *first, *against, *end]) == 2
    assert not out.exists()
    capsys.readouterr()


# --- merge -----------------------------------------------------------------------------------------------------------

OLD_SHARE = 0.7


@pytest.fixture(scope="module")
def old_and_new(small_machine, small_errors):
    """Bare errors, and the errors that a measurement with an old table would have found.

    The old table holds 0.7 times the lengths and angles; the measured errors are those of the machine that it leaves.
    """
    share = small_errors.replace(
        curves={key: replace(c, value=OLD_SHARE * c.value) for key, c in small_errors.curves.items()},
        squareness={key: (OLD_SHARE * value, u) for key, (value, u) in small_errors.squareness.items()},
    )
    left = small_errors.replace(
        curves={key: replace(c, value=(1 - OLD_SHARE) * c.value) for key, c in small_errors.curves.items()},
        squareness={key: ((1 - OLD_SHARE) * value, u) for key, (value, u) in small_errors.squareness.items()},
    )
    return share, left


@pytest.mark.parametrize("name", ["isg-csv", "siemens-cec"])
def test_the_merged_table_does_what_old_and_new_did_one_after_the_other(name, small_machine, old_and_new):
    """By brute force at random points: the axes go to p + new(p), and the old table acts there."""
    old_errors, left = old_and_new
    old = exported_tables(small_machine, old_errors, name)
    active = ActiveTables(old)
    bare, lost_um = merged_errors(small_machine, left, active)
    merged = exported_tables(small_machine, bare, name)
    position = np.random.default_rng(6).uniform(small_machine.lower_mm, small_machine.upper_mm, (300, 3))
    new = needed(small_machine, left, position)
    by_hand = new + old.correction(small_machine, compgen.Points(position + new))
    assert np.max(np.abs(total_correction(small_machine, left, active, position) - by_hand)) < NANOMETRE
    got = merged.correction(small_machine, compgen.Points(position))
    assert np.max(np.abs(got - by_hand)) < 0.05 * MICROMETRE
    assert lost_um < 0.05
    report = merge_report(small_machine, left, active, merged, lost_um)
    assert report.difference_max_um < 0.05
    assert report.total_max_um > 20.0


def test_the_merged_errors_are_those_of_the_bare_machine(small_machine, small_errors, old_and_new):
    old_errors, left = old_and_new
    bare, _ = merged_errors(small_machine, left, ActiveTables(exported_tables(small_machine, old_errors, "isg-csv")))
    position = np.random.default_rng(7).uniform(small_machine.lower_mm, small_machine.upper_mm, (300, 3))
    miss = exact_error(small_machine, bare, position) - exact_error(small_machine, small_errors, position)
    assert np.max(np.abs(miss)) < 0.1 * MICROMETRE


def test_merged_errors_are_split_by_a_rule_and_not_by_rounding(small_machine, small_errors, old_and_new):
    """Slopes are squareness, constants positioning; a millionth of a nanometre in the readings changes nothing more."""
    old_errors, left = old_and_new
    active = ActiveTables(exported_tables(small_machine, old_errors, "isg-csv"))
    noise = np.random.default_rng(8)
    near = left.replace(
        curves={
            k: replace(c, value=c.value * (1 + 1e-10 * noise.normal(size=len(c.value)))) for k, c in left.curves.items()
        }
    )
    one, other = (merged_errors(small_machine, errors, active)[0] for errors in (left, near))
    for name, curve in one.curves.items():
        size = 1e-8 if error_named(name).kind == "linear" else 1e-12  # mm, rad
        assert np.max(np.abs(curve.value - other.curves[name].value)) < size, name
    for name in SQUARENESS_NAMES:
        assert abs(one.squareness[name][0] - other.squareness[name][0]) < 1e-13
        assert abs(one.squareness[name][0] - small_errors.squareness[name][0]) < 1e-6
    for name in ("EXY", "EXZ", "EYZ"):
        assert one.curves[name].value[[0, -1]].tolist() == left.curves[name].value[[0, -1]].tolist()
    for name, curve in one.curves.items():
        at_mm = small_machine.reference_point_mm[error_named(name).axis]
        if error_named(name).kind == "angular":
            assert (
                abs(np.interp(at_mm, curve.position_mm, curve.value - left.curves[name].at(curve.position_mm))) < 1e-15
            )


def test_a_finer_old_table_keeps_its_nodes(small_machine, small_errors, old_and_new):
    """A wave of 50 mm in the old pitch table lies between the nodes of the new errors, and survives the merge."""
    x = np.arange(-300.0, 201.0, 12.5)
    wave = 5e-3 * (np.sin(2 * np.pi * x / 50.0) - np.sin(2 * np.pi * -50.0 / 50.0))
    old_errors = old_and_new[0].replace(
        curves={**old_and_new[0].curves, "EXX": Curve(x, wave, np.full(len(x), np.nan))}
    )
    active = ActiveTables(exported_tables(small_machine, old_errors, "siemens-eec"))
    left = old_and_new[1]
    bare, _ = merged_errors(small_machine, left, active)
    merged = exported_tables(small_machine, bare, "siemens-eec")
    assert merge_report(small_machine, left, active, merged, 0.0).total_max_um > 5.0
    line = np.column_stack([np.linspace(-290, 190, 400), np.full(400, 100.0), np.full(400, -40.0)])
    old_x, new_x = (t.correction(small_machine, compgen.Points(line))[:, 0] for t in (active.tables, merged))
    smooth = np.interp(
        line[:, 0], small_machine.axes[0].nodes_mm, np.interp(small_machine.axes[0].nodes_mm, line[:, 0], new_x - old_x)
    )
    assert np.max(np.abs(new_x - old_x - smooth)) < 0.3 * MICROMETRE
    coarse, lost_um = bare_errors(small_machine, left, active)
    assert len(coarse.curves["EXX"].position_mm) == len(small_machine.axes[0].nodes_mm)
    assert lost_um > 1.0


def test_the_command_writes_one_accepted_set(small_machine_file, small_machine, old_and_new, tmp_path, capsys):
    old_errors, left = old_and_new
    old = files_of(small_machine, old_errors, "siemens-cec", tmp_path / "old")
    measured = tmp_path / "left.errors.csv"
    measured.write_text(compgen.format_errors(left))
    out = tmp_path / "out"
    words = ["merge", str(small_machine_file), str(old[0]), "--controller", "siemens-cec", "--errors", str(measured)]
    assert run_command(cli, [*words, "--out", str(out)]) == 0
    capsys.readouterr()
    names = {path.relative_to(out).as_posix() for path in out.rglob("*")}
    assert {
        "NC_CEC.INI",
        "merge.json",
        "merged.errors.csv",
        "result.json",
        "manifest.json",
        "check/check-program.md",
    } <= names
    assert json.loads((out / "merge.json").read_text())["difference_max_um"] < 0.1
    assert json.loads((out / "result.json").read_text())["accepted"] is True
    assert run_command(cli, [*words, "--out", str(tmp_path / "tight"), "--max-step-um", "1", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["accepted"] is False
    assert (tmp_path / "tight" / "NOT-ACCEPTED-NC_CEC.INI").is_file()


def test_of_merged_tables_as_much_is_known_as_of_the_measurement_with_the_old_ones(small_machine, small_errors):
    """Old tables are exact numbers: they take nothing from the uncertainty of what was not measured, and add nothing."""
    old = ActiveTables(exported_tables(small_machine, small_errors, "isg-csv"))
    rng = np.random.default_rng(2)
    pitch = Curve(np.linspace(-300.0, 200.0, 6), rng.normal(0.0, 2e-3, 6), np.full(6, 3e-4))
    measured = compgen.ErrorTable({"EXX": pitch}, {})
    for known in (None, covariance_of_values(measured, 3e-4 * rng.normal(size=(6, 3)), small_machine.name)):
        bare, _ = merged_errors(small_machine, measured, old)
        found = bare_covariance(small_machine, measured, known, bare)
        position = rng.uniform(small_machine.lower_mm, small_machine.upper_mm, (30, 3))
        alone = posterior_with(small_machine, measured, known).field(position).variance
        merged = posterior_with(small_machine, bare, found).field(position).variance
        assert np.allclose(merged, alone, rtol=1e-9)
        factor = covariance_or_independent(measured, known).errors_factor
        at_nodes = [found.errors_factor[k] for k, name in enumerate(found.error) if name == "EXX"]
        ends = np.array(at_nodes)[[0, -1]]
        assert np.allclose(ends @ ends.T, (factor @ factor.T)[np.ix_([0, -1], [0, -1])])


def test_a_pitch_run_beside_old_tables_says_what_it_did_not_measure(
    small_machine_file, small_machine, small_errors, tmp_path, capsys
):
    old = files_of(small_machine, small_errors, "siemens-cec", tmp_path / "old")
    pitch = Curve(np.linspace(-300.0, 200.0, 6), np.zeros(6), np.full(6, 3e-4))
    (tmp_path / "x.errors.csv").write_text(compgen.format_errors(compgen.ErrorTable({"EXX": pitch}, {})))
    words = ["merge", str(small_machine_file), str(old[0]), "--controller", "siemens-cec", "--json"]
    run_command(cli, [*words, "--errors", str(tmp_path / "x.errors.csv"), "--out", str(tmp_path / "o")])
    found = json.loads(capsys.readouterr().out)
    assert found["probable"]["after_rms_um"]["high"] > 5.0  # angles and squareness that nobody measured
    assert found["measured"]["errors"] == ["EXX"]
    assert found["verdict"] != "accepted"
