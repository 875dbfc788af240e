# SPDX-License-Identifier: MIT
"""Results as one HTML file that needs nothing else: no network, no other file, no library.

`page` joins parts; the other functions make parts: tables of the Markdown report, pictures inside the
file, a timeline of a fused bag, its settings, and a view of points that turns under the pointer.
"""

import base64
import html
import json
import re
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import BagReader, to_ns
from semantic_lidar_fusion.bags.clouds import Clouds
from semantic_lidar_fusion.bags.cloud_io import FUSED, SemanticCloud, xyz
from semantic_lidar_fusion.bags.poses import TransformTree, transform_points
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.rig import CONFIGURATION_TOPIC, Rig

STATUS_NAMES = ("fused", "occluded", "outside", "no image", "no odometry")
STATUS_COLORS = ("#2b7a4b", "#c98a1b", "#9aa3ad", "#7b5ea7", "#c0392b")
MOST_POINTS = 40000
MAP_CELL_M = 0.25
_NO_CLASS = (96, 96, 96)  # as in the clouds


class ScanLine(NamedTuple):
    """One scan of a fused bag: t_ref (ns), points by status, points of each camera, and how far its
    image is from t_ref (s, raw stamps; None = no image)."""

    stamp_ns: int
    by_status: Tuple[int, ...]
    by_camera: Tuple[int, ...]
    image_age_s: Tuple[Optional[float], ...]


class BagStory(NamedTuple):
    """What a fused bag tells of its run."""

    path: str
    labels: LabelSet
    cameras: List[str]
    scans: List[ScanLine]
    by_class: np.ndarray  # (C,) fused points
    richest: int  # the scan with most fused points
    configuration: str  # text of the resolved rig, with the version


def read_story(path: str, known: Optional[LabelSet] = None) -> BagStory:
    """Reads a fused bag once; `known`: its classes, where it has no class_info. DataError if it has
    no clouds, or if nothing tells its classes."""
    configuration, cameras, stamps = _decisions(path)
    with Clouds(path) as clouds:
        labels = clouds.labels or known
        if labels is None:
            raise DataError("%s: no class_info, so the classes have no names" % path)
        scans: List[ScanLine] = []
        by_class = np.zeros(len(labels), dtype=np.int64)
        for cloud in clouds:
            scans.append(_scan_line(cloud, cameras, stamps))
            label = cloud.label[cloud.fused & (cloud.label < len(labels))]
            by_class += np.bincount(label, minlength=len(labels))
    if not scans:
        raise DataError("%s: no clouds on %s" % (path, clouds.topic))
    richest = int(np.argmax([scan.by_status[FUSED] for scan in scans]))
    return BagStory(path, labels, cameras, scans, by_class, richest, configuration)


def _decisions(path: str) -> Tuple[str, List[str], Dict[str, Dict[int, int]]]:
    """The configuration, the cameras in the rig's order, and camera -> t_ref -> stamp of its image."""
    configuration, names = "", []
    references: Dict[int, int] = {}
    chosen: Dict[str, Dict[int, int]] = {}
    with BagReader(path) as bag:
        for item in bag.read([CONFIGURATION_TOPIC]):
            configuration = item.message.data
        for item in bag.read(["/scan_reference"]):
            references[to_ns(item.message.header.stamp)] = to_ns(item.message.time_ref)
        for topic in bag.topics_of_type("sensor_msgs/TimeReference"):
            if not topic.endswith("/selection"):
                continue
            name = topic[1 : -len("/selection")]
            names.append(name)
            for item in bag.read([topic]):
                stamp = to_ns(item.message.time_ref)
                reference = references.get(to_ns(item.message.header.stamp))
                if stamp and reference is not None:
                    chosen.setdefault(name, {})[reference] = stamp
    order = re.findall(r"^\s+(?:- )?name: ([A-Za-z]\w*)", configuration, re.MULTILINE)
    names.sort(key=lambda name: order.index(name) if name in order else len(order))
    return configuration, names, chosen


