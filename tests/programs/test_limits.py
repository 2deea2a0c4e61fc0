"""Limits of corrected programs: how many blocks, the feed along divided ones, and what a control takes in a block."""

import itertools
import math
import re
import shutil

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import run

from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import InputError
from compgen.programs import Setup

ZERO = (0.0, 0.0, 0.0)
SETUP = Setup({"G54": ZERO, "PRESET": ZERO}, {"1": ZERO})


def waves(size_um=30.0, period_mm=150.0):
    """Straightness of X and Y in the other axis: straight lines and arcs bend."""
    at = np.linspace(-600.0, 600.0, 241)
    wave = 1e-3 * size_um * np.sin(2.0 * np.pi * at / period_mm)
    return ErrorTable({name: Curve(at, wave, 0.0 * wave) for name in ("EYX", "EXY", "EZX")})


# --- an own reader: how long each move of a program takes ------------------------------------------------------------


def passes(text):
    """(length, F, mode, kind) of each move at feed of a program in G90 and mm, in plain words; mode is the G of the feed."""
    at, motion, mode, feed, found = np.zeros(3), 0, 94, None, []
    pole = {}
    for line in re.sub(r"\([^)]*\)|;[^\n]*", "", text).splitlines():
        klartext = re.match(r"\s*(CC|CR|CP|C|L)(?= )", line)
        words = {
            a: float(v) for a, v in re.findall(r"(?<![A-Z])(FMAX|IPA|[XYZIJRFT]|F[ZU])=?([+-]?\d*\.?\d+|\b)", line) if v
        }
        words |= {a[:1]: words[a] for a in ("FZ", "FU") if a in words}
        for code in re.findall(r"G(\d+)(?![\d.])", line):
            mode = int(code) if code in ("93", "94", "95") else mode
            motion = int(code) if code in ("0", "1", "2", "3") else motion
        feed = words.get("F", feed)
        if klartext and klartext[1] == "CC":
            pole = words
            continue
        if klartext:
            motion = 0 if "FMAX" in line else 1 if klartext[1] == "L" else 3 if "DR+" in line else 2
        end = np.array([words.get(a, p) for a, p in zip("XYZ", at, strict=True)])
        if "IPA" in words:
            arm = (complex(*at[:2]) - complex(pole["X"], pole["Y"])) * np.exp(1j * math.radians(words["IPA"]))
            end[:2] = pole["X"] + arm.real, pole["Y"] + arm.imag
        if motion and set(words) & {"X", "Y", "Z", "IPA"}:
            way = float(np.linalg.norm(end - at))
            if motion > 1:
                if "R" in words:
                    radius = words["R"]
                    turn = 2.0 * math.asin(min(np.hypot(*(end - at)[:2]) / 2.0 / radius, 1.0))
                else:
                    centre = (
                        np.array([pole["X"], pole["Y"]]) if pole else at[:2] + [words.get("I", 0), words.get("J", 0)]
                    )
                    first, last = at[:2] - centre, end[:2] - centre
                    turn = math.atan2(last[1], last[0]) - math.atan2(first[1], first[0])
                    turn = (turn if motion == 3 else -turn) % (2.0 * math.pi) or 2.0 * math.pi
                    radius = np.hypot(*first)
                way = math.hypot(radius * turn, end[2] - at[2])
            found.append((way, feed, mode, motion))
        at = end
    return found


def minutes(found):
    """Time of moves; G95 at one turn a minute."""
    return sum(1.0 / f if mode == 93 else way / f for way, f, mode, _ in found)


BODY = "G1 X-200. F500\nY150. F250\nG3 X-100. Y250. I100. J0.\nG1 X200. Y-200. F800\n"
TIMED = {
    "linuxcnc": f"G21 G90 G17 G54\nG0 X0. Y0. Z0.\n{BODY}M2\n",
    "grbl": f"G21 G90 G17 G54\nG0 X0. Y0. Z0.\n{BODY}M2\n",
    "fanuc": f"%\nG21 G90 G17 G54\nG0 X0. Y0. Z0.\nG95\n{BODY.replace('500', '0.5')}M30\n%\n",
    "siemens": f"G71 G90 G17 G54\nG0 X0. Y0. Z0.\n{BODY}M30\n",
    "heidenhain-klartext": "BEGIN PGM P MM\nTOOL CALL 1 Z S900 F700\nL X+0 Y+0 Z+0 R0 FMAX\nL X-200 F500\nL Y+150 F250\n"
    "CC X-100 Y+150\nC X-100 Y+250 DR- FU0.4 M8\nL X+200 Y-200 FZ0.25\nL X+0 FMAX\nM30\nEND PGM P MM\n",
}


