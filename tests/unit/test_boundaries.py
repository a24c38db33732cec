"""What import-linter cannot see: that training runs where no chemistry is installed, and that the verbs resolve."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import surrogate

CHEMISTRY = ["openmm", "mdtraj", "rdkit", "MDAnalysis", "pdbfixer"]

WITHOUT_CHEMISTRY = """
import sys
for name in {blocked}:
    sys.modules[name] = None  # importing it now raises ImportError
import numpy as np
from surrogate.data import TrainingFrames, load_frames
from surrogate.models.lam_slide.model import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
frames = load_frames({windows!r})
config = LamSlideConfig.from_dict({config!r})
settings = TrainingConfig(stage_one_steps=2, stage_two_steps=2, stage_two_batch=2, bf16=False)
train_lam_slide(frames, {out!r}, config, settings)
"""


def test_training_on_windows_needs_no_chemistry(tmp_path: Path, harmonic_frames, small_model_config) -> None:
    windows, out = str(tmp_path / "w.h5"), str(tmp_path / "w.safetensors")
    harmonic_frames.save(windows)
    config = small_model_config.to_dict()
    code = WITHOUT_CHEMISTRY.format(blocked=CHEMISTRY, windows=windows, out=out, config=config)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Path(out).exists()


def test_the_block_would_be_noticed() -> None:
    code = "import sys; sys.modules['openmm'] = None\nfrom systems.library.named_scenes import load\n"
    code += "load('alanine-dipeptide').to_openmm_topology()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode != 0
    assert "ModuleNotFoundError" in done.stderr or "ImportError" in done.stderr


def test_every_verb_resolves_and_is_documented() -> None:
    for name in surrogate.__all__:
        verb = getattr(surrogate, name)
        assert callable(verb)
        assert verb.__doc__, name
        assert name in dir(surrogate)


def test_an_unknown_verb_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="simulate"):
        _ = surrogate.simulate


def test_the_version_is_the_distribution_s(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    assert surrogate.__version__ == project["version"]
