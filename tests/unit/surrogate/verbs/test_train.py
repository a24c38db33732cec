"""What `train` chooses for its references and says, what it refuses, and the verdict that it ends with."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

import surrogate as sm
from command_line import SMALL_LAM_SLIDE, run
from surrogate import api
from surrogate.data import References, TrainingFrames
from surrogate.models.architecture import TrainingRequest, toml_text, weights_path
from surrogate.models.lam_slide import trainer as choices
from surrogate.models.lam_slide.model import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.trainer import PeptideTraining
from surrogate.models.weights import Weights, load_weights, save_weights
from surrogate.sampling.domain import match_domain
from surrogate.verbs.train import TrainingVerdict, compare_training, word_of
from systems.errors import InputError, OutOfDomainError, UnknownNameError
from systems.library.named_scenes import prepare
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_writer
from systems.trajectory.companion_writer import pdb_text

MD = {"kind": "reference", "temperature_k": 300.0, "force_field": "ff14SB", "solvent": "obc2"}


def write(folder: Path, scene: Scene, n_frames: int = 64, record: dict[str, object] = MD, lag_ps: float = 1.0) -> Path:
    """Write frames in which every atom shakes by itself."""
    path, rng = folder / f"{scene.name}.h5", np.random.default_rng(n_frames)
    with open_writer(path, scene, record) as writer:
        frames = scene.positions_nm + 0.003 * rng.normal(size=(n_frames, scene.n_atoms, 3))
        writer.append(frames, lag_ps * np.arange(1.0, n_frames + 1))
    return path


def explained(references: Sequence[Path], **given: object) -> tuple[dict[str, object], list[str]]:
    """Return the record of the explained configuration and the lines at its head."""
    text = sm.explain_training(list(references), **given)
    return tomllib.loads(text), [line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ")]


def chosen(lines: list[str]) -> dict[str, str]:
    return dict(line.split(": ")[0].split(" = ") for line in lines)


@pytest.fixture(scope="module")
def alanine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("one"), build_peptide("ACE-ALA-NME"), 660)


@pytest.fixture(scope="module")
def peptides(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("peptides")
    return [write(folder, build_peptide(s), 200, lag_ps=2.0) for s in ("ACE-ALA-NME", "ACE-SER-NME")]


def test_one_molecule_keeps_every_default(alanine: Path) -> None:
    record, lines = explained([alanine])
    assert lines == ["arch = lam-slide: one molecule"]
    assert LamSlideConfig.from_dict(record["model"]) == LamSlideConfig()
    assert TrainingConfig(**record["training"]) == TrainingConfig()
    assert not {"budget_s", "seed", "device", "stage_one_steps"} & record["training"].keys()


def test_one_molecule_is_trained_as_by_the_defaults_bit_for_bit(alanine: Path, tmp_path: Path) -> None:
    few = {"stage_one_batch": 8, "stage_two_batch": 2}
    settings = TrainingConfig(stage_one_steps=1, stage_two_steps=1, seed=5, **few)
    references, trainer = References((alanine,)), choices.LamSlideTrainer()
    frames = references.frames(canonical=True)
    plain = train_lam_slide(frames, tmp_path / "plain.safetensors", LamSlideConfig(), settings)
    request = TrainingRequest("lam-slide", tmp_path / "intent.safetensors", steps=2, seed=5, training=few)
    request = request.with_choices(trainer.choose(references, request))
    by_intent = trainer.prepare(references, request).start(lambda stage, share: None)
    one, other = load_file(plain), load_file(by_intent)
    assert one.keys() == other.keys() and all(np.array_equal(one[k], other[k]) for k in one)


def test_several_peptides_are_known_by_their_residues(peptides: list[Path]) -> None:
    record, lines = explained(peptides)
    assert lines[0].startswith("arch = lam-slide-peptides: 2 peptides")
    assert chosen(lines) == {"arch": "lam-slide-peptides", "model.shortest_ps": "2.0", "model.longest_ps": "360.0",
                             "training.time_reversal": "true"}  # fmt: skip
    assert PeptideConfig.from_dict(record["model"]) == PeptideConfig(shortest_ps=2.0, longest_ps=360.0)
    assert PeptideTraining(**record["training"]) == PeptideTraining(time_reversal=True)
    alone, _ = explained(peptides[:1])
    assert alone["arch"] == "lam-slide"


def test_peptides_are_trained_and_rolled_by_the_verb(peptides: list[Path], tmp_path: Path) -> None:
    config, out = tmp_path / "small.toml", tmp_path / "w.safetensors"
    config.write_text("[model]\nwidth = 16\nn_layers = 1\nn_heads = 2\nchunk_frames = 4\n")
    done = run("train", *map(str, peptides), "--config", str(config), "--steps", "4", "--longest-lag", "40ps", "-o",
               str(out))  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert "model.longest_ps = 40.0: --longest-lag" in done.stderr and "frames pass the guards" in done.stderr
    weights = load_weights(out)
    assert weights.model.arch == "lam-slide-peptides" and weights.domain.lag_ps == pytest.approx(2.0)
    assert (
        len(weights.domain.members) == 2
        and weights.domain.transferable
        and weights.domain.longest_lag_ps == pytest.approx(40.0, rel=0.1)
    )


def test_a_peptide_from_any_file_is_learned_under_standard_names_and_for_itself_alone(tmp_path: Path) -> None:
    """Histidine as a structure database calls it, without hydrogens: prepared, it has other names and another order."""
    built, pdb = build_peptide("ACE-HIE-NME"), tmp_path / "his.pdb"
    lines = [line for line in pdb_text(built).splitlines() if line.startswith(("ATOM", "HETATM"))]
    pdb.write_text("".join(line.replace("HIE", "HIS") + "\n" for line in lines if line[76:78].strip() != "H"))
    scene = prepare(str(pdb))
    assert "HIS" in scene.residue_names and scene.atom_names != built.atom_names
    (folder := tmp_path / "runs").mkdir()
    config, out = folder / "small.toml", folder / "w.safetensors"
    config.write_text("[model]\nwidth = 16\nn_layers = 1\nn_heads = 2\nchunk_frames = 4\n")
    done = run("train", str(write(folder, scene, 200)), "--arch", "lam-slide-peptides", "--config", str(config),
               "--steps", "2", "-o", str(out), "-q")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    weights = load_weights(out)
    assert weights.domain.scene.residue_names[1] in ("HID", "HIE"), "whichever its hydrogens say"
    assert not weights.domain.transferable
    order = match_domain(scene, weights).order
    assert [scene.elements[k] for k in order] == list(weights.domain.scene.elements)
    with pytest.raises(OutOfDomainError, match="atoms"):
        match_domain(build_peptide("ACE-HID-ALA-NME"), weights, force=True)


def test_several_lags_are_learned_where_they_are_asked_for(alanine: Path) -> None:
    record, lines = explained([alanine], longest_lag_ps="10ps")
    assert chosen(lines) == {"arch": "lam-slide", "training.time_reversal": "true"}
    assert record["training"]["longest_lag_ps"] == 10.0
    assert LamSlideConfig.from_dict(record["model"]) == LamSlideConfig()


def test_the_explained_file_gives_the_same_training(alanine: Path, tmp_path: Path) -> None:
    small, filled = tmp_path / "small.toml", tmp_path / "filled.toml"
    small.write_text(SMALL_LAM_SLIDE)
    names = [str(alanine)]
    shown = run("train", *names, "--config", str(small), "--longest-lag", "4ps", "--explain")
    assert shown.exit_code == 0, shown.stderr
    filled.write_text(shown.stdout)
    written = {}
    for name, options in (("direct", [str(small), "--longest-lag", "4ps"]), ("filled", [str(filled)])):
        out = tmp_path / f"{name}.safetensors"
        done = run("train", *names, "--steps", "3", "-o", str(out), "--device", "cpu", "-q", "--config", *options)
        assert done.exit_code == 0, done.stderr
        written[name] = load_file(out)
    assert all(np.array_equal(written["direct"][k], written["filled"][k]) for k in written["direct"])


def test_more_atoms_than_identifiers_get_more_of_these(tmp_path: Path) -> None:
    chain = write(tmp_path, prepare("smiles:CCCCCCCCCCC"))
    record, lines = explained([chain])
    assert record["model"]["autoencoder"]["identifier_pool"] == 35
    assert lines[1].endswith("35 atoms, more than 32 identifiers")
    config = tmp_path / "mine.toml"
    config.write_text("[model.autoencoder]\nidentifier_pool = 40\n")
    record, lines = explained([chain], config=config)
    assert record["model"]["autoencoder"]["identifier_pool"] == 40 and len(lines) == 1, "what the user sets stays"


def test_molecules_that_are_no_peptides_are_refused_together(tmp_path: Path, peptides: list[Path]) -> None:
    two = [write(tmp_path, prepare(f"smiles:{smiles}"), lag_ps=2.0) for smiles in ("CCO", "CCC")]
    for references, validation in ((two, []), ([*peptides, two[0]], []), (two[:1], two[1:])):
        with pytest.raises(InputError, match="no installed architecture suits"):
            explained(references, validation=validation)


def test_files_that_cannot_be_meant_are_refused_in_one_line(alanine: Path, tmp_path: Path) -> None:
    config = tmp_path / "bad.toml"
    for text, said in (
        ("chunk_frames = 4\n", "bad.toml: unknown key 'chunk_frames'"),
        ("model = 3\n", "bad.toml: model"),
        ('arch = "painte"\n', "Did you mean 'painet'"),
        ("[training]\nstage_two_bacth = 3\n", "training.stage_two_bacth.*stage_two_batch"),
    ):
        config.write_text(text)
        with pytest.raises(InputError, match=said):
            explained([alanine], config=config)
    refused = run("train", str(alanine), "--steps", "4")
    assert refused.exit_code == 2 and "train needs --out" in refused.stderr


def test_a_record_comes_back_from_its_toml() -> None:
    record = {"arch": "a", "model": {"n": 3, "x": 1e-3, "on": True, "none": None, "text": 'q"\\', "list": [1.5, "b"],
                                     "deep": {"quad": [1, 2], "visited": None, "empty": []}},
              "training": {}}  # fmt: skip
    found = tomllib.loads(toml_text(record))
    expected = {"arch": "a", "model": {"n": 3, "x": 1e-3, "on": True, "text": 'q"\\', "list": [1.5, "b"],
                                       "deep": {"quad": [1, 2], "empty": []}}, "training": {}}  # fmt: skip
    assert found == expected


SMALL = """
[model.autoencoder]
latent_dim = 12
width = 64
head_dim = 16
[model.approximator]
chunk_frames = 8
width = 64
n_layers = 2
n_heads = 2
auxiliary_frames = 2
"""


@pytest.fixture(scope="module")
def references(
    harmonic_frames: TrainingFrames, alanine_dipeptide: Scene, tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    folder = tmp_path_factory.mktemp("references")
    record = {"kind": "reference", "force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
    paths = []
    for k in range(2):
        paths.append(folder / f"r{k}.h5")
        with open_writer(paths[-1], alanine_dipeptide, record) as writer:
            writer.append(
                harmonic_frames.positions_nm(np.arange(400 * k, 400 * (k + 1))), 10.0 * (np.arange(400) + 1.0)
            )
    return paths


def test_too_short_a_training_is_called_unusable_and_told_what_would_help(
    tmp_path: Path, references: list[Path], capfd: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "small.toml"
    config.write_text(SMALL)
    out = api.train(references, tmp_path / "m.safetensors", config=config, steps=10)
    said = capfd.readouterr().err
    verdict = json.loads((tmp_path / "m.verdict.json").read_text())
    assert verdict["word"] == "not usable" and verdict["percent_valid"] < 50.0
    assert verdict["steps"] == {"autoencoder": 2, "flow": 8} and verdict["validation"]["flow"]["validation_flow"] > 0
    assert "autoencoder 2 steps, flow 8 steps; validation error" in said and "not usable as it is" in said
    advice = " ".join(verdict["advice"])
    assert "more minutes" in advice and "800 frames are few" in advice
    assert out.exists() and not list(tmp_path.glob("*.h5"))


def test_weights_that_are_good_are_called_usable(tmp_path: Path) -> None:
    path = tmp_path / "good.safetensors"
    shutil.copy(weights_path("alanine-dipeptide"), path)
    verdict = compare_training(path)
    assert verdict.word == "usable" and verdict.percent_valid > 99.0 and verdict.advice == ()
    assert "usable; whether populations" in verdict.lines()[-1]


def test_weights_that_stand_still_are_not(tmp_path: Path, small_weights: Weights) -> None:
    """Valid as molecules go, and no motion: the guards' limit of stillness set above what this network moves."""
    limits = small_weights.domain.limits
    assert limits is not None
    domain = replace(small_weights.domain, limits={**limits, "jump_min_nm": 1.0, "jump_max_nm": 10.0})
    path = tmp_path / "still.safetensors"
    save_weights(path, small_weights.model, domain, small_weights.provenance)
    verdict = compare_training(path)
    assert verdict.word == "not usable" and any("hardly a change" in reason for reason in verdict.reasons)
    assert load_weights(path).domain.limits is not None


