"""The command line: help, exit codes, what goes to stdout and to stderr, and that bad input writes nothing."""

import io
import json
import os
import re
import shutil
import stat
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path
from pkgutil import iter_modules

import click
import numpy as np
import pytest
from click.testing import CliRunner

import compgen
from compgen import resources
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.csv_files import read_csv
from compgen.data.error_table import format_errors
from compgen.data.files import sha256_of
from compgen.identification.covariance import Covariance, format_covariance, read_covariance
from compgen.kinematics.first_order import c_matrix
from compgen.tables import Residuals

COMMANDS = sorted(cli.commands)
PRINTED_UM = 1e-6  # columns of results have 6 decimals in um
EXTREMES = "x_mm,y_mm,z_mm\n-300,-100,-240\n200,300,0\n-50,100,-40\n12.5,-37.25,-111\n"


@pytest.fixture
def call(call, monkeypatch, tmp_path):
    """The command line, with an empty working folder."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return call


@pytest.fixture
def errors_file(small_errors, tmp_path):
    path = tmp_path / "small.errors.csv"
    path.write_text(format_errors(small_errors))
    return path


@pytest.fixture
def points_file(tmp_path):
    path = tmp_path / "p.points.csv"
    path.write_text(EXTREMES)
    return path


@pytest.fixture
def tables(call, small_machine_file, errors_file, tmp_path):
    """Folder with exported isg-csv tables."""
    folder = tmp_path / "tables"
    assert call("export", small_machine_file, errors_file, "--controller", "isg-csv", "--out", folder)[0] == 0
    return folder


def strict_json(text):
    """The one JSON object that a text consists of; NaN and Infinity are no JSON."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    value = json.loads(text, parse_constant=refuse)
    assert isinstance(value, dict)
    return value


# --- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_has_units_and_an_example_that_parses(name):
    outcome = CliRunner().invoke(cli, [name, "--help"])
    assert outcome.exit_code == 0
    assert any(unit in outcome.output for unit in ("mm", "um", "urad"))
    example = outcome.output.split("Example:")[1].strip().split("\n\n")[0].split()
    assert example[:2] == ["volcomp", name]
    command = cli.commands[name].loaded
    with command.make_context(name, example[2:]):
        pass
    assert all(option.help for option in command.params if isinstance(option, click.Option))


@pytest.mark.parametrize(
    ("command", "option", "kind"),
    [
        ("import", "--zero-runs", "[drop|keep]"),
        ("import", "--dates", "[dmy|mdy|ymd]"),
        ("import", "--axis", "[x|y|z]"),
        ("identify", "--method", "[joint|two-step]"),
        ("identify", "--u-length-um", "FLOAT"),
        ("diagnose", "--max-effects", "INTEGER RANGE"),
        ("fit", "--max-slope", "NAME=LIMIT"),
        ("compare", "--edition", "[1988|1997|2006|2014]"),
    ],
)
def test_the_type_of_an_option_follows_from_the_field_that_declares_it(command, option, kind):
    output = CliRunner().invoke(cli, [command, "--help"]).output
    assert f"{option} {kind}" in output


def test_the_main_help_states_units_exit_codes_and_every_command():
    output = CliRunner().invoke(cli, ["--help"]).output
    assert all(f"  {name} " in output for name in COMMANDS)
    assert all(
        text in output for text in ("mm", "um and urad", "0 done", "1 done", "2 wrong", "3 internal", "Example:")
    )


# --- commands that work ----------------------------------------------------------------------------------------------


def test_run_writes_everything_and_exits_with_0(call, small_machine_file, small_lengths_file, tmp_path):
    out = tmp_path / "out"
    code, stdout, stderr = call("run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--out", out)
    assert (code, stderr) == (0, "")
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()) == [
        "calibration.json",
        "check/check-program.md",
        "check/check-program.nc",
        "dossier.json",
        "dossier.md",
        "fit.json",
        "fitted.errors.csv",
        "identified.covariance.npz",
        "identified.errors.csv",
        "identify.json",
        "machine.toml",
        "manifest.json",
        "preflight.md",
        "report.html",
        "report.json",
        "residuals.csv",
        "result.json",
        "stations.csv",
        "volcomp0.csv",
        "volcomp0.lis",
        "volume.csv",
    ]
    result = strict_json((out / "result.json").read_text())
    assert result["accepted"] is True
    assert {item["name"]: item["sha256"] for item in result["files"]} == {
        name: sha256_of((out / name).read_bytes()) for name in ("volcomp0.csv", "volcomp0.lis")
    }
    for figures in (result["before"], result["after"]):
        assert {"max_um", "rms_um", "p95_um", "v_x_um", "v_y_um", "v_z_um"} <= set(figures)
    assert "accepted" in stdout
    assert str(out / "volcomp0.csv") in stdout
    assert "\x1b" not in stdout


