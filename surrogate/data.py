"""Frames to train on: of one scene or of several, read from trajectories, posed, split, and kept as int16."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from systems.chemistry.geometry import superpose
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, TrajectoryError, first_line
from systems.files.schema import built, parsed
from systems.files.whole_file import create_whole
from systems.scene import Scene
from systems.trajectory.store import open_hdf5

if TYPE_CHECKING:
    import h5py

    from systems.trajectory.base import TrajectoryReader


def fitted_atoms(scene: Scene) -> npt.NDArray[np.int64]:
    """Return the atoms that frames are superposed by: the heavy ones, all where fewer than three are heavy."""
    return scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)


def standard_turn(scene: Scene) -> npt.NDArray[np.float64]:
    """Return the rotation `(3, 3)` R that lays a scene along its own axes: x moves to `x @ R.T`.

    Axes are the principal ones of the fitted atoms, the longest first; the first two point to where the third moment of
    all atoms does, the third completes a right-handed system. So a molecule that no training saw has a pose, too, which
    does not depend on how the scene came, but for shapes that leave the axes open (a line, a symmetric top).
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


# Successive frames that must agree for a leak: one may coincide by chance in a system of one particle, a run does not.
RUN = 4
# Frames that pass through memory at once.
_BLOCK = 8192


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


def refuse_leaks(coordinates: npt.NDArray[Any], starts: npt.NDArray[Any], split: Split,
                 name: Callable[[int], str]) -> None:  # fmt: skip
    """Raise InputError when a run of RUN held-out frames is also trained on, as when a trajectory is given twice, or
    once whole and once in part.

    `coordinates` (n_frames, n_atoms, 3) int16, in one pose, so that the same frame has the same numbers; read in
    blocks. `name(k)`: what trajectory k is called.
    """
    known = np.unique(np.concatenate([runs for _, runs in _runs(coordinates, split.ranges(starts, validation=False))]
                                     or [np.zeros(0, np.uint64)]))  # fmt: skip
    for first, runs in _runs(coordinates, split.ranges(starts, validation=True)):
        place = np.searchsorted(known, runs).clip(max=max(len(known) - 1, 0))
        seen = np.flatnonzero(known[place] == runs) if len(known) else np.zeros(0, np.int64)
        moving = [k for k in seen.tolist() if (coordinates[first + k] != coordinates[first + k + RUN - 1]).any()]
        if moving:
            frame = first + moving[0]
            which = int(np.searchsorted(starts, frame, side="right")) - 1
            raise InputError(
                f"{name(which)}: frame {frame - int(starts[which])} and {len(moving) - 1} later stretches are held out "
                "for validation and trained on as well, under the same or another name; give each trajectory once."
            )


def _runs(coordinates: npt.NDArray[Any], ranges: list[tuple[int, int]]) -> Iterator[tuple[int, npt.NDArray[np.uint64]]]:
    """First frame and fingerprints of all runs of RUN frames, in blocks that end with a range."""
    rng = np.random.default_rng(0)
    factors = rng.integers(0, 2**64, size=coordinates[0].size, dtype=np.uint64) | np.uint64(1)
    for low, high in ranges:
        for start in range(low, high - RUN + 1, _BLOCK):
            block = coordinates[start : min(start + _BLOCK + RUN - 1, high)]
            # Products and sums wrap: a fingerprint modulo 2^64.
            marks = block.reshape(len(block), -1).astype(np.int64).view(np.uint64) @ factors
            n = len(marks) - RUN + 1
            runs = np.zeros(n, dtype=np.uint64)
            for k in range(RUN):
                runs = runs * np.uint64(0x9E3779B97F4A7C15) + marks[k : k + n]
            yield start, runs


# Training frames of one scene in compact form: read from trajectories, canonicalised once, kept as int16; in a windows
# file they are mapped, not read.
# One unit of the int16 coordinates: 0.0002 nm, range +-6.5 nm. Thermal motion of a bond is ten times larger.
QUANTUM_NM = 2e-4
# Frames beyond this are kept in a file.
MEMORY_BYTES = 2_000_000_000
CONDITIONS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "timestep_ps", "hydrogen_mass_da")


