"""Three simulated machines: their files, what is true of them in each month, and what a tracer reads at them.

A  its squareness EC0Y drifts slowly
B  a crash in July shifts its axis Y: a longer scale and a step in squareness
C  stands in a hall without heating: its scales follow the temperature, which the measurements log
"""

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

import compgen
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.lengths import Points, format_lengths
from compgen.fleet.job import Job
from compgen.fleet.store import open_store
from compgen.kinematics.exact_chain import exact_error, tip_position
from compgen.kinematics.many_points import volume_grid
from compgen.simulation import RandomErrors, Scenario, TruthPlan, draw_truth
from compgen.tables import ReadTables, read_tables

MONTHS = 12
BEGIN = datetime(2026, 1, 5, 6, 0, tzinfo=UTC)
CRASH = datetime(2026, 6, 20, 15, 0, tzinfo=UTC)
DAYS_A_MONTH = 30.4375
UM, URAD = 1e-3, 1e-6

#: The truth that the history has to find.
EC0Y_URAD_A_MONTH = 1.5
CRASH_EYY_UM, CRASH_EC0Y_URAD = 12.0, 20.0
UM_A_METRE_KELVIN = {"X": 6.0, "Y": 5.0, "Z": 4.0}
SEASON_K = 6.0

NAMES = ("mill-a", "mill-b", "mill-c")
CONTROL = {"mill-a": "siemens-cec", "mill-b": "isg-csv", "mill-c": "siemens-cec"}

MACHINE = """\
name = "{name}"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [0.0, 0.0, 0.0]
[axes.X]
range_mm = [-400.0, 0.0]
nodes = 5
[axes.Y]
range_mm = [-300.0, 0.0]
nodes = 4
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 4
[controllers.siemens-cec]
sign = "error"
mult_mode = "S1"
# whatever moves the scales asks for new tables, also the hall: without this line a season of 2 K is expected of it
[repeatability]
season_k = 0.0
"""

JOB = """\
store = "recal.sqlite"

[defaults]
machine = "machines/{name}.toml"
inbox = "inbox/{name}"
out = "tables/{name}"
measured_with = "active"
approval = "manual"
schedule = "0 8 5 * *"

[defaults.policy]
max_age_days = 30
temperature_c = [18.0, 22.0]
max_change_um = 8.0

[defaults.tolerances]
EC0Y_urad = 10.0
volume_um = 5.0

[machines.mill-a]
controllers = ["siemens-cec"]

[machines.mill-b]
controllers = ["isg-csv"]

[machines.mill-c]
controllers = ["siemens-cec"]
[machines.mill-c.policy]
temperature_c = [16.0, 24.0]
max_change_um = 30.0
[machines.mill-c.tolerances]
EXX_um = 10.0
"""

SCENARIO = """\
name = "{name}"
seed = {seed}
[errors]
file = "{name}.errors.csv"
[instrument]
type = "laser-tracer"
noise_um = 0.15
noise_um_per_m = 0.2
[[instrument.stations]]
name = "S1"
position_mm = [-520.0, -410.0, -420.0]
dead_length_mm = 151.25
[[instrument.stations]]
name = "S2"
position_mm = [130.0, -390.0, -405.0]
dead_length_mm = 152.25
[[instrument.stations]]
name = "S3"
position_mm = [110.0, 110.0, -415.0]
dead_length_mm = 153.25
[[instrument.stations]]
name = "S4"
position_mm = [-500.0, 130.0, -90.0]
dead_length_mm = 154.25
[trajectory]
type = "grid"
runs = "once"
"""
SCALE = '[[effects]]\nname = "thermal_scale_{axis}"\nc_um_per_m_k = {c}\nreference_c = 20.0\n'
CHANNEL = "[temperatures.{name}]\nbase_c = {base:.3f}\nramp_k_per_h = 0.1\n"


def day_of(month: int) -> datetime:
    """When the machines are measured in a month, 0 for January 2026."""
    return BEGIN.replace(month=month + 1)


def months_since_begin(at: datetime) -> float:
    return (at - BEGIN) / timedelta(days=DAYS_A_MONTH)


