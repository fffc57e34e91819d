"""Other ways to the same answers, for comparison: used by the benchmark and by nothing else.

    ipopt      all knots as variables, an interior-point method, many random starts (needs casadi)
    mppi       path integral: average control sequences with weights exp(-cost / temperature)
    cem        cross-entropy: refit mean and spread to the cheapest sequences
    mbd        model-based diffusion: the same average, as the score of an annealed density

The last three know controls only (single shooting): one rollout costs K evaluations of f, and
`shooting` runs them all. Whoever finds a trajectory, the same replay decides whether it counts.
"""
