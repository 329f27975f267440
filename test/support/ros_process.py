"""Support for tests over DDS: a node as a process of its own, and a client that waits with deadlines, never blindly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from filecmp import cmp
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGE = "stereoreg_ros"
# For what takes a second or two, beside whatever else the machine does: an end to wait for, not a measure.
DEADLINE_S = 90.0
_QUEUE = QoSProfile(depth=1000)

# One domain per test run and nothing beyond this machine, so that neither other runs nor robots take part.
ROS_ENVIRONMENT = {
    "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
}

T = TypeVar("T")
NodeType = TypeVar("NodeType", bound=Node)


def command_of(executable: str) -> list[str]:
    """How `ros2 run` would start an executable: from the install folder here, or from a sourced workspace.

    Where nothing is built, or it was built for another Python or before the source tree was last changed, the module of
    this source tree runs instead.
    """
    place = Path("lib") / PACKAGE / executable
    prefix = REPOSITORY / "install" / PACKAGE
    installed = prefix / place
    if installed.is_file() and _python_of(installed).parent == Path(sys.executable).parent and _is_up_to_date(prefix):
        source = 'source "$1" && shift && exec "$@"'
        return ["bash", "-c", source, "bash", str(REPOSITORY / "install" / "setup.bash"), str(installed)]
    for sourced in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if sourced and (Path(sourced) / place).is_file():
            return [str(Path(sourced) / place)]
    (module,) = (REPOSITORY / PACKAGE / "nodes").rglob(f"{executable}.py")
    return [sys.executable, "-m", ".".join(module.relative_to(REPOSITORY).with_suffix("").parts)]


def _python_of(script: Path) -> Path:
    """The Python that a script's first line names."""
    return Path(script.read_text().splitlines()[0].removeprefix("#!"))


def _is_up_to_date(prefix: Path) -> bool:
    """Whether what is installed there has been made of the source tree as it is."""
    sources = sorted((REPOSITORY / PACKAGE).rglob("*.py"))
    copies = sorted(prefix.glob(f"lib/python*/site-packages/{PACKAGE}/**/*.py"))
    return len(copies) == len(sources) and all(map(partial(cmp, shallow=False), sources, copies))


