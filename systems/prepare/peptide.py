"""Peptides built from a sequence: extended, L, every peptide bond trans."""

from __future__ import annotations

from typing import Any

import numpy as np

from systems.chemistry.geometry import extend, superposition
from systems.chemistry.residues import ONE_LETTER, template_for
from systems.errors import PreparationError, nearest
from systems.prepare.records import scene_from_records
from systems.prepare.repair import fixed_random_numbers, protonation_summary, records_from_openmm, residue_shape
from systems.scene import FloatArray, Scene

_PROTONATED = {"HID": "HIS", "HIE": "HIS", "HIP": "HIS", "ASH": "ASP", "GLH": "GLU", "LYN": "LYS"}
_PHI_DEG, _PSI_DEG, _PROLINE_PHI_DEG = -140.0, 140.0, -70.0
_LONGEST = 200
# Lengths in nm and angles in degrees: Engh and Huber, Acta Cryst. A47, 392 (1991).
_N_CA, _CA_C, _C_N, _C_O = 0.1458, 0.1525, 0.1329, 0.1231
_N_CA_C, _CA_C_N, _C_N_CA, _CA_C_O = 111.2, 116.2, 121.7, 120.8


def parse_sequence(text: str) -> list[str]:
    """Return three-letter residue names of `ACE-ALA-NME`, or of one-letter code (`SDFS`). A single known three-letter
    name is one residue. Raises PreparationError for unknown residues and misplaced caps."""
    allowed = [*ONE_LETTER.values(), *_PROTONATED, "ACE", "NME"]
    written = text.strip()
    word = written.upper()
    is_named = "-" in word or word in allowed
    if not is_named and not (written.isupper() or written.islower()):
        raise PreparationError(
            f"Sequence {text!r}: write capitals, as in SDFS, or names with dashes, as in ACE-ALA-NME; a lower-case "
            "letter among them is a D-residue, which needs a PDB file or a SMILES string."
        )
    names = [n.strip() for n in word.split("-")] if is_named else [ONE_LETTER.get(c, c) for c in word]
    names = ["NME" if n == "NMA" else n for n in names]
    for k, name in enumerate(names):
        if name not in allowed:
            raise PreparationError(
                f"Sequence {text!r}: unknown residue {name!r}.{nearest(name, allowed)} "
                "Known: the twenty L-amino acids, HID HIE HIP ASH GLH LYN, and the caps ACE and NME."
            )
        if name in ("ACE", "NME") and (len(names) == 1 or k != (0 if name == "ACE" else len(names) - 1)):
            raise PreparationError(
                f"Sequence {text!r}: the cap {name} stands alone or inside; ACE goes first, NME last (ACE-ALA-NME)."
            )
    if len(names) > _LONGEST:
        raise PreparationError(
            f"Sequence of {len(names)} residues; chains are built up to {_LONGEST}, give a PDB file."
        )
    return names


def build_peptide(text: str, *, ph: float = 7.0) -> Scene:
    """Return an extended peptide, relaxed in ff14SB without charges; uncapped ends are charged. Raises PreparationError
    for an unknown residue, or one that ff14SB lacks."""
    from openmm import Platform, app, unit

    names = parse_sequence(text)
    if len(names) == 1:
        raise PreparationError(
            f"Sequence {text!r} is a single amino acid; cap it (ACE-{names[0]}-NME), or give it as smiles:…"
        )
    topology, positions_nm = _heavy_atoms(names)
    variants = [name if name in _PROTONATED else None for name in names]
    reference = Platform.getPlatformByName("Reference")
    with fixed_random_numbers():
        modeller = app.Modeller(topology, positions_nm * unit.nanometer)
        modeller.addHydrogens(pH=ph, variants=variants, platform=reference)
    relaxed_nm = _relaxed(modeller)
    keys = [("A", str(k), name) for k, name in enumerate(names, start=1)]
    records, bonds = records_from_openmm(modeller.topology, relaxed_nm, keys)
    labels = [f"{name} {number}" for _, number, name in keys]
    summary = protonation_summary(labels, keys, variants, records, ph)
    if any(letter.islower() for letter in text):
        summary.append("lower-case letters read as L-residues")
    return scene_from_records(
        records,
        bonds,
        name="-".join(names),
        provenance={"source": "sequence", "sequence": "-".join(names), "ph": ph, "repairs": summary},
    )