@pytest.mark.parametrize(("percent", "stopped", "said"), [
    (99.5, "", "usable; whether"), (95.0, "", "usable with `guard"), (69.0, "", "not usable"),
    (99.5, "replica 0, in its first chunk", "not usable"),
])  # fmt: skip
def test_the_words(percent: float, stopped: str, said: str) -> None:
    word = word_of(percent, stopped)
    verdict = TrainingVerdict({"flow": 5}, {"flow": {"validation_flow": 0.25}}, 744.0, 744, percent, {}, stopped, word,
                              ("more minutes",))  # fmt: skip
    assert said in verdict.lines()[-1] and "validation error: flow 0.25" in verdict.lines()[0]
    assert (stopped in "\n".join(verdict.lines())) and ("what would help" in verdict.lines()[-1]) == (word != "usable")


def refusal(tmp_path: Path, scene: str | list[str] = "smiles:O", **options: object) -> str:
    asked = {"level": "gfn2-xtb", "steps": 5, "quiet": True, **options}
    with pytest.raises(InputError) as caught:
        api.train(scene, tmp_path / "w.safetensors", **asked)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
    return str(caught.value)


def test_what_means_nothing_for_a_potential_is_refused(tmp_path: Path) -> None:
    assert "reference of MD" in refusal(tmp_path, level="mm")
    assert "learns from trajectories" in refusal(tmp_path, arch="lam-slide")
    started = {"start_from": "paracetamol-gfn2-xtb"}
    assert "holds painet-potential, not lam-slide" in refusal(tmp_path, **started, arch="lam-slide")
    assert "`start_from` takes the configuration" in refusal(tmp_path, **started, model={"width": 8})
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


def test_rollouts_among_the_references_are_named(
    alanine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rolled = write(tmp_path, build_peptide("ACE-ALA-NME"), record=MD | {"kind": "rollout", "weights": "w.safetensors"})
    line = "1 of 2 files are rollouts of w.safetensors, no MD; what is trained on them has its errors"
    assert line in explained([alanine, rolled])[1]
    sm.windows([alanine, rolled], tmp_path / "both.windows.h5")
    assert line in capsys.readouterr().err
    sm.windows([alanine], tmp_path / "one.windows.h5")
    assert "rollouts" not in capsys.readouterr().err and not any("rollouts" in x for x in explained([alanine])[1])
