"""The job file ``recal.toml``: which machines are recalibrated, from what, when, and by which rules."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from compgen.controllers import CONTROLLERS
from compgen.core import tomlio
from compgen.core.files import read_bytes, sha256_of
from compgen.core.machine import load_machine
from compgen.core.names import ERROR_NAMES, MM_PER_UM, error_named
from compgen.core.text import nearest
from compgen.core.tomlio import Section
from compgen.errors import InputError
from compgen.recal.schedule import Every, Schedule, cron

T = TypeVar("T")
D = TypeVar("D")
PATTERNS = ("*.lengths.csv", "*.deviations.csv", "*.sixdof.csv")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class Policy:
    """What new tables must fulfil to be proposed; lengths in um.

    Parameters
    ----------
    max_age_days : a measurement may be at most this old when it is judged.
    temperature_c : lowest and highest temperature that any logged channel may show; without a log it is held back.
    confidence : with which the change must exceed its uncertainty.
    min_shrink_um : by how much the remaining rms must shrink against the active tables; more than 0 in any case.
    max_change_um : largest change of the correction anywhere, against the active tables.
    max_reference_um : largest change of the correction at the reference point; for a first table against none.
    max_step_um : largest step of the correction between neighbouring table nodes.
    clock_minutes : how near to a decision that changed the active tables a measurement may be made without saying itself
        which tables were on; for clocks that differ.
    """

    max_age_days: float | None = 30.0
    temperature_c: tuple[float, float] | None = None
    confidence: float = 0.95
    min_shrink_um: float = 0.0
    max_change_um: float | None = None
    max_reference_um: float | None = None
    max_step_um: float | None = None
    clock_minutes: float = 30.0


@dataclass(frozen=True)
class OtherInbox:
    """The inbox of another machine of the job file, for files that came for both."""

    name: str
    inbox: Path
    patterns: tuple[str, ...]


@dataclass(frozen=True)
class MachineJob:
    """How one machine is recalibrated; paths are absolute.

    ``measured_with`` says what was active while the machine was measured: the tables that were active then ("active")
    or none ("bare"); a measurement file may say otherwise for itself. ``tolerances`` are those of the drift, mm or rad,
    by error or "volume". ``others`` are the machines whose
    inbox is the same, or holds a file of this one's as well (:func:`compgen.recal.inbox.with_twins`).
    """

    name: str
    machine: str
    inbox: Path
    controllers: tuple[str, ...]
    out: Path
    measured_with: str
    patterns: tuple[str, ...] = PATTERNS
    schedule: Schedule | None = None
    approval: str = "manual"
    instrument: Path | None = None
    templates: Path | None = None
    allow_unverified: bool = False
    notify: tuple[str, ...] = ()
    settle_s: float = 0.0
    max_size_mb: float = 100.0
    max_minutes: float = 60.0
    policy: Policy = Policy()
    identify: Mapping[str, Any] = field(default_factory=dict)
    tolerances: Mapping[str, float] = field(default_factory=dict)
    others: tuple[OtherInbox, ...] = field(default=(), compare=False, repr=False)

    def settings_sha256(self) -> str:
        """Return the SHA-256 of everything but the measurement that a result depends on."""
        files = [load_machine(self.machine).source, self.instrument]
        digests = [sha256_of(read_bytes(path)) for path in files if path is not None]
        own = {"controllers": self.controllers, "measured_with": self.measured_with, "identify": dict(self.identify)}
        rules = {"policy": asdict(self.policy), "unverified": self.allow_unverified, "templates": str(self.templates)}
        if self.max_minutes != MachineJob.max_minutes:  # who allows more time wants what took too long tried again
            rules["max_minutes"] = self.max_minutes
        return sha256_of(json.dumps([digests, own, rules], sort_keys=True).encode())


@dataclass(frozen=True)
class Job:
    """A job file: where the store is, and the machines by name."""

    path: Path
    store: str
    machines: Mapping[str, MachineJob]

    def with_notify(self, command: tuple[str, ...]) -> Job:
        """Return the job with this notification command for all machines; an empty one changes nothing."""
        if not command:
            return self
        return replace(self, machines={name: replace(item, notify=command) for name, item in self.machines.items()})

    def machine(self, name: str) -> MachineJob:
        """Return one machine; InputError names the nearest if there is none of that name."""
        if name not in self.machines:
            raise InputError(f"no machine is named {name!r}; {nearest(name, self.machines)}", file=self.path)
        return self.machines[name]


class _Keys:
    """Takes each key from the machine's section, else from ``[defaults]``."""

    def __init__(self, own: Section, defaults: Section) -> None:
        self.own, self.defaults = own, defaults

    def take(self, key: str, check: Callable[[Any], T], default: D) -> T | D:
        fallback = self.defaults.take(key, check, default)
        return self.own.take(key, check, fallback) if key in self.own else fallback

    def need(self, key: str, check: Callable[[Any], T]) -> T:
        """Take a key that has to stand in one of the two sections."""
        found = self.take(key, check, None)
        return self.own.take(key, check) if found is None else found

    def section(self, key: str) -> _Keys:
        return _Keys(self.own.section(key, required=False), self.defaults.section(key, required=False))

    def finish(self) -> None:
        self.own.finish()
        self.defaults.finish()


