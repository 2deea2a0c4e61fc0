"""The page "The two papers, reproduced": up to date, and the deviations that it explains are really there."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import compgen

DOCS = Path(__file__).resolve().parents[1] / "docs"
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
#: Sections whose numbers come from many simulated measurements; with two of them only the words can be compared.
REPEATED = ("### Table 2,", "### Table 3,")
FEW = 2


@pytest.fixture(scope="module")
def papers():
    """The script, with two simulated repetitions in place of its own number."""
    spec = importlib.util.spec_from_file_location("papers_reproduced", DOCS / "papers_reproduced.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    bench, machine = module.bench_figures(FEW), module.machine_figures(FEW)
    module.bench_figures, module.machine_figures = (lambda: bench), (lambda: machine)
    yield module
    del sys.modules[spec.name]


def sections_of(text):
    """Text by heading."""
    parts = re.split(r"^(?=##+ )", text, flags=re.MULTILINE)
    return {part.partition("\n")[0]: part for part in parts}


def last_digit(text):
    """One unit of the last digit of a number as it is written."""
    return 10.0 ** -len(text.partition(".")[2])


def table_3(page):
    """Rows of Table 3 on the page: printed, ours, its uncertainty, ours at the carriage's origin."""
    (section,) = [part for heading, part in sections_of(page).items() if heading.startswith("### Table 3,")]
    rows = {}
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        found = re.fullmatch(r"([\d.]+) \(u ([\d.]+)\)", cells[2]) if len(cells) == 5 else None
        if found:
            own = cells[4] if cells[4] != "-" else "nan"
            rows[cells[0].partition(" (")[0]] = tuple(map(float, (cells[1], *found.groups(), own)))
    return rows


# --- up to date ------------------------------------------------------------------------------------------------------


def test_the_page_is_what_the_script_writes(papers):
    committed, fresh = (sections_of(text) for text in (papers.PAGE.read_text(encoding="utf-8"), papers.page()))
    assert list(committed) == list(fresh)
    for heading, text in fresh.items():
        assert NUMBER.sub("#", committed[heading]) == NUMBER.sub("#", text), heading
        if heading.startswith(REPEATED):
            continue
        for was, now in zip(NUMBER.findall(committed[heading]), NUMBER.findall(text), strict=True):
            assert float(now) == pytest.approx(float(was), abs=1.01 * last_digit(was)), heading


def test_the_pictures_are_drawn_are_small_and_are_on_the_page(papers, tmp_path, monkeypatch):
    monkeypatch.setattr(papers, "FIGURES", tmp_path)
    papers.draw_curves()
    papers.draw_residuals()
    drawn = sorted(tmp_path.iterdir())
    assert [path.name for path in drawn] == ["papers-curves.svg", "papers-residuals.svg"]
    page = papers.PAGE.read_text(encoding="utf-8")
    for path in drawn:
        committed = DOCS / "figures" / path.name
        assert f"(figures/{path.name})" in page
        assert committed.stat().st_size < 80_000
        assert committed.read_text().count("<path") == path.read_text().count("<path")


def test_every_table_and_figure_is_in_the_overview(papers):
    page = papers.PAGE.read_text(encoding="utf-8")
    zha, jia = page.partition("## Zha and Zhang")[0].split("| Jia |")
    for text, tables, figures in ((zha, 7, 10), (jia, 3, 18)):
        named = {"Table": set(), "Figure": set()}
        for line in text.splitlines():
            found = re.match(r"\| (Table|Figure)s? ([\d, to]+) \|", line)
            if found:
                numbers = [int(number) for number in re.findall(r"\d+", found[2])]
                named[found[1]] |= set(range(numbers[0], numbers[-1] + 1) if " to " in found[2] else numbers)
        assert named == {"Table": set(range(1, tables + 1)), "Figure": set(range(1, figures + 1))}


# --- what is printed -------------------------------------------------------------------------------------------------


def test_the_transcribed_stations_are_those_of_the_example(papers):
    _, _, scenario = papers.gantry()
    stated = {
        s.name: [papers.zha("Table 6", f"{s.name} {axis}") for axis in "xyz"] for s in scenario.instrument.stations
    }
    assert stated == {s.name: list(s.position_mm) for s in scenario.instrument.stations}


def test_printed_differences_of_squareness_are_right(papers):
    for name in ("EC0Y", "EB0Z", "EA0Z"):
        authors, software, stated = (
            papers.zha("Table 7", f"{name} {w}") for w in ("authors", "software", "difference")
        )
        assert authors - software == pytest.approx(stated, abs=1e-9)


