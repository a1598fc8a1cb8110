"""SIMPLER's episode statistics, judged by the server alone."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Statistics:
    """As of one step; the last step's are the episode's. The last two are ours, not SIMPLER's."""

    is_success: bool
    is_grasped: bool
    ever_grasped: bool
    consecutive_grasp: bool
    moved_correct_object: bool
    moved_wrong_object: bool
    source_on_target: bool
    ever_success: bool
    released_success: bool
