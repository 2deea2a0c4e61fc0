"""Correcting long NC programs: processor time and peak memory of ``volcomp correct`` (python benchmarks/nc_programs.py).

    python benchmarks/nc_programs.py [--blocks 1000000] [--rounds 3]

Programs like those of CAM: a surface finished in lines of 0.4 mm (FANUC, LinuxCNC), the same with block numbers and
blanks (SINUMERIK); lines, arcs and all that CAM mixes among them, increments, and, a tenth of the blocks, holes under one
cycle and pockets of arcs and lines (LinuxCNC). The machine is the example with its
true errors. Least of several rounds of whole processes, one thread; processor time, which other programs disturb little.

Each round also times a peer on the same file: a process that does nothing but split it with numpy, letters from numbers,
line by line, once (``PEER``). ``correct`` splits the program and what it writes twice each, and does everything else; the
ratio of the two says more than seconds where a computer is busy or another one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from timing import machine_line, print_table

ROOT = Path(__file__).resolve().parents[1]
PEER = """
import sys
import numpy as np
blank = bytes(32 if not chr(k).isdigit() and chr(k) not in "+-." else k for k in range(256))
total, words = 0.0, 0
with open(sys.argv[1], "rb") as stream:
    for line in stream:
        numbers = np.array(line.partition(b"(")[0].translate(blank).split(), dtype=np.float64)
        total, words = total + float(numbers.sum()), words + len(numbers)