def test_run_as_json_prints_one_object_and_nothing_else(call, small_machine_file, small_lengths_file, tmp_path):
    words = ("run", small_machine_file, small_lengths_file, "--out", tmp_path / "out", "--json", "--controller")
    code, stdout, stderr = call(*words, "isg-csv")
    printed = strict_json(stdout)
    assert (code, stderr) == (0, "")
    assert {"accepted", "controller", "before", "after", "unrepresentable_um", "files", "identify"} <= set(printed)
    written = strict_json((tmp_path / "out" / "result.json").read_text())
    assert {key: printed[key] for key in written} == written


def test_several_controls_get_a_folder_each(call, small_machine_file, small_lengths_file, tmp_path):
    words = ("--controller", "siemens-cec", "--controller", "siemens-eec", "--controller", "siemens-cec")
    code, stdout, _ = call("run", small_machine_file, small_lengths_file, *words, "--out", tmp_path / "out", "--json")
    assert code == 0
    assert set(strict_json(stdout)["controllers"]) == {"siemens-cec", "siemens-eec"}
    assert (tmp_path / "out" / "siemens-cec" / "NC_CEC.INI").is_file()
    assert (tmp_path / "out" / "siemens-eec" / "result.json").is_file()


def test_a_result_that_is_not_acceptable_exits_with_1(call, small_machine_file, small_lengths_file, tmp_path):
    """Curves that are smoothed to straight lines leave most of the errors."""
    words = ("run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--smoothness", "1e12")
    code, stdout, _ = call(*words, "--out", tmp_path / "out", "--json")
    printed = strict_json(stdout)
    assert code == 1
    assert printed["accepted"] is False
    assert printed["reasons"]
    assert (tmp_path / "out" / "NOT-ACCEPTED-volcomp0.csv").is_file()
    assert not (tmp_path / "out" / "volcomp0.csv").exists()
    code, stdout, _ = call(*words, "--out", tmp_path / "out")
    assert code == 1
    assert "REJECTED" in stdout
    assert "isg-csv: correction" in stdout


def test_identify_and_fit_write_their_files(call, small_machine_file, small_lengths_file, tmp_path):
    code, stdout, _ = call("identify", small_machine_file, small_lengths_file, "--out", tmp_path / "a", "--json")
    assert code == 0
    assert strict_json(stdout)["rank"] > 0
    summary = strict_json((tmp_path / "a" / "identify.json").read_text())
    assert summary["inputs"][-1]["sha256"] == sha256_of(small_lengths_file.read_bytes())
    identified = tmp_path / "a" / "identified.errors.csv"
    assert len(read_csv(tmp_path / "a" / "stations.csv", ("station", "x_mm"), (), ("",))) == 4
    code, stdout, _ = call("fit", small_machine_file, identified, "--out", tmp_path / "b", "--json")
    assert code == 0
    strict_json(stdout)
    strict_json((tmp_path / "b" / "fit.json").read_text())
    assert compgen.read_errors(tmp_path / "b" / "fitted.errors.csv").names == compgen.read_errors(identified).names


def test_simulate_writes_what_the_seed_says(call, small_machine_file, small_lengths_file, tmp_path):
    scenario = small_lengths_file.parent / "scenario.toml"
    words = ("simulate", small_machine_file, "--scenario", scenario, "--json")
    assert call(*words, "--out", tmp_path / "a")[0] == 0
    assert (tmp_path / "a" / "small.lengths.csv").read_bytes() == small_lengths_file.read_bytes()
    code, stdout, _ = call(*words, "--out", tmp_path / "b", "--seed", "99")
    assert code == 0
    assert Path(strict_json(stdout)["files"]["truth.errors.csv"]).is_file()
    assert (tmp_path / "b" / "truth.errors.csv").read_bytes() != (tmp_path / "a" / "truth.errors.csv").read_bytes()


def columns_of(path, *names):
    table = read_csv(path, ("x_mm", "y_mm", "z_mm", *names))
    assert [name for name in path.read_text().splitlines() if not name.startswith("#")][0].split(",") == [
        "x_mm",
        "y_mm",
        "z_mm",
        *names,
    ]
    return np.column_stack([table.numbers(name) for name in names])


def isg_errors(path, position_mm):
    """All 21 errors at positions (n, 3) by a reader of its own of the columns that were exported, mm and rad."""
    values, names = {}, []
    for line in path.read_text().splitlines():
        words = line.split()
        if not words or line.startswith(("//", "#")):
            continue
        if words[0][-1].isalpha():
            names = words
            values.update({name: [] for name in names})
        else:
            for name, word in zip(names, words, strict=True):
                values[name].append(float(word))
    result = np.zeros((len(position_mm), 21))
    for k, name in enumerate(compgen.data.names.ERROR_NAMES):
        key = name if name in values else name[1:]
        if key not in values:
            continue
        axis = "XYZ".index(name[-1])
        nodes = values["XYZ"[axis]]
        result[:, k] = (
            values[key][0] if len(key) == 3 and key[1] == "0" else np.interp(position_mm[:, axis], nodes, values[key])
        )
    return result


