"""Slips in the files of a shop: units, exchanged directions, runs that disagree with the others in a pattern, copies."""

import json
from pathlib import Path

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.circles import PLANES, Circles, format_circles
from compgen.data.deviations import Deviations, format_deviations
from compgen.errors import InputError
from compgen.identification.slips import check_sizes, copies, patterns

AT = np.linspace(0.0, 500.0, 11)
B_MM = -6e-3


def curve(rng):
    return 2e-5 * AT + 4e-3 * np.sin(AT / 80.0 + rng.uniform(0.0, 6.0)) + rng.normal(0.0, 1e-3, len(AT))


def runs(seed=1, slip=None, *, count=5, noise=3e-4, which=2, axis=0, step=None, drift=0.0):
    """Bidirectional runs of an axis with a reversal; ``slip`` changes values (mm) and direction of one run."""
    rng = np.random.default_rng(seed)
    usual, parts = curve(rng), []
    for run in range(count):
        for way in (1, -1):
            values = usual + 0.5 * way * B_MM + rng.normal(0.0, noise, len(AT)) + drift * run * AT / 500.0
            said = way
            if slip and run == which:
                values, said = slip(values, way)
            values = values if step is None else step * np.round(values / step)
            parts.append((values, said, run + 1))
    value = np.concatenate([part[0] for part in parts])
    way, run = (np.repeat([part[k] for part in parts], len(AT)) for k in (1, 2))
    return AxisRuns(np.full(len(value), axis), np.tile(AT, len(parts)), way, run, value)


def up(values, way, changed):
    return (changed if way > 0 else values), way


SLIPS = {
    "shifted on": (lambda v, w: up(v, w, np.append(v[1:], v[-1])), "that at 0 mm belongs to 50 mm"),
    "shifted back": (lambda v, w: up(v, w, np.insert(v[:-1], 0, v[0])), "that at 50 mm belongs to 0 mm"),
    "turned round": (lambda v, w: up(v, w, v[::-1]), "turned round (that at 0 mm belongs to 500 mm)"),
    "opposite sign": (lambda v, w: up(v, w, -v), "the sign of its values is the opposite one"),
    "inches": (lambda v, w: up(v, w, v / 25.4), "its values are thousandths of an inch and not um"),
    "three pairs": (
        lambda v, w: up(v, w, v[[10, 1, 7, 5, 4, 3, 6, 2, 8, 9, 0]]),
        "values are exchanged (0 mm and 500 mm; 100 mm and 350 mm; 150 mm and 250 mm)",
    ),
    "one value": (
        lambda v, w: up(v, w, v + 8e-3 * (AT == 200.0)),
        "its value at 200 mm is left out, which is off by +",
    ),
    "directions exchanged": (lambda v, w: (v, -w), "its directions are exchanged (1 and -1)"),
}


@pytest.mark.parametrize("name", SLIPS)
@pytest.mark.parametrize("which", [0, 2, 4])
def test_a_run_that_disagrees_in_a_pattern_is_named_with_what_explains_it(name, which):
    slip, text = SLIPS[name]
    for seed in (4, 7):
        found = patterns(runs(seed, slip, which=which))
        assert found, seed
        assert all(f"run {which + 1} disagrees with the other runs in a pattern" in item for item in found)
        assert any(text in item for item in found)


def test_a_run_downwards_that_is_labelled_upwards_is_named():
    rng = np.random.default_rng(8)

    def slip(values, way):
        return (values - B_MM + rng.normal(0.0, 3e-4, len(AT)) if way > 0 else values), way

    (found,) = patterns(runs(8, slip))
    assert found.startswith("X, direction 1, run 3 ")
    assert "it was measured in the other direction than labelled" in found


def test_of_two_runs_either_may_be_wrong():
    (found,) = patterns(runs(3, SLIPS["shifted on"][0], count=2, which=1))
    assert (
        "run 2 disagrees with run 1 in a pattern, which is no noise (which of them is right, the file does not tell)"
        in found
    )


@pytest.mark.parametrize("wrong", [(4, 5, 6), (2, 5), (1, 6), (3,)])
def test_several_runs_with_the_same_slip_are_all_named(wrong):
    """A second file of three runs, each shifted by one target: half of the runs, and no outlier among them."""
    measured = runs(3, count=6)
    values = measured.deviation_mm.reshape(-1, len(AT)).copy()
    for row in range(len(values)):
        if row // 2 + 1 in wrong:
            values[row] = np.append(values[row, 1:], values[row, -1])
    found = patterns(AxisRuns(measured.axis, measured.position_mm, measured.direction, measured.run, values.ravel()))
    said = {int(text.partition(", run ")[2].split()[0]) for text in found}
    assert said in ({*wrong}, {*range(1, 7)} - {*wrong} if len(wrong) == 3 else {*wrong})
    assert all("shifted by one target" in text for text in found)
    assert all("which of them is right" in text for text in found) == (len(wrong) == 3)


