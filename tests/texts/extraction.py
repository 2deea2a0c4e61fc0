"""The catalogues of texts: collect all messages, keep their translations, compile. `make texts` runs it.

Messages are collected from the templates of pages and lists, from the cards of the controls, and from the modules whose
sentences pages show. In Python every sentence is a plain string or an f-string; its places are named after their
expressions.
"""

import ast
import html
import inspect
import re
import string
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

from compgen.controls import CONTROLLERS
from compgen.data.toml_files import section_schema
from compgen.language import LABEL, MARKER, PART, WORD, parts
from compgen.simulation import INSTRUMENTS

ROOT = Path(__file__).parents[2]
CATALOGUES = ROOT / "templates" / "_language"

#: Modules whose sentences are shown on a page, in a list for the reader, or in the terminal.
MODULES = (
    "accuracy/*.py", "app/*.py", "cli/common.py", "cli/accuracy_commands.py", "cli/diagnose_commands.py",
    "cli/file_commands.py",
    "cli/identify_commands.py", "cli/listing_commands.py", "cli/plan_commands.py", "cli/program_commands.py",
    "cli/run_commands.py", "cli/table_commands.py", "controls/*.py", "controls/shared/base.py",
    "controls/shared/tables.py", "data/*.py",
    "diagnose/*.py", "drawing/*.py",
    "language.py", "new_machine.py", "registry.py",
    "effects/*.py", "fitting/*.py", "fleet/drift.py", "heat/joining.py", "fleet/history_page.py", "foreign/*.py",
    "identification/*.py", "identification/adjust/*.py", "instruments/*.py", "pipeline.py", "planning/*.py",
    "programs/correct.py",
    "programs/features.py", "programs/part.py", "report/cards.py", "report/handover.py", "report/measurement_order.py",
    "report/html/*.py", "report/pdf.py", "report/options_text.py",
    "report/part_page.py", "report/rotary_axes.py", "report/sheets.py", "report/summary.py", "report/terminal.py", "tables/*.py",
)  # fmt: skip
#: Those whose errors and warnings are shown, too.
WITH_ERRORS = re.compile(
    r"compgen/(accuracy|app|data|diagnose|drawing|fitting|foreign|heat|identification|instruments|planning|programs|tables)/|"
    r"compgen/(cli/common|cli/\w+_commands|pipeline|language|new_machine|registry)\.py"
)
ERRORS = re.compile(r"(Error|fail|warn|refused|refuse)$")
#: Readers of controls' files, and modules with names of columns and keys: their texts are no sentences for people.
READERS = (
    "heidenhain_text.py",
    "siemens_text.py",
    "registry.py",
    "language.py",
    "display.py",
    "heat_outputs.py",
    "heat_programs.py",
    "units.py",
)
#: Calls whose texts are for help, or are no texts.
NOT_SHOWN = re.compile(
    r"(setting|option|choice|positive|number_of|compile|match|search|sub|split|startswith|endswith|strip|argument|"
    r"removeprefix|removesuffix|getattr|import_module|column|take|section|sections|nearest|add_column|read_csv)$"
)
UNTRANSLATED = ("name", "equation", "source", "covariates", "scan")
#: Functions whose texts are read by programs, or shown in a session alone.
NOT_SHOWN_IN = re.compile(
    r"^(overview|panels|parse|usage$|short_text|dossier|calibration|_verification$|machine_text$)"
)
#: Single words that pages show: no rule tells them from keys.
WORDS = (
    "repeats", "neighbouring readings", "curves",
    "table", "head",
    "accepted with reservations", "accepted, partial", "partial", "better only after a new set-up", "not accepted", "volume max",
    "volume rms", "Air pressure", "Air temperature", "Relative humidity of the air", "Temperature of the machine", "um",
    "urad", "Accepted", "Customer", "Feed", "Instrument", "Laboratory", "Machine", "Operator", "Sections", "Squareness",
    "Temperature", "The", "Volume", "no table", "full volumetric", "+ straightness", "+ squareness",
    "+ direction-dependent", "+ angles, as products of tables", "confirmed", "tentative", "not separated", "accepted",
    "after", "angle", "angles", "diameter", "distance", "error", "flatness",
    "parallelism", "roundness", "rms", "assumed", "before", "better", "clockwise", "counter-clockwise", "day", "days", "exceeded",
    "identified", "larger", "metric", "month", "months", "negative", "off", "on", "positioning", "positive", "readings",
    "rejected", "same", "smaller", "smoothed", "squareness", "straightness", "week", "weeks", "with", "within", "without",
    "worse", "positioning runs", "lengths of a tracer", "six-DOF readings", "both", "one", "both directions", "radius (mm)",
    "REJECTED", "nothing", "none", "named", "unknown", "rise", "fall", "grows", "falls", "rises", "up", "down", "stated",
    "estimated", "required", "agrees", "disagrees", "uncalibrated", "both kinds of",
)  # fmt: skip
#: Headings and names of facts: they are no values, and where they are the name of a key they stay as they are.
LABELS = (
    # facts of a report that is handed over
    "Order number", "Certificate number", "Machine maker", "Serial number of the machine", "Place", "Measured", "Received",
    "Issued", "Issued in", "Control",
    "yes", "no",
    "why", "correlation", "partly", "reversal", "units", "passed", "Diagnosis", "Steps", "done", "progress", "volumetric",
    "pitch", "skew", "reference point", "tool offset",
    "circles", "part", "artefact", "deviations", "errors", "diagonals", "axis", "plane", "station", "targets", "runs",
    "directions", "angle", "axes", "base length mm", "calibrated", "columns", "comments", "components", "directions from",
    "duration s", "effective diameter mm", "encoding", "error", "expected diameter mm", "features", "first", "from mm",
    "header", "highest", "instrument", "kind", "largest", "largest misfit um", "largest um", "largest urad",
    "largest um urad", "last", "lowest", "machine", "measured at", "mm per unit by geometry", "notes", "Notes", "not used",
    "offset mm", "position unit", "points", "poses", "radius mm", "ranges mm", "rms um", "rms urad", "rows", "samples",
    "sheet", "sign", "sign of squareness", "slope of readings", "squareness urad", "stations", "step s", "temperatures c",
    "time s", "to mm", "u urad", "unit", "unit angle", "unit length", "serial no", "date", "velocity", "empty", "source",
    "control", "verdict", "reservations", "before*", "after*", "figure", "max", "rms", "difference", "length", "factor",
    "orientation", "volume", "Before", "After", "Suspects", "visible", "gain", "buys", "level", "remark", "left", "left*",
    "from", "meaning", "allowed", "default", "key", "limit", "used", "margin", "over", "correction", "parameters", "effect",
    "equation", "resembles", "chain", "format", "name", "value", "position", "station drift", "smoothness", "free", "bias",
    "solver", "feature", "quantity", "line", "diameter", "distance", "parallelism", "only", "share", "Errors", "Controls",
    "better after new setup", "Properties", "Limits", "Sources", "Files", "Remarks", "Points", "Scatter", "Without", "nodes",
)  # fmt: skip


