"""Read and identify a measurement of any kind, detected by its columns: lengths, positions, axis runs, six-DOF readings.

The code for a kind is imported when a file of that kind is read.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths, read_lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.records import detect_format, may_be_large
from compgen.errors import CompgenWarning, InputError, Message, UndeterminedError, um_text
from compgen.identification.adjust.propagation import SystematicInputs
from compgen.identification.kinds import Measurement, MixedMeasurement, OneKind
from compgen.identification.options import IdentifyOptions
from compgen.identification.result import Identification, at_nodes, determines_all
from compgen.identification.tracer_lengths import identify

if TYPE_CHECKING:
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Artefact, Deviations
    from compgen.identification.posterior import Posterior


def read_measurement(paths: Sequence[str | Path], instrument: str | Path | None = None) -> Measurement:
    """Read measurement files by their columns: lengths, deviations, parts, artefacts, axis runs, circles, six-DOF readings.

    Parameters
    ----------
    paths : files of any kinds; those of one kind are one measurement.
    instrument : the instrument TOML of the six-DOF readings.

    Raises
    ------
    InputError
        for six-DOF readings without an instrument file, or one without such readings.
    """
    if len(paths) == 1 and instrument is None and may_be_large(paths[0]):
        from compgen.data.length_archive import open_large

        large = open_large(paths[0])
        if large is not None:
            return large
    kinds: dict[str, list[str | Path]] = {}
    for path in paths:
        found = detect_format(path)  # of a file that is no measurement, the reader of lengths says best what is missing
        kinds.setdefault(
            found
            if found in ("part", "artefact", "axis", "circle", "deviations", "sixdof", "diagonals", "sphere", "bar")
            else "lengths",
            [],
        ).append(path)
    if "diagonals" in kinds:
        text = "contains measured diagonals, from which no errors can be identified; use accuracy or compare"
        raise InputError(text, file=kinds["diagonals"][0])
    for kind in ("sphere", "bar"):
        if kind in kinds:
            text = (
                "contains readings at poses of rotary axes, which volcomp identify, run and diagnose evaluate; to compare two of "
                "them, identify each and compare their errors and u in identify.json"
            )
            raise InputError(text, file=kinds[kind][0])
    if "sixdof" in kinds and instrument is None:
        message = (
            "contains six-DOF readings, which require the constants of their instrument; give --instrument FILE (TOML)"
        )
        raise InputError(message, file=kinds["sixdof"][0])
    if instrument is not None and "sixdof" not in kinds:
        raise InputError(
            f"--instrument {instrument} was given, but no file contains six-DOF readings (*.sixdof.csv with axis, "
            "position_mm, y_qd1_mm, ...)"
        )
    if not kinds or set(kinds) == {"lengths"}:
        return read_lengths(paths)
    from compgen.data.axis_runs import read_axis_runs
    from compgen.data.circles import read_circles
    from compgen.data.deviations import read_artefacts, read_deviations, read_parts

    readers: dict[str, Callable[[Sequence[str | Path]], OneKind]] = {
        "lengths": read_lengths,
        "artefact": read_artefacts,
        "axis": read_axis_runs,
        "circle": read_circles,
        "deviations": read_deviations,
        "part": read_parts,
    }
    if instrument is not None:
        from compgen.identification.six_dof import SixDofMeasurement
        from compgen.instruments.sixdof_instrument import read_instrument, read_sixdof

        constants = read_instrument(str(instrument))
        readers["sixdof"] = lambda files: SixDofMeasurement(read_sixdof(files), constants)
    parts = [(_names(files), readers[kind](files)) for kind, files in kinds.items()]
    return parts[0][1] if len(parts) == 1 else MixedMeasurement(tuple(parts))


def _names(files: Sequence[str | Path]) -> str:
    names = [Path(file).name for file in files]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def describe(measurement: Measurement | ErrorTable) -> str:
    """Say in words what was measured."""
    if isinstance(measurement, Lengths):
        return f"{len(measurement)} lengths of {len(measurement.stations)} stations"
    if isinstance(measurement, ErrorTable):
        return f"{len(measurement.names)} known errors"
    if isinstance(measurement, MixedMeasurement):
        return ", ".join(describe(part) for _, part in measurement.parts)
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import PART, Artefact, Deviations
    from compgen.data.length_archive import LengthArchive

    if isinstance(measurement, LengthArchive):
        return f"{len(measurement)} lengths of {len(measurement.stations)} stations"
    if isinstance(measurement, Deviations):
        what = "features of parts" if measurement.metadata.get("measured") == PART else "measured positions"
        return f"{len(measurement)} {what}"
    if isinstance(measurement, Artefact):
        return f"{len(measurement)} features of artefacts in {len(np.unique(measurement.setup))} set-ups"
    if isinstance(measurement, Circles):
        return f"{len(measurement)} readings along circles in {', '.join(measurement.planes)}"
    if isinstance(measurement, AxisRuns):
        return f"{len(measurement)} readings along {', '.join(AXES[axis] for axis in measurement.axes)}"
    return f"{len(measurement)} six-DOF readings in {len(measurement.readings.runs())} runs"


def identify_measurement(
    machine: Machine, measurement: Measurement, options: IdentifyOptions | None = None
) -> Identification:
    """Identify from any kind or mixture, with the prior of the machine file; InputError for options of another kind."""
    chosen = options or IdentifyOptions()
    if isinstance(measurement, MixedMeasurement):
        return identify_mixed(machine, measurement, chosen, {})
    alone = _least_squares(machine, measurement, chosen)
    return known_alone(machine, measurement, alone, chosen)


def known_alone(
    machine: Machine, measurement: OneKind | None, alone: Identification, options: IdentifyOptions
) -> Identification:
    """Return the result of one measurement with what the prior of the machine file says of the rest."""
    if measurement is not None:
        alone = replace(alone, notes=unseen(machine, [measurement]))
    learn = machine.prior.learn in ("up", "both")
    on_nodes = not isinstance(measurement, Lengths) or at_nodes(machine, measurement.position_mm)
    if not machine.prior.is_none and on_nodes and determines_all(machine, alone):
        # what adjusts mixtures is loaded only when it is asked for
        def later() -> Posterior:
            from compgen.identification.together import Source, posterior_of

            return posterior_of(machine, [Source("", measurement, alone)], options, alone, learn=learn)[0]

        return replace(alone, posterior_source=later)
    from compgen.identification.together import Source, with_prior

    return with_prior(machine, [Source("", measurement, alone)], alone, options)


def _least_squares(machine: Machine, measurement: OneKind, chosen: IdentifyOptions) -> Identification:
    """Identify what the readings of one kind determine by themselves; InputError for options of another kind."""
    if isinstance(measurement, Lengths):
        if chosen.u_deviation_um is not None:
            raise InputError(
                Message(
                    "u-deviation-with-lengths",
                    "an uncertainty of deviations (--u-deviation-um) was given, but the files contain lengths",
                )
            )
        return identify(machine, measurement, chosen)
    from compgen.data.length_archive import LengthArchive

    if isinstance(measurement, LengthArchive):
        from compgen.identification.streamed_lengths import identify_archive

        return identify_archive(machine, measurement, chosen)
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Artefact, Deviations
    from compgen.identification.axis_tests import check_ways, identify_axis_runs, identify_circles
    from compgen.identification.positions import identify_artefact, identify_deviations
    from compgen.identification.six_dof import identify_sixdof
    from compgen.identification.slips import check_sizes

    if isinstance(measurement, Deviations | AxisRuns | Circles) and not chosen.small_deviations:
        check_sizes(measurement)
    _check_options(measurement, chosen)
    if isinstance(measurement, Deviations):
        return _with_slips(identify_deviations(machine, measurement, chosen), measurement)
    if isinstance(measurement, Artefact):
        return identify_artefact(machine, measurement, chosen)
    if isinstance(measurement, AxisRuns):
        return _with_slips(identify_axis_runs(machine, measurement), measurement)
    if isinstance(measurement, Circles):
        check_ways(machine, measurement)
        return _with_slips(identify_circles(machine, measurement), measurement)
    return identify_sixdof(machine, measurement)


def _with_slips(result: Identification, measurement: Deviations | AxisRuns | Circles) -> Identification:
    """Return a result with objections to runs that disagree with the others in a pattern, and doubts about copies."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.identification.slips import copies, patterns

    found = patterns(measurement)
    doubled = copies(measurement) if isinstance(measurement, AxisRuns) else ()
    for text in (*found, *doubled):
        warnings.warn(text, CompgenWarning, stacklevel=2)
    return replace(result, objections=(*result.objections, *found), doubts=(*result.doubts, *doubled))


