"""Which tables were on while a machine was measured: a wrong assumption undoes the compensation, so it is held back.

Readings are simulated with the exact model: what the machine does with the tables that are really on. The program is told
something else, or left to guess from times.
"""

import os
import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest
from test_recal import CONTROL, NOW, active_correction, deviations_text, drifted, worst_left_um

from compgen.data.error_table import ErrorTable
from compgen.fleet import actions
from compgen.fleet.actions import reprocess
from compgen.fleet.change import volume_points
from compgen.fleet.job import read_job
from compgen.fleet.records import ReprocessRequest
from compgen.fleet.runner import run_jobs
from compgen.fleet.store import open_store
from compgen.kinematics.many_points import volumetric_error

HOUR = timedelta(hours=1)
#: Without tables the machine is off by more, with the right ones by less than this, um.
BARE_UM, RIGHT_UM = 10.0, 1.5


def site_in(folder, small_machine, small_machine_file, small_errors):
    """A machine under ``approval = "auto"`` that is measured with its tables on; its store has a clock that is set."""
    shutil.copy(small_machine_file, folder / "mill.toml")
    inbox = folder / "inbox"
    inbox.mkdir(exist_ok=True)
    made = SimpleNamespace(now=NOW - 10 * timedelta(days=1), folder=folder, out=folder / "out", inbox=inbox)

    def write(policy="", name="mill", approval="auto", measured_with="active"):
        (folder / "recal.toml").write_text(
            f'[machines.{name}]\nmachine = "mill.toml"\ninbox = "inbox"\ncontrollers = ["{CONTROL}"]\nout = "out"\n'
            f'measured_with = "{measured_with}"\napproval = "{approval}"\n[machines.{name}.policy]\n{policy}\n'
        )
        made.job = read_job(folder / "recal.toml")

    def measure(file, errors=small_errors, *, on=None, seed=1, at=None, shown=False, **notes):
        """``on``: the correction that acts (None: the machine is bare); ``at``: what the file says, None: now.

        ``shown``: a backup of the control, which has loaded the active tables, comes with it.
        """
        said = (made.now if at is None else at).isoformat()
        text = deviations_text(small_machine, errors, seed=seed, correction=on, measured_at=said, **notes)
        path = inbox / f"{file}.deviations.csv"
        path.write_text(text)
        if shown:
            shutil.copy(made.out / "active" / "NC_CEC.INI", inbox / f"{file}.backup.NC_CEC.INI")
        return path

    def run():
        return run_jobs(made.job, clock=lambda: made.now).outcomes[0]

    def tables():
        store = open_store(made.job.store)
        try:
            return store.tables()
        finally:
            store.close()

    def on():
        return active_correction(made, small_machine)

    def left_um():
        return worst_left_um(made, small_machine, small_errors)

    for function in (write, measure, run, tables, on, left_um):
        setattr(made, function.__name__, function)
    write()
    return made


@pytest.fixture
def site(tmp_path, small_machine, small_machine_file, small_errors):
    """The machine of :func:`site_in`, which has not been measured yet."""
    return site_in(tmp_path, small_machine, small_machine_file, small_errors)


@pytest.fixture(scope="session")
def site_with_tables(tmp_path_factory, small_machine, small_machine_file, small_errors):
    """Folder of the machine with version 1 active."""
    made = site_in(tmp_path_factory.mktemp("running"), small_machine, small_machine_file, small_errors)
    made.measure("first", active_table="none")
    assert made.run().active == 1
    return made.folder


@pytest.fixture
def running(site_with_tables, tmp_path, small_machine, small_machine_file, small_errors):
    """The machine with version 1 active for nine days."""
    shutil.copytree(site_with_tables, tmp_path, symlinks=True, dirs_exist_ok=True)
    made = site_in(tmp_path, small_machine, small_machine_file, small_errors)
    made.now += timedelta(days=9)
    assert made.left_um() < RIGHT_UM
    return made


def held(site, version=2):
    """The reasons why the newest version is held back; the active tables stay."""
    outcome = site.run()
    assert (outcome.state, outcome.active) == ("held", 1), outcome.messages
    assert site.tables()[-1].version == version
    assert site.left_um() < RIGHT_UM
    return " | ".join(site.tables()[-1].reasons)


