"""What errors of a machine leave on a part: deviation along the path, holes, circles, distances, squareness of corners."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.data.comparison import figures_of, without_rigid_motion
from compgen.data.csv_files import FloatArray
from compgen.data.files import read_bytes, working_folder
from compgen.data.lengths import Points
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError
from compgen.identification.covariance import Covariance, error_design, posterior_with
from compgen.identification.posterior import Posterior, assumed_text, open_shares, worse_text
from compgen.kinematics.many_points import full_grid
from compgen.programs.bends import Bends
from compgen.programs.compensation import centre_path, unknown_radius
from compgen.programs.correct import CorrectOptions, ProgramCorrection, correct_program
from compgen.programs.dialects import dialect_named
from compgen.programs.features import PartFeatures, Quantity, Samples
from compgen.programs.follower import read_twice
from compgen.programs.path import (
    ExactModel,
    IntArray,
    Moves,
    PathDeviations,
    PathFigures,
    directions_at,
    kept_directions,
    path_deviations,
    points_of,
)
from compgen.programs.reader import Reader, Setup, SingleBlock
from compgen.tables import ReadTables

if TYPE_CHECKING:
    from compgen.heat import Growth

#: Samples along an axis for the slope of tables, besides their nodes.
BEND_SAMPLES = 101
#: Distance of samples along the path, mm.
STEP_MM = 2.0
#: Errors that are named where many were not measured, and points of the path at which they are compared.
NAMED, SHARE_POINTS = 3, 200
#: Points of the picture: of more, every second, every fourth ... is left out.
MOST_POINTS = 6000
#: What is evaluated, in the order of the fields of a feature.
VARIANTS = ("as the machine is", "with tables", "program corrected", "tables and program")
#: Those that the picture can show, also with the best-fit rigid motion of the part removed.
SHOWN, FITTED = VARIANTS[:2], "best fit"


@dataclass(frozen=True)
class CompensatedModel(ExactModel):
    """The exact model with the tables of a control active: they add to the command before the machine moves."""

    tables: ReadTables | None = None

    def error(
        self,
        position_mm: FloatArray,
        tool_mm: FloatArray,
        direction: FloatArray,
        taken_up: FloatArray | float = 1.0,
    ) -> FloatArray:
        """Return what the control adds plus the error where the machine then is."""
        if self.tables is None:
            return super().error(position_mm, tool_mm, direction, taken_up)
        tool = np.broadcast_to(tool_mm, position_mm.shape)
        added = self.tables.correction(self.machine, Points(position_mm, tool_mm=tool, approach=direction))
        return np.asarray(added + super().error(position_mm + added, tool_mm, direction, taken_up))

    @property
    def by_direction(self) -> bool:
        """Tables may act in one direction of travel."""
        return self.tables is not None or super().by_direction

    @functools.cached_property
    def bends(self) -> Bends | None:
        """Tables have nodes of their own."""
        return super().bends if self.tables is None else None

    def bend(self) -> float:
        """Add half the range of the slope of the tables, on nine lines along each axis."""
        total = super().bend()
        if self.tables is None:
            return total
        ends = [np.array(axis.range_mm) for axis in self.machine.axes]
        nodes_mm = self.tables.controller.table_nodes_mm(self.tables.tables)
        for axis, (low, high) in enumerate(ends):
            inside = nodes_mm[axis][(nodes_mm[axis] >= low) & (nodes_mm[axis] <= high)]
            levels = [np.array([part[0], part.mean(), part[1]]) for part in ends]
            levels[axis] = np.unique(np.concatenate([np.linspace(low, high, BEND_SAMPLES), inside]))
            points = np.moveaxis(full_grid(levels), axis, 0)
            flat = points.reshape(-1, 3)
            added = self.tables.correction(self.machine, Points(flat, approach=np.ones_like(flat))).reshape(
                points.shape
            )
            slopes = np.diff(added, axis=0) / np.diff(levels[axis])[:, None, None, None]
            total += 0.5 * float(np.linalg.norm(np.ptp(slopes, axis=0), axis=-1).max())
        return total


@dataclass(frozen=True)
class Feature:
    """One quantity of a feature: nominal size (mm, or degrees), its errors, and the standard uncertainty of the first.

    Errors are in um, those of angles in urad: ``error`` as the machine is, ``after`` with the tables of a control,
    ``corrected`` with a corrected program, ``both`` with tables and a program that corrects what they leave. They are nan
    where they were not asked for, ``u`` if the errors have no covariance.
    """

    name: str
    quantity: str
    line: int
    nominal: float
    unit: str
    error: float
    after: float
    corrected: float
    both: float
    u: float

    @property
    def best(self) -> float:
        """The error as the part is made: with all that corrects it."""
        given = (self.both, self.corrected, self.after, self.error)
        return next(value for value in given if not np.isnan(value))

    def as_dict(self) -> dict[str, Any]:
        """Return the feature for JSON; errors have their unit in the name, those that were not asked for are left out."""
        found: dict[str, Any] = {"name": self.name, "quantity": self.quantity, "line": self.line}
        found |= {"nominal": self.nominal, "unit": self.unit, f"error_{self.unit}": self.error}
        more = {"after": self.after, "corrected": self.corrected, "both": self.both}
        found |= {f"{key}_{self.unit}": value for key, value in more.items() if not np.isnan(value)}
        return {**found, f"u_{self.unit}": self.u}


def columns_of(features: Sequence[Feature]) -> dict[str, str]:
    """Return the errors that were asked for: field of the features and heading."""
    keys = zip(("error", "after", "corrected", "both"), ("error", *VARIANTS[1:]), strict=True)
    return {key: name for key, name in keys if any(not np.isnan(getattr(f, key)) for f in features)}


@dataclass(frozen=True)
class PartMachine:
    """A machine on which a part could be made: its errors, their covariance, and the tables that are active on its control."""

    name: str
    model: ExactModel
    covariance: Covariance | None = None
    tables: ReadTables | None = None

    @functools.cached_property
    def with_tables(self) -> CompensatedModel:
        """The machine with its tables active."""
        model = self.model
        return CompensatedModel(model.machine, model.errors, model.reversal, model.only, model.growth, self.tables)

    @functools.cached_property
    def posterior(self) -> Posterior | None:
        """What is known of all errors, also of those that were not measured; None without uncertainties or a prior."""
        if self.covariance is None:
            return None
        return posterior_with(self.model.machine, self.model.errors, self.covariance)

    def notes(self, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> list[str]:
        """Say what was not measured, and its share of what is not known at points (n, 3) with their tools."""
        if self.covariance is None:
            return ["the errors have no uncertainties, so that of the part is not known"]
        if self.posterior is None:
            return ["no prior: the uncertainty has nothing of errors that were not measured"]
        found = [assumed_text(self.posterior), worse_text(self.posterior)]
        shares = open_shares(self.posterior, position_mm, tool_mm) if len(position_mm) else {}
        if shares:
            named = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in list(shares.items())[:NAMED])
            found.append(
                f"errors that were not measured, or hardly, make {100.0 * sum(shares.values()):.0f} % of what is not known of "
                f"the part (variance of the tool along its path), most of all {named}"
            )
        return [text for text in found if text]


@dataclass(frozen=True)
class PartPrediction:
    """What a machine will leave on a part.

    ``figures`` are those of the machine as it is, ``after`` with the tables of a control, ``corrected`` with the program
    corrected for the bare machine, ``both`` with the tables and a program that corrects what they leave; None where not
    asked for. ``refused`` says why the part cannot be made on this machine. ``position_mm`` (n, 3) are points of the path, one of
    ``every`` samples and the one that is farthest off; ``deviation_mm`` has the vectors (n, 3) of the tool from the path there:
    "as the machine is" and "with tables", normal to the path, and both with the best-fit rigid motion removed, from the
    programmed point. A part that is clamped and touched off shows this "best fit": a shift of all of it is no error.
    """

    machine: str
    program: str
    figures: PathFigures
    after: PathFigures | None = None
    corrected: PathFigures | None = None
    both: PathFigures | None = None
    features: tuple[Feature, ...] = ()
    left_out: int = 0
    assumed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    refused: str = ""
    position_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)), repr=False)
    deviation_mm: Mapping[str, FloatArray] = field(default_factory=dict, repr=False)
    every: int = 1
    growth: Growth | None = None

    @property
    def fitted(self) -> dict[str, dict[str, float]]:
        """Largest, rms and 95 % of the points (um) with the best-fit rigid motion removed, by what is shown."""
        names = [name for name in SHOWN if f"{name}, {FITTED}" in self.deviation_mm and len(self.position_mm)]
        sizes = {name: np.linalg.norm(self.deviation_mm[f"{name}, {FITTED}"], axis=1) for name in names}
        return {name: figures_of(size) for name, size in sizes.items()}

    @property
    def variants(self) -> tuple[PathFigures, PathFigures | None, PathFigures | None, PathFigures | None]:
        """The figures as the machine is, with tables, with the program corrected, and with both."""
        return self.figures, self.after, self.corrected, self.both

    @property
    def best(self) -> PathFigures:
        """The figures as the part is made: with all that corrects it."""
        return self.both or self.corrected or self.after or self.figures

    @property
    def rank_figures(self) -> dict[str, float]:
        """Figures with the best-fit rigid motion removed, as the machine is used: with tables if it has any."""
        return list(self.fitted.values())[-1] if self.fitted else figures_of(np.zeros(1))

    def worst(self, unit: str) -> Feature | None:
        """Return the quantity with the largest error of those in ``unit``, um or urad; None without any."""
        return max((f for f in self.features if f.unit == unit), key=lambda f: abs(f.best), default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return the object of ``part.json``."""
        others = {"path_after": self.after, "path_corrected": self.corrected, "path_both": self.both}
        return {
            "machine": self.machine,
            "program": self.program,
            "path_mm": self.figures.length_mm,
            "path": self.figures.as_dict(),
            **{name: None if one is None else one.as_dict() for name, one in others.items()},
            "path_best_fit": self.fitted.get(SHOWN[0]),
            "path_after_best_fit": self.fitted.get(SHOWN[1]),
            "features": [feature.as_dict() for feature in self.features],
            "features_left_out": self.left_out,
            "assumed": list(self.assumed),
            "notes": list(self.notes),
            **({} if self.growth is None else {"heat": self.growth.as_dict()}),
        }

    def ranked(self) -> dict[str, Any]:
        """Return the entry of this machine in a ranking, for JSON."""
        if self.refused:
            return {"machine": self.machine, "refused": self.refused}
        worst = {unit: self.worst(unit) for unit in ("um", "urad")}
        return {
            "machine": self.machine,
            **self.best.as_dict(),
            "best_fit": self.rank_figures,
            **{f"worst_{unit}": None if f is None else f.as_dict() for unit, f in worst.items()},
        }


