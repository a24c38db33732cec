"""PAINET's settings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from surrogate.models.settings import build
from systems.errors import InputError


@dataclass(frozen=True)
class PainetConfig:
    """Size, horizon and physics. `n_new` frames are predicted at once, `frame_stride` reference frames apart: 1 frame
    at a large stride is state-to-state, several are state-to-trajectory.

    `attention` 'linear' (factored over types, cost linear in atoms), 'dense' (the same numbers, quadratic) or 'none'
    (the decoder alone, which is EGNN). `edges` 'bonds' (with second neighbours) or 'all' pairs. `lag_ps` between
    predicted frames, `temperature_k` and `friction_per_ps` of the bath that refreshes velocities between chunks; a
    training takes the three from its reference.

    Ours: `n_modes` modes of motion over the whole molecule beside attention and decoder (`painet.modes`), 0 for none;
    `free_rotation` takes the rotation of the whole out of what is learned (`painet.rotation`).

    `decoder` 'egnn' (the paper's) or 'leapfrog' (ours: layers are steps of an integrator whose forces keep momentum,
    angular momentum and depend on positions alone), with `n_radial` functions of the distance per shell of pairs and
    `n_scalars` and `n_vectors` sums over an atom's neighbours.
    """

    n_new: int = 8
    frame_stride: int = 1
    width: int = 64
    n_heads: int = 4
    head_dim: int = 16
    n_decoder_layers: int = 4
    attention: str = "linear"
    edges: str = "bonds"
    n_modes: int = 0
    free_rotation: bool = False
    decoder: str = "egnn"
    n_radial: int = 12
    n_scalars: int = 8
    n_vectors: int = 6
    # Share of the attention's mean in the next embedding, eta of the descent step.
    step: float = 0.5
    # Largest Psi / Phi: below one, weights stay positive whatever the embeddings.
    psi_limit: float = 0.95
    length_scale_nm: float = 0.1
    lag_ps: float = 0.005
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0

    def __post_init__(self) -> None:
        if self.attention not in ("linear", "dense", "none"):
            raise InputError(f"attention = {self.attention!r} is unknown; choose linear, dense or none.")
        if self.edges not in ("bonds", "all"):
            raise InputError(f"edges = {self.edges!r} is unknown; choose bonds or all.")
        if self.decoder not in ("egnn", "leapfrog"):
            raise InputError(f"decoder = {self.decoder!r} is unknown; choose egnn or leapfrog.")
        if self.n_modes < 0 or (self.decoder == "leapfrog" and (self.n_modes or self.free_rotation)):
            raise InputError(f"n_modes = {self.n_modes} and free_rotation = {self.free_rotation} go with decoder egnn.")
        if self.n_radial < 2 or min(self.n_scalars, self.n_vectors, self.n_decoder_layers) < 1:
            raise InputError(
                f"n_radial = {self.n_radial} must be at least 2, n_scalars = {self.n_scalars}, n_vectors = "
                f"{self.n_vectors} and n_decoder_layers = {self.n_decoder_layers} at least 1."
            )
        if self.n_new < 1 or self.frame_stride < 1:
            raise InputError(f"n_new = {self.n_new} and frame_stride = {self.frame_stride} must be at least 1.")
        if not 0.0 < self.step < 1.0 or not 0.0 <= self.psi_limit < 1.0:
            raise InputError(f"step = {self.step:g} and psi_limit = {self.psi_limit:g} must lie between 0 and 1.")

    @property
    def chunk_ps(self) -> float:
        return self.n_new * self.lag_ps

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> PainetConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(PainetConfig, record)
