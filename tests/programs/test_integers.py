"""Numbers without a decimal point in programs of FANUC: mm or increments as stated, asked where nothing is stated.

The truth is the same program with its decimal points, written by hand from the manuals' rule: one increment of 0.001 mm is
0.0001 inch or 0.001 deg.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from programs.test_correct import run, shift

from compgen.data.machine import load_machine
from compgen.errors import InputError
from compgen.programs import Reader, Setup
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import difference, read_twice
from compgen.programs.path import Moves
from machines import machine_of

ZERO = (0.0, 0.0, 0.0)
EXAMPLES = Path(__file__).parents[2] / "examples"
#: A machine on which 50000 mm are within the travel.
WIDE = machine_of([(-1e5, 1e5)] * 3, 3, tool_offset_mm=ZERO)
HEAD = "%\nO1\nG21 G90 G17 G54 G43 H1\n"
#: What is written, as increments of 0.001 mm, and as mm; P, K of a cycle, L, H, S, F, N and dwells stay what they are.
CASES = {
    "lines": (
        "G0 X50000 Y-5000 Z5000\nG1 Z-100 F200\n",
        "G0 X50. Y-5. Z5.\nG1 Z-.1 F200\n",
        "G0 X50000. Y-5000. Z5000.\nG1 Z-100. F200\n",
    ),
    "signs, zeros and points": (
        "G0 X+7 Y0 Z1.5\nG1 X-0 Y10. F9\n",
        "G0 X.007 Y0 Z1.5\nG1 X0. Y10. F9\n",
        "G0 X7. Y0. Z1.5\nG1 X0. Y10. F9\n",
    ),
    "arcs": (
        "G0 X0 Y0 Z0\nG2 X20 Y0 I10 J0 F50\nG3 X40 R10\n",
        "G0 X0 Y0 Z0\nG2 X.02 Y0 I.01 J0 F50\nG3 X.04 R.01\n",
        "G0 X0 Y0 Z0\nG2 X20. Y0 I10. J0 F50\nG3 X40. R10.\n",
    ),
    "inch": (
        "G20 G0 X50000 Y-1 Z10000\nG21\nX50000\nG1 X1000 F9\n",
        "G20 G0 X5. Y-.0001 Z1.\nG21\nX50.\nG1 X1. F9\n",
        None,
    ),
    "cycle": (
        "G0 X0 Y0 Z30\nG99 G83 X10 Y10 Z-20 R2 Q5 K2 P500 F100\nX20 L2\nG80\nG0 Z40\n",
        "G0 X0 Y0 Z.03\nG99 G83 X.01 Y.01 Z-.02 R.002 Q.005 K2 P500 F100\nX.02 L2\nG80\nG0 Z.04\n",
        "G0 X0 Y0 Z30.\nG99 G83 X10. Y10. Z-20. R2. Q5. K2 P500 F100\nX20. L2\nG80\nG0 Z40.\n",
    ),
    "shifts": (
        "G52 X50 Y7\nG0 X0 Y0 Z5\nG4 X500\nG4 P500\nG53 G0 Z-1\nG92 X100\nG1 X5 Y0 Z1 F9\n",
        "G52 X.05 Y.007\nG0 X0 Y0 Z.005\nG53 G0 Z-.001\nG92 X.1\nG1 X.005 Y0 Z.001 F9\n",
        "G52 X50. Y7.\nG0 X0 Y0 Z5.\nG53 G0 Z-1.\nG92 X100.\nG1 X5. Y0 Z1. F9\n",
    ),
    "increments, settings and calls": (
        "G5.1 Q1 R5\nG187 P2\nG0 X0 Y0 Z0\nG91 G1 X5 F9\nM98 P7 L2\nG90\nM30\nO7\nG1 X5 (X500)\nM99\n",
        "G0 X0 Y0 Z0\nG91 G1 X.005 F9\nX.005\nX.005\nG90\n",
        "G0 X0 Y0 Z0\nG91 G1 X5. F9\nX5.\nX5.\nG90\n",
    ),
    "planes and rotary axes": (
        "G0 A90000\nG18 G0 X10 Y0 Z0\nG3 X0 Z10 I-10 K0 F9\n",
        "G0 A90.\nG18 G0 X.01 Y0 Z0\nG3 X0 Z.01 I-.01 K0 F9\n",
        None,
    ),
    "many": tuple(
        "G0 X0 Y0 Z0\nG1 F9\n" + "".join(f"X{k:{form}} Y{2 * k:{form}}\n" for k in numbers)
        for form, numbers in (("d", range(1, 60)), (".3f", np.arange(1, 60) / 1e3), (".1f", range(1, 60)))
    ),
}


def moves_of(path, text, **stated):
    """Moves of a whole program, read twice; lines do not count."""
    path.write_text(HEAD + text + ("" if "M30" in text else "M30\n") + "%\n")
    setup = Setup({"G54": ZERO}, {"1": ZERO}, **stated)
    reader = Reader(WIDE, DIALECTS["fanuc"], setup, path)
    found = Moves.joined([batch.moves for batch in read_twice(reader)])
    return found, reader


@pytest.mark.parametrize(
    ("name", "integers"),
    [(name, kind) for name in CASES for kind in ("mm", "increments") if kind != "mm" or CASES[name][2]],
)
def test_numbers_without_a_point_are_what_is_stated(tmp_path, name, integers):
    text, small, large = CASES[name]
    expected = small if integers == "increments" else large
    increment_mm = 1e-3 if integers == "increments" else None
    read, reader = moves_of(tmp_path / "a", text, integers=integers, increment_mm=increment_mm)
    wanted, _ = moves_of(tmp_path / "b", expected)
    for key in ("kind", "start_mm", "end_mm", "centre_mm", "sweep_rad"):
        np.testing.assert_allclose(getattr(read, key), getattr(wanted, key), rtol=0, atol=1e-9)
    assert any("without a decimal point" in said for said in reader.assumed)


@pytest.mark.parametrize(
    ("increment_mm", "inch", "length_mm"), [(1e-2, "G21", 5.0), (1e-4, "G21", 0.05), (1e-4, "G20", 0.127)]
)
def test_other_increments(tmp_path, increment_mm, inch, length_mm):
    """IS-A and IS-C: 0.01 mm, and 0.0001 mm or 0.00001 inch."""
    read, _ = moves_of(
        tmp_path / "a", f"{inch} G0 X0 Y0 Z0\nG1 X500 F9\n", integers="increments", increment_mm=increment_mm
    )
    assert read.end_mm[-1, 0] == pytest.approx(length_mm, abs=1e-12)


@pytest.mark.parametrize(
    ("block", "unit", "readings"),
    [
        ("X500", "G21", "500 mm, or 0.5 mm"),
        ("G1 X5. J500", "G21", "500 mm, or 0.5 mm"),
        ("Z-25", "G20", "-25 inch, or -0.0025 inch"),
    ],
)
def test_it_is_asked_where_nothing_is_stated(tmp_path, block, unit, readings):
    with pytest.raises(InputError, match=readings) as refused:
        moves_of(tmp_path / "a", f"{unit} G0 X0 Y0 Z0\n{block}\n")
    assert refused.value.line == 5


@pytest.mark.parametrize("dwell", ["G4 X500", "G04 U500", "G4 U1.5", "G4 P500"])
def test_a_dwell_is_no_length_and_asks_nothing(tmp_path, dwell):
    read, _ = moves_of(tmp_path / "a", f"G0 X0 Y0 Z0\n{dwell}\nG1 X5. F9\n")
    assert len(read) == 2


def test_the_corrected_program_has_valid_numbers(tmp_path):
    """A scale of 0.1 um/mm in X: 100 mm become 99.99, whatever way they are written."""
    text = HEAD + "G0 X100000 Y0 Z5000 (X100)\nG1 Z0 F100\nX200000\nG4 X500\nM30\n%\n"
    setup = Setup({"G54": ZERO}, {"1": ZERO}, integers="increments", increment_mm=0.001)
    result, corrected = run(tmp_path, text, shift(slope=0.1), "fanuc", setup)
    assert result.accepted
    assert corrected.endswith("G0 X99.99 Y0 Z5. (X100)\nG1 Z0 F100\nX199.98\nG4 X500\nM30\n%\n")


def test_the_follower_finds_a_reader_that_takes_them_otherwise(tmp_path):
    read, reader = moves_of(tmp_path / "a", "G0 X5 Y0 Z0\nG1 X500 F9\n", integers="mm")
    other, _ = moves_of(tmp_path / "a", "G0 X5 Y0 Z0\nG1 X500 F9\n", integers="increments", increment_mm=1e-3)
    assert difference(read, other) is not None
    assert reader.setup.integers == "mm"


def corrected_by_command(call, tmp_path, programs, *more):
    """Exit code, JSON and program of ``volcomp correct`` with a machine file that has a section [programs]."""
    machine, program = tmp_path / "shop.toml", tmp_path / "part.nc"
    machine.write_text(load_machine("zha-gantry").file.read_text().replace('"zha-gantry"', '"shop"') + programs)
    program.write_text("%\nO1\nG21 G90 G17 G54\nG0 X-100 Y-50 Z-20\nG1 X-200 F500\nM30\n%\n")
    words = [
        "correct",
        str(machine),
        str(program),
        "--errors",
        str(EXAMPLES / "zha-gantry.truth.errors.csv"),
        "--dialect",
    ]
    words += ["fanuc", "--wcs", "G54=-1,-1,-1", "--out", str(tmp_path / "out"), "--json", *more]
    code, out, error = call(*words)

    return code, out + error


@pytest.mark.parametrize(
    ("programs", "more", "length_mm"),
    [
        ('\n[programs]\nintegers = "mm"\n', (), 100.0),
        ('\n[programs]\nintegers = "increments"\nincrement_mm = 0.001\n', (), 0.1),
        ('\n[programs]\nintegers = "increments"\nincrement_mm = 0.001\n', ("--integers", "mm"), 100.0),
        ('\n[programs]\nintegers = "mm"\n', ("--integers", "increments", "--increment-mm", "0.01"), 1.0),
    ],
)
def test_machine_file_and_command_line(call, tmp_path, programs, more, length_mm):
    code, output = corrected_by_command(call, tmp_path, programs, *more)
    assert code == 0, output
    assert json.loads(output)["path_mm"] == pytest.approx(length_mm, abs=1e-6)


@pytest.mark.parametrize(
    ("programs", "more", "words"),
    [
        ("", (), "X-100 has no decimal point"),
        ("", ("--integers", "increments"), "increments of what"),
        ('\n[programs]\nintegers = "increments"\n', (), "increment_mm"),
        ('\n[programs]\nintegers = "inch"\n', (), "integers"),
        ('\n[programs]\nintegers = "increments"\nincrement_mm = 0\n', (), "increment_mm"),
    ],
)
def test_what_is_not_stated_is_refused(call, tmp_path, programs, more, words):
    code, output = corrected_by_command(call, tmp_path, programs, *more)
    assert (code, words in output) == (2, True), output
    assert not (tmp_path / "out").exists()
