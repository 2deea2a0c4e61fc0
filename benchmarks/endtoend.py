"""What a user waits for: processor time and peak memory of whole processes (python benchmarks/endtoend.py).

    python benchmarks/endtoend.py [--rounds 7] [--only TEXT] [--slow]

Each row is a program that starts, works and ends, as a ratio to ``python -c "import numpy"``. Every round runs the
reference and then each program once, so that a slower minute of the computer meets all of them; the ratio of a row is
that of the medians, and beside it that of the least times. Processor time of the process and its children counts, so
that other programs disturb little; where the reference spreads by more than 20 % all the same, nothing is printed.
The first round, which fills the caches of the disk and of Python, is not counted. A peak of memory below that of this
program itself (about 30 MB) is shown as that: the system counts what a process had before it became another program.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from timing import ALLOWED_SPREAD, machine_line, print_table

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
LENGTHS = str(EXAMPLES / "zha-gantry.lengths.csv")
REFERENCE = "import numpy"
FEWEST_ROUNDS = 7
CONTROLS = ("isg-csv", "etalon-exchange", "siemens-cec", "siemens-eec", "fanuc-pitch", "neutral")


@dataclass
class Row:
    """One program: its arguments after ``python``, the goal as a ratio, and what was measured, one per round."""

    name: str
    words: tuple[str, ...]
    goal: float | None = None
    extra: dict[str, str] = field(default_factory=dict)
    cpu_s: list[float] = field(default_factory=list)
    peak_mb: list[float] = field(default_factory=list)

    def measure(self, folder: Path) -> None:
        """Run the program once in ``folder``; RuntimeError if it fails."""
        output = folder / "output.txt"
        # As for users, Python keeps the compiled modules; a build server may have switched that off.
        inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        with output.open("wb") as stream:
            child = subprocess.Popen(
                [sys.executable, *self.words],
                cwd=folder,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env={
                    **inherited,
                    **self.extra,
                    "OMP_NUM_THREADS": "1",
                    "OPENBLAS_NUM_THREADS": "1",
                    "XDG_CACHE_HOME": str(folder / "cache"),  # filled by the round that is not counted
                },
            )
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode not in (0, 1):  # 1: done, but not acceptable
            raise RuntimeError(
                f"{self.name} ended with {child.returncode}: {output.read_text(errors='replace')[-500:]}"
            )
        self.cpu_s.append(usage.ru_utime + usage.ru_stime)
        self.peak_mb.append(usage.ru_maxrss / 1024.0)

    @property
    def spread(self) -> float:
        """Longest minus shortest time as a share of the median."""
        return (max(self.cpu_s) - min(self.cpu_s)) / statistics.median(self.cpu_s)


def rows(slow: bool) -> list[Row]:
    """The programs in the order of the table; goals are ratios to the reference."""
    program = ("-m", "compgen")
    found = [
        Row(REFERENCE, ("-c", "import numpy")),
        Row("import compgen", ("-c", "import compgen"), 1.5),
        Row("volcomp --help", (*program, "--help"), 1.5),
        Row("completion of a command", program, 1.5, _completing("volcomp ide")),
        Row("completion of an option", program, 1.5, _completing("volcomp identify --u-")),
        Row("volcomp controllers", (*program, "controllers")),
        Row("volcomp identify", (*program, "identify", "zha-gantry", LENGTHS, "--out", "identified"), 4.0),
        Row("volcomp run, no report", _run("isg-csv", out="bare", more=("--no-report",))),
        Row("volcomp run, one control", _run("isg-csv", out="one"), 9.0),
    ]
    if slow:
        found += [
            Row(f"volcomp run, {len(CONTROLS)} controls", _run(*CONTROLS, out="many"), 18.0),
            Row("volcomp diagnose", (*program, "diagnose", "zha-gantry", LENGTHS, "--out", "diagnosis")),
        ]
    return found


def _completing(line: str) -> dict[str, str]:
    """The environment in which bash asks the program how ``line`` may go on."""
    words = line.split(" ")
    return {"_COMPGEN_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}


def _run(*controls: str, out: str, more: tuple[str, ...] = ()) -> tuple[str, ...]:
    chosen = (word for name in controls for word in ("--controller", name))
    return ("-m", "compgen", "run", "zha-gantry", LENGTHS, *chosen, "--out", out, *more)


def measured(chosen: list[Row], rounds: int) -> None:
    """Run all programs in turn, one round more than is counted."""
    with tempfile.TemporaryDirectory() as folder:
        for count in range(rounds + 1):
            for row in chosen:
                row.measure(Path(folder))
                if count == 0:
                    row.cpu_s.clear()
                    row.peak_mb.clear()


def table(chosen: list[Row]) -> list[list[str]]:
    """The rows as text: ratio of medians and of least times, goal, times, peak memory."""
    reference = chosen[0]
    lines = [["", "x numpy", "least", "goal", "median s", "min s", "peak MB"]]
    for row in chosen:
        middle = statistics.median(row.cpu_s)
        ratio, least = middle / statistics.median(reference.cpu_s), min(row.cpu_s) / min(reference.cpu_s)
        goal = "" if row.goal is None else f"{row.goal:g} {'met' if ratio <= row.goal else 'NOT MET'}"
        memory = f"{max(row.peak_mb):.0f}"
        lines.append([row.name, f"{ratio:.2f}", f"{least:.2f}", goal, f"{middle:.3f}", f"{min(row.cpu_s):.3f}", memory])
    return lines


def main() -> None:
    """Measure and print; exit code 1 if the computer was too busy."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=FEWEST_ROUNDS, help=f"at least {FEWEST_ROUNDS}")
    parser.add_argument("--only", default="", help="only rows whose name contains this")
    parser.add_argument("--slow", action="store_true", help="also several controls, and the diagnosis")
    options = parser.parse_args()
    if options.rounds < FEWEST_ROUNDS:
        parser.error(f"at least {FEWEST_ROUNDS} rounds are needed for a median with a spread")
    every = rows(options.slow)
    chosen = [every[0], *(row for row in every[1:] if options.only in row.name)]
    measured(chosen, options.rounds)
    spread = chosen[0].spread
    if spread > ALLOWED_SPREAD:
        sys.exit(f"the reference spreads by {100 * spread:.0f} %: the computer is busy with other things; run again")
    print(f"{machine_line(('numpy', 'scipy'))}; {options.rounds} rounds, reference spreads by {100 * spread:.0f} %")
    print_table(table(chosen))


if __name__ == "__main__":
    main()