def predict_part(
    model: ExactModel,
    program: str | Path,
    dialect: str = "linuxcnc",
    setup: Setup = Setup(),  # noqa: B008 -- frozen
    *,
    covariance: Covariance | None = None,
    tables: ReadTables | None = None,
    correct: CorrectOptions | None = None,
    show: Callable[[str], None] = lambda _: None,
) -> PartPrediction:
    """Predict what the errors of a machine leave on the part of an NC program.

    Every move at feed is sampled on the exact model. Features are found in the program (:mod:`compgen.programs.features`).
    Their errors are weighted sums of the vectors of the tool at samples, so that the covariance of the errors gives their
    uncertainty.

    Parameters
    ----------
    model : the machine with its errors and reversal.
    program, dialect, setup : the program, how it is written, its work offsets and tools.
    covariance : of the errors, for the uncertainty of the features.
    tables : tables of the control; then figures and features are given with them, too.
    correct : how to correct the program (its dialect is ``dialect``); then figures and features are given with the corrected
        program as it is written, and with ``tables`` also with a program that corrects what these leave.
    show : called with the step that is running.
    """
    machine = PartMachine(model.machine.name, model, covariance, tables)
    return _on_machines([machine], program, dialect, setup, correct, show)[0]


def rank_machines(
    machines: Sequence[PartMachine],
    program: str | Path,
    dialect: str = "linuxcnc",
    setup: Setup = Setup(),  # noqa: B008 -- frozen
    *,
    show: Callable[[str], None] = lambda _: None,
) -> list[PartPrediction]:
    """Predict the part on several machines, each with its tables if it has any: the best first, those that cannot make it last.

    The best one has the smallest of the largest deviations with the best-fit rigid motion removed: where the part is clamped
    and how its zero is found is no property of the machine.
    """
    groups: dict[Any, list[PartMachine]] = {}
    for (
        machine
    ) in machines:  # without a tool length, the tool is that of the machine file; G28 leads to its reference point
        own = machine.model.machine
        groups.setdefault((own.tool_offset_mm, str(own.reference_place_mm), own.units), []).append(machine)
    found = []
    for group in groups.values():
        while group:
            try:
                found += _on_machines(group, program, dialect, setup, None, show)
                break
            except InputError as error:
                first = group.pop(0)
                found.append(PartPrediction(first.name, Path(program).name, PathFigures(), refused=str(error)))
    return sorted(found, key=lambda item: (bool(item.refused), item.rank_figures["max_um"]))


