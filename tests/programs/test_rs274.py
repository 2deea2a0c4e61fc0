"""LinuxCNC's own interpreter (``rs274``) reads programs, original and corrected: its moves are ours, to its last decimal."""

import dataclasses
import os
import pathlib
import re
import shutil
import subprocess

import numpy as np
import pytest
from programs.make import OFFSETS_MM, TOOLS_MM, mill, random_holes, random_program

from compgen.programs import CorrectOptions, Reader, Setup, correct_program, model_of
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import Follower
from compgen.programs.path import CCW, PLANE_AXES, RAPID

pytestmark = pytest.mark.skipif(
    shutil.which("rs274") is None,
    reason="LinuxCNC is not installed (rs274 missing): make test installs it on Debian as root",
)
SETUP = Setup(OFFSETS_MM, TOOLS_MM)


def interpreted(program, folder, *, stopped=False):
    """What the interpreter does, as text.

    Without an INI file the interpreter's machine is in inches: so are its offsets and tools.
    """
    rows = [
        f"{5221 + 20 * n + k}\t{value / 25.4:.8f}"
        for n, name in enumerate(OFFSETS_MM)
        for k, value in enumerate(OFFSETS_MM[name])
    ]
    folder.joinpath("sim.var").write_text("\n".join(["5161\t0", "5162\t0", "5163\t0", *rows, ""]))
    folder.joinpath("tool.tbl").write_text("".join(f"T{n} P{n} Z{v[2] / 25.4:.8f} D0\n" for n, v in TOOLS_MM.items()))
    done = subprocess.run(
        ["rs274", "-g", "-v", "sim.var", "-t", "tool.tbl", str(program)],
        cwd=folder, env={**os.environ, "HOME": str(folder)},  # its tool table is a shared file, ~/.tool.mmap
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if stopped:
        assert "PROGRAM_END" not in done.stdout and "is not that of the correction" in done.stderr
        return ""
    assert "PROGRAM_END" in done.stdout, done.stdout[-500:] + done.stderr[-500:]
    return done.stdout


def canonical(program, folder, *, stopped=False):
    """Moves of the interpreter: kind, end in units of the program, and for arcs centre, turns and normal axis."""
    moves, plane, last = [], 2, None
    for line in interpreted(program, folder, stopped=stopped).splitlines():
        found = re.search(r"(\w+)\((.*)\)", line)
        name, text = (found[1], found[2]) if found else ("", "")
        if name == "SELECT_PLANE":
            plane = {"XY": 2, "XZ": 1, "YZ": 0}[text.removeprefix("CANON_PLANE_")]
        elif name in ("STRAIGHT_TRAVERSE", "STRAIGHT_FEED"):
            end = np.array([float(part) for part in text.split(",")[:3]])
            if last is None or np.abs(end - last).max() > 0:
                moves.append((name == "STRAIGHT_FEED", end, None))
            last = end
        elif name == "ARC_FEED":
            e1, e2, c1, c2, turns, rise = (float(part) for part in text.split(",")[:6])
            a, b = PLANE_AXES[plane]
            end = np.zeros(3)
            end[a], end[b], end[plane] = e1, e2, rise
            moves.append((True, end, (c1, c2, turns, plane)))
            last = end
    return moves


def ours(program, setup=SETUP):
    reader = Reader(mill(), DIALECTS["linuxcnc"], setup, program)
    moves, last = [], None
    with open(program, "rb") as stream:
        for batch in reader.batches(stream):
            scales = {}
            for segment in batch.segments:
                numbers = segment.lines if hasattr(segment, "lines") else [segment.number - batch.first_line]
                scales |= {batch.first_line + number: segment.scale for number in numbers}
            for k in range(len(batch.moves)):
                row = batch.moves.part(k)
                scale = scales[int(row.line)]
                end = (row.end_mm - row.offset_mm) / scale
                if row.sweep_rad:
                    a, b = PLANE_AXES[row.plane]
                    c = (row.centre_mm - row.offset_mm) / scale
                    turns = (1 if row.kind == CCW else -1) * np.ceil(abs(row.sweep_rad) / (2 * np.pi) - 1e-9)
                    moves.append((True, end, (c[a], c[b], turns, row.plane)))
                elif last is None or np.abs(np.round(end, 4) - np.round(last, 4)).max() > 0:
                    moves.append((row.kind != RAPID, end, None))
                last = end
    return moves


def assert_same(found, truth):
    assert len(found) == len(truth)
    for k, ((feed, end, arc), (feed_there, end_there, arc_there)) in enumerate(zip(found, truth, strict=True)):
        assert feed == feed_there, k
        known = ~np.isnan(end)
        assert np.abs(end - end_there)[known].max() < 5.1e-5, (k, end, end_there)
        assert (arc is None) == (arc_there is None), k
        if arc is not None:
            assert arc[2:] == arc_there[2:], k
            assert np.abs(np.subtract(arc[:2], arc_there[:2])).max() < 5.1e-5, (k, arc, arc_there)


@pytest.mark.parametrize("seed", range(40))
def test_original_and_corrected_programs_are_read_as_the_interpreter_reads_them(
    tmp_path, seed, make_errors, monkeypatch
):
    if seed % 2:  # plain blocks many at a time, however few there are in a row
        monkeypatch.setattr("compgen.programs.reader.LEAST_RUN", 1)
    program = tmp_path / "p.ngc"
    program.write_text(random_program(seed))
    assert_same(ours(program), canonical(program, tmp_path))
    model = model_of(mill(), make_errors(mill(), seed), None)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions("linuxcnc"), SETUP)
    assert result.counts["changed_blocks"] > 0
    corrected = tmp_path / "out" / result.file
    text = corrected.read_text()
    # the header's numbers are for a control in mm: this one, in inches, stops
    canonical(corrected, tmp_path, stopped=True)
    corrected.write_text(re.sub(r"(#52\d\d)-\[([-.\d]+)\]", lambda m: f"{m[1]}-[{float(m[2]) / 25.4:.6f}]", text))
    truth = canonical(corrected, tmp_path)
    # the check of the work offsets is a conditional, which our reader refuses in programs of others
    body = tmp_path / "body.ngc"
    body.write_text(
        "\n".join(line for line in text.splitlines() if not re.match(r"o<|\(abort|\(CORRECTED", line)) + "\n"
    )
    assert_same(ours(body), truth)
    assert result.after.largest_mm < result.before.largest_mm


