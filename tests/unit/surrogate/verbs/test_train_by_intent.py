"""What `train` chooses for its references, how it says so, and that the file of --explain gives the same training."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

import surrogate as sm
from command_line import SMALL_LAM_SLIDE, run
from surrogate.data import References
from surrogate.models.architecture import TrainingRequest, toml_text
from surrogate.models.lam_slide import trainer as choices
from surrogate.models.lam_slide.model import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.trainer import PeptideTraining
from surrogate.models.weights import load_weights
from surrogate.sampling.domain import match_domain
from systems.errors import InputError, OutOfDomainError
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
