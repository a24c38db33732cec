"""Training of PAINET as a potential, by active learning from an expensive reference. States come from hot MD and turned
torsions, then from the model's own rollouts; those where the forces of its members spread most are labelled next."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NoReturn, Protocol

import numpy as np
import torch
from torch import Tensor

from surrogate.data import References
from surrogate.models import architecture as arch
from surrogate.models.painet.energy import PotentialConfig
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import TrainingDomain, Weights, load_weights, provenance_of, read_header, save_weights
from surrogate.training import loop
from surrogate.training.devices import StepThreads, torch_threads
from systems.chemistry.graph import turn_torsions
from systems.chemistry.validity import WIDENING, geometry_from_frames, limits_from_frames
from systems.errors import InputError, SimulationError
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K

# States with energies and forces: what a potential learns from, kept in a file of its own.

# So far above the lowest state, for each atom, that no rollout comes there: the potential energy of 1,200 K.
_HIGHEST_KJ_MOL = 15.0


@dataclass(frozen=True, eq=False)
class Samples:
    """`positions_nm` and `forces_kj_mol_nm` (n, n_atoms, 3), `energies_kj_mol` (n,), in float64; `held` (n,): whether a
    sample is kept for measuring errors and never trained on."""

    positions_nm: Any
    energies_kj_mol: Any
    forces_kj_mol_nm: Any
    held: Any

    def __len__(self) -> int:
        return len(self.energies_kj_mol)

    def joined(self, other: Samples) -> Samples:
        """Return both, without what lies too high above the lowest."""
        both = Samples(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(Samples)))
        highest = both.energies_kj_mol.min(initial=np.inf) + _HIGHEST_KJ_MOL * both.positions_nm.shape[1]
        return both.where(both.energies_kj_mol < highest)

    def where(self, chosen: Any) -> Samples:
        """Return those that are chosen, by a mask or by numbers."""
        return Samples(*(getattr(self, f.name)[chosen] for f in fields(Samples)))

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, energies and forces."""
        x, energies, forces, _ = (torch.from_numpy(np.ascontiguousarray(getattr(self, f.name))) for f in fields(self))
        return x, energies, forces

    def save(self, path: Path, molecule: str) -> None:
        """Write them whole or not at all; `molecule`: whose they are."""
        tensors = {f.name: torch.from_numpy(np.ascontiguousarray(getattr(self, f.name))) for f in fields(self)}
        loop.save_tensors(path, "surromd_samples", {"molecule": molecule}, tensors)

    @staticmethod
    def load(path: Path, molecule: str) -> Samples:
        """Read them back. Raises InputError for a damaged file or another molecule's."""
        record, tensors = loop.load_tensors(path, "surromd_samples")
        if record.get("molecule") != molecule:
            raise InputError(f"samples {path} are of another molecule; train again without `resume`.")
        return Samples(**{name: tensor.numpy() for name, tensor in tensors.items()})

    @staticmethod
    def none(n_atoms: int) -> Samples:
        empty = np.zeros((0, n_atoms, 3))
        return Samples(empty, np.zeros(0), empty, np.zeros(0, dtype=bool))


def conditions_of(config: PotentialConfig) -> dict[str, Any]:
    """Return the conditions under which weights of these settings stand for MD at the level they learned."""
    return {
        "force_field": "gfn2-xtb", "solvent": "vacuum", "temperature_k": config.temperature_k,
        "friction_per_ps": config.friction_per_ps, "timestep_ps": config.timestep_ps,
        "hydrogen_mass_da": config.hydrogen_mass_da, "constrain_hydrogens": config.constrain_hydrogens,
    }  # fmt: skip


