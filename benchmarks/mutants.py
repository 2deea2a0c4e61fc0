"""Mutation testing of the modules that hold signs: every change of one sign, guard or term must make a test fail.

    python benchmarks/mutants.py compgen/kinematics/gauge.py tests/kinematics [--only 12,40] [--limit 60]

Changes one place at a time: ``+`` for ``-`` and back, a minus sign left out, a comparison turned round, ``0.5`` set to zero,
a sign written as a number turned. The tests run on each change until one fails; a change that no test notices is printed with
its line. Survivors are killed by a new test, or explained in ``benchmarks/README.md``. Options of pytest follow ``--``:

    python benchmarks/mutants.py compgen/kinematics/compiled_kernels.py -- tests/kinematics/test_evaluate.py -k interpreted

The tests run in a fork of this process (so not on Windows), which has loaded the libraries: a tenth of the processor time of
a new process.
"""

import argparse
import ast
import importlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

#: Libraries that are slow to load and that the tests need; none of them imports this program.
LIBRARIES = ("numba", "numpy", "scipy.linalg", "scipy.optimize", "scipy.stats", "hypothesis.strategies")

TURNED = {"+": "-", "-": "+"}
REVERSED = {"<": ">=", ">": "<=", "<=": ">", ">=": "<", "==": "!=", "!=": "=="}


def places(text: str) -> Iterator[tuple[int, int, int, str, str]]:
    """Every change as line, first column, last column (in bytes of that line), what is there and what is put instead."""
    lines = text.encode().splitlines()
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Add | ast.Sub)
            and not isinstance(node.left, ast.Constant | ast.JoinedStr)
        ):
            yield from between(lines, node.left, node.right, TURNED)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node.lineno, node.col_offset, node.col_offset + 1, "-", ""
        elif isinstance(node, ast.Compare):
            yield from between(lines, node.left, node.comparators[0], REVERSED)
        elif isinstance(node, ast.Constant) and node.value == 0.5 and isinstance(node.value, float):
            yield node.lineno, node.col_offset, node.end_col_offset or 0, "0.5", "0.0"


def between(
    lines: list[bytes], left: ast.expr, right: ast.expr, words: dict[str, str]
) -> Iterator[tuple[int, int, int, str, str]]:
    """The operator between two expressions of one line."""
    if left.end_lineno != right.lineno:
        return
    start, end = left.end_col_offset or 0, right.col_offset
    gap = lines[right.lineno - 1][start:end].decode()
    word = gap.strip(" ()")
    if word in words:
        at = start + gap.index(word)
        yield right.lineno, at, at + len(word), word, words[word]


def changed(text: str, place: tuple[int, int, int, str, str]) -> str:
    """The text with one place changed."""
    number, start, end, _, instead = place
    lines = text.encode().splitlines(keepends=True)
    line = lines[number - 1]
    lines[number - 1] = line[:start] + instead.encode() + line[end:]
    return b"".join(lines).decode()


def run(tests: list[str]) -> None:
    """Run the tests silently, in a group of processes that can be killed together; the exit code says how they went."""
    os.setsid()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nowhere, stream)
    loaded = "ignore::pytest.PytestAssertRewriteWarning"  # hypothesis was loaded before pytest started
    sys.exit(pytest.main(["-x", "-q", "-n", "0", "--no-header", "-p", "no:cacheprovider", "-W", loaded, *tests]))


def survives(tests: list[str], seconds: float) -> bool:
    """Whether the tests pass although the module is changed; a run that takes too long counts as noticed."""
    child = multiprocessing.get_context("fork").Process(target=run, args=(tests,))
    child.start()
    child.join(seconds)
    if child.is_alive() and child.pid:
        os.killpg(child.pid, signal.SIGKILL)
        child.join()
    return child.exitcode == 0


def main() -> int:
    """Change one place after the other; the module is put back in the end, also when stopped."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("module", type=Path)
    parser.add_argument("tests", nargs="+")
    parser.add_argument("--only", default="", help="line numbers, with commas")
    parser.add_argument("--limit", type=int, default=10**6, help="at most so many changes, evenly spread")
    parser.add_argument("--seconds", type=float, default=600.0, help="longest time of one run")
    given = parser.parse_args()
    for name in LIBRARIES:
        importlib.import_module(name)
    if not survives(given.tests, given.seconds):
        sys.exit("the tests fail, or take too long, before anything is changed")
    sys.dont_write_bytecode = True  # two changes within a second would share it
    text = given.module.read_text(encoding="utf-8")
    found = sorted(set(places(text)))
    if given.only:
        found = [place for place in found if str(place[0]) in given.only.split(",")]
    found = found[:: max(1, -(-len(found) // given.limit))]
    left = []
    try:
        for place in found:
            given.module.write_text(changed(text, place), encoding="utf-8")
            since = time.monotonic()
            if survives(given.tests, given.seconds):
                left.append(place)
                line = text.splitlines()[place[0] - 1].strip()
                print(
                    f"{given.module}:{place[0]}:{place[1]}: {place[3]} -> {place[4] or 'nothing'}: {line}", flush=True
                )
            print(f"   line {place[0]}: {time.monotonic() - since:.0f} s", file=sys.stderr, flush=True)
    finally:
        given.module.write_text(text, encoding="utf-8")
    print(f"{given.module}: {len(found)} changes, {len(found) - len(left)} noticed, {len(left)} not")
    return int(bool(left))


if __name__ == "__main__":
    sys.exit(main())
