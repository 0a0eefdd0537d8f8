"""Fractions as people read them."""


def percent(share: float) -> str:
    """Write a fraction as a percentage that is never rounded to all or nothing."""
    if 0 < share < 0.01:
        return "< 1 %"
    if 0.99 < share < 1:
        return "> 99 %"
    return f"{100 * share:.0f} %"