def test_the_way_to_a_hole_whose_r_level_is_higher(tmp_path):
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X0 Y0 Z-9\nG1 Z-8 F9\nG99 G81 X1 Y1 Z-5 R-2\nX5 R-1.5\n"
        "G82 X9 Z-5 R3 P0.1\nX9.5 R-3\nG98 X10 Y3 R-2.9995\nX3 R4\nG80\nM2\n%\n"
    )
    assert_same(ours(program), canonical(program, tmp_path))


def test_local_shifts_and_stored_reference_points(tmp_path):
    """G52 is kept where G92 is; G28.1 stores a point that G28 returns to, on the way through a point of the program."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X1 Y2 Z3\nG28.1\nG52 X10 Y-5\nG0 X0 Y0\nG1 X4 F100\nG52 X20\nX5 Y1\nG92 X0\n"
        "X1\nG52 X0 Y0 Z0\nX2 Y2\nG28 Z9\nG1 X3 Y3 Z3\nG91\nG52 X7\nG90 X1\nM2\n%\n"
    )
    assert_same(ours(program), canonical(program, tmp_path))


def test_work_offsets_that_the_program_writes(tmp_path, make_errors):
    """G10 L2 states a zero of the machine, L20 the place where the tool is: with tool length, G92, in inch, and of others."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X1 Y2 Z3\nG1 X4 F100\nG10 L2 P1 X10 Y-5 Z-40\nG1 X5 Y1 Z2\n"
        "G10 L20 P0 X2 Z1\nX3 Y3 Z3\nG10 L20 P2 Y5 Z0\n"
        "G55 G0 X0 Y0 Z1\nG1 X1\nG20\nG10 L2 P3 X1 Y1 Z-1\nG56 G0 X0 Y0 Z0.5\nG1 X0.5\nG21\n"
        "G92 X20\nG10 L20 P3 X1\nG1 X7\nG54 G0 X0 Y0 Z5\nM2\n%\n"
    )
    assert_same(ours(program), canonical(program, tmp_path))
    result = correct_program(
        model_of(mill(), make_errors(mill(), 3), None), program, tmp_path / "out", CorrectOptions(), SETUP
    )
    assert result.accepted
    assert sum("as the program writes it (G10)" in text for text in result.assumed) == 5


