# SPDX-License-Identifier: MIT
"""The report as one HTML file that needs nothing else: no network, no script."""

import base64
import html
from typing import List, Optional, Sequence

import numpy as np

from semantic_lidar_fusion.bags.bag_io import write_text
from semantic_lidar_fusion.rigcheck import alignment
from semantic_lidar_fusion.rigcheck.camera_checks import Aligned
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict, headline, sensors
from semantic_lidar_fusion.rigcheck.run import RigCheck

PICTURE_WIDTH = 960
NOW_BGR, CORRECTED_BGR = (60, 60, 230), (90, 200, 60)

_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;margin:0;background:#f6f7f9;color:#1c2430}
main{max-width:1080px;margin:0 auto;padding:1.2rem}
h1{font-size:1.5rem;margin:.2rem 0 1rem}h2{font-size:1.15rem;margin:2rem 0 .6rem}
.card{background:#fff;border:1px solid #d9dee6;border-radius:8px;padding:1rem 1.2rem;margin:0 0 1rem}
.verdict{display:inline-block;border-radius:4px;padding:.05rem .5rem;font-size:.85rem;
white-space:nowrap;color:#fff}
.ok{background:#2c7a4b}.suspect{background:#a86400}.wrong{background:#b3261e}
.not_observable{background:#68707d}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%}
td,th{text-align:left;vertical-align:top;padding:.35rem .6rem;border-top:1px solid #e4e8ee}
th{font-weight:600}ol{padding-left:1.3rem}li{margin:.5rem 0}
pre{background:#eef1f5;border-radius:6px;padding:.8rem;overflow-x:auto;font-size:.85rem}
figure{margin:0 0 1.2rem}img{max-width:100%;height:auto;border-radius:6px;display:block}
figcaption{font-size:.9rem;color:#556070;margin-top:.3rem}
@media (prefers-color-scheme:dark){body{background:#14181e;color:#e3e7ee}
.card{background:#1d232c;border-color:#333c49}td,th{border-color:#333c49}pre{background:#12161b}
figcaption{color:#9aa5b4}}
"""


def write(path: str, result: RigCheck, bags: Sequence[str], rig: str) -> None:
    """Writes the report; DataError if the file cannot be written."""
    write_text(path, page(result, bags, rig))


def page(result: RigCheck, bags: Sequence[str], rig: str) -> str:
    """The whole page as text."""
    verdict = headline(result.findings)
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width,initial-scale=1'>",
        "<title>Rig check: %s</title><style>%s</style></head><body><main>" % (verdict.text, _STYLE),
        "<h1>Rig check %s</h1>" % _badge(verdict),
        "<p>%s with <code>%s</code></p>"
        % (", ".join("<code>%s</code>" % html.escape(bag) for bag in bags), html.escape(rig)),
        _first_screen(result.findings),
    ]
    if result.patch:
        parts.append("<h2>To paste</h2><pre>%s</pre>" % html.escape(result.patch))
    parts.append(_pictures(result.aligned))
    for sensor in sensors(result.findings):
        own = [finding for finding in result.findings if finding.sensor == sensor]
        parts.append("<h2>%s %s</h2>" % (html.escape(sensor), _badge(headline(own))))
        parts.append(_table(own))
    parts.append("</main></body></html>")
    return "\n".join(part for part in parts if part)


def _badge(verdict: Verdict) -> str:
    return "<span class='verdict %s'>%s</span>" % (verdict.name.lower(), verdict.text)


def _first_screen(findings: Sequence[Finding]) -> str:
    """What is wrong and what to do."""
    lines: List[str] = []
    for verdict in (Verdict.WRONG, Verdict.SUSPECT):
        for finding in findings:
            if finding.verdict != verdict:
                continue
            cure = "<br><b>Do:</b> %s" % html.escape(finding.cure) if finding.cure else ""
            lines.append(
                "<li>%s <b>%s</b>: %s%s</li>"
                % (
                    _badge(verdict),
                    html.escape(finding.sensor),
                    html.escape(finding.cause or finding.figure),
                    cure,
                )
            )
    if not lines:
        return (
            "<div class='card'>Nothing wrong was found. What is marked <i>not observable</i> below "
            "could not be judged with this drive.</div>"
        )
    return "<div class='card'><b>What is wrong, and what to do</b><ol>%s</ol></div>" % "".join(
        lines
    )


def _table(findings: Sequence[Finding]) -> str:
    rows = []
    for finding in findings:
        said = html.escape(finding.figure)
        if finding.cause:
            said += "<br><b>Cause:</b> %s" % html.escape(finding.cause)
        if finding.cure:
            said += "<br><b>Cure:</b> %s" % html.escape(finding.cure)
        rows.append(
            "<tr><td>%s</td><td>%s</td><td>%s</td></tr>"
            % (_badge(finding.verdict), html.escape(finding.check), said)
        )
    head = "<tr><th>verdict</th><th>check</th><th>figure</th></tr>"
    return "<div class='card scroll'><table>%s%s</table></div>" % (head, "".join(rows))


def _pictures(aligned: Sequence[Aligned]) -> str:
    figures = []
    for one in aligned:
        picture = overlay(one)
        if picture is None:
            continue
        caption = (
            "%s: edges of the lidar on the image; red as the rig says, green at the best offset "
            "(edges meet with %.2f and %.2f)"
            % (one.camera.name, one.result.now.lift, one.result.best.lift)
        )
        figures.append(
            "<figure><img alt='%s' src='data:image/jpeg;base64,%s'><figcaption>%s</figcaption></figure>"
            % (html.escape(one.camera.name), _jpeg(picture), html.escape(caption))
        )
    return "<h2>Pictures</h2>" + "".join(figures) if figures else ""


def overlay(one: Aligned) -> Optional[np.ndarray]:
    """The lidar's edges on one image of the camera, BGR."""
    import cv2

    if not one.views:
        return None
    view = one.views[len(one.views) // 2]
    stamp = next((s for s, known in one.stamps.items() if known is view.image), None)
    if stamp is None:
        return None
    image = one.camera.images[stamp]
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    scale = PICTURE_WIDTH / picture.shape[1]
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = (picture * 0.7).astype(np.uint8)
    stack = alignment.Stack([view])
    for offset, color in ((np.zeros(4), NOW_BGR), (one.result.offset, CORRECTED_BGR)):
        pixels = stack.pixels(one.model.project, one.T_camera_vehicle, offset)
        for u, v in np.round((pixels + 0.5) * scale - 0.5).astype(int):
            cv2.circle(picture, (int(u), int(v)), 2, color, -1, cv2.LINE_AA)
    return picture


def _jpeg(picture: np.ndarray) -> str:
    import cv2

    encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return base64.b64encode(encoded.tobytes()).decode("ascii")
