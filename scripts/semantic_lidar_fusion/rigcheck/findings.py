# SPDX-License-Identifier: MIT
"""What a check says: one finding, its verdict, and the table of all of them."""

import dataclasses
import enum
from typing import Iterable, List, Optional


class Verdict(enum.IntEnum):
    """Ordered by how much a reader has to worry."""

    OK = 0
    NOT_OBSERVABLE = 1
    SUSPECT = 2
    WRONG = 3

    @property
    def text(self) -> str:
        return self.name.lower().replace("_", " ")


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the report.

    sensor: `bag`, `lidar`, `odometry`, or a camera's name; check: what was looked at; figure: what
    was found, with its unit and, where there is one, its half-width; cause: the mistake's name in
    plain words, empty if all is well; cure: what to change.
    """

    sensor: str
    check: str
    verdict: Verdict
    figure: str
    cause: str = ""
    cure: str = ""

    def sentence(self) -> str:
        """Everything on one line."""
        parts = ["%s, %s: %s" % (self.sensor, self.check, self.figure)]
        parts += ["%s" % self.cause] if self.cause else []
        parts += ["cure: %s" % self.cure] if self.cure else []
        return "; ".join(parts)


def worst(findings: Iterable[Finding]) -> Verdict:
    """The verdict over all; OK without any."""
    return max((finding.verdict for finding in findings), default=Verdict.OK)


def headline(findings: Iterable[Finding]) -> Verdict:
    """The verdict over one sensor: what cannot be judged does not hide what is ok."""
    verdicts = {finding.verdict for finding in findings}
    doubtful = verdicts & {Verdict.SUSPECT, Verdict.WRONG}
    return max(doubtful) if doubtful else min(verdicts, default=Verdict.OK)


def sensors(findings: Iterable[Finding]) -> List[str]:
    """The sensors in the order in which they first occur."""
    return list(dict.fromkeys(finding.sensor for finding in findings))


def table(findings: List[Finding], width: int = 110) -> str:
    """The findings as text, a block for each sensor; `width` columns at most where words allow."""
    import textwrap

    lines: List[str] = []
    for sensor in sensors(findings):
        own = [finding for finding in findings if finding.sensor == sensor]
        lines.append("%s: %s" % (sensor, headline(own).text))
        for finding in own:
            head = "  %-15s %-14s " % (finding.verdict.text, finding.check)
            lines += _folded(head, finding.figure, width)
            for label, text in (("cause", finding.cause), ("cure", finding.cure)):
                if text:
                    lines += textwrap.wrap(
                        text,
                        width,
                        initial_indent=" " * 20 + label + ": ",
                        subsequent_indent=" " * 26,
                        break_long_words=False,
                        break_on_hyphens=False,
                    )
    return "\n".join(lines) + "\n"


def _folded(head: str, text: str, width: int) -> List[str]:
    import textwrap

    return textwrap.wrap(
        text,
        width,
        initial_indent=head,
        subsequent_indent=" " * len(head),
        break_long_words=False,
        break_on_hyphens=False,
    ) or [head]


def judged(
    value: float, half_width: float, suspect_at: float, wrong_at: float
) -> Optional[Verdict]:
    """The verdict on an offset of which `half_width` is not known; None = the data cannot tell.

    A half-width beyond the limit itself leaves the question open.
    """
    if not abs(value) < float("inf") or half_width > max(suspect_at, 0.5 * abs(value)):
        return None
    sure = abs(value) - half_width
    if sure > wrong_at:
        return Verdict.WRONG
    return Verdict.SUSPECT if sure > suspect_at else Verdict.OK
