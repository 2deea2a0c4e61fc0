"""Q parameters of DIN/ISO programs of HEIDENHAIN: numbers where they are constant, refused where they are not."""

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import run, shift

from compgen.errors import InputError
from compgen.programs import Reader, Setup
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import read_twice
from compgen.programs.path import Moves

ISO = "%P G71 *\nN1 T1 G17*\nN2 G00 G40 G90 X+0 Y+0 Z+10*\n{}N90 G00 Z+50 M2*\nN99 %P G71 *\n"
Q_PROGRAM = (
    "D00 Q1 P01 +50 * ; length\nN5 D00 Q2 P01 -Q1*\nD01 Q3 P01 +Q1 P02 -20*\nD02 Q4 P01 Q1 P02 +12.5*\nD03 Q5 P01 +3 P02 -Q2*\n"
    "D04 Q6 P01 +Q5 P02 +4*\nD05 Q7 P01 +16*\nD06 Q8 P01 +30*\nD07 Q9 P01 +60*\nD08 Q10 P01 +3 P02 +4*\n"
    "Q11 = (Q8 + Q9) * Q10 - SQRT 4*\n"
    "N60 X+Q1 Y-Q7*\nN61 G01 Z-2 FQ1*\nX+Q3 Y+Q4*\nI+Q3 J+30*\nG02 X+Q3 Y+Q4*\nG01 G91 X-Q7 Y+Q11*\nG90 G00 Z+Q6*\n"
    "G200 DRILLING\n Q200=Q8 ;CLEARANCE\n Q201=-Q7\n Q206=150\n Q202=5\n Q203=+0\n Q204=Q1*\nX+Q2 Y+Q8 M99*\n"
)
PLAIN_PROGRAM = (
    "N60 X+50 Y-4*\nN61 G01 Z-2 F50*\nX+30 Y+37.5*\nI+30 J+30*\nG02 X+30 Y+37.5*\nG01 G91 X-4 Y+3*\nG90 G00 Z+37.5*\n"
    "G200 DRILLING\n Q200=0.5 ;CLEARANCE\n Q201=-4\n Q206=150\n Q202=5\n Q203=+0\n Q204=50*\nX-50 Y+0.5 M99*\n"
)


def followed(tmp_path, text):
    """Moves of a DIN/ISO program, by reader and follower."""
    path = tmp_path / "p.i"
    path.write_text(text)
    setup = Setup({"PRESET": (0.0, 0.0, 0.0)}, {"1": (0.0, 0.0, 0.0)})
    return Moves.joined([batch.moves for batch in read_twice(Reader(mill(), DIALECTS["heidenhain-iso"], setup, path))])


def test_q_parameters_that_are_constant_are_their_numbers(tmp_path):
    found, truth = (followed(tmp_path, ISO.format(text)) for text in (Q_PROGRAM, PLAIN_PROGRAM))
    assert len(found) == len(truth) > 8
    np.testing.assert_allclose(found.end_mm, truth.end_mm, atol=1e-9)
    np.testing.assert_allclose(found.centre_mm, truth.centre_mm, atol=1e-9)
    result, corrected = run(
        tmp_path,
        ISO.format(Q_PROGRAM),
        shift(x=10.0),
        "heidenhain-iso",
        Setup({"PRESET": (0.0,) * 3}, {"1": (0.0,) * 3}),
    )
    assert result.accepted
    assert "; D00 Q1 P01 +50 * ; length\n; N5 D00 Q2 P01 -Q1\n" in corrected
    assert "N60 X+49.99 Y-4*\nN61 G01 Z-2 F50*\nX+29.99 Y+37.5*\n" in corrected
    assert any(text.endswith("Q11, Q2, Q3, Q4, Q5, Q6, Q7, Q8, Q9") or "Q1, Q2, Q3" in text for text in result.assumed)


@pytest.mark.parametrize(
    ("body", "line"),
    [
        ("N5 X+Q1*\n", 4),
        ("N5 D00 Q1 P01 +Q2*\nX+Q1*\n", 4),
        ("N5 D04 Q1 P01 +5 P02 +0*\n", 4),
        ("N5 D05 Q1 P01 -5*\n", 4),
        ("N5 D00 Q1 P01 +5*\nN6 D09 P01 +Q1 P02 +5 P03 1*\n", 5),
        ("N5 D18 Q1 ID20 NR5*\n", 4),
        ("N5 D00 Q1 P01 +5*\nN6 L1,0*\nN7 X+Q1*\n", 5),
        ("G200 DRILLING\n Q200=2\n Q201=-4\n Q203=+0\n Q204=5*\nX+5 M99*\nN5 Q201=-5*\nX+9 M99*\n", 10),
        ("N5 D00 Q201 P01 +5*\n", 4),
    ],
)
def test_q_parameters_that_are_not_known_are_refused_with_their_line(tmp_path, body, line):
    with pytest.raises(InputError) as caught:
        followed(tmp_path, ISO.format(body))
    assert caught.value.line == line
