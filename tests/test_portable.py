"""Where a system lacks what POSIX has, the program works without: no module needs it to be loaded, and no command to run."""

import ast
import os
import subprocess
import sys
from pathlib import Path

from container_steps import steps

ROOT = Path(__file__).resolve().parents[1]
#: Modules of the standard library that Windows does not have.
ONLY_POSIX = frozenset(
    [
        "crypt",
        "fcntl",
        "grp",
        "nis",
        "ossaudiodev",
        "posix",
        "pty",
        "pwd",
        "readline",
        "resource",
        "spwd",
        "syslog",
        "termios",
        "tty",
        "_posixshmem",
    ]
)
#: What Windows lacks in ``os`` and ``signal``; ``os.name`` says "nt" there.
MISSING = {
    "os": [
        "chown",
        "fchmod",
        "fork",
        "forkpty",
        "getegid",
        "geteuid",
        "getgid",
        "getgroups",
        "getpgid",
        "getuid",
        "killpg",
        "mkfifo",
        "nice",
        "pread",
        "pwrite",
        "setsid",
        "statvfs",
        "sched_getaffinity",
        "umask_",
        "O_DIRECTORY",
        "O_NOFOLLOW",
        "O_NONBLOCK",
        "O_CLOEXEC_",
        "WNOHANG",
    ],
    "signal": [
        "SIGKILL",
        "SIGHUP",
        "SIGALRM",
        "SIGUSR1",
        "SIGUSR2",
        "SIGCHLD",
        "SIGPIPE",
        "alarm",
        "setitimer",
        "pthread_sigmask",
    ],
}
#: Takes them away, as far as the standard library of this system runs without them, and loads every module of the program.
WITHOUT = f"""
import importlib, os, pkgutil, signal, sys, warnings
warnings.simplefilter("ignore")
import multiprocessing.context, subprocess, tempfile, shutil, socketserver, asyncio  # they need them on this system
missing = {MISSING!r}
for module, names in missing.items():
    for name in names:
        vars(sys.modules[module]).pop(name, None)
os.supports_dir_fd = set()
for name in {sorted(ONLY_POSIX - {"posix"})!r}:
    sys.modules[name] = None
import compgen
failed = []
for found in pkgutil.walk_packages(compgen.__path__, "compgen."):
    if ".migrations" in found.name or found.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(found.name)
    except ImportError as error:
        if any(word in str(error) for word in ("compgen", *{sorted(ONLY_POSIX)!r})):
            failed.append(f"{{found.name}}: {{error}}")
    except AttributeError as error:
        failed.append(f"{{found.name}}: {{error}}")
print("\\n".join(failed))
from compgen.cli import cli
code = cli.main(sys.argv[1:], standalone_mode=False)
print("exit", code)
"""


def test_no_module_imports_what_only_posix_has_when_it_is_loaded():
    """Only within a function, whose caller does without where there is none."""
    found = []
    for path in sorted((ROOT / "compgen").rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        inside = {
            id(node)
            for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
            for node in ast.walk(function)
        }
        for node in ast.walk(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            if ONLY_POSIX.intersection(name.partition(".")[0] for name in names) and id(node) not in inside:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found


def test_every_module_is_loaded_and_a_run_works_without_what_only_posix_has(tmp_path):
    sheet = tmp_path / "x.axis.csv"
    rows = "".join(f"X,{-100 * k},{way},1,{0.5 * k}\n" for k in range(8) for way in (1, -1))
    sheet.write_text(f"axis,position_mm,direction,run,deviation_um\n{rows}")
    words = ["run", "zha-gantry", str(sheet), "--controller", "isg-csv", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *words],
        cwd=ROOT,
        env={**os.environ, "COMPGEN_KERNELS": "plain"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    said = done.stdout.splitlines()
    assert said[0] == "", said[:20]  # nothing failed
    assert said[-1] in ("exit 0", "exit 1"), said[-5:]
    assert (tmp_path / "out" / "report.html").is_file()
    assert not list((tmp_path / "out").glob(".*tmp*"))


def test_the_container_file_installs_pinned_packages_and_starts_the_program():
    """Its steps are run whole by tests/container_steps.py, which needs the network; here they are read."""
    said = steps()
    runs = [rest for word, rest in said if word == "RUN"]
    installs = [rest for rest in runs if "pip install" in rest]
    assert all("--require-hashes" in rest or "--no-index" in rest for rest in installs)
    assert said[-1] == ("ENTRYPOINT", '["volcomp"]')
    assert ("USER", "volcomp") in said  # not as root
    assert [rest.split()[0] for word, rest in said if word == "FROM"] == ["docker.io/library/python:3.12-slim"] * 2
