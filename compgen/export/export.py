"""Errors to controller files: settings, basis, best table values, text, manifest and preflight list."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from compgen.controllers import AnyController, SourceFile, controller_named
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable, format_errors
from compgen.core.files import OutputFolder, sha256_of
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves, format_reversal, reversal_name
from compgen.effects import advice_of_effects
from compgen.errors import InputError
from compgen.export.companions import companion_files, errors_context
from compgen.export.render import Format, load_format, render, render_files
from compgen.export.superseded import MANIFEST, REJECTED_PREFIX, set_aside_superseded
from compgen.export.synthesis import Projector, best_values, projector


def program_version() -> str:
    """Return the version of compgen that runs."""
    try:
        return version("compgen")
    except PackageNotFoundError:
        return "unknown"


@dataclass(frozen=True)
class Export:
    """What :func:`export` made, still in memory.

    Parameters
    ----------
    controller : name of the control.
    files : text of each controller file by name.
    manifest : contents of ``manifest.json``: hashes, version, inputs, settings, sign statement.
    preflight : text of ``preflight.md``.
    violations : limits of the control that the tables break; not empty means not acceptable.
    warnings : what the user should know.
    companions : text of files that the user's own templates make beside those of the control; never read back.
    """

    controller: str
    files: Mapping[str, str]
    manifest: Mapping[str, Any]
    preflight: str
    violations: Sequence[str] = ()
    warnings: Sequence[str] = ()
    companions: Mapping[str, str] = field(default_factory=dict)

    def write(
        self, folder: str | Path, *, accepted: bool | None = None, beside: Mapping[str, str] | None = None
    ) -> list[Path]:
        """Write everything together, with the texts ``beside`` them, and return the paths of the controller files.

        Tables that are not accepted (by default: that break a limit) get ``NOT-ACCEPTED-`` before their name. Tables of
        an earlier export that have no successor of their name, and tables that were edited since, are renamed to
        ``PREVIOUS-...``, see :func:`set_aside_superseded`.
        """
        output = OutputFolder(folder)
        good = not self.violations if accepted is None else accepted
        names = self.add_to(output, accepted=good, beside=beside)
        set_aside_superseded(output)
        paths = output.commit()
        return [paths[name] for name in names]

    def add_to(
        self, output: OutputFolder, sub_folder: str = "", *, accepted: bool, beside: Mapping[str, str] | None = None
    ) -> list[str]:
        """Add all files to ``output``, below ``sub_folder`` if one is given; return the names of the controller files."""
        prefix = "" if accepted else REJECTED_PREFIX
        manifest = {**self.manifest, "accepted": accepted, "file_prefix": prefix}
        files: dict[str, str | bytes] = {
            **{
                prefix + name: text.encode("ascii", "replace")
                for name, text in {**self.files, **self.companions}.items()
            },
            MANIFEST: json.dumps(manifest, indent=2) + "\n",
            "preflight.md": self.preflight,
            **(beside or {}),
        }
        for name, content in files.items():
            output.add(str(PurePosixPath(sub_folder) / name), content)
        return [str(PurePosixPath(sub_folder) / (prefix + name)) for name in self.files]


@dataclass(frozen=True)
class Provenance:
    """Where the errors came from: (name, SHA-256) of every input file, for manifest and file headers."""

    inputs: Sequence[tuple[str, str]] = field(default_factory=tuple)


def usable_format(controller: str, templates: Path | None = None, *, allow_unverified: bool = False) -> Format:
    """Return the card of a control's format; InputError if it is unverified and that was not allowed."""
    card = load_format(controller, templates)
    if card.evidence == "unverified" and not allow_unverified:
        raise InputError(
            f"the format {controller!r} is unverified ({'; '.join(card.unverified)}); "
            "add --allow-unverified if you accept that"
        )
    return card


def export(
    machine: Machine,
    errors: ErrorTable,
    controller: str,
    *,
    templates: Path | None = None,
    allow_unverified: bool = False,
    provenance: Provenance | None = None,
    reversal: ReversalCurves | None = None,
) -> Export:
    """Turn errors into the files of one control; nothing is written yet.

    Parameters
    ----------
    machine : its section ``[controllers.<name>]`` holds what the export needs.
    errors : usually the fitted errors, mm and rad.
    controller : name of the control, e.g. ``"isg-csv"``.
    templates : a folder of the user's own templates, searched before the shipped ones.
    allow_unverified : export formats that no public document fully describes.
    provenance : the input files, for the manifest and the headers.
    reversal : what each axis does differently in its two directions; in tables of one direction where the control has
        them, else as a parameter or a warning in the preflight list.

    Raises
    ------
    InputError
        for settings that are missing or wrong, and for an unverified format that was not allowed.
    """
    control = controller_named(controller)
    settings = control.read_settings(machine)
    card = usable_format(controller, templates, allow_unverified=allow_unverified)
    basis = control.basis(machine, settings, errors)
    solver = projector(machine, basis, anchored=control.anchored)
    tables = control.build(machine, settings, basis, table_values(control, machine, settings, errors, solver))
    rest = reversal
    if reversal is not None:
        held = control.reversal_in_tables(settings, reversal)
        rest = reversal.without(held)
        tables = control.with_reversal(machine, settings, tables, held) if held.curves else tables
    own = _with_backlash(control, machine, settings, control.context(machine, settings, tables), rest)
    said = [*control.reservations(machine, settings, tables), *control.left_out(machine, settings, errors)]
    own = {**own, "warnings": [*own["warnings"], *said, *machine.emphasis.notes]}
    own["warnings"] = [*own["warnings"], *advice_of_effects(machine)]
    common = export_context(machine, errors, controller, provenance or Provenance(), reversal)
    files = render_files(card, {**common, **own}, templates)
    with_errors = {**common, **own, "errors21": errors_context(machine, errors)}
    companions = companion_files(card, with_errors, files, templates)
    own = {**own, "warnings": [*own["warnings"], *_not_read_back(companions)]}
    described = _described(files)
    violations = control.violations(machine, settings, tables)
    preflight = render(card, "preflight.md.j2", {**common, **own, "files": described}, templates)
    manifest = {**_manifest(common, card, own, described, machine), "violations": violations}
    if companions:
        manifest["companions"] = _described(companions)
    return Export(controller, files, manifest, preflight, violations, own["warnings"], companions)


