"""A factory of three simulated machines over twelve months under ``volcomp recal``, held against its own truth.

The example in ``examples/factory`` runs once; every test looks at another side of the same year.
"""

import itertools
import re
import shutil
import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import format_axis_runs
from compgen.data.files import sha256_of
from compgen.fleet import actions
from compgen.fleet.change import calibrations_of
from compgen.fleet.dashboard.background import drift_charts, trend_rows
from compgen.fleet.dashboard.charts import ErrorCache
from compgen.fleet.dashboard.charts import history as machine_history
from compgen.fleet.drift import DriftSettings, drift_of_store, drift_report
from compgen.fleet.job import read_job
from compgen.fleet.records import RESERVATION
from compgen.fleet.status import history
from compgen.fleet.store import open_store
from compgen.simulation import read_scenario, simulate_axis_runs

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "factory"
MODULES = ("factory", "plant", "people", "checks", "clocks")
#: Rms of the true error over the volume that is left right after new tables, um; readings are good to some 0.3 um.
LEFT_UM = 0.5


@pytest.fixture(scope="module")
def example():
    """The modules of the example by name."""
    sys.path.insert(0, str(EXAMPLE))
    try:
        yield {name: __import__(name) for name in MODULES}
    finally:
        sys.path.remove(str(EXAMPLE))
        for name in MODULES:
            sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def checks(example):
    return example["checks"]


@pytest.fixture(scope="module")
def year(example, tmp_path_factory):
    """The whole year, simulated."""
    made = example["factory"].begin(tmp_path_factory.mktemp("factory") / "out", seed=1)
    for _ in example["factory"].months(made):
        pass
    return made


@pytest.fixture(scope="module")
def store(year):
    opened = open_store(year.job.store)
    yield opened
    opened.close()


def rows_of(year, machine):
    return [row for row in year.rows if row.machine == machine]


def reasons(row):
    return " | ".join(row.table.reasons)


def holding(row):
    """What holds tables back: reservations are only shown."""
    return [reason for reason in row.table.reasons if not reason.startswith(RESERVATION)]


# --- proposals and refusals ------------------------------------------------------------------------------------------


def test_what_changed_is_proposed_by_the_second_measurement_and_what_did_not_change_is_held(year, checks):
    """Never below what measurements and repeatability explain; three times that at the latest when it is seen twice."""
    judged = [item for item in checks.judged(year) if not item.outside_window]
    assert all(item.true_um > item.expected_um for item in judged if item.significant)
    assert sum(item.true_um < 1e-6 for item in judged) >= 8
    clear = 0
    for name in {item.machine for item in judged}:
        own = [item for item in judged if item.machine == name]
        missed = [item.true_um > 3.0 * item.expected_um and not item.significant for item in own]
        clear += sum(item.true_um > 3.0 * item.expected_um for item in own)
        assert not any(first and second for first, second in itertools.pairwise(missed)), own
    assert clear >= 2  # the crash of B, the spring of C


def test_a_change_within_its_uncertainty_is_held_with_both_figures(year):
    held = [row for row in year.rows if row.table is not None and "is within its uncertainty" in reasons(row)]
    assert {"mill-a", "mill-b"} <= {row.machine for row in held}
    for row in held:
        assert row.table.state == "held"
        p_value = float(re.search(r"p = (\d\.\d+)", reasons(row)).group(1))
        assert p_value >= 0.02 and not row.table.summary["change"]["significant"]


def test_every_proposed_table_has_a_significant_change_behind_it(year):
    for row in year.rows:
        if row.table is not None and row.table.state == "pending" and row.table.summary["active_version"]:
            assert row.table.summary["change"]["significant"]
            assert holding(row) == []


def test_measurements_that_cannot_be_right_are_refused_with_the_cause(year):
    exchanged, wrong_sign, right = rows_of(year, "mill-b")[:3]
    assert exchanged.outcome.state == wrong_sign.outcome.state == "failed"
    assert "column y_mm: -400 mm is outside the travel" in exchanged.outcome.messages[0]
    assert "opposite sign" in wrong_sign.outcome.messages[0]
    assert all(message.startswith("2026-01-04-") for row in (exchanged, wrong_sign) for message in row.outcome.messages)
    assert exchanged.table is wrong_sign.table is None and wrong_sign.active is None
    assert right.outcome.state == "ok" and right.active == 1


