"""``volcomp recal history --drift`` and ``recheck`` on a store: figures, page, points, tolerances, wrong input."""

import json
from datetime import UTC, datetime, timedelta
from xml.etree import ElementTree

import numpy as np
import pytest
from texts.reading import left_in_english, shown

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.csv_files import read_csv
from compgen.data.error_table import Curve, format_errors
from compgen.fleet import claims, decisions
from compgen.fleet import claims as results
from compgen.fleet.change import calibrations_of
from compgen.fleet.drift import DriftSettings, drift_report
from compgen.fleet.history_page import history_page
from compgen.fleet.job import read_job
from compgen.fleet.records import NewMeasurement, NewResult
from compgen.fleet.store import open_store

BEGIN = datetime(2026, 1, 10, 8, 0, tzinfo=UTC)
JOB = """\
store = "recal.sqlite"
[machines.mill]
machine = "mill.toml"
inbox = "inbox"
controllers = ["siemens-cec"]
out = "out"
measured_with = "bare"
[machines.mill.tolerances]
EC0Y_urad = 20
volume_um = 10
"""
STATIONS = "station,x_mm,y_mm,z_mm\nA,-420,-210,-420\nB,330,-190,-405\nC,310,410,-415\nD,-400,430,-90\n"


def errors_text(errors, month, generator):
    """EC0Y drifts by 2 urad a month; everything is read with noise of 0.2 um and urad."""
    curves = {}
    for name, curve in errors.curves.items():
        u = np.full(len(curve.value), 0.2e-3 if name[1] in "XYZ" else 0.2e-6)
        curves[name] = Curve(curve.position_mm, curve.value + u * generator.normal(size=len(u)), u)
    drift = {"EC0Y": 2e-6 * month}
    constants = {
        name: (value + drift.get(name, 0.0) + 0.2e-6 * generator.normal(), 0.2e-6)
        for name, (value, _) in errors.squareness.items()
    }
    return format_errors(errors.replace(curves=curves, squareness=constants))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_machine_file, small_errors):
    """A job and a store with eight months of one machine; the third calibration's tables are active."""
    where, generator = tmp_path_factory.mktemp("drift"), np.random.default_rng(8)
    (where / "recal.toml").write_text(JOB)
    (where / "mill.toml").write_text(small_machine_file.read_text())
    (where / "stations.csv").write_text(STATIONS)
    store = open_store(read_job(where / "recal.toml").store)
    mill = store.add_machine("mill")
    for month in range(8):
        at = BEGIN + timedelta(days=30.4375 * month)
        new = NewMeasurement(f"{month:064x}", f"m{month}", at, "file", {"a.csv": b"%d" % month})
        claim = claims.take(store, store.add_measurement(mill, new), claims.owner_name())
        result = NewResult(
            machine_text=small_machine_file.read_bytes(),
            errors_text=errors_text(small_errors, month, generator).encode(),
            covariance=None,
            fitted_text=None,
            summary={},
            program="1",
            active_table_id=None,
            files=(),
            accepted=True,
            hold=(),
            judgement={},
            approve=month == 2,
            settings_sha256="0" * 64,
            seconds=1.0,
        )
        active = decisions.active_table(store, mill)
        results.keep_result(store, mill, claim, result, None if active is None else active.id)
    store.close()
    return where


@pytest.fixture
def call(folder, monkeypatch, capsys):
    def run(*words):
        monkeypatch.chdir(folder)
        code = run_command(cli, list(words))
        return code, capsys.readouterr()

    return run


def test_the_drift_is_counted_from_the_active_tables(call, folder):
    code, output = call("recal", "history", "mill", "--drift", "--report", "mill.html", "--json")
    told = json.loads(output.out)
    assert code == 0
    drift = told["drift"]
    assert drift["reference"] == drift["times"][2]
    found = next(item for item in drift["figures"] if item["figure"] == "EC0Y")
    assert found["tolerance"] == pytest.approx(20.0)
    trend = found["trend"]
    assert abs(30.4375 * trend["per_day"] - 2.0) < 3 * 30.4375 * trend["u_per_day"]
    # 2 urad a month from the third calibration (month 2): 20 urad in month 12, five after the last one
    assert found["forecast"]["low_days"] < 5 * 30.4375 < found["forecast"]["high_days"]
    assert any(text.startswith("EC0Y leaves tolerance in about ") for text in drift["sentences"])
    assert (folder / "mill.html").exists()


def test_the_drift_is_said_in_words(call):
    code, output = call("recal", "history", "mill", "--drift")
    assert code == 0
    assert "since the first:" in output.out and "changed: EC0Y" in output.out.replace("\n", " ")


def test_the_page_needs_nothing_else_and_escapes_texts(folder):
    store = open_store(read_job(folder / "recal.toml").store)
    history, _, machine = calibrations_of(store, store.machine("mill"))
    store.close()
    page = history_page(drift_report(machine, history, name="<script>alert(1)</script>"))
    assert "<script" not in page and "&lt;script&gt;" in page
    assert "src=" not in page and "http-equiv" in page
    assert page.count("<svg ") == page.count("</svg>") and page.count('<svg class="plot"') > 10
    start = page.index("<svg", page.index('id="picture-figure-EC0Y"'))
    picture = page[start : page.index("</svg></div>", start) + 6]  # the axes are an svg within the svg
    assert ElementTree.fromstring(picture.replace("xlink:href", "href")).tag == "svg"
    assert len(set(part.split('"')[0] for part in page.split(' id="')[1:])) == page.count(' id="')


def test_the_page_in_german_has_no_english_text(folder):
    store = open_store(read_job(folder / "recal.toml").store)
    history, _, machine = calibrations_of(store, store.machine("mill"))
    store.close()
    page = history_page(drift_report(machine, history, DriftSettings({"EC0Y": 20e-6})), "de")
    assert [text for text in shown(page) if left_in_english(text, ())] == []
    assert "EC0Y verlässt die Toleranz in etwa " in page and '<html lang="de">' in page


def test_a_recheck_is_found_and_its_points_written(call, folder):
    code, output = call(
        "recal", "recheck", "mill", "--stations", "stations.csv", "--error", "EC0Y", "--change", "10",
        "--points", "recheck.points.csv", "--json",
    )  # fmt: skip
    told = json.loads(output.out)
    assert code == 0 and told["power"] >= 0.9 and told["smallest"] <= 10.0
    assert len(read_csv(folder / "recheck.points.csv", required=("x_mm", "y_mm", "z_mm"))) == told["points"] < 20


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("history", "--drift"), "give its name"),
        (("history", "other", "--drift"), "other"),
        (("recheck", "mill", "--stations", "stations.csv", "--error", "EC0X", "--change", "1"), "is not an error"),
        (("recheck", "mill", "--stations", "stations.csv", "--error", "EC0Y", "--change", "-1"), "positive"),
    ],
)
def test_wrong_wishes_exit_with_2(call, words, text):
    code, output = call("recal", *words)
    assert code == 2
    assert text in " ".join(output.err.split())


def test_a_tolerance_in_the_wrong_unit_is_an_error_with_its_name(call, folder, tmp_path):
    (tmp_path / "recal.toml").write_text(JOB.replace("EC0Y_urad", "EC0Y_um"))
    code, output = call("recal", "status", "--job", str(tmp_path / "recal.toml"))
    assert code == 2
    assert "EC0Y_um" in output.err
