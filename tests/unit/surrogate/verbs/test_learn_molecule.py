"""What `train` refuses where it learns a molecule's forces, before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogate import api
from systems.errors import InputError, UnknownNameError


def refusal(tmp_path: Path, scene: str | list[str] = "smiles:O", **options: object) -> str:
    asked = {"level": "gfn2-xtb", "steps": 5, "quiet": True, **options}
    with pytest.raises(InputError) as caught:
        api.train(scene, tmp_path / "w.safetensors", **asked)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
    return str(caught.value)


def test_what_means_nothing_for_a_potential_is_refused(tmp_path: Path) -> None:
    assert "reference of MD" in refusal(tmp_path, level="mm")
    assert "learns from trajectories" in refusal(tmp_path, arch="lam-slide")
    assert "`start_from`" in refusal(tmp_path, start_from="paracetamol-gfn2-xtb", arch="painet")
    assert "`longest_lag_ps`" in refusal(tmp_path, longest_lag_ps=1.0)
    assert "budget_s" in refusal(tmp_path, steps=None)
    assert "one molecule" in refusal(tmp_path, scene=["smiles:O", "smiles:CO"])
    assert "ensemble" in refusal(tmp_path, model={"ensemble": "npt"})
    assert "Did you mean 'rounds'" in refusal(tmp_path, training={"round": 3})
    with pytest.raises(UnknownNameError, match="gfn2-xtb"):
        api.train("smiles:O", tmp_path / "w.safetensors", level="gfn2", steps=5)


def test_trajectories_say_too_little_about_forces(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"level='gfn2-xtb'"):
        api.train("reference.h5", tmp_path / "w.safetensors", arch="painet-potential", steps=5)


@pytest.mark.parametrize("answered", [True, False])
def test_an_interrupted_training_says_that_its_samples_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answered: bool
) -> None:
    def stopped(*_: object) -> Path:
        if answered:
            (tmp_path / "w.samples.safetensors").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("surrogate.verbs.train.learn_molecule", stopped)
    with pytest.raises(KeyboardInterrupt) as caught:
        api.train("smiles:O", tmp_path / "w.safetensors", level="gfn2-xtb", steps=5, quiet=True)
    assert ("w.samples.safetensors" in str(caught.value)) is answered
    assert ("`resume=True`" in str(caught.value)) is answered


def test_a_training_that_is_done_is_left_alone_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "w.safetensors"
    out.write_bytes(b"weights")
    api.train("smiles:O", out, level="gfn2-xtb", budget_s="1h", resume=True)
    assert "w.safetensors: this training is done" in capsys.readouterr().err and out.read_bytes() == b"weights"
