"""What makes a report one that can be handed to a customer: for whom, by whom, where, with what, under which conditions.

The list is that of ISO/IEC 17025:2017, 7.8.2 and 7.8.4. What ``certificate.toml`` does not state is taken from the measurement
files where they name it, otherwise it is listed as missing with the key that states it: nothing is invented.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from compgen.report.dcc.laboratory import Certificate, Condition, Contact, Thing

#: Facts of a report: heading, key of ``certificate.toml``, and the name of the fact in the measurement files.
FACTS = (
    ("Customer", "[customer] name", "customer"),
    ("Order number", "[certificate] order", "order_number"),
    ("Certificate number", "[certificate] number", "certificate_number"),
    ("Laboratory", "[laboratory] name", "laboratory"),
    ("Machine maker", "[machine] manufacturer", "machine_manufacturer"),
    ("Serial number of the machine", "[machine] serial_number", "machine_serial_number"),
    ("Place", "[certificate] place", "place"),
    ("Carried out by", "[[person]] name", "operator"),
)
#: Headings of what files name, as the page shows it beside the file.
NAMED = {
    "instrument": "instrument", "serial_number": "serial number", "operator": "operator", "date": "date",
    "customer": "customer", "order_number": "order number", "certificate_number": "certificate number",
    "machine_manufacturer": "machine maker", "machine_serial_number": "serial number of the machine", "place": "place",
    "laboratory": "laboratory",
}  # fmt: skip
#: What every report says of its figures, after ISO/IEC 17025, 7.8.2.1 l and 7.8.4.1 a.
RELATES = "The results relate only to the machine named here, in the state and under the conditions of the measurement."
UNCERTAINTY = (
    "Uncertainties are expanded, U = k u with k = 2 (about 95 % for a normal distribution), after JCGM 100 and ISO 230-9; "
    "what they include is listed under Limitations."
)
SIGNED = "Not to be reproduced except in full without approval of the laboratory."


def handed_over(
    certificate: Certificate | None, files: Sequence[Mapping[str, Any]], measured: Mapping[str, str]
) -> dict[str, Any]:
    """Return what the page shows of customer, machine, instruments, people and conditions, and what is missing.

    Parameters
    ----------
    certificate : ``certificate.toml``, perhaps incomplete; None for none.
    files : what each measurement file says (``files`` of ``identify.json``).
    measured : instrument, serial number and operator as ``residuals.csv`` has them, for folders of earlier versions.
    """
    said = [{str(key): value for key, value in item.items()} for item in files]
    own = {} if certificate is None else dict(_facts(certificate))
    facts = []
    for heading, key, name in FACTS:
        values = dict.fromkeys(str(item[name]) for item in [*said, measured] if item.get(name))
        facts.append({"heading": heading, "key": key, "text": own.get(heading) or "; ".join(values)})
    instruments = _once([*_stated_instruments(certificate), *_named_instruments(said, measured)])
    conditions = [] if certificate is None else [[item.name, _range(item)] for item in certificate.conditions]
    missing = [{"what": item["heading"], "key": item["key"]} for item in facts if not item["text"]]
    missing += [{"what": what, "key": key} for what, key in _gaps(instruments, conditions)]
    return {
        "facts": facts,
        "further": [] if certificate is None else [list(pair) for pair in _further(certificate)],
        "instruments": instruments,
        "conditions": conditions,
        "persons": [] if certificate is None else [[item.name, item.role] for item in certificate.persons if item.name],
        "statements": [] if certificate is None else [list(pair) for pair in certificate.statements],
        "files": [
            {
                "file": str(item.get("file", "")),
                "named": [[NAMED[key], str(item[key])] for key in NAMED if item.get(key)],
                "lines": [str(line) for line in item.get("lines") or []],
            }
            for item in said
        ],
        "missing": missing,
        "said": [RELATES, UNCERTAINTY, SIGNED],
    }


def _facts(certificate: Certificate) -> Iterator[tuple[str, str]]:
    machine = certificate.machine
    yield "Customer", _contact(certificate.customer)
    yield "Order number", certificate.order
    yield "Certificate number", certificate.number
    yield "Laboratory", _joined(_contact(certificate.laboratory), certificate.laboratory_code)
    yield "Machine maker", _joined(machine.manufacturer, machine.model)
    inventory = machine.inventory_number and f"inventory number {machine.inventory_number}"
    yield "Serial number of the machine", _joined(machine.serial_number, inventory)
    yield "Place", _joined(certificate.place, certificate.location and f"at: {certificate.location}")
    yield "Carried out by", "; ".join(_joined(item.name, item.role) for item in certificate.persons)


def _further(certificate: Certificate) -> Iterator[tuple[str, str]]:
    """Yield the dates and the control, where they are stated."""
    dates = dict.fromkeys(str(day) for day in (certificate.begin, certificate.end) if day is not None)
    for heading, text in (
        ("Measured", " to ".join(dates)),
        ("Received", str(certificate.received or "")),
        ("Issued", str(certificate.issued or "")),
        ("Issued in", certificate.country),
        ("Control", "" if certificate.control is None else _thing(certificate.control)),
    ):
        if text:
            yield heading, text


def _contact(contact: Contact) -> str:
    street = " ".join(part for part in (contact.street, contact.street_number) if part)
    city = " ".join(part for part in (contact.post_code, contact.city) if part)
    return _joined(contact.name, street, city, contact.country, contact.email, contact.phone)


def _thing(thing: Thing) -> str:
    number = thing.serial_number and f"serial number {thing.serial_number}"
    return _joined(thing.manufacturer, thing.name, thing.model, number, thing.software_version)


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def _stated_instruments(certificate: Certificate | None) -> Iterator[dict[str, str]]:
    for thing in () if certificate is None else certificate.equipment:
        yield {
            "name": _joined(thing.manufacturer, thing.name, thing.model),
            "serial_number": thing.serial_number,
            "certificate": _joined(thing.certificate_number, thing.certificate_by),
            "file": "",
        }


def _named_instruments(files: Sequence[Mapping[str, Any]], measured: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """Yield the instrument of each file; that of ``residuals.csv`` where no file names one."""
    named = [item for item in files if item.get("instrument") or item.get("serial_number")]
    for item in named or ([measured] if measured.get("instrument") or measured.get("serial_number") else []):
        yield {
            "name": str(item.get("instrument", "")),
            "serial_number": str(item.get("serial_number", "")),
            "certificate": "",
            "file": str(item.get("file", "")),
        }


def _once(instruments: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Return each instrument once: what has the same serial number is the same, with what each source says of it."""
    found: dict[str, dict[str, str]] = {}
    for item in instruments:
        number = item["serial_number"]
        same = found.setdefault(number or f"{item['name']} {item['file']}", item)
        if same is not item:
            files = dict.fromkeys(name for name in (same["file"], item["file"]) if name)
            same.update({**item, **{key: text for key, text in same.items() if text}, "file": ", ".join(files)})
    return list(found.values())


def _range(item: Condition) -> str:
    sign = {"\\degreeCelsius": "°C", "\\percent": "%", "\\hecto\\pascal": "hPa"}.get(item.unit, item.unit)
    return f"{' to '.join(dict.fromkeys((f'{item.lowest:g}', f'{item.highest:g}')))} {sign}"


def _gaps(instruments: Sequence[Mapping[str, str]], conditions: Sequence[Any]) -> Iterator[tuple[str, str]]:
    if not instruments:
        yield "Instruments with their serial numbers", "[[equipment]] name, serial_number"
    elif not any(item["serial_number"] for item in instruments):
        yield "Serial numbers of the instruments", "[[equipment]] serial_number"
    if not any(item["certificate"] for item in instruments):
        yield "Traceability: calibration certificates of the instruments", "[[equipment]] certificate_number"
    if not conditions:
        yield "Conditions during the measurement", "[conditions] air_temperature_c, machine_temperature_c"
