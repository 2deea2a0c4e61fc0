"""Sheets to print: the pictures contain the readings at their places, the figures those of the worked example."""

import base64
import json
import math
import re
from pathlib import Path

import browser as helper
import numpy as np
import pytest
from texts.reading import left_in_english, shown

from compgen.data.circles import arcs_of

#: The statement of the certificate stands behind those of the program, which are German.
ENGLISH_REST = ([], ["ISO 230-2:2014; an veröffentlichten Formeln und gerechneten Beispielen geprüft, nicht zertifiziert. "
                     "Traceability: The instruments are calibrated; their certificates are named with them."])  # fmt: skip
GOLDEN_CSV = Path(__file__).resolve().parents[1] / "golden" / "accuracy" / "iso230_2_constructed_golden.csv"


def write_runs(path, axes="X", shift=-500.0, comments=()):
    """The worked example of deviations (um) at five targets as axis runs of the given axes."""
    lines = [*(f"# {text}" for text in comments), "axis,position_mm,direction,run,deviation_um,temp_bed_c"]
    rows = [line.split(",") for line in GOLDEN_CSV.read_text().splitlines() if line[:1].isdigit()]
    for axis in axes:
        for target, direction, *values in rows:
            for run, value in enumerate(values):
                lines.append(f"{axis},{float(target) + shift:g},{direction},{run},{value},{20 + 0.1 * run:.1f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_circle(path, radius=150.0, angles=range(0, 360, 6), comments=()):
    """30 urad of squareness, 3 um of reversal of X, a centre that is off by 40 and -25 um (formulas of the page on circles)."""
    lines = [*(f"# {text}" for text in comments), "plane,radius_mm,angle_deg,direction,deviation_um"]
    values = {}
    for direction in (1, -1):
        for angle in angles:
            a = math.radians(angle)
            shape = 30e-3 * radius * math.sin(a) * math.cos(a)
            reversal = 1.5 * math.cos(a) * np.sign(round(-direction * math.sin(a), 9))
            values[direction, angle] = shape + reversal
            off = 40.0 * math.cos(a) - 25.0 * math.sin(a)
            lines.append(f"XY,{radius:g},{angle},{direction},{shape + reversal + off:.6f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return values


def axes_of(page):
    """The first axes of each picture: frame and limits."""
    found = re.findall(r'class="axes"[^>]* data-frame="([^"]+)" data-limits="([^"]+)"', page)
    return [tuple(np.array(part.split(), dtype=float) for part in pair) for pair in found]


def paths_of(page, role, width):
    """Points (n, 2) of every line of a colour and width, in units of the picture."""
    pattern = rf'<path d="(M[^"]+)" fill="none"[^>]*style="stroke:var\(--{role}\);stroke-width:{width:g}"'
    return [np.array(re.findall(r"-?[\d.]+", path), dtype=float).reshape(-1, 2) for path in re.findall(pattern, page)]


def values_of(points, frame, limits):
    """Points of a picture in units of the data."""
    (left, top, right, bottom), (x0, x1, y0, y1) = frame, limits
    x = x0 + (points[:, 0] - left) / (right - left) * (x1 - x0)
    return np.column_stack([x, y0 + (bottom - points[:, 1]) / (bottom - top) * (y1 - y0)])


def test_german_sheets_are_german_but_for_what_the_laboratory_says(tmp_path, call):
    runs, circle = write_runs(tmp_path / "x.axis.csv", comments=["operator = M. Muster"]), tmp_path / "c.circle.csv"
    write_circle(circle)
    lab = Path(__file__).resolve().parents[2] / "examples" / "certificate.toml"
    said = lab.read_text(encoding="utf-8")
    for file, more in ((runs, ("--certificate", lab, "--tolerance", "A=18")), (circle, ())):
        code, _, error = call("accuracy", "zha-gantry", file, *more, "--language", "de", "--out", tmp_path / "out")
        assert code == 0, error
        page = (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
        english = [text for text in shown(page) if left_in_english(text, ())]
        assert [text for text in english if text not in said and text.split(", ")[-1] not in said] == ENGLISH_REST[
            more != ()
        ]
    assert "Kreisformprüfung XY, Radius 150 mm, ISO 230-4" in page
    assert json.loads((tmp_path / "out" / "accuracy.json").read_text())["statements"][0].startswith(
        "ISO 230-4, about the centre"
    )


def test_the_sheet_of_an_axis_has_the_worked_figures_and_draws_the_means(tmp_path, call):
    runs = write_runs(tmp_path / "x.axis.csv", comments=["operator = M. <b>Muster</b>", "instrument = laser"])
    code, _, error = call("accuracy", "zha-gantry", runs, "--out", tmp_path / "out")
    assert code == 0, error
    page = (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
    assert page.count('<section class="sheet">') == 1
    assert "Positioning of X, ISO 230-2:2014" in page
    for key, value in {"A": 19, "E": 12, "R": 13, "B": 4, "M": 8, "A up": 17, "VDI P": 23}.items():
        row = re.search(rf'<th scope="row">{key}</th><td class="n">([^<]+)<', page)
        assert float(row.group(1)) == value
    assert "M. &lt;b&gt;Muster&lt;/b&gt;" in page and "<b>Muster" not in page
    assert "20.00 °C before, 20.40 °C after" in page
    frame, limits = axes_of(page)[0]
    for role, means in (("c0", (2, 6, 0, -2, 5)), ("c1", (-1, 2, -3, -6, 2))):
        (mean,) = paths_of(page, role, 1.8)
        found = values_of(mean, frame, limits)
        np.testing.assert_allclose(found[:, 0], np.arange(-500, -99, 100), atol=0.1)
        np.testing.assert_allclose(found[:, 1], means, atol=0.02)
    # the ranges beside the picture, and B and R where they are largest: 4 um at -400 mm, 13 um at -100 mm
    for name, value in (("A", 19), ("E", 12), ("M", 8)):
        assert f">{name} {value:.1f}<" in page
    marks = re.findall(r'<path d="M([\d.]+) ([\d.]+)V([\d.]+)" fill="none"[^>]*--ink\);stroke-width:1.6"', page)
    per_um = (frame[3] - frame[1]) / (limits[3] - limits[2])
    found = [(float(a), abs(float(c) - float(b)) / per_um) for a, b, c in marks]
    at = [limits[0] + (place - frame[0]) / (frame[2] - frame[0]) * (limits[1] - limits[0]) for place, _ in found]
    assert [round(size, 1) for _, size in found] == [4.0, 13.0]
    np.testing.assert_allclose(at, [-400, -100], atol=10.0)


def test_tolerances_are_judged_with_the_uncertainty(tmp_path, call):
    runs = write_runs(tmp_path / "xy.axis.csv", axes="XY")
    options = ("--tolerance", "A=40", "--tolerance", "Y.A=5", "--tolerance", "M=8.1")
    code, text, error = call("accuracy", "zha-gantry", runs, *options, "--json", "--out", tmp_path / "out")
    assert code == 0, error
    data = json.loads(text)
    assert data["tolerances"] == {
        "X": {"M": {"tolerance_um": 8.1, "verdict": "not proven"}, "A": {"tolerance_um": 40.0, "verdict": "within"}},
        "Y": {"M": {"tolerance_um": 8.1, "verdict": "not proven"}, "A": {"tolerance_um": 5.0, "verdict": "exceeded"}},
    }
    page = (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
    assert page.count('<section class="sheet">') == 2
    assert page.count('class="exceeded">exceeded<') == 1


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("Q=3", "Q is not a figure of this measurement; use one of B, B_mean"),
        ("A=-3", "'A=-3' is not a tolerance; expected FIGURE=UM above zero"),
        ("A", "'A' is not a tolerance"),
        ("Z.A=3", "Z A is not a figure of this measurement"),
    ],
)
def test_a_wrong_tolerance_is_refused_and_nothing_is_written(tmp_path, call, option, message):
    runs = write_runs(tmp_path / "x.axis.csv")
    code, _, error = call("accuracy", "zha-gantry", runs, "--tolerance", option, "--out", tmp_path / "out")
    assert code == 2
    assert message in " ".join(error.split())
    assert not (tmp_path / "out").exists()


def test_laboratory_customer_and_conditions_come_from_a_file(tmp_path, call):
    example = Path(__file__).resolve().parents[2] / "examples" / "certificate.toml"
    runs = write_runs(tmp_path / "x.axis.csv")
    code, _, error = call("accuracy", "zha-gantry", runs, "--certificate", example, "--out", tmp_path / "out"
    )  # fmt: skip
    assert code == 0, error
    page = (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
    for text in (
        "Example Works, Sampleville", "serial number 0001", "A. Example, Head of the laboratory", "19.6 to 20.4 °C",
        "45 %", "1012 hPa", "certificate EX-2026-0003", "2026-11-09 to 2026-11-10",
    ):  # fmt: skip
        assert text in page


@pytest.mark.parametrize("angles", [range(0, 360, 6), range(20, 161, 4)], ids=["full", "arc"])
def test_the_polar_diagram_shows_the_readings_at_its_scale(tmp_path, call, angles):
    write_circle(tmp_path / "c.circle.csv", angles=angles)
    code, _, error = call("accuracy", "zha-gantry", tmp_path / "c.circle.csv", "--out", tmp_path / "out")
    assert code == 0, error
    page = (tmp_path / "out" / "sheet.html").read_text(encoding="utf-8")
    step, magnification = map(float, re.search(r"([\d.]+) µm per division, magnification (\d+)", page).groups())
    frame, limits = axes_of(page)[0]
    centre = np.array([(frame[0] + frame[2]) / 2, (frame[1] + frame[3]) / 2])
    np.testing.assert_allclose(limits, [-1, 1, -1, 1])
    (nominal,) = paths_of(page, "muted", 1.1)
    zero = np.linalg.norm(nominal - centre, axis=1).mean()
    rings = sorted(
        np.linalg.norm(ring - centre, axis=1).mean() for ring in paths_of(page, "grid", 0.6) if len(ring) > 9
    )
    per_um = (rings[-1] - zero) / (3 * step)
    assert rings[0] == pytest.approx(zero - 3 * step * per_um, abs=0.01)
    assert magnification == pytest.approx(per_um / 1e-3 / (zero / 150.0), rel=0.01)
    # the readings of the file about their own centre, by an independent fit
    rows = [line.split(",") for line in (tmp_path / "c.circle.csv").read_text().splitlines()[1:]]
    a, way, value = (np.array([float(row[k]) for row in rows]) for k in (2, 3, 4))
    a = np.radians(a)
    normal = np.array(
        [[np.sum(f * g) for g in (np.cos(a), np.sin(a), 1 + 0 * a)] for f in (np.cos(a), np.sin(a), 1 + 0 * a)]
    )
    x, y, _ = np.linalg.solve(normal, [np.sum(value * f) for f in (np.cos(a), np.sin(a), 1 + 0 * a)])
    radial = value - x * np.cos(a) - y * np.sin(a)
    closed = len(angles) == 60
    for role, sign in (("c0", 1), ("c1", -1)):
        (path,) = paths_of(page, role, 1.3)
        assert len(path) == len(angles) + closed
        own = way == sign
        place = path[:-1] - centre if closed else path - centre
        turned = np.arctan2(-place[:, 1], place[:, 0])  # pictures count downwards
        np.testing.assert_allclose(np.cos(turned - a[own]), 1.0, atol=1e-6)
        drawn = (np.linalg.norm(place, axis=1) - zero) / per_um
        np.testing.assert_allclose(drawn, radial[own], atol=0.02 * step + 0.02)


@pytest.mark.parametrize(
    ("degrees", "arcs"),
    [
        ([90, 0, 30, 60], [[0, 30, 60, 90]]),
        (range(0, 360, 90), [[0, 90, 180, 270, 0]]),
        ([350, 355, 0, 5, 100, 105, 110], [[350, 355, 0, 5], [100, 105, 110]]),
        ([310, 170, 180, 300, 190], [[170, 180, 190], [300, 310]]),
    ],
)
def test_a_gap_ends_an_arc_and_a_full_circle_is_closed(degrees, arcs):
    angle = np.radians(np.array(degrees, dtype=float))
    found = arcs_of(angle, np.arange(len(angle)))
    assert [np.rint(np.degrees(angle[rows])).astype(int).tolist() for rows in found] == arcs


@pytest.mark.skipif(helper.program() is None, reason="chromium is not installed: the sheet is not printed")
def test_each_axis_is_one_printed_page(tmp_path, call):
    pytest.importorskip("websocket")
    runs = write_runs(tmp_path / "xyz.axis.csv", axes="XYZ", shift=-420.0)
    example = Path(__file__).resolve().parents[2] / "examples" / "certificate.toml"
    code, _, error = call("accuracy", "zha-gantry", runs, "--certificate", example, "--out", tmp_path / "out"
    )  # fmt: skip
    assert code == 0, error
    (tmp_path / "browser").mkdir()
    page = helper.Browser(tmp_path / "browser")
    try:
        events = page.open(tmp_path / "out" / "sheet.html")
        pdf = base64.b64decode(page.call("Page.printToPDF", printBackground=False)["data"])
    finally:
        page.close()
    assert not [event for event in events if event.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")]
    assert len(re.findall(rb"/Type ?/Page[\n ]", pdf)) == 3
