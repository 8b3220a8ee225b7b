"""Residuals, their thresholds, and the smallest contact that they detect."""