@dataclass(frozen=True)
class _Header:
    """What a windows file says of its frames."""

    scene: Scene
    lag_ps: float
    canonical: bool
    conditions: dict[str, float | bool | str | None]
    sources: tuple[dict[str, Any], ...]
    quantum_nm: float = QUANTUM_NM
    split: Split = field(default_factory=Split)

    def of(self, coordinates: Any, starts: npt.NDArray[np.int64], velocities: Any) -> TrainingFrames:
        """Return the frames in `coordinates` (n_frames, n_atoms, 3) int16, with this header."""
        return TrainingFrames(self.scene, coordinates, starts, self.lag_ps, self.canonical, self.conditions,
                              self.sources, velocities, self.split)  # fmt: skip

    def enter(self, handle: h5py.File, starts: npt.NDArray[np.int64]) -> None:
        """Write header and `starts` into a windows file that holds the frames already."""
        split = {"share": self.split.share, "held": list(self.split.held)}
        plain = {"scene": self.scene.to_dict(), "sources": list(self.sources), "split": split}
        handle.attrs["surromd_windows"] = json.dumps({**vars(self), **plain})
        handle.create_dataset("starts", data=starts)


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
        found = [
            np.arange(low, high - length + 1, dtype=np.int64)
            for low, high in self.split.ranges(self.starts, validation=validation)
            if high - low >= length
        ]
        if not found:
            kind = "validation" if validation else "training"
            raise InputError(f"no {kind} window of {length} frames fits; give longer trajectories or shorter chunks.")
        return np.concatenate(found)

    def spread_starts(self, n: int, length: int = 1, *, validation: bool = False) -> npt.NDArray[np.int64]:
        """Return the first frames of at most `n` of these windows, evenly spaced."""
        found = self.window_starts(length, validation=validation)
        return found[np.linspace(0, len(found) - 1, min(n, len(found))).astype(int)]

    def some_nm(self, n: int) -> npt.NDArray[np.float32]:
        """Return at most `n` training frames `(n, n_atoms, 3)` nm, evenly spaced."""
        return self.positions_nm(self.spread_starts(n))

    @property
    def origin(self) -> dict[str, Any]:
        """How much reference these frames are, and of which files, as the record of a training has it."""
        return {"reference_ns": self.total_ps * 1e-3, "sources": list(self.sources)}

    def refuse_leaks(self) -> None:
        """Raise InputError when held-out frames are trained on as well."""
        names = [str(source["file"]) for source in self.sources]
        refuse_leaks(self.coordinates, self.starts, self.split, lambda k: names[k] if names else f"trajectory {k}")

    def save(self, path: str | Path) -> None:
        """Write one HDF5 file that `load_frames` takes back; it appears whole or not at all."""
        if self.turn is not None:
            raise InputError("frames that have been posed anew are not kept; save them as they were read.")

        def fill(temporary: Path) -> None:
            with _new_file(temporary, self.n_frames, self.scene.n_atoms, moving=self.velocities is not None) as handle:
                for start in range(0, self.n_frames, _BLOCK):
                    part = slice(start, min(start + _BLOCK, self.n_frames))
                    handle["coordinates"][part] = self.coordinates[part]
                    if self.velocities is not None:
                        handle["velocities"][part] = self.velocities[part]
                _Header(self.scene, self.lag_ps, self.canonical, self.conditions, self.sources, split=self.split).enter(
                    handle, self.starts
                )

        create_whole(Path(path), fill)


def _new_file(path: Path, n_frames: int, n_atoms: int, *, moving: bool) -> h5py.File:
    import h5py

    handle = h5py.File(path, "w")
    # Neither chunked nor compressed: only so can they be mapped.
    handle.create_dataset("coordinates", (n_frames, n_atoms, 3), dtype=np.int16)
    if moving:
        handle.create_dataset("velocities", (n_frames, n_atoms, 3), dtype=np.float32)
    return handle


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
    kinds = [(column.shape, column.dtype.str) for column in columns]
    if kinds != [(shape, kind) for kind in ("<i2", "<f4")][: len(kinds)] or (np.diff(starts, prepend=0) < 0).any():
        raise InputError(f"{path} is damaged: its frames are not those that it says it holds.")
    return header.of(columns[0], starts, columns[1] if len(columns) > 1 else None)


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
    paths: list[Path], *, canonical: bool = True, velocities: bool = False, held: list[Path] | None = None,
    memory_bytes: int = MEMORY_BYTES, spool: Path | None = None,
) -> TrainingFrames:  # fmt: skip
    """Read reference trajectories of one scene. Raises InputError when scenes, save intervals or conditions differ.

    With `velocities`, which excludes `canonical`, frames keep their pose and must carry velocities, natural masses'.
    `held`: trajectories that are held out whole; without any, the end of each is. More than `memory_bytes` of frames
    are kept in a nameless file in the folder `spool`, mapped, which goes when the process does.
    """
    found = _survey(paths, held or [], canonical=canonical, velocities=velocities)
    n_frames, n_atoms = int(found.starts[-1]), found.header.scene.n_atoms
    if n_frames * n_atoms * (18 if velocities else 6) <= memory_bytes:
        coordinates = np.empty((n_frames, n_atoms, 3), dtype=np.int16)
        moving = np.empty((n_frames, n_atoms, 3), dtype=np.float32) if velocities else None
        return found.read_into(coordinates, moving).of(coordinates, found.starts, moving)
    with tempfile.TemporaryDirectory(dir=spool, prefix=".surromd-windows-") as folder:
        file = Path(folder) / "windows.h5"
        write_windows(paths, file, canonical=canonical, velocities=velocities, held=held)
        return load_frames(file)


