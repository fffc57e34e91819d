"""Helpers to pose a problem: terms of costs, distances, initial guesses."""
