"""SVGF in plain Python loops and float64: the yardstick that the library is held against.

Written from the specification alone: it shares no line with the library and never imports it. A stage is one loop over
pixels with one loop over taps inside, in the order of the specification, to be checked against the paper by eye.

Data are plain dicts of NumPy arrays:

frame:   radiance [S, H, W, 3], albedo [S or 1, H, W, 3], emission [H, W, 3], normal [H, W, 3], depth [H, W],
         prev_depth [H, W], motion [H, W, 2] (pixels, previous minus current), object_id [H, W] (-1: no surface)
history: illumination [S, H, W, 3], moments [S, H, W, 2], history_length [H, W], depth, normal, object_id
output:  image [H, W, 3], illumination [S, H, W, 3], variance [S, H, W], variance_filtered [S, H, W],
         history_length [H, W], valid [H, W] (reprojection found history), rejected (dict of counts)
params:  the names of `PAPER`; each a number or a list with one number per a-trous level
config:  levels, feedback_level; where not the paper's: variance, prefilter, reprojection, fallback, id_test, warm_up, clamp_radius
"""

from math import exp, floor, isfinite, sqrt

import numpy as np

PAPER = {
    "alpha": 0.2,
    "alpha_moments": 0.2,
    "sigma_depth": 1.0,
    "sigma_normal": 128.0,
    "sigma_luminance": 4.0,
    "short_history_boost": 1.0,
    "max_history": 32.0,
    "albedo_floor": 1e-3,
    "depth_epsilon": 1e-3,
    "luminance_epsilon": 1e-6,
    "reproject_depth": 0.1,
    "reproject_normal": 0.9,
    "kernel_near": 2 / 3,  # (1/4) / (3/8)
    "kernel_far": 1 / 6,  # (1/16) / (3/8)
    "clamp_sigma": 1.0,
}
FALCOR = PAPER | {"alpha": 0.05, "sigma_luminance": 10.0, "short_history_boost": 4.0}
PAPER_CONFIG = {"levels": 5, "feedback_level": 0}
FALCOR_CONFIG = {"levels": 4, "feedback_level": 1}


def at_level(value, level):
    """A parameter is one number, or a list with one number per level."""
    return float(np.asarray(value).reshape(-1)[level if np.size(value) > 1 else 0])


def first(params, name):
    """What a stage outside the a-trous filter uses of a parameter: entry 0."""
    return at_level(params[name], 0)


def luminance(rgb):
    return 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def all_finite(values):
    return all(isfinite(v) for v in values)


def empty_history(frame):
    signals, height, width, _ = frame["radiance"].shape
    return {
        "illumination": np.zeros((signals, height, width, 3)),
        "moments": np.zeros((signals, height, width, 2)),
        "history_length": np.zeros((height, width)),
        "depth": np.zeros((height, width)),
        "normal": np.zeros((height, width, 3)),
        "object_id": np.full((height, width), -1),
    }


# Step 1


def sanitise(frame):
    """The frame without NaN and Inf, the pixels whose motion is usable, and how many pixels were repaired."""
    frame = {name: np.array(value, dtype=int if name == "object_id" else float) for name, value in frame.items()}
    signals, height, width, _ = frame["radiance"].shape
    usable_motion = np.zeros((height, width), dtype=bool)
    rejected = dict.fromkeys(("radiance", "negative", "emission", "surface", "motion", "normal", "bright"), 0)
    for y in range(height):
        for x in range(width):
            radiance = frame["radiance"][:, y, x].reshape(-1).tolist()
            rejected["radiance"] += not all_finite(radiance)
            rejected["negative"] += any(isfinite(v) and v < 0 for v in radiance)
            rejected["bright"] += any(isfinite(v) and v > 2.0**40 for v in radiance)
            repaired = [min(v, 2.0**40) if isfinite(v) and v > 0 else 0.0 for v in radiance]
            frame["radiance"][:, y, x] = np.reshape(repaired, (signals, 3))

            emission = frame["emission"][y, x].tolist()
            rejected["emission"] += not all_finite(emission)
            frame["emission"][y, x] = [v if isfinite(v) else 0.0 for v in emission]

            guides = [*frame["normal"][y, x], frame["depth"][y, x], *frame["albedo"][:, y, x].reshape(-1)]
            if frame["object_id"][y, x] != -1 and not all_finite(guides):
                frame["object_id"][y, x] = -1
                rejected["surface"] += 1
            usable_motion[y, x] = all_finite([*frame["motion"][y, x], frame["prev_depth"][y, x]])
            if frame["object_id"][y, x] != -1 and not usable_motion[y, x]:
                rejected["motion"] += 1
    return frame, usable_motion, rejected


