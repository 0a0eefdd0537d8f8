"""Texts from outside, such as names of files, as something that can be printed, drawn and kept in any format."""


def printable(text: str) -> str:
    r"""Write characters that cannot be shown by their codes, as in `\x1b`.

    These are control characters, such as line ends and what colours a terminal; what XML and HTML cannot hold; and
    halves of characters, which stand for the bytes of a file name that is not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
