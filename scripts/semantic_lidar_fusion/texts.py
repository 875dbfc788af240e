# SPDX-License-Identifier: MIT
"""Texts from outside, as they may stand in a line."""


def plain_text(text: str, longest: int = 80) -> str:
    """A text of a message or file (a frame, a name, a path) as it may stand in a log or in the header
    of a file: one line of printable characters, escaped where it was not, at most about `longest`
    characters; what is longer loses its middle. The twin of common/plain_text.h."""
    if len(text) > longest:
        head, tail = text[: longest * 2 // 3], text[len(text) - longest // 3 :]
        text = "%s...(%d characters)...%s" % (head, len(text), tail)
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
