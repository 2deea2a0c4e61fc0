"""A project in German from the machine to the comparison, and commands in German: nothing that is shown is left in English."""

import csv
import io
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from texts.reading import left_in_english, numbers, shown

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.language import Texts, texts_of

ROOT = Path(__file__).resolve().parents[2]
IMPORTS = ROOT / "tests" / "golden" / "imports"
ERRORS = "examples/zha-gantry.truth.errors.csv"
LENGTHS = "examples/zha-gantry.lengths.csv"
MILL = {
    "name": "my-mill", "chain": "Tisch in X und Y, Kopf in Z", "X-low": "0", "X-high": "400", "Y-low": "0",
    "Y-high": "400", "Z-low": "-240", "Z-high": "0", "control": "siemens-cec",
}  # fmt: skip
PROGRAM = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG1 X100. F500\nG1 X400. Y50.\nM30\n"
#: Texts of the files of this test: they are the user's.
OF_FILES = {"constructed for tests", "constructed, not measured", "by"}


def circles_with_backlash():
    """Circles of a machine whose X has a reversal value of 12 um."""
    rows = ["plane,angle_deg,radius_mm,deviation_um,direction,run"]
    for run in (1, 2):
        for direction in (1, -1):
            for k in range(0, 360, 2):
                angle = math.radians(k + 0.5)
                moving = -math.copysign(1.0, math.sin(angle)) * direction
                radial = -6.0 * moving * math.cos(angle) + 0.05 * math.sin(7.0 * k + 31 * run + 5 * direction)
                rows.append(f"XY,{math.degrees(angle):.4f},100,{radial:.5f},{direction},{run}")
    return "\n".join(rows) + "\n"


def english_of(page):
    """Return the texts of a page that are English, but for those of the user's files."""
    page = re.sub(r"<textarea.*?</textarea>", "", page, flags=re.DOTALL)
    english = [text for text in shown(page) if left_in_english(text, ()) and text not in OF_FILES]
    return [
        text for text in english if not re.search("constructed for tests|TITLE: constructed", text)
    ]  # heads of files


def test_all_pages_of_a_german_project_are_german(tmp_path, monkeypatch):
    pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
    pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")
    import app_site

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    site = app_site.Site(tmp_path / "project", language="de")
    left = []

    def look():
        for name in ("machine", "measurement", "result", "tables", "program", "after", "project"):
            page = site.get(f"/projects/1/{name}").text
            left.extend((name, text) for text in english_of(page))
            assert '<html lang="de">' in page

    def given(name, content=None):
        content = (IMPORTS / name).read_bytes() if content is None else content.encode()
        return (io.BytesIO(content), name)

    look()
    site.do("machine/describe", MILL)
    state = site.do("measurement/add", {"files": [given(name) for name in ("angular.rta", "ecmc_ISO230.dat")]})
    page = site.get("/projects/1/measurement").text
    assert "die Datei sagt nicht, welche Abweichung es ist" in page
    assert "Achse: X" not in page
    look()
    for item in state.measurements:
        site.do(f"measurement/{item.number}/remove")
    site.do("measurement/add", {"files": [given("xy.circle.csv", circles_with_backlash())]})
    site.do("identify")
    state = site.do("diagnose")
    assert state.last("diagnose").commands[0][-4:-2] == ["--language", "de"]
    page = site.get("/projects/1/result").text
    assert "Was zu tun ist" in page
    look()
    state = site.do("measurement/add", {"files": [given("linear.rtl")]})
    runs = state.measurements[-1]
    site.do(f"measurement/{runs.number}/sheet")
    site.do("identify")
    state = site.do("run", {"control": "siemens-cec", "allow-misfit": "on"})
    typed = dict.fromkeys(("gauge", "keep-unknown", "tables", "tolerance-um", "shortest-mm", "decimals", "only"), "")
    typed |= {"dialect": "fanuc", "wcs": "G54=0,0,-100"}
    site.do("program/use", {**typed, "program": given("part.nc", PROGRAM), "what": "part"})
    site.do("program/use", {**typed, "what": "correct"})
    text = site.project.path(runs.used[0]).read_text()
    state = site.do("measurement/add", {"files": [given("after.axis.csv", text)], "after": "yes"})
    after = next(item for item in state.measurements if item.after)
    site.post("/projects/1/compare", {"before": str(runs.number), "after": str(after.number), "align": ""})
    state = site.project.state()
    assert {"identify", "diagnose", "run", "part", "correct", "compare"} <= {step.kind for step in state.steps}
    look()
    for step in state.steps:
        for path in site.project.pages_of(step).values():
            left.extend((step.kind, text) for text in english_of(path.read_text("utf-8")))
        assert not [text for text in step.warnings if re.search("[äöüß]", text)], (
            "the project itself is kept in English"
        )
    site.workbench.close()
    assert not left, "left in English:\n" + "\n".join(f"{place}: {text}" for place, text in dict.fromkeys(left))


