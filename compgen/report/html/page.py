"""The HTML page: Jinja2 with every text escaped, one style sheet, one script, and a policy that forbids the network."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from compgen.report.html.content import FIGURES, um
from compgen.report.html.curves import LABEL, Picture
from compgen.report.html.folder import ResultFolder
from compgen.resources import data_folder

#: Markdown that the preflight lists are made of; no raw HTML, links or pictures.
_OFF = ("html_block", "html_inline", "link", "image", "autolink", "reference")


def render_page(
    source: ResultFolder,
    data: Mapping[str, Any],
    pictures: Mapping[str, Sequence[Picture]],
    seconds: float | None = None,
) -> str:
    """Return the text of ``report.html``.

    Parameters
    ----------
    source : the folder, for the beginnings of the files and the preflight lists.
    data : from :func:`compgen.report.html.content.content`.
    pictures : by group: ``curves``, ``squareness``, ``measurement``, and ``space-K``, ``slices-K``, ``tables-K`` for
        control K.
    seconds : how long the drawing took; None leaves it out.
    """
    environment = _environment()
    script = _file(environment, "script.js")
    drawn = [picture for group in pictures.values() for picture in group]
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{_hash(script)}'"
    policy += "; base-uri 'none'; form-action 'none'"
    return environment.get_template("page.html.j2").render(
        data=data,
        controls=list(zip(data["controls"], source.controls, strict=True)),
        pictures=pictures,
        figures=FIGURES,
        policy=policy,
        style=Markup(_file(environment, "style.css")),
        script=Markup(script),
        payload=script_data({picture.key: dict(picture.data) for picture in drawn if picture.data}),
        seconds=seconds,
    )


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(data_folder("templates") / "_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "um": um,
        "number": number,
        "known": lambda value: "not known" if value is None else number(value),
        "markdown": markdown,
        "unit": lambda name: LABEL.get(name, name),
    }
    return environment


def _file(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def script_data(value: Any) -> Markup:
    r"""Return data as JSON that stays data inside a script element, whatever texts it holds.

    >>> print(script_data({"a": "</script><!--"}))
    {"a":"\u003c/script\u003e\u003c!--"}
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)  # ASCII, so U+2028 and U+2029 are escaped
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def number(value: Any, digits: int = 3) -> str:
    """A number with ``digits`` digits after the point; a dash where there is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}"


def markdown(text: str) -> Markup:
    """Return the HTML of Markdown without raw HTML, links and pictures; the check boxes of lists become marks."""
    from markdown_it import MarkdownIt

    html = MarkdownIt("commonmark", {"html": False}).enable("table").disable(list(_OFF)).render(text)
    html = re.sub(r"<(/?)h([1-3])>", lambda found: f"<{found.group(1)}h{int(found.group(2)) + 3}>", html)
    return Markup(html.replace("<li>[ ] ", "<li class='check'>"))


__all__ = ["escape", "markdown", "number", "render_page", "script_data"]
