"""``certificate.toml``: what only the laboratory knows about a calibration; no default makes a statement."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgen.data.toml_files import Section, choice, flag, number, read_toml, text

#: Where a calibration was done, in the words of the schema.
LOCATIONS = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")
MOST_CHARACTERS = 4000


@dataclass(frozen=True)
class Contact:
    """A laboratory or a customer; empty means not given."""

    name: str
    city: str
    country: str
    street: str = ""
    street_number: str = ""
    post_code: str = ""
    email: str = ""
    phone: str = ""


@dataclass(frozen=True)
class Person:
    """A person responsible for the certificate."""

    name: str
    role: str = ""
    email: str = ""
    main_signer: bool | None = None


@dataclass(frozen=True)
class Thing:
    """The machine, its control or an instrument; ``name`` may be empty for the machine: its file has the name."""

    name: str
    serial_number: str
    manufacturer: str = ""
    model: str = ""
    inventory_number: str = ""
    software_version: str = ""
    certificate_number: str = ""
    certificate_sha256: str = ""
    certificate_by: str = ""
    certificate_file: Path | None = None


@dataclass(frozen=True)
class Condition:
    """A condition during the measurement: lowest and highest value in a D-SI unit, with the stem of its refTypes."""

    name: str
    unit: str
    lowest: float
    highest: float
    ref_type: str = ""


@dataclass(frozen=True)
class Certificate:
    """All of ``certificate.toml``."""

    number: str
    country: str
    begin: datetime.date | None
    end: datetime.date | None
    location: str
    laboratory: Contact
    customer: Contact
    persons: tuple[Person, ...]
    machine: Thing
    equipment: tuple[Thing, ...]
    received: datetime.date | None = None
    issued: datetime.date | None = None
    laboratory_code: str = ""
    control: Thing | None = None
    conditions: tuple[Condition, ...] = ()
    statements: tuple[tuple[str, str], ...] = ()
    order: str = ""
    place: str = ""


#: Keys of ``[conditions]``: name, D-SI unit, refType of the public list, plausible limits.
CONDITIONS: dict[str, tuple[str, str, str, tuple[float, float]]] = {
    "air_temperature_c": ("Air temperature", "\\degreeCelsius", "basic_temperature", (-60.0, 100.0)),
    "machine_temperature_c": ("Temperature of the machine", "\\degreeCelsius", "basic_temperature", (-60.0, 100.0)),
    "humidity_percent": ("Relative humidity of the air", "\\percent", "basic_humidityRelative", (0.0, 100.0)),
    "pressure_hpa": ("Air pressure", "\\hecto\\pascal", "", (500.0, 1200.0)),
}


def date(value: Any) -> datetime.date:
    """A date without a time."""
    if not isinstance(value, datetime.date) or isinstance(value, datetime.datetime):
        raise ValueError("expected a date such as 2026-11-21, without quotation marks")
    return value


def country(value: Any) -> str:
    """A country code of ISO 3166-1."""
    if not isinstance(value, str) or not re.fullmatch("[A-Z]{2}", value):
        raise ValueError("expected two capital letters of ISO 3166-1, such as DE")
    return value


def sha256(value: Any) -> str:
    """A SHA-256 as hexadecimal digits."""
    if not isinstance(value, str) or not re.fullmatch("[0-9a-fA-F]{64}", value):
        raise ValueError("expected 64 hexadecimal digits")
    return value.lower()


def long_text(value: Any) -> str:
    """A text of several lines."""
    if not isinstance(value, str) or not value.strip() or len(value) > MOST_CHARACTERS:
        raise ValueError(f"expected a text of at most {MOST_CHARACTERS} characters")
    return value


def range_within(limits: tuple[float, float]) -> Callable[[Any], tuple[float, float]]:
    """One number, or the lowest and the highest one, within ``limits``."""

    def check(value: Any) -> tuple[float, float]:
        message = f"expected a number, or two numbers [lowest, highest], from {limits[0]:g} to {limits[1]:g}"
        values = value if isinstance(value, list) else [value, value]
        if len(values) != 2:
            raise ValueError(message)
        low, high = (number(item) for item in values)
        if not limits[0] <= low <= high <= limits[1]:
            raise ValueError(message)
        return low, high

    return check


#: Keys of every table, in the order in which they are read; "?" marks optional ones.
KEYS: dict[str, tuple[str, ...]] = {
    "contact": ("name", "city", "country", "street?", "street_number?", "post_code?", "email?", "phone?"),
    "person": ("name", "role?", "email?", "main_signer?"),
    "machine": ("name?", "serial_number", "manufacturer", "model?", "inventory_number?"),
    "control": ("name", "serial_number", "manufacturer?", "model?", "software_version?"),
    "equipment": (
        "name", "serial_number", "manufacturer?", "model?", "certificate_number?", "certificate_sha256?",
    ),
    "statement": ("name", "text"),
}  # fmt: skip
#: Keys whose value is not one line of text.
CHECKS: dict[str, Callable[[Any], Any]] = {
    "country": country,
    "main_signer": flag,
    "certificate_sha256": sha256,
    "text": long_text,
}


def read_certificate(path: str | Path, *, complete: bool = True) -> Certificate:
    """Read ``certificate.toml``.

    ``complete`` is False for a page that says itself what is missing: then keys may be missing, and are empty.

    Raises
    ------
    InputError
        for a key that is missing (if ``complete``), unknown, or has an invalid value; the message names it.
    """
    root = read_toml(path)
    needed: tuple[Any, ...] = () if complete else (None,)
    named: tuple[Any, ...] = () if complete else ("",)
    core = root.section("certificate", required=complete)
    begin, end = core.take("begin", date, *needed), core.take("end", date, *needed)
    if begin is not None and end is not None and end < begin:
        raise core.fail("end", f"{end} is before begin, {begin}")
    laboratory = root.section("laboratory", required=complete)
    contact = _values(laboratory, "contact", complete=complete)
    control = root.section("control", required=False)
    found = Certificate(
        number=core.take("number", text, *named),
        country=core.take("country", country, *named),
        begin=begin,
        end=end,
        location=core.take("location", choice(*LOCATIONS), *named),
        laboratory=Contact(**contact),
        laboratory_code=laboratory.take("code", text, ""),
        customer=Contact(**_closed(root.section("customer", required=complete), "contact", complete=complete)),
        persons=tuple(Person(**values) for values in _listed(root, "person", complete=complete)),
        machine=Thing(
            **{"name": "", **_closed(root.section("machine", required=complete), "machine", complete=complete)}
        ),
        equipment=tuple(Thing(**values) for values in _listed(root, "equipment", complete=complete)),
        received=core.take("received", date, None),
        issued=core.take("issued", date, None),
        control=Thing(**_closed(control, "control")) if control.data else None,
        conditions=_conditions(root.section("conditions", required=False)),
        statements=tuple((item["name"], item["text"]) for item in _all(root, "statement")),
        order=core.take("order", text, ""),
        place=core.take("place", text, ""),
    )
    if found.received is not None and end is not None and found.received > end:
        raise core.fail("received", f"{found.received} is after the end of the measurement, {end}")
    if found.issued is not None and end is not None and found.issued < end:
        raise core.fail("issued", f"{found.issued} is before the end of the measurement, {end}")
    for section in (laboratory, core, root):
        section.finish()
    return found


def _values(section: Section, kind: str, *, complete: bool = True) -> dict[str, Any]:
    """Return the keys of a kind of table; omitted ones are empty."""
    found = {}
    for entry in KEYS[kind]:
        key = entry.removesuffix("?")
        check = CHECKS.get(key, text)
        empty = None if check is flag else ""
        optional = entry.endswith("?") or not complete
        found[key] = section.take(key, check, empty) if optional else section.take(key, check)
    if kind == "equipment" and (file := section.file("certificate_file")) is not None:
        found |= _by_reference(section, found, file)
    if found.get("certificate_sha256") and not found["certificate_number"]:
        raise section.fail(
            "certificate_sha256", "needs certificate_number, the number of the certificate with this hash"
        )
    return found


def _by_reference(section: Section, stated: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return what the DCC of an instrument says of its calibration; InputError where it is that of another one."""
    from compgen.report.dcc.reading import read_dcc

    read = read_dcc(file)
    for key, own in (("certificate_number", read.number), ("certificate_sha256", read.sha256)):
        if stated[key] and stated[key] != own:
            raise section.fail(key, f"{stated[key]} is stated, but {file.name} has {own}")
    if stated["serial_number"] and stated["serial_number"] not in read.numbers:
        known = ", ".join(read.numbers) or "none"
        raise section.fail(
            "serial_number", f"{stated['serial_number']} is not in {file.name}, which identifies its items by {known}"
        )
    said = ", ".join(part for part in (read.laboratory, f"measured {read.end}") if part)
    return {
        "certificate_number": read.number,
        "certificate_sha256": read.sha256,
        "certificate_by": said,
        "certificate_file": file,
    }


def _closed(section: Section, kind: str, *, complete: bool = True) -> dict[str, Any]:
    """Return the values of a table without further keys."""
    found = _values(section, kind, complete=complete)
    section.finish()
    return found


def _all(root: Section, key: str, *, complete: bool = True) -> list[dict[str, Any]]:
    return [_closed(section, key, complete=complete) for section in root.sections(key)]


def _listed(root: Section, key: str, *, complete: bool) -> list[dict[str, Any]]:
    """Return an array of tables, with at least one entry where the certificate must be complete."""
    found = _all(root, key, complete=complete)
    if complete and not found:
        raise root.fail(key, f"is missing; the schema or ISO/IEC 17025 requires at least one [[{key}]]")
    return found


def _conditions(section: Section) -> tuple[Condition, ...]:
    found = []
    for key, (name, unit, ref_type, limits) in CONDITIONS.items():
        values = section.take(key, range_within(limits), None)
        if values is not None:
            found.append(Condition(name, unit, *values, ref_type))
    section.finish()
    return tuple(found)
