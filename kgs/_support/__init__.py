"""What the package is built on and no user calls: errors, JSON files, memory, threads, and what kernels stand on."""