def test_rigid_tapping_ends_where_the_interpreter_says_and_comes_back(tmp_path, make_errors):
    """G33.1 is one block: its end is corrected, the tool comes back to where it was, and is there for an increment."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X10 Y20 Z3\nS100 M3\nG33.1 Z-12 K1.25\nG0 X30\nG91\nG33.1 Z-8 K1\nG1 X5 F100\n"
        "G90\nG0 Z9\nM2\n%\n"
    )
    taps = re.findall(r"RIGID_TAP\(([-\d.]+), ([-\d.]+), ([-\d.]+)", interpreted(program, tmp_path))
    feed = [end.round(9).tolist() for fed, end, _ in ours(program) if fed]
    assert [[float(part) for part in tap] for tap in taps] == [feed[0], feed[2]] == [[10, 20, -12], [30, 20, -5]]
    assert (feed[1], feed[3], feed[4]) == ([10, 20, 3], [30, 20, 3], [35, 20, 3])
    model = model_of(mill(), make_errors(mill(), 3), None)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions(), SETUP)
    assert result.accepted
    assert len(re.findall("^G33.1", (tmp_path / "out/p.ngc").read_text(), re.MULTILINE)) == 2
    assert result.after.ends_mm < 2e-5


def test_calls_of_subprograms_in_the_same_file_are_written_out_as_the_interpreter_executes_them(tmp_path, make_errors):
    """Nested, repeated, in absolute and in incremental; the corrected program has no calls and moves alike."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nO1\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X1 Y2 Z3\nF100\nM98 P2000\nG55 G0 X0 Y0\nN7 M98 P2000 (again)\n"
        "G91\nM98 P30 L3\nG90\nG0 X0 Y0 Z9\nM30\nO2000\nG1 Z-1\nX5 Y5\nM98 P30\nG90 G0 Z3\nM99\nO30 (STEP)\nG91 G1 X2\nY1\n"
        "N9 M99\n%\n"
    )
    truth = canonical(program, tmp_path)
    result = correct_program(
        model_of(mill(), make_errors(mill(), 3), None), program, tmp_path / "out", CorrectOptions(), SETUP
    )
    assert result.accepted
    assert result.assumed[0].endswith("each is corrected: O2000 (2 times), O30 (5 times)")
    text = (tmp_path / "out" / "p.ngc").read_text()
    assert "N7 (O2000) (again)\n" in text.replace(" (again) (O2000)", " (O2000) (again)")
    assert not re.search("M9[89]|O2000\\n", text)
    # without errors the program is that of the calls
    reader = Reader(mill(), DIALECTS["linuxcnc"], SETUP, program)
    written = tmp_path / "written.ngc"
    with reader.opened() as stream:
        written.write_bytes(stream.read())
    assert_same(ours(written), truth)
    assert_same(canonical(written, tmp_path), truth)


