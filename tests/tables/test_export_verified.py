"""``volcomp export`` reads its files back: it never exits with 0 on tables that ``volcomp verify`` refuses."""

import json
from dataclasses import replace

import pytest

import compgen
import compgen.pipeline
from compgen.cli import cli
from compgen.cli.common import run_command


@pytest.fixture
def words(small_machine_file, small_errors, tmp_path):
    path = tmp_path / "e.errors.csv"
    path.write_text(compgen.format_errors(small_errors))
    return ["export", str(small_machine_file), str(path), "--controller", "isg-csv", "--out", str(tmp_path / "out")]


def test_the_result_of_the_round_trip_is_beside_the_tables(words, tmp_path, capsys):
    assert run_command(cli, [*words, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["accepted"], printed["verified"], printed["reasons"]) == (True, True, [])
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["accepted"] is True
    assert result["after"]["max_um"] < 1.0
    assert "tool_range_mm" in result["judged_with_tools"]  # assumed, and said so
    assert [item["name"] for item in result["files"]] == ["volcomp0.csv", "volcomp0.lis"]


def test_tables_that_are_read_back_wrong_are_not_accepted(words, tmp_path, monkeypatch, capsys):
    """An exporter that turns every sign: only what is read back shows it."""
    right = compgen.export

    def turned(machine, errors, controller, **options):
        curves = {name: replace(curve, value=-curve.value) for name, curve in errors.curves.items()}
        return right(machine, replace(errors, curves=curves), controller, **options)

    monkeypatch.setattr("compgen.cli.table_commands.export", turned)
    assert run_command(cli, [*words, "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["accepted"] is False
    assert any("its sign is reversed" in reason for reason in printed["reasons"])
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "NOT-ACCEPTED-volcomp0.csv" in names
    assert "volcomp0.csv" not in names
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["accepted"] is False
    assert run_command(cli, [*words, "--no-verify", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verified"] is False
