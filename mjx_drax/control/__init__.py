"""A solver in the loop: model predictive control and the plant that it drives."""
