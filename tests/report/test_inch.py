"""Pages, tables and questions in inch: the same numbers as in mm, each once converted; files do not change."""

import json
import re
from html import unescape

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.drawing.charts import Plot, rescaled, svg
from compgen.drawing.page_units import page_in_inch
from compgen.units import Inch, converted, typed_mm

# exact by definition of the inch (25.4 mm) and of the second of arc (a turn is 1 296 000 of them)
PER = {"um": 1.0 / 2.54, "mm": 1.0 / 25.4, "urad": 1296000.0 / (2e6 * np.pi), "um/m": 12.0 * 1e-6 * 1e4, "none": 1.0}
NUMBER = re.compile(r"(?<![\w.])\d[\d\u202f]*(?:\.\d+)?(?:e-?\d+)?(?![\w.]*\d)")
METRIC = re.compile(r"(?<![\w/])(?:mm|[uµ]m|[uµ]rad)(?!\w)")


def call(*words):
    return run_command(cli, [str(word) for word in words])


@pytest.fixture(scope="module")
def both(small_machine_file, small_lengths_file, tmp_path_factory):
    """The same run with pages in mm and in inch."""
    folder = tmp_path_factory.mktemp("inch")
    words = ["run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--out"]
    assert call(*words, folder / "mm") == call(*words, folder / "inch", "--units", "inch") == 0
    return folder


def texts_of(page):
    """Texts between the tags of a page, but those of files, scripts and pictures, whose ticks are other round numbers."""
    page = re.sub(
        r"<(script|style|svg|code|pre|select)\b.*?</\1>",
        "",
        re.sub(r"<svg x=.*?</svg>", "", page, flags=re.S),
        flags=re.S,
    )
    page = re.sub(r'<p class="note units">.*?</p>\n?', "", page)
    texts = (unescape(text).strip() for text in re.split(r"<[^>]*>", page))
    return [text for text in texts if text]


def last_digit(text):
    """Half of what the last digit of a number counts."""
    return 0.5 * 10.0 ** -len(text.partition("e")[0].partition(".")[2]) * 10.0 ** int(text.partition("e")[2] or 0)


def unit_of_pair(metric, inch):
    """The unit by which two numbers differ, within the rounding of both; nothing if there is none."""
    a, b = (float(text.replace("\u202f", "")) for text in (metric, inch))
    fits = (
        u
        for u in ("none", *PER)
        if abs(a * PER[u] - b) <= 1.001 * (last_digit(metric) * PER[u] + last_digit(inch)) + 1e-9
    )
    return next(fits, None)


def compared(metric, inch):
    """Pairs of texts that differ; each number in them is once converted."""
    assert len(metric) == len(inch)
    for a, b in zip(metric, inch, strict=True):
        numbers = [NUMBER.findall(re.sub(r"0\.0001 in(?:/ft|ch)?", "", text)) for text in (a, b)]
        assert len(numbers[0]) == len(numbers[1]), (a, b)
        assert None not in [unit_of_pair(*pair) for pair in zip(*numbers, strict=True)], (a, b)
    return [pair for pair in zip(metric, inch, strict=True) if pair[0] != pair[1]]


def test_every_number_of_the_report_is_that_of_the_page_in_mm_and_no_metric_unit_is_left(both):
    pages = [(both / name / "report.html").read_text() for name in ("mm", "inch")]
    shown = [texts_of(re.sub(r"<(\w+)[^>]* data-as-in-file.*?</\1>", "", page, flags=re.S)) for page in pages]
    changed = compared(*shown)
    assert len(changed) > 200
    assert [text for text in shown[1] if METRIC.search(text)] == []


def test_the_rows_of_the_report_in_inch_are_the_numbers_of_its_json(both):
    page, data = (both / "inch" / "report.html").read_text(), json.loads((both / "inch" / "report.json").read_text())
    for row in data["errors"]:
        cells = re.search(rf'<th scope="row">{row["error"]}</th><td>[^<]*</td>(.*?)</tr>', page)[1]
        largest, at, expanded, unit = re.findall(r"<td[^>]*>([^<]*)</td>", cells)
        per = PER[row["unit"]]
        assert float(largest.replace("−", "-")) == pytest.approx(row["largest"] * per, abs=1.1e-3)
        assert float(expanded) == pytest.approx(row["U"] * per, abs=1.1e-3)
        assert (at == "") == (row["at_mm"] is None) and (
            not at or float(at) == pytest.approx(row["at_mm"] / 25.4, abs=6e-4)
        )
        assert unit == {"um": "0.0001 in", "urad": "arcsec"}[row["unit"]]
    before = re.search(r'largest error \|e\|</th><td class="n">([\d.]+)', page)[1]
    assert float(before) == pytest.approx(data["controls"][0]["before"]["max_um"] / 2.54, rel=0.01)


