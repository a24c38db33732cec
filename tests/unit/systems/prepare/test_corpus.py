"""Structure files that others wrote (docs/studies/preparation/corpus.py): taken as they are, or refused for a
reason."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def corpus(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "corpus", repository / "docs" / "studies" / "preparation" / "corpus.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["corpus"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def structures(shared_data: Path) -> Path:
    folder = shared_data / "structures"
    if not (folder / "corpus.tsv").exists():
        pytest.skip(f"no corpus at {folder}")
    return folder


def _row(corpus: ModuleType, path: Path, peer: str = "ok:fixer [fixer: 22 atoms, charge +0]", before: str = "ok;"):
    return corpus.Row(path.name, str(path), "amber", peer, before)


def test_a_file_is_taken_and_every_alteration_noticed(corpus: ModuleType, repository: Path, tmp_path: Path) -> None:
    text = (repository / "systems" / "library" / "data" / "alanine-dipeptide.pdb").read_text()
    path = tmp_path / "whole.pdb"
    path.write_text(text)
    row = _row(corpus, path)
    taken = corpus.try_row(row)
    assert (taken.state, taken.n_atoms, taken.faults) == ("ok", 22, ())
    from systems.library.named_scenes import prepare

    scene = prepare(str(path))
    moved = scene.positions_nm.copy()
    moved[3, 2] += 0.001
    assert not corpus._unsaid(row, scene, ())
    assert "lost or changed" in corpus._unsaid(row, scene.with_positions(moved), ())[0]
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith("ATOM      5")))
    assert corpus._unsaid(row, scene, ("1 water molecule left out",)), "a note on losses tells no gain"


def test_the_table_counts_what_peers_take(corpus: ModuleType, tmp_path: Path) -> None:
    rows = [
        _row(corpus, tmp_path / "a.pdb"),
        _row(corpus, tmp_path / "b.pdb", before="ok with drop_water; plan ok"),
        _row(corpus, tmp_path / "c.pdb", peer="garbage [fixer: E nan]", before="refused: ..."),
    ]
    ok, refused = corpus.Outcome("ok", "", n_atoms=22), corpus.Outcome("refused", "it holds water")
    text, holds = corpus.report(rows, [ok, ok, refused])
    assert holds and "amber                      2        1        2  100.0" in text
    text, holds = corpus.report(rows, [ok, refused, refused])
    assert not holds and "b.pdb: it holds water" in text and "below 97%" in text
    clash = corpus.Outcome("ok", "", faults=("atoms stand in each other: 1e+09 kJ/mol",))
    text, holds = corpus.report(rows, [ok, ok, clash])
    assert not holds and "taken by us: 1" in text


# What a peer takes and we refuse, and why that is right.
REFUSED = {
    "amber__Amber-MD__tz2.stretched.pdb": "a hydrogen 1.99 Å from its carbon",
    "odd__RBVI__start.pdb": "coordinates that are no peptide's: neighbours lie 4 to 15 Å apart",
    "sdf__NicolasCARPi__example.mol": "a drawing whose columns are shifted: an oxygen with three bonds",
}
# What surromd took at 8e005fd and refuses now.
GARBAGE = {"amber__jamesgillesp__minip.pdb": "side chains through each other, 0.6 Å between hydrogens"}


def _hold(corpus: ModuleType, rows: list) -> None:
    outcomes = [corpus.try_row(row) for row in rows]
    pairs = list(zip(rows, outcomes, strict=True))
    text = corpus.report(rows, outcomes)[0]
    assert not [row.name for row, out in pairs if out.faults], text
    assert {r.name for r, o in pairs if r.is_ok_for_a_peer and not o.is_as_is} <= set(REFUSED), text
    assert {r.name for r, o in pairs if r.was_as_is and not o.is_as_is} <= {*REFUSED, *GARBAGE}, text


def test_small_files_are_taken_as_they_are(corpus: ModuleType, structures: Path) -> None:
    rows = [r for r in corpus.read_rows(structures) if r.kind in ("ccd", "odd", "molpdb")]
    assert len(rows) > 15
    _hold(corpus, rows)


@pytest.mark.slow
def test_the_corpus_is_taken_as_it_is(corpus: ModuleType, structures: Path) -> None:
    _hold(corpus, corpus.read_rows(structures))
