"""Data of the molecules' forecasting task: OpenMM trajectories of the eight MD17 molecules, and MD17's own ethanol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from molecule_windows import MoleculeWindows, pair_kinds, split_windows

from systems.errors import InputError
from systems.files.outside import arrays_in
from systems.library import named_scenes
from systems.scene import ATOMIC_NUMBERS, Scene

if TYPE_CHECKING:
    from surrogate.progress import ProgressFn

MD17_MOLECULES = (
    "aspirin", "benzene", "ethanol", "malonaldehyde", "naphthalene", "salicylic-acid", "toluene", "uracil",
)  # fmt: skip
# MD17's frames are 0.5 fs apart and every tenth is used.
STRIDE = 10
_BLOCK = 4096
_REAL = "ethanol (MD17)"


def make_trajectories(
    names: Sequence[str], folder: Path, *, time_ps: float, seed: int = 0, progress: ProgressFn | None = None
) -> dict[str, Path]:
    """Simulate molecules of the library without a bath, as MD17 was made; return their files, positions and velocities.

    MD17's protocol (GAFF2 in vacuum, 0.5 fs, frames every 5 fs), equilibrated at 500 K, then at constant energy:
    at a friction of 0.1/ps the bath alone moves a carbon by 0.08 Å in the 100 fs that are to be predicted. Finished
    files stay and interrupted ones go on. Raises InputError for files of other settings.
    """
    from md_reference.forces.forcefield import resolve
    from md_reference.run.config import resolve_settings, to_config
    from md_reference.run.simulate import simulate

    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.h5" for name in names}
    for k, (name, path) in enumerate(paths.items()):
        scene = named_scenes.load(name)
        settings, _ = resolve_settings(scene, {"ensemble": "nve"}, "md17")
        config = to_config(settings | {"time_ps": time_ps}, seed=seed)
        config = replace(config, force=resolve(scene, config.force), save_velocities=True)

        simulate(scene, config, path, resume=True, progress=partial(_advance, progress, name, k, len(paths)))
    return paths


def _advance(progress: ProgressFn | None, name: str, k: int, n: int, done: int, total: int,
             note: str | None = None) -> None:  # fmt: skip
    """Tell of molecule `k` of `n`; its equilibration counts as nothing."""
    if progress is not None:
        progress(1000 * k + (0 if note else 1000 * done // total), 1000 * n, name)


def read_windows(path: Path, counts: Mapping[str, int], span: int) -> MoleculeWindows:
    """Read a trajectory made by `make_trajectories` and cut it into windows. Raises InputError when it is too short."""
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(path) as reader:
        if reader.scene is None:
            raise InputError(f"{path} carries no topology.")
        scene, lag_ps = reader.scene, float(reader.time_ps[1] - reader.time_ps[0])
        frames = np.concatenate([block.astype(np.float64) for block in reader.iter_blocks(_BLOCK)])
    chosen, every, blocks = split_windows(len(frames), span, counts, scene.name)
    return MoleculeWindows(**_structure(scene), frames_nm=frames, lag_ps=lag_ps, span=span,
                           starts=chosen, every_start=every, blocks=blocks)  # fmt: skip


def read_md17_ethanol(path: Path, span: int) -> MoleculeWindows:
    """Read MD17's own ethanol (DFT; `R` in Å, `z`; frames 0.5 fs apart): every tenth frame, from each of the ten first
    frames on, all of it for test. Raises InputError for another molecule or another order of atoms."""
    scene = named_scenes.load("ethanol")
    stored = arrays_in(path)
    numbers, frames = stored["z"], stored["R"].astype(np.float64) / 10.0
    structure = _structure(scene)
    if numbers.tolist() != structure["elements"].tolist():
        raise InputError(f"{path} holds atoms {numbers.tolist()}, ethanol is {structure['elements'].tolist()}.")
    series = [frames[first::STRIDE] for first in range(STRIDE)]
    starts = [np.arange(len(one) - span + 1) for one in series]
    if min(map(len, starts)) == 0:
        raise InputError(f"{path}: {len(frames)} frames hold no window of {span} at every tenth.")
    offsets = np.cumsum([0, *map(len, series[:-1])])
    test = {"test": np.concatenate([start + offset for start, offset in zip(starts, offsets, strict=True)])}
    # The ten series run side by side in time: they add no independent windows.
    n_blocks = min(map(len, series)) // span
    blocks = {"test": np.minimum(np.concatenate(starts) // span, n_blocks - 1)}
    return MoleculeWindows(**(structure | {"label": _REAL}), frames_nm=np.concatenate(series), lag_ps=0.005, span=span,
                           starts=test, every_start=test, blocks=blocks)  # fmt: skip


def _structure(scene: Scene) -> dict[str, Any]:
    heavy = scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)
    return {
        "name": scene.name,
        "label": scene.name,
        "elements": np.array([ATOMIC_NUMBERS[e] for e in scene.elements], dtype=np.int64),
        "kinds": pair_kinds(scene.n_atoms, scene.bonds),
        "template_nm": scene.positions_nm - scene.positions_nm[heavy].mean(axis=0),
        "fitted_idx": heavy,
    }
