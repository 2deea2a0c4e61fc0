"""Adding a machine to a job file: the text is appended, what stands there stays as it is."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from compgen.core.files import read_text, write_file
from compgen.core.machine import load_machine
from compgen.errors import InputError
from compgen.recal.job import MachineJob, job_of_text


def add_machine(path: Path, name: str, keys: Mapping[str, Any]) -> MachineJob:
    """Append ``[machines.NAME]`` with the keys that are not None; nothing is written if the result is no valid job.

    Raises
    ------
    InputError
        for a machine that is there already, a machine file that does not load, a value that the job file refuses.
    """
    before = read_text(path) if path.exists() else ""
    if before and name in job_of_text(before, path).machines:
        raise InputError(f"has a machine {name!r} already; edit it there", file=path)
    lines = [f"{key} = {_value(value)}" for key, value in keys.items() if value is not None]
    gap = "" if not before else "\n" if before.endswith("\n") else "\n\n"
    text = before + gap + "\n".join([f"[machines.{_key(name)}]", *lines]) + "\n"
    added = job_of_text(text, path).machine(name)
    load_machine(added.machine)
    write_file(path, text)
    return added


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def _value(value: Any) -> str:
    """Write texts, numbers and lists of texts as TOML; JSON's escapes are TOML's as well."""
    return json.dumps(value, ensure_ascii=True)
