"""``slamfusion doctor``: what is installed, whether it computes, what to install."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from slamfusion.cli.devices import print_devices
from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import print_json, print_table
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.jobs.tool_records import DoctorDocument


@click.command("doctor")
@with_config("device")
@common_options
def command(config: RunConfig, as_json: bool) -> int:
    """Check this installation: versions, devices, and a test of three kernels."""
    from slamfusion.jobs.doctor import check_installation  # noqa: PLC0415

    document = check_installation(config)
    if as_json:
        print_json(document)
    else:
        _print(document)
    if document["problems"]:
        raise SlamFusionError("; ".join(document["problems"]))
    return 0


def _print(document: DoctorDocument) -> None:
    """Print what was found as tables."""
    rows = [[name, version or "absent"] for name, version in document["versions"].items()]
    print_table(("package ", "version "), rows)
    print_devices(document["devices"])
    if document["pocl"] is not None:
        print(f"PoCL: {document['pocl'].detail}")
    tests = document["self_test"]
    failed = [test for test in tests if not test["passed"]]
    if failed:
        print_table(
            ("failed self test ",),
            [[test["name"]] for test in failed],
            notes=[test["detail"] for test in failed],
            title=f"{len(failed)} of {len(tests)} self tests failed on {document['device']}",
        )
    else:
        print(f"kernels: all {len(tests)} self tests passed on {document['device']}")
    print_table(("for ", "install "), [list(item) for item in document["install"].items()])
