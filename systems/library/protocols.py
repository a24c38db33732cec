"""Protocols of papers by name: the settings that made their data, for `protocol` and `protocol = "NAME"`.

A protocol goes with no molecule: it is asked for, and what is said beside it outweighs it. What it leaves out stays at
the program's defaults.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from systems.errors import UnknownNameError, nearest


@dataclass(frozen=True)
class Protocol:
    """Settings of `surrogate.api.reference` by name, and the paper they are from."""

    name: str
    settings: dict[str, Any]
    source: str


# The friction is ours, and low, but a window of the forecasting task is not deterministic: two runs from one state that
# draw other noise are 0.07 Å (aspirin) to 0.12 Å (ethanol) apart after 100 fs, root mean square over atoms, and 0.10 to
# 0.22 Å after 150 fs; the best forecast of one of them is off by that over √2.
_MD17: dict[str, Any] = {
    "force_field": "gaff2",
    "solvent": "vacuum",
    "temperature_k": 500.0,
    "friction_per_ps": 0.1,
    "timestep_ps": 0.0005,
    "hydrogen_mass_da": None,
    "constrain_hydrogens": False,
    "save_every_ps": 0.005,
}
_MDGEN: dict[str, Any] = {
    "force_field": "ff14SB",
    "solvent": "gbn2",
    "temperature_k": 350.0,
    "friction_per_ps": 0.3,
    "timestep_ps": 0.002,
    "hydrogen_mass_da": None,
    "save_every_ps": 0.1,
}
PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            "md17",
            _MD17,
            "MD17, Chmiela et al., Sci. Adv. 3, e1603015 (2017), every tenth frame as in GeoTDM; GAFF2 for their PBE",
        ),
        Protocol(
            "md22",
            _MD17 | {"force_field": "ff14SB", "timestep_ps": 0.001, "save_every_ps": 0.01},
            "MD22, Chmiela et al., Sci. Adv. 9, eadf0873 (2023): 500 K, 1 fs; ff14SB in vacuum for their PBE+MBD",
        ),
        Protocol(
            "mdgen",
            _MDGEN,
            "MDGen's implicit-solvent runs: Jing, Stärk, Jaakkola and Berger, NeurIPS 2024 (100 ns each)",
        ),
        Protocol(
            "fast-folders",
            {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 340.0},
            "340 K, near chignolin's melting temperature: Lindorff-Larsen et al., Science 334, 517 (2011)",
        ),
    )
}


def find_protocol(name: str) -> Protocol:
    """Return a protocol by name. Raises UnknownNameError, with the nearest."""
    if name not in PROTOCOLS:
        known = list(PROTOCOLS)
        raise UnknownNameError(f"unknown protocol {name!r}; known: {', '.join(known)}.{nearest(name, known)}")
    return PROTOCOLS[name]
