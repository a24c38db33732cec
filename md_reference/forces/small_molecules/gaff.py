"""GAFF2 parameters and AM1-BCC charges of one molecule, through AmberTools; shipped and cached ones first.

GAFF2: Wang, Wolf, Caldwell, Kollman and Case, J. Comput. Chem. 25, 1157 (2004), second generation (gaff2.dat). AM1-BCC:
Jakalian, Jack and Bayly, J. Comput. Chem. 23, 1623 (2002).
"""

from __future__ import annotations

import gzip
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import networkx as nx

from md_reference.forces.small_molecules.prmtop import CHARGE_UNIT, Prmtop
from md_reference.forces.small_molecules.programs import (
    ambertools,
    complaint,
    find_ambertools,
    gaff2_table,
    run,
    scratch_folder,
)
from md_reference.forces.spec import CHAIN_FILES, force_field_of, unmatched_residues
from systems.chemistry.distance_bonds import changed_bond
from systems.chemistry.graph import match_atoms, molecule_key
from systems.errors import InputError, OutOfDomainError, PreparationError, StorageError
from systems.files.native import cache_folder
from systems.files.outside import content
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole, sealed, storage_error, unsealed
from systems.scene import Scene
from systems.units import format_wall

_FORMAT = 1


@dataclass(frozen=True)
class Entry:
    """Parameters of one molecule: prmtop text in the atom order of `template`, and where they come from."""

    template: Scene
    prmtop: str
    source: dict[str, Any]

    def ordered_as(self, scene: Scene) -> str:
        """Return the prmtop text in the scene's atom order. Raises OutOfDomainError for another molecule."""
        order = match_atoms(scene, self.template)
        return Prmtop(self.prmtop).permuted(order).text()


@dataclass(frozen=True)
class _Record:
    format: int
    scene: Scene
    prmtop: str
    source: dict[str, Any]


def shipped_folder() -> Path:
    """Where the parameters lie that come with the package."""
    return Path(str(files("systems.library") / "data" / "parameters"))


def find_shipped(scene: Scene, method: str) -> Entry | None:
    """Return the shipped parameters of this molecule, or None."""
    return _read(shipped_folder() / f"{molecule_key(scene)}-{method}.json.gz")


def find_cached(scene: Scene, method: str, version: str | None) -> Entry | None:
    """Return parameters computed here earlier by this version (by any, the last by name, where `version` is None)."""
    folder = cache_folder() / "parameters"
    if version is not None:
        return _read(folder / f"{molecule_key(scene)}-{method}-{version}.json.gz")
    found = sorted(folder.glob(f"{molecule_key(scene)}-{method}-*.json.gz"))
    return _read(found[-1]) if found else None


def cached_path(scene: Scene, method: str, version: str) -> Path:
    """Where `find_cached` looks."""
    return cache_folder() / "parameters" / f"{molecule_key(scene)}-{method}-{version}.json.gz"


def fits(entry: Entry | None, scene: Scene) -> bool:
    """Return whether the entry's molecule is the scene's (keys are hashes, and some stereo is beyond them)."""
    if entry is None:
        return False
    try:
        match_atoms(scene, entry.template)
    except OutOfDomainError:
        return False
    return True


