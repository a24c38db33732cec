"""Views of windows for forecasters of molecules: the body frame, the best linear forecast, and LaM-SLidE's inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from forecast_methods import N_GIVEN, N_NEW, motion_features
from molecule_windows import MoleculeWindows

from systems.chemistry.geometry import superposition

if TYPE_CHECKING:
    from particle_flow import Given
    from particle_flow_training import ParticleWindows

Array = npt.NDArray[np.float64]
ELEMENTS = (1, 6, 7, 8)
# Ridge penalties that are tried, as shares of the mean variance of a given coordinate.
_PENALTIES = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2)
_BLOCK = 2000


@dataclass(frozen=True, eq=False)
class BodyFrame:
    """Where a window's molecule is: frames x become `(x - centre) @ rotation.T`, laid on the template by the last given
    frame. Moving with the molecule makes every forecast below exactly equivariant to rotations and translations."""

    rotation: Array
    centre: Array

    @staticmethod
    def of(molecule: MoleculeWindows, given: Array) -> BodyFrame:
        """From given frames `(n, n_given, n_atoms, 3)`."""
        last = given[:, -1]
        rotation, moved = superposition(last, molecule.template_nm, idx=molecule.fitted_idx)
        return BodyFrame(rotation, -np.einsum("nij,ni->nj", rotation, moved))

    def enter(self, x: Array) -> Array:
        """Frames `(n, n_frames, n_atoms, 3)` as the lab sees them -> as the body does."""
        return np.einsum("ntad,nkd->ntak", x - self.centre[:, None, None], self.rotation)

    def leave(self, x: Array) -> Array:
        return np.einsum("ntak,nkd->ntad", x, self.rotation) + self.centre[:, None, None]


@dataclass(frozen=True, eq=False)
class LinearForecast:
    """The best linear forecast of one molecule: in the body frame, every coordinate of every frame to come is a ridge
    regression on all given ones. It knows every harmonic mode and its coupling to the others, not their anharmonicity.

    `weights` (1 + 3 n_given n_atoms, 3 n_new n_atoms): what is added to the last given frame.
    """

    weights: Array
    mean: Array
    penalty: float

    @staticmethod
    def fit(molecule: MoleculeWindows) -> LinearForecast:
        """Fit to every window of the training split; the penalty is that with the least error on validation."""
        starts = molecule.every_start["train"]
        mean = _features(molecule, starts[:: max(1, len(starts) // 4000)]).mean(0)
        n = len(mean)
        squared, mixed = np.zeros((n + 1, n + 1)), np.zeros((n + 1, N_NEW * 3 * molecule.n_atoms))
        for begin in range(0, len(starts), _BLOCK):
            inputs, targets = _pair(molecule, starts[begin : begin + _BLOCK], mean)
            squared += inputs.T @ inputs
            mixed += inputs.T @ targets
        scale = np.trace(squared[1:, 1:]) / n
        inputs, targets = _pair(molecule, molecule.starts["validation"], mean)
        fits = []
        for penalty in _PENALTIES:
            damping = np.diag(np.concatenate([[0.0], np.full(n, penalty * scale)]))
            weights = np.linalg.lstsq(squared + damping, mixed, rcond=None)[0].astype(np.float64)
            fits.append((float(np.square(inputs @ weights - targets).mean()), penalty, weights))
        _, penalty, weights = min(fits, key=lambda fit: fit[0])
        return LinearForecast(weights, mean, penalty)

    def forecast(self, molecule: MoleculeWindows, given: Array) -> Array:
        """Given frames `(n, n_given, n_atoms, 3)` -> `(n, n_new, n_atoms, 3)`."""
        body = BodyFrame.of(molecule, given)
        inside = body.enter(given)
        flat = inside.reshape(len(given), -1) - self.mean
        moved = self.weights[0] + flat @ self.weights[1:]
        return body.leave(inside[:, -1:] + moved.reshape(len(given), N_NEW, -1, 3))


def _features(molecule: MoleculeWindows, starts: npt.NDArray[np.int64]) -> Array:
    given = molecule.windows(starts)[:, :N_GIVEN]
    return BodyFrame.of(molecule, given).enter(given).reshape(len(starts), -1)


def _pair(molecule: MoleculeWindows, starts: npt.NDArray[np.int64], mean: Array) -> tuple[Array, Array]:
    windows = molecule.windows(starts)
    inside = BodyFrame.of(molecule, windows[:, :N_GIVEN]).enter(windows)
    given = inside[:, :N_GIVEN].reshape(len(starts), -1) - mean
    targets = (inside[:, N_GIVEN:] - inside[:, N_GIVEN - 1 : N_GIVEN]).reshape(len(starts), -1)
    return np.concatenate([np.ones((len(given), 1)), given], axis=1), targets


@dataclass(frozen=True, eq=False)
class MoleculeView:
    """How LaM-SLidE sees a molecule's windows.

    `canonical`: in the body frame; else about the last given frame's centre, as they stand in the lab. `linear`: each
    frame as the difference from what is known, in units of that difference's size: frames to come from the linear
    forecast, given ones from the last, the last from the template (or the centre). Without it all frames are positions
    in one unit, as in the paper. `scales` (n_given + n_new,) nm.
    """

    molecule: MoleculeWindows
    canonical: bool
    linear: LinearForecast | None
    scales: Array

    @staticmethod
    def of(molecule: MoleculeWindows, *, canonical: bool, linear: LinearForecast | None) -> MoleculeView:
        """Measure the scales on the training windows."""
        starts = molecule.starts["train"]
        sample = molecule.windows(starts[:: max(1, len(starts) // 1000)])
        bare = MoleculeView(molecule, canonical, linear, np.ones(N_GIVEN + N_NEW))
        sizes = np.sqrt(np.square(bare.to_model(sample)).mean(axis=(0, 2, 3)))
        if linear is None:
            sizes = np.full_like(sizes, np.sqrt(np.square(sizes).mean()))
        return MoleculeView(molecule, canonical, linear, np.maximum(sizes, 1e-9))

    def given(self, given: Array) -> Array:
        """Given frames `(n, n_given, n_atoms, 3)` nm as the model sees them."""
        inside = self._frame(given).enter(given)
        if self.linear is not None:
            last = inside[:, -1:] - (self.molecule.template_nm if self.canonical else 0.0)
            inside = np.concatenate([inside[:, :-1] - inside[:, -1:], last], axis=1)
        return inside / self.scales[:N_GIVEN, None, None]

    def to_model(self, windows: Array) -> Array:
        """Windows `(n, n_given + n_new, n_atoms, 3)` nm as the model sees them."""
        given, ahead = windows[:, :N_GIVEN], windows[:, N_GIVEN:]
        frame = self._frame(given)
        rest = frame.enter(ahead) - self._base(given, frame)
        return np.concatenate([self.given(given), rest / self.scales[N_GIVEN:, None, None]], axis=1)

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones as the model sees them -> predicted positions, nm."""
        frame = self._frame(given)
        return frame.leave(seen * self.scales[N_GIVEN:, None, None] + self._base(given, frame))

    def _frame(self, given: Array) -> BodyFrame:
        if self.canonical:
            return BodyFrame.of(self.molecule, given)
        return BodyFrame(np.broadcast_to(np.eye(3), (len(given), 3, 3)), given[:, -1].mean(axis=1))

    def _base(self, given: Array, frame: BodyFrame) -> Array | float:
        return 0.0 if self.linear is None else frame.enter(self.linear.forecast(self.molecule, given))


