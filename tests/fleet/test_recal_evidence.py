"""Which tables were on is shown by a backup of the control; without one, what drift does not explain waits.

Readings are simulated with the exact model and with what the control really adds: its files, edited as text, read by the
control's own reader. The program has to find out, or to hold the new tables.
"""

import itertools
import re
import shutil
from datetime import timedelta

import numpy as np
import pytest
from test_recal import NOW, deviations_text, drifted
from test_recal_active import site_in

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.files import sha256_of
from compgen.data.lengths import Points
from compgen.fleet import actions
from compgen.fleet.inbox import backup_part, is_backup, names_of
from compgen.fleet.job import read_job
from compgen.fleet.records import ReprocessRequest
from compgen.fleet.runner import run_jobs
from compgen.fleet.store import open_store
from compgen.tables import read_tables

LONG_AGO = NOW - timedelta(days=60)
CONTROLS = ("siemens-cec", "linuxcnc-comp", "isg-csv", "fanuc-pitch")


# --- files of controls as an operator, or an accident, changes them ---------------------------------------------------


def numbers(control, name, text):
    """Split the text of a table into pieces: (False, text), or (True, a value of a table, to which table it belongs)."""
    if control == "siemens-cec":
        pattern = re.compile(r"(?m)^(\$AN_CEC\[(\d+),\d+\]=)(\S+)$")
        return _split(text, pattern, 3, lambda found: int(found[2]))
    if control == "linuxcnc-comp":
        pattern = re.compile(r"(?<= )(-?\d+\.\d+)")
        return _split(text, pattern, 1, lambda _: "xyz".index(name[-6]))
    if control == "fanuc-pitch":
        pattern = re.compile(r"(?m)^(N1(\d{4})P)(-?\d+)$")
        return _split(text, pattern, 3, lambda found: 1 if 11 <= int(found[2]) <= 18 else 0)
    return _isg(text)


def _split(text, pattern, group, table):
    pieces, end = [], 0
    for found in pattern.finditer(text):
        pieces += [(False, text[end : found.start(group)], None), (True, found[group], table(found))]
        end = found.end(group)
    return [*pieces, (False, text[end:], None)]


def _isg(text):
    """Rows below a heading of names; the first column of a heading that begins with an axis is the position."""
    pieces, heading = [], []
    for line in text.splitlines(keepends=True):
        words = line.split()
        if words and re.fullmatch(r"[A-Z0-9]+", words[0]) and not re.match(r"[-\d]", words[0]):
            heading = words
        if not words or not re.fullmatch(r"-?\d+\.\d+", words[0]):
            pieces.append((False, line, None))
            continue
        for column, found in enumerate(re.finditer(r"(\s*)(\S+)", line.rstrip("\n"))):
            value = heading[column] not in ("X", "Y", "Z")
            pieces += [(False, found[1], None), (value, found[2], heading[column])]
        pieces.append((False, "\n", None))
    return pieces


def edited(control, files, change):
    """Files with every value of a table replaced by ``change(value, table)``."""
    made = {}
    for name, content in files.items():
        if name.endswith((".json", ".lis")):
            if name.endswith(".lis"):
                made[name] = content
            continue
        text = ""
        for is_value, piece, table in numbers(control, name, content.decode()):
            if not is_value:
                text += piece
            elif control == "fanuc-pitch":
                text += str(round(change(int(piece), table)))
            else:
                digits = len(piece.partition(".")[2])
                text += f"{change(float(piece), table):.{digits}f}"
        made[name] = text.encode()
    return made


#: A table that is lost, by control.
LOST = {"siemens-cec": 1, "linuxcnc-comp": 1, "isg-csv": "EYY", "fanuc-pitch": 1}


def control_holds(state, control, versions):
    """Files of the control in a state, from those of the stored versions by number; None: no tables are on."""
    old, new = versions[1], versions[2]
    turn = itertools.cycle((1, 1, -1))
    change = {
        "lost": lambda value, table: 0 if table == LOST[control] else value,
        "opposite": lambda value, _: -value,
        "half": lambda value, _: 0.5 * value,
        "twice": lambda value, _: 2 * value,
        "opposite table": lambda value, table: -value if table == LOST[control] else value,
        "edited": lambda value, table: value if table != LOST[control] else next(turn) * value,
    }
    if state == "none":
        return None
    if state in ("older", "right"):
        return {"older": old, "right": new}[state]
    if control == "isg-csv" and state == "edited":
        change["edited"] = lambda value, table: value + 43e-6 * (table == "EC0Y" or table == "C0Y")
    return edited(control, new, change[state])


