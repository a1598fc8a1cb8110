//! SIMPLER's episode statistics, judged by the server alone.

use serde::{Deserialize, Serialize};

/// All as of one step; the last step's are the episode's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Statistics {
    /// The task is solved at this step.
    pub is_success: bool,
    /// The gripper holds the source object at this step.
    pub is_grasped: bool,
    /// It has held it at some step.
    pub ever_grasped: bool,
    /// It has held it over several steps in a row.
    pub consecutive_grasp: bool,
    /// The source object has moved, and no other.
    pub moved_correct_object: bool,
    /// Another object has moved.
    pub moved_wrong_object: bool,
    /// The source object is on its target at this step.
    pub source_on_target: bool,
    /// The task has been solved at some step.
    pub ever_success: bool,
    /// The task is solved at this step, and the gripper does not hold the object.
    pub released_success: bool,
}