def test_read_writes_minus_c_p_of_the_exported_errors(call, tables, small_machine, small_machine_file, points_file):
    out = tables.parent / "correction.csv"
    words = ("read", small_machine_file, tables / "volcomp0.csv", "--controller", "isg-csv", "--points", points_file)
    code, stdout, stderr = call(*words, "--out", out)
    assert (code, stderr) == (0, "")
    assert "4 points" in stdout
    position = np.array([[float(word) for word in line.split(",")] for line in EXTREMES.splitlines()[1:]])
    errors = isg_errors(tables / "volcomp0.csv", position)
    assert np.count_nonzero(np.any(errors, axis=0)) == 17
    expected_um = -1e3 * np.einsum("nij,nj->ni", c_matrix(small_machine, position), errors)
    assert np.max(np.abs(columns_of(out, "cx_um", "cy_um", "cz_um") - expected_um)) <= PRINTED_UM
    code, stdout, _ = call(*words, "--out", out, "--json")
    assert strict_json(stdout)["points"] == 4


@pytest.mark.parametrize("exact", [False, True])
def test_predict_writes_the_error_of_the_model(
    exact, call, small_machine, small_machine_file, small_errors, errors_file, points_file, tmp_path
):
    words = ("predict", small_machine_file, errors_file, "--points", points_file, "--out", tmp_path / "e.csv")
    code, stdout, stderr = call(*words, *(["--exact"] if exact else []), "--json")
    assert (code, stderr) == (0, "")
    assert strict_json(stdout)["model"] == ("exact" if exact else "E = C P")
    points = compgen.read_points(points_file)
    model = compgen.exact_error if exact else compgen.volumetric_error
    expected_um = 1e3 * model(small_machine, small_errors, points.position_mm)
    assert np.max(np.abs(columns_of(tmp_path / "e.csv", "ex_um", "ey_um", "ez_um") - expected_um)) <= PRINTED_UM


def test_predict_warns_outside_the_curves_on_stderr_only(call, small_machine_file, errors_file, tmp_path):
    (tmp_path / "far.points.csv").write_text("x_mm,y_mm,z_mm\n900,0,0\n")
    words = ("--points", tmp_path / "far.points.csv", "--out", tmp_path / "e.csv", "--json")
    code, stdout, stderr = call("predict", small_machine_file, errors_file, *words)
    assert code == 0
    strict_json(stdout)
    assert stderr.startswith("warning: ")
    assert "-300 to 200 mm" in stderr


def test_verify_judges_files_and_exits_with_0_or_1(call, tables, small_machine_file, errors_file, points_file):
    words = ("verify", small_machine_file, tables / "volcomp0.csv", tables / "volcomp0.lis", "--controller", "isg-csv")
    words = (*words, "--errors", errors_file, "--out", tables / "check", "--json")
    code, stdout, stderr = call(*words)
    assert (code, stderr) == (0, "")
    assert strict_json(stdout) == strict_json((tables / "check" / "result.json").read_text())
    code, stdout, _ = call(*words, "--points", points_file)
    assert strict_json(stdout)["points"] == 4
    text = (tables / "volcomp0.csv").read_text()
    (tables / "volcomp0.csv").write_text(text.replace(" -0.0", " ~").replace(" 0.0", " -0.0").replace(" ~", " 0.0"))
    code, stdout, stderr = call(*words)
    assert (code, stderr) == (1, "")
    assert "sign is reversed" in " ".join(strict_json(stdout)["reasons"])


def test_export_that_breaks_a_limit_exits_with_1(call, small_machine_file, errors_file, tmp_path):
    machine = tmp_path / "m.toml"
    machine.write_text(small_machine_file.read_text() + "[controllers.isg-csv]\nmax_records = 3\n")
    words = ("export", machine, errors_file, "--controller", "isg-csv", "--out", tmp_path / "out", "--json")
    code, stdout, stderr = call(*words)
    assert code == 1
    assert strict_json(stdout)["accepted"] is False
    assert "not acceptable: " in stderr
    assert "max_records" in stderr
    assert (tmp_path / "out" / "NOT-ACCEPTED-volcomp0.csv").is_file()


@pytest.mark.parametrize("name", ["controllers", "machines"])
def test_listings_print_tables_and_json(name, call):
    code, stdout, stderr = call(name)
    assert (code, stderr) == (0, "")
    known = {"controllers": set(compgen.CONTROLLERS), "machines": {"zha-gantry", "jia-xytz", "moving-table-mill"}}[name]
    assert all(item in stdout for item in known)
    assert "…" not in stdout
    code, stdout, _ = call(name, "--json")
    assert known <= set(strict_json(stdout))


# --- bad input -------------------------------------------------------------------------------------------------------


def without_stations(text, kept):
    """Only the readings of some stations; the number of rows is no longer declared."""
    lines = [line for line in text.splitlines() if not line.startswith("# rows")]
    return "\n".join(line for line in lines if line[:2] not in {"S1", "S2", "S3", "S4"} - set(kept)) + "\n"


def changed_row(text, row, column, cell):
    """The text with one cell of a data row changed, counted from 0."""
    lines = text.splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    cells = lines[first + 1 + row].split(",")
    cells[lines[first].split(",").index(column)] = cell
    lines[first + 1 + row] = ",".join(cells)
    return "\n".join(lines) + "\n"


