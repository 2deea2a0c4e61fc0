"""Compiles the catalogues of texts when compgen is installed or built: only the `.po` files are kept in the repository."""

from pathlib import Path

from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po
from hatchling.builders.hooks.plugin.interface import BuildHookInterface


def compile_catalogues(folder: Path) -> None:
    """Write the compiled form (`.mo`) of every catalogue in a folder, each by a temporary name."""
    for path in sorted(folder.glob("*.po")):
        with path.open("rb") as file:
            catalogue = read_po(file)
        made = path.with_suffix(".mo.part")
        with made.open("wb") as file:
            write_mo(file, catalogue)
        made.replace(path.with_suffix(".mo"))


class CompiledCatalogues(BuildHookInterface):
    """Hatch calls it before it collects the files of a wheel, an editable installation or a source archive."""

    def initialize(self, version: str, build_data: dict) -> None:
        """Compile the catalogues next to their sources."""
        compile_catalogues(Path(self.root) / "templates" / "_language")


if __name__ == "__main__":
    compile_catalogues(Path(__file__).parent / "templates" / "_language")
