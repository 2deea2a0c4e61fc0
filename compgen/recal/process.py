"""One measurement through the whole chain, in a temporary folder, judged against what is active now."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from compgen.core.files import FOLDERS, read_bytes, working_folder
from compgen.core.machine import Machine, load_machine
from compgen.errors import CompgenWarning, InputError
from compgen.export import program_version
from compgen.identify import IdentifyOptions
from compgen.identify.covariance import FILE_NAME as COVARIANCE
from compgen.pipeline import Checks, RunResult, run
from compgen.recal.job import MachineJob
from compgen.recal.judge import (
    STATED,
    ActiveState,
    Earlier,
    Judgement,
    Past,
    apply_limits,
    judge_assumption,
    judge_change,
    judge_likeness,
    judge_measurement,
    judge_misfit,
    judge_order,
    judge_tables,
    judge_twins,
    shows_all,
    version_said,
)
from compgen.recal.records import MachineRecord, MeasurementRecord, NewResult, TableFile, TableRecord
from compgen.recal.states import AFTER, active_id
from compgen.recal.store import Store
from compgen.verify import ReadTables, read_tables
from compgen.verify.active import ActiveTables
from compgen.verify.safety import SafetyLimits

#: Files of a run that belong to the identification; with one control they stand beside its own.
NOT_OF_A_CONTROL = (
    "identified.errors.csv",
    COVARIANCE,
    "identified.reversal.csv",
    "measured.deviations.csv",
    "stations.csv",
    "identify.json",
    "fitted.errors.csv",
    "fit.json",
)
#: The newest of the versions that were active with which a change is compared.
LOOKED_BACK = 20
#: How temporary folders begin; their names say nothing to a reader.
FOLDER = "compgen-recal-"
_TEMPORARY = re.compile(rf"\S*{FOLDER}[^/\\]+[/\\]measurement[/\\]")


@dataclass(frozen=True)
class Processed:
    """What is to be kept, and the id of the tables that it was judged against."""

    result: NewResult
    judged_against: int | None


def process(
    store: Store, job: MachineJob, record: MachineRecord, measurement: MeasurementRecord, stated: str | None = None
) -> Processed:
    """Run the chain for one measurement and judge the outcome; nothing outside a temporary folder is written.

    Parameters
    ----------
    stated : the tables that were on while the machine was measured, by a person: a version or "none". It counts before
        what the file says; None if nobody says so.

    Raises
    ------
    CompgenError
        for a measurement that cannot be used, or does not determine the errors.
    """
    said = measurement.active_table if stated is None else stated
    started = time.monotonic()
    settings = job.settings_sha256()
    machine = load_machine(job.machine)
    tables = store.tables(record)
    now = store.read(store.now)
    with working_folder(FOLDER.removeprefix(FOLDERS)) as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        paths = write_files(Path(folder) / "measurement", store.contents_of(measurement))
        past = Past(store.decisions(record), tables, store.measurements(record), store.events(record))
        measured = _active_then(job, measurement, past, said)
        checks: Checks = {"instrument": job.instrument, "limits": SafetyLimits(job.policy.max_step_um)}
        checks["allow_misfit"] = True  # a misfit that refuses the tables of `run` holds them back here: judge_misfit
        if measured is not None:
            checks["active"] = _parsed(store, machine, measured, job.controllers[0], Path(folder) / "then")
        outcome = run(
            machine,
            paths,
            job.controllers,
            Path(folder) / "out",
            identify_options=IdentifyOptions(**job.identify),
            templates=job.templates,
            allow_unverified=job.allow_unverified,
            **checks,
        )
        active = _active_now(store, machine, tables, Path(folder) / "now")
        judgement = _judged(store, job, machine, measurement, (outcome, active, now))
        judge_order(judgement, store, measurement, tables)
        taken = None if measured is None else measured.version
        if said is not None:
            judgement.figures[STATED] = said
        elif job.measured_with == "active":
            judge_assumption(judgement, job, measurement, past, now, taken)
        if outcome.accepted:
            about = (job, machine, measurement)
            _judge_likeness(judgement, store, about, past, outcome, taken, Path(folder) / "earlier")
        judge_twins(judgement, store, job, record, measurement)
        judgement.figures["warnings"] = [without_folder(str(item.message)) for item in caught if _ours(item)]
        files = _tables_of(outcome, Path(folder) / "out")
        result = _result(Path(folder) / "out", machine, outcome, files, judgement)
    kept = NewResult(
        **result,
        active_table_id=None if measured is None else measured.id,
        approve=job.approval == "auto",
        settings_sha256=settings,
        seconds=time.monotonic() - started,
    )
    return Processed(kept, next((table.id for table in tables if table.state == "active"), None))


def without_folder(message: str) -> str:
    """Return a message that names files of a measurement as the inbox has them."""
    return _TEMPORARY.sub("", message)


def _ours(item: warnings.WarningMessage) -> bool:
    return issubclass(item.category, CompgenWarning)


def write_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files into a temporary folder and return their paths."""
    paths = []
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        paths.append(path)
    return paths


# --- active tables -------------------------------------------------------------------------------------------------


