"""Mutated PDB and mmCIF files: a scene that is what the file says, or one line of refusal; no traceback, no hang."""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from systems.errors import SurromdError
from systems.library.named_scenes import prepare
from systems.scene import Scene
from time_limits import time_limit

SOURCES = ("alanine-dipeptide", "aspirin", "ethanol", "benzene", "ACE-TRP-NME", "ACE-PRO-NME", "ACE-CYS-NME", "toluene")
SECONDS_A_FILE = 20
Mutation = Callable[[bytes, random.Random], bytes]


def _lines(data: bytes) -> list[bytes]:
    return data.splitlines(keepends=True)


def _atom_line(lines: list[bytes], rng: random.Random) -> int:
    rows = [k for k, line in enumerate(lines) if line.startswith((b"ATOM", b"HETATM"))]
    return rng.choice(rows) if rows else rng.randrange(len(lines))


def flip_bits(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def random_bytes(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data))
    junk = bytes(rng.randrange(256) for _ in range(rng.choice((1, 3, 20))))
    return data[:at] + junk + data[at + rng.choice((0, len(junk))) :]


def cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(1, len(data))]


def drop_line(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    del lines[rng.randrange(len(lines))]
    return b"".join(lines)


def repeat_line(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return b"".join(lines)


def swap_lines(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)


def odd_number(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    k = _atom_line(lines, rng)
    value = rng.choice(("     nan", "     inf", "********", "1_0.0000", "  1e3000", " -1e-300", "99999.99", "        ",
                        "0x1.0000", "   1,234", "-9999.99", "١٢٣"))  # fmt: skip
    start = rng.choice((6, 22, 30, 38, 46, 54))
    lines[k] = lines[k][:start] + value[:8].encode() + lines[k][start + 8 :]
    return b"".join(lines)


def odd_field(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    k = _atom_line(lines, rng)
    start, width = rng.choice(((0, 6), (6, 5), (12, 4), (16, 1), (17, 3), (21, 1), (22, 4), (26, 1), (76, 2)))
    value = "".join(rng.choice("ACHNOSX0129 *'-é") for _ in range(width))
    lines[k] = lines[k][:start] + value.encode()[:width] + lines[k][start + width :]
    return b"".join(lines)


def shift_columns(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    k = _atom_line(lines, rng)
    at = rng.randrange(max(len(lines[k]) - 1, 1))
    lines[k] = lines[k][:at] + rng.choice((b"", b" ", b"\t", "é".encode())) + lines[k][at + rng.choice((0, 1)) :]
    return b"".join(lines)


def odd_record(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    record = rng.choice((b"MODEL        2\n", b"ENDMDL\n", b"TER\n", b"END\n", b"CONECT    1    9\n", b"CONECT\n",
                         b"CONECT    1    1\n", b"CONECT99999    2\n", b"CRYST1    0.000\n", b"\r\n", b"\n",
                         b"\x00\n"))  # fmt: skip
    lines.insert(rng.randrange(len(lines) + 1), record)
    return b"".join(lines)


def move_atom(data: bytes, rng: random.Random) -> bytes:
    lines = _lines(data)
    k = _atom_line(lines, rng)
    start = rng.choice((30, 38, 46))
    value = f"{rng.uniform(-1, 1) * 10 ** rng.randrange(-2, 4):8.3f}"[:8]
    lines[k] = lines[k][:start] + value.encode() + lines[k][start + 8 :]
    return b"".join(lines)


def strip_hydrogens(data: bytes, rng: random.Random) -> bytes:
    return b"".join(x for x in _lines(data) if not (x[76:78].strip() == b"H" and rng.random() < 0.8))


MUTATIONS: tuple[Mutation, ...] = (flip_bits, random_bytes, cut, drop_line, repeat_line, swap_lines, odd_number,
                                   odd_field, shift_columns, odd_record, move_atom, strip_hydrogens)  # fmt: skip


def mutated(seed: int, sources: list[bytes]) -> tuple[str, bytes]:
    """Return what was done and the mutated file number `seed`."""
    rng = random.Random(seed)
    data, done = rng.choice(sources), []
    for mutation in rng.choices(MUTATIONS, k=rng.choice((1, 1, 1, 2, 4))):
        if data:
            data = mutation(data, rng)
            done.append(mutation.__name__)
    return "+".join(done), data


_NUMBER = re.compile(r" *[-+]?[0-9]*\.?[0-9]*([eE][-+]?[0-9]+)? *\Z")


_TELLING = re.compile("left out|models|added|taken|kept|hydrogens placed|dropped|standardi|renamed|replaced")


def atoms_of(data: bytes) -> list[tuple[float, float, float]] | None:
    """What the bytes say, column by column, of the first model, read as strictly as the format is written."""
    found: list[tuple[float, float, float]] = []
    ended = False
    for line in data.decode("utf-8", errors="replace").splitlines():
        fields = [line[k : k + 8] for k in (30, 38, 46)]
        plain = all(_NUMBER.match(f) and f.strip() for f in fields)
        ended |= bool(found) and line[:6].rstrip() == "END"
        if line.startswith("ENDMDL") or (line.startswith("MODEL") and found):
            if found:
                break
        elif line.startswith(("ATOM  ", "HETATM")) and not plain:
            if not ended:  # after END nothing is read, and what is there counts as lost
                return None
        elif line.startswith(("ATOM  ", "HETATM")):
            found.append((float(fields[0]), float(fields[1]), float(fields[2])))
    return found


def altered(scene: Scene, data: bytes) -> str:
    """Say what the scene changed of the file without telling, or return an empty string."""
    said = scene.provenance["repairs"]
    there = atoms_of(data)
    if there is None:
        return "read coordinates that are no plain numbers"
    if not np.isfinite(scene.positions_nm).all():
        return "positions that are not finite"
    if len(there) == scene.n_atoms and np.abs(scene.positions_nm * 10 - there).max() < 1e-6:
        return ""
    kept = Counter(tuple(np.round(x, 3)) for x in (scene.positions_nm * 10).tolist())
    given = Counter(tuple(np.round(x, 3)) for x in there)
    lost, new = sum((given - kept).values()), sum((kept - given).values())
    if not said:
        return f"{scene.n_atoms} atoms from {len(there)} records, {lost} of them lost, and nothing said"
    if lost and not _TELLING.search(" ".join(said)):
        return f"{lost} atoms lost, and only this said: {said}"
    if new and not _TELLING.search(" ".join(said)):
        return f"{new} atoms made up, and only this said: {said}"
    return ""


def outcome(path: Path, data: bytes) -> str:
    """Return 'read' or 'refused'; raise AssertionError for anything else."""
    path.write_bytes(data)
    try:
        with time_limit(SECONDS_A_FILE):
            scene = prepare(str(path))
    except SurromdError as error:
        assert str(error).strip() and "\n" not in str(error), f"not one line: {error!r}"
        return "refused"
    fault = altered(scene, data)
    assert not fault, fault
    return "read"


def fuzz(seeds: range, folder: Path, sources: list[bytes]) -> tuple[Counter[str], list[str]]:
    """Return how often each outcome came, and every fault with the seed that makes it again."""
    counts: Counter[str] = Counter()
    faults = []
    for seed in seeds:
        what, data = mutated(seed, sources)
        if not data:
            continue
        try:
            counts[outcome(folder / "mutated.pdb", data)] += 1
        except Exception as error:  # whatever else is raised is the finding
            counts["fault"] += 1
            faults.append(f"seed {seed} ({what}): {type(error).__name__}: {error}")
    return counts, faults


@pytest.fixture(scope="module")
def sources(repository: Path) -> list[bytes]:
    return [(repository / "systems" / "library" / "data" / f"{name}.pdb").read_bytes() for name in SOURCES]


def test_an_alteration_is_noticed(sources: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "whole.pdb"
    path.write_bytes(sources[1])
    scene = prepare(str(path))
    assert altered(scene, sources[1]) == ""
    moved = scene.positions_nm.copy()
    moved[3, 2] += 1e-4
    assert "1 atoms lost" in altered(scene.with_positions(moved), sources[1])
    fewer = b"".join(line for line in _lines(sources[1]) if not line.startswith(b"ATOM      4"))
    assert "1 atoms made up" in altered(scene, fewer)
    assert outcome(path, sources[1]) == "read" and outcome(path, b"ATOM") == "refused"


def test_mutated_structures(tmp_path: Path, sources: list[bytes]) -> None:
    counts, faults = fuzz(range(200), tmp_path, sources)
    assert not faults, "\n".join(faults)
    assert counts["read"] > 20 and counts["refused"] > 40, "mutations must neither be harmless nor always fatal"


@pytest.mark.slow
def test_ten_thousand_mutated_structures(tmp_path: Path, sources: list[bytes]) -> None:
    counts, faults = fuzz(range(1_000, 11_000), tmp_path, sources)
    assert not faults, "\n".join(faults[:20])
    assert sum(counts.values()) > 9_900


def _as_mmcif(pdb: bytes) -> bytes:
    import gemmi

    structure = gemmi.read_pdb_string(pdb.decode())
    structure.setup_entities()
    return structure.make_mmcif_document().as_string().encode()


def fuzz_mmcif(seeds: range, folder: Path, sources: list[bytes]) -> tuple[Counter[str], list[str]]:
    """As `fuzz`, of mmCIF: each coordinate stands in the file, in a plain notation, or something is said."""
    counts: Counter[str] = Counter()
    faults = []
    path = folder / "mutated.cif"
    for seed in seeds:
        rng = random.Random(seed)
        data, done = rng.choice(sources), []
        for mutation in rng.choices(
            (flip_bits, random_bytes, cut, drop_line, repeat_line, swap_lines), k=rng.choice((1, 1, 2))
        ):
            data = mutation(data, rng) or b"x"
            done.append(mutation.__name__)
        path.write_bytes(data)
        try:
            with time_limit(SECONDS_A_FILE):
                scene = prepare(str(path))
        except SurromdError as error:
            counts["refused" if "\n" not in str(error) else "fault"] += 1
            continue
        except Exception as error:
            faults.append(f"seed {seed} ({'+'.join(done)}): {type(error).__name__}: {error}")
            continue
        numbers = {round(float(word), 3) for word in data.split() if re.fullmatch(rb"[-+]?[0-9]*\.?[0-9]+", word)}
        unsaid = [x for x in (scene.positions_nm * 10).ravel().tolist() if round(x, 3) not in numbers]
        if unsaid and not scene.provenance["repairs"]:
            faults.append(f"seed {seed} ({'+'.join(done)}): {len(unsaid)} coordinates from nowhere, and nothing said")
        counts["read"] += 1
    return counts, faults


def test_mutated_mmcif(tmp_path: Path, sources: list[bytes]) -> None:
    counts, faults = fuzz_mmcif(range(100), tmp_path, [_as_mmcif(source) for source in sources])
    assert not faults, "\n".join(faults)
    assert counts["read"] > 10 and counts["refused"] > 20 and not counts["fault"]