def store(path: Path, entry: Entry) -> Entry:
    """Write an entry and return what lies there: of several processes that compute the same, the first one's stays.

    The file appears whole or not at all. Raises StorageError when it cannot be written.
    """
    template = replace(entry.template, provenance={})
    record = {"format": _FORMAT, "source": entry.source, "scene": template.to_dict(), "prmtop": entry.prmtop}
    data = gzip.compress(sealed(json.dumps(record, sort_keys=True)).encode(), mtime=0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    existing = _read(path)
    if existing is not None and fits(existing, entry.template):
        return existing
    create_whole(path, data)
    return entry


def _read(path: Path) -> Entry | None:
    """Return an entry, or None where there is none or it is damaged (it is then made again)."""
    try:
        text = content(path).decode()
        found = built(_Record, parsed(unsealed(text) if path.parent != shipped_folder() else text))
        if found.format != _FORMAT or Prmtop(found.prmtop).n_atoms != found.scene.n_atoms:
            return None
        return Entry(found.scene, found.prmtop, found.source)
    except (OSError, ValueError, LookupError, TypeError, InputError):
        return None


# ---- computed here --------------------------------------------------------------------------------------------------


METHOD = "gaff2-am1bcc"
ELEMENTS = ("H", "C", "N", "O", "F", "P", "S", "Cl", "Br", "I")
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
_EQUIVALENT_TIME_SAYING_S = 2.0
_log = logging.getLogger("surromd.charges")


def parameters(scene: Scene, *, cached: bool = True) -> str:
    """Return the AMBER prmtop text of a molecule, atoms in the scene's order.

    Shipped parameters are taken first, then those cached by `molecule_key` and program versions, and only then is
    AmberTools run on the scene's bonds, charge and positions (`cached=False`: at once, and nothing is kept). Stereo
    plays no part in GAFF2, and positions are left alone. What rounding leaves of the total charge is spread evenly.
    Raises PreparationError with the reason for what GAFF2 or AM1-BCC cannot describe, and where AmberTools is needed
    and absent.
    """
    return entry(scene, cached=cached).ordered_as(scene)


def entry(scene: Scene, *, cached: bool = True) -> Entry:
    """Return what `parameters` reads: the prmtop in the order in which it was made, and its source."""
    refuse(scene)
    if not cached:
        return _parametrise(scene)
    shipped = find_shipped(scene, METHOD)
    if shipped is not None and fits(shipped, scene):
        return shipped
    tools = find_ambertools()
    known = find_cached(scene, METHOD, None if tools is None else tools.label)
    if known is not None and fits(known, scene):
        return known
    made = _parametrise(scene)
    try:
        return store(cached_path(scene, METHOD, ambertools().label), made)
    except StorageError:
        return made  # a cache that cannot be written costs time, not the run


def write_shipped(scene: Scene) -> Path:
    """Write the molecule's parameters into the package (systems/library/data/parameters) and return the file.

    For the library's makers: `parameters` reads it before anything else, without AmberTools. What lies there is made
    again. Raises as `parameters`.
    """
    refuse(scene)
    found = _parametrise(scene)
    path = shipped_folder() / f"{molecule_key(scene)}-{METHOD}.json.gz"
    path.unlink(missing_ok=True)
    store(path, found)
    return path


def refuse(scene: Scene) -> None:
    """Raise PreparationError with the reason when GAFF2 with AM1-BCC cannot describe the scene."""
    foreign = sorted(set(scene.elements) - set(ELEMENTS))
    if foreign:
        raise PreparationError(
            f"GAFF2 has no parameters for {', '.join(foreign)} in scene {scene.name!r} (it covers "
            f"{', '.join(ELEMENTS)}); use `level='gfn2-xtb'`."
        )
    graph: nx.Graph = nx.Graph()
    graph.add_nodes_from(range(scene.n_atoms))
    graph.add_edges_from(scene.bonds.tolist())
    pieces = nx.number_connected_components(graph)
    if pieces != 1:
        raise PreparationError(f"scene {scene.name!r} holds {pieces} molecules; GAFF2 parameters are made one by one.")
    if scene.n_atoms < 2:
        raise PreparationError(f"GAFF2 has no parameters for a lone {scene.elements[0]} atom.")
    crowded = [i for i, n in graph.degree if n > 4]
    if crowded:
        raise PreparationError(
            f"{scene.atom_names[crowded[0]]} in scene {scene.name!r} has {graph.degree(crowded[0])} neighbours; GAFF2 "
            "has no angle terms for more than four. Use `level='gfn2-xtb'`."
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
        lacking = _without_template(scene)
        culprits = f", which lacks {', '.join(lacking[:4])}" if lacking else ""
        raise PreparationError(
            f"scene {scene.name!r} has {scene.n_atoms} atoms outside the protein force field{culprits}; AM1-BCC "
            f"charges for them take about {format_wall(expected_s(scene.n_atoms))}, and more than {LARGEST} are not "
            "computed. Give a smaller molecule, or one of standard residues."
        )


def _without_template(scene: Scene) -> list[str]:
    """Return the residues of a scene that no template of ff14SB fits, `PSU 39`; none where no residue has one."""
    try:
        found = unmatched_residues(scene, force_field_of(CHAIN_FILES))
    except InputError:  # residues that are not contiguous
        return []
    if len(found) == len(scene.residue_names):
        return []
    return [f"{scene.residue_names[r]} {scene.residue_ids[r]}" for r in found]


def rough_parameters(scene: Scene) -> str:
    """Return GAFF2 with Gasteiger's charges as AMBER prmtop text, in about a second and never kept: for states to ask
    a better reference about. Raises PreparationError as `parameters`."""
    refuse(scene)
    return _parametrise(scene, "gas").ordered_as(scene)


def _parametrise(scene: Scene, charges: str = "bcc") -> Entry:
    tools = ambertools()
    with scratch_folder("surromd-gaff-") as folder:
        try:
            if charges == "gas":
                notes = _charges_and_types(scene, folder, charges=charges)
            else:
                with announced(scene) as waiting:
                    notes = _charges_and_types(scene, folder, waiting)
            _missing_terms(scene, folder)
            text = _assemble(folder)
        except PreparationError as error:
            raise PreparationError(f"scene {scene.name!r} cannot be given GAFF2 parameters: {error}") from error
    made = Prmtop(text)
    _check(scene, made)
    # AmberTools rounds charges to 0.0001 e or so each; the sum must be whole for PME and for a neutral box.
    residual = float(made.charges_e.sum()) - int(scene.formal_charges.sum())
    made.fields["CHARGE"] = [q - residual * CHARGE_UNIT / scene.n_atoms for q in made.fields["CHARGE"]]
    source = {
        "force_field": f"GAFF2 {tools.gaff2_version}",
        "charges": "AM1-BCC" if charges == "bcc" else "Gasteiger",
        "program": f"AmberTools {tools.version}",
        "residual_charge_e": round(residual, 6),
        "notes": notes,
    }
    return Entry(scene, made.text(), source)


def _charges_and_types(
    scene: Scene, folder: Path, waiting: Callable[[float], None] | None = None, charges: str = "bcc"
) -> list[str]:
    """Run antechamber: atom types, bond types and charges into `typed.mol2`; return what was unusual."""
    (folder / "input.sdf").write_text(_sdf(scene))
    arguments = ["-i", "input.sdf", "-fi", "sdf", "-o", "typed.mol2", "-fo", "mol2", "-at", "gaff2", "-c", charges]
    arguments += ["-nc", str(int(scene.formal_charges.sum())), "-m", "1", "-rn", "MOL", "-s", "2", "-dr", "no"]
    printed = run("antechamber", arguments, folder, waiting=waiting)
    if not (folder / "typed.mol2").exists():
        raise PreparationError(f"antechamber failed: {complaint(printed)}")
    if charges == "gas" or not _rearranged(scene, folder / "sqm.pdb"):
        return []
    # AM1-BCC wants the AM1 minimum; where that is another molecule (a proton that hops), the scene's own geometry.
    keywords = "qm_theory='AM1', maxcyc=0, scfconv=1.d-10, ndiis_attempts=700,"
    run("antechamber", [*arguments, "-ek", keywords], folder, waiting=waiting)
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
    second run, says that an angle which is there needs revision, and gives other impropers (aspirin's ring 1.1 or 10.5
    kcal/mol). Beside the molecule it is therefore shown hydrogen cyanide, whose angle the tables hold, and is run again
    until it finds that. Where the tables do not hold it, two runs must agree.
    """
    arguments = ["-i", "checked.mol2", "-f", "mol2", "-o", "extra.frcmod", "-s", "gaff2"]
    typed = (folder / "typed.mol2").read_text()
    has_canary = any(line.startswith(_CANARY) for line in gaff2_table().read_text(errors="replace").splitlines())
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


def _check(scene: Scene, made: Prmtop) -> None:
    """Raise PreparationError unless the parameters are for exactly the scene's atoms, bonds and charge, in order."""
    what = ""
    numbers = [_ATOMIC_NUMBERS[e] for e in scene.elements]
    bonds = {(min(i, j), max(i, j)) for i, j in scene.bonds.tolist()}
    charge = int(scene.formal_charges.sum())
    if made.fields["ATOMIC_NUMBER"] != numbers:
        what = "other elements or another atom order"
    elif made.bonds != bonds:
        what = f"other bonds ({len(made.bonds - bonds)} more, {len(bonds - made.bonds)} fewer)"
    elif abs(float(made.charges_e.sum()) - charge) > _CHARGE_TOLERANCE_E:
        what = f"charge {float(made.charges_e.sum()):+.3f} instead of {charge:+d}"
    elif {"DU", "du"} & set(made.fields["AMBER_ATOM_TYPE"]):
        what = "atoms it found no type for"
    if what:
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


@contextmanager
def announced(scene: Scene) -> Iterator[Callable[[float], None] | None]:
    """Say before and after a molecule's charges are computed how long that takes, where it is worth saying.

    Yields what `programs.run_program` calls while it waits: on a terminal it keeps a line with the seconds so far. The
    lines are warnings of the logger 'surromd.charges': on stderr unless a program that uses this package decides else.
    """
    expected = expected_s(scene.n_atoms)
    if expected < _EQUIVALENT_TIME_SAYING_S:
        yield None
        return
    about = format_wall(float(f"{expected:.1g}"))
    _log.warning(
        "%s: AM1-BCC charges of %d atoms, about %s on an idle core, once: they are kept in the cache",
        scene.name,
        scene.n_atoms,
        about,
    )
    on_terminal = sys.stderr.isatty() and _log.isEnabledFor(logging.WARNING)
    started = time.monotonic()

    def waiting(_: float) -> None:
        sys.stderr.write(f"\r{scene.name}: {format_wall(time.monotonic() - started)} of about {about} \x1b[K")
        sys.stderr.flush()

    try:
        yield waiting if on_terminal else None
    finally:
        if on_terminal:
            sys.stderr.write("\r\x1b[K")
    _log.warning("%s: charges computed in %s", scene.name, format_wall(time.monotonic() - started))
