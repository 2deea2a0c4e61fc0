"""Identification against scipy and against one dsyrk on a ready Jacobian (python benchmarks/identify.py).

Every peer solves the same problem: the exact machine model, from the same closed-form start, to the same optimum; the
deviation from that optimum stands beside each time. ``identify`` is the whole call that a user makes from Python with
arrays in hand: checks, start, rank, outliers, covariance and tables included. The peers only solve.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import timing
from scipy.linalg.blas import dsyrk
from scipy.optimize import least_squares

from compgen.data.length_archive import write_archive
from compgen.data.lengths import Lengths
from compgen.data.machine import Axis, Chain, Machine
from compgen.identification import identify, identify_measurement, joint_covariance, read_measurement, sample_errors
from compgen.identification.adjust.grid_problem import grid_problem
from compgen.identification.adjust.starts import start_moments, station_start_from_moments
from compgen.identification.adjust.unknowns import ErrorParameters, error_parameters
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import exact_columns, tip_position
from compgen.kinematics.kernel_switch import COMPILED, PLAIN, VARIABLE, has_numba

STATIONS_MM = np.array(  # Zha & Zhang 2024, Table 6
    [
        [158.8075, -1456.6824, -349.7023],
        [-113.1165, -1671.7155, -349.3517],
        [-468.6489, -1563.1627, -349.4140],
        [-769.8987, -1599.5469, -208.9567],
    ]
)
NOISE_MM = 2e-4
MM_RAD_PER_UM_URAD = {"linear": 1e-3, "angular": 1e-6}


class Case:
    """A gantry with ``nodes`` nodes an axis, seen by four stations on a grid of ``levels`` positions an axis."""

    def __init__(self, levels: int, nodes: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        axes = tuple(Axis((-travel, 0.0), np.linspace(-travel, 0.0, nodes)) for travel in (800.0, 1000.0, 350.0))
        self.machine = Machine("gantry", Chain("WFYXZT"), axes)
        self.layout = error_parameters(self.machine, modelled_errors(self.machine))
        steps = [np.linspace(*axis.range_mm, levels) for axis in axes]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
        truth = rng.normal(0.0, 0.01, self.layout.size)
        for curve in self.layout.curves:
            if curve.error.kind == "angular":
                truth[curve.columns] *= 1e-3
        truth[-3:] = (2903e-6, -61e-6, 23e-6)
        tip = tip_position(self.machine, self.layout.values(truth, self._bases(grid)), grid)
        distance = np.linalg.norm(tip[:, None] - STATIONS_MM, axis=2)
        reading = distance - (400.0, 500.0, 600.0, 700.0) + NOISE_MM * rng.standard_normal(distance.shape)
        self.lengths = Lengths(
            stations=("LT1", "LT2", "LT3", "LT4"),
            station=np.tile(np.arange(4), len(grid)),
            point=[""] * reading.size,
            position_mm=np.repeat(grid, 4, axis=0),
            length_mm=reading.ravel(),
            metadata={"u_length_um": str(NOISE_MM * 1e3)},
        )

    def _bases(self, position_mm: np.ndarray) -> list[np.ndarray]:
        return [self.layout.basis(axis, position_mm[:, axis]) for axis in range(3)]

    def ours(self) -> np.ndarray:
        """The product's call; returns the node values of all curves and the squareness (mm, rad)."""
        found = identify(self.machine, self.lengths).errors
        values = [found.curves[curve.error.name].value for curve in self.layout.curves]
        return np.concatenate([*values, [found.squareness[name][0] for name in self.layout.squareness]])

    def ours_plain(self) -> np.ndarray:
        """The same without compiled loops."""
        with patch.dict(os.environ, {VARIABLE: PLAIN}):
            return self.ours()

    def peer(self) -> Peer:
        return Peer(self)


