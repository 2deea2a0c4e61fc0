"""Instruments and conditions of a measurement, as far as they were stated or stand with the readings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from compgen.report.dcc.administrative import identifications, manufacturer
from compgen.report.dcc.options import Certificate, Condition, Thing
from compgen.report.dcc.xml import LANGUAGE, Element, dcc, flat, given, optional, real, said

NOT_STATED = "The conditions during the measurement were not stated."


def measuring_equipments(options: Certificate) -> Element:
    """Return the instruments; the hash of a calibration certificate where it was given."""
    return dcc("measuringEquipments", *(_equipment(item) for item in options.equipment))


def _equipment(thing: Thing) -> Element:
    certificate = None
    if thing.certificate_sha256:
        certificate = dcc(
            "certificate",
            said("referral", "Calibration certificate"),
            dcc("referralID", flat(thing.certificate_number)),
            dcc("procedure", "SHA-256"),
            dcc("value", thing.certificate_sha256),
        )
    return dcc(
        "measuringEquipment",
        given("name", thing.name),
        certificate,
        manufacturer(thing),
        optional("model", thing.model),
        identifications(thing),
    )


def influence_conditions(data: Mapping[str, Any], options: Certificate, version: str) -> Element:
    """Return the conditions that were stated and the temperatures of the scales; says so where nothing is known."""
    found = [_condition(item, version) for item in (*options.conditions, *scale_temperatures(data))]
    if not found:
        text = dcc("data", dcc("text", dcc("content", NOT_STATED, lang=LANGUAGE)))
        found = [dcc("influenceCondition", said("name", "Conditions"), text)]
    return dcc("influenceConditions", *found)


def scale_temperatures(data: Mapping[str, Any]) -> Iterator[Condition]:
    """Yield the temperatures of the scales that came with the readings, for which they were corrected to 20 degC."""
    corrections = data["measurement"].get("corrections") or {}
    for axis, item in dict(corrections.get("temperature") or {}).items():
        if {"lowest_c", "highest_c"} <= set(item):
            name = f"Temperature of the {axis} scale, from the readings; corrected to 20 degrees Celsius"
            yield Condition(name, "\\degreeCelsius", item["lowest_c"], item["highest_c"], "basic_temperature")


def _condition(item: Condition, version: str) -> Element:
    """One condition: a single value, or the lowest and the highest one."""
    parts = (
        (("", item.lowest, item.name),)
        if item.lowest == item.highest
        else (("Min", item.lowest, "Lowest value"), ("Max", item.highest, "Highest value"))
    )
    quantities = [
        dcc("quantity", said("name", name), real(value, item.unit, version), **_ref_type(item.ref_type, end))
        for end, value, name in parts
    ]
    return dcc("influenceCondition", said("name", item.name), dcc("data", *quantities), **_ref_type(item.ref_type, ""))


def _ref_type(stem: str, end: str) -> dict[str, str]:
    return {"refType": stem + end} if stem else {}