def write_windows(
    paths: list[Path], out: Path, *, canonical: bool = True, velocities: bool = False, held: list[Path] | None = None
) -> None:
    """Write what `collect_frames` returns to a windows file, block by block: trajectories may be larger than memory."""
    found = _survey(paths, held or [], canonical=canonical, velocities=velocities)

    def fill(temporary: Path) -> None:
        n_frames, n_atoms = int(found.starts[-1]), found.header.scene.n_atoms
        with _new_file(temporary, n_frames, n_atoms, moving=velocities) as handle:
            header = found.read_into(handle["coordinates"], handle["velocities"] if velocities else None)
            header.enter(handle, found.starts)

    create_whole(out, fill)


@dataclass(frozen=True, eq=False)
class _Survey:
    """What trajectories say of themselves, no frame read yet. `starts`: see TrainingFrames."""

    paths: tuple[Path, ...]
    header: _Header
    starts: npt.NDArray[np.int64]

    def read_into(self, coordinates: Any, moving: Any) -> _Header:
        """Read all frames into `coordinates` and, unless None, `moving` (arrays or data sets); return the header with
        its sources."""
        from systems.trajectory.codec import open_trajectory

        scene, sources = self.header.scene, []
        for path, begin in zip(self.paths, self.starts[:-1].tolist(), strict=True):
            with open_trajectory(path) as reader:
                digest, at = hashlib.sha256(), begin
                for frames in reader.iter_blocks(_BLOCK):
                    if not np.isfinite(frames).all():
                        raise InputError(f"{path} holds frames that are not finite; it cannot be trained on.")
                    if moving is not None:
                        given = _velocities(reader, at - begin, len(frames))
                        moving[at : at + len(frames)] = at_rest(given, scene.masses_da).astype(np.float32)
                        posed = at_rest(frames, scene.masses_da)
                    elif self.header.canonical:
                        posed = canonicalise(frames, scene)
                    else:
                        posed = frames - frames.mean(axis=1, keepdims=True)
                    block = quantise(posed)
                    coordinates[at : at + len(frames)] = block
                    digest.update(block.tobytes())
                    at += len(frames)
                sources.append({"file": Path(path).name, "n_frames": reader.n_frames,
                                "seed": reader.record.get("seed"), "sha256": digest.hexdigest()[:16]})  # fmt: skip
        return replace(self.header, sources=tuple(sources))