class Peer:
    """The same problem for scipy: residuals and analytic Jacobian, the model evaluated once for each pose."""

    def __init__(self, case: Case) -> None:
        self.case, lengths = case, case.lengths
        self.poses, pose = np.unique(lengths.position_mm, axis=0, return_inverse=True)
        self.pose = pose.ravel()
        self.bases = case._bases(self.poses)
        self.size = case.layout.size
        self.scale = np.ones(self.size + 16)
        for curve in case.layout.curves:
            if curve.error.kind == "angular":
                self.scale[curve.columns] = 1e-3
        self.scale[self.size - 3 : self.size] = 1e-3
        self.start = self._start() / self.scale

    def _start(self) -> np.ndarray:
        lengths, layout = self.case.lengths, self.case.layout
        problem = grid_problem(
            layout, lengths.position_mm, np.zeros(3), lengths.station, lengths.station, lengths.length_mm
        )
        sums, offset, centre, scale = start_moments(problem)
        found = [station_start_from_moments(sums[[k]], offset[[k]], centre, scale) for k in range(4)]
        stations = np.concatenate([item.position_mm for item in found])
        return np.concatenate([np.zeros(layout.size), stations, [item.dead_length_mm[0] for item in found]])

    def _sight(self, x: np.ndarray, tip: np.ndarray) -> np.ndarray:
        return tip[self.pose] - x[self.size : self.size + 12].reshape(4, 3)[self.case.lengths.station]

    def residual(self, scaled: np.ndarray) -> np.ndarray:
        x = scaled * self.scale
        values = self.case.layout.values(x[: self.size], self.bases)
        tip = tip_position(self.case.machine, values, self.poses)
        lengths = self.case.lengths
        distance = np.linalg.norm(self._sight(x, tip), axis=1)
        return distance - x[self.size + 12 :][lengths.station] - lengths.length_mm

    def jacobian(self, scaled: np.ndarray) -> np.ndarray:
        x = scaled * self.scale
        layout, lengths = self.case.layout, self.case.lengths
        values = layout.values(x[: self.size], self.bases)
        tip, columns = exact_columns(self.case.machine, values, self.poses)
        sight = self._sight(x, tip)
        unit = sight / np.linalg.norm(sight, axis=1)[:, None]
        rows = np.arange(len(lengths))
        matrix = np.zeros((len(lengths), self.size + 16))
        matrix[:, : self.size] = np.einsum("na,nak->nk", unit, layout.design(columns, self.bases)[self.pose])
        for axis in range(3):
            matrix[rows, self.size + 3 * lengths.station + axis] = -unit[:, axis]
        matrix[rows, self.size + 12 + lengths.station] = -1.0
        matrix *= self.scale
        return matrix

    def solve(self, method: str) -> np.ndarray:
        options = {"x_scale": "jac"} if method == "trf" else {}
        found = least_squares(
            self.residual, self.start, self.jacobian, method=method, xtol=1e-14, ftol=1e-14, gtol=1e-14, **options
        )
        x = found.x * self.scale
        values = [curve.free @ x[curve.columns] for curve in self.case.layout.curves]
        return np.concatenate([*values, x[self.size - 3 : self.size]])


