"""Frames to train on: of one scene or of several, read from trajectories, posed, split, and kept as int16."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from systems.chemistry.geometry import superpose
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, TrajectoryError, first_line, listed
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, uneven_by_ps
from systems.trajectory.codec import open_trajectory
from systems.trajectory.joined import refuse_joined
from systems.trajectory.store import open_hdf5

# Successive frames that must agree for a leak: one may coincide by chance in a system of one particle, a run does not.
RUN = 4
# Frames that pass through memory at once.
_BLOCK = 8192
# One unit of the int16 coordinates: 0.0002 nm, range +-6.5 nm. Thermal motion of a bond is ten times larger.
QUANTUM_NM = 2e-4
# Frames beyond this are kept in a file.
MEMORY_BYTES = 2_000_000_000
CONDITIONS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "timestep_ps", "hydrogen_mass_da")


def fitted_atoms(scene: Scene) -> npt.NDArray[np.int64]:
    """Return the atoms that frames are superposed by: the heavy ones, all where fewer than three are heavy."""
    return scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)


def standard_turn(scene: Scene) -> npt.NDArray[np.float64]:
    """Return the rotation `(3, 3)` R that lays a scene along its own axes: x moves to `x @ R.T`.

    Axes are the principal ones of the fitted atoms, the longest first; the first two point to where the third moment of
    all atoms does, the third completes a right-handed system. So the pose does not depend on how the scene came, but
    for shapes that leave the axes open (a line, a symmetric top).
    """
    idx = fitted_atoms(scene)
    centred = scene.positions_nm - scene.positions_nm[idx].mean(axis=0)
    _, vectors = np.linalg.eigh(centred[idx].T @ centred[idx])
    axes = vectors[:, ::-1].T.copy()
    along = centred @ axes.T
    for k in (0, 1):
        if (along[:, k] ** 3).sum() < 0.0:
            axes[k] = -axes[k]
    axes[2] = np.cross(axes[0], axes[1])
    return axes


def in_standard_pose(scene: Scene) -> Scene:
    """Return the scene laid along its own axes (`standard_turn`), the middle of the fitted atoms at the origin."""
    centred = scene.positions_nm - scene.positions_nm[fitted_atoms(scene)].mean(axis=0)
    return scene.with_positions(centred @ standard_turn(scene).T)


@dataclass(frozen=True)
class Split:
    """By time: the last `share` of each trajectory is held out. By trajectory: those of the numbers `held` are, whole,
    and `share` plays no part."""

    share: float = 0.05
    held: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.share < 1.0:
            raise InputError(f"the held-out share must lie between 0 and 1, not {self.share:g}.")

    def ranges(self, starts: npt.NDArray[Any], *, validation: bool) -> list[tuple[int, int]]:
        """Return first and last-plus-one frames of the training or validation stretches.

        `starts`: first frame of each trajectory and, last, the number of frames.
        """
        found = []
        for k, (begin, end) in enumerate(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)):
            cut = int(end - round((end - begin) * self.share))
            if self.held:
                cut = begin if k in self.held else end
            found.append((cut, end) if validation else (begin, cut))
        return [(low, high) for low, high in found if high > low]


@dataclass(frozen=True, eq=False)
class TrainingFrames:
    """Frames of several trajectories of one scene, ready to be cut into windows.

    `coordinates` (n_frames, n_atoms, 3) int16 in units of QUANTUM_NM, centred, and superposed on the scene by its
    heavy atoms when `canonical`. `starts` holds the first frame of each trajectory and, last, n_frames. Frames that
    carry `velocities` (n_frames, n_atoms, 3) nm/ps have their centre of mass at the origin and at rest. `turn` (3, 3):
    applied to frames as they are read, where the scene has been posed anew since they were laid on it.
    """

    scene: Scene
    coordinates: npt.NDArray[np.int16]
    starts: npt.NDArray[np.int64]
    lag_ps: float
    canonical: bool
    conditions: dict[str, Any]
    sources: tuple[dict[str, Any], ...]
    velocities: npt.NDArray[np.float32] | None = None
    split: Split = field(default_factory=Split)
    turn: npt.NDArray[np.float64] | None = None

    @property
    def n_frames(self) -> int:
        return len(self.coordinates)

    @property
    def total_ps(self) -> float:
        return self.n_frames * self.lag_ps

    def positions_nm(self, idx: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return frames `(*idx.shape, n_atoms, 3)` nm."""
        found = self.coordinates[idx].astype(np.float32) * np.float32(QUANTUM_NM)
        return found if self.turn is None else found @ self.turn.T.astype(np.float32)

    def window_starts(self, length: int, *, validation: bool) -> npt.NDArray[np.int64]:
        """Return the first frames of all windows of `length` frames that cross no boundary of trajectories or split.
        Raises InputError where there is none."""
        found = self._starts(length, validation=validation)
        if not len(found):
            which = "validation" if validation else "training"
            raise InputError(f"no {which} window of {length} frames fits; give longer trajectories or shorter chunks.")
        return found

    def _starts(self, length: int, *, validation: bool) -> npt.NDArray[np.int64]:
        ranges = self.split.ranges(self.starts, validation=validation)
        windows = [np.arange(low, high - length + 1, dtype=np.int64) for low, high in ranges]
        return np.concatenate([np.zeros(0, np.int64), *windows])

    def spread_starts(self, n: int, length: int = 1, *, validation: bool = False) -> npt.NDArray[np.int64]:
        """Return the first frames of at most `n` of these windows, evenly spaced."""
        found = self.window_starts(length, validation=validation)
        return found[np.linspace(0, len(found) - 1, min(n, len(found))).astype(int)]

    def some_nm(self, n: int) -> npt.NDArray[np.float32]:
        """Return at most `n` training frames `(n, n_atoms, 3)` nm, evenly spaced."""
        return self.positions_nm(self.spread_starts(n))

    @property
    def origin(self) -> dict[str, Any]:
        return FrameSets((self,)).origin

    def refuse_leaks(self) -> None:
        """Raise InputError when a run of RUN held-out frames is also trained on, as when a trajectory is given twice,
        or once whole and once in part."""
        rng, size = np.random.default_rng(0), self.coordinates[0].size
        factors = rng.integers(0, 2**64, size=size, dtype=np.uint64) | np.uint64(1)
        # Products and sums wrap: fingerprints of frames, and of runs of them, modulo 2^64.
        blocks = (self.coordinates[k : k + _BLOCK].reshape(-1, size) for k in range(0, self.n_frames, _BLOCK))
        marks = np.concatenate([block.astype(np.int64).view(np.uint64) @ factors for block in blocks])
        runs = np.zeros(max(self.n_frames - RUN + 1, 0), dtype=np.uint64)
        for k in range(RUN):
            runs = runs * np.uint64(0x9E3779B97F4A7C15) + marks[k : k + len(runs)]
        trained, held = (self._starts(RUN, validation=validation) for validation in (False, True))
        leaked = held[np.isin(runs[held], runs[trained])]
        leaked = leaked[marks[leaked] != marks[leaked + RUN - 1]]  # a system that does not move holds one frame alone
        if len(leaked):
            which = int(np.searchsorted(self.starts, leaked[0], side="right")) - 1
            name = self.sources[which]["file"] if self.sources else f"trajectory {which}"
            raise InputError(
                f"{name}: frame {leaked[0] - self.starts[which]} and {len(leaked) - 1} later stretches are held out "
                "for validation and trained on as well, under the same or another name; give each trajectory once."
            )

    def save(self, path: str | Path) -> None:
        """Write one HDF5 file that `load_frames` takes back; it appears whole or not at all."""
        if self.turn is not None:
            raise InputError("frames that have been posed anew are not kept; save them as they were read.")
        header = {"scene": self.scene.to_dict(), "lag_ps": self.lag_ps, "canonical": self.canonical,
                  "conditions": self.conditions, "sources": self.sources, "quantum_nm": QUANTUM_NM,
                  "split": asdict(self.split)}  # fmt: skip

        def fill(temporary: Path) -> None:
            with h5py.File(temporary, "w") as handle:
                # Neither chunked nor compressed: only so can they be mapped.
                handle.create_dataset("coordinates", data=self.coordinates)
                if self.velocities is not None:
                    handle.create_dataset("velocities", data=self.velocities)
                handle.attrs["surromd_windows"] = json.dumps(header)
                handle.create_dataset("starts", data=self.starts)

        create_whole(Path(path), fill)


