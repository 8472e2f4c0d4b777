"""What a map must not be."""

from __future__ import annotations

from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig
from slamfusion.fusion.live.limits import unusable
from tests.fusion.drawings import draw

RULES = NormalizeConfig()


def test_too_few_walls_say_nothing(device: ComputeDevice) -> None:
    assert "unknown" in (unusable(draw("   \n   "), RULES) or "")
    assert "23 of the 24" in (unusable(draw("#" * 23 + "."), RULES) or "")
    assert unusable(draw("#" * 24 + "\n" + 2 * ("." * 24 + "\n")), RULES) is None
    assert "0 of the 24" in (unusable(draw("?" * 40), RULES) or "")
    assert device.name
