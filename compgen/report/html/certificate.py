"""``calibration.json``: the results in the order of a Digital Calibration Certificate, as documented JSON.

It is no DCC: that is an XML document of PTB's schema (namespace ``https://ptb.de/dcc``), issued and signed by a
laboratory. Its parts and units are named alike, so that a laboratory can take the numbers over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from compgen.report.html.content import FIGURES
from compgen.report.html.curves import COVERAGE

#: Share of values within the expanded uncertainty, for k = 2 and a normal distribution.
PROBABILITY = 0.9545
#: Units in the notation of the D-SI metadata model.
UNITS = {"um": "\\micro\\metre", "urad": "\\micro\\radian", "mm": "\\milli\\metre"}

STATEMENT = (
    "Documented JSON in the order of a Digital Calibration Certificate; not a DCC and not signed. Fields that only a "
    "laboratory can fill are null."
)


def calibration_record(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of ``calibration.json`` from the numbers of the report."""
    return {
        "format": "compgen calibration record 1",
        "statement": STATEMENT,
        "administrativeData": {
            "software": [{"name": "compgen", "release": data["provenance"]["report_made_by"].removeprefix("compgen ")}],
            "coreData": {
                "uniqueIdentifier": None,
                "beginPerformanceDate": data["provenance"]["date"] or None,
                "endPerformanceDate": data["provenance"]["date"] or None,
                "performanceLocation": None,
            },
            "items": [{"name": data["title"], "manufacturer": None, "serialNumber": None, "machine": data["machine"]}],
            "calibrationLaboratory": None,
            "respPersons": None,
            "customer": None,
        },
        "measurementResults": [_errors(data), *(_verification(item) for item in data["controls"])],
        "comment": data["limitations"],
        "documents": data["provenance"]["inputs"],
    }


def _list(values: Sequence[Any], unit: str, standard: Sequence[Any] = ()) -> dict[str, Any]:
    """A list of real quantities as D-SI has it: values, one unit, expanded uncertainties where all are known."""
    found: dict[str, Any] = {"valueXMLList": list(values), "unitXMLList": [UNITS[unit]]}
    if standard and None not in standard:
        found["expandedUncXMLList"] = {
            "uncertaintyXMLList": [COVERAGE * u for u in standard],
            "coverageFactor": COVERAGE,
            "coverageProbability": PROBABILITY,
            "distribution": "normal",
        }
    return found


def _quantity(value: Any, unit: str) -> dict[str, Any]:
    """A real quantity as D-SI has it."""
    return {"value": value, "unit": UNITS[unit]}


def _errors(data: Mapping[str, Any]) -> dict[str, Any]:
    results = []
    for item in data["errors"]:
        values = _list(item["value"], item["unit"], item["u"])
        positions = _list(item["position_mm"], "mm")
        results.append({"name": item["error"], "meaning": item["meaning"], "positions": positions, "values": values})
    method = data["measurement"].get("method")
    return {"name": "geometric errors (ISO 230-1)", "usedMethod": method, "results": results}


def _verification(item: Mapping[str, Any]) -> dict[str, Any]:
    results = [
        {"name": text, "when": when, **_quantity(item[when].get(key), "um")}
        for when in ("before", "after")
        for key, text in FIGURES
    ]
    what = "error of the tool tip over the volume"
    if not item["volumetric"]:
        what = "effect of the measured errors alone on the tool tip"
    return {
        "name": f"{what}, tables of {item['name']}",
        "usedMethod": "emulation of the files that were read back; computed, not measured",
        "conformity": {"accepted": item["state"] != "rejected", "reasons": [*item["reasons"], *item["objections"]]},
        "results": results,
        "files": item["files"],
    }
