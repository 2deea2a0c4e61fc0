"""The job file, schedules, scheduler files, the commands with their exit codes, watching, and kill -9."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from apscheduler.triggers.base import BaseTrigger

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.toml_files import declared_settings
from compgen.errors import InputError
from compgen.fleet import publish
from compgen.fleet.job import Every, MachineJob, cron, cron_expression, job_of_text, read_job, systemd_lines, units
from compgen.fleet.runner import MachineOutcome, run_jobs
from compgen.fleet.store import open_store
from compgen.fleet.watch import Watch, trigger_of
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volume_grid

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "recal"
MACHINE = """\
[machines.mill]
machine = "mill.toml"
inbox = "inbox"
controllers = ["siemens-cec"]
out = "out"
measured_with = "bare"
"""


def write_measurement(path, machine, errors, seed, day):
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    noise = np.random.default_rng(seed).normal(0.0, 3e-4, position.shape)
    deviation = exact_error(machine, errors, position) + noise
    notes = {"measured_at": (datetime.now().astimezone() - timedelta(days=20 - day)).isoformat()}
    path.write_text(format_deviations(Deviations(position, deviation, u_mm=np.full_like(noise, 3e-4), metadata=notes)))


@pytest.fixture
def site(tmp_path, small_machine_file, monkeypatch):
    """A folder with a job file and an inbox, as the working directory, and the command line on it."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(small_machine_file, "mill.toml")
    (tmp_path / "inbox").mkdir()
    (tmp_path / "recal.toml").write_text(MACHINE)

    def call(*words):
        return run_command(cli, ["recal", *map(str, words)])

    return SimpleNamespace(folder=tmp_path, job=tmp_path / "recal.toml", call=call)


# --- the job file --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said", "line"),
    [
        (MACHINE + "schedul = '0 6 * * *'\n", "is not a known key", 7),
        (MACHINE + "[machines.mill.policy]\nmax_age = 3\n", "is not a known key", 8),
        ("[defaults.policy]\nmax_age = 3\n" + MACHINE, "is not a known key", 2),
        ("shop = 1\n" + MACHINE, "is not a known key", 1),
        (MACHINE.replace('measured_with = "bare"\n', ""), "compensates twice or not at all", 1),
        (MACHINE.replace('"bare"', '"off"'), "'active', 'bare'", 6),
        (MACHINE.replace("siemens-cec", "simens-cec"), "siemens-cec", 4),
        (MACHINE + "schedule = '0 25 * * *'\n", "'25' is not a valid hour; expected 0 to 23", 7),
        (MACHINE + "schedule = '0 6 * * *'\nevery_minutes = 5\n", "give one of the two", 7),
        (MACHINE + "[machines.mill.policy]\nconfidence = 95\n", "0.95", 8),
        (MACHINE + "[machines.mill.policy]\ntemperature_c = [22, 18]\n", "lower number first", 8),
        (MACHINE + "patterns = ['../*.csv']\n", "without folders", 7),
        (MACHINE.replace("machines.mill", "machines.'a/b'"), "is not a name", 1),
        (MACHINE + MACHINE.replace("machines.mill", "machines.saw"), "same folder out", 7),
        (MACHINE + "[machines.mill]\n", "not valid TOML", 7),
    ],
)
def test_a_wrong_job_file_is_an_error_that_names_the_line(tmp_path, text, said, line):
    (tmp_path / "recal.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_job(tmp_path / "recal.toml")
    assert said in str(caught.value)
    assert caught.value.line == line


def test_defaults_count_for_all_machines_and_a_machine_may_differ(tmp_path):
    (tmp_path / "recal.toml").write_text(
        'store = "postgresql://u@h/n"\n[defaults]\ncontrollers = "neutral"\nmeasured_with = "active"\n'
        'machine = "machines/{name}.toml"\ninbox = "in/{name}"\nout = "/srv/{name}"\nschedule = "@daily"\n'
        "[defaults.policy]\nmax_age_days = 5\nmax_change_um = 20\n"
        "[machines.a]\n[machines.b]\nevery_minutes = 20\n[machines.b.policy]\nmax_age_days = 9\n"
    )
    job = read_job(tmp_path / "recal.toml")
    a, b = job.machines.values()
    assert job.store == "postgresql://u@h/n"
    assert (a.machine, a.inbox, str(a.out)) == (str(tmp_path / "machines/a.toml"), tmp_path / "in/a", "/srv/a")
    assert (a.schedule.hours, b.schedule) == ((0,), Every(20))
    assert (a.policy.max_age_days, b.policy.max_age_days, b.policy.max_change_um) == (5.0, 9.0, 20.0)


def test_a_key_of_the_defaults_is_checked_even_where_every_machine_has_its_own(tmp_path):
    (tmp_path / "recal.toml").write_text("[defaults]\nsettle_s = -1\n" + MACHINE + "settle_s = 2\n")
    with pytest.raises(InputError, match=r"\[defaults\] settle_s: .*not negative") as caught:
        read_job(tmp_path / "recal.toml")
    assert caught.value.line == 2
    (tmp_path / "recal.toml").write_text("[defaults]\nsettle_s = -1\n")  # and where there is no machine yet
    with pytest.raises(InputError, match="not negative"):
        read_job(tmp_path / "recal.toml")


def test_of_schedule_and_interval_a_machine_s_own_one_counts(tmp_path):
    both = MACHINE + "schedule = '@daily'\n" + MACHINE.replace("mill]", "saw]").replace('"out"', '"o2"')
    (tmp_path / "recal.toml").write_text("[defaults]\nevery_minutes = 30\n" + both)
    mill, saw = read_job(tmp_path / "recal.toml").machines.values()
    assert (mill.schedule, saw.schedule) == (cron("0 0 * * *"), Every(30))
    (tmp_path / "recal.toml").write_text("[defaults]\nevery_minutes = 30\nschedule = '@daily'\n" + MACHINE)
    with pytest.raises(InputError, match="give one of the two"):
        read_job(tmp_path / "recal.toml")


def cell(value):
    """A default as the page shows it."""
    if value is None:
        return "none"
    if isinstance(value, list):
        return ", ".join(f"`{item}`" for item in value)
    return f"`{json.dumps(value)}`" if isinstance(value, str | bool) else f"{value:g}"


def test_the_page_lists_every_key_of_the_job_file_as_it_is_declared():
    page = (EXAMPLE.parents[1] / "docs" / "recal.md").read_text(encoding="utf-8")
    section = page.partition("## Job file\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| `") and "machines.NAME" not in line]
    declared = [(item.key.removeprefix("policy."), item, meaning) for item, meaning in declared_settings(MachineJob)]
    assert rows[1:] == [
        f"| `{key}` | {'required' if item.required else cell(item.shown)} | {meaning} |"
        for key, item, meaning in declared
    ]
    assert rows[0].startswith("| `store` | `recal.sqlite` |")


