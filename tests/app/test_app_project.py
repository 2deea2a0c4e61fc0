"""The folder of a project: steps, revisions, undo, names of files; what several windows and processes do at once."""

import itertools
import json
import math
import re
import threading

import pytest

from compgen.app.contents import chain_picture, options_from, settings_of
from compgen.app.machine_text import with_value
from compgen.app.project import PROJECT, Project, StaleError, Step, file_name
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import CONTROLLERS
from compgen.data.machine import CHAINS, Chain, parse_machine
from compgen.errors import InputError


@pytest.fixture
def project(tmp_path):
    return Project.open(tmp_path / "mill")


def with_files(project, kind="measurement", **files):
    """Add a step whose folder has these files."""
    folder = project.new_folder(kind)
    for name, text in files.items():
        (project.folder / folder / f"{name}.txt").write_text(text)
    return project.add(Step(0, kind, f"step {folder}", folder=folder)).steps[-1]


@pytest.mark.parametrize(
    "given",
    ["../../etc/passwd", "..", ".", "", "/", "\\", "a/../..", "..\\..\\x", "\x00", "con", "AUX.csv", ".bashrc", "-rf", "x" * 500,
     "ä" * 200 + ".rtl", "a\nb.csv", "<script>.csv", "a b;rm -rf ~.csv", "\u202egnp.csv", "%2e%2e%2f", "~root"],
)  # fmt: skip
def test_names_of_uploaded_files_are_one_harmless_part(tmp_path, given):
    name = file_name(given)
    assert name
    assert not set(name) & set("/\\\0\n<>;~% \u202e")
    assert name[0] not in ".-"
    assert len(name.encode()) <= 121
    assert name.partition(".")[0].lower() not in ("con", "aux", "prn", "nul")
    (tmp_path / name).write_text("x")
    assert (tmp_path / name).resolve().parent == tmp_path


def test_a_folder_with_other_files_is_no_project(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="has 1 other files"):
        Project.open(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
    with pytest.raises(InputError, match="cannot be used as the folder of a project"):
        Project.open(tmp_path / "letter.txt")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"form": 1}', '{"form": 2, "revision": 1, "steps": []}',
                                  '{"form": 1, "revision": 0, "steps": [{"x": 1}]}'])  # fmt: skip
def test_a_damaged_list_of_steps_is_refused_and_kept(tmp_path, text):
    (tmp_path / PROJECT).write_text(text)
    with pytest.raises(InputError, match="project.json"):
        Project.open(tmp_path)
    assert (tmp_path / PROJECT).read_text() == text


def test_a_change_that_was_not_seen_is_refused(project):
    """Two windows show revision 0; the second one that changes something is told to reload."""
    project.add(Step(0, "numbers", "first", data={"numbers": {}}), 0)
    with pytest.raises(StaleError, match="another window"):
        project.add(Step(0, "numbers", "second", data={"numbers": {}}), 0)
    with pytest.raises(StaleError, match="another window"):
        project.undo(0)
    with pytest.raises(StaleError, match="another window"):
        Project.open(project.folder).check(0)
    assert [step.title for step in project.state().steps] == ["first"]


def test_many_windows_of_several_processes_lose_no_step(project):
    """Each has its own object, as another process would; every step arrives, with its own number and folder."""

    def work():
        own = Project.open(project.folder)
        for _ in range(5):
            with_files(own, a="x")

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    steps = project.state().steps
    assert [step.number for step in steps] == list(range(1, 21))
    assert len({step.folder for step in steps}) == 20
    assert project.state().revision == 20


def test_undo_takes_back_one_step_and_keeps_its_files(project):
    with_files(project, a="one")
    last = with_files(project, a="two")
    project.undo(project.state().revision)
    assert [step.number for step in project.state().steps] == [1]
    assert (project.folder / "undone" / last.folder / "a.txt").read_text() == "two"
    again = with_files(project, a="three")
    assert again.number == 2
    project.undo(project.state().revision)
    assert (project.folder / "undone" / f"{again.folder}-2" / "a.txt").read_text() == "three"
    project.undo(project.state().revision)
    with pytest.raises(InputError, match="no step to undo"):
        project.undo(project.state().revision)


