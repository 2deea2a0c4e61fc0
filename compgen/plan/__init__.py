"""Planning a measurement: what it will determine, how well, and better places for the stations."""

from compgen.plan.plan import Plan, VolumeUncertainty, plan, plan_of, planned_noise
from compgen.plan.planned import Planned, planned
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
from compgen.plan.suggest import Candidate, Suggestion, candidate_trajectories, judge_trajectories, suggest
from compgen.plan.visibility import PlanVisibility, plan_visibility

__all__ = [
    "Box",
    "Candidate",
    "Plan",
    "Planned",
    "PlanVisibility",
    "PlannedStations",
    "Shell",
    "Suggestion",
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