# --- schedules -----------------------------------------------------------------------------------------------------

EXPRESSIONS = {
    # expression: (minutes, hours, days, months, weekdays with Sunday 0, how days combine)
    "30 6 * * mon-fri": ({30}, {6}, None, None, {1, 2, 3, 4, 5}, all),
    "*/20 0-4/2 * * *": ({0, 20, 40}, {0, 2, 4}, None, None, None, all),
    "0 0 * * 0": ({0}, {0}, None, None, {0}, all),
    "0 0 * * 5-7": ({0}, {0}, None, None, {5, 6, 0}, all),
    "5,10 12 1,15 * *": ({5, 10}, {12}, {1, 15}, None, None, all),
    "0 3 13 * fri": ({0}, {3}, {13}, None, {5}, any),
    "15 1 */10 feb,mar *": ({15}, {1}, {1, 11, 21, 31}, {2, 3}, None, all),
    "@monthly": ({0}, {0}, {1}, None, None, all),
}


def brute_force(expression, start, count):
    """The first minutes after ``start`` that fit, looked at one by one."""
    minutes, hours, days, months, weekdays, combine = EXPRESSIONS[expression]
    found, now = [], start.replace(second=0, microsecond=0)
    while len(found) < count:
        now += timedelta(minutes=1) if now.hour in hours else timedelta(hours=1, minutes=-now.minute)
        fits_day = [s is None or v in s for v, s in ((now.day, days), (now.isoweekday() % 7, weekdays))]
        fits = now.minute in minutes and now.hour in hours and (months is None or now.month in months)
        if fits and combine(fits_day):
            found.append(now)
    return found


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_a_schedule_fires_when_cron_would(expression, monkeypatch):
    from zoneinfo import ZoneInfo

    monkeypatch.setattr("apscheduler.triggers.cron.get_localzone", lambda: ZoneInfo("UTC"))
    now = datetime(2026, 1, 30, 23, 17, tzinfo=ZoneInfo("UTC"))
    trigger: BaseTrigger = trigger_of(cron(expression))
    fired, last = [], None
    for _ in range(8):
        last = trigger.get_next_fire_time(last, fired[-1] if fired else now)
        if fired and last == fired[-1]:
            last = trigger.get_next_fire_time(last, last + timedelta(seconds=1))
        fired.append(last)
    assert fired == brute_force(expression, now, 8)


