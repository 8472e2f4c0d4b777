"""The lists of topics, services and parameters are those of the running nodes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from docs.generate.ros import parameter_file
from slamfusion.ros.interface import (
    LATCHED,
    NAME_LISTS,
    PRODUCERS,
    SERVICES,
    START_NAME,
    TOPICS,
    Topic,
    node_parameters,
)
from tests.cli.command import ROOT
from tests.ros.drives import write_log
from tests.ros.live import Observer, Processes, free_domain, ros_environment

pytestmark = pytest.mark.ros

PARAMETER_FILE = ROOT / "launch_scripts" / "slamfusion.yaml"
# What every node has.
EVERYWHERE = {"/rosout", "/parameter_events", "/clock"}


@pytest.fixture(scope="module", params=["tinyslam", "fusion", "player"])
def started(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[str, Observer]]:
    """One node of each kind, started with the parameter file: its name, and who listens to it.

    The tests only ask it, so one serves all of them.
    """
    name: str = request.param
    folder = tmp_path_factory.mktemp(name)
    more = {}
    if name == "player":
        log = write_log(folder, 4)
        # Longer than the tests take: it ends when nobody comes.
        more = {"file": str(log), "wait_for": ["tinyslam"], "save": str(folder / "maps")}
        more["start_timeout_s"] = 600.0
    with pytest.MonkeyPatch.context() as patch, free_domain() as domain:
        for key, value in ros_environment(domain).items():
            patch.setenv(key, value)
        with Observer(domain) as listener, Processes(ros_environment(domain), folder) as running:
            process = running.node(name, "--params-file", str(PARAMETER_FILE), **more)
            statuses = listener.statuses()
            listener.wait(
                lambda: any(key.startswith(f"{name}: ") for key in statuses),
                60.0,
                "its diagnostics",
            )
            assert "unknown parameter" not in process.text()
            yield name, listener
            assert process.is_running


def test_the_tables_of_topics_and_services_are_those_of_a_running_node(
    started: tuple[str, Observer],
):
    own_name, listener = started
    group = "producers" if own_name in PRODUCERS else own_name
    node = listener.node

    def names(ask: Callable[[str, str], list[tuple[str, list[str]]]]) -> dict[str, str]:
        """What the node has now; nothing while it is not known yet."""
        try:
            found = ask(own_name, "/")
        except NodeNameNonExistentError:
            return {}
        return {name: re.sub("/(msg|srv)/", "/", types[0]) for name, types in found}

    def listed(topics: list[Topic]) -> dict[str, str]:
        """Rows of the table, with the names of the producers filled in."""
        who = PRODUCERS if group == "fusion" else ("tinyslam",)
        return {
            "/" + topic.name.replace("NAME", producer).lstrip("/"): topic.type
            for topic in topics
            for producer in who
        }

    for wanted, ask in (
        (
            [topic for topic in TOPICS if group in topic.writers],
            node.get_publisher_names_and_types_by_node,
        ),
        (
            [topic for topic in TOPICS if group in topic.readers],
            node.get_subscriber_names_and_types_by_node,
        ),
    ):
        # Those of transforms depend on tf2_msgs, and on parameters.
        certain = listed([topic for topic in wanted if topic.needs_tf2 is None])
        listener.wait(
            lambda ask=ask, certain=certain: certain.items() <= names(ask).items(),
            what=f"all of {certain}; there are {names(ask)}",
        )
        table = listed(wanted)
        own = {name for name in names(ask).items() if name[0] not in EVERYWHERE - {*table}}
        assert own <= table.items()

    wanted_services = {f"/{item.name}": item.type for item in SERVICES if item.node == own_name}

    def services() -> dict[str, str]:
        found = names(node.get_service_names_and_types_by_node)
        return {name: kind for name, kind in found.items() if not name.startswith(f"/{own_name}/")}

    listener.wait(lambda: services() == wanted_services, what=f"{wanted_services}")


def test_the_qualities_of_service_are_those_of_a_running_node(started: tuple[str, Observer]):
    own_name, listener = started
    group = "producers" if own_name in PRODUCERS else own_name
    for topic in TOPICS:
        # Scans and odometry are read from anybody; of the others it is said how they are written.
        is_read = topic.qos == "best effort"
        if topic.needs_tf2 is not None or group not in (
            topic.readers if is_read else topic.writers
        ):
            continue
        name = "/" + topic.name.replace("NAME", "tinyslam").lstrip("/")
        ask = listener.node.get_publishers_info_by_topic
        if is_read:
            ask = listener.node.get_subscriptions_info_by_topic

        def own(name: str = name, ask: Callable[[str], list[Any]] = ask) -> list[Any]:
            return [info.qos_profile for info in ask(name) if info.node_name == own_name]

        listener.wait(own, what=f"{name} of {own_name}")
        for profile in own():
            is_kept = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            is_best_effort = profile.reliability == ReliabilityPolicy.BEST_EFFORT
            assert (is_kept, is_best_effort) == (topic.qos == LATCHED, is_read), name


def test_the_parameters_are_those_of_a_running_node(started: tuple[str, Observer]):
    name, listener = started
    request = ListParameters.Request(depth=ListParameters.Request.DEPTH_RECURSIVE)
    answer = listener.call(ListParameters, f"/{name}/list_parameters", request)
    # Every node of rclpy has these.
    common = {"use_sim_time", "start_type_description_service"}
    found = {key for key in answer.result.names if not key.startswith("qos_overrides.")} - common
    wanted = {option.key for option in node_parameters(name)}
    wanted |= {item.name for item in NAME_LISTS.get(name, ())}
    # A parameter that has no value is not listed.
    open_ones = {option.key for option in node_parameters(name) if option.info.default is None}
    # One for each input.
    starts = {START_NAME.replace("NAME", key) for key in PRODUCERS}
    assert found <= (wanted | starts if name == "fusion" else wanted)
    assert wanted - open_ones <= found
    # Those that may be changed are listed below the table.
    names = DescribeParameters.Request(names=sorted(wanted))
    descriptors = listener.call(DescribeParameters, f"/{name}/describe_parameters", names)
    free = {one.name for one in descriptors.descriptors if not one.read_only}
    group = "producers" if name in PRODUCERS else name
    text = (ROOT / "docs/reference/ros.md").read_text(encoding="utf-8")
    listed = text.partition("while a node runs:")[2].partition(f"- {group}: ")[2]
    told = {*re.findall("`([a-z_]+)`", listed.partition("\n\n")[0].partition("\n- ")[0])}
    assert {key for key in free if not key.startswith("live.")} == told


def test_a_running_node_takes_the_values_of_the_parameter_file(
    processes: Processes, observer: Observer, tmp_path: Path
):
    """In a namespace, with values that are not the defaults; the command line has the last word."""
    changed = parameter_file()
    for old, new in (
        ("max_publish_rate_hz: 5.0", "max_publish_rate_hz: 2.5"),
        ("fused_frame: fused_map", "fused_frame: ours"),
        ("stale_after_s: 30.0", "stale_after_s: 12.5"),
    ):
        assert changed.count(old) == 1
        changed = changed.replace(old, new)
    path = tmp_path / "changed.yaml"
    path.write_text(changed)
    processes.node(
        "fusion", "-r", "__ns:=/robot1", "--params-file", str(path), "-p", "fused_frame:=mine"
    )
    client = AsyncParameterClient(observer.node, "/robot1/fusion")
    observer.wait(client.services_are_ready, 60.0, "the node")
    names = ["max_publish_rate_hz", "fused_frame", "live.stale_after_s", "inputs"]
    future = client.get_parameters(names)
    observer.wait(future.done, what="the parameters")
    rate, frame, stale, inputs = future.result().values
    assert (rate.double_value, frame.string_value, stale.double_value) == (2.5, "mine", 12.5)
    assert list(inputs.string_array_value) == [f"{name}/map" for name in PRODUCERS]
