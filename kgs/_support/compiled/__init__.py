"""What all numba kernels stand on: how they are compiled (`kernel`), threads (`threads`), tensors' memory (`arrays`).

Only `arrays` needs torch, and only `kernel` numba.
"""
