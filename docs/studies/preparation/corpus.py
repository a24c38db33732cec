"""What surromd makes of the structure files that others wrote: a table by kind, before and now, and each exception.

    python docs/studies/preparation/corpus.py [--data FOLDER] [--kind rcsb_pdb ...] [--charges] [--json OUT]

FOLDER (../shared/data/structures unless told) holds the files and `corpus.tsv`, which says of each what PDBFixer,
OpenMM's Modeller, RDKit and Open Babel make of it (`peer`) and what surromd made of it at 8e005fd. A row is taken as is
when `prepare` needs no switch and forces can be built for the scene. AM1-BCC charges are not computed: a scene that
comes as far as starting a program for them counts, and is marked so; with `--charges` they are computed.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(REPOSITORY))
COLUMN_BEFORE = "surromd_8e005fd"
TARGET = 0.97
# Above this, kJ/mol an atom before any minimisation, atoms stand in each other: X-ray structures with hydrogens just
# added reach some hundreds, one pair of oxygens at 1.2 Å in a small peptide two thousand.
GARBAGE_KJ_MOL_AN_ATOM = 10_000.0
_TELLS_LOSS = re.compile("left out|models|taken|replaced|standard|made methionine")
_TELLS_NEW = re.compile("added|placed|replaced|standard|made methionine|cap|taken from names")


# Element and position in Å.
Atom = tuple[str, float, float, float]


class _WouldComputeCharges(Exception):
    """Somebody started a program."""


@dataclass(frozen=True)
class Row:
    """One row of `corpus.tsv`: what to prepare, and what others and surromd made of it."""

    name: str
    spec: str
    kind: str
    peer: str
    before: str

    @property
    def is_ok_for_a_peer(self) -> bool:
        """Whether PDBFixer or OpenMM, or RDKit or Open Babel, make a whole molecule of it."""
        return self.peer.startswith(("ok:", "rdkit"))

    @property
    def is_garbage_for_peers(self) -> bool:
        return self.peer.startswith("garbage")

    @property
    def was_as_is(self) -> bool:
        return self.before.startswith("ok;") and "plan refused" not in self.before and "hangs" not in self.before


@dataclass(frozen=True)
class Outcome:
    """What surromd makes of a row now. `state`: 'ok', 'charges' (ok as far as AM1-BCC), 'prepared' (no forces) or
    'refused'; `faults` are alterations that no note tells, and energies of atoms in each other."""

    state: str
    message: str
    notes: tuple[str, ...] = ()
    n_atoms: int = 0
    charge: int = 0
    energy_kj_mol: float | None = None
    faults: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def is_as_is(self) -> bool:
        return self.state in ("ok", "charges")


def read_rows(folder: Path) -> list[Row]:
    """Return the rows of `corpus.tsv` whose file is there."""
    smiles = {}
    if (folder / "smiles.tsv").exists():
        smiles = dict(line.split("\t")[:2] for line in (folder / "smiles.tsv").read_text().splitlines() if line)
    rows = []
    with open(folder / "corpus.tsv", newline="") as handle:
        for record in csv.DictReader(handle, delimiter="\t"):
            name = record["path"].split("/", 1)[-1]
            if "#" in name:
                spec = f"smiles:{smiles[name.split('#', 1)[1]]}"
            else:
                spec = str(folder / name)
            rows.append(Row(name, spec, record["kind"], record["peer"], record.get(COLUMN_BEFORE) or ""))
    return [row for row in rows if row.spec.startswith("smiles:") or Path(row.spec).exists()]


def try_row(row: Row, *, charges: bool = False, limit_s: int = 300) -> Outcome:
    """Prepare a row and build its forces. Anything but a typed refusal is a fault, with its traceback's last line."""
    began = time.perf_counter()

    def too_long(*_: object) -> None:
        raise TimeoutError(f"took more than {limit_s} s")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(limit_s)
    try:
        outcome = _try(row, charges)
    except Exception as error:
        text = str(error).splitlines()[0] if str(error) else ""
        outcome = Outcome("refused", f"{type(error).__name__}: {text}", faults=(f"raised {type(error).__name__}",))
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return Outcome(**{**asdict(outcome), "seconds": round(time.perf_counter() - began, 2)})


