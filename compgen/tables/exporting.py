"""Errors to controller files: table values, text, manifest, and what becomes of the files of an earlier export."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from compgen import effects
from compgen.controls import CONTROLLERS, AnyController, SourceFile, controller_named
from compgen.data.arguments import of_kind, text_of
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves, format_errors, format_reversal, reversal_name
from compgen.data.files import REJECTED_PREFIX, OutputFolder, Provenance, sha256_of
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.drawing.display import Displayed, Overview, shortened
from compgen.errors import CompgenWarning, InputError
from compgen.kinematics.kernel_switch import one_thread
from compgen.resources import LANGUAGES, program_version
from compgen.tables.render import Format, companion_files, errors_context, load_format, render, render_files
from compgen.tables.synthesis import Projector, best_values, projector

# What an earlier export left in a folder: kept as ``PREVIOUS-...``, so that no old table is taken for one of the new.


MANIFEST = "manifest.json"
#: Files that belong to the tables that a manifest names.
COMPANY = (
    MANIFEST,
    "preflight.md",
    "result.json",
    "volume.csv",
    "explain.md",
    "check/check-program.md",
    "check/check-program.nc",
)
#: Files of a report (``dcc.xml`` is made on request); they say something about all tables of a folder.
REPORT_FILES = ("report.html", "report.json", "dossier.md", "dossier.json", "calibration.json")


def set_aside_superseded(output: OutputFolder, targets: Sequence[str] = ("",)) -> list[Path]:
    """Set aside the files of earlier exports that the new ones in ``output`` replace or contradict.

    These are tables that an earlier manifest names and that are not written now (another control, another verdict) with
    what belongs to them; tables that are no longer as their manifest says (somebody edited them); and the report. Tables
    that no manifest names stay where they are, and a warning names them.

    Parameters
    ----------
    output : holds all new files.
    targets : the sub-folders that get tables; ``""`` is the folder itself.

    Returns
    -------
    list of Path
        where the report of the earlier tables is kept.
    """
    if not output.folder.is_dir():
        return []
    names = {spec.name for control in CONTROLLERS for spec in load_format(control).files}
    new = {PurePosixPath(name): content for name, content in output.contents.items()}
    others: list[str] = []  # sub-folders with tables that an earlier run wrote for controls that this run leaves out
    if "identify.json" in output.contents:
        found = (path.parent for path in sorted(output.folder.glob(f"*/{MANIFEST}")))
        # a sub-folder with an identification of its own is not part of a run in the folder above
        others = [path.name for path in found if path.name not in targets and not (path / "identify.json").exists()]
    for target in dict.fromkeys(["", *targets, *others]):
        base = PurePosixPath(target)
        in_folder = {str(path.relative_to(base)): text for path, text in new.items() if path.is_relative_to(base)}
        if (output.folder / base).is_dir():
            _set_aside_in(output, base, in_folder, names)
    report = [
        name for name in (*REPORT_FILES, "dcc.xml") if (output.folder / name).is_file() and name not in output.contents
    ]
    return [output.set_aside(name) for name in report]


def _set_aside_in(output: OutputFolder, base: PurePosixPath, new: Mapping[str, bytes], names: Set[str]) -> None:
    """Sort the tables in one folder, where ``new`` are the files that it gets; ``names`` are those of all controls' tables."""
    folder = output.folder / base
    try:  # SHA-256 of every table by name, as the manifest in the folder has it
        manifest = json.loads((folder / MANIFEST).read_bytes())
        prefix = str(manifest.get("file_prefix", ""))
        items = [*manifest["files"], *manifest.get("companions", ())]
        hashes = {prefix + str(item["name"]): str(item["sha256"]) for item in items}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        hashes = {}
    known = {name: digest for name, digest in hashes.items() if PurePosixPath(name).name == name}
    tables = {*known, *names, *(REJECTED_PREFIX + name for name in names)}
    kept, strangers = [], []
    for path in sorted(path for path in folder.iterdir() if path.name in tables and path.is_file()):
        name, content = path.name, path.read_bytes()
        untouched = known.get(name) == sha256_of(content)
        if new.get(name) == content or (name in new and untouched):
            continue
        if name in new or name in known or _twin(name) in new:
            target = output.set_aside(str(base / name))
            if not untouched or _twin(name) not in new:
                changed = "changed after the export" if not untouched else "of an earlier export"
                kept.append(f"{name} ({changed}) as {target.name}")
        else:
            strangers.append(name)
    for name in COMPANY if known else ():
        if name not in new and (folder / name).is_file():
            output.set_aside(str(base / name))
    if kept:
        warnings.warn(f"{folder}: kept {', '.join(kept)}", CompgenWarning, stacklevel=4)
    if strangers:
        text = f"{folder}: {', '.join(strangers)} are tables that this export did not write; do not load them with it"
        warnings.warn(text, CompgenWarning, stacklevel=4)


def _twin(name: str) -> str:
    """The name of the same table with the other verdict."""
    return name.removeprefix(REJECTED_PREFIX) if name.startswith(REJECTED_PREFIX) else REJECTED_PREFIX + name


# Errors to controller files: settings, basis, best table values, text, manifest and preflight list.


