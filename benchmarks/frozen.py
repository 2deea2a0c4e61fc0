"""What the program does, written down: outputs of every command on the examples, to compare before and after a change.

    python benchmarks/frozen.py record DIR [--python PATH] [--only TEXT]   # runs the commands, writes what came out to DIR
    python benchmarks/frozen.py compare DIR DIR [--only TEXT]              # lists what differs; exit code 1 if anything does
    python benchmarks/frozen.py kinds DIR DIR                              # the same by kind: largest numbers, each wording once

A change of structure must leave every byte as it was: files of all controls on three machines, JSON of every command,
help texts, pages, rows of the store. Times, dates, versions and folders are taken out of the texts. The processor time of
each command is recorded beside its output; it is printed by ``compare`` and never judged.
"""

import argparse
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from difflib import SequenceMatcher
from pathlib import Path

from compgen.cli import cli
from compgen.controls import CONTROLLERS

ROOT = Path(__file__).resolve().parents[1]
MACHINES = ("zha-gantry", "jia-xytz", "moving-table-mill")
CONTROLS = sorted(CONTROLLERS)
COMMANDS = sorted(cli.commands)
RECAL = [
    "add",
    "run",
    "watch",
    "status",
    "approve",
    "reject",
    "rollback",
    "history",
    "adopt",
    "recheck",
    "exclude",
    "reprocess",
    "export-units",
    "backup",
    "restore",
]

