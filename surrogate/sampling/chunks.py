"""Chunks that can be trusted: drawn from a model, checked, and helped where a guard catches a frame.

flag: caught frames are marked. resample: from the first caught frame on, the chunk is drawn again with another seed,
from the last valid frame; after four draws, from where the chunk began. repair: OpenMM restores bond lengths and
relaxes caught frames under restraints; what is not valid then is drawn again. fallback: real MD runs from the last
valid frame to the end of the chunk, and the surrogate takes over again.

A model that has got no chunk through yet, gives one without a frame that passes, and another in a second draw, is not
unlucky but wrong: the rollout stops. Under 'flag', which draws once, it stops at a chunk whose every frame is broken
(validity.INVALID) or stands still, and where, after some chunks or at its end, it has not got one through.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from time import perf_counter
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data import fitted_atoms
from surrogate.models.layers import with_lean_parts
from surrogate.models.potential import Potential
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.models.weights import TrainingDomain, Weights
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.coupling import Coupling, PotentialChecks
from surrogate.training.devices import choose_precision, keep_freed_memory, torch_threads
from systems.chemistry import validity
from systems.chemistry.geometry import FloatArray, superposition
from systems.errors import InputError, SimulationError

_Model = TypeVar("_Model", bound=Propagator)
# Up to as many replicas one thread was faster than two, on a pair of hardware threads: products of few rows are too
# small to be shared.
_ROWS_OF_ONE_THREAD = 16
# In steps of 4 fs replicas fly apart now and then at 600 K.
_HOT_STEP_PS = 0.0025


class Drawn(NamedTuple):
    """New frames `(b, n_new, n_atoms, 3)` nm and, of a model that carries them, the velocities `(b, n_atoms, 3)` nm/ps
    at the last of them; both in the pose of the frames that they follow."""

    frames_nm: FloatArray
    velocities_nm_ps: FloatArray | None


class ChunkSampler:
    """One model, ready to draw chunks: what a rollout does with the weights, and all that it does with them.

    Atoms are in the model's order throughout. `batch` is the most replicas computed at once: None for all, until
    memory runs out, and then half as many, for good. Raises InputError for a solver or precision that does not suit
    the weights.
    """

    def __init__(
        self, weights: Weights, *, solver_steps: int | None = None, solver: str | None = None, precision: str = "auto"
    ) -> None:
        model, template = weights.model, weights.domain.scene
        keep_freed_memory()
        known = model.solvers
        if solver is not None and solver not in known:
            raise InputError(
                f"the solver {solver!r} does not suit {weights.path.name}; "
                + (f"choose {' or '.join(known)}." if known else "its model has no solver; leave `solver` out.")
            )
        self.solver = solver or (known[0] if known else None)
        self.solver_steps = solver_steps or model.usual_steps
        self.precision = choose_precision(precision, suits=model.float32_layers is not None)
        self.batch: int | None = None
        # Chunks drawn, each row one, and the network evaluations they took together.
        self.drawn, self.evaluations = 0, 0.0
        self._model = with_lean_parts(with_bf16_weights(model) if self.precision.bf16 else model)
        # Frames that a chunk is conditioned on, and those in it.
        self.n_conditioning, self.n_new = model.n_conditioning, model.n_new
        self._molecule = model.featurise(template)
        self._fit = fitted_atoms(template)
        self._target = template.positions_nm - template.positions_nm[self._fit].mean(axis=0)

    def at(self, temperature_k: float, n_new: int, least_friction_per_ps: float = 0.0) -> ChunkSampler:
        """Return this sampler of a potential at another temperature, in NVT, for chunks of `n_new` frames; in steps
        that are stable at 600 K."""
        other, model = copy.copy(self), cast(Potential, self._model)
        other.n_new = n_new
        step_ps, lag_ps = model.config.timestep_ps, model.config.lag_ps
        if step_ps > _HOT_STEP_PS:
            step_ps = lag_ps / math.ceil(lag_ps / _HOT_STEP_PS - 1e-6)
        friction = max(model.config.friction_per_ps, least_friction_per_ps)
        bath = {"temperature_k": temperature_k, "ensemble": "nvt", "n_new": n_new, "timestep_ps": step_ps,
                "friction_per_ps": friction}  # fmt: skip
        other._model = model.in_bath(bath)
        return other

    @property
    def evaluations_per_chunk(self) -> float:
        """Network evaluations for a chunk of one replica, the mean of all that were drawn; 0 before any is."""
        return self.evaluations / self.drawn if self.drawn else 0.0

    def draw(
        self, last_frames_nm: FloatArray, seeds: Sequence[int], velocities_nm_ps: FloatArray | None = None
    ) -> Drawn:
        """Return the chunks that follow `last_frames_nm (b, n_conditioning, n_atoms, 3)`, row k drawn with `seeds[k]`.

        `velocities_nm_ps (b, n_atoms, 3)`: what the chunk before ended in; rows of NaN start from velocities that the
        noise draws. A row does not depend on the rows beside it, but for rounding. Frames come in the precision of
        `last_frames_nm`: in float64 they keep their accuracy however far from the origin the molecule lies.
        Raises SimulationError when memory does not suffice for a single replica.
        """
        parts: list[tuple[npt.NDArray[np.int64], Drawn]] = []
        for rows in _alike(velocities_nm_ps, len(seeds)):
            start = 0
            while start < len(rows):
                size = min(self.batch or len(rows), len(rows) - start)
                some = rows[start : start + size]
                given = velocities_nm_ps if velocities_nm_ps is None else velocities_nm_ps[some]
                if given is not None and np.isnan(given).any():
                    given = None
                try:
                    with torch_threads(1 if size <= _ROWS_OF_ONE_THREAD else torch.get_num_threads()):
                        parts.append((some, self._draw(last_frames_nm[some], [seeds[k] for k in some], given)))
                except (MemoryError, RuntimeError) as error:
                    if not _out_of_memory(error):
                        raise
                    if size == 1:
                        raise SimulationError(
                            "memory does not suffice for one replica; use smaller weights."
                        ) from error
                    self.batch = -(-size // 2)
                    continue
                start += size
        order = np.argsort(np.concatenate([rows for rows, _ in parts]))
        frames = np.concatenate([part.frames_nm for _, part in parts])[order]
        ends = [part.velocities_nm_ps for _, part in parts if part.velocities_nm_ps is not None]
        return Drawn(frames, np.concatenate(ends)[order] if ends else None)

    @torch.inference_mode()
    def _draw(self, last_frames_nm: FloatArray, seeds: Sequence[int], velocities: FloatArray | None) -> Drawn:
        kind = last_frames_nm.dtype
        last = last_frames_nm.astype(np.float64)
        n_atoms = last.shape[2]
        # One rigid motion per replica, that of its last frame, carried back onto the new frames. A potential needs no
        # pose, but what the noise draws (velocities) turns with the molecule.
        rotation, translation = superposition(last[:, -1], self._target, idx=self._fit)
        if isinstance(self._model, Potential):
            translation = -np.einsum("rij,rj->ri", rotation, last[:, -1].mean(axis=1))
        canonical = np.einsum("rij,rtnj->rtni", rotation, last) + translation[:, None, None, :]
        noise = draw_noise(self._model, n_atoms, [torch.Generator().manual_seed(seed) for seed in seeds])
        turned = None if velocities is None else np.einsum("rij,rnj->rni", rotation, velocities)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.precision.bf16):
            chunk = self._model.next_chunk(
                torch.from_numpy(canonical.astype(np.float32)), self._molecule, noise, solver_steps=self.solver_steps,
                solver=self.solver,
                last_velocities_nm_ps=None if turned is None else torch.from_numpy(turned.astype(np.float32)),
            )  # fmt: skip
        usual = self.solver_steps if self._model.solvers else 1
        self.drawn += len(seeds)
        self.evaluations += len(seeds) * (usual if chunk.evaluations is None else chunk.evaluations)
        moved = chunk.frames_nm.double().numpy() - translation[:, None, None, :]
        ends = None
        if chunk.velocities_nm_ps is not None:
            ends = np.einsum("rji,rnj->rni", rotation, chunk.velocities_nm_ps.double().numpy()).astype(kind)
        return Drawn(np.einsum("rji,rtnj->rtni", rotation, moved).astype(kind), ends)


def noise_seed(seed: int, replica: int, chunk: int, attempt: int = 0) -> int:
    """Return the seed of one replica's chunk; further attempts at the same chunk draw other noise."""
    text = f"{seed}/{replica}/{chunk}" + (f"/{attempt}" if attempt else "")
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def with_bf16_weights(model: _Model) -> _Model:
    """Return a copy whose matrix weights are bf16 already: autocast would round them anew in every evaluation."""
    copied = copy.deepcopy(model)
    for name, module in copied.named_modules():
        if isinstance(module, torch.nn.Linear) and not name.startswith(model.float32_layers or ()):
            module.to(torch.bfloat16)
    return copied


