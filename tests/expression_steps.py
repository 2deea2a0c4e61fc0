"""Counts the steps of a regular expression on a text, and builds texts that make it repeat what it has done.

The matcher goes the ways that Python's own goes, in the same order; it takes the expression as ``re`` has parsed it.
"""

import re
from re import _constants as c
from re import _parser as parser

#: Characters that texts are made of: one of each kind that expressions tell apart.
LETTERS = " 0A.+-,;:()[]<\"'=_#/*%$\u00b5\u2212\u4e00"
REPEATS = (c.MAX_REPEAT, c.MIN_REPEAT, c.POSSESSIVE_REPEAT)
#: A repeat with a higher limit counts as one without.
UNLIMITED = 1000
#: Steps after which a text is given up: at most some thousand for each of its letters.
MOST_STEPS = 150_000
#: The parts of an item that consists of others.
_PARTS = {
    c.BRANCH: lambda value: value[1],
    c.SUBPATTERN: lambda value: [value[3]],
    c.ATOMIC_GROUP: lambda value: [value],
}
_PARTS |= {c.ASSERT: lambda value: [value[1]], c.ASSERT_NOT: lambda value: [value[1]]}
_PARTS |= {c.GROUPREF_EXISTS: lambda value: value[1:], **dict.fromkeys(REPEATS, lambda value: [value[2]])}
_KINDS = {
    c.CATEGORY_DIGIT: str.isdigit,
    c.CATEGORY_SPACE: str.isspace,
    c.CATEGORY_WORD: lambda letter: letter.isalnum() or letter == "_",
    c.CATEGORY_NOT_DIGIT: lambda letter: not letter.isdigit(),
    c.CATEGORY_NOT_SPACE: lambda letter: not letter.isspace(),
    c.CATEGORY_NOT_WORD: lambda letter: not (letter.isalnum() or letter == "_"),
}


def _of_set(items, letter):
    found = negated = False
    for what, value in items:
        if what is c.NEGATE:
            negated = True
        elif what is c.LITERAL:
            found |= value == ord(letter)
        elif what is c.RANGE:
            found |= value[0] <= ord(letter) <= value[1]
        else:
            found |= _KINDS[value](letter)
    return found != negated


