"""``LiveClient``: asks a running fusion node from outside, as ``ros2 service`` and ``param`` do."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from slamfusion.errors import SlamFusionError
from slamfusion.jobs.records import LiveAnswerDocument, LiveLineJson, LiveStatusDocument
from slamfusion.ros import qos
from slamfusion.ros.base import DIAGNOSTICS_TOPIC, Level
from slamfusion.ros.fusion_inputs import ENTRY, FUSION, PREFIX, entry_for
from slamfusion.ros.fusion_services import SAVE_AS
from slamfusion.ros.parameters import names_of

SPIN_S = 0.1
INPUTS = "inputs"


class LiveNodeError(SlamFusionError):
    """A node that is not there, or does not answer."""


class LiveClient:
    """A node of its own that asks; to be used in a ``with``.

    Args:
        node: name of the fusion node, with its namespace where it has one.
        timeout_s: how long to wait for it, each time.

    Raises:
        LiveNodeError: of every method: it did not answer in that time.
    """

    def __init__(self, node: str, timeout_s: float) -> None:
        self._target = "/" + node.strip("/")
        self._timeout_s = timeout_s
        self._context = Context()
        self._diagnostics: Any = None
        self._heard: list[Any] = []

    def __enter__(self) -> LiveClient:  # noqa: PYI034  (Self is newer than Python 3.10)
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        name = f"slamfusion_live_{os.getpid()}"
        self._node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def status(self) -> LiveStatusDocument:
        """Return what the node says next of itself and its inputs."""
        if self._diagnostics is None:
            self._diagnostics = self._node.create_subscription(
                DiagnosticArray, DIAGNOSTICS_TOPIC, self._keep, qos.STREAM
            )
        self._heard.clear()
        self._wait(lambda: bool(self._heard), "diagnostics")
        own = {status.name.partition(": ")[2]: status for status in self._heard[-1].status}
        inputs = [
            _line(name.removeprefix(PREFIX), status)
            for name, status in own.items()
            if name.startswith(PREFIX)
        ]
        return {"node": self._target, "fusion": _line(FUSION, own[FUSION]), "inputs": inputs}

    def call(self, service: str) -> LiveAnswerDocument:
        """Call ``save_map`` or ``reset`` and return the answer."""
        future = self._client(Trigger, service).call_async(Trigger.Request())
        self._wait(future.done, f"an answer of {service}")
        response = future.result()
        return {"success": bool(response.success), "message": str(response.message)}

    def save_as(self, **rules: str) -> LiveAnswerDocument:
        """Save the fused map and return the answer.

        Args:
            rules: path, without an ending; format (pgm, png or bmp); mode (trinary, scale or raw).
        """
        client = self._client(SetParametersAtomically, SAVE_AS)
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in rules.items()]
        future = client.call_async(SetParametersAtomically.Request(parameters=given))
        self._wait(future.done, f"an answer of {SAVE_AS}")
        result = future.result().result
        return {"success": bool(result.successful), "message": str(result.reason)}

    def set(self, name: str, value: str) -> LiveAnswerDocument:
        """Set a parameter to a value as YAML writes it, and return the answer."""
        try:
            parameter = Parameter(name, value=yaml.safe_load(value))
        except (TypeError, yaml.YAMLError) as error:
            message = f"{name}: {value!r} is no value of a parameter; wanted 1.5, true or a text"
            raise LiveNodeError(message) from error
        return self._set(parameter, f"{name} is {parameter.value!r} now")

    def add(self, name: str, topic: str | None = None) -> LiveAnswerDocument:
        """Let the node fuse one map more, and return the answer.

        Args:
            name: what the input is to be called.
            topic: of its maps, or ``file:PATH`` as the node sees it; default: ``NAME/map``.

        Raises:
            ConfigError: the name is none.
        """
        entry = entry_for(name, topic)
        entries = [*self._entries(), entry]
        return self._set(Parameter(INPUTS, value=entries), f"{name} is an input now ({entry})")

    def remove(self, name: str) -> LiveAnswerDocument:
        """Let the node fuse a map no more, and return the answer.

        Raises:
            LiveNodeError: no input is called so.
        """
        inputs = {line["name"]: line["figures"].get(ENTRY) for line in self.status()["inputs"]}
        if name not in inputs:
            message = f"{self._target}: no input {name!r}; the inputs are {', '.join(inputs)}"
            raise LiveNodeError(message)
        entries = [entry for entry in self._entries() if entry != inputs[name]]
        return self._set(Parameter(INPUTS, value=entries), f"{name} is no input any more")

    def _client(self, kind: Any, service: str) -> Any:
        """Return a client of a service in the node's namespace, when it is there."""
        folder = self._target.rpartition("/")[0]
        client = self._node.create_client(kind, f"{folder}/{service}")
        self._wait(client.service_is_ready, f"the service {folder}/{service}")
        return client

    def _entries(self) -> list[str]:
        """Return what the node fuses."""
        client = self._parameters()
        future = client.get_parameters([INPUTS])
        self._wait(future.done, f"an answer about {INPUTS}")
        (value,) = future.result().values
        given = Parameter.from_parameter_msg(ParameterMessage(name=INPUTS, value=value)).value
        return [*names_of(given)]

    def _set(self, parameter: Parameter, said: str) -> LiveAnswerDocument:
        """Set a parameter and return the answer; ``said`` where it is only yes."""
        future = self._parameters().set_parameters([parameter])
        self._wait(future.done, "an answer")
        (result,) = future.result().results
        return {"success": bool(result.successful), "message": str(result.reason) or said}

    def _parameters(self) -> AsyncParameterClient:
        """Return a client of the node's parameters, when they are there."""
        client = AsyncParameterClient(self._node, self._target)
        self._wait(client.services_are_ready, "its parameters")
        return client

    def _keep(self, message: Any) -> None:
        wanted = f"{self._target.lstrip('/')}: {FUSION}"
        if any(status.name == wanted for status in message.status):
            self._heard.append(message)

    def _wait(self, is_done: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + self._timeout_s
        while not is_done():
            if time.monotonic() > until_s:
                names = sorted(
                    f"{folder.rstrip('/')}/{name}"
                    for name, folder in self._node.get_node_names_and_namespaces()
                    if name != self._node.get_name()
                )
                raise LiveNodeError(
                    f"{self._target}: waited {self._timeout_s:g} s for {what}; running nodes: "
                    f"{', '.join(names) or 'none'} (ROS_DOMAIN_ID "
                    f"{os.environ.get('ROS_DOMAIN_ID', '0')}); name it with --node"
                )
            self._executor.spin_once(timeout_sec=SPIN_S)


def _line(name: str, status: DiagnosticStatus) -> LiveLineJson:
    """Return a line of the diagnostics."""
    return {
        "name": name,
        "level": Level(status.level[0]).name.lower(),
        "message": str(status.message),
        "figures": {item.key: item.value for item in status.values},
    }