def _alike(velocities: FloatArray | None, n: int) -> list[npt.NDArray[np.int64]]:
    """Rows with velocities and rows without, which go into different calls of the model."""
    if velocities is None:
        return [np.arange(n)]
    without = np.isnan(velocities).any(axis=(1, 2))
    return [rows for rows in (np.flatnonzero(~without), np.flatnonzero(without)) if len(rows)]


def _out_of_memory(error: BaseException) -> bool:
    words = ("out of memory", "not enough memory", "can't allocate memory")
    return isinstance(error, MemoryError | torch.OutOfMemoryError) or any(w in str(error).lower() for w in words)


# Guard of a rollout: checks every frame as it is made, before it is written or conditions the next chunk.

Flags = npt.NDArray[np.uint16]
# Any of these bits, and a frame does not pass.
CAUGHT = (
    validity.INVALID
    | validity.ANGLE
    | validity.PLANARITY
    | validity.JUMP
    | validity.DRIFT
    | validity.ENERGY
    | validity.STILL
    | validity.UNSURE
)


class Guard:
    """The checks of one training domain, with thresholds that its reference set (`systems.chemistry.validity`,
    `.limits`)."""

    def __init__(self, domain: TrainingDomain) -> None:
        self._geometry = validity.Geometry.from_dict(domain.geometry)
        self._limits = None if domain.limits is None else validity.Limits.from_dict(domain.limits)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """What is not checked, because the reference changes it or the weights are older than the check."""
        missing: tuple[str, ...] = ()
        if self._limits is None:
            missing = ("angles, flat centres, jumps, stillness and drift: the weights carry no limits",)
        elif self._limits.jump_min_nm == 0.0:
            missing = ("stillness: the weights carry no limit of it",)
        return (*self._geometry.excluded, *missing)

    def check(
        self, frames_nm: FloatArray, before_nm: FloatArray, *, from_start: bool = False, may_jump: bool = False
    ) -> Flags:
        """Return the flags `(b, n)` of frames `(b, n, n_atoms, 3)` nm that follow `before_nm (b, n_atoms, 3)`.

        `from_start`: the frames before are the user's structure, which need not be one of the ensemble, so that the
        first step away from it does not count as a jump; `may_jump`: none does.
        """
        n_rows, n_frames = frames_nm.shape[:2]
        flat = frames_nm.reshape(-1, *frames_nm.shape[2:])
        flags = validity.check_frames(flat, self._geometry)
        if self._limits is not None:
            previous = np.concatenate([before_nm[:, None], frames_nm[:, :-1]], axis=1).reshape(flat.shape)
            found = validity.check_limits(flat, self._limits, previous).reshape(n_rows, n_frames)
            if from_start or may_jump:
                found[:, : n_frames if may_jump else 1] &= ~np.uint16(validity.JUMP | validity.DRIFT)
            flags |= found.reshape(-1)
        return flags.reshape(n_rows, n_frames)