# --- what the data say ---------------------------------------------------------------------------------------------


def test_readings_of_the_compensated_machine_that_count_as_bare_are_held_by_what_they_look_like(running):
    running.write(policy="clock_minutes = 0")
    running.measure("wrong", on=running.on(), seed=2, active_table="none")
    reasons = held(running)
    assert "seems to have changed by what version 1 adds (correlation +1.000, size 1.00; a random" in reasons
    assert "probability below 1e-09" in reasons
    assert "recal reprocess mill --measurement 2 --active-table v1 --reason" in reasons


def test_readings_of_the_bare_machine_from_which_tables_are_taken_out_are_held(running):
    running.measure("wrong", seed=2, active_table="v1")
    reasons = held(running)
    assert "the opposite of what version 1 adds (correlation -1.000, size 1.00" in reasons
    assert "as if version 1 was off" in reasons and "--active-table none" in reasons


@pytest.mark.parametrize(("on", "said"), [(True, "none"), (False, "v1")])
def test_a_drift_on_top_does_not_hide_which_tables_were_on(running, small_machine, small_errors, on, said):
    """The machine drifts by a third of what version 1 takes out, in another shape, and the wrong tables are stated."""
    running.write(policy="clock_minutes = 0")
    signs = dict(zip(small_errors.names, (1, -1) * 12, strict=False))
    curves = {
        name: replace(curve, value=curve.value + signs[name] * (curve.value[::-1] - curve.value[::-1][-1]) / 3.0)
        for name, curve in small_errors.curves.items()
    }
    moved = ErrorTable(curves, small_errors.squareness)
    position = volume_points(small_machine)
    before, after = (volumetric_error(small_machine, item, position) for item in (small_errors, moved))
    assert 0.25 < np.linalg.norm(after - before) / np.linalg.norm(before) < 0.4
    running.measure("wrong", moved, on=running.on() if on else None, seed=2, active_table=said)
    reasons = held(running)
    assert "adds (correlation" in reasons


def test_a_machine_that_really_changed_is_not_held_for_it(running, small_errors):
    running.measure("drift", drifted(small_errors, 40.0), on=running.on(), seed=2, shown=True)
    outcome = running.run()
    assert (outcome.state, outcome.active) == ("ok", 2)
    assert "likeness" not in running.tables()[-1].summary


def test_an_earlier_version_that_was_still_on_is_held(running, small_errors):
    old = running.on()
    moved = drifted(small_errors, 40.0)
    running.measure("drift", moved, on=old, seed=2, shown=True)
    assert running.run().active == 2
    running.now += timedelta(days=3)
    running.measure("bare", moved, on=old, seed=3, active_table="none")  # nobody loaded version 2; 1 was on, not none
    outcome = running.run()
    assert (outcome.state, outcome.active) == ("held", 2)
    assert "by what version 1 adds" in " ".join(running.tables()[-1].reasons)


def test_readings_with_the_new_tables_by_a_clock_that_is_a_day_late_are_held(running, small_errors):
    moved = drifted(small_errors, 40.0)
    running.measure("drift", moved, on=running.on(), seed=2, shown=True)
    assert running.run().active == 2
    running.now += timedelta(days=1)
    running.measure("late", moved, on=running.on(), seed=3, at=running.now - timedelta(days=1, hours=2))
    outcome = running.run()
    assert (outcome.state, outcome.active) == ("held", 2)
    assert "by what version 2 instead of version 1 adds" in " ".join(running.tables()[-1].reasons)


def test_after_a_rollback_to_none_the_tables_that_are_still_on_are_found(running):
    still = running.on()
    actions.rollback(running.job, "mill", "ada", "spindle changed", to=0, clock=lambda: running.now)
    running.now += timedelta(days=1)
    running.measure("after", on=still, seed=2)
    outcome = running.run()
    assert (outcome.state, outcome.active) == ("held", None)
    assert "by what version 1 adds" in " ".join(running.tables()[-1].reasons)


# --- what the time says --------------------------------------------------------------------------------------------


