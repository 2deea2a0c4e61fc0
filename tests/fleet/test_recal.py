"""Scheduled recalibration: what is proposed, held back, refused; approval, rollback; failures; notifications."""

import errno
import json
import os
import shutil
import sys
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest

import compgen
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.lengths import Points
from compgen.fleet import actions, decisions, inbox, publish, runner
from compgen.fleet import status as overview
from compgen.fleet.inbox import measurement_of
from compgen.fleet.job import Policy, read_job
from compgen.fleet.process import Judgement, judge_measurement
from compgen.fleet.runner import run_jobs
from compgen.fleet.status import fleet
from compgen.fleet.store import Store, open_store
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import volume_grid
from compgen.tables import read_tables

NOISE_UM = 0.3
#: What identification noise and second-order terms leave of the error anywhere, um.
LEFT_UM = 1.0
CONTROL = "siemens-cec"
NOW = datetime.now(UTC)


def deviations_text(machine, errors, *, seed, correction=None, temperature_c=None, **metadata):
    """Deviations of the exact machine under a correction (function of positions (n, 3), mm), with noise, as a file."""
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    added = np.zeros_like(position) if correction is None else correction(position)
    truth = added + exact_error(machine, errors, position + added)
    noise = np.random.default_rng(seed).normal(0.0, NOISE_UM * 1e-3, truth.shape)
    notes = {"u_deviation_um": str(NOISE_UM), **metadata}
    covariates = {} if temperature_c is None else {"temp_ambient_c": np.linspace(*temperature_c, len(position))}
    u_mm = np.full_like(truth, NOISE_UM * 1e-3)
    return format_deviations(Deviations(position, truth + noise, u_mm=u_mm, covariates=covariates, metadata=notes))


def drifted(errors, urad):
    """The errors with EC0Y changed by so many urad."""
    value, u = errors.squareness["EC0Y"]
    return errors.replace(squareness={**errors.squareness, "EC0Y": (value + urad * 1e-6, u)})


def time_of(hours):
    return (NOW + timedelta(hours=hours)).isoformat()


def plant_in(folder, machine, errors):
    """One machine with its inbox in ``folder``: functions to write the job, to measure, to run, to approve."""
    inbox = folder / "inbox"
    inbox.mkdir(exist_ok=True)

    def write(text="", policy="", measured_with="bare", more=""):
        (folder / "recal.toml").write_text(
            f'[machines.mill]\nmachine = "mill.toml"\ninbox = "inbox"\ncontrollers = ["{CONTROL}"]\nout = "out"\n'
            f'measured_with = "{measured_with}"\n{text}\n[machines.mill.policy]\n{policy}\n{more}'
        )
        return job()

    def measure(name, errors=errors, *, hours=0.0, seed=1, **options):
        text = deviations_text(machine, errors, seed=seed, measured_at=time_of(hours), **options)
        (inbox / f"{name}.deviations.csv").write_text(text)

    def states():
        return [table.state for table in open_store(job().store).tables()]

    def job():
        return read_job(folder / "recal.toml")

    def run():
        return run_jobs(job())

    def approve(version=None):
        """Approve a version; None: the only one that waits."""
        if version is None:
            store = open_store(job().store)
            version = decisions.only_pending(store, store.machine("mill")).version
            store.close()
        return actions.approve(job(), "mill", version, "ada")

    return SimpleNamespace(
        folder=folder,
        inbox=inbox,
        out=folder / "out",
        write=write,
        measure=measure,
        states=states,
        job=job,
        run=run,
        approve=approve,
    )


@pytest.fixture
def plant(tmp_path, small_machine, small_machine_file, small_errors):
    """A machine that was never measured."""
    shutil.copy(small_machine_file, tmp_path / "mill.toml")
    made = plant_in(tmp_path, small_machine, small_errors)
    made.write()
    return made


@pytest.fixture(scope="session")
def running(tmp_path_factory, small_machine, small_machine_file, small_errors):
    """The folder of a machine with one measurement, two hours old, whose tables were approved."""
    folder = tmp_path_factory.mktemp("running")
    shutil.copy(small_machine_file, folder / "mill.toml")
    made = plant_in(folder, small_machine, small_errors)
    made.write()
    made.measure("a", hours=-2)
    assert made.run().exit_code == 0
    made.approve()
    return folder


