"""A measuring session: lines, repeats, loads, set-ups, directions, feeds, times and temperatures. No errors yet."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from hidden.kinematics import HiddenMachine


@dataclass(frozen=True)
class Plan:
    """What is measured.

    ``in_turn``: one tracer goes from station to station. ``approach``: ``"controlled"`` gives repeats the same latched
    directions, ``"natural"`` takes them from the way there, ``"unknown"`` leaves those of resting axes 0. ``on_pitch``: all
    positions are multiples of the pitch. ``slanted``: all lines run parallel to the four body diagonals.
    """

    lines: int = 24
    axis_only: bool = False
    slanted: bool = False
    points: int = 6
    repeats: int = 2
    loads_kg: tuple[float, ...] = (0.0, 250.0)
    feeds_mm_min: tuple[float, ...] = (600.0, 2000.0, 5000.0)
    setups: int = 2
    stations: int = 4
    in_turn: bool = False
    approach: str = "controlled"
    on_pitch: bool = False
    sensor_noise_k: float = 0.01


@dataclass(frozen=True)
class Session:
    """P stops in the order of time and n readings of them; arrays of stops unless said otherwise.

    ``velocity``: mm/s with sign. ``k``: number of the stop in its run. ``temp``: true temperatures by channel.
    ``reading_stop``, ``reading_station`` (n,): which stop each reading is of, and by which station.
    """

    machine: HiddenMachine
    plan: Plan
    q: np.ndarray
    tool: np.ndarray
    direction: np.ndarray
    velocity: np.ndarray
    feed: np.ndarray
    load: np.ndarray
    setup: np.ndarray
    line: np.ndarray
    repeat: np.ndarray
    run: np.ndarray
    block: np.ndarray
    k: np.ndarray
    t: np.ndarray
    temp: dict[str, np.ndarray]
    station_names: tuple[str, ...]
    station_mm: np.ndarray
    reading_stop: np.ndarray
    reading_station: np.ndarray
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def s(self) -> np.ndarray:
        """Positions over the travels, (P, 3), -1 ... 1."""
        return np.column_stack([self.machine.unit(a, self.q[:, a]) for a in range(3)])

    def beams(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions (n, 3) from station to target and ranges (n,), nominal."""
        line = (self.q + self.tool)[self.reading_stop] - self.station_mm[self.reading_station]
        size = np.linalg.norm(line, axis=1)
        return line / size[:, None], size