def test_an_instrument_whose_clock_is_ten_minutes_behind(site):
    site.measure("first", active_table="none")
    assert site.run().active == 1
    site.now += timedelta(minutes=5)
    site.measure("check", on=site.on(), seed=2, at=site.now - timedelta(minutes=10))
    reasons = held(site)
    assert "5 min from the decision of" in reasons and "30 min are required" in reasons
    assert "by what version 1 adds" in reasons


@pytest.mark.parametrize(("after", "away"), [(20, 40), (85, 25), (140, 80)])
def test_an_instrument_whose_clock_missed_daylight_saving_time(site, after, away):
    """An hour behind, whatever the clocks differ by otherwise: a time up to 30 min and an hour from a decision says nothing."""
    site.measure("first", active_table="none")
    assert site.run().active == 1
    site.now += timedelta(minutes=after)
    site.measure("check", on=site.on(), seed=2, at=site.now - timedelta(minutes=60))
    reasons = held(site)
    assert f"{away} min from the decision of" in reasons
    assert ("30 min and an hour are required" in reasons) == (away > 30)


def test_the_margin_can_be_chosen(running, small_errors):
    running.write(policy="clock_minutes = 20000")
    running.measure("drift", drifted(small_errors, 40.0), on=running.on(), seed=2)
    assert "20000 min are required" in held(running)


def test_a_time_without_zone(running, small_errors):
    at = running.now.replace(tzinfo=None)
    running.measure("drift", drifted(small_errors, 40.0), on=running.on(), seed=2, at=at)
    assert "the time of the measurement has no zone" in held(running)


def test_a_file_time_after_a_copy(running):
    """Measured bare before version 1 became active, copied later: it seems to be measured with version 1 on."""
    path = running.measure("stick", seed=2)
    path.write_text("".join(line for line in path.read_text().splitlines(True) if "measured_at" not in line))
    os.utime(path, (running.now.timestamp(),) * 2)
    reasons = held(running)
    assert "the time of a file changes when it is copied" in reasons
    assert "the opposite of what version 1 adds" in reasons


@pytest.mark.parametrize("ran", [timedelta(days=1), timedelta(days=40)])
def test_an_approval_while_the_clock_of_the_server_ran_ahead(site, small_errors, ran):
    site.write(approval="manual")
    site.measure("first", active_table="none")
    site.run()
    true = site.now
    actions.approve(site.job, "mill", 1, "ada", clock=lambda: true + ran)
    site.now = true + 6 * HOUR
    site.write(approval="auto", policy="clock_minutes = 0")
    site.measure("check", drifted(small_errors, 40.0), on=site.on(), seed=2)
    outcome = site.run()
    assert (outcome.state, outcome.active) == ("held", 1)
    reasons = " ".join(site.tables()[-1].reasons)
    assert "the clock went back, so the time of the decision" in reasons


def test_a_clock_that_went_back_is_remembered(site, small_errors):
    """The measurement is processed when the right clock has passed the wrong time of the approval."""
    site.write(approval="manual")
    site.measure("first", active_table="none")
    site.run()
    true = site.now
    actions.approve(site.job, "mill", 1, "ada", clock=lambda: true + timedelta(days=1))
    site.now = true + 2 * HOUR
    site.run()  # sees that the clock went back
    measured = true + 6 * HOUR
    site.now = true + timedelta(days=3)
    site.measure("check", drifted(small_errors, 40.0), on=site.on(), seed=2, at=measured)
    assert "the clock went back" in held(site)


def test_times_far_from_any_decision_with_a_zone_are_trusted(running, small_errors):
    at = running.now - 2 * HOUR
    running.measure("drift", drifted(small_errors, 10.0), on=running.on(), seed=2, at=at)  # as much as drift explains
    assert running.run().state == "ok"
    running.measure("jump", drifted(small_errors, 60.0), on=running.on(), seed=3, at=running.now + 5 * HOUR)
    running.now += 6 * HOUR
    assert running.run().state == "held"


# --- machines without history --------------------------------------------------------------------------------------


def test_a_machine_without_history_has_to_say_once_that_no_tables_were_on(site, small_errors):
    site.measure("first")
    outcome = site.run()
    assert (outcome.state, outcome.active) == ("held", None)
    (reason,) = site.tables()[0].reasons
    assert "does not know which tables were on" in reason and "active_table = none" in reason
    site.now += HOUR
    site.measure("second", seed=2, active_table="none")
    assert site.run().active == 2


