"""The state machine of a set of tables: what the decisions make of it, and which decision is allowed next.

propose -> pending        approve -> active       another approved -> retired    rollback to it -> active
hold    -> held           reject  -> rejected     a newer proposal -> superseded
refuse  -> refused        (the round trip did not accept the files: for good)
"""

from __future__ import annotations

from collections.abc import Sequence

from compgen.recal.records import DecisionKind, DecisionRecord, TableState

#: Who decides where no person does.
AUTOMATIC = "automatic"
#: State right after a decision about a set of tables.
AFTER: dict[DecisionKind, TableState] = {
    "propose": "pending",
    "hold": "held",
    "refuse": "refused",
    "supersede": "superseded",
    "approve": "active",
    "reject": "rejected",
    "rollback": "active",
}
#: States in which a person may decide.
OPEN: tuple[TableState, ...] = ("pending", "held")
#: States that a rollback may bring back.
WAS_ACTIVE: tuple[TableState, ...] = ("retired",)


def active_id(decisions: Sequence[DecisionRecord]) -> int | None:
    """Return the id of the tables that are active after the decisions of one machine, None if none are."""
    for decision in reversed(decisions):
        if decision.kind in ("approve", "rollback"):
            return decision.table_id
    return None


def state_of(table_id: int, decisions: Sequence[DecisionRecord]) -> TableState:
    """Return the state of one set of tables after the decisions of its machine."""
    own = [decision for decision in decisions if decision.table_id == table_id]
    if not own:
        return "held"
    state = AFTER[own[-1].kind]
    return "retired" if state == "active" and active_id(decisions) != table_id else state


def before_active(decisions: Sequence[DecisionRecord]) -> int | None:
    """Return the id of the tables that were active before the active ones were first approved, None if none were.

    A rollback counts as if what it undid had never been: after versions 1, 2, 3 and a rollback to 2 the one before is 1.
    """
    stack: list[int | None] = [None]
    for decision in decisions:
        if decision.kind == "approve":
            stack.append(decision.table_id)
        elif decision.kind == "rollback":
            if decision.table_id in stack:
                last = len(stack) - 1 - stack[::-1].index(decision.table_id)
                del stack[last + 1 :]
            else:
                stack.append(decision.table_id)
    return stack[-2] if len(stack) > 1 else None