# --- a machine at each control ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def base(tmp_path_factory, small_machine_file, small_errors):
    """Folders of machines at each control, on which version 2 has been active for days; made when they are needed."""
    made = {}

    def folder(control):
        if control not in made:
            made[control] = tmp_path_factory.mktemp(control)
            file = made[control] / "small.toml"
            file.write_text(small_machine_file.read_text())
            site = plant(made[control], control, file, small_errors)
            site.now = LONG_AGO
            site.put("first", small_errors, None, active_table="none", seed=1)
            assert site.run().active == 1
            site.now += timedelta(days=20)
            site.put("second", changed(small_errors, 1.0), site.files(1), site.files(1), seed=2)
            assert site.run().active == 2, site.tables()[-1].reasons
            site.now += timedelta(days=9)
        return made[control]

    return folder


@pytest.fixture
def at(base, tmp_path, small_errors):
    """A copy of the machine at a control."""

    def make(control):
        source = base(control)
        shutil.copytree(source, tmp_path, symlinks=True, dirs_exist_ok=True)
        site = plant(tmp_path, control, tmp_path / "small.toml", small_errors)
        site.now = LONG_AGO + timedelta(days=29)
        return site

    return make


def changed(errors, size):
    """The machine after some weeks: scale of Y and squareness have changed by 12 um/m and 18 urad times ``size``."""
    curve = errors.curves["EYY"]
    grown = curve.value + size * 12e-6 * (curve.position_mm - 100.0)
    table = drifted(errors, 18.0 * size)
    return table.replace(curves={**table.curves, "EYY": type(curve)(curve.position_mm, grown, curve.u)})


def plant(folder, control, machine_file, errors):
    import compgen

    machine = compgen.load_machine(machine_file)
    site = site_in(folder, machine, machine_file, errors)
    shutil.copy(machine_file, folder / "mill.toml")
    path = folder / "recal.toml"

    def write(policy="", approval="auto"):
        path.write_text(
            f'[machines.mill]\nmachine = "mill.toml"\ninbox = "inbox"\ncontrollers = ["{control}"]\nout = "out"\n'
            f'measured_with = "active"\napproval = "{approval}"\n[machines.mill.policy]\n{policy}\n'
        )
        site.job = read_job(path)

    def files(version):
        store = open_store(site.job.store)
        table = next(item for item in store.tables() if item.version == version)
        names = table.summary["tables"][control]
        found = {item.name: item.content for item in store.table_files(table) if item.name in names}
        store.close()
        return {name: content for name, content in found.items() if not name.endswith(".json")}

    def acts(held):
        """What the control adds, from its files by its own reader."""
        if held is None:
            return None
        (folder / "control").mkdir(exist_ok=True)
        for old in (folder / "control").iterdir():
            old.unlink()
        for name, content in held.items():
            (folder / "control" / name).write_bytes(content)
        tables = read_tables(machine, sorted((folder / "control").iterdir()), control, foreign=True)
        return lambda position: tables.correction(machine, Points(position, approach=np.ones_like(position)))

    def backup(name, held):
        for file, content in held.items():
            (site.inbox / f"{name}.backup.{file}").write_bytes(content)

    def put(name, truth, held, backed_up=None, *, seed, at=None, **notes):
        """Measure the machine while its control holds files; ``backed_up``: files of a backup beside the measurement."""
        said = (site.now if at is None else at).isoformat()
        text = deviations_text(machine, truth, seed=seed, correction=acts(held), measured_at=said, **notes)
        (site.inbox / f"{name}.deviations.csv").write_text(text)
        if backed_up is not None:
            backup(name, backed_up)

    def identified():
        """Errors of the newest identification."""
        store = open_store(site.job.store)
        found = store.errors_of(max(store.identifications(), key=lambda item: item.id))
        store.close()
        return found

    write()
    for function in (write, files, backup, put, identified, acts):
        setattr(site, function.__name__, function)
    site.control = control
    site.command = lambda *words: run_command(cli, ["recal", *words, "--job", str(path)])
    return site


