"""Records that the store returns (frozen, times in UTC), the states of a set of tables, and requests of a person.

``volcomp recal --help`` loads this module, so it imports no library.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from compgen.data.names import ERROR_NAMES, error_named
from compgen.data.toml_files import option
from compgen.errors import InputError, nearest

#: State of a set of tables, from the last decision about it.
TableState = Literal["pending", "held", "refused", "superseded", "rejected", "active", "retired"]
DecisionKind = Literal["propose", "hold", "refuse", "supersede", "approve", "reject", "rollback"]

#: Kinds of events. The clock of the store went back; the message ends with the time of the newest entry.
CLOCK = "clock"
#: A machine's folder was given to this store, or was found to be empty: the store does not know which tables are on.
ADOPTED = "adopted"
#: A backup of the control came with a measurement.
EVIDENCE = "evidence"
#: The history comes from a backup, whose last entry is of the time that is the subject of the event.
RESTORED = "restored"
#: Prefix of a reason that is shown with the tables but does not hold them back.
RESERVATION = "reservation: "


@dataclass(frozen=True)
class MachineRecord:
    """A machine with its name in the job file."""

    id: int
    name: str
    at: datetime


@dataclass(frozen=True)
class MeasurementRecord:
    """One measurement, identified by the SHA-256 of its files.

    ``measured_at`` comes from the file's comment ``measured_at`` (``measured_at_source`` = "file"; "file, no zone" if it
    has no time zone and is taken as local time) or from the file's time stamp ("file time"). ``active_table`` is the
    comment ``active_table``: a version or "none"; None if the file does not state it. ``temperatures_c`` contains the
    lowest, mean and highest value of each channel. ``files`` are name and SHA-256.
    """

    id: int
    machine_id: int
    sha256: str
    name: str
    measured_at: datetime
    measured_at_source: str
    received_at: datetime
    active_table: str | None
    temperatures_c: Mapping[str, Mapping[str, float]]
    files: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class AttemptRecord:
    """One attempt to process a measurement: ``outcome`` "done" or "failed"; ``message`` says why."""

    id: int
    machine_id: int
    measurement_id: int
    outcome: str
    message: str
    settings_sha256: str
    owner: str
    seconds: float
    at: datetime


@dataclass(frozen=True)
class IdentificationRecord:
    """Errors of the bare machine from one measurement; contents through ``Store.errors_of`` and ``covariance_of``.

    ``active_table_id`` is the set of tables that was active during the measurement and whose effect was removed;
    ``revision`` counts how often the measurement was identified.
    """

    id: int
    machine_id: int
    measurement_id: int
    machine_version_id: int
    active_table_id: int | None
    errors_sha256: str
    covariance_sha256: str | None
    fitted_sha256: str | None
    summary: Mapping[str, Any]
    program: str
    at: datetime
    measured_at: datetime
    revision: int = 1

    @property
    def without_prior(self) -> bool:
        """Whether its uncertainties have nothing of errors that were not measured (:func:`has_prior`)."""
        return not has_prior(self.summary)


@dataclass(frozen=True)
class TableRecord:
    """A set of tables of one machine; ``version`` counts from 1.

    ``accepted`` says whether the round trip accepted the files. ``reasons`` state why the policy holds them back; those
    that begin with :data:`RESERVATION` are reservations of the verdict and hold nothing back. ``summary`` contains the
    figures of the judgement, ``state`` follows from the last decision.
    """

    id: int
    machine_id: int
    version: int
    identification_id: int
    accepted: bool
    controllers: Sequence[str]
    reasons: Sequence[str]
    summary: Mapping[str, Any]
    at: datetime
    state: TableState


@dataclass(frozen=True)
class DecisionRecord:
    """Who decided what, when and why; ``table_id`` is None where a rollback leaves no table active."""

    id: int
    machine_id: int
    sequence: int
    table_id: int | None
    kind: DecisionKind
    actor: str
    reason: str
    at: datetime


@dataclass(frozen=True)
class EventRecord:
    """An event other than a decision: an unreadable file, a clock that went backwards."""

    id: int
    machine_id: int | None
    kind: str
    subject: str
    message: str
    at: datetime


@dataclass(frozen=True)
class EvidenceRecord:
    """A backup of the control that came with a measurement: what it held while the machine was measured.

    ``files`` are name, SHA-256 and time of change of each file, ``source`` is where it came from. ``key`` identifies the
    contents: a measurement was judged with this evidence if an attempt at it has this message.
    """

    measurement_id: int
    source: str
    files: Sequence[tuple[str, str, str]]
    at: datetime

    @property
    def key(self) -> str:
        """Identify names and contents."""
        return " ".join(["evidence", *(f"{name}:{digest}" for name, digest, _ in self.files)])

    @property
    def names(self) -> str:
        """Names of the files."""
        return ", ".join(name for name, _, _ in self.files)


@dataclass(frozen=True)
class StoredTableFile:
    """One file of a set of tables: its control, name and contents."""

    controller: str
    name: str
    content: bytes


@dataclass(frozen=True)
class NewMeasurement:
    """A measurement to be stored: contents by file name, and what is known about it, see :class:`MeasurementRecord`."""

    sha256: str
    name: str
    measured_at: datetime
    measured_at_source: str
    contents: Mapping[str, bytes]
    active_table: str | None = None
    temperatures_c: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class NewResult:
    """Result of processing a measurement, stored in one transaction.

    ``hold`` lists why the policy holds the tables back, ``reservations`` what is shown with them; with ``approve`` the
    tables become active at once unless held or not accepted. ``revision`` counts how often the measurement has been
    identified; from the second time on ``actor`` and ``reason`` say who requested it and why. ``evidence`` is the key of the
    backup that showed which tables were on, "" for none.
    """

    machine_text: bytes
    errors_text: bytes
    covariance: bytes | None
    fitted_text: bytes | None
    summary: Mapping[str, Any]
    program: str
    active_table_id: int | None
    files: Sequence[StoredTableFile]
    accepted: bool
    hold: Sequence[str]
    judgement: Mapping[str, Any]
    approve: bool
    settings_sha256: str
    seconds: float
    revision: int = 1
    actor: str = ""
    reason: str = ""
    reservations: Sequence[str] = ()
    evidence: str = ""


#: Mark of what was identified without a prior.
WITHOUT_PRIOR = "without prior"


def has_prior(figures: Mapping[str, Any]) -> bool:
    """Whether an identification, by its figures, had a prior: not one of an earlier program, nor of class none.

    >>> has_prior({"prior": {"class": "general"}}), has_prior({"prior": {"class": "none"}}), has_prior({})
    (True, False, False)
    """
    prior = figures.get("prior")
    return isinstance(prior, Mapping) and prior.get("class", "none") != "none"


def comparable(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether the uncertainties of two identifications, by their figures, may be compared.

    Both have a prior, or neither; or the readings alone determine what the one with the prior found, and the other found
    it as well.
    """
    if has_prior(first) == has_prior(second):
        return True
    known, other = (first, second) if has_prior(first) else (second, first)
    found = {*known.get("identified", ())}
    return bool(found) and found <= {*known.get("determined", ())} and found <= {*other.get("identified", ())}


