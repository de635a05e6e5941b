"""Spatiotemporal variance-guided filtering (SVGF) as a pure functional JAX library.

Names are imported when first used: `import svgf_jax` costs nothing, and what needs no JAX does not load it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from svgf_jax.accumulation import Accumulated as Accumulated
    from svgf_jax.accumulation import accumulate as accumulate
    from svgf_jax.accumulation import clamp_history as clamp_history
    from svgf_jax.adaptation import follow_light as follow_light
    from svgf_jax.antialiasing import taa as taa
    from svgf_jax.antialiasing import taa_init as taa_init
    from svgf_jax.arrays import frame_of as frame_of
    from svgf_jax.atrous import atrous_filter as atrous_filter
    from svgf_jax.atrous import atrous_level as atrous_level
    from svgf_jax.baselines import baseline_denoise as baseline_denoise
    from svgf_jax.baselines import baseline_init as baseline_init
    from svgf_jax.baselines import baseline_step as baseline_step
    from svgf_jax.color import demodulate as demodulate
    from svgf_jax.color import luminance as luminance
    from svgf_jax.color import remodulate as remodulate
    from svgf_jax.demo import sample as sample
    from svgf_jax.devices import step_over as step_over
    from svgf_jax.edges import Guides as Guides
    from svgf_jax.edges import depth_gradient as depth_gradient
    from svgf_jax.edges import edge_weight as edge_weight
    from svgf_jax.edges import guides_of as guides_of
    from svgf_jax.frames import load_sequence as load_sequence
    from svgf_jax.frames import open_source as open_source
    from svgf_jax.frames import read_frame as read_frame
    from svgf_jax.joint_bilateral import bilateral_filter as bilateral_filter
    from svgf_jax.joint_bilateral import gaussian_filter as gaussian_filter
    from svgf_jax.joint_bilateral import joint_bilateral_filter as joint_bilateral_filter
    from svgf_jax.methods import MethodConfig as MethodConfig
    from svgf_jax.methods import method as method
    from svgf_jax.modulation import modulate as modulate
    from svgf_jax.moments import Sums as Sums
    from svgf_jax.moments import Welford as Welford
    from svgf_jax.moments import add_sample as add_sample
    from svgf_jax.moments import mean_of as mean_of
    from svgf_jax.moments import merge_samples as merge_samples
    from svgf_jax.moments import start_sums as start_sums
    from svgf_jax.moments import start_welford as start_welford
    from svgf_jax.moments import variance_of as variance_of
    from svgf_jax.moments import variance_of_mean as variance_of_mean
    from svgf_jax.outliers import clamp_outliers as clamp_outliers
    from svgf_jax.outliers import remove_outliers as remove_outliers
    from svgf_jax.parameters import load_params as load_params
    from svgf_jax.parameters import preset as preset
    from svgf_jax.parameters import save_params as save_params
    from svgf_jax.pipeline import denoise as denoise
    from svgf_jax.pipeline import init as init
    from svgf_jax.pipeline import step as step
    from svgf_jax.references import load_reference as load_reference
    from svgf_jax.references import read_radiance as read_radiance
    from svgf_jax.reflections import Reflections as Reflections
    from svgf_jax.reflections import trace_reflections as trace_reflections
    from svgf_jax.reprojection import reproject as reproject
    from svgf_jax.reprojection import reproject_reflections as reproject_reflections
    from svgf_jax.sanitation import sanitise as sanitise
    from svgf_jax.tonemapping import decode_srgb as decode_srgb
    from svgf_jax.tonemapping import encode_srgb as encode_srgb
    from svgf_jax.tonemapping import tonemap as tonemap
    from svgf_jax.tonemapping import untonemap as untonemap
    from svgf_jax.types import Config as Config
    from svgf_jax.types import Frame as Frame
    from svgf_jax.types import History as History
    from svgf_jax.types import Output as Output
    from svgf_jax.types import Params as Params
    from svgf_jax.types import Rejected as Rejected
    from svgf_jax.types import Reprojected as Reprojected
    from svgf_jax.types import SvgfError as SvgfError
    from svgf_jax.types import TaaHistory as TaaHistory
    from svgf_jax.variance import estimate_variance as estimate_variance

__version__ = "0.1.0"

_HOME = {
    "accumulation": ["Accumulated", "accumulate", "clamp_history"],
    "adaptation": ["follow_light"],
    "antialiasing": ["taa", "taa_init"],
    "arrays": ["frame_of"],
    "atrous": ["atrous_filter", "atrous_level"],
    "baselines": ["baseline_denoise", "baseline_init", "baseline_step"],
    "color": ["demodulate", "luminance", "remodulate"],
    "demo": ["sample"],
    "devices": ["step_over"],
    "edges": ["Guides", "depth_gradient", "edge_weight", "guides_of"],
    "frames": ["load_sequence", "open_source", "read_frame"],
    "joint_bilateral": ["bilateral_filter", "gaussian_filter", "joint_bilateral_filter"],
    "methods": ["MethodConfig", "method"],
    "modulation": ["modulate"],
    "moments": [
        *("Sums", "Welford", "add_sample", "mean_of", "merge_samples"),
        *("start_sums", "start_welford", "variance_of", "variance_of_mean"),
    ],
    "outliers": ["clamp_outliers", "remove_outliers"],
    "parameters": ["load_params", "preset", "save_params"],
    "pipeline": ["denoise", "init", "step"],
    "references": ["load_reference", "read_radiance"],
    "reflections": ["Reflections", "trace_reflections"],
    "reprojection": ["reproject", "reproject_reflections"],
    "sanitation": ["sanitise"],
    "tonemapping": ["decode_srgb", "encode_srgb", "tonemap", "untonemap"],
    "types": ["Config", "Frame", "History", "Output", "Params", "Rejected", "Reprojected", "SvgfError", "TaaHistory"],
    "variance": ["estimate_variance"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = getattr(import_module(f"svgf_jax.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'svgf_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
