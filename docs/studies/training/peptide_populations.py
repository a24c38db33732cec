"""Populations of torsion states of peptides in TIP3P: kept as a table, set in weights, and compared with rollouts.

    python docs/studies/training/peptide_populations.py gather WATER
    python docs/studies/training/peptide_populations.py set OUT.safetensors --start WEIGHTS
    python docs/studies/training/peptide_populations.py left-out FOLDER [--start WEIGHTS]
    python docs/studies/training/peptide_populations.py table FOLDER [--earlier WEIGHTS]
    python docs/studies/training/peptide_populations.py lags FOLDER [--earlier WEIGHTS]

WATER is a folder of `peptide_campaign --umbrella`. `gather` writes the populations of psi and of side chains to
`water_populations.tsv`, a line for each torsion of each batch of runs: in per cent of the frames with every phi
negative, of strands and helices, or of gauche+, trans and gauche-, by a Markov model, with standard errors. Nothing
else is kept of this MD, and the campaign leaves out what the table holds. `set` moves how likely states are in TIP3P to
the table's, those of molecules that weights are tested on aside (`balance.population_levels`), in the mean over
rollouts, and again as rollouts of the new weights show. `left-out` says how far the logarithms of ratios of populations
are from the table's, of each molecule as others set them. `table` lays those of the tests beside rollouts by the
shipped weights and by earlier ones. `lags` says how far populations by longer steps are from those by steps of 10 ps,
of pairs that no training saw.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from peptide_list import TEST_PAIRS, held_out_peptides, unseen_peptides
from peptide_rollouts import rolled
from peptide_scores import angles, psi_crossings, turns_of
from processes import is_trained

from md_reference.run.machine import machine_name
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.markov import equilibrium
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.balance import Change, population_levels, raise_populations
from surrogate.models.peptides.chains import ChainFeatures
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.weights import TrainingDomain, Weights, load_weights, provenance_of, save_weights
from systems.chemistry.geometry import torsion
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import frame_factors

FloatArray = npt.NDArray[np.float64]
RECORD = Path(__file__).with_name("water_populations.tsv")
TABLES = Path(__file__).parents[2] / "results" / "tables"
COLUMNS = ("molecule", "batch", "ns", "residue", "torsion", "populations", "errors")
TIP3P, SHIPPED = "tip3p", "peptides"
# Rollouts by which populations are counted, how much of their beginning is left out, and, where it is counted how often
# psi crosses, the time between frames.
ROLLOUTS, ROLLED_PS, LEFT_OUT_PS, LAG_PS, FINE_LAG_PS = 16, 30_000.0, 2_000.0, 20.0, 10.0
PASSES = 3
LONGER_PS = (20.0, 100.0)
# Between states lie so many degrees on either side of their ends.
CORE_DEG = 25.0


class Torsion(NamedTuple):
    """One torsion of a molecule by a batch of runs, or by several: of `residue` (from 1), `name`d ψ, χ1, ..., and of
    each state the share and its standard error, `(n_states,)`."""

    molecule: str
    batch: str
    ns: float
    residue: int
    name: str
    shares: FloatArray
    errors: FloatArray

    @property
    def at(self) -> tuple[int, str]:
        return self.residue, self.name

    @property
    def counted(self) -> float:
        """How many independent frames would err as much."""
        often = self.shares * (1.0 - self.shares)
        return float(often.sum() / max(1e-4, (self.errors**2).sum()))

    def log_ratio(self, shares: FloatArray, a: int, b: int) -> float:
        """Return the logarithm of how much likelier state `b` is than `a`, half a frame more seen of each."""
        return math.log((shares[b] * self.counted + 0.5) / (shares[a] * self.counted + 0.5))

    def variance(self, a: int, b: int) -> float:
        return sum(1.0 / (self.shares[k] * self.counted + 0.5) for k in (a, b))


def read(record: Path = RECORD) -> list[Torsion]:
    """Return what the table holds, batch by batch."""
    found = []
    for line in record.read_text("utf-8").splitlines()[1:] if record.exists() else ():
        molecule, batch, ns, residue, name, *both = line.split("\t")
        shares, errors = (np.array(each.split(), dtype=np.float64) / 100.0 for each in both)
        found.append(Torsion(molecule, batch, float(ns), int(residue), name, shares, errors))
    return found


def recorded() -> set[tuple[str, int]]:
    """Return the molecules and numbers of batches that the table holds."""
    return {(torsion.molecule, int(torsion.batch)) for torsion in read()}


def together(some: Sequence[Torsion]) -> list[Torsion]:
    """Return each torsion of each molecule once, by all its batches."""
    found = []
    for key in dict.fromkeys((t.molecule, t.at) for t in some):
        each = [t for t in some if (t.molecule, t.at) == key]
        ns = np.array([t.ns for t in each])
        shares = sum(t.shares * t.ns for t in each) / ns.sum()
        errors = np.sqrt(sum((t.errors * t.ns) ** 2 for t in each)) / ns.sum()
        found.append(each[0]._replace(batch="", ns=float(ns.sum()), shares=shares, errors=errors))
    return found


class Place(NamedTuple):
    """Where a torsion stands in a model: its `row` among the torsions that have states, how many states it has
    (`count`), and by how many places these are `shifted`: a model may count them from other atoms."""

    row: int
    count: int
    shifted: int

    def state(self, k: int) -> int:
        return (k + self.shifted) % self.count


def places_of(scene: Scene, chain: ChainFeatures) -> dict[tuple[int, str], Place]:
    """Return where psi and each torsion of side chains whose states differ stand, by residue (from 1) and name."""
    turns = {frozenset(t.quad[1:3]): t for t in turns_of(scene) if t.kind != "phi" and t.fold == 1}
    stated, found = chain.stated, {}
    for row, quad in enumerate(stated.quads.tolist()):
        if (turn := turns.get(frozenset(quad[1:3]))) is not None:
            own, usual = torsion(scene.positions_nm[None], [quad, turn.quad])[0]
            count = int(stated.counts[stated.residue[row], stated.slot[row]])
            shifted = round(count * (own - usual) / (2.0 * math.pi)) % count
            name = turn.kind.replace("psi", "ψ").replace("chi", "χ")
            found[turn.residue + 1, name] = Place(row, count, shifted)
    return found


def populations(
    scene: Scene, chain: ChainFeatures, runs: Sequence[npt.NDArray[np.floating]],
    factors: Sequence[FloatArray] | None = None,
) -> dict[tuple[int, str], tuple[FloatArray, FloatArray]]:  # fmt: skip
    """Return of each torsion, by residue and name, the share of each of its states among frames with every phi
    negative, and its standard error, from `runs` `(n_frames, n_atoms, 3)`, whose frames count by `factors`: of a
    Markov model of how runs go from well inside one state to another, which forgets where they began."""
    stated, found = chain.stated, {}
    rows = [torsion(np.asarray(x, dtype=np.float64), stated.quads.numpy()) for x in runs]
    states = [stated.states(torch.from_numpy(x)).numpy() for x in rows]
    kept = [(x[..., 0] == 0).all(axis=1) for x in states]
    for at, place in places_of(scene, chain).items():
        ends, labels, visits = stated.ends_deg[place.row].numpy(), [], []
        residue, slot = int(stated.residue[place.row]), int(stated.slot[place.row])
        for angles_rad, of_all, negative in zip(rows, states, kept, strict=True):
            state = of_all[:, residue, slot]
            ahead = (np.degrees(angles_rad[:, place.row]) - float(stated.first_deg[place.row])) % 360.0
            inside = np.minimum(ahead - ends[state], ends[state + 1] - ahead) >= CORE_DEG
            last = np.maximum.accumulate(np.where(inside, np.arange(len(state)), -1))
            visits.append(np.where(last >= 0, state[last], -1))
            labels.append(np.where(negative, (state - place.shifted) % place.count, -1))
        shares, draws = equilibrium(visits).shares(visits, labels, place.count, factors)
        found[at] = shares, draws.std(axis=0)
    return found


def gather(water: Path, model: PeptideSlide) -> None:
    """Add what a folder holds to the table."""
    lines = RECORD.read_text("utf-8").splitlines() if RECORD.exists() else ["\t".join(COLUMNS)]
    known, n = recorded(), len(lines)
    places = sorted(path for kind in ("umbrella_test", "umbrella") for path in (water / kind).glob("*"))
    if not places:
        raise SystemExit(f"{water} holds no MD under an umbrella potential; name a folder of peptide_campaign.")
    for place in places:
        batches: dict[int, list[Path]] = {}
        for file in sorted(place.glob("run_*.h5")):
            batches.setdefault(int(file.stem.removeprefix("run_")) // n_replicas(), []).append(file)
        for number, files in batches.items():
            if (place.name, number) in known or len(files) < n_replicas():
                continue
            md = load_ensemble(files)
            assert md.differences_kj_mol is not None
            factors = frame_factors(md.differences_kj_mol, 300.0)
            chain = chain_features(md.scene, model.config, TIP3P)
            ns = 1e-3 * md.lag_ps * sum(map(len, md.segments))
            for (residue, name), both in populations(md.scene, chain, md.segments, factors).items():
                percents = (" ".join(f"{100.0 * x:.1f}" for x in some) for some in both)
                lines.append("\t".join([place.name, str(number), f"{ns:.3g}", str(residue), name, *percents]))
    RECORD.write_text("\n".join(lines) + "\n", "utf-8")
    sys.stdout.write(f"{len(lines) - n} torsions added\n")


def learned() -> list[Torsion]:
    """Return what the table holds of molecules that weights are not tested on."""
    tested = {p.name for p in (*unseen_peptides(), *held_out_peptides())}
    return together([t for t in read() if t.molecule not in tested])


def lacking(weights: Weights, torsions: Sequence[Torsion], folder: Path) -> dict[str, list[Change]]:
    """Return, by molecule, every two states of torsions with the logarithm of how many times too rare the second is
    beside the first in rollouts, which lie in a folder."""
    model, found = weights.model, {}
    assert isinstance(model, PeptideSlide)
    for molecule in dict.fromkeys(t.molecule for t in torsions):
        scene = build_peptide(f"ACE-{molecule}-NME")
        chain = chain_features(scene, model.config, TIP3P)
        outs = [folder / molecule / f"{k:02d}.h5" for k in range(ROLLOUTS)]
        runs = rolled(weights, scene, outs, ROLLED_PS, LAG_PS, TIP3P)
        of_model = populations(scene, chain, [x[round(LEFT_OUT_PS / LAG_PS) :] for x in runs])
        places = places_of(scene, chain)
        changes = found[molecule] = []
        for t in (t for t in torsions if t.molecule == molecule):
            place = places[t.at]
            residue, slot = int(chain.stated.residue[place.row]), int(chain.stated.slot[place.row])
            types = chain.places[residue, :3].tolist()
            shares, _ = of_model[t.at]
            for a, b in combinations(range(len(shares)), 2):
                off = t.log_ratio(t.shares, a, b) - t.log_ratio(shares, a, b)
                both = place.state(a), place.state(b)
                if both[0] > both[1]:
                    both, off = both[::-1], -off
                changes.append(Change((*types,), slot, both, off, t.variance(a, b)))
    return found


Levels = dict[tuple[int, int, int], torch.Tensor]


def told(levels: Levels, change: Change) -> float:
    """Return what levels say that a change lacks."""
    key = (change.torsion, *change.states)
    return sum(float(levels[key][k, kind]) for k, kind in enumerate(change.types)) if key in levels else 0.0


def set_populations(out: Path, start: Weights) -> None:
    """Write weights with the table's populations: levels are fitted to what `start` lacks, and after each pass to what
    its rollouts lack and what levels have added together."""
    model, torsions = start.model, learned()
    assert isinstance(model, PeptideSlide)
    moved: Levels = {}
    solvent = model.config.solvents.index(TIP3P)
    for k in range(PASSES):
        # Rollouts of a pass are of no other table's.
        with TemporaryDirectory() as folder:
            changes = [c for each in lacking(start, torsions, Path(folder)).values() for c in each]
        levels = population_levels(model, [c._replace(lacking=c.lacking + told(moved, c)) for c in changes])
        raise_populations(model, solvent, {key: x - moved.get(key, 0.0) for key, x in levels.items()})
        moved = levels
        sys.stdout.write(f"pass {k}: off by {off_by(changes):.2f}\n")
    molecules = sorted({t.molecule for t in torsions})
    about = {"tuned": "populations", "umbrella_ns": round(sum({t.molecule: t.ns for t in torsions}.values()), 1),
             "molecules": molecules}  # fmt: skip
    domain = with_sequences(start.domain, [f"ACE-{name}-NME" for name in molecules])
    save_weights(out, model, domain, provenance_of({}, about, start), half=True)


def with_sequences(domain: TrainingDomain, sequences: Sequence[str]) -> TrainingDomain:
    """Return the domain with further molecules trained on in TIP3P."""
    members = list(domain.members)
    k = next(k for k, member in enumerate(members) if member.conditions.get("solvent") == TIP3P)
    known = {"-".join(m.scene.residue_names) for m in members if m.conditions == members[k].conditions}
    new = [name for name in sequences if name not in known | {*members[k].sequences}]
    members[k] = replace(members[k], sequences=(*members[k].sequences, *new))
    return replace(domain, further=tuple(members[1:])) if k else replace(domain, sequences=members[0].sequences)


def off_by(changes: Sequence[Change]) -> float:
    """Return how far logarithms of ratios are off beyond MD's error, root mean square, each as it is known."""
    weights = np.array([c.counted for c in changes])
    square = np.array([c.lacking**2 - c.variance for c in changes])
    return math.sqrt(max(0.0, float((weights * square).sum() / weights.sum())))


