# SPDX-License-Identifier: Apache-2.0
"""ament's linters as tests."""

from starpos_testing.linters import package, test_copyright, test_pep257, test_xmllint  # noqa: F401
