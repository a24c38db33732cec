"""Weights files: one safetensors file that carries its configuration, training domain and provenance."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load

from surrogate.data import TrainingFrames
from surrogate.models.architecture import architecture
from surrogate.models.propagator import Propagator
from surrogate.training.loop import save_tensors, tensor_checksum
from systems.chemistry.validity import geometry_from_frames, limits_from_frames
from systems.errors import InputError, SurromdError, WeightsError, first_line
from systems.files.outside import UNREADABLE
from systems.files.schema import built, parsed
from systems.scene import Scene

FORMAT = "surromd-weights-1"
# Settings that are no sizes (an interval in ps) may be as large as this, however small the model.
_LEAST_SIZE = 1_000_000


@dataclass(frozen=True)
class Chemistry:
    """Molecules that a potential trained on many covers: of these elements, at most so many atoms, charges in e from
    the least to the greatest, where its members' forces spread by at most `spread_kj_mol_nm`
    (`PainetPotential.spread`)."""

    elements: tuple[str, ...]
    n_atoms: int
    charges: tuple[int, int]
    spread_kj_mol_nm: float

    def describe(self) -> str:
        """Return 'molecules of H, C, N, O with up to 50 atoms, charges -1 to 1'."""
        least, most = self.charges
        return f"molecules of {', '.join(self.elements)} with up to {self.n_atoms} atoms, charges {least} to {most}"


@dataclass(frozen=True)
class TrainingDomain:
    """The training domain of weights. `scene` is the template: atom k of the model is its atom k, and canonical
    frames are superposed on its positions. `conditions`: of the reference (force field, temperature_k, ...);
    `geometry` and `limits` of its frames, as dictionaries (systems.chemistry.validity.Geometry and Limits).

    `lag_ps`: between frames, the shortest where the model takes a lag; `jumps` are then rows (lag, least and greatest
    jump) that stand for those of `limits` at each lag. `further`: the domains of other molecules trained on;
    `sequences`: residues, as ACE-ALA-NME, of further peptides that were trained on under the same conditions, of which
    no more is kept. `transferable`: other molecules are covered too (`sampling.domain`): those that `chemistry` says,
    or peptides of such residues.
    """

    scene: Scene
    lag_ps: float
    conditions: dict[str, Any]
    geometry: dict[str, Any]
    limits: dict[str, Any] | None = None
    jumps: tuple[tuple[float, float, float], ...] = ()
    further: tuple[TrainingDomain, ...] = ()
    sequences: tuple[str, ...] = ()
    transferable: bool = False
    chemistry: Chemistry | None = None

    @property
    def members(self) -> tuple[TrainingDomain, ...]:
        """The domains of molecules trained on, all but those that are known by their residues alone."""
        return (self, *self.further)

    @property
    def peptides(self) -> tuple[tuple[str, ...], ...]:
        """The residues of every molecule trained on."""
        return (
            *(member.scene.residue_names for member in self.members),
            *(tuple(sequence.split("-")) for member in self.members for sequence in member.sequences),
        )

    @property
    def longest_lag_ps(self) -> float:
        return self.jumps[-1][0] if self.jumps else self.lag_ps

    def to_dict(self) -> dict[str, Any]:
        """Return what a weights file keeps (`systems.files.schema.built` takes it back); what a single molecule and lag
        leave empty is left out."""
        out: dict[str, Any] = {**vars(self), "scene": self.scene.to_dict()}
        out["further"] = [domain.to_dict() for domain in self.further]
        out["chemistry"] = None if self.chemistry is None else asdict(self.chemistry)
        empty = ("jumps", "further", "sequences", "transferable", "chemistry")
        return {key: value for key, value in out.items() if value or key not in empty}

    @property
    def names(self) -> tuple[str, ...]:
        """The molecules, each once."""
        members = self.members
        return tuple(dict.fromkeys([*(d.scene.name for d in members), *(s for d in members for s in d.sequences)]))

    @property
    def solvents(self) -> tuple[str | None, ...]:
        """Those of the molecules, each once; the first is meant where none is named."""
        return tuple(dict.fromkeys(member.conditions.get("solvent") for member in self.members))

    def describe(self) -> str:
        """One line for people: 'alanine-dipeptide (C6H12N2O2, 22 atoms), ff14SB/obc2, 300 K, frames 1 ps apart'."""
        c, names = self.conditions, self.names
        lags = f"{self.lag_ps:g}" + (f" to {self.longest_lag_ps:g}" if self.jumps else "")
        what = f"{self.scene.name} ({self.scene.formula}, {self.scene.n_atoms} atoms)"
        if self.further:
            more = f" and {len(names) - 6} more" if len(names) > 6 else ""
            what = f"{len(names)} molecules ({', '.join(names[:6])}{more})"
        what += " and molecules like them" if self.transferable else ""
        what = what if self.chemistry is None else self.chemistry.describe()
        solvents = " or ".join(map(str, self.solvents))
        md = f"{f}/{solvents}, {c.get('temperature_k')} K" if (f := c.get("force_field")) else "unknown MD"
        return f"{what}, {md}, frames {lags} ps apart"


@dataclass(frozen=True)
class Weights:
    """A model ready to roll, with everything its file says of it. `hash` is that of the file's bytes."""

    model: Propagator
    domain: TrainingDomain
    provenance: dict[str, Any]
    hash: str
    path: Path


@dataclass(frozen=True)
class Header:
    """A weights file's record: everything but its numbers."""

    arch: str
    config: dict[str, Any]
    domain: TrainingDomain
    provenance: dict[str, Any]


