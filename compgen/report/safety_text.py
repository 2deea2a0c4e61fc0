"""Readable summaries of the sign crash test, of differences between tables, and of a merge."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.verify.crash_test import ACCEPTED, REJECTED, SAME, CrashTest
from compgen.verify.diff import TableDifference
from compgen.verify.merge import MergeReport

#: Kinds of wrong ones in the order of the table, with what they are called there.
KINDS = {
    "output": "signed axes of the correction",
    "frame": "signed axes of the frame",
    "unit": "units",
    "errors": "errors",
    "entry": "single entries",
}
#: Components of a difference beyond this number stand in diff.json only.
MOST_COMPONENTS = 12


def crash_table(results: Sequence[CrashTest]) -> Group:
    """Return how many wrong tables of every kind were rejected, by control, and every one that was not."""
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
        notes += _crash_notes(item)
    legend = (
        "same: the wrong table differs from the right one by no more than the verification is meant to see (resolution of "
        "the format and 0.2 um), so that it does not count"
    )
    return Group(table, *notes, Text(legend))


def _crash_notes(item: CrashTest) -> list[Text]:
    notes = [Text(f"{item.controller}: the right tables are not accepted: {reason}", "red") for reason in item.baseline]
    for trial in item.trials:
        if trial.outcome == ACCEPTED:
            text = (
                f"{item.controller}: ACCEPTED although wrong by {trial.difference_um:.2f} um: {trial.kind} {trial.name}"
            )
            notes.append(Text(text, "red"))
        elif trial.outcome == SAME:
            text = f"{item.controller}: {trial.kind} {trial.name} changes {trial.difference_um:.3f} um at most"
            notes.append(Text(text, "yellow"))
    return notes


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
    """Return how close the merged table comes to old and new together."""
    text = (
        f"old and new together reach {report.total_max_um:.1f} um; the merged tables miss it by "
        f"{report.difference_max_um:.2f} um max, {report.difference_rms_um:.2f} um rms, with all that this control cannot hold"
    )
    if report.lost_um > 0.1:
        text += f"; {report.lost_um:.2f} um of the old tables belong to no error of the machine's model"
    return Text(text)