@pytest.mark.parametrize("dialect", TIMED)
def test_divided_blocks_keep_their_feed(tmp_path, dialect):
    text = TIMED[dialect]
    result, corrected = run(tmp_path, text, waves(), dialect, SETUP)
    assert result.accepted and result.counts["added_blocks"] > 15
    before, after = passes(text), passes(corrected)
    assert minutes(after) == pytest.approx(minutes(before), rel=1e-3)
    assert list(dict.fromkeys(f for _, f, *_ in after)) == list(dict.fromkeys(f for _, f, *_ in before))


INVERSE = "G93\nG1 X-200. F2.5\nY150. Z2. F0.4\nX-199.9 F4000.\nX10. F1.\nG94 X0. F300\n"


@pytest.mark.parametrize("dialect", ["linuxcnc", "grbl", "siemens", "fanuc"])
@pytest.mark.parametrize("arc", ["", "G2 X50. Y50. I25. J0. F1.5\nG1 X60. F2.\n"])
def test_under_g93_the_pieces_take_the_time_of_the_block_at_one_feed(tmp_path, dialect, arc):
    body = INVERSE.replace("G94 X0. F300\n", f"{'X0. Y50. F1.' if arc else ''}\n{arc}G94 X0. F300\n")
    text = f"G90 G17 G54\nG0 X0. Y0. Z0.\n{body}M30\n"
    if dialect == "fanuc" and arc:
        with pytest.raises(InputError, match="per radius on FANUC"):
            run(tmp_path, text, waves(), dialect, SETUP)
        return
    result, corrected = run(tmp_path, text, waves(), dialect, SETUP)
    assert result.accepted and result.counts["added_blocks"] > 10
    before, after = passes(text), passes(corrected)
    assert minutes(after) == pytest.approx(minutes(before), rel=1e-3)
    k = 0
    for way, f, mode, _ in before:  # each block: its time, and one feed in all its pieces
        pieces = []
        while sum(p[0] for p in pieces) < way * 0.999 and mode == 93:
            pieces.append(after[k])
            k += 1
        assert sum(1.0 / p[1] for p in pieces) == pytest.approx(1.0 / f, rel=0.01) or mode == 94
        speeds = np.array([p[0] * p[1] for p in pieces])
        assert mode == 94 or np.ptp(speeds) < 0.01 * way * f
    assert "e+" not in corrected.lower()


def test_under_g93_large_numbers_are_plain_or_refused(tmp_path):
    text = "G90 G17 G54\nG0 X-300. Y0. Z0.\nG93\nG1 X300. F{}\nG94 F100\nM30\n"
    _, corrected = run(tmp_path, text.format("900000."), waves(), "linuxcnc", SETUP)
    assert all(p[1] > 1e6 for p in passes(corrected))
    with pytest.raises(InputError, match="line|control does not take"):
        run(tmp_path, text.format("5000."), waves(), "fanuc", SETUP)
    with pytest.raises(InputError, match="no decimal point"):
        run(tmp_path, text.format("50"), waves(), "fanuc", SETUP)


def test_a_feed_that_g93_leaves_behind_is_refused(tmp_path):
    text = "G90 G17 G54\nG0 X0. Y0. Z0.\nG93\nG1 X3. F2.\nG94\n{}M30\n"
    for body in ("X5.\n", "G1 Y5.\n" * 30):
        with pytest.raises(InputError, match="without F since") as caught:
            run(tmp_path, text.format(body), waves(), "linuxcnc", SETUP)
        assert caught.value.line == 6
    assert run(tmp_path, text.format("F100\nX5.\n"), waves(), "linuxcnc", SETUP)[0].accepted
    assert run(tmp_path, text.format("G0 X5.\nG1 X6. F10\n"), waves(), "linuxcnc", SETUP)[0].accepted