def _check_sizes(config: Any, n_tensors: int, n_values: int) -> None:
    """Raise ValueError for more layers than a file has tensors, or a size beyond that of all of them, before any is
    made."""
    for key, value in config.items() if isinstance(config, dict) else enumerate(config):
        most = n_tensors if str(key).endswith(("layers", "rounds")) else n_values
        if isinstance(value, dict | list):
            _check_sizes(value, n_tensors, n_values)
        elif isinstance(value, int | float) and not abs(value) <= most:
            raise ValueError(f"{key} = {value!r} in a file of {n_tensors} tensors with {n_values} numbers")


def save_weights(
    path: str | Path, model: Propagator, domain: TrainingDomain, provenance: dict[str, Any], *, half: bool = False
) -> None:
    """Write weights whole or not at all; `half` rounds them to float16, half the size, for shipping."""
    header = {"arch": model.arch, "config": model.config.to_dict(), "domain": domain.to_dict(),
              "provenance": provenance}  # fmt: skip
    dtype = torch.float16 if half else torch.float32
    tensors = {k: v.to(dtype) for k, v in model.state_dict().items()}
    save_tensors(Path(path), "surromd", header, tensors, format=FORMAT)


def read_header(path: str | Path) -> Header:
    """Return a weights file's record without loading it. Raises InputError (no such file) or WeightsError."""
    return _header(Path(path))[0]


def _header(path: Path) -> tuple[Header, dict[str, str]]:
    if not path.is_file():
        raise InputError(f"weights file {path} does not exist.")
    found = path.stat()
    return _header_of(path, (found.st_ino, found.st_mtime_ns, found.st_size))


# One command asks what weights cover before it loads them; of many peptides a header is megabytes.
@lru_cache(maxsize=8)
def _header_of(path: Path, version: tuple[int, ...]) -> tuple[Header, dict[str, str]]:
    try:
        with safe_open(path, framework="pt") as handle:
            metadata = dict(handle.metadata() or {})
        if metadata.get("format") != FORMAT or metadata.keys() != {"format", "surromd", "sha256"}:
            raise ValueError(f"format {metadata.get('format')!r}")
        return built(Header, parsed(metadata["surromd"])), metadata
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(
            f"{path} is damaged or not a weights file of this version of surromd ({first_line(error)})."
        ) from error


def load_weights(path: str | Path) -> Weights:
    """Load a weights file in evaluation mode. Raises InputError, WeightsError (damaged, non-finite, other shapes)."""
    path = Path(path)
    header, metadata = _header(path)
    data = path.read_bytes()
    try:
        state = load(data)
        if metadata["sha256"] != tensor_checksum(metadata["surromd"], state):
            raise ValueError("it is not what was written (checksum); restore it from a whole copy")
        if broken := [name for name, tensor in state.items() if not torch.isfinite(tensor).all()]:
            raise ValueError(f"values are not finite, first in {broken[0]}; train again")
        arch = architecture(header.arch)
        _check_sizes(header.config, len(state), max(sum(tensor.numel() for tensor in state.values()), _LEAST_SIZE))
        model = arch.model(arch.config(header.config))
        model.load_state_dict(state)
    except (SafetensorError, *UNREADABLE, ArithmeticError, AssertionError, SurromdError) as error:
        raise WeightsError(f"{path} is damaged or of another version of surromd: {first_line(error)}") from error
    file_hash = hashlib.sha256(data).hexdigest()[:16]
    return Weights(model.eval().requires_grad_(False), header.domain, header.provenance, file_hash, path)


# Training frames that checks are measured on.
_MEASURED_FRAMES = 20_000


def training_domain(frames: TrainingFrames, *, stride: int = 1, strides: Sequence[int] = ()) -> TrainingDomain:
    """Return the domain of weights trained on every `stride`-th of `frames`; its checks are measured on evenly spaced
    training frames. `strides`: those of a model that takes the lag, from 1 on, for each of which jumps are measured."""
    picked = frames.spread_starts(_MEASURED_FRAMES, stride + 1)
    positions = frames.positions_nm(picked)
    geometry = geometry_from_frames(frames.scene, positions)
    limits = limits_from_frames(frames.scene, positions, frames.positions_nm(picked + stride))
    jumps = []
    for wide in strides:
        picked = frames.spread_starts(_MEASURED_FRAMES, wide + 1)
        found = limits_from_frames(frames.scene, frames.positions_nm(picked), frames.positions_nm(picked + wide))
        jumps.append((frames.lag_ps * wide, found.jump_min_nm, found.jump_max_nm))
    return TrainingDomain(frames.scene, frames.lag_ps * stride, frames.conditions, geometry.to_dict(), limits.to_dict(),
                          tuple(jumps))  # fmt: skip


def provenance_of(origin: dict[str, Any], settings: dict[str, Any], start: Weights | None = None) -> dict[str, Any]:
    """Return when, where and from what weights were made. `origin`: of the frames trained on (`TrainingFrames.origin`);
    `settings`: of the training; `start`: the weights that it began with, of whose trajectories those stand there that
    are not among `origin`'s."""
    earlier = {}
    if start is not None:
        known = {source["sha256"] for source in origin.get("sources", ()) if "sha256" in source}
        earlier = {"from": {"hash": start.hash, **_beside(start.provenance, known)}}
    return {
        **earlier,
        "trained": datetime.now(UTC).isoformat(timespec="seconds"),
        "torch": torch.__version__,
        "machine": platform.machine(),
        **origin,
        **settings,
    }


def _beside(record: dict[str, Any], known: set[str]) -> dict[str, Any]:
    """Return the record of earlier weights and of those that they began with, without trajectories in `known`."""
    left = [source for source in record.get("sources", ()) if source.get("sha256") not in known]
    found = {**record, "sources": left} if "sources" in record else dict(record)
    if isinstance(record.get("from"), dict):
        found["from"] = _beside(record["from"], known | {source["sha256"] for source in left if "sha256" in source})
    return found
