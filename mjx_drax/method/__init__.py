"""The method of the paper, equations only.

Read schedules, model, bounds, metrics, riccati, gauss_newton, descent, langevin.
"""
