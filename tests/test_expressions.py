"""Regular expressions that read files of others take a time that grows with the length of the text, not faster."""

import ast
import importlib
import itertools
import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from expression_steps import Expression
from programs.test_correct import PLAIN, moves_of

import compgen
from compgen.controls import rotary_parameters
from compgen.controls.shared.scanner import number_pattern
from compgen.errors import InputError
from compgen.programs import klartext
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import _COMMENTS, _OTHER_COMMENTS
from compgen.programs.follower import _runs as block_runs
from compgen.programs.reader import _SIDE, _SIDE_KLARTEXT

ROOMS = ("programs", "controls", "foreign")
FOLDER = Path(compgen.__file__).parent
METHODS = {"match", "fullmatch", "search", "sub", "subn", "findall", "finditer", "split"}
#: Expressions that depend on arguments, with all that they can be.
_DIALECTS = [(dialect.word_pattern(), "match") for dialect in DIALECTS.values()]
_DIALECTS += [(re.compile(dialect.comments), "search") for dialect in DIALECTS.values()]
MADE = {
    "dialects.word_pattern": _DIALECTS,
    "dialects.head": [(dialect.head(), "match") for dialect in DIALECTS.values()],
    "dialects.without_words": [(dialect.without_words(), "fullmatch") for dialect in DIALECTS.values()],
    "dialects.length_of": [(re.compile(rf"{item.comments}|\s"), "sub") for item in DIALECTS.values() if item.bare],
    "klartext._approach": [(re.compile(rf"(?<![A-Z]){name}\s*+[-+.\dQ]"), "search") for name in ("LEN", "CCA", "R")],
    "runs.__init__": _DIALECTS,
    "follower._runs": [(block_runs(name), "match") for name in DIALECTS],
    "follower.__init__": [(re.compile(comments), "sub") for comments in (*_COMMENTS.values(), _OTHER_COMMENTS)],
    "reader._within_contour": [
        *(
            (re.compile(pattern.pattern.decode(), pattern.flags & ~re.UNICODE), "sub")
            for pattern in (_SIDE, _SIDE_KLARTEXT)
        ),
        *((re.compile(dialect.comments, re.IGNORECASE), "sub") for dialect in DIALECTS.values()),
    ],
    "subprograms.file_of": [
        (re.compile(r"O?0*1001(?:\.[^.]*)?"), "fullmatch"),
        (re.compile(r"(?:_N_)?A(?:[._](?:SPF|MPF))?"), "fullmatch"),
    ],
    "subprograms._while": [(re.compile(r"\s*(?:N\s*\d+\s*)?END\s*1(?!\d)"), "match")],
    "subprograms.number": [(re.compile(r"\s*(?:N\s*\d+\s*)?[O:]\s*0*(\d+)(?!\d)"), "match")],
    "correct._hole": [(re.compile(r"^(\s*)\d+\s+"), "sub"), (re.compile(r"^(\s*)N\d+\s*", re.IGNORECASE), "sub")],
    "klartext._said": [(re.compile(pattern), "match") for pattern, _ in klartext._REFUSED],
    "klartext._corner": [(re.compile(rf"{kind}\s*({klartext.VALUE})"), "match") for kind in ("RND", "CHF")],
    "rotary_parameters.parse": [
        (re.compile(pattern), "fullmatch")
        for pattern in (rotary_parameters.SETP, rotary_parameters.CARRIER, rotary_parameters.PARAMETER)
    ],
    "scanner.number_pattern": [(number_pattern(exponent=3), "fullmatch"), (number_pattern(), "fullmatch")],
    "cells.plain_decimals": [
        (re.compile(rf"[+-]?(\d*|[1-9]\d{{0,2}}([{a}]\d{{3}})+)([{b}]\d*)?([eE][+-]?\d+)?"), "fullmatch")
        for a, b in ((".", ","), (",", "."))
    ],
}


@pytest.fixture(autouse=True)
def deep_calls():
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(30_000)
    yield
    sys.setrecursionlimit(before)