def _try(row: Row, charges: bool) -> Outcome:
    from systems.errors import SurromdError
    from systems.library.named_scenes import prepare

    try:
        scene = prepare(row.spec)
    except SurromdError as error:
        faults = () if "\n" not in str(error).strip() else ("its refusal is more than one line",)
        return Outcome("refused", str(error).replace(f"{row.spec}: ", "").replace(row.spec, row.name), faults=faults)
    notes = tuple(scene.provenance.get("repairs", ()))
    faults = [] if row.spec.startswith("smiles:") else _unsaid(row, scene, notes)
    state, message, energy = _forces(scene, charges)
    if energy is not None and not energy < GARBAGE_KJ_MOL_AN_ATOM * scene.n_atoms:
        faults.append(f"atoms stand in each other: {energy:.3g} kJ/mol")
    charge = int(scene.formal_charges.sum())
    return Outcome(state, message, notes, scene.n_atoms, charge, energy, tuple(faults))


def _forces(scene: Any, charges: bool) -> tuple[str, str, float | None]:
    """Return the state, a message and the energy of the scene as it stands, kJ/mol, where forces were built."""
    import openmm

    from md_reference.forces.forcefield import build_system
    from md_reference.forces.programs import find_ambertools
    from md_reference.forces.spec import ForceFieldSpec
    from systems.errors import SurromdError

    started = subprocess.Popen.__init__

    def refuse(self: Any, *_: object, **__: object) -> None:
        self.returncode, self.pid = 0, None  # what its __del__ reads
        raise _WouldComputeCharges

    try:
        if not charges:
            subprocess.Popen.__init__ = refuse  # type: ignore[method-assign]
        system = build_system(scene, ForceFieldSpec(force_field="auto", solvent="auto"))
    except _WouldComputeCharges:
        return "charges", "AM1-BCC charges would be computed", None
    except SurromdError as error:
        if not charges and find_ambertools() is None and "AmberTools" in str(error):
            return "charges", "AM1-BCC charges would be computed, by AmberTools, which is not here", None
        return "prepared", f"no forces: {error}", None
    finally:
        subprocess.Popen.__init__ = started  # type: ignore[method-assign]
    context = openmm.Context(
        system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("CPU"), {"Threads": "1"}
    )
    context.setPositions(scene.positions_nm)
    context.computeVirtualSites()
    energy = context.getState(getEnergy=True).getPotentialEnergy()._value
    return "ok", "", float(energy)


def _unsaid(row: Row, scene: Any, notes: Sequence[str]) -> list[str]:
    """What of the file's first model the scene left out, made up or changed without a note; read independently."""
    there = list(_atoms_of(Path(row.spec)))
    if not there:
        return []
    told = " | ".join(notes)
    kept = [(e, *x) for e, x in zip(scene.elements, (scene.positions_nm * 10).tolist(), strict=True)]
    lost, new = _without(there, kept), _without(kept, there)
    found = []
    if lost and not _TELLS_LOSS.search(told):
        found.append(f"{len(lost)} atoms of the file lost or changed ({min(lost)}), unsaid; notes: {told!r}")
    if new and not _TELLS_NEW.search(told):
        found.append(f"{len(new)} atoms made up or changed ({min(new)}), unsaid; notes: {told!r}")
    return found


def _without(atoms: Sequence[Atom], others: Sequence[Atom]) -> list[Atom]:
    """The atoms, element and position in Å, that none of the others equals within the rounding of PDB files."""
    from scipy.spatial import cKDTree

    near = cKDTree([a[1:] for a in others]).query_ball_point([a[1:] for a in atoms], 0.002)
    return [a for a, those in zip(atoms, near, strict=True) if a[0] not in {others[k][0] for k in those}]


def _atoms_of(path: Path) -> Iterator[Atom]:
    """Element and position in Å of the atoms of the first model of a PDB or mmCIF file; none of other files."""
    data = path.read_bytes()
    text = (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data).decode("utf-8", errors="replace")
    names = path.name.lower()
    if ".cif" in names:
        import gemmi

        for block in gemmi.cif.read_string(text):
            columns = ["type_symbol", "Cartn_x", "Cartn_y", "Cartn_z", "?pdbx_PDB_model_num"]
            table = block.find("_atom_site.", columns)
            for line in table:
                if not line.has(4) or line[4] == table[0][4]:
                    yield (line.str(0).capitalize().replace("D", "H", line.str(0) == "D"),
                           *(round(float(line[k]), 3) for k in (1, 2, 3)))  # fmt: skip
    elif ".pdb" in names or ".ent" in names:
        any_atom = False
        for line in text.splitlines():
            if line.startswith(("ENDMDL", "END ")) or line.strip() == "END":
                if any_atom:
                    return
            elif line.startswith(("ATOM  ", "HETATM")):
                any_atom = True
                symbol = line[76:78].strip().capitalize()
                if symbol.isalpha():
                    yield ("H" if symbol == "D" else symbol,
                           *(round(float(line[k : k + 8]), 3) for k in (30, 38, 46)))  # fmt: skip


