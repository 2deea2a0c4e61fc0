"""A second run into a folder: what the first left there is kept, said, and cannot be taken for the new tables."""

import json
import os
import subprocess
import sys

import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data import files
from compgen.errors import InputError, UndeterminedError
from compgen.pipeline import run


@pytest.fixture
def folder(small_machine, small_lengths_file, tmp_path):
    """A folder with the accepted tables of one run, and a report."""
    run(small_machine, [small_lengths_file], ["isg-csv"], tmp_path / "out")
    (tmp_path / "out" / "report.html").write_text("green")
    return tmp_path / "out"


def again(machine, lengths, folder, *controllers):
    return run(machine, [lengths], controllers or ("isg-csv",), folder)


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_edited_table_is_kept_with_a_word(small_machine, small_lengths_file, folder):
    table = folder / "volcomp0.csv"
    exported = table.read_bytes()
    edited = exported.replace(b"0.0", b"0.1", 1)
    table.write_bytes(edited)
    with pytest.warns(
        compgen.CompgenWarning, match=r"kept volcomp0\.csv \(changed after the export\) as PREVIOUS-volcomp0\.csv"
    ):
        again(small_machine, small_lengths_file, folder)
    assert (folder / "PREVIOUS-volcomp0.csv").read_bytes() == edited
    hashes = {item["name"]: item["sha256"] for item in json.loads((folder / "manifest.json").read_text())["files"]}
    assert files.sha256_of(table.read_bytes()) == hashes["volcomp0.csv"]
    assert not (folder / "PREVIOUS-volcomp0.lis").exists()


def test_two_edited_tables_are_both_kept(small_machine, small_lengths_file, folder):
    table = folder / "volcomp0.csv"
    for text in ("first", "second"):
        table.write_text(text)
        with pytest.warns(compgen.CompgenWarning, match="kept"):
            again(small_machine, small_lengths_file, folder)
    assert (folder / "PREVIOUS-volcomp0.csv").read_text() == "first"
    assert (folder / "PREVIOUS-2-volcomp0.csv").read_text() == "second"


def test_tables_that_are_as_they_were_exported_are_replaced_in_silence(small_machine, small_lengths_file, folder):
    before = sorted(contents(folder))
    result = again(small_machine, small_lengths_file, folder)
    assert sorted(set(contents(folder)) - set(before)) == ["PREVIOUS-report.html"]
    assert result.earlier_report == (folder / "PREVIOUS-report.html",)


def test_the_tables_of_another_control_do_not_stay_beside_the_new_ones(small_machine, small_lengths_file, folder):
    with pytest.warns(
        compgen.CompgenWarning, match=r"volcomp0\.csv \(of an earlier export\) as PREVIOUS-volcomp0\.csv"
    ):
        again(small_machine, small_lengths_file, folder, "siemens-cec")
    names = {name for name in contents(folder) if not name.startswith("PREVIOUS-")}
    assert {"NC_CEC.INI"} <= names
    assert not {"volcomp0.csv", "volcomp0.lis", "report.html"} & names


def test_several_controls_after_one_leave_one_result(small_machine, small_lengths_file, folder):
    with pytest.warns(compgen.CompgenWarning, match="kept"):
        again(small_machine, small_lengths_file, folder, "isg-csv", "siemens-cec")
    names = contents(folder)
    assert not {"volcomp0.csv", "manifest.json", "result.json", "check/check-program.md"} & set(names)
    assert {"isg-csv/volcomp0.csv", "siemens-cec/NC_CEC.INI", "PREVIOUS-result.json"} <= set(names)
    with pytest.warns(compgen.CompgenWarning, match=r"siemens-cec: kept NC_CEC.INI"):
        again(small_machine, small_lengths_file, folder, "isg-csv", "neutral")
    assert "siemens-cec/result.json" not in contents(folder)  # or the report would show it as one of the new ones


def test_a_run_of_its_own_in_a_sub_folder_is_left_alone(small_machine, small_lengths_file, folder):
    again(small_machine, small_lengths_file, folder / "trial", "siemens-cec")
    before = contents(folder / "trial")
    again(small_machine, small_lengths_file, folder)
    assert contents(folder / "trial") == before