def caught(flags: Flags) -> npt.NDArray[np.bool_]:
    """Return which frames do not pass."""
    return cast(npt.NDArray[np.bool_], (flags & np.uint16(CAUGHT)) != 0)


# The column `intervention` of a trajectory: what a frame is, if it is not the surrogate's first draw.
DRAWN_AGAIN, REPAIRED, MD_AFTER_FAILURE = 1, 2, 3
MARKS = {DRAWN_AGAIN: "drawn again", REPAIRED: "repaired", MD_AFTER_FAILURE: "MD after a failure"}
# What frames of each kind may do to the statistics of a trajectory.
BIAS = {
    DRAWN_AGAIN: "states from which the surrogate fails are visited less, and left in other ways",
    REPAIRED: "repaired frames and those that follow from them have relaxed bonds and angles, colder than the "
    "ensemble's",
    MD_AFTER_FAILURE: "MD stands where the surrogate failed: ensemble and kinetics are a mixture, and each stretch of "
    "MD starts from a relaxed frame with new velocities and warms up within about 1 ps",
}


@dataclass
class Tally:
    """One replica's summary. All numbers are of model frames, whether they are kept in the file or not.

    `chunks` drawn, of which `chunks_caught` held a frame that a guard caught; `frames_caught` and `reasons` count the
    frames of first draws, `frames` those that an intervention left, `draws` the further draws. `md_in_a_row`: chunks
    that MD had to finish since the surrogate last got through one. `invalid_in_a_row`: frames of the chunks since the
    last one that held a valid frame.
    """

    chunks: int = 0
    chunks_caught: int = 0
    frames_caught: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    draws: int = 0
    md_in_a_row: int = 0
    invalid_in_a_row: int = 0

    def note_caught(self, flags: npt.NDArray[np.uint16]) -> None:
        """Enter the caught frames of a first draw, `flags (k,)` each with its bits."""
        self.chunks_caught += 1
        self.frames_caught += len(flags)
        names = Counter(name for bits in flags.tolist() for name in validity.flag_names(bits))
        for name, count in names.items():
            self.reasons[name] = self.reasons.get(name, 0) + count

    def note_marks(self, marks: npt.NDArray[np.uint8]) -> None:
        """Enter what the frames of a finished chunk are, `marks (n,)`."""
        for mark, name in MARKS.items():
            count = int((marks == mark).sum())
            if count:
                self.frames[name] = self.frames.get(name, 0) + count

    def to_record(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        kept = {k: v for k, v in asdict(self).items() if not k.endswith("_in_a_row")}
        bias = [why for mark, why in BIAS.items() if self.frames.get(MARKS[mark])]
        return {**kept, "share_of_chunks": self.chunks_caught / max(self.chunks, 1), "bias": bias}


@contextmanager
def timed(seconds: dict[str, float], what: str) -> Iterator[None]:
    """Add the wall time that the block takes to what a batch has spent on `what`."""
    started = perf_counter()
    try:
        yield
    finally:
        seconds[what] = seconds.get(what, 0.0) + perf_counter() - started


# Why a rollout stops whose numbers are none.
BLOWN_UP = "the coordinates became NaN or infinite"
MOST_DRAWS = 8
_DRAWS_FROM_LAST_VALID = 4
MOST_MD_IN_A_ROW = 10
# Invalid frames, after which unguarded rollouts end: a clash passes, a molecule that came apart does not.
MOST_INVALID_IN_A_ROW = 4
_MD_ATTEMPT = 1000
# Under 'flag': so many chunks of each replica a model has to get one through. A frame now and then, as sound weights
# have in long chunks, does not prove it wrong: of frames, so many must be caught, and more than one.
_CHUNKS_TO_PROVE = 8
_WRONG_SHARE = 0.1


@dataclass(eq=False)
class Chunk:
    """Frames of all replicas: positions `(b, n, n_atoms, 3)` nm; flags, marks (`MARKS`) and, where they were
    computed, energy differences in kJ/mol, `(b, n)`; velocities `(b, n_atoms, 3)` nm/ps at the end, of a model
    that carries them, NaN where they are unknown. `failure`: why the rollout cannot go on, and in which replica."""

    frames_nm: FloatArray
    flags: Flags
    marks: npt.NDArray[np.uint8]
    energies_kj_mol: npt.NDArray[np.float64]
    velocities_nm_ps: FloatArray | None
    failure: tuple[int, str] | None = None


@dataclass
class Progress:
    """Where a rollout stands between two chunks.

    `last_frames (replicas, n_conditioning, n_atoms, 3)` nm, in the model's atom order and the user's pose, relative to
    where the scene's centre was; `velocities (replicas, n_atoms, 3)` nm/ps of a model that carries them. `steps`: model
    frames done, kept or not. `batch`: replicas computed at once, if memory has run out before. `drawn`: chunks drawn of
    all replicas, further draws included, which took `evaluations` of the network together.
    """

    last_frames: npt.NDArray[np.float32]
    velocities: npt.NDArray[np.float32] | None = None
    chunks: int = 0
    steps: int = 0
    wall_s: float = 0.0
    batch: int | None = None
    drawn: int = 0
    evaluations: float = 0.0
    # Wall seconds of the batch by what they went into: draw, check, draw again, relax, md, energy.
    seconds: dict[str, float] = field(default_factory=dict)
    tallies: list[Tally] = field(default_factory=list)


def none_through(tallies: Sequence[Tally], n_new: int, *, at_end: bool) -> tuple[int, str] | None:
    """Return the worst replica and what is wrong, where a model has drawn no chunk of `n_new` frames that passes.

    None as long as one has passed, or may yet: `at_end` says that no chunk follows.
    """
    chunks, frames = sum(t.chunks for t in tallies), sum(t.frames_caught for t in tallies)
    if any(t.chunks_caught < t.chunks for t in tallies) or frames <= max(1.0, _WRONG_SHARE * chunks * n_new):
        return None
    if not at_end and tallies[0].chunks < _CHUNKS_TO_PROVE:
        return None
    row = max(range(len(tallies)), key=lambda k: tallies[k].frames_caught)
    reasons: Counter[str] = Counter()
    for tally in tallies:
        reasons.update(tally.reasons)
    named, share = ", ".join(name for name, _ in reasons.most_common()), f"{100 * frames / (chunks * n_new):.0f} %"
    if chunks == 1:
        return row, f"the only chunk contains invalid frames ({share}: {named})"
    return row, f"every one of {chunks} chunks was caught ({share} of frames: {named})"


@dataclass(eq=False)
class Interventions:
    """Draws the chunks that follow `state` and treats frames that the checks caught as `config.guard` says
    (`surrogate.sampling.config.GUARDS`). Tallies and seconds of the state are brought up to date.

    `coupling` is needed by 'repair' and 'fallback'; `potential` checks the frames of a learned potential, and the
    energy of every `config.energy_every`-th of them.
    """

    sampler: ChunkSampler
    checks: Guard
    config: RolloutConfig
    state: Progress
    coupling: Coupling | None = None
    potential: PotentialChecks | None = None
    chunk: Chunk = field(init=False)

    def advance(self) -> Chunk:
        """Return the next chunk, its frames as they are to be written; where `failure` is set, the rollout must
        stop."""
        self.draw()
        if self.config.guard not in ("off", "flag"):
            self.help_rows()
        self.compare()
        for tally, marks in zip(self.state.tallies, self.chunk.marks, strict=True):
            tally.note_marks(marks)
            tally.chunks += 1
        return self.chunk

    def draw(self) -> None:
        """Draw the chunk, check it, and enter the caught frames in the tallies."""
        with timed(self.state.seconds, "draw"):
            drawn = self.sampler.draw(
                self.state.last_frames, self._seeds(range(len(self.state.last_frames)), 0), self.state.velocities
            )
        shape = drawn.frames_nm.shape[:2]
        flags, marks = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint8)
        self.chunk = Chunk(drawn.frames_nm, flags, marks, np.full(shape, np.nan), drawn.velocities_nm_ps)
        self._check(np.arange(shape[0]))
        for row, tally in enumerate(self.state.tallies):
            bad = np.flatnonzero(caught(self.chunk.flags[row]))
            if len(bad):
                tally.note_caught(self.chunk.flags[row, bad])

    def help_rows(self) -> None:
        """Replace caught frames by further draws, repair or MD; `chunk.failure` says which row could not be helped."""
        pending = self._caught_rows()
        none_passed = {row for row in pending if self._none_passes(row)}
        for attempt in range(MOST_DRAWS + 1):
            if attempt:
                self._draw_again(pending, attempt)
            wrong = [row for row in pending if attempt == 1 and row in none_passed and self._is_wrong(row)]
            if wrong:
                self.chunk.failure = (wrong[0], f"two draws gave no frame that passes ({self._reasons(wrong[0])})")
                return
            pending = [row for row in pending if not self._resolve(row, attempt)]
            if not pending:
                return
        first = pending[0]
        what = f"{MOST_DRAWS} further draws gave no chunk that passes ({self._reasons(first)})"
        if self.state.tallies[first].md_in_a_row > MOST_MD_IN_A_ROW:
            what = f"MD had to finish {MOST_MD_IN_A_ROW} chunks in a row, and {what}"
        self.chunk.failure = (first, what)

    def compare(self) -> None:
        """Enter in `chunk.failure` the row whose last frame is not finite, or which under 'flag' has had no valid frame
        for a whole chunk, or for as many short ones as hold MOST_INVALID_IN_A_ROW frames."""
        if self.chunk.failure is not None:
            return
        for row in range(len(self.state.last_frames)):
            if self.chunk.flags[row, -1] & validity.NOT_FINITE or not np.isfinite(self.chunk.frames_nm[row, -1]).all():
                self.chunk.failure = (row, BLOWN_UP)
                continue
            invalid = (self.chunk.flags[row] & np.uint16(validity.INVALID | validity.STILL)).all()
            tally = self.state.tallies[row]
            tally.invalid_in_a_row = tally.invalid_in_a_row + self.chunk.flags.shape[1] if invalid else 0
            if self.config.guard == "flag" and tally.invalid_in_a_row >= MOST_INVALID_IN_A_ROW:
                self.chunk.failure = (row, f"{tally.invalid_in_a_row} frames and no valid one ({self._reasons(row)})")

    def _resolve(self, row: int, attempt: int) -> bool:
        """Do what the guard says about a row that was just drawn; return whether it can stay as it is then. A first
        draw without a frame that passes is a waste: there is another."""
        bad = np.flatnonzero(caught(self.chunk.flags[row]))
        if not len(bad):
            self.state.tallies[row].md_in_a_row = 0
            return True
        if attempt == 0 and self._none_passes(row):
            return False
        if self.config.guard == "repair":
            return self._repair(row)
        return self.config.guard == "fallback" and self._fall_back(row, int(bad[0]))

    def _repair(self, row: int) -> bool:
        """Relax the caught frames of a row, first to last; return whether all of them are valid then."""
        assert self.coupling is not None
        while True:
            bad = np.flatnonzero(caught(self.chunk.flags[row]))
            if not len(bad):
                return True
            frame = int(bad[0])
            if self.chunk.marks[row, frame] == REPAIRED:
                return False
            try:
                with timed(self.state.seconds, "relax"):
                    self.chunk.frames_nm[row, frame] = self.coupling.relax(self.chunk.frames_nm[row, frame])
            except SimulationError:
                return False
            self.chunk.marks[row, frame] = REPAIRED
            self.chunk.energies_kj_mol[row, frame] = np.nan
            self._check(np.array([row]))

    def _fall_back(self, row: int, first: int) -> bool:
        """Replace a row from frame `first` on by MD; return whether it could be done."""
        assert self.coupling is not None
        tally = self.state.tallies[row]
        tally.md_in_a_row += 1
        if tally.md_in_a_row > MOST_MD_IN_A_ROW:
            return False
        n = self.chunk.frames_nm.shape[1] - first
        try:
            with timed(self.state.seconds, "md"):
                segment = self.coupling.simulate(self._history(row, first)[-1], n, seed=self._seed(row, _MD_ATTEMPT))
        except SimulationError:
            return False
        self._replace(row, first, segment.frames_nm, MD_AFTER_FAILURE)
        if self.chunk.velocities_nm_ps is not None:
            self.chunk.velocities_nm_ps[row] = segment.velocities_nm_ps
        self._check(np.array([row]))
        return True

    def _draw_again(self, rows: Sequence[int], attempt: int) -> None:
        """Draw the rows anew, each from its last valid frame, or from where the chunk began once that has failed."""
        keep = attempt <= _DRAWS_FROM_LAST_VALID
        firsts = [int(np.argmax(caught(self.chunk.flags[row]))) if keep else 0 for row in rows]
        histories = np.stack([self._history(row, first) for row, first in zip(rows, firsts, strict=True)])
        velocities = None
        if self.chunk.velocities_nm_ps is not None:
            velocities = np.full((len(rows), *self.state.last_frames.shape[2:]), np.nan)
            for k, (row, first) in enumerate(zip(rows, firsts, strict=True)):
                if first == 0 and self.state.velocities is not None:
                    velocities[k] = self.state.velocities[row]
        with timed(self.state.seconds, "draw again"):
            drawn = self.sampler.draw(histories, self._seeds(rows, attempt), velocities)
        for k, (row, first) in enumerate(zip(rows, firsts, strict=True)):
            self.state.tallies[row].draws += 1
            self._replace(row, first, drawn.frames_nm[k, : drawn.frames_nm.shape[1] - first], DRAWN_AGAIN)
            if self.chunk.velocities_nm_ps is not None and drawn.velocities_nm_ps is not None:
                # Those of the draw belong to its last frame, which is cut off where the row began before it.
                self.chunk.velocities_nm_ps[row] = drawn.velocities_nm_ps[k] if first == 0 else np.nan
        self._check(np.asarray(rows))

    def _replace(self, row: int, first: int, frames_nm: FloatArray, mark: int) -> None:
        self.chunk.frames_nm[row, first:] = frames_nm
        self.chunk.marks[row, first:] = mark
        self.chunk.energies_kj_mol[row, first:] = np.nan

    def _history(self, row: int, first: int) -> FloatArray:
        """The frames `(n_conditioning, n_atoms, 3)` before frame `first` of a row."""
        n = self.state.last_frames.shape[1]
        return np.concatenate([self.state.last_frames[row], self.chunk.frames_nm[row, :first]])[-n:]

    def _check(self, rows: npt.NDArray[np.int64]) -> None:
        with timed(self.state.seconds, "check"):
            frames, before = self.chunk.frames_nm[rows], self.state.last_frames[rows, -1]
            flags = self.checks.check(
                frames, before, from_start=self.state.steps == 0, may_jump=self.config.torsion_moves > 0
            )
            if self.potential is not None:
                flags |= np.uint16(validity.UNSURE) * self.potential.unsure(frames)
            self.chunk.flags[rows] = flags
        if self.potential is not None and self.config.energy_every:
            with timed(self.state.seconds, "energy"):
                for row in rows.tolist():
                    self._check_energies(row, self.potential)

    def _check_energies(self, row: int, potential: PotentialChecks) -> None:
        """Flag frames whose turn it is and whose energy is far from the reference's."""
        steps = self.state.steps + 1 + np.arange(self.chunk.flags.shape[1])
        energies = self.chunk.energies_kj_mol[row]
        for k in np.flatnonzero((steps % self.config.energy_every == 0) & ~caught(self.chunk.flags[row])).tolist():
            if np.isnan(energies[k]):
                energies[k] = potential.difference(self.chunk.frames_nm[row, k])
            if potential.is_wrong(energies[k]):
                self.chunk.flags[row, k] |= np.uint16(validity.ENERGY)

    def _caught_rows(self) -> list[int]:
        rows: list[int] = np.flatnonzero(caught(self.chunk.flags).any(axis=1)).tolist()
        for row, tally in enumerate(self.state.tallies):
            if row not in rows:
                tally.md_in_a_row = 0
        return rows

    def _is_wrong(self, row: int) -> bool:
        """Whether no frame of this caught row passes, and no earlier chunk of it has got through without help."""
        tally = self.state.tallies[row]
        return self._none_passes(row) and tally.chunks == tally.chunks_caught - 1

    def _none_passes(self, row: int) -> bool:
        return bool(caught(self.chunk.flags[row]).all())

    def _reasons(self, row: int) -> str:
        return ", ".join(validity.flag_names(int(np.bitwise_or.reduce(self.chunk.flags[row]))))

    def _seed(self, row: int, attempt: int) -> int:
        return noise_seed(self.config.seed, row, self.state.chunks, attempt)

    def _seeds(self, rows: Sequence[int] | range, attempt: int) -> list[int]:
        return [self._seed(row, attempt) for row in rows]
