"""Settings of the documentation site: make docs (Sphinx; the pages are the Markdown files of this folder)."""

import os
import re
import tomllib
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

ROOT = Path(__file__).resolve().parents[1]
RESOURCES = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["version"]
VERSION = re.search(RESOURCES["pattern"], (ROOT / RESOURCES["path"]).read_text(encoding="utf-8"))
assert VERSION, "no version"

project = "volcomp"
author = "the compgen authors"
version = release = VERSION["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"volcomp {release}"
html_show_copyright = False

myst_heading_anchors = 4  # the anchors that a repository page gives its headings
myst_links_external_new_tab = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = False
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# make docs-links: addresses that answer to people only, or ask for a log-in
linkcheck_ignore = [r"https://doi\.org/.*", r"http://127\.0\.0\.1.*"]


#: Pages whose text is a file of the root folder, where people and platforms look for it.
ROOT_PAGES = {"contributing": "CONTRIBUTING.md", "changelog": "CHANGELOG.md", "security": "SECURITY.md"}


class FilesOfTheRepository(SphinxTransform):
    """Links to pages and folders outside this folder, which the site does not have, become their path as text.

    Links to single files outside (examples, machine files) stay: Sphinx copies the file and offers it for download.
    A link to what does not exist stays too, and is warned about.
    """

    default_priority = 5

    def apply(self) -> None:
        """Replace the links of one page."""
        here = Path(self.document["source"]).parent
        for link in list(self.document.findall(addnodes.pending_xref)):
            target = link.get("reftarget", "").partition("#")[0]
            # MyST gives a folder as it was written, and a page as its full path without the suffix
            path = Path(os.path.normpath(here / target)) if link.get("refdomain") != "doc" else Path(f"{target}.md")
            if path.parent == ROOT and path.name in ROOT_PAGES.values():
                link["reftarget"] = next(page for page, name in ROOT_PAGES.items() if name == path.name)
            elif path.is_absolute() and path.exists() and not path.is_relative_to(ROOT / "docs"):
                link.replace_self(nodes.literal(text=path.relative_to(ROOT).as_posix()))


def take_root_page(app, docname, source):
    """Put the text of the file of the root folder in place of the page that points to it; links count from there."""
    if docname not in ROOT_PAGES:
        return
    text = (ROOT / ROOT_PAGES[docname]).read_text(encoding="utf-8")
    text = re.sub(r"\]\((?!\w+:|#)", "](../", text).replace("](../docs/", "](")
    for page, name in ROOT_PAGES.items():
        text = text.replace(f"](../{name}", f"]({page}.md")
    source[0] = text


PARAMETER = re.compile(r"^(\*{0,2}\w[\w*, ]*) : (.*)$")


def describe_parameters(app, what, name, obj, options, lines):
    """Give each parameter its text: our docstrings have "name : meaning", where numpydoc has "name : type"."""
    inside, changed = False, []
    for k, line in enumerate(lines):
        if k + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[k + 1]):
            inside = line == "Parameters"
        found = PARAMETER.match(line) if inside else None
        changed += [found[1], f"    {found[2]}"] if found else [line]
    lines[:] = changed


def setup(app):
    """Add the rules for what lies outside this folder, and that for docstrings, before napoleon reads them."""
    app.connect("autodoc-process-docstring", describe_parameters, priority=400)
    app.add_transform(FilesOfTheRepository)
    app.connect("source-read", take_root_page)