@pytest.mark.parametrize(
    "how", [{}, {"noise": 3e-3}, {"count": 2, "noise": 2e-3}, {"count": 3, "noise": 1e-3}, {"noise": 0.0}, {"step": 1e-3},
            {"drift": 5e-3}, {"drift": 2e-3, "count": 3}]
)  # fmt: skip
def test_noise_rounding_and_drift_are_no_pattern(how):
    assert not [seed for seed in range(40) if patterns(runs(seed, **how))]


def test_the_commands_say_the_pattern_and_accept_nothing(tmp_path, small_machine, capsys):
    measured = runs(4, SLIPS["shifted on"][0])
    path = tmp_path / "x.axis.csv"
    path.write_text(format_axis_runs(measured).replace(",0.000000,", ",0,"))
    machine = tmp_path / "m.toml"
    text = Path(small_machine.source).read_text()
    machine.write_text(text.replace("[-300.0, 200.0]", "[0.0, 500.0]").replace("[-50.0, 100.0", "[0.0, 100.0"))
    words = ["run", str(machine), str(path), "--controller", "isg-csv", "--no-report", "--out", str(tmp_path / "o")]
    assert run_command(cli, words) == 1
    result = json.loads((tmp_path / "o" / "result.json").read_text())
    assert not result["accepted"]
    assert any(item["blocking"] and "shifted by one target" in item["text"] for item in result["objections"])
    assert "run 3 disagrees" in capsys.readouterr().err


def test_repeated_positions_and_circles_are_compared_run_by_run():
    rng = np.random.default_rng(5)
    place = np.column_stack([rng.uniform(0.0, 300.0, 12), rng.uniform(0.0, 300.0, 12), np.zeros(12)])
    usual = rng.normal(0.0, 8e-3, (12, 3))
    values = [usual + rng.normal(0.0, 3e-4, usual.shape) for _ in range(3)]
    values[1][:, 1] = np.roll(values[1][:, 1], 1)
    labels = {"run": np.repeat([1, 2, 3], 12)}
    (found,) = patterns(Deviations(np.tile(place, (3, 1)), np.concatenate(values), labels=labels))
    assert found.startswith("dy_um, run 2 ")
    assert "shifted by one target" in found
    angle = np.radians(np.arange(0.0, 360.0, 10.0))
    shape = 5e-3 * np.sin(2 * angle) + 3e-3 * np.cos(3 * angle + 0.4) + 2e-3 * np.cos(angle + 1.0)
    values = [shape + rng.normal(0.0, 1e-4, len(angle)) for _ in range(3)]
    values[2] = values[2][::-1]
    (found,) = patterns(circles(angle, np.concatenate(values), np.ones(108, dtype=int), np.repeat([1, 2, 3], 36)))
    assert found.startswith("circle in XY, direction 1, run 3 ")
    assert "turned round" in found