@pytest.fixture
def approved(running, tmp_path, small_machine, small_errors):
    """A copy of that machine, at which nothing is new."""
    shutil.copytree(running, tmp_path / "plant", symlinks=True)
    return plant_in(tmp_path / "plant", small_machine, small_errors)


def active_correction(plant, machine):
    """What the files behind the pointer add to commanded positions, mm."""
    tables = read_tables(machine, [plant.out / "active" / "NC_CEC.INI"], CONTROL)
    return lambda position: tables.correction(machine, Points(position, approach=np.ones_like(position)))


def worst_left_um(plant, machine, errors):
    """Largest error of the tool tip with the active files, rigid motion taken out, by the exact model."""
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    added = active_correction(plant, machine)(position)
    left = compgen.without_rigid_motion(position, added + exact_error(machine, errors, position + added))
    return 1e3 * np.max(np.linalg.norm(left, axis=1))


def test_a_first_measurement_is_proposed_and_approved_by_a_person(plant, small_machine, small_errors):
    plant.measure("a")
    outcome = plant.run()
    assert (outcome.exit_code, outcome.outcomes[0].waiting) == (0, (1,))
    assert not (plant.out / "active").exists()
    assert (plant.out / "proposed" / "v0001" / "NC_CEC.INI").is_file()
    plant.approve()
    assert os.readlink(plant.out / "active") == "v0001"
    assert not list((plant.out / "proposed").iterdir())
    assert worst_left_um(plant, small_machine, small_errors) < LEFT_UM


def test_the_files_are_those_of_compgen_run_byte_for_byte(plant):
    plant.measure("a")
    plant.run()
    machine = compgen.load_machine(plant.folder / "mill.toml")
    with one_thread():  # other numbers of threads round differently
        compgen.run(machine, [plant.inbox / "a.deviations.csv"], [CONTROL], plant.folder / "direct")
    for name in ("NC_CEC.INI", "preflight.md", "manifest.json", "result.json"):
        assert (plant.out / "proposed/v0001" / name).read_bytes() == (plant.folder / "direct" / name).read_bytes()


def test_the_same_inbox_gives_the_same_state_and_the_same_exit_code(plant, listing):
    plant.measure("a")
    plant.measure("b", seed=2, hours=1)
    first = plant.run()
    plant.approve(2)
    store = open_store(plant.job().store)
    counts = {
        name: len(getattr(store, name)()) for name in ("measurements", "attempts", "tables", "decisions", "events")
    }
    files = listing(plant.out)
    (plant.inbox / "a.deviations.csv").rename(plant.inbox / "copy.deviations.csv")
    second, third = plant.run(), plant.run()
    assert second.outcomes[0].processed == () == third.outcomes[0].processed
    assert second.exit_code == third.exit_code
    assert first.outcomes[0].processed == ("a.deviations.csv", "b.deviations.csv")
    assert counts == {name: len(getattr(store, name)()) for name in counts}
    assert listing(plant.out) == files


def test_no_change_beyond_its_uncertainty_is_held_back(approved):
    approved.measure("b", seed=2, hours=-1)
    outcome = approved.run()
    assert outcome.exit_code == 1
    assert approved.states() == ["active", "held"]
    assert "within its uncertainty" in outcome.outcomes[0].messages[0]
    assert (approved.out / "proposed" / "HELD-v0002").is_dir()
    with pytest.raises(decisions.DecisionError, match="held back"):
        approved.approve(2)


