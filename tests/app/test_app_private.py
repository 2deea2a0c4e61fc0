"""Other users of the computer: the token on no command line, files that only their owner reads, processes that are stopped."""

import io
import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")

import app_site as helper

from compgen.app import pages, project
from compgen.app.project import Project, Step
from compgen.data import files
from compgen.errors import InputError
from compgen.fleet.dashboard.users import Users
from compgen.web.site import LocalSite

PITCH = b"axis,position_mm,direction,run,deviation_um\nX,-800,1,1,1\nX,0,1,1,2\n"
posix = pytest.mark.skipif(os.name != "posix", reason="modes of files mean nothing on this system")


@pytest.fixture
def mask():
    """A umask that hides nothing."""
    before = os.umask(0)
    yield
    os.umask(before)


def mode(path):
    return stat.S_IMODE(path.lstat().st_mode)


# --- the token --------------------------------------------------------------------------------------------------------


@posix
def test_the_browser_is_called_with_a_private_file_and_never_with_the_token(tmp_path, mask):
    """As another user would look: at the words of the browser, at the modes of what they name."""
    seen = tmp_path / "seen"
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {seen}.part\nmv {seen}.part {seen}\n')
    browser.chmod(0o755)
    variables = {
        **os.environ,
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "TMPDIR": str(tmp_path),
        "PYTHONUNBUFFERED": "1",
    }
    words = [sys.executable, "-m", "compgen", "app", str(tmp_path / "project")]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, env={**variables, "BROWSER": f"{browser} %s"}
    ) as process:
        token = re.search(r"token=(\S+)", process.stdout.readline())[1]
        helper.until(seen.exists)
        (address,) = seen.read_text().split()
        page = Path(address.removeprefix("file://"))
        assert address.startswith("file:///")
        assert token not in seen.read_text()
        assert token in page.read_text()
        assert (mode(page), mode(page.parent)) == (0o600, 0o700)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=helper.PATIENCE_S)
    assert not page.parent.exists()


def test_the_private_file_is_gone_once_its_token_has_been_used(tmp_path, monkeypatch):
    """The page that the browser gets then goes on by itself: it would send no new cookie where it is redirected to."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    site = helper.Site(tmp_path / "project", start=False)
    address = f"{site.url}/start?token={site.workbench.ticket}"
    with pages.start_file(site.workbench, address) as shown:
        page = Path(shown.removeprefix("file://"))
        target = re.search(r'content="0; url=([^"]+)"', page.read_text())[1].replace("&amp;", "&")
        assert target == f"{address}&from=file"
        assert site.get("/start?token=wrong&from=file").status_code == 403
        assert page.exists()
        answer = site.get(target.removeprefix(site.url), headers={"Sec-Fetch-Site": "cross-site"})
        assert not page.exists()
        assert (answer.status_code, answer.mimetype) == (200, "text/html")
        assert '<meta http-equiv="refresh" content="0; url=/projects/1/">' in answer.text
        assert "SameSite=Strict" in answer.headers["Set-Cookie"]
        assert site.get("/projects/1/machine").status_code == 200
        assert site.get(target.removeprefix(site.url)).status_code == 403
    site.workbench.close()


def test_where_browsers_are_snaps_the_file_is_where_they_may_read(tmp_path, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    workbench = pages.Workbench(LocalSite(8765))
    monkeypatch.setattr(pages.Path, "home", lambda: home)
    monkeypatch.setattr(pages, "SNAPS", tmp_path)
    with pages.start_file(workbench, "http://127.0.0.1:1/start?token=x") as shown:
        page = Path(shown.removeprefix("file://"))
        assert page.parent.parent == home
        assert not page.parent.name.startswith(".")
    assert list(home.iterdir()) == []


# --- files of projects ------------------------------------------------------------------------------------------------


@posix
def test_everything_in_a_project_belongs_to_its_user_alone(tmp_path, monkeypatch, mask):
    """What the pages write, what is uploaded, and what commands write."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "project").mkdir(mode=0o755)
    site = helper.Site(tmp_path / "project")
    site.do("machine/choose", {"machine": "zha-gantry"})
    site.do("measurement/add", {"files": [(io.BytesIO(PITCH), "x.axis.csv")]})
    site.do("identify")
    site.do("undo")
    site.project.keep(io.BytesIO(b"G0 X0\n"), f"{site.project.new_folder('program')}/given/program/p.nc")
    found = [site.project.folder, *site.project.folder.rglob("*")]
    assert {path.name for path in found} >= {"project.json", "identified.errors.csv", "p.nc", ".project.lock", "undone"}
    for path in found:
        assert mode(path) == (0o700 if path.is_dir() else 0o600), path
    assert mode(pages._recent_file()) == 0o600
    site.workbench.close()


@posix
@pytest.mark.parametrize(
    ("before", "after"), [(0o600, 0o600), (0o640, 0o640), (0o644, 0o644), (0o444, 0o644), (0o666, 0o644)]
)
def test_a_file_that_is_written_again_is_shown_to_nobody_more(tmp_path, before, after):
    """A job file with a password of mode 0600 stays so when a machine is added to it."""
    path = tmp_path / "recal.toml"
    path.write_text("old")
    path.chmod(before)
    mask = os.umask(0o022)
    files.write_file(path, "new")
    os.umask(mask)
    assert (path.read_text(), mode(path)) == ("new", after)


@posix
def test_the_users_of_the_dashboard_are_in_a_private_file(tmp_path, mask):
    users = Users(tmp_path / "users.json")
    users.add("meyer", "correct horse battery")
    assert mode(users.path) == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["users.json"]


# --- a process that is stopped ----------------------------------------------------------------------------------------

KEEPER = """
import sys, time
from compgen.app.project import Project
with Project.open(sys.argv[1])._alone():
    print("kept", flush=True)
    time.sleep(600)
"""


def test_a_change_does_not_wait_for_ever_for_a_stopped_process_and_names_it(tmp_path, monkeypatch):
    monkeypatch.setattr(project, "LOCK_S", 0.1)
    made = Project.open(tmp_path / "project")
    made.add(Step(0, "numbers", "first", data={"numbers": {}}))
    words = [sys.executable, "-c", KEEPER, str(made.folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "kept\n"
        process.send_signal(signal.SIGSTOP)
        said = rf"process {process.pid} \(.*which is stopped\), also after 0.1 s; nothing was changed"
        for change in (
            lambda: made.new_folder("plan"),
            lambda: made.undo(1),
            lambda: made.add(Step(0, "identify", "x")),
        ):
            with pytest.raises(InputError, match=said):
                change()
        assert made.state().revision == 1
        process.kill()
    made.undo(1)
    assert made.state().steps == ()