def circles(angle, value, way, run, plane="XY", centre_mm=(0.0, 100.0, -120.0)):
    count = len(value)
    nan = np.full(count, np.nan)
    return Circles(np.full(count, list(PLANES).index(plane)), np.tile(angle, count // len(angle)), np.full(count, 90.0), value,
                   way, run, np.zeros(count, dtype=int), np.tile(centre_mm, (count, 1)), nan)  # fmt: skip


# --- copies ----------------------------------------------------------------------------------------------------------


def test_a_copy_of_a_run_under_another_number_is_said():
    measured = runs(2, count=3)
    values = measured.deviation_mm.copy()
    values[44:] = values[:22]
    again = AxisRuns(measured.axis, measured.position_mm, measured.direction, measured.run, values)
    assert copies(again)[0] == "X, direction -1, run 3 has exactly the values of run 1: a copy counts twice"
    assert len(copies(again)) == 2
    assert copies(measured) == ()


@pytest.mark.parametrize("change", ["renumbered", "reordered", "reformatted"])
def test_a_file_given_twice_is_refused_whatever_its_run_numbers(tmp_path, small_machine, capsys, change):
    text = "\n".join(
        f"X,{x},{way},1,{1e3 * v:.4f}"
        for x, way, v in zip(AT - 300.0, [1] * 11, curve(np.random.default_rng(1)), strict=True)
    )
    head = "axis,position_mm,direction,run,deviation_um\n"
    first, second = tmp_path / "a.axis.csv", tmp_path / "b.axis.csv"
    first.write_text(head + text + "\n")
    lines = text.replace(",1,1,", ",1,2,").splitlines()
    if change == "reordered":
        lines = lines[::-1]
    if change == "reformatted":
        lines = [
            ",".join([*line.split(",")[:1], f"{float(line.split(',')[1]):.3f}", *line.split(",")[2:]]) for line in lines
        ]
    second.write_text(head + "\n".join(lines) + "\n")
    words = ["identify", str(small_machine.source), str(first), str(second), "--out", str(tmp_path / "o")]
    assert run_command(cli, words) == 2
    assert "contains the same readings as" in capsys.readouterr().err


# --- units -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", [0, 1, 2])
def test_one_run_in_mm_among_runs_in_um_is_asked_about(which):
    with pytest.raises(InputError, match=rf"X, run {which + 1}: the largest deviation is 0\.0\d+ um.*in mm") as found:
        check_sizes(runs(1, lambda v, w: (1e-3 * v, w), count=3, which=which))
    assert "--small-deviations" in str(found.value)
    check_sizes(runs(1))


@pytest.mark.parametrize("kind", ["axis", "component", "file", "circle"])
def test_one_axis_column_or_file_in_another_unit_is_asked_about(tmp_path, small_machine, capsys, kind):
    rng, files = np.random.default_rng(3), []
    if kind in ("axis", "file"):
        for name, axis, factor in (("x", 0, 1.0), ("y", 1, 1e-3)):
            values = factor * curve(rng)
            at = np.linspace(-100.0, 200.0, 11)
            ones = np.ones(11, dtype=int)
            files.append(
                (f"{name}.axis.csv", format_axis_runs(AxisRuns(np.full(11, axis), at, ones, ones, values)), factor)
            )
        if kind == "axis":
            files = [("both.axis.csv", files[0][1] + "\n".join(files[1][1].splitlines()[-11:]) + "\n", 1.0)]
        files = [
            (name, "\n".join(line for line in text.splitlines() if not line.startswith("#")) + "\n", f)
            for name, text, f in files
        ]
        wanted = "Y, run 1: the largest deviation is 0.0"
    elif kind == "component":
        place = np.stack(
            np.meshgrid([-200.0, 0.0, 100.0], [0.0, 100.0, 200.0], [-200.0, -100.0], indexing="ij"), -1
        ).reshape(-1, 3)
        values = rng.normal(0.0, 5e-3, place.shape) * [1.0, 1e-3, 1.0]
        files = [("p.deviations.csv", format_deviations(Deviations(place, values)), 1.0)]
        wanted = "dy_um, run 0: the largest deviation is 0.0"
    else:
        angle = np.radians(np.arange(0.0, 360.0, 10.0))
        shape = 9e-3 * np.sin(2 * angle)
        both = circles(angle, np.concatenate([shape, 1e-3 * shape]), np.repeat([1, -1], 36), np.repeat([1, 2], 36))
        files = [("c.circle.csv", format_circles(both), 1.0)]
        wanted = "XY, run 2: the largest deviation is 0.0"
    for name, text, _ in files:
        (tmp_path / name).write_text(text)
    words = [
        "identify",
        str(small_machine.source),
        *(str(tmp_path / name) for name, _, _ in files),
        "--out",
        str(tmp_path / "o"),
    ]
    assert run_command(cli, words) == 2
    assert wanted in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


# --- clockwise and counter-clockwise ---------------------------------------------------------------------------------


def circle_with(reversals_um, planes=("XY",), *, exchanged=(), seed=1):
    """Circles with reversals of X, Y, Z in both directions; in ``exchanged`` planes the labels of the directions are wrong."""
    rng, parts = np.random.default_rng(seed), []
    angle = np.radians(np.arange(0.0, 360.0, 5.0))
    for plane in planes:
        first, second = PLANES[plane]
        for way in (1, -1):
            value = np.cos(angle) * -way * np.sign(np.round(np.sin(angle), 9)) * 5e-4 * reversals_um[first]
            value += np.sin(angle) * way * np.sign(np.round(np.cos(angle), 9)) * 5e-4 * reversals_um[second]
            value += rng.normal(0.0, 2e-4, len(angle)) + 2e-3 * np.sin(2 * angle)
            said = np.full(len(angle), -way if plane in exchanged else way)
            parts.append(circles(angle, value, said, np.ones(len(angle), dtype=int), plane, (0.0, 100.0, -120.0)))
    return parts


def asked(tmp_path, machine, parts, comment=""):
    paths = []
    for k, part in enumerate(parts):
        path = tmp_path / f"{k}.circle.csv"
        path.write_text(comment + format_circles(part))
        paths.append(str(path))
    return run_command(cli, ["identify", str(machine.source), *paths, "--out", str(tmp_path / "o")])


@pytest.mark.parametrize("planes", [("XY",), ("YZ",), ("ZX",), ("XY", "YZ", "ZX")])
def test_axes_that_all_run_ahead_ask_whether_the_directions_are_exchanged(tmp_path, small_machine, capsys, planes):
    wrong = circle_with((-6.0, -4.0, -3.0), planes, exchanged=planes[-1:])
    assert asked(tmp_path, small_machine, wrong) == 2
    said = capsys.readouterr().err
    assert "both axes run ahead" in said
    assert "# runs_ahead = true" in said
    assert f"in {planes[-1]} say" in said
    assert not (tmp_path / "o").exists()
    assert asked(tmp_path, small_machine, wrong, "# runs_ahead = true\n") == 0


@pytest.mark.parametrize("reversals", [(-6.0, -4.0, -3.0), (6.0, -4.0, 3.0), (0.0, 0.0, 0.0), (6.0, 0.0, 0.0)])
def test_axes_that_stay_behind_or_differ_are_not_asked_about(tmp_path, small_machine, reversals):
    assert asked(tmp_path, small_machine, circle_with(reversals)) == 0