def expressions(room):
    """Yield the place of every expression in a room, its pattern (None if it depends on arguments), flags and methods."""
    for path in sorted((FOLDER / room).rglob("*.py")):
        tree = ast.parse(path.read_text())
        name = ".".join(["compgen", *path.relative_to(FOLDER).with_suffix("").parts]).removesuffix(".__init__")
        names, uses, within = vars(importlib.import_module(name)), defaultdict(set), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in METHODS:
                uses[ast.unparse(node.value).rpartition(".")[2]].add(node.attr)
            within |= {child: node for child in ast.iter_child_nodes(node)}
        for node in ast.walk(tree):
            if not (
                isinstance(node, ast.Call) and ast.unparse(node.func) in {f"re.{m}" for m in METHODS | {"compile"}}
            ):
                continue
            methods = {node.func.attr}
            if methods == {"compile"}:
                target = within[node].targets[0] if isinstance(within[node], ast.Assign) else None
                # one that stands in a list or a dictionary is used by the names of a loop
                others = set().union(*(found for used, found in uses.items() if used.islower() and used != "re"))
                methods = uses.get(ast.unparse(target).rpartition(".")[2] if target else "") or others or {"search"}
            methods = {method if method in ("match", "fullmatch") else "search" for method in methods}
            flags = [ast.unparse(arg) for arg in [*node.args[1:], *(k.value for k in node.keywords)]]
            found = sum(int(eval(text, {"re": re})) for text in flags if text.startswith("re."))
            try:
                pattern = eval(compile(ast.Expression(node.args[0]), name, "eval"), names)
            except NameError:
                function = within[node]
                while not isinstance(function, ast.FunctionDef):
                    function = within[function]
                yield f"{path.stem}.{function.name}", None, 0, set()
                continue
            if isinstance(pattern, re.Pattern):
                pattern, found = pattern.pattern, pattern.flags
            pattern = pattern.decode("latin-1") if isinstance(pattern, bytes) else pattern
            yield f"{path.stem}:{node.lineno}", pattern, found & int(re.IGNORECASE | re.MULTILINE | re.DOTALL), methods


@pytest.mark.parametrize("room", ROOMS)
def test_every_expression_of_a_reader_is_linear_in_the_length_of_the_text(room):
    """Texts are built from each expression: what leads to a repeat, what it takes many times, and what it does not take."""
    slow, count = [], itertools.count()
    every = defaultdict(set)
    for place, pattern, flags, methods in expressions(room):
        if pattern is None:
            assert place in MADE, f"{place}: say in MADE which expressions this can be"
            for made, method in MADE[place]:
                pattern = made.pattern if isinstance(made.pattern, str) else made.pattern.decode()
                every[pattern, made.flags & int(re.IGNORECASE)].add((place, method))
            continue
        for method in methods:
            every[pattern, flags].add((place, method))
    for (pattern, flags), places in every.items():
        for method in sorted({method for _, method in places}):
            next(count)
            if found := Expression(pattern, flags).grows_faster(method):
                slow.append((sorted(places), *found))
    assert not slow
    assert next(count) > 15


@pytest.mark.parametrize(
    ("pattern", "method"),
    [
        (r"[A-Z]\s*=?\s*[+-]?\s*\d+", "match"),  # a letter, blanks, and no number
        (r"\s*x", "search"),
        (r"(a+)+b", "match"),
        (r"\d+\.?\d*", "fullmatch"),
        (r"\w*\d", "match"),
        (r"\"[^\"]*,[^\"]*,[^\"]*\"", "match"),
        (r"(.*?)(\d*)", "fullmatch"),
        (r";(?=[; ]*$)", "search"),
        (r"MSG\([^)\n]*\)", "search"),
    ],
)
def test_what_is_not_linear_is_found(pattern, method):
    if pattern == r"(a+)+b":  # this one doubles with every letter
        steps = [Expression(pattern).steps_on("a" * n, method) for n in (6, 9)]
        assert steps[1] > 6 * steps[0]
    elif pattern == r"\w*\d":
        assert Expression(pattern).grows_faster(method) is None  # what is given back is tried once
    else:
        assert Expression(pattern).grows_faster(method)


def test_the_matcher_goes_the_ways_of_python():
    """Ends of matches of many expressions on texts of their own are those of ``re``."""
    for _, pattern, flags, _ in expressions("programs"):
        if pattern is None:
            continue
        one = Expression(pattern, flags)
        for head, often in list(one.attacks())[:6]:
            for text in (head + often * 2 + "0", head + often):
                one.text, one.groups = text, {}
                found = re.match(pattern, text, flags)
                assert one._first(one.items, 0) == (found.end() if found else None), (pattern, text)


BLANKS = " " * 3900
ATTACKS = [f"G{BLANKS}nan", f"X={BLANKS}AC(", f"G1{'; ' * 1900}(", "(" * 3900, f"M{'0' * 3900}[", f"P01{BLANKS}x"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_long_block_that_is_no_word_is_refused_at_once(dialect):
    """With three repeats that may take the same blank, 3,900 blanks would need 10,000 million steps."""
    for text in ATTACKS[:2] + ATTACKS[3:] + [ATTACKS[2]] * (dialect == "fanuc"):
        with pytest.raises(InputError):
            moves_of(f"{text}\n", dialect, PLAIN)
