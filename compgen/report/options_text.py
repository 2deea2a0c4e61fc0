"""What the options of a control would gain: tables for the terminal, `options.md` and `explain.md`."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.data.comparison import Residuals
from compgen.errors import um_text
from compgen.tables.options import CORRECTED_UM, LABELS, Capability, Explanation, Left, LevelResult

# What the options of a control would gain: tables for the terminal, and ``options.md``.


#: The row of a corrected NC program among the levels.
PROGRAM = "none, and the NC program corrected"
#: What three skew factors correct: this is none of the levels.
SQUARENESS_ALONE = "squareness alone"
#: Errors that leave less than this at every tool and level are not listed, um.
LISTED_FROM_UM = 0.1
#: A level that reduces the rms by less than this share, or by less than this much, gains nothing.
LEAST_GAIN, LEAST_GAIN_UM = 0.005, 0.05
#: Heading of the rms that has in it what the measurement does not know.
UNKNOWN = "with what is not known*"
#: What is written where the uncertainty is not determined.
NOT_DETERMINED = "not determined"
LEGEND = (
    "left: what the best table of that level leaves of the errors found, largest / rms / 95 % in um, with no more digits than "
    "the uncertainty leaves; left*: the best-fit rigid motion of the workpiece removed; with what is not known*: rms* of both, "
    "what is left and what the measurement does not know; gain: reduction of that (where the uncertainty is not determined, of "
    "rms*) compared with the level above, with the tool of the machine file: full volumetric compensation pays off with other "
    "tools. A level may contain a constant shift of an axis, which a workpiece offset can do as well; controls whose tables are "
    "zero at the reference point do not. A program corrected by `volcomp correct` leaves the last decimal of its coordinates and "
    "what is not known; with program*: the control adds its table, and a program made with `--active` corrects what that leaves "
    "(rigid motion removed, in the decimals of the control's programs)."
)


def _three(result: Capability, figures: Residuals) -> str:
    """Largest, rms and 95 % of what a table leaves of the errors found, with as many digits as mean something."""
    known = result.uncertainty
    u_max, u_rms = (None, None) if known is None else (known.max_um, known.rms_um)
    largest, most = um_text(figures.max_um, u_um=u_max), um_text(figures.p95_um, u_um=u_max)
    return f"{largest} / {um_text(figures.rms_um, u_um=u_rms)} / {most}"


def _with_unknown(result: Capability, left: Left | None) -> str:
    """The rms of what is left and of what is not known, the rigid motion removed."""
    found = None if left is None else result.with_unknown_um(left)
    if found is None:
        return "-" if left is None else NOT_DETERMINED
    return um_text(found[1])


def uncertainty_lines(result: Capability) -> list[str]:
    """Return the uncertainty of every figure, and what was assumed of what was not measured."""
    known = result.uncertainty
    text = f"uncertainty of every figure after compensation: {NOT_DETERMINED}"
    if known is not None:
        text = (
            "uncertainty of every figure after compensation, whatever the tables contain: U = "
            f"{um_text(known.rms_um)} um rms over the volume, {um_text(known.max_um)} um where it is largest (k = 2); "
            f"rigid motion removed {um_text(known.rms_rigid_removed_um)} and {um_text(known.max_rigid_removed_um)} um"
        )
    return [text, *result.assumed]


def tool_name(tool_mm: Sequence[float]) -> str:
    """A tool offset in words, e.g. ``Z -100`` or ``none``."""
    parts = [f"{axis} {value:g}" for axis, value in zip("XYZ", tool_mm, strict=True) if value]
    return ", ".join(parts) or "none"


def level_rows(result: Capability) -> list[list[str]]:
    """Return rows of level, left, left*, with what is not known*, gain."""
    rows, before = [], None
    for item in result.levels:
        found = result.with_unknown_um(item.left)
        rms = item.left.rigid_removed.rms_um if found is None else found[1]
        shown = _three(result, item.left.after), _three(result, item.left.rigid_removed)
        rows.append([item.label, *shown, _with_unknown(result, item.left), _gain(before, rms)])
        before = rms
    if result.program is not None:
        left = result.program.left
        figures = _three(result, left.after), _three(result, left.rigid_removed)
        rows.append([PROGRAM, *figures, _with_unknown(result, left), "rounding of the program"])
    return rows


def _gain(before_um: float | None, after_um: float) -> str:
    """Return by how much a level reduces the rms, um and per cent, or "nothing"."""
    if before_um is None:
        return ""
    gain = before_um - after_um
    worth = gain > max(LEAST_GAIN * before_um, LEAST_GAIN_UM)
    return f"{um_text(gain)} um, {100.0 * gain / before_um:.0f} %" if worth else "nothing"


def control_rows(result: Capability) -> list[list[str]]:
    """Return rows of control, level, left, left*, what table and program leave together, remark."""
    rows = []
    for item in result.controls:
        directional = f", {LABELS['directional'].lstrip('+ ')}" if item.directional else ""
        level = "-" if item.level is None else LABELS.get(item.level, SQUARENESS_ALONE) + directional
        left = ["-", "-"]
        if item.left is not None:
            left = [_three(result, item.left.after), _three(result, item.left.rigid_removed)]
        left += [_with_unknown(result, item.left)]
        left.append("-" if item.both is None else _three(result, item.both.left.rigid_removed))
        broken = [f"{len(item.broken)} limits exceeded, first: {item.broken[0]}"] if item.broken else []
        other = [] if item.own else ["not as in the machine file"]
        remark = f"cannot be exported: {item.problem}" if item.problem else "; ".join([*broken, *other, *item.notes])
        rows.append([item.label, level, *left, remark])
    return rows


def _shown_levels(result: Capability) -> list[str]:
    return [item.key for item in result.levels]


def error_rows(result: Capability, tool: int) -> list[list[str]]:
    """Return rows of error and, by level, the largest displacement in um that remains with tool number ``tool``."""
    rows = []
    for name in result.levels[0].by_tool[tool][1]:
        values = [result.level(key).by_tool[tool][1][name] for key in _shown_levels(result)]
        if max(values) >= LISTED_FROM_UM:
            rows.append([name, *(_of_largest(result, value) for value in values)])
    return rows


def _of_largest(result: Capability, value_um: float) -> str:
    """A largest displacement, with as many digits as the uncertainty leaves."""
    return um_text(value_um, u_um=None if result.uncertainty is None else result.uncertainty.max_um)


def tool_rows(result: Capability) -> list[list[str]]:
    """Return rows of tool offset and, by level, largest / rms of all errors together, with the reference point fixed."""
    return [
        [
            tool_name(tool),
            *(_of_largest(result, result.level(key).by_tool[k][0].after.max_um) for key in _shown_levels(result)),
        ]
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
    """Return the tables for the terminal: levels, controls, errors that remain with the machine's tool, other tools."""
    own = tool_name(result.tools_mm[0])
    levels = ["tables contain", "left", "left*", UNKNOWN, "gain"]
    controls = ["control", "level", "left", "left*", UNKNOWN, "with program*", "remark"]
    return Group(
        _table(f"{result.machine}: what each level of option leaves (max / rms / p95, um)", levels, level_rows(result)),
        _table("what the file of each control leaves, read back (max / rms / p95, um)", controls, control_rows(result)),
        _table(
            f"largest displacement left by each single error, um, tool offset {own}",
            ["error", *_level_headings(result)],
            error_rows(result, 0),
        ),
        _table(
            "largest error left with other tool offsets (mm), um, all errors together",
            ["tool offset", *_level_headings(result)],
            tool_rows(result),
        ),
        *(Text(text) for text in uncertainty_lines(result)),
        Text(LEGEND),
        *(Text(note, "yellow") for note in result.notes),
    )


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown, with a line end."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |\n" for line in lines)