def off_urad(site, truth):
    """By how much the identified squareness EC0Y misses the truth, urad."""
    return 1e6 * abs(site.identified().squareness["EC0Y"][0] - truth.squareness["EC0Y"][0])


STATES = ("older", "lost", "opposite", "half", "none", "edited", "opposite table", "twice")


@pytest.mark.parametrize(("control", "state"), list(itertools.product(CONTROLS, STATES)))
def test_without_a_backup_no_wrong_state_of_the_tables_becomes_tables(at, small_errors, control, state):
    """The machine has drifted besides; version 2 stays active, whatever the control really held."""
    site = at(control)
    held = control_holds(state, control, {1: site.files(1), 2: site.files(2)})
    site.put("third", changed(small_errors, 1.6), held, seed=3)
    outcome = site.run()
    assert (outcome.state, outcome.active) == ("held", 2)


@pytest.mark.parametrize("control", CONTROLS)
def test_an_ordinary_drift_needs_no_backup(at, small_errors, control):
    site = at(control)
    site.put("third", changed(small_errors, 1.3), site.files(2), seed=3)
    assert "no backup of the control" not in " ".join(site.run().messages)
    assert "do not fit" not in " ".join(site.tables()[-1].reasons)


@pytest.mark.parametrize(
    ("control", "state"),
    [
        ("siemens-cec", "lost"),
        ("siemens-cec", "opposite"),
        ("linuxcnc-comp", "half"),
        ("linuxcnc-comp", "lost"),
        ("isg-csv", "edited"),
        ("isg-csv", "older"),
        ("fanuc-pitch", "opposite table"),
        ("fanuc-pitch", "twice"),
    ],
)
def test_a_backup_decides_whatever_the_control_held(at, small_errors, control, state):
    """The new errors are those of the bare machine, though no stored version is what was on."""
    site = at(control)
    held = control_holds(state, control, {1: site.files(1), 2: site.files(2)})
    truth = changed(small_errors, 3.5)
    site.put("third", truth, held, held, seed=3)
    outcome = site.run()
    table = site.tables()[-1]
    print(table.reasons, table.summary["tables_on"])
    assert (outcome.state, outcome.active, table.state) == ("ok", 3, "active"), table.reasons
    shown = table.summary["evidence"]
    assert shown["version"] == (1 if state == "older" else None) and shown["source"] == "inbox"
    words = {
        "older": "version 1",
        "lost": "version 2 without",
        "opposite": "version 2 with the opposite sign",
        "half": "version 2 at half its size",
        "twice": "version 2 at twice its size",
        "opposite table": "version 2 with the opposite sign of",
        "edited": "tables that differ from version 2 by up to",
    }[state]
    assert shown["tables"].startswith(words)
    assert f"shows {words}" in " ".join(table.reasons)  # a reservation: the right tables should be loaded
    assert off_urad(site, truth) < 1.0


@pytest.mark.parametrize("control", CONTROLS)
def test_tables_of_zeros_are_none(at, small_errors, control):
    site = at(control)
    zero = edited(control, site.files(2), lambda value, _: 0)
    truth = changed(small_errors, 3.5)
    site.put("third", truth, None, zero, seed=3)
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["tables"].startswith("no tables")
    assert off_urad(site, truth) < 1.0


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("first", ["backup", "measurement"])
def test_measurement_and_backup_come_in_either_order(at, small_errors, control, first):
    site = at(control)
    held = control_holds("half", control, {1: site.files(1), 2: site.files(2)})
    truth = changed(small_errors, 3.0)
    if first == "backup":
        site.backup("third", held)
        assert site.run().processed == ()
        site.put("third", truth, held, seed=3)
        assert site.run().active == 3
    else:
        site.put("third", truth, held, seed=3)
        assert site.run().state == "held"
        (site.inbox / "third.deviations.csv").unlink()  # the store has it
        site.backup("third", held)
        outcome = site.run()
        assert (outcome.state, outcome.active) == ("ok", 4)
        store = open_store(site.job.store)
        said = [item for item in store.decisions() if item.kind == "propose"][-1]
        assert "third.deviations.csv processed again with the backup third.backup." in said.reason
        assert max(item.revision for item in store.identifications()) == 2
        store.close()
    assert off_urad(site, truth) < 1.0
    before = len(site.tables())
    assert site.run().processed == () and len(site.tables()) == before  # and it is not judged a third time


