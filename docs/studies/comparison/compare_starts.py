"""How often a reference that has forgotten its start is called unconverged, and one that has not is found:

    python docs/studies/comparison/compare_starts.py [--sets 200]

Two residues of known jump processes: ψ of the first 70 % in one state, relaxing in a time τ; ψ of the second 50 %, in
τ/3; φ of both at 1 % above zero, entered for some frames at a time. Replicas are given by their number, their length
in τ and where they start: from equilibrium, or all in one state.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogate.comparison.convergence import Convergence, convergence_of
from surrogate.comparison.measure.structure import Backbone, Features, Residue

LAG_PS = 10.0
TAU_FRAMES = 60.0
TORSIONS = Backbone(
    np.zeros((2, 4), dtype=np.int64),
    np.zeros((2, 4), dtype=np.int64),
    ("THR 2", "PHE 3"),
    ("THR 2", "PHE 3"),
    (Residue(0, 0, "THR 2"), Residue(1, 1, "PHE 3")),
)


@dataclass(frozen=True)
class Setting:
    """A kind of set: `starts` "equilibrium" or "one"; `stuck` replicas never leave where they began; `must` be found
    converged, or not; of None it may be either."""

    name: str
    n_replicas: int
    length_tau: float
    starts: str = "equilibrium"
    stuck: int = 0
    never: bool = False
    must: bool | None = True


SETTINGS = (
    Setting("32 replicas of 40 τ, from equilibrium", 32, 40.0),
    Setting("32 replicas of 10 τ, from equilibrium", 32, 10.0),
    Setting("32 replicas of 40 τ, all from one state", 32, 40.0, "one"),
    Setting("8 replicas of 40 τ, from equilibrium", 8, 40.0),
    Setting("two runs of 200 τ", 2, 200.0),
    Setting("one run of 200 τ", 1, 200.0),
    Setting("32 replicas of 4 τ, all from one state (drift)", 32, 4.0, "one", must=False),
    Setting("32 replicas of 2 τ, all from one state (drift)", 32, 2.0, "one", must=False),
    Setting("32 replicas of τ/2, all from one state (drift)", 32, 0.5, "one", must=False),
    Setting("32 replicas of 2 τ, from equilibrium (short)", 32, 2.0, must=False),
    Setting("one of 32 replicas of 40 τ is stuck", 32, 40.0, stuck=1, must=False),
    Setting("four replicas of 2 τ (too few transitions)", 4, 2.0, must=False),
    Setting("one run of 4 τ (too few transitions)", 1, 4.0, must=False),
    Setting("16 replicas begin in each of two states, and none passes", 32, 40.0, never=True, must=False),
)


def jumps(n: int, share: float, tau: float, rng: np.random.Generator, start: int | None) -> np.ndarray:
    """Return a two-state path `(n,)` of 0 and 1: equilibrium `share` of 1, relaxation time `tau` frames."""
    decay = np.exp(-1.0 / tau)
    leave = (1.0 - decay) * np.array([share, 1.0 - share])
    state = int(rng.random() < share) if start is None else start
    path = np.empty(n, dtype=np.int64)
    at = 0
    while at < n:
        stay = min(int(rng.geometric(leave[state])), n - at)
        path[at : at + stay] = state
        at, state = at + stay, 1 - state
    return path


def make_set(setting: Setting, seed: int, shares: tuple[float, float] = (0.7, 0.5), label: str = "MD") -> Features:
    """Return the measured torsions of one set."""
    rng = np.random.default_rng([seed, 5])
    n = max(round(setting.length_tau * TAU_FRAMES), 16)
    phi, psi = [], []
    for k in range(setting.n_replicas):
        start = 0 if setting.starts == "one" else None
        first = jumps(n, shares[0], TAU_FRAMES, rng, start)
        if k < setting.stuck:
            first = np.full(n, 0)
        if setting.never:
            first = np.full(n, k % 2)
        second = jumps(n, shares[1], TAU_FRAMES / 3, rng, start)
        above = np.stack([jumps(n, 0.01, 5.0, rng, 0) for _ in range(2)], axis=1)
        noise = rng.normal(0.0, 0.25, (n, 4))
        psi.append((np.where(np.stack([first, second], axis=1) == 1, -0.7, 2.6) + noise[:, :2]).astype(np.float32))
        phi.append((np.where(above == 1, 1.0, -1.4) + noise[:, 2:]).astype(np.float32))
    psi = [np.angle(np.exp(1j * x)).astype(np.float32) for x in psi]
    empty = [np.empty((n, 0), dtype=np.float32)] * setting.n_replicas
    return Features(label, LAG_PS, phi, psi, empty, [np.zeros(n, dtype=np.uint16)] * setting.n_replicas, None)


def evaluated(setting: Setting, seed: int) -> Convergence:
    """Return what is said of one set."""
    return convergence_of([make_set(setting, seed)], TORSIONS)


def rates(n_sets: int, settings: Sequence[Setting] = SETTINGS) -> list[tuple[Setting, int, str]]:
    """Return how many of `n_sets` sets of every kind are called unconverged, and one reason."""
    out = []
    for setting in settings:
        found = [evaluated(setting, seed) for seed in range(n_sets)]
        reason = next((f.reasons[0] for f in found if f.reasons), "")
        out.append((setting, sum(not f.converged for f in found), reason))
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=200, help="of each kind")
    args = parser.parse_args(arguments)
    lines = ["| set | is | called not converged | such as |", "|---|---|---|---|"]
    for setting, n, reason in rates(args.sets):
        is_so = "converged" if setting.must else "not converged"
        lines.append(f"| {setting.name} | {is_so} | {n} of {args.sets} | {reason} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
