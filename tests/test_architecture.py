"""Imports point one way: a file imports from its own stage or an earlier one, and data folders hold data only."""

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: The stages in the order of the pipeline; those of one line may import each other.
ORDER = (
    ("errors", "resources", "registry", "units", "drawing", "language"),
    ("data",),
    ("new_machine",),
    ("kinematics",),
    ("parallel",),
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


@cache
def nodes_of(text):
    """The imports and conditions of a module, wherever they stand."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, (ast.Import, ast.ImportFrom, ast.If))]


def imported_modules(path, module, is_package):
    """Full names of everything that a file imports, also below functions; relative imports are resolved."""
    base = module if is_package else module.rpartition(".")[0]
    for node in nodes_of(path.read_text(encoding="utf-8")):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parent = node.module or ""
            if node.level:
                above = base.split(".")[: len(base.split(".")) - node.level + 1]
                parent = ".".join([*above, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{parent}.{alias.name}") for alias in node.names)


def imported_at_run_time(path, module, is_package):
    """As :func:`imported_modules`, but for what only the check of types imports."""
    nodes = nodes_of(path.read_text(encoding="utf-8"))
    unused = [node for node in nodes if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)]
    lines = {line for node in unused for line in range(node.lineno, node.body[-1].end_lineno + 1)}
    return [item for item in imported_modules(path, module, is_package) if item[0] not in lines]


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


def reached(needs, module):
    """The modules that one needs, and those that they need, with itself."""
    found, waiting = set(), [module]
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += needs[one]
    return found


def circles_of(root):
    """Groups of files below ``root``/compgen that need each other, whichever way round one begins: each sorted."""
    files = {path.relative_to(root).with_suffix("").parts: path for path in (root / "compgen").rglob("*.py")}
    modules = {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for parts, path in files.items()}
    needs = {}
    for module, path in modules.items():
        names = [name for _, name in imported_at_run_time(path, module, path.name == "__init__.py")]
        found = {name if name in modules else name.rpartition(".")[0] for name in names}
        needs[module] = (found & {*modules}) - {module}
    behind = {module: reached(needs, module) for module in modules}
    groups = {tuple(sorted(b for b in behind[a] if a in behind[b])) for a in modules}
    return sorted(group for group in groups if len(group) > 1)


#: Pairs in which a reader hands over to one for another form of the same file when it meets one.
KNOWN_CIRCLES = [
    ("compgen.controls.heat_outputs", "compgen.controls.heat_programs"),
    ("compgen.controls.rotary_lists", "compgen.controls.rotary_pitch"),
    ("compgen.data.length_archive", "compgen.data.lengths"),
]


def test_files_of_a_room_do_not_need_each_other():
    assert [group for group in circles_of(ROOT) if group not in KNOWN_CIRCLES] == []


def test_a_circle_is_found_also_if_one_import_is_within_a_function(tmp_path):
    (tmp_path / "compgen/data").mkdir(parents=True)
    (tmp_path / "compgen/data/a.py").write_text("from compgen.data.b import c")
    (tmp_path / "compgen/data/b.py").write_text("def f():\n    from compgen.data.a import d")
    assert circles_of(tmp_path) == [("compgen.data.a", "compgen.data.b")]
    (tmp_path / "compgen/data/b.py").write_text("if TYPE_CHECKING:\n    from compgen.data.a import d")
    assert circles_of(tmp_path) == []


#: Where files of other programs meet what is done with them; the readers know nothing of that.
MEETING = ("converted.py", "opening.py", "__init__.py")


def test_readers_of_foreign_files_do_not_import_identification():
    found = [
        (path.name, name)
        for path in (ROOT / "compgen/foreign").glob("*.py")
        for _, name in imported_modules(path, f"compgen.foreign.{path.stem}", is_package=False)
        if path.name not in MEETING and name.startswith(("compgen.identification", "compgen.fitting"))
    ]
    assert found == []


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
