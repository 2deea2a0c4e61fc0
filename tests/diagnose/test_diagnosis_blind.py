"""Diagnosis of hidden sets: their simulator shares no code with the catalogue or the method, and names stay in the key."""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import legendre

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hidden.change import along  # noqa: E402 - found through the line above
from hidden.kinematics import random_truth, tip, without_lever  # noqa: E402
from hidden.named import named  # noqa: E402
from hidden.score import outcome, wilson  # noqa: E402
from hidden.sets import CHAINS, Options, draw_machine, make  # noqa: E402
from hidden.unlisted_rest import UNLISTED  # noqa: E402
from hidden.visible import base_space, centred, rms, visible_part  # noqa: E402
from hidden.write import write_set  # noqa: E402

from compgen.cli import cli  # noqa: E402
from compgen.data.lengths import read_lengths  # noqa: E402
from compgen.data.machine import load_machine  # noqa: E402
from compgen.data.names import ERROR_INDEX, ERRORS  # noqa: E402
from compgen.errors import CompgenWarning  # noqa: E402
from compgen.kinematics.exact_chain import tip_position  # noqa: E402

NANOMETRE = 1e-6
PICOMETRE = 1e-9
#: Lines of a small set: 2688 lengths instead of 4608.
LINES = 14


def diagnosis_of(case, folder):
    """What the command says about a set; exit codes 0 and 1 are both answers."""
    machine, lengths = write_set(folder, case.machine, case.lengths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        cli.main(["diagnose", str(machine), str(lengths), "--out", str(folder / "out")], standalone_mode=False)
    return json.loads((folder / "out" / "diagnosis.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("kind", "seed", "options", "right"),
    [
        ("null", 1, Options("white", lines=LINES), "clean"),
        ("null", 2, Options("ar1", lines=LINES), "clean"),
        ("single", 3, Options("white", 0.5, ("backlash_Y",), lines=LINES), "exact"),
        ("single", 4, Options("one_over_f", 1.0, ("thermal_scale_Z",), lines=LINES), "exact"),
        ("single", 5, Options("range", 1.0, ("lever_ECX",), lines=LINES), "exact"),
        ("double", 6, Options("white", 1.0, ("refractive_index", "periodic_X"), lines=LINES), "exact"),
        ("alias", 7, Options("white", 1.0, ("servo_lag_X",), lines=LINES), "set"),
        ("invisible", 8, Options("white", 1.0, ("lever_EAZ",), lines=28), "listed"),
        ("outside", 9, Options("white", 1.0, ("clamping",), lines=LINES), "unknown"),
        ("gross", 10, Options("white", lines=LINES), "found"),
    ],
)
def test_a_hidden_set_gets_the_right_answer(tmp_path, capsys, kind, seed, options, right):
    case = make(kind, seed, options)
    assert outcome(case.key, diagnosis_of(case, tmp_path)) == right


def test_the_files_hold_no_name_of_an_effect():
    case = make("single", 11, Options(lines=4))
    text = case.machine + case.lengths.partition("\n")[0]
    assert not any(name in text for name in (*named(case.session), *UNLISTED))


@pytest.mark.parametrize("chain", CHAINS)
def test_the_hidden_machine_moves_like_the_exact_model(tmp_path, chain):
    """Two implementations of the same page of conventions."""
    rng = np.random.default_rng(12)
    case = make("null", 12, Options(chain=chain, lines=4))
    model = load_machine(write_set(tmp_path, case.machine, case.lengths)[0])
    hidden = case.session.machine
    truth = random_truth(hidden, rng, 6)
    q = rng.uniform(*hidden.range_mm.T, (50, 3))
    tool = np.tile([70.0, -40.0, -130.0], (50, 1))
    values = np.zeros((50, len(ERRORS)))
    for name, coefficients in truth.curves.items():
        axis = "XYZ".index(name[2])
        values[:, ERROR_INDEX[name]] = legendre.legval(hidden.unit(axis, q[:, axis]), coefficients)
    for name, value in truth.squareness.items():
        values[:, ERROR_INDEX[name]] = value
    assert np.abs(tip(hidden, truth, q, tool) - tip_position(model, values, q, tool)).max() < NANOMETRE


@pytest.mark.parametrize("chain", CHAINS)
def test_every_chain_leaves_four_errors_without_lever(chain):
    assert len(without_lever(draw_machine(np.random.default_rng(1), chain))) == 4


def test_an_effect_has_the_size_that_was_asked_for():
    case = make("single", 13, Options("white", 0.7, ("servo_lag_X",), lines=6))
    got = rms(centred(case.session, case.effect_um)) / case.key["sigma_um"]
    assert got == pytest.approx(0.7, rel=1e-9)


def test_plain_least_squares_finds_an_injected_effect_again():
    """Base model and one column, dense: the size comes back within three standard deviations."""
    case = make("single", 14, Options("white", 1.0, ("backlash_X",)))
    space = base_space(case.session)
    column = along(case.session, 0, case.session.direction[:, 0]).readings(case.session)
    seen = visible_part(space, case.effect_um + case.noise_um)
    column_seen = visible_part(space, column)
    found = column_seen @ seen / (column_seen @ column_seen)
    true = column @ case.effect_um / (column @ column)
    assert abs(found - true) < 3.0 * case.key["sigma_um"] / np.linalg.norm(column_seen)


def test_the_file_can_be_read_and_its_lengths_are_distances(tmp_path):
    case = make("null", 15, Options("white", lines=4))
    _, path = write_set(tmp_path, case.machine, case.lengths)
    lengths = read_lengths(path)
    assert len(lengths) == len(case.noise_um)
    assert set(lengths.labels) == {"run", "line", "repeat", "block", "setup", "pose"}
    assert np.isin(lengths.approach, (-1.0, 1.0)).all()


def test_repeats_differ_by_noise_alone():
    """Position, direction, feed, load and set-up agree in both repeats, so their lengths agree but for the noise."""
    session = make("null", 16, Options("white", lines=4)).session
    first, second = (session.repeat == number for number in (1, 2))
    keys = [
        np.column_stack([session.line, session.load, session.setup, session.k, session.q, session.feed])[which]
        for which in (first, second)
    ]
    orders = [np.lexsort(key.T) for key in keys]
    assert np.abs(keys[0][orders[0]] - keys[1][orders[1]]).max() < PICOMETRE
    assert (session.direction[first][orders[0]] == session.direction[second][orders[1]]).all()


def test_backlash_and_lag_are_the_same_column_where_they_are_meant_to_be():
    session = make("alias", 17, Options("white", lines=16)).session
    rng = np.random.default_rng(0)
    columns = [named(session)[f"{family}_X"](session, rng).readings(session) for family in ("backlash", "servo_lag")]
    assert abs(np.corrcoef(columns)[0, 1]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("label", sorted(UNLISTED))
def test_every_unlisted_effect_is_finite_and_does_something(label):
    session = make("null", 18, Options("white", lines=6)).session
    change = UNLISTED[label](session, np.random.default_rng(3)).readings(session)
    assert np.isfinite(change).all()
    assert rms(centred(session, change)) > 0.0


def test_wilson_interval_of_nine_in_ten():
    """Worked by hand: centre (9 + 1.9207) / 13.8415, half width 1.96 / 13.8415 * sqrt(0.9 + 0.9604)."""
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)


@pytest.mark.parametrize(("seed", "size", "station"), [(701, 1.2, "east"), (704, 2.0, "north"), (706, 2.2, "south")])
def test_a_runout_has_no_unknown_beside_it(tmp_path, seed, size, station):
    name = f"tracer_runout_{station}"
    found = diagnosis_of(make("single", seed, Options("white", size, (name,), lines=LINES)), tmp_path)
    assert [(item["name"], item["grade"]) for item in found["effects"]] == [(name, "confirmed")]
    assert found["unknown"] == []