def test_a_backup_by_the_command(at, small_errors, capsys):
    """One file; a folder of files for a control with several; a measurement that was held before."""
    site = at("linuxcnc-comp")
    site.now = NOW  # the command sees the true time
    held = control_holds("opposite", "linuxcnc-comp", {1: site.files(1), 2: site.files(2)})
    truth = changed(small_errors, 3.0)
    site.put("third", truth, held, seed=3)
    assert site.command("run") == 1
    (site.folder / "from-control").mkdir()
    for name, content in held.items():
        (site.folder / "from-control" / name).write_bytes(content)
    assert site.command("run", "--backup", str(site.folder / "from-control")) == 2
    assert "a backup is that of one machine" in capsys.readouterr().err
    assert site.command("run", "mill", "--backup", str(site.folder / "nowhere")) == 2
    assert site.command("run", "mill", "--backup", str(site.folder / "from-control")) == 0
    assert site.tables()[-1].state == "active" and off_urad(site, truth) < 1.0
    capsys.readouterr()
    assert site.command("history", "mill") == 0
    assert "joint0-x.comp" in capsys.readouterr().out


def test_several_files_by_the_command_and_for_one_stored_measurement(at, small_errors, capsys):
    site = at("isg-csv")
    held = control_holds("lost", "isg-csv", {1: site.files(1), 2: site.files(2)})
    truth = changed(small_errors, 3.0)
    site.put("third", truth, held, seed=3)
    assert site.run().state == "held"
    paths = [site.folder / "control" / name for name in held]
    wish = ReprocessRequest("3", "ada", "here is the backup", None, tuple(paths))
    done = actions.reprocess(site.job, "mill", wish, clock=lambda: site.now)
    assert done.table.state == "active" and off_urad(site, truth) < 1.0


def test_a_backup_by_the_command_is_not_guessed_to_belong_to_one_of_several_measurements(at, small_errors, capsys):
    site = at("siemens-cec")
    for number in (3, 4):
        site.put(f"m{number}", changed(small_errors, 1.5), site.files(2), seed=number)
    path = site.folder / "NC_CEC.INI"
    path.write_bytes(site.files(2)["NC_CEC.INI"])
    before = len(site.tables())
    assert site.command("run", "mill", "--backup", str(path)) == 2
    assert "2 measurements of mill wait (m3.deviations.csv, m4.deviations.csv)" in capsys.readouterr().err
    assert len(site.tables()) == before


@pytest.mark.parametrize("content", [b"", b"hello\n", b"\x00\x01\x02" * 100, b"%\nN03620A1P5\n%\n"])
def test_what_is_no_backup_of_this_control(at, small_errors, capsys, content):
    """By the command nothing is stored; in the inbox the measurement is held, and judged again with a better one."""
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 1.2), site.files(2), {"NC_CEC.INI": content}, seed=3)
    outcome = site.run()
    assert outcome.state == "held"
    assert "the backup of the control (third.backup.NC_CEC.INI) cannot be read" in " ".join(site.tables()[-1].reasons)
    assert "compgen-backup" not in " ".join(site.tables()[-1].reasons)
    path = site.folder / "other.ini"
    path.write_bytes(content)
    assert site.command("run", "mill", "--backup", str(path)) == 2
    assert "is no backup that siemens-cec can read" in capsys.readouterr().err
    site.backup("third", site.files(2))
    site.run()
    assert "cannot be read" not in " ".join(site.tables()[-1].reasons)


# --- hashes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["{hash}  NC_CEC.INI\n", "{hash}", "{HASH} *NC_CEC.INI\r\n"])
def test_the_hash_of_the_tables_shows_which_version_was_on(at, small_errors, form):
    site = at("siemens-cec")
    truth = changed(small_errors, 3.5)
    digest = sha256_of(site.files(1)["NC_CEC.INI"])
    text = form.format(hash=digest, HASH=digest.upper()).encode()
    site.put("third", truth, site.files(1), {"sha256": text}, seed=3)
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["version"] == 1
    assert off_urad(site, truth) < 1.0