# Step 2


def demodulate(radiance, albedo, albedo_floor):
    """I = radiance / max(albedo, floor); an albedo for every signal or one for all."""
    return radiance / np.maximum(albedo, albedo_floor)


# Step 3


def reproject_taps(frame, usable_motion, history, params, config=PAPER_CONFIG):
    """For every pixel the list of (y, x, weight) in the previous frame that it continues, weights summing to 1."""
    height, width = frame["depth"].shape
    object_id, prev_id = frame["object_id"].tolist(), history["object_id"].tolist()
    normal, prev_normal = frame["normal"].tolist(), np.asarray(history["normal"], float).tolist()
    expected_z, prev_z = frame["prev_depth"].tolist(), np.asarray(history["depth"], float).tolist()
    motion = frame["motion"].tolist()
    tolerance, least_cosine = first(params, "reproject_depth"), first(params, "reproject_normal")

    def consistent(y, x, qy, qx):
        return (
            0 <= qy < height
            and 0 <= qx < width
            and -1 not in (prev_id[qy][qx], object_id[y][x])
            and (prev_id[qy][qx] == object_id[y][x] or not config.get("id_test", True))
            and abs(prev_z[qy][qx] - expected_z[y][x]) <= tolerance * max(expected_z[y][x], 1e-6)
            and dot(normal[y][x], prev_normal[qy][qx]) >= least_cosine
        )

    taps = [[[] for _ in range(width)] for _ in range(height)]
    for y in range(height):
        for x in range(width):
            if object_id[y][x] == -1 or not usable_motion[y, x]:
                continue
            py, px = y + motion[y][x][1], x + motion[y][x][0]
            by, bx = floor(py), floor(px)
            fy, fx = py - by, px - bx
            cy, cx = floor(py + 0.5), floor(px + 0.5)
            found = [
                (by + j, bx + i, (fy if j else 1 - fy) * (fx if i else 1 - fx))
                for j in (0, 1)
                for i in (0, 1)
                if consistent(y, x, by + j, bx + i)
            ]
            if config.get("reprojection") == "nearest":
                found = [(cy, cx, 1.0)] * consistent(y, x, cy, cx)
            if sum(weight for _, _, weight in found) < 0.01:
                found = config.get("fallback", True) * [
                    (cy + j, cx + i, 1.0) for j in (-1, 0, 1) for i in (-1, 0, 1) if consistent(y, x, cy + j, cx + i)
                ]
            total = sum(weight for _, _, weight in found)
            taps[y][x] = [(qy, qx, weight / total) for qy, qx, weight in found]
    return taps


def gather(taps, values):
    """The weighted mean of `values` [H, W, ...] over each pixel's taps; 0 without taps."""
    values = np.asarray(values, float)
    out = np.zeros_like(values)
    for y, row in enumerate(taps):
        for x, pixel_taps in enumerate(row):
            for qy, qx, weight in pixel_taps:
                out[y, x] += weight * values[qy, qx]
    return out


# Step 4