def deviation_um(layout: ErrorParameters, found: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference of two results, in um and urad."""
    count = [len(curve.nodes_mm) for curve in layout.curves]
    unit = np.concatenate(
        [np.full(n, MM_RAD_PER_UM_URAD[curve.error.kind]) for n, curve in zip(count, layout.curves, strict=True)]
        + [np.full(3, 1e-6)]
    )
    return float(np.max(np.abs(found - reference) / unit))


def compare(levels: int, nodes: int, runs: int, methods: tuple[str, ...], clock: timing.Clock) -> None:
    """Time one case and print it."""
    case = Case(levels, nodes)
    peer = case.peer()
    reference = peer.solve("trf")
    ready = np.asfortranarray(peer.jacobian(peer.start))
    case.ours()  # loads the compiled loops
    functions = {"identify": case.ours, "identify, plain": case.ours_plain}
    functions |= {f"scipy {method}, analytic": (lambda m=method: peer.solve(m)) for method in methods}
    functions["one dsyrk on a ready J"] = lambda: dsyrk(1.0, ready, trans=1)
    comparison = timing.alternate(functions, runs, clock)
    title = f"{len(case.lengths)} lengths x {peer.size + 16} unknowns"
    timing.print_comparison(title, comparison, references=("identify",))
    print(
        f"  deviation of identify from scipy's optimum: {deviation_um(case.layout, case.ours(), reference):.1e} um, urad"
    )


def million(clock: timing.Clock) -> None:
    """1e6 lengths, everything included, against a dsyrk of that size measured in blocks."""
    case = Case(63, 11)
    size, count = case.layout.size + 16, len(case.lengths)
    block = np.asfortranarray(np.random.default_rng(0).normal(size=(20_000, size)))
    with timing.one_thread():
        case.ours()
        ours, syrk = [], []
        for _ in range(5):
            ours.append(timing.seconds(case.ours, 1, clock))
            syrk.append(timing.seconds(lambda: dsyrk(1.0, block, trans=1), 5, clock) / len(block) * count)
    ratios = np.array(ours) / np.array(syrk)
    print(f"\n{count} lengths x {size} unknowns")
    print(f"  identify {timing.scaled(float(np.median(ours)))}, dsyrk {timing.scaled(float(np.median(syrk)))}")
    print(f"  ratio {np.median(ratios):.3g} ({ratios.min():.3g}-{ratios.max():.3g})")


def archive(count: int = 10_000_000) -> None:
    """Readings on the fly from a ``*.lengths.npz`` file, four stations at each stop: time, processor time, peak memory."""
    case, stops = Case(3, 11), count // 4
    rng = np.random.default_rng(1)
    truth = rng.normal(0.0, 1e-5, case.layout.size)
    truth[-3:] = (2903e-6, -61e-6, 23e-6)

    def parts() -> Iterator[dict[str, np.ndarray]]:
        for first in range(0, stops, 50_000):
            time_s = np.arange(first, min(first + 50_000, stops)) / stops * 2e3
            waves = [np.sin(time_s), np.sin(3.1 * time_s), np.sin(0.73 * time_s)]
            position = np.stack(
                [0.5 * t * (w - 1.0) for t, w in zip((800.0, 1000.0, 350.0), waves, strict=True)], axis=1
            )
            tip = tip_position(case.machine, case.layout.values(truth, case._bases(position)), position)
            distance = np.linalg.norm(tip[:, None] - STATIONS_MM, axis=2)
            length = distance - (400.0, 500.0, 600.0, 700.0) + NOISE_MM * rng.standard_normal(distance.shape)
            columns = {f"{axis}_mm": position[:, k].repeat(4) for k, axis in enumerate("xyz")}
            yield {
                "station": np.tile(np.arange(4, dtype=np.int16), len(time_s)),
                **columns,
                "length_mm": length.ravel(),
            }

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fly.lengths.npz"
        write_archive(path, ["LT1", "LT2", "LT3", "LT4"], parts(), {"u_length_um": NOISE_MM * 1e3})
        print(f"\n{count} lengths from an archive of {path.stat().st_size / 1e6:.0f} MB")
        for run in range(3):
            begun, worked = time.perf_counter(), time.process_time()
            found = identify_measurement(case.machine, read_measurement([path]))
            took, worked = time.perf_counter() - begun, time.process_time() - worked
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            what = "with compilation, " if run == 0 else ""
            print(
                f"  {what}{took:.2f} s, processor time {worked:.2f} s, peak memory {peak:.0f} MB, {found.iterations} passes"
            )


def sampling() -> None:
    """10000 draws of all errors from the covariance, against identifying as often with scipy."""
    case = Case(11, 11)
    found = identify(case.machine, case.lengths)
    peer = case.peer()
    with timing.one_thread():
        start = time.perf_counter()
        peer.solve("trf")
        once = time.perf_counter() - start
        sample_errors(joint_covariance(found), 100)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            sample_errors(joint_covariance(found), 10_000)
            times.append(time.perf_counter() - start)
    median = float(np.median(times))
    print(
        f"\n10000 samples of all errors: {timing.scaled(median)}; 10000 solutions by scipy trf: {10_000 * once:.0f} s"
    )
    print(f"  ratio {10_000 * once / median:.0f}")


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5, help="rounds, at least 5")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of time: for a busy computer")
    parser.add_argument("--archive", action="store_true", help="1e7 lengths from a file, nothing else")
    parser.add_argument("--quick", action="store_true", help="the small case only")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu else time.perf_counter
    print(timing.machine_line())
    if arguments.archive:
        archive()
        return
    if has_numba():
        os.environ[VARIABLE] = COMPILED
    print("identify with the compiled loops of COMPGEN_KERNELS=compiled:", has_numba())
    compare(11, 11, arguments.runs, ("trf", "lm"), clock)
    if not arguments.quick:
        compare(21, 21, arguments.runs, ("trf",), clock)
        million(clock)
    sampling()


if __name__ == "__main__":
    main()