def _scan_line(
    cloud: SemanticCloud, cameras: Sequence[str], stamps: Dict[str, Dict[int, int]]
) -> ScanLine:
    by_status = np.bincount(np.minimum(cloud.status, 4), minlength=len(STATUS_NAMES))
    bits = cloud.optional("cameras")
    by_camera = [0] * len(cameras)
    if bits is not None:
        by_camera = [int((bits >> i & 1).sum()) for i in range(len(cameras))]
    ages: List[Optional[float]] = []
    for name in cameras:
        stamp = stamps.get(name, {}).get(cloud.stamp_ns)
        ages.append(None if stamp is None else (stamp - cloud.stamp_ns) * 1e-9)
    return ScanLine(cloud.stamp_ns, tuple(map(int, by_status)), tuple(by_camera), tuple(ages))


# --- Parts


def from_markdown(text: str) -> str:
    """The Markdown of report.md: headings, tables, paragraphs, code."""
    parts: List[str] = []
    for block in re.split(r"\n\s*\n", text.strip()):
        lines = block.strip("\n").split("\n")
        heading = re.match(r"(#+) +(.*)", lines[0])
        if heading:
            level = min(len(heading.group(1)), 4)
            parts.append("<h%d>%s</h%d>" % (level, _inline(heading.group(2)), level))
            lines = lines[1:]
        if len(lines) > 1 and lines[0].lstrip().startswith("|"):
            parts.append(_table([_cells(line) for line in lines if "|" in line]))
        elif any(line.strip() for line in lines):
            parts.append("<p>%s</p>" % _inline(" ".join(lines)))
    return "\n".join(parts)


def _inline(text: str) -> str:
    text = html.escape(text.strip())
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*([^*]+)\*\*", r"<b>\1</b>", text)