#: What changes from run to run, and what stands in its place.
VOLATILE = (
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(\+\d\d:\d\d|Z)?"), "<time>"),
    (re.compile(r"\d{4}-\d\d-\d\d"), "<date>"),
    (re.compile(r"\b\d\d:\d\d:\d\d\b"), "<clock>"),
    (re.compile(r"\b\d+(\.\d+)? (s|ms)\b"), "<duration>"),
    (re.compile(r'("\w*(seconds|duration|elapsed|_s)": )[\d.e+-]+'), r"\1<duration>"),
    (re.compile(r"\b[0-9a-f]{64}\b"), "<sha256>"),
    (re.compile(r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b"), "<uuid>"),
)

#: A number in a text that is no part of a name or a date.
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")


def commands() -> dict[str, list[list[str]]]:
    """Chains of commands: each chain runs in a folder of its own, one command after the other."""
    chains: dict[str, list[list[str]]] = {"help": [["--help"], *([name, "--help"] for name in COMMANDS)]}
    chains["help recal"] = [["recal", name, "--help"] for name in RECAL]
    chains["lists"] = [[name, "--json"] for name in ("controllers", "machines", "effects", "instruments")]
    chains["lists in words"] = [[name] for name in ("controllers", "machines", "effects", "instruments")]
    for machine in MACHINES:
        errors = f"{machine}.errors.csv"
        chains[f"{machine} controls"] = [
            line
            for control in CONTROLS
            for line in (
                [
                    "export",
                    machine,
                    errors,
                    "--controller",
                    control,
                    "--out",
                    f"export-{control}",
                    "--allow-unverified",
                ],
                [
                    "verify",
                    machine,
                    f"export-{control}",
                    "--controller",
                    control,
                    "--errors",
                    errors,
                    "--out",
                    f"verify-{control}",
                ]
                + ["--json"],
            )
        ]
        chains[f"{machine} errors"] = [
            ["fit", machine, errors, "--out", "fit", "--json"],
            ["predict", machine, errors, "--points", "some.points.csv", "--out", "predicted.points.csv"],
            ["predict", machine, errors, "--points", "some.points.csv", "--out", "exact.points.csv", "--exact"],
            ["accuracy", machine, errors, "--out", "accuracy", "--json"],
            ["compare", machine, errors, "fit/fitted.errors.csv", "--out", "compare", "--json"],
            ["options", machine, errors, "--json"],
            ["export", machine, errors, "--controller", "isg-csv", "--out", "a"],
            ["export", machine, "fit/fitted.errors.csv", "--controller", "isg-csv", "--out", "b"],
            [
                "read",
                machine,
                "a",
                "--controller",
                "isg-csv",
                "--points",
                "some.points.csv",
                "--out",
                "read.points.csv",
            ],
            ["diff", machine, "a", "--against", "b", "--controller", "isg-csv", "--out", "diff", "--json"],
            ["merge", machine, "a", "--controller", "isg-csv", "--errors", errors, "--out", "merge", "--json"],
            ["crash-test", machine, errors, "--controller", "isg-csv", "--entries", "2"],
        ]
    every = [word for control in CONTROLS for word in ("--controller", control)]
    chains["run"] = [
        ["run", "zha-gantry", "zha-gantry.lengths.csv", *every[:2], "--out", "run", "--json"],
        ["report", "run", "--out", "report"],
        ["identify", "zha-gantry", "zha-gantry.lengths.csv", "--out", "identify", "--json"],
        ["run", "zha-gantry", "zha-gantry.lengths.csv", *every, "--out", "all", "--json", "--allow-unverified"],
        ["import", "zha-gantry.lengths.csv", "--machine", "zha-gantry", "--json"],
    ]
    chains["simulated"] = [
        ["simulate", "moving-table-mill", "--scenario", "moving-table-mill.scenario.toml", "--out", "s", "--json"],
        ["identify", "moving-table-mill", "s/moving-table-mill.lengths.csv", "--out", "identify", "--json"],
        ["simulate", "jia-xytz", "--scenario", "jia-xytz.scenario.toml", "--out", "j", "--json"],
        [
            "identify",
            "jia-xytz",
            "jia-xytz.sixdof.csv",
            "--instrument",
            "jia-xytz.instrument.toml",
            "--out",
            "sixdof",
            "--json",
        ],
        ["diagnose", "zha-gantry", "few.lengths.csv", "--out", "diagnose", "--json"],
        ["diagnose", "zha-gantry", "x.axis.csv", "--out", "axis", "--json"],
        ["run", "zha-gantry", "x.axis.csv", "--controller", "siemens-cec", "--out", "pitch", "--json"],
        ["import", "sheet.csv", "--machine", "zha-gantry", "--out", "imported"],
    ]
    chains["recal"] = [
        ["recal", "run", "--job", "recal.toml", "--json"],
        ["recal", "status", "--job", "recal.toml", "--json"],
        ["recal", "history", "zha-gantry", "--job", "recal.toml", "--json"],
        [
            "recal",
            "approve",
            "zha-gantry",
            "1",
            "--job",
            "recal.toml",
            "--actor",
            "a person",
            "--override",
            "--reason",
            "tried",
        ],
        ["recal", "status", "--job", "recal.toml"],
        ["recal", "history", "zha-gantry", "--job", "recal.toml"],
    ]
    return chains


def prepare(folder: Path) -> None:
    """Inputs of a chain: the examples, and small files made of them."""
    for path in (ROOT / "examples").glob("*.*"):
        if path.suffix in (".csv", ".toml"):
            shutil.copy(path, folder)
    truth = {"zha-gantry": "zha-gantry", "jia-xytz": "jia-xytz", "moving-table-mill": "zha-gantry"}
    for machine, source in truth.items():
        lines = (ROOT / f"examples/{source}.truth.errors.csv").read_text().splitlines()
        kept = [with_noise(line, k) for k, line in enumerate(lines) if machine == source or not line.startswith("#")]
        (folder / f"{machine}.errors.csv").write_text("\n".join(kept) + "\n")
    grid = [(x, y, z) for x in (-700, -333.3, -50) for y in (-600, -222.2) for z in (-300, -90.5)]
    (folder / "some.points.csv").write_text("x_mm,y_mm,z_mm\n" + "".join(f"{x},{y},{z}\n" for x, y, z in grid))
    lines = (folder / "zha-gantry.lengths.csv").read_text().splitlines()
    head = [line for line in lines[:20] if line.startswith(("#", "station"))]
    kept = [line for line in head if "rows" not in line] + lines[len(head) :: 9]
    (folder / "few.lengths.csv").write_text("\n".join(kept) + "\n")
    runs = [
        f"X,{-80 * k},{way},{run},{0.03 * k * k + 2 * (way > 0) + ((7 * k + 3 * run + way) % 5) * 0.2 - 0.1 * run:.3f}\n"
        for run in range(1, 6)
        for way in (1, -1)
        for k in (range(11) if way < 0 else range(10, -1, -1))
    ]
    (folder / "x.axis.csv").write_text("axis,position_mm,direction,run,deviation_um\n" + "".join(runs))
    (folder / "sheet.csv").write_text(
        "Temperatur [°C];20,4\nAchse;X\nPosition [mm];Lauf 1 + [µm];Lauf 1 - [µm];Lauf 2 + [µm];Lauf 2 - [µm]\n"
        + "".join(f"{-80 * k};{k},1;{k},5;{k},2;{k},4\n" for k in range(11))
    )
    inbox = folder / "inbox/zha-gantry"
    inbox.mkdir(parents=True)
    shutil.copy(folder / "zha-gantry.lengths.csv", inbox)
    (folder / "recal.toml").write_text(
        'store = "sqlite:///recal.sqlite"\n[machines.zha-gantry]\nmachine = "zha-gantry"\ninbox = "inbox/zha-gantry"\n'
        'out = "tables"\ncontrollers = ["isg-csv"]\napproval = "manual"\nmeasured_with = "active"\n'
    )


def with_noise(line: str, k: int) -> str:
    """A line of an error file with a small disturbance and an uncertainty, as a measured one has them."""
    name, position, value, *_ = line.split(",") if line.startswith("E") else [""] * 3
    return f"{name},{position},{float(value) + 0.05 * ((7 * k) % 11 - 5):.4f},0.2" if name else line


def plain(text: str, folder: Path) -> str:
    """A text without what changes from run to run."""
    text = text.replace(str(folder), "<folder>").replace(str(ROOT), "<root>")
    for pattern, instead in VOLATILE:
        text = pattern.sub(instead, text)
    return text


def rows(path: Path, folder: Path) -> str:
    """The rows of a store, table by table, without blobs."""
    with sqlite3.connect(path) as store:
        names = [name for (name,) in store.execute("select name from sqlite_master where type = 'table' order by name")]
        texts = []
        for name in names:
            for row in store.execute(f'select * from "{name}"'):
                texts.append(
                    f"{name}: " + " | ".join(f"<{len(v)} bytes>" if isinstance(v, bytes) else str(v) for v in row)
                )
    return plain("\n".join(texts), folder) + "\n"


def chain(name: str, lines: list[list[str]], out: Path, python: str) -> None:
    """Run the commands of one chain in a folder of its own and write down what came out."""
    with tempfile.TemporaryDirectory(prefix="frozen-") as text:
        folder = Path(text)
        prepare(folder)
        given = {path for path in folder.rglob("*")}
        log, times = [], {}
        for line in lines:
            before = os.times()
            environment = {**os.environ, "COLUMNS": "120", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}
            done = subprocess.run(
                [python, "-m", "compgen", *line], cwd=folder, capture_output=True, text=True, env=environment
            )
            after = os.times()
            times[" ".join(line)] = (
                after.children_user + after.children_system - before.children_user - before.children_system
            )
            log.append(f"$ {' '.join(line)}\nexit {done.returncode}\n{done.stdout}{done.stderr}\n")
        target = out / name.replace(" ", "-")
        shutil.rmtree(target, ignore_errors=True)
        (target / "files").mkdir(parents=True)
        (target / "log.txt").write_text(plain("".join(log), folder))
        (target / "processor-time.json").write_text(json.dumps(times, indent=1))
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path not in given:
                keep(path, target / "files" / path.relative_to(folder), folder)


def keep(path: Path, target: Path, folder: Path) -> None:
    """One file of the output as text, or only its size where it is not text."""
    target.parent.mkdir(parents=True, exist_ok=True)
    content = path.read_bytes()
    if path.suffix == ".sqlite":
        target.write_text(rows(path, folder))
    elif path.suffix == ".npz":
        target.write_text("numbers\n")
    else:
        try:
            target.write_text(plain(content.decode(), folder))
        except UnicodeDecodeError:
            target.write_bytes(content)


def record(out: Path, python: str, only: str) -> None:
    """All chains, two at a time."""
    chosen = {name: lines for name, lines in commands().items() if only in name}
    with ThreadPoolExecutor(2) as pool:
        recorded = {name: pool.submit(chain, name, lines, out, python) for name, lines in chosen.items()}
    failed = {name: future.exception() for name, future in recorded.items() if future.exception() is not None}
    if failed:
        sys.exit("\n".join(f"not recorded: {name}: {error!r}" for name, error in failed.items()))


def compare(old: Path, new: Path, only: str) -> int:
    """Print what differs between two recordings; the number of files that do, and of chains that one of them lacks.

    With ``only`` these chains alone are compared, as they are recorded.
    """
    chosen = [name.replace(" ", "-") for name in commands() if only in name]
    lacking = [f"{top}: {name}" for top in (old, new) for name in chosen if not (top / name / "log.txt").exists()]
    for text in lacking:
        print(f"not recorded, so not compared: {text}")
    names = sorted({p.relative_to(top).as_posix() for top in (old, new) for p in top.rglob("*") if p.is_file()})
    differing = len(lacking)
    for name in names:
        a, b = old / name, new / name
        if name.endswith("processor-time.json") or name.split("/")[0] not in chosen:
            continue
        if not a.exists() or not b.exists() or a.read_bytes() != b.read_bytes():
            differing += 1
            state = "only before" if not b.exists() else "only after" if not a.exists() else "differs"
            print(f"{state}: {name}", flush=True)
            if state == "differs":
                subprocess.run(["diff", "-U0", str(a), str(b)], stdout=sys.stdout)
    print(f"{differing} of {len(names)} files differ")
    for top in (old, new):
        spent = sum(sum(json.loads(p.read_text()).values()) for p in top.rglob("processor-time.json"))
        print(f"{top}: {spent:.0f} s of processor time")
    return differing


def lines_of(path: Path) -> list[str]:
    """Lines of a recorded file; of a page every tag and every text is one, and scripts and styles are left out."""
    text = path.read_text(errors="replace")
    if path.suffix == ".html":
        text = re.sub(r"<(style|script)\b.*?</\1>", "", text, flags=re.DOTALL)
        text = re.sub(r"\s*(<[^>]*>)\s*", r"\n\1\n", text)
    return text.splitlines()


def kinds(old: Path, new: Path) -> int:
    """Print the differences by kind: of numbers the largest in files of one name, of words each line once (numbers as #).

    Exit codes and keys are words: if they changed, they are among the lines.
    """
    names = {p.relative_to(top).as_posix() for top in (old, new) for p in top.rglob("*") if p.is_file()}
    largest: dict[str, tuple[float, int, str, str]] = {}
    words: dict[str, str] = {}
    for name in sorted(name for name in names if not name.endswith("processor-time.json")):
        if not ((old / name).exists() and (new / name).exists()):
            print(f"only {'before' if (old / name).exists() else 'after'}: {name}")
            continue
        if (old / name).read_bytes() == (new / name).read_bytes():
            continue
        before, after = lines_of(old / name), lines_of(new / name)
        plain = [[NUMBER.sub("#", line).strip() for line in side] for side in (before, after)]
        size, count, *where = largest.get(Path(name).name, (0.0, 0, "", ""))
        # texts of the same words need no matching, and a page is too long for the exact way
        blocks = [("equal", 0, len(before), 0, len(after))]
        if plain[0] != plain[1]:
            blocks = SequenceMatcher(None, plain[0], plain[1], autojunk=name.endswith(".html")).get_opcodes()
        for what, i, i_end, j, j_end in blocks:
            if what != "equal":
                removed, added = plain[0][i:i_end], plain[1][j:j_end]
                words |= {f"- {line}": name for line in removed} | {f"+ {line}": name for line in added}
                continue
            for one, other in zip(before[i:i_end], after[j:j_end], strict=True):
                pairs = zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)
                apart = max((abs(float(a) - float(b)) for a, b in pairs), default=0.0)
                if apart > size:
                    size, where = apart, [name, f"{one.strip()[:150]}  ->  {other.strip()[:150]}"]
        largest[Path(name).name] = (size, count + 1, *(where or ("", "")))
    for kind, (size, count, name, line) in sorted(largest.items(), key=lambda item: -item[1][0]):
        print(f"{size:9.2g} at most in {count} x {kind}" + (f", {name}: {line}" if size else " (words only)"))
    for line, name in words.items():
        print(f"{line[:300]}   [{name}]")
    return len(largest)


def main() -> int:
    """Read the arguments, record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["record", "compare", "kinds"])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    if given.action == "record":
        record(given.folders[0].resolve(), given.python, given.only)
        return 0
    old, new = given.folders
    return int((kinds(old, new) if given.action == "kinds" else compare(old, new, given.only)) > 0)


if __name__ == "__main__":
    sys.exit(main())
