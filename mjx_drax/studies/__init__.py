"""Benchmarks, comparisons with other methods, and the figures of the paper."""
