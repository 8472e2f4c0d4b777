"""People who walk to and fro: discs in the laser's plane."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from slamfusion.config import PersonConfig
from slamfusion.geometry import F64, travelled
from slamfusion.sim.route import FreeSpace

# A walker's clearance from walls, and the discs at knee or chest height.
PERSON_RADIUS_M = 0.25
LEG_RADIUS_M = 0.07
LEG_APART_M = 0.22
BODY_RADIUS_M = 0.22
STRIDE_M = 1.4
SWING_M = 0.25
# A person stands still rather than come nearer to the robot than this.
DISTANCE_M = 0.7
# Least distance between the two places of one person.
WALK_M = 3.0


def draw_people(space: FreeSpace, count: int, rng: np.random.Generator) -> tuple[PersonConfig, ...]:
    """Draw people who walk between two places each."""
    people = []
    for _ in range(count):
        pairs = [(space.any_place(rng), space.any_place(rng)) for _ in range(8)]
        far = [pair for pair in pairs if math.dist(*pair) >= WALK_M]
        speed_mps = round(float(rng.uniform(0.7, 1.3)), 3)
        people.append(PersonConfig((far or pairs)[0], speed_mps=speed_mps))
    return tuple(people)


def walk(
    people: Sequence[PersonConfig], space: FreeSpace, robot: F64, step_s: float
) -> tuple[F64, F64]:
    """Walk people along their paths; they wait near the robot, (N, 2) metres, one row a step.

    Returns:
        (N, D, 2) float64 centres of the discs (two legs, or one body) at each of N steps, metres,
        map frame; and (D,) float64 radii.
    """
    discs, radii = [], []
    for number, person in enumerate(people, start=1):
        way = _there_and_back(person, space, f"waypoint of person {number}")
        along = _paced(way, person, robot, step_s)
        centre, heading = _on(way, along)
        if person.body == "disc":
            discs.append(centre)
            radii.append(BODY_RADIUS_M)
            continue
        ahead = np.stack((np.cos(heading), np.sin(heading)), axis=1)
        left = np.stack((-ahead[:, 1], ahead[:, 0]), axis=1)
        swing = SWING_M * np.sin(along * math.tau / STRIDE_M)[:, None]
        for side in (1.0, -1.0):
            discs.append(centre + side * (left * LEG_APART_M / 2.0 + ahead * swing))
            radii.append(LEG_RADIUS_M)
    if not discs:
        return np.empty((len(robot), 0, 2)), np.empty(0)
    return np.stack(discs, axis=1), np.array(radii)


def _there_and_back(person: PersonConfig, space: FreeSpace, what: str) -> F64:
    stops = person.waypoints
    if len(stops) == 1:
        space.place(stops[0], what)
        return np.array([stops[0]])
    ways = [space.way(a, b, what) for a, b in itertools.pairwise(stops)]
    there = np.concatenate([ways[0], *(way[1:] for way in ways[1:])])
    return np.concatenate((there, there[-2::-1]))


def _paced(way: F64, person: PersonConfig, robot: F64, step_s: float) -> F64:
    """Return the distance walked at each step, (N,) metres."""
    walked = np.zeros(len(robot))
    if len(way) < 2:
        return walked
    lengths = travelled(way)
    along, pace_m = 0.0, person.speed_mps * step_s
    for n in range(1, len(robot)):
        at = (along + pace_m) % float(lengths[-1])
        x, y = (float(np.interp(at, lengths, way[:, axis])) for axis in (0, 1))
        if math.hypot(x - robot[n, 0], y - robot[n, 1]) >= DISTANCE_M:
            along += pace_m
        walked[n] = along
    return walked


def _on(way: F64, along: F64) -> tuple[F64, F64]:
    """Return place (N, 2) and heading (N,) at distances along a closed path."""
    if len(way) < 2:
        return np.repeat(way, len(along), axis=0), np.zeros(len(along))
    lengths = travelled(way)
    at = along % lengths[-1]
    centre = np.stack([np.interp(at, lengths, way[:, axis]) for axis in (0, 1)], axis=1)
    piece = np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, len(way) - 2)
    step = way[piece + 1] - way[piece]
    return centre, np.asarray(np.arctan2(step[:, 1], step[:, 0]))
