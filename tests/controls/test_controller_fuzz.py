"""Malformed files of every control: an InputError with file and line, never anything else; the cost grows with the file."""

from __future__ import annotations

import random
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import CONTROLLERS, SourceFile
from compgen.data.lengths import Points
from compgen.errors import InputError
from compgen.tables import read_tables

ALL = sorted(CONTROLLERS)
SHIPPED = compgen.load_machine("zha-gantry")
FUZZ = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope="module")
def machine(small_machine):
    return replace(small_machine, controllers=SHIPPED.controllers)


@pytest.fixture(scope="module")
def good(machine, small_errors):
    """Texts of a good export by control, made once."""
    made = {}

    def of(name):
        if name not in made:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", compgen.CompgenWarning)
                made[name] = dict(compgen.export(machine, small_errors, name, allow_unverified=True).files)
        return made[name]

    return of


def parse(machine, name, files):
    control = CONTROLLERS[name]
    chosen = control.read_settings(machine)
    sources = [SourceFile(Path(key), text) for key, text in files.items()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", compgen.CompgenWarning)
        return control, chosen, control(machine, chosen).parse(sources)


def refused(machine, paths, name, match=None):
    """The InputError with which files are refused."""
    with pytest.raises(InputError, match=match) as caught:
        read_tables(machine, paths, name)
    return caught.value


def harmless(machine, name, files):
    """Parsing gives an InputError that names a file, or tables that can be emulated and judged (their violations)."""
    try:
        control, chosen, tables = parse(machine, name, files)
        middle = 0.5 * (machine.lower_mm + machine.upper_mm)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", compgen.CompgenWarning)
            added = control(machine, chosen).emulate(tables, Points(middle[None], approach=np.ones((1, 3))))
            outcome = control(machine, chosen).violations(tables)
        assert added.shape == (1, 3)
    except InputError as error:
        assert error.file is not None
        outcome = error
    return outcome


def numbers_file(files):
    """Name of the file with the most numbers that the control reads: a plan in JSON beside it is for a transfer."""
    read = [key for key in files if not key.endswith(".plan.json")]
    return max(read, key=lambda key: len(re.findall(r"\d+", files[key])))


# --- edits that nobody has in mind -----------------------------------------------------------------------------------


@st.composite
def line_edits(draw):
    """A few deletions, duplications and swaps of lines, by share of the file."""
    kind = st.sampled_from(["delete", "double", "swap", "cut"])
    return draw(st.lists(st.tuples(kind, st.floats(0, 1), st.floats(0, 1)), min_size=1, max_size=4))


def edited(text, edits):
    lines = text.splitlines(keepends=True)
    for kind, first, second in edits:
        if not lines:
            break
        a, b = (min(int(share * len(lines)), len(lines) - 1) for share in (first, second))
        if kind == "delete":
            del lines[min(a, b) : min(a, b) + 1]
        elif kind == "double":
            lines.insert(b, lines[a])
        elif kind == "swap":
            lines[a], lines[b] = lines[b], lines[a]
        else:
            lines[a] = lines[a][: int(second * len(lines[a]))]
    return "".join(lines)


@pytest.mark.parametrize("name", ALL)
@FUZZ
@given(edits=line_edits())
def test_lines_deleted_doubled_swapped_and_cut(name, machine, good, edits):
    files = good(name)
    for key in files:
        harmless(machine, name, {**files, key: edited(files[key], edits)})


HOSTILE = ["", "-", "+", ".", "1e5", "1E400", "nan", "inf", "1,5", "0x1F", "1_0", "--1", "9" * 30, "9" * 400, "1.2.3"]
HOSTILE += ["%", "[", "]", "{", "}", '"', "=", ";", "//", "\t", "\r", "\0", "\x1a", "$", "N", "{%", "-0", "1e-400"]


@pytest.mark.parametrize("name", ALL)
@FUZZ
@given(where=st.lists(st.tuples(st.floats(0, 1), st.sampled_from(HOSTILE)), min_size=1, max_size=3))
def test_words_replaced_by_hostile_ones(name, machine, good, where):
    files = good(name)
    key = numbers_file(files)
    text = files[key]
    for share, word in where:
        found = list(re.finditer(r"[^\s,;=()\[\]{}]+", text))
        hit = found[min(int(share * len(found)), len(found) - 1)]
        text = text[: hit.start()] + word + text[hit.end() :]
    harmless(machine, name, {**files, key: text})


@pytest.mark.parametrize("name", ALL)
@FUZZ
@given(text=st.text(alphabet=st.characters(max_codepoint=127), max_size=300))
def test_any_ascii_text(name, machine, text):
    harmless(machine, name, {"garbage.txt": text})


# --- edits that somebody makes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.33, 0.5, 0.77, 0.9, 0.97])
def test_a_file_that_was_cut_is_refused(name, share, machine, good):
    """Cut between two lines and within one; a format without an end mark does not cover the travel then."""
    files = good(name)
    key = numbers_file(files)
    lines = files[key].splitlines(keepends=True)
    whole = "".join(lines[: int(share * len(lines))])
    within = whole + lines[int(share * len(lines))][:2]
    for text in (whole, *([within] if within != files[key] else [])):  # the last line may be an end mark alone
        assert harmless(machine, name, {**files, key: text}), text[-200:]


def decimal_in_the_middle(text):
    """The decimal number in the middle of a text, as a match."""
    found = list(re.finditer(r"(?<![\w.])-?\d+\.\d+(?![\w.])", text))
    return found[len(found) // 2] if found else None


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("change", [lambda w: w.replace(".", ","), lambda w: w + "x", lambda w: w.replace(".", "..")])
def test_a_decimal_that_is_none_is_refused_with_its_line(name, change, machine, good):
    for key in (numbers_file(good(name)),):
        text = good(name)[key]
        hit = decimal_in_the_middle(re.sub(r"(?m)^\s*(;|#|//|\().*$", lambda m: "~" * len(m[0]), text))
        if hit is None:
            pytest.skip("the file holds whole numbers only")
        wrong = text[: hit.start()] + change(hit[0]) + text[hit.end() :]
        error = harmless(machine, name, {**good(name), key: wrong})
        assert isinstance(error, InputError), text[hit.start() - 60 : hit.end() + 20]
        assert str(error.file) == key
        assert error.line is not None


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("encoding", ["latin-1", "utf-16", "utf-8-sig", "nul"])
def test_a_wrong_encoding_is_refused_with_file_and_line(name, encoding, machine, good, tmp_path):
    key = numbers_file(good(name))
    lines = good(name)[key].split("\n")
    nth = len(lines) // 2
    if encoding == "latin-1":
        lines[nth] += " \xe4"
    if encoding == "nul":
        lines[nth] = lines[nth][:1] + "\0" + lines[nth][1:]
    content = "\n".join(lines).encode("latin-1" if encoding == "nul" else encoding)
    paths = []
    for other, text in good(name).items():
        paths.append(tmp_path / other)
        paths[-1].write_bytes(content if other == key else text.encode("ascii"))
    error = refused(machine, paths, name)
    assert Path(error.file).name == key
    assert error.line == (1 if encoding.startswith("utf") else nth + 1)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("seed", range(4))
def test_binary_garbage_is_refused(name, seed, machine, tmp_path):
    path = tmp_path / "garbage.bin"
    path.write_bytes(random.Random(seed).randbytes(2000))
    with pytest.raises(InputError) as caught:
        read_tables(machine, path, name)
    assert Path(caught.value.file) == path


HUGE = {
    "zeros": b"\0",
    "one-line": b"1234567890",
    "blank-lines": b"\n",
    "rows": b"0.0 0.0 0.0\n",
    "csv": b"X,1.0,2.0\n",
    "comments": b"; nothing\n",
    "commands": b"$AN_CEC[0,0]=0.1\n",
    "words": b"N10001P1\n",
    "binary": bytes(range(256)),
}


@pytest.fixture(scope="module")
def huge(tmp_path_factory):
    """A file of garbage of a kind and size, made when it is asked for."""
    folder = tmp_path_factory.mktemp("huge")

    def of(kind, size):
        path = folder / f"{kind}-{size}.txt"
        if not path.exists():
            path.write_bytes(HUGE[kind] * (size // len(HUGE[kind])))
        return path

    yield of
    for path in folder.iterdir():
        path.unlink()


@pytest.mark.parametrize("kind", sorted(HUGE))
@pytest.mark.parametrize("name", ALL)
def test_much_garbage_is_refused_at_a_cost_that_grows_with_it(name, kind, machine, huge):
    """Just below the size at which a file is refused unread: this is for the parser."""

    def read(text):
        with pytest.raises(InputError):
            parse(machine, name, {"garbage.txt": text})

    assert grows_with_its_file(read, HUGE[kind].decode("latin-1"))
    path = huge(kind, 19_000_000)
    assert Path(refused(machine, path, name).file) == path


@pytest.mark.parametrize("name", ALL)
def test_a_hundred_megabytes_are_refused_with_a_line(name, machine, huge):
    path = huge("rows", 100_000_000)
    assert refused(machine, path, name, match="is longer than").line == 250_001


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("head", [0.3, 0.999])
def test_a_good_beginning_with_much_garbage_behind_is_refused_at_a_cost_that_grows_with_it(name, head, machine, good):
    """Below the size and number of lines at which a file is refused unread."""
    files = good(name)
    key = numbers_file(files)
    good_part = files[key][: int(head * len(files[key]))]
    for part, times in (
        ("0.0 ", 200_000),
        ("\n", 200_000),
        ("x=", 500_000),
        ("1", 10**6),
        ("N1 ", 300_000),
        ("[[", 300_000),
    ):

        def read(text):
            return harmless(machine, name, {**files, key: text})

        assert grows_with_its_file(read, part, good_part)
        assert isinstance(read(good_part + part * times), InputError) or not part.strip()


@pytest.mark.parametrize("name", ALL)
def test_the_command_says_file_and_line_and_exits_with_2(name, machine, good, small_machine_file, tmp_path, capsys):
    """``volcomp read`` on a cut table: one message, no traceback, nothing written."""
    toml = tmp_path / "m.toml"
    shipped = SHIPPED.source.read_text()
    sections = shipped[shipped.index("[controllers.") :]
    toml.write_text(small_machine_file.read_text().partition("[controllers.")[0] + sections)
    (tmp_path / "p.points.csv").write_text("x_mm,y_mm,z_mm\n0,0,-10\n")
    key = numbers_file(good(name))
    paths = []
    for other, text in good(name).items():
        paths.append(tmp_path / other)
        paths[-1].write_bytes((text[: len(text) // 2] if other == key else text).encode())
    words = [
        "read",
        toml,
        *paths,
        "--controller",
        name,
        "--points",
        tmp_path / "p.points.csv",
        "--out",
        tmp_path / "o.csv",
    ]
    assert run_command(cli, [str(word) for word in words]) == 2
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].startswith(f"error: {tmp_path / key}")
    assert "Traceback" not in said.err
    assert not (tmp_path / "o.csv").exists()