@pytest.mark.parametrize(("corner", "way"), [("RND R5 F50", 2.5 * math.pi), ("CHF 5 F50", 5.0 * math.sqrt(2.0))])
@pytest.mark.parametrize("after", ["L Y+20", "L Y+20 ; up", "L Y+20 F300"])
def test_a_rounding_with_its_own_feed_gives_the_feed_back(tmp_path, corner, way, after):
    """F of RND and CHF counts in their block only (Klartext manual): the next one has the feed of before."""
    head = "BEGIN PGM P MM\nTOOL CALL 1 Z S900\nL X+0 Y+0 Z+0 R0 FMAX\n"
    text = f"{head}L X+20 F400\n{corner}\n{after}\nL X+5\nM30\nEND PGM P MM\n"
    _, corrected = run(tmp_path, text, waves(), "heidenhain-klartext", SETUP)
    later = 300.0 if "F300" in after else 400.0
    found = [(f, sum(one[0] for one in group)) for f, group in itertools.groupby(passes(corrected), lambda one: one[1])]
    assert found == [
        (400.0, pytest.approx(15.0, abs=0.1)),
        (50.0, pytest.approx(way, abs=0.1)),
        (later, pytest.approx(30.0, abs=0.1)),
    ]


# --- how many blocks -------------------------------------------------------------------------------------------------


def fewest(target, tolerance):
    """The fewest pieces of a chain of points that stay within a tolerance: each as long as it can be."""
    at, count = 0, 0
    while at < len(target) - 1:
        best = at + 1
        for end in range(at + 2, len(target)):
            chord = target[end] - target[at]
            inner = target[at + 1 : end] - target[at]
            off = inner - np.outer(inner @ chord / (chord @ chord), chord)
            if np.linalg.norm(off, axis=1).max() <= tolerance:
                best = end
        at, count = best, count + 1
    return count


@pytest.mark.parametrize(
    ("size_um", "period_mm", "tolerance_um"), [(30.0, 150.0, 1.0), (12.0, 90.0, 0.5), (40.0, 300.0, 3.0)]
)
def test_a_line_has_at_most_twice_the_pieces_that_its_tolerance_needs(tmp_path, size_um, period_mm, tolerance_um):
    text = "G21 G90 G54\nG0 X-400. Y0. Z0.\nG1 X400. Y130. F900\nM2\n"
    result, _ = run(tmp_path, text, waves(size_um, period_mm), "linuxcnc", SETUP, tolerance_um=tolerance_um)
    share = np.linspace(0.0, 1.0, 401)
    wanted = np.column_stack([-400.0 + 800.0 * share, 130.0 * share, 0.0 * share])
    errors = 1e-3 * size_um * np.sin(2.0 * np.pi * wanted[:, :2] / period_mm)
    target = wanted - np.column_stack([errors[:, 1], errors[:, 0], errors[:, 0]])
    least = fewest(target, 1e-3 * tolerance_um)
    assert least > 8
    assert result.counts["added_blocks"] + 1 <= 2 * least


# --- characters and digits -------------------------------------------------------------------------------------------


def long_block(length, comment):
    head = "G1 X10. Y10. Z-1. F300 "
    return head + comment.format("A" * (length - len(head) - len(comment) + 2))


@pytest.mark.parametrize(("dialect", "most", "comment"), [("linuxcnc", 252, "({})"), ("siemens", 511, ";{}")])
def test_a_block_that_becomes_too_long_is_refused(tmp_path, dialect, most, comment):
    text = "G90 G17 G54\nG0 X0. Y0. Z0.\nG1 X1. F10\n{}\nM30\n"
    fits, long = (text.format(long_block(length, comment)) for length in (most - 20, most))
    result, corrected = run(tmp_path, fits, waves(), dialect, SETUP)
    assert max(map(len, corrected.splitlines())) <= most
    with pytest.raises(InputError, match=f"takes {most}") as caught:
        run(tmp_path, long, waves(), dialect, SETUP)
    assert caught.value.line == 4


def test_comments_and_blanks_do_not_count_for_grbl(tmp_path):
    text = "G90 G17 G54\nG0 X0. Y0. Z0.\n{}\nM2\n"
    assert run(tmp_path, text.format(long_block(120, "({})")), waves(), "grbl", SETUP)[0].accepted
    code = "N100000000000000000000000000000000000000 G1 G17 G90 G94 G21 G54 M3 X10. Y10. Z-1. F300"
    with pytest.raises(InputError, match="takes 79"):
        run(tmp_path, text.format(code), waves(), "grbl", SETUP)