@dataclass(frozen=True)
class _Header:
    """The record of a windows file."""

    scene: Scene
    lag_ps: float
    canonical: bool
    conditions: dict[str, float | bool | str | None]
    sources: tuple[dict[str, Any], ...]
    quantum_nm: float = QUANTUM_NM
    split: Split = field(default_factory=Split)


def load_frames(path: str | Path) -> TrainingFrames:
    """Map what `TrainingFrames.save` wrote. Raises InputError for any other file."""
    path = Path(path)
    try:
        with open_hdf5(path) as handle:
            header, starts = built(_Header, parsed(handle.attrs["surromd_windows"])), handle["starts"][:]
            columns = [_mapped(path, handle[name]) for name in ("coordinates", "velocities") if name in handle]
    except (OSError, LookupError, ValueError, RuntimeError, TypeError, TrajectoryError) as error:
        raise InputError(f"{path} is not a windows file of `surromd windows` ({first_line(error)}).") from error
    shape = (int(starts[-1]) if starts.ndim == 1 and len(starts) > 1 else -1, header.scene.n_atoms, 3)
    found = [(column.shape, column.dtype.str) for column in columns]
    if found != [(shape, dtype) for dtype in ("<i2", "<f4")][: len(found)] or (np.diff(starts, prepend=0) < 0).any():
        raise InputError(f"{path} is damaged: its frames are not those that it says it holds.")
    if header.quantum_nm != QUANTUM_NM:
        raise InputError(f"{path} counts in units of {header.quantum_nm:g} nm, not {QUANTUM_NM:g}; make it again.")
    velocities = columns[1] if len(columns) > 1 else None
    return TrainingFrames(header.scene, columns[0], starts, header.lag_ps, header.canonical, header.conditions,
                          header.sources, velocities, header.split)  # fmt: skip


