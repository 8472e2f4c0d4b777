"""``FrameWarnings``: what is wrong with the frames of the fused map, its inputs and the robot."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from slamfusion.config import FusionNodeConfig
from slamfusion.fusion.live.session import Believed
from slamfusion.ros.base import Diagnostics, Level

# publish_tf that has sent nothing for so long since somebody votes is named, seconds.
TF_LATE_S = 5.0


class FrameWarnings:
    """Names in the diagnostics frames that clash, rivals on a transform, and one never sent.

    Args:
        diagnostics: of the node.
    """

    def __init__(self, diagnostics: Diagnostics) -> None:
        self._diagnostics = diagnostics
        self._wanted_since_s: float | None = None

    def update(
        self,
        settings: FusionNodeConfig,
        believed: Believed,
        *,
        frames: Sequence[str],
        renamed: Mapping[str, tuple[str, str]],
        rivals: Mapping[str, str],
        other_fusion: str,
        leader: str,
        has_sent_odometry: bool,
    ) -> None:
        """Say what is wrong now, and what is right again.

        Args:
            settings: of the node.
            believed: who votes.
            frames: of the inputs' maps.
            renamed: the map's frame and the one that its transform is sent to, of inputs whose
                frame another one has.
            rivals: parents of our child frames that another node sends too, by child.
            other_fusion: name of another node that fuses into the same topic; empty without.
            leader: name of the input whose pose is taken; empty without.
            has_sent_odometry: whether fused_frame -> odom_frame was sent.
        """
        self._name_shared(frames, renamed, settings.fused_frame)
        self._say("rival", _rival_words(settings, rivals, other_fusion), Level.ERROR)
        self._name_unsent(settings, believed, leader, has_sent_odometry=has_sent_odometry)

    def _name_shared(
        self, frames: Sequence[str], renamed: Mapping[str, tuple[str, str]], fused: str
    ) -> None:
        """Name frames that two inputs share, or that are the fused one."""
        told = [
            f"{name!r} is in frame {frame!r} as another map is: its transform is sent to {child!r}"
            for name, (frame, child) in renamed.items()
        ]
        said = "; ".join([*told, "give each map a frame_id of its own"])
        self._say("shared frame", f"the map of {said}" if told else None)
        self._say(
            "own frame",
            f"an input's map is in {fused!r}, the frame of the fused map; rename one of them"
            if fused in frames
            else None,
        )

    def _name_unsent(
        self,
        settings: FusionNodeConfig,
        believed: Believed,
        leader: str,
        *,
        has_sent_odometry: bool,
    ) -> None:
        """Name that fused_frame -> odom_frame was never sent, though somebody votes."""
        has_voters = any(record.accepted for record in believed.inputs.values())
        if not (settings.publish_tf and has_voters) or has_sent_odometry:
            self._wanted_since_s = None
            self._say("unsent", None)
            return
        now_s = time.monotonic()
        if self._wanted_since_s is None:
            self._wanted_since_s = now_s
        if now_s - self._wanted_since_s < TF_LATE_S:
            return
        if settings.fused_frame == settings.odom_frame:
            why = "both are one frame; rename one of them"
        elif not leader:
            why = "no input that votes tells the robot's pose (NAME/pose beside NAME/map)"
        else:
            why = "the odometry does not tell where the robot is at the times of its poses"
        text = f"publish_tf: {settings.fused_frame} -> {settings.odom_frame} was never sent: {why}"
        self._say("unsent", text)

    def _say(self, key: str, text: str | None, level: Level = Level.WARN) -> None:
        if text is None:
            self._diagnostics.clear(key)
        else:
            self._diagnostics.add(key, level, text)


def _rival_words(
    settings: FusionNodeConfig, rivals: Mapping[str, str], other_fusion: str
) -> str | None:
    """Say who else sends one of our transforms, and what to do; None where nobody does."""
    if not rivals:
        return None
    child = settings.odom_frame if settings.odom_frame in rivals else next(iter(rivals))
    words = f"another node sends the transform to {child!r} too (from {rivals[child]!r}): "
    if other_fusion:
        return words + f"the other fusion is {other_fusion!r}; end one of the two"
    if child == settings.odom_frame:
        return words + "set publish_tf to false in all but one"
    return words + "end one of them, or give the frames of each robot names of their own"