@pytest.mark.parametrize("expression", EXPRESSIONS)
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_timer_means_the_same_to_systemd(expression):
    start = datetime(2026, 1, 30, 23, 17)
    found = set()
    for line in systemd_lines(cron(expression)):
        words = ["systemd-analyze", "calendar", "--iterations=8", "--base-time=2026-01-30 23:17:00 UTC"]
        done = subprocess.run([*words, line.split("=", 1)[1]], capture_output=True, text=True, env={"TZ": "UTC"})
        assert done.returncode == 0, done.stderr
        for text in done.stdout.splitlines():
            name, _, value = text.strip().partition(": ")
            if name == "Next elapse" or name.startswith("Iter"):
                found.add(datetime.strptime(value.strip(), "%a %Y-%m-%d %H:%M:%S UTC"))
    assert sorted(found)[:8] == brute_force(expression, start, 8)


@pytest.mark.parametrize(
    ("minutes", "expression"),
    [(20, "*/20 * * * *"), (120, "0 */2 * * *"), (1440, "0 0 * * *"), (45, None), (300, None)],
)
def test_an_interval_becomes_a_cron_line_only_where_cron_can_say_it(minutes, expression):
    assert cron_expression(Every(minutes)) == expression


WRONG = ("0 6 * *", "60 * * * *", "* * 0 * *", "* * * * 8", "5-2 * * * *", "*/0 * * * *", "0 0 31 2 *", "a * * * *")


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_cron_expression_is_refused(text):
    with pytest.raises(ValueError, match="expected|fields|lower number first"):
        cron(text)


def test_machines_with_one_schedule_share_a_timer_and_names_are_quoted(tmp_path):
    folder = tmp_path / "a b%"
    folder.mkdir()
    lines = "".join(
        f'[machines.m{k}]\nmachine = "m.toml"\ninbox = "i"\ncontrollers = "neutral"\nout = "o{k}"\nmeasured_with = "bare"\n'
        f"{when}\n"
        for k, when in enumerate(["schedule = '0 6 * * *'", "schedule = '0 6 * * *'", "every_minutes = 45"])
    )
    (folder / "recal.toml").write_text(lines)
    files = units(read_job(folder / "recal.toml"), "/opt/compgen")
    assert sorted(files) == [
        "compgen-recal-1.service",
        "compgen-recal-1.timer",
        "compgen-recal-2.service",
        "compgen-recal-2.timer",
        "compgen-recal-watch.service",
        "crontab",
    ]
    job = f"{tmp_path}/a b%%/recal.toml"
    assert f'ExecStart=/opt/compgen recal run m0 m1 --job "{job}"' in files["compgen-recal-1.service"]
    assert "OnCalendar=*-*-* 06:00:00" in files["compgen-recal-1.timer"]
    assert "OnUnitActiveSec=45min" in files["compgen-recal-2.timer"]
    cron_lines = files["crontab"].splitlines()
    assert cron_lines[1] == rf"0 6 * * * /opt/compgen recal run m0 m1 --job '{tmp_path}/a b\%/recal.toml'"
    assert cron_lines[2].startswith("# every 45 minutes")


def test_the_files_in_examples_are_what_the_command_writes_for_the_example():
    text = (EXAMPLE / "recal.toml").read_text()
    files = dict(units(job_of_text(text, Path("/etc/compgen/recal.toml")), "/opt/compgen/bin/compgen"))
    assert (EXAMPLE / "crontab").read_text() == files.pop("crontab")
    assert {path.name: path.read_text() for path in (EXAMPLE / "systemd").iterdir()} == files


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_takes_the_units(site):
    assert site.call("export-units", "--out", "units", "--program", sys.executable) == 0
    names = [str(path) for path in sorted((site.folder / "units").glob("*.service"))]
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", *names], capture_output=True, text=True)
    ours = [line for line in done.stderr.splitlines() if "compgen-recal" in line]
    assert ours == []


