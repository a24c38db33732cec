"""Draw chunks from a model: canonical pose, noise from seeds, and batches that halve when memory runs out."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data.frames import fitted_atoms
from surrogate.models.layers import with_compiled_parts, with_lean_parts
from surrogate.models.potential import Potential
from surrogate.models.propagator import Propagator, draw_noise
from surrogate.training.devices import choose_precision, keep_freed_memory, torch_threads
from systems.chemistry.geometry import superposition
from systems.errors import InputError, SimulationError

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

FloatArray = npt.NDArray[np.floating[Any]]
_Model = TypeVar("_Model", bound=Propagator)
# Up to as many replicas one thread was faster than two, on a pair of hardware threads: products of few rows are too
# small to be shared.
_ROWS_OF_ONE_THREAD = 16


class Drawn(NamedTuple):
    """New frames `(b, n_new, n_atoms, 3)` nm and, of a model that carries them, the velocities `(b, n_atoms, 3)` nm/ps
    at the last of them; both in the pose of the frames that they follow."""

    frames_nm: FloatArray
    velocities_nm_ps: FloatArray | None


class ChunkSampler:
    """One model, ready to draw chunks: what a rollout does with the weights, and all that it does with them.

    Atoms are in the model's order throughout. `batch` is the most replicas computed at once: None for all, until
    memory runs out, and then half as many, for good. `compile`: the networks are compiled for the first batch drawn;
    others, such as a single chunk drawn again, go through the plain ones. Raises InputError for a solver or
    precision that does not suit the weights, and where there is nothing to compile with.
    """

    def __init__(
        self, weights: Weights, *, solver_steps: int | None = None, solver: str | None = None, precision: str = "auto",
        compile: bool = False,
    ) -> None:  # fmt: skip
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
        plain = with_bf16_weights(model) if self.precision.bf16 else model
        self._model = with_lean_parts(plain)
        self._compiled = with_compiled_parts(plain) if compile else None
        self._compiled_rows: int | None = None
        self._molecule = model.featurise(template)
        self._fit = fitted_atoms(template)
        self._target = template.positions_nm - template.positions_nm[self._fit].mean(axis=0)

    @property
    def n_conditioning(self) -> int:
        """Frames that a chunk is conditioned on."""
        return self._model.n_conditioning

    @property
    def n_new(self) -> int:
        """Frames in a chunk."""
        return self._model.n_new

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
                    self._compiled_rows = None
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
        model = self._model
        if self._compiled is not None:
            self._compiled_rows = self._compiled_rows or len(seeds)
            model = self._compiled if len(seeds) == self._compiled_rows else model
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.precision.bf16):
            chunk = model.next_chunk(
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
