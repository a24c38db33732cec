"""Summary of a finished run: temperature, energy and drift with their statistical errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.validity import INVALID, flag_names
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps

_G_ML_PER_DA_NM3 = 1.66053906660e-3
# Fewer frames than this carry no error bar.
_FEWEST_FRAMES = 10
_STANDARD_ERRORS, _BIAS = 4.0, 0.02


def correlation_frames(values: npt.ArrayLike) -> float:
    """Return the statistical inefficiency in frames: 1 + 2 x autocorrelation, summed to its first zero crossing."""
    x = np.asarray(values, dtype=np.float64)
    x = x - x.mean()
    n = len(x)
    if n < 2 or not x.any():
        return 1.0
    spectrum = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n] / np.arange(n, 0, -1)
    correlation /= correlation[0]
    negative = np.flatnonzero(correlation <= 0)
    stop = int(negative[0]) if len(negative) else n
    return max(1.0, 1.0 + 2.0 * float(correlation[1:stop].sum()))


def mean_and_error(values: npt.ArrayLike) -> dict[str, float | None]:
    """Return the mean and its standard error, that of correlated frames; None where there are too few."""
    x = np.asarray(values, dtype=np.float64)
    error = None
    if len(x) >= _FEWEST_FRAMES:
        error = float(x.std(ddof=1) * math.sqrt(correlation_frames(x) / len(x)))
    return {"mean": float(x.mean()), "standard_error": error}


def drift(time_ps: npt.ArrayLike, energy_kj_mol: npt.ArrayLike, n_dof: int) -> dict[str, float | None]:
    """Return the slope of the total energy by least squares, kJ/mol per ns and degree of freedom, and its error. The
    residuals are correlated: their statistical inefficiency widens the error of the slope."""
    t = np.asarray(time_ps, dtype=np.float64) * 1e-3
    energy = np.asarray(energy_kj_mol, dtype=np.float64) / max(n_dof, 1)
    if len(t) < 3:
        return {"kj_mol_ns_dof": None, "standard_error": None}
    t = t - t.mean()
    slope = float((t * energy).sum() / (t * t).sum())
    residual = energy - energy.mean() - slope * t
    variance = float((residual * residual).sum()) / (len(t) - 2)
    error = math.sqrt(variance * correlation_frames(residual) / float((t * t).sum()))
    return {"kj_mol_ns_dof": slope, "standard_error": error if len(t) >= _FEWEST_FRAMES else None}


def summarise(
    time_ps: npt.ArrayLike, scalars: dict[str, FloatArray], flags: npt.NDArray[np.uint16], *, mass_da: float,
    ensemble: str, temperature_k: float, n_dof: int,
) -> dict[str, Any]:  # fmt: skip
    """Return the summary of a run's frames, JSON-able: temperature and potential; drift in NVE; volume and density; by
    `flags`, how many frames are another molecule. Frames without a value (written by an older version) are left out.
    `target` is the bath's temperature, None without."""
    known = {name: values[np.isfinite(values)] for name, values in scalars.items()}
    if not len(known.get("temperature_k", ())):
        return {}
    out: dict[str, Any] = {
        "n_frames": len(np.asarray(time_ps)),
        "degrees_of_freedom": n_dof,
        "temperature_k": mean_and_error(known["temperature_k"])
        | {"target": None if ensemble == "nve" else temperature_k},
        "potential_kj_mol": mean_and_error(known["potential_kj_mol"]),
    }
    if ensemble == "nve":
        kinetic = 0.5 * n_dof * GAS_CONSTANT_KJ_MOL_K * scalars["temperature_k"]
        total = scalars["potential_kj_mol"] + kinetic
        out["total_kj_mol"] = {"mean": float(total.mean()), "standard_deviation": float(total.std())}
        out["drift"] = drift(time_ps, total, n_dof)
    if len(known.get("volume_nm3", ())):
        out["volume_nm3"] = mean_and_error(known["volume_nm3"])
        out["density_g_ml"] = mean_and_error(mass_da * _G_ML_PER_DA_NM3 / known["volume_nm3"])
    if len(changed := np.flatnonzero(flags & INVALID)):
        what = flag_names(int(np.bitwise_or.reduce(flags)) & INVALID)
        first_ps = float(np.asarray(time_ps)[changed[0]])
        out["changed"] = {"n_frames": len(changed), "first_ps": first_ps, "what": what}
    return out


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return the summary for people, a line or two."""
    if not {"temperature_k", "potential_kj_mol"} <= summary.keys():
        return []
    temperature = summary["temperature_k"]
    parts = [f"temperature {_with_error(temperature, 'K')}"]
    if temperature.get("target") is not None:
        parts[0] += f" (bath {temperature['target']:g} K)"
    parts.append(f"potential {_with_error(summary['potential_kj_mol'], 'kJ/mol')}")
    if "density_g_ml" in summary:
        parts.append(f"density {_with_error(summary['density_g_ml'], 'g/mL')}")
    slope = summary.get("drift", {})
    if slope.get("kj_mol_ns_dof") is not None:
        shown = {"mean": slope["kj_mol_ns_dof"], "standard_error": slope["standard_error"]}
        parts.append(f"total energy drifts by {_with_error(shown, 'kJ/mol/ns per degree of freedom')}")
    lines = [", ".join(parts)]
    target, error = temperature.get("target"), temperature.get("standard_error")
    if target is not None and error is not None:
        # Where neither chance nor a usual time step explains it.
        off = float(temperature["mean"] - target)
        if abs(off) > _STANDARD_ERRORS * error + _BIAS * target:
            by = f"differs from the thermostat's by {off:+.1f} K"
            lines.append(f"warning: the mean temperature {by}; try a shorter `timestep_ps`.")
    if changed := summary.get("changed"):
        lines.append(
            f"warning: {changed['n_frames']} of {summary['n_frames']} frames, the first after "
            f"{format_time_ps(changed['first_ps'])}, are no longer the input molecule "
            f"({', '.join(changed['what'])}) and are flagged; it is not stable at this level of theory."
        )
    return lines


def _with_error(value: dict[str, Any], unit: str) -> str:
    error = value.get("standard_error")
    if error is None or error <= 0 or not math.isfinite(error):
        return f"{value['mean']:.{4 if error is None else 6}g} {unit}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    return f"{value['mean']:.{digits}f} ± {error:.{digits}f} {unit}"