def test_hashes_of_some_tables_show_that_the_others_were_lost(at, small_errors):
    site = at("linuxcnc-comp")
    held = {name: content for name, content in site.files(2).items() if "-y" not in name}
    text = "".join(f"{sha256_of(content)}  {name}\n" for name, content in held.items())
    truth = changed(small_errors, 3.5)
    site.put("third", truth, held, {"sha256": text.encode()}, seed=3)
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["tables"] == "version 2 without what it adds to Y"
    assert off_urad(site, truth) < 1.0


def test_a_hash_of_no_stored_version_asks_for_the_backup_itself(at, small_errors):
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 1.2), site.files(2), {"sha256": b"ab" * 32}, seed=3)
    assert site.run().state == "held"
    assert "no stored version has a table with the SHA-256 abababababab...; give the backup itself" in " ".join(
        site.tables()[-1].reasons
    )


# --- what contradicts -------------------------------------------------------------------------------------------------


def test_a_statement_that_the_backup_contradicts_waits(at, small_errors):
    site = at("siemens-cec")
    truth = changed(small_errors, 3.5)
    site.put("third", truth, site.files(1), site.files(1), seed=3, active_table="v2")
    assert site.run().state == "held"
    said = " ".join(site.tables()[-1].reasons)
    assert (
        "the file states that version 2 was on, but the backup of the control (third.backup.NC_CEC.INI) shows version 1"
        in said
    )
    assert off_urad(site, truth) < 1.0  # by the backup


def test_a_backup_of_after_the_next_approval_does_not_show_what_was_on_before(at, small_errors):
    """Measured with version 2; the backup is made when version 1 has been loaded again."""
    site = at("siemens-cec")
    measured = site.now
    site.put("third", changed(small_errors, 1.2), site.files(2), seed=3, at=measured)
    actions.rollback(site.job, "mill", "ada", "parts are off", to=1, clock=lambda: measured + timedelta(hours=5))
    site.now = measured + timedelta(days=1)
    site.backup("third", site.files(1))
    outcome = site.run()
    assert outcome.state == "held"
    assert "which shows version 1: it does not show what was on before" in " ".join(site.tables()[-1].reasons)


def test_a_forgotten_backup_of_an_earlier_measurement_is_no_evidence(at, small_errors):
    """A program always writes check.deviations.csv; the backup beside it is still that of last month."""
    site = at("siemens-cec")
    site.put("check", changed(small_errors, 1.2), site.files(2), site.files(2), seed=3)
    site.run()
    site.now += timedelta(days=30)
    site.put("check", changed(small_errors, 6.0), site.files(1), seed=4)
    outcome = site.run()
    assert outcome.state == "held" and "was evidence of measurement 3 already" in " ".join(outcome.messages)
    assert "evidence" not in site.tables()[-1].summary


def test_data_that_contradict_the_backup_wait(at, small_errors):
    """The control holds version 2, but its compensation was switched off."""
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 1.2), None, site.files(2), seed=3)
    assert site.run().state == "held"
    assert "the readings contradict the backup of the control" in " ".join(site.tables()[-1].reasons)


@pytest.mark.parametrize(("on", "shown"), [(2, 1), (1, 2), (None, 1)])
@pytest.mark.parametrize("control", ["siemens-cec", "isg-csv"])
def test_a_backup_of_another_version_than_was_on_waits(at, small_errors, control, on, shown):
    """An old file, or one that was copied and never loaded; the machine has drifted twice as far as usual."""
    site = at(control)
    site.put("third", changed(small_errors, 1.6), on and site.files(on), site.files(shown), seed=3)
    assert site.run().state == "held"
    assert "the readings contradict the backup of the control" in " ".join(site.tables()[-1].reasons)


