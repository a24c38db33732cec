"""The list of fifty SMILES, run: what is prepared runs and keeps its stereo, or is refused with the reason."""

from __future__ import annotations

import pytest
from drug_like_smiles import Case, cases, run_case

BY_NAME = {c.name: c for c in cases()}
NOT_GAFF2 = {"radical": "unpaired electron", "element": "GAFF2 has no parameters for"}


def _check(case: Case) -> None:
    outcome = run_case(case, time_ps=1.0, timestep_ps=0.002, force_field="auto")
    expected = case.refusal or NOT_GAFF2.get(case.kind, "")
    assert outcome.status == ("refused" if expected else "ran"), outcome.reason
    assert expected in outcome.reason and "\n" not in outcome.reason
    # cyclo-triglycyl is three glycines, which ff14SB knows
    assert outcome.force_field in ([""] if expected else ["ff14SB"] if case.name == "cyclo-triglycyl" else ["gaff2"])


@pytest.mark.parametrize("name", ["aspirin", "TEMPO", "bortezomib", "cisplatin", "choline salicylate"])
def test_shipped_parameters_run_and_what_gaff2_lacks_is_refused(name: str) -> None:
    _check(BY_NAME[name])


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=lambda c: c.name)
def test_each_runs_or_says_why_not(case: Case) -> None:
    from md_reference.forces.programs import find_ambertools

    if find_ambertools() is None:
        pytest.skip("needs AmberTools")
    _check(case)