def reservations_of(reasons: Sequence[str]) -> list[str]:
    """Return the reasons that do not hold the tables back, without their prefix."""
    return [text.removeprefix(RESERVATION) for text in reasons if text.startswith(RESERVATION)]


# --- states of a set of tables, as they follow from the decisions --------------------------------------------------
#
# propose -> pending        approve -> active       another approved -> retired    rollback to it -> active
# hold    -> held           reject  -> rejected     a newer proposal -> superseded
# refuse  -> refused        (the round trip did not accept the files: final)


#: Actor of decisions that no person makes.
AUTOMATIC = "automatic"
#: State of a set of tables right after a decision about it.
AFTER: dict[DecisionKind, TableState] = {
    "propose": "pending",
    "hold": "held",
    "refuse": "refused",
    "supersede": "superseded",
    "approve": "active",
    "reject": "rejected",
    "rollback": "active",
}
#: States in which a person may decide.
OPEN: tuple[TableState, ...] = ("pending", "held")
#: States in which the policy or the round trip objects to the tables.
HELD_BACK: tuple[TableState, ...] = ("held", "refused")
#: States from which a rollback may reactivate tables.
WAS_ACTIVE: tuple[TableState, ...] = ("retired",)


def active_id(decisions: Sequence[DecisionRecord]) -> int | None:
    """Return the id of the tables that are active after the decisions of one machine, None if none are."""
    for decision in reversed(decisions):
        if decision.kind in ("approve", "rollback"):
            return decision.table_id
    return None