def test_every_printed_number_has_place_item_unit_and_source(papers):
    for name in ("zha-zhang-2024.csv", "jia-2022.csv"):
        text = (papers.PRINTED / name).read_text(encoding="utf-8")
        assert "CC BY 4.0" in text.partition("place,")[0]
        rows = papers.rows_of(name)
        assert len({(row["place"], row["item"]) for row in rows}) == len(rows)
        assert all(row["unit"] for row in rows)


# --- Zha and Zhang 2024 ----------------------------------------------------------------------------------------------


def test_the_printed_screws_make_the_exact_model(papers):
    figures = papers.model_figures()
    assert figures["screws, square axes"] < 1e-3
    assert 0.05 < figures["screws"] < 0.2  # squareness turns the errors of the carriages there
    assert 3.0 < figures["first order"] < 4.0
    assert figures["frames as they stand"] > 1000.0
    assert figures["frames"] < 0.2


def test_one_product_of_exponentials_by_hand(papers):
    # X turned by 1 mrad about Z at X = -800: dY = -0.8 mm, and 0.4 um back in X
    flat = np.array([0.0])
    errors = compgen.ErrorTable(squareness={"EC0Y": (-1e-3, 0.0), "EB0Z": (0.0, 0.0), "EA0Z": (0.0, 0.0)})
    (moved,) = papers.product_of_exponentials(errors, np.array([[-800.0, -100.0, -50.0]]))
    assert moved == pytest.approx([0.0004, -0.8, 0.0], abs=1e-6)
    turned = compgen.ErrorTable({"EBX": compgen.Curve(flat, flat + 1e-3, flat)}, errors.squareness)
    (both,) = papers.product_of_exponentials(turned, np.array([[-800.0, -100.0, -50.0]]))
    assert both - moved == pytest.approx([-0.05, 0.0, 0.0], abs=1e-4)


def test_equation_9_has_one_other_sign_and_equation_10_three_slips(papers):
    machine, _, _ = papers.gantry()
    ours = papers.columns_of_c(papers.replace(machine, squareness_reference="Y"), (2.0, 3.0, 5.0))
    other = {name: column for name, column in ours.items() if not np.array_equal(column, papers.equation_9(name, 2, 5))}
    assert {name: column.tolist() for name, column in other.items()} == {"EC0Y": [0.0, -2.0, 0.0]}
    assert len(ours) == 17
    assert [papers.row_of_equation_10(k, ours) for k in range(3)] == [
        "17 entries; EB0Z -Z (ours Z)",
        "16 entries; one -Z is missing: that of EAX",
        "16 entries; one 0 is missing: one of EAX, EBX, EXY, EYY",
    ]


@pytest.mark.parametrize("kind", ["grid", "frame"])
@pytest.mark.parametrize("method", ["joint", "two-step"])
def test_stations_and_squareness_come_back(papers, kind, method):
    result = papers.identified_on(kind, method)
    um, in_u = papers.largest_station_deviation(result)
    assert um < 1.0
    assert in_u < 3.5
    for name, (value, u) in result.errors.squareness.items():
        stated = papers.zha("Table 7", f"{name} authors") / papers.URAD
        assert u < 1e-6
        assert abs(value - stated) < 3.5 * u


def test_the_half_hour_lies_between_cross_and_frame(papers):
    (_, _, frame_once), (_, _, frame), (_, _, cross) = (
        papers.duration("frame", False),
        papers.duration("frame"),
        papers.duration("cross"),
    )
    assert cross < papers.zha("Section 5", "duration") < frame
    assert frame_once == pytest.approx(papers.zha("Section 5", "duration"), abs=0.06)
    assert [papers.determined(kind) for kind in ("cross", "frame")] == [False, True]


def test_duration_of_the_cross_by_hand(papers):
    # 33 stops of 3 s; 800 + 1000 + 350 mm along the lines, and the ways from one line to the next, at 1000 mm/min
    between = np.hypot(400.0, 500.0) + np.hypot(500.0, 175.0)
    points, stops, hours = papers.duration("cross", False)
    assert (points, stops) == (31, 33)
    assert hours * 3600 == pytest.approx(
        33 * 3 + (2150 + between) * 60 / 1000, abs=60
    )  # and the way to the first point


