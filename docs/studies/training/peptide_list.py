"""Peptides of the weights `peptides`: those for training, and those kept for testing and never trained on."""

from __future__ import annotations

import random
from collections.abc import Set
from dataclasses import dataclass
from itertools import product

# Amino acids with their protonation states, as the library has them capped.
RESIDUES = (
    "ALA", "ARG", "ASN", "ASP", "CYS", "GLN", "GLU", "GLY", "HID", "HIE", "HIP", "ILE", "LEU", "LYS", "MET", "PHE",
    "PRO", "SER", "THR", "TRP", "TYR", "VAL",
)  # fmt: skip
# Never trained on. Monomers are tested on long runs of their own: their residues are all in training.
TEST_PAIRS = (("LEU", "SER"), ("VAL", "ASN"), ("PHE", "GLY"), ("LYS", "GLU"), ("ALA", "PRO"), ("TRP", "THR"))
TEST_MONOMERS = ("ALA", "ASN", "PHE")
TEST_CHAINS = (
    ("SER", "LEU", "ALA"), ("ALA", "SER", "VAL", "LEU"), ("GLY", "TYR", "GLU", "LYS"),
    ("VAL", "GLY", "ASP", "ALA", "PHE"), ("ALA", "LYS", "LEU", "GLU", "THR", "ILE"),
)  # fmt: skip
TEST_FREE_CHAINS = (("ILE", "GLN", "ALA", "PHE"), ("SER", "LEU"), ("VAL", "GLU"), ("LEU", "ILE"), ("MET", "SER"))
# Beside the rounds of pairs: what these hold little of, residues before proline and opposite charges side by side.
FURTHER_PAIRS = (
    ("GLY", "PRO"), ("VAL", "PRO"), ("SER", "PRO"), ("LEU", "PRO"), ("LYS", "PRO"), ("GLU", "PRO"), ("ASN", "PRO"),
    ("PHE", "PRO"), ("LYS", "ASP"), ("ASP", "LYS"), ("ARG", "GLU"), ("GLU", "ARG"), ("GLU", "LYS"), ("ARG", "ASP"),
)  # fmt: skip
# Others that are tested by, in OBC2 and in water (`docs/studies/reference/error_against_minutes.py` has some of them).
UNSEEN_PAIRS = (
    ("GLN", "ILE"), ("TYR", "ASP"), ("THR", "PHE"), ("ARG", "ALA"), ("MET", "LEU"), ("ILE", "LYS"),
)  # fmt: skip
UNSEEN_CHAINS = (
    ("TYR", "THR", "GLY"), ("ASN", "ALA", "LEU"), ("VAL", "SER", "GLU", "PHE"), ("LEU", "ALA", "LEU"),
    ("GLN", "TRP", "SER"), ("GLU", "ILE", "ARG"), ("PRO", "VAL", "THR", "LYS"),
)  # fmt: skip
UNSEEN_FREE = (("GLY", "VAL"), ("ALA", "TYR"))
_UNSEEN_TETRAPEPTIDES = 11
FIRST_TESTS = 14
_WIDE_PAIRS, _WIDE_CHAINS, _WIDE_FREE_ROUNDS, _WIDE_SEED, _WIDE_PS = 300, 200, 3, 43, 2000.0
# What weights know least of.
_FREE_CHAINS, _FREE_SEED = 120, 44
_TEST_STARTS = 16
_PAIR_ROUNDS = 3
_CHAINS = 12
_FREE_PAIRS = 12
_SEED = 15


@dataclass(frozen=True)
class Peptide:
    """One molecule: residues without caps, whether it is capped (ACE, NME), how many starts and how long."""

    residues: tuple[str, ...]
    capped: bool
    n_starts: int
    time_ps: float

    @property
    def sequence(self) -> str:
        """What `sequence:` is given."""
        return "-".join(("ACE", *self.residues, "NME") if self.capped else self.residues)

    @property
    def name(self) -> str:
        return ("" if self.capped else "free-") + "-".join(self.residues)


def training_peptides() -> tuple[Peptide, ...]:
    """Return every training molecule in the order in which they are simulated.

    Monomers first; then capped pairs in three rounds, each of which has every residue once at either position, so that
    the first n pairs are a fair set for any n; then FURTHER_PAIRS; then tri- and tetrapeptides and pairs with free
    termini by turns.
    """
    monomers = [Peptide((residue,), True, 48, 2000.0) for residue in RESIDUES]
    rng = random.Random(_SEED)
    taken = set(TEST_PAIRS)
    pairs = []
    for _ in range(_PAIR_ROUNDS):
        drawn = _matching(rng, taken)
        taken.update(drawn)
        pairs += [Peptide(pair, True, 16, 1600.0) for pair in drawn]
    pairs += [Peptide(pair, True, 16, 1600.0) for pair in FURTHER_PAIRS if pair not in taken]
    chains = [
        Peptide(residues, True, 16, 1600.0)
        for residues in _chains(rng, {*TEST_CHAINS, *TEST_FREE_CHAINS}, lengths=(3, 4), n=_CHAINS)
    ]
    free = [
        Peptide(residues, False, 16, 1600.0) for residues in _chains(rng, set(TEST_PAIRS), lengths=(2,), n=_FREE_PAIRS)
    ]
    return (*monomers, *pairs, *(peptide for both in zip(chains, free, strict=True) for peptide in both))