def _mapped(path: Path, dataset: h5py.Dataset) -> npt.NDArray[Any]:
    if (offset := dataset.id.get_offset()) is None:
        raise ValueError(f"{dataset.name} lies in pieces")
    return np.memmap(path, dtype=dataset.dtype, mode="r", offset=offset, shape=dataset.shape)


def is_windows(path: Path) -> bool:
    """True for a windows file; a damaged file is none, so that opening it as a trajectory says what is wrong."""
    try:
        with open_hdf5(path) as handle:
            return "surromd_windows" in handle.attrs
    except TrajectoryError:
        return False


def collect_frames(
    paths: Sequence[Path], *, canonical: bool = True, velocities: bool = False, held: Sequence[Path] = (),
    memory_bytes: int = MEMORY_BYTES, spool: Path | None = None,
) -> TrainingFrames:  # fmt: skip
    """Read reference trajectories of one scene. Raises InputError when scenes, save intervals or conditions differ.

    With `velocities`, which excludes `canonical`, frames keep their pose and must carry velocities, natural masses'.
    `held`: trajectories that are held out whole; without any, the end of each is. More than `memory_bytes` of frames
    are kept in a nameless file in the folder `spool`, mapped, which goes when the process does. `sources` name each
    file's frames by digests: `sha256` of them as they were laid, which hangs on the first file of all, and
    `shape_sha256` of their distances from the first atom, which does not. MD under an umbrella potential, from
    which no motion can be learned, is refused.
    """
    if velocities and canonical:
        raise InputError("frames with velocities keep their own pose; they cannot be canonical as well.")
    files = [*paths, *held]
    scene, lag_ps, conditions, starts = _agreed(files)
    shape = (int(starts[-1]), scene.n_atoms, 3)
    folder = spool or Path(tempfile.gettempdir())
    kept = folder if shape[0] * shape[1] * (18 if velocities else 6) > memory_bytes else None
    coordinates = _room(shape, np.int16, kept)
    moving = _room(shape, np.float32, kept) if velocities else None
    sources = []
    for path, begin in zip(files, starts[:-1].tolist(), strict=True):
        with open_trajectory(path) as reader:
            if reader.record.get("umbrella"):
                raise InputError(f"{path} was made under an umbrella potential, which tells no motion; leave it out.")
            digest, shape_digest, at = hashlib.sha256(), hashlib.sha256(), begin
            for frames in reader.iter_blocks(_BLOCK):
                block = slice(at, at + len(frames))
                if not np.isfinite(frames).all():
                    raise InputError(f"{path} holds frames that are not finite; it cannot be trained on.")
                if moving is not None:
                    moving[block] = at_rest(_velocities(reader, at - begin, len(frames)), scene.masses_da)
                    posed = at_rest(frames, scene.masses_da)
                elif canonical:
                    posed = canonicalise(frames, scene)
                else:
                    posed = frames - frames.mean(axis=1, keepdims=True)
                coordinates[block] = quantise(posed)
                digest.update(coordinates[block].tobytes())
                reach_nm = np.linalg.norm(frames - frames[:, :1].astype(np.float64), axis=-1)
                shape_digest.update(np.rint(reach_nm / QUANTUM_NM).astype(np.int32).tobytes())
                at += len(frames)
            sources.append({"file": Path(path).name, "n_frames": reader.n_frames, "seed": reader.record.get("seed"),
                            "topology": scene.topology_hash, "sha256": digest.hexdigest()[:16],
                            "shape_sha256": shape_digest.hexdigest()[:16]})  # fmt: skip
    split = Split(held=tuple(range(len(paths), len(files))))
    return TrainingFrames(scene, coordinates, starts, lag_ps, canonical, conditions, tuple(sources), moving, split)


