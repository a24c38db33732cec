"""An architecture of another package, once installed: trained, rolled and described by name, within the contract."""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import run
from surrogate.models import architecture as registry
from surrogate.models.conformance import PotentialContract, PropagatorContract
from surrogate.models.propagator import Propagator
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler
from systems.errors import InputError, UnknownNameError
from systems.library.named_scenes import load
from systems.trajectory.codec import open_trajectory, open_writer

SOURCE = Path(__file__).parents[1] / "toy_architecture"


def forget() -> None:
    """Let the registry look again at what is installed."""
    registry._found.cache_clear()
    registry.architecture.cache_clear()


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The toy package, built and installed into a folder of its own, without the network, and that on the path."""
    folder = tmp_path_factory.mktemp("toy")
    shutil.copytree(SOURCE, folder / "source")
    site = folder / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
               "--disable-pip-version-check", "--target", str(site), str(folder / "source")]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        forget()
        yield
    forget()
    for name in ("random_walk", "springs"):
        sys.modules.pop(name, None)


class TestRandomWalk(PropagatorContract):
    equivariant = True
    reflects = True
    permutes = True
    noise_is_vectors = True
    # There is no network whose products bf16 is too coarse.
    bf16_error = None

    def make(self, n_atoms: int) -> Propagator:
        toy = importlib.import_module("random_walk")
        model = toy.RandomWalk(toy.WalkConfig(n_new=3))
        with torch.no_grad():
            model.log_step.copy_(torch.linspace(-5.0, -3.0, 119))
        return model.eval().requires_grad_(False)


class TestSprings(PotentialContract):
    def make(self, n_atoms: int) -> Propagator:
        toy = importlib.import_module("springs")
        return toy.Springs(toy.SpringConfig(n_bonds=n_atoms - 1, n_new=2, lag_ps=0.002, timestep_ps=0.0005,
                                            hydrogen_mass_da=None)).eval()  # fmt: skip


def test_springs_are_fitted_and_rolled_by_name(tmp_path: Path) -> None:
    scene, rng = load("alanine-dipeptide"), np.random.default_rng(0)
    reference, weights, out = (tmp_path / name for name in ("ref.h5", "w.safetensors", "roll.h5"))
    with open_writer(reference, scene, {"temperature_k": 300.0}) as writer:
        noise = rng.normal(scale=0.002, size=(400, scene.n_atoms, 3))
        writer.append(scene.positions_nm + noise, 0.05 * np.arange(1.0, 401.0))
    fitted = run("train", str(reference), "--arch", "springs", "-o", str(weights))
    assert fitted.exit_code == 0, fitted.stderr
    rolled = run("rollout", "alanine-dipeptide", "--weights", str(weights), "--time", "500fs", "--guard", "off", "-o",
                 str(out), "-q")  # fmt: skip
    assert rolled.exit_code == 0, rolled.stderr
    first, second = scene.bonds.T
    lengths = lambda x: np.linalg.norm(x[:, first] - x[:, second], axis=-1)  # noqa: E731
    with open_trajectory(out) as reader:
        x = reader.read()
    off = lengths(x) - lengths(scene.positions_nm[None])
    assert reader.n_frames == 10 and 0.001 < off.std() < 0.006, "about as wide as the reference, 0.0028 nm"
    with pytest.raises(InputError, match="bf16 is too coarse"):
        ChunkSampler(load_weights(weights), precision="bf16")


def test_it_is_trained_rolled_and_described_by_name(tmp_path: Path) -> None:
    scene, rng = load("alanine-dipeptide"), np.random.default_rng(0)
    reference, weights, out = (tmp_path / name for name in ("ref.h5", "w.safetensors", "roll.h5"))
    with open_writer(reference, scene, {"temperature_k": 300.0}) as writer:
        width_nm = np.where(np.array(scene.elements) == "H", 0.02, 0.005)[:, None]
        noise = rng.normal(size=(200, scene.n_atoms, 3))
        writer.append(scene.positions_nm + width_nm * noise, np.arange(1.0, 201.0))
    (tmp_path / "walk.toml").write_text('arch = "random-walk"\n[model]\nn_new = 5\n[training]\nbatch = 16\n')
    trained = run(
        "train", str(reference), "--config", str(tmp_path / "walk.toml"), "--steps", "200", "-o", str(weights)
    )
    assert trained.exit_code == 0, trained.stderr
    assert "arch = random-walk" in trained.stderr and "walk 200 steps" in trained.stderr
    found = json.loads(run("info", str(weights), "--json").stdout)
    assert found["arch"] == "random-walk" and found["config"]["n_new"] == 5
    rolled = run("rollout", "alanine-dipeptide", "--weights", str(weights), "--time", "8ps", "--guard", "off", "-o",
                 str(out), "-q")  # fmt: skip
    assert rolled.exit_code == 0, rolled.stderr
    with open_trajectory(out) as reader:
        steps = np.diff(reader.read(), axis=0).std(axis=(0, 2))
        assert reader.n_frames == 8 and reader.record["model"] == "random-walk"
    hydrogen = np.array(scene.elements) == "H"
    assert steps[hydrogen].mean() > 2 * steps[~hydrogen].mean(), "it learned that hydrogens shake more"
    asked = ("--arch", "random-walk", "--steps", "4", "-o", str(tmp_path / "x.safetensors"))
    for more, said in ((["--longest-lag", "5ps"], "--longest-lag"), (["--from", str(weights)], "--from")):
        refused = run("train", str(reference), *asked, *more)
        assert refused.exit_code == 1 and said in refused.stderr


def test_what_it_makes_of_a_scene_reaches_its_network() -> None:
    scene, model = load("alanine-dipeptide"), TestRandomWalk().make(22)
    molecule = model.featurise(scene).to(torch.device("cpu"))
    assert molecule.own.tolist() == np.bincount(scene.bonds.ravel()).tolist()
    noise = torch.ones(1, 22, 3, 3)
    step = model.next_chunk(torch.zeros(1, 1, 22, 3), molecule, noise).frames_nm[0, 0, :, 0]
    plain = model.next_chunk(torch.zeros(1, 1, 22, 3), replace(molecule, own=None), noise).frames_nm[0, 0, :, 0]
    torch.testing.assert_close(step / plain, torch.where(molecule.own > 1, 1.0, 1.5))


def test_it_is_listed_and_a_misspelt_name_meets_it() -> None:
    assert {"random-walk", "lam-slide", "painet"} <= set(registry.names())
    with pytest.raises(UnknownNameError, match="Did you mean 'random-walk'"):
        registry.architecture("random-wlk")


def test_a_broken_package_and_a_name_offered_twice_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("broken", "nowhere_at_all:MODEL"), ("random-walk", "elsewhere:MODEL")):
        info = tmp_path / name / f"{name.replace('-', '_')}_2-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}-2\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[surromd.architectures]\n{name} = {value}\n")
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path / "broken")
        forget()
        with pytest.raises(InputError, match=r"'broken' \(nowhere_at_all:MODEL\) cannot be loaded"):
            registry.architecture("broken")
        patch.syspath_prepend(tmp_path / "random-walk")
        forget()
        with pytest.raises(InputError, match="two installed packages offer the architecture 'random-walk'"):
            registry.names()
    forget()
