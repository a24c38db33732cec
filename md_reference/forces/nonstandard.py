"""Chains with residues that ff14SB lacks: the others keep ff14SB, these get templates made from GAFF2."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from md_reference.forces.regrouping import permuted, regroup
from md_reference.forces.residue_templates import ResidueTemplate, cap, make_template
from md_reference.forces.spec import CHAIN_FILES, ForceFieldSpec, force_field_of, unmatched_residues
from systems.errors import PreparationError
from systems.scene import IntArray, Scene


@dataclass(frozen=True)
class Chain:
    """One molecule in residues (`scene`, whose atom k was atom `order[k]`), those without a template in `unknown`."""

    scene: Scene
    order: IntArray
    unknown: tuple[int, ...]

    @property
    def lacking(self) -> list[str]:
        """The residues without a template, for messages."""
        return [f"{self.scene.residue_names[r]} {self.scene.residue_ids[r]}" for r in self.unknown]


def find_chain(scene: Scene) -> Chain | None:
    """Return a molecule of which ff14SB covers some amino acids, divided into residues; None where it covers none.

    A cysteine bonded to a residue without a template is one with it.
    """
    force_field = force_field_of(CHAIN_FILES)
    uncut: set[tuple[int, int]] = set()
    while True:
        regrouped, order = regroup(scene, uncut=uncut)
        unknown = set(unmatched_residues(regrouped, force_field))
        of_atom = regrouped.residue_of_atom
        bridges = {
            (i, j)
            for i, j in regrouped.bonds.tolist()
            if regrouped.elements[i] == regrouped.elements[j] == "S"
            and of_atom[i] != of_atom[j]
            and unknown & {int(of_atom[i]), int(of_atom[j])}
        }
        if not bridges:
            break
        uncut |= {tuple(sorted((int(order[i]), int(order[j])))) for i, j in bridges}  # type: ignore[misc]
    known = set(range(len(regrouped.residue_names))) - unknown
    if not unknown or not any(_is_amino_acid(regrouped, r) for r in known):
        return None
    return Chain(regrouped, order, tuple(sorted(unknown)))


def lacking_residues(scene: Scene) -> list[str]:
    """Return the residues of a molecule for which `build_chain` makes templates, as `AIB 2`; none without a chain."""
    chain = find_chain(scene)
    return [] if chain is None else chain.lacking


def build_chain(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System`, in vacuum, of a molecule that `find_chain` finds a chain in; particles in its order.

    Raises PreparationError where GAFF2 or AM1-BCC cannot describe a residue, or a term is left without parameters.
    """
    from openmm import app, unit

    chain = find_chain(scene)
    if chain is None:
        raise PreparationError(f"scene {scene.name!r} has no amino acid that ff14SB covers.")
    templates = templates_of(chain)
    force_field = app.ForceField(*CHAIN_FILES, *(io.StringIO(t.xml) for t in templates.values()))
    topology = chain.scene.to_openmm_topology()
    residues = list(topology.residues())
    try:
        system = force_field.createSystem(
            topology,
            residueTemplates={residues[r]: t.name for r, t in templates.items()},
            nonbondedMethod=app.NoCutoff,
            constraints=app.HBonds if spec.constrain_hydrogens else None,
            rigidWater=False,
            removeCMMotion=False,
            hydrogenMass=None if spec.hydrogen_mass_da is None else spec.hydrogen_mass_da * unit.dalton,
        )
    except Exception as error:  # OpenMM raises KeyError, ValueError and bare Exception here
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise PreparationError(f"scene {scene.name!r} cannot be joined from its residues: {reason}") from error
    _refuse_loose_atoms(chain.scene, system)
    return permuted(system, chain.order)


def templates_of(chain: Chain) -> dict[int, ResidueTemplate]:
    """Return the template of each residue that has none in ff14SB, by its number in the chain."""
    return {r: make_template(cap(chain.scene, r), f"{chain.scene.residue_names[r]}-{r + 1}") for r in chain.unknown}


def _is_amino_acid(scene: Scene, residue: int) -> bool:
    """Whether a residue (of a regrouped scene) is more than a cap: nitrogen and a carbonyl on one carbon of it."""
    near, symbol = scene.neighbours(), scene.elements
    atoms = np.flatnonzero(scene.residue_of_atom == residue).tolist()
    return any(
        symbol[a] == "C"
        and any(symbol[n] == "N" for n in near[a])
        and any(symbol[c] == "C" and any(symbol[o] == "O" and len(near[o]) == 1 for o in near[c]) for c in near[a])
        and {c for c in near[a] if symbol[c] == "C"} & set(atoms)
        for a in atoms
    )


def _refuse_loose_atoms(scene: Scene, system: Any) -> None:
    """Raise PreparationError for a bond or an angle of the graph that no force acts on: OpenMM passes over such."""
    import openmm

    held: set[tuple[int, ...]] = set()
    for k in range(system.getNumConstraints()):
        i, j, _ = system.getConstraintParameters(k)
        held |= {(i, j), (j, i)}
    for force in system.getForces():
        if isinstance(force, openmm.HarmonicBondForce):
            for k in range(force.getNumBonds()):
                i, j, *_ = force.getBondParameters(k)
                held |= {(i, j), (j, i)}
        elif isinstance(force, openmm.HarmonicAngleForce):
            for k in range(force.getNumAngles()):
                i, j, m, *_ = force.getAngleParameters(k)
                held |= {(i, j, m), (m, j, i)}
    near = scene.neighbours()
    terms = [(int(i), int(j)) for i, j in scene.bonds.tolist()]
    loose: list[tuple[int, ...]] = [t for t in terms if t not in held]
    loose += [
        (i, j, m) for j in range(scene.n_atoms) for i in near[j] for m in near[j] if i < m and (i, j, m) not in held
    ]
    if loose:
        names = [
            "-".join(f"{scene.residue_names[scene.residue_of_atom[i]]} {scene.atom_names[i]}" for i in t)
            for t in loose[:3]
        ]
        raise PreparationError(
            f"scene {scene.name!r}: no parameters for {len(loose)} bonds or angles ({'; '.join(names)}); "
            "use `level='gfn2-xtb'`, or a structure without that residue."
        )
