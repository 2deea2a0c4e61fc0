"""``explain.md``: what a control's table corrects, what stays and why, what the next option buys, what it uses."""

from __future__ import annotations

from compgen.controllers.base import Usage
from compgen.report.options_text import markdown_table, tool_name, um
from compgen.verify.capability import Left, LevelResult
from compgen.verify.explain import CORRECTED_UM, Explanation

#: An error counts as corrected, in part at least, if less than this share of it stays.
LEAST_HELP = 0.9
#: What a control of each level holds, in words.
HOLDS = {
    "pitch": "positioning along each axis",
    "squareness": "positioning, straightness and squareness",
    "products": "positioning, straightness, squareness, and angles as products of tables",
    "volumetric": "all errors of its volumetric model, at the tool in use",
}


def explanation_markdown(item: Explanation) -> str:
    """Return ``explain.md``."""
    parts = [
        f"# {item.controller} on {item.machine}\n\nThis control holds {HOLDS[item.level]}.{_figures(item)}\n",
        _corrected(item),
        _stays(item),
        _next(item),
        _nodes(item),
        _limits(item),
    ]
    return "\n".join(part for part in parts if part)


def _figures(item: Explanation) -> str:
    if item.own is None or item.own.left is None:
        return ""
    before, after = item.options.level("nothing").left, item.own.left
    return (
        f" The error over the volume goes from {um(before.rigid_removed.max_um)} to {um(after.rigid_removed.max_um)} um "
        f"(largest) and from {um(before.rigid_removed.rms_um)} to {um(after.rigid_removed.rms_um)} um (rms), the best-fit "
        "rigid motion taken out, by the file as it is written."
    )


def _corrected(item: Explanation) -> str:
    helped = [fate for fate in item.fates if fate.after_um < LEAST_HELP * fate.before_um]
    rows = [[fate.name, um(fate.before_um), um(fate.after_um)] for fate in helped]
    if not rows:
        return ""
    return "## What it corrects\n\n" + markdown_table(["error", "displacement before, um", "left, um"], rows)


def _stays(item: Explanation) -> str:
    rows = [[fate.name, um(fate.after_um), fate.why] for fate in item.fates if fate.after_um > CORRECTED_UM]
    table = markdown_table(["error", "left, um", "why"], rows) if rows else f"Nothing above {CORRECTED_UM:g} um.\n"
    notes = "".join(f"\n{note[0].upper()}{note[1:]}.\n" for note in item.notes)
    other = ""
    if item.level != "volumetric":
        tools = [f"{um(left.after.max_um)} um at {tool}" for tool, left in _by_tool(item)]
        other = (
            "\nThe tables were made for the tool offset of the machine file. With others an angular error acts at another "
            f"lever; the largest error that the best table of this level leaves is {', '.join(tools)}.\n"
        )
    return "## What stays, and why\n\n" + table + other + notes


def _by_tool(item: Explanation) -> list[tuple[str, Left]]:

    results = item.options.level(item.level).by_tool
    return [
        (tool_name(tool) if any(tool) else "no offset", left)
        for tool, (left, _) in zip(item.options.tools_mm, results, strict=True)
    ]


def _next(item: Explanation) -> str:
    current = item.options.level(item.level)
    following = [result for result in _following(item, current)]
    if not following:
        return "## What the next option would buy\n\nNothing more: this is the highest level for these errors.\n"
    rows = [
        [result.label, um(result.left.rigid_removed.max_um), um(result.left.rigid_removed.rms_um)]
        for result in (current, *following)
    ]
    return "## What the next option would buy\n\n" + markdown_table(
        ["tables hold", "largest left, um", "rms left, um"], rows
    )


def _following(item: Explanation, current: LevelResult) -> list[LevelResult]:
    found, result = [], item.options.after(current.key)
    while result is not None:
        if not (result.key == "directional" and item.own is not None and item.own.directional):
            found.append(result)
        result = item.options.after(result.key)
    return found


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
        [f"{step.output} along {step.along}", um(step.step_um), f"{step.from_mm:g} ... {step.to_mm:g}"]
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
        text += "Smallest margin first.\n\n" + markdown_table(
            ["limit", "used", "allowed", "used, %", "margin"], [_usage_row(usage) for usage in item.usage]
        )
    else:
        text += "The control states no limits of its own.\n"
    return text + "".join(f"\nBroken: {violation}.\n" for violation in item.violations)


def _usage_row(usage: Usage) -> list[str]:
    name = usage.name if usage.stated else f"{usage.name}, usual default"
    allowed, margin = usage.allowed, usage.allowed - usage.used
    return [
        name,
        f"{usage.used:.4g} {usage.unit}",
        f"{allowed:g} {usage.unit}",
        f"{100 * usage.share:.0f}",
        f"{margin:.4g}",
    ]
