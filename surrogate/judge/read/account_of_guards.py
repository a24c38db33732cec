"""What a rollout's file says that its guards did: a column, frame by frame, and an account in its record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

# Scalar column, 0 for a frame that nothing was done about.
COLUMN = "intervention"


def unseen_notes(label: str, records: Sequence[dict[str, Any]]) -> list[str]:
    """Return that a rollout's molecule was not trained on, else nothing."""
    if not any(r.get("unseen_molecule") for r in records):
        return []
    return [f"{label}: its weights ({records[0].get('weights')}) were not trained on this molecule."]


def intervention_notes(label: str, records: Sequence[dict[str, Any]]) -> list[str]:
    """Return what the guards of a rollout did, replicas together, and what it may do to statistics; else nothing."""
    accounts = [r["interventions"] for r in records if isinstance(r.get("interventions"), dict)]
    frames: Counter[str] = Counter()
    bias: dict[str, None] = {}
    for account in accounts:
        frames.update({str(k): int(v) for k, v in account.get("frames", {}).items()})
        bias |= dict.fromkeys(str(why) for why in account.get("bias", []))
    if not frames:
        return []
    chunks, caught = (sum(int(a.get(key, 0)) for a in accounts) for key in ("chunks", "chunks_caught"))
    done = ", ".join(f"{n} {name}" for name, n in frames.items())
    return [
        f"{label}: guard {accounts[0].get('guard')} stepped in in {caught} of {chunks} chunks; frames that are not the "
        f"model's first draw: {done}. What that may do: {'; '.join(bias)}."
    ]
