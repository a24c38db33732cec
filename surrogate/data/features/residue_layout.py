"""The layout of a peptide's residues, from its atoms' names and bonds."""

from __future__ import annotations

from surrogate.models.lam_slide.codes.residue_code import N_SLOTS, RESIDUE_TYPES, ResidueLayout
from systems.chemistry.residues import canonical_heavy_name, template_for
from systems.errors import InputError
from systems.scene import Scene

# χ turns about the middle bonds of each four (IUPAC-IUB 1970, rule 4).
_SIDE_CHAINS = {
    "ARG": "CG CD NE CZ", "ASN": "CG OD1", "ASP": "CG OD1", "CYS": "SG", "GLN": "CG CD OE1", "GLU": "CG CD OE1",
    "HIS": "CG ND1", "ILE": "CG1 CD1", "LEU": "CG CD1", "LYS": "CG CD CE NZ", "MET": "CG SD CE", "PHE": "CG CD1",
    "PRO": "CG CD", "SER": "OG", "THR": "OG1", "TRP": "CG CD1", "TYR": "CG CD1", "VAL": "CG1",
}  # fmt: skip
# What stands for the alpha carbon in a peptide bond's omega.
_ALPHA = {"ACE": "CH3", "NME": "C"}


def residue_layout(scene: Scene) -> ResidueLayout:
    """Return the layout of a scene of heavy atoms alone: chains of the twenty amino acids and the caps ACE, NME, NH2.

    Raises InputError, naming the residue, for any other residue, atoms that are missing or too many, and a terminal
    tryptophan with its second oxygen, for which fourteen places do not suffice.
    """
    found = [_named_atoms(scene, r) for r in range(len(scene.residue_names))]
    before, after = _neighbours(scene, found)
    frames, torsions = [], []
    for r, (kind, at) in enumerate(found):
        previous = found[before[r]][1] if r in before else {}
        following = found[after[r]] if r in after else None
        if kind == "ACE":
            frames.append((at["CH3"], at["C"], at["O"]))
        elif kind == "NME" and previous:
            frames.append((previous["C"], at["N"], at["C"]))
        elif kind not in _ALPHA and kind != "NH2":
            frames.append((at["N"], at["CA"], at["C"]))
            if previous:
                torsions.append((previous["C"], at["N"], at["CA"], at["C"]))
            if following is not None:
                torsions.append((at["N"], at["CA"], at["C"], following[1]["N"]))
        if following is not None and following[0] != "NH2":
            alphas = at[_ALPHA.get(kind, "CA")], following[1][_ALPHA.get(following[0], "CA")]
            torsions.append((alphas[0], at["C"], following[1]["N"], alphas[1]))
        if kind in _SIDE_CHAINS:
            path = [at[name] for name in ("N", "CA", "CB", *_SIDE_CHAINS[kind].split())]
            torsions += [(path[k], path[k + 1], path[k + 2], path[k + 3]) for k in range(len(path) - 3)]
    return ResidueLayout(
        scene.n_atoms,
        tuple(RESIDUE_TYPES.index(kind) for kind, _ in found),
        tuple(_slots(kind, at) for kind, at in found),
        tuple(frames),
        tuple(torsions),
    )


def _named_atoms(scene: Scene, r: int) -> tuple[str, dict[str, int]]:
    """Return a residue's standard name and its atoms by theirs."""
    name = f"{scene.residue_names[r]} {scene.residue_ids[r]} of {scene.name}"
    template = template_for(scene.residue_names[r])
    if template is None or template.name not in RESIDUE_TYPES:
        raise InputError(
            f'{name} is none of the twenty amino acids or caps (ACE, NME, NH2) that entities = "residue" covers; train '
            'with entities = "atom".'
        )
    at: dict[str, int] = {}
    for i in [k for k, of in enumerate(scene.residue_of_atom.tolist()) if of == r]:
        known = canonical_heavy_name(template, scene.atom_names[i])
        if known is None or known in at:
            raise InputError(f'{name}: atom {scene.atom_names[i]} has no place in it; train with entities = "atom".')
        at[known] = i
    missing = [atom for atom in template.heavy if atom not in at]
    if missing:
        raise InputError(f'{name} lacks {", ".join(missing)}; complete it, or train with entities = "atom".')
    return template.name, at


def _slots(kind: str, at: dict[str, int]) -> tuple[int, ...]:
    """The atom in each place, the template's order; a terminal oxygen takes the last."""
    template = template_for(kind)
    assert template is not None
    places = [at[name] for name in template.heavy]
    places += [-1] * (N_SLOTS - len(places))
    if "OXT" in at:
        if places[-1] != -1:
            raise InputError(
                f"a terminal {kind} has more atoms than the {N_SLOTS} places of a residue; cap it with NME, or train "
                'with entities = "atom".'
            )
        places[-1] = at["OXT"]
    return tuple(places)


def _neighbours(scene: Scene, found: list[tuple[str, dict[str, int]]]) -> tuple[dict[int, int], dict[int, int]]:
    """Return for each residue the one whose C its N is bonded to, and the other way round."""
    carbons = {at["C"]: r for r, (kind, at) in enumerate(found) if "C" in at and kind != "NME"}
    nitrogens = {at["N"]: r for r, (_, at) in enumerate(found) if "N" in at}
    before: dict[int, int] = {}
    after: dict[int, int] = {}
    for i, j in scene.bonds.tolist():
        for c, n in ((i, j), (j, i)):
            if c in carbons and n in nitrogens and carbons[c] != nitrogens[n]:
                before[nitrogens[n]], after[carbons[c]] = carbons[c], nitrogens[n]
    return before, after
