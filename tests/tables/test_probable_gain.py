"""The verdict from what is known and what is not, against formulas for machines with one or two unknown squareness errors.

EC0Y = e moves the tool by -y e along X and EB0Z = b by z b, so on a travel that is symmetric about machine zero the error
before is |e| rms(y) where nothing else is unknown, that after tables of m is |e - m| rms(y), and it is smaller if e > m / 2.
"""

import json
import warnings
from itertools import product
from math import erf, sqrt

import numpy as np
import pytest
from virtual_shop import Shop, Truth, case, together

import compgen
from compgen.data.axis_runs import format_axis_runs
from compgen.data.circles import format_circles
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.prior import PriorSettings
from compgen.pipeline import identify_bare
from compgen.tables.verification import ProbableGain, probable_gain
from machines import machine_of

HALF_MM = 200.0
URAD = 1e-6
#: A tenth of a nanometre and a thousandth of a microradian: as good as known.
TINY = {"positioning_um": 1e-3, "scale_um_per_m": 1e-3, "straightness_um": 1e-3, "angle_urad": 1e-3}


def machine_with(squareness_urad=1e4):
    prior = PriorSettings(class_name="general", squareness_urad=squareness_urad, learn="no", **TINY)
    return machine_of([(-HALF_MM, HALF_MM)] * 3, 5, prior=prior)


def grid():
    along = np.linspace(-HALF_MM, HALF_MM, 7)
    return np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)


def gain_of(machine, squareness):
    """The statement about tables with exactly the errors found; ``squareness`` by name as (value, u) in urad."""
    stated = ErrorTable({}, {name: (value * URAD, u * URAD) for name, (value, u) in squareness.items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify_bare(machine, stated)
    at = grid()
    before = Truth.of_table(machine, found.errors).field(at)
    return probable_gain(machine, found.errors, found.posterior, at, before, np.zeros_like(before))


def normal(z):
    return 0.5 * (1.0 + erf(z / sqrt(2.0)))


KNOWN = {"EB0Z": (0.0, 0.01), "EA0Z": (0.0, 0.01)}


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.7, 2.4, 3.0, 5.0, 8.0])
def test_the_probability_is_that_the_error_is_more_than_half_of_what_the_tables_hold(ratio):
    gain = gain_of(machine_with(), {"EC0Y": (10.0 * ratio, 10.0), **KNOWN})
    # of 400 draws: the quotient of their mean and spread is known to 0.05 to 0.1
    z = 0.5 * ratio
    low, high = (normal(z + side * 3.0 * sqrt((1.0 + 0.5 * z * z) / 400.0)) for side in (-1.0, 1.0))
    assert low <= gain.probability_as_it_stands <= high
    assert low <= gain.probability_rigid_removed <= high  # a rigid motion takes half of a shear, before and after
    assert gain.probability_better == min(gain.probability_as_it_stands, gain.probability_rigid_removed)


@pytest.mark.parametrize(
    ("ratio", "refused", "codes"), [(1.0, True, {"doubtful"}), (2.6, False, {"doubtful"}), (6.0, False, set())]
)
def test_the_word_of_the_verdict_follows_from_it(ratio, refused, codes):
    """Below 0.8 refused, below 0.975 doubtful; accepted where the limits of before and after are apart, too."""
    gain = gain_of(machine_with(), {"EC0Y": (10.0 * ratio, 10.0), **KNOWN})
    assert bool(gain.reason) == refused
    # e may be far smaller than what the tables hold: then all eighths get worse
    assert {item.code for item in gain.reservations} - {"worse_eighth"} == codes
    assert bool(gain.worse_eighths) == (ratio < 4.0)
    assert not any(item.blocking for item in gain.reservations)


def test_before_and_after_are_stated_with_their_limits():
    value, u = 60.0, 10.0
    gain = gain_of(machine_with(), {"EC0Y": (value, u), **KNOWN})
    rms_mm = float(np.sqrt(np.mean(grid()[:, 1] ** 2)))
    at = URAD * rms_mm * 1e3
    median, low, high = gain.before_um
    assert (median, low, high) == pytest.approx((value * at, (value - 1.96 * u) * at, (value + 1.96 * u) * at), rel=0.1)
    # of |N(0, u)|: half is below 0.674 u, 97.5 % below 2.241 u
    assert gain.after_um[0] == pytest.approx(0.674 * u * at, rel=0.15)
    assert gain.after_um[2] == pytest.approx(2.241 * u * at, rel=0.1)
    assert f"at most {gain.after_um[2]:.1f}" in gain.text


