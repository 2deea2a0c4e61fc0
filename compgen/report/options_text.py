"""What the options of a control would buy: tables for the terminal, and ``options.md``."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.verify.capability import Capability, ControlResult, Left
from compgen.verify.levels import LABELS
from compgen.verify.residuals import Residuals

#: Errors that leave less than this at every tool and level are not listed, um.
LISTED_FROM_UM = 0.1
#: A level that shrinks the rms by less than this share, or by less than this much, buys nothing.
LEAST_GAIN, LEAST_GAIN_UM = 0.005, 0.05
LEGEND = (
    "left: what the best table of that level leaves, largest / rms / 95 % in um; left*: the best-fit rigid motion of the "
    "workpiece taken out; buys: by how much the rms* shrinks against the level above, with the machine's own tool: full "
    "volumetric compensation shows its worth with others. A level may hold a constant shift of "
    "an axis, which a workpiece offset does as well; controls whose tables are zero at the reference point do not."
)


def um(value: float) -> str:
    """A figure in um: two decimals below 10, none from 1000 on."""
    return f"{value:.{2 if abs(value) < 9.995 else 1 if abs(value) < 999.95 else 0}f}"


def _three(figures: Residuals) -> str:
    return f"{um(figures.max_um)} / {um(figures.rms_um)} / {um(figures.p95_um)}"


def tool_name(tool_mm: Sequence[float]) -> str:
    """A tool offset in words, e.g. ``Z -100`` or ``none``."""
    parts = [f"{axis} {value:g}" for axis, value in zip("XYZ", tool_mm, strict=True) if value]
    return ", ".join(parts) or "none"


def level_rows(result: Capability) -> list[list[str]]:
    """Rows level, left, left*, buys."""
    rows, before = [], None
    for item in result.levels:
        rms = item.left.rigid_removed.rms_um
        rows.append([item.label, _three(item.left.after), _three(item.left.rigid_removed), _gain(before, rms)])
        before = rms
    return rows


def _gain(before_um: float | None, after_um: float) -> str:
    """By how much a level shrinks the rms, um and per cent; nothing where it does not."""
    if before_um is None:
        return ""
    gain = before_um - after_um
    worth = gain > max(LEAST_GAIN * before_um, LEAST_GAIN_UM)
    return f"{um(gain)} um, {100.0 * gain / before_um:.0f} %" if worth else "nothing"


def control_rows(result: Capability) -> list[list[str]]:
    """Rows control, level, left, left*, remark."""
    return [[item.label, _level(item), *_figures(item.left), _remark(item)] for item in result.controls]


def _level(item: ControlResult) -> str:
    if item.level is None:
        return "-"
    return LABELS[item.level] + (", " + LABELS["directional"].lstrip("+ ") if item.directional else "")


def _figures(left: Left | None) -> list[str]:
    return ["-", "-"] if left is None else [_three(left.after), _three(left.rigid_removed)]


def _remark(item: ControlResult) -> str:
    if item.problem:
        return f"cannot be exported: {item.problem}"
    broken = [f"{len(item.broken)} limits broken, first: {item.broken[0]}"] if item.broken else []
    other = [] if item.own else ["not as in the machine file"]
    return "; ".join([*broken, *other, *item.notes])


def _shown_levels(result: Capability) -> list[str]:
    return [item.key for item in result.levels]


def error_rows(result: Capability, tool: int) -> list[list[str]]:
    """Rows error and, by level, the largest displacement in um that it leaves with tool number ``tool``."""
    rows = []
    for name in result.levels[0].by_tool[tool][1]:
        values = [result.level(key).by_tool[tool][1][name] for key in _shown_levels(result)]
        if max(values) >= LISTED_FROM_UM:
            rows.append([name, *map(um, values)])
    return rows


def tool_rows(result: Capability) -> list[list[str]]:
    """Rows tool offset and, by level, largest / rms of all errors together as it stands."""
    return [
        [tool_name(tool), *(um(result.level(key).by_tool[k][0].after.max_um) for key in _shown_levels(result))]
        for k, tool in enumerate(result.tools_mm)
    ]


def _level_headings(result: Capability) -> list[str]:
    return [LABELS[key] for key in _shown_levels(result)]


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number == 0 or heading == "remark" else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def options_tables(result: Capability) -> Group:
    """Return what the terminal shows: levels, controls, errors that stay with the machine's own tool, tools."""
    own = tool_name(result.tools_mm[0])
    levels = ["tables hold", "left", "left*", "buys"]
    controls = ["control", "level", "left", "left*", "remark"]
    return Group(
        _table(f"{result.machine}: what each level of option leaves (max / rms / p95, um)", levels, level_rows(result)),
        _table("what the file of each control leaves, read back (max / rms / p95, um)", controls, control_rows(result)),
        _table(
            f"largest displacement that each error leaves by itself, um, tool offset {own}",
            ["error", *_level_headings(result)],
            error_rows(result, 0),
        ),
        _table(
            "largest error left with tools of other offset (mm), um, all errors together",
            ["tool offset", *_level_headings(result)],
            tool_rows(result),
        ),
        Text(LEGEND),
        *(Text(note, "yellow") for note in result.notes),
    )


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, with a line end."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |\n" for line in lines)


def options_markdown(result: Capability) -> str:
    """Return ``options.md``."""
    zone = "the whole travel" if result.zone_mm is None else _zone_words(result)
    parts = [
        f"# Options for {result.machine}\n\nJudged at {result.points} points over {zone}.\n",
        "## What each level of option leaves\n\n"
        + markdown_table(["tables hold", "left, um (max / rms / p95)", "left*, um", "buys"], level_rows(result)),
        LEGEND + "\n",
        "## What the file of each control leaves\n\n"
        + markdown_table(
            ["control", "level", "left, um (max / rms / p95)", "left*, um", "remark"], control_rows(result)
        ),
        "## Largest error with tools of other offset, um\n\n"
        + markdown_table(["tool offset, mm", *_level_headings(result)], tool_rows(result)),
        "## Which errors stay\n\nLargest displacement in um that each error leaves by itself, to first order.\n",
    ]
    for k, tool in enumerate(result.tools_mm):
        heading = f"### Tool offset {tool_name(tool)}{' mm' if any(tool) else ''}{' (of the machine file)' if not k else ''}\n\n"
        parts.append(heading + markdown_table(["error", *_level_headings(result)], error_rows(result, k)))
    if result.notes:
        parts.append("## Notes\n\n" + "".join(f"- {note}\n" for note in result.notes))
    return "\n".join(parts)


def _zone_words(result: Capability) -> str:
    ends = zip("XYZ", result.zone_mm or (), strict=False)
    return ", ".join(f"{axis} {part[0]:g} ... {part[1]:g} mm" for axis, part in ends if part is not None)
