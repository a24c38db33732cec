"""The manual's own parts: tables from JSON and from the code, and tutorials without outputs."""

from __future__ import annotations

import gc
import json
import re
from pathlib import Path

import pytest

pytest.importorskip("sphinx", reason="the manual's libraries are not installed: pip install '.[docs]'")

import from_bench
import kernel_sockets
import nbclient
import nbformat
from command_reference import all_commands, command_markdown
from result_tables import TABLES, read_table, table_markdown


def test_every_table_of_results_can_be_shown_and_is_shown() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in TABLES.parents[1].rglob("*.md"))
    shown = set(re.findall(r"```\{results\} (\w+)", pages))
    assert shown == {path.stem for path in TABLES.glob("*.json")}
    for name in shown:
        record = read_table(TABLES / f"{name}.json")
        assert record["command"] in table_markdown(record)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"command": ""}, "lacks command"), ({"rows": [["one"]]}, "the row of 'one' has 1 cells, the head 2")],
)
def test_a_table_that_says_too_little_is_refused(tmp_path: Path, wrong: dict, message: str) -> None:
    record = {"columns": ["a", "b"], "rows": [["1", "2"]], "command": "measure", "machine": "mine"}
    path = tmp_path / "table.json"
    path.write_text(json.dumps(record))
    assert read_table(path) == record
    path.write_text(json.dumps(record | wrong))
    with pytest.raises(ValueError, match=re.escape(message)):
        read_table(path)


def test_what_a_benchmark_wrote_becomes_a_table(tmp_path: Path) -> None:
    speeds = {"case": "ethanol", "n_atoms": 9, "ns_per_day": {"ours": 122_100.0}, "ratio": [14.5, 13.0, 15.0]}
    measured = {"machine": {"name": "mine", "cores_used": 2}, "rounds": 3, "rows": [speeds | {"solvent": "vacuum"}]}
    record = from_bench.reference_speed(measured)
    path = tmp_path / "table.json"
    path.write_text(from_bench.table_text(record), encoding="utf-8")
    assert read_table(path) == record
    assert "| 9 (ethanol) | 122,100 | 14.5 [13.0, 15.0] |" in table_markdown(record)
    assert "mine, 2 cores used" in table_markdown(record)


def test_the_figure_reads_a_table_of_the_sweep(repository: Path) -> None:
    setting = {
        "label": "fitted 3", "weights": "w", "cpu_s_per_ns": {"mean": 0.591},
        "jsd": {"value": 0.1671, "low": 0.153, "high": None}, "md_of_same_seconds": 0.262,
        "equivalent_time": {"words": "8.1 ns"}, "times_faster": 5.01,
        "valid_half_angstrom_%": {"value": 99.64}, "bonds_20_percent_%": {"value": 94.63},
    }  # fmt: skip
    beaten = {"label": "euler 4", "cpu_s_per_ns": {"mean": 0.6}, "jsd": {"value": 0.2, "low": 0.1, "high": 0.3}}
    measured = {
        "config": {"time_ps": 20_000.0, "threads": 1, "lag_ps": None}, "machine": {"name": "mine"},
        "md": {"length_ps": 1e5, "replicate_baseline": 0.058, "errors": [0.6]},
        "rows": [setting, setting | beaten, {"label": "timed", "weights": "w"}],
    }  # fmt: skip
    record = from_bench.cost_error(measured)
    assert record["rows"] == [["`fitted`, 3", "0.591", "0.167", "0.26", "8.1 ns", "5.0", "99.64 / 94.63"]]
    assert record["columns"] == read_table(TABLES / "cost_error.json")["columns"]


def test_commands_have_their_options() -> None:
    names = {" ".join(words) for words in all_commands()}
    assert {"reference", "rollout", "compare", "train", "bench cost-error"} <= names
    text = command_markdown(["rollout"])
    assert "surromd rollout" in text
    assert "| `--weights " in text
    assert "\\[required\\]" in text


def test_settings_without_a_flag_are_listed_as_such() -> None:
    text = command_markdown(["rollout"])
    assert "| `[sampling] solver` |" in text
    assert "In `--config` files" not in command_markdown(["systems"])


def flags_in(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", text))


def test_the_manual_names_no_flag_that_is_gone(repository: Path) -> None:
    known = set().union(*(flags_in(command_markdown(words)) for words in all_commands()))
    # of the program as a whole, and of the shell's own commands
    known |= {"--help", "--version", "--install-completion", "--exclude"}
    # of maintainers' scripts, whose commands stand beside what they measured
    for script in (repository / "docs" / "studies").rglob("*.py"):
        known |= set(re.findall(r'add_argument\(\s*"(--[a-z-]+)"', script.read_text(encoding="utf-8")))
    pages = [repository / "README.md", *(repository / "docs").glob("*.md"), *(repository / "notebooks").glob("*.ipynb")]
    named = {page.name: flags_in(page.read_text(encoding="utf-8")) - known for page in pages}
    assert {name: flags for name, flags in named.items() if flags} == {}
    assert flags_in("`--not-there` and a--b") == {"--not-there"}


def test_tutorials_are_in_the_manual_and_stripped(repository: Path) -> None:
    index = (repository / "docs" / "index.md").read_text(encoding="utf-8")
    notebooks = sorted((repository / "notebooks").glob("*.ipynb"))
    assert sorted(re.findall(r"^tutorials/(\w+)$", index, re.MULTILINE)) == [path.stem for path in notebooks]
    for path in notebooks:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells), f"strip {path.name}"


def test_kernels_of_tutorials_take_no_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ports that are free when a kernel is asked for may be taken when it opens them."""
    code = "from ipykernel.connect import get_connection_info\nprint(get_connection_info())"

    def connection() -> dict:
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
        nbclient.execute(notebook)
        return json.loads(notebook.cells[0].outputs[0]["text"])

    monkeypatch.setattr(nbclient.client, "NotebookClient", kernel_sockets.SocketClient)
    found = connection()
    assert found["transport"] == "ipc"
    gc.collect()
    assert not Path(found["ip"]).parent.exists(), "its folder goes with the kernel"
    monkeypatch.undo()
    assert connection()["transport"] == "tcp"


def test_every_public_name_is_in_the_python_reference(repository: Path) -> None:
    import surrogate

    page = (repository / "docs" / "python.md").read_text(encoding="utf-8")
    assert not set(surrogate.__all__) - set(re.findall(r"^\.\. auto\w+:: (\w+)$", page, re.MULTILINE))
