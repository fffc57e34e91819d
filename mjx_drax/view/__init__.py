"""Pictures and videos of solutions. Nothing here solves."""
