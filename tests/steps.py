"""Work counted in lines of the package that are executed: the same on every computer, however busy it is."""

import os
import sys
from pathlib import Path

import compgen

PACKAGE = str(Path(compgen.__file__).parent) + os.sep


def steps(action):
    """How many lines of the package ``action`` executes; each pass of a loop on one line counts."""
    count = 0

    def line(frame, event, argument):
        nonlocal count
        count += event == "line"
        return line

    def called(frame, event, argument):
        return line if frame.f_code.co_filename.startswith(PACKAGE) else None

    before = sys.gettrace()
    sys.settrace(called)
    try:
        action()
    finally:
        sys.settrace(before)
    return count


def grows_with_its_file(read, part, head="", size=4_000):
    """Whether ``read`` takes at most twice the steps for twice as much of ``part`` behind ``head``; ``size`` in characters."""
    texts = [head + part * max(n // len(part), 1) for n in (size, 2 * size)]
    read(texts[0])  # what is done once for all texts is done
    small, large = (steps(lambda text=text: read(text)) for text in texts)
    return large <= 2.1 * small + 500
