"""Teach weights of peptides to keep their own equilibrium: `python docs/studies/training/peptide_equilibrium.py OUT`.

`--weights W [--equilibrium E]`, and no MD. The probabilities of torsion states know equilibrium twice: as states at
endless times, and as those in which steps end up. Both are learned from the same runs, yet differ, the first by less
from MD of molecules never seen; those of E, by `peptide_states`, by less still. A copy of E is trained to keep these
by steps of 1 ps to 1 ns, which are W's: of frames drawn at endless times as many are to go from one state of a torsion
to another as come back (detailed balance), both together as many as before, and apart from that its probabilities are
to stay what they were. How likely phi > 0 is at endless times is set first, to the free energies that W was trained
with (`peptide_energies`); how often it is left stays what it was. Frames are those of `--molecules` of the wide
campaign, of which the weights may know none; of its last ones, which play no part, the curves show how far it is from
balance. It is the first solvent that is taught. What is in OUT half done is gone on with.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from peptide_energies import trained_with
from peptide_list import RESIDUES, wide_peptides
from torch import Tensor

from surrogate.models.architecture import weights_path
from surrogate.models.peptides.balance import levels_of_types
from surrogate.models.peptides.chains import MOST_STATES, ChainFeatures, mended
from surrogate.models.peptides.layout import chain_features
from surrogate.models.peptides.model import PeptideSlide, times_apart
from surrogate.models.peptides.subjects import balanced_starts
from surrogate.models.weights import load_weights, provenance_of, save_weights
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.prepare.peptide import build_peptide

# Frames of a molecule, and states for each of which one is chosen, half of them so that rare ones are among them.
_FRAMES, _POOL, _FIRST = 800, 10, 64
# Windows of a step of training; the share at endless times, whose probabilities stay.
_WINDOWS, _ENDLESS_SHARE, _ENDLESS_FRAMES = 256, 0.15, 4
# What detailed balance counts beside what probabilities were, the square of a logarithm beside a divergence; states in
# which fewer frames are say nothing, and how far, squared, sequences differ.
_BALANCE, _LEAST_FRAMES, _DIFFER = 3.0, 3.0, 0.05
# Molecules of several residues by which signs of phi are set, how often, and what holds their levels near zero.
_SIGNED, _SIGNED_FRAMES, _PASSES, _RIDGE = 120, 128, 2, 0.3
_RATE, _HELD, _VALIDATE_S, _VALIDATED = 6e-4, 16, 120.0, ((10.0, 8), (100.0, 8), (1000.0, 1))


class Equilibrium(NamedTuple):
    """Frames `frames_nm` (n, n_atoms, 3) of a molecule that weights draw at endless times: its `chain`, numbers
    `observed` (n, r, slots), `states` (n, r, MOST_TORSIONS), and what each counts `weights` (n,): rare states are drawn
    more often than they occur."""

    chain: ChainFeatures
    frames_nm: Tensor
    observed: Tensor
    states: Tensor
    weights: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: PeptideSlide, sequence: str, seed: int = 0, n_frames: int | None = None) -> Equilibrium:
        scene, generator = build_peptide(sequence), torch.Generator().manual_seed(seed)
        chain = chain_features(scene, model.config)
        built = torch.tensor(scene.positions_nm, dtype=torch.float32)[None]
        found = cls(chain, built, *model.normalised(built, chain), torch.ones(1))
        for n in (_FIRST, n_frames or _FRAMES):
            found = found.later(model, n, generator)
        return found

    def later(self, model: PeptideSlide, n: int, generator: torch.Generator) -> Equilibrium:
        """Return `n` frames endless times after any of these, but for those that cannot be mended."""
        chain, counts, stated = self.chain, self.chain.stated.counts, self.chain.stated
        pool = _POOL * n
        start = torch.randint(len(self.states), (pool,), generator=generator)
        times = torch.full((pool, 1), model.config.forgotten_ps)
        uniform = torch.rand(pool, 1, *counts.shape, generator=generator)
        given = self.observed[start], self.states[start], chain.places, counts, times, times
        states = model.jumps_of(chain).draw(*given, uniform)
        sought = balanced_starts(states[:, 0, stated.residue, stated.slot]).max(dim=1).values
        likely = 1.0 + sought / sought.mean()
        chosen = torch.multinomial(likely, n, True, generator=generator)
        noise = torch.randn(n, 1, *chain.code.filled.shape, generator=generator) * chain.code.filled
        before = self.observed[start[chosen]], self.states[start[chosen]]
        tokens, _ = model.solved(
            *before, states[chosen], times[:n], chain, noise, solver=model.solvers[0], solver_steps=model.usual_steps
        )
        frames, astray, crowded = mended(tokens[:, 0], states[chosen, 0], chain)
        kept = ~(astray | crowded)
        frames, counting = frames[kept], likely[chosen][kept].reciprocal().float()
        return Equilibrium(chain, frames, *model.normalised(frames, chain), counting)


@torch.no_grad()
def positive_phis(model: PeptideSlide, frames: Equilibrium, time_ps: float) -> Tensor:
    """Return how likely each phi that has signs is positive so long after each frame, `(n, n_signed)`."""
    chain, counts, n = frames.chain, frames.chain.stated.counts, len(frames.states)
    times = torch.full((n, 1), time_ps)
    uniform = torch.rand(n, 1, *counts.shape, generator=torch.Generator().manual_seed(0))
    shares = uniform.new_zeros(*uniform.shape, MOST_STATES)
    given = frames.observed, frames.states, chain.places, counts, times, times
    model.jumps_of(chain).draw(*given, uniform, shares)
    return shares[:, 0, chain.signed, 0, 1]


def set_signs(model: PeptideSlide, sequences: Sequence[str], positive_phi_kt: Mapping[str, float]) -> None:
    """Move how likely phi > 0 is at endless times, by levels of types, to what free energies of residues say in the
    mean over molecules."""
    for _ in range(_PASSES):
        types, lacking = [], []
        for frames in (Equilibrium.of(model, sequence, n_frames=_SIGNED_FRAMES) for sequence in sequences):
            chain, endless = frames.chain, model.config.forgotten_ps
            likely = (frames.weights / frames.weights.sum()) @ positive_phis(model, frames, endless)
            for residue, found in zip(chain.signed, likely.logit().tolist(), strict=True):
                kt = positive_phi_kt.get(chain.code.layout.types[residue])
                if kt is not None:
                    types.append(chain.places[residue, :3].tolist())
                    lacking.append(-kt - found)
        levels = levels_of_types(model.jumps, types, lacking, _RIDGE)
        model.jumps.raise_change(0, 0, 1, levels)
        model.jumps.raise_change(0, 1, 0, -levels)


class Step(NamedTuple):
    """Of windows, how far probabilities are from the teacher's (Kullback-Leibler divergence per frame and torsion); and
    of every two states of a torsion, by either half of the windows, the logarithms of how many more go one way than the
    other, `unbalanced` (2, k), and of how many more go than by the teacher, `faster` (2, k), and what these count (k,),
    at most 1."""

    divergence: Tensor
    unbalanced: Tensor
    faster: Tensor
    counts: Tensor

    def square(self, what: Tensor) -> Tensor:
        """Return the mean square (k,) of what halves say, as it counts. Their product leaves their chance out, which a
        training would else make less by probabilities that are alike in all frames, and higher."""
        return self.counts * what.prod(dim=0)

    @property
    def loss(self) -> Tensor:
        return (self.square(self.unbalanced) + self.square(self.faster)).sum() / max(1, len(self.counts))


def step(
    model: PeptideSlide, teacher: PeptideSlide, frames: Equilibrium, rows: Tensor, times_ps: Tensor,
    generator: torch.Generator,
) -> Step:  # fmt: skip
    """Draw states at `times_ps` (t,) after the frames `rows` (b,) by `model`, and compare probabilities."""
    chain, counts, weights = frames.chain, frames.chain.stated.counts, frames.weights[rows]
    observed, now, times = frames.observed[rows], frames.states[rows], times_ps.expand(len(rows), -1)
    given = chain.places, counts, times, times_apart(times, model.config.forgotten_ps)
    with torch.no_grad():
        uniform = torch.rand(*times.shape, *counts.shape, generator=generator)
        later = model.jumps_of(chain).draw(observed, now, *given, uniform)
        states = torch.cat([now[:, None], later], dim=1)
        taught = list(teacher.jumps_of(chain).of_windows(observed, states, *given))
    divergence, found = observed.new_zeros(()), [observed.new_zeros(5, 0)]
    own = model.jumps_of(chain).of_windows(observed, states, *given)
    for (torsion, has, logits), (*_, wanted) in zip(own, taught, strict=True):
        # States that a torsion lacks are infinitely unlikely to both.
        target, ours = (x.log_softmax(-1).masked_fill(torch.isinf(wanted), 0.0) for x in (wanted, logits))
        divergence = divergence + (wanted.softmax(-1) * (target - ours)).sum()
        signs = torch.tensor([not torsion and r in chain.signed for r in has.tolist()])
        before = F.one_hot(states[:, :-1, has, torsion], MOST_STATES).float()
        # Fluxes (2, n, from, to) of either half, and as many frames as the weights of those in a state are worth.
        flux, known = (
            torch.stack([torch.einsum("btna,btnc,b->nac", before[k::2], x[k::2], weights[k::2]) for k in (0, 1)])
            .clamp(min=1e-9).log() for x in (logits.softmax(-1), wanted.softmax(-1))
        )  # fmt: skip
        worth = torch.stack([
            torch.einsum("bna,b->na", before[k::2, 0], weights[k::2]).square()
            / torch.einsum("bna,b->na", before[k::2, 0], weights[k::2].square()).clamp(min=1e-9) for k in (0, 1)
        ])  # fmt: skip
        for a, b in combinations(range(MOST_STATES), 2):
            enough = torch.minimum(worth[..., a], worth[..., b]).amin(0) >= _LEAST_FRAMES
            both = flux[..., a, b], flux[..., b, a]
            # How often phi > 0 is entered no run tells: only how often it is left is to stay.
            pace = torch.where(signs, known[..., b, a], (known[..., a, b] + known[..., b, a]) / 2)
            faster = sum(both) / 2 - pace
            counted = _DIFFER / (_DIFFER + 1.0 / worth[..., a].sum(0) + 1.0 / worth[..., b].sum(0))
            found.append(torch.cat([both[0] - both[1], faster, counted[None]])[:, enough])
    n, each = times.numel() * max(1, int((counts > 0).sum())), torch.cat(found, dim=1)
    return Step(divergence / n, each[:2], each[2:4], each[4])


def some_lags(model: PeptideSlide, generator: torch.Generator) -> Tensor:
    """Return the times `(t,)` of a chunk's frames, evenly spaced by a lag drawn evenly in its logarithm, half of the
    chunks whole."""
    c = model.config
    lag_ps = c.shortest_ps * (c.longest_ps / c.shortest_ps) ** float(torch.rand(1, generator=generator))
    most = max(1, min(c.chunk_frames, int(c.longest_ps / lag_ps)))
    whole = torch.rand(1, generator=generator) < 0.5
    return lag_ps * torch.arange(1, 1 + (most if whole else int(torch.randint(1, 1 + most, (1,), generator=generator))))


def teach(start: Path, out: Path, n_molecules: int, steps: int, equilibrium: Path | None = None) -> Path:
    """Write weights that keep the equilibrium of those of `start`, or of others. Raises SimulationError when training
    diverges."""
    weights, source = load_weights(start), load_weights(equilibrium or start)
    copied = load_weights(source.path)
    teacher, endless_teacher, model = (cast(PeptideSlide, w.model) for w in (weights, source, copied))
    model.requires_grad_(True)
    sequences = [peptide.sequence for peptide in wide_peptides()]
    trained, held = sequences[:-_HELD], sequences[-_HELD:]
    trained = trained[:: max(1, len(trained) // n_molecules)][:n_molecules]
    energies = trained_with(weights.provenance)
    if energies:
        set_signs(endless_teacher, [*sequences[: len(RESIDUES)], *trained[:: max(1, n_molecules // _SIGNED)]], energies)
        model.jumps.load_state_dict(endless_teacher.jumps.state_dict())

    @cache
    def frames_of(sequence: str) -> Equilibrium:
        return Equilibrium.of(endless_teacher, sequence)

    def loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        frames = frames_of(trained[int(torch.randint(len(trained), (1,), generator=generator))])
        rows = torch.randint(len(frames.states), (_WINDOWS,), generator=generator)
        endless = bool(torch.rand(1, generator=generator) < _ENDLESS_SHARE)
        forgotten = torch.full((_ENDLESS_FRAMES,), model.config.forgotten_ps)
        times = forgotten if endless else some_lags(model, generator)
        found = step(model, endless_teacher if endless else teacher, frames, rows, times, generator)
        total = found.divergence if endless else found.divergence + _BALANCE * found.loss
        return total, {"divergence": found.divergence.detach(), "unbalanced": found.loss.detach()}

    @torch.no_grad()
    def validate() -> dict[str, float]:
        curves = {}
        for lag_ps, n in _VALIDATED:
            each = []
            for sequence in held:
                frames, generator = frames_of(sequence), torch.Generator().manual_seed(0)
                times = lag_ps * torch.arange(1, 1 + n)
                each.append(step(model, teacher, frames, torch.arange(len(frames.states)), times, generator))
            counts = sum(float(e.counts.sum()) for e in each)
            for name in ("unbalanced", "faster"):
                square = sum(float(e.square(getattr(e, name)).sum()) for e in each) / counts
                curves[f"validation_{name}_{lag_ps:g}ps"] = math.sqrt(max(0.0, square))
            curves[f"validation_divergence_{lag_ps:g}ps"] = float(np.mean([float(e.divergence) for e in each]))
        return curves

    def write(spent_s: list[float]) -> None:
        settings = {"keeps_equilibrium": True, "steps": steps, "molecules": n_molecules,
                    "spent_s": round(sum(spent_s), 1)}  # fmt: skip
        if equilibrium is not None:
            settings |= {"equilibrium": source.hash, "umbrella_states": source.provenance.get("umbrella_states", 0)}
        save_weights(out, model, source.domain, provenance_of({}, settings, weights), half=True)

    stage = StageConfig("equilibrium", _WINDOWS, _RATE, None, steps, bf16=False, validate_every_s=_VALIDATE_S)
    train_stages([Stage(model.jumps, stage, loss, validate)], out, write, device=torch.device("cpu"), resume=True)
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", required=True)
    parser.add_argument("--equilibrium")
    parser.add_argument("--molecules", type=int, default=160)
    parser.add_argument("--steps", type=int, default=1600)
    a = parser.parse_args(arguments)
    equilibrium = None if a.equilibrium is None else weights_path(a.equilibrium)
    teach(weights_path(a.weights), a.out, a.molecules, a.steps, equilibrium)


if __name__ == "__main__":
    main()
