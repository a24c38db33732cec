"""What `surromd info` says of a rollout's guards."""

from __future__ import annotations

from typing import Any

import pytest

from surrogate.verbs.info import intervention_lines


def account(chunks: int, caught: int, **more: Any) -> dict[str, Any]:
    plain = {"guard": "flag", "chunks": chunks, "chunks_caught": caught, "reasons": {"clash": 3}, "frames": {}}
    return {"interventions": plain | more}


@pytest.mark.parametrize(
    ("chunks", "caught", "said"),
    [(162, 162, "100 %"), (10_000, 9_999, "99.9 %"), (162, 100, "62 %"), (162, 1, "0.62 %"), (1000, 995, "99.5 %")],
)
def test_a_share_of_chunks_is_said_as_people_write_it(chunks: int, caught: int, said: str) -> None:
    assert intervention_lines(account(chunks, caught)) == [
        f"guard flag: {caught} of {chunks} chunks caught ({said}): clash (3 frames)"
    ]


def test_what_help_costs_is_said_as_people_write_it() -> None:
    seconds = {"draw": 2.0, "md": 9.0, "check": 0.001}
    lines = intervention_lines(account(9, 3, frames={"repaired": 4}, seconds=seconds, bias=[]))
    assert lines[-1] == "cost beside drawing chunks: md 450 %, check 0.05 %"