def test_problems_of_commands_are_shown_in_german_with_the_keys_as_they_are_typed(tmp_path, monkeypatch):
    pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
    pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")
    import app_site

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    site = app_site.Site(tmp_path / "project", language="de")
    site.do("machine/describe", MILL)
    site.post("/projects/1/machine/text", {"text": 'name = "x"\nchain = "WXYFZ"\n'})
    page = site.get("/projects/1/machine").text
    assert "axes: fehlt" in page
    assert (
        "chain: die Achsfolge &#39;WXYFZ&#39; ist nicht gültig; erwartet wird W, dann X, Y, Z und F je einmal" in page
    )
    site.post("/projects/1/measurement/add", {"files": [(io.BytesIO(b"no table at all\n"), "a.txt")]})
    assert "enthält keine Tabelle; erwartet wird eine Kopfzeile" in site.get("/projects/1/measurement").text
    site.workbench.close()


def said(capsys, *words):
    code = run_command(cli, words)
    output = capsys.readouterr()
    return code, output.out, output.err


@pytest.mark.parametrize(
    "words",
    [
        ("run", "zha-gantry", LENGTHS, "--controller", "isg-csv", "--no-report", "--out", "{out}"),
        ("import", str(IMPORTS / "linear.rtl"), "--machine", "zha-gantry"),
        ("import", LENGTHS),
        ("plan", "zha-gantry", "--circle", "XY:150", "--out", "{out}"),
        ("compare", "zha-gantry", ERRORS, ERRORS, "--out", "{out}"),
        ("instruments",),
    ],
)  # fmt: skip
def test_commands_print_in_german_with_the_same_numbers(words, tmp_path, capsys):
    def printed(language):
        given = [word.replace("{out}", str(tmp_path / language)) for word in words]
        code, out, err = said(capsys, *given, "--language", language)
        return code, (out + err).replace(str(tmp_path / language), "DIR")

    (code, english), (same, german) = printed("en"), printed("de")
    assert same == code
    assert sorted(numbers(german)) == sorted(numbers(english))
    assert german != english
    lines = (
        line
        for line in german.splitlines()
        if not re.search("constructed|by: |" + "|".join(map(re.escape, (LENGTHS,))), line)
    )
    assert [line for line in lines if left_in_english(line, ())] == []


def test_json_and_results_are_the_same_in_both_languages(tmp_path, capsys):
    """The lists and pages for readers alone have a language."""
    objects = []
    for language in ("en", "de"):
        out = tmp_path / language
        words = ["options", "zha-gantry", ERRORS, "--json", "--language", language, "--out", str(out)]
        code, printed, _ = said(capsys, *words)
        objects.append((code, json.loads(printed), (out / "options.json").read_text()))
    assert objects[0] == objects[1]
    english, german = (next((tmp_path / language).glob("options.md")).read_text("utf-8") for language in ("en", "de"))
    assert "Was jede Stufe übrig lässt" in german
    assert sorted(numbers(german)) == sorted(numbers(english))
    assert left_in_english(german, ()) == []


def test_the_language_ends_with_the_command(tmp_path, capsys):
    assert (
        "Fehler: "
        in said(capsys, "identify", "zha-gantry", "missing.csv", "--out", str(tmp_path), "--language", "de")[2]
    )
    assert "error: " in said(capsys, "identify", "zha-gantry", "missing.csv", "--out", str(tmp_path))[2]