BAD_LENGTHS = {
    "empty": (lambda text: "", "is empty", False),
    "header-only": (lambda text: "station,point,x_mm,y_mm,z_mm,length_mm\n", "no rows", True),
    "truncated-row": (lambda text: text[: len(text) // 2], "truncated", True),
    "truncated-last-digits": (lambda text: text[:-3], "truncated", True),
    "letter": (
        lambda text: changed_row(text, 7, "length_mm", "12O.5"),
        "column length_mm: '12O.5' is not a number",
        True,
    ),
    "comma": (lambda text: text.replace(",", ";"), "separate columns by commas", True),
    "nan": (lambda text: changed_row(text, 7, "x_mm", "nan"), "column x_mm: 'nan' is not a finite number", True),
    "infinite": (lambda text: changed_row(text, 7, "length_mm", "-inf"), "not a finite number", True),
    "no-station": (lambda text: changed_row(text, 7, "station", ""), "column station: is empty", True),
    "two-stations": (lambda text: without_stations(text, ("S1", "S2")), "contains readings of 2 station(s)", False),
    "binary": (lambda text: "\x00\x01\x02" * 50, "NUL bytes", False),
}


@pytest.mark.parametrize("case", BAD_LENGTHS)
def test_a_bad_measurement_exits_with_2_and_writes_nothing(
    case, call, small_machine_file, small_lengths_file, listing, tmp_path
):
    change, message, has_line = BAD_LENGTHS[case]
    bad = tmp_path / "bad.lengths.csv"
    bad.write_text(change(small_lengths_file.read_text()))
    before = listing(tmp_path)
    code, stdout, stderr = call("run", small_machine_file, bad, "--controller", "isg-csv", "--out", tmp_path / "out")
    check_refused(code, stdout, stderr, message)
    assert str(bad) in stderr or not has_line
    if has_line and "truncated-last" not in case:
        assert f"{bad}:" in stderr.split(message)[0]
    assert listing(tmp_path) == before


def check_refused(code, stdout, stderr, message):
    """Exit code 2, nothing on stdout, one line on stderr that says what is wrong, no traceback."""
    assert code == 2
    assert stdout == ""
    lines = stderr.strip().splitlines()
    assert len(lines) == 1, stderr
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert "Traceback" not in stderr
    assert "internal" not in stderr


def bad_machine(folder, small_machine_file, old, new):
    text = small_machine_file.read_text()
    assert text.count(old) >= 1
    path = folder / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[-50.0, 100.0, -40.0]", "[-50.0, 100.0, 40.0]", "Z = 40 mm is outside the travel -240 ... 0 mm"),
        (
            "range_mm = [-300.0, 200.0]",
            "range_m = [-300.0, 200.0]",
            "'range_m' is not a key here, did you mean 'range_mm'?",
        ),
        ("nodes = 6", "nodes = 6\nstep = 4", "is not a known key"),
        ('chain = "WFYXZT"', 'chain = "WYXZT"', "chain 'WYXZT' is not valid"),
        ("[-300.0, 200.0]", "[200.0, -300.0]", "range_mm"),
        ('mult_mode = "S1"', "products = true", "[controllers.siemens-cec] mult_mode: is missing"),
        ('sign = "error"', 'sign = "err"', "sign"),
        ("[controllers.siemens-cec]", "[controllers.simens-cec]", "did you mean 'siemens-cec'"),
        ('name = "small-gantry"', "name = 7", "name: expected one line of text"),
    ],
)
def test_a_bad_machine_exits_with_2_and_writes_nothing(
    old, new, message, call, small_machine_file, small_lengths_file, listing, tmp_path
):
    machine = bad_machine(tmp_path, small_machine_file, old, new)
    before = listing(tmp_path)
    # wrong settings of a control are an error where it is used
    control = "siemens-cec" if old.startswith(("mult_mode", "sign")) else "isg-csv"
    code, stdout, stderr = call("run", machine, small_lengths_file, "--controller", control, "--out", tmp_path / "o")
    check_refused(code, stdout, stderr, message)
    assert f"{machine}:" in stderr
    assert listing(tmp_path) == before


def test_siemens_cec_without_the_mode_of_its_products_asks_for_it(
    call, small_machine_file, small_lengths_file, listing, tmp_path
):
    machine = bad_machine(tmp_path, small_machine_file, 'mult_mode = "S1"', "products = true")
    before = listing(tmp_path)
    wanted = 'set e.g. mult_mode = "S1", or set products = false'
    words = ("--controller", "siemens-cec", "--out", tmp_path / "out")
    check_refused(*call("run", machine, small_lengths_file, *words), wanted)
    assert listing(tmp_path) == before
    # beside another control, that one gets its tables
    code, _, stderr = call("run", machine, small_lengths_file, "--controller", "isg-csv", *words, "--no-report")
    assert code == 1
    assert f"siemens-cec: no tables: {machine}" in stderr and wanted in stderr
    assert (tmp_path / "out" / "isg-csv" / "result.json").is_file()


