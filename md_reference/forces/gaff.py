"""GAFF2 parameters and AM1-BCC charges of one molecule, through AmberTools; shipped and cached ones first.

GAFF2: Wang, Wolf, Caldwell, Kollman and Case, J. Comput. Chem. 25, 1157 (2004), second generation (gaff2.dat). AM1-BCC:
Jakalian, Jack and Bayly, J. Comput. Chem. 23, 1623 (2002).
"""

from __future__ import annotations

import gzip
import json
import logging
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.forces.mixture import molecules_of, permuted
from md_reference.forces.programs import ambertools, complaint, find_ambertools, run, scratch_folder
from md_reference.forces.spec import CHAIN_FILES, force_field_of, unmatched_residues
from systems.chemistry.distance_bonds import changed_bond
from systems.chemistry.graph import match_atoms, molecule_key
from systems.errors import InputError, OutOfDomainError, PreparationError, StorageError
from systems.files.native import cache_folder
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole, sealed, storage_error, unsealed
from systems.scene import FloatArray, Scene
from systems.units import format_wall

_FORMAT = 1
METHOD = "gaff2-am1bcc"
# Parameters that come with the package.
_SHIPPED = Path(str(files("systems.library") / "data" / "parameters"))
_ATOMIC_NUMBERS = {"H": 1, "C": 6, "N": 7, "O": 8, "F": 9, "P": 15, "S": 16, "Cl": 17, "Br": 35, "I": 53}
# `expected_s` says how SQM's cost grows: hours from here on.
LARGEST = 250
_CHARGE_TOLERANCE_E = 0.01
# The angle of hydrogen cyanide in gaff2.dat; `_run_parmchk2` says what it is for.
_CANARY = "ha-c1-n1"
_PARMCHK2_RUNS = 100
# SECONDS_AT_30_ATOMS (atoms / 30)^POWER, measured by docs/studies/preparation/charge_cost.py: AmberTools 26.0,
# processor seconds on a core of an AMD EPYC, ten molecules of 21 to 72 atoms, none off by more than a factor of 2.3.
SECONDS_AT_30_ATOMS = 7.3
POWER = 3.3
_WORTH_SAYING_S = 2.0
_log = logging.getLogger("surromd.charges")


@dataclass(frozen=True)
class Entry:
    """Parameters of one molecule: prmtop text in the atom order of `scene`, and where they come from."""

    scene: Scene
    prmtop: str
    source: dict[str, Any]

    def system(self, scene: Scene, **settings: Any) -> Any:
        """Return the `openmm.System` of the molecule, particles in the scene's order; `settings`: as `createSystem` of
        `openmm.app.AmberPrmtopFile` takes them. Raises OutOfDomainError for another molecule."""
        system = load_openmm(self.prmtop).createSystem(**settings)
        return permuted(system, match_atoms(scene, self.scene))


def entry(scene: Scene, *, cached: bool = True, rough: bool = False) -> Entry:
    """Return the GAFF2 parameters and AM1-BCC charges of a molecule: shipped ones, else those cached by `molecule_key`
    and program versions, else made by AmberTools from the scene's bonds, charge and positions (`cached=False`: at once,
    and nothing is kept); `rough`: where none are shipped, with Gasteiger's charges, which need no quantum mechanics;
    nothing is kept. For hot MD whose states a better method labels.

    Stereo plays no part in GAFF2. What rounding leaves of the total charge is spread evenly. Raises PreparationError
    with the reason for what GAFF2 or AM1-BCC cannot describe, and where AmberTools is needed and absent.
    """
    refuse(scene)
    if not cached:
        return _parametrise(scene)
    tools, folder, stem = find_ambertools(), cache_folder() / "parameters", f"{molecule_key(scene)}-{METHOD}"
    # Without AmberTools what any version made, the last by name.
    kept = [folder / f"{stem}-{tools.label}.json.gz"] if tools else sorted(folder.glob(f"{stem}-*.json.gz"))[-1:]
    for path in (shipped_path(scene), *([] if rough else kept)):
        found = read_entry(path)
        if found is not None and _fits(found, scene):
            return found
    if rough:
        return _parametrise(scene, "gas")
    made = _parametrise(scene)
    with suppress(StorageError):  # a cache that cannot be written costs time, not the run
        made = store(kept[0], made)
    return made


