"""Whether MJX takes the steps of the C engine for a model, and what it is known to do otherwise."""