def domain_of(scene: Scene, samples: Samples, moving: list[Any], config: PotentialConfig) -> TrainingDomain:
    """Return what the weights cover: what frames look like by the reference's quieter samples, and how far they move
    from one to the next by runs of cheap MD, `moving` (n, n_atoms, 3) each, hot ones among them."""
    quiet = samples.positions_nm[np.argsort(samples.energies_kj_mol)[: max(2, len(samples) // 2)]]
    looks = limits_from_frames(scene, quiet, quiet)
    before, after = (np.concatenate([run[part] for run in moving]) for part in (slice(-1), slice(1, None)))
    moves = limits_from_frames(scene, before, after)
    middles = [run[:, np.unique(moves.jump_idx)].mean(axis=1) for run in moving]
    drift_nm = max((np.linalg.norm(np.diff(m, axis=0), axis=-1).max(initial=0.0) for m in middles), default=0.0)
    jumps = {key: getattr(moves, key) for key in ("jump_idx", "jump_max_nm", "jump_min_nm")}
    # A few hundred samples are too few to know how far angles bend: cheap MD tells as well.
    angles: dict[str, Any] = {
        "angle_min_rad": np.minimum(looks.angle_min_rad, moves.angle_min_rad),
        "angle_max_rad": np.maximum(looks.angle_max_rad, moves.angle_max_rad),
    }
    limits = replace(looks, **jumps, **angles, drift_max_nm=WIDENING * float(drift_nm))
    geometry = geometry_from_frames(scene, quiet)
    return TrainingDomain(scene, config.lag_ps, conditions_of(config), geometry.to_dict(), limits.to_dict(), ())


# The share of the budget in which states are labelled; what is missing then is labelled at once, unless a resumption
# comes so late that it would hardly learn them.
_LABELLING_SHARE, _LAST_LABELLING_SHARE = 0.4, 0.7
# Most of the budget that new states and their answers may take.
_LABELLING_TIME_SHARE = 0.3
# Fewer new states than this are not worth a round.
_FEWEST = 8
# Least share of it that is for steps, whatever stands before and after them.
_LEARNING_SHARE = 0.3
# A sample is learned by a member with this chance.
_BAG = 0.75
# Own rollouts: replicas at least, steps, and frames kept of each.
_REPLICAS, _OWN_STEPS, _OWN_FRAMES = 48, 120, 4
# Every so many-th of them starts with a torsion turned to any angle.
_TURN_EVERY = 2
# Rounds the length of an error at zero, in units of the typical force squared.
_ROUND = 1e-8
# Held-out states at which the error is measured again and again, at most.
_MEASURED = 500
_OWN_STEP_PS = 0.0005
# Learning rates beside a new network's where weights are tuned: they know most of it.
_TUNING_RATE = 0.2
# Frames of cheap MD, at the own temperature and at the hottest each, on which it is measured how far frames move.
_MOVING_FRAMES = 200


class ReferenceForces(Protocol):
    """An expensive reference of one molecule's forces, as `md_reference.run.labeller` has it. `label` returns states
    with `positions_nm`, `energies_kj_mol` and `forces_kj_mol_nm`, without those at which it finds no answer."""

    @property
    def scene(self) -> Scene: ...

    def explore(self, n_states: int, temperatures_k: tuple[float, ...], *, seed: int) -> Any: ...

    def motion(
        self, n_frames: int, lag_ps: float, temperature_k: float, *, seed: int, constrain_hydrogens: bool = False
    ) -> Any: ...

    def label(self, positions_nm: Any) -> Any: ...


@dataclass(frozen=True)
class PotentialTraining:
    """Training settings. `first` states are labelled at once, then more in `rounds` up to `most`, until the mean
    absolute error of held-out forces is below `tolerance_kj_mol_nm`; `held_share` of them is never learned. `budget_s`:
    wall time of all that it takes, from the first states to the weights. `matrix_rate`: learning rate of matrices, by
    Muon. `energy_weight`: of energies beside forces in the loss. `temperatures_k`: of hot MD and own rollouts."""

    budget_s: float | None = None
    steps: int | None = None
    batch: int = 16
    learning_rate: float = 2e-3
    matrix_rate: float = 0.01
    energy_weight: float = 1.0
    first: int = 200
    most: int = 16_000
    rounds: int = 8
    held_share: float = 0.1
    tolerance_kj_mol_nm: float = 10.0
    temperatures_k: tuple[float, ...] = (300.0, 400.0, 500.0, 600.0, 700.0)
    seed: int = 0
    device: str = "cpu"
    validate_every_s: float = 60.0

    def __post_init__(self) -> None:
        if min(self.batch, self.rounds) < 1 or not 8 <= self.first <= self.most:
            raise InputError(
                f"batch = {self.batch} and rounds = {self.rounds} must be at least 1, first = {self.first} at least 8 "
                f"and at most `most` = {self.most}."
            )
        if not 0.0 < self.held_share < 1.0 or not self.temperatures_k:
            raise InputError("held_share must lie between 0 and 1, and temperatures_k name one temperature at least.")


class Learner:
    """A potential, its samples and its reference: `loss` learns, and labels new states when they are due; `errors`
    measures on held-out states."""

    def __init__(
        self, model: PainetPotential, reference: ReferenceForces, config: PotentialTraining, out: Path, *,
        resume: bool, pretrained: bool = False,
    ) -> None:  # fmt: skip
        self.model, self.reference, self.config, self._pretrained = model, reference, config, pretrained
        self.molecule = Molecule.of(reference.scene)
        self.topology = model.topology(self.molecule)
        self.path = samples_path(out)
        self.key = reference.scene.topology_hash
        self.samples = Samples.none(reference.scene.n_atoms)
        self.error_kj_mol_nm = np.inf
        # A budget is of wall time; so many steps are the same steps everywhere.
        self._threads = StepThreads(1 if config.budget_s is None else torch.get_num_threads())
        self._spent_s, self._steps = 0.0, 0
        curves = out.with_suffix(".csv")
        if resume and curves.exists() and (rows := [row for rows in loop.read_curves(curves).values() for row in rows]):
            self._spent_s, self._steps = float(rows[-1]["spent_s"]), int(rows[-1]["step"])
        if resume and self.path.exists():
            self.samples = Samples.load(self.path, self.key)
        self._budget_s, self._started = config.budget_s, time.monotonic()
        self._labelling = True
        self._labelling_s, self._labelled = 0.0, 0
        if len(self.samples):
            self._use()
        else:
            began = time.monotonic()
            self._label(
                reference.explore(config.first, config.temperatures_k, seed=config.seed), held=config.held_share
            )
            self._labelling_s, self._labelled = time.monotonic() - began, config.first
        # Samples may be all that an interrupted training left; a state that it left brings its own.
        x, energies, forces = self.samples.tensors()
        if pretrained:
            model.set_offset(x, energies, self.topology)
        else:
            model.set_scales(energies, forces)

    @property
    def share(self) -> float:
        """Share of the budget that is spent."""
        c = self.config
        shares = [0.0 if c.steps is None else self._steps / c.steps]
        if self._budget_s is not None:
            shares.append((self._spent_s + time.monotonic() - self._started) / self._budget_s)
        return max(shares)

    def begin(self, budget_s: float | None) -> None:
        """Start the clock of the steps, which have so long in all, those before a resumption counted."""
        self._budget_s, self._started = budget_s, time.monotonic()

    def loss(self, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean length of the error of an atom's force, in units of the typical force, and mean square error of
        energies. A length, since squares would have a few strained states outweigh all others. Each sample of a batch
        is answered by one of the members that learn from it."""
        self._label_if_due(generator)
        self._steps += 1
        self._threads.next_step()
        model, c = self.model, self.config
        x, energies, forces = self._tensors
        k = torch.randint(len(x), (c.batch,), generator=generator)
        member = torch.multinomial(self._bags[k], 1, generator=generator)[:, 0]
        at = x[k].requires_grad_(True)
        with torch.autocast(at.device.type, enabled=False):
            found = model.members(at, self.topology).gather(1, member[:, None])[:, 0]
            (gradient,) = torch.autograd.grad(found.sum(), at, create_graph=True)
        scale = model.energy_scale_kj_mol.double()
        wrong = (gradient + forces[k]) / (10.0 * scale)
        force = (wrong.square().sum(-1) + _ROUND).sqrt().mean()
        energy = ((found - energies[k]) / scale).square().mean()
        return force + c.energy_weight * energy, {"force": force.detach(), "energy": energy.detach()}

    def errors(self) -> dict[str, float]:
        """Errors on held-out states, of forces in kJ/mol/nm and of energies (less their mean) in kJ/mol; how many
        states have been labelled."""
        numbers = np.flatnonzero(self.samples.held)
        some = np.linspace(0, len(numbers) - 1, min(len(numbers), _MEASURED)).astype(int)
        x, energies, forces = self.samples.where(numbers[some]).tensors()
        parts = [self.model.evaluate(part, self.molecule) for part in x.split(256)]
        wrong = torch.cat([part.forces_kj_mol_nm for part in parts]) - forces
        off = torch.cat([part.energy_kj_mol for part in parts]) - energies
        self.error_kj_mol_nm = float(wrong.abs().mean())
        return {
            "validation_force_mae": self.error_kj_mol_nm,
            "validation_force_rms": float(wrong.square().mean().sqrt()),
            "validation_mean_force": float(forces.abs().mean()),
            "validation_energy_mae": float((off - off.mean()).abs().mean()),
            "validation_energy_spread": float(
                torch.cat([part.members_kj_mol for part in parts]).std(-1, correction=0).mean()
            ),
            "evaluations": float(len(self.samples)),
        }

    def _label_if_due(self, generator: torch.Generator) -> None:
        c, share = self.config, self.share
        have, last = len(self.samples), share >= _LABELLING_SHARE
        if not self._labelling or have >= c.most or self.error_kj_mol_nm < c.tolerance_kj_mol_nm:
            return
        growth = (c.most / c.first) ** (1.0 / c.rounds)
        due = c.most if last else c.first * growth ** (c.rounds * share / _LABELLING_SHARE)
        if due < min(have * growth, c.most):
            return
        n = round(due) - have
        if self._budget_s is not None and self._labelling_s:
            # As many as the time that is left for them allows, at the pace so far.
            left_s = _LABELLING_TIME_SHARE * self._budget_s - self._labelling_s
            n = min(n, round(left_s / self._labelling_s * self._labelled))
        self._labelling = not last and n >= _FEWEST
        if n < _FEWEST or share > _LAST_LABELLING_SHARE:
            return
        self._label_more(n, generator)

    def _label_more(self, n: int, generator: torch.Generator) -> None:
        """Label `n` states of own rollouts and, fewer, of hot MD: half of them where members spread most."""
        began = time.monotonic()
        seed = int(torch.randint(2**31, (), generator=generator))
        own = self._own_states(max(_REPLICAS, n // _OWN_FRAMES), seed)
        hot = self.reference.explore(max(n // 4, 8), self.config.temperatures_k, seed=seed)
        pool = np.concatenate([own, hot])
        order = np.random.default_rng(seed).permutation(len(pool))
        any_ = pool[order[: n // 2]]
        rest = pool[order[n // 2 :]]
        spread = torch.nan_to_num(self.model.spread(torch.from_numpy(rest), self.molecule), nan=0.0)
        unsure = rest[np.argsort(-spread.numpy())[: n - len(any_)]]
        self._label(any_, held=2 * self.config.held_share)
        self._label(unsure, held=0.0)
        self._labelling_s, self._labelled = self._labelling_s + time.monotonic() - began, self._labelled + n

    def _own_states(self, replicas: int, seed: int) -> Any:
        """Return finite states `(n, n_atoms, 3)` of short rollouts from samples, at the temperatures of hot MD."""
        rng, model = np.random.default_rng(seed), self.model
        start = self.samples.positions_nm[rng.integers(len(self.samples), size=replicas)]
        # Barriers are seldom crossed.
        turn_torsions(self.reference.scene, start, _TURN_EVERY, rng)
        temperatures = torch.from_numpy(rng.choice(self.config.temperatures_k, size=replicas))
        masses = self.molecule.masses_da.double()[:, None]
        thermal = (GAS_CONSTANT_KJ_MOL_K * temperatures[:, None, None] / masses).sqrt()
        x = torch.from_numpy(start)
        generator = torch.Generator().manual_seed(seed)
        v = thermal * torch.randn(x.shape, generator=generator, dtype=x.dtype)
        frames = []
        model.eval()
        for _ in range(_OWN_FRAMES):
            draw = torch.randn(*x.shape[:2], _OWN_STEPS // _OWN_FRAMES, 3, generator=generator, dtype=x.dtype)
            x, v = model.langevin(x, v, self.molecule, masses, thermal, draw, timestep_ps=_OWN_STEP_PS)
            frames.append(x)
        model.train()
        found = torch.cat(frames)
        return found[torch.isfinite(found).all(-1).all(-1) & (found.abs().amax((1, 2)) < 10.0)].numpy()

    def _label(self, states: Any, *, held: float) -> None:
        """Label states, of which a share is `held` out, and learn from them."""
        answers = self.reference.label(states)
        n = len(answers.energies_kj_mol)
        if not n:
            if not len(self.samples):
                raise SimulationError(f"the reference finds no answer for any state of {self.reference.scene.name!r}.")
            return
        kept = np.arange(n) < round(held * n)
        new = Samples(answers.positions_nm, answers.energies_kj_mol, answers.forces_kj_mol_nm, kept)
        self.samples = self.samples.joined(new)
        self.samples.save(self.path, self.key)
        self._use()

    def _use(self) -> None:
        learned = self.samples.where(~self.samples.held)
        if len(learned) < 2 or not self.samples.held.any():
            raise SimulationError(f"too few states of {self.reference.scene.name!r} have an answer to learn from.")
        self._tensors = learned.tensors()
        members = self.model.config.n_members
        draw = torch.rand(len(learned), members, generator=torch.Generator().manual_seed(1))
        # Each sample is somebody's.
        self._bags = ((draw < _BAG) | (draw == draw.amin(1, keepdim=True))).float()
        # What weights of other molecules know stays open: a few samples of this one are not all that it does.
        self.model.network.set_walls(self._tensors[0], self.topology, widen=self._pretrained)


def samples_path(out: Path) -> Path:
    """Return where the samples of weights lie."""
    return out.with_name(f"{out.stem}.samples.safetensors")


def learn_potential(
    reference: ReferenceForces, out: Path, network: PotentialConfig | Weights, config: PotentialTraining, *,
    resume: bool = False, progress: loop.ProgressFn | None = None, before_s: float = 0.0, after_s: float = 0.0,
) -> Path:  # fmt: skip
    """Learn a molecule's energies and forces and write weights `out`; beside them stay the samples and the curves
    (.csv). `network`: the settings of a new one, or weights to begin with. Of the budget `before_s` are spent already,
    and `after_s` are wanted by the caller, for later."""
    began = time.monotonic() - before_s
    torch.manual_seed(config.seed)
    start, model_config = (None, network) if isinstance(network, PotentialConfig) else (network, network.model.config)
    model = PainetPotential(model_config)
    if start is not None:
        model.load_state_dict(start.model.state_dict())
    if not resume:
        samples_path(out).unlink(missing_ok=True)
    # Frames change least in the own bath, with bonds as rigid as rollouts have them, and most when hot.
    moving = [
        reference.motion(_MOVING_FRAMES, model_config.lag_ps, kelvin, seed=config.seed, constrain_hydrogens=rigid)
        for kelvin, rigid in ((model_config.temperature_k, model_config.constrain_hydrogens),
                              (max(config.temperatures_k), False))
    ]  # fmt: skip
    learner = Learner(model, reference, config, out, resume=resume, pretrained=start is not None)
    budget_s = config.budget_s
    if budget_s is not None:
        left_s = budget_s - (time.monotonic() - began) - after_s
        budget_s = max(left_s, _LEARNING_SHARE * budget_s)
    slower = 1.0 if start is None else _TUNING_RATE
    stage = loop.StageConfig(
        "potential", config.batch, slower * config.learning_rate, budget_s, config.steps,
        matrix_rate=slower * config.matrix_rate, seed=config.seed, bf16=False,
        validate_every_s=config.validate_every_s,
    )  # fmt: skip

    def advance(name: str, share: float, metrics: dict[str, float]) -> None:
        error = f", force error {learner.error_kj_mol_nm:.3g} kJ/mol/nm" if np.isfinite(learner.error_kj_mol_nm) else ""
        if progress is not None:
            progress(f"{len(learner.samples)} evaluations{error}", share, metrics)

    def write(spent_s: list[float]) -> None:
        domain = domain_of(reference.scene, learner.samples, moving, model_config)
        # No MD of the reference was made: what it answered is the reference.
        origin = {"reference_ns": 0.0, "sources": [{"file": learner.path.name, "n_frames": len(learner.samples)}]}
        found = {k.removeprefix("validation_"): float(f"{v:.6g}") for k, v in learner.errors().items()}
        settings = {"seed": config.seed, "training_s": round(sum(spent_s), 1), **found}
        save_weights(out, model.eval(), domain, provenance_of(origin, settings, start))

    learner.begin(budget_s)
    stages = [loop.Stage(model, stage, learner.loss, learner.errors, saves=False)]
    with torch_threads(1):
        loop.train_stages(stages, out, write, device=torch.device("cpu"), resume=resume, progress=advance)
    return out


class PotentialTrainer(arch.Trainer):
    """Refuses trajectories, which say too little about forces; `learn` takes a molecule and its reference."""

    def check(self, request: arch.TrainingRequest) -> NoReturn:
        raise InputError(
            f"{request.arch} learns from forces that are computed for it; give a molecule, `arch='painet'` and "
            "`level='gfn2-xtb'`."
        )

    def settings(self, request: arch.TrainingRequest) -> arch.Settings:
        if request.start_from is not None and request.model:
            raise InputError("`start_from` takes the configuration of its weights; leave [model] of `config` out.")
        model = request.model if request.start_from is None else read_header(request.start_from).config
        return arch.Settings(PotentialConfig.from_dict(model), request.settings(PotentialTraining), arch.RESOLVED)

    def prepare(self, references: References, request: arch.TrainingRequest) -> arch.Prepared:
        self.check(request)

    def learn(self, reference: ReferenceForces, request: arch.TrainingRequest, advance: Callable[[str, float], None], *,
              before_s: float = 0.0, after_s: float = 0.0) -> Path:  # fmt: skip
        """Learn a molecule from its reference, as the request has it, and return the weights; see `learn_potential`."""
        settings = self.settings(request)
        network = settings.model if request.start_from is None else load_weights(request.start_from)
        return learn_potential(
            reference, request.out, network, settings.training, resume=request.resume,
            progress=lambda stage, share, metrics: advance(stage, share), before_s=before_s, after_s=after_s,
        )  # fmt: skip


PAINET_POTENTIAL = arch.Architecture("painet-potential", PotentialConfig.from_dict, PainetPotential, PotentialTrainer)
