"""Spatiotemporal variance-guided filtering (SVGF) as a pure functional JAX library.

Names are imported when first used: `import svgf_jax` costs nothing, and what needs no JAX does not load it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from svgf_jax.types import Config as Config
    from svgf_jax.types import Frame as Frame
    from svgf_jax.types import History as History
    from svgf_jax.types import Output as Output
    from svgf_jax.types import Params as Params
    from svgf_jax.types import Rejected as Rejected
    from svgf_jax.types import SvgfError as SvgfError

__version__ = "0.1.0"

_HOME = {
    "types": ["Config", "Frame", "History", "Output", "Params", "Rejected", "SvgfError"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name in _MODULE_OF:
        return getattr(import_module(f"svgf_jax.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'svgf_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
