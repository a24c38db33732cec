"""What a potential learns in the same time by AdamW alone, with Muon for its matrices, and that on all cores.

    python docs/studies/quantum/optimisers.py WEIGHTS [--budget 3min] [--repeats 2]

On the samples that lie beside WEIGHTS (`surromd train ... --arch painet --level gfn2-xtb`), new weights each time, one
after the other; errors at held-out samples. By wall time: nothing else should run.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from md_reference.run.machine import machine_name
from surrogate.models.painet.energy import PotentialConfig
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.painet.potential_trainer import Learner, PotentialTraining, samples_path
from surrogate.models.weights import load_weights
from surrogate.training.loop import Stage, StageConfig, StagePlace, run_stage
from systems.units import parse_wall_s


def learned(scene: Any, samples: Path, budget_s: float, seed: int, matrix_rate: float | None) -> dict[str, float]:
    """Return the errors of new weights after so much wall time on these samples."""
    torch.manual_seed(seed)
    model, config = PainetPotential(PotentialConfig()), PotentialTraining(budget_s=budget_s, most=200)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "new.safetensors"
        shutil.copy(samples, samples_path(out))
        reference: Any = SimpleNamespace(scene=scene)  # asked nothing: there are more samples than `most`
        learner = Learner(model, reference, config, out, resume=True)
        stage = StageConfig("potential", config.batch, config.learning_rate, budget_s, matrix_rate=matrix_rate,
                            seed=seed, bf16=False, validate_every_s=1e9)  # fmt: skip
        learner.begin(budget_s)
        place = StagePlace(out.with_suffix(".state"), out.with_suffix(".csv"), torch.device("cpu"))
        run_stage(Stage(model, stage, learner.loss, dict), place)
        return {**learner.errors(), "steps": float(learner._steps)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--budget", type=lambda text: parse_wall_s(text), default=180.0)
    parser.add_argument("--repeats", type=int, default=2)
    given = parser.parse_args()
    most = torch.get_num_threads()
    scene = load_weights(given.weights).domain.scene
    sys.stdout.write(f"{machine_name()}\n")
    for seed in range(given.repeats):
        muon = PotentialTraining().matrix_rate
        for name, rate, threads in (("AdamW", None, 1), ("Muon", muon, 1), (f"Muon, up to {most} cores", muon, most)):
            torch.set_num_threads(threads)
            found = learned(scene, samples_path(given.weights), given.budget, seed, rate)
            sys.stdout.write(
                f"{name}: {found['steps']:,.0f} steps, forces {found['validation_force_mae']:.1f} kJ/mol/nm, "
                f"energies {found['validation_energy_mae']:.2f} kJ/mol\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
