"""Rows that say nothing of a model, since its frames got these terms from a reference."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from surrogate.judge.rows.rows import Row
from systems.imposed import ANGLES, BONDS, RIGID_BONDS

_ROWS = {
    RIGID_BONDS: ("bond_width:constrained bonds",),
    BONDS: ("bond_shift", "bond_width:flexible bonds", "bond_jsd", "bond_wasserstein", "temperature"),
    ANGLES: ("angle_shift", "angle_jsd", "angle_wasserstein", "temperature"),
}


def is_imposed(row: Row, terms: Collection[str]) -> bool:
    """Return whether a row measures one of the imposed terms (systems.imposed)."""
    return any(row.key in _ROWS.get(term, ()) for term in terms)


def imposed_notes(label: str, rows: Sequence[Row], terms: Sequence[str]) -> list[str]:
    """Return one line that says what is imposed, where anything is."""
    n = sum(row.verdict == "imposed" for row in rows)
    if not n:
        return []
    return [
        f"{label}: {', '.join(terms)} of its frames come from the training reference and not from the model; {n} "
        "metrics of them are marked imposed and left out of the verdict."
    ]