def test_it_has_to_say_so_only_once(site):
    site.write(approval="manual")
    site.measure("first", active_table="none")
    assert site.run().state == "ok"
    site.now += HOUR
    site.measure("second", seed=2)
    assert site.run().state == "ok"
    assert [table.state for table in site.tables()] == ["superseded", "pending"]


def test_what_was_said_of_tables_that_the_store_does_not_know_is_no_statement_that_none_were_on(site):
    site.measure("first", active_table="v1")  # of a store that was lost
    assert site.run().state == "failed"
    site.now += HOUR
    site.measure("second", seed=2)
    outcome = site.run()
    assert outcome.active is None
    assert "does not know which tables were on" in " ".join(site.tables()[0].reasons)


def test_the_last_statement_counts(site):
    site.write(approval="manual")
    site.measure("first", active_table="none")
    assert site.run().state == "ok"
    site.now += HOUR
    site.measure("second", seed=2, active_table="v1")  # loaded, though nobody approved it
    site.run()
    site.now += HOUR
    site.measure("third", seed=3)
    assert site.run().state == "held"
    assert "does not know which tables were on" in " ".join(site.tables()[-1].reasons)


def test_a_machine_whose_tables_are_off_when_it_is_measured_says_nothing(site):
    site.write(measured_with="bare")
    site.measure("first", at=site.now.replace(tzinfo=None))
    assert site.run().active == 1


# --- what a person does --------------------------------------------------------------------------------------------


def test_a_person_states_which_tables_were_on(running, small_errors):
    moved = drifted(small_errors, 40.0)
    at = running.now.replace(tzinfo=None)
    running.measure("drift", moved, on=running.on(), seed=2, at=at)
    held(running)
    wish = ReprocessRequest(None, "ada", "the log of the control says so", "v1")
    running.now += HOUR
    done = reprocess(running.job, "mill", wish, clock=lambda: running.now)
    assert (done.table.state, done.revision) == ("active", 2)
    store = open_store(running.job.store)
    identified = {item.revision: item for item in store.identifications() if item.measurement_id == 2}
    value = store.errors_of(identified[2]).squareness["EC0Y"][0]
    assert value == pytest.approx(moved.squareness["EC0Y"][0], abs=2e-6)
    said = [item.reason for item in store.decisions() if item.kind == "propose"][-1]
    assert "with active_table = v1: the log of the control says so" in said
    store.close()


def test_what_a_person_states_is_compared_with_the_data_too(running):
    running.measure("check", on=running.on(), seed=2)
    running.run()
    running.now += HOUR
    done = reprocess(
        running.job, "mill", ReprocessRequest(None, "ada", "I think so", "none"), clock=lambda: running.now
    )
    assert done.table.state in ("held", "refused")  # nothing is left for tables to correct
    assert "by what version 1 adds" in " ".join(done.table.reasons)


@pytest.mark.parametrize(
    ("said", "message"), [("v9", "no such tables"), ("nonsense", "not a version of the tables; give one")]
)
def test_tables_that_do_not_exist_cannot_be_stated(running, said, message):
    running.measure("check", on=running.on(), seed=2)
    running.run()
    with pytest.raises(Exception, match=message) as caught:
        reprocess(running.job, "mill", ReprocessRequest(None, "ada", "why", said), clock=lambda: running.now)
    assert caught.value.exit_code == 2


def test_the_time_of_a_measurement_is_kept_with_what_it_came_from():
    from compgen.fleet.inbox import measurement_of

    file_time = datetime(2026, 3, 1, tzinfo=NOW.tzinfo)
    texts = {
        "# measured_at = 2026-03-01T06:30:00+01:00\n": "file",
        "# measured_at = 2026-03-01T06:30:00Z\n": "file",
        "# measured_at = 2026-03-01T06:30:00\n": "file, no zone",
        "# date = 2026-03-01\n": "file, no zone",
        "# measured_at = soon\n": "file time",
    }
    found = {text: measurement_of("a", {"a": text.encode()}, file_time).measured_at_source for text in texts}
    assert found == texts
