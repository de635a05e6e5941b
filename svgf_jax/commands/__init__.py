"""The commands of `svgf-jax`, one a file. Their heavy imports stand inside the functions."""
