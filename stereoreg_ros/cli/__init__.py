"""`stereoreg`: what the node does, from the shell and without ROS. One file for each command."""

from stereoreg_ros.cli.command_line import main

__all__ = ["main"]
