"""From a MuJoCo model to dynamics. The only room that imports mujoco and mjx, but for drawing."""
