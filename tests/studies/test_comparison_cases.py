"""The table of the manual (docs/compare_cases.md): what must be said of each case is said."""

from __future__ import annotations

from pathlib import Path

import pytest
from compare_cases import CASES, Case, Outcome, run_cases, table


@pytest.mark.slow
def test_every_case_is_evaluated_as_it_must_be(shared_data: Path) -> None:
    outcomes = run_cases(shared_data / "alanine-dipeptide")
    assert [o.case.name for o in outcomes if not o.as_due] == [], table(outcomes)


def test_the_manual_has_every_case() -> None:
    page = Path(__file__).parents[2] / "docs" / "compare_cases.md"
    text = page.read_text(encoding="utf-8")
    assert "**wrong:**" not in text
    for case in CASES:
        assert f"| {case.name} | {' or '.join(case.statuses)} |" in text, case.name


def test_a_case_that_is_evaluated_otherwise_is_marked() -> None:
    case = Case("x", lambda r, x, y: x, ("broken",), "apart")
    assert "**wrong:** close" in table([Outcome(case, "close", "fine", False)])
