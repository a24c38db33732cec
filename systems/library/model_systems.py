"""Model systems: particles under a stated law, with answers that are known.

A scene of this kind holds particles (`systems.elements.PARTICLE`) and says in `Scene.interactions` what acts on them:

- `harmonic`: (k_x x^2 + k_y y^2 + k_z z^2) / 2 on each particle, with `force_constants_kj_mol_nm2`;
- `double-well`: h ((x/a)^2 - 1)^2 + t x + k (y^2 + z^2) / 2, with `barrier_kj_mol` h, `minimum_nm` a,
  `tilt_kj_mol_nm` t and `transverse_kj_mol_nm2` k.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from systems.elements import PARTICLE
from systems.errors import InputError
from systems.scene import Scene

_RESIDUE = "PAR"


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
    provenance: dict[str, Any] | None = None,
) -> Scene:
    """Return a scene of particles at `(n, 3)` nm with masses `(n,)` Da under `law` (see the module).

    Raises InputError when the law is unknown or incomplete.
    """
    positions = np.array(positions_nm, dtype=np.float64)
    n = len(positions)
    check_law(law)
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
    )


_ENTRIES = {
    "harmonic": {"force_constants_kj_mol_nm2"},
    "double-well": {"barrier_kj_mol", "minimum_nm", "tilt_kj_mol_nm", "transverse_kj_mol_nm2"},
}


def check_law(law: dict[str, Any]) -> None:
    """Raise InputError unless `law` is known and complete."""
    kind = law.get("kind")
    if kind not in _ENTRIES:
        raise InputError(f"a model system of kind {kind!r} is unknown; known: {', '.join(_ENTRIES)}.")
    found = set(law) - {"kind"}
    if found != _ENTRIES[kind]:
        wrong = ", ".join(sorted(found ^ _ENTRIES[kind]))
        raise InputError(f"the law of kind {kind!r} needs {', '.join(sorted(_ENTRIES[kind]))}; see: {wrong}.")
    if kind == "harmonic" and len(law["force_constants_kj_mol_nm2"]) != 3:
        raise InputError("a harmonic well needs three force constants, for x, y and z.")
