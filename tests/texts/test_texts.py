"""German pages and lists: every text has a translation with the same numbers, and nothing that a control reads is touched."""

import ast
import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from gettext import GNUTranslations
from pathlib import Path

import pytest
from babel.messages.pofile import read_po
from texts import extraction
from texts.reading import left_in_english, numbers, shown

import compgen
from compgen.controls import CONTROLLERS
from compgen.data.csv_files import read_csv
from compgen.errors import InputError, message_of
from compgen.language import Texts, parts, texts_of, wrapped
from compgen.report.html import build_report
from compgen.resources import LANGUAGES
from compgen.tables import check_files
from compgen.tables.render import load_format

ERRORS = "examples/zha-gantry.truth.errors.csv"
ROOT = Path(__file__).resolve().parents[2]
HOW_TO = "write their German texts into templates/_language/de.po and run `make texts` (CONTRIBUTING.md, Texts)"


@pytest.fixture(scope="module")
def german():
    return texts_of("de")


@pytest.fixture(scope="module")
def catalogue():
    with (extraction.CATALOGUES / "de.po").open("rb") as file:
        return {(item.context, item.id): item.string for item in read_po(file) if item.id}


def translated(language):
    """The catalogue of a language as it is written: translations by context and message."""
    with (extraction.CATALOGUES / f"{language}.po").open("rb") as file:
        return {(item.context, item.id): item.string for item in read_po(file) if item.id and item.string}


@pytest.fixture(scope="module")
def machine():
    return compgen.load_machine("zha-gantry")


@pytest.fixture(scope="module")
def ran(tmp_path_factory, machine):
    folder = tmp_path_factory.mktemp("run")
    names = ["siemens-cec", "fanuc-pitch"]
    compgen.run(machine, ["examples/zha-gantry.lengths.csv"], names, folder, language="de")
    return folder


def test_every_text_has_a_translation(catalogue):
    missing = [text for (context, text) in extraction.messages() if not catalogue.get((context, text))]
    assert not missing, f"{len(missing)} texts have no German translation; {HOW_TO}:\n" + "\n".join(missing)


def test_the_catalogue_contains_nothing_else_and_is_compiled(catalogue):
    unused = set(catalogue) - set(extraction.messages()) - set(extraction.refusals())
    assert not unused, f"texts that no page shows any more; run `make texts`: {unused}"
    with (extraction.CATALOGUES / "de.mo").open("rb") as file:
        compiled = vars(GNUTranslations(file))["_catalog"]
    known = {
        text if context is None else f"{context}\x04{text}": german for (context, text), german in catalogue.items()
    }
    assert {key: value for key, value in compiled.items() if key} == known, "run `make texts`"


def inner(text):
    """Expressions of a template; what they show in words is translated, so it is left out."""
    found = re.findall(r"\{\{.*?\}\}|\{%.*?%\}", text)
    return Counter(re.sub(r'"([^"]*)"', lambda text: '""' if " " in text[1] else text[0], item) for item in found)


def outer(text):
    return re.sub(r"\{\{.*?\}\}|\{%.*?%\}", " ", text)


@pytest.mark.parametrize(
    ("what", "of"),
    [
        ("expressions of the template", inner),
        ("places for values", lambda text: Counter(re.findall(r"\{\w+\}", outer(text)))),
        ("code", lambda text: Counter(re.findall(r"`[^`]*`|<code>.*?</code>", text))),
        ("tags", lambda text: Counter(re.findall(r"</?\w[^>]*>", outer(text)))),
        ("numbers and their signs", lambda text: Counter(numbers(re.sub(r"\{\w+\}", " ", outer(text))))),
        ("keys", lambda text: Counter(re.findall(r"--[a-z-]+|\b[a-z]+_[a-z_]+\b|\b[EC][A-Z0]{2}\b", outer(text)))),
        ("values to set", lambda text: Counter(re.findall(r'= ?"[^"]*"', outer(text)))),
    ],
)
def test_a_translation_has_the_same(what, of, catalogue):
    wrong = [f"{text}\n  {german}" for (_, text), german in catalogue.items() if of(text) != of(german)]
    assert not wrong, f"other {what}:\n" + "\n".join(wrong)


