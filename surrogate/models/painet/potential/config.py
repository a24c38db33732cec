"""Settings of PAINET as a potential."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from surrogate.models.settings import build
from systems.errors import InputError

LONGEST_FLEXIBLE_PS = 0.002


@dataclass(frozen=True)
class PotentialConfig:
    """Size of the network, and the integrator that rolls it.

    `n_steps` latent steps, each a look at the neighbourhood and, between them, energy-descent attention over all atoms.
    An atom sees its neighbours by `n_scalars`, `n_vectors` and `n_tensors` sums of products of `n_radial` functions of
    the distance. `n_members`: read-outs that learn from different samples; their mean is the potential, their spread
    says where it is unsure. `attention`: 'linear' (factored over types), 'dense' (the same numbers) or 'auto'.

    A chunk is `n_new` frames `lag_ps` apart, in steps of `timestep_ps`, in a Langevin bath at `temperature_k`
    with `friction_per_ps`, or with `ensemble` 'nve' without one; hydrogens weigh `hydrogen_mass_da`, if any is given.
    As of reference MD, steps are of 4 fs, hydrogens of 3 Da and their bonds rigid (`constrain_hydrogens`).
    """

    width: int = 64
    n_steps: int = 2
    n_radial: int = 12
    n_scalars: int = 16
    n_vectors: int = 8
    n_tensors: int = 4
    n_heads: int = 4
    head_dim: int = 8
    n_members: int = 4
    cutoff_nm: float = 0.6
    attention: str = "auto"
    # Share of the attention's mean in the next embedding, eta of the descent step.
    step: float = 0.5
    # Largest Psi / Phi: below one, weights stay positive whatever the embeddings.
    psi_limit: float = 0.95
    n_new: int = 10
    lag_ps: float = 0.1
    timestep_ps: float = 0.004
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0
    ensemble: str = "nvt"
    hydrogen_mass_da: float | None = 3.0

    def __post_init__(self) -> None:
        if self.attention not in ("auto", "linear", "dense"):
            raise InputError(f"attention = {self.attention!r} is unknown; choose auto, linear or dense.")
        if self.ensemble not in ("nvt", "nve"):
            raise InputError(f"ensemble = {self.ensemble!r} is unknown to a learned potential; choose nvt or nve.")
        sizes = ("width", "n_steps", "n_scalars", "n_vectors", "n_tensors", "n_heads", "head_dim", "n_members", "n_new")
        for name in sizes:
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be at least 1.")
        if self.n_radial < 2:
            raise InputError(f"n_radial = {self.n_radial} must be at least 2.")
        if not 0.0 < self.step < 1.0 or not 0.0 <= self.psi_limit < 1.0:
            raise InputError(f"step = {self.step:g} and psi_limit = {self.psi_limit:g} must lie between 0 and 1.")

    @property
    def constrain_hydrogens(self) -> bool:
        """Whether bonds to hydrogen are rigid, as reference MD's are: at steps above 2 fs."""
        return self.timestep_ps > LONGEST_FLEXIBLE_PS

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> PotentialConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(PotentialConfig, record)
