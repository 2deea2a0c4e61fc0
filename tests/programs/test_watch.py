"""``volcomp correct --watch``: what comes into a folder is corrected once it rests, and nothing in the folder is touched.

The truth of a corrected program is that of ``correct`` for the same file alone. Time is a number that the tests give.
"""

import json
import os
import signal
import threading
from pathlib import Path

import pytest
from programs.make import mill
from programs.test_correct import PLAIN, shift

from compgen.data.files import exclusive
from compgen.errors import InputError
from compgen.programs import CorrectOptions, FolderWatch, correct_program, model_of

ERRORS = Path(__file__).parents[2] / "examples/zha-gantry.truth.errors.csv"
HEAD = "%\nO1\nG21 G90 G17 G54\nG0 X-10. Y-5. Z-2.\n"
PROGRAM = f"{HEAD}G1 X-20. F500\nM30\n%\n"
OTHER = f"{HEAD}G1 X-30. F500\nM30\n%\n"
REFUSED = f"{HEAD}G41.3 D1\nG1 X-20. F500\nM30\n%\n"
MODEL = model_of(mill(), shift(x=10.0), None)


def correct(source, folder):
    return correct_program(MODEL, source, folder, CorrectOptions("fanuc"), PLAIN)


@pytest.fixture
def posted(tmp_path):
    (tmp_path / "posted").mkdir()
    return tmp_path / "posted"


def watch_of(posted, settle_s=2.0, correct=correct, **more):
    return FolderWatch(posted, posted / "corrected", correct, settle_s=settle_s, **more)


def looked(watch, now_s=0.0):
    return [(item.name, item.state) for item in watch.look(now_s)]