def test_an_old_file_is_held_for_its_age(year):
    stale = next(row for row in rows_of(year, "mill-a") if "stick" in row.file)
    assert stale.table.state == "held"
    assert "the measurement is 50.0 days old; at most 30 are allowed" in stale.table.reasons


def test_measurements_outside_the_temperature_window_are_held_and_only_those(year):
    rows = rows_of(year, "mill-c")
    for row in rows:
        outside = not 16.0 <= row.temperature_c <= 24.0
        assert ("16 to 24 degC are allowed" in reasons(row)) == outside
        assert (row.table.state == "held") >= outside
    assert 4 <= sum("degC" in reasons(row) for row in rows) <= 9
    assert not any("degC" in reasons(row) for row in rows_of(year, "mill-a") if row.table)


def test_after_the_crash_the_tables_are_held_for_the_limit_alone_and_a_person_takes_them(year):
    row = next(row for row in rows_of(year, "mill-b") if row.at.month == 7)
    assert row.table.state == "held"
    (reason,) = holding(row)
    # 12 um along Y and 20 urad over 300 mm: sqrt(12^2 + 6^2) = 13.4 um, more or less the noise
    found = float(re.fullmatch(r"isg-csv: the correction changes by up to ([\d.]+) um; the limit is 8 um", reason)[1])
    assert found == pytest.approx(13.4, abs=1.5)
    assert (row.decision.kind, row.decision.actor, row.active) == ("override", "ada", row.table.version)
    assert row.with_um < LEFT_UM < 3.0 < year.factory.left_um("mill-b", row.at, None)


# --- accuracy and rollback -------------------------------------------------------------------------------------------


def test_the_true_machine_is_better_with_the_active_tables_in_every_month(year):
    compensated = [row for row in year.rows if row.active is not None]
    assert len(compensated) == len(year.rows) - 2
    assert all(row.with_um < row.without_um for row in compensated)
    # the scales of C go up and down by 35 um/m in a year, so nobody can tell a month from the next
    assert all(row.with_um < 0.5 * row.without_um for row in compensated if row.machine != "mill-c")
    fresh = [row for row in compensated if row.decision and row.decision.kind in ("approve", "override")]
    assert all(row.with_um < LEFT_UM for row in fresh)


def test_a_rollback_restores_the_bytes(year, store):
    (undone,) = year.undone
    before, wrong, after = undone.files
    assert len(before) > 2 and before == after != wrong
    left = undone.left_um
    assert left[0] == left[2] < LEFT_UM and left[1] > 10.0  # the wrong sign doubles the error of the machine
    kept = {sha256_of(content) for table in store.tables(store.machine("mill-b")) for content in _bytes(store, table)}
    assert {sha256_of(content) for name, content in after.items() if name != "version.json"} <= kept


def _bytes(store, table):
    return [file.content for file in store.table_files(table)]


# --- drift -----------------------------------------------------------------------------------------------------------


def test_the_slow_drift_of_a_is_named_with_the_truth_inside(year, store, checks):
    drift = drift_of_store(store, store.machine("mill-a"), DriftSettings(year.job.machine("mill-a").tolerances))
    assert checks.named_drifts(drift) == {"EC0Y"}
    assert checks.rate(drift).inside
    assert any(re.match(r"EC0Y drifts by \+1\.\d\d urad \(95 % .*\) per month", text) for text in drift.sentences())
    assert not drift.gaps
    exit_of = checks.exit_of(year, drift)
    assert exit_of.inside and 50.0 < exit_of.truth < 300.0 and exit_of.high - exit_of.low < exit_of.truth
    assert any(re.match(r"EC0Y leaves tolerance in about \d+ ", text) for text in drift.sentences())


@pytest.mark.parametrize("known", [6, 8, 10])
def test_forecasts_from_a_part_of_the_year_hold_the_day_that_came(year, checks, known):
    told = checks.exit_of(year, checks.drift_after(year, "mill-a", known, tolerances={"EC0Y": 15e-6}))
    assert told.inside and told.truth > 0.0


