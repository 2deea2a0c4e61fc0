"""E = C P and the exact model at many points, against writing the result alone (python benchmarks/evaluate.py).

The peers compute the same field of the same machine (the example's true errors); how far each is from the plain sum
over C stands beside its time. ``np.fill`` and ``np.copyto`` write the result without computing anything: no method can
be much faster. All results go to arrays that exist already.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import timing
from scipy.interpolate import BSpline, make_interp_spline

from compgen import load_machine, read_errors
from compgen.data.names import ERROR_INDEX, error_named
from compgen.kinematics.exact_chain import exact_error, tip_position
from compgen.kinematics.first_order import coefficients, factor
from compgen.kinematics.kernel_switch import COMPILED, PLAIN, VARIABLE, has_numba
from compgen.kinematics.many_points import volumetric_error, volumetric_error_on_grid

ROOT = Path(__file__).resolve().parents[1]
MACHINE = load_machine(ROOT / "machines" / "zha-gantry.toml")
ERRORS = read_errors(ROOT / "examples" / "zha-gantry.truth.errors.csv")
TOOL_MM = np.array(MACHINE.tool_offset_mm)
Job = Callable[[], object]


def without_kernels(job: Job) -> Job:
    """Return the job as it runs where numba is not installed."""

    def run() -> object:
        with patch.dict(os.environ, {VARIABLE: PLAIN}):
            return job()

    return run


def by_interp(position_mm: np.ndarray, out: np.ndarray) -> None:
    """One np.interp per curve, one term of C after the other, all points at once."""
    values = ERRORS.at(position_mm)
    out[:] = 0.0
    for term in coefficients(MACHINE.chain, MACHINE.squareness_reference):
        if term.error in ERRORS.names:
            weight = term.sign * factor(term.lever, position_mm, TOOL_MM)
            out[:, term.output] += weight * values[:, ERROR_INDEX[term.error]]


def splines() -> list[tuple[BSpline, list[str]]]:
    """Vector-valued linear splines, one per axis (the curves of an axis have the same nodes here)."""
    found = []
    for axis in range(3):
        names = [name for name in ERRORS.curves if error_named(name).axis == axis]
        values = np.stack([ERRORS.curves[name].value for name in names], axis=1)
        found.append((make_interp_spline(ERRORS.curves[names[0]].position_mm, values, k=1), names))
    return found


def by_splines(per_axis: list[tuple[BSpline, list[str]]], position_mm: np.ndarray, out: np.ndarray) -> None:
    """One look-up per axis by scipy's BSpline, then the terms of C."""
    value: dict[str, np.ndarray | float] = {name: u[0] for name, u in ERRORS.squareness.items()}
    for axis, (spline, names) in enumerate(per_axis):
        value |= dict(zip(names, spline(position_mm[:, axis]).T, strict=True))
    out[:] = 0.0
    for term in coefficients(MACHINE.chain, MACHINE.squareness_reference):
        if term.error in value and (term.lever is None or term.lever < 3 or TOOL_MM[term.lever - 3] != 0.0):
            weight = term.sign if term.lever is None else term.sign * factor(term.lever, position_mm, TOOL_MM)
            out[:, term.output] += weight * value[term.error]


def deviations(jobs: dict[str, Job], out: np.ndarray, due: np.ndarray) -> None:
    """Print how far the results of the jobs are from what is due."""
    found = []
    for name, job in jobs.items():
        out[:] = np.nan
        job()
        found.append(f"{name} {np.abs(out - due).max():.0e} mm")
    print(f"  largest deviation: {', '.join(found)}")


def own_points(position_mm: np.ndarray, out: np.ndarray, compiled: bool) -> dict[str, Job]:
    """Ways of compgen for a list of points."""

    def job() -> object:
        return volumetric_error(MACHINE, ERRORS, position_mm, out=out)

    return {"compgen, numpy": without_kernels(job), **({"compgen, numba": job} if compiled else {})}


def points(count: int, runs: int, compiled: bool, peers: bool) -> None:
    """Compare lists of points."""
    position = np.random.default_rng(0).uniform(MACHINE.lower_mm, MACHINE.upper_mm, (count, 3))
    out, per_axis = np.empty_like(position), splines()
    jobs = own_points(position, out, compiled)
    if peers:
        jobs |= {
            "np.interp": lambda: by_interp(position, out),
            "BSpline k=1": lambda: by_splines(per_axis, position, out),
        }
    comparison = timing.alternate({"np.copyto": lambda: np.copyto(out, position), **jobs}, runs)
    timing.print_comparison(f"E = C P at {count:.3g} random points", comparison, ["np.copyto", *["np.interp"] * peers])
    if peers:
        due = np.empty_like(position)
        by_interp(position, due)
        deviations(jobs, out, due)


def grid(levels: int, runs: int, compiled: bool) -> None:
    """Compare full grids."""
    steps = [np.linspace(*axis.range_mm, levels) for axis in MACHINE.axes]
    out = np.empty((levels, levels, levels, 3))

    def job() -> object:
        return volumetric_error_on_grid(MACHINE, ERRORS, steps, out=out)

    jobs = {"compgen, numpy": without_kernels(job), **({"compgen, numba": job} if compiled else {})}
    comparison = timing.alternate({"np.fill": lambda: out.fill(1.0), **jobs}, runs)
    timing.print_comparison(f"E = C P on a grid of {levels}^3 = {levels**3:.3g} points", comparison, ["np.fill"])
    first = np.stack(np.meshgrid(*steps[1:], indexing="ij"), -1).reshape(-1, 2)
    position = np.column_stack([np.full(len(first), steps[0][0]), first])
    due = np.empty_like(position)
    by_interp(position, due)
    deviations(jobs, out[0], due.reshape(out[0].shape))


def exact(count: int, runs: int, compiled: bool) -> None:
    """Compare the exact model."""
    position = np.random.default_rng(0).uniform(MACHINE.lower_mm, MACHINE.upper_mm, (count, 3))
    out = np.empty_like(position)

    def whole_chain() -> None:
        out[:] = tip_position(MACHINE, ERRORS.at(position), position) - (position + TOOL_MM)

    def job() -> object:
        return exact_error(MACHINE, ERRORS, position, out=out)

    jobs: dict[str, Job] = {"compgen, numpy": without_kernels(job), **({"compgen, numba": job} if compiled else {})}
    comparison = timing.alternate({**jobs, "np.cross chain": whole_chain}, runs)
    timing.print_comparison(f"exact model at {count:.3g} random points", comparison, ["np.cross chain"])
    whole_chain()
    deviations(jobs, out, out.copy())


def main() -> None:
    """Print all comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7, help="alternating runs, at least 5 (default 7)")
    parser.add_argument("--large", action="store_true", help="also 1e8 points (6 GB of memory)")
    options = parser.parse_args()
    compiled = has_numba()
    if compiled:
        os.environ[VARIABLE] = COMPILED
    print(timing.machine_line())
    if not compiled:
        print("numba is not installed: rows of the compiled kernels are missing (pip install compgen[fast])")
    points(1_000_000, options.runs, compiled, peers=True)
    points(10_000_000, options.runs, compiled, peers=False)
    grid(100, options.runs, compiled)
    grid(216, options.runs, compiled)
    exact(200_000, options.runs, compiled)
    if options.large:
        points(100_000_000, max(5, options.runs - 2), compiled, peers=False)
        grid(464, max(5, options.runs - 2), compiled)


if __name__ == "__main__":
    main()