def clamped(old, color, surface, y, x, params, config):
    """`old` [3] within mean +- clamp_sigma population standard deviations of the window around (y, x) of `color`."""
    (height, width, _), r = color.shape, config.get("clamp_radius", 0)
    if r == 0:
        return old
    rows, columns = range(max(y - r, 0), min(y + r + 1, height)), range(max(x - r, 0), min(x + r + 1, width))
    window = np.array([color[qy, qx] for qy in rows for qx in columns if surface[qy][qx]])
    mean, reach = window.mean(axis=0), first(params, "clamp_sigma") * window.std(axis=0)
    return np.clip(old, mean - reach, mean + reach)


def accumulate(illumination, taps, history, surface, params, config=PAPER_CONFIG):
    """Accumulated illumination [S, H, W, 3], moments [S, H, W, 2], history length [H, W], valid [H, W]."""
    signals, height, width, _ = illumination.shape
    prev_length = gather(taps, history["history_length"])
    prev_illumination = [gather(taps, history["illumination"][s]) for s in range(signals)]
    prev_moments = [gather(taps, history["moments"][s]) for s in range(signals)]
    accumulated, moments = np.zeros_like(illumination), np.zeros((signals, height, width, 2))
    length, valid = np.zeros((height, width)), np.zeros((height, width), dtype=bool)
    for y in range(height):
        for x in range(width):
            if not surface[y][x]:
                continue
            valid[y, x] = bool(taps[y][x])
            h, a, a_m = 1.0, 1.0, 1.0
            if valid[y, x]:
                h = min(prev_length[y, x] + 1, first(params, "max_history"))
                least = 1 / h if config.get("warm_up", True) else 0.0
                a = max(first(params, "alpha"), least)
                a_m = max(first(params, "alpha_moments"), least)
            length[y, x] = h
            for s in range(signals):
                old = clamped(prev_illumination[s][y, x], illumination[s], surface, y, x, params, config)
                accumulated[s, y, x] = (1 - a) * old + a * illumination[s, y, x]
                l = luminance(illumination[s, y, x])
                moments[s, y, x] = (1 - a_m) * prev_moments[s][y, x] + a_m * np.array([l, l * l])
    return accumulated, moments, length, valid


# The edge-stopping weights of steps 5 and 6


def depth_gradient(depth, object_id):
    """grad z [H, W] of (d/dx, d/dy): per axis the smaller of the one-sided differences within the object."""
    height, width = len(depth), len(depth[0])

    def one_axis(y, x, dy, dx):
        differences = []
        for sign in (-1, 1):
            qy, qx = y + sign * dy, x + sign * dx
            if 0 <= qy < height and 0 <= qx < width and object_id[qy][qx] == object_id[y][x]:
                differences.append(sign * (depth[qy][qx] - depth[y][x]))
        if not differences:
            return 0.0
        if len(differences) == 2 and abs(differences[0]) == abs(differences[1]):
            return 0.5 * (differences[0] + differences[1])
        return min(differences, key=abs)

    return [
        [(one_axis(y, x, 0, 1), one_axis(y, x, 1, 0)) if object_id[y][x] != -1 else (0.0, 0.0) for x in range(width)]
        for y in range(height)
    ]


def depth_weight(z_p, z_q, gradient, dx, dy, sigma_depth, depth_epsilon):
    """w_z for the offset (dx, dy) in pixels."""
    difference = abs(z_p - z_q)
    tolerance = sigma_depth * abs(gradient[0] * dx + gradient[1] * dy) + depth_epsilon * z_p
    if tolerance == 0:
        return 1.0 if difference == 0 else 0.0
    return exp(-difference / tolerance)


def normal_weight(n_p, n_q, sigma_normal):
    return max(0.0, dot(n_p, n_q)) ** sigma_normal


# Step 5


