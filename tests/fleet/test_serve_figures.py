"""What the dashboard works out beside the requests: drift with forecast, shortest re-check; and what a page costs."""

import re
import threading
import time
from datetime import timedelta

import numpy as np
import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import serve_site as helper
import sqlalchemy as sa
from steps import steps

from compgen.data.lengths import read_points
from compgen.errors import InputError
from compgen.fleet import claims, database, decisions
from compgen.fleet import claims as results
from compgen.fleet.dashboard import app as reading
from compgen.fleet.dashboard import background
from compgen.fleet.dashboard.background import Background, NotReadyError
from compgen.fleet.dashboard.charts import ChartSeries, chart
from compgen.fleet.recheck import shortest_recheck
from compgen.fleet.records import NewMeasurement, NewResult, RequestedChange, StoredTableFile
from compgen.fleet.store import counting
from compgen.identification.covariance import Covariance, format_covariance
from compgen.planning import planned_stations

factory = helper.factory
STATIONS = {"LT1": [-300.0, -400.0, 100.0], "LT2": [800.0, -300.0, 50.0], "LT3": [-200.0, 700.0, -250.0]}
STATIONS |= {"LT4": [700.0, 600.0, 150.0]}


@pytest.fixture
def site(tmp_path):
    made = helper.Site(tmp_path)
    yield made
    made.store.close()


# --- beside the requests ----------------------------------------------------------------------------------------------


def test_a_result_is_worked_out_once_and_kept():
    beside, calls = Background(), []

    def work():
        calls.append(threading.current_thread().name)
        return 7

    assert [beside.get("key", work, 20.0) for _ in range(3)] == [7, 7, 7]
    assert len(calls) == 1
    assert calls[0].startswith("figures")


def test_whoever_asks_is_not_kept_waiting_and_finds_the_result_later():
    beside, go_on = Background(), threading.Event()

    def work():
        go_on.wait(30.0)
        return "done"

    with pytest.raises(NotReadyError):
        beside.get("key", work, 0.05)  # while the work still waits
    go_on.set()
    assert beside.get("key", work, 20.0) == "done"


def test_more_questions_than_may_wait_are_turned_away(monkeypatch):
    monkeypatch.setattr(background, "WAITING", 3)
    beside, go_on, asked = Background(), threading.Event(), []
    for key in range(10):
        with pytest.raises(NotReadyError):
            beside.get(key, lambda key=key: asked.append(key) or go_on.wait(30.0), 0.01)
    go_on.set()
    beside.get(0, lambda: None, 20.0)
    beside.get(2, lambda: None, 20.0)
    assert asked == [0, 1, 2]


def test_results_that_were_not_asked_for_longest_are_forgotten(monkeypatch):
    monkeypatch.setattr(background, "MOST", 3)
    beside, made = Background(), []
    for key in (1, 2, 3, 1, 4, 5, 1, 2):
        beside.get(key, lambda key=key: made.append(key), 20.0)
    assert made == [1, 2, 3, 4, 5, 2]
    assert len(beside._known) <= 3


def test_what_is_wrong_with_the_data_is_kept_and_a_fault_is_tried_again():
    beside, asked = Background(), []

    def wrong():
        asked.append("wrong")
        raise InputError("no")

    def fault():
        asked.append("fault")
        raise RuntimeError("away")

    for _ in range(2):
        with pytest.raises(InputError):
            beside.get("wrong", wrong, 20.0)
        with pytest.raises(RuntimeError):
            beside.get("fault", fault, 20.0)
    assert asked == ["wrong", "fault", "fault"]


def test_a_page_says_that_figures_are_being_worked_out_and_loads_itself_again(site, monkeypatch):
    monkeypatch.setattr(background, "PATIENCE_S", 0.0)
    monkeypatch.setattr(reading, "A_MOMENT_S", 0.0)
    go_on = threading.Event()
    real = site.app.extensions["compgen"].drift_of._background
    monkeypatch.setattr(
        real,
        "get",
        lambda key, work, patience_s=None: Background.get(real, key, lambda: go_on.wait(30) and work(), 0.0),
    )
    text = site.get("/machines/1/drift").text
    assert "being calculated" in text
    assert '<meta http-equiv="refresh" content="3">' in text
    assert "being calculated" in site.get("/machines/1").text
    go_on.set()
    until = time.monotonic() + 60.0
    while "Changes</h2>" not in (text := site.get("/machines/1/drift").text):
        assert time.monotonic() < until
        time.sleep(0.05)
    assert "refresh" not in text


