"""Results as tables in the terminal: identification, fit, verification, accuracy, safety, measuring plan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.data.names import COVERAGE, error_named
from compgen.data.rotary import si_per_unit, unit_of
from compgen.errors import number_text, one_line, um_text

if TYPE_CHECKING:
    from compgen.accuracy.compare import Comparison
    from compgen.accuracy.evaluate import Accuracy
    from compgen.accuracy.field import ComparedFigure, Figure
    from compgen.data.machine import Machine
    from compgen.fitting import FitResult
    from compgen.identification import Identification
    from compgen.identification.spheres import SphereIdentification
    from compgen.planning import Plan, PlanVisibility, Suggestion, TrajectoryCandidate, VolumeUncertainty
    from compgen.planning.gauges import GaugePlan
    from compgen.planning.next_measurement import NextBest
    from compgen.planning.sphere_poses import SpherePlan
    from compgen.tables import Residuals, Verification
    from compgen.tables.active import MergeReport, TableDifference
    from compgen.tables.signs import CrashTest

# Readable summaries for the terminal.


#: Further reasons and rejected readings are in the JSON files only.
MOST_VERDICT_REASONS = 10


def identification_table(result: Identification, *, assumed: bool = True) -> Group:
    """Return the summary of an identification; with ``assumed`` also what is assumed of errors that were not measured."""
    if result.method == "sixdof":
        parts = [
            f"{name}: mode {item['mode']}, {item['runs']} runs, {item['positions']} positions"
            for name, item in result.details["axes"].items()
        ]
        lines = [f"{'; '.join(parts)}; {result.details['line']} lines", *result.details["table"]]
        return Group(Text("\n".join(lines)), _errors_table(result))
    if result.method == "axis-runs":
        lines = [
            f"{name}: {item['targets']} targets from {item['from_mm']:g} to {item['to_mm']:g} mm, {item['runs']} runs"
            for name, item in result.details["axes"].items()
        ]
        lines.append(f"scatter within targets and directions {result.rms_um:.3f} um rms, method {result.method}")
        return Group(Text("\n".join(lines)), _errors_table(result))
    if result.method == "given":
        source = f" in {one_line(result.details['file'])}" if result.details["file"] else ""
        text = f"{result.details['values']} values of errors given{source}; not identified here"
        return Group(Text(text), _errors_table(result))
    if result.method == "together":
        listed = []
        for part in result.details["parts"]:
            alone = ", ".join(part["errors"]) or "nothing alone,"
            shown = f"{alone} from {part['readings']} readings" if part["readings"] else alone
            listed.append(f"{part['name']}: {shown}")
        count = len(result.errors.names)
        residual = f"residual {result.rms_um:.3f} um rms"
        quality = f"1 error, {residual}" if count == 1 else f"{count} errors, {residual}"
        apart = [text.partition(":")[0] for text in result.unobservable if text.endswith("stations and other errors")]
        if apart:
            quality += (
                f"\nleft out, the readings do not separate them from the stations and other errors: {', '.join(apart)}"
            )
        disagree = [f"{name} against the others: largest En {max(en.values()):.2f} ({max(en, key=lambda key: en[key])})"
                    for name, en in result.details.get("en", {}).items() if en]  # fmt: skip
        return Group(
            Text("\n".join([*listed, quality, *disagree, *(_assumed(result) if assumed else [])])),
            _errors_table(result),
        )
    counted = {
        "deviations": "components of measured positions used",
        "artefact": "probed coordinates used",
        "circles": "readings of circles used",
    }
    lengths = result.method not in counted
    stations = f"lengths used, {len({item.station for item in result.stations})} stations"
    used = f"{result.readings_used} of {result.readings} {counted.get(result.method, stations)}"
    stated = f"{result.u_length_um:g} um" + (f" + {result.u_length_um_per_m:g} um/m" if lengths else "")
    lines = [
        f"{used}, rank {result.rank} of {result.unknowns} unknowns, method {result.method}",
        f"residual {result.rms_um:.3f} um rms, reduced chi-square {result.reduced_chi_square:.3f} "
        f"({result.degrees_of_freedom} degrees of freedom, {result.u_source} uncertainty {stated})",
    ]
    if result.stations:
        places = {item.station: ", ".join(f"{value:.0f}" for value in item.position_mm) for item in result.stations}
        found = "; ".join(f"{name} ({place}) mm" for name, place in places.items())
        lines.append(f"stations found at X, Y, Z: {found}")
        lines.append("are they really there? Lengths alone cannot show that an axis is mirrored")
    lines += [segment.text for segment in result.segments[:MOST_VERDICT_REASONS]]
    lines += [
        f"rejected: {item.station} point {item.point} (line {item.line}): {item.reason}"
        for item in result.rejected[:MOST_VERDICT_REASONS]
    ]
    if len(result.rejected) > MOST_VERDICT_REASONS:
        lines.append(f"... and {len(result.rejected) - MOST_VERDICT_REASONS} more in identify.json")
    lines += [
        f"{item['what']} {item['of']}: {item['value']:+.2f} {item['unit']}, u {item['u']:.2f}"
        for item in result.details.get("unknowns", ())
        if item["what"] in ("reversal", "scales", "servo mismatch")
    ]
    if result.method == "merged":
        worst = max(result.details["en"].items(), key=lambda item: item[1])
        lines.append(f"merged with six-DOF readings; largest En {worst[1]:.2f} ({worst[0]}), 1 is the limit")
    return Group(Text("\n".join([*lines, *(_assumed(result) if assumed else [])])), _errors_table(result))


def what_matters(machine: Machine, result: Identification) -> Group:
    """Return the first screen of a result in lines: largest error, squareness, backlash, what was not measured."""
    from compgen.report.summary import summary_of

    found = summary_of(machine, result.errors, result.summary())
    return Group(*(Text(line, style="bold" if k == 0 else "") for k, line in enumerate(found.lines if found else ())))


def _assumed(result: Identification) -> list[str]:
    """Return what was assumed of errors that no reading determines, and whether the machine is worse than its class."""
    if "posterior_means" not in result.details or result.posterior is None:  # the readings determine every error
        return []
    from compgen.identification.posterior import assumed_text, worse_text

    return [text for text in (assumed_text(result.posterior), worse_text(result.posterior)) if text]


def advice_text(result: Identification, proposed: NextBest | None) -> Group:
    """Return what the readings cannot show, with the check that would show it, and what to measure next."""
    lines = [f"note: {text}" for text in result.notes]
    if proposed is not None and proposed.text:
        lines.append(f"next measurement: {proposed.text}")
    return Group(*(Text(line) for line in lines))


def _fit_lines(result: SphereIdentification) -> list[str]:
    """What the fit leaves, and the uncertainty of the readings."""
    figures, (without, left_out) = result.residual_um, result.left_out_um
    before, after = um_text(figures["before_rms"]), um_text(figures["after_rms"])
    most, least = um_text(figures["before_max"]), um_text(figures["after_max"])
    beyond = (
        "" if math.isnan(left_out) else f"; poses left out of the fit: {um_text(without)} -> {um_text(left_out)} um rms"
    )
    source = ", from the residuals" if result.u_from_residuals else ", as stated"
    if result.kinds == ("spheres",):
        return [
            f"distance from the spheres {before} um rms (largest {most}) -> {after} um (largest {least} um){beyond}",
            f"standard uncertainty of a coordinate: {um_text(result.u_um)} um{source}",
        ]
    return [
        f"reading minus model {before} um rms (largest {most}) -> {after} um (largest {least} um){beyond}",
        f"standard uncertainty of a reading: {um_text(result.u_um)} um{source}",
    ]


def sphere_table(result: SphereIdentification) -> Group:
    """Return the position errors of rotary axes, the fit, and what the poses cannot tell apart."""
    overview = result.overview()
    table = Table(
        title=f"{overview.title}; {result.rank} combinations determined", box=box.SIMPLE_HEAD, title_justify="left"
    )
    for name, justify in zip(overview.header, ("left", "right", "right", "left", "left"), strict=True):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for row in overview.rows:
        table.add_row(*row)
    lines = [
        *_fit_lines(result),
        *(f"cannot be told apart: {words}; {cure}" for words, cure in result.inseparable),
        *(f"note: {text}" for text in result.notes),
    ]
    return Group(table, *(Text(line) for line in lines))


def sphere_plan_table(plan: SpherePlan) -> Group:
    """Return what planned poses will determine of the rotary axes, and what they cannot tell apart."""
    title = (
        f"{sum(plan.determined)} of {len(plan.names)} position errors, {plan.rank} combinations determined by "
        f"{len(plan.spheres)} of {plan.candidates} poses"
    )
    table = Table(
        "error", "u (k = 1)", "assumed before", "unit", "", title=title, box=box.SIMPLE_HEAD, title_justify="left"
    )
    for name, u, size, known in zip(plan.names, plan.u, plan.sizes, plan.determined, strict=True):
        unit = si_per_unit(name)
        table.add_row(name, f"{u / unit:.2f}", f"{size / unit:.0f}", unit_of(name), "" if known else "not determined")
    lines = [
        f"for centres with a standard uncertainty of {plan.u_um:g} um in each coordinate; errors of the linear axes that are not "
        "measured enter with the sizes of their class",
        *(f"cannot be told apart: {words}; {cure}" for words, cure in plan.inseparable),
    ]
    return Group(table, *(Text(line) for line in lines))


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
            table.add_row(
                name, f"{value / unit:+.3f}", "", number_text(u / unit, missing="not known"), error_named(name).unit
            )
        else:
            curve = result.errors.curves[name]
            k = int(abs(curve.value).argmax())
            largest, u = curve.value[k] / unit, curve.u.max() / unit
            table.add_row(
                name,
                f"{largest:+.3f}",
                f"{curve.position_mm[k]:g}",
                number_text(u, missing="not known"),
                error_named(name).unit,
            )
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
    """Return what the uncertainty of the measurement adds to the figures after compensation."""
    known = results[0].uncertainty  # depends on errors and points: practically the same for all controls
    if known is None:
        return "the uncertainty of the measurement is unknown, and so is that of the figures after"
    return (
        f"the uncertainty of the measurement (U, k = 2) adds to the figures from the files: +-{um_text(known.max_um)} / "
        f"{um_text(known.rms_um)} um on after, +-{um_text(known.max_rigid_removed_um)} / "
        f"{um_text(known.rms_rigid_removed_um)} um on after*"
    )


def verification_table(results: Sequence[Verification], failed: Mapping[str, str] | None = None) -> Group:
    """Return before and after for every control, read from its files, and why tables were not accepted.

    What is assumed of errors that were not measured is the same for all of them, and is said once. ``failed`` says, by name,
    why a control has no tables.
    """
    lacking = tuple(failed or ())
    probable = all(item.gain is not None for item in results)
    table = _probable_table(results, lacking) if probable else _file_table(results, lacking)
    common = list(dict.fromkeys(text for item in results for text in item.assumptions))
    notes = [Text(f"{name}: no tables: {one_line(why)}", "red") for name, why in (failed or {}).items()]
    for item in results:
        notes += _notes(item, common)
        if item.next_command:
            notes.append(Text(f"{item.controller}: next: {one_line(item.next_command)}"))
        if item.uncorrected_um:
            u_um = None if item.uncertainty is None else item.uncertainty.max_um
            left = {name: um_text(value, u_um=u_um) for name, value in item.uncorrected_um.items()}
            named = [f"{name} {text} um" for name, text in left.items() if not text.startswith("<")]
            more = f" and {len(left) - 8} more" if len(named) > 8 else ""
            if named:
                notes.append(Text(f"{item.controller} leaves uncorrected: {', '.join(named[:8])}{more}"))
    judged = dict.fromkeys(f"every entry was judged with the machine's tool and {item.tools}" for item in results)
    return Group(table, *(Text(text) for text in (*judged, *common)), *notes)


def _notes(item: Verification, common: Sequence[str]) -> list[Text]:
    """Return the verdict on the tables of a control in a sentence, then what else is said of them."""
    style, notes = VERDICTS[item.state][1], []
    if item.accepted:
        notes.append(Text(f"{item.controller}: {item.headline}", "" if item.state == "accepted" else style))
    notes += [Text(f"{item.controller}: {reason}", "red") for reason in item.reasons[:MOST_VERDICT_REASONS]]
    if len(item.reasons) > MOST_VERDICT_REASONS:
        notes.append(
            Text(f"{item.controller}: and {len(item.reasons) - MOST_VERDICT_REASONS} more in result.json", "red")
        )
    if item.accepted:
        said = dict.fromkeys([*item.said_against, *item.notes])
        notes += [Text(f"  {text}", "yellow") for text in said if text not in common and text not in item.headline]
    return notes


def _table_of_controls(title: str, *headings: str) -> Table:
    table = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE, pad_edge=False, collapse_padding=True
    )
    many = len(headings) > 5  # in 80 characters the verdict has to be whole, too
    table.add_column("control", overflow="fold", min_width=8 if many else 12)
    for heading in headings:
        table.add_column(heading, justify="right", overflow="fold", min_width=5 if many else 6)
    table.add_column("verdict", no_wrap=True, min_width=9)
    return table


def _probable_table(results: Sequence[Verification], lacking: Sequence[str] = ()) -> Group:
    """Return before and after with the limits that measurement and prior leave."""
    title = "tool tip error over the volume, um rms, with what was not measured (97.5 % limits)"
    table = _table_of_controls(title, "before", "after", "at most", "after*", "at most*", "by the files", "at best")
    for item in results:
        assert item.gain is not None
        before, low, high, after, most = item.gain.rounded
        _, _, _, after_rigid, most_rigid = item.gain.rounded_rigid
        known = item.uncertainty
        left = "–" if known is None else f"{um_text(item.after.max_um, u_um=known.max_um)} / "
        left += "" if known is None else um_text(item.after.rms_um, u_um=known.rms_um)
        table.add_row(
            item.controller,
            f"{before} ({low} to {high})",
            *(after, most, after_rigid, most_rigid, left),
            um_text(item.unrepresentable_um, u_um=None if known is None else known.max_um),
            Text(*VERDICTS[item.state]),
        )
    for name in lacking:
        table.add_row(name, *["–"] * 7, Text("NO TABLES", "red"))
    legend = (
        "before, after: with the reference point fixed; after*: with the best-fit rigid motion of the workpiece removed; by the "
        "files: largest / rms that the tables, read back, leave of the errors found; at best: the largest with the best "
        "possible table of this control"
    )
    return Group(table, Text(legend))


def _file_table(results: Sequence[Verification], lacking: Sequence[str] = ()) -> Group:
    """Return before and after of the errors found, as read back from the files: nothing is known of other errors."""
    volumetric = all(item.volumetric for item in results)
    what = "tool tip error over the volume" if volumetric else "effect of the measured errors alone on the tool tip"
    table = _table_of_controls(
        f"{what}, max / rms in um, as read back from the files", "before", "after", "before*", "after*", "at best"
    )
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
    for name in lacking:
        table.add_row(name, *["–"] * 5, Text("NO TABLES", "red"))
    legend = (
        "before, after: with the reference point fixed; before*, after*: with the best-fit rigid motion of the "
        "workpiece removed; at best: the largest error with the best possible table of this control"
    )
    return Group(table, Text(legend), *([Text(_uncertainty(results))] if results else []))


# Readable summaries of accuracy figures, and of before against after.


_HEADINGS = ("figure", "before", "after", "unit", "factor", "En", "verdict")
#: More targets than these are in the JSON only.
MOST_TARGETS = 40
_TARGETS = (
    ("target mm", "position_mm", ""),
    ("mean up um", "mean_up_um", "u_mean_up_um"),
    ("mean down um", "mean_down_um", "u_mean_down_um"),
    ("B um", "B_um", "u_B_um"),
    ("s up um", "s_up_um", ""),
    ("s down um", "s_down_um", ""),
    ("R um", "R_um", ""),
)
_STYLES = {"better": "green", "worse": "bold red", "larger": "red"}


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"


def _with_u(item: Figure) -> str:
    band = "" if math.isnan(item.u) else f" +/- {item.expanded:.2f}"
    return f"{item.value:.2f}{band}"


def accuracy_table(found: Accuracy) -> Group:
    """Return all figures with their expanded uncertainties (k = 2)."""
    parts: list[Table | Text] = []
    for name, group in found.groups.items():
        if not group:
            continue
        table = Table("figure", "value +/- U (k = 2)", "unit", title=name, title_justify="left", box=box.SIMPLE)
        for key, item in group.items():
            table.add_row(key, _with_u(item) + (", U not known" if math.isnan(item.u) else ""), item.unit)
        parts.append(table)
        columns = found.targets.get(name, {"position_mm": ()})
        if len(columns["position_mm"]) not in range(1, MOST_TARGETS + 1):
            continue
        # Values at each target; U from the scatter alone.
        parts.append(targets := Table(box=box.SIMPLE))
        for heading, _, _ in _TARGETS:
            targets.add_column(heading, justify="right", no_wrap=True)
        for row in range(len(columns["position_mm"])):
            cells = []
            for _, column, u_column in _TARGETS:
                value, u = float(columns[column][row]), float(columns[u_column][row]) if u_column else math.nan
                cells.append(_number(value) + ("" if math.isnan(u) else f" +/- {COVERAGE * u:.2f}"))
            targets.add_row(*cells)
    return Group(*parts, Text("\n".join(found.statements)))


def comparison_table(found: Comparison) -> Group:
    """Return before, after, improvement factor, E_n and verdict of every figure; the overall verdict first."""
    lines = list(found.statements)
    if found.prediction is not None:
        agreed = found.prediction
        parts = [f"{key} {_with_u(item)} um" for key, item in agreed.difference.items()]
        verdict = "cannot be judged against" if agreed.verdict == "unknown" else f"{agreed.verdict} with"
        share = ""
        if not math.isnan(agreed.beyond):
            share = f"; {100 * agreed.beyond:.1f} % of {agreed.components} components beyond U"
            share += f" (by chance up to {100 * agreed.allowed:.1f} %)"
        lines.insert(0, f"prediction {verdict} the measurement{share}; difference: {', '.join(parts)}")
    tables = _tables(found.groups, found.kind)
    return Group(Text(verdict_text(found), style="bold"), *tables, Text("\n".join(lines)))


def verdict_text(found: Comparison) -> str:
    """Return the verdict in one line, and the figures that decided it."""
    if found.kind == "prediction" and found.prediction is not None:
        return f"prediction and measurement: {found.prediction.verdict}"
    by = ", ".join(f"{group} {key}" for group, key in found.decisive)
    return f"AFTER against BEFORE: {found.verdict} (decided by {by})"


def _tables(groups: Mapping[str, Mapping[str, ComparedFigure]], kind: str) -> list[Table]:
    predicted = kind == "prediction"
    headings = ("figure", "predicted", "measured", "unit", "En") if predicted else _HEADINGS
    tables = []
    for name, group in groups.items():
        table = Table(title=name, title_justify="left", box=box.SIMPLE, pad_edge=False)
        for heading in headings:
            left = heading in ("figure", "unit", "verdict")
            table.add_column(heading, justify="left" if left else "right", no_wrap=True)
        for key, item in group.items():
            row: list[str | Text] = [key, _with_u(item.before), _with_u(item.after), item.before.unit]
            if predicted:
                table.add_row(*row, _number(item.en))
                continue
            factor = _number(item.factor) + ("" if math.isnan(item.u_factor) else f" +/- {2 * item.u_factor:.2f}")
            verdict = Text(item.verdict, _STYLES.get(item.verdict, ""))
            table.add_row(*row, factor, _number(item.en), verdict)
        if group:
            tables.append(table)
    return tables


# Readable summaries of the sign crash test, of differences between tables, and of a merge.


#: Kinds of wrong tables in the order of the summary, with their names in it.
KINDS = {
    "output": "signed axes of the correction",
    "frame": "signed axes of the frame",
    "unit": "units",
    "errors": "errors",
    "entry": "single entries",
}
#: Further components of a difference are in diff.json only.
MOST_COMPONENTS = 12


def crash_table(results: Sequence[CrashTest]) -> Group:
    """Return how many wrong tables of every kind were rejected, by control, and each that was not."""
    from compgen.tables.signs import ACCEPTED, REJECTED, SAME

    table = Table(
        box=box.SIMPLE, pad_edge=False, title="wrong tables: rejected / same / accepted", title_justify="left"
    )
    table.add_column("control", no_wrap=True)
    for kind in KINDS.values():
        table.add_column(kind, justify="right")
    table.add_column("verdict", no_wrap=True)
    notes: list[Text] = []
    for item in results:
        counts = [
            " / ".join(
                str(sum(trial.outcome == outcome for trial in item.trials if trial.kind == kind))
                for outcome in (REJECTED, SAME, ACCEPTED)
            )
            for kind in KINDS
        ]
        verdict = Text("passed", "green") if item.passed else Text("FAILED", "bold red")
        table.add_row(item.controller, *counts, verdict)
        name = item.controller
        notes += [Text(f"{name}: the right tables are not accepted: {reason}", "red") for reason in item.baseline]
        for trial in item.trials:
            what, size_um = f"{trial.kind} {trial.name}", trial.difference_um
            if trial.outcome == ACCEPTED:
                notes.append(Text(f"{name}: ACCEPTED although wrong by {size_um:.2f} um: {what}", "red"))
            elif trial.outcome == SAME:
                notes.append(Text(f"{name}: {what} changes {size_um:.3f} um at most", "yellow"))
    legend = (
        "same: the wrong table differs from the right one by no more than the verification resolves (resolution of "
        "the format and 0.2 um), so it is not counted"
    )
    return Group(table, *notes, Text(legend))


def difference_table(result: TableDifference) -> Group:
    """Return the figures of a difference, its largest components, and what else differs."""
    data = result.summary()
    table = Table(box=box.SIMPLE, pad_edge=False, title="A minus B at the tool, um", title_justify="left")
    for heading in ("", "max", "rms", "95 %"):
        table.add_column(heading, justify="right")
    for name, figures in (("length", data), *((f"d{axis}", data["axes"][f"d{axis}"]) for axis in "xyz")):
        table.add_row(name, *(f"{figures[key]:.3f}" for key in ("max_um", "rms_um", "p95_um")))
    x, y, z = data["largest_at_mm"]
    lines = [f"largest at X {x:g} Y {y:g} Z {z:g} mm, {data['points']} points"]
    named = list(data["components_rms_um"].items())
    lines += [f"  {name}: {value:.3f} um rms" for name, value in named[:MOST_COMPONENTS]]
    if len(named) > MOST_COMPONENTS:
        lines.append(f"  and {len(named) - MOST_COMPONENTS} more in diff.json")
    lines += [f"{item['what']}: A {item['a']}, B {item['b']}" for item in data["geometry"]]
    return Group(table, Text("\n".join(lines)))


def merge_text(report: MergeReport) -> Text:
    """Return how closely the merged table reproduces old and new together."""
    text = (
        f"old and new together reach {report.total_max_um:.1f} um; the merged tables miss it by "
        f"{report.difference_max_um:.2f} um max, {report.difference_rms_um:.2f} um rms, including what it cannot express"
    )
    if report.lost_um > 0.1:
        text += f"; {report.lost_um:.2f} um of the old tables belong to no error of the machine's model"
    return Text(text)


# Readable summary of a planned measurement for the terminal.


#: Further reasons are in plan.json only.
MOST_PLAN_REASONS = 8
#: Further pairs are in plan.json only.
MOST_PAIRS = 12


def plan_table(plan: Plan) -> Group:
    """Return the verdict, the predicted uncertainty of the volume and that of every error."""
    stations, rank = plan.planned.stations, plan.rank
    lines = [
        f"{plan.readings} readings of {len(stations)} stations, rank {rank.rank} of {rank.size} unknowns",
        f"uncertainty of a reading ({plan.planned.noise.source}): {plan.planned.noise.constant_um:g} um + "
        f"{plan.planned.noise.proportional_um_per_m:g} um/m",
        volume_line("volume", plan),
        f"  of this from the noise of the readings: {_worst_and_rms(plan.from_readings)}",
        *([] if plan.posterior is None or plan.determined else [plan.summary()["assumed"]]),
    ]
    notes = [Text(f"not determined: {reason}", "red") for reason in plan.reasons[:MOST_PLAN_REASONS]]
    if len(plan.reasons) > MOST_PLAN_REASONS:
        notes.append(Text(f"and {len(plan.reasons) - MOST_PLAN_REASONS} more in plan.json", "red"))
    table = Table("error", "u (k = 1) max", "at (mm)", "unit", box=box.SIMPLE)
    for name in plan.errors.names:
        error = error_named(name)
        if name in plan.errors.squareness:
            table.add_row(
                name,
                number_text(plan.errors.squareness[name][1] / error.si_per_unit, missing="not determined"),
                "",
                error.unit,
            )
        else:
            curve = plan.errors.curves[name]
            worst = float(curve.u.max()) / error.si_per_unit
            where = f"{curve.position_mm[int(np.argmax(curve.u))]:g}" if np.isfinite(worst) else ""
            table.add_row(name, number_text(worst, missing="not determined"), where, error.unit)
    return Group(Text("\n".join(lines)), *notes, table)


def gauge_plan_table(plan: GaugePlan) -> Group:
    """Return what a plan with artefacts and circles determines, what it leaves out, and what to add."""
    from compgen.planning.gauges import volume_text

    summary = plan.summary()
    lines = [*summary["gauges"], f"{plan.readings} readings, {summary['degrees_of_freedom']} degrees of freedom"]
    lines += [text for text in (volume_text(plan),) if text]
    table = Table("error", "u (k = 1) where read", "over the travel", "at (mm)", "unit", "", box=box.SIMPLE)
    for name, item in summary["u"].items():
        where = "" if item["at_mm"] is None else f"{item['at_mm']:g}"
        numbers = (number_text(item["u_max_where_read"], missing="-"), number_text(item["u_max"], missing="not known"))
        table.add_row(name, *numbers, where, item["unit"], "" if item["state"] == "determined" else item["state"])
    notes = [Text("no error is determined", "red")] if not plan.errors.names else []
    if plan.left_out:
        notes.append(Text(f"not shown: {', '.join(plan.left_out)}", "yellow"))
    if plan.partly and plan.posterior is None:
        text = (
            "partly: not separable from poses, the artefact or other errors in every direction; u is that of the rest"
        )
        notes.append(Text(text, "yellow"))
    elif plan.partly:
        notes.append(Text("partly: more than a third of what is assumed of them remains unknown", "yellow"))
    empty = {axis: nodes for name, nodes in summary["nodes_without_data"].items() if (axis := name[2])}
    notes += [
        Text(
            f"no reading near {axis} {', '.join(f'{value:g}' for value in nodes)} mm: values there are extrapolated",
            "yellow",
        )
        for axis, nodes in sorted(empty.items())
    ]
    notes += [Text(f"to add: {item.text}: {item.effect} ({item.option})") for item in plan.additions]
    return Group(Text("\n".join(lines)), *([table] if plan.errors.names else []), *notes)


def next_table(found: NextBest, assumed: str) -> Group:
    """Return what to measure next, with what each measurement would bring and how it is done."""
    from compgen.planning.next_measurement import NOTHING_NEXT

    table = Table("measurement", "u after (um)", "reduces", box=box.SIMPLE)
    for item in found.measurements:
        most = ", ".join(item.reduces[:6]) + (" ..." if len(item.reduces) > 6 else "")
        table.add_row(item.candidate.what, um_text(item.u_after_um), most)
    lines = [f"u of the tool tip over the volume, rms: {um_text(found.u_um)} um (k = 1)", assumed]
    how = [Text(f"{item.candidate.what}: {item.candidate.how}") for item in found.measurements]
    said = Text("\n".join([*lines, found.text or NOTHING_NEXT]))
    return Group(said, table, *how) if found.measurements else Group(said)


def _worst_and_rms(volume: VolumeUncertainty) -> str:
    """Largest and rms u of E over the volume; in words where it is undetermined."""
    if not np.isfinite(volume.rms_um):
        return "undetermined"
    return f"{volume.worst_um:.3f} / {volume.rms_um:.3f} um"


def volume_line(title: str, plan: Plan) -> str:
    """Return a line or two with the uncertainty of E over the volume."""
    report = plan.volume.summary()
    if report["undetermined_points"]:
        return f"{title}: E is undetermined at {report['undetermined_points']} of {report['points']} points"
    axes = ", ".join(f"{axis} {report[f'u_{axis}_max_um']:.3f} / {report[f'u_{axis}_rms_um']:.3f}" for axis in "xyz")
    together = f"{report['u_max_um']:.3f} / {report['u_rms_um']:.3f} um"
    return f"{title}: u of E, max / rms: {together}\n  by axis: {axes} um"


def suggestion_table(suggestion: Suggestion) -> Group:
    """Return the places that the search found."""
    table = Table("station", "x (mm)", "y (mm)", "z (mm)", box=box.SIMPLE)
    stations = suggestion.plan.planned.stations
    for name, place in zip(stations.names, stations.position_mm, strict=True):
        table.add_row(name, *(f"{value:.1f}" for value in place))
    title = "suggested station positions" if suggestion.improved else "no better station positions were found"
    return Group(Text(volume_line(f"{title} ({suggestion.evaluations} arrangements)", suggestion.plan)), table)


def trajectory_table(
    judged: Sequence[TrajectoryCandidate], chosen: TrajectoryCandidate | None, target_um: float
) -> Group:
    """Return the trajectories that were judged, and the one that reaches the target."""
    table = Table("trajectory", "points", "u max (um)", "u rms (um)", "with all between the nodes, max", box=box.SIMPLE)
    for item in judged:
        table.add_row(
            item.name,
            str(len(item.position_mm)),
            number_text(item.worst_um, missing="not determined"),
            number_text(item.rms_um, missing="not determined"),
            "" if item.volume_um is None else number_text(item.volume_um),
        )
    verdict = (
        f"the smallest trajectory within {target_um:g} um: {chosen.name}"
        if chosen
        else f"no trajectory reaches {target_um:g} um with these stations"
    )
    notes = []
    if chosen is not None and chosen.volume_um is not None and chosen.volume_um > target_um:
        notes.append(
            Text(
                "this is what the noise of the readings makes; with what is assumed of the curves between their nodes u is up "
                f"to {number_text(chosen.volume_um)} um (more nodes in the machine file reduce that)",
                "yellow",
            )
        )
    return Group(table, Text(verdict, "" if chosen else "red"), *notes)


def visibility_table(visible: PlanVisibility) -> Group:
    """Return which effects other than geometric errors the plan cannot show, and which look alike."""
    from compgen.effects.all_effects import separating

    never = Table("what this plan cannot show", "why", "measure in addition", box=box.SIMPLE)
    for (reason, breaker), names in _grouped(visible).items():
        never.add_row(", ".join(names), reason, breaker)
    alike = Table("look alike", "correlation", "measure in addition", box=box.SIMPLE)
    for pair in visible.pairs[:MOST_PAIRS]:
        first, second = (visible.cards[name] for name in pair.names)
        shared = f"{pair.correlation:.3f} ({pair.shared} of {pair.directions} directions)"
        alike.add_row(" and ".join(pair.names), shared, separating(first, second))
    notes = [Text(f"assumed: {'; '.join(visible.assumed)}")] if visible.assumed else []
    if len(visible.pairs) > MOST_PAIRS:
        notes.append(Text(f"and {len(visible.pairs) - MOST_PAIRS} more pairs in plan.json"))
    return Group(never, alike, *notes)


def _grouped(visible: PlanVisibility) -> dict[tuple[str, str], list[str]]:
    """Return the effects that are not shown, by reason and by what would show them."""
    found: dict[tuple[str, str], list[str]] = {}
    for name, reason in visible.never.items():
        found.setdefault((reason.partition(":")[0], visible.cards[name].breaker), []).append(name)
    return found
