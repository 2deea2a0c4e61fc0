"""Does the verification refuse what is wrong and nothing that is right? Random machines, and edited files of every control.

    python benchmarks/verdicts.py right --machines 200
    python benchmarks/verdicts.py edited --edits 800

``right`` exports random errors of random machines for every control and verifies the text: all of it must be accepted.
``edited`` changes the text of exported files as people and programs do (a number, a sign, two columns, rows, units) and
counts what is accepted although it moves the tip by more than the goal: 1 um, or 3 % of the largest correction without
its linear part. What the edit does is read off the emulated control at random points and nodes, with several tools.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import ERROR_NAMES, error_named
from compgen.errors import CompgenError
from compgen.kinematics import modelled_errors
from compgen.tables import ReadTables, export, verify
from compgen.tables.judge import judge_of
from compgen.tables.verification import reasons_against

SHIPPED = compgen.load_machine("zha-gantry")
FOLDER = Path(__file__).resolve().parents[1]
#: Largest displacement of the tip that a changed text causes, mm; None where it cannot be read.
Moved = Callable[[str], float | None]
COMMENT = re.compile(r"\s*(#(?!\d)|//|;|\()")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])|(?<=[A-Z])-?\d+(?=\s|$)")


# --- random machines and errors --------------------------------------------------------------------------------------


def random_machine(rng: np.random.Generator) -> Machine:
    """A chain, travel of any sign, a reference point anywhere in it, and a tool or none."""
    axes, reference = [], []
    for _ in range(3):
        length = round(float(rng.choice([120, 250, 400, 800, 1500, 2500])) * rng.uniform(0.8, 1.2), 1)
        low = round(float(rng.choice([0.0, -length, -0.4 * length, 55.5, -length - 80.0])), 1)
        nodes = int(rng.integers(4, 14))
        axes.append(Axis((low, low + length), np.linspace(low, low + length, nodes)))
        reference.append(round(low + length * float(rng.choice([0.0, 1.0, 0.5, rng.uniform(0.1, 0.9)])), 1))
    tool = rng.choice([0.0, 1.0]) * np.round(rng.uniform([-40, -40, -200], [40, 40, 100]), 1)
    pmac = toml_files.Section(
        {"counts_per_mm": float(rng.choice([500, 1000, 2000]))}, path=None, name="controllers.pmac"
    )
    return Machine(
        name="random",
        chain=Chain(str(rng.choice(CHAINS))),
        axes=(axes[0], axes[1], axes[2]),
        squareness_reference=str(rng.choice(["X", "Y"])),
        tool_offset_mm=tuple(float(part) for part in tool),
        reference_point_mm=tuple(float(part) for part in reference),
        controllers={**SHIPPED.controllers, "pmac": pmac},
    )


def random_errors(machine: Machine, rng: np.random.Generator) -> ErrorTable:
    """Smooth, ragged or stepped curves of any size; all 21 errors, the observable ones, or a few."""
    names = list(ERROR_NAMES) if rng.random() < 0.3 else list(modelled_errors(machine))
    if rng.random() < 0.15:
        names = sorted(rng.choice(names, size=int(rng.integers(1, 6)), replace=False), key=ERROR_NAMES.index)
    size = float(rng.choice([0.3, 1.0, 3.0]))
    square = float(rng.choice([0.0, 3e-6, 50e-6, 800e-6])) * size
    ragged = float(rng.choice([0.0, 0.0, 0.1, 0.5]))
    curves, constants = {}, {}
    for name in names:
        error = error_named(name)
        if error.kind == "squareness":
            constants[name] = (float(rng.normal() * square), 0.3e-6)
            continue
        nodes = machine.axes[error.axis].nodes_mm
        share = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
        value = sum(rng.normal() * np.sin((k + 1) * (share * 3 + rng.uniform(0, 3))) for k in range(3))
        value = value + ragged * rng.normal(size=len(nodes))
        if error.is_straightness:
            value = value - value[0] - share * (value[-1] - value[0])
        else:
            value = value - np.interp(machine.reference_point_mm[error.axis], nodes, value)
        unit = 8e-3 if error.kind == "linear" else 12e-6
        value = value * unit * size * rng.uniform(0.1, 1.5) / max(np.max(np.abs(value)), 1e-9)
        curves[name] = Curve(nodes, value, np.full(len(nodes), unit * 0.02 * rng.choice([0.0, 1.0, np.nan])))
    return ErrorTable(curves, constants, {"machine": machine.name})


def example(name: str) -> tuple[Machine, ErrorTable]:
    """One of the shipped machines with settings for every control, and errors of it."""
    machine = compgen.load_machine(name)
    machine = replace(machine, controllers={**SHIPPED.controllers, **machine.controllers})
    path = FOLDER / "examples" / f"{name}.truth.errors.csv"
    return machine, compgen.read_errors(path) if path.is_file() else random_errors(machine, np.random.default_rng(4))


# --- tables from text ------------------------------------------------------------------------------------------------


def texts_of(machine: Machine, errors: ErrorTable, name: str) -> tuple[dict[str, str], bool]:
    """Exported texts by file, and whether no limit of the control is broken."""
    made = export(machine, errors, name, allow_unverified=True)
    return dict(made.files), not made.violations


def read_texts(machine: Machine, name: str, texts: dict[str, str]) -> ReadTables:
    """Parse texts as ``volcomp verify`` does."""
    control = CONTROLLERS[name](machine)
    sources = [SourceFile(Path(file), text) for file, text in texts.items()]
    tables = control.parse(sources)
    others = tuple(control.contradictions(tables, sources))
    return ReadTables(control, tables, (), others)


def probes(machine: Machine, tables: ReadTables, rng: np.random.Generator) -> Points:
    """Random points and nodes of the tables in random columns, with the machine's own tool and others."""
    low, high = machine.lower_mm, machine.upper_mm
    nodes = tables.controller.table_nodes_mm(tables.tables)
    parts = [rng.uniform(low, high, (1500, 3))]
    inside = [part[(part >= a) & (part <= b)] for part, a, b in zip(nodes, low, high, strict=True)]
    if np.prod([len(part) for part in inside]) <= 20_000 and all(len(part) for part in inside):
        parts.append(np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1).reshape(-1, 3))
    for axis, part in enumerate(inside):
        if len(part):
            lines = np.repeat(rng.uniform(low, high, (12, 3)), len(part), axis=0)
            lines[:, axis] = np.tile(part, 12)
            parts.append(lines)
    position = np.vstack(parts)
    tools = [np.array(machine.tool_offset_mm)] * 2 + [np.array(tool) for tool in machine.tool_corners_mm]
    tool = np.array(tools)[np.arange(len(position)) % len(tools)]
    tool[: len(tool) // 2] = machine.tool_offset_mm
    return Points(position, tool, np.ones_like(position))


def goal_mm(points: Points, added: np.ndarray) -> float:
    """1 um, or 3 % of the largest correction without its linear part, with the machine's own tool."""
    columns = np.column_stack([np.ones(len(added)), points.position_mm])
    own = np.all(points.tool_mm == points.tool_mm[0], axis=1)
    linear, *_ = np.linalg.lstsq(columns[own], added[own], rcond=None)
    return max(1e-3, 0.03 * float(np.max(np.linalg.norm(added[own] - columns[own] @ linear, axis=1))))


# --- edits of text ---------------------------------------------------------------------------------------------------


def numbers_in(text: str) -> list[re.Match[str]]:
    """Return the numbers outside comments, headers and names."""
    found, at = [], 0
    for line in text.splitlines(keepends=True):
        if not COMMENT.match(line):
            found += [m for m in NUMBER.finditer(text, at, at + len(line.rstrip("\r\n")))]
        at += len(line)
    return found


def _written(word: str, value: float) -> str:
    """A number with as many decimals as the word that it takes the place of."""
    _, point, decimals = word.partition(".")
    return (
        f"{value:.{len(decimals)}f}"
        if point and "e" not in word.lower()
        else f"{value:.12e}"
        if point
        else f"{value:.0f}"
    )


def _put(text: str, match: re.Match[str], word: str) -> str:
    return text[: match.start()] + word + text[match.end() :]


def entry_edit(text: str, rng: np.random.Generator, moved: Moved, wanted_mm: float) -> str | None:
    """Change one number so that it moves the tip by about ``wanted_mm``; None where it does not move it."""
    matches = numbers_in(text)
    match = matches[int(rng.integers(len(matches)))]
    value, sign = float(match[0]), float(rng.choice([-1.0, 1.0]))
    whole = "." not in match[0]
    quantum = 1.0 if whole else max(10.0 ** -len(match[0].partition(".")[2]), 1e-12)
    for trial in (quantum, 1e-6, 1e-3, 1.0, 1e3):
        if trial < quantum:
            continue
        step = moved(_put(text, match, _written(match[0], value + sign * trial)))
        if step is None or step > 1e-7:
            break
    if step is None or step < 1e-9:
        return None
    count = max(1.0, np.ceil(trial * wanted_mm / step / quantum))
    return _put(text, match, _written(match[0], value + sign * count * quantum))


def sign_edit(text: str, rng: np.random.Generator) -> str:
    """Turn the sign of one number."""
    matches = numbers_in(text)
    match = matches[int(rng.integers(len(matches)))]
    return _put(text, match, match[0][1:] if match[0].startswith("-") else "-" + match[0].lstrip("+"))


def _rows(text: str) -> list[tuple[int, list[re.Match[str]]]]:
    """Lines with their numbers, of the most frequent count of numbers."""
    at, rows = 0, []
    matches = numbers_in(text)
    for k, line in enumerate(text.splitlines(keepends=True)):
        rows.append((k, [m for m in matches if at <= m.start() < at + len(line)]))
        at += len(line)
    rows = [row for row in rows if row[1]]
    common = Counter(len(row[1]) for row in rows).most_common(1)[0][0]
    return [row for row in rows if len(row[1]) == common]


def _with_words(text: str, words: dict[int, tuple[re.Match[str], str]]) -> str:
    for start in sorted(words, reverse=True):
        text = _put(text, *words[start])
    return text


def columns_edit(text: str, rng: np.random.Generator) -> str | None:
    """Swap two columns in a run of rows."""
    rows = _rows(text)
    if len(rows[0][1]) < 2:
        return None
    one, other = rng.choice(len(rows[0][1]), 2, replace=False)
    first = int(rng.integers(len(rows)))
    words = {}
    for _, row in rows[first : first + int(rng.integers(1, 30))]:
        words[row[one].start()] = (row[one], row[other][0])
        words[row[other].start()] = (row[other], row[one][0])
    return _with_words(text, words)


def rows_edit(text: str, rng: np.random.Generator) -> str:
    """Move the last column of a run of rows by one."""
    rows = _rows(text)
    first = int(rng.integers(len(rows)))
    part = [row[-1] for _, row in rows[first : first + int(rng.integers(2, 30))]]
    moved = [part[-1][0], *(match[0] for match in part[:-1])]
    return _with_words(text, {match.start(): (match, word) for match, word in zip(part, moved, strict=True)})


def unit_edit(text: str, rng: np.random.Generator) -> str:
    """Multiply the last column of a run of rows."""
    rows = _rows(text)
    factor = float(rng.choice([1000.0, 1e-3, 25.4, 1 / 25.4, 57.29578, 0.5, 1.05, 0.95]))
    first = int(rng.integers(len(rows)))
    part = [row[-1] for _, row in rows[first : first + int(rng.choice([1, 5, 20, len(rows)]))]]
    return _with_words(text, {m.start(): (m, _written(m[0], float(m[0]) * factor)) for m in part})


#: Controls that are tried on each random machine, drawn anew; on the shipped ones all are.
PER_MACHINE = 4
KINDS = ("entry", "entry", "entry", "entry", "sign", "columns", "rows", "unit")


class EditedTables:
    """The text of one control, and what edits of it do."""

    def __init__(self, machine: Machine, errors: ErrorTable, name: str, seed: int = 1) -> None:
        self.machine, self.errors, self.name = machine, errors, name
        texts, _ = texts_of(machine, errors, name)
        # The plan for the transfer says every number a second time; the tables alone have to do.
        self.texts = {file: text for file, text in texts.items() if not file.endswith(".plan.json")}
        right = read_texts(machine, name, self.texts)
        self.points = probes(machine, right, np.random.default_rng(seed))
        self.right_mm = self.correction(right)
        self.goal_mm = goal_mm(self.points, self.right_mm)
        self.judge = judge_of(machine, right.controller, errors, right.tables)

    def read(self, texts: dict[str, str]) -> ReadTables | None:
        """Parse edited texts; None if they are refused as input."""
        try:
            return read_texts(self.machine, self.name, texts)
        except CompgenError:
            return None

    def moved_mm(self, tables: ReadTables | None) -> float | None:
        """Largest displacement against the right tables."""
        if tables is None:
            return None
        return float(np.max(np.linalg.norm(self.correction(tables) - self.right_mm, axis=1)))

    def correction(self, tables: ReadTables) -> np.ndarray:
        """What the control adds at the probes, those with the machine's own tool and with others apart."""
        own = np.all(self.points.tool_mm == np.array(self.machine.tool_offset_mm), axis=1)
        added = np.zeros_like(self.points.position_mm)
        for part in (own, ~own):
            where = Points(self.points.position_mm[part], self.points.tool_mm[part], self.points.approach[part])
            added[part] = tables.correction(self.machine, where)
        return added

    def edit(self, rng: np.random.Generator) -> tuple[str, dict[str, str]] | None:
        """Return kind and texts of one edit; None if there was nothing to edit."""
        files = [file for file, text in self.texts.items() if len(numbers_in(text)) > 3]
        file, kind = str(rng.choice(files)), str(rng.choice(KINDS))
        text = self.texts[file]
        if kind == "entry":
            factor = float(rng.choice([0.5, 0.9, 1.02, 1.1, 1.3, 2.0, 10.0, 1000.0]))

            def moved(changed: str) -> float | None:
                return self.moved_mm(self.read({**self.texts, file: changed}))

            other = entry_edit(text, rng, moved, factor * self.goal_mm)
        else:
            other = {"sign": sign_edit, "columns": columns_edit, "rows": rows_edit, "unit": unit_edit}[kind](text, rng)
        return None if other is None or other == text else (kind, {**self.texts, file: other})

    def judged(self, texts: dict[str, str]) -> tuple[str, float, tuple[str, ...]]:
        """Return ``refused``, ``rejected``, ``accepted`` or ``WRONG``, how far the tip moves in um, and the reasons."""
        tables = self.read(texts)
        if tables is None:
            return "refused", np.inf, ()
        moved = self.moved_mm(tables)
        _, reasons = reasons_against(self.machine, tables, self.judge)
        outcome = "rejected" if reasons else "WRONG" if moved > self.goal_mm + 1e-6 else "accepted"
        return outcome, 1e3 * moved, reasons


# --- the two campaigns -----------------------------------------------------------------------------------------------


def right_tables(count: int, seed: int, names: list[str], first: int = 0) -> int:
    """Export and verify for the shipped and ``count`` random machines; returns how many right tables were rejected."""
    rejected, done, start = 0, 0, time.time()
    for k in range(first, count + 3):
        rng = np.random.default_rng([seed, k])
        if k < 3:
            machine, errors = example(("zha-gantry", "jia-xytz", "moving-table-mill")[k])
        else:
            machine = random_machine(rng)
            errors = random_errors(machine, rng)
        for name in names if k < 3 else rng.choice(names, min(len(names), PER_MACHINE), replace=False).tolist():
            try:
                texts, good = texts_of(machine, errors, name)
                if not good:
                    continue
                result = verify(machine, read_texts(machine, name, texts), errors)
            except CompgenError:
                continue
            done += 1
            print(f"{done}, {rejected} rejected", end="\r", file=sys.stderr)
            if not result.accepted:
                rejected += 1
                print(f"machine {k} {machine.chain.name} {name}: {result.reasons[:3]}", flush=True)
    print(f"{done} right tables of machines {first} to {count + 2}, {rejected} rejected, {time.time() - start:.0f} s")
    return rejected


def edited_files(count: int, seed: int, names: list[str], machines: int = 6) -> int:
    """Edit files ``count`` times; returns how many were accepted although they move the tip by more than the goal."""
    counts: Counter[tuple[str, str]] = Counter()
    start = time.time()
    given = [example(name) for name in ("zha-gantry", "jia-xytz", "moving-table-mill")[:machines]]
    for k in range(len(given), machines):
        rng = np.random.default_rng([seed, 77, k])
        machine = random_machine(rng)
        given.append((machine, random_errors(machine, rng)))
    made: dict[tuple[int, str], EditedTables | None] = {}
    k = 0
    while sum(counts.values()) < count:
        rng = np.random.default_rng([seed, k])
        key = int(rng.integers(len(given))), names[k % len(names)]
        k += 1
        if key not in made:
            try:
                made[key] = EditedTables(*given[key[0]], key[1])
            except CompgenError:
                made[key] = None
        edited = made[key]
        found = edited.edit(rng) if edited else None
        if found is None:
            continue
        kind, texts = found
        outcome, moved, reasons = edited.judged(texts)
        counts[kind, outcome] += 1
        print(f"{sum(counts.values())}", end="\r", file=sys.stderr)
        if outcome == "WRONG":
            changed = [
                (a, b)
                for file in texts
                for a, b in zip(edited.texts[file].splitlines(), texts[file].splitlines(), strict=False)
                if a != b
            ]
            goal = 1e3 * edited.goal_mm
            print(
                f"edit {k - 1} machine {key[0]} {key[1]} {kind}: {moved:.2f} um, goal {goal:.2f}; {changed[:2]}",
                flush=True,
            )
    for (kind, outcome), number in sorted(counts.items()):
        print(f"{kind:8s} {outcome:9s} {number}")
    wrong = sum(number for (_, outcome), number in counts.items() if outcome == "WRONG")
    print(f"{sum(counts.values())} edited files, {wrong} accepted although wrong, {time.time() - start:.0f} s")
    return wrong


def main(words: list[str] | None = None) -> int:
    """Command line; exit code 1 if anything right was rejected or anything wrong accepted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", choices=("right", "edited"))
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="leave out the machines before this one")
    parser.add_argument("--edits", type=int, default=800)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--controller", action="append", choices=sorted(CONTROLLERS))
    given = parser.parse_args(words)
    warnings.simplefilter("ignore", compgen.CompgenWarning)
    names = given.controller or sorted(CONTROLLERS)
    if given.campaign == "right":
        return int(right_tables(given.machines, given.seed, names, given.first) > 0)
    return int(edited_files(given.edits, given.seed, names) > 0)


if __name__ == "__main__":
    sys.exit(main())
