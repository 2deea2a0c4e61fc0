"""What users install: the wheel holds the package, every file of the data folders and both licences; pins have hashes."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from compgen.resources import VERSION, data_folder

ROOT = Path(__file__).resolve().parents[1]
DATA_FOLDERS = ("templates", "machines")
COPIED = ("compgen", *DATA_FOLDERS, "pyproject.toml", "hatch_build.py", "README.md", "LICENSE", ".gitignore")


def build_wheel(folder):
    """Build the project in ``folder`` and return the path of its wheel."""
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder / "out"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (folder / "out").glob("compgen-*.whl")
    return wheel


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
def wheel(project):
    return build_wheel(project)


@pytest.fixture(scope="module")
def wheel_names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


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


def test_the_wheel_names_both_licences_and_holds_their_texts(wheel, wheel_names):
    (folder,) = {name.split("/")[0] for name in wheel_names if ".dist-info/" in name}
    with zipfile.ZipFile(wheel) as archive:
        metadata = archive.read(f"{folder}/METADATA").decode()
        texts = {name: archive.read(name).decode() for name in wheel_names if "/licenses/" in name}
    assert "\nLicense-Expression: BSD-3-Clause AND GPL-2.0-or-later\n" in metadata
    copying = [f"templates/{name}/COPYING" for name in ("linuxcnc-volumetric", "linuxcnc-heat")]
    assert texts == {f"{folder}/licenses/{name}": (ROOT / name).read_text() for name in ("LICENSE", *copying)}
    assert {f"compgen/_data/{name}" for name in copying} <= set(wheel_names)  # beside the sources that they belong to


def pins(name):
    """Versions and number of hashes by package of a requirements file; each entry ends where the next begins."""
    found = {}
    for line in (ROOT / name).read_text().splitlines():
        if entry := re.match(r"([A-Za-z0-9._-]+)(?:\[.*\])?==([^ ;]+)", line):
            package = re.sub("[-_.]+", "-", entry[1]).lower()
            assert package not in found or " ; " in line  # one version for each range of Python versions
            found[package] = [entry[2], 0]
        elif re.fullmatch(r" +--hash=sha256:[0-9a-f]{64}( \\)?", line):
            found[package][1] += 1
        else:
            assert line.strip().startswith("#"), line
    return found


def named(texts):
    """The packages that requirements are about, as their pins are named."""
    return {re.sub("[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", text)[0]).lower() for text in texts}


def test_every_dependency_is_pinned_with_the_hashes_of_its_files():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    optional = [text for extra in project["project"]["optional-dependencies"].values() for text in extra]
    kinds = ("", "-extras", "-dev", "-docs", "-release")
    base, extras, dev, docs, release = (pins(f"requirements{kind}.txt") for kind in kinds)
    assert named([*project["project"]["dependencies"], *project["build-system"]["requires"]]) <= set(base)
    # the demo draws: matplotlib is an extra of the package, and among the pins of `make demo`
    assert named(optional) - {"compgen", "matplotlib"} <= set(extras) - set(base)
    assert "matplotlib" in base
    run = base | extras
    assert all(extras[name] == base[name] for name in base.keys() & extras.keys())
    assert {"pytest", "ruff", "mypy"} <= set(dev) - set(run)
    assert all(dev[name] == pin for name, pin in run.items())
    assert all(count >= 1 for _, count in [*dev.values(), *docs.values(), *release.values()])
    assert {"build", "hatchling", "pip-audit", "twine"} <= set(release)
    assert all(release[name] == dev[name] for name in release.keys() & dev.keys())
    assert {"sphinx", "myst-parser", "furo"} <= set(docs) - set(dev)
    assert all(docs[name] == run[name] for name in docs.keys() & run.keys())
    assert run["numpy"][1] > 20  # the wheels of all platforms, not of one


def test_a_pin_has_the_extras_that_other_packages_ask_for():
    """With hashes pip refuses `coverage[toml]` where only `coverage` is pinned, as soon as there is a newer release."""
    text = (ROOT / "requirements-dev.txt").read_text()
    pinned = dict(re.findall(r"^([a-z0-9._-]+)(?:\[(.*)\])?==", text, re.MULTILINE))
    asked = 0
    for name in pinned:
        try:
            requirements = [Requirement(item) for item in metadata.requires(name) or ()]
        except metadata.PackageNotFoundError:  # of another system
            continue
        for item in requirements:
            if item.extras and (item.marker is None or item.marker.evaluate({"extra": ""})):
                assert item.extras <= set(pinned[item.name].split(",")), f"{name} asks for {item}"
                asked += 1
    assert asked >= 1  # pytest-cov asks for coverage[toml]


def test_make_installs_nothing_without_hashes():
    """The only other thing that pip gets is compgen itself, without its dependencies and with the pinned backend."""
    makefile = (ROOT / "Makefile").read_text()
    assert "pip install" not in makefile.replace("-m pip install --quiet --disable-pip-version-check", "", 1)
    assert "PIP_INSTALL" not in re.sub(r"^PIP\w* :=.*$", "", makefile, flags=re.MULTILINE)
    lines = re.findall(r"^\t\$\(PIP(?:_DOCS|_RELEASE)?\) (.*)$", makefile, re.MULTILINE)
    assert len(lines) == 9
    for line in lines:
        assert line.startswith("--require-hashes -r ") or line == "--no-build-isolation --no-deps -e ."


def test_the_bill_of_materials_comes_with_the_wheel_and_names_every_pin_that_compgen_runs_with(wheel, wheel_names):
    """CycloneDX in .dist-info/sboms; compared with the pins and the installed packages. If it differs: make sbom."""
    (name,) = (name for name in wheel_names if re.fullmatch(r"compgen-[^/]+\.dist-info/sboms/[^/]+\.cdx\.json", name))
    with zipfile.ZipFile(wheel) as archive:
        bill = json.loads(archive.read(name))
        assert name in archive.read(name.split("/")[0] + "/RECORD").decode()
    own = bill["metadata"]["component"]
    assert (bill["bomFormat"], bill["specVersion"], own["version"]) == ("CycloneDX", "1.6", VERSION)
    parts = {part["name"]: part for part in bill["components"] if part["type"] == "library"}
    base, extras = pins("requirements.txt"), pins("requirements-extras.txt")
    for package, part in parts.items():
        assert part["version"] == extras[package][0] and part["purl"] == f"pkg:pypi/{package}@{part['version']}"
    builds = named(re.findall(r"^[a-z-]+", (ROOT / "requirements.in").read_text(), re.MULTILINE))
    assert not builds & parts.keys()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {name for name, part in parts.items() if part["scope"] == "required"}
    assert named(project["dependencies"]) <= needed <= set(base)
    optional = [text for extra in project["optional-dependencies"].values() for text in extra]
    assert named(optional) - {"compgen"} <= set(parts) == set(extras)
    edges = {item["ref"]: item["dependsOn"] for item in bill["dependencies"]}
    assert parts["numpy"]["purl"] in edges[parts["scipy"]["purl"]] and parts["jinja2"]["purl"] in edges[own["purl"]]
    refs = {part["bom-ref"] for part in bill["components"]} | {own["bom-ref"]}
    assert edges.keys() | {ref for others in edges.values() for ref in others} <= refs


@pytest.mark.parametrize(
    ("answer", "status", "code", "said"),
    [
        ({"dependencies": [{"name": "numpy", "version": "2.0", "vulns": []}]}, 0, 0, "no known vulnerability"),
        (
            {
                "dependencies": [
                    {"name": "numpy", "version": "2.0", "vulns": [{"id": "CVE-1", "fix_versions": ["2.1"]}]}
                ]
            },
            1,
            1,
            "numpy 2.0: CVE-1, mended in 2.1",
        ),
        (None, 1, 0, "the vulnerability source osv was not reached: no route to host\nNOT AUDITED"),
    ],
)
def test_a_vulnerability_stops_a_release_and_a_source_that_is_not_reached_is_said(tmp_path, answer, status, code, said):
    audit = tmp_path / "pip-audit"
    text = "echo no route to host >&2" if answer is None else f"cat <<'END'\n{json.dumps(answer)}\nEND"
    audit.write_text(f"#!/bin/sh\n{text}\nexit {status}\n")
    audit.chmod(0o755)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = [ROOT / ".ci" / "audit", audit, "requirements-extras.txt"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env={"PATH": path})
    assert (done.returncode, said in done.stdout) == (code, True), done.stdout + done.stderr
