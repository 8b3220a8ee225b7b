"""Residuals, their thresholds, and what they let be seen."""
