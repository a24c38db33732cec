"""Springs along bonds, as stiff as frames show them to be: the least that a potential of another package is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from surrogate.data import References
from surrogate.models.architecture import AdvanceFn, Architecture, Prepared, Settings, Trainer, TrainingRequest, build
from surrogate.models.potential import IntegratorConfig, Potential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import provenance_of, save_weights, training_domain
from systems.units import GAS_CONSTANT_KJ_MOL_K


@dataclass(frozen=True)
class SpringConfig(IntegratorConfig):
    n_bonds: int = 0

    @staticmethod
    def from_dict(record: dict[str, Any]) -> SpringConfig:
        return build(SpringConfig, record)


class Springs(Potential):
    arch: ClassVar[str] = "springs"
    length_nm: Tensor
    stiffness_kj_mol_nm2: Tensor

    def __init__(self, config: SpringConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("length_nm", torch.full((config.n_bonds,), 0.1))
        self.register_buffer("stiffness_kj_mol_nm2", torch.full((config.n_bonds,), 1e5))

    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        first, second = molecule.bonds.T
        stretch = (positions_nm[:, first] - positions_nm[:, second]).norm(dim=-1) - self.length_nm
        return (0.5 * self.stiffness_kj_mol_nm2 * stretch.square()).sum(-1, keepdim=True)


class SpringTrainer(Trainer):
    """Fits each spring to the mean and the variance of its bond, by equipartition."""

    fitted = True

    def settings(self, request: TrainingRequest) -> Settings:
        return Settings(None, None)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        frames = references.frames(canonical=True)

        def start(advance: AdvanceFn) -> Path:
            x = torch.from_numpy(frames.some_nm(10_000)).double()
            first, second = torch.tensor(frames.scene.bonds).T
            lengths = (x[:, first] - x[:, second]).norm(dim=-1)
            kelvin = float(frames.conditions["temperature_k"])
            model = Springs(SpringConfig(n_bonds=len(first), lag_ps=frames.lag_ps, timestep_ps=0.0005, n_new=2,
                                         temperature_k=kelvin, hydrogen_mass_da=None))  # fmt: skip
            model.length_nm.copy_(lengths.mean(0))
            model.stiffness_kj_mol_nm2.copy_(GAS_CONSTANT_KJ_MOL_K * kelvin / lengths.var(0))
            save_weights(request.out, model, training_domain(frames), provenance_of(frames.origin, {}))
            return request.out

        return Prepared(frames.scene.name, start)


SPRINGS = Architecture("springs", SpringConfig.from_dict, Springs, SpringTrainer)
