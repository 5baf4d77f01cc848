# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Where arrays that a module has just made keep their numbers, for the other modules here.

from cpython.buffer cimport PyBUF_WRITABLE, PyBuffer_Release, PyObject_GetBuffer


cdef inline void *numbers_of(array) except NULL:
    """The first number of an array that `numpy.empty` has made, for as long as somebody holds the array.

    Its type is known, so it is not looked at: a typed view of a small array takes longer than the work on it.
    """
    cdef Py_buffer held
    PyObject_GetBuffer(array, &held, PyBUF_WRITABLE)
    PyBuffer_Release(&held)
    return held.buf
