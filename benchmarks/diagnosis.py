"""Blind sets through ``volcomp diagnose``: right names, false alarms, honesty. Seeded; prints a table.

    python benchmarks/diagnosis.py [--sets 40] [--seed 5000] [--workers 2] [--kinds null,single] [--plans standard]

The sets come from ``tests/hidden``, which shares nothing with the catalogue or the method: own machine, own formulas,
and effects that no catalogue has. Only machine file and lengths reach the command; the key stays here. Of each kind
there are ``--sets`` sets, every other one with white noise. ``--details FILE`` writes one JSON line a set.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from hidden.mismatched import mismatched  # noqa: E402 - found through the line above
from hidden.noise import FAMILIES  # noqa: E402
from hidden.score import outcome, said, wilson  # noqa: E402
from hidden.sets import CHAINS, KINDS, OTHER_PLANS, Case, Options, make  # noqa: E402
from hidden.write import write_set  # noqa: E402

#: Every how many sets the installed command is started instead of the same command in this process.
COMMAND_EVERY = 20
#: Kinds whose sets are also drawn with other plans and chains, in the group "other plans".
VARIED = ("null", "single")


@dataclass(frozen=True)
class Job:
    """One set to be made and diagnosed."""

    kind: str
    seed: int
    options: Options
    by_command: bool
    group: str


def jobs_of(kinds: Sequence[str], count: int, seed: int, plans: str) -> list[Job]:
    """The sets of a benchmark; even seeds are white, odd ones go through the other families of noise."""
    found = []
    for kind in kinds:
        for k in range(count):
            family = FAMILIES[0] if k % 2 == 0 else FAMILIES[1 + (k // 2) % (len(FAMILIES) - 1)]
            shade = "white" if family == "white" else "correlated"
            if plans in ("standard", "all"):
                found.append(Job(kind, seed + k, Options(family), k % COMMAND_EVERY == 0, f"{kind}, {shade}"))
            if plans in ("other", "all") and kind in VARIED:
                plan = OTHER_PLANS[k % len(OTHER_PLANS)]
                chain = CHAINS[k % len(CHAINS)]
                options = Options(family, plan=plan, chain=chain)
                found.append(Job(kind, seed + 500 + k, options, False, f"{kind}, other plans"))
    return found


def run_here(machine: Path, lengths: Path, out: Path) -> None:
    """Run the command in this process."""
    from compgen.cli import cli

    cli.main(["diagnose", str(machine), str(lengths), "--out", str(out)], standalone_mode=False)


def run_command(machine: Path, lengths: Path, out: Path) -> None:
    """Run the command as a user does; exit code 1 (not decided, or the gap stays) is an answer."""
    words = [sys.executable, "-m", "compgen", "diagnose", str(machine), str(lengths), "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(done.stderr[-2000:])


def diagnosed(case: Case, run: Callable[[Path, Path, Path], None]) -> tuple[dict, tuple[float, float]]:
    """Diagnosis of a set, and its time in seconds by the clock and of this processor."""
    with tempfile.TemporaryDirectory() as folder:
        machine, lengths = write_set(Path(folder), case.machine, case.lengths)
        begin = time.perf_counter(), time.process_time()
        run(machine, lengths, Path(folder) / "out")
        spent = time.perf_counter() - begin[0], time.process_time() - begin[1]
        return json.loads((Path(folder) / "out" / "diagnosis.json").read_text(encoding="utf-8")), spent


def work(job: Job) -> dict:
    """Make a set, diagnose it, judge it; a crash is an outcome."""
    case = make(job.kind, job.seed, job.options)
    facts = {"group": job.group, **case.key}
    with open(os.devnull, "w") as nowhere:
        before, sys.stdout = sys.stdout, nowhere
        try:
            diagnosis, spent = diagnosed(case, run_command if job.by_command else run_here)
        except Exception:
            return facts | {"outcome": "crash", "error": traceback.format_exc()[-1500:]}
        finally:
            sys.stdout = before
    family = mismatched(case.session)[case.key["effects"][0]["name"]][0] if job.kind == "mismatch" else None
    gap = diagnosis["gap"]
    return facts | {
        "outcome": outcome(case.key, diagnosis, family),
        "right_name": family,
        "first": said(diagnosis).first,
        "seconds": spent[0],
        "processor_s": None if job.by_command else spent[1],
        "verdict": diagnosis["verdict"],
        "said": [
            {k: e.get(k) for k in ("name", "grade", "alias_set", "chi2", "homogeneity_p", "reasons")}
            for e in diagnosis["effects"]
        ],
        "unknown": diagnosis["unknown"][:4],
        "gap": {name: gap[name] for name in ("train", "heldout_lines", "noise_floor_um", "noise_floor_source")},
    }


#: What counts as right for a kind, and the shares that are asked for and aimed at.
RIGHT: dict[str, tuple[tuple[str, ...], str, str]] = {
    "null, white": (("clean",), "98", "99.5"),
    "null, correlated": (("clean",), "95", "99"),
    "null": (("clean",), "95", "99"),
    "single": (("exact", "alias set holds it"), "95", "99"),
    "single, other plans": (("exact", "alias set holds it", "exact, tentative"), "95", "99"),
    "double": (("exact", "alias set holds it"), "90", "98"),
    "triple": (("exact", "alias set holds it"), "80", "95"),
    "inside": (("unknown", "tentative", "silent"), "97", "99"),
    "outside": (("unknown", "tentative", "silent", "right name"), "90", "97"),
    "mixed": (("both",), "85", "95"),
    "alias": (("set",), "100", "100"),
    "invisible": (("listed",), "100", "100"),
    "mismatch": (("exact", "exact, but flagged"), "90", "97"),
    "gross": (("found",), "100", "100"),
}


def row_of(name: str, hits: int, count: int, asked: tuple[str, str], rest: str) -> str:
    """One line of the table."""
    low, high = wilson(hits, count)
    share = f"{100 * hits / count:.1f} [{100 * low:.0f}-{100 * high:.0f}]"
    return f"| {name} | {count} | {share} | {asked[0]} | {asked[1]} | {rest} |"


def others(results: Iterable[dict], right: Sequence[str]) -> str:
    """Outcomes that are not right, counted."""
    counted = Counter(r["outcome"] for r in results if r["outcome"] not in right)
    return ", ".join(f"{name} {count}" for name, count in counted.most_common())


def table(results: Sequence[dict]) -> list[str]:
    """The table of the benchmark."""
    rows = ["| sets | n | right, % [95 %] | must | aim | the others |", "|---|---|---|---|---|---|"]
    for group in dict.fromkeys(r["group"] for r in results):
        own = [r for r in results if r["group"] == group]
        kind = own[0]["kind"]
        right, must, aim = RIGHT.get(group) or RIGHT[kind]
        hits = sum(r["outcome"] in right for r in own)
        rows.append(row_of(group, hits, len(own), (must, aim), others(own, right)))
        if kind in ("single", "mismatch") and "other" not in group:
            first = sum(r.get("first") == (r.get("right_name") or r["effects"][0]["name"]) for r in own)
            rows.append(row_of(f"{group}: right name first", first, len(own), ("95", "99"), ""))
        if kind in ("inside", "outside"):
            found = ("unknown", "right name")
            flagged = sum(r["outcome"] in found for r in own)
            rows.append(row_of(f"{group}: flagged unknown", flagged, len(own), ("", ""), others(own, found)))
    return rows + ["", *figures(results)]


def figures(results: Sequence[dict]) -> list[str]:
    """Held-out residual and time."""
    named = [r for r in results if r["outcome"] == "exact" and (r["gap"] or {}).get("heldout_lines")]
    lines = []
    if named:
        ratio = [r["gap"]["heldout_lines"]["after_rms_um"] / r["noise_rms_um"] for r in named]
        lines.append(
            f"Held-out lines after adding, over the RMS of the true noise: median {np.median(ratio):.3f}, "
            f"90 % below {np.quantile(ratio, 0.9):.3f} (n = {len(ratio)}; must 1.05, aim 1.03)."
        )
    for name, what in (("seconds", "Time by the clock"), ("processor_s", "Processor time")):
        spent = [r[name] for r in results if r.get(name)]
        if spent:
            quantiles = np.quantile(spent, [0.5, 0.9, 1.0])
            text = "{}: median {:.1f} s, 90 % below {:.1f} s, most {:.1f} s.".format(what, *quantiles)
            lines.append(text)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return [*lines, f"{os.cpu_count()} processors, load over 1, 5, 15 minutes at the end: {load}."]


def into_docs(path: Path, lines: Sequence[str]) -> None:
    """Put the table between the marks of a page."""
    text = path.read_text(encoding="utf-8")
    before, mark, rest = text.partition("<!-- table -->\n")
    _, end, after = rest.partition("<!-- end of table -->")
    if not (mark and end):
        raise SystemExit(f"{path} lacks the marks <!-- table --> and <!-- end of table -->")
    path.write_text(before + mark + "\n".join(lines) + "\n" + end + after, encoding="utf-8")


def parsed() -> argparse.Namespace:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=40, help="sets of each kind")
    parser.add_argument("--seed", type=int, default=5000, help="seed of the first set")
    parser.add_argument("--workers", type=int, default=2, help="sets at a time")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds, with commas between")
    parser.add_argument("--plans", choices=("standard", "other", "all"), default="all", help="plans of measurement")
    parser.add_argument("--details", type=Path, help="file for one JSON line a set")
    parser.add_argument("--docs", type=Path, help="page that gets the table, e.g. docs/diagnosis-benchmark.md")
    return parser.parse_args()


def main() -> None:
    """Run the benchmark."""
    options = parsed()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    jobs = jobs_of(options.kinds.split(","), options.sets, options.seed, options.plans)
    results = []
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for result in pool.imap(work, jobs):
            results.append(result)
            print(f"{len(results)}/{len(jobs)} {result['group']}: {result['outcome']}", file=sys.stderr)
            if options.details:
                with options.details.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
    lines = table(results)
    print("\n".join(lines))
    if options.docs:
        into_docs(options.docs, lines)


if __name__ == "__main__":
    main()
