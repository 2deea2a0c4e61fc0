"""The report as plain data: what ``report.json`` holds, and what page, dossier and terminal say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compgen.core.error_table import ErrorTable
from compgen.core.names import error_named
from compgen.export import program_version
from compgen.report.html.curves import COVERAGE, describe_error
from compgen.report.html.folder import ControlFolder, ResultFolder
from compgen.report.html.iso import accuracy_groups, comparison_groups
from compgen.report.html.limitations import limitations

#: Figures of a residual field and what they are.
FIGURES = (
    ("max_um", "largest error |e|"),
    ("rms_um", "rms of |e|"),
    ("p95_um", "95 % of the points below"),
    ("v_x_um", "V_X, range of the X component (ISO 230-1)"),
    ("v_y_um", "V_Y, range of the Y component (ISO 230-1)"),
    ("v_z_um", "V_Z, range of the Z component (ISO 230-1)"),
)
#: States of tables from the best to the worst, and how they are called; the middle ones are amber on the page.
VERDICTS = {
    "accepted": "Accepted",
    "partial": "Accepted, partial",
    "accepted_with_reservations": "Accepted with reservations",
    "better_after_new_setup": "Better only after a new set-up",
    "rejected": "Not accepted",
}


def content(source: ResultFolder) -> dict[str, Any]:
    """Return the numbers of the report; only plain values, every text as it stands in the files."""
    controls = [_control(item) for item in source.controls]
    return {
        "format": "compgen report 1",
        "kind": source.kind,
        "title": _machine_name(source),
        "verdict": _verdict(source, controls),
        "controls": controls,
        "errors": _errors(source.identified),
        "measurement": _measurement(source),
        "accuracy": accuracy_groups(source),
        "compare": comparison_groups(source),
        "machine": _machine(source),
        "provenance": _provenance(source),
        "limitations": limitations(source),
        "notes": list(source.notes),
    }


def _machine_name(source: ResultFolder) -> str:
    if source.machine is not None:
        return source.machine.name
    for item in source.controls:
        name = item.manifest.get("machine", {}).get("name")
        if name:
            return str(name)
    if source.identified is not None and source.identified.metadata.get("machine"):
        return source.identified.metadata["machine"]
    for data in (source.compare, source.accuracy, *(item.result for item in source.controls)):
        if data.get("machine"):
            return str(data["machine"])
    return "Machine without a name"  # a folder's name says nothing about what is in it


def _control(item: ControlFolder) -> dict[str, Any]:
    result = item.result
    state = _state(result)
    return {
        "name": item.name,
        "state": state,
        "verdict": VERDICTS[state],
        "headline": str(result.get("headline", "")),
        "volumetric": bool(result.get("volumetric", True)),
        "measured": str(_mapping(result.get("measured")).get("text", "")),
        "objections": [str(_mapping(entry).get("text", "")) for entry in result.get("objections") or []],
        "uncertainty": dict(_mapping(result.get("after_uncertainty"))),
        "next_command": str(result.get("next_command") or ""),
        "format": item.manifest.get("format", ""),
        "evidence": item.manifest.get("evidence", ""),
        "points": result.get("points"),
        "before": result.get("before", {}),
        "after": result.get("after", {}),
        "before_rigid": result.get("before_rigid_motion_removed", {}),
        "after_rigid": result.get("after_rigid_motion_removed", {}),
        "unrepresentable_um": result.get("unrepresentable_um"),
        "uncorrected": [
            {"error": name, "um": value, "why": why_uncorrected(name)}
            for name, value in dict(result.get("uncorrected_um", {})).items()
        ],
        "reasons": list(result.get("reasons", [])),
        "notes": list(result.get("notes", [])),
        "warnings": list(item.manifest.get("warnings", [])),
        "sign_statement": item.manifest.get("sign_statement", ""),
        "parameters": list(item.manifest.get("parameters", [])),
        "unverified": list(item.manifest.get("unverified", [])),
        "settings": dict(item.manifest.get("settings", {})),
        "files": [
            {"name": f.name, "sha256": f.sha256, "bytes": f.size, "lines": f.lines, "intact": f.intact}
            for f in item.files
        ],
    }


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _state(result: Mapping[str, Any]) -> str:
    """The state of a control's tables; results of earlier versions say only whether they are accepted, and partial."""
    if not result.get("accepted"):
        return "rejected"
    state = str(result.get("verdict", "partial" if result.get("partial") else "accepted"))
    return state if state in VERDICTS else "accepted_with_reservations"


