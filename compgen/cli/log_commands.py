"""``volcomp log``: temperatures while one measures."""

from __future__ import annotations

import re
from pathlib import Path

import click

from compgen.cli.common import NUMBER, PATH, json_option, stopped_by_signals
from compgen.cli.terminal import answer, complain
from compgen.data.files import OutputFolder
from compgen.errors import InputError, doubled, visible_line

_NAME = re.compile(r"[A-Za-z][\w-]{0,40}")


def _sensors(given: tuple[str, ...]) -> dict[str, str]:
    """Where each sensor is, by its name."""
    found: dict[str, str] = {}
    for text in given:
        name, equals, key = (part.strip() for part in text.partition("="))
        name = name.removeprefix("temp_").removesuffix("_c")
        if not equals or not key or not _NAME.fullmatch(name):
            raise InputError(
                f"{visible_line(text)[:60]!r} is no sensor; expected NAME=WHERE, e.g. spindle=ns=2;s=Spindle.Temperature",
                field="--sensor",
            )
        found[name] = key
    names = [text.partition("=")[0].strip().removeprefix("temp_").removesuffix("_c") for text in given]
    if doubled(names) is not None:
        raise InputError(f"{doubled(names)} is given twice", field="--sensor")
    return found


@click.command("log")
@click.argument("source")
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    required=True,
    metavar="NAME=WHERE",
    help="A sensor: its name, and the node id (OPC UA), dataItemId or name (MTConnect), pin or signal (HAL), column (file).",
)
@click.option("--out", required=True, metavar="FILE", type=PATH, help="*.temperatures.csv to write; it must not exist.")
@click.option("--interval", type=NUMBER, default=10.0, show_default=True, metavar="S", help="Time between readings, s.")
@click.option("--hours", type=NUMBER, default=24.0, show_default=True, help="End after so many hours.")
@json_option
def log_command(source: str, sensors: tuple[str, ...], out: Path, interval: float, hours: float, as_json: bool) -> int:
    """Write the temperatures (degC) of a machine to a file while it is measured, until Ctrl-C.

    SOURCE is an OPC UA server (opc.tcp://HOST:PORT; needs compgen[opcua]), the address of an MTConnect agent
    (http://HOST:5000/current), the pins of a running LinuxCNC (hal:), or the file of a logger or a serial port, of which the
    newest line is read. A connection that is lost is tried again; the gap is marked in the file. Times are those of this
    computer. Exit code 1 if nothing was read.

    \b
    Example:
      volcomp log opc.tcp://mill-1:4840 --sensor "spindle=ns=2;s=Spindle.Temp" --out day.temperatures.csv
    """
    from compgen.heat.recorder import Recorder
    from compgen.heat.sources import source_named

    if not 0.1 <= interval <= 3600:
        raise InputError("must be 0.1 to 3600 s", field="--interval")
    if not 0 < hours <= 24 * 31:
        raise InputError("must be above 0 and at most 744", field="--hours")
    if not out.name.endswith(".csv"):
        raise InputError("must end with .temperatures.csv", file=out, field="--out")
    if out.exists():
        raise InputError("exists already; give another name, so that no day is lost", file=out)
    OutputFolder(out.absolute().parent)  # refused before the first reading if it cannot be written
    keys = _sensors(sensors)
    recorder = Recorder(source_named(source, keys), tuple(keys), out, interval, source)
    with stopped_by_signals() as stop:
        done = recorder.run(stop, hours * 3600.0, complain)
    data = {
        "file": str(out) if done.rows else None,
        "rows": done.rows,
        "gaps": [{"from": begin, "to": end, "reason": why} for begin, end, why in done.gaps],
        "implausible": done.implausible,
        "source_clock_minus_ours_s": done.clock_offset_s,
    }
    answer(as_json, data, *(done.lines() if done.rows else ["nothing was read, and nothing written"]))
    return 0 if done.rows else 1
