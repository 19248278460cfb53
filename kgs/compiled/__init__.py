"""The stages of a fit as numba kernels, for float32 on a CPU: one file a stage, NumPy arrays in and out.

Torch defines what is right; a kernel gives the same within the rounding of float32, and the formulas stand beside the
torch code that it follows. Nothing here knows torch: what makes autograd functions of kernels lies next to the torch
implementation of each stage, and `kgs.backends` chooses. `import kgs` does not import numba.

Rules that the speed hangs on. Each was measured to cost a factor of 1.5 to 3 where it was broken, silently:

1. Pixels of a tile are the lanes of SIMD. Loops over pixels have a constant length and read and write one flat scratch
   array at constant distances; other arrays are only read. Else LLVM finds dependences and the loop stays scalar.
2. An index must be provably >= 0, because indices wrap: a loop that counts down masks its index.
3. `fastmath` lets sums be reassociated; NaN and infinity keep their meaning.
4. Literals are float64 in numba: every constant is an `np.float32`.
5. Reads may miss the caches, writes may not: gathers are loops of their own, and sums by Gaussian are kept for a band
   of neighbouring tiles.
6. The number of features is a constant of the compiled kernel: the length of a tuple.
7. Ranges and bands do not depend on the number of threads, and nothing is summed by two threads: same bits on any
   number of them.
"""