def test_a_translation_has_the_same_units(catalogue):
    """In German "um" is a word, so there the unit is µm."""
    wrong = []
    for (_, text), german in catalogue.items():
        before, after = (re.sub(r"\{\w+\}", "0", re.sub(r"--[a-z-]+", "", outer(item))) for item in (text, german))
        before = re.sub(r"(?<!\w)u(?=m\b|rad\b)", "µ", before)
        units = [Counter(re.findall(r"(?<!\w)(?:mm|µm|µrad|rad|K)(?!\w)|%", item)) for item in (before, after)]
        if units[0] != units[1]:
            wrong.append(f"{text}\n  {german}")
    assert not wrong, "other units:\n" + "\n".join(wrong)


def lists(machine, name, language):
    errors = compgen.read_errors(ERRORS)
    made = compgen.export(machine, errors, name, allow_unverified=True, language=language)
    page = check_files(machine, made, errors, language=language)["check/check-program.md"]
    return made, made.preflight, page


@pytest.mark.parametrize("name", [name for name in CONTROLLERS])
def test_the_preflight_list_says_the_same_in_german(name, machine, german):
    english, *said = lists(machine, name, "en")
    translated, *told = lists(machine, name, "de")
    assert translated.files == english.files and translated.manifest == english.manifest
    card = load_format(name)
    for before, after in zip(said, told, strict=True):
        assert Counter(numbers(after)) == Counter(numbers(before))
        assert Counter(re.findall(r"`[^`]*`", " ".join(after.split()))) == Counter(
            german.label(code) if code in ("`3605, interpolated type`", "`linear axis error compensation`") else code
            for code in re.findall(r"`[^`]*`", " ".join(before.split()))
        ) or any(german.text(code[1:-1]) != code[1:-1] for code in re.findall(r"`[^`]*`", before))
        assert left_in_english(after, card.sources) == []


def test_a_german_report_is_german(ran):
    page = build_report(ran, "de").files["report.html"]
    assert '<html lang="de">' in page
    texts = shown(page)
    sources = [source for name in ("siemens-cec", "fanuc-pitch") for source in load_format(name).sources]
    assert [text for text in texts if text not in sources and left_in_english(text, ())] == []
    for text in (
        "Bericht der Kompensation",
        "Rechtwinkligkeitsabweichungen in µrad mit erweiterter Unsicherheit",
        "Geradheit von Y in X",
        "Zahlen sind mit Dezimalpunkt geschrieben, wie in den Dateien für die Steuerung.",
    ):
        assert text in texts
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert data["curve-EXX"]["series"][0]["name"] == "identifiziert"


def test_only_the_page_has_a_language(ran):
    english, translated = build_report(ran), build_report(ran, "de")
    assert {name for name in english.files if english.files[name] != translated.files[name]} == {"report.html"}
    assert english.data == translated.data
    assert '<html lang="en">' in english.files["report.html"]


