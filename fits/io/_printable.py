"""Texts from outside, such as names of files, as something that can be printed, drawn and kept in any format."""


def printable(text: str) -> str:
    r"""Write control characters, and what XML, HTML and UTF-8 cannot hold, by their codes, as in `\x1b`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def plain(number: float, digits: int = 4, sign: str = "") -> str:
    """Significant digits, or whole numbers where these are more, without an exponent for large ones."""
    return f"{number:{sign}.{digits}g}" if abs(number) < 10**digits else f"{number:{sign}.0f}"
