"""The job file ``recal.toml``: which machines are recalibrated, from which files, when and by which rules.

Schedules come first, then the file itself, then what is made from a job: an added machine, and the files for the
system's scheduler. Each key is declared once, with its check, default and meaning, as a field of :class:`Policy` or
:class:`MachineJob`, for the reader, ``volcomp recal add`` and the documentation.

``volcomp recal --help`` loads this module, so imports that need numpy are made where they are used.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.files import name_problem, read_bytes, read_text, sha256_of, write_file
from compgen.data.names import ERROR_NAMES, MM_PER_UM, error_named
from compgen.data.repeatability import Repeatability
from compgen.data.toml_files import Section, accepted, accepts, part_setting, setting, table_setting, take_settings
from compgen.errors import InputError, nearest
from compgen.resources import LANGUAGES

# --- schedules -----------------------------------------------------------------------------------------------------
#
# Expressions mean the same as in cron: Sunday is 0 or 7; if both the day of the month and the day of the week are
# restricted, a day needs to match only one of them. Times are local.

MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DAYS = ("sun", "mon", "tue", "wed", "thu", "fri", "sat")
MACROS = {
    "@hourly": "0 * * * *",
    "@daily": "0 0 * * *",
    "@weekly": "0 0 * * 0",
    "@monthly": "0 0 1 * *",
    "@yearly": "0 0 1 1 *",
}
#: Fields: lowest and highest number, number of the first name, names.
FIELDS = (
    ("minute", 0, 59, ()),
    ("hour", 0, 23, ()),
    ("day of the month", 1, 31, ()),
    ("month", 1, 12, MONTHS),
    ("day of the week", 0, 7, DAYS),
)


@dataclass(frozen=True)
class Cron:
    """A cron expression: numbers that match each field; Sunday is 0. ``any_day``, ``any_weekday``: field is ``*``."""

    expression: str
    minutes: tuple[int, ...]
    hours: tuple[int, ...]
    days: tuple[int, ...]
    months: tuple[int, ...]
    weekdays: tuple[int, ...]
    any_day: bool
    any_weekday: bool


@dataclass(frozen=True)
class Every:
    """An interval in minutes."""

    minutes: int


Schedule = Cron | Every


@accepts({"type": "string", "pattern": r"^\s*(@[A-Za-z]+|\S+(\s+\S+){4})\s*$"})
def cron(value: object) -> Cron:
    """Return a cron expression as numbers; ValueError says what is wrong with which field."""
    if not isinstance(value, str):
        raise ValueError("expected a cron expression, for example '30 6 * * mon'")
    words = MACROS.get(value.strip().lower(), value).split()
    if len(words) != 5:
        raise ValueError(
            f"a cron expression has five fields (minute hour day month weekday), this one has {len(words)}"
        )
    fields = [_field(word.lower(), k) for k, word in enumerate(words)]
    weekdays = tuple(sorted({day % 7 for day in fields[4]}))
    minutes, hours, days, months = fields[:4]
    any_day, any_weekday = words[2].startswith("*"), words[4].startswith("*")
    found = Cron(" ".join(words), minutes, hours, days, months, weekdays, any_day, any_weekday)
    longest = {2: 29, 4: 30, 6: 30, 9: 30, 11: 30}
    if found.any_weekday and not any(day <= longest.get(month, 31) for month in found.months for day in found.days):
        raise ValueError("expected a cron expression whose day exists in one of its months")
    return found


def _field(word: str, number: int) -> tuple[int, ...]:
    name, low, high, names = FIELDS[number]
    found: set[int] = set()
    for part in word.split(","):
        match = re.fullmatch(r"(\*|\w+)(?:-(\w+))?(?:/(\d+))?", part)
        if match is None or (match[1] == "*" and match[2]):
            raise ValueError(f"{part!r} is not a valid {name}; expected numbers, a-b, lists and /step")
        first = low if match[1] == "*" else _number(match[1], number)
        last = high if match[1] == "*" or (match[3] and not match[2]) else _number(match[2] or match[1], number)
        step = int(match[3] or 1)
        if names is DAYS and match[1] == "*":
            last = 6
        if first > last or step == 0:
            raise ValueError(f"{part!r} selects no {name}; give the lower number first and a step above 0")
        found.update(range(first, last + 1, step))
    return tuple(sorted(found))


def _number(word: str, number: int) -> int:
    name, low, high, names = FIELDS[number]
    if word in names:
        return names.index(word) + (low if names is MONTHS else 0)
    if not word.isascii() or not word.isdigit() or not low <= int(word) <= high:
        raise ValueError(f"{word!r} is not a valid {name}; expected {low} to {high}")
    return int(word)


def systemd_lines(schedule: Schedule) -> list[str]:
    """Return the schedule as lines of a systemd timer."""
    if isinstance(schedule, Every):
        return ["OnBootSec=1min", f"OnUnitActiveSec={schedule.minutes}min"]
    clock = f"{_comma_separated_numbers(schedule.hours, 24)}:{_comma_separated_numbers(schedule.minutes, 60)}:00"
    months, days = _comma_separated_numbers(schedule.months, 12), _comma_separated_numbers(schedule.days, 31)
    weekdays = ",".join(DAYS[day].capitalize() for day in schedule.weekdays)
    by_day, by_weekday = f"*-{months}-{days} {clock}", f"{weekdays} *-{months}-* {clock}"
    if schedule.any_weekday and len(schedule.weekdays) == 7:
        return [f"OnCalendar={by_day}"]
    if schedule.any_day or schedule.any_weekday:  # cron: one match suffices only if neither begins with *
        return [f"OnCalendar={weekdays} *-{months}-{days} {clock}"]
    return [f"OnCalendar={by_day}", f"OnCalendar={by_weekday}"]


def _comma_separated_numbers(numbers: tuple[int, ...], all_of_them: int) -> str:
    return "*" if len(numbers) == all_of_them else ",".join(f"{number:02d}" for number in numbers)


def cron_expression(schedule: Schedule) -> str | None:
    """Return the five fields of a crontab; None where cron cannot express the interval."""
    if isinstance(schedule, Cron):
        return schedule.expression
    minutes = schedule.minutes
    if minutes < 60:
        return f"*/{minutes} * * * *" if 60 % minutes == 0 else None
    if minutes % 60 == 0 and 24 % (minutes // 60) == 0:
        return "0 0 * * *" if minutes == 1440 else f"0 */{minutes // 60} * * *"
    return None


# --- the job file --------------------------------------------------------------------------------------------------

PATTERNS = ("*.lengths.csv", "*.deviations.csv", "*.sixdof.csv")
#: The store if a job file does not name one.
STORE = "recal.sqlite"
#: How often a watch checks its job file, s.
WATCH_POLL_S = 2.0
MACHINE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


_confidence = toml_files.bounded(
    "a confidence from 0.5 to below 1, for example 0.95", minimum=0.5, exclusiveMaximum=1.0
)


@accepts(
    {
        "anyOf": [{"type": "string"}, toml_files.array_schema({"type": "string"}, 1)],
        "examples": [[next(iter(CONTROLLERS))]],
    }
)
def _controllers(value: Any) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError("expected a list of controls, for example ['siemens-cec']")
    for name in names:
        if name not in CONTROLLERS:
            raise ValueError(f"{name!r} is not a controller; {nearest(name, CONTROLLERS)}")
    return tuple(dict.fromkeys(names))


@accepts(toml_files.array_schema({"type": "string", "pattern": r"^(?!\.\.)[^/]+$"}, 1))
def _patterns(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(item, str) and item for item in value):
        raise ValueError("expected a list of file patterns, for example ['*.lengths.csv']")
    if any("/" in item or item.startswith("..") for item in value):
        raise ValueError("expected patterns of file names, without folders")
    return tuple(value)


@accepts(
    {"anyOf": [{"type": "string", "pattern": r"\S"}, toml_files.array_schema({"type": "string", "minLength": 1}, 1)]}
)
def command_words(value: Any) -> tuple[str, ...]:
    """Return a command as its words, from a list or from one text that is split as in a shell."""
    words = shlex.split(value) if isinstance(value, str) else value
    if not isinstance(words, list) or not words or not all(isinstance(word, str) and word for word in words):
        raise ValueError("expected a command, as a list of its words")
    return tuple(words)


@accepts(accepted(toml_files.text_of_path))
def _path(value: Any) -> Path:
    return Path(toml_files.text_of_path(value))


#: Keys of ``[tolerances]``: the error or "volume", and its unit in mm or rad.
_TOLERANCES: Mapping[str, tuple[str, float]] = {
    f"{name}_{error_named(name).unit}": (name, error_named(name).si_per_unit) for name in ERROR_NAMES
} | {"volume_um": ("volume", MM_PER_UM)}


def _identify_checks() -> dict[str, Callable[[Any], Any]]:
    """Keys of ``[identify]``, each with its check: the options of an identification that depend on the machine."""
    from compgen.identification.options import IdentifyOptions  # imported here: it needs numpy

    checks = {item.name: item.metadata.get("in_job") for item in fields(IdentifyOptions)}
    return {name: check for name, check in checks.items() if check is not None}


@dataclass(frozen=True)
class Policy:
    """Requirements for new tables to be proposed; lengths in um. None: no limit."""

    max_age_days: float | None = setting(
        toml_files.positive, 30.0, meaning="The measurement is older than this, in days, when it is judged."
    )
    temperature_c: tuple[float, float] | None = setting(
        toml_files.interval, None, meaning="A logged channel leaves the window [low, high], or none was logged."
    )
    confidence: float = setting(
        _confidence,
        0.98,
        meaning="The change against the active tables does not exceed what measurements and repeatability explain, with this "
        "confidence.",
    )
    min_shrink_um: float = setting(
        toml_files.not_negative,
        0.0,
        meaning="The remaining rms, rigid motion removed, does not shrink by more than this against the active tables.",
    )
    max_change_um: float | None = setting(
        toml_files.positive,
        None,
        meaning="The correction changes by more than this anywhere, against the active tables.",
    )
    max_reference_um: float | None = setting(
        toml_files.positive,
        None,
        meaning="The correction changes by more than this at the reference point; for first tables: compared with none.",
    )
    max_step_um: float | None = setting(
        toml_files.positive,
        None,
        meaning="Not held back but refused: a step between neighbouring nodes exceeds it, as with `volcomp run "
        "--max-step-um`.",
    )
    clock_minutes: float = setting(
        toml_files.not_negative,
        30.0,
        meaning="It was measured within this time, or within an hour more (daylight-saving time), of a decision that "
        "changed the active tables, and does not state which were active. 0: the times are certain.",
    )
    evidence: Literal["preferred", "required"] = setting(
        toml_files.choice("preferred", "required"),
        "preferred",
        meaning="required: no backup of the control shows which tables were on; preferred: none shows it, and the machine "
        "seems to have changed by more than drift explains.",
    )


@dataclass(frozen=True)
class OtherInbox:
    """The inbox of another machine of the job file, for files that came for both.

    ``found`` contains size and SHA-256 of the files found in it, for a process that cannot read it; None: it is read.
    """

    name: str
    inbox: Path
    patterns: tuple[str, ...]
    found: frozenset[tuple[int, str]] | None = None


@dataclass(frozen=True)
class MachineJob:
    """How one machine is recalibrated; the fields up to ``policy`` are the keys of its section, paths are absolute.

    ``measured_with`` says what was active while the machine was measured: the tables active at that time ("active") or
    none ("bare"); a measurement file may override it for itself. ``schedule`` is also set by ``every_minutes`` of the
    file. ``tolerances`` are for the drift, mm or rad, by error or "volume". ``others`` are the machines with the same
    inbox, or whose inbox also contains one of this machine's files (:func:`compgen.fleet.inbox.with_twins`). If the
    files that the settings name are copies (:class:`compgen.fleet.runner.Parcel`), ``settings`` is the hash of the
    settings, ``original`` the machine file, and ``copies`` has the folder that they are in.
    """

    name: str
    machine: str = setting(
        toml_files.text_of_path, metavar="MACHINE", meaning="Machine TOML, or the name of a machine."
    )
    inbox: Path = setting(_path, metavar="DIR", meaning="Folder where measurements arrive.")
    controllers: tuple[str, ...] = setting(
        _controllers,
        name="--controller",
        metavar="NAME",
        meaning="Control to export, by the name that `volcomp controllers` lists; may be several.",
    )
    out: Path = setting(_path, metavar="DIR", meaning="Folder for the tables, one for each machine.")
    measured_with: Literal["active", "bare"] = setting(
        toml_files.choice("active", "bare"),
        meaning="active: the compensation stays on while the machine is measured; bare: it is switched off. There is no "
        "default: the wrong one compensates twice or not at all.",
    )
    patterns: tuple[str, ...] = setting(_patterns, PATTERNS, meaning="Name patterns of measurement files.")
    schedule: Schedule | None = setting(
        cron, None, metavar="CRON", meaning="Cron expression in local time, for `watch` and `export-units`."
    )
    every_minutes: int | None = setting(
        toml_files.whole(1, 527040), None, meaning="In place of a schedule: an interval in minutes."
    )
    approval: Literal["manual", "auto"] = setting(
        toml_files.choice("manual", "auto"),
        "manual",
        meaning="manual: new tables wait until a person approves them; auto: they become active if nothing holds them "
        "back.",
    )
    instrument: Path | None = setting(_path, None, metavar="FILE", meaning="Instrument TOML of six-DOF readings.")
    heat: Path | None = setting(
        _path,
        None,
        metavar="FILE",
        meaning="Model of heat of `volcomp heat`: what temperatures have moved is taken out of the readings.",
    )
    temperatures: Path | None = setting(
        _path,
        None,
        metavar="FILE",
        meaning="Temperatures while one measures: a *.temperatures.csv of `volcomp log`, or a folder of them; sensors x, y, z "
        "are those of the scales.",
    )
    templates: Path | None = setting(_path, None, meaning="Folder of your own templates, as for `volcomp run`.")
    allow_unverified: bool = setting(
        toml_files.flag, False, meaning="Export formats that no public document fully describes."
    )
    language: Literal["en", "de"] = setting(
        toml_files.choice(*LANGUAGES),
        LANGUAGES[0],
        meaning="Language of preflight lists and of the report of the history.",
    )
    notify: tuple[str, ...] = setting(
        command_words, (), meaning="Command, as a list of words, that is notified of decisions and failures."
    )
    settle_s: float = setting(
        toml_files.not_negative,
        0.0,
        meaning="A file changed less than this many seconds ago is left for the next pass.",
    )
    max_size_mb: float = setting(
        toml_files.positive, 100.0, meaning="A measurement whose files together exceed this many MB is not read."
    )
    max_minutes: float = setting(
        toml_files.positive,
        60.0,
        meaning="A measurement that takes longer is stopped and set aside; by `run` and `watch`.",
    )
    policy: Policy = table_setting(Policy)
    identify: Mapping[str, Any] = part_setting(
        lambda: toml_files.table_schema({key: accepted(check) for key, check in _identify_checks().items()}),
        factory=dict,
        meaning="How measurements are identified, as the options of `volcomp identify`.",
    )
    tolerances: Mapping[str, float] = part_setting(
        lambda: toml_files.table_schema(dict.fromkeys(_TOLERANCES, accepted(toml_files.positive))),
        factory=dict,
        meaning="Limits of the drift, by error or of the volume.",
    )
    repeatability: Mapping[str, float] = part_setting(
        lambda: toml_files.section_schema(Repeatability),
        factory=dict,
        meaning="Keys of the section of this name in the machine file, which they override.",
    )
    others: tuple[OtherInbox, ...] = field(default=(), compare=False, repr=False)
    settings: str = field(default="", compare=False, repr=False)
    original: Path | None = field(default=None, compare=False, repr=False)
    copies: tuple[Path, ...] = field(default=(), compare=False, repr=False)

    def settings_sha256(self, known: Container[str] = ()) -> str:
        """Return the SHA-256 of all that a result depends on, except the measurement; InputError for a wrong machine.

        If it is one of ``known``, something was processed with these settings, and the machine file is not checked.
        """
        if self.settings:
            return self.settings
        from compgen.data.machine import load_machine

        machine: Path | None = Path(self.machine)
        if not (known and Path(self.machine).is_file() and len(Path(self.machine).parts) > 1):
            machine = load_machine(self.machine).source
        files = [machine, self.instrument]
        digests = [sha256_of(read_bytes(path)) for path in files if path is not None]
        own = {"controllers": self.controllers, "measured_with": self.measured_with, "identify": dict(self.identify)}
        policy = asdict(self.policy)
        if policy["evidence"] == Policy.evidence:  # as before there was this key
            del policy["evidence"]
        rules = {"policy": policy, "unverified": self.allow_unverified, "templates": str(self.templates)}
        if self.max_minutes != MachineJob.max_minutes:  # with more time, what took too long is tried again
            rules["max_minutes"] = self.max_minutes
        if self.language != LANGUAGES[0]:
            rules["language"] = self.language
        if self.heat is not None:
            rules["heat"] = sha256_of(read_bytes(self.heat))
        if self.temperatures is not None:  # which grow from day to day: their contents are no setting
            rules["temperatures"] = str(self.temperatures)
        if self.repeatability:
            rules["repeatability"] = dict(self.repeatability)
        found = sha256_of(json.dumps([digests, own, rules], sort_keys=True).encode())
        if known and found not in known:
            load_machine(self.machine)
        return found


@dataclass(frozen=True)
class Job:
    """A job file: where the store is, and the machines by name."""

    path: Path
    store: str
    machines: Mapping[str, MachineJob]

    def with_notify(self, command: tuple[str, ...]) -> Job:
        """Return the job with this notification command for all machines; an empty command changes nothing."""
        if not command:
            return self
        return replace(self, machines={name: replace(item, notify=command) for name, item in self.machines.items()})

    def machine(self, name: str) -> MachineJob:
        """Return one machine; InputError with the most similar name if it does not exist."""
        if name not in self.machines:
            raise InputError(f"there is no machine {name!r}; {nearest(name, self.machines)}", file=self.path)
        return self.machines[name]


def read_job(path: str | Path) -> Job:
    """Read a job file strictly; InputError with file, line and key for anything unknown, missing or impossible."""
    return job_of(toml_files.read_toml(path), Path(path).absolute())


def job_of_text(text: str, path: Path) -> Job:
    """Return the job that ``text`` would be as the file ``path``; errors as for :func:`read_job`."""
    import tomllib

    try:
        return job_of(Section(tomllib.loads(text), path=path, text=text), path.absolute())
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", file=path) from error


def job_schema() -> dict[str, Any]:
    """Return the JSON schema of a job file."""
    keys = toml_files.section_schema(MachineJob)
    required, known = keys.pop("required"), {"enum": sorted(CONTROLLERS)}
    keys["properties"]["controllers"] |= {"anyOf": [known, toml_files.array_schema(known, 1)]}
    store = {**accepted(toml_files.text_of_path), "default": STORE, "description": "SQLite file, or URL of a database."}
    machines = {
        "type": "object",
        "description": "The machines by name.",
        "propertyNames": {"pattern": f"^{MACHINE_NAME.pattern}$"},
        "additionalProperties": keys,
    }
    defaults = {**keys, "description": "Default keys of all machines."}
    # keys that a machine needs may also be given as defaults
    needed = [
        {
            "anyOf": [
                {"required": ["defaults"], "properties": {"defaults": {"required": [key]}}},
                {"properties": {"machines": {"additionalProperties": {"required": [key]}}}},
            ]
        }
        for key in required
    ]
    whole = toml_files.table_schema({"store": store, "defaults": defaults, "machines": machines})
    return {**whole, "allOf": needed}


def job_of(root: Section, path: Path) -> Job:
    """Read the root section of a job file, as for :func:`read_job`."""
    folder = path.parent
    store = root.take("store", toml_files.text_of_path, STORE)
    defaults = root.section("defaults", required=False)
    every = root.section("machines", required=False)
    machines: dict[str, MachineJob] = {}
    for name in every.data:
        if not MACHINE_NAME.fullmatch(name):
            raise every.fail(name, "is not a name: letters, digits, '.', '_' and '-', at most 64, are allowed")
        problem = name_problem(name, machines)
        if problem is not None:
            raise every.fail(name, problem)
        machines[name] = _machine(name, every.section(name).again(defaults=defaults), folder)
    if not machines:  # the defaults are checked before there is a machine
        required = dict.fromkeys((item.name for item in fields(MachineJob) if item.metadata.get("required")), "")
        keys = Section({}, path=path, defaults=defaults)
        take_settings(MachineJob, keys, name="", **_mappings(keys), **required)
    root.finish()
    # output folders may not be equal or nested, also not through links and ".."
    # and not by upper and lower case only, which some file systems ignore
    real = {name: Path(os.path.realpath(machine.out).casefold()) for name, machine in machines.items()}
    known = {path: name for name, path in reversed(real.items())}
    for name, out in real.items():
        if known[out] != name:
            raise every.fail(
                name, f"has the same folder out as {known[out]} ({machines[name].out}); give each machine its own"
            )
        around = next((parent for parent in out.parents if parent in known), None)
        if around is not None:
            raise every.fail(
                name,
                f"has its folder out ({machines[name].out}) inside that of {known[around]} ({machines[known[around]].out}); give "
                "each machine a folder of its own, "
                "not inside another one",
            )
    shared: dict[str, list[OtherInbox]] = {}
    for name, machine in machines.items():
        shared.setdefault(os.path.realpath(machine.inbox), []).append(OtherInbox(name, machine.inbox, machine.patterns))
    for group in shared.values():
        for own in group if len(group) > 1 else ():
            machines[own.name] = replace(machines[own.name], others=tuple(item for item in group if item != own))
    return Job(path, store if "://" in store else f"sqlite:///{folder / store}", machines)


def _machine(name: str, keys: Section, folder: Path) -> MachineJob:
    if "measured_with" not in keys:
        raise keys.fail(
            "measured_with",
            "is missing; say 'active' if the compensation stays on while the machine is measured, 'bare' if it is "
            "switched off. The wrong one compensates twice or not at all",
            kind="missing",
            instead="bare",
        )
    job = take_settings(MachineJob, keys, name=name, **_mappings(keys))
    keys.finish()

    def placed(path: str | Path) -> Path:
        return folder / str(path).replace("{name}", name)

    is_file = job.machine.endswith(".toml") or len(Path(job.machine).parts) > 1
    return replace(
        job,
        machine=str(placed(job.machine)) if is_file else job.machine.replace("{name}", name),
        inbox=placed(job.inbox),
        out=placed(job.out),
        schedule=_schedule(job, keys),
        instrument=None if job.instrument is None else placed(job.instrument),
        heat=None if job.heat is None else placed(job.heat),
        temperatures=None if job.temperatures is None else placed(job.temperatures),
        templates=None if job.templates is None else placed(job.templates),
    )


def _schedule(job: MachineJob, keys: Section) -> Schedule | None:
    """The schedule from either key; a key given for the machine overrides the other key in the defaults."""
    own = {"every_minutes", "schedule"} & set(keys.data)
    if job.every_minutes is None or (job.schedule is not None and own == {"schedule"}):
        return job.schedule
    if job.schedule is not None and own != {"every_minutes"}:
        raise keys.fail("schedule", "cannot be combined with every_minutes; give one of the two")
    return Every(job.every_minutes)


def _mappings(keys: Section) -> dict[str, Mapping[str, Any]]:
    """The sections ``identify`` and ``repeatability``, in the units of the file, and ``tolerances``, in mm and rad."""
    section = keys.section("tolerances", required=False)
    given = {key: section.take(key, toml_files.positive, None) for key in _TOLERANCES}
    section.finish()
    tolerances = {_TOLERANCES[key][0]: size * _TOLERANCES[key][1] for key, size in given.items() if size is not None}
    section = keys.section("repeatability", required=False)
    stated = toml_files.stated_settings(Repeatability, section)
    section.finish()
    section = keys.section("identify", required=False)
    found: dict[str, Any] = {name: section.take(name, check, None) for name, check in _identify_checks().items()}
    section.finish()
    found["temperature"] = found["temperature"] is not False
    found["small_deviations"] = found["small_deviations"] or None  # keeps the hash unchanged
    options = {name: item for name, item in found.items() if item is not None}
    return {"tolerances": tolerances, "repeatability": stated, "identify": options}


# --- what is made from a job ---------------------------------------------------------------------------------------


def add_machine(path: Path, name: str, keys: Mapping[str, Any]) -> MachineJob:
    """Append ``[machines.NAME]`` with the keys that are not None; nothing is written if the result is not a valid job.

    Raises
    ------
    InputError
        for a machine that already exists, a machine file that does not load, or a value that the job file refuses.
    """
    before = read_text(path) if path.exists() else ""
    if before and name in job_of_text(before, path).machines:
        raise InputError(f"already has a machine {name!r}; edit it there", file=path)
    # texts, numbers and lists of texts: JSON's escapes are also valid in TOML
    lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items() if value is not None]
    head = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
    gap = "" if not before else "\n" if before.endswith("\n") else "\n\n"
    text = before + gap + "\n".join([f"[machines.{head}]", *lines]) + "\n"
    added = job_of_text(text, path).machine(name)
    from compgen.data.machine import load_machine

    load_machine(added.machine)
    write_file(path, text)
    return added


#: For machines without a schedule.
HOURLY = Every(60)
UNIT_NAME = "compgen-recal"

#: The files of systemd.
SERVICE = """[Unit]
Description=compgen recalibration of {names}
After=network-online.target