# --- commands ------------------------------------------------------------------------------------------------------


def test_the_whole_way_by_commands_with_their_exit_codes(site, small_machine, small_errors, capsys):
    def said(*words):
        code = site.call(*words, "--json")
        return code, json.loads(capsys.readouterr().out)

    assert said("status")[1]["machines"][0]["state"] == "new"
    write_measurement(site.folder / "inbox/a.deviations.csv", small_machine, small_errors, 1, 1)
    code, run = said("run")
    assert (code, run["machines"][0]["waiting"]) == (0, [1])
    assert said("status")[1]["machines"][0]["state"] == "waiting"
    code, decision = said("approve", "mill", "1", "--actor", "ada", "--reason", "checked")
    assert (code, decision["active"], decision["decision"]["kind"]) == (0, 1, "approve")
    code, again = said("approve", "mill")  # without a version
    assert (code, again["exit_code"]) == (2, 2)
    assert "nothing waits" in again["error"]
    write_measurement(site.folder / "inbox/b.deviations.csv", small_machine, small_errors, 2, 2)
    assert said("run")[0] == 1
    assert said("status")[0] == 1
    assert said("approve", "mill", "2")[0] == 2
    assert said("reject", "mill", "2", "--reason", "no change")[0] == 0
    assert said("run")[0] == 0
    code, entries = said("history", "mill")
    assert code == 0
    kinds = [entry["kind"] for entry in entries["entries"]]
    assert kinds == ["measurement", "propose", "approve", "measurement", "hold", "reject"]
    assert (entries["entries"][2]["actor"], entries["entries"][2]["text"]) == ("ada", "checked")
    assert said("backup", "copy.sqlite")[0] == 0
    assert said("restore", "copy.sqlite")[0] == 2
    shutil.rmtree(site.folder / "out")
    for path in site.folder.glob("recal.sqlite*"):
        path.unlink()
    assert said("restore", "copy.sqlite")[0] == 0
    assert said("run")[0] == 0
    assert (site.folder / "out/active/NC_CEC.INI").is_file()
    assert said("rollback", "mill", "--reason", "scrap")[1]["active"] is None
    for words in (["status"], ["history"], ["run"]):  # the same for people
        assert site.call(*words) == 0
        assert "mill" in capsys.readouterr().out


@pytest.fixture
def waiting(site, small_machine, small_errors, monkeypatch):
    """Version 1 waits; ``terminal(stdin=..., stderr=...)`` says what is one, ``answer`` what the person types."""
    write_measurement(site.folder / "inbox/a.deviations.csv", small_machine, small_errors, 1, 1)
    assert site.call("run") == 0

    def terminal(answer="", *, stdin=True, stderr=True):
        typed = io.StringIO(answer)
        typed.isatty = lambda: stdin
        monkeypatch.setattr(sys, "stdin", typed)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: stderr, raising=False)

    site.terminal = terminal
    site.decided = lambda: [item.kind for item in _decisions(site)]
    return site


def _decisions(site):
    store = open_store(read_job(site.job).store)
    try:
        return store.decisions()
    finally:
        store.close()


@pytest.mark.parametrize(("stdin", "stderr", "more"), [(False, True, ()), (True, False, ()), (True, True, ("--json",))])
def test_without_a_version_nothing_is_approved_where_nobody_is_shown_it(waiting, capsys, stdin, stderr, more):
    waiting.terminal("y\n", stdin=stdin, stderr=stderr)
    assert waiting.call("approve", "mill", *more) == 2
    said = capsys.readouterr()
    assert "version 1 (pending) from a.deviations.csv, measured 2" in said.err + said.out
    assert "volcomp recal approve mill 1" in said.err + said.out
    assert waiting.decided() == ["propose"]


def test_a_terminal_shows_the_version_that_waits_and_asks(waiting, capsys):
    waiting.terminal("n\n")
    assert waiting.call("approve", "mill") == 130
    said = capsys.readouterr().err
    assert "mill: version 1 (pending) from a.deviations.csv, measured 2" in said
    assert "active now: no tables" in said and "Make it active? [y/N]" in said
    assert waiting.decided() == ["propose"]
    waiting.terminal("y\n")
    assert waiting.call("approve", "mill") == 0
    assert waiting.decided() == ["propose", "approve"]


