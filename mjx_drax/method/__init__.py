"""The method of the paper. Read: schedules, model, bounds, metrics, riccati, gauss_newton,
descent, langevin.
"""
