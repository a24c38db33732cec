"""What a trajectory's record may say: the entries that the program goes by, with their types; all else is free."""

from __future__ import annotations

from typing import Annotated, TypedDict

Count = Annotated[int, range(2**63)]
# Also of a run that came to nothing.
Number = Annotated[float, ...]


class _Mean(TypedDict):
    mean: Number


class _Value(_Mean, total=False):
    standard_error: Number | None
    target: Number | None


class _Drift(TypedDict):
    kj_mol_ns_dof: Number | None
    standard_error: Number | None


class _Summary(TypedDict, total=False):
    temperature_k: _Value
    potential_kj_mol: _Value
    density_g_ml: _Value
    drift: _Drift


class _Cost(TypedDict, total=False):
    wall_s: Number


class _Deviation(TypedDict):
    what: str
    reason: str


class _Guarded(TypedDict):
    guard: str
    chunks: Count
    chunks_caught: Count
    frames: dict[str, int]
    bias: list[str]


class _Interventions(_Guarded, total=False):
    reasons: dict[str, int]
    seconds: dict[str, Number]


class Record(TypedDict, total=False):
    """The record of a trajectory as JSON has it."""

    kind: str
    completed: bool
    seed: int
    program: dict[str, str]
    platform: str
    force_field: str | None
    solvent: str | None
    temperature_k: Number | None
    hydrogen_mass_da: Number | None
    constrain_hydrogens: bool
    cost: _Cost
    summary: _Summary
    interventions: _Interventions
    precision: str
    precision_reason: str | None
    out_of_domain: list[_Deviation]
