"""Hybrid-36 numbers of PDB files: decimal as far as the columns reach, then A000..ZZZZ and a000..zzzz.

gemmi decodes them as it reads a file and offers no function; biotite's takes `A0` for 100.
"""

from __future__ import annotations

_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def decode(field: str, width: int) -> int | None:
    """Return the number in a field of `width` columns, or None where it is neither decimal nor hybrid-36.

    Source: Grosse-Kunstleve et al., cci.lbl.gov/hybrid_36.
    """
    text = field.strip()
    if text.lstrip("-").isdigit():
        return int(text)
    if len(text) != width or not text[0].isalpha() or not text.isascii() or not text.isalnum():
        return None
    lower = text[0].islower()
    if any(c.isalpha() and c.islower() != lower for c in text):
        return None
    start = 10**width + (26 * 36 ** (width - 1) if lower else 0)
    return start + int(text, 36) - 10 * 36 ** (width - 1)


def encode(number: int, width: int) -> str | None:
    """Return `number` in `width` columns, decimal where it fits, or None beyond hybrid-36."""
    if 10**width > number > -(10 ** (width - 1)):
        return f"{number:{width}d}"
    value = number - 10**width
    block = 26 * 36 ** (width - 1)
    if not 0 <= value < 2 * block:
        return None
    lower = value >= block
    value = value % block + 10 * 36 ** (width - 1)
    text = ""
    while value:
        value, digit = divmod(value, 36)
        text = _DIGITS[digit] + text
    return text.lower() if lower else text
