"""``LiveClient``: requests to a running fusion node, as ``ros2 service`` and ``param`` make."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from typing import Any

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from slamfusion.errors import SlamFusionError
from slamfusion.io.yaml_file import Loader
from slamfusion.jobs.records import LiveAnswerDocument, LiveLineJson, LiveStatusDocument
from slamfusion.ros import qos
from slamfusion.ros.base import DIAGNOSTICS_TOPIC, Level
from slamfusion.ros.fusion_inputs import ENTRY, FUSION, PREFIX, entry_for, input_names
from slamfusion.ros.fusion_services import SAVE_AS
from slamfusion.ros.interface import INPUTS
from slamfusion.ros.parameters import names_of

SPIN_S = 0.1


class LiveNodeError(SlamFusionError):
    """A node that is missing or does not answer."""


class LiveClient:
    """A client node, for a ``with`` block.

    Every method raises LiveNodeError if ``node`` (with its namespace) does not answer in time.
    """

    def __init__(self, node: str, timeout_s: float) -> None:
        self._target = "/" + node.strip("/")
        self._timeout_s = timeout_s
        self._context = Context()
        self._heard: list[Any] = []

    def __enter__(self) -> LiveClient:  # noqa: PYI034  (Self is newer than Python 3.10)
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        name = f"slamfusion_live_{os.getpid()}"
        self._node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, DIAGNOSTICS_TOPIC, self._keep, qos.STREAM)
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def status(self) -> LiveStatusDocument:
        """Return the next status of the node and its inputs."""
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
        response = self._ask(Trigger, self._sibling(service), Trigger.Request())
        return _answer(response.success, response.message)

    def save_as(self, **rules: str) -> LiveAnswerDocument:
        """Save the fused map with path (no ending), format and mode, and return the answer."""
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in rules.items()]
        request = SetParametersAtomically.Request(parameters=given)
        result = self._ask(SetParametersAtomically, self._sibling(SAVE_AS), request).result
        return _answer(result.successful, result.reason)

    def set(self, name: str, value: str) -> LiveAnswerDocument:
        """Set a parameter to a value in YAML, else to the text, and return the answer."""
        try:
            given = Loader(value).get_single_data() if value else value
            parameter = Parameter(name, value=given)
        except (TypeError, yaml.YAMLError):  # such as */map, or a date
            parameter = Parameter(name, value=value)
        return self._set(parameter, f"{name} is {parameter.value!r} now")

    def add(self, name: str, topic: str | None = None) -> LiveAnswerDocument:
        """Add an input, and return the answer; ConfigError for an invalid name.

        ``topic``: of its maps, or ``file:PATH`` as the node sees it; default: ``NAME/map``.
        """
        entry = entry_for(name, topic)
        parameter = Parameter(INPUTS.name, value=[*self._entries(), entry])
        (called,) = input_names([entry])
        return self._set(parameter, f"{called} is an input now ({entry})")

    def remove(self, name: str) -> LiveAnswerDocument:
        """Remove an input, and return the answer; LiveNodeError for an unknown name."""
        inputs = {line["name"]: line["figures"].get(ENTRY) for line in self.status()["inputs"]}
        if name not in inputs:
            message = f"{self._target}: no input {name!r}; the inputs are {', '.join(inputs)}"
            raise LiveNodeError(message)
        entries = [entry for entry in self._entries() if entry != inputs[name]]
        return self._set(Parameter(INPUTS.name, value=entries), f"{name} is no input any more")

    def _sibling(self, service: str) -> str:
        return f"{self._target.rpartition('/')[0]}/{service}"

    def _ask(self, kind: Any, service: str, request: Any) -> Any:
        client = self._node.create_client(kind, service)
        self._wait(
            lambda: self._target in self._servers(service) and client.service_is_ready(),
            f"the service {service}",
        )
        # One that was killed is known for half a minute, next to one that has its name.
        if len(servers := dict.fromkeys(self._servers(service))) > 1:
            message = (
                f"{service} is a service of {' and '.join(servers)}, and either could "
                "answer; start each fusion in a namespace of its own: -r __ns:=/NAME"
            )
            raise LiveNodeError(message)
        future = client.call_async(request)
        self._wait(future.done, f"an answer of {service}")
        return future.result()

    def _nodes(self) -> list[tuple[str, str, str]]:
        """Return the full name, name and namespace of the other nodes."""
        return sorted(
            (f"{folder.rstrip('/')}/{name}", name, folder)
            for name, folder in self._node.get_node_names_and_namespaces()
            if name != self._node.get_name()
        )

    def _servers(self, service: str) -> list[str]:
        """Return the nodes that offer a service: its name does not name the node."""
        servers = []
        for full_name, *name in self._nodes():
            with contextlib.suppress(NodeNameNonExistentError):  # it has just ended
                if service in dict(self._node.get_service_names_and_types_by_node(*name)):
                    servers.append(full_name)
        return servers

    def _entries(self) -> list[str]:
        request = GetParameters.Request(names=[INPUTS.name])
        (value,) = self._ask(GetParameters, f"{self._target}/get_parameters", request).values
        return [*names_of(parameter_value_to_python(value))]

    def _set(self, parameter: Parameter, done: str) -> LiveAnswerDocument:
        """Set a parameter and return the answer; ``done`` if it has no text."""
        request = SetParameters.Request(parameters=[parameter.to_parameter_msg()])
        (result,) = self._ask(SetParameters, f"{self._target}/set_parameters", request).results
        return _answer(result.successful, result.reason or done)

    def _keep(self, message: Any) -> None:
        wanted = f"{self._target.lstrip('/')}: {FUSION}"
        if any(status.name == wanted for status in message.status):
            self._heard.append(message)

    def _wait(self, is_done: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + self._timeout_s
        while not is_done():
            if time.monotonic() > until_s:
                names = [full_name for full_name, *_ in self._nodes()]
                domain = f"(ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID', '0')})"
                advice = f"no node runs {domain}; start the fusion, or set its ROS_DOMAIN_ID"
                if names:
                    advice = f"running nodes: {', '.join(names)} {domain}; name it with --node"
                if self._target in names:
                    advice = "it runs, but is no fusion node or is still starting; try again, or "
                    advice += f"name another with --node: {', '.join(names)} {domain}"
                message = f"{self._target}: waited {self._timeout_s:g} s for {what}; {advice}"
                raise LiveNodeError(message)
            self._executor.spin_once(timeout_sec=SPIN_S)


def _answer(is_done: object, message: object) -> LiveAnswerDocument:
    return {"success": bool(is_done), "message": str(message)}


def _line(name: str, status: DiagnosticStatus) -> LiveLineJson:
    return {
        "name": name,
        "level": Level(status.level[0]).name.lower(),
        "message": str(status.message),
        "figures": {item.key: item.value for item in status.values},
    }