@dataclass(frozen=True, eq=False)
class AtomView:
    """How LaM-SLidE sees what each atom does: frames to predict as `window` does, which is canonical; of the given ones
    in the body frame what `motion_features` tells, in units of `sizes_nm` that all molecules share."""

    window: MoleculeView
    sizes_nm: tuple[float, float, float]

    def known(self, given: Array) -> Given:
        """Return what the network is told of windows with these given frames: motion, elements, bonds."""
        import torch
        from particle_flow import Given

        m = self.window.molecule
        features = motion_features(BodyFrame.of(m, given).enter(given), self.sizes_nm)
        types = torch.tensor([ELEMENTS.index(e) for e in m.elements.tolist()]).expand(len(given), -1)
        return Given(torch.from_numpy(features).float(), types, torch.from_numpy(m.kinds).expand(len(given), -1, -1))

    def to_model(self, windows: Array) -> ParticleWindows:
        """Windows `(n, n_given + n_new, n_atoms, 3)` nm as the network sees them."""
        import torch
        from particle_flow_training import ParticleWindows

        ahead = torch.from_numpy(self.window.to_model(windows)[:, N_GIVEN:].swapaxes(1, 2)).float()
        return ParticleWindows(self.known(windows[:, :N_GIVEN]), ahead.contiguous())

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones `(n, n_atoms, n_new, 3)` as the network sees them -> positions, nm."""
        return self.window.from_model(given, seen.swapaxes(1, 2))
