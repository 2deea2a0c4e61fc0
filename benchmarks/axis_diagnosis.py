"""Blind axis sessions (ISO 230-2) through ``volcomp diagnose``: right names, false alarms, honesty. Seeded; prints a table.

    python benchmarks/axis_diagnosis.py [--sets 300] [--seed 5000] [--workers 2] [--kinds null,warmup] [--details FILE]

The sessions come from ``tests/hidden/axis_sets.py``, which shares nothing with the catalogue or the method. Only the file
of the runs reaches the command; the key stays here. "Visible" are sets in which the RMS of every effect (against the mean
of its target and direction; half the reversal) is at least 1.5 times the noise of a mean of five runs.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from hidden.axis_sets import KINDS, NAMELESS, SHARES, make, outcome  # noqa: E402 - found through the line above
from hidden.score import wilson  # noqa: E402

VISIBLE = 1.5
MARKS = ("<!-- axis table -->", "<!-- end of axis table -->")


def work(job: tuple[str, int]) -> dict:
    """One set: made, written, diagnosed as the command does, and judged."""
    from compgen.cli import cli
    from compgen.errors import CompgenWarning

    case = make(*job)
    with tempfile.TemporaryDirectory() as folder:
        path, out = case.write(Path(folder)), Path(folder) / "out"
        started = time.perf_counter()
        with warnings.catch_warnings(), open(os.devnull, "w", encoding="utf-8") as sink:
            warnings.simplefilter("ignore", CompgenWarning)
            before, sys.stdout = sys.stdout, sink
            try:
                cli.main(["diagnose", "zha-gantry", str(path), "--json", "--out", str(out)], standalone_mode=False)
            finally:
                sys.stdout = before
        seconds = time.perf_counter() - started
        diagnosis = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    figures = next(iter(diagnosis["iso_230_2"].values()))
    return {
        "kind": case.kind, "seed": case.seed, "label": case.label, "truth": case.names, "ratio": case.ratio,
        "white": case.memory == 0.0, "memory": case.memory, "sigma_um": case.sigma_um, "seconds": seconds,
        "outcome": outcome(case, diagnosis), "visible": all(ratio >= VISIBLE for ratio in case.ratio),
        "said": [(e["name"], e["grade"], e["alias_set"]) for e in diagnosis["effects"]],
        "unknown": [item["text"] for item in diagnosis["unknown"]],
        "grows": [key for key in ("R", "A") if figures[key]["after"] > figures[key]["before"] * (1 + 1e-9)],
    }  # fmt: skip


def row_of(name: str, hits: int, count: int, must: str, rest: str) -> str:
    """A line of the table: share with its 95 % interval."""
    if not count:
        return f"| {name} | 0 | | {must} | |"
    low, high = wilson(hits, count)
    return f"| {name} | {count} | {100 * hits / count:.1f} [{100 * low:.0f}-{100 * high:.0f}] | {must} | {rest} |"


def others(results: Iterable[dict], right: Sequence[str]) -> str:
    """What the remaining sets were called."""
    count = Counter(item["outcome"] for item in results if item["outcome"] not in right)
    return ", ".join(f"{name} {number}" for name, number in count.most_common())


def table(results: Sequence[dict]) -> list[str]:
    """Lines of the table in Markdown."""
    lines = ["| sets | n | right, % [95 %] | must | the others |", "|---|---|---|---|---|"]
    for shade, white in (("white", True), ("with memory", False)):
        own = [r for r in results if r["white"] == white]
        for kind in KINDS:
            chosen = [r for r in own if r["kind"] == kind and (r["visible"] or kind == "null")]
            right = ("clean",) if kind == "null" else ("unknown",) if kind in NAMELESS else ("exact", "alias set")
            must = {"null": "98", "unlisted": "", "further": "", "several": ""}.get(kind, "95")
            hits = sum(r["outcome"] in right for r in chosen)
            lines.append(row_of(f"{kind}, {shade}", hits, len(chosen), must, others(chosen, right)))
    nameless = [r for r in results if r["kind"] in NAMELESS and r["visible"]]
    singles = [r for r in results if r["kind"] not in ("null", "several", *NAMELESS) and r["visible"]]
    named = [r for r in results if r["kind"] not in ("null", *NAMELESS) and r["visible"]]
    hidden = [r for r in results if r["kind"] != "null"]
    null = [r for r in results if r["kind"] == "null"]
    right = ("exact", "alias set")
    for name, chosen, good, must in (
        ("all null", null, ("clean",), "98"),
        ("all single effects, visible", singles, right, "95"),
        ("all named effects, visible", named, right, ""),
        ("all effects without a name, visible", nameless, ("unknown",), ""),
    ):
        lines.append(row_of(name, sum(r["outcome"] in good for r in chosen), len(chosen), must, others(chosen, good)))
    wrong = [r for r in hidden if r["outcome"] == "misnamed"]
    lines.append(row_of("misnamed, of all with something hidden", len(wrong), len(hidden), "at most 2", ""))
    grows = [r for r in results if r["grows"]]
    lines.append(row_of("R or A grows", len(grows), len(results), "0", ""))
    return lines


def main() -> None:
    """Run the sets and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=300, help="sets altogether, in the shares of the kinds")
    parser.add_argument("--seed", type=int, default=5000, help="first seed of every kind")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kinds", help="only these, comma between them")
    parser.add_argument("--details", type=Path, help="one JSON line a set")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced")
    given = parser.parse_args()
    kinds = given.kinds.split(",") if given.kinds else [kind for kind in KINDS if kind != "further"]
    total = sum(share for kind, share in SHARES.items() if kind != "further")
    jobs = [(kind, given.seed + k) for kind in kinds for k in range(round(SHARES[kind] * given.sets / total))]
    with multiprocessing.Pool(given.workers) as pool:
        results = pool.map(work, jobs, chunksize=4)
    lines = table(results)
    print("\n".join(lines))
    seconds = sorted(r["seconds"] for r in results)
    print(
        f"\n{len(results)} sets, seeds from {given.seed}; a diagnosis takes {seconds[len(seconds) // 2]:.2f} s (median)"
    )
    if given.details:
        given.details.write_text("".join(json.dumps(r) + "\n" for r in results), encoding="utf-8")
    if given.docs:
        text = given.docs.read_text(encoding="utf-8")
        before, after = text.index(MARKS[0]) + len(MARKS[0]), text.index(MARKS[1])
        given.docs.write_text(text[:before] + "\n" + "\n".join(lines) + "\n" + text[after:], encoding="utf-8")


if __name__ == "__main__":
    main()
