"""``export``, ``verify`` and ``read`` for the outputs of a model of heat."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from compgen.cli.terminal import answer, complain, say_paths
from compgen.controls.heat_outputs import ABOUT, from_folder, output_of
from compgen.data.csv_files import format_csv
from compgen.data.files import REJECTED_PREFIX, OutputFolder, sha256_of_file, write_file
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError, visible
from compgen.heat import HeatModel, read_heat, read_temperatures
from compgen.heat.sessions import check_machine
from compgen.tables.heat_outputs import HeatExport, export_heat, judged_output


def _model(machine: Machine, path: Path, controller: str) -> HeatModel:
    """The model of heat of a machine; InputError for another file, or another machine."""
    if path.suffix != ".toml":
        raise InputError(
            f"{controller} takes a model of heat, NAME.heat.toml of volcomp heat, in place of errors", file=path
        )
    model = read_heat(path)
    if model.machine != machine.name:
        raise InputError(f"is the model of heat of {visible(model.machine)}, not of {machine.name}", file=path)
    return model


def export_output(machine: Machine, model_file: Path, controller: str, out: Path, as_json: bool) -> int:
    """Write the output of a model of heat, read back, emulated and judged."""
    output = output_of(machine, controller)
    model = _model(machine, model_file, controller)
    result = export_heat(output, model)
    folder = OutputFolder(out)
    prefix = REJECTED_PREFIX if result.reasons else ""
    for name, text in result.files.items():
        folder.add((prefix if name in output.read_files else "") + name, text)
    summary = {"machine": machine.name, **result.summary()}
    folder.add("result.json", json.dumps(summary, indent=2) + "\n")
    inputs = {model_file.name: sha256_of_file(model_file)}
    files = [{"name": name, "sha256": digest} for name, digest in summary["files"].items()]
    folder.add(
        "manifest.json", json.dumps({"controller": controller, "files": files, "inputs": inputs}, indent=2) + "\n"
    )
    folder.add("preflight.md", preflight(machine, model, result))
    paths = folder.commit()
    for text in result.reasons:
        complain(f"not acceptable: {text}", "red")
    answer(as_json, {**summary, "paths": [str(path) for path in paths or ()]}, *_lines(result))
    if not as_json:
        say_paths([out / ((prefix if name in output.read_files else "") + name) for name in result.files])
        say_paths([out / "preflight.md"])
    return 1 if result.reasons else 0


def _lines(result: HeatExport) -> list[str]:
    """What the files leave, in sentences."""
    found = [
        f"{axis}: growth {result.before[axis][0]:.2f} -> {result.after[axis][0]:.2f} um rms over the "
        f"temperatures that were trained, "
        f"largest {result.before[axis][1]:.2f} -> {result.after[axis][1]:.2f} um"
        for axis in result.output_axes
    ]
    found += [f"{axis}: not expressed by this control" for axis in result.not_expressed]
    if result.output.fades:
        found.append(f"far outside of them the offset is {result.beyond_um:.2f} um")
    else:
        found.append("outside of them it goes on: this control cannot fall silent")
    return found


def preflight(machine: Machine, model: HeatModel, result: HeatExport) -> str:
    """What to know and to do before the output is used."""
    trained = [
        f"| {item.text} | {item.low:.2f} | {item.high:.2f} | {'K' if item.minus else 'degC'} |" for item in model.hull
    ]
    judged = [
        f"- {name}: sessions left out {before:.2f} -> {after:.2f} {'urad' if name.startswith('e') else 'um'} rms."
        for name, (before, after) in model.rms.items()
    ]
    tilts = ["- Tilts (ea, eb) are in no output."] if any(name.startswith("e") for name in model.rms) else []
    lines = [
        f"# {ABOUT[result.output.name]['title']}",
        "",
        f"Machine {visible(machine.name)}. Offsets are added to the commands: minus what heat has moved the "
        f"tool since the first readings.",
        "",
        *judged,
        *tilts,
        *(f"- {text}." for text in _lines(result)),
        "",
        "## What is known about signs and meaning",
        "",
        *(f"- {how}: {text}." for how, text in result.output.stated()),
        "",
        "## Before use",
        "",
        *(f"{k}. {text}" for k, text in enumerate(result.output.before_use(model), start=1)),
        "",
        "## Trained temperatures",
        "",
        "| sensor or difference | from | to | unit |",
        "|---|---|---|---|",
        *trained,
        "",
    ]
    return "\n".join(lines)


def verify_output(
    machine: Machine, tables: Sequence[Path], controller: str, model_file: Path, out: Path, as_json: bool
) -> int:
    """Judge the files of an output against a model of heat."""
    output = output_of(machine, controller)
    result = judged_output(output, _model(machine, model_file, controller), from_folder(output, tables))
    folder = OutputFolder(out)
    summary = {"machine": machine.name, **result.summary()}
    folder.add("result.json", json.dumps(summary, indent=2) + "\n")
    folder.commit()
    for text in result.reasons:
        complain(f"not acceptable: {text}", "red")
    answer(as_json, summary, *_lines(result))
    return 1 if result.reasons else 0


def read_output(
    machine: Machine, tables: Sequence[Path], controller: str, temperatures: Path, out: Path, as_json: bool
) -> int:
    """Write what the control adds to the commands over a file of temperatures."""
    output = output_of(machine, controller)
    parsed = output.parse(from_folder(output, tables))
    read = read_temperatures(temperatures)
    check_machine(read.machine, machine.name, temperatures)
    added = parsed.added(read) / MM_PER_UM
    columns = {"time_s": read.time_s, **{f"c{axis}_um": added[:, k] for k, axis in enumerate("xyz")}}
    digits = {"time_s": 3, **dict.fromkeys(("cx_um", "cy_um", "cz_um"), 4)}
    write_file(out, format_csv(columns, {"machine": machine.name, "controller": controller}, digits))
    largest = {f"c{axis}_um": float(np.abs(added[:, k]).max()) for k, axis in enumerate("xyz")}
    data: dict[str, Any] = {"points": len(read), "controller": controller, "max_um": largest, "file": str(out)}
    said = ", ".join(f"{name} up to {value:.2f}" for name, value in largest.items())
    answer(as_json, data, f"{len(read)} readings: {said} -> {out}")
    return 0
