"""The reception's log as that of a node."""

from __future__ import annotations

import logging

from rclpy.node import Node


class NodeLogHandler(logging.Handler):
    """Hands records of Python's logging, from any thread, to a node's logger."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record; a line for each severity, as rclpy ties one to every line of code."""
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        else:
            self._logger.info(text)