def test_texts_of_users_are_escaped_and_stay_as_they_are(ran, tmp_path):
    for path in ran.rglob("*"):
        if path.is_file():
            target = tmp_path / path.relative_to(ran)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    result = tmp_path / "siemens-cec" / "result.json"
    data = json.loads(result.read_text())
    data["notes"] = ["<script>alert('the tables cover the travel')</script>"]
    result.write_text(json.dumps(data))
    page = build_report(tmp_path, "de").files["report.html"]
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(&#39;the tables cover the travel&#39;)&lt;/script&gt;" in page


def test_what_has_to_be_typed_is_never_translated(machine, german):
    _, preflight, _ = lists(machine, "siemens-cec", "de")
    assert '`sign = "error"`' in preflight and "`$AN_CEC_MULT_BY_TABLE[" in preflight
    assert german.text("error") == "error" and german.text("accepted") == "accepted"
    assert german.label("accepted") == "angenommen" and german.label("7 weeks") == "7 Wochen"


def test_every_sentence_is_found_by_its_text_with_values(german):
    wrong = []
    for text, translation in german.messages.items():
        if "\x04" in text:
            continue
        values = {name: f"{k + 1}.5" for k, name in enumerate(dict.fromkeys(re.findall(r"\{(\w+)\}", text)))}
        filled, expected = (
            re.sub(r"\{(\w+)\}", lambda place, values=values: values[place[1]], item) for item in (text, translation)
        )
        if german.text(filled) != expected:
            wrong.append(f"{filled}\n  {german.text(filled)}")
    assert not wrong, "another message takes these texts; use other words:\n" + "\n".join(wrong)


def test_a_sentence_is_never_a_mixture():
    texts = Texts({"the table {name} is {state}": "die Tabelle {name} ist {state}", "not used": "unbenutzt"})
    assert texts.text("the table X.TAB is not used") == "die Tabelle X.TAB ist unbenutzt"
    assert texts.text("the table X.TAB is far too large") == "the table X.TAB is far too large"
    assert (
        texts.text("the table A is not used; the table B is not used.")
        == "die Tabelle A ist unbenutzt; die Tabelle B ist unbenutzt."
    )
    assert texts.text("the table A is not used. A new sentence.") == "die Tabelle A ist unbenutzt. A new sentence."
    assert texts.text("siemens-cec: the table A is not used") == "siemens-cec: die Tabelle A ist unbenutzt"


@pytest.mark.parametrize(
    ("english", "said"),
    [
        (
            "isg-csv: accepted with reservations: the error over the volume goes from 41 um rms (18 to 81 um) to 3 um, "
            "at most 4 um",
            "isg-csv: angenommen mit Vorbehalten: die Abweichung über das Volumen geht von 41 µm rms (18 bis 81 µm) auf 3 µm, "
            "höchstens 4 µm",
        ),
        (
            "isg-csv: partial: positioning only, 1 of 17 errors measured; accepted with reservations: the error over the volume "
            "goes from 41 um rms (18 to 81 um) to 3 um, at most 4 um",
            "isg-csv: teilweise: nur Positionierung, 1 von 17 Abweichungen gemessen; angenommen mit Vorbehalten: die Abweichung "
            "über das Volumen geht von 41 µm rms (18 bis 81 µm) auf 3 µm, höchstens 4 µm",
        ),
        (
            "next measurement: Assumed, not measured: squareness of Y to X (EC0Y) up to 80 urad (k = 2). It makes 50 % of the "
            "remaining uncertainty.",
            "nächste Messung: Angenommen, nicht gemessen: Rechtwinkligkeit von Y zu X (EC0Y) bis 80 µrad (k = 2). Das macht 50 % "
            "der verbleibenden Unsicherheit aus.",
        ),
        (
            "what was not measured may cost, rms over the volume: EC0Y 35.1 um, EYY 15.1 um, EB0Z 12.3 um, EA0Z 12.3 um "
            "and 12 others",
            "was nicht gemessen wurde, kann kosten (effektiv über das Volumen): EC0Y 35.1 µm, EYY 15.1 µm, EB0Z 12.3 µm, "
            "EA0Z 12.3 µm und 12 weitere",
        ),
    ],
)
def test_verdicts_and_headings_before_a_colon_are_translated_with_their_sentence(english, said, german):
    """A verdict behind the name of a control was taken apart: "angenommen mit reservations", "nur partial: Positionierung"."""
    assert german.lines(english) == said


def test_lines_of_a_file_are_not_texts(german):
    assert german.filled("not known") == "nicht bekannt"
    assert german.filled("not known\n1.0 not known") == "not known\n1.0 not known"
    assert german.filled(3.5) == 3.5


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("{% if a %}\none\ntwo {{ b }}\n{% else %}\n- three\n  four\n{% endif %}\n", ["one\ntwo {{ b }}", "three\n  four"]),
        ("1. {% if a %}yes{% else %}no{% endif %}, then\n2. `only code`\n\n```\nnever this\n```\n# Head\n",
         ["{% if a %}yes{% else %}no{% endif %}, then", "Head"]),
        ("| a word | mm |\n|---|---|\n| {{ x }} | mm |\n", ["| a word | mm |"]),
    ],
)  # fmt: skip
def test_parts_of_a_list(source, found):
    assert [source[first:last] for first, last in parts(source, html=False)] == found


