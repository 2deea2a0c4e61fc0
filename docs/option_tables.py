"""Option tables of docs/commands.md, from the commands themselves: python docs/option_tables.py writes them again.

A table stands between two comments in the section of a command and lists its own options as `--help` does. Options with the
same meaning as in a section above are only named, and those that all commands share are described in the first section.
"""

import re
import sys
from pathlib import Path

import click

from compgen.cli import cli

PAGE = Path(__file__).resolve().parent / "commands.md"
BEGIN, END = "<!-- options, written by docs/option_tables.py -->\n", "<!-- end of options -->\n"
#: Described in the section "What all commands share".
SHARED = {"--machines", "--json", "--quiet", "--verbose", "--plugin", "--language", "--units", "--prior", "--help"}
#: Where more about an option stands; for one command, with its name in front.
SEE = {
    "run --heat": "heat.md#readings-of-known-temperatures",
    "run --temperatures": "heat.md#readings-of-known-temperatures",
    "--allow-misfit": "method.md#what-is-accepted",
    "--certificate": "report.md",
    "--cluster": "recal.md#many-machines",
    "--heat": "heat.md#programs-and-parts-at-stated-temperatures",
    "--instrument": "sixdof.md",
    "--no-report": "report.md",
    "--part-scale": "files.md",
    "--stations": "files.md",
    "--subprograms": "programs.md#subprograms-and-variables",
    "--temperatures": "heat.md#programs-and-parts-at-stated-temperatures",
    "--watch": "programs.md#a-watched-folder",
}
#: How the notes of `--help` behind a meaning are written in a table.
NOTED = {
    r" *\[required\]$": " Required.",
    r"\[default: ([^;\]]+)(?:; )?": r"Default: \1. [",
    r" +\[([-\d.e]+)<=x<=([-\d.e]+)\]$": r" Allowed: \1 to \2.",
    r" +\[x>=([-\d.e]+)\]$": r" At least \1.",
    r" +\[x>([-\d.e]+)\]$": r" Above \1.",
    r" \[\]?$": "",
}


def options_of(name):
    """(option as `--help` writes it, its long names, its meaning) of a command, in the order of `--help`."""
    command = cli.commands[name].loaded
    context = click.Context(command, info_name=name, parent=click.Context(cli, info_name="volcomp"))
    for item in () if isinstance(command, click.Group) else command.params:
        names = [word for word in (*item.opts, *item.secondary_opts) if word.startswith("--")]
        record = item.get_help_record(context)
        if record and names and not SHARED & {*names}:
            yield record[0], names, record[1]


def in_a_table(text):
    """Return a text of `--help` for a cell: options and patterns of files as code, nothing taken for marks."""
    for noted, sentence in NOTED.items():
        text = re.sub(noted, sentence, text)
    text = re.sub(
        r"(?<![\w`-])(--[a-z][\w-]*|`[^`]+`|[\w./-]*\*\.[\w.]+)", lambda found: f"`{found[1].strip('`')}`", text
    )
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(part if part.startswith("`") else re.sub(r"([\\*<\[\]])", r"\\\1", part) for part in parts).replace(
        "|", "\\|"
    )


def table(names, before):
    """Return the table of the commands ``names``; ``before`` has the options of the tables above, and gets these."""
    rows, known = [], {}
    for name in names:
        for shown, words, meaning in options_of(name):
            first = before.setdefault((shown, meaning), name)
            if first != name:
                known.setdefault(first, []).append(f"`{words[0]}`")
                continue
            page = next((SEE[key] for word in words for key in (f"{name} {word}", word) if key in SEE), "")
            see = f" See [{page.partition('#')[0]}]({page})." if page else ""
            who = f" (`{name}`)" if len(names) > 1 else ""
            rows.append(f"| `{shown.replace('|', chr(92) + '|')}`{who} | {in_a_table(meaning)}{see} |\n")
    lines = ["| option | meaning |\n", "|---|---|\n", *rows] if rows else []
    if known:
        lines.append("\n" if rows else "")
        lines += [f"Options as for `{first}`: {', '.join(dict.fromkeys(words))}.\n" for first, words in known.items()]
    return "".join(lines)


def written(page):
    """Return the page with the tables of the commands as they are now."""
    before, parts = {}, re.split(r"(?m)^(?=## )", page)
    for k, part in enumerate(parts):
        heading = part.partition("\n")[0].removeprefix("## ")
        names = [name for name in heading.split(", ") if name in cli.commands]
        if BEGIN in part:
            head, _, rest = part.partition(BEGIN)
            parts[k] = head + BEGIN + table(names, before) + END + rest.partition(END)[2]
    return "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    sys.stdout.write(f"{PAGE.name}\n")
