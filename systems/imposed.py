"""Imposed terms: bonds and angles of a trajectory's frames that come from a reference and not from the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Bonds that the reference constrains; all other bond lengths; bond angles and how siblings fan out about an atom.
RIGID_BONDS, BONDS, ANGLES = "rigid bonds", "bonds", "angles"
KEY = "imposed"


def imposed_terms(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the terms that a trajectory's record says are imposed; nothing where it does not say."""
    terms = record.get(KEY)
    return tuple(str(term) for term in terms) if isinstance(terms, list | tuple) else ()