# --- drift and forecast -----------------------------------------------------------------------------------------------


JOB = """\
store = "store.sqlite"
[machines.mill-9]
machine = "mill.toml"
inbox = "inbox"
controllers = ["isg-csv"]
out = "tables"
measured_with = "active"
"""
TOLERANCE = "[machines.mill-9.tolerances]\nEC0Y_urad = {}\n"


def tracked(store, name="mill-9", months=8, stations=None):
    """A machine whose EC0Y grows by 3 urad a month, with covariance, measured with four tracers."""
    machine = store.add_machine(name)
    position = np.arange(0.0, 600.0, 100.0)
    error = ("EXX",) * len(position) + ("EC0Y",)
    factor = np.diag([0.3e-3] * len(position) + [0.8e-6])
    joint = Covariance(error, np.append(position, np.nan), (), np.zeros(0, dtype=np.int64), factor)
    listed = [{"station": key, "setup": 0, "position_mm": place} for key, place in (stations or STATIONS).items()]
    for month in range(months):
        at = factory.BEGIN + timedelta(days=30.4375 * month)
        new = NewMeasurement(f"{month:064x}", f"{month}.lengths.csv", at, "file", {"a": b"%d" % month})
        claim = claims.take(store, store.add_measurement(machine, new), claims.owner_name())
        active = decisions.active_table(store, machine)
        text = factory.errors_text(10.0 + 3.0 * month, 1.0)
        result = NewResult(
            machine_text=factory.MACHINE_TOML,
            errors_text=text,
            covariance=format_covariance(joint, text.decode()),
            fitted_text=None,
            summary={"stations": listed, "identified": ["EXX", "EC0Y"]},
            program="test",
            active_table_id=None if active is None else active.id,
            files=[StoredTableFile("isg-csv", "table.csv", b"%d" % month)],
            accepted=True,
            hold=[],
            judgement={},
            approve=month == 0,
            settings_sha256="0",
            seconds=1.0,
        )
        results.keep_result(store, machine, claim, result, None if active is None else active.id)
    return machine


@pytest.fixture
def tracked_site(tmp_path, monkeypatch):
    """A dashboard with a job file that knows a tolerance, and the machine that drifts."""
    monkeypatch.setattr(background, "PATIENCE_S", 60.0)
    monkeypatch.setattr(reading, "A_MOMENT_S", 60.0)
    (tmp_path / "recal.toml").write_text(JOB + TOLERANCE.format(50.0))
    made = helper.Site(tmp_path, job=tmp_path / "recal.toml")
    machine = tracked(made.store)
    yield made, machine, f"/machines/{machine.id}"
    made.store.close()


def cells(text, name, after=""):
    row = re.search(rf'{after}.*?<th scope="row">{name}</th>(.*?)</tr>', text, re.S)[1]
    return re.findall(r"<td[^>]*>(.*?)</td>", row)


def test_rate_and_forecast_are_those_of_the_simulated_drift(tracked_site):
    """3 urad a month from 10; seven months are over of the 16.7 until the tolerance of 50 urad: 9.7 months are left."""
    site, _, address = tracked_site
    text = site.get(f"{address}/drift").text
    found = cells(text, "EC0Y", "Trends and forecasts")
    rate, expanded = float(found[0]), float(found[1])
    assert abs(rate - 3.0) <= expanded < 0.6
    assert (found[2], found[4], found[6]) == ("&lt; 0.001", "µrad", "50.00")
    told = re.search(r"EC0Y leaves tolerance in about (\d+) months, 95 % (\d+)-(\d+)", found[7])
    assert int(told[2]) <= 9.7 <= int(told[3])
    assert "limit of the tolerance" in text
    page = site.get(address).text
    assert "EC0Y leaves tolerance in about" in page
    assert "µrad" in page
    assert " urad" not in page


def test_an_edited_job_file_and_an_excluded_measurement_count_at_once(tracked_site, tmp_path):
    site, machine, address = tracked_site
    (tmp_path / "recal.toml").write_text(JOB + TOLERANCE.format(75.0))
    assert cells(site.get(f"{address}/drift").text, "EC0Y", "Trends and forecasts")[6] == "75.00"
    site.store.add_event("exclusion", "version 8", "excluded by ada: wrong probe", machine)
    assert "version 8 is left out (ada: wrong probe)" in site.get(f"{address}/drift").text
    (tmp_path / "recal.toml").unlink()
    assert cells(site.get(f"{address}/drift").text, "EC0Y", "Trends and forecasts")[6] == "–"


