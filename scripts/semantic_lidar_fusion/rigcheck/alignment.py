# SPDX-License-Identifier: MIT
"""Lidar edges against image edges: is a camera where and when the rig says?

Edges of the lidar are depth steps within a ring; edges of an image are those of Canny. Where the
extrinsics, the lens and the times are right, the one lie on the other. The score of a hypothesis is
the mean of exp(-d / 3 px) at the projected lidar edges (d: distance to the nearest image edge at
640 px width), compared with what its surroundings give by chance:

    lift = (mean value at the edges - mean value around them) / (1 - mean value around them)

0 = no better than chance, 1 = every lidar edge lies on an image edge. A right rig reaches 0.3 to 0.5
on streets.
"""

import dataclasses
from typing import Callable, List, Optional, Sequence, Tuple

import numpy as np

# A step of depth that is an edge, m and share of the range; edges beyond MAX_RANGE_M are blunt.
MIN_STEP_M, MIN_STEP_RATIO, MAX_RANGE_M, FULL_WEIGHT_STEP_M = 0.5, 0.1, 40.0, 5.0
IMAGE_WIDTH = 640
FALL_OFF_PX = 3.0
CANNY = (30, 90)
CHANCE_WINDOW_PX = 61
MAX_EDGES = 9000  # of one camera: more change nothing but the time

PITCH, YAW, ROLL, TIME, HEIGHT = range(5)
AXES = ("pitch", "yaw", "roll", "time")
# How far is searched, and the step of comparable effect: rad, rad, rad, s, m.
SEARCH = np.array([np.radians(2.0), np.radians(2.0), np.radians(2.0), 0.05])
STEP = np.array([np.radians(0.3), np.radians(0.3), np.radians(0.6), 0.006, 0.01])
# A camera that stands a few centimetres higher looks like one that is pitched, the more the nearer
# the edges are. A target at 2 m cannot tell them apart, so that good calibrations are wrong in both:
# the search lets the height go by this much, and reports the pitch.
MAX_HEIGHT_M = 0.02
# Offsets whose lift is within this share of the best, or within what it scatters by chance, are as
# good: half their span belongs to the half-width, and of pitch, which is flat, their middle is
# reported. The values of single edges scatter by EDGE_SCATTER.
AS_GOOD, EDGE_SCATTER = 0.03, 0.35
# The stretch is walked in so many steps to a probe away; it goes on beyond so many steps of less.
STRETCH_STEPS, STRETCH_GAP = 16, 3
GRID = (33, 33, 17, 33)
# Yaw and time of a camera that looks sideways nearly make up for each other: places of this many steps
# of both together are tried as further starts.
VALLEY_GRID = 17
# Where edges hardly meet, there are hills everywhere: the one that the rig stands on, where a search
# ends that begins with this part of its width, is believed unless another is higher by this factor.
# Within SAME_HILL the higher place is.
NEAR_PART, CLEARLY_HIGHER = 4, 1.15
SAME_HILL = 1.5 * SEARCH / NEAR_PART
FAR_TIME_S = 0.3

MIN_LIFT = 0.12  # below, edges and image do not belong together, whatever the offset
MIN_EDGES = 300
# Grass and leaves put an edge everywhere: beyond this chance, edges that do not meet prove nothing.
MAX_CHANCE = 0.5
# Loss of lift, as a share, one probe away from the best place: less, and the axis is not observable.
PROBE = np.array([np.radians(1.0), np.radians(1.0), np.radians(1.5), 0.02])
MIN_CONTRAST = np.array([0.2, 0.2, 0.1, 0.15])
# An offset farther than this many probes is observable whatever its contrast, if the rig's own value
# loses this share of the lift: the place of the best may be flat, the rig's is refuted.
FAR_PROBES, REFUTED = 2.0, 0.3
# What the method itself leaves open on data of known truth, in deg and s.
FLOOR = np.array([np.radians(0.1), np.radians(0.06), np.radians(0.15), 0.0007])

# A rolling shutter: how far is searched, s, and what is needed to see it.
MAX_READOUT_S, READOUT_STEPS, READOUT_PROBE_S = 0.06, 20, 0.03
READOUT_FLOOR_S, MIN_READOUT_CONTRAST = 0.003, 0.05

