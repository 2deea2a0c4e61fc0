"""The catalogues of texts: collect all messages, keep their translations, compile. `make texts` runs it.

Messages are collected from the templates of pages and lists, from the cards of the controls, and from the modules whose
sentences pages show. In Python every sentence is a plain string or an f-string; its places are named after their
expressions.
"""

import ast
import re
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

from compgen.data.language import PART, WORD, parts

ROOT = Path(__file__).parents[2]
CATALOGUES = ROOT / "templates" / "_language"

#: Modules whose sentences are shown on a page or in a preflight list.
MODULES = (
    "accuracy/*.py", "app/contents.py", "app/pages.py",
    "controls/*.py", "controls/shared/base.py", "effects/active.py", "fleet/drift.py",
    "fleet/history_page.py", "identify/*.py", "identify/adjust/*.py", "report/html/*.py", "report/sheets.py",
    "tables/active.py", "tables/entries.py", "tables/export.py", "tables/judge.py", "tables/signs.py",
    "tables/verification.py",
)  # fmt: skip
#: Readers of controls' files: their texts are messages of the terminal.
READERS = ("heidenhain_text.py", "siemens_text.py")
#: Calls whose texts are for the terminal, or are no texts.
NOT_SHOWN = re.compile(
    r"(Error|fail|warn|setting|option|choice|positive|number_of|compile|match|search|sub|split|startswith|endswith|strip|"
    r"removeprefix|removesuffix|getattr|import_module|refused|column|take|section|sections|nearest|add_column|Text|read_csv)$"
)
#: Functions whose texts are for the terminal: readers of files, and what a session shows.
NOT_SHOWN_IN = re.compile(
    r"^(overview|panels|summary|parse|remarks|_?read_|usage$|short_text|dossier|calibration|_verification$)"
)
#: Single words that pages show: no rule tells them from keys.
WORDS = (
    "accepted with reservations", "accepted, partial", "better only after a new set-up", "not accepted", "volume max",
    "volume rms", "Air pressure", "Air temperature", "Relative humidity of the air", "Temperature of the machine", "um", "urad",
    "Accepted", "Customer", "Feed", "Instrument", "Laboratory", "Machine", "Operator", "Sections", "Squareness", "Temperature",
    "The", "Volume", "no table", "full volumetric", "+ straightness", "+ squareness", "+ direction-dependent",
    "+ angles, as products of tables", "confirmed", "tentative", "not separated",
    "accepted", "after", "angles", "assumed", "before", "better", "clockwise", "counter-clockwise", "day",
    "days", "exceeded", "identified", "larger", "metric", "month", "months", "negative", "off", "on", "positioning",
    "positive", "readings", "rejected", "same", "smaller", "smoothed", "squareness", "straightness", "week", "weeks", "with",
    "within", "without", "worse",
    "positioning runs", "circles", "part", "artefact", "lengths of a tracer", "deviations", "errors", "six-DOF readings",
    "diagonals", "axis", "plane", "station", "targets", "runs", "directions", "both", "one", "both directions", "radius (mm)",
)  # fmt: skip


#: Policies and headers of answers, comments of scripts, messages of the terminal.
NO_TEXT = re.compile(r"-src '|-ancestors|^; script-src|filename=|^# |^\[controllers|^error: internal")


def place_name(node):
    """Return a name for what is filled into a sentence: that of the value, not of a function or unit around it."""
    if isinstance(node, ast.Attribute):
        return node.attr
    if isinstance(node, ast.Name):
        return None if node.id.isupper() else node.id
    if isinstance(node, ast.Subscript):
        key = node.slice
        return key.value if isinstance(key, ast.Constant) and isinstance(key.value, str) else place_name(node.value)
    if isinstance(node, ast.Call):
        inner = [*node.args, *([node.func.value] if isinstance(node.func, ast.Attribute) else [])]
        key = node.args[0] if node.args else None
        if isinstance(node.func, ast.Attribute) and isinstance(key, ast.Constant) and str(key.value).isidentifier():
            return key.value
        return next(filter(None, map(place_name, inner)), None)
    if isinstance(node, ast.GeneratorExp | ast.ListComp):
        return place_name(node.generators[0].iter)
    return next(filter(None, map(place_name, ast.iter_child_nodes(node))), None)


def sentence(node):
    """Return a string of Python as a message, with named places for what is filled in; None for anything else."""
    if isinstance(node, ast.Constant):
        if not isinstance(node.value, str):
            return None
        pieces = re.split(r"\{\d?\}", node.value)  # of str.format
        return "".join(f"{piece}{{value{k or ''}}}" for k, piece in enumerate(pieces[:-1])) + pieces[-1]
    if not isinstance(node, ast.JoinedStr):
        return None
    found, taken = [], {}
    for part in node.values:
        if isinstance(part, ast.Constant):
            found.append(part.value)
        else:
            name = place_name(part.value) or "value"
            taken[name] = taken.get(name, 0) + 1
            found.append(f"{{{name}{taken[name] if taken[name] > 1 else ''}}}")
    return "".join(found)


