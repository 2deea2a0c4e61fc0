"""``volcomp diagnose``: where model and measurement disagree, for one measurement or for each of many."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from compgen.cli.common import (
    fleet_options,
    for_readers,
    json_option,
    language_option,
    options_of,
    out_option,
)
from compgen.cli.identify_commands import diagnose_rotary, of_rotary_axes
from compgen.cli.output import print_json
from compgen.cli.shared_options import (
    heat_of_readings_options,
    instrument_option,
    machine_argument,
    mapper,
    measurements_argument,
)
from compgen.cli.terminal import progress, say
from compgen.controls.isg_kernel import read_error_file
from compgen.data.files import OutputFolder, json_text
from compgen.data.machine import Machine
from compgen.diagnose import AxisDiagnosis, CircleDiagnosis, DiagnoseOptions, Diagnosis, diagnose
from compgen.diagnose.any_diagnosis import SixDofDiagnosis, diagnose_sixdof, sixdof_text
from compgen.diagnose.feature_diagnosis import FeatureDiagnosis
from compgen.diagnose.observed import Measurement, read_diagnosed
from compgen.diagnose.page import diagnosis_files, next_steps, summary, told
from compgen.errors import CompgenError, CompgenWarning, InputError
from compgen.instruments.sixdof_instrument import read_instrument, read_sixdof
from compgen.kinematics.kernel_switch import one_thread

if TYPE_CHECKING:
    from compgen.identification.heat_of_readings import HeatSource

# ``volcomp diagnose --each``: every measurement separately, in this process, in several, or on a cluster.


Show = Callable[[str], None]


@dataclass(frozen=True)
class DiagnoseRequest:
    """How to diagnose measurements; can be sent to another process."""

    machine: Machine
    options: DiagnoseOptions
    instrument: Path | None
    heat: HeatSource | None = None

    def __call__(self, path: Path) -> DiagnosedMeasurement:
        """Diagnose one measurement; a file that cannot be used is part of the result."""
        try:
            with one_thread():
                found, contents = diagnosed(self, (path,), lambda _: None)
        except CompgenError as error:
            return DiagnosedMeasurement({}, {"error": str(error)}, acceptable=False)
        return DiagnosedMeasurement(contents, found.to_dict(), acceptable=found.acceptable)


@dataclass(frozen=True)
class DiagnosedMeasurement:
    """Files of a diagnosis by name, its figures, and whether it is acceptable."""

    contents: dict[str, str | bytes]
    figures: dict[str, Any]
    acceptable: bool


def diagnosed(
    request: DiagnoseRequest, measurements: Sequence[Path], show: Show
) -> tuple[Diagnosis | AxisDiagnosis | CircleDiagnosis | FeatureDiagnosis | SixDofDiagnosis, dict[str, str | bytes]]:
    """Diagnose files as one measurement; return the diagnosis and its files by name."""
    if request.instrument is None:
        read = read_diagnosed(measurements)
        if request.heat is not None:
            read = _at_reference(request.machine, read, request.heat)
        found = diagnose(request.machine, read, request.options, show=show)
        show("drawing")
        return found, dict(diagnosis_files(found))
    if request.options.against is not None or request.options.effects or request.options.add:
        raise InputError("--against, --effects and --add cannot be used with six-DOF readings")
    readings = diagnose_sixdof(request.machine, read_sixdof(measurements), read_instrument(request.instrument))
    return readings, {"diagnosis.json": json_text(readings.to_dict()), "diagnosis.md": sixdof_text(readings)}


def _at_reference(machine: Machine, measurement: Measurement, heat: HeatSource) -> Measurement:
    """Return the readings without the growth that a model of heat tells; what remains of heat is to be found."""
    from compgen.identification.heat_of_readings import at_reference_heat

    found = at_reference_heat(machine, measurement, heat)
    warnings.warn(found.says(), CompgenWarning, stacklevel=2)
    return cast("Measurement", found.measurement)


def diagnose_each(
    request: DiagnoseRequest,
    measurements: Sequence[Path],
    out: Path,
    spread: tuple[int, str | None],
    language: str,
    *,
    as_json: bool,
) -> int:
    """Diagnose every measurement into its own folder; the exit code is 1 if any is not acceptable."""
    names = [path.name.split(".")[0] for path in measurements]
    twice = sorted({name for name in names if names.count(name) > 1 or not name})
    if twice:
        raise InputError(
            f"the folder {twice[0]!r} would receive two diagnoses; rename the measurements", field="--each"
        )
    results: list[dict[str, Any]] = []
    with mapper(*spread) as share:
        for name, path, found in zip(names, measurements, share(request, measurements), strict=True):
            files = OutputFolder(out / name)
            for file, content in for_readers(found.contents, language).items():
                files.add(file, content)
            files.commit()
            results.append({"measurement": str(path), "acceptable": found.acceptable, **found.figures})
            if not as_json:
                verdict = found.figures.get("error") or found.figures.get("verdict") or ""
                say(f"{path}: {verdict}")
    if as_json:
        print_json({"accepted": all(item["acceptable"] for item in results), "measurements": results})
    return 0 if all(item["acceptable"] for item in results) else 1


# ``volcomp diagnose``.


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


@click.command("diagnose")
@machine_argument
@measurements_argument
@out_option
@options_of(DiagnoseOptions, "options", read={"effects": _names, "against": read_error_file})
@instrument_option
@heat_of_readings_options
@click.option(
    "--each", is_flag=True, help="Diagnose each measurement separately, into a folder of --out with its name."
)
@fleet_options
@language_option
@json_option
def diagnose_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    out: Path,
    options: DiagnoseOptions,
    instrument: Path | None,
    heat: HeatSource | None,
    each: bool,
    workers: int,
    cluster: str | None,
    language: str,
    as_json: bool,
) -> int:
    """Find where model and measurement disagree, name the missing effect, add it, and check that the misfit shrinks.

    MEASUREMENTS are *.lengths.csv (mm), *.deviations.csv, *.axis.csv or *.circle.csv files (um), *.part.csv or
    *.artefact.csv files (mm), or *.sixdof.csv files (mm) with --instrument, which are checked for errors of the
    instrument itself. Writes diagnosis.json, diagnosis.md, pages with pictures (index.html), and extended.toml: the
    machine with the effects that were found, to be used as MACHINE in the next command. For axis runs (ISO 230-2) also
    removed.csv: what was subtracted from each reading.

    *.sphere.csv, and *.axis.csv with angles, of a machine with rotary axes: diagnosis.json and diagnosis.md say what they
    betray of the probe, of the sense of an axis and of misfit, and what they cannot tell apart.

    --each diagnoses every file separately; --workers and --cluster distribute them.

    Exit code 1: not decidable, or the misfit does not shrink on lines that were left out.

    \b
    Example:
      volcomp diagnose zha-gantry lengths.csv --out diagnosis/
    """
    OutputFolder(out)
    if any(of_rotary_axes(path) for path in measurements):
        return diagnose_rotary(machine, measurements, out, as_json)
    request = DiagnoseRequest(machine, options, instrument, heat)
    if each:
        return diagnose_each(request, measurements, out, (workers, cluster), language, as_json=as_json)
    if workers > 1 or cluster is not None:
        raise InputError("--workers and --cluster need --each: they distribute its measurements")
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        found, contents = diagnosed(request, measurements, show)
    files = OutputFolder(out)
    for name, content in for_readers(contents, language).items():
        files.add(name, content)
    files.commit()
    if as_json:
        print_json(told(found.to_dict()))
    else:
        data = told(found.to_dict())
        say(str(contents["diagnosis.md"]) if instrument is not None else summary(machine.name, data, markdown=False))
        steps = next_steps(contents, str(machine.source or machine.name), " ".join(map(str, measurements)), str(out))
        if steps:
            say(steps)
    return 0 if found.acceptable else 1
