"""The correction of NC programs: on a virtual machine, in five dialects, byte for byte, and what is refused."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from programs.make import G_CODE, OFFSETS_MM, TOOLS_MM, mill, mixed_program, random_program
from scipy.spatial import cKDTree

import compgen
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves, format_errors
from compgen.errors import InputError
from compgen.kinematics.exact_chain import exact_error, tip_position
from compgen.programs import CorrectOptions, Reader, Setup, correct_program, model_of, read_tools
from compgen.programs.dialects import DIALECTS
from compgen.programs.path import lengths_of, points_of

SETUP = Setup(OFFSETS_MM, TOOLS_MM)
PLAIN = Setup({"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}, {"1": (0.0, 0.0, 0.0)})


def run(tmp_path, text, errors, dialect="linuxcnc", setup=SETUP, machine=None, reversal=None, only=None, **options):
    """Correct a program; returns the result and the corrected text."""
    program = tmp_path / "p.nc"
    program.write_bytes(text.encode("latin-1"))
    model = model_of(machine or mill(), errors, reversal, only)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions(dialect, **options), setup)
    return result, (tmp_path / "out" / result.file).read_bytes().decode("latin-1")


def body(text):
    """A corrected program in the dialect of FANUC without its header."""
    return re.sub(r"\(CORRECTED BY(.|\n)*POSITION\)\r?\n((IF|#3000|N900\d).*\n)*", "", text)


def moves_of(text, dialect, setup, machine=None):
    """All moves of a program without a header."""
    reader = Reader(machine or mill(), DIALECTS[dialect], setup, "p")
    return reader.batch(text.encode("latin-1"), 1).moves


def shift(x=0.0, y=0.0, z=0.0, slope=0.0):
    """Errors that move the tool by a constant (um), and X by a slope (um/mm): hand calculations are easy."""
    ends = np.array([-600.0, 600.0])
    curves = {"EXX": 1e-3 * (x + slope * ends), "EYX": np.full(2, 1e-3 * y), "EZX": np.full(2, 1e-3 * z)}
    return ErrorTable({name: Curve(ends, value, np.zeros(2)) for name, value in curves.items()})


# --- the virtual machine ---------------------------------------------------------------------------------------------


def sampled(moves, step_mm):
    """Points along all moves at feed, each with its tool."""
    cut = moves.part(np.flatnonzero(moves.cutting))
    count = np.ceil(lengths_of(cut) / step_mm).astype(int) + 1
    own = np.repeat(np.arange(len(cut)), count)
    share = (np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)) / np.maximum(count[own] - 1, 1)
    many = cut.part(own)
    return points_of(many, share), many.tool_mm


def distance_to_path(points, path):
    """Distance of points from a dense polyline."""
    near = cKDTree(path).query(points, k=12)[1]  # also those of another move that comes close
    best = np.full(len(points), np.inf)
    for first in np.concatenate([near - 1, near], axis=1).T.clip(0, len(path) - 2):
        a, b = path[first], path[first + 1]
        square = np.maximum(((b - a) ** 2).sum(axis=1), 1e-30)
        share = np.clip(((points - a) * (b - a)).sum(axis=1) / square, 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - a - share[:, None] * (b - a), axis=1))
    return best


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WYFXZT"])
@pytest.mark.parametrize("seed", [3, 8])
def test_on_a_machine_of_finite_rotations_the_tool_follows_the_wanted_path(tmp_path, make_errors, chain, seed):
    """The tool of an independent product of rotations, moved by the corrected text, is on the path of the original."""
    machine = compgen.Machine("m", compgen.Chain(chain), mill().axes, tool_offset_mm=(0.0, 0.0, -50.0))
    errors = make_errors(machine, seed, (900e-6, -600e-6, 700e-6)[: len([n for n in ("EC0Y", "EB0Z", "EA0Z")])])
    text = random_program(seed, linuxcnc=False, cycles=False)
    result, corrected = run(tmp_path, text, errors, machine=machine)
    start = corrected.index("G21 G90")
    wanted, _ = sampled(moves_of(text, "linuxcnc", SETUP, machine), 0.05)

    def tips(program):
        at, tool = sampled(moves_of(program, "linuxcnc", SETUP, machine), 0.5)
        return tip_position(machine, errors.at(at), at, tool) - tool

    before, after = (distance_to_path(tips(program), wanted) for program in (text, corrected[start:]))
    assert before.max() > 0.02
    assert after.max() < 1.2e-3  # the tolerance, and the decimals
    assert result.accepted
    assert abs(result.after.normal_mm - after.max()) < 0.4e-3


def test_a_constant_error_is_taken_off_with_its_sign(tmp_path):
    """The machine moves 10 um too far in X: the corrected program asks for 10 um less. By hand."""
    text = "%\nO7\nG21 G90 G17 G54\nG0 X10. Y0. Z5.\nG1 Z-1. F100\nX20.\nG2 X30. Y10. I0. J10.\nM30\n%\n"
    setup = Setup({"G54": (0.0, 0.0, 0.0)})
    result, corrected = run(tmp_path, text, shift(x=10.0, y=-4.0), "fanuc", setup)
    moves = "G0 X9.99 Y0.004 Z5.\nG1 Z-1. F100\nX19.99\nG2 X29.99 Y10.004 I0. J10.\nM30\n%\n"
    assert corrected.endswith(moves)
    assert corrected.startswith("%\nO7\n(CORRECTED BY VOLCOMP ")
    assert "IF[ABS[#5221-[0.0000]]LE0.001]GOTO9001\n#3000=1(G54 IS NOT THAT OF THE CORRECTION)\nN9001\n" in corrected
    assert result.before.largest_mm == pytest.approx(np.hypot(10e-3, 4e-3), abs=1e-9)
    assert result.after.largest_mm < 1e-9
    assert result.counts == {"blocks": 9, "changed_blocks": 3, "added_blocks": 0}


def test_work_offset_and_tool_length_say_where_the_machine_is(tmp_path):
    """EXX = 0.1 um/mm at 300 mm of the machine is 30 um; EBZ = 100 urad turns a tool of 100 + 50 mm by -15 um in X.

    The tool offset of the machine file, 50 mm too, is that of a program without a tool length.
    """
    ends = np.array([-400.0, 200.0])
    errors = shift(slope=0.1).replace(
        curves={**shift(slope=0.1).curves, "EBZ": Curve(ends, np.full(2, 100e-6), np.zeros(2))}
    )
    setup = Setup({"G55": (290.0, 0.0, -150.0)}, {"7": (0.0, 0.0, 100.0)}, gauge_mm=(0.0, 0.0, -50.0))
    text = "G21 G90 G17 G55\nG0 X0. Y0.\nG43 H7 Z60.\nG1 X10. F100\nG49\nG0 Z60.\nG1 X9. F100\nM2\n"
    _, corrected = run(tmp_path, text, errors, setup=setup)
    first, second = (float(x) for x in re.findall(r"G1 X([\d.]+)", corrected))
    assert first == pytest.approx(10.0 - 0.030 + 0.015, abs=1e-5)
    assert second == pytest.approx(9.0 - 0.0299 + 0.005, abs=1e-5)


def test_no_word_is_added_for_an_axis_that_the_program_has_not_placed(tmp_path):
    """At the reference point, after another work offset, or with another tool, Z at the control may not be what is assumed."""
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable(
        {"EZX": Curve(ends, 1e-4 * ends, np.zeros(2)), "EXX": Curve(ends, np.full(2, 0.01), np.zeros(2))}
    )
    text = """G21 G90 G17 G54
