"""What a control held while its machine was measured, by a backup of it, and what it may have held instead.

A backup is read by the reader of the control. It is compared with the stored versions by the hashes of its files and by its
numbers, and it counts as it is: edited, half, with the opposite sign, without one of several tables. Instead of a backup,
the SHA-256 of its files may be given.

Without a backup, :func:`possible_states` lists what the tables may have been: each version, each table of it, what it adds to
each axis, with factors that are common mistakes.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from compgen.data.comparison import small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.files import naming_below, sha256_of, working_folder
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.prior import CLASSES
from compgen.errors import CompgenError, InputError
from compgen.fleet.change import Known, compared_fields, volume_points
from compgen.fleet.inbox import backup_part
from compgen.fleet.records import TableRecord
from compgen.fleet.store import Store
from compgen.identification.covariance import Covariance, covariance_of_values, error_design
from compgen.tables import ReadTables, parse_tables, read_tables
from compgen.tables.entries import numbers_of, with_factor

#: Tables that add the same within this everywhere are the same, whoever wrote the numbers, mm.
SAME_MM = 1e-6
#: What is recognised as a version times a factor, or without a table, may differ from it by this beyond the rounding of the
#: control, mm. It only gives a name to what the backup holds.
NAMED_MM = 0.2 * MM_PER_UM
#: Factors that are common mistakes, and what they mean for all tables of a version and for a part of them.
FACTORS = {
    -1.0: ("{} with the opposite sign", "{} with the opposite sign of {}"),
    0.0: ("", "{} without {}"),
    0.5: ("{} at half its size", "{} with half of {}"),
    2.0: ("{} at twice its size", "{} with twice {}"),
}
#: Ends the name of a state in which every number was multiplied, which is not the same where tables are multiplied.
OF_NUMBERS = " in all its numbers"
#: Versions of which single tables are considered, the last ones.
IN_PARTS = 3
#: So few numbers are those of a compensation of shears alone: each is a table.
SKEWS = 12
#: What tables add to the commands, (..., n, 3), mm.
Added = Callable[[ReadTables], FloatArray]
#: What a reader says of a file of its control that it understands, and that has no table.
_NO_TABLE = re.compile(r"contains no (compensation )?table($|; expected)")
_HASH = re.compile(r"\s*([0-9a-fA-F]{64})\b[^\r\n]*")


@dataclass(frozen=True)
class Held:
    """What a control held: its ``tables`` (None: none), which stored ``version`` they are, and what they are in words.

    ``version`` is None if they are no stored version, number for number.
    """

    tables: ReadTables | None
    version: int | None
    words: str


def tables_read(store: Store, machine: Machine, table: TableRecord, control: str) -> ReadTables | None:
    """Parse the table files of one control, without manifest and notes; None if there are none."""
    files = _files_of(store, table, control)
    return parse_tables(machine, files, control) if files else None


def _files_of(store: Store, table: TableRecord, control: str) -> dict[str, bytes]:
    names = table.summary.get("tables", {}).get(control, [])
    files = {file.name: file.content for file in store.table_files(table) if file.controller == control}
    return {name: files[name] for name in names}


def held_by(
    store: Store, machine: Machine, controllers: Sequence[str], known: Sequence[TableRecord], files: Mapping[str, bytes]
) -> Held:
    """Read a backup and compare it with the stored versions ``known``.

    Raises
    ------
    InputError
        if no control of the job can read it, or a hash is not that of a stored table.
    """
    hashes = _hashes_in(files)
    problems = []
    for control in controllers:
        try:
            if hashes:
                return _held_by_hash(store, machine, control, known, hashes)
            return _compared(store, machine, known, _read(machine, control, files))
        except InputError as error:
            problems.append(f"{control}: {error}")
    raise InputError("; ".join(problems))


def _read(machine: Machine, control: str, files: Mapping[str, bytes]) -> ReadTables | None:
    """Parse a backup as the file of a control; None if it has no table at all."""
    with working_folder("backup-") as folder, naming_below(folder):
        paths = []
        for name, content in files.items():
            path = Path(folder) / backup_part(name)
            if path.name not in ("manifest.json", "preflight.md"):
                path.write_bytes(content.removeprefix(codecs.BOM_UTF8))  # editors add it
                paths.append(path)
        try:
            return read_tables(machine, paths, control, foreign=True)
        except InputError as error:
            if _NO_TABLE.search(str(error)) and all(content.strip() for content in files.values()):
                return None
            raise


def _hashes_in(files: Mapping[str, bytes]) -> list[str]:
    """Return the SHA-256 of a list of hashes such as ``sha256sum`` writes; empty if it is anything else."""
    found = []
    for content in files.values():
        lines = [line for line in content[:100_000].decode("ascii", "replace").splitlines() if line.strip()]
        matched = [_HASH.fullmatch(line) for line in lines]
        if not lines or not all(matched):
            return []
        found += [match[1].lower() for match in matched if match is not None]
    return found


def _held_by_hash(
    store: Store, machine: Machine, control: str, known: Sequence[TableRecord], hashes: Sequence[str]
) -> Held:
    """Find the version whose files have these hashes, all of them or some."""
    for table in reversed(known):
        by_hash = {sha256_of(content): name for name, content in _files_of(store, table, control).items()}
        names = [by_hash[digest] for digest in dict.fromkeys(hashes) if digest in by_hash]
        if len(names) == len(set(hashes)):
            contents = {name: content for name, content in _files_of(store, table, control).items() if name in names}
            return _compared(store, machine, known, parse_tables(machine, contents, control))
    raise InputError(f"no stored version has a table with the SHA-256 {hashes[0][:12]}...; give the backup itself")


def _compared(store: Store, machine: Machine, known: Sequence[TableRecord], found: ReadTables | None) -> Held:
    """Say which version the tables are, or what they are most like."""
    if found is None:
        return Held(None, None, "no tables")
    position_mm = volume_points(machine)
    own = _both_ways(machine, found, position_mm)
    if float(np.max(np.abs(own))) < SAME_MM:
        return Held(None, None, "no tables: all values are zero")
    numbers = numbers_of(found.tables)
    versions: dict[int, ReadTables] = {}
    for table in reversed(known):
        stored = tables_read(store, machine, table, found.controller.name)
        if stored is None:
            continue
        same_files = {digest for _, digest in stored.files} == {digest for _, digest in found.files}
        if same_files or _same_numbers(numbers, numbers_of(stored.tables)):
            return Held(found, table.version, f"version {table.version}")
        versions[table.version] = stored
    return Held(found, None, _described(machine, found, own, versions))


def _same_numbers(first: Mapping[str, FloatArray], second: Mapping[str, FloatArray]) -> bool:
    return first.keys() == second.keys() and all(
        first[place].shape == second[place].shape and np.allclose(first[place], second[place], rtol=1e-9, atol=1e-12)
        for place in first
    )


def _described(machine: Machine, found: ReadTables, own: FloatArray, versions: Mapping[int, ReadTables]) -> str:
    """Say in words what tables are that are no stored version, from what they add in both directions (2, n, 3)."""
    position_mm = volume_points(machine)
    limit = NAMED_MM + 2.0 * found.controller.resolution_mm()
    nearest: tuple[float, str] = (np.inf, "tables that this store does not know")
    for version, stored in versions.items():
        for words, field in _states_of(
            stored, f"version {version}", lambda tables: _both_ways(machine, tables, position_mm)
        ):
            apart = float(np.max(np.abs(own - field)))
            if apart < SAME_MM and words == f"version {version}":
                return f"version {version} in other files"
            if apart <= limit and words != f"version {version}" and np.max(np.abs(field)) > limit:
                return words
        apart = float(np.max(np.abs(own - _both_ways(machine, stored, position_mm))))
        if apart < nearest[0]:
            nearest = apart, f"tables that differ from version {version} by up to {apart / MM_PER_UM:.2f} um"
    return nearest[1]


def _both_ways(machine: Machine, tables: ReadTables, position_mm: FloatArray) -> FloatArray:
    """What tables add after travel in both directions, (2, n, 3), mm."""
    sides = (1.0, -1.0) if tables.controller.by_direction(tables.tables) else (1.0,)
    every = [
        tables.correction(machine, Points(position_mm, approach=np.full_like(position_mm, side))) for side in sides
    ]
    return np.stack([every[0], every[-1]])


# --- what may have been on --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TableState:
    """A state that the tables may have been in: in words, and what it adds to the commands at n points, (n, 3), mm.

    ``kind`` says what it takes to get there: "none", "version", "factor" (of all tables), "part" (a table, an axis).
    """

    words: str
    kind: str
    field_mm: FloatArray


def possible_states(machine: Machine, versions: Mapping[int, ReadTables], position_mm: FloatArray) -> list[TableState]:
    """List no tables, each version, and its usual distortions; of the last versions also those of single tables and axes.

    ``versions`` are in order, the last ones the likeliest. Fields are the mean of both directions of travel.
    """
    found = [TableState("no tables", "none", np.zeros_like(position_mm))]
    late = list(versions)[-IN_PARTS:]
    for version, tables in versions.items():
        whole = f"version {version}"

        def added(item: ReadTables) -> FloatArray:
            return item.mean_correction(machine, position_mm)

        whole_ones = tuple(words.format(whole) for words, _ in FACTORS.values() if words)
        for words, field in _states_of(tables, whole, added, parts=version in late):
            kind = "version" if words == whole else "factor" if words.removesuffix(OF_NUMBERS) in whole_ones else "part"
            found.append(TableState(words, kind, field))
    return found


def _states_of(tables: ReadTables, whole: str, added: Added, *, parts: bool = True) -> Iterator[tuple[str, FloatArray]]:
    """Yield what a version may have been in words, and what it then adds: times a factor, all of it or a part of it."""
    field = added(tables)
    lists = _lists_of_values(tables, added, field) if parts else {}
    numbers = set[str]().union(*(places for places, _ in lists.values()))
    yield whole, field
    for factor, (words, _) in FACTORS.items():
        if words:
            yield words.format(whole), factor * field
            change = _change(tables, added, field, numbers, factor) if numbers else None
            if change is not None and not np.allclose(field + change, factor * field, rtol=0.0, atol=NAMED_MM):
                yield words.format(whole) + OF_NUMBERS, field + change
    for name, part in _parts_of(tables, added, field, lists).items() if parts else ():
        for factor, (_, words) in FACTORS.items():
            yield words.format(whole, name), field + (factor - 1.0) * part


#: Lists of numbers that are the values of tables: their places, and what they contribute, by name.
Values = Mapping[str, tuple[set[str], FloatArray]]


def _parts_of(tables: ReadTables, added: Added, field: FloatArray, lists: Values) -> dict[str, FloatArray]:
    """Return what all tables for one axis, and single tables, contribute to ``field``, by name."""
    found: dict[str, FloatArray] = {}
    for name, part in [*_axes(field), *_single_tables(tables, added, field, lists)]:
        small = float(np.max(np.abs(part))) < SAME_MM
        if not small and not any(
            np.allclose(part, other, rtol=0.0, atol=SAME_MM) for other in (field, *found.values())
        ):
            found[name] = part
    return found


def _axes(field: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    for axis, letter in enumerate(AXES):
        part = np.zeros_like(field)
        part[..., axis] = field[..., axis]
        yield f"what it adds to {letter}", part


def _single_tables(
    tables: ReadTables, added: Added, field: FloatArray, lists: Values
) -> Iterator[tuple[str, FloatArray]]:
    """Yield what each table of a control contributes; the lists of one table, as of both directions, belong together."""
    groups: dict[str, list[str]] = {}
    for name in lists:
        groups.setdefault(name.rpartition("]")[0] or name, []).append(name)
    for group, names in groups.items():
        places = set[str]().union(*(lists[name][0] for name in names))
        both = _change(tables, added, field, places, 0) if len(names) > 1 else None
        if both is not None:
            yield f"its {_name_of(group + ']')}", -both
        for name in names:
            which = f" ({name.rpartition(']')[2].lstrip('.')})" if len(names) > 1 else ""
            yield f"its {_name_of(name)}{which}", lists[name][1]


def _lists_of_values(tables: ReadTables, added: Added, field: FloatArray) -> dict[str, tuple[set[str], FloatArray]]:
    """Return the lists of numbers that are the values of tables, with what each contributes, without knowing the control.

    Numbers are the values of a table if what the control adds is linear in them: as much is added by twice the numbers as
    is lost without them. Positions and steps are not.
    """
    numbers = numbers_of(tables.tables)
    few = sum(values.size for values in numbers.values()) <= SKEWS
    lists: dict[str, set[str]] = {}
    for place, values in numbers.items():
        if values.size > 1 or few or place.endswith("]"):
            lists.setdefault(re.sub(r"\[\d+\]$", "", place), set()).add(place)
    linear: dict[str, tuple[set[str], FloatArray]] = {}
    for name, places in lists.items():
        lost, gained = (_change(tables, added, field, places, factor) for factor in (0, 2))
        if lost is None or gained is None or np.max(np.abs(lost)) < SAME_MM:
            continue
        if np.max(np.abs(lost + gained)) <= 1e-6 * np.max(np.abs(lost)):
            linear[name] = places, -lost
    return linear


def _change(tables: ReadTables, added: Added, field: FloatArray, places: set[str], factor: float) -> FloatArray | None:
    """By how much what is added changes if some numbers are multiplied; None if no such table is possible."""
    try:
        with np.errstate(all="ignore"):
            found = added(replace(tables, tables=with_factor(tables.tables, places, factor))) - field
    except (CompgenError, ArithmeticError, ValueError, IndexError, TypeError):
        return None
    return found if np.isfinite(found).all() else None


def _name_of(place: str) -> str:
    """Return a place in words.

    >>> _name_of(".tables[3].table.values"), _name_of(".fields[EXX].values"), _name_of(".xy")
    ('table 3', 'field EXX', 'xy')
    """
    keys = re.findall(r"\.(\w+)\[([^\]]*)\]", place)
    words = [
        f"{name.removesuffix('ies') + 'y' if name.endswith('ies') else name.removesuffix('s')} {key}"
        for name, key in keys
    ]
    return " ".join(words) or place.lstrip(".")


# What explains a change: drift, a jump of an error, or tables that were not as assumed.
#
# Every explanation is a state of the tables together with a kind of change of the machine:
# what it repeats and drifts, a jump of one error, a jump of all. With the field c_S of what the tables added and the field c_A of
# what was removed from the readings, the errors seem to have changed by d = e + c_S - c_A. The true change e is normal with
# zero mean, so each explanation has a likelihood; together with what is usual (:data:`USUAL`) they give probabilities.


#: Prior probabilities of the kinds of change: repeatability and drift; a jump of one error; of two; of all.
CHANGES = {"drift": 0.93, "one": 0.04, "two": 0.02, "all": 0.01}
#: A jump is so many times as large as drift.
JUMP = 10.0
#: Drift of curves in a month, standard deviations: bow and third order of straightness and positioning, mm; line (change
#: from the middle to the end), bow and third order of angles, rad.
DRIFT_CURVE_MM, DRIFT_ANGLE_RAD = (1.0 * MM_PER_UM, 0.5 * MM_PER_UM), (3e-6, 2e-6, 1e-6)
#: Variance of the measurements is doubled, and this much is added over the volume, mm rms: stated uncertainties are often
#: somewhat too small, and tables are rounded.
DOUBLED, FLOOR_MM = 2.0, 0.15 * MM_PER_UM
#: Expansion of a scale that is not corrected for a temperature that was logged, 1/K.
UNCORRECTED_PER_K = 12e-6
DAYS_A_MONTH = 30.4375


@dataclass(frozen=True)
class DriftSizes:
    """Standard deviation of what scales (3,) and squareness may change between two calibrations, mm/mm and rad.

    ``growth`` is the factor for other shapes.
    """

    scale: FloatArray
    squareness: float
    growth: float

    @classmethod
    def between(cls, machine: Machine, days: float, kelvin: FloatArray, *, corrected: bool) -> DriftSizes:
        """Return the sizes for a time, and for temperatures that differ by ``kelvin`` (3,), nan where none is known.

        ``corrected`` says whether scales were corrected for these temperatures where the machine file has a coefficient.
        """
        known, growth = machine.repeatability, float(np.sqrt(max(days / DAYS_A_MONTH, 1.0)))
        growth *= max(1.0, CLASSES.get(machine.prior.stated_class, 1.0))
        scale = np.zeros(3)
        for k, axis in enumerate(machine.axes):
            follows = corrected and axis.expansion_um_per_m_k is not None
            read = bool(np.isfinite(kelvin[k]))
            repeats = known.scale(temperatures=read and follows)
            warm = 0.0 if not read else (axis.u_expansion if follows else UNCORRECTED_PER_K) * kelvin[k]
            scale[k] = np.sqrt(2.0 * repeats**2 + (1e-6 * known.drift_scale_um_per_m * growth) ** 2 + warm**2)
        own = 2.0 * known.squareness_urad**2 + (known.drift_squareness_urad * growth) ** 2
        return cls(scale, 1e-6 * float(np.sqrt(own)), growth)


@dataclass(frozen=True)
class Explanations:
    """Probabilities of m states of the tables, the first of which is assumed: alone, (m,), and with no jump, (m,).

    ``rms_um`` is the change over the volume without rigid motion, ``drift_um`` what drift and noise make of it, rms.
    """

    probability: FloatArray
    without_jump: FloatArray
    rms_um: float
    drift_um: float


def explained(
    machine: Machine, new: Known, old: Known, extra_mm: FloatArray, prior: FloatArray, sizes: DriftSizes
) -> Explanations:
    """Weigh the states of the tables that may explain a change of the identified errors.

    Parameters
    ----------
    extra_mm : what each state would have added beyond what was removed, at :func:`volume_points`, (m, n, 3), mm.
    prior : prior probability of each state, (m,).
    """
    position_mm = volume_points(machine)
    motion = small_motion(position_mm)
    moved = compared_fields(machine, new, old, position_mm)
    layout = new[1] or covariance_of_values(new[0], np.zeros((len(new[0].labels()[0]), 0)))
    design = motion.taken_out(error_design(machine, layout, position_mm).reshape(position_mm.size, -1))
    shapes = _drift_shapes(machine, layout, sizes)
    columns = [part / max(float(np.linalg.norm(part)), 1e-300) for part in (design, moved.factor, moved.value[:, None])]
    left, size, _ = np.linalg.svd(np.hstack(columns), full_matrices=False)
    span = left[:, size > 1e-9 * size[0]]  # what identified errors can express: the rest of a table does not show
    state = span.T @ motion.taken_out(extra_mm.reshape(len(extra_mm), -1).T)
    change = (span.T @ moved.value)[:, None]
    noise = span.T @ moved.factor
    base = DOUBLED * noise @ noise.T + FLOOR_MM**2 * len(position_mm) / span.shape[1] * np.eye(span.shape[1])
    drift = {name: span.T @ (design @ columns) for name, columns in shapes.items()}
    kinds: dict[str, list[tuple[str, ...]]] = {"drift": [()], "one": [(name,) for name in drift], "all": [(*drift,)]}
    kinds["two"] = list(combinations(drift, 2))
    usual, logs = base + sum(part @ part.T for part in drift.values()), []
    for kind, every in kinds.items():
        for jumps in every:
            more = np.hstack([np.zeros((len(base), 0)), *(np.sqrt(JUMP**2 - 1.0) * drift[name] for name in jumps)])
            factor = np.linalg.cholesky(usual + more @ more.T)
            apart = np.linalg.solve(factor, change - state)
            log = np.log(CHANGES[kind] / len(every)) - 0.5 * np.sum(apart**2, axis=0) - np.sum(np.log(np.diag(factor)))
            logs.append(log)
    weight = np.array(logs) + np.log(prior)
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    expected = sum(float(np.sum(part**2)) for part in drift.values()) + moved.noise
    count = len(position_mm)
    return Explanations(
        weight.sum(axis=0),
        weight[0],
        float(np.sqrt(moved.value @ moved.value / count)) / MM_PER_UM,
        float(np.sqrt(expected / count)) / MM_PER_UM,
    )


def _drift_shapes(machine: Machine, layout: Covariance, sizes: DriftSizes) -> dict[str, FloatArray]:
    """Columns of values by error, (k, c) each: one standard deviation of every shape that drift has."""
    names, found = np.array(layout.error), {}
    for name in dict.fromkeys(layout.error):
        own = np.flatnonzero(names == name)
        columns: list[FloatArray] = []
        if name in SQUARENESS_NAMES:
            columns = [np.full(1, sizes.squareness)]
        else:
            error, at = error_named(name), layout.position_mm[own]
            low, high = machine.axes[error.axis].range_mm
            share = 2.0 * (at - low) / (high - low) - 1.0
            powers = [share**2 - 1.0 / 3.0, share**3 - 0.6 * share]
            if error.kind == "angular":
                amounts = [sizes.growth * amount for amount in DRIFT_ANGLE_RAD]
                powers = [share, *powers]
            else:
                amounts = [sizes.growth * amount for amount in DRIFT_CURVE_MM]
                if not error.is_straightness:
                    columns = [sizes.scale[error.axis] * (at - machine.reference_point_mm[error.axis])]
            columns += [amount * power for amount, power in zip(amounts, powers, strict=True)]
        found[name] = np.zeros((len(names), len(columns)))
        found[name][own] = np.column_stack(columns)
    return found