@pytest.mark.parametrize(
    "comment", ["; was M98 P2000", "; drill M2 holes", "(M30) (M98 P2000)", "; M99", "; O30", "(; M30) ; (M2"]
)
def test_what_stands_in_comments_calls_nothing_and_ends_nothing(tmp_path, comment):
    program = tmp_path / "p.ngc"
    text = "%\nO1\nG21 G90 G17 G54\nT1 M6\nG43 H1;\nG0 X1 Y2 Z3\n;\nG1 X50 F100 ;\nM 98 P02000 L2 ;\nG1 Y50 ;\nN8 M98 P30\nX9\n"
    text += "M30 ;\nO2000 ;\nG91 G1 Z-1 ;\nG90\nM99 ;\nN5 O30\nX7 ;\nM99\n%\n"
    program.write_text(text.replace(";", comment))
    reader = Reader(mill(), DIALECTS["linuxcnc"], SETUP, program)
    written = tmp_path / "written.ngc"
    with reader.opened() as stream:
        written.write_bytes(stream.read())
    truth = canonical(program, tmp_path)
    assert len(truth) == 7
    assert_same(ours(written), truth)
    assert_same(canonical(written, tmp_path), truth)


def test_drilling_in_increments_and_with_repeats(tmp_path, make_errors):
    """R counts from where Z was, Z from R, X and Y from hole to hole; in absolute, repeats are in the same place."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X1 Y2 Z10\nF100\nG99 G81 X3 Y4 Z-5 R2 L2\n"
        "N5 G91 G82 X2.5 Y-1 Z-6 R-7.5 P0.1 L3 (row)\nX1 Y1\nG90 X-5 Z-4 R3\nG80\nG0 Z20\nG91 G98\n"
        "G83 X-2 Z-9 R-15 Q4\nY2.25 L2\nX1 R-14\nG80\nG90 G0 X0 Y0\nM2\n%\n"
    )
    truth = canonical(program, tmp_path)
    assert_same(ours(program), truth)
    errors = make_errors(mill(), 4)
    result = correct_program(model_of(mill(), errors, None), program, tmp_path / "out", CorrectOptions(), SETUP)
    assert result.accepted, result.reasons
    text = (tmp_path / "out" / "p.ngc").read_text()
    assert text.count("G91\n") == 5
    body = tmp_path / "body.ngc"
    body.write_text(
        "\n".join(line for line in text.splitlines() if not re.match(r"o<|\(abort|\(CORRECTED", line)) + "\n"
    )
    assert_same(ours(body), canonical(body, tmp_path))
    # the holes are where they were: the corrected places differ by the errors alone
    places = [end for feed, end, _ in canonical(body, tmp_path) if feed]
    assert len(places) == len([row for row in truth if row[0]])
    assert (
        max(np.abs(there - row[1]).max() for there, row in zip(places, [r for r in truth if r[0]], strict=True)) < 0.2
    )


# Positions of the machine, by the offsets that the interpreter has at each move: for what changes them between moves.


def machine_moves(program, folder):
    """Moves of the interpreter: whether at feed, and where the machine goes (mm): all offsets are added."""
    unit, zero, moves, last, plane = 1.0, {}, [], np.full(3, np.nan), 2
    for line in interpreted(program, folder).splitlines():
        found = re.search(r"([A-Z_0-9]+)\((.*)\)", line)
        name, text = (found[1], found[2]) if found else ("", "")
        if name == "USE_LENGTH_UNITS":
            unit = 25.4 if "INCH" in text else 1.0
        elif name in ("SET_G5X_OFFSET", "SET_G92_OFFSET", "USE_TOOL_LENGTH_OFFSET"):
            numbers = [float(part) for part in re.split("[, ]+", text)]
            zero[name] = np.array(numbers[1:4] if name == "SET_G5X_OFFSET" else numbers[:3]) * unit
        elif name == "SELECT_PLANE":
            plane = {"XY": 2, "XZ": 1, "YZ": 0}[text.removeprefix("CANON_PLANE_")]
        elif name.startswith("STRAIGHT_") or name == "ARC_FEED":
            numbers = [float(part) for part in text.split(",")[:6]]
            if name == "ARC_FEED":
                a, b = PLANE_AXES[plane]
                found = {a: numbers[0], b: numbers[1], plane: numbers[5]}
                numbers = [found[k] for k in range(3)]
            end = np.array(numbers[:3]) * unit + sum(zero.values())
            if name == "ARC_FEED" or not np.abs(end - last).max() < MICRON:
                moves.append((name != "STRAIGHT_TRAVERSE", end))
            last = end
    return moves


def our_machine_moves(text, *, follower=False):
    """The same of our reader, or of the follower that it is held against, and the moves themselves."""
    if follower:
        every = Follower("linuxcnc", SETUP, mill()).follow(text, range(1, text.count("\n") + 2))
    else:
        every = Reader(mill(), DIALECTS["linuxcnc"], SETUP, "p").batch(text.encode(), 1).moves
    found, last = [], np.full(3, np.nan)
    for end, feed, sweep in zip(every.end_mm, every.cutting, every.sweep_rad, strict=True):
        if sweep or not np.abs(end - last).max() < MICRON:
            found.append((bool(feed), end))
        last = end
    return found, every


MICRON = 1e-3
#: Four decimals of an inch, of a position and of its offsets.
PRINTED_MM = 6e-3


def without_header(text):
    return "\n".join(line for line in text.splitlines() if not re.match(r"o<|\(abort|\(CORRECTED", line)) + "\n"


def hold_holes(folder, corrected, model, every, truth, axis=2):
    """The interpreter's holes of a corrected program are, by the exact errors, where the program wants them."""
    body = folder / "body.ngc"
    body.write_text(without_header(corrected.read_text()))
    driven = machine_moves(body, folder)
    cut = every.part(np.flatnonzero(every.cutting))
    command = np.array([end for feed, end in driven if feed])
    assert len(command) == len(cut)
    tip = command + model.error(command, cut.tool_mm, np.zeros_like(command))
    deep = (cut.end_mm[:, axis] < cut.start_mm[:, axis]) & (cut.at_mm == cut.end_mm).all(
        axis=1
    )  # not between two pecks
    assert deep.sum() > 5
    assert np.abs(tip - cut.end_mm)[deep].max() < PRINTED_MM / 2
    before = np.abs(model.error(cut.end_mm, cut.tool_mm, np.zeros_like(command)))[deep].max()
    assert before > 5 * PRINTED_MM
    # rapid moves lead where the program led, but for the correction
    assert np.abs(driven[-1][1] - truth[-1][1]).max() < 3 * before


