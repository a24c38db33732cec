"""Quantities: what users write comes out in ps, s, K, 1/ps and dalton, and what is ambiguous is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from systems.errors import InputError, UnitError
from systems.units import (
    format_time_ps,
    parse_time_ps,
    parse_wall_s,
    quantity,
    whole_steps,
)


@pytest.mark.parametrize(
    ("text", "expected_ps"),
    [
        ("2fs", 0.002),
        ("1ps", 1.0),
        ("50ns", 50_000.0),
        ("1.5 us", 1.5e6),
        ("1\u00b5s", 1e6),
        ("1\u03bcs", 1e6),
        ("1ms", 1e9),
        (" 1e2 ps ", 100.0),
        ("1E-1ps", 0.1),
        (".5ps", 0.5),
    ],
)
def test_time(text: str, expected_ps: float) -> None:
    assert parse_time_ps(text) == pytest.approx(expected_ps, rel=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "ns",
        "10",
        "10 parsecs",
        "10NS",
        "1.2.3ns",
        "-1ns",
        "0ps",
        "1e999ns",
        "nan ps",
        "inf ps",
        "1,5ns",
        "10ns 5ps",
    ],
)
def test_bad_times_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(UnitError) as caught:
        parse_time_ps(text, "--time")
    message = str(caught.value)
    assert message.startswith(f"--time {text!r}")
    assert "10ns" in message, "the message shows how to write it"
    assert "\n" not in message


def test_a_missing_unit_is_named_as_such_and_the_units_listed() -> None:
    with pytest.raises(UnitError, match=r"has no unit; .*fs, ps, ns, us"):
        parse_time_ps("10")
    with pytest.raises(UnitError, match="unknown unit 'h'"):
        parse_time_ps("1h")


def test_unit_errors_are_input_errors() -> None:
    assert issubclass(UnitError, InputError)


def test_wall_time_and_simulated_time_do_not_mix() -> None:
    assert parse_wall_s("30min") == 1800.0
    assert parse_wall_s("1.5h") == 5400.0
    assert parse_wall_s("45s") == 45.0
    with pytest.raises(UnitError):
        parse_wall_s("10ns")
    with pytest.raises(UnitError):
        parse_time_ps("30min")


def test_temperature_friction_and_mass() -> None:
    assert {quantity("bath_k", text) for text in ("300K", "300", "300 K")} == {300.0}
    assert {quantity("friction_per_ps", text) for text in ("91/ps", "91", "91 1/ps")} == {91.0}
    assert quantity("friction_per_ps", "0.1/fs") == pytest.approx(100.0)
    assert {quantity("mass_da", text) for text in ("3Da", "3", "3 amu")} == {3.0}
    for name, text in (("bath_k", "25C"), ("friction_per_ps", "1ps"), ("mass_da", "3kg")):
        with pytest.raises(UnitError, match="unknown unit"):
            quantity(name, text)


@given(st.floats(min_value=1e-3, max_value=1e9, allow_nan=False))
def test_what_is_printed_reads_back(time_ps: float) -> None:
    assert parse_time_ps(format_time_ps(time_ps)) == pytest.approx(time_ps, rel=1e-5)


def test_format_picks_the_largest_unit() -> None:
    assert format_time_ps(1500.0) == "1.5 ns"
    assert format_time_ps(1.0) == "1 ps"
    assert format_time_ps(0.004) == "4 fs"
    assert format_time_ps(2e6) == "2 us"


@given(st.integers(min_value=1, max_value=10**9), st.sampled_from([0.0005, 0.001, 0.002, 0.004, 0.1, 0.2, 1.0, 3.0]))
def test_whole_multiples_are_counted(n: int, step_ps: float) -> None:
    assert whole_steps(n * step_ps, step_ps, "run") == n


@pytest.mark.parametrize(
    ("duration_ps", "step_ps"), [(1.0, 0.003), (0.5, 1.0), (10.0, 4.0), (1e6, 3.0), (1e9, 0.3), (1.0, 0.0041)]
)
def test_uneven_divisions_are_refused_however_long_the_run(duration_ps: float, step_ps: float) -> None:
    with pytest.raises(UnitError, match="not a whole multiple"):
        whole_steps(duration_ps, step_ps, "save interval in time steps")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("time_ps", "10ns", 10_000.0),
        ("time_ps", 3, 3.0),
        ("friction_per_ps", "0.1/fs", 100.0),
        ("budget_s", "30min", 1800.0),
        ("temperature_k", "310K", 310.0),
        ("padding_nm", "10A", 1.0),
        ("ionic_strength_molar", "150mM", 0.15),
        ("pressure_bar", "1atm", 1.01325),
        ("equilibrate_ps", 0.0, 0.0),
        ("equilibrate_ps", "0ps", 0.0),
        ("equilibrate_ps", "0.0 ns", 0.0),
        ("equilibrate_ps", "1ns", 1000.0),
        ("ionic_strength_molar", "0", 0.0),
        ("lag_ps", None, None),
    ],
)
def test_a_quantity_is_a_number_or_a_text_with_its_unit(name: str, value: float | str, expected: float) -> None:
    assert quantity(name, value) == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(("text", "said"), [("-1ps", "not negative"), ("0", "no unit"), ("0 parsecs", "unknown unit")])
def test_only_what_has_a_unit_is_none_at_all(text: str, said: str) -> None:
    with pytest.raises(UnitError, match=f"--equilibrate .*{said}"):
        quantity("equilibrate_ps", text, "--equilibrate")


@pytest.mark.parametrize("value", ["10", "soon", -1.0, float("nan"), float("inf"), True, [1.0], b"10ns"])
def test_what_is_no_quantity_is_refused_by_its_name(value: object) -> None:
    with pytest.raises(UnitError, match="time_ps"):
        quantity("time_ps", value)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("name", "number", "of", "power", "expected"),
    [
        ("time_ps", 10, "nanosecond", 1, 10_000.0),
        ("friction_per_ps", 0.1, "femtosecond", -1, 100.0),
        ("temperature_k", 310, "kelvin", 1, 310.0),
        ("hydrogen_mass_da", 3, "dalton", 1, 3.0),
        ("padding_nm", 10, "angstrom", 1, 1.0),
        ("ionic_strength_molar", 150, "millimolar", 1, 0.15),
        ("pressure_bar", 1, "atmosphere", 1, 1.01325),
        ("budget_s", 3, "minute", 1, 180.0),
    ],
)
def test_quantities_of_openmm(name: str, number: float, of: str, power: int, expected: float) -> None:
    from openmm import unit

    assert quantity(name, number * getattr(unit, of) ** power) == pytest.approx(expected, rel=1e-9)


def test_quantities_of_another_dimension_are_refused_in_one_line() -> None:
    from openmm import unit

    for name, value in (
        ("time_ps", 3 * unit.kelvin),
        ("friction_per_ps", 1 * unit.picosecond),
        ("pressure_bar", 1 * unit.nanometer),
        ("time_ps", -1 * unit.picosecond),
    ):
        with pytest.raises(UnitError, match=name) as caught:
            quantity(name, value)
        assert "\n" not in str(caught.value)