def test_parts_of_a_page():
    source = "<p>{% if a %}Text <b>{{ b }}</b>{% endif %}</p>{% for x in y %}<td>{{ x }}</td>{% endfor %}"
    source += "<i>one</i> {% if c %}<p>two</p>{% endif %}"
    assert [source[first:last] for first, last in parts(source, html=True)] == [
        "{% if a %}Text <b>{{ b }}</b>{% endif %}", "<i>one</i>", "two"
    ]  # fmt: skip


def test_long_paragraphs_are_wrapped_and_tables_are_not():
    row = "| " + "word " * 40 + "|"
    text = wrapped("- " + "word " * 40 + "\n" + row)
    assert max(map(len, text.split("\n")[:-1])) <= 120 and text.split("\n")[1].startswith("  word")
    assert text.endswith(row)
    for width in range(90, 130):  # "- 99.990" would be an item, "2. " a numbered one
        assert not re.search(r"(?m)^\s*([-+=]|2\.) ", wrapped("x" * width + " (100.000 - 99.990) + 2. = 1"))


def test_a_language_without_a_catalogue_is_refused(machine):
    with pytest.raises(InputError, match="'fr' is not a language of the pages"):
        texts_of("fr")


def test_english_needs_no_catalogue(ran, tmp_path):
    code = f"""
import sys
from compgen.cli import cli
from compgen.cli.common import run_command
assert run_command(cli, ["report", {str(ran)!r}, "--out", {str(tmp_path)!r}]) == 0
assert "compgen.data.language" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=120)


def test_one_language_for_all_commands_in_the_configuration(ran, tmp_path, monkeypatch, capsys):
    from compgen.cli import cli
    from compgen.cli.common import run_command

    (tmp_path / "config.toml").write_text('language = "de"\n')
    monkeypatch.setenv("COMPGEN_CONFIG", str(tmp_path / "config.toml"))
    assert run_command(cli, ["report", str(ran), "--out", str(tmp_path / "a")]) == 0
    assert '<html lang="de">' in (tmp_path / "a" / "report.html").read_text("utf-8")
    assert run_command(cli, ["report", str(ran), "--out", str(tmp_path / "b"), "--language", "en"]) == 0
    assert '<html lang="en">' in (tmp_path / "b" / "report.html").read_text("utf-8")
    (tmp_path / "config.toml").write_text('language = "fr"\n')
    assert run_command(cli, ["report", str(ran)]) == 2
    assert "language" in capsys.readouterr().err


def test_a_job_file_states_the_language_of_a_machine(tmp_path):
    from compgen.fleet.job import read_job

    text = """store = "recal.sqlite"