def _active_then(job: MachineJob, measurement: MeasurementRecord, past: Past, said: str | None) -> TableRecord | None:
    """Return the tables that were active while the machine was measured: what is said, else what the job says."""
    tables = past.tables
    version = None if said is None else version_said(said)
    if said is not None and version is None:
        return None
    if said is not None:
        found = next((table for table in tables if table.version == version), None)
        if found is None or not found.accepted:
            of_file = said == measurement.active_table
            raise InputError(
                f"says active_table = {said}, but {job.name} has no such tables; a version or none is expected",
                file=measurement.name if of_file else None,
                field=None if of_file else "--active-table",
            )
        return found
    if job.measured_with == "bare":
        return None
    wanted = active_id([decision for decision in past.decisions if decision.at <= measurement.measured_at])
    return next((table for table in tables if table.id == wanted), None)


def _parsed(store: Store, machine: Machine, table: TableRecord, control: str, folder: Path) -> ActiveTables:
    paths = _written(store, table, control, folder)
    if not paths:
        raise InputError(f"version {table.version} was active, but holds no tables of {control}; is the control right?")
    return ActiveTables(read_tables(machine, paths, control), tuple(paths))


def _judge_likeness(
    judgement: Judgement,
    store: Store,
    about: tuple[MachineJob, Machine, MeasurementRecord],
    past: Past,
    outcome: RunResult,
    taken: int | None,
    folder: Path,
) -> None:
    """Compare the change with what each version that is or was active adds."""
    job, machine, measurement = about
    by_id = {table.id: table for table in past.tables}
    order = [item.table_id for item in past.decisions if AFTER[item.kind] == "active" and item.table_id is not None]
    known = [by_id[key] for key in dict.fromkeys(order[::-1])][:LOOKED_BACK][::-1]
    were_active: dict[int, ReadTables] = {}
    for table in known:
        control = next((name for name in job.controllers if name in table.controllers), table.controllers[0])
        paths = _written(store, table, control, folder / str(table.version))
        if paths:
            were_active[table.version] = read_tables(machine, paths, control)
    if were_active:
        old = store.identification(known[-1].identification_id)
        active = next((table.version for table in past.tables if table.state == "active"), None)
        judge_likeness(judgement, store, job, machine, measurement, outcome, old, Earlier(were_active, taken, active))


def _written(store: Store, table: TableRecord, control: str, folder: Path) -> list[Path]:
    """Write the table files proper of one control (no manifest, no notes) and return their paths."""
    names = table.summary.get("tables", {}).get(control, [])
    files = {file.name: file.content for file in store.table_files(table) if file.controller == control}
    return write_files(folder / control, {name: files[name] for name in names})


def _active_now(store: Store, machine: Machine, tables: Sequence[TableRecord], folder: Path) -> ActiveState | None:
    table = next((item for item in tables if item.state == "active"), None)
    if table is None:
        return None
    read = {}
    for control in table.controllers:
        paths = _written(store, table, control, folder)
        if paths:
            read[control] = read_tables(machine, paths, control)
    return ActiveState(table.version, read, store.identification(table.identification_id))


# --- judgement -----------------------------------------------------------------------------------------------------


def _judged(
    store: Store,
    job: MachineJob,
    machine: Machine,
    measurement: MeasurementRecord,
    state: tuple[RunResult, ActiveState | None, datetime],
) -> Judgement:
    result, active, now = state
    judgement = Judgement()
    latest = None if active is None else active.identification.measured_at
    judge_measurement(judgement, job.policy, measurement, now, latest)
    new: dict[str, ReadTables] = {}
    for item in result.results:
        if item.verification.accepted:
            control = item.verification.controller
            names = {path.name: path for path in item.paths}
            new[control] = read_tables(machine, [names[Path(name).name] for name in item.export.files], control)
    if active is not None and result.accepted and shows_all(judgement, store, result, active):
        judge_change(judgement, store, machine, result, active, job.policy)
        judge_tables(judgement, machine, result, new, active)
    if result.accepted:
        apply_limits(judgement, machine, new, {} if active is None else active.tables, job.policy)
    judge_misfit(judgement, result)
    judgement.figures["active_version"] = None if active is None else active.version
    judgement.figures["result"] = {item.verification.controller: item.verification.summary() for item in result.results}
    if not result.accepted:
        reasons = [reason for item in result.results for reason in item.verification.reasons]
        judgement.hold[:0] = list(dict.fromkeys(reasons))
    return judgement


def _tables_of(result: RunResult, folder: Path) -> list[TableFile]:
    """Return the files of every control by their names below the control's own folder."""
    files = []
    for item in result.results:
        control = item.verification.controller
        root = folder / control if len(result.results) > 1 else folder
        names = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
        files += [TableFile(control, name, read_bytes(root / name)) for name in names if name not in NOT_OF_A_CONTROL]
    return files


def _result(
    folder: Path, machine: Machine, outcome: RunResult, files: Sequence[TableFile], judgement: Judgement
) -> dict[str, Any]:
    """Return the fields of a :class:`NewResult` that come from the chain."""
    judgement.figures["tables"] = {item.verification.controller: list(item.export.files) for item in outcome.results}
    covariance = folder / COVARIANCE
    assert machine.source is not None
    return {
        "machine_text": read_bytes(machine.source),
        "errors_text": read_bytes(folder / "identified.errors.csv"),
        "covariance": read_bytes(covariance) if covariance.is_file() else None,
        "fitted_text": read_bytes(folder / "fitted.errors.csv"),
        "summary": outcome.identification.summary(),
        "program": program_version(),
        "files": tuple(files),
        "accepted": outcome.accepted,
        "hold": tuple(judgement.hold),
        "reservations": tuple(judgement.reservations),
        "judgement": judgement.figures,
    }