[Service]
Type=oneshot
{command}
"""
WATCH = """# in place of the timers: one process that keeps the schedules of the job file itself
[Unit]
Description=compgen recalibration, watching
After=network-online.target

[Service]
{command}
Restart=on-failure
TimeoutStopSec=15min

[Install]
WantedBy=multi-user.target
"""
TIMER = """[Unit]
Description=when {names} is recalibrated

[Timer]
{lines}
Unit={unit}.service

[Install]
WantedBy=timers.target
"""


def units(job: Job, program: str) -> Mapping[str, str]:
    """Return the files for the system's scheduler to run ``volcomp recal run``: texts by file name.

    They are systemd services and timers and the lines of a crontab. Machines with the same schedule share one timer; a
    machine without a schedule is checked every hour. ``program`` is the path of the ``compgen`` command.
    """
    groups: dict[Schedule, list[str]] = {}
    for name, machine in job.machines.items():
        groups.setdefault(machine.schedule or HOURLY, []).append(name)
    files: dict[str, str] = {}
    lines = ["# crontab of volcomp recal; exit code 1: something is held back or failed, see `volcomp recal status`"]
    for number, (schedule, names) in enumerate(groups.items(), start=1):
        whole = len(groups) == 1
        unit = UNIT_NAME if whole else f"{UNIT_NAME}-{number}"
        words = [program, "recal", "run", *([] if whole else names), "--job", str(job.path)]
        files[f"{unit}.service"] = SERVICE.format(names=_first_names(names), command=_command_lines(job, words))
        lines_of_timer = [*systemd_lines(schedule), *([] if isinstance(schedule, Every) else ["Persistent=true"])]
        files[f"{unit}.timer"] = TIMER.format(names=_first_names(names), lines="\n".join(lines_of_timer), unit=unit)
        command, expression = shlex.join(words).replace("%", r"\%"), cron_expression(schedule)
        if expression is None:
            minutes = schedule.minutes if isinstance(schedule, Every) else 0
            expression = f"# every {minutes} minutes cannot be expressed by cron; use {unit}.timer:"
        lines.append(f"{expression} {command}")
    files["crontab"] = "\n".join(lines) + "\n"
    watch = [program, "recal", "watch", "--job", str(job.path)]
    files[f"{UNIT_NAME}-watch.service"] = WATCH.format(command=_command_lines(job, watch))
    return files


def _command_lines(job: Job, words: Sequence[str]) -> str:
    """Return where and what to run; words are quoted for systemd."""
    command = []
    for word in words:
        text = _escaped(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
        command.append(f'"{text}"' if any(char in word for char in " \t'\";") else text)
    return f"WorkingDirectory={_escaped(str(job.path.parent))}\nExecStart={' '.join(command)}"


def _first_names(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 5 else f"{', '.join(names[:5])} and {len(names) - 5} more"


def _escaped(text: str) -> str:
    return text.replace("%", "%%")