def test_both_methods_agree_where_the_printed_programs_differ(papers):
    joint, two = papers.as_noisy_as_figure_9().errors.curves, papers.as_noisy_as_figure_9("two-step").errors.curves
    for _, names, key, unit in papers.PANELS:
        factor = papers.URAD if unit == "urad" else 1e3
        apart = max(factor * np.abs(joint[name].value - two[name].value).max() for name in names)
        assert apart < 0.02 < papers.zha(*key)
    residual = 1e3 * np.abs(papers.as_noisy_as_figure_9().residual_mm).max()
    assert residual == pytest.approx(papers.zha("Figure 9", "authors largest residual"), abs=0.01)


def test_the_printed_maximum_of_figure_10_does_not_follow_from_the_printed_differences(papers):
    stated = papers.zha("Figure 10", "largest difference")
    *components, vector = papers.bound_um(papers.limits_by_figure())
    # by hand: dX = 0.9 + 2.0 + 1.8 um, + 350 mm (1.0 + 0.5 + 1.371 urad), + 1000 mm 0.410 urad
    assert components[0] == pytest.approx(4.7 + 0.35 * 2.871 + 0.41, abs=1e-6)
    assert max(components) < vector < stated
    assert papers.bound_um(papers.limits_of_the_abstract())[-1] > stated


# --- Jia et al. 2022 -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_printed_equations_have_the_wrong_signs_and_ours_do_not(papers, axis):
    t_mm, kappa = papers.OPTICS.reduced_depth_mm, (1, -1, -1)[axis]
    twice_um = 2e3 * t_mm * papers.PUT_IN_ARCSEC * papers.ARCSEC
    for mode in (1, 2):
        straight, roll, drift, yaw = papers.equation_figures(axis, mode)
        assert straight[0] == pytest.approx(kappa * twice_um if mode == 1 else 0.0, abs=2e-3)
        assert roll[0] == pytest.approx(0.0 if axis == 0 else -2 * papers.PUT_IN_ARCSEC, abs=1e-3)
        assert abs(yaw[0]) == pytest.approx(papers.DRIFT_ARCSEC / 2, abs=1e-3)
        assert abs(drift[0]) > 0.03
        assert np.abs([straight[1], roll[1], drift[1], yaw[1]]).max() < 1e-3


def test_traced_spots_follow_equations_8_to_10(papers):
    lines = papers.optical_lines()
    assert len(lines) == 8
    for place, axis, name, arcsec, signal, _, slope in lines:
        distance_mm, traced_um = papers.traced_um(axis, name, arcsec, signal)
        assert len(distance_mm) == 17
        assert np.abs(traced_um).max() > 25.0
        assert traced_um == pytest.approx(1e3 * slope * arcsec * papers.ARCSEC * distance_mm, abs=1e-3), place


def test_squareness_of_section_5_2_comes_back(papers):
    for pair, (value, u) in papers.squareness_outcome().items():
        assert u < 0.6
        assert abs(value - papers.jia("Section 5.2", pair)) < 3 * u


def test_half_ranges_of_table_3_come_back_at_the_tool(papers):
    rows = table_3(papers.PAGE.read_text(encoding="utf-8"))
    assert len(rows) == 21
    for name, (stated, ours, u, _) in rows.items():
        fresh, _ = papers.machine_figures()[name]
        assert fresh[0] == pytest.approx(ours, abs=5 * np.sqrt(papers.SEEDS / FEW) * u)
        if not name.startswith("squareness"):
            assert ours == pytest.approx(stated, abs=3.5 * u + 0.01)


def test_the_two_deviations_of_table_3(papers):
    rows = table_3(papers.PAGE.read_text(encoding="utf-8"))
    stated, _, u, own = rows["horizontal Y"]
    assert own > 3 * stated + 3 * u
    assert papers.machine_figures()["horizontal Y"][0][1] > 2 * stated
    for pair in ("S_xy", "S_yz"):
        stated, ours, u, _ = rows[f"squareness {pair}"]
        assert ours + 5 * u < stated / 2


def test_the_metric_of_the_paper_by_hand(papers):
    machine = compgen.load_machine("jia-xytz")
    nodes = machine.axes[0].nodes_mm
    line = 5.0 + 0.01 * nodes
    assert papers.half_range([[0.0, 1.0, 2.0], [0.0, 4.0, 2.5], [0.0, 2.0, 1.0]]) == 1.5
    assert papers.evened(machine, "EYX", line) == pytest.approx(np.zeros(17), abs=1e-12)
    assert papers.evened(machine, "EXX", line) == pytest.approx(0.01 * nodes, abs=1e-12)
    assert papers.evened(machine, "ECX", line)[0] == 0.0
