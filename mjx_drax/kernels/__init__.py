"""Speed and nothing else: arrays in, arrays out, each kernel with a plain twin."""
