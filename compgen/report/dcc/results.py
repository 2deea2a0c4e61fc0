"""``dcc:measurementResults``: geometric errors, figures of ISO 230, comparison, and what the tables would do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from compgen.errors import InputError
from compgen.report.dcc.administrative import software
from compgen.report.dcc.conditions import influence_conditions, measuring_equipments
from compgen.report.dcc.options import Certificate
from compgen.report.dcc.xml import Element, dcc, flat, real, real_list, said
from compgen.report.html.certificate import PROBABILITY, UNITS
from compgen.report.html.curves import COVERAGE

METHODS = {
    "joint": "Lengths from tracer stations: the errors, and what is not known of the stations, in one least-squares adjustment",
    "two-step": "Lengths from several tracer stations: points located first, errors fitted to their deviations",
    "deviations": "Errors fitted to deviations of the tool tip by least squares",
    "axis-runs": "Errors of single axes, each measured along a line",
    "sixdof": "Errors from readings of a six-degree-of-freedom laser instrument, axis by axis",
    "merged": "Errors of several measurements merged by their uncertainties",
    "given": "Errors as they were given in a file",
}


def measurement_results(
    data: Mapping[str, Any], record: Mapping[str, Any], options: Certificate, version: str
) -> Element:
    """Return the results; ``record`` is the contents of ``calibration.json``, whose numbers they are.

    Raises
    ------
    InputError
        where nothing was measured: neither errors nor figures of a measurement.
    """
    return dcc("measurementResults", *Results(data, record, options, version).all())


class Results:
    """The parts of one certificate that share its data, options and release of the schema."""

    def __init__(self, data: Mapping[str, Any], record: Mapping[str, Any], options: Certificate, version: str) -> None:
        self.data, self.record, self.options, self.version = data, record, options, version

    def all(self) -> list[Element]:
        """Measured results first, then what was computed for each control."""
        errors, *verifications = self.record["measurementResults"]
        measured = [*self._errors(errors), *self._accuracy(), *self._comparison()]
        if not measured:
            raise InputError(
                "the folder holds no measured errors and no measured figures, so there is nothing to certify; give one of "
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
        """Return one ``dcc:measurementResult`` with everything that the schema wants around its results."""
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
        return [] if self.data["errors"] else self._evidence()

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
        if not results or compare.get("kind") == "prediction":  # a prediction was not measured
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
        results = [self._computed(item, when) for when in ("before", "after")]
        if moved:
            quantities = [self._computed_figure(key, value) for key, value in moved.items() if value is not None]
            name = "Positioning (ISO 230-2) and body diagonals (ISO 230-6) with the tables, computed"
            results.append(dcc("result", said("name", name), dcc("data", *quantities)))
        verdict = f"{control['verdict']}: {'; '.join(item['conformity']['reasons']) or 'no reason against the tables'}"
        notes = [("Verdict of the program on the tables, computed", verdict), *_files("File", item["files"])]
        return self._result(f"{item['name']}, computed", method, results, notes)

    def _computed(self, item: Mapping[str, Any], when: str) -> Element:
        quantities = [
            dcc("quantity", said("name", row["name"]), real(row["value"], row["unit"], self.version))
            for row in item["results"]
            if row["when"] == when and row["value"] is not None
        ]
        what = "without new tables" if when == "before" else "with the tables"
        name = said("name", f"{when}: {what}, computed")
        if not quantities:
            return dcc("result", name, dcc("data", dcc("text", dcc("content", "no figures", lang="en"))))
        return dcc("result", name, dcc("data", *quantities))

    def _computed_figure(self, key: str, value: float) -> Element:
        return dcc("quantity", said("name", key), real(value, UNITS["um"], self.version))


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
