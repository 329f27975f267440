"""From the start of a node's process to its clean end."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from stereoreg_ros.nodes.common.overrides import require_declared
from stereoreg_ros.nodes.common.parameters import ParameterError

# A wait without an end at times sleeps through a SIGTERM; this one wakes and looks.
_WAKE_S = 0.2


def run(node_factory: Callable[[], Node]) -> int:
    """Run a node until a signal ends the process or the node's own `finished` (if it has one) is true.

    Where the node's `is_computing` (if it has one) is true then, the process ends without waiting for that.
    A callback that fails is reported with its traceback and the node lives on.
    Returns the exit code: 0, or 1 with a sentence on standard error where the node cannot start.
    """
    try:
        rclpy.init()
    except rclpy_implementation.UnknownROSArgsError as error:
        return _cannot_start(f"unknown ROS arguments: {error}")
    except (rclpy_implementation.RCLError, rclpy_implementation.RCLInvalidROSArgsError) as error:
        return _cannot_start(error)
    node: Node | None = None
    try:
        executor = SingleThreadedExecutor()
        node = node_factory()
        require_declared(node)
        _spin(executor, node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterError as error:
        return _cannot_start(error)
    except Exception:
        # The shutdown by a signal reaches whoever is using the context as an error of one kind or another.
        if rclpy.ok():
            raise
    finally:
        _end(node)
    if getattr(node, "is_computing", False):
        # The interpreter would end such a thread in the middle of C++ code, and that the whole process by an abort.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _spin(executor: SingleThreadedExecutor, node: Node) -> None:
    executor.add_node(node)
    while rclpy.ok() and not getattr(node, "finished", False):
        try:
            executor.spin_once(timeout_sec=_WAKE_S)
        except Exception:
            # rclpy itself fails in the callback of a malformed parameter request; that must not take the node away.
            if not rclpy.ok():
                raise
            node.get_logger().error(f"internal error in a callback\n{traceback.format_exc()}")


def _cannot_start(error: Exception | str) -> int:
    print(f"cannot start: {error}", file=sys.stderr, flush=True)
    return 1


def _end(node: Node | None) -> None:
    try:
        if node is not None:
            node.destroy_node()
    except KeyboardInterrupt:
        pass
    rclpy.try_shutdown()
