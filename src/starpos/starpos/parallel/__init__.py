# SPDX-License-Identifier: Apache-2.0
"""The same work on many frames: here, on several processes of this machine, or on a dask.distributed cluster.

All three take calls (work, of), which are one frame's each, and give their answers back in the calls' order.
"""

# What says how many threads a BLAS has when it is loaded. OpenBLAS (that of numpy 1.26 at least) solves a system of six
# in another order with two threads than with one: the last digit differs, and nothing here is quicker for more than one.
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