def is_sentence(text):
    """Return whether a string is meant to be read: several words, or one word beside a value."""
    literal = re.sub(r"\{\w+\}", " ", text)
    words = re.findall(r"[^\W\d_]{2,}", literal)
    if (
        not words
        or NO_TEXT.search(text)
        or "<" in text
        or " | " in text
        or "\n" in text
        or text.startswith(("_", "--", "/", "compgen ", "bold "))
    ):
        return False
    return " " in text.strip() and bool(re.search(r"[a-z]{2,}", literal))


def of_module(source):
    """Yield the messages of a Python module."""

    def walk(node):
        if isinstance(node, ast.Raise | ast.Assert | ast.ImportFrom | ast.Import):
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return
        if isinstance(node, ast.FunctionDef) and NOT_SHOWN_IN.match(node.name):
            return
        if isinstance(node, ast.Call) and NOT_SHOWN.search(ast.unparse(node.func).split("(")[-1]):
            return
        if isinstance(node, ast.Subscript):
            yield from walk(node.value)
            return
        text = sentence(node)
        if text is not None:
            if is_sentence(text):
                yield text.strip()
            if isinstance(node, ast.JoinedStr):
                for part in node.values:
                    if isinstance(part, ast.FormattedValue):
                        yield from walk(part.value)
            return
        for child in ast.iter_child_nodes(node):
            if node.__class__ in (ast.FunctionDef, ast.AnnAssign, ast.arg) and child in (
                getattr(node, "returns", None), getattr(node, "annotation", None), *getattr(node, "decorator_list", ()),
            ):  # fmt: skip
                continue
            yield from walk(child)

    yield from walk(ast.parse(source))


def of_template(source, *, html):
    """Yield the messages of a template with their context: its parts, and the texts of expressions that are filled in."""
    for first, last in parts(source, html=html):
        yield PART, " ".join(source[first:last].split())
    rest, end = [], 0
    for first, last in parts(source, html=html):
        rest.append(source[end:first])
        end = last
    for expression in re.findall(r"\{\{.*?\}\}", "".join([*rest, source[end:]]), re.DOTALL):
        for text in re.findall(r'"([^"]*)"', expression):
            if is_sentence(text) and "%" not in text and ":" not in text:
                yield None, text
    for text in re.findall(r'aria-label="([^"{]* [^"{]*)"', source):
        yield None, text


def of_card(data):
    """Yield the messages of a control's card that its preflight list shows."""
    for text in (data["title"], *data["limits"], *data.get("unverified", ())):
        yield " ".join(text.split())


def messages():
    """Return every message with the files that contain it; the context of single words is WORD."""
    found = {}

    def add(path, texts, context=None):
        for text in texts:
            found.setdefault(text if isinstance(text, tuple) else (context, text), {})[str(path.relative_to(ROOT))] = (
                None
            )

    templates = ROOT / "templates"
    for path in sorted(templates.glob("_report/*.html.j2")):
        source = path.read_text("utf-8")
        add(path, of_template(source, html=True))
    for path in sorted(templates.glob("_app/*.html")):
        add(path, of_template(path.read_text("utf-8"), html=True))
    for path in sorted([*templates.glob("*/preflight.md.j2"), *templates.glob("_common/*.md.j2")]):
        add(path, of_template(path.read_text("utf-8"), html=False))
    for path in sorted(templates.glob("*/format.toml")):
        add(path, of_card(tomllib.loads(path.read_text("utf-8"))))
    for path in sorted({path for pattern in MODULES for path in (ROOT / "compgen").glob(pattern)}):
        if path.name in READERS:
            continue
        add(path, of_module(path.read_text("utf-8")))
    add(Path(__file__), WORDS, WORD)
    return found


def update(language):
    """Write the catalogue of a language with all messages of now, and its compiled form; return what has no translation.

    Translations of messages that are no longer used are removed: a wrong one would not be seen.
    """
    from babel.messages.catalog import Catalog
    from babel.messages.mofile import write_mo
    from babel.messages.pofile import read_po, write_po

    path = CATALOGUES / f"{language}.po"
    known = {}
    if path.is_file():
        with path.open("rb") as file:
            known = {(item.context, item.id): item.string for item in read_po(file) if item.id}
    day = datetime(2026, 11, 23, tzinfo=UTC)  # the date of a file is in the history of the project
    catalogue = Catalog(language, header_comment="# Texts of pages and lists.", project="compgen", version=" ", fuzzy=False,
                        msgid_bugs_address=" ", creation_date=day, revision_date=day, last_translator=" ")  # fmt: skip
    for (context, text), files in messages().items():
        string = known.get((context, text), "")
        catalogue.add(text, string, locations=[(name, None) for name in files], context=context)
    with path.open("wb") as file:
        write_po(file, catalogue, width=120, omit_header=False)
    with path.with_suffix(".mo").open("wb") as file:
        write_mo(file, catalogue)
    return [item.id for item in catalogue if item.id and not item.string]


if __name__ == "__main__":
    for name in (path.stem for path in sorted(CATALOGUES.glob("*.po"))):
        missing = update(name)
        print(f"{name}: {len(missing)} texts without a translation")
        for text in missing:
            print(f"  {text}")
    sys.exit(0)