def read_job(path: str | Path) -> Job:
    """Read a job file strictly; InputError with file, line and key for whatever is unknown, missing or impossible."""
    return _job_of(tomlio.read_toml(path), Path(path).absolute())


def job_of_text(text: str, path: Path) -> Job:
    """Return the job that ``text`` would be as the file ``path``; errors as :func:`read_job` has them."""
    import tomllib

    try:
        return _job_of(Section(tomllib.loads(text), path=path, text=text), path.absolute())
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", file=path) from error


def _job_of(root: Section, path: Path) -> Job:
    folder = path.parent
    store = root.take("store", tomlio.text_of_path, "recal.sqlite")
    defaults = root.section("defaults", required=False)
    every = root.section("machines", required=False)
    machines = {}
    for name in every.data:
        if not NAME.fullmatch(name):
            raise every.fail(name, "is not a name: letters, digits, '.', '_' and '-', at most 64, are allowed")
        machines[name] = _machine(name, _Keys(every.section(name), defaults), folder)
    if not machines:
        _options(_Keys(Section({}, path=path), defaults), folder, "")
    root.finish()
    _check_folders(every, machines)
    shared: dict[str, list[OtherInbox]] = {}
    for name, machine in machines.items():
        shared.setdefault(os.path.realpath(machine.inbox), []).append(OtherInbox(name, machine.inbox, machine.patterns))
    for group in shared.values():
        for own in group if len(group) > 1 else ():
            machines[own.name] = replace(machines[own.name], others=tuple(item for item in group if item != own))
    return Job(path, store if "://" in store else f"sqlite:///{folder / store}", machines)


def _check_folders(every: Section, machines: Mapping[str, MachineJob]) -> None:
    """Refuse folders ``out`` that are the same or lie in each other, whatever links and ``..`` lead there."""
    real = {name: Path(os.path.realpath(machine.out)) for name, machine in machines.items()}
    known = {path: name for name, path in reversed(real.items())}
    for name, path in real.items():
        if known[path] != name:
            raise every.fail(name, f"has the same folder out as {known[path]} ({path}); give each machine its own")
        around = next((parent for parent in path.parents if parent in known), None)
        if around is not None:
            raise every.fail(
                name,
                f"has its folder out ({path}) inside that of {known[around]} ({around}); give each machine its own, beside "
                "each other",
            )


def _machine(name: str, keys: _Keys, folder: Path) -> MachineJob:
    def path(value: Any) -> str:
        return tomlio.text_of_path(value).replace("{name}", name)

    options = _options(keys, folder, name)
    machine = keys.need("machine", path)
    is_file = machine.endswith(".toml") or len(Path(machine).parts) > 1
    job = MachineJob(
        name=name,
        machine=str(folder / machine) if is_file else machine,
        inbox=folder / keys.need("inbox", path),
        controllers=keys.need("controllers", _controllers),
        out=folder / keys.need("out", path),
        measured_with=_measured_with(keys),
        **options,
    )
    keys.finish()
    return job


def _measured_with(keys: _Keys) -> str:
    check = tomlio.choice("active", "bare")
    if keys.take("measured_with", check, None) is None:
        raise keys.own.fail(
            "measured_with",
            "is missing; say 'active' if the compensation stays on while the machine is measured, 'bare' if it is "
            "switched off. The wrong one compensates twice or not at all",
        )
    return keys.need("measured_with", check)


