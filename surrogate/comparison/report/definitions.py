"""What each number in the report means, and where the definition comes from. Text only."""

from __future__ import annotations

from typing import NamedTuple


class Definition(NamedTuple):
    """One term of the report."""

    term: str
    meaning: str
    source: str


# A term, its meaning, and in some its source; an empty line between two.
_TEXT = """\
Equal terms
All trajectories are compared at the same save interval. Distances are taken over the same number of frames (from the
start, replicas in the order given); tests use all there is. Segments are never joined: no time correlation crosses from
one to the next.

Replicate, replicate baseline
An independent piece of the same MD of the same length, evaluated exactly as the candidate is. What it scores is the
replicate baseline: no simulation of this length can be expected to do better.

Blocks
Error bars and tests rest on blocks of ten correlation times of the slowest motion found among all torsions, rings, size
and shape, and TIC 0, in reference and replicate together. What moves fast within a state (φ given ψ's basin, steps) has
blocks of its own. Fewer than 20 independent samples, or states between which hardly any run passes: undecided.
Source: Flyvbjerg and Petersen, J. Chem. Phys. 91, 461 (1989)

Step of all torsions
Root mean square change of φ, ψ and every rotatable torsion from one frame to the next, as if every trajectory were in
each quarter of TIC 0 as often as the reference is, in states that all three hold.

Temperature of vibrations
The reference's temperature times the median ratio of the variances of bonds and angles to the reference's
(equipartition); constrained bonds are left out. Integrators widen angles, too: trajectories of two programs differ by
some 5 % at one temperature.

Secondary structure
Helix (H, G, I), strand (E, B) and coil of each residue by hydrogen bonds of the backbone, for five residues and more.
Source: DSSP: Kabsch and Sander, Biopolymers 22, 2577 (1983), as in MDTraj

Distance
Jensen-Shannon distance: the square root of the divergence, natural logarithm; 0 for equal histograms, 0.8326 (the root
of ln 2) for histograms without overlap. 100 bins on [-π, π] for one torsion, 50 × 50 for φ and ψ together, 100 bins
over the reference's range for TIC 0 (5 % wider) and over four standard deviations either way for bond lengths. Frames
beyond the range, and frames that are not finite, have bins of their own, so that a broken frame costs and never helps.
Source: Lin, IEEE Trans. Inf. Theory 37, 145 (1991); Endres and Schindelin, ibid. 49, 1858 (2003); bins as in MDGen
(Jing et al., 2024)

Basins
β: ψ outside of -120° ≤ ψ < 80°, which is α; the cuts lie at the two minima of the ψ density of alanine dipeptide. φ >
0: the left-handed region. Frames that are not finite belong to no basin and stay in the denominator. Tolerance: a
free-energy difference of 1 kJ/mol at 300 K.

Rare states
Where reference and replicate together visit φ > 0 of a residue fewer than ten times, in less than a tenth of their
frames, its share is luck: it is left out of the residue's map and of φ, and evaluated as a free energy ln((1 - p)/p) in
kT, whose standard error after n visits is the root of 2/n. Visits go from one core (20° to 160°) to the other; how they
fall on trajectories is tested by their lengths (exact binomial).

Autocorrelation of cos ψ
C(t) = <δx(0) δx(t)> / <δx²>, x = cos ψ, deviations from the mean over all segments, averaged over all pairs of frames
inside segments.

Relaxation time
The integral of C(t) to its first zero crossing (trapezoid rule): the integrated autocorrelation time.

TIC 0
The slowest linear combination of cos and sin of all φ and ψ, fitted on the reference alone (reversible TICA, mean
removed). Its timescale is -τ / ln λ(τ), with λ the time-symmetrised autocorrelation of the projected trajectory at the
lag τ: on the reference this is TICA's own eigenvalue.
Source: Pérez-Hernández et al., J. Chem. Phys. 139, 015102 (2013); deeptime (Hoffmann et al., 2022)

Forecast error
Only of segments that start from the same frame. FDE: mean distance of all atoms from the reference's at a time after
the shared frames; ADE: its mean up to that time. Frozen: the last shared frame for ever; constant velocity: the last
shared step repeated.
Source: Xu et al., EGNO (2024); LaM-SLidE (2025)

Potential energy
Of every k-th frame (about 400), by the reference's force field, after its stiff bonds were brought to rest with all
atoms held near where they were. A frame that cannot be relaxed counts as a whole range above.

Size and shape
Radius of gyration: mass-weighted, all atoms. End to end: the two heavy atoms furthest apart in bonds. RMSD and RMSF:
heavy atoms (alpha carbons of large molecules) superposed on the mean structure of the reference, the same for all
trajectories. Values beyond the reference's range are cut a whole range outside in means, and have bins of their own in
distances.
Source: Gower, Psychometrika 40, 33 (1975); Theobald, Acta Cryst. A61, 478 (2005)

Other torsions
ω, χ (IUPAC), every other rotatable bond, and rotors (methyl, hydroxyl, ammonium). Where a turn by 2π/m gives the same
molecule (m = 3 for methyl, 2 for phenyl), m times the angle is taken.
Source: IUPAC-IUB Commission, Biochemistry 9, 3471 (1970)

Contacts, hydrogen bonds
Contact: two heavy atoms more than three bonds apart within 4.5 Å; in chains of five residues or more, two alpha carbons
three or more residues apart within 8 Å. Hydrogen bond: H to acceptor (N, O) below 2.5 Å, angle at H above 120°. Of
those that the molecule's symmetry makes equal (the hydrogens of an ammonium, the oxygens of a carboxylate) the mean is
taken.
Source: Baker and Hubbard, Prog. Biophys. Mol. Biol. 44, 97 (1984)

Valid frames
Finite; every bond within 0.5 Å of its mean in the reference (the published stability rule) and, more strictly, within
20 %; no two atoms (beyond 1-4 neighbours) closer than the reference allows; every stereocentre, double bond and peptide
bond as in the reference; planar rings planar. A frame that fails any but the 20 % rule is invalid.
Source: Fu et al., 'Forces are not enough', TMLR (2023)

Error bars
95 % intervals from a block bootstrap: blocks of ten correlation times of the slowest torsion (never fewer than 10 nor
more than 100 blocks), 400 draws, centred on the value, widened for the small number of blocks by Student's t.
Source: Künsch, Ann. Statist. 17, 1217 (1989); Flyvbjerg and Petersen, J. Chem. Phys. 91, 461 (1989)

Significance
The candidate is tested against reference and replicate together. Distances: block permutation test, blocks dealt at
random to the two sides. Numbers: t test with combined standard errors; where reference and replicate disagree by more
than their errors, that is taken for the error. All p-values are corrected for their number (Holm); the level is 5 % for
the whole table. Faulty frames: any excess over the reference counts, except for what thermal motion can reach (clashes,
bonds 20 % off): there an exact binomial test, level 1 %.
Source: Holm, Scand. J. Statist. 6, 65 (1979)

Words
agrees: no significant difference, and one as large as the tolerance would have shown. close: significant, but within
the tolerance. differs: significant and beyond the tolerance. fails: cannot be computed where the reference can, or a
validity check missed tenfold. undecided: error bars wider than the tolerance.
"""


def _definition(block: str) -> Definition:
    term, _, text = block.partition("\n")
    meaning, _, source = text.replace("\n", " ").partition(" Source: ")
    return Definition(term, meaning, source)


DEFINITIONS = tuple(map(_definition, _TEXT.strip().split("\n\n")))