def options_markdown(result: Capability) -> str:
    """Return ``options.md``."""
    ends = zip("XYZ", result.zone_mm or (), strict=False)
    zone = ", ".join(f"{axis} {part[0]:g} ... {part[1]:g} mm" for axis, part in ends if part is not None)
    parts = [
        f"# Options for {result.machine}\n\nEvaluated at {result.points} points over {zone or 'the whole travel'}.\n",
        "## What each level of option leaves\n\n"
        + markdown_table(
            ["tables contain", "left, um (max / rms / p95)", "left*, um", f"{UNKNOWN}, um", "gain"], level_rows(result)
        ),
        "".join(f"- {text}\n" for text in uncertainty_lines(result)),
        LEGEND + "\n",
        "## What the file of each control leaves\n\n"
        + markdown_table(
            [
                "control",
                "level",
                "left, um (max / rms / p95)",
                "left*, um",
                f"{UNKNOWN}, um",
                "with program*, um",
                "remark",
            ],
            control_rows(result),
        ),
        "## Largest error with other tool offsets, um\n\n"
        + markdown_table(["tool offset, mm", *_level_headings(result)], tool_rows(result)),
        "## Which errors remain\n\nLargest displacement in um left by each single error, to first order.\n",
    ]
    for k, tool in enumerate(result.tools_mm):
        heading = f"### Tool offset {tool_name(tool)}{' mm' if any(tool) else ''}{' (of the machine file)' if not k else ''}\n\n"
        parts.append(heading + markdown_table(["error", *_level_headings(result)], error_rows(result, k)))
    if result.notes:
        parts.append("## Notes\n\n" + "".join(f"- {note}\n" for note in result.notes))
    return "\n".join(parts)