def _survey(paths: list[Path], held: list[Path], *, canonical: bool, velocities: bool) -> _Survey:
    """Return what the files say of themselves. Raises InputError when they do not go together."""
    from systems.trajectory.codec import open_trajectory

    if not paths:
        raise InputError("no trajectory given to train on.")
    if velocities and canonical:
        raise InputError("frames with velocities keep their own pose; they cannot be canonical as well.")
    scene: Scene | None = None
    lag_ps, conditions, lengths = 0.0, {}, []
    for path in [*paths, *held]:
        with open_trajectory(path) as reader:
            if reader.scene is None:
                raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
            steps = np.diff(reader.time_ps)
            if len(steps) == 0 or not np.allclose(steps, steps[0], rtol=1e-4):
                raise InputError(f"{path}: frames are not evenly spaced in time; training needs one save interval.")
            found = {key: reader.record.get(key) for key in CONDITIONS}
            if reader.record.get("constrain_hydrogens") is False:
                found["constrain_hydrogens"] = False
            if scene is None:
                scene, lag_ps, conditions = reader.scene, float(steps[0]), found
            if reader.scene.topology_hash != scene.topology_hash:
                raise InputError(
                    f"{path} holds another topology than {paths[0]}; one model learns one scene, or several peptides "
                    "(`arch='lam-slide-peptides'`)."
                )
            if not np.isclose(steps[0], lag_ps, rtol=1e-4):
                raise InputError(f"{path} is saved every {steps[0]:g} ps, {paths[0]} every {lag_ps:g} ps.")
            if found != conditions:
                raise InputError(f"{path} was made under {found}, {paths[0]} under {conditions}.")
            lengths.append(reader.n_frames)
    assert scene is not None
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    split = Split(held=tuple(range(len(paths), len(lengths))))
    return _Survey((*paths, *held), _Header(scene, lag_ps, canonical, conditions, (), split=split), starts)


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


@dataclass(frozen=True, eq=False)
class FrameSets:
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


def collect_sets(paths: list[Path], *, held: list[Path] | None = None, spool: Path | None = None) -> FrameSets:
    """Read reference trajectories, or windows files, of any number of molecules, canonical and in standard poses.

    Trajectories in `held` of a molecule that is trained on are its validation; molecules that appear in `held` alone
    are held out as systems. Raises InputError when save intervals or temperatures differ, when one molecule comes in
    two atom orders, so that it would be trained on under one and held out under the other, and for leaks of frames.
    """
    seen, also = _by_topology(paths), _by_topology(held or [])
    trained = [_read(files, also.pop(key, []), spool) for key, files in seen.items()]
    unseen = [_read(files, [], spool) for files in also.values()]
    unseen = [replace(frames, split=Split(held=tuple(range(len(frames.starts) - 1)))) for frames in unseen]
    sets = FrameSets(tuple(map(_pose, trained)), tuple(map(_pose, unseen)))
    first, keys = sets.trained[0], dict[str, TrainingFrames]()
    for frames in (*sets.trained, *sets.unseen):
        name = frames.scene.name
        if not np.isclose(frames.lag_ps, first.lag_ps, rtol=1e-4):
            raise InputError(
                f"{name} is saved every {frames.lag_ps:g} ps, {first.scene.name} every {first.lag_ps:g} ps; one model "
                "learns one interval (and multiples of it)."
            )
        asked, known = (f.conditions.get("temperature_k") for f in (frames, first))
        if asked != known:
            raise InputError(f"{name} was made at {asked} K, {first.scene.name} at {known} K; this model takes none.")
        other = keys.setdefault(molecule_key(frames.scene), frames)
        if other is not frames:
            both = " and would be both trained on and held out" if frames in sets.unseen else ""
            raise InputError(
                f"{name} and {other.scene.name} are one molecule in two atom orders{both}; give it in one."
            )
        frames.refuse_leaks()
    return sets