def test_messages_that_a_program_reads_stay_in_english(tmp_path):
    words = ["identify", "zha-gantry", "missing.csv", "--out", str(tmp_path), "--language", "de"]
    texts = []
    for more in ({}, {"COMPGEN_MESSAGES": "en"}):
        command = [sys.executable, "-m", "compgen", *words]
        texts.append(subprocess.run(command, capture_output=True, text=True, env={**os.environ, **more}).stderr)
    assert ["Fehler: " in text for text in texts] == [True, False]
    assert texts[1] == "error: missing.csv: no such file\n"


def test_the_diagnosis_page_and_its_list_say_the_same_in_german(tmp_path, capsys):
    (tmp_path / "xy.circle.csv").write_text(circles_with_backlash())
    for language in ("en", "de"):
        given = ["diagnose", "zha-gantry", str(tmp_path / "xy.circle.csv"), "--out", str(tmp_path / language)]
        said(capsys, *given, "--language", language)
    assert (tmp_path / "en" / "diagnosis.json").read_bytes() == (tmp_path / "de" / "diagnosis.json").read_bytes()
    english, german = ((tmp_path / language / "index.html").read_text("utf-8") for language in ("en", "de"))
    assert sorted(numbers(" ".join(shown(german)))) == sorted(numbers(" ".join(shown(english))))
    assert english_of(german) == []
    assert "die Umkehrspanne (zweimal c) in der Steuerung eintragen" in german
    listed = (tmp_path / "de" / "diagnosis.md").read_text("utf-8")
    assert left_in_english(listed, ()) == []
    assert "| | vorher (µm effektiv) | nachher |" in listed


def test_a_question_and_how_it_is_answered_are_two_messages():
    german = texts_of("de")
    assert german.lines("the file does not state X, Y or Z") == "die Datei nennt weder X, Y noch Z"
    assert german.lines("the file does not state X, Y or Z; give --axis").startswith(
        "die Datei nennt weder X, Y noch Z; "
    )


def test_effects_and_settings_of_all_controls_have_german_texts():
    from compgen.controls import CONTROLLERS
    from compgen.data.toml_files import section_schema
    from compgen.effects import listed
    from compgen.effects.all_effects import what_to_do

    german = texts_of("de")
    texts = [
        text
        for effect in listed().values()
        for text in (effect.card.title, effect.card.breaker, what_to_do(effect.card))
    ]
    for control in CONTROLLERS.values():
        if kind := getattr(control, "settings_class", None):
            texts += [
                about["description"]
                for about in section_schema(kind)["properties"].values()
                if about.get("description")
            ]
    assert len(texts) > 400
    assert [text for text in texts if text and german.text(text) == text and " " in text] == []


def test_rows_of_a_list_keep_their_columns():
    texts = Texts({"label\x04before": "vorher", "label\x04after": "nachher", "not used: {name}": "unbenutzt: {name}"})
    assert texts.lines("name      before    after") == "name      vorher    nachher"
    assert texts.lines("| before | after |") == "| vorher | nachher |"
    assert list(csv.reader([texts.lines("- [ ] not used: X")])) == [["- [ ] unbenutzt: X"]]


def test_kind_and_place_of_a_message_are_german_around_it(tmp_path, capsys):
    (tmp_path / "a.nc").write_text("G21 G90\nG1 X10. F100\nM30\n")
    words = ["correct", "zha-gantry", str(tmp_path / "a.nc"), "--errors", ERRORS, "--dialect", "fanuc"]
    code, _, told = said(capsys, *words, "--out", str(tmp_path / "out"), "--language", "de")
    assert code == 2
    assert " ".join(told.split()).endswith(
        "die Nullpunktverschiebung G54 ist nicht bekannt (angegeben: keine); --wcs G54=X,Y,Z in mm hinzufügen "
        "(Satz: G1 X10. F100)"
    )
    assert told.startswith("Fehler: ")
    german = texts_of("de")
    assert german.lines("warning: a message of a plug-in") == "Warnung: a message of a plug-in"
    assert german.lines("parameter   c1_um: half the reversal value; at most about 100") == (
        "Parameter   c1_um: die halbe Umkehrspanne; höchstens etwa 100"
    )
    assert german.lines("mill.toml: machine, no problem") == "mill.toml: machine, kein Problem"
