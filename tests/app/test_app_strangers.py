"""A project of somebody else is data: whatever its files contain, no code of it runs, and nothing outside is read or written."""

import io
import json
import os
import random
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")

import app_site as helper

from compgen.app import pages, project
from compgen.app.project import PROJECT, Project, environment
from compgen.app.steps import COMMANDS, KINDS, Command, Step, read_steps
from compgen.cli import cli
from compgen.controls import CONTROLLERS
from compgen.errors import InputError

MACHINE = helper.ROOT / "machines" / "zha-gantry.toml"
PITCH = b"axis,position_mm,direction,run,deviation_um\nX,-800,1,1,1\nX,0,1,1,2\n"


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = helper.Site(tmp_path / "project")
    yield made
    made.workbench.close()


def measurement(number=2, **more):
    """A step with a measurement file, as the pages record it."""
    path = f"{number:02d}-measurement/x.axis.csv"
    summary = {"file": path, "format": "compgen", "kind": "axis", "understood": {"axis": "X", "columns": {"X": "axis"}},
               "doubts": [], "notes": ["read"], "machine": {"name": "m", "outside": []}, "files": []}  # fmt: skip
    data = {"file": path, "used": [path], "summary": summary, "answers": ["--axis=X"], "after": False, **more}
    words = [
        "import",
        path,
        "--axis=X",
        "--json",
        "--out",
        f"{number:02d}-measurement/read",
        "--machine",
        "01-machine/m.toml",
    ]
    return {"number": number, "kind": "measurement", "title": "x.axis.csv", "commands": [words],
            "folder": f"{number:02d}-measurement", "exit_code": 0, "seconds": 0.5, "time": "2026-01-01T00:00:00+00:00",
            "warnings": ["a warning"], "data": data}  # fmt: skip


def every_kind():
    """A project with a step of each kind, its commands with every option that the pages give them."""
    out = "--out"
    fit = ["--smoothness=1", "--max-abs=linear=20", "--robust"]
    known = ["--squareness=EC0Y=25", "--backlash=X=3", "--scale=X=1", "--instrument=03-instrument/i.toml"]
    shown = {
        "machine": ([["check", "01-machine/m.toml", "--kind", "machine", "--json"]], {
            "machine": "01-machine/m.toml", "by_hand": ["# 01-machine/m.toml: edited"], "remarks": ["said"], "meaning": "X"}),
        "instrument": ([["check", "03-instrument/i.toml", "--kind", "instrument", "--json"]], {"file": "03-instrument/i.toml"}),
        "plan": ([["plan", "01-machine/m.toml", "--circle=XY:150", "--poses=0,0,0", "--artefact=04-plan/given/a.toml", out,
                   "04-plan"]], {"typed": {"circles": "XY:150", "poses": "0,0,0"}}),
        "removed": ([], {"measurement": 2, "after": False}),
        "numbers": ([], {"numbers": {"squareness": ["EC0Y=25"], "backlash": ["X=3"], "scale": ["X=1"]}}),
        "accuracy": ([["accuracy", "01-machine/m.toml", "02-measurement/x.axis.csv", out, "07-accuracy"]], {"sheet_of": 2}),
        "identify": ([["identify", "01-machine/m.toml", "02-measurement/x.axis.csv", *known, out, "08-identify"],
                      ["report", "08-identify", "--language", "de"]], {}),
        "diagnose": ([["diagnose", "01-machine/m.toml", "02-measurement/x.axis.csv", out, "09-diagnose"]], {}),
        "options": ([["options", "01-machine/m.toml", "08-identify/identified.errors.csv", out, "10-options"]], {}),
        "run": ([["run", "zha-gantry", "02-measurement/x.axis.csv", "--controller", "isg-csv", *fit, "--allow-misfit", out,
                  "11-tables", "--active=11-tables/given/active-1-a.csv"]], {"control": "isg-csv", "fit": {"smoothness": "1"}}),
        "verify": ([["verify", "zha-gantry", "12-verify/given/files-1-a.csv", "--controller", "isg-csv", "--errors",
                     "08-identify/identified.errors.csv", out, "12-verify"]], {"control": "isg-csv"}),
        "program": ([], {"program": "13-program/given/program/p.nc", "tools": "13-program/given/tools/t.csv",
                         "block-delete": True,
                         "typed": {"dialect": "fanuc", "wcs": "G54=0,0,0", "gauge": ""}, "by_hand": ["# p.nc: uploaded"]}),
        "part": ([["part", "zha-gantry", "13-program/given/program/p.nc", "--errors=08-identify/identified.errors.csv",
                   "--dialect=fanuc", "--wcs=G54=0,0,0", "--tools=13-program/given/tools/t.csv", "--block-delete", out,
                   "14-part"]], {}),
        "correct": ([["fit", "zha-gantry", "08-identify/identified.errors.csv", out, "15-correct/fit"],
                     ["correct", "zha-gantry", "13-program/given/program/p.nc", "--tolerance-um=2", out, "15-correct"]], {}),
        "compare": ([["compare", "zha-gantry", "08-identify", "08-identify", "--align=common", out, "16-compare"],
                     ["report", "16-compare", "--dcc=16-compare/given/certificate-1-c.toml"]], {}),
        "recal": ([["recal", "add", "mill", "--machine", "01-machine/m.toml", "--inbox", "inbox", "--controller", "isg-csv",
                    out, "recalibration", "--measured-with", "bare", "--job", "recal.toml"]],
                  {"added": "[machines.mill]\n", "machine_there": "mill"}),
        "certificate": ([["report", "08-identify", "--certificate=18-certificate/certificate.toml"]], {
            "certificate": "18-certificate/certificate.toml", "stated": {"order": "A-7", "instruments": "XL-80; 9\nLevel; L7"}}),
    }  # fmt: skip
    steps = []
    for number, kind in enumerate([*list(shown)[:1], "measurement", *list(shown)[1:]], start=1):
        if kind == "measurement":
            steps.append(measurement(number))
            continue
        commands, data = shown[kind]
        folder = f"{number:02d}-{'tables' if kind == 'run' else kind}" if commands and kind != "recal" else ""
        steps.append(
            {"number": number, "kind": kind, "title": kind, "commands": commands, "folder": folder, "data": data}
        )
    return {"form": 1, "revision": 17, "steps": steps}


