"""Makes ``hidden`` importable by its own modules; the package has no ``__init__.py`` like all of ``tests``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