def test_two_machines_with_one_name_are_refused_where_that_name_is_used(call, small_machine_file, tmp_path):
    for name in ("a", "b"):
        (tmp_path / "two" / name).mkdir(parents=True)
        shutil.copy(small_machine_file, tmp_path / "two" / name / "machine.toml")
    words = ("run", "small-gantry", "x.csv", "--controller", "isg-csv", "--out", "o")
    check_refused(*call(*words, "--machines", tmp_path / "two"), "two machines have the name 'small-gantry'")
    code, stdout, stderr = call("machines", "--machines", tmp_path / "two")
    assert (code, "zha-gantry" in stdout) == (0, True)
    assert "skipped: two machines have the name 'small-gantry'" in stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--controller", "isg_csv"), "did you mean 'isg-csv'"),
        (("--controller", "siemens"), "Known: "),
        ((), "Missing option '--controller'"),
        (("--controller", "isg-csv", "--smoothness", "-1"), "smoothness"),
        (("--controller", "isg-csv", "--smoothness", "nan"), "smoothness"),
        (("--controller", "isg-csv", "--smoothness", "a"), "'a': expected a number"),
        (("--controller", "isg-csv", "--u-length-um", "-1"), "-1 is not a standard uncertainty"),
        (("--controller", "isg-csv", "--u-length-um", "nan"), "'nan': expected a finite number"),
        (("--controller", "isg-csv", "--outt", "x"), "No such option"),
        (("--controller", "isg-csv", "--templates", "nowhere"), "no such folder"),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_wrong_usage_exits_with_2_and_writes_nothing(
    words, message, as_json, call, small_machine_file, small_lengths_file, listing, tmp_path
):
    before = listing(tmp_path)
    words = ("run", small_machine_file, small_lengths_file, *words, "--out", tmp_path / "out")
    code, stdout, stderr = call(*words, *(["--json"] if as_json else []))
    if as_json:
        printed = strict_json(stdout)
        assert printed["exit_code"] == 2
        assert message in printed["error"]
    check_refused(code, "" if as_json else stdout, stderr, message)
    assert listing(tmp_path) == before


def test_an_unknown_machine_is_refused_with_the_nearest_name(call, small_lengths_file, tmp_path):
    words = ("zha-gantri", small_lengths_file, "--controller", "isg-csv", "--out", tmp_path / "out")
    check_refused(*call("run", *words), "did you mean 'zha-gantry'")
    check_refused(*call("run", "no/such.toml", *words[1:]), "no/such.toml: no such file")


@pytest.mark.parametrize("words", [("nonsense",), ("runn", "--json"), ("--nonsense",)])
def test_an_unknown_command_exits_with_2(words, call):
    code, stdout, stderr = call(*words)
    assert code == 2
    assert (strict_json(stdout)["exit_code"] == 2) if "--json" in words else stdout == ""
    assert stderr.startswith("error: No such ")


def test_no_command_shows_the_help(call):
    code, stdout, stderr = call()
    assert code == 2
    assert stdout == ""
    assert stderr.startswith("Usage: compgen")


def output_cases(small_machine_file, small_lengths_file, errors_file, points_file, tables, out):
    files = ("--controller", "isg-csv")
    scenario = small_lengths_file.parent / "scenario.toml"
    stations = small_lengths_file.parent / "planned.csv"
    stations.write_text(
        "station,x_mm,y_mm,z_mm\nS1,-420,-210,-420\nS2,330,-190,-405\nS3,310,410,-415\nS4,-400,430,-90\n"
    )
    program = small_lengths_file.parent / "part.ngc"
    program.write_text("G21 G90 G17 G54\nG0 X0 Y0 Z-100\nG1 X50 F100\nM2\n")
    drift = points_file.with_name("a.drift.csv")
    drift.write_text("time_s,temp_a_c,dx_um\n0,20,0\n60,21,1\n")
    logger = points_file.with_name("logger.csv")
    logger.write_text("time_s,T\n0,20.5\n")
    once = ("--interval", "0.1", "--hours", "0.0001")
    return {
        "log": (logger, "--sensor", "ambient=T", *once, "--out", out / "day.temperatures.csv"),
        "heat": (small_machine_file, drift, "--out", out),
        "correct": (small_machine_file, program, "--errors", errors_file, "--wcs", "G54=0,0,0", "--out", out),
        "part": (small_machine_file, program, "--errors", errors_file, "--wcs", "G54=0,0,0", "--out", out),
        "init": ("new", "--chain", "WFYXZT", "--travel", "X=0..500,Y=0..500,Z=0..500", "--out", out),
        "run": (small_machine_file, small_lengths_file, *files, "--out", out),
        "identify": (small_machine_file, small_lengths_file, "--out", out),
        "fit": (small_machine_file, errors_file, "--out", out),
        "export": (small_machine_file, errors_file, *files, "--out", out),
        "verify": (small_machine_file, tables / "volcomp0.csv", *files, "--errors", errors_file, "--out", out),
        "simulate": (small_machine_file, "--scenario", scenario, "--out", out),
        "read": (small_machine_file, tables / "volcomp0.csv", *files, "--points", points_file, "--out", out / "c.csv"),
        "predict": (small_machine_file, errors_file, "--points", points_file, "--out", out / "e.csv"),
        "plan": (small_machine_file, "--stations", stations, "--grid", "--out", out),
        "diff": (
            small_machine_file,
            tables / "volcomp0.csv",
            "--against",
            tables / "volcomp0.csv",
            *files,
            "--out",
            out,
        ),
        "merge": (small_machine_file, tables / "volcomp0.csv", *files, "--errors", errors_file, "--out", out),
        "options": (small_machine_file, errors_file, "--out", out),
        "import": (Path(__file__).parents[1] / "golden" / "imports" / "linear.rtl", "--out", out),
        "report": (tables, "--out", out),
        "accuracy": (small_machine_file, errors_file, "--out", out),
        "compare": (small_machine_file, errors_file, errors_file, "--out", out),
        "diagnose": (small_machine_file, small_lengths_file, "--out", out),
    }