# --- re-check ---------------------------------------------------------------------------------------------------------


def test_the_recheck_is_that_of_the_program_for_the_stations_of_the_last_calibration(tracked_site, tmp_path):
    site, machine, address = tracked_site
    store, newest = site.store, counting(site.store, machine)[-1]
    known = (store.machine_of(newest), planned_stations(STATIONS))
    plan = shortest_recheck(*known, RequestedChange("EC0Y", 20e-6), store.covariance_of(newest))
    text = site.get(f"{address}/recheck?error=EC0Y&change=20").text
    assert f"{len(plan.position_mm)}, {plan.readings} readings of 4 stations" in text
    answer = site.get(f"{address}/recheck.points.csv?error=EC0Y&change=20")
    assert answer.headers["Content-Disposition"] == 'attachment; filename="recheck.points.csv"'
    (tmp_path / "r.points.csv").write_bytes(answer.data)
    np.testing.assert_allclose(read_points(tmp_path / "r.points.csv").position_mm, plan.position_mm, atol=5e-4)
    assert f'href="{address}/recheck.points.csv?error=EC0Y&amp;change=20"' in text


def test_without_a_wish_the_page_asks_for_the_tolerance(tracked_site):
    site, _, address = tracked_site
    text = site.get(f"{address}/recheck").text
    assert "<option selected>EC0Y</option>" in text
    assert 'value="50"' in text


@pytest.mark.parametrize(
    "query",
    [
        "change=0",
        "change=-5",
        "change=nan",
        "change=inf",
        "change=1e99",
        "change=x",
        "change=%00",
        "error=EZZ",
        "error='--",
    ]
    + ["error=%3Cscript%3E&change=%22%3E%3Cscript%3E"],
)
def test_wishes_that_are_none_are_told_so_and_stay_texts(tracked_site, query):
    site, _, address = tracked_site
    answer = site.get(f"{address}/recheck?{query}")
    assert answer.status_code == 200
    assert 'class="message warn"' in answer.text
    assert "<script" not in answer.text
    assert site.get(f"{address}/recheck.points.csv?{query}").status_code == 409


def test_a_machine_that_was_not_measured_with_tracers_is_told_so(site):
    assert "where its tracers were" in site.get("/machines/1/recheck").text
    assert site.get("/machines/1/recheck.points.csv").status_code == 409
    assert site.get("/machines/99/recheck").status_code == 404


# --- what a page costs ------------------------------------------------------------------------------------------------


#: What refers to what, in the order in which rows are added.
REFERENCES = {
    "machines": {},
    "machine_versions": {"machine_id": "machines"},
    "measurements": {"machine_id": "machines"},
    "identifications": {
        "machine_id": "machines",
        "measurement_id": "measurements",
        "machine_version_id": "machine_versions",
    },
    "tables": {"machine_id": "machines", "identification_id": "identifications"},
    "attempts": {"machine_id": "machines", "measurement_id": "measurements"},
    "decisions": {"machine_id": "machines", "table_id": "tables"},
}
#: Ids of a copy lie this far beyond those of the copy before.
APART = 1000


def copied(store, machine, number):
    """Add copies of a machine with all that belongs to it."""

    def action(connection):
        for name, references in REFERENCES.items():
            table = database.metadata.tables[name]
            own = table.c.id == machine.id if name == "machines" else table.c.machine_id == machine.id
            rows = [dict(row._mapping) for row in connection.execute(sa.select(table).where(own))]
            made = []
            for k in range(1, number + 1):
                for row in rows:
                    shifted = {key: row[key] and row[key] + APART * k for key in ("id", *references)}
                    made.append(row | shifted | ({"name": f"copy-{k:04d}"} if name == "machines" else {}))
            connection.execute(sa.insert(table), made)

    store.write(action)


def cost_of(site, path):
    """Status, number of statements and steps (tests/steps.py) of a page that was asked for before."""
    answers, count = [site.get(path)], []

    def seen(connection, cursor, statement, *rest):
        count.append(statement)

    sa.event.listen(site.store.engine, "before_cursor_execute", seen)
    needed = steps(lambda: answers.append(site.get(path)))
    sa.event.remove(site.store.engine, "before_cursor_execute", seen)
    return answers[-1].status_code, len(count), needed


