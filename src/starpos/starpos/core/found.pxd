# SPDX-License-Identifier: Apache-2.0


cdef class Identification:
    cdef readonly object star, catalogue, blend_px, attitude, expected
    cdef readonly double focal_scale, residual_px, mean_square_px2, log_odds
    cdef readonly bint mirrored
