"""Readable summaries of accuracy figures, and of before against after."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.accuracy.compare import Comparison
from compgen.accuracy.evaluate import Accuracy
from compgen.accuracy.figure import COVERAGE, ComparedFigure, Figure
from compgen.core.csvio import FloatArray

_HEADINGS = ("figure", "before", "after", "unit", "factor", "En", "verdict")
#: More targets than these stand in the JSON alone.
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


def _number(value: float, digits: int = 2) -> str:
    return "" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:.{digits}f}"


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
        if len(found.targets.get(name, {}).get("position_mm", ())) in range(1, MOST_TARGETS + 1):
            parts.append(_targets_table(found.targets[name]))
    return Group(*parts, Text("\n".join(found.statements)))


def _targets_table(columns: Mapping[str, FloatArray]) -> Table:
    """Values at each target; U from the scatter alone."""
    table = Table(box=box.SIMPLE)
    for heading, _, _ in _TARGETS:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in range(len(columns["position_mm"])):
        cells = []
        for _, name, u_name in _TARGETS:
            value, u = float(columns[name][row]), float(columns[u_name][row]) if u_name else math.nan
            cells.append(_number(value) + ("" if math.isnan(u) else f" +/- {COVERAGE * u:.2f}"))
        table.add_row(*cells)
    return table


def comparison_table(found: Comparison) -> Group:
    """Return before, after, improvement factor, E_n and verdict of every figure; the overall verdict first."""
    return Group(Text(verdict_text(found), style="bold"), *_tables(found.groups, found.kind), *_prediction(found))


def verdict_text(found: Comparison) -> str:
    """Say in one line how it came out, and by which figures."""
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


def _prediction(found: Comparison) -> list[Text]:
    lines = list(found.statements)
    if found.prediction is not None:
        agreed = found.prediction
        parts = [f"{key} {_with_u(item)} um" for key, item in agreed.difference.items()]
        verdict = "cannot be judged against" if agreed.verdict == "unknown" else f"{agreed.verdict} with"
        share = (
            ""
            if math.isnan(agreed.beyond)
            else f"; {100 * agreed.beyond:.1f} % of {agreed.components} components beyond U"
        )
        share += "" if math.isnan(agreed.beyond) else f" (by chance up to {100 * agreed.allowed:.1f} %)"
        lines.insert(0, f"prediction {verdict} the measurement{share}; difference: {', '.join(parts)}")
    return [Text("\n".join(lines))]
