# SPDX-License-Identifier: Apache-2.0
"""Position and heading from the stars: the instrument's mathematics, without ROS.

Data flows one way: frame -> detection -> star vectors -> identification -> apparent places -> local frame -> fix.
"""

__version__ = "0.1.0"
