"""Errors of placed hydrogens: `python docs/studies/surrogates/placed_hydrogens.py REF... --on HELD [--frames
20000]`.

Statistics are measured on REF; then the heavy atoms of HELD, frames of MD that were not used, are given hydrogens anew
and these are compared with their own. Held hydrogens (CH, CH2, NH, aromatic): how far the mean place is off, frame by
frame, which is how far the reference swings about it. Rotors: the distribution of the angle about the bond, with that
between REF and HELD beside it, and how well each remembers it. Angles at every hydrogen: mean and width. Guards: frames
of either that the reference's limits refuse.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.features.hydrogen_shapes import fit_hydrogens, plan_hydrogens
from surrogate.data.frames import TrainingFrames, collect_frames
from surrogate.judge.measure.distributions import divergence
from surrogate.models.hydrogens import HydrogenPlacer, SiteGroup
from surrogate.training.provenance import training_domain
from surrogate.verbs.outputs import find_trajectories
from systems.chemistry.limits import Limits, check_limits
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.errors import InputError
from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
# Frames whose hydrogens are placed at once, each from the last of those before: as many as a chunk has.
_CHUNK = 32
_RUNS = 16
LAGS = (1, 10, 100)
_BINS = 36


def measure_hydrogens(reference: TrainingFrames, held: TrainingFrames, *, n_frames: int, seed: int) -> dict[str, Any]:
    """Return what came of placing hydrogens on the first `n_frames` held-out frames; lengths in nm, angles in degrees.

    Raises InputError where the two are of different scenes or too few frames are there.
    """
    if held.scene.topology_hash != reference.scene.topology_hash:
        raise InputError(f"the held-out frames are of {held.scene.name}, the reference is {reference.scene.name}.")
    length = min(n_frames, held.n_frames) // _RUNS // _CHUNK * _CHUNK
    if length < max(LAGS) + _CHUNK:
        raise InputError(f"{held.n_frames} held-out frames are too few; give {_RUNS * (max(LAGS) + _CHUNK)} or more.")
    placer = HydrogenPlacer(plan_hydrogens(reference))
    fit_hydrogens(placer, reference)
    x = torch.from_numpy(held.positions_nm(np.arange(_RUNS * length))).unflatten(0, (_RUNS, length))
    placed = place_along(placer, x, seed)
    still = placer(x[:, :, placer.heavy])
    other = reference.positions_nm(np.linspace(0, reference.n_frames - 1, _RUNS * length).astype(int))
    domain = training_domain(reference)
    names = held.scene
    return {
        "scene": names.name,
        "reference_frames": reference.n_frames,
        "held_frames": _RUNS * length,
        "held_hydrogens": [_held_row(names, group, k, x, still) for group, k in _sites(placer, turns=False)],
        "rotors": [
            _rotor_row(names, group, k, x, placed, torch.from_numpy(other)[None])
            for group, k in _sites(placer, turns=True)
        ],
        "angles": angle_rows(names, placer, x, placed),
        "refused": {
            kind: _refused(frames, Geometry.from_dict(domain.geometry), Limits.from_dict(domain.limits or {}))
            for kind, frames in (("md", x), ("placed", placed))
        },
    }


def place_along(placer: HydrogenPlacer, x: Tensor, seed: int) -> Tensor:
    """Return frames `(runs, length, n_atoms, 3)` nm with hydrogens placed anew, chunk after chunk, rotors going on from
    the chunk before: of MD's own hydrogens those of the first frame alone are used."""
    generator = torch.Generator().manual_seed(seed)
    parts, last = [], x[:, 0]
    for start in range(0, x.shape[1], _CHUNK):
        heavy = x[:, start : start + _CHUNK, placer.heavy]
        parts.append(placer(heavy, last, torch.randn(*heavy.shape[:2], placer.n_noise, generator=generator)))
        last = parts[-1][:, -1]
    return torch.cat(parts, dim=1)


def angle_rows(scene: Scene, placer: HydrogenPlacer, x: Tensor, placed: Tensor) -> list[dict[str, Any]]:
    """Return mean and width of each angle with a hydrogen, in `x` and in `placed`, degrees."""
    hydrogen = {h for site in placer.plan.sites for h in site.hydrogens}
    rows = []
    for site in placer.plan.sites:
        near = [j for bond in scene.bonds.tolist() for j in bond if site.parent in bond and j != site.parent]
        for a in range(len(near)):
            for b in range(a):
                ends = near[b], near[a]
                if hydrogen.isdisjoint(ends):
                    continue
                found = [_angles(frames, ends[0], site.parent, ends[1]) for frames in (x, placed)]
                rows.append({
                    "atoms": "-".join(scene.atom_names[i] for i in (ends[0], site.parent, ends[1])),
                    "md": [float(found[0].mean()), float(found[0].std())],
                    "placed": [float(found[1].mean()), float(found[1].std())],
                })  # fmt: skip
    return rows


