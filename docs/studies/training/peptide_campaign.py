"""Peptides by SIMD replicas, in TIP3P water or in OBC2: what models learn from and are tested on.

    python docs/studies/training/peptide_campaign.py FOLDER --budget 3h [--workers 1] [--solvent obc2]
          [--molecules NAME ...]
    python docs/studies/training/peptide_campaign.py FOLDER --list [--solvent obc2]
    python docs/studies/training/peptide_campaign.py FOLDER --budget 3h --umbrella [--workers 1] [--solvent obc2]

ff14SB, 300 K, 4 fs. Each batch is sixteen runs `FOLDER/{test,train,fine}/NAME/run_000.h5`, ... that begin in other
states: sixteen replicas in OBC2, 100 ps at 500 K and 100 ps at 300 K. In water (NVT at the volume of 1 bar, PME, frames
1 ps apart without water) the replicas are turned to the torsions of these; in OBC2 (the wide campaign, frames 5 ps
apart) they go on from them, those of `fine` 300 ps long and frames 1 ps apart. The first 25 ps in water and 50 ps in
OBC2 are left out. In OBC2 half of the tests come first and the other half last; in water the residues that the first
tests are made of, these tests, the other monomers, two pairs with free ends and eight without, the capped tests again,
the rest of pairs with every residue once at either place, further tests, pairs and chains, then more runs of all. What
is there is left alone and what was stopped goes on.

`--umbrella`: under an umbrella potential of psi and side chains, from frames with phi < 0: `FOLDER/umbrella/NAME`. For
water MD in OBC2 of 1.2 ns a replica tells it, for OBC2 frames drawn by the shipped weights. Such MD is for populations
of torsion states, not for rates. In water these are capped pairs, those of tests in `umbrella_test`, but for what
`peptide_populations` holds; in OBC2 what the wide campaign comes to last, which weights trained on its first molecules
never saw, but for what `peptide_states` holds.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import peptide_states
from peptide_equilibrium import Equilibrium
from peptide_list import (
    FIRST_TESTS,
    RESIDUES,
    Peptide,
    held_out_peptides,
    training_peptides,
    unseen_peptides,
    wide_peptides,
)
from peptide_populations import recorded
from processes import arguments_of, in_order, only_here, parts_of, run_path, simulate_runs

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.forces.umbrella import Umbrella, umbrella_torsions
from md_reference.run.config import SIMD, Conditions, MDConfig
from md_reference.run.engine import Engine
from md_reference.simd.force_field import SimdReplicas, n_replicas
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.chains import POSITIVE_PHI_DEG
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import load_weights
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions, rotatable_torsions
from systems.prepare.peptide import build_peptide
from systems.scene import FloatArray, IntArray, Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K

WATER, IMPLICIT = ForceFieldSpec("ff14SB", "tip3p"), ForceFieldSpec("ff14SB", "obc2")
# In water. Pairs and chains are trained on in no solvent; monomers are tested on runs of their own.
TEST, FURTHER_TEST = (
    tuple(Peptide(residues, capped, 16, 1000.0) for residues, capped in some)
    for some in (
        ((("LEU", "SER"), True), (("VAL", "ASN"), True), (("MET", "SER"), False)),
        ((("LYS", "GLU"), True), (("SER", "LEU", "ALA"), True), (("PHE", "GLY"), True), (("ALA",), True),
         (("PHE",), True), (("ALA", "SER", "VAL", "LEU"), True), (("ILE", "GLN", "ALA", "PHE"), False)),
    )
)  # fmt: skip
TRAINING_PS, ROUNDS, FIRST_FREE, FIRST_PAIRS = 200.0, 12, 2, 10
DISCARDED_PS = {"tip3p": 25.0, "obc2": 50.0}
SAVED_PS = {"tip3p": 1.0, "obc2": 5.0}
FINE_PS, FINE_SAVED_PS = 300.0, 1.0
HOT_K, HOT_PS, COOL_PS = 500.0, 100.0, 100.0
TURNED_PS, STIFFNESS_KJ_MOL = 20.0, 300.0
# For an umbrella potential: the MD in OBC2 that tells it, its first part left out where starts are drawn, and the runs
# in water.
RESOLVED_PS, RESOLVED_EVERY_PS, RELAXED = 1200.0, 0.4, 0.2
UMBRELLA_PS, UMBRELLA_TEST_PS = 200.0, 500.0
# In OBC2: the frames drawn that tell it, and how long their bonds take to settle; the share of MD's frames that is to
# count in effect, for which more of the free energies is left, in steps in kT.
DRAWN, SETTLED_PS = 4000, 2.0
COUNTING, LIGHTER_KT = 0.2, 0.5
# Of what the wide campaign has after so many molecules. Chains come first: weights that learned 85 molecules,
# all pairs, came nearer to pairs and farther from chains.
WIDE_FIRST, UMBRELLA_WIDE_PS, UMBRELLA_SAVED_PS = 184, 800.0, 2.0


def dynamics(system: Any, temperature_k: float, seed: int, **how: Any) -> SimdReplicas:
    settings = {"friction_per_ps": 5.0, "timestep_ps": 0.002, **how}
    return SimdReplicas(system, temperature_k=temperature_k, seed=seed, **settings)


def minimised(scene: Scene, spec: ForceFieldSpec, system: Any) -> FloatArray:
    platform = "Reference" if scene.cell_nm is None else "CPU"
    with Engine(scene, Conditions(force=spec, platform=platform), system=system, threads=1) as engine:
        engine.minimise()
        return engine.positions()


def many_states(dry: Scene, seed: int) -> FloatArray:
    """Return positions `(n_replicas, n_atoms, 3)` of replicas in OBC2 that were hot and have cooled down."""
    system = build_system(dry, IMPLICIT)
    start = minimised(dry, IMPLICIT, system)
    hot = dynamics(system, HOT_K, seed)
    hot.set_positions(np.repeat(start[None], hot.n_replicas, axis=0))
    hot.thermalise()
    hot.step(round(HOT_PS / hot.timestep_ps))
    cool = dynamics(system, 300.0, seed + 1)
    cool.set_positions(hot.positions_nm)
    cool.thermalise()
    cool.step(round(COOL_PS / cool.timestep_ps))
    return cool.positions_nm


def umbrella_of(dry: Scene, seed: int) -> tuple[Umbrella, FloatArray]:
    """Return the umbrella potential of psi and side chains that MD in OBC2 tells, and positions
    `(n_replicas, n_atoms, 3)` with every phi negative."""
    run = dynamics(build_system(dry, IMPLICIT), 300.0, seed + 2, friction_per_ps=1.0, timestep_ps=0.004)
    run.set_positions(many_states(dry, seed))
    run.thermalise()
    quads, left_kt = umbrella_torsions(dry)
    angles, starts = [], []
    for k in range(n := round(RESOLVED_PS / RESOLVED_EVERY_PS)):
        run.step(round(RESOLVED_EVERY_PS / run.timestep_ps))
        angles.append(torsion(run.positions_nm, quads))
        if k >= RELAXED * n:
            starts.append(with_negative_phi(dry, run.positions_nm))
    return Umbrella.of(quads, np.concatenate(angles), left_kt, 300.0), some_of(np.concatenate(starts), seed)


def drawn_umbrella_of(dry: Scene, sequence: str, seed: int) -> tuple[Umbrella, FloatArray]:
    """Return the same, told by frames that the shipped weights draw at endless times."""
    frames = Equilibrium.of(cast(PeptideSlide, load_weights(weights_path("peptides")).model), sequence, seed)
    x, shares = frames.frames_nm.numpy().astype(np.float64), frames.weights.numpy().astype(np.float64)
    rows = np.random.default_rng(seed).choice(len(x), DRAWN, p=shares / shares.sum())
    quads, left_kt = umbrella_torsions(dry)
    run = dynamics(build_system(dry, IMPLICIT), 300.0, seed + 2, timestep_ps=0.0005)
    run.set_positions(some_of(with_negative_phi(dry, x), seed))
    run.thermalise()
    run.step(round(SETTLED_PS / run.timestep_ps))
    return light_umbrella(quads, np.asarray(torsion(x[rows], quads)), left_kt), run.positions_nm


def with_negative_phi(dry: Scene, x: FloatArray) -> FloatArray:
    """Return those of frames `(n, n_atoms, 3)` in which every phi is negative."""
    phi = np.rad2deg(torsion(x, backbone_torsions(dry)["phi"]))
    return x[~((phi > POSITIVE_PHI_DEG[0]) & (phi < POSITIVE_PHI_DEG[1])).any(axis=1)]


def some_of(frames: FloatArray, seed: int) -> FloatArray:
    """Return as many as there are replicas."""
    n = n_replicas()
    return frames[np.random.default_rng(seed).choice(len(frames), n, replace=len(frames) < n)]


def light_umbrella(quads: IntArray, angles: FloatArray, left_kt: list[float]) -> Umbrella:
    """Return the umbrella potential of `quads` (k, 4) that leaves `left_kt` (k,) or as much more as COUNTING asks for,
    by a sample `angles` (n, k) without it. Under U a share 1 / (<exp(U / kT)> <exp(-U / kT)>) counts."""
    kt = GAS_CONSTANT_KJ_MOL_K * 300.0
    while True:
        umbrella = Umbrella.of(quads, angles, left_kt, 300.0)
        u = umbrella.energies_of(angles) / kt
        if np.exp(u).mean() * np.exp(-u).mean() * COUNTING <= 1.0:
            return umbrella
        left_kt = [left + LIGHTER_KT for left in left_kt]


def starts_in_water(wet: Scene, quads: IntArray, angles: FloatArray, seed: int) -> FloatArray:
    """Return positions `(n_replicas, n_atoms, 3)` in which the solute of each replica was turned to its torsions."""
    system = build_system(wet, WATER)
    run = dynamics(system, 300.0, seed, biased=quads.tolist(), timestep_ps=0.004)
    run.set_positions(np.repeat(minimised(wet, WATER, system)[None], run.n_replicas, axis=0))
    run.thermalise()
    run.step(round(5.0 / run.timestep_ps))
    for share in (0.1, 0.3, 1.0):
        for place in range(len(quads)):
            run.set_bias(place, angles[:, place], share * STIFFNESS_KJ_MOL)
        run.step(round(TURNED_PS / 3 / run.timestep_ps))
    return run.positions_nm


def batch(
    folder: Path, peptide: Peptide, number: int, solvent: str, every_ps: float, *, with_umbrella: bool = False
) -> None:
    """Simulate the batch of this number, from wherever it stands. Raises SimulationError, KeyboardInterrupt."""
    numbers = range(number * n_replicas(), (number + 1) * n_replicas())
    if all(run_path(folder, k).exists() for k in numbers):
        return
    with only_here(folder) as free:
        if not free:
            return
        dry = build_peptide(peptide.sequence)
        in_water = solvent == WATER.solvent
        scene = solvate(dry, WATER, WaterBox()) if in_water else dry
        seed = zlib.crc32(f"{'water' if in_water else solvent}:{peptide.name}:{number}".encode()) % (2**31 - 2)
        umbrella, starts = None, None
        if with_umbrella:
            umbrella, starts = umbrella_of(dry, seed) if in_water else drawn_umbrella_of(dry, peptide.sequence, seed)
        if any(part.exists() for part in parts_of(folder, numbers)):
            starts = None
        else:
            starts = many_states(dry, seed) if starts is None else starts
            if in_water:
                quads = rotatable_torsions(dry)
                starts = starts_in_water(scene, quads, np.asarray(torsion(starts, quads), dtype=np.float64), seed)
        config = MDConfig(
            force=WATER if in_water else IMPLICIT, time_ps=peptide.time_ps, equilibrate_ps=DISCARDED_PS[solvent],
            seed=seed, platform=SIMD, keep="solute" if in_water else "all", save_every_ps=every_ps, umbrella=umbrella,
        )  # fmt: skip
        simulate_runs(scene, config, folder, numbers, starts_nm=starts)


def order(solvent: str) -> list[tuple[str, Peptide, int]]:
    """Return every batch: where its files go, the molecule and the number."""
    if solvent == IMPLICIT.solvent:
        in_water, known = {p.name for p in TEST}, {p.name for p in unseen_peptides()}
        tests = (*unseen_peptides(), *(p for p in held_out_peptides() if p.name in in_water - known))
        train = wide_peptides()
        tested = {p.residues for p in tests if len(p.residues) > 1}
        round_one = training_peptides()[: 2 * len(RESIDUES)]
        fine = [replace(p, time_ps=FINE_PS) for p in round_one if p.residues not in tested]
        kinds = (("test", tests[:FIRST_TESTS]), ("train", train[: len(RESIDUES)]), ("fine", fine),
                 ("train", train[len(RESIDUES) :]), ("test", tests[FIRST_TESTS:]))  # fmt: skip
        return [(kind, p, 0) for kind, some in kinds for p in some]
    tests = {p.residues for p in (*unseen_peptides(), *TEST, *FURTHER_TEST) if len(p.residues) > 1}
    training = [replace(p, time_ps=TRAINING_PS) for p in training_peptides() if p.residues not in tests]
    monomers, others = training[: len(RESIDUES)], training[len(RESIDUES) :]
    tested = {residue for peptide in TEST for residue in peptide.residues}
    # What the first tests are made of comes before them, so that a model of theirs can be trained at once.
    monomers.sort(key=lambda peptide: peptide.residues[0] not in tested)
    n, m = len(tested), len(RESIDUES)
    again = [peptide for peptide in TEST if peptide.capped]
    free = [peptide for peptide in others if not peptide.capped]
    others = [*free[:FIRST_FREE], *(peptide for peptide in others if peptide not in free[:FIRST_FREE])]
    parts = (("train", monomers[:n], 0), ("test", TEST, 0), ("train", (*monomers[n:], *others[:FIRST_PAIRS]), 0),
             ("test", again, 1), ("train", others[FIRST_PAIRS:m], 0), ("test", FURTHER_TEST, 0),
             ("train", others[m:], 0))  # fmt: skip
    return [
        *((kind, peptide, number) for kind, some, number in parts for peptide in some),
        *(("train", peptide, number) for number in range(1, ROUNDS) for peptide in training),
    ]


def umbrella_order(solvent: str) -> list[tuple[str, Peptide, int]]:
    """Return the same of batches under an umbrella potential: in OBC2 the last of the wide campaign; in water the tests
    that are pairs, then pairs with every residue once at either place, those of the tests' residues first, then the
    rest; and again."""
    if solvent == IMPLICIT.solvent:
        last = sorted(wide_peptides()[WIDE_FIRST:], key=lambda p: len(p.residues) == 2)
        states = {md.name for md in peptide_states.read()}
        return [("umbrella", replace(p, time_ps=UMBRELLA_WIDE_PS), 0) for p in last if p.name not in states]
    tests = [replace(p, time_ps=UMBRELLA_TEST_PS) for p in TEST if p.capped]
    named = {residue for p in tests for residue in p.residues}
    pairs = [p for kind, p, number in order(WATER.solvent) if (kind, number) == ("train", 0) and p.capped]
    pairs = [replace(p, time_ps=UMBRELLA_PS) for p in pairs if len(p.residues) == 2]
    pairs[: len(RESIDUES)] = sorted(pairs[: len(RESIDUES)], key=lambda p: not named & set(p.residues))
    kinds = (("umbrella_test", tests), ("umbrella", pairs))
    known = recorded()
    return [(kind, p, number) for number in range(ROUNDS) for kind, some in kinds for p in some
            if (p.name, number) not in known]  # fmt: skip


def batches(solvent: str, with_umbrella: bool, names: Sequence[str]) -> list[tuple[str, Peptide, int]]:
    """Return the batches of molecules of these names, of all without any."""
    found = (umbrella_order if with_umbrella else order)(solvent)
    if unknown := sorted({*names} - {p.name for _, p, _ in found}):
        raise SystemExit(f"The campaign holds no {', '.join(unknown)}; names are like LEU-SER and free-MET-SER.")
    return [task for task in found if not names or task[1].name in names]


def make(task: tuple[str, Peptide, int], deadline: float, folder: str, solvent: str) -> None:
    kind, peptide, number = task
    with_umbrella = kind.startswith("umbrella")
    every_ps = FINE_SAVED_PS if kind == "fine" else SAVED_PS[solvent]
    if with_umbrella and solvent == IMPLICIT.solvent:
        every_ps = UMBRELLA_SAVED_PS
    batch(Path(folder) / kind / peptide.name, peptide, number, solvent, every_ps, with_umbrella=with_umbrella)


SWITCHES = {
    "--list": "print what is there and simulate nothing",
    "--umbrella": "MD under an umbrella potential",
}


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = arguments_of(__doc__, SWITCHES, arguments, solvents=SAVED_PS)
    tasks = partial(batches, chosen.solvent, chosen.umbrella, chosen.molecules)
    # Names that it does not hold are refused before any process begins.
    found = tasks()
    if chosen.list:
        for kind, peptide, number in found:
            done = len(list((chosen.folder / kind / peptide.name).glob("run_*.h5"))) - number * n_replicas()
            if done > 0:
                sys.stdout.write(f"{kind} {peptide.name} {min(done, n_replicas())} x {peptide.time_ps:g} ps\n")
        return
    in_order(tasks, make, chosen.budget_s, chosen.workers, str(chosen.folder), chosen.solvent)


if __name__ == "__main__":
    main()
