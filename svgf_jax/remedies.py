"""What to change about what an inspection finds, by renderer: data. "" is what holds for all."""

REMEDIES: dict[str, dict[str, str]] = {
    "correlation": {
        "": "Set the renderer's pixel filter to a box of one pixel: samples must not be shared between pixels.",
        "mitsuba": '<rfilter type="box"/> in the film (the default, gaussian, shares samples between pixels).',
        "pbrt": 'PixelFilter "box" with radii of 0.5.',
        "cycles": "Turn off Render > Sampling > Denoise, or write the pass Noisy Image; the pixel filter does no harm here.",
        "arnold": "Set the filter of all AOVs to box_filter with width 1.",
        "renderman": "Set the pixel filter to box, 1 x 1, or importance sample it.",
        "karma": "Set the pixel filter to box, 1 x 1.",
        "luxcore": "Set film.filter.type to NONE.",
    },
    "seed": {
        "": "Let the renderer's random seed change from frame to frame.",
        "mitsuba": "mi.render(scene, seed=frame_number): the seed is 0 unless it is given.",
        "cycles": "Press the clock beside Render > Sampling > Advanced > Seed (animated seed).",
        "arnold": "Let AA_seed follow the frame number.",
        "pbrt": 'Option "integer seed" with the frame number.',
        "luxcore": "Set renderengine.seed to the frame number.",
    },
    "fireflies": {
        "": "Clamp them here (--set outlier_radius=3), or clamp indirect light in the renderer.",
        "cycles": "Render > Light Paths > Clamping > Indirect Light (10, say), or clamp here: --set outlier_radius=3.",
        "arnold": "Lower indirect_sample_clamp, or clamp here: --set outlier_radius=3.",
        "pbrt": 'Film "float maxcomponentvalue" (20, say), or clamp here: --set outlier_radius=3.',
        "karma": "Lower Color Limit, or clamp here: --set outlier_radius=3.",
    },
    "little noise": {
        "": "Give the renderer's noisy picture: a denoised one has lost what the filter goes by, a converged one needs no filter.",
        "cycles": "Combined is denoised while Render > Sampling > Denoise is on: take Noisy Image (--channel radiance=...).",
    },
    "normal space": {
        "": "Let the renderer write world-space normals.",
        "cycles": "Take the pass Normal; Denoising Normal is in camera space (--channel normal=...).",
        "pbrt": 'Film "gbuffer" "string coordinatesystem" "world" (the default is camera).',
    },
    "normals packed": {
        "": "Unpack them (2 n - 1) before, or let the renderer write them from -1 to 1 in float.",
    },
    "depth kind": {
        "": "Let the renderer write linear view z, the distance along the viewing axis.",
    },
    "depth sign": {
        "": "Let the renderer write depth as positive in front of the camera: negative ones count as background.",
    },
    "history": {
        "": "Look at motion, depth and ids above: something does not match between frames. Fast motion has the same effect.",
    },
    "history, id": {
        "": "Let an object's id stay the same from frame to frame, or leave ids out: --channel id=none.",
    },
    "broken light": {
        "": "They are set to 0, and their neighbours fill them; find the material or light that makes them.",
    },
    "negative light": {
        "": "They are set to 0: a filter with negative lobes (Mitchell, Lanczos, sinc) makes them; use a box of one pixel.",
    },
    "broken guides": {
        "": "Such pixels count as background, or have no history; look at the objects there.",
    },
    "zero motion": {
        "": "Let the renderer fill them (often not with motion blur).",
        "cycles": "Turn off Render > Motion Blur: with it, Cycles writes 0 into the pass Vector.",
    },
    "guides": {
        "": "They count as background. Depth in half float is infinite above 65504: write 32-bit, or scale the scene.",
    },
    "excess": {
        "": "Is this beauty without emission? Then give direct and indirect light by hand (--channel direct=NAMES).",
    },
    "half": {
        "": "Let the renderer write this channel as 32-bit float.",
        "pbrt": '"bool savefp16" false in the film.',
        "mitsuba": '<string name="component_format" value="float32"/> in the film.',
        "falcor": "Mogwai captures in half: copy the texture out in 32-bit.",
        "cycles": "Output > OpenEXR MultiLayer > Color Depth: Float (Full).",
    },
}


def remedy(topic: str, renderer: str) -> str:
    """What to change, for a renderer by its name; one without a line of its own gets what holds for all."""
    by_renderer = REMEDIES[topic]
    return by_renderer.get(renderer, by_renderer[""])