def _on_machines(
    machines: Sequence[PartMachine],
    program: str | Path,
    dialect: str,
    setup: Setup,
    correct: CorrectOptions | None,
    show: Callable[[str], None],
) -> list[PartPrediction]:
    """Read the program once, within the travel of the first machine, and evaluate it on all."""
    source, known = Path(program), dialect_named(dialect)
    read_bytes(source, 1)
    reader = Reader(machines[0].model.machine, known, setup, source)
    figures = [(PathFigures(), None if one.tables is None else PathFigures()) for one in machines]
    features, thinned, direction = PartFeatures(), [_Thinned() for _ in machines], np.zeros(3)
    for batch in read_twice(reader):
        if reader.unknown:
            continue  # it is refused at its end, with all that is not known
        moves = reader.numbered_as_in_file(batch.moves)
        number = np.arange(len(moves))
        if moves.phase.any():
            moves, number = _beside_contours(moves, machines, source)
            reader.assumed[BESIDE] = None
        ended = kept_directions(directions_at(moves, np.full(len(moves), 1.0 - 1e-7)), direction)
        directions = np.vstack([direction, ended[:-1]])[: len(moves)], ended
        direction = ended[-1] if len(moves) else direction
        rows = np.flatnonzero(moves.cutting)
        driven, shares = moves.part(rows), (np.zeros(len(rows)), np.ones(len(rows)))
        for machine, (before, after), points in zip(machines, figures, thinned, strict=True):
            kept: list[list[PathDeviations]] = [[], []]
            models = [(before, machine.model), *([] if after is None else [(after, machine.with_tables)])]
            for (own, model), parts in zip(models, kept, strict=False):
                for found in path_deviations(model, STEP_MM, moves, rows, driven, shares, directions):
                    own.add(found)
                    parts.append(found)
            points.add(*kept)
        drilled = {
            reader.in_file(item.number)
            for item in batch.segments
            if isinstance(item, SingleBlock) and item.kind in ("cycle", "hole")
        }
        features.add(moves, drilled, ended, number)
        show(f"{batch.first_line + len(batch.words.start) - 2} blocks")
    for machine in machines:
        machine.model.errors.warn_outside(reader.reached_mm)
    quantities = list(features.quantities())
    evaluated = _Evaluated(quantities)
    results = []
    for machine, (before, after), points in zip(machines, figures, thinned, strict=True):
        outside = _outside(machine, reader.reached_mm)
        if outside:
            results.append(PartPrediction(machine.name, source.name, PathFigures(), refused=outside))
            continue
        made: list[ProgramCorrection | None] = [None, None]
        commands: list[FloatArray | None] = [None, None]
        for which, model in enumerate((machine.model, machine.with_tables) if machine.tables else (machine.model,)):
            if correct is not None:
                follow, options = _Followed(evaluated.samples), replace(correct, dialect=dialect)
                with working_folder("part-") as folder:
                    made[which] = correct_program(model, source, folder, options, setup, show=show, follow=follow.add)
                commands[which] = follow.command_mm
        notes = [
            f"the corrected program{' with tables' if which else ''} is not acceptable: {reason}"
            for which, one in enumerate(made)
            for reason in (one.reasons if one is not None else ())
        ]
        position_mm, deviation_mm = points.points(tables=after is not None)
        notes += [] if machine.model.growth is None else machine.model.growth.lines()
        notes += machine.notes(*_some_of(evaluated.samples, position_mm))
        result = PartPrediction(
            machine.name,
            source.name,
            before,
            after,
            None if made[0] is None else made[0].after,
            None if made[1] is None else made[1].after,
            evaluated.features(machine, *commands),
            features.left_out(),
            tuple(reader.assumed),
            tuple(notes),
            position_mm=position_mm,
            deviation_mm=deviation_mm,
            every=points.every,
            growth=machine.model.growth,
        )
        results.append(result)
    return results


