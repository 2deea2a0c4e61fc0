"""What users install: the wheel holds the package and every file of the data folders."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from compgen.resources import data_folder

ROOT = Path(__file__).resolve().parents[1]
DATA_FOLDERS = ("templates", "machines")
COPIED = ("compgen", *DATA_FOLDERS, "pyproject.toml", "README.md", "LICENSE", ".gitignore")


def build_wheel(folder):
    """Build the project in ``folder`` and return the names of the files in its wheel."""
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder / "out"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (folder / "out").glob("compgen-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def missing_data(folder, names):
    """Files of the data folders below ``folder`` that are not where an installed package looks for them."""
    files = [path.relative_to(folder) for kind in DATA_FOLDERS for path in (folder / kind).rglob("*") if path.is_file()]
    return sorted(str(path) for path in files if f"compgen/_data/{path.as_posix()}" not in names)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of what a build needs, so that nothing of it lands in the checkout."""
    folder = tmp_path_factory.mktemp("wheel") / "project"
    folder.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel_names(project):
    return build_wheel(project)


def test_every_file_of_the_data_folders_is_in_the_wheel(project, wheel_names):
    assert any((project / "machines").rglob("*.toml"))
    assert missing_data(project, wheel_names) == []


def test_every_module_and_the_typing_marker_are_in_the_wheel_and_nothing_else(project, wheel_names):
    sources = {path.relative_to(project).as_posix() for path in (project / "compgen").rglob("*") if path.is_file()}
    assert "compgen/py.typed" in sources
    assert sources <= wheel_names
    others = {name for name in wheel_names - sources if ".dist-info/" not in name}
    assert {name for name in others if not name.startswith("compgen/_data/")} == set()


def test_a_data_file_that_the_wheel_lacks_is_noticed(project, wheel_names):
    forgotten = project / "templates" / "forgotten.j2"
    forgotten.write_text("x")
    try:
        assert missing_data(project, wheel_names) == ["templates/forgotten.j2"]
    finally:
        forgotten.unlink()


def test_a_data_folder_that_is_nowhere_is_named_with_both_places():
    assert data_folder("machines") == ROOT / "machines"
    with pytest.raises(FileNotFoundError, match=r"no folder 'recipes' in .*_data.recipes or .*: the installation is"):
        data_folder("recipes")