WRITING = [
    "correct",
    "part",
    "init",
    "run",
    "identify",
    "fit",
    "export",
    "verify",
    "simulate",
    "read",
    "predict",
    "plan",
    "diff",
    "merge",
    "options",
    "import",
    "report",
    "accuracy",
    "compare",
    "diagnose",
    "heat",
    "log",
]


def test_every_command_that_writes_is_among_these():
    assert {name for name in COMMANDS if any(p.name == "out" for p in cli.commands[name].loaded.params)} == set(WRITING)


@pytest.mark.parametrize("kind", ["read-only", "file", "below-a-file"])
@pytest.mark.parametrize("name", WRITING)
def test_a_place_that_cannot_be_written_exits_with_2_and_stays_as_it_is(
    name, kind, call, small_machine_file, small_lengths_file, errors_file, points_file, tables, listing, tmp_path
):
    place = tmp_path / "place"
    if kind == "read-only":
        place.mkdir()
        place.chmod(0o555)
        out = place
    else:
        place.write_text("mine")
        out = place if kind == "file" else place / "deeper"
    words = output_cases(small_machine_file, small_lengths_file, errors_file, points_file, tables, out)[name]
    before = listing(tmp_path)
    code, stdout, stderr = call(name, *words)
    message = "read-only" if kind == "read-only" else "needs a folder"
    check_refused(code, stdout, stderr, message)
    assert str(place) in stderr
    assert listing(tmp_path) == before
    if kind == "read-only":
        place.chmod(stat.S_IRWXU)


def test_an_output_file_that_is_a_folder_is_refused(call, small_machine_file, errors_file, points_file, tmp_path):
    words = (small_machine_file, errors_file, "--points", points_file, "--out", tmp_path)
    code, stdout, stderr = call("predict", *words)
    check_refused(code, stdout, stderr, "is a folder")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("errors", "error,position_mm,value\nEXQ,0,1\n", "'EXQ' is not an error of ISO 230-1"),
        ("errors", "error,position_mm,value\nEXX,0,1\nEXX,0,2\n", "already in line 2"),
        ("errors", "error,position_mm,value\nEC0Y,5,1\n", "is a constant"),
        ("errors", "error,position_mm,value\nEXX,,1\n", "needs a position"),
        ("points", "x_mm,y_mm\n1,2\n", "column 'z_mm' is missing"),
        ("points", "x_mm,y_mm,z_mm\n1,2,1e999\n", "not a finite number"),
        ("points", "x_mm,y_mm,z_mm,tool_x_mm\n1,2,3,4\n", "not all of"),
    ],
)
def test_bad_errors_and_points_are_refused(
    name, text, message, call, small_machine_file, errors_file, points_file, listing, tmp_path
):
    files = {"errors": errors_file, "points": points_file}
    files[name].write_text(text)
    before = listing(tmp_path)
    words = (small_machine_file, errors_file, "--points", points_file, "--out", tmp_path / "e.csv")
    code, stdout, stderr = call("predict", *words)
    check_refused(code, stdout, stderr, message)
    assert f"{files[name]}" in stderr
    assert listing(tmp_path) == before


def test_a_damaged_table_is_refused_with_file_and_line(call, tables, small_machine_file, errors_file, listing):
    path = tables / "volcomp0.csv"
    lines = path.read_text().splitlines()
    lines[-1] = lines[-1].replace("0", "O")
    path.write_text("\n".join(lines) + "\n")
    before = listing(tables)
    words = (small_machine_file, path, "--controller", "isg-csv", "--errors", errors_file, "--out", tables / "check")
    code, stdout, stderr = call("verify", *words)
    check_refused(code, stdout, stderr, f"{path}:{len(lines)}: ")
    assert listing(tables) == before