def test_the_crash_is_found_as_a_step_in_its_month_with_its_size(year, checks):
    drift = checks.drift_after(year, "mill-b")
    steps, gap = checks.steps_of(drift), checks.gap_of_the_crash(drift)
    assert drift.times[gap - 1].startswith("2026-06") and drift.times[gap].startswith("2026-07")
    assert set(steps) == {"EYY line", "EC0Y"}
    assert all(after == gap and held.inside for after, held in steps.values())
    assert checks.named_drifts(drift) == set()
    assert drift.sentences()[0].startswith("step between 2026-06-05 06:00 UTC and 2026-07-05 06:00 UTC: ")


def test_a_measurement_that_was_wrong_is_left_out_and_would_have_spoilt_the_history(year, store, checks):
    machine = store.machine("mill-b")
    known, ids, model = calibrations_of(store, machine)
    (undone,) = year.undone
    wrong = next(table for table in store.tables(machine) if table.version == undone.version)
    assert wrong.identification_id not in ids and len(ids) == len(store.identifications(machine)) - 1
    record = store.identification(wrong.identification_id)
    spoilt = [*known, type(known[0])(record.measured_at, store.errors_of(record), store.covariance_of(record))]
    spoilt.sort(key=lambda item: item.at)
    assert set(checks.steps_of(drift_report(model, spoilt))) != {"EYY line", "EC0Y"}
    told = drift_of_store(store, machine, DriftSettings()).sentences()
    assert f"version {undone.version} is left out (ada: the sign of the deviations was wrong)" in told


def test_the_season_of_c_is_separated_and_no_drift_is_left(year, checks):
    drift = checks.drift_after(year, "mill-c")
    assert all(item.inside for item in checks.coefficients(year, drift))
    assert checks.named_drifts(drift) == set() and not drift.gaps
    told = drift.sentences()
    for name in ("EXX", "EYY", "EZZ"):
        assert any(re.match(rf"{name} line changes with temperature by .* per K", text) for text in told)


def test_half_a_year_of_warming_up_is_no_drift_if_the_temperature_is_known(year, store, checks):
    known, _, machine = calibrations_of(store, store.machine("mill-c"))
    until_july = known[:7]
    aware = drift_report(machine, until_july)
    assert "EXX line" not in checks.named_drifts(aware)
    assert checks.figure(aware, "EXX line").trend.per_kelvin is not None
    unaware = drift_report(machine, [type(item)(item.at, item.errors, item.covariance) for item in until_july])
    assert "EXX line" in checks.named_drifts(unaware)


# --- history ---------------------------------------------------------------------------------------------------------


def test_the_history_tells_who_decided_what_when_and_why(year, store):
    entries = [entry for entry in history(store) if entry.kind in ("approve", "reject", "rollback", "exclusion")]
    decided = [row for row in year.rows if row.decision is not None]
    assert len(entries) == len(decided) + 2  # the rollback and the exclusion
    assert {entry.actor for entry in entries} == {"ada", "ben"}
    told = [(e.kind, e.actor, e.at, e.text) for e in history(store, store.machine("mill-b"))]
    noon = [item for item in told if item[2].startswith("2026-09-04")]
    assert [item[:3] for item in noon[2:]] == [
        ("approve", "ben", "2026-09-04T07:00:00+00:00"),
        ("rollback", "ada", "2026-09-04T08:00:00+00:00"),
        ("exclusion", "ada", "2026-09-04T08:00:00+00:00"),
    ]
    assert noon[3][3] == "parts are out of tolerance since this morning"
    failed = [item for item in told if item[0] == "failed"]
    assert len(failed) == 2 and failed[0][2] == "2026-01-04T07:00:00+00:00"
    measured = [entry for entry in history(store) if entry.kind == "measurement"]
    assert len(measured) == len(year.rows) == 3 * 12 + 1 + 2 + 1
    assert [entry.at for entry in history(store)] == sorted(entry.at for entry in history(store))