def report(rows: Sequence[Row], outcomes: Sequence[Outcome]) -> tuple[str, bool]:
    """Return the report, and whether everything holds: the share of every kind, no garbage, nothing unsaid."""
    pairs = list(zip(rows, outcomes, strict=True))
    lines = ["kind           ok for a peer   before      now      %"]
    counted = [(row, out) for row, out in pairs if row.is_ok_for_a_peer]
    by_kind: dict[str, list[tuple[Row, Outcome]]] = defaultdict(list)
    for row, out in counted:
        by_kind[row.kind].append((row, out))
    enough = True
    for kind, those in [*sorted(by_kind.items()), ("all", counted)]:
        n, before, now = len(those), sum(r.was_as_is for r, _ in those), sum(o.is_as_is for _, o in those)
        enough &= now >= TARGET * n
        short = "" if now >= TARGET * n else f"   below {TARGET:.0%}"
        lines.append(f"{kind:<14} {n:>13} {before:>8} {now:>8} {100 * now / max(n, 1):>6.1f}{short}")
    garbage = [(r, o) for r, o in pairs if r.is_garbage_for_peers and o.is_as_is]
    faulty = [(r, o) for r, o in pairs if o.faults]
    sections = [
        ("ok for a peer, not taken as is", [(r, o.message) for r, o in counted if not o.is_as_is]),
        ("taken before, not now", [(r, o.message) for r, o in pairs if r.was_as_is and not o.is_as_is]),
        ("peers make garbage of it, taken by us", [(r, _say(o)) for r, o in garbage]),
        ("faults", [(r, "; ".join(o.faults)) for r, o in faulty]),
        ("atoms or charge other than the peer's", list(_differing(counted))),
        ("no peer takes it", [(r, _say(o)) for r, o in pairs if not r.is_ok_for_a_peer and not r.is_garbage_for_peers]),
    ]
    for title, found in sections:
        lines += ["", f"{title}: {len(found)}", *(f"  {row.name}: {text}" for row, text in found)]
    state = Counter(o.state for o in outcomes)
    lines += ["", ", ".join(f"{n} {s}" for s, n in sorted(state.items())) + f" of {len(pairs)} rows"]
    return "\n".join(lines), enough and not faulty


def _say(out: Outcome) -> str:
    if not out.is_as_is:
        return f"{out.state}: {out.message}"
    energy = "" if out.energy_kj_mol is None else f", {out.energy_kj_mol:.4g} kJ/mol"
    return f"{out.state}, {out.n_atoms} atoms, charge {out.charge:+d}{energy}; notes: {' | '.join(out.notes) or 'none'}"


def _differing(counted: Iterable[tuple[Row, Outcome]]) -> Iterator[tuple[Row, str]]:
    for row, out in counted:
        said = re.search(r"(?:fixer: |rdkit ok )(\d+) atoms,? charge ([-+]\d+)", row.peer)
        if out.is_as_is and said and (out.n_atoms, out.charge) != (int(said[1]), int(said[2])):
            yield row, f"{out.n_atoms} atoms, charge {out.charge:+d}; the peer's: {said[1]}, {said[2]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=REPOSITORY.parent / "shared" / "data" / "structures")
    parser.add_argument("--kind", nargs="*", help="only these kinds")
    parser.add_argument("--name", nargs="*", help="only rows whose name holds one of these")
    parser.add_argument("--charges", action="store_true", help="compute AM1-BCC charges, too (hours)")
    parser.add_argument("--limit", type=int, default=300, help="seconds for a row")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--json", type=Path, help="write the outcome of each row")
    given = parser.parse_args()
    rows = read_rows(given.data)
    rows = [r for r in rows if not given.kind or r.kind in given.kind]
    rows = [r for r in rows if not given.name or any(part in r.name for part in given.name)]
    with ProcessPoolExecutor(given.workers) as pool:
        outcomes = list(pool.map(partial(try_row, charges=given.charges, limit_s=given.limit), rows))
    if given.json:
        table = [asdict(r) | asdict(o) for r, o in zip(rows, outcomes, strict=True)]
        finite = [
            {k: v if not isinstance(v, float) or math.isfinite(v) else str(v) for k, v in t.items()} for t in table
        ]
        given.json.write_text(json.dumps(finite, indent=1, ensure_ascii=False) + "\n")
    text, holds = report(rows, outcomes)
    sys.stdout.write(text + "\n")
    return 0 if holds else 1


if __name__ == "__main__":
    raise SystemExit(main())