def draw_lines(machine: HiddenMachine, plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """Start and end of each line, (lines, 2, 3)."""
    if plan.slanted:
        return slanted_lines(machine, plan, rng)
    low, high = machine.range_mm.T
    axis_lines = plan.lines if plan.axis_only else round(plan.lines * 15 / 24)
    found = []
    for k in range(axis_lines):
        ends = np.tile(low + rng.uniform(0.0, 1.0, 3) * (high - low), (2, 1))
        ends[:, k % 3] = low[k % 3], high[k % 3]
        found.append(ends)
    for k in range(plan.lines - axis_lines):
        corner = np.array([(k >> bit) & 1 for bit in range(3)], dtype=float)
        if k >= 4:
            corner = np.where(rng.random(3) < 0.5, corner, rng.uniform(0.0, 0.4, 3))
        found.append(np.stack([low + corner * (high - low), low + (1.0 - corner) * (high - low)]))
    return np.array(found)


def slanted_lines(machine: HiddenMachine, plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """Lines parallel to the body diagonals, half to wholly as long: every axis has one speed at one feed."""
    low, high = machine.range_mm.T
    found = []
    for k in range(plan.lines):
        slope = np.where([(k >> bit) & 1 for bit in range(3)], -1.0, 1.0)
        share = rng.uniform(0.4, 1.0)
        middle = rng.uniform(share - 1.0, 1.0 - share, 3)
        ends = np.stack([middle - share * slope, middle + share * slope])
        found.append(low + (ends + 1.0) / 2.0 * (high - low))
    return np.array(found)


def stops_of_line(machine: HiddenMachine, plan: Plan, ends: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Jittered stops on a line, (points, 3)."""
    part = np.linspace(0.03, 0.97, plan.points) + rng.uniform(-0.08, 0.08, plan.points)
    stops = ends[0] + np.sort(np.clip(part, 0.0, 1.0))[:, None] * (ends[1] - ends[0])
    if plan.on_pitch:
        low, high = machine.range_mm.T
        inner = np.ceil(low / machine.pitch_mm) * machine.pitch_mm, np.floor(high / machine.pitch_mm) * machine.pitch_mm
        stops = np.clip(np.round(stops / machine.pitch_mm) * machine.pitch_mm, *inner)
    return np.round(stops, 4)


def draw_runs(machine: HiddenMachine, plan: Plan, rng: np.random.Generator) -> list[dict]:
    """Every run of one station group with its conditions, in the order in which it is measured."""
    lines = [stops_of_line(machine, plan, ends, rng) for ends in draw_lines(machine, plan, rng)]
    ordered = []
    for setup in range(plan.setups):
        runs = []
        for number, stops in enumerate(lines):
            for load in plan.loads_kg:
                sense = rng.choice([-1, 1])
                condition = {
                    "line": number + 1,
                    "stops": stops[::sense],
                    "load": load,
                    "setup": setup + 1,
                    "feed": float(rng.choice(plan.feeds_mm_min)),
                    "rest": rng.choice([-1.0, 1.0], 3),
                }
                runs += [condition | {"repeat": r + 1} for r in range(plan.repeats)]
        ordered += [runs[k] for k in rng.permutation(len(runs))]
    return ordered


def draw_tools(plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """Tool offset of each set-up, (setups, 3): the first straight, later ones and an only one sideways."""
    first = [0.0 if plan.setups > 1 else 85.0, 0.0 if plan.setups > 1 else -70.0, -float(rng.uniform(60.0, 160.0))]
    rest = [
        [float(rng.choice([-1, 1]) * rng.uniform(60, 140)) for _ in range(2)] + [-float(rng.uniform(150.0, 260.0))]
        for _ in range(plan.setups - 1)
    ]
    return np.round(np.array([first, *rest]), 3)


def draw_stations(machine: HiddenMachine, plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """Stations around the volume at different heights, (S, 3)."""
    low, high = machine.range_mm.T
    size = high - low
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0), (0.5, 1)]
    found = []
    for k in range(plan.stations):
        side = np.array(corners[k], dtype=float)
        place = low[:2] + side * size[:2] + (side - 0.5) * rng.uniform(160.0, 420.0, 2)
        height = low[2] - 150.0 + (0.1 + 0.9 * (k % 2)) * size[2] * rng.uniform(0.6, 1.1)
        found.append([*place, height])
    return np.array(found)


def first_order(time_s: np.ndarray, drive: np.ndarray, tau_s: float) -> np.ndarray:
    """Response of a first-order body to ``drive`` (n,) at ``time_s`` (n,), from rest."""
    out = np.zeros(len(time_s))
    for k in range(1, len(time_s)):
        share = -np.expm1(-(time_s[k] - time_s[k - 1]) / tau_s)
        out[k] = out[k - 1] + share * (drive[k - 1] - out[k - 1])
    return out


def telegraph(time_s: np.ndarray, mean_s: float, rng: np.random.Generator) -> np.ndarray:
    """On/off cycles (n,) with random times between the changes."""
    changes = np.cumsum(rng.uniform(0.5, 1.5, 400) * mean_s)
    return (np.searchsorted(changes, time_s - time_s[0]) + rng.integers(2)) % 2 * 1.0


def temperatures(time_s: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Temperatures of axes, spindle, air and column over time."""
    span = float(np.ptp(time_s))
    hour = (time_s - time_s[0]) / 3600.0
    air = 0.8 * np.sin(2 * np.pi * hour / rng.uniform(1.5, 5.0) + rng.uniform(0, 6))
    air = 20.0 + air + first_order(time_s, telegraph(time_s, span / 9, rng), 900.0) + 0.05 * hour
    found = {"ambient": air}
    for name, rise in (
        ("x", 4.0),
        ("y", 4.0),
        ("z", 4.0),
        ("spindle", 12.0),
        ("column_front", 2.5),
        ("column_rear", 2.5),
    ):
        cycle = telegraph(time_s, span / rng.uniform(7, 16), rng)
        slow = first_order(time_s, air - 20.0, 5400.0)
        found[name] = 20.0 + slow + rise * first_order(time_s, cycle, rng.uniform(900.0, 3000.0))
    return found


def latched(q: np.ndarray, rest: np.ndarray, run: np.ndarray, how: str) -> np.ndarray:
    """Last direction of travel of each axis at each stop, (P, 3); ``rest`` (P, 3) is how a controlled approach ends."""
    rest = rest if how == "controlled" else np.zeros_like(rest)
    found = np.empty_like(q)
    state = np.sign(q[min(1, len(q) - 1)] - q[0])
    before = q[0]
    for k, here in enumerate(q):
        new_run = k == 0 or run[k] != run[k - 1]
        if how != "natural" and new_run:
            ahead = q[k + 1] - here if k + 1 < len(q) else np.zeros(3)
            state = np.where(np.abs(ahead) > 1e-6, np.sign(ahead), rest[k])
        else:
            moved = here - before
            state = np.where(np.abs(moved) > 1e-6, np.sign(moved), state)
        found[k], before = state, here
    return found


def draw_session(machine: HiddenMachine, plan: Plan, names: tuple[str, ...], rng: np.random.Generator) -> Session:
    """Draw everything that is chosen or logged in a measurement."""
    turns = range(plan.stations) if plan.in_turn else range(1)
    runs = [(turn, run) for turn in turns for run in draw_runs(machine, plan, rng)]
    per = plan.points
    count = len(runs) * per
    run_of = np.repeat(np.arange(len(runs)), per)

    def of_run(key: str) -> np.ndarray:
        return np.repeat(np.array([run[key] for _, run in runs]), per, axis=0)

    gaps = rng.uniform(8.0, 12.0, count)
    gaps[::per] += rng.uniform(20.0, 60.0, len(runs))
    t = np.cumsum(gaps)
    q = np.concatenate([run["stops"] for _, run in runs])
    along = np.concatenate([np.tile(run["stops"][-1] - run["stops"][0], (per, 1)) for _, run in runs])
    feed, setup = of_run("feed"), of_run("setup")
    velocity = feed[:, None] / 60.0 * along / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    turn = np.repeat([turn for turn, _ in runs], per)
    stop, station = np.divmod(np.arange(count * plan.stations), plan.stations)
    if plan.in_turn:
        stop, station = np.arange(count), turn
    return Session(
        machine=machine,
        plan=plan,
        q=q,
        tool=draw_tools(plan, rng)[setup - 1],
        direction=latched(q, of_run("rest"), run_of, plan.approach),
        velocity=velocity,
        feed=feed,
        load=of_run("load"),
        setup=setup,
        line=of_run("line"),
        repeat=of_run("repeat"),
        run=run_of + 1,
        block=1 + np.arange(count) * 4 // count,
        k=np.tile(np.arange(per), len(runs)),
        t=t,
        temp=temperatures(t, rng),
        station_names=names[: plan.stations],
        station_mm=draw_stations(machine, plan, rng),
        reading_stop=stop,
        reading_station=station,
    )
