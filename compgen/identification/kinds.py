"""What a measurement can be: readings of one kind, or several kinds of the same machine together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from compgen.data.error_table import ErrorTable

if TYPE_CHECKING:
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Artefact, Deviations
    from compgen.data.length_archive import LengthArchive
    from compgen.data.lengths import Lengths
    from compgen.identification.six_dof import SixDofMeasurement

OneKind: TypeAlias = "Lengths | LengthArchive | Deviations | AxisRuns | Circles | Artefact | SixDofMeasurement"


@dataclass(frozen=True)
class MixedMeasurement:
    """Several measurements of the same machine, each of one kind, and errors that are known otherwise; with their names."""

    parts: tuple[tuple[str, OneKind | ErrorTable], ...]

    def first(self) -> OneKind | None:
        """Return the first measurement among the parts."""
        return next((part for _, part in self.parts if not isinstance(part, ErrorTable)), None)


Measurement: TypeAlias = "OneKind | MixedMeasurement"