def _by_topology(paths: list[Path]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in paths:
        key = f"windows {path}" if is_windows(path) else _summary(path).scene.topology_hash
        found.setdefault(key, []).append(path)
    return found


def _read(paths: list[Path], held: list[Path], spool: Path | None) -> TrainingFrames:
    if not is_windows(paths[0]):
        return collect_frames(paths, held=held, spool=spool)
    frames = load_frames(paths[0])
    if not frames.canonical:
        raise InputError(f"{paths[0]} holds frames in their own pose; make it without `velocities=True`.")
    return frames


def _pose(frames: TrainingFrames) -> TrainingFrames:
    """Return the frames with their template along its own axes; they are turned as they are read."""
    return replace(frames, scene=in_standard_pose(frames.scene), turn=standard_turn(frames.scene))


# Windows of frames that stand one, two, ... up to a thousand spacings apart, for a model that takes the lag.

_PER_DECADE = 8


def strides_up_to(longest: int) -> tuple[int, ...]:
    """Return strides from 1 to `longest`, evenly spaced in their logarithm, about eight a decade."""
    n = max(2, round(_PER_DECADE * np.log10(longest)) + 1)
    return tuple(sorted({round(float(x)) for x in np.geomspace(1, longest, n)})) if longest > 1 else (1,)


@dataclass(frozen=True, eq=False)
class StrideSampler:
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
        which = torch.randint(len(self.strides), (n,), generator=generator)
        place = torch.rand(n, generator=generator, dtype=torch.float64)
        sizes = torch.tensor([len(starts) for starts in self.starts])
        first = torch.empty(n, dtype=torch.int64)
        for k, starts in enumerate(self.starts):
            rows = which == k
            first[rows] = starts[(place[rows] * sizes[k]).long()]
        return first, torch.tensor(self.strides)[which]


@dataclass(frozen=True, eq=False)
class Survey:
    """A summary of the trajectories to train on, made without reading their frames.

    `scenes`: each molecule trained on once; `unseen`: those that appear in the validation alone. `longest`: frames of
    the longest trajectory of each of `scenes`, `n_frames` all that are trained on. `lag_ps`: time between frames.
    `velocities`: whether all files carry them. `equilibrium`: whether all were simulated at constant temperature.
    """

    scenes: tuple[Scene, ...]
    unseen: tuple[Scene, ...]
    longest: tuple[int, ...]
    n_frames: int
    lag_ps: float
    velocities: bool
    equilibrium: bool

    @property
    def one_molecule(self) -> bool:
        return len(self.scenes) == 1 and not self.unseen


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
        files = [_summary(path) for path in (*self.paths, *self.held)]
        if not self.paths:
            raise InputError("no trajectory given to train on.")
        trained, unseen, longest = dict[str, Scene](), dict[str, Scene](), dict[str, int]()
        for file in files[: len(self.paths)]:
            key = file.scene.topology_hash
            trained.setdefault(key, file.scene)
            longest[key] = max(longest.get(key, 0), file.n_longest)
        for file in files[len(self.paths) :]:
            if (key := file.scene.topology_hash) not in trained:
                unseen.setdefault(key, file.scene)
        return Survey(
            scenes=tuple(trained.values()),
            unseen=tuple(unseen.values()),
            longest=tuple(longest.values()),
            n_frames=sum(file.n_frames for file in files[: len(self.paths)]),
            lag_ps=files[0].lag_ps,
            velocities=all(file.velocities for file in files),
            equilibrium=all(file.equilibrium for file in files),
        )

    def frames(self, *, canonical: bool, velocities: bool = False) -> TrainingFrames:
        """Return the frames of one molecule, from trajectories or from one windows file.

        Raises InputError for files of several molecules, save intervals or conditions; for windows without the
        velocities that are asked for; and where a stretch of motion would be both trained on and validated on.
        """
        if not any(is_windows(path) for path in self.paths):
            frames = collect_frames(
                list(self.paths), canonical=canonical, velocities=velocities, held=list(self.held), spool=self.spool
            )
            frames.refuse_leaks()
            return frames
        if self.held:
            raise InputError("`validation` needs trajectories to train on; a windows file keeps its own split.")
        if len(self.paths) > 1:
            raise InputError("give either trajectories or one windows file to train on.")
        frames = load_frames(self.paths[0])
        if velocities and frames.velocities is None:
            raise InputError(
                f"{self.paths[0]} holds no velocities, which this architecture learns from; make it with "
                "`velocities=True` of `windows`."
            )
        frames.refuse_leaks()
        return frames

    def sets(self) -> FrameSets:
        """Return the frames of any number of molecules (`collect_sets`)."""
        return collect_sets(list(self.paths), held=list(self.held), spool=self.spool)


@dataclass(frozen=True, eq=False)
class _FileSummary:
    scene: Scene
    n_frames: int
    n_longest: int
    lag_ps: float
    velocities: bool
    equilibrium: bool


def _summary(path: Path) -> _FileSummary:
    from systems.trajectory.codec import open_trajectory

    if is_windows(path):
        frames = load_frames(path)
        longest, moving = int(np.diff(frames.starts).max()), frames.velocities is not None
        constant = frames.conditions.get("temperature_k") is not None
        return _FileSummary(frames.scene, frames.n_frames, longest, frames.lag_ps, moving, constant)
    with open_trajectory(path) as reader:
        if reader.scene is None:
            raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
        times, n_frames = reader.time_ps, reader.n_frames
        lag_ps = float(times[1] - times[0]) if n_frames > 1 else 0.0
        moving = n_frames > 0 and reader.read_velocities(0, 1) is not None
        constant = reader.record.get("kind") == "reference" and reader.record.get("temperature_k") is not None
        return _FileSummary(reader.scene, n_frames, n_frames, lag_ps, moving, constant)
