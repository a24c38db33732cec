"""Training frames of one scene in compact form: read from trajectories, canonicalised once, kept as int16."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError
from systems.geometry import superpose
from systems.scene import Scene
from systems.whole_file import create_whole

if TYPE_CHECKING:
    from systems.trajectory_types import TrajectoryReader

# One unit of the int16 coordinates: 0.0002 nm, range +-6.5 nm. Thermal motion of a bond is ten times larger.
QUANTUM_NM = 2e-4
_BLOCK = 8192
CONDITIONS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "timestep_ps", "hydrogen_mass_da")


@dataclass(frozen=True, eq=False)
class TrainingFrames:
    """Frames of several trajectories of one scene, ready to be cut into windows.

    `coordinates` (n_frames, n_atoms, 3) int16 in units of QUANTUM_NM, centred, and superposed on the scene by its
    heavy atoms when `canonical`. `starts` holds the first frame of each trajectory and, last, n_frames. Frames that
    carry `velocities` (n_frames, n_atoms, 3) nm/ps have their centre of mass at the origin and at rest.
    """

    scene: Scene
    coordinates: npt.NDArray[np.int16]
    starts: npt.NDArray[np.int64]
    lag_ps: float
    canonical: bool
    conditions: dict[str, Any]
    sources: tuple[dict[str, Any], ...]
    velocities: npt.NDArray[np.float32] | None = None

    @property
    def n_frames(self) -> int:
        return len(self.coordinates)

    @property
    def total_ps(self) -> float:
        return self.n_frames * self.lag_ps

    def positions_nm(self, idx: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return frames `(*idx.shape, n_atoms, 3)` nm."""
        return self.coordinates[idx].astype(np.float32) * np.float32(QUANTUM_NM)

    def window_starts(self, length: int, *, validation: bool, validation_share: float = 0.05) -> npt.NDArray[np.int64]:
        """Return the first frames of all windows of `length` frames that cross no boundary.

        The last `validation_share` of each trajectory is the validation block; no window reaches from one block into
        the other, so nothing of the validation block is trained on.
        """
        found = []
        for begin, end in zip(self.starts[:-1], self.starts[1:], strict=True):
            cut = int(end - round((end - begin) * validation_share))
            lo, hi = (cut, int(end)) if validation else (int(begin), cut)
            if hi - lo >= length:
                found.append(np.arange(lo, hi - length + 1, dtype=np.int64))
        if not found:
            kind = "validation" if validation else "training"
            raise InputError(f"no {kind} window of {length} frames fits; give longer trajectories or shorter chunks.")
        return np.concatenate(found)

    def save(self, path: str | Path) -> None:
        """Write one HDF5 file that `load_frames` takes back; it appears whole or not at all."""
        import h5py

        header = {
            "scene": self.scene.to_dict(),
            "lag_ps": self.lag_ps,
            "canonical": self.canonical,
            "conditions": self.conditions,
            "sources": list(self.sources),
            "quantum_nm": QUANTUM_NM,
        }

        def fill(temporary: Path) -> None:
            with h5py.File(temporary, "w") as handle:
                handle.attrs["surromd_windows"] = json.dumps(header)
                chunks = (min(2048, self.n_frames), *self.coordinates.shape[1:])
                handle.create_dataset("coordinates", data=self.coordinates, compression="gzip", shuffle=True,
                                      compression_opts=1, chunks=chunks)  # fmt: skip
                handle.create_dataset("starts", data=self.starts)
                if self.velocities is not None:
                    handle.create_dataset("velocities", data=self.velocities, chunks=chunks)

        create_whole(Path(path), fill)


def load_frames(path: str | Path) -> TrainingFrames:
    """Read what `TrainingFrames.save` wrote. Raises InputError for any other file."""
    import h5py

    try:
        with h5py.File(path, "r") as handle:
            header = json.loads(handle.attrs["surromd_windows"])
            return TrainingFrames(
                scene=Scene.from_dict(header["scene"]),
                coordinates=handle["coordinates"][:],
                starts=handle["starts"][:],
                lag_ps=header["lag_ps"],
                canonical=header["canonical"],
                conditions=header["conditions"],
                sources=tuple(header["sources"]),
                velocities=handle["velocities"][:] if "velocities" in handle else None,
            )
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a windows file of `surromd windows` ({error}).") from error


def is_windows_file(path: str | Path) -> bool:
    """True for a file written by `TrainingFrames.save`."""
    import h5py

    if not h5py.is_hdf5(path):
        return False
    with h5py.File(path, "r") as handle:
        return "surromd_windows" in handle.attrs