def held_out_peptides() -> tuple[Peptide, ...]:
    """Return what is never trained on, sixteen runs of each; monomers are tested on runs of their own."""
    return (
        *(Peptide(pair, True, _TEST_STARTS, 30_000.0) for pair in TEST_PAIRS),
        *(Peptide((residue,), True, _TEST_STARTS, 50_000.0) for residue in TEST_MONOMERS),
        *(Peptide(residues, True, _TEST_STARTS, 10_000.0) for residues in TEST_CHAINS),
        *(Peptide(residues, False, _TEST_STARTS, 10_000.0) for residues in TEST_FREE_CHAINS),
    )


def unseen_tetrapeptides() -> list[tuple[str, ...]]:
    """Return tetrapeptides with free ends for MDGen's metrics, beside the one of TEST_FREE_CHAINS."""
    return _chains(random.Random(_WIDE_SEED), {*TEST_FREE_CHAINS}, lengths=(4,), n=_UNSEEN_TETRAPEPTIDES)


def wide_peptides() -> tuple[Peptide, ...]:
    """Return the molecules of the wide campaign, by which states of torsions may be coupled along the chain: monomers,
    then by turns pairs, chains of three and four residues, a third of these with free ends, and pairs with free ends
    that every residue bears, so that any beginning is a fair part; then more chains with free ends. Sixteen runs of
    2 ns each."""
    rng = random.Random(_WIDE_SEED)
    tested = {*TEST_PAIRS, *UNSEEN_PAIRS, *TEST_CHAINS, *UNSEEN_CHAINS, *TEST_FREE_CHAINS, *UNSEEN_FREE}
    tested |= {*unseen_tetrapeptides()}
    pairs = rng.sample([pair for pair in product(RESIDUES, repeat=2) if pair not in tested], _WIDE_PAIRS)
    chains = _chains(rng, tested, lengths=(3, 4), n=_WIDE_CHAINS)
    free: list[tuple[str, str]] = []
    for _ in range(_WIDE_FREE_ROUNDS):
        free += _matching(rng, {*tested, *free})
    kinds = (
        [Peptide(p, True, _TEST_STARTS, _WIDE_PS) for p in pairs],
        [Peptide(p, k // 3 % 3 != 0, _TEST_STARTS, _WIDE_PS) for k, p in enumerate(chains)],
        [Peptide(p, False, _TEST_STARTS, _WIDE_PS) for p in free],
    )
    by_turns = sorted(((k + 0.5) / len(some), p.name, p) for some in kinds for k, p in enumerate(some))
    monomers = [Peptide((r,), True, _TEST_STARTS, _WIDE_PS) for r in RESIDUES]
    further = _chains(random.Random(_FREE_SEED), {*tested, *chains}, lengths=(4, 4, 3), n=_FREE_CHAINS)
    last = (Peptide(p, False, _TEST_STARTS, _WIDE_PS) for p in further)
    return (*monomers, *(p for *_, p in by_turns), *last)


def unseen_peptides() -> tuple[Peptide, ...]:
    """Return what the wide campaign tests by: 12 pairs, 4 monomers, 12 capped and 14 free chains, the first FIRST_TESTS
    a part of each but monomers."""
    pairs, capped = (*TEST_PAIRS, *UNSEEN_PAIRS), (*TEST_CHAINS, *UNSEEN_CHAINS)
    free = (*UNSEEN_FREE, TEST_FREE_CHAINS[0], *unseen_tetrapeptides())
    some = (
        *(Peptide(pair, True, _TEST_STARTS, 10_000.0) for pair in pairs),
        *(Peptide((residue,), True, _TEST_STARTS, 20_000.0) for residue in (*TEST_MONOMERS, "TYR")),
        *(Peptide(chain, True, _TEST_STARTS, 10_000.0) for chain in capped),
        *(Peptide(chain, False, _TEST_STARTS, 10_000.0) for chain in free),
    )
    first = (*pairs[:9], *capped[:2], *free[:3])
    assert len(first) == FIRST_TESTS
    return tuple(sorted(some, key=lambda peptide: peptide.residues not in first))


def _matching(rng: random.Random, taken: Set[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Return one pair for each residue at the first place, each once at the second, none of them `taken`."""
    while True:
        second = list(RESIDUES)
        rng.shuffle(second)
        pairs = list(zip(rng.sample(RESIDUES, len(RESIDUES)), second, strict=True))
        if not taken & set(pairs):
            return pairs


def _chains(
    rng: random.Random, taken: set[tuple[str, ...]], *, lengths: tuple[int, ...], n: int
) -> list[tuple[str, ...]]:
    """Return `n` chains whose residues come from shuffled decks, so that none is drawn far more often than another."""
    deck: list[str] = []
    found: list[tuple[str, ...]] = []
    while len(found) < n:
        length = lengths[len(found) % len(lengths)]
        while len(deck) < length:
            deck += rng.sample(RESIDUES, len(RESIDUES))
        chain, deck = tuple(deck[:length]), deck[length:]
        if chain not in taken:
            taken.add(chain)
            found.append(chain)
    return found
