"""Frames of `peptides` in which atoms overlap, and nonbonded energies of frames as they are, beside MD of a sequence.

    python docs/studies/surrogates/overlaps.py [SEQUENCE ...]

Rolled are 16 replicas of 5 ns, frames 10 ps apart, unguarded: once without limits to how near atoms come, once with
those that the model keeps (0.96 of the nearest in MD, by contact classes). Overlap is what `CLASH_NM` calls so. MD is
16 SIMD replicas of 2 ns; energies are of nonbonded and solvent terms, of every fourth frame, not relaxed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

import surrogate as sm
from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.models.peptides import layout
from systems.chemistry.validity import CLASH, check_frames, geometry_from_scene
from systems.library.named_scenes import prepare
from systems.scene import Scene

SEQUENCES = ("GLY-VAL", "LYS-GLU", "LEU-SER", "ACE-GLN-ILE-NME", "ACE-THR-PHE-NME")
REPLICAS, EVERY_PS, ENERGY_OF, SEED = 16, 10.0, 4, 1
NONBONDED = ("NonbondedForce", "GBSAOBCForce")


def main() -> None:
    for sequence in sys.argv[1:] or SEQUENCES:
        scene = prepare(f"sequence:{sequence}")
        with tempfile.TemporaryDirectory() as folder:
            made = sm.reference(scene, Path(folder) / "md.h5", time_ps="2ns", save_every_ps=EVERY_PS,
                                replicas=REPLICAS, platform="simd", seed=SEED, quiet=True)  # fmt: skip
            md = nonbonded_kj_mol(scene, frames_of(made, scene)[::ENERGY_OF])
            sys.stdout.write(f"{sequence}: MD {md.mean():.0f} ± {md.std():.0f} kJ/mol, at most {md.max():.0f}\n")
            for words, share in (("no limits", 0.0), ("its limits", layout._SHARE_OF_NEAREST)):
                layout._SHARE_OF_NEAREST, kept = share, layout._SHARE_OF_NEAREST
                began = time.process_time()
                rolled = sm.rollout(scene, "peptides", Path(folder) / "r.h5", time_ps="5ns", save_every_ps=EVERY_PS,
                                    replicas=REPLICAS, seed=SEED, guard="off", overwrite=True, quiet=True)  # fmt: skip
                spent_s = time.process_time() - began
                layout._SHARE_OF_NEAREST = kept
                x = frames_of(rolled, scene)
                overlapping = check_frames(x, geometry_from_scene(scene)) & CLASH
                energy = nonbonded_kj_mol(scene, x[::ENERGY_OF])
                sys.stdout.write(
                    f"  {words}: {100 * np.mean(overlapping != 0):.2f} % of {len(x):,} frames overlap; "
                    f"{energy.mean():.0f} ± {energy.std():.0f} kJ/mol, median {np.median(energy):.0f}, "
                    f"{100 * np.mean(energy > md.max()):.1f} % above MD's highest; {spent_s:.1f} s of a processor\n"
                )


def frames_of(files: list[Path], scene: Scene) -> npt.NDArray[np.float32]:
    return np.concatenate([np.asarray(s) for s in load_ensemble(files, template=scene).segments])


def nonbonded_kj_mol(scene: Scene, frames_nm: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the energy of nonbonded and solvent terms of frames `(n, n_atoms, 3)` nm, `(n,)`."""
    import openmm

    system = build_system(scene, resolve(scene, ForceFieldSpec()))
    for force in system.getForces():
        force.setForceGroup(int(type(force).__name__ in NONBONDED))
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    found = []
    for frame in frames_nm:
        context.setPositions(frame.astype(np.float64))
        found.append(context.getState(energy=True, groups={1}).getPotentialEnergy()._value)
    return np.array(found)


if __name__ == "__main__":
    main()