def _agreed(paths: list[Path]) -> tuple[Scene, float, dict[str, Any], npt.NDArray[np.int64]]:
    """Return scene, time between frames, conditions and `starts` of trajectories of which no frame is read yet. Raises
    InputError when they do not go together."""
    scene: Scene | None = None
    lag_ps, conditions, lengths = 0.0, dict[str, Any](), [0]
    for path in paths:
        with open_trajectory(path) as reader:
            refuse_joined(reader)
            steps = np.diff(reader.time_ps)
            step = float(f"{steps.mean():.6g}") if len(steps) else 0.0
            if len(steps) == 0 or np.abs(steps - step).max() > uneven_by_ps(reader.time_ps, step):
                raise InputError(f"{path}: frames are not evenly spaced in time; training needs one save interval.")
            found = {key: reader.record.get(key) for key in CONDITIONS}
            if reader.record.get("constrain_hydrogens") is False:
                found["constrain_hydrogens"] = False
            own = _scene_of(reader)
            if scene is None:
                scene, lag_ps, conditions = own, step, found
            if own.topology_hash != scene.topology_hash:
                raise InputError(
                    f"{path} holds another topology than {paths[0]}; one model learns one scene, or several peptides "
                    "(`arch='lam-slide-peptides'`)."
                )
            if not np.isclose(step, lag_ps, rtol=1e-3):
                raise InputError(f"{path} is saved every {step:g} ps, {paths[0]} every {lag_ps:g} ps.")
            if found != conditions:
                differ = [key for key in {**conditions, **found} if found.get(key) != conditions.get(key)]
                one, other = (listed([f"{k} {of.get(k)}" for k in differ]) for of in (found, conditions))
                raise InputError(f"{path} was made under other conditions ({one}) than {paths[0]} ({other}).")
            lengths.append(reader.n_frames)
    if scene is None:
        raise InputError("no trajectory given to train on.")
    return scene, lag_ps, conditions, np.cumsum(lengths).astype(np.int64)