@pytest.mark.parametrize("control", ["siemens-cec", "isg-csv"])
def test_two_faults_at_once_are_taken_from_the_backup_and_contradicted_without_them(at, small_errors, control):
    """One table lost and the others with the opposite sign; once they were on, once not."""
    site = at(control)
    held = edited(control, site.files(2), lambda value, table: 0 if table == LOST[control] else -value)
    truth = changed(small_errors, 3.5)
    site.put("third", truth, held, held, seed=3)
    assert site.run().active == 3 and off_urad(site, truth) < 1.0
    site.now += timedelta(days=5)
    site.put("fourth", truth, site.files(3), held, seed=4)
    assert site.run().active == 3
    assert "the readings contradict the backup of the control" in " ".join(site.tables()[-1].reasons)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"),
        lambda content: b"\xef\xbb\xbf" + content,
        lambda content: content + b"\n\n",
    ],
    ids=["line ends", "byte order mark", "blank lines"],
)
def test_bytes_that_mean_nothing_do_not_make_other_tables(at, small_errors, change):
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 3.5), site.files(1), seed=3)
    site.backup("third", {name: change(content) for name, content in site.files(1).items()})
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["version"] == 1


def test_a_backup_of_another_machine_waits_although_no_history_contradicts_it(at, small_errors):
    """The first measurement of a second machine comes with the backup of the first one's control."""
    site = at("siemens-cec")
    path = site.folder / "recal.toml"
    text = path.read_text()
    for old, new in (
        ("mill]", "lathe]"),
        ("mill.policy", "lathe.policy"),
        ('"inbox"', '"inbox-2"'),
        ('"out"', '"out-2"'),
    ):
        text = text.replace(old, new)
    path.write_text(path.read_text() + text)
    (site.folder / "inbox-2").mkdir()
    site.job = read_job(path)
    site.put("first", changed(small_errors, 5.0), None, site.files(2), seed=9)
    for file in site.inbox.glob("first.*"):
        file.rename(site.folder / "inbox-2" / file.name)
    (outcome,) = run_jobs(site.job, ["lathe"], clock=lambda: site.now).outcomes
    assert (outcome.state, outcome.active) == ("held", None)
    assert (
        "(first.backup.NC_CEC.INI) has files of mill (version 2): make one of the control of lathe"
        in outcome.messages[0]
    )


def test_more_errors_than_before_do_not_show_which_tables_were_on(at, small_errors):
    site = at("isg-csv")
    path = site.folder / "mill.toml"
    whole = path.read_text()
    store = open_store(site.job.store)
    names = [name for name in store.errors_of(store.identifications()[-1]).names if name != "EAX"]
    store.close()
    path.write_text(f"errors = {names}\n".replace("'", '"') + whole)
    site.put("third", changed(small_errors, 3.5), site.files(2), site.files(2), seed=3)
    assert site.run().state == "held"  # the active tables correct EAX
    site.command("approve", "mill", "3", "--override", "--reason", "a test")
    path.write_text(whole)
    site.now += timedelta(days=5)
    site.put("fourth", changed(small_errors, 3.6), site.files(3), seed=4)
    assert site.run().active == 3
    assert "more errors were measured than for the tables that were active last" in " ".join(site.tables()[-1].reasons)


def test_a_real_jump_with_a_backup_does_not_wait(at, small_errors):
    site = at("isg-csv")
    truth = changed(small_errors, 9.0)
    site.put("third", truth, site.files(2), site.files(2), seed=3)
    assert site.run().active == 3 and off_urad(site, truth) < 1.0


def test_readings_from_before_and_after_an_approval_wait_unless_the_old_tables_stayed_on(at, small_errors):
    from test_recal_timeline import lasting

    site = at("siemens-cec")
    begin = site.now
    for name, seed, version in (("stayed", 3, 2), ("loaded", 4, 1)):
        site.put(name, changed(small_errors, 3.5), site.files(version), site.files(version), seed=seed, at=begin)
        lasting(site.inbox / f"{name}.deviations.csv", 4.0)
    site.write(approval="manual")
    actions.rollback(site.job, "mill", "ada", "a test", to=1, clock=lambda: begin + timedelta(hours=2))
    site.now = begin + timedelta(days=1)
    site.run()
    by_name = {item.summary["evidence"]["version"]: " ".join(item.reasons) for item in site.tables()[2:]}
    assert "does not show what was on before" not in by_name[2] and "does not show what was on before" in by_name[1]


# --- the policy -------------------------------------------------------------------------------------------------------


