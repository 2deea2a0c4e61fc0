"""Planning a measurement: what it will determine, how well, and better places for the stations."""

from compgen.plan.prediction import (
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
from compgen.plan.stations import (
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
from compgen.plan.suggest import Suggestion, TrajectoryCandidate, candidate_trajectories, judge_trajectories, suggest

__all__ = [
    "Box",
    "Plan",
    "Planned",
    "PlanVisibility",
    "PlannedStations",
    "Shell",
    "Suggestion",
    "TrajectoryCandidate",
    "VolumeUncertainty",
    "box_from_text",
    "candidate_trajectories",
    "format_stations",
    "judge_trajectories",
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