#: What figures and features are about where a contour has radius compensation.
BESIDE = "with radius compensation, figures and features are those of the path of the tool centre, with arcs about outer corners"


def _beside_contours(moves: Moves, machines: Sequence[PartMachine], source: Path) -> tuple[Moves, IntArray]:
    """Return the path of the tool centre, with arcs about outer corners, and the number of the move that each belongs to."""
    for machine in machines:
        for model in (machine.model, *([] if machine.tables is None else [machine.with_tables])):
            if unknown := unknown_radius(model, moves, MM_PER_UM):
                raise InputError(unknown.message, file=source, line=unknown.line)
    path = centre_path(moves)
    if path.problem:
        row, why = path.problem
        raise InputError(f"radius compensation: {why}", file=source, line=int(moves.line[row]))
    number = np.concatenate([np.arange(len(moves)), path.after])
    order = np.argsort(number, kind="stable")
    return Moves.joined([path.moves, path.corners]).part(order), number[order]


def _outside(machine: PartMachine, reached_mm: FloatArray) -> str:
    """Say where a program leaves the travel of a machine, "" if it does not."""
    for k, axis in enumerate(machine.model.machine.axes):
        (low, high), (least, most) = axis.range_mm, reached_mm[:, k]
        slack_mm = machine.model.machine.travel_margin_mm + 1e-6
        if least < low - slack_mm or most > high + slack_mm:
            where = f"{AXES[k]} goes from {least:.3f} to {most:.3f} mm of the machine"
            return f"{where}, outside its travel {low:g} to {high:g} mm; check --wcs and --tools"
    return ""