def active_of(tables: Iterable[TableRecord]) -> TableRecord | None:
    """Return the active one of a machine's sets of tables, None if none is."""
    return next((table for table in tables if table.state == "active"), None)


def state_of(table_id: int, decisions: Sequence[DecisionRecord]) -> TableState:
    """Return the state of one set of tables after the decisions of its machine."""
    about_it = [decision for decision in decisions if decision.table_id == table_id]
    if not about_it:
        return "held"
    state = AFTER[about_it[-1].kind]
    return "retired" if state == "active" and active_id(decisions) != table_id else state


def before_active(decisions: Sequence[DecisionRecord]) -> int | None:
    """Return the id of the tables that were active before the active ones were first approved, None if none were.

    What a rollback undid counts as if it had never happened: after versions 1, 2, 3 and a rollback to 2, this is 1.
    """
    stack: list[int | None] = [None]
    for decision in decisions:
        if decision.kind == "approve":
            stack.append(decision.table_id)
        elif decision.kind == "rollback":
            if decision.table_id in stack:
                last = len(stack) - 1 - stack[::-1].index(decision.table_id)
                del stack[last + 1 :]
            else:
                stack.append(decision.table_id)
    return stack[-2] if len(stack) > 1 else None


# --- requests of a person ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RequestedChange:
    """A change to be detected: ``size`` in mm or rad (of the squareness, or of the line or bow of a curve)."""

    error: str = option(required=True, metavar="NAME", text="Error whose change is to be seen, e.g. EC0Y.")
    size: float = option(required=True, name="--change", metavar="SIZE", text="Its size, um or urad.")
    power: float = option(0.9, "Probability of seeing it.")
    confidence: float = option(0.95, "1 - probability of a false alarm.")

    @classmethod
    def from_file_units(cls, error: str, size: float, **how: float) -> RequestedChange:
        """Return the change of ``size`` um or urad; InputError for an unknown error name."""
        if error not in ERROR_NAMES:
            raise InputError(f"{error!r} is not an error; {nearest(error, ERROR_NAMES)}", field="--error")
        return cls(error, size * error_named(error).si_per_unit, **how)


@dataclass(frozen=True)
class ReprocessRequest:
    """Measurement to be processed again (None: the newest), who requests it and why; neither may be empty.

    ``active_table`` states which tables were on during the measurement, a version or "none"; None: as the file states.
    ``backup`` are files of the control that show it.
    """

    measurement: str | None = option(
        None,
        "Its number in `history --json`, or the beginning of its SHA-256; default: the newest.",
        metavar="ID",
    )
    actor: str = ""
    reason: str = ""
    active_table: str | None = option(
        None,
        "The tables that were active while the machine was measured, for a measurement that is held back because that is "
        "not certain; default: what file, job and history say.",
        metavar="VERSION|none",
    )
    backup: tuple[Path, ...] = ()
