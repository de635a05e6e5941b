"""GAMES202's homework 5 in plain NumPy loops, from its text: filter, reproject, clamp, accumulate. Frames are dicts as in `oracle`,
with `position` [H, W, 3]; a history is a dict of the accumulated color [H, W, 3], object_id and length [H, W]."""

from math import floor

import numpy as np
import oracle
import oracle_classic

HOMEWORK = {"space": 32.0, "color": 0.6, "normal": 0.1, "plane": 0.1, "alpha": 0.2, "clamp": 1.0}
GUIDES = {"gaussian": (), "bilateral": (), "joint-bilateral": ("normal", "position")}


def empty_history(frame):
    size = frame["depth"].shape
    return {"color": np.zeros((*size, 3)), "object_id": np.full(size, -1), "length": np.zeros(size)}


def filtered(frame, color, params, filter_, radius, footprint):
    if filter_ == "none":
        return color
    sigmas = params if filter_ != "gaussian" else {"space": params["space"]}
    guides = {name: frame[name] for name in GUIDES[filter_]}
    mask = frame["object_id"] != -1
    return oracle_classic.joint_bilateral(color, guides, sigmas, radius, footprint=footprint, mask=mask)


def box(color, surface, y, x):
    """Mean and standard deviation of the 7 x 7 pixels around (y, x) that have a surface."""
    height, width, _ = color.shape
    inside = [
        color[j, i]
        for j in range(y - 3, y + 4)
        for i in range(x - 3, x + 4)
        if 0 <= j < height and 0 <= i < width and surface[j, i]
    ]
    mean = sum(inside) / len(inside)
    return mean, np.sqrt(sum((value - mean) ** 2 for value in inside) / len(inside))


def step(history, frame, params, filter_="joint-bilateral", radius=16, footprint="full", temporal=True):
    """One frame: the new history, the image, and where there was history."""
    position = frame["position"]
    frame, usable, _ = oracle.sanitise({name: value for name, value in frame.items() if name != "position"})
    frame["position"] = position
    color = frame["radiance"].sum(axis=0) + frame["emission"]
    new = filtered(frame, color, params, filter_, radius, footprint)
    ids, motion = frame["object_id"], frame["motion"]
    height, width = ids.shape
    valid, length, out = np.zeros((height, width), bool), np.zeros((height, width)), color.copy()
    for y in range(height):
        for x in range(width):
            if ids[y, x] == -1:
                continue
            out[y, x], length[y, x] = new[y, x], 1.0
            if not temporal or not usable[y, x]:
                continue
            px, py = floor(x + 0.5 + motion[y, x, 0]), floor(y + 0.5 + motion[y, x, 1])
            if not (0 <= px < width and 0 <= py < height and history["object_id"][py, px] == ids[y, x]):
                continue
            mean, deviation = box(new, ids != -1, y, x)
            old = np.clip(
                history["color"][py, px], mean - params["clamp"] * deviation, mean + params["clamp"] * deviation
            )
            out[y, x] = params["alpha"] * new[y, x] + (1 - params["alpha"]) * old
            valid[y, x], length[y, x] = True, min(history["length"][py, px] + 1, 32)
    return {"color": out, "object_id": ids, "length": length}, out, valid


def denoise(frames, params=HOMEWORK, **method):
    """A list of (history, image, valid)."""
    history, results = empty_history(frames[0]), []
    for frame in frames:
        results.append(step(history, frame, params, **method))
        history = results[-1][0]
    return results
