"""Errors of maps and trajectories against the truth, measured distances or known relations.

Pure functions on value types.
"""