# ``explain.md``: what a control's table corrects, what remains and why, what the next option gains, limits used.


#: An error counts as corrected, at least in part, if less than this share of it remains.
LEAST_HELP = 0.9
#: Levels of controls with a linear map, which are on the way to no other level.
LINEAR = ("skew", "matrix")
#: What a control of each level corrects, in words.
CORRECTS = {
    "skew": SQUARENESS_ALONE,
    "matrix": "squareness and the mean scale of each axis",
    "pitch": "positioning along each axis",
    "squareness": "positioning, straightness and squareness",
    "products": "positioning, straightness, squareness, and angles as products of tables",
    "volumetric": "all errors of its volumetric model, for the active tool",
}


def explanation_markdown(item: Explanation) -> str:
    """Return ``explain.md``."""
    text = f"# Control {item.controller}, machine {item.machine}\n\nThis control corrects {CORRECTS[item.level]}."
    if item.own is not None and item.own.left is not None:
        before, after = item.options.level("nothing").left.rigid_removed, item.own.left.rigid_removed
        largest, rms = zip(*(_three(item.options, part).split(" / ")[:2] for part in (before, after)), strict=True)
        text += (
            f" Its file changes the effect of the errors found from {largest[0]} to {largest[1]} um (largest) "
            f"and from {rms[0]} to {rms[1]} um (rms over the volume), the best-fit rigid motion removed, "
            f"as read back from the file. {_known_after(item.options, item.own.left)}"
        )
    parts = [text + "\n", "".join(f"- {line}\n" for line in uncertainty_lines(item.options))]
    helped = [fate for fate in item.fates if fate.after_um < LEAST_HELP * fate.before_um]
    rows = [[fate.name, *(_of_largest(item.options, x) for x in (fate.before_um, fate.after_um))] for fate in helped]
    if rows:
        table = markdown_table(["error", "displacement before, um", "left, um"], rows)
        parts.append("## What it corrects\n\n" + table)
    rows = [
        [fate.name, _of_largest(item.options, fate.after_um), fate.why]
        for fate in item.fates
        if fate.after_um > CORRECTED_UM
    ]
    table = markdown_table(["error", "left, um", "why"], rows) if rows else f"Nothing above {CORRECTED_UM:g} um.\n"
    notes = "".join(f"\n{note[0].upper()}{note[1:]}.\n" for note in item.notes)
    other = ""
    if item.level not in ("volumetric", *LINEAR):
        results = zip(item.options.tools_mm, _level(item).by_tool, strict=True)
        tools = [
            f"{_of_largest(item.options, left.after.max_um)} um at {tool_name(tool) if any(tool) else 'no offset'}"
            for tool, (left, _) in results
        ]
        other = (
            "\nThe tables were made for the tool offset of the machine file. With other tools an angular error acts at another "
            f"lever; the largest error that the best table of this level leaves is {', '.join(tools)}.\n"
        )
    parts.append("## What remains, and why\n\n" + table + other + notes)
    return "\n".join([*parts, _next(item), _nodes(item), _limits(item)])