def _heavy_atoms(names: list[str]) -> tuple[Any, FloatArray]:
    from openmm import app

    topology = app.Topology()
    chain = topology.addChain("A")
    positions: list[FloatArray] = []
    previous: dict[str, Any] = {}
    at: dict[str, FloatArray] = {}
    psi = _PSI_DEG
    for k, name in enumerate(names):
        template = template_for(name)
        assert template is not None  # parse_sequence let it through
        residue = topology.addResidue(template.name, chain, str(k + 1))
        phi = _PROLINE_PHI_DEG if template.name == "PRO" else _PHI_DEG
        at = _place(template.name, at, phi, psi)
        if k == len(names) - 1 and template.is_amino_acid:
            at["OXT"] = extend(at["N"], at["CA"], at["C"], _C_O, _CA_C_O, psi)
        at |= {"O": extend(at["N"], at["CA"], at["C"], _C_O, _CA_C_O, psi + 180.0)} if template.is_amino_acid else {}
        atoms = {}
        for atom in (*template.heavy, *(["OXT"] if "OXT" in at else [])):
            atoms[atom] = topology.addAtom(atom, app.Element.getBySymbol(atom[0]), residue)
            positions.append(at[atom])
        for a, b in (*template.bonds, *([("C", "OXT")] if "OXT" in atoms else [])):
            topology.addBond(atoms[a], atoms[b])
        if previous:
            topology.addBond(previous["C"], atoms["N"])
        previous = atoms
    return topology, np.array(positions)


def _place(name: str, before: dict[str, FloatArray], phi: float, psi: float) -> dict[str, FloatArray]:
    """Heavy atoms of one residue, joined to the one before by a trans peptide bond."""
    if name == "ACE":
        at = {"CH3": np.zeros(3), "C": np.array([_CA_C, 0.0, 0.0])}
        plane = np.array([0.0, 1.0, 0.0])
        at["O"] = extend(plane, at["CH3"], at["C"], _C_O, _CA_C_O, 0.0)
        return at
    if not before:
        at = {"N": np.zeros(3), "CA": np.array([_N_CA, 0.0, 0.0])}
        at["C"] = extend(np.array([0.0, 1.0, 0.0]), at["N"], at["CA"], _CA_C, _N_CA_C, 180.0)
    else:
        alpha = before.get("CH3", before.get("CA"))
        assert alpha is not None
        c, o = before["C"], before["O"]
        away = extend(o, alpha, c, _C_N, _CA_C_N, 180.0)  # planar carbonyl: N opposite to O
        at = {"N": away}
        at["CA"] = extend(alpha, c, away, _N_CA, _C_N_CA, 180.0)
        if name == "NME":
            return {"N": at["N"], "C": at["CA"]}
        at["C"] = extend(c, away, at["CA"], _CA_C, _N_CA_C, phi)
    shape = residue_shape(name)
    backbone = ("N", "CA", "C")
    target = np.array([at[a] for a in backbone])
    rotation, translation = superposition(np.array([[shape[a] for a in backbone]]), target)
    side = {a: rotation[0] @ x + translation[0] for a, x in shape.items() if a not in (*backbone, "O", "OXT")}
    return at | side


def _relaxed(modeller: Any) -> FloatArray:
    """Minimise in ff14SB without charges: in vacuum these pull charged groups together and twist peptide bonds."""
    from openmm import Context, LocalEnergyMinimizer, NonbondedForce, Platform, VerletIntegrator, app, unit

    try:
        system = app.ForceField("amber14/protein.ff14SB.xml").createSystem(
            modeller.topology, nonbondedMethod=app.NoCutoff, removeCMMotion=False
        )
    except ValueError as error:  # a neutral LYS at an uncapped end, for one
        raise PreparationError(f"ff14SB lacks a residue of the sequence: {str(error).partition('.')[0]}.") from error
    for force in system.getForces():
        if isinstance(force, NonbondedForce):
            for k in range(force.getNumParticles()):
                force.setParticleParameters(k, 0.0, *force.getParticleParameters(k)[1:])
            for k in range(force.getNumExceptions()):
                i, j, _, *rest = force.getExceptionParameters(k)
                force.setExceptionParameters(k, i, j, 0.0, *rest)
    context = Context(system, VerletIntegrator(0.001), Platform.getPlatformByName("Reference"))
    context.setPositions(modeller.positions)
    LocalEnergyMinimizer.minimize(context, 10.0, 500)
    positions = context.getState(positions=True).getPositions(asNumpy=True)
    return np.array(positions.value_in_unit(unit.nanometer), dtype=np.float64)
