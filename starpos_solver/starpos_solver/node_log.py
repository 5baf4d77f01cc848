# SPDX-License-Identifier: Apache-2.0
"""The node's logger as a session has it."""

from rclpy.impl.rcutils_logger import RcutilsLogger


class NodeLog:
    """The node's logger for a session.  rclpy ties a severity to the calling line, so each has its own line."""

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger

    def info(self, message: str) -> None:
        self._logger.info(message)

    def warning(self, message: str) -> None:
        self._logger.warning(message)

    def error(self, message: str) -> None:
        self._logger.error(message, throttle_duration_sec=60.0)