@dataclass(frozen=True, repr=False)
class Export(Displayed):
    """What :func:`export` made, still in memory.

    Parameters
    ----------
    controller : name of the control.
    files : text of each controller file by name.
    manifest : contents of ``manifest.json``: hashes, version, inputs, settings, sign statement.
    preflight : text of ``preflight.md``.
    violations : limits of the control that the tables break; not empty means not acceptable.
    warnings : what the user should know.
    companions : text of files that the user's own templates add to those of the control; never read back.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> exported: compgen.Export = compgen.export(machine, errors, "siemens-eec")
    >>> exported
    <Export: siemens-eec: AX_EEC.INI>
    >>> exported.preflight.splitlines()[0].startswith("# Preflight")
    True
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

    def overview(self) -> Overview:
        """The files and their size, and what speaks against them."""
        rows = tuple((name, str(len(text.encode()))) for name, text in self.files.items())
        title = f"{self.controller}: {shortened(tuple(self.files))}"
        return Overview(title, ("file", "bytes"), rows, (*self.violations, *self.warnings))


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
    language: str = LANGUAGES[0],
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
    language : of the preflight list, ``"en"`` or ``"de"``; files for the control and the manifest stay in English.

    Raises
    ------
    InputError
        for settings that are missing or wrong, and for an unverified format that was not allowed.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> exported = compgen.export(machine, errors, "isg-csv")
    >>> sorted(exported.files)
    ['volcomp0.csv', 'volcomp0.lis']
    """
    of_kind("machine", machine, Machine)
    of_kind("errors", errors, ErrorTable)
    text_of("controller", controller)
    control = controller_named(controller)(machine)
    card = usable_format(controller, templates, allow_unverified=allow_unverified)
    basis = control.basis(errors)
    with one_thread():
        solver = projector(machine, basis, anchored=control.anchored)
        tables = control.build(basis, table_values(control, machine, errors, solver))
    rest = reversal
    if reversal is not None:
        in_tables = control.reversal_in_tables(reversal)
        rest = reversal.without(in_tables)
        tables = control.with_reversal(tables, in_tables) if in_tables.curves else tables
    own = _with_backlash(control, control.context(tables), rest)
    said = [*control.reservations(tables), *control.left_out(errors)]
    said += [*machine.emphasis.notes, *(effects.advice_of_effects(machine) if machine.effects else [])]
    if machine.machine_units == "inch" and not hasattr(control.settings, "machine_units"):
        said.append(
            'the machine file states machine_units = "inch"; this control reads its tables in the units of its own keys'
        )
    own = {**own, "warnings": [*own["warnings"], *said]}
    common = export_context(machine, errors, controller, provenance or Provenance(), reversal)
    files = render_files(card, {**common, **own}, templates)
    with_errors = {**common, **own, "errors21": errors_context(machine, errors)}
    companions = companion_files(card, with_errors, files, templates)
    unread = [
        f"{name} comes from your own template: it is not read back, and nothing in it is verified"
        for name in companions
    ]
    own = {**own, "warnings": [*own["warnings"], *unread]}
    described = _described(files)
    violations = control.violations(tables)
    preflight = render(card, "preflight.md.j2", {**common, **own, "files": described}, templates, language)
    copy = machine.file if machine.file and machine.file.is_file() else None
    manifest = {
        "program": f"compgen {common['version']}",
        "controller": controller,
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
            "sha256": sha256_of(copy.read_bytes()) if copy else None,
        },
        "inputs": [{"name": name, "sha256": digest} for name, digest in common["input_hashes"].items()],
        "errors_sha256": common["errors_sha256"],
        "settings": dict(machine.controller_settings(controller).data),
        "sign_statement": own["sign_statement"],
        "parameters": own["parameters"],
        "warnings": own["warnings"],
        "files": described,
        "violations": violations,
    }
    if companions:
        manifest["companions"] = _described(companions)
    return Export(controller, files, manifest, preflight, violations, own["warnings"], companions)


def with_known(exported: Export, lines: Sequence[str], language: str = LANGUAGES[0]) -> Export:
    """Return the export whose preflight list says what is known of the machine, before its first step."""
    heading = "What is known of the machine"
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        heading, *lines = [texts_of(language).text(line) for line in (heading, *lines)]
    section = f"## {heading}\n\n" + "".join(f"- {line}\n" for line in lines) + "\n"
    before, step, after = exported.preflight.partition("\n## 1.")
    text = f"{before}\n{section}{step.lstrip()}{after}" if step else f"{before.rstrip()}\n\n{section}"
    return replace(exported, preflight=text)


def table_values(
    control: AnyController,
    machine: Machine,
    errors: ErrorTable,
    solver: Projector,
    plain: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Return the best values of a control's tables by term, before rounding.

    ``plain`` may give what :func:`compgen.tables.synthesis.best_values` says of the solver alone, if it is known.
    """

    def applied(values: Mapping[str, FloatArray], points: Points) -> FloatArray:
        return control.emulate(control.build(solver.basis, values), points)

    how = applied if control.finite_rotations else None
    if plain is None or how is not None or control.at_axes:
        plain = best_values(machine, errors, solver, at_axes=control.at_axes, applied=how)
    return solver.by_name(plain)


def _described(files: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "sha256": sha256_of(text.encode("ascii", "replace"))} for name, text in files.items()]


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
    control = controller_named(controller)(machine)
    tables = control.parse([SourceFile(Path(name), text) for name, text in files.items()])
    context = {**common, **control.context(tables)}
    return render_files(load_format(controller, templates), context, templates)


def _with_backlash(control: AnyController, own: dict[str, Any], reversal: ReversalCurves | None) -> dict[str, Any]:
    """Add the backlash parameters for a reversal that no table of one direction holds, and what they cannot hold."""
    if reversal is None or not reversal.curves:
        return own
    parameters = control.backlash_parameters(reversal)
    left = {
        reversal_name(*key): value
        for key, value in reversal.largest_mm.items()
        if abs(value) >= WORTH_MM and (key[0] != key[1] or not parameters)
    }
    warnings = [
        f"{name} is {value / MM_PER_UM:+.1f} um (reached in positive minus in negative direction); these tables act in both "
        f"directions in the same way and do not contain it"
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
    """Return what every file and list says besides the tables: machine, version, inputs and their hashes."""
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