@pytest.mark.parametrize("seed", range(16))
def test_holes_are_where_the_interpreter_drills_them_whatever_changes_between_them(
    tmp_path, seed, make_errors, monkeypatch
):
    """G52, G92, another work offset, tool length or level within a cycle; and so the corrected program, by the exact errors."""
    if seed % 2:
        monkeypatch.setattr("compgen.programs.reader.LEAST_RUN", 1)
    program = tmp_path / "p.ngc"
    program.write_text(random_holes(seed))
    found, every = our_machine_moves(program.read_text())
    truth = machine_moves(program, tmp_path)
    assert [feed for feed, _ in found] == [feed for feed, _ in truth]
    for k, ((_, end), (_, there)) in enumerate(zip(found, truth, strict=True)):
        assert np.abs(end - there).max(where=~np.isnan(end), initial=0.0) < PRINTED_MM, (k, end, there)

    model = model_of(mill(), make_errors(mill(), seed, (900e-6, -600e-6, 700e-6)), None)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions("linuxcnc"), SETUP)
    assert result.accepted, result.reasons
    hold_holes(tmp_path, tmp_path / "out" / result.file, model, every, truth)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("program_of", [random_program, random_holes])
def test_the_follower_goes_where_the_interpreter_goes(tmp_path, seed, program_of, monkeypatch):
    """It shares nothing with the reader; alone, it finds every move of the interpreter."""
    if seed % 2:
        monkeypatch.setattr("compgen.programs.follower._LEAST_RUN", 1)
    program = tmp_path / "p.ngc"
    program.write_text(program_of(seed + 100))
    found, _ = our_machine_moves(program.read_text(), follower=True)
    truth = machine_moves(program, tmp_path)
    assert [feed for feed, _ in found] == [feed for feed, _ in truth]
    for k, ((_, end), (_, there)) in enumerate(zip(found, truth, strict=True)):
        assert np.abs(end - there).max(where=~np.isnan(end), initial=0.0) < PRINTED_MM, (k, end, there)


