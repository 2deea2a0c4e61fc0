"""Readable summaries for the terminal, and the JSON of ``compgen run``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.core.names import error_named
from compgen.fit import FitResult
from compgen.identify import Identification
from compgen.pipeline import RunResult
from compgen.verify import Verification


def identification_table(result: Identification) -> Group:
    """Return the summary of an identification."""
    lines = [
        f"{int(result.accepted.sum())} of {len(result.accepted)} lengths used, {len(result.stations)} stations, "
        f"rank {result.rank} of {result.unknowns} unknowns",
        f"residual {result.rms_um:.3f} um rms, reduced chi-square {result.reduced_chi_square:.3f} "
        f"({result.degrees_of_freedom} degrees of freedom, {result.u_source} uncertainty "
        f"{result.u_length_um:g} um + {result.u_length_um_per_m:g} um/m)",
    ]
    lines += [
        f"rejected: {item.station} point {item.point} (line {item.line}): {item.reason}"
        for item in result.rejected[:10]
    ]
    if len(result.rejected) > 10:
        lines.append(f"... and {len(result.rejected) - 10} more in identify.json")
    table = Table(
        "error",
        "largest",
        "at (mm)",
        "u (k = 1)",
        "unit",
        title="identified errors",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE,
    )
    for name in result.errors.names:
        unit = error_named(name).si_per_unit
        if name in result.errors.squareness:
            value, u = result.errors.squareness[name]
            table.add_row(name, f"{value / unit:+.3f}", "", f"{u / unit:.3f}", error_named(name).unit)
        else:
            curve = result.errors.curves[name]
            k = int(abs(curve.value).argmax())
            largest, u = curve.value[k] / unit, curve.u.max() / unit
            table.add_row(name, f"{largest:+.3f}", f"{curve.position_mm[k]:g}", f"{u:.3f}", error_named(name).unit)
    return Group(Text("\n".join(lines)), table)


def fit_table(result: FitResult) -> Table:
    """Return what the fit did to each curve."""
    table = Table(
        "error",
        "smoothness",
        "chosen by",
        "free",
        "residual rms",
        "bias max",
        "unit",
        "solver",
        "bounds touched",
        box=box.SIMPLE,
    )
    for name, item in result.report.items():
        table.add_row(
            name,
            f"{item.smoothness:.3g}",
            item.method,
            f"{item.degrees_of_freedom:.1f}",
            f"{item.rms_residual:.3f}",
            f"{item.smoothing_bias_max:.3f}",
            item.unit,
            item.solver,
            str(len(item.active_bounds) or ""),
        )
    return table


def verification_table(results: Sequence[Verification]) -> Group:
    """Return before and after for every control, read from the files, and why tables were not accepted."""
    title = "error of the tool tip over the volume, max / rms in um, from the files read back"
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE, pad_edge=False)
    table.add_column("control", no_wrap=True)
    for heading in ("before", "after", "after*", "not expressible"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    notes: list[Text] = []
    for item in results:
        verdict = Text("accepted", "green") if item.accepted else Text("NOT ACCEPTED", "bold red")
        table.add_row(
            item.controller,
            f"{item.before.max_um:.1f} / {item.before.rms_um:.1f}",
            f"{item.after.max_um:.2f} / {item.after.rms_um:.2f}",
            f"{item.after_rigid_removed.max_um:.2f} / {item.after_rigid_removed.rms_um:.2f}",
            f"{item.unrepresentable_um:.2f}",
            verdict,
        )
        notes += [Text(f"{item.controller}: {reason}", "red") for reason in item.reasons]
        if item.uncorrected_um:
            listed = ", ".join(f"{name} {value:.1f} um" for name, value in list(item.uncorrected_um.items())[:8])
            more = f" and {len(item.uncorrected_um) - 8} more" if len(item.uncorrected_um) > 8 else ""
            notes.append(Text(f"{item.controller} leaves uncorrected: {listed}{more}"))
    return Group(table, Text("* after the best-fit rigid motion of the workpiece is taken out"), *notes)


def run_json(result: RunResult) -> dict[str, Any]:
    """Return the object that ``compgen run --json`` prints; with one control its ``result.json`` plus the rest."""
    summaries = [item.verification.summary() for item in result.results]
    common = {
        "accepted": result.accepted,
        "identify": result.identification.summary(),
        "paths": [str(path) for item in result.results for path in item.paths],
    }
    if len(summaries) == 1:
        return {**summaries[0], **common}
    return {**common, "controllers": {item["controller"]: item for item in summaries}}
