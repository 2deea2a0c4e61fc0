"""The certificate: administrative data, statements, conditions, measurement results."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from compgen.data.names import COVERAGE
from compgen.errors import InputError
from compgen.report.dcc.laboratory import Certificate, Condition, Contact, Thing
from compgen.report.dcc.xml import (
    DCC,
    LANGUAGE,
    NEWEST,
    XSI,
    DccSchema,
    Element,
    check_version,
    dcc,
    flat,
    given,
    optional,
    real,
    real_list,
    said,
    serialised,
)
from compgen.report.html.write import PROBABILITY, UNITS, all_errors, calibration_record

# What a certificate says about itself: what it is and is not, signs, uncertainties, limitations, the laboratory's text.


IS = (
    "The results of a measurement of a machine tool as the program compgen computed them from the files whose SHA-256 "
    "is given with the results. Laboratory, customer, persons, dates, instruments and conditions are as stated by the "
    "issuer; the program checked their form, not their truth. The laboratory named here is responsible for the document."
)
IS_NOT = (
    "The program and its authors are not a calibration laboratory, and neither accredited nor certified; the document claims no "
    "accreditation and no metrological traceability beyond what the issuer can show. It contains no electronic signature "
    "or seal: unless the issuer adds one, it does not prove its origin. It is not a statement of conformity of "
    "the machine, and its figures follow published formulas of the standards but are not certified against them."
)
SIGN = (
    "Errors have the names and signs of ISO 230-1: actual minus commanded, of the tool relative to the workpiece, along "
    "and about the positive axes of the machine. A compensation has the opposite sign. The values do not carry the "
    "refType basic_measurementError, which is an indication minus a reference value: a machine indicates the commanded "
    "position, so that difference has the opposite sign."
)
UNCERTAINTY = (
    f"The uncertainties are expanded: the standard uncertainty times the coverage factor k = {COVERAGE:g}, for a normal "
    f"distribution a coverage probability of {100 * PROBABILITY:g} %. Where value and uncertainty are both zero the value "
    "is fixed by the point or line to which the error is referred. "
    "A figure without uncertainty is marked as computed, or its uncertainty is unknown."
)


def statements(data: Mapping[str, Any], options: Certificate) -> Element:
    """Return ``dcc:statements``."""
    return dcc("statements", *_statements(data, options))


def _statements(data: Mapping[str, Any], options: Certificate) -> Iterator[Element]:
    yield _statement("What this document is", IS)
    yield _statement("What this document is not", IS_NOT)
    convention = dcc("convention", "actual minus commanded, tool relative to workpiece")
    yield _statement("Sign convention", SIGN, convention, dcc("norm", "ISO 230-1"))
    yield _statement("Measurement uncertainty", UNCERTAINTY, dcc("norm", "JCGM 100:2008"))
    for text in data["limitations"]:
        yield _statement("Limitation", flat(text))
    further = (("Order number of the customer", options.order), ("Place of the machine", options.place))
    for name, text in (
        *(pair for pair in further if pair[1]),
        *options.statements,
    ):  # the user's words: language unknown
        yield dcc(
            "statement", dcc("name", dcc("content", flat(name))), dcc("declaration", dcc("content", text.strip()))
        )


def _statement(name: str, text: str, *rules: Element) -> Element:
    """A statement: ``rules`` (convention, norm) come between its name and its text."""
    return dcc("statement", said("name", name), *rules, said("declaration", text))


# ``dcc:administrativeData``: the laboratory's data as given, the items, and the statements about the document.


#: Namespaces of the refTypes in use: name, what it is, where its list is.
REF_TYPES = {
    "basic": (
        "RefTypes common to many fields",
        "https://digilab.ptb.de/dkd/refType/vocab/index.php?tema=2",
    ),
    "iso230": ("Symbols of the geometric errors of ISO 230-1, such as EXX or EC0Y", "urn:iso:std:iso:230:-1"),
}


def administrative_data(data: Mapping[str, Any], options: Certificate) -> Element:
    """Return the administrative data from the numbers of the report and ``certificate.toml``."""
    control = None if options.control is None else _item(options.control, options.control.name, None)
    name = options.machine.name or str(data["title"])
    code = optional("calibrationLaboratoryCode", options.laboratory_code)
    persons = [
        dcc(
            "respPerson",
            dcc("person", given("name", person.name), optional("eMail", person.email)),
            optional("role", person.role),
            None if person.main_signer is None else dcc("mainSigner", "true" if person.main_signer else "false"),
        )
        for person in options.persons
    ]
    return dcc(
        "administrativeData",
        dcc("dccSoftware", software(data)),
        dcc(
            "refTypeDefinitions",
            *(
                dcc("refTypeDefinition", said("name", text), dcc("namespace", namespace), dcc("link", link))
                for namespace, (text, link) in REF_TYPES.items()
            ),
        ),
        dcc(
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
        ),
        dcc("items", _item(options.machine, name, said("description", machine_text(data))), control),
        dcc("calibrationLaboratory", code, _contact("contact", options.laboratory)),
        dcc("respPersons", *persons),
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


def _date(tag: str, value: datetime.date | None) -> Element | None:
    return None if value is None else dcc(tag, value.isoformat())


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
    """Describe the machine as modelled: chain from workpiece to tool, reference axis, travel, tool."""
    machine = data["machine"]
    parts = [f"Machine file {machine.get('name', data['title'])}"]
    if machine.get("chain"):
        parts.append(f"kinematic chain {machine['chain']} (W workpiece, F foundation, T tool)")
    if machine.get("squareness_reference"):
        parts.append(f"squareness referred to {machine['squareness_reference']}")
    for axis, limits in dict(machine.get("travel_mm") or {}).items():
        parts.append(f"travel of {axis} {limits[0]:g} mm to {limits[1]:g} mm")
    for key, text in (("reference_point_mm", "reference point"), ("tool_offset_mm", "tool offset")):
        if machine.get(key):
            parts.append(f"{text} ({', '.join(f'{value:g}' for value in machine[key])}) mm")
    return "; ".join(parts)


def manufacturer(thing: Thing) -> Element | None:
    """Return the manufacturer, None if none was given."""
    return dcc("manufacturer", given("name", thing.manufacturer)) if flat(thing.manufacturer) else None


def identifications(thing: Thing) -> Element:
    """Return the numbers that identify an item or an instrument."""
    numbers = [_identification("manufacturer", thing.serial_number, "Serial number")]
    if thing.inventory_number:
        numbers.append(_identification("customer", thing.inventory_number, "Inventory number"))
    if thing.certificate_number and not thing.certificate_sha256:
        numbers.append(_identification("other", thing.certificate_number, "Number of its calibration certificate"))
    return dcc("identifications", *numbers)


def _identification(issuer: str, value: str, name: str) -> Element:
    return dcc("identification", dcc("issuer", issuer), dcc("value", flat(value)), said("name", name))


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


# Instruments and conditions of a measurement, if they were stated or are in the measurement files.


NOT_STATED = "The conditions during the measurement were not stated."


def measuring_equipments(options: Certificate) -> Element:
    """Return the instruments, with the hash of a calibration certificate if given."""
    found = []
    for thing in options.equipment:
        certificate = None
        if thing.certificate_sha256:
            certificate = dcc(
                "certificate",
                said("referral", "Calibration certificate"),
                dcc("referralID", flat(thing.certificate_number)),
                dcc("procedure", "SHA-256"),
                dcc("value", thing.certificate_sha256),
            )
        model = optional("model", thing.model)
        found.append(
            dcc(
                "measuringEquipment",
                given("name", thing.name),
                certificate,
                manufacturer(thing),
                model,
                identifications(thing),
            )
        )
    return dcc("measuringEquipments", *found)


def influence_conditions(data: Mapping[str, Any], options: Certificate, version: str) -> Element:
    """Return the stated conditions and the temperatures of the scales; a statement if nothing is known."""
    found = []
    for item in (*options.conditions, *scale_temperatures(data)):  # a single value, or the lowest and the highest one
        parts = [("Min", item.lowest, "Lowest value"), ("Max", item.highest, "Highest value")]
        if item.lowest == item.highest:
            parts = [("", item.lowest, item.name)]
        quantities = [
            dcc("quantity", said("name", name), real(value, item.unit, version), **_ref_type(item.ref_type, end))
            for end, value, name in parts
        ]
        values = dcc("data", *quantities)
        found.append(dcc("influenceCondition", said("name", item.name), values, **_ref_type(item.ref_type, "")))
    if not found:
        text = dcc("data", dcc("text", dcc("content", NOT_STATED, lang=LANGUAGE)))
        found = [dcc("influenceCondition", said("name", "Conditions"), text)]
    return dcc("influenceConditions", *found)


def scale_temperatures(data: Mapping[str, Any]) -> Iterator[Condition]:
    """Yield the temperatures of the scales from the measurement; the readings were corrected from them to 20 degC."""
    corrections = data["measurement"].get("corrections") or {}
    for axis, item in dict(corrections.get("temperature") or {}).items():
        if {"lowest_c", "highest_c"} <= set(item):
            name = f"Temperature of the {axis} scale, from the readings; corrected to 20 degrees Celsius"
            yield Condition(name, "\\degreeCelsius", item["lowest_c"], item["highest_c"], "basic_temperature")


def _ref_type(stem: str, end: str) -> dict[str, str]:
    return {"refType": stem + end} if stem else {}


# ``dcc:measurementResults``: geometric errors, figures of ISO 230, comparison, and what the tables would do.


METHODS = {
    "joint": "Lengths from tracer stations: errors, station positions and dead lengths in one least-squares adjustment",
    "two-step": "Lengths from several tracer stations: points located first, errors fitted to their deviations",
    "deviations": "Errors fitted to deviations of the tool tip by least squares",
    "axis-runs": "Errors of single axes, each measured along a line",
    "sixdof": "Errors from readings of a six-degree-of-freedom laser instrument, axis by axis",
    "merged": "Errors of several measurements merged by their uncertainties",
    "given": "Errors as given in a file",
}


def measurement_results(
    data: Mapping[str, Any], record: Mapping[str, Any], options: Certificate, version: str
) -> Element:
    """Return the results; ``record``, the contents of ``calibration.json``, provides the numbers.

    Raises
    ------
    InputError
        if nothing was measured: neither errors nor figures of a measurement.
    """
    return dcc("measurementResults", *Results(data, record, options, version).all())


class Results:
    """The parts of one certificate that share its data, options and release of the schema."""

    def __init__(self, data: Mapping[str, Any], record: Mapping[str, Any], options: Certificate, version: str) -> None:
        self.data, self.record, self.options, self.version = data, record, options, version

    def all(self) -> list[Element]:
        """Return the measured results, then what was computed for each control."""
        errors, *verifications = self.record["measurementResults"]
        measured = [*self._errors(errors), *self._accuracy(), *self._comparison()]
        if not measured:
            raise InputError(
                "the folder contains neither measured errors nor measured figures, so there is nothing to certify; give one of "
                "run, identify, accuracy or compare (without --predicted)"
            )
        moved = {item["name"]: item["figures"] for item in self.data["accuracy"].get("with_tables", [])}
        computed = [
            self._verification(item, control, moved.get(control["name"], {}))
            for item, control in zip(verifications, self.data["controls"], strict=True)
        ]
        return [*measured, *computed]

    def _result(
        self, name: str, method: Element, results: Sequence[Element], notes: Sequence[tuple[str, str]] = ()
    ) -> Element:
        """Return one ``dcc:measurementResult`` with everything that the schema requires around its results."""
        meta = [dcc("metaData", said("name", title), said("declaration", text)) for title, text in notes]
        return dcc(
            "measurementResult",
            said("name", name),
            dcc("usedMethods", method),
            dcc("usedSoftware", software(self.data)),
            measuring_equipments(self.options),
            influence_conditions(self.data, self.options, self.version),
            dcc("results", *results),
            dcc("measurementMetaData", *meta) if meta else None,
        )

    # --- geometric errors ------------------------------------------------------------------------------------------

    def _errors(self, errors: Mapping[str, Any]) -> Iterator[Element]:
        if not errors["results"]:
            return
        text = METHODS.get(str(errors["usedMethod"]), f"Method {errors['usedMethod'] or 'not stated'}")
        method = _method("Identification of geometric errors", text, ("ISO 230-1",))
        results = [self._error(item) for item in errors["results"]]
        yield self._result("Geometric errors of the machine", method, results, self._evidence())

    def _error(self, item: Mapping[str, Any]) -> Element:
        name, symbol = f"{item['name']}: {item['meaning']}", str(item["name"])
        if item.get("known_in_part"):
            name = f"{name}, known in part only (see limitations)"
        values = dcc("quantity", said("name", name), self._values(item), refType=f"basic_measuredValue iso230_{symbol}")
        if not item["positions"]["valueXMLList"]:
            return dcc("result", said("name", name), dcc("data", values))
        positions = dcc(
            "quantity",
            said("name", f"Commanded position of {item['name'][-1]}"),
            real_list(item["positions"], self.version),
            refType="basic_nominalValue",
        )
        return dcc("result", said("name", name), dcc("data", dcc("list", positions, values)))

    def _values(self, item: Mapping[str, Any]) -> Element:
        """The values of a curve as a list; a squareness as one real quantity."""
        values = item["values"]
        if item["positions"]["valueXMLList"]:
            return real_list(values, self.version)
        expanded = values.get("expandedUncXMLList")
        single = None if expanded is None else {**expanded, "uncertainty": expanded["uncertaintyXMLList"][0]}
        return real(values["valueXMLList"][0], values["unitXMLList"][0], self.version, single)

    def _evidence(self) -> list[tuple[str, str]]:
        measurement, provenance = self.data["measurement"], self.data["provenance"]
        found = []
        if "readings" in measurement:
            found.append(("Readings", f"{measurement.get('readings_used', '')} of {measurement['readings']} used"))
        for key, title in (("residual_rms_um", "Residual, rms"), ("residual_max_um", "Residual, largest")):
            if key in measurement:
                found.append((title, f"{measurement[key]:.4g} um"))
        return [*found, *_files("Input file", provenance["inputs"])]

    # --- figures ---------------------------------------------------------------------------------------------------

    def _accuracy(self) -> Iterator[Element]:
        groups = self.data["accuracy"].get("groups", [])
        results = [
            dcc("result", said("name", group["name"]), dcc("data", *self._rows(group["rows"]))) for group in groups
        ]
        results = [item for item in results if item.find(".//{*}quantity") is not None]
        if results:
            method = _method("Figures by the formulas of the standards", "; ".join(_rules(self.data)), NORMS)
            yield self._result("Figures of ISO 230", method, results, self._accuracy_evidence())

    def _accuracy_evidence(self) -> list[tuple[str, str]]:
        return [] if all_errors(self.data) else self._evidence()

    def _rows(self, rows: Sequence[Mapping[str, Any]]) -> Iterator[Element]:
        for row in rows:
            if row["value"] is not None and row["unit"] in UNITS:
                yield self._figure(row["key"], row["meaning"], row["value"], row["unit"], row["U"])

    def _figure(self, name: str, meaning: object, value: float, unit: str, expanded: float | None) -> Element:
        known = None if expanded is None else {"uncertainty": expanded, **COVERED}
        inner = real(value, UNITS[unit], self.version, known)
        description = said("description", flat(meaning)) if flat(meaning) else None
        return dcc("quantity", said("name", name), description, inner, refType="basic_measuredValue")

    # --- before and after, both measured ---------------------------------------------------------------------------

    def _comparison(self) -> Iterator[Element]:
        compare = self.data["compare"]
        results = [item for group in compare.get("groups", []) for item in self._compared(group)]
        if not results or compare.get("kind") == "prediction":  # a prediction is not a measurement
            return
        text = f"The same figures from two files, one before and one after. {'; '.join(compare['statements'])}"
        method = _method("Comparison of two measurements", text, NORMS)
        notes = [("Verdict of the program", str(compare["verdict"] or "none"))]
        yield self._result("Before and after", method, results, [*notes, *self._accuracy_evidence()])

    def _compared(self, group: Mapping[str, Any]) -> Iterator[Element]:
        for when in ("before", "after"):
            rows = [{**row, "value": row[when], "U": row[f"{when}_U"]} for row in group["rows"]]
            quantities = list(self._rows(rows))
            if quantities:
                yield dcc("result", said("name", f"{group['name']}, {when}"), dcc("data", *quantities))

    # --- what the tables would do: computed ------------------------------------------------------------------------

    def _verification(self, item: Mapping[str, Any], control: Mapping[str, Any], moved: Mapping[str, float]) -> Element:
        method = _method("Emulation of the control, computed and not measured", str(item["usedMethod"]), ("ISO 230-1",))
        results = []
        for when, what in (("before", "without new tables"), ("after", "with the tables")):
            figures = [
                dcc("quantity", said("name", row["name"]), real(row["value"], row["unit"], self.version))
                for row in item["results"]
                if row["when"] == when and row["value"] is not None
            ] or [dcc("text", dcc("content", "no figures", lang="en"))]
            results.append(dcc("result", said("name", f"{when}: {what}, computed"), dcc("data", *figures)))
        if moved:
            quantities = [
                dcc("quantity", said("name", key), real(value, UNITS["um"], self.version))
                for key, value in moved.items()
                if value is not None
            ]
            name = "Positioning (ISO 230-2) and body diagonals (ISO 230-6) with the tables, computed"
            results.append(dcc("result", said("name", name), dcc("data", *quantities)))
        verdict = f"{control['verdict']}: {'; '.join(item['conformity']['reasons']) or 'no reason against the tables'}"
        notes = [("Verdict of the program on the tables, computed", verdict), *_files("File", item["files"])]
        return self._result(f"{item['name']}, computed", method, results, notes)


NORMS = ("ISO 230-1", "ISO 230-2", "ISO 230-6")
COVERED = {"coverageFactor": COVERAGE, "coverageProbability": PROBABILITY, "distribution": "normal"}


def _method(name: str, text: str, norms: Sequence[str]) -> Element:
    return dcc(
        "usedMethod", said("name", name), said("description", flat(text)), *(dcc("norm", norm) for norm in norms)
    )


def _rules(data: Mapping[str, Any]) -> list[str]:
    found = [str(text) for text in data["accuracy"].get("statements", [])]
    return found or ["Formulas as published; see the meaning of each figure."]


def _files(title: str, files: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    return [(title, f"{item.get('name', '')}, SHA-256 {item.get('sha256', 'not known')}") for item in files]


# The document as a whole, and its file.


FILE = "dcc.xml"


def certificate_xml(data: Mapping[str, Any], options: Certificate, version: str = NEWEST) -> bytes:
    """Return the certificate as XML in UTF-8.

    Parameters
    ----------
    data : the numbers of a report (:func:`compgen.report.html.write.content`), only finite numbers or None.
    options : the statements of the laboratory.
    version : release of the DCC schema, one of :data:`compgen.report.dcc.xml.VERSIONS`.

    Raises
    ------
    InputError
        if nothing was measured, or for an unsupported release.
    """
    root = dcc(
        "digitalCalibrationCertificate",
        administrative_data(data, options),
        measurement_results(data, calibration_record(data), options, check_version(version)),
        schemaVersion=version,
    )
    root.set(f"{{{XSI}}}schemaLocation", f"{DCC} {DCC}/v{version}/dcc.xsd")
    return serialised(root)


def certificate_files(
    data: Mapping[str, Any], options: Certificate, schema: DccSchema | None = None
) -> dict[str, bytes]:
    """Return ``dcc.xml`` by name: in the release of ``schema`` and validated by it, otherwise in the newest release.

    Raises
    ------
    InputError
        if nothing was measured, or the document is not valid.
    """
    document = certificate_xml(data, options, NEWEST if schema is None else schema.version)
    if schema is not None:
        schema.check(document)
    return {FILE: document}
