"""Options, markers and fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from systems.scene import Scene

# Before any numerical library is loaded: the arrays are small, and more threads only make them wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# A shell starts background jobs with Ctrl-C ignored, nohup with hang-ups, and what tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", default=False, help="also run the tests marked slow")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--run-slow"):
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="slow; runs with --run-slow"))
    on_gpu = [item for item in items if "gpu" in item.keywords]
    if on_gpu and not _has_cuda():
        for item in on_gpu:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_collection_finish() -> None:
    """Collect garbage less often: a process that has loaded every library has millions of objects to look through."""
    gc.freeze()
    gc.set_threshold(200_000, 50, 100)


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of other people's data beside the source tree; tests that need it are skipped where it is absent."""
    path = Path(os.environ.get("SURROMD_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no shared data at {path}")
    return path


@pytest.fixture(scope="session")
def alanine_dipeptide() -> Scene:
    """The library's alanine dipeptide (ACE-ALA-NME, 22 atoms)."""
    from systems.library.named_scenes import load

    return load("alanine-dipeptide")


@pytest.fixture(scope="session")
def harmonic_frames(alanine_dipeptide):
    """Synthetic training frames: correlated Gaussian motion about the library geometry, two runs of 400 frames."""
    import numpy as np

    from surrogate.data import TrainingFrames, canonicalise, quantise

    scene = alanine_dipeptide
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(800, scene.n_atoms, 3))
    for t in range(1, 800):
        noise[t] = 0.8 * noise[t - 1] + 0.6 * noise[t]
    positions = canonicalise(scene.positions_nm + 0.004 * noise, scene)
    conditions = {"force_field": "none", "solvent": "none", "temperature_k": 300.0}
    return TrainingFrames(scene, quantise(positions), np.array([0, 400, 800]), 1.0, True, conditions, ())


@pytest.fixture(scope="session")
def small_model_config():
    """A model small enough to train in a second."""
    from surrogate.models.lam_slide.model import ApproximatorConfig, AutoencoderConfig, LamSlideConfig

    return LamSlideConfig(
        autoencoder=AutoencoderConfig(latent_dim=12, width=64, head_dim=16, random_identifiers=0.0),
        approximator=ApproximatorConfig(chunk_frames=8, width=64, n_layers=2, n_heads=2, auxiliary_frames=2),
    )


@pytest.fixture(scope="session")
def small_weights_file(tmp_path_factory, harmonic_frames, small_model_config) -> Path:
    """Weights trained for a second on the synthetic frames: good for plumbing, not for chemistry."""
    from dataclasses import replace

    from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
    from surrogate.models.weights import load_weights, save_weights

    out = tmp_path_factory.mktemp("weights") / "small.safetensors"
    config = TrainingConfig(stage_one_steps=60, stage_two_steps=30, stage_one_batch=32, stage_two_batch=8, bf16=False)
    trained = load_weights(train_lam_slide(harmonic_frames, out, small_model_config, config))
    # After a second of training it hardly moves, for which guards would stop it.
    domain = replace(trained.domain, limits={**trained.domain.limits, "jump_min_nm": 1e-9})
    save_weights(out, trained.model, domain, trained.provenance)
    return out


@pytest.fixture(scope="session")
def small_weights(small_weights_file):
    """The same, read."""
    from surrogate.models.weights import load_weights

    return load_weights(small_weights_file)