def test_a_drift_is_proposed_and_the_new_tables_take_it_out(approved, small_machine, small_errors):
    moved = drifted(small_errors, 40.0)
    before = worst_left_um(approved, small_machine, moved)
    approved.measure("b", moved, seed=2, hours=-1)
    assert approved.run().exit_code == 0
    approved.approve()
    assert approved.states() == ["retired", "active"]
    # X moves by 40 urad y; a rotation takes w out, so that (40 - w) y is left in X and w x in Y (least squares)
    w = 40.0 * 400.0**2 / (400.0**2 + 500.0**2)
    assert before == pytest.approx(1e-3 * np.hypot((40.0 - w) * 200.0, w * 250.0), abs=LEFT_UM)
    assert worst_left_um(approved, small_machine, moved) < LEFT_UM
    change = open_store(approved.job().store).tables()[1].summary["change"]
    along = {half: np.mean(np.linspace(-half, half, 6) ** 2) for half in (200.0, 250.0)}
    expected = 1e-3 * np.sqrt((40.0 - w) ** 2 * along[200.0] + w**2 * along[250.0])
    assert change["rms_um"] == pytest.approx(expected, abs=0.2)
    assert change["significant"]


def test_rollback_restores_the_bytes_and_the_reason_is_kept(approved, small_errors, listing):
    first = listing(approved.out / "active")
    approved.measure("b", drifted(small_errors, 12.0), seed=2, hours=-1)
    approved.run()
    approved.approve()
    assert listing(approved.out / "active") != first
    (approved.out / "v0001" / "NC_CEC.INI").write_text("spoilt")
    decision = actions.rollback(approved.job(), "mill", "bob", "scrap since Monday")
    assert listing(approved.out / "active") == first
    assert (decision.kind, decision.actor, decision.reason) == ("rollback", "bob", "scrap since Monday")
    actions.rollback(approved.job(), "mill", "bob", "back", to=2)
    assert os.readlink(approved.out / "active") == "v0002"
    actions.rollback(approved.job(), "mill", "bob", "none", to=0)
    assert not (approved.out / "active").exists()


def test_a_measurement_with_the_active_tables_gives_the_errors_of_the_bare_machine(
    approved, small_machine, small_errors
):
    approved.write(measured_with="active", text='approval = "auto"')
    moved = drifted(small_errors, 12.0)
    # approved a moment ago, so this measurement is made afterwards, whatever its clock
    approved.measure("b", moved, seed=2, hours=2, correction=active_correction(approved, small_machine))
    assert approved.run().exit_code == 0
    assert os.readlink(approved.out / "active") == "v0002"
    assert worst_left_um(approved, small_machine, moved) < LEFT_UM
    store = open_store(approved.job().store)
    first, second = store.identifications()
    assert (first.active_table_id, second.active_table_id) == (None, 1)
    value, u = store.errors_of(second).squareness["EC0Y"]
    other, u_other = store.errors_of(first).squareness["EC0Y"]
    assert abs((value - other) * 1e6 - 12.0) < 4.0 * np.hypot(u, u_other) * 1e6


def test_the_tables_that_were_active_when_it_was_measured_count_not_those_of_now(approved, small_machine, small_errors):
    approved.write(measured_with="active", text='approval = "auto"')
    approved.measure("early", drifted(small_errors, 12.0), seed=2, hours=-2)  # before a table was active
    assert approved.run().exit_code == 0
    assert open_store(approved.job().store).identifications()[1].active_table_id is None
    assert worst_left_um(approved, small_machine, drifted(small_errors, 12.0)) < LEFT_UM


def test_the_file_itself_may_say_which_tables_were_active(approved, small_machine, small_errors):
    approved.write(text='approval = "auto"')
    moved = drifted(small_errors, -15.0)
    correction = active_correction(approved, small_machine)
    approved.measure("b", moved, seed=2, hours=-1, correction=correction, active_table="v1")
    approved.measure("c", moved, seed=3, hours=0, correction=correction, active_table="v9")
    outcome = approved.run()
    assert worst_left_um(approved, small_machine, moved) < LEFT_UM
    assert any("c.deviations.csv" in text and "no such tables" in text for text in outcome.outcomes[0].messages)


