"""What is solved: trajectories, bounds, costs, dynamics, and how they are built and checked."""
