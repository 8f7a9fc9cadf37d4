"""Accuracy against time: measured, plotted and written to files."""
