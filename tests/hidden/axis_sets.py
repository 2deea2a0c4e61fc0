"""Hidden sessions of ISO 230-2 on one axis: a kind and a seed give the rows of a file and the key.

Five runs there and back of 5 to 11 targets. Kinds: ``null``, ``warmup``, ``backlash``, ``lost_motion``, ``step``,
``bad_run``, ``several`` (two or three of these), ``unlisted`` (an effect that no catalogue has), ``further`` (more of such,
each seed the next of ``FURTHER``). Nothing here knows how
compgen models any of them: a warm-up is a heat balance stepped from reading to reading, noise with a memory is stepped
likewise, a reversal is what stays behind after each turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

RUNS = 5
KINDS = ("null", "warmup", "backlash", "lost_motion", "step", "bad_run", "several", "unlisted", "further")
#: Kinds whose effect has no name.
NAMELESS = ("unlisted", "further")
NAMES = {
    "warmup": "warmup_drift",
    "backlash": "backlash_{axis}",
    "lost_motion": "lost_motion_{axis}",
    "step": "step_between_runs",
    "bad_run": "bad_run",
}
#: Effects of the kind ``further``.
FURTHER = (
    "the scatter grows", "the drift grows along the axis", "one direction drifts", "a jump that fades", "a drift that turns",
    "the reversal changes at once", "every run has its own scale", "slipping back", "a wave that moves from run to run",
)  # fmt: skip
#: Shares of the kinds in a benchmark of 300 sets; ``further`` is beside these.
SHARES = {
    "null": 60, "warmup": 50, "backlash": 35, "lost_motion": 35, "step": 30, "bad_run": 30, "several": 40, "unlisted": 20,
    "further": 90,
}  # fmt: skip


@dataclass(frozen=True)
class AxisSet:
    """Rows (position, direction, run, deviation in um) in the order of the file, and what is true.

    ``names`` are the right names; ``ratio`` is the RMS of each effect over the noise of a mean of five.
    """

    kind: str
    seed: int
    axis: str
    rows: list[tuple[float, int, int, float]]
    names: tuple[str, ...]
    ratio: tuple[float, ...]
    label: str
    sigma_um: float
    memory: float

    def write(self, folder: Path) -> Path:
        """Write the file that the command reads."""
        path = folder / f"{self.kind}-{self.seed}.axis.csv"
        text = "axis,position_mm,direction,run,deviation_um\n"
        text += "".join(f"{self.axis},{p:.6f},{d},{r},{v:.5f}\n" for p, d, r, v in self.rows)
        path.write_text(text)
        return path


class _Session:
    """The way of the axis: reading by reading in time."""

    def __init__(self, rng: np.random.Generator, targets_mm: np.ndarray) -> None:
        self.rng, self.targets = rng, targets_mm
        way = [(k, +1) for k in range(len(targets_mm))] + [(k, -1) for k in reversed(range(len(targets_mm)))]
        self.steps = [(k, d, run) for run in range(1, RUNS + 1) for k, d in way]
        self.target = np.array([k for k, _, _ in self.steps])
        self.sign = np.array([d for _, d, _ in self.steps])
        self.run = np.array([run for _, _, run in self.steps])
        self.share = np.linspace(0.0, 1.0, len(self.steps))  # of the session that has passed
        self.along = self.target / (len(targets_mm) - 1)  # 0 ... 1 along the axis

    def noise(self, sigma: float, memory: float) -> np.ndarray:
        kicks = self.rng.standard_normal(len(self.steps))
        values, now = np.empty(len(kicks)), kicks[0]
        for k, kick in enumerate(kicks):
            now = kick if k == 0 else memory * now + (1.0 - memory**2) ** 0.5 * kick
            values[k] = now
        return sigma * values

    def warmup(self) -> np.ndarray:
        """Heat flows in at a constant rate and out in proportion to what is there."""
        final, tau = self.rng.uniform(-50, 50), np.exp(self.rng.uniform(np.log(0.2), np.log(3.0)))
        fine = 400
        level, values = 0.0, [0.0]
        for k in range(1, len(self.steps)):
            for _ in range(fine):
                level += (final - level) * (self.share[k] - self.share[k - 1]) / fine / tau
            values.append(level)
        return np.array(values)

    def backlash(self) -> np.ndarray:
        return 0.5 * self.rng.uniform(0, 20) * self.rng.choice([-1, 1]) * self.sign

    def lost_motion(self) -> np.ndarray:
        """Reversal that grows from nothing at the fixed bearing, or that is worn in the middle."""
        size = self.rng.uniform(0, 20) * self.rng.choice([-1, 1])
        law = self.rng.integers(3)
        shape = (self.along, 1.0 - self.along, 4.0 * self.along * (1.0 - self.along))[law]
        return 0.5 * size * shape * self.sign

    def step(self) -> np.ndarray:
        at = self.rng.integers(2, 2 * RUNS)  # one-way run before which it happens
        return self.rng.uniform(2, 30) * self.rng.choice([-1, 1]) * (self._leg() >= at)

    def bad_run(self) -> np.ndarray:
        bad = self.rng.integers(1, RUNS + 1)
        off = (self.run == bad) * 1.0
        if self.rng.random() < 0.3:
            off = off * (self.sign == self.rng.choice([-1, 1]))
        return self.rng.uniform(2, 30) * self.rng.choice([-1, 1]) * off

    def _leg(self) -> np.ndarray:
        return 2 * (self.run - 1) + (self.sign < 0) + 1

    def unlisted(self) -> tuple[str, np.ndarray]:
        law = self.rng.integers(5)
        size = self.rng.uniform(4, 12)
        if law == 0:
            phase, waves = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(1.2, 3.0)
            return "air conditioning swings", size * np.sin(2 * np.pi * waves * self.share + phase)
        if law == 1:
            return "every run has its own zero", size * self.rng.standard_normal(RUNS)[self.run - 1]
        if law == 2:
            return "the scale grows", 2 * size * self.share * (self.along - 0.5) * 2
        if law == 3:
            return "the reversal grows", 2 * size * (self.share - 0.5) * self.sign
        own = self.rng.standard_normal(len(self.targets))
        return "every target creeps", 2 * size * self.share * (own - own.mean())[self.target]

    def further(self, law: str, noise: np.ndarray) -> np.ndarray:
        rng, size = self.rng, self.rng.uniform(4, 12) * self.rng.choice([-1, 1])
        levelling = -np.expm1(-self.share / rng.uniform(0.2, 2.0))
        if law == "the scatter grows":
            return noise * self.share * rng.uniform(3, 6)
        if law == "the drift grows along the axis":
            return 3 * size * levelling * self.along ** rng.integers(1, 3)
        if law == "one direction drifts":
            return 3 * size * levelling * (self.sign == rng.choice([-1, 1]))
        if law == "a jump that fades":
            since = self.share - rng.uniform(0.1, 0.7)
            return size * np.where(since >= 0, np.exp(-np.maximum(since, 0) / rng.uniform(0.05, 0.3)), 0.0)
        if law == "a drift that turns":
            turn = rng.uniform(0.3, 0.7)
            back = 1 - (self.share - turn) / (1 - turn) * rng.uniform(0.6, 1.2)
            return 1.7 * size * np.where(self.share < turn, self.share / turn, back)
        if law == "the reversal changes at once":
            return size * self.sign * (self._leg() >= rng.integers(3, 2 * RUNS - 1))
        if law == "every run has its own scale":
            return 2 * size * (self.along - 0.5) * rng.standard_normal(RUNS)[self.run - 1]
        if law == "slipping back":
            return 2 * size * ((self.share * rng.uniform(2, 5) + rng.uniform()) % 1)
        waves, phase = rng.uniform(1, 3), rng.uniform(0.7, 2.5)
        return size * np.sin(2 * np.pi * self.along * waves + self.run * phase)

    def shown(self, name: str, effect: np.ndarray) -> float:
        """RMS of what an effect does: against the mean of its target and direction, or half the reversal."""
        if name == "backlash":
            return float(np.abs(np.mean(effect * self.sign)))
        if name == "lost_motion":
            half = effect * self.sign
            return float(np.sqrt(np.mean((half - half.mean()) ** 2)))
        cell = 2 * self.target + (self.sign > 0)
        means = np.array([effect[cell == c].mean() for c in range(cell.max() + 1)])
        return float(np.sqrt(np.mean((effect - means[cell]) ** 2)))


def make(kind: str, seed: int) -> AxisSet:
    """Draw a set; the same kind and seed give the same one."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    count = int(rng.integers(5, 12))
    low, length = rng.uniform(-900, 100), rng.uniform(80, 700)
    targets = low + length * (np.arange(count) + 0.25 * rng.uniform(-1, 1, count)) / count
    session = _Session(rng, targets)
    sigma = float(np.exp(rng.uniform(np.log(0.3), np.log(5.0))))
    memory = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.2, 0.8))
    noise = session.noise(sigma, memory)
    values = (
        noise
        + (8 * rng.standard_normal() * (session.along - 0.5))
        + 5 * np.sin(rng.uniform(2, 9) * session.along + rng.uniform(0, 6))
    )
    hidden: list[str] = []
    if kind == "several":
        hidden = [str(name) for name in rng.choice(list(NAMES), int(rng.integers(2, 4)), replace=False)]
    elif kind in NAMES:
        hidden = [kind]
    label, ratio = "", []
    # five readings of one target are 2 x targets readings apart
    apart = np.abs(np.subtract.outer(np.arange(RUNS), np.arange(RUNS))) * 2 * count
    of_mean = sigma * float(np.sqrt(np.mean(memory**apart if memory else np.eye(RUNS))))
    for name in hidden:
        effect = getattr(session, name)()
        values = values + effect
        ratio.append(session.shown(name, effect) / of_mean)
    if kind == "unlisted":
        label, effect = session.unlisted()
        values = values + effect
        ratio.append(session.shown(label, effect) / of_mean)
    if kind == "further":
        label = FURTHER[seed % len(FURTHER)]
        effect = session.further(label, noise)
        values = values + effect
        ratio.append(session.shown(label, effect) / of_mean)
    axis = "XYZ"[int(rng.integers(3))]
    rows = [
        (float(targets[k]), int(d), int(run), float(v)) for (k, d, run), v in zip(session.steps, values, strict=True)
    ]
    if rng.random() < 0.7:  # most files list all runs in one direction first, or go by targets
        rows.sort(key=(lambda r: (-r[1], r[2], r[0])) if rng.random() < 0.5 else (lambda r: (r[0], r[1], r[2])))
    names = tuple(NAMES[name].format(axis=axis) for name in hidden)
    return AxisSet(kind, seed, axis, rows, names, tuple(ratio), label, sigma, memory)


def outcome(case: AxisSet, diagnosis: dict) -> str:
    """Judge: ``clean``, ``exact``, ``alias set`` (holds the truth), ``part``, ``unknown``, ``silent``, ``misnamed``."""
    effects = [item for item in diagnosis["effects"] if item["grade"] != "tentative"]
    names = sorted(item["name"] for item in effects)
    if case.kind == "null":
        return "clean" if diagnosis["verdict"] == "none" and not diagnosis["effects"] else "alarm"
    truth = sorted(case.names)
    if case.kind in NAMELESS:
        return "misnamed" if names else "unknown" if diagnosis["unknown"] else "silent"
    if names == truth:
        return "exact"
    sets = [{other["name"] for other in item["alias_set"]} | {item["name"]} for item in effects]
    if any(not own & set(truth) for own in sets):
        return "misnamed"
    if len(names) == len(truth) and set(truth) <= set().union(*sets):
        return "alias set"
    if names:
        return "part"
    return "unknown" if diagnosis["unknown"] else "silent"