def test_a_table_that_no_manifest_names_is_said(small_machine, small_lengths_file, folder):
    (folder / "NC_CEC.INI").write_text("of another machine\n")
    with pytest.warns(compgen.CompgenWarning, match=r"NC_CEC\.INI .* did not write"):
        again(small_machine, small_lengths_file, folder)
    assert (folder / "NC_CEC.INI").read_text() == "of another machine\n"


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"files": 3}', '{"files": [{"name": "../outside.txt", "sha256": "0"}]}', "[" * 9999]
)
def test_a_damaged_manifest_loses_nothing(small_machine, small_lengths_file, folder, text):
    outside = folder.parent / "outside.txt"
    outside.write_text("foreign")
    (folder / "manifest.json").write_text(text)
    (folder / "volcomp0.csv").write_text("edited")
    with pytest.warns(compgen.CompgenWarning, match="kept"):
        again(small_machine, small_lengths_file, folder)
    assert (folder / "PREVIOUS-volcomp0.csv").read_text() == "edited"
    assert outside.read_text() == "foreign"


def test_a_rejected_run_leaves_neither_the_old_table_nor_the_old_report(small_machine_file, small_lengths_file, folder):
    rejecting = folder.parent / "rejecting.toml"
    text = small_machine_file.read_text() + "[controllers.isg-csv]\nmax_records = 3\n"
    rejecting.write_text(text)
    words = ["run", rejecting, small_lengths_file, "--controller", "isg-csv", "--out", folder, "--no-report"]
    assert run_command(cli, list(map(str, words))) == 1
    names = set(contents(folder))
    assert {"NOT-ACCEPTED-volcomp0.csv", "PREVIOUS-volcomp0.csv", "PREVIOUS-report.html"} <= names
    assert not {"volcomp0.csv", "volcomp0.lis", "report.html"} & names


KILLED = """
import os, sys
from pathlib import Path
import compgen
from compgen.pipeline import run

machine, lengths, folder = sys.argv[1:]
genuine = os.replace

def killed(source, target):
    if source.name.endswith(".tmp") and target.parent == Path(folder):
        os._exit(9)
    genuine(source, target)

os.replace = killed
run(compgen.load_machine(machine), [lengths], ["siemens-cec"], folder)
"""


def test_killed_before_the_first_new_file_has_its_name_no_old_table_has_its_own(
    small_machine_file, small_lengths_file, folder
):
    done = subprocess.run([sys.executable, "-c", KILLED, small_machine_file, small_lengths_file, folder], timeout=120)
    assert done.returncode == 9
    names = set(contents(folder))
    assert not {"volcomp0.csv", "volcomp0.lis", "report.html", "NC_CEC.INI"} & names
    assert {"PREVIOUS-volcomp0.csv", "PREVIOUS-report.html"} <= names


@pytest.mark.parametrize("fails_at", ["volcomp0.csv", "result.json", "NC_CEC.INI"])
def test_a_full_disk_at_any_control_changes_nothing(small_machine, small_lengths_file, folder, monkeypatch, fails_at):
    (folder / "volcomp0.csv").write_text("edited")
    before = contents(folder)
    genuine = os.replace

    def full(source, target):
        if source.name.endswith(".tmp") and target.name == fails_at and target.is_relative_to(folder):
            raise OSError(28, "No space left on device")
        genuine(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.warns(compgen.CompgenWarning, match="kept"), pytest.raises(InputError, match="nothing was written"):
        again(small_machine, small_lengths_file, folder, "isg-csv", "siemens-cec")
    monkeypatch.undo()
    assert contents(folder) == before


def test_an_undetermined_run_leaves_earlier_results_as_they_are(
    small_machine_file, small_lengths_file, folder, tmp_path
):
    fine = tmp_path / "fine.toml"
    fine.write_text(small_machine_file.read_text().replace("nodes = 6", "nodes = 13"))
    before = contents(folder)
    with pytest.warns(compgen.CompgenWarning, match="results of an earlier run"), pytest.raises(UndeterminedError):
        again(compgen.load_machine(fine), small_lengths_file, folder)
    assert contents(folder) == before


def test_the_reversal_of_one_measurement_is_not_taken_for_that_of_the_next(small_machine, small_lengths_file, folder):
    (folder / "identified.reversal.csv").write_text("of the first measurement")
    again(small_machine, small_lengths_file, folder)
    assert not (folder / "identified.reversal.csv").exists()
    assert (folder / "PREVIOUS-identified.reversal.csv").read_text() == "of the first measurement"


def test_an_export_into_the_folder_of_a_run_leaves_no_result_of_other_tables(small_machine, folder):
    errors = compgen.read_errors(folder / "fitted.errors.csv")
    with pytest.warns(compgen.CompgenWarning, match="kept"):
        compgen.export(small_machine, errors, "siemens-cec").write(folder)
    assert json.loads((folder / "manifest.json").read_text())["controller"] == "siemens-cec"
    assert not (folder / "result.json").exists()
    assert not (folder / "report.html").exists()
