"""What theory says of model systems and of PAINET's attention, for tests to hold the code against."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from systems.scene import FloatArray, Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K


def harmonic_answers(scene: Scene, temperature_k: float) -> dict[str, FloatArray]:
    """Return what is known of the harmonic scene along x, y, z: `variance_nm2` (kT/k) and `angular_frequency_per_ps`
    (sqrt(k/m), undamped, of the first particle), each `(3,)`.
    """
    k = np.array(scene.interactions["force_constants_kj_mol_nm2"]) if scene.interactions else np.zeros(0)
    return {
        "variance_nm2": GAS_CONSTANT_KJ_MOL_K * temperature_k / k,
        "angular_frequency_per_ps": np.sqrt(k / scene.masses_da[0]),
    }


def double_well_density(scene: Scene, temperature_k: float, x_nm: FloatArray) -> FloatArray:
    """Return the Boltzmann density along x, 1/nm, at an even grid `x_nm (n,)` that must hold all of it."""
    law = scene.interactions or {}
    u = law["barrier_kj_mol"] * ((x_nm / law["minimum_nm"]) ** 2 - 1.0) ** 2 + law["tilt_kj_mol_nm"] * x_nm
    weight = np.exp(-(u - u.min()) / (GAS_CONSTANT_KJ_MOL_K * temperature_k))
    density: FloatArray = weight / (weight.sum() * (x_nm[1] - x_nm[0]))
    return density


def double_well_left_population(scene: Scene, temperature_k: float) -> float:
    """Return the probability of x < 0 by quadrature of the Boltzmann density (y and z factor out)."""
    x = np.linspace(-2.0, 2.0, 20_000)  # even, so that no point lies on 0
    density = double_well_density(scene, temperature_k, x)
    return float(density[x < 0].sum() / density.sum())


def pair_energy(h: Tensor, before: Tensor, a: Tensor, b: Tensor, smoothness: float) -> Tensor:
    """Return E(H) = sum_i |h_i - h_i(t)|^2 + lambda sum_ij (a_ij s - b_ij s^2), s = |h_i - h_j|^2.

    `h` and `before` (H(t)) are `(..., n, d)`, `a` and `b` `(n, n)`; the result `(...)`.
    """
    squared = (h.unsqueeze(-2) - h.unsqueeze(-3)).square().sum(-1)
    rho = a * squared - b * squared.square()
    return (h - before).square().sum((-1, -2)) + smoothness * rho.sum((-1, -2))


def largest_step(weights: Tensor, smoothness: float) -> float:
    """Return the largest eta for which h + eta (mean - h) is proved not to raise `pair_energy`.

    For concave rho the tangent at H(t) majorises the energy. With symmetric weights W, row sums D and L = D - W, the
    step -eta D^-1 L H changes the majorant by at most eta u^T u (eta / d_min - 4 lambda (1 - eta)), u = D^-1/2 L H,
    because D^-1/2 L D^-1/2 has no eigenvalue above 2. It vanishes at eta = c / (1 + c), c = 4 lambda d_min.
    """
    bound = 4.0 * smoothness * float(weights.sum(-1).min())
    return bound / (1.0 + bound)