class Expression:
    """An expression, parsed; ``steps`` counts what it has compared so far."""

    def __init__(self, pattern, flags=0):
        tree = parser.parse(pattern, flags)
        self.items, self.fold = list(tree), bool(tree.state.flags & re.IGNORECASE)
        self.text, self.steps, self.groups, self._tests = "", 0, {}, {}

    def steps_on(self, text, method):
        """Return how many steps a method of ``re`` takes on a text; anything but match and fullmatch starts at each place."""
        self.text, self.steps, self.groups = text, 0, {}
        if method in ("match", "fullmatch"):
            self._follow(self.items, 0, 0, lambda at: method == "match" or at == len(text))
            return self.steps
        at = 0
        while at <= len(text):
            end = self._first(self.items, at)
            at = at + 1 if end is None else max(end, at + 1)
        return self.steps

    def takes(self, what, value):
        """Return the test of one character, None if an item is not about one."""
        if what not in (c.LITERAL, c.NOT_LITERAL, c.ANY, c.IN):
            return None
        known = self._tests.setdefault(id(value), {})

        def test(letter):
            if letter not in known:
                both = {letter, letter.lower(), letter.upper()} if self.fold else {letter}
                if what is c.ANY:
                    known[letter] = letter != "\n"
                elif what is c.IN:
                    known[letter] = any(_of_set(value, one) for one in both)
                else:
                    known[letter] = (chr(value) in both) == (what is c.LITERAL)
            return known[letter]

        if what in (c.LITERAL, c.NOT_LITERAL, c.ANY):
            known = self._tests.setdefault((what, value), {})
        return test

    def _first(self, items, at):
        """End of the first way to match items from a place, None if there is none."""
        found = []
        return found[0] if self._follow(items, 0, at, lambda end: not found.append(end)) else None

    def _follow(self, items, k, at, then):
        self.steps += 1
        if self.steps > MOST_STEPS:
            raise OverflowError("more steps than any expression needs that is linear")
        if k == len(items):
            return then(at)
        what, value = items[k]
        if test := self.takes(what, value):
            return at < len(self.text) and test(self.text[at]) and self._follow(items, k + 1, at + 1, then)

        def after(end):
            return self._follow(items, k + 1, end, then)

        if what is c.AT:
            return self._is_at(value, at) and after(at)
        if what is c.BRANCH:
            return any(self._follow(list(branch), 0, at, after) for branch in value[1])
        if what is c.SUBPATTERN:
            return self._group(value[0], list(value[3]), at, after)
        if what is c.ATOMIC_GROUP:
            end = self._first(list(value), at)
            return end is not None and after(end)
        if what in (c.ASSERT, c.ASSERT_NOT):
            begin = at - value[1].getwidth()[0] if value[0] < 0 else at
            found = begin >= 0 and self._first(list(value[1]), begin) is not None
            return found == (what is c.ASSERT) and after(at)
        if what is c.GROUPREF:
            begin, end = self.groups.get(value) or (0, 0)
            return self.text.startswith(self.text[begin:end], at) and after(at + end - begin)
        if what is c.GROUPREF_EXISTS:
            return self._follow(list(value[1] if self.groups.get(value[0]) else value[2] or []), 0, at, after)
        least, most, part = value
        if len(part) == 1 and (test := self.takes(*part[0])):
            return self._letters(test, (what, least, most), at, after)
        return self._parts(list(part), (what, least, most), at, after)

    def _is_at(self, what, at):
        text = self.text
        if what in (c.AT_BEGINNING, c.AT_BEGINNING_STRING, c.AT_BEGINNING_LINE):
            return at == 0 or (what is c.AT_BEGINNING_LINE and text[at - 1] == "\n")
        if what in (c.AT_END, c.AT_END_STRING, c.AT_END_LINE):
            return at == len(text) or (what is not c.AT_END_STRING and text[at:] == "\n")
        inside = [0 <= k < len(text) and _KINDS[c.CATEGORY_WORD](text[k]) for k in (at - 1, at)]
        return (inside[0] != inside[1]) == (what is c.AT_BOUNDARY)

    def _group(self, number, items, at, after):
        before = self.groups.get(number)

        def closed(end):
            self.groups[number] = at, end
            return after(end)

        if self._follow(items, 0, at, closed):
            return True
        self.groups[number] = before
        return False

    def _letters(self, test, how, at, after):
        what, least, most = how
        count = 0
        while count < most and at + count < len(self.text) and test(self.text[at + count]):
            if what is c.MIN_REPEAT and count >= least and after(at + count):
                return True
            count += 1
            self.steps += 1
        if what is not c.MAX_REPEAT:
            return count >= least and after(at + count)
        return any(after(at + kept) for kept in range(count, least - 1, -1))

    def _parts(self, items, how, at, after):
        what, least, most = how
        if what is c.POSSESSIVE_REPEAT:
            count, end = 0, self._first(items, at)
            while end is not None and end > at and count < most:
                count, at, end = count + 1, end, self._first(items, end)
            return count >= least and after(at)

        def more(count, begin, before):
            if what is c.MIN_REPEAT and count >= least and after(begin):
                return True
            another = count < most and begin != before
            if another and self._follow(items, 0, begin, lambda end: more(count + 1, end, begin)):
                return True
            return what is c.MAX_REPEAT and count >= least and after(begin)

        return more(0, at, -1)

    # Texts.

    def samples(self, items, most=4):
        """Return some texts that items match, as far as assertions allow."""
        found = [""]
        for what, value in items:
            if test := self.takes(what, value):
                parts = next(([letter] for letter in self._known(what, value) if test(letter)), [""])
            elif what is c.BRANCH:
                parts = [text for branch in value[1] for text in self.samples(branch, 2)]
            elif what in (c.SUBPATTERN, c.ATOMIC_GROUP):
                parts = self.samples(value[3] if what is c.SUBPATTERN else value)
            elif what in REPEATS:
                part = self.samples(value[2], 2)
                parts = ["", *part] if value[0] == 0 else [text * value[0] for text in part]
            else:
                parts = ["", *self.samples(value[1], 1)] if what is c.GROUPREF_EXISTS else [""]
            found = list(dict.fromkeys(text + part for part in parts[:most] for text in found))[:most]
        return found

    def _known(self, what, value):
        if what is not c.IN:
            return chr(value) if what is c.LITERAL else LETTERS + "\x02"
        own = [number[0] if kind is c.RANGE else number for kind, number in value if kind in (c.LITERAL, c.RANGE)]
        return "".join([*LETTERS, *map(chr, own)])

    def attacks(self):
        """Return pairs of texts: what leads to a repeat without a limit, and what is repeated there."""
        tests = list(self._tests_in(self.items))
        alike = {tuple(test(letter) for test in tests): letter for letter in reversed(LETTERS)}
        return dict.fromkeys(self._attacks(self.items, [""], "".join(alike.values())))

    def _tests_in(self, items):
        for what, value in items:
            if test := self.takes(what, value):
                yield test
            for part in _PARTS.get(what, lambda _: [])(value):
                yield from self._tests_in(part or [])

    def _attacks(self, items, before, letters):
        for what, value in items:
            for part in _PARTS.get(what, lambda _: [])(value):
                yield from self._attacks(part or [], before, letters)
            if what in REPEATS and value[1] >= UNLIMITED:
                test = self.takes(*value[2][0]) if len(value[2]) == 1 else None
                often = [letter for letter in letters if test(letter)] if test else self.samples(value[2])
                yield from ((head, text) for head in before for text in often if text)
                yield from (("", head + text) for head in before for text in often[:1])
            before = list(dict.fromkeys(a + b for b in self.samples([(what, value)]) for a in before))[:4]

    def grows_faster(self, method):
        """Return a text on which steps grow faster than its length, as what leads to it, is repeated, and ends it; or None."""
        for head, often in self.attacks():
            for end in ("\x01", "0"):
                if self._grows(
                    lambda n, parts=(head, often, end): self.steps_on(parts[0] + parts[1] * n + parts[2], method)
                ):
                    return head, often, end
        return None

    def _grows(self, steps):
        try:
            one, two, three = map(steps, (4, 8, 12))
            if three - 2 * two + one <= 4:
                return False
            # limits such as {1,200} are reached in between
            return steps(80) > 3 * steps(40) and steps(400) > 3 * steps(200)
        except OverflowError:
            return True