def names(folder):
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def test_a_program_is_corrected_as_alone_and_stays_as_it_was(posted, tmp_path):
    (posted / "a.nc").write_text(PROGRAM)
    before = (posted / "a.nc").stat()
    (item,) = watch_of(posted, 0.0).look(0.0)
    correct(posted / "a.nc", tmp_path / "alone")
    for name in ("a.nc", "correction.json", "preflight.md"):
        assert (posted / "corrected/a.nc" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert "X-20.01 " in item.file.read_text()  # the machine moves 10 um too far in X
    after = (posted / "a.nc").stat()
    assert (posted / "a.nc").read_text() == PROGRAM
    assert (after.st_ino, after.st_mtime_ns, after.st_mode) == (before.st_ino, before.st_mtime_ns, before.st_mode)
    assert names(posted) == ["a.nc", "corrected"]


def test_a_program_is_taken_once_it_no_longer_grows(posted):
    watch, file = watch_of(posted), posted / "a.nc"
    file.write_text(HEAD)
    assert looked(watch, 0.0) == []
    with file.open("a") as stream:
        stream.write(PROGRAM[len(HEAD) :])
    assert [looked(watch, now_s) for now_s in (1.9, 3.8, 3.9, 4.0, 90.0)] == [[], [], [("a.nc", "accepted")], [], []]


@pytest.mark.parametrize("settle_s", [0.0, 2.0])
def test_what_changes_while_it_is_read_is_not_taken(posted, monkeypatch, settle_s):
    watch, file = watch_of(posted, settle_s), posted / "a.nc"
    file.write_text(PROGRAM)
    assert settle_s == 0.0 or looked(watch, 0.0) == []
    copy = "compgen.programs.watch.shutil.copyfile"
    with monkeypatch.context() as patch:
        patch.setattr(copy, lambda source, target: (target.write_text(HEAD), source.write_text(PROGRAM + "\n")))
        assert looked(watch, 5.0) == ([] if settle_s else [("a.nc", "refused")])
    assert not (posted / "corrected").exists()
    assert looked(watch, 6.0) == ([] if settle_s else [("a.nc", "accepted")])
    assert looked(watch, 8.0) == ([("a.nc", "accepted")] if settle_s else [])


def test_what_is_deleted_while_it_is_read_is_left(posted, monkeypatch):
    watch, file = watch_of(posted), posted / "a.nc"
    file.write_text(PROGRAM)
    looked(watch, 0.0)

    def gone(source, target):
        source.unlink()
        raise FileNotFoundError(2, "gone")

    monkeypatch.setattr("compgen.programs.watch.shutil.copyfile", gone)
    assert [looked(watch, now_s) for now_s in (5.0, 9.0)] == [[], []]


def test_a_refused_program_leaves_a_text_and_the_next_one_is_corrected(posted):
    (posted / "a.nc").write_text(REFUSED)
    (posted / "b.nc").write_text(PROGRAM)
    first, second = watch_of(posted, 0.0).look(0.0)
    assert (first.state, second.state) == ("refused", "accepted")
    assert first.reasons[0].startswith("a.nc:5: G41.3")
    assert names(posted / "corrected/a.nc") == ["REFUSED.txt"]
    assert "a.nc:5: G41.3" in first.file.read_text()


def test_an_internal_error_does_not_end_the_watch(posted):
    def broken(source, folder):
        raise ZeroDivisionError("by zero") if source.name == "a.nc" else InputError("no", file=source, line=3)

    for name in ("a.nc", "b.nc"):
        (posted / name).write_text(PROGRAM)
    first, second = watch_of(posted, 0.0, broken).look(0.0)
    assert first.reasons == ("internal error: ZeroDivisionError: by zero",)
    assert second.reasons == ("b.nc:3: no",)


@pytest.mark.parametrize("replace", [False, True])
def test_an_overwritten_program_replaces_all_files_of_the_old_one(posted, replace):
    watch, file, made = watch_of(posted, 0.0), posted / "a.nc", posted / "corrected/a.nc"
    results = ["accepted", "refused", "accepted", "not accepted", "accepted"]
    air = f"{HEAD}M30\n%\n"  # no moves at feed
    for text, state in zip([PROGRAM, REFUSED, OTHER, air, PROGRAM], results, strict=True):
        if replace:  # as a post that writes to another name first
            (posted / "a.nc.tmp").write_text(text)
            os.replace(posted / "a.nc.tmp", file)
        else:
            file.write_text(text)
        assert looked(watch) == [("a.nc", state)]
        program = {"accepted": "a.nc", "not accepted": "NOT-ACCEPTED-a.nc"}.get(state)
        assert names(made) == (sorted([program, "correction.json", "preflight.md"]) if program else ["REFUSED.txt"])
    assert looked(watch) == []


def test_renamed_and_deleted_programs(posted):
    watch = watch_of(posted, 0.0)
    (posted / "a.nc").write_text(PROGRAM)
    assert looked(watch) == [("a.nc", "accepted")]
    (posted / "a.nc").rename(posted / "b.nc")
    assert looked(watch) == [("a.nc", "deleted"), ("b.nc", "accepted")]
    (posted / "b.nc").unlink()
    assert looked(watch) == [("b.nc", "deleted")]
    assert names(posted / "corrected") == ["a.nc", "b.nc"]
    (posted / "b.nc").write_text(PROGRAM)
    assert looked(watch) == [("b.nc", "accepted")]


def test_a_second_watch_does_not_do_again_what_has_not_changed(posted):
    for name, text in (("a.nc", PROGRAM), ("b.nc", REFUSED), ("c.nc", PROGRAM), ("d.nc", PROGRAM), ("e.nc", PROGRAM)):
        (posted / name).write_text(text)
    assert len(looked(watch_of(posted, 0.0))) == 5
    made = posted / "corrected"
    before = {path: path.stat().st_mtime_ns for path in made.glob("[ab].nc/*")}
    (posted / "c.nc").write_text(OTHER)  # changed, lost or edited since
    (made / "d.nc/d.nc").unlink()
    (made / "e.nc/e.nc").write_text(PROGRAM)
    found = {item.name: (item.state, item.before) for item in watch_of(posted, 0.0).look(0.0)}
    done, again = ("accepted", True), ("accepted", False)
    assert found == {"a.nc": done, "b.nc": ("refused", True), "c.nc": again, "d.nc": again, "e.nc": again}
    assert {path: path.stat().st_mtime_ns for path in before} == before
    (item,) = [item for item in watch_of(posted, 0.0).look(0.0) if item.name == "b.nc"]
    assert item.reasons[0].startswith("b.nc:5: G41.3")
    other = [item.before for item in watch_of(posted, 0.0, conditions=lambda: "other errors").look(0.0)]
    assert other == [False] * 5


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"program_sha256": 1}', "\x00"])
def test_a_note_that_is_none_is_not_believed(posted, text):
    (posted / "a.nc").write_text(PROGRAM)
    looked(watch_of(posted, 0.0))
    (posted / "corrected/a.nc/.watched.json").write_text(text)
    assert [item.before for item in watch_of(posted, 0.0).look(0.0)] == [False]


