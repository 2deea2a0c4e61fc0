"""``volcomp recal add``, ``export-units``, ``backup`` and ``restore``: the job file, its units, the store as a whole."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import json_option, print_json, stdout
from compgen.cli.recal_commands import JOB, job_option, needed, recal

if TYPE_CHECKING:
    from compgen.recal.job import Job

_PATH = click.Path(path_type=Path)


@recal.command("export-units")
@job_option
@click.option("--out", required=True, metavar="DIR", type=_PATH, help="Folder for the files.")
@click.option("--program", default=None, metavar="PATH", help="The compgen command; default: the one that runs now.")
@json_option
def export_units_command(job: Job, out: Path, program: str | None, as_json: bool) -> int:
    """Write systemd service and timer units and crontab lines that drive `volcomp recal run` by the job's schedules.

    \b
    Example:
      volcomp recal export-units --out units/
    """
    from compgen.pipeline import write_all
    from compgen.recal.units import units

    paths = write_all(out, units(job, program or str(Path(sys.argv[0]).absolute())))
    if as_json:
        print_json({"accepted": True, "paths": [str(path) for path in paths.values()]})
    else:
        for path in paths.values():
            stdout.print(str(path), soft_wrap=True)
    return 0


@recal.command("backup")
@click.argument("file", type=_PATH)
@job_option
@json_option
def backup_command(file: Path, job: Job, as_json: bool) -> int:
    """Write a copy of the whole store to FILE, as it is at one moment, while others may be working with it.

    \b
    Example:
      volcomp recal backup backups/2026-06-01.sqlite
    """
    from compgen.recal.backup import backup

    return _copied(backup(job.store, file), as_json)


@recal.command("restore")
@click.argument("file", type=_PATH)
@job_option
@json_option
def restore_command(file: Path, job: Job, as_json: bool) -> int:
    """Fill the store of the job, which must be empty, from the backup FILE; the next run writes the tables again.

    \b
    Example:
      volcomp recal restore backups/2026-06-01.sqlite --job recal.toml
    """
    from compgen.recal.backup import restore

    return _copied(restore(file, job.store), as_json)


def _copied(counts: dict[str, int], as_json: bool) -> int:
    if as_json:
        print_json({"accepted": True, "rows": counts})
    else:
        stdout.print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()), soft_wrap=True)
    return 0


@recal.command("add")
@click.argument("name")
@click.option("--machine", required=True, metavar="MACHINE", help="Machine TOML, or the name of a machine.")
@click.option("--inbox", required=True, metavar="DIR", help="Folder where measurements arrive.")
@click.option(
    "--controller", "controllers", required=True, multiple=True, metavar="NAME", help="May be given several times."
)
@click.option("--out", required=True, metavar="DIR", help="Folder for the tables of this machine.")
@click.option(
    "--measured-with",
    required=True,
    type=click.Choice(["active", "bare"]),
    help="Whether the compensation stays on (active) or is switched off (bare) while the machine is measured.",
)
@click.option("--schedule", default=None, metavar="CRON", help="Cron expression of five fields, local time.")
@click.option("--every-minutes", default=None, type=int, help="In place of --schedule: an interval in minutes.")
@click.option("--approval", default=None, type=click.Choice(["manual", "auto"]), help="Default: manual.")
@click.option("--instrument", default=None, metavar="FILE", help="Instrument TOML of six-DOF readings.")
@click.option("--job", "job_file", default=JOB, show_default=True, type=_PATH, metavar="FILE", help="Job file.")
@json_option
def add_command(name: str, job_file: Path, as_json: bool, controllers: tuple[str, ...], **keys: Any) -> int:
    """Add the machine NAME to the job file, which is made if it does not exist; paths are relative to it.

    \b
    Example:
      volcomp recal add mill-1 --machine mill-1.toml --inbox inbox --controller siemens-cec --out tables \\
                    --measured-with bare --schedule "30 6 * * mon"
    """
    needed()
    from compgen.recal.edit import add_machine

    added = add_machine(job_file, name, {**keys, "controllers": list(controllers)})
    if as_json:
        print_json({"accepted": True, "job": str(job_file), "machine": added.name})
    else:
        stdout.print(
            f"{added.name}: added to {job_file}; `volcomp recal run --job {job_file}` looks into {added.inbox}"
        )
    return 0


#: Its commands belong to the group ``recal``.
COMMANDS: tuple[click.Command, ...] = ()