def _options(keys: _Keys, folder: Path, name: str) -> dict[str, Any]:
    def path(value: Any) -> Path:
        return folder / tomlio.text_of_path(value).replace("{name}", name)

    return {
        "patterns": keys.take("patterns", _patterns, PATTERNS),
        "schedule": _schedule(keys),
        "approval": keys.take("approval", tomlio.choice("manual", "auto"), "manual"),
        "instrument": keys.take("instrument", path, None),
        "templates": keys.take("templates", path, None),
        "allow_unverified": keys.take("allow_unverified", tomlio.flag, False),
        "notify": keys.take("notify", command_words, ()),
        "settle_s": keys.take("settle_s", tomlio.not_negative, 0.0),
        "max_size_mb": keys.take("max_size_mb", tomlio.positive, MachineJob.max_size_mb),
        "max_minutes": keys.take("max_minutes", tomlio.positive, MachineJob.max_minutes),
        "policy": _policy(keys.section("policy")),
        "identify": _identify(keys.section("identify")),
        "tolerances": _tolerances(keys.section("tolerances")),
    }


def _schedule(keys: _Keys) -> Schedule | None:
    every = keys.take("every_minutes", tomlio.whole(1, 527040), None)
    expression = keys.take("schedule", cron, None)
    both_own = "every_minutes" in keys.own and "schedule" in keys.own
    if both_own or (every and expression and not {"every_minutes", "schedule"} & set(keys.own.data)):
        raise keys.own.fail("schedule", "stands beside every_minutes; give one of the two")
    if every is not None and (expression is None or "every_minutes" in keys.own):
        return Every(every)
    return expression


def _policy(keys: _Keys) -> Policy:
    default = Policy()
    policy = Policy(
        max_age_days=keys.take("max_age_days", tomlio.positive, default.max_age_days),
        temperature_c=keys.take("temperature_c", tomlio.interval, None),
        confidence=keys.take("confidence", _confidence, default.confidence),
        min_shrink_um=keys.take("min_shrink_um", tomlio.not_negative, 0.0),
        max_change_um=keys.take("max_change_um", tomlio.positive, None),
        max_reference_um=keys.take("max_reference_um", tomlio.positive, None),
        max_step_um=keys.take("max_step_um", tomlio.positive, None),
        clock_minutes=keys.take("clock_minutes", tomlio.not_negative, default.clock_minutes),
    )
    keys.finish()
    return policy


def _identify(keys: _Keys) -> dict[str, Any]:
    names = ("u_length_um", "u_length_um_per_m", "u_deviation_um")
    found: dict[str, Any] = {name: keys.take(name, tomlio.not_negative, None) for name in names}
    found["temperature"] = keys.take("temperature", tomlio.flag, True)
    found["small_deviations"] = keys.take("small_deviations", tomlio.flag, False) or None  # so that the hash stays
    keys.finish()
    return {name: value for name, value in found.items() if value is not None}


def _tolerances(keys: _Keys) -> dict[str, float]:
    units = {f"{name}_{error_named(name).unit}": (name, error_named(name).si_per_unit) for name in ERROR_NAMES}
    units["volume_um"] = ("volume", MM_PER_UM)
    given = {units[key][0]: (keys.take(key, tomlio.positive, None), units[key][1]) for key in units}
    keys.finish()
    return {name: size * unit for name, (size, unit) in given.items() if size is not None}


def _confidence(value: Any) -> float:
    result = tomlio.number(value)
    if not 0.5 <= result < 1.0:
        raise ValueError("a confidence from 0.5 to below 1, for example 0.95, is expected")
    return result


def _controllers(value: Any) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError("a list of controls, for example ['siemens-cec'], is expected")
    for name in names:
        if name not in CONTROLLERS:
            raise ValueError(f"{name!r} is not a controller; {nearest(name, CONTROLLERS)}")
    return tuple(dict.fromkeys(names))


def _patterns(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(item, str) and item for item in value):
        raise ValueError("a list of file patterns, for example ['*.lengths.csv'], is expected")
    if any("/" in item or item.startswith("..") for item in value):
        raise ValueError("patterns of file names, without folders, are expected")
    return tuple(value)


def command_words(value: Any) -> tuple[str, ...]:
    """Return a command as its words: a list, or one text that is split as a shell does."""
    words = shlex.split(value) if isinstance(value, str) else value
    if not isinstance(words, list) or not words or not all(isinstance(word, str) and word for word in words):
        raise ValueError("a command, as a list of its words, is expected")
    return tuple(words)
