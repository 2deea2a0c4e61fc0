"""``certificate.toml``: what only the laboratory knows of a calibration. Nothing in it has a default that says something."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgen.core.tomlio import Section, choice, flag, number, read_toml, text

#: Where a calibration was done, as the schema names it.
LOCATIONS = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")
MOST_CHARACTERS = 4000


@dataclass(frozen=True)
class Contact:
    """A laboratory or a customer; empty texts were not given."""

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
    """Somebody who answers for the certificate."""

    name: str
    role: str = ""
    email: str = ""
    main_signer: bool | None = None


@dataclass(frozen=True)
class Thing:
    """The machine, its control or an instrument; ``name`` may be empty for the machine: its file names it."""

    name: str
    serial_number: str
    manufacturer: str = ""
    model: str = ""
    inventory_number: str = ""
    software_version: str = ""
    certificate_number: str = ""
    certificate_sha256: str = ""


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
    begin: datetime.date
    end: datetime.date
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


#: Keys of ``[conditions]``: name, D-SI unit, refType of the public list, limits of sense.
CONDITIONS: dict[str, tuple[str, str, str, tuple[float, float]]] = {
    "air_temperature_c": ("Air temperature", "\\degreeCelsius", "basic_temperature", (-60.0, 100.0)),
    "machine_temperature_c": ("Temperature of the machine", "\\degreeCelsius", "basic_temperature", (-60.0, 100.0)),
    "humidity_percent": ("Relative humidity of the air", "\\percent", "basic_humidityRelative", (0.0, 100.0)),
    "pressure_hpa": ("Air pressure", "\\hecto\\pascal", "", (500.0, 1200.0)),
}


def date(value: Any) -> datetime.date:
    """A date without a time."""
    if not isinstance(value, datetime.date) or isinstance(value, datetime.datetime):
        raise ValueError("a date as 2026-11-21, without quotation marks, is expected")
    return value


def country(value: Any) -> str:
    """A country code of ISO 3166-1."""
    if not isinstance(value, str) or not re.fullmatch("[A-Z]{2}", value):
        raise ValueError("two capital letters of ISO 3166-1, such as DE, are expected")
    return value


def sha256(value: Any) -> str:
    """A SHA-256 as hexadecimal digits."""
    if not isinstance(value, str) or not re.fullmatch("[0-9a-fA-F]{64}", value):
        raise ValueError("64 hexadecimal digits are expected")
    return value.lower()


def long_text(value: Any) -> str:
    """A text of several lines."""
    if not isinstance(value, str) or not value.strip() or len(value) > MOST_CHARACTERS:
        raise ValueError(f"a text of at most {MOST_CHARACTERS} characters is expected")
    return value


def range_within(limits: tuple[float, float]) -> Callable[[Any], tuple[float, float]]:
    """One number, or the lowest and the highest one, within ``limits``."""

    def check(value: Any) -> tuple[float, float]:
        message = f"a number, or two numbers [lowest, highest], from {limits[0]:g} to {limits[1]:g} are expected"
        values = value if isinstance(value, list) else [value, value]
        if len(values) != 2:
            raise ValueError(message)
        low, high = (number(item) for item in values)
        if not limits[0] <= low <= high <= limits[1]:
            raise ValueError(message)
        return low, high

    return check


def read_certificate(path: str | Path) -> Certificate:
    """Read ``certificate.toml``.

    Raises
    ------
    InputError
        for a key that is missing, not known, or holds something else than it should; the message names it.
    """
    root = read_toml(path)
    core = root.section("certificate")
    begin, end = _performed(core)
    laboratory, code = _laboratory(root)
    control = root.section("control", required=False)
    found = Certificate(
        number=core.take("number", text),
        country=core.take("country", country),
        begin=begin,
        end=end,
        location=core.take("location", choice(*LOCATIONS)),
        laboratory=laboratory,
        customer=_closed(root.section("customer"), _contact),
        persons=_some(root, "person", _person),
        machine=_closed(root.section("machine"), _machine),
        equipment=_some(root, "equipment", _instrument),
        received=_until(core, "received", end),
        issued=_from(core, "issued", end),
        laboratory_code=code,
        control=_closed(control, _control) if control.data else None,
        conditions=_conditions(root.section("conditions", required=False)),
        statements=tuple(_closed(item, _statement) for item in root.sections("statement")),
    )
    core.finish()
    root.finish()
    return found


def _closed(section: Section, read: Callable[[Section], Any]) -> Any:
    """What ``read`` makes of a section in which it takes every key."""
    found = read(section)
    section.finish()
    return found


def _some(root: Section, key: str, read: Callable[[Section], Any]) -> tuple[Any, ...]:
    """An array of tables with at least one entry."""
    sections = root.sections(key)
    if not sections:
        raise root.fail(key, f"is missing; the schema or ISO/IEC 17025 asks for at least one [[{key}]]")
    return tuple(_closed(section, read) for section in sections)


def _performed(core: Section) -> tuple[datetime.date, datetime.date]:
    begin, end = core.take("begin", date), core.take("end", date)
    if end < begin:
        raise core.fail("end", f"{end} lies before begin, {begin}")
    return begin, end


def _until(core: Section, key: str, last: datetime.date) -> datetime.date | None:
    found = core.take(key, date, None)
    if found is not None and found > last:
        raise core.fail(key, f"{found} lies after the end of the measurement, {last}")
    return found


def _from(core: Section, key: str, first: datetime.date) -> datetime.date | None:
    found = core.take(key, date, None)
    if found is not None and found < first:
        raise core.fail(key, f"{found} lies before the end of the measurement, {first}")
    return found


def _laboratory(root: Section) -> tuple[Contact, str]:
    section = root.section("laboratory")
    found = _contact(section), section.take("code", text, "")
    section.finish()
    return found


def _contact(section: Section) -> Contact:
    return Contact(
        name=section.take("name", text),
        city=section.take("city", text),
        country=section.take("country", country),
        street=section.take("street", text, ""),
        street_number=section.take("street_number", text, ""),
        post_code=section.take("post_code", text, ""),
        email=section.take("email", text, ""),
        phone=section.take("phone", text, ""),
    )


def _person(section: Section) -> Person:
    return Person(
        name=section.take("name", text),
        role=section.take("role", text, ""),
        email=section.take("email", text, ""),
        main_signer=section.take("main_signer", flag, None),
    )


def _machine(section: Section) -> Thing:
    return Thing(
        name=section.take("name", text, ""),
        serial_number=section.take("serial_number", text),
        manufacturer=section.take("manufacturer", text),
        model=section.take("model", text, ""),
        inventory_number=section.take("inventory_number", text, ""),
    )


def _control(section: Section) -> Thing:
    return Thing(
        name=section.take("name", text),
        serial_number=section.take("serial_number", text),
        manufacturer=section.take("manufacturer", text, ""),
        model=section.take("model", text, ""),
        software_version=section.take("software_version", text, ""),
    )


def _instrument(section: Section) -> Thing:
    found = Thing(
        name=section.take("name", text),
        serial_number=section.take("serial_number", text),
        manufacturer=section.take("manufacturer", text, ""),
        model=section.take("model", text, ""),
        certificate_number=section.take("certificate_number", text, ""),
        certificate_sha256=section.take("certificate_sha256", sha256, ""),
    )
    if found.certificate_sha256 and not found.certificate_number:
        raise section.fail("certificate_sha256", "needs certificate_number: the certificate that it is the hash of")
    return found


def _conditions(section: Section) -> tuple[Condition, ...]:
    found = []
    for key, (name, unit, ref_type, limits) in CONDITIONS.items():
        values = section.take(key, range_within(limits), None)
        if values is not None:
            found.append(Condition(name, unit, *values, ref_type))
    section.finish()
    return tuple(found)


def _statement(section: Section) -> tuple[str, str]:
    return section.take("name", text), section.take("text", long_text)
