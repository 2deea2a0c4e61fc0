"""``dcc:administrativeData``: the laboratory's data as they were given, the items, and what the document says of itself."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping
from typing import Any

from compgen.report.dcc.options import Certificate, Contact, Person, Thing
from compgen.report.dcc.statements import statements
from compgen.report.dcc.xml import LANGUAGE, Element, dcc, flat, given, optional, said

#: Namespaces of the refTypes in use: name, what it is, where its list stands.
REF_TYPES = {
    "basic": (
        "RefTypes common to many fields",
        "https://digilab.ptb.de/dkd/refType/vocab/index.php?tema=2",
    ),
    "iso230": ("Symbols of the geometric errors of ISO 230-1, such as EXX or EC0Y", "urn:iso:std:iso:230:-1"),
}


def administrative_data(data: Mapping[str, Any], options: Certificate) -> Element:
    """Return the administrative data from the numbers of the report and ``certificate.toml``."""
    return dcc(
        "administrativeData",
        dcc("dccSoftware", software(data)),
        dcc("refTypeDefinitions", *(_definition(key, *item) for key, item in REF_TYPES.items())),
        _core(options),
        _items(data, options),
        _laboratory(options),
        dcc("respPersons", *(_person(item) for item in options.persons)),
        _contact("customer", options.customer),
        statements(data, options),
    )


def software(data: Mapping[str, Any]) -> Element:
    """Return this program with its release, as PTB's guide writes it: a letter in front of the number."""
    release = str(data["provenance"]["report_made_by"]).removeprefix("compgen ")
    return dcc(
        "software",
        given("name", "compgen"),
        dcc("release", f"v{flat(release)}"),
        dcc("type", "application"),
        said("description", "Identification of geometric errors of machine tools, compensation tables, this document"),
    )


def _definition(namespace: str, text: str, link: str) -> Element:
    return dcc("refTypeDefinition", said("name", text), dcc("namespace", namespace), dcc("link", link))


def _core(options: Certificate) -> Element:
    return dcc(
        "coreData",
        dcc("countryCodeISO3166_1", options.country),
        dcc("usedLangCodeISO639_1", LANGUAGE),
        dcc("mandatoryLangCodeISO639_1", LANGUAGE),
        dcc("uniqueIdentifier", flat(options.number)),
        _date("receiptDate", options.received),
        _date("beginPerformanceDate", options.begin),
        _date("endPerformanceDate", options.end),
        dcc("performanceLocation", options.location),
        _date("issueDate", options.issued),
    )


def _date(tag: str, value: datetime.date | None) -> Element | None:
    return None if value is None else dcc(tag, value.isoformat())


def _items(data: Mapping[str, Any], options: Certificate) -> Element:
    control = None if options.control is None else _item(options.control, options.control.name, None)
    name = options.machine.name or str(data["title"])
    return dcc("items", _item(options.machine, name, said("description", machine_text(data))), control)


def _item(thing: Thing, name: str, description: Element | None) -> Element:
    installed = None
    if thing.software_version:
        release = dcc("release", flat(thing.software_version))
        installed = dcc("installedSoftwares", dcc("software", said("name", "Software of the control"), release))
    return dcc(
        "item",
        given("name", name),
        description,
        installed,
        manufacturer(thing),
        optional("model", thing.model),
        identifications(thing),
    )


def machine_text(data: Mapping[str, Any]) -> str:
    """Say what the model knows of the machine: chain from workpiece to tool, reference axis, travel, tool."""
    machine = data["machine"]
    parts = [f"Machine file {machine.get('name', data['title'])}"]
    if machine.get("chain"):
        parts.append(f"kinematic chain {machine['chain']} (W workpiece, F frame, T tool)")
    if machine.get("squareness_reference"):
        parts.append(f"squareness referred to {machine['squareness_reference']}")
    for axis, limits in dict(machine.get("travel_mm") or {}).items():
        parts.append(f"travel of {axis} {limits[0]:g} mm to {limits[1]:g} mm")
    for key, text in (("reference_point_mm", "reference point"), ("tool_offset_mm", "tool offset")):
        if machine.get(key):
            parts.append(f"{text} ({', '.join(f'{value:g}' for value in machine[key])}) mm")
    return "; ".join(parts)


def manufacturer(thing: Thing) -> Element | None:
    """Return the manufacturer, None where none was given."""
    return dcc("manufacturer", given("name", thing.manufacturer)) if flat(thing.manufacturer) else None


def identifications(thing: Thing) -> Element:
    """Return the numbers that identify an item or an instrument."""
    return dcc("identifications", *_identifications(thing))


def _identifications(thing: Thing) -> Iterator[Element]:
    yield _identification("manufacturer", thing.serial_number, "Serial number")
    if thing.inventory_number:
        yield _identification("customer", thing.inventory_number, "Inventory number")
    if thing.certificate_number and not thing.certificate_sha256:
        yield _identification("other", thing.certificate_number, "Number of its calibration certificate")


def _identification(issuer: str, value: str, name: str) -> Element:
    return dcc("identification", dcc("issuer", issuer), dcc("value", flat(value)), said("name", name))


def _laboratory(options: Certificate) -> Element:
    code = optional("calibrationLaboratoryCode", options.laboratory_code)
    return dcc("calibrationLaboratory", code, _contact("contact", options.laboratory))


def _contact(tag: str, contact: Contact) -> Element:
    location = dcc(
        "location",
        optional("street", contact.street),
        optional("streetNo", contact.street_number),
        optional("postCode", contact.post_code),
        dcc("city", flat(contact.city)),
        dcc("countryCode", contact.country),
    )
    return dcc(
        tag, given("name", contact.name), optional("eMail", contact.email), optional("phone", contact.phone), location
    )


def _person(person: Person) -> Element:
    signer = None if person.main_signer is None else dcc("mainSigner", "true" if person.main_signer else "false")
    inner = dcc("person", given("name", person.name), optional("eMail", person.email))
    return dcc("respPerson", inner, optional("role", person.role), signer)
