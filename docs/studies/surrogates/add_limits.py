"""Give older weights the limits that guards need: `python docs/studies/surrogates/add_limits.py WEIGHTS REF... -o
OUT`.

`surromd train` measures limits itself. Tensors, configuration, geometry and provenance stay as they are.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from surrogate.data.frames import collect_frames
from surrogate.models.weights import load_weights, save_weights, training_domain
from surrogate.verbs.outputs import find_trajectories
from systems.errors import InputError
from systems.units import whole_steps


def add_limits(weights: Path, references: list[Path], out: Path) -> Path:
    """Write `weights` with limits measured on the trajectories that they were trained on, in the precision they had.

    Raises InputError when the trajectories are of another scene, other conditions or an interval that does not divide
    that of the weights.
    """
    loaded = load_weights(weights)
    domain = loaded.domain
    frames = collect_frames(references)
    if frames.scene.topology_hash != domain.scene.topology_hash:
        raise InputError(
            f"{weights.name} was trained on {domain.scene.name}, not on {frames.scene.name} as it is here."
        )
    if _stated(frames.conditions) != _stated(domain.conditions):
        raise InputError(f"{weights.name} was trained under {domain.conditions}, not under {frames.conditions}.")
    stride = whole_steps(domain.lag_ps, frames.lag_ps, "frame spacing of the weights in that of the trajectories")
    limits = training_domain(frames, stride=stride).limits
    save_weights(out, loaded.model, replace(domain, limits=limits), loaded.provenance, half=_is_half(weights))
    return out


def _stated(conditions: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in conditions.items() if value is not None}


def _is_half(path: Path) -> bool:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as handle:
        return any(handle.get_slice(name).get_dtype() == "F16" for name in handle.keys())  # noqa: SIM118


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("references", nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    written = add_limits(args.weights, find_trajectories(args.references), args.out)
    sys.stdout.write(f"{written}: {load_weights(written).hash}\n")


if __name__ == "__main__":
    main()
