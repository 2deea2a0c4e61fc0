"""Diagnosis of hidden sets whose files differ from the usual: machine files, few lines, uneven stations, steep curves."""

import json
import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import hidden.sets  # noqa: E402 - found through the line above
from hidden.kinematics import Truth, random_truth  # noqa: E402
from hidden.score import outcome  # noqa: E402
from hidden.sets import Options, make  # noqa: E402
from hidden.write import write_set  # noqa: E402

from compgen.cli import cli  # noqa: E402
from compgen.errors import CompgenWarning  # noqa: E402

LINES = 12
NOISE_OF_ONE_STATION_MM = 2e-3


def answer(case, folder, machine, lengths):
    """Outcome of a set with changed files, and the diagnosis."""
    places = write_set(folder, machine, lengths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        cli.main(["diagnose", *map(str, places), "--out", str(folder / "out")], standalone_mode=False)
    found = json.loads((folder / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    return outcome(case.key, found), found


def with_entry(machine, key, value):
    return re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", machine)


def with_longer_travel(machine):
    """The machine file of a machine of which the measurement uses half the travel."""

    def longer(found):
        low, high = float(found[1]), float(found[2])
        return f"range_mm = [{low - 0.4 * (high - low)}, {high + 0.6 * (high - low)}]"

    return re.sub(r"range_mm = \[([-\d.]+), ([-\d.]+)\]", longer, machine)


FORMS = {
    "all 21 errors": lambda text: with_entry(text, "errors", 21),
    "many nodes": lambda text: with_entry(text, "nodes", 31),
    "longer travel": with_longer_travel,
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("kind", "right"), [("null", "clean"), ("single", "exact")])
def test_the_answer_does_not_depend_on_how_rich_the_machine_file_is(tmp_path, capsys, form, kind, right):
    effects = ("periodic_Y",) if kind == "single" else ()
    case = make(kind, 151, Options("white", 1.0, effects, lines=LINES))
    assert answer(case, tmp_path, FORMS[form](case.machine), case.lengths)[0] == right


@pytest.mark.parametrize(("seed", "family"), [(2, "ar1"), (4, "random_walk")])
def test_few_lines_raise_no_alarm(tmp_path, capsys, seed, family):
    case = make("null", seed, Options(family, lines=8))
    assert answer(case, tmp_path, case.machine, case.lengths)[0] == "clean"


def kinked_truth(machine, rng, degree):
    """Errors that are straight between eleven nodes."""
    smooth = random_truth(machine, rng, degree)
    nodes, fine = np.linspace(-1.0, 1.0, 11), np.linspace(-1.0, 1.0, 2001)
    curves = {}
    for name, coefficients in smooth.curves.items():
        size = 1.2e-3 if name[1] in "XYZ" else 1.8e-6
        values = np.polynomial.legendre.legval(nodes, coefficients) + rng.normal(size=11) * size
        curves[name] = np.polynomial.legendre.legfit(fine, np.interp(fine, nodes, values), 70)
    return Truth(curves, smooth.squareness)


def test_curves_with_kinks_at_the_nodes_are_errors_of_the_machine(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(hidden.sets, "random_truth", kinked_truth)
    case = make("null", 7600, Options("white", lines=16))
    assert answer(case, tmp_path, case.machine, case.lengths)[0] == "clean"


def test_a_station_that_scatters_more_than_the_others_is_no_effect(tmp_path, capsys):
    case = make("null", 7400, Options("white", lines=LINES))
    head, *rows = case.lengths.splitlines()
    names = head.split(",")
    rng = np.random.default_rng(5)
    for k, row in enumerate(rows):
        cells = row.split(",")
        if cells[0] == case.session.station_names[1]:
            length = float(cells[names.index("length_mm")]) + NOISE_OF_ONE_STATION_MM * rng.normal()
            cells[names.index("length_mm")] = f"{length:.7f}"
        rows[k] = ",".join(cells)
    assert answer(case, tmp_path, case.machine, "\n".join([head, *rows]) + "\n")[0] == "clean"


@pytest.mark.parametrize("name", ["laser_scale", "tool_offset_error"])
def test_two_tools_cannot_tell_a_scale_of_the_laser_from_a_wrong_offset(tmp_path, capsys, name):
    """Both come as one set: the difference of two offsets is the only known length, and their tilt is free."""
    case = make("single", 7030 if name == "laser_scale" else 7037, Options("white", 2.0, (name,), lines=14))
    word, found = answer(case, tmp_path, case.machine, case.lengths)
    assert word in ("exact", "alias set holds it")
    weights = {item["name"]: item["weight"] for item in found["effects"][0]["alias_set"]}
    assert min(weights["laser_scale"], weights["tool_offset_error"]) > 0.45