G0 X10. Y0. Z5.
G0 X90.
G91 G28 Z0.
G90 G0 X10.
X200.
G43 H1
X300.
Z5.
X10.
G55
X20.
Z3.
X200.
M2
"""
    setup = Setup({"G54": (0.0, 0.0, -100.0), "G55": (0.0, 0.0, -90.0)}, {"1": (0.0, 0.0, 7.0)})
    _, corrected = run(tmp_path, text, errors, setup=setup)
    words = [re.sub(r"-?[\d.]+", "", line) for line in corrected.splitlines()[-14:-1]]
    assert "|".join(words).replace(" ", "") == "GXYZ|GXZ|GGZ|GGX|X|GH|X|Z|XZ|G|X|Z|XZ"


def test_a_reversal_is_taken_up_at_once(tmp_path):
    """Backlash of 20 um in X, with the mean of both directions in the curves: -10 um going up, +10 um going down."""
    reversal = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-20e-3]), np.zeros(1))})
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG1 X10. F100\nX20.\nX5.\nX1.\nM2\n"
    setup = Setup({"G54": (0.0, 0.0, 0.0)})
    result, corrected = run(tmp_path, text, ErrorTable(), setup=setup, reversal=reversal)
    ends = [float(x) for x in re.findall(r"^(?:G1 )?X([\d.]+)", corrected, re.MULTILINE)]
    assert ends == pytest.approx([10.01, 20.01, 19.89, 4.99, 0.99])
    assert result.after.ends_mm < 1e-9 < 9e-3 < result.before.ends_mm


def test_the_correction_of_a_few_um_within_an_arc_reverses_nothing(tmp_path):
    """Z went down before: EZX changes its command along the arc, but the axis stays on the side that it came from."""
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EZX": Curve(ends, 3e-4 * ends, np.zeros(2))})
    reversal = ReversalCurves({(k, k): Curve(np.zeros(1), np.array([-10e-3]), np.zeros(1)) for k in (0, 2)})
    text = "G21 G90 G17 G54\nG0 X20. Y0. Z5.\nG1 Z-5. F100\nG3 X12. Y16. I-20. J0.\nG3 X-20. Y0. I-12. J-16.\nM2\n"
    setup = Setup({"G54": (0.0, 0.0, 0.0)})
    result, _ = run(tmp_path, text, errors, setup=setup, reversal=reversal)
    assert result.after.ends_mm < 1e-4 < 9e-3 < result.before.ends_mm
    assert result.after.normal_rms_mm < 1.5e-3


def test_an_arc_that_passes_a_reversal_just_before_its_end_is_followed(tmp_path):
    """X turns at the top of the arc, 0.3 um before its end: too little for a piece of its own."""
    reversal = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-10e-3]), np.zeros(1))})
    text = "%\nO1\nG21 G90 G17 G54\nG0 X5. Y0. Z0.\nG3 X-0.0003 Y5. I-5. J0. F100\nG1 X-9.\nM30\n%\n"
    result, _ = run(tmp_path, text, ErrorTable(), "fanuc", PLAIN, reversal=reversal)
    assert result.accepted


@pytest.mark.parametrize("dialect", ["fanuc", "siemens", "linuxcnc", "grbl"])
def test_circles_of_a_machine_with_much_backlash_are_corrected(tmp_path, dialect):
    """0.2 mm in X and Y: each quadrant begins with a short arc that takes it up, which the reader of the dialect accepts."""
    reversal = ReversalCurves({(k, k): Curve(np.zeros(1), np.array([-0.2]), np.zeros(1)) for k in (0, 1)})
    unit = "G71" if dialect == "siemens" else "G21"
    arcs = "G1 X20. F100\nG3 I-20. J0.\nG2 X0. Y-20. I-20. J0.\nG3 X-1. Y-19. I0. J1.\nG2 X1. Y-17. I2. J0.\n"
    text = f"{unit} G90 G17 G54\nG0 X0. Y0. Z0.\n{arcs}M30\n"
    result, _ = run(tmp_path, text, ErrorTable(), dialect, PLAIN, reversal=reversal)
    assert result.accepted, result.reasons
    assert result.after.ends_mm < 1.5e-3 < 0.09 < result.before.ends_mm
    assert result.after.normal_mm < 4e-3 < 0.05 < result.before.normal_mm


# --- structure -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_without_errors_a_program_stays_the_same_byte_for_byte(tmp_path, seed):
    text = random_program(seed).replace("\n", "\r\n" if seed % 2 else "\n")
    result, corrected = run(tmp_path, text, shift())
    assert corrected == text
    assert result.accepted
    assert result.counts["changed_blocks"] == 0


@pytest.mark.parametrize("dialect", G_CODE)
@pytest.mark.parametrize("seed", range(3))
def test_blocks_read_together_give_what_single_blocks_give(tmp_path, seed, dialect, make_errors, monkeypatch):
    """However blocks are read and written, and whatever the size of the batches, the same bytes and figures come out."""
    text = mixed_program(seed, dialect)
    errors = make_errors(mill(), seed, (300e-6, 200e-6, 100e-6))
    setup, found = Setup({**OFFSETS_MM, "PRESET": (1.5, 2.5, -60.0)}), []
    for least, size in ((12, 1 << 20), (1, 1 << 20), (10**9, 1 << 20), (3, 700)):
        monkeypatch.setattr("compgen.programs.reader.LEAST_RUN", least)
        monkeypatch.setattr("compgen.programs.reader.BATCH_BYTES", size)
        result, corrected = run(tmp_path, text, errors, dialect, setup)
        figures = [
            {name: round(value, 6) for name, value in part.as_dict().items()} for part in (result.before, result.after)
        ]
        found.append((corrected, figures, result.counts))
    assert found[1:] == found[:1] * 3
    assert result.counts["added_blocks"] > 0
    assert result.accepted


def test_line_ends_comments_numbers_and_signs_stay(tmp_path):
    text = "%\r\nO12 (Stück 4)\r\n/N5 M8\r\nG21 G90 G17 G54\r\nN10 G0X+10.Y0.Z5.(über)\r\nN20 G1 Z-1. F100 M9\r\n\r\nM30\r\n%\r\n"
    _, corrected = run(tmp_path, text, shift(x=10.0), "fanuc", PLAIN)
    assert body(corrected).replace("X+9.99", "X+10.") == text
    assert "\n" not in corrected.replace("\r\n", "")


def test_a_long_move_is_divided_where_the_correction_bends(tmp_path):
    """A kink of 40 um in the middle of 400 mm: two pieces; M9 and the comment act where they acted."""
    nodes = np.array([-600.0, 0.0, 600.0])
    errors = ErrorTable({"EYX": Curve(nodes, np.array([0.0, 40e-3, 0.0]), np.zeros(3))})
    text = "G21 G90 G17 G54\nG0 X-200. Y0. Z0.\nN5 G1 X200. F100 M9 (side)\nM2\n"
    result, corrected = run(tmp_path, text, errors, setup=PLAIN)
    first, second = corrected.splitlines()[-3:-1]
    assert re.fullmatch(r"N5 G1 X-?0\.[0-9]* Y-0\.0[34]\d+ F100  \(side\)|N5 G1 X\S+ Y-0\.\d+ F100 .*\(side\)", first)
    assert re.fullmatch(r"X200\.? ?Y-0\.02667 M9|Y-0\.02667 M9|X200\.0+ Y-0\.02667 M9", second), second
    assert result.counts["added_blocks"] == 1
    assert result.after.normal_mm < 1.1e-3
    inverse = text.replace("N5 G1", "N5 G93 G1").replace("F100", "F2")
    _, corrected = run(tmp_path, inverse, errors, setup=PLAIN)
    rates = [float(rate) for rate in re.findall(r"F([\d.]+)", corrected)]
    assert sum(1 / rate for rate in rates) == pytest.approx(1 / 2, rel=1e-5)  # the time of the block


def test_what_acts_at_the_end_of_a_divided_block_goes_before_the_asterisk(tmp_path):
    ends = np.array([-600.0, 0.0, 600.0])
    bent = ErrorTable({"EYX": Curve(ends, np.array([0.0, 40e-3, 0.0]), np.zeros(3))})
    text = "%A G71 *\nG00 G90 X-200 Y+0 Z+0*\nG01 X+200 F100 M9*\nN9 %A G71 *\n"
    _, corrected = run(tmp_path, text, bent, "heidenhain-iso", PLAIN)
    assert re.search(r"F100 *\*\nX\+200\.? Y-0\.0267 M9 \*\nN9|F100 *\*\nY-0\.0267 M9 \*\nN9", corrected), corrected


def test_arcs_stay_arcs(tmp_path):
    """A scale error makes ellipses: pieces of circles within the tolerance, none of them straight."""
    text = "G21 G90 G17 G54\nG0 X50. Y0. Z0.\nG3 I-50. F100\nG2 X50. Y20. R10.\nG3 X-50. Y20. R-50.\nM2\n"
    result, corrected = run(tmp_path, text, shift(slope=0.2), setup=PLAIN)
    assert result.after.normal_mm < 1.1e-3 < 9e-3 < result.before.normal_mm
    assert re.findall(r"\bG[01]\b", corrected) == ["G0"]
    assert 4 <= result.counts["added_blocks"] <= 20


@pytest.mark.parametrize(("dialect", "turns"), [("linuxcnc", "P4"), ("siemens", "TURN=3")])
def test_a_divided_helix_keeps_its_turns(tmp_path, dialect, turns):
    """From (10, 0) to (0, 10) counterclockwise with three full turns more: 3.25 turns in all."""
    ends, middle = np.array([-9.0, 0.0, 9.0]), 20e-3
    bend = ErrorTable({"EXZ": Curve(ends, np.array([0.0, middle, 0.0]), np.zeros(3))})
    text = f"G54 G71 G90 G17\nG0 X10 Y0 Z-9\nG3 X0 Y10 Z9 I-10 J0 {turns} F100\nM30\n"
    text = text.replace("G71", "G21") if dialect == "linuxcnc" else text
    result, written = run(tmp_path, text, bend, dialect, PLAIN)
    pieces = moves_of(written[written.index("G54 G") :], dialect, PLAIN)
    assert result.accepted
    assert len(pieces) > 2
    assert pieces.sweep_rad.sum() == pytest.approx(3.25 * 2.0 * np.pi, abs=1e-3)


def test_the_radius_of_siemens_keeps_its_equals_sign_in_divided_arcs(tmp_path):
    text = "G71 G90 G17 G54\nG0 X50 Y20 Z0\nG1 F100 Z-1\nG3 X-50 Y20 CR=-53\nM30\n"
    result, corrected = run(tmp_path, text, shift(slope=0.2), "siemens", PLAIN)
    assert result.after.normal_mm < 1.1e-3 < 9e-3 < result.before.normal_mm
    assert corrected.count("CR=") == 1 + result.counts["added_blocks"] > 3
    assert "CR" not in corrected[corrected.index("G3") :].replace("CR=", "")


def test_only_some_axes(tmp_path):
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG1 X10. Y10. Z10. F100\nM2\n"
    _, corrected = run(tmp_path, text, shift(10.0, 20.0, 30.0), setup=PLAIN, only="X,Z")
    assert "G1 X9.99 Y10. Z9.97 F100" in corrected


def test_incremental_moves_do_not_add_up_their_rounding(tmp_path):
    """A scale of 1 um in 10 mm, steps of 1 mm with three decimals: each would be rounded to 1 mm."""
    steps = "X1.\n" * 200
    text = f"%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z0.\nG91 G1 F100\n{steps}G90\nM30\n%\n"
    result, corrected = run(tmp_path, text, shift(slope=0.1), "fanuc", PLAIN)
    total = sum(float(x) for x in re.findall(r"^X([\d.]+)", corrected, re.MULTILINE))
    assert total == pytest.approx(200 - 0.020, abs=0.6e-3)
    assert result.after.largest_mm < 0.6e-3


def test_a_hole_is_drilled_to_its_depth_where_the_correction_bends_on_the_way(tmp_path):
    """The slope of EZZ changes at Z = 0, within the stroke from the R level 5 to the depth -20: EZZ is 0.1 mm there."""
    bent = ErrorTable({"EZZ": Curve(np.array([-20.0, 0.0, 600.0]), np.array([0.1, 0.0, 0.0]), np.zeros(3))})
    text = "%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z9.\nG98 G81 X10. Z-20. R5. F90\nX20.\nG80\nM30\n%\n"
    result, corrected = run(tmp_path, text, bent, "fanuc", PLAIN)
    assert "G98 G81 X10. Z-20.1 R5. F90\nX20.\nG80" in corrected
    assert result.accepted


def test_what_a_cycle_cannot_bend_is_said_with_its_line(tmp_path):
    """EXZ is 1 um/mm: a hole 25 mm deep is right in X at its depth, and 25 um off at the R level."""
    ends = np.array([-400.0, 200.0])
    errors = ErrorTable({"EXZ": Curve(ends, 1e-3 * ends, np.zeros(2))})
    text = "%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z9.\nG1 X1. F90\nG98 G81 X10. Z-40. R-15. F90\nG80\nM30\n%\n"
    result, _ = run(tmp_path, text, errors, "fanuc", PLAIN)
    assert (
        0.02 < result.after.normal_mm <= 0.025 and result.after.normal_line == 6
    )  # the first sample is below the R level
    assert result.accepted and result.notes == (
        "line 6: a drilling cycle has one X and Y, here those that are right at its depth; the stroke above is up to "
        f"{1e3 * result.after.normal_mm:.2f} um from the axis of the hole",
    )
    assert "- [ ] Line 6: a drilling cycle" in (tmp_path / "out" / "preflight.md").read_text()


def test_the_end_of_a_peck_is_none_of_the_part(tmp_path):
    """EZZ is 1 um/mm: the pecks of LinuxCNC end up to 28 um beside those of the program, the hole does not."""
    ends = np.array([-400.0, 200.0])
    errors = ErrorTable({"EZZ": Curve(ends, 1e-3 * ends, np.zeros(2))})
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z9.\nG98 G83 X10. Z-28. R5. Q5. F90\nX20.\nG80\nM2\n"
    result, _ = run(tmp_path, text, errors, setup=PLAIN, decimals=4)
    assert result.accepted and result.after.worst_mm < 1e-3 < 0.02 < result.before.worst_mm


@pytest.mark.parametrize(
    ("slope", "depth", "peck"), [(-4e-4, "-15.", "Q5.0021"), (-4e-4, "-15.01", "Q5."), (4e-4, "-15.004", "Q4.9989")]
)
def test_a_hole_has_as_many_pecks_as_before(tmp_path, slope, depth, peck):
    """EZZ makes 20 mm in four pecks of 5 mm 20.008 mm: a fifth would be one of 8 um; 20.004 mm in five become 19.996."""
    ends = np.array([-400.0, 200.0])
    errors = ErrorTable({"EZZ": Curve(ends, slope * ends, np.zeros(2))})
    text = f"G21 G90 G17 G54\nG0 X0. Y0. Z9.\nG98 G83 X10. Z{depth} R5. Q5. F90\nX20.\nG80\nM2\n"
    result, corrected = run(tmp_path, text, errors, setup=PLAIN, decimals=4)
    assert f" {peck} F90\nX20.\n" in corrected
    assert result.accepted


def test_the_r_level_of_a_hole_is_corrected_where_it_is(tmp_path):
    """EZZ is 1 um/mm of Z: 5 um at the R level 5, -20 um at the depth; two depths, one R level."""
    ends = np.array([-400.0, 200.0])
    errors = ErrorTable({"EZZ": Curve(ends, 1e-3 * ends, np.zeros(2))})
    text = "%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z9.\nG99 G81 X10. Z-20. R5. F90\nX20.\nX30. Z-10.\nG80\nM30\n%\n"
    result, corrected = run(tmp_path, text, errors, "fanuc", PLAIN)
    assert "G99 G81 X10. Z-19.98 R4.995 F90\nX20.\nX30. Z-9.99\nG80" in corrected
    assert result.after.largest_mm < 1e-3 < result.before.largest_mm


def test_inverse_time_needs_its_feed_and_rapids_alone_cannot_be_judged(tmp_path):
    with pytest.raises(InputError, match="G93") as caught:
        run(tmp_path, START + "G93 G1 X5. F2\nX9.\nM2\n", shift(x=10.0), setup=PLAIN)
    assert caught.value.line == 4
    result, _ = run(tmp_path, START + "G0 X5.\nM2\n", shift(x=10.0), setup=PLAIN)
    assert result.reasons == ("the program has no moves at feed, so that nothing can be judged",)


def test_positions_beyond_the_curves_are_warned_of(tmp_path):
    short = ErrorTable({"EXX": Curve(np.array([-50.0, 50.0]), np.array([0.01, 0.02]), np.zeros(2))})
    with pytest.warns(
        compgen.CompgenWarning, match="EXX is known from -50 to 50 mm, but positions range from 0 to 70 mm"
    ):
        run(tmp_path, START + "G1 X70. F9\nM2\n", short, setup=PLAIN)


def test_inches(tmp_path):
    text = "G20 G90 G17 G54\nG0 X0. Y0. Z0.\nG1 X1. F4\nM2\n"
    _, corrected = run(tmp_path, text, shift(x=25.4), setup=PLAIN)
    assert "G1 X0.999 F4" in corrected


# --- dialects: golden programs, the errors are 10 um in X and -20 um in Y ----------------------------------------------

GOLDEN = {
    "siemens": (
        '%_N_PART_MPF\n;$PATH=/_N_WKS_DIR\nN10 G17 G71 G90 G54 ; start\nN20 T1 D1\nN30 MSG("side")\nN40 G0 X10 Y20 Z5\n'
        "N50 G1 Z-2 F200\nN60 G2 X20 Y30 CR=10\nN70 G3 X=30 Y=20 I0 J-10\nN75 G2 X30 Y20 Z-3 I5 J0 TURN=1\n"
        "N80 SUPA G0 Z0 D0\nN90 M30\n",
        "N40 G0 X9.99 Y20.02 Z5\nN50 G1 Z-2 F200\nN60 G2 X19.99 Y30.02 CR=10\nN70 G3 X=29.99 Y=20.02 I0 J-10\n"
        "N75 G2 X29.99 Y20.02 Z-3 I5 J0 TURN=1\nN80 SUPA G0 Z0 D0\nN90 M30\n",
    ),
    "heidenhain-iso": (
        "%PART G71 *\nN10 G30 G17 X+0 Y+0 Z-40*\nN20 G31 G90 X+100 Y+100 Z+0*\nN30 T1 G17 S3000*\nN40 G00 G40 G90 Z+50*\n"
        "N50 X+10 Y+20 M3*\nN60 G01 Z-2 F200*\nN70 I+20 J+20*\nN80 G02 X+30 Y+20*\nN90 G03 X+50 Y+20 I+40 J+20*\n"
        "N100 G00 Z+50 M2*\nN99999999 %PART G71 *\n",
        "N50 X+9.99 Y+20.02 M3*\nN60 G01 Z-2 F200*\nN70 I+20 J+20*\nN80 G02 X+29.99 Y+20.02 I+19.99 J+20.02*\n"
        "N90 G03 X+49.99 Y+20.02 I+39.99 J+20.02*\nN100 G00 Z+50 M2*\nN99999999 %PART G71 *\n",
    ),
    "grbl": (
        "(made by CAM)\nG21\nG90 G17 G54\nG0 X10 Y20 Z5 ; go\nM3 S1000\nG1 Z-2 F200\nG2 X20 Y30 I10 J0\n"
        "X30 Y20 R10\nG91\nG1 X1\nG90\nG53 G0 Z0\nM5\n",
        "G0 X9.99 Y20.02 Z5 ; go\nM3 S1000\nG1 Z-2 F200\nG2 X19.99 Y30.02 I10 J0\nX29.99 Y20.02 R10\nG91\nG1 X1\n"
        "G90\nG53 G0 Z0\nM5\n",
    ),
    "fanuc": (
        "%\nO0001(PART)\nN1 G21 G17 G40 G80 G90\nN2 T1 M6\nN3 G0 G54 X10. Y20. S1000 M3\nN4 G43 H1 Z5. M8\n"
        "N5 G98 G81 Z-3. R2. F90\n"
        "N6 X30.\nN7 Y40. Z-4.\nN8 G80\nN9 G91 G28 Z0.\nN10 G90\nN11 M30\n%\n",
        "N3 G0 G54 X9.99 Y20.02 S1000 M3\nN4 G43 H1 Z5. M8\nN5 G98 G81 Z-3. R2. F90\nN6 X29.99\nN7 Y40.02 Z-4.\nN8 G80\n"
        "N9 G91 G28 Z0.\nN10 G90\nN11 M30\n%\n",
    ),
}


@pytest.mark.parametrize("dialect", GOLDEN)
def test_golden_programs_of_the_dialects(tmp_path, dialect):
    text, expected = GOLDEN[dialect]
    result, corrected = run(tmp_path, text, shift(x=10.0, y=-20.0), dialect, PLAIN)
    assert corrected.endswith(expected)
    assert corrected.startswith(text.splitlines()[0]) or dialect == "grbl"
    assert result.after.largest_mm < 1e-9
    unchanged, same = run(tmp_path, text, shift(), dialect, PLAIN)
    assert (same, unchanged.accepted) == (text, True)


def test_siemens_and_linuxcnc_stop_where_the_work_offset_is_another(tmp_path):
    setup = Setup({"G55": (1.5, -2.0, -3.25)})
    _, corrected = run(tmp_path, "G71 G90 G55\nG0 X0 Y0 Z0\nG1 X9 F9\nM30\n", shift(x=5.0), "siemens", setup)
    assert "IF ABS($P_UIFR[2,Y,TR]-(-2.0000))<=0.001 GOTOF VC9002\nMSG(" in corrected
    assert re.search(r"MSG\(.*\)\nM30\nVC9002:\n", corrected)


# --- what is refused -------------------------------------------------------------------------------------------------

START = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\n"
REFUSED = [
    ("grbl", "G21 G90\nG0 X0 Y0 Z0\nG41 D1\n", 3, "cutter radius compensation"),
    ("linuxcnc", START + "#1=#5420\nM2\n", 3, "#5420 is not known before the program runs: variables"),
    ("linuxcnc", START + "G1 X[1+#2] F9\nM2\n", 3, "variables and expressions"),
    ("linuxcnc", START + "o100 call\nM2\n", 3, "subprograms"),
    ("fanuc", START + "M98 P1000\nM30\n", 3, "subprograms"),
    ("fanuc", START + "G65 P9810 X1.\nM30\n", 3, "subprograms and macros"),
    ("fanuc", START + "G68.2 X0. Y0. Z0. I30. J0. K0.\nM30\n", 3, "turned"),
    ("fanuc", START + "G5 P2\nM30\n", 3, "G5 is followed with P0 or P10000 only"),
    ("fanuc", START + "WHILE[#1LT5]DO1\nM30\n", 3, "#1 is not known"),
    ("fanuc", START + "G1 X10 F100\nM30\n", 3, "decimal point"),
    ("fanuc", START + "G1 X1. A30. F100\nM30\n", 3, "turn while the tool cuts"),
    ("fanuc", START + "G0 A0.\nG0 B90.\nG0 X5. A90.\nM30\n", 5, "the rotary axis turns, from 0"),
    ("fanuc", START + "G1 X1. U2. F100\nM30\n", 3, "further axes"),
    ("fanuc", START + "G1 X5.,R2. F100\nM30\n", 3, "chamfers and roundings"),
    ("fanuc", START + "G1 X5. F100; X6.\nM30\n", 3, "; ends a block"),
    ("fanuc", START + "G12 I5. F100\nM30\n", 3, "milling cycles"),
    ("fanuc", START + "G37 Z-5. F100\nM30\n", 3, "where a probe stops"),
    ("fanuc", START + "G91 G52 X5.\nM30\n", 3, "incremental blocks"),
    ("fanuc", START + "G90 G1 X5. G91 Y5. F1\nM30\n", 3, "G90 and G91"),
    ("fanuc", START + "G187 P1 G1 X5. F1\nM30\n", 3, "divide the block"),
    ("fanuc", START + "G30 Z0.\nG1 X5. Z5. F1\nM30\n", 4, "the position of Z is not known"),
    ("fanuc", START + "G33.7\nM30\n", 3, "is not known"),
    ("fanuc", START + "M123\nM30\n", 3, "--keep-unknown M123"),
    ("fanuc", START + "G1 X1. X2. F1\nM30\n", 3, "twice"),
    ("fanuc", START + "G43 H9 Z1.\nM30\n", 3, "tool 9 is not known"),
    ("fanuc", START + "G56\nM30\n", 3, "--wcs G56=X,Y,Z"),
    ("fanuc", START + "G1 X9000. F1\nM30\n", 3, "outside its travel"),
    ("fanuc", START + "G2 X5. Y5. F1\nM30\n", 3, "without centre or radius"),
    ("fanuc", START + "G2 X5. Y5. I3. J0. F1\nM30\n", 3, "from its centre"),
    ("fanuc", START + "G2 X5. R1. F1\nM30\n", 3, "give no arc"),
    ("fanuc", "G21 G90 G54\nG1 X5. F1\nM30\n", 2, "is not known"),
    ("fanuc", "G21 G90 G54\nX5.\nM30\n", 2, "before any of G0"),
    ("fanuc", "G21 G91 G54\nG0 X5.\nM30\n", 2, "increment"),
    ("fanuc", START + "M30\nO2\nG1 X1. F1\nM99\n", 4, "second program"),
    ("fanuc", "%\n" + START + "G1 X1. F1\n%\nX2.\nM30\n%\n", 6, "after the closing %"),
    ("linuxcnc", "%\n" + START + "G1 X1. F1\n%\nX2.\nM2\n", 6, "after the closing %"),
    ("fanuc", "%\nO1\n" + START + "G1 X1. F1\n", 5, "may have been cut"),
    ("fanuc", "%\nO1\n" + START + "G1 X1. F1\nM30\n", 6, "does not end with it"),
    ("linuxcnc", START + "G1 X1. F1\n", 3, "may have been cut"),
    ("linuxcnc", START + "G1 X1. Y2", 3, "may have been cut|X and Z"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nCYCLE999(5)\nM30\n", 3, "CYCLE999 is not known"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nG2 X5 Y5 CR5\nM30\n", 3, "CR5"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nR1=R9+5\nM30\n", 3, "R9 is not known before the program runs: variables"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nX=DC(5)\nM30\n", 3, "rotary axes; expected AC or IC"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nX=R5+1\nM30\n", 3, "variables"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nG58 X5\nM30\n", 3, "TRANS and ATRANS"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nROT X30\nM30\n", 3, "turned"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nAROT Y30\nM30\n", 3, "turned"),
    ("siemens", 'G71 G90 G54\nG0 X0 Y0 Z0\nCYCLE800(4,"TC1",200000,57,0,0,0,90,0)\nM30\n', 3, "turned plane"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nCIP X5 Y5 I1=3 J1=4\nM30\n", 3, "arcs through a point"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nG1 X5 RND=2\nM30\n", 3, "chamfers and roundings"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nIF R1==1 GOTOF END\nM30\n", 3, "conditions and loops"),
    (
        "siemens",
        "G71 G90 G54\nG0 X0 Y0 Z0\nDEF REAL A=B\nM30\n",
        3,
        "B is not known before the program runs: variables",
    ),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nPOCKET4(10,0,2)\nM30\n", 3, "milling cycles"),
    ("siemens", "G71 G90 G54\nG0 X0 Y0 Z0\nX1=5\nM30\n", 3, "machine axes"),
    ("siemens", "%_N_A_MPF\nG71 G90 G54\nG0 X0 Y0 Z0\n%_N_B_SPF\nM17\n", 4, "second program"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG53 P01 3*\nN9 %A G71 *\n", 3, "datums of a table"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nL1,2*\nN9 %A G71 *\n", 3, "without calls"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG01 X+Q5 F9*\nN9 %A G71 *\n", 3, "variables"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG25 R5*\nN9 %A G71 *\n", 3, "chamfers"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG05 X+5*\nN9 %A G71 *\n", 3, "last arc"),
    ("heidenhain-iso", "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG12 H+90*\nN9 %A G71 *\n", 3, "G12"),
    ("grbl", "G21 G90\nG0 X0 Y0 Z0\nG38.2 Z-5 F9\nG1 X5\n", 4, "position of Z is not known"),
    ("grbl", "G21 G90\nG0 X0 Y0 Z0\n$H\n", 3, "command for the control"),
    ("grbl", "G21 G90\nG10 L20 P9 X0\n", 2, "set them at the control"),
    ("linuxcnc", START + "M73\nM2\n", 3, "modal states"),
    ("linuxcnc", START + "G92.3\nM2\n", 3, "another program"),
    ("linuxcnc", START + "G7\nM2\n", 3, "turning"),
    ("linuxcnc", START + "X#<_x>\nM2\n", 3, "variables"),
    ("linuxcnc", "", 1, "no moves"),
    ("linuxcnc", "\xef\xbb\xbf" + START + "M2\n", 1, "byte-order mark"),
    ("linuxcnc", START + "G1 X1\x00 F1\nM2\n", 3, "control character 0x00"),
    ("linuxcnc", START + "G1 X1 F1\rG1 X2\nM2\n", 3, "carriage return"),
    ("linuxcnc", START + "G1 X1 F1 \xfcber\nM2\n", 3, "cannot be read"),
    ("linuxcnc", START + "G1 X1 F1 (open\nM2\n", 3, "cannot be read"),
    ("linuxcnc", START + "X" + "1" * 6_000 + "\nM2\n", 3, "longer than"),
    ("linuxcnc", "G1X1.5" * 3_500_000, 1, "longer than"),
    ("linuxcnc", "(CORRECTED BY VOLCOMP 1 FOR MACHINE a)\n" + START + "M2\n", 1, "corrected before"),
]


@pytest.mark.parametrize(
    ("dialect", "text", "line", "words"), REFUSED, ids=[f"{r[0]}-{r[3][:24]}-{i}" for i, r in enumerate(REFUSED)]
)
def test_what_cannot_be_followed_is_refused_with_its_line(tmp_path, listing, dialect, text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        run(tmp_path, text, shift(x=10.0), dialect, Setup({"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}))
    assert caught.value.line == line
    assert not (tmp_path / "out").exists()
    assert len(caught.value.message) < 400


def test_codes_that_move_nothing_can_be_kept(tmp_path):
    text = "%\nO1\n" + START + "G5.1 Q1\nM123\nG187 X5. (not a move)\nG1 X1. F1\nM30\n%\n"
    setup = Setup({"G54": (0.0, 0.0, 0.0)}, keep_unknown=frozenset({"G5.1", "M123", "G187"}))
    _, corrected = run(tmp_path, text, shift(x=10.0), "fanuc", setup)
    assert corrected.endswith("G5.1 Q1\nM123\nG187 X5. (not a move)\nG1 X0.99 F1\nM30\n%\n")
    with pytest.raises(InputError, match="ambiguous"):
        run(tmp_path, text.replace("G187", "G1 G187"), shift(x=10.0), "fanuc", setup)


@pytest.mark.parametrize(
    ("dialect", "block", "code", "words"),
    [
        ("fanuc", "G320 X5.", "G320", "may move the machine"),
        ("fanuc", "G81.5 X5.", "g81.5", "may move the machine"),
        ("fanuc", "M98 P99", "M0098", "subprograms"),
        ("fanuc", "M96 P99", "M96", "jumps"),
        ("fanuc", "G54", "G54", "it is followed"),
        ("fanuc", "G65 P1", "G65", "subprograms"),
        ("fanuc", "WHILE", "WHILE", "may move the machine or call"),
        ("siemens", "G810", "G810", "may move the machine"),
        ("siemens", "SUB1", "SUB1", "may move the machine or call"),
        ("siemens", "CYCLE999(5)", "CYCLE999", "may move the machine or call"),
        ("siemens", "GOTOF A", "GOTOF", "loops"),
        ("linuxcnc", "G84 X5 Z-5 R2", "G84", "may move the machine"),
        ("linuxcnc", "M70", "M70", "modal states"),
        ("heidenhain-iso", "G901", "G901", "may move the machine"),
        ("heidenhain-iso", "M91", "M91", "it is followed"),
        ("heidenhain-iso", "M140", "M140", "goes back"),
        ("grbl", "G38.2 Z-5", "G38.2", "it is followed"),
        ("grbl", "M0.5", "M0.5", "may move"),
        ("grbl", "X", "", "may move"),
    ],
)
def test_what_may_move_or_call_is_neither_kept_nor_offered_to_be(tmp_path, dialect, block, code, words):
    unit = {"siemens": "G71", "heidenhain-iso": ""}.get(dialect, "G21")
    text = f"{unit} G90 G17\nG0 X0. Y0. Z0.\n{block}\nG1 X9. F9\nM30\n"
    offsets = {"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}
    with pytest.raises(InputError, match=words) as caught:
        run(tmp_path, text, shift(x=10.0), dialect, Setup(offsets, keep_unknown=frozenset({code})))
    assert caught.value.field == "--keep-unknown"
    if code not in ("G54", "M91", ""):
        with pytest.raises(InputError) as caught:
            run(tmp_path, text, shift(x=10.0), dialect, Setup(offsets))
        assert "--keep-unknown" not in caught.value.message


def test_skipped_blocks_stay(tmp_path):
    text = START + "/G1 X5. F1\nG1 X7. F1\nM2\n"
    setup = Setup({"G54": (0.0, 0.0, 0.0)}, skip_deleted=True)
    assert "/G1 X5. F1\nG1 X6.99 F1" in run(tmp_path, text, shift(x=10.0), setup=setup)[1]
    assert "/G1 X4.99 F1\nG1 X6.99 F1" in run(tmp_path, text, shift(x=10.0), setup=PLAIN)[1]


def test_tool_tables(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("tool,length_mm,x_mm\n01,101.5,0\nMILL,50,0.25\n")
    assert {key: tuple(value) for key, value in read_tools(table).items()} == {
        "1": (0.0, 0.0, 101.5),
        "MILL": (0.25, 0.0, 50.0),
    }
    native = tmp_path / "tool.tbl"
    native.write_text("; tools\nT1 P1 Z+101.5 D6 ; end mill\nT22 P3 X0.1 Z30\n")
    assert read_tools(native) == {"1": (0.0, 0.0, 101.5), "22": (0.1, 0.0, 30.0)}
    table.write_text("tool,length_mm\n1,5\n1,6\n")
    with pytest.raises(InputError, match="twice"):
        read_tools(table)


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def shop(tmp_path, small_machine_file, small_errors):
    """A folder with machine, errors, tools and a program in reach of the small machine."""
    shutil.copy(small_machine_file, tmp_path / "mill.toml")
    (tmp_path / "e.errors.csv").write_text(compgen.format_errors(small_errors))
    (tmp_path / "tools.csv").write_text("tool,length_mm\n1,20\n")
    (tmp_path / "p.nc").write_text("%\nO1\nG21 G90 G17 G54\nG43 H1\nG0 X0. Y0. Z60.\nG1 Z0. F100\nX50.\nY50.\nM30\n%\n")
    return tmp_path


def setup_of(shop):
    """What the program of the shop needs beside its text."""
    files = ["--errors", shop / "e.errors.csv", "--tools", shop / "tools.csv"]
    return [*files, "--dialect", "fanuc", "--wcs", "G54=0,0,-150"]


def test_the_command_writes_the_program_its_figures_and_what_to_check(shop, call):
    words = setup_of(shop)
    code, out, _ = call("correct", shop / "mill.toml", shop / "p.nc", *words, "--out", shop / "o")
    assert code == 0, out
    assert "before" in out
    assert {path.name for path in (shop / "o").iterdir()} == {"p.nc", "correction.json", "preflight.md"}
    assert "G54: X 0, Y 0, Z -150 mm" in (shop / "o" / "preflight.md").read_text()
    code, again, _ = call("correct", shop / "mill.toml", shop / "p.nc", *words, "--out", shop / "o", "--json")
    found = compgen.data.files.json.loads(again)
    assert found["accepted"]
    assert found["after"]["max_um"] < 1.5 < found["before"]["max_um"]
    assert found["errors"]["sha256"] == compgen.data.files.sha256_of_file(shop / "e.errors.csv")


def test_a_result_that_is_not_smaller_is_named_so(shop, call):
    """With one decimal the rounding, up to 50 um, is more than the errors."""
    words = setup_of(shop)
    text = (shop / "p.nc").read_text().replace("X50.", "X50.049")
    (shop / "p.nc").write_text(text.replace("X50.049", "X1.").replace("Y50.", "Y1."))
    code, _, error = call("correct", shop / "mill.toml", shop / "p.nc", *words, "--decimals", 1, "--out", shop / "o")
    names = {path.name for path in (shop / "o").iterdir()}
    if code == 0:
        pytest.fail("rounding to 0.1 mm was accepted")
    assert code == 1
    assert "NOT-ACCEPTED-p.nc" in names
    assert "p.nc" not in names
    assert "not acceptable" in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--wcs", "G54=1,2"], "expected e.g. G54="),
        (["--wcs", "G54=1,2,3", "--wcs", "g54=1,2,3"], "given twice"),
        (["--wcs", "G54.1 P3=1,2,3", "--wcs", "g54.1p3 =1,2,3"], "G54.1P3 is given twice"),
        (["--only", "X,Q"], "does not name axes"),
        (["--tolerance-um", "0"], "above 0"),
        (["--dialect", "mazak"], "mazak"),
        (["--tools", "none.csv"], "no such file"),
        (["--dialect", "fanuc"], "add --wcs G54="),
    ],
)
def test_wrong_usage_writes_nothing(shop, call, words, message):
    code, _, error = call(
        "correct", shop / "mill.toml", shop / "p.nc", "--errors", shop / "e.errors.csv", *words, "--out", shop / "o"
    )
    assert (code, (shop / "o").exists()) == (2, False)
    assert message in error


# --- a table that is active while the program runs ---------------------------------------------------------------------


SQUARE = "G21 G90 G54\nG0 X0 Y0 Z5\nG1 Z-10 F500\nG1 X180\nG1 Y140\nG1 X0\nG1 Y0\nG0 Z5\nM2\n"


def test_a_program_corrects_only_what_the_active_table_leaves(
    tmp_path, call, small_machine, small_machine_file, small_errors
):
    """A COMP_FILE for each joint; the exact machine with it is at the programmed corners. Without --active it would not be."""
    made = compgen.export(small_machine, small_errors, "linuxcnc-comp")
    paths = made.write(tmp_path / "comp")
    (tmp_path / "e.errors.csv").write_text(format_errors(small_errors))
    (tmp_path / "p.ngc").write_text(SQUARE)
    words = ["correct", small_machine_file, tmp_path / "p.ngc", "--errors", tmp_path / "e.errors.csv"]
    words += ["--wcs", "G54=-150,20,-100", "--gauge", "0,0,-80"]
    tables = compgen.read_tables(small_machine, paths, "linuxcnc-comp")

    def missed_um(text):
        """Distance of the tool from the corners, with the table on."""
        place = {"X": -150.0, "Y": 20.0, "Z": -95.0}
        offset, corners = {"X": -150.0, "Y": 20.0, "Z": -100.0}, []
        for line in re.sub(r"\(.*\)", "", text).splitlines():
            found = re.findall(r"([XYZ])(-?[\d.]+)", line)
            place |= {letter: float(number) + offset[letter] for letter, number in found}
            if found and not line.startswith("G0"):
                corners.append([place[letter] for letter in "XYZ"])
        commands = np.array(corners)
        added = tables.correction(small_machine, compgen.Points(commands))
        tip = commands + added + exact_error(small_machine, small_errors, commands + added)
        wanted = np.array([[x, y, -10.0] for x in (0.0, 180.0) for y in (0.0, 140.0)]) + list(offset.values())
        return [1e3 * np.linalg.norm(tip - corner, axis=1).min() for corner in wanted]

    active = [word for path in paths for word in ("--active", path)] + ["--active-controller", "linuxcnc-comp"]
    for more, most_um in ((active, 0.2), ([], None)):
        code, out, err = call(*words, *more, "--out", tmp_path / f"out{len(more)}")
        assert code == 0, (out, err)
        missed = missed_um((tmp_path / f"out{len(more)}" / "p.ngc").read_text())
        assert max(missed) < most_um if most_um else max(missed) > 5.0
    assert "ACTIVE TABLES OF LINUXCNC-COMP" in (tmp_path / f"out{len(active)}" / "p.ngc").read_text().upper()
    code, _, err = call(*words, *active[:2], "--out", tmp_path / "no")
    assert code == 2 and "--active-controller" in err


# --- radius compensation -------------------------------------------------------------------------------------------------

#: A line along Y at X 50, beside it the tool: to it, along it, away from it.
BESIDE = {
    "linuxcnc": (START + "G1 {} D1 X50. Y0. F500\nY40.\nG40 X60. Y50.\nM2\n", "G41", "G42"),
    "fanuc": (START + "G1 {} D1 X50. Y0. F500\nY40.\nG40 X60. Y50.\nM30\n", "G41", "G42"),
    "siemens": ("G71 G90 G54\nG0 X0 Y0 Z0\nG1 {} X50 Y0 F500\nY40\nG40 X60 Y50\nM30\n", "G41", "G42"),
    "heidenhain-iso": (
        "%A G71 *\nG00 G90 X+0 Y+0 Z+0*\nG01 {} X+50 Y+0 F500*\nY+40*\nG40 X+60 Y+50*\nN9 %A G71 *\n", "G41", "G42",
    ),
    "heidenhain-klartext": (
        "BEGIN PGM P MM\nTOOL CALL 1 Z S900\nL X+0 Y+0 Z+0 R0 FMAX\nL X+50 Y+0 {} F500\nL Y+40\nL X+60 Y+50 R0\n"
        "M30\nEND PGM P MM\n", "RL", "RR",
    ),
}  # fmt: skip


@pytest.mark.parametrize("radius_mm", [0.0, 5.0])
@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("dialect", BESIDE)
def test_a_contour_is_corrected_where_the_tool_is(tmp_path, dialect, left, radius_mm):
    """By hand: X is 1 um/mm too long, the tool at 45 (left) or 55 mm (right): command 45 / 1.001, contour 5 mm beside.

    With the radius 0 (the path of the tool centre, wear alone) the tool is at 50 mm on both sides.
    """
    text, *sides = BESIDE[dialect]
    word = sides[0 if left else 1]
    setup = replace(PLAIN, stated_radii_mm={"": radius_mm})
    result, found = run(tmp_path, text.replace("{}", word), shift(slope=1.0), dialect, setup)
    assert result.accepted, result.reasons
    aside = -radius_mm if left else radius_mm
    contour = (50.0 + aside) / 1.001 - aside
    block = next(
        line for line in found.splitlines() if re.search(rf"\b{word}\b", line) and "X" in line and "(" not in line
    )
    assert abs(float(re.search(r"X=?([-+.\d]+)", block)[1]) - contour) < 6e-4, block
    leaves = next(
        line for line in found.splitlines() if re.search(r"Y=?\+?50", line) and re.search(r"\b(G40|R0)\b", line)
    )
    assert abs(float(re.search(r"X=?([-+.\d]+)", leaves)[1]) - 60.0 / 1.001) < 6e-4, leaves
    assert result.after.largest_mm < 0.02 * result.before.largest_mm


ENTRY_LINE = "G1 G41 D1 X0. Y10. F500\n"
NO_PATH = [
    (ENTRY_LINE + "Y40.\nG3 X-6. Y40. I-3. J0.\nG1 Y0.\nG40 X-20.\n", 5, "too large for the inner side of the arc"),
    (ENTRY_LINE + "Y40.\nX-4.\nY10.\nG40 X-20.\n", 5, "nothing is left of the move"),
    (ENTRY_LINE + "Y40.\nY10.\nG40 X-20.\n", 5, "goes back on itself"),
    ("G41 D1\nG3 X20. Y0. I10. J0. F500\nG1 Y9.\nG40 X40.\n", 4, "begins or ends on an arc"),
    (ENTRY_LINE + "Y40.\nG42 D1 X-30.\nG40 X-40.\n", 5, "while G41 is active"),
    ("G18\n" + ENTRY_LINE + "X40.\nG40 X60.\n", 4, "plane XY"),
    (ENTRY_LINE + "Y40.\nD2 X-30.\nG40 X-40.\n", 5, "D changes while G41 is active"),
    (ENTRY_LINE + "Y40.\nG55 X-30.\nG40 X-40.\n", 5, "G41"),
    (ENTRY_LINE + "Y40.\nG91 G28 Z0.\nG90 X-40.\nG40 X-60.\n", 5, "G41"),
]


@pytest.mark.parametrize(("blocks", "line", "words"), NO_PATH, ids=[f"{k}" for k in range(len(NO_PATH))])
def test_contours_that_a_control_would_stop_at_are_refused(tmp_path, blocks, line, words):
    setup = replace(PLAIN, stated_radii_mm={"": 5.0}, work_offsets_mm={**PLAIN.work_offsets_mm, "G55": (1.0, 0.0, 0.0)})
    with pytest.raises(InputError, match=words) as caught:
        run(tmp_path, START + blocks + "M30\n", shift(x=10.0), "fanuc", setup)
    assert caught.value.line == line
    assert not (tmp_path / "out").exists()


def test_the_radius_is_asked_for_only_where_it_matters(tmp_path):
    text = BESIDE["fanuc"][0].replace("{}", "G41")
    with pytest.raises(InputError, match=r"radius of the tool is not known, .*--tool-radius 5"):
        run(tmp_path, text, shift(slope=1.0), "fanuc", PLAIN)
    assert run(tmp_path, text, shift(x=10.0), "fanuc", PLAIN)[0].accepted
