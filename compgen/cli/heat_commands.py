"""``volcomp heat``: the model of heat from sessions of drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import NUMBER, PATH, json_option, out_option
from compgen.cli.shared_options import machine_argument
from compgen.cli.terminal import answer, complain, table_of
from compgen.data.files import OutputFolder, json_text
from compgen.data.machine import Machine
from compgen.errors import InputError, doubled

if TYPE_CHECKING:
    from compgen.heat import DriftSession, HeatModel, Learned


@click.command("heat")
@machine_argument
@click.argument("sessions", nargs=-1, required=True, type=PATH)
@click.option(
    "--tolerance-um",
    type=NUMBER,
    default=5.0,
    show_default=True,
    help="Displacement that may be left, um: how long to wait for it is among the figures.",
)
@out_option
@json_option
def heat_command(machine: Machine, sessions: tuple[Path, ...], tolerance_um: float, out: Path, as_json: bool) -> int:
    """Learn how heat moves the tool, from sessions of drift (*.drift.csv), one for each day.

    The displacement of the spindle nose is explained by few temperatures behind lags. Every session is predicted by a model
    that was learned without it: that is what the figures are of. Exit code 1 if the model does not make left-out sessions
    better: NAME.heat.toml is then not written. DIR gets NAME.heat.toml, heat.json with the figures of ISO 230-3 of each session,
    and heat.md.

    \b
    Example:
      volcomp heat mill.toml monday.drift.csv tuesday.drift.csv wednesday.drift.csv --out heat/
    """
    from compgen.heat import learn_heat, read_drift

    if tolerance_um <= 0:
        raise InputError("must be above 0", field="--tolerance-um")
    folder = OutputFolder(out)
    read = [read_drift(path) for path in sessions]
    twice = doubled([item.name for item in read]) or doubled([item.sha256 for item in read])
    if twice is not None:
        raise InputError(f"session {twice} is given twice: a day cannot be judged by itself; give each session once")
    learned = learn_heat(machine.name, read)
    data = _data(machine, read, learned, tolerance_um)
    usable = learned.model if not learned.reasons else None
    name = f"{machine.name}.heat.toml"
    if usable is not None:
        folder.add(name, usable.text({item.name: item.sha256 for item in read}))
        data["files"] = [name]
    folder.add("heat.json", json_text(data))
    folder.add("heat.md", _page(data))
    folder.commit()
    for reason in learned.reasons:
        complain(f"refused: {reason}", "red")
    tables = [_table(data["sessions"])] if data["sessions"] else []
    answer(as_json, data, *tables, *_lines(data), f"-> {out / (name if usable is not None else 'heat.md')}")
    return 0 if usable is not None else 1


def _data(machine: Machine, read: Sequence[DriftSession], learned: Learned, tolerance_um: float) -> dict[str, Any]:
    """Return what ``--json`` prints and ``heat.json`` has."""
    from compgen.heat.etve import etve_figures, warm_up

    model, etve = learned.model, [etve_figures(item, tolerance_um) for item in read]
    return {
        "accepted": model is not None and not learned.reasons,
        "machine": machine.name,
        "tolerance_um": tolerance_um,
        "reasons": list(learned.reasons),
        "notes": [*learned.notes, *(text for item in read for text in item.temperatures.notes)],
        "terms": _terms(model),
        "left_out": {} if model is None else {k: {"before_rms": b, "after_rms": a} for k, (b, a) in model.rms.items()},
        "sessions": [dict(row) for row in learned.sessions],
        "without_sensor": dict(learned.gains),
        "hull": [] if model is None else [_range_of(item) for item in model.hull],
        "etve": etve,
        "warm_up": warm_up([item["wait_min"] for item in etve]),
        "files": [],
    }


def _range_of(item: Any) -> dict[str, Any]:
    return {"what": item.text, "low_c": item.low, "high_c": item.high, "margin_k": item.margin_k}


def _terms(model: HeatModel | None) -> list[dict[str, Any]]:
    if model is None:
        return []
    found = []
    for k, term in enumerate(model.terms):
        row: dict[str, Any] = {"sensor": term.sensor, "lag_s": term.lag_s, "start": term.start, "text": term.text}
        for name, value in term.per_k.items():
            u = float(model.covariance[name][k, k] ** 0.5)
            row[name] = {"per_k": value, "u_per_k": u}
        found.append(row)
    return found


def _table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return the table of sessions: what is left of each when it was left out."""
    names = [key.removesuffix("_um").removesuffix("_before_rms") for key in rows[0] if key.endswith("_before_rms_um")]
    headings = ["session left out (um rms)"]
    for name in names:
        headings += [f"{name} before", "after", "in the hull"]
    lines = []
    for row in rows:
        cells = [str(row["file"])]
        for name in names:
            cells += [f"{row[f'{name}_{key}_rms_um']:.2f}" for key in ("before", "after", "after_in_hull")]
        lines.append(cells)
    return table_of(headings, lines)


