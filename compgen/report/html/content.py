"""The report as plain data: what `report.json` holds, with the figures of ISO 230 and the limitations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compgen.accuracy.evaluate import axis_figures, diagonal_figures, groups_of_errors, statements_of, volume_fields
from compgen.accuracy.field import error_source, volume_figures
from compgen.accuracy.figure import Figure
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.messages import um_text
from compgen.data.names import COVERAGE, error_named
from compgen.errors import CompgenError
from compgen.report.html.folder import ControlFolder, ResultFolder
from compgen.report.html.pictures import describe_error
from compgen.tables import program_version
from compgen.tables.verification import coverage_of

# Figures of ISO 230 in the report: those of the folder, else those of the identified errors.


#: Reference line of straightness and squareness.
LINE = "ls"
GROUPS = {
    "volume": "Volume (ISO 230-1)",
    "orientation": "Orientation of the tool over the volume (ISO 230-1)",
    "axes": "Positioning on the line through the reference point (ISO 230-2)",
    "diagonals": "Body diagonals (ISO 230-6)",
    "errors": "Single errors",
    "straightness": "Straightness by three reference lines",
    "reversal": "Reversal: both directions (ISO 230-2, ISO 230-6)",
    "squareness indication": "Squareness, an indication from the diagonals",
}

#: Groups that every error of the machine has a part in: without all of them they would claim what was not measured.
VOLUMETRIC = ("volume", "orientation", "diagonals", "squareness indication")


def accuracy_groups(source: ResultFolder) -> dict[str, Any]:
    """Return the figures by group with rows ``key, value, U, unit, meaning``, and in words what they refer to.

    Those of ``accuracy.json`` where it is there; else the machine as it was identified, and beside its positioning and
    diagonals what they become with the tables of each control as they were read back.
    """
    if source.accuracy:
        figures = source.accuracy.get("figures", {})
        groups = [{"name": GROUPS.get(name, name), "rows": _rows(group)} for name, group in figures.items()]
        return {"groups": groups, "statements": list(source.accuracy.get("statements", [])), "with_tables": []}
    if source.machine is None or source.identified is None:
        return {}
    try:
        return _of_errors(source, source.machine, source.identified)
    except (CompgenError, ValueError, LookupError):  # errors that do not fit the machine file of the folder
        return {}


def _of_errors(source: ResultFolder, machine: Machine, errors: ErrorTable) -> dict[str, Any]:
    given = error_source(machine, errors)
    ((full, pairs),) = volume_fields(machine, (given,), "axes")
    found: dict[str, Mapping[str, Figure]] = {"volume": volume_figures(full, pairs), **groups_of_errors(given, LINE)}
    found.pop("errors")  # they are shown with their curves
    coverage = coverage_of(machine, errors)
    for name in VOLUMETRIC if coverage.missing else ():
        found.pop(name, None)
    partial = f"{coverage.text}: no figures of the volume and its diagonals, since the other errors are not known"
    groups = [
        {"name": GROUPS[name], "rows": _rows({key: item.summary() for key, item in group.items()})}
        for name, group in found.items()
    ]
    independent = "uncertainties from those of the single values, taken as independent"
    with_tables = []
    for control in source.controls:
        if control.tables is not None:
            moved = error_source(machine, errors, None, control.correction)
            figures = {**axis_figures(moved), **diagonal_figures(moved)}
            with_tables.append({"name": control.name, "figures": {key: item.value for key, item in figures.items()}})
    return {
        "groups": groups,
        "statements": [
            *statements_of(machine, full, LINE),
            independent,
            "the machine as identified, without tables",
            *([partial] if coverage.missing else []),
        ],
        "with_tables": with_tables,
    }


def _rows(group: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for key, item in group.items():
        if isinstance(item, Mapping):
            row = {name: item.get(name) for name in ("value", "unit", "meaning")}
            rows.append({"key": str(key), **row, "U": item.get("U_k2")})
    return rows


def comparison_groups(source: ResultFolder) -> dict[str, Any]:
    """Return ``compare.json`` in the order of the page: verdict, statements, groups of figures before and after."""
    data = source.compare
    if not data:
        return {}
    return {
        "kind": str(data.get("kind", "")),
        "verdict": str(data.get("verdict", "")),
        "improved": bool(data.get("improved")),
        "decided_by": [str(item) for item in data.get("decided_by", [])],
        "statements": [str(item) for item in data.get("statements", [])],
        "groups": [_compared(name, group) for name, group in dict(data.get("figures", {})).items()],
        "prediction": data.get("prediction"),
    }


def _compared(name: str, group: Any) -> dict[str, Any]:
    rows = []
    for key, item in group.items() if isinstance(group, Mapping) else ():
        before, after = item.get("before") or {}, item.get("after") or {}
        row = {"key": str(key), "unit": before.get("unit", ""), "meaning": before.get("meaning", "")}
        row |= {"before": before.get("value"), "before_U": before.get("U_k2")}
        row |= {"after": after.get("value"), "after_U": after.get("U_k2")}
        rows.append({**row, **{name: item.get(name) for name in ("factor", "u_factor", "en", "verdict")}})
    return {"name": GROUPS.get(name, name), "rows": rows}


# What the figures of a report do not say, in words, as far as it follows from what was done.


ALWAYS = (
    "Before and after are computed: the exact model of the machine moves with the identified errors, without and with "
    "what the files make the emulated control add. A measurement after loading is still needed.",
    "Quasi-static geometric errors of three linear axes only: no thermal drift, load, dynamics, spindle or rotary axes.",
    "The figures follow published formulas of ISO 230-1 and ISO 230-2; the program is not certified against the "
    "standards.",
    "Uncertainties are expanded with k = 2. They include the noise of the readings, and those systematic inputs that were "
    "stated.",
)


def limitations(source: ResultFolder) -> list[str]:
    """Return what the reader should not take from this report."""
    found = list(ALWAYS) if source.controls else list(ALWAYS[1:])
    identify = source.identify
    if identify.get("unobservable"):
        found.append(f"Not observable, and left at zero: {'; '.join(map(str, identify['unobservable']))}.")
    if identify and not identify.get("systematic"):
        found.append(
            "No systematic input (wavelength, temperature, target, drift) was stated; none is in the uncertainties."
        )
    if identify.get("u_length", identify.get("u_deviation", {})).get("source") == "assumed":
        found.append("The uncertainty of the readings was assumed, and scaled by the residuals.")
    for item in source.controls:
        found += [f"{item.name}: {text}" for text in item.manifest.get("unverified", [])]
        if not item.manifest:
            found.append(f"{item.name}: manifest.json is not in the folder, so settings and signs are not stated here.")
        found += [
            f"{item.name}: {f.name} is not the file that was verified (its SHA-256 differs); its verdict does not apply to it."
            for f in item.files
            if f.intact is False
        ]
    return found


# The report as plain data: what ``report.json`` holds, and what page, dossier and terminal say.


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


#: What the report takes over from ``identify.json``, where there is something.
MEASUREMENT = (
    "method", "readings", "readings_used", "residual_rms_um", "residual_max_um", "reduced_chi_square", "degrees_of_freedom",
    "rank", "unknowns", "u_length", "u_deviation", "unobservable", "rejected", "segments", "stations", "corrections",
    "worst_standard_uncertainty", "systematic", "objections",
)  # fmt: skip


def content(source: ResultFolder) -> dict[str, Any]:
    """Return the numbers of the report; only plain values, every text as in the files."""
    controls, identify = [_control(item) for item in source.controls], source.identify
    return {
        "format": "compgen report 1",
        "kind": source.kind,
        "title": _machine_name(source),
        "verdict": _verdict(source, controls),
        "controls": controls,
        "errors": _errors(source.identified),
        "measurement": {key: identify[key] for key in MEASUREMENT if identify.get(key) not in (None, [], {})},
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
    """Say why an error remains, by its name: what the control would need to take it out."""
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
    return um_text(value, whole_from=100.0)


#: Verdicts of a comparison in words.
COMPARED = {
    "better": "Better: the bands before and after separate",
    "worse": "Worse: the bands before and after separate",
    "not separated": "No difference beyond the uncertainty",
    "smaller": "Smaller, by figures without uncertainty",
    "larger": "Larger, by figures without uncertainty",
}


def _verdict(source: ResultFolder, controls: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    if controls:
        state = max((str(item["state"]) for item in controls), key=list(VERDICTS).index)
        return {"state": state, "headline": _headline(state, controls), "text": _verdict_text(controls)}
    if source.kind == "compare":
        # Green only where the bands separate.
        word = str(source.compare.get("verdict", ""))
        decided = ", ".join(map(str, source.compare.get("decided_by", [])))
        return {
            "state": {"better": "accepted", "worse": "rejected"}.get(word, "neutral"),
            "headline": COMPARED.get(word, "Before and after compared"),
            "text": f"Decided by {decided}." if decided else "",
        }
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
            f"{name} effect of the measured errors alone {change} {bounds}, by the files read back. The error "
            "over the volume is not known: the other errors were not measured."
        )
    text = (
        f"{name} error of the tool tip over the volume {change} {bounds}, with the reference point fixed, by the files "
    )
    text += "read back."
    if best["state"] == "better_after_new_setup":
        rigid = f"{um(best['before_rigid'].get('rms_um'))} to {um(best['after_rigid'].get('rms_um'))} µm rms"
        text += f" With the best-fit rigid motion of the workpiece removed it goes from {rigid}."
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
        **({} if source.residuals is None else source.residuals.stated),
        "errors_sha256": sorted({str(item.manifest.get("errors_sha256", "")) for item in source.controls} - {""}),
    }
