"""How figures are written."""

from __future__ import annotations


def percent(value: float) -> str:
    """Write 0..1 as per cent."""
    return f"{100 * value:.1f} %"


def count(value: float) -> str:
    """Write a count with thousands separators."""
    return f"{value:,.0f}"


def seconds(value: float) -> str:
    """Write a duration so that it reads at any length."""
    if value < 0.01:
        return "< 0.01 s" if value > 0 else "0 s"
    if value < 100:
        return f"{value:.2f} s" if value < 10 else f"{value:.1f} s"
    return f"{value / 60:.1f} min" if value < 6000 else f"{value / 3600:.1f} h"