def test_what_changed_while_a_person_was_asked_is_not_approved(
    waiting, small_machine, small_errors, monkeypatch, capsys
):
    def meanwhile(*words, **options):
        write_measurement(waiting.folder / "inbox/b.deviations.csv", small_machine, small_errors, 2, 2)
        assert waiting.call("run") == 0

    waiting.terminal()
    monkeypatch.setattr("click.confirm", meanwhile)
    assert waiting.call("approve", "mill") == 2
    assert "version 1 is superseded" in capsys.readouterr().err
    assert "approve" not in waiting.decided()


@pytest.mark.parametrize(
    "words",
    [
        ["run", "mil"],
        ["run", "--job", "nowhere.toml"],
        ["approve", "mill", "0"],
        ["reject", "mill"],
        ["rollback", "mill"],
        ["history", "nobody"],
        ["restore", "nowhere.sqlite"],
        ["run", "--notify", "'"],
    ],
)
def test_wrong_usage_ends_with_2_and_changes_nothing(site, words, capsys):
    assert site.call(*words) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_store_that_is_none_ends_with_2(site):
    (site.folder / "recal.sqlite").write_text("no store, but long enough to be looked at by the database " * 10)
    assert site.call("run") == 2


def test_add_appends_a_machine_and_refuses_what_the_job_file_would_not_take(site, capsys):
    words = ["--machine", "mill.toml", "--inbox", "in2", "--controller", "neutral", "--measured-with", "active"]
    before = site.job.read_text()
    assert site.call("add", "saw", *words, "--out", "o2", "--schedule", "30 6 * * mon") == 0
    assert site.job.read_text().startswith(before)
    # the keys that were given, as they were given; the others may come from the defaults
    assert site.job.read_text().removeprefix(before).strip() == (
        '[machines.saw]\nmachine = "mill.toml"\ninbox = "in2"\ncontrollers = ["neutral"]\nout = "o2"\n'
        'measured_with = "active"\nschedule = "30 6 * * mon"'
    )
    assert read_job(site.job).machines["saw"].schedule.weekdays == (1,)
    after = site.job.read_text()
    for wrong in (
        ["saw", *words, "--out", "o3"],
        ["a/b", *words, "--out", "o3"],
        ["lathe", *words, "--out", "o2"],
        ["lathe", *words, "--out", "o3", "--schedule", "x"],
        ["lathe", *words, "--out", "o3", "--every-minutes", "0"],
        ["lathe", *words, "--out", "o3", "--approval", "never"],
        ["lathe", *words, "--out", ""],
        ["lathe", *words],
        ["lathe", *words[2:], "--machine", "none.toml", "--out", "o3"],
    ):
        assert site.call("add", *wrong) == 2
    assert site.job.read_text() == after
    assert site.call("add", "first", *words, "--out", 'o"\\', "--job", "new.toml") == 0
    assert read_job(site.folder / "new.toml").machines["first"].out.name == 'o"\\'
    given = [
        "--every-minutes",
        "20",
        "--approval",
        "auto",
        "--controller",
        "isg-csv",
        "--out",
        "o4",
        "--job",
        "new.toml",
    ]
    assert site.call("add", "second", *words, *given) == 0
    second = read_job(site.folder / "new.toml").machines["second"]
    assert (second.schedule, second.approval, second.controllers) == (Every(20), "auto", ("neutral", "isg-csv"))


# --- watching ------------------------------------------------------------------------------------------------------


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    assert condition()


def test_watch_runs_at_once_picks_up_edits_and_keeps_the_job_if_an_edit_is_wrong(site):
    seen = []

    def work(job, _url, _stop):
        seen.append((job.name, job.approval))
        return MachineOutcome(job.name, "ok")

    watch = Watch(site.job, work=work, poll_s=0.05)
    thread = threading.Thread(target=watch.run, kwargs={"signals": False})
    thread.start()
    try:
        wait_for(lambda: seen == [("mill", "manual")])
        site.job.write_text(MACHINE + "approvall = 'auto'\n")
        time.sleep(0.3)
        site.job.write_text(MACHINE + "approval = 'auto'\n" + MACHINE.replace("mill]", "saw]").replace('"out"', '"o2"'))
        wait_for(lambda: len(seen) == 3)
        assert sorted(seen[1:]) == [("mill", "auto"), ("saw", "manual")]
        site.job.write_text(MACHINE + "approval = 'auto'\n")
        wait_for(lambda: set(watch.job.machines) == {"mill"})
        time.sleep(0.2)
        assert len(seen) == 3
    finally:
        watch.stop()
        thread.join(20)
    assert not thread.is_alive()