@pytest.mark.parametrize(
    ("policy", "hours", "temperature_c", "said"),
    [
        (Policy(max_age_days=2.0), -49, None, "2.0 days old"),
        (Policy(max_age_days=2.0), -47, None, None),
        (Policy(), 30, None, "is in the future"),
        (Policy(), 20, None, None),
        (Policy(temperature_c=(19.0, 21.0)), 0, None, "no temperature was logged"),
        (Policy(temperature_c=(19.0, 21.0)), 0, (19.5, 21.3), "from 19.50 to 21.30 degC"),
        (Policy(temperature_c=(19.0, 21.0)), 0, (18.9, 20.0), "from 18.90 to 20.00 degC"),
        (Policy(temperature_c=(19.0, 21.0)), 0, (19.5, 20.9), None),
    ],
)
def test_the_policy_of_age_and_temperature(small_machine, small_errors, policy, hours, temperature_c, said):
    options = {} if temperature_c is None else {"temperature_c": temperature_c}
    text = deviations_text(small_machine, small_errors, seed=1, measured_at=time_of(hours), **options)
    new = measurement_of("a", {"a": text.encode()}, NOW)
    judgement = Judgement()
    judge_measurement(judgement, policy, new, NOW, None)
    assert [said is not None and said in reason for reason in judgement.hold] == ([] if said is None else [True])


@pytest.mark.parametrize(("limit", "state"), [(1.0, "held"), (60.0, "pending")])
def test_the_correction_at_the_reference_point_is_limited_for_the_first_tables_too(plant, limit, state):
    plant.write(policy=f"max_reference_um = {limit}")
    plant.measure("a")
    plant.run()
    assert plant.states() == [state]


@pytest.mark.parametrize(("limit", "state"), [(2.0, "held"), (20.0, "pending")])
def test_the_limit_of_the_change_counts_against_the_active_tables(approved, small_errors, limit, state):
    approved.write(policy=f"max_change_um = {limit}")
    approved.measure("b", drifted(small_errors, 12.0), seed=2, hours=-1)
    approved.run()
    assert approved.states() == ["active", state]


def test_a_measurement_older_than_that_of_the_active_tables_is_held_back(approved, small_errors):
    approved.measure("late", drifted(small_errors, 12.0), seed=2, hours=-5)
    assert "newer measurement" in approved.run().outcomes[0].messages[0]


def test_a_newer_proposal_takes_the_place_of_one_that_waits(plant, small_errors):
    plant.measure("a", hours=-2)
    plant.run()
    plant.measure("b", drifted(small_errors, 12.0), seed=2, hours=-1)
    plant.run()
    assert plant.states() == ["superseded", "pending"]
    assert [path.name for path in (plant.out / "proposed").iterdir()] == ["v0002"]


def test_an_older_measurement_that_comes_late_does_not_take_the_place_of_a_newer_proposal(plant, small_errors):
    plant.measure("b", drifted(small_errors, 12.0), seed=2, hours=-1)
    plant.run()
    plant.measure("a", hours=-2)
    outcome = plant.run()
    assert plant.states() == ["pending", "held"]
    assert "version 1 waits for approval and comes from a newer measurement" in outcome.outcomes[0].messages[0]


def test_tables_that_the_round_trip_refuses_can_never_be_approved(plant):
    plant.write(policy="max_step_um = 0.5")
    plant.measure("a")
    assert plant.run().exit_code == 1
    assert plant.states() == ["refused"]
    assert (plant.out / "proposed/NOT-ACCEPTED-v0001/NOT-ACCEPTED-NC_CEC.INI").is_file()
    with pytest.raises(decisions.DecisionError, match="not accepted"):
        actions.approve(plant.job(), "mill", 1, "ada", "I want it", override=True)


def test_a_held_version_needs_an_override_with_a_reason(plant):
    plant.write(policy="max_reference_um = 1")
    plant.measure("a")
    plant.run()
    with pytest.raises(decisions.DecisionError, match="reason"):
        actions.approve(plant.job(), "mill", 1, "ada", " ", override=True)
    actions.approve(plant.job(), "mill", 1, "ada", "new ball screw", override=True)
    assert os.readlink(plant.out / "active") == "v0001"