def collect_frames(paths: list[Path], *, canonical: bool = True, velocities: bool = False) -> TrainingFrames:
    """Read reference trajectories of one scene. Raises InputError when scenes, save intervals or conditions differ.

    With `velocities`, which excludes `canonical`, frames keep their pose and must carry velocities, natural masses'.
    """
    from systems.trajectory import open_trajectory

    if not paths:
        raise InputError("no trajectory given to train on.")
    if velocities and canonical:
        raise InputError("frames with velocities keep their own pose; they cannot be canonical as well.")
    blocks, sources, lengths, motions = [], [], [], []
    scene: Scene | None = None
    lag_ps, conditions = 0.0, {}
    for path in paths:
        with open_trajectory(path) as reader:
            if reader.scene is None:
                raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
            steps = np.diff(reader.time_ps)
            if len(steps) == 0 or not np.allclose(steps, steps[0], rtol=1e-4):
                raise InputError(f"{path}: frames are not evenly spaced in time; training needs one save interval.")
            found = {key: reader.record.get(key) for key in CONDITIONS}
            if scene is None:
                scene, lag_ps, conditions = reader.scene, float(steps[0]), found
            if reader.scene.topology_hash != scene.topology_hash:
                raise InputError(f"{path} holds another topology than {paths[0]}; one model learns one scene.")
            if not np.isclose(steps[0], lag_ps, rtol=1e-4):
                raise InputError(f"{path} is saved every {steps[0]:g} ps, {paths[0]} every {lag_ps:g} ps.")
            if found != conditions:
                raise InputError(f"{path} was made under {found}, {paths[0]} under {conditions}.")
            digest = hashlib.sha256()
            for k, frames in enumerate(reader.iter_blocks(_BLOCK)):
                if not np.isfinite(frames).all():
                    raise InputError(f"{path} holds frames that are not finite; it cannot be trained on.")
                if velocities:
                    moving = _velocities(reader, k * _BLOCK, len(frames))
                    motions.append(at_rest(moving, scene.masses_da).astype(np.float32))
                    blocks.append(quantise(at_rest(frames, scene.masses_da)))
                else:
                    blocks.append(quantise(canonicalise(frames, scene) if canonical else centre(frames)))
                digest.update(blocks[-1].tobytes())
            sources.append({"file": Path(path).name, "n_frames": reader.n_frames, "seed": reader.record.get("seed"),
                            "sha256": digest.hexdigest()[:16]})  # fmt: skip
            lengths.append(reader.n_frames)
    assert scene is not None
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return TrainingFrames(
        scene,
        np.concatenate(blocks),
        starts,
        lag_ps,
        canonical,
        conditions,
        tuple(sources),
        np.concatenate(motions) if velocities else None,
    )


def _velocities(reader: TrajectoryReader, start: int, n_frames: int) -> npt.NDArray[np.float32]:
    found = reader.read_velocities(start, start + n_frames)
    if found is None:
        raise InputError(
            f"{reader.path} carries no velocities; make the reference with --save-velocities, or train lam-slide."
        )
    if reader.record.get("hydrogen_mass_da") is not None:
        raise InputError(
            f"{reader.path} was made with hydrogens of {reader.record['hydrogen_mass_da']:g} Da, so its velocities are "
            "not the molecule's; make the reference with --hydrogen-mass natural."
        )
    if not np.isfinite(found).all():
        raise InputError(f"{reader.path} holds velocities that are not finite; it cannot be trained on.")
    return found


def at_rest(vectors: npt.NDArray[Any], masses_da: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return positions (or velocities) `(n, n_atoms, 3)` relative to those of the centre of mass."""
    share = masses_da / masses_da.sum()
    return vectors - np.einsum("a,nad->nd", share, vectors, dtype=np.float64)[:, None]


def canonicalise(frames_nm: npt.NDArray[Any], template: Scene) -> npt.NDArray[Any]:
    """Superpose frames on the centred template by heavy atoms; all atoms where fewer than three are heavy."""
    idx = template.heavy_idx if len(template.heavy_idx) >= 3 else np.arange(template.n_atoms)
    target = template.positions_nm - template.positions_nm[idx].mean(axis=0)
    return superpose(frames_nm, target, idx=idx)


def centre(frames_nm: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return frames with their centroid at the origin."""
    return frames_nm - frames_nm.mean(axis=1, keepdims=True)


def quantise(frames_nm: npt.NDArray[Any]) -> npt.NDArray[np.int16]:
    """Round to int16 units of QUANTUM_NM. Raises InputError for a system wider than the format's +-6.5 nm."""
    scaled = np.rint(np.asarray(frames_nm, dtype=np.float64) / QUANTUM_NM)
    if np.abs(scaled).max(initial=0) > 32767:
        raise InputError(f"atoms lie more than {32767 * QUANTUM_NM:.1f} nm from the centre; is the molecule whole?")
    return scaled.astype(np.int16)
