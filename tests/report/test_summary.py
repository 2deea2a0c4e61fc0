"""The first screen of a result: hand-worked numbers, and results that have none."""

import json
import math
import re

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.circles import Circles, circle_columns, circles_of_columns
from compgen.data.csv_files import format_csv, read_csv
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine
from compgen.report.summary import draw_summary, summary_of

MACHINE = Machine(
    "m", Chain("WFYXZT"), tuple(Axis((0.0, end), np.linspace(0.0, end, 5)) for end in (400.0, 500.0, 300.0))
)
ERRORS = ErrorTable(
    curves={"EXX": Curve(np.array([0.0, 400.0]), np.array([0.0, 8e-3]), np.array([1e-3, 1e-3]))},
    squareness={"EC0Y": (100e-6, 10e-6)},
)


def test_squareness_over_the_travel_the_largest_error_and_what_is_not_measured():
    identify = {
        "determined": ["EC0Y"],
        "not_measured": {"EYY": {"rms_over_volume_um": 15.6}, "EXY": {"rms_over_volume_um": 2.3}},
        "reversal": {"axes": {"X": {"vector_um": [3.25, 0.0, 0.0]}}},
    }
    found = summary_of(MACHINE, ERRORS, identify)
    # dX = -Y EC0Y at Y = 0, 1/6 ... 1 of 500 mm: 100 urad make 50 um at the end; U is 2 x 10 urad x 500 mm = 10 um
    rms = 50.0 * math.sqrt(sum((k / 6) ** 2 for k in range(7)) / 7)
    assert found.weights[0].name == "EC0Y" and found.weights[0].rms_um == pytest.approx(rms, rel=1e-9)
    assert [(item.name, item.state) for item in found.weights] == [
        ("EC0Y", "found"), ("EYY", "not measured"), ("EXX", "partly"), ("EXY", "not measured"),
    ]  # fmt: skip
    assert found.lines == (
        f"largest error: EC0Y +100 urad, +50.0 um over the 500 mm of Y; moves the tool tip by {rms:.1f} um rms",
        "squareness over the travel: EC0Y +50.0 ± 10.0 um over 500 mm",
        "backlash: X +3.25 um",
        "1 error found, 1 partly, 2 not measured",
        "what was not measured may cost, rms over the volume: EYY 15.6 um, EXY 2.30 um",
    )
    (picture,) = draw_summary(found)
    assert re.findall(r'data-unit="um">([\d.]+)<', picture.svg) == [f"{rms:.1f}", "15.6", "4.81", "2.30"]


def test_the_backlash_of_axis_runs_is_that_of_their_directions(tmp_path, call):
    """X stops 6 um further in the positive approach at every target: +6.00 um, with the sign of ISO 230-2."""
    path = tmp_path / "x.axis.csv"
    rows = [
        f"X,{place},{way},{run},{0.01 * place + 3.0 * way + 0.25 * (run - 2):.3f}"
        for run in (1, 2, 3)
        for way in (1, -1)
        for place in range(-800, 1, 100)
    ]
    path.write_text("\n".join(["axis,position_mm,direction,run,deviation_um", *rows]) + "\n")
    call("identify", "zha-gantry", path, "--out", tmp_path / "o")
    facts = json.loads((tmp_path / "o" / "identify.json").read_text())
    assert facts["axis-runs"]["axes"]["X"]["reversal_um"] == pytest.approx(6.0, abs=1e-6)
    assert summary_of(MACHINE, ERRORS, facts).lines[2] == "backlash: X +6.00 um"


def test_a_result_without_errors_or_with_damaged_facts_has_no_summary_or_a_shorter_one():
    assert summary_of(None, ERRORS, {}) is None
    assert summary_of(MACHINE, ErrorTable(), {}) is None
    damaged = {"not_measured": ["EYY"], "reversal": {"axes": 3}, "circles": {"unknowns": [3]}}
    assert summary_of(MACHINE, ERRORS, damaged).lines[-1] == "2 errors found, 0 partly, 0 not measured"


def test_circles_of_a_result_are_those_that_were_read(tmp_path):
    angle = np.radians([0.0, 90.0, 180.0])
    given = Circles(
        np.array([0, 0, 2]), angle, np.full(3, 100.0), np.array([1e-3, -2e-3, 3e-3]), np.array([1, -1, 1]),
        np.array([0, 1, 0]), np.array([0, 0, 1]), np.full((3, 3), np.nan), np.full(3, np.nan),
    )  # fmt: skip
    path = tmp_path / "residuals.csv"
    path.write_text(format_csv({**circle_columns(given), "residual_um": np.zeros(3), "used": np.ones(3)}))
    found = circles_of_columns(read_csv(path, ("residual_um", "used"), tuple(circle_columns(given))))
    for name in ("plane", "direction", "run", "setup"):
        assert getattr(found, name).tolist() == getattr(given, name).tolist()
    np.testing.assert_allclose(found.angle_rad, angle, atol=1e-8)
    np.testing.assert_allclose(found.deviation_mm, given.deviation_mm, atol=1e-9)


def test_the_report_of_a_folder_begins_with_what_matters(small_machine_file, small_lengths_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert run_command(cli, ["identify", str(small_machine_file), str(small_lengths_file), "--out", str(out)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert run_command(cli, ["report", str(out)]) == 0
    page, data = (out / "report.html").read_text(), json.loads((out / "report.json").read_text())
    lines = data["summary"]["lines"]
    assert page.index("What matters") < page.index("<h2>Figures") and 'id="figure-summary"' in page
    assert all(line[1:].replace(" um", " µm").replace(" urad", " µrad") in page for line in lines)
    assert any(" um" in line for line in lines)  # as the terminal prints them
    assert lines[0] in printed and lines[-1] in printed
