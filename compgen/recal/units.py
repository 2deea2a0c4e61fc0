"""Files by which a scheduler of the system drives ``volcomp recal run``: systemd service and timer, lines of a crontab.

Machines with the same schedule share one timer; a machine without one is looked at every hour.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from compgen.recal.job import Job
from compgen.recal.schedule import Every, Schedule, cron_expression, systemd_lines

#: For machines without a schedule.
HOURLY = Every(60)
NAME = "compgen-recal"


def units(job: Job, program: str) -> Mapping[str, str]:
    """Return the texts of the files by name; ``program`` is the path of the ``compgen`` command."""
    groups: dict[Schedule, list[str]] = {}
    for name, machine in job.machines.items():
        groups.setdefault(machine.schedule or HOURLY, []).append(name)
    files: dict[str, str] = {}
    lines = ["# crontab of volcomp recal; exit code 1: something is held back or failed, see `volcomp recal status`"]
    for number, (schedule, names) in enumerate(groups.items(), start=1):
        whole = len(groups) == 1
        unit = NAME if whole else f"{NAME}-{number}"
        words = [program, "recal", "run", *([] if whole else names), "--job", str(job.path)]
        files[f"{unit}.service"] = _service(job, words, names)
        files[f"{unit}.timer"] = _timer(schedule, unit, names)
        lines.append(_cron_line(schedule, words, unit))
    files["crontab"] = "\n".join(lines) + "\n"
    files[f"{NAME}-watch.service"] = _watch(job, program)
    return files


def _service(job: Job, words: list[str], names: list[str]) -> str:
    return f"""[Unit]
Description=compgen recalibration of {_listed(names)}
After=network-online.target

[Service]
Type=oneshot
WorkingDirectory={_escaped(str(job.path.parent))}
ExecStart={" ".join(_quoted(word) for word in words)}
"""


def _watch(job: Job, program: str) -> str:
    words = [program, "recal", "watch", "--job", str(job.path)]
    return f"""# in place of the timers: one process that keeps the schedules of the job file itself
[Unit]
Description=compgen recalibration, watching
After=network-online.target

[Service]
WorkingDirectory={_escaped(str(job.path.parent))}
ExecStart={" ".join(_quoted(word) for word in words)}
Restart=on-failure
TimeoutStopSec=15min

[Install]
WantedBy=multi-user.target
"""


def _timer(schedule: Schedule, unit: str, names: list[str]) -> str:
    lines = "\n".join(systemd_lines(schedule))
    persistent = "" if isinstance(schedule, Every) else "Persistent=true\n"
    return f"""[Unit]
Description=when {_listed(names)} is recalibrated

[Timer]
{lines}
{persistent}Unit={unit}.service

[Install]
WantedBy=timers.target
"""


def _cron_line(schedule: Schedule, words: list[str], unit: str) -> str:
    command = shlex.join(words).replace("%", r"\%")
    expression = cron_expression(schedule)
    if expression is None:
        minutes = schedule.minutes if isinstance(schedule, Every) else 0
        return f"# every {minutes} minutes is nothing that cron can say; use {unit}.timer: {command}"
    return f"{expression} {command}"


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 5 else f"{', '.join(names[:5])} and {len(names) - 5} more"


def _escaped(text: str) -> str:
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """Quote a word as systemd reads it."""
    text = _escaped(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    return f'"{text}"' if any(char in word for char in " \t'\";") else text
