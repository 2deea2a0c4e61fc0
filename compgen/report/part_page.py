"""``part.html``: what a machine leaves on a part, the path of the tool in three dimensions, and a ranking of machines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.data.names import MM_PER_UM
from compgen.drawing.charts import page_assets, rounded
from compgen.programs.part import VARIANTS, PartPrediction, columns_of
from compgen.report.html.write import page_environment, script_data
from compgen.resources import LANGUAGES

#: Rows of the tables of features; the rest is in ``part.json``.
MOST_ROWS = 300
#: Figures of the path that are shown: key and heading.
FIGURES = {
    "normal_max_um": "largest distance from the path",
    "normal_rms_um": "rms",
    "ends_max_um": "largest at ends of moves",
    "max_um": "largest with what is along the path",
    "rms_um": "rms",
}


def part_page(found: PartPrediction, ranking: Sequence[PartPrediction] = (), language: str = LANGUAGES[0]) -> str:
    """Return a page in one file: figures, features, the path in three dimensions, and the ``ranking`` of several machines."""
    style, script, policy = page_assets("part.js")
    data = {
        "at": [rounded(row, 6) for row in found.position_mm],
        "off": [[rounded(row, 4) for row in one / MM_PER_UM] for one in found.deviation_mm.values()],
    }
    variants = zip(VARIANTS, found.variants, strict=True)
    figures = [(name, one.as_dict()) for name, one in variants if one is not None]
    made = [item for item in ranking if not item.refused]
    compared = []
    for rows in zip(*(item.features for item in made), strict=True):
        errors = [abs(feature.best) for feature in rows]
        compared.append((rows, int(np.argmin(errors))))
    return page_environment("part", language).get_template("part.html.j2").render(
        found=found, figures=figures, headings=list(FIGURES.items()), columns=columns_of(found.features),
        features=found.features[:MOST_ROWS], ranking=ranking, made=made, compared=compared[:MOST_ROWS],
        views=list(found.deviation_mm), fitted=found.fitted,
        wins=[sum(best == k for _, best in compared) for k in range(len(made))],
        thinned=found.every, data=script_data(data), style=style, script=script, policy=policy,
    )  # fmt: skip
