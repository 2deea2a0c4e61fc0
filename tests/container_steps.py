"""The steps of the Containerfile without a container: each stage in a folder of its own with a fresh Python environment.

``python tests/container_steps.py FOLDER`` copies what the file copies, runs what it runs (but for making a user), and
starts its entry point. It needs the network or a mirror, and a minute; ``tests/test_portable.py`` reads the steps.
"""

import json
import shlex
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def steps():
    """The instructions of the Containerfile as (word, rest)."""
    lines = (ROOT / "Containerfile").read_text("utf-8").splitlines()
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in lines) if word and word != "#"]


def run_in(folder):
    """Run the steps below a folder that is made, and return what the entry point says of its version."""
    stages, stage = [], None
    for word, rest in steps():
        if word == "FROM":
            stage = {"name": rest.partition(" AS ")[2], "root": folder / f"stage-{len(stages)}", "at": "/"}
            stages.append(stage)
            venv.create(stage["root"] / "env", with_pip=True)
        elif word == "WORKDIR":
            stage["at"] = rest
            (stage["root"] / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
        elif word == "COPY":
            copied(stage, stages, shlex.split(rest))
        elif word == "RUN" and not rest.startswith("useradd"):
            words = [stage["root"].as_posix() + part if part.startswith("/") else part for part in shlex.split(rest)]
            words[0] = (stage["root"] / "env" / "bin" / words[0]).as_posix()
            subprocess.run(words, cwd=stage["root"] / stage["at"].lstrip("/"), check=True)
        elif word == "ENTRYPOINT":
            program = stage["root"] / "env" / "bin" / json.loads(rest)[0]
            return subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
    raise ValueError("the Containerfile has no ENTRYPOINT")


def copied(stage, stages, words):
    """Copy from the repository, or from an earlier stage, into a stage."""
    above = next((item["root"] for item in stages if words[0] == f"--from={item['name']}"), None)
    source, target = words[-2:]
    goal = stage["root"] / (target if target.startswith("/") else f"{stage['at']}/{target}").lstrip("/")
    if above is None:
        archive = subprocess.run(["git", "-C", ROOT, "archive", "HEAD"], capture_output=True, check=True).stdout
        goal.mkdir(parents=True, exist_ok=True)
        subprocess.run(["tar", "-x", "-C", goal], input=archive, check=True)
        return
    origin = above / source.lstrip("/")
    goal.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(origin, goal, dirs_exist_ok=True) if origin.is_dir() else shutil.copy(origin, goal)


if __name__ == "__main__":
    print(run_in(Path(sys.argv[1])))