[machines.mill]
machine = "zha-gantry"
inbox = "inbox"
controllers = ["isg-csv"]
out = "out"
measured_with = "bare"
"""
    (tmp_path / "recal.toml").write_text(text)
    english = read_job(tmp_path / "recal.toml").machine("mill")
    (tmp_path / "recal.toml").write_text(text + 'language = "de"\n')
    translated = read_job(tmp_path / "recal.toml").machine("mill")
    assert (english.language, translated.language) == ("en", "de")
    # its lists are made again; those of jobs that state no language are not
    assert english.settings_sha256() != translated.settings_sha256()
    (tmp_path / "recal.toml").write_text(text + 'language = "fr"\n')
    with pytest.raises(InputError, match="language: expected one of 'en', 'de'"):
        read_job(tmp_path / "recal.toml")


# A further language is one file, its catalogue; what it does not translate appears in English.

FURTHER = [language for language in LANGUAGES[1:] if language not in extraction.WHOLE]


def test_every_catalogue_is_a_language():
    assert list(LANGUAGES) == ["en", *sorted(path.stem for path in extraction.CATALOGUES.glob("*.po"))]
    assert FURTHER


@pytest.mark.parametrize("language", FURTHER)
def test_a_further_catalogue_is_compiled_and_its_translations_have_the_same_places_and_tags(language):
    known = translated(language)
    with (extraction.CATALOGUES / f"{language}.mo").open("rb") as file:
        compiled = vars(GNUTranslations(file))["_catalog"]
    assert {key: value for key, value in compiled.items() if key} == {
        text if context is None else f"{context}\x04{text}": string for (context, text), string in known.items()
    }, "run `make texts`"
    kinds = (r"\{\{.*?\}\}|\{%.*?%\}", r"(?<!\{)\{\w+\}(?!\})", r"</?[a-z][^>]*>", r"`[^`]*`", r"\d+(?:\.\d+)?")
    for (_, text), string in known.items():
        for kind in kinds:
            assert sorted(re.findall(kind, text)) == sorted(re.findall(kind, string)), text


@pytest.mark.parametrize("language", FURTHER)
def test_a_report_in_a_further_language_has_its_texts_and_the_same_numbers(language, ran):
    english, page = (build_report(ran, name).files["report.html"] for name in ("en", language))
    assert f'<html lang="{language}">' in page
    texts = translated(language)
    for heading in ("The identified errors", "The measurement", "What remains uncorrected, and why"):
        assert f">{heading}</h" in english
        assert f">{texts['part', heading]}</h" in page
        assert f">{heading}</h" not in page
    cells = [re.findall(r'<td class="n">([-+<]?\d[^<]*)</td>', text) for text in (english, page)]
    assert cells[0] == cells[1]
    assert len(cells[0]) > 100


def test_a_catalogue_that_is_put_there_is_a_language_at_once(tmp_path):
    """Nothing of the program names a language: a copy of it with one more file speaks it."""
    (tmp_path / "templates" / "_language").mkdir(parents=True)
    (tmp_path / "compgen").mkdir()
    shutil.copy(extraction.CATALOGUES / "es.mo", tmp_path / "templates" / "_language" / "xx.mo")
    shutil.copy(ROOT / "compgen" / "resources.py", tmp_path / "compgen" / "resources.py")
    code = "import runpy, sys; print(runpy.run_path('compgen/resources.py')['LANGUAGES'])"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert "'xx'" in done.stdout, done.stderr


@pytest.mark.parametrize("folder", ["data", "neue daten fuer mich", "expected a number of rows"])
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        (
            "point,x_mm\n1,a value in mm\n",
            "'a value in mm' is not a number; expected a number with '.' as decimal point",
        ),
        ("point,x_mm\n1,\n", "is empty; expected a number with '.' as decimal point"),
    ],
)
def test_words_of_the_user_do_not_keep_a_sentence_in_english(folder, content, said, catalogue, tmp_path):
    path = tmp_path / folder / "fehlt.csv"
    path.parent.mkdir()
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as refused:
        read_csv(path, required=("point", "x_mm")).numbers("x_mm")
    message = message_of(refused.value)
    cell = "'a value in mm'"
    german = catalogue[None, said.replace(cell, "{cell}")].replace("{cell}", cell)
    assert said in str(message)
    assert texts_of("de").lines(message) == str(message).replace(said, german).replace(": column", ": Spalte")


def test_json_has_the_code_and_the_values_of_a_message(tmp_path, capsys):
    from compgen.cli import cli
    from compgen.cli.common import run_command

    path = tmp_path / "neue daten" / "fehlt.csv"
    assert run_command(cli, ["fit", "zha-gantry", str(path), "--out", str(tmp_path / "out"), "--json"]) == 2
    said = json.loads(capsys.readouterr().out)
    (message,) = said["messages"]
    assert message["code"] == "file-missing"
    assert message["text"] == said["error"]
    assert message["values"]["place"].startswith(str(path))


def test_a_code_belongs_to_one_message():
    found = {}
    for path in sorted((extraction.ROOT / "compgen").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Message":
                if path.name == "errors.py":  # its template is put together from place and field
                    continue
                code, template = (item.value for item in node.args)
                assert re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", code), (path, code)
                assert found.setdefault(code, template) == template, (path, code)
    assert len(found) > 50
