"""Imports point one way: a file imports from its own stage or an earlier one, and data folders hold data only."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: The stages in the order of the pipeline; those of one line may import each other.
ORDER = (
    ("errors", "resources", "registry", "units", "drawing", "language"),
    ("data",),
    ("new_machine",),
    ("kinematics",),
    ("effects",),
    ("instruments",),
    ("simulation",),
    ("heat",),
    ("identification",),
    ("planning",),
    ("fitting",),
    ("controls",),
    ("tables",),
    ("programs",),
    ("accuracy",),
    ("foreign",),
    ("diagnose",),
    ("pipeline", "plugins"),
    ("report",),
    ("web",),
    ("fleet",),
    ("app",),
    ("cli",),
    ("readers",),  # public names of several rooms, for scripts: none of the rooms uses it
    ("__main__",),
)
RANK = {stage: rank for rank, stages in enumerate(ORDER) for stage in stages}


def imported_modules(path, module, is_package):
    """Full names of everything that a file imports, also below functions; relative imports are resolved."""
    base = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parent = node.module or ""
            if node.level:
                above = base.split(".")[: len(base.split(".")) - node.level + 1]
                parent = ".".join([*above, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{parent}.{alias.name}") for alias in node.names)


def wrong_imports(root):
    """One line of text for each import below ``root``/compgen that points at a later stage or an unknown one."""
    found = []
    for path in sorted((root / "compgen").rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        module = ".".join(parts[:-1] if is_package else parts)
        if module == "compgen":
            continue
        stage = parts[1]
        if stage not in RANK:
            found.append(f"{path}: stage {stage!r} stands in no line of ORDER")
            continue
        for line, name in imported_modules(path, module, is_package):
            package, _, rest = name.partition(".")
            target = rest.partition(".")[0]
            if package == "compgen" and (target not in RANK or RANK[target] > RANK[stage]):
                found.append(f"{path}:{line}: {stage} imports {name}")
    return found


def test_no_file_imports_from_a_later_stage():
    assert wrong_imports(ROOT) == []


@pytest.mark.parametrize(
    ("where", "text", "caught"),
    [
        ("data/a.py", "from compgen.kinematics import c_matrix", True),
        ("data/a.py", "from compgen import kinematics", True),
        ("data/a.py", "import compgen.kinematics.exact_chain as e", True),
        ("data/a.py", "from ..kinematics import exact", True),
        ("data/a.py", "from .. import kinematics", True),
        ("kinematics/sub/a.py", "from ...cli import main", True),
        ("kinematics/__init__.py", "from ..tables import verify", True),
        ("errors.py", "def f():\n    from .kinematics import exact", True),
        ("resources.py", "import compgen", True),
        ("other/a.py", "", True),
        (
            "kinematics/a.py",
            "from compgen.data.names import AXES\nfrom ..data import names\nfrom .exact import rotate",
            False,
        ),
        ("kinematics/__init__.py", "from .exact import rotate\nfrom ..errors import InputError", False),
        ("data/a.py", "from compgen import errors, resources\nimport numpy", False),
        ("cli/a.py", "from compgen import report, tables", False),
        ("__init__.py", "from compgen.cli import main", False),
    ],
)
def test_the_check_catches_wrong_imports_and_only_those(tmp_path, where, text, caught):
    path = tmp_path / "compgen" / where
    path.parent.mkdir(parents=True)
    path.write_text(text)
    assert bool(wrong_imports(tmp_path)) is caught


@pytest.mark.parametrize("folder", ["templates", "machines"])
def test_data_folders_hold_no_python(folder):
    """An editable install cannot place Python files of these folders, so it would fail."""
    assert (ROOT / folder).is_dir()
    assert list((ROOT / folder).rglob("*.py")) == []