def test_what_is_unknown_beside_it_changes_the_limits_and_not_the_probability():
    """EB0Z of 100 urad that nobody read: the tables surely help, but the error after may be as large as that before."""
    sure = gain_of(machine_with(), {"EC0Y": (60.0, 5.0), **KNOWN})
    open_ = gain_of(machine_with(100.0), {"EC0Y": (60.0, 5.0), "EA0Z": (0.0, 0.01)})
    assert sure.probability_better > 0.999 and open_.probability_better > 0.975
    assert not list(sure.reservations)
    codes = {item.code for item in open_.reservations}
    assert "bounds_overlap" in codes
    assert open_.after_um[2] > open_.before_um[1]


def test_the_eighths_that_get_worse_are_those_where_two_errors_had_cancelled():
    """By other draws: dX = z b - y e, and e alone is corrected."""
    size = 100.0
    gain = gain_of(machine_with(size), {"EC0Y": (60.0, 5.0), "EA0Z": (0.0, 0.01)})
    rng, at = np.random.default_rng(3), grid()
    b, e = rng.normal(0.0, size, 4000), rng.normal(60.0, 5.0, 4000)
    worse = {}
    for corner in product((False, True), repeat=3):
        x, y, z = at[((at > 0.0) == corner).all(axis=1)].T
        before, after = (
            1e-3 * np.sqrt(np.mean((np.outer(b, z) - np.outer(e - taken, y)) ** 2, axis=1)) for taken in (0.0, 60.0)
        )
        share = np.mean(after > 1.1 * before + 0.5)
        place = ", ".join(f"{a} {'above' if c else 'below'} 0" for a, c in zip("XYZ", corner, strict=True))
        worse[place] = share
    named = {text.split(" mm (")[0]: float(text.split("(")[1].split(" %")[0]) / 100.0 for text in gain.worse_eighths}
    assert set(named) == {place for place, share in worse.items() if share > 0.05}
    for place, share in named.items():
        assert share == pytest.approx(worse[place], abs=0.08)
    assert "worse_eighth" in {item.code for item in gain.reservations}


@pytest.mark.parametrize(
    ("span", "short"), [(0.6, {"X": pytest.approx(0.6)}), (0.75, {"X": pytest.approx(0.75)}), (0.9, {})]
)
def test_tables_beyond_the_readings_are_a_reservation(span, short):
    shop = case(0, seed=2, family="smooth")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify_bare(shop.machine, together(shop.runs("X", span=span), shop.runs("YZ"), shop.squares()))
    at = np.random.default_rng(1).uniform(shop.machine.lower_mm, shop.machine.upper_mm, (60, 3))
    before = Truth.of_table(shop.machine, found.errors).field(at)
    gain = probable_gain(shop.machine, found.errors, found.posterior, at, before, np.zeros_like(before))
    assert dict(gain.short_axes) == short
    assert ("short_span" in {item.code for item in gain.reservations}) == bool(short)


def statement(**changes):
    fields = {
        "probability_as_it_stands": 0.99,
        "probability_rigid_removed": 0.99,
        "before_um": (10.0, 8.0, 12.0),
        "after_um": (3.0, 1.0, 5.0),
        "worse_eighths": (),
        "short_axes": (),
        "assumed": "",
    }
    return ProbableGain(**(fields | changes))


def test_better_with_the_rigid_motion_removed_only_is_better_after_a_new_set_up():
    gain = statement(probability_as_it_stands=0.5)
    assert gain.only_after_new_setup and not gain.reason
    assert not list(gain.reservations)
    other = statement(probability_rigid_removed=0.5)
    assert not other.only_after_new_setup and other.reason


def test_accepted_is_never_said_with_limits_that_overlap():
    for after, before in product(np.linspace(1.0, 20.0, 20), repeat=2):
        gain = statement(after_um=(0.5, 0.1, after), before_um=(30.0, before, 40.0))
        assert bool(list(gain.reservations)) == (after >= before)


# --- the whole chain -----------------------------------------------------------------------------------------------


MACHINE = """\
name = "mill"
chain = "{chain}"
errors = 17
{prior}
"""
AXIS = "[axes.{axis}]\nrange_mm = [{low}, {high}]\nnodes = {nodes}\n"


@pytest.fixture
def run(tmp_path, call):
    """Write the machine and files of a shop, run them, and return exit code, ``result.json`` and the files."""

    def of(shop, files, *words, prior='[prior]\nclass = "general"'):
        path = tmp_path / "mill.toml"
        text = MACHINE.format(chain=shop.machine.chain.name, prior=prior)
        for letter, axis in zip("XYZ", shop.machine.axes, strict=True):
            low, high = axis.range_mm
            text += AXIS.format(axis=letter, low=low, high=high, nodes=len(axis.nodes_mm))
        path.write_text(text)
        for name, content in files.items():
            (tmp_path / name).write_text(content)
        out = tmp_path / "out"
        command = ["run", path, *(tmp_path / name for name in files), *words, "--controller", "isg-csv", "--no-report"]
        code, _, err = call(*command, "--out", out)
        return code, json.loads((out / "result.json").read_text()) if code < 2 else err, out

    return of