def test_a_failing_machine_does_not_stop_the_others_and_a_bad_file_is_not_tried_twice(plant, small_machine_file):
    other = '[machines.lost]\nmachine = "nowhere.toml"\ninbox = "inbox2"\ncontrollers = ["neutral"]\nout = "out2"\n'
    plant.write(more=other + 'measured_with = "bare"\n')
    plant.measure("a")
    (plant.inbox / "bad.deviations.csv").write_text("x_mm,y_mm,z_mm,dx_um\n0,0,nan,1\n")
    outcome = plant.run()
    mill, lost = outcome.outcomes
    assert (mill.state, lost.state, outcome.exit_code) == ("failed", "failed", 1)
    assert mill.processed == ("a.deviations.csv",)
    assert any("bad.deviations.csv" in text and "finite" in text for text in mill.messages)
    plant.run()
    store = open_store(plant.job().store)
    assert [attempt.outcome for attempt in store.attempts()].count("failed") == 1
    plant.write(policy="confidence = 0.9")  # other settings: tried once more
    plant.run()
    assert [attempt.outcome for attempt in store.attempts()].count("failed") == 2


def test_what_cannot_be_read_is_reported_once_and_taken_when_it_can(plant):
    (plant.inbox / "a.deviations.csv").write_bytes(b"0" * 2_000_000)
    plant.write("max_size_mb = 1.5")
    first, second = plant.run(), plant.run()
    assert first.exit_code == second.exit_code == 1
    assert "is too large: 2 MB, but only 1.5 MB are left" in first.outcomes[0].messages[0]
    assert len(open_store(plant.job().store).events()) == 1
    plant.measure("a")
    assert plant.run().outcomes[0].processed == ("a.deviations.csv",)


def test_a_full_disk_is_no_verdict_about_the_measurement(plant, monkeypatch):
    plant.measure("a")
    real = runner.process

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(runner, "process", full)
    assert plant.run().exit_code == 1
    assert open_store(plant.job().store).attempts() == []
    monkeypatch.setattr(runner, "process", real)
    monkeypatch.setattr(publish, "_make", full)
    outcome = plant.run()
    assert "cannot be written: No space left" in outcome.outcomes[0].messages[-1]
    monkeypatch.undo()
    assert plant.run().exit_code == 0
    assert plant.states() == ["pending"]
    assert (plant.out / "proposed/v0001/NC_CEC.INI").is_file()


def test_a_clock_that_goes_backwards_is_reported_and_the_order_stays(plant, small_errors, monkeypatch):
    plant.measure("a", hours=-40)
    plant.run()
    decided = plant.approve()
    monkeypatch.setattr(Store, "now", lambda *_: NOW - timedelta(hours=30))
    plant.measure("b", drifted(small_errors, 12.0), seed=2, hours=-35)
    outcome = plant.run()
    assert outcome.exit_code == 0
    assert any("clock went backwards" in text for text in outcome.outcomes[0].messages)
    later = open_store(plant.job().store).decisions()[-1]
    assert later.sequence > decided.sequence
    assert later.at >= decided.at


def test_other_tables_that_became_active_meanwhile_make_the_judgement_start_again(plant, small_errors, monkeypatch):
    plant.measure("a", hours=-2)
    plant.run()
    plant.measure("b", drifted(small_errors, 12.0), seed=2, hours=-1)
    real, calls = runner.process, []

    def slow(*parts):
        calls.append(real(*parts))
        if len(calls) == 1:
            plant.approve(1)
        return calls[-1]

    monkeypatch.setattr(runner, "process", slow)
    plant.run()
    assert [call.judged_against for call in calls] == [None, 1]
    assert plant.states() == ["active", "pending"]
    assert "change" in open_store(plant.job().store).tables()[1].summary


def test_every_decision_and_failure_is_told_once(plant):
    script = "import sys, pathlib; pathlib.Path(sys.argv[1]).open('a').write(sys.stdin.read())"
    told = plant.folder / "told.jsonl"
    words = json.dumps([sys.executable, "-c", script, str(told)])
    plant.write(text=f"notify = {words}")
    plant.measure("a")
    (plant.inbox / "bad.deviations.csv").write_text("x_mm\n")
    plant.run()
    plant.approve()
    plant.run()
    messages = [json.loads(line) for line in told.read_text().splitlines()]
    assert sorted(message["event"] for message in messages) == ["approve", "failed", "propose"]
    assert next(m for m in messages if m["event"] == "approve")["actor"] == "ada"


