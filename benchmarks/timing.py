"""Timing of alternatives side by side: alternating runs in one process on one thread, medians with spread.

Absolute times say little on a shared computer; ratios of runs that took turns say more. Beside the functions each
round times a fixed matrix product (dgemm). Where that spreads by more than 20 %, the computer was busy with other
things and the run is invalid.
"""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path

import numpy as np
from threadpoolctl import ThreadpoolController

#: A run is invalid if the times of the matrix product spread by more than this share of their median.
ALLOWED_SPREAD = 0.20
#: A sample repeats a short function until it lasts about this long.
SHORTEST_SAMPLE_S = 0.02
_DGEMM_SIZE = 384
Clock = Callable[[], float]


@dataclass(frozen=True)
class Timing:
    """Times in s of one function, one per round; a sample is the mean of the calls that it took."""

    name: str
    samples_s: tuple[float, ...]

    @property
    def median_s(self) -> float:
        """Median over the rounds."""
        return float(np.median(self.samples_s))

    @property
    def min_s(self) -> float:
        """Shortest round."""
        return min(self.samples_s)

    @property
    def max_s(self) -> float:
        """Longest round."""
        return max(self.samples_s)

    @property
    def spread(self) -> float:
        """Longest minus shortest as a share of the median."""
        return (self.max_s - self.min_s) / self.median_s


@dataclass(frozen=True)
class Comparison:
    """What :func:`alternate` measured; ``dgemm`` is the fixed matrix product of the same rounds."""

    timings: tuple[Timing, ...]
    dgemm: Timing

    def __getitem__(self, name: str) -> Timing:
        """Return the timing of one function."""
        return next(timing for timing in self.timings if timing.name == name)

    @property
    def valid(self) -> bool:
        """Whether the computer was quiet enough."""
        return self.dgemm.spread <= ALLOWED_SPREAD

    def ratio(self, name: str, reference: str) -> tuple[float, float, float]:
        """Time of ``name`` by that of ``reference``: median, least and largest of the ratios of each round."""
        ratios = np.array(self[name].samples_s) / np.array(self[reference].samples_s)
        return float(np.median(ratios)), float(ratios.min()), float(ratios.max())


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread."""
    with ThreadpoolController().limit(limits=1):
        yield


@cache
def _dgemm_operands() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(1)
    left, right = generator.normal(size=(2, _DGEMM_SIZE, _DGEMM_SIZE))
    return left, right, np.empty((_DGEMM_SIZE, _DGEMM_SIZE))


def dgemm() -> None:
    """Multiply two fixed matrices: the reference for the state of the computer."""
    left, right, product = _dgemm_operands()
    np.matmul(left, right, out=product)


def seconds(function: Callable[[], object], calls: int = 1, clock: Clock = time.perf_counter) -> float:
    """Time of one of ``calls`` calls in a row, s."""
    start = clock()
    for _ in range(calls):
        function()
    return (clock() - start) / calls


def _calls_for(function: Callable[[], object]) -> int:
    """Calls that make up one sample; the first call of all (compilation, page faults) is not counted."""
    function()
    once = seconds(function)
    return max(1, round(SHORTEST_SAMPLE_S / max(once, 1e-9)))


def alternate(
    functions: Mapping[str, Callable[[], object]], runs: int = 7, clock: Clock = time.perf_counter
) -> Comparison:
    """Time functions without arguments in turn, ``runs`` rounds (at least 5), on one thread.

    With ``time.process_time`` as ``clock``, time that other programs take does not count.
    """
    if runs < 5:
        raise ValueError(f"{runs} runs give no median with a spread; at least 5 are needed")
    every = {**functions, "dgemm": dgemm}
    samples: dict[str, list[float]] = {name: [] for name in every}
    with one_thread():
        calls = {name: _calls_for(function) for name, function in every.items()}
        for _ in range(runs):
            for name, function in every.items():
                samples[name].append(seconds(function, calls[name], clock))
    timings = {name: Timing(name, tuple(times)) for name, times in samples.items()}
    reference = timings.pop("dgemm")
    return Comparison(tuple(timings.values()), reference)


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown processor"
    )


def _version(package: str) -> str:
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"no {package}"


def machine_line(packages: Sequence[str] = ("numpy", "scipy", "numba")) -> str:
    """Return one line: processor, cores, versions of Python and of ``packages``, threads used."""
    versions = ", ".join(_version(package) for package in packages)
    python = ".".join(map(str, sys.version_info[:3]))
    return f"{processor()}, {cpu_count()} cores; Python {python}, {versions}; one thread"


def scaled(seconds: float) -> str:
    """Return a time with three digits and a fitting unit.

    >>> scaled(0.01234), scaled(2e-6)
    ('12.3 ms', '2 us')
    """
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if seconds * factor >= 1.0:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def ratio_text(comparison: Comparison, name: str, reference: str) -> str:
    """Return ``median (min-max)`` of a ratio."""
    middle, low, high = comparison.ratio(name, reference)
    return f"{middle:.3g} ({low:.3g}-{high:.3g})"


def rows_of(comparison: Comparison, references: Sequence[str] = ()) -> list[list[str]]:
    """Return a table: one row per function with median, min-max, and its ratio to each of ``references``."""
    rows = [["", "median", "min-max", *(f"x {reference}" for reference in references)]]
    for timing in comparison.timings:
        ratios = [ratio_text(comparison, timing.name, reference) for reference in references]
        rows.append([timing.name, scaled(timing.median_s), f"{scaled(timing.min_s)}-{scaled(timing.max_s)}", *ratios])
    return rows


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of text; the first is the head, the first column is aligned left, the others right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        print("  " + "   ".join(cells).rstrip())


def print_comparison(title: str, comparison: Comparison, references: Sequence[str] = ()) -> None:
    """Print one comparison with its verdict on the state of the computer."""
    spread = f"dgemm spread {100 * comparison.dgemm.spread:.0f} %"
    print(f"\n{title}   [{spread}{'' if comparison.valid else ': INVALID, the computer was busy; run again'}]")
    print_table(rows_of(comparison, references))