def true_rms(shop, tables=None):
    at = np.random.default_rng(5).uniform(shop.machine.lower_mm, shop.machine.upper_mm, (400, 3))
    error = shop.truth.field(at)
    if tables is not None:
        error = error - Truth.of_table(shop.machine, tables).field(at)
    return 1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def test_a_circle_and_a_straightedge_say_nothing_of_the_squareness_of_z(run):
    """It was written as -494 +- 29 urad: nothing but what some reading shows is in the tables, and the rest is named."""
    shop = case(0, seed=21, family="smooth")
    files = {"c.circle.csv": format_circles(shop.circles()), "x.errors.csv": format_errors(shop.straightedges("EYX"))}
    code, result, out = run(shop, files)
    assert code in (0, 1)
    assert result["accepted"] == (code == 0)
    listed = compgen.read_errors(next(out.glob("*identified.errors.csv"))).names
    assert {"EB0Z", "EA0Z"} & set(listed) == set()
    assert {"EB0Z", "EA0Z"} <= set(result["not_measured"])
    assert result["not_measured"]["EB0Z"]["assumed_sd"] == 40.0
    assert result["not_measured"]["EB0Z"]["rms_over_volume_um"] > 1.0
    assert set(result["not_measured"]) | set(listed) >= set(shop.truth.curves)
    assert result["measured"]["determined"] <= 3


def test_pitch_and_squareness_are_judged_by_the_whole_machine(run):
    """Angles that nobody measured stay, so U is no longer that of the laser; the machine gets better nevertheless."""
    shop = case(0, seed=22, family="smooth")
    numbers = [f"{name}={shop.truth.squareness[name] / URAD:.1f}±2" for name in ("EC0Y", "EB0Z", "EA0Z")]
    words = [word for number in numbers for word in ("--squareness", number)]
    code, result, out = run(shop, {"p.axis.csv": format_axis_runs(shop.runs())}, *words)
    gain = result["probable"]
    assert result["accepted"] == (code == 0)
    assert result["probability_better"] == min(
        gain["probability_as_it_stands"], gain["probability_rigid_motion_removed"]
    )
    assert result["prior"]["class"] == "general" and result["prior"]["angle_urad"] == 12.0
    assert set(result["measured"]["errors"]) <= {"EXX", "EYY", "EZZ", "EC0Y", "EB0Z", "EA0Z"}
    assert {"EAX", "EBY", "EYX"} <= set(result["not_measured"])
    tables = compgen.read_errors(next(out.glob("*identified.errors.csv")))
    before, after = true_rms(shop), true_rms(shop, tables)
    assert after < before
    assert gain["before_rms_um"]["low"] <= before <= gain["before_rms_um"]["high"]
    assert after <= gain["after_rms_um"]["high"]
    assert result["after_uncertainty"]["U_rms_um"] > 2.0


def test_one_run_that_helps_little_is_not_accepted(run):
    """X alone: the rest of the machine is far larger than what the table takes off."""
    shop = case(0, seed=23, family="smooth")
    small = Shop(shop.truth, shop.rng)
    at, value = shop.truth.curves["EXX"]
    small.truth.curves["EXX"] = (at, 0.05 * value)
    code, result, out = run(small, {"x.axis.csv": format_axis_runs(small.runs("X"))})
    assert result["probability_better"] < 0.975
    assert (code, result["verdict"]) in {(1, "not_accepted"), (0, "accepted_with_reservations")}
    assert (code == 1) == (result["probability_better"] < 0.8)
    assert bool(list(out.glob("NOT-ACCEPTED-*"))) == (code == 1)
    codes = {item["code"] for item in result["objections"]}
    assert "doubtful" in codes or code == 1


def test_without_a_prior_nothing_is_said_of_the_rest(run):
    shop = case(0, seed=22, family="smooth")
    code, result, _ = run(shop, {"p.axis.csv": format_axis_runs(shop.runs())}, "--prior", "none", prior="")
    assert code == 0
    assert result["prior"] == {"class": "none"}
    assert result["probability_better"] is None and result["not_measured"] == {}
    assert result["verdict"] == "partial"


def test_the_class_of_the_command_line_is_that_of_the_result(run):
    shop = case(0, seed=22, family="smooth")
    _, result, _ = run(shop, {"p.axis.csv": format_axis_runs(shop.runs())}, "--prior", "large", prior="")
    assert result["prior"]["class"] == "large"
    assert result["prior"]["squareness_urad"] == 120.0