def _cells(line: str) -> List[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _table(rows: List[List[str]]) -> str:
    rows = [row for row in rows if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    head = "".join("<th>%s</th>" % _inline(cell) for cell in rows[0])
    body = "".join(
        "<tr>%s</tr>" % "".join("<td>%s</td>" % _inline(cell) for cell in row) for row in rows[1:]
    )
    return "<div class=wide><table><thead><tr>%s</tr></thead><tbody>%s</tbody></table></div>" % (
        head,
        body,
    )


def picture(path: str, title: str) -> str:
    """A PNG or JPEG inside the page."""
    with open(path, "rb") as file:
        data = base64.b64encode(file.read()).decode("ascii")
    kind = "png" if path.lower().endswith(".png") else "jpeg"
    return (
        '<figure><img alt="%s" src="data:image/%s;base64,%s"><figcaption>%s</figcaption></figure>'
        % (
            html.escape(title),
            kind,
            data,
            html.escape(title),
        )
    )


def overview(story: BagStory) -> str:
    """Figures of the whole bag."""
    total = np.sum([scan.by_status for scan in story.scans], axis=0)
    points = int(total.sum())
    seconds = (story.scans[-1].stamp_ns - story.scans[0].stamp_ns) * 1e-9
    rows = [["points", "number", "share"]]
    for name, count in zip(STATUS_NAMES, total):
        rows.append([name, str(int(count)), "%.1f %%" % (100.0 * count / max(points, 1))])
    classes = [["class", "fused points", "share"]]
    fused = max(int(story.by_class.sum()), 1)
    for info, count in zip(story.labels.classes, story.by_class):
        if count:
            classes.append([info.name, str(int(count)), "%.1f %%" % (100.0 * count / fused)])
    return "<h2>The drive</h2><p>%d scans over %.1f s, %d points, %d cameras.</p>%s%s" % (
        len(story.scans),
        seconds,
        points,
        len(story.cameras),
        _table(rows),
        _table(classes),
    )


def timeline(story: BagStory) -> str:
    """Scan by scan: shares of the statuses, points of each camera, and images that are missing."""
    times = [(scan.stamp_ns - story.scans[0].stamp_ns) * 1e-9 for scan in story.scans]
    parts = ["<h2>Scan by scan</h2>", _legend(STATUS_NAMES, STATUS_COLORS)]
    shares = np.array([scan.by_status for scan in story.scans], dtype=float)
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1.0)
    parts.append(_bands(times, shares, STATUS_COLORS, "share of the points"))
    for index, name in enumerate(story.cameras):
        counts = [scan.by_camera[index] for scan in story.scans]
        ages = [scan.image_age_s[index] for scan in story.scans]
        missing = [k for k, age in enumerate(ages) if age is None]
        known = [abs(age) for age in ages if age is not None]
        note = "%s: %.0f points a scan, %d of %d scans without an image" % (
            name,
            float(np.mean(counts)),
            len(missing),
            len(counts),
        )
        if known:
            note += ", images %.1f ms from t_ref (mean), %.1f at most" % (
                1e3 * float(np.mean(known)),
                1e3 * max(known),
            )
        parts.append("<p class=note>%s</p>%s" % (html.escape(note), _bars(times, counts, missing)))
    return "\n".join(parts)


def _legend(names: Sequence[str], colors: Sequence[str]) -> str:
    return "<p class=legend>%s</p>" % "".join(
        '<span><i style="background:%s"></i>%s</span>' % (color, html.escape(name))
        for name, color in zip(names, colors)
    )


_WIDTH, _HEIGHT = 900, 90


def _x(times: Sequence[float]) -> List[float]:
    """Left edges of the scans' columns, and the right one of the last."""
    return [_WIDTH * k / len(times) for k in range(len(times) + 1)]


def _svg(content: str, times: Sequence[float], top: str) -> str:
    return (
        '<svg viewBox="0 0 %d %d" preserveAspectRatio="none" role="img" aria-label="%s">%s</svg>'
        "<p class=axis><span>0 s</span><span>%s</span><span>%.1f s</span></p>"
        % (_WIDTH, _HEIGHT, html.escape(top), content, html.escape(top), times[-1])
    )


def _bands(times: Sequence[float], shares: np.ndarray, colors: Sequence[str], top: str) -> str:
    edges, content = _x(times), []
    tops = np.cumsum(shares, axis=1)
    for row in range(len(times)):
        for status, color in enumerate(colors):
            height = shares[row, status] * _HEIGHT
            if height > 0.05:
                content.append(
                    '<rect x="%.2f" y="%.2f" width="%.2f" height="%.2f" fill="%s"/>'
                    % (
                        edges[row],
                        _HEIGHT * (1 - tops[row, status]),
                        edges[row + 1] - edges[row] + 0.2,
                        height,
                        color,
                    )
                )
    return _svg("".join(content), times, top)


def _bars(times: Sequence[float], counts: Sequence[int], missing: Sequence[int]) -> str:
    edges, most = _x(times), max(max(counts), 1)
    content = []
    for row, count in enumerate(counts):
        height = _HEIGHT * count / most
        content.append(
            '<rect x="%.2f" y="%.2f" width="%.2f" height="%.2f" fill="#33658a"/>'
            % (edges[row], _HEIGHT - height, max(edges[row + 1] - edges[row] - 0.4, 0.4), height)
        )
    for row in missing:
        content.append(
            '<rect x="%.2f" y="0" width="%.2f" height="%d" fill="%s" opacity="0.35"/>'
            % (edges[row], edges[row + 1] - edges[row], _HEIGHT, STATUS_COLORS[3])
        )
    return _svg("".join(content), times, "points, up to %d; shaded: no image" % most)


def settings(text: str) -> str:
    """The rig as it ran, folded."""
    version = text.split("\n", 1)[0].lstrip("# ") if text.startswith("#") else ""
    return (
        "<h2>Settings</h2><p>%s</p><details><summary>the resolved rig</summary><pre>%s</pre></details>"
        % (
            html.escape(version),
            html.escape(text),
        )
    )


# --- Points to look at


class Points(NamedTuple):
    """(N, 3) m, labels, confidence in 0..1, status."""

    name: str
    xyz: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    status: np.ndarray


def _points_of(cloud: SemanticCloud, name: str, positions: np.ndarray, chosen: Any) -> Points:
    confidence = cloud.optional("confidence")
    values = np.zeros(len(cloud)) if confidence is None else confidence
    return Points(
        name, positions[chosen], cloud.label[chosen], values[chosen], cloud.status[chosen]
    )


def scan_points(story: BagStory) -> Points:
    """The scan with most fused points."""
    with Clouds(story.path) as clouds:
        cloud = clouds[story.richest]
    step = -(-len(cloud) // MOST_POINTS)
    name = "scan %d" % story.richest
    return _points_of(cloud, name, xyz(cloud.points), slice(None, None, max(step, 1)))


def map_points(story: BagStory, fixed_frame: Optional[str] = None) -> Optional[Points]:
    """Fused points of scans laid over each other, one for each cell; None where tf does not tell.
    `fixed_frame`: default: that of the bag's own rig, else odom."""
    with BagReader(story.path) as bag:
        tree = TransformTree.from_bag(bag)
        if fixed_frame is None:
            rig = Rig.from_bag(bag)
            fixed_frame = rig.text("fixed_frame") if rig else "odom"
    step = max(1, len(story.scans) // 60)
    kept: List[Points] = []
    with Clouds(story.path) as clouds:
        for cloud in clouds[::step]:
            try:
                pose, valid = tree.lookup(fixed_frame, cloud.frame_id, np.array([cloud.stamp_ns]))
            except DataError:
                return None
            if valid[0]:
                positions = transform_points(pose[0], xyz(cloud.points))
                kept.append(_points_of(cloud, "map", positions, cloud.fused))
    if not kept:
        return None
    parts = [np.concatenate(values) for values in zip(*(points[1:] for points in kept))]
    positions = parts[0] - parts[0].mean(axis=0)
    cells = np.floor(positions / MAP_CELL_M).astype(np.int64)
    _, chosen = np.unique(cells, axis=0, return_index=True)
    if len(chosen) > MOST_POINTS:
        chosen = chosen[:: -(-len(chosen) // MOST_POINTS)]
    return Points("map of %d scans" % len(kept), positions[chosen], *(p[chosen] for p in parts[1:]))


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def viewer(sets: Sequence[Points], labels: LabelSet) -> str:
    """A view of points: drag to turn, wheel or pinch to zoom; coloured by class, probability or
    status."""
    data = []
    for points in sets:
        centred = np.clip(np.round(points.xyz * 100.0), -32768, 32767).astype("<i2")
        data.append(
            {
                "name": points.name,
                "xyz": _base64(centred),
                "label": _base64(points.label.astype(np.uint8)),
                "sure": _base64(np.round(np.clip(points.confidence, 0, 1) * 255).astype(np.uint8)),
                "status": _base64(points.status.astype(np.uint8)),
            }
        )
    colors = [list(info.color_rgb) for info in labels.classes]
    used = sorted({int(v) for points in sets for v in np.unique(points.label) if v != NO_LABEL})
    legends = {
        "class": _legend(
            [labels.names[i] for i in used] + ["no class"],
            ["rgb(%d,%d,%d)" % tuple(colors[i]) for i in used] + ["rgb(%d,%d,%d)" % _NO_CLASS],
        ),
        "probability": "<p class=legend><span><i class=ramp></i>0 to 1: how sure the class is</span></p>",
        "status": _legend(STATUS_NAMES, STATUS_COLORS),
    }
    content = json.dumps(
        {
            "sets": data,
            "colors": colors,
            "none": list(_NO_CLASS),
            "status": STATUS_COLORS,
            "legends": legends,
        }
    )
    return (
        "<h2>The points</h2><div id=view><div class=buttons></div><canvas></canvas>"
        "<div class=key></div></div><script>const DATA=%s;%s</script>"
        % (content.replace("</", "<\\/"), _SCRIPT)
    )


_SCRIPT = r"""
(function () {
  const view = document.getElementById('view'), canvas = view.querySelector('canvas');
  const context = canvas.getContext('2d'), key = view.querySelector('.key');
  const bytes = t => Uint8Array.from(atob(t), c => c.charCodeAt(0));
  const sets = DATA.sets.map(s => ({name: s.name, p: new Int16Array(bytes(s.xyz).buffer),
    label: bytes(s.label), sure: bytes(s.sure), status: bytes(s.status)}));
  const hex = t => [1, 3, 5].map(i => parseInt(t.substr(i, 2), 16));
  const status = DATA.status.map(hex);
  // From dark (unsure) to light (sure): viridis at five places.
  const ramp = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const sure = v => { const x = v / 255 * 4, i = Math.min(3, Math.floor(x)), f = x - i;
    return [0, 1, 2].map(c => ramp[i][c] + f * (ramp[i + 1][c] - ramp[i][c])); };
  let current = 0, mode = 'class', yaw = -2.2, pitch = 0.6, zoom = 1, pending = false;
  function color(s, i) {
    if (mode === 'status') return status[Math.min(s.status[i], 4)];
    if (s.label[i] === 255) return DATA.none;
    return mode === 'class' ? DATA.colors[s.label[i]] : sure(s.sure[i]);
  }
  function draw() {
    pending = false;
    const s = sets[current], n = s.label.length, w = canvas.width, h = canvas.height;
    const image = context.createImageData(w, h), depth = new Float32Array(w * h).fill(1e9);
    for (let i = 0; i < image.data.length; i += 4) {
      image.data[i] = 32; image.data[i + 1] = 36; image.data[i + 2] = 42; image.data[i + 3] = 255;
    }
    // Nine of ten points fit into the view.
    const far = [];
    for (let i = 0; i < n; i += 17) far.push(Math.hypot(s.p[3 * i], s.p[3 * i + 1]));
    far.sort((a, b) => a - b);
    const scale = zoom * 0.8 * Math.min(w, h) / Math.max(1, far[Math.floor(far.length * 0.9)] || 1);
    const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
    const size = Math.max(2, Math.round(w / 500));
    for (let i = 0; i < n; ++i) {
      const x = s.p[3 * i], y = s.p[3 * i + 1], z = s.p[3 * i + 2];
      const a = cy * x - sy * y, b = sy * x + cy * y;
      const u = Math.round(w / 2 + scale * 0.6 * a), v = Math.round(h / 2 - scale * 0.6 * (b * sp + z * cp));
      const d = b * cp - z * sp;
      if (u < 0 || v < 0 || u >= w - size || v >= h - size) continue;
      const c = color(s, i);
      for (let k = 0; k < size; ++k) for (let l = 0; l < size; ++l) {
        const at = (v + k) * w + u + l;
        if (d >= depth[at]) continue;
        depth[at] = d;
        image.data[4 * at] = c[0]; image.data[4 * at + 1] = c[1]; image.data[4 * at + 2] = c[2];
      }
    }
    context.putImageData(image, 0, 0);
    key.innerHTML = DATA.legends[mode];
  }
  function later() { if (!pending) { pending = true; requestAnimationFrame(draw); } }
  function resize() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    draw();
  }
  const buttons = view.querySelector('.buttons');
  function button(text, chosen, pressed) {
    const b = document.createElement('button');
    b.textContent = text; b.type = 'button';
    b.onclick = () => { pressed(); mark(); draw(); };
    b.dataset.chosen = chosen;
    buttons.appendChild(b);
  }
  function mark() {
    for (const b of buttons.children) {
      const chosen = b.dataset.chosen;
      b.className = chosen === mode || chosen === 'set' + current ? 'on' : '';
    }
  }
  sets.forEach((s, i) => { if (sets.length > 1) button(s.name, 'set' + i, () => { current = i; zoom = 1; }); });
  for (const m of ['class', 'probability', 'status']) button('by ' + m, m, () => { mode = m; });
  const fingers = new Map();
  canvas.onpointerdown = e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, e); };
  canvas.onpointerup = canvas.onpointercancel = e => fingers.delete(e.pointerId);
  canvas.onpointermove = e => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const others = [...fingers.values()].filter(o => o.pointerId !== e.pointerId);
    if (others.length) {
      const gap = p => Math.hypot(p.clientX - others[0].clientX, p.clientY - others[0].clientY);
      zoom = Math.min(40, Math.max(0.2, zoom * gap(e) / Math.max(1, gap(last))));
    } else {
      yaw -= (e.clientX - last.clientX) * 0.008;
      pitch = Math.min(1.57, Math.max(-0.2, pitch + (e.clientY - last.clientY) * 0.008));
    }
    fingers.set(e.pointerId, e);
    later();
  };
  canvas.onwheel = e => { e.preventDefault(); zoom = Math.min(40, Math.max(0.2, zoom * Math.exp(-e.deltaY * 0.001))); later(); };
  window.onresize = resize;
  mark(); resize();
})();
"""

_STYLE = """
:root{font-family:system-ui,sans-serif;line-height:1.45;color:#1d232a;background:#fff}
body{max-width:1100px;margin:0 auto;padding:1rem}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2rem;border-bottom:1px solid #d5dbe1}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem;margin:.6rem 0}
th,td{padding:.2rem .6rem;text-align:right;border-bottom:1px solid #e3e8ec;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
thead th{border-bottom:2px solid #8a96a3;white-space:normal;vertical-align:bottom}
figure{margin:1rem 0}img{max-width:100%;height:auto}figcaption,.note,.axis{font-size:.8rem;color:#4c5864}
svg{width:100%;height:90px;display:block;background:#f3f5f7}
.axis{display:flex;justify-content:space-between;margin:.1rem 0 .8rem}.note{margin:.2rem 0}
.legend{display:flex;flex-wrap:wrap;gap:.2rem 1rem;font-size:.8rem;margin:.4rem 0}
.legend i{display:inline-block;width:.8rem;height:.8rem;margin-right:.35rem;vertical-align:-.1rem;border:1px solid #0002}
.legend i.ramp{width:8rem;background:linear-gradient(90deg,#440154,#3b528b,#21918c,#5ec962,#fde725)}
#view canvas{width:100%;height:min(60vh,560px);touch-action:none;border:1px solid #d5dbe1;cursor:grab}
.buttons{display:flex;flex-wrap:wrap;gap:.4rem;margin:.4rem 0}
button{font:inherit;font-size:.85rem;padding:.25rem .7rem;border:1px solid #8a96a3;background:#fff;border-radius:.3rem}
button.on{background:#33658a;color:#fff;border-color:#33658a}
pre{overflow-x:auto;font-size:.75rem;background:#f3f5f7;padding:.6rem}code{background:#f3f5f7}
"""


def bag_parts(
    path: str, fixed_frame: Optional[str] = None, known: Optional[LabelSet] = None
) -> List[str]:
    """All that a fused bag tells by itself."""
    story = read_story(path, known)
    sets = [scan_points(story)]
    laid = map_points(story, fixed_frame)
    if laid is not None:
        sets.append(laid)
    return [
        overview(story),
        viewer(sets, story.labels),
        timeline(story),
        settings(story.configuration),
    ]


def page(title: str, parts: Sequence[str]) -> str:
    """The file's text."""
    return (
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8>"
        '<meta name=viewport content="width=device-width,initial-scale=1">'
        "<meta http-equiv=Content-Security-Policy content=\"default-src 'none'; img-src data:; "
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
        "<title>%s</title><style>%s</style></head><body>\n%s\n</body></html>\n"
        % (html.escape(title), _STYLE, "\n".join(parts))
    )
