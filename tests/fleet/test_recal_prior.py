"""Results with and without a prior in one store: marked, and their uncertainties are not compared."""

from datetime import timedelta

import pytest
from test_recal import drifted
from test_recal_active import site_in

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.fleet import actions
from compgen.fleet.dashboard.charts import ErrorCache, find_table, proposal
from compgen.fleet.drift import DriftSettings, drift_of_store
from compgen.fleet.records import comparable
from compgen.fleet.status import fleet, status
from compgen.fleet.store import open_store

PRIOR = {"class": "general"}
ALL = ["EXX", "EC0Y"]


@pytest.mark.parametrize(
    ("first", "second", "alike"),
    [
        ({}, {}, True),
        ({}, {"prior": {"class": "none"}}, True),
        ({"prior": PRIOR}, {"prior": {"class": "precision"}}, True),
        ({"prior": PRIOR, "identified": ALL, "determined": ["EC0Y"]}, {"identified": ALL}, False),
        ({"prior": PRIOR, "identified": ALL, "determined": ALL}, {"identified": [*ALL, "EYY"]}, True),
        ({"prior": PRIOR, "identified": ALL, "determined": ALL}, {"identified": ["EC0Y"]}, False),
        ({"prior": PRIOR}, {}, False),
    ],
)
def test_which_uncertainties_may_be_compared(first, second, alike):
    assert comparable(first, second) == comparable(second, first) == alike


@pytest.fixture(params=[True, False], ids=["one height", "whole volume"])
def both(request, tmp_path, small_machine, small_machine_file, small_errors):
    """A machine measured without prior, then with one: at one height of Z, where angles stay open, or everywhere."""
    site = site_in(tmp_path, small_machine, small_machine_file, small_errors)
    file = tmp_path / "mill.toml"
    whole = file.read_text()
    top = small_machine.axes[2].range_mm[1]

    def measure(name, **options):
        path = site.measure(name, active_table="none", **options)
        if request.param:
            lines = path.read_text().splitlines()
            head = next(k for k, line in enumerate(lines) if line.startswith("x_mm,"))
            kept = [line for line in lines[head + 1 :] if float(line.split(",")[2]) == top]
            notes = [line for line in lines[:head] if "rows" not in line]
            path.write_text("\n".join([*notes, lines[head], *kept]) + "\n")

    file.write_text(whole + '\n[prior]\nclass = "none"\n')
    site.write(approval="manual")
    measure("first")
    site.run()
    actions.approve(site.job, "mill", 1, "ada", "fine", override=True, clock=lambda: site.now)
    file.write_text(whole)
    site.now += timedelta(days=9)
    measure("second", errors=drifted(small_errors, 40.0), seed=2)
    site.run()
    site.partial = request.param
    return site


def test_the_change_is_judged_only_if_the_uncertainties_are_alike(both):
    said = " ".join(both.tables()[-1].reasons)
    assert ("version 1 were identified without a prior, and these with one" in said) == both.partial, said
    assert ("change" in both.tables()[-1].summary) != both.partial


def test_a_measurement_that_shows_more_errors_than_those_before_is_judged(
    tmp_path, small_machine, small_machine_file, small_errors
):
    """Nothing in the history shows as many errors, so the two fields are compared as they are."""
    site = site_in(tmp_path, small_machine, small_machine_file, small_errors)
    file = tmp_path / "mill.toml"
    whole = file.read_text()
    file.write_text('errors = ["EXX", "EYY", "EZZ", "EC0Y", "EB0Z", "EA0Z"]\n' + whole)
    site.write(approval="manual")
    site.measure("first", active_table="none")
    site.run()
    actions.approve(site.job, "mill", 1, "ada", "better than none", override=True, clock=lambda: site.now)
    file.write_text(whole)
    site.now += timedelta(days=9)
    site.measure("second", seed=2, active_table="none")
    site.run()
    change = site.tables()[-1].summary["change"]
    assert change["significant"] and change["rms_um"] > 1.0


def test_results_without_prior_are_marked_and_no_uncertainty_of_the_two_is_shown(both, capsys):
    store = open_store(both.job.store)
    assert [row.without_prior for row in fleet(store).rows] == [True]
    assert [item.without_prior for item in status(store, both.job)] == [True]
    mill = store.machine("mill")
    shown = proposal(store, ErrorCache(store), mill, find_table(store, mill, 2))
    assert not shown.without_prior and store.without_prior(mill) == {1}
    assert {item.expanded is None for item in shown.squareness if item.before is not None} == {both.partial}
    assert not both.partial or not any(item.significant for item in shown.squareness)
    drift = drift_of_store(store, mill, DriftSettings())
    assert len(drift.times) == (1 if both.partial else 2)
    assert any("identified without prior, the newest with one" in note for note in drift.notes) == both.partial
    store.close()
    run_command(cli, ["recal", "status", "--job", str(both.folder / "recal.toml")])
    assert "1 (without prior)" in " ".join(capsys.readouterr().out.split())


def test_the_earlier_measurement_identified_again_makes_them_alike(both):
    wish = actions.ReprocessRequest("1", "ada", "with the prior")
    done = actions.reprocess(both.job, "mill", wish, clock=lambda: both.now)
    actions.approve(both.job, "mill", done.table.version, "ada", "the same", override=True, clock=lambda: both.now)
    store = open_store(both.job.store)
    assert [row.without_prior for row in fleet(store).rows] == [False]
    assert len(drift_of_store(store, store.machine("mill"), DriftSettings()).times) == 2
    store.close()