def _check_options(measurement: OneKind, options: IdentifyOptions) -> None:
    """InputError for options of lengths or of deviations that the kind of measurement does not take."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Artefact, Deviations

    stated = options.u_length_um is not None or options.u_length_um_per_m is not None
    other = stated or options.method != "joint" or options.stations is not None
    other = other or options.systematic != SystematicInputs() or options.nodes != "machine"
    if isinstance(measurement, Deviations):
        text = (
            "--method, --stations, --nodes, --u-length-... and the systematic inputs apply to tracer lengths; the files contain "
            "deviations, for which use --u-deviation-um"
        )
    elif isinstance(measurement, Artefact):
        text = (
            "--method, --stations, --nodes, --u-length-... apply to tracer lengths; the files contain an artefact, which takes "
            "--u-deviation-um"
        )
    elif isinstance(measurement, AxisRuns | Circles):
        what = "axis runs" if isinstance(measurement, AxisRuns) else "circles"
        text = (
            f"--method, --stations, --nodes, --u-... apply to other kinds of measurement; the files contain {what}, whose "
            "uncertainty comes from their scatter"
        )
    else:
        text = (
            "--method, --stations, --nodes, --u-... apply to tracer lengths and deviations; the files contain six-DOF readings, "
            "whose uncertainties the instrument file gives ([noise], [u_constants], [u_systematics])"
        )
    takes_u = isinstance(measurement, Deviations | Artefact)
    if other or (options.u_deviation_um is not None and not takes_u):
        raise InputError(text)


def identify_mixed(
    machine: Machine, measurement: MixedMeasurement, options: IdentifyOptions, known: Mapping[str, Identification]
) -> Identification:
    """Identify every part of a mixture alone as far as it goes, and all of them together.

    ``known`` are the errors that are known otherwise, by the name of their part.
    """
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.deviations import Artefact, Deviations
    from compgen.identification.six_dof import SixDofMeasurement
    from compgen.identification.together import Source, identify_together, merge, with_prior
    from compgen.identification.tracer_lengths import MIN_STATIONS

    parts, plain = [], IdentifyOptions()
    unless_lengths = replace(
        options,
        u_length_um=None,
        u_length_um_per_m=None,
        method=plain.method,
        stations=None,
        systematic=plain.systematic,
    )
    for name, part in measurement.parts:
        if isinstance(part, ErrorTable):
            parts.append(Source(name, None, known[name]))
            continue
        # of the options, those that apply to this kind
        probed = isinstance(part, Deviations | Artefact)
        applicable = replace(
            options if isinstance(part, Lengths) else unless_lengths,
            u_deviation_um=options.u_deviation_um if probed else None,
        )
        try:
            with warnings.catch_warnings():
                if isinstance(part, AxisRuns | Artefact):  # they warn of what others may have measured
                    warnings.simplefilter("ignore", CompgenWarning)
                if isinstance(part, Lengths) and len(part.stations) < MIN_STATIONS and applicable.stations is None:
                    alone = None
                else:
                    alone = _least_squares(machine, part, applicable)
        except UndeterminedError:
            if not isinstance(part, Deviations | Artefact | Lengths):
                raise
            alone = None
        parts.append(Source(name, part, alone))
    # six-DOF readings measure all errors: compared with those of one other instrument, and averaged
    posed = [part.alone for part in parts if isinstance(part.measurement, SixDofMeasurement)]
    others = [part.alone for part in parts if isinstance(part.measurement, Lengths | Deviations)]
    if len(parts) == 2 and posed and posed[0] is not None and others and others[0] is not None:
        merged = merge(machine, others[0], posed[0])
        return with_prior(machine, [Source("", None, merged)], merged, options)
    together = identify_together(machine, parts, options)
    together = replace(together, notes=unseen(machine, [part for _, part in measurement.parts]))
    return with_prior(machine, parts, together, options)


# What readings cannot show although it makes the errors wrong, and the check that would show it.


#: Set-ups of a plate count as turned in its plane if the sine of the angle between its axes is at least this, and the
#: cosine of that between its normals.
TURNED, STILL_FLAT = 0.5, 0.9


def unseen(machine: Machine, parts: Sequence[OneKind | ErrorTable]) -> tuple[str, ...]:
    """Return what no residual of these readings shows: a plate that is not square, runs at another temperature."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.deviations import Artefact
    from compgen.identification.axis_tests import temperatures_read

    found: list[str] = []
    for k, part in enumerate(parts):
        others = [*parts[:k], *parts[k + 1 :]]
        if isinstance(part, Artefact) and part.calibrated.all():
            found += _unseen_in_plate(part, others)
        elif isinstance(part, AxisRuns):
            if not temperatures_read(part):
                found.append(_unseen_in_runs(machine, part))
            found += _assumed_of_lines(machine, part)
    return tuple(dict.fromkeys(found))


