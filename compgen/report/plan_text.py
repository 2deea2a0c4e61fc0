"""Readable summary of a planned measurement for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from compgen.core.names import error_named
from compgen.effects.visibility import separating
from compgen.plan import Candidate, Plan, PlanVisibility, Suggestion

#: Reasons beyond this number stand in plan.json only.
MOST_REASONS = 8
#: Pairs beyond this number stand in plan.json only.
MOST_PAIRS = 12


def plan_table(plan: Plan) -> Group:
    """Return the verdict, the predicted uncertainty of the volume and that of every error."""
    stations, rank = plan.planned.stations, plan.rank
    lines = [
        f"{plan.readings} readings of {len(stations)} stations, rank {rank.rank} of {rank.size} unknowns",
        f"uncertainty of a reading ({plan.planned.noise.source}): {plan.planned.noise.constant_um:g} um + "
        f"{plan.planned.noise.proportional_um_per_m:g} um/m",
        volume_line("volume", plan),
    ]
    notes = [Text(f"not determined: {reason}", "red") for reason in plan.reasons[:MOST_REASONS]]
    if len(plan.reasons) > MOST_REASONS:
        notes.append(Text(f"and {len(plan.reasons) - MOST_REASONS} more in plan.json", "red"))
    table = Table("error", "u (k = 1) max", "at (mm)", "unit", box=box.SIMPLE)
    for name in plan.errors.names:
        error = error_named(name)
        if name in plan.errors.squareness:
            table.add_row(name, _figure(plan.errors.squareness[name][1] / error.si_per_unit), "", error.unit)
        else:
            curve = plan.errors.curves[name]
            worst = float(curve.u.max()) / error.si_per_unit
            where = f"{curve.position_mm[int(np.argmax(curve.u))]:g}" if np.isfinite(worst) else ""
            table.add_row(name, _figure(worst), where, error.unit)
    return Group(Text("\n".join(lines)), *notes, table)


def _figure(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "not determined"


def volume_line(title: str, plan: Plan) -> str:
    """Return a line or two with the uncertainty of E over the volume."""
    report = plan.volume.summary()
    if report["undetermined_points"]:
        return f"{title}: E is not determined at {report['undetermined_points']} of {report['points']} points"
    axes = ", ".join(f"{axis} {report[f'u_{axis}_max_um']:.3f} / {report[f'u_{axis}_rms_um']:.3f}" for axis in "xyz")
    together = f"{report['u_max_um']:.3f} / {report['u_rms_um']:.3f} um"
    return f"{title}: u of E, max / rms: {together}\n  by axis: {axes} um"


def suggestion_table(suggestion: Suggestion) -> Group:
    """Return the places that the search found."""
    table = Table("station", "x (mm)", "y (mm)", "z (mm)", box=box.SIMPLE)
    stations = suggestion.plan.planned.stations
    for name, place in zip(stations.names, stations.position_mm, strict=True):
        table.add_row(name, *(f"{value:.1f}" for value in place))
    title = "suggested places" if suggestion.improved else "no better places were found"
    return Group(Text(volume_line(f"{title} ({suggestion.evaluations} arrangements)", suggestion.plan)), table)


def trajectory_table(judged: Sequence[Candidate], chosen: Candidate | None, target_um: float) -> Group:
    """Return the trajectories that were judged, and the one that reaches the target."""
    table = Table("trajectory", "points", "u max (um)", "u rms (um)", box=box.SIMPLE)
    for item in judged:
        table.add_row(item.name, str(len(item.position_mm)), _figure(item.worst_um), _figure(item.rms_um))
    verdict = (
        f"the smallest trajectory within {target_um:g} um: {chosen.name}"
        if chosen
        else f"no trajectory reaches {target_um:g} um with these stations"
    )
    return Group(table, Text(verdict, "" if chosen else "red"))


def visibility_table(visible: PlanVisibility) -> Group:
    """Return what the plan can never see of the effects beside the geometric errors, and which look alike."""
    never = Table("what this plan can never see", "why", "measure in addition", box=box.SIMPLE)
    for (reason, breaker), names in _grouped(visible).items():
        never.add_row(", ".join(names), reason, breaker)
    alike = Table("look alike", "correlation", "measure in addition", box=box.SIMPLE)
    for pair in visible.pairs[:MOST_PAIRS]:
        first, second = (visible.cards[name] for name in pair.names)
        shared = f"{pair.correlation:.3f} ({pair.shared} of {pair.directions} directions)"
        alike.add_row(" and ".join(pair.names), shared, separating(first, second))
    notes = [Text(f"assumed: {'; '.join(visible.assumed)}")] if visible.assumed else []
    if len(visible.pairs) > MOST_PAIRS:
        notes.append(Text(f"and {len(visible.pairs) - MOST_PAIRS} more pairs in plan.json"))
    return Group(never, alike, *notes)


def _grouped(visible: PlanVisibility) -> dict[tuple[str, str], list[str]]:
    """Effects that are not seen, by reason and by what would show them."""
    found: dict[tuple[str, str], list[str]] = {}
    for name, reason in visible.never.items():
        found.setdefault((reason.partition(":")[0], visible.cards[name].breaker), []).append(name)
    return found
