"""Find the kernel sources, build them once per device, keep the kernel objects."""

from __future__ import annotations

import logging
import re
import warnings
from pathlib import Path
from typing import Any

import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.compute_device import FAMILIES
from slamfusion.compute.layout import kernel_options
from slamfusion.errors import DeviceError

__all__ = ["KernelProgram", "kernel_folder"]

LOG = logging.getLogger(__name__)
INCLUDE = re.compile(r'^#include "([\w.]+)"$', flags=re.MULTILINE)


def kernel_folder() -> Path:
    """Return the folder of the .cl files: inside the wheel, or beside an editable checkout.

    Raises:
        DeviceError: neither place has them.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.h").is_file():
            return folder
    message = f"no kernel sources in {package / 'kernels'} or beside it; reinstall slamfusion"
    raise DeviceError(message)


def family_source(folder: Path, family: str) -> str:
    """Return the source of a kernel family with the headers that it includes written out.

    The compiler then needs no path, which PoCL's cache goes by: what one installation built, every
    other one of equal sources has.

    Args:
        folder: of the .cl files.
        family: name of one, without its suffix.
    """
    source = (folder / f"{family}.cl").read_text(encoding="utf-8")
    return INCLUDE.sub(lambda found: (folder / found[1]).read_text(encoding="utf-8"), source)


class KernelProgram:
    """All kernel families, built for one device; a kernel object is fetched once and kept."""

    def __init__(self, context: Any, device: Any, options: tuple[str, ...] = ()) -> None:
        """Build every family; a compiler's complaint becomes one DeviceError.

        Args:
            context, device: pyopencl's own.
            options: of the compiler, beside the constants of ``layout``.
        """
        folder = kernel_folder()
        self.options = ("-w", *kernel_options(), *options)
        LOG.debug("kernels are built with %s", " ".join(self.options))
        self._kernels: dict[str, Any] = {}
        for family in FAMILIES:
            source = family_source(folder, family)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", cl.CompilerWarning)
                    program = cl.Program(context, source).build(
                        options=list(self.options), devices=[device]
                    )
            except cl.Error as error:
                words = " ".join(str(error).split())[:400]
                message = f"{family}.cl does not build on {device.name.strip()}: {words}"
                raise DeviceError(message) from error
            for kernel in program.all_kernels():
                self._kernels[kernel.function_name] = kernel

    def __getitem__(self, name: str) -> Any:
        """Return the kernel object of that name."""
        return self._kernels[name]
