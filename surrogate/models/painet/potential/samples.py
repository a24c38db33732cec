"""States with energies and forces: what a potential learns from, kept in a file of its own."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surrogate.data.tensor_checksums import tensor_checksum
from systems.errors import InputError
from systems.files.schema import parsed
from systems.files.whole_file import create_whole

Array = Any
# So far above the lowest state, for each atom, that no rollout comes there: the potential energy of 1,200 K.
_HIGHEST_KJ_MOL = 15.0


@dataclass(frozen=True, eq=False)
class Samples:
    """`positions_nm` and `forces_kj_mol_nm` (n, n_atoms, 3), `energies_kj_mol` (n,), in float64; `held` (n,): whether a
    sample is kept for measuring errors and never trained on."""

    positions_nm: Array
    energies_kj_mol: Array
    forces_kj_mol_nm: Array
    held: Array

    def __len__(self) -> int:
        return len(self.energies_kj_mol)

    def joined(self, other: Samples) -> Samples:
        """Return both, without what lies too high above the lowest."""
        parts = [np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(Samples)]
        together = Samples(*parts)
        return together.plausible(together)

    def plausible(self, others: Samples) -> Samples:
        """Return those of the others that a rollout may visit, by how far they lie above the lowest of these."""
        highest = self.energies_kj_mol.min(initial=np.inf) + _HIGHEST_KJ_MOL * self.positions_nm.shape[1]
        return others.where(others.energies_kj_mol < highest)

    def where(self, chosen: Array) -> Samples:
        """Return those that are chosen, by a mask or by numbers."""
        return Samples(*(getattr(self, f.name)[chosen] for f in fields(Samples)))

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return positions, energies and forces."""
        return tuple(torch.from_numpy(np.ascontiguousarray(a)) for a in (
            self.positions_nm, self.energies_kj_mol, self.forces_kj_mol_nm))  # type: ignore[return-value]  # fmt: skip

    def save(self, path: Path, molecule: str) -> None:
        """Write them whole or not at all; `molecule`: whose they are."""
        from safetensors.torch import save_file

        tensors = {f.name: torch.from_numpy(np.ascontiguousarray(getattr(self, f.name))) for f in fields(Samples)}
        text = json.dumps({"molecule": molecule})
        metadata = {"surromd_samples": text, "sha256": tensor_checksum(text, tensors)}
        create_whole(path, lambda temporary: save_file(tensors, temporary, metadata=metadata))

    @staticmethod
    def load(path: Path, molecule: str) -> Samples:
        """Read them back. Raises InputError for a damaged file or another molecule's."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="pt") as handle:
                metadata = handle.metadata() or {}
                tensors = {f.name: handle.get_tensor(f.name) for f in fields(Samples)}
            text = metadata["surromd_samples"]
            whole = metadata["sha256"] == tensor_checksum(text, tensors)
            whose = parsed(text)["molecule"]
        except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"samples {path} cannot be read ({error}); train again without `resume`.") from error
        if not whole:
            raise InputError(f"samples {path} are damaged (checksum); train again without `resume`.")
        if whose != molecule:
            raise InputError(f"samples {path} are of another molecule; train again without `resume`.")
        return Samples(**{name: tensor.numpy() for name, tensor in tensors.items()})

    @staticmethod
    def none(n_atoms: int) -> Samples:
        empty = np.zeros((0, n_atoms, 3))
        return Samples(empty, np.zeros(0), empty, np.zeros(0, dtype=bool))
