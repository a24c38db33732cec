"""One LaM-SLidE for many molecules against one for each: `python docs/studies/training/many_molecules.py FOLDER`.

References of small alkanes, alcohols and ethers are simulated (GAFF2 in vacuum, 300 K, frames 1 ps apart), one model
is trained on most of them, with `graph` on, rounded to float16, and rolled on molecules that it has seen and on ones
that it has not; one of a single molecule, trained for a seventh of the time (four times what each molecule gets of the
one for all), stands beside it. What is finished in FOLDER is not done again. Frames are held against that molecule's
own reference, which of an unseen one the model never saw. `--latents set` is the paper's code of a frame instead of one
latent for each atom. The weights shipped as alkanes-alcohols-ethers are those of `--latents atoms --budget 70min`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from alanine_dipeptide import ship

from systems.chemistry.validity import BOND_20_PERCENT, INVALID, check_frames, geometry_from_frames
from systems.scene import Scene
from systems.units import parse_wall_s

if TYPE_CHECKING:
    from surrogate.models.lam_slide.config import LamSlideConfig

FloatArray = npt.NDArray[np.float64]
TRAINED = (
    "CC", "CCC", "CCCC", "CCCCC", "CCCCCC", "CC(C)C", "CC(C)(C)C", "CCC(C)C", "CC(C)C(C)C", "CCC(C)(C)C", "CCC(C)CC",
    "CO", "CCCO", "CCCCO", "CC(C)O", "CC(C)(C)O", "CC(C)CCO", "OCCO", "OCCCO", "CCC(O)CC", "CC(C)(C)CO", "OCC(C)CO",
    "COC", "CCOC", "CCOCC", "COCCO", "COCCOC", "CC(C)OC",
)  # fmt: skip
UNSEEN = ("CCO", "CCCCCO", "CCCC(C)C", "CC(C)CO", "CCCOC", "OCCCCO")
# Of these, models of their own are trained as well.
ALONE = ("CCO",)
OWN_SHARE = 1 / 7
_BINS = 30
_REPLICAS = 4


@dataclass(frozen=True)
class Row:
    """How a rollout compares with its molecule's reference.

    `valid`, `loose`: shares of frames that pass `systems.chemistry.validity`, and of those with a bond more than 20 %
    off. `bond_pm`: root mean square error of mean bond lengths; `spread`: the standard deviation of bond lengths over
    the reference's, mean over bonds that it does not hold rigid. `torsion_jsd`: mean over all torsions that turn.
    `step`: root mean square change of interatomic distances from frame to frame, over the reference's.
    """

    molecule: str
    model: str
    frames: int
    valid: float
    loose: float
    bond_pm: float
    spread: float
    torsion_jsd: float
    step: float


def measure(scene: Scene, reference_nm: FloatArray, replicas_nm: Sequence[FloatArray], model: str) -> Row:
    """Hold replicas' frames `(n, n_atoms, 3)` nm each against the reference's."""
    from surrogate.data.features.stiff_terms import RIGID_NM
    from surrogate.judge.measure.distributions import distance
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import rotatable_torsions

    frames_nm = np.concatenate(replicas_nm)
    flags = check_frames(frames_nm, geometry_from_frames(scene, reference_nm))
    i, j = scene.bonds.T
    bonds = [np.linalg.norm(x[:, i] - x[:, j], axis=-1) for x in (reference_nm, frames_nm)]
    free = bonds[0].std(0) > RIGID_NM
    quads = rotatable_torsions(scene, rotors=True)
    edges = np.linspace(-np.pi, np.pi, _BINS + 1)
    jsd = []
    for k in range(len(quads)):
        counts = [np.histogram(torsion(x, quads[k : k + 1]), edges)[0].astype(float) for x in (reference_nm, frames_nm)]
        jsd.append(float(distance(*counts)))
    return Row(
        molecule=scene.name,
        model=model,
        frames=len(frames_nm),
        valid=float(((flags & INVALID) == 0).mean()),
        loose=float(((flags & BOND_20_PERCENT) > 0).mean()),
        bond_pm=1e3 * float(np.sqrt(np.square(bonds[1].mean(0) - bonds[0].mean(0)).mean())),
        spread=float((bonds[1].std(0)[free] / bonds[0].std(0)[free]).mean()) if free.any() else math.nan,
        torsion_jsd=float(np.mean(jsd)) if jsd else math.nan,
        step=float(np.mean([change_per_frame(x) for x in replicas_nm])) / change_per_frame(reference_nm),
    )


def change_per_frame(frames_nm: FloatArray, lag: int = 1) -> float:
    """Return the root mean square change in nm of interatomic distances over `lag` frames."""
    i, j = np.triu_indices(frames_nm.shape[1], 1)
    distances = np.linalg.norm(frames_nm[:, i] - frames_nm[:, j], axis=-1)
    return float(np.sqrt(np.square(distances[lag:] - distances[:-lag]).mean()))


def model_config(latents: str) -> LamSlideConfig:
    """Return a network that an hour of one core trains."""
    from surrogate.models.lam_slide.config import LamSlideConfig

    if latents == "atoms":
        return LamSlideConfig.of_many({})
    # A token for each frame is faster than one for each of its atoms, so that there may be more and wider layers.
    sizes = {"chunk_frames": 8, "auxiliary_frames": 2, "width": 192, "n_layers": 7}
    return LamSlideConfig.of_many({"atoms": {"latents": "set"}, "approximator": sizes})


def simulate(smiles: Sequence[str], folder: Path, time_ps: float) -> dict[str, Path]:
    """Simulate each molecule with OpenMM, if that is not done yet, and return the trajectories."""
    from surrogate import api

    found = {}
    for k, text in enumerate(smiles):
        path = folder / f"{text}.h5"
        if not path.exists():
            api.reference(f"smiles:{text}", path, time_ps=time_ps, save_every_ps=1.0, temperature_k=300.0, seed=k,
                          quiet=True)  # fmt: skip
        found[text] = path
    return found


def train(references: Sequence[Path], held: Sequence[Path], out: Path, config: LamSlideConfig, budget_s: float) -> None:
    """Train on references, one model for all; what is there stays, what was interrupted goes on."""
    from surrogate.data.molecules import collect_sets
    from surrogate.models.lam_slide.trainer import TrainingConfig, is_trained, train_lam_slide

    if is_trained(out):
        return
    sets = collect_sets(list(references), held=list(held))
    started = time.monotonic()

    def tell(stage: str, share: float, metrics: dict[str, float]) -> None:
        if metrics:
            shown = ", ".join(
                f"{key} {value:.4g}" for key, value in metrics.items() if "validation" in key or "unseen" in key
            )
            sys.stderr.write(f"{out.stem} {stage} {100 * share:.0f} % {time.monotonic() - started:.0f} s: {shown}\n")

    settings = TrainingConfig(budget_s=budget_s, stage_two_batch=32, time_reversal=True, validate_every_s=300.0)
    train_lam_slide(sets, out, config, settings, resume=True, progress=tell)


def roll(reference: Path, weights: Path, n_frames: int) -> tuple[Scene, FloatArray, list[FloatArray]]:
    """Roll a reference's molecule from its structure; return the scene, the reference's frames and each replica's."""
    from surrogate.data.weights import load_weights
    from surrogate.sampling.runner import RolloutConfig, rollout
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(reference) as reader:
        assert reader.scene is not None
        scene, truth = reader.scene, reader.read().astype(np.float64)
    config = RolloutConfig(time_ps=float(n_frames // _REPLICAS), guard="off")
    outs = [weights.with_name(f"{reference.stem}.{weights.stem}_r{k}.h5") for k in range(_REPLICAS)]
    if not all(out.exists() for out in outs):
        rollout(scene, load_weights(weights), outs, config, overwrite=True)
    frames = []
    for out in outs:
        with open_trajectory(out) as reader:
            frames.append(reader.read().astype(np.float64))
    return scene, truth, frames


def run(folder: Path, *, budget_s: float, time_ps: float, n_frames: int, latents: str) -> list[Row]:
    """Simulate, train, roll and measure."""
    folder.mkdir(parents=True, exist_ok=True)
    references = simulate([*TRAINED, *UNSEEN], folder, time_ps)
    trained = folder / f"{latents}.safetensors"
    train([references[m] for m in TRAINED], [references[m] for m in UNSEEN], trained, model_config(latents), budget_s)
    many = ship(trained, folder / f"{latents}-shipped.safetensors")
    rows = []
    for text, reference in references.items():
        seen = "seen" if text in TRAINED else "unseen"
        scene, truth, frames = roll(reference, many, n_frames)
        half = len(truth) // 2
        rows.append(replace(measure(scene, truth[:half], [truth[half:]], "reference, other half"), molecule=text))
        rows.append(replace(measure(scene, truth, frames, f"one for all, {seen}"), molecule=text))
        if text in ALONE:
            own = folder / f"{latents}-own-{text}.safetensors"
            train([reference], [], own, model_config(latents), budget_s * OWN_SHARE)
            scene, truth, frames = roll(reference, own, n_frames)
            rows.append(replace(measure(scene, truth, frames, "its own"), molecule=text))
    return rows


def table(rows: Sequence[Row]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| molecule | model | frames | valid | bond > 20 % off | bonds off, pm | bond spread | torsion JSD | step |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r.molecule} | {r.model} | {r.frames} | {100 * r.valid:.2f} % | {100 * r.loose:.2f} % "
            f"| {r.bond_pm:.2f} | {r.spread:.2f} | {r.torsion_jsd:.3f} | {r.step:.2f} |"
        )
    return "\n".join(lines)


def summary(rows: Sequence[Row]) -> str:
    """Return means over molecules as Markdown, each with its standard error, those of the references beside them."""
    groups: dict[str, list[Row]] = {}
    unseen = {r.molecule for r in rows if r.model.endswith(" unseen")}
    for r in rows:
        of = "unseen" if r.molecule in unseen else "seen"
        groups.setdefault(r.model if r.model.endswith("seen") else f"{r.model} ({of})", []).append(r)
    lines = [
        "| model | molecules | valid, % | bond > 20 % off, % | bonds off, pm | bond spread | torsion JSD | step |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, some in groups.items():
        cells = [
            _mean([scale * getattr(r, key) for r in some])
            for key, scale in (("valid", 100.0), ("loose", 100.0), ("bond_pm", 1.0), ("spread", 1.0),
                               ("torsion_jsd", 1.0), ("step", 1.0))
        ]  # fmt: skip
        lines.append(f"| {name} | {len(some)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _mean(values: Sequence[float]) -> str:
    found = np.array([v for v in values if math.isfinite(v)])
    error = f" ± {found.std(ddof=1) / math.sqrt(len(found)):.2g}" if len(found) > 1 else ""
    return f"{found.mean():.3f}{error}" if len(found) else "–"


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, run, print the table and keep it in FOLDER."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budget", default="70min", help="wall time of the training of the model for all")
    parser.add_argument("--time-ps", type=float, default=3000.0, help="of each reference")
    parser.add_argument("--frames", type=int, default=1200, help="of each molecule, in four replicas")
    parser.add_argument("--latents", choices=("atoms", "set"), default="atoms")
    a = parser.parse_args(arguments)
    budget_s = parse_wall_s(a.budget)
    rows = run(a.folder, budget_s=budget_s, time_ps=a.time_ps, n_frames=a.frames, latents=a.latents)
    record: dict[str, Any] = {"settings": {**vars(a), "folder": str(a.folder)}, "rows": [asdict(row) for row in rows]}
    (a.folder / f"{a.latents}.json").write_text(json.dumps(record, indent=1))
    text = f"{summary(rows)}\n\n{table(rows)}\n"
    (a.folder / f"{a.latents}.md").write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