def estimate_variance(moments, length, depth, normal, surface, gradient, params, estimator="svgf"):
    """Luminance variance [S, H, W]: of the past where it is long enough, else of the 7x7 neighbourhood.

    Estimator "spatial": of the neighbourhood however long; "temporal": of the past, a constant where there is none.
    """
    signals, height, width, _ = moments.shape
    variance = np.zeros((signals, height, width))
    first_moment, second_moment = moments[..., 0].tolist(), moments[..., 1].tolist()
    sigma_depth, depth_epsilon = first(params, "sigma_depth"), first(params, "depth_epsilon")
    sigma_normal, boost = first(params, "sigma_normal"), first(params, "short_history_boost")
    for y in range(height):
        for x in range(width):
            if not surface[y][x]:
                continue
            past = [max(0.0, second_moment[s][y][x] - first_moment[s][y][x] ** 2) for s in range(signals)]
            if estimator == "temporal":
                new = length[y, x] < 1 + 1e-3
                initial, scale = first(params, "initial_variance"), first(params, "variance_scale")
                variance[:, y, x] = [initial if new else scale * v for v in past]
                continue
            if length[y, x] >= 4 - 1e-3 and estimator == "svgf":
                variance[:, y, x] = past
                continue
            sum_w, sum_1, sum_2 = 0.0, [0.0] * signals, [0.0] * signals
            for qy in range(max(y - 3, 0), min(y + 4, height)):
                for qx in range(max(x - 3, 0), min(x + 4, width)):
                    if not surface[qy][qx]:
                        continue
                    w = depth_weight(
                        depth[y][x], depth[qy][qx], gradient[y][x], qx - x, qy - y, sigma_depth, depth_epsilon
                    ) * normal_weight(normal[y][x], normal[qy][qx], sigma_normal)
                    sum_w += w
                    for s in range(signals):
                        sum_1[s] += w * first_moment[s][qy][qx]
                        sum_2[s] += w * second_moment[s][qy][qx]
            for s in range(signals):
                if sum_w > 0:
                    spatial = max(0.0, sum_2[s] / sum_w - (sum_1[s] / sum_w) ** 2)
                    variance[s, y, x] = spatial * max(1.0, boost / length[y, x])
    return variance


# Step 6


def blur_variance(variance, surface):
    """g(V) [H, W]: 3x3 Gaussian over the taps that count, its weights renormalised."""
    height, width = len(variance), len(variance[0])
    out = [[0.0] * width for _ in range(height)]
    for y in range(height):
        for x in range(width):
            if not surface[y][x]:
                continue
            total, weights = 0.0, 0.0
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    qy, qx = y + dy, x + dx
                    if 0 <= qy < height and 0 <= qx < width and surface[qy][qx]:
                        g = (1 / 4, 1 / 8, 1 / 16)[abs(dy) + abs(dx)]
                        total += g * variance[qy][qx]
                        weights += g
            out[y][x] = total / weights
    return out


