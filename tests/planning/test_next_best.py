"""What to measure next: against a full solution with the same readings, against identification, and on what is written."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import PLANES, Circles
from compgen.data.deviations import Artefact
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.machine import Axis, Chain
from compgen.data.names import AXES, SQUARENESS_NAMES
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning
from compgen.identification.any_measurement import MixedMeasurement, identify_measurement, unseen
from compgen.identification.options import IdentifyOptions
from compgen.identification.posterior import Information, with_information
from compgen.kinematics.many_points import full_grid
from compgen.pipeline import next_measurements
from compgen.planning.next_measurement import LEVELS, candidates, error_words, next_best, set_up_picture, unmeasured


@pytest.fixture(scope="module")
def unknown(small_machine):
    """A machine of which nothing was measured."""
    return unmeasured(small_machine)


@pytest.fixture(scope="module")
def choices(unknown):
    """One candidate of each kind."""
    return {item.code: item for item in candidates(unknown)}


def middles(machine):
    """Points of the volume, the middles of as many equal parts of each axis."""
    shares = (np.arange(LEVELS) + 0.5) / LEVELS
    return full_grid([axis.range_mm[0] + shares * axis.length_mm for axis in machine.axes]).reshape(-1, 3)


def rms_um(posterior):
    return 1e3 * float(np.sqrt(posterior.field(middles(posterior.machine)).variance.sum(axis=1).mean()))


def runs(machine, axes=(0, 1, 2), deviation_um=0.0, temperatures=False):
    """Pitch runs along the lines through the reference point, in both directions and twice, with a little scatter."""
    rng, rows = np.random.default_rng(5), []
    for axis in axes:
        for run in (1, 2):
            for direction in (1, -1):
                rows += [(axis, at, direction, run) for at in np.linspace(*machine.axes[axis].range_mm, 9)]
    axis, at, direction, run = np.array(rows).T
    reference = dict(zip(("line_x_mm", "line_y_mm", "line_z_mm"), machine.reference_point_mm, strict=True))
    covariates = {name: np.full(len(rows), value) for name, value in reference.items()}
    covariates |= {f"temp_{name}_c": np.full(len(rows), 20.0) for name in "xyz"} if temperatures else {}
    deviation_mm = 1e-3 * (deviation_um * np.sin(at / 90.0) + 0.5 * rng.standard_normal(len(rows)))
    whole = (item.astype(np.int64) for item in (axis, direction, run))
    axis, direction, run = whole
    return AxisRuns(axis, at, direction, run, deviation_mm, covariates)


def circle(machine, plane, radius_mm, centre_mm):
    """A circle in both directions with 1 um of noise."""
    angle = np.tile(np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False), 2)
    count = len(angle)
    noise = 1e-3 * np.random.default_rng(6).standard_normal(count)
    ones = np.ones(count, dtype=np.int64)
    return Circles(
        list(PLANES).index(plane) * ones, angle, radius_mm * ones.astype(float), noise, np.repeat([1, -1], count // 2), ones,
        0 * ones, np.tile(centre_mm, (count, 1)), np.full(count, np.nan),
    )  # fmt: skip


# --- numbers -------------------------------------------------------------------------------------------------------


def test_every_kind_of_instrument_is_a_candidate(choices):
    assert set(choices) == {
        "axis_run", "straightedge", "angles", "circle", "square", "plate", "plate_heights", "plate_turned", "plate_upright",
        "laser_tracer",
    }  # fmt: skip


@pytest.mark.parametrize(
    "code", ["axis_run", "straightedge", "angles", "circle", "square", "plate_heights", "laser_tracer"]
)
def test_u_after_a_measurement_is_that_of_the_posterior_with_its_readings(unknown, choices, code):
    """The low-rank update against the whole solution with prior and readings."""
    chosen = choices[code]
    alone = replace(unknown)  # nothing is kept from before
    item = next((x for x in next_best(alone).measurements if x.candidate.code == code), None)
    expected = rms_um(with_information(unknown, [Information.of(chosen.readings)]))
    assert expected < rms_um(unknown)
    if item is not None:  # the best of its kind is at least as good
        assert item.u_before_um == pytest.approx(rms_um(unknown), rel=1e-6)
        best = rms_um(with_information(unknown, [Information.of(item.candidate.readings)]))
        assert item.u_after_um == pytest.approx(best, rel=1e-4)
        assert item.u_after_um <= expected * (1 + 1e-6)


def test_the_update_is_the_formula_of_the_conditional_covariance(unknown, choices):
    """S' = S - S A' (A S A' + R)^-1 A S, with an unknown of its own as noise of a very large variance."""
    readings = choices["square"].readings
    a, large = readings.design, 1.0  # mm, a thousand times the noise
    noise = np.diag(readings.sigma**2)
    flat = readings.others[:, :3] * large  # offsets and lay; the angle of the square is known by a further reading
    known = np.outer(readings.others[:, 3], readings.others[:, 3])
    rows = slice(0, len(a) - 1)
    total = noise[rows, rows] + flat[rows] @ flat[rows].T + known[rows, rows]
    covariance = unknown.factor @ unknown.factor.T
    shown = a[rows] @ covariance
    after = covariance - shown.T @ np.linalg.solve(a[rows] @ shown.T + total, shown)
    solved = with_information(unknown, [Information.of(readings)])
    for name in SQUARENESS_NAMES:
        place = dict(unknown.layout.columns())[name]
        assert np.linalg.norm(solved.factor[place]) == pytest.approx(np.sqrt(after[place, place][0, 0]), rel=1e-3)


def test_a_proposed_circle_does_what_was_said(small_machine):
    """Pitch runs alone, then with the circle that was proposed: u of the field falls as was promised."""
    with pytest.warns(CompgenWarning, match="positioning runs"):
        before = identify_measurement(small_machine, runs(small_machine, deviation_um=3.0), IdentifyOptions())
    found = next_best(before.posterior)
    item = next(item for item in found.measurements if item.candidate.code == "circle")
    plane, radius, centre = item.candidate.options.removeprefix("--circle ").split(":")
    made = circle(small_machine, plane, float(radius), [float(value) for value in centre.split(",")])
    both = MixedMeasurement((("runs", runs(small_machine, deviation_um=3.0)), ("circle", made)))
    after = identify_measurement(small_machine, both, IdentifyOptions())
    assert rms_um(before.posterior) == pytest.approx(item.u_before_um, rel=1e-6)
    assert rms_um(after.posterior) == pytest.approx(item.u_after_um, rel=0.1)
    assert set(item.reduces) & set(SQUARENESS_NAMES)


def test_the_prior_decides_what_comes_first(small_machine):
    """With guides that may turn by a milliradian and axes that are square, angles come before squareness."""
    loose = replace(small_machine, prior=PriorSettings(angle_urad=1000.0, squareness_urad=0.1, positioning_um=0.1))
    found = next_best(unmeasured(loose))
    assert re.fullmatch("E[ABC][XYZ]", found.largest)
    assert "angles" in [item.candidate.code for item in found.measurements]
    square = replace(small_machine, prior=PriorSettings(angle_urad=0.1, squareness_urad=1000.0, positioning_um=0.1))
    found = next_best(unmeasured(square))
    assert found.largest in SQUARENESS_NAMES
    assert "angles" not in [item.candidate.code for item in found.measurements]


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WXFYZT", "WZXYFT"])
def test_every_chain_and_every_travel_has_candidates(small_machine, chain):
    """A machine whose axes are a few mm long has no room for a plate or a circle of 50 mm, and still something to measure."""

    axes = tuple(Axis((0.0, length), np.linspace(0.0, length, 3)) for length in (40.0, 3000.0, 12.0))
    machine = replace(small_machine, axes=axes, reference_point_mm=(0.0, 0.0, 0.0), chain=Chain(chain))
    found = next_best(unmeasured(machine))
    assert found.measurements
    assert all(item.u_after_um < item.u_before_um for item in found.measurements)


# --- nothing to propose --------------------------------------------------------------------------------------------


def test_where_everything_is_determined_nothing_is_proposed(unknown):
    exact = replace(unknown, factor=1e-3 * unknown.factor)
    found = next_best(exact)
    assert found.measurements == ()
    assert found.text == ""
    assert found.summary() == {"next_measurements": [], "next_text": ""}


def test_without_a_prior_nothing_is_proposed(small_machine):
    bare = replace(small_machine, prior=PriorSettings(class_name="none"))
    with pytest.warns(CompgenWarning, match="positioning runs"):
        assert next_measurements(identify_measurement(bare, runs(bare), IdentifyOptions())) is None


# --- words, pictures, files ----------------------------------------------------------------------------------------


def test_the_sentence_says_what_is_assumed_what_it_costs_and_what_would_help(unknown):
    found = next_best(unknown)
    text = found.text
    assert text.startswith(f"Assumed, not measured: {error_words(found.largest)} ({found.largest}) up to ")
    assert re.search(
        r"It makes \d+ % of the remaining uncertainty\. .* would reduce u from [\d.]+ to [\d.]+ um, ", text
    )
    assert text.endswith("(rms over the volume).")
    listed = [item.u_after_um for item in found.measurements]
    assert listed == sorted(listed)
    assert len({item.candidate.code for item in found.measurements}) == len(listed)


def test_an_entry_holds_everything_that_a_page_needs(unknown, small_machine):
    entry = json.loads(json.dumps(next_best(unknown).summary()["next_measurements"][0]))
    assert {"what", "code", "how", "command", "u_before_um", "u_after_um", "reduces"} <= set(entry)
    assert entry["U_after_um"] == pytest.approx(2.0 * entry["u_after_um"])
    picture = set_up_picture(entry, "next-0")
    assert picture.title == entry["what"]
    assert picture.svg.startswith("<svg")
    assert all(f">{letter}</text>" in picture.svg for letter in AXES)
    assert entry["command"].startswith(f"volcomp plan {small_machine.source} --")
    with pytest.raises((KeyError, TypeError, ValueError)):
        set_up_picture({**entry, "picture": {"volume_mm": "x"}}, "k")


def test_every_picture_stays_in_its_frame(choices, small_machine):
    from compgen.planning.next_measurement import NextMeasurement

    for item in choices.values():
        entry = NextMeasurement(item, 2.0, 1.0, ()).summary(small_machine)
        markup = str(set_up_picture(entry, "k").svg)
        numbers = [
            float(value) for path in re.findall(r' d="M([^"]+)"', markup) for value in re.findall(r"-?\d+\.\d+", path)
        ]
        assert min(numbers) >= 0.0
        assert max(numbers[::2]) <= 250.0
        assert max(numbers[1::2]) <= 190.0


def test_plan_alone_says_what_to_measure_first_and_next(small_machine, tmp_path, call):
    code, stdout, _ = call("plan", small_machine.source, "--out", tmp_path / "first", "--json")
    first = json.loads(stdout)
    assert code == 0
    assert first["determined"] == []
    assert first["prior"]["class"] == "general"
    page = (tmp_path / "first" / "plan.html").read_text()
    assert first["next_measurements"][0]["what"] in page
    assert len(re.findall('id="figure-next-', page)) == len(first["next_measurements"])
    assert not re.search(r'(src|href)="(?!data:)', page)
    known = tmp_path / "known.errors.csv"
    known.write_text(format_errors(ErrorTable({}, {name: (0.0, 1e-6) for name in SQUARENESS_NAMES})))
    words = ("plan", small_machine.source, "--errors", known, "--out", tmp_path / "next")
    code, stdout, _ = call(*words, "--json")
    then = json.loads(stdout)
    assert code == 0
    assert set(then["determined"]) == set(SQUARENESS_NAMES)
    assert then["u_rms_um"] < first["u_rms_um"]
    assert "square" not in [item["code"] for item in then["next_measurements"]]
    assert "next measurement" not in call(*words)[1]
    code, stdout, _ = call(*words, "--prior", "large", "--json")
    assert json.loads(stdout)["u_rms_um"] == pytest.approx(3.0 * then["u_rms_um"], rel=0.05)
    nothing = tmp_path / "nothing.errors.csv"
    nothing.write_text(format_errors(ErrorTable({}, {"EC0Y": (1e-5, np.nan)})))
    code, _, stderr = call("plan", small_machine.source, "--errors", nothing, "--out", tmp_path / "none")
    assert code == 2
    assert "states no uncertainty" in stderr
    assert not (tmp_path / "none").exists()


# --- what readings cannot show -------------------------------------------------------------------------------------


def plate(*turns_deg, calibrated=True):
    """A plate of 3 x 3 holes in set-ups that are turned about Z; last of a pair: upright."""
    side = np.array([-50.0, 0.0, 50.0])
    nominal = np.column_stack([part.ravel() for part in np.meshgrid(side, 1.4 * side, [0.0], indexing="ij")])
    placed = []
    for turn in turns_deg:
        if turn == "upright":
            placed.append(nominal[:, [0, 2, 1]] + [0.0, 100.0, -120.0])
            continue
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        placed.append(nominal @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [-50.0, 100.0, -120.0])
    count = len(turns_deg)
    return Artefact(
        [f"F{k}" for k in range(9)] * count, np.tile(nominal, (count, 1)), np.full((9 * count, 3), np.nan), np.vstack(placed),
        np.repeat(np.arange(count), 9), np.full(9 * count, calibrated),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("turns", "said"),
    [
        ((0.0,), True),
        ((0.0, 180.0), True),
        ((0.0, 10.0), True),
        ((0.0, "upright"), True),
        ((0.0, 90.0), False),
        ((0.0, 45.0), False),
        ((30.0, 30.0, 120.0), False),
    ],
)
def test_a_plate_that_was_not_turned_may_be_sheared_and_that_is_said(small_machine, turns, said):
    notes = unseen(small_machine, [plate(*turns)])
    assert any("turned by 90 degrees" in text for text in notes) is said
    assert any("temperature" in text for text in notes)


def test_what_another_measurement_would_contradict_is_not_said(small_machine):
    one = plate(0.0)
    circles = circle(small_machine, "XY", 90.0, [-50.0, 100.0, -120.0])
    square = ErrorTable({}, {"EC0Y": (0.0, 1e-6)})
    for other in (circles, square):
        assert not any("turned" in text for text in unseen(small_machine, [one, other]))
    assert any("turned" in text for text in unseen(small_machine, [one, runs(small_machine, temperatures=True)]))
    assert not any(
        "a plate at another" in text for text in unseen(small_machine, [one, runs(small_machine, temperatures=True)])
    )
    assert unseen(small_machine, [plate(0.0, calibrated=False)]) == ()  # its form is unknown anyway


def test_runs_without_temperatures_name_the_check_in_identify_and_run(small_machine, tmp_path, call):
    from compgen.data.axis_runs import format_axis_runs

    path = tmp_path / "p.axis.csv"
    path.write_text(format_axis_runs(runs(small_machine)))
    code, stdout, _ = call("identify", small_machine.source, path, "--out", tmp_path / "o", "--json")
    report = json.loads(stdout)
    assert code == 0
    assert any("runs of X, Y, Z" in text and "other end of the travel" in text for text in report["notes"])
    assert report["next_measurements"]
    assert report == {
        **report,
        **{k: json.loads((tmp_path / "o" / "identify.json").read_text())[k] for k in ("notes", "next_text")},
    }
    said = " ".join(call("identify", small_machine.source, path, "--out", tmp_path / "o")[1].split())
    assert "next measurement: Assumed, not measured:" in said
    assert "note: runs of X, Y, Z at another temperature" in said
    code, _, _ = call("run", small_machine.source, path, "--controller", "siemens-cec", "--out", tmp_path / "t")
    result = json.loads((tmp_path / "t" / "result.json").read_text())
    assert result["next_measurements"] == report["next_measurements"]
    assert any("runs of X, Y, Z" in text for text in result["notes"])
    page = (tmp_path / "t" / "report.html").read_text()
    assert "What to measure next" in page
    assert 'id="figure-next-0"' in page
    assert unseen(small_machine, [runs(small_machine, temperatures=True)]) == ()