Projection = Callable[[np.ndarray], Tuple[np.ndarray, np.ndarray]]


def lidar_edges(points: np.ndarray) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of one scan (structured array with x, y, z, ring): positions (E, 3), the index of the
    return each belongs to (E,), weights (E,).

    An edge lies between two neighbouring beams: the nearer return turned half a step towards the
    farther one, which takes away the bias of a silhouette that ends between two beams.
    """
    p = np.stack([points["x"], points["y"], points["z"]], axis=1).astype(float)
    distance = np.linalg.norm(p, axis=1)
    azimuth = np.arctan2(p[:, 1], p[:, 0])
    usable = np.isfinite(distance) & (distance > 0.5)
    found: List[Tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for ring in np.unique(points["ring"][usable]):
        k = np.flatnonzero((points["ring"] == ring) & usable)
        if len(k) < 10:
            continue
        k = k[np.argsort(azimuth[k], kind="stable")]
        gap = np.diff(azimuth[k])
        step = np.median(gap)
        first, second = distance[k][:-1], distance[k][1:]
        near, jump = np.minimum(first, second), np.abs(second - first)
        edge = (jump > np.maximum(MIN_STEP_M, MIN_STEP_RATIO * near)) & (near < MAX_RANGE_M)
        edge &= (gap > 0) & (gap < 3 * step)
        index = np.where(first < second, k[:-1], k[1:])[edge]
        turn = np.where(first < second, 0.5, -0.5)[edge] * np.minimum(gap[edge], 1.5 * step)
        c, s, q = np.cos(turn), np.sin(turn), p[index]
        turned = np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1], q[:, 2]], axis=1)
        found.append((turned, index, np.sqrt(np.minimum(jump[edge], FULL_WEIGHT_STEP_M))))
    if not found:
        return np.zeros((0, 3)), np.zeros(0, dtype=int), np.zeros(0)
    return tuple(np.concatenate(part) for part in zip(*found))  # type: ignore[return-value]


@dataclasses.dataclass
class ImageEdges:
    """How near each pixel of a reduced image lies to an edge.

    value (H, W): exp(-d / FALL_OFF_PX); chance (H, W): its mean around; scale: reduced pixels per
    pixel.
    """

    value: np.ndarray
    chance: np.ndarray
    scale: float


def image_edges(image: np.ndarray) -> ImageEdges:
    """Of an 8-bit image (grey or BGR)."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if grey.shape[1] > IMAGE_WIDTH:
        height = max(1, round(grey.shape[0] * IMAGE_WIDTH / grey.shape[1]))
        grey = cv2.resize(grey, (IMAGE_WIDTH, height), interpolation=cv2.INTER_AREA)
    scale = grey.shape[1] / image.shape[1]
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.0), *CANNY)
    if not edges.any():
        value = np.zeros(grey.shape, dtype=np.float32)
    else:
        distance = cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5)
        value = np.exp(-distance / FALL_OFF_PX).astype(np.float32)
    return ImageEdges(value, cv2.blur(value, (CHANCE_WINDOW_PX, CHANCE_WINDOW_PX)), scale)


@dataclasses.dataclass
class View:
    """The edges of one scan for one image.

    points (E, 3): edges in the vehicle's frame at the image's time, m; weights (E,); velocity,
    rate (3,): the vehicle's twist in its own frame then, m/s and rad/s; image: what they should
    meet.
    """

    points: np.ndarray
    weights: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray
    image: ImageEdges