def atrous_level(illumination, variance, depth, normal, surface, gradient, level, params, prefilter=True):
    """One level of the a-trous filter: C' [S, H, W, 3] and V' [S, H, W]."""
    signals, height, width, _ = illumination.shape
    step = 2**level
    sigma_depth, depth_epsilon = at_level(params["sigma_depth"], level), at_level(params["depth_epsilon"], level)
    sigma_normal = at_level(params["sigma_normal"], level)
    sigma_luminance = at_level(params["sigma_luminance"], level)
    luminance_epsilon = at_level(params["luminance_epsilon"], level)
    near, far = at_level(params["kernel_near"], level), at_level(params["kernel_far"], level)
    scale = 1 + 2 * near + 2 * far
    k = {0: 1 / scale, 1: near / scale, 2: far / scale}  # (3/8, 1/4, 1/16)

    color, v = illumination.tolist(), variance.tolist()
    light = luminance(np.moveaxis(illumination, -1, 0)).tolist()
    blurred = [blur_variance(v[s], surface) if prefilter else v[s] for s in range(signals)]
    out, out_variance = illumination.copy(), variance.copy()
    for y in range(height):
        for x in range(width):
            if not surface[y][x]:
                continue
            tolerance = [sigma_luminance * sqrt(blurred[s][y][x]) + luminance_epsilon for s in range(signals)]
            # per signal: sum of h w, of h w C (three channels), of (h w)^2 V
            sum_w, sum_r, sum_g, sum_b, sum_v = ([0.0] * signals for _ in range(5))
            for dy in (-2, -1, 0, 1, 2):
                for dx in (-2, -1, 0, 1, 2):
                    qy, qx = y + step * dy, x + step * dx
                    if not (0 <= qy < height and 0 <= qx < width and surface[qy][qx]):
                        continue
                    w_z = depth_weight(
                        depth[y][x], depth[qy][qx], gradient[y][x], step * dx, step * dy, sigma_depth, depth_epsilon
                    )
                    w_n = normal_weight(normal[y][x], normal[qy][qx], sigma_normal)
                    h = k[abs(dx)] * k[abs(dy)]
                    for s in range(signals):
                        w_l = exp(-abs(light[s][y][x] - light[s][qy][qx]) / tolerance[s])
                        w = h * w_z * w_n * w_l
                        r, g, b = color[s][qy][qx]
                        sum_w[s] += w
                        sum_r[s] += w * r
                        sum_g[s] += w * g
                        sum_b[s] += w * b
                        sum_v[s] += w * w * v[s][qy][qx]
            for s in range(signals):
                if sum_w[s] > 0:
                    out[s, y, x] = sum_r[s] / sum_w[s], sum_g[s] / sum_w[s], sum_b[s] / sum_w[s]
                    out_variance[s, y, x] = sum_v[s] / sum_w[s] ** 2
    return out, out_variance


# Steps 1 to 7


def step(history, frame, params, config):
    """One frame: (history, frame) -> (history, output)."""
    frame, usable_motion, rejected = sanitise(frame)
    has_surface = frame["object_id"] != -1
    surface, depth, normal = has_surface.tolist(), frame["depth"].tolist(), frame["normal"].tolist()

    illumination = demodulate(frame["radiance"], frame["albedo"], first(params, "albedo_floor"))
    illumination = np.where(has_surface[None, :, :, None], illumination, 0.0)
    taps = reproject_taps(frame, usable_motion, history, params, config)
    illumination, moments, length, valid = accumulate(illumination, taps, history, surface, params, config)
    gradient = depth_gradient(depth, frame["object_id"].tolist())
    estimator, prefilter = config.get("variance", "svgf"), config.get("prefilter", True)
    variance = estimate_variance(moments, length, depth, normal, surface, gradient, params, estimator)

    filtered, variance_filtered, feedback = illumination, variance, illumination
    for level in range(config["levels"]):
        filtered, variance_filtered = atrous_level(
            filtered, variance_filtered, depth, normal, surface, gradient, level, params, prefilter
        )
        if level <= config["feedback_level"]:
            feedback = filtered

    floored = np.maximum(frame["albedo"], first(params, "albedo_floor"))
    modulated = (filtered * np.where(has_surface[None, :, :, None], floored, 0.0)).sum(axis=0)
    untouched = frame["radiance"].sum(axis=0)
    output = {
        "image": np.where(has_surface[:, :, None], modulated, untouched) + frame["emission"],
        "illumination": filtered,
        "variance": variance,
        "variance_filtered": variance_filtered,
        "history_length": length,
        "valid": valid,
        "rejected": rejected,
    }
    history = {"illumination": feedback, "moments": moments, "history_length": length}
    return history | {name: frame[name] for name in ("depth", "normal", "object_id")}, output


def denoise(frames, params, config):
    """`step` over a list of frames from an empty history: a list of outputs, each with its new history as "history"."""
    history, outputs = empty_history(frames[0]), []
    for frame in frames:
        history, output = step(history, frame, params, config)
        outputs.append(output | {"history": history})
    return outputs
