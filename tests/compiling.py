"""Compiling quickly rather than well: a third of the time."""

import os

import jax

QUICK: tuple = (("xla_backend_optimization_level", 0), ("xla_llvm_disable_expensive_passes", True))
"""Compiler options: quick, but with the order of arithmetic that users get."""
AS_USERS: tuple = (("xla_backend_optimization_level", 3), ("xla_llvm_disable_expensive_passes", False))
"""Compiler options for tests of how something is computed rather than of what."""
FLAGS: str = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if jax.__version_info__[:2] == (0, 10):  # later ones do not know the first, and gain nothing by the second
    FLAGS += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    AS_USERS += (("xla_cpu_use_fusion_emitters", True),)


def compile_quickly() -> None:
    """In this process, before its first computation, and in all that it starts."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}".strip()