def refusal(folder, content):
    """Why a project with this list of steps is refused, None if it is not."""
    folder.mkdir(exist_ok=True)
    (folder / PROJECT).write_text(content if isinstance(content, str) else json.dumps(content))
    try:
        Project.open(folder)
    except InputError as error:
        return str(error)
    return None


def places(value, at=()):
    """Every key and entry within JSON data."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*at, key)
        yield from places(item, (*at, key))


def changed(value, at, new):
    """A copy of JSON data with another value at one place."""
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = new
    return copy


#: Values for every field: options, paths that lead out, lines of a script, wrong types, too much of anything.
EVIL = (
    "--plugin=p.py", "-v", "--", "../../etc/passwd", "/etc/passwd", "01-machine/../../x.toml", "~/x.toml", "a//b", "C:\\x.toml",
    "x\ntouch PWNED", "# x\rtouch PWNED", "$(touch PWNED)", "`touch PWNED`.toml", "'; touch PWNED; '", "a\x00b", "\x1b[2J",
    "x" * 3000, 5, -1, 1e9, True, None, [], {}, [["--plugin=p.py"]], {"a": "--plugin=p.py"}, ["--plugin=p.py", "x"],
    ["recal", "run", "--job=recal.toml"], ["identify", "zha-gantry", "--plugin", "p.py"], [["run", "--templates=x"]],
)  # fmt: skip


def test_the_project_with_every_kind_of_step_is_read(tmp_path):
    assert refusal(tmp_path / "p", every_kind()) is None
    steps = Project.open(tmp_path / "p").state().steps
    assert {step.kind for step in steps} == {*KINDS}
    assert {" ".join(words[:2]) if words[0] == "recal" else words[0] for step in steps for words in step.commands} >= {
        *COMMANDS
    } - {"init"}


def is_harmless(folder):
    """What is read of a project that was not refused can do nothing but what the pages do."""
    made = Project.open(folder)
    for step in made.state().steps:
        for words in step.commands:
            command = Command.of(words)
            started = command.started
            assert not any(word.startswith(("--plugin", "--templates", "--machines", "--job=/")) for word in started)
            assert all(word.startswith("--") for word in started[len(command.name.split()) : started.index("--")])
            assert not any(path.startswith(("/", "~", "-")) or ".." in path.split("/") for path in command.paths)
    for line in made.script().splitlines():
        words = shlex.split(line, comments=True)
        assert words[:1] in ([], ["set"], ["cd"], ["volcomp"]), line
        assert not any(ord(char) < 32 or ord(char) == 127 for char in line), line


@pytest.mark.parametrize("seed", range(4))
def test_every_field_of_every_step_is_refused_or_harmless(tmp_path, seed):
    """Each place of the file gets values that attack; a fourth of all in each of the four."""
    good, folder = every_kind(), tmp_path / "p"
    refused = count = 0
    every = [(at, new) for at in places(good) for new in EVIL]
    for at, new in random.Random(1).sample(every, len(every))[seed::40]:
        said = refusal(folder, changed(good, at, new))
        count += 1
        if said is None:
            is_harmless(folder)
        else:
            refused += 1
            assert PROJECT in said
    assert refused > count / 2


@pytest.mark.parametrize(
    ("at", "new", "said"),
    [
        (("steps", 0, "data", "machine"), "--plugin=p.py", "letters, digits"),
        (("steps", 0, "data", "machine"), "../m.toml", "not in the folder of the project"),
        (("steps", 1, "data", "file"), "/etc/passwd", "not in the folder of the project"),
        (("steps", 1, "data", "used", 0), "--plugin=p.py", "not in the folder of the project"),
        (("steps", 1, "data", "answers", 0), "--plugin=p.py", "an option of volcomp import"),
        (("steps", 7, "commands", 0), ["identify", "--plugin", "p.py"], "not an option that the workbench gives"),
        (("steps", 7, "commands", 0), ["schema", "machine"], "not a command of the workbench"),
        (("steps", 7, "commands", 0), ["check", "01-machine/m.toml"], "does not belong to a step"),
        (("steps", 7, "kind"), "shell", "kind of step"),
        (("steps", 7, "more"), 1, "is not a known key"),
        (("steps", 7, "data", "more"), 1, "is not a known key"),
        (("steps", 7, "folder"), "07-accuracy", "folder with the number"),
        (("steps", 4, "number"), 3, "numbers that grow"),
        (("steps", 10, "data", "control"), "--plugin=p.py", "letters, digits"),
        (("steps", 10, "data", "fit"), {"plugin": "p.py"}, "keys of smoothness"),
        (("steps", 5, "data", "numbers"), {"plugin": ["p.py"]}, "keys of squareness"),
        (("revision",), "1", "whole number"),
        (("form",), 2, "this program reads form 1"),
        (("more",), [], "is not a known key"),
    ],
)
def test_what_the_pages_do_not_write_is_refused_with_its_place(tmp_path, at, new, said):
    found = refusal(tmp_path / "p", changed(every_kind(), at, new))
    assert found is not None
    assert said in found


@pytest.mark.parametrize(
    "content",
    ["[" * 100_000, '{"form": ' * 5_000, '{"form": 1, "revision": 1e999, "steps": []}',
     '{"form": 1, "revision": NaN, "steps": []}',
     '{"form": 1, "revision": ' + "9" * 5_000 + ', "steps": []}', '{"form": 1, "revision": 0, "steps": {}}',
     '{"form": [[]], "revision": 0, "steps": []}', '"form"', "null", "\ufeff{}"],
)  # fmt: skip
def test_text_that_is_no_list_of_steps_is_refused(tmp_path, content):
    assert PROJECT in str(refusal(tmp_path / "p", content))


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_a_list_of_steps_that_is_no_file_is_refused_without_waiting(tmp_path, kind):
    folder = tmp_path / "p"
    folder.mkdir()
    (tmp_path / PROJECT).write_text(json.dumps(every_kind()))
    path = folder / PROJECT
    {"link": lambda: path.symlink_to(tmp_path / PROJECT), "pipe": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    with pytest.raises(InputError, match="is not a file with the steps"):
        Project.open(folder)


def test_what_could_not_be_read_again_is_not_written(site):
    before = (site.project.folder / PROJECT).read_bytes()
    with pytest.raises(InputError, match="kind of step"):
        site.project.add(Step(0, "strange", "title"))
    assert (site.project.folder / PROJECT).read_bytes() == before


def test_every_option_that_a_step_may_have_is_one_of_its_command():
    """The list of options is kept beside the commands: a new name in it must exist there."""
    for called, syntax in COMMANDS.items():
        command = cli
        for part in called.split():
            command = command.commands[part]
            command = getattr(command, "loaded", command)
        known = {word for parameter in command.params for word in parameter.opts}
        assert {f"--{option}" for option in syntax.options} <= known, called
    assert {item.sample_setting for item in map(CONTROLLERS.__getitem__, CONTROLLERS)} == {
        None,
        "style_from",
        "template_from",
    }
    assert {"style-from", "template-from"} <= set(COMMANDS["run"].options)


# --- code beside the list of steps ------------------------------------------------------------------------------------


def plant(folder, marker):
    """Files that Python, numpy, numba, matplotlib or this program might take as code or as settings."""
    code = f"import builtins\nopen({str(marker)!r}, 'a').write(__name__ + chr(10))\n"
    for name in (
        "numpy",
        "click",
        "json",
        "scipy",
        "sitecustomize",
        "usercustomize",
        "encodings",
        "types",
        "p",
        "conftest",
    ):
        (folder / f"{name}.py").write_text(code)
    for name in ("compgen", "rich"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(code)
        (folder / name / "__main__.py").write_text(code)
    (folder / "x.pth").write_text(f"import p; open({str(marker)!r}, 'a').write('pth')\n")
    info = folder / "evil-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[compgen.controllers]\nevil = p:X\n[compgen.effects]\nevil = p:X\n")
    (folder / ".numba_config.yaml").write_text("cache_dir: .\n")
    (folder / "config.toml").write_text('machines = ["."]\n')
    (folder / "matplotlibrc").write_text("backend: module://p\n")
    (folder / "machines").mkdir()
    (folder / "machines" / "zha-gantry.toml").write_text("not = 'a machine'\n")
    (folder / "zha-gantry").mkdir()


def test_no_file_of_a_project_is_run_or_taken_as_settings(site, tmp_path, monkeypatch):
    """With an environment that names the working folder in every way in which it is named by accident."""
    folder, marker = site.project.folder, tmp_path / "PWNED"
    monkeypatch.chdir(tmp_path)
    with_measurement(site)
    plant(folder, marker)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", ".", str(folder), str(folder / "rich"), "project"]))
    monkeypatch.setenv("PYTHONSTARTUP", "p.py")
    monkeypatch.setenv("COMPGEN_CONFIG", "")
    content = json.loads((folder / PROJECT).read_text())
    content["steps"][0]["data"]["machine"] = "zha-gantry"  # the shipped one, not that of a folder "machines"
    (folder / PROJECT).write_text(json.dumps(content))
    state = site.do("identify")
    assert [step.kind for step in state.steps] == ["machine", "measurement", "identify"]
    assert "identified.errors.csv" in site.project.files_of(state.last("identify"))
    assert not marker.exists()
    assert sorted(path.name for path in folder.iterdir() if path.name[0].isdigit()) == [
        "01-machine",
        "02-measurement",
        "03-identify",
    ]


def test_the_environment_of_a_command_means_the_same_in_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "project"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "lib", str(folder), str(folder / "x"), "/opt/x"]))
    monkeypatch.setenv("COMPGEN_PLUGINS", os.pathsep.join(["a.py", "/opt/b.py"]))
    monkeypatch.setenv("COMPGEN_CONFIG", "c.toml")
    monkeypatch.setenv("PYTHONSTARTUP", "s.py")
    found = environment(folder)
    assert found["PYTHONPATH"] == os.pathsep.join([str(tmp_path / "lib"), "/opt/x"])
    assert found["COMPGEN_PLUGINS"] == os.pathsep.join([str(tmp_path / "a.py"), "/opt/b.py"])
    assert found["COMPGEN_CONFIG"] == str(tmp_path / "c.toml")
    assert "PYTHONSTARTUP" not in found
    monkeypatch.setenv("COMPGEN_CONFIG", "")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    assert environment(folder)["COMPGEN_CONFIG"] == ""
    assert "PYTHONPATH" not in environment(folder)


def test_a_project_in_which_python_looks_for_modules_is_not_opened(site, tmp_path, monkeypatch):
    folder = tmp_path / "other"
    Project.open(folder)
    for place in (folder, folder / "lib"):
        with monkeypatch.context() as patch:
            patch.syspath_prepend(place)
            answer = site.client.post("/open", base_url=site.url, headers={"Origin": site.url},
                                      data={"csrf": site.workbench.csrf, "folder": str(folder)})  # fmt: skip
            assert answer.status_code == 409
            assert "Python looks for modules in" in answer.text
    assert site.workbench.open(folder) == 2


def test_python_m_takes_no_module_and_no_plug_in_from_the_working_folder(tmp_path):
    """What Python itself loads before the program cannot be kept out by it: `python -P -m compgen`, or `volcomp`."""
    marker = tmp_path / "PWNED"
    plant(tmp_path, marker)
    for name in ("types.py", "encodings.py", "compgen"):
        path = tmp_path / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    words = [sys.executable, "-m", "compgen", "effects", "--json"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert not marker.exists()


# --- files and links --------------------------------------------------------------------------------------------------


def test_a_script_of_commands_has_comments_and_commands_only(site, tmp_path):
    """Every text of every step that goes into it, run by a shell that would notice."""
    content = every_kind()
    for step in content["steps"]:
        step["title"] = "x\ntouch PWNED\r\n$(touch PWNED)\u2028touch PWNED"
        if "by_hand" in step["data"]:
            step["data"]["by_hand"] = ["# x\ntouch PWNED", "touch PWNED", "\rtouch PWNED", "#\x1b[2J\u202etouch"]
    (site.project.folder / PROJECT).write_text(json.dumps(content))
    script = site.get("/projects/1/commands.sh").text
    is_harmless(site.project.folder)
    assert "\x1b" not in script and "\u202e" not in script and "\r" not in script
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "volcomp").write_text("#!/bin/sh\nexit 0\n")
    (tools / "volcomp").chmod(0o755)
    where = {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(["sh", "-c", script], cwd=tmp_path, env={**os.environ, **where}, check=True)
    assert not [path for path in tmp_path.rglob("PWNED*")]


def with_measurement(site):
    """A machine and a measurement, as their commands leave them."""
    made = site.project
    folder = made.new_folder("machine")
    shutil.copy(MACHINE, made.folder / folder / "m.toml")
    made.add(Step(0, "machine", "Machine m", folder=folder, data={"machine": f"{folder}/m.toml"}))
    folder = made.new_folder("measurement")
    (made.folder / folder / "x.axis.csv").write_bytes(PITCH)
    step = measurement()
    made.add(Step(0, "measurement", "x", step["commands"], folder, data=step["data"]))
    return made.state()


@pytest.mark.parametrize("what", ["file", "folder", "inner", "pipe"])
def test_no_command_reads_through_a_link_or_waits_for_a_pipe(site, tmp_path, what):
    state = with_measurement(site)
    folder = site.project.folder / "02-measurement"
    secret = tmp_path / "secret"
    shutil.copytree(folder, secret)
    if what == "folder":
        shutil.rmtree(folder)
        folder.symlink_to(secret)
    elif what == "inner":
        (folder / "x.axis.covariance.npz").symlink_to(secret / "x.axis.csv")
    else:
        (folder / "x.axis.csv").unlink()
        {"file": lambda: (folder / "x.axis.csv").symlink_to(secret / "x.axis.csv"),
         "pipe": lambda: os.mkfifo(folder / "x.axis.csv")}[what]()  # fmt: skip
    site.post("/projects/1/identify")
    (problem,) = site.runner.job.problems
    assert "leads out of the folder of the project" in problem or "is neither a file nor a folder" in problem
    assert site.project.state() == state
    for name in pages.PAGES:
        assert site.get(f"/projects/1/{name}").status_code in (200, 409)


def test_a_machine_file_of_a_project_names_no_file_elsewhere(site, tmp_path):
    """`style_from` and its like: their contents would go into the tables, and with them to whoever gets these."""
    (tmp_path / "secret").write_text("%\nN1\n%\n")
    before = with_measurement(site)
    head = "[controllers.fanuc-pitch]\n"
    for named in (str(tmp_path / "secret"), "../../secret"):
        changed = MACHINE.read_text().replace(head, f'{head}style_from = "{named}"\n')
        site.post("/projects/1/machine/text", {"text": changed})
        assert any("a project must not name files elsewhere" in item for item in site.runner.job.problems)
        assert site.project.state() == before


@pytest.mark.parametrize(
    "line",
    ['notify = ["sh", "-c", "touch PWNED"]', 'templates = "t"', 'store = "postgresql://evil/x"', 'store = "../x.sqlite"',
     '[defaults]\nnotify = ["sh"]', '[machines.a]\ninbox = "/etc"', '[machines.a]\nout = "~/x"', "[machines"],
)  # fmt: skip
def test_no_machine_is_added_to_a_job_file_that_does_more(site, line):
    with_measurement(site)
    path = site.project.folder / project.JOB
    path.write_text(f"{line}\n")
    answer = site.post("/projects/1/recal", {"name": "mill", "control": "isg-csv", "measured": "bare"})
    assert answer.status_code == 409
    assert path.read_text() == f"{line}\n"


def test_what_is_taken_back_is_not_moved_out_of_the_project(site, tmp_path):
    state = with_measurement(site)
    (tmp_path / "elsewhere").mkdir()
    (site.project.folder / "undone").symlink_to(tmp_path / "elsewhere")
    assert "is a link" in site.post("/projects/1/undo").text
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert (site.project.folder / state.steps[-1].folder / "x.axis.csv").is_file()


def test_a_page_in_a_step_has_no_origin_and_its_script_reaches_none_of_ours(site):
    """A page may have its own script, by the hash in its policy; whoever gave the project may have written both."""
    folder = site.project.new_folder("identify")
    evil = "<meta http-equiv=Content-Security-Policy content=\"script-src 'sha256-" + "A" * 44 + "'\">"
    (site.project.folder / folder / "report.html").write_text(f"<html><head>{evil}</head>")
    site.project.add(Step(0, "identify", "x", folder=folder))
    policy = site.get("/projects/1/steps/1/view/report.html").headers["Content-Security-Policy"].split("; ")
    assert "sandbox allow-scripts" in policy
    assert not any("allow-same-origin" in part or "allow-popups" in part for part in policy)


def test_names_in_an_archive_are_files_for_every_system(site):
    folder = site.project.new_folder("identify")
    for name in ("x\\..\\..\\y.bat", "NUL.txt", "a:b", "c\nd"):
        (site.project.folder / folder / name).write_text("x")
    site.project.add(Step(0, "identify", "x", folder=folder))
    names = zipfile.ZipFile(io.BytesIO(site.get("/projects/1/steps/1/files.zip").data)).namelist()
    assert sorted(names) == [f"{folder}/{name}" for name in ("_NUL.txt", "a_b", "c_d", "x_.._.._y.bat")]


@pytest.mark.parametrize(
    "content", ["[" * 50_000, "[]", '{"unobservable": 5, "u_deviation": [1], "identified": 3}', "nan", "\xff"]
)
def test_facts_that_no_command_wrote_are_said_not_a_fault_of_the_pages(site, content, capfd):
    """The other pages work, and the step can be taken back."""
    with_measurement(site)
    folder = site.project.new_folder("identify")
    (site.project.folder / folder / "identify.json").write_bytes(content.encode("latin-1"))
    site.project.add(Step(0, "identify", "x", folder=folder))
    for name in pages.PAGES:
        answer = site.get(f"/projects/1/{name}")
        assert answer.status_code == 200 or "take that step back" in answer.text, name
    assert site.get("/projects/1/project").status_code == 200
    site.do("undo")
    capfd.readouterr()


def test_steps_are_read_as_they_were_written(tmp_path):
    revision, steps = read_steps(json.dumps(every_kind()).encode(), Path("project.json"))
    assert revision == 17
    assert [step.number for step in steps] == list(range(1, 19))