def left_out(folder: Path, start: Weights) -> None:
    """Print how far molecules are off as they are, and as all others set them, for psi and side chains."""
    model, found = start.model, lacking(start, learned(), folder / f"{start.path.stem}-{start.hash[:8]}")
    assert isinstance(model, PeptideSlide)
    rest = []
    for molecule, changes in found.items():
        levels = population_levels(model, [c for name, each in found.items() if name != molecule for c in each])
        rest += [c._replace(lacking=c.lacking - told(levels, c)) for c in changes]
    every = [c for each in found.values() for c in each]
    for words, some in (("as they are", every), ("as others set them", rest)):
        parts = (("all", some), ("ψ", [c for c in some if c.torsion == 1]), ("χ", [c for c in some if c.torsion > 1]))
        sys.stdout.write(f"{words}: " + ", ".join(f"{name} {off_by(part):.2f}" for name, part in parts) + "\n")


def ways_of(earlier: str | None) -> dict[str, tuple[Any, str]]:
    """Return which weights in which solvent, by what they are called in tables."""
    ways: dict[str, tuple[Any, str]] = {"earlier ones": (earlier, TIP3P)} if earlier else {}
    return ways | {f"`{SHIPPED}`": (SHIPPED, TIP3P), f"`{SHIPPED}` in OBC2": (SHIPPED, "obc2")}


