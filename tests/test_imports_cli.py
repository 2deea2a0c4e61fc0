"""`compgen import`, and commands that are given foreign files: from file to tables in one command."""

import json
import time
from pathlib import Path

import openpyxl
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.core.error_table import read_errors

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "tests" / "golden" / "imports"
VENDOR = ROOT / "tests" / "golden" / "etalon-exchange" / "vendor.etalon.txt"
MACHINE = """\
name = "imported"
chain = "WFYXZT"
[axes.X]
range_mm = [0.0, 400.0]
nodes = 5
[axes.Y]
range_mm = [-280.0, 270.0]
nodes = 5
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 5
"""


@pytest.fixture
def machine(tmp_path):
    path = tmp_path / "machine.toml"
    path.write_text(MACHINE)
    return str(path)


def call(capsys, *words):
    code = run_command(cli, [str(word) for word in words])
    shown = capsys.readouterr()
    return code, shown.out, shown.err


def test_import_shows_what_it_understood_and_writes_nothing_without_out(capsys, tmp_path, listing):
    before = listing(tmp_path)
    code, out, err = call(capsys, "import", GOLDEN / "linear.rtl")
    assert code == 0
    for line in ("axis: X", "targets: 5", "runs: 5", "directions: both", "unit: um", "sign: measured minus target"):
        assert line in out
    assert err == ""
    assert listing(tmp_path) == before


def test_import_as_json_is_one_object_and_writes_the_contract_file(capsys, tmp_path, machine):
    code, out, _ = call(
        capsys, "import", GOLDEN / "german.csv", "--machine", machine, "--out", tmp_path / "o", "--json"
    )
    facts = json.loads(out)
    assert code == 0
    assert facts["kind"] == "axis"
    assert facts["doubts"] == []
    assert facts["machine"] == {"name": "imported", "outside": []}
    assert facts["files"] == [str(tmp_path / "o" / "german.axis.csv")]


def test_import_writes_nothing_while_something_is_open(capsys, tmp_path):
    code, out, _ = call(capsys, "import", GOLDEN / "ecmc_ISO230.dat", "--out", tmp_path / "o")
    assert code == 2
    assert "give --axis" in out
    assert not (tmp_path / "o").exists()
    code, _, _ = call(capsys, "import", GOLDEN / "ecmc_ISO230.dat", "--axis", "y", "--out", tmp_path / "o")
    assert code == 0
    assert (tmp_path / "o" / "ecmc_ISO230.axis.csv").exists()


def test_positions_beyond_the_travel_are_named(capsys, tmp_path, machine):
    path = tmp_path / "x.csv"
    path.write_text("position [mm],deviation [um],axis\n0,1,X\n4000,2,X\n")
    code, out, _ = call(capsys, "import", path, "--machine", machine, "--out", tmp_path / "o")
    assert code == 2
    assert "0 to 4000 mm, the travel of imported from 0 to 400 mm" in out
    assert not (tmp_path / "o").exists()


def test_own_files_and_unknown_sheets_are_usage_errors(capsys):
    code, _, err = call(capsys, "import", ROOT / "examples" / "zha-gantry.lengths.csv")
    assert code == 2
    assert "compgen's own format (lengths)" in err
    code, _, err = call(capsys, "import", GOLDEN / "wide.xlsx", "--sheet", "Q", "--json")
    assert code == 2
    assert "no sheet 'Q'" in err


@pytest.mark.parametrize("name", ["linear.rtl", "wide.xlsx", "german.csv"])
def test_from_a_foreign_measurement_to_accepted_tables_in_one_command(capsys, tmp_path, machine, name):
    code, out, err = call(
        capsys,
        "run",
        machine,
        GOLDEN / name,
        "--controller",
        "isg-csv",
        "--smoothness",
        "0",
        "--out",
        tmp_path / "o",
        "--json",
    )
    assert code == 0, err
    facts = json.loads(out)
    assert facts["accepted"] is True
    assert "was taken as" in err
    assert facts["identify"]["method"] == "axis-runs"
    assert facts["before"]["v_x_um"] == pytest.approx(8.0, abs=1e-6)  # M of ISO 230-2 in the golden example
    assert facts["after"]["max_um"] < 0.01
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert [round(1e3 * value, 9) for value in errors.curves["EXX"].value] == [0.0, 3.5, -2.0, -4.5, 3.0]


def test_from_an_exchange_file_and_from_a_sheet_of_errors_to_tables_in_one_command(capsys, tmp_path, machine):
    code, _, err = call(capsys, "export", machine, VENDOR, "--controller", "isg-csv", "--out", tmp_path / "a")
    assert code == 0, err
    book = openpyxl.Workbook()
    for row in (["Position", "EXX"], ["mm", "um"], [0, 0], [200, 5], [400, -3]):
        book.active.append(row)
    book.save(tmp_path / "errors.xlsx")
    code, _, err = call(
        capsys, "export", machine, tmp_path / "errors.xlsx", "--controller", "isg-csv", "--out", tmp_path / "b"
    )
    assert code == 0, err
    assert (tmp_path / "b" / "volcomp0.csv").exists()


def test_an_exchange_file_runs_through_the_whole_chain(capsys, tmp_path, machine):
    path = tmp_path / "tracer.txt"
    path.write_text(
        "// constructed\n[C0Y]\nVALUE = 0.00002\n[EXX]\nGridpoints = {\n0 0.003\n100 0.007\n200 0.002\n400 0.005\n}\n"
        "[EYX]\nGridpoints = {\n0 0.001\n200 0.006\n400 0.003\n}\n"
    )
    code, out, err = call(capsys, "run", machine, path, "--controller", "isg-csv", "--out", tmp_path / "o", "--json")
    assert code == 0, err
    facts = json.loads(out)
    assert facts["identify"]["method"] == "given"
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert [round(1e3 * float(errors.curves["EXX"].at(x)), 6) for x in (0, 100, 200, 400)] == [0, 4, -1, 2]
    # the line 1 + 2 x / 400 um of the straightness turns X by +5 urad about Z: Y is 5 urad less beyond square to it
    assert [round(1e3 * float(errors.curves["EYX"].at(x)), 6) for x in (0, 200, 400)] == [0, 4, 0]
    assert 1e6 * errors.squareness["EC0Y"][0] == pytest.approx(15, abs=1e-6)


def test_a_file_that_leaves_something_open_is_not_computed_with(capsys, tmp_path, machine):
    code, _, err = call(
        capsys, "run", machine, GOLDEN / "ecmc_ISO230.dat", "--controller", "isg-csv", "--out", tmp_path / "o"
    )
    assert code == 2
    assert "leaves open" in err
    assert "give --axis" in err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("command", ["import", "identify", "run", "fit"])
def test_a_file_of_500_megabytes_is_answered_within_a_second(capsys, tmp_path, machine, command):
    path = tmp_path / "huge.rtl"
    with path.open("wb") as stream:
        stream.write(b"HEADER::\r\n")
        stream.truncate(500_000_000)
    words = {
        "import": [path],
        "identify": [machine, path, "--out", tmp_path / "o"],
        "run": [machine, path, "--controller", "isg-csv", "--out", tmp_path / "o"],
        "fit": [machine, path, "--out", tmp_path / "o"],
    }[command]
    started = time.monotonic()
    code, _, err = call(capsys, command, *words)
    assert time.monotonic() - started < 1.0
    assert code == 2
    assert "500 MB" in err
