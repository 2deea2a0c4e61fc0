"""The report of a folder as files: HTML page, dossier, calibration record, and the lines for the terminal."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from rich.console import Group
from rich.text import Text

from compgen.accuracy.evaluate import axis_figures, diagonal_figures, groups_of_errors, statements_of, volume_fields
from compgen.accuracy.field import ErrorSource, Figure, error_source, volume_figures
from compgen.data.error_table import ErrorTable
from compgen.data.files import OutputFolder, json_text, json_values, read_bytes, read_text
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, CURVE_NAMES, describe_error, error_named
from compgen.drawing.charts import LABEL, Picture, page_assets
from compgen.errors import CompgenError, number_text, one_line, um_text
from compgen.identification.covariance import covariance_named_by
from compgen.kinematics.kernel_switch import one_thread
from compgen.report.handover import handed_over
from compgen.report.html.folder import (
    CERTIFICATE,
    ControlFolder,
    KnownTables,
    ResultFolder,
    TableCurve,
    read_folder,
    table_curves,
)
from compgen.report.html.pictures import (
    draw_circles,
    draw_curve,
    draw_proposed,
    draw_residuals,
    draw_slices,
    draw_space,
    draw_squareness,
    draw_stations,
    draw_tables,
    grid_of,
    thousands,
    uncertainty_um,
)
from compgen.report.rotary_axes import of_rotary_axes, rotary_result, rotary_section
from compgen.report.summary import Summary, draw_summary, summary_of
from compgen.resources import LANGUAGES, data_folder
from compgen.tables import REPORT_FILES, program_version
from compgen.tables.render import KeptTemplates
from compgen.tables.verification import coverage_of, known_errors, open_text, rounded_limits

if TYPE_CHECKING:
    from markdown_it import MarkdownIt

# Figures of ISO 230 in the report: those in the folder, otherwise those of the identified errors.


# The report as plain data: contents of `report.json`, with the figures of ISO 230 and the limitations.

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

#: Groups to which every error of the machine contributes: without all errors they would claim what was not measured.
VOLUMETRIC = ("volume", "orientation", "diagonals", "squareness indication")


def accuracy_groups(source: ResultFolder) -> dict[str, Any]:
    """Return the figures by group with rows ``key, value, U, unit, meaning``, and in words what they refer to.

    They come from ``accuracy.json`` if it exists; otherwise from the machine as identified, with positioning and
    diagonals also for the tables of each control as read back.
    """
    if source.accuracy:
        figures = source.accuracy.get("figures", {})
        groups = [{"name": GROUPS.get(name, name), "rows": _rows(group)} for name, group in figures.items()]
        return {"groups": groups, "statements": list(source.accuracy.get("statements", [])), "with_tables": []}
    if source.machine is None or source.identified is None:
        return {}
    try:
        return _of_errors(source, source.machine, source.identified)
    except (CompgenError, ValueError, LookupError):  # errors that do not match the machine file of the folder
        return {}


def _of_errors(source: ResultFolder, machine: Machine, errors: ErrorTable) -> dict[str, Any]:
    covariance = covariance_named_by(source.folder / "identified.errors.csv", errors)
    given = error_source(machine, errors, covariance)
    ((full, pairs),) = volume_fields(machine, (given,), "axes")
    found: dict[str, Mapping[str, Figure]] = {"volume": volume_figures(full, pairs), **groups_of_errors(given, LINE)}
    found.pop("errors")  # they are shown with their curves
    coverage = coverage_of(machine, errors, known_errors(machine, errors, covariance))
    listed = coverage_of(machine, errors)
    for name in VOLUMETRIC if listed.missing else ():
        found.pop(name, None)
    # of an axis whose positioning was not measured, 0 +- 0 would be a claim
    unknown = [f"M_{axis}" for axis in AXES if f"E{axis}{axis}" not in errors.names]
    found["axes"] = {key: item for key, item in found["axes"].items() if key not in unknown}
    if not found["axes"]:
        found.pop("axes")
    partial = f"{coverage.text}: no figures of the volume and its diagonals, because the other errors are unknown"
    groups = [
        {"name": GROUPS[name], "rows": _rows({key: item.summary() for key, item in group.items()})}
        for name, group in found.items()
    ]
    independent = "uncertainties from those of the single values, taken as independent"
    if covariance is not None:
        independent = "uncertainties from what is known of all errors together"
    with_tables = []
    for control in source.controls:
        if control.tables is not None:
            moved = ErrorSource(machine, errors, correction=control.correction)  # only the values are shown
            figures = {**axis_figures(moved), **diagonal_figures(moved)}
            with_tables.append({"name": control.name, "figures": {key: item.value for key, item in figures.items()}})
    return {
        "groups": groups,
        "statements": [
            *statements_of(machine, full, LINE),
            independent,
            "the machine as identified, without tables",
            *([partial] if listed.missing else []),
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


# What the figures of a report do not say, in words.


ALWAYS = (
    "Before and after are computed: the exact model of the machine moves with the identified errors, without and with "
    "what the emulated control adds with these files. A measurement after loading is still needed.",
    "Quasi-static geometric errors of three linear axes only: no thermal drift, load, dynamics, spindle or rotary axes.",
    "The figures follow published formulas of ISO 230-1 and ISO 230-2; the program is not certified against the "
    "standards.",
    "Uncertainties are expanded with k = 2. They include the noise of the readings, those systematic inputs that were "
    "stated, and what is assumed of errors that were not measured, as far as it is named below.",
)


#: In place of the second of these, where errors of rotary axes were identified.
WITH_ROTARY = "Quasi-static geometric errors only: no thermal drift, load, dynamics or errors of the running spindle."
#: Rotary axes that were identified without files of the linear ones.
ROTARY_ALONE = (
    "the linear axes were not measured; of each position error of a rotary axis the size in the column \u201cassumed\u201d was "
    "taken before the measurement (k = 1), and what the readings do not determine keeps it as its uncertainty"
)


def in_part_of(identify: Mapping[str, Any]) -> list[str]:
    """Return the errors that are listed in ``identify.json`` although the readings do not determine them."""
    if "determined" not in identify:
        return []
    return [str(name) for name in identify.get("identified") or [] if name not in identify["determined"]]


def limitations(source: ResultFolder) -> list[str]:
    """Return the limitations of this report."""
    found = list(ALWAYS) if source.controls else list(ALWAYS[1:])
    identify = source.identify
    if of_rotary_axes(identify) or any(rotary_result(item.result) for item in source.controls):
        found[found.index(ALWAYS[1])] = WITH_ROTARY
    in_part = in_part_of(identify)
    if in_part:
        found.append(
            f"Known in part only: {', '.join(in_part)}. Of these the readings leave more than a third of what is assumed of "
            "errors that were not measured; their values are drawn towards zero by it, and their uncertainties have it in."
        )
    if identify.get("unobservable"):
        found.append(
            f"Not in the errors found, so no table corrects it: {'; '.join(map(str, identify['unobservable']))}."
        )
    found += [text[0].upper() + text[1:] + "." for text in assumptions_of(identify)] if identify else []
    if identify and not identify.get("systematic"):
        found.append(
            "No systematic input (wavelength, temperature, target, drift) was stated; the uncertainties include none."
        )
    if identify.get("u_length", identify.get("u_deviation", {})).get("source") == "assumed":
        found.append("The uncertainty of the readings was assumed and scaled by the residuals.")
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


# The report as plain data: the contents of ``report.json``, for page, dossier and terminal.


#: Figures of a residual field and what they are.
FIGURES = (
    ("max_um", "largest error |e|"),
    ("rms_um", "rms of |e|"),
    ("p95_um", "95 % of the points below"),
    ("v_x_um", "V_X, range of the X component (ISO 230-1)"),
    ("v_y_um", "V_Y, range of the Y component (ISO 230-1)"),
    ("v_z_um", "V_Z, range of the Z component (ISO 230-1)"),
)
#: States of tables from best to worst, with their headings; the middle ones are amber on the page.
VERDICTS = {
    "accepted": "Accepted",
    "partial": "Accepted, partial",
    "accepted_with_reservations": "Accepted with reservations",
    "better_after_new_setup": "Better only after a new set-up",
    "rejected": "Not accepted",
}


#: What the report takes from ``identify.json``, if present.
MEASUREMENT = (
    "method", "readings", "readings_used", "residual_rms_um", "residual_max_um", "reduced_chi_square", "degrees_of_freedom",
    "rank", "unknowns", "u_length", "u_deviation", "unobservable", "rejected", "segments", "stations", "corrections",
    "worst_standard_uncertainty", "systematic", "objections", "notes",
)  # fmt: skip


def content(source: ResultFolder) -> dict[str, Any]:
    """Return the numbers of the report; only plain values, every text as in the files."""
    controls, identify = [_control(item) for item in source.controls], source.identify
    identified = {} if source.identified is None else source.identified.metadata
    manifests = [item.manifest for item in source.controls]
    results = (source.compare, source.accuracy, *(item.result for item in source.controls))
    # the name of a folder says nothing about its contents
    title = "Machine without a name" if source.machine is None else source.machine.name
    if source.machine is None:
        named = chain(
            (made.get("machine", {}).get("name") for made in manifests),
            [identified.get("machine"), identify.get("machine")],
            (data.get("machine") for data in results),
        )
        title = next((str(name) for name in named if name), title)
    inputs = identify.get("inputs") or _hashed(identify.get("provenance"))
    inputs = inputs or (_hashed(manifests[0].get("inputs", [])) if manifests else [])
    return {
        "format": "compgen report 1",
        "kind": source.kind,
        "title": title,
        "verdict": _verdict(source, controls),
        "controls": controls,
        "summary": None if (seen := _summary(source)) is None else seen.as_dict(),
        "errors": _errors(source.identified, in_part_of(identify)),
        "rotary": rotary_section(identify),
        "assumed": assumptions_of(identify) if identify and identify.get("identified") is not False else [],
        "measurement": _measurement(identify),
        "next": _proposed(source),
        "accuracy": accuracy_groups(source),
        "compare": comparison_groups(source),
        "machine": _machine(source),
        "provenance": {
            "tables_made_by": sorted({str(made.get("program", "")) for made in manifests} - {""}),
            "report_made_by": f"compgen {program_version()}",
            "inputs": list(inputs or source.compare.get("inputs", []) or source.accuracy.get("inputs", [])),
            "date": identified.get("date"),
            **({} if source.residuals is None else source.residuals.stated),
            "errors_sha256": sorted({str(made.get("errors_sha256", "")) for made in manifests} - {""}),
        },
        "handover": handed_over(
            source.certificate,
            identify.get("files") or [],
            {} if source.residuals is None else source.residuals.stated,
        ),
        "limitations": limitations(source),
        "notes": list(source.notes),
    }


def _hashed(inputs: Any) -> list[Any]:
    """Files with their hashes as a list; results of rotary axes have them by name."""
    if isinstance(inputs, Mapping):
        return [{"name": str(name), "sha256": str(digest)} for name, digest in inputs.items()]
    return list(inputs or [])


def _measurement(identify: Mapping[str, Any]) -> dict[str, Any]:
    """What the report says of the readings of the linear axes; those of the rotary ones have their own section."""
    if of_rotary_axes(identify) and "readings" not in identify:
        return {}
    return {key: identify[key] for key in MEASUREMENT if identify.get(key) not in (None, [], {})}


def _summary(source: ResultFolder) -> Summary | None:
    """What matters of the errors of a folder; None if it has none, or errors of another machine."""
    try:
        return summary_of(source.machine, source.identified, source.identify)
    except (CompgenError, ValueError, LookupError):
        return None


def _proposed(source: ResultFolder) -> dict[str, Any]:
    """What to measure next, as ``identify.json`` or ``result.json`` has it; empty where nothing is proposed."""
    found = (source.identify, *(item.result for item in source.controls))
    data = next((item for item in found if item.get("next_measurements")), {})
    return {"text": str(data.get("next_text", "")), "measurements": list(proposed_rows(data.get("next_measurements")))}


def proposed_rows(listed: Any) -> Iterator[dict[str, Any]]:
    """Yield what a page shows of ``next_measurements``; entries without their keys are left out."""
    for item in listed if isinstance(listed, list) else ():
        known = _mapping(item)
        if isinstance(known.get("reduces"), list) and isinstance(known.get("u_after_um"), int | float):
            texts = {key: str(known.get(key, "")) for key in ("what", "how")}
            yield {**texts, **{key: known.get(key) for key in ("u_after_um", "reduces", "picture")}}


def judged(name: str, result: Mapping[str, Any]) -> dict[str, Any]:
    """Return what ``result.json`` of a control says, and the verdict in words: ``said`` in short, ``text`` with figures."""
    state, rotary = _state(result), rotary_result(result)
    found = {
        "name": name,
        "state": state,
        "verdict": VERDICTS[state],
        "headline": str(result.get("headline", "")),
        "volumetric": bool(result.get("volumetric", True)),
        "measured": str(_mapping(result.get("measured")).get("text", "")),
        "uncertainty": dict(_mapping(result.get("after_uncertainty"))),
        "limits": _limits(_mapping(result.get("probable"))),
        "assumed": [] if rotary else assumptions_of(result),
        "rotary": rotary,
        "probability_better": result.get("probability_better"),
        "before": _mapping(result.get("before")),
        "after": _mapping(result.get("after")),
        "before_rigid": _mapping(result.get("before_rigid_motion_removed")),
        "after_rigid": _mapping(result.get("after_rigid_motion_removed")),
    }
    return {**found, "said": _headline(state, [found]), "text": _verdict_text([found])}


#: What is said of a result that has no prior: made by an earlier version, or with class none.
WITHOUT_PRIOR = (
    "without prior: the uncertainties have nothing of errors that were not measured, and are not compared with those of "
    "other results"
)


def assumptions_of(result: Mapping[str, Any]) -> list[str]:
    """Return what ``result.json`` or ``identify.json`` says is assumed of errors that were not measured."""
    if of_rotary_axes(result) and "prior" not in result:
        return [ROTARY_ALONE] if result.get("errors") else []
    if _mapping(result.get("prior")).get("class", "none") == "none":
        return [WITHOUT_PRIOR]
    probable = _mapping(result.get("probable")) or result
    costs = {str(key): float(value) for key, value in _mapping(probable.get("not_determined_rms_um")).items()}
    said = (probable.get("assumed"), open_text(costs), probable.get("machine_worse_than_class"))
    return [str(text) for text in said if text]


def _limits(probable: Mapping[str, Any]) -> dict[str, list[str]]:
    """Before with its limits, after and at most, um rms, rounded: as it stands, and with the rigid motion removed."""
    found = {}
    for key, name in (("as_it_stands", "rms_um"), ("rigid", "rms_rigid_motion_removed_um")):
        parts = [_mapping(probable.get(f"{when}_{name}")) for when in ("before", "after")]
        if all(isinstance(part.get(word), int | float) for part in parts for word in ("median", "low", "high")):
            before, after = ((part["median"], part["low"], part["high"]) for part in parts)
            found[key] = list(rounded_limits(before, after))
    return found


def _control(item: ControlFolder) -> dict[str, Any]:
    result = item.result
    return {
        **judged(item.name, result),
        "objections": [str(_mapping(entry).get("text", "")) for entry in result.get("objections") or []],
        "next_command": str(result.get("next_command") or ""),
        "format": item.manifest.get("format", ""),
        "evidence": item.manifest.get("evidence", ""),
        "points": result.get("points"),
        "unrepresentable_um": result.get("unrepresentable_um"),
        "uncorrected": [
            {"error": name, "um": value, "why": why_uncorrected(name)}
            for name, value in dict(result.get("uncorrected_um", {})).items()
        ],
        "reasons": list(result.get("reasons", [])),
        "notes": [text for text in result.get("notes", []) if text not in assumptions_of(result)],
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
    """The state of a control's tables; results of earlier versions only have accepted and partial."""
    if not result.get("accepted"):
        return "rejected"
    state = str(result.get("verdict", "partial" if result.get("partial") else "accepted"))
    return state if state in VERDICTS else "accepted_with_reservations"