def test_a_fault_of_the_program_exits_with_3_without_a_traceback(call, monkeypatch):
    from compgen.cli import listing_commands

    def broken(*_):
        raise KeyError("unforeseen")

    monkeypatch.setattr(listing_commands, "machine_files", broken)
    code, stdout, stderr = call("machines", "--json")
    assert code == 3
    assert strict_json(stdout)["exit_code"] == 3
    assert stderr.startswith("error: internal error: KeyError: 'unforeseen' (test_cli.py:")
    assert "Traceback" not in stderr


# --- as a process ----------------------------------------------------------------------------------------------------


def process(*words, **options):
    script = Path(sys.executable).with_name("compgen")
    return subprocess.run([script, *map(str, words)], capture_output=True, text=True, timeout=120, **options)


def test_the_console_script_works_from_another_folder(small_machine_file, errors_file, points_file, tmp_path):
    words = ("predict", small_machine_file, errors_file, "--points", points_file, "--out", tmp_path / "e.csv", "--json")
    done = process(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert strict_json(done.stdout)["points"] == 4


def test_the_console_script_refuses_bad_input(tmp_path):
    done = process("run", "zha-gantry", "missing.lengths.csv", "--controller", "isg-csv", "--out", "out", cwd=tmp_path)
    check_refused(done.returncode, done.stdout, done.stderr, "missing.lengths.csv: no such file")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [("controllers",), ("controllers", "--json"), ("machines",)])