def shipped_path(scene: Scene) -> Path:
    """Return where the parameters of a molecule lie if they come with the package."""
    return _SHIPPED / f"{molecule_key(scene)}-{METHOD}.json.gz"


def store(path: Path, made: Entry) -> Entry:
    """Write an entry and return what lies there: of several processes that compute the same, the first one's stays. The
    file appears whole or not at all. Raises StorageError when it cannot be written."""
    scene = replace(made.scene, provenance={}).to_dict()
    record = {"format": _FORMAT, "source": made.source, "scene": scene, "prmtop": made.prmtop}
    data = gzip.compress(sealed(json.dumps(record, sort_keys=True)).encode(), mtime=0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    existing = read_entry(path)
    if existing is not None and _fits(existing, made.scene):
        return existing
    create_whole(path, data)
    return made


def read_entry(path: Path) -> Entry | None:
    """Return an entry, or None where there is none or it is damaged (it is then made again)."""
    try:
        text = content(path).decode()
        record = dict(parsed(text if path.parent == _SHIPPED else unsealed(text)))
        is_known = record.pop("format") == _FORMAT
        found = built(Entry, record)
        return found if is_known and len(section(found.prmtop, "CHARGE")) == found.scene.n_atoms else None
    except (OSError, ValueError, LookupError, TypeError, InputError):
        return None


def _fits(found: Entry, scene: Scene) -> bool:
    """Return whether the entry's molecule is the scene's (keys are hashes, and some stereo is beyond them)."""
    try:
        match_atoms(scene, found.scene)
    except OutOfDomainError:
        return False
    return True


# ---- computed here --------------------------------------------------------------------------------------------------


def refuse(scene: Scene) -> None:
    """Raise PreparationError with the reason when GAFF2 with AM1-BCC cannot describe the scene."""
    foreign = sorted(set(scene.elements) - set(_ATOMIC_NUMBERS))
    if foreign:
        raise PreparationError(
            f"GAFF2 has no parameters for {', '.join(foreign)} in scene {scene.name!r} (it covers "
            f"{', '.join(_ATOMIC_NUMBERS)}); use `level='gfn2-xtb'`."
        )
    pieces = len(molecules_of(scene))
    if pieces != 1:
        raise PreparationError(f"scene {scene.name!r} holds {pieces} molecules; GAFF2 parameters are made one by one.")
    if scene.n_atoms < 2:
        raise PreparationError(f"GAFF2 has no parameters for a lone {scene.elements[0]} atom.")
    near = scene.neighbours()
    for i in (i for i, around in enumerate(near) if len(around) > 4):
        raise PreparationError(
            f"{scene.atom_names[i]} in scene {scene.name!r} has {len(near[i])} neighbours; GAFF2 has no angle terms "
            "for more than four. Use `level='gfn2-xtb'`."
        )
    charge = int(scene.formal_charges.sum())
    electrons = sum(_ATOMIC_NUMBERS[e] for e in scene.elements) - charge
    unpaired = int(scene.provenance.get("multiplicity", 1)) - 1
    if electrons % 2 or unpaired:
        n = unpaired or 1
        raise PreparationError(
            f"scene {scene.name!r} (charge {charge:+d}) has {n} unpaired electron{'s' if n > 1 else ''}; GAFF2 and "
            "AM1-BCC are made for closed shells. Check hydrogens and charges, or use `level='gfn2-xtb'`."
        )
    if scene.n_atoms > LARGEST:
        lacking: list[int] = []
        with suppress(InputError):  # residues that are not contiguous
            lacking = unmatched_residues(scene, force_field_of(CHAIN_FILES))
        names = [f"{scene.residue_names[r]} {scene.residue_ids[r]}" for r in lacking[:4]]
        culprits = f", which lacks {', '.join(names)}" if 0 < len(lacking) < len(scene.residue_names) else ""
        raise PreparationError(
            f"scene {scene.name!r} has {scene.n_atoms} atoms outside the protein force field{culprits}; AM1-BCC "
            f"charges for them take about {format_wall(expected_s(scene.n_atoms))}, and more than {LARGEST} are not "
            "computed. Give a smaller molecule, or one of standard residues."
        )


def _parametrise(scene: Scene, charges: str = "bcc") -> Entry:
    tools = ambertools()
    with scratch_folder("surromd-gaff-") as folder:
        try:
            if charges == "bcc":
                announce(scene)
            notes = _charges_and_types(scene, folder, charges)
            _missing_terms(scene, folder)
            text = _assemble(folder)
        except PreparationError as error:
            raise PreparationError(f"scene {scene.name!r} cannot be given GAFF2 parameters: {error}") from error
    _check(scene, text)
    # AmberTools rounds charges to 0.0001 e or so each; the sum must be whole for PME and for a neutral box.
    charges_e = charges_of(text)
    residual = float(charges_e.sum()) - int(scene.formal_charges.sum())
    source = {
        "force_field": f"GAFF2 {tools.gaff2_version}",
        "charges": "AM1-BCC" if charges == "bcc" else "Gasteiger",
        "program": f"AmberTools {tools.version}",
        "residual_charge_e": round(residual, 6),
        "notes": notes,
    }
    return Entry(scene, _with_charges(text, charges_e - residual / scene.n_atoms), source)


def _charges_and_types(scene: Scene, folder: Path, charges: str = "bcc") -> list[str]:
    """Run antechamber: atom types, bond types and charges into `typed.mol2`; return what was unusual."""
    (folder / "input.sdf").write_text(_sdf(scene))
    arguments = ["-i", "input.sdf", "-fi", "sdf", "-o", "typed.mol2", "-fo", "mol2", "-at", "gaff2", "-c", charges]
    arguments += ["-nc", str(int(scene.formal_charges.sum())), "-m", "1", "-rn", "MOL", "-s", "2", "-dr", "no"]
    printed = run("antechamber", arguments, folder)
    if not (folder / "typed.mol2").exists():
        raise PreparationError(f"antechamber failed: {complaint(printed)}")
    if charges == "gas" or not _rearranged(scene, folder / "sqm.pdb"):
        return []
    # AM1-BCC wants the AM1 minimum; where that is another molecule (a proton that hops), the scene's own geometry.
    keywords = "qm_theory='AM1', maxcyc=0, scfconv=1.d-10, ndiis_attempts=700,"
    run("antechamber", [*arguments, "-ek", keywords], folder)
    if _rearranged(scene, folder / "sqm.pdb"):
        raise PreparationError("its positions do not fit its bonds; minimise or repair the structure first")
    return ["AM1 charges at the scene's own geometry: the isolated molecule rearranges when AM1 minimises it"]


def _missing_terms(scene: Scene, folder: Path) -> None:
    """Run parmchk2; raise PreparationError for what it could not even guess."""
    listed = _run_parmchk2(folder)
    unknown = [line.split("ATTN")[0].strip() for line in listed.splitlines() if "ATTN" in line]
    if unknown:
        terms = "; ".join(" ".join(term.split()) for term in unknown[:3])
        raise PreparationError(
            f"GAFF2 has no parameters for {len(unknown)} of its terms ({terms}); use `level='gfn2-xtb'`"
        )


def _run_parmchk2(folder: Path) -> str:
    """Write what GAFF2's tables lack into `extra.frcmod`, and return it.

    parmchk2 of AmberTools 26 reads memory it has not set: on the same input it misses some of the tables in about every
    second run and gives other impropers (aspirin's ring 1.1 or 10.5 kcal/mol). Beside the molecule it is therefore
    shown hydrogen cyanide, whose angle the tables hold, and is run again until it finds that. Where the tables do not
    hold it, two runs must agree.
    """
    arguments = ["-i", "checked.mol2", "-f", "mol2", "-o", "extra.frcmod", "-s", "gaff2"]
    typed = (folder / "typed.mol2").read_text()
    known = ambertools().gaff2_table.read_text(errors="replace").splitlines()
    has_canary = any(line.startswith(_CANARY) for line in known)
    (folder / "checked.mol2").write_text(_with_canary(typed) if has_canary else typed)
    earlier: set[str] = set()
    for attempt in range(_PARMCHK2_RUNS):
        # The layout of the stack, on which the outcome hangs, follows the length of the environment.
        run("parmchk2", arguments, folder, SURROMD_PADDING="x" * (37 * attempt))
        listed = (folder / "extra.frcmod").read_text()
        if _CANARY not in listed if has_canary else listed in earlier:
            return listed
        earlier.add(listed)
    raise PreparationError(f"parmchk2 gave no reliable answer in {_PARMCHK2_RUNS} runs; try another AmberTools")


def _with_canary(mol2: str) -> str:
    """Return a mol2 file with a molecule of hydrogen cyanide added to its atoms and bonds."""
    lines = mol2.splitlines()
    head = lines.index("@<TRIPOS>MOLECULE") + 2
    n_atoms, n_bonds = (int(word) for word in lines[head].split()[:2])
    lines[head] = f"{n_atoms + 3} {n_bonds + 2} 1 0 0"
    end = lines.index("@<TRIPOS>ATOM") + 1 + n_atoms
    lines[end:end] = [
        f"{n_atoms + 1} C9Z 90.000 0.0 0.0 c1 1 MOL 0.0",
        f"{n_atoms + 2} N9Z 91.160 0.0 0.0 n1 1 MOL 0.0",
        f"{n_atoms + 3} H9Z 88.930 0.0 0.0 ha 1 MOL 0.0",
    ]
    end = lines.index("@<TRIPOS>BOND") + 1 + n_bonds
    lines[end:end] = [f"{n_bonds + 1} {n_atoms + 1} {n_atoms + 2} 3", f"{n_bonds + 2} {n_atoms + 1} {n_atoms + 3} 1"]
    return "\n".join([*lines, ""])


def _assemble(folder: Path) -> str:
    """Run tleap and return the prmtop text."""
    script = (
        "set default PBRadii mbondi2\nsource leaprc.gaff2\nloadamberparams extra.frcmod\n"
        "molecule = loadmol2 typed.mol2\nsaveamberparm molecule out.prmtop out.inpcrd\nquit\n"
    )
    (folder / "leap.in").write_text(script)
    printed = run("tleap", ["-f", "leap.in"], folder)
    out = folder / "out.prmtop"
    if not out.exists() or not out.stat().st_size:
        raise PreparationError(f"tleap failed: {complaint(printed)}")
    return out.read_text()


def _check(scene: Scene, prmtop: str) -> None:
    """Raise PreparationError unless the parameters are for exactly the scene's atoms, bonds and charge, in order."""
    topology = load_openmm(prmtop).topology
    bonds = {frozenset(pair) for pair in scene.bonds.tolist()}
    made = {frozenset((a.index, b.index)) for a, b in topology.bonds()}
    charge, made_charge = int(scene.formal_charges.sum()), float(charges_of(prmtop).sum())
    if tuple(a.element.symbol for a in topology.atoms()) != scene.elements:
        what = "other elements or another atom order"
    elif made != bonds:
        what = f"other bonds ({len(made - bonds)} more, {len(bonds - made)} fewer)"
    elif abs(made_charge - charge) > _CHARGE_TOLERANCE_E:
        what = f"charge {made_charge:+.3f} instead of {charge:+d}"
    elif {"DU", "du"} & set(section(prmtop, "AMBER_ATOM_TYPE")):
        what = "atoms it found no type for"
    else:
        return
    raise PreparationError(f"AmberTools made parameters with {what} for scene {scene.name!r}; check its bonds.")


def _rearranged(scene: Scene, pdb: Path) -> bool:
    """Return whether the geometry sqm ended with has lost a bond or moved a hydrogen to another atom."""
    lines = [line for line in pdb.read_text().splitlines() if line.startswith(("ATOM", "HETATM"))]
    return bool(changed_bond(scene, [[float(line[k : k + 8]) / 10.0 for k in (30, 38, 46)] for line in lines]))


def _sdf(scene: Scene) -> str:
    """The scene as a V2000 MOL block, centred, in Å; antechamber reads elements, bonds and positions from it."""
    x = (scene.positions_nm - scene.positions_nm.mean(axis=0)) * 10.0
    lines = ["molecule", "  surromd", "", f"{scene.n_atoms:3d}{len(scene.bonds):3d}  0  0  0  0  0  0  0  0999 V2000"]
    for (a, b, c), element in zip(x.tolist(), scene.elements, strict=True):
        lines.append(f"{a:10.4f}{b:10.4f}{c:10.4f} {element:<3} 0  0  0  0  0  0  0  0  0  0  0  0")
    for (i, j), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        kind = 4 if order == 1.5 else max(1, round(order))
        lines.append(f"{i + 1:3d}{j + 1:3d}{kind:3d}  0")
    charged: list[tuple[int, int]] = [(i + 1, int(q)) for i, q in enumerate(scene.formal_charges.tolist()) if q]
    for start in range(0, len(charged), 8):
        row = charged[start : start + 8]
        lines.append(f"M  CHG{len(row):3d}" + "".join(f"{i:4d}{q:4d}" for i, q in row))
    return "\n".join([*lines, "M  END", "$$$$", ""])


def expected_s(n_atoms: int) -> float:
    """Return about how many seconds AM1-BCC charges of a molecule of so many atoms take on one idle core."""
    return SECONDS_AT_30_ATOMS * (n_atoms / 30.0) ** POWER


def announce(scene: Scene) -> None:
    """Say how long a molecule's charges will take, if more than a moment: a warning of the logger 'surromd.charges', on
    stderr unless a program that uses this package decides else."""
    if (expected := expected_s(scene.n_atoms)) >= _WORTH_SAYING_S:
        about = format_wall(float(f"{expected:.1g}"))
        what = f"computing AM1-BCC charges for {scene.n_atoms} atoms (about {about} on an idle core)"
        _log.warning("%s: %s; the result is cached", scene.name, what)


# ---- AMBER parameter files (prmtop) ---------------------------------------------------------------------------------


# Amber's unit of charge: sqrt(kcal/mol Å) per elementary charge.
CHARGE_UNIT = 18.2223


def section(prmtop: str, name: str) -> list[str]:
    """Return the entries of a section of a prmtop, as words."""
    block = prmtop.partition(f"%FLAG {name} ")[2].partition("%FLAG")[0]
    return block.partition("%FORMAT")[2].partition("\n")[2].split()


def charges_of(prmtop: str) -> FloatArray:
    """Return the partial charges `(n_atoms,)` in elementary charges."""
    return np.array(section(prmtop, "CHARGE"), dtype=np.float64) / CHARGE_UNIT


def _with_charges(prmtop: str, charges_e: FloatArray) -> str:
    before, flag, after = prmtop.partition("%FLAG CHARGE ")
    end = after.index("%FLAG")
    cells = [f"{q * CHARGE_UNIT:16.8E}" for q in charges_e]
    rows = ["".join(cells[k : k + 5]) for k in range(0, len(cells), 5)]
    head = after[:end].splitlines()[:2]
    return "\n".join([before + flag + head[0], head[1], *rows, after[end:]])


def load_openmm(text: str) -> Any:
    """Return OpenMM's own reader (`openmm.app.AmberPrmtopFile`) of a prmtop given as text."""
    from openmm import app

    with tempfile.TemporaryDirectory(prefix="surromd-") as folder:
        path = Path(folder) / "molecule.prmtop"
        path.write_text(text)
        return app.AmberPrmtopFile(str(path))