def test_a_policy_that_requires_evidence(at, small_errors):
    site = at("siemens-cec")
    site.write(policy='evidence = "required"')
    site.put("third", changed(small_errors, 1.3), site.files(2), seed=3, active_table="v2")
    assert site.run().state == "held"
    assert "evidence = required" in " ".join(site.tables()[-1].reasons)
    wish = ReprocessRequest(None, "ada", "the log says so", "v2")
    assert "evidence = required" in " ".join(
        actions.reprocess(site.job, "mill", wish, clock=lambda: site.now).table.reasons
    )
    site.backup("third", site.files(2))
    site.run()
    assert "evidence = required" not in " ".join(site.tables()[-1].reasons)


def test_the_first_tables_of_a_machine_may_replace_those_of_its_maker(base, tmp_path, small_errors, small_machine_file):
    """What the control held is known by the backup alone; no statement is needed, and no stored version has it."""
    file = tmp_path / "small.toml"
    file.write_text(small_machine_file.read_text())
    site = plant(tmp_path, "isg-csv", file, small_errors)
    reader = plant(base("isg-csv"), "isg-csv", file, small_errors)
    makers = edited("isg-csv", reader.files(1), lambda value, _: 0.4 * value)
    site.put("first", small_errors, makers, makers, seed=1)
    assert site.run().active == 1
    assert off_urad(site, small_errors) < 1.0
    site.now += timedelta(days=1)
    site.put("second", small_errors, site.files(1), seed=2)
    assert "does not know" not in " ".join(site.run().messages)


def test_a_backup_cannot_tell_whether_tables_that_are_switched_off_acted(at, small_errors):
    site = at("siemens-cec")
    path = site.folder / "recal.toml"
    path.write_text(path.read_text().replace('measured_with = "active"', 'measured_with = "bare"'))
    site.job = read_job(path)
    truth = changed(small_errors, 1.4)
    site.put("third", truth, None, site.files(2), seed=3)
    assert site.run().state == "held"
    assert "does not show whether it acted" in " ".join(site.tables()[-1].reasons)
    assert off_urad(site, truth) < 1.0
    site.put("fourth", truth, None, site.files(2), seed=4, active_table="none")
    site.run()
    assert "does not show whether it acted" not in " ".join(site.tables()[-1].reasons)


# --- names ------------------------------------------------------------------------------------------------------------


def test_which_measurement_a_backup_belongs_to():
    assert names_of("a.lengths.csv") == {"a", "a.lengths", "a.lengths.csv"}
    assert names_of("v1.2.deviations.csv") == {"v1.2", "v1.2.deviations", "v1.2.deviations.csv"}
    assert names_of("both") == {"both"} and names_of("run 7.rtl") == {"run 7", "run 7.rtl"}
    assert is_backup("a.backup.tar.gz") and is_backup("A.BACKUP.INI") and not is_backup("backup.ini")
    assert backup_part("a.BACKUP.NC_CEC.INI") == "NC_CEC.INI"


@pytest.mark.parametrize("place", ["third.backup/NC_CEC.INI", "third.deviations.backup.ini", "third.backup.NC.arc"])
def test_places_of_a_backup(at, small_errors, place):
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 3.5), site.files(1), seed=3)
    path = site.inbox / place
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(site.files(1)["NC_CEC.INI"])
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["version"] == 1


def test_a_backup_in_the_folder_of_a_measurement_of_several_files(at, small_errors):
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 3.5), site.files(1), seed=3)
    (site.inbox / "both").mkdir()
    (site.inbox / "third.deviations.csv").rename(site.inbox / "both" / "third.deviations.csv")
    (site.inbox / "both" / "control.backup.ini").write_bytes(site.files(1)["NC_CEC.INI"])
    assert site.run().active == 3
    assert site.tables()[-1].summary["evidence"]["files"] == "control.backup.ini"


def test_a_backup_that_is_a_link_is_not_followed(at, small_errors, tmp_path):
    site = at("siemens-cec")
    site.put("third", changed(small_errors, 1.3), site.files(2), seed=3)
    (tmp_path / "secret").write_text("x")
    (site.inbox / "third.backup.ini").symlink_to(tmp_path / "secret")
    outcome = site.run()
    assert outcome.state == "failed" and "it is a link" in " ".join(outcome.messages)
    assert "evidence" not in site.tables()[-1].summary
