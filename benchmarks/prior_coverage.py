"""Does what is stated about unknown errors hold the truth, for every mixture of measurements? Prints a table.

    python benchmarks/prior_coverage.py [--machines 20] [--seed 1] [--family smooth] [--size 3] [MIXTURE ...]

The machines and their readings are those of ``tests/virtual_shop.py``: errors of five families that take turns (smooth,
piecewise linear, cyclic, random walk, with jumps), three chains, travels of 300 to 1000 mm. For each mixture, at k = 2 and
over the whole travel:

    curves, squareness, field   how many true values are within U of the posterior mean, %
    nrms                        error of the field over its standard uncertainty, rms: 1 is ideal
    before, after               true error of the tool tip over the volume, um rms, without and with the errors found
    stated (bound)              what was stated for the latter: median and 97.5 % limit
    accepted/reservations/...   verdicts on tables that contain exactly the errors found: accepted, with reservations
                                (at least 97.5 % likely to be better), doubtful or only after a new set-up, refused
    worse                       machines that got worse, of those accepted / with reservations
    beyond                      machines whose true error afterwards is above the stated limit
    lost                        machines made better by at least a fifth by tables that were refused
    class                       machines that were said to be worse than their class
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgen.errors import CompgenError
from compgen.identification import IdentifyOptions
from compgen.identification.result import Identification
from compgen.pipeline import identify_bare
from compgen.tables.verification import ProbableGain, probable_gain

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from virtual_shop import FAMILIES, FROM_DATA, MIXTURES, SQUARENESS, Shop, Truth, case

#: Positions of a curve, and points of the volume, at which the truth is compared.
POSITIONS, POINTS = 81, 300
#: Points along each axis at which the verdict is made.
GRID = 7
VERDICTS = ("accepted", "reservations", "doubtful", "refused")


@dataclass(frozen=True)
class Coverage:
    """Shares of the true values within U of the posterior mean, and the error of the field over its u, rms."""

    curves: tuple[float, ...]
    squareness: tuple[bool, ...]
    field: float
    field_nrms: float


@dataclass(frozen=True)
class Outcome(Coverage):
    """How one machine and its result compare; all lengths um, rms over the volume."""

    before_um: float
    after_um: float
    stated_um: tuple[float, float]
    verdict: str
    alarm: bool
    seconds: float

    @property
    def better(self) -> bool:
        """Whether the errors that were found, taken off, make the true machine better as it stands."""
        return self.after_um < self.before_um


def outcome(shop: Shop, mixture: str) -> tuple[Outcome, Identification]:
    """Take a mixture of readings in a shop, identify it, and compare all that is stated with the truth."""
    measurement = MIXTURES[mixture](shop)
    options = IdentifyOptions(nodes="from-data") if mixture == FROM_DATA else None
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify_bare(shop.machine, measurement, options)  # type: ignore[arg-type]
    assert found.posterior is not None
    seconds = time.perf_counter() - start
    covered = coverage(shop, found)
    gain, before_um, after_um = verdict(shop, found)
    return Outcome(
        **vars(covered),
        before_um=before_um,
        after_um=after_um,
        stated_um=(gain.after_um[0], gain.after_um[2]),
        verdict=word(gain),
        alarm=bool(found.posterior.worse),
        seconds=seconds,
    ), found


def coverage(shop: Shop, found: Identification) -> Coverage:
    """Compare what is known of all errors with the truth."""
    posterior = found.posterior
    assert posterior is not None
    curves, squareness = [], []
    mean = Truth(shop.machine, {}, {})
    for name in posterior.names:
        if name in SQUARENESS:
            known = posterior.curve(name, np.zeros(1))
            squareness.append(bool(abs(known.value[0] - shop.truth.squareness[name]) <= 2.0 * known.u[0]))
            mean.squareness[name] = float(known.value[0])
            continue
        axis = shop.machine.axes["XYZ".index(name[2])]
        at = np.linspace(*axis.range_mm, POSITIONS)
        known = posterior.curve(name, at)
        mean.curves[name] = (at, known.value)
        curves.append(float(np.mean(np.abs(known.value - shop.truth.value(name, at)) <= 2.0 * known.u + 1e-12)))
    rng = np.random.default_rng(7)
    at = rng.uniform(shop.machine.lower_mm, shop.machine.upper_mm, (POINTS, 3))
    left, u = shop.truth.field(at) - mean.field(at), np.sqrt(posterior.field(at).variance)
    moves = u > 1e-9
    return Coverage(
        tuple(curves),
        tuple(squareness),
        float(np.mean(np.abs(left[moves]) <= 2.0 * u[moves])),
        float(np.sqrt(np.mean((left[moves] / u[moves]) ** 2))),
    )


def verdict(shop: Shop, found: Identification) -> tuple[ProbableGain, float, float]:
    """What is stated about tables that contain exactly the errors found, and the true error before and after, um rms."""
    machine = shop.machine
    along = [np.linspace(*axis.range_mm, GRID) for axis in machine.axes]
    at = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3)
    true, tables = shop.truth.field(at), Truth.of_table(machine, found.errors).field(at)
    assert found.posterior is not None
    gain = probable_gain(machine, found.errors, found.posterior, at, tables, np.zeros_like(tables))
    before_um, after_um = (1e3 * float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in (true, true - tables))
    return gain, before_um, after_um


def word(gain: ProbableGain) -> str:
    """The verdict in one word of :data:`VERDICTS`."""
    if gain.reason:
        return "refused"
    codes = {item.code for item in gain.reservations}
    if gain.only_after_new_setup or "doubtful" in codes:
        return "doubtful"
    return "reservations" if codes else "accepted"


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """One row of the table."""
    shares = [
        100.0 * np.mean(np.concatenate([np.atleast_1d(part) for part in parts]))
        for parts in zip(*((item.curves, item.squareness, item.field) for item in outcomes), strict=True)
    ]
    nrms = np.sqrt(np.mean([item.field_nrms**2 for item in outcomes]))
    before, after = (np.mean([getattr(item, key) for item in outcomes]) for key in ("before_um", "after_um"))
    stated, bound = np.mean([item.stated_um for item in outcomes], axis=0)
    counts = [sum(item.verdict == verdict for item in outcomes) for verdict in VERDICTS]
    worse = [sum(not item.better for item in outcomes if item.verdict == verdict) for verdict in VERDICTS[:2]]
    beyond = sum(item.after_um > item.stated_um[1] for item in outcomes)
    lost = sum(item.verdict == "refused" and item.after_um < 0.8 * item.before_um for item in outcomes)
    cells = (
        "/".join(f"{share:.0f}" for share in shares),
        f"{nrms:.2f}",
        f"{before:.1f}",
        f"{after:.1f}",
        f"{stated:.1f} ({bound:.1f})",
        "/".join(map(str, counts)),
        "/".join(map(str, worse)),
        f"{beyond}",
        f"{lost}",
        f"{sum(item.alarm for item in outcomes)}",
        f"{np.median([item.seconds for item in outcomes]):.2f}",
    )
    return f"{name:40s}" + "".join(f"{cell:>13s}" for cell in cells)


HEAD = ("coverage", "nrms", "before", "after", "stated", "acc/res/dbt/no", "worse", "beyond", "lost", "class", "s")


def measured(name: str, machines: int, *, family: str | None, size: float, seed: int) -> list[Outcome]:
    """The outcomes of one mixture on seeded machines; what a mixture does not determine at all is said and left out."""
    found = []
    for number in range(machines):
        shop = case(number, family=family, size=size, seed=seed)
        try:
            found.append(outcome(shop, name)[0])
        except CompgenError as error:
            print(f"{name}, machine {number}: {error}", file=sys.stderr)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mixtures", nargs="*", metavar="MIXTURE", help=f"of: {'; '.join(MIXTURES)}")
    parser.add_argument("--machines", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", choices=[*FAMILIES, "prior"], default=None, help="default: all five take turns")
    parser.add_argument("--size", type=float, default=1.0, help="size of the errors relative to class general")
    chosen = parser.parse_args()
    print(f"{'':40s}" + "".join(f"{title:>13s}" for title in HEAD))
    every: list[Outcome] = []
    for name in chosen.mixtures or MIXTURES:
        found = measured(name, chosen.machines, family=chosen.family, size=chosen.size, seed=chosen.seed)
        if found:
            print(row(name, found), flush=True)
        every += found
    if every:
        print(row("all", every))


if __name__ == "__main__":
    main()
