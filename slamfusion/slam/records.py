"""What a JSON document says of a producer's run: typed records, made by ``to_json`` methods.

The text below a key is its meaning and unit; the published JSON Schema carries it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

from slamfusion.io.log import LogRecord, SkipJson


class FilterJson(TypedDict):
    """How well a particle filter is doing."""

    best_score: float | None
    """Of the best particle at the last filter step: sum over its hits, each 0 to 1."""
    filter_steps: int
    """Times that the particles were weighed and mapped."""
    resamplings: int
    """Times that the particles were resampled."""
    resamplings_for_memory: int
    """Of these, the ones that the memory budget asked for."""
    rejected: int
    """Matches of single particles below minimumScore."""
    path_entropy: float | None
    """Mean over the path of the entropy of the particles' pose, nats."""
    tiles_owned: int
    """Tiles of the maps that one particle uses alone."""
    tiles_shared: int
    """Tiles that several particles use."""


class GraphJson(TypedDict):
    """How well a pose graph of submaps is doing."""

    nodes: int
    """Scans that became nodes."""
    submaps: int
    """Submaps, each of which holds some of the nodes."""
    restarts: int
    """Times that tracking was lost and a new submap was started."""
    breaks: int
    """Times that tracking failed for a while and only odometry bridges the gap."""
    refound: int
    """Times that the robot was relocalized on submaps of before."""
    parts: int
    """Parts of the map that nothing but odometry holds together; 1 for a whole map."""
    closures_tried: int
    """Searches of an older submap."""
    closures_accepted: int
    """Of these, the ones that became an edge."""
    closures_rejected: Mapping[str, int]
    """Of these, the others, by reason."""
    closures_doubted: int
    """Edges that the last solution left less than half of their weight."""
    largest_correction_m: float
    """How far a closure has moved the robot at most, metres."""
    pauses: int
    """Times that no scan came for long."""
    longest_pause_s: float
    """The longest of them, seconds."""
    chi2: float | None
    """Chi-square of the graph after the last solution; null before the first."""
    solutions: int
    """How often the graph was solved."""
    solve_s: float | None
    """Duration of the last solution, seconds; null before the first."""


class _HealthJson(TypedDict):
    scans: int
    """Scans fed so far."""
    scans_used: int
    """Of these, the ones that were matched or mapped."""
    match_score: float | None
    """Share of the last matched scan's hits that fell on known walls, 0 to 1."""
    mean_match_score: float | None
    """Mean of it over every matched scan."""
    low_scores: int
    """Matched scans whose score was below half of the mean so far."""
    n_eff: float | None
    """Effective number of particles; null where there are none."""
    skipped: Sequence[SkipJson]
    """Scans that were not used, by reason."""


class HealthJson(_HealthJson, total=False):
    """How well a producer is doing; each kind of producer may add keys of its own."""

    filter: FilterJson
    """Of a producer with a particle filter."""
    graph: GraphJson
    """Of a producer with a pose graph."""


class MapSizeJson(TypedDict):
    """Size of a map."""

    width: int
    """Columns."""
    height: int
    """Rows."""
    resolution: float
    """Metres per cell."""


class TimePerScanJson(TypedDict):
    """Time that a producer took for a scan, nothing else in it; milliseconds."""

    mean: float
    """Mean, milliseconds."""
    p50: float
    """Median, milliseconds."""
    p95: float
    """95th percentile, milliseconds."""
    p99: float
    """99th percentile, milliseconds."""
    p999: float
    """99.9th percentile, milliseconds."""
    max: float
    """The longest, milliseconds."""


class ProducerRunJson(TypedDict):
    """What one producer made of a log, and what it took."""

    name: str
    """The producer."""
    scans: int
    """Scans that were ever fed to it, before it was resumed too."""
    scans_used: int
    """Of these, the ones that were matched or mapped."""
    time_s: float
    """From the first scan asked for to the finished map, reading included; seconds."""
    time_per_scan_ms: TimePerScanJson
    """Time for each scan that was fed in this run, milliseconds."""
    peak_memory_mb: float
    """Peak of map and filter together, host and device; MB of 10^6 bytes."""
    process_peak_memory_mb: float
    """Peak of the whole process, as the system counts it; MB of 10^6 bytes."""
    duration_s: float
    """Time from the first pose to the last, seconds."""
    path_length_m: float
    """Length of the path, metres."""
    odometry_path_length_m: float | None
    """Length of the path by raw odometry, metres; null without odometry."""
    map: MapSizeJson
    """Size of its map."""
    health: HealthJson
    """How well it did."""
    low_scores_in_a_row: int
    """Most matches one after the other whose score was below half of the mean."""
    warnings: Sequence[str]
    """What contradicts the map, a sentence each."""
    complete: bool
    """Whether the scans came to their end; false: it was stopped before."""
    known_scans: int
    """Scans of the log that a resumed producer had been fed before and that were passed over."""
    log: LogRecord | None
    """What the log said of itself; null where the scans are from no log."""
