"""Train the model of peptides (`models.peptides.model`) on runs of many sequences: one flow, no first stage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import EllipsisType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from surrogate.data import FrameSets, References, Survey, TrainingFrames
from surrogate.models import architecture as arch
from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.trainer import REVERSIBLE, TAU_MAX, pick
from surrogate.models.peptides import chains
from surrogate.models.peptides.balance import balance
from surrogate.models.peptides.layout import (
    ENDS,
    PeptideConfig,
    chain_features,
    chain_layout,
    chain_scale,
    standard_peptide,
    unknown_coordinates,
)
from surrogate.models.peptides.model import PeptideSlide, times_apart
from surrogate.models.peptides.subjects import PeptideSubject, StateWindows
from surrogate.models.weights import (
    TrainingDomain,
    Weights,
    load_weights,
    provenance_of,
    read_header,
    save_weights,
    training_domain,
)
from surrogate.training.loop import ProgressFn, Stage, StageConfig, train_stages
from systems.errors import InputError

_MEASURED_FRAMES = 4000
_MEASURED_PAIRS = 4000
_LEAST_MEASURED = 300
# Of one molecule; of many fewer of each, so that validation stays a small share of a training.
_HELD_WINDOWS, _LEAST_HELD, _HELD_IN_ALL = 128, 16, 1024
# Flow times and noise of validation are the same each time.
_HELD_SEED = 0
# Of the budget, for the probabilities that torsions change their states: a small network, of which a step costs a
# tenth. In each of their windows a share of hidden numbers is left out, since sequences are few; but none in the end of
# their budget, else changes come too often.
JUMPS_SHARE, _DROPPED, _ENDING_SHARE = 0.2, 0.2, 0.1
_JUMPS_BATCH = 128
# Molecules of which the domain of weights keeps all that is checked.
_WHOLE = 40
TUNED = ("all", "flow", "states")
# Torsions' numbers vary by at least this: omega's cosine is all but constant, and nothing is learned of its rounding.
_LEAST_SCALE = 0.05


@dataclass(frozen=True)
class PeptideTraining:
    """Optimisation (AdamW, EMA 0.999), in seconds of training or steps.

    `time_reversal`: windows are read backwards, too, and frames drawn from equilibrium stand for endless times, both
    weighted by a Markov model of each molecule (`models.peptides.subjects`). `positive_phi_kt`: of residue types, the
    free energy of phi > 0 over phi < 0 in kT, which every solvent is taken to have. `tuned`: of weights that training
    goes on from, 'all', the 'flow' alone, or the probabilities of 'states' alone, these in the solvents of the frames:
    in others such weights stay what they are.
    """

    budget_s: float | None = None
    steps: int | None = None
    batch: int = 64
    learning_rate: float = 1e-3
    seed: int = 0
    bf16: bool = True
    device: str = "cpu"
    time_reversal: bool = False
    positive_phi_kt: dict[str, float] = field(default_factory=dict)
    tuned: str = "all"
    validate_every_s: float = 120.0


def train_peptides(
    sets: Sequence[TrainingFrames], out: str | Path, config: PeptideConfig, training: PeptideTraining, *,
    unseen: Sequence[TrainingFrames] = (), start: Weights | None = None, resume: bool = False,
    progress: ProgressFn | None = None,
) -> Path:  # fmt: skip
    """Train on frames of several sequences and write `out` (.safetensors); beside it a CSV of the curves: first the
    flow, conditioned on the states of torsions, then the probabilities of these states, which share nothing with it.

    `unseen`: sequences held out whole, whose loss the curves show. `start`: weights to go on from, with their scales;
    a solvent that these do not know begins as their first. Sequences of several solvents make weights that take one.
    Raises InputError for scenes that are no chains, SimulationError when training diverges.
    """
    out = Path(out)
    torch.manual_seed(training.seed)
    if training.tuned not in TUNED:
        raise InputError(f"`tuned` is one of {', '.join(TUNED)}, not {training.tuned!r}.")
    if training.tuned != "all" and start is None:
        raise InputError(f"`tuned='{training.tuned}'` goes on from weights, most of which it keeps; give them.")
    if start is not None:
        # Trained further, a flow forgets the few steps that it was distilled to.
        kept = start.model.config if training.tuned == "states" else config
        config = replace(start.model.config, usual_steps=kept.usual_steps, usual_solver=kept.usual_solver,
                         coupled=start.model.config.coupled or config.coupled)  # fmt: skip
    config = with_scale(in_solvents(config, sets, start), sets)
    device = torch.device(training.device)
    model = PeptideSlide(config).to(device)
    subjects, held_out = (
        [PeptideSubject(f, chain_features(f.scene, config, f.conditions.get("solvent")).to(device)) for f in some]
        for some in (sets, unseen)
    )
    normalise(model, subjects, training.seed)
    measured = [kind for subject in subjects for kind in model.kinds(subject.chain).tolist()]
    if start is not None:
        known = cast(PeptideSlide, start.model)
        _go_on_from(known, model)
        # A flow that stays needs the means and scales that it was trained with.
        measured = [*range(len(known.token_mean)), *(measured if training.tuned == "all" else ())]
    _fill_unseen(model, measured)
    if training.time_reversal:
        subjects = [subject.in_equilibrium(training.positive_phi_kt) for subject in subjects]
    of_jumps = {"all": JUMPS_SHARE, "flow": 0.0, "states": 1.0}[training.tuned]
    flow_s, jumps_s = (
        None if training.budget_s is None else share * training.budget_s for share in (1 - of_jumps, of_jumps)
    )
    of_flow = StageConfig(
        "flow", training.batch, training.learning_rate, flow_s, training.steps, seed=training.seed, bf16=training.bf16,
        validate_every_s=training.validate_every_s,
    )  # fmt: skip
    of_states = replace(of_flow, name="jumps", batch=_JUMPS_BATCH, budget_s=jumps_s, bf16=False)
    n_held = min(_HELD_WINDOWS, max(_LEAST_HELD, _HELD_IN_ALL // (len(subjects) + len(held_out))))
    held = [
        (name, subject, *subject.windows(n_held, config, torch.Generator().manual_seed(_HELD_SEED),
                                         validation=name == "validation"))
        for name, some in (("validation", long_enough(subjects, config)), ("unseen", held_out)) for subject in some
    ]  # fmt: skip

    def flow_loss(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        subject = subjects[pick(subjects, generator)]
        idx, times = subject.batch(training.batch, config, generator)
        return peptide_loss(model, subject.chain, *subject.seen(model, idx), times.to(device), generator)

    pools: dict[int, StateWindows] = {}

    def jumps_loss(generator: torch.Generator, *, dropped: float) -> tuple[Tensor, dict[str, Tensor]]:
        which = pick(subjects, generator)
        subject = subjects[which]
        if which not in pools:
            pools[which] = StateWindows.of(subject, config)
        idx, times, share = pools[which].draw(_JUMPS_BATCH, generator)
        observed = disturbed(subject.seen(model, idx[:, 0])[0], subject.chain, config, generator)
        states = subject.states(idx).to(device)
        given = (observed, states, times.to(device), generator)
        loss = state_loss(model, subject.chain, *given, share=share.to(device), dropped=dropped)
        return loss, {"jumps": loss.detach()}

    @torch.no_grad()
    def validate(stage: StageConfig) -> dict[str, float]:
        found: dict[str, list[float]] = {}
        for name, subject, idx, times in held:
            generator = torch.Generator().manual_seed(_HELD_SEED)
            numbers, states = subject.seen(model, idx)
            if stage.name != "flow":
                loss = state_loss(model, subject.chain, numbers[:, 0], states, times.to(device), generator)
                terms = {"jumps": loss}
            else:
                with torch.autocast(device.type, dtype=torch.bfloat16, enabled=stage.bf16):
                    given = (numbers, states, times.to(device), generator)
                    terms = peptide_loss(model, subject.chain, *given, noisy=False)[1]
            for key, value in terms.items():
                found.setdefault(f"{name}_{key}", []).append(float(value))
        return {key: float(np.mean(values)) for key, values in found.items()}

    domain = peptides_domain(sets, config, start.domain if start is not None and training.tuned != "all" else None)

    def write(spent_s: list[float]) -> None:
        settings: dict[str, Any] = {"seed": training.seed, "spent_s": round(sum(spent_s), 1)}
        if training.positive_phi_kt:
            settings["positive_phi_kt"] = training.positive_phi_kt
        save_weights(out, model, domain, provenance_of(FrameSets(tuple(sets)).origin, settings, start))

    def in_turn() -> Iterator[Stage]:
        if training.tuned != "states":
            yield Stage(model.flow, of_flow, flow_loss, partial(validate, of_flow))
        if training.tuned != "flow":
            for name, share, dropped in (("jumps", 1 - _ENDING_SHARE, _DROPPED), ("ending", _ENDING_SHARE, 0.0)):
                stage = replace(of_states.part(share), name=name)
                yield Stage(model.all_jumps, stage, partial(jumps_loss, dropped=dropped), partial(validate, stage))
            balance(model, subjects)

    train_stages(in_turn(), out, write, device=device, resume=resume, progress=progress)
    return out


def long_enough(subjects: Sequence[PeptideSubject], config: PeptideConfig) -> list[PeptideSubject]:
    """Return the peptides of which the part held out is longer than a chunk, all of them where none is."""

    def held(subject: PeptideSubject) -> int:
        ranges = subject.frames.split.ranges(subject.frames.starts, validation=True)
        return max((high - low for low, high in ranges), default=0)

    return [subject for subject in subjects if held(subject) > config.chunk_frames] or list(subjects)


def peptides_domain(
    sets: Sequence[TrainingFrames], config: PeptideConfig, start: TrainingDomain | None = None
) -> TrainingDomain:
    """Return the domain of weights for peptides: of each solvent the smallest molecules, whose own frames say what is
    valid, and the names of all others. `start`: of weights of which a part stays; what they cover stays covered."""
    smallest: dict[str, dict[str, TrainingFrames]] = {}
    for frames in sorted(sets, key=lambda frames: (frames.scene.n_atoms, frames.lag_ps)):
        of_solvent = smallest.setdefault(str(frames.conditions.get("solvent")), {})
        of_solvent.setdefault("-".join(frames.scene.residue_names), frames)
    # One molecule says nothing of others, whatever the weights covered that it was trained from.
    several = len({f.scene.topology_hash for f in sets}) > 1
    found: list[TrainingDomain] = []
    for solvent in config.solvents or smallest:
        some, covered = smallest.get(solvent, {}), []
        if start is not None and start.transferable == several:
            members = (replace(member, further=()) for member in start.members)
            covered = [member for member in members if str(member.conditions.get("solvent")) == solvent]
        if covered and several and all(f.conditions == covered[0].conditions for f in some.values()):
            known = replace(covered[0], further=tuple(covered[1:])).peptides
            larger = ("-".join(member.scene.residue_names) for member in covered[_WHOLE:])
            new = (name for name in some if tuple(name.split("-")) not in known)
            covered = [replace(covered[0], sequences=(*covered[0].sequences, *larger, *new)), *covered[1:_WHOLE]]
        elif some:
            kept = list(map(id, list(some.values())[:_WHOLE]))
            whole = [training_domain(f, strides=_strides(config, f)) for f in sets if id(f) in kept]
            covered = [replace(one, sequences=tuple(some)[_WHOLE:] if one is whole[0] else ()) for one in whole]
        found += covered
    return replace(found[0], further=tuple(found[1:]), transferable=several)


def _strides(config: PeptideConfig, frames: TrainingFrames) -> tuple[int, ...]:
    """Return the lags in frames at which jumps are measured, as far as the runs reach."""
    most = max(high - low for low, high in frames.split.ranges(frames.starts, validation=False)) - 1
    whole = (config.lags_ps / frames.lag_ps).round().long().clamp(1, most)
    return tuple(sorted(set(whole.tolist())))


def in_solvents(config: PeptideConfig, sets: Sequence[TrainingFrames], start: Weights | None) -> PeptideConfig:
    """Return the configuration with the solvents of the weights gone on from and of frames, where there are several."""
    known = config.solvents or (() if start is None else (str(start.domain.conditions.get("solvent")),))
    found = tuple(dict.fromkeys((*known, *(str(frames.conditions.get("solvent")) for frames in sets))))
    return replace(config, solvents=found if len(found) > 1 else ())


def with_scale(config: PeptideConfig, sets: Sequence[TrainingFrames]) -> PeptideConfig:
    """Return the configuration with the types and scales of residues that frames show, where it lacks any.

    Raises InputError for a residue type that is none of those it has.
    """
    layouts = [chain_layout(frames.scene) for frames in sets]
    if config.scale is not None:
        for layout in layouts:
            config.places(layout.types)
        lacking = [k for k, one in enumerate(layouts) if unknown_coordinates(one, config.scale)]
        sets, layouts = [sets[k] for k in lacking], [layouts[k] for k in lacking]
        if not sets:
            return config
    share = max(200, _MEASURED_FRAMES // len(sets))
    shown = ((layout, frames.some_nm(share)) for layout, frames in zip(layouts, sets, strict=True))
    types = config.types or tuple(sorted({name for layout in layouts for name in layout.types}))
    return replace(config, scale=chain_scale(shown, config.scale), types=types)


def _go_on_from(start: PeptideSlide, model: PeptideSlide) -> None:
    """Give `model` the weights of `start`, and for the numbers that this has its means, scales and correlations."""
    own = {name: tensor.clone() for name, tensor in model.named_buffers()}
    whole = model.state_dict()
    with torch.no_grad():
        for name, tensor in start.state_dict().items():
            # New numbers come after those of `start`, new solvents after its own, which begin as its first.
            whole[name][tuple(slice(n) for n in tensor.shape)] = tensor
    for jumps in list(model.all_jumps)[len(start.all_jumps) :]:
        jumps.load_state_dict(model.jumps.state_dict())
    assert start.config.scale is not None and model.config.scale is not None
    for key in model.config.scale.slots.keys() - start.config.scale.slots.keys():
        places = _places(model.config, key)
        for name in ("token_mean", "token_scale", "correlation"):
            getattr(model, name)[places] = own[name][places]


def _fill_unseen(model: PeptideSlide, seen: Sequence[int]) -> None:
    """Give residue types in a further solvent that are not among those `seen` the numbers that they have in the
    first."""
    n_types = model.config.n_types
    for kind in set(range(n_types, len(model.token_mean))) - set(seen):
        for table in (model.token_mean, model.token_scale, model.correlation):
            table[kind] = table[kind % n_types]


def _places(config: PeptideConfig, key: str) -> tuple[slice, EllipsisType, slice]:
    """Return where a coordinate's numbers stand in `(n_kinds, ..., n_slots)`: of its residue's type in every solvent,
    or, where it is a free end's, of all types."""
    assert config.scale is not None
    slot, bearer = config.scale.slots[key], key.split()[0]
    kinds = slice(None)
    if bearer not in chains.FREE_ENDS:
        kinds = slice((*ENDS, *config.types).index(bearer), None, config.n_types)
    return kinds, ..., slice(slot, slot + (1 if key in config.scale.mean else 2))


