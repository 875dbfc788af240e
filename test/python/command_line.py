# SPDX-License-Identifier: MIT
"""What the tests ask of every command that fails."""


def assert_one_line(code, errors, *words):
    """Exit code 1 and, beside warnings, one line with the error and all of `words`."""
    lines = [line for line in errors.strip().splitlines() if "warning:" not in line]
    assert code == 1, errors
    assert len(lines) == 1, errors
    assert "error:" in lines[0]
    for word in words:
        assert word in lines[0], errors
