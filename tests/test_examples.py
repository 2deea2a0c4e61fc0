"""The shipped examples run and say what they promise."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from compgen.tables import export

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_the_quickstart_identifies_exports_and_verifies():
    done = subprocess.run(
        [sys.executable, "-W", "error", EXAMPLES / "quickstart.py"], capture_output=True, text=True, timeout=300
    )
    assert (done.returncode, done.stderr) == (0, "")
    squareness, chi_square = re.search(r"EC0Y ([-\d.]+) urad, chi2 ([\d.]+)", done.stdout).groups()
    before, after, accepted = re.search(r"before ([\d.]+) um, after ([\d.]+) um, accepted: (\w+)", done.stdout).groups()
    assert float(squareness) == pytest.approx(2903.6, abs=0.8)
    assert 0.9 <= float(chi_square) <= 1.1
    assert float(before) > 1000
    assert float(after) <= 2.0
    assert accepted == "True"


def test_the_check_against_the_truth_runs_on_written_files(example, tmp_path, monkeypatch, capsys):
    for name in ("isg-csv", "siemens-cec"):
        export(example.machine, example.fitted.errors, name).write(tmp_path / name)
    monkeypatch.setattr(sys, "argv", ["against_truth.py", str(tmp_path)])
    runpy.run_path(str(EXAMPLES / "against_truth.py"), run_name="__main__")
    figures = re.findall(r"(\S+)\s+max\s+([\d.]+) um\s+rms\s+([\d.]+) um", capsys.readouterr().out)
    assert [name for name, _, _ in figures] == ["isg-csv", "siemens-cec"]
    assert all(float(largest) <= 2.0 and float(rms) <= 0.8 for _, largest, rms in figures)
