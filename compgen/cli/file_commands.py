"""``volcomp init``, ``check`` and ``schema``: write a machine file, look files over, and what an editor needs to know of them."""

from __future__ import annotations

import json
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from compgen import effects
from compgen.cli.common import json_option, shown_units
from compgen.cli.output import print_json
from compgen.cli.shared_options import check_settings
from compgen.cli.terminal import answer, complain, say
from compgen.controls import CONTROLLERS, controller_named, program_instead
from compgen.data import toml_files
from compgen.data.csv_files import whole_number
from compgen.data.files import OutputFolder, name_problem
from compgen.data.machine import (
    ROTARY,
    Chain,
    Emphasis,
    Interval,
    Machine,
    RotaryAxis,
    Vector3,
    load_machine,
    machine_files,
    machine_of,
    parse_machine,
)
from compgen.data.names import AXES
from compgen.data.prior import CLASS_WORDS, USUAL_CLASS, class_named
from compgen.effects.active import effects_schema
from compgen.errors import CompgenWarning, InputError
from compgen.fleet.job import job_of, job_schema
from compgen.instruments.sixdof_instrument import instrument_of, instrument_schema
from compgen.new_machine import chains_of, in_words, machine_text, rotary_directions, usual_nodes
from compgen.simulation.run import Scenario, scenario_of
from compgen.tables import load_format
from compgen.units import typed_mm

# The kinds of TOML files: how each is detected, read, and described.


def read_whole_machine(root: toml_files.Section) -> None:
    """Read a machine file with the settings of all of its controls and effects; query unlikely values."""
    machine = machine_of(root, root.path or Path())
    for controller in machine.controllers:
        check_settings(machine, controller)
    effects.active_effects(machine)
    for doubt in machine.doubts:
        warnings.warn(doubt, CompgenWarning, stacklevel=1)


def machine_schema() -> dict[str, Any]:
    """Return the JSON schema of a machine file with the sections of all controls and effects."""
    declared = {name: getattr(CONTROLLERS[name], "settings_class", None) for name in sorted(CONTROLLERS)}
    sections = {
        name: {"type": "object"} if kind is None else toml_files.section_schema(kind) for name, kind in declared.items()
    }
    schema = toml_files.section_schema(Machine, Emphasis)
    schema["properties"]["controllers"] |= toml_files.table_schema(sections)
    schema["properties"]["effects"] |= effects_schema()
    return schema


def read_whole_job(root: toml_files.Section) -> None:
    """Read a job file; warn of unreadable machine files: only their machines cannot be measured."""
    for name, item in job_of(root, (root.path or Path()).absolute()).machines.items():
        try:
            load_machine(item.machine)
        except InputError as error:
            warnings.warn(f"[machines.{name}] machine: {error}", CompgenWarning, stacklevel=1)


@dataclass(frozen=True)
class FileKind:
    """A kind of TOML file: its description, the keys by which it is detected, its reader, and its JSON schema."""

    title: str
    keys: frozenset[str]
    read: Callable[[toml_files.Section], object]
    schema: Callable[[], dict[str, Any]]


#: A file is of the kind with which it shares the most keys.
KINDS: Mapping[str, FileKind] = {
    "machine": FileKind(
        "Machine file", frozenset({"chain", "axes", "controllers"}), read_whole_machine, machine_schema
    ),
    "job": FileKind(
        "Job file of volcomp recal", frozenset({"machines", "defaults", "store"}), read_whole_job, job_schema
    ),
    "scenario": FileKind(
        "Scenario of a simulated measurement",
        frozenset({"instrument", "seed", "trajectory", "errors"}),
        lambda root: scenario_of(root, root.path or Path()),
        lambda: toml_files.section_schema(Scenario),
    ),
    "instrument": FileKind(
        "Constants of a six-DOF laser instrument",
        frozenset({"kind", "focal_length_mm", "beam_separation_mm", "glass_index"}),
        instrument_of,
        instrument_schema,
    ),
}
#: Tables of these files whose entries are independent of each other.
_APART = ("controllers", "effects", "machines")