def _unseen_in_runs(machine: Machine, runs: AxisRuns) -> str:
    """A run at another temperature than stated."""
    from compgen.identification.axis_tests import U_NOT_READ_K, USUAL_EXPANSION

    stated = [machine.axes[axis].expansion_um_per_m_k or 1e6 * USUAL_EXPANSION for axis in runs.axes]
    letters = ", ".join(AXES[axis] for axis in runs.axes)
    return (
        f"runs of {letters} at another temperature than 20 degC, or than the instrument assumed, would have the same residuals "
        f"and a wrong scale ({max(stated):.3g} um/m for each K); their file has no temperatures of axes or material, so u allows "
        f"for {U_NOT_READ_K:g} K. Read the temperatures of axis and instrument (columns temp_x_c ...), or measure a length "
        "standard at the other end of the travel"
    )


def _assumed_of_lines(machine: Machine, runs: AxisRuns) -> Iterator[str]:
    """Where in the volume the laser was, if nobody said it: what is assumed, what it costs, and how to state it."""
    from compgen.identification.axis_tests import unstated_lines

    if machine.prior.is_none:
        return
    costs = unstated_lines(machine, runs)
    if not costs:
        return
    parts = ", ".join(f"{um_text(cost)} um in {AXES[axis]}" for axis, (cost, _) in costs.items())
    letters = dict.fromkeys(letter for _, others in costs.values() for letter in others)
    keys = " and ".join(f"# line_{letter.lower()}_mm = ..." for letter in sorted(letters))
    yield (
        f"where in the volume the runs of {', '.join(AXES[axis] for axis in costs)} were measured is not stated: it is assumed "
        f"to be anywhere in the travel, where angles move the tool, which adds to u (rms along the axis) {parts}. Where was the "
        f"laser? State the positions of the axes that did not move in the file, {keys} (or columns of these names)"
    )