print(words)
"""
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def surface(blocks: int, numbered: bool) -> Iterator[str]:
    """Lines along X in rows over Y, with waves in Z; the file is written in parts."""
    yield (
        "N1 G71 G90 G54 G17\nN2 G0 X0 Y0 Z50\nN3 G1 F1000\n"
        if numbered
        else "G21 G90 G54 G17\nG0 X0. Y0. Z50.\nG1 F1000\n"
    )
    form = "N%d X%.3f Y%.3f Z%.3f\n" if numbered else "X%.3fY%.3fZ%.3f\n"
    for first in range(0, blocks, 10_000):
        i = np.arange(first, min(first + 10_000, blocks))
        x, y = np.abs((i * 0.4) % 800 - 400) - 200, np.minimum(-150 + (i * 0.4 // 400) * 0.05, 300)
        z = -20 + 10 * np.sin(x / 30) * np.cos(y / 40)
        rows = zip(i + 4, x, y, z, strict=True) if numbered else zip(x, y, z, strict=True)
        yield "".join(form % row for row in rows)
    yield "G0 Z50.\nM30\n"


def pockets(blocks: int) -> Iterator[str]:
    """Rounded rectangles in passes over Z."""
    yield "G21 G90 G54 G17\nG0 X0 Y0 Z50\n"
    for k in range(blocks // 10):
        x, y, z = 30.0 * (k % 10), 30.0 * (k // 10 % 10), -0.01 * (k // 100)
        yield f"G0 Z5\nX{x + 4:.3f} Y{y:.3f}\nG1 Z{z:.3f} F200\nX{x + 20:.3f}\nG3 X{x + 24:.3f} Y{y + 4:.3f} J4\n"
        yield f"G1 Y{y + 20:.3f}\nG3 X{x + 20:.3f} Y{y + 24:.3f} I-4\nG1 X{x + 4:.3f}\n"
        yield f"G3 X{x:.3f} Y{y + 20:.3f} R4\nG1 Y{y + 4:.3f}\nG3 X{x + 4:.3f} Y{y:.3f} I4\n"
    yield "G0 Z50\nM2\n"


def mixed(blocks: int) -> Iterator[str]:
    """Passes as CAM writes them: of 100 blocks about 70 lines, 25 arcs, and codes, comments, increments, a drilled hole."""
    yield "G21 G90 G54 G17\nG0 X0 Y0 Z50\nG1 F800\n"
    r = np.random.default_rng(0)
    written = 0
    while written < blocks:
        k = written // 100
        x, y, z = 20.0 * (k % 20), 15.0 * (k // 20 % 20), -0.01 * (k // 400)
        lines = [f"G0 Z5 (pass {k})", f"X{x:.3f} Y{y:.3f}", "M8", f"G1 Z{z:.3f} F200"]
        for row in range(9):
            v = y + 1.0 * row
            for u in np.sort(r.uniform(0.5, 7.5, 6)):
                lines.append(f"G1 X{x + (u if row % 2 == 0 else 8 - u):.3f} Y{v + 0.05 * u:.3f}")
            side, code = (8.0, "G3") if row % 2 == 0 else (0.0, "G2")
            lines += [f"G1 X{x + side:.3f} Y{v:.3f}", f"{code} X{x + side:.3f} Y{v + 1:.3f} J0.5"]
        for inset in (0.0, 0.7, 1.4):
            left, right, low, high = x + inset, x + 12 - inset, y + 10 + inset, y + 16 - inset
            lines += [f"G1 X{left + 1:.3f} Y{low:.3f}", f"X{right - 1:.3f}", f"G3 X{right:.3f} Y{low + 1:.3f} R1"]
            lines += [f"G1 Y{high - 1:.3f}", f"G3 X{right - 1:.3f} Y{high:.3f} I-1", f"G1 X{left + 1:.3f}"]
            lines += [f"G3 X{left:.3f} Y{high - 1:.3f} J-1", f"G1 Y{low + 1:.3f}", f"G3 X{left + 1:.3f} Y{low:.3f} R1"]
        lines.append("G2 I1")
        lines += ["G91", "G1 Z0.5", "X0.25 Y-0.25", "G90", "M9", "G0 Z5"]
        if k % 5 == 0:
            lines += [f"G81 X{x + 3:.3f} Y{y + 3:.3f} Z{z - 4:.3f} R2 F90", f"X{x + 6:.3f}", "G80", "G0 Z5"]
        written += len(lines)
        yield "\n".join([*lines, ""])
    yield "G0 Z50\nM2\n"


def steps(blocks: int) -> Iterator[str]:
    """Increments of about 0.5 mm along waves."""
    yield "G21 G90 G54 G17\nG0 X0 Y0 Z0\nG91 G1 F1000\n"
    for first in range(0, blocks, 10_000):
        i = np.arange(first, min(first + 10_000, blocks) + 1)
        at = np.round(np.stack([100 * np.sin(i / 300), 80 * np.cos(i / 410), 10 * np.sin(i / 50)], axis=1), 3)
        yield "".join(f"X{x:.3f} Y{y:.3f} Z{z:.3f}\n" for x, y, z in np.diff(at, axis=0))
    yield "G90\nM2\n"


def holes(blocks: int) -> Iterator[str]:
    """A plate of holes under one modal cycle."""
    yield "G21 G90 G54 G17\nG0 X0 Y0 Z50\nG99 G81 X0 Y0 Z-12 R2 F200\n"
    yield from (f"X{0.7 * (k % 400):.3f} Y{0.07 * (k // 400):.3f}\n" for k in range(1, blocks))
    yield "G80\nM2\n"


def peer_s(program: Path) -> float:
    """Processor time in s of the peer on the same file."""
    child = subprocess.Popen([sys.executable, "-c", PEER, str(program)], stdout=subprocess.DEVNULL, env=ONE_THREAD)
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise RuntimeError("the peer failed")
    return used.ru_utime + used.ru_stime


def measured(program: Path, dialect: str, offset: str) -> tuple[float, float, float, float]:
    """Processor time in s, peak memory in MB, largest deviation before and after in um of one run."""
    words = [sys.executable, "-m", "compgen", "correct", "zha-gantry", str(program), "--dialect", dialect, "--json"]
    words += ["--errors", str(ROOT / "examples" / "zha-gantry.truth.errors.csv"), "--wcs", f"G54={offset}"]
    with tempfile.TemporaryFile() as output:
        child = subprocess.Popen(
            [*words, "--out", str(program.parent / "out")],
            stdout=output,
            env=ONE_THREAD,
        )
        _, status, used = os.wait4(child.pid, 0)
        output.seek(0)
        found = json.loads(output.read())
    if status:
        raise RuntimeError(f"volcomp correct failed: {found}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, found["before"]["max_um"], found["after"]["max_um"]


def main() -> None:
    """Write the programs, correct each several times, print the least of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    cases = {
        "surface, fanuc": ("fanuc", lambda: surface(given.blocks, numbered=False)),
        "surface, linuxcnc": ("linuxcnc", lambda: surface(given.blocks, numbered=False)),
        "surface with block numbers, siemens": ("siemens", lambda: surface(given.blocks, numbered=True)),
        "lines, arcs and others, linuxcnc": ("linuxcnc", lambda: mixed(given.blocks)),
        "increments, linuxcnc": ("linuxcnc", lambda: steps(given.blocks)),
        "holes under one cycle, linuxcnc": ("linuxcnc", lambda: holes(given.blocks // 10)),
        "pockets of arcs, linuxcnc": ("linuxcnc", lambda: pockets(given.blocks // 10)),
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (dialect, text) in cases.items():
            program = Path(folder) / "program.nc"
            with program.open("w") as stream:
                stream.writelines(text())
            with program.open("rb") as stream:
                blocks = sum(1 for _ in stream)
            runs, peers = [], []
            for _ in range(given.rounds):  # in turn, so that both meet the same load
                runs.append(measured(program, dialect, "-400,-500,-200"))
                peers.append(peer_s(program))
            time_s, peak = min(run[0] for run in runs), min(run[1] for run in runs)
            rows.append(
                [name, f"{blocks}", f"{time_s:.1f} s", f"{1e6 * time_s / blocks:.1f} us",
                 f"{time_s / min(peers):.1f}", f"{peak:.0f} MB",
                 f"{runs[0][2]:.1f} um", f"{runs[0][3]:.2f} um"]
            )  # fmt: skip
    print(machine_line())
    print_table(
        [
            ["program", "blocks", "processor time", "a block", "of the peer", "peak memory", "largest before", "after"],
            *rows,
        ]
    )


if __name__ == "__main__":
    main()
