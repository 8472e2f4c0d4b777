"""The producers by name: how each one comes into being, with its settings, fresh or resumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import Resumable
from slamfusion.slam.gmapping import Gmapping
from slamfusion.slam.graph import GraphSlam
from slamfusion.slam.tinyslam import TinySlam

__all__ = [
    "PRODUCERS",
    "Producer",
    "make_producer",
    "open_producer_device",
    "resume_producer",
]


@dataclass(frozen=True)
class Producer:
    """How a producer comes into being.

    Attributes:
        make: with its settings and an empty map.
        resume: from a file of ``Resumable.save_state``, with the settings and the seed that it was
            made with; None for a producer that cannot. Raises SlamFusionError for another file.
        small_kernels: what its device is to be good at, see ``open_device``.
    """

    make: Callable[[RunConfig, ComputeDevice], Mapper]
    resume: Callable[[Path, RunConfig, ComputeDevice], Resumable] | None = None
    small_kernels: bool = False


def _gmapping(config: RunConfig, device: ComputeDevice) -> Resumable:
    return Gmapping(config.gmapping, device, config.seed)


def _resumed_gmapping(path: Path, config: RunConfig, device: ComputeDevice) -> Resumable:
    return Gmapping.load_state(path, config.gmapping, device, config.seed)


def _graph(config: RunConfig, device: ComputeDevice) -> Resumable:
    return GraphSlam(config.graph, device, config.seed)


def _resumed_graph(path: Path, config: RunConfig, device: ComputeDevice) -> Resumable:
    return GraphSlam.load_state(path, config.graph, device, config.seed)


# Every producer; its name is also the section of its settings.
PRODUCERS: dict[str, Producer] = {
    "tinyslam": Producer(
        lambda config, device: TinySlam(config.tinyslam, device, config.seed), small_kernels=True
    ),
    "gmapping": Producer(_gmapping, _resumed_gmapping),
    "graph": Producer(_graph, _resumed_graph, small_kernels=True),
}


def open_producer_device(name: str, config: RunConfig) -> ComputeDevice:
    """Return the device for a producer that has a process to itself.

    Raises:
        SlamFusionError: there is no producer of this name; the known ones are named.
        DeviceError: see ``open_device``.
    """
    return open_device(config.device.device, small_kernels=_producer(name).small_kernels)


def make_producer(name: str, config: RunConfig, device: ComputeDevice) -> Mapper:
    """Return a producer of ``PRODUCERS`` with its settings and an empty map.

    Raises:
        SlamFusionError: there is none of this name; the known ones are named.
    """
    return _producer(name).make(config, device)


def resume_producer(name: str, path: Path, config: RunConfig, device: ComputeDevice) -> Resumable:
    """Return a producer of ``PRODUCERS`` in the state that a file holds.

    Args:
        name: the producer.
        path: written by its ``save_state``.
        config: with the settings and the seed that the state was made with.
        device: where it computes from now on.

    Raises:
        SlamFusionError: there is no such producer, it cannot go on from a file, or the file is
            damaged or made with other settings.
        OSError: the file cannot be read.
    """
    resume = _producer(name).resume
    if resume is None:
        able = ", ".join(key for key, value in PRODUCERS.items() if value.resume is not None)
        message = f"{name} cannot go on from a saved state; wanted one of {able or '(none)'}"
        raise SlamFusionError(message)
    return resume(path, config, device)


def _producer(name: str) -> Producer:
    if name not in PRODUCERS:
        message = f"no producer {name!r}; wanted one of {', '.join(PRODUCERS)}"
        raise SlamFusionError(message)
    return PRODUCERS[name]