def why_uncorrected(name: str) -> str:
    """Return why an error remains, by its name: what the control would need to correct it."""
    if name not in _KNOWN:
        return "differs between the two directions of travel; these tables act in the same way in both"
    error = error_named(name)
    if error.kind == "squareness":
        return "moves another axis in proportion to the travel; that needs a table of one axis over another"
    if error.is_straightness:
        return "moves another axis than the one that travels; that needs a table of one axis over another"
    if error.kind == "angular":
        return "acts through a lever that other axes change; that needs a table times an axis position, or a field"
    return "the interval, rounding or zero point of the table leave this part"


_KNOWN = {f"E{d}{a}" for d in "XYZABC" for a in "XYZ"} | {"EC0Y", "EB0Z", "EA0Z"}


def um(value: Any, u_um: Any = None) -> str:
    """Return a figure in um with a sensible number of digits, no more than its expanded uncertainty leaves; a dash for None.

    >>> um(2964.4), um(12.34), um(0.3959), um(None), um(0.002, 6.1)
    ('2964', '12.3', '0.40', '–', '<0.1')
    """
    return um_text(value, whole_from=100.0, u_um=u_um if isinstance(u_um, int | float) else None)


#: Verdicts of a comparison in words.
COMPARED = {
    "better": "Better: the intervals before and after do not overlap",
    "worse": "Worse: the intervals before and after do not overlap",
    "not separated": "No difference beyond the uncertainty",
    "smaller": "Smaller, by figures without uncertainty",
    "larger": "Larger, by figures without uncertainty",
}


