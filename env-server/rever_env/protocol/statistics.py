"""SIMPLER's episode statistics, which only the server computes."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Statistics:
    """Flags after a control step; those of the last step are the episode's.

    BridgeEnv documents each flag. SIMPLER has no ever_success and released_success.
    """

    is_success: bool
    is_grasped: bool
    ever_grasped: bool
    consecutive_grasp: bool
    moved_correct_object: bool
    moved_wrong_object: bool
    source_on_target: bool
    ever_success: bool
    released_success: bool
