"""From a chain's knots to a local optimum: Newton steps until a residual is small."""
