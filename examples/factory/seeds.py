"""How often the factory's statements hold: the year with several seeds (python examples/factory/seeds.py 20)."""

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import checks
from factory import Year, begin, months

from compgen.fleet import logs

#: Fixed tolerance of the forecasts from a part of the year, against the first calibration.
EARLY_TOLERANCE_URAD = 15.0


def statements(year: Year) -> Counter:
    """Count what was stated in one year, and how often it was true."""
    found: Counter = Counter()

    def count(what: str, true: bool) -> None:
        found[what, "n"] += 1
        found[what, "true"] += int(true)

    def interval(item: checks.Held) -> None:
        count(f"95 % interval: {item.what}", item.inside)

    a, b, c = (checks.drift_after(year, name) for name in ("mill-a", "mill-b", "mill-c"))
    interval(checks.rate(a))
    count("A: drift of EC0Y named", "EC0Y" in checks.named_drifts(a))
    for known in (6, 8, 10):
        tolerances = {"EC0Y": EARLY_TOLERANCE_URAD * 1e-6}
        item = checks.exit_of(year, checks.drift_after(year, "mill-a", known, tolerances=tolerances))
        count(f"95 % interval: {item.what} after {known}", item.inside)
    steps, gap = checks.steps_of(b), checks.gap_of_the_crash(b)
    for name in ("EYY line", "EC0Y"):
        after, held = steps.get(name, (None, None))
        count(f"B: step of {name} in the right gap", after == gap)
        if held is not None:
            interval(held)
    for item in checks.coefficients(year, c):
        interval(item)
    count("A: no other error drifts", checks.named_drifts(a) <= {"EC0Y"})
    count("B: no error drifts", not checks.named_drifts(b))
    count("C: no error drifts", not checks.named_drifts(c))
    count("A, C: no step", not a.gaps and not c.gaps)
    count("B: no other step", set(steps) <= {"EYY line", "EC0Y"})
    for item in checks.judged(year):
        if item.true_um < 1e-6:
            count("no change: held", not item.significant)
        elif item.true_um > item.expected_um:
            count("change larger than the rms expected by noise: seen", item.significant)
    for row in year.rows:
        if row.active is not None:
            count("better with the tables than without", row.with_um < row.without_um)
    for item in year.undone:
        count("rollback brings the bytes back", item.files[0] == item.files[2] != item.files[1])
    return found


def main() -> None:
    """Run the years and print the shares."""
    parser = argparse.ArgumentParser(description="How often the statements of the example factory hold.")
    parser.add_argument("seeds", type=int, nargs="?", default=20)
    parser.add_argument("--first", type=int, default=1)
    arguments = parser.parse_args()
    logs.configure("text")
    total: Counter = Counter()
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            year = begin(Path(folder) / "factory", seed)
            for _ in months(year):
                pass
            now = statements(year)
        total += now
        wrong = [what for what, kind in now if kind == "n" and now[what, "true"] < now[what, "n"]]
        print(
            f"seed {seed}: {time.perf_counter() - started:.0f} s; not true: {'; '.join(wrong) or 'nothing'}", flush=True
        )
    print()
    for what, kind in total:
        if kind == "n":
            print(f"{total[what, 'true']:5} of {total[what, 'n']:4}  {what}")


if __name__ == "__main__":
    main()
