"""Fit the filter's weights to a renderer's own noise."""