@dataclass(frozen=True)
class Factory:
    """Folder and seed of one simulated year."""

    folder: Path
    seed: int = 1

    def write(self) -> Path:
        """Write machine files and job file; return the path of the latter."""
        for name in NAMES:
            for part in ("machines", "scenarios", "reports"):
                (self.folder / part).mkdir(parents=True, exist_ok=True)
            (self.folder / "inbox" / name).mkdir(parents=True, exist_ok=True)
            (self.folder / "machines" / f"{name}.toml").write_text(MACHINE.format(name=name))
        (self.folder / "recal.toml").write_text(JOB)
        return self.folder / "recal.toml"

    def machine(self, name: str) -> compgen.Machine:
        return compgen.load_machine(str(self.folder / "machines" / f"{name}.toml"))

    def temperature_c(self, name: str, at: datetime) -> float:
        """Temperature of a hall: C is cold in winter, the others are kept at 20 degC."""
        noise = np.random.default_rng([self.seed, NAMES.index(name), at.toordinal()]).normal()
        if name != "mill-c":
            return 20.0 + 0.1 * noise
        return 20.0 - SEASON_K * float(np.cos(2 * np.pi * months_since_begin(at) / MONTHS)) + 0.5 * noise

    def truth(self, name: str, at: datetime) -> ErrorTable:
        """True errors of a machine at 20 degC, mm and rad."""
        small = RandomErrors((6 * UM, 12 * UM), (8 * URAD, 16 * URAD), (15 * URAD, 30 * URAD))
        seeds = np.random.SeedSequence([self.seed, NAMES.index(name)])
        table = draw_truth(TruthPlan(random=small), self.machine(name), seeds)
        curves, squareness = dict(table.curves), dict(table.squareness)
        moved = 0.0
        if name == "mill-a":
            moved = EC0Y_URAD_A_MONTH * months_since_begin(at)
        if name == "mill-b" and at > CRASH:
            moved, eyy = CRASH_EC0Y_URAD, curves["EYY"]
            share = eyy.position_mm / np.ptp(eyy.position_mm)
            curves["EYY"] = replace(eyy, value=eyy.value + CRASH_EYY_UM * UM * share)
        value, u = squareness["EC0Y"]
        squareness["EC0Y"] = (value + moved * URAD, u)
        return ErrorTable(curves, squareness)

    def warm_truth(self, name: str, at: datetime) -> ErrorTable:
        """True errors at the temperature of that day, when the scales of C have grown."""
        table = self.truth(name, at)
        if name != "mill-c":
            return table
        curves = dict(table.curves)
        for axis, c in UM_A_METRE_KELVIN.items():
            curve = curves[f"E{axis}{axis}"]
            growth = c * 1e-6 * (self.temperature_c(name, at) - 20.0) * curve.position_mm
            curves[f"E{axis}{axis}"] = replace(curve, value=curve.value + growth)
        return ErrorTable(curves, table.squareness)

    def scenario(self, name: str, at: datetime, part: str = "") -> Scenario:
        """Write the scenario of one measurement, which `volcomp simulate` reads as well, and return it."""
        title = f"{name}-{at:%Y-%m-%d}{part}"
        seed = [self.seed, NAMES.index(name), at.toordinal(), len(part)]
        number = int(np.random.SeedSequence(seed).generate_state(1)[0])
        text = SCENARIO.format(name=title, seed=number)
        base = self.temperature_c(name, at)
        channels = ("ambient",)
        if name == "mill-c":
            channels = ("x", "y", "z")
            text += "".join(SCALE.format(axis=axis, c=c) for axis, c in UM_A_METRE_KELVIN.items())
        text += "".join(CHANNEL.format(name=channel, base=base) for channel in channels)
        (self.folder / "scenarios" / f"{title}.errors.csv").write_text(format_errors(self.truth(name, at)))
        path = self.folder / "scenarios" / f"{title}.scenario.toml"
        path.write_text(text)
        return compgen.read_scenario(path)

    def measure(
        self, job: Job, name: str, at: datetime, *, bare: bool = False, part: str = "", says: dict | None = None
    ) -> Path:
        """Measure a machine as it is then, with the tables that are in its control; return the file in the inbox.

        ``says`` replaces what the file says about time and tables.
        """
        machine, tables = self.machine(name), None if bare else active_tables(job, name, self.machine(name))
        bare = tables is None  # which the file says: before the first tables the store cannot know it
        effects = () if tables is None else (Compensated(tables, self.truth(name, at)),)
        lengths = compgen.simulate(machine, self.scenario(name, at, part), effects=effects).lengths
        true = {"measured_at": at.isoformat(), **({"active_table": "none"} if bare else {})}
        notes = {**lengths.metadata, **(true if says is None else says)}
        path = job.machine(name).inbox / f"{at:%Y-%m-%d}{part}.lengths.csv"
        path.write_text(format_lengths(replace(lengths, metadata=notes)))
        if tables is not None and says is None:
            self._back_up(job, name, path)
        return path

    def _back_up(self, job: Job, name: str, path: Path) -> None:
        """Put a backup of the control, which has loaded the active tables, beside a measurement."""
        for file, _ in active_tables(job, name, self.machine(name)).files:
            content = (job.machine(name).out / "active" / file).read_bytes()
            (path.parent / f"{path.name.removesuffix('.lengths.csv')}.backup.{file}").write_bytes(content)

    def measure_deviations(self, job: Job, name: str, at: datetime, *, sign: float) -> Path:
        """Deviations of the bare machine at its nodes; with sign = -1 they are written the wrong way round."""
        machine, errors = self.machine(name), self.truth(name, at)
        position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
        noise = np.random.default_rng([self.seed, at.toordinal()]).normal(0.0, 0.3 * UM, position.shape)
        read = Deviations(
            position,
            sign * exact_error(machine, errors, position) + noise,
            u_mm=np.full_like(position, 0.3 * UM),
            covariates={"temp_ambient_c": np.full(len(position), self.temperature_c(name, at))},
            metadata={"measured_at": at.isoformat(), "active_table": "none"},
        )
        path = job.machine(name).inbox / f"{at:%Y-%m-%d}-converted.deviations.csv"
        path.write_text(format_deviations(read))
        return path

    def left_um(self, name: str, at: datetime, tables: ReadTables | None) -> float:
        """Rms of the true error of the tool tip between the nodes, rigid motion taken out: by the exact model alone."""
        machine, errors = self.machine(name), self.warm_truth(name, at)
        levels = tuple(np.linspace(*axis.range_mm, count) for axis, count in zip(machine.axes, (8, 7, 6), strict=True))
        position = volume_grid(machine, levels).position_mm
        added = np.zeros_like(position)
        if tables is not None:
            added = tables.correction(machine, Points(position, approach=np.ones_like(position)))
        left = compgen.without_rigid_motion(position, added + exact_error(machine, errors, position + added))
        return float(np.sqrt(np.mean(np.sum(left**2, axis=1)))) / UM


@dataclass(frozen=True)
class Compensated:
    """What active tables add to the true place of the tip: the axes go to p + correction(p) in place of p."""

    tables: ReadTables
    truth: ErrorTable

    def __call__(self, machine, stops):
        told = stops.position_mm
        sent = told + self.tables.correction(machine, Points(told, approach=stops.approach))
        now = tip_position(machine, self.truth.at(sent), sent, stops.tool_mm)
        return now - tip_position(machine, self.truth.at(told), told, stops.tool_mm)


def active_tables(job: Job, name: str, machine: compgen.Machine) -> ReadTables | None:
    """Read the files behind the pointer ``active``, as the control would; None while there is none."""
    folder = job.machine(name).out / "active"
    if not folder.exists():
        return None
    store = open_store(job.store)
    try:
        table = next(item for item in store.tables(store.machine(name)) if item.state == "active")
    finally:
        store.close()
    files = [folder / file for file in table.summary["tables"][CONTROL[name]]]
    return read_tables(machine, files, CONTROL[name])