def why_uncorrected(name: str) -> str:
    """Say why an error stays, by its name: what the control would need to take it out."""
    if name not in _KNOWN:
        return "acts differently in the two directions of travel; these tables act in both alike"
    error = error_named(name)
    if error.kind == "squareness":
        return "an axis out of square moves another axis in proportion; that needs a table of one axis over another"
    if error.is_straightness:
        return "moves another axis than the one that travels; that needs a table of one axis over another"
    if error.kind == "angular":
        return "acts through a lever that other axes change; that needs a table times an axis position, or a field"
    return "the table's steps, rounding or zero point leave this part of it"


_KNOWN = {f"E{d}{a}" for d in "XYZABC" for a in "XYZ"} | {"EC0Y", "EB0Z", "EA0Z"}


def um(value: Any) -> str:
    """A figure in um with a sensible number of digits; a dash where there is none.

    >>> um(2964.4), um(12.34), um(0.3959), um(None)
    ('2964', '12.3', '0.40', '–')
    """
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    size = abs(value)
    return f"{value:.{0 if size >= 99.95 else 1 if size >= 9.995 else 2}f}"


def _verdict(source: ResultFolder, controls: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    if controls:
        state = max((str(item["state"]) for item in controls), key=list(VERDICTS).index)
        return {"state": state, "headline": _headline(state, controls), "text": _verdict_text(controls)}
    if source.kind == "compare":
        return _compare_verdict(source.compare)
    if source.kind == "accuracy":
        return {
            "state": "neutral",
            "headline": "Accuracy evaluated",
            "text": "The figures of one measurement or error file.",
        }
    identify = source.identify
    if identify.get("identified") is False:
        return {
            "state": "rejected",
            "headline": "The errors are not determined",
            "text": str(identify.get("error", "")),
        }
    text = (
        f"{len(identify.get('identified', []))} errors from {identify.get('readings_used', '–')} of "
        f"{identify.get('readings', '–')} readings; residual {um(identify.get('residual_rms_um'))} µm rms."
    )
    return {"state": "neutral", "headline": "Errors identified", "text": text}


def _compare_verdict(compare: Mapping[str, Any]) -> dict[str, str]:
    """The verdict of a comparison in words; green only where the bands separate."""
    word = str(compare.get("verdict", ""))
    state = {"better": "accepted", "worse": "rejected"}.get(word, "neutral")
    headline = {
        "better": "Better: the bands before and after separate",
        "worse": "Worse: the bands before and after separate",
        "not separated": "No difference beyond the uncertainty",
        "smaller": "Smaller, by figures without uncertainty",
        "larger": "Larger, by figures without uncertainty",
    }.get(word, "Before and after compared")
    decided = ", ".join(map(str, compare.get("decided_by", [])))
    return {"state": state, "headline": headline, "text": f"Decided by {decided}." if decided else ""}


def _headline(state: str, controls: Sequence[Mapping[str, Any]]) -> str:
    if len(controls) == 1 and state == "partial" and not controls[0]["volumetric"]:
        return f"Partial: {controls[0]['measured']}; the tables correct what was measured and nothing else"
    if len(controls) == 1:
        return {
            "accepted": "The tables may be loaded, by the preflight list",
            "partial": "The tables may be loaded, by the preflight list, but much of the error is beyond this control",
            "accepted_with_reservations": "The tables may be loaded, by the preflight list, with the reservations below",
            "better_after_new_setup": "Better only after the workpiece is set up anew",
            "rejected": "Do not load these tables",
        }[state]
    count = {name: sum(item["state"] == name for item in controls) for name in VERDICTS}
    parts = [f"{count[key]} {VERDICTS[key].lower()}" for key in VERDICTS if count[key]]
    return f"{len(controls)} controls: {'; '.join(parts)}"


def _verdict_text(controls: Sequence[Mapping[str, Any]]) -> str:
    loadable = [item for item in controls if item["state"] != "rejected"] or controls
    best = min(loadable, key=lambda item: item["after"].get("rms_um", math.inf))
    before, after = best["before"], best["after"]
    name = f"With {best['name']} the" if len(controls) > 1 else "The"
    change = f"goes from {um(before.get('rms_um'))} to {um(after.get('rms_um'))} µm rms"
    known = um(best["uncertainty"].get("U_rms_um")) if best["uncertainty"] else ""
    bounds = f"± {known} µm (uncertainty of the measurement, k = 2)" if known else "(its uncertainty is not known)"
    if not best["volumetric"]:
        return (
            f"{name} effect of the measured errors alone {change} {bounds}, as the files that were read back say. The error "
            "over the volume is not known: the other errors were not measured."
        )
    text = f"{name} error of the tool tip over the volume {change} {bounds}, as it stands, as the files that were read back say."
    if best["state"] == "better_after_new_setup":
        rigid = f"{um(best['before_rigid'].get('rms_um'))} to {um(best['after_rigid'].get('rms_um'))} µm rms"
        text += f" With the best-fit rigid motion of the workpiece taken out it goes from {rigid}."
    return text


def _errors(table: ErrorTable | None) -> list[dict[str, Any]]:
    """One row for each error: largest value and uncertainty, and all values, in the unit of the files."""
    rows: list[dict[str, Any]] = []
    for name in table.names if table is not None else ():
        assert table is not None
        unit = error_named(name)
        row: dict[str, Any] = {"error": name, "meaning": describe_error(name), "unit": unit.unit}
        if name in table.squareness:
            value, u = (part / unit.si_per_unit for part in table.squareness[name])
            row |= {"largest": value, "at_mm": None, "U": COVERAGE * u, "position_mm": [], "value": [value], "u": [u]}
        else:
            curve = table.curves[name]
            k = int(np.argmax(np.abs(curve.value)))
            row |= {"largest": float(curve.value[k] / unit.si_per_unit), "at_mm": float(curve.position_mm[k])}
            row |= {
                "U": float(COVERAGE * np.max(curve.u) / unit.si_per_unit),
                "position_mm": curve.position_mm.tolist(),
            }
            row |= {"value": (curve.value / unit.si_per_unit).tolist(), "u": (curve.u / unit.si_per_unit).tolist()}
        rows.append(row)
    return rows


def _measurement(source: ResultFolder) -> dict[str, Any]:
    keys = (
        "method",
        "readings",
        "readings_used",
        "residual_rms_um",
        "residual_max_um",
        "reduced_chi_square",
        "degrees_of_freedom",
        "rank",
        "unknowns",
        "u_length",
        "u_deviation",
        "unobservable",
        "rejected",
        "segments",
        "stations",
        "corrections",
        "worst_standard_uncertainty",
        "systematic",
        "objections",
    )
    return {key: source.identify[key] for key in keys if source.identify.get(key) not in (None, [], {})}


def _machine(source: ResultFolder) -> dict[str, Any]:
    machine = source.machine
    if machine is None:
        return next((dict(item.manifest["machine"]) for item in source.controls if "machine" in item.manifest), {})
    return {
        "name": machine.name,
        "chain": machine.chain.name,
        "squareness_reference": machine.squareness_reference,
        "tool_offset_mm": list(machine.tool_offset_mm),
        "reference_point_mm": list(machine.reference_point_mm),
        "travel_mm": {name: list(axis.range_mm) for name, axis in zip("XYZ", machine.axes, strict=True)},
    }


def _provenance(source: ResultFolder) -> dict[str, Any]:
    inputs = source.identify.get("inputs", [])
    if not inputs and source.controls:
        inputs = source.controls[0].manifest.get("inputs", [])
    inputs = inputs or source.compare.get("inputs", []) or source.accuracy.get("inputs", [])
    programs = {str(item.manifest.get("program", "")) for item in source.controls} - {""}
    date = None if source.identified is None else source.identified.metadata.get("date")
    return {
        "tables_made_by": sorted(programs),
        "report_made_by": f"compgen {program_version()}",
        "inputs": list(inputs),
        "date": date,
        "errors_sha256": sorted({str(item.manifest.get("errors_sha256", "")) for item in source.controls} - {""}),
    }