def _unseen_in_plate(plate: Artefact, others: Sequence[OneKind | ErrorTable]) -> Iterator[str]:
    """A calibrated plate that is itself out of square, or at another temperature than when it was calibrated."""
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Artefact, Deviations
    from compgen.identification.six_dof import SixDofMeasurement

    whole = (Lengths, Deviations, SixDofMeasurement)
    squares = [part for part in others if isinstance(part, ErrorTable) and part.squareness]
    if not (squares or any(isinstance(part, (*whole, Circles, Artefact)) for part in others) or _turned(plate)):
        yield (
            "a plate whose own axes are not square to each other (wrong calibration, bent by its clamps) would have the same "
            "residuals, and its angle would count as squareness of the machine: measure it once more, turned by 90 degrees"
        )
    if not any(isinstance(part, (*whole, AxisRuns)) for part in others):
        yield (
            "a plate at another temperature than that of its calibration would have the same residuals and a wrong scale of the "
            "axes: read its temperature, or measure a length standard as well"
        )


def _turned(plate: Artefact) -> bool:
    """Whether a plate lay in two directions that differ, in its own plane: only then its angle is not the machine's."""
    turns = []
    for setup in np.unique(plate.setup).tolist():
        own = plate.setup == setup
        nominal, measured = plate.nominal_mm[own], np.nan_to_num(plate.measured_mm[own])
        left, _, right = np.linalg.svd((measured - measured.mean(axis=0)).T @ (nominal - nominal.mean(axis=0)))
        turns.append(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)  # fits best (Kabsch 1976)
    axes = np.linalg.svd(plate.nominal_mm - plate.nominal_mm.mean(axis=0))[2]  # the last one is across the plate
    for k, one in enumerate(turns):
        for other in turns[:k]:
            relative = axes @ other.T @ one @ axes.T
            if abs(relative[2, 2]) > STILL_FLAT and abs(relative[0, 1]) > TURNED:
                return True
    return False


