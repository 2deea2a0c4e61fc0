"""What results show in a session and a notebook: short lines, escaped tables, pictures of the right figures."""

import html.parser
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import compgen
from compgen.accuracy import accuracy_of_errors, compare_errors, error_source
from compgen.data.axis_runs import AxisRuns
from compgen.diagnose import diagnose
from compgen.drawing.display import Bars, Displayed, Drawable, Overview, Panel, PlottedLine, drawn, html_of, shortened
from compgen.identification import joint_covariance
from compgen.pipeline import ControllerResult, RunResult

matplotlib.use("Agg")
LONGEST = 200  # characters of a repr: two lines
BACKLASH_UM = 4.0


class Cells(html.parser.HTMLParser):
    """The rows of the table of a page, and the tags that it uses."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.tags, self.inside = [], set(), False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.inside = True

    def handle_endtag(self, tag):
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.rows[-1][-1] += data


def axis_runs():
    """Five cycles along X with backlash: the tip stands at +4 um after positive travel, at -4 um after negative travel."""
    generator = np.random.default_rng(4)
    positions, runs = np.arange(0.0, 501.0, 50.0), np.arange(5)
    rows = [(p, d, r) for r in runs for d in (1, -1) for p in positions[::d]]
    position, direction, run = (np.array(column) for column in zip(*rows, strict=True))
    value_mm = 1e-3 * (BACKLASH_UM * direction + generator.normal(0.0, 0.2, len(rows)))
    return AxisRuns(np.zeros(len(rows), dtype=np.int64), position.astype(float), direction, run, value_mm)


@pytest.fixture(scope="module")
def shown(example, tmp_path_factory):
    """One of each kind of result, by the name of its class."""
    machine, errors = example.machine, example.fitted.errors
    exported = compgen.export(machine, errors, "isg-csv")
    tables = compgen.read_tables(machine, exported.write(tmp_path_factory.mktemp("tables")), "isg-csv")
    verified = compgen.verify(machine, tables, example.identified.errors)
    stations = compgen.planned_stations({"A": (-900, -1100, -400), "B": (100, -1100, -400), "C": (100, 100, -400)})
    corners = np.array([[x, y, z] for x in (-800, -400, 0) for y in (-1000, -500, 0) for z in (-350, 0)], dtype=float)
    source, other = error_source(machine, errors), error_source(machine, example.truth)
    items = [
        machine,
        machine.axes[0],
        compgen.read_lengths("examples/zha-gantry.lengths.csv"),
        compgen.Points(corners),
        compgen.Deviations(corners, np.full(corners.shape, 1e-3)),
        errors,
        errors.curves["EXX"],
        compgen.ReversalCurves({(0, 0): compgen.Curve(np.zeros(1), np.array([8e-3]), np.zeros(1))}),
        example.identified,
        joint_covariance(example.identified),
        example.fitted,
        exported,
        tables,
        verified,
        RunResult(example.identified, example.fitted, (ControllerResult(exported, verified, ()),)),
        compgen.plan(machine, stations, compgen.Points(corners)),
        compgen.read_scenario("examples/zha-gantry.scenario.toml"),
        accuracy_of_errors(source),
        compare_errors(source, other),
        diagnose(compgen.load_machine("moving-table-mill"), axis_runs()),
    ]
    return {type(item).__name__: item for item in items}


def test_every_result_has_a_short_line_and_a_table(shown):
    assert len(shown) == 20
    for name, item in shown.items():
        assert isinstance(item, Displayed)
        line = repr(item)
        assert line.startswith(f"<{name}: ")
        assert "\n" not in line
        assert len(line) <= LONGEST, line
        cells = Cells(item._repr_html_())
        assert cells.tags <= {"p", "b", "table", "tr", "th", "td"}
        assert len({len(row) for row in cells.rows}) <= 1, name


def test_the_line_of_an_identification_has_its_quality(shown):
    found = shown["Identification"]
    assert repr(found) == (
        "<Identification: 17 errors from 10648 of 10648 readings (joint), residual 0.279 um rms, reduced chi-square 0.999>"
    )
    assert repr(shown["Machine"]) == "<Machine: zha-gantry, chain WFYXZT>"
    assert "accepted, tool-tip error 1715 to " in repr(shown["Verification"])
    assert repr(shown["RunResult"]) == "<RunResult: isg-csv accepted>"


def test_the_table_of_errors_has_signed_values_in_um_and_urad(shown):
    errors = compgen.ErrorTable(
        {
            "EXX": compgen.Curve(
                np.array([0.0, 100.0, 200.0]), np.array([0.0, 2e-3, -5e-3]), np.array([0.0, 1e-4, 3e-4])
            ),
            "EAX": compgen.Curve(np.array([0.0, 200.0]), np.array([0.0, 7e-6]), np.full(2, np.nan)),
        },
        {"EC0Y": (-30e-6, 1e-6)},
    )
    assert Cells(errors._repr_html_()).rows == [
        ["error", "largest", "at (mm)", "u (k = 1)", "unit"],
        ["EXX", "-5.000", "200", "0.300", "um"],
        ["EAX", "+7.000", "200", "", "urad"],
        ["EC0Y", "-30.000", "", "1.000", "urad"],
    ]
    panels = errors.panels()
    assert [(panel.title, panel.y_label, [line.label for line in panel.lines]) for panel in panels] == [
        ("errors of X", "error (um)", ["EXX"]),
        ("errors of X", "error (urad)", ["EAX"]),
    ]
    assert panels[0].lines[0].y.tolist() == pytest.approx([0.0, 2.0, -5.0])


def test_residuals_are_drawn_as_reading_minus_model_as_in_the_files(shown):
    found = shown["Identification"]
    (line,) = found.panels()[-1].lines
    assert line.y[0] == pytest.approx(-1e3 * found.residual_mm[found.accepted][0])
    assert len(line.y) == 10648


def test_the_diagnosis_shows_the_name_and_the_smaller_residual(shown):
    found = shown["AxisDiagnosis"]
    assert repr(found) == "<AxisDiagnosis: moving-table-mill: named: backlash_X>"
    (row,) = Cells(found._repr_html_()).rows[1:]
    assert row[:2] == ["backlash_X", "confirmed"]
    before, after = found.panels()[0].bars
    assert before.values[0] > BACKLASH_UM * 0.9 > 5 * after.values[0]


def test_the_picture_of_a_verification_ends_at_the_largest_errors(shown):
    found = shown["Verification"]
    before, after = found.panels()[0].lines
    assert (before.x[-1], after.x[-1]) == pytest.approx((found.before.max_um, found.after.max_um), rel=1e-6)
    assert (before.y[0], before.y[-1]) == (0.0, 100.0)


def test_every_drawable_result_draws_its_panels(shown):
    drawable = {name: item for name, item in shown.items() if isinstance(item, Drawable)}
    assert len(drawable) == 9
    for item in drawable.values():
        figure = item.plot(Figure(layout="constrained"))
        assert len(figure.axes) == len(item.panels())
        assert all(axes.lines or axes.patches for axes in figure.axes)


def test_a_picture_of_its_own_is_made_without_a_figure_and_nothing_is_no_picture():
    import matplotlib.pyplot as plt

    figure = compgen.ErrorTable({"EXX": compgen.Curve(np.arange(3.0), np.zeros(3), np.zeros(3))}).plot()
    assert figure.number in plt.get_fignums()
    plt.close(figure)
    with pytest.raises(ValueError, match="nothing to draw: no errors"):
        compgen.ErrorTable().plot()


def test_a_picture_without_matplotlib_says_which_extra_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(compgen.InputError, match=r"pictures need matplotlib; install compgen\[plot\]"):
        compgen.ErrorTable({"EXX": compgen.Curve(np.arange(3.0), np.zeros(3), np.zeros(3))}).plot()


def test_texts_are_escaped():
    text = html_of(Overview("<script>a</script>", ("a&b", "c"), (("<i>", '"'),), ("<b>",)))
    assert Cells(text).rows == [["a&b", "c"], ["<i>", '"']]
    assert not {"script", "i"} & Cells(text).tags


def test_panels_draw_lines_with_bands_of_two_uncertainties_and_bars_side_by_side():
    line = PlottedLine("EXX", np.array([0.0, 1.0]), np.array([1.0, 2.0]), np.array([0.5, 0.5]))
    bars = (Bars("before", ("a", "b"), (3.0, 4.0)), Bars("after", ("a", "b"), (1.0, 2.0)))
    figure = drawn([Panel("lines", "um", (line,)), Panel("bars", "um", bars=bars)], "title", Figure())
    left, right = figure.axes
    low, high = (edge(left.collections[0].get_paths()[0].vertices[:, 1]) for edge in (min, max))
    assert (low, high) == (0.0, 3.0)
    assert [patch.get_height() for patch in right.patches] == [3.0, 4.0, 1.0, 2.0]
    assert right.patches[0].get_x() + right.patches[0].get_width() == pytest.approx(right.patches[2].get_x())


def test_long_lists_are_shortened():
    assert shortened(["a", "b"]) == "a, b"
    assert shortened(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"
