"""Fit the filter's numbers to a renderer's own noise. Imports only the public `svgf_jax`, which never imports this.

`tune.fit(params, config, shots)` takes shots from `tune.shot_of_files` or `tune.shot_of_arrays`. Names are imported when first
used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tune.evaluate import Measured as Measured
    from tune.evaluate import measure as measure
    from tune.fitting import Fit as Fit
    from tune.fitting import Iteration as Iteration
    from tune.fitting import fit as fit
    from tune.knowledge import Knowledge as Knowledge
    from tune.residuals import NOISY as NOISY
    from tune.residuals import REFERENCE as REFERENCE
    from tune.residuals import Term as Term
    from tune.residuals import noisy_terms as noisy_terms
    from tune.residuals import reference_terms as reference_terms
    from tune.shots import Example as Example
    from tune.shots import Shot as Shot
    from tune.shots import shot_of_arrays as shot_of_arrays
    from tune.shots import shot_of_files as shot_of_files
    from tune.targets import Likeness as Likeness
    from tune.targets import doubts as doubts
    from tune.targets import likeness as likeness

_HOME = {
    "evaluate": ["Measured", "measure"],
    "fitting": ["Fit", "Iteration", "fit"],
    "knowledge": ["Knowledge"],
    "residuals": ["NOISY", "REFERENCE", "Term", "noisy_terms", "reference_terms"],
    "shots": ["Example", "Shot", "shot_of_arrays", "shot_of_files"],
    "targets": ["Likeness", "doubts", "likeness"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = getattr(import_module(f"tune.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'tune' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__]
