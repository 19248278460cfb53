r"""The backend in plain torch: every call, device and dtype. It defines what is right, and the others follow it.

`projection` makes the footprints, `binning` the lists of the tiles (which Gaussian reaches which tile, front to back),
and `compositing` adds up the layers of each pixel, with an analytic backward pass. The photometric loss in torch is
`kgs.losses.photometric` itself.

For the layers k = 1, 2, ... of a pixel, nearest first (Kerbl et al. 2023, eq. 3)

    alpha_k = min(0.99, o_k exp(-q_k / 2)),   T_1 = 1,   T_{k+1} = T_k (1 - alpha_k),
    C = sum_k w_k c_k + T_end background,   w_k = T_k alpha_k

with alpha below `alpha_threshold` taken as 0, and T below `transmittance_stop` taken as 0 from then on. Both rules act
on each pixel and layer alone, so the image does not depend on tiles or chunks.

The torch compositor takes K layers of many tiles in a chunk: q_k is the sum of two squares, each linear in x and y; an
exponential gives the alphas, a scan over the layers T, and a sum the colours. T before each chunk is kept and, where
memory allows, the alphas. The backward pass visits the chunks from back to front and carries V_k, the colour along g
that shows from layer k on, as if the transmittance before it were 1:

    V_k = alpha_k (c_k . g) + (1 - alpha_k) V_{k+1},   V_end = g_T,   dL/d ln alpha_k = w_k (c_k . g - V_{k+1})

and V_{k+1} = 0 where the transmittance falls below the stop at layer k. V is a mean of colours: no sum grows large,
nothing is divided by 1 - alpha. For each Gaussian, a tile contributes the six moments of that derivative over
the pixels, about the centre of the Gaussian; they are summed over its tiles.

An image that needs more than `max_bytes` is made in row slices. Where lists are long, a row slice is made in depth
slices, nearest first, with lists only for tiles that are not yet opaque: hidden Gaussians are not listed or sorted.
"""