def test_watch_stops_cleanly_on_sigterm(site, small_machine, small_errors):
    write_measurement(site.folder / "inbox/a.deviations.csv", small_machine, small_errors, 1, 1)
    words = [sys.executable, "-m", "compgen", "recal", "watch", "--log", "json", "--poll-s", "0.1"]
    with subprocess.Popen(words, cwd=site.folder, stderr=subprocess.PIPE, text=True) as process:
        lines = []
        for line in process.stderr:
            lines.append(json.loads(line))
            if lines[-1]["event"] == "machine done":
                process.send_signal(signal.SIGTERM)
    assert process.returncode == 0
    assert [line["event"] for line in lines] == ["watching", "measurement processed", "machine done", "stopped"]


# --- kill -9 -------------------------------------------------------------------------------------------------------


def killed_at(number, job):
    """Run in a child process that kills itself at the given step of writing; return whether it got that far."""
    child = os.fork()
    if child == 0:
        try:
            _count_steps(number)
            run_jobs(job)
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def _count_steps(number):
    """Kill this process at the n-th commit (before or after it), synchronisation, renaming or link."""
    from sqlalchemy import Engine, event

    steps = [0]

    def step(*_):
        steps[0] += 1
        if steps[0] == number:
            os.kill(os.getpid(), signal.SIGKILL)

    def wrapped(function):
        def call(*args, **options):
            step()
            done = function(*args, **options)
            step()
            return done

        return call

    event.listen(Engine, "commit", step)
    for name in ("fsync", "replace", "rename", "symlink"):
        setattr(os, name, wrapped(getattr(os, name)))
    publish.os.fsync = os.fsync


def test_killed_at_any_step_nothing_is_lost_half_or_double(site, small_machine, small_errors, listing):
    site.job.write_text(MACHINE + "approval = 'auto'\n")
    for k in (1, 2):
        path = site.folder / f"inbox/{k}.deviations.csv"
        value, u = small_errors.squareness["EC0Y"]
        errors = small_errors.replace(squareness={**small_errors.squareness, "EC0Y": (value + k * 3e-5, u)})
        write_measurement(path, small_machine, errors, k, k)
    job = read_job(site.job)
    number, killed = 1, 0
    generator = np.random.default_rng(7)
    while killed_at(number, job):
        killed += 1
        active = site.folder / "out/active"
        if active.exists():
            assert (active / "version.json").is_file()
            assert (active / "NC_CEC.INI").read_bytes().endswith(b"M17\n")
        number = int(generator.integers(1, 60))
        if killed == 10:  # the benchmark does it some hundreds of times
            break
    outcome = run_jobs(job)
    assert killed >= 5
    assert outcome.exit_code == 0
    store = open_store(job.store)
    assert [item.outcome for item in store.attempts()] == ["done", "done"]
    assert [table.state for table in store.tables()] == ["retired", "active"]
    assert [item.kind for item in store.decisions()] == ["propose", "approve"] * 2
    found = listing(site.folder / "out")
    assert not [name for name in found if name.endswith(".tmp")]
    shutil.rmtree(site.folder / "out")
    run_jobs(job)
    assert listing(site.folder / "out") == found


def test_two_runners_at_the_same_time_process_each_measurement_once(site, small_machine, small_errors):
    for k in (1, 2, 3):
        write_measurement(site.folder / f"inbox/{k}.deviations.csv", small_machine, small_errors, k, k)
    words = [sys.executable, "-m", "compgen", "recal", "run", "--json"]
    runners = [
        subprocess.Popen(words, cwd=site.folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) for _ in "ab"
    ]
    outputs = [json.loads(runner.communicate()[0]) for runner in runners]
    assert [runner.returncode for runner in runners] == [0, 0]
    done = [name for output in outputs for name in output["machines"][0]["processed"]]
    assert sorted(done) == [f"{k}.deviations.csv" for k in (1, 2, 3)]
    store = open_store(read_job(site.job).store)
    assert len(store.identifications()) == len(store.attempts()) == 3