def _room(shape: tuple[int, ...], dtype: npt.DTypeLike, folder: Path | None) -> npt.NDArray[Any]:
    """Return an array to be filled: in memory, or mapped from a nameless file in a folder."""
    if folder is None:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):
            # A full disk is an error here; where a page is written later it would be a signal.
            os.posix_fallocate(file.fileno(), 0, int(np.prod(shape)) * np.dtype(dtype).itemsize)
        return np.memmap(file, dtype=dtype, mode="w+", shape=shape)


def _scene_of(reader: TrajectoryReader) -> Scene:
    if reader.scene is None:
        raise InputError(f"{reader.path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
    return reader.scene


def _velocities(reader: TrajectoryReader, start: int, n_frames: int) -> npt.NDArray[np.float32]:
    found = reader.read_velocities(start, start + n_frames)
    if found is None:
        raise InputError(
            f"{reader.path} carries no velocities; make the reference with `save_velocities=True`, or train lam-slide."
        )
    if reader.record.get("hydrogen_mass_da") is not None:
        raise InputError(
            f"{reader.path} was made with hydrogens of {reader.record['hydrogen_mass_da']:g} Da, so its velocities are "
            "not the molecule's; make the reference with `hydrogen_mass_da='natural'`."
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
    idx = fitted_atoms(template)
    target = template.positions_nm - template.positions_nm[idx].mean(axis=0)
    return superpose(frames_nm, target, idx=idx)


def quantise(frames_nm: npt.NDArray[Any]) -> npt.NDArray[np.int16]:
    """Round to int16 units of QUANTUM_NM. Raises InputError for a system wider than the format's +-6.5 nm."""
    scaled = np.rint(np.asarray(frames_nm, dtype=np.float64) / QUANTUM_NM)
    if np.abs(scaled).max(initial=0) > 32767:
        raise InputError(f"atoms lie more than {32767 * QUANTUM_NM:.1f} nm from the centre; is the molecule whole?")
    return scaled.astype(np.int16)


# Windows of frames that stand one, two, ... up to a thousand spacings apart, for a model that takes the lag.

_PER_DECADE = 8


def strides_up_to(longest: int) -> tuple[int, ...]:
    """Return strides from 1 to `longest`, evenly spaced in their logarithm, about eight a decade."""
    n = max(2, round(_PER_DECADE * np.log10(longest)) + 1)
    return tuple(sorted({round(float(x)) for x in np.geomspace(1, longest, n)})) if longest > 1 else (1,)


class StrideSampler(NamedTuple):
    """Draws windows of any of `strides`, each as likely; `starts[k]` (n_k,) are the first frames of those of stride
    k."""

    strides: tuple[int, ...]
    starts: tuple[Tensor, ...]

    @staticmethod
    def of(frames: TrainingFrames, length: int, strides: Sequence[int], *, validation: bool = False) -> StrideSampler:
        """Return the sampler of windows of `length` frames. Raises InputError where one of the longest does not fit
        into a training stretch; validation takes those that fit."""
        found: list[tuple[int, Tensor]] = []
        for stride in strides:
            span = (length - 1) * stride + 1
            try:
                found.append((stride, torch.from_numpy(frames.window_starts(span, validation=validation))))
            except InputError as error:
                if validation and found:
                    break
                raise InputError(
                    f"{frames.scene.name}: no window of {length} frames {stride * frames.lag_ps:g} ps apart fits; give "
                    "longer trajectories, a shorter `longest_lag_ps` or shorter chunks."
                ) from error
        return StrideSampler(tuple(s for s, _ in found), tuple(starts for _, starts in found))

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return first frames `(n,)` and strides `(n,)`."""
        if len(self.strides) == 1:
            own = self.starts[0]
            return own[torch.randint(len(own), (n,), generator=generator)], torch.full((n,), self.strides[0])
        which = torch.randint(len(self.strides), (n,), generator=generator)
        place = torch.rand(n, generator=generator, dtype=torch.float64)
        sizes = torch.tensor([len(starts) for starts in self.starts])
        first = torch.empty(n, dtype=torch.int64)
        for k, starts in enumerate(self.starts):
            rows = which == k
            first[rows] = starts[(place[rows] * sizes[k]).long()]
        return first, torch.tensor(self.strides)[which]


class FrameSets(NamedTuple):
    """Frames of several molecules. Those `trained` on hold their own validation stretches; those of `unseen` are held
    out whole: curves are measured on them, and nothing is learned from them."""

    trained: tuple[TrainingFrames, ...]
    unseen: tuple[TrainingFrames, ...] = ()

    @property
    def names(self) -> str:
        return ", ".join(frames.scene.name for frames in self.trained)

    @property
    def origin(self) -> dict[str, Any]:
        """How much reference is trained on, and of which files, as the record of a training has it."""
        sources = [source for frames in self.trained for source in frames.sources]
        return {"reference_ns": sum(frames.total_ps for frames in self.trained) * 1e-3, "sources": sources}


class Survey(NamedTuple):
    """A summary of the trajectories to train on, made without reading their frames.

    `scenes`: each molecule trained on once; `unseen`: those that appear in the validation alone. `longest`: frames of
    the longest trajectory of each of `scenes`. `lag_ps`: time between frames. `equilibrium`: whether all were simulated
    at constant temperature.
    """

    scenes: tuple[Scene, ...]
    unseen: tuple[Scene, ...]
    longest: tuple[int, ...]
    lag_ps: float
    equilibrium: bool


@dataclass(frozen=True)
class References:
    """Files to train on. `held`: trajectories that are held out whole, for validation. `spool`: a folder for frames
    that memory does not hold."""

    paths: tuple[Path, ...]
    held: tuple[Path, ...] = ()
    spool: Path | None = None

    @cached_property
    def survey(self) -> Survey:
        """Return what the files say of themselves. Raises InputError for a file without topology or times."""
        if not self.paths:
            raise InputError("no trajectory given to train on.")
        files = [_summary(path) for path in (*self.paths, *self.held)]
        trained, unseen, longest = dict[str, Scene](), dict[str, Scene](), dict[str, int]()
        for k, (scene, n_frames, _, _) in enumerate(files):
            key = scene.topology_hash
            if k < len(self.paths):
                trained.setdefault(key, scene)
                longest[key] = max(longest.get(key, 0), n_frames)
            elif key not in trained:
                unseen.setdefault(key, scene)
        equilibrium = all(constant for *_, constant in files)
        return Survey((*trained.values(),), (*unseen.values(),), (*longest.values(),), files[0][2], equilibrium)

    def frames(self, *, canonical: bool, velocities: bool = False) -> TrainingFrames:
        """Return the frames of one molecule, from trajectories or from one windows file.

        Raises InputError for files of several molecules, save intervals or conditions; for windows without the
        velocities that are asked for, or in another pose; and where a stretch of motion would be both trained on and
        validated on.
        """
        return _read(self.paths, self.held, self.spool, canonical=canonical, velocities=velocities)

    def sets(self) -> FrameSets:
        """Return the frames of any number of molecules, canonical and in standard poses.

        Trajectories in `held` of a molecule that is trained on are its validation; molecules that appear in `held`
        alone are held out as systems. Raises InputError when save intervals or temperatures differ, when one molecule
        comes in two atom orders, and for leaks of frames.
        """
        grouped, also = _by_topology(self.paths), _by_topology(self.held)
        trained = [_read(files, also.pop(key, []), self.spool, canonical=True) for key, files in grouped.items()]
        unseen = [_read(files, [], self.spool, canonical=True) for files in also.values()]
        unseen = [replace(frames, split=Split(held=tuple(range(len(frames.starts) - 1)))) for frames in unseen]
        sets = FrameSets(tuple(map(_pose, trained)), tuple(map(_pose, unseen)))
        first, by_molecule = sets.trained[0], dict[str, TrainingFrames]()
        for frames in (*sets.trained, *sets.unseen):
            name = frames.scene.name
            if not np.isclose(frames.lag_ps, first.lag_ps, rtol=1e-4):
                raise InputError(
                    f"{name} is saved every {frames.lag_ps:g} ps, {first.scene.name} every {first.lag_ps:g} ps; one "
                    "model learns one interval (and multiples of it)."
                )
            here_k, first_k = (some.conditions.get("temperature_k") for some in (frames, first))
            if here_k != first_k:
                raise InputError(
                    f"{name} was made at {here_k} K, {first.scene.name} at {first_k} K; this model takes none."
                )
            other = by_molecule.setdefault(molecule_key(frames.scene), frames)
            if other is not frames and other.scene.topology_hash == frames.scene.topology_hash:
                held = "a windows file keeps its own split; leave it out of `validation`"
                several = "comes in several files, windows among them; make one windows file of all its trajectories"
                raise InputError(f"{name}: {held}." if frames in sets.unseen else f"{name} {several}.")
            if other is not frames:
                both = " and would be both trained on and held out" if frames in sets.unseen else ""
                raise InputError(
                    f"{name} and {other.scene.name} are one molecule in two atom orders{both}; give it in one."
                )
        return sets


def rollouts_among(paths: Sequence[Path]) -> list[str]:
    """Return a line where trajectories are rollouts and no MD, as their records say, else none."""
    weights = []
    for path in paths:
        if not is_windows(path):
            with open_trajectory(path) as reader:
                weights += [str(reader.record.get("weights"))] if reader.record.get("kind") == "rollout" else []
    if not weights:
        return []
    of = " and ".join(dict.fromkeys(weights))
    return [f"{len(weights)} of {len(paths)} files are rollouts of {of}, no MD; what is trained on them has its errors"]


def _by_topology(paths: Sequence[Path]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in paths:
        key = f"windows {path}" if is_windows(path) else _summary(path)[0].topology_hash
        found.setdefault(key, []).append(path)
    return found


def _read(paths: Sequence[Path], held: Sequence[Path], spool: Path | None, *, canonical: bool,
          velocities: bool = False) -> TrainingFrames:  # fmt: skip
    if not any(map(is_windows, paths)):
        frames = collect_frames(paths, canonical=canonical, velocities=velocities, held=held, spool=spool)
    elif held:
        raise InputError("`validation` needs trajectories to train on; a windows file keeps its own split.")
    elif len(paths) > 1:
        raise InputError("give either trajectories or one windows file to train on.")
    else:
        frames = load_frames(paths[0])
        if velocities and frames.velocities is None:
            raise InputError(
                f"{paths[0]} holds no velocities, which this architecture learns from; make it with `velocities=True` "
                "of `windows`."
            )
        if canonical and not frames.canonical:
            raise InputError(
                f"{paths[0]} holds frames in their own pose; make it canonical, without `velocities=True`."
            )
    frames.refuse_leaks()
    return frames


def _pose(frames: TrainingFrames) -> TrainingFrames:
    """Return the frames with their template along its own axes; they are turned as they are read."""
    return replace(frames, scene=in_standard_pose(frames.scene), turn=standard_turn(frames.scene))


def _summary(path: Path) -> tuple[Scene, int, float, bool]:
    """Return a file's scene, the frames of its longest trajectory, the time between frames, and whether it was
    simulated at constant temperature."""
    if is_windows(path):
        frames = load_frames(path)
        constant = frames.conditions.get("temperature_k") is not None
        return frames.scene, int(np.diff(frames.starts).max()), frames.lag_ps, constant
    with open_trajectory(path) as reader:
        lag_ps = float(reader.time_ps[1] - reader.time_ps[0]) if reader.n_frames > 1 else 0.0
        constant = reader.record.get("kind") == "reference" and reader.record.get("temperature_k") is not None
        return _scene_of(reader), reader.n_frames, lag_ps, constant
