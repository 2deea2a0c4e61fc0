"""A page as PDF, printed by the Chromium of this computer without a window; without one, a browser's own print does it."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from compgen.errors import InputError

#: Browsers that print without a window, by the names of their programs.
BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "msedge",
    "microsoft-edge",
)
#: Longest time for one page, seconds.
PATIENCE_S = 120.0


def browser() -> str | None:
    """Return the path of a browser that prints without a window; None if there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def pdf_of(page: Path) -> bytes:
    """Return a page in one file as PDF.

    Raises
    ------
    InputError
        if there is no such browser, or it does not print.
    """
    program = browser()
    if program is None:
        text = f"needs a browser that prints without a window ({', '.join(BROWSERS[:3])}); open {page} and print it to PDF there"
        raise InputError(text, field="--pdf")
    with tempfile.TemporaryDirectory(prefix="volcomp-pdf-") as folder:
        made = Path(folder) / "page.pdf"
        words = [
            program, "--headless=new", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-extensions", "--disable-dev-shm-usage", f"--user-data-dir={folder}/profile", "--no-pdf-header-footer",
            f"--print-to-pdf={made}", page.resolve().as_uri(),
        ]  # fmt: skip
        for more in (
            [],
            ["--no-sandbox"],
        ):  # in a container, or as root, its own fence cannot be built: the page has no network
            try:
                subprocess.run([words[0], *more, *words[1:]], capture_output=True, timeout=PATIENCE_S, check=False)
            except (OSError, subprocess.TimeoutExpired) as error:
                raise InputError(f"{program} does not print {page}: {error}", field="--pdf") from error
            if made.is_file():
                return made.read_bytes()
    raise InputError(f"{program} does not print {page}; open it in a browser and print it to PDF there", field="--pdf")
