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