def test_the_data_of_the_files_do_not_depend_on_the_units(both):
    names = sorted(path.name for path in (both / "mm").iterdir() if path.is_file())
    assert names == sorted(path.name for path in (both / "inch").iterdir() if path.is_file())
    differ = [n for n in names if (both / "mm" / n).read_bytes() != (both / "inch" / n).read_bytes()]
    assert differ == ["report.html"]


def test_pictures_have_round_numbers_in_inch_at_their_places(both):
    data = [
        json.loads(re.search(r'id="data">(.*?)</script>', (both / name / "report.html").read_text(), re.S)[1])
        for name in ("mm", "inch")
    ]
    mm, inch = (item["curve-EXX"] for item in data)
    np.testing.assert_allclose(inch["series"][0]["x"], np.array(mm["series"][0]["x"]) / 25.4, rtol=1e-6)
    np.testing.assert_allclose(inch["series"][0]["y"], np.array(mm["series"][0]["y"]) / 2.54, rtol=1e-6)
    np.testing.assert_allclose(inch["limits"], np.array(mm["limits"]) / [25.4, 25.4, 2.54, 2.54], rtol=1e-6)


def test_a_tick_in_inch_is_drawn_where_that_length_is():
    plot = Plot((0.0, 254.0), (-5.08, 5.08), (0.0, 0.0, 200.0, 100.0), x_label="X (mm)", y_label="µm")
    made = rescaled(str(svg("k", "over X in mm", [plot])), Inch())
    across = re.findall(r'<text x="([\d.]+)" y="110.8" text-anchor="middle"[^>]*>(\d+)<', made)
    assert across and all(float(x) == pytest.approx(20.0 * int(number), abs=0.06) for x, number in across)
    up = re.findall(r'y="([\d.]+)" text-anchor="end"[^>]*>(−?\d+)<', made)
    assert up and all(float(y) - 3.2 == pytest.approx(50.0 - 25.0 * int(n.replace("−", "-")), abs=0.11) for y, n in up)
    assert re.findall(r"<text[^>]*>(X \(in\)|0\.0001 in)</text>", made) == ["X (in)", "0.0001 in"]
    assert "&lt;" not in made and made.count("<text") == made.count("</text>")


@pytest.mark.parametrize(
    ("text", "inch"),
    [
        ("25.4 um", "10.00 tenths"),
        ("5.08 -> 2.54 um max", "2.00 -> 1.00 tenths max"),
        ("5.08 / 2.54 um", "2.00 / 1.00 tenths"),
        ("+-25.4 um (k = 2) over 254 mm", "+-10.00 tenths (k = 2) over 10 in"),
        ("LT1 (254, -508, 0) mm", "LT1 (10, -20, 0) in"),
        ("X -254 ... 254, Y 0 ... 508 mm", "X -10 ... 10, Y 0 ... 20 in"),
        ("100 um/m", "12.0 tenths/ft"),
        ("100 urad", "20.6 arcsec"),
        ("17 of 21 errors, run 3, 2.54 um", "17 of 21 errors, run 3, 1.00 tenths"),
        ("3 um.csv and a_12mm.csv", "3 um.csv and a_12mm.csv"),
        ("`--radius 100 mm`", "`--radius 100 mm`"),
        ("is it 24 mm or inch?", "is it 24 mm or inch?"),
        ("11.5 um/(m K)", "11.5 um/(m K)"),
        ("G54.1 X100", "G54.1 X100"),
    ],
)
def test_a_sentence_in_inch(text, inch):
    assert Inch().text(text) == inch


def test_german_has_no_zehntel_because_these_are_tenths_of_a_millimetre():
    assert Inch("de").text("2.54 µm bis 5.08 µm, 3 um") == "1.00 × 0.0001 in bis 2.00 × 0.0001 in, 1.2 × 0.0001 in"
    assert Inch("de").text("von 25.4 auf 5.08 µm") == "von 10.00 auf 2.00 × 0.0001 in"
    assert Inch("de").text("es geht um 3 Punkte; µm") == "es geht um 3 Punkte; 0.0001 in"


def test_a_number_keeps_what_it_is_known_by():
    for value in ("0.02", "1", "9.99", "0.5", "123", "0.001"):
        assert abs(float(converted(value, "um")) * 2.54 - float(value)) <= 0.13 * float(value), value