def _lines(data: Mapping[str, Any]) -> list[str]:
    """Return what is said in words of the model, the sensors and the wait."""
    found = []
    for term in data["terms"]:
        parts = [
            f"{name} {term[name]['per_k']:+.2f} (u {term[name]['u_per_k']:.2f}) {'urad' if name in ('ea', 'eb') else 'um'}/K"
            for name in ("dx", "dy", "dz", "ea", "eb")
            if name in term
        ]
        found.append(f"{term['text']}: {', '.join(parts)}")
    for name, figures in data["left_out"].items():
        unit = "urad" if name in ("ea", "eb") else "um"
        found.append(f"{name}: left-out sessions {figures['before_rms']:.2f} -> {figures['after_rms']:.2f} {unit} rms")
    found += [f"without {name}: {factor:.2f} times as much is left" for name, factor in data["without_sensor"].items()]
    waits = [item["wait_min"] for item in data["etve"]]
    known = [wait for wait in waits if wait is not None]
    if known:
        missing = len(waits) - len(known)
        more = f"; {missing} of {len(waits)} sessions had not settled at their end" if missing else ""
        found.append(
            f"wait until the rest is below {data['tolerance_um']:g} um: {min(known):.0f} ... {max(known):.0f} min{more}"
        )
    if (own := data["warm_up"]) is not None:
        found.append(
            f"warm-up: {own['mean_min']:.0f} min (standard deviation between {own['sessions']} days "
            f"{own['s_min']:.0f} min); on 19 of 20 days "
            f"{own['enough_min']:.0f} min are enough"
        )
    elif known:
        why = "it needs two sessions" if len(waits) < 2 else "a session had not settled at its end"
        found.append(f"warm-up: how long it takes on another day is not known: {why}")
    elif waits:
        found.append(f"no session had settled to {data['tolerance_um']:g} um at its end: how long to wait is not known")
    return found + list(data["notes"])


def _page(data: Mapping[str, Any]) -> str:
    """Return heat.md: the model, the sessions that were left out, and the figures of ISO 230-3."""
    lines = [f"# Heat of {data['machine']}", ""]
    lines += [f"Refused: {reason}." for reason in data["reasons"]]
    lines += [f"- {text}" for text in _lines(data)]
    lines += ["", "Displacements are of the tool relative to the workpiece, actual minus nominal.", ""]
    for title, rows in (("Sessions left out", data["sessions"]), ("Drift (ISO 230-3, ETVE)", data["etve"])):
        if rows:
            lines += [f"## {title}", "", *_markdown(rows), ""]
    return "\n".join(lines)


def _markdown(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table with a line for each figure and a column for each session."""
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if key != "file"]
    head = "| figure | " + " | ".join(str(row["file"]) for row in rows) + " |"
    body = [f"| {key} | " + " | ".join(_cell(row.get(key)) for row in rows) + " |" for key in keys]
    return [head, "|---" * (len(rows) + 1) + "|", *body]


def _cell(value: Any) -> str:
    return "not known" if value is None else f"{value:.2f}"