def test_a_cycle_keeps_its_numbers_from_increments_to_absolute(tmp_path):
    """LinuxCNC keeps R 2 and Z -6 of a block in increments as numbers: in absolute they are heights."""
    program = tmp_path / "p.ngc"
    program.write_text(
        "%\nG21 G90 G17 G54\nT1 M6\nG43 H1\nG0 X0 Y0 Z-20 F90\nG91 G99 G81 X3 R2 Z-6\nX4\nG90 X20\nY5\nG80\nM2\n%\n"
    )
    found, _ = our_machine_moves(program.read_text())
    truth = machine_moves(program, tmp_path)
    assert [feed for feed, _ in found] == [feed for feed, _ in truth]
    assert np.abs(np.array([a - b for (_, a), (_, b) in zip(found, truth, strict=True)])).max() < 2e-4


def test_the_length_of_the_tool_that_the_same_block_changes(tmp_path):
    """The tool is changed first, wherever M6 and G43 stand in their block."""
    for block in ("T2 M6 G43", "G43 M6 T2", "G43 T2 M6 Z30", "M6 T2 G43 H1", "T2\nM6 G43"):
        program = tmp_path / "p.ngc"
        program.write_text(f"%\nG21 G90 G17 G54\nT1 M6 G43\nG0 X0 Y0 Z20\n{block}\nG0 X1 Y2 Z3\nG1 X5 F9\nM2\n%\n")
        found, _ = our_machine_moves(program.read_text())
        truth = machine_moves(program, tmp_path)
        assert found[-1][1] == pytest.approx(truth[-1][1], abs=2e-4), block


# --- radius compensation: the interpreter's own tool centre ----------------------------------------------------------


def contour(seed):
    """A closed contour with outer and inner corners and tangent arcs, cut on its left or right side; what is beside it."""
    r = np.random.default_rng(seed)
    radius = float(np.round(r.uniform(2.0, 6.0), 1))
    w, h, big = (float(np.round(v, 2)) for v in r.uniform((60.0, 50.0, 15.0), (90.0, 70.0, 20.0)))
    notch = float(np.round(r.uniform(6.0, 9.0), 2))
    points = [
        f"G1 X0.0 Y{h - big:.2f}",
        f"G2 X{big:.2f} Y{h:.2f} I{big:.2f} J0.0",
        f"G1 X{w / 2 - 15:.2f} Y{h:.2f}",
        f"X{w / 2:.2f} Y{h - notch:.2f}",  # an inner corner between two outer ones
        f"X{w / 2 + 15:.2f} Y{h:.2f}",
        f"X{w:.2f} Y{h:.2f}",
        f"X{w:.2f} Y{big:.2f}",
        f"G2 X{w - big:.2f} Y0.0 I{-big:.2f} J0.0",
        "G1 X-20.0 Y0.0",
    ]
    start, lead, leave = "X-30.0 Y-30.0", "G1 X0.0 Y-15.0", "X-40.0 Y-25.0"
    side = "G41"
    if r.random() < 0.5:  # the mirror image: the same contour on the right side
        side = "G42"
        flip = {"G2": "G3", "G3": "G2"}
        mirrored = []
        for line in [start, lead, *points, leave]:
            words = [flip.get(word, word) for word in line.split()]
            mirrored.append(" ".join(f"{w[0]}{-float(w[1:])}" if w[0] in "XI" else w for w in words))
        start, lead, *points, leave = mirrored
    text = ["%", "G21 G90 G17 G54 G94 G40 G49", "T1 M6", "G43 H1", f"G0 {start} Z20.0", "G1 Z-2.0 F500"]
    text += [f"{side} D1 {lead}", *points, f"G40 {leave}", "G0 Z20.0", "M2", "%", ""]
    return "\n".join(text), radius