def test_programs_are_corrected_again_once_changed_errors_rest(posted):
    said = ["old"]
    (posted / "a.nc").write_text(PROGRAM)
    watch = watch_of(posted, conditions=lambda: said[0])
    assert [looked(watch, now_s) for now_s in (0.0, 2.0, 3.0)] == [[], [("a.nc", "accepted")], []]
    said[0] = "new"
    assert [looked(watch, now_s) for now_s in (4.0, 5.9, 6.0, 9.0)] == [[], [], [("a.nc", "accepted")], []]


def test_subfolders_are_passed_over_aloud_or_looked_into(posted):
    for name in ("job1/a.nc", "job2/a.nc", "job2/deep/a.nc", ".hidden/a.nc", "a.nc", "a.tap"):
        (posted / name).parent.mkdir(parents=True, exist_ok=True)
        (posted / name).write_text(PROGRAM)
    watch = watch_of(posted, 0.0)
    assert looked(watch) == [("job1", "folder"), ("job2", "folder"), ("a.nc", "accepted"), ("a.tap", "accepted")]
    assert looked(watch) == []
    (posted / "loop").symlink_to(posted)
    watch = watch_of(posted, 0.0, subfolders=True)
    states = {item.name: item.state for item in watch.look(0.0)}
    made = ("a.nc", "a.tap", "job1/a.nc", "job2/a.nc", "job2/deep/a.nc")
    assert states == {"loop": "folder", **dict.fromkeys(made, "accepted")}
    assert all((posted / "corrected" / name / Path(name).name).is_file() for name in made)
    assert looked(watch) == []


def test_a_link_is_followed_and_its_own_output_is_no_input(posted, tmp_path):
    (tmp_path / "elsewhere.nc").write_text(PROGRAM)
    (posted / "link.nc").symlink_to(tmp_path / "elsewhere.nc")
    (posted / "broken.nc").symlink_to(tmp_path / "none")
    watch = watch_of(posted, 0.0)
    assert looked(watch) == [("link.nc", "accepted")]
    (tmp_path / "elsewhere.nc").write_text(OTHER)
    assert looked(watch) == [("link.nc", "accepted")]
    assert (tmp_path / "elsewhere.nc").read_text() == OTHER
    assert (posted / "link.nc").is_symlink()


def test_its_own_output_is_no_input(posted):
    watch = watch_of(posted, 0.0)
    (posted / "a.nc").write_text(PROGRAM)
    looked(watch)
    made = posted / "corrected/a.nc/a.nc"
    corrected = made.read_bytes()
    assert looked(watch) == []
    (posted / "copy.nc").write_bytes(corrected)
    (posted / "link.nc").symlink_to(made)
    found = {item.name: item for item in watch.look(0.0)}
    assert "corrected" in found["copy.nc"].reasons[0]
    assert found["link.nc"].reasons == ("it is a link to a file that this command writes",)
    assert {item.state for item in found.values()} == {"refused"}
    assert made.read_bytes() == corrected