def test_the_example_tells_the_year_line_by_line_and_writes_its_pages(year, example):
    lines = [row.words() for row in year.rows]
    assert re.match(r"2026-01-05 mill-a +[\d.]+ degC  v1 pending   ada: approve +active v1", lines[0])
    assert any("ben: override" in line and "rolled back by ada an hour later" in line for line in lines)
    told = list(example["factory"].tell(year))
    assert any(re.match(r"  EC0Y drifts by \+1\.\d\d urad ", line) for line in told)
    assert any("rollback" in line and " ada " in line and "out of tolerance" in line for line in told)
    pages = sorted((year.factory.folder / "reports").glob("*.html"))
    assert [page.stem for page in pages] == ["mill-a", "mill-b", "mill-c"]
    assert all("changes with temperature" in page.read_text() for page in pages[2:])


def test_running_again_changes_nothing(year, example, listing):
    before = listing(year.factory.folder / "tables")
    year.now += timedelta(days=1)
    outcomes = [year.run(name) for name in example["plant"].NAMES]
    assert all(outcome.processed == () and outcome.state in ("ok", "held") for outcome in outcomes)
    assert listing(year.factory.folder / "tables") == before


def test_the_commands_work_on_the_factory(year, capsys, tmp_path):
    job = ["--job", str(year.factory.folder / "recal.toml")]
    assert run_command(cli, ["recal", "history", "mill-c", "--drift", "--report", str(tmp_path / "c.html"), *job]) == 0
    assert "EXX line changes with temperature" in capsys.readouterr().out
    assert (tmp_path / "c.html").read_text().count('<svg class="plot"') > 10
    wrong = [["exclude", "mill-b", "99"], ["exclude", "mill-b", str(year.rows[-2].active)], ["exclude", "mill-x", "1"]]
    for words in wrong:
        assert run_command(cli, ["recal", *words, "--reason", "?", *job]) == 2
    version = str(year.undone[0].version)
    undo = ["recal", "exclude", "mill-b", version, "--undo", "--actor", "eve", "--reason", "a test", *job]
    assert run_command(cli, undo) == 0
    again = ["recal", "exclude", "mill-b", version, "--actor", "eve", "--reason", "it was wrong", *job]
    assert run_command(cli, again) == 0
    capsys.readouterr()
    assert run_command(cli, ["recal", "history", "mill-b", *job]) == 0
    assert "measurement taken back: a test" in " ".join(capsys.readouterr().out.split())


# --- a measurement of one axis ---------------------------------------------------------------------------------------


# --- the dashboard ---------------------------------------------------------------------------------------------------


def test_the_dashboard_draws_the_steps_that_it_names(year, store):
    found = drift_of_store(store, store.machine("mill-b"), DriftSettings(year.job.machine("mill-b").tolerances))
    rows = trend_rows(found)
    assert {row.name for row in rows[:2]} == {"EYY line", "EC0Y"}
    assert (
        {row.name for row in rows if row.significant} == {row.name for row in rows if row.steps} == {"EYY line", "EC0Y"}
    )
    drawn = {item.title.partition(",")[0]: item for item in drift_charts(found)}
    assert set(drawn) == {"Change in the volume", "EYY line", "EC0Y"}
    for name in ("EYY line", "EC0Y"):
        label, points, marks = drawn[name].lines[1]
        assert label == "trend with steps" and marks == []
        places = [tuple(map(float, point.split(","))) for point in points.split()]
        jumps = [(x, new - old) for (x, old), (same, new) in zip(places, places[1:], strict=False) if x == same]
        ((_, jump),) = jumps
        seen = [mark.y for mark in drawn[name].lines[0][2]]
        assert jump == pytest.approx(np.mean(seen[6:]) - np.mean(seen[:6]), abs=0.25 * abs(jump))


def test_a_machine_at_which_nothing_moves_draws_no_figures(year, store):
    found = drift_of_store(store, store.machine("mill-b"), DriftSettings())
    quiet = replace(found, figures=tuple(item for item in found.figures if item.p_value > 0.05))
    assert [item.title.partition(",")[0] for item in drift_charts(quiet)] == ["Change in the volume"]


def test_the_measurement_that_ada_excluded_is_grey_on_the_page_of_the_machine(store):
    shown = machine_history(store, ErrorCache(store), store.machine("mill-b"))
    grey = {trend.name: trend.chart.left_out for trend in shown.trends}
    assert {len(marks) for marks in grey.values()} == {1}


