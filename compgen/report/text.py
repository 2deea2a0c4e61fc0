"""Readable summaries for the terminal, and the JSON of ``volcomp run``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.core.names import error_named
from compgen.core.text import one_line, um_text
from compgen.fit import FitResult
from compgen.identify import Identification
from compgen.pipeline import RunResult
from compgen.verify import Residuals, Verification

#: Reasons and rejected readings beyond this number stand in the JSON files only.
MOST_REASONS = 10


def identification_table(result: Identification) -> Group:
    """Return the summary of an identification."""
    if result.method == "sixdof":
        return Group(*_sixdof_lines(result), _errors_table(result))
    if result.method == "axis-runs":
        return Group(Text("\n".join(_axis_lines(result))), _errors_table(result))
    if result.method == "given":
        text = f"{result.details['values']} values of errors given in {one_line(result.details['file'])}; not identified here"
        return Group(Text(text), _errors_table(result))
    lengths = result.method != "deviations"
    used = f"{int(result.accepted.sum())} of {len(result.accepted)} "
    used += (
        f"lengths used, {len({item.station for item in result.stations})} stations"
        if lengths
        else "components of measured positions used"
    )
    stated = f"{result.u_length_um:g} um" + (f" + {result.u_length_um_per_m:g} um/m" if lengths else "")
    lines = [
        f"{used}, rank {result.rank} of {result.unknowns} unknowns, method {result.method}",
        f"residual {result.rms_um:.3f} um rms, reduced chi-square {result.reduced_chi_square:.3f} "
        f"({result.degrees_of_freedom} degrees of freedom, {result.u_source} uncertainty {stated})",
    ]
    lines += [segment.text for segment in result.segments[:MOST_REASONS]]
    lines += [
        f"rejected: {item.station} point {item.point} (line {item.line}): {item.reason}"
        for item in result.rejected[:MOST_REASONS]
    ]
    if len(result.rejected) > MOST_REASONS:
        lines.append(f"... and {len(result.rejected) - MOST_REASONS} more in identify.json")
    if result.method == "merged":
        worst = max(result.details["en"].items(), key=lambda item: item[1])
        lines.append(f"merged with six-DOF readings; largest En {worst[1]:.2f} ({worst[0]}), 1 is the limit")
    return Group(Text("\n".join(lines)), _errors_table(result))


def _axis_lines(result: Identification) -> list[str]:
    """What was measured along each axis, and how it repeats."""
    lines = [
        f"{name}: {item['targets']} targets from {item['from_mm']:g} to {item['to_mm']:g} mm, {item['runs']} runs"
        for name, item in result.details["axes"].items()
    ]
    return [*lines, f"scatter within targets and directions {result.rms_um:.3f} um rms, method {result.method}"]


def _sixdof_lines(result: Identification) -> list[Text]:
    """What was measured, repeatability and uncertainty in the units of the instrument."""
    axes = result.details["axes"]
    parts = [
        f"{name}: mode {item['mode']}, {item['runs']} runs, {item['positions']} positions"
        for name, item in axes.items()
    ]
    lines = [f"{'; '.join(parts)}; {result.details['line']} lines", *result.details["table"]]
    return [Text("\n".join(lines))]


def _errors_table(result: Identification) -> Table:
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
            table.add_row(name, f"{value / unit:+.3f}", "", _u(u / unit), error_named(name).unit)
        else:
            curve = result.errors.curves[name]
            k = int(abs(curve.value).argmax())
            largest, u = curve.value[k] / unit, curve.u.max() / unit
            table.add_row(name, f"{largest:+.3f}", f"{curve.position_mm[k]:g}", _u(u), error_named(name).unit)
    return table


def fit_table(result: FitResult) -> Table:
    """Return what the fit did to each curve."""
    table = Table(box=box.SIMPLE, pad_edge=False, collapse_padding=True)
    headings = ("error", "smoothness", "chosen by", "free", "residual rms", "bias max", "unit", "solver", "at a bound")
    for heading in headings:
        table.add_column(heading, overflow="fold", min_width=10 if heading == "smoothness" else None)
    for name, item in result.report.items():
        table.add_row(
            name,
            f"{item.smoothness:.2g}",
            item.method,
            f"{item.degrees_of_freedom:.1f}",
            f"{item.rms_residual:.3f}",
            f"{item.smoothing_bias_max:.3f}",
            item.unit,
            item.solver,
            str(len(item.active_bounds) or ""),
        )
    return table


def _u(value: float) -> str:
    """A standard uncertainty; one that nothing tells is said to be so."""
    return f"{value:.3f}" if math.isfinite(value) else "not known"


def _pair(figures: Residuals) -> str:
    return f"{um_text(figures.max_um)} / {um_text(figures.rms_um)}"


VERDICTS = {
    "accepted": ("accepted", "green"),
    "partial": ("partial", "yellow"),
    "accepted_with_reservations": ("reservations", "yellow"),
    "better_after_new_setup": ("new set-up", "yellow"),
    "not_accepted": ("REJECTED", "bold red"),
}


def _uncertainty(results: Sequence[Verification]) -> str:
    """What the uncertainty of the measurement adds to the figures after compensation."""
    known = results[0].uncertainty  # of the errors and points, so much the same for all controls
    if known is None:
        return "the uncertainty of the measurement is not known, so neither is that of the figures after"
    return (
        f"the uncertainty of the measurement (U, k = 2) comes on top of the figures by the files: +-{um_text(known.max_um)} / "
        f"{um_text(known.rms_um)} um on after, +-{um_text(known.max_rigid_removed_um)} / "
        f"{um_text(known.rms_rigid_removed_um)} um on after*"
    )


def verification_table(results: Sequence[Verification]) -> Group:
    """Return before and after for every control, read from the files, and why tables were not accepted."""
    volumetric = all(item.volumetric for item in results)
    what = "tool tip error over the volume" if volumetric else "effect of the measured errors alone on the tool tip"
    title = f"{what}, max / rms in um, by the files read back"
    table = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE, pad_edge=False, collapse_padding=True
    )
    table.add_column("control", overflow="fold", min_width=12)
    for heading in ("before", "after", "before*", "after*", "not held"):
        table.add_column(heading, justify="right", overflow="fold", min_width=6)
    table.add_column("verdict", no_wrap=True, min_width=9)
    notes: list[Text] = []
    for item in results:
        table.add_row(
            item.controller,
            _pair(item.before),
            _pair(item.after),
            _pair(item.before_rigid_removed),
            _pair(item.after_rigid_removed),
            um_text(item.unrepresentable_um),
            Text(*VERDICTS[item.state]),
        )
        if item.accepted and item.state != "accepted":
            notes.append(Text(f"{item.controller}: {item.headline}", VERDICTS[item.state][1]))
        notes += [Text(f"{item.controller}: {reason}", "red") for reason in item.reasons[:MOST_REASONS]]
        if len(item.reasons) > MOST_REASONS:
            notes.append(Text(f"{item.controller}: and {len(item.reasons) - MOST_REASONS} more in result.json", "red"))
        notes += [
            Text(f"{item.controller}: {note}", "yellow")
            for note in item.notes
            if item.accepted and note not in item.headline
        ]
        if item.next_command:
            notes.append(Text(f"{item.controller}: next: {one_line(item.next_command)}"))
        if item.uncorrected_um:
            listed = ", ".join(f"{name} {um_text(value)} um" for name, value in list(item.uncorrected_um.items())[:8])
            more = f" and {len(item.uncorrected_um) - 8} more" if len(item.uncorrected_um) > 8 else ""
            notes.append(Text(f"{item.controller} leaves uncorrected: {listed}{more}"))
    notes += [Text(_uncertainty(results))] if results else []
    legend = (
        "before, after: as it stands, the reference point fixed; before*, after*: the best-fit rigid motion of the "
        "workpiece taken out; not held: the largest error that no table of this control can express"
    )
    judged = dict.fromkeys(f"every entry was judged with the machine's tool and {item.tools}" for item in results)
    return Group(table, Text(legend), *(Text(text) for text in judged), *notes)


def run_json(result: RunResult) -> dict[str, Any]:
    """Return the object that ``volcomp run --json`` prints; with one control its ``result.json`` plus the rest."""
    summaries = [item.verification.summary() for item in result.results]
    common = {
        "accepted": result.accepted,
        "identify": result.identification.summary(),
        "paths": [str(path) for item in result.results for path in item.paths],
    }
    if len(summaries) == 1:
        return {**summaries[0], **common}
    return {**common, "controllers": {item["controller"]: item for item in summaries}}