def test_fields_of_a_form_and_what_users_wrote_stay_in_their_units():
    page = (
        '<html lang="en"><head><title>5.08 um</title></head><body><h1 data-as-in-file>mill 254 mm</h1>'
        '<form><label>Radius, mm <input value="254 mm"></label><figure><figcaption>5.08 µm</figcaption></figure></form>'
        "<pre>254 mm</pre><table><thead><tr><th>n</th><th>at, mm</th><th>value</th><th>unit</th></tr></thead>"
        "<tbody><tr><td>1</td><td>254</td><td>&lt;5.08</td><td>µm</td></tr><tr><td>1</td><td>254</td><td>100</td><td>µrad</td></tr>"
        "</tbody></table></body></html>"
    )
    made = page_in_inch(page)
    for kept in ("mill 254 mm", "Radius, mm", 'value="254 mm"', "<pre>254 mm</pre>"):
        assert kept in made
    for shown in (
        "<title>2.00 tenths",
        "<figcaption>2.00 tenths",
        "<td>10</td><td>&lt;2.00</td><td>0.0001 in",
        "<td>20.6</td>",
    ):
        assert shown in made
    assert page_in_inch(made) == made


def test_the_terminal_shows_the_tables_in_inch(both, small_machine_file, small_lengths_file, tmp_path, capsys):
    words = ["identify", small_machine_file, small_lengths_file, "--out"]
    shown = []
    for units in ("mm", "inch"):
        assert call(*words, tmp_path / units, "--units", units) == 0
        shown.append([line for line in capsys.readouterr().out.splitlines() if str(tmp_path) not in line])
    rows = [[line.split() for line in lines if re.match(r" +E[A-Z0]{2,3} ", line)] for lines in shown]
    assert len(rows[0]) == len(rows[1]) > 10
    for metric, inch in zip(*rows, strict=True):
        sizes = [[cell.lstrip("+-") for cell in row if re.fullmatch(r"[+-]?\d[\d.]*", cell)] for row in (metric, inch)]
        unit = "um" if "um" in metric else "urad"
        # the last cells of a row in inch are "0.0001 in"
        units = [unit_of_pair(a, b) for a, b in zip(sizes[0], sizes[1], strict=False)]
        assert units[0] == unit and units[-1] == unit, (metric, inch)
    assert METRIC.search("\n".join(shown[1])) is None


def test_the_configuration_states_the_units_and_an_option_comes_before_it(
    both, tmp_path, monkeypatch, capsys, small_machine_file
):
    path = tmp_path / "config.toml"
    path.write_text('units = "inch"\n')
    monkeypatch.setenv("COMPGEN_CONFIG", str(path))
    assert call("report", both / "mm", "--out", tmp_path / "a") == 0
    assert (tmp_path / "a" / "report.html").read_bytes() == (both / "inch" / "report.html").read_bytes()
    assert call("report", both / "mm", "--out", tmp_path / "b", "--units", "mm") == 0
    assert (tmp_path / "b" / "report.html").read_bytes() == (both / "mm" / "report.html").read_bytes()
    path.write_text('units = "furlong"\n')
    assert call("machines") == 2
    assert "config.toml" in capsys.readouterr().err


def test_json_is_the_same_in_inch(both, capsys):
    found = []
    for units in ("mm", "inch"):
        assert call("report", both / "mm", "--json", "--units", units) == 0
        found.append(capsys.readouterr().out)
    assert found[0] == found[1]


@pytest.mark.parametrize("typed", ["24in", '24"', "24 inch", "2ft", "609.6", "609,6mm", "60.96cm"])
def test_a_length_that_is_typed_may_say_its_unit(typed):
    assert typed_mm(typed) == 609.6


def test_a_machine_whose_travel_looks_like_inch_is_warned_of(tmp_path, capsys):
    axes = "".join(
        f"[axes.{letter}]\nrange_mm = [0.0, {size}]\nnodes = 5\n"
        for letter, size in zip("XYZ", (23.6, 15.7, 20.0), strict=True)
    )
    path = tmp_path / "small.toml"
    path.write_text(f'name = "small"\nchain = "WFYXZT"\n{axes}')
    errors = tmp_path / "e.errors.csv"
    errors.write_text("error,position_mm,value,u_value\nEXX,0,0,1\nEXX,23.6,2,1\n")
    call("fit", path, errors, "--out", tmp_path / "out")
    assert "was it meant in inch?" in capsys.readouterr().err