def _some_of(samples: Samples, path_mm: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Points (n, 3) of the part, of its features with their tools if it has any, else of its path."""
    position_mm, tool_mm = (samples.position_mm, samples.tool_mm) if len(samples.position_mm) else (path_mm, None)
    rows = np.unique(np.linspace(0, max(len(position_mm) - 1, 0), SHARE_POINTS).astype(np.int64))[: len(position_mm)]
    return position_mm[rows], None if tool_mm is None else np.broadcast_to(tool_mm, position_mm.shape)[rows]


class _Evaluated:
    """Quantities with the samples of all of them together, so that a machine is evaluated in one go."""

    def __init__(self, quantities: Sequence[Quantity]) -> None:
        self.quantities = quantities
        parts = [item.samples for item in quantities]
        nothing = Samples(np.zeros(0, dtype=np.int64), np.zeros(0), *(np.zeros((0, 3)) for _ in range(3)))
        self.samples = Samples.joined([nothing, *parts])
        ends = np.cumsum([0, *(len(part.share) for part in parts)])
        self.rows = [slice(int(low), int(high)) for low, high in zip(ends[:-1], ends[1:], strict=True)]

    def features(
        self, machine: PartMachine, corrected_mm: FloatArray | None, both_mm: FloatArray | None
    ) -> tuple[Feature, ...]:
        """Return all quantities on a machine; with the commands (n, 3) of corrected programs at the samples, if there are any."""
        at = self.samples.position_mm

        def off(model: ExactModel, command_mm: FloatArray | None) -> FloatArray | None:
            if command_mm is None:
                return None
            return command_mm - at + model.error(command_mm, self.samples.tool_mm, self.samples.direction)

        vectors = [
            off(machine.model, at),
            off(machine.with_tables, at if machine.tables is not None else None),
            off(machine.model, corrected_mm),
            off(machine.with_tables, both_mm),
        ]
        found = []
        for item, rows in zip(self.quantities, self.rows, strict=True):
            per = 1.0 / MM_PER_UM if item.unit == "um" else 1e6
            error, after, corrected, both = (
                np.nan if one is None else item.value(one[rows])[0] * per for one in vectors
            )
            u = np.nan
            if machine.covariance is not None and vectors[0] is not None:
                _, weight = item.value(vectors[0][rows])
                u = _u_of_feature(machine, item.samples, weight)
            values = (error, after, corrected, both, u * per)
            found.append(Feature(item.name, item.quantity, item.line, item.nominal, item.unit, *values))
        return tuple(found)


def _u_of_feature(machine: PartMachine, samples: Samples, weight: FloatArray) -> float:
    """Standard uncertainty of a figure whose derivatives by the errors at n samples are weights (n, 3), mm."""
    model, covariance = machine.model, machine.covariance
    assert covariance is not None
    posterior = machine.posterior
    # growth is the same at all samples: it cancels in sizes, and is whole in positions
    by_heat = 0.0 if model.growth is None else float(np.linalg.norm(weight.sum(axis=0) * model.growth.u_mm))
    if posterior is not None:
        return math.hypot(posterior.field(samples.position_mm, samples.tool_mm).u_of(weight), by_heat)
    design = error_design(model.machine, covariance, samples.position_mm, samples.tool_mm)
    own = float(np.linalg.norm(np.einsum("nk,nkp->p", weight, design) @ covariance.errors_factor))
    return math.hypot(own, by_heat)


class _Followed:
    """Finds the commands (n, 3) of a corrected program at samples of the program, batch by batch; nan where it has none."""

    def __init__(self, samples: Samples) -> None:
        self._order = np.argsort(samples.move, kind="stable")
        self._move, self._share = samples.move[self._order], samples.share[self._order]
        self.command_mm = np.full(samples.position_mm.shape, np.nan)
        self._passed = 0

    def add(self, wanted: Moves, owner: IntArray, driven: Moves, low: FloatArray, high: FloatArray) -> None:
        """Take the moves of a batch; ``driven`` are corrected moves of ``owner`` between its shares ``low`` and ``high``."""
        rows = slice(*np.searchsorted(self._move, [self._passed, self._passed + len(wanted)]).tolist())
        where = self._move[rows] - self._passed + np.minimum(self._share[rows], 1.0 - 1e-9)
        self._passed += len(wanted)
        if not len(where):
            return
        piece = np.searchsorted(owner + low, where, side="right") - 1
        width = np.maximum(high - low, 1e-12)[piece]
        share = np.clip((self._share[rows] - low[piece]) / width, 0.0, 1.0)
        self.command_mm[self._order[rows]] = points_of(driven.part(piece), share)


class _Thinned:
    """Keeps points of a path of any length, evenly, and the one that is farthest off."""

    def __init__(self) -> None:
        self.every, self.passed = 1, 0
        self.kept = np.zeros((0, 15))
        self.worst = np.zeros((0, 15))

    def add(self, before: Sequence[PathDeviations], after: Sequence[PathDeviations]) -> None:
        """Take the samples of a batch, as the machine is and, unless that is empty, with tables."""
        for k, found in enumerate(before):
            other = after[k] if after else found
            every = np.hstack([found.position_mm, found.normal_mm, other.normal_mm, found.whole_mm, other.whole_mm])
            farthest = every[[int(np.argmax(np.linalg.norm(found.normal_mm, axis=1)))]]
            if not len(self.worst) or np.linalg.norm(farthest[:, 3:6]) > np.linalg.norm(self.worst[:, 3:6]):
                self.worst = farthest
            self.kept = np.concatenate([self.kept, every[-self.passed % self.every :: self.every]])
            self.passed += len(every)
            while len(self.kept) > MOST_POINTS:
                self.kept, self.every = self.kept[::2], 2 * self.every

    def points(self, *, tables: bool) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return positions (n, 3) and deviations (n, 3) by what is shown, see :class:`PartPrediction`."""
        rows = np.concatenate([self.kept, self.worst])
        found = {}
        for k, name in enumerate(SHOWN if tables else SHOWN[:1]):
            found[name] = rows[:, 3 + 3 * k : 6 + 3 * k]
            whole = rows[:, 9 + 3 * k : 12 + 3 * k]
            found[f"{name}, {FITTED}"] = without_rigid_motion(rows[:, :3], whole) if len(rows) else whole
        return rows[:, :3], found