def test_pages_of_500_machines_with_a_year_of_history_take_as_many_queries_and_a_few_steps_a_machine(tracked_site):
    site, _, _ = tracked_site
    year = tracked(site.store, "year", months=12)
    paths = ("/", "/?q=copy&status=pending&page=2", f"/machines/{year.id}", f"/machines/{year.id}/tables/12")
    paths += ("/audit", "/audit?who=people&page=3", "/metrics", f"/machines/{year.id}/drift")
    few = {path: cost_of(site, path) for path in paths}
    copied(site.store, year, 500)
    assert f"{len(site.store.machines())} machines" in re.sub(r"<[^>]+>", "", site.get("/").text)
    for path in paths:
        status, queries, needed = cost_of(site, path)
        assert (status, queries) == (200, few[path][1]), path
        assert queries <= 40, path
        assert needed - few[path][2] <= 100 * 500, path  # a machine more adds what it takes to show it


def test_a_longer_history_needs_no_more_queries(tracked_site):
    site, machine, _ = tracked_site
    year = tracked(site.store, "year", months=12)
    for path in ("/machines/{}", "/machines/{}/tables/8", "/machines/{}/drift"):
        (_, first, _), (_, second, _) = (cost_of(site, path.format(item.id)) for item in (machine, year))
        assert first == second, path


# --- fleet, steps, what is left out -----------------------------------------------------------------------------------


def test_the_fleet_shows_trend_and_tolerance(tracked_site, monkeypatch):
    """3 urad a month; 21 of the 50 urad are used up since the active tables, so 9.7 months are left."""
    monkeypatch.setattr(background, "REST_S", 0.05)
    site, machine, _ = tracked_site
    until = time.monotonic() + 60.0
    while "EC0Y leaves tolerance" not in (text := site.get("/").text):
        assert time.monotonic() < until
        time.sleep(0.2)
    row = re.search(rf'href="/machines/{machine.id}">mill-9</a></th>(.*?)</tr>', text, re.S)[1]
    rate = float(re.search(r"EC0Y \+(\d\.\d\d) µrad a month", row)[1])
    assert abs(rate - 3.0) < 0.3
    told = re.search(r"EC0Y leaves tolerance in about (\d+) months, 95 % (\d+)-(\d+)", row)
    assert int(told[2]) <= 9.7 <= int(told[3])
    mill = re.search(r'href="/machines/1">mill-1</a></th>(.*?)</tr>', text, re.S)[1]
    assert "nothing beyond the uncertainty" in mill or "being calculated" in mill


def test_the_fleet_is_worked_out_only_when_nobody_asks_for_anything(monkeypatch):
    monkeypatch.setattr(background, "REST_S", 0.1)
    beside, done, go_on = Background(), [], threading.Event()
    beside.began()  # a request is under way
    for key in (1, 2, 2):
        beside.later(key, lambda key=key: done.append(key))
    time.sleep(0.5)
    assert done == []
    with pytest.raises(NotReadyError):
        beside.get("page", lambda: go_on.wait(30.0), 0.01)
    beside.ended()
    time.sleep(0.4)
    assert done == []  # somebody still waits for figures
    go_on.set()
    until = time.monotonic() + 20.0
    while done != [1, 2]:
        assert time.monotonic() < until
        time.sleep(0.05)
    monkeypatch.setattr(background, "AT_LATEST_S", 0.3)
    beside.began()  # a server that never rests
    beside.later(3, lambda: done.append(3))
    while done != [1, 2, 3]:
        assert time.monotonic() < until
        time.sleep(0.05)


def test_what_fails_in_an_idle_moment_stops_nothing(monkeypatch):
    monkeypatch.setattr(background, "REST_S", 0.01)
    beside, done = Background(), threading.Event()
    beside.later("fault", lambda: 1 / 0)
    beside.later("next", done.set)
    assert done.wait(20.0)