#: What a measurement file contains, on the pages of the workbench; other overviews are shown in sessions only.
TITLES = (
    "{count} positions with {names}", "{count} {kind} features in {setups} set-ups", "{count} readings of {stations}",
)  # fmt: skip


#: Policies and headers of answers, comments of scripts, help of options, names of fields in files, parts of drawings.
NO_TEXT = re.compile(
    r"-src '|-ancestors|^; script-src|filename=|^# |^\[controllers|^set -e$|\$\? -eq|<Controls|never ends|in line 0$|"
    r"[Dd]efault: |\(default |\(may be given |\(several times |^Print (no|each) |^Scheduler of |"
    r"^(Axis|Standard uncertainty) of (an inst|meas)|"
    r"^Tool offset of the model|^[*]\.reversal|^(x|viewBox|transform|data-[a-z]+)=\"|"
    r"^(cd|volcomp) \{|^What was done in this project, by|"
    r"^([Mm]easurement|target|serial|version|[Ss]ample|mat temp) (date|id|no|\d)$|^(file type|exp coeff|air temp|measured at)$|"
    r"^(test date|date time|date of measurement|start time|actual sample rate|[Ss]ample rate|trigger interval)$|"
    r"^error: internal| \| [A-Z]|^run target data$|^Tool lengths: CSV|"
    r"^Another machine with its errors|^ecart type$|^coverage factor k$|^Position \[|^run\{zero|"
    r"^; sandbox |^recal add$"
)
#: Modules whose constants are words that readers look for.
WITH_WORD_LISTS = ("new_machine.py", "column_names.py", "covariates.py", "cells.py")


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


def template_sentence(template):
    """Return the template of a message as the catalogue lists it: places without formats."""
    pieces = string.Formatter().parse(template)
    return "".join(literal + (f"{{{name}}}" if name is not None else "") for literal, name, _, _ in pieces)


def pieces_of(text):
    """Return what is translated as one: the text between two tags of a page, a line of a list without its marker."""
    if re.search(r"</?[a-z]\w*[ >]", text):
        names = re.findall(r'aria-label="([^"{]+)"', text)
        return names + [html.unescape(" ".join(piece.split())) for piece in re.split(r"<[^<>]*>?|^[^<>]*>", text)]
    rows = (line.split("|") if line.startswith("|") else [line] for line in text.split("\n"))
    return [cell[MARKER.match(cell).end() :].strip() for row in rows for cell in row]


