"""States of peptides' torsions in OBC2, of MD under an umbrella potential: kept as a record, learned, and compared.

    python docs/studies/training/peptide_states.py record CAMPAIGN
    python docs/studies/training/peptide_states.py teach OUT.safetensors --weights WEIGHTS [--steps 600]
    python docs/studies/training/peptide_states.py compare [--weights WEIGHTS]

CAMPAIGN is a folder of `peptide_campaign --umbrella --solvent obc2`. `record` adds its molecules to
`umbrella_states.npz`: of each half of the runs, what states all torsions are in at once, drawn as often as frames count
at equilibrium. Nothing else is kept of this MD, and the campaign leaves out what the record holds. `teach` trains the
probabilities at endless times on it, but those of the signs of phi; of molecules that WEIGHTS were trained on they are
to stay what they were. One molecule in eight is left out. `compare` says how far populations at endless times are from
those of MD, of molecules left out and learned, and how much psi of residues one and two apart are in one state together
(the mean correlation); and how rare phi > 0 is by steps, beside free energies that weights were trained with
(`peptide_energies`). Weights so taught are for endless times alone: `peptide_equilibrium`
teaches steps to keep what they draw.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from peptide_energies import trained_with
from peptide_equilibrium import Equilibrium, positive_phis, step
from peptide_list import held_out_peptides, training_peptides, unseen_peptides, wide_peptides
from torch import Tensor

from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.chains import MOST_STATES, MOST_TORSIONS, ChainFeatures
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.trainer import state_loss
from surrogate.models.weights import TrainingDomain, Weights, load_weights, provenance_of, save_weights
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.errors import InputError
from systems.trajectory.codec import frame_factors

RECORD = Path(__file__).with_name("umbrella_states.npz")
# Of each half of the runs of a molecule; of runs of which fewer frames count in effect nothing is kept but the name.
DRAWS, LEAST_COUNTED = 2048, 100.0
LEFT_OUT = 8
_WINDOWS, _TIMES, _RATE, _DROPPED, _VALIDATE_S = 256, 4, 5e-4, 0.2, 600.0
# Frames of a molecule that endless times are counted from: little of them is left by then.
_STARTS = 128
# Where psi stands among torsions, and how far apart residues are whose psi are looked at together. Steps by which
# phi > 0 is looked at, and frames of each residue for it.
_PSI, _APART = 1, (1, 2)
_STEPS_PS, _SIGNED_FRAMES = (10.0, 100.0, 1000.0), 3000
# The share of training that keeps what is drawn of so many molecules known before.
_KEEPING, _KNOWN = 0.4, 40


class Md(NamedTuple):
    """A molecule of the record: what is given to `build_peptide`, and `states` (2, DRAWS, n_torsions) by either half of
    its runs, of torsions as `ChainFeatures.stated` has them."""

    name: str
    states: npt.NDArray[np.uint8]

    @property
    def sequence(self) -> str:
        return self.name.removeprefix("free-") if self.name.startswith("free-") else f"ACE-{self.name}-NME"

    @property
    def kind(self) -> str:
        ends = "free" if self.name.startswith("free-") else "capped"
        return f"{ends} {'pairs' if self.name.removeprefix('free-').count('-') == 1 else 'chains'}"

    def laid(self, chain: ChainFeatures) -> Tensor:
        """Return the states `(n, n_residues, MOST_TORSIONS)`."""
        flat = torch.from_numpy(self.states).flatten(0, 1).long()
        found = flat.new_zeros(len(flat), len(chain.places), MOST_TORSIONS)
        found[:, chain.stated.residue, chain.stated.slot] = flat
        return found


def drawn(states: npt.NDArray[np.uint8], factors: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """Return DRAWS rows of `states` (n, k), in order, each as often as its `factors` (n,) say and nearly so."""
    order = np.lexsort(states.T[::-1])
    ends = np.cumsum(factors[order])
    places = (np.arange(DRAWS) + 0.5) / DRAWS * ends[-1]
    return states[order][np.searchsorted(ends, places)]


def read(record: Path = RECORD) -> list[Md]:
    """Return the molecules of a record. Raises InputError for one that is tested by."""
    if not record.exists():
        return []
    with np.load(record) as kept:
        found = [Md(name, kept[name]) for name in kept.files]
    tested = {"-".join(p.residues) for p in (*unseen_peptides(), *held_out_peptides()) if len(p.residues) > 1}
    if some := [md.name for md in found if md.name.removeprefix("free-") in tested]:
        raise InputError(f"{record}: weights are tested on {', '.join(some)}; leave them out of the record.")
    return found


def gather(campaign: Path, model: PeptideSlide, record: Path = RECORD) -> None:
    """Add the molecules of a campaign to a record."""
    kept = {md.name: md.states for md in read(record)}
    places = sorted((campaign / "umbrella").glob("*"))
    if not places:
        raise SystemExit(f"{campaign} holds no MD under an umbrella potential; name a folder of peptide_campaign.")
    for place in places:
        files = sorted(place.glob("run_*.h5"))
        if place.name in kept or not files:
            continue
        md = load_ensemble(files)
        assert md.differences_kj_mol is not None
        chain = chain_features(md.scene, model.config)
        at = chain.stated.residue, chain.stated.slot
        states = [chain.states(torch.from_numpy(x))[:, at[0], at[1]].numpy().astype(np.uint8) for x in md.segments]
        factors = frame_factors(md.differences_kj_mol, 300.0)
        halves = [drawn(np.concatenate(states[k::2]), np.concatenate(factors[k::2])) for k in (0, 1)]
        every = np.concatenate(factors)
        counted = every.sum() ** 2 / (every**2).sum()
        kept[place.name] = np.stack(halves)[:, : DRAWS if counted >= LEAST_COUNTED else 0]
        sys.stdout.write(f"{place.name}: {len(every)} frames, of which {counted:.0f} count\n")
    by_name: dict[str, Any] = {name: kept[name] for name in sorted(kept)}
    np.savez_compressed(record, **by_name)


def shares(states: Tensor, chain: ChainFeatures) -> Tensor:
    """Return how often each torsion but phi is in each state `(n_torsions, MOST_STATES)`, of `states` (n, n_residues,
    MOST_TORSIONS) with every phi negative."""
    kept = states[(states[..., 0] == 0).all(dim=1)]
    side = chain.stated.slot > 0
    own = kept[:, chain.stated.residue[side], chain.stated.slot[side]]
    return F.one_hot(own, MOST_STATES).double().mean(dim=0)


def together(states: Tensor, chain: ChainFeatures) -> dict[int, list[float]]:
    """Return the correlations of the states of psi of residues one and two apart, by how far, of `states` (n,
    n_residues, MOST_TORSIONS) with every phi negative."""
    kept, psi = states[(states[..., 0] == 0).all(dim=1)][..., _PSI].double(), chain.stated.counts[:, _PSI] > 1
    return {
        apart: [float(torch.corrcoef(kept[:, [r, r + apart]].T)[0, 1].nan_to_num())
                for r in range(len(psi) - apart) if psi[r] and psi[r + apart]] for apart in _APART
    }  # fmt: skip


@torch.no_grad()
def endless_states(model: PeptideSlide, frames: Equilibrium) -> Tensor:
    """Return states `(2 DRAWS, n_residues, MOST_TORSIONS)` endless times after frames."""
    chain, generator = frames.chain, torch.Generator().manual_seed(0)
    rows = torch.multinomial(frames.weights, 2 * DRAWS, True, generator=generator)
    times = torch.full((2 * DRAWS, 1), model.config.forgotten_ps)
    uniform = torch.rand(len(rows), 1, *chain.stated.counts.shape, generator=generator)
    given = frames.observed[rows], frames.states[rows], chain.places, chain.stated.counts, times, times
    return model.jumps_of(chain).draw(*given, uniform)[:, 0]


def errors(model: PeptideSlide, some: Iterable[tuple[Md, Equilibrium]]) -> dict[str, float]:
    """Return how far shares of states at endless times are from MD's, root mean square less MD's own error, and that
    error, %."""
    off, own, n = 0.0, 0.0, 0
    for md, frames in some:
        chain = frames.chain
        ours = shares(endless_states(model, frames), chain)
        first, second = (shares(x, chain) for x in md.laid(chain).split(DRAWS))
        off += float((ours - (first + second) / 2).square().sum())
        own += float((first - second).square().sum()) / 4
        n += int(chain.stated.counts[chain.stated.counts > 0].sum()) - 2 * int((chain.stated.slot == 0).sum())
    return {"off": 100.0 * math.sqrt(max(0.0, off - own) / n), "own": 100.0 * math.sqrt(own / n)}


def correlations(model: PeptideSlide, some: Iterable[tuple[Md, Equilibrium]]) -> dict[int, tuple[float, float]]:
    """Return the mean correlations of `together`, ours at endless times and MD's, by how far residues are apart; those
    alone that some molecule has."""
    each: dict[int, list[tuple[float, float]]] = {apart: [] for apart in _APART}
    for md, frames in some:
        ours, theirs = (together(x, frames.chain) for x in (endless_states(model, frames), md.laid(frames.chain)))
        for apart, found in each.items():
            found += zip(ours[apart], theirs[apart], strict=True)
    return {apart: (float(np.mean(x, 0)[0]), float(np.mean(x, 0)[1])) for apart, x in each.items() if x}


def positive_phi_errors(model: PeptideSlide, energies: dict[str, float]) -> dict[str, tuple[float, float]]:
    """Return, by how long steps are, how much rarer phi > 0 is than its free energies say where as many enter it as
    leave it, in the mean over residues between caps, and root mean square, kT."""
    off: dict[str, list[float]] = {f"{time_ps:g} ps": [] for time_ps in _STEPS_PS}
    for name, kt in energies.items():
        frames = Equilibrium.of(model, f"ACE-{name}-NME", n_frames=_SIGNED_FRAMES)
        positive = frames.states[:, frames.chain.signed[0], 0] == 1
        for time_ps in _STEPS_PS:
            after = positive_phis(model, frames, time_ps)[:, 0]
            entered, left = (
                (frames.weights[side] @ x[side]) / frames.weights[side].sum()
                for side, x in ((~positive, after), (positive, 1.0 - after))
            )
            off[f"{time_ps:g} ps"].append(float((left / entered).log()) - kt)
    return {name: (float(np.nanmean(x)), float(np.sqrt(np.nanmean(np.square(x))))) for name, x in off.items()}


def parted(some: Sequence[Md]) -> tuple[list[Md], list[Md]]:
    """Return, of those with enough MD, what is learned and what is left out: by places in the wide campaign, so that
    they stay what they are as the record grows, and only where no earlier training saw their residues."""
    first = {p.residues for p in training_peptides()}
    out = {p.name for k, p in enumerate(wide_peptides()) if k % LEFT_OUT == 0 and p.residues not in first}
    some = [md for md in some if md.states.size]
    return [md for md in some if md.name not in out], [md for md in some if md.name in out]


def with_sequences(domain: TrainingDomain, some: Sequence[Md]) -> TrainingDomain:
    """Return the domain with further molecules trained on in OBC2."""
    known = {*domain.sequences}
    return replace(domain, sequences=(*domain.sequences, *(md.sequence for md in some if md.sequence not in known)))


def teach(out: Path, start: Weights, steps: int, some: Sequence[Md]) -> Path:
    """Write weights that draw the record's states at endless times. Raises InputError for a record of which nothing is
    learned or nothing left out, and SimulationError when training diverges."""
    learned, left_out = parted(some)
    if not learned or not left_out:
        raise InputError(f"{RECORD}: {len(learned)} molecules to learn and {len(left_out)} left out; record more.")
    teacher, model = (cast(PeptideSlide, w.model) for w in (start, load_weights(start.path)))
    model.requires_grad_(True)
    names = {md.sequence for md in some}
    known = [sequence for sequence in start.domain.sequences if sequence not in names]
    known = random.Random(0).sample(known, min(_KNOWN, len(known)))
    times = torch.full((_TIMES,), model.config.forgotten_ps)

    @cache
    def frames_of(sequence: str) -> Equilibrium:
        return Equilibrium.of(teacher, sequence, n_frames=_STARTS)

    def of_record(md: Md, generator: torch.Generator, dropped: float) -> Tensor:
        frames, n = frames_of(md.sequence), _WINDOWS * _TIMES
        rows = torch.randint(len(frames.states), (_WINDOWS,), generator=generator)
        laid = md.laid(frames.chain)[torch.randint(2 * DRAWS, (n,), generator=generator)]
        states = torch.cat([frames.states[rows][:, None], laid.unflatten(0, (_WINDOWS, _TIMES))], dim=1)
        share = torch.ones(_WINDOWS, *frames.chain.stated.counts.shape)
        share[:, frames.chain.signed, 0] = 0.0
        given = frames.chain, frames.observed[rows], states, times.expand(_WINDOWS, -1), generator
        return state_loss(model, *given, share=share, dropped=dropped)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        keeping = known and torch.rand(1, generator=generator) < _KEEPING
        place = float(torch.rand(1, generator=generator))
        if not keeping:
            found = of_record(learned[int(place * len(learned))], generator, _DROPPED)
            return found, {"states": found.detach()}
        frames = frames_of(known[int(place * len(known))])
        rows = torch.randint(len(frames.states), (_WINDOWS,), generator=generator)
        found = step(model, teacher, frames, rows, times, generator).divergence
        return found, {"divergence": found.detach()}

    @torch.no_grad()
    def validate() -> dict[str, float]:
        curves: dict[str, float] = {}
        for name, part in (("learned", learned[: len(left_out)]), ("left_out", left_out)):
            found = errors(model, ((md, frames_of(md.sequence)) for md in part))
            curves |= {f"validation_{name}_{what}": value for what, value in found.items()}
            each = [float(of_record(md, torch.Generator().manual_seed(0), 0.0)) for md in part]
            curves[f"validation_{name}_states"] = float(np.mean(each))
        return curves

    def write(spent_s: list[float]) -> None:
        settings = {"umbrella_states": len(learned), "steps": steps, "spent_s": round(sum(spent_s), 1)}
        save_weights(out, model, with_sequences(start.domain, learned), provenance_of({}, settings, start), half=True)

    stage = StageConfig("states", _WINDOWS, _RATE, None, steps, bf16=False, validate_every_s=_VALIDATE_S)
    train_stages([Stage(model.jumps, stage, loss, validate)], out, write, device=torch.device("cpu"), resume=True)
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "teach", "compare"))
    parser.add_argument("path", type=Path, nargs="?")
    parser.add_argument("--weights", default="peptides")
    parser.add_argument("--steps", type=int, default=600)
    a = parser.parse_args(arguments)
    if a.path is None and a.what != "compare":
        parser.error(f"{a.what} needs a path.")
    start = load_weights(weights_path(a.weights))
    model = cast(PeptideSlide, start.model)
    if a.what == "record":
        gather(a.path, model)
    elif a.what == "teach":
        teach(a.path, start, a.steps, read())
    else:
        for name, part in zip(("left out", "learned"), reversed(parted(read())), strict=True):
            for kind in sorted({md.kind for md in part}, reverse=True):
                some = [md for md in part if md.kind == kind]
                each = [(md, Equilibrium.of(model, md.sequence, n_frames=_STARTS)) for md in some]
                found = errors(model, each)
                off, own = found["off"], found["own"]
                line = f"{len(some)} {kind} {name}: off by {off:.1f} %, MD's error {own:.1f} %"
                for apart, (ours, theirs) in correlations(model, each).items():
                    line += f"; psi {apart} apart correlate {ours:.3f}, MD's {theirs:.3f}"
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
        for time, (mean, rms) in positive_phi_errors(model, trained_with(start.provenance)).items():
            sys.stdout.write(f"phi > 0 by steps of {time}: rarer by {mean:.2f} kT, root mean square {rms:.2f} kT\n")


if __name__ == "__main__":
    main()
