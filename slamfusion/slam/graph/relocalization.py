"""Where a lost robot may be: several guesses, each tested as it drives on, until one is left.

Rooms look alike. A place where a scan fits is a guess; so is every other place where one fits. Each
guess says where the next scans must fit too. One that is right goes on fitting; one that is not
fails where the look-alikes differ. The robot is found when a guess has been borne out on a way and
no other is left, and every old submap has been looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.slam.graph.closure_search import AGREEMENT_M, AGREEMENT_RAD, Waiting

__all__ = ["Guess", "Relocation"]

# A guess is believed after so many nodes that fit, over such a way in metres.
HITS, WAY_M = 14, 4.0
# It is given up after so many misses in a row. One that has fewer hits, or less than a share of the
# best one's, is no rival: where it has the robot now there is nothing to test it on.
MISSES = 3
RIVAL_HITS, RIVAL_SHARE = 2, 0.4
# Guesses that are tested at a node, and that are kept.
TESTED = 2
MOST_GUESSES = 12


@dataclass(eq=False)
class Guess:
    """Where the robot's part may lie.

    Attributes:
        correction: what would move the part there, in the map frame.
        hits: closures that say so.
        misses: tests in a row that it has failed.
        tested: node at which it was tested last.
    """

    correction: Pose2
    hits: list[Waiting] = field(default_factory=list)
    misses: int = 0
    tested: int = -1

    def is_borne_out(self) -> bool:
        """Return whether enough scans have fitted on a long enough way."""
        nodes = {hit.edge.end for hit in self.hits}
        travelled = [hit.travelled_m for hit in self.hits]
        return len(nodes) >= HITS and max(travelled) - min(travelled) >= WAY_M


class Relocation:
    """The guesses about one lost robot.

    Attributes:
        guesses: that are not given up.
    """

    def __init__(self) -> None:
        self.guesses: list[Guess] = []

    def to_test(self) -> list[Guess]:
        """Return the guesses whose turn it is."""
        return sorted(self.guesses, key=lambda guess: guess.tested)[:TESTED]

    def add(self, hit: Waiting, pose: Pose2) -> Guess:
        """Take a closure as a hit of the guess that says the same, or of a new one.

        Args:
            hit: the closure.
            pose: of its node in the map frame, before any correction.
        """
        place = hit.correction.compose(pose)
        for guess in self.guesses:
            if _is_near(guess.correction.compose(pose), place):
                break
        else:
            guess = Guess(hit.correction)
            self.guesses.append(guess)
        guess.hits.append(hit)
        guess.correction, guess.misses = hit.correction, 0
        if len(self.guesses) > MOST_GUESSES:
            self.guesses.remove(min(self.guesses, key=lambda one: len(one.hits)))
        return guess

    def miss(self, guess: Guess) -> None:
        """Count that a scan did not fit where a guess says that it must."""
        guess.misses += 1
        if guess.misses >= MISSES and guess in self.guesses:
            self.guesses.remove(guess)

    def winner(self) -> Guess | None:
        """Return the guess that is borne out and has no rival left."""
        if not self.guesses:
            return None
        best = max(self.guesses, key=lambda guess: len(guess.hits))
        enough = max(RIVAL_HITS, RIVAL_SHARE * len(best.hits))
        has_rival = any(len(guess.hits) >= enough for guess in self.guesses if guess is not best)
        return best if best.is_borne_out() and not has_rival else None


def _is_near(one: Pose2, other: Pose2) -> bool:
    """Return whether two poses are one place."""
    away = math.hypot(one.x - other.x, one.y - other.y)
    return away < AGREEMENT_M and abs(wrap_angle(one.yaw_rad - other.yaw_rad)) < AGREEMENT_RAD