def by_rollouts(
    weights: Weights, solvent: str, scene: Scene, folder: Path, lag_ps: float
) -> tuple[list[npt.NDArray[np.floating]], dict[tuple[int, str], tuple[FloatArray, FloatArray]]]:
    """Return rollouts of a molecule, which lie in a folder, without their beginnings, and populations by these."""
    assert isinstance(weights.model, PeptideSlide)
    place = folder / f"{weights.path.stem}-{weights.hash[:8]}-{solvent}" / scene.name
    outs = [place / f"{lag_ps:g}ps-{k:02d}.h5" for k in range(ROLLOUTS)]
    runs = rolled(weights, scene, outs, ROLLED_PS, lag_ps, solvent)
    runs = [x[round(LEFT_OUT_PS / lag_ps) :] for x in runs]
    return runs, populations(scene, chain_features(scene, weights.model.config, solvent), runs)


def lag_table(folder: Path, earlier: str | None, out: Path) -> None:
    """Say how far populations by longer steps are from those by short ones, root mean square over states, less what
    rollouts err by."""
    pairs = ["-".join(pair) for pair in TEST_PAIRS]
    lines = []
    for way, (name, solvent) in ways_of(earlier).items():
        weights, square = load_weights(weights_path(str(name))), np.zeros(len(LONGER_PS))
        n, farthest = 0, (0.0, "")
        for pair in pairs:
            scene = build_peptide(f"ACE-{pair}-NME")
            short, *long = (by_rollouts(weights, solvent, scene, folder, lag)[1] for lag in (FINE_LAG_PS, *LONGER_PS))
            for at, (shares, errors) in short.items():
                others = [each[at] for each in long]
                square += [((x - shares) ** 2 - e**2 - errors**2).sum() for x, e in others]
                n += len(shares)
                last, its_errors = others[-1]
                k = int(np.abs(last - shares).argmax())
                both = f"{percent(shares[k], errors[k])} and {percent(last[k], its_errors[k])}"
                words = f"{at[1]} of {pair.split('-')[at[0] - 1]} in {pair}: {both}"
                farthest = max(farthest, (abs(float(last[k] - shares[k])), words), key=itemgetter(0))
        lines.append([way, *(f"{100.0 * math.sqrt(max(0.0, x / n)):.1f}" for x in square), farthest[1]])
        sys.stdout.write(" | ".join(lines[-1]) + "\n")
    note = (
        f"{len(pairs)} capped pairs that no training saw; {ROLLOUTS} rollouts of {1e-3 * ROLLED_PS:g} ns of each at "
        f"each step, without their first {1e-3 * LEFT_OUT_PS:g}."
    )
    columns = ["", *(f"by steps of {lag:g} ps, %" for lag in LONGER_PS),
               f"farthest by {LONGER_PS[-1]:g} ps, %, of a state by {FINE_LAG_PS:g} ps"]  # fmt: skip
    write_table(out, columns, lines, "lags", earlier, note)


