"""Temporal anti-aliasing in plain Python loops, from its description alone."""

from math import floor, isfinite

import numpy as np


def luma(c):
    return max((c[0] + 2 * c[1] + c[2]) / 4, 0.0)


def to_ycocg(c):
    return np.array([(c[0] + 2 * c[1] + c[2]) / 4, (c[0] - c[2]) / 2, (2 * c[1] - c[0] - c[2]) / 4])


def to_rgb(c):
    return np.array([c[0] + c[1] - c[2], c[0] + c[2], c[0] - c[1] - c[2]])


def catmull_rom(t):
    return [
        (-t + 2 * t**2 - t**3) / 2,
        (2 - 5 * t**2 + 3 * t**3) / 2,
        (t + 4 * t**2 - 3 * t**3) / 2,
        (-(t**2) + t**3) / 2,
    ]


def taa(color, frames, image, motion, depth, alpha):
    """(color, frames) of the past and a frame -> (color, frames, linear image)."""
    height, width = depth.shape
    image = np.where(np.isfinite(image), image, 0.0)
    display = np.array([[c / (1 + luma(c)) for c in row] for row in image])
    out_color, out = np.zeros_like(image), np.zeros_like(image)
    for y in range(height):
        for x in range(width):
            around = [(y, x)] + [
                (y + j, x + i)
                for j, i in [(-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)]
                if 0 <= y + j < height and 0 <= x + i < width
            ]
            z = {q: depth[q] if isfinite(depth[q]) and depth[q] > 0 else np.inf for q in around}
            nearest = min(around, key=lambda q: z[q])
            m = motion[nearest]
            out_color[y, x], out[y, x] = display[y, x], image[y, x]
            if frames == 0 or not all(isfinite(v) for v in m):
                continue
            px, py = x + m[0], y + m[1]
            if not (-0.5 <= px <= width - 0.5 and -0.5 <= py <= height - 0.5):
                continue
            past = np.zeros(3)
            for j, wy in enumerate(catmull_rom(py - floor(py))):
                for i, wx in enumerate(catmull_rom(px - floor(px))):
                    qy, qx = floor(py) + j - 1, floor(px) + i - 1
                    past += wy * wx * color[min(max(qy, 0), height - 1), min(max(qx, 0), width - 1)]
            shown = np.array([to_ycocg(display[q]) for q in around])
            low, high = shown.min(axis=0), shown.max(axis=0)
            centre, reach = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
            away = to_ycocg(past) - centre
            past = to_rgb(centre + away / max(1.0, np.max(np.abs(away) / reach)))
            a = max(alpha, 1 / (frames + 1))
            out_color[y, x] = (1 - a) * past + a * display[y, x]
            out[y, x] = out_color[y, x] / (1 - luma(out_color[y, x]))
    return out_color, frames + 1, out
