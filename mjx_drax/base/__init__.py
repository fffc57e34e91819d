"""What every room uses: errors, pytrees, files. No numerics."""
