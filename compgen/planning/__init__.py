"""Planning a measurement: what it will determine, how well, better places for the stations, and what to measure next."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.planning.next_measurement import NextBest, NextMeasurement, next_best
    from compgen.planning.prediction import (
        Plan,
        Planned,
        PlanVisibility,
        VolumeUncertainty,
        plan,
        plan_of,
        plan_visibility,
        planned,
        planned_noise,
    )
    from compgen.planning.stations import (
        Box,
        PlannedStations,
        Shell,
        box_from_text,
        format_stations,
        planned_stations,
        read_boxes,
        read_stations,
        regions_of,
        shell_around,
    )
    from compgen.planning.suggestions import (
        Suggestion,
        TrajectoryCandidate,
        candidate_trajectories,
        judge_trajectories,
        suggest,
    )

__all__ = [
    "Box",
    "NextBest",
    "NextMeasurement",
    "Plan",
    "PlanVisibility",
    "Planned",
    "PlannedStations",
    "Shell",
    "Suggestion",
    "TrajectoryCandidate",
    "VolumeUncertainty",
    "box_from_text",
    "candidate_trajectories",
    "format_stations",
    "judge_trajectories",
    "next_best",
    "plan",
    "plan_of",
    "plan_visibility",
    "planned",
    "planned_noise",
    "planned_stations",
    "read_boxes",
    "read_stations",
    "regions_of",
    "shell_around",
    "suggest",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
