"""Numbers that a person typed, beside a measurement of the same: compared, refused or adjusted together, each counted once."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.circles import PLANES, Circles
from compgen.data.error_table import ARMS as CURVES_OF_ARMS
from compgen.data.error_table import (
    Curve,
    ErrorTable,
    ReversalCurves,
    format_errors,
    read_errors,
    square_spans_mm,
)
from compgen.data.names import ERROR_NAMES, error_named
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError
from compgen.foreign.converted import given_errors
from compgen.identification import joint_covariance
from compgen.identification.any_measurement import MixedMeasurement
from compgen.identification.options import StatedNumbers
from compgen.identification.posterior import processes_of
from compgen.pipeline import identified_reversal, identify_beside
from machines import machine_of

B_UM, SQUARE_URAD, SCALE_UM_PER_M = -5.9, 30.0, 20.0
#: No learning: then what is known before and a number combine as two normal numbers do.
FIXED = PriorSettings(class_name="general", learn="no")
NONE = PriorSettings(class_name="none")


TRAVEL_MM = ((0.0, 600.0), (0.0, 400.0), (0.0, 300.0))


def mill(prior=FIXED, reference_mm=(0.0, 0.0, 0.0), chain="WFYXZT"):
    return machine_of(TRAVEL_MM, (7, 5, 4), chain, reference_point_mm=reference_mm, prior=prior)


def runs(*, ways=(1, -1), reversal_um=B_UM, scale=SCALE_UM_PER_M, axis=0):
    """Three runs of 13 targets of an axis with a scale and a reversal."""
    rng = np.random.default_rng(4)
    rows = [(x, way, run) for run in range(3) for way in ways for x in np.linspace(0.0, 600.0 - 200.0 * axis, 13)]
    at, way, run = (np.array(column) for column in zip(*rows, strict=True))
    value = 1e-6 * scale * at + 5e-4 * reversal_um * way + rng.normal(0.0, 2e-4, len(at))
    return AxisRuns(np.full(len(at), axis), at, way.astype(int), run.astype(int), value)


def circle(*, square=SQUARE_URAD, reversal_um=B_UM):
    """A circle of 120 mm in XY with both directions, of a squareness and a reversal of X (docs/instruments.md)."""
    angle = np.radians(np.tile(np.arange(0.0, 360.0, 3.0), 2))
    way = np.repeat([1, -1], len(angle) // 2)
    value = -0.5 * 120.0 * 1e-6 * square * np.sin(2 * angle) + np.random.default_rng(5).normal(0.0, 2e-4, len(angle))
    value += np.cos(angle) * -way * np.sign(np.round(np.sin(angle), 9)) * 5e-4 * reversal_um
    count = len(angle)
    zeros, nan = np.zeros(count, dtype=int), np.full(count, np.nan)
    plane = np.full(count, list(PLANES).index("XY"))
    centre = np.tile([300.0, 200.0, 150.0], (count, 1))
    return Circles(plane, angle, np.full(count, 120.0), value, way, zeros, zeros, centre, nan)


def beside(machine, numbers, *measured):
    """Identify measurements with numbers, as the commands do."""
    stated = numbers.errors(machine)
    parts = [(f"file {k}", part) for k, part in enumerate(measured)]
    parts += [("command line", stated)] if stated is not None else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        return identify_beside(machine, parts[0][1] if len(parts) == 1 else MixedMeasurement(tuple(parts)), numbers)


def both(one, other):
    """Two normal numbers of the same: their mean and standard uncertainty."""
    weight = np.array([1.0 / one[1] ** 2, 1.0 / other[1] ** 2])
    return (one[0] * weight[0] + other[0] * weight[1]) / weight.sum(), weight.sum() ** -0.5


def slope_of(found):
    """What is known of the slope of EXX from end to end, rad: mean and standard uncertainty."""
    ends = np.array([0.0, 600.0])
    weights = np.array([-1.0, 1.0]) / 600.0
    factor = found.posterior.values_factor(["EXX"], [ends])
    return weights @ found.posterior.curve("EXX", ends).value, np.linalg.norm(weights @ factor)


# --- reversal --------------------------------------------------------------------------------------------------------

MEASURED = {"axis runs": runs, "circle": circle}


@pytest.mark.parametrize("kind", MEASURED)
@pytest.mark.parametrize("text", ["-6", "-6±0.5", "B=6", "B=+6±0.5", "0±0.5", "0.06mm", "20"])
def test_a_backlash_that_contradicts_the_measured_reversal_is_refused(kind, text):
    """The table would have had twice the play: 13 values near -5.9 um became one of +6."""
    with pytest.raises(InputError, match=r"contradicts that of the measurement, B = -5\.\d+ um.*En = ") as found:
        beside(mill(), StatedNumbers(backlash={"X": text}), MEASURED[kind]())
    assert ("opposite sign" in str(found.value)) == (text in ("-6", "-6±0.5", "B=6", "B=+6±0.5"))


@pytest.mark.parametrize("prior", [FIXED, NONE])
@pytest.mark.parametrize("kind", MEASURED)
@pytest.mark.parametrize(
    ("text", "typed", "u"), [("6.5±0.4", -6.5, 0.4), ("B=-6.5±0.4", -6.5, 0.4), ("6.8", -6.8, 1.0)]
)
def test_a_backlash_that_agrees_is_adjusted_with_the_measured_reversal(kind, text, typed, u, prior):
    """The mean of the reversal and the number, each with its weight; of a number at no place, its spread counts, too."""
    machine, measured = mill(prior), MEASURED[kind]()
    alone = beside(machine, StatedNumbers(), measured).reversal_curves.curves[0, 0]
    curve = beside(machine, StatedNumbers(backlash={"X": text}), measured).reversal_curves.curves[0, 0]
    own = 1e3 * alone.value.mean(), 1e3 * np.linalg.norm(alone.u) / len(alone.u)
    mean, _ = both(own, (typed, np.hypot(u, 1e3 * np.std(alone.value))))
    assert 1e3 * curve.value.mean() == pytest.approx(mean, abs=1e-6)
    assert curve.position_mm.tolist() == alone.position_mm.tolist()  # its shape over the travel stays
    assert np.ptp(curve.value - alone.value) == pytest.approx(0.0, abs=1e-12)
    assert (curve.u <= alone.u).all()


def test_a_backlash_beside_that_of_the_machine_file_and_a_tracer_is_compared_with_it():
    found = beside(mill(), StatedNumbers(), runs(ways=(1,)))
    shown = replace(
        found, reversal_curves=ReversalCurves({(0, 0): Curve(np.zeros(1), np.full(1, -6e-3), np.full(1, 1e-3))})
    )
    assert 1e3 * identified_reversal(shown).curves[0, 0].value[0] == pytest.approx(-6.0)
    from compgen.pipeline import with_reversal

    with pytest.raises(InputError, match="opposite sign"):
        with_reversal(shown, StatedNumbers(backlash={"X": "-6±1"}).reversal())
    joined = with_reversal(shown, StatedNumbers(backlash={"X": "7±1"}).reversal()).reversal_curves.curves[0, 0]
    assert (1e3 * joined.value[0], 1e3 * joined.u[0]) == pytest.approx(both((-6.0, 1.0), (-7.0, 1.0)))


@pytest.mark.parametrize("letter", "XYZ")
def test_the_sign_of_a_reversal_value_is_asked_where_nothing_shows_it(letter):
    """Runs in one direction show no reversal: -6 may be the B of ISO 230-2, or an axis that runs ahead."""
    machine, one_way = mill(), runs(ways=(1,))
    with pytest.raises(InputError, match=f"{letter}=B=-6, the same as {letter}=6; for .* ahead {letter}=B=\\+6"):
        beside(machine, StatedNumbers(backlash={letter: "-6"}), one_way)
    axis = "XYZ".index(letter)
    for text, um in (("6", -6.0), ("B=-6", -6.0), ("b = -6±1", -6.0), ("B=+6", 6.0), ("0", 0.0), ("B=-0.006mm", -6.0)):
        curve = beside(machine, StatedNumbers(backlash={letter: text}), one_way).reversal_curves.curves[axis, axis]
        assert 1e3 * curve.value[0] == pytest.approx(um)


def test_two_instruments_that_show_different_reversals_are_a_reservation():
    found = beside(mill(), StatedNumbers(), runs(), circle(reversal_um=6.0))
    assert any("disagree in the reversal of X: B = -5.89 and +6.07 um" in text for text in found.doubts)
    assert beside(mill(), StatedNumbers(), runs(), circle()).doubts == ()


# --- squareness ------------------------------------------------------------------------------------------------------

GIVEN = ErrorTable({}, {"EC0Y": (30e-6, 3e-6)}, {"source": "granite square"})


@pytest.mark.parametrize("prior", [FIXED, NONE])
def test_a_squareness_beside_a_file_of_the_same_counts_once(prior):
    found = beside(mill(prior), StatedNumbers(squareness={"EC0Y": "34±4"}), GIVEN).errors.squareness["EC0Y"]
    assert (1e6 * found[0], 1e6 * found[1]) == pytest.approx(both((30.0, 3.0), (34.0, 4.0)), rel=0.01)


@pytest.mark.parametrize(("text", "typed"), [("20±4", (20.0, 4.0)), ("45±3", (45.0, 3.0)), ("25", (25.0, 5.0))])
def test_a_squareness_beside_a_circle_counts_once(text, typed):
    """What the circle and the prior say of the squareness over the travel, and the number: two normal numbers."""
    alone = beside(mill(), StatedNumbers(), circle()).posterior.curve("EC0Y", np.zeros(1))
    found = beside(mill(), StatedNumbers(squareness={"EC0Y": text}), circle())
    mean, u = both((1e6 * alone.value[0], 1e6 * alone.u[0]), typed)
    after = found.posterior.curve("EC0Y", np.zeros(1))
    assert (1e6 * after.value[0], 1e6 * after.u[0]) == pytest.approx((mean, u), rel=1e-3)
    value, stated = found.errors.squareness["EC0Y"]
    assert 1e6 * abs(value - after.value[0]) <= 0.25 * u
    assert 1e6 * stated == pytest.approx(u, rel=0.05)


@pytest.mark.parametrize("prior", [FIXED, NONE])
@pytest.mark.parametrize("measured", [circle(), GIVEN])
@pytest.mark.parametrize("text", ["-30±3", "-60", "150±5", "-0.06/300±0.001"])
def test_a_squareness_that_contradicts_the_measured_one_is_refused(measured, text, prior):
    with pytest.raises(InputError, match=r"EC0Y = .* contradicts what was measured, .*En = "):
        beside(mill(prior), StatedNumbers(squareness={"EC0Y": text}), measured)


def test_a_number_about_another_error_is_no_contradiction():
    for prior in (FIXED, NONE):
        numbers = StatedNumbers(squareness={"EA0Z": "-300±3"}, scale={"Y": "-30±2"})
        found = beside(mill(prior), numbers, circle())
        assert found.errors.squareness["EA0Z"][0] == pytest.approx(-300e-6, rel=0.1)
        assert {"EYY", "EC0Y", "EA0Z"} <= set(found.errors.names)


ARMS = {"EYX": Curve(np.array([0.0, 300.0]), np.array([0.0, 3e-3]), np.full(2, 5e-4)),
        "EXY": Curve(np.array([0.0, 300.0]), np.array([0.0, 6e-3]), np.full(2, 5e-4))}  # fmt: skip


@pytest.mark.parametrize("prior", [FIXED, NONE])
def test_a_number_beside_both_arms_of_a_square_is_compared_with_them_and_they_count_once(prior):
    """The number is usually what the same arms give (docs/instruments.md: -30 urad): together they would count twice."""
    square = ErrorTable(ARMS, {}, {"source": "granite square"})
    found = beside(mill(prior), StatedNumbers(squareness={"EC0Y": "-29±3"}), square).errors.squareness["EC0Y"]
    assert (1e6 * found[0], 1e6 * found[1]) == pytest.approx((-29.0, 3.0), rel=0.02)
    with pytest.raises(
        InputError, match=r"EC0Y = 30 urad .* contradicts what was measured, -30\.?\d* urad.*opposite sign"
    ):
        beside(mill(prior), StatedNumbers(squareness={"EC0Y": "30±3"}), square)
    scaled = beside(mill(prior), StatedNumbers(scale={"X": "12±3"}), square).errors.squareness["EC0Y"]
    assert 1e6 * scaled[0] == pytest.approx(-30.0, rel=0.05)  # a scale says nothing of the arms


def test_without_a_prior_a_circle_and_a_number_make_no_other_squareness():
    """EB0Z and EA0Z came out as -5400 and -4800 urad: their columns are rounding errors of 1e-16."""
    found = beside(mill(NONE, chain="WYXFZT"), StatedNumbers(squareness={"EC0Y": "30±3"}), circle())
    assert found.errors.names == ("EC0Y",)


# --- scale -----------------------------------------------------------------------------------------------------------

REFERENCES = [(0.0, 0.0, 0.0), (600.0, 0.0, 0.0), (300.0, 200.0, 150.0), (150.0, 0.0, 0.0)]


@pytest.mark.parametrize("reference_mm", REFERENCES)
@pytest.mark.parametrize(("text", "typed"), [("17±2", (17.0, 2.0)), ("23", (23.0, 5.0))])
def test_a_scale_beside_runs_counts_once_wherever_its_zero_is(reference_mm, text, typed):
    """A reference point in the middle made two readings of one number, each end with the whole weight."""
    machine = mill(reference_mm=reference_mm)
    alone = slope_of(beside(machine, StatedNumbers(), runs()))
    found = slope_of(beside(machine, StatedNumbers(scale={"X": text}), runs()))
    expected = both((1e6 * alone[0], 1e6 * alone[1]), typed)
    assert (1e6 * found[0], 1e6 * found[1]) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("reference_mm", REFERENCES)
def test_a_scale_alone_is_the_slope_and_no_shape(reference_mm):
    found = beside(mill(reference_mm=reference_mm), StatedNumbers(scale={"X": "17±2"}))
    before = beside(mill(reference_mm=reference_mm), StatedNumbers(squareness={"EC0Y": "17±2"}))
    value, u = slope_of(found)
    assert (1e6 * value, 1e6 * u) == pytest.approx(both((0.0, 1e6 * slope_of(before)[1]), (17.0, 2.0)), rel=1e-3)
    assert "EXX" in found.errors.names
    # without a prior the curve is a line, of which both ends follow one number
    plain = beside(mill(NONE, reference_mm), StatedNumbers(scale={"X": "17±2"}))
    away = plain.errors.curves["EXX"].position_mm - reference_mm[0]
    assert 1e3 * plain.errors.curves["EXX"].value == pytest.approx(17e-3 * away)
    assert joint_covariance(plain).errors_covariance == pytest.approx(np.outer(away, away) * 4e-12)


@pytest.mark.parametrize("prior", [FIXED, NONE])
@pytest.mark.parametrize("text", ["-20", "-20±1", "60±3", "0.06mm/m"])
def test_a_scale_that_contradicts_the_runs_is_refused(text, prior):
    with pytest.raises(InputError, match=r"X = .* um/m .* contradicts what was measured, (19|20)\.?\d* um/m.*En = "):
        beside(mill(prior), StatedNumbers(scale={"X": text}), runs())


@pytest.mark.parametrize("prior", [FIXED, NONE])
@pytest.mark.parametrize("text", ["22±0.5", "14±3", "20", "0.021mm/m"])
def test_a_scale_within_what_laser_and_temperature_allow_is_taken(text, prior):
    """Without temperatures a run may be 3 um/m off: a number that is 2 um/m away is no contradiction."""
    assert "EXX" in beside(mill(prior), StatedNumbers(scale={"X": text}), runs()).errors.names


# --- units -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "word", "asked"),
    [
        ("squareness", "EC0Y=0.02", "EC0Y=0.02mm/m for 20 urad, or EC0Y=0.02urad"),
        ("squareness", "EA0Z=-0.5", "EA0Z=-0.5mm/m for -500 urad, or EA0Z=-0.5urad"),
        ("squareness", "EB0Z=0.05±0.01", "looks like mm/m"),
        ("scale", "X=0.012", "X=0.012mm/m for 12 um/m"),
        ("backlash", "X=0.006", "X=0.006mm for 6 um, or X=0.006um"),
        ("backlash", "X=B=-0.006", "looks like mm"),
    ],
)
def test_the_unit_of_a_number_too_small_for_the_usual_one_is_asked(
    tmp_path, small_machine, capsys, option, word, asked
):
    words = ["identify", str(small_machine.source), "--squareness", "EC0Y=0.02/300" if "EC0Y" not in word else "EA0Z=9"]
    assert run_command(cli, [*words, f"--{option}", word, "--out", str(tmp_path / "o")]) == 2
    assert asked in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "o").exists()
    name, _, text = word.partition("=")
    for unit in ("um/m", "mm/m") if option != "backlash" else ("um", "mm"):
        numbers = StatedNumbers(**{option: {name: text.partition("±")[0] + unit}})
        assert numbers.errors(small_machine) or numbers.reversal()


@pytest.mark.parametrize("text", ["0", "0±5", "0.5±3", "-1", "1±0.1", "0.02/300"])
def test_a_number_in_the_usual_unit_is_not_asked_about(small_machine, text):
    assert StatedNumbers(squareness={"EC0Y": text}).errors(small_machine).squareness["EC0Y"]


def test_both_commands_refuse_a_contradiction_and_leave_nothing(tmp_path, small_machine, capsys):
    at, rng = np.linspace(-300.0, 200.0, 11), np.random.default_rng(1)
    rows = [(x, way, run) for run in range(3) for way in (1, -1) for x in at]
    x, way, run = (np.array(column) for column in zip(*rows, strict=True))
    value = 2e-5 * x - 3e-3 * way + rng.normal(0.0, 2e-4, len(x))
    path = tmp_path / "x.axis.csv"
    path.write_text(format_axis_runs(AxisRuns(np.zeros(len(x), int), x, way.astype(int), run.astype(int), value)))
    for command in (["identify"], ["run", "--controller", "isg-csv"]):
        words = [command[0], str(small_machine.source), str(path), *command[1:], "--out", str(tmp_path / "o")]
        for wrong in ("--backlash X=-6", "--scale X=-20±2"):
            assert run_command(cli, [*words, *wrong.split()]) == 2
            assert "contradicts" in capsys.readouterr().err
            assert not (tmp_path / "o").exists()


# --- a square that is shorter than the travel -----------------------------------------------------------------------


SQUARES = [("EC0Y", "25±3@300"), ("EC0Y", "25±3@300x200"), ("EB0Z", "25±3 um/m @ 300 mm"), ("EA0Z", "25±3@12in")]


@pytest.mark.parametrize(("name", "text"), SQUARES)
def test_what_the_guides_do_along_the_arms_of_a_square_is_in_its_uncertainty(name, text):
    machine = mill()
    errors = StatedNumbers(squareness={name: text}).errors(machine)
    value, u = given_errors(machine, errors).errors.squareness[name]
    assert value == pytest.approx(25e-6)
    first, second = square_spans_mm(errors)[name]
    assert u == pytest.approx(np.hypot(3e-6, scatter_of_squares(machine, name, (first, second))), rel=0.2)


def scatter_of_squares(machine, name, spans_mm, machines=120):
    """Rms of what squares read beside the squareness, rad: exact readings of machines drawn from the prior, at any place."""
    rng = np.random.default_rng(3)
    pair = [error_named(curve) for curve in CURVES_OF_ARMS[name]]
    span = [min(one, machine.axes[error.axis].length_mm) for one, error in zip(spans_mm, pair, strict=True)]
    drawn = {}
    for curve, process in processes_of(machine, machine.prior, ERROR_NAMES).items():
        at = np.linspace(*machine.axes[error_named(curve).axis].range_mm, 31)
        root = np.linalg.cholesky(process.covariance(at, at) + 1e-18 * np.eye(31))
        drawn[curve] = at, root @ rng.normal(size=(31, machines))
    read = []
    for k in range(machines):
        table = ErrorTable({curve: Curve(at, value[:, k], np.zeros(31)) for curve, (at, value) in drawn.items()})
        corner = rng.uniform(machine.lower_mm, machine.upper_mm)
        for error, length in zip(pair, span, strict=True):
            low, high = machine.axes[error.axis].range_mm
            corner[error.axis] = rng.uniform(low, high - length)
        points = np.tile(corner, (3, 1))
        for n, (error, length) in enumerate(zip(pair, span, strict=True), start=1):
            points[n, error.axis] += length
        tip = compgen.predict(machine, table, compgen.Points(points), exact=True)
        read.append(
            sum(
                (tip[n, error.direction] - tip[0, error.direction]) / length
                for n, (error, length) in enumerate(zip(pair, span, strict=True), start=1)
            )
        )
    return float(np.sqrt(np.mean(np.square(read))))


def test_a_short_square_that_differs_from_the_whole_travel_is_no_contradiction():
    machine, measured = mill(), circle(square=SQUARE_URAD)
    for text, refused in (("70±3", True), ("70±3@120", False)):
        numbers = StatedNumbers(squareness={"EC0Y": text})
        both = MixedMeasurement((("circle", measured), ("numbers", numbers.errors(machine))))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            if refused:
                with pytest.raises(InputError, match="contradicts"):
                    identify_beside(machine, both, numbers)
            else:
                value, u = identify_beside(machine, both, numbers).errors.squareness["EC0Y"]
                assert 1e6 * u > 3.0 and 1e6 * value < 70.0


@pytest.mark.parametrize(
    "text", ["25@", "25@0", "25@-300", "25@nan", "25@300x", "25@1e3", "25@300 um", "25@9000", "@300", "25@300@200"]
)
def test_a_length_of_arms_that_is_not_understood_is_refused(text):
    with pytest.raises(InputError, match="EC0Y"):
        StatedNumbers(squareness={"EC0Y": text}).errors(mill())


def test_only_squareness_is_read_from_a_square():
    with pytest.raises(InputError, match="not understood"):
        StatedNumbers(scale={"X": "25@300"}).errors(mill())
    with pytest.raises(InputError, match="not understood"):
        StatedNumbers(backlash={"X": "6@300"}).reversal()


def test_without_a_prior_a_square_says_what_it_states():
    machine = mill(NONE)
    errors = StatedNumbers(squareness={"EC0Y": "25±3@300"}).errors(machine)
    assert given_errors(machine, errors).errors.squareness["EC0Y"] == pytest.approx((25e-6, 3e-6))


def test_the_arms_of_an_imported_square_stay_with_its_errors_file(tmp_path):
    errors = StatedNumbers(squareness={"EC0Y": "25±3@300"}).errors(mill())
    path = tmp_path / "square.errors.csv"
    path.write_text(format_errors(errors), encoding="utf-8")
    assert given_errors(mill(), read_errors(path)).errors.squareness["EC0Y"][1] > 10e-6
    path.write_text(path.read_text(encoding="utf-8").replace("EC0Y 300 300", "EC0Y long"), encoding="utf-8")
    with pytest.raises(InputError, match="lengths of two arms"):
        given_errors(mill(), read_errors(path))
