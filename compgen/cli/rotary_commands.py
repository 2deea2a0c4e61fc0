"""``export``, ``verify``, ``read`` and ``run`` for parameters of rotary axes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from compgen.cli.terminal import answer, complain, say, say_paths
from compgen.controls.rotary_parameters import believed, lines_of, target_of
from compgen.controls.rotary_pitch import ABOUT, PitchFormat, format_of
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.files import REJECTED_PREFIX, OutputFolder, read_text, write_file
from compgen.data.machine import Machine
from compgen.data.names import COVERAGE, MM_PER_UM
from compgen.data.rotary import RotaryErrors, format_poses, read_machine_errors, read_poses
from compgen.errors import InputError
from compgen.identification.rotary_covariance import constant_covariance
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose
from compgen.pipeline import provenance_of
from compgen.tables.rotary_parameters import RotaryExport, export_rotary, judged
from compgen.tables.rotary_pitch import PitchExport, export_pitch, judged_pitch


def export_parameters(machine: Machine, errors: Path, controller: str, out: Path, as_json: bool) -> int:
    """Write the parameters of a control for errors of rotary axes, read back, emulated and judged."""
    target = target_of(machine, controller)
    _, rotary = read_machine_errors(errors)
    result = export_rotary(machine, target, _some(rotary, errors), constant_covariance(errors, rotary))
    output = OutputFolder(out)
    prefix = REJECTED_PREFIX if result.reasons else ""
    output.add(prefix + target.file, result.text)
    summary = {"machine": machine.name, **result.summary()}
    output.add("result.json", json.dumps(summary, indent=2) + "\n")
    inputs = dict(provenance_of(machine.source, errors).inputs)
    files = [{"name": prefix + target.file, "sha256": summary["files"][target.file]}]
    output.add(
        "manifest.json", json.dumps({"controller": controller, "files": files, "inputs": inputs}, indent=2) + "\n"
    )
    output.add("preflight.md", preflight(machine, result))
    paths = output.commit()
    for text in result.reasons:
        complain(f"not acceptable: {text}", "red")
    answer(as_json, {**summary, "paths": [str(path) for path in paths or ()]}, parameters_table(result))
    if not as_json:
        say_paths([out / name for name in (prefix + target.file, "result.json", "manifest.json", "preflight.md")])
    return 1 if result.reasons else 0


def _some(rotary: RotaryErrors, path: Path) -> RotaryErrors:
    if not rotary.names:
        raise InputError("contains no errors of rotary axes; identify them from *.sphere.csv files first", file=path)
    return rotary


def parameters_table(result: RotaryExport) -> Table:
    """The numbers, with their uncertainty, and what they leave."""
    before, after = result.before, result.after
    table = Table(
        "parameter",
        "without errors",
        "exported",
        "U (k = 2)",
        box=box.SIMPLE,
        title=result.target.title,
        title_justify="left",
    )
    for name, value in result.numbers.items():
        u = result.u.get(name)
        digits = 6 if name in result.target.unitless else 4
        shown = "" if u is None else f"{COVERAGE * u:.{digits}f}"
        table.add_row(name, f"{result.nominal[name]:.{digits}f}", f"{value:.{digits}f}", shown)
    table.caption = "\n".join(
        [
            f"tip over all poses, part set up: rms {before.rms_um:.2f} -> {after.rms_um:.2f} um, largest {before.max_um:.2f} -> "
            f"{after.max_um:.2f} um" + ("" if result.after_u_um is None else f" (u {result.after_u_um:.2f} um rms)"),
            f"tool axis against what the control knows: rms {before.rms_urad:.1f} -> {after.rms_urad:.1f} urad",
            *([f"not expressed: {', '.join(result.not_expressed)}"] if result.not_expressed else []),
        ]
    )
    table.caption_justify = "left"
    return table


def preflight(machine: Machine, result: RotaryExport) -> str:
    """What to check before the parameters are used."""
    target, before, after = result.target, result.before, result.after
    rows = [f"| `{name}` | {result.nominal[name]:.6f} | {value:.6f} |" for name, value in result.numbers.items()]
    turned = [
        f"{letter} of the control is minus {letter} of the machine file" for letter, s in target.sense.items() if s < 0
    ]
    zeros = [
        f"- {letter}: the zero is off by {value / 1e-6:+.1f} urad (`E{letter}0{letter}`): every command of {letter} should be "
        f"{-value * 57.29577951308232 * target.sense.get(letter, 1.0):+.6f} degrees more, by the reference position of the axis"
        for letter in machine.rotary
        if (value := result.zeros.get(letter, 0.0))
    ]
    return "\n".join(
        [
            f"# {target.title}",
            "",
            f"Machine {machine.name}, chain {machine.chain.name}. Lengths in {machine.units}.",
            "",
            "| number | without errors | exported (mm) |",
            "|---|---|---|",
            *rows,
            "",
            f"Over the travel, all angles and tools of 0 to 200 mm, with the part set up: tip rms {before.rms_um:.2f} -> "
            f"{after.rms_um:.2f} um, largest {before.max_um:.2f} -> {after.max_um:.2f} um; tool axis rms "
            f"{before.rms_urad:.1f} -> {after.rms_urad:.1f} urad.",
            "",
            "## What is known about signs",
            "",
            *(f"- {how}: {text}" for how, text in target.stated),
            "",
            "## Before use",
            "",
            "- Write down the numbers that are on the control now. Those without errors are what it should hold if it was set up "
            "from the machine file; if it holds others, find out why before you change them.",
            *(f"- {text}." for text in turned),
            *zeros,
            "- Two probed poses show the sense of each axis: `volcomp check MACHINE --spheres FILE` names an axis that turns the "
            "other way round than the machine file says.",
            "- Probe a sphere at four poses of the rotary axes again: it must stay where it is.",
            *(f"- Not expressed by this control: {name}." for name in result.not_expressed),
            "",
        ]
    )


def pitch_format(machine: Machine, controller: str, allow_unverified: bool) -> PitchFormat:
    """The format of a table over the angle; InputError if no document describes it and that was not allowed."""
    form = format_of(machine, controller)
    if ABOUT[controller]["evidence"] == "unverified" and not allow_unverified:
        raise InputError(
            f"the format {controller!r} is unverified ({' '.join(form.instructions(()))}) "
            "Add --allow-unverified if you accept that"
        )
    return form


def export_tables(
    machine: Machine, errors: Path, controller: str, out: Path, as_json: bool, allow_unverified: bool
) -> int:
    """Write the positioning tables of rotary axes, read back, emulated and judged."""
    form = pitch_format(machine, controller, allow_unverified)
    result = export_pitch(form, read_machine_errors(errors)[1])
    prefix = REJECTED_PREFIX if result.reasons else ""
    output = OutputFolder(out)
    for name, text in result.files.items():
        output.add(prefix + name, text)
    summary = {"machine": machine.name, **result.summary()}
    output.add("result.json", json.dumps(summary, indent=2) + "\n")
    files = [{"name": prefix + name, "sha256": digest} for name, digest in summary["files"].items()]
    inputs = dict(provenance_of(machine.source, errors).inputs)
    output.add(
        "manifest.json", json.dumps({"controller": controller, "files": files, "inputs": inputs}, indent=2) + "\n"
    )
    rows = [f"# {form.title}", "", f"Machine {machine.name}. Angles in degrees.", "", *_said(result), ""]
    turned = [
        f"- {letter} of the control is minus {letter} of the machine file." for letter in form.settings.reversed_axes
    ]
    output.add(
        "preflight.md",
        "\n".join([*rows, *(f"- {text}" for text in result.instructions), *turned, ""]),
    )
    paths = output.commit()
    for text in result.reasons:
        complain(f"not acceptable: {text}", "red")
    answer(as_json, {**summary, "paths": [str(path) for path in paths or ()]}, *_said(result))
    if not as_json:
        say_paths(out / name for name in (*(prefix + name for name in result.files), "result.json", "preflight.md"))
    return 1 if result.reasons else 0


def _said(result: PitchExport) -> list[str]:
    """What the tables leave, in sentences."""
    lines = [
        f"{letter}: error of the angle {own['before_rms']:.2f} -> {own['after_rms']:.2f} arcsec rms, "
        f"largest {own['before_max']:.2f} -> {own['after_max']:.2f} arcsec; "
        f"standard uncertainty of the measured error {own['u_after']:.2f} arcsec, between its angles unknown"
        + (
            f"; reversal {own['reversal_before']:+.2f} -> {own['reversal_after']:+.2f} arcsec"
            if "reversal_before" in own
            else ""
        )
        for letter, own in result.angle_arcsec.items()
    ]
    before, after = result.before, result.after
    return [
        *lines,
        *result.backlash,
        f"over travel, angles and tools of 0 to 200 mm, part set up: tip rms {before.rms_um:.2f} -> {after.rms_um:.2f} um, "
        f"tool axis rms {before.rms_urad:.1f} -> {after.rms_urad:.1f} urad",
    ]


def pitch_contents(form: PitchFormat, tables: Sequence[Path]) -> dict[Path, str]:
    """Text of the files that can be tables of this control: those given, and those in folders that are given."""
    paths = [file for path in tables for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    chosen = [path for path in paths if path.suffix.lower() in form.endings]
    if not chosen:
        raise InputError(f"has no file {' or '.join('*' + ending for ending in form.endings)}", file=tables[0])
    return {path: read_text(path) for path in chosen}


def read_pitch(
    machine: Machine, tables: Sequence[Path], controller: str, points: Path, out: Path, as_json: bool
) -> int:
    """What the control adds to the commands of the rotary axes at poses, by direction of travel where it matters."""
    form = format_of(machine, controller)
    found, poses = form.parse(pitch_contents(form, tables)), read_poses(machine, points)
    columns: dict[str, FloatArray] = {}
    for letter, table in found.items():
        for way, name in ((1, ""), (-1, "_negative")):
            if way > 0 or table.negative_deg is not None:
                columns[f"c{letter.lower()}{name}_arcsec"] = 3600.0 * table.emulated(poses.angle_deg[letter], way)
    write_file(out, format_poses(poses, columns, {"machine": machine.name, "controller": controller}))
    largest = {name: float(np.abs(values).max(initial=0.0)) for name, values in columns.items()}
    faults = [text for table in found.values() for text in table.faults]
    data = {"points": len(poses.position_mm), "controller": controller, "max_arcsec": largest, "file": str(out)}
    for text in faults:
        complain(f"warning: {text}")
    said = ", ".join(f"{name} up to {value:.2f}" for name, value in largest.items())
    answer(as_json, {**data, "remarks": faults}, f"{data['points']} poses: {said} -> {out}")
    return 0


def verify_tables(
    machine: Machine, tables: Sequence[Path], controller: str, errors: Path, out: Path, as_json: bool
) -> int:
    """Judge positioning tables of rotary axes against the errors."""
    form = format_of(machine, controller)
    result = judged_pitch(form, read_machine_errors(errors)[1], pitch_contents(form, tables))
    output = OutputFolder(out)
    output.add("result.json", json.dumps({"machine": machine.name, **result.summary()}, indent=2) + "\n")
    output.commit()
    for reason in result.reasons:
        complain(f"not acceptable: {reason}", "red")
    answer(as_json, result.summary(), *_said(result))
    return 1 if result.reasons else 0


def verify_parameters(
    machine: Machine, tables: Sequence[Path], controller: str, errors: Path, out: Path, as_json: bool
) -> int:
    """Judge a file of parameters against the errors of the rotary axes."""
    target = target_of(machine, controller)
    path = parameter_file(tables, target.file)
    text = read_text(path)
    _, rotary = read_machine_errors(errors)
    result = judged(machine, target, _some(rotary, errors), target.parse(machine, text, path), text)
    output = OutputFolder(out)
    output.add("result.json", json.dumps({"machine": machine.name, **result.summary()}, indent=2) + "\n")
    output.commit()
    for reason in result.reasons:
        complain(f"not acceptable: {reason}", "red")
    answer(as_json, result.summary(), parameters_table(result))
    return 1 if result.reasons else 0


def parameter_file(tables: Sequence[Path], name: str) -> Path:
    """The file of parameters: given, or in the folder of an export."""
    if len(tables) != 1:
        raise InputError(f"expected one file, {name}, or the folder of the export", file=tables[1])
    path = tables[0]
    if not path.is_dir():
        return path
    found = [path / name, path / f"{REJECTED_PREFIX}{name}"]
    return next((file for file in found if file.is_file()), found[0])


def read_parameters(
    machine: Machine, tables: Sequence[Path], controller: str, points: Path, out: Path, as_json: bool
) -> int:
    """What the control adds to the positions of X, Y, Z at poses, against one with the numbers of the machine file."""
    target = target_of(machine, controller)
    path = parameter_file(tables, target.file)
    numbers = target.parse(machine, read_text(path), path)
    poses = read_poses(machine, points)
    count = len(poses.position_mm)
    tool = np.array(machine.tool_offset_mm if poses.tool_mm is None else poses.tool_mm)
    tool = np.broadcast_to(tool, (count, 3))
    nominal = believed(target, machine, target.numbers(lines_of(machine)))
    tip, _ = tip_pose(nominal, ErrorTable(), RotaryErrors(), poses.position_mm, poses.angle_deg, tool)
    added = joints_of_tip(believed(target, machine, numbers), tip, poses.angle_deg, tool) - poses.position_mm
    columns = {f"c{axis}_um": added[:, k] / MM_PER_UM for k, axis in enumerate("xyz")}
    write_file(out, format_poses(poses, columns, {"machine": machine.name, "controller": controller}))
    largest = float(np.linalg.norm(added, axis=1).max() / MM_PER_UM)
    data: dict[str, Any] = {"points": count, "controller": controller, "max_um": largest, "file": str(out)}
    if as_json:
        answer(True, data)
    else:
        say(f"{count} poses: the control adds up to {largest:.2f} um to X, Y, Z -> {out}")
    return 0
