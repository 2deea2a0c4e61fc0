"""``volcomp diagnose --each``: every measurement by itself, in this process, in several, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgen.cli.common import print_json, stdout
from compgen.cli.parallel_options import mapper
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.core.threads import one_thread
from compgen.diagnose import AxisDiagnosis, DiagnoseOptions, Diagnosis, diagnose
from compgen.diagnose.files import diagnosis_files, json_text
from compgen.diagnose.measurement import read_diagnosed
from compgen.diagnose.sixdof import SixDofDiagnosis, diagnose_sixdof, sixdof_text
from compgen.errors import CompgenError, InputError
from compgen.sixdof.instrument import read_instrument
from compgen.sixdof.readings import read_sixdof

Show = Callable[[str], None]


@dataclass(frozen=True)
class Asked:
    """What is asked of measurements; it can be sent to another process."""

    machine: Machine
    options: DiagnoseOptions
    instrument: Path | None

    def __call__(self, path: Path) -> Found:
        """Diagnose one measurement; what cannot be used becomes part of what was found."""
        try:
            with one_thread():
                found, contents = diagnosed(self, (path,), lambda _: None)
        except CompgenError as error:
            return Found({}, {"error": str(error)}, acceptable=False)
        return Found(contents, found.to_dict(), acceptable=found.acceptable)


@dataclass(frozen=True)
class Found:
    """Files of a diagnosis by name, its figures, and whether it is acceptable."""

    contents: dict[str, str | bytes]
    figures: dict[str, Any]
    acceptable: bool


def diagnosed(
    asked: Asked, measurements: Sequence[Path], show: Show
) -> tuple[Diagnosis | AxisDiagnosis | SixDofDiagnosis, dict[str, str | bytes]]:
    """Diagnose files as one measurement; return the diagnosis and its files by name."""
    if asked.instrument is None:
        found = diagnose(asked.machine, read_diagnosed(measurements), asked.options, show=show)
        show("drawing")
        return found, dict(diagnosis_files(found))
    if asked.options.against is not None or asked.options.effects or asked.options.add:
        raise InputError("--against, --effects and --add do not belong to six-DOF readings")
    readings = diagnose_sixdof(asked.machine, read_sixdof(measurements), read_instrument(asked.instrument))
    return readings, {"diagnosis.json": json_text(readings.to_dict()), "diagnosis.md": sixdof_text(readings)}


def diagnose_each(
    asked: Asked, measurements: Sequence[Path], out: Path, spread: tuple[int, str | None], *, as_json: bool
) -> int:
    """Diagnose every measurement into a folder of its own; the exit code is 1 if any is not acceptable."""
    names = [path.name.split(".")[0] for path in measurements]
    twice = sorted({name for name in names if names.count(name) > 1 or not name})
    if twice:
        raise InputError(f"the folder {twice[0]!r} would hold two diagnoses; rename the measurements", field="--each")
    results: list[dict[str, Any]] = []
    with mapper(*spread) as share:
        for name, path, found in zip(names, measurements, share(asked, measurements), strict=True):
            files = OutputFolder(out / name)
            for file, content in found.contents.items():
                files.add(file, content)
            files.commit()
            results.append({"measurement": str(path), "acceptable": found.acceptable, **found.figures})
            if not as_json:
                said = found.figures.get("error") or found.figures.get("verdict") or ""
                stdout.print(f"{path}: {said}", soft_wrap=True)
    if as_json:
        print_json({"accepted": all(item["acceptable"] for item in results), "measurements": results})
    return 0 if all(item["acceptable"] for item in results) else 1
