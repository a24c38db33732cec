"""Statistics of the frames of a stress test, and its result as Markdown tables and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.distributions import distance
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import rotatable_torsions
from systems.chemistry.validity import BOND_HALF_ANGSTROM, INVALID, NOT_FINITE, Geometry, check_frames
from systems.files.whole_file import create_whole
from systems.scene import FloatArray, IntArray, Scene

Frames = npt.NDArray[np.floating[Any]]

# The published stability rule: finite, and each bond within 0.5 Å of the reference's mean (Fu et al., TMLR 2023).
HALF_ANGSTROM_RULE = NOT_FINITE | BOND_HALF_ANGSTROM
_TORSION_BINS = 36
# Bonds that the reference constrains do not vibrate and have no temperature.
_STIFF_NM = 5e-4


@dataclass(frozen=True)
class Validity:
    """Frames that break the 0.5 Å rule and frames that break any rule, with the first of the former in ps."""

    frames: int
    broken: int
    invalid: int
    first_broken_ps: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return percentages for JSON and the table."""
        return {
            "frames": self.frames,
            "valid_half_angstrom_%": 100.0 * (1.0 - self.broken / self.frames),
            "valid_all_%": 100.0 * (1.0 - self.invalid / self.frames),
            "first_failure_ps": self.first_broken_ps,
        }


def measure_validity(replicas: Sequence[Frames], geometry: Geometry, spacing_ps: float) -> Validity:
    """Return the validity of replicas, each `(n_frames, n_atoms, 3)` nm in the geometry's atom order."""
    flags = [check_frames(frames, geometry) for frames in replicas]
    broken = [np.flatnonzero(f & HALF_ANGSTROM_RULE) for f in flags]
    firsts = [float(b[0] + 1) * spacing_ps for b in broken if len(b)]
    return Validity(
        frames=sum(map(len, flags)),
        broken=sum(map(len, broken)),
        invalid=sum(int(np.count_nonzero(f & INVALID)) for f in flags),
        first_broken_ps=min(firsts, default=None),
    )


def measure_bonds(frames: Frames, geometry: Geometry) -> dict[str, float]:
    """Return of frames `(n, n_atoms, 3)` nm: the root mean square of mean bond lengths from the reference's, in pm, and
    the share of the reference's variance that bonds which vibrate have, times 100 (100 % is the reference's
    temperature, by equipartition)."""
    pairs = geometry.bond_idx
    x = frames[np.isfinite(frames).all(axis=(1, 2))].astype(np.float64)
    if not len(x) or not len(pairs):
        return {}
    lengths = np.linalg.norm(x[:, pairs[:, 0]] - x[:, pairs[:, 1]], axis=2)
    out = {"bond_shift_pm": 1e3 * float(np.sqrt(np.square(lengths.mean(axis=0) - geometry.bond_mean_nm).mean()))}
    soft = geometry.bond_std_nm > _STIFF_NM
    if soft.any():
        out["bond_variance_%"] = 100.0 * float((lengths.var(axis=0)[soft] / geometry.bond_std_nm[soft] ** 2).mean())
    return out