@pytest.fixture(scope="module")
def prepared(example, tmp_path_factory):
    return example["clocks"].prepared(tmp_path_factory.mktemp("clocks") / "base")


@pytest.mark.parametrize(
    ("name", "state", "said", "would_lose"),
    [
        ("the instrument's clock is 10 minutes behind", "held", "5 min from the decision", True),
        ("the time has no zone", "held", "has no zone", False),
        ("the file has no time and was copied", "held", "changes when it is copied", True),
        ("the server's clock ran ahead", "held", "the clock went back, so the time", True),
        ("the machine has another name in the job file", "held", "never made tables of mill-x active", True),
        ("the store was deleted", "failed", "this store never made active", False),
        ("the store has 0 bytes", "stopped", r"0 bytes", False),
        ("the store is an older one", "failed", "this store never made active", False),
    ],
)
def test_wrong_times_and_lost_histories_never_undo_the_compensation(
    example, prepared, tmp_path, name, state, said, would_lose
):
    """Truth: the exact machine with the tables that are really on; the new tables would lose what the old ones hold."""
    folder = tmp_path / "factory"
    shutil.copytree(prepared, folder)
    case = example["clocks"].carried_out(name, folder)
    assert case.state == state and said in case.said
    assert case.same_files and case.left_um < LEFT_UM
    assert (case.would_leave_um is not None and case.would_leave_um > 9.0) == would_lose


def test_every_case_of_the_example_is_tested(example):
    tested = test_wrong_times_and_lost_histories_never_undo_the_compensation.pytestmark[0].args[1]
    assert [case[0] for case in tested] == list(example["clocks"].CASES)


AXIS_LASER = """\
name = "laser"
seed = 3
[errors]
file = "{errors}"
[instrument]
type = "axis-laser"
axes = ["X"]
targets = 5
cycles = 2
"""


def test_a_laser_along_one_axis_never_replaces_tables_of_all_errors(example, tmp_path):
    plant = example["plant"]
    factory = plant.Factory(tmp_path / "out")
    path = factory.write()
    text = path.read_text().replace("max_change_um = 8.0", "").replace("temperature_c = [18.0, 22.0]", "")
    path.write_text(text.replace("[defaults]", '[defaults]\npatterns = ["*.lengths.csv", "*.axis.csv"]', 1))
    year = example["factory"].Year(factory, read_job(path))
    at = plant.day_of(0)
    factory.measure(year.job, "mill-b", at)
    assert year.run("mill-b").waiting == (1,)
    actions.approve(year.job, "mill-b", 1, "ada", clock=year.clock)
    scenario = factory.folder / "scenarios" / "laser.scenario.toml"
    scenario.write_text(AXIS_LASER.format(errors=f"mill-b-{at:%Y-%m-%d}.errors.csv"))
    readings = format_axis_runs(simulate_axis_runs(factory.machine("mill-b"), read_scenario(scenario)).readings)
    inbox, said = year.job.machine("mill-b").inbox, f"# measured_at = {at + timedelta(hours=1):%Y-%m-%dT%H:%M}+00:00\n"
    (inbox / "compensated.axis.csv").write_text(said + readings)
    year.now = at + timedelta(days=1)
    first = year.run("mill-b")
    assert first.state == "failed" and "measure anything else with the compensation off" in first.messages[0]
    (inbox / "compensated.axis.csv").unlink()
    (inbox / "bare.axis.csv").write_text("# active_table = none\n" + said + readings)
    assert year.run("mill-b").state == "held"
    doubt, reason = year.tables("mill-b")[-1].reasons
    assert doubt.startswith("the machine probably does not get better")  # one error of 17, with a prior for the others
    assert reason.startswith("the measurement does not show EYX, EZX, ") and "EC0Y" in reason
    store = open_store(year.job.store)
    told = drift_of_store(store, store.machine("mill-b"), DriftSettings())
    store.close()
    assert len(told.times) == 1
    assert told.notes[-1] == "1 of 2 calibrations are left out: they contain only a few errors"