def test_numbers_have_no_more_digits_than_the_control_reads(tmp_path):
    """FANUC reads eight digits: 1234.56789 mm would be alarm 003; six decimals go where the number is below 100."""
    machine = mill()
    body = "".join(
        f"X{x:.5f} Y{y:.3f}\n" for x, y in zip(np.linspace(90.0, 480.0, 40), np.linspace(-5.0, 12.0, 40), strict=True)
    )
    text = (
        f"%\nG21 G90 G17 G54\nG0 X-500. Y0. Z0.\nG1 X0.5 F100\n{body}G91\nX1. Y-0.25\nG90\nG2 X450. Y0. R900.\nM30\n%\n"
    )
    result, corrected = run(tmp_path, text, waves(), "fanuc", SETUP, machine, decimals=6)
    assert result.accepted
    numbers = [n for n in re.findall(r"[XYZIJR]-?(\d*\.\d*)", corrected.partition("POSITION)")[2])]
    digits = [len(n.replace(".", "").lstrip("0")) for n in numbers]
    assert max(digits) == 8
    assert any(len(n.partition(".")[2]) == 6 for n in numbers)


@pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed")
def test_linuxcnc_takes_the_longest_block_and_no_longer(tmp_path):
    import subprocess

    for length, taken in ((252, True), (253, False)):
        path = tmp_path / "long.ngc"
        path.write_text(long_block(length, "({})") + "\nM2\n")
        done = subprocess.run(
            ["rs274", "-g", path], capture_output=True, text=True, cwd=tmp_path, timeout=30, check=False
        )
        assert ("Command too long" not in done.stdout + done.stderr) == taken


def test_the_note_says_the_tolerance_at_which_a_program_has_twice_its_blocks(tmp_path):
    """Curves that are smooth: with the tolerance that the note names the program has about twice its blocks."""
    body = "".join(
        f"G1 X{400 * (-1) ** k}. Y{k}. F900\nY{k}.5\nY{k}.6\n" + "".join(f"Y{k}.{j}\n" for j in range(61, 81))
        for k in range(40)
    )
    text = f"G21 G90 G54\nG0 X-400. Y0. Z0.\n{body}M2\n"
    errors = waves(40.0, 500.0)
    result, _ = run(tmp_path, text, errors, "linuxcnc", SETUP)
    found = re.search(r"at about ([\d.]+) um it has twice the blocks", " ".join(result.notes))
    assert result.counts["added_blocks"] > 1.3 * result.counts["blocks"]
    again, _ = run(tmp_path, text, errors, "linuxcnc", SETUP, tolerance_um=float(found[1]))
    assert 0.7 < again.counts["added_blocks"] / again.counts["blocks"] < 1.3


@pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed")
def test_the_time_of_a_corrected_program_is_that_of_the_program_by_linuxcnc(tmp_path):
    """Inverse time, per minute, lines, arcs and a helix of two turns: path by feed, as the interpreter says both."""
    import subprocess

    def time(text):
        path = tmp_path / "t.ngc"
        path.write_text(
            "\n".join(line for line in text.splitlines() if not re.match(r"o<|\(abort|\(CORRECTED", line)) + "\n"
        )
        done = subprocess.run(
            ["rs274", "-g", path], capture_output=True, text=True, cwd=tmp_path, timeout=30, check=True
        )
        at, feed, found = np.zeros(3), math.nan, 0.0
        for name, inside in re.findall(r"([A-Z_]+)\(([^()]*)\)", done.stdout):
            number = [float(one) for one in re.findall(r"-?\d+(?:\.\d+)?", inside)]
            if name == "SET_FEED_RATE":
                feed = number[0]
            elif name == "ARC_FEED":
                end, centre, turns = np.array(number[:2]), np.array(number[2:4]), number[4]
                one, other = (np.arctan2(*(place - centre)[::-1]) for place in (at[:2], end))
                swept = (other - one) * np.sign(turns) % (2.0 * np.pi)
                swept = (swept if swept > 1e-6 else 2.0 * np.pi) + 2.0 * np.pi * (abs(turns) - 1)
                found += math.hypot(swept * math.dist(at[:2], centre), number[5] - at[2]) / feed
                at = np.array([*end, number[5]])
            elif name.startswith("STRAIGHT_"):
                found += math.dist(at, number[:3]) / feed if name == "STRAIGHT_FEED" else 0.0
                at = np.array(number[:3])
        return found

    text = "G21 G90 G17 G54\nG0 X0 Y0 Z0\nG93\nG1 X-200 F2.5\nY150 Z2 F0.4\nG3 X-100 Y250 I100 J0 F1.5\n"
    text += "G2 X-100 Y250 Z5 I0 J-30 P2 F0.7\nG94 G1 X10 Y20 F300\nG3 X60 I25 J0\nM2\n"
    result, corrected = run(tmp_path, text, waves(), "linuxcnc", SETUP)
    assert result.counts["added_blocks"] > 100
    assert time(corrected) == pytest.approx(time(text), rel=1e-3)
