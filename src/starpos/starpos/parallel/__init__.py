# SPDX-License-Identifier: Apache-2.0
"""Do the same work on many frames: in this process, or in several processes.

Both take calls, one for each frame (a function and the file or files it works on), and return the answers in the order of
the calls.
"""

# Variables that set the number of threads when a BLAS is loaded. With two threads OpenBLAS (at least numpy 1.26's)
# solves a system of six in another order than with one, so that the last digit differs. More threads make nothing faster.
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
