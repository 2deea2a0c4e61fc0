"""The report in a few lines for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group
from rich.text import Text

from compgen.report.html.content import um

STYLES = {"accepted": "bold green", "rejected": "bold red", "neutral": "bold"}


def short_text(data: Mapping[str, Any]) -> Group:
    """Return verdict, one line per control, the largest error that stays, and where to read on."""
    verdict = data["verdict"]
    lines = [Text(f"{data['title']}: {verdict['headline']}", STYLES.get(verdict["state"], "bold yellow"))]
    if verdict["text"]:
        lines.append(Text(verdict["text"]))
    for item in data["controls"]:
        before, after = item["before"], item["after"]
        what = "" if item["volumetric"] else "measured errors alone "
        figures = f"{what}{um(before.get('max_um'))} -> {um(after.get('max_um'))} um max, "
        figures += f"{um(before.get('rms_um'))} -> {um(after.get('rms_um'))} um rms"
        lines.append(Text(f"  {item['name']}: {item['verdict'].lower()}; {figures}"))
        lines += [Text(f"    {text}", "yellow") for text in item["objections"] if text not in item["reasons"]]
        if item["uncorrected"]:
            largest = item["uncorrected"][0]
            lines.append(Text(f"    stays: {largest['error']} {um(largest['um'])} um; {largest['why']}"))
        lines += [Text(f"    {reason}", "red") for reason in item["reasons"][:3]]
    return Group(*lines)