def _verdict(source: ResultFolder, controls: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    if controls:
        state = max((str(item["state"]) for item in controls), key=list(VERDICTS).index)
        return {"state": state, "headline": _headline(state, controls), "text": _verdict_text(controls)}
    if source.kind == "compare":
        # Green only if the intervals do not overlap.
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
    if of_rotary_axes(identify):
        return _rotary_verdict(identify)
    used, readings = identify.get("readings_used", "–"), identify.get("readings", "–")
    residual_rms_um, count = um(identify.get("residual_rms_um")), len(identify.get("identified", []))
    text = (
        f"1 error from {used} of {readings} readings; residual {residual_rms_um} µm rms."
        if count == 1
        else f"{count} errors from {used} of {readings} readings; residual {residual_rms_um} µm rms."
    )
    return {"state": "neutral", "headline": "Errors identified", "text": text}


def _rotary_verdict(identify: Mapping[str, Any]) -> dict[str, str]:
    """Headline and sentence of an identification of rotary axes."""
    text = rotary_section(identify)["title"]
    if identify.get("determined_combinations") == 0:
        return {"state": "rejected", "headline": "The errors are not determined", "text": text}
    return {"state": "neutral", "headline": "Errors of the rotary axes identified", "text": text}


def _headline(state: str, controls: Sequence[Mapping[str, Any]]) -> str:
    if len(controls) == 1 and state == "partial" and not controls[0]["volumetric"]:
        return f"Partial: {controls[0]['measured']}; the tables correct only what was measured"
    if len(controls) == 1:
        return {
            "accepted": "The tables may be loaded, following the preflight list",
            "partial": "The tables may be loaded, following the preflight list, but much of the error remains",
            "accepted_with_reservations": "The tables may be loaded, following the preflight list, with the reservations below",
            "better_after_new_setup": "Better only after the workpiece is set up again",
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
    if best["rotary"]:
        return (
            f"{name} error of the tool tip over the travel, all angles and tools of 0 to 200 mm, with the part set up, goes from "
            f"{um(before.get('rms_um'))} to {um(after.get('rms_um'))} µm rms, as read back from the files."
        )
    if "as_it_stands" in best["limits"]:
        one, low, high, left, most = best["limits"]["as_it_stands"]
        text = (
            f"{name} error of the tool tip over the volume goes from {one} µm rms ({low} to {high} µm) to {left} µm, at most "
            f"{most} µm, with the reference point fixed; 97.5 % limits, with what was not measured."
        )
        return text if best["volumetric"] else f"{text} What was measured: {best['measured']}."
    known = um(best["uncertainty"].get("U_rms_um")) if best["uncertainty"] else ""
    bounds = f"± {known} µm (uncertainty of the measurement, k = 2)" if known else "(its uncertainty is unknown)"
    if not best["volumetric"]:
        return (
            f"{name} effect of the measured errors alone goes from {um(before.get('rms_um'))} to {um(after.get('rms_um'))} "
            f"µm rms {bounds}, as read back from the files. The error over the volume is unknown: the other errors were not "
            "measured."
        )
    text = (
        f"{name} error of the tool tip over the volume goes from {um(before.get('rms_um'))} to {um(after.get('rms_um'))} "
        f"µm rms {bounds}, with the reference point fixed, as read back from the files."
    )
    if best["state"] == "better_after_new_setup":
        rigid = f"{um(best['before_rigid'].get('rms_um'))} to {um(best['after_rigid'].get('rms_um'))} µm rms"
        text += f" With the best-fit rigid motion of the workpiece removed it goes from {rigid}."
    return text


def _errors(table: ErrorTable | None, in_part: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return a row for each error: largest value and uncertainty, and all values, in the unit of the files.

    ``in_part`` are errors that the readings do not determine.
    """
    rows: list[dict[str, Any]] = []
    for name in table.names if table is not None else ():
        assert table is not None
        unit = error_named(name)
        row: dict[str, Any] = {"error": name, "meaning": describe_error(name), "unit": unit.unit}
        row["in_part"] = name in in_part
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


# The HTML page: Jinja2 with every text escaped, one style sheet, one script, and a policy that forbids the network.


#: Markdown of the preflight lists; no raw HTML, links or pictures.
_OFF = ("html_block", "html_inline", "link", "image", "autolink", "reference")


def render_page(
    source: ResultFolder,
    data: Mapping[str, Any],
    pictures: Mapping[str, Sequence[Picture]],
    seconds: float | None = None,
    language: str = LANGUAGES[0],
) -> str:
    """Return the text of ``report.html``.

    Parameters
    ----------
    source : the folder, for the beginnings of the files and the preflight lists.
    data : from :func:`compgen.report.html.write.content`.
    pictures : by group: ``curves``, ``squareness``, ``measurement``, and ``space-K``, ``slices-K``, ``tables-K`` for
        control K.
    seconds : how long the drawing took; None omits it.
    language : of the page; what users wrote, and what is in files for a control, stays as it is.
    """
    environment = page_environment("report", language)
    style, script, policy = page_assets("charts.js", "script.js")
    has_named = any(item["series"][-1]["name"].startswith("table ") for item in (p.data for p in pictures["curves"]))
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        pictures = {group: [texts_of(language).picture(item) for item in items] for group, items in pictures.items()}
    drawn = [picture for group in pictures.values() for picture in group]
    return environment.get_template("page.html.j2").render(
        data=data,
        controls=list(zip(data["controls"], source.controls, strict=True)),
        pictures=pictures,
        has_fit=source.fitted is not None,
        has_named=has_named,
        figures=FIGURES,
        policy=policy,
        style=style,
        script=script,
        payload=script_data({picture.key: dict(picture.data) for picture in drawn if picture.data}),
        seconds=seconds,
        running=css_string(running_text(data)),
    )


def running_text(data: Mapping[str, Any]) -> str:
    """Return what stands below every printed page, so that each is known to belong to this report."""
    facts = {item["heading"]: item["text"] for item in data["handover"]["facts"]}
    number = facts["Certificate number"]
    return "  ".join(str(part) for part in (data["title"], number, data["provenance"]["date"]) if part)


def css_string(text: str) -> Markup:
    r"""Return a text as the inside of a CSS string, which no character of it can end.

    >>> str(css_string('a"</style>'))
    'a\\22 \\3c \\2f style\\3e '
    """
    return Markup("".join(char if char.isalnum() or char == " " else f"\\{ord(char):x} " for char in text[:120]))


def micro(text: str) -> str:
    """Return a text of the terminal with the units of numbers as pages write them.

    >>> micro("EC0Y +2904 urad, 35.1 um over X; um.csv")
    'EC0Y +2904 µrad, 35.1 µm over X; um.csv'
    """
    return re.sub(r"(?<=\d )u(?=(?:m|rad)\b)", "µ", text)


def page_environment(kind: str, language: str = LANGUAGES[0]) -> Environment:
    """Return the templates of pages in a language: every text is escaped; compiled templates are kept for each ``kind``."""
    environment = Environment(
        loader=FileSystemLoader(data_folder("templates") / "_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        optimized=False,
        bytecode_cache=KeptTemplates(kind if language == LANGUAGES[0] else f"{kind}-{language}"),
    )
    environment.filters |= {
        "um": um,
        "number": number_text,
        "known": lambda value: number_text(value, missing="not known"),
        "markdown": markdown,
        "unit": lambda name: LABEL.get(name, name),
        "thousands": thousands,
        "word": str,
        "micro": micro if language == LANGUAGES[0] else str,  # other languages write the sign themselves
    }
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        texts_of(language).translate(environment, html=True)
    return environment


def script_data(value: Any) -> Markup:
    r"""Return data as JSON that stays data inside a script element, whatever texts it contains.

    >>> print(script_data({"a": "</script><!--"}))
    {"a":"\u003c/script\u003e\u003c!--"}
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)  # ASCII, so U+2028 and U+2029 are escaped
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def markdown(text: str) -> Markup:
    """Return the HTML of Markdown without raw HTML, links and pictures; the check boxes of lists become marks."""
    html = _markdown_renderer().render(text)
    html = re.sub(r"<(/?)h([1-3])>", lambda found: f"<{found.group(1)}h{int(found.group(2)) + 3}>", html)
    return Markup(html.replace("<li>[ ] ", "<li class='check'>"))


@cache
def _markdown_renderer() -> MarkdownIt:
    from markdown_it import MarkdownIt

    return MarkdownIt("commonmark", {"html": False}).enable("table").disable(list(_OFF))


# The documentation of a compensation in the spirit of ISO/TR 16907, clause 12: what was done, with what, and its limits.
#
# The clauses of the report were not at hand; the sections follow its published contents (kinematic representation,
# geometric errors, determination, compensation, validation, documentation).


#: Characters with a meaning in Markdown or HTML.
_SPECIAL = "\\`*_{}[]<>()#+!|&~"


#: What the dossier contains about the tables of a control and their verification.
TABLES = ("name", "format", "evidence", "settings", "sign_statement", "parameters", "files")
VERIFICATION = (
    "name", "state", "headline", "measured", "objections", "points", "before", "after", "before_rigid", "after_rigid",
    "unrepresentable_um", "uncorrected", "reasons", "notes", "rotary",
)  # fmt: skip


def dossier_data(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of the dossier from the numbers of the report (:func:`compgen.report.html.write.content`)."""
    return {
        "format": "compgen dossier 1",
        "machine": data["machine"] or {"name": data["title"]},
        "measured": {"inputs": data["provenance"]["inputs"], "date": data["provenance"]["date"]},
        "handover": data["handover"],
        "model": {
            "kinematic_chain": data["machine"].get("chain"),
            "errors": [item["error"] for item in all_errors(data)],
            "convention": "names and signs of ISO 230-1: actual minus commanded, tool relative to workpiece",
        },
        "identification": data["measurement"],
        "identified_errors": data["errors"],
        "rotary_axes": data["rotary"],
        "tables": [{key: item[key] for key in TABLES} for item in data["controls"]],
        "verification": [{key: item[key] for key in VERIFICATION} for item in data["controls"]],
        "accuracy": data["accuracy"],
        "comparison": data["compare"],
        "limits": data["limitations"],
        "provenance": data["provenance"],
    }


def all_errors(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the errors of linear axes, then constants and motions of rotary ones, from the numbers of the report."""
    rotary = data["rotary"]
    return [*data["errors"], *rotary.get("errors", []), *rotary.get("motions", [])]


def plain_markdown(value: Any) -> str:
    r"""Return a value as one line of Markdown that shows it literally, whatever it contains.

    >>> plain_markdown("a|b <img>")
    'a\\|b \\<img\\>'
    """
    text = " ".join(str(value).split())
    return "".join(f"\\{char}" if char in _SPECIAL else char for char in text)


def dossier_text(dossier: Mapping[str, Any]) -> str:
    """Return ``dossier.md`` from :func:`dossier_data`."""
    machine = dossier["machine"]
    lines = [f"# Documentation of the compensation of {plain_markdown(machine.get('name', ''))}", ""]
    lines += ["Lengths in mm, errors in um and urad. Expanded uncertainties with k = 2.", ""]
    lines += _section("1. Machine and model", [*_pairs(machine), *_pairs(dossier["model"])])
    inputs = [[item["name"], f"`{one_line(item['sha256'])}`"] for item in dossier["measured"]["inputs"]]
    given = dossier["handover"]
    facts = {item["heading"]: item["text"] for item in given["facts"]}
    said = [
        f"- {plain_markdown(item['file'])}: {plain_markdown(line)}" for item in given["files"] for line in item["lines"]
    ]
    lines += _section("2. What was measured", [*_table(["file", "SHA-256"], inputs, raw=1), *_pairs(facts), *said])
    rows = []
    for item in dossier["identified_errors"]:
        at = "" if item["at_mm"] is None else f"{item['at_mm']:g}"
        rows.append(
            [item["error"], item["meaning"], f"{item['largest']:+.3f}", at, number_text(item["U"]), item["unit"]]
        )
    errors = _table(["error", "meaning", "largest", "at (mm)", "U (k = 2)", "unit"], rows)
    turned = _rotary_lines(dossier["rotary_axes"])
    lines += _section("3. Identification", [*_pairs(dossier["identification"]), "", *errors, *turned])
    tables: list[str] = []
    for item in dossier["tables"]:
        tables += [f"### {plain_markdown(item['name'])}", ""]
        tables += _pairs({key: item[key] for key in ("format", "evidence", "settings", "sign_statement")})
        files = [[f["name"], f"`{one_line(f['sha256'])}`", f["bytes"], f["lines"]] for f in item["files"]]
        tables += ["", *_table(["file", "SHA-256", "bytes", "lines"], files, raw=1)]
    lines += _section("4. Tables", tables)
    verified: list[str] = []
    for item in dossier["verification"]:
        if item["rotary"]:
            verified += [f"### {plain_markdown(item['name'])}: {item['state']}", ""]
            verified += [f"- {plain_markdown(text)}" for text in (*item["rotary"]["lines"], *item["reasons"])] + [""]
            continue
        verified += [f"### {plain_markdown(item['name'])}: {item['state']}, {item['points']} points", ""]
        parts = ("before", "after", "before_rigid", "after_rigid")
        figures = [[text, *(um(item[part].get(key)) for part in parts)] for key, text in FIGURES]
        headings = ["um", "before", "after", "before, rigid motion removed", "after, rigid motion removed"]
        verified += _table(headings, figures)
        verified += [f"- {plain_markdown(text)}" for text in (item["headline"], *item["objections"]) if text]
        verified += [f"- Cannot be expressed by this control: {um(item['unrepresentable_um'])} um"]
        verified += [f"- Remains: {row['error']} {um(row['um'])} um; {row['why']}" for row in item["uncorrected"]]
        verified += [*(f"- {plain_markdown(text)}" for text in (*item["reasons"], *item["notes"])), ""]
    lines += _section("5. Verification", verified)
    compare = dossier["comparison"]
    compared = [
        [
            row["key"],
            *(_figure(row[side], row[f"{side}_U"]) for side in ("before", "after")),
            row["unit"],
            row["verdict"] or "",
        ]
        for group in compare.get("groups", [])
        for row in group["rows"]
    ]
    table = _table(["figure", "before", "after", "unit", "verdict"], compared)
    lines += _section(
        "6. Accuracy figures and comparison", [*_accuracy(dossier["accuracy"]), *table, *_statements(compare)]
    )
    lines += _section("7. Limits", [f"- {plain_markdown(text)}" for text in dossier["limits"]])
    lines += _section("8. Provenance", _pairs(dossier["provenance"]))
    return "\n".join(lines).rstrip() + "\n"


def _rotary_lines(rotary: Mapping[str, Any]) -> list[str]:
    """The rotary axes in the dossier; empty without them."""
    if not rotary:
        return []
    head = ["error", "ISO 230-7", "meaning", "value", "U (k = 2)", "unit", ""]
    rows = [
        [row["error"], row["axis_name"], row["meaning"], f"{row['largest']:+.3f}", number_text(row["U"]), row["unit"]]
        + ["" if row["determined"] else "not determined"]
        for row in rotary["errors"]
    ]
    motions = [
        [
            row["error"],
            row["meaning"],
            f"{row['largest']:+.3f}",
            f"{row['at_deg']:g}",
            number_text(row["U"]),
            row["unit"],
        ]
        for row in rotary["motions"]
    ]
    apart = [f"cannot be told apart: {row['errors']}; {row['separated_by']}" for row in rotary["not_told_apart"]]
    return [
        *_table(head, rows),
        *_table(["error", "meaning", "largest", "at (degrees)", "U (k = 2)", "unit"], motions),
        *(f"- {plain_markdown(text)}" for text in (*rotary["fit"], *apart, *rotary["notes"])),
    ]


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "", *(lines if any(lines) else ["No data in the folder."]), ""]


def _pairs(data: Mapping[str, Any]) -> list[str]:
    """Return values as a list; longer parts (stations, rejected readings) are counted, their numbers are in the JSON files."""
    lines = []
    for key, value in data.items():
        if value in (None, "", [], {}):
            continue
        many = isinstance(value, list) and value and isinstance(value[0], dict)
        text = f"{len(value)}, see dossier.json" if many else _value(value)
        lines.append(f"- {plain_markdown(str(key).replace('_', ' '))}: {plain_markdown(text)}")
    return lines


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_value(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_value(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _table(head: list[str], rows: list[list[Any]], raw: int | None = None) -> list[str]:
    """Return a Markdown table; column ``raw`` is already Markdown."""
    if not rows:
        return []
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for row in rows:
        cells = [str(value) if k == raw else plain_markdown(_value(value)) for k, value in enumerate(row)]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _figure(value: Any, u: Any) -> str:
    return number_text(value, 2) + ("" if value is None or u is None else f" ± {u:.2f}")


def _accuracy(accuracy: Mapping[str, Any]) -> list[str]:
    rows = [
        [row["key"], _figure(row["value"], row["U"]), row["unit"], row["meaning"]]
        for group in accuracy.get("groups", [])
        for row in group["rows"]
    ]
    return [*_table(["figure", "value", "unit", "meaning"], rows), *_statements(accuracy)]


def _statements(data: Mapping[str, Any]) -> list[str]:
    return [*(f"- {plain_markdown(text)}" for text in data.get("statements", [])), ""]


# ``calibration.json``: the results in the order of a Digital Calibration Certificate, as documented JSON.
#
# It is not a DCC: that is an XML document of PTB's schema (namespace ``https://ptb.de/dcc``), issued and signed by a
# laboratory. Its parts and units have the same names, so that a laboratory can adopt the numbers.


#: Share of values within the expanded uncertainty, for k = 2 and a normal distribution.
PROBABILITY = 0.9545
#: Units in the notation of the D-SI metadata model.
UNITS = {"um": "\\micro\\metre", "urad": "\\micro\\radian", "mm": "\\milli\\metre", "deg": "\\degree"}

STATEMENT = (
    "Documented JSON in the order of a Digital Calibration Certificate; not a DCC and not signed. Fields that only a "
    "laboratory can fill are null."
)


def calibration_record(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of ``calibration.json`` from the numbers of the report."""
    results = [
        {
            "name": item["error"],
            "meaning": item["meaning"],
            "known_in_part": item.get("in_part", False),
            "positions": _list(item["position_deg"], "deg")
            if "position_deg" in item
            else _list(item["position_mm"], "mm"),
            "values": _list(item["value"], item["unit"], item["u"]),
        }
        for item in all_errors(data)
    ]
    method = data["measurement"].get("method")
    errors = {"name": "geometric errors (ISO 230-1)", "usedMethod": method, "results": results}
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
        "measurementResults": [errors, *(_verification(item) for item in data["controls"])],
        "comment": data["limitations"],
        "documents": data["provenance"]["inputs"],
    }


def _list(values: Sequence[Any], unit: str, standard: Sequence[Any] = ()) -> dict[str, Any]:
    """Return a list of real quantities in the form of D-SI: values, one unit, expanded uncertainties if all are known."""
    found: dict[str, Any] = {"valueXMLList": list(values), "unitXMLList": [UNITS[unit]]}
    if standard and None not in standard:
        found["expandedUncXMLList"] = {
            "uncertaintyXMLList": [COVERAGE * u for u in standard],
            "coverageFactor": COVERAGE,
            "coverageProbability": PROBABILITY,
            "distribution": "normal",
        }
    return found


def _verification(item: Mapping[str, Any]) -> dict[str, Any]:
    results = [
        {"name": text, "when": when, "value": item[when].get(key), "unit": UNITS["um"]}
        for when in ("before", "after")
        for key, text in FIGURES
    ]
    what = "error of the tool tip over the volume"
    if not item["volumetric"]:
        what = "effect of the measured errors alone on the tool tip"
    if item["rotary"]:
        what = "error of the tool tip over the travel, all angles and tools of 0 to 200 mm, with the part set up"
    return {
        "name": f"{what}, tables of {item['name']}",
        "usedMethod": "emulation of the files that were read back; computed, not measured",
        "conformity": {"accepted": item["state"] != "rejected", "reasons": [*item["reasons"], *item["objections"]]},
        "results": results,
        "files": item["files"],
    }


# The report of a folder, from its files alone.


#: The files of a report.
FILES = REPORT_FILES
Further = Callable[[Mapping[str, Any]], Mapping[str, bytes]]


@dataclass(frozen=True)
class Report:
    """A report in memory: the texts by file name, and their numbers."""

    files: Mapping[str, str]
    data: Mapping[str, Any]


def build_report(
    folder: str | Path,
    language: str = LANGUAGES[0],
    known: KnownTables | None = None,
    certificate: str | Path | None = None,
) -> Report:
    """Read the results in ``folder`` and make their report, the page in a language; nothing is written.

    ``known`` is what the run which wrote the folder still has, ``certificate`` the file that states customer, machine and
    instruments: see :func:`compgen.report.html.folder.read_folder`.

    Raises
    ------
    InputError
        if the folder contains no results, or one of its files cannot be read.
    """
    with one_thread():
        source = read_folder(folder, known, certificate)
        data = json_values(content(source))
        pictures = draw(source, data)
    page = render_page(source, data, pictures, language=language)
    record = calibration_record(data)
    dossier = dossier_data(data)
    return Report(
        {
            "report.html": page,
            "report.json": json_text(data),
            "dossier.md": dossier_text(dossier),
            "dossier.json": json_text(dossier),
            "calibration.json": json_text(record),
        },
        data,
    )


def write_report(
    folder: str | Path,
    out: str | Path | None = None,
    also: Further | None = None,
    language: str = LANGUAGES[0],
    known: KnownTables | None = None,
    certificate: str | Path | None = None,
    shown: Callable[[str], str] = str,
) -> tuple[Report, dict[str, Path]]:
    """Make the report of ``folder`` and write its files there, or to ``out``: all or none.

    ``also`` makes additional files, by name, from the numbers of the report. ``language`` is that of the page;
    ``known`` and ``certificate``: see :func:`build_report`; ``shown`` makes the finished page one in other units.
    """
    target = OutputFolder(out if out is not None else folder)
    report = build_report(folder, language, known, certificate)
    documents = also(report.data) if also is not None else {}
    if certificate is not None:
        for name, text in certificate_copies(Path(certificate)).items():
            target.add(name, text)
    for name, text in report.files.items():
        target.add(name, shown(text) if name.endswith(".html") else text)
    for name, document in documents.items():
        target.add(name, document)
    return report, target.commit()


def certificate_copies(path: Path) -> dict[str, str | bytes]:
    """Return ``certificate.toml`` and the certificates of instruments that it names beside itself, by name in the folder."""
    from compgen.report.dcc.laboratory import read_certificate

    text, found = read_text(path), dict[str, str | bytes]()
    for thing in read_certificate(path, complete=False).equipment:
        file = thing.certificate_file
        if file is not None and file.resolve().is_relative_to(path.resolve().parent):
            found[file.resolve().relative_to(path.resolve().parent).as_posix()] = read_bytes(file)
    return {CERTIFICATE: text, **found}


def draw(source: ResultFolder, data: Mapping[str, Any]) -> dict[str, list[Picture]]:
    """Return the pictures of a report by group, see :func:`compgen.report.html.write.render_page`."""
    errors = source.fitted or source.identified
    tables: dict[str, tuple[TableCurve, ...]] = {item.name: table_curves(errors, item) for item in source.controls}
    found: dict[str, list[Picture]] = {"curves": [], "squareness": [], "measurement": []}
    seen = _summary(source)
    found["summary"] = [] if seen is None else draw_summary(seen)
    found["circles"] = draw_circles(None if source.residuals is None else source.residuals.circles)
    if source.identified is not None:
        found["curves"] = [
            draw_curve(name, source.identified, source.fitted, tables)
            for name in CURVE_NAMES
            if name in source.identified.curves
        ]
        found["squareness"] = draw_squareness(source.identified)
    if source.residuals is not None:
        found["measurement"] = draw_residuals(source.residuals)
    found["stations"] = draw_stations(source.identify.get("stations", []), source.residuals)
    found["next"] = draw_proposed(data["next"]["measurements"])
    known: dict[bytes, str] = {}
    for k, item in enumerate(source.controls):
        grid = grid_of(item.volume, uncertainty_um(item.result))
        found[f"space-{k}"] = [draw_space(grid, k)] if grid is not None else []
        found[f"slices-{k}"] = draw_slices(grid, k, known) if grid is not None else []
        found[f"tables-{k}"] = draw_tables(item.name, k, tables[item.name])
    return found


# The report in a few lines for the terminal.


STYLES = {"accepted": "bold green", "rejected": "bold red", "neutral": "bold"}


def short_text(data: Mapping[str, Any]) -> Group:
    """Return verdict, one line per control, the largest error that remains, and where to find more."""
    verdict = data["verdict"]
    lines = [Text(f"{data['title']}: {verdict['headline']}", STYLES.get(verdict["state"], "bold yellow"))]
    if verdict["text"]:
        lines.append(Text(verdict["text"]))
    for item in data["controls"]:
        before, after = item["before"], item["after"]
        what = "" if item["volumetric"] else "measured errors alone "
        figures = f"{what}{um(before.get('max_um'))} -> {um(after.get('max_um'))} um max, "
        figures += f"{um(before.get('rms_um'))} -> {um(after.get('rms_um'))} um rms"
        lines.append(Text(f"  {item['name']}: {item['verdict'].lower()}; {figures}"))
        lines += [Text(f"    {text}", "yellow") for text in item["objections"] if text not in item["reasons"]]
        if item["uncorrected"]:
            largest = item["uncorrected"][0]
            lines.append(Text(f"    remains: {largest['error']} {um(largest['um'])} um; {largest['why']}"))
        lines += [Text(f"    {reason}", "red") for reason in item["reasons"][:3]]
    return Group(*lines)