def test_the_axis_of_a_chart_reaches_round_numbers_with_the_same_decimals():
    drawn = chart("c", [ChartSeries("a", [0.0, 250.0, 1000.0], [-0.3, 0.0, 1.9])])
    assert [text for _, text in drawn.y_ticks] == ["\N{MINUS SIGN}0.5", "0.0", "0.5", "1.0", "1.5", "2.0"]
    assert [text for _, text in drawn.x_ticks] == ["0", "200", "400", "600", "800", "1000"]
    assert (drawn.y_ticks[0][0], drawn.y_ticks[-1][0]) == (drawn.bottom, drawn.top)
    flat = chart("c", [ChartSeries("a", [5.0], [3.0])])  # one value lies in the middle of both axes
    assert [text for _, text in flat.y_ticks] == ["1", "2", "3", "4", "5"]
    assert flat.lines[0][1] == f"{(flat.left + flat.right) / 2},{(flat.top + flat.bottom) / 2}"


def test_an_excluded_measurement_is_grey_and_out_of_the_scale(tracked_site):
    """A measurement of 10 mrad: with it in the scale, the drift of 3 urad a month would be a flat line."""
    site, machine, address = tracked_site
    wild = factory.errors_text(10_000.0, 1.0)
    new = NewMeasurement("e" * 64, "wild.lengths.csv", factory.BEGIN + timedelta(days=300), "file", {"a": b"wild"})
    claim = claims.take(site.store, site.store.add_measurement(machine, new), claims.owner_name())
    active = decisions.active_table(site.store, machine)
    files = [StoredTableFile("isg-csv", "table.csv", b"wild")]
    common = {"machine_text": factory.MACHINE_TOML, "covariance": None, "fitted_text": None, "summary": {}}
    rest = {"program": "test", "accepted": True, "hold": [], "judgement": {}, "approve": False, "seconds": 1.0}
    result = NewResult(errors_text=wild, active_table_id=active.id, files=files, settings_sha256="0", **common, **rest)
    table = results.keep_result(site.store, machine, claim, result, active.id)

    def chart_of(text):
        return re.search(r"<figcaption>EC0Y, value.*?</figure>", text, re.S)[0]

    def labels(text):
        return [float(found) for found in re.findall(r'text-anchor="end">([0-9.]+)</text>', chart_of(text))]

    assert max(labels(site.get(address).text)) >= 8000.0
    site.store.add_event("exclusion", f"version {table.version}", "excluded by ada: wrong probe", machine)
    text = site.get(address).text
    assert max(labels(text)) < 60.0
    out = re.search(r'<g class="out">(.*?)</g>', chart_of(text), re.S)[1]
    (place,) = re.findall(r'cy="([0-9.]+)"', out)
    assert float(place) == 12.0  # the upper edge
    assert "left out (excluded)" in chart_of(text)
    newest = re.search(r'<th scope="row">EC0Y</th><td>value</td><td class="number">([^<]+)<', text)[1]
    assert newest == "31.00"


def test_a_change_that_equals_the_tables_asks_whether_they_were_on_or_off(tmp_path):
    site = helper.Site(tmp_path)
    machine = site.store.machine("mill-1")
    for number, (sign, word) in enumerate([(-1, "off"), (1, "on")], start=20):
        new = NewMeasurement(
            f"{number:064d}", "x", factory.BEGIN + timedelta(days=900 + number), "file", {"a": b"%d" % number}
        )
        claim = claims.take(site.store, site.store.add_measurement(machine, new), claims.owner_name())
        active = decisions.active_table(site.store, machine)
        like = {"field": "version 2", "sign": sign, "correlation": 0.98 * sign, "size": 1.03 * sign, "p_value": 1e-7}
        common = {"machine_text": factory.MACHINE_TOML, "covariance": None, "fitted_text": None, "summary": {}}
        rest = {
            "program": "test",
            "accepted": True,
            "hold": ["seems to have changed"],
            "approve": False,
            "seconds": 1.0,
        }
        result = NewResult(
            errors_text=factory.errors_text(1.0, 1.0),
            active_table_id=active.id,
            files=[StoredTableFile("isg-csv", "table.csv", b"%d" % number)],
            settings_sha256="0",
            judgement={"likeness": like},
            **common,
            **rest,
        )
        table = results.keep_result(site.store, machine, claim, result, active.id)
        text = site.get(f"/machines/{machine.id}/tables/{table.version}").text
        assert f"Were the tables {word} while it was measured?" in text
        assert "size 1.03" in text
    assert "Were the tables" not in site.get(f"/machines/{machine.id}/tables/3").text
    site.store.close()
