"""The gradient of projection for pinhole cameras: the contribution of each Gaussian to pose and intrinsics."""

import numpy as np

from kgs._support.compiled.kernel import ONE, ZERO, jit

from .projection_kernels import camera_point, color_gradients, point_gradient, rotation, rows, turned_back


@jit
def camera_gradients(begin, end, means, quats, scales, colors, camera, ids, gradients, outs):
    """From gradients of what a camera sees, a range of its list, to those of its matrices, one row for each Gaussian.

    `ids` and `gradients` are those of :func:`.projection_kernels.footprint_gradients`. Written are `outs` `(M, 21)`:
    world to camera `(3, 4)`, then the intrinsics `(3, 3)`.
    """
    v, k, limits, back, centre = camera
    g_means2d, g_factors, g_depths, _, g_rgb = gradients
    bands = colors.shape[1] // 3 if g_rgb.shape[1] else 0
    b, h, none = np.empty(16, np.float32), np.empty(16, np.float32), np.empty((0, 0), np.float32)
    for m in range(begin, end):
        g, out = ids[m], outs[m]
        x, y, z = local = camera_point(means[g, 0], means[g, 1], means[g, 2], v)
        world, inverse = (means[g, 0], means[g, 1], means[g, 2]), ONE / z
        j, _, tx, ty = rows(x, y, inverse, v, k, limits)
        s, f = scales[g], g_factors[m]
        t = (f[0] * s[0], f[1] * s[1], f[2] * s[2], f[3] * s[0], f[4] * s[1], f[5] * s[2])
        u = turned_back(t, rotation(quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3])[2])
        g_mean = g_means2d[m, 0], g_means2d[m, 1]
        gx, gy, gz, by_j = point_gradient(x, y, z, v, k, limits, u, g_mean, g_depths[m])
        moved, w = (gx, gy, gz), (ZERO, ZERO, ZERO)
        if bands > 1:
            w = color_gradients(g, means, colors, centre, bands, g_rgb[m], b, h, none)
        px, py = (k[0, 0] * x + k[0, 1] * y) * inverse + k[0, 2], (k[1, 0] * x + k[1, 1] * y) * inverse + k[1, 2]
        across = g_mean[0] * inverse, g_mean[1] * inverse, -(g_mean[0] * px + g_mean[1] * py) * inverse
        for i in range(3):
            turned = back[0, i] * w[0] + back[1, i] * w[1] + back[2, i] * w[2]
            for c in range(3):
                out[4 * i + c] = moved[i] * world[c] + j[i] * u[c] + j[3 + i] * u[3 + c] + turned * centre[c]
                out[12 + 3 * i + c] = across[i] * local[c]
            out[4 * i + 3] = moved[i] + turned
        for i in range(2):
            out[12 + 3 * i] += (by_j[3 * i] - by_j[3 * i + 2] * tx) * inverse
            out[13 + 3 * i] += (by_j[3 * i + 1] - by_j[3 * i + 2] * ty) * inverse
        if not limits[0, 0] <= x * inverse <= limits[0, 1]:  # the limits follow the lens
            by_limit = (k[0, 0] * by_j[2] + k[1, 0] * by_j[5]) * inverse / k[0, 0]
            out[12], out[14] = out[12] + by_limit * tx, out[14] + by_limit
        if not limits[1, 0] <= y * inverse <= limits[1, 1]:
            by_limit = (k[0, 1] * by_j[2] + k[1, 1] * by_j[5]) * inverse / k[1, 1]
            out[16], out[17] = out[16] + by_limit * ty, out[17] + by_limit