def with_radius(monkeypatch, radius_mm):
    """The interpreter's tool table has the diameter of tool 1 (in inch, as all of its numbers here)."""
    write = pathlib.Path.write_text

    def written(path, text, *args, **more):
        if path.name == "tool.tbl":
            text = text.replace(" D0", f" D{2 * radius_mm / 25.4:.8f}")
        return write(path, text, *args, **more)

    monkeypatch.setattr(pathlib.Path, "write_text", written)


@pytest.mark.parametrize("wear", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_contours_beside_which_the_interpreter_goes(tmp_path, seed, wear, make_errors, monkeypatch):
    """G41 and G42 stay: the interpreter's own tool centre, by the exact errors, is where the program has it without errors.

    With wear alone the control's radius is 0, and the tool is still wanted where the contour is.
    """
    text, radius = contour(seed)
    radius = 0.0 if wear else radius
    with_radius(monkeypatch, radius)
    program = tmp_path / "p.ngc"
    program.write_text(text)
    wanted = machine_moves(program, tmp_path)
    setup = dataclasses.replace(SETUP, stated_radii_mm={"1": radius})
    model = model_of(mill(), make_errors(mill(), seed, (900e-6, -600e-6, 700e-6)), None)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions("linuxcnc"), setup)
    assert result.accepted, result.reasons
    written = (tmp_path / "out" / result.file).read_text()
    side = "G41" if "G41" in text else "G42"
    assert written.count(side) == 1 and written.count("G40") == text.count("G40")
    body = tmp_path / "body.ngc"
    body.write_text(without_header(written))
    driven = machine_moves(body, tmp_path)
    tool = Reader(mill(), DIALECTS["linuxcnc"], setup, "p").batch(text.encode(), 1).moves.tool_mm[-3:-2]

    def tips(moves):
        ends = np.array([end for feed, end in moves if feed])
        return ends + model.error(ends, np.repeat(tool, len(ends), axis=0), np.zeros_like(ends))

    there = np.array([end for feed, end in wanted if feed])
    reached = tips(driven)
    before = np.abs(tips(wanted) - there).max()
    # every place where the interpreter ends a move without errors is reached with them, in this order
    nearest, row = [], 0
    for place in there:
        apart = np.abs(reached[row:] - place).max(axis=1)
        nearest.append(apart.min())
        row += int(apart.argmin())
    assert before > 5 * PRINTED_MM
    assert max(nearest) < PRINTED_MM, (max(nearest), before)


#: Programs of the plane G17 with other axes: Z, along which cycles drill, becomes Y or X.
TURNED_AXES = {18: str.maketrans("ZXY", "YZX"), 19: str.maketrans("ZXY", "XYZ")}


@pytest.mark.parametrize("plane", TURNED_AXES)
@pytest.mark.parametrize("seed", [2, 5, 7, 11, 20, 21])
def test_cycles_drill_along_y_in_g18_and_along_x_in_g19(tmp_path, plane, seed, make_errors):
    """The random series of holes again, in the two other planes: reader, follower and corrected program."""
    program = tmp_path / "p.ngc"
    program.write_text(random_holes(seed).translate(TURNED_AXES[plane]).replace("G17", f"G{plane}"))
    truth = machine_moves(program, tmp_path)
    for follower in (True, False):
        found, every = our_machine_moves(program.read_text(), follower=follower)
        assert [feed for feed, _ in found] == [feed for feed, _ in truth]
        for k, ((_, end), (_, there)) in enumerate(zip(found, truth, strict=True)):
            assert np.abs(end - there).max(where=~np.isnan(end), initial=0.0) < PRINTED_MM, (k, end, there)
    model = model_of(mill(), make_errors(mill(), seed, (900e-6, -600e-6, 700e-6)), None)
    result = correct_program(model, program, tmp_path / "out", CorrectOptions("linuxcnc"), SETUP)
    assert result.accepted, result.reasons
    hold_holes(tmp_path, tmp_path / "out" / result.file, model, every, truth, {18: 1, 19: 0}[plane])