@torch.no_grad()
def normalise(model: PeptideSlide, subjects: Sequence[PeptideSubject], seed: int) -> None:
    """Measure what centres and scales each residue type's numbers in each solvent, and their correlations in time, and
    set them. A torsion's cosine and sine share one scale and one correlation; a free end's numbers are alike in all
    residues."""
    assert model.config.scale is not None
    slots = model.config.scale.slots
    of_ends = [_places(model.config, key) for key in slots if key.split()[0] in chains.FREE_ENDS]
    of_turning = [_places(model.config, key) for key in slots if key not in model.config.scale.mean]
    rng = np.random.default_rng(seed)
    lags = model.config.lags_ps
    n_kinds, _, n_slots = model.token_mean.shape

    def of_all_types(sums: Tensor) -> None:
        for _, _, place in of_ends:
            each = sums[..., place].unflatten(1, (-1, model.config.n_types))
            sums[..., place] = each.sum(2, keepdim=True).expand_as(each).flatten(1, 2)

    sums = torch.zeros(3, n_kinds, chains.MOST_STATES, n_slots, dtype=torch.float64)
    for subject in subjects:
        kinds = model.kinds(subject.chain).tolist()
        _count_middles(sums, subject, kinds)
        frames = torch.from_numpy(subject.frames.some_nm(_MEASURED_FRAMES // len(subjects) + _LEAST_MEASURED))
        tokens, states = subject.chain.code.encode(frames).double(), subject.chain.states(frames)
        own = subject.chain.state_of_numbers(states)
        for r, number in enumerate(kinds):
            for state in range(chains.MOST_STATES):
                inside = (own[:, r] == state) & subject.chain.code.filled[r]
                for power in range(3):
                    sums[power, number, state] += (tokens[:, r].pow(power) * inside).sum(0)
    of_all_types(sums)
    mean = sums[1] / sums[0].clamp(min=1)
    within = (sums[2] - sums[0] * mean.square()).clamp(min=0).sum(1)
    variance = within / sums[0].sum(1).clamp(min=1)
    for places in of_turning:
        variance[places] = variance[places].mean(-1, keepdim=True)
    scale = variance.sqrt().clamp(min=_LEAST_SCALE)
    model.token_mean.copy_(mean)
    model.token_scale.copy_(scale)
    products = torch.zeros(3, n_kinds, len(lags), n_slots, dtype=torch.float64)
    for subject in subjects:
        for k, lag in enumerate((lags / subject.frames.lag_ps).round().long().tolist()):
            if lag == 0:
                continue
            try:
                starts = subject.frames.window_starts(lag + 1, validation=False)
            except InputError:
                continue
            first = torch.from_numpy(rng.choice(starts, size=min(_MEASURED_PAIRS // len(subjects) + 100, len(starts))))
            both = subject.seen(model, torch.stack([first, first + lag]))[0].double()
            for r, number in enumerate(model.kinds(subject.chain).tolist()):
                x, y = both[0, :, r], both[1, :, r]
                for what, value in enumerate((x * y, x * x, y * y)):
                    products[what, number, k] += value.sum(0)
    of_all_types(products)
    for places in of_turning:
        products[:, *places] = products[:, *places].mean(-1, keepdim=True)
    found = products[0] / (products[1] * products[2]).sqrt().clamp(min=1e-12)
    model.correlation.copy_(found.clamp(0.0, 1.0))


def _count_middles(sums: Tensor, subject: PeptideSubject, kinds: Sequence[int]) -> None:
    """Count one frame in the middle of each state, so that states never seen have a mean."""
    stated, slots = subject.chain.stated, subject.chain.state_at
    for residue, slot, middles in zip(stated.residue.tolist(), stated.slot.tolist(), stated.middles_deg, strict=True):
        number, at = kinds[residue], int(torch.nonzero(slots[residue] == slot)[0])
        for place, value in ((at, middles.deg2rad().cos()), (at + 1, middles.deg2rad().sin())):
            sums[:, number, :, place] += torch.stack([value**power for power in range(3)]).double()


def peptide_loss(
    model: PeptideSlide, chain: chains.ChainFeatures, numbers: Tensor, states: Tensor, times_ps: Tensor,
    generator: torch.Generator, *, noisy: bool = True,
) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Flow matching on the innovations of windows: `numbers` (b, 1 + t, r, slots) and `states` (b, 1 + t, r,
    MOST_TORSIONS), the first frame given.

    The error is divided by c_out^2, so that every flow time asks for the same relative precision. `noisy`: the given
    frame is disturbed as in training. Returns the loss and its parts: of torsions' numbers, of stiff ones.
    """
    c, filled = model.config, chain.code.filled
    observed, later = numbers[:, 0], numbers[:, 1:]
    if noisy:
        observed = disturbed(observed, chain, c, generator)
    target = model.innovations(later, observed, times_ps, model.kinds(chain))
    draws = torch.randn(len(numbers), generator=generator) * c.tau_scale + c.tau_location
    tau = torch.sigmoid(draws).clamp(max=TAU_MAX).to(numbers.device)
    noise = torch.randn(target.shape, generator=generator).to(numbers.device) * filled
    of_states = chains.conditioning_states(states, chain.stated.counts)
    conditioning = model.flow.conditioning(observed, times_ps, chain.places, of_states)
    found = model.flow(flow.mixed(target, noise, tau), tau, conditioning)
    weight = flow.expand(flow.preconditioning(tau)[1].square().reciprocal(), target)
    loss, turning, stiff = by_kind((found - target).square() * weight, chain, c)
    return loss, {"flow": loss.detach(), "turning": turning.detach(), "stiff": stiff.detach()}


def by_kind(error: Tensor, chain: chains.ChainFeatures, config: PeptideConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of squared errors `(b, t, r, slots)` in which torsions count more, that of torsions alone, and
    that of stiff numbers."""
    turning, stiff = chain.code.filled_turning, chain.code.filled_stiff
    of_turning, of_stiff = (error[..., which].mean() for which in (turning, stiff))
    share = config.turning_weight * turning.sum() / (config.turning_weight * turning.sum() + stiff.sum())
    return share * of_turning + (1 - share) * of_stiff, of_turning, of_stiff


def state_loss(
    model: PeptideSlide, chain: chains.ChainFeatures, observed: Tensor, states: Tensor, times_ps: Tensor,
    generator: torch.Generator, *, share: Tensor | None = None, dropped: float = 0.0,
) -> Tensor:  # fmt: skip
    """Return the negative log-likelihood of the changes of states: `observed` (b, r, slots) the given frame's numbers,
    `states` (b, 1 + t, r, MOST_TORSIONS), `times_ps` (b, t), `share` (b, r, MOST_TORSIONS) what each change counts,
    1 where it is not given. `dropped`: the share of hidden numbers that are left out."""
    jumps = model.jumps_of(chain)
    drawn = torch.rand(len(observed), 1, observed.shape[1], jumps.hidden.in_features, generator=generator)
    kept = ((drawn >= dropped) / (1 - dropped)).to(observed.device)
    apart = times_apart(times_ps, model.config.forgotten_ps)
    return jumps.loss(observed, states, chain.places, chain.stated.counts, times_ps, apart, share, kept)


def disturbed(
    observed: Tensor, chain: chains.ChainFeatures, config: PeptideConfig, generator: torch.Generator
) -> Tensor:
    """Return the given frame's numbers `(b, r, slots)` with the noise that training adds."""
    noise = torch.randn(observed.shape, generator=generator).to(observed.device)
    return observed + config.conditioning_noise * chain.code.filled * noise


# Share of the longest trajectory that a window may span: its end is held out.
_SPAN = 0.9


class PeptideTrainer(arch.Trainer):
    """One flow for peptides of any sequence and any spacing of frames."""

    goes_on = True
    learns_lags = True

    def choose(self, references: References, request: arch.TrainingRequest) -> tuple[arch.Choice, ...]:
        survey, found = references.survey, list[arch.Choice]()
        begins = request.start_from is None
        if begins and "shortest_ps" not in request.model and survey.lag_ps != PeptideConfig.shortest_ps:
            found.append(arch.Choice("model.shortest_ps", survey.lag_ps, "the references' spacing of frames"))
        if begins and "longest_ps" not in request.model:
            reach = int(_SPAN * min(survey.longest)) * survey.lag_ps
            if request.longest_lag_ps is not None:
                found.append(arch.Choice("model.longest_ps", request.longest_lag_ps, "`longest_lag_ps`"))
            elif reach < PeptideConfig.longest_ps:
                found.append(arch.Choice("model.longest_ps", reach, "as far as every reference reaches"))
        if "time_reversal" not in request.training and survey.equilibrium:
            found.append(REVERSIBLE)
        return tuple(found)

    def settings(self, request: arch.TrainingRequest) -> arch.Settings:
        model = request.model if request.start_from is None else read_header(request.start_from).config
        if request.start_from is not None:  # trained further, a flow forgets the few steps that it was distilled to
            model = {key: value for key, value in model.items() if key not in ("usual_steps", "usual_solver")}
        return arch.Settings(PeptideConfig.from_dict(model), request.settings(PeptideTraining), arch.RESOLVED)

    def prepare(self, references: References, request: arch.TrainingRequest) -> arch.Prepared:
        settings, sets = self.settings(request), references.sets()
        start = None if request.start_from is None else load_weights(request.start_from)

        def run(advance: arch.AdvanceFn) -> Path:
            done = {"flow": (0.0, 1 - JUMPS_SHARE), "ending": (1 - _ENDING_SHARE * JUMPS_SHARE, 1.0)}
            done["jumps"] = (done["flow"][1], done["ending"][0])

            def report(stage: str, share: float, metrics: dict[str, float]) -> None:
                low, high = done[stage]
                advance(stage, low + share * (high - low))

            trained, unseen = (list(map(_under_standard_names, some)) for some in (sets.trained, sets.unseen))
            return train_peptides(trained, request.out, settings.model, settings.training, unseen=unseen, start=start,
                                  resume=request.resume, progress=report)  # fmt: skip

        return arch.Prepared(sets.names, run)


def _under_standard_names(frames: TrainingFrames) -> TrainingFrames:
    """Return frames of a peptide from any program's file, atoms in the order and residues under the names of ours."""
    standard, order = standard_peptide(frames.scene)
    if standard.residue_names == frames.scene.residue_names and (order == np.arange(len(order))).all():
        return frames
    return replace(
        frames, scene=replace(standard, name=frames.scene.name), coordinates=frames.coordinates[:, order],
        velocities=None if frames.velocities is None else frames.velocities[:, order],
    )  # fmt: skip


def _suits(survey: Survey) -> tuple[int, str] | None:
    if len(survey.scenes) < 2:
        return None
    try:
        for scene in (*survey.scenes, *survey.unseen):
            chain_layout(scene)
    except InputError:
        return None
    return 10, f"{len(survey.scenes)} peptides, known by their residues in internal coordinates"


PEPTIDES = arch.Architecture("lam-slide-peptides", PeptideConfig.from_dict, PeptideSlide, PeptideTrainer, _suits)
