"""The rotary axes in a report: their errors with uncertainty and names, and what the readings do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from compgen.data.names import COVERAGE
from compgen.data.rotary import axis_line_name, describe_rotary_error, unit_of
from compgen.errors import um_text

#: Kinds of ``identify.json`` that contain errors of rotary axes: from readings at poses, from runs of an axis alone.
AT_POSES, FROM_RUNS = "sphere", "rotary-axis"


def of_rotary_axes(identify: Mapping[str, Any]) -> bool:
    """Whether ``identify.json`` contains errors of rotary axes."""
    return identify.get("kind") in (AT_POSES, FROM_RUNS)


def rotary_section(identify: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a report says of the rotary axes, from ``identify.json``; empty without them.

    ``errors`` has a row for each constant, in the form of the errors of linear axes with ``determined`` and what was assumed
    before; ``motions`` one for each error motion over the angle (``position_deg``). Values in um and urad.
    """
    if not of_rotary_axes(identify):
        return {}
    runs = identify if identify["kind"] == FROM_RUNS else identify.get("rotary_axis", {})
    constants = identify.get("errors", {}) if identify["kind"] == AT_POSES else {}
    motions = {**identify.get("motions", {}), **_of_runs(runs)}
    chain = str(identify.get("chain", ""))
    return {
        "title": _title(identify, motions),
        "errors": [_constant(name, own, chain) for name, own in constants.items()],
        "motions": [_motion(name, own) for name, own in motions.items()],
        "not_told_apart": [
            {"errors": str(item["errors"]), "separated_by": str(item["separated_by"])}
            for item in identify.get("inseparable", [])
        ],
        "motions_not_told_apart": [str(name) for name in identify.get("motions_not_told_apart", [])],
        "fit": _fit(identify),
        "figures_arcsec": [
            {"axis": letter, "figure": name.replace("_", " "), "value": value}
            for letter, own in runs.get("figures_arcsec", {}).items()
            for name, value in own.items()
        ],
        "notes": [str(text) for text in dict.fromkeys([*identify.get("notes", []), *runs.get("notes", [])])],
    }


def _title(identify: Mapping[str, Any], motions: Mapping[str, Any]) -> str:
    """How much was determined, in one sentence."""
    if identify["kind"] == FROM_RUNS:
        return f"Positioning of {', '.join(name[-1] for name in motions)} from runs."
    known = sum(bool(own["determined"]) for own in identify["errors"].values())
    return (
        f"{known} of {identify['position_errors']} position errors from {identify['poses']} poses; "
        f"{identify['determined_combinations']} combinations determined."
    )


def _of_runs(runs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Curves of runs in the form of error motions."""
    return {
        name: {"position_deg": own["position_deg"], "value": own["value_urad"], "u": own["u_urad"], "unit": "urad"}
        for name, own in runs.get("curves", {}).items()
    }


def _constant(name: str, own: Mapping[str, Any], chain: str) -> dict[str, Any]:
    """A row for a constant; ``axis_line`` is where the line lies or how it leans, None if the chain is not known."""
    other = axis_line_name(name)
    before_bed = chain.partition("F")[0]
    sign = -1.0 if name[-1] in before_bed else 1.0
    return {
        "error": name,
        "axis_name": other,
        "meaning": describe_rotary_error(name),
        "unit": unit_of(name),
        "in_part": not own["determined"],
        "determined": bool(own["determined"]),
        "assumed": own["assumed"],
        "largest": own["value"],
        "axis_line": sign * own["value"] if other and chain else None,
        "at_mm": None,
        "u_k1": own["u"],
        "U": COVERAGE * own["u"],
        "position_mm": [],
        "value": [own["value"]],
        "u": [own["u"]],
    }


def _motion(name: str, own: Mapping[str, Any]) -> dict[str, Any]:
    """A row for an error motion over the angle."""
    value: Sequence[float] = own["value"]
    k = max(range(len(value)), key=lambda n: abs(value[n]))
    return {
        "error": name,
        "meaning": describe_rotary_error(name),
        "unit": unit_of(name),
        "largest": value[k],
        "at_deg": own["position_deg"][k],
        "U": COVERAGE * max(own["u"]),
        "position_deg": list(own["position_deg"]),
        "value": list(value),
        "u": list(own["u"]),
    }


def _fit(identify: Mapping[str, Any]) -> list[str]:
    """What the errors leave of the readings, in sentences; empty for runs alone."""
    if identify["kind"] != AT_POSES:
        return []
    figures, (without, left_out) = identify["residual_um"], identify["left_out_rms_um"]
    before, after = um_text(figures["before_rms"]), um_text(figures["after_rms"])
    most, least = um_text(figures["before_max"]), um_text(figures["after_max"])
    found = [
        f"Reading minus model: {before} µm rms ({most} µm at most) before, {after} µm ({least} µm) with the errors."
    ]
    if left_out is not None:
        found.append(
            f"Poses that were left out of the fit: {um_text(without)} µm rms before, {um_text(left_out)} µm after."
        )
    source = "from the residuals" if identify["u_from_residuals"] else "as stated"
    return [*found, f"Standard uncertainty of a reading: {um_text(identify['u_um'])} µm, {source}."]


def rotary_result(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return what ``result.json`` says of parameters or tables of rotary axes; empty for tables of linear axes."""
    if "numbers" not in result and "angle_arcsec" not in result:
        return {}
    before, after, u = result["before"], result["after"], result.get("after_u_um")
    known = "" if u is None else f" (u {um_text(u)} µm rms)"
    rms, left = um_text(before["rms_um"]), um_text(after["rms_um"])
    most, least = um_text(before["max_um"]), um_text(after["max_um"])
    lines = [
        f"Tool tip over the travel, all angles and tools of 0 to 200 mm, with the part set up: {rms} to {left} µm rms, largest "
        f"{most} to {least} µm{known}.",
        f"Tool axis against what the control knows: {before['rms_urad']:.1f} to {after['rms_urad']:.1f} µrad rms.",
        *_angles(result.get("angle_arcsec", {})),
    ]
    if result.get("not_expressed"):
        lines.append(f"Not expressed by this control: {', '.join(map(str, result['not_expressed']))}.")
    nominal, spread = result.get("nominal", {}), result.get("u", {})
    return {
        "lines": lines,
        "numbers": [
            {
                "name": str(name),
                "nominal": nominal.get(name),
                "value": value,
                "U": COVERAGE * spread[name] if name in spread else None,
            }
            for name, value in result.get("numbers", {}).items()
        ],
    }


def _angles(found: Mapping[str, Any]) -> list[str]:
    """The angle of each axis before and after its table, in sentences."""
    return [
        f"Angle of {letter}: {own['before_rms']:.2f} to {own['after_rms']:.2f} arcsec rms, largest {own['before_max']:.2f} to "
        f"{own['after_max']:.2f} arcsec; standard uncertainty of the measured error {own['u_after']:.2f} arcsec."
        for letter, own in found.items()
    ]
