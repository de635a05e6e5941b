"""Compares what several devices compute with what one does; run in a process of its own, with JAX_NUM_CPU_DEVICES=4.

Prints the largest difference, relative to the largest value, of each comparison as JSON.
"""

import json
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scenes
from bridge import to_frame
from jax.sharding import Mesh, PartitionSpec

from svgf_jax import TaaHistory, init, preset, sampling, step, step_over, taa


def difference(one, other):
    """Of two trees of arrays; 1 where something is not finite."""
    worst = 0.0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        assert a.shape == b.shape
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return 1.0
        worst = max(worst, float(np.abs(a - b).max(initial=0) / max(np.abs(a).max(initial=0), 1e-9)))
    return worst


def read_everything(plane, ids):
    """All of `sampling` that looks at other rows."""
    height, width = plane.shape
    first, tall = sampling.place(plane)
    row = first + jax.lax.broadcasted_iota(jnp.int32, (height, width), 0)
    column = jax.lax.broadcasted_iota(jnp.int32, (height, width), 1)
    far, inside = sampling.read_at(sampling.whole({"a": plane})["a"], tall - 1 - 2 * row, column + 1)
    window = sampling.sum_over_taps(
        lambda sums, q, p, t: (sums[0] + t * q[0] * q[1] * p, sums[1] + q[1]),
        lambda sums, p: sums,
        neighbours=(plane, sampling.inside_image(plane)),
        centre=plane,
        offsets=sampling.square_offsets(2),
        per_tap=jnp.arange(25, dtype=plane.dtype),
        sums=(jnp.zeros((), plane.dtype), jnp.zeros((), plane.dtype)),
        where=row != 2,
        step_size=2,
        largest_step=2,
    )
    window = [jnp.where(row != 2, a, 0) for a in window]  # elsewhere it is 0 in some strips and not in others
    moved = [sampling.shift(plane, dy, dx) for dy, dx in ((-1, 0), (1, 1), (0, -2), (6, 0), (-40, 1))]
    return (
        far,
        inside,
        window,
        moved,
        sampling.shift(ids, 3, 0),
        sampling.add_up(ids > 2) + 0 * ids,
    )


def anti_alias(plane):
    """The stage that looks at the border itself."""
    image, motion = jnp.stack([plane, plane * 2, 1 - plane], -1), jnp.stack([5 * plane - 3, 9 * plane - 4], -1)
    past, image = taa(TaaHistory(jnp.flip(image, 1), jnp.ones((), plane.dtype)), image, motion, 1 + plane)
    return past.color, image


def over(function, height, count, *planes):
    """`function` of planes whose rows are divided over so many devices, rows of zeros below."""
    rows = -(-height // count)
    axis = f"{sampling.DIVIDED}{height}"
    mesh = Mesh(np.asarray(jax.devices()[:count]), (axis,))
    spec = PartitionSpec(axis)
    divided = jax.shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    results = divided(*(jnp.pad(a, ((0, rows * count - height), (0, 0))) for a in planes))
    return jax.tree.map(lambda a: a[:height], results)


def readings():
    """The helpers, over 2, 3 and 4 devices: rows that they divide, rows that they don't, fewer rows than a filter reaches."""
    told = {}
    for count, height in ((2, 12), (3, 13), (4, 6)):
        rng = np.random.default_rng(height)
        plane = jnp.asarray(rng.random((height, 5), np.float32))
        ids = jnp.asarray(rng.integers(0, 5, (height, 5), np.int32))
        divided = jax.jit(partial(over, read_everything, height, count))
        told[f"{count} devices, {height} rows"] = difference(jax.jit(read_everything)(plane, ids), divided(plane, ids))
        if count == 3:
            functions = (jax.jit(read_everything), divided)
            slopes = [jax.jvp(lambda a, go=go, ids=ids: go(a, ids)[2], (plane,), (plane,))[1] for go in functions]
            results = (jax.jit(anti_alias)(plane), jax.jit(partial(over, anti_alias, height, count))(plane))
            told["anti-aliasing"] = difference(*results)
            told["derivatives"] = difference(*slopes)
    return told


def steps(name, count, size, *, frames=3, signals=1, changes=()):
    """The largest differences over a sequence, history and output."""
    params, config = preset(name)
    config = config._replace(**dict(changes))
    values = (np.asarray(value, np.float32) for value in params)
    params = type(params)(*(value[: config.levels] if value.ndim else value for value in values))
    sequence = [to_frame(frame, np.float32) for frame in scenes.synthetic(3, *size, frames=frames)]
    sequence = [f._replace(radiance=f.radiance[:signals]) for f in sequence]
    one = several = init(sequence[0], config=config, effective_history=True)
    worst = 0.0
    for frame in sequence:
        one = step(one, frame, params=params, config=config)
        several = step_over(several, frame, params=params, config=config, devices=jax.devices()[:count])
        worst = max(worst, difference(one, several))
        one, several = one[0], several[0]
    return worst


if __name__ == "__main__":
    if sys.argv[1:] == ["readings"]:
        print(json.dumps(readings()))
    else:
        print(json.dumps({"adaptive": steps("adaptive", 3, (21, 11), frames=2, changes=[("levels", 2)])}))
