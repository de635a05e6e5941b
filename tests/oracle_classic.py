"""Classic filters in plain NumPy loops, from their formulas: the window kernel of GAMES202's homework 5, its approximations, and
the removal of outliers.

`full` sums over the window. `separable` and `atrous` sum over ever more of it, pass by pass: numerators and denominators are handed
on, and divided at the end.
"""

import math

import numpy as np


def likeness(p, q, image, guides, sigmas):
    """J(p, q) without the factor of pixel distance. `guides`: normal, position, and a list `others` of (image, sigma)."""
    exponent = 0.0
    if sigmas.get("color") is not None and np.isfinite(image[p]).all():
        exponent += sum((image[p] - image[q]) ** 2) / (2 * sigmas["color"] ** 2)
    if guides.get("normal") is not None:
        n, m = guides["normal"][p], guides["normal"][q]
        exponent += math.acos(min(1.0, max(-1.0, n @ m))) ** 2 / (2 * sigmas["normal"] ** 2)
    if guides.get("position") is not None:
        d = guides["position"][q] - guides["position"][p]
        length = math.sqrt(d @ d)
        plane = guides["normal"][p] @ d / length if length > 1e-9 else 0.0
        exponent += plane**2 / (2 * sigmas["plane"] ** 2)
    for other, sigma in guides.get("others", []):
        difference = np.atleast_1d(other[p] - other[q])
        exponent += difference @ difference / (2 * sigma**2)
    return math.exp(-exponent)


def passes(sigma, radius, footprint, levels=None, last_pass=False):
    """For every pass its taps: a list of (dy, dx, weight)."""
    reach = range(-radius, radius + 1)
    bell = {d: math.exp(-(d * d) / (2 * sigma * sigma)) for d in reach}
    if footprint == "full":
        return [[(y, x, bell[y] * bell[x]) for y in reach for x in reach]]
    if footprint == "separable":
        return [[(0, x, bell[x]) for x in reach], [(y, 0, bell[y]) for y in reach]]
    if levels is None:
        levels = max(1, round(math.log2(radius))) if radius else 0
    wanted = sum(d * d * bell[d] for d in reach) / sum(bell.values()) - 0.5 * last_pass
    spline_levels = sum(4.0**i for i in range(levels))
    most = min(1 / 3, max(1 / 4, wanted / (4 * spline_levels))) if levels else 0.0
    result = []
    for level in range(levels):
        p = min(most, max(0.0, wanted / (4 * 4.0**level)))
        wanted -= 4 * p * 4.0**level
        result.append(square(np.convolve([p, 1 - 2 * p, p], [p, 1 - 2 * p, p]), 2**level))
    if last_pass:
        result.append(square([0.25, 0.5, 0.25], 1))
    return result


def square(kernel, step):
    reach = len(kernel) // 2
    return [
        (step * y, step * x, kernel[y + reach] * kernel[x + reach])
        for y in range(-reach, reach + 1)
        for x in range(-reach, reach + 1)
    ]


def joint_bilateral(image, guides, sigmas, radius, footprint="full", levels=None, last_pass=False, mask=None):
    """The filter; `sigmas`: space, color (None = does not guide), normal, plane. A Gaussian has no guides and no color."""
    height, width, _ = image.shape
    wanted = np.ones((height, width), bool) if mask is None else mask
    mask = wanted & np.isfinite(image).all(-1)
    guided = sigmas.get("color") is not None or any(g is not None and len(g) for g in guides.values())
    above = np.where(mask[..., None], image, 0.0)
    below = mask.astype(float)
    for taps in passes(sigmas["space"], radius, footprint, levels, last_pass):
        new_above, new_below = np.zeros_like(above), np.zeros_like(below)
        for y in range(height):
            for x in range(width):
                for dy, dx, kernel in taps:
                    p, q = (y, x), (y + dy, x + dx)
                    if not (0 <= q[0] < height and 0 <= q[1] < width):
                        continue
                    if guided and not (wanted[p] and mask[q]):
                        continue
                    w = kernel * (likeness(p, q, image, guides, sigmas) if guided else 1.0)
                    new_above[p] += w * above[q]
                    new_below[p] += w * below[q]
        above, below = new_above, new_below
    counted = wanted & (below > 1e-15)
    image = np.where((wanted & ~mask)[..., None], 0.0, image)
    return np.where(counted[..., None], above / np.where(counted, below, 1.0)[..., None], image)


def remove_outliers(signal, surface, radius, sigma):
    """`signal` [H, W, C] clamped to mean +- sigma population standard deviations of the others around with a surface."""
    height, width, _ = signal.shape
    result = np.array(signal)
    for y in range(height):
        for x in range(width):
            rows = range(max(0, y - radius), min(height, y + radius + 1))
            columns = range(max(0, x - radius), min(width, x + radius + 1))
            others = [signal[i, j] for i in rows for j in columns if surface[i, j] and (i, j) != (y, x)]
            if surface[y, x] and others:
                mean, reach = np.mean(others, axis=0), sigma * np.std(others, axis=0)
                result[y, x] = np.clip(signal[y, x], mean - reach, mean + reach)
    return result