def _known_after(options: Capability, left: Left) -> str:
    """What the error of the machine will be, with what the measurement does not know."""
    found = options.with_unknown_um(left)
    if found is None:
        return "What the machine will do with it is not determined: nothing is said of what was not measured."
    return f"With what the measurement does not know, {um_text(found[1])} um rms is to be expected."


def _level(item: Explanation) -> LevelResult:
    """The level that the control reaches; linear maps are on the way to none of them."""
    return item.options.level("nothing" if item.level in LINEAR else item.level)


def _next(item: Explanation) -> str:
    current = _level(item)
    following, result = [], item.options.after(current.key)
    while result is not None:
        if not (result.key == "directional" and item.own is not None and item.own.directional):
            following.append(result)
        result = item.options.after(result.key)
    if not following:
        return "## What the next option would gain\n\nNothing: this is the highest level for these errors.\n"
    rows = [
        [level.label, *(part for part in _three(item.options, level.left.rigid_removed).split(" / ")[:2]),
         _with_unknown(item.options, level.left)]
        for level in (current, *following)
    ]  # fmt: skip
    return "## What the next option would gain\n\n" + markdown_table(
        ["tables contain", "largest left, um", "rms left, um", f"{UNKNOWN[:-1]}, um rms"], rows
    )


def _nodes(item: Explanation) -> str:
    rows = [
        [
            axis,
            f"{int(node['nodes'])}",
            f"{node['first_mm']:g} ... {node['last_mm']:g}",
            f"{node['smallest_step_mm']:g} ... {node['largest_step_mm']:g}",
        ]
        for axis, node in item.nodes.items()
    ]
    steps = [
        [f"{step.output} along {step.along}", um_text(step.step_um), f"{step.from_mm:g} ... {step.to_mm:g}"]
        for step in item.steps
    ]
    text = "## Nodes, rounding, steps\n\n" + markdown_table(["over", "nodes", "from ... to, mm", "step, mm"], rows)
    text += f"\nRounding changes the correction of an axis by at most {item.rounding_um:.3g} um.\n"
    if steps:
        headings = ["correction", "largest step between nodes, um", "between, mm"]
        text += "\n" + markdown_table(headings, steps)
    return text


def _limits(item: Explanation) -> str:
    text = "## Limits used\n\n"
    if item.usage:
        rows = [
            [
                usage.name if usage.stated else f"{usage.name}, usual default",
                f"{usage.used:.4g} {usage.unit}",
                f"{usage.allowed:g} {usage.unit}",
                f"{100 * usage.share:.0f}",
                f"{usage.allowed - usage.used:.4g}",
            ]
            for usage in item.usage
        ]
        headings = ["limit", "used", "allowed", "used, %", "margin"]
        text += "Smallest margin first.\n\n" + markdown_table(headings, rows)
    else:
        text += "The control states no limits.\n"
    return text + "".join(f"\nBroken: {violation}.\n" for violation in item.violations)