def test_a_notification_that_fails_is_reported_and_sent_by_the_next_run(plant):
    plant.write(text='notify = ["false"]')
    plant.measure("a")
    outcome = plant.run()
    assert outcome.exit_code == 0
    assert "false ended with 1" in outcome.outcomes[0].messages[0]
    plant.write(text=f'notify = ["tee", "{plant.folder}/told"]')
    plant.run()
    assert json.loads((plant.folder / "told").read_text())["event"] == "propose"


def test_a_folder_in_the_inbox_is_one_measurement(plant, small_machine, small_errors):
    text = deviations_text(small_machine, small_errors, seed=1).splitlines(keepends=True)
    head = [k for k, line in enumerate(text) if line.startswith("x_mm")][0] + 1
    middle = head + (len(text) - head) // 2
    both = plant.inbox / "monday"
    both.mkdir()
    notes = [line for line in text[:head] if "rows" not in line]
    (both / "1.deviations.csv").write_text("".join([*notes, *text[head:middle]]))
    (both / "2.deviations.csv").write_text("".join([*notes, *text[middle:]]))
    outcome = plant.run()
    assert outcome.outcomes[0].processed == ("monday",)
    assert plant.states() == ["pending"]


# --- an inbox into which anybody may put anything -------------------------------------------------------------------


def test_only_regular_files_of_the_inbox_itself_are_read(plant, monkeypatch):
    plant.write()
    secret = plant.folder / "secret.csv"
    secret.write_text("root:x:0\n")
    elsewhere = plant.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "x.deviations.csv").write_text("x_mm\n1\n")
    os.mkfifo(plant.inbox / "fifo.deviations.csv")
    (plant.inbox / "fifo-link.deviations.csv").symlink_to(plant.inbox / "fifo.deviations.csv")
    (plant.inbox / "zero.deviations.csv").symlink_to("/dev/zero")
    (plant.inbox / "foreign.deviations.csv").symlink_to(secret)
    (plant.inbox / "folder").symlink_to(elsewhere)
    (plant.inbox / "nested").mkdir()
    (plant.inbox / "nested" / "n.deviations.csv").symlink_to(secret)
    plant.measure("good")
    outcome = plant.run().outcomes[0]
    assert outcome.processed == ("good.deviations.csv",)
    assert outcome.state == "failed"
    said = "\n".join(outcome.messages)
    assert "root:x" not in said
    for name in ("fifo.", "fifo-link.", "zero.", "foreign.", "folder", "n.dev"):
        assert name in said
    assert said.count("it is a link") == 4 and said.count("is a link to a folder") == 1
    assert said.count("it is a pipe or a device") == 1
    store = open_store(plant.job().store)
    assert [item.name for item in store.measurements()] == ["good.deviations.csv"]


def test_a_folder_that_becomes_a_link_between_listing_and_reading_is_not_followed(plant):
    plant.write()
    elsewhere = plant.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "n.deviations.csv").write_text("secret\n")
    nested = plant.inbox / "nested"
    nested.mkdir()
    (nested / "n.deviations.csv").write_text("x_mm\n")
    (group,) = inbox.scan(plant.job().machine("mill"), NOW).groups
    shutil.rmtree(nested)
    nested.symlink_to(elsewhere)
    with pytest.raises(compgen.InputError, match="it is a link"):
        inbox.read_files(plant.job().machine("mill"), group)


def test_the_size_of_all_files_of_a_measurement_is_limited_before_they_are_read(plant):
    plant.write("max_size_mb = 1.0")
    nested = plant.inbox / "nested"
    nested.mkdir()
    for k in range(3):
        (nested / f"{k}.deviations.csv").write_bytes(b"1" * 400_000)
    with (plant.inbox / "sparse.deviations.csv").open("wb") as stream:
        stream.truncate(1 << 40)  # holds nothing, would take a terabyte of memory
    said = "\n".join(plant.run().outcomes[0].messages)
    assert "2.deviations.csv: is too large: 0.4 MB, but only 0.2 MB are left" in said and "0.deviations" not in said
    assert "sparse.deviations.csv: is too large: 1.1e+06 MB, but only 1 MB are left" in said