def table_values(
    control: AnyController,
    machine: Machine,
    settings: Any,
    errors: ErrorTable,
    solver: Projector,
    plain: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Return the best values of a control's tables by term, before rounding.

    ``plain`` may give what :func:`compgen.export.synthesis.best_values` says of the solver alone, if it is known.
    """

    def applied(values: Mapping[str, FloatArray], points: Points) -> FloatArray:
        return control.emulate(machine, settings, control.build(machine, settings, solver.basis, values), points)

    how = applied if control.finite_rotations else None
    if plain is None or how is not None or control.at_axes:
        plain = best_values(machine, errors, solver, at_axes=control.at_axes, applied=how)
    return solver.by_name(plain)


def _described(files: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "sha256": sha256_of(text.encode("ascii", "replace"))} for name, text in files.items()]


def _not_read_back(companions: Mapping[str, str]) -> list[str]:
    return [
        f"{name} comes from a template of yours: it is not read back, and nothing in it is verified"
        for name in companions
    ]


def rerender(
    machine: Machine,
    controller: str,
    files: Mapping[str, str],
    common: Mapping[str, Any],
    *,
    templates: Path | None = None,
) -> dict[str, str]:
    """Parse the texts of controller files by name, and render what was read: the same texts, byte for byte.

    ``common`` is what the headers say and no table does, e.g. from :func:`export_context`.
    """
    control = controller_named(controller)
    settings = control.read_settings(machine)
    tables = control.parse(machine, settings, [SourceFile(Path(name), text) for name, text in files.items()])
    context = {**common, **control.context(machine, settings, tables)}
    return render_files(load_format(controller, templates), context, templates)


def _with_backlash(
    control: AnyController, machine: Machine, settings: Any, own: dict[str, Any], reversal: ReversalCurves | None
) -> dict[str, Any]:
    """Add the backlash parameters for a reversal that no table of one direction holds, and what they cannot hold."""
    if reversal is None or not reversal.curves:
        return own
    parameters = control.backlash_parameters(machine, settings, reversal)
    left = {
        reversal_name(*key): value
        for key, value in reversal.largest_mm.items()
        if abs(value) >= WORTH_MM and (key[0] != key[1] or not parameters)
    }
    warnings = [
        f"{name} is {value / MM_PER_UM:+.1f} um (reached in positive minus in negative direction); these tables act in both "
        f"directions alike and do not hold it"
        for name, value in left.items()
    ]
    return {**own, "parameters": [*own["parameters"], *parameters], "warnings": [*own["warnings"], *warnings]}


def export_context(
    machine: Machine,
    errors: ErrorTable,
    controller: str,
    provenance: Provenance,
    reversal: ReversalCurves | None = None,
) -> dict[str, Any]:
    """Return what every file and list says beside the tables: machine, version, inputs and their hashes."""
    text = format_errors(errors)
    inputs = list(provenance.inputs) or [("errors", sha256_of(text.encode()))]
    both = text if reversal is None else text + format_reversal(reversal)
    return {
        "version": program_version(),
        "controller": controller,
        "machine_name": machine.name,
        "chain": machine.chain.name,
        "tool_offset_mm": [f"{value:g}" for value in machine.tool_offset_mm],
        "reference_point_mm": [f"{value:g}" for value in machine.reference_point_mm],
        "inputs": [name for name, _ in inputs],
        "input_sha256": sha256_of(both.encode()),
        "errors_sha256": sha256_of(text.encode()),
        "input_hashes": dict(inputs),
    }


def _manifest(
    common: dict[str, Any], card: Format, own: dict[str, Any], files: list[dict[str, str]], machine: Machine
) -> dict[str, Any]:
    return {
        "program": f"compgen {common['version']}",
        "controller": common["controller"],
        "format": card.title,
        "evidence": card.evidence,
        "unverified": list(card.unverified),
        "machine": {
            "name": machine.name,
            "chain": machine.chain.name,
            "squareness_reference": machine.squareness_reference,
            "tool_offset_mm": list(machine.tool_offset_mm),
            "reference_point_mm": list(machine.reference_point_mm),
            **machine.emphasis.summary(),
            "file": str(machine.source) if machine.source else None,
            "sha256": sha256_of(machine.source.read_bytes()) if machine.source and machine.source.is_file() else None,
        },
        "inputs": [{"name": name, "sha256": digest} for name, digest in common["input_hashes"].items()],
        "errors_sha256": common["errors_sha256"],
        "settings": dict(machine.controller_settings(common["controller"]).data),
        "sign_statement": own["sign_statement"],
        "parameters": own["parameters"],
        "warnings": own["warnings"],
        "files": files,
    }