def test_a_step_shows_no_file_outside_the_project(project, tmp_path):
    """A link in the folder of a step, and a list of steps that names another folder."""
    (tmp_path / "secret.txt").write_text("secret")
    step = with_files(project, a="x")
    (project.folder / step.folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    assert list(project.files_of(step)) == ["a.txt"]
    with pytest.raises(InputError, match="not in the folder"):
        project.path("../secret.txt")
    content = json.loads((project.folder / PROJECT).read_text())
    content["steps"][0]["folder"] = ".."
    (project.folder / PROJECT).write_text(json.dumps(content))
    with pytest.raises(InputError, match="not in the folder"):
        project.files_of(project.state().steps[0])


# --- machine files ----------------------------------------------------------------------------------------------------


def test_settings_are_changed_in_the_text_and_comments_stay(tmp_path):
    words = ["init", "m", "--chain=WXYFZT", "--travel=X=0..600", "--travel=Y=0..400", "--travel=Z=0..500"]
    controls = [f"--control={name}" for name in sorted(CONTROLLERS)]
    assert run_command(cli, [*words, *controls, f"--out={tmp_path}"]) == 0
    text = (tmp_path / "m.toml").read_text()
    changed = with_value(text, "controllers.siemens-cec", "sign", '"correction"')
    changed = with_value(changed, "controllers.siemens-cec", "mult_mode", '"S2"')
    changed = with_value(changed, "controllers.pmac", "counts_per_mm", "{ X = 1000.0, Y = 1000.0, Z = 2000.0 }")
    changed = with_value(changed, "", "reference_point_mm", "[1.0, 2.0, 3.0]")
    machine = parse_machine(changed, "m.toml")
    assert machine.reference_point_mm == (1.0, 2.0, 3.0)
    values = {item.key: item.value for item in settings_of(changed, "siemens-cec")}
    assert (values["sign"], values["mult_mode"], values["profile"]) == ("correction", "S2", "")
    assert CONTROLLERS["pmac"].read_settings(machine)
    before, after = text.splitlines(), changed.splitlines()
    assert len(before) == len(after)
    differing = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(differing) == 5  # four values, and the header of a section that was a comment
    assert all(a.partition(" # ")[2].partition(" # ")[2] in b for a, b in differing)
    unset = with_value(changed, "controllers.siemens-cec", "sign", "")
    assert {item.key: item.value for item in settings_of(unset, "siemens-cec")}["sign"] == ""


def test_answers_become_the_options_of_import():
    options = options_from(["--axis=X", "--unit=deviation=um", "--unit=position=mm", "--ignore=a", "--ignore=b"])
    assert (options.axis, options.ignore) == ("X", ("a", "b"))
    assert options.units == {"deviation": "um", "position": "mm"}


@pytest.mark.parametrize("name", ["WCAYFXZT", "WCYFXZBT", "WXYFZCBT", "WFXYZCAT", "WCBXYZFT", "WBXFYZCAT"])
def test_the_drawing_shows_what_turns(name):
    drawing = chain_picture(Chain(name))
    letters = [letter for letter in name if letter in "XYZABC"]
    assert sorted(re.findall(r">([A-Z])</text>", drawing)) == sorted(letters)
    # what turns is drawn with an arc, what moves with a line
    assert len(re.findall(r'class="arrow" d="M[\d.]+ [\d.]+A', drawing)) == len(Chain(name).rotary)
    points = [
        tuple(map(float, pair.split(","))) for part in re.findall(r'points="([^"]+)"', drawing) for pair in part.split()
    ]
    assert all(0 <= x <= 380 and 0 <= y <= 280 for x, y in points)
    # bodies are drawn from the foundation: those that carry the tool, then those that carry the workpiece
    bodies = [int(found) for found in re.findall(r'"axis(\d) front"', drawing)]
    left, _, right = name[1:-1].partition("F")
    assert bodies == ["XYZABC".index(letter) for letter in right + left[::-1]]


@pytest.mark.parametrize("name", CHAINS)
def test_the_drawing_has_an_arrow_for_each_axis_and_stays_within_its_frame(name):
    drawing = chain_picture(Chain(name))
    assert [drawing.count(f">{letter}</text>") for letter in "XYZ"] == [1, 1, 1]
    points = [
        tuple(map(float, pair.split(","))) for part in re.findall(r'points="([^"]+)"', drawing) for pair in part.split()
    ]
    assert all(0 <= x <= 380 and 0 <= y <= 280 for x, y in points)
    letters = [(float(x), float(y)) for x, y in re.findall(r'<text x="([\d.]+)" y="([\d.]+)">[XYZ]<', drawing)]
    assert min(math.dist(a, b) for a, b in itertools.combinations(letters, 2)) > 20

    def covers(corners, x, y):
        """Whether a point is inside a polygon: an odd number of its sides is crossed to the right."""
        ends = zip(corners, [*corners[1:], corners[0]], strict=True)
        return sum((b > y) != (d > y) and x < (c - a) * (y - b) / (d - b) + a for (a, b), (c, d) in ends) % 2 == 1

    faces = [
        (kind.split()[0], [tuple(map(float, pair.split(","))) for pair in corners.split()])
        for kind, corners in re.findall(r'<polygon class="([^"]+)" points="([^"]+)"', drawing)
    ]
    found = re.findall(r'class="leader" d="M([\d.]+) ([\d.]+)L.*?>([XYZ])</text>', drawing)
    assert [letter for *_, letter in found] == ["XYZ"[axis] for axis in Chain(name).tool_side]
    for x, y, letter in found:  # the line of an arrow begins where its own body is seen
        seen = [kind for kind, corners in faces if covers(corners, float(x), float(y))]
        assert seen[-1] == f"axis{'XYZ'.index(letter)}"