def write_table(
    out: Path, columns: Sequence[str], lines: Sequence[Sequence[str]], what: str, earlier: str | None, note: str
) -> None:
    words = " --earlier EARLIER.safetensors" if earlier else ""
    about = {"command": f"python docs/studies/training/peptide_populations.py {what} FOLDER{words}",
             "machine": machine_name(), "note": note}  # fmt: skip
    table = {"columns": columns, "rows": lines, **about}
    out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


def make_table(folder: Path, earlier: str | None, out: Path) -> None:
    """Lay the tests' populations beside those of rollouts, and say how often psi crosses."""
    known = {t.molecule for t in learned()}
    torsions = together([t for t in read() if t.molecule not in known])
    ways, rows = ways_of(earlier), dict[str, list[str]]()
    off: dict[str, list[float]] = {way: [] for way in ways}
    for molecule in dict.fromkeys(t.molecule for t in torsions):
        scene = build_peptide(f"ACE-{molecule}-NME")
        turns, names = turns_of(scene), ("", *molecule.split("-"))
        for way, (name, solvent) in ways.items():
            weights = load_weights(weights_path(str(name)))
            runs, found = by_rollouts(weights, solvent, scene, folder, FINE_LAG_PS)
            for t in (t for t in torsions if t.molecule == molecule):
                for k, state in enumerate(("strand", "helix") if t.name == "ψ" else ("gauche+", "trans", "gauche-")):
                    shares, errors = found[t.at]
                    row = rows.setdefault(f"{t.name} {names[t.residue]} {state}", [percent(t.shares[k], t.errors[k])])
                    row.append(percent(shares[k], errors[k]))
                    off[way].append((shares[k] - t.shares[k]) ** 2 - t.errors[k] ** 2)
            for k, turn in enumerate(turns):
                if turn.kind == "psi":
                    often = [1e3 * psi_crossings(angles(turns, x)[:, k]) / (FINE_LAG_PS * len(x)) for x in runs]
                    error = float(np.std(often)) / math.sqrt(len(often) - 1)
                    row = rows.setdefault(f"ψ {names[turn.residue + 1]}, crossings per ns", [""])
                    row.append(f"{np.mean(often):.2f} ± {error:.2f}")
    lines = [[name, *row] for name, row in sorted(rows.items(), key=lambda row: "crossings" in row[0])]
    lines = [line for line in lines if not line[0].endswith((" strand", " gauche-"))]
    lines.append(["error of all states", "", *(f"{100.0 * math.sqrt(max(0.0, np.mean(x))):.0f}" for x in off.values())])
    lengths = {t.molecule: f"{t.ns:.2g} ns of {t.molecule}" for t in torsions}
    note = (
        f"Share of time in %, of frames with every φ negative. MD under an umbrella potential: "
        f"{'; '.join(lengths.values())}. Rollouts: {ROLLOUTS} of {1e-3 * ROLLED_PS:g} ns, without their first "
        f"{1e-3 * LEFT_OUT_PS:g}. By Markov models; the error of all states is the root mean square, less MD's own."
    )
    write_table(out, ["", "MD in TIP3P", *ways], lines, "table", earlier, note)
    sys.stdout.write("\n".join(" | ".join(line) for line in lines) + "\n")


def percent(share: float, error: float) -> str:
    return f"{100.0 * share:.0f} ± {100.0 * error:.0f}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("gather", "set", "left-out", "table", "lags"))
    parser.add_argument("path", type=Path)
    parser.add_argument("--start", default=SHIPPED)
    parser.add_argument("--earlier")
    parser.add_argument("-o", "--out", type=Path)
    a = parser.parse_args(arguments)
    if a.what in ("table", "lags"):
        make, name = (make_table, "shipped") if a.what == "table" else (lag_table, "lags")
        make(a.path, a.earlier, a.out or TABLES / f"peptides_water_{name}.json")
        return
    start = load_weights(weights_path(a.start))
    if a.what == "set":
        if not is_trained(a.path):
            set_populations(a.path, start)
        return
    if a.what == "left-out":
        left_out(a.path, start)
        return
    assert isinstance(start.model, PeptideSlide)
    gather(a.path, start.model)


if __name__ == "__main__":
    main()