def is_sentence(text):
    """Return whether a string is meant to be read: several words, or one word beside a value."""
    literal = re.sub(r"\{\w+\}", " ", text)
    words = re.findall(r"[^\W\d_]{2,}", literal)
    if not words or NO_TEXT.search(text) or text.startswith(("_", "--", "/", "compgen ", "bold ")):
        return False
    return " " in text.strip() and bool(re.search(r"[a-z]{2,}", literal))


def of_module(source, *, errors=False, constants_are_words=False):
    """Yield the messages of a Python module; with ``errors`` also those of its errors and warnings."""

    def walk(node):
        if isinstance(node, ast.Assert | ast.ImportFrom | ast.Import):
            return
        if not errors and isinstance(node, ast.Raise):
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return
        if isinstance(node, ast.FunctionDef) and NOT_SHOWN_IN.match(node.name):
            return
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func).split("(")[-1]
            if called == "Message":  # code, template, values
                yield template_sentence(node.args[1].value)
                for value in node.keywords:
                    yield from walk(value.value)
                return
            if NOT_SHOWN.search(called) or (not errors and ERRORS.search(called)):
                return
            if called == "Card":  # of an effect: equations and sources are the same in every language
                node = ast.Call(node.func, node.args, [item for item in node.keywords if item.arg not in UNTRANSLATED])
        if isinstance(node, ast.Subscript):
            yield from walk(node.value)
            return
        text = sentence(node)
        if text is not None:
            for piece in pieces_of(text):
                if is_sentence(piece):
                    yield piece
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

    body = ast.parse(source).body
    for part in body:
        if not (constants_are_words and isinstance(part, ast.Assign | ast.AnnAssign)):
            yield from walk(part)


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
    for text in re.findall(r'aria-label="([^"]* [^"]*)"', source):
        if (
            re.search(r"[a-z]{2,}", re.sub(r"\{\{.*?\}\}", "", text))
            and "{%" not in text
            and text.count("{{") == text.count("}}")
        ):
            yield (PART if "{{" in text else None), text


def of_card(data):
    """Yield the messages of a control's card that its preflight list shows."""
    for text in (data["title"], *data["limits"], *data.get("unverified", ())):
        yield " ".join(text.split())


def of_settings(settings_class):
    """Yield what the settings of a control mean, as its form in the workbench shows them."""
    schemas = [section_schema(settings_class)]
    while schemas:
        for about in schemas.pop().get("properties", {}).values():
            schemas.append(about)
            if about.get("description"):
                yield about["description"]


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
        shown = {
            "errors": WITH_ERRORS.search(path.as_posix()) is not None,
            "constants_are_words": path.name in WITH_WORD_LISTS,
        }
        add(path, of_module(path.read_text("utf-8"), **shown))
    for control in CONTROLLERS.values():
        if kind := getattr(control, "settings_class", None):
            add(ROOT / f"{kind.__module__.replace('.', '/')}.py", of_settings(kind))
    for reader in INSTRUMENTS.values():
        add(ROOT / f"{reader.__module__.replace('.', '/')}.py", [inspect.getdoc(reader).partition("\n")[0]])
    add(Path(__file__), WORDS, WORD)
    add(Path(__file__), TITLES)
    add(Path(__file__), LABELS, LABEL)
    return found


def refusals():
    """Return the messages with which NC programs and files of controls are refused; some may lack a translation."""
    found, known = {}, messages()
    paths = [
        path
        for pattern in ("controls/*.py", "controls/shared/*.py", "programs/*.py")
        for path in (ROOT / "compgen").glob(pattern)
    ]
    for path in sorted(paths):
        for text in of_module(path.read_text("utf-8"), errors=True):
            if (None, text) not in known:
                found.setdefault((None, text), {})[str(path.relative_to(ROOT))] = None
    return found


#: Languages whose catalogue lists every message; that of another one has its translations alone, the rest appears in English.
WHOLE = ("de",)


def update(language):
    """Write the catalogue of a language with all messages of now, and its compiled form; return what has no translation.

    Translations of messages that are no longer used are removed: a wrong one would not be seen. A catalogue that is not
    :data:`WHOLE` keeps what is translated.
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
    refused = {key: files for key, files in refusals().items() if known.get(key)}
    missing = []
    for (context, text), files in {**messages(), **refused}.items():
        string = known.get((context, text), "")
        if not string and language not in WHOLE:
            missing.append(text)
            continue
        catalogue.add(text, string, locations=[(name, None) for name in files], context=context)
    with path.open("wb") as file:
        write_po(file, catalogue, width=120, omit_header=False)
    with path.with_suffix(".mo").open("wb") as file:
        write_mo(file, catalogue)
    return [*missing, *(item.id for item in catalogue if item.id and not item.string)]


if __name__ == "__main__":
    for name in (path.stem for path in sorted(CATALOGUES.glob("*.po"))):
        missing = update(name)
        print(f"{name}: {len(missing)} texts without a translation")
        for text in missing if name in WHOLE else ():
            print(f"  {text}")
    sys.exit(0)
