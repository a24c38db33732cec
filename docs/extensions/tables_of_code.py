"""The directives `definitions`, `metrics` and `flags`: what the code says of the comparison's terms and metrics, and of
frames' flags, as tables."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Definitions(SphinxDirective):
    """`{definitions}`: the comparison's terms, as its report defines them."""

    def run(self) -> list[nodes.Node]:
        from surrogate.comparison.report.report import definitions

        parts = []
        for one in definitions():
            source = f" *{_plain(one.source)}*" if one.source else ""
            parts.append(f"{_plain(one.term)}\n: {_plain(one.meaning)}{source}\n")
        return self.parse_text_to_nodes("\n".join(parts))


class MetricsTable(SphinxDirective):
    """`{metrics}`: what is measured, its kind and its time scale."""

    def run(self) -> list[nodes.Node]:
        from surrogate.comparison.metrics import METRICS

        lines = ["| metric | kind | time scale |", "|---|---|---|"]
        lines += [
            f"| {_plain(m.name)} | {m.kind} | {'' if m.kind == 'information' else m.time_scale} |" for m in METRICS
        ]
        return self.parse_text_to_nodes("\n".join(lines))


class FlagsTable(SphinxDirective):
    """`{flags}`: the bits of a frame's flags."""

    def run(self) -> list[nodes.Node]:
        from systems.chemistry.validity import INVALID, flag_names

        rows = [1 << k for k in range(16)]
        lines = ["| bit | meaning | makes a frame invalid |", "|---|---|---|"]
        for bit in rows:
            for name in flag_names(bit):
                lines.append(f"| {bit} | {_plain(name)} | {'yes' if bit & INVALID else 'no'} |")
        return self.parse_text_to_nodes("\n".join(lines))


def _plain(text: str) -> str:
    """Return a text in which nothing is Markdown."""
    return "".join("\\" + c if c in "\\`*_[]<>|$" else c for c in text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("definitions", Definitions)
    app.add_directive("metrics", MetricsTable)
    app.add_directive("flags", FlagsTable)
    return {"parallel_read_safe": True}