def thinned(views: Sequence[View], most: int = MAX_EDGES) -> List[View]:
    """The views with every n-th edge, `most` in all."""
    total = sum(len(view.weights) for view in views)
    step = max(1, -(-total // most))
    return [
        dataclasses.replace(view, points=view.points[::step], weights=view.weights[::step])
        for view in views
    ]


@dataclasses.dataclass(frozen=True)
class Score:
    """lift: see above; inside: weight of the edges within the image over the weight of all; chance:
    the mean value around them."""

    lift: float
    inside: float
    edges: int
    chance: float = 1.0


def rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation vector, rad."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()


class Stack:
    """Views of one camera, ready to be scored many times: all edges in one array."""

    def __init__(self, views: Sequence[View]):
        """The images of `views` have one size."""
        self.points = np.concatenate([view.points for view in views])
        self.weights = np.concatenate([view.weights for view in views])
        counts = [len(view.weights) for view in views]
        self.view = np.repeat(np.arange(len(views)), counts)
        velocity = np.repeat([view.velocity for view in views], counts, axis=0)
        rate = np.repeat([view.rate for view in views], counts, axis=0)
        # How fast an edge passes in the vehicle's frame, m/s.
        self.passing = -(velocity + np.cross(rate, self.points))
        self.value = np.stack([view.image.value for view in views])
        self.chance = np.stack([view.image.chance for view in views])
        self.scale = views[0].image.scale

    def _project(
        self, project: Projection, T_camera_vehicle: np.ndarray, x: np.ndarray
    ) -> Tuple[np.ndarray, np.ndarray]:
        turn = rotation(x[:3]) @ T_camera_vehicle[:3, :3]
        shift = rotation(x[:3]) @ T_camera_vehicle[:3, 3]
        if len(x) > HEIGHT:
            shift = shift + (0.0, x[HEIGHT], 0.0)
        points = self.points + x[TIME] * self.passing if x[TIME] else self.points
        return project(points @ turn.T + shift)

    def pixels(
        self, project: Projection, T_camera_vehicle: np.ndarray, offset: np.ndarray
    ) -> np.ndarray:
        """(M, 2) of the edges within the image; `offset` as in `score`."""
        pixels, valid = self._project(project, T_camera_vehicle, offset)
        return pixels[valid]

    def row_score(
        self,
        project: Projection,
        T_camera_vehicle: np.ndarray,
        x: np.ndarray,
        readout_s: float,
        by_columns: bool,
    ) -> float:
        """The lift with rows (columns) taken one after the other, the middle one at the stamp."""
        pixels, valid = self._project(project, T_camera_vehicle, x)
        axis = 0 if by_columns else 1
        size = self.value.shape[2 - axis]
        share = np.where(valid, (pixels[:, axis] + 0.5) * self.scale / size - 0.5, 0.0)
        moved = self.points
        self.points = moved + (readout_s * share)[:, None] * self.passing
        try:
            return self.score(project, T_camera_vehicle, x).lift
        finally:
            self.points = moved

    def score(
        self, project: Projection, T_camera_vehicle: np.ndarray, offset: Optional[np.ndarray] = None
    ) -> Score:
        """Of extrinsics and times that are `offset` (4,) or (5,) off: rotation of the camera about its
        own x (pitch), y (yaw), z (roll), rad, applied after T_camera_vehicle; seconds that images are
        later than stamped; metres that the camera stands higher (its y points down)."""
        x = np.zeros(4) if offset is None else offset
        pixels, valid = self._project(project, T_camera_vehicle, x)
        w, view = self.weights[valid], self.view[valid]
        u = np.floor((pixels[valid] + 0.5) * self.scale).astype(int)
        row = np.clip(u[:, 1], 0, self.value.shape[1] - 1)
        column = np.clip(u[:, 0], 0, self.value.shape[2] - 1)
        weight = float(w.sum())
        hit = float(w @ self.value[view, row, column])
        chance = float(w @ self.chance[view, row, column])
        if weight <= 0 or weight - chance <= 1e-9 * weight:
            return Score(0.0, 0.0, len(w))
        inside = weight / max(float(self.weights.sum()), 1e-9)
        return Score((hit - chance) / (weight - chance), inside, len(w), chance / weight)


@dataclasses.dataclass(frozen=True)
class Alignment:
    """The best offset of one camera.

    offset, half_width (4,): pitch, yaw, roll (rad) and time (s), the correction to apply to the
    rig; contrast (4,): loss of lift one PROBE away; observable (4,) bool; now, best: scores of the
    rig as it is and with the offset and `height_m`, which is not known to be so.
    """

    offset: np.ndarray
    half_width: np.ndarray
    contrast: np.ndarray
    observable: np.ndarray
    now: Score
    best: Score
    height_m: float = 0.0


def fit(
    views: Sequence[View], project: Projection, T_camera_vehicle: np.ndarray, moving: bool
) -> Alignment:
    """Searches pitch, yaw, roll and (if the vehicle moves) time jointly."""
    views = thinned(views)
    whole = Stack(views)
    free = [PITCH, YAW, ROLL] + ([TIME] if moving else [])

    def lift_of(stack: Stack) -> Callable[[np.ndarray], float]:
        return lambda x: stack.score(project, T_camera_vehicle, x).lift

    lift = lift_of(whole)

    x = np.append(_coarse(lift, free), 0.0)
    free.append(HEIGHT)
    x = _refined(lift, x, free)
    best = lift(x)
    parts = [Stack(part) for part in (views[0::2], views[1::2]) if part]
    halves = [_refined(lift_of(part), x, free) for part in parts]
    spread = np.abs(halves[0] - halves[1])[:4] / 2 if len(halves) == 2 else np.full(4, np.inf)
    after = whole.score(project, T_camera_vehicle, x)
    tolerance = max(AS_GOOD * best, EDGE_SCATTER / np.sqrt(max(after.edges, 1)))
    contrast, refuted = np.zeros(4), np.zeros(4, dtype=bool)
    middle, span = x[:4].copy(), np.zeros(4)
    for axis in free[:-1]:
        away = [lift(_moved(x, axis, sign * PROBE[axis])) for sign in (-1.0, 1.0)]
        contrast[axis] = (best - max(away)) / max(best, 1e-9)
        far = abs(x[axis]) > FAR_PROBES * PROBE[axis]
        refuted[axis] = far and lift(_moved(x, axis, -x[axis])) < (1.0 - REFUTED) * best
        good, span[axis] = _as_good(lift, x, axis, best - tolerance)
        if axis == PITCH:  # the valley of pitch and height is long and flat
            middle[axis] = good
    now = whole.score(project, T_camera_vehicle)
    enough = after.edges >= MIN_EDGES and best >= MIN_LIFT
    half_width = np.sqrt(FLOOR**2 + (1.5 * spread) ** 2 + span**2)
    observable = ((contrast >= MIN_CONTRAST) | refuted) & enough & np.isfinite(half_width)
    return Alignment(middle, half_width, contrast, observable, now, after, float(x[HEIGHT]))


def _moved(x: np.ndarray, axis: int, by: float) -> np.ndarray:
    y = x.copy()
    y[axis] += by
    return y


def _as_good(
    lift: Callable[[np.ndarray], float], x: np.ndarray, axis: int, least: float
) -> Tuple[float, float]:
    """The middle and half the length of the stretch around x on which the lift, with the best height
    and roll for each pitch, is at least `least`."""
    ways = [(0.0, float(x[HEIGHT]))]  # roll by, height
    if axis == PITCH:
        heights = np.linspace(-MAX_HEIGHT_M, MAX_HEIGHT_M, 5)
        ways = [(by * STEP[ROLL], float(h)) for by in (0.0, -0.5, 0.5) for h in heights]

    def is_good(by: float) -> bool:
        for roll_by, height in ways:
            y = _moved(_moved(x, axis, by), ROLL, roll_by)
            y[HEIGHT] = height
            if lift(y) >= least:
                return True
        return False

    ends = []
    for sign in (-1.0, 1.0):
        last = 0
        for k in range(1, STRETCH_STEPS + 1):
            if k - last > STRETCH_GAP:
                break
            if is_good(sign * k * PROBE[axis] / STRETCH_STEPS):
                last = k
        ends.append(sign * last * PROBE[axis] / STRETCH_STEPS)
    return x[axis] + (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2


@dataclasses.dataclass(frozen=True)
class Readout:
    """How much later the last row (column) is taken than the first: value_s, negative if it is taken
    first, with half_width_s; contrast: loss of lift READOUT_PROBE_S away."""

    value_s: float
    half_width_s: float
    contrast: float
    observable: bool


def readout(
    views: Sequence[View],
    project: Projection,
    T_camera_vehicle: np.ndarray,
    found: Alignment,
    by_columns: bool = False,
) -> Readout:
    """Whether the offset in time that remains at an edge depends on its row (column): each edge is
    moved by the time of its row before or after the middle one's, at the offset already found."""
    stack = Stack(thinned(views))
    x = np.append(found.offset, found.height_m)
    tries = np.linspace(-MAX_READOUT_S, MAX_READOUT_S, 2 * READOUT_STEPS + 1)
    lifts = np.array([stack.row_score(project, T_camera_vehicle, x, t, by_columns) for t in tries])
    best = int(np.argmax(lifts))
    good = lifts >= (1.0 - AS_GOOD) * lifts[best]
    first = last = best
    while first > 0 and good[first - 1]:
        first -= 1
    while last < len(tries) - 1 and good[last + 1]:
        last += 1
    step = tries[1] - tries[0]
    probe = int(round(READOUT_PROBE_S / step))
    away = lifts[[max(0, best - probe), min(len(tries) - 1, best + probe)]]
    contrast = float((lifts[best] - away.max()) / max(lifts[best], 1e-9))
    half = float(np.hypot(READOUT_FLOOR_S, (tries[last] - tries[first]) / 2 + step / 2))
    seen = bool(
        found.observable[TIME]
        and contrast >= MIN_READOUT_CONTRAST
        and READOUT_PROBE_S < MAX_READOUT_S - abs(tries[best])
    )
    return Readout(float((tries[first] + tries[last]) / 2), half, contrast, seen)


def _coarse(lift: Callable[[np.ndarray], float], free: Sequence[int]) -> np.ndarray:
    """The hill that the rig stands on, unless another one is clearly higher."""
    near = _descend(lift, np.zeros(4), free, first_part=NEAR_PART)
    found = _descend(lift, np.zeros(4), free)
    if TIME in free:
        times = np.linspace(-FAR_TIME_S, FAR_TIME_S, 61)
        lifts = [lift(np.array([0.0, 0.0, 0.0, t])) for t in times]
        far = times[int(np.argmax(lifts))]
        if abs(far) > SEARCH[TIME]:
            start = np.array([0.0, 0.0, 0.0, far])
            found = max((found, _descend(lift, start, free)), key=lift)
        found = max((found, _descend(lift, _other_pair(lift, found), free, 2, 3)), key=lift)
    beside = bool((np.abs(found - near) <= SAME_HILL).all())
    return found if lift(found) > (1.0 if beside else CLEARLY_HIGHER) * lift(near) else near


def _other_pair(lift: Callable[[np.ndarray], float], x: np.ndarray) -> np.ndarray:
    """The best place of another yaw and time than those of `x`."""
    best, start = -np.inf, x
    for yaw in np.linspace(-1.0, 1.0, VALLEY_GRID) * SEARCH[YAW]:
        for later in np.linspace(-1.0, 1.0, VALLEY_GRID) * SEARCH[TIME]:
            far = abs(yaw - x[YAW]) > STEP[YAW] or abs(later - x[TIME]) > STEP[TIME]
            y = x.copy()
            y[[YAW, TIME]] = yaw, later
            value = lift(y)
            if far and value > best:
                best, start = value, y
    return start


def _descend(
    lift: Callable[[np.ndarray], float],
    start: np.ndarray,
    free: Sequence[int],
    turns: int = 3,
    first_part: int = 1,
) -> np.ndarray:
    """Axis by axis; the first of `turns` goes over SEARCH / `first_part`, the others over a third."""
    x, best = start.copy(), lift(start)
    for turn in range(turns):
        before = x.copy()
        for axis in free:
            reach = SEARCH[axis] / (first_part if turn == 0 else 3)
            for value in x[axis] + np.linspace(-reach, reach, GRID[axis]):
                y = x.copy()
                y[axis] = value
                found = lift(y)
                if found > best:
                    best, x = found, y
        if (np.abs(x - before) < STEP[: len(x)] / 4).all():
            break
    return x


def _refined(
    lift: Callable[[np.ndarray], float], start: np.ndarray, free: Sequence[int]
) -> np.ndarray:
    """Jointly, with the simplex method, in units of STEP; the height stays within its bounds."""
    from scipy.optimize import minimize

    def place(z: np.ndarray) -> np.ndarray:
        x = start.copy()
        x[list(free)] += z * STEP[list(free)]
        if len(x) > HEIGHT:
            x[HEIGHT] = np.clip(x[HEIGHT], -MAX_HEIGHT_M, MAX_HEIGHT_M)
        return x

    simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))])
    found = minimize(
        lambda z: -lift(place(z)),
        np.zeros(len(free)),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 150, "xatol": 0.02, "fatol": 1e-5},
    )
    return place(found.x)
