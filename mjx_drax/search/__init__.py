"""Many chains and many attempts: the loops on the host, compilation, devices, checkpoints."""
