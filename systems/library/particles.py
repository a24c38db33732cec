"""Model systems: particles under a stated law, with starting conditions drawn from a seed and answers that are known.

A scene of this kind holds particles (`systems.elements.PARTICLE`) and says in `Scene.interactions` what acts on them:

- `coulomb`: sum over pairs of C q_i q_j / r, with `coulomb_constant` C and `charges_e` q;
- `springs`: sum over `pairs` of k r^2 / 2, with `force_constant_kj_mol_nm2` k and zero rest length;
- `gravity`: minus the sum over pairs of G m_i m_j / sqrt(r^2 + s^2), with `gravitational_constant` G, `softening_nm` s
  and the scene's masses;
- `harmonic`: (k_x x^2 + k_y y^2 + k_z z^2) / 2 on each particle, with `force_constants_kj_mol_nm2`;
- `double-well`: h ((x/a)^2 - 1)^2 + t x + k (y^2 + z^2) / 2, with `barrier_kj_mol` h, `minimum_nm` a,
  `tilt_kj_mol_nm` t and `transverse_kj_mol_nm2` k.

nm, ps, Da and kJ/mol belong together (1 Da nm^2/ps^2 = 1 kJ/mol), so the dimensionless n-body systems of the literature
are taken over number by number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.elements import PARTICLE
from systems.errors import InputError
from systems.scene import FloatArray, Scene

GAS_CONSTANT_KJ_MOL_K = 8.31446261815324e-3
_RESIDUE = "PAR"


@dataclass(frozen=True)
class NBodyProtocol:
    """How one kind of n-body trajectory is made: LaM-SLidE, section 4.3, by the generator of GeoTDM (Han et al., 2024).

    `position_std_nm`: of every coordinate at the start. `speed_nm_ps`: of every particle, in a random direction; None:
    each component is unit normal and the centre of mass is brought to rest. `integrator`: `kick-drift` (symplectic
    Euler) or `kick-drift-kick` (velocity Verlet). `max_force`: each component of a particle's force is cut there,
    kJ/mol/nm. `first_frame_ps`: time of the first of the saved frames.
    """

    kind: str
    n_particles: int
    position_std_nm: float
    speed_nm_ps: float | None
    integrator: str
    max_force: float | None
    first_frame_ps: float
    timestep_ps: float = 0.001
    save_every_ps: float = 0.1
    n_frames: int = 30


N_BODY = {
    "n-body-charged": NBodyProtocol("coulomb", 5, 1.0, 0.5, "kick-drift", 100.0, 0.1),
    "n-body-spring": NBodyProtocol("springs", 5, 0.5, 0.5, "kick-drift", 100.0, 0.1),
    "n-body-gravity": NBodyProtocol("gravity", 10, 1.0, None, "kick-drift-kick", None, 0.0),
}


def n_body(name: str, seed: int = 0) -> Scene:
    """Return the n-body scene `name` (a key of `N_BODY`) with the starting conditions of `seed`.

    Charges are ±1 with even odds, springs join each pair with probability 1/2, all masses are 1 Da.
    """
    protocol = N_BODY[name]
    rng = np.random.default_rng([sorted(N_BODY).index(name), seed])
    n = protocol.n_particles
    law: dict[str, Any] = {"kind": protocol.kind}
    if protocol.kind == "coulomb":
        law |= {"coulomb_constant": 1.0, "charges_e": rng.choice([-1.0, 1.0], size=n).tolist()}
    elif protocol.kind == "springs":
        joined = rng.random((n, n)) < 0.5
        pairs = [[i, j] for i in range(n) for j in range(i + 1, n) if joined[i, j]]
        law |= {"force_constant_kj_mol_nm2": 0.1, "pairs": pairs}
    else:
        law |= {"gravitational_constant": 1.0, "softening_nm": 0.1}
    if protocol.max_force is not None:
        law["max_force_kj_mol_nm"] = protocol.max_force
    positions = rng.normal(size=(n, 3)) * protocol.position_std_nm
    velocities = rng.normal(size=(n, 3))
    if protocol.speed_nm_ps is None:
        velocities -= velocities.mean(axis=0)  # all masses are equal
    else:
        velocities *= protocol.speed_nm_ps / np.linalg.norm(velocities, axis=1, keepdims=True)
    return particles(f"{name}:{seed}", law, positions, masses_da=np.ones(n), velocities_nm_ps=velocities,
                     provenance={"source": "library", "library_name": name, "seed": seed, "repairs": []})  # fmt: skip


def harmonic_oscillator() -> Scene:
    """Return one particle of 12 Da in a harmonic well, a different force constant along each axis.

    At 300 K its spread is 0.22, 0.16 and 0.11 nm, its period 3.1, 2.2 and 1.5 ps.
    """
    law = {"kind": "harmonic", "force_constants_kj_mol_nm2": [50.0, 100.0, 200.0]}
    return _single("harmonic-oscillator", law, [0.1, 0.1, 0.1])


def double_well() -> Scene:
    """Return one particle of 12 Da in two wells along x, 6 kJ/mol deep and 0.6 nm apart, the left one lower."""
    law = {"kind": "double-well", "barrier_kj_mol": 6.0, "minimum_nm": 0.3, "tilt_kj_mol_nm": 2.5,
           "transverse_kj_mol_nm2": 200.0}  # fmt: skip
    return _single("double-well", law, [-0.3, 0.0, 0.0])


def _single(name: str, law: dict[str, Any], position_nm: list[float]) -> Scene:
    return particles(name, law, [position_nm], masses_da=np.array([12.0]),
                     provenance={"source": "library", "library_name": name, "repairs": []})  # fmt: skip


def particles(
    name: str,
    law: dict[str, Any],
    positions_nm: npt.ArrayLike,
    *,
    masses_da: npt.ArrayLike,
    velocities_nm_ps: npt.ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
) -> Scene:
    """Return a scene of particles at `(n, 3)` nm with masses `(n,)` Da under `law` (see the module).

    Raises InputError when the law is unknown, incomplete, or does not fit the number of particles.
    """
    positions = np.array(positions_nm, dtype=np.float64)
    n = len(positions)
    check_law(law, n)
    return Scene(
        name=name,
        atom_names=tuple(f"P{k + 1}" for k in range(n)),
        elements=(PARTICLE,) * n,
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=(_RESIDUE,),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.zeros((0, 2), dtype=np.int64),
        bond_orders=np.zeros(0),
        formal_charges=np.zeros(n, dtype=np.int64),
        masses_da=np.array(masses_da, dtype=np.float64),
        positions_nm=positions,
        provenance=dict(provenance or {}),
        interactions=law,
        velocities_nm_ps=None if velocities_nm_ps is None else np.array(velocities_nm_ps, dtype=np.float64),
    )


_ENTRIES = {
    "coulomb": {"coulomb_constant", "charges_e"},
    "springs": {"force_constant_kj_mol_nm2", "pairs"},
    "gravity": {"gravitational_constant", "softening_nm"},
    "harmonic": {"force_constants_kj_mol_nm2"},
    "double-well": {"barrier_kj_mol", "minimum_nm", "tilt_kj_mol_nm", "transverse_kj_mol_nm2"},
}


def check_law(law: dict[str, Any], n_particles: int) -> None:
    """Raise InputError unless `law` is complete and fits `n_particles`."""
    kind = law.get("kind")
    if kind not in _ENTRIES:
        raise InputError(f"a model system of kind {kind!r} is unknown; known: {', '.join(_ENTRIES)}.")
    found = set(law) - {"kind", "max_force_kj_mol_nm"}
    if found != _ENTRIES[kind]:
        wrong = ", ".join(sorted(found ^ _ENTRIES[kind]))
        raise InputError(f"the law of kind {kind!r} needs {', '.join(sorted(_ENTRIES[kind]))}; see: {wrong}.")
    if kind == "coulomb" and len(law["charges_e"]) != n_particles:
        raise InputError(f"{len(law['charges_e'])} charges for {n_particles} particles.")
    if kind == "springs" and any(not 0 <= i < j < n_particles for i, j in law["pairs"]):
        raise InputError(f"a spring must join two of the {n_particles} particles, i < j.")
    if kind == "harmonic" and len(law["force_constants_kj_mol_nm2"]) != 3:
        raise InputError("a harmonic well needs three force constants, for x, y and z.")


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
