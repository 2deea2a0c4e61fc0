"""The pages: each is in the table of contents, each link within the project leads somewhere, the tutorials work."""

import importlib
import re
import shlex
import warnings
from collections import Counter
from pathlib import Path

import click
import pytest
from markdown_it import MarkdownIt

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.effects import catalogue
from compgen.plugins import KINDS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(
    [*ROOT.glob("*.md"), *DOCS.glob("*.md"), *(ROOT / "benchmarks").glob("*.md"), *ROOT.glob("examples/**/*.md")]
)
#: Blocks of a page: language, name of the file that it is (or nothing), text.
BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
README_LINES = 60  # one screen


# --- links -----------------------------------------------------------------------------------------------------------


def tokens_of(path):
    """All tokens of a page, the inline ones among them."""
    for token in MarkdownIt("commonmark").enable("table").parse(path.read_text(encoding="utf-8")):
        yield token
        yield from token.children or ()


def anchors_of(path):
    """The anchors of the headings of a page, as repository pages and the site make them."""
    found, tokens = [], list(tokens_of(path))
    for before, token in zip(tokens, tokens[1:], strict=False):
        if before.type == "heading_open":
            text = "".join(child.content for child in token.children or () if child.type in ("text", "code_inline"))
            found.append(re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-"))
    return found


def links_of(path):
    """Targets of the links and pictures of a page that stay within the project."""
    for token in tokens_of(path):
        target = token.attrGet("href") or token.attrGet("src")
        if target and not re.match(r"\w+:", target):
            yield target


def broken_links(path):
    """The links of a page that lead nowhere."""
    for target in links_of(path):
        name, _, anchor = target.partition("#")
        other = (path.parent / name).resolve() if name else path
        if not other.exists() or (anchor and anchor not in anchors_of(other)):
            yield target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_link_within_the_project_leads_somewhere(path):
    assert list(broken_links(path)) == []


def test_links_that_lead_nowhere_are_found(tmp_path):
    (tmp_path / "b.md").write_text("# Two words, `code`\n")
    (tmp_path / "a.md").write_text(
        "# A\n[1](b.md) [2](b.md#two-words-code) [3](#a) [4](https://example.org/x)\n\n"
        "| [5](c.md) |\n|---|\n| ![6](no.png) [7](b.md#two) |\n\n[8](#b)\n\n```\n[9](none.md)\n```\n"
    )
    assert list(broken_links(tmp_path / "a.md")) == ["c.md", "no.png", "b.md#two", "#b"]


# --- table of contents -----------------------------------------------------------------------------------------------


def contents():
    """Names of the pages in the tables of contents of docs/index.md."""
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r"^```{toctree}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]


def test_every_page_is_in_the_table_of_contents_once():
    assert Counter(contents()) == Counter(path.stem for path in DOCS.glob("*.md") if path.stem != "index")


def test_the_first_page_links_to_every_page_that_it_lists():
    assert sorted(set(links_of(DOCS / "index.md"))) == sorted(
        [f"{name}.md" for name in contents()] + ["figures/example.png"]
    )


def test_the_tables_of_options_are_those_of_the_commands(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    tables = importlib.import_module("option_tables")
    page = tables.PAGE.read_text("utf-8")
    assert tables.written(page) == page, "python docs/option_tables.py writes them again"
    commands = [command.loaded for command in cli.commands.values()]
    options = [item for command in commands if not isinstance(command, click.Group) for item in command.params]
    names = {word for item in options if not getattr(item, "hidden", False) for word in item.opts if word[:2] == "--"}
    assert len(names) > 150
    assert {name for name in names if not re.search(rf"(?<![\w-]){name}(?![\w-])", page)} == set()
    assert page.count(tables.BEGIN) == page.count(tables.END) > 20


def test_the_first_picture_has_the_figures_of_the_text():
    """Both are of the example's run: the picture notes its own figures (docs/figures.py)."""
    picture = (DOCS / "figures" / "example.png").read_bytes()
    noted = re.search(rb"Description\0rms, um: ([^\x00]*?)(?=.{4}\x00\x00|$)", picture, re.DOTALL)[1].decode("latin-1")
    figures = dict(item.rsplit(" ", 1) for item in noted.split("; "))
    for page in (ROOT / "README.md", DOCS / "index.md"):
        before, after = re.search(
            r"the true machine from (\d+) µm to ([\d.]+) µm rms", page.read_text("utf-8")
        ).groups()
        assert abs(float(figures["before"]) - float(before)) <= 5.0  # said to three digits
        assert {figures[name] for name in ("isg-csv", "etalon-exchange", "siemens-cec")} == {after}
    shown = (DOCS / "getting-started.md").read_text("utf-8")
    for name, rms in re.findall(r"^  ([a-z-]+) +max +[\d.]+ um +rms +([\d.]+) um$", shown, re.MULTILINE):
        assert float(figures[name]) == pytest.approx(float(rms), abs=0.5 if float(rms) > 10 else 0.0)


def test_the_readme_fits_one_screen_with_one_picture_and_two_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= README_LINES
    assert text.count("![") == 1
    ((language, _, commands),) = BLOCK.findall(text)
    assert (language, [line.split("#")[0].strip() for line in commands.splitlines()]) == (
        "sh",
        ["make demo", "make test"],
    )


def test_the_reference_has_every_public_name_once():
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    named = re.findall(r"^\.\. (?:autofunction|autoclass|autoexception|py:data):: (\w+)$", text, re.MULTILINE)
    assert Counter(named) == Counter(compgen.__all__)


# --- tutorials and words ---------------------------------------------------------------------------------------------


def squeezed(text):
    """The lines of a text without what depends on the width of the terminal."""
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize(
    "name", ["tutorial-first-table", "tutorial-diagnose", "tutorial-router", "tutorial-pitch-and-program"]
)
def test_every_command_of_a_tutorial_works_and_prints_what_the_page_shows(name, tmp_path, monkeypatch, capsys):
    """A block of text without a name holds beginnings of lines that the commands before it print, in their order."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "130")
    printed, commands, compared = [], 0, 0
    for language, file, text in BLOCK.findall((DOCS / f"{name}.md").read_text(encoding="utf-8")):
        if file:
            Path(file).write_text(text)
        elif language == "sh":
            for line in text.splitlines():
                words = shlex.split(line)
                assert words[0] == "volcomp"
                code = run_command(cli, words[1:])
                captured = capsys.readouterr()
                assert code == 0, (line, captured.out, captured.err)
                printed, commands = squeezed(captured.out), commands + 1
        else:
            shown = squeezed(text)
            remaining = iter(printed)
            assert [line for line in shown if not any(other.startswith(line) for other in remaining)] == []
            compared += len(shown)
    assert commands >= 4
    assert compared >= 5


def test_the_glossary_names_what_files_and_code_have():
    """Every name in the last column occurs in the package or its templates, or is an effect of the catalogue."""
    sources = [*(ROOT / "compgen").rglob("*.py"), *(ROOT / "templates").rglob("*.j2")]
    package = "\n".join(path.read_text(encoding="utf-8") for path in sources) + " ".join(catalogue(()))
    rows = re.findall(r"^\|(?! ?-|-| term )(.*)\|$", (DOCS / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`([^`]+)`", row.rsplit("|", 1)[1])]
    assert len(rows) > 80
    assert len(names) > 80
    words = {word for name in names for word in name.removeprefix("volcomp ").lstrip("*.").split(".")}
    assert sorted(word for word in words if not re.search(rf"(?<!\w){re.escape(word)}(?!\w)", package)) == []


def missing_names(text):
    """Files of the project and names of the package that a text puts in code style and that do not exist."""
    files = re.findall(r"`((?:compgen|tests|docs|benchmarks|examples|templates|machines)/[\w./-]+\.\w+)`", text)
    names = re.findall(r"`(compgen(?:\.\w+)+)\b[^`]*`", text)
    return [name for name in files if not (ROOT / name).exists()] + [name for name in names if not is_there(name)]


def is_there(name):
    """Whether a dotted name is a module, what a module holds, or a group of entry points; former names count while they work."""
    if name in [kind.group for kind in KINDS]:
        return True
    parts = name.split(".")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        for cut in range(len(parts), 0, -1):
            try:
                found = importlib.import_module(".".join(parts[:cut]))
            except ImportError:
                continue
            return all((found := getattr(found, part, None)) is not None for part in parts[cut:])
    return False


@pytest.mark.parametrize("path", [path for path in PAGES if path.name != "CHANGELOG.md"], ids=lambda path: path.stem)
def test_pages_name_files_and_functions_that_exist(path):
    """The changelog is left out: it names what was."""
    assert missing_names(path.read_text(encoding="utf-8")) == []


def test_names_that_do_not_exist_are_found():
    text = "`compgen.fitting.FitOptions` `compgen.fitting.nothing(x)` `compgen.nothing.at.all` `tests/none.py` `docs/conf.py`"
    assert missing_names(text) == ["tests/none.py", "compgen.fitting.nothing", "compgen.nothing.at.all"]