@pytest.mark.parametrize(
    "content",
    [
        b"," * 10_000_000,
        b",".join(b"c%d" % k for k in range(1_000_000)) + b"\n",
        b"# temp_ = " + b" " * 5_000_000 + b"x\nx_mm\n1\n",
        b"# temp_x_c only comments\n",
        b"temp_x_c" + b"y" * 200_000 + b",x_mm\n1,2\n",
        b"temp_x_c," * 500_000 + b"x_mm\n" + b"1\n" * 1000,
        b'temp_x_c,"x_mm\n1,2\n',
    ],
    ids=["commas", "columns", "spaces", "comments", "long", "temperatures", "quote"],
)
def test_a_file_that_is_no_table_is_refused_and_the_next_machine_has_its_turn(plant, content, small_machine_file):
    other = f'[machines.next]\nmachine = "mill.toml"\ninbox = "inbox2"\ncontrollers = ["{CONTROL}"]\nout = "out2"\n'
    plant.write(more=other + 'measured_with = "bare"\n')
    (plant.inbox / "bad.deviations.csv").write_bytes(content)
    plant.measure("good")
    (plant.folder / "inbox2").mkdir()
    shutil.copy(plant.inbox / "good.deviations.csv", plant.folder / "inbox2")
    outcome = plant.run()
    assert outcome.exit_code == 1
    assert outcome.outcomes[0].processed == outcome.outcomes[1].processed == ("good.deviations.csv",)
    assert max(map(len, outcome.outcomes[0].messages)) < 2000


# --- what speaks against the measurement ---------------------------------------------------------------------------


def misfit_text(machine, errors, *, step_um, stated_um):
    """Two runs over the volume, the second shifted in X, with an uncertainty stated that the noise does not keep."""
    once = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    position, run = np.vstack([once, once]), np.repeat([1, 2], len(once))
    noise = np.random.default_rng(5).normal(0.0, NOISE_UM * 1e-3, position.shape)
    measured = exact_error(machine, errors, position) + noise + np.outer(run == 2, [step_um * 1e-3, 0.0, 0.0])
    notes = {"u_deviation_um": str(stated_um), "measured_at": time_of(0)}
    u_mm = np.full_like(measured, stated_um * 1e-3)
    return format_deviations(Deviations(position, measured, u_mm=u_mm, labels={"run": run}, metadata=notes))


def test_a_step_between_runs_is_held_back_until_a_person_overrides(plant, small_machine, small_errors):
    plant.write('approval = "auto"')
    text = misfit_text(small_machine, small_errors, step_um=20.0, stated_um=NOISE_UM)
    (plant.inbox / "a.deviations.csv").write_text(text)
    assert plant.run().exit_code == 1
    (table,) = open_store(plant.job().store).tables()
    assert (table.state, table.accepted) == ("held", True)
    assert any("step between runs" in reason for reason in table.reasons)
    actions.approve(plant.job(), "mill", 1, "ada", override=True, reason="the shift is that of the probe")
    assert (plant.out / "active" / "NC_CEC.INI").exists()


def test_residuals_above_their_uncertainty_are_published_and_shown(plant, small_machine, small_errors):
    plant.write('approval = "auto"')
    text = misfit_text(small_machine, small_errors, step_um=0.0, stated_um=0.2 * NOISE_UM)
    (plant.inbox / "a.deviations.csv").write_text(text)
    assert plant.run().exit_code == 0
    store = open_store(plant.job().store)
    (table,) = store.tables()
    assert table.state == "active"
    assert [reason[: len("reservation: ")] for reason in table.reasons] == ["reservation: "]
    assert "times their stated uncertainty" in table.reasons[0]
    (status,) = overview.status(store, plant.job())
    assert status.state == "ok" and "with reservations" in status.message
    (row,) = fleet(store).rows
    assert row.status == "reserved"
