# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Where arrays keep their numbers, and memory to work in, for the other modules here.

from cpython.buffer cimport PyBUF_SIMPLE, PyBuffer_Release, PyObject_GetBuffer
from cpython.bytearray cimport PyByteArray_AS_STRING, PyByteArray_FromStringAndSize


cdef inline void *numbers_of(array, Py_ssize_t size) except NULL:
    """The first number of a contiguous array of so many bytes, for as long as somebody holds the array.

    Its type must be known: it is not looked at, because a typed view of a small array takes longer than the work on it.
    """
    cdef Py_buffer held
    PyObject_GetBuffer(array, &held, PyBUF_SIMPLE)
    PyBuffer_Release(&held)
    if held.len != size:
        raise ValueError(f"an array of {held.len} bytes where {size} were expected")
    return held.buf


cdef inline bytearray room_for(Py_ssize_t size):
    """So many bytes to work in, without values; Python frees them when nobody holds them any more."""
    return PyByteArray_FromStringAndSize(NULL, size)


cdef inline void *start_of(bytearray room) noexcept:
    """The first byte."""
    return PyByteArray_AS_STRING(room)