def test_a_reader_that_stops_early_gets_no_verdict_and_no_traceback(words):
    """As in ``volcomp controllers | head -1``: the exit code is none of those that state a result."""
    script = Path(sys.executable).with_name("compgen")
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "wb") as pipe:
        done = subprocess.run([script, *words], stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize(
    "said, meant",
    [
        ("sinumerik", ["siemens-cec", "siemens-cec-eec", "siemens-eec"]),
        ("fanuc", ["fanuc-3d", "fanuc-pitch", "fanuc-straightness"]),
        ("Beckhoff", ["etalon-exchange", "isg-csv", "twincat-lists"]),
        ("iTNC", ["heidenhain-kinematics"]),
        ("isg_csv", ["isg-csv"]),
    ],
)
def test_the_name_of_a_maker_leads_to_all_of_its_formats(call, said, meant):
    code, _, stderr = call("controllers", said)
    assert code == 2
    assert f"did you mean {' or '.join(map(repr, meant))}?" in stderr


def test_ctrl_c_while_the_program_is_still_being_loaded_prints_no_traceback(tmp_path):
    """The interrupt comes in the middle of the imports, where no command runs yet."""
    hook = "import sys\nclass Interrupt:\n    def find_spec(self, name, *_):\n"
    hook += (
        "        if name == 'compgen.cli':\n            raise KeyboardInterrupt\nsys.meta_path.insert(0, Interrupt())\n"
    )
    (tmp_path / "sitecustomize.py").write_text(hook)
    for words in ([sys.executable, "-m", "compgen"], [Path(sys.executable).with_name("compgen")]):
        done = subprocess.run(
            [*words, "machines"],
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
        )
        assert (done.returncode, done.stdout, done.stderr) == (130, "", "stopped\n")


def test_public_names_are_loaded_on_first_use_and_are_not_hidden_by_sub_packages():
    # what loads on first use is in compgen.resources, of a few lines
    code = "import sys, compgen; loaded = set(sys.modules) - {'compgen.resources'}; "
    code += "assert not {m for m in loaded if m.startswith(('compgen.', 'numpy', 'scipy'))}; "
    code += "import compgen.fitting.bounds as bounds, compgen.identification.options; "
    code += (
        "assert bounds.FitOptions is compgen.FitOptions; assert callable(compgen.fit) and callable(compgen.identify); "
    )
    code += "assert {'fit', 'Machine'} <= set(dir(compgen))"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_type_checkers_see_the_names_that_the_package_offers():
    homes = resources.homes_of("compgen")
    assert sorted(homes) == sorted(compgen.__all__)
    assert all(getattr(compgen, name) is not None for name in compgen.__all__)


@pytest.mark.parametrize(
    "room", [None, *(name for _, name, is_package in iter_modules(compgen.__path__) if is_package)]
)
def test_no_module_hides_a_public_name_of_its_room(room):
    """Importing a module sets it as an attribute of its room: a function of the same name would be gone."""
    package = import_module(f"compgen.{room}") if room else compgen
    modules = {name for _, name, _ in iter_modules(package.__path__)}
    assert not modules & set(getattr(package, "__all__", ()))


# --- the width of a terminal -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [80, 100, 130])
@pytest.mark.parametrize("name", ["isg-csv", "linuxcnc-volumetric"])
def test_no_figure_and_no_verdict_is_cut_off(width, name, small_machine, small_errors, tmp_path):
    """Also with figures of four digits, a long name and a table that is rejected."""
    from rich.console import Console

    from compgen.report.terminal import verification_table

    paths = compgen.export(small_machine, small_errors, "isg-csv").write(tmp_path)
    result = compgen.verify(small_machine, compgen.read_tables(small_machine, paths, "isg-csv"), small_errors)
    figures = Residuals(4321.0, 1234.0, 1.0, 1.0, 1.0, 1.0)
    limits = (4322.0, 4323.0, 4324.0)  # median, lower and upper
    gain = replace(
        result.gain, before_um=(5321.0, 5322.0, 5323.0), after_um=limits, after_rigid_um=(6321.0, 6322.0, 6323.0)
    )
    for (reasons, verdict), with_prior in product((((), "accepted"), (("first", "second"), "REJECTED")), (False, True)):
        wide = replace(result, controller=name, before=figures, after=figures, reasons=reasons)
        wide = replace(wide, gain=gain if with_prior else None)
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(verification_table([wide]))
        text = console.export_text()
        assert verdict in text
        assert "…" not in text
        shown = Counter(re.findall(r"\b[1-6][0-9]{3}\b", text.partition("before, after")[0]))
        # before with both limits, after and its upper one, twice; what the files leave
        probable = Counter(["5321", "5322", "5323", "4322", "4324", "6321", "6323", "4321", "1234"])
        assert shown == (probable if with_prior else Counter({"4321": 2, "1234": 2}))
        assert all(reason in text for reason in reasons)
        assert max(map(len, text.splitlines())) <= width


def test_what_the_data_do_not_determine_is_reported_and_no_curve_is_written(
    call, small_machine_file, small_lengths_file, tmp_path
):
    machine = tmp_path / "fine.toml"
    machine.write_text(small_machine_file.read_text().replace("nodes = 6", "nodes = 13"))
    out = tmp_path / "out"
    code, _, stderr = call("identify", machine, small_lengths_file, "--out", out)
    assert code == 1
    assert "no data at all" in stderr
    report = json.loads((out / "identify.json").read_text())
    assert report["identified"] is False
    assert any("EXX" in text for text in report["unobservable"])
    assert [path.name for path in out.iterdir()] == ["identify.json"]


def test_the_line_number_in_a_message_stays_a_number(call, small_machine_file, small_lengths_file, tmp_path):
    rows = small_lengths_file.read_text().splitlines()
    rows[99] = rows[99].replace(".", "x", 1)
    bad = tmp_path / "bad.lengths.csv"
    bad.write_text("\n".join(rows) + "\n")
    _, _, stderr = call("identify", small_machine_file, bad, "--out", tmp_path / "out")
    assert "bad.lengths.csv:100: column" in stderr


@pytest.mark.parametrize("name", ["a\x1b[2Jb.csv", "a\x9b31mb.csv", "a\u202eb.csv", "a\x07b.csv"])
def test_control_characters_of_names_reach_no_terminal(name, capsys):
    assert run_command(cli, ["identify", "zha-gantry", name, "--out", "out"]) == 2
    said = capsys.readouterr().err
    assert name not in said
    assert name.encode("unicode_escape").decode() in said


@pytest.mark.parametrize("value", ["1e300", "9e18", "-9e18", "1e308", "5e-324", "1e-300"])
@pytest.mark.parametrize("where", ["range", "offset", "error", "u", "option"])
def test_numbers_at_the_edge_are_bad_input_and_no_internal_error(
    where, value, small_machine_file, small_machine, small_errors, tmp_path, capsys
):
    machine, errors = tmp_path / "m.toml", tmp_path / "e.errors.csv"
    text, table = small_machine_file.read_text(), format_errors(small_errors)
    options, expected = [], {2}
    if where == "range":
        text = text.replace("range_mm = [-300.0, 200.0]", f"range_mm = [-300.0, {value}]")
    elif where == "offset":
        text = text.replace("-80.0]", f"{value}]", 1)
    elif where in ("error", "u"):
        lines = table.splitlines()
        row = next(k for k, line in enumerate(lines) if line.startswith("EXX,"))
        cells = lines[row].split(",")
        cells[2 if where == "error" else 3] = value
        table = "\n".join([*lines[:row], ",".join(cells), *lines[row + 1 :]]) + "\n"
        expected = {2} if float(value) > 1e15 or float(value) < 0 else {0, 1}  # next to nothing is nothing
    elif where == "option":
        options = ["--smoothness", value]
    machine.write_text(text)
    errors.write_text(table)
    code = run_command(cli, ["fit", str(machine), str(errors), "--out", str(tmp_path / "out"), *options])
    assert code in expected, capsys.readouterr().err


@pytest.mark.parametrize("value", [1e300, -9e18, np.inf, np.nan])
def test_a_covariance_file_with_numbers_at_the_edge_is_refused(value, small_errors, tmp_path):
    positions = {
        name: small_errors.curves[name].position_mm if name in small_errors.curves else [np.nan]
        for name in small_errors.names
    }
    names = tuple(name for name in small_errors.names for _ in positions[name])
    joined = np.concatenate([positions[name] for name in small_errors.names])
    made = Covariance(names, joined, (), np.zeros(0, dtype=np.int64), np.full((len(names), 2), value))
    path = tmp_path / "identified.covariance.npz"
    path.write_bytes(format_covariance(made, ""))
    with pytest.raises(compgen.InputError, match="not finite, or above"):
        read_covariance(path)
