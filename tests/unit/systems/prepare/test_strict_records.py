"""PDB records that look right and are not: refused or said, never read as something else."""

from __future__ import annotations

from pathlib import Path

import pytest

from systems.errors import InputError
from systems.library.named_scenes import prepare


@pytest.fixture
def ethanol_lines(repository: Path) -> list[str]:
    return (repository / "systems" / "library" / "data" / "ethanol.pdb").read_text().splitlines()


def _prepared(folder: Path, lines: list[str]) -> None:
    path = folder / "mutated.pdb"
    path.write_text("\n".join(lines) + "\n")
    prepare(str(path))


def _row(lines: list[str]) -> int:
    return next(k for k, line in enumerate(lines) if line.startswith(("ATOM", "HETATM")))


@pytest.mark.parametrize("number", ["   1_0.50", "  \t0.500", "  ١.٥٠0 ", "  0x1p1 ", "        "])
def test_numbers_of_other_notations_are_refused(tmp_path: Path, ethanol_lines: list[str], number: str) -> None:
    k = _row(ethanol_lines)
    _prepared(tmp_path, ethanol_lines)
    ethanol_lines[k] = ethanol_lines[k][:30] + f"{number:8s}"[:8] + ethanol_lines[k][38:]
    with pytest.raises(InputError, match=rf"line {k + 1}: columns 31-54"):
        _prepared(tmp_path, ethanol_lines)


def test_plain_notations_are_read(tmp_path: Path, ethanol_lines: list[str]) -> None:
    k = _row(ethanol_lines)
    x = float(ethanol_lines[k][30:38])
    for text in (f"{x:8.3f}", f"{x:<8.3f}", f"{x:+8.3f}", f"{x:8.1e}"):
        ethanol_lines[k] = ethanol_lines[k][:30] + text + ethanol_lines[k][38:]
        _prepared(tmp_path, ethanol_lines)


def test_replaced_hydrogens_are_said(tmp_path: Path, repository: Path) -> None:
    """Without its carbonyl oxygen the chain ends at ALA 2, and the nitrogen after it gets other hydrogens."""
    lines = (repository / "systems" / "library" / "data" / "alanine-dipeptide.pdb").read_text().splitlines()
    k = next(i for i, line in enumerate(lines) if line[12:21] == " O   ALA ")
    ca = next(i for i, line in enumerate(lines) if line[12:21] == " CA  ALA ")
    changed = [*lines[: ca + 1], "TER", *lines[ca + 1 : k], *lines[k + 1 :]]
    c = next(i for i, line in enumerate(changed) if line[12:21] == " C   ALA ")
    changed[c] = changed[c][:6] + "     " + changed[c][11:]
    path = tmp_path / "cut.pdb"
    path.write_text("\n".join(changed) + "\n")
    assert any("hydrogens of the file replaced on NME" in line for line in prepare(str(path)).provenance["repairs"])