def measure_drift(replicas: Sequence[Frames], scene: Scene, geometry: Geometry) -> dict[str, Any]:
    """Return what differs between the first and the last tenth of replicas `(n_frames, n_atoms, 3)` nm, template order.

    `torsion_jsd`: the mean Jensen-Shannon distance (square root, natural logarithm) of the rotatable torsions'
    histograms of 10° bins; `torsion_jsd_floor` the same between two halves of the replicas over both tenths, which
    differ by chance alone.
    """
    tenth = max(1, min(map(len, replicas)) // 10)
    first, last = (np.concatenate([r[part] for r in replicas]) for part in (slice(tenth), slice(-tenth, None)))
    out: dict[str, Any] = {"first": measure_bonds(first, geometry), "last": measure_bonds(last, geometry)}
    quads = rotatable_torsions(scene, rotors=False)
    if len(quads):
        out["torsion_jsd"] = _torsion_distance(first, last, quads)
    if len(quads) and len(replicas) > 1:
        ends = [np.concatenate([r[:tenth], r[-tenth:]]) for r in replicas]
        out["torsion_jsd_floor"] = _torsion_distance(np.concatenate(ends[::2]), np.concatenate(ends[1::2]), quads)
    return out


def _torsion_distance(one: Frames, other: Frames, quads: IntArray) -> float:
    return float(np.mean(distance(_histograms(one, quads), _histograms(other, quads))))


def _histograms(frames: Frames, quads: IntArray) -> FloatArray:
    finite = frames[np.isfinite(frames).all(axis=(1, 2))]
    angles = torsion(finite, quads)
    edges = np.linspace(-np.pi, np.pi, _TORSION_BINS + 1)
    return np.stack([np.histogram(angles[:, k], bins=edges)[0].astype(np.float64) for k in range(len(quads))])


# ---- the page -------------------------------------------------------------------------------------------------------


TITLES = {
    "length": "Long rollouts",
    "invariance": "The first chunk of moved input, moved back: greatest deviation",
    "inputs": "Inputs pushed out of the training domain",
    "precision": "Arithmetic: the first chunk against float64",
    "batches": "Batch size: the first replica against the same alone",
    "solvers": "Solver steps",
    "openmm": "OpenMM itself, by the same criteria",
}
_LEFT_TO_JSON = ("asked", "drift")
_DRIFT = {
    "bond_shift_pm": "mean bonds off, pm, first and last tenth",
    "bond_variance_%": "bond variance, % of the reference's",
}


def write_stress(result: dict[str, Any], folder: Path) -> None:
    """Write stress.json and stress.md. Raises StorageError."""
    create_whole(folder / "stress.json", json.dumps(result, indent=1))
    create_whole(folder / "stress.md", markdown(result))


def markdown(result: dict[str, Any]) -> str:
    """Return the tables."""
    lines = [
        f"# Stress test of {result['weights']}",
        "",
        f"{result['domain']}; {result['model']}, {result['made']}",
        "",
        *([result["machine"]["about"], ""] if isinstance(result.get("machine"), dict) else []),
    ]
    for name, rows in result["sections"].items():
        lines += [f"## {TITLES[name]}", "", *table([_flat(row) for row in rows]), ""]
    lines += [
        "valid_half_angstrom: finite, and each bond within 0.5 Å of the reference's mean; valid_all: every rule of "
        "systems.chemistry.validity. chunks helped: those in which the guard caught a frame (under flag, only "
        "marked); checks and help: their time in per cent of the time that drawing took. A surrogate has no velocities "
        "that are its own: in place of a temperature stands the variance of bonds in per cent of the reference's.",
        "",
    ]
    return "\n".join(lines)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return Markdown lines with a column for each key that a row has."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    if not keys:
        return ["nothing was run"]
    head = [key.replace("_", " ") for key in keys]
    lines = [head, ["---"] * len(keys), *([_text(row.get(key)) for key in keys] for row in rows)]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    out = {key: value for key, value in row.items() if key not in _LEFT_TO_JSON}
    drift = row.get("drift", {})
    for key, title in _DRIFT.items():
        if key in drift.get("first", {}) and key in drift.get("last", {}):
            out[title] = f"{drift['first'][key]:.3g} → {drift['last'][key]:.3g}"
    if "torsion_jsd" in drift:
        by_chance = f" (by chance {floor:.3f})" if (floor := drift.get("torsion_jsd_floor")) else ""
        out["torsion distance"] = f"{drift['torsion_jsd']:.3f}{by_chance}"
    if "energy_first_kj_mol" in drift and "energy_last_kj_mol" in drift:
        parts = [
            f"{drift[f'energy_{k}_kj_mol']:.1f} ± {drift[f'energy_{k}_error_kj_mol']:.1f}" for k in ("first", "last")
        ]
        out["relaxed energy, kJ/mol"] = " → ".join(parts)
    return out


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.2e}" if value and abs(value) < 1e-3 else f"{value:.6g}"
    return str(value).replace("|", "\\|")