class NodeProcess:
    """A node that runs in a process group of its own, its output kept in a file.

    within: what its command begins with, where it runs elsewhere than a test's own processes.
    """

    def __init__(
        self,
        executable: str,
        *arguments: str,
        env: Mapping[str, str] | None = None,
        within: Sequence[str] = (),
    ) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        self.name = executable
        self._process = subprocess.Popen(
            [*within, *command_of(executable), *arguments],
            cwd=REPOSITORY,
            env={**os.environ, **ROS_ENVIRONMENT, "PYTHONUNBUFFERED": "1", **(env or {})},
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def output(self) -> str:
        """Everything the process has written so far."""
        # Not by reading on from the file's position: the process writes at that very position.
        descriptor = self._log.fileno()
        return os.pread(descriptor, os.fstat(descriptor).st_size, 0).decode(errors="replace")

    @property
    def pid(self) -> int:
        """Of the node, as whatever starts it gives way to it."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    def stop(self, with_signal: signal.Signals = signal.SIGINT, deadline_s: float = 20.0) -> tuple[int, float]:
        """End the process by a signal; returns its exit code and the seconds it took, AssertionError if too long."""
        begun = time.monotonic()
        self._process.send_signal(with_signal)
        return self.wait(deadline_s), time.monotonic() - begun

    def wait(self, deadline_s: float = DEADLINE_S) -> int:
        """Exit code of a process that ends by itself."""
        try:
            return self._process.wait(deadline_s)
        except subprocess.TimeoutExpired:
            self.kill()
            raise AssertionError(f"{self.name} did not end within {deadline_s:g} s:\n{self.output}") from None

    def kill(self) -> None:
        """End the whole process group at once."""
        if self.running:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """Kill what still runs and let go of the output."""
        self.kill()
        self._log.close()


@contextmanager
def node_process(
    executable: str, *arguments: str, env: Mapping[str, str] | None = None, within: Sequence[str] = ()
) -> Iterator[NodeProcess]:
    """Run a node; at the end SIGINT must end it with exit code 0. On a failure its output is printed."""
    process = NodeProcess(executable, *arguments, env=env, within=within)
    try:
        yield process
        if process.running:
            code, _ = process.stop()
            assert code == 0, f"{executable} ended with exit code {code}"
    except BaseException:
        print(f"--- output of {executable}\n{process.output}---")
        raise
    finally:
        process.close()


@contextmanager
def _making_nodes() -> Iterator[None]:
    """The first node of a process imports a parser of interface files that needs a module which Python is to lose."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "module 'sre_", DeprecationWarning)
        yield


@contextmanager
def node_here(make: Callable[[], NodeType]) -> Iterator[NodeType]:
    """A node in this process, to be looked into."""
    os.environ.update(ROS_ENVIRONMENT)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with _making_nodes():
            node = make()
        yield node
        node.destroy_node()
    finally:
        rclpy.shutdown()


class RosClient:
    """A ROS node in this process, with a context of its own, that sends, receives and calls."""

    def __init__(self, name: str = "test_client", namespace: str | None = None) -> None:
        os.environ.update(ROS_ENVIRONMENT)
        self._context = Context()
        rclpy.init(context=self._context)
        with _making_nodes():
            self.node = Node(
                name, context=self._context, namespace=namespace, enable_rosout=False, start_parameter_services=False
            )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers: dict[str, Publisher] = {}
        self._clients: dict[str, Any] = {}

    def __enter__(self) -> RosClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave ROS."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for(self, look: Callable[[], T], what: str, deadline_s: float = DEADLINE_S) -> T:
        """Serve ROS until `look` returns something true, and return that; AssertionError after the deadline."""
        end = time.monotonic() + deadline_s
        while not (found := look()):
            left = end - time.monotonic()
            assert left > 0, f"waited {deadline_s:g} s in vain for {what}"
            self._executor.spin_once(timeout_sec=min(left, 0.1))
        return found

    def collect(self, message_type: type, topic: str) -> list[Any]:
        """Subscribe; the list returned grows by every message."""
        messages: list[Any] = []
        subscription = self.node.create_subscription(message_type, topic, messages.append, _QUEUE)
        self.wait_for(subscription.get_publisher_count, f"a publisher of {topic}")
        return messages

    def announce(self, topic: str, message_type: type) -> Publisher:
        """Become a publisher of a topic that somebody listens to."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(message_type, topic, _QUEUE)
        self.wait_for(self._publishers[topic].get_subscription_count, f"a subscriber of {topic}")
        return self._publishers[topic]

    def publish(self, topic: str, message: Any) -> None:
        """Publish, once somebody listens."""
        self.announce(topic, type(message)).publish(message)

    def unpublish(self, topic: str) -> None:
        """Withdraw as publisher of a topic."""
        self.node.destroy_publisher(self._publishers.pop(topic))

    def client_of(self, service_type: Any, service: str, deadline_s: float = DEADLINE_S) -> Any:
        """The client of a service that is there, the same one for every call."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(service_type, service)
        client = self._clients[service]
        self.wait_for(client.service_is_ready, f"service {service}", deadline_s)
        return client

    def call(
        self,
        service_type: Any,
        service: str,
        request: Any = None,
        deadline_s: float = DEADLINE_S,
        again_after_s: float | None = 5.0,
    ) -> Any:
        """Call a service and return its response.

        The response to a client that the server has discovered only in part is lost
        (https://github.com/ros2/rmw_fastrtps/issues/842), which happens to new clients under load. The call is
        therefore made once more where no response has come by then; again_after_s: None where it must not be.
        """
        client = self.client_of(service_type, service, deadline_s)
        end, calls = time.monotonic() + deadline_s, [client.call_async(request or service_type.Request())]

        def answered() -> list[Any]:
            return [call for call in calls if call.done()]

        if again_after_s is not None:
            with suppress(AssertionError):
                self.wait_for(answered, "", again_after_s)
            if not answered():
                calls.append(client.call_async(request or service_type.Request()))
        self.wait_for(answered, f"the response of {service}", end - time.monotonic())
        for call in calls:
            client.remove_pending_request(call)
        return answered()[0].result()

    def set_parameters(self, node: str, **values: Any) -> SetParametersResult:
        """Set parameters of another node, all or none."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result

    def get_parameters(self, node: str, *names: str) -> list[Any]:
        """Values of another node's parameters."""
        response = self.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names))
        return [parameter_value_to_python(value) for value in response.values]

    def describe_parameters(self, node: str, *names: str) -> list[Any]:
        """Descriptors of another node's parameters."""
        request = DescribeParameters.Request(names=names)
        return list(self.call(DescribeParameters, f"{node}/describe_parameters", request).descriptors)
