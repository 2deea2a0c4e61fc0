"""The configuration file states where files are; -q and -v change what is printed and nothing else."""

import re
import shutil
from pathlib import Path

import pytest

from compgen.resources import data_folder

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def own_machine(tmp_path):
    """A folder with a machine that no other folder has."""
    text = (data_folder("machines") / "zha-gantry.toml").read_text().replace('name = "zha-gantry"', 'name = "mine"')
    (tmp_path / "shop").mkdir()
    (tmp_path / "shop" / "mine.toml").write_text(text)
    return tmp_path / "shop"


@pytest.fixture
def configure(tmp_path, monkeypatch):
    """A function that writes a configuration file and lets the program use it."""

    def write(text):
        path = tmp_path / "config.toml"
        path.write_text(text, encoding="utf-8")
        monkeypatch.setenv("COMPGEN_CONFIG", str(path))
        return path

    return write


@pytest.fixture
def runs(tmp_path):
    path = tmp_path / "x.axis.csv"
    rows = [f"X,{x},{d},{r},{x / 100 + d + 0.1 * r:g}" for x in (-500, -300, -100) for d in (1, -1) for r in (0, 1)]
    path.write_text("axis,position_mm,direction,run,deviation_um\n" + "\n".join(rows) + "\n")
    return path


def test_folders_of_the_configuration_are_searched_relative_to_it(call, configure, own_machine):
    assert "mine" not in call("machines")[1]
    configure('machines = "shop"')
    code, stdout, stderr = call("machines")
    assert (code, "mine" in stdout) == (0, True), stderr


def test_an_option_comes_before_the_configuration(call, configure, own_machine, tmp_path):
    (tmp_path / "empty").mkdir()
    configure('machines = ["shop"]')
    assert "mine" not in call("machines", "--machines", tmp_path / "empty")[1]


def test_the_laboratory_of_the_configuration_is_on_sheets_and_stops_nothing_else(call, configure, runs, tmp_path):
    shutil.copy(EXAMPLES / "certificate.toml", tmp_path / "lab.toml")
    configure('certificate = "lab.toml"')
    code, _, stderr = call("accuracy", "zha-gantry", runs, "--out", tmp_path / "out")
    assert code == 0, stderr
    assert "Example Works" in (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
    errors = EXAMPLES / "zha-gantry.truth.errors.csv"
    assert call("accuracy", "zha-gantry", errors, "--out", tmp_path / "errors")[0] == 0
    code, _, stderr = call(
        "accuracy", "zha-gantry", errors, "--certificate", tmp_path / "lab.toml", "--out", tmp_path / "again"
    )
    assert (code, "--certificate: applies to the sheet" in stderr) == (2, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('machine = "x"', r"config\.toml:1: machine: is not a known key"),
        ("machines = 3", r"config\.toml:1: machines: expected the path of a file, or a list of paths; got 3"),
        ("u_length_um = 0.1", r"config\.toml:1: u_length_um: is not a known key"),
        ("machines = [", r"config\.toml:1"),
    ],
)
def test_a_wrong_configuration_is_refused_with_its_line(call, configure, text, message):
    configure(text)
    code, _, stderr = call("machines")
    assert code == 2
    assert re.search(message, stderr), stderr


def test_a_configuration_that_does_not_exist_is_an_error_only_if_it_was_named(call, monkeypatch, tmp_path):
    monkeypatch.setenv("COMPGEN_CONFIG", str(tmp_path / "none.toml"))
    code, _, stderr = call("machines")
    assert (code, "none.toml" in stderr) == (2, True)
    monkeypatch.delenv("COMPGEN_CONFIG")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    assert call("machines")[0] == 0


@pytest.mark.parametrize("before", [True, False], ids=["before the command", "among its options"])
@pytest.mark.parametrize("option", ["-q", "--quiet"])
def test_quiet_prints_no_result_but_writes_the_files(call, runs, tmp_path, before, option):
    words = ["accuracy", "zha-gantry", runs, "--out", tmp_path / "out"]
    code, stdout, stderr = call(*([option, *words] if before else [*words, option]))
    assert (code, stdout, stderr) == (0, "", "")
    assert (tmp_path / "out" / "accuracy.json").is_file()
    assert "A" in call(*words)[1]  # the next call prints again


def test_quiet_keeps_errors(call, tmp_path):
    code, stdout, stderr = call("-q", "accuracy", "zha-gantry", tmp_path / "none.axis.csv", "--out", tmp_path / "out")
    assert (code, stdout) == (2, "")
    assert "none.axis.csv" in stderr


def test_verbose_prints_each_step_with_the_time(call, runs, tmp_path):
    plain = call("accuracy", "zha-gantry", runs, "--out", tmp_path / "out")
    code, stdout, stderr = call("accuracy", "zha-gantry", runs, "--out", tmp_path / "out", "-v")
    assert (code, stdout) == plain[:2]
    assert re.findall(r"^ +\d+\.\d\d s  (.*)$", stderr, re.MULTILINE) == ["reading and evaluating", "done"]
