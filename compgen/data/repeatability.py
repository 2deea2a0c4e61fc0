"""How well a machine repeats from one calibration to the next, and how fast it drifts: section ``[repeatability]``."""

from __future__ import annotations

from dataclasses import dataclass

from compgen.data import toml_files

#: Default repeatability of a scale: 0.3 K of steel; where temperatures are read, what is left of them, um/m.
SCALE_UM_PER_M, SCALE_CORRECTED_UM_PER_M = 3.5, 1.0
#: How much warmer or colder a hall is from one calibration to the next if nobody reads it (standard deviation), K; and the
#: expansion of a scale whose coefficient is not stated, um/(m K).
SEASON_K, USUAL_UM_PER_M_K = 2.0, 11.5
#: Uncertainty of an expansion coefficient that the machine file does not state, share of the coefficient.
EXPANSION_SHARE = 0.2

_size = toml_files.bounded("a standard deviation from 0.001 to 10000", minimum=1e-3, maximum=1e4)


@dataclass(frozen=True)
class Repeatability:
    """How much calibrations of an unchanged machine differ (standard deviations), and what it may drift.

    ``scale_um_per_m`` None: 3.5, or 1 where temperatures are read and the scales corrected for them. ``drift_...`` are of
    a month, and grow with the square root of the time.
    """

    scale_um_per_m: float | None = toml_files.setting(
        _size,
        None,
        meaning="standard deviation of the scale of an axis from one calibration to the next, um/m (3.5 if not stated; 1 where "
        "temperatures are read)",
    )
    season_k: float | None = toml_files.setting(
        toml_files.bounded("a standard deviation from 0 to 50", minimum=0.0, maximum=50.0),
        None,
        meaning="standard deviation of the temperature of the hall from one calibration to the next, K, which moves all scales "
        "together where nobody reads it (2 if neither this nor scale_um_per_m is stated, else 0)",
    )
    squareness_urad: float = toml_files.setting(
        _size, 1.0, meaning="standard deviation of a squareness from one calibration to the next, urad"
    )
    drift_scale_um_per_m: float = toml_files.setting(
        _size, 5.0, meaning="what a scale may drift in a month, standard deviation, um/m"
    )
    drift_squareness_urad: float = toml_files.setting(
        _size, 5.0, meaning="what a squareness may drift in a month, standard deviation, urad"
    )

    @property
    def hall_k(self) -> float:
        """Standard deviation of a temperature that all scales share and nobody reads, K."""
        usual = SEASON_K if self.scale_um_per_m is None else 0.0
        return usual if self.season_k is None else self.season_k

    def scale(self, *, temperatures: bool) -> float:
        """Return the standard deviation of a scale, mm/mm, with or without temperatures that were corrected for."""
        usual = SCALE_CORRECTED_UM_PER_M if temperatures else SCALE_UM_PER_M
        return 1e-6 * (usual if self.scale_um_per_m is None else self.scale_um_per_m)
