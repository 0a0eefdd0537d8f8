"""Texts from outside, such as names of files, as something that can be printed, drawn and kept in any format."""


def printable(text: str) -> str:
    r"""Write characters that cannot be shown by their codes, as in `\x1b`.

    These are control characters, such as line ends and what colours a terminal; what XML and HTML cannot hold; and
    halves of characters, which stand for the bytes of a file name that is not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def plain(number: float, digits: int = 4, sign: str = "") -> str:
    """Significant digits, or whole numbers where these are more, without an exponent for large ones."""
    return f"{number:{sign}.{digits}g}" if abs(number) < 10**digits else f"{number:{sign}.0f}"