# What a later report needs in addition to the results of an identification: the machine file, and the residuals.


def evidence_files(
    machine: Machine, measurement: Measurement | ErrorTable, result: Identification
) -> dict[str, str | bytes]:
    """Return ``machine.toml``, the machine file byte by byte, and ``residuals.csv`` if anything was read."""
    files: dict[str, str | bytes] = {}
    if len(result.residual_mm):
        files["residuals.csv"] = format_residuals(machine, measurement, result)
    if machine.file is not None and machine.file.is_file():
        files["machine.toml"] = machine.file.read_bytes()
    return files


#: Comments of a measurement on instrument and operator; the report shows them.
MEASURED_WITH = ("instrument", "serial_number", "operator")


def format_residuals(machine: Machine, measurement: Measurement | ErrorTable, result: Identification) -> str:
    """Return the text of ``residuals.csv``: measurement minus model of every reading, um, in the order of the files.

    ``used`` is 0 for rejected readings; lengths have columns for station and commanded position, circles those of
    their diagram. Comments of the measurement about instrument and operator are kept.
    """
    from compgen.data.circles import Circles, circle_columns

    columns: dict[str, Sequence[str] | FloatArray] = {}
    if not isinstance(measurement, Lengths):
        from compgen.data.length_archive import LengthArchive

        if isinstance(measurement, LengthArchive):
            measurement = measurement.taken(measurement.sample_rows)
    if isinstance(measurement, Lengths) and len(measurement) == len(result.residual_mm):
        columns["station"] = [measurement.stations[k] for k in measurement.station.tolist()]
        columns |= {f"{axis}_mm": measurement.position_mm[:, k] for k, axis in enumerate("xyz")}
    if isinstance(measurement, Circles) and len(measurement) == len(result.residual_mm):
        columns |= circle_columns(measurement)
    columns["residual_um"] = -result.residual_mm / MM_PER_UM
    columns["used"] = result.accepted.astype(np.float64)
    whole = dict.fromkeys(("used", "direction", "run", "setup"), 0)
    digits = {"x_mm": 3, "y_mm": 3, "z_mm": 3, "residual_um": 4, "deviation_um": 4, **whole}
    described = measurement.first() if isinstance(measurement, MixedMeasurement) else measurement
    metadata = {} if described is None else described.metadata
    stated = {key: metadata[key] for key in MEASURED_WITH if metadata.get(key)}
    return format_csv(columns, {"machine": machine.name, "method": result.method, **stated}, digits)
