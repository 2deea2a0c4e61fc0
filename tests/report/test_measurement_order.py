"""The measurement order: the sheets have the places that the instrument needs, and empty cells for what it reads."""

import re
from dataclasses import replace

import numpy as np
import pytest

from compgen.planning.next_measurement import (
    ALONG,
    BALLS,
    NextBest,
    NextMeasurement,
    candidates,
    unmeasured,
)
from compgen.report.measurement_order import RUNS, order_page, order_sheets


@pytest.fixture(scope="module")
def order(small_machine):
    """A sheet of every kind of measurement, by its code."""
    first = {}
    for item in candidates(unmeasured(small_machine)):
        first.setdefault(item.code, item)
    found = NextBest(small_machine, 3.0, tuple(NextMeasurement(item, 3.0, 2.0, ("EXX",)) for item in first.values()))
    return found, dict(zip(first, order_sheets(found), strict=True)), first


def test_an_axis_run_has_its_targets_over_the_travel_and_a_cell_for_each_run_and_direction(order, small_machine):
    (table,) = order[1]["axis_run"].tables
    assert len(table.columns) == 1 + 2 * RUNS
    low, high = small_machine.axes[0].range_mm
    assert [float(row[0]) for row in table.rows] == pytest.approx(np.linspace(low, high, ALONG), abs=0.05)
    assert all(len(row) == 1 for row in table.rows)


def test_plates_have_the_balls_of_each_set_up_in_machine_coordinates(order, small_machine):
    sheet, candidate = order[1]["plate_heights"], order[2]["plate_heights"]
    assert [len(table.rows) for table in sheet.tables] == [BALLS**2, BALLS**2]
    heights = [{float(row[3]) for row in table.rows} for table in sheet.tables]
    assert heights == [{round(float(line[0, 2]), 1)} for line in candidate.lines_mm]
    corners = np.array([[float(v) for v in row[1:3]] for row in sheet.tables[0].rows])
    assert corners.min(axis=0) == pytest.approx(candidate.lines_mm[0][:, :2].min(axis=0), abs=0.06)


def test_a_tracer_has_its_stations_and_every_target_once(order):
    stations, targets = order[1]["laser_tracer"].tables
    assert len(stations.rows) == 4
    assert len({row[1:] for row in targets.rows}) == len(targets.rows) == 44  # 12 edges of 5 targets, corners once


def test_a_square_has_a_table_for_each_arm(order):
    headings = [table.heading for table in order[1]["square"].tables]
    assert ["along X" in headings[0], "along Y" in headings[1]] == [True, True]


def test_the_page_has_a_sheet_with_conditions_for_each_measurement_loads_nothing_and_escapes(order):
    found = replace(order[0], machine=replace(order[0].machine, name="<script>alert(1)</script>"))
    page = order_page(found)
    assert page.count('<section class="sheet">') == len(order[1])
    assert page.count("Instrument, serial number") == len(order[1])
    assert "break-after:page" in page
    assert "<script" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_plan_writes_the_order_in_the_language_of_the_reader(small_machine, tmp_path, call):
    assert call("plan", small_machine.source, "--language", "de", "--out", tmp_path)[0] == 0
    page = (tmp_path / "order.html").read_text()
    assert "Durchgeführt von" in page
    assert "Instrument, serial number" not in page


def test_balls_of_a_plate_that_lies_is_turned_and_stands_are_where_the_probe_finds_them(small_machine):
    """By hand: at (x, y) of the plate from its centre c, flat c + (x, y, 0), turned about Z by +90 degrees c + (-y, x, 0),
    upright in ZX c + (x, 0, y), upright in YZ c + (0, y, x); a ball has the same number in every set-up."""
    places = {
        "flat": lambda x, y: (x, y, 0.0),
        "turned": lambda x, y: (-y, x, 0.0),
        "ZX": lambda x, y: (x, 0.0, y),
        "YZ": lambda x, y: (0.0, y, x),
    }
    seen = set()
    for item in candidates(unmeasured(small_machine)):
        if item.code not in ("plate", "plate_turned", "plate_upright"):
            continue
        edge_mm = float(re.search(r"balls, ([\d.]+) mm", item.how)[1])
        centre = np.array([float(v) for v in re.search(r"at X (\S+), Y (\S+), Z (\S+) mm", item.how).groups()])
        side = [(k / (BALLS - 1) - 0.5) * edge_mm for k in range(BALLS)]
        second = "turned" if item.code == "plate_turned" else item.what[-2:]
        found = NextBest(small_machine, 3.0, (NextMeasurement(item, 3.0, 2.0, ("EXX",)),))
        for table, lies in zip(order_sheets(found)[0].tables, ("flat", second), strict=False):
            by_hand = [centre + places[lies](x, y) for x in side for y in side]
            assert np.array([row[1:] for row in table.rows], dtype=float) == pytest.approx(np.array(by_hand), abs=0.051)
            seen.add(lies)
    assert seen == set(places)


def test_a_sheet_in_german_and_inch_has_no_english_heading_and_no_place_in_mm(small_machine, tmp_path, call):
    options = ("--language", "de", "--units", "inch", "--out", tmp_path)
    assert call("plan", small_machine.source, *options)[0] == 0
    page = (tmp_path / "order.html").read_text()
    cells = set(re.findall(r"<t[hd][^>]*>([^<>]+)<", page))
    assert {"Kugel Nr.", "Ziel Nr.", "Station 4: Länge, in", "gemessen X in"} <= cells
    assert not cells & {"target no.", "ball no.", "run no.", "circle direction", "file name", "as set up, there"}
    assert "centre at" not in page
    headings = re.findall(r"<h1>([^<]+)</h1>", page)
    assert all(text.endswith(" in") for text in headings if " bei " in text), headings