@pytest.mark.parametrize("out", [".", ".."])
def test_results_may_not_go_where_they_would_be_read(posted, out):
    with pytest.raises(InputError, match="choose another folder"):
        FolderWatch(posted, posted / out, correct)


def test_what_is_no_program_is_left_alone(posted):
    for name in ("a.nc.tmp", ".a.nc", "a.nc~", "b.NC.PART", "sheet.pdf"):
        (posted / name).write_text(PROGRAM)
    os.mkfifo(posted / "pipe.nc")
    assert looked(watch_of(posted, 0.0, match=("*.nc", "*.tap"))) == []


def test_a_folder_that_is_away_for_a_while_is_no_deletion(posted):
    watch = watch_of(posted, 0.0)
    (posted / "a.nc").write_text(PROGRAM)
    looked(watch)
    posted.rename(posted.with_name("away"))
    with pytest.raises(InputError, match="cannot be read"):
        looked(watch)
    posted.with_name("away").rename(posted)
    assert looked(watch) == []


def test_a_result_that_cannot_be_written_is_said(posted):
    (posted / "corrected").mkdir()
    (posted / "corrected/a.nc").write_text("of somebody")
    for name, text in (("a.nc", PROGRAM), ("b.nc", PROGRAM)):
        (posted / name).write_text(text)
    first, second = watch_of(posted, 0.0).look(0.0)
    assert (first.state, first.file, second.state) == ("refused", None, "accepted")
    assert "is a file" in first.reasons[0]
    assert (posted / "corrected/a.nc").read_text() == "of somebody"


@pytest.mark.parametrize("name", ["correction.json", "preflight.md"])
def test_a_program_named_as_a_result_is_refused(posted, name):
    (posted / name).write_text(PROGRAM)
    with pytest.raises(InputError, match="rename the program"):
        correct(posted / name, posted / "out")


# --- the command -----------------------------------------------------------------------------------------------------


def words(posted, *more):
    return (
        "correct",
        "zha-gantry",
        "--watch",
        posted,
        "--errors",
        ERRORS,
        "--dialect",
        "fanuc",
        "--wcs",
        "G54=-9,-9,-9",
        *more,
    )


def test_once_says_what_became_of_each_program(call, posted):
    (posted / "good.nc").write_text(PROGRAM)
    code, out, _ = call(*words(posted, "--once"))
    assert code == 0
    assert "good.nc: accepted, " in out
    (posted / "bad.nc").write_text(REFUSED)
    code, out, error = call(*words(posted, "--once", "--json"))
    found = json.loads(out)
    assert (code, found["accepted"]) == (1, False)
    assert [(item["program"], item["state"]) for item in found["programs"]] == [
        ("bad.nc", "refused"),
        ("good.nc", "accepted"),
    ]
    assert "bad.nc: refused: bad.nc:5: G41.3" in error.replace("\n", "")
    assert call(*words(posted, "--once", "--match", "g*"))[0] == 0


def test_ctrl_c_ends_the_watch_with_0(call, posted, monkeypatch):
    """The signal comes when the first program is done: it is sent by the wait between two looks."""
    (posted / "a.nc").write_text(PROGRAM)
    waits, waited = [], threading.Event.wait

    def wait(self, timeout=None):
        waits.append(timeout)
        if (posted / "corrected/a.nc/a.nc").exists() or len(waits) > 1000:
            os.kill(os.getpid(), signal.SIGINT)
        return waited(self, timeout)

    monkeypatch.setattr(threading.Event, "wait", wait)
    before = signal.getsignal(signal.SIGINT)
    code, out, error = call(*words(posted, "--settle-s", "0.1"))
    assert (code, error) == (0, "")
    assert out.splitlines()[-1] == "1 accepted"
    assert signal.getsignal(signal.SIGINT) is before


