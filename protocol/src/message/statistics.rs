//! SIMPLER's episode statistics. Only the server computes them.

use serde::{Deserialize, Serialize};

/// The statistics at one step; those of the last step are the episode's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Statistics {
    /// The task is solved at this step.
    pub is_success: bool,
    /// The gripper holds the source object at this step.
    pub is_grasped: bool,
    /// The gripper has held the source object at some step.
    pub ever_grasped: bool,
    /// The gripper has held the source object for several consecutive steps.
    pub consecutive_grasp: bool,
    /// The source object has moved and no other object has.
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