@click.command("schema")
@click.argument("kind", type=click.Choice(list(KINDS)))
def schema_command(kind: str) -> int:
    """Print the JSON schema of a machine, job, scenario or instrument file, for editors.

    The schema (draft 2020-12) tells an editor what to show and to complete: every key with its meaning, unit (mm, um,
    urad), default and allowed values, as the reader of the file declares them. Editors (Even Better TOML, taplo) find it
    through the first line of the file, `#:schema machine.schema.json`.

    \b
    Example:
      volcomp schema machine
    """
    print_json(
        {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": KINDS[kind].title, **KINDS[kind].schema()}
    )
    return 0


#: What a machine file without a prior is told.
NO_CLASS = (
    f"[prior] class is not stated, so errors of a {CLASS_WORDS[USUAL_CLASS]} are assumed where nothing is measured; known are "
    + ", ".join(f"{key} ({words})" for key, words in CLASS_WORDS.items())
)


@click.command("check")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--kind", type=click.Choice(list(KINDS)), help="Kind of the files; default: recognised by their keys.")
@click.option(
    "--spheres",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="*.sphere.csv (mm, degrees): two probed poses of a sphere say whether each rotary axis turns as the machine file says.",
)
@json_option
def check_command(files: tuple[str, ...], kind: str | None, spheres: Path | None, as_json: bool) -> int:
    """List every problem of machine, job, scenario and instrument files at once.

    FILE is a TOML file, the name of a machine, or a folder: all *.toml files in it are checked, even if one is broken. A
    machine file is read with the settings of all of its controls. Values that are possible but unlikely, such as a travel
    of 0.8 mm, are listed as questions, not as problems. Exit code 2 if there is a problem.

    With --spheres and one machine: whether its rotary axes turn as its file says (exit code 1 if one does not).

    \b
    Example:
      volcomp check zha-gantry
    """
    if spheres is not None:
        return _check_senses(files, spheres, as_json)
    listing: list[dict[str, Any]] = []
    for path, named in _paths(files):
        try:
            present = set(toml_files.read_toml(path).data)
        except InputError:  # listed as a problem below
            present = set()
        likeliest = max(KINDS, key=lambda name: len(KINDS[name].keys & present))
        known = kind or (likeliest if KINDS[likeliest].keys & present else None)
        if known is None and present and not named:
            listing.append(
                {"file": str(path), "kind": None, "problems": [], "warnings": [], "hints": [], "unsure": False}
            )
            continue
        if known is None and present:
            none = InputError(f"is none of {', '.join(KINDS)}: its keys do not show its kind; give --kind", file=path)
            found = toml_files.FileProblems((none,))
        else:  # if the kind is unknown, the file is not TOML, which any reader reports
            found = toml_files.problems_of(path, KINDS[known or "machine"].read, _APART)
        problems = [
            {
                "file": str(item.file or path),
                "line": item.line,
                "field": item.field,
                "message": item.message,
                "text": str(item),
            }
            for item in found.problems
        ]
        listing.append(
            {
                "file": str(path),
                "kind": known,
                "problems": problems,
                "warnings": list(found.warnings),
                "hints": [NO_CLASS] if known == "machine" and "prior" not in present else [],
                "unsure": found.unsure,
            }
        )
    count = sum(len(item["problems"]) for item in listing)
    if as_json:
        print_json({"problems": count, "files": listing})
        return 2 if count else 0
    for item in listing:
        wrong, of_kind = len(item["problems"]), item["kind"] or "file"
        if item["kind"] is None and not wrong:
            say(f"{item['file']}: skipped, it is none of {', '.join(KINDS)}")
            continue
        what = f"{wrong} problem{'s' if wrong > 1 else ''}" if wrong else "no problem"
        say(f"{item['file']}: {of_kind}, {what}", style="red" if wrong else None)
        say(*(f"  {problem['text']}" for problem in item["problems"]))
        if item["unsure"]:
            say("  settings that depend on these keys are checked once these are correct")
        say(*(f"  {'question' if '?' in text else 'warning'}: {text}" for text in item["warnings"]), style="yellow")
        say(*(f"  hint: {text}" for text in item.get("hints", [])))
    return 2 if count else 0


def _check_senses(files: Sequence[str], spheres: Path, as_json: bool) -> int:
    """Say which way each rotary axis of a machine turns."""
    from compgen.data.rotary import read_spheres
    from compgen.identification.spheres import senses

    if len(files) != 1:
        raise InputError("expected one machine", field="--spheres")
    machine = load_machine(files[0])
    found = senses(machine, read_spheres(machine, [spheres]))
    data = {sense.letter: {"verdict": sense.verdict, "as_stated_mm": sense.as_stated_mm, "reversed_mm": sense.reversed_mm,
                           "text": sense.text} for sense in found}  # fmt: skip
    if as_json:
        print_json({"machine": machine.name, "senses": data})
    for sense in () if as_json else found:
        say(sense.text, style={"reversed": "red", "not told": "yellow"}.get(sense.verdict))
    return 1 if any(sense.verdict == "reversed" for sense in found) else 0


def _paths(files: Sequence[str]) -> list[tuple[Path, bool]]:
    """The files to check, each once, and whether it was named explicitly."""
    found: dict[Path, bool] = {}
    for name in files:
        path = Path(name)
        if path.is_dir():
            inside = [item for item in sorted(path.rglob("*.toml")) if item.is_file()]
            if not inside:
                raise InputError("has no *.toml file", file=path)
            found |= {item: found.get(item, False) for item in inside}
        elif path.suffix == ".toml" or len(path.parts) > 1 or path.is_file():
            found[path] = True
        else:
            local = Path("machines")
            known = machine_files((local,) if local.is_dir() else ()).get(name)
            found[known or load_machine(name).file or path] = True
    return list(found.items())


# ``volcomp init``: a commented machine file.


@click.command("init")
@click.argument("name", required=False, metavar="[NAME]")
@click.option(
    "--chain",
    metavar="TEXT",
    help='What moves what, in words, e.g. "table moves in X and Y, head in Z" (English or German), or a code such as WFYXZT.',
)
@click.option(
    "--travel",
    multiple=True,
    metavar="AXIS=LOW..HIGH",
    help="Travel of an axis in mm, e.g. X=-800..0, or in another unit, X=0..24in; once for each of X, Y, Z. Of a rotary axis "
    "in degrees, A=-110..30, or C=endless.",
)
@click.option(
    "--point",
    "points",
    multiple=True,
    metavar="AXIS=X,Y,Z",
    help="A point of the line of a rotary axis with all axes at zero, mm, e.g. A=0,0,-50.",
)
@click.option(
    "--nodes",
    multiple=True,
    metavar="[AXIS=]N",
    help="Nodes of the error curves of an axis, or of all; default: one every 100 mm, at least 5.",
)
@click.option(
    "--control", "controls", multiple=True, metavar="NAME", help="Control whose settings are listed (may be several)."
)
@click.option(
    "--out",
    metavar="DIR",
    type=click.Path(path_type=Path),
    default=".",
    help="Folder of NAME.toml; default: this one.",
)
@click.option(
    "--class",
    "class_name",
    metavar="CLASS",
    help="Class of the machine, which says how large errors are assumed to be that are not measured: precision (jig borer), "
    "general (machining centre), large (portal), router (hobby), printer, or none.",
)
@click.option("--force", is_flag=True, help="Overwrite a file that exists.")
@json_option
def init_command(
    name: str | None,
    chain: str | None,
    travel: tuple[str, ...],
    points: tuple[str, ...],
    nodes: tuple[str, ...],
    controls: tuple[str, ...],
    out: Path,
    class_name: str | None,
    force: bool,
    as_json: bool,
) -> int:
    """Write a commented machine file, NAME.toml, from a few answers (lengths in mm).

    On a terminal it asks for everything that no option gives. Every key has a comment with its meaning and unit; settings of
    a control that only its owner can know, such as the sign of a table, are left as comments for you to complete.

    Rotary axes are described, too: --chain "trunnion in A and C, table in Y, column in X, head in Z" --travel A=-110..30
    --travel C=endless --point A=0,0,-50 (degrees, mm). Words such as "fork head" alone mean the usual machine.

    \b
    Example:
      volcomp init my-mill --chain WXYFZT --travel X=0..600 --travel Y=0..400 --travel Z=0..500
    """
    asks = sys.stdin.isatty() and not as_json
    name = name or _asked("Name of the machine", "NAME", asks)
    target = out / f"{re.sub(r'[^A-Za-z0-9._-]', '-', name)}.toml"
    beside = [path.name for path in out.glob("*.toml")] if out.is_dir() else []
    problem = name_problem(name) or name_problem(target.name, beside)
    if problem is not None:
        raise InputError(f"{name!r} {problem}", field="NAME")
    if target.exists() and not force:
        raise InputError("exists; --force overwrites it", file=target)
    _refuse_unknown(controls)
    understood, assumed, words = _chain(chain, asks)
    travel = tuple(part for text in travel for part in text.split(","))
    turning = [part for part in travel if part.strip()[:1].upper() in understood.rotary]
    travel = tuple(part for part in travel if part not in turning)
    ranges = {letter: _travel(letter, travel, asks) for letter in AXES}
    counts = _nodes(nodes, ranges, understood)
    rotary, open_points = _rotary(understood, words, turning, points, counts, asks)
    assumed += open_points
    if asks and not controls:
        text = click.prompt(
            f"Controls ({', '.join(sorted(CONTROLLERS))}; several with commas)", default="none", err=True
        )
        controls = () if text == "none" else tuple(item.strip() for item in text.split(","))
        _refuse_unknown(controls)
    instead = [said for control in controls if (said := program_instead(control))]
    controls = tuple(control for control in controls if program_instead(control) is None)
    if asks and class_name is None:
        listed = ", ".join(CLASS_WORDS.values())
        class_name = click.prompt(f"What kind of machine is it ({listed})", default=CLASS_WORDS[USUAL_CLASS], err=True)
    class_name = None if class_name is None else class_named(class_name)
    # a control with mandatory settings is read only once they are stated
    plain = machine_text(name, understood, ranges, counts, rotary=rotary)
    machine = parse_machine(plain, target)
    sections = [_control_section(machine, control) for control in dict.fromkeys(controls)]
    written = machine_text(name, understood, ranges, counts, sections, class_name, rotary)
    found = parse_machine(written, target)
    output = OutputFolder(out)
    output.add(target.name, written)
    output.commit()
    meaning, questions = in_words(understood), [*assumed, *found.doubts]
    summary = {"file": str(target), "name": name, "chain": understood.name, "meaning": meaning, "questions": questions}
    for question in questions:
        complain(f"question: {question}")
    summary["programs"] = instead
    answer(as_json, summary, f"{target}: {understood.name}: {meaning}", f"volcomp check {target} checks it", *instead)
    return 0


def _refuse_unknown(controls: Sequence[str]) -> None:
    for control in controls:
        if program_instead(control) is None:
            controller_named(control)


def _asked(question: str, option: str, asks: bool) -> str:
    if not asks:
        raise InputError(
            f"is missing; give it, or call `volcomp init` on a terminal, where it asks: {question}", field=option
        )
    return str(click.prompt(question, err=True)).strip()


def _chain(words: str | None, asks: bool) -> tuple[Chain, list[str], str]:
    """The chain, what was assumed about it, and the words."""
    words = words or _asked('What moves what (e.g. "table moves in X and Y, head in Z")', "--chain", asks)
    fits = chains_of(words)
    if not fits:
        raise InputError(
            f"{words!r}: no machine can be built like this; state for each axis what moves in it", field="--chain"
        )
    listed = [f"{item.name}: {in_words(item)}" for item in fits]
    if len(fits) > 1 and asks:
        for number, text in enumerate(listed, start=1):
            click.echo(f"  {number}  {text}", err=True)
        chosen = click.prompt("Which of them", type=click.IntRange(1, len(fits)), default=1, err=True)
        return fits[chosen - 1], [], words
    sides = {frozenset(item.tool_side) for item in fits}
    if len(sides) > 1:
        raise InputError(
            f"{words!r} can mean {len(fits)} machines; give one of the codes: {'. '.join(listed)}", field="--chain"
        )
    others = ", or ".join(listed[1:])
    asked = [f"{words!r} is taken as {listed[0]}. Is it {others}? If so, give that code"] if others else []
    unnamed = [letter for letter in fits[0].name[1:-1] if letter != "F" and letter not in words.upper()]
    if unnamed and not asked:
        asked = [f"{words!r} is taken as {listed[0]}. If it is another machine, name all its axes"]
    return fits[0], asked, words


def _rotary(
    chain: Chain, words: str, travel: Sequence[str], points: Sequence[str], counts: Mapping[str, int], asks: bool
) -> tuple[dict[str, RotaryAxis], list[str]]:
    """The rotary axes of the chain, and questions about what was not stated."""
    given = {"--travel": _by_letter(travel, chain, "--travel"), "--point": _by_letter(points, chain, "--point")}
    directions, found, questions = rotary_directions(words, chain), {}, []
    for letter in chain.rotary:
        x, y, z = (float(other == letter) for other in ROTARY)
        direction = directions.get(letter, (x, y, z))
        if letter in directions:
            questions.append(f"[axes.{letter}] direction: {list(direction)} is assumed of a nutating axis; is it that?")
        text = given["--travel"].get(letter) or (
            click.prompt(f"Travel of {letter} in degrees, e.g. -110..30, or endless", err=True) if asks else None
        )
        if text is None:
            text = "endless" if letter == "C" and (letter, False) in chain.passed else "-90..90"
            travel = "without end" if text == "endless" else f"{text} degrees"
            questions.append(
                f"[axes.{letter}]: a travel {travel} is assumed; give it in degrees: --travel {letter}=-110..30, or "
                f"{letter}=endless"
            )
        place, usual = given["--point"].get(letter), "mm"
        if place is None and asks:
            usual = shown_units()
            place = click.prompt(
                f"A point of the line of {letter}, all axes at zero, {usual}", default="0,0,0", err=True
            )
        if place is None:
            place = "0,0,0"
            questions.append(
                f"[axes.{letter}] point_mm: [0, 0, 0] is assumed; where is its axis line with all axes at zero? "
                f"--point {letter}=0,0,-50"
            )
        found[letter] = _rotary_axis(letter, direction, text, (place, usual), counts[letter])
    return found, questions


def _rotary_axis(letter: str, direction: Vector3, travel: str, point: tuple[str, str], nodes: int) -> RotaryAxis:
    """One rotary axis from ``-110..30`` or ``endless``, and ``0,0,-50`` with the unit of what has none."""
    try:
        x, y, z = (typed_mm(part, point[1]) for part in point[0].split(","))
        place = toml_files.vector3([x, y, z])
    except ValueError:
        raise InputError(
            f"{letter}={point[0]!r} is not of the form AXIS=X,Y,Z in mm, e.g. A=0,0,-50", field="--point"
        ) from None
    if travel.strip().lower() in ("endless", "endlos", "modulo", "360"):
        return RotaryAxis(direction, place, np.linspace(0.0, 360.0, nodes), modulo_deg=360.0)
    ends = re.fullmatch(r"\s*([-+]?[\d.]+)\s*(?:\.\.+|:|\bto\b|\bbis\b)\s*([-+]?[\d.]+?)\s*(?:deg|\u00b0)?\s*", travel)
    try:
        low, high = toml_files.interval([float(part) for part in ends.groups()] if ends else [])
    except ValueError as error:
        raise InputError(
            f"{letter}={travel!r} is not of the form AXIS=LOW..HIGH in degrees, e.g. A=-110..30, or C=endless; {error}",
            field="--travel",
        ) from None
    return RotaryAxis(direction, place, np.linspace(low, high, nodes), range_deg=(low, high))


def _by_letter(given: Sequence[str], chain: Chain, option: str) -> dict[str, str]:
    """Texts of an option by rotary axis."""
    found: dict[str, str] = {}
    for text in given:
        letter, _, value = text.strip().partition("=")
        letter = letter.strip().upper()
        if letter not in chain.rotary:
            known = ", ".join(chain.rotary) or "none"
            raise InputError(
                f"{text!r}: the chain {chain.name} has no rotary axis {letter[:10]} (it has {known})", field=option
            )
        if letter in found:
            raise InputError(f"{letter} is given twice; give it once", field=option)
        found[letter] = value
    return found


def _travel(letter: str, given: Sequence[str], asks: bool) -> Interval:
    """The travel of an axis, from ``X=-800..0``."""
    usual = shown_units()
    stated = [
        text.partition("=")[2] for part in given for text in part.split(",") if text.strip().upper().startswith(letter)
    ]
    if len(stated) > 1:
        raise InputError(f"{letter} is given twice; give it once", field="--travel")
    unknown = [part for part in given for text in part.split(",") if text.strip()[:1].upper() not in AXES]
    if unknown:
        raise InputError(f"{unknown[0]!r} is not of the form AXIS=LOW..HIGH, e.g. X=-800..0", field="--travel")
    text = (
        stated[0]
        if stated
        else _asked(
            f"Travel of {letter} in {usual}, lower and upper end (e.g. {'-30..0' if usual == 'inch' else '-800..0'})",
            "--travel",
            asks,
        )
    )
    try:
        # an option is in mm whatever a page shows; what is asked is in the unit of the question
        low, high = _ends_mm(text, "mm" if stated else usual)
    except ValueError:
        raise InputError(
            f"{letter}={text!r} is not of the form AXIS=LOW..HIGH in mm, e.g. X=-800..0, or with a unit X=0..24in, X=24in",
            field="--travel",
        ) from None
    try:
        return toml_files.interval([low, high])
    except ValueError as error:
        raise InputError(f"{letter}={text!r}: {error}", field="--travel") from None


def _ends_mm(text: str, usual: str = "mm") -> tuple[float, float]:
    """Return both ends of a travel in mm; one length alone counts from 0, and a unit behind the last end is that of both.

    >>> _ends_mm("-800..0"), _ends_mm("24in"), _ends_mm("-30..0 in"), _ends_mm("0mm..0.6m"), _ends_mm("-30..0", "inch")
    ((-800.0, 0.0), (0.0, 609.6), (-762.0, 0.0), (0.0, 600.0), (-762.0, 0.0))
    """
    parts = re.split(r"\.\.+|:|\bto\b|\bbis\b", text)
    stated = re.search(r"[a-zA-Z\"\u2033]+\s*$", parts[-1])
    if not 1 <= len(parts) <= 2 or (len(parts) == 1 and not stated):
        raise ValueError(text)
    ends = [typed_mm(part, stated[0].strip().lower() if stated else usual) for part in parts]
    return (ends[0], ends[1]) if len(ends) == 2 else (min(0.0, ends[0]), max(0.0, ends[0]))


def _nodes(given: Sequence[str], ranges: Mapping[str, Interval], chain: Chain) -> dict[str, int]:
    """The number of nodes of each axis, from ``11`` or ``X=11``; of a rotary axis 13 if nothing says otherwise."""
    found = {letter: usual_nodes(ends) for letter, ends in ranges.items()} | dict.fromkeys(chain.rotary, 13)
    for part in given:
        letters, equals, number = part.rpartition("=")
        chosen = letters.strip().upper() if equals else AXES
        count = whole_number(number.strip())
        if count is None or not 2 <= count <= 10001 or any(item not in found for item in chosen):
            raise InputError(f"{part!r} is not of the form [AXIS=]N with N from 2 to 10001, e.g. X=11", field="--nodes")
        found |= dict.fromkeys(chosen, count)
    return found


def _control_section(machine: Machine, name: str) -> str:
    """The section of a control: every setting as a comment with its default and meaning.

    If a setting must be stated before the section can be read, its header is a comment too.
    """
    control = controller_named(name)
    settings: dict[str, list[tuple[toml_files.DeclaredKey, str]]] = {}
    for key, meaning in toml_files.declared_settings(getattr(control, "settings_class", object)):
        settings.setdefault(key.key.partition(".")[0], []).append((key, meaning))
    lines = []
    for stem, items in settings.items():
        values = ["..." if key.shown is None else json.dumps(key.shown, ensure_ascii=False) for key, _ in items]
        parts = [f"{key.key.partition('.')[2]} = {value}" for (key, _), value in zip(items, values, strict=True)]
        key, meaning = items[0]
        words = key.allowed if key.allowed.startswith(("one of", "a whole number from", "true or")) else ""
        remark = "; ".join(part for part in ("to be stated" if key.required else "", meaning, words) if part)
        lines.append(
            f"{f'# {stem} = ' + (values[0] if len(items) == 1 else '{ ' + ', '.join(parts) + ' }'):<41} # {remark}"
        )
    lines += [
        f"# not settled by any public document: {' '.join(text.split())}" for text in load_format(name).unverified
    ]
    try:
        control.read_settings(machine)
        missing = control(machine).missing()
    except InputError as error:
        why = f"# open: {error.field or ''} {error.message}".replace("\n", " ")
        return "\n".join([why, f"# [controllers.{name}]", *lines])
    open_point = [f"# open: {missing.field} {missing.message}"] if missing is not None else []
    return "\n".join([*open_point, f"[controllers.{name}]", *lines])