def test_two_watches_of_a_folder_exclude_each_other(call, posted):
    (posted / "corrected").mkdir()
    with exclusive(posted / "corrected/.watch.lock"):
        code, _, error = call(*words(posted, "--once"))
    assert code == 2
    assert "is kept by process" in error


def test_a_restart_says_what_is_unchanged_and_ends_as_before(call, posted, tmp_path):
    """Other options, other errors: again. The exit code is that of the state, not of the work."""
    (posted / "good.nc").write_text(PROGRAM)
    (posted / "bad.nc").write_text(REFUSED)
    assert call(*words(posted, "--once"))[0] == 1
    code, out, error = call(*words(posted, "--once"))
    assert code == 1
    assert "good.nc: accepted before, unchanged" in out
    assert "bad.nc: refused, as before: bad.nc:5" in error
    (posted / "bad.nc").unlink()
    errors = tmp_path / "e.errors.csv"
    errors.write_text(ERRORS.read_text())
    unchanged = []
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib/O7.nc").write_text("O7")
    called = ("--subprograms", tmp_path / "lib")
    for more in ((), ("--tolerance-um", "2"), ("--errors", errors), ("--errors", errors), ("--wcs", "G55=0,0,0")):
        found = json.loads(call(*words(posted, "--once", "--json", *more))[1])
        unchanged.append(found["programs"][0]["unchanged"])
    assert unchanged == [True, False, False, True, False]
    for text in ("O7", "O7 (changed)"):
        (tmp_path / "lib/O7.nc").write_text(text)
        found = [json.loads(call(*words(posted, "--once", "--json", *called))[1])["programs"][0] for _ in range(2)]
        assert [item["unchanged"] for item in found] == [False, True]
    call(*words(posted, "--once", "--errors", errors))
    errors.write_text(errors.read_text() + "\n")
    found = json.loads(call(*words(posted, "--once", "--json", "--errors", errors))[1])
    assert not found["programs"][0]["unchanged"]


def test_changed_errors_are_read_again(tmp_path, call, posted, monkeypatch):
    """Two programs in one pass; the errors are doubled between them, and the second is corrected by twice as much."""
    from compgen.cli import program_commands

    errors = tmp_path / "e.errors.csv"
    errors.write_text("error,position_mm,value,u_value\nEXX,-700,10,1\nEXX,700,10,1\n")
    for name in ("a.nc", "b.nc"):
        (posted / name).write_text(PROGRAM)
    say = program_commands._say_program

    def said(item, as_json):
        say(item, as_json)
        errors.write_text(errors.read_text().replace(",10,", ",20,"))

    monkeypatch.setattr(program_commands, "_say_program", said)
    code, _, error = call(*words(posted, "--once", "--errors", errors))
    assert code == 0
    assert "were read again" in error
    texts = [(posted / "corrected" / name / name).read_text() for name in ("a.nc", "b.nc")]
    assert ["G1 X-20.01 " in texts[0], "G1 X-20.02 " in texts[1]] == [True, True]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--once",), "give the folder with --watch"),
        (("p.nc", "--out", "o", "--match", "*"), "give the folder with --watch"),
        (("p.nc", "--watch", "."), "exclude each other"),
        (("--watch", "no-such-folder"), "one that exists"),
        (("--watch", ".", "--out", "."), "choose another folder"),
        (("--watch", ".", "--tolerance-um", "0"), "above 0"),
        (("--watch", ".", "--wcs", "G54=1"), "is no work offset"),
        ((), "Missing argument 'PROGRAM'"),
        (("p.nc",), "Missing option '--out'"),
    ],
)
def test_wrong_use_is_said_before_anything_is_corrected(call, posted, monkeypatch, more, message):
    monkeypatch.chdir(posted)
    (posted / "p.nc").write_text(PROGRAM)
    code, _, error = call("correct", "zha-gantry", "--errors", ERRORS, *more)
    assert code == 2
    assert message in error.replace("\n", " ")
    assert names(posted) == ["p.nc"]