def lines(found: dict[str, Any]) -> list[str]:
    """Return the account for people."""
    out = [
        f"{found['scene']}: hydrogens of {found['held_frames']} held-out frames, statistics of "
        f"{found['reference_frames']}",
        "hydrogens that their neighbours hold: RMSD of the mean place, Å; bond, Å (MD, placed)",
    ]
    for row in found["held_hydrogens"]:
        out.append(f"  {row['atoms']:<24} {10 * row['rmsd_nm']:.3f}   {10 * row['bond_nm'][0]:.4f} "
                   f"{10 * row['bond_nm'][1]:.4f}")  # fmt: skip
    out.append("rotors: JSD of the angle in nats, placed and (reference against held-out); memory at lags of "
               f"{', '.join(map(str, LAGS))} frames, MD / placed")  # fmt: skip
    for row in found["rotors"]:
        memory = "  ".join(f"{a:.3f} / {b:.3f}" for a, b in zip(row["memory_md"], row["memory_placed"], strict=True))
        out.append(f"  {row['atoms']:<24} {row['jsd']:.5f} ({row['jsd_reference']:.5f})   {memory}")
    worst = max(found["angles"], key=lambda row: abs(row["placed"][0] - row["md"][0]))
    ratios = [row["placed"][1] / row["md"][1] for row in found["angles"]]
    out.append(
        f"{len(ratios)} angles with a hydrogen: means at most {abs(worst['placed'][0] - worst['md'][0]):.2f}° off "
        f"({worst['atoms']}), widths {min(ratios):.3f} to {max(ratios):.3f} of MD's"
    )
    out.append("frames that guards refuse: " + ", ".join(f"{k} {v:.5f}" for k, v in found["refused"].items()))
    return out


def _held_row(scene: Scene, group: SiteGroup, k: int, x: Tensor, still: Tensor) -> dict[str, Any]:
    atoms = group.hydrogens[k]
    off = (still[..., atoms, :] - x[..., atoms, :]).square().sum(-1).mean().sqrt()
    bonds = [float(group.bonds(frames)[..., k, :, :].norm(dim=-1).mean()) for frames in (x, still)]
    return {"atoms": _label(scene, group, k), "rmsd_nm": float(off), "bond_nm": bonds}


def _rotor_row(scene: Scene, group: SiteGroup, k: int, x: Tensor, placed: Tensor, other: Tensor) -> dict[str, Any]:
    md, ours, reference = (group.phase(frames, group.hand(frames))[..., k] for frames in (x, placed, other))
    counts = [_histogram(angle) for angle in (md, ours, reference)]
    return {
        "atoms": _label(scene, group, k),
        "jsd": float(divergence(counts[0], counts[1])),
        "jsd_reference": float(divergence(counts[0], counts[2])),
        "memory_md": _memory(md),
        "memory_placed": _memory(ours),
    }


def _histogram(angle: Tensor) -> FloatArray:
    return np.histogram(angle.numpy(), bins=_BINS, range=(-np.pi, np.pi))[0].astype(np.float64)


def _memory(angle: Tensor) -> list[float]:
    return [float((angle[:, lag:] - angle[:, :-lag]).cos().mean()) for lag in LAGS]


def _angles(x: Tensor, a: int, b: int, c: int) -> FloatArray:
    first, second = x[..., a, :] - x[..., b, :], x[..., c, :] - x[..., b, :]
    cosine = (first * second).sum(-1) / (first.norm(dim=-1) * second.norm(dim=-1))
    return np.degrees(np.arccos(cosine.double().clamp(-1.0, 1.0).numpy()))


def _refused(x: Tensor, geometry: Geometry, limits: Limits) -> float:
    flags = [
        (check_frames(run, geometry) | check_limits(run, limits, np.concatenate([run[:1], run[:-1]]))) & INVALID
        for run in x.numpy()
    ]
    return float((np.stack(flags) != 0).mean())


def _sites(placer: HydrogenPlacer, *, turns: bool) -> list[tuple[SiteGroup, int]]:
    groups = [group for group in placer.groups if isinstance(group, SiteGroup) and group.turns == turns]
    return [(group, k) for group in groups for k in range(len(group.parent))]


def _label(scene: Scene, group: SiteGroup, k: int) -> str:
    parent = int(group.parent[k])
    residue = int(scene.residue_of_atom[parent])
    names = " ".join(scene.atom_names[h] for h in group.hydrogens[k].tolist())
    return f"{scene.residue_names[residue]} {scene.residue_ids[residue]} {scene.atom_names[parent]}-{names}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("references", nargs="+")
    parser.add_argument("--on", nargs="+", required=True, help="held-out trajectories")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    reference = collect_frames(find_trajectories(args.references))
    held = collect_frames(find_trajectories(args.on))
    found = measure_hydrogens(reference, held, n_frames=args.frames, seed=args.seed)
    sys.stdout.write("\n".join(lines(found)) + "\n")
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
