"""Find the kernel sources, build them once per device, keep the kernel objects."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.layout import kernel_options
from slamfusion.errors import DeviceError

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


def kernel_source(folder: Path) -> str:
    """Return the source of all kernels with the headers that they include written out.

    It is one program, since PoCL reads the OpenCL header of 1 MB anew for each program that it
    finds in its cache. No path stands in it, which that cache goes by: what one installation built,
    every other one of equal sources has.

    Args:
        folder: of the .cl files, one for each family.
    """
    families = sorted(path.stem for path in folder.glob("*.cl"))
    return "\n".join(_family_source(folder, family) for family in families)


def _family_source(folder: Path, family: str) -> str:
    """Return the source of a family; a compiler's complaint names its files and lines.

    Arithmetic is as in a program that begins: what the family before it asked for has ended.
    """
    source = (folder / f"{family}.cl").read_text(encoding="utf-8")

    def write_out(found: re.Match[str]) -> str:
        header = (folder / found[1]).read_text(encoding="utf-8")
        next_line = source.count("\n", 0, found.end()) + 2
        return f'#line 1 "{found[1]}"\n{header}\n#line {next_line} "{family}.cl"'

    begin = f'#pragma OPENCL FP_CONTRACT ON\n#line 1 "{family}.cl"\n'
    return begin + INCLUDE.sub(write_out, source)


class KernelProgram:
    """All kernels, built for one device; a kernel object is fetched once and kept."""

    def __init__(self, context: Any, device: Any, options: tuple[str, ...] = ()) -> None:
        """Build every kernel; a compiler's complaint becomes one DeviceError.

        Args:
            context, device: pyopencl's own.
            options: of the compiler, beside the constants of ``layout``.
        """
        source = kernel_source(kernel_folder())
        self.options = ("-w", *kernel_options(), *options)
        LOG.debug("kernels are built with %s", " ".join(self.options))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                program = cl.Program(context, source).build(
                    options=list(self.options), devices=[device]
                )
        except cl.Error as error:
            words = " ".join(str(error).split())[:400]
            message = f"the kernels do not build on {device.name.strip()}: {words}"
            raise DeviceError(message) from error
        self._kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        self._typed: set[str] = set()

    def kernel(self, name: str, arguments: Sequence[Any]) -> Any:
        """Return the kernel object of that name.

        Args:
            name: of the kernel.
            arguments: of a launch. The types of the numbers among them are those of every launch:
                pyopencl is told them once, as it takes 4 us to find out that of each number.
        """
        kernel = self._kernels[name]
        if name not in self._typed:
            types = [type(item) if isinstance(item, np.generic) else None for item in arguments]
            kernel.set_scalar_arg_dtypes(types)
            self._typed.add(name)
        return kernel
